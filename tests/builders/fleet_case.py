"""Made-up rows of a fleet's table."""

from __future__ import annotations

import numpy as np


def departing_rows() -> list[dict]:
    """Nine turbines of which the fifth has a time constant e times as long."""
    random = np.random.default_rng(5)
    rows = []
    for place in range(9):
        value = 1.5 * float(np.exp(0.05 * random.normal() + (1.0 if place == 4 else 0.0)))
        bounds = {f"thermal_{k}_h": value * f for k, f in (("lower", 0.9), ("value", 1.0), ("upper", 1.1))}
        rows.append({"turbine": f"W{place}", "status": "done", "task": "fit", **bounds})
    return rows
