"""What a round believes: likelihood with each model's own slack, and parameters within what is plausible."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.choice import Choice
from nfc_gym.measured.contest import Judged, losses
from nfc_gym.measured.fit import Fit, stand
from nfc_gym.measured.metric import metric
from nfc_gym.measured.owned import Data
from nfc_gym.measured.problem import Columns, Problem
from nfc_gym.measured.search import Options, Search
from nfc_gym.measured.settle import slack
from nfc_gym.physics.effects.friction import Coulomb
from nfc_gym.physics.effects.inertial import Payload
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import sized


class Curve(Problem):
    """Two quantities over t in blocks of four numbers each; one bends by `bend`, and models are polynomials of t."""

    rough = False

    def __init__(self, bend: float, seed: int, noise: float = 0.1, blocks: int = 60) -> None:
        rng = np.random.default_rng(seed)
        self.t, self.noise = rng.uniform(-1, 1, (blocks, 8)), noise
        self.y = noise * rng.normal(size=self.t.shape)
        self.y[:, :4] += bend * self.t[:, :4]
        self.mask = np.ones(self.t.shape, bool)
        self.log_of, self.time_of, self.names = np.repeat(np.arange(5), blocks // 5), np.arange(blocks) % 12.0, ("log",)
        self.columns = Columns(("a",) * 4 + ("b",) * 4, ("1",) * 8, np.zeros(8), ("joint:a",) * 4 + ("joint:b",) * 4)

    def residual(self, plant: Any, x: np.ndarray) -> np.ndarray:
        basis = np.polynomial.legendre.legvander(self.t, x.shape[1] - 1)
        basis[:, 4:, 1:] = 0
        return self.y - np.einsum("smk,pk->psm", basis, x)

    def covariance(self, plant: Any, x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(self.noise**2 * np.eye(8), (len(self), 8, 8))

    def take(self, index): ...  # type: ignore[override]
    def synthetic(self, plant, x, rng): ...  # type: ignore[override]


def model(problem: Curve, x: list[float]) -> Fit:
    wide = np.full(len(x), 1e9)
    space = SimpleNamespace(low=-wide, high=wide, free=np.ones(len(x), bool))
    same = lambda x: x  # noqa: E731
    plant: Any = SimpleNamespace(space=space, effects=(), null=np.zeros(len(x)), chart=same, unchart=same)
    white = problem.residual(plant, np.array([x]))[0]
    return Fit(plant, np.array(x), white, np.zeros((*white.shape, len(x))))


def arena(bend: float) -> tuple[Arena, Curve]:
    one, other = Curve(bend, 0), Curve(bend, 1)
    data = [Data(p, p.covariance(None, np.zeros(1))) for p in (one, other)]
    under = metric(one, data[0].sigma)
    rng = np.random.default_rng(0)
    return Arena(data[0], data[1], model(one, [0.0]), under, np.zeros(8), rng, lambda text: None), one


def judged(fitted: Fit) -> Judged:
    return Judged(fitted, np.zeros(1), np.zeros(1), 0.0, 0.0)


@pytest.mark.parametrize(("bend", "likelier"), [(0.0, False), (0.01, False), (0.2, True), (5.0, True)])
def test_a_slope_is_likelier_only_where_the_data_bend(bend: float, likelier: bool) -> None:
    contest, problem = arena(bend)
    assert contest.likelier(judged(model(problem, [0.0, bend]))) == likelier


@pytest.mark.parametrize("own", [False, True])
def test_what_a_candidate_explains_is_told_by_the_common_metric_whatever_it_is_judged_by(own: bool) -> None:
    """Gains by a metric of one's own may be of any size."""
    contest, problem = arena(0.05)  # small errors: the loss is a square
    contest.own, half = own, model(problem, [0.0, 0.025])
    whole, left = (losses(contest.select.problem, contest.on, model(problem, [0.0, b])).sum() for b in (0.05, 0.025))
    gains = np.full(60, -1e6 if own else (contest.base.sum() - left) / 60)
    share = contest.explained(Judged(half, gains, gains, 0.0, 0.0))
    assert share == pytest.approx(1 - left / contest.base.sum())
    assert (left - whole) / (contest.base.sum() - whole) == pytest.approx(0.25, abs=0.1)  # of what the slope explains


def test_own_slack_weighs_a_mended_quantity_however_large_the_error_was() -> None:
    contest, problem = arena(5.0)
    half, whole = (contest.unexplained(model(problem, [0.0, slope])) for slope in (2.5, 5.0))
    bare = contest.unexplained(contest.current)
    # Half the error of four of eight numbers: ln 2 for each of 4 x 120 numbers.
    assert bare - half == pytest.approx(480 * np.log(2), rel=0.05)
    assert half - whole > 3 * (bare - half)


def test_leftover_counts_the_slack_beyond_the_noise() -> None:
    contest, _ = arena(0.0)
    assert contest.leftover == 0.0
    variance = float(contest.fit_data.sigma[0, 0, 0])
    contest.extra = np.repeat([3 * variance, 0.0], 4)  # half of the numbers have twice the noise's deviation
    assert contest.leftover == pytest.approx(0.5 * np.log(2))


@pytest.mark.parametrize(
    ("param", "value", "plausible"),
    [
        (Param("gain", "1", 0.2, 3.0, null=1.0), 0.2, False),
        (Param("gain", "1", 0.2, 3.0, null=1.0), 2.99, False),
        (Param("gain", "1", 0.2, 3.0, null=1.0), 0.3, True),
        (Param("level", "N m", 0.0, 5.0), 0.0, True),
        (Param("level", "N m", 0.0, 5.0), 5.0, False),
        (Param("speed", "rad/s", 0.1, 5.0, shape=True), 5.0, True),
        (Param("fraction", "1", 0.0, 1.0, natural=True), 1.0, True),
        # a bound close to null: null is not at it, and where no size that counts lies between, nothing is
        (Param("linear", "N m s/rad", -0.01, 4.0), 0.0, True),
        (Param("linear", "N m s/rad", -0.01, 4.0), -0.0099, False),
        (Param("cubic", "N m s^3/rad^3", -1e-5, 0.15, resolution=6e-5), -1e-5, True),
        (Param("cubic", "N m s^3/rad^3", -1e-5, 0.15, resolution=6e-5), 0.149, False),
    ],
)
def test_a_law_that_ends_at_the_edge_of_the_plausible_stands_in_for_another(
    param: Param, value: float, plausible: bool
) -> None:
    contest, _ = arena(0.0)
    effect: Any = SimpleNamespace(id="law:place", params=(param,))
    plant: Any = SimpleNamespace(effects=(effect,), split=lambda x: (x[:0], [x]))
    fitted = Fit(plant, np.array([value]), np.zeros((1, 1)), np.zeros((1, 1, 1)))
    assert contest.plausible(judged(fitted)) == plausible


class Touching(Curve):
    """A machine whose models expect the more noise the further their first parameter is from zero."""

    rough = True

    def covariance(self, plant: Any, x: np.ndarray) -> np.ndarray:
        return (1 + 100 * abs(x[0])) ** 2 * super().covariance(plant, x)


@pytest.mark.parametrize("own", [True, False])
def test_where_bodies_touch_who_expects_noise_pays_for_it(own: bool) -> None:
    """Two models with the same errors but for a hair: which is better depends on what they expect alone."""
    one, other = Touching(0.0, 0), Touching(0.0, 1)
    calm, loud = model(one, [0.0]), model(one, [0.05])
    data = [Data(p, p.covariance(None, loud.x)) for p in (one, other)]
    rng = np.random.default_rng(0)
    contest = Arena(data[0], data[1], loud, metric(one, data[0].sigma), np.zeros(8), rng, lambda text: None, own=own)
    found = contest.judge(calm)
    numbers = 8 * len(one)  # on either side; six times the deviation costs 2 ln 6 each and spares them nearly all loss
    expected = numbers * (2 * np.log(6) - 1) if own else 0.0
    assert found.gain == pytest.approx(expected, abs=0.2 * numbers)
    assert float(found.fit_gains.sum()) == pytest.approx(expected, abs=0.2 * numbers)


def test_by_a_metric_of_its_own_a_model_is_refitted_and_pays_for_its_slack() -> None:
    """Under the slack of a model that misses the slope, missing it costs nothing; under their own, all of the bend."""
    shared, problem = arena(5.0)
    data = shared.fit_data
    blunt = slack(problem, data.sigma, None, np.zeros(1))  # type: ignore[arg-type]
    under = metric(problem, data.sigma, blunt)
    straight, bent = (stand(problem, under, m.plant, m.x) for m in (model(problem, [0.0]), model(problem, [0.0, 4.0])))
    rng = np.random.default_rng(0)
    common, own = (
        Arena(data, shared.select, straight, under, blunt, rng, lambda text: None, own=own) for own in (False, True)
    )
    gains = [a.judge(bent).total for a in (common, own)]
    # Four of eight numbers, 120 blocks, each with a spread of 0.1 in place of 2.9.
    assert gains[1] == pytest.approx(480 * 2 * np.log(2.9 / 0.1), rel=0.1)
    assert gains[1] > 2 * gains[0]
    found = own.judge(bent).fitted
    assert found.x[1] == pytest.approx(5.0, abs=0.1)
    np.testing.assert_allclose(found.white, under.whiten(problem.residual(None, found.x[None]))[0], atol=1e-6)


@pytest.mark.parametrize(("bend", "pays"), [(0.002, False), (0.02, True)])
def test_a_slope_that_the_data_hardly_show_is_not_worth_a_judgement(bend: float, pays: bool) -> None:
    """A slope costs the logarithm of 960 numbers, and must promise a quarter of that."""
    contest, problem = arena(bend)
    straight, bent = (
        stand(problem, contest.under, m.plant, m.x) for m in (contest.current, model(problem, [0.0, bend]))
    )
    contest.current, contest.own = straight, True
    assert contest.cost(1) == pytest.approx(np.log(960), rel=0.2)  # the loss counts outliers less than their squares
    assert contest.drop(bent, straight) == pytest.approx(-contest.drop(straight, bent))
    assert contest.pays(bent, straight) == pays
    contest.own = False  # judging costs as much as asking whether to
    assert contest.pays(bent, straight)


class Hung(Payload):
    """A lump whose body is 0.2 m across, about a middle of its own."""

    def __init__(self, body: str, middle: float) -> None:
        place = {"low": middle - 0.5, "high": middle + 0.5}
        super().__init__((body,), sized(Payload.PARAMS, x=place, y=place, z=place))


@pytest.mark.parametrize(("apart", "one_thing"), [(0.9, True), (1.1, False)])
def test_of_two_bodies_that_could_carry_one_lump_the_nearer_one_does(apart: float, one_thing: bool) -> None:
    contest, _ = arena(0.0)
    near, far, drag = Hung("trunk", 0.0), Hung("arm", 0.4), Coulomb(("joint",))

    def hung(effect: Any, theta: list[float], off: float) -> Judged:
        white = contest.current.white + off * np.eye(*contest.current.white.shape)
        plant: Any = SimpleNamespace(effects=(effect,), space=())
        return judged(Fit(plant, np.array(theta), white, np.zeros((*white.shape, 4))))

    lump = [0.1, 0.05, 0.05, 0.05]
    trunk, arm = hung(near, lump, 0.0), hung(far, lump, float(np.sqrt(apart * contest.cost(1) / 8)))
    assert contest.nearer(trunk, arm) == one_thing
    assert not contest.nearer(arm, trunk)
    assert not contest.nearer(hung(drag, [0.1], 0.0), arm)


def test_one_lump_on_either_of_two_bodies_is_one_equivalent() -> None:
    shift, near, far = (
        SimpleNamespace(id=i, family=i.partition(":")[0], where=(i[-1],), simpler=(), covers=())
        for i in ("shift:a", "lump:a", "lump:b")
    )
    laws: list[Any] = [SimpleNamespace(law=law, total=total) for law, total in ((shift, 9.0), (near, 8.8), (far, 8.9))]
    found: Any = SimpleNamespace(
        new=lambda j: [j.law],
        label=lambda j: j.law.id,
        ties=lambda best, other, *, priced: True,
        nearer=lambda one, other: (one.law, other.law) == (near, far),
    )
    choice = Choice(found, 0.02, {}, lambda _: pytest.fail("nothing to look at"))
    assert choice.alike(laws, laws[0], laws[0]) == ["shift:a", "lump:a"]


@pytest.mark.parametrize(("drop", "listed"), [(14.9, True), (13.0, False)])
def test_what_gains_as_much_for_more_numbers_is_an_equivalent_however_little_that_is(drop: float, listed: bool) -> None:
    """Where a shift gains little, the price of the number more that a load has is a large part of it."""
    shift, load = (
        SimpleNamespace(id=i, family=i.partition(":")[0], where=("a",), simpler=(), covers=())
        for i in ("shift:a", "load:a")
    )
    best, rival = (
        SimpleNamespace(law=law, total=total, drop=d) for law, total, d in ((shift, 9.0, 15.0), (load, 5.0, drop))
    )
    found: Any = SimpleNamespace(
        new=lambda j: [j.law],
        label=lambda j: j.law.id,
        ties=lambda best, other, *, priced: True,
        nearer=lambda one, other: False,
    )
    choice = Choice(found, 0.02, {}, lambda _: pytest.fail("nothing to look at"))
    laws: Any = [best, rival]
    assert choice.alike(laws, laws[0], laws[0]) == ["shift:a"]
    assert choice.alike(laws, laws[0], laws[0], priced=False) == ["shift:a", *["load:a"] * listed]


@pytest.mark.parametrize(
    ("bluntly", "sharply", "total", "holds"),
    [(True, False, 500.0, True), (False, True, 500.0, True), (False, False, 500.0, False), (False, True, 15.0, False)],
)
def test_a_smooth_law_is_judged_a_second_time_where_much_of_its_gain_is_not_sure(
    bluntly: bool, sharply: bool, total: float, holds: bool
) -> None:
    """As a named effect is; but not for a gain that would not be worth naming if it were sure."""
    j: Any = SimpleNamespace(total=total, fitted="its fit")
    sharp = SimpleNamespace(worth=lambda j, share: sharply, enter_again=lambda j: j)
    arena: Any = SimpleNamespace(
        worth=lambda j, share: bluntly,
        sharper=lambda fitted: sharp,
        misfit=1000.0,
        label=lambda j: "generic_grip:ground",
    )
    said: list[str] = []
    search: Any = SimpleNamespace(options=Options(), say=said.append)
    assert Search._holds(search, arena, j) == holds  # pyright: ignore[reportPrivateUsage]
    asked = not bluntly and total > 100
    assert said == ["judging again under what generic_grip:ground leaves unexplained"] * asked
