"""Records from pandas frames: equal to those from files, and every wrong input told with its remedy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
from builders.faults import faults_of

from hygrokf.cases.case_file import CaseFault, read_case
from hygrokf.cases.doubts import all_doubts
from hygrokf.cases.frames import read_frames
from hygrokf.data.record import Record, Site
from hygrokf.texts.record_codes import DoubtCode, touched

COUNT = 6 * 24 * 30
INDEX = pd.date_range("2020-10-05", periods=COUNT, freq="10min", tz="UTC")
HOUR = np.arange(COUNT) / 6.0
UNITS = {"T": "degC", "RH": "%", "ambient_temperature": "degC", "P": "kW"}
SIGNALS = {"T": "cabinet_temperature", "RH": "cabinet_relative_humidity", "P": "active_power"}


def cabinet() -> pd.DataFrame:
    """A logger's table on an index that knows its zone."""
    random = np.random.default_rng(1)
    day = np.sin(2.0 * np.pi * HOUR / 24.0)
    return pd.DataFrame(
        {
            "T": np.round(22.0 + 5.0 * day + random.normal(0.0, 0.4, COUNT), 1),
            "RH": np.round(50.0 - 9.0 * day + random.normal(0.0, 0.8, COUNT), 1),
            "ambient_temperature": np.round(9.0 + 6.0 * day + random.normal(0.0, 0.5, COUNT), 2),
        },
        index=INDEX,
    )


def scada(zone: str = "UTC") -> pd.DataFrame:
    """Power on a local clock that does not say its zone."""
    random = np.random.default_rng(2)
    power = np.clip(900.0 + 800.0 * random.normal(0.0, 1.0, COUNT), -8.0, 2050.0)
    return pd.DataFrame({"P": np.round(power, 1)}, index=INDEX.tz_convert(zone).tz_localize(None))


def made(frames: object = None, **changed: object) -> Record:
    """The record of both frames, with options changed; None takes one away."""
    options = {
        "signals": SIGNALS,
        "units": UNITS,
        "timezone": {"scada": "UTC"},
        "stamp": {"scada": "start"},
        "rated_power_kW": 2050.0,
        **changed,
    }
    given = {"cabinet": cabinet(), "scada": scada()} if frames is None else frames
    return read_frames(given, **{key: one for key, one in options.items() if one is not None})


def faults(frames: object = None, **changed: object) -> tuple[str, ...]:
    return faults_of(made, frames, **changed)


# -- the same as from files ----------------------------------------------------------------------------------
def messy() -> dict[str, pd.DataFrame]:
    """Four sources with what exports have: sentinels, a frozen sensor, saturation, text, doubled and unsorted
    stamps."""
    one, two = cabinet().astype(object), scada("Europe/Berlin")
    one["T"] = one["T"].astype(float)
    one.loc[one.index[100:104], "T"] = -273.0
    one.loc[one.index[1000:1080], "T"] = 23.4
    one.loc[one.index[2000:2030], "RH"] = 100.0
    one.loc[one.index[40:44], "RH"] = "sensor lost"
    one = pd.concat([one, one.iloc[200:203], one.iloc[300:301].assign(T=31.0)])
    reference = pd.DataFrame({"outside": 9.0 + 0.01 * np.round(300.0 * np.sin(HOUR / 5.0))}, INDEX)
    hourly = pd.DataFrame({"dew": np.round(4.0 + np.sin(HOUR[::6] / 9.0), 2)}, INDEX[::6])
    return {"cabinet.csv": one, "scada.csv": two, "mast.csv": reference, "dew.csv": hourly}


MESSY_CASE = """name = "uk-01"
rated_power_kW = 2050.0
[site]
latitude_deg = 52.4
longitude_deg = -0.95
[identification]
start = "2020-10-07T00:00Z"
until = "2020-10-28T00:00Z"
[[source]]
file = "cabinet.csv"
time = "time"
missing = ["sensor lost"]
clock_uncertainty = "2min"
signals.cabinet_temperature = { column = "T", unit = "degC", accuracy = 0.5, response_time = "90s" }
signals.cabinet_relative_humidity = { column = "RH", unit = "%", accuracy = 2.0, resolution = 0.5 }
signals.ambient_temperature = { column = "ambient_temperature", unit = "degC" }
[[source]]
file = "scada.csv"
time = "time"
timezone = "Europe/Berlin"
stamp = "start"
signals.active_power = { column = "P", unit = "kW" }
[[source]]
file = "mast.csv"
time = "time"
compare = true
signals.ambient_temperature = { column = "outside", unit = "degC" }
[[source]]
file = "dew.csv"
time = "time"
stamp = "end"
interval = "30min"
clock_correction = "-5min"
signals.ambient_dew_point_temperature = { column = "dew", unit = "degC" }
"""
MESSY_OPTIONS = {
    "name": "uk-01",
    "rated_power_kW": np.int64(2050),
    "site": {"latitude_deg": 52.4, "longitude_deg": -0.95},
    "identification": {"start": pd.Timestamp("2020-10-07", tz="UTC"), "until": "2020-10-28T00:00Z"},
    "signals": {**SIGNALS, "outside": "ambient_temperature", "dew": "ambient_dew_point_temperature"},
    "units": {**UNITS, "outside": "degC", "dew": "degC"},
    "accuracy": {"T": 0.5, "RH": 2.0},
    "resolution": {"RH": np.float64(0.5)},
    "response_time": {"T": "90s"},
    "missing": {"cabinet.csv": ("sensor lost",)},
    "clock_uncertainty": {"cabinet.csv": "2min"},
    "timezone": {"scada.csv": "Europe/Berlin"},
    "stamp": {"scada.csv": "start", "dew.csv": "end"},
    "compare": {"mast.csv": True},
    "interval": {"dew.csv": "30min"},
    "clock_correction": {"dew.csv": "-5min"},
}


def test_texts_and_serial_days_are_read_as_in_files() -> None:
    """Thousands marks, units and flags in texts; Excel's days as numbers; a zone in the name of the index."""
    plain = made(stamp=None, timezone={"scada": "UTC"})
    power = scada().round(0)
    texts = power.assign(
        P=[f"{one:,.0f}".replace(",", ".") for one in power["P"]],
        door=["open" if k % 50 == 0 else "closed" for k in range(COUNT)],
        heater=["ON" if k % 7 else "off" for k in range(COUNT)],
    )
    days = (texts.index - pd.Timestamp("1899-12-30")) / pd.Timedelta("1D")
    texts.index = pd.Index(days + 1.0 / 24.0, name="Zeit (MEZ)")
    logger = cabinet().assign(T=lambda frame: [f"{one} °C" for one in frame["T"]])
    told = {
        "signals": {**SIGNALS, "door": "door_open", "heater": "heater_duty"},
        "units": {**UNITS, "door": "1", "heater": "1"},
        "timezone": None, "stamp": None, "time_format": {"scada": "excel"},
    }  # fmt: skip
    frames = {"cabinet": logger, "scada": texts}
    with pytest.raises(CaseFault, match=r'may be 1\d{3} or 1\.\d+, since .*state thousands = "\."'):
        made(frames, **told)
    record = made(frames, **told, thousands={"scada": "."})
    for signal in ("cabinet_temperature", "active_power"):
        np.testing.assert_array_equal(record[signal].time, plain[signal].time)
    np.testing.assert_array_equal(record["cabinet_temperature"].value, plain["cabinet_temperature"].value)
    np.testing.assert_allclose(record["active_power"].value, 1e3 * power["P"].to_numpy())
    np.testing.assert_array_equal(record["door_open"].value, np.arange(COUNT) % 50 == 0)
    np.testing.assert_array_equal(record["heater_duty"].value, np.arange(COUNT) % 7 > 0)
    assert any('read at "+01:00"' in said for said in record.warnings)


def test_frames_give_the_record_that_files_give(tmp_path: Path) -> None:
    frames = messy()
    for name, frame in frames.items():
        frame.to_csv(tmp_path / name, index_label="time")
    (tmp_path / "case.toml").write_text(MESSY_CASE)
    filed, held = read_case(tmp_path / "case.toml"), read_frames(frames, **MESSY_OPTIONS)
    assert held.series == filed.series and held.compared == filed.compared
    assert held.warnings == filed.warnings and all_doubts(held) == all_doubts(filed)
    assert (held.name, held.site, held.rated_power_W, held.until_s) == (
        filed.name,
        filed.site,
        filed.rated_power_W,
        filed.until_s,
    )
    assert held.files == () and len(filed.files) == 4
    assert read_frames(frames, **MESSY_OPTIONS, provenance="simulated").provenance == "simulated"
    # and that they are equal is no wonder of two empty records
    said = " ".join(held.warnings)
    for word in ("masked", "frozen sensor", "saturated", "duplicate stamps", "unsorted", "repeated hour"):
        assert word in said, word
    assert held["cabinet_temperature"].resolution == pytest.approx(0.1)
    assert held["cabinet_temperature"].response_time_s == 90.0
    assert held["cabinet_relative_humidity"].resolution == pytest.approx(0.005)
    assert held.compared[0].signal == "ambient_temperature" and held["active_power"].interval_s == 600.0


def test_a_site_may_be_a_site() -> None:
    assert made(site=Site(52.4, -0.95)).site == Site(52.4, -0.95)


def test_columns_of_the_same_name_are_told_apart_by_their_frames() -> None:
    one, other = cabinet()[["T", "RH"]], cabinet()[["ambient_temperature"]].set_axis(["T"], axis=1) + 273.15
    record = made(
        {"a": one, "b": other},
        signals={"a": {"T": "cabinet_temperature", "RH": "cabinet_relative_humidity"},
            "b": {"T": "ambient_temperature"}},
        units={"a": {"T": "degC", "RH": "%"}, "b": {"T": "K"}},
        timezone=None,
        stamp=None,
    )  # fmt: skip
    whole = made()
    assert record["cabinet_temperature"].value.tolist() == whole["cabinet_temperature"].value.tolist()
    np.testing.assert_allclose(record["ambient_temperature"].value, whole["ambient_temperature"].value)
    assert [one.source for one in record.series] == ['a, column "T"', 'a, column "RH"', 'b, column "T"']


def test_one_frame_and_a_list_of_frames() -> None:
    alone = made(cabinet(), units={name: UNITS[name] for name in cabinet()},
        signals={"T": SIGNALS["T"], "RH": SIGNALS["RH"]},
                 timezone=None, stamp=None)  # fmt: skip
    assert alone["cabinet_temperature"].source == 'frame, column "T"'
    listed = made([cabinet(), scada()], timezone={"frame 2": "UTC"}, stamp={"frame 2": "start"})
    assert listed["active_power"].source == 'frame 2, column "P"'
    assert listed["active_power"].value.tolist() == made()["active_power"].value.tolist()


# -- what pandas may hold ------------------------------------------------------------------------------------
def as_strings(frame: pd.DataFrame) -> pd.DataFrame:
    return frame.set_axis(frame.index.strftime("%Y-%m-%dT%H:%M:%SZ"))


@pytest.mark.parametrize(
    ("change", "options"),
    [
        *((lambda f, unit=unit: f.set_axis(f.index.as_unit(unit)), {}) for unit in ("s", "ms", "us", "ns")),
        (lambda f: f.tz_convert("Asia/Kolkata"), {}),
        (lambda f: f.tz_localize(None), {"timezone": "UTC"}),
        (lambda f: f.tz_convert("Europe/Berlin").tz_localize(None),
            {"timezone": {"cabinet": "Europe/Berlin", "scada": "UTC"}}),
        (as_strings, {}),
        (lambda f: f.rename_axis("when").reset_index(), {"time": {"cabinet": "when"}}),
        (lambda f: as_strings(f).rename_axis("when").reset_index(), {"time": {"cabinet": "when"}}),
        (lambda f: f.astype({"T": object, "RH": "string", "ambient_temperature": "category"}), {}),
        (lambda f: f.map(lambda one: str(one).replace(".", ",")).astype(object),
            {"decimal": {"cabinet": ","}}),
        (lambda f: f.astype("Float64"), {}),
        (lambda f: f.astype("Sparse[float]"), {}),
        (lambda f: f.assign(more="text", wind="calm"), {}),
        (lambda f: f.iloc[:, ::-1], {}),
    ],
)  # fmt: skip
def test_the_same_readings_in_another_form_give_the_same_record(change: Callable, options: dict) -> None:
    expected = {one.signal: one for one in made().series}
    found = made({"cabinet": change(cabinet()), "scada": scada()}, **options)
    assert {one.signal: one for one in found.series} == expected


def test_arrow_columns_and_stamps() -> None:
    pytest.importorskip("pyarrow")
    frame = cabinet().rename_axis("when").reset_index().convert_dtypes(dtype_backend="pyarrow")
    assert made({"cabinet": frame, "scada": scada()}, time={"cabinet": "when"}).series == made().series


def test_float32_has_its_resolution_and_no_more_than_its_precision() -> None:
    found = made({"cabinet": cabinet().astype("float32"), "scada": scada()})
    for signal in ("cabinet_temperature", "cabinet_relative_humidity"):
        np.testing.assert_allclose(found[signal].value, made()[signal].value, rtol=1e-6)
        assert found[signal].resolution == made()[signal].resolution


def test_missing_readings_of_every_kind_are_missing() -> None:
    frame = cabinet()
    frame["T"] = frame["T"].astype(object)
    for row, nothing in enumerate((None, pd.NA, np.nan, pd.NaT, "", "n/a", np.inf)):
        frame.iloc[10 + row, 0] = nothing
    frame["RH"] = frame["RH"].round().astype("Int64")
    frame.iloc[20, 1] = pd.NA
    found = made({"cabinet": frame, "scada": scada()})
    assert np.flatnonzero(found["cabinet_temperature"].missing).tolist() == list(range(10, 17))
    assert np.flatnonzero(found["cabinet_relative_humidity"].missing).tolist() == [20]
    assert found["cabinet_relative_humidity"].resolution == pytest.approx(0.01)


def test_rows_without_a_stamp_doubled_and_unsorted_ones_are_repaired_and_said() -> None:
    frame = cabinet()
    frame.index = frame.index.where(np.arange(COUNT) != 7)
    found = made({"cabinet": frame, "scada": scada()})
    assert any("1 row without a stamp left out: iloc 7" in one for one in found.warnings)
    assert len(found["cabinet_temperature"]) == COUNT - 1
    turned = made({"cabinet": cabinet().iloc[::-1], "scada": scada()})
    assert turned.series == made().series and any("newest first" in one for one in turned.warnings)
    twice = made({"cabinet": pd.concat([cabinet(), cabinet().iloc[5:8] + 0.5]), "scada": scada()})
    assert np.flatnonzero(twice["cabinet_temperature"].missing).tolist() == [5, 6, 7]
    assert any("contradicting ones masked" in one for one in twice.warnings)


def test_periods_are_means_over_themselves() -> None:
    frame = scada()
    frame.index = frame.index.to_period("10min")
    found = made({"cabinet": cabinet(), "scada": frame}, stamp=None)
    stated = made(interval={"scada": "10min"})
    assert found["active_power"] == stated["active_power"]
    assert (found["active_power"].hold, found["active_power"].interval_s) == ("mean", 600.0)
    assert found["active_power"].time[0] == INDEX[0].timestamp() + 600.0
    # with a zone that has summer time, and hours of which some are missing: the length is the period's, not
    # the step's
    hours = scada("Europe/Berlin").resample("h").mean().to_period("h").iloc[::3]
    local = made({"cabinet": cabinet(), "scada": hours}, stamp=None, timezone={"scada": "Europe/Berlin"})
    assert local["active_power"].interval_s == 3600.0
    first = pd.Timestamp("2020-10-05T02:00", tz=ZoneInfo("Europe/Berlin")).timestamp()
    assert local["active_power"].time[0] == first + 3600.0


def test_a_frame_is_left_as_it_was() -> None:
    frames = {"cabinet": cabinet(), "scada": scada()}
    made(frames)
    pd.testing.assert_frame_equal(frames["cabinet"], cabinet())
    pd.testing.assert_frame_equal(frames["scada"], scada())


# -- what is wrong -------------------------------------------------------------------------------------------
def at(frame: str, change: Callable[[pd.DataFrame], object]) -> dict[str, object]:
    """Both frames, one of them changed."""
    frames = {"cabinet": cabinet(), "scada": scada()}
    return frames | {frame: change(frames[frame])}


WRONG = [
    (None, {"timezone": None}, "scada: the index: 4320 of 4320 stamps have no offset", 'timezone = "UTC"'),
    (None, {"timezone": {"scada": "Europe/Berln"}}, "scada: unknown timezone",
        'did you mean "Europe/Berlin"'),
    (None, {"timezone": {"scda": "UTC"}}, 'timezone: no frame is called "scda"', 'did you mean "scada"?'),
    (None, {"units": {**UNITS, "T": "K"}}, "cabinet_temperature is called K, but its readings (median 22",
        "degC"),
    (None, {"units": {**UNITS, "RH": "1"}}, "they look like per cent", 'state unit = "%"'),
    (at("cabinet", lambda f: f.assign(RH=0.01 * f["RH"])), {}, "they look like fractions", 'unit = "1"'),
    (None, {"units": {**UNITS, "P": "MW"}}, "active_power is called MW, but its readings (median 9",
        "W or kW"),
    (None, {"units": {**UNITS, "T": "celsius"}}, 'cabinet, column "T": unknown unit "celsius"',
        'did you mean "degC"?'),
    (None, {"units": {k: u for k, u in UNITS.items() if k != "P"}},
        'scada, column "P": needs unit, one of', "W, kW, MW"),
    (None, {"units": {**UNITS, "TT": "K"}}, 'units: no column "TT" (the frames have "T", "RH"',
        'did you mean "T"'),
    (None, {"units": "degC"}, "units: expected a mapping from columns", "'degC'"),
    (None, {"units": {"T": "degC", "scada": {"P": "kW"}}}, "units: expected columns or frames as keys",
        "both"),
    (None, {"signals": {**SIGNALS, "T": "cabinet_temp"}}, 'unknown signal "cabinet_temp"',
        '"cabinet_temperature"'),
    (None, {"signals": {**SIGNALS, "RH": "cabinet_temperature"}},
        'columns "T" and "RH" are both cabinet_temperature', "one series"),
    (None, {"signals": {**SIGNALS, "P": "ambient_temperature"}, "units": {**UNITS, "P": "degC"}},
     'scada, column "P": ambient_temperature is named a second time', "compare = true"),
    (at("cabinet", lambda f: f.rename(columns={"ambient_temperature": "ambient_temprature"})),
     {"units": {**UNITS, "ambient_temprature": "degC"}}, 'column "ambient_temprature" is no signal',
     'did you mean "ambient_temperature"?'),
    (at("scada", lambda f: f.reset_index(drop=True)), {}, "scada: the index holds numbers (0, 1, 2 …)",
        'time="…"'),
    (at("scada", lambda f: f.set_axis(f.index.astype("int64"))), {}, "the index holds numbers",
        'pandas.to_datetime(…, unit="s", utc=True)'),
    (at("scada", lambda f: f.set_axis(f.index - f.index[0])), {}, "the index holds durations",
        "expected times"),
    (at("scada", lambda f: f.set_axis(f.index.strftime("%d.%m.%Y %H:%M"))), {}, "expected ISO 8601 stamps",
        'time_format = "%d.%m.%Y %H:%M"'),
    (at("scada",
        lambda f: f.set_axis(f.index.where(f.index < f.index[9], pd.Timestamp("9999-12-31").as_unit("us")))),
        {},
     "found 4311 before 1850 or after 2200", "correct or remove these rows"),
    (at("scada", lambda f: f.set_index("P", append=True, drop=False)), {}, "the index has 2 levels",
        ".reset_index(level=…)"),
    (at("scada", lambda f: pd.concat({"a": f}, axis=1)), {}, "expected one level of column names, found 2",
        "one name"),
    (at("scada", lambda f: pd.concat([f, f], axis=1)), {}, 'scada: column "P" occurs 2 times', ""),
    (at("scada", lambda f: f.iloc[:0]), {}, "scada: expected readings, found no row in the frame", ""),
    (at("scada", lambda f: f["P"]), {}, "found pandas.Series", '.to_frame("cabinet_temperature")'),
    (at("scada", lambda f: {"P": 3}), {}, "scada: expected a pandas DataFrame, found builtins.dict", ""),
    ({}, {}, "expected a DataFrame, or several by name, found none", ""),
    (at("scada", lambda f: f.set_axis(f.index.to_period("10min"))), {}, "the index holds periods",
        "remove stamp"),
    (at("scada", lambda f: f.set_axis(pd.period_range("1700-01", periods=COUNT, freq="M"))), {"stamp": None},
        "periods of several lengths", "one length"),
    (at("cabinet", lambda f: f.assign(T=[str(one).replace(".", ",") for one in f["T"]])), {},
     'column "T": expected numbers, found text in 4320 of 4320 rows: iloc 0 "', 'state decimal = ","'),
    (at("cabinet", lambda f: f.assign(T=f["T"].astype(object).where(f.index != f.index[3], "lost"))), {},
        'iloc 3 "lost"', "correct them or, if this means"),
    (at("cabinet", lambda f: f.assign(T=f["T"].astype(object).where(f["T"] < 25.0, "lost"))), {}, '"lost"',
        'state missing = ["lost"]'),
    (at("cabinet", lambda f: f.assign(T=pd.to_timedelta(f["T"], unit="s"))), {},
        "expected numbers, found durations", "another column"),
    (at("cabinet", lambda f: f.assign(T=f.index)), {}, "expected numbers, found dates", "another column"),
    (at("cabinet", lambda f: f.assign(T=f["T"] + 1j)), {}, "expected numbers, found text", "(2"),
    (at("cabinet", lambda f: f.assign(T=[[one] for one in f["T"]])), {}, "expected numbers, found text",
        "[2"),
    (at("scada", lambda f: f.shift(freq="400D")), {}, "no overlap: active_power in scada (2021-11-09",
        "share no time"),
    (None, {"time": {"scada": "tim"}}, 'scada: no column "tim" (the frame has "P")', ""),
    (None, {"stmp": "start"}, 'unknown option "stmp"', 'did you mean "stamp"?'),
    (None, {"until": "2020-10-20T00:00Z"}, 'unknown option "until"', 'identification={"until": …}'),
    (None, {"separator": ";"}, 'unknown option "separator"', "for files"),
    (None, {"stamp": {"scada": "begin"}}, "scada: stamp must be one of instant, start, middle, end",
        '"begin"'),
    (None, {"interval": "10"}, 'expected a duration such as "30s"', "'10'"),
    (None, {"response_time": {"RH": 600}}, 'cabinet, column "RH": response_time: expected a duration such as',
        "600"),
    (None, {"accuracy": {"RH": -1.0}}, 'cabinet, column "RH": accuracy: expected a number ≥ 0', "-1.0"),
    (None, {"identification": {"until": "2020-10-20"}}, 'until: stamp "2020-10-20" has no offset', "add Z"),
    (None, {"identification": {"until": "2021-10-20T00:00Z"}},
        "until = 2021-10-20T00:00Z is outside of the record", "2020-10-05"),
    (None, {"identification": {"untill": "2020-10-20T00:00Z"}},
        'read_frames, identification={…}: unknown key "untill"', '"until"'),
    (None, {"site": {"latitude_deg": 152.4}}, "read_frames, site={…}: needs longitude_deg", ""),
    (None, {"site": {"latitude_deg": 152.4, "longitude_deg": 0.0}}, "latitude_deg must lie within -90 … 90",
        "152.4"),
    (None, {"rated_power_kW": 2.05},
        "active_power is called kW and reaches 2050 kW, 1e+03 times the rated 2.05 kW",
        "correct its unit or rated"),
    (None, {"rated_power_kW": 0.0}, "rated_power_kW must be a number above 0", "0.0"),
    ({"scada": scada()}, {"units": {"P": "kW"}, "signals": {"P": "active_power"}},
     "no source names ambient_temperature, the input that every model needs", ""),
    ({"scada": scada().set_axis(["power"], axis=1)}, {"units": None, "signals": None},
        'none of its columns is named after a signal (it has "power")', "signals={"),
]  # fmt: skip


@pytest.mark.parametrize(("frames", "options", "found", "remedy"), WRONG)
def test_what_is_wrong_is_told_with_its_remedy(
    frames: object, options: dict, found: str, remedy: str
) -> None:
    said = faults(frames, **options)
    hits = [one for one in said if found in one]
    assert hits, said
    assert remedy in hits[0], hits[0]


def test_all_faults_come_at_once_under_the_name_of_the_function() -> None:
    with pytest.raises(CaseFault, match=r"^read_frames: 1 fault\n"):
        made(rated_power_kW=-1.0)
    said = faults(
        at("cabinet", lambda f: f.assign(RH="lost")),
        units={"T": "C", "RH": "%", "ambient_temperature": "degC"},
        timezone=None,
        stamp={"scada": "begin"},
        site={"latitude_deg": 99.0, "longitude_deg": 0.0},
        rated_power_kW=-1.0,
        clock="UTC",
    )
    for words in (
        'unit "C"',
        'column "P": needs unit',
        "begin",
        "latitude_deg",
        "rated_power_kW",
        '"clock"',
        "found text",
    ):
        assert any(words in one for one in said), (words, said)


def test_a_power_alone_is_a_record_when_asked_for() -> None:
    alone = {"units": {"P": "kW"}, "signals": {"P": "active_power"}, "timezone": "UTC", "stamp": "start"}
    power = read_frames({"scada": scada()}, **alone, cabinet=False, ambient=False)
    assert power.signals == ("active_power",) and power["active_power"] == made()["active_power"]
    with pytest.raises(CaseFault, match="nothing in the cabinet to identify"):
        read_frames({"scada": scada()}, **alone, ambient=False)


def test_a_dew_point_of_the_logger_is_not_the_air_outside():
    """The logger's own dew point given as the ambient's: the columns are named."""
    frame = cabinet()
    gamma = np.log(frame["RH"] / 100.0) + 17.27 * frame["T"] / (237.7 + frame["T"])
    frame["DP"] = (237.7 * gamma / (17.27 - gamma)).round(2)
    frames, units = {"cabinet": frame, "scada": scada()}, UNITS | {"DP": "degC"}
    with pytest.raises(CaseFault, match="computed from the cabinet's own readings") as raised:
        made(frames, signals=SIGNALS | {"DP": "ambient_dew_point_temperature"}, units=units)
    assert all(f'column "{one}"' in str(raised.value) for one in ("T", "RH", "DP"))
    inside = made(frames, signals=SIGNALS | {"DP": "cabinet_dew_point_temperature"}, units=units)
    assert "cabinet_dew_point_temperature" in inside


def test_a_humidity_beside_another_probe_s_temperature_is_doubted():
    """The logger's own temperature stays unused, and that of the controller stands in for it."""
    logger = cabinet()
    controller = logger.assign(Tc=logger["T"] + 2.0)[["Tc"]]
    signals = {"RH": "cabinet_relative_humidity", "Tc": "cabinet_temperature", "P": "active_power"}
    units = {"RH": "%", "Tc": "degC", "ambient_temperature": "degC", "P": "kW"}
    frames = {"cabinet": logger, "controller": controller, "scada": scada()}
    record = made(frames, signals=signals, units=units)
    (doubt,) = [one for one in all_doubts(record) if one.code is DoubtCode.OTHER_PROBE]
    columns = [doubt.values[name] for name in ("temperature_column", "humidity_column", "own")]
    assert columns == ["Tc", "RH", "T"] and touched(doubt) == ("hygric",)
    assert not [one for one in all_doubts(made()) if one.code is DoubtCode.OTHER_PROBE]
