"""Blocks as text of at most so many columns, for the command line."""

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
"""Most columns of a text, and those of one that is printed to a file."""
NARROWEST = 40
MARKS_KEY = "Reliable ({}), with caution ({}), not reliable ({})".format(*map(PLAIN_MARKS.get, VERDICTS))


def terminal_width() -> int:
    """Columns for text on standard output: those of the terminal, from `NARROWEST` to `TEXT_WIDTH`."""
    if sys.stdout is None or not sys.stdout.isatty():
        return TEXT_WIDTH
    return min(max(shutil.get_terminal_size((TEXT_WIDTH, 24)).columns, NARROWEST), TEXT_WIDTH)


def page_text(page: Page, width: int | None = None) -> str:
    """What a terminal prints of a page: its name, its warnings, its answer, and the sections that hold text.

    width: [columns]; None: see `terminal_width`.
    """
    width = width or terminal_width()
    warnings = [block for block in page.lead if isinstance(block, Banner)]
    synthetic = any(block.word == "SYNTHETIC" for block in warnings)
    name = f"{page.name}{' (SYNTHETIC: nothing measured)' if synthetic else ''}"
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
    """The text of each block; a figure has none.

    width: [columns]; None: see `terminal_width`.
    """
    width = width or terminal_width()
    return [text for block in blocks if (text := block_text(block, width))]


def block_text(block: Block, width: int = TEXT_WIDTH) -> str:
    """One block as lines of at most `width` columns."""
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
    """A number with its verdict; for a rejected number the verdict comes first."""
    value = f"{card.value} ({card.bounds})" if card.bounds else card.value
    if card.kind == REJECT:
        said = f"{card.label}, {card.verdict}: {value}"
    else:
        said = f"{card.label}: {value}{f', {card.verdict}' if card.kind else ''}"
    end = "" if said.endswith(".") else "."  # the label may be a name: no capital
    return " ".join([f"{said}{end}", *(sentence(text) for text in (card.reason, *card.lines) if text)])


def _line(line: Line, width: int) -> str:
    """A sentence with its mark; a reason stands further in than the sentence that it is a reason for."""
    edge = "  " if line.within else ""
    said = f"{PLAIN_MARKS[line.kind]} {line.text}{f' – {line.struck}' if line.struck else ''}"
    return "\n".join(edge + row for row in _paragraph(said, width - len(edge), "  ").splitlines())


def _paragraph(text: str, width: int, indent: str = "") -> str:
    """Lines of at most so many columns that do not part a number from its unit."""
    return "\n".join(wrapped(unbroken(text), width, indent)).replace("\xa0", " ")


# --- tables ----------------------------------------------------------------------------------


def table_text(table: Table, width: int = TEXT_WIDTH) -> str:
    """A table in fixed width.

    Names of rows that do not fit take several lines; where the longest word of a name does not fit beside the
    other columns, each row is a paragraph of its own instead, so that no name and no number is cut.
    """
    chosen = table.brief or tuple(range(len(table.columns)))
    rows = [[one_line(row[i]) for i in chosen] for row in ([*table.columns], *table.rows)]
    widths = [max(cells(text) for text in column) for column in zip(*rows, strict=True)]
    room = width - sum(widths[1:]) - 2 * (len(widths) - 1)
    if widths[0] > room:
        if room < max(_longest_word(row[0]) for row in rows):
            return _paragraphs(table, chosen, rows, width)
        widths[0] = room
        rows = [line for row in rows for line in _name_wrapped(row, room)]
    left = {place for place, i in enumerate(chosen) if i in table.left}
    lines = [table.heading] if table.heading else []
    if table.groups and not table.brief:
        lines.append(_group_line(table.groups, widths))
    for row in rows:
        parts = [_padded(text, widths[k], k in left) for k, text in enumerate(row)]
        lines.append("  ".join(parts).rstrip())
    if table.note:
        lines += wrapped(table.note, width)
    return "\n".join(shortened(line, width) for line in lines)


def _longest_word(name: str) -> int:
    """Columns of a name's longest word, with its indent and that of a continued line."""
    text = name.lstrip()
    longest = max((cells(word) for word in text.split()), default=0)
    return longest + len(name) - len(text) + (2 if " " in text else 0)


def _paragraphs(table: Table, chosen: Sequence[int], rows: list[list[str]], width: int) -> str:
    """A table as a paragraph for each row: its name, then each column with its value.

    chosen: places of the columns. rows: the head and the rows, as text.
    """
    groups = [heading for heading, count in table.groups for _ in range(count)]
    head, *others = rows
    terms = [
        f"{groups[i]}, {name}" if i < len(groups) and groups[i].strip() else name
        for i, name in zip(chosen, head, strict=True)
    ]
    lines = wrapped(table.heading, width) if table.heading else []
    for row in others:
        lines += wrapped(row[0], width, "  ")
        for term, text in zip(terms[1:], row[1:], strict=True):
            if text.strip() not in ("", "–"):
                lines += [f"  {line}" for line in wrapped(f"{term}: {text}", width - 2, "  ")]
    if table.note:
        lines += wrapped(table.note, width)
    return "\n".join(lines)


def _name_wrapped(row: list[str], width: int) -> list[list[str]]:
    """A row whose first cell is wrapped to `width` columns; its first line has the other cells."""
    text = row[0].lstrip()
    indent = " " * (len(row[0]) - len(text))
    first, *others = [indent + line for line in wrapped(text, width - len(indent), "  ")]
    return [[first, *row[1:]], *([other, *[""] * (len(row) - 1)] for other in others)]


def _group_line(groups: tuple[tuple[str, int], ...], widths: list[int]) -> str:
    parts, at = [], 0
    for heading, count in groups:
        room = sum(widths[at : at + count]) + 2 * (count - 1)
        at += count
        parts.append(_padded(shortened(heading, room), room, False))
    return "  ".join(parts).rstrip()


def cells(text: str) -> int:
    """Columns that a terminal needs for a text."""
    return len(text) if text.isascii() else sum(map(_columns, text))


@cache
def _columns(character: str) -> int:
    if unicodedata.combining(character):
        return 0
    return 2 if unicodedata.east_asian_width(character) in "WF" else 1


def _padded(text: str, width: int, left: bool) -> str:
    space = " " * max(width - cells(text), 0)
    return text + space if left else space + text


def shortened(text: str, width: int) -> str:
    """Text cut to a width, with an ellipsis where something is gone."""
    if cells(text) <= width:
        return text
    while text and cells(text) > width - 1:
        text = text[:-1]
    return text + "…"


def wrapped(text: str, width: int = TEXT_WIDTH, indent: str = "") -> list[str]:
    """Lines of at most `width` columns, further ones indented; words longer than a line are cut."""
    lines, line = [], ""
    for word in text.split(" "):
        while word:
            grown = f"{line} {word}" if line.strip() else line + word
            if cells(grown) <= width:
                line, word = grown, ""
            elif line.strip():
                lines.append(line)
                line = indent
            else:
                part = word
                while cells(line + part) > width:
                    part = part[:-1]
                lines.append(line + part)
                line, word = indent, word[len(part) :]
    return [*lines, line] if line.strip() or not lines else lines
