"""Many years of weather: files after each other, a typical year repeated, gaps in words."""

from __future__ import annotations

import re
from pathlib import Path

import builders.weather_case as made
import numpy as np
import pytest

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Series, Site
from hygrokf.weather.joining import join_records
from hygrokf.weather.reading import gaps_text, read_weather, read_weather_file

SITE = Site(48.48, 5.57, 311.0)


def moment(text: str) -> float:
    return float(np.datetime64(text, "s").astype(np.int64))


def test_files_put_after_each_other(tmp_path: Path) -> None:
    later = made.START + 3600 * made.HOURS
    paths = [made.new_file(tmp_path / "b.nc", start=later, preliminary=5), made.new_file(tmp_path / "a.nc")]
    record = read_weather(paths, site=SITE)
    assert len(record["ambient_temperature"]) == 2 * made.HOURS
    assert np.all(np.diff(record["ambient_temperature"].time) == 3600.0)
    assert record["ambient_pressure"].value[-1] == pytest.approx(made.truth("sp")[-1], rel=1e-6)
    assert [name for name, _ in record.files] == ["b.nc", "a.nc"]
    assert not any("gap" in said or "duplicate" in said for said in record.warnings)


def test_gaps_are_said(tmp_path: Path) -> None:
    later = made.START + 3600 * (made.HOURS + 50)
    record = read_weather(
        [made.new_file(tmp_path / "a.nc"), made.new_file(tmp_path / "b.nc", start=later)], site=SITE
    )
    assert "ambient_temperature: a gap of 2.12 d from 2021-03-04T23:00Z" in record.warnings


def test_the_gap_of_a_series() -> None:
    time = 3600.0 * np.arange(100.0)
    value = np.full(100, 280.0)
    assert gaps_text(Series("ambient_temperature", time, value)) == []
    value[10:12] = np.nan  # two readings are no gap
    assert gaps_text(Series("ambient_temperature", time, value)) == []
    value[40:50] = np.nan
    value[60:80] = np.nan
    (said,) = gaps_text(Series("ambient_temperature", time, value))
    assert said.startswith("ambient_temperature: 2 gaps, 30 h")
    assert re.findall(r"(\d+) h from (\S+Z)", said) == [
        ("21", "1970-01-03T11:00Z"),
        ("11", "1970-01-02T15:00Z"),
    ]


def test_a_typical_year_repeated(tmp_path: Path) -> None:
    path = tmp_path / "site.epw"
    path.write_text(made.epw_text((2006, *(2011,) * 11)))
    record = read_weather(path, year=2019, years=3)
    warm = record["ambient_dew_point_temperature"]
    assert len(warm) == 2 * 8760 + 8784 and np.all(np.diff(warm.time) == 3600.0)
    assert warm.value[:8000:9] == pytest.approx(warm.value[8760 + 8784 :][:8000:9], nan_ok=True)
    said = " ".join(record.warnings)
    assert "hours of 2006 … 2011 stand in 2019 … 2021: a typical year" in said
    assert said.count("28 February") == 1 and "2020 is a leap year: 28 February is repeated" in said


def test_faults_of_every_file_at_once(tmp_path: Path) -> None:
    (tmp_path / "broken.nc").write_bytes(b"CDF\x01")
    with pytest.raises(TableFault) as caught:
        read_weather([tmp_path / "broken.nc", tmp_path / "absent.nc"], site=SITE)
    assert [fault.split(":")[0] for fault in caught.value.faults] == ["broken.nc", "absent.nc"]
    for arguments, words in (
        ({"years": 0}, "1 or more"), ({"years": 2}, "years needs year"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            read_weather(tmp_path / "x.epw", **arguments)
    with pytest.raises(ValueError, match="expected one weather file"):
        read_weather([])
    with pytest.raises(TableFault, match="only a typical year"):
        read_weather(made.new_file(tmp_path / "a.nc"), site=SITE, year=2019, years=2)


def test_records_of_different_places_are_not_joined() -> None:
    def at(latitude: float, start: float) -> Record:
        series = Series("ambient_temperature", start + 3600.0 * np.arange(3), np.full(3, 280.0))
        return Record(f"{latitude}", (series,), Site(latitude, 5.0))

    assert len(join_records([at(48.0, 0.0), at(48.0, 7200.0)], "x")["ambient_temperature"]) == 5
    with pytest.raises(TableFault, match="different places"):
        join_records([at(48.0, 0.0), at(49.0, 1e5)], "x")


def test_contradicting_files_are_masked_and_said() -> None:
    time = 3600.0 * np.arange(3)
    one = Record("a", (Series("ambient_temperature", time, np.array([280.0, 281.0, 282.0])),))
    other = Record("b", (Series("ambient_temperature", time, np.array([280.0, 281.5, 282.0])),))
    record = join_records([one, other], "x")
    assert list(record["ambient_temperature"].missing) == [False, True, False]
    assert "contradicting ones masked" in record.warnings[0]


def test_the_rounding_of_packed_files_is_no_contradiction() -> None:
    time = 3600.0 * np.arange(400)
    truth = 280.0 + 15.0 * np.sin(np.arange(400) / 30.0)

    def packed(first: int, last: int) -> Record:
        part = truth[first:last]
        step = np.ptp(part) / 65530.0
        value = part.min() + step * np.round((part - part.min()) / step)
        return Record("x", (Series("ambient_temperature", time[first:last], value),))

    one, other = packed(0, 250), packed(190, 400)
    assert np.any(one["ambient_temperature"].value[190:] != other["ambient_temperature"].value[:60])
    record = join_records([one, other], "x")
    assert not record["ambient_temperature"].missing.any()
    np.testing.assert_allclose(record["ambient_temperature"].value, truth, atol=3e-4)


def test_a_code_for_missing_among_the_readings_is_masked(tmp_path: Path) -> None:
    dataset = made.new_dataset(("t2m", "d2m"))
    dataset["t2m"][7] = -9999.0
    path = tmp_path / "era5.nc"
    path.write_bytes(made.netcdf4(dataset))
    record = read_weather(path, site=SITE)
    assert np.flatnonzero(record["ambient_temperature"].missing).tolist() == [7]
    assert any("masked" in said and "ambient_temperature" in said for said in record.warnings)


def test_heights(tmp_path: Path) -> None:
    path = tmp_path / "site.epw"
    path.write_text(made.epw_text())
    high = Site(48.5, 5.5, 850.0)
    said = read_weather_file(path, site=high).warnings
    assert any(all(word in one for word in ("250 m", "850 m", "3.9 K colder")) for one in said)
    moved = read_weather(path, site=high, to_site_altitude=True)
    plain = read_weather(path)
    difference = moved["ambient_temperature"].value - plain["ambient_temperature"].value
    assert np.nanmax(np.abs(difference + 3.9)) < 1e-9 and moved.site.altitude_m == 850.0
    with pytest.raises(TableFault, match=r"needs altitude_m in \[site\]"):
        read_weather_file(path, site=Site(48.5, 5.5), to_site_altitude=True)
    grid = made.new_file(tmp_path / "era5.nc")
    with pytest.raises(TableFault, match="needs the altitude of the weather"):
        read_weather_file(grid, site=high, to_site_altitude=True)
    given = read_weather_file(grid, site=high, to_site_altitude=True, altitude_m=350.0)
    assert given["ambient_temperature"].value == pytest.approx(made.truth("t2m") - 3.25, abs=1e-4)
    far = read_weather_file(path, site=Site(53.0, 8.0, 250.0))
    assert any("km from the site: is it the weather of this site?" in one for one in far.warnings)


def test_winds_at_two_heights_are_not_put_together() -> None:
    parts = [
        Record(str(h), (Series("wind_speed", np.arange(3.0) + h, np.ones(3), height_m=h),))
        for h in (10.0, 100.0)
    ]
    with pytest.raises(TableFault, match="wind_speed: at 10 m and 100 m in different files"):
        join_records(parts, "both")
    assert join_records(parts[:1] * 2, "one")["wind_speed"].height_m == 10.0
