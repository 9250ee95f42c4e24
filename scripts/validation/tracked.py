"""Simulated cabinets that are identified on their first weeks and tracked from then on, with the truth beside
them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from plants import plant
from plants.as_record import to_record
from plants.plant import Plant

from hygrokf.data.readings import mask
from hygrokf.data.record import Record
from hygrokf.estimation.likelihood import Gaussian
from hygrokf.identification.fit import Fit
from hygrokf.identification.identify import identify
from hygrokf.live.condition import Surface
from hygrokf.live.forecast import heating_sd
from hygrokf.live.plan import Plan, SignalReporting, plan
from hygrokf.live.scenarios import PAST_DAYS, Scenarios, persistence
from hygrokf.live.tracker import Point, TrackedCourse, offline_course
from hygrokf.physics.psychrometrics import (
    GAS_CONSTANT_VAPOUR,
    ZERO_CELSIUS_K,
    dew_point,
    frost_point,
    saturation_pressure_water,
)

DAY_S = 86400.0
SURFACE = Surface(follows=0.6, offset_K=0.0)
"""The cold surface of the trials."""
SETTLED_S = 2 * DAY_S
"""[s] of tracking before the first forecast or judgement."""
HISTORY_S = (PAST_DAYS + 6.0) * DAY_S
"""[s] of readings that scenarios is given."""


def identified(record: Record, until_s: float) -> Fit:
    """The model of the readings up to `until_s` [s], masked as those of a case file, by the default settings
    and one start."""
    return identify(mask(record.window(record.start_s, until_s)), starts=1)


def plan_of(fit: Fit, record: Record) -> Plan:
    """How a tracker of this cabinet is planned."""
    forms = {s.signal: SignalReporting(s.hold, s.interval_s, s.resolution, s.accuracy) for s in record.series}
    return plan(fit, forms=forms, site=record.site, rated_power_W=record.rated_power_W)


@dataclass(frozen=True)
class Tracked:
    """A plant, its record, its model, and the tracker's estimates: offline, which is bit for bit the same.

    `heating_sd_K`: standard error of the effect of the model's heaters.
    """

    made: Plant
    record: Record
    plan: Plan
    course: TrackedCourse
    seconds: np.ndarray
    heating_sd_K: float

    def point(self, now_s: float) -> Point:
        """The newest estimate at a time [s]."""
        i = int(np.searchsorted(self.seconds, now_s + 1e-3)) - 1
        trace = self.course.trace
        return Point(float(self.seconds[i]), Gaussian(trace.mean[i], trace.covariance[i]))

    def scenarios(self, now_s: float) -> Scenarios:
        """What may come, from the readings up to a time [s].  Raises NoScenarios."""
        history = self.record.window(now_s - HISTORY_S, now_s)
        return persistence(history, self.point(now_s).time, self.plan.further)


def tracked(
    made: Plant, until_s: float, logged: Callable[[Record], Record] = lambda record: record
) -> Tracked:
    """A plant that is identified on its readings up to `until_s` [s]; `logged`: what its loggers report."""
    record = logged(to_record(made))
    fit = identified(record, until_s)
    found = plan_of(fit, record)
    course = offline_course(found, record)
    return Tracked(made, record, found, course, course.seconds, heating_sd(fit))


def turbine_plant(seed: int, days: float, **options: object) -> Plant:
    """A cabinet in a turbine that stands still at times and pre-heats, under moist fronts."""
    return plant(seed, days=days, operation="turbine", weather="fronts", preheating=True, **options)


@lru_cache(maxsize=1)
def tracked_plant(seed: int, learnt: float, days: float, **options: object) -> tuple[Tracked, float]:
    """Such a plant, identified on its first days and tracked over others, and the time [s] at which these
    begin."""
    made = turbine_plant(seed, learnt + days, **options)
    begin = float(made.drivers.time[0]) + learnt * DAY_S
    return tracked(made, begin), begin


@dataclass(frozen=True)
class Truth:
    """What a plant's air was at some times: temperature [K], relative humidity [1] in the air and at the cold
    surface, and the surface's margin [K] above the dew point or, below freezing, the frost point."""

    kelvin: np.ndarray
    humidity: np.ndarray
    at_surface: np.ndarray
    margin_K: np.ndarray


def truth(made: Plant, time_s: np.ndarray, surface: Surface = SURFACE) -> Truth:
    """The truth at times (T,) [s]."""
    minutes, run = made.drivers.time, made.trajectory
    kelvin = np.interp(time_s, minutes, run.cabinet_K)
    pressure = np.interp(time_s, minutes, run.cabinet_kg_m3) * GAS_CONSTANT_VAPOUR * kelvin
    outside = np.interp(time_s, minutes, made.drivers.ambient_K)
    cold = outside + surface.follows * (kelvin - outside) + surface.offset_K
    dew = dew_point(pressure)
    icy = (cold < ZERO_CELSIUS_K) & (dew < ZERO_CELSIUS_K)
    # the ice's formula is not made for the pressures of warm air
    drops = np.where(icy, frost_point(np.minimum(pressure, 611.0)), dew)
    return Truth(
        kelvin,
        pressure / saturation_pressure_water(kelvin),
        pressure / saturation_pressure_water(cold),
        cold - drops,
    )
