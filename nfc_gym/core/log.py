"""`Log`: what was observed, simulated and measured alike (channels: `joint:<name>:pos`, `body:<name>:quat`, ...)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError

Array = NDArray[np.float64]
_LEAST = 1e-9  # s: no clock ticks faster, and differences of less underflow


@dataclass(frozen=True)
class Channel:
    """One measured quantity along a log.

    Attributes:
      values: (T,) or (T, k), SI units; quaternions scalar first.
      unit: the SI unit, for reports.
      noise: standard deviation of one sample in that unit, or None where it must be estimated.
      smooth: measurement and prediction are compared after a centred moving average of so many samples.
      mask: (T,) bool, where the channel is compared; None is everywhere.
      axes: which components of a vector sensor the columns are; None is all of them.
      rate: Hz at which the value is renewed where it is held between samples; None is every sample.
    """

    values: Array
    unit: str = "1"
    noise: float | None = None
    smooth: int = 1
    mask: NDArray[np.bool_] | None = None
    axes: tuple[int, ...] | None = None
    rate: float | None = None


@dataclass(frozen=True)
class Inputs:
    """What drove a robot along a stretch of time: of a log all but its measurements.

    Attributes:
      time: (T,) s, strictly increasing; below 0 before the log itself begins.
      controls, exogenous, known, servo: as of a `Log`.
    """

    time: Array
    controls: Mapping[str, Array]
    exogenous: Mapping[str, Array]
    known: Mapping[str, Array]
    servo: Mapping[str, Mapping[str, Array]]

    def first(self, count: int, zero: float) -> "Inputs":
        """The first rows, at times that are counted from `zero`, s."""
        cut = lambda rows: {k: v[:count] for k, v in rows.items()}  # noqa: E731
        servo = {k: cut(terms) for k, terms in self.servo.items()}
        return Inputs(self.time[:count] - zero, cut(self.controls), cut(self.exogenous), cut(self.known), servo)

    def then(self, later: "Inputs") -> "Inputs":
        """These rows and later ones, which hold the same keys."""
        join = lambda a, b: {k: np.concatenate([a[k], v]) for k, v in b.items()}  # noqa: E731
        return Inputs(
            np.concatenate([self.time, later.time]),
            join(self.controls, later.controls),
            join(self.exogenous, later.exogenous),
            join(self.known, later.known),
            {k: join(self.servo[k], terms) for k, terms in later.servo.items()},
        )


@dataclass(frozen=True)
class Log:
    """A stretch of a robot's motion: commands in, measurements out.

    Attributes:
      name: what reports call it.
      time: (T,) s, strictly increasing, from 0.
      controls: `ctrl:<actuator>` -> (T,) what was commanded.
      channels: channel name -> `Channel`.
      exogenous: `exo:<name>` -> (T,) measured signals that drive effects (volts, temperature).
      known: `<field>:<object>` -> (T,) model fields that the log itself gives.
      servo: `ctrl:<actuator>` -> {"gain" | "supply" | "damping": (T,)} of a firmware servo's law.
      group: logs of one group are never split between fitting and verifying where the split is `by: group` or `rotate`.
      condition: label of what the day was like (a wind, a floor); logs of one label share it.
      before: of a part of a longer log, what drove the robot until the part begins; hidden states are made from it.
        What was measured then is left out: it may belong to another split.
    """

    name: str
    time: Array
    controls: Mapping[str, Array]
    channels: Mapping[str, Channel]
    exogenous: Mapping[str, Array] = field(default_factory=dict)
    known: Mapping[str, Array] = field(default_factory=dict)
    servo: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)
    group: str = ""
    condition: str = ""
    before: Inputs | None = None

    def __post_init__(self) -> None:
        if self.time.ndim != 1 or len(self.time) < 2:
            raise InputError(
                f"log {self.name!r}: time must be a vector of two or more samples, got shape {self.time.shape}"
            )
        back = np.flatnonzero(np.diff(self.time) < _LEAST)
        if back.size:
            k = int(back[0])
            raise InputError(
                f"log {self.name!r}: time must increase, by {_LEAST:g} s or more, but goes from {self.time[k]:g} to "
                f"{self.time[k + 1]:g} s at row {k + 1}"
            )
        rows = {**self.controls, **self.exogenous, **self.known, **{k: c.values for k, c in self.channels.items()}}
        for key, values in rows.items():
            if len(values) != len(self.time):
                raise InputError(f"log {self.name!r}: {key} has {len(values)} rows where time has {len(self.time)}")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.time[-1] - self.time[0])

    @property
    def interval(self) -> float:
        """Median time between samples, s."""
        return float(np.median(np.diff(self.time)))

    @cached_property
    def inputs(self) -> Inputs:
        """What drove the robot, from before the log on."""
        own = Inputs(self.time, self.controls, self.exogenous, self.known, self.servo)
        return own if self.before is None else self.before.then(own)

    def part(self, start: int, stop: int, name: str) -> "Log":
        """Rows `start:stop` as a log of their own, whose time begins at 0 and which knows what drove it before."""
        rows = slice(start, stop)
        earlier = len(self.inputs.time) - len(self) + start

        def cut(channel: Channel) -> Channel:
            mask = None if channel.mask is None else channel.mask[rows]
            return replace(channel, values=channel.values[rows], mask=mask)

        return Log(
            name=name,
            time=self.time[rows] - self.time[start],
            controls={k: v[rows] for k, v in self.controls.items()},
            channels={k: cut(c) for k, c in self.channels.items()},
            exogenous={k: v[rows] for k, v in self.exogenous.items()},
            known={k: v[rows] for k, v in self.known.items()},
            servo={k: {n: v[rows] for n, v in terms.items()} for k, terms in self.servo.items()},
            group=self.group,
            condition=self.condition,
            before=self.inputs.first(earlier, float(self.time[start])) if earlier else None,
        )
