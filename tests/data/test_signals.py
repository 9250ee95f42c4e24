"""The signal table, units and their page."""

from __future__ import annotations

import math

import numpy as np
import pytest
from builders.documents import document
from handbook.signal_table import signal_table_markdown
from hypothesis import given
from hypothesis import strategies as st

from hygrokf.data.signals import (
    SIGNALS,
    UNITS,
    difference_from_si,
    difference_to_si,
    fitting_units,
    from_si,
    in_words,
    signal_named,
    to_si,
    unit_fault,
)
from hygrokf.errors import near_names

PAIRS = [(name, unit) for name in SIGNALS for unit in fitting_units(name)]


def test_docs_page_is_made_from_the_table():
    page = document("signals.md")
    assert page.read_text(encoding="utf-8") == signal_table_markdown()


@pytest.mark.parametrize("signal", SIGNALS.values(), ids=lambda row: row.name)
def test_every_row_of_the_table_is_sound(signal):
    assert signal.low < signal.high
    assert signal.meaning
    assert signal.unit in UNITS
    assert UNITS[signal.unit].factor == 1.0
    assert UNITS[signal.unit].offset == 0.0
    assert signal.display in fitting_units(signal)
    if signal.idle is not None:
        assert signal.idle[0] < signal.idle[1]


def test_units_of_the_issue_are_all_there():
    assert set("K degC degF % 1 Pa hPa kPa W kW MW g/m3 kg/m3 m/s W/m2 mm".split()) <= set(UNITS)


@pytest.mark.parametrize(
    ("value", "unit", "signal", "expected"),
    [
        (0.0, "degC", "cabinet_temperature", 273.15),
        (-40.0, "degF", "ambient_temperature", 233.15),
        (212.0, "degF", "cabinet_temperature", 373.15),
        (300.0, "K", "cabinet_temperature", 300.0),
        (55.0, "%", "cabinet_relative_humidity", 0.55),
        (1013.25, "hPa", "ambient_pressure", 101325.0),
        (101.325, "kPa", "ambient_pressure", 101325.0),
        (2.05, "MW", "active_power", 2.05e6),
        (-7.0, "kW", "active_power", -7e3),
        (12.8, "g/m3", "cabinet_absolute_humidity", 0.0128),
        (1.5, "mm", "rain", 1.5),
        (180.0, "deg", "wind_direction", math.pi),
        (60.0, "rpm", "rotor_speed", 2.0 * math.pi),
    ],
)
def test_known_values_in_si(value, unit, signal, expected):
    assert to_si(np.array([value]), unit, signal)[0] == pytest.approx(expected, rel=1e-12)


@given(pair=st.sampled_from(PAIRS), values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=5))
def test_from_si_is_the_inverse_of_to_si(pair, values):
    signal, unit = pair
    there = to_si(np.array(values), unit, signal)
    np.testing.assert_allclose(from_si(there, unit, signal), values, rtol=1e-9, atol=1e-6)


@given(pair=st.sampled_from(PAIRS), one=st.floats(-1e3, 1e3), size=st.floats(0, 1e3))
def test_difference_is_the_difference_of_two_values(pair, one, size):
    signal, unit = pair
    low, high = to_si(np.array([one, one + size]), unit, signal)
    difference = difference_to_si(size, unit, signal)
    scale = abs(low) + abs(high) + 1.0
    assert difference == pytest.approx(high - low, abs=1e-11 * scale)
    assert difference_from_si(difference, unit, signal) == pytest.approx(size, rel=1e-12)


def test_degf_accuracy_is_scaled_without_offset():
    assert difference_to_si(0.9, "degF", "cabinet_temperature") == pytest.approx(0.5)


def test_missing_values_stay_missing():
    assert np.isnan(to_si(np.array([np.nan]), "degC", "cabinet_temperature")).all()


def test_unit_of_another_dimension_lists_what_fits():
    with pytest.raises(ValueError, match=r"\"Pa\" is one of pressure.*K, degC, degF"):
        to_si(np.zeros(1), "Pa", "cabinet_temperature")


@pytest.mark.parametrize(
    ("unit", "signal", "meant"),
    [
        ("°C", "cabinet_temperature", "degC"),
        ("C", "cabinet_temperature", "degC"),
        ("mbar", "ambient_pressure", "hPa"),
        ("percent", "cabinet_relative_humidity", "%"),
        ("g/m³", "cabinet_absolute_humidity", "g/m3"),
        ("kw", "active_power", "kW"),
    ],
)
def test_unknown_unit_suggests_the_one_meant(unit, signal, meant):
    fault = unit_fault(unit, signal)
    assert "unknown unit" in fault
    assert f'did you mean "{meant}"?' in fault


def test_rain_takes_millimetres_and_wind_does_not():
    assert unit_fault("mm", "rain") is None
    assert unit_fault("1", "rain") is None
    assert unit_fault("mm", "wind_speed") is not None


def test_unknown_signal_names_near_ones():
    with pytest.raises(KeyError, match="cabinet_temperature"):
        signal_named("cabinet_temprature")


def test_default_accuracies_are_the_loggers():
    assert signal_named("cabinet_temperature").default_accuracy == 0.3
    assert signal_named("cabinet_relative_humidity").default_accuracy == 0.02
    assert signal_named("active_power").default_accuracy is None


def test_values_in_words_use_the_shown_unit():
    assert in_words(0.15, "cabinet_temperature") == "-273 degC"
    assert in_words(1.5, "cabinet_relative_humidity") == "150 %"
    assert in_words(0.5, "heater_duty") == "0.5"


def test_near_names_ignore_case_and_keep_order():
    assert near_names("TEMP", ["time", "Temp", "RH"])[0] == "Temp"
    assert near_names("xyz", ["time", "Temp"]) == []
