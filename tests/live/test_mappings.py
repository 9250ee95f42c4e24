"""Mappings: every layout of the page is read as it says, what is ambiguous is refused, and nothing breaks
it."""

from __future__ import annotations

import gzip
import json
import math
import random
import re
import time
import timeit
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from builders.documents import document
from builders.rejections import counted
from builders.track_case import write_model

from hygrokf.data.numbers import Marks, Meaning, Unread, stated_marks
from hygrokf.data.timestamps import zone_named
from hygrokf.live.config import Config, ConfigFault, read_config
from hygrokf.live.doctor.payloads import file_payloads, read_trial, trials_text
from hygrokf.live.sources.payload import (
    EARLIEST_STAMP_S,
    LATEST_STAMP_S,
    Field,
    PayloadMapping,
    TurbineReadings,
)
from hygrokf.live.sources.payload_formats import INFLUX, LARGEST_PAYLOAD, PLAIN, UNPACKED, Refused
from hygrokf.live.sources.payload_values import (
    Clock,
    number,
    path_fault,
    pattern_fault,
    quantity_or_flag,
    seconds,
    tag_reader,
)

NOW = 1_772_367_000.0
"""[s] 2026-03-01T12:10:00Z."""
BERLIN = zone_named("Europe/Berlin")
FIELDS = {
    "Tcab": Field("cabinet_temperature", "degC"),
    "RHcab": Field("cabinet_relative_humidity", "%"),
    "P": Field("active_power", "kW"),
    "Heater": Field("preheating", "1"),
}
TURBINES = {"W01": "W01", "W02": "W02"}
SIGNALS = """
[mapping.signals]
Tcab = { signal = "cabinet_temperature", unit = "degC" }
RHcab = { signal = "cabinet_relative_humidity", unit = "%" }
"""
SOURCE = '[[source]]\nurl = "mqtt://127.0.0.1:1"\ntopics = ["#"]\n'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("mappings")
    write_model(made / "T07")
    return made


def config(folder: Path, mapping: str, sources: str = SOURCE) -> Config:
    """A tracker's file of two turbines, with the page's signals unless the mapping has its own."""
    text = f'[[turbine]]\nname = "W01"\nfit = "T07"\n{mapping}\n'
    if 'name = "W02"' in text:
        text = text.replace('name = "W02"', 'name = "W02"\nfit = "T07"')
    else:
        text = f'[[turbine]]\nname = "W02"\nfit = "T07"\n{text}'
    if "[mapping.signals]" not in text:
        text += SIGNALS
    file = folder / "track.toml"
    file.write_text(text + sources, encoding="utf-8")
    return read_config(file)


def layouts() -> list[tuple[str, str, str, str]]:
    """(heading, payloads, mapping, what they give) of every layout of the page and of `layouts.md` here."""
    found = []
    pages = (document("live_mapping.md"), Path(__file__).with_name("layouts.md"))
    parts = [page.read_text(encoding="utf-8").split("## Layouts")[1].split("\n### ")[1:] for page in pages]
    for part in (one for some in parts for one in some):
        blocks = re.findall(r"^```\w+\n(.*?)^```", part, re.DOTALL | re.MULTILINE)
        assert len(blocks) == 3, part
        found.append((part.splitlines()[0], *blocks))
    return found


LAYOUTS = layouts()


def read(mapping: PayloadMapping, content: object, topic: str = "", received: float = NOW) -> dict:
    """(turbine, signal) → value, and the kinds of what is rejected."""
    text = content if isinstance(content, str | bytes) else json.dumps(content)
    found = mapping.read(text, received, topic)
    values = {(of.turbine, one.signal): round(one.value, 6) for of in found for one in of.readings}
    return {**values, **sum(map(counted, found), Counter())}


def kind(mapping: PayloadMapping, content: object, topic: str = "", received: float = NOW) -> str:
    with pytest.raises(Refused) as refusal:
        read(mapping, content, topic, received)
    return refusal.value.kind


def fields(**named: object) -> PayloadMapping:
    return PayloadMapping(FIELDS, turbines=TURBINES, **named)


# -- the page ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("layout", LAYOUTS, ids=[one[0] for one in LAYOUTS])
def test_every_layout_of_the_page_is_read_as_it_says(folder: Path, layout: tuple[str, ...]) -> None:
    _, payloads, mapping, gives = layout
    found = config(folder, mapping).streams[0].mapping
    file = folder / "captured"
    file.write_text(payloads, encoding="utf-8")
    said = trials_text([read_trial(("captured",), found, file_payloads(file, found))]).splitlines()
    lines = iter(line.strip() for line in said)
    for expected in gives.splitlines():
        assert any(line.startswith(expected) for line in lines), "\n".join(said)
    shown = [line for line in said if re.match(r"      (W0\d|not used)", line)]
    assert len(shown) == len(gives.splitlines()), "\n".join(said)
    packed = folder / "captured.gz"
    packed.write_bytes(gzip.compress(payloads.encode()))
    unpacked = trials_text([read_trial(("captured",), found, file_payloads(packed, found))]).splitlines()
    assert unpacked[2:4] == said[2:4]


# -- numbers and times ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("text", "comma", "value"),
    [
        ("21.5", False, 21.5), (" -2.15e1 ", False, -21.5), ("+.5", False, 0.5), (7, False, 7.0),
        ("21,5", True, 21.5), ("-0,5", True, -0.5), (21.5, True, 21.5), ("21", True, 21.0),
        ("21,5", False, None), ("21.5", True, None), ("1.021,5", True, 1021.5), ("1,021,5", True, None),
        ("1.003", True, 1003.0), ("0.998", True, None), ("1.003.25", True, None), ("1,003", False, 1003.0),
        ("10,03", False, None), ("1,003.5", False, 1003.5),
        ("1_000", False, None), ("infinity", False, None), ("nan", False, None), ("0x1F", False, None),
        ("٣١", False, None), ("", False, None), ("9" * 300, False, None), (True, False, None),
        (10**400, False, None),
        (math.nan, False, None), (None, False, None), ([1.0], False, None),
    ],
)  # fmt: skip
def test_numbers_are_read_strictly(text: object, comma: bool, value: float | None) -> None:
    assert number(text, stated_marks("," if comma else ".", None)) == value
    assert number("1,003") is None


@pytest.mark.parametrize(
    ("raw", "unit", "value"),
    [
        ("21.5 °C", "degC", 21.5), ("21.5degC", "degC", 21.5), ("-3 K", "K", -3.0), ("41 %", "%", 41.0),
        ("41 % RH", "%", 41.0), ("5 W/m²", "W/m2", 5.0), ("21.5 °F", "degC", "other unit"),
        ("5 W", "kW", 0.005), ("1.25 MW", "kW", 1250.0), ("45%", "1", 0.45),
        ("5 hPa", "kW", "other unit"), ("1_000", "degC", "no number"), ("0x1F", "degC", "no number"),
        ("12e", "degC", "no number"), ("warm", "degC", "no number"), ("1.000.000 W", "W", "no number"),
        ("1e999 W", "W", "no number"), (True, "degC", "no number"), ({}, "degC", "no number"),
    ],
)  # fmt: skip
def test_a_unit_in_the_text_is_checked(raw: object, unit: str, value: float | str) -> None:
    if isinstance(value, float):
        assert quantity_or_flag(raw, Meaning("", unit)) == pytest.approx(value, rel=1e-12)
        return
    with pytest.raises(Unread) as refusal:
        quantity_or_flag(raw, Meaning("", unit))
    assert refusal.value.kind == value


@pytest.mark.parametrize(
    ("name", "text", "decimal", "value"),
    [
        ("P", "1.003", None, "ambiguous number"), ("P", "1.003 kW", None, "ambiguous number"),
        ("P", "1.003", ".", 1003.0), ("P", "1.003", ",", 1.003e6), ("P", "1,003", ",", 1003.0),
        ("P", "1.0035", None, 1003.5), ("P", 1.003, None, 1003.0), ("P", "0.998", None, 998.0),
        ("Tcab", "21.503", None, 294.653), ("Tcab", "21.503", ",", "impossible value"),
    ],
)  # fmt: skip
def test_a_point_that_may_divide_thousands_is_read_as_stated_or_as_its_signal_allows(
    name: str, text: object, decimal: str | None, value: float | str
) -> None:
    mapping = fields(marks=stated_marks(decimal, None))
    found = read(mapping, {"turbine": "W01", "time": NOW, name: text})
    signal = FIELDS[name].signal
    assert found == ({value: 1} if isinstance(value, str) else {("W01", signal): value})


def test_the_signal_or_the_mapping_says_which_pole_is_one() -> None:
    def flags(one: str = "") -> dict:
        row = {"Door": Field("door_open", "1"), "Fan": Field("fan_duty", "1", one=one), "RH": FIELDS["RHcab"]}
        content = {"turbine": "W01", "time": NOW, "Door": "open", "Fan": "Closed", "RH": "on"}
        return read(PayloadMapping(row, turbines={"W01": "W01"}), content)

    door = {("W01", "door_open"): 1.0, "no number": 1}
    assert flags() == {**door, "unknown polarity": 1}
    assert flags("closed") == {**door, ("W01", "fan_duty"): 1.0}
    assert flags("open") == {**door, ("W01", "fan_duty"): 0.0}


def test_true_and_false_are_values_of_flags_only() -> None:
    content = {"turbine": "W01", "time": NOW, "Heater": True, "RHcab": True, "Tcab": False}
    assert read(fields(), content) == {("W01", "preheating"): 1.0, "no number": 2}
    assert read(fields(), {**content, "Heater": "False", "RHcab": None, "Tcab": ""}) == {
        ("W01", "preheating"): 0.0
    }


@pytest.mark.parametrize("factor", [1, 1e3, 1e6, 1e9])
def test_unix_times_of_every_precision(factor: float) -> None:
    assert seconds(int(NOW * factor)) == NOW == seconds(str(int(NOW * factor)))
    assert seconds(int((NOW + 0.25) * factor)) == pytest.approx(NOW + 0.25 * (factor > 1), abs=1e-6)


@pytest.mark.parametrize(
    ("stamp", "clock", "expected"),
    [
        ("2026-03-01T13:10:00", Clock(BERLIN), NOW), ("2026-03-01T12:10:00Z", Clock(BERLIN), NOW),
        ("01.03.2026 13:10", Clock(BERLIN, "%d.%m.%Y %H:%M"), NOW),
        ("1.3.2026 12:10:00 +0000", Clock(BERLIN, "%d.%m.%Y %H:%M:%S %z"), NOW),
        (20260301131000, Clock(BERLIN, "%Y%m%d%H%M%S"), NOW),
        (46082.548611111, Clock(BERLIN, "excel"), NOW), ("46082.548611111", Clock(BERLIN, "excel"), NOW),
        (1e300, Clock(BERLIN, "excel"), None), ("2026-03-01T13:10:00", Clock(BERLIN, "excel"), None),
        ("2026-02-28 24:00", Clock(UTC), NOW - 43_800.0),
        ("28.02.2026 24:00", Clock(UTC, "%d.%m.%Y %H:%M"), NOW - 43_800.0),
        ("2026022824", Clock(UTC, "%Y%m%d%H"), NOW - 43_800.0),
        ("28.02.2026 24:10", Clock(UTC, "%d.%m.%Y %H:%M"), None),
        ("2026-03-01T13:10:00", Clock(), None),
        ("2026-03-01T12:10:00Z", Clock(BERLIN, "%d.%m.%Y %H:%M"), None),
        (NOW, Clock(BERLIN, "%d.%m.%Y %H:%M"), None), (None, Clock(BERLIN), None),
    ],
)  # fmt: skip
def test_stated_zones_and_forms(stamp: object, clock: Clock, expected: float | None) -> None:
    assert seconds(stamp, clock, NOW) == expected


def test_hours_that_summer_time_skips_or_repeats() -> None:
    clock = Clock(BERLIN)
    with pytest.raises(Refused, match=r"2026-03-29 02:30:00 does not exist in Europe/Berlin") as refusal:
        seconds("2026-03-29T02:30:00", clock)
    assert refusal.value.kind == "no time"
    first = 1_792_888_200.0  # 2026-10-25T00:30Z, 02:30 in summer time, an hour before 02:30 in winter time
    for lag_s in (-600.0, 0.0, 300.0, 2_400.0):  # the second pass is still to come
        assert seconds("2026-10-25T02:30:00", clock, first + lag_s) == first
    for lag_s in (3_000.0, 3_600.0, 6_000.0, 86_400.0):  # the time of arrival alone never decides
        with pytest.raises(Refused) as refusal:
            seconds("2026-10-25T02:30:00", clock, first + lag_s, {})
        assert refusal.value.kind == "ambiguous time"
    mapping = fields(clock=clock)
    assert kind(mapping, {"turbine": "W01", "time": "2026-10-25T02:30:00", "Tcab": 31.2}, "", 1.8e9) == (
        "ambiguous time"
    )


@pytest.mark.parametrize("delay_s", [0.0, 600.0, 3_000.0, 86_400.0])
@pytest.mark.parametrize("step_s", [60.0, 600.0, 1_800.0])
def test_the_order_of_its_source_places_a_stamp_of_the_repeated_hour(delay_s: float, step_s: float) -> None:
    """Whatever the delay: the second pass begins where the stamps of a turbine step back."""
    mapping, order = fields(clock=Clock(BERLIN)), {}
    begin = 1_792_886_400.0 - 7_200.0  # 2026-10-24T22:00Z
    for at in np.arange(begin, begin + 5 * 3_600.0, step_s):
        local = datetime.fromtimestamp(at, BERLIN).replace(tzinfo=None).isoformat()
        for turbine, lag_s in (("W01", 0.0), ("W02", 5.0)):
            payload = json.dumps({"turbine": turbine, "time": local, "Tcab": 31.2})
            for _ in range(2):  # a redelivery is a repetition
                (found,) = mapping.read(payload, at + lag_s + delay_s, "", order)
                assert [one.time for one in found.readings] == [at]


def test_an_order_with_a_gap_or_of_hours_does_not_place_a_stamp() -> None:
    clock, order = Clock(BERLIN), {}
    first = 1_792_888_200.0
    for at in (first - 3_600.0, first - 3_000.0):
        local = datetime.fromtimestamp(at, BERLIN).isoformat()[:19]
        assert seconds(local, clock, math.inf, order, ("W01",)) == at
    for later in (3_000.0, 7_200.0):  # silent since 01:40: either pass
        with pytest.raises(Refused):
            seconds("2026-10-25T02:30:00", clock, first + later, order, ("W01",))
    hours = {}
    for at in (first - 5_400.0, first - 1_800.0):
        local = datetime.fromtimestamp(at, BERLIN).isoformat()[:19]
        assert seconds(local, clock, at, hours, ("W01",)) == at
    with pytest.raises(Refused):  # 02:00 again: the same hour, or the next
        seconds("2026-10-25T02:00:00", clock, first + 1_800.0, hours, ("W01",))


# -- records -------------------------------------------------------------------------------------------------
def test_what_a_record_lacks_is_looked_up_around_it() -> None:
    mapping = fields(records="parks.rows", time="t")
    content = {
        "t": NOW, "parks": [
            {"turbine": "W01", "rows": [{"Tcab": 20.0}, {"RHcab": 40.0, "t": None}]},
            {"rows": [{"turbine": "W02", "Tcab": 21.0}, 5, {"Tcab": 22.0}]},
        ],
    }  # fmt: skip
    assert read(mapping, content) == {
        ("W01", "cabinet_temperature"): 293.15, ("W02", "cabinet_temperature"): 294.15,
        "no time": 1, "malformed": 1, "unknown turbine": 1,
    }  # fmt: skip
    assert mapping.read(json.dumps({"t": NOW, "parks": []}), NOW) == []
    assert kind(mapping, {"t": NOW}) == "no records" and kind(mapping, {"parks": [{}]}) == "no records"


def test_names_without_a_rule_are_counted_by_kind() -> None:
    tags = fields(records="v", tag="id", value="v", tag_pattern="{turbine}.{field}", time="{received}")
    content = {"v": [
        {"id": "W01.Tcab", "v": 20}, {"id": "W01.Oil", "v": 1}, {"id": "W77.Tcab", "v": 1},
        {"id": "x", "v": 1}, {"v": 1}, {"id": "W02.Tcab"}, {"id": "W02.Tcab", "v": None},
    ]}  # fmt: skip
    found = {of.turbine: counted(of) for of in tags.read(json.dumps(content), NOW)}
    assert found == {
        "W01": {"unknown tag": 1}, "W02": {"no known field": 1}, "": {"unknown tag": 2, "unknown turbine": 1}
    }  # fmt: skip
    assert read(fields(), {"turbine": "W01", "time": NOW, "Oil": 1}) == {"no known field": 1}
    assert read(fields(), {"turbine": "W01", "time": NOW, "Tcab": None}) == {}
    assert kind(fields(tag_pattern="{turbine}.{field}"), {"time": NOW, "W77.Tcab": 1}) == "no known field"


def test_a_tag_is_read_by_what_is_known() -> None:
    split = tag_reader("{turbine}.{field}", ["W.1", "W"], ["1.T", "T"])
    assert split("W.1.T") == ("W.1", "T", True) and split("W.T") == ("W", "T", True)
    assert split("W.1.1.T") == ("W.1", "1.T", True)
    assert split("W.Oil") == ("W", "Oil", False) and split("X.T") == ("X", "T", False)
    assert split("T") is None and split("W." + "x" * 300) is None
    began = time.process_time()
    for text in ("." * 199, "W." * 99, "1.T" * 66):
        tag_reader("*.{turbine}.{field}", ["W"], ["T"])(text)
    assert time.process_time() - began < 2.0


def test_values_that_stand_alone() -> None:
    plain = fields(form=PLAIN, turbine="{1}", tag="{-1}", value="value", time="{received}")
    assert read(plain, b'"21.5 \xc2\xb0C"', "a/W01/Tcab") == {("W01", "cabinet_temperature"): 294.65}
    assert read(plain, "true", "a/W01/Heater") == {("W01", "preheating"): 1.0}
    assert read(plain, "", "a/W01/Tcab") == {} and read(plain, "[]", "a/W01/Tcab") == {"no number": 1}
    assert read(plain, "1", "a/W01/Oil") == {"unknown tag": 1}
    assert kind(plain, "1", "a") == "unknown turbine" and kind(plain, b"\xff", "a/W01/Tcab") == "malformed"


def test_line_protocol() -> None:
    lines = fields(form=INFLUX, time="time | {received}")
    text = (
        '# a comment\nc,turbine=W01,n=a\\,b\\ c Tcab=20i,note="a, b=c \\" d",Heater=t 1772367000000\n'
        "c,turbine=W02 Tcab=21\nbroken\nc,turbine=W01 Tcab=\nc,turbine=W01 Tcab=1 soon\n"
    )
    assert read(lines, text) == {
        ("W01", "cabinet_temperature"): 293.15, ("W01", "preheating"): 1.0,
        ("W02", "cabinet_temperature"): 294.15, "malformed": 3,
    }  # fmt: skip
    began = time.process_time()
    for text in ("\\" * 30_000 + '"' * 30_001, '"\\' * 20_000, "a=b," * 15_000 + '"'):
        assert kind(lines, f"c,turbine=W01 {text}") == "malformed"
    assert time.process_time() - began < 1.0


def test_packed_payloads_are_bounded() -> None:
    text = json.dumps({"turbine": "W01", "time": NOW, "Tcab": 31.2, "note": "x" * LARGEST_PAYLOAD}).encode()
    packed = gzip.compress(text)
    assert read(fields(), packed) == {("W01", "cabinet_temperature"): 304.35}
    assert kind(fields(), text) == "too large"
    assert kind(fields(), gzip.compress(b" " * (UNPACKED + 1))) == "too large"
    bomb = gzip.compress(b"0" * 50_000_000)
    began = time.process_time()
    assert len(bomb) < LARGEST_PAYLOAD and kind(fields(), bomb) == "too large"
    assert time.process_time() - began < 0.5
    assert kind(fields(), packed[:-9]) == kind(fields(), b"\x1f\x8b" + bytes(40)) == "malformed"


def test_names_of_one_turbine_and_of_the_others() -> None:
    mapping = fields(names={"W02": {"TT": "Tcab", "Tcab": "RHcab"}})
    content = {"time": NOW, "Tcab": 30.0, "RHcab": 50.0, "TT": 20.0}
    assert read(mapping, {"turbine": "W01", **content}) == {
        ("W01", "cabinet_temperature"): 303.15, ("W01", "cabinet_relative_humidity"): 0.5
    }  # fmt: skip
    assert read(mapping, {"turbine": "W02", **content}) == {
        ("W02", "cabinet_temperature"): 293.15, ("W02", "cabinet_relative_humidity"): 0.3
    }  # fmt: skip


def cost(run: object, count: int) -> float:
    """CPU time of one call [s], the least of several rounds of a few."""
    return min(timeit.repeat(run, number=count, repeat=9, timer=time.process_time)) / count


def test_reading_costs_little_more_than_parsing() -> None:
    """A flat payload of four values less than eight times what Python's own JSON takes (measured: four); a
    value of an array less than that payload."""
    values = {"Tcab": 31.2, "RHcab": 41.5, "P": 1500.0, "Heater": 1}
    flat = json.dumps({"turbine": "W01", "time": "2026-03-01T12:10:00Z", "q": "good", **values}).encode()
    value = {"id": "A.B.W01.Tcab", "v": 31.2, "q": True, "t": int(NOW * 1e3)}
    array = json.dumps({"values": [value] * 500}).encode()
    mapping = fields(quality="q")
    own = {"tag": "id", "value": "v", "quality": "q", "time": "t"}
    tags = fields(records="values", tag_pattern="*.{turbine}.{field}", **own)
    assert len(mapping.read(flat, NOW)[0].readings) == 4 and len(tags.read(array, NOW)[0].readings) == 500
    parsing, reading = cost(lambda: json.loads(flat), 500), cost(lambda: mapping.read(flat, NOW), 200)
    each = cost(lambda: tags.read(array, NOW), 2) / 500
    assert reading < 8.0 * parsing and each < reading, (parsing, reading, each)


# -- the tracker's file --------------------------------------------------------------------------------------
def test_a_source_has_a_mapping_of_its_own(folder: Path) -> None:
    own = '[[source]]\nurl = "file:x.csv"\n[source.mapping]\ntime = "Zeit"\ntimezone = "+01:00"\n'
    own += 'decimal = ","\n'
    found = config(folder, '[mapping]\ntime = "t"\nquality = "q"', SOURCE + own)
    common, table = (one.mapping for one in found.streams)
    reset = own + 'records = ""\ntag = ""\nvalue = ""\ntag_pattern = ""\ntime_format = ""\nquality = ""\n'
    arrays = '[mapping]\nrecords = "v"\ntag = "i"\nvalue = "v"\ntag_pattern = "*{field}"\nquality = "q"\n'
    flat = config(folder, arrays + 'time_format = "%d.%m.%Y %H:%M"', SOURCE + reset).streams[1].mapping
    assert flat == replace(table, quality="")
    assert (common.time, common.marks, common.clock.zone) == ("t", None, None)
    assert (table.time, table.marks, table.quality) == ("Zeit", (",", "."), "q")
    assert table.fields == common.fields and table.turbines == common.turbines
    only = own + '[source.mapping.signals]\nT = { signal = "cabinet_temperature", unit = "K" }\n'
    (alone,) = config(folder, "", only).streams
    assert list(alone.mapping.fields) == ["T"]


FAULTS = [
    ("[mapping]\ntag_pattern = '{turbin}.{field}'", "tag_pattern: expected a pattern with {field}"),
    ("[mapping]\ntag_pattern = '{turbine}'", "tag_pattern: expected a pattern with {field}"),
    ("[mapping]\ntag_pattern = '*{turbine}.{field}*'", "at most once"),
    ("[mapping]\ntime = '{recieved}'", "time: expected a field, or one of"),
    ("[mapping]\nturbine = '{received}'", "turbine: expected a field"),
    ("[mapping]\nturbine = 'a | '", "both sides of |"),
    ("[mapping]\nrecords = 'a..b'", "records: expected names with points between"),
    ("[mapping]\nformat = 'influxdb'", 'format must be one of json, plain, influx, found "influxdb"'),
    ("[mapping]\nformat = 'plain'", "a plain value has no field 'time'"),
    ("[mapping]\ntimezone = 'Europe/Berlyn'", "Europe/Berlin"),
    ("[mapping]\ntime_format = '%H:%M'", "time_format: expected a strptime form"),
    ("[mapping]\ntime_format = 'DD.MM.YYYY'", "time_format: expected a strptime form"),
    ("[mapping]\ntime_format = '%m/%d/%Y %H:%M %p'", "write %I for %H"),
    ("[mapping]\ndecimal = ';'", "decimal must be one of"),
    ("[mapping]\nrecord = 'values'", 'unknown key "record"'),
    ("[mapping.signals]\nT = { signal = 'cabinet_temperature', unit = 'degC', scale = 0 }", "scale must be"),
    ("[[turbine]]\nname = \"W02\"\nnames = { TT = 'Tcabb' }", "which [mapping.signals] does not have"),
    ("[[turbine]]\nname = \"W02\"\nnames = 'TT'", "names: expected a table"),
]


@pytest.mark.parametrize(("mapping", "said"), FAULTS, ids=[one[1][:30] for one in FAULTS])
def test_faults_of_a_mapping_are_told(folder: Path, mapping: str, said: str) -> None:
    with pytest.raises(ConfigFault) as fault:
        config(folder, mapping)
    assert said in str(fault.value) and len(fault.value.faults) == 1, fault.value


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ("time = '{received}'", "is for sources that send by themselves"),
        ("tag = 'tag'", "[[source]] 2 mapping: tag and value belong together"),
        ("signals = { T = { signal = 'cabinet_temperature', unit = 'degC', accuracy = 0.5 } }",
            "T is cabinet_temperature of another interval"),
        ("signals = {}", "no signals"),
    ],
)  # fmt: skip
def test_faults_of_a_source_s_mapping_are_told(folder: Path, own: str, said: str) -> None:
    source = f'[[source]]\nurl = "file:x.csv"\n[source.mapping]\n{own}\n'
    with pytest.raises(ConfigFault) as fault:
        config(folder, "[mapping]", SOURCE + source)
    assert said in str(fault.value) and len(fault.value.faults) == 1, fault.value


def test_all_faults_of_all_mappings_at_once(folder: Path) -> None:
    sources = SOURCE + '[source.mapping]\ndecimal = ";"\n'
    sources += '[[source]]\nurl = "stdin"\n[source.mapping]\nvalue = "v"\n'
    with pytest.raises(ConfigFault) as fault:
        config(folder, "[mapping]\ntimezone = 'Mars'\ntime = '{x}'", sources)
    assert len(fault.value.faults) == 4, fault.value
    assert path_fault("{1} | {name}_q") is None and pattern_fault("*{turbine}{field}") is None


# -- fuzz ----------------------------------------------------------------------------------------------------
SCRAPS = (
    None, True, False, 0, -1, 31.2, 1e308, 10**30, math.nan, "", "31.2", "31,2", "31.2 °C", "1_000", "\ud800",
    "W01", "W01.Tcab", "Tcab", "W02_RHcab", "2026-03-01T12:10:00Z", "2026-03-01T13:10:00",
    "01.03.2026 13:10", NOW, NOW * 1e3, NOW * 1e9, "192", "Good", [], {}, [[]], [{}],
    {"Value": {"Body": 31.2}},
)  # fmt: skip
NAMES = (
    "values", "metrics", "Messages", "Payload", "id", "v", "q", "t", "timestamp", "name", "value", "tag",
    "time", "turbine", "Tcab", "W01.Tcab", "W01.Tcab.q", "air.T", "Value", "Body", "Timestamp", "header",
    "ts", "us", "\x00",
)  # fmt: skip


def scrap(random_: random.Random, depth: int = 0) -> object:
    draw = random_.random()
    if depth < 4 and draw < 0.35:
        return {random_.choice(NAMES): scrap(random_, depth + 1) for _ in range(random_.randrange(5))}
    if depth < 4 and draw < 0.55:
        return [scrap(random_, depth + 1) for _ in range(random_.randrange(4))]
    return random_.choice(SCRAPS)


def damaged(random_: random.Random, payload: bytes) -> bytes:
    """A payload as it was found, or cut, with bytes changed, with parts exchanged, or packed."""
    draw, found = random_.randrange(6), bytearray(payload)
    if draw == 1:
        return bytes(found[: random_.randrange(len(found) + 1)])
    if draw == 2:
        for _ in range(random_.randrange(1, 8)):
            found[random_.randrange(len(found))] = random_.randrange(256)
    elif draw == 3:
        parts = re.split(rb"([,:{}\[\]])", payload)
        random_.shuffle(parts)
        return b"".join(parts)
    elif draw == 4:
        packed = bytearray(gzip.compress(payload, mtime=0))
        packed[random_.randrange(len(packed))] ^= 1 << random_.randrange(8)
        return bytes(packed)
    elif draw == 5:
        return json.dumps(scrap(random_)).encode()
    return bytes(found)


def fuzz(folder: Path, seed: int, count: int) -> Counter[str]:
    """Counts of readings and rejections of so many payloads; every result is checked."""
    random_, counts = random.Random(seed), Counter[str]()
    rules = [config(folder, mapping).streams[0].mapping for _, _, mapping, _ in LAYOUTS]
    rules.append(fields(clock=Clock(BERLIN), marks=Marks(",", "."), records="*.*", quality="{name}.q | q"))
    samples = [captured(folder, one, rule) for one, rule in zip(LAYOUTS, rules[:-1], strict=True)]
    samples.append([payload for some in samples for payload in some])
    for number_ in range(count):
        place = number_ % len(rules)
        mapping, topic = rules[place], random_.choice(("", "a/W01/Tcab", "spBv1.0/a/b/c/W01"))
        payload = damaged(random_, random_.choice(samples[place if random_.random() < 0.8 else -1]))
        try:
            found = mapping.read(payload, NOW, topic)
        except Refused as refusal:
            assert len(str(refusal)) < 1_000
            counts[refusal.kind] += 1
            continue
        mapping.stamp(payload)
        expect_sound(found)
        counts.update(kind for of in found for kind, _ in of.rejections)
        counts["reading"] += sum(len(of.readings) for of in found)
    return counts


def captured(folder: Path, layout: tuple[str, ...], mapping: PayloadMapping) -> list[bytes]:
    """The payloads of a layout; rows of tables as JSON."""
    file = folder / "captured"
    file.write_text(layout[1], encoding="utf-8")
    contents = [one.content for one in file_payloads(file, mapping)]
    texts = [one if isinstance(one, str | bytes) else json.dumps(one) for one in contents]
    return [one.encode() if isinstance(one, str) else one for one in texts]


def expect_sound(found: list[TurbineReadings]) -> None:
    for of in found:
        assert of.turbine in ("", "W01", "W02") and (of.turbine or not of.readings)
        for one in of.readings:
            assert one.signal in {field.signal for field in FIELDS.values()}
            assert math.isfinite(one.value) and EARLIEST_STAMP_S <= one.time <= LATEST_STAMP_S


@pytest.mark.parametrize("count", [4_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_nothing_from_outside_breaks_a_mapping(folder: Path, count: int) -> None:
    counts = fuzz(folder, 18, count)
    assert min(counts["reading"], counts["malformed"]) > 0.03 * count and len(counts) >= 9, counts


# -- one place a tag -----------------------------------------------------------------------------------------
def test_a_tag_that_two_sources_read_as_different_signals_names_both(folder: Path) -> None:
    own = '[source.mapping.signals]\nTcab = { signal = "ambient_temperature", unit = "degC" }\n'
    broker = SOURCE.replace("[[source]]", '[[source]]\nclient_id = "b"')
    twice = r"2: Tcab of mqtt://127.0.0.1:1 is ambient_temperature here and cabinet_temperature in"
    with pytest.raises(ConfigFault, match=rf"{twice} .*\[\[source\]\] 1: a tag has one place"):
        config(folder, "", SOURCE + broker + own)
    assert len(config(folder, "", SOURCE + broker).streams) == 2
    elsewhere = broker.replace('"#"', '"mast"')
    assert len(config(folder, "", SOURCE.replace('"#"', '"cabinet"') + elsewhere + own).streams) == 2


def test_a_node_that_two_sources_read_for_different_turbines_names_both(folder: Path) -> None:
    def server(turbine: str) -> str:
        node = f'{{ "i=5" = {{ turbine = "{turbine}", field = "Tcab" }} }}'
        return f'[[source]]\nurl = "opc.tcp://127.0.0.1:1/"\nnodes = {node}\n'

    said = r"2: i=5 of opc.tcp://127.0.0.1:1/ is \w+ of W02 here and cabinet_temperature of W01 in"
    with pytest.raises(ConfigFault, match=rf"{said} .*\[\[source\]\] 1"):
        config(folder, "", server("W01") + server("W02"))
