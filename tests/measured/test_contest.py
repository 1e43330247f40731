"""Believing a candidate: folds that leave out, clusters that belong together, and gains that are not chance."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.choice import Choice
from nfc_gym.measured.contest import (
    Judged,
    bootstrap,
    calmed,
    clusters,
    dispersion,
    fold_of,
    left_out,
    not_worse,
    shortlist,
)
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.metric import Metric, loss, metric
from nfc_gym.measured.problem import Columns, Problem
from nfc_gym.measured.ranking import Round
from nfc_gym.measured.rounds import Contest
from nfc_gym.measured.screen import Screened, likeness
from nfc_gym.physics.effects import FAMILIES
from nfc_gym.physics.effects.each import each


class Line(Problem):
    """y = 1 + noise in blocks of four numbers, fitted by Legendre polynomials of t: every answer is known.

    Bounds are so wide that the pull towards nominal is nothing and the fit is plain regression.
    """

    def __init__(self, blocks: int, noise: float, seed: int, logs: int = 5) -> None:
        rng = np.random.default_rng(seed)
        self.t = rng.uniform(-1, 1, (blocks, 4))
        self.y = 1.0 + noise * rng.normal(size=self.t.shape)
        self.noise = noise
        self.mask = np.ones(self.t.shape, bool)
        self.log_of = np.repeat(np.arange(logs), -(-blocks // logs))[:blocks]
        self.time_of = 0.4 * (np.arange(blocks) - np.searchsorted(self.log_of, self.log_of))
        self.names = tuple(f"log_{k}" for k in range(logs))
        self.columns = Columns(("y",) * 4, ("1",) * 4, np.zeros(4), ("joint:j",) * 4)

    def basis(self, size: int) -> np.ndarray:
        return np.polynomial.legendre.legvander(self.t, size - 1)

    def residual(self, plant: Any, x: np.ndarray) -> np.ndarray:
        return self.y - np.einsum("smk,pk->psm", self.basis(x.shape[1]), x)

    def covariance(self, plant: Any, x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(self.noise**2 * np.eye(4), (len(self), 4, 4))

    def take(self, index): ...  # type: ignore[override]
    def synthetic(self, plant, x, rng): ...  # type: ignore[override]


def flat(size: int) -> Any:
    """A plant with `size` free numbers and no model: regression needs none."""
    wide = np.full(size, 1e9)
    space = SimpleNamespace(low=-wide, high=wide, free=np.ones(size, bool))
    same = lambda x: x  # noqa: E731
    return SimpleNamespace(space=space, effects=(), null=np.zeros(size), chart=same, unchart=same)


def regress(problem: Line, size: int) -> tuple[Fit, Any]:
    """Least squares of a polynomial with `size` coefficients, as a `Fit`."""
    plant = flat(size)
    x = np.linalg.lstsq(problem.basis(size).reshape(-1, size), problem.y.ravel(), rcond=None)[0]
    under = metric(problem, problem.covariance(plant, x))
    scale = (plant.space.high - plant.space.low) / 4
    white = under.whiten(problem.residual(plant, x[None]))[0]
    return Fit(plant, x, white, -problem.basis(size) * scale / problem.noise), under


def placed(log_of: list[int], time_of: list[float]) -> Any:
    return SimpleNamespace(log_of=np.array(log_of), time_of=np.array(time_of), __len__=None)


def test_blocks_near_in_time_share_a_cluster_and_logs_never_do() -> None:
    found = clusters(placed([0, 0, 0, 1, 1, 2], [0.0, 0.4, 0.6, 0.0, 0.2, 0.0]))
    assert found.shape == (6,)
    assert found[0] == found[1] != found[2]
    assert found[3] == found[4]
    assert len(set(found.tolist())) == 4
    assert set(found.tolist()) == set(range(4))
    assert len(set(clusters(placed([0] * 4, [0, 0.4, 0.8, 1.2]), 10.0).tolist())) == 1


def test_whole_logs_are_left_out_where_there_are_several() -> None:
    problem = Line(40, 1, 0, logs=5)
    folds = fold_of(problem)
    for k in range(5):
        assert len(set(folds[problem.log_of == k].tolist())) == 1
    assert len(set(folds.tolist())) == 5
    many = Line(60, 1, 0, logs=20)
    assert set(fold_of(many, most=8).tolist()) == set(range(8))
    assert all(len(set(fold_of(many)[many.log_of == k].tolist())) == 1 for k in range(20))


@pytest.mark.parametrize("logs", [1, 2])
def test_few_logs_are_cut_in_stretches(logs: int) -> None:
    problem = Line(40, 1, 0, logs=logs)
    folds = fold_of(problem)
    assert np.bincount(folds).tolist() == [5] * 8
    for k in range(logs):  # consecutive in time, never interleaved
        of = problem.log_of == k
        assert (np.diff(folds[of][np.argsort(problem.time_of[of])]) >= 0).all()


def test_bootstrap_has_the_mean_and_spread_of_a_sum_over_clusters() -> None:
    rng = np.random.default_rng(0)
    blocks = np.repeat(np.arange(50), 4)
    common = np.repeat(rng.normal(1, 1, 50), 4)  # the blocks of a cluster all err alike
    draws = bootstrap(common, blocks, rng, draws=20_000)
    sums = np.bincount(blocks, common)
    assert draws.mean() == pytest.approx(common.sum(), abs=0.03 * np.sqrt(50) * sums.std())
    assert draws.std() == pytest.approx(np.sqrt(50) * sums.std(), rel=0.03)
    apart = bootstrap(common, np.arange(200), rng, draws=20_000)
    assert draws.std() == pytest.approx(2 * apart.std(), rel=0.1)  # taken as independent they would seem surer


def test_left_out_losses_are_those_of_a_refit() -> None:
    """Against regression that truly leaves each fold out; the damped step comes within a few per cent of its cost."""
    problem = Line(40, 0.1, 1)
    result, under = regress(problem, 3)
    folds = fold_of(problem)
    found = left_out_losses(problem, under, result, folds)
    exact = np.empty(len(problem))
    for k in np.unique(folds):
        of = folds == k
        x = np.linalg.lstsq(problem.basis(3)[~of].reshape(-1, 3), problem.y[~of].ravel(), rcond=None)[0]
        exact[of] = loss(under.whiten(problem.residual(None, x[None])))[0][of]
    inside = result.losses
    assert (found - inside).sum() == pytest.approx((exact - inside).sum(), rel=0.25)
    np.testing.assert_allclose(found, exact, atol=0.2 * inside.mean())


def left_out_losses(problem: Problem, under: Metric, fitted: Fit, folds: np.ndarray) -> np.ndarray:
    """Surprises without what every model pays for the noise that it expects."""
    inside = under.surprise(problem.residual(fitted.plant, fitted.x[None]))[0]
    return left_out(problem, under, fitted, folds) - inside + fitted.losses


@pytest.mark.parametrize("seed", range(5))
def test_a_superfluous_parameter_pays_on_what_it_did_not_see(seed: int) -> None:
    """y has no slope and no curvature: in-sample they always gain, left out they lose."""
    problem = Line(30, 0.1, seed)
    (small, under), (large, _) = regress(problem, 1), regress(problem, 6)
    folds = fold_of(problem)
    outside = [left_out_losses(problem, under, f, folds).sum() for f in (small, large)]
    assert large.losses.sum() < small.losses.sum()
    for f, out in zip((small, large), outside, strict=True):
        assert out > f.losses.sum()
    optimism = [out - f.losses.sum() for f, out in zip((small, large), outside, strict=True)]
    assert optimism[1] > optimism[0]


def test_superfluous_parameters_lose_on_average() -> None:
    lost = []
    for seed in range(40):
        problem = Line(30, 0.1, 100 + seed)
        (small, under), (large, _) = regress(problem, 1), regress(problem, 6)
        folds = fold_of(problem)
        out = [left_out_losses(problem, under, f, folds).sum() for f in (small, large)]
        lost.append(out[1] - out[0])
    assert np.mean(lost) > 3 * np.std(lost) / np.sqrt(len(lost))


def test_dispersion_is_the_loss_of_one_number() -> None:
    assert dispersion(regress(Line(2000, 0.3, 2), 1)[0]) == pytest.approx(0.93, abs=0.05)  # robust: a little below 1


def judged(gains: np.ndarray, fit_gains: np.ndarray) -> Judged:
    return Judged(None, gains, fit_gains, float(gains.sum() + fit_gains.sum()), 0.0)  # type: ignore[arg-type]


def test_not_worse_is_symmetric_between_equals() -> None:
    rng = np.random.default_rng(3)
    blocks = np.arange(100)
    base = rng.normal(5, 1, 100)
    one, same = judged(base, base), judged(base, base)
    other = judged(base + rng.normal(0, 1, 100), base + rng.normal(0, 1, 100))
    assert not_worse(one, same, blocks, blocks, rng)
    assert not_worse(one, other, blocks, blocks, rng)
    assert not_worse(other, one, blocks, blocks, rng)


def test_not_worse_tells_a_clear_difference_from_one_lucky_block() -> None:
    rng = np.random.default_rng(4)
    blocks = np.arange(100)
    base = rng.normal(5, 1, 100)
    best, worse = judged(base, base), judged(base - 1, base - 1)
    assert not not_worse(best, worse, blocks, blocks, rng)
    assert not_worse(worse, best, blocks, blocks, rng)
    lucky = base + rng.normal(0, 0.1, 100)
    lucky[0] += 500
    assert not_worse(judged(lucky, base), best, blocks, blocks, rng)


def test_few_blocks_that_gain_much_are_believed_and_one_is_not() -> None:
    """Seventy blocks of a hundred numbers; what chance does to them is symmetric, and heavy where a foot slips."""
    rng = np.random.default_rng(5)
    numbers, blocks = np.full(70, 100), np.arange(70)

    def believed(gains: np.ndarray) -> bool:
        return float(np.quantile(bootstrap(calmed(gains, numbers), blocks, rng), 0.005)) > 0

    noise = rng.permutation(np.concatenate([np.linspace(-30, 30, 68), [-150.0, 150.0]]))
    limit = noise.copy()
    limit[:9] += [1400, 250, 240, 200, 190, 180, 160, 150, 140]  # a limit that few blocks reach
    one = noise.copy()
    one[0] += 3000
    assert believed(limit)
    assert not believed(one)
    assert not believed(noise)
    assert not believed(-limit)


def test_calmed_gains_are_the_gains_where_these_are_small() -> None:
    small, numbers = np.array([-1.0, 0.0, 2.0]), np.full(3, 200)
    np.testing.assert_allclose(calmed(small, numbers), small, rtol=2e-3)
    assert calmed(np.array([2000.0]), numbers[:1])[0] == pytest.approx(200 * np.arcsinh(10))
    assert np.isfinite(calmed(small, np.zeros(3, int))).all()


def row(family: str, gain: float, where: str = "hub", simpler: tuple = ()) -> Any:
    """A screened candidate at a place of its own, or at a shared one."""
    place = (where,) if simpler or where != "hub" else (f"{family}_{gain}",)
    return SimpleNamespace(effect=SimpleNamespace(family=family, where=place, simpler=simpler), gain=gain)


def test_no_family_crowds_out_the_others() -> None:
    screened = [row("coulomb", 100 - k) for k in range(10)] + [row("lag", 50), row("gain", 40), row("offset", -1)]
    picked = shortlist(screened, size=8, each=3)
    assert [s.effect.family for s in picked] == ["coulomb"] * 3 + ["lag", "gain"]
    assert [s.gain for s in picked] == [100, 99, 98, 50, 40]
    assert len(shortlist(screened, size=2)) == 2


def test_friction_in_four_dresses_counts_as_one_mechanism_at_one_place() -> None:
    plain = (("coulomb",), ("coulomb", "damping_poly"))
    screened = [
        row("stribeck", 100, "all", plain),
        row("coulomb", 90, "all"),
        row("load_friction", 80, "all", plain),
        row("load_friction", 70, "left", plain),
        row("slip", 10, "ground"),
    ]
    picked = shortlist(screened, size=4)
    assert [(s.effect.family, s.gain) for s in picked] == [
        ("stribeck", 100), ("coulomb", 90), ("load_friction", 70), ("slip", 10),
    ]  # fmt: skip


def choice(arena: Any, pool: list[Any]) -> Choice:
    return Choice(arena, 0.02, {e.id: e for e in pool}, lambda effect: SimpleNamespace(effect=effect))  # pyright: ignore[reportArgumentType]


def test_plainer_laws_are_tried_though_screening_left_them_out() -> None:
    """Friction by direction is dry friction and a preload together, neither of which leads alone in a large pool."""
    law, coulomb, force = (FAMILIES[f](("hinge",)) for f in ("directional_friction", "coulomb", "external_force"))
    best: Any = SimpleNamespace(fitted=SimpleNamespace(plant=SimpleNamespace(effects=[law])))
    arena = SimpleNamespace(
        fit_data=SimpleNamespace(problem=SimpleNamespace(rough=False)),
        current=SimpleNamespace(plant=SimpleNamespace(effects=[])),
        new=lambda judged: [law],
        enter_beside=lambda leader, picks: [p.effect for p in picks],
    )
    assert list(choice(arena, [law, coulomb, force])._plainer(best)) == [[coulomb], [coulomb, force]]


def test_plainer_laws_take_the_place_of_an_accepted_one_that_wants_values_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Friction by direction at all joints alike came first; with values at each joint it is two plainer laws there."""
    alike, coulomb, force, other = (
        FAMILIES[f](("hip", "knee")) for f in ("directional_friction", "coulomb", "external_force", "armature")
    )
    parts = lambda effect: each([type(effect)((name,)) for name in effect.where])  # noqa: E731
    monkeypatch.setattr("nfc_gym.measured.choice.split", lambda effect, plant: (parts(effect), None))
    monkeypatch.setattr("nfc_gym.measured.choice.Screen", lambda *_: SimpleNamespace(try_one=screened))
    screened = lambda effect: SimpleNamespace(effect=effect)  # noqa: E731
    law = parts(alike)

    def arena(effects: list) -> Any:
        return SimpleNamespace(
            fit_data=SimpleNamespace(problem=SimpleNamespace(rough=False)),
            under=None,
            current=SimpleNamespace(plant=SimpleNamespace(effects=effects)),
            new=lambda judged: [law],
            without=lambda effect: arena([e for e in effects if e is not effect]),
            enter_beside=lambda leader, picks: SimpleNamespace(fitted=[*effects, *(p.effect for p in picks)]),
            judge=lambda fitted: [e.id for e in fitted],
        )

    best: Any = SimpleNamespace(fitted=SimpleNamespace(plant=SimpleNamespace(effects=[other, law])))
    assert list(choice(arena([alike, other]), [alike, coulomb, force])._plainer(best)) == [
        ["armature:hip+knee", "coulomb:hip+knee:each"],
        ["armature:hip+knee", "coulomb:hip+knee:each", "external_force:hip+knee:each"],
    ]


def candidate(name: str, columns: list[list[float]]) -> Screened:
    effect: Any = SimpleNamespace(id=name, place=name, kin=(), family=name)
    return Screened(effect, 1.0, np.zeros(1), np.zeros(1), np.array(columns, float).reshape(-1, 4).T)


def test_likeness_asks_what_the_other_could_do_of_what_the_one_does() -> None:
    residual = np.array([3.0, 4.0, 0.0, 1.0])
    first, both = candidate("a", [[2, 0, 0, 0]]), candidate("b", [[1, 0, 0, 0], [0, 1, 0, 0]])
    tilted, apart = candidate("c", [[1, 1, 0, 0]]), candidate("d", [[0, 0, 1, 0]])
    assert likeness(first, both, residual) == pytest.approx(1.0)
    assert likeness(both, first, residual) == pytest.approx(0.6)
    assert likeness(first, tilted, residual) == pytest.approx(np.sqrt(0.5))
    assert likeness(first, apart, residual) == pytest.approx(0.0)
    assert likeness(first, candidate("e", []), residual) == 0.0


def asking(screened: list[Screened], pool: list[Any] = []) -> Contest:  # noqa: B006 (never written to)
    """A contest whose answer to a candidate that is fitted beside the best is its id."""
    arena: Any = SimpleNamespace(
        fit_data=SimpleNamespace(problem=SimpleNamespace(rough=True)),
        current=SimpleNamespace(plant=SimpleNamespace(effects=[])),
        new=lambda j: j.fitted.plant.effects,
        label=lambda j: j.fitted.plant.effects[0].id,
        enter_beside=lambda best, picks: picks[0].effect.id,
    )
    screen: Any = SimpleNamespace(
        projected=np.array([1.0, 0.0, 0.0, 0.0]), try_one=lambda e: replace(candidate("new", [[0, 0, 1, 0]]), effect=e)
    )
    return Contest(arena, screen, screened, 8, 0.02, pool)


def refitted(effect: Any) -> Judged:
    return Judged(SimpleNamespace(plant=SimpleNamespace(effects=[effect])), np.zeros(1), np.zeros(1), 1.0, 1.0)  # type: ignore[arg-type]


def test_what_does_the_same_as_the_best_is_asked_before_the_best_is_believed() -> None:
    """Whoever was refitted in full already is not asked again, and of many that do the same the two nearest are."""
    lag, named = candidate("lag", [[1, 0.1, 0, 0]]), [candidate("far", [[0, 1, 0, 0]])]
    near = [candidate(f"near_{k}", [[1, 0.1 + 0.01 * k, 0, 0]]) for k in range(4)]
    contest = asking([*named, *near[::-1], lag])
    best, asked = (refitted(s.effect) for s in (lag, near[1]))
    assert contest._mimics(best, [best, asked]) == ["near_0", "near_2"]


def test_a_shifted_centre_of_mass_is_not_believed_before_a_load_was_asked() -> None:
    """Straight lines show no likeness, and a thinned screening left the load out: it is asked all the same."""
    shift, load, elsewhere = (
        FAMILIES[f]((body,)) for f, body in (("com_shift", "torso"), ("payload", "torso"), ("payload", "foot"))
    )
    screened = [replace(candidate("shift", [[1, 0, 0, 0]]), effect=shift)]
    best = refitted(shift)
    assert asking(screened, [shift, load, elsewhere])._mimics(best, [best]) == ["payload:torso"]
    assert asking(screened, [shift, load, elsewhere])._mimics(best, [best, refitted(load)]) == []
    assert asking(screened, [shift, elsewhere])._mimics(best, [best]) == []
    # Of a load that is in the model already there is nothing to ask.
    contest: Any = asking(screened, [shift, load, elsewhere])
    contest.arena.current.plant.effects = [load]
    contest.arena.new = lambda j: [e for e in j.fitted.plant.effects if e is not load]
    both: Any = SimpleNamespace(plant=SimpleNamespace(effects=[load, shift]))
    best = Judged(both, np.zeros(1), np.zeros(1), 1.0, 1.0)
    contest.arena.label = lambda j: "+".join(e.id for e in contest.arena.new(j))
    assert contest._mimics(best, [best]) == []


@pytest.mark.parametrize("rough", [False, True])
def test_a_law_is_not_believed_before_its_likest_other_places_were_asked(rough: bool) -> None:
    """Though other families do more alike, and though a thinned screening left such a place out."""
    here, there, far, aside = (FAMILIES["coulomb"]((j,)) for j in ("hip", "knee", "toe", "neck"))
    lines = {here.id: [1, 0.1, 0, 0], there.id: [1, 0.3, 0, 0], far.id: [0, 1, 0, 0], aside.id: [1, 0.2, 0, 0]}
    screened = [replace(candidate(e.id, [lines[e.id]]), effect=e) for e in (here, there, far)]
    screened += [candidate(f"near_{k}", [[1, 0.1 + 0.01 * k, 0, 0]]) for k in range(2)]
    contest = asking(screened, [here, there, far, aside])
    contest.rough = rough
    contest.screen.try_one = lambda e: replace(candidate(e.id, [lines[e.id]]), effect=e)  # type: ignore[method-assign]
    best = refitted(here)
    wanted = [there.id] if rough else [aside.id, there.id]
    assert contest._mimics(best, [best]) == [*wanted, "near_0", "near_1"]


def test_the_leading_law_is_tried_where_like_places_share_it() -> None:
    """Only wider and narrower sets that were not asked and promise enough are; nothing is where nothing touches."""
    law = FAMILIES["saturation"]
    one, both, three, other = (law(w) for w in (("a",), ("a", "b"), ("a", "b", "c"), ("b", "c")))
    pool = [one, both, three, other, FAMILIES["gain"](("a", "b"))]
    contest = asking([], pool)
    arena, screen = contest.arena, contest.screen
    gains = {one.id: 1.0, other.id: 1.0, both.id: 100.0, three.id: 1.0}
    arena.promises, arena.asked = (lambda s: s.gain), (lambda s, worth: 100.0)  # type: ignore[method-assign]
    arena.rng, arena.enter = np.random.default_rng(0), lambda picks: picks[0].effect.id  # type: ignore[assignment]
    screen.scout = lambda s, rng, draws: replace(s, gain=gains[s.effect.id])  # type: ignore[method-assign]
    assert contest._shared([refitted(one), refitted(other)]) == [both.id]
    assert contest._shared([refitted(one), refitted(both)]) == []
    assert contest._shared([refitted(both)]) == [], "the widest promises too little"
    gains[three.id] = 100.0
    assert contest._shared([refitted(both), refitted(one)]) == [three.id]
    assert contest._shared([refitted(three)]) == [both.id], "a narrower set"
    gains |= {one.id: 200.0, other.id: 300.0}
    assert contest._shared([refitted(three)]) == [other.id, one.id], "the two that promise most"
    contest.rough = False
    assert contest._shared([refitted(one)]) == []


@dataclass(frozen=True)
class SimpleFit:
    """A fit that is known by its law's family."""

    family: str


def rated(family: str, total: float, where: tuple[str, ...] = ("all",)) -> Judged:
    own = FAMILIES[family]
    effect = SimpleNamespace(
        id=f"{family}:{'+'.join(where)}", family=family, where=where, simpler=own.simpler, covers=own.covers
    )
    return Judged(SimpleNamespace(plant=SimpleNamespace(effects=[effect])), np.zeros(1), np.zeros(1), total, 1.0)  # type: ignore[arg-type]


def test_who_comes_near_the_best_meets_it_again_at_half_the_step() -> None:
    """One of a family, no further form of the best's own, nobody far behind, and nobody where nothing touches."""
    best, lag, apart = rated("delay", 100.0), rated("lag", 90.0), rated("lag", 85.0, ("one",))
    gain, slip, faint = rated("gain", 70.0), rated("slip", 60.0), rated("wind", 20.0)
    judged = [best, rated("delay", 95.0, ("one",)), lag, apart, gain, slip, faint]
    said: list[Judged] = []

    def again(duel: list[Judged], whole: Any) -> list[Judged]:
        said.extend(duel)
        half: Any = SimpleNamespace(step="half")
        return [replace(j, total=200.0 if j is lag else 50.0, fitted=half) for j in duel]

    arena: Any = SimpleNamespace(
        fit_data=SimpleNamespace(problem=SimpleNamespace(rough=True)),
        new=lambda j: j.fitted.plant.effects,
        halved=lambda: SimpleNamespace(enter_halved=again),
    )
    contest = Contest(arena, SimpleNamespace(), [], 8, 0.02)  # pyright: ignore[reportArgumentType]
    rivals = contest._rivals(best, judged)
    assert rivals == [lag, gain]
    duel = contest._at_half([best, *rivals])
    assert said == [best, lag, gain]
    assert [j.total for j in duel] == [200.0, 50.0, 50.0]
    assert duel[0].fitted is lag.fitted  # the search goes on at the whole step
    contest.rough = False
    assert contest._rivals(best, judged) == []


@pytest.mark.parametrize("own", [True, False])
def test_rivals_are_judged_by_the_noise_of_each_in_turn(own: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """What chance has told one of them of its noise counts for the other as well."""
    worth = {("delay", "delay"): 1100.0, ("delay", "lag"): 560.0, ("lag", "delay"): 1080.0, ("lag", "lag"): 600.0}
    monkeypatch.setattr("nfc_gym.measured.arena._at_half", lambda problem, under, fitted: SimpleFit(fitted.family))

    def judge(fitted: Any, told: str | None) -> Judged:
        total = worth[fitted.family, told or "delay"]
        return Judged(fitted, np.array([total]), np.array([total / 2]), total, total / 10)

    fine: Any = SimpleNamespace(
        own=own,
        say=lambda text: None,
        label=lambda j: "",
        fit_data=SimpleNamespace(problem=None),
        under=None,
        judge=judge,
    )
    whole: Any = SimpleNamespace(_told_at_half=lambda fitted: fitted.family)
    duel = [Judged(SimpleFit(f), np.zeros(1), np.zeros(1), 0.0, 0.0) for f in ("delay", "lag")]  # pyright: ignore[reportArgumentType]
    delay, lag = Arena.enter_halved(fine, duel, whole)
    assert (delay.total, lag.total) == ((830.0, 840.0) if own else (1100.0, 1080.0))
    assert delay.lower == delay.total / 10
    assert delay.gains == delay.total
    assert delay.fit_gains == delay.total / 2


def test_the_same_law_at_a_place_where_it_does_as_well_comes_to_half_the_step_too() -> None:
    """Of two coupled jaws friction at one alone; what is clearly worse there, and values of their own, stay away."""
    best, one, worse = (
        rated("coulomb", 100.0, ("l", "r")),
        rated("coulomb", 99.0, ("l",)),
        rated("coulomb", 90.0, ("r",)),
    )
    apart, other = rated("coulomb", 99.0, ("l", "r")), rated("hysteresis", 98.0, ("l",))
    met: list[str] = []

    def again(duel: list[Judged], whole: Any) -> list[Judged]:
        met.extend(map(arena.label, duel))
        return duel

    arena: Any = SimpleNamespace(
        fit_data=SimpleNamespace(problem=SimpleNamespace(rough=True)),
        new=lambda j: j.fitted.plant.effects,
        ties=lambda best, j, priced: j.total > 0.95 * best.total,
        halved=lambda: SimpleNamespace(enter_halved=again),
        label=lambda j: j.fitted.plant.effects[0].id,
        row=lambda j: {"id": j.fitted.plant.effects[0].id},
    )
    contest = Contest(arena, SimpleNamespace(), [], 8, 0.02)  # pyright: ignore[reportArgumentType]
    contest._mimics, contest._believed = (lambda *_: []), (lambda j: True)  # type: ignore[method-assign]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Choice, "simplest", lambda self, believed: believed[0])
        judged = [best, one, apart, other, worse]
        _, left, _ = contest._challenged(Round([], 0.0), judged, judged)
    assert met == ["coulomb:l+r", "hysteresis:l", "coulomb:l"]
    assert one in left


def test_a_law_and_its_special_case_do_not_meet_again() -> None:
    arena: Any = SimpleNamespace(
        fit_data=SimpleNamespace(problem=SimpleNamespace(rough=True)), new=lambda j: j.fitted.plant.effects
    )
    contest = Contest(arena, SimpleNamespace(), [], 8, 0.02)  # pyright: ignore[reportArgumentType]
    plain, wider, other = rated("coulomb", 100.0), rated("stribeck", 99.0), rated("armature", 98.0)
    assert contest._rivals(plain, [plain, wider, other]) == [other]
    assert contest._rivals(wider, [wider, plain, other]) == [other]


@pytest.mark.parametrize(
    ("own", "drops", "near"),
    [
        (True, [100.0, 49.0, 51.0], [True, False, True]),
        (True, [3.0, 2.0, -1.0], [True, False, False]),  # none of them pays: the best alone is asked in full
        (True, [-5.0, -9.0], [True, False]),
        (False, [100.0, 1.0], [True, True]),
    ],
)
def test_only_who_comes_near_the_best_is_judged_by_noise_of_its_own(own: bool, drops: list, near: list) -> None:
    arena: Any = SimpleNamespace(
        own=own, current=None, fit_data=SimpleNamespace(problem=SimpleNamespace(rough=True)),
        drop=lambda fitted, than: fitted, pays=lambda fitted, than: fitted > 10.0,
    )  # fmt: skip
    contest = Contest(arena, SimpleNamespace(), [], 8, 0.02)  # pyright: ignore[reportArgumentType]
    assert contest._near(drops) == near


def test_a_price_decides_a_choice_but_excludes_nothing() -> None:
    rng = np.random.default_rng(5)
    blocks = np.arange(100)
    base = rng.normal(5, 1, 100)
    plain = judged(base, base)
    richer = judged(base + rng.normal(0, 0.1, 100), base + rng.normal(0, 0.1, 100))
    richer = replace(richer, total=richer.total - 10)  # what another parameter costs
    assert not not_worse(plain, richer, blocks, blocks, rng)
    assert not_worse(plain, richer, blocks, blocks, rng, priced=False)
    assert not not_worse(plain, judged(base - 1, base - 1), blocks, blocks, rng, priced=False)
