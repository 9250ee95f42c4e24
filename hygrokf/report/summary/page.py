"""A summary as a page: the blocks of a page that prints on one sheet of A4."""

from __future__ import annotations

import math
from dataclasses import replace

from hygrokf.report.blocks import Card, Cards, Items, Page, Prose, Table, present, section, synthetic
from hygrokf.report.figures.drawing import WIDTH_IN
from hygrokf.report.summary.content import TODO, Summary


def summary_blocks(summary: Summary) -> Page:
    """The answer to the question, its numbers and its picture, then what to do; prints on one page of A4."""
    card = Card(
        summary.question, summary.answer, summary.verdict, lines=summary.reasons, wide=True,
        words=True, tone=summary.tone,
    )  # fmt: skip
    picture = summary.picture
    size, height_in = fitted(summary)
    return Page(
        summary.kind,
        summary.name,
        (),
        present(
            *synthetic(bool(summary.synthetic), summary.synthetic),
            Cards((card,)),
            replace(summary.bounds, heading=""),
            None
            if picture is None
            else replace(picture, draw=lambda: replace(picture.draw(), height_in=height_in)),
        ),
        section(TODO, Items(summary.actions)),
        tuple(Prose(f"{term}: {text}") for term, text in summary.foot),
        sheet=size,
    )


LETTERS_PT = (10.0, 9.5, 9.0, 8.5, 8.0, 7.5, 7.0, 6.5, 6.0, 5.5, 5.0, 4.5, 4.0)
"""[pt] sizes of letters; the largest one that leaves room for the picture is taken."""
WIDTH_PT, HEIGHT_PT = 487.6, 728.0
"""[pt] what the margins in `page.css` leave of A4; of the height two lines are kept free."""
LETTER_EM, LEADING_EM, GAPS_EM = 0.545, 1.45, 11.0
"""[1] average width of a letter, height of a line, and all spaces between the parts of the page, in sizes of
the letters."""
LEAST_SHARE, MOST_SHARE, MOST_IN = 0.9, 1.5, 3.4
"""[1] height of the picture against that in a report; every picture may be as high as `MOST_IN` [in]."""


def fitted(summary: Summary) -> tuple[float, float]:
    """Size of the letters [pt] with which the summary fits on its page, and height of its picture [in]."""
    wanted = 0.0 if summary.picture is None else summary.picture.draw().height_in
    size, room = 0.0, 0.0
    for size in LETTERS_PT:
        room = (HEIGHT_PT - text_pt(summary, size)) / WIDTH_PT * WIDTH_IN
        if room >= LEAST_SHARE * wanted:
            break
    return size, max(LEAST_SHARE * wanted, min(room, max(MOST_SHARE * wanted, MOST_IN)))


def text_pt(summary: Summary, size: float) -> float:
    """[pt] height of all texts in letters of `size` [pt], as far as the average width of a letter tells."""
    shown = summary.picture
    picture = () if shown is None else ((1.05, shown.heading), (0.85, shown.caption))
    texts = (
        (0.85, summary.kind), (2.1, summary.name), (1.2, summary.synthetic), (1.15, summary.question),
        (1.55, summary.answer), (1.2, summary.verdict), *((1.1, text) for text in summary.reasons),
        (0.85, summary.bounds.note), *picture, (1.3, TODO), *((1.15, text) for text in summary.actions),
        *((0.75, f"{term}: {text}") for term, text in summary.foot),
    )  # fmt: skip
    lines = sum(em * math.ceil(len(text) / letters_a_line(em * size)) for em, text in texts)
    return ((lines + _rows_em(summary.bounds, size)) * LEADING_EM + GAPS_EM) * size


def letters_a_line(size: float) -> float:
    """[1] letters of `size` [pt] side by side on the page."""
    return WIDTH_PT / (LETTER_EM * size)


def _rows_em(table: Table, size: float) -> float:
    """Height of a table in lines of the page [1]: numbers stay on one line, the words beside them wrap."""
    if not table:
        return 0.0
    letters = letters_a_line(0.95 * size)
    longest = [max(len(text) + 3 for text in column) for column in zip(*table.rows, strict=True)]
    heads = [(len(text) + 3, room) for text, room in zip(table.columns, longest, strict=True)]
    wrapped = sum(map(max, heads)) > letters
    head = max(math.ceil(wide / room) for wide, room in heads) if wrapped else 1
    words = sum(longest[i] for i in table.left)
    crowding = words / max(letters - sum(longest) + words, 8.0)
    fullest = (max((len(row[i]) + 3) / longest[i] for i in table.left) for row in table.rows)
    return sum(0.35 + 0.95 * lines for lines in (head, *(math.ceil(crowding * share) for share in fullest)))
