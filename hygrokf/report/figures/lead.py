"""Lead figures: the picture at the top of a result's page, which its summary and its method `plot` also show;
and the figure of one finding of a discovery, with its worst episodes or, for a finding that lasts for months,
the whole record."""

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
from hygrokf.report.figures.course_panels import courses
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
"""[h] shortest and longest time shown before and after an episode; between these limits, half its length."""
LONGEST_STRETCH_H = 120.0
"""[h] longest part of an episode that is shown."""
NARROW = 200
"""Bins of time over the width of a panel."""
Span: TypeAlias = tuple[float, float]


# --- what to draw ----------------------------------------------------------------------------


def drawable(found: DiscoveryResults) -> list[Finding]:
    """Return the findings that have episodes to draw, worst first."""
    return [finding for finding in found.findings if finding.spans]


@dataclass(frozen=True)
class CauseEpisodes:
    """The spans of time in which an accepted cause acts, and the quantity that gains most from it."""

    cause: CauseFound
    quantity: Quantity
    spans: tuple[Span, ...]
    kind: str = "episode"


def events(found: DiscoveryResults) -> list[CauseEpisodes]:
    """Return the accepted causes that act only in certain spans of time, with these spans."""
    result = []
    for cause in found.causes:
        stated_spans = cause.settings.get("spans", ())
        spans = tuple((float(start), float(end)) for start, end in stated_spans if start < end)
        gains = cause.evidence.gains
        if spans and gains:
            best = max(gains, key=lambda name: gains[name])
            result.append(CauseEpisodes(cause, TEMPERATURE if best == TEMPERATURE else HUMIDITY, spans))
    return result


# --- episodes --------------------------------------------------------------------------------


def figure_episodes(
    residuals: Residuals, finding: Finding | CauseEpisodes, after: Residuals | None = None
) -> Picture:
    """Draw up to three of the worst episodes of a finding, side by side: above, readings and free run with
    its 95 % band; below, the error of the free run. For a finding that lasts for months: daily means of the
    error over the whole record.

    after: residuals of the extended model, drawn beside those of the base model; None: the base model alone.
    Raises NothingToShow where the quantity has no errors or the finding no episodes.
    """
    name, terms = finding.quantity, quantity(finding.quantity)
    if name not in residuals.measured or not np.isfinite(residuals.error[name]).any():
        raise NothingToShow(f"There are no errors of the {terms.words} to show.")
    if finding.kind in LASTING_KINDS:
        return Picture((_lasting(residuals, finding, after),), height_in=2.5)
    windows = _windows(finding, residuals)
    if not windows:
        raise NothingToShow("The finding has no episodes.")
    models = _before_after(residuals, after)
    largest_error = max(_largest(model, name, *window) for model, _, _ in models for window, _ in windows)
    level_panels, error_panels = [], []
    for window, episodes in windows:
        x = Axis(limits=window, kind="time", most=5)
        shades = [
            Shade(max(first_s, window[0]), min(last_s, window[1]), CONDITION, 0.75, "under the condition")
            for first_s, last_s in episodes
        ]
        marks, limits = _course(residuals, name, window, after)
        errors = [
            course(model.time_s, -model.error[name], window, colour, 1.0, bins=NARROW)
            for model, colour, _ in models
        ]
        level_panels.append(Panel((*marks, *shades), x, Axis(terms.level, limits)))
        y = Axis(terms.error, (-1.1 * largest_error, 1.1 * largest_error), most=5)
        error_panels.append(Panel((*shades, CrossLine(0.0, "y"), *errors), x, y))
    for row in (level_panels, error_panels):
        row[1:] = [replace(panel, y=replace(panel.y, label="")) for panel in row[1:]]
    panels = (*level_panels, *error_panels)
    return Picture(panels, height_in=3.3, columns=len(windows), shared="x", heights=(2.3, 1.0))


def _largest(residuals: Residuals, name: str, start_s: float, end_s: float) -> float:
    """The largest absolute error between two instants [s], in the quantity's unit; 1 where there is none."""
    inside = (residuals.time_s >= start_s) & (residuals.time_s <= end_s)
    return float(np.nanmax(np.abs(residuals.error[name][inside]), initial=0.0)) or 1.0


def _before_after(residuals: Residuals, after: Residuals | None) -> list[tuple[Residuals, str, str]]:
    """Return each model's residuals with the colour of its line and the words that end its label."""
    if after is None:
        return [(residuals, SIMULATED_COLOUR, "")]
    return [(residuals, SIMULATED_COLOUR, ", before"), (after, EXTENDED_COLOUR, ", after")]


def _windows(finding: Finding | CauseEpisodes, residuals: Residuals) -> list[tuple[Span, list[Span]]]:
    """Up to `EPISODES` windows (start, end) [s] around the worst episodes, each with its episodes."""
    low, high = float(residuals.time_s[0]), float(residuals.time_s[-1])
    windows: list[tuple[float, float]] = []
    for first, last in finding.spans:
        around = 3600.0 * float(np.clip(0.5 * (last - first) / 3600.0, *AROUND_H))
        last = min(last, first + 3600.0 * LONGEST_STRETCH_H)
        start, end = max(low, first - around), min(high, last + around)
        if all(end <= other_start or start >= other_end for other_start, other_end in windows):
            windows.append((start, end))
        if len(windows) == EPISODES:
            break
    windows.sort()
    return [
        ((start, end), [span for span in finding.spans if span[1] > start and span[0] < end])
        for start, end in windows
    ]


def _course(
    residuals: Residuals, name: str, span: Span, after: Residuals | None
) -> tuple[tuple[Mark, ...], Limits]:
    """The marks of one window: ambient, readings, simulations, band; and the limits of the y axis."""
    zero = quantity(name).zero
    base, *extensions = _before_after(residuals, after)
    lines = [
        ("readings", residuals.measured[name] - zero, MEASURED, 1.3),
        (f"simulated{base[2]}", residuals.simulated[name] - zero, SIMULATED_COLOUR, 1.0),
    ]
    ambient = residuals.drivers.get(AMBIENT_NAME[name])
    if ambient is not None:
        lines.insert(0, ("ambient", ambient - zero, AMBIENT_COLOUR, 0.9))
    marks, limits = courses(residuals.time_s, lines, residuals.sd.get(name), span, NARROW)
    extended = (
        course(model.time_s, model.simulated[name] - zero, span, colour, 1.2, f"simulated{suffix}", NARROW)
        for model, colour, suffix in extensions
    )
    return (*marks, *extended), limits


def _lasting(residuals: Residuals, finding: Finding | CauseEpisodes, after: Residuals | None) -> Panel:
    """Return the panel of a lasting finding: daily means of the error over the record, shaded where the
    finding holds, with the mean error inside and outside the shade."""
    hours = binned(residuals)
    marks: list[Mark] = [CrossLine(0.0, "y")]
    for model, colour, suffix in _before_after(residuals, after):
        day, mean, low, high = _daily(model, finding.quantity)
        marks.append(Curve(day, mean, colour, 1.0, f"daily mean{suffix}"))
        if model is residuals:
            marks.append(Band(day, low, high, colour, 0.13, "middle 80 % of the day"))
    inside = np.zeros(len(hours.time_h), dtype=bool)
    for start_s, end_s in finding.spans:
        marks.append(Shade(start_s, end_s, CONDITION, 0.6, "where the finding is"))
        inside |= (hours.time_s >= start_s) & (hours.time_s <= end_s)
    error = -hours.error[finding.quantity]
    for is_chosen in (inside, ~inside):
        if np.isfinite(error[is_chosen]).any():
            level = np.where(is_chosen, np.nanmean(error[is_chosen]), np.nan)
            marks.append(Curve(hours.time_s, level, INK, 1.1, "mean of either part", dashed=True))
    span = (float(residuals.time_s[0]), float(residuals.time_s[-1]))
    marks += held_out(residuals, span)
    y = Axis(quantity(finding.quantity).excess, most=6)
    return Panel(tuple(marks), Axis(limits=span, kind="time"), y)


def _daily(residuals: Residuals, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """For each day with a reading: noon [s], mean, 10th and 90th percentile of simulation − reading."""
    error = -residuals.error[name]
    is_known = np.isfinite(error)
    day = np.floor(residuals.time_s[is_known] / DAY_S).astype(int)
    starts = np.flatnonzero(np.append(True, np.diff(day) > 0))
    errors_by_day = np.split(error[is_known], starts[1:])
    rows = [(np.mean(errors), *np.quantile(errors, [0.1, 0.9])) for errors in errors_by_day]
    return (day[starts] + 0.5) * DAY_S, *np.array(rows).T


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
    """Return the figure of readings and free run after the identification period."""
    return figure_of("validation", FitResults(), series)


def lead_of_discovery(found: DiscoveryResults, before: Residuals | None, after: Residuals | None) -> Figure:
    """Return the figure of the worst finding; without one, of a cause that acts in spans of time; else the
    errors over the drivers.

    Raises NothingToShow without residuals.
    """
    if before is None:
        raise NothingToShow("The discovery holds no residuals.")
    return [*episodes(found, before, after), errors_over_drivers(found, before, after)][0]


def episodes(found: DiscoveryResults, before: Residuals, after: Residuals | None) -> list[Figure]:
    """Return one figure for each of the worst findings and for each cause that acts only in spans of time:
    readings, base model and extended model."""
    compare = "." if after is None else ": compare the base model (red) with the extended one (green)."
    caption = f"Where the background is shaded the simulation should stay with the blue readings{compare}"
    drawn: list[Finding | CauseEpisodes] = [*drawable(found)[:EPISODE_FIGURES], *events(found)]
    return [
        Figure(
            f"episodes-{number}",
            sentence(
                what_it_is(episode.cause) if isinstance(episode, CauseEpisodes) else episode.statement.text
            ),
            caption if number == 1 else "",
            partial(figure_episodes, before, episode, after),
        )
        for number, episode in enumerate(drawn, start=1)
    ]


def errors_over_drivers(found: DiscoveryResults, before: Residuals, after: Residuals | None) -> Figure:
    """The figure of the errors over the drivers that the findings name, then over others."""
    drivers = [finding.driver for finding in drawable(found) if finding.driver]
    explanation = (
        "; a bend shows what the model lacks."
        if after is None
        else "; where the red medians bend and the green ones stay flat, the cause explains the bend. Where "
        "only green shows, both are alike."
    )
    return Figure(
        "drivers",
        "Error against what drives the cabinet",
        f"Medians should lie on zero along every driver{explanation}",
        lambda: figure_drivers(before, telling_drivers(before, drivers), after),
    )


def lead_of_climate(study: Study) -> Figure:
    """Return the figure that compares the regions; for a single region, the figure of its year."""
    regions = study.regions
    if len(regions) == 1:
        return year_figure(regions[0], 1)
    means = percent(min(region.mean_bounds_hold for region in regions))
    caption = REGIONS_CAPTION.format(years=share_held(regions), means=means)
    return Figure("regions", "Regions side by side", caption, partial(figure_regions, regions))


def year_figure(region: RegionClimate, number: int) -> Figure:
    """Return the joint distribution of temperature and humidity of a region; without humidity, its duration
    curves.

    number: of the region on the page, from 1.
    """
    if region.joint is None:
        return duration_figure(region, number)
    heading = "The year by temperature and relative humidity"
    return Figure(f"r{number}-joint", heading, JOINT_CAPTION, partial(figure_joint, region))


def duration_figure(region: RegionClimate, number: int) -> Figure:
    """Return the figure of a region's duration curves; number: of the region on the page, from 1."""
    caption = DURATION_CAPTION.format(share=share_held([region]))
    return Figure(f"r{number}-duration", "Duration curves", caption, partial(figure_duration, region))
