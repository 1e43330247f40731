"""Figures of Tables II and III against closed forms, and the planner on ground made for it."""

import numpy as np
import pytest


def test_jerk_of_a_cubic_is_exact_and_of_a_slow_wave_nearly_so() -> None:
    from worlds import figures

    time = np.arange(200) * 0.02
    cubic = np.stack([time**3, 2 - time**2], 1)
    second = figures.smooth_second(cubic, 0.02)
    middle = time[12:-12]
    assert second == pytest.approx(np.stack([6 * middle, np.full_like(middle, -2.0)], 1), abs=1e-8)
    wave = np.sin(2 * np.pi * 0.5 * time)[:, None]
    assert figures.jerk(wave, 0.02) == pytest.approx(np.pi**2 * 2 / np.pi, rel=0.05)  # mean of |sin|: 2 / pi


def test_the_filter_halves_what_moves_at_its_corner() -> None:
    from worlds import figures

    time, rate = np.arange(2000) * 0.02, 2 * np.pi * 1.9
    wave = np.sin(rate * time)[:, None]
    assert figures.jerk(wave, 0.02) == pytest.approx(0.5 * rate**2 * 2 / np.pi, rel=0.03)


def test_the_filter_takes_out_what_sensors_add() -> None:
    from worlds import figures

    noise = 0.02 * np.random.default_rng(0).standard_normal((1000, 1))
    raw = np.abs(np.diff(noise, 2, axis=0)).mean() / 0.02**2
    assert figures.jerk(noise, 0.02) < raw / 100
    assert figures.jerk(noise[:10], 0.02) != figures.jerk(noise[:10], 0.02)  # too short: no figure


def test_gates_count_in_their_order_alone() -> None:
    from worlds.figures import gates_passed, way

    angle = np.linspace(0, 2 * np.pi, 400)
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    gates = circle[50::50]
    assert way(circle) == pytest.approx(2 * np.pi, rel=1e-3)
    assert gates_passed(circle, gates, 0.05)[0] == len(gates)
    assert gates_passed(circle[::-1], gates, 0.05)[0] < len(gates)
    assert gates_passed(circle[:220], gates, 0.05)[0] == 4


def test_normalised_returns_and_shares() -> None:
    from worlds import figures

    assert figures.normalised(np.array([10.0, 30.0, 20.0]), 10.0, 30.0) == pytest.approx([0, 1, 0.5])
    assert figures.recovered(0.9, 0.5, 1.0) == pytest.approx(0.8)
    found = figures.running_min_max([1.0, 3.0, 2.0, 5.0])
    assert np.isnan(found[0])
    assert found[1:] == pytest.approx([1.0, 0.5, 1.0])


def test_an_interval_over_seeds_holds_the_mean_about_as_often_as_it_says() -> None:
    from worlds.figures import bootstrap

    rng = np.random.default_rng(0)
    held = []
    for _ in range(150):
        groups = [rng.normal(rng.normal(0, 0.5), 1.0, 40) for _ in range(12)]
        interval = bootstrap(groups, rng)
        held.append(interval.low <= 0 <= interval.high)
    assert 0.85 <= np.mean(held) <= 0.99
    assert np.isnan(bootstrap([np.array([np.nan])], rng).value)


def test_arcs_are_arcs() -> None:
    from worlds.falco import Arcs

    arcs = Arcs(length=2.0)
    bent = arcs.curvature != 0
    radius = 1 / arcs.curvature[bent]
    centre = np.stack([np.zeros_like(radius), radius], 1)
    gaps = np.linalg.norm(arcs.points[bent] - centre[:, None], axis=-1)
    assert gaps == pytest.approx(np.broadcast_to(np.abs(radius)[:, None], gaps.shape))
    step = np.linalg.norm(np.diff(arcs.points, axis=1), axis=-1)
    assert (step <= 0.1 + 1e-9).all()


def test_the_planner_goes_round_what_it_cannot_climb() -> None:
    from worlds.falco import Falco

    planner = Falco()
    planner.begin(3)
    goal = np.tile([4.0, 0.0], (3, 1))
    ground = np.zeros((3, 128, 128))
    ground[1, 80:84, 61:100] = 0.5  # a wall ahead (rows go forward, columns to the left), open to the right
    ground[2, 80:84, 28:67] = 0.5  # and open to the left
    chosen = planner.arcs.curvature[planner.plan(goal, ground)]
    assert chosen[0] == 0
    assert chosen[1] < 0 < chosen[2]


def test_the_planner_drives_to_its_goals() -> None:
    from worlds.falco import Falco
    from worlds.judge import Uniform
    from worlds.players import play
    from worlds.world import World

    world = World("JackalFlat", "nominal", 0, noisy=False)
    driven, drunk = play(Falco(), world, 6, 0), play(Uniform(2, 0), world, 6, 0)
    assert np.mean(driven.success) == 1
    assert all(0.9 <= r < 1.5 for r in driven.ratio)  # it is there 0.3 m before the goal
    assert np.mean(drunk.success) < 0.5
    assert np.mean(driven.returns) > np.mean(drunk.returns) + 500


def cell(returns: list[float]) -> dict:
    n = len(returns)
    part = dict.fromkeys(("success", "ended", "ratio", "orientation_jerk", "position_jerk"), [1.0] * n)
    return {"episodes": {"returns": returns, **part, "steps": [10] * n}, "curve": [[0, returns[0]]], "notes": {}}


def test_the_tables_stand_between_their_references() -> None:
    pytest.importorskip("torch", reason="methods learn with torch")
    from worlds import tables

    cells = tables.Cells()
    for seed in (0, 1):
        key = ("II", "AntFlat", "psi+effect", 7, seed)
        for method, level in {"random": 0.0, "oracle": 200.0, "unadapted": 100.0, "no_nfc": 150.0}.items():
            cells.add(key, method, cell([level - 1, level + 1]))
        cells.add(key, "tdmpc2", {"missing": "needs a world model"})
    names = ["random", "oracle", "unadapted", "no_nfc", "tdmpc2"]
    text, rows = tables.table_two(cells, names, np.random.default_rng(0))
    own = [r for r in rows if r["name"].endswith(", normalised return")]
    values = {r["name"].split(": ")[1].split(",")[0]: r["value"] for r in own}
    assert values["random"] == pytest.approx(0)
    assert values["oracle"] == pytest.approx(1)
    assert values["PPO w/o NFC"] == pytest.approx(0.75)
    assert "needs a world model" in text
    assert "0.64" in text  # the paper's
    assert tables.recovered(cells, "AntFlat", "no_nfc") == {("AntFlat", "psi+effect", 7): pytest.approx(0.5)}
    cells.add(("II", "AntRough", "psi", 7, 0), "oracle", cell([100.0, 100.0]))
    for method, level in {"random": 0.0, "unadapted": 99.0, "no_nfc": 120.0}.items():
        cells.add(("II", "AntRough", "psi", 7, 0), method, cell([level, level]))
    assert not tables.recovered(cells, "AntRough", "no_nfc")  # an oracle that is none
    assert tables.min_max(cells, "AntFlat", "no_nfc") == pytest.approx(151 / 201)  # from -1, a curve's, to 200
    gain = tables.paired(cells, "AntFlat", "no_nfc", "unadapted", np.random.default_rng(0))
    assert gain.value == gain.low == gain.high == pytest.approx(0.25)


def test_a_share_is_of_its_own_world_and_the_median_over_all_worlds() -> None:
    pytest.importorskip("torch", reason="methods learn with torch")
    from worlds import tables

    cells = tables.Cells()
    for place, seed, level in (("AntFlat", 7, 180.0), ("AntFlat", 8, 110.0), ("AntRough", 7, 160.0)):
        for method, earned in {"random": 0.0, "oracle": 200.0, "unadapted": 100.0, "nfc": level}.items():
            cells.add(("II", place, "psi", seed, 0), method, cell([earned]))
    # a world in which nothing was lost: pooled with the other it would hide what was recovered there
    for method, earned in {"random": 0.0, "oracle": 10.0, "unadapted": 2000.0}.items():
        cells.add(("II", "AntFlat", "psi", 9, 0), method, cell([earned]))
    text, rows = tables.table_two(cells, ["random", "oracle", "unadapted", "nfc"], np.random.default_rng(0))
    assert tables.recovered(cells, "AntFlat", "nfc") == {
        ("AntFlat", "psi", 7): pytest.approx(0.8), ("AntFlat", "psi", 8): pytest.approx(0.1)
    }  # fmt: skip
    middle = next(r for r in rows if r["name"].startswith("share"))
    assert (middle["value"], middle["low"], middle["high"]) == pytest.approx((0.6, 0.1, 0.8))
    assert "psi 8: 0.10" in text
    assert "| 3 (3, 3) |" in text  # unadapted: cells, worlds, episodes
    assert "| 2 (2, 2) |" in text  # with NFC


def test_the_paper_s_figures_are_goals_of_nfc_alone() -> None:
    pytest.importorskip("torch", reason="methods learn with torch")
    from worlds import paper, tables

    cells = tables.Cells()
    for place, level in (("AntFlat", 199.0), ("JackalFlat", 160.0)):  # of 200: the paper's 0.98 and 0.87
        for method, earned in {"random": 0.0, "oracle": 200.0, "nfc": level}.items():
            cells.add(("II", place, "psi", 7, 0), method, cell([earned, earned]))
    _, rows = tables.table_two(cells, ["random", "oracle", "nfc"], np.random.default_rng(0))
    held = {r["name"]: (r["goal"], r["holds"]) for r in rows if r["goal"]}
    assert held == {
        "AntFlat: PPO w/ NFC, min-max": (">= 0.98", True),
        "JackalFlat: PPO w/ NFC, min-max": (">= 0.87", False),
        "places where min-max is at least the paper's": (">= 7", False),
    }
    cells.add(("III", "JackalRough", "axle", 7, 0), "nfc", cell([1.0, 2.0]))  # all figures are 1
    cells.add(("III", "JackalRough", "axle+mud", 7, 0), "nfc", cell([1.0, 2.0]))
    text, rows = tables.table_three(cells, ["nfc"], np.random.default_rng(0))
    assert [(r["goal"], r["holds"]) for r in rows] == [(">= 0.72", True), ("<= 2.1", True), ("<= 3.19", True),
                                                       ("<= 6.26", True)]  # fmt: skip
    assert paper.GOALS["orientation_jerk", "Flat"] == 2.98
    assert "| axle 1.00 (2), axle+mud 1.00 (2) |" in text


def test_alarms_are_counted_and_what_nfc_adds_needs_no_oracle() -> None:
    pytest.importorskip("torch", reason="methods learn with torch")
    from worlds import tables

    cells = tables.Cells()
    for seed, anomalies in ((0, 0), (1, 2)):
        notes = {"anomalies": anomalies, "history": [{}] * 5}
        key = ("II", "AntFlat", "nominal", 7, seed)
        cells.add(key, "unadapted", cell([100.0, 200.0]))
        cells.add(key, "nfc", cell([100.0, 200.0]) | {"notes": notes})
    text, _ = tables.table_two(cells, ["unadapted", "nfc"], np.random.default_rng(0))
    assert "- w/ NFC 2 of 10 trajectories were anomalous; in 1 of 2 cells none" in text
    assert "- w/ NFC minus PPO, unadapted, return: 0.0 [0.0, 0.0]" in text
    cells.add(("III", "JackalFlat", "axle", 7, 0), "nfc", cell([1.0]) | {"notes": {"anomalies": 1, "history": [{}]}})
    text, _ = tables.table_three(cells, ["nfc"], np.random.default_rng(0))
    assert "1 of 1 trajectories were anomalous; in 0 of 1 cells none" in text


def test_control_rates_stand_beside_the_paper_s() -> None:
    pytest.importorskip("torch", reason="methods learn with torch")
    from worlds import tables

    cells = tables.Cells()
    for table, place in (("II", "AntFlat"), ("III", "JackalFlat")):
        for seed, hertz in ((0, 11.0), (1, 13.0)):
            cells.add((table, place, "psi", 7, seed), "tdmpc2", cell([1.0, 2.0]) | {"hertz": hertz})
            cells.add((table, place, "psi", 7, seed), "oracle", cell([3.0, 4.0]))  # of before rates were measured
    for table in (tables.table_two, tables.table_three):
        text, rows = table(cells, ["tdmpc2", "oracle"], np.random.default_rng(0))
        assert "| 12 / 6 |" in text
        assert "| - / - |" in text
    rates = [r for r in rows if r["unit"] == "Hz"]
    assert [(r["value"], r["baseline"]) for r in rates] == [(12.0, 6.0)]


def test_laps_are_as_long_as_the_robots_have_them() -> None:
    from worlds.players import LAPS

    from nfc_gym.envs import jackal, quadcopter

    assert {"jackal": jackal.LAP, "quadcopter": quadcopter.LAP} == LAPS
