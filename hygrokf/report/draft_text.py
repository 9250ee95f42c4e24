"""The summary of a drafted case as text, for `hygrokf init`."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from hygrokf.drafting.draft import Draft, DraftedSignal
from hygrokf.report.blocks import Block, Heading, Items, Prose, Table
from hygrokf.report.record_text import WIDTH
from hygrokf.report.terminal import blocks_text


def draft_text(found: Draft) -> str:
    """A draft as tables for the terminal."""
    return "\n\n".join(blocks_text(draft_blocks(found), WIDTH))


def draft_blocks(found: Draft) -> Iterator[Block]:
    """What a draft says: signals with their columns, doubts, and the next command."""
    if found.signals:
        head = ("signal", "column", "unit", "file", "score", "in the case as")
        rows = tuple(
            (one.signal, one.column, one.unit, one.file, f"{one.score:.2f}", _state(one))
            for one in found.signals
        )
        yield Table("signals", head, rows, left=(0, 1, 2, 3, 5))
    if found.lacks:
        yield Heading(f"not found: {len(found.lacks)}", 3)
        yield Items(found.lacks)
    doubts = (*found.doubts, *(f"{one.signal}: {doubt}" for one in found.signals for doubt in one.doubts))
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
