"""Policies whose motion is mixed in: a TorchScript file, an npz of a perceptron's weights, or any callable."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError, MissingExtra
from nfc_gym.envs.simulations import Simulations
from nfc_gym.simulate.machine import Machine

Act = Callable[[NDArray[np.float32]], Any]  # observations (n, proprio + goal) -> actions (n, action_size)
_BENDS: dict[str, Callable[[NDArray], NDArray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
}


class Policy:
    """What moves some of the windows.

    Args:
      source: a callable, or the path of a TorchScript file (.pt) or of an npz with `weight_0` (out, in), `bias_0`,
        `weight_1`, ..., perhaps `mean` and `std` of the observation, and `activation`: tanh (by default), relu or elu.
        It is given what the environment observes with `context=()`.
      machine: the robot; one call shows whether the policy is for it.

    Raises:
      InputError: no such file, not a policy, or one of other sizes.
    """

    def __init__(self, source: Act | str | Path, machine: Machine) -> None:
        self.call = opened(source)
        kind = machine.kind
        self.size, self.has_goal = kind.action_size, bool(kind.goal_size)
        probe = np.zeros((2, kind.proprio_size + kind.goal_size), np.float32)
        try:
            out = np.asarray(self.call(probe))
        except Exception as e:
            raise InputError(
                f"policy {source}: fails on observations of {machine.environment} with context=(), "
                f"shape {probe.shape} ({type(e).__name__}: {e})"
            ) from None
        if out.shape != (2, self.size):
            raise InputError(f"policy {source}: gives {out.shape} for {probe.shape}, want (2, {self.size})")

    def act(self, sims: Simulations, rows: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(k, action_size) for some simulations."""
        robot, view = sims.robot, sims.view
        parts = [*robot.proprio(view), *([robot.goal(view)] if self.has_goal else [])]
        obs = np.concatenate(parts, -1)[rows].astype(np.float32)
        return np.nan_to_num(np.asarray(self.call(obs), np.float64))


def opened(source: Act | str | Path) -> Act:
    """A policy as a callable."""
    if callable(source):
        return source
    path = Path(source)
    if not path.is_file():
        raise InputError(f"policy {path}: no such file; want a TorchScript file (.pt) or an npz of weights")
    if path.suffix == ".npz":
        return _perceptron(path)
    try:
        import torch
    except ImportError:
        raise MissingExtra(f"policy {path}: TorchScript needs torch: pip install 'nfc_gym[inference]'") from None
    try:
        module = torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, ValueError) as e:
        raise InputError(f"policy {path}: no TorchScript file ({str(e).splitlines()[0]})") from None

    def act(obs: NDArray[np.float32]) -> NDArray:
        # Sums over several threads round otherwise than over one.
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            with torch.no_grad():
                return module(torch.from_numpy(obs)).numpy()
        finally:
            torch.set_num_threads(threads)

    return act


def _perceptron(path: Path) -> Act:
    try:
        with np.load(path, allow_pickle=False) as file:
            held = {k: file[k] for k in file.files}
    except (ValueError, OSError, EOFError, BadZipFile) as e:
        raise InputError(f"policy {path}: truncated, or no npz of plain arrays ({e})") from None
    count = sum(k.startswith("weight_") for k in held)
    lacking = [k for i in range(count) for k in (f"weight_{i}", f"bias_{i}") if k not in held]
    name = str(held.get("activation", "tanh"))
    if not count or lacking or name not in _BENDS:
        raise InputError(
            f"policy {path}: holds {', '.join(held)}; want weight_0, bias_0, weight_1, ... and perhaps mean, std, "
            f"activation ({', '.join(_BENDS)})"
        )
    bend = _BENDS[name]

    def act(obs: NDArray[np.float32]) -> NDArray:
        x = (obs - held.get("mean", 0)) / held.get("std", 1)
        for i in range(count):
            x = x @ held[f"weight_{i}"].T + held[f"bias_{i}"]
            x = bend(x) if i < count - 1 else x
        return x

    return act
