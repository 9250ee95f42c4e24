"""Tables of a climate, as blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hygrokf.climate.bounds import BoundedMean
from hygrokf.climate.limits import LIMITED_QUANTITIES, Exceedance
from hygrokf.climate.statistics import STATISTICS, YearNumber
from hygrokf.climate.study import RegionClimate
from hygrokf.report.blocks import Table
from hygrokf.report.quantities import interval
from hygrokf.texts.wording import NONE, fixed, percent, plain_number

SCOPE_WORDS = {
    "all": "whole year",
    "operation": "in operation",
    "standstill": "at standstill",
    "standstill_all_year": "at standstill all year",
}

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


def hours_text(value: float) -> str:
    """Hours a year, counted in whole hours: below one hour no digits are shown."""
    return "< 1" if 0.0 < value < 1.0 else plain_number(value)


def number_text(name: str) -> Callable[[float], str]:
    """How a number is written, by its name; ageing is no count of hours."""
    return hours_text if name.endswith("_h") and name != "ageing_h" else plain_number


def span_text(one: BoundedMean | None, text: Callable[[float], str] = plain_number) -> str:
    """A value with its bounds for a year, each as `text` writes it."""
    value, bounds = value_and_bounds(one, text)
    return f"{value} ({bounds})" if bounds else value


def value_and_bounds(one: BoundedMean | None, text: Callable[[float], str] = plain_number) -> tuple[str, str]:
    """A value and its bounds for a year; no bounds where they read like the value."""
    if one is None or one.value != one.value:
        return NONE, ""
    value = text(one.value)
    alike = text(one.lower) == text(one.upper) == value
    return value, "" if alike else interval(one.lower, one.upper, text)


def compared_statistics(regions: Sequence[RegionClimate]) -> list[YearNumber]:
    """The statistics by which regions are compared, as far as all of them have these."""
    return [one for one in STATISTICS if one.compared and all(one.name in region.year for region in regions)]


def share_held(regions: Sequence[RegionClimate]) -> str:
    """The share of single years that the bounds hold, the least of several regions."""
    return percent(min(region.bounds_hold for region in regions))


def class_text(region: RegionClimate) -> str:
    """The class of wetness, with those of its bounds where they differ: "τ1 (bounds τ1 … τ2)"."""
    found = region.wetness_class
    low, high = region.wetness_class_bounds or (found, found)
    return NONE if found is None else found if low == high else f"{found} (bounds {low} … {high})"


def verdict_text(limit: Exceedance) -> str:
    """A verdict, and why there is none."""
    return f"{limit.verdict} ({limit.why.text})" if limit.why else limit.verdict


def year_table(region: RegionClimate) -> Table:
    """The whole year, the year at standstill, and the weather."""
    note = f"In brackets: bounds that hold {share_held([region])} of single years. Hours refer to a year of "
    return _numbers(region, "Means, hours and ageing", ("all", "standstill_all_year"), f"{note}8766 h.")


def regimes_table(region: RegionClimate) -> Table | None:
    """Operation beside standstill; None where the year has only one of them."""
    if not {"operation", "standstill"} <= set(region.scopes):
        return None
    note = "Means are taken over the hours of each column; hours are the column's share of the year."
    return _numbers(region, "Operation and standstill", ("operation", "standstill"), note)


def events_table(region: RegionClimate) -> Table:
    """How often and how long conditions hold, rates of change and temperature cycles."""
    return _numbers(
        region,
        "Excursions, rates of change and cycles",
        ("all",),
        "An excursion is an unbroken stretch of hours. Rates are absolute changes from hour to hour. Cycles "
        "are counted by rainflow (ASTM E1049).",
        ("excursion", "rate"),
    )


def _numbers(
    region: RegionClimate, heading: str, wanted: Sequence[str], note: str, kinds: Sequence[str] = ("scope",)
) -> Table:
    """The numbers of some scopes; beside the whole year those of the weather."""
    scopes = [scope for scope in wanted if scope in region.scopes]
    rows = []
    for one in STATISTICS:
        if one.table in kinds and any(one.name in region.scopes[scope] for scope in scopes):
            text = number_text(one.name)
            cells = [span_text(region.scopes[scope].get(one.name), text) for scope in scopes]
            if "all" in wanted:
                shown = one.weather and one.name in region.outside
                cells.append(text(region.outside[one.name]) if shown else "")
            rows.append((one.words, one.unit, *cells))
    weather = ("outside",) if "all" in wanted else ()
    columns = ("", "unit", *(SCOPE_WORDS[scope] for scope in scopes), *weather)
    return Table(heading, columns, tuple(rows), left=(0, 1), note=note)


def limits_table(region: RegionClimate) -> Table:
    """Limits and verdicts."""
    rows = []
    for limit in region.limits:
        when = "" if limit.during == "all" else f", {SCOPE_WORDS[limit.during]}"
        rows.append(
            (
                limit.name,
                f"{limit.side} {limit.level:g} {LIMITED_QUANTITIES[limit.quantity]}{when}",
                plain_number(limit.hours_a_year),
                span_text(limit.hours, hours_text),
                span_text(limit.number),
                span_text(limit.longest_h),
                verdict_text(limit),
            )
        )
    return Table(
        "Limits and verdicts",
        ("limit", "exceeded", "allowed, h/a", "found, h/a", "number/a", "longest, h", "verdict"),
        tuple(rows),
        left=(0, 1, 6),
        marked=tuple(i for i, limit in enumerate(region.limits) if limit.verdict == "fail"),
        note="pass: the upper bound of the hours in a year is within the allowed hours. fail: the lower "
        "bound exceeds them. undecided: the allowed hours lie between the bounds, or too little of a year is "
        "known to pass.",
        brief=(0, 1, 2, 3, 6),
    )


def profile_table(region: RegionClimate) -> Table | None:
    """What the test profile reproduces, and how closely; None without a profile."""
    if region.test_profile is None:
        return None
    close = region.test_profile.closeness
    numbers = (("ageing by the stated law, h at the reference", close.ageing.service_h, close.ageing.test_h),)
    rows = (*numbers, *((number.name.text, number.site, number.test) for number in close.numbers))
    return Table(
        "What the test profile reproduces",
        ("", "site", "test"),
        tuple((words, plain_number(site), plain_number(test)) for words, site, test in rows),
        note="Distance (total variation, 0 the same, 1 nothing in common, in bins of 5 K and 10 %) of the "
        f"joint distribution of temperature before warming and humidity: {fixed(close.joint_distance)}; of "
        f"the ageing over these: {fixed(close.ageing_distance)}. Not reproduced: "
        f"{'; '.join(NOT_REPRODUCED)}.",
    )


def regions_table(regions: Sequence[RegionClimate]) -> Table | None:
    """Regions side by side; None for a single one."""
    if len(regions) < 2:
        return None
    rows = []
    for row in compared_statistics(regions):
        cells = (span_text(region.year[row.name], number_text(row.name)) for region in regions)
        rows.append((row.words, row.unit, *cells))
    rows.append(("class of wetness, ISO 9223:1992", "", *map(class_text, regions)))
    for i, limit in enumerate(regions[0].limits):
        cells = (verdict_text(region.limits[i]) if i < len(region.limits) else NONE for region in regions)
        rows.append((f"limit: {limit.name}", "", *cells))
    return Table(
        "Regions side by side",
        ("", "unit", *(region.name for region in regions)),
        tuple(rows),
        left=(0, 1),
        note=f"In brackets: bounds that hold {share_held(regions)} of single years.",
    )
