"""The compiled filter is the plain one: numpy and numerical integration, with nothing of the engine."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from plants import plant
from plants.as_record import to_record

from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.reference_filter import reference_filter
from hygrokf.modelling.design import design
from hygrokf.modelling.inputs import prepare_run


def case(kind: str, count: int, rate_step: float | None) -> tuple[Likelihood, dict[str, float]]:
    record = to_record(plant(11, days=6))
    made = design(record, kind=kind)
    line = prepare_run(made, record).timeline.window(0, count)
    y = line.y.copy()
    y[np.random.default_rng(3).random(y.shape) < 0.2] = np.nan
    values = {p.name: p.start for p in made.model.parameters}
    return Likelihood(made.model, line.with_readings(y), rate_step=rate_step), values


@pytest.mark.parametrize(
    ("kind", "rate_step", "tolerance"),
    [
        ("thermal", None, 1e-9),  # linear: the compiled steps are exact
        ("joint", 0.01, 1e-9),  # short sub-steps: their error falls with the fourth power
        ("joint", None, 1e-5),  # ordinary sub-steps: the stated error of the discretisation
    ],
)
def test_the_compiled_filter_is_the_plain_one(kind, rate_step, tolerance):
    likelihood, values = case(kind, 150, rate_step)
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


def test_a_diffuse_start_is_refused():
    likelihood, values = case("thermal", 3, None)
    with pytest.raises(ValueError, match="diffuse"):
        reference_filter(Likelihood(likelihood.model, likelihood.timeline, initial="diffuse"), values)
