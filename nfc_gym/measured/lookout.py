"""Which candidates deserve a refit: linear screening of all, then a closer look at those that lead."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from nfc_gym.measured.fit import Fit
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.screen import Screen, Screened, screen_all
from nfc_gym.measured.suspects import Suspects
from nfc_gym.measured.telling import paced
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.conditions import MARK

_FIELD, _THIN = 30, 3  # a larger pool of candidates is first thinned to so many, on every third block or fewer
_COSTLY = 20  # the same where roll-outs are costly
_ENOUGH = 12  # blocks that such a thinning must leave, and does leave where each is costly
_WORST = 6  # blocks with the largest errors that join them there
_FAINT = 0.05  # of the best gain: what the best of a family must reach there to be among the field whatever its rank
_KEEP = 60  # candidates that are screened again in every round, whatever they gained
_SCOUTED = 16  # candidates, each the best of its family, that a costly problem looks around before refitting
_SURE = 2  # of them, whose gain by straight lines counts where the look around finds less
_PURSUED = 40  # leading candidates that a problem that costs little takes a few steps further before it shortlists
_FIRST = 10  # of the suspected families' candidates that are screened in full, besides the best of each family
_BESIDE, _MOST_BESIDE = 2, 4  # families that lead plain screening and join the suspected ones: always, and at most
_ALIKE = 0.5  # of the best gain there: what a family beyond the first two must reach to join them


class Lookout:
    """Screens pools of candidates round after round, and remembers which places show nothing.

    Args:
      problem: on the fit logs.
      rng: of the draws with which costly problems look around.
      say: progress.
      suspects: what a structure head holds possible; None where there is no head.
    """

    def __init__(
        self,
        problem: Problem,
        rng: np.random.Generator,
        say: Callable[[str], None],
        suspects: Suspects | None = None,
    ) -> None:
        self.problem, self.rng, self.say, self.suspects = problem, rng, say, suspects
        self.hopeless: set[str] = set()
        self._glance: tuple[Screen, list[Screened]] | None = None  # the last one at all candidates, and for whom

    def screen(self, screen: Screen, pool: Sequence[Effect], field: int | None = None) -> list[Screened]:
        """Candidates that are not at work yet, by what they gain as far as straight lines tell, best first.

        Args:
          field: how many of a large pool are screened in full, besides the best of each family.
        """
        field = field or (_COSTLY if self.problem.costly else _FIELD)
        left = self._left(screen, pool)
        self.say(f"screening {len(left)} candidates")
        found = screen_all(screen, self._promising(screen, left, field))
        # Places that show nothing at all are not looked at again; sets of places stay, since they stand for many.
        floor = 1e-3 * float(screen.projected @ screen.projected)
        self.hopeless |= {f.effect.id for f in found[_KEEP:] if f.gain < floor}
        return found

    def first(self, screen: Screen, pool: Sequence[Effect], glance: bool) -> list[Screened]:
        """The same of the suspected families alone, and of those that lead a glance at all candidates.

        Args:
          glance: look at all candidates on some of the blocks, so that a head which is wrong hides nothing that plain
            screening sees. Without it the suspected families are all.
        """
        assert self.suspects is not None
        left, likely = self._left(screen, pool), set(self.suspects.likely)
        chosen = [e for e in left if e.family in likely]
        if glance:
            self.say(f"glancing at {len(left)} candidates")
            best = list({r.effect.family: r for r in reversed(self._rough(screen, left))}.values())[::-1]
            beside = [r for r in best if r.gain > 0][:_MOST_BESIDE]
            beside = [r for i, r in enumerate(beside) if i < _BESIDE or r.gain > _ALIKE * beside[0].gain]
            likely |= {r.effect.family for r in beside}
            chosen = [e for e in left if e.family in likely]
        self.say(f"screening {len(chosen)} candidates of {', '.join(sorted(likely)) or 'no family'} first")
        return screen_all(screen, self._promising(screen, chosen, _FIRST))

    def _left(self, screen: Screen, pool: Sequence[Effect]) -> list[Effect]:
        """Candidates that are not at work yet and may show."""
        taken = {_plain(e) for e in screen.current.plant.effects}
        return [e for e in pool if _plain(e) not in taken and (e.id not in self.hopeless or len(e.where) > 1)]

    def closer(self, screen: Screen, found: list[Screened]) -> list[Screened]:
        """The leading candidates by what they gain in truth, then the rest as screening has them."""
        if self.problem.costly:
            leading = list({f.effect.family: f for f in reversed(found) if f.gain > 0}.values())[::-1][:_SCOUTED]
            thin = self._thinned(screen)
            whole = float(screen.current.losses.sum() / thin.current.losses.sum())
            # A scout sees few blocks: who leads on all of them by straight lines is not lost for what it saw.
            sure = {id(f) for f in leading[:_SURE]}
            look = lambda f: _times(whole, thin.scout(f, self.rng), f.gain * (id(f) in sure))  # noqa: E731
        else:
            leading, look = _pursued(found), screen.pursue
        self.say(f"looking closer at {len(leading)} of them")
        looked = sorted(map(look, paced(self.say, leading)), key=lambda f: -f.gain)
        chosen = {id(f.effect) for f in looked}
        return looked + [f for f in found if id(f.effect) not in chosen]

    def _thinned(self, screen: Screen) -> Screen:
        """The same screen on some of the blocks, where there are enough of them.

        They are spread evenly; where only few can be had, those with the largest errors join them: a limit that is
        reached in three blocks of seventy shows in no others.
        """
        blocks, current = len(self.problem), screen.current
        if blocks < _THIN * _ENOUGH:
            return screen
        index = np.arange(0, blocks, blocks // _ENOUGH if self.problem.costly else _THIN)
        if self.problem.costly:
            index = np.union1d(index, np.argsort(current.losses)[-_WORST:])
        part = Fit(current.plant, current.x, current.white[index], current.jacobian[index])
        return Screen(self.problem.part(index), screen.metric.take(index), part)

    def _promising(self, screen: Screen, pool: list[Effect], field: int) -> list[Effect]:
        """Of a large pool, those that do best on some of the blocks, and the best of each family that does anything."""
        thin = self._thinned(screen)
        if len(pool) <= field or thin is screen:
            return pool
        rough = self._rough(screen, pool)
        least = _FAINT * rough[0].gain if self.problem.costly else 0.0
        families = {r.effect.family: r.effect for r in reversed(rough) if r.gain >= least}
        best = [r.effect for r in rough[:field]]
        return best + [e for e in families.values() if e not in best]

    def _rough(self, screen: Screen, pool: list[Effect]) -> list[Screened]:
        """Candidates by what they gain on some of the blocks; what the last glance saw is not rolled out anew."""
        of, seen = self._glance if self._glance is not None else (None, [])
        known = {id(r.effect): r for r in seen} if of is screen else {}
        thin = self._thinned(screen)
        new = screen_all(thin, [e for e in pool if id(e) not in known], every_size=not self.problem.costly)
        found = sorted([*new, *(known[id(e)] for e in pool if id(e) in known)], key=lambda s: -s.gain)
        if self.suspects is not None:
            self._glance = screen, [*known.values(), *new]
        return found


def _pursued(found: Sequence[Screened]) -> list[Screened]:
    """Of candidates, best first, those whose true gains are asked: who leads, sets of places, the best of each family.

    Straight lines may say next to nothing of the right one. Inertia of a leg's knees beside their friction gained 2 by
    them, 171st of 337, and 108 in truth, twice what any other did.
    """
    hopeful = [f for f in found if f.gain > 0]
    best = {id(f) for f in {f.effect.family: f for f in reversed(hopeful)}.values()}
    return [f for i, f in enumerate(hopeful) if i < _PURSUED or len(f.effect.where) > 1 or id(f) in best]


def _times(factor: float, found: Screened, least: float) -> Screened:
    """What was found on some of the blocks, with the gain that all of them would bring, or at least so much."""
    return replace(found, gain=max(factor * found.gain, least))


def _plain(effect: Effect) -> str:
    """Id without the mark of values that differ by place or condition."""
    return effect.id.removesuffix(":each").removesuffix(MARK)
