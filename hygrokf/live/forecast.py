"""Forecast of a cabinet's climate: the model run forward from its present state under possible weather and
operation.

Possible futures are a small set of **members**, each a course of every driver.  The state's Gaussian is
propagated under each member.  The forecast is the mixture: probabilities are means over the members, and
bounds include their spread.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import HOUR_S
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
from hygrokf.live.scenarios import Scenarios
from hygrokf.live.tracker import SAME_S, Point
from hygrokf.modelling.inputs import Run, prepare_run

LIMIT = 0.8
"""Default limit of relative humidity [1]; a forecast gives the probability of exceeding it."""
ENOUGH = 0.95
"""Probability [1] with which the air must be dry enough for a restart."""
LONGEST_H = 24.0
"""Longest pre-heating that is considered [h]."""
STAYS_H = 1.0
"""[h] the air must stay dry: the peak of vapour that the heat drives out of materials must have passed."""
STEPPED = ("active_power", "preheating")


class NoForecast(Exception):
    """No forecast can be made; the message says why."""


@dataclass(frozen=True)
class Forecast:
    """The condition at future instants (T,).

    `made_s`: time [s] of the state it starts from; `above` (T,): probability [1] that relative humidity
    exceeds `limit`; `words`: description of the scenarios.
    """

    made_s: float
    condition: Condition
    above: np.ndarray
    limit: float
    words: str


@dataclass(frozen=True)
class ForecastMade:
    """What the store keeps of a forecast beside its courses: time [s] of the state it starts from, the
    scenarios in words, and the limit of relative humidity [1]."""

    made: float
    weather: str = ""
    limit: float | None = None


@dataclass(frozen=True)
class Advice:
    """How long to pre-heat before a restart.

    `hours` [h] of pre-heating until the air is dry enough, None if `LONGEST_H` is not enough or the time is
    unknown; `probability` [1] of dry air after that time, or the highest one within `LONGEST_H`.
    """

    made_s: float
    hours: float | None
    probability: float | None
    limit: float
    statement: str


def forecast(
    plan: Plan, state: Point, scenarios: Scenarios, surface: Surface, limit: float = LIMIT
) -> Forecast:
    """The forecast from the newest state under scenarios.

    Raises NoForecast if the model uses the cabinet's own readings as inputs, because future readings do not
    exist.
    """
    found = conditions_by_member(plan, state, scenarios, surface)
    mixed = mixture(found)
    humidities = [one.relative_humidity for one in found if one.relative_humidity is not None]
    above = np.full(len(mixed.time_s), np.nan)
    if humidities:
        above = np.mean([probability_above(humidity, limit) for humidity in humidities], axis=0)
    return Forecast(state.time, mixed, above, limit, scenarios.words)


def restart(plan: Plan, state: Point, scenarios: Scenarios, surface: Surface, limit: float = LIMIT) -> Advice:
    """How long to pre-heat from now on, at standstill and with the identified heating power.

    The advice is the shortest time after which the relative humidity at the coldest surface is below `limit`
    with a probability of at least `ENOUGH`, and stays so for `STAYS_H`.
    """
    if "preheating" not in plan.model.inputs:
        statement = "the record that identified the model has no pre-heating: its heating power is unknown"
        return Advice(state.time, None, None, limit, statement)
    found = conditions_by_member(plan, state, scenarios.with_preheating(LONGEST_H + STAYS_H), surface)
    humidities = [one.surface_humidity for one in found if one.surface_humidity is not None]
    if not humidities:
        return Advice(state.time, None, None, limit, "the model has no humidity")
    chance = np.mean([probability_below(humidity, limit) for humidity in humidities], axis=0)
    hours = (found[0].time_s - state.time) / HOUR_S
    return advice_from(state.time, hours, chance, limit)


def advice_from(made_s: float, hours: np.ndarray, chance: np.ndarray, limit: float) -> Advice:
    """The advice from the probability `chance` (T,) of dry air after `hours` (T,) [h] of pre-heating."""
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
        f"not even {LONGEST_H:.0f} h of pre-heating bring relative humidity at the coldest surface below "
        f"{100 * limit:.0f} % for {STAYS_H:.0f} h with a probability of {percent(ENOUGH)}: at best it is "
        f"{percent(chance[best])}, after {hours[best]:.1f} h",
    )  # fmt: skip


def percent(probability: float) -> str:
    """A probability as text that never claims certainty."""
    if probability > 0.99:
        return "over 99 %"
    return f"{100 * probability:.0f} %" if probability >= 0.01 else "under 1 %"


def conditions_by_member(plan: Plan, state: Point, scenarios: Scenarios, surface: Surface) -> list[Condition]:
    """The condition at the state's time and at the scenarios' instants after it, one for each member.

    The state's time must be the scenarios' `now_s`.  Raises NoForecast as `forecast` does.
    """
    found = []
    for moments in moments_by_member(plan, state, scenarios):
        whole = condition(plan.model, plan.values, *moments, surface)
        found.append(only(whole, np.isin(np.round(whole.time_s), np.round(scenarios.time_s))))
    return found


def moments_by_member(
    plan: Plan, state: Point, scenarios: Scenarios
) -> Iterator[tuple[Timeline, np.ndarray, np.ndarray]]:
    """For each member: the timeline from the state's time on, and the state's means (T, n) and covariances
    (T, n, n) there."""
    if abs(state.time - scenarios.now_s) > SAME_S:
        raise NoForecast(
            f"the scenarios must begin at the state's time; they begin {scenarios.now_s - state.time:+.0f} s "
            "from it"
        )
    for member in scenarios.members:
        yield _member_moments(plan, state, scenarios, member)


def _member_moments(
    plan: Plan, state: Point, scenarios: Scenarios, member: Mapping[str, np.ndarray]
) -> tuple[Timeline, np.ndarray, np.ndarray]:
    record = Record(
        plan.name,
        tuple(_series(plan, name, scenarios, values) for name, values in sorted(member.items())),
        plan.site,
        plan.rated_power_W,
    )
    try:
        whole = prepare_run(plan.design, record)
    except (ValueError, KeyError) as fault:
        raise NoForecast(f"the model needs inputs that are unknown in the future: {fault}") from fault
    made = whole.timeline
    seconds = made.seconds
    first = int(np.searchsorted(seconds, state.time + 1e-3, side="right"))
    future = made.window(first, len(made))
    unread = future.with_readings(np.full_like(future.y, np.nan))
    later = Run(unread, whole.operating[first:], whole.scored[first:])
    # the state alone decides a switch's initial position; within its hysteresis it starts off
    part = self_switched(plan.design, plan.values, [later], [state.state])[0].timeline
    trace = plan.likelihood(part).trace(plan.values, start=state.state)
    mean = np.concatenate([state.state.mean[None], trace.mean])
    covariance = np.concatenate([state.state.covariance[None], trace.covariance])
    return made.window(first - 1, len(made)), mean, covariance


def _series(plan: Plan, signal: str, scenarios: Scenarios, values: np.ndarray) -> Series:
    """A driver of a member; a signal that is averaged over intervals is constant over each step of the
    scenarios."""
    stepped = signal in STEPPED or (
        plan.form(signal).hold == "zero-order" and not signal.startswith("ambient_")
    )
    step_s = float(scenarios.time_s[1] - scenarios.time_s[0])
    return Series(
        signal, scenarios.time_s, values, "zero-order" if stepped else "linear", step_s if stepped else 0.0
    )


def mixture(found: Sequence[Condition]) -> Condition:
    """The mixture of equally likely conditions at the same instants: means and standard deviations."""
    first = found[0]
    mixed: dict[str, Quantity] = {}
    for name, quantity in vars(first).items():
        if not isinstance(quantity, Quantity):
            continue
        values = np.array([getattr(one, name).value for one in found])
        spreads = np.array([getattr(one, name).sd for one in found])
        mixed[name] = Quantity(values.mean(axis=0), np.sqrt(values.var(axis=0) + np.mean(spreads**2, axis=0)))
    chances = [one.condensation for one in found if one.condensation is not None]
    return replace(
        first, time_s=first.time_s, condensation=np.mean(chances, axis=0) if chances else None, **mixed
    )
