"""Events: every commit is told once, to all who listen; who reads slowly costs nothing; the end comes in
time."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from builders.page_case import Case, filled
from builders.waiting import eventually

from hygrokf.live.batch import Alarm, Batch, Observation
from hygrokf.live.service import Service
from hygrokf.live.tracker import Reading
from hygrokf.live.web import server as web_events
from hygrokf.live.web.application import PageEndpoints
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.live.web.server import START_AND_STOP_S, Hub, PageServer, changed_turbines, serve

LOCAL = PageSettings(port=0)


class Listener:
    """A client of /events: what it was told, by kind."""

    def __init__(self, url: str) -> None:
        self.told: list[tuple[str, dict]] = []
        self.head = ""
        self.ended = False
        self._url = url
        self.thread = threading.Thread(target=self._listen, daemon=True)
        self.thread.start()
        eventually(lambda: self.told)

    def _listen(self) -> None:
        try:
            with httpx.stream("GET", f"{self._url}events", timeout=60.0) as answer:
                self.head = answer.headers["content-type"]
                kind = ""
                for line in answer.iter_lines():
                    if line.startswith("event: "):
                        kind = line.removeprefix("event: ")
                    elif line.startswith("data: "):
                        self.told.append((kind, json.loads(line.removeprefix("data: "))))
        finally:
            self.ended = True

    def changes(self) -> list:
        return [content["turbines"] for kind, content in self.told if kind == "changed"]


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Hub, PageServer]]:
    """A hub and a server of a page without turbines."""
    monkeypatch.setattr(web_events, "MESSAGE_PAUSE_S", 0.05)
    hub = Hub(most=3)
    with serve(PageEndpoints(Service({}, [], "sqlite:none"), hub, LOCAL).app(), LOCAL, hub) as server:
        yield hub, server


def test_a_change_is_told_to_all(page: tuple[Hub, PageServer]) -> None:
    hub, server = page
    one, two = Listener(server.url), Listener(server.url)
    assert one.head.startswith("text/event-stream") and one.told[0][0] == "alive" and len(hub) == 2
    hub.announce(["B", "A"])
    for listener in (one, two):
        eventually(listener.changes)
        assert listener.changes() == [["A", "B"]]
    hub.announce(["C"])
    eventually(lambda: one.changes()[1:] == [["C"]])
    hub.announce([str(n) for n in range(web_events.MOST_NAMED + 1)])
    eventually(lambda: one.changes()[2:] == [None])
    assert hub.generation == 3


def test_a_real_commit_is_told(tmp_path: Path) -> None:
    hub = Hub()
    batches: list[Batch] = []
    with serve(PageEndpoints(Service({}, [], "sqlite:none"), hub, LOCAL).app(), LOCAL, hub) as server:
        listener = Listener(server.url)

        def settle(batch: Batch) -> None:
            batches.append(batch)
            hub.settle(batch)

        filled(tmp_path, [Case("T1"), Case("T2")], days=2.0, settle=settle)
        eventually(lambda: {name for names in listener.changes() for name in names} == {"T1", "T2"})
        assert hub.generation == len(batches) > 0


def test_what_a_batch_changes() -> None:
    batch = Batch(
        observations=[Observation("A", Reading("rain", 1.0, 0.0), 2.0)],
        alarms=[Alarm("x", "B", "k", "alarm", 1.0, "", "")],
        properties=[("C", 1.0, [])],
        memories={("D", "forecast"): {}},
        counters={("E", "late"): 1, ("", "malformed"): 1},
    )
    assert changed_turbines(batch) == set("ABCDE") and changed_turbines(Batch()) == set()


def test_silence_is_broken_by_signs_of_life(
    page: tuple[Hub, PageServer], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web_events, "HEARTBEAT_S", 0.1)
    listener = Listener(page[1].url)
    eventually(lambda: len(listener.told) > 5)
    assert {kind for kind, _ in listener.told} == {"alive"} and listener.told[-1][1]["now"] <= time.time()


def test_clients_are_bounded_and_leave_room_behind(page: tuple[Hub, PageServer]) -> None:
    hub, server = page
    sockets = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(3)]
    for one in sockets:
        one.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    eventually(lambda: len(hub) == 3)
    refused = httpx.get(f"{server.url}events", timeout=60.0)
    assert refused.status_code == 503 and "too many" in refused.json()["fault"]
    sockets.pop().close()
    eventually(lambda: len(hub) == 2)
    Listener(server.url)
    for one in sockets:
        one.close()


def test_the_end_comes_in_time_with_open_streams() -> None:
    hub = Hub()
    with serve(PageEndpoints(Service({}, [], "sqlite:none"), hub, LOCAL).app(), LOCAL, hub) as server:
        listeners = [Listener(server.url) for _ in range(3)]
        began = time.monotonic()
    took = time.monotonic() - began
    assert not server.thread.is_alive() and took < START_AND_STOP_S
    for one in listeners:
        eventually(lambda one=one: one.ended)
    hub.announce(["A"])  # nobody is there, and nothing breaks
    assert len(hub) == 0
