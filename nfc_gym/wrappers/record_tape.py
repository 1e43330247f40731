"""The samples of one running episode."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Tape:
    """A sample a control step: the state at its start, the command that was sent, and what the sensors showed of both.

    A sensor that feels forces shows the command too, so its reading belongs to the first physics step under it: it is
    taken after that step, where MuJoCo has it for the state before. The state that an episode ends in has no command
    and is not recorded.
    """

    def __init__(self) -> None:
        self.time: list[float] = []
        self.rows: dict[str, list[Array]] = {k: [] for k in ("qpos", "qvel", "ctrl", "sensordata")}

    def command(self, time: float, qpos: Array, qvel: Array, ctrl: Array) -> None:
        """The start of a control step; copies are taken."""
        self.time.append(float(time))
        self.rows["qpos"].append(qpos.copy())
        self.rows["qvel"].append(qvel.copy())
        self.rows["ctrl"].append(ctrl.copy())

    def sense(self, sensordata: Array) -> None:
        """The sensors of the sample begun last; a copy is taken."""
        self.rows["sensordata"].append(sensordata.copy())

    def __len__(self) -> int:
        return len(self.time)

    def record(self) -> dict[str, Array]:
        """`time` (T,), and `qpos`, `qvel`, `ctrl`, `sensordata`, (T, ...) each."""
        # A simulation that came apart never made its last reading.
        whole = len(self.rows["sensordata"]) or len(self.time)
        return {"time": np.array(self.time[:whole]), **{k: np.array(v[:whole]) for k, v in self.rows.items()}}
