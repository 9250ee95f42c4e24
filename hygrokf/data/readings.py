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
"""Readings pile up at a ceiling if there are this many times as many as just below it."""
PILE_WIDTHS = (0.0, 0.005, 0.01, 0.015)
"""[-] widths of the ranges over which noise may spread readings of saturated air."""


def mask(record: Record, within_range: bool = False) -> Record:
    """Return the record without readings that are certainly wrong, with warnings.

    within_range: whether to remove only readings outside of the physical range; otherwise also those that the
        gate excludes and saturated cabinet humidity.  Series for comparison are treated in the same way.
    """
    treatments = (mask_out_of_range,) if within_range else (mask_out_of_range, mask_gated, mask_saturated)
    warnings: list[str] = []

    def masked(series: Series) -> Series:
        """Return a series after all treatments; their warnings are collected."""
        for treat in treatments:
            series, treatment_warnings = treat(series)
            warnings.extend(treatment_warnings)
        return series

    series, compared = (tuple(map(masked, group)) for group in (record.series, record.compared))
    all_warnings = record.warnings + tuple(dict.fromkeys(warnings))
    return dataclasses.replace(record, series=series, compared=compared, warnings=all_warnings)


def order_readings(
    time: np.ndarray, values: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray], tuple[str, ...]]:
    """Return readings sorted by time, one for each stamp, and warnings.

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
    is_new_stamp = np.append(True, np.diff(time) > 0.0)
    if is_new_stamp.all():
        return time, values, tuple(warnings)
    first_rows = np.flatnonzero(is_new_stamp)
    rows_per_stamp = np.diff(np.append(first_rows, len(time)))
    repeated_stamps = time[first_rows][rows_per_stamp > 1]
    unique_values = {}
    contradictions = []
    for name, array in values.items():
        lowest = np.fmin.reduceat(array, first_rows)
        highest = np.fmax.reduceat(array, first_rows)
        is_contradicting = lowest != highest
        is_contradicting &= np.isfinite(lowest)
        unique_values[name] = np.where(is_contradicting, np.nan, lowest)
        if is_contradicting.any():
            contradictions.append(f"{name}: {int(is_contradicting.sum())}")
    sentence = (
        f"duplicate stamps: {len(repeated_stamps)} occur more than once "
        f"({period_text(repeated_stamps[0], repeated_stamps[-1])}); equal readings kept once"
    )
    if contradictions:
        sentence += f", contradicting ones masked ({', '.join(contradictions)})"
    return time[first_rows], unique_values, (*warnings, sentence)


def detect_resolution(values: np.ndarray) -> float:
    """Return the spacing of the grid on which readings lie, in their own unit; 0 where there is none.

    values: (N,) as in the file, before any conversion; NaN = missing.

    The coarsest of 1, 2, 2.5, 5 times a power of ten, and of the binary fractions of one, on whose multiples
    (shifted by any constant) 99 % of the readings lie.  Sentinels and single-precision noise are tolerated.
    Fewer than five different readings give 0.
    """
    finite = values[np.isfinite(values)]
    if len(finite) > 5000:
        finite = finite[:: len(finite) // 5000]
    distinct, counts = np.unique(finite, return_counts=True)
    if len(distinct) < 5:
        return 0.0
    distances = np.abs(finite - distinct[np.argmax(counts)])
    tolerance = max(1e-9, 3e-7 * float(np.quantile(np.abs(finite), 0.95)))
    for spacing in _SPACINGS:
        deviations = np.abs(distances - spacing * np.round(distances / spacing))
        if tolerance <= 0.1 * spacing and np.mean(deviations <= tolerance) >= 0.99:
            return spacing
    return 0.0


_SPACINGS = tuple(
    sorted(
        {m * 10.0**e for e in range(-7, 4) for m in (1.0, 2.0, 2.5, 5.0)} | {2.0**-k for k in range(1, 9)},
        reverse=True,
    )
)


def out_of_range(series: Series) -> np.ndarray:
    """Return (T,) True where a reading lies outside of the signal's physical range."""
    row = signal_named(series.signal)
    slack = 1e-9 * (row.high - row.low)
    return (series.value < row.low - slack) | (series.value > row.high + slack)


def mask_out_of_range(series: Series) -> tuple[Series, tuple[str, ...]]:
    """Return a series without readings outside of the signal's physical range, and a warning.

    Catches -273 degC, -99, 9999, a relative humidity of 150 %.
    """
    is_outside = out_of_range(series)
    if not is_outside.any():
        return series, ()
    statement = range_statement(RecordCode.OUT_OF_RANGE_MASKED, series, is_outside)
    return _without(series, is_outside), (statement.text,)


def range_statement(code: Code, series: Series, outside: np.ndarray) -> Statement:
    """Return the statement about readings outside of the physical range.

    code: of the statement.  outside: (T,) True for these readings.
    """
    signal_row, outside_values = signal_named(series.signal), np.unique(series.value[outside])
    times_s = [float(moment) for moment in series.time[outside]]
    return code(
        signal=series.signal,
        label=_label(series),
        n=len(times_s),
        low=in_words(signal_row.low, signal_row),
        high=in_words(signal_row.high, signal_row),
        examples=tuple(
            in_words(value, signal_row) for value in dict.fromkeys((outside_values[0], outside_values[-1]))
        ),
        when=RecordCode.AT_TIMES(times=tuple(map(stamp_text, times_s)))
        if len(times_s) <= 3
        else RecordCode.BETWEEN(start=times_s[0], end=times_s[-1]),
    )


def mask_saturated(series: Series) -> tuple[Series, tuple[str, ...]]:
    """Return a series of a relative humidity with saturated readings treated, and a warning; others
    unchanged.

    A sensor at its ceiling is censored, which a Gaussian cannot represent.  Cabinet humidity is an
    observation: readings of at least `SATURATED`, or at the sensor's own ceiling (the highest value of the
    record, at 95 % or more, where readings pile up), are masked.  Humidity elsewhere is an input: outside air
    does saturate, so its readings are kept and limited to 1.
    """
    if not series.signal.endswith("_relative_humidity"):
        return series, ()
    if not series.signal.startswith("cabinet_"):
        is_above_1 = series.value > 1.0 + 1e-9
        if not is_above_1.any():
            return series, ()
        sentence = (
            f"{_label(series)}: saturated humidity, {_readings(is_above_1)} above 100 % set to 100 % "
            f"({_period(series, is_above_1)})"
        )
        return dataclasses.replace(series, value=np.minimum(series.value, 1.0)), (sentence,)
    ceiling = min(SATURATED, _ceiling(series.value))
    saturated = series.value >= ceiling - 1e-9
    if not saturated.any():
        return series, ()
    step_s, _ = modal_step(series.time)
    duration = f", {duration_text(saturated.sum() * step_s)} in all" if np.isfinite(step_s) else ""
    sentence = (
        f"{_label(series)}: saturated humidity, {_readings(saturated)} of at least "
        f"{100.0 * ceiling:.4g} % masked{duration} ({_period(series, saturated)}); the sensor "
        "cannot show more, so a fit does not use them"
    )
    masked = dataclasses.replace(_without(series, saturated), saturated=int(saturated.sum()))
    return masked, (sentence,)


def _ceiling(humidity: np.ndarray) -> float:
    """Return the lowest of the humidity readings that accumulate at the sensor's ceiling; infinity if there
    are none.

    They accumulate at one value or, with sensor noise, in a narrow range: at least `PILED` times as many as
    in a range of the same width (at least 1 %) just below.
    """
    finite = humidity[np.isfinite(humidity)]
    if not len(finite) or finite.max() < 0.95:
        return np.inf
    highest = float(finite.max())
    for width in PILE_WIDTHS:
        lower_edge = highest - width - 1e-9
        count_at_top = np.sum(finite >= lower_edge)
        count_below = np.sum((finite >= lower_edge - max(width, 0.01)) & (finite < lower_edge))
        if count_at_top >= 20 and count_at_top > PILED * count_below:
            return highest - width
    return np.inf


def mask_gated(series: Series) -> tuple[Series, tuple[str, ...]]:
    """Return a series without the readings that the gate excludes, and warnings that name them.

    The first reading of a frozen run is kept.  If more than half of the readings would be masked, the source
    generally repeats readings: no run is masked, and the warning says so.
    """
    signal_row = signal_named(series.signal)
    present = np.flatnonzero(np.isfinite(series.value))
    time, value = series.time[present], series.value[present]
    if len(value) < FEWEST_FOR_SCALE or signal_row.idle == (-np.inf, np.inf):
        return series, ()
    if value[0] == value.min() == value.max() and not resting(series.signal, value[:1], np.inf).any():
        reading = in_words(value[0], signal_row)
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
    if (is_departed := verdict == DEPARTED).any():
        is_masked[present[is_departed]] = True
        rows = present[is_departed]
        listed_readings = ", ".join(
            f"{in_words(series.value[i], signal_row)} at {stamp_text(series.time[i])}"
            for i in rows[:SHOWN_READINGS]
        )
        and_more = f" and {len(rows) - SHOWN_READINGS} more" if len(rows) > SHOWN_READINGS else ""
        verb = "leaves its course and returns" if len(rows) == 1 else "leave their course and return"
        warnings.append(
            f"{_label(series)}: {_readings(is_departed)} that {verb} within {duration_text(REACH_S)} masked: "
            f"{listed_readings}{and_more}"
        )
    if (is_frozen := verdict == FROZEN).any():
        runs_sentence = _frozen_sentence(series, time, value, is_frozen)
        if is_frozen.sum() > 0.5 * len(value):
            doubt = f"perhaps a frozen sensor: {runs_sentence}; not masked, since these are more than half"
            warnings.append(f"{_label(series)}: {doubt} of the readings")
        else:
            is_masked[present[is_frozen]] = True
            warnings.append(
                f"{_label(series)}: frozen sensor, {runs_sentence}; {_readings(is_frozen)} masked"
            )
    return (_without(series, is_masked) if is_masked.any() else series), tuple(warnings)


def _frozen_sentence(series: Series, time: np.ndarray, value: np.ndarray, frozen: np.ndarray) -> str:
    """Describe the runs of identical readings: their number, and the longest one."""
    starts, lengths = runs_of(value)
    frozen_runs = np.flatnonzero(frozen[np.minimum(starts + 1, len(value) - 1)] & (lengths > 1))
    longest_run = frozen_runs[np.argmax(lengths[frozen_runs])]
    start_s, end_s = time[starts[longest_run]], time[starts[longest_run] + lengths[longest_run] - 1]
    return (
        f"{len(frozen_runs)} run{'s' if len(frozen_runs) > 1 else ''} of identical readings, the longest "
        f"{duration_text(end_s - start_s)} at "
        f"{in_words(value[starts[longest_run]], signal_named(series.signal))} ({period_text(start_s, end_s)})"
    )


def _without(series: Series, where: np.ndarray) -> Series:
    """Return the series with NaN where `where` (T,) is True."""
    return dataclasses.replace(series, value=np.where(where, np.nan, series.value))


def _label(series: Series) -> str:
    """Return the name of a series for messages: its signal, with the source."""
    return f"{series.signal} ({series.source})" if series.source else series.signal


def _readings(where: np.ndarray) -> str:
    """Return the number of readings in words, such as "3 readings"."""
    count = int(np.sum(where))
    return f"{count} reading{'s' if count != 1 else ''}"


def _period(series: Series, where: np.ndarray) -> str:
    """Return when readings occur, in words: up to three times, else the first and the last."""
    moments = series.time[where]
    if len(moments) <= 3:
        return ", ".join(stamp_text(moment) for moment in moments)
    return f"between {stamp_text(moments[0])} and {stamp_text(moments[-1])}"
