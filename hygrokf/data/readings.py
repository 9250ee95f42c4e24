"""Readings of a record: their order, their resolution, and which are masked, with a sentence for each."""

from __future__ import annotations

import dataclasses

import numpy as np

from hygrokf.data.gate import DEPARTED, FEWEST_FOR_SCALE, FROZEN, REACH_S, judge, resting, runs_of, scale_of
from hygrokf.data.record import Record, Series
from hygrokf.data.signals import in_words, signal_named
from hygrokf.data.timestamps import modal_step
from hygrokf.texts.record_codes import RecordCode
from hygrokf.texts.statement import Code, Statement
from hygrokf.texts.wording import duration_text, period_text, stamp_text

SATURATED = 0.995
"""[-] relative humidity from which a reading is censored: the sensor cannot show more."""
SHOWN_READINGS = 5
"""Number of outlying readings that a warning names."""
PILED = 5
"""Ratio of readings at the ceiling to readings below it from which they pile up."""
PILE_WIDTHS = (0.0, 0.005, 0.01, 0.015)
"""[-] ranges over which noise may spread the readings of saturated air."""


def mask(record: Record, within_range: bool = False) -> Record:
    """The record without readings that are certainly wrong, with warnings.

    record: any, SI units. Readings out of the physical range become missing and then, unless `within_range`,
    the readings that the gate excludes and saturated cabinet humidity.  Series for comparison are treated in
    the same way.
    """
    treatments = (mask_out_of_range,) if within_range else (mask_out_of_range, mask_gated, mask_saturated)
    warnings: list[str] = []

    def masked(series: Series) -> Series:
        for treat in treatments:
            series, sentences = treat(series)
            warnings.extend(sentences)
        return series

    series, compared = (tuple(map(masked, group)) for group in (record.series, record.compared))
    all_warnings = record.warnings + tuple(dict.fromkeys(warnings))
    return dataclasses.replace(record, series=series, compared=compared, warnings=all_warnings)


def order_readings(
    time: np.ndarray, values: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray], tuple[str, ...]]:
    """Readings sorted by time, one for each stamp, and warnings.

    time: [s] (N,) finite, in any order, repeats allowed.
    values: column -> (N,).

    Equal readings with the same stamp are kept once, and a present reading replaces a missing one.
    Contradicting readings are masked, since either may be correct.
    """
    warnings = []
    backward = np.diff(time) < 0.0
    if backward.any():
        first = int(np.argmax(backward))
        step_back = f"{stamp_text(time[first + 1])} after {stamp_text(time[first])}"
        order = np.argsort(time, kind="stable")
        time = time[order]
        values = {name: array[order] for name, array in values.items()}
        if backward.mean() > 0.9:
            warnings.append("unsorted stamps: newest first; reversed")
        else:
            warnings.append(
                f"unsorted stamps: {int(backward.sum())} of {len(time)} are earlier than the one "
                f"before, first {step_back}; sorted"
            )
    fresh = np.append(True, np.diff(time) > 0.0)
    if fresh.all():
        return time, values, tuple(warnings)
    starts = np.flatnonzero(fresh)
    counts = np.diff(np.append(starts, len(time)))
    repeated_stamps = time[starts][counts > 1]
    unique_values = {}
    contradictions = []
    for name, array in values.items():
        low = np.fmin.reduceat(array, starts)
        high = np.fmax.reduceat(array, starts)
        is_contradicting = low != high
        is_contradicting &= np.isfinite(low)
        unique_values[name] = np.where(is_contradicting, np.nan, low)
        if is_contradicting.any():
            contradictions.append(f"{name}: {int(is_contradicting.sum())}")
    sentence = (
        f"duplicate stamps: {len(repeated_stamps)} occur more than once "
        f"({period_text(repeated_stamps[0], repeated_stamps[-1])}); equal readings kept once"
    )
    if contradictions:
        sentence += f", contradicting ones masked ({', '.join(contradictions)})"
    return time[starts], unique_values, (*warnings, sentence)


def detect_resolution(values: np.ndarray) -> float:
    """Spacing of the grid on which readings lie, in their own unit; 0 where there is none.

    values: (N,) as in the file, before any conversion; NaN = missing.

    The coarsest of 1, 2, 2.5, 5 times a power of ten, and of the binary fractions of one, on whose
    multiples (shifted by any constant) 99 % of the readings lie. Sentinels and single-precision
    noise are tolerated. Fewer than five different readings give 0.
    """
    finite = values[np.isfinite(values)]
    if len(finite) > 5000:
        finite = finite[:: len(finite) // 5000]
    distinct, counts = np.unique(finite, return_counts=True)
    if len(distinct) < 5:
        return 0.0
    distance = np.abs(finite - distinct[np.argmax(counts)])
    noise = max(1e-9, 3e-7 * float(np.quantile(np.abs(finite), 0.95)))
    for spacing in _SPACINGS:
        deviation = np.abs(distance - spacing * np.round(distance / spacing))
        if noise <= 0.1 * spacing and np.mean(deviation <= noise) >= 0.99:
            return spacing
    return 0.0


_SPACINGS = tuple(
    sorted(
        {m * 10.0**e for e in range(-7, 4) for m in (1.0, 2.0, 2.5, 5.0)} | {2.0**-k for k in range(1, 9)},
        reverse=True,
    )
)


def out_of_range(series: Series) -> np.ndarray:
    """(T,) True where a reading lies outside of the signal's physical range."""
    row = signal_named(series.signal)
    slack = 1e-9 * (row.high - row.low)
    return (series.value < row.low - slack) | (series.value > row.high + slack)


def mask_out_of_range(series: Series) -> tuple[Series, tuple[str, ...]]:
    """Series without readings outside of the signal's physical range, and a warning.

    Catches -273 degC, -99, 9999, a relative humidity of 150 %.
    """
    is_outside = out_of_range(series)
    if not is_outside.any():
        return series, ()
    statement = range_statement(RecordCode.OUT_OF_RANGE_MASKED, series, is_outside)
    return _without(series, is_outside), (statement.text,)


def range_statement(code: Code, series: Series, outside: np.ndarray) -> Statement:
    """The statement about readings outside of the physical range; outside: (T,) True for these readings."""
    row, outside_values = signal_named(series.signal), np.unique(series.value[outside])
    moments = [float(moment) for moment in series.time[outside]]
    return code(
        signal=series.signal,
        label=_label(series),
        n=len(moments),
        low=in_words(row.low, row),
        high=in_words(row.high, row),
        examples=tuple(
            in_words(value, row) for value in dict.fromkeys((outside_values[0], outside_values[-1]))
        ),
        when=RecordCode.AT_TIMES(times=tuple(map(stamp_text, moments)))
        if len(moments) <= 3
        else RecordCode.BETWEEN(start=moments[0], end=moments[-1]),
    )


def mask_saturated(series: Series) -> tuple[Series, tuple[str, ...]]:
    """Series of a relative humidity with saturated readings treated, and a warning; others unchanged.

    A sensor at its ceiling is censored, which a Gaussian cannot represent. Cabinet humidity is an
    observation: readings of at least `SATURATED`, or at the sensor's own ceiling (the highest value
    of the record, at 95 % or more, where readings pile up), are masked. Humidity elsewhere is an
    input: outside air does saturate, so its readings are kept and limited to 1.
    """
    if not series.signal.endswith("_relative_humidity"):
        return series, ()
    if not series.signal.startswith("cabinet_"):
        above = series.value > 1.0 + 1e-9
        if not above.any():
            return series, ()
        sentence = (
            f"{_label(series)}: saturated humidity, {_readings(above)} above 100 % set to 100 % "
            f"({_period(series, above)})"
        )
        return dataclasses.replace(series, value=np.minimum(series.value, 1.0)), (sentence,)
    limit = min(SATURATED, _ceiling(series.value))
    saturated = series.value >= limit - 1e-9
    if not saturated.any():
        return series, ()
    step, _ = modal_step(series.time)
    hours = f", {duration_text(saturated.sum() * step)} in all" if np.isfinite(step) else ""
    sentence = (
        f"{_label(series)}: saturated humidity, {_readings(saturated)} of at least "
        f"{100.0 * limit:.4g} % masked{hours} ({_period(series, saturated)}); they are censored and "
        "excluded from the likelihood"
    )
    masked = dataclasses.replace(_without(series, saturated), saturated=int(saturated.sum()))
    return masked, (sentence,)


def _ceiling(humidity: np.ndarray) -> float:
    """The lowest of the readings that accumulate at the sensor's ceiling [-]; infinity if there are none.

    They accumulate at one value or, with sensor noise, in a narrow range: at least `PILED` times as many as
    in a range of the same width (at least 1 %) just below.
    """
    finite = humidity[np.isfinite(humidity)]
    if not len(finite) or finite.max() < 0.95:
        return np.inf
    top = float(finite.max())
    for width in PILE_WIDTHS:
        edge = top - width - 1e-9
        at_top = np.sum(finite >= edge)
        below = np.sum((finite >= edge - max(width, 0.01)) & (finite < edge))
        if at_top >= 20 and at_top > PILED * below:
            return top - width
    return np.inf


def mask_gated(series: Series) -> tuple[Series, tuple[str, ...]]:
    """Series without the readings that the gate excludes, and warnings that name them.

    The first reading of a frozen run is kept.  If more than half of the readings would be masked, the source
    generally repeats readings: no run is masked, and the warning says so.
    """
    row = signal_named(series.signal)
    present = np.flatnonzero(np.isfinite(series.value))
    time, value = series.time[present], series.value[present]
    if len(value) < FEWEST_FOR_SCALE or row.idle == (-np.inf, np.inf):
        return series, ()
    if value[0] == value.min() == value.max() and not resting(series.signal, value[:1], np.inf).any():
        reading = in_words(value[0], row)
        doubt = (
            f"all {len(value)} readings are {reading}: perhaps a frozen sensor; no other signal confirms this"
        )
        return series, (f"{_label(series)}: {doubt}",)
    scale = scale_of(series.signal, time, value, series.resolution)
    if scale is None:
        return series, ()
    verdict = judge(series.signal, time, value, scale, in_hindsight=True).verdict
    warnings = []
    is_masked = np.zeros(len(series), dtype=bool)
    if (departed := verdict == DEPARTED).any():
        is_masked[present[departed]] = True
        rows = present[departed]
        named = ", ".join(
            f"{in_words(series.value[i], row)} at {stamp_text(series.time[i])}" for i in rows[:SHOWN_READINGS]
        )
        more = f" and {len(rows) - SHOWN_READINGS} more" if len(rows) > SHOWN_READINGS else ""
        verb = "leaves its course and returns" if len(rows) == 1 else "leave their course and return"
        warnings.append(
            f"{_label(series)}: {_readings(departed)} that {verb} within {duration_text(REACH_S)} masked: "
            f"{named}{more}"
        )
    if (frozen := verdict == FROZEN).any():
        runs = _frozen_sentence(series, time, value, frozen)
        if frozen.sum() > 0.5 * len(value):
            doubt = f"perhaps a frozen sensor: {runs}; not masked, since these are more than half"
            warnings.append(f"{_label(series)}: {doubt} of the readings")
        else:
            is_masked[present[frozen]] = True
            warnings.append(f"{_label(series)}: frozen sensor, {runs}; {_readings(frozen)} masked")
    return (_without(series, is_masked) if is_masked.any() else series), tuple(warnings)


def _frozen_sentence(series: Series, time: np.ndarray, value: np.ndarray, frozen: np.ndarray) -> str:
    starts, lengths = runs_of(value)
    runs = np.flatnonzero(frozen[np.minimum(starts + 1, len(value) - 1)] & (lengths > 1))
    longest = runs[np.argmax(lengths[runs])]
    first, last = time[starts[longest]], time[starts[longest] + lengths[longest] - 1]
    return (
        f"{len(runs)} run{'s' if len(runs) > 1 else ''} of identical readings, the longest "
        f"{duration_text(last - first)} at {in_words(value[starts[longest]], signal_named(series.signal))} "
        f"({period_text(first, last)})"
    )


def _without(series: Series, where: np.ndarray) -> Series:
    return dataclasses.replace(series, value=np.where(where, np.nan, series.value))


def _label(series: Series) -> str:
    return f"{series.signal} ({series.source})" if series.source else series.signal


def _readings(where: np.ndarray) -> str:
    count = int(np.sum(where))
    return f"{count} reading{'s' if count != 1 else ''}"


def _period(series: Series, where: np.ndarray) -> str:
    moments = series.time[where]
    if len(moments) <= 3:
        return ", ".join(stamp_text(moment) for moment in moments)
    return f"between {stamp_text(moments[0])} and {stamp_text(moments[-1])}"
