"""One case from its record to a line of results."""

from __future__ import annotations

import hashlib
import math
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

import numpy as np
from plants.as_record import to_record
from plants.hidden import hidden_plant
from plants.nulls import null_plant
from plants.plant import Plant

import hygrokf
from battery.cases import DAYS, Case
from battery.measured import IDENTIFIED, absent, measured
from hygrokf.data.record import Record
from hygrokf.discovery.estimate import Estimate
from hygrokf.discovery.forms import Ground, forms
from hygrokf.discovery.judgement import Judged, levelled, scores
from hygrokf.discovery.search import search
from hygrokf.discovery.starting_model import base_estimate


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
        "simulations": None,
        "cpu_s": 0.0,
    }
    if line["skipped"]:
        return line
    begin = time.process_time()
    try:
        record, line["hidden"] = make(case)
        begin = time.process_time()
        line |= found(record)
    except Exception as broken:  # trials count failures, they do not stop at them
        line["failure"] = {
            "type": type(broken).__name__,
            "message": str(broken),
            "trace": traceback.format_exc()[-3000:],
        }
    line["cpu_s"] = time.process_time() - begin
    return plain(line)


def make(case: Case) -> tuple[Record, list[dict]]:
    """The record of a case and the accounts of what is hidden in it."""
    if case.known:
        return measured(case.known.record, case.known.variant), []
    if case.null:
        made = null_plant(case.plant_seed, case.null, days=DAYS)
    else:
        (cause, form), *others = case.causes
        second = others[0] if others else None
        made = hidden_plant(
            case.plant_seed, cause, form=form, halved=case.halved, days=DAYS, second=second
        )
    record = to_record(made)
    return to_record(made, until_s=identified_until(record, made)), [asdict(one) for one in made.truth.hidden]


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


def found(record: Record) -> dict:
    """What is named in a record, what was refuted, free-run errors on held-out readings, and the work."""
    base = base_estimate(record)
    release = dict(base.simulator.heat.mechanisms)["heat_release"]
    ground = Ground(
        record.identification(),
        "vapour" in base.quantities,
        release.get("order", 0),
        release.get("operation", False),
    )
    ended = search(base, forms(ground))
    names = [
        {
            **_told(one.candidate),
            "rivals": [rival.cause for rival in one.rivals],
            "worth": worth(one.judged),
        }
        for one in ended.accepted
    ]
    before, after = (held_out_errors(one) for one in (base, ended.final))
    return {
        "verdict": "named" if names else "none",
        "names": names,
        "refuted": [{**_told(one), "reason": judged.reason} for one, judged in ended.refuted],
        "errors": {q: [before[q], after[q]] for q in before},
        "simulations": ended.final.simulator.work.simulations,
    }


def _told(one) -> dict:
    return {
        "cause": one.cause, "form": one.form.code, "evidence": one.evidence, "evidence_in_days": one.in_days,
    }  # fmt: skip


def worth(judged: Judged) -> float:
    """The largest share by which a name lowers a levelled free-run error on held-out readings."""
    return max((1.0 - judged.after[q] / judged.before[q] for q in judged.before), default=0.0)


def held_out_errors(one: Estimate) -> dict[str, float]:
    """Root mean square errors of the levelled free run on held-out readings: temperature [K], vapour
    [g/m3]."""
    return {q: math.sqrt(np.nanmean(s.squares[:, -1])) for q, s in scores(levelled(one)).items()}


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
