"""Forecast of a cabinet's climate: the model run forward from its present state under possible weather and
operation.

Possible futures are a small set of **members**, each a course of every driver.  The state's Gaussian is
propagated under each member.  The forecast is the mixture: probabilities are means over the members, and
bounds include their spread.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.data.record import Record, Series
from hygrokf.engine.timeline import Timeline
from hygrokf.evaluation.self_switching import self_switched
from hygrokf.live.condition import (
    Condition,
    Quantity,
    Surface,
    air_condition,
    inputs_of,
    only,
    probability_above,
)
from hygrokf.live.plan import Plan
from hygrokf.live.scenarios import OPERATION, Scenarios
from hygrokf.live.tracker import SAME_S, Point
from hygrokf.live.water import on_the_safe_side
from hygrokf.modelling.inputs import Run, model_inputs
from hygrokf.physics.holds import LINEAR, MEAN

LIMIT = 0.8
"""Default limit of relative humidity [1]; a forecast gives the probability of exceeding it."""


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
    scenarios in words or why there are none, the limit of relative humidity [1], and the advice for a restart
    at standstill."""

    made: float
    weather: str
    limit: float
    advice: str | None = None


def forecast(
    plan: Plan,
    state: Point,
    scenarios: Scenarios,
    surface: Surface,
    limit: float = LIMIT,
    excess: float = np.nan,
) -> Forecast:
    """The forecast from the newest state under scenarios.

    `excess` [g/m³]: vapour by which the newest reading exceeds the estimate (`live.water`); it stays.
    Raises NoForecast if the model uses the cabinet's own readings as inputs, because future readings do not
    exist.
    """
    found = conditions_by_member(plan, state, scenarios, surface, excess)
    mixed = mixture(found)
    humidities = [one.relative_humidity for one in found if one.relative_humidity is not None]
    above = np.full(len(mixed.time_s), np.nan)
    if humidities:
        above = np.mean([probability_above(humidity, limit) for humidity in humidities], axis=0)
    return Forecast(state.time, mixed, above, limit, scenarios.words)


def conditions_by_member(
    plan: Plan, state: Point, scenarios: Scenarios, surface: Surface, excess: float = np.nan
) -> list[Condition]:
    """The condition at the state's time and at the scenarios' instants after it, one for each member, on the
    safe side of model and sensor.

    The state's time must be the scenarios' `now_s`.  Raises NoForecast as `forecast` does.
    """
    found = []
    for t, mean, covariance in moments_by_member(plan, state, scenarios):
        known, u = np.full(len(t), excess), inputs_of(plan.model, t)
        by_model = air_condition(plan.model, plan.values, t.seconds, u, mean, covariance, surface)
        whole = on_the_safe_side(by_model, plan.model, plan.values, u, mean, covariance, surface, known)
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
        series = (_series(plan, name, scenarios, values) for name, values in sorted(member.items()))
        record = Record(plan.name, tuple(series), plan.site, plan.rated_power_W)
        try:
            whole = model_inputs(plan.design, record)
        except (ValueError, KeyError) as fault:
            raise NoForecast(f"the model needs inputs that are unknown in the future: {fault}") from fault
        made = whole.timeline
        first = int(np.searchsorted(made.seconds, state.time + 1e-3, side="right"))
        future = made.window(first, len(made))
        unread = future.with_readings(np.full_like(future.y, np.nan))
        later = Run(unread, whole.operating[first:], whole.scored[first:])
        part = self_switched(plan.design, plan.values, [later], [state.state])[0].timeline
        trace = plan.likelihood(part).trace(plan.values, start=state.state)
        mean = np.concatenate([state.state.mean[None], trace.mean])
        covariance = np.concatenate([state.state.covariance[None], trace.covariance])
        yield made.window(first - 1, len(made)), mean, covariance


def _series(plan: Plan, signal: str, scenarios: Scenarios, values: np.ndarray) -> Series:
    """A driver of a member; a signal that is not joined by lines is constant over each step of the
    scenarios."""
    stepped = signal in OPERATION or (plan.form(signal).hold != LINEAR and not signal.startswith("ambient_"))
    step_s = float(scenarios.time_s[1] - scenarios.time_s[0])
    hold = (MEAN, step_s) if stepped else (LINEAR, 0.0)
    return Series(signal, scenarios.time_s, values, *hold)


def mixture(found: Sequence[Condition]) -> Condition:
    """The mixture of equally likely conditions at the same instants: means and standard deviations."""

    def mixed(name: str, _: Quantity) -> Quantity:
        values = np.array([getattr(one, name).value for one in found])
        spreads = np.array([getattr(one, name).sd for one in found])
        return Quantity(values.mean(axis=0), np.sqrt(values.var(axis=0) + np.mean(spreads**2, axis=0)))

    chances = [one.condensation for one in found if one.condensation is not None]
    return found[0].mapped(mixed, condensation=np.mean(chances, axis=0) if chances else None)
