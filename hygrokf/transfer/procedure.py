"""The model of one turbine on the record of another: what travels, what must be re-estimated, what that gains.

The record's identification period (without `until` the first three quarters) estimates, its held-out rest judges.  Four
sets of values are run over it, all with the design of the fit:

- as it is: every parameter of the fit;
- own loggers: offsets of the sensors and disturbances estimated here, the cabinet as it was fitted;
- re-estimated: besides, the groups of the cabinet's parameters that differ;
- all its own: every parameter estimated here.

A group differs where the two estimates are further apart than both uncertainties explain (`groups`; both
covariances count, each the wider of Wald and sandwich) and where the difference matters (`account.MATTERS`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from hygrokf.data.record import Record
from hygrokf.estimation.confidence import Bounds, Uncertainty, normal_quantile, uncertainty
from hygrokf.estimation.optimiser import Estimate, Objective, maximise
from hygrokf.evaluation.bootstrap import Resampled, resampled
from hygrokf.evaluation.scoring import SCORED, guesses, period_masks, rmse
from hygrokf.evaluation.simulation import Prediction, measured, simulate
from hygrokf.identification.estimation import TIME_CONSTANTS, Stage
from hygrokf.identification.fit import Fit
from hygrokf.identification.procedure import Basis, assembled
from hygrokf.identification.turbine_type import TurbineType
from hygrokf.identification.verdict import PARTS, inherited, with_reasons
from hygrokf.modelling.design import JOINT
from hygrokf.transfer.baseline import Origin, Scene, difference, scene_of, stamp
from hygrokf.transfer.groups import OFFSETS, members, selection
from hygrokf.transfer.verdict import MATTERS, groups_of, judged, matters, parameters_of, ratios_of, sentence
from hygrokf.version import __version__

SETS = ("as_is", "own_loggers", "re_estimated", "all_own")
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Transfer:
    """A fit on another turbine's record: plain `results` (an entry of transfer.json), `series` for pictures, and the
    record's own estimates: `adapted` the model to use there, `own` that with every parameter estimated there (None where
    they were not asked for)."""

    results: Mapping[str, Any]
    series: Mapping[str, np.ndarray]
    adapted: Fit | None = None
    own: Fit | None = None

    @property
    def verdict(self) -> str:
        return str(self.results["verdict"])


def transfer_fit(
    source: Fit | TurbineType, record: Record, progress: Progress | None = None, fits: bool = True
) -> Transfer:
    """Judge how the model of one turbine, or of a type, does on another turbine's record.

    `fits`: also make the record's own fits, with their scores and bands.  Raises ValueError where the record has no input or reading that the model needs.
    """
    say = progress or (lambda text: None)
    scene, statements = scene_of(Origin.of(source), record)
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
    effects = {
        group: _effect(scene, own, group) for group in dict.fromkeys(scene.groups[n] for n in apart.names)
    }
    differing = [
        g for g in effects if g in significant and matters(g, apart.of(members(scene.groups, g)), effects[g])
    ]
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
    predicted = {name: simulate(scene.base, one, scene.run) for name, one in values.items()}
    scored = _scored(scene, predicted)
    found = {
        "name": record.name,
        "synthetic": "synthetic" in record.name.lower(),
        "from": {
            "name": scene.origin.name,
            "kind": scene.origin.kind,
            "verdicts": dict(scene.origin.verdicts),
        },
        "until": stamp(scene.until_s),
        "n_readings": scene.early_run.timeline.n_readings,
        "parameters": parameters_of(scene, apart, values, spread, own),
        "groups": groups_of(scene, apart, steps, effects, significant, differing),
        "likelihood_ratios": ratios_of(scene, logger, adapted, own, spread, differing),
        **scored,
        "structure": _structure(scene, predicted["all_own"]),
        "at_bounds": [
            n for n in adapted.at_bounds if scene.groups[n] in differing and n != "resistance_ratio"
        ],
        "converged": {
            "own_loggers": logger.converged,
            "re_estimated": adapted.converged,
            "all_own": own.converged,
        },
        "statements": statements,
        "matters": dict(MATTERS),
    }
    verdict, reasons = judged(found, differing)
    found |= {
        "verdict": verdict,
        "re_estimate": differing,
        "reasons": reasons,
        "sentence": sentence(verdict, differing),
    }
    series = _series(scene, predicted)
    if not fits:
        return Transfer(found, series)
    say("its own fit")
    mine = _fit(scene, own, spread)
    made = mine if adapted is own else _fit(scene, adapted, told)
    return Transfer(found | {"verdicts": inherited(made.results)}, series, made, mine)


def _effect(scene: Scene, own: Estimate, group: str) -> dict[str, float]:
    """What a group's own values change in the free run: root mean square [K] and [g/m³] over the record."""
    changed = dict(scene.origin.values) | {n: own.values[n] for n in members(scene.groups, group)}
    runs = [simulate(scene.base, values, scene.run) for values in (scene.origin.values, changed)]
    found = {}
    for quantity in SCORED:
        before, after = (made.of(quantity) for made in runs)
        if before is not None and after is not None:
            found[quantity] = float(np.sqrt(np.mean((before[0] - after[0])[scene.run.scored] ** 2)))
    return found


def _adapted(scene: Scene, logger: Estimate, own: Estimate, differing: Sequence[str]) -> Estimate:
    """Offsets, disturbances and the differing groups estimated here, the others as they were."""
    if not differing:
        return logger
    fixed = {n: scene.origin.values[n] for n in scene.cabinet if scene.groups[n] not in differing}
    if not fixed:
        return own
    start = {**own.values, **fixed}
    return maximise(scene.likelihood, start, {**scene.held, **fixed}, count=1)


# --- held-out errors -------------------------------------------------------------------------


def _errors(scene: Scene, predicted: Mapping[str, Prediction], quantity: str) -> dict[str, np.ndarray]:
    """Errors (T,) of every set and of the sceptic's rules at scored instants."""
    reading = measured(scene.run)[quantity]
    columns = {n: pair[0] for n, made in predicted.items() if (pair := made.of(quantity)) is not None}
    columns |= {
        n: guess[quantity]
        for n, guess in guesses(scene.run, scene.record.until_s).items()
        if quantity in guess
    }
    return {n: np.where(scene.run.scored, reading - value, np.nan) for n, value in columns.items()}


def _scored(scene: Scene, predicted: Mapping[str, Prediction]) -> dict:
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
            n: rmse(np.where(there, errors[n], np.nan), scene.run.operating)
            | {"bounds": _pair(drawn.bounds(i))}
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


def _structure(scene: Scene, predicted: Prediction) -> dict:
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
            found[quantity] = {
                "rmse": float(drawn.value[0]),
                "rmse_of_the_fit": before,
                "ratio": ratio,
                "lower": low,
            }
    return found


def _pair(bounds: tuple[float, float] | None) -> list[float] | None:
    return None if bounds is None else list(bounds)


# --- fits and series -------------------------------------------------------------------------


def _fit(scene: Scene, estimate: Estimate, spread: Uncertainty) -> Fit:
    """An estimate on the record as a fit; what travelled keeps the value and the uncertainty that it came with."""
    from hygrokf.identification.steady_state import heat_release_regression

    kept = [n for n in scene.origin.names if n in estimate.coordinates.fixed]
    place = [scene.origin.names.index(n) for n in kept]
    parameters = {p.name: p for p in scene.base.model.parameters}
    slopes = np.array([parameters[n].slope(scene.origin.values[n]) for n in kept])
    old = scene.origin.covariance[np.ix_(place, place)] / np.outer(slopes, slopes)
    wider = replace(
        spread,
        names=(*spread.names, *kept),
        hessian=_blocks(spread.hessian, np.linalg.pinv(old)),
        wald=_blocks(spread.wald, old),
        sandwich=_blocks(spread.sandwich, old),
        factor=np.concatenate([spread.factor, np.ones(len(kept))]),
        # no part of this record says anything about what was taken over
        parts=np.pad(spread.parts, ((0, 0), (0, len(kept) if spread.parts.size else 0))),
    )
    bounds = {}
    for name in (n for n in TIME_CONSTANTS if n in parameters and wider.place(n) is not None):
        i = wider.place(name)
        reach = normal_quantile(0.95) * math.sqrt(max(wider.wald[i, i], wider.sandwich[i, i]))
        value = estimate.values[name]
        ends = (value * math.exp(-min(reach, 50.0)), value * math.exp(min(reach, 50.0)))
        said = "taken over" if name in kept else "wald"
        bounds[name] = Bounds(value, *ends, 0.95, said, "", np.empty((0, 2)))
    stage = Stage(scene.base, scene.early_run, estimate, wider, bounds)
    basis = Basis(JOINT, (stage,), (scene.early,), heat_release_regression(scene.early))
    made = assembled(scene.record, basis, {})
    results: dict[str, Any] = dict(made.results)
    results["statements"] = [
        f"design and values that are marked as fixed come from {scene.origin.name}",
        *made.results["statements"],
    ]
    for part, name in zip(PARTS, TIME_CONSTANTS, strict=True):
        if name in kept:
            results = with_reasons(results, part, scene.origin.reasons(part))
    return replace(made, results=results)


def _blocks(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    n, m = len(first), len(second)
    result = np.zeros((n + m, n + m))
    result[:n, :n], result[n:, n:] = first, second
    return result


def _series(scene: Scene, predicted: Mapping[str, Prediction]) -> dict[str, np.ndarray]:
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
