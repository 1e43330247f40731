"""The mapping file: which model, which parameters, which logs, and which column is what.

`load_mapping` reads it; every mistake in it is reported at once, with line, key, value and what would be valid.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import AfterValidator, BaseModel, Field, ValidationError, field_validator, model_validator
from pydantic_core import PydanticCustomError

from nfc_gym.core import InputError, units
from nfc_gym.measured.channels import ChannelName, parse_channel
from nfc_gym.measured.entries import (
    Control,
    EffectChoice,
    Exogenous,
    Known,
    LogEntry,
    Measured,
    ParameterEntry,
    Segments,
    SplitRule,
    Strict,
    TimeColumn,
)
from nfc_gym.measured.yaml_marks import Place, line_of, read_yaml, suggest
from nfc_gym.physics.parameters import Parameter

Split = Literal["fit", "select", "verify"]
SPLITS: tuple[Split, ...] = ("fit", "select", "verify")


def _begins(prefix: str) -> Callable[[str], str]:
    def validate(name: str) -> str:
        if not name.startswith(prefix) or name == prefix:
            raise PydanticCustomError("name", "names here begin with '{prefix}'", {"prefix": prefix})
        return name

    return validate


def _channel_name(name: str) -> str:
    try:
        parse_channel(name)
    except InputError as e:
        raise PydanticCustomError("channel", "{why}", {"why": str(e)}) from None
    return name


class Mapping(Strict):
    """A mapping file."""

    version: Literal[1]
    model_file: str = Field(alias="model")
    parameters: tuple[ParameterEntry, ...] = ()
    logs: tuple[LogEntry, ...] = Field(min_length=1)
    split: SplitRule = SplitRule()
    time: TimeColumn
    controls: dict[Annotated[str, AfterValidator(_begins("ctrl:"))], Control] = Field(default_factory=dict)
    known: tuple[Known, ...] = ()
    channels: dict[Annotated[str, AfterValidator(_channel_name)], Measured] = Field(min_length=1)
    exogenous: dict[Annotated[str, AfterValidator(_begins("exo:"))], Exogenous] = Field(default_factory=dict)
    segments: Segments = Segments()
    effects: EffectChoice = EffectChoice()

    @property
    def straight(self) -> frozenset[str]:
        """Commands that go straight from row to row; all others are held."""
        return frozenset(name for name, c in self.controls.items() if c.hold == "linear")

    @property
    def servo_laws(self) -> dict[str, tuple[str, float]]:
        """Joint and limit of the firmware servo of each command that has one."""
        return {name: (c.servo.joint, c.servo.limit) for name, c in self.controls.items() if c.servo is not None}

    @field_validator("channels")
    @classmethod
    def _channels(cls, value: dict[str, Measured]) -> dict[str, Measured]:
        for name, channel in value.items():
            try:
                _check_channel(parse_channel(name), channel)
            except InputError as e:
                raise PydanticCustomError("channel", "{why}", {"why": str(e), "key": name}) from None
        return value

    @model_validator(mode="after")
    def _unique(self) -> Self:
        names = [p.name for p in self.declared]
        for name in names:
            if names.count(name) > 1:
                raise PydanticCustomError("unique", "parameter '{name}' is declared twice", {"name": name})
        return self

    @property
    def declared(self) -> tuple[Parameter, ...]:
        """The declared psi, entries without `tied` expanded to one parameter an object."""
        return tuple(p for entry in self.parameters for p in entry.expand())


def _check_channel(name: ChannelName, channel: Measured) -> None:
    quaternion = name.quantity == "quat"
    if quaternion and channel.order is None:
        raise InputError("a quaternion's `order` must be said: wxyz (scalar first) or xyzw (scalar last)")
    if channel.order is not None and not quaternion:
        if name.kind != "sensor":  # whether the model's sensor is one, `check` knows
            raise InputError("`order` is for quaternions")
        if channel.axes is not None:
            raise InputError("`axes` is for vector sensors: of a quaternion all four columns are named")
        if units.si_unit(channel.unit or "1") != "1":
            raise InputError(f"unit {channel.unit!r} cannot be right: a quaternion has none")
    if channel.unit is None and channel.order is None:
        raise InputError(f"`unit` is missing; {' or '.join(name.units) or 'say 1 if it has none'}")
    si = units.si_unit(channel.unit or "1")
    if name.units and si not in name.units:
        raise InputError(
            f"unit {channel.unit!r} cannot be right; want {' or '.join(name.units)}, or what converts to it"
        )
    if channel.axes is not None and name.kind != "sensor":
        raise InputError("`axes` is for vector sensors")
    if channel.axis_indices is not None and len(set(channel.axis_indices)) != len(channel.axis_indices):
        raise InputError("`axes` names an axis twice")


def load_mapping(path: Path) -> Mapping:
    """Read and validate a mapping file.

    Raises:
      InputError: the file cannot be read, or holds mistakes: one line for each, with file, line and key.
    """
    data, lines = read_yaml(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: a mapping file has the keys version, model, logs, time, channels at least")
    try:
        return Mapping.model_validate(data)
    except ValidationError as e:
        raise InputError("\n".join(_report(path, lines, e.errors()))) from None


_MESSAGES = {
    "missing": "is missing",
    "finite_number": "must be a finite number",
    "dict_type": "must hold keys and values",
    "model_type": "must hold keys and values",
    "tuple_type": "must be a list",
    "too_short": "must not be empty",
}


def _report(path: Path, lines: dict[Place, int], errors: list[Any]) -> list[str]:
    """One line for each mistake, from the top of the file; a list that is empty for want of a valid item is none."""
    found: list[tuple[Place, Any]] = []
    for error in errors:
        key = (error["ctx"]["key"],) if "key" in error.get("ctx", {}) else ()
        found.append((tuple(k for k in error["loc"] if k != "[key]") + key, error))

    def follows(place: Place, error: Any) -> bool:
        return error["type"] == "too_short" and any(p[: len(place)] == place and p != place for p, _ in found)

    found = [(place, error) for place, error in found if not follows(place, error)]
    return [_line(path, lines, place, e) for place, e in sorted(found, key=lambda f: line_of(lines, f[0]))]


def _line(path: Path, lines: dict[Place, int], place: Place, error: Any) -> str:
    key = ".".join(str(k) for k in place) or "the file"
    at = f"{path}:{line_of(lines, place)}: {key}"
    if error["type"] == "extra_forbidden":
        return f"{at}: unknown key; {suggest(str(place[-1]), _keys_at(place[:-1]))}"
    message = _MESSAGES.get(error["type"], error["msg"][:1].lower() + error["msg"][1:])
    value = error["input"]
    shown = f" (got {value!r})" if isinstance(value, str | int | float) and error["type"] != "missing" else ""
    return f"{at}: {message}{shown}"


def _keys_at(place: Place) -> list[str]:
    """The keys that are valid at a place of the file."""
    model: type[BaseModel] = Mapping
    for step in place:
        for name, field in model.model_fields.items():
            if step in (name, field.alias):
                model = _model_in(field.annotation) or model
    keys = [field.alias or name for name, field in model.model_fields.items()]
    return ["column", *keys] if "columns" in keys else keys


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model class inside `tuple[X, ...]`, `dict[str, X]` or `X | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for a in get_args(annotation) if (found := _model_in(a))), None)
