"""Psychrometrics against published values, other formulas, round trips and complex steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from builders.moist_air import humidity_ratio, specific_humidity
from hypothesis import given
from hypothesis import strategies as st

from hygrokf.physics import psychrometrics as air

ZERO = 273.15
COMPLEX_STEP = 1e-30

temperatures = st.floats(193.15, 373.15)
cabinet_temperatures = st.floats(243.15, 343.15)
fractions = st.floats(0.0, 1.2)
pressures = st.floats(5.0e4, 1.1e5)


def wagner_pruss(temperature: np.ndarray) -> np.ndarray:
    """Saturation pressure over water [Pa] above 0 degC (Wagner and Pruss 1993, equation 1)."""
    tau = 1.0 - temperature / 647.096
    series = (
        -7.85951783 * tau
        + 1.84408259 * tau**1.5
        - 11.7866497 * tau**3
        + 22.6807411 * tau**3.5
        - 15.9618719 * tau**4
        + 1.80122502 * tau**7.5
    )
    return 22.064e6 * np.exp(647.096 / temperature * series)


def murphy_koop(temperature: np.ndarray) -> np.ndarray:
    """Saturation pressure over supercooled water [Pa] (Murphy and Koop 2005, equation 10)."""
    logarithm = np.log(temperature)
    upper = 54.842763 - 6763.22 / temperature - 4.210 * logarithm + 0.000367 * temperature
    lower = 53.878 - 1331.22 / temperature - 9.44523 * logarithm + 0.014025 * temperature
    return np.exp(upper + np.tanh(0.0415 * (temperature - 218.8)) * lower)


def sublimation(temperature: np.ndarray) -> np.ndarray:
    """Saturation pressure over ice [Pa] (IAPWS R14-08(2011), equation 6)."""
    theta = temperature / 273.16
    series = (
        -21.2144006 * theta**0.00333333333 + 27.3203819 * theta**1.20666667 - 6.10598130 * theta**1.70333333
    )
    return 611.657 * np.exp(series / theta)


@pytest.mark.parametrize(
    ("celsius", "published"),
    [(0.0, 611.21), (20.0, 2339.3), (40.0, 7384.9), (60.0, 19946.0), (80.0, 47414.0)],
)
def test_water_agrees_with_iapws_95(celsius: float, published: float) -> None:
    assert air.saturation_pressure_water(celsius + ZERO) == pytest.approx(published, rel=1e-4)


def test_water_agrees_with_wagner_pruss_up_to_boiling() -> None:
    kelvin = np.linspace(273.16, 373.15, 201)
    np.testing.assert_allclose(air.saturation_pressure_water(kelvin), wagner_pruss(kelvin), rtol=3e-5)


def test_water_agrees_with_murphy_koop_when_supercooled() -> None:
    kelvin = np.linspace(ZERO - 40.0, ZERO, 81)
    ratio = air.saturation_pressure_water(kelvin) / murphy_koop(kelvin) - 1.0
    assert np.all(np.abs(ratio[kelvin >= ZERO - 30.0]) < 2e-3)
    assert np.all(np.abs(ratio) < 7e-3)


def test_ice_agrees_with_iapws_sublimation() -> None:
    # The check value of IAPWS R14-08(2011) itself; it guards the oracle below as well.
    assert sublimation(np.array(230.0)) == pytest.approx(8.94735, rel=1e-5)
    assert air.saturation_pressure_ice(230.0) == pytest.approx(8.94735, rel=4e-4)
    kelvin = np.linspace(ZERO - 40.0, 273.16, 201)
    np.testing.assert_allclose(air.saturation_pressure_ice(kelvin), sublimation(kelvin), rtol=3.4e-4)


def test_water_and_ice_meet_at_the_triple_point() -> None:
    assert air.saturation_pressure_water(273.16) == pytest.approx(611.657, rel=2e-5)
    assert air.saturation_pressure_ice(273.16) == pytest.approx(611.657, rel=2e-5)


def test_ice_lies_below_water_under_the_triple_point() -> None:
    kelvin = np.linspace(193.15, 273.0, 50)
    assert np.all(air.saturation_pressure_ice(kelvin) < air.saturation_pressure_water(kelvin))


@pytest.mark.parametrize(
    ("celsius", "grams"),
    # Saturated absolute humidity [g/m3], from the IAPWS-95 pressures above and the ideal gas law.
    [(0.0, 4.849), (20.0, 17.291), (40.0, 51.10)],
)
def test_saturated_absolute_humidity(celsius: float, grams: float) -> None:
    assert 1e3 * air.absolute_humidity(1.0, celsius + ZERO) == pytest.approx(grams, rel=2e-4)


def test_two_percent_at_fifteen_degrees() -> None:
    # The share of sensor accuracy that the paper's 2 % relative humidity stands for.
    assert 1e3 * air.absolute_humidity(0.02, 15.0 + ZERO) == pytest.approx(0.26, abs=0.005)


def test_known_dew_point_and_frost_point() -> None:
    assert air.dew_point(2339.3) == pytest.approx(20.0 + ZERO, abs=2e-3)
    assert air.dew_point(611.21) == pytest.approx(ZERO, abs=2e-3)
    assert air.frost_point(8.94735) == pytest.approx(230.0, abs=5e-3)


def test_humidity_ratio_and_specific_humidity_of_saturated_air() -> None:
    # 20 degC saturated at 101,325 Pa: 14.7 g/kg in every psychrometric chart.
    ratio = 0.014698
    assert air.vapour_pressure_from_humidity_ratio(ratio, 101325.0) == pytest.approx(2339.3, rel=1e-3)
    fraction = ratio / (1.0 + ratio)
    assert air.vapour_pressure_from_specific_humidity(fraction, 101325.0) == pytest.approx(2339.3, rel=1e-3)


@given(temperatures)
def test_dew_point_inverts_saturation_over_water(kelvin: float) -> None:
    assert air.dew_point(air.saturation_pressure_water(kelvin)) == pytest.approx(kelvin, rel=1e-10)


@given(st.floats(193.15, 273.16))
def test_frost_point_inverts_saturation_over_ice(kelvin: float) -> None:
    assert air.frost_point(air.saturation_pressure_ice(kelvin)) == pytest.approx(kelvin, rel=1e-10)


def test_inverses_hold_at_the_bounds_of_the_range() -> None:
    for bound in air.WATER_RANGE:
        assert air.dew_point(air.saturation_pressure_water(bound)) == pytest.approx(bound, rel=1e-10)
    for bound in air.ICE_RANGE:
        assert air.frost_point(air.saturation_pressure_ice(bound)) == pytest.approx(bound, rel=1e-10)


@given(fractions, temperatures)
def test_relative_and_absolute_humidity_round_trip(fraction: float, kelvin: float) -> None:
    concentration = air.absolute_humidity(fraction, kelvin)
    assert air.relative_humidity(concentration, kelvin) == pytest.approx(fraction, rel=1e-12)
    pressure = air.vapour_pressure(fraction, kelvin)
    assert air.absolute_humidity_from_vapour_pressure(pressure, kelvin) == pytest.approx(
        concentration, rel=1e-12
    )
    assert air.vapour_pressure_from_absolute_humidity(concentration, kelvin) == pytest.approx(
        pressure, rel=1e-12
    )


@given(st.floats(0.01, 1.0), st.floats(248.15, 343.15))
def test_dew_point_round_trip_through_humidity(fraction: float, kelvin: float) -> None:
    dew = air.dew_point(air.vapour_pressure(fraction, kelvin))
    assert dew <= kelvin * (1.0 + 1e-12)
    assert air.absolute_humidity_from_dew_point(dew, kelvin) == pytest.approx(
        air.absolute_humidity(fraction, kelvin), rel=1e-9
    )


@given(st.floats(0.0, 2.0e4), pressures)
def test_mass_fractions_round_trip(vapour: float, pressure: float) -> None:
    ratio = humidity_ratio(vapour, pressure)
    fraction = specific_humidity(vapour, pressure)
    assert fraction == pytest.approx(ratio / (1.0 + ratio), rel=1e-12)
    assert air.vapour_pressure_from_humidity_ratio(ratio, pressure) == pytest.approx(
        vapour, rel=1e-9, abs=1e-9
    )
    assert air.vapour_pressure_from_specific_humidity(fraction, pressure) == pytest.approx(
        vapour, rel=1e-9, abs=1e-9
    )


@given(temperatures)
def test_saturation_slope_over_water_is_the_derivative(kelvin: float) -> None:
    step = 1e-3
    inside = min(max(kelvin, 193.2), 373.1)
    difference = (
        air.saturation_pressure_water(inside + step) - air.saturation_pressure_water(inside - step)
    ) / (2.0 * step)
    slope = air.saturation_pressure_water_slope(inside)
    assert slope == pytest.approx(difference, rel=1e-6)
    exact = air.saturation_pressure_water(inside + COMPLEX_STEP * 1j).imag / COMPLEX_STEP
    assert slope == pytest.approx(exact, rel=1e-12)


@given(st.floats(193.15, 273.16))
def test_saturation_slope_over_ice_is_the_derivative(kelvin: float) -> None:
    exact = air.saturation_pressure_ice(kelvin + COMPLEX_STEP * 1j).imag / COMPLEX_STEP
    assert air.saturation_pressure_ice_slope(kelvin) == pytest.approx(exact, rel=1e-12)


@given(st.floats(0.01, 1.0), cabinet_temperatures)
def test_absolute_humidity_slope_is_the_derivative(fraction: float, kelvin: float) -> None:
    exact = air.absolute_humidity(fraction, kelvin + COMPLEX_STEP * 1j).imag / COMPLEX_STEP
    assert air.absolute_humidity_slope_temperature(fraction, kelvin) == pytest.approx(exact, rel=1e-11)


def test_complex_steps_pass_through_the_inverse() -> None:
    kelvin = np.array([230.0, 280.0, 350.0])
    pressure = air.saturation_pressure_water(kelvin)
    slope = air.dew_point(pressure + COMPLEX_STEP * 1j).imag / COMPLEX_STEP
    np.testing.assert_allclose(slope, 1.0 / air.saturation_pressure_water_slope(kelvin), rtol=1e-10)


@pytest.mark.parametrize("argument", [math.nan, math.inf, -math.inf, 0.0, -5.0, 20.0, 173.0, 373.2])
def test_outside_the_range_of_temperature_is_nan(argument: float) -> None:
    for function in (
        air.saturation_pressure_water,
        air.saturation_pressure_water_slope,
        air.saturation_pressure_ice,
        air.saturation_pressure_ice_slope,
    ):
        assert math.isnan(function(argument)), function.__name__
    for function in (
        air.absolute_humidity,
        air.vapour_pressure,
        air.relative_humidity,
        air.absolute_humidity_slope_temperature,
    ):
        assert math.isnan(function(0.01, argument)), function.__name__


def test_ice_ends_at_the_triple_point() -> None:
    assert math.isnan(air.saturation_pressure_ice(273.17))
    assert math.isnan(air.frost_point(612.0))


@pytest.mark.parametrize("argument", [math.nan, math.inf, 0.0, -1.0, 1.1e5])
def test_outside_the_range_of_pressure_is_nan(argument: float) -> None:
    assert math.isnan(air.dew_point(argument))
    assert math.isnan(air.frost_point(argument))


def test_impossible_mixtures_are_nan() -> None:
    assert math.isnan(air.vapour_pressure_from_humidity_ratio(-0.1, 1.0e5))
    assert math.isnan(air.vapour_pressure_from_specific_humidity(1.1, 1.0e5))
    assert math.isnan(air.absolute_humidity_from_vapour_pressure(1000.0, 0.0))
    assert math.isnan(air.vapour_pressure_from_absolute_humidity(0.01, -1.0))


def test_missing_values_stay_where_they_are() -> None:
    kelvin = np.array([280.0, np.nan, 300.0])
    fraction = np.array([0.5, 0.5, np.nan])
    for result in (
        air.absolute_humidity(fraction, kelvin),
        air.relative_humidity(0.01 * fraction, kelvin),
        air.absolute_humidity_from_dew_point(kelvin - 5.0 + 0.0 * fraction, kelvin),
        air.vapour_pressure_from_humidity_ratio(0.01 * fraction, 340.0 * kelvin),
    ):
        assert np.isfinite(result[0])
        assert np.isnan(result[1:]).all()


def test_floats_give_floats_and_arrays_broadcast() -> None:
    assert isinstance(air.absolute_humidity(0.5, 290.0), float)
    assert isinstance(air.dew_point(1000), float)
    table = air.absolute_humidity(np.array([[0.2], [0.8]]), np.array([280.0, 290.0, 300.0]))
    assert table.shape == (2, 3)
    assert table[1, 2] == air.absolute_humidity(0.8, 300.0)
