"""The search for what a model lacks: screening, estimates, jumps, evidence, acceptance."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.discovery.estimate import LIGHT, POLISH, Estimate, errors_of, estimate_at, fitted, frame, slopes
from hygrokf.discovery.forms import Form, Setting
from hygrokf.discovery.judgement import Judged, judged, levelled, scores
from hygrokf.discovery.screening import (
    Parent,
    Screened,
    added,
    amplitudes,
    openings,
    parent_of,
    screened,
    widened,
)

THRESHOLD, FURTHER = 10.0, 25.0
CAUSES, SETTINGS, ROUNDS = 4, 3, 6
NEAR, NEAR_SHARE = 30.0, 0.15
SWEEPS = 3
CLOSE = 10.0
CLOSE_Z = 2.0


@dataclass(frozen=True)
class Candidate:
    form: Form
    setting: Setting
    estimate: Estimate
    gains: Mapping[str, float]
    evidence: float
    in_days: float

    @property
    def cause(self) -> str:
        return self.form.cause

    @property
    def quantities(self) -> set[str]:
        return {q for q, gain in self.gains.items() if gain > 0.5}


@dataclass(frozen=True)
class Accepted:
    candidate: Candidate
    judged: Judged
    alike: tuple[str, ...]


@dataclass(frozen=True)
class Found:
    base: Estimate
    final: Estimate
    accepted: tuple[Accepted, ...]
    refuted: tuple[tuple[Candidate, Judged], ...]


def touched(parent: Estimate, candidate: Estimate, form: Form) -> set[str]:
    if form.clock:
        return set(parent.quantities)
    if form.freed:
        return set(candidate.simulator.affects(form.freed))
    new = added(parent, candidate.simulator)
    return {q for p in new for q in candidate.simulator.affects(p.name)}


def _acts(parent: Estimate, form: Form) -> set[str]:
    """The quantities that a form acts on."""
    if form.clock:
        return set(parent.quantities)
    if form.freed:
        return {"vapour"}
    return {q for q, mechanisms in (("temperature", form.heat), ("vapour", form.vapour)) if mechanisms}


def estimated(parent: Estimate, form: Form, setting: Setting, theta: np.ndarray, effort: tuple[int, float]) -> Estimate:
    wider = widened(parent, form, setting)
    sizes = frozenset(p.name for p in amplitudes(added(parent, wider)))
    one = estimate_at(wider, parent.errors, theta, parent.linear | sizes, parent.variances)
    names = touched(parent, one, form)
    free = [name for name in wider.names if set(wider.affects(name)) & names]
    return fitted(one, free, effort)


def candidate(parent: Estimate, one: Estimate, form: Form, setting: Setting, searched: int) -> Candidate:
    new = added(parent, one.simulator)
    price = 2.0 * math.log(max(searched, 1))
    gains, evidence = {}, -price - setting.price
    for q in one.quantities:
        gain = parent.deviances[q] - one.deviances[q]
        own = [p for p in new if one.simulator.affects(p.name)[0] == q]
        n = int(np.isfinite(one.residual(q)).sum())
        k = len(own) + int(bool(form.clock) and q == "temperature") + int(bool(form.freed) and q == "vapour")
        gains[q] = gain
        paid = gain - k * math.log(max(n, 2))
        if form.together and k and paid <= 0.0:
            evidence = -math.inf
        evidence += max(0.0, paid)
    if evidence <= 0.0:
        return Candidate(form, setting, one, gains, evidence, evidence)
    return Candidate(form, setting, one, gains, evidence, evidence / day_factor(parent, one))


def day_factor(parent: Estimate, one: Estimate) -> float:
    """How much the daily sums of the added parameters' scores vary beyond independent readings, at least 1."""
    new = {p.name for p in added(parent, one.simulator)}
    if not new:
        return 1.0
    f = frame(one.simulator.parameters, set(one.simulator.names), one.linear)
    names = [one.simulator.names[i] for i in f.place]
    mine = np.array([name in new for name in names])
    information = np.zeros((mine.sum(), mine.sum()))
    spread = np.zeros_like(information)
    for q, columns in slopes(one, f).items():
        known = one.filtered[q]
        root = np.sqrt(known.weight)
        white = known.whitened(columns) * root[:, None]
        scale = np.maximum(np.sqrt((white**2).sum(axis=0)), 1e-300)
        rest = white[:, ~mine] / scale[~mine]
        rest = rest[:, rest.any(axis=0)]
        basis = np.linalg.qr(rest)[0] if rest.shape[1] else rest
        x = white[:, mine] / scale[mine]
        x = x - basis @ (basis.T @ x)
        score = x * (np.nan_to_num(known.standardised) * root)[:, None]
        day = np.floor(one.simulator.scene.readings[q].time_h / 24.0).astype(int)
        daily = np.zeros((day.max() + 1, score.shape[1]))
        np.add.at(daily, day, score)
        information += x.T @ x
        spread += daily.T @ daily
    found = float(np.trace(np.linalg.pinv(information, rcond=1e-8) @ spread)) / mine.sum()
    return max(1.0, found)


def jumped(parent: Estimate, best: Candidate, searched: int) -> Candidate:
    """The candidate after jumps of its size, its shapes and its settings, while they improve it."""
    steps = dict(best.form.steps)
    for _ in range(SWEEPS):
        before = best.estimate.deviance
        for form, setting, theta in _jumps(parent, best, steps):
            light = estimated(parent, form, setting, theta, (1, 0.3))
            if light.deviance < best.estimate.deviance + 5.0:
                one = fitted(light, _free(parent, light, form), POLISH)
                if one.deviance < best.estimate.deviance - 0.1:
                    best = candidate(parent, one, form, setting, searched)
        steps = {key: 0.5 * step for key, step in steps.items()}
        if not best.estimate.deviance < before - 1.0 and not steps:
            break
    return best


def _free(parent: Estimate, one: Estimate, form: Form) -> list[str]:
    names = touched(parent, one, form)
    return [name for name in one.simulator.names if set(one.simulator.affects(name)) & names]


def _jumps(parent: Estimate, best: Candidate, steps: Mapping[tuple[str, str], float]):
    one, form, setting = best.estimate, best.form, best.setting
    place = {name: i for i, name in enumerate(one.simulator.names)}
    new = added(parent, one.simulator)
    sizes = amplitudes(new)
    for factor in (2.5, 0.4):
        theta = one.theta.copy()
        for p in sizes:
            null = p.null or 0.0
            theta[place[p.name]] = np.clip(null + factor * (theta[place[p.name]] - null), min(p.lower, null), p.upper)
        if sizes:
            yield form, setting, theta
    for p in new:
        if p in sizes:
            continue
        for factor in (1.5, 1.0 / 1.5):
            theta = one.theta.copy()
            i = place[p.name]
            theta[i] = theta[i] * factor if p.positive else theta[i] + (0.1 if factor > 1 else -0.1) * min(p.upper - p.lower, 20.0)
            theta[i] = np.clip(theta[i], p.lower, p.upper)
            yield form, setting, theta
    for (feature, key), step in steps.items():
        for sign in (1.0, -1.0):
            if feature == "clock":
                moved = replace(setting, shift_s=setting.shift_s + sign * step)
            else:
                settings = dict(setting.features[feature])
                settings[key] = max(settings[key] + sign * step, 0.0)
                moved = replace(setting, features={**setting.features, feature: settings})
            yield form, moved, one.theta


def candidates(parent: Parent, forms: Sequence[Form], searched: Mapping[str, int]) -> list[Candidate]:
    """The causes' best candidates, best first."""
    one = parent.estimate
    seen: dict[str, list[Screened]] = {}
    for form in forms:
        seen.setdefault(form.cause, []).extend(screened(parent, form))
    for found in seen.values():
        found.sort(key=lambda s: -s.gain)
    ranked = sorted((c for c in seen if seen[c]), key=lambda c: -seen[c][0].gain)
    # of each quantity by itself: gains of the two are not alike in size
    order = [
        c for c in ranked if any(c in [d for d in ranked if q in _acts(one, seen[d][0].form)][:CAUSES] for q in one.quantities)
    ]
    best: dict[str, Candidate] = {}
    for cause in order:
        for s in seen[cause][:SETTINGS]:
            made = estimated(one, s.form, s.setting, s.theta, LIGHT)
            found = candidate(one, made, s.form, s.setting, searched[cause])
            if cause not in best or found.evidence > best[cause].evidence:
                best[cause] = found
    if not best:
        return []
    lead = max(one.evidence for one in best.values())
    polished = []
    for found in best.values():
        if found.evidence > lead - max(NEAR, NEAR_SHARE * lead):
            made = fitted(found.estimate, _free(one, found.estimate, found.form), POLISH)
            found = candidate(one, made, found.form, found.setting, searched[found.cause])
        polished.append(found)
    return sorted(polished, key=lambda c: -c.in_days)


def search(base: Estimate, forms: Sequence[Form], say: Callable[[str], None] = lambda text: None) -> Found:
    searched: dict[str, int] = {}
    for form in forms:
        searched[form.cause] = searched.get(form.cause, 0) + len(form.grid)
    parent, accepted, refuted = base, [], []
    gone: set[str] = set()
    for _ in range(ROUNDS):
        before = scores(levelled(parent))
        whole = parent_of(parent)
        left = [form for form in forms if form.cause not in gone]
        found = candidates(whole, left, searched)
        if not found:
            break
        found = [jumped(parent, found[0], searched[found[0].cause]), *found[1:]]
        found.sort(key=lambda c: -c.in_days)
        say(", ".join(f"{c.cause}/{c.form.code} {c.evidence:.0f}/{c.in_days:.0f}" for c in found))
        taken = None
        for one in found:
            named = {q for a in accepted for q in a.candidate.quantities}
            need = FURTHER if one.quantities & named else THRESHOLD
            if min(one.evidence, one.in_days) < need:
                continue
            acts = touched(parent, one.estimate, one.form)
            after = scores(levelled(foreseen(parent, one)))
            verdict = judged({q: before[q] for q in acts}, {q: after[q] for q in acts})
            say(f"   {one.cause}: z {verdict.z}, growth {verdict.growth}, {verdict.before} -> {verdict.after} {verdict.reason}")
            if verdict.reason:
                refuted.append((one, verdict))
                gone.add(one.cause)
                continue
            rivals = tuple(c.cause for c in found if c is not one and _alike(one, c))
            taken = Accepted(one, verdict, rivals)
            break
        if taken is None:
            break
        accepted.append(taken)
        gone.add(taken.candidate.cause)
        parent = taken.candidate.estimate
        errors = errors_of(parent.simulator, parent.theta, parent.quantities)
        parent = fitted(estimate_at(parent.simulator, errors, parent.theta, parent.linear))
    return Found(base, parent, tuple(accepted), tuple(refuted))


def foreseen(parent: Estimate, one: Candidate) -> Estimate:
    """The candidate's estimate with the openings of the held-out part, which nothing foresees."""
    if not one.form.windows:
        return one.estimate
    base = replace(one.form, grid=(Setting({"door_open": {"spans": [[-1e18, 1e18]]}}),))
    later = openings(parent, base, identified=False)
    spans = sorted([*one.setting.features["door_open"]["spans"], *later.spans])
    wider = widened(parent, one.form, Setting({"door_open": {"spans": spans}}))
    e = one.estimate
    return estimate_at(wider, e.errors, e.theta, e.linear, e.variances)


def _alike(best: Candidate, rival: Candidate) -> bool:
    shared = best.quantities & rival.quantities
    if not shared or rival.evidence < THRESHOLD:
        return False
    if best.evidence - rival.evidence < CLOSE:
        return True
    total = []
    for q in shared:
        day = np.floor(best.estimate.simulator.scene.readings[q].time_h / 24.0).astype(int)
        daily = np.zeros(day.max() + 1)
        np.add.at(daily, day, rival.estimate.filtered[q].terms - best.estimate.filtered[q].terms)
        total.append(daily)
    daily = sum(total[1:], total[0])
    return float(daily.sum() / (math.sqrt(len(daily)) * max(daily.std(), 1e-12))) < CLOSE_Z
