"""Sources without a server: growing, cut and replaced files, half-written lines, standard input, playback."""

from __future__ import annotations

import io
import os
import queue
import random
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from builders.stream_case import Collected
from builders.waiting import eventually

from hygrokf.data.record import Record, Series
from hygrokf.live.service import take_from
from hygrokf.live.sources import local
from hygrokf.live.sources import stream as streams
from hygrokf.live.sources.local import (
    Lines,
    Playback,
    StandardInput,
    TailedFile,
    delay_and_repeat,
    file_messages,
    record_mapping,
    record_messages,
)
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.payload_formats import Refused
from hygrokf.live.sources.stream import Delivery

NOW = 1_772_367_000.0
"""[s] 2026-03-01T12:10:00Z."""
MAPPING = PayloadMapping({"Tcab": Field("cabinet_temperature", "degC")}, turbines={"T1": "T1"})


@pytest.fixture
def grown(tmp_path: Path):
    """(append text, a started tail of the file, what it put)."""
    path, got = tmp_path / "live.csv", Collected()

    def append(text: str) -> None:
        with path.open("a", encoding="utf-8") as file:
            file.write(text)

    append("turbine,time,Tcab\n")
    stream = TailedFile(path, MAPPING)
    stream.start(None, got)
    yield append, stream, got
    stream.stop()


def test_a_growing_file_delivers_whole_lines(grown) -> None:
    append, stream, got = grown
    append("T1,2026-03-01T12:00:00Z,31.5\nT1,2026-03-01T12:10")
    assert got.wait(1)[0].content == {"turbine": "T1", "time": "2026-03-01T12:00:00Z", "Tcab": "31.5"}
    time.sleep(0.5)
    assert len(got.found) == 1  # half a line is none
    append(":00Z,31.7\n# a comment\n\n")
    assert got.wait(2)[1].content["time"] == "2026-03-01T12:10:00Z"
    assert stream.state[0] == "connected"


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        (b"T1,2026-03-01T12:00:00Z,31\r.5\n", "malformed"), (b"T1,\x00,31.5\n", "malformed"),
        (b"T1,2026-03-01T12:00:00Z\n", "malformed"), (b"T1,2026-03-01T12:00:00Z,31,5\n", "malformed"),
        (b"T1,2026-03-01T12:00:00Z,31.5 \xb0C\n", "malformed"), (b'T1,"soon,1\n', "malformed"),
        (b"T1," + b"9" * 200_000 + b",31.5\n", "too large"), (b'{"Tcab": \xff}\n', "malformed"),
    ],
)  # fmt: skip
def test_a_damaged_row_is_counted_and_passed_by(grown, line: bytes, kind: str) -> None:
    append, stream, got = grown
    append("T1,2026-03-01T12:00:00Z,31.5\n")
    with stream.path.open("ab") as file:
        file.write(line)
    append("T1,2026-03-01T12:10:00Z,31.6\n")
    first, damaged, last = got.wait(3)
    assert first.content["Tcab"] == "31.5" and last.content["Tcab"] == "31.6"
    with pytest.raises(Refused) as refusal:
        MAPPING.read(damaged.content, NOW)
    assert refusal.value.kind == kind and stream.state.word == "connected"
    assert last.place.endswith(f" {stream.path.stat().st_size}")


def test_random_bytes_never_end_a_file(grown) -> None:
    append, stream, got = grown
    random = np.random.default_rng(5)
    count = 0
    for _ in range(300):
        line = bytes(random.integers(0, 256, int(random.integers(1, 60)), dtype=np.uint8)).replace(b"\n", b"")
        with stream.path.open("ab") as file:
            file.write(line + b"\n")
        append(f"T1,{NOW + count},31.5\n")
        count += 1
    eventually(lambda: sum(isinstance(one.content, dict) for one in got.found) >= count)
    assert stream.state.word == "connected"


def test_pauses_double_until_a_source_has_held_and_leave_the_global_generator_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waits: list[float] = []
    now = [1_000.0]
    monkeypatch.setattr(streams, "time", SimpleNamespace(monotonic=lambda: now[0]))

    class Ended(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            waits.append(timeout or 0.0)
            return False

    before, back_off = random.getstate(), streams.BackOff()
    for _ in range(8):
        back_off.wait(Ended())
    assert not back_off.has_held
    now[0] += 61.0  # the attempt outlasts the longest pause
    assert back_off.has_held
    back_off.wait(Ended())
    assert not back_off.has_held
    bounds = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0, 1.0]
    assert all(0.5 * bound <= wait <= bound for bound, wait in zip(bounds, waits, strict=True))
    assert len(set(waits)) == len(waits) and random.getstate() == before
    assert streams.pause_s(10**6, (0.5, 10.0)) == 10.0


def test_whatever_is_raised_in_a_source_is_told_and_it_goes_on(
    grown, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    monkeypatch.setattr(streams, "SOURCE_BACK_OFF_S", (0.05, 0.1))
    append, stream, _ = grown
    stream.stop()
    append("".join(f"T1,{i},{i}.0\n" for i in range(1, 8)))
    again, taken, states = TailedFile(stream.path, MAPPING), [], []

    def put(one: Delivery) -> None:
        if one.content["time"] in ("3", "6") and len(states) < 2 * int(one.content["time"]) // 3:
            states.append(again.state)
            raise ZeroDivisionError("the taker's fault")
        taken.append(one.content["time"])

    again.start(None, put)
    eventually(lambda: len(states) == 2)
    eventually(lambda: len(taken) == 7)
    assert taken == [str(i) for i in range(1, 8)] and again.state.word == "connected"
    (said,) = [one for one in caplog.records if one.message == "source lost"]
    assert "ZeroDivisionError: the taker's fault" in said.reason and said.exc_info
    again.stop()
    assert again.state.word == "stopped"


def test_a_source_that_cannot_go_on_stays_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "SOURCE_BACK_OFF_S", (0.02, 0.04))
    calls = []

    def broken(line: bytes) -> None:
        calls.append(line)
        raise MemoryError("no more")

    stream = StandardInput(MAPPING, io.BytesIO(b"1\n" * 9))
    monkeypatch.setattr(stream._lines, "content", broken)
    stream.start(None, Collected())
    eventually(lambda: len(calls) >= 3)
    assert stream.state.word == "lost" and "MemoryError: no more" in stream.state.words
    stream.stop()


def test_it_goes_on_from_its_place(grown) -> None:
    append, stream, got = grown
    append("".join(f"T1,{i},{i}.0\n" for i in range(1, 6)))
    places = [one.place for one in got.wait(5)]
    stream.stop()
    append("T1,6,6.0\n")
    again, later = TailedFile(stream.path, MAPPING), Collected()
    again.start(places[2], later)
    assert [one.content["time"] for one in later.wait(3)] == ["4", "5", "6"]
    assert later.found[0].place == places[3]
    again.stop()


def test_a_file_that_was_cut_or_replaced_begins_anew(grown) -> None:
    append, stream, got = grown
    append("T1,1,1.0\nT1,2,2.0\n")
    got.wait(2)
    os.truncate(stream.path, 0)
    time.sleep(0.5)
    append("time;turbine;RH\n3;T1;55\n")
    assert got.wait(3)[2].content == {"time": "3", "turbine": "T1", "RH": "55"}
    new = stream.path.with_suffix(".new")
    new.write_text("turbine,time,Tcab\nT1,4,4.0\n", encoding="utf-8")
    os.replace(new, stream.path)
    assert got.wait(4)[3].content["time"] == "4"


def test_a_file_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    stream, got = TailedFile(tmp_path / "later.ndjson", MAPPING), Collected()
    stream.start(None, got)
    eventually(lambda: stream.state[0] == "waiting")
    stream.path.write_text('{"turbine": "T1"}\n', encoding="utf-8")
    assert got.wait(1)[0].content == '{"turbine": "T1"}'
    stream.stop()
    assert stream.state[0] == "stopped"


def test_a_file_that_is_read_once_ends(tmp_path: Path) -> None:
    path, got = tmp_path / "all.csv", Collected()
    path.write_text("\ufeffturbine;Tcab\nT1;1\nT1;2", encoding="utf-8")
    stream = TailedFile(path, MAPPING, follow=False)
    stream.start(None, got)
    assert [one.content["Tcab"] for one in got.wait(2)] == ["1", "2"]
    assert {one.content["turbine"] for one in got.found} == {"T1"}
    eventually(lambda: stream.state[0] == "ended")
    none = TailedFile(tmp_path / "none.csv", MAPPING, follow=False)
    none.start(None, got)
    eventually(lambda: none.state[0] == "lost")
    assert none.state[1].startswith(f"{tmp_path / 'none.csv'}: no such file")
    none.stop()


def test_lines() -> None:
    lines = Lines()
    rows = ["# made by hand", 'a\t"b c"', "1\t2\t", 'a\t"b c"', "", "4\t", '{"x": 1}', '[{"x": 1}]']
    contents = [lines.content(row) for row in rows]
    row, last = {"a": "1", "b c": "2"}, {"a": "4", "b c": ""}
    assert contents == [None, None, row, None, None, last, '{"x": 1}', '[{"x": 1}]']


def test_standard_input_of_a_pipe_ends_while_it_waits_for_more() -> None:
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as file, os.fdopen(writing, "wb", buffering=0) as sender:
        stream, got = StandardInput(MAPPING, file), Collected()
        stream.start(None, got)
        lines = [f'{{"turbine": "T1", "time": {n}}}' for n in range(5_000)]  # more than a pipe holds
        sender.write(("\n".join(lines) + '\n{"turb').encode())
        eventually(lambda: len(got.found) == 5_000)
        assert [one.content for one in got.found] == lines
        sender.write(b'ine": "T2"}\n' + b"9" * (local.LONGEST_LINE + 10) + b"\n")
        eventually(lambda: len(got.found) == 5_002)
        assert got.found[5_000].content == '{"turbine": "T2"}'
        assert got.found[5_001].content.kind == "too large"
        began = time.monotonic()
        stream.stop()
        assert time.monotonic() - began < 2.0 and stream.state[0] == "stopped"
    reading, writing = os.pipe()
    os.write(writing, b'{"turbine": "T1"}')  # the last line need not end
    os.close(writing)
    with os.fdopen(reading, "rb") as file:
        stream, got = StandardInput(MAPPING, file), Collected()
        stream.start(None, got)
        assert got.wait(1)[0].content == '{"turbine": "T1"}'
        eventually(lambda: stream.state[0] == "ended")


def some_record() -> Record:
    time_s = 1.6e9 + 600.0 * np.arange(50)
    warm = np.where(np.arange(50) == 7, np.nan, 290.0)
    return Record(
        "R", (Series("cabinet_temperature", time_s, warm), Series("rain", time_s + 5.0, np.zeros(50)))
    )


def played(speed: float = 0.0) -> Playback:
    record = some_record()
    return Playback("replay:R", record_messages(record, "T1"), record_mapping(record, "T1"), speed)


def test_a_file_is_played_back_by_its_stamps(tmp_path: Path) -> None:
    path = tmp_path / "old.csv"
    path.write_text(
        "turbine,when,Tcab\nT1,2026-03-01T12:10:00Z,2\nT1,soon,9\nT1,2026-03-01T12:00:00Z,1\n", "utf-8"
    )
    found = file_messages(path, PayloadMapping({"Tcab": Field("cabinet_temperature", "degC")}, time="when"))
    assert [(at - 1772366400.0, content["Tcab"]) for at, content in found] == [(0.0, "1"), (600.0, "2")]


def test_playback_delivers_every_reading_and_goes_on_from_its_place() -> None:
    stream, got = played(), Collected()
    stream.start(None, got)
    found = got.wait(99)
    assert len(stream.messages) == 99
    assert found[0].content == {"turbine": "T1", "time": 1.6e9, "cabinet_temperature": 290.0}
    assert [one.received for one in found] == sorted(one.received for one in found)
    again, rest = played(), Collected()
    again.start(found[89].place, rest)
    assert [one.content for one in rest.wait(9)] == [one.content for one in found[90:]]
    eventually(lambda: again.state[0] == "ended")


def test_playback_may_be_late_and_repeated() -> None:
    plain = record_messages(some_record(), "T1")
    found = delay_and_repeat(plain, late_s=1800.0, repeated=0.5, seed=3)
    assert found == delay_and_repeat(plain, late_s=1800.0, repeated=0.5, seed=3)
    stamps = [content["time"] for _, content in found]
    assert stamps != sorted(stamps) and len({str(content) for _, content in found}) == 99 < len(found) < 199
    assert all(0.0 <= at - stamp < 1800.0 for (at, _), stamp in zip(found, stamps, strict=True))


def test_playback_does_not_fall_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock that moves only by what is waited for and by a taker that is slow once: that is caught up
    with."""
    stream, clock, came = played(6000.0), [100.0], []

    def wait(seconds: float) -> bool:
        clock[0] += seconds
        return False

    def put(one: Delivery) -> None:
        came.append((clock[0] - 100.0, one.received - 1.6e9))
        clock[0] += 0.25 if len(came) == 10 else 0.0

    monkeypatch.setattr(local, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(stream._ended, "wait", wait)
    stream._deliver(None, put)
    late_until = came[9][0] + 0.25
    assert len(came) == 99 and late_until > came[12][1] / 6000.0
    assert [after for after, _ in came] == pytest.approx(
        [at / 6000.0 if k < 10 else max(at / 6000.0, late_until) for k, (_, at) in enumerate(came)], abs=1e-9
    )


def test_deliveries_are_taken_in_bounded_rounds() -> None:
    waiting: queue.Queue = queue.Queue()
    for number in range(7):
        waiting.put(Delivery(str(number), 0.0))
    assert [one.content for one in take_from(waiting, 5, 0.1)] == list("01234")
    assert [one.content for one in take_from(waiting, 5, 0.1)] == list("56")
    assert take_from(waiting, 5, 0.01) == []
