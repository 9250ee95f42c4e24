"""Smoother and filterpy objects."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from plants import plant
from plants.as_record import to_record

from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.smoother import smoothed_states, to_filterpy
from hygrokf.modelling.design import design
from hygrokf.modelling.inputs import model_inputs


@pytest.fixture(scope="module")
def record():
    return to_record(plant(11, days=20))


@pytest.mark.parametrize("kind", ["thermal", "cascade", "joint"])
def test_filterpy_object_is_the_filter(record, kind):
    """filterpy's own algebra (Joseph form) and ours agree to 1e-9 over 1,000 partly missing readings."""
    base = design(record, kind=kind)
    line = model_inputs(base, record).timeline
    y = line.y.copy()
    y[np.random.default_rng(3).random(y.shape) < 0.1] = np.nan
    counts = np.isfinite(y).sum(axis=1).cumsum()
    last = int(np.searchsorted(counts, 1000)) + 1
    line = line.with_readings(y).window(0, last)
    likelihood = Likelihood(base.model, line)
    values = {p.name: p.start for p in base.model.parameters}
    trace = likelihood.trace(values)
    made = to_filterpy(likelihood, values)
    total = 0.0
    for k in range(len(line)):
        made.advance(k)
        total += made.observe(k)
        assert_allclose(made.x, trace.mean[k], rtol=1e-9, atol=1e-9)
        assert_allclose(made.P, trace.covariance[k], rtol=1e-9, atol=1e-9)
    assert np.isfinite(line.y).sum() >= 1000
    assert total == pytest.approx(likelihood.value(values), abs=1e-7)


def test_smoothed_states_are_the_conditional_means(record):
    """Against dense linear algebra: condition the joint Gaussian of all states on all readings (thermal
    model)."""
    base = design(record, kind="thermal")
    line = model_inputs(base, record).timeline.window(0, 60)
    likelihood = Likelihood(base.model, line)
    values = {p.name: p.start for p in base.model.parameters}
    free = likelihood.trace(values, gain=False)
    n, count = free.mean.shape[1], len(line)
    joint = np.zeros((count * n, count * n))
    for k in range(count):
        block = free.prior_covariance[k]
        joint[k * n : (k + 1) * n, k * n : (k + 1) * n] = block
        carried = block
        for later in range(k + 1, count):
            carried = free.transition[later] @ carried
            joint[later * n : (later + 1) * n, k * n : (k + 1) * n] = carried
            joint[k * n : (k + 1) * n, later * n : (later + 1) * n] = carried.T
    rho = values["resistance_ratio"]
    row = np.zeros(n)
    row[base.model.states.index("converter_temperature")] = rho
    seen = np.flatnonzero(np.isfinite(line.y[:, 0]))
    h = np.zeros((len(seen), count * n))
    for i, k in enumerate(seen):
        h[i, k * n : (k + 1) * n] = row
    noise = values["cabinet_temperature_noise"] ** 2 + record["cabinet_temperature"].resolution ** 2 / 12
    s = h @ joint @ h.T + noise * np.eye(len(seen))
    gain = joint @ h.T @ np.linalg.inv(s)
    expected = free.prior_mean.reshape(-1) + gain @ (line.y[seen, 0] - free.prediction[seen, 0])
    spread = joint - gain @ h @ joint
    mean, covariance = smoothed_states(likelihood, values)
    assert_allclose(mean.reshape(-1), expected, rtol=1e-9, atol=1e-8)
    for k in range(count):
        assert_allclose(covariance[k], spread[k * n : (k + 1) * n, k * n : (k + 1) * n], atol=1e-8)
