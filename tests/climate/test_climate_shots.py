"""Disturbances that come as shots: found in the innovations of courses made with jumps, and drawn with the
same moments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders.climate_case import BEGIN_S, known_fit
from scipy.signal import lfilter

from hygrokf.climate.ensemble import FEWEST_JUMPS, Shots, course, shot_statements, shots_of, simulate_years
from hygrokf.climate.region import driven
from hygrokf.data.record import Record, Series
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.evaluation.innovation_tests import Diagnosis, OutputDiagnosis, diagnose
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_results import FitResults
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.psychrometrics import Surface, saturation_pressure_water

STEP_H = 1.0 / 30.0
TAU_H, HYGRIC_H = 1.5, 0.4
AMBIENT_K, AMBIENT_G = 283.15, 6.0
QUIET = {"thermal_diffusion": 1e-4, "hygric_diffusion": 1e-4}


def jumps(
    random: np.random.Generator, count: int, memory_h: float, sd: float, every_h: float | None
) -> np.ndarray:
    """A disturbance of stated memory and standard deviation: decaying jumps, one `every_h`, or Gaussian kicks
    (None)."""
    gain = np.exp(-STEP_H / memory_h)
    chance = 1.0 if every_h is None else STEP_H / every_h
    drive = (random.random(count) < chance) * random.standard_normal(count)
    return lfilter([sd * np.sqrt((1.0 - gain**2) / chance)], [1.0, -gain], drive)


def lagged(drive: np.ndarray, lag_h: float) -> np.ndarray:
    gain = np.exp(-STEP_H / lag_h)
    return lfilter([1.0 - gain], [1.0, -gain], drive)


def flat_record(days: float, heat_h: float | None, vapour_h: float | None, seed: int) -> Record:
    """A cabinet under constant weather, every 15 minutes; heat and vapour are disturbed by jumps every so
    many hours."""
    random = np.random.default_rng(seed)
    count = int(24 * days / STEP_H)
    heat, vapour = (jumps(random, count, *one) for one in ((8.0, 1.2, heat_h), (6.0, 0.3, vapour_h)))
    fit = known_fit(**QUIET)
    air = AMBIENT_K + 2.0 + lagged(heat, TAU_H)
    factor = AMBIENT_K**0.8 / 273.0**1.8
    c = AMBIENT_G + lagged(vapour, HYGRIC_H / (float(air.mean()) * factor))
    humidity = 0.4615 * AMBIENT_K * c / saturation_pressure_water(air)
    time = BEGIN_S + 3600.0 * STEP_H * np.arange(count)
    place = slice(0, None, round(0.25 / STEP_H))
    shown = {
        "cabinet_temperature": air + fit.values["cabinet_temperature_noise"] * random.standard_normal(count),
        "cabinet_relative_humidity": humidity
        + fit.values["cabinet_relative_humidity_noise"] * random.standard_normal(count),
        "ambient_temperature": np.full(count, AMBIENT_K),
        "ambient_absolute_humidity": np.full(count, 1e-3 * AMBIENT_G),
        "active_power": np.zeros(count),
    }
    return Record("flat", tuple(Series(n, time[place], v[place]) for n, v in shown.items()))


def judged(record: Record) -> Fit:
    """The known model with the diagnosis of its innovations on a record, as a fit's results have it."""
    fit = known_fit(**QUIET)
    t = model_inputs(fit.design, record).timeline
    trace = Likelihood(replace(fit.design.model, bound=np.inf), t).trace(fit.values)
    standard = (t.y - trace.prediction) / np.sqrt(trace.variance)
    settled = t.time > 48.0
    names = {"cabinet_temperature": "temperature", "cabinet_relative_humidity": "humidity"}
    by_name = {names[n]: standard[settled, i] for i, n in enumerate(t.outputs) if n in names}
    found = diagnose(t.time[settled], by_name, {})
    return Fit(fit.name, fit.design, fit.values, replace(fit.results, innovations=found))


@pytest.mark.parametrize(("heat_h", "vapour_h"), [(20.0, 9.0), (6.0, None), (None, 20.0)])
def test_the_distance_of_shots_is_found_in_the_innovations(
    heat_h: float | None, vapour_h: float | None
) -> None:
    """Two years: of 900 jumps the fourth moment is known to some 12 %; Gaussian noise shows as less than an
    hour."""
    record = flat_record(730, heat_h, vapour_h, 3)
    fit = judged(record)
    heat, vapour = shots_of(fit, *course(fit, record))
    assert (heat.name, vapour.name) == ("heat", "vapour")
    for found, truth in ((heat, heat_h), (vapour, vapour_h)):
        if truth is None:
            assert found.every_h < 1.0
        else:
            assert found.every_h == pytest.approx(truth, rel=0.3)
    said = shot_statements((heat, vapour))
    rare = [(heat, heat_h), (vapour, vapour_h)]
    shots = [(one.name, one.every_h) for one, truth in rare if truth is not None]
    assert (
        len(said) == 1
        and [(one.values["balance"], one.values["hours"]) for one in said[0].values["shots"]] == shots
    )


def test_shots_are_not_rarer_than_the_fit_can_know() -> None:
    fit = judged(flat_record(40, 100.0, None, 5))
    outputs = fit.results.innovations.outputs
    wild = {"temperature": replace(outputs["temperature"], excess_kurtosis=1e6)}  # one wild reading
    diagnosis = replace(fit.results.innovations, outputs={**outputs, **wild})
    fit = replace(fit, results=replace(fit.results, innovations=diagnosis))
    record = flat_record(5, None, None, 6)
    heat, _ = shots_of(fit, *course(fit, record))
    found = fit.results.innovations.outputs["temperature"]
    span_h = found.n * found.step_h
    assert heat.every_h == pytest.approx(span_h / FEWEST_JUMPS)


def test_without_a_diagnosis_disturbances_are_gaussian() -> None:
    record = flat_record(5, None, None, 6)
    fit = known_fit()
    assert shots_of(fit, *course(fit, record)) == () and shot_statements(()) == []
    short = judged(record)
    few = Diagnosis(outputs={"temperature": OutputDiagnosis(n=3)})
    short = replace(short, results=FitResults(innovations=few))
    assert shots_of(short, *course(short, record)) == ()


def test_factors_have_the_moments_of_shots() -> None:
    """Normal kicks times the factors: variance 1, excess kurtosis 3 h/d, and none of both where noise is
    Gaussian."""
    random = np.random.default_rng(8)
    states = np.array([True])
    factor = Shots("heat", states, 2.0).factors(random, 1.0, 400_000)
    kick = factor * random.standard_normal(len(factor))
    assert kick.var() == pytest.approx(1.0, rel=0.02)
    assert np.mean(kick**4) / kick.var() ** 2 - 3.0 == pytest.approx(6.0, rel=0.1)
    assert np.array_equal(Shots("heat", states, 0.0).factors(random, 1.0, 3), np.ones(3))


def test_shots_keep_the_spread_and_make_the_largest_changes_larger() -> None:
    """Under constant weather: the variance is that of Gaussian noise, the change exceeded in 1 % of hours is
    not."""
    record, _ = driven(known_fit(), flat_record(60, None, None, 7), None)
    fit = known_fit(**QUIET)
    both = (Shots("heat", np.array([n != "vapour" for n in fit.design.model.states]), 20.0),)
    members = [dict(fit.values)] * 100
    driver = course(fit, record)
    made = [
        next(iter(simulate_years(fit, *driver, members, 4, Surface(), rare=rare))).temperature_K
        for rare in ((), both)
    ]
    assert made[1].var() == pytest.approx(made[0].var(), rel=0.1)
    largest = [np.quantile(np.abs(np.diff(one, axis=1)), 0.99) for one in made]
    expected = []
    for every_h in (None, 20.0):
        true = lagged(jumps(np.random.default_rng(9), 4_000_000, 8.0, 1.2, every_h), TAU_H)
        expected.append(np.quantile(np.abs(np.diff(true[:: round(1 / STEP_H)])), 0.99))
    assert largest[1] > 1.3 * largest[0]
    for found, truth in zip(largest, expected, strict=True):
        assert found == pytest.approx(truth, rel=0.1)
