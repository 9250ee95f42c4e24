"""MERRA-2: hourly means at half past, humidity by mass, daily files."""

from __future__ import annotations

import zipfile
from pathlib import Path

import builders.weather_services as made
import numpy as np
import pytest
from builders.faults import faults_of
from builders.moist_air import specific_humidity

from hygrokf.data.record import Site
from hygrokf.physics.psychrometrics import saturation_pressure_water
from hygrokf.weather.reading import read_weather, weather_format
from hygrokf.weather.reanalysis import read_era5, read_merra2

SITE = Site(48.48, 5.57, 400.0)  # nearest to the middle cell
START_S = np.datetime64("2021-03-01T00:00", "s").astype(np.int64).astype(float)


def faults(path: Path, site: Site | None = SITE) -> str:
    return "\n".join(faults_of(read_merra2, path, site))


def test_a_day_as_delivered(tmp_path: Path) -> None:
    path = made.merra2_file(tmp_path)
    record = read_merra2(path, SITE)
    temperature, dew_point = record["ambient_temperature"], record["ambient_dew_point_temperature"]
    np.testing.assert_allclose(temperature.value, made.merra2_truth("T2M"), rtol=1e-6)
    # the mean of 00:00 … 01:00 is stamped 00:30; a record has the end of the interval
    np.testing.assert_array_equal(temperature.time, START_S + 3600.0 * np.arange(1, 25))
    assert {(one.hold, one.interval_s) for one in record.series} == {("mean", 3600.0)}
    vapour = saturation_pressure_water(dew_point.value)
    pressure = record["ambient_pressure"].value
    np.testing.assert_allclose(specific_humidity(vapour, pressure), made.merra2_truth("QV2M"), rtol=1e-5)
    wind = record["wind_speed"]
    assert wind.height_m == 50.0
    np.testing.assert_allclose(
        wind.value, np.hypot(made.merra2_truth("U50M"), made.merra2_truth("V50M")), rtol=1e-6
    )
    assert (record.site.latitude_deg, record.site.longitude_deg) == (48.5, 5.625)
    assert 'column "T2M" at 48.50° N 5.62° E' in temperature.source


def test_daily_files_follow_each_other_alone_and_in_an_archive(tmp_path: Path) -> None:
    files = [made.merra2_file(tmp_path, day) for day in range(4)]
    archive = tmp_path / "march.zip"
    with zipfile.ZipFile(archive, "w") as into:
        for file in files:
            into.write(file, file.name)
    assert weather_format(archive) == "merra2"
    for given in (files, [archive], files[::-1]):
        series = read_weather(given, site=SITE)["ambient_temperature"]
        np.testing.assert_allclose(series.value, made.merra2_truth("T2M", days=4), rtol=1e-6)
        assert (np.diff(series.time) == 3600.0).all()


def test_a_subset_under_another_name_is_known_by_its_fields(tmp_path: Path) -> None:
    path = made.merra2_file(tmp_path, name="site.nc", names=("T2M", "QV2M", "PS", "U10M", "V10M"))
    assert weather_format(path) == "merra2"
    assert read_merra2(path, SITE)["wind_speed"].height_m == 10.0
    assert 'state format = "merra2"' in "\n".join(faults_of(read_era5, path, SITE))


def test_what_is_missing_is_nan(tmp_path: Path) -> None:
    import xarray

    with xarray.open_dataset(made.merra2_file(tmp_path)) as opened:
        dataset = opened.load()
    dataset["T2M"][3] = np.nan
    path = tmp_path / "MERRA2_gap.nc4"
    dataset.to_netcdf(path, engine="h5netcdf")
    assert list(np.flatnonzero(np.isnan(read_merra2(path, SITE)["ambient_temperature"].value))) == [3]


@pytest.mark.parametrize(
    ("names", "minute", "words"),
    [
        (("T2M", "QV2M"), 30, "needs the pressure PS"),
        (("T2M", "QV2M", "PS"), 0, "24 of 24 stamps are not half past the hour"),
        (("QV2M", "PS"), 30, "no temperature T2M"),
    ],
)
def test_faults_are_named(tmp_path: Path, names: tuple[str, ...], minute: int, words: str) -> None:
    assert words in faults(made.merra2_file(tmp_path, names=names, first_minute=minute))


def test_a_grid_needs_a_site(tmp_path: Path) -> None:
    assert "no site is given" in faults(made.merra2_file(tmp_path), None)


def test_without_humidity_the_record_says_so(tmp_path: Path) -> None:
    record = read_merra2(made.merra2_file(tmp_path, names=("T2M", "U10M", "V10M")), SITE)
    assert any("no humidity" in said for said in record.warnings)
