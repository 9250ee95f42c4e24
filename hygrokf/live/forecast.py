"""What a cabinet's climate will be: the model run ahead of its state, under weather and operation that may come.

What may come is a handful of **members**, each a course of every driver.  The state's own Gaussian is carried through
each of them, and the forecast is the mixture: probabilities are means over the members, bounds hold their spread.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.engine.timeline import Timeline
from hygrokf.evaluation.self_switching import self_switched
from hygrokf.live.condition import (
    Condition,
    Quantity,
    Surface,
    condition,
    only,
    probability_above,
    probability_below,
)
from hygrokf.live.plan import Plan
from hygrokf.live.scenarios import Outlook
from hygrokf.live.tracker import SAME_S, Point
from hygrokf.modelling.inputs import Run, prepare_run

LIMIT = 0.8
"""[1] relative humidity above which a forecast gives the probability."""
ENOUGH = 0.95
"""Probability with which a restart must be dry."""
LONGEST_H = 24.0
"""[h] of pre-heating that are looked at."""
STAYS_H = 1.0
"""[h] for which it must stay dry once it is: a peak of vapour that the heat drives out must have passed."""
STEPPED = ("active_power", "preheating")


class NoForecast(Exception):
    """Why there is no forecast, in words."""


@dataclass(frozen=True)
class Forecast:
    """The condition at coming instants (T,), the probability [1] that relative humidity is `above` the limit, its words."""

    made_s: float
    condition: Condition
    above: np.ndarray
    limit: float
    words: str


@dataclass(frozen=True)
class Advice:
    """How long to pre-heat [h] until it is dry enough; None where the longest time is not enough, or nobody can say.

    `probability` [1] at that time, or the highest one reached.
    """

    made_s: float
    hours: float | None
    probability: float | None
    limit: float
    statement: str


def forecast(plan: Plan, state: Point, outlook: Outlook, surface: Surface, limit: float = LIMIT) -> Forecast:
    """The forecast from a state (the newest one) under what may come.

    Raises NoForecast where the model reads the cabinet's own readings, which do not exist yet.
    """
    found = ahead(plan, state, outlook, surface)
    mixed = mixture(found)
    known = [one.relative_humidity for one in found if one.relative_humidity is not None]
    above = (
        np.mean([probability_above(one, limit) for one in known], axis=0)
        if known
        else np.full(len(mixed.time_s), np.nan)
    )
    return Forecast(state.time, mixed, above, limit, outlook.words)


def restart(plan: Plan, state: Point, outlook: Outlook, surface: Surface, limit: float = LIMIT) -> Advice:
    """How long to pre-heat from now on, at standstill and with the heating that was identified.

    The shortest time after which the air at the coldest surface is drier than `limit` with a probability of at least
    `ENOUGH`, and stays so for `STAYS_H`.
    """
    if "preheating" not in plan.model.inputs:
        return Advice(state.time, None, None, limit, "no pre-heating was seen when the model was identified: how much it heats is not known")  # fmt: skip
    found = ahead(plan, state, outlook.heated(LONGEST_H + STAYS_H), surface)
    known = [one.surface_humidity for one in found if one.surface_humidity is not None]
    if not known:
        return Advice(state.time, None, None, limit, "the model knows no humidity")
    chance = np.mean([probability_below(one, limit) for one in known], axis=0)
    hours = (found[0].time_s - state.time) / 3600.0
    return advice_from(state.time, hours, chance, limit)


def advice_from(made_s: float, hours: np.ndarray, chance: np.ndarray, limit: float) -> Advice:
    """The advice from the probability (T,) of being dry enough after so many hours (T,) of pre-heating."""
    for place in range(len(hours)):
        if hours[place] > LONGEST_H:
            break
        later = (hours >= hours[place]) & (hours <= hours[place] + STAYS_H)
        if np.all(chance[later] >= ENOUGH):
            at, likely = float(hours[place]), float(chance[place])
            what = f"below {100 * limit:.0f} % at the coldest surface with a probability of {percent(likely)}"
            if place == 0:
                return Advice(
                    made_s, 0.0, likely, limit, f"no pre-heating is needed: relative humidity is {what}"
                )
            return Advice(
                made_s, at, likely, limit, f"pre-heat for {at:.1f} h: relative humidity is then {what}"
            )
    best = int(np.argmax(np.where(hours <= LONGEST_H, chance, -1.0)))
    return Advice(
        made_s, None, float(chance[best]), limit,
        f"not even {LONGEST_H:.0f} h of pre-heating bring relative humidity at the coldest surface below {100 * limit:.0f} % "
        f"for {STAYS_H:.0f} h with a probability of {percent(ENOUGH)}: at best it is {percent(chance[best])}, after {hours[best]:.1f} h",
    )  # fmt: skip


def percent(probability: float) -> str:
    """A probability in words that do not claim to be certain."""
    if probability > 0.99:
        return "over 99 %"
    return f"{100 * probability:.0f} %" if probability >= 0.01 else "under 1 %"


def ahead(plan: Plan, state: Point, outlook: Outlook, surface: Surface) -> list[Condition]:
    """The condition at the state's time and at the outlook's instants after it, under each member.

    The state must be of the outlook's own time.  Raises NoForecast as `forecast` does.
    """
    found = []
    for moments in moments_ahead(plan, state, outlook):
        whole = condition(plan.model, plan.values, *moments, surface)
        found.append(only(whole, np.isin(np.round(whole.time_s), np.round(outlook.time_s))))
    return found


def moments_ahead(
    plan: Plan, state: Point, outlook: Outlook
) -> Iterator[tuple[Timeline, np.ndarray, np.ndarray]]:
    """Under each member: the instants from the state's on, the state's means (T, n) and covariances (T, n, n) there."""
    if abs(state.time - outlook.now_s) > SAME_S:
        raise NoForecast(
            f"the outlook must begin at the state's time, it begins {outlook.now_s - state.time:+.0f} s from it"
        )
    for member in outlook.members:
        yield _under(plan, state, outlook, member)


def _under(
    plan: Plan, state: Point, outlook: Outlook, member: Mapping[str, np.ndarray]
) -> tuple[Timeline, np.ndarray, np.ndarray]:
    record = Record(
        plan.name,
        tuple(_series(plan, name, outlook, values) for name, values in sorted(member.items())),
        plan.site,
        plan.rated_power_W,
    )
    try:
        whole = prepare_run(plan.design, record)
    except (ValueError, KeyError) as fault:
        raise NoForecast(f"the model needs what is not known ahead of time: {fault}") from fault
    made = whole.timeline
    seconds = made.origin_s + 3600.0 * made.time
    first = int(np.searchsorted(seconds, state.time + 1e-3, side="right"))
    later = Run(_unread(made.window(first, len(made))), whole.operating[first:], whole.scored[first:])
    # a switch begins as it would stand by the state alone: within its hysteresis, off
    part = self_switched(plan.design, plan.values, [later], [state.state])[0].timeline
    trace = plan.likelihood(part).trace(plan.values, start=state.state)
    mean = np.concatenate([state.state.mean[None], trace.mean])
    covariance = np.concatenate([state.state.covariance[None], trace.covariance])
    return made.window(first - 1, len(made)), mean, covariance


def _unread(t: Timeline) -> Timeline:
    return t.with_readings(np.full_like(t.y, np.nan))


def _series(plan: Plan, signal: str, outlook: Outlook, values: np.ndarray) -> Series:
    """A driver of a member; what is averaged over intervals holds over the steps of the outlook."""
    stepped = signal in STEPPED or (
        plan.form(signal).hold == "zero-order" and not signal.startswith("ambient_")
    )
    step_s = float(outlook.time_s[1] - outlook.time_s[0])
    return Series(
        signal, outlook.time_s, values, "zero-order" if stepped else "linear", step_s if stepped else 0.0
    )


def mixture(found: Sequence[Condition]) -> Condition:
    """Means and standard deviations of the mixture of equally likely conditions at the same instants."""
    first = found[0]
    mixed: dict[str, Any] = {}
    for name, quantity in vars(first).items():
        if not isinstance(quantity, Quantity):
            continue
        values = np.array([getattr(one, name).value for one in found])
        spreads = np.array([getattr(one, name).sd for one in found])
        mixed[name] = Quantity(values.mean(axis=0), np.sqrt(values.var(axis=0) + np.mean(spreads**2, axis=0)))
    chances = [one.condensation for one in found if one.condensation is not None]
    chance = np.mean(chances, axis=0) if chances else None
    return replace(first, condensation=chance, **mixed)
