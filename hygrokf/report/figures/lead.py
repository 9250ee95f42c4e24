"""The picture of a result's first screen, for its page, its summary, and its `plot`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from hygrokf.climate.study import RegionClimate, Study
from hygrokf.discovery.discovery_results import DiscoveryResults, Finding
from hygrokf.discovery.residuals import Residuals
from hygrokf.identification.fit_results import FitResults
from hygrokf.report.blocks import Figure
from hygrokf.report.climate_tables import share_held
from hygrokf.report.discovery_text import what_it_is
from hygrokf.report.figures.climate_figures import figure_duration, figure_joint, figure_regions
from hygrokf.report.figures.drawing import NothingToShow
from hygrokf.report.figures.findings_figures import Event, drawable, events, figure_episodes
from hygrokf.report.figures.fit_figures import figure_of
from hygrokf.report.figures.residual_structure import figure_drivers, telling_drivers
from hygrokf.texts.wording import percent, sentence

EPISODE_FIGURES = 3
JOINT_CAPTION = (
    "Hours a year in bins of 2.5 K and 5 %. Above the red line (80 %) a surface counts as wet. With the same "
    "water vapour content a warmer cabinet has a lower relative humidity than the outside air."
)
DURATION_CAPTION = (
    "The share of the time for which a value is exceeded. The band holds {share} of single years; it "
    "includes the uncertainty of the parameters, the disturbances, and the differences between the years of "
    "weather."
)
REGIONS_CAPTION = (
    "Thin: bounds that hold {years} of single years. Thick: bounds that hold {means} of the means over all "
    "years."
)


def lead_of_fit(series: Mapping[str, np.ndarray]) -> Figure:
    """Readings and free run after the identification period."""
    return figure_of("validation", FitResults(), series)


def lead_of_discovery(found: DiscoveryResults, before: Residuals | None, after: Residuals | None) -> Figure:
    """The worst finding that can be drawn, else the event of a cause, else the errors over the drivers.

    Raises NothingToShow where there are no residuals.
    """
    if before is None:
        raise NothingToShow("The discovery holds no residuals.")
    return [*episodes(found, before, after), errors_over_drivers(found, before, after)][0]


def episodes(found: DiscoveryResults, before: Residuals, after: Residuals | None) -> list[Figure]:
    """Readings, base and extended model in the worst findings, and where causes were found in stretches of
    time."""
    compare = "." if after is None else ": compare the base model (red) with the extended one (green)."
    caption = f"Where the background is shaded the simulation should stay with the blue readings{compare}"
    shown: list[Finding | Event] = [*drawable(found)[:EPISODE_FIGURES], *events(found)]
    return [
        Figure(
            f"episodes-{place}",
            sentence(what_it_is(one.cause) if isinstance(one, Event) else one.statement.text),
            caption if place == 1 else "",
            partial(figure_episodes, before, one, after),
        )
        for place, one in enumerate(shown, start=1)
    ]


def errors_over_drivers(found: DiscoveryResults, before: Residuals, after: Residuals | None) -> Figure:
    """The errors over those drivers that the findings name, then over the most telling ones."""
    drivers = [one.driver for one in drawable(found) if one.driver]
    bend = (
        "; a bend shows what the model lacks."
        if after is None
        else "; where the red medians bend and the green ones stay flat, the cause explains the bend. Where "
        "only green shows, both are alike."
    )
    return Figure(
        "drivers",
        "Error against what drives the cabinet",
        f"Medians should lie on zero along every driver{bend}",
        lambda: figure_drivers(before, telling_drivers(before, drivers), after),
    )


def lead_of_climate(study: Study) -> Figure:
    """Regions side by side; of a single one the year by temperature and humidity, or duration curves."""
    regions = study.regions
    if len(regions) == 1:
        return year_figure(regions[0], 1)
    means = percent(min(region.mean_bounds_hold for region in regions))
    caption = REGIONS_CAPTION.format(years=share_held(regions), means=means)
    return Figure("regions", "Regions side by side", caption, partial(figure_regions, regions))


def year_figure(region: RegionClimate, place: int) -> Figure:
    """The picture of the year: temperature with humidity, or duration curves without humidity."""
    if region.joint is None:
        return duration_figure(region, place)
    heading = "The year by temperature and relative humidity"
    return Figure(f"r{place}-joint", heading, JOINT_CAPTION, partial(figure_joint, region))


def duration_figure(region: RegionClimate, place: int) -> Figure:
    """The duration curves of a region."""
    caption = DURATION_CAPTION.format(share=share_held([region]))
    return Figure(f"r{place}-duration", "Duration curves", caption, partial(figure_duration, region))
