"""The compiled filter is the plain one: numpy and numerical integration, with nothing of the engine."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from plants import plant
from plants.as_record import to_record

from hygrokf.data.record import Record
from hygrokf.engine.schedule import STEP_TOLERANCE
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.reference_filter import reference_filter
from hygrokf.modelling.design import design
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.model import Model


@cache
def cabinet() -> Record:
    return to_record(plant(11, days=6))


def case(
    kind: str, count: int, step: float = STEP_TOLERANCE, wrong: tuple[int, ...] = ()
) -> tuple[Likelihood, dict[str, float]]:
    """A likelihood and parameter values; `wrong`: instants whose readings are far off."""
    record = cabinet()
    made = design(record, kind=kind)
    line = model_inputs(made, record).timeline.window(0, count)
    y = line.y.copy()
    y[np.random.default_rng(3).random(y.shape) < 0.2] = np.nan
    y[list(wrong)] += np.array([30.0, 0.5])[: y.shape[1]]
    values = {p.name: p.start for p in made.model.parameters}
    return Likelihood(made.model, line.with_readings(y), tolerance=step), values


@pytest.mark.parametrize(
    ("kind", "step", "tolerance"),
    [
        ("thermal", STEP_TOLERANCE, 1e-9),  # linear: the compiled steps are exact
        ("joint", 1e-12, 1e-9),  # short sub-steps
        ("joint", STEP_TOLERANCE, 1e-6),  # ordinary sub-steps
    ],
)
def test_the_compiled_filter_is_the_plain_one(kind, step, tolerance):
    likelihood, values = case(kind, 90, step, wrong=(40, 41, 70))
    total, states = reference_filter(likelihood, values)
    trace = likelihood.trace(values)
    assert total == pytest.approx(likelihood.value(values), rel=tolerance)
    for k, state in enumerate(states):
        assert_allclose(state.mean, trace.mean[k], rtol=tolerance, atol=tolerance)
        spread = np.sqrt(np.diag(state.covariance))
        assert_allclose(
            state.covariance / np.outer(spread, spread),
            trace.covariance[k] / np.outer(spread, spread),
            rtol=0.0,
            atol=max(tolerance, 1e-9),
        )


def test_the_influence_of_a_wrong_reading_is_bounded():
    """However far off a reading is, the state moves as for one at the bound; unbounded it moves 40 times as
    far."""
    likelihood, values = case("joint", 150)
    place = 72 + int(np.flatnonzero(np.isfinite(likelihood.timeline.y[72:, 0]))[0])
    before = likelihood.trace(values)
    spread = np.sqrt(before.variance[place, 0])

    def moved(model: Model, off: float) -> float:
        y = likelihood.timeline.y.copy()
        y[place] = before.prediction[place, 0] + off * spread, np.nan
        one = Likelihood(model, likelihood.timeline.with_readings(y)).trace(values)
        return float(np.abs(one.mean[place] - before.prior_mean[place]).max())

    bounded = likelihood.model
    assert moved(bounded, 3.9) == pytest.approx(3.9 / 4.0 * moved(bounded, 4.0), rel=1e-9)
    assert moved(bounded, 160.0) == pytest.approx(moved(bounded, 4.0), rel=1e-9)
    assert moved(replace(bounded, bound=np.inf), 160.0) == pytest.approx(40.0 * moved(bounded, 4.0), rel=1e-3)


def test_the_score_of_bounded_readings_is_the_central_difference():
    likelihood, values = case("joint", 150, wrong=(70, 71, 110))
    names = [p.name for p in likelihood.model.parameters]
    _, score = likelihood.score(values)
    assert_allclose(likelihood.sensitivities(values, np.eye(len(names))).score, score, rtol=1e-8, atol=1e-8)
    for name, slope in zip(names, score, strict=True):
        step = 1e-5 * max(abs(values[name]), 1e-2)
        ends = [likelihood.value({**values, name: values[name] + one}) for one in (step, -step)]
        assert (ends[0] - ends[1]) / (2.0 * step) == pytest.approx(slope, rel=2e-4, abs=2e-3)


def test_a_diffuse_start_is_refused():
    likelihood, values = case("thermal", 3)
    with pytest.raises(ValueError, match="diffuse"):
        reference_filter(Likelihood(likelihood.model, likelihood.timeline, initial="diffuse"), values)
