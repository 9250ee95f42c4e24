"""Why something has departed: the cabinet itself, or a sensor, by which of them explains the readings of the last weeks.

Every property and every sensor's error is a state of the tracked model that may wander.  An inquiry lets one of them wander
at a time and holds all others still: the same filter with other rates, so that likelihoods can be compared as they are.  A
thermometer that is off, say, makes the humidity reading depart by what saturation demands; a heater that stays on does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from hygrokf.data.record import Record
from hygrokf.live.ceiling import filtered
from hygrokf.live.plan import Plan
from hygrokf.modelling.inputs import prepare_run

STATES = {
    "thermal_time_constant": (("log_thermal_change", (0.05, 0.2, 0.6)),),
    "hygric_k": (("log_hygric_change", (0.05, 0.2, 0.6)),),
    "heat_release_change": (("release_change", (0.2, 0.6, 2.0)),),
    "temperature_sensor": (("temperature_reading_change", (0.2, 0.6, 2.0)),),
    "humidity_sensor": (
        ("humidity_reading_change", (0.01, 0.03, 0.1)),
        ("humidity_scale_change", (0.03, 0.1, 0.3)),
    ),
}
"""Cause -> states that wander where it is the cause, each with rates for a day that are tried."""
SENSORS = ("temperature_sensor", "humidity_sensor")
LEAST = 8.0
"""Gain in ln L from which a cause explains something: there are some twenty combinations to choose from."""
CLOSE = 3.0
"""Difference in ln L below which two causes are not told apart."""
BEFORE_S = 20.0 * 86400.0
"""[s] of readings before a departure that an inquiry looks at."""
LONGEST_S = 45.0 * 86400.0
EVERY_S = 86400.0
"""[s] after which one that lasts is inquired into again."""


@dataclass(frozen=True)
class Finding:
    """The likeliest cause ("" where none explains the readings), its state and value there now, and others as likely.

    `gain` in ln L over a cabinet that has not changed; `lead` over the next cause, None where there is none.
    """

    time_s: float
    cause: str
    state: str = ""
    value: float = 0.0
    gain: float = 0.0
    lead: float | None = None
    alike: tuple[str, ...] = ()


def inquire(plan: Plan, record: Record) -> Iterator[Finding | None]:
    """Look for the cause in a record; None after each step, and in the end the finding.

    Raises ValueError where nothing can be filtered.
    """
    t = prepare_run(plan.design, record).timeline
    likelihood = plan.likelihood(t)
    still = {**plan.values, **_standing(plan)}
    base = filtered(likelihood, still).loglik
    end_s = float(t.origin_s + 3600.0 * t.time[-1])
    gains: dict[str, tuple[float, str, float]] = {}
    for cause, options in STATES.items():
        for state, rates in options:
            if state not in plan.model.states:
                continue
            place = plan.model.states.index(state)
            for rate in rates:
                found = filtered(likelihood, {**still, f"{state}_rate": rate})
                gain = found.loglik - base
                if cause not in gains or gain > gains[cause][0]:
                    gains[cause] = (gain, state, float(found.mean[-1, place]))
                yield None
    yield judged_by(gains, end_s)


def judged_by(gains: Mapping[str, tuple[float, str, float]], time_s: float) -> Finding:
    """The finding from each cause's (gain, state, value)."""
    ordered = sorted(gains, key=lambda cause: -gains[cause][0])
    if not ordered or gains[ordered[0]][0] < LEAST:
        return Finding(time_s, "")
    best = ordered[0]
    gain, state, value = gains[best]
    lead = gain - gains[ordered[1]][0] if len(ordered) > 1 else None
    alike = tuple(cause for cause in ordered[1:] if gain - gains[cause][0] < CLOSE)
    return Finding(time_s, best, state, value, gain, lead, alike)


def _standing(plan: Plan) -> dict[str, float]:
    """Rates at which nothing wanders: the least that the model allows."""
    wandering = {f"{state}_rate" for options in STATES.values() for state, _ in options}
    return {p.name: p.lower for p in plan.model.parameters if p.name in wandering}
