"""Plants that hide nothing in other ways, halved causes, effects of no library: stated sizes."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from plants import Plant, undisturbed
from plants.causes_outside import TIDE_H
from plants.convection import convecting_plant
from plants.hidden import GROWTH, hidden_plant
from plants.nulls import (
    BURST_H,
    BURST_K,
    BURST_KG_M3,
    FLUCTUATION,
    FLUCTUATION_H,
    NULLS,
    PROBE_H,
    PROBE_HUMIDITY,
    PROBE_K,
    QUIET,
    change_of,
    null_plant,
)
from plants.saturation import relative_humidity
from plants.scene import Scene
from test_hidden import same, scene_of

DAYS = 170.0
SEEDS = (71, 72, 73, 74)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of(71, DAYS)


def root_mean_square(values: np.ndarray) -> float:
    return math.sqrt(float(np.mean(values**2)))


def correlation_h(values: np.ndarray) -> float:
    """Correlation time [h] of a series at minutes, by its correlation over half an hour."""
    centred = values - values.mean()
    left = float(np.mean(centred[30:] * centred[:-30]) / np.mean(centred**2))
    return -0.5 / math.log(left)


def free_run(made: Plant) -> tuple[float, float]:
    bare = undisturbed(made)
    kelvin = root_mean_square(made.trajectory.cabinet_K - bare.cabinet_K)
    return kelvin, 1e3 * root_mean_square(made.trajectory.cabinet_kg_m3 - bare.cabinet_kg_m3)


def flows(made: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Heat [W] and vapour [kg/s] flows that disturb a plant."""
    drivers = made.drivers
    release = made.cabinet.heat_release(drivers.power_W[:-1], drivers.held_ambient_K, drivers.preheating[:-1])
    return made.forcing.heat_W - release, made.forcing.vapour_kg_s


# --- nulls ----------------------------------------------------------------------------------


def times_h(some: list[np.ndarray]) -> tuple[float, float]:
    """Correlation times [h] of like flows between lags of a half and one hour, and of 6 and 12 hours; white
    kicks have no part in them."""
    moments = np.zeros(4)
    for flow in some:
        smooth = flow[: flow.size // 10 * 10].reshape(-1, 10).mean(axis=1)
        smooth = smooth - smooth.mean()
        lags = (3, 6, 36, 72)
        these = np.array([np.mean(smooth[lag:] * smooth[:-lag]) for lag in lags])
        moments += these / these[0]
    return 0.5 / math.log(moments[0] / moments[1]), 6.0 / math.log(moments[2] / moments[3])


def test_flows_have_two_times_and_err_as_much_as_stated() -> None:
    two = [null_plant(seed, "two_times", days=DAYS) for seed in SEEDS]
    for made in two:
        kelvin, grams = free_run(made)
        assert 1.0 < kelvin < 2.0 and 0.3 < grams < 0.5
        assert made.truth.hidden == () and not made.truth.class_right
    one = [bare(seed) for seed in SEEDS]
    for which in range(2):
        short, long = times_h([flows(made)[which] for made in two])
        assert short < 6.0 and long > 4.0 * short
        short, long = times_h([flows(made)[which] for made in one])
        assert 0.5 < long / short < 2.0


def test_the_probe_wanders_as_stated_and_its_humidity_goes_with_it(scene: Scene) -> None:
    run = scene.trajectory
    told, errors = [], []
    for seed in range(12):
        change = change_of("probe", seed, scene)
        assert not change.inside
        _, seen = change.sees(scene.drivers, run)
        warmth = seen.cabinet_K - run.cabinet_K
        # At equal vapour pressure the humidity falls with the saturation pressure; the rest is the sensor's.
        felt = relative_humidity(run.cabinet_kg_m3 * run.cabinet_K / seen.cabinet_K, seen.cabinet_K)
        error = relative_humidity(seen.cabinet_kg_m3, seen.cabinet_K) - felt
        told.append((np.std(warmth), np.std(error)))
        errors.append(change.parameters["warmth_h"] / correlation_h(warmth))
        for hours in change.parameters.values():
            assert PROBE_H[0] <= hours <= PROBE_H[1]
        assert np.corrcoef(warmth, felt - scene.humidity)[0, 1] < -0.9
    assert np.mean(told, axis=0) == pytest.approx((PROBE_K, PROBE_HUMIDITY), rel=0.06)
    assert np.exp(np.mean(np.log(errors))) == pytest.approx(1.0, abs=0.1)
    assert (PROBE_K, PROBE_HUMIDITY, PROBE_H) == (0.3, 0.02, (1.0, 6.0))


def test_resistances_fluctuate_as_stated(scene: Scene) -> None:
    sizes, times, together = [], [], []
    for seed in range(12):
        change = change_of("resistances", seed, scene)
        factors = (1.0 + change.conductance_W_K * scene.cabinet.outer_resistance, change.exchange)
        logs = [-np.log(factor) for factor in factors]
        sizes.append([np.std(one) for one in logs])
        together.append(np.corrcoef(*logs)[0, 1])
        for one, hours in zip(logs, change.parameters.values(), strict=True):
            assert FLUCTUATION_H[0] <= hours <= FLUCTUATION_H[1]
            times.append(hours / correlation_h(one))
    assert np.mean(sizes, axis=0) == pytest.approx((FLUCTUATION, FLUCTUATION), rel=0.06)
    assert np.exp(np.mean(np.log(times))) == pytest.approx(1.0, abs=0.1)
    assert abs(np.mean(together)) < 0.1
    assert (FLUCTUATION, FLUCTUATION_H) == (0.2, (2.0, 12.0))


def test_bursts_come_one_in_two_days(scene: Scene) -> None:
    counts, lengths = [], []
    resistance = float(scene.cabinet.diffusion_resistance(np.array(scene.drivers.ambient_K.mean())))
    for seed in range(12):
        change = change_of("bursts", seed, scene)
        kelvin = change.heat_W * scene.cabinet.outer_resistance
        counts.append(len(change.dates))
        edges = np.diff(np.concatenate(([0.0], kelvin, [0.0])))
        begins, ends = np.flatnonzero(edges > 0.0), np.flatnonzero(edges < 0.0)
        if len(begins) == len(ends) == len(change.dates):  # none overlap
            lengths += ((ends - begins) / 60.0).tolist()
        assert np.median(kelvin) == 0.0 and np.all((kelvin > 0.0) == (change.vapour_kg_s > 0.0))
        assert kelvin[kelvin > 0.0].min() >= BURST_K[0] - 1e-9
        assert change.vapour_kg_s.max() * resistance >= BURST_KG_M3[0]
    # 12 x 170 days / 2 days: 1,020 bursts with a standard deviation of 32
    assert sum(counts) / 12 == pytest.approx(DAYS / 2.0, rel=0.1)
    assert BURST_H[0] <= min(lengths) + 1.0 / 60.0 and max(lengths) <= BURST_H[1] + 1.0 / 60.0
    assert np.mean(lengths) == pytest.approx(np.mean(BURST_H), rel=0.1)


def test_bursts_apart_share_no_times(scene: Scene) -> None:
    """Heat and vapour come together no more often than chance has it."""
    together = []
    for seed in range(12):
        change = change_of("apart_bursts", seed, scene)
        hot, damp = change.heat_W > 0.0, change.vapour_kg_s > 0.0
        assert 0.02 < hot.mean() < 0.06 and 0.02 < damp.mean() < 0.06
        together.append(np.mean(hot & damp) / (hot.mean() * damp.mean()))
    assert np.mean(together) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("kind", [kind for kind in NULLS if kind != "two_times"])
def test_other_nulls_differ_in_their_readings_alone(kind: str) -> None:
    """Odd seeds have a third of the usual flows; weather, cabinet and loggers are the plant's."""
    even = null_plant(72, kind, days=40.0)
    plain = hidden_plant(72, "none", days=40.0)
    changed = {one.signal for one in plain.series if not same(even, plain, one.signal)}
    assert changed == {"cabinet_temperature", "cabinet_relative_humidity"}
    assert even.cabinet == plain.cabinet and even.truth.hidden == ()
    again = null_plant(72, kind, days=40.0)
    assert all(same(even, again, one.signal) for one in even.series)
    if kind == "probe":
        quiet, loud = free_run(null_plant(71, kind, days=40.0)), free_run(hidden_plant(71, "none", days=40.0))
        assert np.array(quiet) / np.array(loud) == pytest.approx((QUIET, QUIET), rel=0.05)


# --- halved causes --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cause", "form", "name"),
    [
        ("moisture_sorption", 0, "dry_material_kg"),
        ("clock_shift", 0, "late_min"),
    ],
)
def test_halved_is_half_the_amplitude_of_the_same_law(cause: str, form: int, name: str) -> None:
    (whole,) = hidden_plant(5, cause, form=form, days=40.0).truth.hidden
    (half,) = hidden_plant(5, cause, form=form, days=40.0, halved=True).truth.hidden
    assert half.parameters[name] == pytest.approx(0.5 * whole.parameters[name], rel=1e-12)
    others = {key for key in whole.parameters if whole.parameters[key] != half.parameters[key]}
    assert others == {name}
    if "growth" in whole.measure:
        # independent errors add in squares: half of what 30 % more is made of makes 8 %
        assert half.reached < 0.5 * whole.reached
        assert half.rmse_with / half.rmse_without - 1.0 == pytest.approx(GROWTH * half.reached, abs=1e-9)
    else:
        assert half.reached == pytest.approx(0.5 * whole.reached)


def test_summer_time_cannot_be_halved() -> None:
    (half,) = hidden_plant(5, "clock_shift", form=1, days=40.0, halved=True).truth.hidden
    assert half.limited


# --- effects of no library ------------------------------------------------------------------


@cache
def bare(seed: int) -> Plant:
    return hidden_plant(seed, "none", days=DAYS)


def course(cause: str, seed: int = 71) -> tuple[Plant, Plant]:
    """A plant with an effect and the one without it."""
    return hidden_plant(seed, cause, days=DAYS), bare(seed)


def test_the_tide_has_its_period() -> None:
    made, plain = course("tide")
    apart = made.trajectory.cabinet_K - plain.trajectory.cabinet_K
    power = np.abs(np.fft.rfft(apart - apart.mean())) ** 2
    period_h = apart.size / 60.0 / np.argmax(power)
    assert period_h == pytest.approx(TIDE_H, rel=0.01)


def test_the_routine_is_on_two_days_of_a_week() -> None:
    made, plain = course("weekly_routine")
    apart = made.trajectory.cabinet_K - plain.trajectory.cabinet_K
    since = (made.drivers.time / 3600.0 - made.truth.hidden[0].parameters["begin_h"]) / 24.0
    by_day = [apart[np.floor(since).astype(int) % 7 == day].mean() for day in range(7)]
    busy = np.array(by_day) > 0.5 * max(by_day)
    assert busy.sum() == 2 and 0.05 < np.mean(apart > 0.3 * apart.max()) < 0.15


def test_the_load_by_chance_lasts_two_days() -> None:
    counts = [hidden_plant(s, "load_by_chance", days=DAYS).truth.hidden[0].parameters for s in SEEDS[:2]]
    # 85 switchings each, 170 with a standard deviation of 13
    assert np.mean([one["switchings"] for one in counts]) == pytest.approx(DAYS / 2.0, rel=0.2)


def test_falling_pressure_brings_vapour_and_the_wet_filter_takes_exchange() -> None:
    made, plain = course("pressure_leak")
    assert np.all(made.trajectory.cabinet_kg_m3 - plain.trajectory.cabinet_kg_m3 > -1e-7)
    np.testing.assert_allclose(made.trajectory.cabinet_K, plain.trajectory.cabinet_K, atol=1e-4)
    (filter_,) = hidden_plant(71, "wet_filter", days=DAYS).truth.hidden
    assert 0.05 <= filter_.parameters["share"] <= 0.95 and 0.02 < filter_.parameters["fog"] < 0.6


def test_the_lit_sensor_sees_sun_in_its_slit_alone() -> None:
    made, plain = course("sunlit_sensor")
    np.testing.assert_array_equal(made.trajectory.cabinet_K, plain.trajectory.cabinet_K)
    one, two = (p["cabinet_temperature"] for p in (made, plain))
    apart = one.value - two.value
    assert np.nanmax(apart) > 1.0 and 0.02 < np.nanmean(apart > 0.3) < 0.2
    hour = (one.time[np.nan_to_num(apart) > 1.0] / 3600.0) % 24.0
    assert np.ptp(hour) < 6.0
    # the vapour that is there does not change: a warmer probe reads a lower relative humidity
    damp = made["cabinet_relative_humidity"].value - plain["cabinet_relative_humidity"].value
    assert np.nanmax(damp) <= 0.2 and np.nanmin(damp) < -2.0


# --- cabinets of another make ----------------------------------------------------------------


def test_cabinets_of_another_make_hide_nothing_and_differ_from_the_model() -> None:
    """The same weather, power and loggers; another cabinet, whose air is never above saturation and reaches
    it."""
    wet = 0.0
    for seed in range(40, 46):
        made = convecting_plant(seed, days=30.0)
        again = convecting_plant(seed, days=30.0)
        assert np.array_equal(made.trajectory.cabinet_K, again.trajectory.cabinet_K) and not made.truth.hidden
        apart = made.trajectory.cabinet_K - made.drivers.ambient_K
        assert np.isfinite(apart).all() and 0.5 < apart.mean() < 12.0 and apart.max() < 40.0
        celsius = made.trajectory.cabinet_K - 273.15
        saturated = (
            610.94 * np.exp(17.625 * celsius / (243.04 + celsius)) / (461.5 * made.trajectory.cabinet_K)
        )
        humidity = made.trajectory.cabinet_kg_m3 / saturated
        assert humidity.max() <= 1.0 + 1e-9 and humidity.min() > 0.05
        wet += float(np.mean(humidity > 0.999))
        plain = hidden_plant(seed, "none", days=30.0)
        assert np.array_equal(plain.drivers.power_W, made.drivers.power_W)
        assert np.std(made.trajectory.cabinet_K - plain.trajectory.cabinet_K) > 0.3
    assert wet > 0.0
