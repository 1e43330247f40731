"""The figures of benchmarks/posterior_table.py against closed forms: known normals, maps and curves."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

torch = pytest.importorskip("torch", reason="the posteriors that are judged are nfc_gym.inference's")


def normals(rng: np.random.Generator, windows: int, n: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Draws in u and truths of a right posterior: z = x + spread e, x known, so the posterior of z is normal."""
    middle = rng.standard_normal((windows, 3)) * math.sqrt(1 - spread**2)
    draws = middle[:, None] + spread * rng.standard_normal((windows, n, 3))
    return ndtr(draws), ndtr(middle + spread * rng.standard_normal((windows, 3)))


def test_the_gain_of_a_known_normal_is_the_log_of_how_much_narrower_it_is() -> None:
    from posteriors import metrics

    draws, truth = normals(np.random.default_rng(0), 3000, 200, 0.2)
    found = metrics.mean(metrics.marginal_gain(draws, truth).mean(1))
    # E[log N(z; m, s) - log N(z; 0, 1)] = -log s, as z is N(0, 1) in all; 1 / n is lost to fitting from draws
    assert found.value == pytest.approx(-math.log(0.2), abs=4 * found.error + 0.01)


def test_the_prior_gains_nothing() -> None:
    from posteriors import metrics

    draws, truth = normals(np.random.default_rng(1), 2000, 200, 1.0)
    found = metrics.mean(metrics.marginal_gain(draws, truth).mean(1))
    assert abs(found.value) < 4 * found.error + 0.01


def test_density_changes_with_the_coordinates() -> None:
    from posteriors.fitted import gain_of, truth_of

    z = truth_of(torch.tensor([[0.1, 0.6], [0.5, 0.9]], dtype=torch.float64))
    prior = torch.distributions.Normal(0, 1).log_prob(z).sum(-1)
    assert gain_of(z, prior).numpy() == pytest.approx(np.zeros(2), abs=1e-12)
    narrow = torch.distributions.Normal(z, torch.full_like(z, 0.1)).log_prob(z).sum(-1)
    assert (gain_of(z, narrow) - gain_of(z, prior)).numpy() == pytest.approx((narrow - prior).numpy())


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95])
@pytest.mark.parametrize("spread", [0.3, 1.0])
def test_right_posteriors_are_covered_as_often_as_they_say(level: float, spread: float) -> None:
    from posteriors import metrics

    draws, truth = normals(np.random.default_rng(2), 3000, 128, spread)
    found = metrics.mean(metrics.coverage(draws, truth, level))
    assert found.value == pytest.approx(round(level * 65) / 65, abs=4 * found.error)


def test_too_narrow_posteriors_are_not() -> None:
    from posteriors import metrics

    draws, truth = normals(np.random.default_rng(3), 500, 128, 0.5)
    narrow = draws.mean(1, keepdims=True) + (draws - draws.mean(1, keepdims=True)) / 2
    assert metrics.coverage(narrow, truth, 0.9).mean() < 0.75


def test_an_interval_holds_a_truth_at_the_edge_of_the_box() -> None:
    from posteriors import metrics

    draws = np.random.default_rng(4).exponential(0.02, (50, 400, 1)).clip(1e-6, 1)
    low, high = metrics.intervals(draws, 0.9)
    assert (low == 0).mean() > 0.8
    # 90 % of an exponential lies below log(10) of its means
    assert np.median(high) == pytest.approx(0.02 * math.log(10), rel=0.2)


def test_ranks_and_random_points_show_what_is_wrong() -> None:
    from posteriors import metrics
    from posteriors.judge import critical

    rng = np.random.default_rng(5)
    draws, truth = normals(rng, 800, 100, 0.5)
    right = [metrics.farthest(metrics.ranks(draws, truth)[:, 0]), metrics.farthest(metrics.tarp(draws, truth, rng))]
    wide = np.clip(0.5 + (draws - 0.5) * 0.3, 0, 1)
    assert max(right) < critical(800, 20)
    assert metrics.farthest(metrics.ranks(wide, truth)[:, 0]) > 2 * critical(800)
    shifted = ndtr(np.sqrt(2) * (draws - 0.5))
    assert metrics.farthest(metrics.tarp(shifted, truth, rng)) > critical(800)


def test_the_energy_score_of_a_normal_is_its_closed_form() -> None:
    from posteriors import metrics

    rng = np.random.default_rng(6)
    truth = np.array([[0.0], [1.5]]).repeat(200, 0)
    score = metrics.energy_score(rng.standard_normal((400, 300, 1)), truth).reshape(2, 200)
    for values, y in zip(score, (0.0, 1.5), strict=True):
        bell = math.exp(-y * y / 2) / math.sqrt(2 * math.pi)
        exact = y * (2 * ndtr(y) - 1) + 2 * bell - 1 / math.sqrt(math.pi)  # Gneiting et al. 2005, for one dimension
        found = metrics.mean(values)
        assert found.value == pytest.approx(exact, abs=4 * found.error)


def test_a_normal_like_draws_has_their_mean_and_covariance() -> None:
    from posteriors import metrics

    rng = np.random.default_rng(7)
    draws = rng.exponential(size=(1, 40, 3)) @ np.array([[1, 0.5, 0], [0, 1, 0.2], [0, 0, 2.0]])
    like = metrics.normal_like(draws, 100_000, rng)[0]
    assert like.mean(0) == pytest.approx(draws[0].mean(0), abs=0.05)
    assert np.cov(like.T) == pytest.approx(np.cov(draws[0].T), rel=0.1, abs=0.05)


def test_the_variogram_score_sees_correlations() -> None:
    from posteriors import metrics

    rng = np.random.default_rng(8)
    smooth = rng.standard_normal((30, 41, 1, 1)) * np.ones((32, 32))
    rough = rng.standard_normal((30, 40, 32, 32))
    truth = smooth[:, 0]
    assert metrics.variogram_score(smooth[:, 1:], truth) == pytest.approx(np.zeros(30))
    # E sqrt|x - x'| of two N(0, 1) is 2^(1/2) Gamma(3/4) / sqrt(pi)
    wanted = (math.sqrt(2) * math.gamma(0.75) / math.sqrt(math.pi)) ** 2
    assert metrics.variogram_score(rough, truth).mean() == pytest.approx(wanted, rel=0.05)


def test_a_wave_is_in_its_octave_and_white_noise_in_all_alike() -> None:
    from posteriors import metrics

    wave = np.sin(2 * np.pi * 11 * np.arange(128) / 128) * np.ones((128, 1))
    power = metrics.spectrum(wave)
    assert power.argmax() == 3  # 8 to 16 waves
    white = metrics.spectrum(np.random.default_rng(9).standard_normal((200, 128, 128))).mean(0)
    assert white[1:] == pytest.approx(np.full(5, white[-1]), rel=0.1)


def test_the_area_counts_ties_half() -> None:
    from posteriors import metrics

    assert metrics.area(np.array([1.0, 2, 2, 3]), np.array([False, True, False, True])) == pytest.approx(3.5 / 4)


def test_what_is_finished_is_kept_and_what_is_missing_tried_again(tmp_path: Path) -> None:
    from posteriors.keep import Kept

    from nfc_gym.core import InputError

    kept = Kept(tmp_path, {"windows": 10})
    assert kept.once("a", lambda: {"gain": [1.0, 0.1]}) == kept.once("a", lambda: pytest.fail("made twice"))
    kept.once("b", lambda: {"missing": "sbi"})
    assert kept.once("b", lambda: {"gain": [2.0, 0.1]}) == {"gain": [2.0, 0.1]}
    assert json.loads((tmp_path / "cells" / "b.json").read_text())["gain"][0] == 2
    kept.once("c", lambda: {"gain": [3.0, 0.1]}, trained_on=100)
    with pytest.raises(InputError, match="of trained_on 100, not 200"):
        kept.once("c", lambda: pytest.fail("made anew"), trained_on=200)
    with pytest.raises(InputError, match="windows 10, not 20"):
        Kept(tmp_path, {"windows": 20})


def test_the_tables_print_what_there_is() -> None:
    from posteriors import report

    one = {"gain": [0.3, 0.01], "gain_without_effect": [0.4, 0.02], "log_posterior": [-1.0, 0.1], "gains":
           [0.2, 0.3, 0.4], "marginal":
           {"mass": [0.1, 0.01]}, "coverage": {k: [float(k), 0.01] for k in ("0.5", "0.9", "0.95")}, "width":
           [0.5, 0.1], "ranks": 0.02, "tarp": 0.03, "distance_95": 0.04, "epochs": 5, "best": 4, "seconds": 9.0,
           "latency_ms": 12.0, "trained_on": 100}  # fmt: skip
    less = one | {"gain": [0.1, 0.01], "gains": [0.0, 0.1, 0.2]}
    ceiling = {"windows": 3, "apart": 0, "cloud": 8, "pairs": 2, "joint": [0.8, 0.1], "groups": {"mass": [0.2, 0.1]}}
    text = report.table({
        "JackalFlat_sde-tcn_window_0": one, "JackalFlat_mdn-rff_window_0": less, "JackalFlat_ceiling": ceiling,
        "JackalFlat_sbi-npe_window_0": {"missing": "sbi is not installed"},
        "JackalFlat_residuals_waves": {"delta_e: variogram score": [0.125, 0.00042]},
    })  # fmt: skip
    assert "0.50" in text  # efficiency: 0.4 of 0.8
    assert "+0.200 ± 0.000" in text  # window by window
    assert "sbi is not installed" in text
    assert "-1.00 ± 0.10 / 1.21" in text  # beside the paper's
    assert "| JackalFlat_residuals_waves | delta_e: variogram score | 0.1250 ± 0.0004 |" in text


def test_all_pictures_of_the_ground_show_the_left_on_the_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    from posteriors import plots

    shown = {}
    monkeypatch.setattr(plots, "maps_of", lambda *_: np.random.default_rng(0).normal(size=(24, 128, 128)))
    monkeypatch.setattr(plots, "_saved", lambda figure, file: shown.setdefault(file.name, figure))
    one = {k: torch.zeros(1, 128, 128) for k in ("map", "delta_e")}
    plots.ground(tmp_path, "JackalRough", None, one)
    assert set(shown) == {"JackalRough_ground.png", "JackalRough_delta_e.png"}
    for figure, panels in zip(shown.values(), (3, 6), strict=True):
        images = [a for a in figure.axes if a.get_title()]
        assert [a.xaxis_inverted() for a in images] == [True] * panels
        plots.plt.close(figure)


def test_noise_is_drawn_anew_with_each_pass_and_the_same_for_a_seed() -> None:
    from posteriors.sets import Held

    states = torch.zeros(40, 3, 2)
    held = Held(
        {"states": states, "actions": torch.zeros(40, 2, 1), "psi": torch.rand(40, 1)}, torch.tensor([0.5, 0.0])
    )
    first, again, other = (torch.cat([b["states"] for b in held.batches(16, s)]) for s in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert (first[..., 1] == 0).all()
    assert float(first[..., 0].std()) == pytest.approx(0.5, rel=0.2)
    train, judge = held.split(0.25)
    assert (len(train), len(judge)) == (30, 10)


def test_refined_windows_are_judged_beside_the_first_round(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a posterior that is known: N(0, 0.5^2) in each parameter's probit coordinate."""
    from posteriors import cases
    from posteriors.sets import environment, prior_of

    from nfc_gym.inference.config import NetworkConfig
    from nfc_gym.inference.normal import Normal, NormalPosterior
    from nfc_gym.inference.posterior import NeuralPosterior, Window
    from nfc_gym.inference.random import mixed
    from nfc_gym.inference.train import TrainConfig

    env, training, device = environment("Jackal", "Flat"), TrainConfig(epochs=1, batch=32), torch.device("cpu")
    prior, asked, truth = prior_of(env), dict[str, Any](), list[np.ndarray]()

    def refined(posterior: NeuralPosterior, window: Window, **how: object) -> NormalPosterior:
        posterior.given(window)  # or it is refused
        asked.update(how)
        return NormalPosterior(prior, Normal(np.zeros(17), 0.25 * np.eye(17)))

    def ceiling(env: str, window: dict[str, np.ndarray], **how: object) -> SimpleNamespace:
        truth.append(ndtri(window["psi"][0]))
        return SimpleNamespace(joint=np.array([34.0]))

    quick = NetworkConfig("nn", "mixture", width=16, features=16, hidden=16, components=1)
    monkeypatch.setattr(cases, "network_config", lambda *_: quick)
    monkeypatch.setattr(cases, "refined", refined)
    monkeypatch.setattr(cases, "ceiling", ceiling)
    cases.before(env, prior, 40, training, True, 1, device, tmp_path)
    found = [cases.rounds(env, k, 40, training, ["refined"], 1, device, tmp_path) for k in (3, 4)]
    assert {k: asked[k] for k in ("environment", "simulations", "seed", "jobs")} == {
        "environment": env, "simulations": 40, "seed": mixed(4, 2), "jobs": 1,
    }  # fmt: skip
    for one, z in zip(found, truth, strict=True):
        assert one["refined"] == pytest.approx(-math.log(0.5) - ((z / 0.5) ** 2 - z**2).mean() / 2, abs=1e-6)
        assert one["ceiling"] == 2
        edge = 1.645 * 0.5
        sure = np.abs(np.abs(z) - edge) > 0.1  # ends of intervals are those of draws
        low, high = ((np.abs(z) < edge) & sure).mean(), ((np.abs(z) < edge) | ~sure).mean()
        assert low <= one["held (refined)"] <= high
        assert one["width (refined)"] == pytest.approx(2 * ndtr(edge) - 1, abs=0.02)
        assert set(one) == {"one", "first", "refined", "held (refined)", "width (refined)", "ceiling"}
    told = cases.summed(found)
    assert told["the first round, refined"].value == pytest.approx(np.mean([f["refined"] for f in found]))
    assert told["... less one (refined)"].value == pytest.approx(np.mean([f["refined"] - f["one"] for f in found]))
    assert told["what these windows tell at most, gain a parameter"].value == 2


def test_one_window_begins_with_a_trained_posterior(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An untrained one here, whose own gain is told beside; it is named where its folder lacks it."""
    import one_window
    from posteriors.sets import environment, prior_of

    from nfc_gym.core import InputError
    from nfc_gym.inference.config import NetworkConfig, Sizes
    from nfc_gym.inference.encoders.place import place_of
    from nfc_gym.inference.network import Network
    from nfc_gym.inference.normal import Normal, NormalPosterior
    from nfc_gym.inference.posterior import NeuralPosterior, Window
    from nfc_gym.simulate.machine import Machine

    env = environment("Quadcopter", "Flat")
    prior, machine, begun = prior_of(env), Machine(env), list[object]()
    sizes = Sizes(
        machine.habit.horizon, machine.kind.proprio_size, machine.kind.action_size, place=place_of(machine.state_names)
    )
    quick = NetworkConfig("nn", "mixture", width=16, features=16, hidden=16, components=1)

    def refined(posterior: object, window: Window, **how: object) -> NormalPosterior:
        begun.append(posterior)
        return NormalPosterior(prior, Normal.prior(prior.size))

    monkeypatch.setattr(one_window, "refined", refined)
    monkeypatch.setattr(one_window, "before", lambda *_: None)
    monkeypatch.setattr(one_window, "ceiling", lambda *_, **__: SimpleNamespace(joint=np.array([9.0])))
    command = ["--robots", "Quadcopter", "--windows", "1", "--jobs", "1", "--seed", "3"]
    table = tmp_path / "rows.json"
    with pytest.raises(InputError, match=r"QuadcopterFlat\.safetensors"):
        one_window.main([*command, "--out", str(tmp_path / "a"), "--posteriors", str(tmp_path)])
    NeuralPosterior(Network(quick, sizes, prior)).save(tmp_path / "QuadcopterFlat.safetensors")
    for out, more in (("b", ["--posteriors", str(tmp_path)]), ("c", [])):
        assert one_window.main([*command, "--out", str(tmp_path / out), "--json", str(table), *more]) == 0
        row = json.loads(table.read_text())["rows"][0]
        assert isinstance(begun[-1], NeuralPosterior) == ("trained" in row) == bool(more)
        assert row["gain"] == pytest.approx(0, abs=1e-9)
        if more:
            assert math.isfinite(row["trained"])


@pytest.mark.parametrize("method", ["sde-nn", "mdn-rff"])
def test_each_method_has_the_seconds_of_the_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    import importlib

    from posteriors.fit import Plan, fit
    from posteriors.sets import Held

    from nfc_gym.inference.progress import quiet
    from nfc_gym.inference.space import PriorBox

    chance, n = np.random.default_rng(0), 120  # of which nothing is to be learned: held-out losses rise at once
    sizes = {"states": (n, 6, 2), "actions": (n, 5, 1), "psi": (n, 2), "delta_s": (n, 2), "family": (n,)}
    tensors = {k: torch.as_tensor(chance.uniform(size=s), dtype=torch.float32) for k, s in sizes.items()}

    class Slow(Held):
        """Each step takes a quarter of a second, a whole one once others work too; the first ones more."""

        def batches(self, size: int, seed: int | None):  # type: ignore[no-untyped-def]
            for batch in super().batches(size, seed):
                clock[0] += 20 if len(steps) < 3 else 0.25 if len(steps) < 130 else 1
                steps.append(clock[0])
                yield batch

    clock, steps = [0.0], []
    monkeypatch.setattr(importlib.import_module("nfc_gym.inference.train"), "monotonic", lambda: clock[0])
    monkeypatch.setattr("posteriors.sets.Held", Slow)  # as `split` makes them
    windows = Slow(tensors, torch.zeros(2), ("qpos", "qvel"))
    prior = PriorBox("toy", ("a", "b"), ("1", "1"), (0.0, 0.0), (1.0, 1.0))
    plan = Plan(epochs=1000, budget=60.0, batch=64, rate=1e-3, draws=1, small=True)
    found = fit(method, "window", windows, prior, plan, 0, tmp_path, torch.device("cpu"), quiet)
    assert found.outcome.stopped == "budget"  # and not "patience"
    assert len(steps) > 140  # those of a fast start, which what is loaded first takes nothing of
    assert 60 <= found.outcome.seconds <= 62  # the held-out windows of the last epoch come on top
