"""From a record to its discovery: what the simulation gets wrong, the cause, the extended model, and what that gained."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.confidence import normal_quantile, standard_error, wald_bounds
from hygrokf.design import CASCADE
from hygrokf.discovery.choice import Choice, choose
from hygrokf.discovery.library import LIBRARY, Cause, named
from hygrokf.discovery.misfits import misfits
from hygrokf.discovery.remainder import structure
from hygrokf.discovery.residuals import residuals
from hygrokf.discovery.scene import HYGRIC, THERMAL, Scene, part_of
from hygrokf.discovery.trial import Trial, shift_source
from hygrokf.fit import Fit
from hygrokf.fitting import maximise
from hygrokf.identification import Basis, assembled, identified
from hygrokf.likelihood import Likelihood
from hygrokf.record import Record
from hygrokf.stage import Estimated, Progress, Stage, judged, output_errors
from hygrokf.version import __version__

BLOCK_DAYS = 3
DRAWS = 400
QUANTITY = {THERMAL: "temperature_K", HYGRIC: "absolute_humidity_g_m3"}


@dataclass(frozen=True)
class Discovery:
    """The base fit, the extended one where a cause was accepted, and the plain data of `discovery.json`."""

    base: Fit
    extended: Fit | None
    results: Mapping[str, object]

    def to_json(self) -> dict:
        return dict(self.results)


def discover(
    record: Record,
    *,
    library: Sequence[Cause] = LIBRARY,
    starts: int = 4,
    progress: Progress | None = None,
) -> Discovery:
    """Find what the identified model of a record lacks, and name the cause out of a library.

    Everything is chosen on the identification period; the validation period gives the reported gain.  Raises ValueError
    as `identify` does.
    """
    say = progress or (lambda text: None)
    early = record.identification()
    basis = identified(early, CASCADE, starts, True, say)
    simulated = output_errors(early, basis.whole, basis.values)
    base = assembled(record, basis, simulated, say=say)
    rival = assembled(record, basis, simulated, "simulation", say)
    names = (THERMAL, HYGRIC)[: len(basis.stages)]
    scene = Scene(
        early,
        {
            name: part_of(name, driven, stage)
            for name, driven, stage in zip(names, basis.records, basis.stages, strict=True)
        },
    )
    choice = choose(scene, library, say)
    extended, stages = None, basis.stages
    moved = record
    if choice.accepted:
        say("extended model")
        for trial in choice.accepted:
            for source, seconds in trial.variant.shift_s.items():
                moved = shift_source(moved, source, seconds)
        stages = _stages(basis, choice, say)
        wider = replace(basis, stages=stages)
        moved_early = moved.identification()
        extended = assembled(moved, wider, output_errors(moved_early, wider.whole, wider.values), say=say)
    say("what is left")
    return Discovery(base, extended, _results(record, moved, base, rival, extended, choice, stages, library))


def _stages(basis: Basis, choice: Choice, say: Progress) -> tuple[Stage, ...]:
    """The stages with the accepted causes in them, climbed to the end and judged."""
    found = []
    for name, stage in zip((THERMAL, HYGRIC), basis.stages, strict=False):
        part = choice.scene.parts[name]
        if part.base is stage.base and part.record is basis.records[len(found)]:
            found.append(stage)
            continue
        likelihood = Likelihood(part.base.model, part.run.timeline)
        estimate = maximise(likelihood, dict(part.values), count=1)
        found.append(judged(part.record, Estimated(part.base, part.run, estimate), True, say))
    return tuple(found)


def _results(
    record: Record,
    moved: Record,
    base: Fit,
    rival: Fit,
    extended: Fit | None,
    choice: Choice,
    stages: Sequence[Stage],
    library: Sequence[Cause],
) -> dict:
    after = extended or base
    left = residuals(after, moved)
    shown = misfits(residuals(base, record))
    remaining = structure(left)
    causes = [
        _cause(trial, rivals, base, rival, after, stages, library)
        for trial, rivals in zip(choice.accepted, choice.rivals, strict=True)
    ]
    verdict = "named" if causes else "unexplained" if remaining is not None else "none"
    return {
        "name": record.name,
        "version": __version__,
        "synthetic": base.results["synthetic"],
        "verdict": verdict,
        "baseline": _scores(base),
        "extended": None if extended is None else _scores(extended),
        "misfits": [one.to_json() for one in shown],
        "causes": causes,
        "rejected": [
            {"cause": t.variant.cause, "form": t.variant.form, "evidence": _evidence(t), "reason": reason}
            for t, reason in choice.rejected
        ],
        "unexplained": remaining,
    }


def _scores(fit: Fit) -> dict:
    return {key: fit.results[key] for key in ("rmse", "baselines", "time_constants", "loglik", "n_obs")}


def _evidence(trial: Trial) -> dict:
    from scipy.stats import chi2

    p = float(chi2.sf(max(trial.lr, 0.0), trial.parameters))
    return {
        "lr": trial.lr,
        "df": trial.parameters,
        "p_adjusted": min(1.0, p * max(trial.variant.searched, 1) * len(LIBRARY)),
        "bic_gain": trial.bic_gain,
        "free_run_gain": dict(trial.gain),
        "lasting_gain": dict(trial.lasting),
        "settings": dict(trial.variant.settings),
    }


def _cause(
    trial: Trial,
    rivals: Sequence[Trial],
    base: Fit,
    rival: Fit,
    after: Fit,
    stages: Sequence[Stage],
    library: Sequence[Cause],
) -> dict:
    cause = named(trial.variant.cause, library)
    quantity = max(trial.lasting, key=lambda part: trial.lasting[part], default=THERMAL)
    gain = _gain(QUANTITY[quantity], base, rival, after)
    return {
        "cause": cause.name,
        "form": trial.variant.form,
        "confidence": _confidence(trial, rivals),
        "statement": f"{cause.meaning} ({trial.variant.form})",
        "parameters": _parameters(trial, stages),
        "settings": dict(trial.variant.settings),
        "evidence": _evidence(trial),
        "gain": gain,
        "ambiguous_with": [t.variant.cause for t in rivals],
        "separate_by": cause.separate_by,
        "remedy": cause.remedy,
    }


def _confidence(trial: Trial, rivals: Sequence[Trial]) -> float:
    """Share of the evidence that the cause holds against the rivals that were acceptable too."""
    return float(1.0 / (1.0 + sum(max(t.bic_gain, 0.0) / trial.bic_gain for t in rivals)))


def _parameters(trial: Trial, stages: Sequence[Stage]) -> dict:
    """The cause's own parameters in the extended model, with bounds."""
    names = {mechanism for pairs in trial.variant.additions.values() for mechanism, _ in pairs}
    found = {}
    for stage in stages:
        for mechanism in stage.base.model.mechanisms:
            if mechanism.name not in names:
                continue
            for p in mechanism.parameters:
                b = wald_bounds(stage.estimate, stage.uncertainty, p.name)
                se = standard_error(stage.estimate, stage.uncertainty, p.name)
                found[p.name] = {
                    "value": stage.estimate.values[p.name],
                    "unit": p.unit,
                    "lower": b.lower if math.isfinite(b.lower) else None,
                    "upper": b.upper if math.isfinite(b.upper) else None,
                    "se": se if math.isfinite(se) else None,
                    "meaning": p.meaning,
                }
    return found


def _gain(quantity: str, base: Fit, rival: Fit, after: Fit) -> dict:
    """Free-run error before and after on the validation period (the identification period where there is none).

    Before: the better of the bases that were fitted by innovations and by the free run.  `lower`, `upper` bound the
    difference by a bootstrap of blocks of three days.
    """
    period = (
        "validation"
        if base.results["rmse"]["validation"][quantity]["total"] is not None
        else "identification"
    )
    before = min((base, rival), key=lambda fit: fit.results["rmse"][period][quantity]["total"])
    a, b = (fit.results["rmse"][period][quantity]["total"] for fit in (before, after))
    low, high = _bootstrap(quantity, period, before, after)
    per = (after.results["loglik"] - base.results["loglik"]) / max(base.results["n_obs"], 1)
    return {
        "quantity": quantity,
        "period": period,
        "rmse_before": a,
        "rmse_after": b,
        "lower": low,
        "upper": high,
        "loglik_per_obs": per,
    }


def _bootstrap(quantity: str, period: str, before: Fit, after: Fit) -> tuple[float | None, float | None]:
    """95 % bounds of RMSE before − RMSE after."""
    sums = []
    for fit in (before, after):
        s = fit.series
        stem = quantity.removesuffix("_K").removesuffix("_g_m3")
        error = s[f"{stem}_measured"] - s[f"{stem}_simulated"]
        late = s["time_s"] > float(s["until_s"]) if math.isfinite(float(s["until_s"])) else s["time_s"] < 0
        there = np.isfinite(error) & (s["scored"] > 0) & (late if period == "validation" else ~late)
        block = np.floor(s["time_s"] / (BLOCK_DAYS * 86400.0)).astype(int)
        sums.append((block[there], error[there] ** 2))
    first, last = min(b.min() for b, _ in sums), max(b.max() for b, _ in sums)
    count = last - first + 1
    squares = [np.bincount(b - first, e, count) for b, e in sums]
    numbers = [np.bincount(b - first, minlength=count) for b, _ in sums]
    if count < 4:
        return None, None
    random = np.random.default_rng(0)
    draws = random.integers(0, count, (DRAWS, count))
    values = [
        np.sqrt(s[draws].sum(axis=1) / np.maximum(n[draws].sum(axis=1), 1))
        for s, n in zip(squares, numbers, strict=True)
    ]
    z = normal_quantile(0.95)
    tail = 0.5 * math.erfc(z / math.sqrt(2.0))
    low, high = np.quantile(values[0] - values[1], [tail, 1.0 - tail])
    return float(low), float(high)
