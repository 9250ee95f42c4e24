"""Scores against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from hygrokf.estimation.likelihood import Likelihood


def differences(likelihood: Likelihood, values: dict[str, float]) -> np.ndarray:
    """Central differences with the error of the step removed once (Richardson): of fourth order."""
    result = []
    for p in likelihood.model.parameters:
        size = 2e-4 * max(abs(values[p.name]), 0.1 * (p.upper - p.lower) if not p.positive else 0.0, 1e-4)
        slopes = []
        for step in (size, 0.5 * size):
            up, down = (likelihood.value(values | {p.name: values[p.name] + s}) for s in (step, -step))
            slopes.append((up - down) / (2 * step))
        result.append((4 * slopes[1] - slopes[0]) / 3)
    return np.array(result)


def check_score(likelihood: Likelihood, values: dict[str, float]) -> None:
    value, score = likelihood.score(values)
    assert value == pytest.approx(likelihood.value(values), rel=1e-12)
    expected = differences(likelihood, values)
    # rounding of the value (1e-13 of it) over the step; steps are at least 2e-8
    size = np.maximum(np.abs(expected), 1e-3 * np.abs(expected).max())
    np.testing.assert_allclose((score - expected) / size, 0.0, atol=2e-6)
    found = likelihood.sensitivities(values, np.eye(len(values)), each=True)
    assert found.loglik == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose((found.score - score) / size, 0.0, atol=1e-9)
    np.testing.assert_allclose(
        found.scores.sum(axis=0), found.score, rtol=1e-9, atol=1e-9 * np.abs(score).max()
    )
    assert np.all(np.linalg.eigvalsh(found.information) > -1e-9 * np.trace(found.information))
