"""Never silent: what no named effect explains is said in words, mapped, saved as a proposal, and never claimed."""

import io
import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from hidden_laws import WHEEL, Machine, record, swing
from rich.console import Console

from nfc_gym.measured import choice, remainder, rounds
from nfc_gym.measured.bench import candidates, make_bench
from nfc_gym.measured.dataset import load
from nfc_gym.measured.loop import close_loop
from nfc_gym.measured.owned import Data
from nfc_gym.measured.remarks import on_simplicity
from nfc_gym.measured.rounds import Contest
from nfc_gym.measured.search import Found, Options, Search
from nfc_gym.measured.unexplained import unexplained
from nfc_gym.measured.verdict import Verified, verdict
from nfc_gym.physics.effects.saved import from_row

MAPPING = """
version: 1
model: wheel.xml
parameters:
  - {name: damping, field: dof_damping, of: [wheel], unit: N m s/rad, low: 0.0, high: 0.1}
logs:
  - {path: "fit_*.npz", split: fit}
  - {path: "select.npz", split: select}
  - {path: "verify.npz", split: verify}
time: {column: t}
controls:
  "ctrl:motor": {column: u, unit: Nm}
channels:
  "joint:wheel:pos": {column: q, unit: rad, noise: 0.002}
  "joint:wheel:vel": {column: v, unit: rad/s, noise: 0.02}
segments: {length: 0.3, history: 0.0, horizons: [0.1, 0.3]}
effects: {only: [coulomb]}
"""


@dataclass
class Closed:
    """A finished run."""

    out: Path
    report: dict[str, Any]
    said: str
    order: int
    size: float


def write_case(folder: Path, machine: Machine, family: str) -> None:
    """Logs of a wheel, with the mapping and the model beside them; effects of one family are looked among."""
    for seed, name in enumerate(("fit_0", "fit_1", "fit_2", "select", "verify")):
        log = record(machine, 71 + seed, 2.5)
        joint = {k: log.channels[f"joint:wheel:{n}"].values for k, n in (("q", "pos"), ("v", "vel"))}
        np.savez(folder / f"{name}.npz", t=log.time, u=log.controls["ctrl:motor"], **joint)
    (folder / "wheel.xml").write_text(WHEEL.format(known=machine.given))
    (folder / "mapping.yaml").write_text(MAPPING.replace("coulomb", family))


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Closed:
    folder, rng = tmp_path_factory.mktemp("cogging"), np.random.default_rng(71)
    order, size = int(rng.integers(3, 8)), rng.uniform(0.02, 0.05)

    def push(model, data) -> None:
        data.qfrc_applied[0] = size * np.cos(order * data.qpos[0] - 1)

    write_case(folder, Machine(WHEEL, 0.01, 0.012, swing(0.1), push), "coulomb")
    told = io.StringIO()
    report = close_loop(folder / "mapping.yaml", folder / "out", jobs=1, console=Console(file=told, width=500))
    return Closed(folder / "out", report, told.getvalue(), order, size)


def test_the_law_is_a_proposal_and_no_claim(closed: Closed) -> None:
    report = closed.report
    assert report["verdict"] == "unexplained"
    assert report["effects"] == []
    assert [p["id"] for p in report["proposals"]] == ["law_harmonic:wheel"]
    assert report["proposals"][0]["parameters"]["order"]["value"] == pytest.approx(closed.order, abs=0.02)
    left = report["unexplained"]
    assert (left["coordinate"], left["where"]) == ("joint:wheel:pos", "joint:wheel")
    assert left["description"].startswith(f"looks like f(q_wheel): a torque on wheel that repeats {closed.order} times")
    assert left["nearest"] == "coulomb:wheel"
    assert left["nearest_share"] < 0.5
    assert f"the nearest named effect, coulomb:wheel, explains {left['nearest_share']:.0%}" in left["description"]
    chi2 = report["chi2"]
    assert chi2["extended"] < 0.1 * chi2["calibrated"]
    assert json.loads((closed.out / "report.json").read_text())["proposals"] == report["proposals"]


def test_console_and_page_say_so(closed: Closed) -> None:
    assert "UNEXPLAINED at joint:wheel:pos: looks like f(q_wheel)" in closed.said
    page = (closed.out / "report.html").read_text()
    for text in ("law_harmonic:wheel", "a proposed law", "By degree of freedom", "over the position of wheel"):
        assert text in page
    assert "over the speed of wheel" in page
    assert "with the proposed law added" in page


def test_effects_yaml_carries_it_marked_as_a_proposal(closed: Closed) -> None:
    (row,) = yaml.safe_load((closed.out / "effects.yaml").read_text())["effects"]
    assert row["proposal"] is True
    law, theta = from_row(row)
    assert law.id == "law_harmonic:wheel"
    assert np.hypot(theta[0], theta[1]) == pytest.approx(closed.size, rel=0.05)
    assert theta[2] == pytest.approx(closed.order, abs=0.02)


def test_a_law_never_makes_a_verdict_explained() -> None:
    null = np.array([0.99, 1.0, 1.01])
    fine = SimpleNamespace(chi2=lambda stage: 1.0, null=null, shares=null[:, None])
    assert verdict(fine, 0, False) == "nothing missing"
    assert verdict(fine, 1, False) == "explained"
    assert verdict(fine, 0, True) == "unexplained"
    assert verdict(fine, 1, True) == "partly explained"


@pytest.mark.parametrize(("gain", "asked"), [(399.0, True), (401.0, False)])
def test_no_law_is_looked_for_where_effects_leave_too_little_for_it(
    monkeypatch: pytest.MonkeyPatch, gain: float, asked: bool
) -> None:
    """To gain a quarter more than 400 that effects gain it would have to gain all of 100 that they leave."""
    seen: list[Any] = []
    monkeypatch.setattr(remainder, "fit", lambda *_: None)
    monkeypatch.setattr(remainder.LawSearch, "_best", lambda self, arena: seen.append(arena))
    bare = SimpleNamespace(judge=lambda fitted: SimpleNamespace(total=gain))
    data = SimpleNamespace(problem=None)
    arena: Any = SimpleNamespace(facing=lambda _: bare, fit_data=data, under=None, current=None, remains=100.0)
    search = remainder.LawSearch([], 0.0, lambda f: arena, lambda a: a.current)
    assert search._instead(arena, SimpleNamespace(plant=None, x=None), [SimpleNamespace()], False) is None  # pyright: ignore[reportArgumentType]
    assert bool(seen) is asked


def test_even_without_a_law_the_worst_place_is_named() -> None:
    place, channel = ("joint:a", "joint:b"), ("joint:a:pos", "joint:b:vel")
    columns = SimpleNamespace(place=place, group=("joint angle", "joint speed"), channel=channel)
    problem = SimpleNamespace(mask=np.ones((5, 2), bool), columns=columns)
    # The first misses by more, the second by more of what noise alone would make it miss.
    white, none, floor = {"extended": np.tile([4.0, 3.0], (5, 1))}, np.zeros((0, 0)), np.array([8.0, 0.9])
    v = Verified(problem, {}, white, none, none, none, floor)  # pyright: ignore[reportArgumentType]
    last = SimpleNamespace(ranking=[{"id": "lag:m", "generic": False, "share": 0.12}], reason="too small")
    found = SimpleNamespace(rounds=[last], rest=SimpleNamespace(dropped=[], scanned=None), generic=None, hinted=None)
    left = unexplained(v, found, SimpleNamespace(effects=(), model=None), [], [], 0.0)  # pyright: ignore[reportArgumentType]
    assert left["where"] == "joint:b"
    assert left["coordinate"] == "joint:b:vel"
    said = "furthest beyond the noise in its joint speed, with 10 times its mean square; too small; the"
    assert left["description"].startswith(said)
    assert (left["nearest"], left["nearest_share"]) == ("lag:m", 0.12)


def test_a_law_takes_the_place_of_an_effect_whose_form_is_refuted(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    order, size = rng.uniform(3, 5), rng.uniform(0.04, 0.06)

    def push(model, data) -> None:
        data.qfrc_applied[0] = -size * np.sin(order * data.qpos[0] + 0.3)

    little = lambda t, d, p: [0.03 * (np.sin(2.1 * t + p[0]) + 0.6 * np.sin(5.3 * t + p[1]))]  # noqa: E731
    write_case(tmp_path, Machine(WHEEL, 0.01, 0.012, little, push), "spring_offset")
    bench = make_bench(load(tmp_path / "mapping.yaml"), nthread=1)
    data = []
    for split in ("fit", "select"):
        problem = bench.problem(bench.dataset.of(split))
        data.append(Data(problem, problem.covariance(bench.plant, bench.plant.null)))
    search = Search(data[0], data[1], candidates(bench, bench.dataset.of("fit")), Options(), lambda text: None)
    (spring,) = search.named
    plant = bench.plant.with_effects([spring])
    calibrated, arena = search.settle(bench.plant, bench.plant.null).current, search.settle(plant, plant.null)
    by = "generic_position:wheel"
    refuted = Found(calibrated, arena.current, arena.extra, [], by, None, misshapen={spring.id: by})
    rest = search.rest(refuted)
    assert rest.dropped == [spring.id]
    assert [law.id for law in rest.laws] == ["law_harmonic:wheel"] == [e.id for e in rest.fitted.plant.effects]
    cosine, sine, found = rest.fitted.x[-3:]
    assert (np.hypot(cosine, sine), found) == (pytest.approx(size, rel=0.05), pytest.approx(order, abs=0.1))


class _Alike:
    """An arena in which every candidate explains the data as well as every other."""

    leftover, blocks, rng, base = 0.0, (np.zeros(1, int),) * 2, None, np.ones(1)
    fit_data = SimpleNamespace(problem=SimpleNamespace(rough=False))
    current = SimpleNamespace(plant=SimpleNamespace(effects=()), x=np.zeros(0))

    def __getattr__(self, name: str) -> Any:
        return {"believed": True, "ties": True, "unexplained": 0.0}.get(name)

    def enter(self, picks: list) -> Any:
        plant = SimpleNamespace(effects=(picks[0].effect,))
        return SimpleNamespace(
            fitted=SimpleNamespace(plant=plant, x=np.zeros(1)), total=1.0, drop=2.0, gain=1.0, fit_gains=np.ones(1)
        )

    def new(self, j: Any) -> list:
        return list(j.fitted.plant.effects)


@pytest.mark.parametrize(
    ("families", "claimed"), [(("lag", "gain", "payload"), True), (("lag", "gain", "payload", "wind"), False)]
)
def test_more_than_three_families_that_do_alike_are_no_claim(families: tuple, claimed: bool, monkeypatch) -> None:
    """Pretend arena, real contest: only the number of families that tie differs."""
    arena: Any = _Alike()
    for name in ("believed", "plausible", "ties"):
        setattr(arena, name, lambda *a, **k: True)
    arena.nearer = lambda one, other: False
    arena.unexplained, arena.say, arena.likelier = (lambda f: 0.0), (lambda t: None), (lambda j: True)
    arena.label = lambda j: j.fitted.plant.effects[0].id
    arena.row = lambda j: {"id": arena.label(j), "generic": False}
    arena.judge = arena.again = lambda j: j
    arena.own, arena.explained = False, lambda j: 1.0
    arena.sharper = lambda fitted: arena
    arena.promises, arena.asked = (lambda s: s.gain), (lambda s, share: 0.0)
    arena.enter_apart = lambda *a: None
    monkeypatch.setattr(Contest, "_psi_alone", lambda self, best: None)
    monkeypatch.setattr(rounds, "contains", lambda law, plain: False)
    monkeypatch.setattr(choice, "contains_any", lambda laws, others: False)
    traits = {"where": ("x",), "place": "x", "simpler": (), "kin": (), "generic": False}
    effect = lambda f: SimpleNamespace(id=f"{f}:x", family=f, **traits)  # noqa: E731
    screened: Any = [SimpleNamespace(effect=effect(f), gain=1.0) for f in families]
    contest: Any = Contest(arena, SimpleNamespace(chance=lambda *a: {}, projected=None), screened, 8, 0.02)  # pyright: ignore[reportArgumentType]
    outcome, best = contest.hold()
    assert (best is not None) == claimed == bool(outcome.accepted)
    assert ("4 effects explain it alike" in outcome.reason) != claimed
    assert not outcome.possible
    # With more numbers in each of the others than in the first, they do as well but for the price of these.
    contest.arena = arena
    arena.ties = lambda one, other, *, priced=True: other is one or not priced
    outcome, best = contest.hold()
    assert outcome.accepted == ["lag:x"]
    assert len(outcome.equivalents) == (2 if claimed else 0)
    assert outcome.possible == ([] if claimed else ["gain:x", "payload:x", "wind:x"])
    text = [f["text"] for f in on_simplicity([{"id": "lag:x"}], [outcome])]
    assert text == ([] if claimed else [text[0]])
    assert claimed or text[0].startswith(
        "lag:x is named since it needs the fewest numbers: gain:x, payload:x and wind:x"
    )
