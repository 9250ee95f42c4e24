"""Exported filterpy objects."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from plants import plant
from plants.as_record import to_record

from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.smoother import to_filterpy
from hygrokf.modelling.design import design
from hygrokf.modelling.inputs import model_inputs


@pytest.fixture(scope="module")
def record():
    return to_record(plant(11, days=8))


@pytest.mark.parametrize("kind", ["cascade", "joint"])
def test_filterpy_object_is_the_filter(record, kind):
    """filterpy's own algebra (Joseph form) and ours agree to 1e-9 over 400 partly missing readings."""
    base = design(record, kind=kind)
    line = model_inputs(base, record).timeline
    y = line.y.copy()
    y[np.random.default_rng(3).random(y.shape) < 0.1] = np.nan
    counts = np.isfinite(y).sum(axis=1).cumsum()
    last = int(np.searchsorted(counts, 400)) + 1
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
    assert np.isfinite(line.y).sum() >= 400
    assert total == pytest.approx(likelihood.value(values), abs=1e-7)
