"""The summary of a record as text, for `hygrokf check`, and that of a drafted case, for `hygrokf init`."""

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
"""Lines are not cut: the paths of files may be long."""


def describe_text(found: RecordSummary) -> str:
    """A summary as tables for the terminal."""
    return "\n\n".join(blocks_text(record_blocks(found), UNCUT_WIDTH))


def record_blocks(found: RecordSummary) -> Iterator[Block]:
    """What a summary says: spans, signals, sources, comparisons, actuators, warnings and doubts."""
    yield Prose(_heading(found))
    periods = (("identification", found.identification), ("validation", found.validation))
    spans = (
        "none" if period is None else f"{period.start} to {period.end}, {period.days:.1f} d"
        for _, period in periods
    )
    yield Items(tuple(f"{name}: {span}" for (name, _), span in zip(periods, spans, strict=True)))
    if found.signals:
        head: tuple[str, ...] = ("signal", "readings", "missing", "step", "gaps", "longest", "hold")
        columns = (*head, "resolution", "mean (lowest … highest)")
        yield Table("", columns, tuple(map(_signal, found.signals)), left=(0, 6, 8))
        yield _sources(found)
    if found.comparisons:  # lags are minutes by the weather, positive where the first source is late
        head = ("compared", "source", "against", "offset", "lag in winter", "lag in summer", "daily wave")
        rows = tuple(_comparison(alignment) for error in found.comparisons for alignment in error.alignments)
        yield Table("", head, rows, left=(0, 1, 2, 4, 5))
    if found.actuators:
        yield Heading("logged actuators", 3)
        yield Items(tuple(map(str, found.actuators)))
    for title, said in (("warnings", found.warnings), ("doubts", found.doubts)):
        yield Heading(f"{title}: {len(said) or 'none'}", 3)
        if said:
            yield Items(tuple(map(str, said)))
    if found.untold:
        yield Heading("what the record cannot tell", 3)
        yield Items(tuple(map(str, found.untold)))


def _heading(found: RecordSummary) -> str:
    parts = [f"{found.name}: {found.start} to {found.end}", f"{found.days:.1f} d"]
    if found.provenance is not Provenance.MEASURED:
        parts.append(found.provenance)
    if math.isfinite(found.rated_power_kW):
        parts.append(f"rated {found.rated_power_kW:g} kW")
    if found.site is not None:
        parts.append(" ".join(place(found.site, "{:g}".format)))
    return ", ".join(parts)


def _signal(one: SignalSummary) -> tuple[str, ...]:
    unit = "" if one.unit == "1" else f" {one.unit}"
    step_unit = " K" if one.unit == "degC" else unit
    hold = f"{one.hold} {duration_text(one.interval_s)}" if one.interval_s else one.hold
    values = f"{one.mean:.4g} ({interval(one.minimum, one.maximum, '{:.4g}'.format)}){unit}"
    return (
        one.signal,
        str(one.readings),
        f"{100 * one.missing_share:.1f} %" if math.isfinite(one.missing_share) else NO_ENTRY,
        duration_text(one.step_s) if math.isfinite(one.step_s) else NO_ENTRY,
        str(one.gaps),
        duration_text(one.longest_gap_s) if one.gaps else NO_ENTRY,
        hold,
        f"{one.resolution:g}{step_unit}" if one.resolution > 0.0 else NO_ENTRY,
        values if math.isfinite(one.mean) else NO_ENTRY,
    )


def _sources(found: RecordSummary) -> Table:
    rows = tuple(
        (
            signal.signal,
            signal.start or NO_ENTRY,
            signal.end or NO_ENTRY,
            f"±{duration_text(signal.clock_uncertainty_s)}" if signal.clock_uncertainty_s > 0.0 else NO_ENTRY,
            signal.source,
        )
        for signal in found.signals
    )
    return Table("", ("signal", "from", "to", "clock", "source"), rows, left=(0, 1, 2, 3, 4))


def _comparison(one: Alignment) -> tuple[str, ...]:
    signal = signal_named(one.signal)
    unit = "K" if signal.display == "degC" else signal.display
    offset = f"{difference_from_si(one.offset.value, signal.display, signal):+.2g} {unit}".rstrip(" 1")
    wave = f"{100 * one.amplitude / one.other_amplitude:.0f} %" if one.other_amplitude else NO_ENTRY
    lags = (_lag(season or one.whole) for season in (one.winter, one.summer))
    return (one.signal, one.one, one.other, offset, *lags, wave)


def _lag(lag: Lag) -> str:
    if not lag.weather.known:
        return NO_ENTRY
    value, low, high = (n / MINUTE_S for n in (lag.weather.value, lag.weather.low, lag.weather.high))
    return f"{value:+.0f} min ({interval(low, high, '{:+.0f}'.format)})"


# --- a drafted case --------------------------------------------------------------------------


def draft_text(found: Draft) -> str:
    """A draft as tables for the terminal."""
    return "\n\n".join(blocks_text(draft_blocks(found), UNCUT_WIDTH))


def draft_blocks(found: Draft) -> Iterator[Block]:
    """What a draft says: signals with their columns, doubts, and the next command."""
    if found.signals:
        head = ("signal", "column", "unit", "file", "score", "in the case as")
        rows = tuple(
            (signal.signal, signal.column, signal.unit, signal.file, f"{signal.score:.2f}", _state(signal))
            for signal in found.signals
        )
        yield Table("signals", head, rows, left=(0, 1, 2, 3, 5))
    if found.lacks:
        yield Heading(f"not found: {len(found.lacks)}", 3)
        yield Items(found.lacks)
    doubts = (
        *found.doubts,
        *(f"{signal.signal}: {doubt}" for signal in found.signals for doubt in signal.doubts),
    )
    yield Heading(f"doubts: {len(doubts) or 'none'}", 3)
    if doubts:
        yield Items(doubts)
    for copy in found.copies:
        yield Prose(f"copy of a table, in a form that a case can name: {copy}")
    yield Prose(f"case file: {found.case}, {len(found.left)} columns not used")
    yield Prose(f"next: hygrokf check {shlex.quote(found.case)}")


def _state(one: DraftedSignal) -> str:
    if not one.active:
        return "comment"
    return ("compared" if one.compare else "signal") + (", to confirm" if one.doubts else "")
