"""The search for what a model lacks: calibrate psi, screen candidates, refit the best, select on held-out logs, repeat.

Method and its reasons: Kennedy and O'Hagan (2001) for the discrepancy that must not be credited to psi; score tests
with secants for the screening; a moving-block bootstrap (Kuensch 1989) for what is believed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.arena import Arena, Data
from nfc_gym.measured.contest import Judged
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.lookout import Lookout
from nfc_gym.measured.rounds import Contest, Round
from nfc_gym.measured.screen import Screen, Screened
from nfc_gym.measured.settle import settle
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
Say = Callable[[str], None]


@dataclass(frozen=True)
class Options:
    """Knobs of a search.

    Attributes:
      most: effects at most.
      worth: share of the excess that an effect must explain to be named.
      short: candidates refitted in each round.
      seed: of bootstrap and chance draws.
    """

    most: int = 8
    worth: float = 0.02
    short: int = 8
    seed: int = 0


@dataclass(frozen=True)
class State:
    """Where a search stands between two rounds: all that the rounds to come depend on, besides data and options.

    Attributes:
      plant, x: the model that the next round starts from, as the last round's contest left it.
      rounds: so far.
      hopeless: places that showed nothing (`Lookout.hopeless`).
    """

    plant: Plant
    x: Array
    rounds: tuple[Round, ...] = ()
    hopeless: frozenset[str] = field(default_factory=frozenset)


@dataclass
class Found:
    """Outcome of a search.

    Attributes:
      calibrated: psi alone, fitted.
      extended: psi and the accepted effects, fitted.
      slack: (m,) that of the metric of the last round, under which `extended` was fitted.
      rounds: in order, the last one being the round that accepted nothing.
      generic: id of a generic alternative that beat every named effect, or None.
      screened: the last round's screening, from which the identifiability table is made.
    """

    calibrated: Fit
    extended: Fit
    slack: Array
    rounds: list[Round]
    generic: str | None
    screened: list[Screened]


class Search:
    """One greedy search on fit and selection problems."""

    def __init__(self, fit_data: Data, select: Data, candidates: Sequence[Effect], options: Options, say: Say) -> None:
        self.fit_data, self.select = fit_data, select
        self.named = [e for e in candidates if not e.generic]
        self.generics = [e for e in candidates if e.generic]
        self.options, self.say = options, say
        self.rng = np.random.default_rng(options.seed)
        self.lookout = Lookout(fit_data.problem, self.rng, say)

    def settle(self, plant: Plant, x: Array, polished: bool = False) -> Arena:
        """The arena of the round that starts from a model, which is refitted first."""
        data, seed = self.fit_data, None if polished else self.options.seed
        fitted, under, extra = settle(data.problem, data.sigma, plant, x, seed)
        return Arena(data, self.select, fitted, under, extra, self.rng, self.say)

    def run(
        self, calibrated: Fit, begun: State | None = None, keep: Callable[[State], None] = lambda state: None
    ) -> Found:
        """Greedy rounds from a calibrated model until nothing more is believed; then the generic alternatives' turn.

        Args:
          calibrated: psi alone, fitted.
          begun: state of a search that was interrupted, to go on from; the outcome is that of one that was not.
          keep: called with the state after every round that accepted something.
        """
        state = begun or State(calibrated.plant, calibrated.x)
        self.lookout.hopeless = set(state.hopeless)
        rounds = list(state.rounds)
        while True:
            arena = self._begin(state)
            screen = Screen(self.fit_data.problem, arena.under, arena.current)
            screened = self.lookout.closer(screen, self.lookout.screen(screen, self.named))
            outcome, best = Contest(arena, screen, screened, self.options.short, self.options.worth).hold()
            rounds.append(outcome)
            if best is None or len(arena.current.plant.effects) >= self.options.most:
                break
            state = State(best.fitted.plant, best.fitted.x, tuple(rounds), frozenset(self.lookout.hopeless))
            keep(state)
        generic = self._generic(arena, screen, outcome)
        current = arena.current
        if generic is not None and current.plant.effects and self._outdone(arena, generic, calibrated):
            self.say("a generic law explains clearly more than all named effects: none is claimed")
            current = fit(self.fit_data.problem, arena.under, calibrated.plant, calibrated.x, 6)
        label = None if generic is None else arena.label(generic)
        return Found(calibrated, current, arena.extra, rounds, label, screened)

    def _begin(self, state: State) -> Arena:
        """The arena of the round that follows a state.

        Each round draws from a generator of its own: what it draws does not depend on which rounds ran before it in
        this process, and a search that goes on after an interruption draws the same.
        """
        self.rng = self.lookout.rng = np.random.default_rng([self.options.seed, len(state.rounds)])
        arena = self.settle(state.plant, state.x, polished=not state.rounds)
        current = self._prune(arena) if state.rounds else arena.current
        return arena if current is arena.current else self.settle(current.plant, current.x, polished=True)

    def _prune(self, arena: Arena) -> Fit:
        """Drop earlier effects that the later ones have made superfluous."""
        for effect in arena.current.plant.effects[:-1]:
            without = arena.without(effect)
            kept = without.judge(arena.current)
            if not without.worth(kept, self.options.worth) and not without.likelier(kept):
                self.say(f"dropped {effect.id}: the others explain what it did")
                arena = without
        return arena.current

    # ---- generic alternatives ---------------------------------------------------------------------------------------

    def _generic(self, arena: Arena, screen: Screen, outcome: Round) -> Judged | None:
        """The smooth law of position, speed or time that still adds most to the accepted effects, if it is believed."""
        screened = self.lookout.screen(screen, self.generics)
        judged = sorted((arena.enter([s]) for s in screened[:3] if s.gain > 0), key=lambda j: -j.total)
        outcome.ranking += [arena.row(j) for j in judged]
        if not judged or not arena.worth(judged[0], self.options.worth):
            return None
        chance = screen.chance(screened, arena.blocks[0], self.rng)
        return judged[0] if float(judged[0].fit_gains.sum()) > chance.get(arena.label(judged[0]), 0.0) else None

    def _outdone(self, arena: Arena, generic: Judged, calibrated: Fit) -> bool:
        """Whether that generic law alone explains clearly more than all accepted effects together."""
        problem = self.fit_data.problem
        bare = arena.facing(fit(problem, arena.under, calibrated.plant, calibrated.x, 6))
        effect = arena.new(generic)[0]
        plant = calibrated.plant.with_effects([effect])
        rival = bare.judge(fit(problem, arena.under, plant, np.concatenate([bare.current.x, effect.null]), 10))
        named = bare.judge(arena.current)
        return rival.total > 1.25 * named.total and not arena.ties(rival, named)
