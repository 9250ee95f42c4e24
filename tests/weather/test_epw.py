"""EPW files: hours, zones, codes for what is missing, typical years."""

from __future__ import annotations

import gzip
from pathlib import Path

import builders.weather_case as made
import numpy as np
import pytest
from builders.faults import faults_of
from builders.measured import DATA, measured

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Site
from hygrokf.weather.reading import read_weather, weather_format
from hygrokf.weather.typical_years import read_epw

TYPICAL = (2006, 2011, 2018, 2006, 2009, 2015, 2007, 2012, 2016, 2010, 2013, 2008)


def written(tmp_path: Path, text: str, name: str = "site.epw") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


def faults(path: Path, year: int | None = None) -> str:
    return "\n".join(faults_of(read_epw, path, year))


def moment(text: str) -> float:
    return float(np.datetime64(text, "s").astype(np.int64))


def test_hours_end_in_local_standard_time(tmp_path: Path) -> None:
    record = read_epw(written(tmp_path, made.epw_text()))
    warm = record["ambient_temperature"]
    # hour 1 of 1 January ends at 01:00 local, 00:00 UTC; hour 24 of 31 December at 23:00 UTC
    assert (warm.time[0], warm.time[-1]) == (moment("2010-01-01T00:00:00"), moment("2010-12-31T23:00:00"))
    assert len(warm) == 8760 and np.all(np.diff(warm.time) == 3600.0)
    assert (warm.hold, warm.interval_s) == ("linear", 0.0)
    hour = np.arange(8760)
    assert np.nanmax(np.abs(warm.value - 283.15 - 5.0 * np.sin(2 * np.pi * hour / 24))) < 0.051
    sun = record["global_horizontal_irradiance"]
    # hours 9 to 16 are those from 8 to 16 o'clock: the day's energy is centred at noon, local time
    assert (sun.hold, sun.interval_s) == ("mean", 3600.0)
    middle = np.mod(sun.time - 1800.0 + 3600.0, 86400.0) / 3600.0
    assert np.nansum(sun.value[:24] * middle[:24]) / np.nansum(sun.value[:24]) == pytest.approx(12.0)
    assert record.site == Site(48.5, 5.5, 250.0)


@pytest.mark.parametrize("zone", [-8.0, 5.5, 12.75])
def test_zones(tmp_path: Path, zone: float) -> None:
    record = read_epw(written(tmp_path, made.epw_text(zone=zone)))
    assert record["ambient_temperature"].time[0] == moment("2010-01-01T01:00:00") - 3600.0 * zone


def test_codes_for_missing_are_no_readings(tmp_path: Path) -> None:
    record = read_epw(written(tmp_path, made.epw_text()))
    for signal, place in (
        ("ambient_temperature", 100), ("ambient_pressure", 300), ("global_horizontal_irradiance", 400)
    ):  # fmt: skip
        assert list(np.flatnonzero(record[signal].missing)) == [place], signal
    assert record["rain"].missing.sum() == 4380 and np.nanmax(record["rain"].value) == pytest.approx(0.4)
    assert "direct_normal_irradiance" not in record  # all of it is missing
    assert record["cloud_cover"].value[0] == pytest.approx(0.7)


def test_a_missing_dew_point_comes_from_relative_humidity(tmp_path: Path) -> None:
    record = read_epw(written(tmp_path, made.epw_text()))
    dew, warm = record["ambient_dew_point_temperature"].value, record["ambient_temperature"].value
    assert made.relative_humidity(dew[200], warm[200]) == pytest.approx(0.6, abs=1e-9)
    assert np.isnan(dew[201]) and np.isnan(dew).sum() == 1
    assert any("1 dew points are missing; they were computed from" in said for said in record.warnings)


def test_a_typical_year_needs_a_year(tmp_path: Path) -> None:
    path = written(tmp_path, made.epw_text(TYPICAL))
    assert "typical year composed of months from 2006 … 2018; state the calendar year" in faults(path)
    record = read_epw(path, 2019)
    warm = record["ambient_temperature"]
    assert len(warm) == 8760 and np.all(np.diff(warm.time) == 3600.0)
    assert (warm.time[0], warm.time[-1]) == (moment("2019-01-01T00:00:00"), moment("2019-12-31T23:00:00"))
    assert "hours of 2006 … 2018 stand in 2019: a typical year, not the weather of 2019" in record.warnings


def test_leap_years(tmp_path: Path) -> None:
    path = written(tmp_path, made.epw_text(TYPICAL))
    record = read_epw(path, 2020)
    value, time = record["ambient_dew_point_temperature"].value, record["ambient_dew_point_temperature"].time
    assert len(time) == 8784 and np.all(np.diff(time) == 3600.0)
    twice = int(np.searchsorted(time, moment("2020-02-29T00:00:00")))
    assert value[twice : twice + 24] == pytest.approx(value[twice - 24 : twice])
    assert value[twice + 24] != pytest.approx(value[twice])
    assert any("28 February is repeated" in said for said in record.warnings)


def test_a_real_leap_year_in_a_common_one(tmp_path: Path) -> None:
    text = made.epw_text((2012,) * 12)
    lines = text.splitlines()
    day = [line for line in lines if line.startswith("2012,2,28,")]
    place = lines.index(day[-1]) + 1
    lines[place:place] = [line.replace("2012,2,28,", "2012,2,29,") for line in day]
    path = written(tmp_path, "\n".join(lines))
    assert len(read_epw(path)["ambient_temperature"]) == 8784
    record = read_epw(path, 2013)
    assert len(record["ambient_temperature"]) == 8760
    assert any("29 February is left out" in said for said in record.warnings)


def test_faults_of_files(tmp_path: Path) -> None:
    text = made.epw_text()
    lines = text.splitlines()
    assert faults(written(tmp_path, "\n".join(lines[:5000]))) == (
        "expected 8760 hours after its DATA PERIODS, found 4992: the file is cut short; fetch it again"
    )
    assert "the file is cut short or is not EPW" in faults(written(tmp_path, "\n".join(lines[:4])))
    assert "first line begins with LOCATION" in faults(written(tmp_path, "time,T\n1,2\n"))
    wrong = [lines[0].replace("48.500", "north"), *lines[1:100], "2010,1,4,25,0,x,warm", *lines[101:]]
    said = faults(written(tmp_path, "\n".join(wrong)))
    assert (
        "line 1: expected LOCATION with latitude" in said and "line 101: expected at least 22 cells" in said
    )
    wrong = list(lines)
    wrong[50] = wrong[50].replace("2010,1,2,19,", "2010,1,2,25,")
    assert "line 51: expected an hour 1 … 24, found 25" in faults(written(tmp_path, "\n".join(wrong)))
    wrong = list(lines)
    wrong[50], wrong[51] = wrong[51], wrong[50]
    assert "line 52: the hours must be consecutive" in faults(written(tmp_path, "\n".join(wrong)))
    half = text.replace("DATA PERIODS,1,1,", "DATA PERIODS,1,4,")
    assert "expected 1 record an hour, found 4" in faults(written(tmp_path, half))
    hot = [
        *lines[:8],
        *(",".join([*c[:6], "283.1", *c[7:]]) for c in (line.split(",") for line in lines[8:])),
    ]
    assert "column 7: ambient_temperature would lie at 283.1 … 283.1 degC" in faults(
        written(tmp_path, "\n".join(hot))
    )
    with pytest.raises(TableFault, match="1900 … 2200"):
        read_epw(written(tmp_path, text), 19)


def test_archives_of_weather_services(tmp_path: Path) -> None:
    text = made.epw_text().encode()
    path = made.zipped(
        tmp_path / "site.zip",
        {"site.epw": text, "site.stat": b"statistics of the file", "site.ddy": b"! days"},
    )
    assert len(read_epw(path)["ambient_temperature"]) == 8760
    assert "holds 2 such files" in faults(made.zipped(path, {"a.epw": text, "b.epw": text}))
    assert 'state format = "era5"' in faults(made.new_file(tmp_path / "era5.nc"))


@measured
def test_the_published_file_against_its_plain_columns() -> None:
    """PVGIS, 45° N 8° E: every value where pandas finds it."""
    import pandas as pd

    path = DATA / "weather/PVGIS_45N_8E.epw.gz"
    assert "typical year" in faults(path)
    record = read_epw(path, 2019)
    with gzip.open(path) as stream:
        table = pd.read_csv(stream, skiprows=8, header=None)
    assert len(table) == len(record["ambient_temperature"]) == 8760
    for signal, column, offset in (
        ("ambient_temperature", 6, 273.15), ("ambient_dew_point_temperature", 7, 273.15),
        ("ambient_pressure", 9, 0.0),
        ("global_horizontal_irradiance", 13, 0.0), ("diffuse_horizontal_irradiance", 15, 0.0),
        ("wind_speed", 21, 0.0),
    ):  # fmt: skip
        np.testing.assert_allclose(record[signal].value, table[column] + offset, atol=1e-9)
    assert record.site == Site(45.0, 8.0, 250.0) and "rain" not in record and "cloud_cover" not in record
    # dew point and relative humidity of the file agree over water, which is how the dew point is read
    made_of = 100.0 * made.relative_humidity(table[7].to_numpy() + 273.15, table[6].to_numpy() + 273.15)
    cold = (table[6] < 0.0).to_numpy()
    assert cold.sum() > 100
    assert np.median(np.abs(made_of - table[8])[cold]) < 1.5 and np.median(np.abs(made_of - table[8])) < 1.5


def test_an_archive_of_a_weather_service_is_known_by_what_is_in_it(tmp_path: Path) -> None:
    text = made.epw_text(TYPICAL)
    members = {
        "FRA_site.epw": text.encode(),
        "FRA_site.stat": b"- Statistics",
        "FRA_site.ddy": b"! design days",
    }
    path = made.zipped(tmp_path / "FRA_site.zip", members)
    assert (
        weather_format(path) == "epw"
        and len(read_weather(path, year=2019, years=2)["ambient_temperature"]) == 17544
    )
    assert weather_format(written(tmp_path, text, "site.txt")) == "epw"
    assert (
        weather_format(made.streams(tmp_path / "era5.nc")) == "era5"
        and weather_format(tmp_path / "no.zip") is None
    )
    (tmp_path / "cut.zip").write_bytes(path.read_bytes()[:400])
    with pytest.raises(TableFault, match="damaged ZIP"):
        read_weather(tmp_path / "cut.zip")


def test_what_only_looks_like_a_reading(tmp_path: Path) -> None:
    lines = made.epw_text().splitlines()

    def changed(column: int, number) -> Path:
        body = [line.split(",") for line in lines[8:]]
        for place, cells in enumerate(body):
            cells[column] = number(place, cells)
        return written(tmp_path, "\n".join([*lines[:8], *map(",".join, body)]) + "\n")

    path = changed(6, lambda place, cells: "inf" if place == 3 else cells[6])
    assert faults(path) == "line 12: cell 7: expected a number, found inf"
    assert "column 9: relative humidity reaches 0.6 only" in faults(changed(8, lambda place, cells: "0.6"))
    exchanged = read_epw(changed(7, lambda place, cells: str(float(cells[6]) + 4.0)))
    assert any("the dew point lies above the temperature for 100 %" in said for said in exchanged.warnings)
