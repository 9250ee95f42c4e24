"""The panels of a picture as data: the marks on each panel, with labels, units and limits.

`Picture` draws the panels with matplotlib, in rows and columns below a key: on a figure of its own for pages
and summaries, or on axes that a user gives.

matplotlib is imported inside the functions that need it.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.report.figures.drawing import (
    BINS,
    INK,
    QUIET,
    calendar_ticks,
    envelope,
    new_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis as MatplotlibAxis
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure

SMALL_PT = 6.8
"""[pt] size of notes in a panel."""
DASHES = (4, 2)
MARKER_EDGE = {"|": 1.4, ".": 0.0}
"""[pt] width of the edges of markers for which it differs from matplotlib's."""
BOX = {"facecolor": "white", "alpha": 0.78, "pad": 0.7, "linewidth": 0}
KEY_WIDTH = 1.0
"""[pt] least width of a line in a key."""
BOUND_WIDTH = 1.6
"""[pt] width of the line between two bounds."""
Numbers: TypeAlias = Sequence[float] | np.ndarray
Limits: TypeAlias = tuple[float | None, float | None]


@dataclass(frozen=True)
class Curve:
    """Points x (n,), y (n,) drawn as a line, as markers, or as both; `width` 0: only markers.

    `label`: its text in the key; a mark without a label is not in the key.
    """

    x: Numbers
    y: Numbers
    colour: str
    width: float = 0.9
    label: str = ""
    marker: str = ""
    size: float = 3.0
    dashed: bool = False
    alpha: float = 1.0
    edge: str = ""


@dataclass(frozen=True)
class Band:
    """The area between two edges (n,) over x (n,)."""

    x: np.ndarray
    low: np.ndarray
    high: np.ndarray
    colour: str
    alpha: float = 0.16
    label: str = ""


@dataclass(frozen=True)
class Shade:
    """A shaded interval of one axis ("x", "y") that covers the full length of the other axis."""

    low: float
    high: float
    colour: str
    alpha: float = 1.0
    label: str = ""
    of: Literal["x", "y"] = "x"
    hatched: bool = False


@dataclass(frozen=True)
class CrossLine:
    """A straight line across the panel at a value of one axis ("x", "y")."""

    at: float
    of: Literal["x", "y"]
    colour: str = QUIET
    width: float = 0.6
    dashed: bool = False
    label: str = ""


@dataclass(frozen=True)
class Note:
    """A text beside a point; `shares` names the coordinates given as fractions of the axes: "", "x", "y",
    "xy".

    `side` and `level`: position of the point relative to the box of the text.
    """

    text: str
    x: float
    y: float
    colour: str = INK
    side: Literal["left", "center", "right"] = "left"
    level: Literal["bottom", "center", "top"] = "center"
    shares: Literal["", "x", "y", "xy"] = ""
    bold: bool = False
    boxed: bool = False


@dataclass(frozen=True)
class ColourScale:
    """The colours of numbers: from `low` to `high` (`logarithmic`: in equal steps of the logarithm), or one
    colour for each class between `edges`; `label` and `ticks` of the bar that explains the colours."""

    colours: tuple[str, ...]
    label: str
    low: float = 0.0
    high: float = 1.0
    logarithmic: bool = False
    edges: tuple[float, ...] = ()
    ticks: tuple[float, ...] = ()
    missing: str = "#e3e6ea"
    """Colour of places without a value."""

    def colour_map(self) -> Colormap:
        """The colours as a colour map of matplotlib."""
        from matplotlib.colors import LinearSegmentedColormap, ListedColormap

        if self.edges:
            return ListedColormap(self.colours)
        return LinearSegmentedColormap.from_list(self.label, self.colours).with_extremes(bad=self.missing)

    def norm(self) -> Normalize:
        """The mapping of numbers to the range of the colour map, as an object of matplotlib."""
        from matplotlib.colors import BoundaryNorm, LogNorm, Normalize

        if self.edges:
            return BoundaryNorm(self.edges, len(self.colours))
        return (LogNorm if self.logarithmic else Normalize)(self.low, self.high)

    def draw_bar(self, figure: Figure, **where: Any) -> None:
        """Draw the bar that explains the colours."""
        from matplotlib.cm import ScalarMappable

        look: Any = {"extend": "neither" if self.edges or self.logarithmic else "both", "extendfrac": 0.03}
        bar = figure.colorbar(ScalarMappable(self.norm(), self.colour_map()), **look, **where)
        if ticks := self.ticks or self.edges:
            bar.set_ticks(list(ticks), labels=[f"{tick:g}" for tick in ticks])
            bar.minorticks_off()
        bar.set_label(self.label)


@dataclass(frozen=True)
class Map:
    """Cells in the colours of `values` (n, m), with cell edges x (n + 1,) and y (m + 1,); NaN: no value."""

    x: np.ndarray
    y: np.ndarray
    values: np.ndarray
    scale: ColourScale


Mark: TypeAlias = Curve | Band | Shade | CrossLine | Note | Map


@dataclass(frozen=True)
class Axis:
    """One axis of a panel.

    `limits`: an end that is None follows from the marks.  `kind`: "time" takes seconds since 1970 and shows a
    calendar in UTC.  `at` and `words`: positions of the ticks and their labels; without them there are at
    most `most` ticks, at multiples of `steps` times a power of ten.
    """

    label: str = ""
    limits: Limits = (None, None)
    kind: Literal["linear", "logarithmic", "time"] = "linear"
    at: Numbers = ()
    words: Sequence[str] = ()
    most: int = 0
    steps: tuple[float, ...] = ()
    grid: bool = True


@dataclass(frozen=True)
class Panel:
    """One pair of axes with the marks on it; without marks, the title says why in a sentence."""

    marks: tuple[Mark, ...] = ()
    x: Axis = Axis()
    y: Axis = Axis()
    title: str = ""
    plain: bool = False
    """Whether the title is set like the labels, not as a heading."""

    def on(self, axes: Axes) -> None:
        """Draw the panel on axes of matplotlib."""
        if not self.marks:
            axes.set_axis_off()
            words = textwrap.fill(self.title, 34)
            axes.text(0.5, 0.5, words, ha="center", va="center", color=QUIET, transform=axes.transAxes)
            return
        unit = DAY_S if self.x.kind == "time" else 1.0
        for mark in self.marks:
            _draw(mark, axes, unit)
        _scaled(self.x, axes, "x")
        _scaled(self.y, axes, "y")
        look: dict[str, Any] = {"fontweight": "normal", "fontsize": SMALL_PT} if self.plain else {}
        axes.set_title(self.title, **look)


def _draw(mark: Mark, axes: Axes, x_unit: float) -> None:
    """Draw a mark; x coordinates are divided by `x_unit` (a day in seconds on an axis of time, else 1)."""
    dashes: dict[str, Any] = {"dashes": DASHES} if getattr(mark, "dashed", False) else {}
    match mark:
        case Curve():
            axes.plot(
                np.asarray(mark.x) / x_unit, mark.y, color=mark.colour, alpha=mark.alpha,
                linewidth=mark.width, linestyle="-" if mark.width else "none", **_marker(mark), **dashes,
            )  # fmt: skip
        case Band():
            axes.fill_between(
                mark.x / x_unit, mark.low, mark.high, color=mark.colour, alpha=mark.alpha, linewidth=0
            )
        case Shade():
            settings: dict[str, Any] = {"color": mark.colour, "alpha": mark.alpha, "zorder": 0.0}
            if mark.hatched:
                settings = {"facecolor": "none", "edgecolor": mark.colour, "hatch": "////", "zorder": 0.5}
            if mark.of == "x":
                axes.axvspan(mark.low / x_unit, mark.high / x_unit, linewidth=0, **settings)
            else:
                axes.axhspan(mark.low, mark.high, linewidth=0, **settings)
        case CrossLine(of="x"):
            axes.axvline(mark.at / x_unit, color=mark.colour, linewidth=mark.width, **dashes)
        case CrossLine():
            axes.axhline(mark.at, color=mark.colour, linewidth=mark.width, **dashes)
        case Note():
            x_of, y_of = ("axes fraction" if coordinate in mark.shares else "data" for coordinate in "xy")
            x = mark.x if "x" in mark.shares else mark.x / x_unit
            shift = {"left": 3, "right": -3}.get(mark.side, 0), {"top": -3, "bottom": 3}.get(mark.level, 0)
            axes.annotate(
                mark.text, (x, mark.y), xycoords=(x_of, y_of), xytext=shift, textcoords="offset points",
                ha=mark.side, va=mark.level, color=mark.colour, fontsize=SMALL_PT, annotation_clip=False,
                fontweight="bold" if mark.bold else "normal", bbox=BOX if mark.boxed else None,
            )  # fmt: skip
        case Map():
            settings = {"cmap": mark.scale.colour_map(), "norm": mark.scale.norm(), "rasterized": True}
            axes.pcolormesh(mark.x / x_unit, mark.y, mark.values.T, **settings)


def _marker(line: Curve) -> dict[str, Any]:
    """The settings of matplotlib for the markers of a curve."""
    look: dict[str, Any] = {"marker": line.marker, "markersize": line.size}
    if line.edge:
        look["markeredgecolor"] = line.edge
    if line.marker in MARKER_EDGE:
        look["markeredgewidth"] = MARKER_EDGE[line.marker]
    return look


def _scaled(axis: Axis, axes: Axes, which: Literal["x", "y"]) -> None:
    """Set limits, ticks and label of one of the axes ("x", "y") after its marks are drawn."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    drawn_axis = axes.xaxis if which == "x" else axes.yaxis
    side_names = "left right" if which == "x" else "bottom top"
    unit = DAY_S if axis.kind == "time" else 1.0
    low, high = axis.limits
    if axis.kind == "time" and low is not None and high is not None and not high > low:
        low, high = low - HOUR_S / 2, high + HOUR_S / 2
    limits_by_side: dict[str, Any] = {
        side: limit / unit
        for side, limit in zip(side_names.split(), (low, high), strict=True)
        if limit is not None
    }
    if axis.kind == "logarithmic":
        (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    if limits_by_side:
        (axes.set_xlim if which == "x" else axes.set_ylim)(**limits_by_side)
    if len(axis.at):
        drawn_axis.set_ticks(np.asarray(axis.at) / unit, axis.words or None)
        drawn_axis.set_minor_locator(NullLocator())
    elif axis.kind == "time" and low is not None and high is not None:
        at, labels = calendar_ticks(low, high, axis.most or 12)
        drawn_axis.set_ticks(at / unit, labels)
    elif axis.kind == "logarithmic":
        low, high = drawn_axis.get_view_interval()
        multiples = (1.0, 2.0, 5.0) if math.log10(high / low) < 2.2 else (1.0,)
        drawn_axis.set_major_locator(LogLocator(base=10.0, subs=multiples, numticks=(axis.most or 6) + 4))
        drawn_axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        drawn_axis.set_minor_locator(NullLocator())
    elif axis.most or axis.steps:
        from matplotlib.ticker import MaxNLocator

        drawn_axis.set_major_locator(MaxNLocator(axis.most or "auto", steps=axis.steps or [1, 2, 2.5, 5, 10]))
    if not axis.grid:
        axes.grid(visible=False, axis=which)
    drawn_axis.set_label_text(axis.label)


# --- the picture -----------------------------------------------------------------------------

PANEL_LETTER_EM, WIDE_EM, LINE_EM = 0.67, 1.0, 1.25
"""Width of a letter, width of an M or W, and height of a line, in multiples of the font size; wide enough for
the page's fonts."""
SIGN_EM, KEY_LETTER_EM, KEY_LINE_EM = 3.7, 0.6, 1.75
"""In a key: width of a sign with the space beside it, width of a letter, and height of a line, in multiples
of the font size."""
GAP_IN, ROW_IN, BAR_IN = 0.09, 0.03, 0.62
"""[in] space between columns and between rows of panels, and width of a bar of colours with its labels."""
POINT_IN = 1.0 / 72.0


@dataclass(frozen=True)
class Picture:
    """The panels of one picture, row by row, the most important panel first.

    `height_in` [in] of the whole picture at the width of a page; `columns`: panels side by side.
    `heights`: heights of the rows in proportion; equal without any.
    `shared`: the axes that the panels of a row ("y") or of a column ("x") have in common, which only the
        outer ones label.
    `key`: marks that only the key shows, after those of the panels that have a label.
    `scale`: the colours that a bar beside the panels explains.
    """

    panels: tuple[Panel, ...]
    height_in: float
    columns: int = 1
    shared: Literal["", "x", "y", "xy"] = ""
    heights: tuple[float, ...] = ()
    key: tuple[Mark, ...] = ()
    scale: ColourScale | None = None

    def figure(self) -> Figure:
        """The picture on a figure of a page's width."""
        with styled():
            figure = new_figure(self.height_in)
            self.on_figure(figure)
        return figure

    def on(self, axes: Sequence[Axes]) -> None:
        """Draw the first panels on a user's axes, one on each, with a key and a bar of colours."""
        self._draw(axes)
        if entries := self._handles():
            axes[0].legend(handles=entries, loc="best")
        if self.scale is not None:
            figure = axes[0].get_figure(root=True)
            assert figure is not None
            self.scale.draw_bar(figure, ax=list(axes))

    def on_figure(self, figure: Figure) -> list[Axes]:
        """Draw all panels on new axes of a figure, below their key; returns the axes."""
        rows = -(-len(self.panels) // self.columns)
        # roughly the final positions: matplotlib chooses ticks by the size of the axes
        axes = [figure.add_subplot(rows, self.columns, i + 1) for i in range(len(self.panels))]
        self._draw(axes)
        width, height = map(float, figure.get_size_inches())
        key_in = 0.0
        if entries := self._handles():
            columns = _columns(width, [str(handle.get_label()) for handle in entries])
            figure.legend(handles=entries, ncols=columns, loc="upper left", bbox_to_anchor=(0.0, 1.0))
            key_in = -(-len(entries) // columns) * KEY_LINE_EM * _points("legend.fontsize") * POINT_IN
        width_of_panels_in = width - (BAR_IN + GAP_IN if self.scale is not None else 0.0)
        axes_by_row = [axes[i : i + self.columns] for i in range(0, len(axes), self.columns)]
        _place(
            axes_by_row, width_of_panels_in, height - key_in, (width, height), self.heights or (1.0,) * rows
        )
        if self.scale is not None:
            boxes = [axis.get_position() for axis in axes]
            bottom, top = min(box.y0 for box in boxes), max(box.y1 for box in boxes)
            bar_axes = figure.add_axes((width_of_panels_in / width, bottom, 0.14 / width, top - bottom))
            self.scale.draw_bar(figure, cax=bar_axes)
        return axes

    def _draw(self, axes: Sequence[Axes]) -> None:
        """Draw the first panels, one on each of the axes."""
        last = len(axes) - 1
        for place, (axis, panel) in enumerate(zip(axes, self.panels, strict=False)):
            hides_x_labels = "x" in self.shared and place + self.columns <= last
            hides_y_labels = "y" in self.shared and place % self.columns > 0
            # set before the ticks exist, so that no hidden labels are created
            axis.tick_params(labelbottom=not hides_x_labels, labelleft=not hides_y_labels)
            panel.on(axis)
            if hides_x_labels:
                axis.set_xlabel("")
            if hides_y_labels:
                axis.set_ylabel("")

    def _handles(self) -> list[Artist]:
        """Return the entries of the key; marks with the same label share one entry."""
        marks = [mark for panel in self.panels for mark in panel.marks]
        handles: dict[str, Artist] = {}
        for mark in (*marks, *self.key):
            if isinstance(mark, Curve | Band | Shade | CrossLine) and mark.label:
                handles.setdefault(mark.label, _handle(mark))
        return list(handles.values())


def _handle(mark: Curve | Band | Shade | CrossLine) -> Artist:
    """Return the entry of a mark in the key."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if isinstance(mark, Band | Shade):
        if isinstance(mark, Shade) and mark.hatched:
            return Patch(facecolor="white", edgecolor=mark.colour, hatch="//////", label=mark.label)
        return Patch(facecolor=mark.colour, alpha=min(1.3 * mark.alpha, 1.0), label=mark.label)
    width = max(mark.width, KEY_WIDTH) if mark.width else 0.0
    settings: dict[str, Any] = {"dashes": DASHES} if mark.dashed else {}
    settings |= _marker(mark) if isinstance(mark, Curve) else {}
    return Line2D([], [], color=mark.colour, label=mark.label, linewidth=width, **settings)


def _place(
    grid: list[list[Axes]], width: float, height: float, size: tuple[float, float], heights: Sequence[float]
) -> None:
    """Set the positions of axes in rows and columns, from the estimated sizes of the texts beside them.

    width, height: [in] the area for all axes.  size: [in] of the figure.  The texts are estimated, not
    measured, because measuring would draw the figure twice.
    """
    margins = [[_around(axis) for axis in row] for row in grid]
    left_in, right_in = (
        [max(row[i][side].sum() for row in margins if i < len(row)) for i in range(len(grid[0]))]
        for side in (0, 1)
    )
    top_in, bottom_in = ([max(axis[side].sum() for axis in row) for row in margins] for side in (2, 3))
    gaps_in = GAP_IN * (len(left_in) - 1)
    axes_width = (width - sum(left_in) - sum(right_in) - gaps_in) / len(left_in)
    free_height = height - sum(top_in) - sum(bottom_in) - ROW_IN * (len(grid) - 1)
    y_in = height
    for row, proportion, above_in, below_in in zip(grid, heights, top_in, bottom_in, strict=True):
        axes_height = max(free_height * proportion / sum(heights), 0.2)
        y_in -= above_in + axes_height
        x_in = 0.0
        for i, axes in enumerate(row):
            x_in += left_in[i]
            axes.set_position((x_in / size[0], y_in / size[1], axes_width / size[0], axes_height / size[1]))
            axes.yaxis.set_label_coords(-(left_in[i] - 0.02) / axes_width, 0.5)
            axes.yaxis.label.set_verticalalignment("top")
            ticks_in = _around(axes)[3][0]
            axes.xaxis.set_label_coords(0.5, -ticks_in / axes_height)
            x_in += axes_width + right_in[i] + GAP_IN
        y_in -= below_in + ROW_IN


def _around(axes: Axes) -> tuple[np.ndarray, ...]:
    """Space [in] for tick labels (first) and titles (second) left, right, above and below the axes."""
    if not axes.axison:
        return (np.zeros(2),) * 4
    return (
        np.array([_ticks_in(axes, "y"), _lines(axes.get_ylabel(), "axes.labelsize")]),
        np.array([_beyond(axes), 0.0]),
        np.array([0.04, _lines(axes.get_title(loc="left"), "axes.titlesize")]),
        np.array([_ticks_in(axes, "x"), _lines(axes.get_xlabel(), "axes.labelsize")]),
    )


def _ticks_in(axes: Axes, which: Literal["x", "y"]) -> float:
    """Estimate the space [in] that the tick labels of an axis need beside the axes."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    shown = axis.get_tick_params()["labelbottom" if which == "x" else "labelleft"]
    if not shown:
        return 0.05
    labels, letter_in = _words(axis), _points(f"{which}tick.labelsize") * POINT_IN
    if which == "x":
        return 0.085 + LINE_EM * letter_in * max(
            (1 + label.count("\n") for label in labels.values()), default=1
        )
    widths = (
        sum(WIDE_EM if letter in "MW" else PANEL_LETTER_EM for letter in word) for word in labels.values()
    )
    return 0.08 + letter_in * max(widths, default=PANEL_LETTER_EM)


def _beyond(axes: Axes) -> float:
    """Estimate how far [in] the label of the last tick extends beyond the right end of the axes."""
    labels = _words(axes.xaxis) if axes.xaxis.get_tick_params()["labelbottom"] else {}
    last_position = max(labels, default=0.0)
    letter_in = PANEL_LETTER_EM * _points("xtick.labelsize") * POINT_IN
    return max(
        0.04, 0.5 * letter_in * len(labels.get(last_position, "").split("\n")[0]) * (last_position > 0.97)
    )


def _words(axis: MatplotlibAxis) -> dict[float, str]:
    """Return the labels of the visible ticks by their positions, as shares [1] of the axis."""
    positions, (low, high) = axis.get_majorticklocs(), sorted(axis.get_view_interval())
    labels = axis.get_major_formatter().format_ticks(list(positions))
    shares = (np.asarray(positions) - low) / (high - low)
    return {share: word for share, word in zip(shares, labels, strict=False) if 0.0 <= share <= 1.0}


def _lines(text: str, size: str) -> float:
    """Return the height [in] of a text with the space beside it; 0 for an empty text."""
    return 0.04 + LINE_EM * _points(size) * POINT_IN * (1 + text.count("\n")) if text else 0.0


def _points(setting: str) -> float:
    """Return the font size [pt] of an entry of matplotlib's settings."""
    from matplotlib import rcParams
    from matplotlib.font_manager import FontProperties

    sizes: dict[Any, Any] = dict(rcParams)
    return float(FontProperties(size=sizes[setting]).get_size_in_points())


def _columns(width_in: float, labels: Sequence[str]) -> int:
    """The largest number of columns of a key that fit into a width [in]; entries fill it column by column."""
    letter_in = _points("legend.fontsize") * POINT_IN
    entry_widths = [(SIGN_EM + KEY_LETTER_EM * len(label)) * letter_in for label in labels]
    for columns in range(len(entry_widths), 1, -1):
        rows = -(-len(entry_widths) // columns)
        if sum(max(entry_widths[i : i + rows]) for i in range(0, len(entry_widths), rows)) <= width_in:
            return columns
    return 1


# --- marks of several pictures ---------------------------------------------------------------


def course(
    time: np.ndarray, value: np.ndarray, span: tuple[float, float], colour: str, width: float,
    label: str = "", bins: int = BINS,
) -> Curve:  # fmt: skip
    """The curve of a series (T,) within `span` [s], thinned as in `envelope`; a single value is a marker."""
    thinned_time, thinned_value = envelope(time, value, span, bins)
    count = np.isfinite(thinned_value).sum()
    return Curve(
        thinned_time, thinned_value, colour, width, label if count else "", marker="o" if count == 1 else ""
    )


def validation(start_s: float, span: tuple[float, float]) -> tuple[Mark, ...]:
    """A line with a note at the begin `start_s` [s] of the validation period, within a `span` of time [s]."""
    start = max(start_s, span[0])
    is_near_end = (span[1] - start) / max(span[1] - span[0], 1e-9) < 0.12
    note = Note("validation", start, 1.0, INK, "right" if is_near_end else "left", "top", "y", boxed=True)
    return (CrossLine(start, "x", INK, 0.9, dashed=True), note)


def strokes(
    x1: np.ndarray, y1: np.ndarray, x2: np.ndarray, y2: np.ndarray, colour: str, width: float, label: str = ""
) -> Curve:
    """Return separate line segments from points (x1, y1) to points (x2, y2), each (n,), as one curve."""
    gap = np.full(len(x1), np.nan)
    x, y = (np.column_stack([start, end, gap]).ravel() for start, end in ((x1, x2), (y1, y2)))
    return Curve(x, y, colour, width, label)


def bounds(
    low: float, high: float, at: float, colour: str, width: float = BOUND_WIDTH, alpha: float = 0.6
) -> Curve:
    """Return a horizontal line from the lower to the upper bound, at the height `at`."""
    return Curve((low, high), (at, at), colour, width, alpha=alpha)


def point(x: float, y: float, marker: str, colour: str, size: float, edge: str = "") -> Curve:
    """Return a single marker of `size` [pt]; `edge`: colour of its edge."""
    return Curve((x,), (y,), colour, 0.0, marker=marker, size=size, edge=edge)


def estimate(
    value: float, low: float, high: float, at: float, colour: str, marker: str = "o", size: float = 4.0
) -> tuple[Curve, ...]:
    """A value with its bounds at the height `at`: a line from bound to bound (none for NaN), and a marker."""
    line = (bounds(low, high, at, colour),) if math.isfinite(low) else ()
    return (*line, point(value, at, marker, colour, size))


def rows(labels: Sequence[str]) -> Axis:
    """Return an axis with one row for each label, at the heights 0, 1, …; the first label is on top."""
    return Axis(limits=(len(labels) - 0.4, -0.6), at=range(len(labels)), words=labels, grid=False)
