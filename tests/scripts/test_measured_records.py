"""Measured records: each is read as its case says, and its variants hide what they say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from validation import records
from validation.frame import Absent

from hygrokf.data.record import Record, Series
from hygrokf.data.signals import SIGNALS
from hygrokf.data.timestamps import DAY_S
from hygrokf.modelling.library import CAUSES

DAYS_AND_READINGS = {
    "attic R2": (580.0, 13_921),
    "attic R4": (551.0, 13_225),
    "attic R7": (588.0, 14_113),
    "house": (137.0, 19_735),
    "controller": (137.4, 17_151),
    "logger box": (51.5, 7_157),
    "Reference": (43.0, 12_359),
    "Koala": (43.0, 12_359),
    "CVA": (46.0, 13_216),
    "Celle": (59.0, 6_730),
    "dryer": (19.5, 1_836),
}


def there(name: str) -> None:
    try:
        records.expect(*records.SOURCES[name].files)
    except Absent as reason:
        pytest.skip(str(reason))


@pytest.mark.parametrize("name", records.SOURCES)
def test_a_record_has_the_readings_of_its_file(name: str) -> None:
    there(name)
    record = records.measured(name)
    time, value = record["cabinet_temperature"].known
    assert ((time[-1] - time[0]) / DAY_S, len(time)) == (
        pytest.approx(DAYS_AND_READINGS[name][0], abs=0.06),
        DAYS_AND_READINGS[name][1],
    )
    assert value.min() > 250.0 and value.max() < 338.0
    # a gap may lie at the end of the identification
    assert record.until_s - time[0] == pytest.approx(records.IDENTIFIED * (time[-1] - time[0]), abs=3600.0)


@pytest.mark.parametrize(
    "known", {one.variant: one for one in records.CASES}.values(), ids=lambda k: k.variant
)
def test_a_variant_leaves_out_what_it_withholds_and_nothing_else(known: records.Known) -> None:
    there(known.record)
    whole, variant = records.measured(known.record), records.measured(known.record, known.variant)
    assert set(whole.signals) - set(variant.signals) == set(records.VARIANTS[known.variant])
    # a clear sky can be computed in the place of the sun that is withheld
    assert variant.site is not None or known.variant != "sun withheld"


def test_a_record_is_the_same_each_time_and_names_no_folder() -> None:
    there("Koala")
    first, second = records.measured("Koala"), records.measured("Koala")
    assert first.series == second.series
    assert {one.file for one in first.series} == {
        "greenhouse_agc2022_Koala_5min.csv",
        "greenhouse_agc2022_weather_5min.csv.gz",
    }


def test_the_cases_are_those_of_the_rows_of_figures() -> None:
    assert len({(one.record, one.variant) for one in records.CASES}) == len(records.CASES)
    rows = [one.row for one in records.CASES]
    assert (rows.count(records.KNOWN), rows.count(records.WITHHELD)) == (9, 8)
    names = {cause.name for cause in CAUSES}
    assert all({*one.right, *one.wrong} <= names and not {*one.right} & {*one.wrong} for one in records.CASES)
    assert all(signal in SIGNALS for withheld in records.VARIANTS.values() for signal in withheld)
    assert set(records.RECORDS) < set(records.SOURCES) == set(DAYS_AND_READINGS)


def test_a_file_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(records, "DATA", tmp_path)
    (tmp_path / "greenhouse_agc2022_Koala_5min.csv.gz").touch()
    for name, file in (
        ("Koala", "greenhouse_agc2022_weather_5min.csv.gz"),
        ("dryer", "solar_dryer_1min_2023.csv.gz"),
    ):
        with pytest.raises(Absent, match=f"../shared/data/{file} is not there"):
            records.measured(name)


def hours(days: float, outside_days: float) -> Record:
    """Hours inside for some days, and outside for more."""
    spans = {"cabinet_temperature": days, "ambient_temperature": outside_days}
    series = []
    for name, span in spans.items():
        time = 1.3e9 + 3600.0 * np.arange(int(24 * span) + 1)
        series.append(Series(name, time, 285.0 + np.sin(time / 1e5)))
    return Record("made", tuple(series))


def test_a_cut_record_ends_before_the_last_fifth_inside() -> None:
    whole = hours(100.0, 130.0)
    cut, kept = records.before_the_last_fifth(whole)
    assert cut.end_s == whole.start_s + 80.0 * DAY_S
    assert cut.until_s == kept.until_s == whole.start_s + 80.0 * DAY_S * records.IDENTIFIED
    assert kept.series == whole.series
    assert cut["cabinet_temperature"].value[-1] == whole["cabinet_temperature"].value[80 * 24]


def test_duties_of_a_compartment_are_shares() -> None:
    rows = pd.DataFrame(
        {
            "vent_lee_pct": [0.0, 100.0, 30.0],
            "vent_wind_pct": [0.0, 100.0, 10.0],
            "heating_pipe_degC": [0.0, 50.0, 90.0],
        }
    )
    made = records._compartment(rows)
    assert made["vents"].tolist() == [0.0, 1.0, 0.2] and made["pipe"].tolist() == [0.0, 0.5, 1.0]


def test_rows_of_sensors_that_were_not_read_are_left_out() -> None:
    rows = pd.DataFrame(
        {
            "time": ["a", "b", "c"],
            "T_in": [21.0, 0.0, 23.0],
            "T_out": [3.0, -2.147e8, 0.0],
            "vent": [0.1, 0.0, 0.0],
        }
    )
    made = records._cell(rows)
    assert made.time.tolist() == ["a", "b", "c"]
    assert made.vent.isna().tolist() == made.T_out.isna().tolist() == [False, True, True]


def test_means_end_at_their_stamps_and_are_of_whole_intervals() -> None:
    stamps = pd.date_range("2023-03-11 07:00", periods=12, freq="min").delete(8)
    rows = pd.DataFrame({"time": stamps.astype(str), "T_in": np.arange(11.0)})
    made = records._means(rows)
    assert made.time.astype(str).tolist() == ["2023-03-11 07:05:00"]
    assert made.T_in.tolist() == [3.0]


def test_the_cell_in_celle_keeps_summer_time() -> None:
    there("Celle")
    record = records.measured("Celle")
    assert np.diff(record["cabinet_temperature"].time).max() == 600.0
    sun, noon = record["global_horizontal_irradiance"], 0.5 * DAY_S
    local = sun.time + record.site.longitude_deg / 360.0 * DAY_S
    high = np.isfinite(sun.value) & (sun.value > 5.0)
    middles = []
    for day in (28, 30, 31):
        start = pd.Timestamp(f"2014-03-{day}").timestamp()
        seen = (local % DAY_S)[high & (local >= start) & (local < start + DAY_S)]
        middles.append(0.5 * (seen.min() + seen.max()) - noon)
    # the equation of time at the end of March is -5 min
    assert np.allclose(middles, 300.0, atol=1500.0)
