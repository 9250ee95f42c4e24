"""Figures of a climate: pure functions of its result."""

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
    """Hours a year by temperature and relative humidity, in the cabinet and outside."""
    joint = region.joint
    if joint is None:
        raise NothingToShow("The model has no humidity.")
    warm, damp = joint.temperature_edges_degC, joint.humidity_edges_percent
    shown = {"in the cabinet": joint.hours, "outside": joint.outside}
    top = max(2.0, *(float(one.max()) for one in shown.values()))
    used = np.flatnonzero(np.any([(one >= 1.0).any(axis=1) for one in shown.values()], axis=0))
    x = Axis("temperature [°C]", (warm[used[0]] - 1.0, warm[used[-1] + 1] + 1.0))
    y = Axis("relative humidity [%]", (0.0, 100.0), at=range(0, 101, 20))
    ticks = tuple(float(t) for t in (1, 3, 10, 30, 100, 300, 1000) if t <= top)
    scale = ColourScale(SHADES, "hours a year", 1.0, top, logarithmic=True, ticks=ticks, missing="white")
    panels = tuple(
        Panel(
            (
                Map(warm, damp, np.where(hours >= 1.0, hours, np.nan), scale),
                CrossLine(80.0, "y", SIMULATED_COLOUR, 0.8),
            ),
            x,
            y,
            title,
        )
        for title, hours in shown.items()
    )
    return Picture(panels, height_in=2.7, columns=2, shared="y", scale=scale)


def figure_duration(region: RegionClimate) -> Picture:
    """Duration curves of the quantities, then those of their rates, with bounds."""
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


def _duration(curve: DurationCurve, title: str, label: str, rate: bool) -> Panel:
    share = 100.0 * curve.share_beyond
    # of rates only the steep end is of interest
    kept = (share > 0.0) & (share <= 50.0) if rate else np.ones(len(share), bool)
    share = share[kept]
    words = "share of the time beyond [%]"
    x = Axis(words, (0.0, 100.0))
    if rate:
        at = (0.1, 1.0, 10.0, 50.0)
        x = Axis(words, (share.min(), 50.0), "logarithmic", at, [f"{one:g}" for one in at])
    marks = (
        Curve(share, curve.value[kept], MEASURED, label="cabinet, simulated"),
        Band(share, curve.lower[kept], curve.upper[kept], MEASURED, 0.25, label),
        Curve(share, curve.outside[kept], AMBIENT_COLOUR, label="outside", dashed=True),
    )
    return Panel(marks, x, title=title)


def figure_profile(region: RegionClimate) -> Picture:
    """The test profile: temperature and relative humidity over its hours."""
    profile = region.test_profile
    if profile is None:
        raise NothingToShow("There is no test profile of this climate.")
    hours = np.arange(len(profile.temperature_degC))
    warm = (
        Curve(hours, profile.temperature_degC, SIMULATED_COLOUR, 0.7, "test"),
        Curve(hours, profile.site_temperature_degC, QUIET, 0.6, "the same hours at the site"),
    )
    damp = (Curve(hours, profile.relative_humidity_percent, MEASURED, 0.7),)
    x = Axis("hours of the test", (0.0, float(len(hours))))
    panels = (
        Panel(warm, x, Axis("temperature [°C]")),
        Panel(damp, x, Axis("relative humidity [%]", (0.0, 100.0))),
    )
    return Picture(panels, height_in=3.7, shared="x")


def figure_regions(regions: Sequence[RegionClimate]) -> Picture:
    """Regions side by side in the numbers by which they are compared, with bounds for a year and for the
    mean."""
    if len(regions) < 2:
        raise NothingToShow("There is only one region.")
    chosen = compared_statistics(regions)
    panels = []
    for statistic in chosen:
        marks: list[Mark] = []
        for place, region in enumerate(regions):
            found = region.year[statistic.name]
            marks.append(bounds(found.lower, found.upper, place, MEASURED, 1.2, 1.0))
            marks.append(bounds(found.mean_lower, found.mean_upper, place, MEASURED, 3.6, 0.45))
            marks.append(point(found.value, place, "o", INK, 3.2))
        words = textwrap.fill(short_words(statistic), 64 // len(chosen), break_long_words=False)
        labels = rows([region.name for region in regions])
        panels.append(Panel(tuple(marks), y=labels, title=f"{words}\n[{statistic.unit}]", plain=True))
    return Picture(tuple(panels), 0.95 + 0.3 * len(regions), columns=len(chosen), shared="y")


def short_words(statistic: YearNumber) -> str:
    """A number of a climate in two or three words."""
    return statistic.words.split(" (")[0].split(" on ")[0].split(",")[0].replace("relative ", "")
