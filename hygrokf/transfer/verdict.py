"""What a transfer found, as plain data and in words: parameters, groups, likelihood ratios, the verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hygrokf.estimation.confidence import Uncertainty
from hygrokf.estimation.optimiser import Estimate
from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification.wording import RULES
from hygrokf.transfer.baseline import Scene
from hygrokf.transfer.groups import HYGRIC, OF_THE_RECORD, THERMAL, Difference, Step, members, unexplained

MATTERS = {
    "ln_time_constant": 0.10,
    "resistance_ratio": 0.05,
    "temperature_K": 0.3,
    "absolute_humidity_g_m3": 0.26,
}
"""Smaller differences do not matter, however significant: 10 % of a time constant, 0.05 of R_AT/(R_AT+R_IC), and in the
simulated readings the paper's loggers' accuracy (0.3 K; 2 % relative humidity, 0.26 g/m³ at 15 °C)."""
STRUCTURE = 1.5
"""Free-run error of the record's own model over that of the fit on its own record, beyond which the form is doubted."""
TRANSFERS, PARTLY, NOT = "transfers", "transfers after re-estimating", "does not transfer"
OPEN = "cannot be judged"


def matters(group: str, apart: Difference, effect: Mapping[str, float]) -> bool:
    """Whether a group's difference is large enough to matter."""
    size = dict(zip(apart.names, np.abs(apart.value), strict=True))
    if group == THERMAL:
        return (
            size.get("thermal_time_constant", 0.0) >= MATTERS["ln_time_constant"]
            or size.get("resistance_ratio", 0.0) >= MATTERS["resistance_ratio"]
        )
    if group == HYGRIC:
        return size.get("hygric_k", 0.0) >= MATTERS["ln_time_constant"]
    return any(effect.get(quantity, 0.0) >= MATTERS[quantity] for quantity in SCORED)


def parameters_of(
    scene: Scene, apart: Difference, values: Mapping[str, Mapping], spread: Uncertainty, own: Estimate
) -> dict:
    """Every parameter: original and own value with standard errors, and by how much they differ with bounds."""
    known = {n: i for i, n in enumerate(scene.origin.names)}
    rows = {}
    for p in scene.base.model.parameters:
        i = known.get(p.name)
        old = None if i is None else math.sqrt(max(float(scene.origin.covariance[i, i]), 0.0))
        place = spread.place(p.name)
        new = None
        if place is not None:
            new = math.sqrt(spread.wald[place, place] * spread.factor[place]) * abs(
                p.slope(own.values[p.name])
            )
        change = None
        if p.name in apart.names:
            change = dict(zip(("value", "lower", "upper"), apart.bounds(p.name), strict=True))
            if p.positive:  # as a ratio
                change = {key: math.exp(min(max(v, -50.0), 50.0)) for key, v in change.items()}
        rows[p.name] = {
            "group": scene.groups[p.name],
            "unit": p.unit,
            "meaning": p.meaning,
            "original": values["as_is"][p.name],
            "original_se": old,
            "own": own.values[p.name],
            "own_se": new if new is None or math.isfinite(new) else None,
            "re_estimated": values["re_estimated"][p.name],
            "difference": change,
            "difference_is": None if change is None else "ratio" if p.positive else "difference",
            "kept": p.name in scene.held,
        }
    return rows


def groups_of(
    scene: Scene,
    apart: Difference,
    steps: Sequence[Step],
    effects: Mapping[str, Mapping[str, float]],
    significant: Sequence[str],
    differing: Sequence[str],
) -> list[dict]:
    """One row a group: the statistic at the step that decided on it, what the difference does, and what follows."""
    rows: list[dict[str, Any]] = []
    for group in dict.fromkeys(scene.groups.values()):
        names = members(scene.groups, group)
        if group in OF_THE_RECORD:
            said = "belongs to the record: always estimated there"
            rows.append({"group": group, "parameters": list(names), "outcome": "own", "statement": said})
            continue
        if group not in effects:
            said = "this record cannot tell"
            rows.append(
                {"group": group, "parameters": list(names), "outcome": "not judged", "statement": said}
            )
            continue
        step = next(s for s in reversed(steps) if group in s.p)
        alone = apart.of(names)
        from scipy.stats import chi2

        single = unexplained(alone, ())
        outcome = "travels"
        said = "no difference that both uncertainties do not explain"
        if group in differing:
            outcome, said = "differs", "differs by more than both uncertainties explain, and enough to matter"
        elif group in significant:
            outcome, said = "travels", "differs measurably, but by less than matters"
        elif _could_matter(group, alone, effects[group]):
            said += "; one that would matter cannot be excluded by this record"
        rows.append(
            {
                "group": group,
                "parameters": list(alone.names),
                "statistic": step.statistic[group],
                "df": step.degrees[group],
                "p": step.p[group],
                "p_adjusted": step.p_adjusted[group],
                "alone": {
                    "statistic": single,
                    "df": len(alone.names),
                    "p": float(chi2.sf(single, len(alone.names))),
                },
                "effect": dict(effects[group]),
                "outcome": outcome,
                "statement": said,
            }
        )
    return rows


def _could_matter(group: str, alone: Difference, effect: Mapping[str, float]) -> bool:
    """Whether a difference that would matter is within the uncertainty of this record.

    Of time constants and the resistance ratio: whether their bounds hold one. Of other groups: whether the estimate itself,
    which is within its bounds, changes the simulation by what matters.
    """
    watched = {
        THERMAL: {"thermal_time_constant": "ln_time_constant", "resistance_ratio": "resistance_ratio"},
        HYGRIC: {"hygric_k": "ln_time_constant"},
    }.get(group)
    if watched is None:
        return matters(group, alone, effect)
    ends = {key: alone.bounds(name)[1:] for name, key in watched.items() if name in alone.names}
    return any(max(-low, high) >= MATTERS[key] for key, (low, high) in ends.items())


def ratios_of(
    scene: Scene,
    logger: Estimate,
    adapted: Estimate,
    own: Estimate,
    spread: Uncertainty,
    differing: Sequence[str],
) -> list[dict]:
    """Exact likelihood ratios on this record alone, the fit's own uncertainty left out, scaled by the mean of the factors
    by which the noise's real colour widens bounds (Kent 1982)."""
    from scipy.stats import chi2

    rows = []
    for first, second, names, label in (
        (
            logger,
            adapted,
            [n for n in scene.cabinet if scene.groups[n] in differing],
            "re-estimating what differs",
        ),
        (
            adapted,
            own,
            [n for n in scene.cabinet if scene.groups[n] not in differing],
            "re-estimating the rest",
        ),
    ):
        if not names:
            continue
        place = [spread.names.index(n) for n in names if n in spread.names]
        factor = float(np.mean(spread.factor[place])) if place else 1.0
        ratio = max(2.0 * (second.objective - first.objective), 0.0)
        rows.append(
            {
                "of": label,
                "parameters": names,
                "likelihood_ratio": ratio,
                "factor": factor,
                "df": len(names),
                "p": float(chi2.sf(ratio / factor, len(names))),
            }
        )
    return rows


def judged(found: Mapping, differing: Sequence[str]) -> tuple[str, list[str]]:
    """Verdict and reasons from what was found."""
    against, reasons, doubts = [], [], []
    tried = [row["group"] for row in found["groups"] if row["outcome"] in ("travels", "differs")]
    unit = {"temperature_K": ("temperature", "K"), "absolute_humidity_g_m3": ("absolute humidity", "g/m³")}
    if len(tried) > 1 and set(tried) == set(differing):
        against.append(
            f"nothing of the cabinet is the same: {_list(differing)} all differ; identify this turbine by itself"
        )
    if found["at_bounds"]:
        against.append(f"re-estimated at the edge of its range: {', '.join(found['at_bounds'])}")
    for quantity, row in found["structure"].items():
        if row["lower"] is not None and row["lower"] > STRUCTURE:
            name, u = unit[quantity]
            against.append(
                f"even with all parameters estimated here the simulated {name} errs by {row['rmse']:.2f} {u}, "
                f"{row['ratio']:.1f} times as much as the fit did on its own record: the model lacks something here; "
                "`hygrokf discover` may name it"
            )
    for quantity, rows in found["gains"].items():
        over = rows.get("re_estimated", {}).get("over_rule")
        name, u = unit[quantity]
        if over and over["upper"] is None and over["gain"] < 0.0:
            doubts.append(
                f"the simulated {name} errs by {-over['gain']:.2f} {u} more than the rule “{RULES.get(over['against'], over['against'])}”, "
                f"and {found['n_readings']} readings are too few for bounds: take a longer record"
            )
        if over and over["upper"] is not None and over["upper"] < 0.0:
            against.append(
                f"no gain over the sceptic's rule: the simulated {name} errs by {-over['gain']:.2f} {u} more than "
                f"“{RULES.get(over['against'], over['against'])}” does"
            )
    for quantity, rows in found["gains"].items():
        gain = rows.get("re_estimated", {}).get("over_as_is")
        if differing and gain and gain["upper"] is not None and gain["upper"] < 0.0:
            name, u = unit[quantity]
            against.append(
                f"re-estimating {_list(differing)} makes the error of the simulated {name} larger by {-gain['gain']:.2f} {u}, "
                "beyond its bounds: what the identification period says does not hold afterwards; take a longer one"
            )
        if gain:
            name, u = unit[quantity]
            table = found["rmse"][quantity]
            before, after = table["as_is"]["total"], table["re_estimated"]["total"]
            bounds = (
                ""
                if gain["lower"] is None
                else f", a gain of {gain['gain']:.2f} {u} ({gain['lower']:.2f} … {gain['upper']:.2f}, 95 %)".replace(
                    "-", "−"
                )
            )
            where = "held-out error" if found["period"] == "validation" else "error"
            what = "own offsets" if not differing else "re-estimating"
            reasons.append(
                f"{where} of the {name}: {before:.2f} {u} as it is, {after:.2f} {u} after {what}{bounds}"
            )
    if against:
        return NOT, against + reasons
    if doubts:
        return OPEN, doubts + reasons
    return (PARTLY if differing else TRANSFERS), reasons


def sentence(verdict: str, differing: Sequence[str]) -> str:
    """The verdict in words."""
    return f"{verdict} {_list(differing)}" if verdict == PARTLY else verdict


def _list(names: Sequence[str]) -> str:
    names = list(names)
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
