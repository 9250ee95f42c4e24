"""`climate_profile`: the climate in a fitted cabinet under the weather of regions, with bounds. The years of
an ensemble are simulated one after the other, and each is reduced to numbers, curves, days, and hours beyond
limits.

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
"""Number of members of each year whose days a test profile may choose from."""
SHARES = (0.0, 0.001, 0.01, 0.02, 0.05, *np.arange(0.1, 0.91, 0.05).round(2), 0.95, 0.98, 0.99, 0.999, 1.0)
"""Shares of the time [1] at which a duration curve is given."""
RATE_QUANTITIES = {"temperature_degC": "temperature", "relative_humidity_percent": "relative_humidity"}
"""Quantities whose rates of change have a duration curve, with their keys in climate.json."""
TEMPERATURE_EDGES = np.arange(-60.0, 120.1, 2.5)
HUMIDITY_EDGES = np.arange(0.0, 100.1, 5.0)
"""Edges of the joint distribution [°C], [%]; the last bin also counts what is above saturation."""


Reduced: TypeAlias = Mapping[tuple[str, str], np.ndarray]
"""The numbers of a year for every member (N, …), by two keys: (scope, name): a number of `STATISTICS`;
("duration", quantity) and ("rates", quantity): values exceeded for `SHARES` of the time; ("joint", "hours"):
joint distribution [h a year]; ("limit", name): exceedances of a limit.  Keys of a quantity that the model
lacks are absent."""


def reduced(year: Year, law: Acceleration, limits: Sequence[ClimateLimit] = ()) -> Reduced:
    """Reduce a year to its numbers and curves."""
    quantities, levels = courses(year), 1.0 - np.array(SHARES)
    numbers = {
        (scope, name): scalar for scope in SCOPES for name, scalar in scalars(year, law, scope).items()
    }
    for name, value in quantities.items():
        numbers["duration", name] = np.quantile(value[:, year.known], levels, axis=1).T
    for name, key in RATE_QUANTITIES.items():
        if name in quantities:
            numbers["rates", key] = np.quantile(rates(quantities[name], year), levels, axis=1).T
    if (percent := quantities.get("relative_humidity_percent")) is not None:
        celsius = quantities["temperature_degC"]
        numbers["joint", "hours"] = _joint_hours(celsius[:, year.known], percent[:, year.known])
    return numbers | {
        ("limit", limit.name): exceedances
        for limit in limits
        if (exceedances := exceeded(year, limit)) is not None
    }


def _joint_hours(celsius: np.ndarray, percent: np.ndarray) -> np.ndarray:
    """The hours a year (N, I, J) of every member in the bins of `TEMPERATURE_EDGES` and `HUMIDITY_EDGES`."""
    rows, columns = len(TEMPERATURE_EDGES) - 1, len(HUMIDITY_EDGES) - 1
    temperature_bin = np.clip(np.searchsorted(TEMPERATURE_EDGES, celsius, side="right") - 1, 0, rows - 1)
    humidity_bin = np.clip(np.searchsorted(HUMIDITY_EDGES, percent, side="right") - 1, 0, columns - 1)
    member = np.arange(len(celsius))[:, None]
    bin_numbers = ((member * rows + temperature_bin) * columns + humidity_bin).ravel()
    counts = np.bincount(bin_numbers, minlength=len(celsius) * rows * columns)
    return counts.reshape(-1, rows, columns) * (YEAR_H / celsius.shape[1])


@dataclass
class Gathered:
    """The reduced years of one ensemble: each list has one entry for each year."""

    cabinet: list[Reduced] = field(default_factory=list)
    weather: list[Reduced] = field(default_factory=list)
    days: list[Days] = field(default_factory=list)
    spans: list[YearSpan] = field(default_factory=list)

    def of(self, kind: str) -> dict[str, np.ndarray]:
        """Return the cabinet's arrays of one kind (first key) by name, with all years (years, N, …)."""
        names = (name for kind_of_key, name in self.cabinet[0] if kind_of_key == kind)
        return {name: np.array([year[kind, name] for year in self.cabinet]) for name in names}

    def outside(self, kind: str) -> dict[str, np.ndarray]:
        """Return the weather's arrays of one kind by name, as the mean over the years."""
        names = (name for kind_of_key, name in self.weather[0] if kind_of_key == kind)
        return {name: np.mean([year[kind, name][0] for year in self.weather], axis=0) for name in names}

    @property
    def part(self) -> Statement | None:
        """The length of the fullest year, such as 80 days; None if this year can stand for a whole one."""
        fullest = max(self.spans, key=lambda span: span.hours_known)
        if fullest.hours_known >= WHOLE_SHARE * YEAR_H:
            return None
        covered = fullest.hours_covered
        return _length(covered if covered < WHOLE_SHARE * YEAR_H else fullest.hours_known)

    def has(self, scope: str) -> bool:
        """Return whether any hour of any year belongs to a scope."""
        return any(year[scope, "hours"].max() > 0.0 for year in self.cabinet)

    def add(self, year: Year, limits: Sequence[ClimateLimit], law: Acceleration, members: int) -> None:
        """Reduce one more year and append it; members: number of members of the ensemble."""
        # a year without operation has 0 h of it, and counts among the others
        self.cabinet.append(reduced(year, law, limits))
        self.weather.append(reduced(outside(year), law))
        if year.relative_humidity is not None and abs(year.step_h - 1.0) < 1e-6:
            # each year contributes other members, so that the days show the differences between members
            first_member = len(self.days) * DAYS_OF
            chosen_members = sorted(
                {(first_member + offset) % members for offset in range(min(DAYS_OF, members))}
            )
            self.days.append(thinned(days_of(year, chosen_members)))
        ends = (stamp_text(year.time_s[index]) for index in (0, -1))
        self.spans.append(YearSpan(year.hours, float(year.operating[year.known].mean()), *ends))

    def duration_curves(self, kind: Literal["duration", "rates"]) -> dict[str, DurationCurve]:
        """Return the duration curves by quantity, with bounds."""
        weather = self.outside(kind)
        curves = {}
        for name, values in self.of(kind).items():
            bounded_values = bounded_array(values)
            fields = {
                field_name: rounded(bounded_values[field_name]) for field_name in ("value", "lower", "upper")
            }
            curves[name] = DurationCurve(np.array(SHARES), **fields, outside=rounded(weather[name]))
        return curves

    def joint(self) -> JointDistribution | None:
        """Return the joint distribution without empty rows; None without humidity."""
        if "hours" not in (by_name := self.of("joint")):
            return None
        cabinet, weather = bounded_array(by_name["hours"]), self.outside("joint")["hours"]
        used_rows = np.flatnonzero((cabinet["value"] > 0).any(axis=1) | (weather > 0).any(axis=1))
        rows = slice(int(used_rows[0]), int(used_rows[-1]) + 1)
        hours = (cabinet["value"], cabinet["lower"], cabinet["upper"], weather)
        return JointDistribution(
            TEMPERATURE_EDGES[rows.start : rows.stop + 1],
            HUMIDITY_EDGES,
            *(rounded(values[rows], 4) for values in hours),
        )

    def test_profile(self, plan: ProfilePlan) -> ChamberProfile | None:
        """Return the test profile; None if no day is known hour by hour with its humidity."""
        days = thinned(np.concatenate(self.days, axis=1)) if self.days else None
        if days is None or not days.shape[1]:
            return None
        numbers = self.of("all")
        cycles = [
            numbers[f"temperature_cycles_from_{smallest_range:g}_K_number"]
            for smallest_range in CYCLE_RANGES_K
        ]
        mean_cycles = np.array(
            [np.mean([year.mean() for year in cycles_of_range]) for cycles_of_range in cycles]
        )
        return build_profile(days, plan, bounded(numbers["ageing_h"]), mean_cycles)


def _length(hours: float) -> Statement:
    """Return the statement of a length of time, in days or hours."""
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
    """Simulate the climate in a fitted cabinet under the weather of regions.

    fit: of `identify` or `read_fit`.
    regions: name and weather of each place.
    power: a record with active power, a power curve for the weather's wind, or None for standstill all year.
    limits: of a specification.
    plan: of a test profile, with its law of ageing.
    members: size of the ensemble, at least 2.
    seed: of the random parameters and disturbances.
    surface: the coldest one in the cabinet.
    progress: called with each step in words; True: shows the steps as one line.

    Returns hours, temperatures [°C], relative [%] and absolute humidities [g/m³] of a year by region and
    scope, with bounds. If there are several years, those with less than `WHOLE_SHARE` of their hours known
    are left out. Raises ValueError without regions or for fewer than two members, PowerFault if weather and
    power do not suffice for the model.
    """
    if not regions:
        raise ValueError("expected the weather of at least one region, found none")
    if members < 2:
        raise ValueError(f"an ensemble has at least 2 members, found {members}")
    limits = [limit.named() for limit in limits]
    if faults := duplicate_name_faults(limits):
        raise ValueError("; ".join(faults))
    plan, surface = plan or ProfilePlan(), surface or Surface()
    parameter_sets = draw_members(fit, members, seed)

    def simulate(design: Design, run: Run, rare: Sequence[Shots], report_year: Progress) -> Iterator[Year]:
        return simulate_years(fit, design, run, parameter_sets, seed, surface, rare=rare, say=report_year)

    climates = []
    with reporting(progress, "climate_profile") as say:
        for region in regions:
            try:
                climates.append(_region(fit, region, power, limits, plan, simulate, members, say))
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
        regions=tuple(climates),
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
    """Simulate the climate of one region."""
    record, statements = driven(fit, region.weather, power)
    design, run = course(fit, record)
    shots = shots_of(fit, design, run)
    statements += shot_statements(shots)
    years = simulate(design, run, shots, lambda text: say(f"{region.name}: {text}"))
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
        record_at_standstill, _ = driven(fit, region.weather, None)
        years = simulate(
            *course(fit, record_at_standstill),
            shots,
            lambda text: say(f"{region.name} at standstill: {text}"),
        )
        scopes[STANDSTILL_YEAR] = _bounded(_gathered(years, (), plan.law, members)[0].of("all"))
    say(f"{region.name}: test profile")
    profile = gathered.test_profile(plan)
    if profile is None:
        statements.append(ClimateCode.NO_PROFILE())
    wetness, exceedances = scopes["all"].get("wetness_h"), gathered.of("limit")
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
        wetness_class=None if wetness is None else wetness_class(wetness.value),
        wetness_class_bounds=None
        if wetness is None
        else (wetness_class(wetness.lower), wetness_class(wetness.upper)),
        scopes={
            scope: {name: number.rounded() for name, number in numbers.items()}
            for scope, numbers in scopes.items()
        },
        outside={name: float(value) for name, value in gathered.outside("all").items()},
        duration=gathered.duration_curves("duration"),
        rates=gathered.duration_curves("rates"),
        joint=gathered.joint(),
        limits=tuple(
            judge_limit(limit, exceedances[limit.name], gathered.part)
            for limit in limits
            if limit.name in exceedances
        ),
        test_profile=profile,
    )


def _gathered(
    years: Iterator[Year], limits: Sequence[ClimateLimit], law: Acceleration, members: int
) -> tuple[Gathered, int]:
    """Reduce years; returns those known well enough to stand for whole years (if there is none, all parts of
    years), and the number of all years."""
    whole_years, parts_of_years, count = Gathered(), Gathered(), 0
    for year in years:
        count += 1
        if year.known.any():
            (whole_years if year.hours >= WHOLE_SHARE * YEAR_H else parts_of_years).add(
                year, limits, law, members
            )
    return (whole_years if whole_years.spans else parts_of_years), count


def _bounded(numbers: Mapping[str, np.ndarray]) -> dict[str, BoundedMean]:
    """Return the bounds of each number from its values (years, N)."""
    return {name: bounded(values) for name, values in numbers.items()}


FEWEST_MEMBERS = 39
"""Smallest number of members of which the smallest and the largest one are 95 % bounds."""
DRIPPING_H = 24.0
"""[h/a] with more hours above saturation, the model evidently lacks condensation or storage of moisture."""
LEAST_OPERATION = 0.3
"""[1] with a smaller share of the time in operation, power or wind are doubted."""
BEYOND_K = 2.0
BEYOND_SHARE = 0.1
"""Margin beyond the identified range: of a temperature [K], of other inputs as a share of the range [1]."""
SAID_FROM = 0.01
"""[1] smallest share of the time outside the identified range that is stated."""


def weather_statements(
    weather: Record, gathered: Gathered, years: int, members: int, limits: Sequence[ClimateLimit]
) -> list[Statement]:
    """Return statements on the weather, on years left out of all `years`, on too few members for the stated
    bounds, on limits that cannot be judged, and on air above saturation."""
    hours_known, count = sum(span.hours_known for span in gathered.spans), len(gathered.spans)
    hours_covered, part = sum(span.hours_covered for span in gathered.spans), gathered.part
    share = held(members * count)
    steps = [
        (middle(series.steps_s) / 3600.0, series.signal)
        for series in weather.series
        if series.signal.startswith("ambient_") and len(series.steps_s)
    ]
    step_h, signal = max(steps, default=(0.0, ""))
    numbers = gathered.of("all")
    dripping_h = float(numbers["saturation_h"].mean()) if "saturation_h" in numbers else 0.0
    statements = []
    if step_h > 1.01:
        code = ClimateCode.WEATHER_WITHOUT_DAYS if step_h >= 12.0 else ClimateCode.WEATHER_RARE
        statements.append(code(signal=signal, step_h=step_h))
    if count < years:
        statements.append(ClimateCode.YEARS_LEFT_OUT(left_out=years - count, years=years, share=WHOLE_SHARE))
    if count == 1:
        statement = (
            ClimateCode.BOUNDS_OF_ONE_YEAR() if part is None else ClimateCode.BOUNDS_OF_A_PART(part=part)
        )
        statements.append(statement)
    if hours_covered < 0.95 * YEAR_H * count:
        statements.append(ClimateCode.SCALED_UP(length=_length(hours_covered), years=in_years(count)))
    if part is not None:
        statements.append(ClimateCode.NO_LIMIT_PASSES(part=part))
    if hours_known < 0.98 * hours_covered:
        statements.append(ClimateCode.INPUTS_UNKNOWN(share=1.0 - hours_known / hours_covered))
    if share < CONFIDENCE:
        statement_on_members = ClimateCode.FEW_MEMBERS(
            members=members, share=share, level=CONFIDENCE, fewest=FEWEST_MEMBERS
        )
        statements.append(statement_on_members)
    statements += [text for limit in limits for text in _limit_statements(limit, gathered)]
    if dripping_h >= DRIPPING_H:
        statements.append(ClimateCode.AIR_ABOVE_SATURATION(hours=dripping_h))
    return statements


def _limit_statements(limit: ClimateLimit, gathered: Gathered) -> list[Statement]:
    """Return a statement if a limit cannot be judged, or is kept only because its scope has no hours."""
    if limit.name not in gathered.of("limit"):
        return [ClimateCode.LIMIT_NOT_JUDGED(limit=limit.name, quantity=limit.quantity_words)]
    if gathered.has(limit.during):
        return []
    is_standstill = limit.during == "standstill"
    regime = ClimateCode.AT_STANDSTILL() if is_standstill else ClimateCode.IN_OPERATION()
    is_whole_year = gathered.part is None
    code = ClimateCode.PASSES_WITHOUT_HOURS if is_whole_year else ClimateCode.KEPT_WITHOUT_HOURS
    return [code(limit=limit.name, regime=regime)]


def operating_statement(gathered: Gathered, by_curve: bool) -> Statement:
    """Return the share of the time in operation, with a doubt if it is small."""
    shares, hours = zip(*((span.operating_share, span.hours_known) for span in gathered.spans), strict=True)
    share = float(np.average(shares, weights=hours))
    if share >= LEAST_OPERATION:
        return ClimateCode.OPERATES(share=share)
    code = ClimateCode.OPERATES_LITTLE_BY_CURVE if by_curve else ClimateCode.OPERATES_LITTLE
    return code(share=share)


def extrapolation_statements(fit: Fit, run: Run) -> list[Statement]:
    """Return statements on the hours of weather and power outside the range on which a fit was identified;
    empty for a fit that states no range."""
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
        margin = BEYOND_K if name == "ambient_temperature" else BEYOND_SHARE * (high - low)
        value = run.timeline.input(name)[run.scored]
        is_outside = (value < low - margin) | (value > high + margin)
        share = float(is_outside.mean()) if len(value) else 0.0
        if share > SAID_FROM:
            code, factor, offset = units[name]
            range_ends = {
                "lower": low,
                "upper": high,
                "least": float(np.min(value)),
                "most": float(np.max(value)),
            }
            values = {end_name: factor * end + offset for end_name, end in range_ends.items()}
            statements.append(code(hours=share * YEAR_H, **values))
    return statements
