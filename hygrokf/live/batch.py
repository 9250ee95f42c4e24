"""A batch: what one round of the tracker gives the store to keep, completely or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from hygrokf.data.structured import Json
from hygrokf.live.condition import Condition
from hygrokf.live.forecast import Forecast
from hygrokf.live.properties import Property
from hygrokf.live.tracker import Point, Reading


@dataclass(frozen=True)
class Observation:
    """A reading of a turbine, the time it was `received` [s], and whether it came too `late` to be used."""

    turbine: str
    reading: Reading
    received: float
    late: bool = False


@dataclass(frozen=True)
class Alarm:
    """An alarm: `began`, `ended`, `acknowledged` [s]; `severity` "notice", "warning" or "alarm"."""

    id: str
    turbine: str
    kind: str
    severity: str
    began: float
    statement: str
    remedy: str
    ended: float | None = None
    acknowledged: float | None = None
    acknowledged_by: str | None = None


@dataclass(frozen=True)
class Estimates:
    """The condition at new instants, of which the first `final` are final.

    It replaces provisional estimates from `since` [s] on.
    """

    condition: Condition
    final: int
    since: float


@dataclass
class Batch:
    """The results of one round.

    `estimates`: by turbine; `properties`: (turbine, time [s], properties); `memories`: (turbine, name) → JSON
    data that the tracker resumes from; `counters`: (turbine, name) → increase; `place`: source → position to
    resume from; `forecasts`: turbine → forecast that replaces the previous one, None to delete it; `weather`:
    values of a weather forecast.
    """

    observations: list[Observation] = field(default_factory=list)
    points: dict[str, Point] = field(default_factory=dict)
    estimates: dict[str, Estimates] = field(default_factory=dict)
    properties: list[tuple[str, float, Sequence[Property]]] = field(default_factory=list)
    alarms: list[Alarm] = field(default_factory=list)
    memories: dict[tuple[str, str], Json] = field(default_factory=dict)
    counters: dict[tuple[str, str], int] = field(default_factory=dict)
    place: dict[str, str] = field(default_factory=dict)
    forecasts: dict[str, Forecast | None] = field(default_factory=dict)
    weather: list[Observation] = field(default_factory=list)

    @property
    def empty(self) -> bool:
        return not any(vars(self).values())
