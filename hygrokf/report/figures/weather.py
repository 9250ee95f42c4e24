"""Figure of two weather series of one signal: mean days as stamped and as corrected, and the lag month by
month."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hygrokf.data.record import Series
from hygrokf.data.signals import signal_named
from hygrokf.data.timestamps import DAY_S, summer_time
from hygrokf.report.figures.drawing import (
    AMBIENT,
    MEASURED,
    QUIET,
    RULE,
    SHADE,
    SIMULATED,
    NothingToShow,
    calendar,
    days,
    figure_key,
    line_handle,
    new_figure,
    styled,
)
from hygrokf.weather.alignment import Alignment, mean_days

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def figure_clocks(
    one: Series,
    other: Series,
    found: Alignment,
    corrections_s: tuple[float, float],
    *,
    names: tuple[str, str] | None = None,
    america: bool = False,
) -> Figure:
    """Mean days of both sources before and after the correction, winter above summer, and the lag of every
    month.

    one, other: the series that were compared. found: by `align`. corrections_s: [s] added to the stamps of
    `one` in winter and in summer, as `ClockError.corrections_s` has them. names: of the sources; None: their
    files. Raises NothingToShow where no season has ten days.
    """
    before = mean_days(one, other, america=america)
    after = mean_days(one, other, corrections_s, america=america)
    seasons = [name for name in ("winter", "summer") if name in before and name in after]
    if not seasons:
        raise NothingToShow("The two sources have less than ten days in common.")
    names = names or (found.one, found.other)
    with styled():
        figure = new_figure(2.0 + 1.55 * len(seasons))
        grid = figure.add_gridspec(
            len(seasons) + 1, 2, left=0.075, right=0.985, bottom=0.075, top=0.9, hspace=0.55, wspace=0.12
        )
        unit = signal_named(found.signal).display
        unit = "K" if unit == "degC" else unit
        highest = max(np.abs(course[place]).max() for course in before.values() for place in (1, 2))
        for row, season in enumerate(seasons):
            correction = corrections_s[season == "summer"]
            for column, course in enumerate((before, after)):
                axes = figure.add_subplot(grid[row, column])
                _mean_day(axes, course[season], 1.12 * highest)
                how = "as stamped" if column == 0 else f"stamps of {names[0]} {correction / 3600.0:+.3g} h"
                axes.set_title(f"{season}, {how}")
                if column == 0:
                    axes.set_ylabel(f"mean day [{unit}]")
                else:
                    axes.set_yticklabels([])
                if row == len(seasons) - 1:
                    axes.set_xlabel("hour of the day [UTC]", labelpad=1.0)
        _lags(figure.add_subplot(grid[-1, :]), found, corrections_s, america)
        figure_key(figure, _handles(names), (0.07, 0.99), left=True)
    return figure


def _mean_day(axes: Axes, course: tuple[np.ndarray, np.ndarray, np.ndarray], reach: float) -> None:
    hour, one, other = (
        np.append(each, end) for each, end in zip(course, (24.0, course[1][0], course[2][0]), strict=True)
    )
    axes.plot(hour, other, color=AMBIENT, linewidth=1.6)
    axes.plot(hour, one, color=MEASURED, linewidth=1.2)
    axes.set_xlim(0.0, 24.0)
    axes.set_xticks(range(0, 25, 6))
    axes.set_ylim(-reach, reach)


def _lags(axes: Axes, found: Alignment, corrections_s: tuple[float, float], america: bool) -> None:
    """The lag of every month by both witnesses with bounds, over the lag that the correction takes away."""
    span = (found.start_s, found.end_s)
    time = np.arange(span[0], span[1], 3600.0)
    warm = summer_time(time, america)
    axes.fill_between(
        days(time), 0, 1, where=warm, color=SHADE, transform=axes.get_xaxis_transform(), zorder=0
    )
    if any(corrections_s):
        expected = -np.where(warm, corrections_s[1], corrections_s[0]) / 3600.0
        axes.plot(days(time), expected, color=SIMULATED, linewidth=1.0, drawstyle="steps-mid")
    axes.axhline(0.0, color=QUIET, linewidth=0.6)
    for place, colour, aside in ((1, MEASURED, -2.5), (2, RULE, 2.5)):
        for month in found.months:
            lag: Any = month[place]
            if not lag.known:
                continue
            middle = float(days(_middle(month[0], span) + aside * DAY_S))
            shade = colour if place == 1 else QUIET
            axes.plot([middle] * 2, [lag.low / 3600.0, lag.high / 3600.0], color=shade, linewidth=1.0)
            axes.plot(
                middle,
                lag.value / 3600.0,
                "o" if place == 1 else "s",
                color=shade,
                markersize=3.4 if place == 1 else 2.6,
            )
    axes.set_title("lag of every month with 95 % bounds; summer time shaded")
    axes.set_ylabel("stamped late by [h]")
    axes.margins(y=0.1)
    calendar(axes, span)


def _middle(start_s: float, span: tuple[float, float]) -> float:
    """Middle of a month [s], as far as it lies in the span."""
    month = np.datetime64(int(start_s), "s").astype("datetime64[M]")
    end_s = float((month + 1).astype("datetime64[s]").astype(np.int64))
    return 0.5 * (max(start_s, span[0]) + min(end_s, span[1]))


def _handles(names: tuple[str, str]) -> list[Artist]:
    return [
        line_handle(MEASURED, names[0], 1.2),
        line_handle(AMBIENT, names[1]),
        line_handle(MEASURED, "lag by the weather", 1.0, marker="o", markersize=3.4),
        line_handle(QUIET, "lag by the mean day", 1.0, marker="s", markersize=2.6),
        line_handle(SIMULATED, "lag that is corrected", 1.0),
    ]
