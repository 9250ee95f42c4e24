"""Tables of a climate, as words and numbers: pure functions of the data of `climate.json`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from hygrokf.climate.bounds import held
from hygrokf.climate.ensemble import part_text
from hygrokf.climate.limits import QUANTITIES
from hygrokf.data.lookup import number
from hygrokf.identification.verdict import told
from hygrokf.identification.wording import NONE, fixed, percent, plain_number
from hygrokf.report.fit_tables import Table

SCOPE_WORDS = {
    "all": "all of the year",
    "operation": "in operation",
    "standstill": "at standstill",
    "standstill_all_year": "if it stood still all year",
}
OF_SCOPES = {
    "hours": ("hours", "h/a"),
    "mean_temperature_degC": ("mean temperature", "°C"),
    "mean_relative_humidity_percent": ("mean relative humidity", "%"),
    "mean_absolute_humidity_g_m3": ("mean absolute humidity", "g/m³"),
    "wetness_h": ("time of wetness (above 80 %, above 0 °C)", "h/a"),
    "saturation_h": ("relative humidity above 100 %", "h/a"),
    "condensation_h": ("condensation on the cold surface", "h/a"),
    "ageing_h": ("ageing, in hours at the reference condition", "h/a"),
}
OF_COURSES = {
    "humidity_above_80": "humidity above 80 %",
    "humidity_above_95": "humidity above 95 %",
    "temperature_above_40": "temperature above 40 °C",
    "temperature_below_0": "temperature below 0 °C",
    "condensation": "condensation",
}
RATES_AND_CYCLES = {
    "temperature_rate_99_K_per_h": ("rate of temperature, exceeded 1 % of the time", "K/h"),
    "temperature_rate_largest_K_per_h": ("largest rate of temperature", "K/h"),
    "relative_humidity_rate_99_percent_per_h": ("rate of humidity, exceeded 1 % of the time", "%/h"),
    "relative_humidity_rate_largest_percent_per_h": ("largest rate of humidity", "%/h"),
    "temperature_cycles_from_5_K_number": ("temperature cycles of 5 K and more", "1/a"),
    "temperature_cycles_from_10_K_number": ("temperature cycles of 10 K and more", "1/a"),
    "temperature_cycles_from_20_K_number": ("temperature cycles of 20 K and more", "1/a"),
}
SIDE_BY_SIDE = (
    "mean_temperature_degC", "mean_relative_humidity_percent", "wetness_h", "condensation_h", "ageing_h",
)  # fmt: skip


def hours_text(value: float) -> str:
    """Hours a year, counted in whole hours: of less than one no digits are told."""
    return "< 1" if 0.0 < value < 1.0 else plain_number(value)


def _text_of(name: str) -> Callable[[float], str]:
    """How a number is written: the ageing is no count of hours."""
    return hours_text if name.endswith("_h") and name != "ageing_h" else plain_number


def span_text(one: Mapping | None, text: Callable[[float], str] = plain_number) -> str:
    """A value with its bounds for a year, each as `text` writes it."""
    value, low, high = (number(one, key) for key in ("value", "lower", "upper"))
    if value != value:
        return NONE
    if text(low) == text(high) == text(value):
        return text(value)
    return f"{text(value)} ({text(low)} … {text(high)})"


def with_shares(found: Mapping) -> list[Mapping]:
    """The regions of a climate with the shares that their bounds hold; those of older results follow from its members."""
    draws = number(found, "members")
    return [
        {"bounds_hold": held(draws * len(one["years"])), "mean_bounds_hold": held(draws), **one}
        for one in found["regions"]
    ]


def share_held(regions: Sequence[Mapping], which: str = "bounds_hold") -> str:
    """The share of single years (or, of `mean_bounds_hold`, of means) that bounds hold, the least of several regions."""
    return percent(min(number(one, which) for one in regions))


def part_of_year(region: Mapping) -> str:
    """What there is of a region's fullest year where it is too little to stand for a year, such as "80 days"; else ""."""
    if "part_of_year" in region:
        return region["part_of_year"]
    return part_text(max(number(one, "hours_known") for one in region["years"]))


def class_text(region: Mapping) -> str:
    """The class of wetness, with those of its bounds where they differ: "τ1 (bounds τ1 … τ2)"."""
    found = region["wetness_class"]
    low, high = region.get("wetness_class_bounds") or (found, found)
    return NONE if found is None else found if low == high else f"{found} (bounds {low} … {high})"


def verdict_text(limit: Mapping) -> str:
    """A verdict, and why there is none."""
    why = limit.get("why")
    return f"{limit['verdict']} ({why})" if why else limit["verdict"]


def year_table(region: Mapping) -> Table:
    """The year as it is, the year if the turbine stood still, and outside."""
    return _scopes(
        region,
        "The year",
        ("all", "standstill_all_year"),
        True,
        f"In brackets bounds that hold {share_held([region])} of single years. Hours are those of a year of 8766 h.",
    )


def regimes_table(region: Mapping) -> Table | None:
    """Operation beside standstill; None where there is only one of them."""
    if not {"operation", "standstill"} <= set(region["scopes"]):
        return None
    return _scopes(
        region,
        "Operation and standstill",
        ("operation", "standstill"),
        False,
        "Means are those of the hours in the column; hours are those of the year that fall into it.",
    )


def _scopes(region: Mapping, heading: str, wanted: Sequence[str], weather: bool, note: str) -> Table:
    scopes = [scope for scope in wanted if scope in region["scopes"]]
    rows = []
    for name, (words, unit) in OF_SCOPES.items():
        if any(name in region["scopes"][scope] for scope in scopes):
            text = _text_of(name)
            cells = [span_text(region["scopes"][scope].get(name), text) for scope in scopes]
            if weather:  # ageing counts for what stands in the cabinet, not outside
                told = name not in ("hours", "ageing_h")
                cells.append(text(number(region["outside"], name)) if told else "")
            rows.append((words, unit, *cells))
    columns = ("", "unit", *(SCOPE_WORDS[scope] for scope in scopes), *(("outside",) if weather else ()))
    return Table(heading, columns, tuple(rows), left=(0, 1), note=note)


def excursions_table(region: Mapping) -> Table:
    """How often, how long."""
    year = region["scopes"]["all"]
    rows = []
    for name, words in OF_COURSES.items():
        if f"{name}_number" in year:
            cells = [
                span_text(year[f"{name}_{part}"], hours_text if part == "h" else plain_number)
                for part in ("h", "number", "mean_length_h", "longest_h")
            ]
            rows.append((words, *cells))
    return Table(
        "Excursions",
        ("", "h/a", "number/a", "mean length, h", "longest, h"),
        tuple(rows),
        note="An excursion is a stretch of hours without a break.",
    )


def rates_table(region: Mapping) -> Table:
    """Rates of change and temperature cycles."""
    year = region["scopes"]["all"]
    rows = [
        (words, unit, span_text(year[name]), plain_number(number(region["outside"], name)))
        for name, (words, unit) in RATES_AND_CYCLES.items()
        if name in year
    ]
    return Table(
        "Rates of change and cycles",
        ("", "unit", "cabinet", "outside"),
        tuple(rows),
        left=(0, 1),
        note="Rates are absolute, from hour to hour. Cycles are counted by rainflow (ASTM E1049).",
    )


def limits_table(region: Mapping) -> Table | None:
    """Limits and verdicts; None without limits."""
    rows = []
    for one in region["limits"]:
        when = "" if one["during"] == "all" else f", {one['during']}"
        rows.append(
            (
                one["name"],
                f"{one['side']} {one['level']:g} {QUANTITIES[one['quantity']]}{when}",
                plain_number(one["hours_a_year"]),
                span_text(one["hours"], hours_text),
                span_text(one["number"]),
                span_text(one["longest_h"]),
                verdict_text(one),
            )
        )
    if not rows:
        return None
    return Table(
        "Limits",
        ("limit", "beyond it", "allowed, h/a", "found, h/a", "number/a", "longest, h", "verdict"),
        tuple(rows),
        left=(0, 1, 6),
        marked=tuple(i for i, one in enumerate(region["limits"]) if one["verdict"] == "fail"),
        note="pass: the upper bound of the hours in a year is within what is allowed; fail: the lower bound is beyond it; "
        "undecided: what is allowed lies between the bounds, or too little of a year is known to pass.",
    )


def profile_table(region: Mapping) -> Table | None:
    """What the test profile reproduces, and how closely; None where there is none."""
    profile = region["test_profile"]
    if profile is None:
        return None
    close = profile["closeness"]
    aged = close["ageing"]
    rows = [
        (
            "ageing by the stated law, h at the reference",
            f"{plain_number(aged['service_h'])} in service",
            plain_number(aged["test_h"]),
            f"{plain_number(aged['years'])} years ({plain_number(aged['years_lower'])} … {plain_number(aged['years_upper'])})",
        ),
        (
            "joint distribution of temperature before warming and humidity",
            "",
            "",
            f"distance {fixed(close['joint_distance'])}",
        ),
        ("distribution of the ageing over it", "", "", f"distance {fixed(close['ageing_distance'])}"),
        _shares("share of hours above 80 %", close["wet_share"]),
        _shares("share of the ageing above 80 %", close["wet_ageing_share"]),
        (
            "mean relative humidity, %",
            fixed(close["mean_humidity_percent"]["site"], 1),
            fixed(close["mean_humidity_percent"]["test"], 1),
            "",
        ),
    ]
    for one in close["cycles"]:
        rows.append(
            (
                f"temperature cycles of {one['from_K']:g} K and more",
                f"{plain_number(one['site_a_year'])} a year; {plain_number(one['service'])} in service",
                plain_number(one["test"]),
                f"its days before warming: {plain_number(one['days_a_year'])} a year",
            )
        )
    return Table(
        "What the test profile reproduces",
        ("", "site", "test", "how closely"),
        tuple(rows),
        left=(0, 1, 3),
        note="Distance: total variation, 0 the same, 1 nothing in common, in bins of 5 K and 10 %. Not reproduced: "
        + "; ".join(close["not_reproduced"])
        + ".",
    )


def _shares(words: str, pair: Mapping) -> tuple[str, str, str, str]:
    return words, percent(pair["site"], 2), percent(pair["test"], 2), ""


def regions_table(regions: Sequence[Mapping]) -> Table | None:
    """Regions side by side; None for a single one."""
    if len(regions) < 2:
        return None
    rows = []
    for name in SIDE_BY_SIDE:
        if all(name in one["scopes"]["all"] for one in regions):
            words, unit = OF_SCOPES[name]
            rows.append(
                (words, unit, *(span_text(one["scopes"]["all"][name], _text_of(name)) for one in regions))
            )
    rows.append(("class of wetness, ISO 9223:1992", "", *map(class_text, regions)))
    for i, limit in enumerate(regions[0]["limits"]):
        cells = [verdict_text(one["limits"][i]) if i < len(one["limits"]) else NONE for one in regions]
        rows.append((f"limit: {limit['name']}", "", *cells))
    return Table(
        "Regions side by side",
        ("", "unit", *(one["name"] for one in regions)),
        tuple(rows),
        left=(0, 1),
        note=f"In brackets bounds that hold {share_held(regions)} of single years.",
    )


def climate_text(data: Mapping) -> str:
    """The same for a terminal."""
    lines = told(data.get("verdicts"))
    regions = with_shares(data)
    for region in regions:
        lines += [f"{region['name']}", *(f"  {one}" for one in region["statements"])]
        for table in (
            limits_table(region),
            year_table(region),
            regimes_table(region),
            excursions_table(region),
        ):
            if table is not None:
                lines += ["", *_lines(table)]
        lines.append("")
    table = regions_table(regions)
    return "\n".join([*lines, *(_lines(table) if table else [])]).rstrip()


def _lines(table: Table) -> list[str]:
    rows = [table.columns, *table.rows]
    widths = [max(len(row[i]) for row in rows) for i in range(len(table.columns))]
    made = [
        "  "
        + "  ".join(
            c.ljust(w) if i in table.left else c.rjust(w)
            for i, (c, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    return [f"  {table.heading}", *(line.rstrip() for line in made)]
