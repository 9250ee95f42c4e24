"""Figures of a climate: pure functions of its result."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.climate.study import DurationCurve, RegionClimate
from hygrokf.report.climate_tables import compared_statistics, share_held
from hygrokf.report.figures.drawing import (
    AMBIENT,
    INK,
    MEASURED,
    QUIET,
    SIMULATED,
    NothingToShow,
    area_handle,
    key,
    line_handle,
    new_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHADES = ("#ffffff", "#dbe7f3", "#a9c8e4", "#6ba3d0", "#2f74b0", "#16365c")
PANELS = (
    ("duration", "temperature_degC", "temperature [°C]"),
    ("duration", "relative_humidity_percent", "relative humidity [%]"),
    ("duration", "absolute_humidity_g_m3", "absolute humidity [g/m³]"),
    ("rates", "temperature", "rate of temperature [K/h]"),
    ("rates", "relative_humidity", "rate of humidity [%/h]"),
)


def figure_joint(region: RegionClimate) -> Figure:
    """Hours a year by temperature and relative humidity, in the cabinet and outside."""
    joint = region.joint
    if joint is None:
        raise NothingToShow("The model has no humidity.")
    from matplotlib.colors import LinearSegmentedColormap, LogNorm

    warm, damp = joint.temperature_edges_degC, joint.humidity_edges_percent
    shown = (joint.hours, joint.outside)
    top = max(float(one.max()) for one in shown)
    shades = LinearSegmentedColormap.from_list("hours", SHADES)
    with styled():
        made = new_figure(2.7)
        axes = made.subplots(1, 2, sharex=True, sharey=True)
        for axis, hours, title in zip(axes, shown, ("in the cabinet", "outside"), strict=True):
            drawn = axis.pcolormesh(
                warm, damp, np.where(hours >= 1.0, hours, np.nan).T, cmap=shades,
                norm=LogNorm(1.0, max(top, 2.0)),
                rasterized=True,
            )  # fmt: skip
            axis.axhline(80.0, color=SIMULATED, linewidth=0.8)
            axis.set_title(title)
            axis.set_xlabel("temperature [°C]")
            axis.set_ylim(0.0, 100.0)
            axis.set_yticks(range(0, 101, 20))
        used = np.flatnonzero((shown[0] >= 1.0).any(axis=1) | (shown[1] >= 1.0).any(axis=1))
        axes[0].set_xlim(warm[used[0]] - 1.0, warm[used[-1] + 1] + 1.0)
        axes[0].set_ylabel("relative humidity [%]")
        made.subplots_adjust(left=0.065, right=0.9, bottom=0.16, top=0.91, wspace=0.07)
        bar = made.colorbar(drawn, cax=made.add_axes((0.92, 0.16, 0.016, 0.75)))
        ticks = [t for t in (1, 3, 10, 30, 100, 300, 1000) if t <= max(top, 2.0)]
        bar.set_ticks(ticks, labels=[f"{t}" for t in ticks])
        bar.minorticks_off()
        bar.set_label("hours a year")
        bar.outline.set_visible(False)
    return made


def figure_duration(region: RegionClimate) -> Figure:
    """Duration curves of the quantities and of their rates, with bounds."""
    curves = {"duration": region.duration, "rates": region.rates}
    there = [(kind, curves[kind][name], label) for kind, name, label in PANELS if name in curves[kind]]
    if not there:
        raise NothingToShow("The result has no duration curves.")
    with styled():
        made = new_figure(4.5)
        axes = made.subplots(2, 3).ravel()
        for axis, (kind, curve, label) in zip(axes, there, strict=False):
            _duration(axis, curve, label, kind == "rates")
        for axis in axes[len(there) :]:
            axis.set_axis_off()
        _duration_key(axes[len(there)] if len(there) < 6 else axes[0], share_held([region]))
        made.subplots_adjust(left=0.06, right=0.99, bottom=0.09, top=0.95, wspace=0.2, hspace=0.42)
    return made


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


def _duration_key(axis: Axes, share: str) -> None:
    handles = [
        line_handle(MEASURED, "cabinet, simulated", 0.9),
        area_handle(MEASURED, f"{share} of single years", 0.25, edgecolor=MEASURED),
        line_handle(AMBIENT, "outside", 0.9, linestyle=(0, (4, 2))),
    ]
    axis.legend(handles=handles, loc="center")


def figure_profile(region: RegionClimate) -> Figure:
    """The test profile: temperature and relative humidity over its hours."""
    profile = region.test_profile
    if profile is None:
        raise NothingToShow("There is no test profile of this climate.")
    hour = profile.hour
    with styled():
        made = new_figure(3.7)
        upper, lower = made.subplots(2, 1, sharex=True)
        upper.plot(hour, profile.temperature_degC, color=SIMULATED, linewidth=0.7)
        upper.plot(hour, profile.site_temperature_degC, color=QUIET, linewidth=0.6)
        upper.set_ylabel("temperature [°C]")
        same = "the same hours at the site"
        key(upper, [line_handle(SIMULATED, "test", 0.9), line_handle(QUIET, same, 0.9)])
        lower.plot(hour, profile.relative_humidity_percent, color=MEASURED, linewidth=0.7)
        lower.set_ylabel("relative humidity [%]")
        lower.set_xlabel("hours of the test")
        lower.set_ylim(0, 100)
        lower.margins(x=0.005)
        made.align_ylabels()
        made.subplots_adjust(left=0.07, right=0.99, bottom=0.11, top=0.93, hspace=0.1)
    return made


def figure_regions(regions: Sequence[RegionClimate]) -> Figure:
    """Regions side by side: value, bounds for a year, bounds for the mean."""
    if len(regions) < 2:
        raise NothingToShow("There is only one region.")
    chosen = compared_statistics(regions)
    with styled():
        made = new_figure(0.95 + 0.3 * len(regions))
        axes = np.atleast_1d(made.subplots(1, len(chosen), sharey=True))
        for axis, statistic in zip(axes, chosen, strict=True):
            for row, one in enumerate(regions):
                found = one.year[statistic.name]
                axis.plot([found.lower, found.upper], [row, row], color=MEASURED, linewidth=1.2)
                means = [found.mean_lower, found.mean_upper]
                axis.plot(means, [row, row], color=MEASURED, linewidth=3.6, alpha=0.45)
                axis.plot(found.value, row, "o", color=INK, markersize=3.2)
            short = statistic.words.split(" (")[0].split(" on ")[0].split(",")[0].replace("relative ", "")
            axis.set_title(f"{short}\n[{statistic.unit}]", fontsize=7.0)
            axis.grid(axis="y", visible=False)
            axis.margins(x=0.12)
        axes[0].set_yticks(range(len(regions)), [one.name for one in regions])
        axes[0].set_ylim(len(regions) - 0.5, -0.5)
        widest = max(len(one.name) for one in regions)
        made.subplots_adjust(
            left=min(0.025 + 0.0098 * widest, 0.3), right=0.985, bottom=0.32 / made.get_figheight(),
            top=1.0 - 0.4 / made.get_figheight(), wspace=0.14,
        )  # fmt: skip
    return made
