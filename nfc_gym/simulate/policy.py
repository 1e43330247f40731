"""Policies whose motion is mixed in: a perceptron, a TorchScript file, an npz of weights, or any callable."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError, MissingExtra
from nfc_gym.envs.rotations import yaw
from nfc_gym.envs.simulations import Simulations
from nfc_gym.simulate.machine import Machine
from nfc_gym.terrain.egocentric import Cells

Act = Callable[[NDArray[np.float32]], Any]  # observations (n, proprio + goal) -> actions (n, action_size)
_BENDS: dict[str, Callable[[NDArray], NDArray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
}


@dataclass(frozen=True, eq=False)
class Perceptron:
    """A policy as plain arrays, which any process can be sent; `adaptation.Policy.perceptron` makes one of a policy.

    Attributes:
      weights: (out, in) of each layer.
      biases: (out,) of each layer.
      mean, std: (in,) by which observations are brought to scale.
      activation: between layers: tanh, relu or elu.
      clip: standard deviations beyond which observations are cut.
      squash: tanh of the last layer too.
      cells: of the elevation map, which come last in the observation; None sees none.
      name: what errors call it.
    """

    weights: tuple[NDArray, ...]
    biases: tuple[NDArray, ...]
    mean: NDArray | float = 0.0
    std: NDArray | float = 1.0
    activation: str = "tanh"
    clip: float = np.inf
    squash: bool = False
    cells: Cells | None = None
    name: str = "of plain arrays"

    def __call__(self, obs: NDArray[np.float32]) -> NDArray:
        """Observations (n, in) -> actions (n, out)."""
        if obs.shape[-1] != self.weights[0].shape[1]:
            raise InputError(f"it takes {self.weights[0].shape[1]} numbers and not {obs.shape[-1]}")
        x = np.clip((obs - self.mean) / self.std, -self.clip, self.clip)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = x @ weight.T + bias
            x = _BENDS[self.activation](x) if i < len(self.weights) - 1 else x
        return np.tanh(x) if self.squash else x

    @property
    def digest(self) -> str:
        """What tells it from another."""
        found = hashlib.sha256(repr((self.activation, self.clip, self.squash, self.cells)).encode())
        for array in (*self.weights, *self.biases, self.mean, self.std):
            found.update(np.ascontiguousarray(array).tobytes())
        return found.hexdigest()[:16]


class Policy:
    """What moves some of the windows.

    Args:
      source: a callable (a `Perceptron`, or any other), or the path of a TorchScript file (.pt) or of an npz with
        `weight_0` (out, in), `bias_0`, `weight_1`, ..., perhaps `mean` and `std` of the observation, and `activation`:
        tanh (by default), relu or elu. It is given what the environment observes with `context=()`, and after that the
        `cells` of the elevation map that it names, if any.
      machine: the robot; one call shows whether the policy is for it.

    Attributes:
      observation: size of what it is given.

    Raises:
      InputError: no such file, not a policy, or one of other sizes.
    """

    def __init__(self, source: Act | str | Path, machine: Machine) -> None:
        self.call = opened(source)
        self.cells: Cells | None = getattr(self.call, "cells", None)
        kind, name = machine.kind, getattr(self.call, "name", source)
        self.size, self.has_goal = kind.action_size, bool(kind.goal_size)
        if self.cells is not None and not machine.rough:
            raise InputError(f"policy {name}: looks at elevation, and {machine.environment} is flat ground")
        seen = 0 if self.cells is None else int(np.prod(self.cells.shape))
        self.observation = kind.proprio_size + kind.goal_size + seen
        probe = np.zeros((2, self.observation), np.float32)
        try:
            out = np.asarray(self.call(probe))
        except Exception as e:
            raise InputError(
                f"policy {name}: fails on observations of {machine.environment} with context=(), "
                f"shape {probe.shape} ({type(e).__name__}: {e})"
            ) from None
        if out.shape != (2, self.size):
            raise InputError(f"policy {name}: gives {out.shape} for {probe.shape}, want (2, {self.size})")

    def act(self, sims: Simulations, rows: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(k, action_size) for some simulations."""
        robot, view = sims.robot, sims.view
        parts = [*robot.proprio(view), *([robot.goal(view)] if self.has_goal else [])]
        obs = np.concatenate(parts, -1)[rows].astype(np.float32)
        if self.cells is not None:
            maps = [sims.perceived[k] for k in sims.chosen[rows]]
            base = np.nan_to_num(view.qpos[rows])
            seen = self.cells.around(maps, base[:, :3], yaw(base[:, 3:7]))
            obs = np.concatenate([obs, seen.reshape(len(seen), -1)], -1)
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


def _perceptron(path: Path) -> Perceptron:
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
    layers = range(count)
    return Perceptron(
        tuple(held[f"weight_{i}"] for i in layers), tuple(held[f"bias_{i}"] for i in layers), held.get("mean", 0.0),
        held.get("std", 1.0), name, name=str(path),
    )  # fmt: skip
