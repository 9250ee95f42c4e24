"""ERA5 in every layout in which it was delivered, and what is said of files that are none."""

from __future__ import annotations

import gzip
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import builders.weather_case as made
import numpy as np
import pandas as pd
import pytest
from builders.faults import faults_of

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Site
from hygrokf.weather import archive
from hygrokf.weather.reading import read_weather_file
from hygrokf.weather.reanalysis import ERA5, derive_era5, point_weather, read_era5

if TYPE_CHECKING:
    import xarray

SITE = Site(48.48, 5.57, 400.0)  # nearest to the middle cell, 48.5 N 5.5 E


def faults(path: Path, site: Site | None = SITE) -> str:
    return "\n".join(faults_of(read_era5, path, site))


def era5_record(dataset: xarray.Dataset, site: Site = SITE) -> Record:
    weather = point_weather(dataset, "data set", ERA5, site)
    derive_era5(weather)
    return weather.record("")


def assert_middle_cell(record, hours: int = made.HOURS, tolerance: float = 1e-4) -> None:
    for signal, name in (
        ("ambient_temperature", "t2m"),
        ("ambient_dew_point_temperature", "d2m"),
        ("ambient_pressure", "sp"),
    ):
        series = record[signal]
        np.testing.assert_allclose(series.value, made.truth(name, hours), rtol=tolerance)
        np.testing.assert_array_equal(series.time, made.seconds(hours))
        assert (series.hold, series.interval_s) == ("linear", 0.0)


# -- layouts -------------------------------------------------------------------------------------------------
def test_the_layout_of_today(tmp_path: Path) -> None:
    record = read_era5(made.new_file(tmp_path / "era5.nc", ("t2m", "d2m", "sp", "z")), SITE)
    assert_middle_cell(record)
    assert (record.site.latitude_deg, record.site.longitude_deg) == (48.5, 5.5)
    assert record.site.altitude_m == pytest.approx(311.0, abs=0.01)
    source = record["ambient_temperature"].source
    assert source == 'era5.nc, column "t2m" at 48.50° N 5.50° E, 6 km from the site'
    assert record.warnings == () and len(record.files[0][1]) == 64


def test_preliminary_hours_are_said(tmp_path: Path) -> None:
    record = read_era5(made.new_file(tmp_path / "era5.nc", preliminary=30), SITE)
    assert_middle_cell(record)
    (said,) = record.warnings
    assert said.startswith("30 hours are preliminary")


@pytest.mark.parametrize("preliminary", [None, 24], ids=["final", "two halves"])
def test_the_legacy_layout(tmp_path: Path, preliminary: int | None) -> None:
    """NetCDF-3, packed in two bytes, hours since 1900, halves of expver that are NaN where the other is
    not."""
    record = read_era5(made.legacy_file(tmp_path / "old.nc", preliminary=preliminary), SITE)
    assert_middle_cell(record, tolerance=2e-5)
    assert any("24 hours are preliminary" in said for said in record.warnings) == (preliminary is not None)


def test_the_streams_of_one_request_come_as_a_zip_named_nc(tmp_path: Path) -> None:
    record = read_era5(made.streams(tmp_path / "era5.nc"), SITE)
    assert_middle_cell(record)
    sun = record["global_horizontal_irradiance"]
    np.testing.assert_allclose(sun.value, made.truth("ssrd") / 3600.0, rtol=1e-6)
    assert (sun.hold, sun.interval_s) == ("mean", 3600.0)
    np.testing.assert_array_equal(sun.time, made.seconds())  # the sum's hour ends at its stamp
    np.testing.assert_allclose(
        record["diffuse_horizontal_irradiance"].value,
        (made.truth("ssrd") - made.truth("fdir")) / 3600.0,
        rtol=1e-6,
    )
    np.testing.assert_allclose(record["rain"].value, 1000.0 * made.truth("tp"), rtol=1e-6)
    np.testing.assert_allclose(record["cloud_cover"].value, made.truth("tcc"), rtol=1e-6)
    east, north = made.truth("u100"), made.truth("v100")
    np.testing.assert_allclose(record["wind_speed"].value, np.hypot(east, north), rtol=1e-5)
    towards = record["wind_direction"].value + np.pi
    assert record["wind_speed"].height_m == (100.0 if "u100" in record["wind_speed"].source else 10.0)
    speed = record["wind_speed"].value
    np.testing.assert_allclose(np.sin(towards) * speed, east, atol=1e-4)
    np.testing.assert_allclose(np.cos(towards) * speed, north, atol=1e-4)
    assert record.warnings == ()


@pytest.mark.parametrize("packing", ["plain", "gzip", "zip"])
def test_the_point_products_csv(tmp_path: Path, packing: str) -> None:
    data = made.point_csv()
    path = tmp_path / "point.csv"
    if packing == "plain":
        path.write_bytes(data)
    elif packing == "gzip":
        path.write_bytes(gzip.compress(data))
    else:
        waves = b"valid_time,swh,latitude,longitude\n2021-03-01 00:00:00,,48.5,5.5\n"
        made.zipped(
            path,
            {
                "reanalysis-era5-single-levels-timeseries-sfcab12.csv": data,
                "reanalysis-era5-single-levels-timeseries-wavb9i2.csv": waves,
            },
        )
    record = read_era5(path)
    assert_middle_cell(record)
    np.testing.assert_allclose(
        record["global_horizontal_irradiance"].value, made.truth("ssrd") / 3600.0, atol=1e-3
    )
    (said,) = record.warnings
    assert "wind_speed" in said and "10 m" in said
    assert (record.site.latitude_deg, record.site.longitude_deg) == (48.5, 5.5)


def test_the_point_products_netcdf_needs_no_site(tmp_path: Path) -> None:
    dataset = (
        made.new_dataset(("t2m", "d2m", "sp")).drop_vars(["number", "expver"]).isel(latitude=1, longitude=1)
    )
    path = tmp_path / "point.nc"
    path.write_bytes(made.netcdf4(dataset))
    assert_middle_cell(read_era5(path))


def test_any_data_set_with_long_names() -> None:
    import xarray

    names = {"2m_temperature": "t2m", "2m_dewpoint_temperature": "d2m", "surface_pressure": "sp"}
    dataset = xarray.Dataset(
        {
            long: (("time", "latitude", "longitude"), made.grid(short), {"units": made.UNITS[short]})
            for long, short in names.items()
        },
        coords={
            "time": made.stamps().astype("datetime64[ns]"),
            "latitude": made.LATITUDES,
            "longitude": made.LONGITUDES,
        },
    )
    assert_middle_cell(era5_record(dataset, SITE))
    # longitudes of 0 … 360 and a site in the west
    west = dataset.assign_coords(longitude=made.LONGITUDES + 350.0)
    record = era5_record(west, Site(48.48, -4.43))
    assert_middle_cell(record)
    assert record.site.longitude_deg == pytest.approx(-4.5)


def test_stamps_in_any_order_and_twice(tmp_path: Path) -> None:
    import xarray

    dataset = made.new_dataset(("t2m", "d2m", "sp")).drop_vars("expver")
    mixed = xarray.concat(
        [dataset.isel(valid_time=slice(40, None)), dataset.isel(valid_time=slice(0, 45))], "valid_time"
    )
    record = era5_record(mixed, SITE)
    assert_middle_cell(record)
    (said,) = record.warnings
    assert said.startswith("5 stamps")


# -- places --------------------------------------------------------------------------------------------------
def test_the_nearest_cell_by_the_metric_of_the_sphere() -> None:
    dataset = made.new_dataset(("t2m", "d2m"))
    for latitude, longitude, row, column in ((48.7, 5.26, 0, 0), (48.27, 5.74, 2, 2), (48.5, 5.4, 1, 1)):
        record = era5_record(dataset, Site(latitude, longitude))
        expected = made.truth("t2m", row=row, column=column)
        np.testing.assert_allclose(record["ambient_temperature"].value, expected, rtol=1e-6)


def test_a_cell_without_data_gives_way_to_the_next() -> None:
    """Reanalyses of the land alone have no temperature over the sea."""
    dataset = made.new_dataset(("t2m", "d2m")).copy(deep=True)
    dataset["t2m"][:, 1, 1] = np.nan
    record = era5_record(dataset, SITE)
    np.testing.assert_allclose(record["ambient_temperature"].value, made.truth("t2m", column=2), rtol=1e-6)
    assert "5.75° E" in record["ambient_temperature"].source


def test_a_grid_needs_a_site(tmp_path: Path) -> None:
    said = faults(made.new_file(tmp_path / "era5.nc"), None)
    assert "holds a grid of 3 × 3 cells and no site is given" in said and "[site]" in said


def test_a_site_outside_of_the_grid_is_refused(tmp_path: Path) -> None:
    said = faults(made.new_file(tmp_path / "era5.nc"), Site(52.0, 5.5))
    assert "outside of the grid" in said and "latitude 48.25 … 48.75" in said


def test_a_point_from_afar_is_said(tmp_path: Path) -> None:
    path = tmp_path / "point.csv"
    path.write_bytes(made.point_csv())
    record = read_weather_file(path, "era5", site=Site(52.4, -0.95))
    assert any("is it the weather of this site?" in said for said in record.warnings)


# -- accumulated fields --------------------------------------------------------------------------------------
def test_sums_since_midnight_become_hourly_ones() -> None:
    """ERA5-Land: the stamp 00:00 has the sum of the whole day before."""
    dataset = made.new_dataset(("t2m", "d2m", "ssrd", "tp")).copy(deep=True)
    for name in ("ssrd", "tp"):
        hourly = made.grid(name)
        total = np.zeros_like(hourly)
        for place in range(1, made.HOURS):
            total[place] = hourly[place] + (0.0 if place % 24 == 1 else total[place - 1])
        dataset[name][:] = total
    record = era5_record(dataset, SITE)
    sun = record["global_horizontal_irradiance"].value
    np.testing.assert_allclose(sun[1:], made.truth("ssrd")[1:] / 3600.0, atol=0.02)
    np.testing.assert_allclose(record["rain"].value[1:], 1000.0 * made.truth("tp")[1:], atol=1e-4)
    assert sum("since 00:00 UTC" in said for said in record.warnings) == 2


def packed(total: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Sums (T,) as GRIB packs them in 16 bits, in steps that double as the largest sum of the field grows."""
    step = 2.0 ** np.ceil(np.log2(largest / 2**16))
    return np.floor(total / step) * step


@pytest.mark.parametrize("longitude", [8.0, -75.0, -150.0])
@pytest.mark.parametrize("as_csv", [True, False])
def test_packed_sums_since_midnight_are_told_over_the_whole_file(
    longitude: float, as_csv: bool, tmp_path: Path
) -> None:
    """A packed sum falls a little within the day; far from Greenwich a day of sun ends after 00:00 UTC."""
    count = 24 * 20
    hours = np.arange(1, count + 1)
    local = (hours - 0.5 + longitude / 15.0) % 24.0
    rng = np.random.default_rng(8)
    truth = {
        "ssrd": 2.5e6 * np.maximum(np.sin(np.pi * (local - 5.0) / 14.0), 0.0) * (np.abs(local - 12.0) < 7.0),
        "tp": np.where(rng.random(count) < 0.1, rng.exponential(4e-4, count), 0.0),
    }
    of_day = (hours - 1) // 24
    columns = {"t2m": 280.0 + np.sin(hours), "d2m": 275.0 + np.sin(hours)}
    into_day = (hours - 1) % 24 + 1
    for name, most in (("ssrd", 3e7), ("tp", 0.4)):
        total = np.concatenate([np.cumsum(truth[name][of_day == day]) for day in range(20)])
        columns[name] = packed(total, most * into_day / 24.0)
    assert np.any(np.diff(columns["tp"])[into_day[1:] > 1] < 0.0)
    if as_csv:
        stamps = pd.Timestamp("2024-01-01") + pd.to_timedelta(hours, "h")
        frame = pd.DataFrame({"valid_time": stamps, **columns})
        frame.assign(latitude=55.0, longitude=longitude).to_csv(tmp_path / "land.csv", index=False)
        record = read_era5(tmp_path / "land.csv")
    else:
        dataset = made.new_dataset(("t2m", "d2m", "ssrd", "tp"), hours=count + 1)
        dataset = dataset.isel(valid_time=slice(1, None)).copy(deep=True)
        assert dataset.valid_time.values[0].astype("datetime64[h]").astype(int) % 24 == 1
        for name in ("ssrd", "tp"):
            dataset[name][:] = columns[name][:, None, None]
        (tmp_path / "land.nc").write_bytes(made.netcdf4(dataset))
        record = read_era5(tmp_path / "land.nc", SITE)
    assert sum("sums since 00:00 UTC" in said for said in record.warnings) == 2
    rain = record["rain"].value
    assert rain.sum() == pytest.approx(1e3 * truth["tp"].sum(), rel=0.02)
    assert np.mean(rain > 0.02) == pytest.approx(np.mean(truth["tp"] > 2e-5), abs=0.02)
    sun = record["global_horizontal_irradiance"].value
    np.testing.assert_allclose(sun, truth["ssrd"] / 3600.0, atol=1.0)


def test_rain_in_a_dry_place_is_not_taken_for_sums_since_midnight() -> None:
    dataset = made.new_dataset(("t2m", "d2m", "tp"), hours=24 * 120).copy(deep=True)
    rain = np.zeros((24 * 120, 3, 3))
    rain[1000:1005] = np.array([1, 2, 4, 3, 1])[:, None, None] * 1e-4
    dataset["tp"][:] = rain
    record = era5_record(dataset, SITE)
    assert record["rain"].value.sum() == pytest.approx(1.1, rel=1e-5) and record.warnings == ()


# -- what is no such file ------------------------------------------------------------------------------------
def test_a_netcdf_file_cut_short(tmp_path: Path) -> None:
    for path in (made.new_file(tmp_path / "new.nc"), made.legacy_file(tmp_path / "old.nc")):
        data = path.read_bytes()
        for share in (0.3, 0.9):
            path.write_bytes(data[: int(share * len(data))])
            said = faults(path)
            assert "cut short; fetch it again" in said and said.count("\n") == 0


def test_an_archive_cut_short(tmp_path: Path) -> None:
    path = made.streams(tmp_path / "era5.zip")
    path.write_bytes(path.read_bytes()[:-300])
    assert "damaged ZIP archive" in faults(path)


def test_csv_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "point.csv"
    path.write_bytes(made.point_csv()[:-30])
    said = faults(path)
    assert said.startswith("no latitude and longitude at 2021-03-04T23:00Z") and "fetch it again" in said


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "the file is empty"),
        (b"GRIB\x00\x00\x00\x02", "GRIB"),
        (b"CDF\x05" + 40 * b"\x00", "nccopy"),
        (b"<!DOCTYPE html><p>Service unavailable", "an error page saved in place of the file"),
        (b'{"type": "permission denied"}', "error page"),
        (b"\x00\x01\x02" * 100, "found other bytes"),
        (b"time,T\n2021-01-01,3\n", "expected the point product's CSV"),
        (b"LOCATION,x,-,x,x,x,1,2,3,4\n", 'state format = "epw"'),
    ],
)
def test_other_files(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "era5.nc"
    path.write_bytes(data)
    assert words in faults(path)


def test_no_such_file_and_a_directory(tmp_path: Path) -> None:
    (tmp_path / "era5_2021.nc").touch()
    said = faults(tmp_path / "era5_2020.nc")
    assert "no such file" in said and "era5_2021" in said
    assert "directory" in faults(tmp_path)


def test_wrong_units_all_at_once(tmp_path: Path) -> None:
    dataset = made.new_dataset(("t2m", "d2m", "sp"))
    dataset["t2m"].attrs["units"] = "furlong"
    dataset["d2m"].attrs["units"] = "degC"  # the values are kelvin
    path = tmp_path / "era5.nc"
    path.write_bytes(made.netcdf4(dataset))
    said = faults(path)
    assert 't2m: unknown unit "furlong"; expected one of K' in said
    assert "d2m: ambient_dew_point_temperature would lie at" in said and 'the unit "degC"' in said


def test_csv_in_celsius_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "point.csv"
    text = made.point_csv(("t2m", "d2m")).decode()
    rows = [line.split(",") for line in text.splitlines()]
    for row in rows[1:]:
        row[1] = f"{float(row[1]) - 273.15:.3f}"
    path.write_text("\n".join(",".join(row) for row in rows))
    assert "no unit, so K was taken" in faults(path)


def test_missing_axes_and_fields(tmp_path: Path) -> None:
    dataset = made.new_dataset(("t2m", "d2m"))
    path = tmp_path / "era5.nc"
    path.write_bytes(made.netcdf4(dataset.isel(valid_time=0, drop=True)))
    said = faults(path)
    assert "no time axis" in said and "latitude (3), longitude (3)" in said
    path.write_bytes(made.netcdf4(made.new_dataset(("d2m",))))
    assert "no 2 m temperature" in faults(path)
    path.write_bytes(made.netcdf4(dataset.expand_dims(number=[0, 1]).assign_coords(number=[0, 1])))
    assert "2 members of an ensemble" in faults(path)
    path.write_bytes(made.netcdf4(dataset.drop_vars("number").expand_dims(level=[1, 2, 3])))
    assert "an axis level with 3 entries" in faults(path)
    plain = dataset.assign_coords(valid_time=np.arange(made.HOURS))
    path.write_bytes(made.netcdf4(plain))
    assert "expected times such as" in faults(path)


def test_without_a_dew_point_the_lack_is_said(tmp_path: Path) -> None:
    record = read_era5(made.new_file(tmp_path / "era5.nc", ("t2m", "sp")), SITE)
    assert any("no humidity" in said for said in record.warnings)


# -- archives ------------------------------------------------------------------------------------------------
def test_a_zip_bomb_is_refused_before_it_unfolds(tmp_path: Path) -> None:
    path = made.zipped(tmp_path / "bomb.zip", {"era5.nc": b"\x89HDF\r\n\x1a\n" + bytes(300_000_000)})
    assert path.stat().st_size < 400_000
    assert "unpacks to more than 200 times its size" in faults(path)
    path = tmp_path / "bomb.nc"
    path.write_bytes(gzip.compress(b"CDF\x01" + bytes(50_000_000)))
    assert "unpacks to more than 200 times its size" in faults(path)


def test_all_members_together_are_limited(tmp_path: Path, monkeypatch) -> None:
    noise = np.random.default_rng(3).bytes(2_000_000)
    path = made.zipped(tmp_path / "large.zip", {"a.nc": b"CDF\x01" + noise, "b.nc": b"CDF\x01" + noise})
    packed = path.read_bytes()
    monkeypatch.setattr(archive, "MOST_BYTES", 3_000_000)
    assert "the file holds more than" in faults(path)
    monkeypatch.setattr(archive, "_packed", lambda path: packed)  # as if it were packed more tightly
    assert "b.nc: it unpacks to more than" in faults(path)


def test_members_with_paths_are_never_written(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    path = made.zipped(
        inside / "era5.zip", {"../../evil.nc": made.netcdf4(made.new_dataset(("t2m", "d2m", "sp")))}
    )
    assert_middle_cell(read_era5(path, SITE))
    assert sorted(one.name for one in tmp_path.rglob("*")) == ["era5.zip", "inside"]


def test_faults_of_members_are_named(tmp_path: Path) -> None:
    good = made.netcdf4(made.new_dataset(("t2m", "d2m")))
    path = made.zipped(
        tmp_path / "two.zip", {"good.nc": good, "bad.nc": good[:5000], "nested.zip": b"PK\x03\x04abc"}
    )
    said = faults(path)
    assert "nested.zip: is a ZIP archive in a ZIP archive" in said
    path = made.zipped(tmp_path / "two.zip", {"good.nc": good, "bad.nc": good[:5000]})
    assert faults(path).startswith("bad.nc: cannot be read as NetCDF")
    path = made.zipped(tmp_path / "many.zip", {f"{n}.nc": b"x" for n in range(401)}, zipfile.ZIP_STORED)
    assert "holds 401 files" in faults(path)
    assert "without a file in it" in faults(made.zipped(tmp_path / "none.zip", {}))


def test_the_missing_extra_is_named(tmp_path: Path, monkeypatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "xarray", None)
    path = tmp_path / "era5.nc"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    assert 'pip install "hygrokf[weather]"' in faults(path)


# -- what is missing, and what only looks right --------------------------------------------------------------
def test_lost_radiation_and_rain_stay_missing() -> None:
    dataset = made.new_dataset(("t2m", "d2m", "ssrd", "fdir", "tp"))
    for name in ("ssrd", "fdir", "tp"):
        dataset[name][10:14] = np.nan
    record = era5_record(dataset, SITE)
    for signal in ("global_horizontal_irradiance", "diffuse_horizontal_irradiance", "rain"):
        assert np.flatnonzero(record[signal].missing).tolist() == [10, 11, 12, 13]
    dataset["ssrd"][:] = np.nan
    record = era5_record(dataset, SITE)
    assert "global_horizontal_irradiance" not in record
    assert any("ssrd: no value at this point" in said for said in record.warnings)


def test_sums_since_midnight_are_missing_after_a_gap() -> None:
    dataset = made.new_dataset(("t2m", "d2m", "ssrd"))
    hourly = dataset["ssrd"].values.astype(float)
    day = (made.seconds() - 1.0) // 86400.0
    for number in np.unique(day):
        dataset["ssrd"][day == number] = np.cumsum(hourly[day == number], axis=0)
    whole = era5_record(dataset, SITE)["global_horizontal_irradiance"]
    left = np.delete(np.arange(made.HOURS), np.arange(32, 36))
    cut = era5_record(dataset.isel(valid_time=left), SITE)["global_horizontal_irradiance"]
    expected = whole.value[left].copy()
    expected[32] = np.nan  # the first hour after the gap
    np.testing.assert_allclose(cut.value, expected, atol=0.05)
    assert np.isnan(whole.value[0])  # the day before the file is not in it


def test_sums_since_midnight_every_three_hours_are_refused() -> None:
    dataset = made.new_dataset(("t2m", "d2m", "ssrd"), hours=240)
    hourly = 0.1 * dataset["ssrd"].values.astype(float)  # a winter: the sums alone look possible
    day = (made.seconds(240) - 1.0) // 86400.0
    for number in np.unique(day):
        dataset["ssrd"][day == number] = np.cumsum(hourly[day == number], axis=0)
    with pytest.raises(TableFault, match="sums since 00:00 UTC, every 3 h"):
        era5_record(dataset.isel(valid_time=slice(None, None, 3)), SITE)
    dataset["ssrd"][:] = hourly  # sums of an hour, known every third hour: those of ERA5 itself
    every_third = era5_record(dataset.isel(valid_time=slice(None, None, 3)), SITE)
    np.testing.assert_allclose(
        every_third["global_horizontal_irradiance"].value, hourly[::3, 1, 1] / 3600.0, atol=0.01
    )


def test_radiation_in_watts_that_is_called_joules() -> None:
    dataset = made.new_dataset(("t2m", "d2m", "ssrd"))
    watts = dataset["ssrd"] / 3600.0
    dataset["ssrd"] = watts.assign_attrs(units="J m**-2")
    with pytest.raises(TableFault, match=r"would reach 0.19 W/m² only; the file states .J m\*\*-2."):
        era5_record(dataset, SITE)
    dataset["ssrd"] = watts.assign_attrs(units="W m**-2")
    assert era5_record(dataset, SITE)["global_horizontal_irradiance"].value.max() > 600.0


def test_a_forecasts_hour_stands_at_its_valid_time() -> None:
    dataset = made.new_dataset(("t2m", "d2m")).drop_vars(("expver", "number"))
    stamps = dataset["valid_time"].values
    dataset = dataset.rename(valid_time="time").assign_coords(
        time=stamps - np.timedelta64(1, "h"), step=np.timedelta64(1, "h"), valid_time=("time", stamps)
    )
    np.testing.assert_array_equal(era5_record(dataset, SITE)["ambient_temperature"].time, made.seconds())


def test_damaged_stamps_and_numbers(tmp_path: Path) -> None:
    dataset = made.new_dataset(("t2m", "d2m", "sp"))
    stamps = dataset["valid_time"].values.copy()
    stamps[5] = np.datetime64("NaT")
    with pytest.raises(TableFault, match="valid_time: 1 of 96 stamps are missing"):
        era5_record(dataset.assign_coords(valid_time=stamps), SITE)
    with pytest.raises(TableFault, match="has no hour in it"):
        era5_record(dataset.isel(valid_time=slice(0, 0)), SITE)
    assert len(era5_record(dataset.isel(valid_time=3), SITE)["ambient_temperature"]) == 1
    dataset["sp"][7] = np.inf
    record = era5_record(dataset.assign_coords(expver=("valid_time", np.array([b"0005"] * made.HOURS))), SITE)
    assert np.flatnonzero(record["ambient_pressure"].missing).tolist() == [7]
    assert "sp: 1 values are infinite, taken as missing" in record.warnings
    assert record.warnings[0].startswith("96 hours are preliminary")
    table = tmp_path / "point.csv"
    table.write_text("valid_time,t2m,latitude,longitude\n")
    assert "no row below the header" in faults(table)
    table.write_text("valid_time,t2m,latitude,longitude\n2021-03-01 00:00:00,280,95.0,5.5\n")
    assert "latitude_deg must lie within" in faults(table, None)


def test_a_small_file_of_a_huge_array_is_refused(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "huge.nc"
    with h5py.File(path, "w") as file:
        axes = {
            "valid_time": np.arange(100_000),
            "latitude": np.linspace(60, 40, 200),
            "longitude": np.arange(200) / 9,
        }
        for name, values in axes.items():
            file.create_dataset(name, data=values).make_scale(name)
        file["valid_time"].attrs["units"] = "hours since 2014-01-01"
        field = file.create_dataset(
            "t2m", (100_000, 200, 200), "f4", chunks=(1000, 200, 200), compression="gzip"
        )
        for place, name in enumerate(axes):
            field.dims[place].attach_scale(file[name])
    assert path.stat().st_size < 2_000_000
    assert "holds 14.9 GiB of fields" in faults(path)
