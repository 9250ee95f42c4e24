"""The tables of a fit, once as data; the report writes them as HTML, the command line as text."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass

from hygrokf.data.lookup import entry, number, numbers, one_line
from hygrokf.identification.wording import (
    NONE,
    QUANTITIES,
    RULES,
    SCORED,
    decimals_for,
    ends,
    fixed,
    percent,
    plain_number,
    sentence,
    signed,
    text_of,
    texts,
)
from hygrokf.report.fit_text import lead_words, method, simulated, time_constant

TEXT_WIDTH = 100
PERIODS = ("identification", "validation")
REGIMES = ("operation", "standstill", "total")


@dataclass(frozen=True)
class Table:
    """Columns and rows of text; `left` columns are words, the others numbers; `marked` rows are set off.

    `groups` spans columns under a common heading: (heading, number of columns).
    """

    heading: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: tuple[int, ...] = (0,)
    marked: tuple[int, ...] = ()
    groups: tuple[tuple[str, int], ...] = ()
    note: str = ""

    def __post_init__(self) -> None:
        wrong = [row for row in self.rows if len(row) != len(self.columns)]
        if wrong:
            raise ValueError(
                f"{self.heading}: expected a cell for each of {len(self.columns)} columns, found {wrong[0]}"
            )


def time_constants_table(fit: Mapping) -> Table | None:
    """Both time constants by both criteria; None where neither was identified."""
    rows: list[tuple[str, ...]] = []
    notes: list[str] = []
    for name in ("thermal", "hygric"):
        constant = time_constant(fit, name)
        if constant.found is None:
            continue
        bounds = constant.bounds.split(",")[0] if constant.closed else NONE
        level = number(constant.found, "level")
        how = (
            f"{method(constant.found)}, {percent(level)}" if math.isfinite(level) else method(constant.found)
        )
        rows.append((f"{name} {_PRODUCT[name]}", constant.value, bounds, how, constant.verdict.words))
        rows += _beside(constant.found)
        other = simulated(constant.found)
        if other:
            value, _, span = other.partition(" (")
            rows.append(
                ("  by simulation (output error)", value, span.rstrip(")") or NONE, "sandwich, 95 %", "")
            )
        differences = numbers(constant.found, "difference_K")
        if len(differences) == 3:
            note = (
                f"The difference between cabinet and ambient is {differences[0]:.1f}, {differences[1]:.1f} and "
                f"{differences[2]:.1f} K in 10, 50 and 90 % of the readings"
            )
            courses = numbers(constant.found, "range_h")
            if len(courses) == 3:
                note += (
                    f"; small changes decay with {', '.join(plain_number(v) for v in courses[:2])} and "
                    f"{plain_number(courses[2])} h there"
                )
            notes.append(f"{note}.")
        span = entry(constant.found, "range_h")
        if isinstance(span, (list, tuple)) and len(span) == 2:
            low, high = number({"": span[0]}, ""), number({"": span[1]}, "")
            if math.isfinite(low) and math.isfinite(high):
                decimals = decimals_for(0.2 * abs(high - low))
                rows.append(
                    (
                        "  over the record's temperatures",
                        f"{low:.{decimals}f} … {high:.{decimals}f} h",
                        NONE,
                        "",
                        "",
                    )
                )
        inside, outside = (
            number(constant.found, "reference", f"{side}_temperature_K") - 273.15
            for side in ("cabinet", "ambient")
        )
        if math.isfinite(inside) and math.isfinite(outside):
            notes.append(
                f"The {name} time constant holds at {fixed(inside, 1)} °C inside and {fixed(outside, 1)} °C outside."
            )
        modes = numbers(constant.found, "modes")
        if len(modes) > 1:
            notes.append(f"Poles of the {name} model: {', '.join(f'{plain_number(v)} h' for v in modes)}.")
    if not rows:
        return None
    return Table(
        "Time constants",
        ("", "value", "bounds [h]", "method", "verdict"),
        tuple(rows),
        left=(0, 3, 4),
        note=" ".join(notes),
    )


def _beside(found: Mapping) -> list[tuple[str, ...]]:
    """Rows below a time constant: the likelihood's own bounds, R·C under convection, the sensor's response."""
    rows: list[tuple[str, ...]] = []
    for words, key, how in (
        ("  by the likelihood alone", "profile", "profile likelihood, 95 %"),
        ("  R·C at the same difference", "resistance_capacity", "all sources, 95 %"),
    ):
        value, low, high = (number(found, key, part) for part in ("value_h", "lower_h", "upper_h"))
        if math.isfinite(value) and low > 0 and math.isfinite(high):
            shown, span = ends(value, low, high)
            rows.append((words, f"{shown} h", span, how, ""))
    minutes = number(found, "response", "minutes")
    kind = entry(found, "response", "kind")
    if kind == "estimated":
        low, high = (number(found, "response", f"{side}_minutes") for side in ("lower", "upper"))
        rows.append(
            (
                "  humidity sensor's response",
                f"{minutes:.1f} min",
                f"{low:.1f} … {high:.1f} min",
                "estimated, 95 %",
                "",
            )
        )
    elif kind == "included":
        rows.append(("  humidity sensor's response", "included", NONE, "not stated, none seen", ""))
    elif kind == "stated" and minutes > 0:
        rows.append(("  humidity sensor's response", f"{minutes:.1f} min", NONE, "stated", ""))
    return rows


_PRODUCT = {"thermal": "(R_AT+R_IC)·C", "hygric": "R_D*·V*"}


def rmse_table(fit: Mapping, period: str) -> Table | None:
    """The paper's Table III for one period with the baselines; None where nothing was scored."""
    if not any(math.isfinite(number(fit, "rmse", period, q, "total")) for q in SCORED):
        return None
    rows = [("model, free run", *_cells(fit, ("rmse", period)))]
    for key, words in RULES.items():
        cells = _cells(fit, ("baselines", period, key))
        if any(cell != NONE for cell in cells):
            rows.append((words, *cells))
    counts = []
    for quantity in SCORED:
        for regime in REGIMES:
            n = number(fit, "rmse", period, quantity, "n", regime)
            counts.append(f"{n:.0f}" if math.isfinite(n) else NONE)
    rows.append(("readings", *counts))
    share = [number(fit, "sensor_share", period, q) for q in SCORED]
    if any(math.isfinite(one) for one in share):
        rows.append(
            (
                "share explained by sensor accuracy",
                NONE,
                NONE,
                percent(share[0]),
                NONE,
                NONE,
                percent(share[1]),
            )
        )
    return Table(
        f"Root mean squared error, {period}",
        ("", *REGIMES, *REGIMES),
        tuple(rows),
        marked=(0,),
        groups=(("", 1), ("temperature [K]", 3), ("absolute humidity [g/m³]", 3)),
    )


def _cells(fit: Mapping, path: tuple[str, ...]) -> list[str]:
    return [fixed(number(fit, *path, quantity, regime)) for quantity in SCORED for regime in REGIMES]


def bands_table(fit: Mapping) -> Table | None:
    """Coverage of the bands by lead; None without any."""
    found = entry(fit, "bands")
    rows = []
    for lead, by_quantity in found.items() if isinstance(found, Mapping) else ():
        cells = []
        for quantity in QUANTITIES:
            share, n, scale = (number(by_quantity, quantity, part) for part in ("coverage", "n", "scale"))
            cells += [percent(share, 1), fixed(scale), f"{n:.0f}" if n > 0 else NONE]
        if any(cell != NONE for cell in cells):
            rows.append((lead_words(lead), *cells))
    if not rows:
        return None
    return Table(
        "Readings inside the 95 % bands",
        ("", *("inside", "scale", "n") * 3),
        tuple(rows),
        groups=(("", 1), *((words, 3) for words, _ in QUANTITIES.values())),
        note="Scale: the factor by which the band would have to be widened (above 1) or narrowed to hold 95 %.",
    )


def parameters_table(fit: Mapping) -> Table | None:
    """Every parameter with standard error, bounds, unit, meaning and remarks; None without any."""
    found = entry(fit, "parameters")
    flat = set(texts(entry(fit, "flat")))
    rows: list[tuple[str, ...]] = []
    marked: list[int] = []
    for name, row in found.items() if isinstance(found, Mapping) else ():
        value, se, low, high = (number(row, part) for part in ("value", "se", "lower", "upper"))
        decimals = decimals_for(0.5 * se)
        shown = [
            fixed(v, decimals) if se > 0 and decimals < 8 else plain_number(v) for v in (value, low, high)
        ]
        remarks = []
        if entry(row, "fixed") is True:
            remarks.append("fixed")
        if entry(row, "at_bound") is True:
            remarks.append("at its bound")
        if name in flat:
            remarks.append("not pinned down")
        mean, sd = number(row, "prior", "mean"), number(row, "prior", "sd")
        if math.isfinite(sd):
            remarks.append(f"prior {plain_number(mean, 2)} ± {plain_number(sd, 2)}")
        bounds = NONE if shown[1:] == [NONE, NONE] else f"{shown[1]} … {shown[2]}"
        if {"at its bound", "not pinned down"} & set(remarks):
            marked.append(len(rows))
        rows.append(
            (
                text_of(name),
                shown[0],
                plain_number(se, 2),
                bounds,
                unit(text_of(entry(row, "unit"))),
                text_of(entry(row, "meaning")),
                "; ".join(remarks),
            )
        )
    if not rows:
        return None
    columns = ("parameter", "value", "se", "95 % bounds", "unit", "meaning", "remarks")
    return Table("Parameters", columns, tuple(rows), left=(0, 4, 5, 6), marked=tuple(marked))


def actuators_table(fit: Mapping) -> Table | None:
    """What logged actuators change while they are on; None where none is logged."""
    rows, left_out = [], []
    for one in _rows(entry(fit, "actuators")):
        if entry(one, "used") is not True:
            left_out.append(sentence(text_of(entry(one, "statement"))))
            rows.append((text_of(entry(one, "signal")), *[NONE] * 4))
            continue
        cells = []
        for quantity, factor in (
            ("temperature_K", 1.0),
            ("relative_humidity", 100.0),
            ("absolute_humidity_g_m3", 1.0),
        ):
            value, low, high = (
                factor * number(one, "changes", quantity, part) for part in ("value", "lower", "upper")
            )
            decimals = (
                decimals_for(max(0.25 * (high - low), 0.01 * abs(value))) if math.isfinite(high - low) else 2
            )
            bounds = (
                f" ({signed(low, decimals)} … {signed(high, decimals)})" if math.isfinite(high - low) else ""
            )
            cells.append(f"{signed(value, decimals)}{bounds}" if math.isfinite(value) else NONE)
        rows.append((text_of(entry(one, "signal")), percent(number(one, "on_share"), 1), *cells))
    if not rows:
        return None
    return Table(
        "What the logged actuators change while they are on",
        ("actuator", "on", "temperature [K]", "relative humidity [%]", "absolute humidity [g/m³]"),
        tuple(rows),
        note=" ".join(
            [
                "Mean of the simulation with the actuator less the one without it, over the time that it is above half of its "
                "span, with 95 % bounds.",
                *left_out,
            ]
        ),
    )


def _rows(found: object) -> list[Mapping]:
    return [one for one in found if isinstance(one, Mapping)] if isinstance(found, (list, tuple)) else []


def unit(text: str) -> str:
    """A unit as it is printed."""
    for plain, printed in (("g/m3", "g/m³"), ("kg/m3", "kg/m³"), ("m2", "m²"), ("/h^0.5", "/√h")):
        text = text.replace(plain, printed)
    return text


def optima_table(fit: Mapping) -> Table | None:
    """Other local optima that were met; None where there were none."""
    found = entry(fit, "other_optima")
    best = number(fit, "loglik")
    rows = []
    for one in found if isinstance(found, (list, tuple)) else ():
        if not isinstance(one, Mapping):
            continue
        objective = number(one, "objective")
        rest = [
            f"{key.replace('_', ' ')} {plain_number(number(one, key))}" for key in one if key != "objective"
        ]
        rows.append((fixed(objective), fixed(objective - best), ", ".join(rest)))
    if not rows:
        return None
    return Table(
        "Other optima met on the way",
        ("objective", "against the log-likelihood", "there"),
        tuple(rows),
        left=(2,),
    )


def innovations_table(fit: Mapping) -> Table | None:
    """Moments and whiteness of the innovations; None without any."""
    found = entry(fit, "innovations", "outputs")
    rows = []
    for name, one in found.items() if isinstance(found, Mapping) else ():
        n = number(one, "n")
        tests = entry(one, "ljung_box")
        last = tests[-1] if isinstance(tests, list) and tests else None
        rows.append(
            (
                text_of(name),
                f"{n:.0f}" if math.isfinite(n) else NONE,
                fixed(number(one, "mean"), 3),
                fixed(number(one, "variance")),
                fixed(number(one, "excess_kurtosis")),
                percent(number(one, "beyond_3"), 2),
                _p(number(last, "p")),
                _p(number(one, "cumulative_periodogram", "p")),
            )
        )
    if not rows:
        return None
    columns = ("output", "n", "mean", "variance", "kurtosis", "beyond ±3", "Ljung–Box p", "spectrum p")
    note = "White, normal innovations: mean 0, variance 1, excess kurtosis 0, 0.27 % beyond ±3; Ljung–Box over a day."
    return Table("Standardised innovations", columns, tuple(rows), note=note)


def _p(p: float) -> str:
    return NONE if math.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"


# --- text ------------------------------------------------------------------------------------


def table_text(table: Table, width: int = TEXT_WIDTH, columns: tuple[int, ...] | None = None) -> str:
    """A table in fixed width; `columns` picks some of them."""
    chosen = columns or tuple(range(len(table.columns)))
    head = [table.columns[i] for i in chosen]
    rows = [[one_line(row[i]) for i in chosen] for row in table.rows]
    widths = [max(cells(text) for text in column) for column in zip(head, *rows, strict=True)]
    first = max(width - sum(widths[1:]) - 2 * (len(widths) - 1), 12)
    if widths[0] > first:
        widths[0] = first
        rows = [[shortened(row[0], first), *row[1:]] for row in rows]
    left = {place for place, i in enumerate(chosen) if i in table.left}
    lines = [table.heading]
    if table.groups and columns is None:
        lines.append(_group_line(table.groups, widths))
    for row in (head, *rows):
        parts = [_padded(text, widths[k], k in left) for k, text in enumerate(row)]
        lines.append("  ".join(parts).rstrip())
    if table.note:
        lines += wrapped(table.note, width)
    return "\n".join(shortened(line, width) for line in lines)


def _group_line(groups: tuple[tuple[str, int], ...], widths: list[int]) -> str:
    parts, at = [], 0
    for heading, count in groups:
        room = sum(widths[at : at + count]) + 2 * (count - 1)
        at += count
        parts.append(_padded(shortened(heading, room), room, False))
    return "  ".join(parts).rstrip()


def cells(text: str) -> int:
    """Columns that a terminal needs for a text."""
    return sum(
        0 if unicodedata.combining(c) else 2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in text
    )


def _padded(text: str, width: int, left: bool) -> str:
    space = " " * max(width - cells(text), 0)
    return text + space if left else space + text


def shortened(text: str, width: int) -> str:
    """Text cut to a width, with an ellipsis where something is gone."""
    if cells(text) <= width:
        return text
    while text and cells(text) > width - 1:
        text = text[:-1]
    return text + "…"


def wrapped(text: str, width: int = TEXT_WIDTH, indent: str = "") -> list[str]:
    """Lines of at most `width` columns, further ones indented; words longer than a line are cut."""
    lines, line = [], ""
    for word in text.split(" "):
        while word:
            grown = f"{line} {word}" if line.strip() else line + word
            if cells(grown) <= width:
                line, word = grown, ""
            elif line.strip():
                lines.append(line)
                line = indent
            else:
                part = word
                while cells(line + part) > width:
                    part = part[:-1]
                lines.append(line + part)
                line, word = indent, word[len(part) :]
    return [*lines, line] if line.strip() or not lines else lines
