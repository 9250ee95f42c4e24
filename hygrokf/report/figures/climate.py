"""Figures of a climate: pure functions of its result."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.climate.statistics import YearNumber
from hygrokf.climate.study import DurationCurve, RegionClimate
from hygrokf.report.climate_tables import compared_statistics, share_held
from hygrokf.report.figures.drawing import (
    AMBIENT,
    INK,
    MEASURED,
    QUIET,
    SIMULATED,
    NothingToShow,
    Panels,
    area_handle,
    line_handle,
)

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

SHADES = ("#ffffff", "#dbe7f3", "#a9c8e4", "#6ba3d0", "#2f74b0", "#16365c")
PANELS = (
    ("duration", "temperature_degC", "temperature [°C]"),
    ("duration", "relative_humidity_percent", "relative humidity [%]"),
    ("duration", "absolute_humidity_g_m3", "absolute humidity [g/m³]"),
    ("rates", "temperature", "rate of temperature [K/h]"),
    ("rates", "relative_humidity", "rate of humidity [%/h]"),
)


def figure_joint(region: RegionClimate) -> Panels:
    """Hours a year by temperature and relative humidity, in the cabinet and outside."""
    joint = region.joint
    if joint is None:
        raise NothingToShow("The model has no humidity.")
    from matplotlib.colors import LinearSegmentedColormap, LogNorm

    warm, damp = joint.temperature_edges_degC, joint.humidity_edges_percent
    shown = (joint.hours, joint.outside)
    top = max(2.0, *(float(one.max()) for one in shown))
    shades = LinearSegmentedColormap.from_list("hours", SHADES)
    used = np.flatnonzero((shown[0] >= 1.0).any(axis=1) | (shown[1] >= 1.0).any(axis=1))

    def draw(axis: Axes, hours: np.ndarray, title: str) -> None:
        axis.pcolormesh(
            warm, damp, np.where(hours >= 1.0, hours, np.nan).T, cmap=shades, norm=LogNorm(1.0, top),
            rasterized=True,
        )  # fmt: skip
        axis.axhline(80.0, color=SIMULATED, linewidth=0.8)
        axis.set_title(title)
        axis.set_xlabel("temperature [°C]")
        axis.set_ylabel("relative humidity [%]")
        axis.set_ylim(0.0, 100.0)
        axis.set_yticks(range(0, 101, 20))
        axis.set_xlim(warm[used[0]] - 1.0, warm[used[-1] + 1] + 1.0)

    titles = ("in the cabinet", "outside")
    return Panels(
        tuple(partial(draw, hours=hours, title=title) for hours, title in zip(shown, titles, strict=True)),
        height_in=2.7,
        columns=2,
        shared="y",
        finish=_hours_scale,
    )


def _hours_scale(axes: Sequence[Axes]) -> None:
    """The colour scale of the hours, which takes its room from the axes."""
    drawn = axes[0].collections[0]
    top = float(np.max(drawn.get_clim()))
    figure = axes[0].get_figure(root=True)
    assert figure is not None
    bar = figure.colorbar(drawn, ax=list(axes), fraction=0.05, pad=0.02)
    ticks = [t for t in (1, 3, 10, 30, 100, 300, 1000) if t <= top]
    bar.set_ticks(ticks, labels=[f"{t}" for t in ticks])
    bar.minorticks_off()
    bar.set_label("hours a year")
    bar.outline.set_visible(False)


def figure_duration(region: RegionClimate) -> Panels:
    """Duration curves of the quantities, then those of their rates, with bounds."""
    curves = {"duration": region.duration, "rates": region.rates}
    there = [(kind, curves[kind][name], label) for kind, name, label in PANELS if name in curves[kind]]
    if not there:
        raise NothingToShow("The result has no duration curves.")
    return Panels(
        tuple(
            partial(_duration, curve=curve, label=label, rate=kind == "rates") for kind, curve, label in there
        ),
        height_in=2.4 if len(there) < 4 else 4.5,
        columns=min(3, len(there)),
        handles=lambda: [
            line_handle(MEASURED, "cabinet, simulated", 0.9),
            area_handle(MEASURED, f"{share_held([region])} of single years", 0.25, edgecolor=MEASURED),
            line_handle(AMBIENT, "outside", 0.9, linestyle=(0, (4, 2))),
        ],
    )


def _duration(axis: Axes, curve: DurationCurve, label: str, rate: bool) -> None:
    share = 100.0 * curve.share_beyond
    value, low, high, outside = curve.value, curve.lower, curve.upper, curve.outside
    if rate:  # only the steep end is of interest
        kept = (share > 0.0) & (share <= 50.0)
        share, value, low, high, outside = (one[kept] for one in (share, value, low, high, outside))
        axis.set_xscale("log")
        axis.set_xticks([0.1, 1.0, 10.0, 50.0], ["0.1", "1", "10", "50"])
        axis.minorticks_off()
    axis.fill_between(share, low, high, color=MEASURED, alpha=0.25, linewidth=0)
    axis.plot(share, value, color=MEASURED)
    axis.plot(share, outside, color=AMBIENT, linestyle=(0, (4, 2)))
    axis.set_title(label)
    axis.set_xlabel("share of the time beyond [%]")
    axis.margins(x=0.01)


def figure_profile(region: RegionClimate) -> Panels:
    """The test profile: temperature and relative humidity over its hours."""
    profile = region.test_profile
    if profile is None:
        raise NothingToShow("There is no test profile of this climate.")

    def warm(axes: Axes) -> None:
        axes.plot(profile.hour, profile.temperature_degC, color=SIMULATED, linewidth=0.7)
        axes.plot(profile.hour, profile.site_temperature_degC, color=QUIET, linewidth=0.6)
        axes.set_ylabel("temperature [°C]")

    def damp(axes: Axes) -> None:
        axes.plot(profile.hour, profile.relative_humidity_percent, color=MEASURED, linewidth=0.7)
        axes.set_ylabel("relative humidity [%]")
        axes.set_xlabel("hours of the test")
        axes.set_ylim(0, 100)

    def handles() -> list[Artist]:
        return [line_handle(SIMULATED, "test", 0.9), line_handle(QUIET, "the same hours at the site", 0.9)]

    return Panels((warm, damp), height_in=3.7, shared="x", handles=handles)


def figure_regions(regions: Sequence[RegionClimate]) -> Panels:
    """Regions side by side in the numbers by which they are compared, with bounds for a year and for the
    mean."""
    if len(regions) < 2:
        raise NothingToShow("There is only one region.")
    from matplotlib import rcParams

    def draw(axis: Axes, statistic: YearNumber) -> None:
        for row, one in enumerate(regions):
            found = one.year[statistic.name]
            axis.plot([found.lower, found.upper], [row, row], color=MEASURED, linewidth=1.2)
            means = [found.mean_lower, found.mean_upper]
            axis.plot(means, [row, row], color=MEASURED, linewidth=3.6, alpha=0.45)
            axis.plot(found.value, row, "o", color=INK, markersize=3.2)
        axis.set_title(
            f"{_narrowed(short_words(statistic), axis)}\n[{statistic.unit}]",
            fontsize=rcParams["xtick.labelsize"],
        )
        axis.grid(axis="y", visible=False)
        axis.margins(x=0.12)
        axis.set_yticks(range(len(regions)), [one.name for one in regions])
        axis.set_ylim(len(regions) - 0.5, -0.5)

    chosen = compared_statistics(regions)
    return Panels(
        tuple(partial(draw, statistic=one) for one in chosen),
        height_in=0.95 + 0.3 * len(regions),
        columns=len(chosen),
        shared="y",
    )


def short_words(statistic: YearNumber) -> str:
    """A number of a climate in two or three words."""
    return statistic.words.split(" (")[0].split(" on ")[0].split(",")[0].replace("relative ", "")


def _narrowed(words: str, axis: Axes) -> str:
    """Words in lines that are no wider than the axes."""
    import textwrap

    figure = axis.get_figure(root=True)
    assert figure is not None
    letters = axis.get_window_extent().width / figure.dpi / (0.0095 * float(axis.xaxis.label.get_fontsize()))
    return textwrap.fill(words, max(8, int(letters)), break_long_words=False)
