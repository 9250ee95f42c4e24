"""The sparse regression from outside: courses handed to an interpreter that has PySINDy, its terms mapped to
causes."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from validation.head_to_head.ground import HUMIDITY, TEMPERATURE, Ground, drivers

LONGEST_GAP_S = 3600.0
HOURLY = ("sin", "cos")


def cause_of(state: str, term: str) -> str | None:
    """The cause that a term of a state's equation stands for; None where the table has no entry.

    The table is docs/validation/head_to_head.md's.  A product counts by the first row that it meets.
    """
    names = set(term.split())
    heat = state == "T"
    rows = (
        ("sun" in names and heat, "solar_gain"),
        ("wind" in names, "wind_driven_exchange"),
        ("rain" in names and not heat, "rain_ingress"),
        (bool(names & set(HOURLY)) and heat, "scheduled_heat"),
        (heat and names <= {"T", "Ta"} and " " in term, "cooling_switching"),
        (not heat and term == "1", "internal_moisture_source"),
        (not heat and names <= {"v", "va"} and " " in term, "condensation"),
        (
            not heat and names <= {"T", "Ta", "P", "v", "va"} and bool(names & {"T", "Ta", "P"}),
            "moisture_sorption",
        ),
    )
    return next((cause for holds, cause in rows if holds), None)


def courses(ground: Ground) -> dict[str, np.ndarray]:
    """The record on a uniform grid of the cabinet thermometer's own step."""
    record = ground.record
    inside = record["cabinet_temperature"]
    step = float(np.median(inside.steps_s))
    start = max(
        series.known[0][0]
        for series in record.series
        if series.signal in ("ambient_temperature", inside.signal)
    )
    grid = np.arange(start, inside.known[0][-1], step)
    found = {"grid": grid, "until_s": np.array(ground.until_s), **drivers(record, grid)}
    known = np.ones(len(grid), bool)
    for name, quantity in (("T", TEMPERATURE), ("v", HUMIDITY)):
        if quantity in ground.quantities:
            time, value = ground.readings[quantity]
            found[name] = np.interp(grid, time, value)
            after = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
            known &= time[after] - time[after - 1] <= LONGEST_GAP_S + step
    return found | {"known": known}


def regressed(ground: Ground, python: str) -> dict:
    """Names, held-out errors, CPU seconds and the chosen terms of PySINDy, run by another interpreter."""
    with tempfile.TemporaryDirectory() as directory:
        given, out = Path(directory) / "courses.npz", Path(directory) / "run.npz"
        made = courses(ground)
        np.savez(given, **made)
        script = Path(__file__).with_name("sparse_regression.py")
        free = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(
            [python, str(script), str(given), str(out)], env=free, capture_output=True, text=True
        )
        if done.returncode:
            raise RuntimeError(f"pysindy: {done.stderr.strip()[-800:]}")
        run = dict(np.load(out))
    account = json.loads(str(run.pop("account")))
    after = {}
    for quantity, name in ((TEMPERATURE, "T"), (HUMIDITY, "v")):
        if quantity in ground.quantities:
            time, value = ground.readings[quantity]
            late = time > ground.until_s
            error = value[late] - np.interp(time[late], made["grid"], run[name])
            rmse = float(np.sqrt(np.mean(error**2)))
            after[quantity] = rmse if np.isfinite(rmse) else None
    terms = [(size, state, term) for state, found in account["terms"].items() for term, size in found]
    largest = max(terms, default=None)
    cause = None if largest is None else cause_of(largest[1], largest[2])
    return {
        "names": [] if cause is None else [cause],
        "after": after,
        "cpu_s": account["cpu_s"],
        "largest": None if largest is None else f"{largest[2]} in {largest[1]}",
        "terms": len(terms),
        "setting": account["setting"],
        "version": account["version"],
    }
