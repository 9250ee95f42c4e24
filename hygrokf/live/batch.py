"""A batch: what one round of the tracker gives the store to keep, completely or not at all."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

from hygrokf.data.structured import Json, JsonObject, plain, structured
from hygrokf.live.condition import Condition
from hygrokf.live.forecast import Forecast
from hygrokf.live.properties import Property
from hygrokf.live.tracker import Point, Reading
from hygrokf.texts.statement import Statement


@dataclass(frozen=True)
class Observation:
    """A reading of a turbine, the time it was `received` [s], whether it came too `late` to be used, and
    whether it is a `revision`: another value of its stamp than those before."""

    turbine: str
    reading: Reading
    received: float
    late: bool = False
    revision: bool = False


@dataclass(frozen=True)
class Loss:
    """A span in which the connection of a turbine's signal was lost [s]; None while it still is."""

    turbine: str
    signal: str
    lost: float
    regained: float | None


STATES = ("at risk", "alarm", "stale", "no estimate", "ok", "off")
"""States of a turbine, in the order in which they need attention.

"at risk": condensation is likely now or within the forecast; "alarm": an alarm is open; "stale": its data
are too old; "no estimate": nothing can be said, for the reason that the assessment gives; "off": it is
stopped, and its estimate holds.
"""
CAUSES = ("defect", "settings changed", "false alarm", "unexplained", "look again")
"""Causes with which a person acknowledges an alarm."""


def content_of(statements: Sequence[Statement]) -> str:
    """What a row says, as the JSON of its column `content`."""
    return json.dumps(plain(list(statements)), ensure_ascii=False)


def text_of(statements: Sequence[Statement]) -> str:
    """What a row says, as the text of the column that people read."""
    return "; ".join(one.text for one in statements)


def pieces_of(statements: Sequence[Statement]) -> list[str | float]:
    """The same in pieces, of which the numbers are instants [s]: the page writes them in its own zone."""
    pieces: list[str | float] = []
    for one in statements:
        pieces += ["; ", *one.pieces] if pieces else one.pieces
    return pieces


@dataclass(frozen=True)
class Alarm:
    """An alarm: `began`, `ended`, `acknowledged` [s]; `severity` "notice", "warning" or "alarm"; `subject`
    distinguishes alarms of one kind.

    It says `content`, of which `statement` is the text, and what to do is the `remedy`.  Whoever acknowledges
    it states a `cause` (one of `CAUSES`) and may add a `note`; `look_again` [s] is when it is due once more.
    """

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
    cause: str | None = None
    note: str | None = None
    look_again: float | None = None
    subject: str = ""
    content: str = "[]"

    @property
    def statements(self) -> tuple[Statement, ...]:
        """What it says: the first statement, and doubts about it."""
        return structured(tuple[Statement, ...], json.loads(self.content))

    def served(self) -> JsonObject:
        """The alarm as programs receive it."""
        return {**asdict(self), "content": json.loads(self.content)}


@dataclass(frozen=True)
class Assessment:
    """The `state` of a turbine (one of `STATES`) `since` a time [s]; its `reason` is that of `content`."""

    turbine: str
    state: str
    reason: str
    since: float
    content: str = "[]"

    @property
    def statements(self) -> tuple[Statement, ...]:
        """The reason, and what the estimate lacks."""
        return structured(tuple[Statement, ...], json.loads(self.content))


@dataclass(frozen=True)
class Shelf:
    """Shelved alarms of one kind and turbine: they are stored, but nobody is notified `until` a time [s]."""

    turbine: str
    kind: str
    until: float
    made: float
    made_by: str
    note: str = ""


@dataclass(frozen=True)
class Event:
    """A change at a turbine at `time` [s] that a person stated at `made` [s].

    kind: one of `traces.KINDS`.
    """

    id: str
    turbine: str
    time: float
    kind: str
    note: str
    made: float
    made_by: str


@dataclass(frozen=True)
class Notice:
    """A message about an alarm to a `channel`: `content` is JSON, sent after `due` [s].

    `attempts` to send it so far, the `failure` of the last one, and when it was `sent` [s].  Its id consists
    of channel, alarm and event, so that a message is written once.
    """

    id: str
    channel: str
    content: str
    made: float
    due: float
    attempts: int = 0
    failure: str = ""
    sent: float | None = None


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

    `losses`: spans of lost connection that began or ended; `held`: readings whose stamps are ahead of this
    machine's clock, kept apart until they are `released`; `reopened`: alarms that are unacknowledged again;
    `estimates`: by turbine; `properties`: (turbine, time [s], properties); `memories`: (turbine or source,
    name) → JSON data that the tracker resumes from; `counters`: (turbine, name) → increase; `place`: source →
    position to resume from; `forecasts`: turbine → forecast that replaces the previous one, None to delete
    it; `weather`: values of a weather forecast.
    """

    observations: list[Observation] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    held: list[Observation] = field(default_factory=list)
    released: list[Observation] = field(default_factory=list)
    points: dict[str, Point] = field(default_factory=dict)
    estimates: dict[str, Estimates] = field(default_factory=dict)
    properties: list[tuple[str, float, Sequence[Property]]] = field(default_factory=list)
    alarms: list[Alarm] = field(default_factory=list)
    reopened: list[Alarm] = field(default_factory=list)
    assessments: list[Assessment] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)
    memories: dict[tuple[str, str], Json] = field(default_factory=dict)
    counters: Counter[tuple[str, str]] = field(default_factory=Counter)
    place: dict[str, str] = field(default_factory=dict)
    forecasts: dict[str, Forecast | None] = field(default_factory=dict)
    weather: list[Observation] = field(default_factory=list)

    @property
    def empty(self) -> bool:
        return not any(vars(self).values())
