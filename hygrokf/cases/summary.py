"""A look at a record: what was read, what was masked."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from hygrokf.cases.doubts import all_doubts
from hygrokf.data.actuators import actuators
from hygrokf.data.masks import mask_frozen, mask_out_of_range, mask_saturated
from hygrokf.data.record import Record, Series
from hygrokf.data.signals import difference_from_si, from_si, signal_named
from hygrokf.data.timestamps import duration_text, modal_step, stamp_text
from hygrokf.weather.clocks import alignments, clock_errors, comparison_rows, described

_DAY = 86400.0
_GAP_STEPS = 3.0


def mask(record: Record) -> Record:
    """Record in which everything that can be masked safely is, said in its warnings.

    record: any, SI units. Readings out of the physical range, repeats of a frozen sensor and
    saturated cabinet humidity become missing, in this order; see `hygrokf.data.masks` for each rule.
    The series that are only compared are treated alike.
    """
    warnings: list[str] = []

    def masked(all_of_them: tuple[Series, ...]) -> tuple[Series, ...]:
        changed = []
        for series in all_of_them:
            for treat in (mask_out_of_range, mask_frozen, mask_saturated):
                series, said = treat(series)
                warnings.extend(said)
            changed.append(series)
        return tuple(changed)

    series, compared = masked(record.series), masked(record.compared)
    return replace(
        record, series=series, compared=compared, warnings=record.warnings + tuple(dict.fromkeys(warnings))
    )


def describe(record: Record) -> dict[str, Any]:
    """What is in a record, for `hygrokf check`: plain numbers and text, ready for JSON.

    record: any. Keys: `name`, `start`, `end`, `days`, `site`, `rated_power_kW`, `identification`
    and `validation` (`start`, `end`, `days`, or None), `signals` (one dictionary each), `actuators` (logged ones, and whether
    a model uses them), `comparisons` (of sources
    that are compared; see `hygrokf.weather.clocks.described`), `warnings`, `doubts`, `files`. Values of a signal are in its `unit`, steps and gaps in seconds, stamps in
    UTC; what is not known is None.
    """
    site = record.site
    clocks = clock_errors(alignments(record))
    return {
        "name": record.name,
        **_span(record.start_s, record.end_s),
        "site": None
        if site is None
        else {
            "latitude_deg": site.latitude_deg,
            "longitude_deg": site.longitude_deg,
            "altitude_m": site.altitude_m,
        },
        "rated_power_kW": None if record.rated_power_W is None else record.rated_power_W / 1e3,
        "identification": _period_of(record.identification()),
        "validation": _period_of(record.validation()),
        "signals": [_describe_series(series) for series in record.series],
        "actuators": [
            {"signal": one.signal, "used": one.used, "statement": one.statement}
            for one in actuators(record.identification())
        ],
        "comparisons": described(clocks),
        "warnings": list(record.warnings),
        "doubts": list(all_doubts(record, clocks)),
        "files": [{"file": file, "sha256": digest} for file, digest in record.provenance],
    }


def _span(start_s: float, end_s: float) -> dict[str, Any]:
    if not math.isfinite(start_s):
        return {"start": None, "end": None, "days": 0.0}
    days = round((end_s - start_s) / _DAY, 3)
    return {"start": stamp_text(start_s), "end": stamp_text(end_s), "days": days}


def _period_of(record: Record) -> dict[str, Any] | None:
    return _span(record.start_s, record.end_s) if record.series else None


def _number(value: float | None, digits: int = 6) -> float | None:
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{digits}g}")


def _describe_series(series: Series) -> dict[str, Any]:
    row = signal_named(series.signal)
    step, regular = modal_step(series.time)
    there = series.value[~series.missing]
    times = series.time[~series.missing]
    expected = len(series)
    if math.isfinite(step) and regular > 0.5:
        expected = max(expected, round((series.time[-1] - series.time[0]) / step) + 1)
    gaps = np.diff(times)
    long = gaps > (_GAP_STEPS + 0.01) * step if math.isfinite(step) else np.zeros(0, dtype=bool)
    widest = int(np.argmax(gaps)) if len(gaps) else None
    shown = from_si(there, row.display, row)
    accuracy = row.default_accuracy if series.accuracy is None else series.accuracy
    return {
        "signal": series.signal,
        "source": series.source,
        **_span(
            series.time[0] if len(series) else math.nan,
            series.time[-1] if len(series) else 0,
        ),
        "readings": len(there),
        "missing_share": _number(1.0 - len(there) / expected if expected else math.nan),
        "step_s": _number(step),
        "regular_share": _number(regular),
        "clock_phase_s": _number(_phase(series.time, step)),
        "clock_uncertainty_s": series.clock_uncertainty_s,
        "gaps": int(long.sum()),
        "longest_gap_s": None if widest is None else _number(gaps[widest]),
        "longest_gap_start": None if widest is None else stamp_text(times[widest]),
        "hold": series.hold,
        "interval_s": series.interval_s,
        "unit": row.display,
        "resolution": _number(difference_from_si(series.resolution, row.display, row), 4),
        "accuracy": None if accuracy is None else _number(difference_from_si(accuracy, row.display, row), 4),
        "minimum": _number(shown.min()) if len(shown) else None,
        "mean": _number(shown.mean()) if len(shown) else None,
        "maximum": _number(shown.max()) if len(shown) else None,
    }


def _phase(time: np.ndarray, step: float) -> float:
    """Where stamps lie within their step [s]: 0 for full hours, ten minutes and so on."""
    if not (len(time) and step > 0.0):
        return math.nan
    # The circular mean, since stamps just before and after a full step belong together.
    angle = 2.0 * math.pi * np.mod(time, step) / step
    mean = math.atan2(float(np.mean(np.sin(angle))), float(np.mean(np.cos(angle))))
    return round(mean / (2.0 * math.pi) * step, 3) + 0.0


def describe_text(description: dict[str, Any]) -> str:
    """A description as a table for the terminal.

    description: what `describe` returns.
    """
    lines = [_heading(description), ""]
    for name in ("identification", "validation"):
        part = description[name]
        text = "none" if part is None else f"{part['start']} to {part['end']}, {part['days']:.1f} d"
        lines.append(f"{name:<15} {text}")
    head = (
        "signal",
        "readings",
        "missing",
        "step",
        "gaps",
        "longest",
        "hold",
        "resolution",
    )
    rows: list[tuple[str, ...]] = [(*head, "mean (lowest … highest)")]
    rows += [_row(one) for one in description["signals"]]
    lines += ["", *_table(rows, right=(1, 2, 3, 4, 5, 7))]
    rows = [("signal", "from", "to", "clock", "source")]
    for one in description["signals"]:
        stated = one["clock_uncertainty_s"]
        clock = f"±{duration_text(stated)}" if stated else "-"
        rows.append(
            (
                one["signal"],
                one["start"] or "-",
                one["end"] or "-",
                clock,
                one["source"],
            )
        )
    lines += ["", *_table(rows, right=())]
    if description.get("comparisons"):
        lines += ["", *_table(comparison_rows(description["comparisons"]), right=(3, 6))]
    if description.get("actuators"):
        lines += ["", "logged actuators"]
        lines += [f"  - {one['statement']}" for one in description["actuators"]]
    for title in ("warnings", "doubts"):
        said = description[title]
        lines += ["", f"{title}: {len(said) or 'none'}"]
        lines += [f"  - {sentence}" for sentence in said]
    return "\n".join(lines)


def _heading(description: dict[str, Any]) -> str:
    parts = [f"{description['name']}: {description['start']} to {description['end']}"]
    parts.append(f"{description['days']:.1f} d")
    if description["rated_power_kW"] is not None:
        parts.append(f"rated {description['rated_power_kW']:g} kW")
    site = description["site"]
    if site is not None:
        north = "N" if site["latitude_deg"] >= 0 else "S"
        east = "E" if site["longitude_deg"] >= 0 else "W"
        parts.append(f"{abs(site['latitude_deg']):g}°{north} {abs(site['longitude_deg']):g}°{east}")
    return ", ".join(parts)


def _row(one: dict[str, Any]) -> tuple[str, ...]:
    unit = "" if one["unit"] == "1" else f" {one['unit']}"
    step_unit = " K" if one["unit"] == "degC" else unit
    hold = one["hold"]
    if one["interval_s"]:
        hold = f"{hold} {duration_text(one['interval_s'])}"
    if one["mean"] is None:
        values = "-"
    else:
        values = f"{one['mean']:.4g} ({one['minimum']:.4g} … {one['maximum']:.4g}){unit}"
    return (
        one["signal"],
        str(one["readings"]),
        "-" if one["missing_share"] is None else f"{100 * one['missing_share']:.1f} %",
        "-" if one["step_s"] is None else duration_text(one["step_s"]),
        str(one["gaps"]),
        duration_text(one["longest_gap_s"]) if one["gaps"] else "-",
        hold,
        f"{one['resolution']:g}{step_unit}" if one["resolution"] else "-",
        values,
    )


def _table(rows: list[tuple[str, ...]], right: tuple[int, ...]) -> list[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(
            cell.rjust(width) if column in right else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
