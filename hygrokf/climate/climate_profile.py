"""`climate_profile`: from a fit and the weather of regions to the climate in the cabinet, with bounds; the
years of one ensemble are reduced one after the other to numbers, curves, days and hours beyond limits.

Shapes: N members, T instants, I temperature bins, J humidity bins.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from hygrokf.climate.bounds import BoundedMean, bounded, bounded_array, held, rounded
from hygrokf.climate.chamber import Acceleration, ProfilePlan
from hygrokf.climate.chamber_profile import ChamberProfile, Days, build_profile, days_of, thinned
from hygrokf.climate.ensemble import (
    WHOLE_SHARE,
    YEAR_H,
    Shots,
    Year,
    course,
    draw_members,
    shot_statements,
    shots_of,
    simulate_years,
)
from hygrokf.climate.limits import ClimateLimit, duplicate_name_faults, exceeded, judge_limit
from hygrokf.climate.region import PowerCurve, Region, driven, in_years
from hygrokf.climate.statistics import CYCLE_RANGES_K, SCOPES, courses, outside, rates, scalars, wetness_class
from hygrokf.climate.study import DurationCurve, JointDistribution, RegionClimate, Study, YearSpan
from hygrokf.data.ambient import middle
from hygrokf.data.progress import Progress, reporting
from hygrokf.data.record import Record
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.identification.fit import Fit
from hygrokf.identification.verdict import inherited
from hygrokf.identification.verdict_terms import rests_on
from hygrokf.modelling.design import Design
from hygrokf.modelling.inputs import IDENTIFIED_ON, Run
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K, Surface
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.wording import stamp_text
from hygrokf.version import __version__

DAYS_OF = 8
"""Members of each year whose days a test profile may choose from."""
SHARES = (0.0, 0.001, 0.01, 0.02, 0.05, *np.arange(0.1, 0.91, 0.05).round(2), 0.95, 0.98, 0.99, 0.999, 1.0)
"""Shares of the time [1] at which a duration curve is given."""
RATE_QUANTITIES = {"temperature_degC": "temperature", "relative_humidity_percent": "relative_humidity"}
"""Quantities whose rates of change have a duration curve, with their keys in climate.json."""
TEMPERATURE_EDGES = np.arange(-60.0, 120.1, 2.5)
HUMIDITY_EDGES = np.arange(0.0, 100.1, 5.0)
"""Edges of the joint distribution [°C], [%]; the last bin also counts what is above saturation."""


Reduced: TypeAlias = Mapping[tuple[str, str], np.ndarray]
"""What a year is reduced to, for every member (N, …): by scope and name the numbers; by "duration" or "rates"
and quantity the values that are exceeded for `SHARES` of the time; by "joint" and "hours" the joint
distribution [h a year]; by "limit" and name what is beyond a limit.  Absent without the quantity."""


def reduced(year: Year, law: Acceleration, limits: Sequence[ClimateLimit] = ()) -> Reduced:
    """The numbers and curves of a year."""
    rows, shares = courses(year), 1.0 - np.array(SHARES)
    found = {(scope, name): scalar for scope in SCOPES for name, scalar in scalars(year, law, scope).items()}
    for name, value in rows.items():
        found["duration", name] = np.quantile(value[:, year.known], shares, axis=1).T
    for name, short in RATE_QUANTITIES.items():
        if name in rows:
            found["rates", short] = np.quantile(rates(rows[name], year), shares, axis=1).T
    if (percent := rows.get("relative_humidity_percent")) is not None:
        celsius = rows["temperature_degC"]
        found["joint", "hours"] = _joint_hours(celsius[:, year.known], percent[:, year.known])
    return found | {
        ("limit", limit.name): many for limit in limits if (many := exceeded(year, limit)) is not None
    }


def _joint_hours(celsius: np.ndarray, percent: np.ndarray) -> np.ndarray:
    """Hours a year (N, I, J) of every member in the bins of `TEMPERATURE_EDGES` and `HUMIDITY_EDGES`."""
    rows, columns = len(TEMPERATURE_EDGES) - 1, len(HUMIDITY_EDGES) - 1
    i = np.clip(np.searchsorted(TEMPERATURE_EDGES, celsius, side="right") - 1, 0, rows - 1)
    j = np.clip(np.searchsorted(HUMIDITY_EDGES, percent, side="right") - 1, 0, columns - 1)
    member = np.arange(len(celsius))[:, None]
    flat = ((member * rows + i) * columns + j).ravel()
    counted = np.bincount(flat, minlength=len(celsius) * rows * columns)
    return counted.reshape(-1, rows, columns) * (YEAR_H / celsius.shape[1])


@dataclass
class Gathered:
    """The years of one ensemble, reduced: each list has an entry for each year."""

    cabinet: list[Reduced] = field(default_factory=list)
    weather: list[Reduced] = field(default_factory=list)
    days: list[Days] = field(default_factory=list)
    spans: list[YearSpan] = field(default_factory=list)

    def of(self, kind: str) -> dict[str, np.ndarray]:
        """What the cabinet's years have of one kind, by name (years, N, …)."""
        names = (name for other, name in self.cabinet[0] if other == kind)
        return {name: np.array([year[kind, name] for year in self.cabinet]) for name in names}

    def outside(self, kind: str) -> dict[str, np.ndarray]:
        """The same of the weather: the mean of the years."""
        names = (name for other, name in self.weather[0] if other == kind)
        return {name: np.mean([year[kind, name][0] for year in self.weather], axis=0) for name in names}

    @property
    def part(self) -> Statement | None:
        """The known part of the fullest year, such as 80 days; None where it can stand for a year."""
        fullest = max(self.spans, key=lambda span: span.hours_known)
        if fullest.hours_known >= WHOLE_SHARE * YEAR_H:
            return None
        covered = fullest.hours_covered
        return _length(covered if covered < WHOLE_SHARE * YEAR_H else fullest.hours_known)

    def has(self, scope: str) -> bool:
        """Whether any hour of any year belongs to a scope."""
        return any(year[scope, "hours"].max() > 0.0 for year in self.cabinet)

    def add(self, year: Year, limits: Sequence[ClimateLimit], law: Acceleration, members: int) -> None:
        """Reduce one more year of an ensemble of so many members."""
        # a year without operation has 0 h of it, and counts among the others
        self.cabinet.append(reduced(year, law, limits))
        self.weather.append(reduced(outside(year), law))
        if year.relative_humidity is not None and abs(year.step_h - 1.0) < 1e-6:
            # each year contributes other members, so that the days show the differences between members
            first = len(self.days) * DAYS_OF
            chosen = sorted({(first + i) % members for i in range(min(DAYS_OF, members))})
            self.days.append(thinned(days_of(year, chosen)))
        ends = (stamp_text(year.time_s[place]) for place in (0, -1))
        self.spans.append(YearSpan(year.hours, float(year.operating[year.known].mean()), *ends))

    def duration_curves(self, kind: Literal["duration", "rates"]) -> dict[str, DurationCurve]:
        """The curves by quantity, with bounds."""
        weather = self.outside(kind)
        found = {}
        for name, values in self.of(kind).items():
            made = bounded_array(values)
            parts = {part: rounded(made[part]) for part in ("value", "lower", "upper")}
            found[name] = DurationCurve(np.array(SHARES), **parts, outside=rounded(weather[name]))
        return found

    def joint(self) -> JointDistribution | None:
        """The joint distribution without its empty rows; None without humidity."""
        if "hours" not in (found := self.of("joint")):
            return None
        inside, weather = bounded_array(found["hours"]), self.outside("joint")["hours"]
        used = np.flatnonzero((inside["value"] > 0).any(axis=1) | (weather > 0).any(axis=1))
        rows = slice(int(used[0]), int(used[-1]) + 1)
        hours = (inside["value"], inside["lower"], inside["upper"], weather)
        return JointDistribution(
            TEMPERATURE_EDGES[rows.start : rows.stop + 1],
            HUMIDITY_EDGES,
            *(rounded(hour[rows], 4) for hour in hours),
        )

    def test_profile(self, plan: ProfilePlan) -> ChamberProfile | None:
        """The test profile; None where no whole day with humidity is known hour by hour."""
        days = thinned(np.concatenate(self.days, axis=1)) if self.days else None
        if days is None or not days.shape[1]:
            return None
        numbers = self.of("all")
        cycles = [numbers[f"temperature_cycles_from_{least:g}_K_number"] for least in CYCLE_RANGES_K]
        means = np.array([np.mean([year.mean() for year in cycle]) for cycle in cycles])
        return build_profile(days, plan, bounded(numbers["ageing_h"]), means)


def _length(hours: float) -> Statement:
    if hours >= 48.0:
        return ClimateCode.LENGTH_IN_DAYS(days=hours / 24.0)
    return ClimateCode.LENGTH_IN_HOURS(hours=hours)


ENSEMBLE_MEMBERS = 50
STANDSTILL_YEAR = "standstill_all_year"


def climate_profile(
    fit: Fit,
    regions: Sequence[Region],
    power: Record | PowerCurve | None = None,
    *,
    limits: Sequence[ClimateLimit] = (),
    plan: ProfilePlan | None = None,
    members: int = ENSEMBLE_MEMBERS,
    seed: int = 1,
    surface: Surface | None = None,
    progress: Progress | bool | None = None,
) -> Study:
    """The climate in a fitted cabinet under the weather of regions.

    fit: of `identify` or `read_fit`.
    regions: weather of each place, as records.
    power: a record with active power, a power curve for the weather's wind, or None for standstill all year.
    limits: of a specification.
    plan: of a test profile, with its law of acceleration.
    members: of the ensemble, at least 2.
    seed: of the drawn parameters and disturbances.
    surface: the coldest one in the cabinet.
    progress: called with each step in words; True: shows them as one line.

    Returns hours, temperatures [°C], relative [%] and absolute humidities [g/m³] a year by region and scope,
    with bounds.  Of several years those with less than `WHOLE_SHARE` of their hours known are left out.
    Raises ValueError without regions and for fewer than two members, and PowerFault where weather and power
    do not suffice for the model.
    """
    if not regions:
        raise ValueError("expected the weather of at least one region, found none")
    if members < 2:
        raise ValueError(f"an ensemble has at least 2 members, found {members}")
    limits = [limit.named() for limit in limits]
    if faults := duplicate_name_faults(limits):
        raise ValueError("; ".join(faults))
    plan, surface = plan or ProfilePlan(), surface or Surface()
    drawn = draw_members(fit, members, seed)

    def simulate(design: Design, run: Run, rare: Sequence[Shots], tell: Progress) -> Iterator[Year]:
        return simulate_years(fit, design, run, drawn, seed, surface, rare=rare, say=tell)

    found = []
    with reporting(progress, "climate_profile") as say:
        for region in regions:
            try:
                found.append(_region(fit, region, power, limits, plan, simulate, members, say))
            except ValueError as fault:
                files = f" ({', '.join(region.files)})" if region.files else ""
                raise ValueError(f"{region.name}{files}: {fault}") from fault
    return Study(
        name=fit.name,
        version=__version__,
        members=members,
        seed=seed,
        level=CONFIDENCE,
        verdicts=inherited(fit.results),
        surface=surface,
        plan=plan,
        provenance=fit.results.provenance,
        regions=tuple(found),
    )


def _region(
    fit: Fit,
    region: Region,
    power: Record | PowerCurve | None,
    limits: Sequence[ClimateLimit],
    plan: ProfilePlan,
    simulate: Callable[[Design, Run, Sequence[Shots], Progress], Iterator[Year]],
    members: int,
    say: Progress,
) -> RegionClimate:
    record, statements = driven(fit, region.weather, power)
    design, run = course(fit, record)
    rare = shots_of(fit, design, run)
    statements += shot_statements(rare)
    years = simulate(design, run, rare, lambda text: say(f"{region.name}: {text}"))
    gathered, count = _gathered(years, limits, plan.law, members)
    if not gathered.spans:
        raise ValueError(
            "weather and power are never known at the same instant; check the files and their spans"
        )
    operates = power is not None and fit.design.power_scale_W is not None
    scopes = {scope: _bounded(gathered.of(scope)) for scope in SCOPES if gathered.has(scope)}
    if operates:
        statements.append(operating_statement(gathered, isinstance(power, PowerCurve)))
    statements += [
        *rests_on(inherited(fit.results)),
        *extrapolation_statements(fit, run),
        *region.statements,
        *weather_statements(region.weather, gathered, count, members, limits),
    ]
    if operates:
        still, _ = driven(fit, region.weather, None)
        years = simulate(*course(fit, still), rare, lambda text: say(f"{region.name} at standstill: {text}"))
        scopes[STANDSTILL_YEAR] = _bounded(_gathered(years, (), plan.law, members)[0].of("all"))
    say(f"{region.name}: test profile")
    profile = gathered.test_profile(plan)
    if profile is None:
        statements.append(ClimateCode.NO_PROFILE())
    wet, beyond = scopes["all"].get("wetness_h"), gathered.of("limit")
    return RegionClimate(
        name=region.name,
        files=tuple(region.files),
        provenance=region.weather.provenance,
        statements=tuple(statements),
        warnings=region.weather.warnings,
        part_of_year=gathered.part,
        bounds_hold=held(members * len(gathered.spans)),
        mean_bounds_hold=held(members),
        years=tuple(gathered.spans),
        wetness_class=None if wet is None else wetness_class(wet.value),
        wetness_class_bounds=None if wet is None else (wetness_class(wet.lower), wetness_class(wet.upper)),
        scopes={
            scope: {name: number.rounded() for name, number in numbers.items()}
            for scope, numbers in scopes.items()
        },
        outside={name: float(one) for name, one in gathered.outside("all").items()},
        duration=gathered.duration_curves("duration"),
        rates=gathered.duration_curves("rates"),
        joint=gathered.joint(),
        limits=tuple(
            judge_limit(limit, beyond[limit.name], gathered.part) for limit in limits if limit.name in beyond
        ),
        test_profile=profile,
    )


def _gathered(
    years: Iterator[Year], limits: Sequence[ClimateLimit], law: Acceleration, members: int
) -> tuple[Gathered, int]:
    """The years that are known well enough to stand for one, else the parts of years, reduced; and the number
    of all."""
    whole, part, count = Gathered(), Gathered(), 0
    for year in years:
        count += 1
        if year.known.any():
            (whole if year.hours >= WHOLE_SHARE * YEAR_H else part).add(year, limits, law, members)
    return (whole if whole.spans else part), count


def _bounded(numbers: Mapping[str, np.ndarray]) -> dict[str, BoundedMean]:
    return {name: bounded(values) for name, values in numbers.items()}


FEWEST_MEMBERS = 39
"""Members whose extremes are 95 % bounds."""
DRIPPING_H = 24.0
"""[h/a] above saturation from which the model evidently lacks condensation or storage of moisture."""
LEAST_OPERATION = 0.3
"""Share of the time in operation below which power or wind are doubted."""
BEYOND_K = 2.0
BEYOND_SHARE = 0.1
"""How far beyond the ends a temperature [K], or a share of the range of another input, counts as outside."""
SAID_FROM = 0.01
"""Share of the time outside the identified range from which a statement says so."""


def weather_statements(
    weather: Record, gathered: Gathered, found: int, members: int, limits: Sequence[ClimateLimit]
) -> list[Statement]:
    """Statements on the weather, on the years used out of `found` years, on too few members for the stated
    bounds, on limits that cannot be judged, and on air above saturation."""
    hours, count = sum(span.hours_known for span in gathered.spans), len(gathered.spans)
    length, part = sum(span.hours_covered for span in gathered.spans), gathered.part
    share = held(members * count)
    rare = [
        (middle(s.steps_s) / 3600.0, s.signal)
        for s in weather.series
        if s.signal.startswith("ambient_") and len(s.steps_s)
    ]
    step_h, name = max(rare, default=(0.0, ""))
    numbers = gathered.of("all")
    dripping_h = float(numbers["saturation_h"].mean()) if "saturation_h" in numbers else 0.0
    statements = []
    if step_h > 1.01:
        code = ClimateCode.WEATHER_WITHOUT_DAYS if step_h >= 12.0 else ClimateCode.WEATHER_RARE
        statements.append(code(signal=name, step_h=step_h))
    if count < found:
        statements.append(ClimateCode.YEARS_LEFT_OUT(left_out=found - count, years=found, share=WHOLE_SHARE))
    if count == 1:
        alone = ClimateCode.BOUNDS_OF_ONE_YEAR() if part is None else ClimateCode.BOUNDS_OF_A_PART(part=part)
        statements.append(alone)
    if length < 0.95 * YEAR_H * count:
        statements.append(ClimateCode.SCALED_UP(length=_length(length), years=in_years(count)))
    if part is not None:
        statements.append(ClimateCode.NO_LIMIT_PASSES(part=part))
    if hours < 0.98 * length:
        statements.append(ClimateCode.INPUTS_UNKNOWN(share=1.0 - hours / length))
    if share < CONFIDENCE:
        few = ClimateCode.FEW_MEMBERS(members=members, share=share, level=CONFIDENCE, fewest=FEWEST_MEMBERS)
        statements.append(few)
    statements += [text for limit in limits for text in _limit_statements(limit, gathered)]
    if dripping_h >= DRIPPING_H:
        statements.append(ClimateCode.AIR_ABOVE_SATURATION(hours=dripping_h))
    return statements


def _limit_statements(limit: ClimateLimit, gathered: Gathered) -> list[Statement]:
    """That a limit cannot be judged, or is kept for want of hours."""
    if limit.name not in gathered.of("limit"):
        return [ClimateCode.LIMIT_NOT_JUDGED(limit=limit.name, quantity=limit.quantity_words)]
    if gathered.has(limit.during):
        return []
    standing = limit.during == "standstill"
    regime = ClimateCode.AT_STANDSTILL() if standing else ClimateCode.IN_OPERATION()
    whole = gathered.part is None
    code = ClimateCode.PASSES_WITHOUT_HOURS if whole else ClimateCode.KEPT_WITHOUT_HOURS
    return [code(limit=limit.name, regime=regime)]


def operating_statement(gathered: Gathered, by_curve: bool) -> Statement:
    """The share of time in operation, with a doubt where it is low."""
    shares, hours = zip(*((span.operating_share, span.hours_known) for span in gathered.spans), strict=True)
    share = float(np.average(shares, weights=hours))
    if share >= LEAST_OPERATION:
        return ClimateCode.OPERATES(share=share)
    code = ClimateCode.OPERATES_LITTLE_BY_CURVE if by_curve else ClimateCode.OPERATES_LITTLE
    return code(share=share)


def extrapolation_statements(fit: Fit, run: Run) -> list[Statement]:
    """Statements on the hours of weather and power outside the range on which a fit was identified; none for
    a fit without a stated range."""
    ranges = fit.results.identified_on
    if not ranges:
        return []
    power_kW = (fit.design.power_scale_W or 0.0) / 1e3
    units = {  # factor and offset from the model's unit
        "ambient_temperature": (ClimateCode.EXTRAPOLATED_TEMPERATURE, 1.0, -ZERO_CELSIUS_K),
        "ambient_absolute_humidity": (ClimateCode.EXTRAPOLATED_HUMIDITY, 1.0, 0.0),
        "power_1": (ClimateCode.EXTRAPOLATED_POWER, power_kW, 0.0),
    }
    statements = []
    for name, key in IDENTIFIED_ON.items():
        if key not in ranges or name not in fit.design.model.inputs:
            continue
        low, high = ranges[key]
        beyond = BEYOND_K if name == "ambient_temperature" else BEYOND_SHARE * (high - low)
        value = run.timeline.input(name)[run.scored]
        outside = (value < low - beyond) | (value > high + beyond)
        share = float(outside.mean()) if len(value) else 0.0
        if share > SAID_FROM:
            code, factor, offset = units[name]
            ends = {"lower": low, "upper": high, "least": float(np.min(value)), "most": float(np.max(value))}
            values = {key: factor * end + offset for key, end in ends.items()}
            statements.append(code(hours=share * YEAR_H, **values))
    return statements
