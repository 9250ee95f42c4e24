"""What a result says, as blocks: the template draws them as a page, `terminal` prints them as text.

A block holds plain text and numbers already printed; it knows neither HTML nor the width of a terminal.
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
"""Terms of the reports, explained where a page or a text begins to use them."""
OF_RECORD = {
    Provenance.SIMULATED: "A model computed the readings in the cabinet. They were not measured.",
    Provenance.SYNTHETIC: "A computer made this record. Nothing on this page was measured.",
}
OF_RECORDS = {
    Provenance.SIMULATED: "A model computed the cabinet's readings of at least one of these records.",
    Provenance.SYNTHETIC: "A computer made at least one of these records: its numbers were not measured.",
}
"""What the page of one or of several records says of those that were not measured."""


@dataclass(frozen=True)
class Heading:
    """A heading: level 2 begins a section, level 3 a part of it."""

    text: str
    level: Literal[2, 3] = 2


@dataclass(frozen=True)
class Prose:
    """A paragraph; `style` "note" is smaller, "missing" says what is absent and why."""

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
    """A sentence with its verdict; `within` marks a reason for the line above it, `head` a main line."""

    kind: str
    text: str
    within: bool = False
    head: bool = False
    struck: str = ""
    """A number at the beginning that is not reliable, shown struck through."""


@dataclass(frozen=True)
class Verdicts:
    """Sentences, each with the mark of its verdict; `key` explains the marks."""

    lines: tuple[Line, ...]
    heading: str = ""
    key: bool = True


@dataclass(frozen=True)
class Card:
    """One number of the answer: label, value, bounds, verdict and its reason.

    `symbol`: the formula beside the label, with an underscore before an index ("R_D*·V*").  `kind`: the
    verdict; "" for an answer without one, whose edge then shows its `tone`: "open" a warning, "plain" none,
    "reject" a refusal.  `words`: the value is a sentence, not a number.
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
    """Columns and rows of text; `left` columns are words, the others numbers; `marked` rows are set off.

    `groups` spans columns under a common heading: (heading, number of columns).  `brief` lists the columns
    that a terminal shows; empty for all.  A table without rows is false, and drawn nowhere.
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
    """A drawing made when the page is; `name` (letters, digits, -) makes its identifiers unique on the page.

    The caption says what to look for.  `draw` may raise `NothingToShow` with the reason.
    """

    name: str
    heading: str
    caption: str
    draw: Callable[[], Picture]


@dataclass(frozen=True)
class Details:
    """Blocks that are folded until a reader asks for them; a printed page shows them.

    `printed`: whether a terminal shows them too.
    """

    summary: str
    blocks: tuple[Block, ...]
    printed: bool = False


Block: TypeAlias = Heading | Prose | Link | Items | Banner | Verdicts | Cards | Table | Figure | Details


@dataclass(frozen=True)
class Page:
    """A result to read.

    `kind` says what sort of result it is, `name` whose, `about` the lines below the name.  `lead` is the
    first screen: warnings, the answer with its verdict, and the picture that shows it.  `body` holds the
    rest, `foot` how it was computed.  `sheet` above 0: it prints on one page, in letters of this size [pt].
    """

    kind: str
    name: str
    about: tuple[str, ...]
    lead: tuple[Block, ...]
    body: tuple[Block, ...]
    foot: tuple[Block, ...] = ()
    sheet: float = 0.0


def present(*blocks: Block | None) -> tuple[Block, ...]:
    """The blocks that there are: neither None nor an empty table."""
    return tuple(block for block in blocks if block)


def table_or(table: Table | None, why: str) -> Block:
    """A table, or the sentence that says why there is none."""
    return table or Prose(why, "missing")


def section(heading: str, *blocks: Block | None) -> tuple[Block, ...]:
    """A heading with blocks below it; nothing where there are none."""
    found = present(*blocks)
    return (Heading(heading), *found) if found else ()


def method(heading: str, *lines: str) -> tuple[Block, ...]:
    """How a result was computed, a paragraph a line."""
    return (Heading(heading), *map(Prose, lines))


def unmeasured(provenance: Provenance, texts: Mapping[Provenance, str]) -> tuple[Banner, ...]:
    """The warning about a result of readings that nobody measured; nothing about a measured one."""
    return (Banner(provenance.upper(), texts[provenance]),) if provenance in texts else ()


def inherited_verdicts(found: Mapping[str, Inherited], heading: str) -> Verdicts | None:
    """The time constants that a result took over from a fit, each with the verdict that it came with.

    A value that is not reliable is struck through.  None without any.
    """
    lines = []
    for part, constant in found.items():
        text, struck = constant.line(part)
        lines.append(Line(constant.verdict, text, struck=struck))
    return Verdicts(tuple(lines), heading, key=False) if lines else None
