"""The picture of a result's first screen, for its page, its summary, and its `plot`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.climate.study import Study
from hygrokf.discovery.discovery_results import DiscoveryResults
from hygrokf.discovery.residuals import Residuals
from hygrokf.identification.wording import percent, sentence
from hygrokf.report.climate_tables import share_held
from hygrokf.report.figures.climate import (
    DURATION_CAPTION,
    JOINT_CAPTION,
    REGIONS_CAPTION,
    duration_panels,
    joint_panels,
    region_panels,
)
from hygrokf.report.figures.course import validation_panels
from hygrokf.report.figures.drawing import NothingToShow
from hygrokf.report.figures.findings import drawable, episode_panels, episodes_caption, events
from hygrokf.report.figures.fit import FIGURES
from hygrokf.report.figures.panels import Panels
from hygrokf.report.figures.residual_structure import (
    DRIVERS_HEADING,
    driver_panels,
    drivers_caption,
    telling_drivers,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

YEAR_HEADING = "The year by temperature and relative humidity"
DURATION_HEADING = "Duration curves"
REGIONS_HEADING = "Regions side by side"


@dataclass(frozen=True)
class Lead:
    """A picture with its heading and a caption that says what to look for."""

    heading: str
    caption: str
    panels: Panels

    def figure(self, height_in: float = 0.0) -> Figure:
        """The picture on a figure of a page's width; of its own height unless one [in] is given."""
        return self.panels.figure(height_in)


def lead_of_fit(series: Mapping[str, np.ndarray]) -> Lead:
    """Readings and free run after the identification period.  Raises NothingToShow."""
    return Lead(FIGURES[0].heading, FIGURES[0].caption, validation_panels(series))


def lead_of_discovery(found: DiscoveryResults, before: Residuals | None, after: Residuals | None) -> Lead:
    """The worst finding that can be drawn, else the event of a cause, else the errors over the drivers.

    Raises NothingToShow.
    """
    if before is None:
        raise NothingToShow("The discovery holds no residuals.")
    overlaid = after is not None
    shown = [*drawable(found), *events(found)]
    if shown:
        panels = episode_panels(before, shown[0], after)
        return Lead(sentence(shown[0].statement), episodes_caption(overlaid), panels)
    panels = driver_panels(before, telling_drivers(before), after)
    return Lead(DRIVERS_HEADING, drivers_caption(overlaid), panels)


def lead_of_climate(study: Study) -> Lead:
    """Regions side by side; of a single one the year by temperature and humidity, or duration curves.

    Raises NothingToShow.
    """
    regions = study.regions
    share = share_held(regions)
    if len(regions) > 1:
        means = percent(min(one.mean_bounds_hold for one in regions))
        return Lead(REGIONS_HEADING, REGIONS_CAPTION.format(years=share, means=means), region_panels(regions))
    if regions[0].joint is not None:
        return Lead(YEAR_HEADING, JOINT_CAPTION, joint_panels(regions[0]))
    return Lead(DURATION_HEADING, DURATION_CAPTION.format(share=share), duration_panels(regions[0]))
