"""A look at a record: what was read, what was masked, what a sceptic would ask."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hygrokf.masks import mask_frozen, mask_out_of_range, mask_saturated
from hygrokf.psychrometrics import absolute_humidity, absolute_humidity_from_dew_point
from hygrokf.record import Record, Series
from hygrokf.signals import difference_from_si, from_si, signal_named
from hygrokf.stamps import duration_text, modal_step, stamp_text
from hygrokf.weather.alignment import FEWEST_D
from hygrokf.weather.clocks import (
    NOT_COMPARED,
    ClockError,
    alignments,
    clock_errors,
    clock_sentences,
    comparison_rows,
    described,
)

_DAY = 86400.0
_GAP_STEPS = 3.0
_SHORT_RECORD_D = 14.0
_SHORT_VALIDATION_D = 7.0
_SOLAR_LAG_MIN = 20.0
_FEWEST_IN_COMMON = 20


def mask(record: Record) -> Record:
    """Record in which everything that can be masked safely is, said in its warnings.

    record: any, SI units. Readings out of the physical range, repeats of a frozen sensor and
    saturated cabinet humidity become missing, in this order; see `hygrokf.masks` for each rule.
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
    and `validation` (`start`, `end`, `days`, or None), `signals` (one dictionary each), `comparisons` (of sources
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
        "comparisons": described(clocks),
        "warnings": list(record.warnings),
        "doubts": list(all_doubts(record, clocks)),
        "files": [{"file": file, "sha256": digest} for file, digest in record.provenance],
    }


def all_doubts(record: Record, clocks: Sequence[ClockError] | None = None) -> tuple[str, ...]:
    """The `doubts` about a record, and before them those of the sources that are compared.

    record: any. clocks: errors of clocks, where they are known already.
    """
    if clocks is None:
        clocks = clock_errors(alignments(record))
    south = record.site is not None and record.site.latitude_deg < 0.0
    return (*clock_sentences(clocks, south), *_uncompared(record, clocks), *doubts(record))


def _uncompared(record: Record, clocks: Sequence[ClockError]) -> list[str]:
    """Files that are there to be compared, and have too little time in common with what is used."""
    done = {one.signal for error in clocks for one in error.alignments}
    apart = [one for one in record.compared if one.signal in record and one.signal not in done]
    apart = [one for one in apart if one.signal not in NOT_COMPARED]
    files: dict[str, list[str]] = {}
    for one in apart:
        files.setdefault(one.source.split(", column")[0], []).append(one.signal)
    return [
        f"{file} cannot be compared ({', '.join(signals)}): fewer than {FEWEST_D:g} days in common with the source that is used"
        for file, signals in files.items()
    ]


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


def doubts(record: Record) -> tuple[str, ...]:
    """What a sceptic would ask about a record, one sentence each; none of it is a fault.

    record: any.
    """
    return (
        *_doubts_of_periods(record),
        *_doubts_of_power(record),
        *_doubts_of_climate(record),
        *_doubts_of_clocks(record),
    )


def _doubts_of_periods(record: Record) -> list[str]:
    said = []
    days = (record.end_s - record.start_s) / _DAY
    if not days >= _SHORT_RECORD_D:
        said.append(
            f"short record: {days:.1f} days; below {_SHORT_RECORD_D:.0f} days weather and "
            "operation hardly vary, and bounds will be wide"
        )
    if record.until_s is None:
        said.append(
            "no validation period: every score will be one on the data that were fitted; state "
            "[identification] until"
        )
    else:
        for name, part in (
            ("identification", record.identification()),
            ("validation", record.validation()),
        ):
            length = (part.end_s - part.start_s) / _DAY
            if not length >= _SHORT_VALIDATION_D:
                said.append(f"short {name} period: {length:.1f} days")
    return said


def _doubts_of_power(record: Record) -> list[str]:
    if "active_power" not in record:
        return ["no active power: the whole record counts as standstill"]
    power = record["active_power"]
    there = power.value[~power.missing]
    if not len(there):
        return ["active power has no reading: the whole record counts as standstill"]
    said = []
    standstill = float(np.mean(there <= 0.0))
    if np.median(there) < 0.0 and -there.min() > 2.0 * max(there.max(), 0.0):
        said.append(
            f"active power is negative for {100 * standstill:.0f} % of its readings and hardly "
            "ever positive: is the sign turned round (feeding in is positive)?"
        )
    elif standstill < 0.01:
        said.append(
            f"no standstill: {100 * standstill:.1f} % of the power readings are ≤ 0, so standstill "
            "cannot be identified apart from operation"
        )
    elif standstill > 0.9:
        said.append(f"hardly any operation: {100 * standstill:.0f} % of the power readings are ≤ 0")
    if record.rated_power_W is None:
        said.append("no rated power: stationary periods cannot be found; state rated_power_kW")
    elif 0.0 < there.max() < 0.3 * record.rated_power_W:
        share = 100.0 * there.max() / record.rated_power_W
        said.append(f"active power never exceeds {share:.0f} % of the rated power: right unit?")
    for signal in record.signals:
        if signal.startswith("cabinet_") and len(record[signal]):
            covered = _covered(record[signal], power)
            if covered < 0.5:
                said.append(f"active power covers only {100 * covered:.0f} % of the period of {signal}")
            break
    return said


def _covered(series: Series, other: Series) -> float:
    """Share of the readings of a series that lie within the span of another [-]."""
    inside = (series.time >= other.time[0] - other.interval_s) & (series.time <= other.time[-1])
    return float(np.mean(inside))


def _doubts_of_climate(record: Record) -> list[str]:
    said = []
    humid = any(f"cabinet_{kind}" in record for kind in _HUMIDITIES)
    if "cabinet_temperature" not in record and not humid:
        said.append("no cabinet signal: nothing can be identified or scored")
    elif "cabinet_temperature" not in record:
        said.append("no cabinet temperature: the thermal model cannot be identified")
    elif not humid:
        said.append("no cabinet humidity: only the thermal model can be identified")
    if humid and not any(f"ambient_{kind}" in record for kind in _HUMIDITIES):
        said.append("no ambient humidity: the hygric model has no input")
    for signal in record.signals:
        one = record[signal]
        if one.missing.mean() > 0.3:
            said.append(f"{signal}: {100 * one.missing.mean():.0f} % of its readings are missing")
    if "ambient_temperature" in record:
        step, _ = modal_step(record["ambient_temperature"].time)
        if step >= 3600.0:
            said.append(
                f"ambient temperature every {duration_text(step)} only: how fast the cabinet "
                "follows it (rho) will hardly be resolved"
            )
        if "cabinet_temperature" in record:
            pair = _pair(
                _present(record["cabinet_temperature"]),
                _present(record["ambient_temperature"]),
            )
            if pair is not None and np.mean(pair[0] - pair[1]) < -2.0:
                colder = np.mean(pair[1] - pair[0])
                said.append(
                    f"the cabinet is {colder:.1f} K colder than outside on average: are the "
                    "columns exchanged?"
                )
    for kind in ("temperature", *_HUMIDITIES):
        if f"cabinet_{kind}" in record and f"ambient_{kind}" in record:
            inside, outside = record[f"cabinet_{kind}"], record[f"ambient_{kind}"]
            if _same_readings(inside, outside):
                said.append(
                    f"{inside.signal} and {outside.signal} are the same readings ({inside.source}; {outside.source}): "
                    "one of the two columns is wrong"
                )
    pair = _pair(_vapour_density(record, "cabinet"), _vapour_density(record, "ambient"))
    if pair is not None and len(pair[0]):
        factor = float(np.mean(pair[0]) / np.mean(pair[1]))
        if not 0.7 <= factor <= 1.3:
            said.append(
                f"absolute humidity in the cabinet is {factor:.2f} times that outside on average: "
                "a source or sink of vapour, a sensor error, or the wrong column"
            )
    return said


def _same_readings(one: Series, other: Series) -> bool:
    """Whether two series that vary agree to rounding at nearly every time which both have."""
    _, i, j = np.intersect1d(one.time, other.time, return_indices=True)
    there = ~(one.missing[i] | other.missing[j])
    first, second = one.value[i][there], other.value[j][there]
    if len(first) < _FEWEST_IN_COMMON or not np.ptp(first) > 0.0:
        return False
    return bool(np.mean(np.isclose(first, second, rtol=1e-9, atol=0.0)) > 0.99)


_HUMIDITIES = ("relative_humidity", "absolute_humidity", "dew_point_temperature")


def _present(series: Series) -> tuple[np.ndarray, np.ndarray]:
    there = ~series.missing
    # A mean stands for the middle of its interval.
    return series.time[there] - 0.5 * series.interval_s, series.value[there]


def _vapour_density(record: Record, place: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Times [s] and absolute humidity [kg/m3] of a place, from whatever humidity there is."""
    if f"{place}_absolute_humidity" in record:
        return _present(record[f"{place}_absolute_humidity"])
    if f"{place}_temperature" not in record:
        return None
    time, temperature = _present(record[f"{place}_temperature"])
    for kind, convert in (
        ("relative_humidity", absolute_humidity),
        ("dew_point_temperature", absolute_humidity_from_dew_point),
    ):
        if f"{place}_{kind}" in record:
            when, value = _present(record[f"{place}_{kind}"])
            if not (len(time) and len(when)):
                return None
            density = convert(value, np.interp(when, time, temperature))
            good = np.isfinite(density)
            return when[good], density[good]
    return None


def _pair(
    one: tuple[np.ndarray, np.ndarray] | None,
    other: tuple[np.ndarray, np.ndarray] | None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Values of one and, at the same times, of the other, over their common span."""
    if one is None or other is None or not (len(one[0]) and len(other[0])):
        return None
    common = (one[0] >= other[0][0]) & (one[0] <= other[0][-1])
    if not common.any():
        return None
    return one[1][common], np.interp(one[0][common], *other)


def _doubts_of_clocks(record: Record) -> list[str]:
    said = []
    irregular: dict[str, list[str]] = {}
    for series in record.series:
        step, regular = modal_step(series.time)
        if len(series) > 2 and regular < 0.9:
            source = series.source.split(", column")[0] or series.signal
            text = f"{100 * regular:.0f} % of the steps are {duration_text(step)}"
            irregular.setdefault(f"irregular steps in {source}: only {text}", []).append(series.signal)
    said += list(irregular)
    if record.site is not None and "global_horizontal_irradiance" in record:
        lag = _solar_lag(record["global_horizontal_irradiance"], record.site.longitude_deg)
        if lag is not None and abs(lag) > _SOLAR_LAG_MIN * 60.0:
            direction = "after" if lag > 0 else "before"
            said.append(
                f"the sun's radiation is centred {abs(lag) / 60:.0f} min {direction} solar noon at "
                "the site: wrong zone, wrong stamp (start, middle, end) or wrong longitude?"
            )
    return said


def _solar_lag(irradiance: Series, longitude_deg: float) -> float | None:
    """Mean time from solar noon to the middle of a day's radiation [s]; None below 20 days.

    The equation of time is the usual three-term one, good to a minute.
    """
    time, value = _present(irradiance)
    step, _ = modal_step(irradiance.time)
    if not (len(time) > 100 and step <= 3600.0):
        return None
    day_of_year = np.mod(time / _DAY, 365.2425)
    angle = 2.0 * math.pi * (day_of_year - 80.0) / 365.2425
    equation_min = 9.87 * np.sin(2 * angle) - 7.53 * np.cos(angle) - 1.5 * np.sin(angle)
    solar = time + 240.0 * longitude_deg + 60.0 * equation_min
    day = np.floor(solar / _DAY)
    hour_angle = solar - (day + 0.5) * _DAY
    first = day - day.min()
    number = np.bincount(first.astype(int))
    energy = np.bincount(first.astype(int), weights=np.fmax(value, 0.0))
    moment = np.bincount(first.astype(int), weights=np.fmax(value, 0.0) * hour_angle)
    whole = (number >= 0.95 * _DAY / step) & (energy > 0.0)
    whole &= energy > 0.2 * np.median(energy[whole]) if whole.any() else False
    if whole.sum() < 20:
        return None
    return float(np.median(moment[whole] / energy[whole]))


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
    rows = [(*head, "mean (lowest … highest)")]
    rows += [_row(one) for one in description["signals"]]
    lines += ["", *_table(rows, right=(1, 2, 3, 4, 5, 7))]
    rows = [("signal", "from", "to", "clock", "source")]
    for one in description["signals"]:
        clock = f"±{duration_text(one['clock_uncertainty_s'])}"
        clock = clock if one["clock_uncertainty_s"] else "-"
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
