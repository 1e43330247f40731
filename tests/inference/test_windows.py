"""The format on disk: what is written is read back, and what is broken is said so."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.inference.data import StoredWindows
from nfc_gym.inference.shards import maps_path
from nfc_gym.inference.windows import Manifest, Windows, WindowWriter, packed, shard_path

MANIFEST = Manifest(
    environment="nfc_gym/ToyFlat-v0", robot="toy", rough=False, psi_names=("mass", "drag"), psi_units=("kg", "1"),
    psi_low=(1.0, 0.0), psi_high=(2.0, 1.0), horizon=4, dt=0.02, state_names=("x", "v", "obs"), action_names=("push",),
    state_noise=(0.1, 0.0, 0.0), families=("none", "payload"), effects=({"family": "payload"},),
    terrain_kinds=("rough",), terrain_scale=1.0, seed=0, windows=25, per_shard=10,
)  # fmt: skip


def arrays(manifest: Manifest, shard: int) -> dict[str, np.ndarray]:
    """Windows that say which they are: every number of window i is i, or i modulo something."""
    n = manifest.size(shard)
    row = np.arange(shard * manifest.per_shard, shard * manifest.per_shard + n)
    out = {}
    for name, shape in manifest.shapes().items():
        kind = np.float64 if name == "start" else np.float32
        kind = np.int64 if name.endswith("seed") else np.int16 if name in ("family", "effect", "terrain_kind") else kind
        full = (n, *(3 if k is None else k for k in shape))
        out[name] = np.broadcast_to(row.reshape(n, *(1,) * len(shape)), full).astype(kind)
    return out


def written(folder: Path, shards: tuple[int, ...] = (0, 1, 2), manifest: Manifest = MANIFEST) -> Path:
    writer = WindowWriter(folder, manifest)
    for k in shards:
        writer.add(k, packed(manifest, arrays(manifest, k), {"windows": manifest.size(k), "unstable": k}))
    return folder


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    found = Windows(written(tmp_path))
    assert len(found) == 25
    assert found.manifest.complete
    assert found.manifest.finished[1] == {"windows": 10, "unstable": 1}
    np.testing.assert_array_equal(found[13]["psi"], [13, 13])
    rows = np.array([24, 0, 9, 10, 9])
    for name, value in found[rows].items():
        assert value.dtype == arrays(MANIFEST, 0)[name].dtype
        np.testing.assert_array_equal(value.reshape(5, -1)[:, 0], rows, err_msg=name)
    np.testing.assert_array_equal(found[-3:]["family"], [22, 23, 24])
    assert set(found.take(rows, ("psi", "states"))) == {"psi", "states"}


def test_the_same_windows_are_the_same_bytes() -> None:
    counts = {"windows": 10, "unstable": 3, "ended": 1, "relabelled": 0}
    assert len({packed(MANIFEST, arrays(MANIFEST, 0), counts) for _ in range(5)}) == 1


def test_a_pass_meets_every_window_once_in_an_order_of_its_seed(tmp_path: Path) -> None:
    found = Windows(written(tmp_path))
    batches = found.batches(8, seed=1, names=("psi",))
    first, second = (np.concatenate([b["psi"][:, 0] for b in batches]) for _ in range(2))
    assert len(batches) == 4
    assert sorted(first) == sorted(second) == list(range(25))
    assert first.tolist() != second.tolist()
    again = np.concatenate([b["psi"][:, 0] for b in found.batches(8, seed=1, names=("psi",))])
    assert again.tolist() == first.tolist()
    some = found.batches(8, rows=np.array([3, 20, 21]))
    assert sorted(np.concatenate([b["family"] for b in some])) == [3, 20, 21]
    assert some.manifest.robot == "toy"


def test_noise_is_of_the_size_that_the_manifest_says_and_new_in_each_pass(tmp_path: Path) -> None:
    found = Windows(written(tmp_path))
    batches = found.batches(25, seed=0)
    passes = [next(iter(batches)) for _ in range(40)]
    errors = np.stack([b["states"] - b["psi"][:, :1, None] for b in passes])
    assert not errors[..., 1:].any()
    assert errors[..., 0].std() == pytest.approx(0.1, rel=0.05)
    clean = next(iter(found.batches(25, noise=0)))
    np.testing.assert_array_equal(clean["states"][:, 0, 0], clean["psi"][:, 0])


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    written(tmp_path, (0, 2))
    (tmp_path / f".{shard_path(tmp_path, 1).name}.part").write_bytes(b"half")
    writer = WindowWriter(tmp_path, MANIFEST)
    assert writer.missing == [1]
    assert len(Windows(tmp_path)) == 15
    assert Windows(tmp_path)[10]["family"] == 20
    # A shard that was put in place right before the end counts, though the manifest did not hear of it.
    text = json.loads((tmp_path / "manifest.json").read_text())
    (tmp_path / "manifest.json").write_text(json.dumps({**text, "finished": {}}))
    assert WindowWriter(tmp_path, MANIFEST).missing == [1]


def test_rounds_are_read_as_one(tmp_path: Path) -> None:
    """The second folder's windows follow the first's; folders of another kind are refused."""
    first, second = written(tmp_path / "a"), written(tmp_path / "b", (0,), replace(MANIFEST, seed=1))
    both = Windows(first, second, robot="toy")
    assert len(both) == 35
    np.testing.assert_array_equal(both[np.array([0, 24, 25, 34])]["family"], [0, 24, 0, 9])
    assert sum(len(b["psi"]) for b in both.batches(8)) == 35
    other = written(tmp_path / "c", (0,), replace(MANIFEST, psi_high=(3.0, 1.0)))
    with pytest.raises(InputError, match="another psi_high than the first folder"):
        Windows(first, other)
    noisier = written(tmp_path / "d", (0,), replace(MANIFEST, state_noise=tuple(2 * sd for sd in MANIFEST.state_noise)))
    with pytest.raises(InputError, match="another state_noise than the first folder"):
        Windows(first, noisier)


def test_training_tells_the_second_folder_from_others(tmp_path: Path) -> None:
    """By its seed and settings, as the first: else a state of other windows would be gone on from."""
    first = written(tmp_path / "a", (0,))
    seconds = [written(tmp_path / str(k), (0,), replace(MANIFEST, seed=k)) for k in (1, 2)]
    told = [StoredWindows(Windows(first, second)).told for second in seconds]
    assert [t.pop("the windows' seed in folder 2") for t in told] == [1, 2]
    assert told[0] == told[1]
    alone = StoredWindows(Windows(first)).told
    assert alone == {k: told[0][k] for k in alone}


def test_another_set_is_not_mixed_in(tmp_path: Path) -> None:
    written(tmp_path, (0,))
    with pytest.raises(InputError, match=r"made otherwise \(seed 0, now 1\)"):
        WindowWriter(tmp_path, replace(MANIFEST, seed=1))
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(InputError, match=r"shards without a manifest\.json"):
        WindowWriter(tmp_path, MANIFEST)
    shard_path(tmp_path, 0).rename(maps_path(tmp_path, 0))
    with pytest.raises(InputError, match=r"elevation maps without a manifest\.json"):
        WindowWriter(tmp_path, MANIFEST)


def test_what_cannot_be_read_is_said_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no manifest\.json"):
        Windows(tmp_path)
    written(tmp_path)
    with pytest.raises(InputError, match="of the robot 'toy', want 'jackal'"):
        Windows(tmp_path, robot="jackal")
    with pytest.raises(InputError, match="the parameters are mass, drag; want mass"):
        Windows(tmp_path, psi_names=("mass",))
    with pytest.raises(InputError, match="no array 'maps'; there are"):
        Windows(tmp_path).take(np.arange(2), ("maps",))
    path = shard_path(tmp_path, 1)
    whole = path.read_bytes()
    for broken in (whole[:-5], whole[:20], b"", b"x" * 100):
        path.write_bytes(broken)
        with pytest.raises(InputError, match=r"shard_00001.* truncated, or no shard"):
            Windows(tmp_path)
    assert WindowWriter(tmp_path, MANIFEST).missing == [1]
    path.unlink()
    (tmp_path / "manifest.json").write_text(replace(MANIFEST, finished={0: {}, 1: {}}).text())
    with pytest.raises(InputError, match=r"shard_00001.* missing"):
        Windows(tmp_path)
    (tmp_path / "manifest.json").write_text(replace(MANIFEST, format=2).text())
    with pytest.raises(InputError, match="format 2, and this version of nfc_gym reads format 1"):
        Windows(tmp_path)
    (tmp_path / "manifest.json").write_text('{"format": 1}')
    with pytest.raises(InputError, match=r"psi_names.* missing or unknown"):
        Windows(tmp_path)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(InputError, match="cannot be read"):
        Windows(tmp_path)


def test_windows_that_do_not_exist_are_told_by_their_index(tmp_path: Path) -> None:
    windows = Windows(written(tmp_path))
    for odd in (len(windows), -1):
        with pytest.raises(InputError, match=f"there is no window {odd}; the indices are 0 to {len(windows) - 1}"):
            windows.take(np.array([0, odd]))
    assert len(windows.take(np.zeros(0, int))["psi"]) == 0


def test_numbers_that_are_not_finite_never_leave(tmp_path: Path) -> None:
    bad = arrays(MANIFEST, 0)
    bad["states"][4, 1, 2] = np.nan
    with pytest.raises(InputError, match="states of window 4 is not finite"):
        packed(MANIFEST, bad, {})
    written(tmp_path)
    path = shard_path(tmp_path, 0)
    whole = bytearray(path.read_bytes())
    at = whole.index(arrays(MANIFEST, 0)["states"].tobytes())
    whole[at : at + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(whole)
    with pytest.raises(InputError, match="states of window 0 is not finite"):
        Windows(tmp_path)[:3]
    with pytest.raises(InputError, match="states of window 0 is not finite"):  # wherever it stands in a batch
        Windows(tmp_path)[[2, 1, 0]]


def test_short_windows_and_missing_arrays_are_refused() -> None:
    short = {k: v[:, :3] if k == "states" else v for k, v in arrays(MANIFEST, 0).items()}
    with pytest.raises(InputError, match="windows shorter than 5 rows"):
        packed(MANIFEST, short, {})
    with pytest.raises(InputError, match=r"a shard holds .*; want"):
        packed(MANIFEST, {k: v for k, v in arrays(MANIFEST, 0).items() if k != "psi"}, {})
