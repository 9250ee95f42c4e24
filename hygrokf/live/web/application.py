"""The live page as an ASGI application: static files, data as JSON, events and metrics.

The page reads the store over its own connection, so that the tracker never waits for the page.
"""

from __future__ import annotations

import logging
import math
import time
import uuid
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from hygrokf.data.structured import Json
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.errors import HygrokfError
from hygrokf.live.alarms import ALARM_RULES
from hygrokf.live.batch import STATED_CAUSES, TURBINE_STATES, Event, Shelf
from hygrokf.live.notification.notices import LOOK_AGAIN, ChannelState, acknowledge, channel_states
from hygrokf.live.service import Service
from hygrokf.live.storage.export import alarms_csv
from hygrokf.live.storage.schema import alarm_open
from hygrokf.live.storage.statements import count_rows
from hygrokf.live.storage.store import Store, StoreFault
from hygrokf.live.traces import EVENT_KINDS
from hygrokf.live.turbines import SOURCE
from hygrokf.live.web.metrics import exposition
from hygrokf.live.web.page_settings import MISSING_PACKAGES, PageFault, PageSettings
from hygrokf.live.web.reader import Reader, StoreAnswers
from hygrokf.live.web.server import Access, EventStream, Hub, guard, posted_json, refusal, reply
from hygrokf.live.web.views import (
    MarginsCache,
    View,
    alarms_view,
    fleet_view,
    health_view,
    labels_view,
    turbine_view,
)
from hygrokf.version import __version__

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import Route
    from starlette.types import ASGIApp

STATIC = Path(__file__).parent / "static"
HISTORY_DAYS = (1, 3, 7, 14)
"""Lengths of a turbine's history that may be requested [d]."""
LOOP_S = 300.0
"""[s] that one cycle of the tracker's loop may take before the loop counts as stuck."""
FLEET_KEPT_S = 10.0
"""[s] after which the fleet's rows are read again even without a change."""


class PageEndpoints:
    """The page's endpoints, which read a tracker's service; the hub announces the service's commits."""

    def __init__(self, service: Service, hub: Hub, settings: PageSettings) -> None:
        self.service = service
        self.hub = hub
        self.access = Access(settings)
        self.reader = Reader(service)
        self.answers = StoreAnswers(service)
        self._fleet: tuple[int, float, list[View]] = (-1, 0.0, [])
        self._margins = MarginsCache()

    def app(self) -> ASGIApp:
        """The ASGI application.  Raises PageFault if packages are missing."""
        try:
            from starlette.applications import Starlette
        except ImportError:
            raise PageFault(MISSING_PACKAGES) from None
        from starlette.middleware import Middleware
        from starlette.middleware.gzip import GZipMiddleware
        from starlette.responses import FileResponse
        from starlette.routing import Mount, Route
        from starlette.staticfiles import StaticFiles

        def index(request: Request) -> Response:
            return FileResponse(STATIC / "index.html")

        routes = [
            Route("/", index),
            Mount("/static", StaticFiles(directory=STATIC)),
            Route("/api/fleet", self.fleet),
            Route("/api/margins", self.margins),
            Route("/api/turbine/{name:path}", self.turbine),
            Route("/api/alarms", self.alarms),
            *Statements(self.service, self.hub, self.reader).routes(),
            Route("/api/health", self.health),
            Route("/api/login", self.login, methods=["POST"]),
            Route("/api/logout", self.logout, methods=["POST"]),
            Route("/events", EventStream(self.hub)),
            Route("/metrics", self.metrics),
            Route("/healthz", self.healthz),
            Route("/readyz", self.readyz),
        ]
        app = Starlette(
            routes=routes,
            middleware=[Middleware(GZipMiddleware, minimum_size=1000, compresslevel=5)],
            exception_handlers={
                StatementFault: lambda request, fault: refusal(400, str(fault)),
                StoreFault: lambda request, fault: refusal(503, str(fault)),
                PageFault: lambda request, fault: refusal(503, str(fault)),
            },
        )
        return guard(app, self.access)

    def close(self) -> None:
        """Close the page's connections to the store."""
        self.reader.close()
        self.answers.close()

    # -- data of the page ------------------------------------------------------------------------------------
    def fleet(self, request: Request) -> Response:
        now = self.service.now
        rows = self.rows(now)
        summary = dict.fromkeys(TURBINE_STATES, 0) | Counter(row["state"] for row in rows)
        return reply({"now": now, "summary": summary, "turbines": rows})

    def rows(self, now: float) -> list[View]:
        """The fleet's rows, read again after a change or `FLEET_KEPT_S`."""
        generation, read_s, rows = self._fleet
        current = self.hub.generation
        if generation != current or not 0.0 <= now - read_s < FLEET_KEPT_S:
            verdicts = {name: turbine.verdicts for name, turbine in self.service.turbines.items()}
            rows = self.reader.read(lambda store: fleet_view(store, list(verdicts), now, verdicts))
            self._fleet = (current, now, rows)
        return rows

    def margins(self, request: Request) -> Response:
        now = self.service.now
        return reply({"now": now, **self._margins.view(self.reader, list(self.service.turbines), now)})

    def turbine(self, request: Request) -> Response:
        name, days = request.path_params["name"], request.query_params.get("days", "3")
        if name not in self.service.turbines:
            return refusal(404, "no such turbine is tracked")
        if days not in map(str, HISTORY_DAYS):
            return refusal(400, f"days must be one of {', '.join(map(str, HISTORY_DAYS))}")
        now = self.service.now
        turbine, since = self.service.turbines[name], now - int(days) * DAY_S
        view = self.reader.read(
            lambda store: turbine_view(store, name, since, now, turbine.verdicts, turbine.plan.needs)
        )
        return reply({"now": now, **view})

    def alarms(self, request: Request) -> Response:
        now = self.service.now
        alarms = self.reader.read(lambda store: alarms_view(store, since=now - max(HISTORY_DAYS) * DAY_S))
        return reply({"now": now, "alarms": alarms})

    def health(self, request: Request) -> Response:
        counters, ((open_count,),), channels = self.reader.read(
            lambda store: (store.counters(), store.rows(count_rows(alarm_open)), channel_states(store))
        )
        now = self.service.now
        rows = self.rows(now)
        fleet = {
            "now": now,
            "version": __version__,
            "token": bool(self.access.settings.token),
            "turbines": len(self.service.turbines),
            "open_alarms": int(open_count),
            "heard": max((row["heard"] for row in rows if row["heard"] is not None), default=None),
            "label": "; ".join(stream.label for stream in self.service.streams.values() if stream.label),
            "channels": [
                {"name": channel.name, **asdict(channels.get(channel.name, ChannelState()))}
                for channel in self.service.channels
            ],
        }
        return reply({**fleet, **health_view(self.service.streams, self.service.health, counters)})

    # -- login -----------------------------------------------------------------------------------------------
    async def login(self, request: Request) -> Response:
        token = (await posted_json(request)).get("token")
        if not self.access.settings.token:
            return reply({})
        if not self.access.is_token(token if isinstance(token, str) else ""):
            # without a "Bearer" challenge, for which the browser would show its own login prompt
            return refusal(401, "wrong token")
        return reply({}, {"Set-Cookie": self.access.sessions.header(opens=True)})

    async def logout(self, request: Request) -> Response:
        return reply({}, {"Set-Cookie": self.access.sessions.header(opens=False)})

    # -- metrics and health checks ---------------------------------------------------------------------------
    def metrics(self, request: Request) -> Response:
        from starlette.responses import Response

        channels: dict[str, ChannelState] = {}
        try:
            rows: list[View] | None = self.rows(self.service.now)
            counters, alarms, channels = self.reader.read(
                lambda store: (store.counters(), alarms_view(store, since=math.inf), channel_states(store))
            )
        except StoreFault:
            rows, counters, alarms = None, {}, []
        notices = {
            channel.name: channels.get(channel.name, ChannelState()).waiting
            for channel in self.service.channels
        }
        text, kind = exposition(self.service, len(self.hub), rows, alarms, counters, notices)
        return Response(text, headers={"Content-Type": kind})

    async def healthz(self, request: Request) -> Response:
        """Status 200 while the tracker's loop and store work, else 503: then restarting the tracker may help.

        The answer waits neither for other requests nor for the threads that answer them.
        """
        return self._status(await self._fault())

    async def readyz(self, request: Request) -> Response:
        """Status 200 while readings can become estimates, else 503.

        503 also says that a source has not been reached for longer than its limit.
        """
        now = self.service.now
        lost = sum(reach.share(now) >= 1.0 for reach in self.service.reaches().values())
        source_fault = f"{lost} of {len(self.service.streams)} sources are not reached" if lost else ""
        return self._status(await self._fault() or source_fault)

    def _status(self, fault: str) -> Response:
        """The answer to a health check, with the number of sources in each state but without names of sources
        or turbines, because it needs no token."""
        states = Counter(stream.state.word for stream in self.service.streams.values())
        body = {"fault": fault} if fault else {"ok": True}
        return reply({**body, "sources": states}, status=503 if fault else 200)

    async def _fault(self) -> str:
        if self.service.ending.is_set():
            return "the tracker is ending"
        if self.service.health.store:
            return "the tracker cannot reach its store"
        if time.monotonic() - self.service.health.looped > LOOP_S:
            return f"the tracker's loop has not completed a cycle for {LOOP_S:g} s"
        return await self.answers.fault()


LOG = logging.getLogger("hygrokf.page")
LONGEST_NAME, LONGEST_ID, LONGEST_NOTE = 60, 300, 500
"""Longest name of a person, id of an alarm, and note [characters]."""
MOST_SHELVED_DAYS, MOST_POSTPONED_DAYS = 30.0, 90.0
"""Longest shelf, and longest time until an alarm is looked at again [d]."""
EVENT_PAST_S, EVENT_AHEAD_S = 400.0 * DAY_S, 300.0
"""Largest time by which an event may lie before, and after, the present [s]."""
EXPECTED_TURBINE = "expected a turbine that is tracked"
MOST_EVENTS = 1_000
"""Largest number of events listed."""


T = TypeVar("T")


class StatementFault(HygrokfError):
    """A statement is incomplete or impossible; the message says what was expected."""


# -- statements of people ------------------------------------------------------------------------------------
def acknowledgement_of(posted: Mapping[str, Json], now: float) -> dict[str, Any]:
    """The acknowledgement in a posted object, as arguments of `acknowledge`.  Raises StatementFault."""
    alarm, cause = posted.get("id"), posted.get("cause", "unexplained")
    if not isinstance(alarm, str) or not 0 < len(alarm) <= LONGEST_ID or not alarm.isprintable():
        raise StatementFault("expected the id of an alarm")
    cause = _choice(cause, STATED_CAUSES, f"expected a cause of {', '.join(STATED_CAUSES)}")
    look_again_s = None
    if cause == LOOK_AGAIN:
        look_again_s = now + DAY_S * _days(posted, MOST_POSTPONED_DAYS)
    elif posted.get("days") is not None:
        raise StatementFault(f'days belong to the cause "{LOOK_AGAIN}" alone')
    by, note = _name(posted), _note(posted)
    return {"alarm": alarm, "by": by, "cause": cause, "note": note, "look_again_s": look_again_s}


def shelf_of(posted: Mapping[str, Json], turbines: Collection[str], now: float) -> Shelf:
    """The shelf in a posted object.  Raises StatementFault."""
    turbine, kind = shelf_key(posted, turbines)
    until = now + DAY_S * _days(posted, MOST_SHELVED_DAYS)
    return Shelf(turbine, kind, until, now, _name(posted), _note(posted))


def shelf_key(posted: Mapping[str, Json], turbines: Collection[str]) -> tuple[str, str]:
    """Turbine ("" for the sources) and kind of alarms in a posted object.  Raises StatementFault."""
    turbine = _choice(posted.get("turbine"), (SOURCE, *turbines), EXPECTED_TURBINE)
    return turbine, _choice(posted.get("kind"), ALARM_RULES, f"expected a kind of {', '.join(ALARM_RULES)}")


def event_of(posted: Mapping[str, Json], turbines: Collection[str], now: float) -> Event:
    """The event in a posted object.  Raises StatementFault."""
    turbine = _choice(posted.get("turbine"), turbines, EXPECTED_TURBINE)
    kind = _choice(posted.get("kind"), EVENT_KINDS, f"expected a kind of {', '.join(EVENT_KINDS)}")
    at = _number(posted.get("time", now))
    if not -EVENT_PAST_S <= at - now <= EVENT_AHEAD_S:
        raise StatementFault("expected a time in seconds since 1970, within the last 400 days")
    return Event(uuid.uuid4().hex, turbine, at, kind, _note(posted), now, _name(posted))


def _choice(value: Json, choices: Collection[str], message: str) -> str:
    if not isinstance(value, str) or value not in choices:
        raise StatementFault(message)
    return value


def _name(posted: Mapping[str, Json]) -> str:
    by = posted.get("by")
    by = by.strip() if isinstance(by, str) else ""
    if not 0 < len(by) <= LONGEST_NAME or not by.isprintable():
        raise StatementFault(f"expected a name of 1 to {LONGEST_NAME} characters")
    return by


def _note(posted: Mapping[str, Json]) -> str:
    note = posted.get("note", "")
    note = note.strip() if isinstance(note, str) else None
    if note is None or len(note) > LONGEST_NOTE or not note.isprintable():
        raise StatementFault(f"expected a note of at most {LONGEST_NOTE} printable characters")
    return note


def _days(posted: Mapping[str, Json], most: float) -> float:
    days = _number(posted.get("days"))
    if not HOUR_S / DAY_S <= days <= most:
        raise StatementFault(f"expected days from 1 hour (1/24) to {most:g}")
    return days


def _number(value: Json) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    try:
        return float(value) if is_number else math.nan  # type: ignore[arg-type]
    except OverflowError:
        return math.nan


# -- endpoints -----------------------------------------------------------------------------------------------
class Statements:
    """The endpoints for statements of people: acknowledgements, shelves and events.

    They share the page's connection to the store; the application turns a StatementFault into a refusal.
    """

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
        statement = acknowledgement_of(await posted_json(request), now)
        turbine = await self._write(lambda store: acknowledge(store, now=now, channels=channels, **statement))
        if turbine is None:
            return refusal(409, "there is no such alarm, or it is already acknowledged")
        LOG.info(
            "an alarm was acknowledged",
            extra={name: statement[name] for name in ("alarm", "by", "cause")},
        )
        self.hub.announce({turbine} - {SOURCE})
        return reply({"turbine": turbine})

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
        self.hub.announce({shelf.turbine} - {SOURCE})
        return reply({"shelf": shelf})

    async def unshelve(self, request: Request) -> Response:
        turbine, kind = shelf_key(await posted_json(request), self.service.turbines)
        if not await self._write(lambda store: store.unshelve(turbine, kind)):
            return refusal(404, "there is no such shelf")
        LOG.info("a shelf was ended", extra={"turbine": turbine, "kind": kind})
        self.hub.announce({turbine} - {SOURCE})
        return reply({"turbine": turbine})

    def events(self, request: Request) -> Response:
        name = request.query_params.get("turbine")
        if name is not None and name not in self.service.turbines:
            return refusal(404, "no such turbine is tracked")
        names = list(self.service.turbines) if name is None else [name]

        def view(store: Store) -> list[Event]:
            events = [event for event in store.all_events() if event.turbine in names]
            return events[-MOST_EVENTS:][::-1]

        return reply({"now": self.service.now, "events": self.reader.read(view)})

    async def note_event(self, request: Request) -> Response:
        event = event_of(await posted_json(request), self.service.turbines, self.service.now)
        await self._write(lambda store: store.note_event(event))
        LOG.info(
            "an event was stated",
            extra={"turbine": event.turbine, "kind": event.kind, "at": event.time, "by": event.made_by},
        )
        self.hub.announce([event.turbine])
        return reply({"event": event})

    async def _write(self, change: Callable[[Store], T]) -> T:
        from starlette.concurrency import run_in_threadpool

        return await run_in_threadpool(self.reader.read, change)
