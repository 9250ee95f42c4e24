"""One case from its record to a line of results."""

from __future__ import annotations

import hashlib
import math
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from plants.as_record import to_record
from plants.hidden import hidden_plant
from plants.nulls import null_plant
from plants.plant import Plant

import hygrokf
from battery.cases import DAYS, Case
from battery.measured import IDENTIFIED, absent, before_the_last_fifth, measured
from hygrokf.data.clocks import Shift, shifted
from hygrokf.data.record import Record
from hygrokf.discovery.results import Discovery


@lru_cache(maxsize=1)
def sources_hash() -> str:
    """The package's sources in twelve digits: results of other sources are other results."""
    root = Path(hygrokf.__file__).parent
    found = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        found.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:12]


def run_case(case: Case) -> dict:
    """The line of a case.  What is raised is part of it; a record that is not there leaves a reason."""
    line: dict = {
        "key": case.key,
        "group": case.group,
        "cell": case.cell,
        "seed": case.seed,
        "asked": [list(one) for one in case.causes],
        "strength": 0.5 if case.halved else 1.0,
        "sources": sources_hash(),
        "known": asdict(case.known) if case.known else None,
        "skipped": absent(case.known.record) if case.known else "",
        "failure": None,
        "hidden": [],
        "verdict": None,
        "names": [],
        "refuted": [],
        "errors": {},
        "lines": [],
        "last_fifth": {},
        "simulations": None,
        "cpu_s": 0.0,
    }
    if line["skipped"]:
        return line
    try:
        record, line["hidden"], whole = make(case)
        line |= found(record, whole)
    except Exception as broken:  # trials count failures, they do not stop at them
        line["failure"] = {
            "type": type(broken).__name__,
            "message": str(broken),
            "trace": traceback.format_exc()[-3000:],
        }
    return plain(line)


def make(case: Case) -> tuple[Record, list[dict], Record | None]:
    """The record of a case, the accounts of what is hidden in it, and of a measured one, which is cut before
    its last fifth, the whole."""
    if case.known:
        cut, whole = before_the_last_fifth(measured(case.known.record, case.known.variant))
        return cut, [], whole
    if case.null:
        made = null_plant(case.plant_seed, case.null, days=DAYS)
    else:
        (cause, form), *others = case.causes
        second = others[0] if others else None
        made = hidden_plant(case.plant_seed, cause, form=form, halved=case.halved, days=DAYS, second=second)
    record = to_record(made)
    record = to_record(made, until_s=identified_until(record, made))
    return record, [asdict(one) for one in made.truth.hidden], None


def identified_until(record: Record, made: Plant) -> float:
    """End of the identification period [s]: two thirds of the record, later where a change would else lie
    behind it.

    What begins in the validation period cannot be identified; so that it can, a seventh of the record follows
    the date.
    """
    span = record.end_s - record.start_s
    dates = [float(np.median(one.dates)) for one in made.truth.hidden if len(one.dates)]
    latest = max(((date - record.start_s) / span for date in dates), default=0.0)
    return record.start_s + min(max(IDENTIFIED, latest + 1.0 / 7.0), 0.95) * span


def found(record: Record, whole: Record | None = None) -> dict:
    """What is named in a record, what was refuted, free-run errors on held-out readings and on those of the
    whole record that were cut off, and the work."""
    begin = time.process_time()
    discovery = hygrokf.discover(record)
    results, spent = discovery.results, time.process_time() - begin
    return {
        "verdict": results.verdict,
        "names": [{**_told(one), "rivals": list(one.ambiguous_with), "confidence": one.confidence,
                   "worth": one.held_out.improvement} for one in results.causes],
        "refuted": [{**_told(one), "reason": one.held_out.reason} for one in results.refuted],
        "errors": {one.quantity: [one.rmse_before, one.rmse_after] for one in results.gains},
        "lines": [[one.quantity, one.period_h, one.p, one.cause] for one in results.lines],
        "last_fifth": {} if whole is None else afterwards(discovery, whole, record.end_s),
        "simulations": results.work.simulations,
        "cpu_s": spent,
    }  # fmt: skip


def afterwards(discovery: Discovery, whole: Record, from_s: float) -> dict[str, list[float]]:
    """Free-run errors [K], [g/m³] of the base and of the told model on readings after an instant [s], by
    quantity."""
    later = replace(whole, until_s=from_s)
    shifts = [
        Shift(one.settings["source"], one.settings["shift_s"])
        for one in discovery.results.causes
        if "shift_s" in one.settings
    ]
    base = hygrokf.evaluate(discovery.base, later)
    told = hygrokf.evaluate(discovery.extended, shifted(later, *shifts)) if discovery.extended else base
    quantities = ("temperature_K", "absolute_humidity_g_m3")
    pairs = {q: [one.errors("validation", q).total for one in (base, told)] for q in quantities}
    return {q: pair for q, pair in pairs.items() if np.isfinite(pair).all()}


def _told(one) -> dict:
    return {
        "cause": one.cause, "form": one.form, "evidence": one.evidence.evidence,
        "evidence_in_days": one.evidence.in_days, "lead": one.evidence.lead,
    }  # fmt: skip


def plain(value):
    """The same as JSON can hold it: numbers of numpy as Python's, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
