"""Blocks as text for the command line, in lines of limited width."""

from __future__ import annotations

import shutil
import sys
import unicodedata
from collections.abc import Iterable, Sequence
from functools import cache

from hygrokf.report.blocks import (
    Banner,
    Block,
    Card,
    Cards,
    Details,
    Figure,
    Heading,
    Items,
    Line,
    Link,
    Page,
    Prose,
    Table,
    Verdicts,
)
from hygrokf.texts.reasons import PLAIN_MARKS, REJECT, VERDICTS
from hygrokf.texts.wording import one_line, sentence, unbroken

TEXT_WIDTH = 100
"""Largest width of a text [columns], also used for output to a file."""
NARROWEST = 40
"""Smallest width of a text [columns]."""
MARKS_KEY = "Reliable ({}), with caution ({}), not reliable ({})".format(*map(PLAIN_MARKS.get, VERDICTS))


def terminal_width() -> int:
    """Width of text on standard output [columns], within `NARROWEST` … `TEXT_WIDTH`."""
    if sys.stdout is None or not sys.stdout.isatty():
        return TEXT_WIDTH
    return min(max(shutil.get_terminal_size((TEXT_WIDTH, 24)).columns, NARROWEST), TEXT_WIDTH)


def page_text(page: Page, width: int | None = None) -> str:
    """Return the text that a terminal prints of a page: its name, warnings and answer, and the sections that
    hold text.

    width: [columns]; None: `terminal_width`.
    """
    width = width or terminal_width()
    warnings = [block for block in page.lead if isinstance(block, Banner)]
    is_synthetic = any(block.word == "SYNTHETIC" for block in warnings)
    name = f"{page.name}{' (SYNTHETIC: nothing measured)' if is_synthetic else ''}"
    texts = [_paragraph(name, width)]
    heading = ""
    for block in (*page.lead, *page.body):
        text = "" if isinstance(block, Banner) and block.word == "SYNTHETIC" else block_text(block, width)
        if isinstance(block, Heading) and block.level == 2:
            heading = text
        elif text:
            texts += [heading, text] if heading else [text]
            heading = ""
    return "\n\n".join(texts)


def blocks_text(blocks: Iterable[Block], width: int | None = None) -> list[str]:
    """Return the text of each block; a figure has none.

    width: [columns]; None: `terminal_width`.
    """
    width = width or terminal_width()
    return [text for block in blocks if (text := block_text(block, width))]


def block_text(block: Block, width: int = TEXT_WIDTH) -> str:
    """Return one block as lines of at most `width` columns."""
    match block:
        case Heading() | Prose():
            return _paragraph(block.text, width)
        case Link():
            return _paragraph(f"{block.text} {block.file}", width)
        case Items():
            return "\n".join(_paragraph(f"- {item}", width, "  ") for item in block.items)
        case Banner():
            return _paragraph(f"{block.word}: {block.text}", width)
        case Cards():
            return "\n".join(_paragraph(_card(card), width) for card in block.cards)
        case Verdicts():
            head = [block.heading] if block.heading else [MARKS_KEY] if block.key else []
            return "\n".join([*head, *(_line(line, width) for line in block.lines)])
        case Table():
            return table_text(block, width)
        case Details() if not block.printed:
            return _paragraph(f"{block.summary}: on the page.", width)
        case Details():
            return "\n\n".join([_paragraph(block.summary, width), *blocks_text(block.blocks, width)])
        case Figure():
            return ""


def _card(card: Card) -> str:
    """A card as a sentence: the number with its verdict; for a rejected number the verdict comes first."""
    value = f"{card.value} ({card.bounds})" if card.bounds else card.value
    if card.kind == REJECT:
        statement = f"{card.label}, {card.verdict}: {value}"
    else:
        statement = f"{card.label}: {value}{f', {card.verdict}' if card.kind else ''}"
    end = "" if statement.endswith(".") else "."  # the label may be a name: no capital
    return " ".join([f"{statement}{end}", *(sentence(text) for text in (card.reason, *card.lines) if text)])


def _line(line: Line, width: int) -> str:
    """Return a sentence with its mark; a reason is indented below the sentence that it explains."""
    indent = "  " if line.within else ""
    statement = f"{PLAIN_MARKS[line.kind]} {line.text}{f' – {line.struck}' if line.struck else ''}"
    return "\n".join(indent + row for row in _paragraph(statement, width - len(indent), "  ").splitlines())


def _paragraph(text: str, width: int, indent: str = "") -> str:
    """Wrap a text to lines of at most `width` columns that never separate a number from its unit."""
    return "\n".join(wrapped(unbroken(text), width, indent)).replace("\xa0", " ")


# --- tables ----------------------------------------------------------------------------------


def table_text(table: Table, width: int = TEXT_WIDTH) -> str:
    """Return a table in fixed width.

    Long names of rows are wrapped. If the longest word of a name does not fit beside the other columns, each
    row becomes a paragraph, so that no name and no number is cut.
    """
    shown_columns = table.brief or tuple(range(len(table.columns)))
    rows = [[one_line(row[i]) for i in shown_columns] for row in ([*table.columns], *table.rows)]
    widths = [max(cells(text) for text in column) for column in zip(*rows, strict=True)]
    name_width = width - sum(widths[1:]) - 2 * (len(widths) - 1)
    if widths[0] > name_width:
        if name_width < max(_longest_word(row[0]) for row in rows):
            return _paragraphs(table, shown_columns, rows, width)
        widths[0] = name_width
        rows = [line for row in rows for line in _name_wrapped(row, name_width)]
    left_columns = {column for column, i in enumerate(shown_columns) if i in table.left}
    lines = [table.heading] if table.heading else []
    if table.groups and not table.brief:
        lines.append(_group_line(table.groups, widths))
    for row in rows:
        cells_of_row = [
            _padded(text, widths[column], column in left_columns) for column, text in enumerate(row)
        ]
        lines.append("  ".join(cells_of_row).rstrip())
    if table.note:
        lines += wrapped(table.note, width)
    return "\n".join(shortened(line, width) for line in lines)


def _longest_word(name: str) -> int:
    """The width of a name's longest word [columns], with its indent and the indent of a wrapped line."""
    text = name.lstrip()
    longest = max((cells(word) for word in text.split()), default=0)
    return longest + len(name) - len(text) + (2 if " " in text else 0)


def _paragraphs(table: Table, shown_columns: Sequence[int], rows: list[list[str]], width: int) -> str:
    """Return a table as a paragraph for each row: its name, then each column with its value.

    shown_columns: indices of the columns. rows: the head, then the rows, as text.
    """
    groups = [heading for heading, count in table.groups for _ in range(count)]
    head, *body_rows = rows
    column_names = [
        f"{groups[column]}, {name}" if column < len(groups) and groups[column].strip() else name
        for column, name in zip(shown_columns, head, strict=True)
    ]
    lines = wrapped(table.heading, width) if table.heading else []
    for row in body_rows:
        lines += wrapped(row[0], width, "  ")
        for term, text in zip(column_names[1:], row[1:], strict=True):
            if text.strip() not in ("", "–"):
                lines += [f"  {line}" for line in wrapped(f"{term}: {text}", width - 2, "  ")]
    if table.note:
        lines += wrapped(table.note, width)
    return "\n".join(lines)


def _name_wrapped(row: list[str], width: int) -> list[list[str]]:
    """Wrap the first cell of a row to `width` columns; only the first line has the other cells."""
    text = row[0].lstrip()
    indent = " " * (len(row[0]) - len(text))
    first, *further_lines = [indent + line for line in wrapped(text, width - len(indent), "  ")]
    return [[first, *row[1:]], *([line, *[""] * (len(row) - 1)] for line in further_lines)]


def _group_line(groups: tuple[tuple[str, int], ...], widths: list[int]) -> str:
    """Return the line with the headings of groups, each above the columns that it spans."""
    headings, first_column = [], 0
    for heading, count in groups:
        group_width = sum(widths[first_column : first_column + count]) + 2 * (count - 1)
        first_column += count
        headings.append(_padded(shortened(heading, group_width), group_width, False))
    return "  ".join(headings).rstrip()


def cells(text: str) -> int:
    """Return the number of columns that a terminal needs for a text."""
    return len(text) if text.isascii() else sum(map(_columns, text))


@cache
def _columns(character: str) -> int:
    """Return the width of a character: 0 for a combining one, 2 for a wide East Asian one, else 1."""
    if unicodedata.combining(character):
        return 0
    return 2 if unicodedata.east_asian_width(character) in "WF" else 1


def _padded(text: str, width: int, left: bool) -> str:
    """Pad a text with blanks to a width [columns], on the right (left: words) or on the left (numbers)."""
    space = " " * max(width - cells(text), 0)
    return text + space if left else space + text


def shortened(text: str, width: int) -> str:
    """Cut a text to a width, and mark the cut by an ellipsis."""
    if cells(text) <= width:
        return text
    while text and cells(text) > width - 1:
        text = text[:-1]
    return text + "…"


def wrapped(text: str, width: int = TEXT_WIDTH, indent: str = "") -> list[str]:
    """Wrap a text to `width` columns, further lines indented; words longer than a line are cut."""
    lines, line = [], ""
    for word in text.split(" "):
        while word:
            longer_line = f"{line} {word}" if line.strip() else line + word
            if cells(longer_line) <= width:
                line, word = longer_line, ""
            elif line.strip():
                lines.append(line)
                line = indent
            else:
                piece = word
                while cells(line + piece) > width:
                    piece = piece[:-1]
                lines.append(line + piece)
                line, word = indent, word[len(piece) :]
    return [*lines, line] if line.strip() or not lines else lines
