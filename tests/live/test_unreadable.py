"""Every source: what cannot be read is counted and passed, and quality means the same in every layout."""

from __future__ import annotations

import io
import json
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from builders.rejections import counted
from builders.sparkplug_peer import FLOAT, metric, payload
from builders.track_case import write_model

from hygrokf.commands.main import main
from hygrokf.data.quality import VOCABULARIES, QualityVocabulary, stated_vocabulary
from hygrokf.live.doctor.payloads import file_payloads, read_trial, trials_text
from hygrokf.live.sources.local import StandardInput, TailedFile
from hygrokf.live.sources.opcua_client import Node, sample_of
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.payload_formats import Content, Refused
from hygrokf.live.sources.sparkplug_node import Arrived, BirthTable, EdgeAddress, contents_of
from hygrokf.live.sources.sparkplug_payload import decode
from hygrokf.live.sources.stream import Delivery

AT = 1_772_366_400.0
STAMP = "2026-03-01T12:00:00Z"
FIELDS = {"Tcab": Field("cabinet_temperature", "degC"), "RHcab": Field("cabinet_relative_humidity", "%")}
MAPPING = PayloadMapping(FIELDS, turbines={"W01": "W01"})
SIGNALS = (
    '[mapping.signals]\nTcab = { signal = "cabinet_temperature", unit = "degC" }\n'
    'RHcab = { signal = "cabinet_relative_humidity", unit = "%" }\n'
)


def read(mapping: PayloadMapping, contents: list[Content], topic: str = "") -> tuple[Counter, Counter]:
    """Numbers of readings by signal, and what is counted."""
    readings: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    for content in contents:
        try:
            for of in mapping.read(content, AT + 60.0, topic):
                readings.update(one.signal for one in of.readings)
                counts += counted(of)
        except Refused as refusal:
            counts[refusal.kind] += 1
    return readings, counts


# -- numbers that are none -----------------------------------------------------------------------------------
NO_NUMBERS = ["nan", "NaN", "NAN", "-nan", "+NaN", "nan(ind)", "-nan(ind)", "inf", "-inf", "Infinity",
              "-Infinity", "INF", "-INFINITY", "1.#QNAN", "-1.#IND", "1.#INF"]  # fmt: skip


@pytest.mark.parametrize("word", NO_NUMBERS)
def test_a_bare_nan_costs_its_own_value_alone(word: str, tmp_path: Path) -> None:
    text = f'{{"turbine": "W01", "time": "{STAMP}", "note": "a nan, \\"inf\\"", "Tcab":{word}, "RHcab": 40}}'
    expected = ({"cabinet_relative_humidity": 1}, {"no number": 1})
    assert read(MAPPING, [text.encode()]) == read(MAPPING, [text]) == read(MAPPING, [f"[{text}]"]) == expected
    (tmp_path / "captured.json").write_text(text.replace(', "', ',\n"'), "utf-8")
    assert "1 of 1 payloads gave readings" in trials_text(
        [read_trial(("",), MAPPING, file_payloads(tmp_path / "captured.json", MAPPING))]
    )
    for rows in ([f"turbine,time,Tcab,RHcab\nW01,{STAMP},{word},40\n"], [text + "\n"]):
        for contents in (by_file(tmp_path, "".join(rows)), by_input("".join(rows))):
            assert read(MAPPING, contents) == expected
    line = f"c,turbine=W01 Tcab={word},RHcab=40 1772366400000000000"
    assert read(replace(MAPPING, form="influx"), [line]) == expected
    assert read(replace(MAPPING, form="plain", turbine="{0}", tag="{1}", value="value", time="{received}"),
                [word], "W01/Tcab") == ({}, {"no number": 1})  # fmt: skip


@pytest.mark.parametrize(
    "text",
    ['{"Tcab": nanx}', '{"Tcab": 1nan}', "{nan: 1}", '{"Tcab": nan', '"nan" nan', '{"Tcab" nan}', "nan"],
)
def test_what_is_no_json_stays_malformed(text: str) -> None:
    assert read(MAPPING, [text]) == ({}, {"malformed": 1})


def test_texts_with_such_words_stay_as_they_are() -> None:
    mapping = replace(MAPPING, turbines={"nan": "W01", 'a\\b"inf': "W01"})
    for name in mapping.turbines:
        text = json.dumps({"turbine": name, "time": STAMP, "Tcab": 1}).replace("}", ', "RHcab": -nan}')
        assert read(mapping, [text]) == ({"cabinet_temperature": 1}, {"no number": 1})


def test_open_texts_are_refused_in_linear_time() -> None:
    for text in ('"' * 60_000, '\\"' * 30_000, "nan" * 20_000, '{"a\\' * 10_000):
        assert read(MAPPING, [text])[1].total() == 1


def by_file(folder: Path, text: str) -> list[Content]:
    path = folder / "rows.txt"
    path.write_text(text, "utf-8")
    stream, found = TailedFile(path, MAPPING, follow=False), list[Delivery]()
    stream._deliver(None, found.append)
    return [one.content for one in found]


def by_input(text: str) -> list[Content]:
    found: list[Delivery] = []
    StandardInput(MAPPING, io.BytesIO(text.encode()))._deliver(None, found.append)
    return [one.content for one in found]


# -- times that are none -------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "stamp", ["infinity", "-infinity", "4713-01-01 00:00:00+00 BC", "20000-01-01T00:00Z", "0000-00-00",
              "1e300", "9999-12-31T23:59:59Z", "0001-01-01T00:00:00Z"],
)  # fmt: skip
def test_a_row_of_an_impossible_time_is_counted_and_the_others_are_read(stamp: str, tmp_path: Path) -> None:
    rows = [f"W01,{one},20,40\n" for one in (STAMP, stamp, "2026-03-01T12:00:10Z")]
    text = "turbine,time,Tcab,RHcab\n" + "".join(rows)
    for contents in (by_file(tmp_path, text), by_input(text)):
        readings, counts = read(MAPPING, contents)
        assert readings == {"cabinet_temperature": 2, "cabinet_relative_humidity": 2}
        assert counts.total() == 1 and set(counts) <= {"no time", "impossible time"}


@pytest.mark.parametrize("year", [1, 1600, 1899, 2101, 9999])
def test_an_opc_ua_value_of_an_impossible_time_is_counted(year: int) -> None:
    from asyncua import ua

    for when in (datetime(year, 1, 1, tzinfo=UTC), datetime(year, 12, 31, 23, 59, 59, 999_999)):
        value = ua.DataValue(ua.Variant(1.5), ua.StatusCode(0), SourceTimestamp=when)
        sample = sample_of(Node("i=1", "W01", "Tcab"), value, AT)
        content = {"turbine": "W01", "time": sample.time, "Tcab": sample.value}
        assert read(MAPPING, [content])[1] in ({"impossible time": 1}, {"no time": 1})


def sparkplug(*metrics: object) -> list[Content]:
    """What the metrics of a device give."""
    message = decode(payload(metrics, 1, AT))
    address = EdgeAddress("Farm", "DDATA", "N1", "W01")
    found = contents_of(Arrived(address, "", message, b"", AT), BirthTable.of(message))
    return [{**one, "turbine": "W01"} for one in found]


@pytest.mark.parametrize("at", [-1.0, 0.0, 1.0, 5e9, 1e13, 1.8e16])
def test_a_sparkplug_metric_of_an_impossible_time_is_counted(at: float) -> None:
    metrics = [metric("Tcab", 20.0, FLOAT, at=AT), metric("RHcab", 40.0, FLOAT)]
    metrics[1].timestamp = int(1000 * at) % 2**64
    readings, counts = read(MAPPING, sparkplug(*metrics, metric("Tcab", float("nan"), FLOAT, at=AT)))
    assert readings == {"cabinet_temperature": 1}
    assert counts == {"impossible time": 1, "no number": 1}


# -- quality -------------------------------------------------------------------------------------------------
MARKS = {192: "good", 216: "good", 64: "uncertain", 24: "bad", 0: "bad"}


def layouts(mark: object) -> dict[str, tuple[str, Content, str]]:
    """Name → mapping, payload and topic, with one value of a quality."""
    row = {"turbine": "W01", "time": STAMP, "Tcab": 20.0, "q": mark}
    values = [{"id": "P.W01_Tcab", "v": 20.0, "q": mark, "t": 1000 * AT}]
    return {
        "object": ('quality = "q"', json.dumps(row), ""),
        "text": ('quality = "q"', json.dumps({**row, "q": str(mark)}), ""),
        "columns of a database": ('quality = "q"', {**row, "q": mark and float(mark)}, ""),
        "beside each value": ('quality = "{name}_q"', json.dumps({**row, "Tcab_q": mark}), ""),
        "arrays": (
            'records = "values"\ntag = "id"\nvalue = "v"\nquality = "q"\ntime = "t"\n'
            'tag_pattern = "*.{turbine}_{field}"', json.dumps({"values": values}), "",
        ),
        "one tag a topic": (
            'turbine = "{1}"\ntag = "{-1}"\nvalue = "v"\nquality = "q"\ntime = "t"',
            json.dumps({"v": 20.0, "t": AT, "q": mark}), "park/W01/Tcab",
        ),
        "names": (
            'tag_pattern = "{turbine}.{field}"\nquality = "q"',
            json.dumps({"time": STAMP, "W01.Tcab": 20.0, "q": mark}), "",
        ),
    }  # fmt: skip


@pytest.fixture
def mapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Makes a mapping from the lines of a tracker's file."""
    from hygrokf.live.config import read_config

    monkeypatch.chdir(tmp_path)
    write_model(tmp_path / "W01")

    def made(lines: str) -> PayloadMapping:
        head = '[[turbine]]\nname = "W01"\nfit = "W01"\n[[source]]\nurl = "stdin"\n'
        Path("track.toml").write_text(f"{head}[mapping]\n{lines}\n{SIGNALS}", "utf-8")
        return read_config("track.toml").streams[0].mapping

    return made


@pytest.mark.parametrize("layout", list(layouts(0)))
def test_quality_means_the_same_in_every_layout(layout: str, mapped) -> None:
    for mark, outcome in MARKS.items():
        lines, content, topic = layouts(mark)[layout]
        stated = mapped(f'{lines}\nvocabulary = "opc-da"')
        unstated, strict = (
            replace(stated, vocabulary=MAPPING.vocabulary),
            replace(stated, use_uncertain=False),
        )
        for mapping, found in ((stated, outcome), (unstated, "ambiguous" if mark == 0 else outcome),
                               (strict, "bad" if outcome == "uncertain" else outcome)):  # fmt: skip
            readings, counts = read(mapping, [content], topic)
            assert readings["cabinet_temperature"] == (found in ("good", "uncertain"))
            assert counts == ({} if found == "good" else {f"{found} quality": 1}), (mark, mapping)
    lines, content, topic = layouts(None)[layout]
    if layout != "text":
        assert read(mapped(lines), [content], topic) == ({"cabinet_temperature": 1}, {})


def test_the_keys_of_a_vocabulary(mapped) -> None:
    for stated, expected in (
        ('vocabulary = "opc-ua"', VOCABULARIES["opc-ua"]),
        ("vocabulary = [100]", stated_vocabulary([100])),
        ("good = [0]", stated_vocabulary([0])),
        ("", MAPPING.vocabulary),
    ):
        found: QualityVocabulary = mapped(f'quality = "q"\n{stated}').vocabulary
        assert found == expected


@pytest.mark.parametrize(("mark", "outcome"), [*MARKS.items(), (None, "good"), (255, "good"), (500, "bad")])
def test_sparkplug_s_property_is_in_opc_da_s_codes(mark: int | None, outcome: str) -> None:
    metrics = [metric("Tcab", 20.0, FLOAT, at=AT, quality=mark), metric("RHcab", 40.0, FLOAT, at=AT)]
    null = metric("Tcab", None, FLOAT, at=AT)
    readings, counts = read(replace(MAPPING, quality="quality"), sparkplug(*metrics, null))
    assert readings["cabinet_temperature"] == (outcome in ("good", "uncertain"))
    assert readings["cabinet_relative_humidity"] == 1
    assert counts == ({} if outcome == "good" else {f"{outcome} quality": 1})


def test_the_doctor_says_which_vocabulary_would_fit(mapped, capsys: pytest.CaptureFixture) -> None:
    rows = [(0, 192, 31.2), (10, 0, -17.8), (20, 192.0, 31.3), (30, 216, 31.3), (40, 24, 31.3)]
    payloads = [
        json.dumps({"turbine": "W01", "time": f"2026-03-01T12:{minute:02d}:00Z", "q": mark, "Tcab": value})
        for minute, mark, value in rows
    ]
    Path("payloads.ndjson").write_text("\n".join(payloads) + "\n")
    for lines, words in (
        ('quality = "q"', 'state vocabulary = "opc-da", which fits 0, 24, 192, 216'),
        ("", 'state quality = "q", or "" if it is none; state vocabulary = "opc-da"'),
        ('quality = "q"\nvocabulary = "opc-da"', None),
    ):
        mapped(lines)
        assert main(["doctor", "track.toml", "--try", "payloads.ndjson"]) == 0
        said = capsys.readouterr().out
        assert ("state " in said) is (words is not None) and (words or "") in said
        used = [line.split()[2] for line in said.splitlines() if "W01  cabinet_temperature" in line]
        if lines:
            assert used == ["2026-03-01T12:00Z", "2026-03-01T12:20Z", "2026-03-01T12:30Z"]
