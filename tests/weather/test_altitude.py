"""From a station's height to the site's, against the standard atmosphere and the hydrostatic equation
itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders.moist_air import humidity_ratio
from hypothesis import given
from hypothesis import strategies as some
from scipy.integrate import solve_ivp

from hygrokf.data.record import Record, Series, Site
from hygrokf.physics.psychrometrics import saturation_pressure_water
from hygrokf.weather.site_weather import at_altitude, pressure_ratio

TIME = 3600.0 * np.arange(4)
WARM = np.array([263.15, 278.15, 288.15, 303.15])
DEW = np.array([262.0, 270.0, 285.0, 290.0])
PRESSURE = np.array([98000.0, 97000.0, 98500.0, 97500.0])


def record() -> Record:
    return Record(
        "station",
        (
            Series("ambient_temperature", TIME, WARM),
            Series("ambient_dew_point_temperature", TIME, DEW),
            Series("ambient_pressure", TIME, PRESSURE),
            Series("wind_speed", TIME, np.arange(4.0)),
        ),
        Site(45.0, 8.0, 250.0),
    )


def test_the_standard_atmosphere() -> None:
    """ICAO (Doc 7488): 898.74 hPa at 1000 m and 794.95 hPa at 2000 m of geopotential height."""
    for height, pressure in ((1000.0, 89874.6), (2000.0, 79495.2)):
        assert 101325.0 * pressure_ratio(288.15, height) == pytest.approx(pressure, rel=1e-4)


@given(
    some.floats(240.0, 310.0),
    some.floats(-2000.0, 2000.0),
    some.sampled_from([0.0065, 0.0, -0.005, 0.0098, 1e-7]),
)
def test_hydrostatic_balance(kelvin: float, rise: float, lapse: float) -> None:
    solved = solve_ivp(
        lambda z, p: -9.80665 * p / (287.05 * (kelvin - lapse * z)),
        (0.0, rise),
        [1.0],
        rtol=1e-10,
        atol=1e-12,
    )
    assert pressure_ratio(kelvin, rise, lapse) == pytest.approx(solved.y[0, -1], rel=1e-7)


@pytest.mark.parametrize("altitude", [0.0, 400.0, 1200.0])
def test_the_mixing_ratio_stays(altitude: float) -> None:
    moved = at_altitude(record(), altitude, 250.0)
    assert moved["ambient_temperature"].value == pytest.approx(WARM - 0.0065 * (altitude - 250.0))
    before = humidity_ratio(saturation_pressure_water(DEW), PRESSURE)
    after = humidity_ratio(
        saturation_pressure_water(moved["ambient_dew_point_temperature"].value),
        moved["ambient_pressure"].value,
    )
    saturated = moved["ambient_dew_point_temperature"].value >= moved["ambient_temperature"].value - 1e-9
    assert after[~saturated] == pytest.approx(before[~saturated], rel=1e-9)
    assert (after[saturated] < before[saturated]).all()
    assert (moved["ambient_dew_point_temperature"].value <= moved["ambient_temperature"].value + 1e-9).all()
    assert saturated.any() == (altitude == 1200.0)
    assert any("became saturated" in said for said in moved.warnings) == (altitude == 1200.0)
    assert moved["wind_speed"] == record()["wind_speed"]
    assert moved.site.altitude_m == altitude


def test_there_and_back() -> None:
    # downwards first, where nothing condenses
    again = at_altitude(at_altitude(record(), 0.0, 250.0), 250.0, 0.0)
    for signal in ("ambient_temperature", "ambient_dew_point_temperature", "ambient_pressure"):
        assert again[signal].value == pytest.approx(record()[signal].value, rel=1e-9)


def test_missing_readings_stay_missing() -> None:
    one = record()
    value = one["ambient_dew_point_temperature"].value.copy()
    value[2] = np.nan
    one = one.replace_series(replace(one["ambient_dew_point_temperature"], value=value))
    assert list(at_altitude(one, 500.0, 250.0)["ambient_dew_point_temperature"].missing) == [
        False,
        False,
        True,
        False,
    ]


def test_the_lapse_rate_is_per_metre() -> None:
    with pytest.raises(ValueError, match="lapse_rate"):
        at_altitude(record(), 300.0, 250.0, lapse_rate=6.5)
