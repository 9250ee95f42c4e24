"""Blocks: the content of a page as data, which the template draws as HTML and `terminal` prints as text.

A block holds plain text and numbers as printed; it knows neither HTML nor the width of a terminal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

from hygrokf.data.record import Provenance
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.texts.reasons import WORDS

if TYPE_CHECKING:
    from hygrokf.report.figures.panels import Picture

FREE_RUN = (
    "Free run: a simulation from weather, power and other inputs alone, which sees no reading of the cabinet."
)
INNOVATIONS = "Innovations: readings less their one-step predictions."
"""Terms that a page explains at their first use."""
OF_RECORD = {
    Provenance.SIMULATED: "A model computed the readings in the cabinet. They were not measured.",
    Provenance.SYNTHETIC: "A computer made this record. Nothing on this page was measured.",
}
OF_RECORDS = {
    Provenance.SIMULATED: "A model computed the cabinet's readings of at least one of these records.",
    Provenance.SYNTHETIC: "A computer made at least one of these records: its numbers were not measured.",
}
"""Provenance → warning on a page about one record (`OF_RECORD`), or about several (`OF_RECORDS`)."""


@dataclass(frozen=True)
class Heading:
    """A heading: level 2 begins a section, level 3 a part of it."""

    text: str
    level: Literal[2, 3] = 2


@dataclass(frozen=True)
class Prose:
    """A paragraph; `style` "note" is printed smaller, "missing" says what is absent and why."""

    text: str
    style: Literal["", "note", "missing"] = ""


@dataclass(frozen=True)
class Link:
    """A sentence that ends in a link to a file beside the page."""

    text: str
    file: str


@dataclass(frozen=True)
class Items:
    """A list of sentences."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Banner:
    """A warning about the whole page: `word` in capitals, then a sentence."""

    word: str
    text: str
    severe: bool = False


@dataclass(frozen=True)
class Line:
    """A sentence with the mark of its verdict `kind`; `head`: a main line; `within`: a reason for a main
    line."""

    kind: str
    text: str
    within: bool = False
    head: bool = False
    struck: str = ""
    """A number at the beginning that is not reliable, shown struck through."""


@dataclass(frozen=True)
class Verdicts:
    """Sentences, each with the mark of its verdict; `key`: whether the marks are explained above them."""

    lines: tuple[Line, ...]
    heading: str = ""
    key: bool = True


@dataclass(frozen=True)
class Card:
    """One number of the answer: label, value, bounds, verdict and the reason for it.

    `symbol`: the formula beside the label, with an underscore before an index ("R_D*·V*"). `kind`: the
    verdict; for "" the card's edge shows its `tone` instead: "open" a warning, "plain" nothing, "reject" a
    refusal. `words`: the value is a sentence, not a number. `wide`: the card takes the whole width.
    """

    label: str
    value: str
    kind: str = ""
    bounds: str = ""
    reason: str = ""
    symbol: str = ""
    lines: tuple[str, ...] = ()
    wide: bool = False
    words: bool = False
    tone: Literal["open", "plain", "reject"] = "open"

    @property
    def verdict(self) -> str:
        """The verdict in words; empty without one."""
        return WORDS.get(self.kind, "")


@dataclass(frozen=True)
class Cards:
    """The answer: one card for each number, or one wide card for a sentence."""

    cards: tuple[Card, ...]


@dataclass(frozen=True)
class Table:
    """Columns and rows of text; the columns `left` hold words, all others numbers; the rows `marked` are
    bold.

    `groups`: headings above the columns, each with the number of columns that it spans. `brief`: the columns
    that a terminal shows; empty: all. A table without rows is false, and is shown nowhere.
    """

    heading: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: tuple[int, ...] = (0,)
    marked: tuple[int, ...] = ()
    groups: tuple[tuple[str, int], ...] = ()
    note: str = ""
    brief: tuple[int, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.rows)

    def __post_init__(self) -> None:
        wrong = [row for row in self.rows if len(row) != len(self.columns)]
        if wrong:
            raise ValueError(
                f"{self.heading}: expected a cell for each of {len(self.columns)} columns, found {wrong[0]}"
            )


@dataclass(frozen=True)
class Figure:
    """A figure, drawn when the page is made; `name` (letters, digits, -) makes its identifiers unique on the
    page.

    The caption says what to look for. `draw` may raise `NothingToShow` with the reason.
    """

    name: str
    heading: str
    caption: str
    draw: Callable[[], Picture]


@dataclass(frozen=True)
class Details:
    """Blocks that are folded until a reader opens them; printed pages show them, terminals if `printed`."""

    summary: str
    blocks: tuple[Block, ...]
    printed: bool = False


Block: TypeAlias = Heading | Prose | Link | Items | Banner | Verdicts | Cards | Table | Figure | Details


@dataclass(frozen=True)
class Page:
    """A page about one result.

    `kind`: sort of result. `name`: of the record or model. `about`: lines below the name. `lead`: the first
    screen, with warnings, the answer and its verdict, and a figure. `body`: the rest. `foot`: how the result
    was computed. `sheet`: size of the letters [pt] for a page that is printed on one sheet; 0: any number of
    sheets.
    """

    kind: str
    name: str
    about: tuple[str, ...]
    lead: tuple[Block, ...]
    body: tuple[Block, ...]
    foot: tuple[Block, ...] = ()
    sheet: float = 0.0


def present(*blocks: Block | None) -> tuple[Block, ...]:
    """Return the blocks without None and without empty tables."""
    return tuple(block for block in blocks if block)


def table_or(table: Table | None, reason_if_empty: str) -> Block:
    """Return a table, or for an empty one a sentence that says why it is empty."""
    return table or Prose(reason_if_empty, "missing")


def section(heading: str, *blocks: Block | None) -> tuple[Block, ...]:
    """Return a heading with the blocks below it; empty without any block."""
    shown_blocks = present(*blocks)
    return (Heading(heading), *shown_blocks) if shown_blocks else ()


def method(heading: str, *lines: str) -> tuple[Block, ...]:
    """The heading and paragraphs that say how a result was computed."""
    return (Heading(heading), *map(Prose, lines))


def unmeasured(provenance: Provenance, texts: Mapping[Provenance, str]) -> tuple[Banner, ...]:
    """Return the warning about a result whose readings were not measured; empty for a measured one."""
    return (Banner(provenance.upper(), texts[provenance]),) if provenance in texts else ()


def inherited_verdicts(constants: Mapping[str, Inherited], heading: str) -> Verdicts | None:
    """Return the time constants that a result took over from a fit, with their verdicts; None without any.

    A value that is not reliable is struck through.
    """
    lines = []
    for part, constant in constants.items():
        text, struck = constant.line(part)
        lines.append(Line(constant.verdict, text, struck=struck))
    return Verdicts(tuple(lines), heading, key=False) if lines else None
