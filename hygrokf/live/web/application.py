"""The live page as an ASGI application: static files, data as JSON, events and metrics.

The page reads the store over its own connection, so that the tracker never waits for the page.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.data.timestamps import DAY_S
from hygrokf.live.batch import STATES
from hygrokf.live.service import Service
from hygrokf.live.storage.outbox import ChannelState, channel_states
from hygrokf.live.storage.store import StoreFault
from hygrokf.live.web.exchange import Access, guard, posted_json, refusal, reply
from hygrokf.live.web.margins import MarginsKept
from hygrokf.live.web.metrics import exposition
from hygrokf.live.web.page_settings import NEEDED, PageFault, PageSettings
from hygrokf.live.web.reader import Reader, StoreAnswers
from hygrokf.live.web.server import EventStream, Hub
from hygrokf.live.web.statements import StatementFault, Statements
from hygrokf.live.web.views import (
    View,
    alarms_view,
    fleet_view,
    health_view,
    turbine_view,
)
from hygrokf.version import __version__

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import ASGIApp

STATIC = Path(__file__).parent / "static"
DAYS = (1, 3, 7, 14)
"""Lengths of a turbine's history that may be requested [d]."""
LOOP_S = 300.0
"""[s] that one round of the tracker may take before it counts as stuck."""
KEPT_S = 10.0
"""[s] after which the fleet's rows are read again even without a change."""


class Page:
    """The page's endpoints, which read a tracker's service and the hub that announces its commits."""

    def __init__(self, service: Service, hub: Hub, settings: PageSettings) -> None:
        self.service = service
        self.hub = hub
        self.access = Access(settings)
        self.reader = Reader(service)
        self.answers = StoreAnswers(service)
        self._fleet: tuple[int, float, list[View]] = (-1, 0.0, [])
        self._margins = MarginsKept()

    def app(self) -> ASGIApp:
        """The ASGI application.  Raises PageFault if packages are missing."""
        try:
            from starlette.applications import Starlette
        except ImportError:
            raise PageFault(NEEDED) from None
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
        made = Starlette(
            routes=routes,
            middleware=[Middleware(GZipMiddleware, minimum_size=1000, compresslevel=5)],
            exception_handlers={
                StatementFault: lambda request, fault: refusal(400, str(fault)),
                StoreFault: lambda request, fault: refusal(503, str(fault)),
                PageFault: lambda request, fault: refusal(503, str(fault)),
            },
        )
        return guard(made, self.access)

    def close(self) -> None:
        """Close the page's connections to the store."""
        self.reader.close()
        self.answers.close()

    # -- what is shown ---------------------------------------------------------------------------------------
    def fleet(self, request: Request) -> Response:
        now = self.service.now
        rows = self.rows(now)
        summary = dict.fromkeys(STATES, 0) | Counter(row["state"] for row in rows)
        return reply({"now": now, "summary": summary, "turbines": rows})

    def rows(self, now: float) -> list[View]:
        """The fleet's rows, read again after a change or `KEPT_S`."""
        generation, at, rows = self._fleet
        current = self.hub.generation
        if generation != current or not 0.0 <= now - at < KEPT_S:
            known = {name: one.verdicts for name, one in self.service.turbines.items()}
            rows = self.reader.read(lambda store: fleet_view(store, list(known), now, known))
            self._fleet = (current, now, rows)
        return rows

    def margins(self, request: Request) -> Response:
        now = self.service.now
        return reply({"now": now, **self._margins.view(self.reader, list(self.service.turbines), now)})

    def turbine(self, request: Request) -> Response:
        name, days = request.path_params["name"], request.query_params.get("days", "3")
        if name not in self.service.turbines:
            return refusal(404, "no such turbine is tracked")
        if days not in map(str, DAYS):
            return refusal(400, f"days must be one of {', '.join(map(str, DAYS))}")
        now = self.service.now
        verdicts, needs = self.service.turbines[name].verdicts, self.service.turbines[name].plan.needs
        since = now - int(days) * DAY_S
        found = self.reader.read(lambda store: turbine_view(store, name, since, now, verdicts, needs))
        return reply({"now": now, **found})

    def alarms(self, request: Request) -> Response:
        now = self.service.now
        found = self.reader.read(lambda store: alarms_view(store, since=now - max(DAYS) * DAY_S))
        return reply({"now": now, "alarms": found})

    def health(self, request: Request) -> Response:
        open_alarms = "SELECT COUNT(*) FROM alarm WHERE ended IS NULL"
        counters, ((open_,),), told = self.reader.read(
            lambda store: (store.counters(), store.rows(open_alarms), channel_states(store))
        )
        now = self.service.now
        rows = self.rows(now)
        own = {
            "now": now,
            "version": __version__,
            "token": bool(self.access.settings.token),
            "turbines": len(self.service.turbines),
            "open_alarms": int(open_),
            "heard": max((row["heard"] for row in rows if row["heard"] is not None), default=None),
            "label": "; ".join(one.label for one in self.service.streams.values() if one.label),
            "channels": [
                {"name": one.name, **asdict(told.get(one.name, ChannelState()))}
                for one in self.service.channels
            ],
        }
        return reply({**own, **health_view(self.service.streams, self.service.health, counters)})

    # -- who is let in ---------------------------------------------------------------------------------------
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

    # -- what machines ask -----------------------------------------------------------------------------------
    def metrics(self, request: Request) -> Response:
        from starlette.responses import Response

        told: dict[str, ChannelState] = {}
        try:
            rows: list[View] | None = self.rows(self.service.now)
            counters, alarms, told = self.reader.read(
                lambda store: (store.counters(), alarms_view(store, since=math.inf), channel_states(store))
            )
        except StoreFault:
            rows, counters, alarms = None, {}, []
        notices = {one.name: told.get(one.name, ChannelState()).waiting for one in self.service.channels}
        text, kind = exposition(self.service, len(self.hub), rows, alarms, counters, notices)
        return Response(text, headers={"Content-Type": kind})

    async def healthz(self, request: Request) -> Response:
        """200 while the tracker's loop and store work, else 503: then restarting it may help.

        It waits neither for other requests nor for the threads that answer them.
        """
        return self._said(await self._fault())

    async def readyz(self, request: Request) -> Response:
        """200 while readings can become estimates, else 503: also while a source has not been reached for
        longer than its limit."""
        now = self.service.now
        beyond = sum(one.share(now) >= 1.0 for one in self.service.reaches().values())
        sources = f"{beyond} of {len(self.service.streams)} sources are not reached" if beyond else ""
        return self._said(await self._fault() or sources)

    def _said(self, fault: str) -> Response:
        """The answer to a machine, with the number of sources in each state; it reveals no location and no
        turbine."""
        states = Counter(one.state.word for one in self.service.streams.values())
        body = {"fault": fault} if fault else {"ok": True}
        return reply({**body, "sources": states}, status=503 if fault else 200)

    async def _fault(self) -> str:
        """Why loop or store do not work; empty if they do."""
        if self.service.ending.is_set():
            return "the tracker is ending"
        if self.service.health.store:
            return "the tracker cannot reach its store"
        if time.monotonic() - self.service.health.looped > LOOP_S:
            return f"the tracker's loop has not gone round for {LOOP_S:g} s"
        return await self.answers.fault()
