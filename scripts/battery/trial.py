"""One case from its record to a line of results."""

from __future__ import annotations

import hashlib
import math
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from importlib import import_module
from pathlib import Path

import numpy as np
from plants.as_record import to_record
from plants.convection import convecting_plant
from plants.hidden import hidden_plant
from plants.paper import paper_case
from plants.plant import Hidden, Plant, undisturbed

import hygrokf
from battery.cases import Case
from battery.measured import IDENTIFIED, absent, injected, measured
from hygrokf.data.record import Record

ENGINES = ("discover", "choose")
QUANTITY = {"temperature": "temperature_K", "absolute_humidity": "absolute_humidity_g_m3"}
PART = {"temperature": "thermal", "absolute_humidity": "hygric"}


@lru_cache(maxsize=1)
def sources_hash() -> str:
    """The package's sources in twelve digits: results of other sources are other results."""
    root = Path(hygrokf.__file__).parent
    found = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        found.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:12]


def load(engine: str) -> None:
    """Load an engine before processes are forked: all of them run, and name, the sources as they are now."""
    sources_hash()
    import_module(f"hygrokf.discovery.{'procedure' if engine == 'discover' else 'model_selection'}")


def case_key(case: Case, engine: str) -> str:
    return f"{engine}:{case.key}"


def run_case(case: Case, engine: str = "discover", starts: int | None = None) -> dict:
    """The line of a case.  What is raised is part of the result; a record that is not there leaves a
    reason."""
    line: dict = {
        "key": case_key(case, engine),
        "group": case.group,
        "engine": engine,
        "seed": case.seed,
        "days": None if case.record else case.days,
        "asked": [[cause, form] for cause, form in case.causes],
        "strength": case.strength,
        "decoy": case.decoy,
        "record": case.record,
        "effect": case.effect,
        "sources": sources_hash(),
        "starts": starts,
        "truth": [],
        "skipped": absent(case.record) if case.record else "",
        "failure": None,
    }
    if line["skipped"]:
        return line
    begin = middle = time.process_time()
    try:
        record, line["truth"] = make(case)
        middle = time.process_time()
        line |= (_discovered if engine == "discover" else _chosen)(record, line["truth"], starts)
    except Exception as broken:  # a battery counts failures, it does not stop at them
        line["failure"] = {
            "type": type(broken).__name__,
            "message": str(broken),
            "trace": traceback.format_exc()[-3000:],
        }
    line["making_s"] = middle - begin
    line["cpu_s"] = time.process_time() - middle
    return plain(line)


# -- records -------------------------------------------------------------------------------------------------
def make(case: Case) -> tuple[Record, list[dict]]:
    """The record of a case and the accounts of what is hidden in it."""
    if case.record:
        record = measured(case.record)
        if not case.effect:
            return record, []
        record, account = injected(record, case.effect, case.seed)
        return record, [account]
    if case.group == "paper":
        made = paper_case(case.seed, decoy=case.decoy or None, form=case.causes[0][1], days=case.days)
    elif case.group == "convection":
        made = convecting_plant(case.seed, days=case.days)
    else:
        first, form = case.causes[0] if case.causes else ("none", 0)
        made = hidden_plant(
            case.seed,
            first,
            form=form,
            strength=case.strength,
            days=case.days,
            second=case.causes[1] if len(case.causes) > 1 else None,
        )
    record = to_record(made)
    until_s = identified_until(record, made)
    accounts = [account_of(one, made) for one in made.truth.hidden]
    if case.group == "hidden":
        # The cause's own model is wrong by the disturbances, which are not equally large in all parts of a
        # record.
        shares = disturbance_shares(hidden_plant(case.seed, "none", days=case.days), until_s)
        accounts = [{**one, "disturbance_shares": shares[one["quantity"]]} for one in accounts]
    return to_record(made, until_s=until_s), accounts


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


def disturbance_shares(nothing: Plant, until_s: float) -> dict[str, dict[str, float]]:
    """Size of the disturbances before and after an instant [s] over that in the whole record [-], by
    quantity."""
    with_them, without = nothing.trajectory, undisturbed(nothing)
    early = nothing.drivers.time <= until_s
    found = {}
    for quantity, name in (("temperature", "cabinet_K"), ("absolute_humidity", "cabinet_kg_m3")):
        square = (getattr(with_them, name) - getattr(without, name)) ** 2
        parts = {"identification": square[early], "validation": square[~early]}
        found[quantity] = {period: math.sqrt(part.mean() / square.mean()) for period, part in parts.items()}
    return found


def account_of(hidden: Hidden, made: Plant) -> dict:
    """The truth of a hidden cause as plain data, with the gain to be had, and what can be held against an
    estimate."""
    return {
        **asdict(hidden),
        "attainable": 1.0 - hidden.rmse_true / hidden.rmse_with,
        "comparable": comparable(hidden.cause, hidden.parameters, made.cabinet.volume),
    }


def comparable(cause: str, truth: Mapping[str, float], volume_m3: float) -> dict[str, float]:
    """True values of the library's parameters where the plant's form has the same parameter."""
    found = {}
    if cause == "moisture_sorption":
        found["sorption_time"] = truth["time_constant_h"]
        if "dry_material_kg" in truth:
            wet, c = 0.5 * truth["gab_k"], truth["gab_c"]
            steepness = 2.0 * (1.0 + (c - 1.0) * wet**2) / ((1.0 - wet) * (1.0 + (c - 1.0) * wet))
            slope_kg = truth["dry_material_kg"] * truth["water_at_half_humidity"] * steepness
        else:  # the slab's isotherm is a straight line
            slope_kg = truth["water_at_full_humidity_kg"]
        found["sorption_capacity"] = 1e3 * slope_kg / volume_m3
    elif cause == "condensation" and "hold_g_m2" not in truth:
        if "surface_lag_h" in truth:
            found["surface_time"] = truth["surface_lag_h"]
    elif cause == "rain_ingress" and "evaporation_h" in truth:
        found["rain_drying_time"] = truth["evaporation_h"]
    elif cause == "temperature_sensor_offset":
        found["temperature_offset"] = truth["offset_K"]
    elif cause == "humidity_sensor_drift" and "ceiling" in truth:
        found["humidity_ceiling"] = truth["ceiling"]
    return found


# -- engines -------------------------------------------------------------------------------------------------
def _discovered(record: Record, truth: list[dict], starts: int | None) -> dict:
    from hygrokf.discovery.procedure import discover

    results = discover(record, budget_s=math.inf, **({} if starts is None else {"starts": starts})).to_json()
    return read_discovery(results, truth)


def read_discovery(results: Mapping, truth: list[dict]) -> dict:
    """What the battery keeps of `discovery.json`; gains in the hidden quantities go into the accounts of the
    truth."""
    for account in truth:
        if account.get("quantity"):
            before, after, source = errors(results, QUANTITY[account["quantity"]])
            account |= gained(account, before, after, "validation", source)
    true = {account["cause"] for account in truth}
    causes = [
        {
            "cause": one["cause"],
            "form": one.get("form"),
            "confidence": one["confidence"],
            "ambiguous_with": list(one["ambiguous_with"]),
            "lr": one["evidence"]["lr"],
            "bic_gain": one["evidence"]["bic_gain"],
            "evidence": one["evidence"],
            "gain": one["gain"],
            "parameters": one["parameters"],
            "settings": one.get("settings"),
        }
        for one in results["causes"]
    ]
    return {
        "verdict": results["verdict"],
        "causes": causes,
        "rejected": [row for row in results["rejected"] if row["cause"] in true],
        "unexplained": results["unexplained"],
        "rmse": {side: (results[side] or {}).get("rmse") for side in ("baseline", "extended")},
    }


def errors(results: Mapping, quantity: str) -> tuple[float | None, float | None, str]:
    """Free-run errors in a quantity without and with the causes that were named, and where they were read.

    From the reported gain where a cause's is in that quantity (against the better of two bases); else those
    of both models on the validation period; without a cause nothing was gained.
    """
    for one in results["causes"]:
        gain = one["gain"] or {}
        if gain.get("quantity") == quantity and gain.get("period", "validation") == "validation":
            return gain.get("rmse_before"), gain.get("rmse_after"), "reported gain"

    def total(side: str) -> float | None:
        rows = (results[side] or {}).get("rmse", {})
        return rows.get("validation", {}).get(quantity, {}).get("total")

    if not results["causes"]:
        return total("baseline"), total("baseline"), "no cause"
    return total("baseline"), total("extended"), "errors of both models"


def gained(
    account: Mapping, before: float | None, after: float | None, period: str, source: str
) -> dict[str, object]:
    """Achieved gain, and the gain to be had on the same stretch: that of the true mechanism with true
    parameters.

    before, after: [K] or [g/m3] free-run errors on a period.
    """
    found: dict[str, object] = {
        "achieved": None,
        "attainable_there": None,
        "achieved_by": f"{source}, {period}",
    }
    if not before or after is None:
        return found
    found["achieved"] = 1.0 - after / before
    shares = account.get("disturbance_shares")
    if shares:
        true = account["rmse_true"] * (1e3 if account["quantity"] == "absolute_humidity" else 1.0)
        found["attainable_there"] = 1.0 - true * shares[period] / before
    return found


def _chosen(record: Record, truth: list[dict], starts: int | None) -> dict:
    """Scene and choice alone: no bounds, gains on the identification period."""
    from hygrokf.discovery.baseline import baseline
    from hygrokf.discovery.evidence import confidence
    from hygrokf.discovery.model_selection import select
    from hygrokf.discovery.submodel import rmse

    base = baseline(record, **({} if starts is None else {"starts": starts}))
    choice = select(base)
    for account in truth:
        part = PART.get(account.get("quantity", ""))
        if part in base.submodels:
            before, after = rmse(base.submodels[part]), rmse(choice.baseline.submodels[part])
            account |= gained(account, before, after, "identification", "errors of both models")

    def told(trial) -> dict:
        return {
            "cause": trial.variant.cause,
            "form": trial.variant.form,
            "lr": trial.lr,
            "bic_gain": trial.bic_gain,
            "evidence": {"lr": trial.lr, "bic_gain": trial.bic_gain, "df": trial.parameters},
            "gain": {"free_run": dict(trial.gain), "lasting": dict(trial.lasting)},
            "settings": dict(trial.variant.settings),
        }

    causes = []
    for accepted in choice.accepted:
        trial = accepted.candidate
        values = {
            name: {"value": value}
            for part, found in trial.submodels.items()
            for name, value in found.values.items()
            if name not in base.submodels[part].values
        }
        named = [other.variant.cause for other in accepted.rivals]
        told_more = {
            "confidence": confidence(trial, accepted.margin),
            "margin": accepted.margin,
            "once": trial.once,
        }
        causes.append({**told(trial), **told_more, "ambiguous_with": named, "parameters": values})
    true = {account["cause"] for account in truth}
    rejected = [
        {**told(trial), "reason": reason} for trial, reason in choice.rejected if trial.variant.cause in true
    ]
    verdict = "named" if causes else "none"
    return {"verdict": verdict, "causes": causes, "rejected": rejected, "unexplained": None, "rmse": None}


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
