"""The parts of a mapping file, one pydantic model each; `nfc_gym.measured.mapping` puts them together."""

import re
from typing import Annotated, Any, Literal, Self, cast

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from nfc_gym.core import units
from nfc_gym.measured.readers.streams import normal_name
from nfc_gym.measured.yaml_marks import suggest
from nfc_gym.physics.parameters import Parameter

# fmt: off
FAMILIES = (
    "coulomb", "stribeck", "load_friction", "directional_friction", "damping_poly", "armature", "spring_offset",
    "hysteresis", "backlash", "cogging", "gain", "loss", "command_gain", "offset", "lag", "delay", "dead_zone",
    "saturation", "torque_speed", "supply_sag", "thermal", "payload", "com_shift", "inertia", "drag_linear",
    "drag_quadratic", "wind", "gust", "ground_effect", "rotor_drag", "external_force", "slope", "slip",
    "friction_patch", "compliance", "sinkage", "sensor_bias", "sensor_gain", "sensor_delay", "misalignment",
)
# fmt: on
_AXES = {"x": 0, "y": 1, "z": 2}
_TIMES = ("s", "ms", "us", "ns")
_TIMES_SAID = f"{', '.join(_TIMES[:-1])} or {_TIMES[-1]}"


def _unit(value: object) -> str:
    text = str(value)
    if not units.known(text):
        raise PydanticCustomError(
            "unit", "unknown unit; {advice}", {"advice": suggest(units.spelt(text), units.UNITS, most=len(units.UNITS))}
        )
    return text


def _one_or_more(value: object) -> object:
    return [value] if isinstance(value, str | int | float) and not isinstance(value, bool) else value


def _time_unit(value: object) -> str:
    if str(value) not in _TIMES:
        raise PydanticCustomError("unit", "time is in {times}", {"times": _TIMES_SAID})
    return str(value)


Unit = Annotated[str, BeforeValidator(_unit)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Names = Annotated[tuple[str, ...], BeforeValidator(_one_or_more)]


class Strict(BaseModel):
    """A part of the mapping; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Columns(Strict):
    """Something read from one or more columns; `column: x` is short for `columns: [x]`."""

    columns: tuple[str, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _column_or_columns(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        data = dict(data)
        if "column" in data and "columns" in data:
            raise PydanticCustomError("both", "has both `column` and `columns`; keep one")
        one = isinstance(data.get("columns"), str)
        if "column" in data or one:
            data["columns"] = [data.pop("columns" if one else "column")]
        return data

    @field_validator("columns")
    @classmethod
    def _names(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            if re.fullmatch(r"[-+]?\d+(\.\d*)?([eE][-+]?\d+)?", name):
                raise PydanticCustomError("literal", "'{name}' is a number, not a column; use `scale`", {"name": name})
        value = tuple(map(normal_name, value))
        twice = [name for name in value if value.count(name) > 1]
        if twice:
            raise PydanticCustomError("twice", "column '{name}' appears twice", {"name": twice[0]})
        return value


class _Signal(_Columns):
    columns: tuple[str, ...] = Field(min_length=1)


class TimeColumn(_Columns):
    """Where the time is: a column; or, of logs that have no clock, the `interval` in s from one row to the next.

    `gaps` says what becomes of a log with a pause in it: it is refused, or cut there into logs of their own.
    """

    unit: Annotated[str, BeforeValidator(_time_unit)] = "s"
    interval: Positive | None = None
    gaps: Literal["refuse", "cut"] = "refuse"

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.interval is not None and self.gaps == "cut":
            raise PydanticCustomError("time", "rows `interval` apart have no gaps; leave out `gaps`")
        if self.interval is not None and self.columns:
            raise PydanticCustomError("both", "has both `column` and `interval`; keep one")
        if self.interval is not None and self.unit != "s":
            raise PydanticCustomError("time", "`interval` is in s; leave out `unit`")
        if self.interval is None and len(self.columns) != 1:
            text = "time is one column, in {times}; or `interval`, the seconds from row to row"
            raise PydanticCustomError("time", text, {"times": _TIMES_SAID})
        return self


class Term(_Columns):
    """A factor of a servo's law: the product of columns times `scale`; a bare number is a constant."""

    scale: Finite = 1.0

    @model_validator(mode="before")
    @classmethod
    def _number(cls, data: object) -> object:
        return {"scale": data} if isinstance(data, int | float) and not isinstance(data, bool) else data


class Servo(Strict):
    """A firmware servo: ctrl = supply clip(gain (goal - q) - damping v, -limit, limit) at every physics step."""

    joint: str
    gain: Term
    limit: Annotated[float, Field(gt=0)] = float("inf")
    supply: Term = Term()
    damping: Term = Term(scale=0.0)


class Control(_Signal):
    """A command: one column, held between samples as `hold` says."""

    columns: tuple[str, ...] = Field(min_length=1, max_length=1)
    unit: Unit
    hold: Literal["zero", "linear"] = "zero"
    servo: Servo | None = None


class Exogenous(_Signal):
    """A measured signal that drives effects: one column."""

    columns: tuple[str, ...] = Field(min_length=1, max_length=1)
    unit: Unit


class Measured(_Signal):
    """A measured channel; see `nfc_gym.core.Channel` for what becomes of it."""

    unit: Unit | None = None
    noise: Positive | None = None
    rate: Positive | None = None
    order: Literal["wxyz", "xyzw"] | None = None
    axes: tuple[Literal["x", "y", "z"] | Annotated[int, Field(ge=0)], ...] | None = None
    smooth: Annotated[int, Field(ge=1)] = 1
    mask: Annotated[str, AfterValidator(normal_name)] | None = None
    shift: Finite = 0.0  # s by which its stamps are late: a sample stamped t was taken at t - shift

    @property
    def axis_indices(self) -> tuple[int, ...] | None:
        """`axes` as component indices."""
        return None if self.axes is None else tuple(_AXES[a] if isinstance(a, str) else a for a in self.axes)


class Known(_Columns):
    """Model fields that the log itself gives: columns' product times scale plus offset, converted from `unit`."""

    field: str
    of: Names = ()
    columns: tuple[str, ...] = Field(min_length=1)
    scale: Finite = 1.0
    offset: Finite = 0.0
    unit: Unit = "1"


class ParameterEntry(Strict):
    """One line of the declared psi; see `nfc_gym.physics.parameters.Parameter`."""

    name: str
    field: str
    of: Names = ()
    unit: Annotated[str, BeforeValidator(str)] = "1"
    nominal: Finite | None = None
    low: Finite
    high: Finite
    anchored: bool = False
    tied: bool = False
    reason: str = ""

    @model_validator(mode="after")
    def _bounds(self) -> Self:
        if not self.low < self.high:
            raise PydanticCustomError(
                "bounds", "low {low} must be below high {high}", {"low": self.low, "high": self.high}
            )
        if self.nominal is not None and not self.low <= self.nominal <= self.high:
            text = "nominal {nominal} lies outside [{low}, {high}]"
            raise PydanticCustomError("bounds", text, {"nominal": self.nominal, "low": self.low, "high": self.high})
        if units.known(self.unit) and units.si_unit(self.unit) != self.unit and self.unit != "Nm":
            raise PydanticCustomError(
                "unit",
                "parameters are in the model's own SI units: give the values in {si} and say `unit: {si}`, not {unit}",
                {"si": units.si_unit(self.unit), "unit": self.unit},
            )
        return self

    def expand(self) -> tuple[Parameter, ...]:
        """One parameter, or without `tied` one for each object, named `<name>:<object>`."""

        def one(name: str, of: tuple[str, ...]) -> Parameter:
            rest = {"unit": self.unit, "low": self.low, "high": self.high, "nominal": self.nominal}
            return Parameter(
                name, self.field, of, anchored=self.anchored, reason=self.reason, **cast(dict[str, Any], rest)
            )

        if self.tied or len(self.of) <= 1:
            return (one(self.name, self.of),)
        return tuple(one(f"{self.name}:{target}", (target,)) for target in self.of)


class LogEntry(Strict):
    """Log files: a path or glob beside the mapping, and which split they belong to."""

    path: str
    split: Literal["fit", "select", "verify", "auto"] = "auto"
    group: str | None = None
    condition: str | None = None
    splits: str | None = None

    @field_validator("group", "condition")
    @classmethod
    def _regex(cls, value: str | None) -> str | None:
        try:
            groups = re.compile(value).groups if value is not None else 1
        except re.error as e:
            raise PydanticCustomError("regex", "not a regular expression: {why}", {"why": str(e)}) from None
        if groups < 1:
            raise PydanticCustomError("regex", "needs one (group) in round brackets, which gives the name")
        return value

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.splits is not None and self.split != "auto":
            raise PydanticCustomError("both", "has both `split` and `splits`; keep one")
        return self


class SplitRule(Strict):
    """How logs whose split is `auto` are divided."""

    by: Literal["log", "group", "time", "rotate"] = "log"
    fit: Annotated[float, Field(gt=0, le=1)] = 0.6
    select: Annotated[float, Field(ge=0, lt=1)] = 0.2
    verify: Annotated[float, Field(ge=0, lt=1)] = 0.2
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _sum(self) -> Self:
        total = self.fit + self.select + self.verify
        if abs(total - 1) > 1e-6:
            raise PydanticCustomError("sum", "fit + select + verify must be 1, got {total}", {"total": round(total, 6)})
        return self


class Segments(Strict):
    """What is predicted and compared, in seconds."""

    mode: Literal["rollout", "inverse", "forward"] = "rollout"
    length: Positive = 0.4
    history: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.5
    horizons: tuple[Positive, ...] = ()
    timestep: Positive | None = None
    start: Literal["measured", "settled"] = "measured"

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.horizons:  # an eighth, a quarter, a half and all of the segment
            object.__setattr__(self, "horizons", tuple(self.length * f for f in (0.125, 0.25, 0.5, 1.0)))
        if list(self.horizons) != sorted(set(self.horizons)):
            raise PydanticCustomError("order", "horizons must increase, got {got}", {"got": list(self.horizons)})
        if self.horizons[-1] > self.length * (1 + 1e-9):
            text = "the longest horizon {got} s is longer than the segment, {length} s"
            raise PydanticCustomError("order", text, {"got": self.horizons[-1], "length": self.length})
        if self.timestep is not None and self.timestep > self.horizons[0]:
            text = "timestep {got} s is longer than the shortest horizon, {length} s"
            raise PydanticCustomError("order", text, {"got": self.timestep, "length": self.horizons[0]})
        return self


class EffectChoice(Strict):
    """Families of effects to leave out, or the only ones to consider."""

    exclude: Names = ()
    only: Names = ()

    @field_validator("exclude", "only")
    @classmethod
    def _families(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            if name not in FAMILIES:
                advice = suggest(name, FAMILIES, most=len(FAMILIES))
                raise PydanticCustomError("family", "no family '{name}'; {advice}", {"name": name, "advice": advice})
        return value
