"""Elevation maps rebuilt from seeds and poses."""

from pathlib import Path

import numpy as np
import safetensors.numpy

from nfc_gym.envs.look import look
from nfc_gym.inference.windows import Windows
from nfc_gym.simulate import simulate
from nfc_gym.simulate.ground import made
from nfc_gym.simulate.maps import keep_maps, maps
from nfc_gym.simulate.run import manifest_of
from nfc_gym.simulate.shard import Plan, make_shard


def rough(effects: float = 0.0) -> tuple:
    plan = Plan(manifest_of("nfc_gym/JackalRough-v0", 4, 0, 4, {}), effects=effects)
    return plan.manifest, safetensors.numpy.load(make_shard(plan, 0))


def test_the_true_map_is_the_one_that_the_environment_shows() -> None:
    manifest, windows = rough()
    found = maps(manifest, windows)
    for i in range(4):
        kind, seed = manifest.terrain_kinds[windows["terrain_kind"][i]], int(windows["terrain_seed"][i])
        field = made(kind, seed, float(windows["terrain_difficulty"][i]), manifest.terrain_scale)
        np.testing.assert_allclose(found.true[i], look(windows["pose"][i, -1].astype(float), field), atol=1e-6)
        # The base stands on what is below it: axles of wheels with a radius of 0.098 m.
        assert -0.35 < found.true[i][62:66, 62:66].mean() < -0.05


def test_the_perceived_map_is_seen_ahead_with_an_error_of_centimetres() -> None:
    manifest, windows = rough()
    first, second = maps(manifest, windows), maps(manifest, windows)
    np.testing.assert_array_equal(first.perceived, second.perceived)
    assert 0.02 < first.valid.mean() < 0.6
    assert first.valid[:, 66:100].sum() > 3 * first.valid[:, 28:62].sum()
    error = first.delta_e[first.valid]
    assert 0.002 < np.abs(error).mean() < 0.08
    louder = maps(manifest, windows | {"camera_level": np.full(4, 4.0, np.float32)})
    assert np.abs(louder.delta_e[louder.valid]).mean() > np.abs(error).mean()


def test_kept_maps_are_read_with_the_windows(tmp_path: Path) -> None:
    windows = simulate("nfc_gym/JackalRough-v0", 3, tmp_path, per_shard=2, jobs=1, effects=0)
    assert "map" not in windows.names
    keep_maps(tmp_path, jobs=1)
    again = Windows(tmp_path)
    rebuilt = maps(windows.manifest, windows[:])
    assert again[:]["map"].dtype == np.float32
    np.testing.assert_array_equal(again[:]["map"], rebuilt.perceived.astype(np.float16))
    np.testing.assert_array_equal(again[2]["delta_e"], rebuilt.delta_e[2].astype(np.float16))


def test_a_plane_is_level(jackal: dict[str, np.ndarray]) -> None:
    manifest = manifest_of("nfc_gym/JackalFlat-v0", 8, 0, 8, {})
    found = maps(manifest, {k: v[:2] for k, v in jackal.items()})
    np.testing.assert_allclose(found.true, -jackal["pose"][:2, -1, 2, None, None] + np.zeros((2, 128, 128)), atol=1e-6)
