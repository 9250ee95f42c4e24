"""One variant of a cause put to the test: all parameters estimated again with it, and what that gained."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hygrokf.data.record import Record
from hygrokf.data.timestamps import HOUR_S
from hygrokf.discovery.baseline import Baseline, Part, climbed, days, refitted, searching, self_driven
from hygrokf.discovery.cause import Variant, penalty
from hygrokf.discovery.causes_readings import SHIFTS_MIN
from hygrokf.discovery.clocks import Shift, shifted, sources
from hygrokf.discovery.discovery_results import Settings
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.likelihood import Trace
from hygrokf.modelling.design import Design, extended
from hygrokf.modelling.inputs import prepare_run
from hygrokf.physics.switches import SWITCHES

MATERIAL = 0.05
"""Share of the squared free-run error that must be gone, without the three best days, for a cause to be worth
having."""
FINER = 10.0
"""2 ln L by which a form must be ahead of the simpler one that it refines."""
REFINEMENTS = 2
"""Passes that narrow a shift down from the coarse grid by score statistics, each to about half the
spacing."""
CLOCK_REACH_S = (480.0, 160.0, 50.0)
"""[s] how far around a shift the next one is looked for, all parameters estimated again before each."""
CLOCK_S = 15.0
"""[s] by which a shift is moved at least."""
SMALLEST_SHIFT_S = 240.0
"""[s] below this a clock error is ordinary."""
OF_INTERVAL = 0.6
"""The same as a share of the interval over which a source takes means."""
SHOWN = 40.0
"""2 ln L from which a switch is worth being simulated by itself, which takes seconds."""
SENSOR_ERRORS = ("humidity_drift_total", "humidity_scale_error", "temperature_offset", "thermometer_offset")
"""Parameters whose bounds are what a sensor can be off by."""
AT_BOUND = 1e-4
"""Share of the largest error within which an estimate stands at that bound."""
EPISODE_GAP = 3
"""[d] days of one episode lie at most so far apart."""
WEEK = 7
BLOCKS = 25
"""Blocks of days from which the standard error of a gain is taken."""
BEST_DAYS = 3
"""Days that a gain must survive without: an effect that was seen on three days alone is no property of the
cabinet."""


@dataclass(frozen=True)
class Candidate:
    """A variant estimated in a baseline.

    `parts` the parts that it changed; `lrs` 2 Δ ln L of each, `lr` of them together, `parameters` their new
    ones, `price` what these and the grid cost, `bic_gain` the evidence: what is left of the lrs over the
    baseline's tempers; `gain` part → share of the squared free-run error that is gone, `lasting` the same
    without the three days that gained most, `z` the gain in standard errors of its blocks, `episodes` in how
    many episodes it was gained.
    """

    variant: Variant
    parts: Mapping[str, Part]
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

    def bic_in(self, parts: Iterable[str]) -> float:
        """Its `bic_gain`, as far as it was gained in some of its parts."""
        return self.bic_gain * sum(self.lrs[name] for name in parts) / self.lr if self.lr > 0.0 else 0.0

    def value(self, parameter: str, otherwise: float) -> float:
        """A parameter's estimate in the parts that it changed; `otherwise` where none has it."""
        return next((p.values[parameter] for p in self.parts.values() if parameter in p.values), otherwise)

    @property
    def best_lasting(self) -> float:
        return max(self.lasting.values(), default=0.0)

    @property
    def part(self) -> str:
        """The part whose free run gained most."""
        return max(self.lasting, key=lambda name: self.lasting[name], default="")

    @property
    def beyond(self) -> str:
        """An error of a sensor that ended as large as is physically possible; empty where none did.

        Bounds of other amplitudes are what a record can resolve, and no limit of physics.
        """
        for part in self.parts.values():
            for p in part.base.model.parameters:
                if p.name in SENSOR_ERRORS:
                    largest = max(abs(p.lower), abs(p.upper))
                    if abs(part.values[p.name]) > (1.0 - AT_BOUND) * largest:
                        return p.name
        return ""

    @property
    def once(self) -> bool:
        """Whether all that it gained in the free run was gained in one episode: it cannot be seen to
        recur."""
        return self.episodes.get(self.part, 2) < 2


def added(variant: Variant) -> set[str]:
    """Names of the mechanisms that a variant brings."""
    return {mechanism for pairs in variant.additions.values() for mechanism, _ in pairs}


def attempt(baseline: Baseline, variant: Variant) -> Candidate:
    """Estimate a variant in every part that it touches."""
    if variant.shift is not None:
        return _shifted(baseline, variant)
    parts = {}
    for name, part in baseline.parts.items():
        additions = variant.additions.get(name, ())
        altered = variant.altered.get(name, {})
        if not additions and not altered:
            continue
        base = replace(part, base=_altered(part.base, altered))
        parts[name] = refitted(base, additions, variant.features, variant.starts, budget=baseline.budget)
    return judged(baseline, variant, parts)


def refined(
    base: Baseline, baseline: Baseline, candidate: Candidate, alone: bool
) -> tuple[Candidate, Baseline]:
    """An accepted candidate in its finer form where that gains, and the baseline with it; both as they are
    otherwise.

    base: the baseline that nothing was added to; alone: whether the candidate is all that changed the parts
        that it
    changed. Then it is judged anew; else what the finer form gains is added to its evidence, and its free
    run's gain is left.
    """
    finer = candidate.variant.finer
    if finer is None:
        return candidate, baseline
    after = {}
    for name, additions in finer.additions.items():
        part = baseline.parts[name]
        start = {
            p.name: min(max(part.values[p.name] * finer.scaled.get(p.name, 1.0), p.lower), p.upper)
            for p in part.base.model.parameters
        }
        altered = replace(part, base=_altered(part.base, dict(additions)))
        after[name] = refitted(altered, (), {}, (start,), budget=baseline.budget)
    if sum(_gained(baseline, after).values()) <= FINER:
        return candidate, baseline
    after = {name: climbed(part, baseline.budget) for name, part in after.items()}
    if alone:
        found = judged(base, finer, {**candidate.parts, **after})
    else:
        gained = _gained(baseline, after)
        lrs = {name: one + gained.get(name, 0.0) for name, one in candidate.lrs.items()}
        more = sum(one / baseline.tempers[name] for name, one in gained.items())
        found = replace(candidate, variant=finer, lrs=lrs, bic_gain=candidate.bic_gain + more)
    return found, replace(baseline, parts={**baseline.parts, **after})


def started(baseline: Baseline, candidate: Candidate) -> Variant:
    """The variant of a candidate, to be tried again from where it ended."""
    if candidate.variant.shift is not None:
        return candidate.variant
    known = {name for part in baseline.parts.values() for name in part.values}
    altered = {name for changed in candidate.variant.altered.values() for name in changed}
    start = {
        name: value
        for part in candidate.parts.values()
        for name, value in part.values.items()
        if name not in known or altered
    }
    return replace(candidate.variant, starts=(start,))


def polished(baseline: Baseline, candidate: Candidate) -> Candidate:
    """The candidate with its parts climbed to their maxima."""
    return judged(
        baseline,
        candidate.variant,
        {name: climbed(part, baseline.budget) for name, part in candidate.parts.items()},
    )


def judged(baseline: Baseline, variant: Variant, parts: Mapping[str, Part]) -> Candidate:
    """What changed parts gained over those of the baseline; a switch with evidence is simulated by itself for
    that."""
    lrs = _gained(baseline, parts)
    lr = sum(lrs.values())
    count, n = 0, 0
    gain, lasting, often, z = {}, {}, {}, {}
    switched = set(SWITCHES) & set(variant.features)
    own = lr > SHOWN and bool(switched)
    for name, part in parts.items():
        before, after = baseline.parts[name], self_driven(part) if own else part
        squares = daily_squares(before, after)
        often[name], z[name] = episodes(*squares), standard_errors(*squares)
        count += part.parameters - before.parameters
        n += before.n
        gain[name], lasting[name] = shares(before, after)
    count = max(count, 1)
    price = penalty(variant, count, n)
    evidence = sum(one / baseline.tempers[name] for name, one in lrs.items()) - price
    return Candidate(variant, dict(parts), lrs, count, evidence, gain, lasting, often, price, z)


def _gained(baseline: Baseline, parts: Mapping[str, Part]) -> dict[str, float]:
    """2 Δ ln L of changed parts over those of the baseline."""
    return {name: 2.0 * (part.objective - baseline.parts[name].objective) for name, part in parts.items()}


def daily_squares(before: Part, after: Part) -> tuple[np.ndarray, np.ndarray]:
    """Squared free-run errors (D,) summed by day, before and after."""
    count = int(max(days(before).max(), days(after).max())) + 1
    old, new = (
        np.bincount(days(p)[np.isfinite(p.error)], p.error[np.isfinite(p.error)] ** 2, count)
        for p in (before, after)
    )
    return old, new


def shares(before: Part, after: Part) -> tuple[float, float]:
    """Share of the squared free-run error that is gone, and the same without the three days that gained
    most."""
    old, new = daily_squares(before, after)
    order = np.argsort(new - old)[BEST_DAYS:]
    total, rest = float(old.sum()), float(old[order].sum())
    return (
        1.0 - float(new.sum()) / total if total > 0 else 0.0,
        1.0 - float(new[order].sum()) / rest if rest > 0 else 0.0,
    )


def standard_errors(old: np.ndarray, new: np.ndarray) -> float:
    """What is gone of squared errors by day (D,), over its own standard error from `BLOCKS` blocks of
    days."""
    size = max(1, len(old) // BLOCKS)
    gone = np.add.reduceat(old - new, np.arange(0, len(old), size))
    spread = math.sqrt(len(gone) * float(np.var(gone, ddof=1))) if len(gone) > 1 else 0.0
    return float(gone.sum()) / spread if spread > 0.0 else 0.0


def episodes(old: np.ndarray, new: np.ndarray) -> int:
    """Number of episodes in which most of a gain was made; one that lasts counts for every week of it.

    old, new: (D,) squared errors by day.  Days that together make four fifths of what was gained, the best
    first, belong to one episode where no more than two others lie between them.
    """
    gained = np.maximum(old - new, 0.0)
    order = np.argsort(-gained)
    enough = int(np.searchsorted(np.cumsum(gained[order]), 0.8 * gained.sum())) + 1
    chosen = np.sort(order[:enough])
    begins = np.flatnonzero(np.diff(chosen, prepend=-10) > EPISODE_GAP)
    lengths = [int(part[-1] - part[0]) + 1 for part in np.split(chosen, begins[1:]) if len(part)]
    return sum(max(1, length // WEEK) for length in lengths)


def probability(candidate: Candidate) -> float:
    """p of 2 Δ ln L where there is no such effect: χ², half of it with one degree less where the null is a
    boundary.

    An amplitude that cannot be negative is zero half of the time (Self and Liang 1987); not corrected for
    what was tried.
    """
    from scipy.stats import chi2

    lr, df = max(candidate.lr, 0.0), candidate.parameters
    names = added(candidate.variant)
    bounded = any(
        p.null is not None and p.null <= p.lower
        for part in candidate.parts.values()
        for mechanism in part.base.model.mechanisms
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
        if name not in baseline.parts:
            continue
        part = baseline.parts[name]
        wider = extended(part.base, additions, features=variant.features)
        likelihood = searching(wider.model, prepare_run(wider, part.record).timeline)
        parameters = wider.model.parameters
        given = variant.starts[0] if variant.starts else {}
        at = {p.name: given.get(p.name, p.start) for p in parameters} | dict(part.values)
        nulls = {
            i: p.null for i, p in enumerate(parameters) if p.name not in part.values and p.null is not None
        }
        new = list(nulls)
        for i, null in nulls.items():
            at[parameters[i].name] = max(null, parameters[i].lower)
        old = [i for i, p in enumerate(parameters) if p.name in part.values]
        directions = np.zeros((len(parameters), len(new) + len(old)))
        for column, i in enumerate((*new, *old)):
            directions[i, column] = parameters[i].slope(at[parameters[i].name])
        found = likelihood.sensitivities(at, directions)
        # what priors know keeps a sensor's ordinary offset from taking up one beyond its accuracy
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


# -- clocks --------------------------------------------------------------------------------------------------
def _shifted(baseline: Baseline, variant: Variant) -> Candidate:
    """The shift of a source that the innovations ask for, found on a grid, refined, and estimated."""
    assert variant.shift is not None
    source = variant.shift.source
    if variant.shift.summer:
        hours = [replace(variant.shift, seconds=s) for s in (HOUR_S, -HOUR_S)]
        seconds, parts = _moved(baseline, max(hours, key=lambda shift: _unestimated(baseline, shift)))
    else:
        seconds = _coarse(baseline, source)
        if seconds != 0.0:
            seconds, parts = _climbed(baseline, source, seconds)
    shift = replace(variant.shift, seconds=seconds)
    settings = {
        **variant.settings,
        "source": source,
        "shift_s": seconds,
        "summer_time": shift.summer,
        "ordinary_s": ordinary_shift(baseline.record, source),
    }
    variant = replace(variant, shift=shift, settings=settings)
    if seconds == 0.0:
        return Candidate(variant, {}, {}, 1, -penalty(variant, 1, 1), {}, {}, {})
    return judged(baseline, variant, parts)


def ordinary_shift(record: Record, source: str) -> float:
    """Largest error [s] of a source's clock that is ordinary, or no clock's.

    Of interval means a little over half the interval is what the place of the stamp in it, and heat that
    takes some minutes to the sensor, look like.
    """
    intervals = [record[name].interval_s for name in sources(record).get(source, ())]
    return max([SMALLEST_SHIFT_S, *(OF_INTERVAL * one for one in intervals)])


def _moved(
    baseline: Baseline, shift: Shift, near: Mapping[str, Part] | None = None
) -> tuple[float, dict[str, Part]]:
    """The parts estimated with a shift, from the baseline's values or from those of a shift nearby."""
    parts = {}
    for name, part in baseline.parts.items():
        begin = part if near is None else replace(part, values=near[name].values)
        parts[name] = refitted(begin, (), {}, ({},), shifted(part.record, shift), baseline.budget)
    return shift.seconds, parts


def _unestimated(baseline: Baseline, shift: Shift) -> float:
    """ln L with a shift at the baseline's own values."""
    found = 0.0
    for part in baseline.parts.values():
        moved = prepare_run(part.base, shifted(part.record, shift)).timeline
        found += searching(part.base.model, moved).value(part.values)
    return found


def _coarse(baseline: Baseline, source: str) -> float:
    """The shift [s] that score statistics ask for, 0 where none gains."""
    grid = np.array(SHIFTS_MIN) * 60.0
    gains = _gains(baseline.parts, source, grid)
    grid, gains = np.append(grid, 0.0), np.append(gains, 0.0)
    order = np.argsort(grid)
    grid, gains = grid[order], gains[order]
    for _ in range(REFINEMENTS):
        best = int(np.argmax(gains))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        more = np.setdiff1d(np.linspace(low, high, 5)[1:-1], grid)
        if not len(more):
            break
        extra = _gains(baseline.parts, source, more)
        grid, gains = np.append(grid, more), np.append(gains, extra)
        order = np.argsort(grid)
        grid, gains = grid[order], gains[order]
    return float(grid[int(np.argmax(gains))])


def _climbed(baseline: Baseline, source: str, seconds: float) -> tuple[float, dict[str, Part]]:
    """The shift of the largest likelihood near one, and the parts estimated there.

    Statistics of first order are minutes wrong for a clock that is off by many minutes; so they are taken
    again where the last ones led.
    """
    best, parts = _moved(baseline, Shift(source, seconds))
    for reach in CLOCK_REACH_S:
        delta = _summit(parts, source, reach * np.array([-1.0, -0.5, 0.5, 1.0]))
        if abs(delta) < CLOCK_S:
            continue
        further, moved = _moved(baseline, Shift(source, best + delta), parts)
        if _objective(moved) > _objective(parts):
            best, parts = further, moved
    return best, parts


def _summit(parts: Mapping[str, Part], source: str, shifts: np.ndarray) -> float:
    """The further shift [s] at the top of the parabola through the largest of the gains and its
    neighbours."""
    gains = _gains(parts, source, shifts)
    x, y = np.insert(shifts, 2, 0.0), np.insert(gains, 2, 0.0)
    place = int(np.clip(np.argmax(y), 1, len(x) - 2))
    a, b, _ = np.polyfit(x[place - 1 : place + 2], y[place - 1 : place + 2], 2)
    return float(np.clip(-0.5 * b / a, x[0], x[-1])) if a < 0.0 else float(x[np.argmax(y)])


def _objective(parts: Mapping[str, Part]) -> float:
    return sum(part.objective for part in parts.values())


def _gains(parts: Mapping[str, Part], source: str, shifts: np.ndarray) -> np.ndarray:
    """2 Δ ln L (S,) that shifts [s] promise in all parts together."""
    return np.sum([shift_gains(part, source, shifts) for part in parts.values()], axis=0)


def shift_gains(part: Part, source: str, shifts: np.ndarray) -> np.ndarray:
    """2 Δ ln L (S,) that shifts [s] of a source promise, all parameters estimated again to first order.

    Innovations e of the shifted record at the base's parameters, less what their slopes X can explain: |M
    e₀|² − |M e|².
    """
    model, at = part.base.model, dict(part.values)
    likelihood = searching(model, part.run.timeline)
    directions = np.diag([p.slope(at[p.name]) for p in model.parameters]).astype(float)
    trace = likelihood.trace(at)
    slopes = -likelihood.slopes(at, directions)
    base_time, base_e, x = _readings(part.run.timeline, trace, slopes)
    keep = np.abs(x).max(axis=0) > 1e-12
    basis, _ = np.linalg.qr(x[:, keep])
    result = []
    for seconds in shifts:
        record = shifted(part.record, Shift(source, float(seconds)))
        t = prepare_run(part.base, record).timeline
        found = searching(model, t).trace(at)
        time, e, _ = _readings(t, found, None)
        moved = "cabinet_temperature" in sources(part.record).get(source, ())
        place = _match(base_time, time - (seconds if moved else 0.0))
        inside = place >= 0
        change = np.zeros(len(base_e))
        change[place[inside]] = e[inside] - base_e[place[inside]]
        own = base_e + change
        result.append(
            float(base_e @ base_e - (basis.T @ base_e) @ (basis.T @ base_e))
            - float(own @ own - (basis.T @ own) @ (basis.T @ own))
        )
    return np.array(result)


def _readings(
    t: Timeline, trace: Trace, slopes: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [s] (N,), standardised innovations (N,), and their slopes (N, d), at the readings; (N, 0) without
    slopes."""
    read = np.isfinite(t.y)
    root = np.sqrt(trace.variance)
    e = ((t.y - trace.prediction) / root)[read]
    seconds = np.broadcast_to((t.origin_s + 3600.0 * t.time)[:, None], t.y.shape)[read]
    return seconds, e, np.empty((len(e), 0)) if slopes is None else (slopes / root[..., None])[read]


def _match(known: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Place of each time in `known` (within a second), −1 where there is none."""
    place = np.clip(np.searchsorted(known, time - 0.5), 0, len(known) - 1)
    return np.where(np.abs(known[place] - time) < 1.0, place, -1)
