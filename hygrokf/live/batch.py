"""A batch: the results of a round of the tracker, which the store keeps completely or not at all."""

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
    """A reading of a turbine, received at the time `received` [s].

    `late`: whether it came too late to be used; `revision`: whether its value differs from earlier values
    with the same time stamp.
    """

    turbine: str
    reading: Reading
    received: float
    late: bool = False
    revision: bool = False


@dataclass(frozen=True)
class Loss:
    """A loss of the connection of a turbine's signal: times [s] at which the connection was `lost` and
    `regained` (None while it is lost)."""

    turbine: str
    signal: str
    lost: float
    regained: float | None


TURBINE_STATES = ("at risk", "alarm", "stale", "no estimate", "ok", "off")
"""States of a turbine, in the order in which they need attention.

"at risk": condensation is likely now or within the forecast; "alarm": an alarm is open; "stale": its data
are too old; "no estimate": the state is unknown, for the reason that the assessment gives; "off": the turbine
is stopped, and condensation is unlikely.
"""
STATED_CAUSES = ("defect", "settings changed", "false alarm", "unexplained", "look again")
"""Causes with which a person acknowledges an alarm."""


def stated_content(statements: Sequence[Statement]) -> str:
    """Return statements as JSON for the column `content`."""
    return json.dumps(plain(list(statements)), ensure_ascii=False)


def stated_text(statements: Sequence[Statement]) -> str:
    """Return statements as one text for people."""
    return "; ".join(statement.text for statement in statements)


def pieces_of(statements: Sequence[Statement]) -> list[str | float]:
    """Return the text of statements in pieces; numbers are times [s] to be shown in the page's time zone."""
    pieces: list[str | float] = []
    for statement in statements:
        pieces += ["; ", *statement.pieces] if pieces else statement.pieces
    return pieces


@dataclass(frozen=True)
class Alarm:
    """An alarm: `began`, `ended`, `acknowledged` [s]; `severity` "notice", "warning" or "alarm"; `subject`
    distinguishes alarms of one kind.

    `content` holds its statements, `statement` is their text, and `remedy` tells what to do.  Whoever
    acknowledges the alarm states a `cause` (one of `STATED_CAUSES`) and may add a `note`; `look_again` [s] is
    the time at which the alarm is due again.
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
        """The statement of the alarm, and doubts about the fit on which it rests."""
        return structured(tuple[Statement, ...], json.loads(self.content))

    def served(self) -> JsonObject:
        """Return the alarm as JSON for other programs."""
        return {**asdict(self), "content": json.loads(self.content)}


@dataclass(frozen=True)
class Assessment:
    """The `state` of a turbine (one of `TURBINE_STATES`) `since` a time [s]; `reason` is the text of
    `content`."""

    turbine: str
    state: str
    reason: str
    since: float
    content: str = "[]"

    @property
    def statements(self) -> tuple[Statement, ...]:
        """The reason of the state, and which sensors are silent."""
        return structured(tuple[Statement, ...], json.loads(self.content))


@dataclass(frozen=True)
class Shelf:
    """A shelf: alarms of one kind at one turbine are stored, but nobody is notified of them `until` a time
    [s].

    `made`: time [s] at which `made_by` shelved them.
    """

    turbine: str
    kind: str
    until: float
    made: float
    made_by: str
    note: str = ""


@dataclass(frozen=True)
class Event:
    """A change at a turbine at `time` [s], entered at `made` [s] by the person `made_by`.

    `kind`: one of `traces.KINDS`.
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
    """A message about an alarm to a `channel`, written at `made` [s] and sent from `due` [s] on.

    `content`: JSON; `attempts`: number of attempts to send it; `failure`: why the last one failed; `sent`:
    time [s] at which it was sent.  The id consists of channel, alarm and event, so that a notice is written
    once.
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
    """The condition at new instants, of which the first `final` are final; they replace the provisional
    estimates from `since` [s] on."""

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
        """Whether the store has nothing to write."""
        return not any(vars(self).values())
