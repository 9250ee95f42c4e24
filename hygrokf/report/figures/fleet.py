"""Pictures of a fleet: every turbine's value with its bounds, in order, beside the fleet's median and
spread."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.fleet.outliers import REACH, Spread
from hygrokf.report.figures.drawing import (
    MEASURED,
    QUIET,
    SHADE,
    SIMULATED,
    NothingToShow,
    area_handle,
    line_handle,
    logarithmic,
)
from hygrokf.report.figures.panels import Panels

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

NAMED = 45
"""Turbines up to which every one has its name beside its row."""


def figure_spreads(found: Sequence[Spread]) -> Panels:
    """One panel a quantity: turbines from the least to the largest value, bounds as lines, outliers in red.

    The shade is where 95 % of turbines would lie if their bounds were closed to a point: median and spread
    between them. There is none where the median deviation is no more than the bounds explain.
    """
    shown = [one for one in found if len(one.turbines)]
    if not shown:
        raise NothingToShow("No turbine has a value with bounds.")
    most = max(len(one.turbines) for one in shown)
    named = most <= NAMED
    height = 0.95 + (0.155 * most if named else min(0.155 * NAMED, 0.03 * most + 3.0))

    def handles() -> list[Artist]:
        bounds = ", 95 % bounds" if any(one.compared.lower for one in shown) else ""
        made = [line_handle(MEASURED, f"turbine{bounds}", marker="o", markersize=3)]
        if any(one.outliers for one in shown):
            made.append(line_handle(SIMULATED, "outlier", marker="o", markersize=3))
        made.append(line_handle(QUIET, "median"))
        if any(one.between > 0 for one in shown):
            made.append(area_handle(SHADE, "95 % of turbines"))
        return made

    return Panels(
        tuple(partial(_panel, one=one, named=named, most=most) for one in shown),
        height_in=max(height, 1.9),
        columns=len(shown),
        handles=handles,
    )


def _panel(axes: Axes, one: Spread, named: bool, most: int) -> None:
    order = np.argsort(one.x)
    value, error = np.exp(one.x[order]), one.error[order]
    place = np.arange(len(order))
    odd = np.isin(order, one.outliers)
    low, high = np.exp([one.center - REACH * one.between, one.center + REACH * one.between])
    axes.axvspan(low, high, color=SHADE, zorder=0)
    axes.axvline(np.exp(one.center), color=QUIET, linewidth=0.8, zorder=1)
    for chosen, colour in ((~odd, MEASURED), (odd, SIMULATED)):
        if np.isfinite(error).all() and chosen.any():
            ends = value[chosen] * np.exp(np.outer([-REACH, REACH], error[chosen]))
            axes.hlines(place[chosen], *ends, color=colour, linewidth=1.1 if named else 0.5, zorder=2)
        axes.plot(value[chosen], place[chosen], "o", color=colour, markersize=3.2 if named else 1.4, zorder=3)
    axes.set_ylim(-0.8, max(most, 2) - 0.2)
    if named:
        names = [one.turbines[i] for i in order]
        axes.set_yticks(place, [name if len(name) <= 18 else f"{name[:17]}…" for name in names])
        axes.tick_params(axis="y", length=0)
    else:
        axes.set_yticks([])
        axes.set_ylabel(f"{len(order)} turbines, from the least to the largest")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel(f"{one.compared.title} [{one.compared.unit}]")
    left, right = axes.get_xlim()
    if left <= 0 or right / left < 5.0:  # a decade's marks would leave such a narrow axis empty
        from matplotlib.ticker import MaxNLocator

        axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 2.5, 5, 10]))
    else:
        axes.set_xlim(max(left, 0.5 * value.min()), right)
        logarithmic(axes, "x", 4)
