"""`climate_profile`: from a fit and the weather of regions to the climate in the cabinet, with bounds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.climate.bounds import LEVEL, Bounded, held
from hygrokf.climate.chamber import ProfilePlan
from hygrokf.climate.ensemble import Year, draw_members, shots_of, simulate_years
from hygrokf.climate.jump_noise import Shots, shot_words
from hygrokf.climate.limits import Limit, expect_names, judge_limit
from hygrokf.climate.power import PowerCurve
from hygrokf.climate.region import Region, driven
from hygrokf.climate.statements import (
    extrapolation_words,
    interval_words,
    limit_words,
    member_words,
    operating_words,
    saturation_words,
    weather_words,
)
from hygrokf.climate.statistics import SCOPES, scalars, wetness_class
from hygrokf.climate.study import RegionClimate, Study, YearSpan
from hygrokf.climate.years import Gathered, is_whole, summary
from hygrokf.data.progress import Progress, reporting
from hygrokf.data.record import Record
from hygrokf.data.timestamps import stamp_text
from hygrokf.identification.fit import Fit
from hygrokf.identification.verdict import inherited
from hygrokf.identification.verdict_terms import rests_on
from hygrokf.physics.cold_surface import Surface
from hygrokf.version import __version__

MEMBERS = 50
STANDSTILL_YEAR = "standstill_all_year"
NO_PROFILE = "there is no test profile: it needs humidity, and weather known hour by hour for whole days"


def climate_profile(
    fit: Fit,
    regions: Sequence[Region],
    power: Record | PowerCurve | None = None,
    *,
    limits: Sequence[Limit] = (),
    plan: ProfilePlan | None = None,
    members: int = MEMBERS,
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
    with bounds.  Of several years those with less than `WHOLE` of their hours known are left out.
    Raises ValueError without regions and for fewer than two members, and PowerFault where weather and power
    do not suffice for the model.
    """
    if not regions:
        raise ValueError("expected the weather of at least one region, found none")
    if members < 2:
        raise ValueError(f"an ensemble has at least 2 members, found {members}")
    expect_names(limits)
    plan, surface = plan or ProfilePlan(), surface or Surface()
    drawn = draw_members(fit, members, seed)
    found = []
    with reporting(progress, "climate_profile") as say:
        for one in regions:
            ensemble = _Ensemble(fit, drawn, seed, surface, say, one.name)
            try:
                found.append(_region(ensemble, one, power, limits, plan))
            except ValueError as fault:
                files = f" ({', '.join(one.files)})" if one.files else ""
                raise ValueError(f"{one.name}{files}: {fault}") from fault
    return Study(
        name=fit.name,
        version=__version__,
        members=members,
        seed=seed,
        level=LEVEL,
        verdicts=inherited(fit.results),
        surface=surface,
        plan=plan,
        synthetic=fit.results.synthetic,
        regions=tuple(found),
    )


@dataclass(frozen=True)
class _Ensemble:
    """A fit and the members drawn from it; `region` is named in the messages to `say`."""

    fit: Fit
    members: Sequence[Mapping[str, float]]
    seed: int
    surface: Surface
    say: Progress
    region: str

    def years(self, record: Record, rare: Sequence[Shots], where: str = "") -> Iterator[Year]:
        """The simulated years; `where` is added to the region's name in messages."""
        name = f"{self.region}{where}"
        return simulate_years(
            self.fit, record, self.members, self.seed, self.surface, rare=rare,
            say=lambda text: self.say(f"{name}: {text}"),
        )  # fmt: skip


def _region(
    ensemble: _Ensemble,
    region: Region,
    power: Record | PowerCurve | None,
    limits: Sequence[Limit],
    plan: ProfilePlan,
) -> RegionClimate:
    fit, members = ensemble.fit, len(ensemble.members)
    record, statements = driven(fit, region.weather, power)
    rare = shots_of(fit, record)
    statements += shot_words(rare)
    whole, part, count = Gathered(), Gathered(), 0
    for year in ensemble.years(record, rare):
        count += 1
        if year.known.any():
            (whole if is_whole(year) else part).add(year, limits, plan.law, members)
    gathered = whole if whole.spans else part
    if not gathered.spans:
        raise ValueError(
            "weather and power are never known at the same instant; check the files and their spans"
        )
    operates = power is not None and fit.design.power_scale_W is not None
    scopes = {scope: summary(gathered.scalars[scope]) for scope in SCOPES if gathered.has(scope)}
    if operates:
        statements += operating_words(gathered, isinstance(power, PowerCurve))
    statements += [
        *filter(None, [rests_on(inherited(fit.results))]),
        *extrapolation_words(fit, record),
        *region.weather.warnings,
        *interval_words(region.weather),
        *weather_words(gathered, count),
        *member_words(members, len(gathered.spans)),
        *limit_words(limits, gathered),
        *saturation_words(scopes["all"]),
    ]
    if operates:
        scopes[STANDSTILL_YEAR] = _standstill(ensemble, region, rare, plan)
    ensemble.say(f"{region.name}: test profile")
    profile = gathered.test_profile(plan)
    if profile is None:
        statements.append(NO_PROFILE)
    wet = scopes["all"].get("wetness_h")
    return RegionClimate(
        name=region.name,
        files=tuple(region.files),
        synthetic=any("synthetic" in s.source for s in region.weather.series),
        statements=tuple(statements),
        part_of_year=gathered.part,
        bounds_hold=held(members * len(gathered.spans)),
        mean_bounds_hold=held(members),
        years=tuple(
            YearSpan(one.hours, one.operating, stamp_text(one.begin_s), stamp_text(one.end_s))
            for one in gathered.spans
        ),
        wetness_class=None if wet is None else wetness_class(wet.value),
        wetness_class_bounds=None if wet is None else (wetness_class(wet.lower), wetness_class(wet.upper)),
        scopes={
            scope: {name: one.rounded() for name, one in numbers.items()} for scope, numbers in scopes.items()
        },
        outside=gathered.outside(),
        duration=gathered.duration_curves("duration"),
        rates=gathered.duration_curves("rates"),
        joint=gathered.joint(),
        limits=tuple(
            judge_limit(one, gathered.limits[one.name], gathered.part)
            for one in limits
            if one.name in gathered.limits
        ),
        test_profile=profile,
    )


def _standstill(
    ensemble: _Ensemble, region: Region, rare: Sequence[Shots], plan: ProfilePlan
) -> dict[str, Bounded]:
    """The numbers of the years if the turbine stood still all the time."""
    record, _ = driven(ensemble.fit, region.weather, None)
    rows: dict[bool, list[dict[str, np.ndarray]]] = {True: [], False: []}
    for year in ensemble.years(record, rare, " at standstill"):
        if year.known.any():
            rows[is_whole(year)].append(scalars(year, plan.law))
    return summary(rows[True] or rows[False])
