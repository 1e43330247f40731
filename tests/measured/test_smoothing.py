"""Local polynomials reproduce what they can represent, say truly how noisy they are, and noise is read off a signal."""

from dataclasses import fields

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nfc_gym.core import Channel, Log
from nfc_gym.measured.smoothing import covered, estimate_noise, fresh_samples, local_polynomial, moving_average
from nfc_gym.measured.states import channel_noise, estimate_states
from nfc_gym.physics.state import quat_multiply, vector_to_quat

uneven = np.cumsum(np.random.default_rng(0).uniform(0.005, 0.015, 80))


@settings(max_examples=30)
@given(
    st.lists(st.floats(-3, 3), min_size=4, max_size=4),
    st.integers(5, 11),
    st.lists(st.floats(-0.02, 0.85), min_size=1, max_size=5),
)
def test_a_cubic_is_reproduced_with_its_derivatives(c: list[float], points: int, at: list[float]) -> None:
    """Anywhere: between samples, at both ends, a little beyond them, and with uneven steps."""
    cubic, times = np.polynomial.Polynomial(c), np.array(at)
    fit = local_polynomial(uneven, np.stack([cubic(uneven), 2 * cubic(uneven)], 1), times, points)
    for scale, column in ((1, 0), (2, 1)):
        np.testing.assert_allclose(fit.value[:, column], scale * cubic(times), atol=1e-8)
        np.testing.assert_allclose(fit.slope[:, column], scale * cubic.deriv()(times), atol=1e-6)
        np.testing.assert_allclose(fit.curvature[:, column], scale * cubic.deriv(2)(times), atol=1e-3)


def test_the_error_on_a_smooth_signal_is_of_fourth_order() -> None:
    def worst(step: float) -> float:
        t = np.arange(0, 1, step)
        at = np.linspace(0.3, 0.7, 37)
        return float(np.abs(local_polynomial(t, np.sin(5 * t)[:, None], at).slope[:, 0] - 5 * np.cos(5 * at)).max())

    # The slope of a cubic fit errs by step^3; half the step, an eighth of the error.
    assert 5 < worst(0.02) / worst(0.01) < 13


def test_samples_at_even_times_are_fitted_as_each_would_be_alone() -> None:
    """To the bit, though those whose neighbours are at the same distances share what is alike."""
    time, values = 0.01 * np.arange(60), np.random.default_rng(2).normal(size=(60, 2))
    whole = local_polynomial(time, values, time)
    for k in range(60):
        alone = local_polynomial(time, values, time[k : k + 1])
        for f in fields(alone):
            np.testing.assert_array_equal(getattr(whole, f.name)[k : k + 1], getattr(alone, f.name))


@pytest.mark.parametrize("points", [5, 7, 11])
def test_noise_gain_is_what_a_monte_carlo_finds(points: int) -> None:
    rng = np.random.default_rng(1)
    at = np.array([uneven[0], uneven[3], 0.31, uneven[40], uneven[-1]])  # the ends are the noisiest
    draws = rng.normal(size=(len(uneven), 20_000))
    fit = local_polynomial(uneven, draws, at, points)
    np.testing.assert_allclose(fit.value_gain, fit.value.std(1), rtol=0.03)
    np.testing.assert_allclose(fit.slope_gain, fit.slope.std(1), rtol=0.03)
    assert fit.value_gain[0] > fit.value_gain[3]
    np.testing.assert_allclose(fit.misfit, 1.0, rtol=0.03)


def test_short_signals_lower_the_degree() -> None:
    t = np.array([0.0, 0.1, 0.2])
    fit = local_polynomial(t, (3 * t + 1)[:, None], t)
    np.testing.assert_allclose(fit.slope[:, 0], 3, atol=1e-9)
    np.testing.assert_array_equal(fit.curvature, 0)
    two = local_polynomial(t[:2], np.array([[1.0], [2.0]]), t[:2])
    np.testing.assert_allclose(two.value[:, 0], 1.5)
    np.testing.assert_allclose(two.value_gain, np.sqrt(0.5))


@pytest.mark.parametrize("sd", [1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("columns", [1, 3])
def test_noise_is_estimated_on_a_smooth_signal(sd: float, columns: int) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(0, 20, 0.01)
    smooth = np.sin(2 * t)[:, None] * np.arange(1, columns + 1) + 0.1 * t[:, None] ** 2
    assert estimate_noise(smooth + sd * rng.normal(size=smooth.shape)) == pytest.approx(sd, rel=0.15)


def test_jumps_do_not_pass_for_noise() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(0, 20, 0.01)
    steps = np.floor(t) % 2 * 5.0
    assert estimate_noise(steps + 0.01 * rng.normal(size=len(t))) == pytest.approx(0.01, rel=0.15)


def test_a_quantised_signal_is_no_better_than_its_step() -> None:
    t = np.arange(0, 20, 0.01)
    step = 0.05
    assert estimate_noise(np.round(np.sin(t) / step) * step) >= 0.99 * step / np.sqrt(12)
    assert estimate_noise(np.zeros(100)) == 0
    assert estimate_noise(np.arange(5.0)) == 0  # too short to tell


def test_held_samples_are_recognised() -> None:
    t = np.arange(40) * 0.01
    held = np.repeat(np.random.default_rng(4).normal(size=8), 5)
    np.testing.assert_array_equal(fresh_samples(t, held, 20.0), np.arange(0, 40, 5))
    np.testing.assert_array_equal(fresh_samples(t, held, None), np.arange(40))
    np.testing.assert_array_equal(fresh_samples(t, np.zeros(40), 20.0), np.arange(40))  # nothing to go by


def test_noise_of_a_held_signal_is_that_of_its_fresh_samples() -> None:
    rng = np.random.default_rng(5)
    fresh = np.sin(np.arange(0, 100, 0.05)) + 0.02 * rng.normal(size=2000)
    held = np.repeat(fresh, 5)
    index = fresh_samples(np.arange(10_000) * 0.01, held, 20.0)
    assert estimate_noise(held[index]) == pytest.approx(0.02, rel=0.15)


@pytest.mark.parametrize("samples", [1, 5, 15])
def test_moving_average(samples: int) -> None:
    values = np.random.default_rng(6).normal(size=(60, 2))
    out = moving_average(values, samples)
    assert out.shape == values.shape
    half = samples // 2
    for k in (half, 30, 59 - half):
        np.testing.assert_allclose(out[k], values[k - half : k + half + 1].mean(0))
    np.testing.assert_allclose(moving_average(values[:, 0], samples), out[:, 0])


@pytest.mark.parametrize("samples", [1, 4, 9, 80])
def test_means_are_of_the_samples_that_there_are(samples: int) -> None:
    """At the ends, beside masked rows, and in windows longer than the signal."""
    rng = np.random.default_rng(7)
    values, mask = rng.normal(size=(60, 2)), rng.random((60, 2)) > 0.4
    found = moving_average(np.where(mask, values, np.nan), samples, mask)
    whole = moving_average(values, samples)
    share = covered(mask, samples)
    for k in range(60):
        at = slice(max(k - samples // 2, 0), k + (samples - 1) // 2 + 1)
        np.testing.assert_allclose(whole[k], values[at].mean(0))
        for c in range(2):
            kept = values[at, c][mask[at, c]]
            np.testing.assert_allclose(found[k, c], kept.mean() if len(kept) else 0.0, atol=1e-12)
            assert share[k, c] == len(kept) / samples


def test_the_noise_of_an_attitude_is_estimated_as_an_angle() -> None:
    rng, t = np.random.default_rng(0), 0.01 * np.arange(2000)
    turned = vector_to_quat(np.stack([0.3 * np.sin(t), 0.2 * np.cos(2 * t), 0.5 * t], 1))
    seen = quat_multiply(turned, vector_to_quat(0.01 * rng.standard_normal((len(t), 3))))
    log = Log("flight", t, {}, {"body:base:quat": Channel(seen)})
    assert channel_noise(log, "body:base:quat") == pytest.approx(0.01, rel=0.05)
    plain = Log("flight", t, {}, {"sensor:imu:quat_x": Channel(0.01 * rng.standard_normal(len(t)))})
    assert channel_noise(plain, "sensor:imu:quat_x") == pytest.approx(0.01, rel=0.1)  # a name, not an attitude


@pytest.mark.parametrize("raw", [False, True])
def test_masked_rows_are_no_measurements_of_a_state(raw: bool) -> None:
    text = """<mujoco><worldbody><body name="base"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    rng, t = np.random.default_rng(0), 0.01 * np.arange(400)
    place = np.stack([np.sin(t), np.cos(t), t], 1)
    turned = vector_to_quat(np.stack([0.2 * t, 0 * t, 0 * t], 1))
    valid = np.ones(400, bool)
    valid[[0, *range(100, 103), 250, 399]] = False
    held = np.maximum.accumulate(np.where(valid, np.arange(400), 1))  # as readers leave rows without a value
    channels = {
        "body:base:pos": Channel(place[held] + 1e-6 * rng.standard_normal((400, 3)), noise=1e-6, mask=valid),
        "body:base:quat": Channel(turned[held], noise=1e-6, mask=valid),
    }
    states = estimate_states(mujoco.MjModel.from_xml_string(text), Log("flight", t, {}, channels), raw=raw)
    np.testing.assert_allclose(states.qpos[:, :3], place, atol=2e-5)
    np.testing.assert_allclose(states.qpos[:, 3:], turned, atol=2e-5)
    np.testing.assert_allclose(states.qvel[:, 3], 0.2, atol=1e-3)
    assert states.qpos_sd[101, 0] > states.qpos_sd[60, 0]


@pytest.mark.parametrize("sd", [0.25, 0.5, 1.0, 2.0])
def test_noise_of_an_encoder_of_few_counts_is_read_between_them(sd: float) -> None:
    """Its differences are whole counts: their median alone is 13 % too low at a quarter of a count."""
    rng = np.random.default_rng(0)
    counts = np.round(500 * np.sin(np.arange(20_000) * 0.022) + sd * rng.normal(size=20_000))
    assert estimate_noise(0.00077 * counts) == pytest.approx(0.00077 * np.sqrt(sd**2 + 1 / 12), rel=0.05)
