"""Texts for the terminal: the summary of a record (`hygrokf check`), and a drafted case (`hygrokf init`)."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator
from typing import TYPE_CHECKING

from hygrokf.cases.summary import RecordSummary, SignalSummary
from hygrokf.data.record import Provenance
from hygrokf.data.signals import difference_from_si, signal_named
from hygrokf.data.timestamps import MINUTE_S
from hygrokf.report.blocks import Block, Heading, Items, Prose, Table
from hygrokf.report.quantities import interval, place
from hygrokf.report.terminal import blocks_text
from hygrokf.texts.wording import duration_text
from hygrokf.weather.clock_comparison import Alignment, Lag

if TYPE_CHECKING:
    from hygrokf.drafting.draft import Draft
    from hygrokf.drafting.mapping import DraftedSignal

NO_ENTRY = "-"
UNCUT_WIDTH = 1000
"""[columns] wider than any line, so that long paths of files are not wrapped."""


def describe_text(summary: RecordSummary) -> str:
    """Return the summary of a record as text."""
    return "\n\n".join(blocks_text(record_blocks(summary), UNCUT_WIDTH))


def record_blocks(summary: RecordSummary) -> Iterator[Block]:
    """Yield a record's summary: periods, signals, sources, comparisons, actuators, and doubts."""
    yield Prose(_heading(summary))
    periods = (("identification", summary.identification), ("validation", summary.validation))
    spans = (
        "none" if period is None else f"{period.start} to {period.end}, {period.days:.1f} d"
        for _, period in periods
    )
    yield Items(tuple(f"{name}: {span}" for (name, _), span in zip(periods, spans, strict=True)))
    if summary.signals:
        head: tuple[str, ...] = ("signal", "readings", "missing", "step", "gaps", "longest", "hold")
        columns = (*head, "resolution", "mean (lowest … highest)")
        yield Table("", columns, tuple(map(_signal, summary.signals)), left=(0, 6, 8))
        yield _sources(summary)
    if summary.comparisons:  # lags are minutes by the weather, positive where the first source is late
        head = ("compared", "source", "against", "offset", "lag in winter", "lag in summer", "daily wave")
        alignments = (alignment for error in summary.comparisons for alignment in error.alignments)
        yield Table("", head, tuple(map(_comparison, alignments)), left=(0, 1, 2, 4, 5))
    if summary.actuators:
        yield Heading("logged actuators", 3)
        yield Items(tuple(map(str, summary.actuators)))
    for title, statements in (("warnings", summary.warnings), ("doubts", summary.doubts)):
        yield Heading(f"{title}: {len(statements) or 'none'}", 3)
        if statements:
            yield Items(tuple(map(str, statements)))
    if summary.untold:
        yield Heading("what the record cannot tell", 3)
        yield Items(tuple(map(str, summary.untold)))


def _heading(summary: RecordSummary) -> str:
    """Return name, span, provenance, rated power and place of a record in one line."""
    parts = [f"{summary.name}: {summary.start} to {summary.end}", f"{summary.days:.1f} d"]
    if summary.provenance is not Provenance.MEASURED:
        parts.append(summary.provenance)
    if math.isfinite(summary.rated_power_kW):
        parts.append(f"rated {summary.rated_power_kW:g} kW")
    if summary.site is not None:
        parts.append(" ".join(place(summary.site, "{:g}".format)))
    return ", ".join(parts)


def _signal(signal: SignalSummary) -> tuple[str, ...]:
    """Return the row of a signal: counts, steps, gaps, hold, resolution and values."""
    unit = "" if signal.unit == "1" else f" {signal.unit}"
    step_unit = " K" if signal.unit == "degC" else unit
    hold = f"{signal.hold} {duration_text(signal.interval_s)}" if signal.interval_s else signal.hold
    values = f"{signal.mean:.4g} ({interval(signal.minimum, signal.maximum, '{:.4g}'.format)}){unit}"
    return (
        signal.signal,
        str(signal.readings),
        f"{100 * signal.missing_share:.1f} %" if math.isfinite(signal.missing_share) else NO_ENTRY,
        duration_text(signal.step_s) if math.isfinite(signal.step_s) else NO_ENTRY,
        str(signal.gaps),
        duration_text(signal.longest_gap_s) if signal.gaps else NO_ENTRY,
        hold,
        f"{signal.resolution:g}{step_unit}" if signal.resolution > 0.0 else NO_ENTRY,
        values if math.isfinite(signal.mean) else NO_ENTRY,
    )


def _sources(summary: RecordSummary) -> Table:
    """Return the table of the signals' sources with their spans and the uncertainty of their clocks."""
    rows = tuple(
        (
            signal.signal,
            signal.start or NO_ENTRY,
            signal.end or NO_ENTRY,
            f"±{duration_text(signal.clock_uncertainty_s)}" if signal.clock_uncertainty_s > 0.0 else NO_ENTRY,
            signal.source,
        )
        for signal in summary.signals
    )
    return Table("", ("signal", "from", "to", "clock", "source"), rows, left=(0, 1, 2, 3, 4))


def _comparison(alignment: Alignment) -> tuple[str, ...]:
    """Return the row that compares one source of a signal with another one."""
    signal = signal_named(alignment.signal)
    unit = "K" if signal.display == "degC" else signal.display
    offset = f"{difference_from_si(alignment.offset.value, signal.display, signal):+.2g} {unit}".rstrip(" 1")
    other = alignment.other_amplitude
    wave = f"{100 * alignment.amplitude / other:.0f} %" if other else NO_ENTRY
    lags = (_lag(season or alignment.whole) for season in (alignment.winter, alignment.summer))
    return (alignment.signal, alignment.one, alignment.other, offset, *lags, wave)


def _lag(lag: Lag) -> str:
    """Return a lag with its bounds in minutes."""
    if not lag.weather.known:
        return NO_ENTRY
    value, low, high = (
        seconds / MINUTE_S for seconds in (lag.weather.value, lag.weather.low, lag.weather.high)
    )
    return f"{value:+.0f} min ({interval(low, high, '{:+.0f}'.format)})"


# --- a drafted case --------------------------------------------------------------------------


def draft_text(draft: Draft) -> str:
    """Return a drafted case as text."""
    return "\n\n".join(blocks_text(draft_blocks(draft), UNCUT_WIDTH))


def draft_blocks(draft: Draft) -> Iterator[Block]:
    """Yield a drafted case: its signals with their columns, its doubts, and the next command."""
    if draft.signals:
        head = ("signal", "column", "unit", "file", "score", "in the case as")
        rows = tuple(
            (signal.signal, signal.column, signal.unit, signal.file, f"{signal.score:.2f}", _state(signal))
            for signal in draft.signals
        )
        yield Table("signals", head, rows, left=(0, 1, 2, 3, 5))
    if draft.lacks:
        yield Heading(f"not found: {len(draft.lacks)}", 3)
        yield Items(draft.lacks)
    doubts = (
        *draft.doubts,
        *(f"{signal.signal}: {doubt}" for signal in draft.signals for doubt in signal.doubts),
    )
    yield Heading(f"doubts: {len(doubts) or 'none'}", 3)
    if doubts:
        yield Items(doubts)
    for copy in draft.copies:
        yield Prose(f"copy of a table, in a form that a case can name: {copy}")
    yield Prose(f"case file: {draft.case}, {len(draft.left)} columns not used")
    yield Prose(f"next: hygrokf check {shlex.quote(draft.case)}")


def _state(signal: DraftedSignal) -> str:
    """How the draft writes a signal: as a comment, to be compared, or as a signal; maybe to be confirmed."""
    if not signal.active:
        return "comment"
    return ("compared" if signal.compare else "signal") + (", to confirm" if signal.doubts else "")
