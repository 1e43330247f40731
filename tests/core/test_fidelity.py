"""`Fidelity`, the sources that it comes from, and files that are whole."""

from pathlib import Path

import numpy as np
import pytest

from nfc_gym.core import Fidelity, InputError, Posterior, Sampler, load_source, register_loader
from nfc_gym.core.files import replacing, write_whole


def test_rows_samples_and_files(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    many = Fidelity(psi=rng.normal(size=(5, 3)), delta_e=rng.normal(size=(5, 4, 4)))
    assert (len(many), many.given, many.batched) == (5, ("psi", "delta_e"), True)
    one = many[2]
    assert not one.batched
    assert one.psi is not None
    assert one.psi.shape == (3,)
    many.save(tmp_path / "f.npz")
    again = load_source(tmp_path / "f.npz")
    assert isinstance(again, Fidelity)
    np.testing.assert_array_equal(again.psi, many.psi)
    drawn = many.sample(200, np.random.default_rng(1))
    assert len(drawn) == 200
    assert drawn.psi is not None
    rows = {tuple(r) for r in drawn.psi}
    assert rows == {tuple(r) for r in many.psi}  # type: ignore[union-attr]
    # parts of one sample stay together
    at = [int(np.flatnonzero((many.psi == p).all(1))[0]) for p in drawn.psi]
    np.testing.assert_array_equal(drawn.delta_e, many.delta_e[at])  # type: ignore[index]
    assert len(one.sample(3, rng)) == 3


def test_what_is_no_fidelity_is_refused() -> None:
    with pytest.raises(InputError, match="different numbers"):
        Fidelity(psi=np.zeros((2, 3)), delta_s=np.zeros((4, 5)))
    with pytest.raises(InputError, match=r"delta_e must have 2 or 3 axes"):
        Fidelity(delta_e=np.zeros(4))
    for wrong in ("heavy", [[1.0], [1.0, 2.0]], np.ones(2, complex), [True, False]):
        with pytest.raises(InputError, match=r"psi is .*, want an array of numbers"):
            Fidelity(psi=wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="nan"):
        Fidelity(psi=np.array([1.0, np.nan]))


def test_sources_are_opened_by_suffix(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no loader for \.bin; there are: .*\.npz"):
        load_source(tmp_path / "x.bin")
    with pytest.raises(InputError, match="no such file"):
        load_source(tmp_path / "x.npz")
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04 half")
    with pytest.raises(InputError, match="truncated"):
        load_source(tmp_path / "x.npz")
    np.savez(tmp_path / "y.npz", other=np.zeros(3))
    with pytest.raises(InputError, match="other"):
        load_source(tmp_path / "y.npz")
    np.savez(tmp_path / "z.npz", psi=np.array([object()]))
    with pytest.raises(InputError, match="plain arrays"):
        load_source(tmp_path / "z.npz")
    register_loader(".BIN", lambda path: Fidelity(psi=np.ones(2)))
    (tmp_path / "x.bin").touch()
    assert load_source(tmp_path / "x.bin").sample(2, np.random.default_rng(0)).psi.shape == (2, 2)  # type: ignore[union-attr]


def test_the_protocols_tell_posteriors_from_samples() -> None:
    class Known:
        def sample(self, n, rng): ...

        def log_prob(self, x): ...

    assert isinstance(Known(), Posterior)
    assert isinstance(Fidelity(psi=np.zeros(2)), Sampler)
    assert not isinstance(Fidelity(psi=np.zeros(2)), Posterior)
    assert not isinstance(np.zeros(2), Sampler)


def test_files_are_whole_or_as_before(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_whole(path, "first")

    def half() -> None:
        with replacing(path) as part:
            part.write_text("half")
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        half()
    assert path.read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    write_whole(path, "second")
    assert path.read_text() == "second"


def test_a_file_may_be_read_by_whom_the_users_mask_says(tmp_path: Path) -> None:
    """Whatever the permissions that the library which writes it gives to its files."""
    plain, path = tmp_path / "plain.txt", tmp_path / "a.txt"
    plain.write_text("")
    with replacing(path) as part:
        part.unlink()
        part.write_text("private")
        part.chmod(0o600)
    assert path.stat().st_mode == plain.stat().st_mode


def test_two_may_replace_a_file_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with replacing(path) as outer:
        outer.write_text("outer")
        write_whole(path, "inner")
    assert path.read_text() == "outer"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
