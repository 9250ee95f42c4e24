"""The figure of an interval: how it grows, source by source, from the profile likelihood's to the
headline."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.identification.composition import Step
from hygrokf.identification.fit_results import FitResults, TimeConstant
from hygrokf.report.figures.drawing import INK, MEASURED, QUIET, SIMULATED, NothingToShow, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LABELS = {
    "profile": "profile likelihood",
    "parts": "+ parts of the record",
    "forms": "+ other forms",
    "free run": "+ free run",
    "clocks": "+ clocks",
    "sampling": "+ ambient sampling",
}
SHOWN_SD = 1e-3
"""[1] standard deviation of the logarithm from which a source has a bar of its own."""
SHOWN_WEIGHT = 0.01
"""[1] share of the evidence above which another form is drawn."""


def figure_composition(fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
    """One panel a time constant: a bar for each step of the interval, the last one the headline."""
    shown = [
        (name, fit.time_constants[name])
        for name in ("thermal", "hygric")
        if name in fit.time_constants and len(_steps(fit.time_constants[name])) > 1
    ]
    if not shown:
        raise NothingToShow("No interval is composed of several sources, so there is nothing to take apart.")
    with styled():
        figure = new_figure(0.75 + 0.2 * max(len(_steps(found)) for _, found in shown))
        grid = figure.add_gridspec(1, 2, wspace=0.5, left=0.155, right=0.985, top=0.84, bottom=0.24)
        for column, (name, found) in enumerate(shown):
            axes = figure.add_subplot(grid[column])
            _panel(axes, found)
            axes.set_title(f"{name} time constant")
            axes.set_xlabel("[h]")
    return figure


def _steps(found: TimeConstant) -> list[Step]:
    """Steps of an interval that is closed throughout, without those that add nothing."""
    rows = [row for row in found.composition if row.source in LABELS]
    if not all(0 < row.lower_h < row.upper_h < math.inf for row in rows):
        return []
    return [row for i, row in enumerate(rows) if i == 0 or row.sd_ln > SHOWN_SD]


def _panel(axes: Axes, found: TimeConstant) -> None:
    rows = _steps(found)
    last = len(rows) - 1
    for place, row in enumerate(rows):
        bold = place == last
        axes.plot(
            [row.lower_h, row.upper_h], [place, place], color=MEASURED, linewidth=5.0 if bold else 2.6,
            alpha=1.0 if bold else 0.55, solid_capstyle="butt",
        )  # fmt: skip
    axes.axvline(found.value_h, color=INK, linewidth=0.8)
    for one in found.forms:
        if one.form != "base" and one.weight >= SHOWN_WEIGHT:
            _mark(axes, rows, "forms", one.value_h, QUIET, 2.5 + 4.0 * one.weight)
    if found.simulation is not None:
        _mark(axes, rows, "free run", found.simulation.value_h, SIMULATED, 4.5)
    axes.set_yticks(range(len(rows)), [LABELS[row.source] for row in rows])
    axes.set_ylim(last + 0.6, -0.6)
    axes.locator_params(axis="x", nbins=5)
    axes.grid(False, axis="y")


def _mark(axes: Axes, rows: list[Step], source: str, value: float, colour: str, size: float) -> None:
    """Another estimate, on the row of the source that it stands for; none where that adds nothing."""
    places = [i for i, row in enumerate(rows) if row.source == source]
    if places and math.isfinite(value):
        axes.plot([value], places, "D", color=colour, markersize=size, markeredgecolor="white", clip_on=True)
