"""The test profile of a climate chamber: days of the simulated climate, warmed until they cause the ageing of
the years of service.

The warmer temperature T* is given by 1/T* = 1/T − δ: the ageing of every hour grows by the same factor
exp(E_a δ/k_B), and the humidity stays, so that every condition keeps its share of the ageing. (Raising all
temperatures by the same number of kelvin would give cold hours a larger share.) The chamber's limits cut the
temperatures off; δ is found with these limits applied.

The days are chosen so that together they have the features of the whole ensemble: joint distribution of
temperature and humidity, distribution of ageing over it, wet hours, and daily ranges. Each step adds, and
later exchanges, the day that brings the means of these features closest to their targets in least squares.
(The method of test reference years, ISO 15927-4, with days instead of months and ageing instead of heating
demand.)
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hygrokf.climate.bounds import BoundedMean, expect_shape
from hygrokf.climate.chamber import BOLTZMANN_EV, Acceleration, Chamber, ProfilePlan
from hygrokf.climate.ensemble import YEAR_H, Year
from hygrokf.climate.statistics import CYCLE_RANGES_K, WET_PERCENT, cycles_from
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.statement import Statement

DAY_H = 24
MOST_DAYS = 3000
"""Largest number of days to choose from."""
T_EDGES, H_EDGES = np.arange(-60.0, 125.0, 5.0), np.arange(0.0, 110.0, 10.0)
"""[°C], [%] edges of the bins in which distributions are compared."""
RANGE_EDGES_K = np.array([0.0, 2.5, 5.0, 7.5, 10.0, 15.0, 20.0, 1e3])
WEIGHTS = {"joint": 1.0, "ageing": 1.0, "mean": 3.0, "wet": 2.0, "range": 1.0}
"""Weights of the features' squared errors."""
MOST_EXCHANGES = 12
"""Largest number of rounds in which chosen days are exchanged."""


Days: TypeAlias = np.ndarray
"""Temperatures [°C] and relative humidities [%] (2, D, 24) of days, hour by hour."""


def days_of(year: Year, members: Sequence[int]) -> Days:
    """The days of some members of a year whose hours are all known; empty if the year is not hourly."""
    hours = np.round(year.time_s / 3600.0).astype(np.int64)
    day_starts = np.flatnonzero(hours % DAY_H == hours[0] % DAY_H)
    day_starts = day_starts[day_starts + DAY_H <= len(hours)]
    day_starts = day_starts[hours[day_starts + DAY_H - 1] - hours[day_starts] == DAY_H - 1]
    indices = day_starts[:, None] + np.arange(DAY_H)
    indices = indices[year.known[indices].all(axis=1)]
    assert year.relative_humidity is not None, "a test profile needs the humidity"
    member_indices = np.asarray(members)
    courses = (
        year.temperature_K[member_indices] - ZERO_CELSIUS_K,
        100.0 * year.relative_humidity[member_indices],
    )
    return np.stack([course[:, indices].reshape(-1, DAY_H) for course in courses])


def thinned(days: Days) -> Days:
    """Return at most `MOST_DAYS` days, evenly spread over all."""
    count = days.shape[1]
    if count <= MOST_DAYS:
        return days
    return days.take(np.linspace(0, count - 1, MOST_DAYS).round().astype(int), axis=1)


def places_in(celsius: np.ndarray, percent: np.ndarray) -> np.ndarray:
    """Return the bin of each instant in the flattened joint distribution, in any shape."""
    temperature_bin = np.clip(np.searchsorted(T_EDGES, celsius, side="right") - 1, 0, len(T_EDGES) - 2)
    humidity_bin = np.clip(np.searchsorted(H_EDGES, percent, side="right") - 1, 0, len(H_EDGES) - 2)
    return temperature_bin * (len(H_EDGES) - 1) + humidity_bin


def shares(days: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Return the shares (B,) of the instants (or of a weight) in the bins of the joint distribution."""
    bins = (len(T_EDGES) - 1) * (len(H_EDGES) - 1)
    weights = None if weight is None else np.ravel(weight)
    sums = np.bincount(places_in(*days).ravel(), weights=weights, minlength=bins).astype(float)
    return sums / sums.sum()


def choose_days(days: Days, count: int, law: Acceleration) -> np.ndarray:
    """Choose the days (count,) that together come closest to the features of all; returns their indices. A
    day is repeated only if there are too few."""
    features, target = _features(days, law)
    count = max(1, count)
    times_used, most_uses = np.zeros(len(features), dtype=int), -(-count // len(features))
    squares = np.einsum("df,df->d", features, features)
    chosen: list[int] = []
    feature_sum = np.zeros(features.shape[1])

    def best(wanted_sum: np.ndarray) -> int:
        cost = squares + 2.0 * features @ (feature_sum - wanted_sum)
        return int(np.argmin(np.where(times_used < most_uses, cost, np.inf)))

    for number in range(1, count + 1):
        # at each length the days so far shall be like the whole
        day = best(number * target)
        chosen.append(day)
        times_used[day] += 1
        feature_sum += features[day]
    for _ in range(MOST_EXCHANGES):
        has_changed = False
        for slot, old_day in enumerate(chosen):
            feature_sum -= features[old_day]
            times_used[old_day] -= 1
            new_day = best(count * target)
            times_used[new_day] += 1
            feature_sum += features[new_day]
            has_changed |= new_day != old_day
            chosen[slot] = new_day
        if not has_changed:
            break
    return np.array(chosen)


def _features(days: Days, law: Acceleration) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted features (D, F) of every day, and their means (F,), which are the targets."""
    celsius, percent = days
    bins = (len(T_EDGES) - 1) * (len(H_EDGES) - 1)
    bin_of_hour = places_in(celsius, percent)
    used_bins = np.unique(bin_of_hour)
    column = np.zeros(bins, dtype=int)
    column[used_bins] = np.arange(len(used_bins))
    positions = (np.arange(len(celsius))[:, None] * len(used_bins) + column[bin_of_hour]).ravel()
    ageing_rate = _rate(law, celsius, percent)
    ageing_rate = ageing_rate / ageing_rate.mean()
    cells = len(celsius) * len(used_bins)
    joint = np.bincount(positions, minlength=cells).reshape(len(celsius), -1) / DAY_H
    ageing = (
        np.bincount(positions, weights=ageing_rate.ravel(), minlength=cells).reshape(len(celsius), -1) / DAY_H
    )
    wet = ((percent > 80.0) & (celsius > 0.0)).mean(axis=1, keepdims=True)
    daily_range = np.ptp(celsius, axis=1)
    range_class = (
        np.searchsorted(RANGE_EDGES_K, daily_range, side="right")[:, None] == np.arange(1, len(RANGE_EDGES_K))
    ).astype(float)
    blocks = {
        "joint": joint, "ageing": ageing, "mean": ageing_rate.mean(axis=1, keepdims=True), "wet": wet,
        "range": range_class
    }  # fmt: skip
    features = np.hstack([np.sqrt(WEIGHTS[name]) * block for name, block in blocks.items()])
    return features, features.mean(axis=0)


def ordered(days: Days) -> np.ndarray:
    """Return an order (D,) of days in which each day begins close to the end of the day before: by nearest
    neighbours, then by moving single days."""
    first_hours, last_hours = (days[:, :, hour].T / (5.0, 10.0) for hour in (0, -1))
    jumps = np.linalg.norm(last_hours[:, None] - first_hours[None], axis=2)
    order = [int(np.argmin(days[0].mean(axis=1)))]
    remaining = set(range(days.shape[1])) - set(order)
    while remaining:
        nearest = min(remaining, key=lambda day: (jumps[order[-1], day], day))
        order.append(nearest)
        remaining.remove(nearest)

    # then move single days to where they fit better; a piece of several days cannot be turned round
    for _ in range(4):
        has_moved = False
        for day in list(order):
            position = order.index(day)
            neighbours = order[max(position - 1, 0) : position + 2]
            gain = _length(jumps, neighbours) - _length(
                jumps, [other for other in neighbours if other != day]
            )
            others = order[:position] + order[position + 1 :]
            costs = [
                _length(jumps, [others[new_position - 1], day, *others[new_position : new_position + 1]])
                - _length(jumps, others[new_position - 1 : new_position + 1])
                for new_position in range(1, len(others) + 1)
            ]
            new_position = int(np.argmin(costs)) + 1 if costs else 0
            if costs and position > 0 and costs[new_position - 1] < gain - 1e-9:
                order = [*others[:new_position], day, *others[new_position:]]
                has_moved = True
        if not has_moved:
            break
    return np.array(order)


def _length(jumps: np.ndarray, days: Sequence[int]) -> float:
    """Return the sum of the jumps between successive days."""
    return float(sum(jumps[day, next_day] for day, next_day in itertools.pairwise(days)))


CUT_MOST = 0.5
"""[1] largest share of the hours at the chamber's highest temperature."""


@dataclass(frozen=True)
class Ageing:
    """The ageing [h at the reference condition] of the test and of the years of service; and the years at the
    site that the test stands for, with bounds."""

    test_h: float
    service_h: float
    years: float
    years_lower: float
    years_upper: float


@dataclass(frozen=True)
class Reproduced:
    """A number of the site, and the same number of the test."""

    name: Statement
    site: float
    test: float


@dataclass(frozen=True)
class Closeness:
    """What a test profile reproduces of the site, and how closely.

    The distances [1] are total variations between distributions: `joint_distance` of temperature before
    warming and humidity, `ageing_distance` of the ageing over them.
    """

    ageing: Ageing
    joint_distance: float
    ageing_distance: float
    numbers: tuple[Reproduced, ...] = ()


@dataclass(frozen=True, eq=False)
class ChamberProfile:
    """The set points of a chamber, hour by hour, and what they reproduce of the site.

    Temperature [°C] and relative humidity [%] of the chamber, and of the site in the same hours;
    `acceleration`: exp(E_a δ/k_B) [1] before the chamber's limits apply; `share_at_chamber_limit`: share of
    the hours [1]; `reached`: whether the test ages as much as the years of service.
    """

    temperature_degC: np.ndarray
    relative_humidity_percent: np.ndarray
    site_temperature_degC: np.ndarray
    site_humidity_percent: np.ndarray
    acceleration: float
    share_at_chamber_limit: float
    reached: bool
    closeness: Closeness

    def __post_init__(self) -> None:
        expect_shape(
            self.temperature_degC.shape,
            {name: var for name, var in vars(self).items() if isinstance(var, np.ndarray)},
        )


def build_profile(
    days: Days, plan: ProfilePlan, ageing: BoundedMean, service_cycles: np.ndarray
) -> ChamberProfile:
    """Make a test profile from all days of a climate, at least one.

    ageing: [h a year at the reference] of the site. service_cycles: (3,) cycles a year at the site from each
        of `CYCLE_RANGES_K` on.
    """
    length_h, target_h = round(plan.test.length_h), plan.test.service_years * ageing.value
    chosen = days.take(choose_days(days, -(-length_h // DAY_H), plan.law), axis=1)
    site = chosen.take(ordered(chosen), axis=1).reshape(2, -1)[:, :length_h]

    def ageing_of_shift(shift: float) -> float:
        return float(_rate(plan.law, *set_points(site, shift, plan.chamber)).sum())

    low, high = _span(site[0], plan.chamber)
    reached = ageing_of_shift(low) <= target_h <= ageing_of_shift(high)
    shift = high if target_h > ageing_of_shift(high) else low
    if reached:
        for _ in range(60):
            shift = 0.5 * (low + high)
            low, high = (shift, high) if ageing_of_shift(shift) < target_h else (low, shift)
    test = set_points(site, shift, plan.chamber)
    is_at_limit = np.isclose(test[0][:, None], plan.chamber.temperature_degC).any(axis=1)
    temperature, humidity, site_temperature, site_humidity = (
        np.round(course, 2) for course in (*test, *site)
    )
    return ChamberProfile(
        temperature,
        humidity,
        site_temperature,
        site_humidity,
        acceleration=float(np.exp(plan.law.activation_energy_eV / BOLTZMANN_EV * shift)),
        share_at_chamber_limit=float(is_at_limit.mean()),
        reached=reached,
        closeness=closeness(days, site, test, plan, ageing, service_cycles),
    )


def _span(celsius: np.ndarray, chamber: Chamber) -> tuple[float, float]:
    """Return the smallest and the largest shift δ [1/K] to try: those that bring the median hour to the
    chamber's lowest and highest temperature."""
    kelvin = np.sort(celsius) + ZERO_CELSIUS_K
    lowest, highest = (limit + ZERO_CELSIUS_K for limit in chamber.temperature_degC)
    index = int((1.0 - CUT_MOST) * (len(kelvin) - 1))
    return 1.0 / kelvin[index] - 1.0 / max(lowest, 1.0), 1.0 / kelvin[index] - 1.0 / highest


def set_points(site: np.ndarray, shift: float, chamber: Chamber) -> np.ndarray:
    """Return temperature [°C] and humidity [%] (2, n) after the shift δ [1/K], within the limits and ramps of
    the chamber."""
    celsius, percent = site
    inverse_temperature = np.maximum(
        1.0 / (celsius + ZERO_CELSIUS_K) - shift, 1.0 / (chamber.temperature_degC[1] + ZERO_CELSIUS_K)
    )
    temperature = np.clip(1.0 / inverse_temperature - ZERO_CELSIUS_K, *chamber.temperature_degC)
    humidity = np.clip(percent, *chamber.relative_humidity_percent)
    ramps = (chamber.temperature_ramp_K_per_h, chamber.humidity_ramp_percent_per_h)
    return np.stack(
        [_ramped(course, ramp) for course, ramp in zip((temperature, humidity), ramps, strict=True)]
    )


def _ramped(values: np.ndarray, largest_change: float) -> np.ndarray:
    """Follow values (n,) with at most `largest_change` from one to the next."""
    if not len(values) or np.abs(np.diff(values)).max(initial=0.0) <= largest_change:
        return values
    course = [float(values[0])]
    for value in values[1:].tolist():
        course.append(min(max(value, course[-1] - largest_change), course[-1] + largest_change))
    return np.array(course)


def _rate(law: Acceleration, celsius: np.ndarray, percent: np.ndarray) -> np.ndarray:
    """Return the rate of ageing at temperatures [°C] and relative humidities [%]."""
    return law.rate(celsius + ZERO_CELSIUS_K, percent / 100.0)


def closeness(
    days: Days,
    site: np.ndarray,
    test: np.ndarray,
    plan: ProfilePlan,
    ageing: BoundedMean,
    service_cycles: np.ndarray,
) -> Closeness:
    """Return what a test profile reproduces of the site, and how closely.

    days, ageing, service_cycles: as for `build_profile`. site, test: (2, n) temperatures [°C] and humidities
        [%] of the chosen days before warming, and of the test.
    """
    site_rate, test_rate = (_rate(plan.law, *climate) for climate in (days, test))
    test_ageing, service_years = float(test_rate.sum()), plan.test.service_years
    years = [
        test_ageing / max(a_year, 1e-300)
        for a_year in (ageing.value, ageing.mean_upper, ageing.mean_lower)  # many years: their mean
    ]
    is_wet, is_wet_in_test = (percent > WET_PERCENT for _, percent in (days, test))
    numbers = [
        (ClimateCode.WET_HOURS(percent=WET_PERCENT), 100.0 * is_wet.mean(), 100.0 * is_wet_in_test.mean()),
        (
            ClimateCode.WET_AGEING(percent=WET_PERCENT),
            100.0 * site_rate[is_wet].sum() / site_rate.sum(),
            100.0 * test_rate[is_wet_in_test].sum() / test_rate.sum(),
        ),
        (ClimateCode.MEAN_HUMIDITY(), days[1].mean(), test[1].mean()),
    ]
    cycles = (cycles_from(site[0]) * (YEAR_H / len(site[0])), cycles_from(test[0]))
    for range_K, a_year, before, tested in zip(CYCLE_RANGES_K, service_cycles, *cycles, strict=True):
        numbers.append((ClimateCode.CYCLES_BEFORE_WARMING(range_K=float(range_K)), a_year, before))
        in_service = service_years * a_year
        numbers.append((ClimateCode.CYCLES_IN_SERVICE(range_K=float(range_K)), in_service, tested))
    return Closeness(
        Ageing(test_ageing, service_years * ageing.value, *years),
        _distance(shares(site), shares(days)),
        _distance(shares(site, test_rate), shares(days, site_rate)),
        tuple(Reproduced(name, float(at_site), float(in_test)) for name, at_site, in_test in numbers),
    )


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the total variation distance of two distributions (B,): 0 for equal ones, 1 if they have nothing
    in common."""
    return float(0.5 * np.abs(a - b).sum())
