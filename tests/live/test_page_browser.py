"""The page in a real browser: what it shows is what the store holds, and it says when that is no longer of
now."""

from __future__ import annotations

import json
import math
import re
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import pytest
from builders.browser import needs_chromium
from builders.live_case import live_turbine
from builders.page_case import Case, Fed, add_forecast, filled, opened, recent_record, served
from builders.ports import free_port
from builders.service_case import running
from builders.store_case import queried
from builders.waiting import eventually
from playwright.sync_api import Browser, Page, expect

from hygrokf.identification.verdict_terms import Inherited
from hygrokf.live import service as service_module
from hygrokf.live.batch import Alarm, Assessment, Batch, stated_content
from hygrokf.live.condition import Surface
from hygrokf.live.notification.notices import acknowledge
from hygrokf.live.service import Service
from hygrokf.live.sources.local import Playback, record_mapping, record_messages
from hygrokf.live.web.application import PageEndpoints as LivePage
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.live.web.server import Hub, serve
from hygrokf.texts.live_codes import StateCode
from hygrokf.texts.reasons import REJECT, ReasonCode
from hygrokf.texts.statement import Statement

pytestmark = needs_chromium
EVIL = '<img src=x onerror="window.broken=1">'
TOKEN = "a-token-of-the-tests-0123456789"
MINUS = "\u2212"
expect.set_options(timeout=60_000)
UNREACHED = re.compile(r"net::ERR_|Failed to load resource")
"""What a browser says when its server is not there, or refuses."""


def assessment(name: str, state: str, since: float, reason: Statement) -> Assessment:
    return Assessment(name, state, reason.text, since, stated_content([reason]))


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Service:
    cases = [
        Case("T1"),
        Case("T2", without=("cabinet_relative_humidity",)),
        Case("silent", silent_h=5.0),
        Case(EVIL),
    ]
    made = filled(tmp_path_factory.mktemp("page"), cases, days=2.0)
    store = opened(made)
    add_forecast(store, "T1", f"pre-heat for 40 min {EVIL}")
    now = time.time()
    store.commit(
        Batch(
            alarms=[
                Alarm(
                    "silent:reading contradicts cabinet_temperature:0",
                    "silent",
                    "reading contradicts",
                    "warning",
                    now - 20_000.0,
                    "cabinet temperature reads 40.0 °C, where the estimate expects 25.0",
                    "compare",
                    subject="cabinet_temperature",
                ),
                Alarm(
                    "evil",
                    EVIL,
                    "condensation",
                    "alarm",
                    now - 7200.0,
                    EVIL,
                    "dry <b>it</b>",
                    content=stated_content([StateCode.FILTER_FAILS(fault=EVIL)]),
                ),
                Alarm("wet", "T1", "condensation", "warning", now - 3600.0, "water condenses", "pre-heat"),
                Alarm(
                    "past", "T1", "data stale", "warning", now - 9000.0, "silent", "look", ended=now - 8000.0
                ),
            ],
            assessments=[
                assessment("T1", "at risk", now - 3600.0, StateCode.CONDENSATION_LIKELY_NOW()),
                assessment(EVIL, "alarm", now - 7200.0, StateCode.ALARMS_OPEN(kinds=(EVIL,))),
                assessment("silent", "stale", now - 60.0, StateCode.ESTIMATE_OLD(at=now - 18e3)),
            ],
            counters={("T1", "late"): 12, ("T1", "bad quality"): 1},
        )
    )
    store.close()
    return made


@pytest.fixture(scope="module")
def live(service: Service) -> Iterator[tuple[str, Hub]]:
    with served(service) as (page, server):
        yield server.url, page.hub


class Tab:
    """A page of the browser that keeps what went wrong in it."""

    def __init__(self, browser: Browser, **context: object) -> None:
        given = {"viewport": {"width": 1280, "height": 900}, "timezone_id": "Europe/Berlin", **context}
        self.context = browser.new_context(**given)
        self.page: Page = self.context.new_page()
        self.said: list[str] = []
        self.page.on("console", lambda m: m.type in ("error", "warning") and self.said.append(m.text))
        self.page.on("pageerror", lambda fault: self.said.append(str(fault)))
        self.page.add_init_script(
            "document.addEventListener('securitypolicyviolation', e => console.error('CSP ' + "
            "e.violatedDirective))"
        )
        self.page.set_default_timeout(60_000)

    def open(self, url: str) -> Page:
        self.page.goto(url)
        expect(self.page.locator("#live-words")).to_have_text("page connected")
        return self.page

    def faults(self) -> list[str]:
        return [text for text in self.said if not UNREACHED.search(text)]


@pytest.fixture
def tab(browser: Browser) -> Iterator[Tab]:
    made = Tab(browser)
    yield made
    made.context.close()
    assert made.faults() == []


def text_of(value: float, digits: int, sign: bool = False) -> str:
    """A number as the page writes it."""
    text = f"{abs(value):.{digits}f}"
    if float(text) == 0.0:
        return text
    return (MINUS if value < 0 else "+" if sign else "") + text


def chance_text(value: float) -> str:
    shown = 100.0 * value
    if shown < 0.1:
        return "<\u20090.1 %"
    if shown > 99.9:
        return ">\u200999.9 %"
    return f"{shown:.{1 if shown < 10 or shown > 99 else 0}f} %"


def significant(value: float) -> str:
    """Three significant digits of a number above 0.1."""
    return text_of(value, 3 if value < 1.0 else 2 if value < 10.0 else 1)


def row_of(page: Page, name: str):
    return page.locator(f"tr[data-turbine={json.dumps(name)}]")


def plain(text: str) -> str:
    return text.replace("\u00a0", " ")


def newest(service: Service, name: str) -> tuple:
    store = opened(service)
    (found,) = queried(
        store,
        "SELECT temperature_K, temperature_sd, relative_humidity, relative_humidity_sd, margin_K, margin_sd, "
        "condensation, absolute_humidity_g_m3 FROM estimate WHERE turbine = ? ORDER BY time DESC LIMIT 1",
        (name,),
    )
    store.close()
    return found


# -- the fleet -----------------------------------------------------------------------------------------------
def test_the_fleet_shows_what_the_store_holds(tab: Tab, live: tuple[str, Hub], service: Service) -> None:
    page = tab.open(live[0])
    expect(page.locator("tbody tr")).to_have_count(4)
    expect(page.locator("#live-data")).to_have_text(re.compile(r"^data \d+\s(s|min) old$"))
    expect(page.locator("#live")).not_to_have_class(re.compile("old|off|waiting"))
    expect(page.locator("#label")).to_be_hidden()
    for name in service.turbines:
        kelvin, kelvin_sd, humidity, humidity_sd, margin, margin_sd, chance, _ = newest(service, name)
        cells = {
            kind: plain(row_of(page, name).locator(f"td.{kind}").inner_text())
            for kind in ("temperature", "humidity", "margin", "condensation")
        }
        assert cells["temperature"] == f"{text_of(kelvin - 273.15, 1)} °C± {text_of(1.959964 * kelvin_sd, 1)}"
        assert cells["humidity"] == f"{text_of(100 * humidity, 0)} %± {text_of(196 * humidity_sd, 0)}"
        lower = margin - 1.959964 * margin_sd
        assert cells["margin"] == f"{text_of(margin, 1, True)} K≥ {text_of(lower, 1, True)}"
        assert cells["condensation"] == chance_text(chance)
    assert [row.get_attribute("data-turbine") for row in page.locator("tbody tr").all()][:2] == ["T1", EVIL]


def test_what_rests_on_a_number_that_is_not_to_be_believed_says_so(
    tab: Tab, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    reasons = (ReasonCode.RECORD_DOUBTED(REJECT, doubt=f"the source {EVIL}"),)
    known = {"thermal": Inherited(1.5, 1.4, 1.6, REJECT, reasons), "hygric": Inherited(1.5, 1.4, 1.6)}
    monkeypatch.setitem(service.turbines, "T2", replace(service.turbines["T2"], verdicts=known))
    with served(service) as (_, server):
        page = tab.open(server.url)
        doubtful, fine = row_of(page, "T2"), row_of(page, "T1")
        expect(doubtful.locator(".badge")).not_to_have_text("ok")
        expect(doubtful.locator("td.cabinet")).to_contain_text("model rejected")
        expect(doubtful).to_have_class("rejected")
        expect(fine).not_to_have_class("rejected")
        page = tab.open(f"{server.url}#/turbine/T2")
        expect(page.locator(".model li")).to_have_count(
            1
        )  # of the number that is believed nothing needs to be said
        expect(page.locator(".model li")).to_have_text(
            f"✕ thermal time constant not reliable: doubt about the record: the source {EVIL}"
        )
        expect(page.locator("#now-temperature")).to_contain_text("by a rejected model")
        assert "by a model" not in page.locator("#now-absolute_humidity").inner_text()
        page = tab.open(f"{server.url}#/turbine/T1")
        expect(page.locator("#now-temperature")).to_be_visible()
        expect(page.locator(".model")).to_be_hidden()


def test_what_is_old_is_shown_as_old(tab: Tab, live: tuple[str, Hub]) -> None:
    page = tab.open(live[0])
    silent, fresh = row_of(page, "silent"), row_of(page, "T2")
    expect(silent.locator(".badge")).to_have_text("stale")
    expect(silent.locator(".reason")).to_contain_text("the estimate is from ")
    expect(silent).to_have_class("stale")
    assert plain(silent.locator("td.heard").inner_text()).startswith("5 h")
    expect(fresh).not_to_have_class("stale")


def test_names_are_found(tab: Tab, live: tuple[str, Hub]) -> None:
    page = tab.open(live[0])
    page.keyboard.press("/")
    page.keyboard.type("t")
    expect(page.locator("tbody tr:visible")).to_have_count(3)
    page.keyboard.type("2")
    expect(page.locator("tbody tr:visible")).to_have_count(1)
    expect(page.locator(".found")).to_have_text("1 of 4")
    page.keyboard.press("Enter")
    expect(page.locator("h1")).to_have_text("T2")
    expect(page.locator("h1")).to_be_focused()
    page.go_back()
    expect(page.locator("h1")).to_have_text("Cabinets")
    assert page.locator("#search").input_value() == "t2"


def test_a_summary_of_the_states_with_their_reasons(tab: Tab, live: tuple[str, Hub]) -> None:
    page = tab.open(live[0])
    risky = row_of(page, "T1")
    expect(risky.locator(".badge")).to_have_text("at risk")
    expect(risky.locator(".reason")).to_contain_text("condensation is likely now")
    expect(row_of(page, EVIL).locator(".reason")).to_contain_text(EVIL)
    red = page.evaluate(
        "name => getComputedStyle(document.querySelector(name)).backgroundColor", ".badge.at-risk"
    )
    assert red == "rgb(179, 36, 27)"
    chips = {one.get_attribute("data-state"): one.inner_text() for one in page.locator(".chip:visible").all()}
    shown = [row.get_attribute("data-state") for row in page.locator("tbody tr").all()]
    assert {state: int(text.split()[0]) for state, text in chips.items()} == Counter(shown)
    page.locator(".chip.at-risk").click()
    expect(page.locator("tbody tr:visible")).to_have_count(shown.count("at risk"))
    expect(page.locator(".found")).to_have_text(f"{shown.count('at risk')} of 4")
    page.locator(".chip.at-risk").click()
    expect(page.locator("tbody tr:visible")).to_have_count(4)


def test_a_sparkline_draws_the_margin_back_and_ahead(tab: Tab, live: tuple[str, Hub]) -> None:
    page = tab.open(live[0])
    spark = row_of(page, "T1").locator(".spark")
    expect(spark).to_be_visible()
    assert spark.locator(".line.past").count() >= 1 and spark.locator(".band.ahead").count() == 1
    assert "Lowest of the last 3 days: " in spark.get_attribute("aria-label")
    # two days of estimates lie left of now, the forecast right of it
    [past, ahead, now] = [
        page.evaluate(
            "e => { const b = e.getBoundingClientRect(); return [b.left, b.right]; }", one.element_handle()
        )
        for one in (spark.locator(".line.past").last, spark.locator(".line.ahead"), spark.locator(".now"))
    ]
    assert past[0] < past[1] < now[0] < ahead[0] < ahead[1]


def test_a_playback_is_marked_and_its_dates_have_a_year(tab: Tab, service: Service, tmp_path: Path) -> None:
    record = recent_record(tmp_path, 7, 2.0, 1_583_000_000.0)
    source = Playback(
        "replay:old", record_messages(record, "T1"), record_mapping(record, "T1"), label="Demo: old"
    )
    played = Service({"T1": live_turbine(record)}, [source], f"sqlite:{tmp_path / 'live.db'}")
    played.run(until_ended=True)
    with served(played) as (_, server):
        page = tab.open(f"{server.url}#/turbine/T1")
        expect(page.locator("#label")).to_have_text("Demo: old")
        expect(page.locator(".as-of")).to_contain_text("2020")


# -- one turbine ---------------------------------------------------------------------------------------------
COLUMNS = """(colours) => { const c = document.querySelector('#chart-temperature canvas');
  const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
  return colours.map((sought) => { let first = 1, last = 0;
    for (let i = 0; i < d.length; i += 4)
      if (d[i + 3] === 255 && sought.every((v, k) => Math.abs(v - d[i + k]) < 40)) {
      const x = (i / 4 % c.width) / c.width; first = Math.min(first, x); last = Math.max(last, x); }
    return [first, last]; }); }"""
"""Between which shares of the width a chart has pixels of colours."""


def chart(page: Page, name: str) -> list:
    return page.evaluate(
        "name => document.getElementById('chart-' + name).chart.data.map(column => [...column].map(v => v ?? "
        "null))",
        name,
    )


def test_charts_hold_what_the_store_holds(tab: Tab, live: tuple[str, Hub], service: Service) -> None:
    page = tab.open(live[0] + "#/turbine/T1")
    expect(page.locator("#chart-temperature canvas")).to_be_visible()
    store = opened(service)
    since = time.time() - 3 * 86400.0
    estimates = queried(
        store,
        "SELECT time, temperature_K, temperature_sd FROM estimate WHERE turbine = 'T1' AND time >= ? ORDER "
        "BY time",
        (since,),
    )
    readings = queried(
        store,
        "SELECT time, value FROM observation WHERE turbine = 'T1' AND signal = 'cabinet_temperature' AND "
        "time >= ? ORDER BY time",
        (since,),
    )
    forecast = queried(
        store, "SELECT time, temperature_K, temperature_sd FROM forecast WHERE turbine = 'T1' ORDER BY time"
    )
    store.close()
    data = chart(page, "temperature")

    def drawn(column: int) -> list[tuple[float, float]]:
        return [(t, v) for t, v in zip(data[0], data[column], strict=True) if v is not None]

    assert drawn(1) == [(t, pytest.approx(v - 273.15, abs=1e-3)) for t, v in readings]
    assert drawn(2) == [(t, pytest.approx(v - 273.15, abs=1e-3)) for t, v, _ in estimates]
    assert drawn(4) == [(t, pytest.approx(v - 273.15 + 1.959964 * sd, abs=1e-3)) for t, v, sd in estimates]
    assert drawn(5) == [(t, pytest.approx(v - 273.15, abs=1e-3)) for t, v, _ in forecast]
    assert drawn(6) == [(t, pytest.approx(v - 273.15 - 1.959964 * sd, abs=1e-3)) for t, v, sd in forecast]
    for name in ("relative_humidity", "margin", "absolute_humidity", "condensation", "humid"):
        assert len(chart(page, name)[0]) > 10, name
    assert len(chart(page, "property-thermal_time_constant")[0]) >= 1
    assert "above 80 %" in page.locator("#chart-humid h3").inner_text()
    # pixels are there: the estimate's up to now, the forecast's after it
    drawings = page.evaluate(COLUMNS, [[31, 95, 168], [141, 90, 20]])
    (first, last), (forecast_first, forecast_last) = drawings
    assert first < last < forecast_first + 0.02 and forecast_last > 0.95 and 0.4 < last < 0.8


def test_a_turbine_in_words(tab: Tab, live: tuple[str, Hub], service: Service) -> None:
    page = tab.open(live[0] + "#/turbine/T1")
    kelvin, _, humidity, _, margin, _, chance, density = newest(service, "T1")
    shown = {
        "temperature": f"{text_of(kelvin - 273.15, 1)} °C",
        "relative_humidity": f"{text_of(100 * humidity, 0)} %",
        "margin": f"{text_of(margin, 1, True)} K",
        "condensation": chance_text(chance),
        "absolute_humidity": f"{density:.1f} g/m³",
    }
    for name, text in shown.items():
        assert plain(page.locator(f"#now-{name} .value").inner_text()) == text
    assert f"pre-heat for 40 min {EVIL}" in page.locator(".advice").inner_text()
    store = opened(service)
    properties = queried(
        store,
        "SELECT name, value, lower_bound, upper_bound, reference FROM property WHERE turbine = 'T1' AND time "
        "= (SELECT MAX(time) FROM property WHERE turbine = 'T1')",
    )
    store.close()
    assert len(properties) == 4
    for name, value, lower, upper, reference in properties:
        text = plain(page.locator(f"[data-property={name}]").inner_text())
        if name == "heat_release_change":
            value, lower, upper = (text_of(v, 1, True) for v in (value, lower, upper))
            assert f"{value} K {lower} … {upper}" in text
        elif name == "humidity_offset":
            value, lower, upper = (text_of(100.0 * v, 1, True) for v in (value, lower, upper))
            assert f"{value} % {lower} … {upper}" in text
        else:
            value, lower, upper, reference = (significant(v) for v in (value, lower, upper, reference))
            assert f"{value} h {lower} … {upper}" in text and f"from the fit: {reference} h" in text
    aside = page.locator(".aside li").all_inner_texts()
    assert aside == ["1 reading was marked as bad by the source", "12 readings came too late to be used"]
    assert page.locator("tr[data-signal=cabinet_temperature] td").first.inner_text().endswith("°C")
    expect(page.locator("#zone")).to_contain_text("Europe/Berlin")
    assert re.search(
        r"\d{4}-\d\d-\d\d \d\d:\d\d UTC$", page.locator(".as-of time").first.get_attribute("title")
    )


@pytest.mark.slow
def test_days_are_chosen_and_kept(tab: Tab, live: tuple[str, Hub]) -> None:
    page = tab.open(live[0] + "#/turbine/T1")
    points = len(chart(page, "temperature")[0])
    page.locator("input[name=days]:checked").focus()
    page.keyboard.press("ArrowLeft")
    expect(page.locator("input[value='1']")).to_be_checked()
    eventually(lambda: len(chart(page, "temperature")[0]) < points)
    page.reload()
    expect(page.locator("input[value='1']")).to_be_checked()


def test_without_a_humidity_sensor_it_is_said(tab: Tab, live: tuple[str, Hub]) -> None:
    page = tab.open(live[0] + "#/turbine/T2")
    said = "no humidity sensor: estimate from the model alone"
    for name in ("relative_humidity", "margin", "absolute_humidity"):
        expect(page.locator(f"#chart-{name} .chart-note")).to_have_text(said)
    expect(page.locator("#chart-temperature .chart-note")).to_be_hidden()
    expect(page.locator("#now-relative_humidity .note")).to_have_text("from the model alone")
    page.goto(live[0] + "#/turbine/nobody")
    expect(page.locator(".page-fault")).to_have_text("no such turbine is tracked")


def test_a_contradiction_is_flagged_and_what_never_came_is_listed(
    tab: Tab, live: tuple[str, Hub], service: Service
) -> None:
    page = tab.open(live[0] + "#/turbine/silent")
    flagged = page.locator("tr[data-signal=cabinet_temperature]")
    expect(flagged.locator(".contradicts")).to_be_visible()
    expect(page.locator("#chart-temperature .chart-note")).to_contain_text("contradicts the estimate")
    expect(page.locator("#now-temperature .note")).to_contain_text("contradicts the estimate")
    expect(page.locator("#chart-relative_humidity .chart-note")).to_be_hidden()
    page = tab.open(live[0] + "#/turbine/T2")
    never = page.locator("tr.never")
    expect(never).to_have_count(1)
    expect(never).to_contain_text("never came")
    assert never.get_attribute("data-signal") == "cabinet_relative_humidity"
    limit = page.evaluate("document.getElementById('chart-relative_humidity').chart.scales.y.max")
    assert limit > 80.0  # the limit's line is in view


@pytest.mark.slow
def test_pointing_at_a_chart_reads_it_in_both_times(tab: Tab, live: tuple[str, Hub]) -> None:
    page = tab.open(live[0] + "#/turbine/T1")
    page.locator("#chart-temperature .u-over").hover(position={"x": 500, "y": 50})
    for name in ("temperature", "margin"):  # all charts follow
        text = page.locator(f"#chart-{name} output").inner_text()
        assert re.match(r"\w{3} \d+ \w{3,4} \d\d:\d\d \(\d\d:\d\d UTC\): .* \(.* … .*\)", text), text


# -- what comes from outside stays text ----------------------------------------------------------------------
def test_names_and_texts_stay_text(tab: Tab, live: tuple[str, Hub]) -> None:
    page = tab.open(live[0])
    expect(row_of(page, EVIL).locator("a")).to_have_text(EVIL)
    row_of(page, EVIL).locator("a").click()
    expect(page.locator("h1")).to_have_text(EVIL)
    assert page.url.endswith(quote(EVIL, safe="!~*'()"))
    expect(page.locator(".item .statement")).to_have_text(f"the filter cannot run: {EVIL}")
    expect(page.locator(".item .remedy")).to_have_text("To do: dry <b>it</b>")
    page.locator(".item button.acknowledge").click()
    expect(page.locator("#acknowledge-about")).to_contain_text(EVIL)
    page.keyboard.press("Escape")
    page.goto(live[0] + "#/alarms")
    expect(page.locator(".item .statement").first).to_contain_text(EVIL)
    assert page.locator("img").count() == 0 and page.evaluate("window.broken") is None


# -- alarms --------------------------------------------------------------------------------------------------
def test_an_alarm_appears_by_itself_and_is_acknowledged(
    browser: Browser, tab: Tab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages into a tracker that runs; its own rule raises the alarm; a click is kept by the store."""
    # the second half of the messages must not be missed while the first is looked at, however long that takes
    monkeypatch.setattr(service_module, "TICK_S", math.inf)
    record = recent_record(tmp_path / "record", 7, 2.0, 60.0 * (time.time() // 60.0))
    messages = record_messages(record, "wet")
    at = messages[-1][0] - 6 * 3600.0
    source = Fed("fed:", record_mapping(record, "wet"))
    cold = replace(live_turbine(record), surface=Surface(0.0, -20.0))
    hub = Hub()
    service = Service({"wet": cold}, [source], f"sqlite:{tmp_path / 'live.db'}", hub.settle)
    page_of = LivePage(service, hub, PageSettings(port=0))
    with serve(page_of.app(), PageSettings(port=0), hub) as server, running(service):
        eventually(lambda: service.store)
        page = tab.open(server.url)
        expect(page.locator("tbody tr")).to_have_count(1)
        expect(page.locator("#open-alarms")).to_be_hidden()
        source.give([m for m in messages if m[0] < at])
        store = opened(service)
        eventually(lambda: queried(store, "SELECT id FROM alarm"))
        # nothing but the event of its commit lets the page ask for its rows again
        expect(row_of(page, "wet").locator(".badge")).to_have_text("at risk")
        expect(row_of(page, "wet").locator(".reason")).to_have_text("condensation is likely now")
        expect(page.locator("#open-alarms")).to_have_text("1")
        row_of(page, "wet").locator("a").click()
        clicked = time.time()
        page.locator(".item button.acknowledge").click()
        page.keyboard.type("Control room")
        page.keyboard.press("Enter")
        expect(page.locator(".item .seen")).to_contain_text("acknowledged by Control room")
        expect(page.locator(".item button.acknowledge")).to_have_count(0)
        rows = queried(store, "SELECT kind, acknowledged_by, acknowledged, ended FROM alarm")
        before = chart(page, "temperature")[0][-1]
        assert [row[:2] for row in rows] == [("condensation", "Control room")]
        assert clicked <= rows[0][2] <= time.time() and rows[0][3] is None
        # what comes next is drawn by itself, and the acknowledgement stays
        source.give([m for m in messages if m[0] >= at])
        eventually(lambda: chart(page, "temperature")[0][-1] > before)
        expect(page.locator(".item .seen")).to_contain_text("Control room")
        assert queried(store, "SELECT acknowledged_by FROM alarm") == [("Control room",)]
        store.close()
        assert page.evaluate("localStorage.getItem('hygrokf.by')") == "Control room"
    page_of.close()


def test_what_is_refused_is_said_in_the_dialog(tab: Tab, live: tuple[str, Hub], service: Service) -> None:
    page = tab.open(live[0] + "#/turbine/T1")
    expect(page.locator(".item")).to_have_count(2)
    expect(page.locator(".item.ended button")).to_have_count(0)
    page.locator(".item button.acknowledge").click()
    store = opened(service)
    assert acknowledge(store, "wet", "someone else", time.time(), "unexplained")
    store.close()
    page.locator("#acknowledge-by").fill("me")
    page.locator("#acknowledge button[type=submit]").click()
    expect(page.locator("#acknowledge-fault")).to_contain_text("it is already acknowledged")
    page.keyboard.press("Escape")
    expect(page.locator(".item .seen")).to_contain_text("someone else")


def test_a_cause_a_shelf_and_a_change_are_stated(tab: Tab, live: tuple[str, Hub], service: Service) -> None:
    page = tab.open(live[0] + "#/turbine/silent")
    item = page.locator(".item.warning", has_text="reading contradicts").first
    item.locator("button.acknowledge").click()
    page.locator("#acknowledge-by").fill("K. Maier")
    expect(page.locator("#acknowledge-days")).to_be_hidden()
    page.locator("#acknowledge select").select_option("look again")
    page.locator("#acknowledge [name=days]").fill("5")
    page.locator("#acknowledge [name=note]").fill(f"loose plug {EVIL}")
    page.locator("#acknowledge button[type=submit]").click()
    seen = item.locator(".seen")
    expect(seen).to_contain_text("acknowledged by K. Maier")
    expect(seen).to_contain_text("look again")
    expect(seen).to_contain_text(f"loose plug {EVIL}")
    item.locator("button.shelve").click()
    expect(page.locator("#shelve-by")).to_have_value("K. Maier")
    page.locator("#shelve select").select_option("3")
    page.locator("#shelve button[type=submit]").click()
    expect(page.locator(".shelf")).to_contain_text("shelved by K. Maier")
    expect(item).to_contain_text("shelved until")
    page.locator("#state-change").click()
    page.locator("#change [name=note]").fill("heater set to 5 K")
    page.locator("#change button[type=submit]").click()
    expect(page.locator(".events")).to_contain_text(
        "settings changed, stated by K. Maier – heater set to 5 K"
    )
    store = opened(service)
    ((cause, note, days),) = queried(
        store,
        "SELECT cause, note, (look_again - acknowledged) / 86400 FROM alarm WHERE turbine = 'silent' "
        "AND kind = 'reading contradicts'",
    )
    assert (cause, note, round(days, 3)) == ("look again", f"loose plug {EVIL}", 5.0)
    (shelf,) = store.shelves(time.time())
    assert (shelf.turbine, shelf.kind) == ("silent", "reading contradicts")
    assert shelf.until - shelf.made == pytest.approx(3 * 86400.0)
    ((event,),) = ([one for one in store.all_events() if one.turbine == "silent"],)
    store.close()
    assert (event.kind, event.made_by) == ("settings changed", "K. Maier")
    page = tab.open(live[0] + "#/alarms")
    labels = page.locator("tr[data-kind='reading contradicts']")
    expect(labels).to_contain_text("1 look again")
    with page.expect_download() as started:
        page.get_by_text("All alarms as CSV").click()
    assert "reading contradicts" in started.value.path().read_text(encoding="utf-8")
    page.locator(".shelf button").click()
    expect(page.locator(".shelf")).to_have_count(0)


# -- being connected -----------------------------------------------------------------------------------------
def test_it_comes_back_after_the_server_was_gone(tab: Tab, service: Service) -> None:
    port = free_port()
    with served(service, PageSettings(port=port)) as (_, server):
        page = tab.open(server.url)
        expect(page.locator("#lost")).to_be_hidden()
    expect(page.locator("#lost")).to_contain_text("Connection lost since")
    expect(page.locator("#live-words")).to_have_text("not connected")
    expect(page.locator("body")).to_have_class("lost")
    page.clock.install()
    page.clock.fast_forward(7200_000)  # nobody tells the page, and still what it shows gets old
    expect(page.locator("#lost")).to_contain_text("2\u00a0h")
    expect(row_of(page, "T2")).to_have_class("stale")
    expect(row_of(page, "T2").locator("td.heard")).to_contain_text("2\u00a0h")
    with served(service, PageSettings(port=port)) as (server_page, _):
        expect(page.locator("#lost")).to_be_hidden()
        expect(page.locator("#live-words")).to_have_text("page connected")
        expect(row_of(page, "T2")).not_to_have_class("stale")
        hub = server_page.hub
        eventually(lambda: len(hub) == 1)
        stale = Alarm("late", "T2", "data stale", "notice", time.time(), "silent", "look")
        store = opened(service)
        for alarm, there in ((stale, True), (replace(stale, ended=time.time()), False)):
            batch = Batch(alarms=[alarm])
            store.commit(batch)
            hub.settle(batch)
            reason = expect(row_of(page, "T2").locator(".reason"))
            reason.to_contain_text("data stale") if there else reason.not_to_contain_text("data stale")
        store.close()


# -- access --------------------------------------------------------------------------------------------------
def test_logging_in_and_out(tab: Tab, service: Service) -> None:
    with served(service, PageSettings(port=0, token=TOKEN)) as (_, server):
        page = tab.page
        page.goto(server.url)
        expect(page.locator("#login")).to_be_visible()
        assert page.locator("tbody tr").count() == 0
        page.keyboard.press("Escape")
        expect(page.locator("#login")).to_be_visible()
        page.locator("#login-token").fill("wrong")
        page.keyboard.press("Enter")
        expect(page.locator("#login-fault")).to_have_text("wrong token")
        page.locator("#login-token").fill(TOKEN)
        page.keyboard.press("Enter")
        expect(page.locator("tbody tr")).to_have_count(4)
        expect(page.locator("#live-words")).to_have_text("page connected")
        (cookie,) = tab.context.cookies()
        assert cookie["httpOnly"] and cookie["sameSite"] == "Strict" and TOKEN not in cookie["value"]
        assert TOKEN not in page.content() and TOKEN not in page.url
        page.reload()
        expect(page.locator("tbody tr")).to_have_count(4)
        page.locator("#logout").click()
        expect(page.locator("#login")).to_be_visible()
        assert tab.context.cookies() == []


# -- devices -------------------------------------------------------------------------------------------------
def test_a_phone_needs_no_scrolling_aside(browser: Browser, live: tuple[str, Hub]) -> None:
    tab = Tab(
        browser, viewport={"width": 375, "height": 740}, is_mobile=True, has_touch=True, device_scale_factor=2
    )
    page = tab.open(live[0])
    views = {
        "#/": "Cabinets",
        "#/turbine/T1": "T1",
        f"#/turbine/{quote(EVIL)}": EVIL,
        "#/alarms": "Alarms",
        "#/data": "Data",
    }
    for view, title in views.items():
        page.evaluate("view => { location.hash = view }", view)
        expect(page.locator("h1")).to_have_text(title)  # or else it may be the view before that is looked at
        eventually(lambda: page.evaluate("document.querySelectorAll('main li, main tbody tr').length"))
        assert page.evaluate("document.documentElement.scrollWidth") <= 375, view
        assert page.evaluate("innerWidth") == 375, view  # nothing made the page zoom out
        outside = page.evaluate(
            "[...document.querySelectorAll('main *')].filter(e => e.getClientRects().length "
            "&& e.getBoundingClientRect().right > 376).map(e => e.outerHTML.slice(0, 80))"
        )
        assert outside == [], view
    tab.context.close()
    assert tab.faults() == []


def test_dark(browser: Browser, live: tuple[str, Hub]) -> None:
    tab = Tab(browser, color_scheme="dark")
    page = tab.open(live[0] + "#/turbine/T1")
    expect(page.locator("#chart-temperature canvas")).to_be_visible()

    def look() -> tuple[list[int], str]:
        back = page.evaluate("getComputedStyle(document.body).backgroundColor")
        line = page.evaluate("document.querySelector('#chart-temperature').chart.series[2].stroke()")
        return [int(v) for v in re.findall(r"\d+", back)[:3]], line

    dark = look()
    page.emulate_media(color_scheme="light")
    eventually(lambda: look()[1] != dark[1])
    assert max(dark[0]) < 60 and min(look()[0]) > 200
    tab.context.close()
    assert tab.faults() == []


FAINT = """() => {
  const parts = (t) => { const v = t.match(/[\\d.]+/g).map(Number); return v.length < 4 ? [...v, 1] : v; };
  const light = (c) => { const [r, g, b] = c.map((v) => { v /= 255;
      return v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4; });
    return .2126 * r + .7152 * g + .0722 * b; };
  const ground = (e) => { for (; e; e = e.parentElement) {
    const c = parts(getComputedStyle(e).backgroundColor); if (c[3] === 1) return c; }
    return [255, 255, 255]; };
  const found = [];
  for (const e of document.querySelectorAll('body *')) {
    if (!e.getClientRects().length
        || ![...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim())) continue;
    const a = light(parts(getComputedStyle(e).color).slice(0, 3)), b = light(ground(e).slice(0, 3));
    const ratio = (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
    if (ratio < 4.5) found.push([e.className, e.textContent.slice(0, 30), ratio]);
  }
  return found; }"""
"""Texts whose contrast to their ground is below 4.5."""


@pytest.mark.slow
def test_text_stands_out_from_its_ground(browser: Browser, live: tuple[str, Hub]) -> None:
    """Contrast of at least 4.5 for every text that is shown, in both schemes (WCAG 2, level AA)."""
    tab = Tab(browser)
    page = tab.open(live[0])
    for view, title in {"#/": "Cabinets", "#/turbine/T1": "T1", "#/alarms": "Alarms"}.items():
        page.evaluate("view => { location.hash = view }", view)
        expect(page.locator("h1")).to_have_text(title)
        eventually(lambda: page.locator("main .badge").count())
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            assert page.evaluate(FAINT) == [], (view, scheme)
    tab.context.close()
    assert tab.faults() == []


def test_by_keyboard_alone(tab: Tab, live: tuple[str, Hub]) -> None:
    """From the top of the page to an alarm's dialog and out of it, seeing at each step where one is."""
    page = tab.open(live[0])
    page.keyboard.press("Tab")
    expect(page.locator(".skip")).to_be_focused()
    for _ in range(4):
        page.keyboard.press("Tab")
    expect(page.locator("#search")).to_be_focused()
    for _ in range(page.locator(".chip:visible").count() + 2):
        page.keyboard.press("Tab")
    first = page.locator("tbody tr").nth(1)  # whose alarm no other test acknowledges
    expect(first.locator("a")).to_be_focused()
    assert page.evaluate("getComputedStyle(document.querySelectorAll('tbody tr')[1]).outlineStyle") == "solid"
    page.keyboard.press("Enter")
    expect(page.locator("h1")).to_be_focused()
    acknowledge = page.locator(".item button.acknowledge").first
    expect(acknowledge).to_be_visible()
    page.keyboard.press("Tab")
    expect(acknowledge).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#acknowledge-by")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.locator("#acknowledge")).to_be_hidden()
    expect(acknowledge).to_be_focused()
    named = page.evaluate(
        "[...document.querySelectorAll('button, input, a[href], [role=img]')].filter(e => "
        "e.getClientRects().length && !(e.ariaLabel || e.labels?.length || e.textContent.trim())).map(e => "
        "e.outerHTML)"
    )
    assert named == []
