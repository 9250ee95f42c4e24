"""The look at a record: masks, description, doubts, table."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from hygrokf.cases.doubts import all_doubts
from hygrokf.cases.summary import RecordSummary, describe
from hygrokf.data.readings import mask
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.structured import plain, structured
from hygrokf.report.record_text import describe_text
from hygrokf.texts.record_codes import DoubtCode, touched
from hygrokf.texts.statement import Statement

DAY = 86400.0
START = 1577836800.0  # 2020-01-01T00:00Z


def series(signal: str, value, step: float = 600.0, start: float = START, **more) -> Series:
    value = np.asarray(value, dtype=float)
    return Series(signal, start + step * np.arange(1, len(value) + 1), value, **more)


def good(days: float = 60.0) -> Record:
    """A record that nobody doubts."""
    count = int(days * 144)
    random = np.random.default_rng(1)
    outside = 283.15 + 5.0 * np.sin(np.arange(count) / 23.0) + random.normal(0, 0.2, count)
    power = np.clip(random.normal(8e5, 8e5, count), -8e3, 2.05e6)
    return Record(
        "x",
        (
            series("cabinet_temperature", outside + 8.0),
            series("cabinet_relative_humidity", 0.45 + 0.01 * random.normal(0, 1, count)),
            series("ambient_temperature", outside),
            series("ambient_relative_humidity", 0.75 + 0.01 * random.normal(0, 1, count)),
            series("active_power", power, hold="mean", interval_s=600.0),
        ),
        Site(52.4, -0.95),
        2.05e6,
        START + 45.0 * DAY,
    )


def without(record: Record, *signals: str, **more) -> Record:
    kept = tuple(one for one in record.series if one.signal not in signals)
    return Record(
        record.name, kept, record.site, **{"rated_power_W": 2.05e6, "until_s": record.until_s} | more
    )


def changed(record: Record, signal: str, value) -> Record:
    one = record[signal]
    return record.replace_series(Series(signal, one.time, np.asarray(value, float), one.hold, one.interval_s))


def from_zero(record: Record) -> Record:
    """The record with times that count from its start."""
    moved = tuple(replace(one, time=one.time - START) for one in record.series)
    return replace(record, series=moved, until_s=45.0 * DAY)


def test_mask_treats_every_series_and_says_so():
    record = good()
    warm = record["cabinet_temperature"].value.copy()
    warm[10] = 0.15
    warm[1000:1400] = warm[1000]
    humid = record["cabinet_relative_humidity"].value.copy()
    humid[50:60] = 1.0
    dirty = changed(changed(record, "cabinet_temperature", warm), "cabinet_relative_humidity", humid)
    clean = mask(dirty)
    assert clean["cabinet_temperature"].missing.sum() == 1 + 399
    assert clean["cabinet_relative_humidity"].missing.sum() == 10
    assert len(clean.warnings) == 3
    assert clean["ambient_temperature"] == dirty["ambient_temperature"]
    assert mask(clean) == clean
    assert dirty.warnings == ()


def test_a_good_record_raises_neither_warning_nor_doubt():
    assert mask(good()) == good()
    assert all_doubts(good()) == ()


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (good(10.0), ["short record: 10.0 days"]),
        (without(good(), until_s=None), ["no validation period"]),
        (without(good(), until_s=START + 57 * DAY), ["short validation period: 3.0 days"]),
        (without(good(), until_s=START + 2 * DAY), ["short identification period"]),
        (without(good(), "active_power"), ["no active power: the whole record counts"]),
        (without(good(), rated_power_W=None), ["no rated power"]),
        (without(good(), "cabinet_relative_humidity"), ["no cabinet humidity"]),
        (without(good(), "ambient_relative_humidity"), ["no ambient humidity"]),
        (without(good(), "cabinet_temperature"), ["no cabinet temperature"]),
        (without(good(), "cabinet_temperature", "cabinet_relative_humidity"), ["no cabinet signal"]),
        (changed(good(), "active_power", np.full(8640, 1e6)), ["no standstill: 0.0 %"]),
        (changed(good(), "active_power", np.full(8640, -5e3)), ["sign reversed"]),
        (changed(good(), "active_power", np.full(8640, np.nan)), ["power has no reading"]),
        (
            changed(good(), "active_power", good()["active_power"].value / 1e3),
            ["times the rated 2050 kW: are its unit"],
        ),
        (
            changed(good(), "cabinet_temperature", good()["ambient_temperature"].value - 5.0),
            ["5.0 K colder than outside", "swapped"],
        ),
        (
            changed(good(), "cabinet_temperature", good()["ambient_temperature"].value),
            ["cabinet_temperature and ambient_temperature are the same readings"],
        ),
        (
            changed(good(), "ambient_relative_humidity", good()["cabinet_relative_humidity"].value),
            ["cabinet_relative_humidity and ambient_relative_humidity are the same readings"],
        ),
        (
            changed(good(), "cabinet_relative_humidity", np.full(8640, 0.95)),
            ["absolute humidity in the cabinet is"],
        ),
        (
            changed(
                good(),
                "ambient_temperature",
                np.where(np.arange(8640) % 2, np.nan, good()["ambient_temperature"].value),
            ),
            ["ambient_temperature: 50 % of its readings are missing"],
        ),
        (
            changed(good(), "active_power", good()["active_power"].value * 11.0),
            ["active power reaches 2.255e+04 kW, 11 times the rated"],
        ),
        (
            without(good(), until_s=2.0 * START),
            ["until = ", "is outside of the record (2020-01-01T00:00Z to"],
        ),
        (
            changed(good(), "cabinet_temperature", np.full(8640, 20.0)),
            ["cabinet_temperature is called K, but its readings (median 20)", "they would fit as degC"],
        ),
        (
            changed(good(), "cabinet_temperature", np.where(np.arange(8640) % 90, 293.15, 20.0)),
            [
                "cabinet_temperature: 96 readings outside of -60 degC … 120 degC, such as -253.1 degC",
                "read_frames",
            ],
        ),
        (
            from_zero(good()),
            ["begin on 1970-01-01T00:00Z: are the times seconds since 1970-01-01T00:00Z, or since"],
        ),
        (
            good().replace_series(series("active_power", np.full(8640, 1e6), start=START + 400 * DAY)),
            ["no overlap: active_power (2021-02-04T00:10Z to 2021-04-05T00:00Z) and the cabinet's readings"],
        ),
    ],
)
def test_doubts(record, words):
    said = [one.text for one in all_doubts(record)]
    for word in words:
        assert any(word in one for one in said), said


@pytest.mark.parametrize(
    ("record", "parts"),
    [
        (good(), ()),
        (without(good(), "active_power"), ()),  # a cabinet without power has time constants too
        (changed(good(), "active_power", np.full(8640, -5e3)), ("thermal",)),
        (changed(good(), "cabinet_temperature", good()["ambient_temperature"].value), ("thermal", "hygric")),
        (changed(good(), "cabinet_relative_humidity", np.full(8640, 0.95)), ("hygric",)),
        (changed(good(), "cabinet_temperature", np.full(8640, 20.0)), ("thermal", "hygric")),
    ],
)
def test_doubts_name_the_time_constants_that_they_put_in_question(record, parts):
    doubts = all_doubts(record)
    assert {part for one in doubts for part in touched(one)} == set(parts)
    again = structured(tuple[Statement, ...], json.loads(json.dumps(plain(doubts))))
    assert again == doubts


def test_the_factor_of_absolute_humidity_is_that_of_its_definition():
    # At one temperature the ratio of absolute humidities is that of the relative ones.
    count = 8640
    record = without(good(), "cabinet_temperature", "ambient_temperature")
    even = np.full(count, 288.15)
    record = Record(
        "x",
        (*record.series, series("cabinet_temperature", even), series("ambient_temperature", even)),
        None,
        2.05e6,
        record.until_s,
    )
    record = changed(record, "cabinet_relative_humidity", np.full(count, 0.80))
    record = changed(record, "ambient_relative_humidity", np.full(count, 0.50))
    (doubt,) = (one for one in all_doubts(record) if one.code is DoubtCode.OTHER_VAPOUR)
    assert doubt.values["factor"] == pytest.approx(1.6, abs=0.005)


def test_hourly_ambient_and_irregular_steps_are_doubted():
    record = good()
    hourly = series("ambient_temperature", record["ambient_temperature"].value[::6], 3600.0)
    random = np.random.default_rng(2)
    time = START + np.cumsum(random.uniform(100.0, 1100.0, 5000))
    uneven = Series("wind_speed", time, random.uniform(2, 9, 5000), source='a.csv, column "v"')
    other = without(record, "ambient_temperature")
    said = all_doubts(Record("x", (*other.series, hourly, uneven), None, 2.05e6, record.until_s))
    assert DoubtCode.AMBIENT_TOO_COARSE(step_s=3600.0) in said
    assert any(one.code is DoubtCode.IRREGULAR_STEPS and one.values["file"] == "a.csv" for one in said)


def sun(longitude_deg: float, shift_s: float, days: int = 60) -> Series:
    """Clear-sky radiation as the hour angle gives it, on a clock that is `shift_s` fast."""
    time = START + 100 * DAY + 600.0 * np.arange(days * 144)
    # Almanac values of the equation of time from 10 April to 9 June [min].
    equation = 60.0 * np.interp(
        (time - START) / DAY, [100, 110, 120, 130, 140, 150, 160], [-1.2, 1.0, 2.8, 3.7, 3.5, 2.4, 0.7]
    )
    hour_angle = 2 * math.pi * ((time + 240.0 * longitude_deg + equation) / DAY - 0.5)
    return Series("global_horizontal_irradiance", time + shift_s, np.clip(800 * np.cos(hour_angle), 0, None))


@pytest.mark.parametrize("longitude", [-0.95, 25.0, -120.0, 150.0])
@pytest.mark.parametrize(("shift_min", "direction"), [(0, None), (60, "after"), (-60, "before")])
def test_the_sun_tells_the_clock(longitude, shift_min, direction):
    record = Record("x", (sun(longitude, 60.0 * shift_min),), Site(50.0, longitude))
    codes = {"after": DoubtCode.RADIATION_LATE, "before": DoubtCode.RADIATION_EARLY}
    said = [one for one in all_doubts(record) if one.code in codes.values()]
    if direction is None:
        assert said == []
    else:
        (doubt,) = said
        assert doubt.code is codes[direction]
        assert doubt.values["minutes"] == pytest.approx(60.0, abs=3.0)


def test_description_counts_what_is_there():
    record = good()
    value = record["cabinet_temperature"].value.copy()
    value[100:150] = np.nan
    value[300] = np.nan
    record = changed(record, "cabinet_temperature", value)
    described = describe(record)
    assert described.days == 60.0
    assert described.start == "2020-01-01T00:00Z"
    assert described.identification.days == 45.0
    assert described.validation.end == "2020-03-01T00:00Z"
    one = described.signals[0]
    assert one.signal == "cabinet_temperature"
    assert one.readings == 8640 - 51
    assert one.missing_share == pytest.approx(51 / 8640, rel=1e-4)
    assert one.gaps == 1
    assert one.longest_gap_s == 51 * 600.0
    assert one.step_s == 600.0
    assert one.unit == "degC"
    assert one.mean == pytest.approx(np.nanmean(value) - 273.15, rel=1e-4)
    assert one.accuracy == 0.3
    assert described.signals[4].hold == "mean"
    assert described.signals[4].interval_s == 600.0


def test_rows_that_are_absent_count_as_missing():
    record = good()
    one = record["cabinet_temperature"]
    kept = np.ones(len(one), dtype=bool)
    kept[1000:1864] = False
    short = Series(one.signal, one.time[kept], one.value[kept])
    described = describe(record.replace_series(short)).signals[0]
    assert described.missing_share == pytest.approx(0.1)
    assert described.gaps == 1


@pytest.mark.parametrize(
    "record",
    [
        good(),
        Record("empty", ()),
        Record("one", (series("rain", [0.0]),)),
        Record("none", (series("cabinet_temperature", [np.nan, np.nan]),)),
    ],
    ids=lambda record: record.name,
)
def test_every_record_can_be_described(record):
    described = describe(record)
    data = json.loads(json.dumps(plain(described), allow_nan=False))
    assert plain(structured(RecordSummary, data)) == data
    text = describe_text(described)
    assert record.name in text
    for one in record.series:
        assert one.signal in text


def test_the_table_is_aligned_and_complete():
    text = describe_text(describe(good()))
    lines = text.splitlines()
    start = next(n for n, line in enumerate(lines) if line.startswith("signal") and "step" in line)
    column = lines[start].index("hold")
    for line in lines[start + 1 : start + 6]:
        assert line[column:].startswith(("linear", "mean 10 min"))
    assert "warnings: none" in text
    assert "doubts: none" in text


def test_readings_lost_in_gaps_of_the_ambient_are_counted():
    """Outside, nothing from 21:00 to 9:00: half of the cabinet's readings have no known input."""
    record = good()
    day = [one.time % DAY for one in record.series[2:4]]
    series = [
        replace(one, value=np.where((at > 9 * 3600.0) & (at < 21 * 3600.0), one.value, np.nan))
        for one, at in zip(record.series[2:4], day, strict=True)
    ]
    said = [
        one.values for one in all_doubts(record.replace_series(*series)) if one.code is DoubtCode.GAPS_OUTSIDE
    ]
    assert len(said) == 2
    assert not [one for one in all_doubts(record) if one.code is DoubtCode.GAPS_OUTSIDE]
    assert all(0.48 < one["lost"] / len(record["cabinet_temperature"]) < 0.52 for one in said)
    assert all(one["unknown"] == ("temperature", "humidity") for one in said)
