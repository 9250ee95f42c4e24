"""The page's own connections to the store: one for what is shown, and one to see whether it answers."""

from __future__ import annotations

import asyncio
import logging
import sqlite3
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

from hygrokf.live.service import Service
from hygrokf.live.storage.statements import SCHEMA_NUMBER
from hygrokf.live.storage.store import Store, StoreFault, open_store

LOG = logging.getLogger("hygrokf.page")
PATIENCE_S = 0.5
"""[s] an answer of the store is waited for before the last one is told again."""
SILENT_S = 15.0
"""[s] after which a store that does not answer counts as not reached."""
T = TypeVar("T")


class Reader:
    """The page's own connection to the store, used by one thread at a time and reopened after a failure.

    The tracker opens the store first, so that only the tracker creates its tables.
    """

    def __init__(self, service: Service) -> None:
        self._service = service
        self._lock = threading.Lock()
        self._store: Store | None = None
        self._failed = False

    def read(self, view: Callable[[Store], T]) -> T:
        """Apply `view` to the store and return its result.  Raises StoreFault if the store cannot be
        reached."""
        with self._lock:
            if self._service.store is None:
                raise StoreFault("the tracker has not opened its store yet")
            try:
                if self._store is None:
                    self._store = open_store(self._service.store_url)
                found = view(self._store)
            except Exception as fault:
                self._close()
                # from the database, of either kind, and not from a bug in the program
                known = isinstance(fault, StoreFault | sqlite3.Error | OSError)
                if not known and not type(fault).__module__.startswith("psycopg"):
                    raise
                if not self._failed:
                    LOG.warning("the page cannot reach the store", extra={"fault": str(fault).strip()})
                self._failed = True
                raise StoreFault("the store cannot be reached; the tracker's log says why") from fault
            self._failed = False
            return found

    def close(self) -> None:
        """Close the connection; the next read opens a new one."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        if self._store is not None:
            self._store.close()
            self._store = None


class StoreAnswers:
    """Whether the store answers, asked in a thread and over a connection of its own.

    Views that take long, and requests that occupy all threads, therefore do not delay it.
    """

    def __init__(self, service: Service) -> None:
        self._reader = Reader(service)
        self._asked: asyncio.Future[str] | None = None
        self._began = 0.0
        self._fault = ""

    async def fault(self) -> str:
        """Why the store does not answer, empty if it does; known within `PATIENCE_S`."""
        if self._asked is None or self._asked.done():
            self._asked, self._began = self._ask(), time.monotonic()
        asked = self._asked
        await asyncio.wait([asked], timeout=PATIENCE_S)
        if asked.done():
            self._fault = asked.result()
        elif time.monotonic() - self._began > SILENT_S:
            self._fault = f"the store has not answered for {SILENT_S:g} s"
        return self._fault

    def _ask(self) -> asyncio.Future[str]:
        """Start a thread that asks the store; the end of the program does not wait for it."""
        found: Future[str] = Future()

        def ask() -> None:
            try:
                self._reader.read(lambda store: store.rows(SCHEMA_NUMBER))
                found.set_result("")
            except StoreFault as fault:
                found.set_result(str(fault))
            except BaseException as fault:
                found.set_exception(fault)

        threading.Thread(target=ask, name="page health", daemon=True).start()
        return asyncio.wrap_future(found)

    def close(self) -> None:
        self._reader.close()
