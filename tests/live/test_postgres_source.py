"""A database as a source: all rows, once, whatever the server, the writers and the tracker do meanwhile."""

from __future__ import annotations

import math
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, date, datetime
from decimal import Decimal
from pathlib import Path

import psycopg
import pytest
from builders.databases import OWNER, Server
from builders.live_case import count_of, expect_offline
from builders.rejections import counted
from builders.service_case import in_small_rounds, running
from builders.track_case import write_model
from builders.waiting import eventually

from hygrokf.data.record import Record
from hygrokf.data.toml_form import Place
from hygrokf.live.config import ConfigFault, read_config, stream_of
from hygrokf.live.doctor.examination import examine
from hygrokf.live.service import Service
from hygrokf.live.sources import postgres_source as module
from hygrokf.live.sources import stream as streams
from hygrokf.live.sources.local import record_mapping, record_messages
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.payload_formats import Refused
from hygrokf.live.sources.payload_values import Clock
from hygrokf.live.sources.postgres_source import PostgresForm, PostgresQuery, number_of
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.turbines import Turbine

NARROW = "SELECT * FROM reading WHERE {0} > %(after)s ORDER BY {0}, time, id"
TABLE = """CREATE TABLE reading (
    id BIGSERIAL PRIMARY KEY, turbine TEXT, time DOUBLE PRECISION, tag TEXT, value DOUBLE PRECISION,
    received TIMESTAMPTZ NOT NULL DEFAULT now(),
    local TIMESTAMP NOT NULL DEFAULT (now() AT TIME ZONE 'UTC'),
    seconds DOUBLE PRECISION NOT NULL DEFAULT extract(epoch FROM now()))"""
INSERT = "INSERT INTO reading (turbine, time, tag, value) VALUES ('T1', %s, %s, %s)"
RISING = (
    [-5, 0, 7, 2**62], [Decimal("-1e300"), Decimal("1.5"), Decimal("2")], [-math.inf, 0.0, 1e300, math.inf],
    [date(1999, 1, 1), date(2026, 2, 28)], [datetime(1999, 1, 1), datetime(2026, 2, 28, 1)],
    [datetime(1999, 1, 1, tzinfo=UTC), datetime(2026, 2, 28, 1, tzinfo=UTC)],
)  # fmt: skip
MAPPING = PayloadMapping(
    {"Tcab": Field("cabinet_temperature", "degC")}, turbines={"T1": "T1"}, tag="tag", value="value"
)


@pytest.mark.parametrize("rising", RISING, ids=lambda one: type(one[0]).__name__)
def test_watermarks_order_the_versions_of_a_value(rising: Sequence) -> None:
    numbers = [number_of(one) for one in rising]
    assert numbers == sorted(set(numbers)) and max(numbers) < math.inf


class Rows:
    """What a stream has put: ids of rows, and the place of the last one."""

    def __init__(self) -> None:
        self.ids: list[int] = []
        self.places: list[str] = []

    def __call__(self, one: Delivery) -> None:
        self.ids.append(one.content["id"])
        self.places.append(one.place)


@pytest.fixture
def historian(postgresql: Server) -> str:
    """The name of a database with an empty table of readings."""
    name = postgresql.database()
    postgresql.execute(name, TABLE)
    return name


@pytest.fixture
def add(postgresql: Server, historian: str) -> Callable[..., None]:
    """Adds rows, each with the next id."""

    def added(count: int, **fixed: str) -> None:
        names, values = ", ".join(["turbine", *fixed]), ", ".join(["'T1'", *fixed.values()])
        postgresql.execute(
            historian, f"INSERT INTO reading ({names}) SELECT {values} FROM generate_series(1, {count})"
        )

    return added


def source(url: str, watermark: str = "id", **more: float) -> PostgresQuery:
    settings = {"poll_s": 0.05, "lag_s": 0.0, **more}
    return PostgresQuery(PostgresForm(url, NARROW.format(watermark), watermark, **settings), MAPPING)


@contextmanager
def followed(stream: PostgresQuery, place: str | None = None) -> Iterator[Rows]:
    rows = Rows()
    stream.start(place, rows)
    try:
        yield rows
    finally:
        stream.stop()
        assert stream.state.word == "stopped"


# -- rows ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("watermark", ["id", "received", "local", "seconds"])
def test_rows_come_once_and_a_restart_goes_on(
    postgresql: Server, historian: str, add: Callable[..., None], watermark: str
) -> None:
    url = postgresql.url(historian)
    add(5)
    add(5)
    with followed(source(url, watermark)) as rows:
        eventually(lambda: len(rows.ids) >= 10)
        add(5)
        eventually(lambda: len(rows.ids) >= 15)
        time.sleep(0.2)
        assert rows.ids == list(range(1, 16))
    with followed(source(url, watermark), rows.places[-1]) as later:
        add(5)
        eventually(lambda: 20 in later.ids)
    # the highest watermark before the restart is read again, and nothing is left out
    assert set(later.ids) >= set(range(16, 21)) and len(later.ids) == len(set(later.ids))
    assert min(later.ids) >= 6


def test_many_rows_with_ties_are_read_in_bounded_queries(
    postgresql: Server, historian: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """10,000 rows whose watermarks are the same in groups of up to 700: no group is cut."""
    monkeypatch.setattr(module, "ROWS_PER_QUERY", 500)
    sizes = [1 + (37 * k) % 700 for k in range(28)]
    total = 0
    for group, size in enumerate(sizes):
        stamp = f"to_timestamp({1.7e9 + group})"
        postgresql.execute(
            historian, f"INSERT INTO reading (received) SELECT {stamp} FROM generate_series(1, {size})"
        )
        total += size
    postgresql.execute(
        historian,
        f"INSERT INTO reading (received) SELECT to_timestamp({1.7e9 + 100} + i / 10) "
        f"FROM generate_series(1, {10_000 - total}) i",
    )
    with followed(source(postgresql.url(historian), "received", lag_s=0.2)) as rows:
        eventually(lambda: len(rows.ids) >= 10_000)
        time.sleep(0.5)
    assert sorted(rows.ids) == list(range(1, 10_001))
    # each place is one from which every row after it comes: a restart anywhere leaves nothing out
    for at in (0, 700, 4_321, 9_998):
        with followed(source(postgresql.url(historian), "received"), rows.places[at]) as later:
            eventually(lambda later=later, at=at: set(rows.ids[at:]) <= set(later.ids))


@pytest.mark.parametrize("watermark", ["id", "received"])
def test_rows_that_commit_late_are_found(postgresql: Server, historian: str, watermark: str) -> None:
    """Writers whose transactions overlap: each takes its watermark first and commits up to 0.3 s later."""
    url, random_ = postgresql.url(historian), random.Random(8)
    waits = [[random_.uniform(0.0, 0.3) for _ in range(12)] for _ in range(5)]

    def write(own: Sequence[float]) -> None:
        with psycopg.connect(url) as connection:
            for wait in own:
                connection.execute("INSERT INTO reading (turbine) VALUES ('T1')")
                time.sleep(wait)
                connection.commit()

    with followed(source(url, watermark, lag_s=0.6)) as rows:
        writers = [threading.Thread(target=write, args=(own,)) for own in waits]
        for one in writers:
            one.start()
        for one in writers:
            one.join(timeout=60.0)
        eventually(lambda: len(rows.ids) >= 60, lambda: rows.ids)
        time.sleep(0.3)
    assert sorted(rows.ids) == list(range(1, 61))
    assert rows.ids != sorted(rows.ids)  # some did come late


def test_a_restart_in_between_finds_what_commits_late(postgresql: Server, historian: str) -> None:
    url = postgresql.url(historian)
    with psycopg.connect(url) as late:
        late.execute("INSERT INTO reading (turbine) VALUES ('T1')")  # id 1, not committed
        postgresql.execute(historian, "INSERT INTO reading (turbine) VALUES ('T1'), ('T1')")
        with followed(source(url, lag_s=30.0)) as rows:
            eventually(lambda: rows.ids == [2, 3])
    with followed(source(url, lag_s=30.0), rows.places[-1]) as later:
        eventually(lambda: set(later.ids) == {1, 2, 3})


def test_the_history_before_look_back_is_left(postgresql: Server, historian: str) -> None:
    postgresql.execute(
        historian, "INSERT INTO reading (received) VALUES (now() - interval '2 days'), (now())"
    )
    with followed(source(postgresql.url(historian), "received", look_back_s=86400.0)) as rows:
        eventually(lambda: rows.ids == [2])


# -- with the tracker ----------------------------------------------------------------------------------------
def test_an_outage_of_the_server_and_restarts_end_in_the_offline_filter(
    postgresql: Server,
    historian: str,
    tmp_path: Path,
    record: Record,
    turbine: Turbine,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A record as a narrow table, written in four parts; the server dies, the tracker is restarted."""
    in_small_rounds(monkeypatch, 400)
    monkeypatch.setattr(streams, "SOURCE_BACK_OFF_S", (0.05, 0.1))
    rows = []
    for at, content in record_messages(record, "T1"):
        rows += [(at, name, value) for name, value in content.items() if name not in ("turbine", "time")]
    mapping = replace(record_mapping(record, "T1"), tag="tag", value="value")
    store, share = f"sqlite:{tmp_path / 'live.db'}", len(rows) // 4

    def write(part: int) -> None:
        with psycopg.connect(postgresql.url(historian)) as connection:
            own = rows[part * share : (part + 1) * share if part < 3 else len(rows)]
            connection.cursor().executemany(INSERT, own)

    def tracked() -> tuple[Service, PostgresQuery]:
        stream = source(postgresql.url(historian), "received", lag_s=0.3)
        stream.mapping = mapping
        return Service({"T1": turbine}, [stream], store), stream

    service, stream = tracked()
    with running(service):
        write(0)
        eventually(lambda: service.health.deliveries >= share // 2)
        postgresql.kill()
        eventually(lambda: stream.state.word == "lost")
        assert "\n" not in stream.state.words and postgresql.password not in stream.state.words
        postgresql.start()
        eventually(lambda: stream.state.word == "connected")
        write(1)
        eventually(lambda: service.health.deliveries >= share)
    service, stream = tracked()
    with running(service):
        write(2)
        eventually(lambda: service.health.deliveries > 0)
    write(3)
    service, stream = tracked()
    stream.end_when_read()
    service.run(until_ended=True)
    assert count_of(record) == len(rows)
    expect_offline(store, record, turbine)


def test_a_wide_table_with_times(
    postgresql: Server, historian: str, tmp_path: Path, record: Record, turbine: Turbine
) -> None:
    """One column a signal, `timestamptz` as time and watermark, missing values as NULL."""
    signals = [one.signal for one in record.series]
    columns = ", ".join(f"{name} DOUBLE PRECISION" for name in signals)
    postgresql.execute(historian, f"CREATE TABLE wide (stamp TIMESTAMPTZ, turbine TEXT, {columns})")
    by_time: dict[float, dict[str, float]] = {}
    for at, content in record_messages(record, "T1"):
        by_time.setdefault(at, {}).update({k: v for k, v in content.items() if k in signals})
    with psycopg.connect(postgresql.url(historian)) as connection:
        connection.cursor().executemany(
            f"INSERT INTO wide VALUES (to_timestamp(%s), 'T1'{', %s' * len(signals)})",
            [(at, *(own.get(name) for name in signals)) for at, own in by_time.items()],
        )
    text = "SELECT * FROM wide WHERE stamp > %(after)s ORDER BY stamp"
    mapping = replace(record_mapping(record, "T1"), time="stamp")
    stream = PostgresQuery(PostgresForm(postgresql.url(historian), text, "stamp"), mapping)
    stream.end_when_read()
    store = f"sqlite:{tmp_path / 'live.db'}"
    Service({"T1": turbine}, [stream], store).run(until_ended=True)
    expect_offline(store, record, turbine)


# -- what Python does not have -------------------------------------------------------------------------------
ODD = ("infinity", "-infinity", "4713-01-01 BC", "20000-01-01", "0044-03-15 BC")
ENDLESS = ("infinity", "2026-03-01", "4713-01-01 BC", "2026-03-02", "20000-01-01", "infinity")
FAR = ("2026-03-01", "2026-03-01", "2026-03-01", "2026-03-02", "8000-01-01", "9000-01-01")


def read_all(stream: PostgresQuery) -> tuple[list[float], Counter[str]]:
    """Values of the readings, and what is counted, until all present rows are read."""
    values: list[float] = []
    counts: Counter[str] = Counter()

    def put(one: Delivery) -> None:
        try:
            for of in stream.mapping.read(one.content, one.received):
                values.extend(round(reading.value - 273.15, 6) for reading in of.readings)
                counts.update(counted(of))
        except Refused as refusal:
            counts[refusal.kind] += 1

    stream.end_when_read()
    stream.start(None, put)
    eventually(lambda: stream.state.word == "ended", lambda: stream.state)
    return values, counts


@pytest.mark.parametrize("kind", ["timestamptz", "timestamp", "date"])
def test_rows_of_impossible_times_are_counted_and_the_others_come(
    postgresql: Server, historian: str, kind: str
) -> None:
    """In the stamp of a row and in a column that nobody reads; a value that is no number costs itself."""
    postgresql.execute(
        historian,
        f"CREATE TABLE odd (id BIGSERIAL, turbine TEXT, stamp {kind}, value NUMERIC, "
        f"tag TEXT DEFAULT 'Tcab', until {kind} DEFAULT 'infinity', span INTERVAL, clock TIME, zoned TIMETZ)",
    )
    for number, stamp in enumerate(("2026-03-01", *ODD, "2026-03-02")):
        postgresql.execute(
            historian,
            f"INSERT INTO odd (turbine, stamp, value, span, clock, zoned) VALUES "
            f"('T1', '{stamp}', {number}, '900000 years', '24:00', '24:00+00')",
        )
    postgresql.execute(
        historian, "INSERT INTO odd (turbine, stamp, value) VALUES ('T1', '2026-03-03', 'NaN')"
    )
    text = "SELECT * FROM odd WHERE id > %(after)s ORDER BY id"
    mapping = replace(MAPPING, time="stamp", clock=Clock(UTC))
    values, counts = read_all(PostgresQuery(PostgresForm(postgresql.url(historian), text, "id"), mapping))
    assert values == [0.0, 6.0] and counts == {"impossible time": len(ODD), "no number": 1}


@pytest.mark.parametrize(
    ("kind", "watermarks"),
    [
        *((kind, times) for kind in ("timestamptz", "timestamp", "date") for times in (ENDLESS, FAR)),
        ("double precision", ("NaN", "1", "-1e308", "2", "Infinity", "NaN")),
        ("numeric", ("NaN", "1", "-1e200", "2", "Infinity", "NaN")),
    ],
)
def test_a_watermark_that_cannot_be_passed_hides_no_later_row(
    postgresql: Server, historian: str, kind: str, watermarks: Sequence[str]
) -> None:
    postgresql.execute(historian, f"CREATE TABLE marked (id BIGSERIAL, turbine TEXT, mark {kind})")

    def add(mark: str) -> None:
        postgresql.execute(historian, f"INSERT INTO marked (turbine, mark) VALUES ('T1', '{mark}')")

    for mark in watermarks:
        add(mark)
    text = "SELECT * FROM marked WHERE mark > %(after)s ORDER BY mark, id"
    query = PostgresForm(postgresql.url(historian), text, "mark", poll_s=0.05, lag_s=0.0)
    with followed(PostgresQuery(query, MAPPING)) as rows:
        eventually(lambda: len(rows.ids) >= 6)
        add("3" if watermarks[1] == "1" else "2026-03-03")
        eventually(lambda: 7 in rows.ids)
        assert sorted(rows.ids) == list(range(1, 8))
    with followed(PostgresQuery(query, MAPPING), rows.places[-1]) as later:
        add("4" if watermarks[1] == "1" else "2026-03-04")
        eventually(lambda: 8 in later.ids)


# -- what is wrong -------------------------------------------------------------------------------------------
def lost(stream: PostgresQuery) -> str:
    """Why a source is lost."""
    with followed(stream):
        eventually(lambda: stream.state.word == "lost", lambda: stream.state)
        return stream.state.words


@pytest.mark.parametrize(
    ("query", "watermark", "words"),
    [
        ("SELECT * FROM nowhere WHERE id > %(after)s ORDER BY id", "id", 'relation "nowhere" does not exist'),
        ("SELECT * FROM reading WHERE id > %(after)s ORDER BY id", "stamp", "expected the watermark 'stamp'"),
        ("SELECT * FROM reading WHERE tag > %(after)s ORDER BY tag", "tag", "found tag of type text"),
        ("SELECT * FROM reading WHERE id > %(after)s ORDER BY id DESC", "id", "add ORDER BY id"),
        ("DELETE FROM reading WHERE id > %(after)s RETURNING id", "id", "read-only transaction"),
        ("SELECT id FROM reading WHERE id ~ %(after)s", "id", "operator does not exist"),
    ],
)
def test_a_query_that_cannot_be_followed_is_told(
    postgresql: Server, historian: str, add: Callable[..., None], query: str, watermark: str, words: str
) -> None:
    add(3)
    said = lost(PostgresQuery(PostgresForm(postgresql.url(historian), query, watermark), MAPPING))
    assert words in said and "\n" not in said and "Traceback" not in said
    assert postgresql.execute(historian, "SELECT COUNT(*) FROM reading") == [(3,)]


def test_a_watermark_of_another_type_than_before_is_told(postgresql: Server, historian: str) -> None:
    stream = source(postgresql.url(historian))
    with followed(stream, "timestamptz 2026-01-01T00:00:00+00:00"):
        eventually(lambda: "give the source a new name" in stream.state.words)


def test_faults_of_the_table_are_told_together(tmp_path: Path) -> None:
    place = Place()
    table = {
        "url": "postgresql://me:geheim@host/scada",
        "query": "SELECT * FROM reading WHERE tag LIKE 'T%' ORDER BY id",
        "watermark": "id", "poll": "0s", "password_file": "a", "password_env": "B",
    }  # fmt: skip
    assert stream_of(table, place, tmp_path, MAPPING) is None
    said = "\n".join(map(str, place.faults))
    for words in ("does not belong in the URL", "query must ask for new rows", "0.1s", "keep one"):
        assert words in said
    assert "geheim" not in said


def test_a_password_comes_from_a_file_and_shows_nowhere(
    postgresql: Server,
    historian: str,
    add: Callable[..., None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("PGPASSWORD", raising=False)
    (tmp_path / "right").write_text(postgresql.password + "\n")
    (tmp_path / "wrong").write_text("falsch-geheim\n")
    add(2)
    url = postgresql.tcp_url(historian)
    query = PostgresForm(url, NARROW.format("id"), "id", password_file=str(tmp_path / "right"))
    with followed(PostgresQuery(query, MAPPING)) as rows:
        eventually(lambda: rows.ids == [1, 2])
    said = lost(PostgresQuery(replace(query, password_file=str(tmp_path / "wrong")), MAPPING))
    assert f'password authentication failed for user "{OWNER}"' in said and "geheim" not in said


# -- the tracker's file and the doctor -----------------------------------------------------------------------
TRACK = '''\
[[turbine]]
name = "T1"
fit = "T1"
[mapping]
tag = "tag"
value = "value"
[mapping.signals]
Tcab = {{ signal = "cabinet_temperature", unit = "degC" }}
[[source]]
url = "{url}"
query = """
SELECT turbine, time, tag, value, {watermark} FROM reading
WHERE {watermark} > %(after)s ORDER BY {watermark}"""
watermark = "{watermark}"
poll = "5s"
'''


def examined(folder: Path, url: str, watermark: str = "received") -> list[tuple[str, str]]:
    write_model(folder / "T1")
    (folder / "track.toml").write_text(TRACK.format(url=url, watermark=watermark))
    config = read_config(folder / "track.toml")
    checks = examine(config, folder / "track.toml", 0.2, False)
    return [(one.level, one.text) for one in checks if one.about.startswith("source postgresql:")]


def test_the_doctor_reads_the_newest_rows(postgresql: Server, historian: str, tmp_path: Path) -> None:
    found = examined(tmp_path, postgresql.url(historian))
    assert ("doubt", "no rows of the last 30 d") in found
    now = time.time()
    with psycopg.connect(postgresql.url(historian)) as connection:
        connection.cursor().executemany(
            INSERT, [(now - 60.0, "Tcab", 25.0), (now - 30.0, "Tcab", 25.5), (now - 30.0, "Tgear", 60.0)]
        )
    for watermark in ("received", "id"):
        found = examined(tmp_path, postgresql.url(historian), watermark)
        said = "\n".join(f"{level} {words}" for level, words in found)
        assert f"ok connected; the query gives turbine, time, tag, value, {watermark}" in said
        assert "ok its clock agrees" in said
        assert "doubt 2 of 3" in said and "1 unknown tag" in said
        newest = datetime.fromtimestamp(now - 30.0, UTC)
        assert f"ok its newest reading is from {newest:%Y-%m-%dT%H:%M}" in said
    found = examined(tmp_path, postgresql.url("nowhere"))
    assert [level for level, _ in found] == ["fault"] and 'database "nowhere" does not exist' in found[0][1]
    postgresql.execute(historian, "DROP TABLE reading")
    found = examined(tmp_path, postgresql.url(historian))
    assert found == [("fault", 'relation "reading" does not exist')]


def test_two_queries_of_a_database_need_names(postgresql: Server, historian: str, tmp_path: Path) -> None:
    write_model(tmp_path / "T1")
    text = TRACK.format(url=postgresql.url(historian), watermark="id")
    source_ = text[text.index("[[source]]") :]
    (tmp_path / "track.toml").write_text(text + source_)
    with pytest.raises(ConfigFault, match="is a source already"):
        read_config(tmp_path / "track.toml")
    (tmp_path / "track.toml").write_text(text + source_ + 'name = "second"\n')
    urls = [one.url for one in read_config(tmp_path / "track.toml").streams]
    assert urls[1] == f"{urls[0]}#second"
