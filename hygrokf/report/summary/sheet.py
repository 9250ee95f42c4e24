"""A summary as one sheet of A4, as PDF and PNG: texts are wrapped as wide as they measure, and the picture
takes the room that they leave."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from hygrokf.identification.verdict_terms import BELIEVE, CAUTION, REJECT, WORDS
from hygrokf.report.blocks import Table
from hygrokf.report.figures.drawing import INK, MEASURED, QUIET, RULE, expect_matplotlib, styled
from hygrokf.report.page import prose
from hygrokf.report.summary.content import TODO, Summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 8.27, 11.69
"""[in] A4."""
LEFT, TOP = 0.8, 0.75
"""[in] margins at the sides, above and below."""
TEXT = WIDTH - 2 * LEFT
SOFT = "#4a525c"
EDGES = {
    BELIEVE: MEASURED, CAUTION: "#c98a00", REJECT: "#b3140f", "plain": MEASURED, "open": "#c98a00",
}  # fmt: skip
"""Colours of the answer's edge: those of the cards of the reports."""
WARNING_GROUND, WARNING_EDGE = "#fdf3d7", "#c98a00"
SCALES = (1.0, 0.94, 0.88, 0.82, 0.76, 0.7, 0.64, 0.58, 0.5, 0.42)
"""Sizes of the letters to try until the sheet has room for the picture."""
LEAST_SHARE, MOST_SHARE = 0.9, 1.5
"""[1] height of the picture against its height on the page of a report."""
MOST = 3.4
"""[in] height that every picture may have."""
PNG_DPI, PDF_DPI = 150, 220


def summary_bytes(summary: Summary) -> tuple[bytes, bytes]:
    """The sheet as (PDF, PNG); the same summary gives the same bytes.  Raises HygrokfError without
    matplotlib."""
    expect_matplotlib()
    pdf, png = io.BytesIO(), io.BytesIO()
    about = {"Title": f"{summary.kind}: {summary.name}", "Creator": "hygrokf", "CreationDate": None}
    with _lettered():
        figure = summary_sheet(summary)
        figure.savefig(pdf, format="pdf", dpi=PDF_DPI, metadata=about)
        figure.savefig(png, format="png", dpi=PNG_DPI, metadata={"Title": about["Title"]})
    return pdf.getvalue(), png.getvalue()


def summary_sheet(summary: Summary) -> Figure:
    """The sheet as a figure of 8.27 in × 11.69 in."""
    from matplotlib.figure import Figure

    with _lettered():
        layout = _layout(summary)
        figure = Figure(figsize=(WIDTH, HEIGHT), dpi=PNG_DPI)
        end = _put(figure, layout.above, HEIGHT - TOP)
        picture = layout.picture_in
        if summary.picture is not None and picture > 0.3:
            within = (LEFT / WIDTH, (end - picture) / HEIGHT, TEXT / WIDTH, picture / HEIGHT)
            axes = summary.picture.panels.on_figure(figure, within)
            _keep_places(figure, axes)
        _put(figure, layout.below, end - picture)
        end = TOP + sum(one.height for one in layout.foot)
        _box(figure, LEFT, end - 0.06, TEXT, 0.006, RULE)
        _put(figure, layout.foot, end)
    return figure


def _keep_places(figure: Figure, axes: Sequence[Axes]) -> None:
    """Keep the places of a layout, rounded: its solver's last digits differ from one time to the next."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for one in axes:
        left, bottom, width, height = np.round(one.get_position().bounds, 6).tolist()
        one.set_position((left, bottom, width, height))


def fitting_scale(summary: Summary) -> float:
    """[1] the factor on the size of letters with which the summary fits on its sheet, at most 1."""
    with _lettered():
        return _layout(summary).scale


@dataclass(frozen=True)
class _Layout:
    """Measured pieces, with the `scale` [1] of their letters and the height of the picture between them
    [in]."""

    scale: float
    picture_in: float
    above: Sequence[_Piece]
    below: Sequence[_Piece]
    foot: Sequence[_Piece]


def _layout(summary: Summary) -> _Layout:
    """The largest letters that leave enough room for the picture."""
    wanted = 0.0 if summary.picture is None else summary.picture.panels.height_in
    for scale in SCALES:
        above, below, foot = (_measured(part(summary, scale)) for part in (_above, _below, _foot))
        free = HEIGHT - 2 * TOP - sum(one.height for one in (*above, *below, *foot))
        if free >= LEAST_SHARE * wanted:
            break
    picture = min(max(free, 0.0), max(MOST_SHARE * wanted, MOST)) if wanted else 0.0
    return _Layout(scale, picture, above, below, foot)


@contextmanager
def _lettered() -> Iterator[None]:
    """The style of the reports, with letters for paper, embedded so that their text can be copied."""
    import matplotlib

    with styled(1.08), warnings.catch_warnings():
        # a name in letters that the font lacks; the page in HTML shows them
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        matplotlib.rcParams["pdf.fonttype"] = 42
        yield


# --- what stands on it -----------------------------------------------------------------------


@dataclass(frozen=True)
class _Text:
    """Lines of text. `size` [pt]; `gap` above [in]; `indent` [in]; `edge`: colour of a bar at the left;
    `ground`: colour behind; `bullet`: sign before the first line."""

    text: str
    size: float
    colour: str = INK
    bold: bool = False
    gap: float = 0.0
    indent: float = 0.0
    edge: str = ""
    ground: str = ""
    bullet: str = ""
    lines: tuple[str, ...] = field(default=())

    @property
    def leading(self) -> float:
        """[in] from line to line."""
        return self.size * 1.36 / 72.0

    @property
    def height(self) -> float:
        return self.gap + len(self.lines) * self.leading


@dataclass(frozen=True)
class _Rows:
    """A table: cells wrapped in columns. `starts` [in] of the columns, `widths` [in]."""

    table: Table
    size: float
    gap: float
    cells: tuple[tuple[tuple[str, ...], ...], ...] = ()
    starts: tuple[float, ...] = ()
    widths: tuple[float, ...] = ()

    @property
    def leading(self) -> float:
        return self.size * 1.3 / 72.0

    @property
    def heights(self) -> tuple[float, ...]:
        """[in] of the rows."""
        return tuple(0.55 * self.leading + self.leading * max(map(len, row), default=1) for row in self.cells)

    @property
    def height(self) -> float:
        return self.gap + sum(self.heights)


_Piece = _Text | _Rows


def _above(summary: Summary, scale: float) -> list[_Piece]:
    """From the head of the sheet to the heading of the picture."""
    edge = EDGES[summary.verdict or summary.tone]
    found: list[_Piece] = [
        _Text(summary.kind, 9.5 * scale, QUIET),
        _Text(summary.name, 21 * scale, bold=True, gap=0.03),
    ]
    if summary.synthetic:
        found.append(
            _Text(
                f"SYNTHETIC. {summary.synthetic}", 9 * scale, gap=0.14 * scale, indent=0.14,
                edge=WARNING_EDGE, ground=WARNING_GROUND,
            )
        )  # fmt: skip
    found += [
        _Text(summary.question, 11.5 * scale, SOFT, gap=0.22 * scale),
        _Text(summary.answer, 15 * scale, bold=True, gap=0.12 * scale, indent=0.18, edge=edge),
    ]
    if summary.verdict:
        words = f"Verdict: {WORDS[summary.verdict]}"
        found.append(_Text(words, 11 * scale, edge, True, 0.06 * scale, 0.18, edge))
    found += [_Text(text, 9.5 * scale, INK, False, 0.05 * scale, 0.18, edge) for text in summary.reasons]
    if summary.bounds:
        found.append(_Rows(summary.bounds, 9 * scale, 0.2 * scale))
        if summary.bounds.note:
            found.append(_Text(summary.bounds.note, 8 * scale, SOFT, gap=0.05))
    if summary.picture is not None:
        found.append(_Text(summary.picture.heading, 10.5 * scale, bold=True, gap=0.24 * scale))
        found.append(_Text("", 2.0))
    return found


def _below(summary: Summary, scale: float) -> list[_Piece]:
    """The caption of the picture, and what to do."""
    found: list[_Piece] = []
    if summary.picture is not None:
        found.append(_Text(summary.picture.caption, 8 * scale, SOFT, gap=0.06))
    found.append(_Text(TODO, 13 * scale, bold=True, gap=0.24 * scale))
    found += [_Text(text, 10.5 * scale, gap=0.07 * scale, indent=0.2, bullet="•") for text in summary.actions]
    return found


def _foot(summary: Summary, scale: float) -> list[_Piece]:
    """Record, period and version, at the end of the sheet."""
    size = max(7.5 * scale, 5.0)
    lines = [_Text(f"{term}: {text}", size, QUIET) for term, text in summary.foot]
    return [replace(lines[0], gap=0.16), *lines[1:]] if lines else []


# --- measuring and placing -------------------------------------------------------------------


def _measured(pieces: Sequence[_Piece]) -> list[_Piece]:
    """The pieces with their texts in lines that fit."""
    return [_laid(one) if isinstance(one, _Rows) else _wrapped(one) for one in pieces]


def _wrapped(one: _Text) -> _Text:
    return replace(one, lines=lines_of(one.text, TEXT - one.indent, one.size, one.bold))


def lines_of(text: str, width_in: float, size: float, bold: bool = False) -> tuple[str, ...]:
    """A text in lines of at most `width_in` [in]; a word that is wider than a line is parted,
    a number from its unit is not."""
    wide = _width_of(size, bold)
    lines, line = [], ""
    for word in prose(text).split(" "):
        if not word:
            continue
        longer = f"{line} {word}" if line else word
        if wide(longer) <= width_in:
            line = longer
            continue
        if line:
            lines.append(line)
        while wide(word) > width_in and len(word) > 1:
            count = next(n for n in range(len(word) - 1, 0, -1) if n == 1 or wide(word[:n]) <= width_in)
            lines.append(word[:count])
            word = word[count:]
        line = word
    return (*lines, line) if line else tuple(lines) or ("",)


def _width_of(size: float, bold: bool) -> Callable[[str], float]:
    """A function that measures a text [in] in letters of a size [pt]."""
    weight = "bold" if bold else "normal"

    def wide(text: str) -> float:
        return ROUNDED * size / 72.0 * sum(_advance(letter, weight) for letter in text)

    return wide


ROUNDED = 1.035
"""[1] how much wider a text may get where its letters are rounded to the dots of a PNG."""


@cache
def _advance(letter: str, weight: str) -> float:
    """[em] from a letter to the next one."""
    from matplotlib.backends.backend_agg import RendererAgg
    from matplotlib.font_manager import FontProperties

    renderer, font = RendererAgg(1, 1, 72), FontProperties(family="DejaVu Sans", size=100.0, weight=weight)
    with_it, without = (
        renderer.get_text_width_height_descent(text, font, False)[0] for text in (f"n{letter}n", "nn")
    )
    return float(with_it - without) / 100.0


GUTTER = 0.16
"""[in] between columns."""


def _laid(one: _Rows) -> _Rows:
    """The table with its cells in lines: columns as wide as they need, the widest narrowed until all fit."""
    table = one.table
    rows = (table.columns, *table.rows)
    wide, bold = _width_of(one.size, False), _width_of(one.size, True)
    needs = [
        max(bold(table.columns[i]), *(wide(row[i]) for row in table.rows)) for i in range(len(table.columns))
    ]
    room = TEXT - GUTTER * (len(needs) - 1)
    while sum(needs) > room + 1e-6:
        place = needs.index(max(needs))
        second = max([need for i, need in enumerate(needs) if i != place], default=0.0)
        needs[place] = max(needs[place] - (sum(needs) - room), min(second, 0.97 * needs[place]))
    spare = max(room - sum(needs), 0.0)
    needs[0] += spare
    starts = tuple(LEFT + sum(needs[:i]) + GUTTER * i for i in range(len(needs)))
    cells = tuple(
        tuple(lines_of(text, need + 1e-3, one.size, not place) for text, need in zip(row, needs, strict=True))
        for place, row in enumerate(rows)
    )
    return replace(one, cells=cells, starts=starts, widths=tuple(needs))


def _put(figure: Figure, pieces: Sequence[_Piece], top: float) -> float:
    """Draw pieces from `top` [in] down; returns where the last one ends."""
    for number, one in enumerate(pieces):
        if isinstance(one, _Rows):
            _put_rows(figure, one, top)
        else:
            joined = number > 0 and isinstance(before := pieces[number - 1], _Text) and bool(before.edge)
            _put_text(figure, one, top, joined)
        top -= one.height
    return top


def _put_text(figure: Figure, one: _Text, top: float, joined: bool) -> None:
    """A text, with its bar at the left: from the text above on where that has one too."""
    under = top - one.gap
    if one.ground:
        pad = 0.05
        _box(figure, LEFT, under - len(one.lines) * one.leading - pad, TEXT, one.height - one.gap + 2 * pad,
             one.ground)  # fmt: skip
    if one.edge:
        start = top if joined else under
        pad = 0.05 if one.ground else 0.0
        bottom = under - len(one.lines) * one.leading - pad
        _box(figure, LEFT, bottom, 0.05, start + pad - bottom, one.edge)
    at: dict[str, Any] = {
        "va": "center_baseline", "fontsize": one.size, "color": one.colour,
        "weight": "bold" if one.bold else "normal",
    }  # fmt: skip
    for place, line in enumerate(one.lines):
        middle = under - (place + 0.5) * one.leading
        figure.text((LEFT + one.indent) / WIDTH, middle / HEIGHT, line, **at)
        if one.bullet and not place:
            figure.text(LEFT / WIDTH, middle / HEIGHT, one.bullet, **at)


def _put_rows(figure: Figure, one: _Rows, top: float) -> None:
    y = top - one.gap
    for place, (row, height) in enumerate(zip(one.cells, one.heights, strict=True)):
        marked = place - 1 in one.table.marked
        for column, lines in enumerate(row):
            left = column in one.table.left
            x = one.starts[column] + (0.0 if left else one.widths[column])
            for number, line in enumerate(lines):
                figure.text(
                    x / WIDTH, (y - 0.27 * one.leading - (number + 0.5) * one.leading) / HEIGHT, line,
                    ha="left" if left else "right", va="center_baseline", fontsize=one.size,
                    color=SOFT if not place else INK, weight="bold" if marked or not place else "normal",
                )  # fmt: skip
        y -= height
        _box(figure, LEFT, y, TEXT, 0.011 if not place else 0.006, QUIET if not place else RULE)


def _box(figure: Figure, x: float, y: float, width: float, height: float, colour: str) -> None:
    """A filled rectangle [in]."""
    from matplotlib.patches import Rectangle

    place = (x / WIDTH, y / HEIGHT)
    figure.add_artist(
        Rectangle(
            place, width / WIDTH, height / HEIGHT, facecolor=colour, linewidth=0.0,
            transform=figure.transFigure, zorder=0,
        )
    )  # fmt: skip
