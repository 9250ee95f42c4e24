"""What people state on the page: acknowledgements, shelves and events; and what follows from them."""

from __future__ import annotations

import logging
import math
import uuid
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from hygrokf.data.structured import Json
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.errors import HygrokfError
from hygrokf.live.alarms import RULES
from hygrokf.live.batch import CAUSES, Event, Shelf
from hygrokf.live.changes import KINDS as EVENT_KINDS
from hygrokf.live.notification.notices import LOOK_AGAIN, acknowledge
from hygrokf.live.service import Service
from hygrokf.live.storage.export import alarms_csv
from hygrokf.live.storage.store import Store
from hygrokf.live.turbines import SOURCE
from hygrokf.live.web.exchange import posted_json, refusal, reply
from hygrokf.live.web.reader import Reader
from hygrokf.live.web.server import Hub
from hygrokf.live.web.views import labels_view

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import Route

LOG = logging.getLogger("hygrokf.page")
LONGEST_NAME, LONGEST_ID, LONGEST_NOTE = 60, 300, 500
"""Longest name of a person, id of an alarm, and note [characters]."""
MOST_SHELVED_DAYS, MOST_LATER_DAYS = 30.0, 90.0
"""Longest shelf, and longest time until an alarm is looked at again [d]."""
EARLIEST_S, AHEAD_S = 400.0 * DAY_S, 300.0
"""How far an event may lie in the past, and ahead of the clock [s]."""
TRACKED = "expected a turbine that is tracked"
LISTED = 1_000
"""Largest number of events listed."""


T = TypeVar("T")


class StatementFault(HygrokfError):
    """A statement is incomplete or impossible; the message says what was expected."""


# -- reading -------------------------------------------------------------------------------------------------
def acknowledgement_of(given: Mapping[str, Json], now: float) -> dict[str, Any]:
    """The acknowledgement in a posted object, as arguments of `acknowledge`.  Raises StatementFault."""
    alarm, cause = given.get("id"), given.get("cause", "unexplained")
    if not isinstance(alarm, str) or not 0 < len(alarm) <= LONGEST_ID or not alarm.isprintable():
        raise StatementFault("expected the id of an alarm")
    cause = _chosen(cause, CAUSES, f"expected a cause of {', '.join(CAUSES)}")
    later = None
    if cause == LOOK_AGAIN:
        later = now + DAY_S * _days(given, MOST_LATER_DAYS)
    elif given.get("days") is not None:
        raise StatementFault(f'days belong to the cause "{LOOK_AGAIN}" alone')
    note = _note(given)
    return {"alarm": alarm, "by": _name(given), "cause": cause, "note": note, "look_again_s": later}


def shelf_of(given: Mapping[str, Json], turbines: Collection[str], now: float) -> Shelf:
    """The shelf in a posted object.  Raises StatementFault."""
    turbine, kind = shelved(given, turbines)
    until = now + DAY_S * _days(given, MOST_SHELVED_DAYS)
    return Shelf(turbine, kind, until, now, _name(given), _note(given))


def shelved(given: Mapping[str, Json], turbines: Collection[str]) -> tuple[str, str]:
    """Turbine ("" for the sources) and kind of alarms in a posted object.  Raises StatementFault."""
    turbine = _chosen(given.get("turbine"), (SOURCE, *turbines), TRACKED)
    return turbine, _chosen(given.get("kind"), RULES, f"expected a kind of {', '.join(RULES)}")


def event_of(given: Mapping[str, Json], turbines: Collection[str], now: float) -> Event:
    """The event in a posted object.  Raises StatementFault."""
    turbine = _chosen(given.get("turbine"), turbines, TRACKED)
    kind = _chosen(given.get("kind"), EVENT_KINDS, f"expected a kind of {', '.join(EVENT_KINDS)}")
    at = _number(given.get("time", now))
    if not -EARLIEST_S <= at - now <= AHEAD_S:
        raise StatementFault("expected a time in seconds since 1970, within the last 400 days")
    return Event(uuid.uuid4().hex, turbine, at, kind, _note(given), now, _name(given))


def _chosen(value: Json, choices: Collection[str], words: str) -> str:
    """A text that is one of the choices; `words` say what was expected."""
    if not isinstance(value, str) or value not in choices:
        raise StatementFault(words)
    return value


def _name(given: Mapping[str, Json]) -> str:
    by = given.get("by")
    by = by.strip() if isinstance(by, str) else ""
    if not 0 < len(by) <= LONGEST_NAME or not by.isprintable():
        raise StatementFault(f"expected a name of 1 to {LONGEST_NAME} characters")
    return by


def _note(given: Mapping[str, Json]) -> str:
    note = given.get("note", "")
    note = note.strip() if isinstance(note, str) else None
    if note is None or len(note) > LONGEST_NOTE or not note.isprintable():
        raise StatementFault(f"expected a note of at most {LONGEST_NOTE} printable characters")
    return note


def _days(given: Mapping[str, Json], most: float) -> float:
    days = _number(given.get("days"))
    if not HOUR_S / DAY_S <= days <= most:
        raise StatementFault(f"expected days from 1 hour (1/24) to {most:g}")
    return days


def _number(value: Json) -> float:
    """A number, NaN for anything else."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    try:
        return float(value) if number else math.nan  # type: ignore[arg-type]
    except OverflowError:
        return math.nan


# -- endpoints -----------------------------------------------------------------------------------------------
class Statements:
    """The endpoints of what people state; they share the page's connection to the store, and the page answers
    a StatementFault."""

    def __init__(self, service: Service, hub: Hub, reader: Reader) -> None:
        self.service = service
        self.hub = hub
        self.reader = reader

    def routes(self) -> list[Route]:
        from starlette.routing import Route

        return [
            Route("/api/alarms/acknowledge", self.acknowledge, methods=["POST"]),
            Route("/api/alarms/labels", self.labels),
            Route("/api/alarms.csv", self.csv),
            Route("/api/shelves", self.shelves),
            Route("/api/shelves", self.shelve, methods=["POST"]),
            Route("/api/shelves", self.unshelve, methods=["DELETE"]),
            Route("/api/events", self.events),
            Route("/api/events", self.note_event, methods=["POST"]),
        ]

    async def acknowledge(self, request: Request) -> Response:
        now, channels = self.service.now, self.service.channels
        stated = acknowledgement_of(await posted_json(request), now)
        done = await self._write(lambda store: acknowledge(store, now=now, channels=channels, **stated))
        if done is None:
            return refusal(409, "there is no such alarm, or it is already acknowledged")
        LOG.info(
            "an alarm was acknowledged",
            extra={name: stated[name] for name in ("alarm", "by", "cause")},
        )
        self.hub.changed({done} - {SOURCE})
        return reply({"turbine": done})

    def labels(self, request: Request) -> Response:
        return reply({"now": self.service.now, "kinds": self.reader.read(labels_view)})

    def csv(self, request: Request) -> Response:
        from starlette.responses import Response

        text = self.reader.read(alarms_csv)
        headers = {"Content-Disposition": 'attachment; filename="alarms.csv"'}
        return Response(text, media_type="text/csv", headers=headers)

    def shelves(self, request: Request) -> Response:
        now = self.service.now
        return reply({"now": now, "shelves": self.reader.read(lambda store: store.shelves(now))})

    async def shelve(self, request: Request) -> Response:
        shelf = shelf_of(await posted_json(request), self.service.turbines, self.service.now)
        await self._write(lambda store: store.shelve(shelf))
        LOG.info(
            "alarms were shelved",
            extra={"turbine": shelf.turbine, "kind": shelf.kind, "by": shelf.made_by, "until": shelf.until},
        )
        self.hub.changed({shelf.turbine} - {SOURCE})
        return reply({"shelf": shelf})

    async def unshelve(self, request: Request) -> Response:
        turbine, kind = shelved(await posted_json(request), self.service.turbines)
        if not await self._write(lambda store: store.unshelve(turbine, kind)):
            return refusal(404, "there is no such shelf")
        LOG.info("a shelf was ended", extra={"turbine": turbine, "kind": kind})
        self.hub.changed({turbine} - {SOURCE})
        return reply({"turbine": turbine})

    def events(self, request: Request) -> Response:
        name = request.query_params.get("turbine")
        if name is not None and name not in self.service.turbines:
            return refusal(404, "no such turbine is tracked")
        names = list(self.service.turbines) if name is None else [name]

        def view(store: Store) -> list[Event]:
            known = [event for event in store.all_events() if event.turbine in names]
            return known[-LISTED:][::-1]

        return reply({"now": self.service.now, "events": self.reader.read(view)})

    async def note_event(self, request: Request) -> Response:
        event = event_of(await posted_json(request), self.service.turbines, self.service.now)
        await self._write(lambda store: store.note_event(event))
        LOG.info(
            "an event was stated",
            extra={"turbine": event.turbine, "kind": event.kind, "at": event.time, "by": event.made_by},
        )
        self.hub.changed([event.turbine])
        return reply({"event": event})

    async def _write(self, change: Callable[[Store], T]) -> T:
        from starlette.concurrency import run_in_threadpool

        return await run_in_threadpool(self.reader.read, change)
