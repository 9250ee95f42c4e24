"""`hygrokf track` as it is started: a process, its file, its page, signals, mistakes; and the defaults."""

from __future__ import annotations

import json
import math
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pytest
from builders.case_edits import exchange, nothing
from builders.command_line import environment, run
from builders.fit_case import bare_fit
from builders.live_case import live_fit
from builders.page_case import recent_record
from builders.store_case import queried
from builders.track_case import MODEL

from hygrokf.identification.fit import Fit, write_fit
from hygrokf.live import defaults, service
from hygrokf.live.service import Service
from hygrokf.live.storage.database import StoreUnready
from hygrokf.live.storage.store import Store, open_store

PATIENCE_S = 90.0
TRACK = """\
store = "sqlite:live.db"
page = "127.0.0.1:0"
[[turbine]]
name = "T07"
fit = "fit.json"
[mapping.signals]
Tcab = { signal = "cabinet_temperature", unit = "degC" }
Tamb = { signal = "ambient_temperature", unit = "degC" }
[[source]]
url = "file:live.csv"
"""
START_S = 1_772_366_400.0
"""[s] 2026-03-01T12:00Z."""


def write_model(folder: Path, fit: Fit) -> None:
    write_fit(bare_fit(fit.name, fit.design, fit.values), folder)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: a model, a tracker's file and a file of readings."""
    monkeypatch.chdir(tmp_path)
    write_model(tmp_path, Fit("one", MODEL, {p.name: p.start for p in MODEL.model.parameters}))
    (tmp_path / "track.toml").write_text(TRACK)
    (tmp_path / "live.csv").write_text("turbine,time,Tcab,Tamb\n" + rows(range(12)))
    return tmp_path


def rows(numbers: Sequence[int], header: str = "") -> str:
    """Rows every ten minutes, each with two readings."""
    at = (datetime.fromtimestamp(START_S + 600.0 * k, UTC).isoformat() for k in numbers)
    return header + "".join(f"T07,{t},{20 + k % 3},{10 + k % 2}\n" for k, t in zip(numbers, at, strict=True))


@dataclass
class Started:
    """A tracker's process, and what it has said so far on standard error."""

    process: subprocess.Popen
    log: Path

    def said(self) -> str:
        return self.log.read_text(encoding="utf-8")

    def until(self, happened: Callable[[], object], what: str) -> None:
        end = time.monotonic() + PATIENCE_S
        while not happened():
            assert self.process.poll() is None and time.monotonic() < end, (
                f"{what} did not happen: {self.said()}"
            )
            time.sleep(0.02)

    def ended(self) -> int:
        return self.process.wait(timeout=PATIENCE_S)


def command(folder: Path, *arguments: str, **more: object) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "hygrokf", *arguments],
        cwd=folder,
        env=environment(PYTHONWARNINGS="error"),
        **{"stdin": subprocess.DEVNULL, **more},
    )


@contextmanager
def tracker(folder: Path, *arguments: str, **more: object) -> Iterator[Started]:
    """`hygrokf track ARGUMENTS`, which ends with the block whatever happens in it."""
    log = folder / "stderr"
    with log.open("wb") as file:
        process = command(folder, "track", *arguments, stderr=file, stdout=file, **more)
    try:
        yield Started(process, log)
    finally:
        process.kill()
        process.wait(timeout=PATIENCE_S)
        if process.stdin is not None:
            process.stdin.close()


def observations(folder: Path, name: str = "live.db") -> int:
    """How many readings a store has; none before its tables are made."""
    try:
        return read(folder, lambda store: queried(store, "SELECT COUNT(*) FROM observation")[0][0], name)
    except StoreUnready:
        return 0


def read(folder: Path, view: Callable[[Store], object], name: str = "live.db") -> object:
    store = open_store(f"sqlite:{folder / name}", read_only=True)
    try:
        return view(store)
    finally:
        store.close()


def asked(url: str) -> dict:
    with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:
        return json.loads(answer.read())


# -- as it should be -----------------------------------------------------------------------------------------
def test_a_growing_file_the_page_and_a_restart(folder: Path) -> None:
    """Rows become readings and estimates, the page shows them; told to end it ends, and the next one goes on
    there.  A file that is not there yet is waited for."""
    text = (folder / "live.csv").read_text()
    (folder / "live.csv").unlink()
    with tracker(folder, "track.toml") as one:
        one.until(lambda: "does not exist yet" in one.said(), "a word on it")
        (folder / "live.csv").write_text(text)
        one.until(lambda: "page: http://" in one.said(), "a page")
        page = one.said().split("page: ")[1].split()[0]
        one.until(
            lambda: asked(f"{page}api/health")["turbines"] == 1 and observations(folder) == 24,
            "the first rows",
        )
        with (folder / "live.csv").open("a") as file:
            file.write(rows(range(12, 18)))
        one.until(lambda: observations(folder) == 36, "the rows that were added")
        (row,) = asked(f"{page}api/fleet")["turbines"]
        assert row["turbine"] == "T07" and asked(f"{page}healthz")["ok"] is True
        second = run("track track.toml --no-page")
        assert second.status == 2 and f"is already tracked by process {one.process.pid}" in second.err
        one.process.send_signal(signal.SIGTERM)
        assert one.ended() == 0, one.said()
    assert "ending" in one.said() and "done: 18 deliveries, all committed" in one.said()
    assert "Traceback" not in one.said()
    with (folder / "live.csv").open("a") as file:
        file.write(rows(range(18, 20)))
    with tracker(folder, "track.toml", "--no-page") as two:
        two.until(lambda: observations(folder) == 40, "what was added meanwhile")
        two.process.send_signal(signal.SIGINT)
        assert two.ended() == 0, two.said()
    assert "done: 2 deliveries" in two.said() and "page:" not in two.said()
    assert read(folder, Store.counters) == {}
    newest = read(folder, lambda store: queried(store, "SELECT MAX(time), COUNT(*) FROM estimate"))
    assert newest == [(START_S + 600.0 * 19, 20)]


def test_a_model_and_a_source_without_a_file(folder: Path) -> None:
    """Signals under their own names; the only turbine needs no name in the rows."""
    text = rows(range(12)).replace("T07,", "")
    text = "time,cabinet_temperature,ambient_temperature\n" + text
    (folder / "own.csv").write_text(text)
    of_file = run("track fit.json --source file:own.csv --store sqlite:own.db --no-page --until-ended")
    assert of_file.status == 0, of_file.err
    assert observations(folder, "own.db") == 24
    with tracker(folder, ".", "--source", "stdin", "--store", "sqlite:piped.db", "--no-page", "--until-ended",
        stdin=subprocess.PIPE) as piped:  # fmt: skip
        piped.process.stdin.write(text.encode())
        piped.process.stdin.close()
        assert piped.ended() == 0, piped.said()
    every = "SELECT signal, time, value FROM observation ORDER BY signal, time"
    stored = {str(read(folder, lambda s: queried(s, every), f"{name}.db")) for name in ("own", "piped")}
    assert len(stored) == 1


def test_logs_as_json_are_one_object_a_line(folder: Path) -> None:
    said = run("track track.toml --until-ended --log json")
    assert said.status == 0, said.err
    lines = [json.loads(line) for line in said.err.splitlines()]
    assert all({"time", "level", "name", "message"} <= set(line) for line in lines)
    told = {line["message"]: line for line in lines}
    assert told["tracking"]["turbines"] == 1 and told["page"]["url"].startswith("http://127.0.0.1:")
    assert told["source"]["source"].endswith("live.csv") and told["done"]["deliveries"] == 12
    (folder / "track.toml").write_text("x = 1\n")
    for name in ("nowhere.toml", "track.toml"):  # what keeps it from starting is JSON too
        said = run(f"track {name} --log json")
        (line,) = [json.loads(line) for line in said.err.splitlines()]
        assert said.status == 2 and line["level"] == "error" and name in line["fault"]


def test_a_weather_forecast_feeds_the_forecast(tmp_path: Path) -> None:
    """Ten days of readings in a file, two days of weather ahead of them in another one."""
    now = 600.0 * (time.time() // 600.0)
    record = recent_record(tmp_path / "turbine", seed=7, days=12.0, end_s=now + 2.0 * 86400.0)
    write_model(tmp_path / "model", live_fit(record))

    def lines(since: float, until: float, signals: Sequence[str]) -> str:
        found = []
        for name in signals:
            series = record.window(since, until)[name]
            for at, value in zip(series.time[~series.missing], series.value[~series.missing], strict=True):
                found.append((at, json.dumps({"time": at, name: value})))
        return "".join(f"{line}\n" for _, line in sorted(found))

    ambient = ("ambient_temperature", "ambient_relative_humidity")
    (tmp_path / "live.ndjson").write_text(lines(record.start_s, now, [s.signal for s in record.series]))
    (tmp_path / "weather.ndjson").write_text(lines(now, record.end_s, ambient))
    units = {
        "cabinet_temperature": "K", "cabinet_relative_humidity": "1", "ambient_temperature": "K",
        "ambient_relative_humidity": "1", "active_power": "W", "preheating": "1",
    }  # fmt: skip
    fields = []
    for series in record.series:
        mean = f', stamp = "end", interval = "{series.interval_s:g}s"' if series.interval_s else ""
        fields.append(
            f'{series.signal} = {{ signal = "{series.signal}", unit = "{units[series.signal]}"{mean} }}'
        )
    (tmp_path / "track.toml").write_text(
        '[[turbine]]\nname = "T07"\nfit = "model"\nrated_power_kW = 2050\n[mapping]\nturbine = '
        '""\n[mapping.signals]\n'
        + "\n".join(fields)
        + '\n[[source]]\nurl = "file:weather.ndjson"\nweather = true\n[[source]]\nurl = "file:live.ndjson"\n'
    )
    done = run(f"track {tmp_path}/track.toml --store sqlite:{tmp_path}/live.db --no-page --until-ended")
    assert done.status == 0, done.err
    said = read(tmp_path, lambda store: store.memory("T07", "forecast"))
    assert said["basis"]["code"] == "weather_forecast", (said, done.err)
    rows_of = read(tmp_path, lambda store: queried(store, "SELECT COUNT(*), MIN(time) FROM forecast"))
    assert rows_of[0][0] > 90 and abs(rows_of[0][1] - now) < 86400.0
    assert read(tmp_path, lambda store: queried(store, "SELECT COUNT(*) FROM weather"))[0][0] > 100
    assert read(tmp_path, Store.counters) == {}


# -- mistakes ------------------------------------------------------------------------------------------------
def other_database(folder: Path) -> None:
    import sqlite3

    with sqlite3.connect(folder / "live.db") as found:
        found.execute("CREATE TABLE mine (a)")
    found.close()


edited = partial(exchange, "track.toml")
FIT = "fit.json --no-page"
MISTAKES: dict[str, tuple[str, Callable[[Path], None], tuple[str, ...]]] = {
    "no argument": ("", nothing, ("expected a TRACK.toml or FIT.json",)),
    "two files": ("track.toml fit.json", nothing, ("give it alone",)),
    "no source": (FIT, nothing, ("no source: add --source",)),
    "unknown scheme": (f"{FIT} --source kafka://x", nothing,
        ("--source 1: url must begin with one of file:",)),
    "a broker without topics": (f"{FIT} --source mqtt://x", nothing, ("topics must be a list",)),
    "a password for a broker": (f"{FIT} --source mqtt://me:geheim@x", nothing,
        ("a password must not be",)),
    "a missing model": ("none.json --source stdin --no-page", nothing, ("no such file; run `hygrokf fit`",)),
    "one model twice": ("fit.json . --source stdin --no-page", nothing, ("a second model of 'one'",)),
    "another scheme of store": (f"{FIT} --source stdin --store mysql:x", nothing,
        ("--store: expected sqlite:PATH",)),
    "a password for the store": (
        f"{FIT} --source stdin --store postgresql://me:geheim@host/x", nothing,
        ("--store: the password does not belong",),
    ),
    "no folder for the store": (f"{FIT} --source stdin --store sqlite:none/x.db", nothing,
        ("none does not exist; make it",)),
    "a page for others without token": (
        "fit.json --source stdin --page 0.0.0.0:8080", nothing,
        ("other machines reach 0.0.0.0", "token_file"),
    ),
    "no address of a page": ("fit.json --source stdin --page here", nothing, ("page must be HOST:PORT",)),
    "speed": ("--demo --speed abc", nothing, ("expected a number above 0", "'abc'")),
    "demo with a source": ("--demo --source stdin", nothing, ("brings its own turbine",)),
    "no file to the end": (f"{FIT} --source file:none.csv --until-ended", nothing,
        ("none.csv: no such file",)),
    "a store of another program": (
        "track.toml", other_database, ("expected a store of hygrokf, found another database",)
    ),
    "a damaged store": (
        "track.toml",
        lambda folder: (folder / "live.db").write_text("no database, but text of some length " * 50),
        ("it cannot be read as a store", "restore a copy"),
    ),
    "many faults": (
        "track.toml",
        edited(("store =", "stroe ="), ('page = "127.0.0.1:0"', "page = 7"),
            ('fit = "fit.json"', 'fit = "none"'),
               ('"degC" }', '"kPa" }'), ("file:live.csv", "ftp://x")),
        ('unknown key "stroe"; expected store', "page: expected", "none", "kPa",
            "url must begin with one of"),
    ),
    "no TOML": ("track.toml", lambda folder: (folder / "track.toml").write_text("[[turbine"),
        ("not valid TOML",)),
}  # fmt: skip


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


@pytest.mark.parametrize("line", ["track --demo", "doctor a.toml", "export --store sqlite:a.db --out out"])
def test_without_sqlalchemy_the_extra_is_named(line: str, tmp_path: Path) -> None:
    text = "import sys; sys.modules['sqlalchemy'] = None; from hygrokf.commands.main import main; "
    text += f"sys.exit(main({line.split()}))"
    ended = subprocess.run(
        [sys.executable, "-c", text], cwd=tmp_path, env=environment(), capture_output=True, text=True
    )
    assert (ended.returncode, ended.stdout) == (2, "") and not list(tmp_path.iterdir())
    assert "pip install 'hygrokf[live]'" in ended.stderr and "Traceback" not in ended.stderr


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_told_and_nothing_is_begun(name: str, folder: Path) -> None:
    line, spoil, words = MISTAKES[name]
    spoil(folder)
    before = contents(folder)
    said = run(f"track {line}")
    assert said.status == 2 and said.out == "" and all(one in said.err for one in words), said.err
    assert "Traceback" not in said.err and "geheim" not in said.err
    # whether a file is there shows after the store was opened
    new = {"live.db", "live.db.lock"} if name == "no file to the end" else set()
    assert {file for file, content in contents(folder).items() if before.get(file) != content} == new


def test_a_page_s_address_that_is_in_use(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        said = run(f"track track.toml --page 127.0.0.1:{other.getsockname()[1]}")
    assert said.status == 2 and "the port is in use by another program" in said.err
    assert not (folder / "live.db").exists()


# -- the demo ------------------------------------------------------------------------------------------------
def test_the_demo_finds_and_names_what_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer days than the demo has, as fast as they are taken: the same model, cabinets, change and
    questions."""
    days_of = {"LIVE_DAYS": 30.0, "KNOWN_DAYS": 8.0, "CHANGED_DAYS": 3.0, "RECORD_DAYS": 60.0}
    for name, days in days_of.items():
        monkeypatch.setattr(defaults, name, days)
    # whether a gap of the record is noticed depends on how quick the machine is
    monkeypatch.setattr(service, "TICK_S", math.inf)
    turbines, record, live_s = defaults.demo_turbines(tmp_path)
    record = record.window(record.start_s, live_s + 11.0 * 86400.0)
    assert list(turbines) == list(defaults.TURBINE_NAMES) and len(turbines) == 3
    assert defaults.demo_stream(record, live_s, 0.0).label.startswith("Demo: ")  # what the page marks it with
    url = f"sqlite:{tmp_path / 'live.db'}"
    Service(turbines, [defaults.demo_stream(record, live_s, 0.0)], url).run(until_ended=True)
    store = open_store(url, read_only=True)
    try:
        still_open = "SELECT turbine, kind, statement, remedy, began FROM alarm WHERE ended IS NULL"
        alarms = queried(store, still_open)
        forecasts = dict(queried(store, "SELECT turbine, COUNT(*) FROM forecast GROUP BY turbine"))
        seen = queried(store, "SELECT DISTINCT turbine, signal FROM observation WHERE signal LIKE 'cabinet%'")
    finally:
        store.close()
    assert {(turbine, kind) for turbine, kind, *_ in alarms} == {
        (name, "cabinet changed") for name in list(defaults.TURBINE_NAMES)[:2]
    }
    for _, _, statement, remedy, began in alarms:
        assert "loses its heat more slowly: thermal time constant +" in statement and "filters" in remedy
        assert began > live_s + 3.0 * 86400.0
    assert set(forecasts) == set(defaults.TURBINE_NAMES) and min(forecasts.values()) > 90
    assert len(seen) == 3
    # what is there from an earlier demo is used again
    monkeypatch.setattr(defaults, "identify", lambda *_, **__: pytest.fail("the model was identified again"))
    assert list(defaults.demo_turbines(tmp_path)[0]) == list(defaults.TURBINE_NAMES)
