"""The doctor: what is sound is called so, each fault is found and comes with what to do, and nothing is
changed."""

from __future__ import annotations

import json
import math
import os
import shutil
import sqlite3
import ssl
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from builders.brokers import (
    authority,
    dynamic_security,
    mosquitto,
    needs_mosquitto,
    password_file,
    peer,
    publish,
)
from builders.ports import free_port
from builders.track_case import write_model
from builders.waiting import eventually, repeating

from hygrokf.commands.main import main
from hygrokf.live.config import read_config
from hygrokf.live.doctor import check as doctor_check
from hygrokf.live.doctor import examination as doctor_store
from hygrokf.live.doctor import sources as doctor_sources
from hygrokf.live.doctor.check import (
    machine_checks,
    monotonic_epoch,
    server_check,
    stamp_check,
    validity_check,
    worst,
)
from hygrokf.live.doctor.examination import examine, page_checks
from hygrokf.live.service import Service
from hygrokf.live.sources.opcua_client import Connection
from hygrokf.live.storage.store import open_store
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.texts.doctor_codes import Check, CheckCode
from hygrokf.texts.wording import several

TRACK = """\
store = "sqlite:live.db"
page = "127.0.0.1:0"
[[turbine]]
name = "T07"
fit = "T07"
[mapping]
time = "time"
[mapping.signals]
Tcab = { signal = "cabinet_temperature", unit = "degC" }
Tamb = { signal = "ambient_temperature", unit = "degC" }
RH = { signal = "cabinet_relative_humidity", unit = "%" }
"""
FILE = '[[source]]\nurl = "file:live.csv"\n'
HOUR_S, DAY_S = 3600.0, 86400.0


def iso(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat()


def row(at: float, turbine: str = "T07", cabinet: float = 25.0, ambient: float = 10.0) -> str:
    return f"{turbine},{iso(at)},{cabinet},{ambient}\n"


def write_rows(path: Path, end_s: float, hours: float = 6.0, turbine: str = "T07") -> None:
    """Rows every ten minutes, the last one at a time [s]."""
    times = [end_s - 600.0 * k for k in range(int(6 * hours))][::-1]
    path.write_text(
        "turbine,time,Tcab,Tamb\n" + "".join(row(t, turbine, 25.0 + k % 3) for k, t in enumerate(times))
    )


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model, a file of readings up to now, and a store that a tracker filled from it."""
    folder = tmp_path_factory.mktemp("plant")
    write_model(folder / "T07")
    write_rows(folder / "live.csv", time.time() - 30.0)
    (folder / "track.toml").write_text(TRACK + FILE + "follow = false\n")
    config = read_config(folder / "track.toml")
    Service(config.turbines, config.streams, config.store).run(until_ended=True)
    (folder / "track.toml").write_text(TRACK + FILE)
    return folder


@pytest.fixture
def folder(plant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, in which things may be broken; this machine's clock counts as kept."""
    monkeypatch.setattr(doctor_check, "is_synchronised", lambda: True)
    shutil.copytree(plant, tmp_path / "plant")
    (tmp_path / "plant" / "pw").write_text("right")
    (tmp_path / "plant" / "pw").chmod(0o600)
    return tmp_path / "plant"


def changed(folder: Path, *changes: tuple[str, str]) -> Path:
    file = folder / "track.toml"
    text = file.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    file.write_text(text)
    return file


def looked(folder: Path, wait_s: float = 0.3, with_page: bool = False) -> list[Check]:
    file = folder / "track.toml"
    return examine(read_config(file), file, wait_s, with_page)


def said(checks: list[Check], level: str, words: str, remedy: str = "") -> Check:
    """The one check of this level that says so; every one that is not fine says what to do."""
    assert all(bool(one.remedy) == (one.level != "ok") for one in checks), checks
    found = [c for c in checks if c.level == level and words in f"{c.about}: {c.text}" and remedy in c.remedy]
    assert len(found) == 1, "\n".join(map(str, checks))
    return found[0]


def troubles(checks: list[Check]) -> list[str]:
    return [str(one) for one in checks if one.level != "ok"]


def grow(path: Path) -> None:
    """Append a row to a file."""
    with path.open("a") as file:
        file.write(row(time.time()))


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    return {
        str(one.relative_to(folder)): (one.read_bytes(), one.stat().st_mtime_ns)
        for one in folder.rglob("*")
        # SQLite puts its log and index, both empty, beside a store that is read
        if one.is_file() and one.name not in ("live.csv", "live.db-wal", "live.db-shm")
    }


# -- all is well ---------------------------------------------------------------------------------------------
def test_a_sound_set_up_is_called_sound_and_left_as_it_is(folder: Path) -> None:
    (folder / "token").write_text("a-token-of-enough-characters")
    (folder / "token").chmod(0o600)
    changed(folder, ('page = "127.0.0.1:0"', 'page = { address = "127.0.0.1:0", token_file = "token" }'))
    before = contents(folder)
    with repeating(lambda: grow(folder / "live.csv")):
        found = looked(folder, wait_s=5.0, with_page=True)
    assert troubles(found) == [] and worst(found) == "ok"
    for words in (
        "clock: it is synchronised", "other users cannot read",
        "it grows: ", "last rows gave readings", "is reached and intact", "free on its disk",
        "no process tracks these turbines now", "newest estimates: T07 ",
        "turbines: 1 have a model that can run", "the address is free",
    ):  # fmt: skip
        assert any(words in str(one) for one in found), words
    assert contents(folder) == before


def test_the_command_its_status_and_its_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def told(line: str) -> tuple[int, str, str]:
        return main(["doctor", *line.split()]), *capsys.readouterr()

    status, out, err = told(f"{folder}/track.toml --wait 0.1s")
    assert (status, err) == (0, "") and out.splitlines()[-1].endswith(" 0 fault: ready to track")
    assert all(line.split()[0] in ("ok", "doubt") for line in out.splitlines()[:-1])
    status, out, err = told(
        f"{folder}/track.toml --wait 0.1s --json --no-page --store sqlite:{folder}/none/x.db"
    )
    found = json.loads(out)
    assert (status, err, found["level"]) == (1, "", "fault")
    (wrong,) = [one for one in found["checks"] if one["level"] == "fault"]
    assert (wrong["about"], wrong["code"]) == ("store", "store_fails")
    assert "does not exist; make it" in wrong["found"] and wrong["values"]["fault"] == wrong["found"]
    status, out, _ = told(
        f"{folder}/T07/fit.json --source file:{folder}/live.csv --store sqlite:{folder}/x.db --wait 0s "
        "--no-page"
    )
    assert status == 1 and "rows gave readings" in out  # the columns have names of their own
    status, out, err = told(f"{folder}/none.toml")
    assert (status, out) == (2, "") and "none.toml: cannot be read" in err
    status, out, err = told(f"{folder}/T07/fit.json --source mqtt://me:geheim@host --no-page")
    assert (status, out) == (2, "") and "a password must not be" in err and "geheim" not in err
    assert not (folder / "x.db").exists()


def test_lines_are_lines_and_lists_are_short() -> None:
    check = CheckCode.SECRET_READABLE("a", "fault", path="b\nc\x1b[31m")
    assert str(check).startswith("fault  a: every user ")
    assert str(check).endswith("can read b c [31m; to do: chmod o-rwx b c [31m")
    assert several("abcdefg") == "a, b, c, d, e and 2 more"


# -- files ---------------------------------------------------------------------------------------------------
def test_a_file_that_is_not_there_cannot_be_read_or_is_empty(folder: Path) -> None:
    source = folder / "live.csv"
    source.unlink()
    said(looked(folder), "doubt", "does not exist yet", "check the path")
    source.mkdir()
    said(looked(folder), "fault", "cannot be read: Is a directory", "permissions")
    source.rmdir()
    source.write_text("turbine,time,Tcab,Tamb\n")
    said(looked(folder), "doubt", "it has no rows yet")
    changed(folder, ("file:live.csv", "file:none/live.csv"))
    said(looked(folder), "fault", "its folder", "check the path")
    changed(folder, ('none/live.csv"', 'none.csv"\nfollow = false'))
    said(looked(folder), "fault", "no such file")


def test_rows_that_give_no_reading_are_counted_with_the_reason(folder: Path) -> None:
    source, now = folder / "live.csv", time.time()
    with source.open("a") as file:
        file.write(row(now, "T99") + row(now, cabinet=500.0) + f"T07,yesterday,1,2\nT07,{iso(now)},,\n")
    found = said(looked(folder), "doubt", "37 of 40 last rows gave readings", "compare [mapping]").text
    for words in ("1 unknown turbine (turbine 'T99'", "1 impossible value", "1 no time", "1 no value"):
        assert words in found
    write_rows(source, now, turbine="T99")
    said(looked(folder), "fault", "0 of 36 last rows gave readings")


def test_a_long_file_is_read_from_its_end(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hygrokf.live.doctor.sources.TAIL", 500)
    found = [one.text for one in looked(folder) if "last rows gave readings" in one.text]
    count, of = (int(found[0].split()[k]) for k in (0, 2))
    assert count == of and 5 < of < 20


def test_a_file_that_nobody_writes_any_more(folder: Path) -> None:
    source, old = folder / "live.csv", time.time() - 5 * HOUR_S
    write_rows(source, old)
    os.utime(source, (old, old))
    found = looked(folder)
    said(found, "doubt", "it was last written 5 h ago", "check the program that writes the file")
    said(found, "doubt", "its newest reading is from", "check the program that writes the file")


def test_a_played_back_record_is_no_stale_one(folder: Path) -> None:
    write_rows(folder / "live.csv", time.time() - 1000 * DAY_S)
    changed(folder, ('live.csv"', 'live.csv"\nspeed = 0'))
    assert troubles(looked(folder)) == []


def test_a_weather_forecast_that_runs_out(folder: Path) -> None:
    source = '[[source]]\nurl = "file:weather.csv"\nweather = true\n'
    (folder / "track.toml").write_text(TRACK + FILE + source)
    for hours, level in ((20.0, "doubt"), (48.0, "ok")):
        write_rows(folder / "weather.csv", time.time() + hours * HOUR_S, hours=hours)
        said(looked(folder), level, "its weather forecast reaches ", "at least a day" * (level != "ok"))


def test_what_goes_wrong_in_a_source_s_own_thread_is_not_lost(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(path: Path, statistics: object) -> None:
        raise RuntimeError("a mistake of its own")

    monkeypatch.setattr(doctor_sources, "read_rows", broken)
    with pytest.raises(RuntimeError, match="of its own"):
        looked(folder)


# -- clocks --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("lag_s", "level", "words"),
    [
        (0.0, "ok", "0 s old"),
        (1500.0, "ok", "25 min old"),
        (-90.0, "doubt", "90 s ahead"),
        (-2000.0, "fault", "ahead are held back"),
        (2500.0, "doubt", "more than the lateness"),
        (7210.0, "doubt", "2 whole hours"),
        (30.5 * HOUR_S, "doubt", "more than the lateness"),
    ],
)
def test_stamps_against_the_clock(lag_s: float, level: str, words: str) -> None:
    found = stamp_check("x", lag_s, 1800.0)
    assert found.level == level and words in found.text
    assert stamp_check("x", lag_s, 1800.0, fresh=False).level == ("ok" if lag_s >= 0 else level)


def test_a_source_whose_clock_is_ahead(folder: Path) -> None:
    write_rows(folder / "live.csv", time.time() + 2.5 * HOUR_S)  # in words so for half a minute
    found = looked(folder)
    said(found, "fault", "2.5 h ahead of this machine's clock", "compare both clocks")


def test_this_machine_s_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_check, "is_synchronised", lambda: True)
    now = time.time()
    assert [one.level for one in machine_checks(monotonic_epoch(), now)] == ["ok"]
    assert [one.level for one in machine_checks(monotonic_epoch(), -math.inf)] == ["ok"]
    (jumped,) = machine_checks(monotonic_epoch() - 30.0, now)
    assert jumped.level == "doubt" and "jumped by +30.0 s" in jumped.text
    (back,) = machine_checks(monotonic_epoch(), now + 9000.0)
    assert back.level == "fault" and "received 2.5 h in the future" in back.text
    monkeypatch.setattr(doctor_check, "is_synchronised", lambda: False)
    (loose,) = machine_checks(monotonic_epoch(), now)
    assert loose.level == "doubt" and loose.code is CheckCode.CLOCK_NOT_SYNCHRONISED and "NTP" in loose.remedy
    monkeypatch.setattr(doctor_check, "is_synchronised", lambda: None)
    assert [one.level for one in machine_checks(monotonic_epoch(), now)] == ["ok"]


def test_the_kernel_is_asked_and_not_told() -> None:
    before = monotonic_epoch()
    assert doctor_check.is_synchronised() in (True, False, None)
    assert abs(monotonic_epoch() - before) < doctor_check.JUMP_S
    assert [server_check("x", d).level for d in (0.0, -50.0, 100.0, -5000.0, 1000.0)] == [
        "ok", "ok", "doubt", "doubt", "fault",
    ]  # fmt: skip


# -- certificates and secrets --------------------------------------------------------------------------------
def test_the_validity_of_the_certificates_of_a_file(tmp_path: Path) -> None:
    made = authority(tmp_path)
    files = [made.issue(f"n{one}", days=one)[0] for one in (400, 20_000, -1)]
    chain = b"# a chain\n" + b"".join(file.read_bytes() for file in files)
    first, last = validity_check("x", chain, "chain"), validity_check("x", chain, "chain", all_needed=False)
    assert first.level == "fault" and "chain has expired " in first.text
    assert (last.level, last.text) == ("ok", "chain is valid for 20000 d")
    der = ssl.PEM_cert_to_DER_cert(files[0].read_text())
    assert validity_check("x", der, "one").text == "one is valid for 400 d"
    key = b"-----BEGIN RSA PRIVATE KEY-----\nAA==\n"
    for wrong in (b"", b"no certificate", key, chain[:400], b"\x30\x82\xff"):
        assert validity_check("x", wrong, "w").code is CheckCode.NO_CERTIFICATE


def test_without_cryptography_certificates_are_in_doubt(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    authority(folder).issue("mine")
    file = changed(folder, (FILE, FILE + 'certificate = "mine.crt"\n'))
    monkeypatch.setitem(sys.modules, "cryptography", None)
    said(list(doctor_check.certificate_checks(file)), "doubt", "mine.crt was not examined", "cryptography")


def test_certificates_that_end_and_keys_that_others_read(folder: Path) -> None:
    made = authority(folder)
    _, key = made.issue("soon", "127.0.0.1", days=10)
    key.chmod(0o644)
    past, _ = made.issue("past", "127.0.0.1", days=-1)
    shutil.copy(key, folder / "past.key")
    file = changed(folder, (FILE, FILE + 'certificate = "soon.crt"\nkey = "soon.key"\n'))
    found = list(doctor_check.certificate_checks(file))
    said(found, "doubt", "soon.crt is valid for 10 d", "order a new certificate")
    said(found, "doubt", "every user of this machine can read", f"chmod o-rwx {key}")
    file.write_text(file.read_text().replace("soon.crt", "past.crt"))
    # 24 h or 1 d ago, as the seconds fall
    said(
        list(doctor_check.certificate_checks(file)),
        "fault",
        "past.crt has expired ",
        "replace the certificate",
    )
    file.write_text(file.read_text().replace("past.crt", "track.toml").replace("soon.key", "none.key"))
    wrong = list(doctor_check.certificate_checks(file))
    said(wrong, "fault", "expected a certificate", "PEM or DER")
    said(wrong, "fault", "none.key: No such file")
    assert past.exists()


# -- the store -----------------------------------------------------------------------------------------------
def test_a_store_that_is_not_there_yet(folder: Path) -> None:
    (folder / "live.db").unlink()
    found = looked(folder)
    assert troubles(found) == [] and not (folder / "live.db").exists()
    said(found, "ok", "does not exist yet; the tracker")


def test_stores_that_cannot_be_used(folder: Path) -> None:
    path = folder / "live.db"
    whole = path.read_bytes()
    for first in (8192, len(whole) - 16384):
        path.write_bytes(whole[:first] + b"\xff" * 8192 + whole[first + 8192 :])
        found = said(looked(folder), "fault", "store: ", "restore a copy")
        assert "damaged" in found.text or "malformed" in found.text
    path.write_text("no database at all, but some text")
    said(looked(folder), "fault", "cannot be read as a store")
    path.unlink()
    with closing(sqlite3.connect(path)) as other:
        other.execute("CREATE TABLE mine (a)")
        other.commit()
    said(looked(folder), "fault", "found another database; name another file", "restore a copy")
    path.write_bytes(whole)
    with closing(sqlite3.connect(path)) as store:
        store.execute("UPDATE schema_version SET version = 99")
        store.commit()
    said(looked(folder), "fault", "Use that version", "restore a copy")


def test_who_tracks_is_told_as_long_as_it_lives(folder: Path) -> None:
    store = open_store(f"sqlite:{folder / 'live.db'}")
    store.claim("turbine", ["T07"])
    said(looked(folder), "ok", f"process {os.getpid()} on ")
    store.close()
    said(looked(folder), "ok", "no process tracks these turbines now")


def test_turbines_of_the_store_and_of_the_file(folder: Path) -> None:
    text = 'name = "T07"\nfit = "T07"\n'
    changed(folder, (text, text.replace('name = "T07"', 'name = "T08"')))
    found = looked(folder)
    said(found, "doubt", "no process tracks T07", "add a [[turbine]]")
    said(found, "doubt", "it does not contain T08 yet", "name a new store")
    said(found, "doubt", "it has no estimate yet", "start the tracker")
    said(found, "doubt", "no reading of T08", "known_as")


def test_a_store_of_sources_not_read_yet_takes_any_turbine(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "live.db")) as store:
        store.execute("DELETE FROM source")
        store.execute("DELETE FROM turbine")
        store.commit()
    said(looked(folder), "ok", "it does not contain T07 yet")


def test_another_form_of_readings_is_another_model(folder: Path) -> None:
    changed(
        folder,
        ('"ambient_temperature", unit = "degC"', '"ambient_temperature", unit = "degC", resolution = 0.5'),
    )
    said(looked(folder), "doubt", "T07 had another model", "filters their readings again")


def test_old_estimates_and_readings_of_the_future(folder: Path) -> None:
    path = folder / "live.db"
    with closing(sqlite3.connect(path)) as store:
        store.execute("DELETE FROM estimate WHERE time > ?", (time.time() - 3 * HOUR_S,))
        store.execute("UPDATE observation SET received = ?", (time.time() + DAY_S,))
        store.commit()
    found = looked(folder)
    said(found, "doubt", "newest estimates are old: T07 3", "check whether the tracker runs")
    said(found, "fault", "the store has readings received")


def test_a_disk_that_fills(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = (folder / "live.db").stat().st_size

    def free(count: int) -> Check:
        monkeypatch.setattr(
            doctor_store.shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(0, 0, count)
        )
        (found,) = [one for one in looked(folder) if "free on its disk" in one.text]
        return found

    monkeypatch.setattr(doctor_store, "LEAST_FREE", size // 4)
    assert free(400 * size).level == "ok"
    found = free(10 * size)
    assert found.level == "doubt" and "fills it in 10 d" in found.text and "retention" in found.remedy
    assert free(size // 2).level == "fault" and free(0).level == "fault"
    monkeypatch.setattr(doctor_store, "LEAST_FREE", 500 * size)
    assert free(400 * size).level == "fault"


def test_a_postgresql_store(folder: Path, postgresql) -> None:
    name = postgresql.database()
    changed(folder, ("sqlite:live.db", postgresql.url(name)), ('live.csv"', 'live.csv"\nfollow = false'))
    said(looked(folder), "ok", "does not exist yet")
    assert postgresql.execute(name, "SELECT COUNT(*) FROM pg_class WHERE relname = 'observation'") == [(0,)]
    config = read_config(folder / "track.toml")
    Service(config.turbines, config.streams, config.store).run(until_ended=True)
    store = open_store(config.store)
    store.claim("turbine", ["T07"])
    found = looked(folder)
    assert troubles(found) == []
    said(found, "ok", "is reached and intact; version")
    said(found, "ok", f"process {os.getpid()} on ")
    store.close()
    reader = f"looker_{os.getpid()}"
    postgresql.execute(
        name, f"CREATE ROLE {reader} LOGIN", f"GRANT SELECT ON ALL TABLES IN SCHEMA public TO {reader}"
    )
    try:
        changed(folder, (postgresql.url(name), postgresql.url(name, user=reader)))
        said(looked(folder), "fault", "this user may not write", "write permission")
    finally:
        postgresql.execute(name, f"DROP OWNED BY {reader}", f"DROP ROLE {reader}")
    changed(folder, (postgresql.url(name, user=reader), f"postgresql://nobody@127.0.0.1:{free_port()}/x"))
    said(looked(folder), "fault", "cannot be reached", "check")


# -- models --------------------------------------------------------------------------------------------------
def test_models_whose_signals_are_not_mapped_or_never_came(folder: Path) -> None:
    file = folder / "track.toml"
    text = file.read_text()
    file.write_text("".join(line for line in text.splitlines(True) if not line.startswith("Tamb")))
    said(looked(folder), "fault", "its model needs ambient_temperature", "add it to [mapping.signals]")
    file.write_text("".join(line for line in text.splitlines(True) if not line.startswith("Tcab")))
    said(looked(folder), "ok", "from the model alone")
    file.write_text(
        text.replace(
            '"cabinet_temperature", unit = "degC"',
            '"cabinet_temperature", unit = "degC", stamp = "end", interval = "10min"',
        )
    )
    said(looked(folder), "fault", "its model cannot be run on these signals", "fit the model again")
    file.write_text(text.replace("Tcab =", "Tcabinet ="))
    with closing(sqlite3.connect(folder / "live.db")) as store:
        store.execute("DELETE FROM observation WHERE signal = 'cabinet_temperature'")
        store.commit()
    said(looked(folder), "doubt", "cabinet_temperature, which never arrived", "compare the names")


# -- the page ------------------------------------------------------------------------------------------------
def test_the_page_s_address(folder: Path) -> None:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as other:
        settings = PageSettings("127.0.0.1", other.getsockname()[1])

        def hang_up() -> None:
            connection, _ = other.accept()
            connection.close()

        thread = threading.Thread(target=hang_up)
        thread.start()
        said(list(page_checks(settings)), "fault", "the port is in use", "another address")
        thread.join()
    said(list(page_checks(PageSettings("192.0.2.1", 8080))), "fault", "does not have this address")


@pytest.mark.parametrize("unix", ["", "page.sock"])
def test_a_tracker_s_own_page_is_told_from_a_stranger(folder: Path, unix: str) -> None:
    from hygrokf.live.web.application import PageEndpoints
    from hygrokf.live.web.server import Hub, serve

    config = read_config(folder / "track.toml")
    service, hub = Service(config.turbines, (), config.store), Hub()
    at = f"{folder}/{unix}" if unix else ""
    settings = PageSettings("127.0.0.1", 0, token="x" * 20, behind_proxy=True, unix=at)
    if unix:
        said(list(page_checks(settings)), "ok", "the address is free")
        assert not (folder / unix).exists()
    with serve(PageEndpoints(service, hub, settings).app(), settings, hub) as server:
        there = replace(settings, port=server.port)
        said(list(page_checks(there)), "doubt", "has not opened its store yet", "that tracker's log")
        service.store = open_store(config.store)
        said(list(page_checks(there)), "ok", "is healthy")
        service.store.close()


# -- MQTT ----------------------------------------------------------------------------------------------------
def mqtt_source(url: str, topics: str = '["plant/+/cabinet"]', *more: str) -> str:
    return "\n".join([f'[[source]]\nurl = "{url}"\ntopics = {topics}', *more, ""])


def payload(turbine: str = "T07", at: float | None = None, cabinet: float = 25.0) -> str:
    return json.dumps({"turbine": turbine, "time": at or time.time(), "Tcab": cabinet, "Tamb": 10.0})


@contextmanager
def publishing(broker, topic: str, make: Callable[[], str] = payload, qos: int = 1) -> Iterator[None]:
    """Messages that go on as long as the block, from before it on."""
    with peer(broker) as client:
        publish(client, [(topic, make())], qos)
        with repeating(lambda: publish(client, [(topic, make())], qos)):
            yield


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator:
    with mosquitto(tmp_path_factory.mktemp("broker")) as made:
        yield made


def looked_at(source: str, folder: Path, wait_s: float = 1.0) -> list[Check]:
    (folder / "track.toml").write_text(TRACK + source)
    return looked(folder, wait_s)


@needs_mosquitto
def test_a_sound_broker(broker, folder: Path) -> None:
    with publishing(broker, "plant/7/cabinet"):
        found = looked_at(mqtt_source(broker.url), folder)
    assert troubles(found) == []
    said(found, "ok", "plant/+/cabinet: granted; ")
    said(found, "ok", "payloads gave readings")
    said(found, "ok", "its newest stamp is 0")


@needs_mosquitto
def test_topics_that_are_silent_retained_or_not_kept(broker, folder: Path) -> None:
    with peer(broker) as client:
        publish(client, [("kept/7", payload(at=time.time() - 30 * DAY_S))], retain=True)
        try:
            found = looked_at(mqtt_source(broker.url, '["none/#", "kept/+"]'), folder, 2.0)
        finally:
            publish(client, [("kept/7", "")], retain=True)
    said(found, "doubt", "none/#: granted, but no message arrived within 2 s", "rights of this user")
    said(found, "doubt", "kept/+: granted; nothing new within 2 s, only 1 retained")
    said(found, "ok", "retained messages: 1 of 1 payloads gave readings")
    with publishing(broker, "plant/7/cabinet", qos=0):
        said(looked_at(mqtt_source(broker.url), folder), "doubt", "published at QoS 0", "publish at QoS 1")


@needs_mosquitto
def test_payloads_that_give_nothing_and_clocks_that_differ(broker, folder: Path) -> None:
    with publishing(broker, "plant/7/cabinet", lambda: payload("WEA 7")):
        said(
            looked_at(mqtt_source(broker.url), folder),
            "fault",
            "unknown turbine (turbine 'WEA 7'",
            "known_as",
        )
    with publishing(broker, "plant/7/cabinet", lambda: payload(at=time.time() - 2 * HOUR_S)):
        said(looked_at(mqtt_source(broker.url), folder), "doubt", "2 whole hours")


@needs_mosquitto
def test_the_tracker_s_session_and_its_share_are_left_alone(broker, folder: Path) -> None:
    """While the doctor listens the tracker stays connected, and of a shared subscription it gets every
    message."""
    source = mqtt_source(
        broker.url, '["$share/g/plant/+/shared"]', 'client_id = "the-tracker"', 'alarms = "plant/7"'
    )
    (folder / "track.toml").write_text(TRACK + source)
    config = read_config(folder / "track.toml")
    (stream,) = config.streams
    got: list[str] = []
    stream.start(
        None, lambda one: (got.append(json.loads(one.content)["turbine"]), stream.acknowledge([one]))
    )
    try:
        eventually(lambda: stream.state[0] == "connected", lambda: stream.state)
        sent: list[str] = []

        def numbered() -> str:
            sent.append(f"n{len(sent)}")
            return payload(sent[-1])

        with publishing(broker, "plant/8/shared", numbered):
            found = looked_at(source, folder, 1.0)
        said(found, "ok", "plant/+/shared: granted; ")
        eventually(lambda: len(got) >= len(sent), lambda: (got, sent))
        assert got == sent and stream.state[0] == "connected"
    finally:
        stream.stop()
        stream.stop()
    log = broker.log()
    assert "hygrokf-doctor-" in log and "already connected, closing old connection" not in log


@needs_mosquitto
def test_brokers_that_are_not_reached_or_send_one_away(tmp_path: Path, folder: Path) -> None:
    said(
        looked_at(mqtt_source(f"mqtt://127.0.0.1:{free_port()}"), folder),
        "fault",
        "nothing listens there",
        "check url",
    )
    (folder / "pw").write_text("wrong")
    users = password_file(tmp_path, "reader", "right")
    with mosquitto(tmp_path, "allow_anonymous false", f"password_file {users}") as made:
        url = made.url.replace("//", "//reader@")
        found = looked_at(mqtt_source(url, '["a"]', 'password_file = "pw"'), folder, 0.2)
        said(found, "fault", "user name", "password")
        (folder / "pw").write_text("right")
        found = looked_at(mqtt_source(url, '["a"]', 'password_file = "pw"'), folder, 0.2)
        said(found, "ok", "connected as user reader")
    assert not [one for one in found if "right" in str(one).replace("rights", "").replace("the right", "")]


@needs_mosquitto
def test_a_topic_that_is_denied(tmp_path: Path, folder: Path) -> None:
    (folder / "pw").write_text("geheim")
    with mosquitto(tmp_path, *dynamic_security(tmp_path, "reader", "geheim", "secret/#")) as made:
        url = made.url.replace("//", "//reader@")
        found = looked_at(mqtt_source(url, '["secret/#", "open/#"]', 'password_file = "pw"'), folder, 0.3)
    said(found, "fault", "secret/#: the broker denies the subscription", "give this user the right")
    said(found, "doubt", "open/#: granted, but no message arrived")


@needs_mosquitto
def test_a_broker_by_tls(tmp_path: Path, folder: Path) -> None:
    made = authority(folder)
    certificate, key = made.issue("server", "127.0.0.1", days=12)
    tls = ("allow_anonymous true", f"cafile {made.file}", f"certfile {certificate}", f"keyfile {key}")
    key.chmod(0o644)  # for the broker's own user
    with mosquitto(tmp_path, *tls) as one:
        source = mqtt_source(one.url.replace("mqtt:", "mqtts:"), '["a"]', 'ca = "ca.crt"')
        found = looked_at(source, folder, 0.2)
        said(found, "ok", "connected by TLS")
        said(found, "doubt", "the broker's certificate is valid for 12 d", "order a new certificate")
        said(found, "doubt", "[[source]] 1 ca: ", "order a new certificate")
        said(looked_at(mqtt_source(one.url, '["a"]'), folder, 0.2), "fault", "mqtts://")


# -- OPC UA --------------------------------------------------------------------------------------------------
def opcua_source(url: str, nodes: dict[str, str]) -> str:
    more = ('user = "reader"', 'password_file = "pw"')
    rows = [f'"{id}" = {{ turbine = "T07", field = "{field}" }}' for id, field in nodes.items()]
    return "\n".join([f'[[source]]\nurl = "{url}"', *more, "[source.nodes]", *rows, ""])


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator:
    pytest.importorskip("asyncua", reason="asyncua is not installed: pip install 'hygrokf[test]'")
    from builders.opcua_peer import Peer

    with Peer(tmp_path_factory.mktemp("peer"), users={"reader": "right"}, clock=True) as made:
        yield made.start()


def test_a_sound_opcua_server(server, folder: Path) -> None:
    nodes = {"ns=2;s=a.Tcab": "Tcab", "ns=2;s=a.Tamb": "Tamb"}
    server.add(nodes)
    server.write([(id, time.time(), 20.0, 0) for id in nodes])
    before = server.asked_of()
    found = looked_at(opcua_source(server.url, nodes), folder, 10.0)
    assert (
        troubles([one for one in found if one.code is not CheckCode.SERVER_CLOCK_AGREES]) == []
    )  # the peer's stands still
    said(found, "ok", "its clock agrees with this machine's")
    said(found, "ok", "2 of 2 nodes have a good value")
    said(found, "ok", "keeps the history of the 2 nodes")
    said(found, "ok", "2 of 2 values gave readings")
    after = server.asked_of()
    assert (after["written"], after["called"]) == (before["written"], before["called"])


def test_nodes_that_are_not_there_bad_old_or_without_history(server, folder: Path) -> None:
    server.add(["ns=2;s=b.bad"], history="refused")
    server.add(["ns=2;s=b.old"])
    server.write(
        [("ns=2;s=b.bad", time.time(), 20.0, 0x808C0000), ("ns=2;s=b.old", time.time() - DAY_S, 20.0, 0)]
    )
    nodes = {"ns=2;s=b.none": "Tcab", "ns=2;s=b.bad": "Tamb", "ns=2;s=b.old": "RH"}
    found = looked_at(opcua_source(server.url, nodes), folder, 10.0)
    said(
        found,
        "fault",
        "1 of 3 nodes do not exist or are denied: ns=2;s=b.none (BadNodeIdUnknown)",
        "address space",
    )
    said(found, "doubt", "values that are not good: ns=2;s=b.bad (BadSensorFailure)", "check the sensor")
    said(found, "doubt", "values older than 2 h: ns=2;s=b.old", "check the sensor")
    said(
        found,
        "doubt",
        "no history of 1 of 2 nodes: ns=2;s=b.bad (BadHistoryOperationUnsupported)",
        "enable history",
    )


def test_history_is_kept_only_where_the_access_level_says_so(server, folder: Path) -> None:
    nodes = {"ns=2;s=h.kept": "Tcab", "ns=2;s=h.never": "Tamb"}
    server.add(["ns=2;s=h.kept"])
    server.add(["ns=2;s=h.never"], history="none")
    server.write([(id, time.time(), 20.0, 0) for id in nodes])
    found = looked_at(opcua_source(server.url, nodes), folder, 10.0)
    words = "no history of 1 of 2 nodes: ns=2;s=h.never (the node's AccessLevel has no HistoryRead"
    said(found, "doubt", words, "enable history")


def test_opcua_servers_that_are_not_reached_or_refuse(
    server, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = {"ns=2;s=c": "Tcab"}
    server.add(nodes)
    nobody = opcua_source(f"opc.tcp://127.0.0.1:{free_port()}", nodes)
    said(looked_at(nobody, folder, 1.0), "fault", "nothing listens there", "check url, certificates")
    (folder / "pw").write_text("wrong")
    found = looked_at(opcua_source(server.url, nodes), folder, 1.0)
    said(found, "fault", "the server refuses the user", "check url, certificates")
    (folder / "pw").write_text("right")
    shown = Connection.server_time

    async def behind(connection: Connection) -> float:
        return await shown(connection) - 2.5 * HOUR_S

    monkeypatch.setattr(Connection, "server_time", behind)
    said(
        looked_at(opcua_source(server.url, nodes), folder, 0.3),
        "doubt",
        "2.5 h behind this machine's clock",
        "NTP",
    )
