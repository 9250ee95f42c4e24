"""Open-Meteo as JSON and CSV: units, offsets, heights, and what is said of other files."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import builders.weather_services as made
import numpy as np
import pytest
from builders.faults import faults_of
from builders.weather_case import relative_humidity

from hygrokf.data.record import Site
from hygrokf.weather.open_meteo import read_open_meteo
from hygrokf.weather.reading import read_weather, read_weather_file, weather_format

START_S = np.datetime64("2021-03-01T00:00", "s").astype(np.int64).astype(float)
HOUR = np.arange(96.0)


def faults(path: Path) -> str:
    return "\n".join(faults_of(read_open_meteo, path))


def truth(name: str) -> np.ndarray:
    return made.OPEN_METEO[name][1](HOUR)


@pytest.mark.parametrize("write", [made.open_meteo_json, made.open_meteo_csv])
def test_both_layouts_give_the_same_record(tmp_path: Path, write) -> None:
    path = write(tmp_path / "site.txt", made.open_meteo())
    assert weather_format(path) == "open_meteo"
    record = read_weather_file(path, site=Site(48.48, 5.57, 420.0))
    for signal, values, hold in (
        ("ambient_temperature", truth("temperature_2m") + 273.15, "linear"),
        ("ambient_dew_point_temperature", truth("dew_point_2m") + 273.15, "linear"),
        ("ambient_pressure", 100.0 * truth("surface_pressure"), "linear"),
        ("wind_speed", truth("wind_speed_100m") / 3.6, "linear"),
        ("wind_direction", np.radians(truth("wind_direction_100m")), "previous"),
        ("global_horizontal_irradiance", truth("shortwave_radiation"), "mean"),
        ("rain", truth("precipitation"), "mean"),
        ("cloud_cover", 0.01 * truth("cloud_cover"), "linear"),
    ):
        series = record[signal]
        np.testing.assert_allclose(series.value, values, rtol=1e-12, err_msg=signal)
        np.testing.assert_array_equal(series.time, START_S + 3600.0 * HOUR)
        assert series.hold == hold, signal
    assert record["wind_speed"].height_m == 100.0
    assert record["rain"].interval_s == 3600.0
    assert (record.site.latitude_deg, record.site.altitude_m) == (48.5, 411.0)
    assert record.warnings == ()


@pytest.mark.parametrize(
    ("unit", "factor"), [("m/s", 1.0), ("km/h", 1 / 3.6), ("mp/h", 0.44704), ("kn", 1852 / 3600)]
)
def test_wind_in_the_unit_of_the_file(tmp_path: Path, unit: str, factor: float) -> None:
    path = made.open_meteo_json(tmp_path / "a.json", made.open_meteo(units={"wind_speed_100m": unit}))
    np.testing.assert_allclose(read_open_meteo(path)["wind_speed"].value, factor * truth("wind_speed_100m"))


def test_fahrenheit_and_inch(tmp_path: Path) -> None:
    units = {"temperature_2m": "°F", "dew_point_2m": "°F", "precipitation": "inch"}
    record = read_open_meteo(made.open_meteo_json(tmp_path / "a.json", made.open_meteo(units=units)))
    np.testing.assert_allclose(
        record["ambient_temperature"].value, (truth("temperature_2m") - 32.0) / 1.8 + 273.15
    )
    np.testing.assert_allclose(record["rain"].value, 25.4 * truth("precipitation"))


@pytest.mark.parametrize("offset_h", [2, -5])
def test_local_stamps_are_at_the_offset_of_the_file(tmp_path: Path, offset_h: int) -> None:
    """The service has one offset for the whole file, also across the days on which the clocks change."""
    answer = made.open_meteo(start="2021-03-26T00:00", offset_s=3600 * offset_h)
    record = read_open_meteo(made.open_meteo_csv(tmp_path / "a.csv", answer))
    first = np.datetime64("2021-03-26T00:00", "s").astype(int) - 3600 * offset_h
    np.testing.assert_array_equal(record["ambient_temperature"].time, first + 3600.0 * HOUR)
    assert any(f"offset {offset_h:+d} h" in said for said in record.warnings)


def test_unix_stamps_are_utc_whatever_the_offset(tmp_path: Path) -> None:
    answer = made.open_meteo(offset_s=7200)
    answer["hourly"]["time"] = [int(START_S + 3600 * hour) for hour in range(96)]
    for write in (made.open_meteo_json, made.open_meteo_csv):
        record = read_open_meteo(write(tmp_path / "a", answer))
        np.testing.assert_array_equal(record["ambient_temperature"].time, START_S + 3600.0 * HOUR)
        assert record.warnings == ()


def test_stamps_with_summer_time_are_refused(tmp_path: Path) -> None:
    answer = made.open_meteo(offset_s=3600)
    del answer["hourly"]["time"][30]
    answer["hourly"]["time"].append("2021-03-05T00:00")
    assert "ask for timezone=GMT" in faults(made.open_meteo_json(tmp_path / "a.json", answer))


def test_humidity_without_a_dew_point_and_former_names(tmp_path: Path) -> None:
    answer = made.open_meteo(names=("temperature_2m", "relative_humidity_2m", "wind_speed_10m"))
    for now, former in (("relative_humidity_2m", "relativehumidity_2m"), ("wind_speed_10m", "windspeed_10m")):
        answer["hourly"][former] = answer["hourly"].pop(now)
        answer["hourly_units"][former] = answer["hourly_units"].pop(now)
    record = read_open_meteo(made.open_meteo_json(tmp_path / "a.json", answer))
    found = relative_humidity(
        record["ambient_dew_point_temperature"].value, record["ambient_temperature"].value
    )
    np.testing.assert_allclose(found, 0.01 * truth("relative_humidity_2m"), rtol=1e-6)
    assert record["wind_speed"].height_m == 10.0
    assert any("at 10 m, not at hub height" in said for said in record.warnings)


@pytest.mark.parametrize(("heights", "chosen"), [((10, 80, 120, 180), 120), ((10, 80), 80), ((180, 10), 180)])
def test_the_wind_nearest_to_100_m_is_taken(tmp_path: Path, heights: tuple[int, ...], chosen: int) -> None:
    answer = made.open_meteo(names=("temperature_2m", "dew_point_2m"))
    for height in heights:
        answer["hourly"][f"wind_speed_{height}m"] = [float(height) / 10.0] * 96
        answer["hourly_units"][f"wind_speed_{height}m"] = "m/s"
    wind = read_open_meteo(made.open_meteo_json(tmp_path / "a.json", answer))["wind_speed"]
    assert (wind.height_m, wind.value[0]) == (chosen, chosen / 10.0)


def test_null_is_missing_and_gzip_is_read(tmp_path: Path) -> None:
    answer = made.open_meteo()
    answer["hourly"]["temperature_2m"][5] = None
    path = tmp_path / "site.json.gz"
    path.write_bytes(gzip.compress(json.dumps(answer).encode()))
    assert weather_format(path) == "open_meteo"
    assert list(np.flatnonzero(np.isnan(read_open_meteo(path)["ambient_temperature"].value))) == [5]
    csv = made.open_meteo_csv(tmp_path / "site.csv", answer)
    assert list(np.flatnonzero(np.isnan(read_open_meteo(csv)["ambient_temperature"].value))) == [5]


def test_years_follow_each_other(tmp_path: Path) -> None:
    files = [
        made.open_meteo_json(tmp_path / f"{start}.json", made.open_meteo(start=f"{start}T00:00"))
        for start in ("2021-03-01", "2021-03-05")
    ]
    assert len(read_weather(files)["ambient_temperature"]) == 192


def test_other_files_are_named(tmp_path: Path) -> None:
    answer = made.open_meteo()
    several = made.open_meteo_json(tmp_path / "several.json", [answer, answer])
    assert "holds 2 places" in faults(several)
    strange = made.open_meteo(units={"wind_speed_100m": "furlong", "surface_pressure": "inHg"})
    said = faults(made.open_meteo_json(tmp_path / "strange.json", strange))
    assert 'unknown unit "furlong"' in said and 'unknown unit "inHg"' in said
    none = made.open_meteo(names=("dew_point_2m",))
    assert "no temperature_2m" in faults(made.open_meteo_json(tmp_path / "none.json", none))
    cut = made.open_meteo_csv(tmp_path / "cut.csv", answer)
    cut.write_text(cut.read_text(encoding="utf-8")[:-40], encoding="utf-8")
    assert "cut short" in faults(cut)
    table = tmp_path / "table.csv"
    table.write_text("time,T\n2021-01-01,3\n")
    assert "expected CSV of Open-Meteo" in faults(table)
    refused = tmp_path / "refused.json"
    refused.write_text('{"error":true,"reason":"Daily API request limit exceeded"}')
    assert "error page" in faults(refused)
