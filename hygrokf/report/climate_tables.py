"""Tables of a climate study, and how its numbers are written."""

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
    """Return hours a year as text; "< 1" below one hour."""
    return "< 1" if 0.0 < value < 1.0 else plain_number(value)


def number_text(name: str) -> Callable[[float], str]:
    """The function that writes a number by its `name`: hours as whole hours, others by significant digits."""
    return hours_text if name.endswith("_h") and name != "ageing_h" else plain_number


def span_text(bounded: BoundedMean | None, text: Callable[[float], str] = plain_number) -> str:
    """Return a value with its bounds for a year, each written by `text`: "120 (90 … 160)"."""
    value, bounds = value_and_bounds(bounded, text)
    return f"{value} ({bounds})" if bounds else value


def value_and_bounds(
    bounded: BoundedMean | None, text: Callable[[float], str] = plain_number
) -> tuple[str, str]:
    """Return a value and its bounds for a year; no bounds if they read like the value."""
    if bounded is None or bounded.value != bounded.value:
        return NONE, ""
    value = text(bounded.value)
    is_exact = text(bounded.lower) == text(bounded.upper) == value
    return value, "" if is_exact else interval(bounded.lower, bounded.upper, text)


def compared_statistics(regions: Sequence[RegionClimate]) -> list[YearNumber]:
    """Return the statistics by which regions are compared, if all regions have them."""
    compared = [statistic for statistic in STATISTICS if statistic.compared]
    return [one for one in compared if all(one.name in region.year for region in regions)]


def share_held(regions: Sequence[RegionClimate]) -> str:
    """Return the share of single years that the bounds hold; of several regions the smallest."""
    return percent(min(region.bounds_hold for region in regions))


def class_text(region: RegionClimate) -> str:
    """Return the class of wetness with the classes of its bounds: "τ2 (bounds τ1 … τ3)"."""
    if region.wetness_class is None:
        return NONE
    low, high = region.wetness_class_bounds or ("", "")
    return region.wetness_class if low == high else f"{region.wetness_class} (bounds {low} … {high})"


def verdict_text(limit: Exceedance) -> str:
    """Return a verdict, and for "undecided" the reason."""
    return f"{limit.verdict} ({limit.why.text})" if limit.why else limit.verdict


def year_table(region: RegionClimate) -> Table:
    """Return the numbers of the whole year, of a year at standstill, and of the weather."""
    note = f"In brackets: bounds that hold {share_held([region])} of single years. Hours refer to a year of "
    return _numbers(region, "Means, hours and ageing", ("all", "standstill_all_year"), f"{note}8766 h.")


def regimes_table(region: RegionClimate) -> Table | None:
    """Return the numbers in operation and at standstill; None if the year has only one of them."""
    if not {"operation", "standstill"} <= set(region.scopes):
        return None
    note = "Means are taken over the hours of each column; hours are the column's share of the year."
    return _numbers(region, "Operation and standstill", ("operation", "standstill"), note)


def events_table(region: RegionClimate) -> Table:
    """Return number and length of excursions, rates of change, and temperature cycles."""
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
    """The statistics of some scopes, one column each; beside the whole year also those of the weather."""
    scopes = [scope for scope in wanted if scope in region.scopes]
    rows = []
    for statistic in STATISTICS:
        if statistic.table in kinds and any(statistic.name in region.scopes[scope] for scope in scopes):
            text = number_text(statistic.name)
            cells = [span_text(region.scopes[scope].get(statistic.name), text) for scope in scopes]
            if "all" in wanted:
                has_weather = statistic.weather and statistic.name in region.outside
                cells.append(text(region.outside[statistic.name]) if has_weather else "")
            rows.append((statistic.words, statistic.unit, *cells))
    weather = ("outside",) if "all" in wanted else ()
    columns = ("", "unit", *(SCOPE_WORDS[scope] for scope in scopes), *weather)
    return Table(heading, columns, tuple(rows), left=(0, 1), note=note)


def limits_table(region: RegionClimate) -> Table:
    """Return the limits of a region with their exceedances and verdicts."""
    rows = []
    for limit in region.limits:
        scope_text = "" if limit.during == "all" else f", {SCOPE_WORDS[limit.during]}"
        rows.append(
            (
                limit.name,
                f"{limit.side} {limit.level:g} {LIMITED_QUANTITIES[limit.quantity]}{scope_text}",
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
        marked=tuple(number for number, limit in enumerate(region.limits) if limit.verdict == "fail"),
        note="pass: the upper bound of the hours in a year is within the allowed hours. fail: the lower "
        "bound exceeds them. undecided: the allowed hours lie between the bounds, or too little of a year is "
        "known to pass.",
        brief=(0, 1, 2, 3, 6),
    )


def profile_table(region: RegionClimate) -> Table | None:
    """Return what the test profile reproduces of the site, and how closely; None without a profile."""
    if region.test_profile is None:
        return None
    closeness = region.test_profile.closeness
    ageing_row = (
        ("ageing by the stated law, h at the reference", closeness.ageing.service_h, closeness.ageing.test_h),
    )
    rows = (*ageing_row, *((number.name.text, number.site, number.test) for number in closeness.numbers))
    return Table(
        "What the test profile reproduces",
        ("", "site", "test"),
        tuple((label, plain_number(site), plain_number(test)) for label, site, test in rows),
        note="Distance (total variation, 0 the same, 1 nothing in common, in bins of 5 K and 10 %) of the "
        "joint distribution of temperature before warming and humidity: "
        f"{fixed(closeness.joint_distance)}; of "
        f"the ageing over these: {fixed(closeness.ageing_distance)}. Not reproduced: "
        f"{'; '.join(NOT_REPRODUCED)}.",
    )


def regions_table(regions: Sequence[RegionClimate]) -> Table | None:
    """Return the regions side by side; None for a single region."""
    if len(regions) < 2:
        return None
    rows = []
    for statistic in compared_statistics(regions):
        cells = (span_text(region.year[statistic.name], number_text(statistic.name)) for region in regions)
        rows.append((statistic.words, statistic.unit, *cells))
    rows.append(("class of wetness, ISO 9223:1992", "", *map(class_text, regions)))
    for number, limit in enumerate(regions[0].limits):
        cells = (
            verdict_text(region.limits[number]) if number < len(region.limits) else NONE for region in regions
        )
        rows.append((f"limit: {limit.name}", "", *cells))
    return Table(
        "Regions side by side",
        ("", "unit", *(region.name for region in regions)),
        tuple(rows),
        left=(0, 1),
        note=f"In brackets: bounds that hold {share_held(regions)} of single years.",
    )
