"""The layout of every picture: panels in rows and columns below a key, for pages, summaries, and axes that a
user gives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from hygrokf.report.figures.drawing import new_figure, styled

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGN_EM, LETTER_EM, LINE_EM = 3.7, 0.6, 1.75
"""Width of an entry's sign with the space beside it, of a letter, and height of a line of a key, in sizes of
its letters."""
POINT_IN = 1.0 / 72.0


@dataclass(frozen=True)
class Panels:
    """The panels of one picture.

    `draw`: draws a panel on axes, row by row, the most important panel first.
    `columns`: panels side by side; `height_in` [in] of the whole picture at the width of a page.
    `heights`: heights of the rows in proportion; equal without any.
    `shared`: the axes that the panels of a row ("y") or of a column ("x") have in common, which only the
        outer ones label.
    `handles`: makes those of the key.
    `finish`: adds what belongs to all panels that were drawn, such as a colour scale.
    """

    draw: tuple[Callable[[Axes], None], ...]
    height_in: float
    columns: int = 1
    shared: Literal["", "x", "y", "xy"] = ""
    handles: Callable[[], Sequence[Artist]] | None = None
    finish: Callable[[Sequence[Axes]], None] | None = None
    heights: tuple[float, ...] = ()

    @property
    def rows(self) -> int:
        """Panels one above the other."""
        return -(-len(self.draw) // self.columns)

    def figure(self) -> Figure:
        """The picture on a figure of a page's width."""
        with styled():
            made = new_figure(self.height_in)
            self.on_figure(made)
        return made

    def on(self, axes: Sequence[Axes]) -> None:
        """Draw the first panels, one on each of the axes, with a key in the first."""
        self.without_key(axes)
        if self.handles is not None:
            axes[0].legend(handles=self.handles(), loc="best")

    def on_figure(self, figure: Figure) -> list[Axes]:
        """Draw all panels on new axes, below their key; returns the axes."""
        grid = figure.add_gridspec(self.rows, self.columns, height_ratios=self.heights or None)
        axes = [figure.add_subplot(grid[divmod(i, self.columns)]) for i in range(len(self.draw))]
        self.without_key(axes)
        key = 0.0
        if self.handles is not None:
            handles, inches = self.handles(), figure.get_size_inches()
            columns = _columns(inches[0], [str(one.get_label()) for one in handles])
            legend = figure.legend(
                handles=handles, ncols=columns, loc="upper left", bbox_to_anchor=(0.0, 1.0)
            )
            legend.set_in_layout(False)
            lines = -(-len(handles) // columns)
            key = lines * LINE_EM * _letters() * POINT_IN / inches[1]
        figure.align_ylabels(axes)
        figure.set_layout_engine("constrained", rect=(0.0, 0.0, 1.0, 1.0 - key))
        return axes

    def without_key(self, axes: Sequence[Axes]) -> None:
        """Draw the first panels, one on each of the axes."""
        last = len(axes) - 1
        for place, (one, draw) in enumerate(zip(axes, self.draw, strict=False)):
            draw(one)
            if "x" in self.shared and place + self.columns <= last:
                one.tick_params(labelbottom=False)
                one.set_xlabel("")
            if "y" in self.shared and place % self.columns:
                one.tick_params(labelleft=False)
                one.set_ylabel("")
        if self.finish is not None:
            self.finish(axes)


def _columns(width_in: float, labels: Sequence[str]) -> int:
    """The columns of a key that fit within a width [in]; its entries stand one below the other first."""
    needs = [(SIGN_EM + LETTER_EM * len(one)) * _letters() * POINT_IN for one in labels]
    for columns in range(len(needs), 1, -1):
        rows = -(-len(needs) // columns)
        if sum(max(needs[i : i + rows]) for i in range(0, len(needs), rows)) <= width_in:
            return columns
    return 1


def _letters() -> float:
    """[pt] size of the letters of a key."""
    from matplotlib import rcParams
    from matplotlib.font_manager import FontProperties

    return float(FontProperties(size=rcParams["legend.fontsize"]).get_size_in_points())
