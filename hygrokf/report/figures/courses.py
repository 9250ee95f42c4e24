"""Readings beside the simulations of one or several models, over the first held-out days."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.timestamps import DAY_S
from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification.wording import QUANTITIES
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.figures.drawing import (
    MEASURED,
    NothingToShow,
    calendar,
    days,
    envelope,
    new_figure,
    styled,
    upright,
)
from hygrokf.transfer.course import Course

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXCERPT_S = 12 * DAY_S


@dataclass(frozen=True)
class Panel:
    """One record's readings with lines for the simulations: label and colour by name in the course."""

    title: str
    course: Course
    lines: Mapping[str, tuple[str, str]]

    @property
    def span(self) -> tuple[float, float]:
        """The first held-out days [s since 1970]; the first days where less than one is held out."""
        first, last = float(self.course.time_s[0]), float(self.course.time_s[-1])
        begin = self.course.until_s if self.course.until_s < last - DAY_S else first
        return begin, min(begin + EXCERPT_S, last)

    def has(self, quantity: str) -> bool:
        return bool(np.isfinite(self.course.measured.get(quantity, np.empty(0))).any())


def figure_courses(panels: Sequence[Panel]) -> Figure:
    """Twelve days of each record: a row for each quantity, a column for each record."""
    rows = [q for q in SCORED if any(panel.has(q) for panel in panels)]
    if not rows:
        raise NothingToShow("There are no readings to show.")
    handles: dict[str, object] = {}
    with styled():
        figure = new_figure(3.0 if len(rows) > 1 else 3.4)
        top = 0.9 if len(panels) == 1 else 0.85
        grid = figure.add_gridspec(
            len(rows), len(panels), hspace=0.13, wspace=0.1, left=0.08, right=0.995, top=top, bottom=0.11
        )
        for column, panel in enumerate(panels):
            for row, quantity in enumerate(rows):
                axes = figure.add_subplot(grid[row, column])
                name, unit = QUANTITIES[quantity]
                shift = ZERO_CELSIUS_K if quantity == "temperature_K" else 0.0
                drawn = {"measured": ("reading", MEASURED), **panel.lines}
                for name_, (words, colour) in drawn.items():
                    made = panel.course.simulated.get(name_, panel.course.measured)
                    if quantity in made:
                        x, y = envelope(panel.course.time_s, made[quantity] - shift, panel.span)
                        width = 1.3 if name_ == "measured" else 0.9
                        (line,) = axes.plot(days(x), y, color=colour, linewidth=width, label=words)
                        handles.setdefault(words, line)
                if column == 0:
                    upright(
                        axes, f"{name} [{'°C' if shift else unit}]".replace(" ", "\n", name.count(" ")), 0.02
                    )
                if row == 0 and len(panels) > 1:
                    axes.set_title(panel.title, fontsize=7.5)
                calendar(axes, panel.span, 9 // len(panels) + 1, labels=row == len(rows) - 1)
        figure.legend(
            handles=list(handles.values()), loc="upper left", bbox_to_anchor=(0.08, 1.0), ncols=len(handles)
        )
    return figure
