"""Whole cases: files in, record out, or all faults at once."""

from __future__ import annotations

import dataclasses
import json
import math
import pickle
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from builders.faults import faults_of
from builders.measured import DATA, measured

from hygrokf.cases.case_file import CaseFault, read_case
from hygrokf.cases.doubts import all_doubts
from hygrokf.cases.frames import read_frames
from hygrokf.cases.summary import describe
from hygrokf.data.ambient import at_times
from hygrokf.data.input_paths import on_change
from hygrokf.data.record import Provenance, Record, Series
from hygrokf.modelling.design import design, extended
from hygrokf.modelling.inputs import model_inputs
from hygrokf.report.record_text import describe_text
from hygrokf.texts.record_codes import DoubtCode
from hygrokf.texts.wording import stamp_text

START = datetime(2020, 6, 1, tzinfo=UTC)
COUNT = 3000

CASE = """name = "uk-01"
rated_power_kW = 2050.0
[[source]]
file = "cabinet.csv"
time = "time"
signals.cabinet_temperature = { column = "T", unit = "degC" }
signals.cabinet_relative_humidity = { column = "RH", unit = "%" }
[[source]]
file = "ambient.csv"
time = "time"
signals.ambient_temperature = { column = "T", unit = "degC" }
[[source]]
file = "scada.csv"
time = "time"
stamp = "start"
signals.active_power = { column = "P", unit = "kW" }
"""


def seconds(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def columns(seed: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    day = np.sin(2 * np.pi * np.arange(COUNT) / 144)
    return {
        "T": np.round(20 + 5 * day + random.normal(0, 0.3, COUNT), 1),
        "RH": np.round(50 - 10 * day + random.normal(0, 1.0, COUNT), 1),
        "P": np.round(np.clip(900 + 800 * random.normal(0, 1, COUNT), -8, 2050), 1),
    }


def csv(chosen: dict[str, np.ndarray], start: datetime = START, form: str = "%Y-%m-%dT%H:%MZ"):
    rows = [",".join(["time", *chosen])]
    for k in range(COUNT):
        stamp = (start + timedelta(minutes=10 * k)).strftime(form)
        rows.append(",".join([stamp, *(str(array[k]) for array in chosen.values())]))
    return "\n".join(rows) + "\n"


FILES = {"cabinet": ("T", "RH"), "ambient": ("T",), "scada": ("P",)}
"""Columns of each file."""


def table(name: str, **new) -> str:
    """A file's text with columns changed; `start` and `form` go to the stamps."""
    everything = columns(list(FILES).index(name))
    stamps = {key: new.pop(key) for key in ("start", "form") if key in new}
    return csv({one: new.get(one, everything[one]) for one in FILES[name]}, **stamps)


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    """The text of each file."""
    return {name: table(name) for name in FILES}


@pytest.fixture
def folder(tmp_path: Path, texts: dict[str, str]) -> Path:
    for name, text in texts.items():
        (tmp_path / f"{name}.csv").write_text(text)
    return tmp_path


def change(folder: Path, name: str, **new) -> None:
    """Write one file anew with columns changed."""
    (folder / f"{name}.csv").write_text(table(name, **new))


def read(folder: Path, *changes: tuple[str, str], add: str = "", **more):
    text = CASE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "case.toml").write_text(text + add)
    return read_case(folder / "case.toml", **more)


def test_the_name_is_by_default_that_of_the_file(folder):
    assert read(folder).name != "case" and read(folder, ('name = "uk-01"\n', "")).name == "case"


def faults(folder: Path, *changes: tuple[str, str], add: str = "") -> tuple[str, ...]:
    return faults_of(read, folder, *changes, add=add)


@pytest.mark.parametrize("stated", Provenance)
def test_provenance_is_stated_and_never_read_from_a_name(folder, stated):
    named = ('name = "uk-01"\n', f'name = "a synthetic name"\nprovenance = "{stated}"\n')
    record = read(folder, named)
    assert record.provenance is stated and describe(record).provenance is stated
    assert (str(stated) in describe_text(describe(record))) == (stated is not Provenance.MEASURED)
    assert read(folder, ('"uk-01"', '"a synthetic name"')).provenance is Provenance.MEASURED


def test_another_provenance_is_refused(folder):
    (said,) = faults(folder, ('name = "uk-01"\n', 'name = "uk-01"\nprovenance = "sythetic"\n'))
    assert said == (
        'case.toml, line 2: provenance must be one of measured, simulated, synthetic, found "sythetic"; '
        'did you mean "synthetic"?'
    )
    with pytest.raises(ValueError, match="one of measured, simulated, synthetic, found 'made'"):
        Record("T1", (), provenance="made")


def test_a_case_becomes_a_record(folder):
    record = read(folder)
    expected = columns(0)
    assert record.name == "uk-01"
    assert record.rated_power_W == 2.05e6
    assert record.until_s is None
    assert record.warnings == ()
    assert [name for name, _ in record.files] == ["cabinet.csv", "ambient.csv", "scada.csv"]
    temperature = record["cabinet_temperature"]
    np.testing.assert_allclose(temperature.value, expected["T"] + 273.15)
    np.testing.assert_allclose(record["cabinet_relative_humidity"].value, expected["RH"] / 100)
    np.testing.assert_allclose(record["active_power"].value, columns(2)["P"] * 1e3)
    assert temperature.time[0] == START.timestamp()
    assert (temperature.hold, temperature.interval_s) == ("linear", 0.0)
    assert temperature.resolution == pytest.approx(0.1)
    assert record["cabinet_relative_humidity"].resolution == pytest.approx(0.001)
    assert temperature.accuracy is None
    assert temperature.source == 'cabinet.csv, column "T"'


@pytest.mark.parametrize(
    ("stamp", "hold", "shift", "found"),
    [
        ("instant", None, 0.0, ("linear", 0.0)),
        ("start", None, 600.0, ("mean", 600.0)),
        ("middle", None, 300.0, ("mean", 600.0)),
        ("end", None, 0.0, ("mean", 600.0)),
        ("start", "linear", 300.0, ("linear", 0.0)),
        ("middle", "linear", 0.0, ("linear", 0.0)),
        ("end", "linear", -300.0, ("linear", 0.0)),
        ("end", "mean", 0.0, ("mean", 600.0)),
        ("end", "foh", -300.0, ("linear", 0.0)),
        ("instant", "zoh", 0.0, ("previous", 0.0)),
        ("instant", "previous", 0.0, ("previous", 0.0)),
    ],
)
def test_stamps_and_holds(folder, stamp, hold, shift, found):
    stated = f'stamp = "{stamp}"' + (f'\nhold = "{hold}"' if hold else "")
    power = read(folder, ('stamp = "start"', stated))["active_power"]
    assert power.time[0] == START.timestamp() + shift
    assert (power.hold, power.interval_s) == found


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ('hold = "zero-order"', r"two meanings: held from its stamp on .*\"previous\".*ends at its stamp"),
        ('hold = "Linear"', r"expected the hold previous, mean or linear, found 'Linear'; did you mean"),
        ('hold = ""', r"expected the hold previous, mean or linear, found ''"),
        ('hold = "mean"', r"a mean needs the position of its stamp in the averaging interval"),
        ('stamp = "end"\nhold = "zoh"', r'hold = "previous" needs stamp = "instant"'),
        ('hold = "zoh"\nlongest_hold = "long"', r"longest_hold"),
        ('hold = "zoh"\nlongest_hold = "0s"', r"longest_hold"),
    ],
)
def test_a_hold_that_is_not_one_is_refused(folder, stated, said):
    (found,) = faults(folder, ('stamp = "start"', stated))
    assert re.search(said, found) and "case.toml, line 1" in found


def test_a_door_that_is_told_when_it_moves_is_open_in_between(tmp_path):
    """Closed at 0 h, open at 6 h, closed at 7 h."""
    told = pd.Series([0.0, 1.0, 0.0], pd.to_datetime(["2024-03-01T00Z", "2024-03-01T06Z", "2024-03-01T07Z"]))
    told.to_csv(tmp_path / "door.csv", header=["door"], index_label="t")
    hours = pd.date_range("2024-03-01T00Z", periods=49, freq="1h")
    climate = pd.DataFrame({"in": 20.0 + np.arange(49) % 3, "out": 10.0 + np.arange(49) % 5}, hours)
    climate.to_csv(tmp_path / "climate.csv", index_label="t")
    (tmp_path / "case.toml").write_text(
        'name = "box"\n[[source]]\nfile = "climate.csv"\ntime = "t"\n'
        'signals.cabinet_temperature = { column = "in", unit = "degC" }\n'
        'signals.ambient_temperature = { column = "out", unit = "degC" }\n'
        '[[source]]\nfile = "door.csv"\ntime = "t"\nsignals.door_open = { column = "door", unit = "1" }\n'
    )
    frames = {"climate": climate, "door": told.to_frame("door")}
    units = {"climate": {"in": "degC", "out": "degC"}, "door": {"door": "1"}}
    signals = {
        "climate": {"in": "cabinet_temperature", "out": "ambient_temperature"},
        "door": {"door": "door_open"},
    }
    for record in (read_case(tmp_path / "case.toml"), read_frames(frames, signals=signals, units=units)):
        door = record["door_open"]
        assert (door.hold, door.longest_hold_s) == ("previous", math.inf)
        at = record.start_s + 3600.0 * np.array([0.0, 3.0, 5.999, 6.0, 6.999, 7.0, 40.0])
        assert at_times(door, at, 6.0).tolist() == [0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]
        made = design(record, kind="thermal")
        made = extended(made, [("open_loss", {})])
        run = model_inputs(made, record).timeline
        assert run.input("door_open")[run.seconds <= record.start_s + 9 * 3600.0].tolist() == [
            *[0.0] * 7, 1.0, 0.0, 0.0,
        ]  # fmt: skip
    text = (tmp_path / "case.toml").read_text()
    span = [stamp_text(record.start_s + 3600.0 * hour) for hour in (1.0, 6.5)]
    lost = {"door": [span]}
    (tmp_path / "case.toml").write_text(f"{text}lost = {json.dumps([span])}\n")
    for record in (
        read_case(tmp_path / "case.toml"), read_frames(frames, signals=signals, units=units, lost=lost),
    ):  # fmt: skip
        unknown = np.isnan(at_times(record["door_open"], at, 6.0))
        assert unknown.tolist() == [False, True, True, False, False, False, False]
    for wrong in (span, [span[::-1]], [span, span]):
        (tmp_path / "case.toml").write_text(f"{text}lost = {json.dumps(wrong)}\n")
        with pytest.raises(CaseFault, match=r"lost.*expected pairs of stamps"):
            read_case(tmp_path / "case.toml")
    (tmp_path / "case.toml").write_text(f'{text}longest_hold = "connectd"\ndecimal = ";"\n')
    with pytest.raises(CaseFault, match=r'(?s)"connected" holds.*decimal must be one of'):
        read_case(tmp_path / "case.toml")


def test_a_signal_that_comes_on_change_and_is_joined_by_lines_is_said(folder):
    """A coarse temperature without any repetition; regular or repeating readings are not on change."""
    random = np.random.default_rng(3)
    value = 20.0 + 0.1 * np.cumsum(random.choice([-1.0, 1.0], 300))
    time = np.cumsum(random.uniform(60.0, 3600.0, 300))
    assert on_change(time, value, 0.1)
    assert not on_change(600.0 * np.arange(300.0), value, 0.1)  # regular
    assert not on_change(time, np.repeat(value, 2)[:300], 0.1)  # repeating
    assert not on_change(time[:12], value[:12], 0.1)  # few enough for chance
    assert not on_change(time, random.normal(size=300), 1e-6)  # noise on a fine grid never repeats
    made = Record("x", (Series("cabinet_temperature", time, value + 273.15, resolution=0.1),))
    assert DoubtCode.ONLY_ON_CHANGE(signal="cabinet_temperature") in all_doubts(made)
    held = Record("x", (dataclasses.replace(made.series[0], hold="zoh"),))
    assert DoubtCode.ONLY_ON_CHANGE(signal="cabinet_temperature") not in all_doubts(held)


def test_a_stated_interval_counts_instead_of_the_step(folder):
    power = read(folder, ('"start"', '"start"\ninterval = "5min"'))["active_power"]
    assert power.interval_s == 300.0
    assert power.time[0] == START.timestamp() + 300.0


def test_overlapping_intervals_are_said(folder):
    record = read(folder, ('"start"', '"start"\ninterval = "1h"'))
    assert any("overlapping intervals" in one for one in record.warnings)


def test_directions_are_held_and_not_interpolated(folder):
    ambient = 'signals.ambient_temperature = { column = "T", unit = "degC" }\n'
    turning = 'signals.wind_direction = { column = "T", unit = "deg" }\n'
    flag = 'signals.rain = { column = "T", unit = "mm" }\n'
    record = read(folder, (ambient, ambient + turning + flag))
    assert (record["wind_direction"].hold, record["wind_direction"].interval_s) == ("previous", 0.0)
    assert record["rain"].hold == "linear"


def test_stated_accuracy_resolution_and_clock(folder):
    record = read(
        folder,
        ('"T", unit = "degC"', '"T", unit = "degF", accuracy = 0.9, resolution = 0.18'),
        ('time = "time"', 'time = "time"\nclock_uncertainty = "2min"'),
    )
    one = record["cabinet_temperature"]
    assert one.accuracy == pytest.approx(0.5)
    assert one.resolution == pytest.approx(0.1)
    assert one.clock_uncertainty_s == 120.0
    assert record["ambient_temperature"].clock_uncertainty_s is None


def test_a_clock_that_is_known_to_be_off_is_corrected(folder):
    right, late = (
        read(folder),
        read(folder, ('time = "time"', 'time = "time"\nclock_correction = "-12.5min"')),
    )
    one = "cabinet_temperature"
    assert late[one].time == pytest.approx(right[one].time - 750.0, abs=1e-6)
    assert (late[one].value == right[one].value).all()
    other = "ambient_temperature"
    assert (late[other].time == right[other].time).all()
    with pytest.raises(CaseFault, match="clock_correction"):
        read(folder, ('time = "time"', 'time = "time"\nclock_correction = "12 parsecs"'))


def test_until_and_start(folder):
    record = read(
        folder, add='[identification]\nstart = "2020-06-03T00:00:00Z"\nuntil = "2020-06-10T00:00:00Z"\n'
    )
    assert record.start_s == seconds("2020-06-03T00:00+00:00") - 600.0
    assert record["cabinet_temperature"].time[0] == seconds("2020-06-03T00:00+00:00")
    assert record.identification()["cabinet_temperature"].time[-1] == record.until_s
    assert record.validation()["cabinet_temperature"].time[0] == record.until_s + 600.0


@pytest.mark.parametrize("key", ["until", "start"])
@pytest.mark.parametrize("year", [2019, 2022])
def test_periods_lie_in_the_record(folder, key, year):
    (fault,) = faults(folder, add=f'[identification]\n{key} = "{year}-01-01T00:00:00Z"\n')
    assert fault.startswith(f"case.toml, line 18, [identification]: {key} = {year}-01-01T00:00Z is outside")
    assert "2020-06-01T00:00Z to 2020-06-21T20:00Z" in fault


def test_faults_of_the_case_and_of_every_source_come_together(folder):
    change(folder, "cabinet", form="%Y-%m-%d %H:%M")
    text = (folder / "ambient.csv").read_text().replace("\n2020-06-01T00:20Z,", "\n2020-06-01T00:20Z,x")
    (folder / "ambient.csv").write_text(text)
    changes = (
        ("rated_power_kW", "rated_power_kw"),
        ('column = "RH"', 'column = "rH"'),
        ('"scada.csv"', '"scda.csv"'),
        ('unit = "kW"', 'unit = "kWh"'),
    )
    with pytest.raises(CaseFault) as caught:
        read(folder, *changes)
    found = caught.value.faults
    for number, fault in enumerate(found, 1):
        assert f"  {number}. {fault}" in str(caught.value)
    again = pickle.loads(pickle.dumps(caught.value))  # as from a worker process
    assert type(again) is CaseFault and again.faults == found and str(again) == str(caught.value)
    expected = (
        'case.toml, line 2: unknown key "rated_power_kw"',
        'case.toml, line 16, [[source]] 3 signals.active_power: unknown unit "kWh"',
        'cabinet.csv: no column "rH"',
        'cabinet.csv: column "time": 3000 of 3000 stamps have no offset',
        'ambient.csv: column "T": expected numbers, found text in 1 of 3000 rows: line 4 "x',
        "scda.csv: no such file",
    )
    for start in expected:
        assert any(one.startswith(start) for one in found), (start, found)
    assert len(found) == len(expected)


@pytest.mark.parametrize(
    ("file", "new", "changes", "words"),
    [
        ("cabinet", {"RH": columns(0)["RH"] / 100}, (), ["called %", 'unit = "1"']),
        ("cabinet", {}, (('unit = "%"', 'unit = "1"'),), ["called a fraction", 'unit = "%"']),
        ("cabinet", {"T": columns(0)["T"] + 273}, (), ["called degC", "fit as K"]),
        ("ambient", {}, (('"T", unit = "degC" }\n[', '"T", unit = "K" }\n['),), ["called K", "degC"]),
        ("ambient", {"T": columns(1)["T"] * 1.8 + 32}, (), ["degF"]),
        ("scada", {}, (('"kW"', '"MW"'),), ["called MW", "kW"]),
        ("scada", {"P": columns(2)["P"] * 20}, (), ["times the rated 2050 kW"]),
        ("cabinet", {"T": np.full(COUNT, -273.0)}, (), ["median −273", "column"]),
    ],
)
def test_readings_in_another_unit_than_stated(folder, file, new, changes, words):
    change(folder, file, **new)
    (fault,) = faults(folder, *changes)
    assert fault.startswith(f"{file}.csv: column ")
    for word in words:
        assert word in fault


def test_a_percentage_duty_called_a_fraction(folder):
    change(folder, "scada", P=np.where(np.arange(COUNT) % 50 == 0, 80.0, 0.0))
    (fault,) = faults(
        folder, ('active_power = { column = "P", unit = "kW" }', 'heater_duty = { column = "P", unit = "1" }')
    )
    assert "look like per cent" in fault


def test_humidity_with_sentinels_is_still_seen_to_be_a_fraction(folder):
    humidity = columns(0)["RH"] / 100
    humidity[::400] = -99.0
    change(folder, "cabinet", RH=humidity)
    assert "called %" in faults(folder)[0]


@pytest.mark.parametrize("factor", [1e-3, 2.0])
def test_doubtful_power_is_a_doubt(folder, factor):
    change(folder, "scada", P=columns(2)["P"] * factor)
    assert DoubtCode.POWER_BESIDE_RATED in [one.code for one in all_doubts(read(folder))]


def test_sources_that_share_no_time_show_both_spans(folder):
    change(folder, "ambient", start=START + timedelta(days=365))
    (fault,) = faults(folder)
    assert fault.startswith("no overlap: ambient_temperature in ambient.csv")
    assert "2021-06-01T00:00Z to 2021-06-21T19:50Z" in fault
    assert "2020-06-01T00:00Z to 2020-06-21T19:50Z" in fault


def test_the_ambient_temperature_and_a_cabinet_signal_are_needed(folder):
    found = faults(
        folder,
        ("cabinet_temperature", "nacelle_temperature"),
        ("cabinet_relative_humidity", "nacelle_relative_humidity"),
        ("ambient_temperature", "tower_temperature"),
    )
    assert "ambient_temperature" in found[0]
    assert "nothing in the cabinet to identify" in found[1]


def test_drivers_alone_are_read_when_asked_for(folder):
    record = read(
        folder,
        ("cabinet_temperature", "nacelle_temperature"),
        ("cabinet_relative_humidity", "nacelle_relative_humidity"),
        cabinet=False,
    )
    assert "nacelle_temperature" in record


@pytest.mark.parametrize("left_out", ["RH", "P", "both"])
def test_records_without_humidity_or_power_are_legal(folder, left_out):
    humidity = 'signals.cabinet_relative_humidity = { column = "RH", unit = "%" }\n'
    scada = CASE[CASE.index('[[source]]\nfile = "scada') :]
    changes = {"RH": [(humidity, "")], "P": [(scada, "")], "both": [(humidity, ""), (scada, "")]}
    record = read(folder, *changes[left_out])
    assert "cabinet_temperature" in record
    assert ("active_power" in record) == (left_out == "RH")


def test_columns_without_any_number_leave_nothing_to_identify(folder):
    change(folder, "cabinet", T=np.full(COUNT, np.nan), RH=np.full(COUNT, np.nan))
    (fault,) = faults(folder)
    assert "no reading of cabinet_temperature, cabinet_relative_humidity" in fault


def test_what_can_be_masked_is_masked_and_said(folder):
    new = columns(0)
    new["T"][100] = -273.0
    new["RH"][200:230] = 100.0
    new["T"][1000:1300] = new["T"][1000]
    change(folder, "cabinet", **{one: new[one] for one in ("T", "RH")})
    with (folder / "cabinet.csv").open("a") as stream:
        stream.write("2020-06-01T00:00Z,99.9,50\n")
    record = read(folder)
    text = "\n".join(record.warnings)
    for word in ("unsorted", "duplicate", "-273 degC", "frozen sensor", "saturated humidity"):
        assert word in text
    missing = record["cabinet_temperature"].missing
    assert missing[0]
    assert missing[100]
    assert missing[1001:1300].all()
    assert missing.sum() <= 2 + 299
    assert record["cabinet_relative_humidity"].missing[200:230].all()


def test_a_local_clock_is_followed_through_summer_time(folder):
    from zoneinfo import ZoneInfo

    berlin = ZoneInfo("Europe/Berlin")
    start = datetime(2020, 10, 20, tzinfo=UTC)
    for name in ("ambient", "scada"):
        change(folder, name, start=start)
    text = (folder / "cabinet.csv").read_text().splitlines()
    moments = [start + timedelta(minutes=10 * k) for k in range(COUNT)]
    rows = [
        ",".join([one.astimezone(berlin).strftime("%Y-%m-%d %H:%M"), *row.split(",")[1:]])
        for one, row in zip(moments, text[1:], strict=True)
    ]
    (folder / "cabinet.csv").write_text("\n".join([text[0], *rows]) + "\n")
    zone = ('time = "time"', 'time = "time"\ntimezone = "Europe/Berlin"')
    record = read(folder, zone)
    expected = [one.timestamp() for one in moments]
    np.testing.assert_array_equal(record["cabinet_temperature"].time, expected)
    assert any("summer-time hole" in one for one in record.warnings)
    fixed = read(folder, ('time = "time"', 'time = "time"\ntimezone = "+02:00"'))
    assert any("twice on 2020-10-25" in one for one in fixed.warnings)


def test_irregular_means_need_their_interval(folder):
    random = np.random.default_rng(1)
    moments = np.cumsum(random.integers(300, 3000, 200))
    rows = [f"{(START + timedelta(seconds=int(one))).isoformat()},100" for one in moments]
    (folder / "scada.csv").write_text("\n".join(["time,P", *rows]) + "\n")
    (fault,) = faults(folder)
    assert 'interval = "10min"' in fault
    power = read(folder, ('"start"', '"start"\ninterval = "5min"'))["active_power"]
    assert power.interval_s == 300.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('name = "x', ["line 1, at the end: not valid TOML", 'name = "x']),
        ('name = "x"\nname = "y"', ["line 2", "not valid TOML"]),
        ('[source]\nfile="a"\n[[source]]\n', ["line 3", "[[source]]"]),
    ],
)
def test_broken_toml_shows_its_line(tmp_path, text, words):
    (tmp_path / "case.toml").write_text(text)
    with pytest.raises(CaseFault) as caught:
        read_case(tmp_path / "case.toml")
    for word in words:
        assert word in caught.value.faults[0]


def test_no_case_file(tmp_path):
    (tmp_path / "uk-01.toml").write_text("")
    with pytest.raises(CaseFault, match=r"did you mean \"uk-01.toml\"\?"):
        read_case(tmp_path / "uk01.toml")
    with pytest.raises(CaseFault, match="cannot be read"):
        read_case(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'name = "\xe9"')
    with pytest.raises(CaseFault, match="UTF-8"):
        read_case(tmp_path / "latin.toml")


@measured
def test_the_attic_is_read_without_a_word(tmp_path):
    (tmp_path / "case.toml").write_text(
        f"""[[source]]
file = "{DATA / "attic_trh1_R2_hourly.csv.gz"}"
time = "t_UTC+2"
timezone = "+02:00"
signals.cabinet_temperature = {{ column = "T_roofmiddle_airmiddle", unit = "degC" }}
signals.cabinet_relative_humidity = {{ column = "RH_roofmiddle_airmiddle", unit = "%" }}
signals.ambient_temperature = {{ column = "T_fmi", unit = "degC" }}
signals.ambient_relative_humidity = {{ column = "RH_fmi", unit = "%" }}
signals.global_horizontal_irradiance = {{ column = "Rglob", unit = "W/m2" }}
signals.wind_speed = {{ column = "ws", unit = "m/s" }}
signals.rain = {{ column = "precip", unit = "mm" }}
""",
        encoding="utf-8",
    )
    record = read_case(tmp_path / "case.toml")
    assert record.warnings == ()
    assert record.start_s == seconds("2010-11-23T00:00+02:00")
    assert all(len(one) == 13921 and not one.missing.any() for one in record.series)


@measured
def test_the_french_clock_that_contradicts_its_stamps_is_noticed(tmp_path):
    (tmp_path / "case.toml").write_text(
        f"""[[source]]
file = "{DATA / "la_haute_borne_R80736_10min_2014_2015.csv.gz"}"
time = "Date_time"
stamp = "start"
signals.active_power = {{ column = "P_avg", unit = "kW" }}
signals.ambient_temperature = {{ column = "Ot_avg", unit = "degC" }}
""",
        encoding="utf-8",
    )
    record = read_case(tmp_path / "case.toml", cabinet=False)
    holes = [one for one in record.warnings if "summer-time hole" in one]
    assert len(holes) == 1
    assert "2014-10-26, 2015-10-25" in holes[0]
    assert "2014-03-30, 2015-03-29" in holes[0]
    assert record["active_power"].interval_s == 600.0
    assert not any("frozen" in one for one in record.warnings)


# -- a draft -------------------------------------------------------------------------------------------------
def test_open_doubts_of_a_draft_are_told(folder: Path) -> None:
    """A doubt stands above its line; one above a line that is commented out changes nothing."""
    file = folder / "case.toml"
    doubted = CASE.replace(
        'stamp = "start"\n',
        "# doubt: the header does not say which end of the\n#   interval the stamp is\n"
        'stamp = "start"\n# doubt: reactive power?\n# signals.reserve = { column = "Q", unit = "kW" }\n',
    )
    file.write_text(doubted)
    line = doubted.splitlines().index("# doubt: the header does not say which end of the") + 1
    warning = read_case(file).warnings[0]
    assert f"case.toml: a doubt of its draft is open, line {line}: " in warning
    file.write_text(doubted.replace("[[source]]\n", "# doubt: two loggers?\n[[source]]\n", 1))
    assert f"2 doubts of its draft are open, lines 3, {line + 1}: " in read_case(file).warnings[0]
    file.write_text(doubted.replace('stamp = "start"\n', '# as in May\nstamp = "start"\n'))
    assert f"a doubt of its draft is open, line {line}: " in read_case(file).warnings[0]
    file.write_text(CASE)
    assert not any("draft" in one for one in read_case(file).warnings)
