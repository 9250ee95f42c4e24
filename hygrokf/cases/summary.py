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
from hygrokf.weather.clocks import ClockError, alignments, clock_errors

if TYPE_CHECKING:
    import pandas

_GAP_STEPS = 3.0


@dataclass(frozen=True)
class Span:
    """First and last stamp (UTC) and length [d]; no stamps where there is no reading."""

    start: Instant | None
    end: Instant | None
    days: float


@dataclass(frozen=True)
class SignalSummary:
    """One signal of a record: its stamps, gaps and values.

    `days` [d] from `start` to `end` (UTC); `missing_share` [1] of the readings expected from the usual step;
    `step_s` [s] the usual step; `clock_uncertainty_s`, `interval_s` [s] as stated; `gaps` longer than three
    steps; `minimum`, `mean`, `maximum`, `resolution` and `accuracy` in `unit`.  Unknown numbers are NaN.
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

    `provenance` of the readings; `days` [d] from `start` to `end` (UTC); `rated_power_kW` NaN where it is not
    stated; `identification` and
    `validation` None where they are empty; `actuators`: whether and how a model uses each that is logged;
    `comparisons` of sources for the same signal; `untold`: what the record cannot tell of its clocks;
    `files`: that it was read from, with their SHA-256.
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
        """One row a signal, stamps as times in UTC; `unit` is that of the readings, further units are in
        `attrs["units"]`."""
        import pandas as pd

        columns = [one.name for one in fields(SignalSummary)]
        frame = pd.DataFrame([asdict(one) for one in self.signals], columns=columns)
        units = {**units_by_name(columns), "days": "d"}
        return with_units(frame.set_index("signal"), units, ("start", "end"))


def describe(record: Record) -> RecordSummary:
    """The summary of a record for `hygrokf check`: spans, steps, gaps, clocks, doubts."""
    record = prepare(record)
    clocks, read = clock_errors(alignments(record)), alternative_readings(record)
    whole = _span(record.start_s, record.end_s)
    return RecordSummary(
        record.name,
        record.provenance,
        whole.start,
        whole.end,
        whole.days,
        record.site,
        math.nan if record.rated_power_W is None else record.rated_power_W / 1e3,
        _period_of(record.identification()),
        _period_of(record.validation()),
        tuple(_describe_series(series) for series in record.series),
        tuple(one.statement for one in actuators(record.identification())),
        clocks,
        record.warnings,
        all_doubts(record, clocks, read),
        read.untold,
        record.files,
    )


def _span(start_s: float, end_s: float) -> Span:
    if not math.isfinite(start_s):
        return Span(None, None, 0.0)
    return Span(stamp_text(start_s), stamp_text(end_s), round((end_s - start_s) / DAY_S, 3))


def _period_of(record: Record) -> Span | None:
    return _span(record.start_s, record.end_s) if record.series else None


def _number(value: float | None, digits: int = 6) -> float:
    """A number rounded to significant digits; NaN where it is unknown."""
    if value is None or not math.isfinite(value):
        return math.nan
    return float(f"{value:.{digits}g}")


def _describe_series(series: Series) -> SignalSummary:
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
    span = _span(series.time[0], series.time[-1]) if len(series) else _span(math.nan, math.nan)
    return SignalSummary(
        signal=series.signal,
        source=series.source,
        start=span.start,
        end=span.end,
        days=span.days,
        readings=len(there),
        missing_share=_number(1.0 - len(there) / expected if expected else math.nan),
        step_s=_number(step),
        clock_uncertainty_s=_number(series.clock_uncertainty_s),
        gaps=int(long.sum()),
        longest_gap_s=math.nan if widest is None else _number(gaps[widest]),
        hold=series.hold,
        interval_s=series.interval_s,
        unit=row.display,
        resolution=_number(difference_from_si(series.resolution, row.display, row), 4),
        accuracy=math.nan if accuracy is None else _number(difference_from_si(accuracy, row.display, row), 4),
        minimum=_number(shown.min() if len(shown) else None),
        mean=_number(shown.mean() if len(shown) else None),
        maximum=_number(shown.max() if len(shown) else None),
    )
