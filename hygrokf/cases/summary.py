"""The summary of a record: readings, gaps, clocks, warnings, doubts."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.cases.alternatives import alternative_readings
from hygrokf.cases.doubts import all_doubts
from hygrokf.data.actuators import actuators
from hygrokf.data.prepared import prepare
from hygrokf.data.record import Provenance, Record, Series, Site
from hygrokf.data.result_file import units_by_name, with_units
from hygrokf.data.signals import difference_from_si, from_si, signal_named
from hygrokf.data.timestamps import DAY_S, modal_step
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Digest, Instant, Name, ReaderText, Source, Unit
from hygrokf.texts.wording import stamp_text
from hygrokf.weather.clock_comparison import ClockError, alignments, clock_errors

if TYPE_CHECKING:
    import pandas

_GAP_STEPS = 3.0


@dataclass(frozen=True)
class Span:
    """First and last stamp (UTC), None without readings, and length [d]."""

    start: Instant | None
    end: Instant | None
    days: float


@dataclass(frozen=True)
class SignalSummary:
    """One signal of a record: its stamps, gaps and values.

    `days` [d] from `start` to `end` (UTC).  `missing_share` [1] of the readings expected from the usual step
    `step_s` [s]. `clock_uncertainty_s`, `interval_s` [s]: as stated.  `gaps`: longer than three steps.
    `minimum`, `mean`, `maximum`, `resolution`, `accuracy`: in `unit`.  Unknown numbers are NaN.
    """

    signal: Name
    source: Source
    start: Instant | None
    end: Instant | None
    days: float
    readings: int
    missing_share: float
    step_s: float
    clock_uncertainty_s: float
    gaps: int
    longest_gap_s: float
    hold: Name
    interval_s: float
    unit: Unit
    resolution: float
    accuracy: float
    minimum: float
    mean: float
    maximum: float


@dataclass(frozen=True)
class RecordSummary:
    """The contents of a record, as `hygrokf check` shows them.

    `provenance`: of the readings.  `days` [d] from `start` to `end` (UTC).  `rated_power_kW`: NaN if it is
        not stated.
    `identification`, `validation`: None if they are empty.
    `actuators`: whether and how a model uses each logged actuator.
    `comparisons`: of sources for the same signal.  `untold`: what the record cannot show about its clocks.
    `files`: names and SHA-256 of the files that were read.
    """

    name: Name
    provenance: Provenance
    start: Instant | None
    end: Instant | None
    days: float
    site: Site | None
    rated_power_kW: float
    identification: Span | None
    validation: Span | None
    signals: tuple[SignalSummary, ...]
    actuators: tuple[Statement, ...]
    comparisons: tuple[ClockError, ...]
    warnings: tuple[ReaderText, ...]
    doubts: tuple[Statement, ...]
    untold: tuple[Statement, ...]
    files: tuple[tuple[Source, Digest], ...]

    def to_frame(self) -> pandas.DataFrame:
        """Return a pandas frame with a row for each signal and stamps in UTC.

        The column `unit` is the unit of the readings; `attrs["units"]` holds those of the other columns.
        """
        import pandas as pd

        columns = [field.name for field in fields(SignalSummary)]
        frame = pd.DataFrame([asdict(summary) for summary in self.signals], columns=columns)
        units = {**units_by_name(columns), "days": "d"}
        return with_units(frame.set_index("signal"), units, ("start", "end"))


def describe(record: Record) -> RecordSummary:
    """Return the summary of a record for `hygrokf check`: spans, steps, gaps, clocks, doubts."""
    record = prepare(record)
    clocks, alternatives = clock_errors(alignments(record)), alternative_readings(record)
    span = _span(record.start_s, record.end_s)
    return RecordSummary(
        record.name,
        record.provenance,
        span.start,
        span.end,
        span.days,
        record.site,
        math.nan if record.rated_power_W is None else record.rated_power_W / 1e3,
        _period_of(record.identification()),
        _period_of(record.validation()),
        tuple(_describe_series(series) for series in record.series),
        tuple(actuator.statement for actuator in actuators(record.identification())),
        clocks,
        record.warnings,
        all_doubts(record, clocks, alternatives),
        alternatives.untold,
        record.files,
    )


def _span(start_s: float, end_s: float) -> Span:
    """Return the span between two times [s]; an empty one if they are not finite."""
    if not math.isfinite(start_s):
        return Span(None, None, 0.0)
    return Span(stamp_text(start_s), stamp_text(end_s), round((end_s - start_s) / DAY_S, 3))


def _period_of(record: Record) -> Span | None:
    """Return the span of a record; None without series."""
    return _span(record.start_s, record.end_s) if record.series else None


def _number(value: float | None, digits: int = 6) -> float:
    """Return a number rounded to significant digits; NaN where it is unknown."""
    if value is None or not math.isfinite(value):
        return math.nan
    return float(f"{value:.{digits}g}")


def _describe_series(series: Series) -> SignalSummary:
    """Return the summary of one series: stamps, gaps and values."""
    signal_row = signal_named(series.signal)
    step_s, regular_share = modal_step(series.time)
    readings = series.value[~series.missing]
    known_times = series.time[~series.missing]
    expected_count = len(series)
    if math.isfinite(step_s) and regular_share > 0.5:
        expected_count = max(expected_count, round((series.time[-1] - series.time[0]) / step_s) + 1)
    steps_s = np.diff(known_times)
    is_gap = steps_s > (_GAP_STEPS + 0.01) * step_s if math.isfinite(step_s) else np.zeros(0, dtype=bool)
    longest_step_index = int(np.argmax(steps_s)) if len(steps_s) else None
    shown_values = from_si(readings, signal_row.display, signal_row)
    accuracy = signal_row.default_accuracy if series.accuracy is None else series.accuracy
    span = _span(series.time[0], series.time[-1]) if len(series) else _span(math.nan, math.nan)
    return SignalSummary(
        signal=series.signal,
        source=series.source,
        start=span.start,
        end=span.end,
        days=span.days,
        readings=len(readings),
        missing_share=_number(1.0 - len(readings) / expected_count if expected_count else math.nan),
        step_s=_number(step_s),
        clock_uncertainty_s=_number(series.clock_uncertainty_s),
        gaps=int(is_gap.sum()),
        longest_gap_s=math.nan if longest_step_index is None else _number(steps_s[longest_step_index]),
        hold=series.hold,
        interval_s=series.interval_s,
        unit=signal_row.display,
        resolution=_number(difference_from_si(series.resolution, signal_row.display, signal_row), 4),
        accuracy=math.nan
        if accuracy is None
        else _number(difference_from_si(accuracy, signal_row.display, signal_row), 4),
        minimum=_number(shown_values.min() if len(shown_values) else None),
        mean=_number(shown_values.mean() if len(shown_values) else None),
        maximum=_number(shown_values.max() if len(shown_values) else None),
    )
