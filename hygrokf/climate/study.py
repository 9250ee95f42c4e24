"""`climate_profile`: from a fit and the weather of regions to the climate in the cabinet, with bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hygrokf.climate.acceleration import Acceleration
from hygrokf.climate.bounds import LEVEL, Bounded, bounded, held
from hygrokf.climate.chamber import ProfilePlan
from hygrokf.climate.ensemble import WHOLE, YEAR_H, Year, part_text, shots_of, simulate_years
from hygrokf.climate.form import as_list
from hygrokf.climate.jump_noise import words as shot_words
from hygrokf.climate.limits import Limit, exceeded, expect_names, judged
from hygrokf.climate.parameter_samples import draw_members
from hygrokf.climate.power import PowerCurve
from hygrokf.climate.range import extrapolation_words
from hygrokf.climate.region import Region, driven
from hygrokf.climate.representative_days import Days, days_of, joined, thinned
from hygrokf.climate.statistics import (
    CYCLE_RANGES_K,
    HUMIDITY_EDGES,
    SCOPES,
    SHARES,
    TEMPERATURE_EDGES,
    Curves,
    curves,
    outside,
    scalars,
    wetness_class,
)
from hygrokf.climate.test_profile import chamber_sequence, closeness
from hygrokf.data.ambient import middle
from hygrokf.data.record import Record
from hygrokf.data.timestamps import stamp_text
from hygrokf.identification.fit import Fit
from hygrokf.identification.verdict import inherited, rests_on
from hygrokf.physics.cold_surface import Surface
from hygrokf.version import __version__

MEMBERS = 50
FEWEST_MEMBERS = 39
"""Members whose extremes are 95 % bounds."""
DAYS_OF = 8
"""Members of whose days a test profile is chosen, of each year."""
DRIPPING_H = 24.0
"""[h/a] above saturation from which it is said that the model lacks what would hold the air below it."""
LEAST_OPERATION = 0.3
"""Share of the time in operation below which power or wind are doubted."""
STANDSTILL_YEAR = "standstill_all_year"
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Study:
    """Climates of one or several regions; `results` is the plain data of `climate.json`."""

    results: Mapping[str, Any]

    def to_json(self) -> dict:
        return dict(self.results)


@dataclass
class _Gathered:
    """What the years of one ensemble add up to: one entry a year."""

    scalars: dict[str, list[dict]] = field(default_factory=lambda: {scope: [] for scope in SCOPES})
    curves: list[Curves] = field(default_factory=list)
    limits: dict[str, list[np.ndarray]] = field(default_factory=dict)
    outside: list[tuple[dict, Curves]] = field(default_factory=list)
    days: list[Days] = field(default_factory=list)
    spans: list[tuple[float, float, float, float]] = field(default_factory=list)

    @property
    def part(self) -> str:
        """What is known of the fullest year, in words, where it is too little to stand for a year; else ""."""
        begin, end, known, _ = max(self.spans, key=lambda span: span[2])
        return part_text(known, (end - begin) / 3600.0 + 1.0)

    def has(self, scope: str) -> bool:
        """Whether any hour of any year is of a scope."""
        return any(year["hours"].max() > 0.0 for year in self.scalars[scope])


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
    progress: Progress = lambda text: None,
) -> Study:
    """The climate in a fitted cabinet under the weather of regions.

    power: a record that has it, a power curve for the weather's wind, or None for standstill all year.  limits: of a
    specification.  plan: of a test profile, with its law of acceleration.  members: of the ensemble.  seed: of the
    parameters drawn and of the disturbances.  surface: the coldest one in the cabinet.  Of several years those of which
    less than `WHOLE` is known are left out.

    Raises ValueError, PowerFault where weather and power do not suffice for the model.
    """
    if not regions:
        raise ValueError("expected the weather of at least one region, found none")
    if members < 2:
        raise ValueError(f"an ensemble has at least 2 members, found {members}")
    expect_names(limits)
    plan, surface = plan or ProfilePlan(), surface or Surface()
    drawn = draw_members(fit, members, seed)
    found = []
    for one in regions:
        try:
            found.append(_region(fit, one, power, limits, plan, drawn, seed, surface, progress))
        except ValueError as fault:
            files = f" ({', '.join(one.files)})" if one.files else ""
            raise ValueError(f"{one.name}{files}: {fault}") from fault
    return Study(
        {
            "name": fit.name,
            "version": __version__,
            "members": members,
            "seed": seed,
            "level": LEVEL,
            "verdicts": inherited(fit.results),
            "surface": vars(surface),
            "plan": plan.to_json(),
            "synthetic": fit.results.get("synthetic") is True,
            "regions": found,
        }
    )


def _region(
    fit: Fit,
    region: Region,
    power: Record | PowerCurve | None,
    limits: Sequence[Limit],
    plan: ProfilePlan,
    drawn: Sequence[Mapping[str, float]],
    seed: int,
    surface: Surface,
    say: Progress,
) -> dict:
    record, statements = driven(fit, region.weather, power)
    rare = shots_of(fit, record)
    statements += shot_words(rare)
    whole, part, count = _Gathered(), _Gathered(), 0
    for year in simulate_years(
        fit, record, drawn, seed, surface, rare=rare, say=lambda t: say(f"{region.name}: {t}")
    ):
        count += 1
        if year.known.any():
            _gather(whole if _is_whole(year) else part, year, limits, plan.law, len(drawn))
    gathered = whole if whole.spans else part
    if not gathered.spans:
        raise ValueError("neither weather nor power is known at any instant; check the files and their spans")
    if power is not None and fit.design.power_scale_W is not None:
        statements += _operating_words(gathered, isinstance(power, PowerCurve))
    statements += filter(None, [rests_on(inherited(fit.results))])
    statements += extrapolation_words(fit, record)
    statements += region.weather.warnings
    statements += _interval_words(region.weather)
    statements += _weather_words(gathered, count)
    statements += _member_words(len(drawn), len(gathered.spans))
    statements += _limit_words(limits, gathered)
    scopes = {scope: _summary(gathered.scalars[scope]) for scope in SCOPES if gathered.has(scope)}
    statements += _saturation_words(scopes["all"])
    if power is not None and fit.design.power_scale_W is not None:
        still, _ = driven(fit, region.weather, None)
        rows: dict[bool, list] = {True: [], False: []}
        for year in simulate_years(
            fit,
            still,
            drawn,
            seed,
            surface,
            rare=rare,
            say=lambda t: say(f"{region.name} at standstill: {t}"),
        ):
            if year.known.any():
                rows[_is_whole(year)].append(scalars(year, plan.law))
        scopes[STANDSTILL_YEAR] = _summary(rows[True] or rows[False])
    say(f"{region.name}: test profile")
    profile, why = _test_profile(gathered, plan)
    if why:
        statements.append(why)
    wet = scopes["all"].get("wetness_h")
    return {
        "name": region.name,
        "files": list(region.files),
        "synthetic": any("synthetic" in s.source for s in region.weather.series),
        "statements": statements,
        "part_of_year": gathered.part,
        "bounds_hold": held(len(drawn) * len(gathered.spans)),
        "mean_bounds_hold": held(len(drawn)),
        "years": [
            {"from": stamp_text(a), "until": stamp_text(b), "hours_known": hours, "operating_share": share}
            for a, b, hours, share in gathered.spans
        ],
        "wetness_class": None if wet is None else wetness_class(float(wet.value)),
        "wetness_class_bounds": None
        if wet is None
        else [wetness_class(float(end)) for end in (wet.lower, wet.upper)],
        "scopes": {
            scope: {name: _plain(one) for name, one in rows.items()} for scope, rows in scopes.items()
        },
        "outside": {
            name: float(np.mean([rows[name] for rows, _ in gathered.outside]))
            for name in gathered.outside[0][0]
        },
        "duration": _curves_json(gathered, "duration"),
        "rates": _curves_json(gathered, "rates"),
        "joint": _joint_json(gathered),
        "limits": [
            judged(one, gathered.limits[one.name], gathered.part).to_json()
            for one in limits
            if one.name in gathered.limits
        ],
        "test_profile": profile,
    }


def _gather(into: _Gathered, year: Year, limits: Sequence[Limit], law: Acceleration, members: int) -> None:
    for scope in SCOPES:  # a year without operation has 0 h of it, and counts among the others
        into.scalars[scope].append(scalars(year, law, scope))
    into.curves.append(curves(year))
    weather = outside(year)
    into.outside.append(
        ({name: float(value[0]) for name, value in scalars(weather, law).items()}, curves(weather))
    )
    for one in limits:
        found = exceeded(year, one)
        if found is not None:
            into.limits.setdefault(one.name, []).append(found)
    if year.relative_humidity is not None and abs(year.step_h - 1.0) < 1e-6:
        # other members in other years, so that their differences are among the days too
        first = len(into.days) * DAYS_OF
        chosen = sorted({(first + i) % members for i in range(min(DAYS_OF, members))})
        into.days.append(thinned(days_of(year, chosen)))
    operating = float(year.operating[year.known].mean())
    into.spans.append((year.time_s[0], year.time_s[-1], year.hours, operating))


def _is_whole(year: Year) -> bool:
    """Whether enough of a year is known to stand for it."""
    return year.hours >= WHOLE * YEAR_H


def _interval_words(weather: Record) -> list[str]:
    """A remark where weather comes less often than every hour."""
    rare = [
        (middle(s.steps_s) / 3600.0, s.signal)
        for s in weather.series
        if s.signal.startswith("ambient_") and len(s.steps_s) and middle(s.steps_s) > 1.01 * 3600.0
    ]
    if not rare:
        return []
    step, name = max(rare)
    more = "; of a day's course nothing is left" if step >= 12.0 else ""
    return [
        f"{name} comes every {step:g} h, with straight lines between: extremes, rates, cycles and short excursions "
        f"come out too small{more}"
    ]


def _operating_words(gathered: _Gathered, by_curve: bool) -> list[str]:
    """For how much of the time the turbine operates, with a doubt where that is little."""
    share = float(
        np.average([span[3] for span in gathered.spans], weights=[span[2] for span in gathered.spans])
    )
    said = f"operates {100.0 * share:.0f} % of the time"
    if share >= LEAST_OPERATION:
        return [said]
    return [f"{said}: check {'units and height of the wind' if by_curve else 'unit and sign of the power'}"]


def _member_words(members: int, years: int) -> list[str]:
    """A remark where there are too few members for the stated bounds."""
    share = held(members * years)
    if share >= LEVEL:
        return []
    return [
        f"{members} members are few: bounds are the least and the largest of them, which hold a single year in "
        f"{100.0 * share:.0f} % of cases, not in {100.0 * LEVEL:.0f} %; state {FEWEST_MEMBERS} or more (--members)"
    ]


def _limit_words(limits: Sequence[Limit], gathered: _Gathered) -> list[str]:
    """Limits that say nothing: of what the model does not have, or of hours that never are."""
    said = []
    for one in limits:
        if one.name not in gathered.limits:
            said.append(
                f'limit "{one.name}" is not judged: the model has no {one.quantity_words}, only a temperature'
            )
        elif not gathered.has(one.during):
            said.append(
                f'limit "{one.name}" {"has nothing beyond it" if gathered.part else "passes"} for want of hours: '
                f"{'these days' if gathered.part else 'these years'} have none"
                f"{' at' if one.during == 'standstill' else ' in'} {one.during}"
            )
    return said


def _weather_words(gathered: _Gathered, found: int) -> list[str]:
    """Remarks on the years, of which so many were found."""
    hours, count = sum(span[2] for span in gathered.spans), len(gathered.spans)
    length = sum(span[1] - span[0] for span in gathered.spans) / 3600.0 + count
    said = []
    if count < found:
        said.append(
            f"{found - count} of {found} years left out: of them less than {100.0 * WHOLE:.0f} % of weather and power is known"
        )
    if gathered.part and count == 1:
        said.append(
            f"{gathered.part} of weather: the bounds say nothing of the rest of the year, nor of other years"
        )
    elif count == 1:
        said.append("one year of weather: the bounds say nothing of how much years differ")
    if length < 0.95 * YEAR_H * count:
        days = f"{length / 24.0:.0f} days" if length >= 48.0 else f"{length:.0f} hours"
        said.append(
            f"the weather covers {days}, not {'a year' if count == 1 else f'{count} years'}: hours a year are scaled up "
            "from them, as if the rest were like them"
        )
    if gathered.part:
        said.append(
            f"on {gathered.part} no limit passes, as the rest of the year may not keep to it: it is undecided; one that is "
            "broken here fails"
        )
    if hours < 0.98 * length:
        said.append(
            f"{100.0 * (1.0 - hours / length):.1f} % of the time weather or power is unknown and left out"
        )
    return said


def _saturation_words(found: Mapping[str, Bounded]) -> list[str]:
    hours = found.get("saturation_h")
    if hours is None or hours.value < DRIPPING_H:
        return []
    return [
        f"the cabinet's air is above 100 % for {hours.value:.0f} h a year: the model lacks what holds it below (condensation, "
        "moisture storage), and the bounds do not know that; hours of damp and condensation are unreliable"
    ]


def _summary(years: Sequence[Mapping[str, np.ndarray]]) -> dict[str, Bounded]:
    return {name: bounded(np.array([year[name] for year in years])) for name in years[0]}


def _plain(one: Bounded) -> dict:
    return {name: as_list(value) for name, value in vars(one).items()}


def _curves_json(gathered: _Gathered, kind: str) -> dict:
    result = {}
    weather = [getattr(one, kind) for _, one in gathered.outside]
    for name in getattr(gathered.curves[0], kind):
        made = _plain(bounded(np.array([getattr(one, kind)[name] for one in gathered.curves])))
        made["outside"] = as_list(np.mean([one[name][0] for one in weather if name in one], axis=0))
        result[name] = {"share_beyond": list(SHARES), **made}
    return result


def _joint_json(gathered: _Gathered) -> dict | None:
    """The joint distribution without its empty rows."""
    if gathered.curves[0].joint is None:
        return None
    inside = bounded(np.array([one.joint for one in gathered.curves]))
    weather = np.mean([one.joint[0] for _, one in gathered.outside if one.joint is not None], axis=0)
    used = np.flatnonzero((inside.value > 0).any(axis=1) | (weather > 0).any(axis=1))
    rows = slice(int(used[0]), int(used[-1]) + 1)
    return {
        "temperature_edges_degC": TEMPERATURE_EDGES[rows.start : rows.stop + 1].tolist(),
        "humidity_edges_percent": HUMIDITY_EDGES.tolist(),
        "hours": as_list(inside.value[rows], 4),
        "lower": as_list(inside.lower[rows], 4),
        "upper": as_list(inside.upper[rows], 4),
        "outside": as_list(weather[rows], 4),
    }


def _test_profile(gathered: _Gathered, plan: ProfilePlan) -> tuple[dict | None, str]:
    """The test profile of a region as plain data, or why there is none."""
    days = thinned(joined(gathered.days)) if gathered.days else None
    if days is None or not len(days):
        return None, "no test profile: it needs humidity, and weather known hour by hour over whole days"
    ageing = bounded(np.array([rows["ageing_h"] for rows in gathered.scalars["all"]]))
    made = chamber_sequence(days, float(ageing.value), plan)
    cycles = np.array(
        [
            np.mean(
                [rows[f"temperature_cycles_from_{k:g}_K_number"].mean() for rows in gathered.scalars["all"]]
            )
            for k in CYCLE_RANGES_K
        ]
    )
    return {
        "hour": list(range(len(made.temperature_degC))),
        "temperature_degC": np.round(made.temperature_degC, 2).tolist(),
        "relative_humidity_percent": np.round(made.relative_humidity_percent, 2).tolist(),
        "site_temperature_degC": np.round(made.site_temperature_degC, 2).tolist(),
        "site_humidity_percent": np.round(made.site_humidity_percent, 2).tolist(),
        "day": [stamp_text(one) for one in made.day_s[::24]],
        "shift_per_K": made.shift,
        "acceleration": made.factor,
        "share_at_chamber_limit": made.cut,
        "reached": made.reached,
        "closeness": closeness(made, days, plan, ageing, cycles),
    }, ""
