"""The page against clients that mean no good: half-open connections, slow ones, input that nobody expects."""

from __future__ import annotations

import logging
import socket
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import httpx
import numpy as np
import pytest
from builders.live_case import live_turbine
from builders.malformed import malformed_request
from builders.page_case import Case, Fed, filled, recent_record, served
from builders.ports import open_files
from builders.service_case import running
from builders.waiting import eventually

from hygrokf.live.service import Service
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.web import server as web_server
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.live.web.server import BACKLOG, MOST_CONNECTIONS, PageServer

TOKEN = "a-token-of-the-tests-0123456789"
LOCAL, LOCKED = PageSettings(port=0), PageSettings(port=0, token=TOKEN)
MANY = 2_000


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Service:
    return filled(tmp_path_factory.mktemp("page"), [Case("T1")], days=2.0)


def connected(stack: ExitStack, server: PageServer, sent: bytes = b"") -> socket.socket:
    made = stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=20.0))
    made.sendall(sent)
    return made


def health(server: PageServer) -> float:
    """How long [s] a new connection waits for `/healthz`."""
    began = time.monotonic()
    answer = httpx.get(f"{server.url}healthz", verify=False, timeout=20.0)
    assert answer.status_code == 200, answer.text
    return time.monotonic() - began


# -- connections ---------------------------------------------------------------------------------------------
HALVES = [b"", b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nX-More: "]


@pytest.mark.parametrize("sent", HALVES, ids=["silent", "partial"])
def test_half_open_clients_stop_no_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sent: bytes
) -> None:
    """Each reading is committed soon while they come and stay; afterwards the page is there again."""
    record = recent_record(tmp_path / "record", 7, 2.0, 60.0 * (time.time() // 60.0))
    messages = record_messages(record, "T1")
    source = Fed("fed:", record_mapping(record, "T1"))
    service = Service({"T1": live_turbine(record)}, [source], f"sqlite:{tmp_path / 'live.db'}")
    waits, held_then = [], []
    monkeypatch.setattr(web_server, "REQUEST_SILENT_S", 4.0)

    def deliver() -> None:
        began, before = time.monotonic(), service.health.deliveries
        source.give([messages[len(waits)]])
        eventually(lambda: service.health.deliveries > before)
        waits.append(time.monotonic() - began)

    with served(service, LOCAL) as (_, server), running(service), open_files(3 * MANY), ExitStack() as stack:
        eventually(lambda: service.store)
        held = server.server.server_state.connections
        deliver()  # compiles the filter
        for number in range(MANY):
            with suppress(ConnectionError):  # one more than the page takes
                connected(stack, server, sent)
            if number % 50 == 49:
                deliver()
                held_then.append(len(held))
        # one is refused after it was accepted, which takes up to three rounds of the loop
        assert 0.9 * MOST_CONNECTIONS < max(held_then) <= MOST_CONNECTIONS + 3 * BACKLOG
        assert max(waits[1:]) < 2.0
        eventually(lambda: len(held) == 0)
        assert health(server) < 1.0


def test_a_connection_that_asks_nothing_is_closed(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server, "REQUEST_SILENT_S", 0.3)
    with served(service, LOCAL) as (_, server), ExitStack() as stack:
        silent, partial = (connected(stack, server, sent) for sent in HALVES)
        watching = connected(stack, server, b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        for one in (silent, partial):
            with suppress(ConnectionResetError):
                assert one.recv(1) == b""
        time.sleep(0.3)
        assert watching.recv(4096).startswith(b"HTTP/1.1 200")
        watching.settimeout(0.1)
        with suppress(TimeoutError):  # what has come is told, and the end would be
            while True:
                assert watching.recv(4096)


def test_health_waits_for_no_other_request(service: Service) -> None:
    with served(service, LOCAL) as (page, server), ExitStack() as stack:
        with page.reader._lock:  # as a view that takes long
            for _ in range(50):  # more than there are threads for
                connected(stack, server, b"GET /api/fleet HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert health(server) < 1.0
        eventually(lambda: httpx.get(f"{server.url}api/fleet", timeout=20.0).status_code == 200)


# -- input ---------------------------------------------------------------------------------------------------
SURROGATE = b'"\\ud800"'


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("/api/login", b'{"token": %s}' % SURROGATE, 401),
        ("/api/login", b'{"token": "%s"}' % ("x" * 3_000).encode(), 401),
        ("/api/login", b"\xff\xfe\x00", 401),
        ("/api/login", b'{"token": %s}' % (b"9" * 4_000), 401),
        ("/api/login", b'{"token": NaN}', 401),
        ("/api/alarms/acknowledge", b'{"id": %s, "by": "x"}' % SURROGATE, 400),
        ("/api/alarms/acknowledge", b'{"id": "x", "by": %s}' % SURROGATE, 400),
        ("/api/alarms/acknowledge", b'{"id": "a\\u0000", "by": "x"}', 400),
        ("/api/alarms/acknowledge", b"x", 400),
        ("/api/alarms/acknowledge", b"[" * 4_000, 400),
        ("/api/logout", b"[" * 4_000, 200),
    ],
)
def test_json_that_nobody_expects_is_refused_in_words(
    service: Service, path: str, body: bytes, status: int
) -> None:
    with served(service, LOCKED) as (_, server):
        headers = {"Content-Type": "application/json", "Authorization": f"Bearer {TOKEN}"}
        answer = httpx.post(f"{server.url.rstrip('/')}{path}", content=body, headers=headers, timeout=20.0)
        assert answer.status_code == status
        assert status == 200 or answer.json()["fault"]


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/api/turbine/T1?days=" + "1" * 5_000, {}, 400),
        ("/api/turbine/T1?days=%D9%A3", {}, 400),
        ("/api/turbine/T1?days=%ff", {}, 400),
        ("/api/turbine/%ff%00", {}, 404),
        ("/static/%00", {}, 404),
        ("/static/" + "a" * 5_000, {}, 404),
        ("/static/page.js", {"Range": "bytes=9-1,x"}, 400),
    ],
)
def test_addresses_that_nobody_expects_are_refused_in_words(
    service: Service, path: str, headers: dict, status: int
) -> None:
    with served(service, LOCAL) as (_, server), ExitStack() as stack:
        lines = [f"GET {path} HTTP/1.1", "Host: 127.0.0.1", "Connection: close"]
        lines += [f"{name}: {value}" for name, value in headers.items()]
        client = connected(stack, server, ("\r\n".join(lines) + "\r\n\r\n").encode())
        found = client.makefile("rb").read()
        assert found.split(b" ", 2)[1] == str(status).encode(), found


# -- anything ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("settings", [LOCAL, LOCKED], ids=["open", "with a token"])
def test_whatever_is_sent_the_server_is_at_no_fault(
    service: Service, settings: PageSettings, caplog: pytest.LogCaptureFixture
) -> None:
    random = np.random.default_rng(len(settings.token))
    statuses: dict[bytes, int] = {}
    with served(service, settings) as (_, server):
        for _ in range(1_000):
            head, body = malformed_request(random)
            with ExitStack() as stack:
                client = connected(stack, server, head + body)
                client.shutdown(socket.SHUT_WR)
                with suppress(ConnectionError):
                    found = client.recv(65_536)
                    status = found.split(b" ", 2)[1] if found.startswith(b"HTTP/") else b""
                    statuses[status] = statuses.get(status, 0) + 1
                    assert not status.startswith(b"5"), (head, body, found)
        assert health(server) < 1.0
    # an answer to a request that turned out to be malformed comes too late for the library, no more
    faults = [r.exc_info and r.exc_info[0].__name__ for r in caplog.records if r.levelno >= logging.ERROR]
    assert set(faults) <= {"LocalProtocolError"} and {b"200", b"400", b"404"} <= set(statuses), statuses
