"""A variant of a cause as a candidate: all parameters estimated again with it, and the gain of that."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hygrokf.data.clocks import Shift
from hygrokf.discovery.baseline import Baseline, climbed, refitted
from hygrokf.discovery.cause import Variant, penalty
from hygrokf.discovery.clocks import best_shift, ordinary_shift
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.submodel import Submodel, search_likelihood, self_driven_error
from hygrokf.modelling.design import Design, extended
from hygrokf.modelling.inputs import prepare_run
from hygrokf.physics.switches import SWITCHES

MATERIAL = 0.05
"""[1] share of the squared free-run error that must be gone, without the three best days, for a cause to be
worth having."""
FINER = 10.0
"""2 ln L by which a form must be ahead of the simpler form that it refines."""
SHOWN = 40.0
"""2 ln L from which a switch is worth a simulation in which it follows the simulation, which takes
seconds."""
SENSOR_ERRORS = ("humidity_drift_total", "humidity_scale_error", "temperature_offset", "thermometer_offset")
"""Parameters whose bounds are the largest error that a sensor can have."""
AT_BOUND = 1e-4
"""[1] share of the largest error within which an estimate stands at that bound."""
EPISODE_GAP = 3
"""[d] days of one episode are at most this far apart."""
WEEK = 7
BLOCKS = 25
"""Blocks of days from which the standard error of a gain is taken."""
BEST_DAYS = 3
"""Days that a gain must survive without: an effect that was seen on three days alone is no property of the
cabinet."""


@dataclass(frozen=True)
class Candidate:
    """A variant estimated in a baseline.

    submodels: those that it changed, and by submodel:
    lrs: 2 Δ ln L.
    gain: [1] share of the squared free-run error that is gone; lasting: the same without the three days that
        gained most; z: the gain in standard errors of its blocks; episodes: in how many it was gained.

    parameters: number of new ones; price: what these and the grid cost in 2 ln L.
    bic_gain: the evidence, the lrs over the baseline's tempers less the price.
    """

    variant: Variant
    submodels: Mapping[str, Submodel]
    lrs: Mapping[str, float]
    parameters: int
    bic_gain: float
    gain: Mapping[str, float]
    lasting: Mapping[str, float]
    episodes: Mapping[str, int]
    price: float = 0.0
    z: Mapping[str, float] = field(default_factory=dict)

    @property
    def lr(self) -> float:
        return sum(self.lrs.values())

    def bic_in(self, names: Iterable[str]) -> float:
        """The part of its `bic_gain` that was gained in some of its submodels."""
        return self.bic_gain * sum(self.lrs[name] for name in names) / self.lr if self.lr > 0.0 else 0.0

    def value(self, parameter: str, otherwise: float) -> float:
        """A parameter's estimate in the submodels that it changed; `otherwise` where none has it."""
        return next(
            (m.values[parameter] for m in self.submodels.values() if parameter in m.values), otherwise
        )

    @property
    def best_lasting(self) -> float:
        return max(self.lasting.values(), default=0.0)

    @property
    def submodel(self) -> str:
        """The submodel whose free run gained most."""
        return max(self.lasting, key=lambda name: self.lasting[name], default="")

    @property
    def beyond(self) -> str:
        """A sensor error whose estimate is as large as is physically possible; empty where there is none.

        Bounds of other amplitudes are what a record can resolve, not limits of physics.
        """
        for submodel in self.submodels.values():
            for p in submodel.base.model.parameters:
                if p.name in SENSOR_ERRORS:
                    largest = max(abs(p.lower), abs(p.upper))
                    if abs(submodel.values[p.name]) > (1.0 - AT_BOUND) * largest:
                        return p.name
        return ""

    @property
    def once(self) -> bool:
        """Whether the free run gained in one episode only: nothing shows that the effect recurs."""
        return self.episodes.get(self.submodel, 2) < 2


def added_mechanisms(variant: Variant) -> set[str]:
    """Names of the mechanisms that a variant brings."""
    return {mechanism for pairs in variant.additions.values() for mechanism, _ in pairs}


def clock_shifts(candidates: Iterable[Candidate]) -> list[Shift]:
    """Corrections of clocks among candidates."""
    return [one.variant.shift for one in candidates if one.variant.shift is not None]


def attempt(baseline: Baseline, variant: Variant) -> Candidate:
    """Estimate a variant in every submodel that it changes."""
    if variant.shift is not None:
        return _shifted(baseline, variant)
    changed = {}
    for name, submodel in baseline.submodels.items():
        additions = variant.additions.get(name, ())
        altered = variant.altered.get(name, {})
        if not additions and not altered:
            continue
        base = replace(submodel, base=_altered(submodel.base, altered))
        changed[name] = refitted(base, additions, variant.features, variant.starts, budget=baseline.budget)
    return candidate_of(baseline, variant, changed)


def _shifted(baseline: Baseline, variant: Variant) -> Candidate:
    """The shift of a source that the innovations ask for, estimated."""
    assert variant.shift is not None
    source = variant.shift.source
    seconds, changed = best_shift(baseline, variant.shift)
    settings = {
        **variant.settings,
        "source": source,
        "shift_s": seconds,
        "summer_time": variant.shift.summer,
        "ordinary_s": ordinary_shift(baseline.record, source),
    }
    variant = replace(variant, shift=replace(variant.shift, seconds=seconds), settings=settings)
    if not changed:
        return Candidate(variant, {}, {}, 1, -penalty(variant, 1, 1), {}, {}, {})
    return candidate_of(baseline, variant, changed)


def refined(
    base: Baseline, baseline: Baseline, candidate: Candidate, alone: bool
) -> tuple[Candidate, Baseline]:
    """An accepted candidate in its finer form where that gains, and the baseline with it; both unchanged
    otherwise.

    base: the baseline without any cause; alone: whether the candidate is all that changed its submodels.
        Then it is judged anew; otherwise the gain of the finer form is added to its evidence, and the gain of
        its free run stays.
    """
    finer = candidate.variant.finer
    if finer is None:
        return candidate, baseline
    after = {}
    for name, additions in finer.additions.items():
        submodel = baseline.submodels[name]
        start = {
            p.name: min(max(submodel.values[p.name] * finer.scaled.get(p.name, 1.0), p.lower), p.upper)
            for p in submodel.base.model.parameters
        }
        altered = replace(submodel, base=_altered(submodel.base, dict(additions)))
        after[name] = refitted(altered, (), {}, (start,), budget=baseline.budget)
    if sum(_gained(baseline, after).values()) <= FINER:
        return candidate, baseline
    after = {name: climbed(submodel, baseline.budget) for name, submodel in after.items()}
    if alone:
        found = candidate_of(base, finer, {**candidate.submodels, **after})
    else:
        gained = _gained(baseline, after)
        lrs = {name: one + gained.get(name, 0.0) for name, one in candidate.lrs.items()}
        more = sum(one / baseline.tempers[name] for name, one in gained.items())
        found = replace(candidate, variant=finer, lrs=lrs, bic_gain=candidate.bic_gain + more)
    return found, replace(baseline, submodels={**baseline.submodels, **after})


def restarted(baseline: Baseline, candidate: Candidate) -> Variant:
    """The variant of a candidate, to be tried again from its estimate."""
    if candidate.variant.shift is not None:
        return candidate.variant
    known = {name for submodel in baseline.submodels.values() for name in submodel.values}
    altered = {name for changed in candidate.variant.altered.values() for name in changed}
    start = {
        name: value
        for submodel in candidate.submodels.values()
        for name, value in submodel.values.items()
        if name not in known or altered
    }
    return replace(candidate.variant, starts=(start,))


def polished(baseline: Baseline, candidate: Candidate) -> Candidate:
    """The candidate with its submodels climbed to their maxima."""
    return candidate_of(
        baseline,
        candidate.variant,
        {name: climbed(submodel, baseline.budget) for name, submodel in candidate.submodels.items()},
    )


def candidate_of(baseline: Baseline, variant: Variant, submodels: Mapping[str, Submodel]) -> Candidate:
    """What changed submodels gained over those of the baseline; a switch with evidence follows the simulation
    for that."""
    lrs = _gained(baseline, submodels)
    count, n = 0, 0
    gain, lasting, often, z = {}, {}, {}, {}
    own = sum(lrs.values()) > SHOWN and bool(set(SWITCHES) & set(variant.features))
    for name, submodel in submodels.items():
        before = baseline.submodels[name]
        squares = daily_squares(before, submodel, self_driven_error(submodel) if own else submodel.error)
        often[name], z[name] = episodes(*squares), standard_errors(*squares)
        count += submodel.parameters - before.parameters
        n += before.n
        gain[name], lasting[name] = shares(*squares)
    count = max(count, 1)
    price = penalty(variant, count, n)
    evidence = sum(one / baseline.tempers[name] for name, one in lrs.items()) - price
    return Candidate(variant, dict(submodels), lrs, count, evidence, gain, lasting, often, price, z)


def _gained(baseline: Baseline, submodels: Mapping[str, Submodel]) -> dict[str, float]:
    """2 Δ ln L of changed submodels over those of the baseline."""
    return {
        name: 2.0 * (submodel.objective - baseline.submodels[name].objective)
        for name, submodel in submodels.items()
    }


def daily_squares(before: Submodel, after: Submodel, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared free-run errors (D,) summed by day, before and after; error: of the latter (T,)."""
    count = int(max(before.days.max(), after.days.max())) + 1
    old, new = (
        np.bincount(days[np.isfinite(e)], e[np.isfinite(e)] ** 2, count)
        for days, e in ((before.days, before.error), (after.days, error))
    )
    return old, new


def shares(old: np.ndarray, new: np.ndarray) -> tuple[float, float]:
    """Share of the squared errors by day (D,) that is gone, and the same without the three days that gained
    most."""
    order = np.argsort(new - old)[BEST_DAYS:]
    total, rest = float(old.sum()), float(old[order].sum())
    return (
        1.0 - float(new.sum()) / total if total > 0 else 0.0,
        1.0 - float(new[order].sum()) / rest if rest > 0 else 0.0,
    )


def standard_errors(old: np.ndarray, new: np.ndarray) -> float:
    """Fall of the squared errors by day (D,), over its own standard error from `BLOCKS` blocks of days."""
    size = max(1, len(old) // BLOCKS)
    gone = np.add.reduceat(old - new, np.arange(0, len(old), size))
    spread = math.sqrt(len(gone) * float(np.var(gone, ddof=1))) if len(gone) > 1 else 0.0
    return float(gone.sum()) / spread if spread > 0.0 else 0.0


def episodes(old: np.ndarray, new: np.ndarray) -> int:
    """Number of episodes in which most of a gain was made; one that lasts counts for every week of it.

    old, new: (D,) squared errors by day.  The days, best first, that together make four fifths of the gain
    belong to one episode where no more than two others lie between them.
    """
    gained = np.maximum(old - new, 0.0)
    order = np.argsort(-gained)
    enough = int(np.searchsorted(np.cumsum(gained[order]), 0.8 * gained.sum())) + 1
    chosen = np.sort(order[:enough])
    begins = np.flatnonzero(np.diff(chosen, prepend=-10) > EPISODE_GAP)
    lengths = [int(days[-1] - days[0]) + 1 for days in np.split(chosen, begins[1:]) if len(days)]
    return sum(max(1, length // WEEK) for length in lengths)


def probability(candidate: Candidate) -> float:
    """p of 2 Δ ln L where there is no such effect: χ², half of it with one degree less where the null is a
    boundary.

    An amplitude that cannot be negative is zero half of the time (Self and Liang 1987).  Not corrected for
    the number of variants tried.
    """
    from scipy.stats import chi2

    lr, df = max(candidate.lr, 0.0), candidate.parameters
    names = added_mechanisms(candidate.variant)
    bounded = any(
        p.null is not None and p.null <= p.lower
        for submodel in candidate.submodels.values()
        for mechanism in submodel.base.model.mechanisms
        if mechanism.name in names
        for p in mechanism.parameters
    )
    if not bounded:
        return float(chi2.sf(lr, df))
    below = float(chi2.sf(lr, df - 1)) if df > 1 else float(lr <= 0.0)
    return 0.5 * (float(chi2.sf(lr, df)) + below)


def score_statistic(baseline: Baseline, variant: Variant) -> float | None:
    """LM of a variant at its null value: the gain 2 Δ ln L that the base model's innovations promise for a
    small effect.

    Other parameters of its mechanisms stand at their first start.  None for what is no added mechanism.
    """
    total = None
    for name, additions in variant.additions.items():
        if name not in baseline.submodels:
            continue
        submodel = baseline.submodels[name]
        wider = extended(submodel.base, additions, features=variant.features)
        likelihood = search_likelihood(wider.model, prepare_run(wider, submodel.record).timeline)
        parameters = wider.model.parameters
        given = variant.starts[0] if variant.starts else {}
        at = {p.name: given.get(p.name, p.start) for p in parameters} | dict(submodel.values)
        nulls = {
            i: p.null
            for i, p in enumerate(parameters)
            if p.name not in submodel.values and p.null is not None
        }
        new = list(nulls)
        for i, null in nulls.items():
            at[parameters[i].name] = max(null, parameters[i].lower)
        old = [i for i, p in enumerate(parameters) if p.name in submodel.values]
        directions = np.zeros((len(parameters), len(new) + len(old)))
        for column, i in enumerate((*new, *old)):
            directions[i, column] = parameters[i].slope(at[parameters[i].name])
        found = likelihood.sensitivities(at, directions)
        # the priors keep a sensor's ordinary offset from explaining an offset beyond its accuracy
        known = [
            p.prior.information(at[p.name]) * p.slope(at[p.name]) ** 2 if p.prior is not None else 0.0
            for p in (parameters[i] for i in (*new, *old))
        ]
        information = found.information + np.diag(known)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        information = information * scale[:, None] * scale
        score = found.score[: len(new)] * scale[: len(new)]
        k = len(new)
        rest = information[:k, k:] @ np.linalg.pinv(information[k:, k:], rcond=1e-10) @ information[k:, :k]
        total = (total or 0.0) + float(score @ np.linalg.pinv(information[:k, :k] - rest, rcond=1e-8) @ score)
    return total


def _altered(base: Design, altered: Mapping[str, Settings]) -> Design:
    """The design with other settings of some of its mechanisms."""
    mechanisms = tuple((name, {**settings, **altered.get(name, {})}) for name, settings in base.mechanisms)
    return replace(base, mechanisms=mechanisms)
