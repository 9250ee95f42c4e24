"""The page behind nginx, by the file that the documentation gives."""

from __future__ import annotations

import getpass
import json
import logging
import os
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import pytest
from builders.documents import DOCS
from builders.malformed import malformed_request
from builders.page_case import Case, filled, served, write_certificate
from builders.ports import free_port, open_files
from builders.waiting import eventually

from hygrokf.live.service import Service
from hygrokf.live.web import server as web_events
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.live.web.server import HEADERS, PageServer

TOKEN = "a-token-of-the-tests-0123456789"
BEARER = {"Authorization": f"Bearer {TOKEN}"}
BEHIND = PageSettings(port=0, token=TOKEN, behind_proxy=True)
HALF_OPEN = 2_000
PROGRAM = shutil.which("nginx", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")
pytestmark = pytest.mark.skipif(
    PROGRAM is None, reason="nginx is not installed (Debian and Ubuntu: apt-get install nginx)"
)


@dataclass
class Nginx:
    """A proxy that runs: its ports, and what clients need to trust it."""

    port: int
    plain: int
    trusted: ssl.SSLContext

    def client(self, address: str = "127.0.0.1") -> httpx.Client:
        """A client at an address of loopback, without the token."""
        transport = httpx.HTTPTransport(verify=self.trusted, local_address=address)
        return httpx.Client(base_url=f"https://127.0.0.1:{self.port}", transport=transport, timeout=60.0)


@contextmanager
def proxied(folder: Path, server: PageServer, *changes: tuple[str, str]) -> Iterator[Nginx]:
    """nginx before a page, with the connections that Debian gives it; `changes` of its file."""
    write_certificate(folder / "page.pem", folder / "page.key")
    port, plain = free_port(), free_port()
    to = f"http://{server.url}" if server.url.startswith("unix:") else server.url.rstrip("/")
    text = (DOCS / "live_files" / "nginx.conf").read_text(encoding="utf-8")
    for old, new in (
        ("listen 443 ", f"listen 127.0.0.1:{port} "),
        ("listen 80;", f"listen 127.0.0.1:{plain};"),
        ("/etc/ssl/hygrokf/", f"{folder}/"),
        ("http://127.0.0.1:8080", to),
        *changes,
    ):
        assert old in text
        text = text.replace(old, new)
    (folder / "hygrokf.conf").write_text(text)
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    (folder / "nginx.conf").write_text(
        f"user {getpass.getuser()} {getpass.getuser()}; daemon off; master_process off; pid {folder}/pid;\n"
        "events { worker_connections 768; }\n"
        "http { access_log off; "
        + "".join(f"{kind}_temp_path {folder}/{kind}; " for kind in kinds)
        + f"include {folder}/hygrokf.conf; }}\n"
    )
    log = folder / "error.log"
    process = subprocess.Popen([PROGRAM, "-p", folder, "-e", log, "-c", folder / "nginx.conf"])
    try:
        eventually(lambda: process.poll() is not None or listens(port))
        assert process.poll() is None, log.read_text()
        yield Nginx(port, plain, ssl.create_default_context(cafile=str(folder / "page.pem")))
    finally:
        process.terminate()
        process.wait(timeout=30.0)


def listens(port: int) -> bool:
    with suppress(OSError):
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
        return True
    return False


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Service:
    return filled(tmp_path_factory.mktemp("page"), [Case("T1")], days=2.0)


@pytest.mark.parametrize("unix", [False, True], ids=["loopback", "Unix socket"])
def test_a_browser_logs_in_through_nginx(service: Service, tmp_path: Path, unix: bool) -> None:
    """TLS, HTTP/2, the session's cookie for https alone, and the rules about origins on a port of its own."""
    at = PageSettings("localhost", 0, token=TOKEN, behind_proxy=True, unix=str(tmp_path / "page.sock"))
    with (
        served(service, at if unix else BEHIND) as (_, server),
        proxied(tmp_path, server) as nginx,
        nginx.client() as client,
    ):
        assert client.get("/api/fleet").status_code == 401
        own = f"https://127.0.0.1:{nginx.port}"
        assert client.post("/api/logout", json={}, headers={"Origin": "https://127.0.0.1"}).status_code == 403
        answer = client.post("/api/login", json={"token": TOKEN}, headers={"Origin": own})
        cookie = answer.headers["set-cookie"]
        assert cookie.startswith("__Host-hygrokf_") and "; Secure" in cookie and "HttpOnly" in cookie
        answer = client.get("/api/fleet", headers={"X-Forwarded-Proto": "http"})
        assert [row["turbine"] for row in answer.json()["turbines"]] == ["T1"]
        for name, value in HEADERS:
            assert answer.headers.get_list(name.decode()) == [value.decode()]
        assert client.get("/", headers={"Host": "evil.example"}).status_code == 421
        plain = httpx.get(f"http://127.0.0.1:{nginx.plain}/api/fleet")
        assert (plain.status_code, plain.headers["location"]) == (301, "https://127.0.0.1/api/fleet")
        nginx.trusted.set_alpn_protocols(["h2", "http/1.1"])
        with socket.create_connection(("127.0.0.1", nginx.port)) as bare:
            with nginx.trusted.wrap_socket(bare, server_hostname="127.0.0.1") as secured:
                assert secured.selected_alpn_protocol() == "h2"


def test_events_come_through_nginx_at_once(service: Service, tmp_path: Path) -> None:
    with (
        served(service, BEHIND) as (page, server),
        proxied(tmp_path, server) as nginx,
        nginx.client() as client,
        client.stream("GET", "/events", headers=BEARER) as answer,
    ):
        lines = (line for line in answer.iter_lines() if line.startswith("data: "))
        assert "now" in json.loads(next(lines)[6:])  # a sign of life
        for name in ("A", "B"):
            began = time.monotonic()
            page.hub.announce([name])
            assert json.loads(next(lines)[6:])["turbines"] == [name]
            assert time.monotonic() - began < 5.0


def test_a_page_that_takes_nothing_is_dropped_by_nginx(
    service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web_events, "MESSAGE_PAUSE_S", 0.0)
    names = ["x" * 100 + str(number) for number in range(web_events.MOST_NAMED)]
    with (
        served(service, BEHIND) as (page, server),
        proxied(tmp_path, server, ("send_timeout 10s", "send_timeout 1s")) as nginx,
        nginx.trusted.wrap_socket(socket.socket(), server_hostname="127.0.0.1") as slow,
    ):
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect(("127.0.0.1", nginx.port))
        slow.sendall(
            f"GET /events HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {TOKEN}\r\n\r\n".encode()
        )
        eventually(lambda: len(page.hub) == 1)

        def dropped() -> bool:
            page.hub.announce(names)
            return len(page.hub) == 0

        eventually(dropped)


def test_wrong_tokens_of_one_address_are_limited(service: Service, tmp_path: Path) -> None:
    with (
        served(service, BEHIND) as (_, server),
        proxied(tmp_path, server) as nginx,
        nginx.client() as one,
        nginx.client("127.0.0.2") as other,
    ):
        statuses = [one.post("/api/login", json={"token": "wrong"}).status_code for _ in range(12)]
        assert statuses[:10] == [401] * 10 and statuses[-1] == 429
        answer = one.post("/api/login", json={"token": TOKEN})
        assert answer.status_code == 429 and "try again" in answer.json()["fault"]
        assert int(answer.headers["retry-after"]) > 0
        assert one.get("/api/fleet", headers=BEARER).status_code == 200
        assert other.post("/api/login", json={"token": TOKEN}).status_code == 200


def test_half_open_clients_of_nginx_keep_nobody_out(service: Service, tmp_path: Path) -> None:
    """Neither silent ones nor those within a TLS handshake, more than nginx has connections for."""
    with (
        served(service, BEHIND) as (_, server),
        open_files(3 * HALF_OPEN),
        proxied(tmp_path, server) as nginx,
        ExitStack() as stack,
    ):
        waits = []
        for number in range(HALF_OPEN):
            client = stack.enter_context(socket.create_connection(("127.0.0.1", nginx.port), timeout=20.0))
            if number % 8 == 0:
                client.sendall(b"\x16\x03\x01\x02\x00\x01")  # the beginning of a client's greeting
            if number % 200 == 199:
                with nginx.client() as asking:
                    began = time.monotonic()
                    assert asking.get("/api/fleet", headers=BEARER).status_code == 200
                    waits.append(time.monotonic() - began)
        assert max(waits) < 2.0
        assert len(server.server.server_state.connections) <= 1  # none of them reaches the page


def test_whatever_is_sent_through_nginx_the_page_is_at_no_fault(
    service: Service, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    random = np.random.default_rng(20)
    with (
        served(service, BEHIND) as (_, server),
        proxied(tmp_path, server, ("rate=50r/s", "rate=100000r/s")) as nginx,
        nginx.client() as client,
    ):
        statuses = set()
        for _ in range(500):
            with (
                socket.create_connection(("127.0.0.1", nginx.port), timeout=20.0) as bare,
                nginx.trusted.wrap_socket(bare, server_hostname="127.0.0.1") as secured,
                suppress(ConnectionError, ssl.SSLError, TimeoutError),
            ):
                head, body = malformed_request(random)
                secured.settimeout(2.0)
                secured.sendall(head + body)
                statuses.add(secured.recv(4096)[9:12])
        assert client.get("/api/fleet", headers=BEARER).status_code == 200
    assert [r.getMessage() for r in caplog.records if r.levelno >= logging.ERROR] == []
    assert {b"200", b"400", b"401"} <= statuses
