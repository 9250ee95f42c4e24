"""Files for the tracker's surroundings: alert rules, dashboards, container, unit; run where their programs
are."""

from __future__ import annotations

import configparser
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import yaml
from builders.databases import Server
from builders.documents import DOCS, ROOT, document
from builders.fit_case import bare_fit
from builders.page_case import Case, filled, opened
from builders.track_case import MODEL
from prometheus_client.parser import text_string_to_metric_families

from hygrokf.commands.main import _parser
from hygrokf.identification.fit import write_fit
from hygrokf.live.batch import Alarm, Batch
from hygrokf.live.condition import Condition, Quantity
from hygrokf.live.config import read_config
from hygrokf.live.forecast import Forecast
from hygrokf.live.service import Service
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.stream import Stream
from hygrokf.live.storage.database import Row
from hygrokf.live.web.metrics import exposition
from hygrokf.live.web.views import fleet_view
from hygrokf.texts.live_codes import BasisCode

FILES = DOCS / "live_files"
RULES, RULES_TEST = FILES / "prometheus_rules.yml", FILES / "prometheus_rules_test.yml"
NAME = "W'01"
needs_promtool = pytest.mark.skipif(
    shutil.which("promtool") is None,
    reason="promtool is not installed (Debian and Ubuntu: apt-get install prometheus)",
)


def done(*command: object, cwd: Path = FILES, **environment: str) -> str:
    """What a program that ends well has said."""
    run = subprocess.run(
        [str(one) for one in command],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout + run.stderr


# -- Prometheus ----------------------------------------------------------------------------------------------
@needs_promtool
def test_the_alert_rules_raise_what_they_should() -> None:
    rules = yaml.safe_load(RULES.read_text(encoding="utf-8"))
    names = [rule["alert"] for group in rules["groups"] for rule in group["rules"]]
    assert f"{len(names)} rules found" in done("promtool", "check", "rules", RULES)
    assert "SUCCESS" in done("promtool", "test", "rules", RULES_TEST)
    tests = yaml.safe_load(RULES_TEST.read_text(encoding="utf-8"))["tests"]
    raised = {one["alertname"] for test in tests for one in test["alert_rule_test"] if one["exp_alerts"]}
    assert raised == set(names)  # each rule is seen to raise its alert


@needs_promtool
def test_prometheus_reads_its_example(tmp_path: Path) -> None:
    text = (FILES / "prometheus.yml").read_text(encoding="utf-8")
    (tmp_path / "token").write_text("x")
    (tmp_path / "prometheus.yml").write_text(text.replace("/run/secrets/page.token", "token"))
    shutil.copy(RULES, tmp_path)
    assert "SUCCESS" in done("promtool", "check", "config", "prometheus.yml", cwd=tmp_path)


def test_the_alert_rules_name_metrics_that_there_are(
    filled_store: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(opened(filled_store)) as store:
        rows = fleet_view(store, [NAME], time.time())
    streams = {**filled_store.streams, "mqtt://b": Stream(PayloadMapping({}))}
    monkeypatch.setattr(filled_store, "streams", streams)
    text, _ = exposition(filled_store, 0, rows, (), {("", "malformed"): 1}, {"mail": 1})
    samples = [one for family in text_string_to_metric_families(text.decode()) for one in family.samples]
    labels = {(key, value) for one in samples for key, value in one.labels.items()}
    for group in yaml.safe_load(RULES.read_text(encoding="utf-8"))["groups"]:
        for rule in group["rules"]:
            named = set(re.findall(r"hygrokf_\w+", rule["expr"]))
            assert named <= {one.name for one in samples}, rule["alert"]
            for key, values in re.findall(r'(state|severity)=~?"([^"]+)"', rule["expr"]):
                assert {(key, value) for value in values.split("|")} <= labels


# -- Grafana -------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Query:
    """A query of a dashboard: its panel, its SQL, and whether it gives courses over time."""

    panel: str
    sql: str
    is_course: bool


def queries(kind: str) -> list[Query]:
    dashboard = json.loads((FILES / f"grafana_{kind}.json").read_text(encoding="utf-8"))
    found = []
    for panel in dashboard["panels"]:
        for one in panel["targets"]:
            sql = one["rawSql"] if kind == "postgresql" else one["queryText"]
            form = one["format"] if kind == "postgresql" else one["queryType"].replace(" ", "_")
            assert form in ("time_series", "table")
            assert kind == "postgresql" or one["rawQueryText"] == sql
            found.append(Query(panel["title"], sql, form == "time_series"))
    return found


def expanded(sql: str, since: float, until: float) -> str:
    """A query as Grafana sends it: its macros and variables are replaced."""
    begin, end = (
        datetime.fromtimestamp(one, UTC).strftime("'%Y-%m-%dT%H:%M:%S.%fZ'") for one in (since, until)
    )
    sql = re.sub(r"\$__timeFilter\((\w+)\)", rf"\1 BETWEEN {begin} AND {end}", sql)
    sql = sql.replace("$__from", f"{1e3 * since:.0f}").replace("$__to", f"{1e3 * until:.0f}")
    sql = sql.replace("${turbine:sqlstring}", "'" + NAME.replace("'", "''") + "'")
    assert "$" not in sql
    return sql


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def filled_store(
    kind: str, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Service:
    """A turbine's days up to now, a forecast, and an open alarm, in either store."""
    url = ""
    if kind == "postgresql":
        server: Server = request.getfixturevalue("postgresql")
        url = server.url(server.database())
    made = filled(tmp_path_factory.mktemp("files"), [Case(NAME)], days=2.0, url=url)
    now = time.time()
    at = now + 3600.0 * np.arange(1.0, 25.0)
    one = np.ones(24)
    known = [Quantity(value * one, 0.5 * one) for value in (285.0, 0.5, 5.0, 275.0)]
    condition = Condition(at, *known, None, Quantity(3.0 * one, one), 0.1 * one, None)
    alarm = Alarm("one", NAME, "condensation", "warning", now - 60.0, "water condenses", "dry it")
    with closing(opened(made)) as store:
        made_forecast = Forecast(now, condition, 0.2 * one, 0.8, BasisCode.OPERATION_AS_NOW())
        store.commit(Batch(forecasts={NAME: made_forecast}, alarms=[alarm]))
    return made


def test_every_query_of_the_dashboard_gives_what_its_panel_shows(kind: str, filled_store: Service) -> None:
    now = time.time()
    with closing(opened(filled_store)) as store:
        for query in queries(kind):
            rows, columns = run(store.database.connection, expanded(query.sql, now - 86400.0, now + 86400.0))
            assert rows, query
            if not query.is_course:
                continue
            assert columns[0] == "time"
            times = [seconds(row[0]) for row in rows]
            assert times == sorted(times) and now - 86400.0 <= times[0] <= times[-1] <= now + 86400.0
            assert all(isinstance(value, float | str | None) for row in rows for value in row[1:])
            assert any(isinstance(value, float) for row in rows for value in row[1:])
            assert (times[0] > now) == ("forecast_" in query.sql.partition(" FROM ")[0])


def run(connection, sql: str) -> tuple[list[Row], list[str]]:
    cursor = connection.cursor()
    cursor.execute(sql)
    return cursor.fetchall(), [one[0] for one in cursor.description]


def seconds(value: datetime | float) -> float:
    return value.timestamp() if isinstance(value, datetime) else float(value)


def test_both_dashboards_show_the_same() -> None:
    def plain(sql: str) -> str:
        for one in ("$__timeFilter(time_utc)", "time >= $__from / 1000 AND time < $__to / 1000"):
            sql = sql.replace(one, "WINDOW")
        return sql.replace('time_utc AS "time"', "time").replace("ORDER BY time_utc", "ORDER BY time")

    one, other = ([(q.panel, plain(q.sql)) for q in queries(kind)] for kind in ("sqlite", "postgresql"))
    assert one == other and len(one) >= 15


# -- container and unit --------------------------------------------------------------------------------------
def instructions() -> list[tuple[str, str]]:
    """(instruction, arguments) of the container file."""
    text = re.sub(r"(?m)^#.*\n", "", (FILES / "Containerfile").read_text(encoding="utf-8"))
    lines = [line for line in text.replace("\\\n", " ").splitlines() if line.strip()]
    return [(name, rest.strip()) for name, _, rest in (line.partition(" ") for line in lines)]


def test_the_container_is_built_of_files_that_there_are() -> None:
    found = instructions()
    assert found[0][0] == "FROM"
    for name, rest in found:
        if name == "COPY":
            *sources, _ = rest.split()
            assert [one for one in sources if not (ROOT / one).exists()] == []
        if name == "RUN":
            shlex.split(rest)
            done("sh", "-n", "-c", rest)
    settings = configparser.ConfigParser()
    settings.read(ROOT / "setup.cfg", encoding="utf-8")
    (extras,) = re.findall(r"/source\[([\w,]+)\]", dict(found)["RUN"] + " ".join(r for _, r in found))
    assert set(extras.split(",")) <= set(settings["options.extras_require"])
    words = dict(found)
    assert json.loads(words["ENTRYPOINT"]) == ["hygrokf"] and words["STOPSIGNAL"] == "SIGTERM"
    assert _parser().parse_args(json.loads(words["CMD"])).log == "json"
    _, _, check = words["HEALTHCHECK"].partition(" CMD ")
    compile(json.loads(check)[2], "HEALTHCHECK", "exec")


def test_the_example_of_compose_names_what_there_is(tmp_path: Path) -> None:
    compose = yaml.safe_load((FILES / "compose.yml").read_text(encoding="utf-8"))
    services = compose["services"]
    for one in services.values():
        assert set(one.get("depends_on", {})) <= set(services)
        assert set(one.get("secrets", ())) <= set(compose["secrets"])
        for volume in one["volumes"]:
            source = volume.partition(":")[0]
            own = source.startswith("./") and source != "./models"
            assert (FILES / source).is_file() if own else source in {*compose["volumes"], "./models"}
        assert all(port.startswith("127.0.0.1:") for port in one.get("ports", ()))
    build = services["hygrokf"]["build"]
    assert (FILES / build["context"]).resolve() == ROOT
    assert (ROOT / build["dockerfile"]).is_file()
    assert _parser().parse_args(services["hygrokf"]["command"]).log == "json"
    for name in ("hygrokf", "grafana"):
        entry = services[name]["entrypoint"]
        done("sh", "-n", "-c", entry[2].replace("$$", "$"))
    shell = [
        one.replace("$$", "$").replace("exec hygrokf", "exec echo")
        for one in services["hygrokf"]["entrypoint"]
    ]
    shell[2] = shell[2].replace("/run/secrets/database.password", "/dev/null")
    assert done(*shell, *services["hygrokf"]["command"]).split() == services["hygrokf"]["command"]


def test_the_tracker_s_file_of_compose_can_be_read(tmp_path: Path) -> None:
    write_fit(
        bare_fit("one", MODEL, {p.name: p.start for p in MODEL.model.parameters}), tmp_path / "models/T07"
    )
    (tmp_path / "token").write_text("a-token-of-the-tests-0123456789")
    text = (FILES / "compose_track.toml").read_text(encoding="utf-8")
    (tmp_path / "track.toml").write_text(text.replace("/run/secrets/page.token", "token"))
    found = read_config(tmp_path / "track.toml")
    (target,) = re.findall(r'targets: \["(\w+):8080"\]', (FILES / "prometheus.yml").read_text())
    assert found.page.behind_proxy and target in found.page.names and found.page.port == 8080


def test_grafana_is_told_of_files_that_compose_brings() -> None:
    sources = yaml.safe_load((FILES / "grafana_sources.yml").read_text(encoding="utf-8"))
    dashboard = json.loads((FILES / "grafana_postgresql.json").read_text(encoding="utf-8"))
    assert sources["datasources"][0]["type"] == dashboard["templating"]["list"][0]["query"]
    (provider,) = yaml.safe_load((FILES / "grafana_dashboards.yml").read_text(encoding="utf-8"))["providers"]
    compose = (FILES / "compose.yml").read_text(encoding="utf-8")
    assert f"grafana_postgresql.json:{provider['options']['path']}/" in compose


@pytest.fixture
def unit(tmp_path: Path) -> Iterator[Path]:
    """The unit, for a program that there is here."""
    text = (FILES / "hygrokf.service").read_text(encoding="utf-8")
    (command,) = re.findall(r"^ExecStart=/opt/hygrokf/bin/hygrokf (.*)$", text, re.MULTILINE)
    assert _parser().parse_args(shlex.split(command)).log == "json"
    made = tmp_path / "hygrokf.service"
    made.write_text(text.replace("/opt/hygrokf/bin/hygrokf", sys.executable))
    yield made


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
def test_systemd_has_nothing_to_say_of_the_unit(unit: Path) -> None:
    said = done("systemd-analyze", "verify", "--man=no", unit, cwd=unit.parent)
    assert [line for line in said.splitlines() if "hygrokf" in line] == []


def test_the_page_on_operation_names_every_file() -> None:
    text = document("live_operation.md").read_text(encoding="utf-8")
    missing = [one.name for one in FILES.iterdir() if f"live_files/{one.name}" not in text]
    assert missing == []
