"""All figures of a fit in the order of the report.

Each function takes (fit, series), the content of `fit.json` and `series.npz`, and raises
`drawing.NothingToShow` with one sentence where its data are missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Picture:
    """A figure of the report: `name` for identifiers, heading, and a caption that says what to look for."""

    name: str
    heading: str
    caption: str
    draw: Callable[[FitResults, Mapping[str, np.ndarray]], Panels]

    def of(self, fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
        """The picture of one fit as a block of its page."""
        return Figure(self.name, self.heading, self.caption, lambda: self.draw(fit, series))


FIGURES: tuple[Picture, ...] = (
    Picture(
        "validation",
        "Readings and free run after the identification period",
        "The model saw the weather and the power of these days, and no reading of the cabinet. Red should "
        "follow blue, and about one blue reading in twenty should lie outside the 95 % band.",
        figure_validation,
    ),
    Picture(
        "temperature",
        "Cabinet temperature, whole record",
        "Red should follow blue through seasons, days and standstills, with an error around zero, before and "
        "in the shaded validation period.",
        figure_temperature,
    ),
    Picture(
        "humidity",
        "Absolute humidity in the cabinet, whole record",
        "The humidity inside and outside is similar in most cabinets: a useful model follows blue more "
        "closely than yellow does.",
        figure_humidity,
    ),
    Picture(
        "excerpts",
        "Three excerpts",
        "Check the lag after a change of load and at sunrise, and the level at standstill. About one blue "
        "reading in twenty should lie outside the band.",
        figure_excerpts,
    ),
    Picture(
        "heat-release",
        "Heat release by operating point",
        "The points should scatter evenly around the curve of their own colour at every power. Where solid "
        "and dashed curves differ, the stationary periods and the dynamic record disagree.",
        figure_heat_release,
    ),
    Picture(
        "profiles",
        "How well the record determines the time constants",
        "The likelihood's own bounds (shaded) lie where the curve crosses the dashed line. A curve that "
        "stays below the line on one side leaves that side open. A red bar outside the shading means that "
        "the two criteria disagree.",
        figure_profiles,
    ),
    Picture(
        "composition",
        "Sources of uncertainty in the intervals",
        "Each bar adds one source of uncertainty to the bar above it; the last bar is the reported interval. "
        "Diamonds are other estimates: grey from other forms of the model (sized by their weights), red from "
        "the free run.",
        figure_composition,
    ),
    Picture(
        "residuals",
        "Error of the free run by operating point",
        "The medians should lie on zero everywhere. Others show at which power, temperature or hour the "
        "model is wrong.",
        figure_residuals,
    ),
    Picture(
        "innovations-temperature",
        "Innovations of the temperature",
        "Bars and curves should stay inside the grey bands and the dashed limits. Red marks the lag, the "
        "period or the input with which the one-step predictions are still correlated.",
        figure_innovations,
    ),
    Picture(
        "innovations-humidity",
        "Innovations of the humidity",
        "As above. Bars beyond the dashed limits at positive lags of an input show a response to that input "
        "that the model lacks.",
        partial(figure_innovations, output="humidity"),
    ),
)
