"""Made-up rows of a fleet's table, and work of a fleet that ends for its first turbine alone."""

from __future__ import annotations

import threading

import numpy as np

from hygrokf.fleet.job import Job


def departing_rows() -> list[dict]:
    """Nine turbines of which the fifth has a time constant e times as long."""
    random = np.random.default_rng(5)
    rows = []
    for place in range(9):
        value = 1.5 * float(np.exp(0.05 * random.normal() + (1.0 if place == 4 else 0.0)))
        bounds = {f"thermal_{k}_h": value * f for k, f in (("lower", 0.9), ("value", 1.0), ("upper", 1.1))}
        rows.append({"turbine": f"W{place}", "status": "done", "task": "fit", **bounds})
    return rows


def first_alone(job: Job) -> dict:
    """Work whose process ends by itself for T1, and is to be killed for any other turbine."""
    if job.turbine != "T1":
        threading.Event().wait()
    return {}
