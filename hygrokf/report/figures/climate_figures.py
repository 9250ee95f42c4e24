"""Figures of a climate study: joint distribution, duration curves, test profile, and regions side by side."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np

from hygrokf.climate.statistics import YearNumber
from hygrokf.climate.study import DurationCurve, RegionClimate
from hygrokf.report.climate_tables import compared_statistics, share_held
from hygrokf.report.figures.drawing import (
    AMBIENT_COLOUR,
    INK,
    MEASURED,
    QUIET,
    SIMULATED_COLOUR,
    NothingToShow,
)
from hygrokf.report.figures.panels import (
    Axis,
    Band,
    ColourScale,
    CrossLine,
    Curve,
    Map,
    Mark,
    Panel,
    Picture,
    bounds,
    point,
    rows,
)

SHADES = ("#ffffff", "#dbe7f3", "#a9c8e4", "#6ba3d0", "#2f74b0", "#16365c")
PANELS = (
    ("duration", "temperature_degC", "temperature [°C]"),
    ("duration", "relative_humidity_percent", "relative humidity [%]"),
    ("duration", "absolute_humidity_g_m3", "absolute humidity [g/m³]"),
    ("rates", "temperature", "rate of temperature [K/h]"),
    ("rates", "relative_humidity", "rate of humidity [%/h]"),
)


def figure_joint(region: RegionClimate) -> Picture:
    """Draw the hours a year by temperature and relative humidity, in the cabinet and outside."""
    joint = region.joint
    if joint is None:
        raise NothingToShow("The model has no humidity.")
    temperature_edges, humidity_edges = joint.temperature_edges_degC, joint.humidity_edges_percent
    hours_by_place = {"in the cabinet": joint.hours, "outside": joint.outside}
    most_hours = max(2.0, *(float(hours.max()) for hours in hours_by_place.values()))
    is_used = [(hours >= 1.0).any(axis=1) for hours in hours_by_place.values()]
    used_rows = np.flatnonzero(np.any(is_used, axis=0))
    first, last = used_rows[0], used_rows[-1]
    x = Axis("temperature [°C]", (temperature_edges[first] - 1.0, temperature_edges[last + 1] + 1.0))
    y = Axis("relative humidity [%]", (0.0, 100.0), at=range(0, 101, 20))
    ticks = tuple(float(tick) for tick in (1, 3, 10, 30, 100, 300, 1000) if tick <= most_hours)
    scale = ColourScale(
        SHADES, "hours a year", 1.0, most_hours, logarithmic=True, ticks=ticks, missing="white"
    )
    wet_from = CrossLine(80.0, "y", SIMULATED_COLOUR, 0.8)
    panels = []
    for title, hours in hours_by_place.items():
        shown_hours = np.where(hours >= 1.0, hours, np.nan)
        panels.append(
            Panel((Map(temperature_edges, humidity_edges, shown_hours, scale), wet_from), x, y, title)
        )
    return Picture(tuple(panels), height_in=2.7, columns=2, shared="y", scale=scale)


def figure_duration(region: RegionClimate) -> Picture:
    """Draw the duration curves of the quantities, then those of their rates, with bounds."""
    curves = {"duration": region.duration, "rates": region.rates}
    band = f"{share_held([region])} of single years"
    panels = tuple(
        _duration(curves[kind][name], label, band, kind == "rates")
        for kind, name, label in PANELS
        if name in curves[kind]
    )
    if not panels:
        raise NothingToShow("The result has no duration curves.")
    return Picture(panels, height_in=2.4 if len(panels) < 4 else 4.5, columns=min(3, len(panels)))


def _duration(curve: DurationCurve, title: str, band_label: str, is_rate: bool) -> Panel:
    """Return the panel of one duration curve: cabinet with its bounds, and weather."""
    share = 100.0 * curve.share_beyond
    # of rates only the steep end is of interest
    kept = (share > 0.0) & (share <= 50.0) if is_rate else np.ones(len(share), bool)
    share = share[kept]
    x_label = "share of the time beyond [%]"
    x = Axis(x_label, (0.0, 100.0))
    if is_rate:
        ticks = (0.1, 1.0, 10.0, 50.0)
        x = Axis(x_label, (share.min(), 50.0), "logarithmic", ticks, [f"{tick:g}" for tick in ticks])
    marks = (
        Curve(share, curve.value[kept], MEASURED, label="cabinet, simulated"),
        Band(share, curve.lower[kept], curve.upper[kept], MEASURED, 0.25, band_label),
        Curve(share, curve.outside[kept], AMBIENT_COLOUR, label="outside", dashed=True),
    )
    return Panel(marks, x, title=title)


def figure_profile(region: RegionClimate) -> Picture:
    """Draw the test profile: temperature and relative humidity over its hours."""
    profile = region.test_profile
    if profile is None:
        raise NothingToShow("There is no test profile of this climate.")
    hours = np.arange(len(profile.temperature_degC))
    temperatures = (
        Curve(hours, profile.temperature_degC, SIMULATED_COLOUR, 0.7, "test"),
        Curve(hours, profile.site_temperature_degC, QUIET, 0.6, "the same hours at the site"),
    )
    humidities = (Curve(hours, profile.relative_humidity_percent, MEASURED, 0.7),)
    x = Axis("hours of the test", (0.0, float(len(hours))))
    panels = (
        Panel(temperatures, x, Axis("temperature [°C]")),
        Panel(humidities, x, Axis("relative humidity [%]", (0.0, 100.0))),
    )
    return Picture(panels, height_in=3.7, shared="x")


def figure_regions(regions: Sequence[RegionClimate]) -> Picture:
    """Draw regions side by side in the numbers by which they are compared; thin lines: bounds of a year,
    thick lines: bounds of the mean."""
    if len(regions) < 2:
        raise NothingToShow("There is only one region.")
    chosen = compared_statistics(regions)
    panels = []
    for statistic in chosen:
        marks: list[Mark] = []
        for row, region in enumerate(regions):
            bounded = region.year[statistic.name]
            marks.append(bounds(bounded.lower, bounded.upper, row, MEASURED, 1.2, 1.0))
            marks.append(bounds(bounded.mean_lower, bounded.mean_upper, row, MEASURED, 3.6, 0.45))
            marks.append(point(bounded.value, row, "o", INK, 3.2))
        title = textwrap.fill(short_words(statistic), 64 // len(chosen), break_long_words=False)
        labels = rows([region.name for region in regions])
        panels.append(Panel(tuple(marks), y=labels, title=f"{title}\n[{statistic.unit}]", plain=True))
    return Picture(tuple(panels), 0.95 + 0.3 * len(regions), columns=len(chosen), shared="y")


def short_words(statistic: YearNumber) -> str:
    """Return the name of a climate's number in two or three words."""
    return statistic.words.split(" (")[0].split(" on ")[0].split(",")[0].replace("relative ", "")
