"""The page's own connections to the store: one for the data of the page, one to check that the store
answers."""

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
STORE_PATIENCE_S = 0.5
"""[s] for which the page waits for an answer of the store before it repeats the previous answer."""
STORE_SILENT_S = 15.0
"""[s] without an answer after which the store counts as not reached."""
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
                result = view(self._store)
            except Exception as fault:
                self._close()
                # all other exceptions are bugs in the program
                is_of_store = isinstance(fault, StoreFault | sqlite3.Error | OSError)
                if not is_of_store and not type(fault).__module__.startswith("psycopg"):
                    raise
                if not self._failed:
                    LOG.warning("the page cannot reach the store", extra={"fault": str(fault).strip()})
                self._failed = True
                raise StoreFault("the store cannot be reached; the tracker's log says why") from fault
            self._failed = False
            return result

    def close(self) -> None:
        """Close the connection; the next read opens a new one."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        if self._store is not None:
            self._store.close()
            self._store = None


class StoreAnswers:
    """Checks that the store answers, in its own thread and over its own connection.

    Slow views, and requests that occupy all threads, therefore do not delay the check.
    """

    def __init__(self, service: Service) -> None:
        self._reader = Reader(service)
        self._query: asyncio.Future[str] | None = None
        self._began = 0.0
        self._fault = ""

    async def fault(self) -> str:
        """Why the store does not answer, "" if it does; returns within `STORE_PATIENCE_S`."""
        if self._query is None or self._query.done():
            self._query, self._began = self._start_query(), time.monotonic()
        query = self._query
        await asyncio.wait([query], timeout=STORE_PATIENCE_S)
        if query.done():
            self._fault = query.result()
        elif time.monotonic() - self._began > STORE_SILENT_S:
            self._fault = f"the store has not answered for {STORE_SILENT_S:g} s"
        return self._fault

    def _start_query(self) -> asyncio.Future[str]:
        """Start a daemon thread that queries the store, so that the program can end without an answer."""
        answer: Future[str] = Future()

        def query() -> None:
            try:
                self._reader.read(lambda store: store.rows(SCHEMA_NUMBER))
                answer.set_result("")
            except StoreFault as fault:
                answer.set_result(str(fault))
            except BaseException as fault:
                answer.set_exception(fault)

        threading.Thread(target=query, name="page health", daemon=True).start()
        return asyncio.wrap_future(answer)

    def close(self) -> None:
        self._reader.close()
