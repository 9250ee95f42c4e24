"""What a likelihood may start from."""

from __future__ import annotations

import numpy as np
import pytest

from hygrokf.estimation.likelihood import Gaussian, Likelihood

MEAN, COVARIANCE = np.array([283.0, 0.0]), np.array([[4.0, 1.9], [1.9, 1.0]])


def test_a_full_covariance_is_taken(thermal: object) -> None:
    line = thermal.first(30).timeline
    full, alone = (
        Likelihood(thermal.model, line, Gaussian(MEAN, p)).value(thermal.values)
        for p in (COVARIANCE, np.diag(np.diag(COVARIANCE)))
    )
    assert np.isfinite(full) and full != alone


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"initial": Gaussian(MEAN[:1], COVARIANCE)}, r"mean of shape \(2,\) and .* \(2, 2\), found \(1,\)"),
        ({"initial": Gaussian(MEAN, np.ones(2))}, r"found \(2,\) and \(2,\)"),
        ({"initial": Gaussian(MEAN * np.nan, COVARIANCE)}, "expected finite moments"),
        ({"initial": Gaussian(MEAN, np.array([[4.0, 1.0], [0.5, 1.0]]))}, "symmetric"),
        ({"initial": Gaussian(MEAN, np.array([[4.0, 2.1], [2.1, 1.0]]))}, "without negative eigenvalues"),
        ({"initial": Gaussian(MEAN, np.array([[-1e-20, 0.0], [0.0, 1.0]]))}, "without negative eigenvalues"),
        ({"initial": "difuse"}, "found 'difuse'; did you mean \"diffuse\""),
        ({"initial": None}, "found None"),
        ({"diffuse_states": ("heat_disturbance",)}, "initial=\"diffuse\" beside them, found 'prior'"),
        (
            {"initial": "diffuse", "diffuse_states": ("heat_disturbence",)},
            'found "heat_disturbence"; did you mean "heat_disturbance"',
        ),
    ],
)  # fmt: skip
def test_what_is_no_start_is_refused(thermal: object, options: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Likelihood(thermal.model, thermal.timeline, **options)
