"""All figures of a fit in the order of the report.

Each function takes (fit, series), the content of `fit.json` and `series.npz`, and raises
`drawing.NothingToShow` with one sentence where its data are missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from hygrokf.identification.fit_results import FitResults
from hygrokf.report.blocks import Figure
from hygrokf.report.figures.course import (
    figure_excerpts,
    figure_humidity,
    figure_residuals,
    figure_temperature,
    figure_validation,
)
from hygrokf.report.figures.identification import figure_composition, figure_heat_release, figure_profiles
from hygrokf.report.figures.innovations import figure_innovations
from hygrokf.report.figures.panels import Panels

FIGURES: Mapping[str, tuple[str, str, Callable[[FitResults, Mapping[str, np.ndarray]], Panels]]] = {
    "validation": (
        "Readings and free run after the identification period",
        "The model saw the weather and the power of these days, and no reading of the cabinet. Red should "
        "follow blue, and about one blue reading in twenty should lie outside the 95 % band.",
        figure_validation,
    ),
    "temperature": (
        "Cabinet temperature, whole record",
        "Red should follow blue through seasons, days and standstills, with an error around zero, before and "
        "in the shaded validation period.",
        figure_temperature,
    ),
    "humidity": (
        "Absolute humidity in the cabinet, whole record",
        "The humidity inside and outside is similar in most cabinets: a useful model follows blue more "
        "closely than yellow does.",
        figure_humidity,
    ),
    "excerpts": (
        "Three excerpts",
        "Check the lag after a change of load and at sunrise, and the level at standstill. About one blue "
        "reading in twenty should lie outside the band.",
        figure_excerpts,
    ),
    "heat-release": (
        "Heat release by operating point",
        "The points should scatter evenly around the curve of their own colour at every power. Where solid "
        "and dashed curves differ, the stationary periods and the dynamic record disagree.",
        figure_heat_release,
    ),
    "profiles": (
        "How well the record determines the time constants",
        "The likelihood's own bounds (shaded) lie where the curve crosses the dashed line. A curve that "
        "stays below the line on one side leaves that side open. A red bar outside the shading means that "
        "the two criteria disagree.",
        figure_profiles,
    ),
    "composition": (
        "Sources of uncertainty in the intervals",
        "Each bar adds one source of uncertainty to the bar above it; the last bar is the reported interval. "
        "Diamonds are other estimates: grey from other forms of the model (sized by their weights), red from "
        "the free run.",
        figure_composition,
    ),
    "residuals": (
        "Error of the free run by operating point",
        "The medians should lie on zero everywhere. Others show at which power, temperature or hour the "
        "model is wrong.",
        figure_residuals,
    ),
    "innovations-temperature": (
        "Innovations of the temperature",
        "Bars and curves should stay inside the grey bands and the dashed limits. Red marks the lag, the "
        "period or the input with which the one-step predictions are still correlated.",
        figure_innovations,
    ),
    "innovations-humidity": (
        "Innovations of the humidity",
        "As above. Bars beyond the dashed limits at positive lags of an input show a response to that input "
        "that the model lacks.",
        partial(figure_innovations, output="humidity"),
    ),
}
"""By name: heading, caption that says what to look for, and what draws it."""


def figure_of(name: str, fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
    """One of `FIGURES` as a block of the page of a fit."""
    heading, caption, draw = FIGURES[name]
    return Figure(name, heading, caption, lambda: draw(fit, series))
