"""The form of a case file: keys, types, lines."""

from __future__ import annotations

import re
import tomllib

import pytest

from hygrokf.cases.form import stated_case
from hygrokf.data.numbers import Meaning
from hygrokf.data.quality import StatedQuality
from hygrokf.data.toml_form import Place, lines_of

GOOD = """name = "uk-01"
rated_power_kW = 2050.0
[site]
latitude_deg = 52.4
longitude_deg = -0.95
[[source]]
file = "cabinet.csv"
time = "time"
signals.cabinet_temperature = { column = "T", unit = "degC", accuracy = 0.5, resolution = 0.1 }
[[source]]
file = "scada.csv"
time = "stamp"
timezone = "+01:00"
stamp = "start"
interval = "10min"
clock_uncertainty = "2min"
separator = ";"
decimal = ","
missing = ["bad"]
signals.active_power = { column = "P", unit = "kW" }
[identification]
start = "2020-07-01T00:00:00Z"
until = 2020-12-01T00:00:00Z
"""


def state(text: str):
    case = stated_case(tomllib.loads(text), Place(file="case.toml", lines=lines_of(text)))
    return case, case.place.faults


def faults(*changes: tuple[str, str]) -> list[str]:
    text = GOOD
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    return state(text)[1]


def test_the_form_is_read():
    case, found = state(GOOD)
    assert found == []
    form, period = case.form, case.form.identification
    assert form.name == "uk-01"
    assert form.rated_power_W == 2.05e6
    assert (form.site.latitude_deg, form.site.longitude_deg) == (52.4, -0.95)
    assert form.site.altitude_m is None
    assert period.until_s - period.start_s == 153 * 86400.0
    assert case.declared == {"cabinet_temperature": 0, "active_power": 1}
    cabinet, scada = case.sources
    assert (cabinet.file, cabinet.time, cabinet.stamp) == ("cabinet.csv", "time", "instant")
    assert (cabinet.hold, cabinet.interval_s, cabinet.clock_uncertainty_s) == (None, None, None)
    (column,) = cabinet.columns
    assert (column.column, column.unit) == ("T", "degC")
    assert column.settings == {"accuracy": 0.5, "resolution": 0.1}
    assert (scada.stamp, scada.interval_s, scada.clock_uncertainty_s) == ("start", 600.0, 120.0)
    assert (scada.timezone, scada.separator, scada.decimal, scada.missing) == ("+01:00", ";", ",", ("bad",))
    assert scada.meanings == {"P": Meaning("active_power", "kW")}
    assert scada.quality == StatedQuality({"P": None})


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('name = "', 'nam = "', 1, ['unknown key "nam"', '"name"?']),
        ("2050.0", '"2050"', 2, ["rated_power_kW", "above 0", "'2050'"]),
        ("2050.0", "-1", 2, ["above 0"]),
        ("2050.0", "true", 2, ["above 0"]),
        ("latitude_deg = 52.4", "lat = 52.4", 3, ["needs latitude_deg"]),
        ("52.4", "152.4", 4, ["-90 … 90"]),
        ("-0.95", '"west"', 5, ["longitude_deg must be a number"]),
        ('file = "c', 'fil = "c', 7, ['unknown key "fil"', '"file"?']),
        ('"cabinet.csv"', "3", 7, ["file must be text"]),
        ("cabinet_temperature", "cabinet_temp", 9, ['"cabinet_temp"', '"cabinet_temperature"']),
        ('"degC"', '"celsius"', 9, ["unknown unit", '"degC"?']),
        ('"degC"', '"kW"', 9, ['unit "kW" is one of power', "K, degC, degF"]),
        ("column =", "colum =", 9, ['unknown key "colum"', '"column"?']),
        ("accuracy = 0.5", "accuracy = -0.5", 9, ["accuracy: expected a number ≥ 0"]),
        ("resolution = 0.1", "response_time = 10", 9, ["response_time: expected a duration"]),
        ("resolution = 0.1", 'resolution = "x"', 9, ["resolution: expected a number ≥ 0"]),
        ('stamp = "start"', 'stamp = "begin"', 14, ["instant, start, middle, end"]),
        ('stamp = "start"', "", 15, ["position of its stamp in the averaging interval"]),
        ('"10min"', "10", 15, ["interval", "10min"]),
        ('"10min"', '"0s"', 15, ["longer than 0"]),
        ('"2min"', '"two"', 16, ["clock_uncertainty", "duration"]),
        ('";"', '";;"', 17, ["one character"]),
        ('";"', '","', 18, ["both"]),
        ('["bad"]', '"bad"', 19, ["list of texts"]),
        ('start = "2020-07-01T00:00:00Z"', "from = 1", 22, ["unknown key", "until, start"]),
        ('"2020-07-01T00:00:00Z"', '"2020-07-01"', 22, ["no offset"]),
        ('"2020-07-01T00:00:00Z"', '"2021-07-01T00:00Z"', 22, ["before until"]),
        ("2020-12-01T00:00:00Z", "2020-12-01", 23, ["ISO 8601", '"2020-12-01"']),
        ("2020-12-01T00:00:00Z", "2020-12-01T00:00:00", 23, ["no offset", "Z"]),
    ],
)
def test_a_fault_names_line_finding_and_remedy(old, new, line, words):
    found = faults((old, new))
    hits = [one for one in found if all(word in one for word in words)]
    assert hits, found
    assert re.match(rf"case\.toml, line {line}[:,]", hits[0])


def test_all_faults_come_at_once():
    found = faults(
        ("2050.0", "0"), ("52.4", "152.4"), ("degC", "C"), ('"start"', '"begin"'), ("until", "untill")
    )
    assert len(found) >= 5


def test_a_signal_named_twice_names_both_lines():
    (found,) = faults(("signals.active_power", "signals.cabinet_temperature"), ('"kW"', '"K"'))
    assert found.startswith("case.toml, line 20, [[source]] 2 signals.cabinet_temperature: ")
    assert "(first: case.toml, line 9, [[source]] 1 signals.cabinet_temperature)" in found


def test_a_source_without_signals_file_or_time():
    found = faults(('file = "cabinet.csv"\n', ""), ('time = "time"\n', ""))
    assert "case.toml, line 6, [[source]] 1: needs file, path, relative to the case file" in " ".join(found)
    assert "case.toml, line 6, [[source]] 1: needs time, column of the stamps" in found
    _, found = state('[[source]]\nfile = "a.csv"\ntime = "t"\n')
    assert "names no signal" in found[0]


def test_signals_may_be_tables():
    case, found = state(
        '[[source]]\nfile = "a.csv"\ntime = "t"\n[source.signals.rain]\ncolumn = "r"\nunit = "mm"\n'
    )
    assert found == []
    assert case.sources[0].columns[0].unit == "mm"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "names no source"),
        ("source = 3", "[[source]]"),
        ('[source]\nfile = "a.csv"', "[[source]]"),
        ("site = 3", "[site]"),
        ("identification = 3", "[identification]"),
        ('[[source]]\nfile = "a"\ntime = "t"\nsignals.rain = "r"', "column = "),
        (
            '[[source]]\nfile = "a"\ntime = "t"\nsignals.rain = { column = "r" }',
            "needs unit, one of 1, %, mm",
        ),
        ("[[source]]\nignore_offset = true", "needs the timezone"),
        ("[[source]]\nignore_offset = 1", "true or false"),
    ],
)
def test_odd_forms_are_faults_too(text, word):
    assert any(word in one for one in state(text)[1])
