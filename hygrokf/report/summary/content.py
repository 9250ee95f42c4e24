"""What stands on the page of a reader who decides: question, answer, verdict, bounds, picture, what to do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from hygrokf.identification.verdict_terms import Kind
from hygrokf.identification.wording import one_line
from hygrokf.report.blocks import Figure, Table
from hygrokf.report.figures.drawing import NothingToShow
from hygrokf.version import __version__

MOST_ROWS, MOST_ACTIONS = 12, 8
"""What one page can hold."""
TODO = "What to do"
Tone: TypeAlias = Literal["plain", "open", "reject"]
"""How an answer without a verdict is shown: as it is, as a warning, as a refusal."""


@dataclass(frozen=True)
class Summary:
    """A result for a manager.

    `kind` of result and `name`, whose it is.  `question` and `answer`, with the `verdict` on its numbers
    ("" without one, then with a `tone`) and the `reasons` in sentences; `bounds`: the numbers behind the
    answer.  `picture`: None where the result has nothing to draw.  `actions`: what to do.  `foot`: record,
    period, version.  `synthetic`: the sentence that nothing was measured, or empty.
    """

    kind: str
    name: str
    question: str
    answer: str
    verdict: Kind | Literal[""]
    reasons: tuple[str, ...]
    bounds: Table
    picture: Figure | None
    actions: tuple[str, ...]
    foot: tuple[tuple[str, str], ...]
    tone: Tone = "plain"
    synthetic: str = ""


def named(text: str, without: str = "unnamed record") -> str:
    """A name on one line; `without` one, what stands in its place."""
    return one_line(text).strip() or without


def known(term: str, text: str) -> tuple[tuple[str, str], ...]:
    """A line of the foot; none where its text is empty."""
    return ((term, text),) if text else ()


def made_by(version: str) -> tuple[str, str]:
    """The line of the foot with the versions of the result and of the page."""
    return ("Made by", f"hygrokf {version or '(version not stated)'}; summary by hygrokf {__version__}")


def first_rows(table: Table) -> Table:
    """A table of at most `MOST_ROWS` rows, whose note names the rest."""
    rest = len(table.rows) - MOST_ROWS
    if rest <= 0:
        return table
    note = f"{table.note} {rest} more rows: see the report.".strip()
    return replace(table, rows=table.rows[:MOST_ROWS], note=note)


def first_actions(actions: Sequence[str]) -> tuple[str, ...]:
    """At most `MOST_ACTIONS`, and how many more there are."""
    rest = len(actions) - MOST_ACTIONS
    return (*actions[:MOST_ACTIONS], *([f"{rest} more: see the report."] if rest > 0 else []))


def drawable(make: Callable[[], Figure]) -> Figure | None:
    """A picture; None where there is nothing to show."""
    try:
        picture = make()
        picture.draw()
        return picture
    except NothingToShow:
        return None
