"""What people state on the page, asked of a server that runs: causes, shelves, events, labels, CSV."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Iterator

import httpx
import pytest
from builders.page_case import Case, filled, opened

from hygrokf.data.timestamps import DAY_S
from hygrokf.live.batch import Alarm, Batch
from hygrokf.live.notification.notices import alarm_of, with_prefix
from hygrokf.live.notification.transports import Webhook
from hygrokf.live.service import Service
from hygrokf.live.web.application import PageEndpoints
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.live.web.server import Hub, serve

CHANNEL = Webhook(name="duty", url="https://127.0.0.1:9")


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Service:
    made = filled(tmp_path_factory.mktemp("page"), [Case("T1")], days=2.0)
    made.channels = (CHANNEL,)
    return made


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[httpx.Client]:
    hub, settings = Hub(), PageSettings(port=0)
    page = PageEndpoints(service, hub, settings)
    with serve(page.app(), settings, hub) as server, httpx.Client(base_url=server.url) as client:
        yield client
    page.reader.close()


def raised(service: Service, name: str, kind: str = "condensation") -> Alarm:
    alarm = Alarm(name, "T1", kind, "warning", time.time() - 60.0, "wet", "dry it")
    store = opened(service)
    store.commit(Batch(alarms=[alarm]))
    store.close()
    return alarm


def test_an_acknowledgement_with_its_cause(client: httpx.Client, service: Service) -> None:
    alarm = raised(service, "seen")
    given = {"id": alarm.id, "by": " Ä. Berg ", "cause": "look again", "note": "filter ordered", "days": 2}
    assert client.post("/api/alarms/acknowledge", json=given).json() == {"turbine": "T1"}
    for again in (alarm.id, "none"):
        found = client.post("/api/alarms/acknowledge", json={"id": again, "by": "x"})
        assert found.status_code == 409 and "already acknowledged" in found.json()["fault"]
    store = opened(service)
    found = alarm_of(store, alarm.id)
    assert (found.acknowledged_by, found.cause, found.note) == ("Ä. Berg", "look again", "filter ordered")
    assert found.look_again - found.acknowledged == 2 * DAY_S
    (notice,) = with_prefix(store, "duty", f"duty:{alarm.id}:")
    assert "filter ordered" in notice.content and notice.sent is None
    store.close()
    (channel,) = client.get("/api/health").json()["channels"]
    assert (channel["name"], channel["waiting"], channel["failure"]) == ("duty", 1, "")
    assert 'hygrokf_notices_waiting{channel="duty"} 1.0' in client.get("/metrics").text
    shown = {one["id"]: one for one in client.get("/api/alarms").json()["alarms"]}
    assert shown[alarm.id]["cause"] == "look again"


@pytest.mark.parametrize(
    ("path", "given"),
    [
        ("alarms/acknowledge", {"by": "me"}),
        ("alarms/acknowledge", {"id": "x"}),
        ("alarms/acknowledge", {"id": 2, "by": "me"}),
        ("alarms/acknowledge", {"id": "x", "by": "  "}),
        ("alarms/acknowledge", {"id": "x", "by": "a\nb"}),
        ("alarms/acknowledge", {"id": "x", "by": "x" * 61}),
        ("alarms/acknowledge", {"id": "x", "by": "x", "more": "y" * 5000}),
        ("alarms/acknowledge", {"id": "x", "by": "me", "cause": "bad luck"}),
        ("alarms/acknowledge", {"id": "x", "by": "me", "cause": "look again"}),
        ("alarms/acknowledge", {"id": "x", "by": "me", "cause": "look again", "days": 91}),
        ("alarms/acknowledge", {"id": "x", "by": "me", "cause": "look again", "days": True}),
        ("alarms/acknowledge", {"id": "x", "by": "me", "cause": "look again", "days": 10**400}),
        ("alarms/acknowledge", {"id": "x", "by": "me", "cause": "defect", "days": 1}),
        ("alarms/acknowledge", {"id": "x", "by": "me", "note": "a\nb"}),
        ("alarms/acknowledge", {"id": "x", "by": "me", "note": "n" * 501}),
        ("alarms/acknowledge", {"id": "x", "by": "\ud800"}),
        ("shelves", {"turbine": "T9", "kind": "condensation", "days": 1, "by": "me"}),
        ("shelves", {"turbine": "T1", "kind": "bad luck", "days": 1, "by": "me"}),
        ("shelves", {"turbine": "T1", "kind": ["condensation"], "days": 1, "by": "me"}),
        ("shelves", {"turbine": "T1", "kind": "condensation", "days": 30.5, "by": "me"}),
        ("shelves", {"turbine": "T1", "kind": "condensation", "days": 0, "by": "me"}),
        ("shelves", {"turbine": "T1", "kind": "condensation", "days": 1}),
        ("events", {"turbine": ["T1"], "kind": "settings changed", "by": "me"}),
        ("events", {"turbine": "T1", "kind": "settings", "by": "me"}),
        ("events", {"turbine": "T1", "kind": "settings changed", "by": "me", "time": 1e300}),
        ("events", {"turbine": "T1", "kind": "settings changed", "by": "me", "time": "now"}),
        ("events", {"turbine": "T1", "kind": "settings changed", "by": ""}),
        ("events", []),
    ],
)
def test_what_cannot_be_stated_is_refused(client: httpx.Client, path: str, given: object) -> None:
    sent = {"content": json.dumps(given), "headers": {"Content-Type": "application/json"}}
    found = client.post(f"/api/{path}", **sent)
    assert found.status_code == 400 and found.json()["fault"].startswith(("expected", "days"))


def test_shelves_hold_until_their_end(client: httpx.Client) -> None:
    given = {"turbine": "T1", "kind": "condensation", "days": 0.5, "by": "me", "note": "valve open"}
    made = client.post("/api/shelves", json=given).json()["shelf"]
    assert made["until"] - made["made"] == 0.5 * DAY_S and made["made_by"] == "me"
    assert client.get("/api/shelves").json()["shelves"] == [made]
    sources = {**given, "turbine": "", "kind": "source lost"}
    assert client.post("/api/shelves", json=sources).status_code == 200
    assert len(client.get("/api/shelves").json()["shelves"]) == 2
    for one, status in ((given, 200), (given, 404), (sources, 200)):
        kept = {name: one[name] for name in ("turbine", "kind")}
        assert client.request("DELETE", "/api/shelves", json=kept).status_code == status
    assert client.get("/api/shelves").json()["shelves"] == []


def test_other_sites_change_nothing(client: httpx.Client) -> None:
    given = {"turbine": "T1", "kind": "condensation", "days": 1, "by": "me"}
    for method in ("POST", "DELETE"):
        for headers in ({"Origin": "http://evil.example"}, {"Sec-Fetch-Site": "cross-site"}):
            found = client.request(method, "/api/shelves", json=given, headers=headers)
            assert found.status_code == 403
    assert client.get("/api/shelves").json()["shelves"] == []
    assert client.get("/api/alarms/acknowledge").status_code == 405


def test_events_are_listed(client: httpx.Client) -> None:
    at = time.time() - 3600.0
    given = {"turbine": "T1", "kind": "settings changed", "time": at, "by": "me", "note": "fan set to 40 °C"}
    made = client.post("/api/events", json=given).json()["event"]
    assert (made["time"], made["note"], made["made_by"]) == (at, "fan set to 40 °C", "me")
    assert client.get("/api/events", params={"turbine": "T1"}).json()["events"] == [made]
    assert client.get("/api/events").json()["events"] == [made]
    assert client.get("/api/events", params={"turbine": "T9"}).status_code == 404


def test_labels_count_how_often_a_kind_was_right(client: httpx.Client, service: Service) -> None:
    kind = "cabinet changed"
    causes = ("defect", "defect", "settings changed", "false alarm", "unexplained", "")
    for number, cause in enumerate(causes):
        alarm = raised(service, f"c{number}", kind)
        if cause:
            client.post("/api/alarms/acknowledge", json={"id": alarm.id, "by": "me", "cause": cause})
    found = {one["kind"]: one for one in client.get("/api/alarms/labels").json()["kinds"]}[kind]
    assert (found["alarms"], found["right"], found["wrong"]) == (6, 3, 1)
    assert found["causes"] == {
        "defect": 2, "settings changed": 1, "false alarm": 1, "unexplained": 1, "look again": 0
    }  # fmt: skip


def test_the_alarms_as_csv(client: httpx.Client, service: Service) -> None:
    alarm = raised(service, "csv")
    note = '=HYPERLINK("http://evil.example")'
    given = {"id": alarm.id, "by": "@me", "cause": "defect", "note": note}
    assert client.post("/api/alarms/acknowledge", json=given).status_code == 200
    found = client.get("/api/alarms.csv")
    assert found.headers["Content-Type"].startswith("text/csv") and "attachment" in str(found.headers)
    rows = {row["id"]: row for row in csv.DictReader(io.StringIO(found.text))}
    assert (rows["csv"]["note"], rows["csv"]["acknowledged_by"]) == ("'" + note, "'@me")
    assert rows["csv"]["cause"] == "defect" and rows["csv"]["ended_utc"] == ""
