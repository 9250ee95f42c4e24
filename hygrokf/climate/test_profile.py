"""The test profile: days of the climate, warmed until the chamber ages as much as the years of service do.

With T* from 1/T* = 1/T − δ the law's rate grows by the same factor exp(E_a δ/k_B) in every hour, and the humidity
stays: the test is as much faster as it must be, and every condition keeps its share of the ageing.  (A temperature that
is simply raised by so many kelvin would give the cold hours more than their share.)  Chamber limits cut this off; δ is
then found for the sequence as it is after them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hygrokf.climate.acceleration import BOLTZMANN_EV, FREEZING_K, Acceleration
from hygrokf.climate.bounds import Bounded
from hygrokf.climate.chamber import Chamber, ProfilePlan
from hygrokf.climate.cycles import cycles_from
from hygrokf.climate.ensemble import YEAR_H
from hygrokf.climate.representative_days import DAY_H, Days, choose_days, ordered, shares
from hygrokf.climate.statistics import CYCLE_RANGES_K, WET_PERCENT

CUT_MOST = 0.5
"""Share of the hours that may stand at the chamber's highest temperature."""
NOT_REPRODUCED = (
    "temperatures and absolute humidity themselves: the test is warmer than the site",
    "the number of temperature cycles in service: the test has those of its own length, each wider by (T*/T)²",
    "the order of the seasons, and stretches longer than a day",
    "rates of change: an hour's change of temperature is wider by (T*/T)² too, as far as the chamber's ramps allow",
    "condensation: the chamber's air is held below saturation, and no part in it is colder than the air",
    "what does not age by the stated law: vibration, voltage, salt, dust, drying between wet stretches",
)


@dataclass(frozen=True)
class Sequence:
    """A test profile (n,) hour by hour: temperature [°C], relative humidity [%], the site's temperature [°C] that it
    came from, and `day_s` (n,) when the day was.

    `shift` δ [1/K]; `factor` the acceleration exp(E_a δ/k_B) [1]; `cut` share of hours at a limit of the chamber;
    `ageing_h` of the whole [h at the reference]; `statements` rows of what is reproduced and how closely.
    """

    temperature_degC: np.ndarray
    relative_humidity_percent: np.ndarray
    site_temperature_degC: np.ndarray
    site_humidity_percent: np.ndarray
    day_s: np.ndarray
    shift: float
    factor: float
    cut: float
    ageing_h: float
    reached: bool


def chamber_sequence(days: Days, ageing_h_a_year: float, plan: ProfilePlan) -> Sequence:
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
    cut = np.isclose(warm, plan.chamber.temperature_degC[1]) | np.isclose(
        warm, plan.chamber.temperature_degC[0]
    )
    return Sequence(
        warm, damp, celsius, percent, np.repeat(chosen.start_s, DAY_H)[:length], shift,
        float(np.exp(plan.law.activation_energy_eV / BOLTZMANN_EV * shift)), float(cut.mean()), aged(shift), reached,
    )  # fmt: skip


def _span(celsius: np.ndarray, chamber: Chamber) -> tuple[float, float]:
    """Shifts between which to look: the hottest half of the hours at the limit, and the coldest half at the other one."""
    kelvin = np.sort(celsius) + FREEZING_K
    bottom, top = (one + FREEZING_K for one in chamber.temperature_degC)
    place = int((1.0 - CUT_MOST) * (len(kelvin) - 1))
    return 1.0 / kelvin[place] - 1.0 / max(bottom, 1.0), 1.0 / kelvin[place] - 1.0 / top


def set_points(
    celsius: np.ndarray, percent: np.ndarray, shift: float, chamber: Chamber
) -> tuple[np.ndarray, np.ndarray]:
    """Temperature [°C] and humidity [%] (n,) after the shift δ [1/K], as the chamber can follow them."""
    inverse = np.maximum(
        1.0 / (celsius + FREEZING_K) - shift, 1.0 / (chamber.temperature_degC[1] + FREEZING_K)
    )
    warm = np.clip(1.0 / inverse - FREEZING_K, *chamber.temperature_degC)
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
    return celsius + FREEZING_K, percent / 100.0


def closeness(
    sequence: Sequence, days: Days, plan: ProfilePlan, ageing: Bounded, service_cycles: np.ndarray
) -> dict:
    """What a test profile reproduces of the site, and how closely; plain data.

    days: all days of the climate.  ageing: [h a year at the reference] of the site.  service_cycles: (3,) cycles a year
    from each of `CYCLE_RANGES_K`.
    """
    law: Acceleration = plan.law
    celsius, percent = sequence.site_temperature_degC, sequence.site_humidity_percent
    all_rate = law.rate(*_in_si(days.temperature_degC, days.relative_humidity_percent))
    own_rate = law.rate(*_in_si(sequence.temperature_degC, sequence.relative_humidity_percent))
    site = shares(days.temperature_degC, days.relative_humidity_percent)
    site_ageing = shares(days.temperature_degC, days.relative_humidity_percent, all_rate)
    years = [
        sequence.ageing_h / max(float(one), 1e-300)
        for one in (ageing.value, ageing.mean_upper, ageing.mean_lower)  # many years: their mean
    ]
    per_year = YEAR_H / len(celsius)
    before = cycles_from(celsius, CYCLE_RANGES_K)
    after = cycles_from(sequence.temperature_degC, CYCLE_RANGES_K)
    wet = days.relative_humidity_percent > WET_PERCENT
    return {
        "ageing": {
            "test_h": sequence.ageing_h,
            "service_h": plan.service_years * float(ageing.value),
            "years": years[0],
            "years_lower": years[1],
            "years_upper": years[2],
        },
        "joint_distance": _distance(shares(celsius, percent), site),
        "ageing_distance": _distance(shares(celsius, percent, own_rate), site_ageing),
        "wet_share": {
            "site": float(wet.mean()),
            "test": float((sequence.relative_humidity_percent > WET_PERCENT).mean()),
        },
        "wet_ageing_share": {
            "site": float(all_rate[wet].sum() / all_rate.sum()),
            "test": float(own_rate[sequence.relative_humidity_percent > WET_PERCENT].sum() / own_rate.sum()),
        },
        "mean_humidity_percent": {
            "site": float(days.relative_humidity_percent.mean()),
            "test": float(sequence.relative_humidity_percent.mean()),
        },
        "cycles": [
            {
                "from_K": float(least),
                "site_a_year": float(service_cycles[i]),
                "days_a_year": float(before[i] * per_year),
                "test": float(after[i]),
                "service": float(plan.service_years * service_cycles[i]),
            }
            for i, least in enumerate(CYCLE_RANGES_K)
        ],
        "not_reproduced": list(NOT_REPRODUCED),
    }


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """Total variation distance of two distributions (B,): 0 the same, 1 nothing in common."""
    return float(0.5 * np.abs(a - b).sum())
