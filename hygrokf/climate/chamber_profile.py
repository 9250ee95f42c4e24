"""The test profile of a chamber: days of the climate, warmed to the ageing of the years of service.

With T* from 1/T* = 1/T − δ the law's rate grows by the same factor exp(E_a δ/k_B) in every hour, and the
humidity stays: every condition keeps its share of the ageing.
(A temperature raised by a fixed number of kelvin would give the cold hours more than their share.)  The
chamber's limits cut this off; δ is found for the sequence after them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hygrokf.climate.bounds import Bounded
from hygrokf.climate.chamber import BOLTZMANN_EV, Acceleration, Chamber, ProfilePlan
from hygrokf.climate.ensemble import YEAR_H
from hygrokf.climate.representative_days import DAY_H, Days, choose_days, ordered, shares
from hygrokf.climate.statistics import CYCLE_RANGES_K, WET_PERCENT, cycles_from
from hygrokf.data.timestamps import stamp_text
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K

CUT_MOST = 0.5
"""Share of the hours that may stand at the chamber's highest temperature."""
NOT_REPRODUCED = (
    "temperatures and absolute humidities themselves: the test is warmer than the site",
    "the number of temperature cycles in service: the test has only the cycles of its own length, each "
    "wider by (T*/T)²",
    "the order of the seasons, and stretches longer than a day",
    "rates of change: an hour's change of temperature is wider by (T*/T)² too, as far as the chamber's ramps "
    "allow",
    "condensation: the chamber's air is held below saturation, and no part in it is colder than the air",
    "ageing that does not follow the stated law: vibration, voltage, salt, dust, drying between wet "
    "stretches",
)


@dataclass(frozen=True, eq=False)
class ChamberSequence:
    """A sequence of a chamber, hour by hour.

    `hour` of the test; temperature [°C] and relative humidity [%] of the chamber, and of the site in the same
    hours; `day` when each day began, UTC.  `shift_per_K` δ; `acceleration` exp(E_a δ/k_B) [1] before the
    chamber's limits; `share_at_chamber_limit` [1] of the hours; `reached`: whether it ages as much as the
    years of service.
    """

    hour: tuple[int, ...]
    temperature_degC: np.ndarray
    relative_humidity_percent: np.ndarray
    site_temperature_degC: np.ndarray
    site_humidity_percent: np.ndarray
    day: tuple[str, ...]
    shift_per_K: float
    acceleration: float
    share_at_chamber_limit: float
    reached: bool

    @property
    def courses(self) -> dict[str, np.ndarray]:
        """The temperatures and humidities by name."""
        return {name: one for name, one in vars(self).items() if isinstance(one, np.ndarray)}


@dataclass(frozen=True)
class Ageing:
    """Ageing [h at the reference condition] of the test and of the years of service, and the years [a] at the
    site that the test stands for, with bounds."""

    test_h: float
    service_h: float
    years: float
    years_lower: float
    years_upper: float


@dataclass(frozen=True)
class SiteAndTest:
    """A number of the site beside the same of the test."""

    site: float
    test: float


@dataclass(frozen=True)
class CycleCount:
    """Temperature cycles of at least `from_K` [K]: per year at the site, per year in the chosen days before
    warming, in the test, and in the years of service."""

    from_K: float
    site_a_year: float
    days_a_year: float
    test: float
    service: float


@dataclass(frozen=True)
class Closeness:
    """What a test profile reproduces of the site, and how closely.

    Distances [1] are total variations between distributions: of temperature before warming and humidity, and
    of the ageing over these.  Shares [1] are of the hours, and of the ageing, above 80 %.
    """

    ageing: Ageing
    joint_distance: float
    ageing_distance: float
    wet_share: SiteAndTest
    wet_ageing_share: SiteAndTest
    mean_humidity_percent: SiteAndTest
    cycles: tuple[CycleCount, ...]
    not_reproduced: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ChamberProfile(ChamberSequence):
    """The test profile of a region, and what it reproduces of the site."""

    closeness: Closeness

    def __post_init__(self) -> None:
        if found := [one.shape for one in self.courses.values() if one.shape != (len(self.hour),)]:
            raise ValueError(f"expected a value for each of {len(self.hour)} hours, found {found[0]}")


def build_profile(
    days: Days, plan: ProfilePlan, ageing: Bounded, service_cycles: np.ndarray
) -> ChamberProfile:
    """The test profile from all days of a climate; arguments as for `chamber_sequence` and `closeness`."""
    made = chamber_sequence(days, ageing.value, plan)
    shown = {name: np.round(one, 2) for name, one in made.courses.items()}
    return ChamberProfile(
        **{**vars(made), **shown}, closeness=closeness(made, days, plan, ageing, service_cycles)
    )


def chamber_sequence(days: Days, ageing_h_a_year: float, plan: ProfilePlan) -> ChamberSequence:
    """A test profile from the days of a climate that ages by so many hours a year [h at the reference].

    Raises ValueError where there is no whole day to choose from.
    """
    if not len(days):
        raise ValueError("no day of the weather is known hour by hour: a test profile needs hourly weather")
    length = round(plan.length_h)
    count = -(-length // DAY_H)
    chosen = days.take(choose_days(days, count, plan.law))
    chosen = chosen.take(ordered(chosen))
    celsius = chosen.temperature_degC.ravel()[:length]
    percent = chosen.relative_humidity_percent.ravel()[:length]
    target = plan.service_years * ageing_h_a_year

    def aged(shift: float) -> float:
        return float(plan.law.rate(*_in_si(*set_points(celsius, percent, shift, plan.chamber))).sum())

    low, high = _span(celsius, plan.chamber)
    reached = aged(low) <= target <= aged(high)
    shift = high if target > aged(high) else low
    if reached:
        for _ in range(60):
            shift = 0.5 * (low + high)
            low, high = (shift, high) if aged(shift) < target else (low, shift)
    warm, damp = set_points(celsius, percent, shift, plan.chamber)
    cut = np.isclose(warm[:, None], plan.chamber.temperature_degC).any(axis=1)
    return ChamberSequence(
        tuple(range(len(warm))), warm, damp, celsius, percent, tuple(map(stamp_text, chosen.start_s)), shift,
        float(np.exp(plan.law.activation_energy_eV / BOLTZMANN_EV * shift)), float(cut.mean()), reached,
    )  # fmt: skip


def _span(celsius: np.ndarray, chamber: Chamber) -> tuple[float, float]:
    """Shifts between which to look: the hottest half of the hours at the limit, and the coldest half at the
    other one."""
    kelvin = np.sort(celsius) + ZERO_CELSIUS_K
    bottom, top = (one + ZERO_CELSIUS_K for one in chamber.temperature_degC)
    place = int((1.0 - CUT_MOST) * (len(kelvin) - 1))
    return 1.0 / kelvin[place] - 1.0 / max(bottom, 1.0), 1.0 / kelvin[place] - 1.0 / top


def set_points(
    celsius: np.ndarray, percent: np.ndarray, shift: float, chamber: Chamber
) -> tuple[np.ndarray, np.ndarray]:
    """Temperature [°C] and humidity [%] (n,) after the shift δ [1/K], as the chamber can follow them."""
    inverse = np.maximum(
        1.0 / (celsius + ZERO_CELSIUS_K) - shift, 1.0 / (chamber.temperature_degC[1] + ZERO_CELSIUS_K)
    )
    warm = np.clip(1.0 / inverse - ZERO_CELSIUS_K, *chamber.temperature_degC)
    damp = np.clip(percent, *chamber.relative_humidity_percent)
    return (
        _ramped(warm, chamber.temperature_ramp_K_per_h),
        _ramped(damp, chamber.humidity_ramp_percent_per_h),
    )


def _ramped(values: np.ndarray, most: float) -> np.ndarray:
    """The course that follows values (n,) with at most so much change from one to the next."""
    if not len(values) or np.abs(np.diff(values)).max(initial=0.0) <= most:
        return values
    course = [float(values[0])]
    for value in values[1:].tolist():
        course.append(min(max(value, course[-1] - most), course[-1] + most))
    return np.array(course)


def _in_si(celsius: np.ndarray, percent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return celsius + ZERO_CELSIUS_K, percent / 100.0


def closeness(
    sequence: ChamberSequence, days: Days, plan: ProfilePlan, ageing: Bounded, service_cycles: np.ndarray
) -> Closeness:
    """What a test profile reproduces of the site, and how closely.

    days: all days of the climate.  ageing: [h a year at the reference] of the site.  service_cycles: (3,)
    cycles a year from each of `CYCLE_RANGES_K`.
    """
    law: Acceleration = plan.law
    celsius, percent = sequence.site_temperature_degC, sequence.site_humidity_percent
    all_rate = law.rate(*_in_si(days.temperature_degC, days.relative_humidity_percent))
    own_rate = law.rate(*_in_si(sequence.temperature_degC, sequence.relative_humidity_percent))
    site = shares(days.temperature_degC, days.relative_humidity_percent)
    site_ageing = shares(days.temperature_degC, days.relative_humidity_percent, all_rate)
    aged = float(own_rate.sum())
    years = [
        aged / max(one, 1e-300)
        for one in (ageing.value, ageing.mean_upper, ageing.mean_lower)  # many years: their mean
    ]
    per_year = YEAR_H / len(celsius)
    before = cycles_from(celsius)
    after = cycles_from(sequence.temperature_degC)
    wet = days.relative_humidity_percent > WET_PERCENT
    test_wet = sequence.relative_humidity_percent > WET_PERCENT
    return Closeness(
        Ageing(aged, plan.service_years * ageing.value, *years),
        _distance(shares(celsius, percent), site),
        _distance(shares(celsius, percent, own_rate), site_ageing),
        SiteAndTest(float(wet.mean()), float(test_wet.mean())),
        SiteAndTest(
            float(all_rate[wet].sum() / all_rate.sum()), float(own_rate[test_wet].sum() / own_rate.sum())
        ),
        SiteAndTest(
            float(days.relative_humidity_percent.mean()), float(sequence.relative_humidity_percent.mean())
        ),
        tuple(
            CycleCount(
                float(least), float(service_cycles[i]), float(before[i] * per_year), float(after[i]),
                float(plan.service_years * service_cycles[i]),
            )
            for i, least in enumerate(CYCLE_RANGES_K)
        ),
        NOT_REPRODUCED,
    )  # fmt: skip


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """Total variation distance of two distributions (B,): 0 the same, 1 nothing in common."""
    return float(0.5 * np.abs(a - b).sum())
