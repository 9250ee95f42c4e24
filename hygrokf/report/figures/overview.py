"""All figures of a fit in the order of the report: pure functions from `fit.json` and `series.npz` to a figure.

Each takes (fit, series), the plain data of the two files, and raises `drawing.NothingToShow` with one sentence where
its data are missing.  `drawing.svg`, `drawing.inline_svg` and `drawing.png` turn a figure into text or bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.report.figures.composition import figure_composition
from hygrokf.report.figures.course import (
    figure_excerpts,
    figure_humidity,
    figure_residuals,
    figure_temperature,
)
from hygrokf.report.figures.identification import figure_heat_release, figure_profiles
from hygrokf.report.figures.innovations import figure_innovations

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "FIGURES",
    "Picture",
    "figure_composition",
    "figure_excerpts",
    "figure_heat_release",
    "figure_humidity",
    "figure_innovations",
    "figure_profiles",
    "figure_residuals",
    "figure_temperature",
]


@dataclass(frozen=True)
class Picture:
    """A figure of the report: `name` for identifiers, heading, one sentence that says what to look for."""

    name: str
    heading: str
    caption: str
    draw: Callable[[Mapping, Mapping[str, np.ndarray]], Figure]


def _humidity_innovations(fit: Mapping, series: Mapping[str, np.ndarray]) -> Figure:
    return figure_innovations(fit, series, "humidity")


FIGURES: tuple[Picture, ...] = (
    Picture(
        "temperature",
        "Cabinet temperature, whole record",
        "Red should follow blue through seasons, days and standstills, stay with its error around zero, and do in the "
        "shaded validation period as well as before it.",
        figure_temperature,
    ),
    Picture(
        "humidity",
        "Absolute humidity in the cabinet, whole record",
        "Inside and outside lie close together in most cabinets, so judge the model by whether red follows blue better "
        "than yellow does.",
        figure_humidity,
    ),
    Picture(
        "excerpts",
        "Three excerpts",
        "Look for the right lag after a change of load and at sunrise, and for the right level at standstill; blue should "
        "leave the band about one time in twenty.",
        figure_excerpts,
    ),
    Picture(
        "heat-release",
        "Heat release by operating point",
        "The points should scatter evenly around the curves of their own colour at every power; solid and dashed curves "
        "that part mean that stationary periods and the dynamic record disagree.",
        figure_heat_release,
    ),
    Picture(
        "profiles",
        "How well the time constants are pinned down",
        "The likelihood's own bounds (shaded) are where the curve crosses the dashed line; a curve that stays below it on "
        "one side leaves that side open, and a red bar outside the shading means that the two criteria disagree.",
        figure_profiles,
    ),
    Picture(
        "composition",
        "What the intervals are composed of",
        "Each bar adds one source of uncertainty to the bar above it, down to the interval that is reported; diamonds are "
        "other estimates, grey by another form of the model (as large as its share of the evidence), red by the free run.",
        figure_composition,
    ),
    Picture(
        "residuals",
        "Error of the free run by operating point",
        "Medians should lie on zero everywhere: a slope names what the model still lacks at that power, that temperature "
        "or that time of day.",
        figure_residuals,
    ),
    Picture(
        "innovations-temperature",
        "Innovations of the temperature",
        "Bars and curves should stay inside the grey bands and the dashed limits; red ones name the lag, the period or "
        "the input at which the one-step prediction still owes something.",
        figure_innovations,
    ),
    Picture(
        "innovations-humidity",
        "Innovations of the humidity",
        "As above for the humidity reading: bars beyond the dashed limits against an input at positive lags are an answer "
        "to that input that the model lacks.",
        _humidity_innovations,
    ),
)
