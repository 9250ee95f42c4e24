"""The errors of a simulation: where, when and by how much, in words; worst first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

import numpy as np

from hygrokf.discovery.changes import Step, change_p, drift_p, sharp_step
from hygrokf.discovery.discovery_results import Finding
from hygrokf.discovery.residuals import (
    FEWEST_HOURS,
    QUANTITIES,
    UNITS,
    Hours,
    Residuals,
    closed,
    date_text,
    duration_h,
    hourly,
    reading_grid,
    root_mean_square,
    run_lengths,
)
from hygrokf.discovery.significance import Null, Prewhitened, benjamini_hochberg, centred, largest_p, linear_p
from hygrokf.discovery.strata import Stratum, dummies, strata

LEVEL = 0.05
MATERIAL = 0.2
"""[1] share of the free run's RMSE below which a finding is immaterial, however significant."""
SENSORS = 0.6
"""[1] share of a finding's square that the sensors may explain; beyond it the error is theirs."""
CONCORDANT = 0.05
"""[1] p that the free run itself must reach where another view of the errors is the significant one."""
CERTAIN = 1e-8
UNSURE = 0.05
"""[1] p between which the noise is judged again without the condition's own effect."""
DOUBTS = 3
"""Conditions for which this is done."""
MOST = 8
"""Findings that are reported."""
PASSES = 6
SAME_HOURS = 0.4
"""[1] hours in common over hours in either, beyond which two findings of one direction are the same."""
SEEN = 0.5
"""[1] share of its size by which a finding counts as seen in an episode."""
LASTING = 0.25
"""[1] share of a step between two readings that the means before and after must show; twice that where a kick
of the cabinet that is soon forgotten would explain the readings as well."""
NAMES = {"temperature": "temperature", "humidity": "absolute humidity"}


# --- significance ----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Answer:
    """p over all views of the errors, p of the free run alone; the date of a change, or the step between two
    readings.

    sharp: whether the errors without their memory give the smallest p.
    """

    p: float
    p_run: float
    date: int = -1
    step: Step | None = None
    sharp: bool = False


@dataclass
class _State:
    """The errors of one quantity that are left after the findings so far; described: hours and size of
    these."""

    error: np.ndarray
    innovation: np.ndarray
    step: Step | None
    rmse: float
    described: list[tuple[np.ndarray, float]] = field(default_factory=list)


def _answers(state: _State, conditions: Sequence[Stratum], step_h: float) -> list[_Answer]:
    """Test every condition on the free run, on the innovations and, where it sets in sharply, on the errors
    without their memory."""
    views = [Null.of(state.error, step_h)]
    if np.isfinite(state.innovation).sum() >= FEWEST_HOURS:
        views.append(Null.of(state.innovation, step_h))
    linear = [i for i, one in enumerate(conditions) if one.law == "linear"]
    p = np.ones((len(conditions), len(views) + 1))
    date = -1
    for view, null in enumerate(views):
        p[linear, view] = linear_p(null, [conditions[i].basis for i in linear])
    for i, one in enumerate(conditions):
        if one.law == "largest":
            p[i, : len(views)] = [largest_p(null, one.basis) for null in views]
        elif one.law == "trend":
            p[i, 0] = drift_p(views[0], one.basis)
        elif one.law == "change":
            p[i, 0], date = change_p(views[0], one.basis[:, 0].astype(int))
            p[i, -1] = state.step.p if state.step is not None else 1.0
    unsure = [i for i in linear if CERTAIN < p[i, 0] < UNSURE and conditions[i].kind != "season"]
    for i in sorted(unsure, key=lambda i: p[i, 0])[:DOUBTS]:
        p[i, 0] = linear_p(views[0].without(conditions[i].basis), [conditions[i].basis])[0]
    sudden = [i for i in linear if conditions[i].sharp]
    if sudden:
        free = Prewhitened.of(state.error)
        p[sudden, -1] = linear_p(
            Null.of(free.errors, step_h), [free.basis(conditions[i].basis) for i in sudden]
        )
    result = []
    for i, one in enumerate(conditions):
        looks = {"change": 2, "trend": 1}.get(one.law, len(views) + one.sharp)
        best = int(np.argmin(p[i]))
        last = best == len(views) and p[i, -1] < 1.0
        step = state.step if one.law == "change" and last else None
        chance = min(1.0, looks * float(p[i, best]))
        result.append(_Answer(chance, float(p[i, 0]), date, step, last and one.sharp))
    return result


def _adjusted(
    answers: Mapping[str, Sequence[_Answer]], conditions: Sequence[Stratum]
) -> dict[str, np.ndarray]:
    """q (J,) by quantity; groups of conditions have equal shares of the level."""
    groups = [one.group for one in conditions]
    weights = np.array([1.0 / groups.count(group) for group in groups])
    p = np.array([one.p for found in answers.values() for one in found])
    q = benjamini_hochberg(p, np.tile(weights, len(answers)))
    return dict(zip(answers, q.reshape(len(answers), -1), strict=True))


def findings(residuals: Residuals, level: float = LEVEL) -> list[Finding]:
    """The errors of the free run in the identification period, worst (in units of its RMSE) first, at most
    eight.

    level: [1] share of false discoveries.

    Each condition (episodes, regimes, hours since a change, hour, season, level, rate and lag of every
    driver, drift and step, saturation) is tested on the free run's errors and on the innovations.  The
    surest is described and taken out of the errors, then all are tested again: an effect that one condition
    explains is not reported under another.  A finding must be significant (weighted Benjamini–Hochberg:
    episodes, hour, calendar and drivers have equal shares of the level), material (0.2 RMSE) and more than
    the sensors' accuracy explains.

    A quantity with errors in fewer than 72 hours has no findings.
    """
    hours = hourly(residuals)
    conditions = strata(hours)
    states = {
        quantity: _State(
            hours.error[quantity].copy(),
            hours.innovation[quantity].copy(),
            sharp_step(reading_grid(residuals, quantity)[2]),
            residuals.rmse(quantity),
        )
        for quantity in QUANTITIES
        if np.isfinite(hours.error[quantity]).sum() >= FEWEST_HOURS
    }
    found: list[Finding] = []
    done: set[tuple[str, int]] = set()
    answers: dict[str, list[_Answer]] = {}
    changed = list(states)
    for _ in range(PASSES):
        for quantity in changed:
            answers[quantity] = _answers(states[quantity], conditions, hours.step_h)
        q = _adjusted(answers, conditions) if answers else {}
        changed = []
        for quantity, state in states.items():
            for i in np.argsort([one.p for one in answers[quantity]], kind="stable"):
                answer = answers[quantity][i]
                if (quantity, i) in done or q[quantity][i] > level:
                    continue
                if answer.p_run > CONCORDANT and answer.step is None:
                    continue
                done.add((quantity, i))
                one = _described(
                    residuals, hours, quantity, state, conditions, int(i), answer, float(q[quantity][i])
                )
                if one is not None:
                    found.append(one)
                    changed.append(quantity)
                    break
        if not changed:
            break
    found.sort(key=lambda one: -one.size / states[one.quantity].rmse)
    return found[:MOST]


# --- description -----------------------------------------------------------------------------


def _described(
    residuals: Residuals,
    hours: Hours,
    quantity: str,
    state: _State,
    conditions: Sequence[Stratum],
    number: int,
    answer: _Answer,
    q: float,
) -> Finding | None:
    """The finding in numbers and words, taken out of the state; None where it is immaterial or described
    already."""
    stratum = _strongest(conditions[number], conditions, state.error)
    if stratum.law == "change":
        stratum = _since(residuals, hours, quantity, stratum, answer)
    error = state.error
    known = np.isfinite(error)
    worst = stratum.worst(error)
    if worst is None:
        return None
    first, last, inside = worst
    under = known & inside
    elsewhere = float(error[known & ~inside & (stratum.bins >= 0)].mean())
    size = float(error[under].mean()) - elsewhere
    if answer.step is not None:
        least = LASTING if answer.step.clear else 2.0 * LASTING
        if size * answer.step.size < least * answer.step.size**2:
            return None
        size = answer.step.size
    if answer.sharp:
        sudden = Prewhitened.of(error).size(stratum.basis[:, 0])
        if sudden * size <= 0:
            return None
        size = sudden
    sensors = float(np.nan_to_num(root_mean_square(hours.sensor_error[quantity][inside])))
    share = min(1.0, (sensors / size) ** 2) if size else 1.0
    if abs(size) < MATERIAL * state.rmse or share > SENSORS:
        return None
    for other, direction in state.described:
        if direction * size > 0 and (inside & other).sum() > SAME_HOURS * (inside | other).sum():
            return None
    episodes = [(a, b) for a, b in run_lengths(closed(inside, hours.step_h)) if under[a:b].any()]
    means = np.array([float(error[a:b][under[a:b]].mean()) - elsewhere for a, b in episodes])
    seen = int((means * np.sign(size) >= SEEN * abs(size)).sum())
    duration = math.nan
    if stratum.kind == "episode":
        duration = duration_h(np.sign(size) * (error - elsewhere), episodes, hours.step_h)
    where, when = stratum.phrase(first, last)
    curve = stratum.curve(error, hours.step_h)
    state.described.append((inside, size))
    if answer.sharp:
        state.error = error - size * stratum.basis[:, 0]
    kin = [one for one in conditions if one.driver and one.driver == stratum.driver]
    _take_out(state, stratum, kin, answer.sharp)
    if answer.step is not None or stratum.kind == "step":
        state.step = None
    sign = "too low" if size > 0 else "too high"
    found = Finding(
        quantity, where, when, abs(size), UNITS[quantity], sign, duration, seen, len(episodes), share, "",
        answer.p, q, stratum.driver or None, stratum.kind, curve,
        tuple(
            (float(hours.time_s[a] - 1800.0 * hours.step_h),
                float(hours.time_s[b - 1] + 1800.0 * hours.step_h))
            for a, b in (episodes[i] for i in np.argsort(-means * np.sign(size), kind="stable"))
        ),
    )  # fmt: skip
    return replace(found, statement=_statement(found, sensors))


def _strongest(stratum: Stratum, conditions: Sequence[Stratum], error: np.ndarray) -> Stratum:
    """Of all conditions on the same driver, the one whose bins explain most of the error."""
    if not stratum.driver:
        return stratum
    kin = [one for one in conditions if one.driver == stratum.driver]
    return max((part for one in kin for part in one.columns or (one,)), key=lambda one: one.explained(error))


def _statement(one: Finding, sensors: float) -> str:
    noun = {"hour": "days", "step": "", "drift": "", "season": ""}.get(one.kind, "episodes")
    count = f"{one.n_episodes} of {one.n_possible} {noun}; " if noun else ""
    lasting = f" for {one.duration_h:.0f} h" if one.duration_h > 0 else ""
    place = ", ".join(part for part in (one.when, one.where) if part)
    return (
        f"{place}, simulated {NAMES[one.quantity]} is {digits(one.size)} {one.unit} {one.direction}{lasting} "
        f"({count}the sensors explain {digits(sensors)} {one.unit})"
    )


def digits(size: float) -> str:
    """A size with its significant digits."""
    return f"{size:.1f}" if size >= 0.95 else f"{size:.2f}" if size < 0.1 else f"{size:.2g}"


def _since(residuals: Residuals, hours: Hours, quantity: str, stratum: Stratum, answer: _Answer) -> Stratum:
    """The step at its date as a condition: after it, against before."""
    if answer.step is None:
        date = hours.start_s + 3600.0 * hours.step_h * answer.date
        words = f"since about {date_text(date)}"
    else:
        start, step, _ = reading_grid(residuals, quantity)
        date = start + step * answer.step.place
        words = f"since {datetime.fromtimestamp(date, UTC):%-d %B %Y %H:%M} UTC"
    after = hours.time_s >= date
    return Stratum(
        "step", "", after[:, None].astype(float), np.where(after, 0, 1), hours.time_s, lambda a,
        b: ("", words),
        "date", flag=True,
    )  # fmt: skip


def _take_out(state: _State, stratum: Stratum, kin: Sequence[Stratum], kept: bool) -> None:
    """Take out of the errors (unless they are `kept`) and of the innovations the part that the condition and
    the others on its driver explain; of the innovations also the part that changes of these explain."""
    basis = np.column_stack([stratum.basis, dummies(stratum.bins), *(one.basis for one in kin)])
    changes = np.vstack([np.zeros((1, basis.shape[1])), np.diff(np.nan_to_num(basis), axis=0)])
    if not kept:
        state.error = _unexplained(state.error, basis)
    state.innovation = _unexplained(state.innovation, np.column_stack([basis, changes]))


def _unexplained(values: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Values (n,) less their regression on columns (n, k); unchanged where there are too few."""
    known = np.isfinite(values)
    if known.sum() <= columns.shape[1]:
        return values
    x = centred(columns, known)
    effect, *_ = np.linalg.lstsq(x[known], values[known], rcond=None)
    return values - x @ effect
