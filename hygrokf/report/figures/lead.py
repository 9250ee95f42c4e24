"""The picture of a result's first screen, for its page, its summary, and its `plot`; and that of one finding:
the episodes in which it is worst, or the whole record where it lasts for months.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np

from hygrokf.climate.study import RegionClimate, Study
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.discovery_results import LASTING_KINDS, CauseFound, DiscoveryResults, Finding
from hygrokf.discovery.residuals import HUMIDITY, TEMPERATURE, Quantity, Residuals, binned
from hygrokf.identification.fit_results import FitResults
from hygrokf.report.blocks import Figure
from hygrokf.report.climate_tables import share_held
from hygrokf.report.discovery_text import what_it_is
from hygrokf.report.figures.climate_figures import figure_duration, figure_joint, figure_regions
from hygrokf.report.figures.drawing import AMBIENT_COLOUR, INK, MEASURED, SIMULATED_COLOUR, NothingToShow
from hygrokf.report.figures.fit_figures import figure_of
from hygrokf.report.figures.panels import (
    Axis,
    Band,
    CrossLine,
    Curve,
    Limits,
    Mark,
    Panel,
    Picture,
    Shade,
    course,
    courses,
)
from hygrokf.report.figures.residual_structure import (
    EXTENDED_COLOUR,
    figure_drivers,
    held_out,
    telling_drivers,
)
from hygrokf.report.quantities import quantity
from hygrokf.texts.wording import percent, sentence

# -- one finding ---------------------------------------------------------------------------------------------
CONDITION = "#f3e3c0"
AMBIENT_NAME: Mapping[str, str] = {TEMPERATURE: "ambient_temperature", HUMIDITY: "ambient_absolute_humidity"}
EPISODES = 3
AROUND_H = (18.0, 42.0)
"""[h] shown on either side of an episode: at least, at most; in between half of the episode."""
LONGEST_STRETCH_H = 120.0
NARROW = 200
"""Stretches of time over the width of a panel."""
Span: TypeAlias = tuple[float, float]


# --- what to draw ----------------------------------------------------------------------------


def drawable(found: DiscoveryResults) -> list[Finding]:
    """The findings whose episodes can be drawn, worst first."""
    return [finding for finding in found.findings if finding.spans]


@dataclass(frozen=True)
class CauseEpisodes:
    """The stretches of time in which a cause was found, and the quantity that gained most there."""

    cause: CauseFound
    quantity: Quantity
    spans: tuple[Span, ...]
    kind: str = "episode"


def events(found: DiscoveryResults) -> list[CauseEpisodes]:
    """Accepted causes that were found in stretches of time."""
    result = []
    for cause in found.causes:
        spans = tuple((float(a), float(b)) for a, b in cause.settings.get("spans", ()) if a < b)
        gains = cause.evidence.gains
        if spans and gains:
            most = max(gains, key=lambda name: gains[name])
            result.append(CauseEpisodes(cause, TEMPERATURE if most == TEMPERATURE else HUMIDITY, spans))
    return result


# --- episodes --------------------------------------------------------------------------------


def figure_episodes(
    residuals: Residuals, finding: Finding | CauseEpisodes, after: Residuals | None = None
) -> Picture:
    """The episodes in which a finding is largest, with the free run's 95 % band and below it the error; of a
    lasting finding the daily means over the whole record."""
    name, terms = finding.quantity, quantity(finding.quantity)
    if name not in residuals.measured or not np.isfinite(residuals.error[name]).any():
        raise NothingToShow(f"There are no errors of the {terms.words} to show.")
    if finding.kind in LASTING_KINDS:
        return Picture((_lasting(residuals, finding, after),), height_in=2.5)
    windows = _windows(finding, residuals)
    if not windows:
        raise NothingToShow("The finding has no episodes.")
    models = _before_after(residuals, after)
    reach = max(_largest(one, name, *span) for one, _, _ in models for span, _ in windows)
    above, below = [], []
    for span, shaded in windows:
        x = Axis(limits=span, kind="time", most=5)
        where = [
            Shade(max(a, span[0]), min(b, span[1]), CONDITION, 0.75, "under the condition") for a, b in shaded
        ]
        marks, limits = _course(residuals, name, span, after)
        errors = [
            course(one.time_s, -one.error[name], span, colour, 1.0, bins=NARROW) for one, colour, _ in models
        ]
        above.append(Panel((*marks, *where), x, Axis(terms.level, limits)))
        y = Axis(terms.error, (-1.1 * reach, 1.1 * reach), most=5)
        below.append(Panel((*where, CrossLine(0.0, "y"), *errors), x, y))
    for row in (above, below):
        row[1:] = [replace(one, y=replace(one.y, label="")) for one in row[1:]]
    panels = (*above, *below)
    return Picture(panels, height_in=3.3, columns=len(windows), shared="x", heights=(2.3, 1.0))


def _largest(residuals: Residuals, name: str, start_s: float, end_s: float) -> float:
    inside = (residuals.time_s >= start_s) & (residuals.time_s <= end_s)
    return float(np.nanmax(np.abs(residuals.error[name][inside]), initial=0.0)) or 1.0


def _before_after(residuals: Residuals, after: Residuals | None) -> list[tuple[Residuals, str, str]]:
    """The models with the colours and the ends of the labels that they have."""
    if after is None:
        return [(residuals, SIMULATED_COLOUR, "")]
    return [(residuals, SIMULATED_COLOUR, ", before"), (after, EXTENDED_COLOUR, ", after")]


def _windows(finding: Finding | CauseEpisodes, residuals: Residuals) -> list[tuple[Span, list[Span]]]:
    """Up to three windows ((start, end), episodes in it) [s] in order of time around the worst episodes."""
    low, high = float(residuals.time_s[0]), float(residuals.time_s[-1])
    chosen: list[tuple[float, float]] = []
    for first, last in finding.spans:
        around = 3600.0 * float(np.clip(0.5 * (last - first) / 3600.0, *AROUND_H))
        last = min(last, first + 3600.0 * LONGEST_STRETCH_H)
        start, end = max(low, first - around), min(high, last + around)
        if all(end <= a or start >= b for a, b in chosen):
            chosen.append((start, end))
        if len(chosen) == EPISODES:
            break
    chosen.sort()
    return [((a, b), [span for span in finding.spans if span[1] > a and span[0] < b]) for a, b in chosen]


def _course(
    residuals: Residuals, name: str, span: Span, after: Residuals | None
) -> tuple[tuple[Mark, ...], Limits]:
    """Ambient, reading, simulation with its band, and the extended model's; and the limits."""
    shift = quantity(name).zero
    first, *later = _before_after(residuals, after)
    shown = [
        ("readings", residuals.measured[name] - shift, MEASURED, 1.3),
        (f"simulated{first[2]}", residuals.simulated[name] - shift, SIMULATED_COLOUR, 1.0),
    ]
    ambient = residuals.drivers.get(AMBIENT_NAME[name])
    if ambient is not None:
        shown.insert(0, ("ambient", ambient - shift, AMBIENT_COLOUR, 0.9))
    marks, limits = courses(residuals.time_s, shown, residuals.sd.get(name), span, NARROW)
    extended = (
        course(one.time_s, one.simulated[name] - shift, span, colour, 1.2, f"simulated{end}", NARROW)
        for one, colour, end in later
    )
    return (*marks, *extended), limits


def _lasting(residuals: Residuals, finding: Finding | CauseEpisodes, after: Residuals | None) -> Panel:
    hours = binned(residuals)
    marks: list[Mark] = [CrossLine(0.0, "y")]
    for one, colour, end in _before_after(residuals, after):
        day, mean, low, high = _daily(one, finding.quantity)
        marks.append(Curve(day, mean, colour, 1.0, f"daily mean{end}"))
        if one is residuals:
            marks.append(Band(day, low, high, colour, 0.13, "middle 80 % of the day"))
    inside = np.zeros(len(hours.time_h), dtype=bool)
    for first, last in finding.spans:
        marks.append(Shade(first, last, CONDITION, 0.6, "where the finding is"))
        inside |= (hours.time_s >= first) & (hours.time_s <= last)
    error = -hours.error[finding.quantity]
    for flag in (inside, ~inside):
        if np.isfinite(error[flag]).any():
            level = np.where(flag, np.nanmean(error[flag]), np.nan)
            marks.append(Curve(hours.time_s, level, INK, 1.1, "mean of either part", dashed=True))
    span = (float(residuals.time_s[0]), float(residuals.time_s[-1]))
    marks += held_out(residuals, span)
    y = Axis(quantity(finding.quantity).excess, most=6)
    return Panel(tuple(marks), Axis(limits=span, kind="time"), y)


def _daily(residuals: Residuals, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Day's noon [s], mean and 10th and 90th percentile of simulation − reading."""
    error = -residuals.error[name]
    there = np.isfinite(error)
    number = np.floor(residuals.time_s[there] / DAY_S).astype(int)
    starts = np.flatnonzero(np.append(True, np.diff(number) > 0))
    parts = np.split(error[there], starts[1:])
    rows = [(np.mean(part), *np.quantile(part, [0.1, 0.9])) for part in parts]
    return (number[starts] + 0.5) * DAY_S, *np.array(rows).T


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
    shown: list[Finding | CauseEpisodes] = [*drawable(found)[:EPISODE_FIGURES], *events(found)]
    return [
        Figure(
            f"episodes-{place}",
            sentence(what_it_is(one.cause) if isinstance(one, CauseEpisodes) else one.statement.text),
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
