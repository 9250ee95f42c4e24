"""Probes: what belongs together, and what was read twice."""

from __future__ import annotations

import numpy as np
import pytest

from hygrokf.data.probes import copies, probe_of
from hygrokf.data.record import Series
from hygrokf.texts.record_codes import DoubtCode

TIME = 1.6e9 + 600.0 * np.arange(600.0)
DRAW = np.random.default_rng(4)
WARM = 20.0 + 5.0 * np.sin(TIME / 13e3) + DRAW.normal(0, 0.1, 600)
MOIST = 50.0 + 10.0 * np.sin(TIME / 21e3) + DRAW.normal(0, 0.5, 600)


@pytest.mark.parametrize(
    ("name", "probe", "quantity"),
    [
        ("Temperature (°C)", "", "temperature"),
        ("RH (%)", "", "relative_humidity"),
        ("Dew Point (°C)", "", "dew_point_temperature"),
        ("Ch2 DewPoint_C", "ch 2", "dew_point_temperature"),
        ("Ch2 RH", "ch 2", "relative_humidity"),
        ("T_cab", "cab", "temperature"),
        ("Feuchte [%rF]", "", "relative_humidity"),
        ("Power (kW)", "power", ""),
    ],
)
def test_the_probe_of_a_column(name, probe, quantity):
    assert probe_of(name) == (probe, quantity)


def dew_point(celsius: np.ndarray, percent: np.ndarray) -> np.ndarray:
    """Magnus' formula with other constants than the package's [degC]."""
    gamma = np.log(percent / 100.0) + 17.27 * celsius / (237.7 + celsius)
    return 237.7 * gamma / (17.27 - gamma)


def of_logger() -> list[Series]:
    return [
        Series("cabinet_temperature", TIME, WARM.round(2) + 273.15, source="log.csv, T"),
        Series("cabinet_relative_humidity", TIME, MOIST.round(1) / 100.0, source="log.csv, RH"),
    ]


def test_a_dew_point_of_the_cabinet_s_own_readings_is_found():
    own = Series(
        "ambient_dew_point_temperature", TIME, dew_point(WARM, MOIST).round(1) + 273.15, source="log.csv, DP"
    )
    (doubt,) = copies([*of_logger(), own])
    assert doubt.code is DoubtCode.COMPUTED_FROM_CABINET and doubt.values["signal"] == own.signal
    sources = [doubt.values[name] for name in ("temperature_source", "humidity_source", "source")]
    assert sources == [f"log.csv, {one}" for one in ("T", "RH", "DP")]


def test_a_dew_point_of_the_air_outside_is_none():
    """Its vapour is the cabinet's half an hour ago, and of sensors of its own."""
    late = dew_point(np.roll(WARM, -3), np.roll(MOIST, -3)) + DRAW.normal(0, 0.2, 600)
    outside = Series("ambient_dew_point_temperature", TIME, late.round(1) + 273.15)
    assert not list(copies([*of_logger(), outside]))
