"""The programs of docs/inference.md run as they stand, on the processor and for one epoch."""

import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from problems import motion_windows

import nfc_gym  # noqa: F401 (registers the environments)
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.trials import trials

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "inference.md").read_text(encoding="utf-8")


def test_train_then_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    programs = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    assert len(programs) == 4
    monkeypatch.chdir(tmp_path)
    t = motion_windows(60).tensors
    env = gymnasium.make("nfc_gym/JackalFlat-v0", context=["psi"])
    names: dict[str, Any] = {"env": env, "states": t["states"], "actions": t["actions"], "u": torch.rand(60, 17)}
    exec(programs[0].replace('"cuda"', '"cpu"').replace("TrainConfig()", "TrainConfig(epochs=1)"), names)
    exec(programs[1].replace("sample(100", "sample(10"), names)
    assert names["outcome"].stopped == "epochs"
    assert names["psi"].shape == (10, 17)
    assert np.isfinite(names["told"]).all()
    machine = Machine("nfc_gym/JackalFlat-v0")
    nominal = trials(machine, np.tile(machine.space.nominal, (12, 1)), 0)
    names |= {"nominal_states": nominal["states"], "nominal_actions": nominal["actions"]}
    exec(programs[2].replace("given)", "given, draws=4)").replace("rate=0.01", "rate=0.25"), names)
    names["env"].reset(seed=0)
    names |= {f"other_{k}": nominal[k][:10] for k in ("states", "actions")}
    few = programs[3].replace("given)", "given, draws=2)").replace("rate=0.01", "rate=0.25")
    exec(few.replace("other_actions)", "other_actions, rate=0.1)"), names)
    assert names["detector"].threshold is not None
    assert {p.name for p in tmp_path.iterdir()} == {"run", "jackal_posterior.safetensors", "today.safetensors"}
    env.close()
