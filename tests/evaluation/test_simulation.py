"""Free runs and forecasts against plants, Monte-Carlo and the filter with its later readings hidden."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from builders.known_values import RELEASE, physical_values, with_reference
from builders.record_edits import without
from numpy.testing import assert_allclose
from plants import plant, undisturbed
from plants.as_record import to_record

from hygrokf.estimation.likelihood import Gaussian, Likelihood
from hygrokf.evaluation.simulation import (
    QUANTITIES,
    forecasts,
    free_run,
    measured,
    predicted_readings,
    project,
)
from hygrokf.modelling.design import Design, design
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.psychrometrics import absolute_humidity

EXACT = {"sensor_errors": "none", "missing": 0.0, "ambient_humidity": "absolute", "disturbance": "none"}
VALUES = {
    "thermal_time_constant": 1.5,
    "resistance_ratio": 0.85,
    **RELEASE,
    "heat_disturbance_sd": 1.2,
    "heat_disturbance_time": 5.0,
    "thermal_diffusion": 0.07,
    "cabinet_temperature_bias": 0.0,
    "cabinet_temperature_noise": 0.06,
    "hygric_k": 0.32,
    "vapour_disturbance_sd": 0.3,
    "vapour_disturbance_time": 4.0,
    "hygric_diffusion": 0.03,
    "cabinet_relative_humidity_bias": 0.0,
    "cabinet_relative_humidity_noise": 0.004,
}


def parameters(base: Design, **changes: float) -> dict[str, float]:
    return {p.name: changes.get(p.name, VALUES.get(p.name, p.start)) for p in base.model.parameters}


def of_plant(made) -> dict[str, float]:
    """True parameters of a plant, by the package's names; its reference temperature is 283.15 K."""
    return VALUES | physical_values(made.truth)


@pytest.fixture(scope="module")
def exact():
    """A plant without disturbances and sensor errors, its record, design and true values."""
    made = plant(21, days=20, **EXACT)
    record = to_record(made)
    base = with_reference(design(record))
    return made, record, base, parameters(base, **of_plant(made))


@pytest.fixture(scope="module")
def noisy():
    """A plant with everything on: its record, design, run and parameters."""
    record = to_record(plant(22, days=20))
    base = design(record)
    return record, base, model_inputs(base, record), parameters(base)


# --- free run -------------------------------------------------------------------------------


def test_free_run_is_the_plants_own_trajectory(exact):
    """With the true parameters, from the second day on: 0.01 K and 0.01 g/m³.

    The plant integrates watts and kilograms each minute by Runge–Kutta, with another saturation formula;
    absolute humidities are compared, the ambient one is read as such.
    """
    made, record, base, values = exact
    driven = model_inputs(base, record)
    found = free_run(base, values, driven)
    truth = undisturbed(made)
    seconds = driven.timeline.seconds
    settled = driven.timeline.time > 24.0
    for value, true in (
        (found.temperature[0], truth.cabinet_K),
        (found.absolute_humidity[0], 1e3 * truth.cabinet_kg_m3),
    ):
        expected = np.interp(seconds, made.drivers.time, true)
        assert np.max(np.abs(value - expected)[settled]) < 0.01
        assert np.std(expected[settled]) > 1.0


def test_quantities_that_a_model_lacks_are_none(noisy):
    record, *_ = noisy
    thermal = design(record, kind="thermal")
    found = free_run(thermal, parameters(thermal), model_inputs(thermal, record))
    assert found.of("relative_humidity") is None
    assert found.of("absolute_humidity_g_m3") is None
    assert found.of("temperature_K") is found.temperature
    cascade = design(record, kind="cascade")
    driven = model_inputs(cascade, record)
    found = free_run(cascade, parameters(cascade), driven)
    assert found.temperature is None
    warm = driven.timeline.input("cabinet_temperature")
    assert_allclose(found.absolute_humidity[0], 1e3 * absolute_humidity(found.relative_humidity[0], warm))


def test_a_logger_may_read_absolute_humidity(noisy):
    record, own, run, values = noisy
    moist = record["cabinet_relative_humidity"]
    kelvin = np.interp(moist.time, *record["cabinet_temperature"].known)
    grams = replace(
        moist,
        signal="cabinet_absolute_humidity",
        value=absolute_humidity(moist.value, kelvin),
        resolution=0.0,
    )
    other = replace(record, series=(*without(record, moist.signal).series, grams))
    base = design(other)
    driven = model_inputs(base, other)
    found = free_run(base, parameters(base), driven)
    assert found.relative_humidity is None
    usual = free_run(own, values, run)
    assert np.isin(driven.timeline.time, run.timeline.time).all()
    assert_allclose(found.absolute_humidity[0], usual.absolute_humidity[0], atol=2e-3)


# --- interval means -------------------------------------------------------------------------


def test_readings_of_means_are_the_integrals_of_the_instants():
    """Every predicted mean is the integral of the finely sampled free run over its interval, and what is
    shown between the ends of intervals is the course itself, not a half-filled mean."""
    record = to_record(plant(23, days=8, logger_mean=True, missing=0.3))
    base = design(record)
    assert base.averaged
    driven = model_inputs(base, record)
    values = parameters(base)
    found = free_run(base, values, driven)
    seconds = driven.timeline.seconds

    # the same cabinet read each half minute as instants
    fine_time = np.arange(seconds[0], seconds[-1], 30.0)
    fine_series = [
        replace(record[n], time=fine_time, value=np.full(len(fine_time), v), hold="linear", interval_s=0.0)
        for n, v in (("cabinet_temperature", 290.0), ("cabinet_relative_humidity", 0.5))
    ]
    fine_record = record.replace_series(*fine_series)
    fine = replace(base, averaged={})
    fine_run = model_inputs(fine, fine_record)
    course = free_run(fine, values, fine_run)
    fine_seconds = fine_run.timeline.seconds
    for name, quantity, tolerance in (
        ("cabinet_temperature", "temperature_K", 2e-3),
        ("cabinet_relative_humidity", "relative_humidity", 2e-5),
    ):
        value = course.of(quantity)[0]
        area = np.concatenate([[0.0], np.cumsum(0.5 * (value[1:] + value[:-1]) * np.diff(fine_seconds))])
        read = np.isfinite(driven.timeline.reading(name)) & (seconds < fine_seconds[-1])
        read &= seconds > seconds[0] + 2 * 3600.0
        end = seconds[read]
        mean = (np.interp(end, fine_seconds, area) - np.interp(end - 900.0, fine_seconds, area)) / 900.0
        assert read.sum() > 400
        assert_allclose(found.of(quantity)[0][read], mean, atol=tolerance)
        between = ~np.isfinite(driven.timeline.reading(name)) & (seconds > seconds[0] + 7200.0)
        assert between.sum() > 400
        expected = np.interp(seconds[between], fine_seconds, value)
        assert_allclose(found.of(quantity)[0][between], expected, atol=10 * tolerance)
        sd = course.of(quantity)[1]
        assert_allclose(
            found.of(quantity)[1][between], np.interp(seconds[between], fine_seconds, sd), rtol=0.02
        )
    warm, moist = (np.isfinite(driven.timeline.reading(n)) for n in base.averaged)
    later = seconds > seconds[0] + 7200.0
    neither, both = later & ~warm & ~moist, later & warm & moist
    grams, shown = course.absolute_humidity[0], found.absolute_humidity[0]
    assert_allclose(shown[neither], np.interp(seconds[neither], fine_seconds, grams), atol=2e-3)
    area = np.concatenate([[0.0], np.cumsum(0.5 * (grams[1:] + grams[:-1]) * np.diff(fine_seconds))])
    end = seconds[both]
    mean = (np.interp(end, fine_seconds, area) - np.interp(end - 900.0, fine_seconds, area)) / 900.0
    assert_allclose(shown[both], mean, atol=0.05)


# --- spread ---------------------------------------------------------------------------------


def test_parameters_spread_is_that_of_slightly_different_parameters(noisy):
    """J V J' against the spread over 200 free runs with drawn parameters (small, so that first order is
    all)."""
    record, base, _, values = noisy
    driven = model_inputs(base, record.window(record.start_s, record.start_s + 3 * 86400.0))
    names = ("thermal_time_constant", "heat_release_power_1", "hygric_k", "cabinet_relative_humidity_bias")
    sd = np.array([0.02, 0.1, 0.005, 0.002])
    correlation = np.eye(4)
    correlation[0, 1] = correlation[1, 0] = 0.7
    matrix = correlation * np.outer(sd, sd)
    random = np.random.default_rng(41)
    drawn = random.multivariate_normal(np.zeros(4), matrix, 200)
    runs = [
        free_run(base, values | {n: values[n] + s for n, s in zip(names, shift, strict=True)}, driven)
        for shift in drawn
    ]
    plain, wide = free_run(base, values, driven), free_run(base, values, driven, (names, matrix))
    for quantity in QUANTITIES:
        spread = np.std([one.of(quantity)[0] for one in runs], axis=0)
        extra = np.sqrt(np.maximum(wide.of(quantity)[1] ** 2 - plain.of(quantity)[1] ** 2, 0.0))
        assert_allclose(wide.of(quantity)[0], plain.of(quantity)[0], rtol=0, atol=0)
        later = driven.timeline.time > 1.0
        assert np.median(spread[later]) > 0
        assert_allclose(extra[later], spread[later], rtol=0.25, atol=0.02 * spread.max())


# --- forecasts ------------------------------------------------------------------------------


def test_a_forecast_is_the_filter_with_its_later_readings_hidden(noisy):
    _, base, driven, values = noisy
    t = driven.timeline
    first = int(np.searchsorted(t.time, 200.0))
    found = forecasts(base, values, driven, first, leads_h=(1.0, 6.0), count=40)
    seen = np.isfinite(t.y).any(axis=1) & driven.scored
    starts = np.flatnonzero(seen)
    starts = starts[starts >= first]
    starts = starts[np.unique(np.linspace(0, len(starts) - 1, 40).astype(int))]
    for lead in (1.0, 6.0):
        rows = []
        for start in starts:
            later = np.flatnonzero(np.isfinite(t.reading("cabinet_temperature")) & (t.time > t.time[start]))
            if not len(later):
                continue
            target = later[np.argmin(np.abs(t.time[later] - t.time[start] - lead))]
            if abs(t.time[target] - t.time[start] - lead) > 0.15:
                continue
            hidden = t.y.copy()
            hidden[start + 1 :] = np.nan
            trace = Likelihood(base.model, t.with_readings(hidden).window(0, target + 1)).trace(values)
            rows.append(
                (
                    t.reading("cabinet_temperature")[target],
                    trace.prediction[-1, 0],
                    math.sqrt(trace.variance[-1, 0]),
                )
            )
        assert len(rows) > 30
        assert_allclose(np.column_stack(found[lead]["temperature_K"]), rows, rtol=1e-9)
    assert found[1.0]["temperature_K"][2].mean() < found[6.0]["temperature_K"][2].mean()


def test_forecasts_leave_unscored_stretches_out(noisy):
    record, base, _, values = noisy
    driven = model_inputs(base, record.window(record.start_s, record.start_s + 4 * 86400.0))
    scored = driven.timeline.time < 60.0
    found = forecasts(base, values, replace(driven, scored=scored), 0, (1.0,), 10_000)
    usual = forecasts(base, values, driven, 0, (1.0,), 10_000)
    share = len(found[1.0]["temperature_K"][0]) / len(usual[1.0]["temperature_K"][0])
    assert share == pytest.approx(60.0 / driven.timeline.time[-1], abs=0.02)


# --- derived quantities ---------------------------------------------------------------------


def test_projections_have_the_slopes_of_finite_differences(noisy):
    record, base, _, values = noisy
    driven = model_inputs(base, record.window(record.start_s, record.start_s + 86400.0))
    trace = Likelihood(base.model, driven.timeline).trace(values)
    for name in ("cabinet_air_temperature", base.model.states[0]):
        value, variance = project(base.model, driven.timeline, values, trace.mean, trace.covariance, name)
        slopes = []
        for i in range(trace.mean.shape[1]):
            moved = [trace.mean.copy(), trace.mean.copy()]
            moved[0][:, i] -= 1e-4
            moved[1][:, i] += 1e-4
            low, high = (project(base.model, driven.timeline, values, m, None, name)[0] for m in moved)
            slopes.append((high - low) / 2e-4)
        j = np.array(slopes).T
        assert_allclose(variance, np.einsum("ti,tij,tj->t", j, trace.covariance, j), rtol=1e-5)
        assert np.all(project(base.model, driven.timeline, values, trace.mean, None, name)[1] == 0.0)
        assert value.shape == (len(driven.timeline),)
    u = driven.timeline.input("ambient_temperature")
    warm = 0.85 * trace.mean[:, 0] + 0.15 * u
    air, _ = project(base.model, driven.timeline, values, trace.mean, None, "cabinet_air_temperature")
    assert_allclose(air, warm)


def test_measured_absolute_humidity_uses_a_temperature_no_further_than_half_an_hour(noisy):
    record, *_ = noisy
    warm = record["cabinet_temperature"]
    hole = (warm.time > record.start_s + 20 * 3600) & (warm.time < record.start_s + 25 * 3600)
    single = np.flatnonzero(~warm.missing)[400]
    value = np.where(hole, np.nan, warm.value)
    value[single] = np.nan
    holed = record.replace_series(replace(warm, value=value))
    base = design(holed)
    driven = model_inputs(base, holed)
    found = measured(driven)
    seconds = driven.timeline.seconds
    amid = (seconds > record.start_s + 20.6 * 3600) & (seconds < record.start_s + 24.4 * 3600)
    assert np.isfinite(found["relative_humidity"][amid]).any()
    assert np.isnan(found["absolute_humidity_g_m3"][amid]).all()
    at = int(np.argmin(np.abs(seconds - warm.time[single])))
    expected = np.interp(warm.time[single], *holed["cabinet_temperature"].known)
    humidity = found["relative_humidity"][at]
    assert found["absolute_humidity_g_m3"][at] == pytest.approx(1e3 * absolute_humidity(humidity, expected))
    there = np.isfinite(found["temperature_K"]) & np.isfinite(found["relative_humidity"])
    assert_allclose(
        found["absolute_humidity_g_m3"][there],
        1e3 * absolute_humidity(found["relative_humidity"][there], found["temperature_K"][there]),
    )


def test_predictions_start_from_any_state(noisy):
    """A prediction from a given Gaussian begins there: the checkpoint of a filter."""
    _, base, driven, values = noisy
    trace = Likelihood(base.model, driven.timeline).trace(values)
    piece = driven.window(501, 700)
    start = Gaussian(trace.mean[500], trace.covariance[500])
    ahead = Likelihood(base.model, piece.timeline).trace(values, start=start)
    found = predicted_readings(base, values, piece, ahead)
    assert_allclose(found.temperature[0], trace.prediction[501:700, 0], rtol=1e-12)
