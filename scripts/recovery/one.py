"""One plant: its record, its fit with the default settings, and the line that says what came of it."""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Mapping

from battery.trial import sources_hash

from hygrokf import identify
from hygrokf.data.structured import plain
from recovery.rows import ROWS, Quantity


def line(row: str, seed: int, days: float) -> dict:
    """The line of a plant; what a fit raises is part of it."""
    found: dict = {"row": row, "seed": seed, "days": days, "sources": sources_hash(), "failure": None}
    record, quantities = ROWS[row].make(seed, days)
    begin, used = time.perf_counter(), _cpu_s()
    try:
        fit = identify(record)
    except Exception as broken:  # a study counts failures, it does not stop at them
        return found | {"failure": f"{type(broken).__name__}: {broken}"}
    found |= {"wall_s": time.perf_counter() - begin, "cpu_s": _cpu_s() - used}
    found["converged"] = fit.results.converged
    found["statements"] = list(fit.results.statements)
    found["free_run"] = {
        name: rmse["total"] for name, rmse in plain(fit.results.rmse["identification"]).items()
    }
    found["mechanisms"] = [name for name, _ in fit.design.mechanisms]
    found["quantities"] = {
        name: compared(quantity, plain(fit.results.time_constants[quantity.constant]))
        for name, quantity in quantities.items()
    }
    return found


def compared(quantity: Quantity, whole: Mapping) -> dict:
    """Truth, estimate, headline interval, plain profile bound and verdict of one quantity."""
    part = whole.get(quantity.key) if quantity.key else None
    entry = whole if part is None else part
    truth = float(quantity.truth(whole))
    profile = entry.get("profile")
    simulation = entry.get("simulation")
    return {
        "truth": truth,
        "value": entry["value_h"],
        **_interval(entry, truth),
        "own": quantity.key is None or part is not None,
        "profile": None if profile is None else _interval(profile, truth),
        "verdict": entry.get("verdict", whole.get("verdict")),
        "reasons": entry.get("reasons", whole.get("reasons")),
        "factor": entry.get("factor"),
        "simulation": None if simulation is None else simulation["value_h"],
        "disagreement": entry.get("disagreement") is not None,
    }


def _interval(entry: Mapping, truth: float) -> dict:
    """Bounds [h], None where open, and whether they hold the truth."""
    lower, upper = entry["lower_h"], entry["upper_h"]
    covered = (0.0 if lower is None else lower) <= truth <= (math.inf if upper is None else upper)
    return {"lower": lower, "upper": upper, "covered": bool(covered)}


def _cpu_s() -> float:
    """[s] of processor time of this process and of those that it has waited for."""
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, who))
