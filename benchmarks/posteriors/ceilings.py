"""The Fisher ceiling of an environment's windows, computed once into DIR."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from nfc_gym.inference.windows import Windows
from nfc_gym.simulate.ceiling import CLOUD, PAIRS, ceiling
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.starts import spread
from posteriors.judge import groups
from posteriors.keep import write
from posteriors.metrics import mean


def ceiling_of(
    out: Path, env: str, judges: Windows, count: int, jobs: int, cloud: int = CLOUD, pairs: int = PAIRS
) -> dict[str, Any]:  # fmt: skip
    """Joint gain a parameter, and the mean of single parameters' gains by group, over the first windows without effect.

    Each window is kept as it is done, so that a command that was killed goes on; windows that come apart under a step
    of psi are left out and counted.
    """
    name = env.removeprefix("nfc_gym/").removesuffix("-v0")
    folder = out / "ceilings" / f"{name}_{cloud}_{pairs}_start"
    folder.mkdir(parents=True, exist_ok=True)
    family = judges.take(np.arange(len(judges)), ("family",))["family"]
    before = spread(Machine(env), judges.take(np.arange(len(judges)), ("start",)))
    joint, own = [], []
    for row in np.flatnonzero(family == 0)[:count]:
        file = folder / f"{row}.json"
        if not file.is_file():
            found = ceiling(env, judges.take(np.array([row])), cloud=cloud, pairs=pairs, nthread=jobs, before=before)
            write(file, {"joint": float(found.joint[0]), "gain": found.gain[0].tolist()})
        kept = json.loads(file.read_text())
        joint.append(kept["joint"])
        own.append(kept["gain"])
    each, whole = np.array(own), np.array(joint)
    fine = np.isfinite(whole) & np.isfinite(each).all(1)
    names = judges.manifest.psi_names
    return {
        "windows": int(fine.sum()),
        "apart": int((~fine).sum()),
        "cloud": cloud,
        "pairs": pairs,
        "joint": mean(whole[fine] / len(names)),
        "groups": {g: mean(each[fine][:, at].mean(1)) for g, at in groups(names).items()},
    }
