"""The sensors that the robots' laws read, from what PyBullet knows of contacts and links."""

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Array

from .simulation import Simulation

SENSOR = mujoco.mjtSensor


class Senses:
    """Touch sensors, velocities of feet, and whether anything has hit the machine; all else stays 0.

    Args:
      model: whose `sensordata` is filled.

    A touch sensor feels what its site's body is pressed with, wherever on the body.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        def of(kind: mujoco.mjtSensor) -> list[int]:
            return [s for s in range(model.nsensor) if int(model.sensor_type[s]) == int(kind)]

        def bodies(sensors: list[int]) -> list[str]:
            return [model.body(model.site_bodyid[model.sensor_objid[s]]).name for s in sensors]

        touch, moving = of(SENSOR.mjSENS_TOUCH), of(SENSOR.mjSENS_FRAMELINVEL)
        self.touch, self.felt = model.sensor_adr[touch], bodies(touch)
        at_sites = [s for s in moving if int(model.sensor_objtype[s]) == int(mujoco.mjtObj.mjOBJ_SITE)]
        self.moving = list(zip(model.sensor_adr[at_sites].tolist(), bodies(at_sites), strict=True))
        self.hit = [int(model.sensor_adr[s]) for s in of(SENSOR.mjSENS_CONTACT)]
        self.all = [model.body(b).name for b in range(1, model.nbody)]

    def read(self, sim: Simulation, out: Array) -> None:
        """Into (nsensordata,)."""
        out[self.touch] = sim.touching(self.felt) if self.felt else 0.0
        for address, body in self.moving:
            out[address : address + 3] = sim.velocity(body)
        if self.hit:
            out[self.hit] = float(np.any(sim.touching(self.all) > 0))
