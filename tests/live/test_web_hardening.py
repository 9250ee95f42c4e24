"""The page against clients that mean no good: half-open connections, slow ones, input that nobody expects."""

from __future__ import annotations

import http.client
import logging
import resource
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest
from builders.page_case import Case, filled, write_certificate
from builders.waiting import eventually

from hygrokf.live.service import Service
from hygrokf.live.web import access, connections, exchange
from hygrokf.live.web.application import Page
from hygrokf.live.web.connections import WAITING_OF_ADDRESS, Connections
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.live.web.server import Hub, PageServer, serve

TOKEN = "a-token-of-the-tests-0123456789"
LOCAL, LOCKED = PageSettings(port=0), PageSettings(port=0, token=TOKEN)
MANY = 1_000


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Service:
    return filled(tmp_path_factory.mktemp("page"), [Case("T1")], days=2.0)


@contextmanager
def served(service: Service, settings: PageSettings = LOCAL) -> Iterator[tuple[Page, PageServer]]:
    hub = Hub()
    page = Page(service, hub, settings)
    with serve(page.app(), settings, hub) as server:
        yield page, server
    page.close()


@pytest.fixture(scope="module", autouse=True)
def files() -> Iterator[None]:
    """As many open files as the tests need."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(max(soft, 4 * MANY), hard), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def connected(stack: ExitStack, server: PageServer, sent: bytes = b"") -> socket.socket:
    made = stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=20.0))
    made.sendall(sent)
    return made


def is_closed(one: socket.socket) -> bool:
    """Whether the server has ended a connection without a word."""
    before = one.gettimeout()
    one.settimeout(0.0)
    try:
        return one.recv(1, socket.MSG_PEEK) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True
    finally:
        one.settimeout(before)


def health(server: PageServer) -> float:
    """How long [s] a new connection waits for `/healthz`."""
    began = time.monotonic()
    answer = httpx.get(f"{server.url}healthz", verify=False, timeout=20.0)
    assert answer.status_code == 200, answer.text
    return time.monotonic() - began


# -- connections ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("sent", [b"", b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nX-More: "])
def test_a_thousand_half_open_connections_keep_nobody_out(service: Service, sent: bytes) -> None:
    with served(service) as (_, server), ExitStack() as stack:
        waits = []
        for number in range(MANY):
            connected(stack, server, sent)
            if number % 100 == 99:
                waits.append(health(server))
        assert max(waits) < 1.0
        assert httpx.get(f"{server.url}api/fleet", timeout=20.0).status_code == 200


def test_half_open_tls_handshakes_keep_nobody_out(service: Service, tmp_path: Path) -> None:
    certificate, key = tmp_path / "page.pem", tmp_path / "page.key"
    write_certificate(certificate, key)
    settings = PageSettings(port=0, certificate=str(certificate), key=str(key))
    with served(service, settings) as (_, server), ExitStack() as stack:
        clients = [connected(stack, server) for _ in range(3 * WAITING_OF_ADDRESS)]
        assert health(server) < 1.0
        eventually(lambda: sum(map(is_closed, clients)) >= 2 * WAITING_OF_ADDRESS)


def test_a_connection_that_asks_nothing_is_closed(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "HEADER_S", 2.0)
    monkeypatch.setattr(connections, "IDLE_S", 0.4)
    monkeypatch.setattr(connections, "SWEEP_S", 0.05)
    with served(service) as (_, server), ExitStack() as stack:
        silent = connected(stack, server)
        partial = connected(stack, server, b"GET / HT")
        eventually(lambda: is_closed(silent) and is_closed(partial))
        request = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
        used = connected(stack, server, request)
        answer = http.client.HTTPResponse(used)
        answer.begin()
        assert answer.status == 200 and answer.read()  # whole, since what is unread hides the end
        used.sendall(b"GET /heal")  # the half of a further request
        eventually(lambda: is_closed(used))
        watching = connected(stack, server, b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert watching.recv(4096).startswith(b"HTTP/1.1 200")
        time.sleep(0.8)
        assert not b"" == watching.recv(4096)  # an event stream stays


def test_the_oldest_connection_gives_way() -> None:
    """Per address and altogether; one whose request is being answered is not among those that wait."""
    import asyncio

    async def run() -> None:
        held = Connections(of_address=2)
        pairs = [socket.socketpair() for _ in range(connections.WAITING + 3)]
        for number, (inside, _) in enumerate(pairs[:3]):
            held.enter(inside, ("a", number))
        assert [is_closed(outside) for _, outside in pairs[:3]] == [True, False, False]
        pairs[1][0].close()  # this one has gone by itself
        held.enter(pairs[3][0], ("a", 3))
        assert [is_closed(outside) for _, outside in pairs[2:4]] == [False, False]
        for number, (inside, _) in enumerate(pairs[4:]):
            held.enter(inside, (f"b{number}", 1))
        assert len(held) == connections.WAITING
        assert is_closed(pairs[2][1]) and not is_closed(pairs[-1][1])
        for pair in pairs:
            for one in pair:
                one.close()

    asyncio.run(run())


def test_the_only_connection_is_closed_after_a_slow_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    import asyncio

    monkeypatch.setattr(connections, "IDLE_S", 0.05)
    monkeypatch.setattr(connections, "SWEEP_S", 0.02)

    async def run() -> None:
        held = Connections()
        inside, outside = socket.socketpair()

        async def app(*_: object) -> None:
            while held._sweeping:  # as long as it takes until nothing waits and nobody sweeps
                await asyncio.sleep(0.01)

        async def unused(*_: object) -> None: ...

        with inside, outside:
            held.enter(inside, ("a", 1))
            await held.limited(app)({"client": ("a", 1), "path": "/"}, unused, unused)
            assert not is_closed(outside)
            async with asyncio.timeout(30.0):
                while not is_closed(outside):
                    await asyncio.sleep(0.01)

    asyncio.run(run())


def test_a_body_that_does_not_come_is_given_up(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange, "BODY_S", 0.2)
    with served(service) as (_, server), ExitStack() as stack:
        head = b"POST /api/alarms/acknowledge HTTP/1.1\r\nHost: 127.0.0.1\r\n"
        head += b"Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{"
        assert connected(stack, server, head).recv(4096).startswith(b"HTTP/1.1 400")


def test_health_waits_for_no_other_request(service: Service) -> None:
    with served(service) as (page, server), ExitStack() as stack:
        with page.reader._lock:  # as a view that takes long
            for _ in range(50):  # more than there are threads for
                connected(stack, server, b"GET /api/fleet HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert health(server) < 1.0
        eventually(lambda: httpx.get(f"{server.url}api/fleet", timeout=20.0).status_code == 200)


def test_too_many_requests_are_told_to_come_back(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "REQUESTS", 0)
    with served(service) as (_, server):
        answer = httpx.get(f"{server.url}api/fleet", timeout=20.0)
        assert answer.status_code == 503 and "retry-after" in answer.headers
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert health(server) < 1.0


# -- tokens --------------------------------------------------------------------------------------------------
def test_wrong_tokens_lock_out_wrong_tokens_alone(service: Service, caplog: pytest.LogCaptureFixture) -> None:
    with served(service, LOCKED) as (_, server), httpx.Client(base_url=server.url, timeout=20.0) as client:
        right, wrong = {"Authorization": f"Bearer {TOKEN}"}, {"Authorization": "Bearer wrong"}
        for _ in range(access.GUESSES // 2):
            assert client.post("/api/login", json={"token": "wrong"}).status_code == 401
            assert client.get("/api/fleet", headers=wrong).status_code == 401
        answer = client.post("/api/login", json={"token": "wrong"})
        assert answer.status_code == 429 and int(answer.headers["retry-after"]) > 200
        assert client.get("/api/fleet", headers=wrong).status_code == 429
        assert client.get("/api/fleet", headers=right).status_code == 200
        assert client.post("/api/login", json={"token": TOKEN}).status_code == 200
        client.cookies.clear()
        assert client.get("/api/fleet", headers=wrong).status_code == 429
    said = [r for r in caplog.records if r.message == "too many wrong tokens"]
    assert [r.address for r in said] == ["127.0.0.1"]


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
    with served(service) as (_, server), ExitStack() as stack:
        lines = [f"GET {path} HTTP/1.1", "Host: 127.0.0.1", "Connection: close"]
        lines += [f"{name}: {value}" for name, value in headers.items()]
        client = connected(stack, server, ("\r\n".join(lines) + "\r\n\r\n").encode())
        found = client.makefile("rb").read()
        assert found.split(b" ", 2)[1] == str(status).encode(), found


@pytest.mark.parametrize("method", ["HEAD", "GET", "POST", "CONNECT"])
def test_a_body_that_is_malformed_is_no_fault_of_the_server(
    service: Service, method: str, caplog: pytest.LogCaptureFixture
) -> None:
    head = f"{method} / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n".encode()
    with served(service) as (_, server), ExitStack() as stack:
        assert b" 400 " in connected(stack, server, head + b"zz\r\n").recv(4096).partition(b"\r\n")[0]
    assert [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING] == []


def test_an_origin_that_is_no_address_is_refused(service: Service) -> None:
    with served(service) as (_, server):
        headers = {"Content-Type": "application/json", "Origin": "http://["}
        answer = httpx.post(f"{server.url}api/logout", content=b"{}", headers=headers, timeout=20.0)
        assert answer.status_code == 403


# -- anything ------------------------------------------------------------------------------------------------
PIECES = [
    b"/", b"/api/fleet", b"/api/turbine/", b"/api/alarms", b"/api/alarms/acknowledge", b"/api/login",
    b"/static/", b"/metrics", b"T1", b"..", b"%2e%2e", b"%00", b"%ff", b"%ed%a0%80", b"%", b"?days=", b"&",
    b"\xc3\xa4", b"99999999999999999999", b"-1", b"*", b"http://evil/", b"//", b"#", b";", b"\\", b"'",
    b'"', b"{}", b"a" * 300,
]  # fmt: skip
HEADS = [
    b"Cookie: hygrokf_0=\xff.1", b'Cookie: hygrokf_0="\\777"; $x', b"Cookie: =;;=\x01",
    b"Authorization: Bearer \xff", b"Authorization: \x80", b"Origin: http://[", b"Origin: \xff",
    b"Content-Length: -1", b"Content-Length: 5", b"Content-Length: 99999999999",
    b"Transfer-Encoding: chunked", b"Content-Type: application/json", b"Content-Type: application/json;\xff",
    b"Accept-Encoding: gzip;q=\xff", b"Range: bytes=1-0", b"Range: bytes=-9",
    b"If-Modified-Since: nonsense", b"If-None-Match: \xff", b"Upgrade: websocket\r\nConnection: Upgrade",
    b"Expect: 100-continue", b"X-Forwarded-For: \xff, [", b"Host: evil", b"X: " + b"y" * 2_000, b": x",
    b"\x00: x",
]  # fmt: skip
METHODS = [b"GET", b"POST", b"HEAD", b"PUT", b"OPTIONS", b"CONNECT", b"get", b"\xff"]
VERSIONS = [b"HTTP/1.1", b"HTTP/1.1", b"HTTP/1.0", b"HTTP/9"]
BODIES = [b"", b"{}", b'{"token": "\\ud800"}', b'{"id": "\\udfff", "by": "\\ud800"}', b"\xff\xfe",
          b"5\r\n{}\r\n", b"[" * 3_000, b'{"id": 1e999}', b"zz\r\n"]  # fmt: skip


@pytest.mark.parametrize("settings", [LOCAL, LOCKED], ids=["open", "with a token"])
def test_whatever_is_sent_the_server_is_at_no_fault(
    service: Service, settings: PageSettings, caplog: pytest.LogCaptureFixture
) -> None:
    random = np.random.default_rng(len(settings.token))
    statuses: dict[bytes, int] = {}
    with served(service, settings) as (_, server):
        for _ in range(1_000):
            method = random.choice(METHODS)
            target = b"/" * random.integers(2) + b"".join(random.choice(PIECES, random.integers(1, 4)))
            heads = [b"Host: 127.0.0.1", *random.choice(HEADS, random.integers(0, 4))]
            if random.random() < 0.5:
                heads.append(b"Content-Type: application/json")
            version = random.choice(VERSIONS)
            sent = b" ".join([method, target, version]) + b"\r\n" + b"\r\n".join(heads) + b"\r\n\r\n"
            with ExitStack() as stack:
                client = connected(stack, server, sent + random.choice(BODIES))
                client.shutdown(socket.SHUT_WR)
                with ExitStack() as may_break:
                    may_break.enter_context(_broken_is_fine())
                    found = client.recv(65_536)
                    status = found.split(b" ", 2)[1] if found.startswith(b"HTTP/") else b""
                    statuses[status] = statuses.get(status, 0) + 1
                    assert not status.startswith(b"5"), (sent, found)
        assert health(server) < 1.0
    errors = [r.getMessage() for r in caplog.records if r.levelno >= logging.ERROR]
    assert errors == [] and {b"200", b"400", b"404"} <= set(statuses), statuses


@contextmanager
def _broken_is_fine() -> Iterator[None]:
    try:
        yield
    except ConnectionError:
        pass
