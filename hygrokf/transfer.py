"""The model of one turbine on the record of another: what travels, what must be re-estimated, what that gains.

The record's identification period (without `until` the first three quarters) estimates, its held-out rest judges.  Four
sets of values are run over it, all with the design of the fit:

- as it is: every parameter of the fit;
- own loggers: offsets of the sensors and disturbances estimated here, the cabinet as it was fitted;
- re-estimated: besides, the groups of the cabinet's parameters that differ;
- all its own: every parameter estimated here.

A group differs where the two estimates are further apart than both uncertainties explain (`parameter_groups`; both
covariances count, each the wider of Wald and sandwich) and where the difference matters (`MATTERS`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

import numpy as np

from hygrokf.confidence import Bounds, Uncertainty, normal_quantile, uncertainty
from hygrokf.design import JOINT, Design, accuracy_of, read_as
from hygrokf.drivers import Run, run
from hygrokf.fit import Fit
from hygrokf.fitting import Estimate, Objective, maximise
from hygrokf.identification import Basis, assembled
from hygrokf.likelihood import Likelihood
from hygrokf.parameter_groups import (
    DISTURBANCES,
    HEAT,
    HYGRIC,
    OF_THE_RECORD,
    OFFSETS,
    THERMAL,
    Difference,
    Step,
    group_of,
    members,
    selection,
    unexplained,
)
from hygrokf.parameters import Coordinates
from hygrokf.record import Record
from hygrokf.resampling import Resampled, resampled
from hygrokf.scoring import SCORED, guesses, period_masks, rmse
from hygrokf.simulation import Prediction, free_run, measured
from hygrokf.stage import TIME_CONSTANTS, Stage
from hygrokf.turbine_type import TurbineType
from hygrokf.version import __version__

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
EARLY_SHARE = 0.75
SETS = ("as_is", "own_loggers", "re_estimated", "all_own")
TRANSFERS, PARTLY, NOT = "transfers", "transfers after re-estimating", "does not transfer"
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Origin:
    """What is taken elsewhere: a design, its values, and how sure they are (covariance of `names`, in their units).

    `rmse` [K] and [g/m³]: the free run's errors where it comes from, by quantity, if known.  `kind` "fit" or "type".
    """

    name: str
    kind: str
    design: Design
    values: Mapping[str, float]
    names: tuple[str, ...]
    covariance: np.ndarray
    rmse: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, source: Fit | TurbineType) -> Origin:
        """From a fit, or from a type: then the covariance is that of the next turbine's own values."""
        if isinstance(source, TurbineType):
            values = source.values
            names = tuple(n for n in source.parameters if n in values)
            slopes = [values[n] if source.parameters[n].logarithmic else 1.0 for n in names]
            sd = [source.parameters[n].next_sd * slope for n, slope in zip(names, slopes, strict=True)]
            return cls(source.name, "type", source.design, values, names, np.diag(np.square(sd)))
        names, matrix = source.covariance
        scored = source.results.get("rmse", {}).get("identification", {})
        known = {q: row["total"] for q, row in scored.items() if row.get("total")}
        values = {p.name: source.values[p.name] for p in source.design.model.parameters}
        return cls(source.name, "fit", source.design, values, names, matrix, known)


@dataclass(frozen=True)
class Transfer:
    """A fit on another turbine's record: plain `results` (an entry of transfer.json), `series` for pictures, and the
    record's own estimates: `adapted` the model to use there, `own` that with every parameter estimated there (None where
    they were not asked for)."""

    results: Mapping[str, object]
    series: Mapping[str, np.ndarray]
    adapted: Fit | None = None
    own: Fit | None = None

    @property
    def verdict(self) -> str:
        return str(self.results["verdict"])


@dataclass(frozen=True)
class _Scene:
    """What all four sets share."""

    origin: Origin
    record: Record
    early: Record
    base: Design
    run: Run
    early_run: Run
    held: dict[str, float]
    groups: dict[str, str]

    @property
    def likelihood(self) -> Likelihood:
        return Likelihood(self.base.model, self.early_run.timeline)

    @property
    def cabinet(self) -> tuple[str, ...]:
        """Parameters of the cabinet that this record can tell something about."""
        return tuple(n for n, g in self.groups.items() if g not in OF_THE_RECORD and n not in self.held)


def transfer_fit(
    source: Fit | TurbineType, record: Record, progress: Progress | None = None, fits: bool = True
) -> Transfer:
    """Judge how the model of one turbine, or of a type, does on another turbine's record.

    `fits`: also make the record's own fits, with their scores and bands.  Raises ValueError where the record has no input or reading that the model needs.
    """
    say = progress or (lambda text: None)
    scene, statements = _scene(Origin.of(source), record)
    say("as it is")
    starts = dict(scene.origin.values) | {n: 0.0 for n in members(scene.groups, OFFSETS)}
    cabinet = {n: scene.origin.values[n] for n in scene.cabinet}
    say("own loggers")
    logger = maximise(scene.likelihood, starts, {**scene.held, **cabinet}, count=1)
    say("all parameters")
    own = maximise(scene.likelihood, logger.values, scene.held, count=1)
    if own.objective < logger.objective - 0.01:  # a climb that ended elsewhere
        own = maximise(scene.likelihood, starts, scene.held, count=3)
    say("uncertainty")
    spread = uncertainty(Objective(scene.likelihood, own.coordinates), own)
    apart = difference(scene.origin, own, spread, scene.cabinet)
    steps = selection(apart, scene.groups)
    significant = [step.taken for step in steps if step.taken]
    say("what differences do")
    effects = {group: _effect(scene, own, group) for group in dict.fromkeys(scene.groups[n] for n in apart.names)}
    differing = [g for g in significant if _matters(g, apart.of(members(scene.groups, g)), effects[g])]
    say("re-estimated")
    adapted, told = _adapted(scene, logger, own, differing), spread
    if adapted is not own:
        told = uncertainty(Objective(scene.likelihood, adapted.coordinates), adapted)
    values = {
        "as_is": dict(scene.origin.values),
        "own_loggers": logger.values,
        "re_estimated": adapted.values,
        "all_own": own.values,
    }
    say("held-out errors")
    predicted = {name: free_run(scene.base, one, scene.run) for name, one in values.items()}
    scored = _scored(scene, predicted)
    found = {
        "name": record.name,
        "synthetic": "synthetic" in record.name.lower(),
        "from": {"name": scene.origin.name, "kind": scene.origin.kind},
        "until": _stamp(scene.record.until_s),
        "n_readings": scene.early_run.timeline.n_readings,
        "parameters": _parameters(scene, apart, values, spread, own),
        "groups": _groups(scene, apart, steps, effects, significant, differing),
        "likelihood_ratios": _ratios(scene, logger, adapted, own, spread, differing),
        **scored,
        "structure": _structure(scene, predicted["all_own"]),
        "at_bounds": [n for n in adapted.at_bounds if scene.groups[n] in differing and n != "resistance_ratio"],
        "converged": {"own_loggers": logger.converged, "re_estimated": adapted.converged, "all_own": own.converged},
        "statements": statements,
        "matters": dict(MATTERS),
    }
    verdict, reasons = judged(found, differing)
    found |= {"verdict": verdict, "re_estimate": differing, "reasons": reasons, "sentence": sentence(verdict, differing)}
    series = _series(scene, predicted)
    if not fits:
        return Transfer(found, series)
    say("its own fit")
    mine = _fit(scene, own, spread)
    return Transfer(found, series, mine if adapted is own else _fit(scene, adapted, told), mine)


def _scene(origin: Origin, record: Record) -> tuple[_Scene, list[str]]:
    """The record's periods, its run, and which parameters it can say nothing about."""
    statements = []
    if record.until_s is None:
        cabinet = [record[n] for n in ("cabinet_temperature", *_HUMIDITIES) if n in record]
        first, last = min(s.time[0] for s in cabinet), max(s.time[-1] for s in cabinet)
        record = replace(record, until_s=float(first + EARLY_SHARE * (last - first)))
        statements.append(f"no `until` is stated: estimated on the first three quarters, up to {_stamp(record.until_s)}")
    base = replace(read_as(origin.design, record), priors={})
    groups = group_of(base.model)
    early = record.identification()
    early_run = run(base, early)
    coordinates = Coordinates(base.model.parameters)
    objective = Objective(Likelihood(base.model, early_run.timeline), coordinates)
    information = np.diag(objective.information(coordinates.start(origin.values))[2])
    held = {}
    for p, known in zip(coordinates.free, information, strict=True):
        width = p.to_coordinate(p.upper) - p.to_coordinate(p.lower)
        if not known * width**2 > 1.0:
            held[p.name] = origin.values[p.name]
    if held:
        statements.append(f"this record says nothing about {', '.join(held)}: kept as they were")
    ratio = None
    if record.rated_power_W and origin.design.power_scale_W:
        ratio = record.rated_power_W / origin.design.power_scale_W
    if ratio is not None and abs(ratio - 1.0) > 0.02:
        statements.append(
            f"this turbine's rated power is {ratio:.2f} times that of the fit: another type? The heat release counts power "
            "in the fit's scale"
        )
    return _Scene(origin, record, early, base, run(base, record), early_run, held, groups), statements


_HUMIDITIES = ("cabinet_relative_humidity", "cabinet_absolute_humidity")


def difference(origin: Origin, own: Estimate, spread: Uncertainty, names: Sequence[str]) -> Difference:
    """Own less original values of the named parameters in their coordinates; both covariances add up.

    A parameter that the origin knows without standard error (at a bound there) counts as known as well as here.  Those at
    a bound here are left out.
    """
    free = {p.name: p for p in own.coordinates.free}
    kept = [n for n in names if n in spread.names]
    place = [spread.names.index(n) for n in kept]
    # the exact information's correlations, widened to the sandwich where that is wider
    grow = np.sqrt(spread.factor[place])
    covariance = spread.wald[np.ix_(place, place)] * np.outer(grow, grow)
    old = np.zeros_like(covariance)
    known = {n: i for i, n in enumerate(origin.names)}
    slopes = np.array([free[n].slope(origin.values[n]) for n in kept])
    for i, a in enumerate(kept):
        if a not in known:
            old[i, i] = covariance[i, i]
            continue
        for j, b in enumerate(kept):
            if b in known:
                old[i, j] = origin.covariance[known[a], known[b]] / (slopes[i] * slopes[j])
    value = np.array([free[n].to_coordinate(own.values[n]) - free[n].to_coordinate(origin.values[n]) for n in kept])
    return Difference(tuple(kept), value, covariance + old)


def _effect(scene: _Scene, own: Estimate, group: str) -> dict[str, float]:
    """What a group's own values change in the free run: root mean square [K] and [g/m³] over the record."""
    changed = dict(scene.origin.values) | {n: own.values[n] for n in members(scene.groups, group)}
    runs = [free_run(scene.base, values, scene.run) for values in (scene.origin.values, changed)]
    found = {}
    for quantity in SCORED:
        pairs = [made.of(quantity) for made in runs]
        if pairs[0] is not None:
            found[quantity] = float(np.sqrt(np.mean((pairs[0][0] - pairs[1][0])[scene.run.scored] ** 2)))
    return found


def _matters(group: str, apart: Difference, effect: Mapping[str, float]) -> bool:
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


def _adapted(scene: _Scene, logger: Estimate, own: Estimate, differing: Sequence[str]) -> Estimate:
    """Offsets, disturbances and the differing groups estimated here, the others as they were."""
    if not differing:
        return logger
    fixed = {n: scene.origin.values[n] for n in scene.cabinet if scene.groups[n] not in differing}
    if not fixed:
        return own
    start = {**own.values, **fixed}
    return maximise(scene.likelihood, start, {**scene.held, **fixed}, count=1)


# --- held-out errors -------------------------------------------------------------------------


def _errors(scene: _Scene, predicted: Mapping[str, Prediction], quantity: str) -> dict[str, np.ndarray]:
    """Errors (T,) of every set and of the sceptic's rules at scored instants."""
    reading = measured(scene.run)[quantity]
    columns = {n: pair[0] for n, made in predicted.items() if (pair := made.of(quantity)) is not None}
    columns |= {
        n: guess[quantity] for n, guess in guesses(scene.run, scene.record.until_s).items() if quantity in guess
    }
    return {n: np.where(scene.run.scored, reading - value, np.nan) for n, value in columns.items()}


def _scored(scene: _Scene, predicted: Mapping[str, Prediction]) -> dict:
    """Table III of the four sets and the rules, held out; bounds, gains over "as it is" and over the best rule."""
    masks = period_masks(scene.run, scene.record.until_s)
    late = masks["validation"] if (masks["validation"] & scene.run.scored).any() else masks["identification"]
    seconds = scene.run.timeline.origin_s + 3600.0 * scene.run.timeline.time
    table: dict = {}
    gains: dict = {}
    for quantity in SCORED:
        errors = {n: np.where(late, e, np.nan) for n, e in _errors(scene, predicted, quantity).items()}
        names = [n for n, e in errors.items() if np.isfinite(e).any()]
        if not names:
            continue
        drawn = resampled(seconds, np.column_stack([errors[n] for n in names]))
        if drawn is None:
            continue
        there = np.isfinite(np.column_stack([errors[n] for n in names])).all(axis=1)
        table[quantity] = {
            n: rmse(np.where(there, errors[n], np.nan), scene.run.operating) | {"bounds": _pair(drawn.bounds(i))}
            for i, n in enumerate(names)
        }
        gains[quantity] = _gains(drawn, names)
    period = "validation" if late is masks["validation"] else "identification"
    return {"period": period, "rmse": table, "gains": gains}


def _gains(drawn: Resampled, names: Sequence[str]) -> dict:
    """How much less each set errs than the model as it is, and than the best of the sceptic's rules."""
    result: dict = {}
    rules = [n for n in names if n not in SETS]
    best = min(rules, key=lambda n: drawn.value[names.index(n)]) if rules else None
    for name in (n for n in SETS if n in names):
        result[name] = {}
        for key, other in (("over_as_is", "as_is"), ("over_rule", best)):
            if other is None or other not in names or other == name:
                continue
            i, j = names.index(other), names.index(name)
            found = drawn.difference(i, j)
            low, high = (None, None) if found is None else found[1:]
            value = float(drawn.value[i] - drawn.value[j])
            result[name][key] = {"against": other, "gain": value, "lower": low, "upper": high}
    return result


def _structure(scene: _Scene, predicted: Prediction) -> dict:
    """Free-run error of the record's own model in the identification period, beside that of the fit on its own record."""
    masks = period_masks(scene.run, scene.record.until_s)
    seconds = scene.run.timeline.origin_s + 3600.0 * scene.run.timeline.time
    found = {}
    for quantity in SCORED:
        errors = _errors(scene, {"all_own": predicted}, quantity).get("all_own")
        before = scene.origin.rmse.get(quantity)
        if errors is None or before is None:
            continue
        drawn = resampled(seconds, np.where(masks["identification"], errors, np.nan)[:, None])
        if drawn is not None:
            bounds = _pair(drawn.bounds(0))
            ratio = float(drawn.value[0]) / before
            low = None if bounds is None else bounds[0] / before
            found[quantity] = {"rmse": float(drawn.value[0]), "rmse_of_the_fit": before, "ratio": ratio, "lower": low}
    return found


def _pair(bounds: tuple[float, float] | None) -> list[float] | None:
    return None if bounds is None else list(bounds)


# --- what was found, as plain data -----------------------------------------------------------


def _parameters(
    scene: _Scene, apart: Difference, values: Mapping[str, Mapping], spread: Uncertainty, own: Estimate
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
            new = math.sqrt(spread.wald[place, place] * spread.factor[place]) * abs(p.slope(own.values[p.name]))
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


def _groups(
    scene: _Scene,
    apart: Difference,
    steps: Sequence[Step],
    effects: Mapping[str, Mapping[str, float]],
    significant: Sequence[str],
    differing: Sequence[str],
) -> list[dict]:
    """One row a group: the statistic at the step that decided on it, what the difference does, and what follows."""
    rows = []
    for group in dict.fromkeys(scene.groups.values()):
        names = members(scene.groups, group)
        if group in OF_THE_RECORD:
            said = "belongs to the record: always estimated there"
            rows.append({"group": group, "parameters": list(names), "outcome": "own", "statement": said})
            continue
        if group not in effects:
            said = "this record cannot tell"
            rows.append({"group": group, "parameters": list(names), "outcome": "not judged", "statement": said})
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
        elif _could_matter(group, alone):
            said += "; one that would matter cannot be excluded by this record"
        rows.append(
            {
                "group": group,
                "parameters": list(alone.names),
                "statistic": step.statistic[group],
                "df": step.degrees[group],
                "p": step.p[group],
                "p_adjusted": step.p_adjusted[group],
                "alone": {"statistic": single, "df": len(alone.names), "p": float(chi2.sf(single, len(alone.names)))},
                "effect": dict(effects[group]),
                "outcome": outcome,
                "statement": said,
            }
        )
    return rows


def _could_matter(group: str, alone: Difference) -> bool:
    """Whether the bounds of a time constant's difference hold one that would matter."""
    name = {THERMAL: "thermal_time_constant", HYGRIC: "hygric_k"}.get(group)
    if name is None or name not in alone.names:
        return False
    _, low, high = alone.bounds(name)
    return max(-low, high) >= MATTERS["ln_time_constant"]


def _ratios(
    scene: _Scene, logger: Estimate, adapted: Estimate, own: Estimate, spread: Uncertainty, differing: Sequence[str]
) -> list[dict]:
    """Exact likelihood ratios on this record alone, the fit's own uncertainty left out, scaled by the mean of the factors
    by which the noise's real colour widens bounds (Kent 1982)."""
    from scipy.stats import chi2

    rows = []
    for first, second, names, label in (
        (logger, adapted, [n for n in scene.cabinet if scene.groups[n] in differing], "re-estimating what differs"),
        (adapted, own, [n for n in scene.cabinet if scene.groups[n] not in differing], "re-estimating the rest"),
    ):
        if not names:
            continue
        place = [spread.place(n) for n in names if spread.place(n) is not None]
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
    against, reasons = [], []
    tried = [row["group"] for row in found["groups"] if row["outcome"] in ("travels", "differs")]
    unit = {"temperature_K": ("temperature", "K"), "absolute_humidity_g_m3": ("absolute humidity", "g/m³")}
    if len(tried) > 1 and set(tried) == set(differing):
        against.append(f"nothing of the cabinet is the same: {_list(differing)} all differ; identify this turbine by itself")
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
        if over and over["upper"] is not None and over["upper"] < 0.0:
            name, u = unit[quantity]
            against.append(
                f"no gain over the sceptic's rule: the simulated {name} errs by {-over['gain']:.2f} {u} more than "
                f"`{over['against']}` does"
            )
    for quantity, rows in found["gains"].items():
        gain = rows.get("re_estimated", {}).get("over_as_is")
        if gain:
            name, u = unit[quantity]
            bounds = "" if gain["lower"] is None else f" (95 % {gain['lower']:.2f} … {gain['upper']:.2f})"
            reasons.append(f"held-out error of the {name}: {gain['gain']:+.2f} {u} less than as it is{bounds}")
    if against:
        return NOT, against + reasons
    return (PARTLY if differing else TRANSFERS), reasons


def sentence(verdict: str, differing: Sequence[str]) -> str:
    """The verdict in words."""
    return f"{verdict} {_list(differing)}" if verdict == PARTLY else verdict


def _list(names: Sequence[str]) -> str:
    names = list(names)
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _stamp(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


# --- fits and series -------------------------------------------------------------------------


def _fit(scene: _Scene, estimate: Estimate, spread: Uncertainty) -> Fit:
    """An estimate on the record as a fit; what travelled keeps the value and the uncertainty that it came with."""
    from hygrokf.stationary import heat_release_regression

    kept = [n for n in scene.origin.names if n in estimate.coordinates.fixed]
    place = [scene.origin.names.index(n) for n in kept]
    parameters = {p.name: p for p in scene.base.model.parameters}
    slopes = np.array([parameters[n].slope(scene.origin.values[n]) for n in kept])
    old = scene.origin.covariance[np.ix_(place, place)] / np.outer(slopes, slopes)
    wider = Uncertainty(
        (*spread.names, *kept),
        _blocks(spread.hessian, np.linalg.pinv(old)),
        _blocks(spread.wald, old),
        _blocks(spread.sandwich, old),
        np.concatenate([spread.factor, np.ones(len(kept))]),
        spread.flat,
        spread.trade_offs,
    )
    bounds = {}
    for name in (n for n in TIME_CONSTANTS if n in parameters and wider.place(n) is not None):
        i = wider.place(name)
        reach = normal_quantile(0.95) * math.sqrt(max(wider.wald[i, i], wider.sandwich[i, i]))
        value = estimate.values[name]
        ends = (value * math.exp(-min(reach, 50.0)), value * math.exp(min(reach, 50.0)))
        said = "taken over" if name in kept else "wald"
        bounds[name] = Bounds(value, *ends, 0.95, said, "", np.empty((0, 2)))
    stage = Stage(scene.base, scene.early_run, estimate, wider, bounds, {}, None)
    basis = Basis(JOINT, (stage,), (scene.early,), heat_release_regression(scene.early))
    made = assembled(scene.record, basis, {})
    made.results["statements"].insert(0, f"design and values that are marked as fixed come from {scene.origin.name}")
    return made


def _blocks(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    n, m = len(first), len(second)
    result = np.zeros((n + m, n + m))
    result[:n, :n], result[n:, n:] = first, second
    return result


def _series(scene: _Scene, predicted: Mapping[str, Prediction]) -> dict[str, np.ndarray]:
    """Readings and the simulations of all sets, for pictures."""
    t = scene.run.timeline
    known = measured(scene.run)
    found = {
        "time_s": t.origin_s + 3600.0 * t.time,
        "scored": scene.run.scored.astype(float),
        "operating": scene.run.operating.astype(float),
        "until_s": np.array(scene.record.until_s),
    }
    for quantity in SCORED:
        found[f"{quantity}_measured"] = known[quantity]
        for name, made in predicted.items():
            if (pair := made.of(quantity)) is not None:
                found[f"{quantity}_{name}"] = pair[0]
    return found


def transfer_json(transfers: Sequence[Transfer], pooled: TurbineType | None = None) -> dict:
    """The data of transfer.json."""
    return {
        "version": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "from": transfers[0].results["from"],
        "records": [dict(one.results) for one in transfers],
        "type": None if pooled is None else pooled.to_json(),
    }
