"""Masks and repairs: what goes, what must stay."""

from __future__ import annotations

import numpy as np
import pytest
from builders.measured import DATA, measured
from hypothesis import given
from hypothesis import strategies as st

from hygrokf.data.readings import (
    detect_resolution,
    mask_gated,
    mask_out_of_range,
    mask_saturated,
    order_readings,
)
from hygrokf.data.record import Series
from hygrokf.data.signals import SIGNALS, difference_to_si, to_si


def series(signal: str, value, step: float = 600.0, unit: str | None = None, **more) -> Series:
    value = np.asarray(value, dtype=float)
    row = SIGNALS[signal]
    unit = unit or row.display
    resolution = difference_to_si(detect_resolution(value), unit, row)
    time = step * np.arange(len(value))
    return Series(signal, time, to_si(value, unit, row), resolution=resolution, **more)


def walk(count: int, spread: float, digits: int, seed: int, mean: float = 20.0) -> np.ndarray:
    """A day's swing and a random walk, as a sensor of so many digits shows it."""
    random = np.random.default_rng(seed)
    swing = 4.0 * np.sin(2 * np.pi * np.arange(count) / 144.0)
    return np.round(mean + swing + np.cumsum(random.normal(0.0, spread, count)), digits)


class TestOrder:
    @given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 3) | st.none()), min_size=1, max_size=40))
    def test_every_stamp_once_in_order_and_only_agreed_readings(self, rows):
        time = np.array([float(one) for one, _ in rows])
        value = np.array([np.nan if two is None else float(two) for _, two in rows])
        ordered, values, _ = order_readings(time, {"a": value})
        np.testing.assert_array_equal(ordered, np.unique(time))
        for stamp, found in zip(ordered, values["a"], strict=True):
            given_values = {two for one, two in rows if one == stamp and two is not None}
            if len(given_values) == 1:
                assert found == given_values.pop()
            else:
                assert np.isnan(found)

    def test_orderly_readings_pass_unsaid(self):
        time = np.arange(5.0)
        assert order_readings(time, {"a": time})[2] == ()

    def test_findings_are_said(self):
        time = np.array([0.0, 60.0, 60.0, 120.0, 30.0, 120.0])
        value = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 4.0])
        ordered, values, (unsorted, duplicate) = order_readings(time, {"T": value})
        np.testing.assert_array_equal(ordered, [0.0, 30.0, 60.0, 120.0])
        np.testing.assert_array_equal(values["T"], [1.0, 5.0, np.nan, 4.0])
        assert "1 of 6" in unsorted
        assert "1970-01-01T00:00:30Z after 1970-01-01T00:02Z" in unsorted
        assert "2 occur more than once" in duplicate
        assert "contradicting ones masked (T: 1)" in duplicate

    def test_newest_first_is_turned_round(self):
        ordered, _, (said,) = order_readings(np.arange(9.0)[::-1], {"a": np.zeros(9)})
        np.testing.assert_array_equal(ordered, np.arange(9.0))
        assert "newest first" in said


class TestResolution:
    @pytest.mark.parametrize(
        "spacing", [1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.0625, 0.02, 0.01, 0.001, 5.0, 10.0]
    )
    @pytest.mark.parametrize("shift", [0.0, 273.15])
    def test_a_grid_is_found(self, spacing, shift):
        count = np.random.default_rng(3).integers(0, 200, 3000)
        assert detect_resolution(shift + spacing * count) == pytest.approx(spacing)

    def test_single_precision_and_sentinels_do_not_matter(self):
        value = np.round(np.random.default_rng(4).normal(10, 5, 5000), 1).astype(np.float32)
        value[::500] = -273.17
        value[1::400] = np.nan
        assert detect_resolution(value.astype(float)) == pytest.approx(0.1)

    @pytest.mark.parametrize(
        "value",
        [
            np.random.default_rng(5).normal(10, 5, 2000),
            np.random.default_rng(5).integers(0, 2, 2000).astype(float),
            np.full(100, 20.0),
            np.array([]),
            np.full(10, np.nan),
        ],
        ids=["continuous", "flag", "constant", "empty", "missing"],
    )
    def test_where_there_is_none(self, value):
        assert detect_resolution(value) == 0.0


class TestRange:
    @pytest.mark.parametrize(
        ("signal", "wrong", "word"),
        [
            ("cabinet_temperature", -273.0, "-273 degC"),
            ("cabinet_temperature", -99.0, "-99 degC"),
            ("cabinet_temperature", 9999.0, "9999 degC"),
            ("ambient_temperature", -273.15, "degC"),
            ("cabinet_relative_humidity", -5.0, "-5 %"),
            ("cabinet_relative_humidity", 150.0, "150 %"),
            ("cabinet_relative_humidity", 0.0, "0 %"),
            ("wind_speed", -1.0, "-1 m/s"),
            ("active_power", 9e9, "kW"),
        ],
    )
    def test_impossible_readings_go_and_are_said(self, signal, wrong, word):
        value = np.array([20.0, wrong, 21.0, 22.0])
        masked, (said,) = mask_out_of_range(series(signal, value))
        np.testing.assert_array_equal(masked.missing, [False, True, False, False])
        assert "1 reading outside" in said
        assert word in said
        assert "1970-01-01T00:10Z" in said

    @pytest.mark.parametrize("signal", SIGNALS)
    def test_the_limits_themselves_stay(self, signal):
        row = SIGNALS[signal]
        one = Series(signal, np.arange(2.0), np.array([row.low, row.high]))
        assert mask_out_of_range(one) == (one, ())

    def test_masking_twice_says_nothing_new(self):
        masked, _ = mask_out_of_range(series("cabinet_temperature", [20.0, -273.0]))
        assert mask_out_of_range(masked) == (masked, ())


class TestSaturated:
    def test_cabinet_humidity_at_the_end_of_the_scale_is_masked(self):
        humidity = np.array([50.0, 99.4, 99.5, 100.0, 103.0, 80.0])
        masked, (said,) = mask_saturated(series("cabinet_relative_humidity", humidity))
        np.testing.assert_array_equal(masked.missing, [False, False, True, True, True, False])
        assert "3 readings" in said
        assert "30 min in all" in said

    def test_a_ceiling_of_the_sensors_own_is_masked(self):
        humidity = np.append(np.linspace(40.0, 97.0, 500), np.full(60, 98.0))
        masked, (said,) = mask_saturated(series("cabinet_relative_humidity", humidity))
        np.testing.assert_array_equal(masked.missing, humidity == 98.0)
        assert "98 %" in said

    def test_saturated_air_read_with_offset_and_noise_is_masked(self):
        random = np.random.default_rng(4)
        damp = random.uniform(40.0, 100.0, 1500)
        wet = 98.6 + 0.35 * random.standard_normal(300)
        humidity = np.round(2.0 * np.concatenate([damp[damp < 98.0], wet])) / 2.0
        masked, (said,) = mask_saturated(series("cabinet_relative_humidity", humidity))
        limit = humidity[masked.missing].min()
        assert 97.5 <= limit <= 98.5 and "saturated humidity" in said
        assert np.mean(masked.missing[-300:]) > 0.9
        assert np.mean(masked.missing[:-300]) < 0.03

    def test_a_merely_humid_cabinet_is_left_alone(self):
        humidity = np.round(np.clip(np.random.default_rng(1).normal(90, 3, 3000), 0, 98.5), 1)
        one = series("cabinet_relative_humidity", np.minimum(humidity, 98.0 + humidity % 0.5))
        assert mask_saturated(one) == (one, ())

    def test_outside_air_may_be_saturated(self):
        kept, (said,) = mask_saturated(series("ambient_relative_humidity", [90.0, np.nan, 100.0, 104.0]))
        np.testing.assert_allclose(kept.value, [0.9, np.nan, 1.0, 1.0])
        assert "1 reading above 100 %" in said
        fog = series("ambient_relative_humidity", np.full(10, 100.0))
        assert mask_saturated(fog) == (fog, ())

    def test_other_signals_are_left_alone(self):
        one = series("heater_duty", [0.0, 1.0])
        assert mask_saturated(one) == (one, ())


class TestFrozen:
    @pytest.mark.parametrize("digits", [1, 2])
    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("hours", [12, 24, 72])
    def test_a_frozen_thermometer_is_found(self, digits, seed, hours):
        value = walk(6000, 0.05, digits, seed)
        length = 6 * hours
        value[2000 : 2000 + length] = value[2000]
        masked, (*_, said) = mask_gated(series("cabinet_temperature", value))
        inside = np.zeros(6000, dtype=bool)
        inside[2001 : 2000 + length] = True
        assert masked.missing[inside].all()
        # The walk itself may go on at the frozen value for a step or two.
        assert masked.missing[~inside].sum() <= 3
        assert not masked.missing[2000]
        assert "frozen sensor, 1 run" in said

    def test_several_frozen_stretches_of_one_length_are_found(self):
        value = walk(6000, 0.05, 1, 7)
        for start in (1000, 2500, 4000):
            value[start : start + 144] = value[start]
        masked, (said,) = mask_gated(series("cabinet_temperature", value))
        assert masked.missing.sum() >= 3 * 143
        assert "3 runs" in said

    def test_gaps_do_not_hide_a_frozen_sensor(self):
        value = walk(6000, 0.05, 1, 8)
        value[2000:2400] = value[2000]
        value[2100:2150] = np.nan
        masked, said = mask_gated(series("cabinet_temperature", value))
        assert said
        assert masked.missing[2001:2400].all()

    @pytest.mark.parametrize("seed", range(6))
    @pytest.mark.parametrize("digits", [0, 1, 2])
    @pytest.mark.parametrize("spread", [0.003, 0.02, 0.2])
    def test_a_slow_or_coarse_thermometer_is_not_frozen(self, seed, digits, spread):
        random = np.random.default_rng(seed)
        value = np.round(15.0 + np.cumsum(random.normal(0.0, spread, 5000)), digits)
        one = series("cabinet_temperature", value)
        masked, said = mask_gated(one)
        assert masked == one
        assert bool(said) == (np.ptp(value) == 0.0)

    def test_a_reading_that_never_changes_is_doubted_and_kept(self):
        one = series("cabinet_temperature", np.full(300, 21.4))
        masked, (said,) = mask_gated(one)
        assert masked == one
        for word in ("cabinet_temperature", "300", "21.4 degC", "perhaps a frozen sensor"):
            assert word in said
        calm = series("wind_speed", np.zeros(300))
        assert mask_gated(calm) == (calm, ())

    def test_means_of_a_coarse_sensor_are_not_frozen(self):
        quiet = np.repeat(walk(300, 0.05, 1, 1), 20) + 0.0
        fine = np.round(quiet.reshape(-1, 5).mean(axis=1) + 0.0, 2)
        one = series("ambient_temperature", fine)
        assert mask_gated(one) == (one, ())

    def test_hourly_readings_repeated_every_ten_minutes_are_not_frozen(self):
        one = series("ambient_temperature", np.repeat(walk(800, 0.5, 2, 1), 6))
        assert mask_gated(one) == (one, ())

    @pytest.mark.parametrize(
        ("signal", "rest", "moving"),
        [
            ("active_power", 0.0, (100.0, 2000.0)),
            ("active_power", -7.3, (100.0, 2000.0)),
            ("global_horizontal_irradiance", 0.0, (10.0, 900.0)),
            ("wind_speed", 0.0, (1.0, 20.0)),
            ("cabinet_relative_humidity", 100.0, (40.0, 90.0)),
            ("ambient_relative_humidity", 100.0, (40.0, 90.0)),
            ("rain", 0.0, (0.1, 4.0)),
            ("preheating", 1.0, (0.0, 1.0)),
            ("heater_duty", 0.0, (0.1, 1.0)),
            ("fan_duty", 0.4, (0.0, 1.0)),
        ],
    )
    def test_readings_that_may_rest_are_left_alone(self, signal, rest, moving):
        value = np.round(np.random.default_rng(2).uniform(*moving, 3000), 2)
        value[1000:1600] = rest
        one = series(signal, value)
        assert mask_gated(one) == (one, ())

    def test_power_frozen_in_operation_is_found(self):
        value = np.round(np.random.default_rng(2).uniform(100.0, 2000.0, 3000), 1)
        value[1000:1600] = 812.3
        assert mask_gated(series("active_power", value))[0].missing.sum() == 599

    def test_a_sensor_frozen_for_most_of_the_record_is_said_but_not_masked(self):
        value = walk(3000, 0.05, 1, 3)
        value[500:2500] = value[500]
        one = series("cabinet_temperature", value)
        kept, (said,) = mask_gated(one)
        assert kept == one
        assert "not masked" in said

    def test_few_readings_are_left_alone(self):
        one = series("cabinet_temperature", np.full(40, 20.0))
        assert mask_gated(one) == (one, ())

    def test_masking_twice_says_nothing_new(self):
        value = walk(6000, 0.05, 1, 8)
        value[2000:2400] = value[2000]
        masked, _ = mask_gated(series("cabinet_temperature", value))
        assert mask_gated(masked) == (masked, ())


def _column(file: str, column: str) -> np.ndarray:
    import pandas as pd

    return pd.read_csv(DATA / file)[column].to_numpy(dtype=float, copy=True)


ATTIC = [
    (f"attic_trh1_{house}_hourly.csv.gz", column, signal, 3600.0)
    for house in ("R2", "R4", "R7")
    for column, signal in (
        ("T_fmi", "ambient_temperature"),
        ("RH_fmi", "ambient_relative_humidity"),
        ("Rglob", "global_horizontal_irradiance"),
        ("ws", "wind_speed"),
        ("wd", "wind_direction"),
        ("T_roofmiddle_airmiddle", "cabinet_temperature"),
        ("RH_roofmiddle_airmiddle", "cabinet_relative_humidity"),
        ("T_roofmiddle_airtop", "cabinet_temperature"),
        ("RH_roofmiddle_airtop", "cabinet_relative_humidity"),
        ("T_indoor1", "nacelle_temperature"),
        ("RH_indoor1", "nacelle_relative_humidity"),
    )
]
TURBINES = [
    ("la_haute_borne_R80736_10min_2014_2015.csv.gz", "Ot_avg", "ambient_temperature", 600.0),
    ("la_haute_borne_R80736_10min_2014_2015.csv.gz", "P_avg", "active_power", 600.0),
    ("la_haute_borne_R80736_10min_2014_2015.csv.gz", "Ws_avg", "wind_speed", 600.0),
    ("kelmarsh_2018_2019_era5_power_hourly.csv.gz", "T2m_C", "ambient_temperature", 3600.0),
    ("kelmarsh_2018_2019_era5_power_hourly.csv.gz", "P_K2_kW", "active_power", 3600.0),
    ("house_uci_energy_10min.csv.gz", "T7", "cabinet_temperature", 600.0),
    ("house_uci_energy_10min.csv.gz", "T9", "cabinet_temperature", 600.0),
    ("house_uci_energy_10min.csv.gz", "RH_8", "cabinet_relative_humidity", 600.0),
]


@measured
@pytest.mark.parametrize(("file", "column", "signal", "step"), ATTIC + TURBINES)
def test_clean_measured_series_lose_nothing(file, column, signal, step):
    """One reading in 14,000 is suspected over all series, four times as many in any one of them."""
    one = series(signal, _column(file, column), step)
    kept, said = mask_gated(one)
    assert (kept.missing & ~one.missing).sum() <= max(2, 3e-4 * len(one))
    assert not any("frozen" in sentence for sentence in said)
    assert mask_out_of_range(one) == (one, ())


@measured
@pytest.mark.parametrize("start", [1500, 4000, 9000, 12000])
@pytest.mark.parametrize("column", ["T_roofmiddle_airmiddle", "T_roofmiddle_airtop"])
def test_a_frozen_day_in_the_attic_is_found(column, start):
    value = _column("attic_trh1_R2_hourly.csv.gz", column)
    value[start : start + 30] = value[start]
    masked, _ = mask_gated(series("cabinet_temperature", value, 3600.0))
    assert masked.missing[start + 1 : start + 30].all()
    assert masked.missing.sum() <= 31


@measured
def test_the_logger_that_really_froze_is_found():
    # Ten identical readings to 0.01 K at noon in August, where neighbours move by kelvins.
    value = _column("attic_trh1_R7_hourly.csv.gz", "T_roofeast_airtop")
    masked, _ = mask_gated(series("cabinet_temperature", value, 3600.0))
    assert (masked.missing & np.isfinite(value)).sum() == 9
