"""Test reference years of Germany: clock, year, place, humidity of two columns."""

from __future__ import annotations

from pathlib import Path

import builders.weather_services as made
import numpy as np
import pytest
from builders.faults import faults_of
from builders.weather_case import relative_humidity

from hygrokf.data.record import Site
from hygrokf.weather.reading import read_weather, weather_format
from hygrokf.weather.typical_years import geographic, read_try


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made.try_file(tmp_path_factory.mktemp("try") / "TRY2015_513564124162_Jahr.dat")


def faults(path: Path, year: int | None = 2019) -> str:
    return "\n".join(faults_of(read_try, path, year))


def test_the_layout_of_2017(file: Path) -> None:
    record, columns = read_try(file, 2019), made.try_columns()
    # hour 1 of 1 January ends at 01:00 of Central European Time
    first = np.datetime64("2019-01-01T00:00", "s").astype(int)
    summer = record["ambient_temperature"].time[24 * 200]
    assert record["ambient_temperature"].time[0] == first
    assert summer == first + 3600 * 24 * 200  # no summer time
    for signal, values, hold in (
        ("ambient_temperature", columns["t"] + 273.15, "linear"),
        ("ambient_pressure", 100.0 * columns["p"], "linear"),
        ("wind_speed", columns["WG"], "linear"),
        ("wind_direction", np.radians(columns["WR"]), "previous"),
        ("cloud_cover", columns["N"] / 8.0, "linear"),
        ("global_horizontal_irradiance", columns["B"] + columns["D"], "mean"),
        ("diffuse_horizontal_irradiance", columns["D"], "mean"),
    ):
        np.testing.assert_allclose(record[signal].value, values, rtol=1e-9, err_msg=signal)
        assert record[signal].hold == hold
    assert record["wind_speed"].height_m == 10.0
    assert any("not the weather of 2019" in said for said in record.warnings)


def test_the_dew_point_is_as_fine_as_the_finer_column(file: Path) -> None:
    """Within half a per cent of the humidity that was rounded, although x alone is off by up to 4 %."""
    record, columns = read_try(file, 2019), made.try_columns()
    found = relative_humidity(
        record["ambient_dew_point_temperature"].value, record["ambient_temperature"].value
    )
    np.testing.assert_allclose(found, 0.01 * columns["RF"], rtol=0.008)


def test_the_place_by_rechtswert_and_hochwert(file: Path) -> None:
    """A published name of a file holds latitude and longitude of its Rechtswert and Hochwert."""
    north, east = geographic(4162500.0, 2733500.0)
    assert (north, east) == pytest.approx((51.3564, 12.4162), abs=5e-5)
    assert geographic(4.0e6, 2.8e6) == pytest.approx((52.0, 10.0), abs=1e-9)
    site = read_try(file, 2019).site
    assert (site.latitude_deg, site.longitude_deg, site.altitude_m) == pytest.approx((north, east, 139.0))


def test_the_layout_of_2011_with_codes_for_what_is_missing(tmp_path: Path) -> None:
    columns = made.try_columns()
    columns["WR"][5], columns["N"][6] = 999, 9
    record = read_try(made.try_file(tmp_path / "TRY2010_04_Jahr.dat", made.OF_2011, columns), 2018)
    assert record.site is None and any("region" in said for said in record.warnings)
    np.testing.assert_allclose(record["ambient_temperature"].value, columns["t"] + 273.15)
    assert list(np.flatnonzero(np.isnan(record["wind_direction"].value))) == [5]
    assert list(np.flatnonzero(np.isnan(record["cloud_cover"].value))) == [6]


def test_a_reference_year_is_known_by_its_header_and_repeated(file: Path) -> None:
    assert weather_format(file) == "try"
    weather = read_weather(file, site=Site(51.36, 12.42, 139.0), year=2019, years=2)
    assert len(weather["ambient_temperature"]) == 2 * 8760 + 24
    assert any("2020 is a leap year: 28 February is repeated" in said for said in weather.warnings)
    assert any("stand in 2019 … 2020" in said for said in weather.warnings)


def test_faults_are_named(file: Path, tmp_path: Path) -> None:
    assert "state the one to assign to it" in faults(file, None)
    lines = file.read_bytes().decode("latin-1").splitlines()
    broken = tmp_path / "broken.dat"

    def said(*changed: str) -> str:
        broken.write_bytes("\n".join(changed).encode("latin-1"))
        return faults(broken)

    assert "expected 8760 hours after its header, found 8759" in said(*lines[:-1])
    assert "expected a header that ends in ***" in said(*(one for one in lines if one != "***"))
    begin = lines.index("***") + 1
    assert f"line {begin + 1}: expected 17 cells, found 3" in said(
        *lines[:begin], "1 2 3", *lines[begin + 1 :]
    )
    swapped = [*lines[:begin], lines[begin + 1], lines[begin], *lines[begin + 2 :]]
    assert "the hours must be consecutive" in said(*swapped)
    names = [one.replace("  RF", "  XX") if one.split()[-1:] == ["IL"] else one for one in lines[:begin]]
    assert 'no column "RF"' in said(*names, *lines[begin:])


def test_shifted_columns_are_doubted(tmp_path: Path) -> None:
    columns = made.try_columns()
    columns["x"] = columns["x"] + 2.0
    record = read_try(made.try_file(tmp_path / "TRY.dat", columns=columns), 2019)
    assert any("x and RF differ by" in said for said in record.warnings)
