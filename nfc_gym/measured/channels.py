"""Channel names: `joint:<name>:pos`, `body:<name>:quat@body`, `sensor:<name>`, `force:<actuator>`, taken apart."""

import re
from dataclasses import dataclass

from nfc_gym.core import InputError

# what a quantity may be measured in, after conversion to SI; sensors take any unit
_UNITS: dict[tuple[str, str], tuple[str, ...]] = {
    ("joint", "pos"): ("rad", "m"),
    ("joint", "vel"): ("rad/s", "m/s"),
    ("joint", "acc"): ("rad/s^2", "m/s^2"),
    ("body", "pos"): ("m",),
    ("body", "quat"): ("1",),
    ("body", "linvel"): ("m/s",),
    ("body", "angvel"): ("rad/s",),
    ("force", ""): ("N", "N m"),
}
_WIDTH = {("body", "pos"): 3, ("body", "quat"): 4, ("body", "linvel"): 3, ("body", "angvel"): 3}
_FORMS = (
    re.compile(r"^(?P<kind>joint):(?P<object>.+):(?P<quantity>pos|vel|acc)$"),
    re.compile(r"^(?P<kind>body):(?P<object>.+):(?P<quantity>pos|quat|linvel|angvel)(?P<own>@body)?$"),
    re.compile(r"^(?P<kind>sensor|force):(?P<object>.+)$"),
)
GRAMMAR = (
    "joint:<name>:pos|vel|acc, body:<name>:pos|quat|linvel|angvel (world frame; with @body after it, the body's own), "
    "sensor:<name>, force:<actuator>"
)


@dataclass(frozen=True)
class ChannelName:
    """A channel's name, taken apart.

    Attributes:
      kind: joint, body, sensor or force.
      object: a name of the model: of a joint, a body, a sensor or an actuator.
      quantity: pos, vel, acc, quat, linvel, angvel; empty for sensors and forces.
      own_frame: a body's quantity is in the body's own frame rather than the world's.
    """

    kind: str
    object: str
    quantity: str = ""
    own_frame: bool = False

    @property
    def units(self) -> tuple[str, ...]:
        """SI units that the quantity may have; empty where any will do."""
        return _UNITS.get((self.kind, self.quantity), ())

    @property
    def width(self) -> int | None:
        """Components of one sample of a body's quantity; None where the model decides (joints, sensors)."""
        return _WIDTH.get((self.kind, self.quantity))


def parse_channel(name: str) -> ChannelName:
    """Take a channel's name apart; one that does not follow the grammar raises `InputError` stating it."""
    for form in _FORMS:
        match = form.fullmatch(name)
        if match:
            parts = match.groupdict()
            return ChannelName(parts["kind"], parts["object"], parts.get("quantity") or "", bool(parts.get("own")))
    if name.startswith("ctrl:"):
        raise InputError(f"{name!r} is a command: it belongs under `controls`")
    if name.startswith("exo:"):
        raise InputError(f"{name!r} is an exogenous signal: it belongs under `exogenous`")
    raise InputError(f"{name!r} is no channel name; valid: {GRAMMAR}")
