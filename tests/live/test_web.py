"""The page's endpoints, asked as a browser and as a machine would, of a server that runs."""

from __future__ import annotations

import gzip
import platform
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from builders.page_case import Case, add_forecast, filled, opened, served
from builders.ports import free_port
from builders.store_case import queried
from prometheus_client.parser import text_string_to_metric_families

from hygrokf.live.batch import TURBINE_STATES, Alarm, Batch
from hygrokf.live.service import Service
from hygrokf.live.web import server as web_access
from hygrokf.live.web.application import STATIC, PageEndpoints
from hygrokf.live.web.page_settings import PageFault, PageSettings
from hygrokf.live.web.server import Hub, PageServer, Sessions, serve
from hygrokf.version import __version__

NAMES = ("T1", "A/B <b>&%3F")
TOKEN = "a-token-of-the-tests-0123456789"
LOCAL = PageSettings(port=0)
LOCKED = PageSettings(port=0, token=TOKEN)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Service:
    made = filled(tmp_path_factory.mktemp("page"), [Case(name) for name in NAMES], days=2.0)
    store = opened(made)
    add_forecast(store, "T1", "no pre-heating is needed")
    store.commit(Batch(counters={("", "malformed"): 3, ("T1", "late"): 2}))
    store.close()
    return made


@contextmanager
def asked(service: Service, settings: PageSettings = LOCAL) -> Iterator[tuple[httpx.Client, Hub, PageServer]]:
    """A client of a page that runs, its hub, its server."""
    with (
        served(service, settings) as (page, server),
        httpx.Client(base_url="" if settings.unix else server.url, timeout=60.0) as client,
    ):
        yield client, page.hub, server


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[httpx.Client]:
    with asked(service) as (client, _, _):
        yield client


@pytest.fixture(scope="module")
def locked(service: Service) -> Iterator[httpx.Client]:
    with asked(service, LOCKED) as (client, _, _):
        yield client


def raised(service: Service, name: str, **more: object) -> Alarm:
    """An alarm that stands in the store."""
    alarm = Alarm(
        name, "T1", "condensation", "warning", time.time() - 60.0, "water <condenses>", "dry it", **more
    )
    store = opened(service)
    store.commit(Batch(alarms=[alarm]))
    store.close()
    return alarm


# -- what is shown -------------------------------------------------------------------------------------------
def test_the_fleet_is_the_stores(client: httpx.Client, service: Service) -> None:
    began = time.time()
    found = client.get("/api/fleet").json()
    assert began - 1e-3 <= found["now"] <= time.time() + 1e-3
    rows = {row["turbine"]: row for row in found["turbines"]}
    assert set(rows) == set(NAMES)
    store = opened(service)
    for name in NAMES:
        ((kelvin, humidity, chance, at),) = queried(
            store,
            "SELECT temperature_K, relative_humidity, condensation, time FROM estimate WHERE turbine = ? "
            "ORDER BY time DESC LIMIT 1",
            (name,),
        )
        assert rows[name]["temperature"] == pytest.approx(kelvin - 273.15, abs=1e-4)
        assert rows[name]["relative_humidity"] == pytest.approx(100.0 * humidity, abs=1e-4)
        assert (rows[name]["condensation"], rows[name]["time"]) == (chance, at)
    states = store.assessments()
    assert {name: row["state"] for name, row in rows.items()} == {n: one.state for n, one in states.items()}
    assert found["summary"] == {s: [o.state for o in states.values()].count(s) for s in TURBINE_STATES}
    assert all(row["reason"] and row["since"] for row in rows.values())
    (most,) = queried(store, "SELECT MAX(condensation) FROM forecast WHERE time >= ?", (found["now"],))
    store.close()
    assert rows["T1"]["forecast"]["condensation"] == most[0] and rows[NAMES[1]]["forecast"] is None


def test_a_turbine_of_any_name(client: httpx.Client) -> None:
    assert client.get("/api/turbine/A%2FB%20%3Cb%3E%26%253F").json()["turbine"] == NAMES[1]
    found = client.get("/api/turbine/T1", params={"days": 1}).json()
    assert len(found["time"]) == len(found["courses"]["margin"]["upper"]) > 50
    assert min(found["time"]) >= found["now"] - 86400.0
    assert len(client.get("/api/turbine/T1", params={"days": 3}).json()["time"]) > len(found["time"])
    assert found["forecast"]["advice"] == "no pre-heating is needed"
    hours = dict(found["hours"]["past"])
    last = found["time"][-1] // 3600.0 * 3600.0
    inside = [p for t, p in zip(found["time"], found["condensation"], strict=True) if t >= last]
    assert hours[last] == max(inside) and len(found["hours"]["forecast"]) == pytest.approx(36, abs=1)
    humid = found["humid"]
    assert humid["limit"] == 0.8 and humid["forecast"] and {t for t, _ in humid["past"]} == set(hours)
    assert all(0.0 <= p <= 1.0 for _, p in humid["past"])
    signals = {one["signal"]: one for one in found["signals"]}
    assert (
        signals["cabinet_temperature"]["unit"] == "degC"
        and 0.0 < signals["cabinet_temperature"]["value"] < 60.0
    )
    assert found["counts"]["late"] == 2


@pytest.mark.parametrize(
    ("path", "status", "said"),
    [
        ("/api/turbine/T9", 404, "no such turbine"),
        ("/api/turbine/T1?days=2", 400, "days must be one of 1, 3, 7, 14"),
        ("/api/turbine/T1?days=x", 400, "days must be one of"),
    ],
)
def test_what_is_not_there_is_said(client: httpx.Client, path: str, status: int, said: str) -> None:
    found = client.get(path)
    assert found.status_code == status and said in found.json()["fault"]


def test_health(client: httpx.Client, service: Service) -> None:
    found = client.get("/api/health").json()
    assert found["deliveries"] == service.health.deliveries > 0 and found["refused"] == {"malformed": 3}
    assert [one["state"] for one in found["sources"]] == ["ended", "ended"]
    for path in ("/healthz", "/readyz"):
        assert client.get(path).json() == {"ok": True, "sources": {"ended": 2}}


def test_every_answer_binds_the_browser(client: httpx.Client) -> None:
    for path in ("/", "/static/page.js", "/api/fleet", "/nothing", "/api/turbine/T9", "/metrics"):
        headers = client.get(path).headers
        policy = headers["content-security-policy"]
        assert (
            "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "unsafe" not in policy
        )
        assert headers["x-content-type-options"] == "nosniff" and headers["referrer-policy"] == "no-referrer"
        assert headers["cross-origin-opener-policy"] == "same-origin" and "server" not in headers
        assert headers["cache-control"] == ("no-cache" if path in ("/", "/static/page.js") else "no-store")


def test_the_page_is_small() -> None:
    """What a telephone loads: the page's files, compressed, with the charts' library [bytes]."""
    files = [file for file in STATIC.iterdir() if file.suffix in (".js", ".css", ".html", ".svg")]
    assert sum(len(gzip.compress(file.read_bytes(), 5)) for file in files) < 60_000


SVG = "http://www.w3.org/2000/svg"
"""The name of SVG's elements, which no browser asks for."""


def test_the_page_asks_for_its_own_files_alone(client: httpx.Client) -> None:
    text = client.get("/").text
    named = re.findall(r'(?:src|href)="([^"#]+)"', text)
    assert {"static/page.js", "static/page.css", "static/uPlot.iife.min.js"} <= set(named)
    for name in named:
        assert not re.match(r"\w+:|//", name) and client.get(f"/{name}").status_code == 200
    for file in STATIC.glob("*.js"):
        if not file.name.startswith("uPlot"):
            source = file.read_text(encoding="utf-8").replace(SVG, "")
            assert not re.search(
                r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|https?://", source
            )
            for name in re.findall(r'from "\./([\w.]+)"', source):
                assert (STATIC / name).is_file()
    assert (
        client.get("/static/../web.py").status_code == client.get("/static/%2e%2e/web.py").status_code == 404
    )


def test_files_are_not_sent_twice(client: httpx.Client) -> None:
    tag = client.get("/static/page.css").headers["etag"]
    assert client.get("/static/page.css", headers={"If-None-Match": tag}).status_code == 304


# -- acknowledging -------------------------------------------------------------------------------------------
def unseen(service: Service, alarm: str) -> bool:
    store = opened(service)
    found = queried(store, "SELECT acknowledged FROM alarm WHERE id = ?", (alarm,))
    store.close()
    return found == [(None,)]


@pytest.mark.parametrize(
    "headers",
    [
        {"Content-Type": "text/plain"},
        {"Content-Type": "application/x-www-form-urlencoded"},
        {"Content-Type": "application/json", "Sec-Fetch-Site": "cross-site"},
        {"Content-Type": "application/json", "Sec-Fetch-Site": "same-site"},
        {"Content-Type": "application/json", "Origin": "http://evil.example"},
        {"Content-Type": "application/json", "Origin": "null"},
        {"Content-Type": "application/json", "Origin": "http://["},
    ],
)
def test_another_site_cannot_acknowledge(client: httpx.Client, service: Service, headers: dict) -> None:
    raised(service, "three")
    answer = client.post("/api/alarms/acknowledge", content='{"id": "three", "by": "x"}', headers=headers)
    assert answer.status_code == 403 and unseen(service, "three")


def test_the_page_itself_may(client: httpx.Client, service: Service) -> None:
    raised(service, "four")
    own = {"Sec-Fetch-Site": "same-origin", "Origin": str(client.base_url).rstrip("/")}
    assert (
        client.post("/api/alarms/acknowledge", json={"id": "four", "by": "x"}, headers=own).status_code == 200
    )
    assert not unseen(service, "four")
    assert client.get("/api/alarms/acknowledge").status_code == 405


def test_a_name_that_was_bent_to_the_page_is_refused(client: httpx.Client, service: Service) -> None:
    for host in ("evil.example", "evil.example:8080", "127.0.0.2", "localhost.evil.example", "[::2]:80", ""):
        answer = client.get("/api/fleet", headers={"Host": host})
        assert answer.status_code in (400, 421), host
        assert "turbines" not in answer.text
    for host in ("localhost", "LOCALHOST:1", "localhost.", "[::1]:80", "127.0.0.1"):
        assert client.get("/api/fleet", headers={"Host": host}).status_code == 200
    with asked(service, PageSettings(port=0, hosts=("Farm.Example",))) as (other, _, _):
        assert other.get("/api/fleet", headers={"Host": "farm.example:443"}).status_code == 200


# -- metrics -------------------------------------------------------------------------------------------------
def measured(client: httpx.Client) -> dict[tuple, float]:
    answer = client.get("/metrics")
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/plain")
    families = text_string_to_metric_families(answer.text)
    return {(s.name, *sorted(s.labels.items())): s.value for family in families for s in family.samples}


def test_metrics_are_the_stores(service: Service) -> None:
    raised(service, "five")
    # a page of its own: the others' keeps the fleet's rows for some seconds, and this alarm comes past the
    # tracker
    with asked(service) as (client, _, _):
        began = time.time()
        found = measured(client)
        ended = time.time()
        rows = {row["turbine"]: row for row in client.get("/api/fleet").json()["turbines"]}
    assert found["hygrokf_deliveries_total",] == service.health.deliveries
    assert found["hygrokf_refused_total", ("kind", "malformed")] == 3.0
    assert found["hygrokf_set_aside_total", ("kind", "late"), ("turbine", "T1")] == 2.0
    assert found["hygrokf_source_state", ("source", "replay:T1"), ("state", "ended")] == 1.0
    assert found["hygrokf_store_reached",] == 1.0
    assert 0.0 <= found["hygrokf_last_commit_age_seconds",] < 600.0
    count = found["hygrokf_commit_wait_seconds_count",]
    assert found["hygrokf_commit_wait_seconds_bucket", ("le", "+Inf")] == count == service.health.deliveries
    assert found["hygrokf_commit_wait_seconds_sum",] == service.health.wait_sum_s > 0.0
    assert found["hygrokf_build_info", ("python", platform.python_version()), ("version", __version__)] == 1.0
    assert found["process_resident_memory_bytes",] > 1e6 and found["process_open_fds",] > 3.0
    last = found["hygrokf_source_last_message_timestamp_seconds", ("source", "replay:T1")]
    assert last == service.health.sources["replay:T1"].committed
    assert 0.0 <= began - last < 600.0
    assert found["hygrokf_source_lag_seconds", ("source", "replay:T1")] >= 0.0
    for name, row in rows.items():
        turbine = ("turbine", name)
        assert found["hygrokf_condensation_probability", turbine] == row["condensation"]
        states = {s: found["hygrokf_turbine_state", ("state", s), turbine] for s in TURBINE_STATES}
        assert states == {s: float(s == row["state"]) for s in TURBINE_STATES}
        assert found["hygrokf_dew_point_margin_kelvin", turbine] == row["margin"]
        age = found["hygrokf_heard_age_seconds", turbine]
        assert began - row["heard"] - 1e-3 <= age <= ended - row["heard"] + 1e-3
        assert sum(states.values()) == 1.0
    open_ = ("hygrokf_open_alarms", ("kind", "condensation"), ("severity", "warning"))
    assert found[*open_, ("turbine", "T1")] >= 1.0 and found[*open_, ("turbine", NAMES[1])] == 0.0
    lost = ("hygrokf_open_alarms", ("kind", "source lost"), ("severity", "alarm"), ("turbine", ""))
    assert found[lost] == 0.0


PROMTOOL = shutil.which("promtool")
needs_promtool = pytest.mark.skipif(
    PROMTOOL is None, reason="promtool is not installed (Debian and Ubuntu: apt-get install prometheus)"
)


@needs_promtool
def test_promtool_has_nothing_to_say_of_the_metrics(client: httpx.Client) -> None:
    text = client.get("/metrics").content
    done = subprocess.run(
        [PROMTOOL, "check", "metrics"], input=text, capture_output=True, timeout=60.0, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, b"")


def test_a_store_that_is_not_reached_is_told_and_comes_back(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    with asked(service) as (client, _, _):
        with monkeypatch.context() as patched:
            patched.setattr(service, "store_url", "sqlite:/nowhere/at/all.db")
            answer = client.get("/api/alarms")
            assert answer.status_code == 503 and "nowhere" not in answer.text
            assert client.get("/healthz").status_code == 503
            found = measured(client)
            assert found["hygrokf_store_reached",] == 0.0
            assert found["hygrokf_deliveries_total",] == service.health.deliveries
        assert client.get("/api/alarms").status_code == client.get("/healthz").status_code == 200


def test_before_the_tracker_has_a_store_nothing_is_read(tmp_path: Path, service: Service) -> None:
    waiting = Service(service.turbines, [], f"sqlite:{tmp_path / 'live.db'}")
    with asked(waiting) as (client, _, _):
        assert "has not opened its store yet" in client.get("/api/fleet").json()["fault"]
        assert not (tmp_path / "live.db").exists()
        waiting.run(until_ended=True)
        assert len(client.get("/api/fleet").json()["turbines"]) == 2
        waiting.stop()
        answer = client.get("/healthz")
        assert (answer.status_code, answer.json()["fault"]) == (503, "the tracker is ending")


# -- access --------------------------------------------------------------------------------------------------
CLOSED = ("/api/fleet", "/api/turbine/T1", "/api/alarms", "/api/health", "/events", "/metrics")


def test_nothing_is_told_without_the_token(locked: httpx.Client) -> None:
    for path in CLOSED:
        for headers in ({}, {"Authorization": "Basic eDp5"}, {"Cookie": "hygrokf_0=1.2.3"}):
            answer = locked.get(path, headers=headers)
            assert answer.status_code == 401 and "turbine" not in answer.text and TOKEN not in answer.text
    assert locked.post("/api/alarms/acknowledge", json={"id": "x", "by": "x"}).status_code == 401
    for path in ("/", "/static/page.js", "/healthz", "/readyz"):
        assert locked.get(path).status_code == 200
    answer = locked.get("/api/fleet", headers={"Authorization": f"Bearer {TOKEN}"})
    assert len(answer.json()["turbines"]) == 2


def test_a_browser_logs_in_and_out(service: Service, locked: httpx.Client) -> None:
    answer = locked.post("/api/login", json={"token": TOKEN})
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert TOKEN not in cookie and "Secure" not in cookie
    session = cookie.partition(";")[0]
    with asked(service, LOCKED) as (other, _, _):  # also of the page after a restart
        assert other.get("/api/fleet", headers={"Cookie": f"more=1; {session}"}).status_code == 200
        assert other.get("/api/fleet", headers={"Cookie": session[:-1] + "x"}).status_code == 401
    with asked(service, PageSettings(port=0, token=TOKEN + "-another")) as (other, _, _):
        assert other.get("/api/fleet", headers={"Cookie": session}).status_code == 401
    assert (
        "Max-Age=0" in locked.post("/api/logout", json={}, headers={"Cookie": session}).headers["set-cookie"]
    )
    locked.cookies.clear()


def test_a_session_ends() -> None:
    now = [1e9]
    sessions = Sessions(LOCKED, lambda: now[0])
    cookie = sessions.header(opens=True).partition(";")[0]
    assert sessions.valid(cookie) and not sessions.valid(cookie.replace("=1", "=9"))
    now[0] += web_access.SESSION_S + 1.0
    assert not sessions.valid(cookie)
    for cookies in ("", "hygrokf_0=", "hygrokf_0=.", "hygrokf_0=nan.x", "hygrokf_0", "\x00", "=;=;"):
        assert not sessions.valid(cookies)


BEHIND = PageSettings(port=0, token=TOKEN, behind_proxy=True)


@pytest.mark.parametrize("forwarded", [{}, {"X-Forwarded-Proto": "http"}, {"X-Forwarded-Proto": "x"}])
def test_behind_a_proxy_nothing_is_told_without_tls(service: Service, forwarded: dict) -> None:
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    with asked(service, BEHIND) as (client, _, _):
        for path in ("/", "/static/page.js", "/api/fleet", "/events"):
            answer = client.get(path, headers={**bearer, **forwarded})
            assert answer.status_code == 403 and "X-Forwarded-Proto" in answer.json()["fault"]
        assert client.post("/api/login", json={"token": TOKEN}, headers=forwarded).status_code == 403
        for path in ("/healthz", "/readyz", "/metrics"):
            assert client.get(path, headers={**bearer, **forwarded}).status_code == 200
        assert client.get("/metrics", headers=forwarded).status_code == 401


# -- the server ----------------------------------------------------------------------------------------------
def test_a_unix_socket(service: Service, tmp_path: Path) -> None:
    settings = PageSettings("localhost", 0, unix=str(tmp_path / "page.sock"))
    for _ in range(2):  # the second time in place of what the first has left behind
        with asked(service, settings) as (_, hub, server):
            assert server.url == f"unix:{tmp_path}/page.sock"
            transport = httpx.HTTPTransport(uds=settings.unix)
            with httpx.Client(base_url="http://localhost", transport=transport) as client:
                assert len(client.get("/api/fleet").json()["turbines"]) == 2
            with pytest.raises(PageFault, match=r"page\.sock: Address already in use"):
                serve(PageEndpoints(service, hub, settings).app(), settings, hub).__enter__()
    (tmp_path / "other").write_text("kept")
    taken = PageSettings("localhost", 0, unix=str(tmp_path / "other"))
    with pytest.raises(PageFault, match="Address already in use"):
        serve(PageEndpoints(service, hub, taken).app(), taken, hub).__enter__()
    assert (tmp_path / "other").read_text() == "kept"


def test_an_address_in_use_is_said(service: Service) -> None:
    with asked(service) as (_, hub, server):
        settings = PageSettings(port=server.port)
        with pytest.raises(PageFault, match=f"127.0.0.1:{server.port}: the port is in use"):
            serve(PageEndpoints(service, hub, settings).app(), settings, hub).__enter__()
    with pytest.raises(PageFault, match="does not have this address"):
        away = PageSettings("203.0.113.7", 0, token=TOKEN, behind_proxy=True)
        serve(PageEndpoints(service, hub, LOCAL).app(), away, hub).__enter__()


def test_it_listens_on_loopback_alone_and_is_gone_after_its_end(service: Service) -> None:
    with asked(service, PageSettings(port=free_port())) as (_, _, server):
        port = server.port
        assert server.url == f"http://127.0.0.1:{port}/" and server.thread.is_alive()
        with pytest.raises(OSError):
            socket.create_connection(("127.0.0.2", port), timeout=1.0)
    assert not server.thread.is_alive()
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", port), timeout=1.0)
