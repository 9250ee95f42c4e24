"""The confidence of a name from lines of results: three coefficients by maximum likelihood.

Names of all groups of simulated plants calibrate it, but those of the group `confidence`, which holds
plants as they may come: these test it (`battery.tables`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from scipy.optimize import minimize

from battery.tables import names, thirds, truths

FEWEST = 30
WIDEST = 10.0
"""Standard deviation of a coefficient's prior: where no name was wrong, the likelihood alone has no
maximum."""


def calibrated(lines: Iterable[Mapping]) -> str:
    """The coefficients of `hygrokf.discovery.procedure.CONFIDENCE`, and how they state what was observed.

    P(right) = 1/(1 + exp(−(a + b ln(evidence in days) + c lead))), of every name that was told.  Raises
    ValueError for fewer than 30 names.
    """
    told = [
        (one["evidence_in_days"], one["lead"], one["cause"] in truths(line))
        for line in lines
        if line["group"] not in ("confidence", "measured") and not line["failure"]
        for one in names(line)
    ]
    if len(told) < FEWEST:
        raise ValueError(f"expected at least {FEWEST} names to calibrate by, found {len(told)}")
    in_days, lead, right = np.array(told, dtype=float).T
    x = np.column_stack([np.ones(len(told)), np.log(np.maximum(in_days, 1.0)), lead])
    scale = np.array([1.0, 1.0, max(float(np.std(lead)), 1.0)])

    def loss(b: np.ndarray) -> tuple[float, np.ndarray]:
        z = (x / scale) @ b
        chance = 1.0 / (1.0 + np.exp(-z))
        value = float(np.sum(np.logaddexp(0.0, z) - right * z) + 0.5 * b @ b / WIDEST**2)
        return value, (x / scale).T @ (chance - right) + b / WIDEST**2

    b = minimize(loss, np.zeros(3), jac=True).x / scale
    stated = 1.0 / (1.0 + np.exp(-(x @ b)))
    numbers = ", ".join(f"{one:.3g}" for one in b)
    text = [f"CONFIDENCE = ({numbers})  # {len(told)} names, {right.mean():.0%} right"]
    for number, (difference, count) in enumerate(thirds(list(zip(stated, right, strict=True))), 1):
        text.append(f"third {number}: stated − observed {difference:+.3f} of {count}")
    return "\n".join(text)
