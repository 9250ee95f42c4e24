"""Figures of the record: whole series with band and error, excerpts, and the error over the point of
operation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.result_file import array, instants, scalar
from hygrokf.identification.fit_results import FitResults
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.figures.drawing import (
    AMBIENT,
    BINS,
    INK,
    LEVEL_SD,
    MEASURED,
    QUIET,
    SHADE,
    SIMULATED,
    NothingToShow,
    area_handle,
    band,
    calendar,
    days,
    envelope,
    figure_key,
    key,
    line_handle,
    new_figure,
    segments,
    shade,
    stretches,
    styled,
    upright,
)
from hygrokf.report.figures.excerpts import choose_excerpts
from hygrokf.report.figures.panels import Panels

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TEMPERATURE = "temperature"
HUMIDITY = "absolute_humidity"
AXIS_LABEL = {TEMPERATURE: "temperature [°C]", HUMIDITY: "absolute humidity [g/m³]"}
ERROR_LABEL = {TEMPERATURE: "error [K]", HUMIDITY: "error [g/m³]"}
FORTNIGHT_S = 14.0 * 86400.0
HATCH = "#9aa4b1"
NARROW = 170
"""Stretches of time over the width of an excerpt."""
AMBIENT_SERIES = {TEMPERATURE: "ambient_temperature", HUMIDITY: "ambient_absolute_humidity"}


# --- the record ------------------------------------------------------------------------------


class _Record:
    """Both quantities of a record in the units of the figures [°C, g/m³], its span and its shaded stretches
    [s]."""

    def __init__(self, series: Mapping[str, np.ndarray]) -> None:
        self.time = instants(series)
        self.series = series
        if len(self.time) == 0:
            raise NothingToShow(
                "series.npz holds no instants in order, so there is nothing to draw over time."
            )
        self.span = (float(self.time[0]), float(self.time[-1]))
        self.until = scalar(series, "until_s")
        self.scored = array(series, "scored") != 0
        self.power = array(series, "power")
        self.operating = array(series, "operating") > 0
        self.preheating = np.nan_to_num(array(series, "preheating"))

    @property
    def has_power(self) -> bool:
        return bool(np.isfinite(self.power).any() and (self.operating.any() or np.nanmax(self.power) > 0))

    @property
    def validation(self) -> bool:
        return math.isfinite(self.until) and self.until < self.span[1]

    def quantity(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Measured, simulated, its standard deviation, ambient (T,)."""
        shift = ZERO_CELSIUS_K if name == TEMPERATURE else 0.0
        measured, simulated = (
            array(self.series, f"{name}_{kind}") - shift for kind in ("measured", "simulated")
        )
        return (
            measured,
            simulated,
            array(self.series, f"{name}_sd"),
            array(self.series, AMBIENT_SERIES[name]) - shift,
        )

    def known(self, name: str) -> bool:
        measured, simulated, _, _ = self.quantity(name)
        return bool(np.isfinite(measured).any() or np.isfinite(simulated).any())


def figure_temperature(fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
    """Cabinet temperature over the whole record, error of the free run, relative power (Fig. 6 of the
    paper)."""
    return _whole(_Record(series), TEMPERATURE, "The fit has no cabinet temperature to show.")


def figure_humidity(fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
    """Absolute humidity over the whole record and error of the free run (Fig. 8 of the paper)."""
    why = "There is no cabinet humidity: the record, or the model, lacks it."
    return _whole(_Record(series), HUMIDITY, why)


def _whole(record: _Record, name: str, why: str) -> Figure:
    if not record.known(name):
        raise NothingToShow(why)
    power = name == TEMPERATURE and record.has_power
    with styled():
        figure = new_figure(4.3 if power else 3.5)
        grid = figure.add_gridspec(
            3 if power else 2, 1, height_ratios=(3.2, 1.1, 1.0) if power else (3.2, 1.1), hspace=0.14,
            left=0.075, right=0.995, top=0.925, bottom=0.07 if power else 0.085,
        )  # fmt: skip
        main, error = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
        _course(main, record, name, record.span)
        upright(main, AXIS_LABEL[name])
        key(main, _handles(record, name))
        measured, simulated, _, _ = record.quantity(name)
        difference = simulated - measured
        error.axhline(0.0, color=QUIET, linewidth=0.6)
        _line(error, record, difference, SIMULATED, 0.6)
        upright(error, ERROR_LABEL[name])
        every = [main, error]
        if power:
            low = figure.add_subplot(grid[2])
            _power(low, record, record.span)
            upright(low, "power / rated")
            every.append(low)
        for axes in every:
            calendar(axes, record.span, 12, labels=axes is every[-1])
            _shade(axes, record, record.span)
        _mark_validation(main, record)
    return figure


def figure_validation(fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
    """Readings, free run and its 95 % band after the identification period, or in the last fortnight."""
    with styled():
        panels = validation_panels(series)
        rows = len(panels.draw)
        figure = new_figure(0.45 + 1.25 * rows)
        bottom = 0.115 if rows > 1 else 0.19
        grid = figure.add_gridspec(rows, 1, hspace=0.12, left=0.075, right=0.995, top=0.91, bottom=bottom)
        every = [figure.add_subplot(grid[row]) for row in range(rows)]
        panels.without_key(every)
        for axes in every:
            upright(axes, axes.get_ylabel().replace("\n", " "))
        if panels.handles is not None:
            key(every[0], panels.handles())
    return figure


def validation_panels(series: Mapping[str, np.ndarray]) -> Panels:
    """The temperature, and below it the humidity, of `figure_validation`."""
    record = _Record(series)
    names = [name for name in (TEMPERATURE, HUMIDITY) if record.known(name)]
    if not names:
        raise NothingToShow("The fit has neither a temperature nor a humidity of the cabinet to show.")
    begin = record.until if record.validation else record.span[1] - FORTNIGHT_S
    span = (max(begin, record.span[0]), record.span[1])

    def draw(axes: Axes, name: str) -> None:
        _course(axes, record, name, span)
        axes.set_ylabel(AXIS_LABEL[name].replace(" [", "\n["))
        calendar(axes, span, _ticks(axes))
        _hatch_unscored(axes, record, span)

    return Panels(
        tuple(partial(draw, name=name) for name in names),
        height_in=0.45 + 1.25 * len(names),
        shared="x",
        handles=partial(_handles, record, names[0]),
    )


def _ticks(axes: Axes) -> int:
    """The ticks of a calendar whose labels fit below the axes."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    width_in = axes.get_window_extent().width / figure.dpi
    return max(2, int(width_in / (0.088 * float(axes.xaxis.label.get_fontsize()))))


def _course(
    axes: Axes, record: _Record, name: str, span: tuple[float, float], width: float = 0.8, bins: int = BINS
) -> None:
    """Ambient, measured, simulated with its 95 % band."""
    measured, simulated, sd, ambient = record.quantity(name)
    t, below, above = band(record.time, simulated - LEVEL_SD * sd, simulated + LEVEL_SD * sd, span, bins)
    axes.fill_between(days(t), below, above, color=SIMULATED, alpha=0.17, linewidth=0)
    for value, colour, thick in (
        (ambient, AMBIENT, 1.0),
        (measured, MEASURED, 1.25),
        (simulated, SIMULATED, 0.8),
    ):
        t, v = envelope(record.time, value, span, bins)
        single = np.isfinite(v).sum() == 1
        axes.plot(
            days(t), v, color=colour, linewidth=thick * width, marker="o" if single else None, markersize=3
        )
    _robust_limits(axes, [measured, simulated, ambient], record, span)


def _robust_limits(axes: Axes, values: list[np.ndarray], record: _Record, span: tuple[float, float]) -> None:
    """Limits that show every reading, but not every excess of the band."""
    inside = (record.time >= span[0]) & (record.time <= span[1])
    there = [v[inside & np.isfinite(v)] for v in values]
    there = [v for v in there if len(v)]
    if there:
        low, high = min(float(v.min()) for v in there), max(float(v.max()) for v in there)
        margin = 0.07 * (high - low) or 1.0
        axes.set_ylim(low - margin, high + margin)


def _line(axes: Axes, record: _Record, value: np.ndarray, colour: str, width: float) -> None:
    t, v = envelope(record.time, value, record.span)
    marker = "o" if np.isfinite(v).sum() == 1 else None
    axes.plot(days(t), v, color=colour, linewidth=width, marker=marker, markersize=3)


def _power(axes: Axes, record: _Record, span: tuple[float, float], bins: int = BINS) -> None:
    from matplotlib.lines import Line2D

    t, v = envelope(record.time, record.power, span, bins)
    axes.plot(days(t), v, color=INK, linewidth=0.5)
    axes.fill_between(days(t), 0.0, v, color=INK, alpha=0.12)
    axes.set_ylim(-0.05, 1.14)
    least = 0.004 * (span[1] - span[0])
    named = False
    for start, end in stretches(record.time, record.preheating > 0, least=1800.0):
        if end < span[0] or start > span[1]:
            continue
        start, end = max(start, span[0]), min(end, span[1])
        middle, half = 0.5 * (start + end), 0.5 * max(end - start, least)
        axes.add_line(
            Line2D(
                [float(days(middle - half)), float(days(middle + half))], [1.04, 1.04], color=SIMULATED,
                linewidth=3.0,
                solid_capstyle="butt",
            )
        )  # fmt: skip
        if not named:
            named = True
            late = middle > span[0] + 0.7 * (span[1] - span[0])
            axes.annotate(
                "pre-heating", (days(middle - half if late else middle + half), 1.04),
                ha="right" if late else "left",
                xytext=(-3 if late else 3, 0), textcoords="offset points", va="center", color=SIMULATED,
                fontsize=6.5,
                bbox={"facecolor": "white", "alpha": 0.75, "pad": 0.6, "linewidth": 0},
            )  # fmt: skip


def _shade(axes: Axes, record: _Record, span: tuple[float, float]) -> None:
    if record.validation:
        shade(axes, max(record.until, span[0]), span[1], color=SHADE, zorder=0, linewidth=0)
    _hatch_unscored(axes, record, span)


def _hatch_unscored(axes: Axes, record: _Record, span: tuple[float, float]) -> None:
    least = (span[1] - span[0]) / 300.0
    for start, end in stretches(record.time, ~record.scored, least):
        if end >= span[0] and start <= span[1]:
            shade(
                axes, max(start, span[0]), min(end, span[1]), facecolor="none", edgecolor=HATCH, hatch="////",
                linewidth=0.0, zorder=0.5,
            )  # fmt: skip


def _handles(record: _Record, name: str) -> list[Artist]:
    measured, simulated, sd, ambient = record.quantity(name)
    lines = (
        (measured, MEASURED, "readings"),
        (simulated, SIMULATED, "simulated"),
        (ambient, AMBIENT, "ambient"),
    )
    handles = [line_handle(colour, label) for value, colour, label in lines if np.isfinite(value).any()]
    if np.isfinite(sd).any():
        handles.insert(-1, area_handle(SIMULATED, "95 % band", 0.17))
    if not record.scored.all():
        words = "inputs unknown, not scored"
        handles.append(area_handle("white", words, edgecolor=HATCH, hatch="//////"))
    return handles


def _mark_validation(axes: Axes, record: _Record) -> None:
    if not record.validation:
        return
    place = max(record.until, record.span[0])
    near_end = (record.span[1] - place) / max(record.span[1] - record.span[0], 1.0) < 0.12
    axes.annotate(
        "validation", (days(record.span[1] if near_end else place), 1.0), xycoords=("data", "axes fraction"),
        xytext=(-3 if near_end else 3, -3), textcoords="offset points", ha="right" if near_end else "left",
        va="top",
        color=QUIET, fontsize=7.0, fontstyle="italic",
    )  # fmt: skip


def figure_excerpts(fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
    """Up to three closer views (Fig. 7 of the paper) of both quantities and the power."""
    record = _Record(series)
    names = [name for name in (TEMPERATURE, HUMIDITY) if record.known(name)]
    usable = {name: array(series, name) for name in _EXCERPT_SERIES} | {"time_s": record.time}
    chosen = choose_excerpts(usable) if names else ()
    if not chosen:
        raise NothingToShow("The record is too short for excerpts.")
    rows = len(names) + record.has_power
    with styled():
        figure = new_figure(0.75 + 1.55 * len(names) + 0.75 * record.has_power)
        height = figure.get_size_inches()[1]
        grid = figure.add_gridspec(
            rows, len(chosen), height_ratios=[1.55] * len(names) + [0.7] * record.has_power, hspace=0.16,
            wspace=0.17,
            left=0.072, right=0.995, top=1.0 - 0.52 / height, bottom=0.3 / height,
        )  # fmt: skip
        left: list[Axes] = []
        for column, excerpt in enumerate(chosen):
            span = (excerpt.start_s, excerpt.end_s)
            for row in range(rows):
                axes = figure.add_subplot(grid[row, column])
                if row < len(names):
                    _course(axes, record, names[row], span, 1.0, NARROW)
                else:
                    _power(axes, record, span, NARROW)
                calendar(axes, span, 7, labels=row == rows - 1)
                _shade(axes, record, span)
                if column == 0:
                    upright(axes, AXIS_LABEL[names[row]] if row < len(names) else "power / rated")
                    left.append(axes)
                if row == 0:
                    late = record.validation and span[0] >= record.until
                    axes.set_title(f"({'abc'[column]}) {excerpt.reason}{' (validation)' if late else ''}")
        top = left[0]
        key(top, _handles(record, names[0]), anchor=(0.0, 1.0 + 0.24 / (top.get_position().height * height)))
    return figure


_EXCERPT_SERIES = (
    "temperature_measured", "temperature_simulated", "absolute_humidity_measured",
    "absolute_humidity_simulated",
    "ambient_temperature", "power", "operating", "preheating", "scored",
)  # fmt: skip


# --- residuals -------------------------------------------------------------------------------


def figure_residuals(fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
    """Error of the free run over power, ambient temperature and hour of the day."""
    record = _Record(series)
    errors = {}
    for name in (TEMPERATURE, HUMIDITY):
        measured, simulated, _, _ = record.quantity(name)
        value = np.where(record.scored, simulated - measured, np.nan)
        if np.isfinite(value).sum() >= 30:
            errors[name] = value
    if not errors:
        raise NothingToShow("Fewer than 30 readings can be compared with the free run.")
    ambient = array(series, "ambient_temperature") - ZERO_CELSIUS_K
    hour = (record.time / 3600.0) % 24.0
    columns: list[tuple[str, np.ndarray, np.ndarray]] = []
    if record.has_power:
        columns.append(("power / rated [1]", np.where(record.operating, record.power, np.nan), _POWER_EDGES))
    low, high = (
        np.nanquantile(ambient, [0.005, 0.995]) if np.isfinite(ambient).any() else (math.nan, math.nan)
    )
    if math.isfinite(low) and high - low > 1.0:
        columns.append(("ambient temperature [°C]", ambient, np.linspace(low, high, 11)))
    columns.append(("hour of the day [UTC]", hour, np.arange(0.0, 25.0, 2.0)))
    late = record.time > record.until if record.validation else np.zeros(len(record.time), bool)
    with styled():
        figure = new_figure(0.55 + 1.75 * len(errors))
        height = figure.get_size_inches()[1]
        grid = figure.add_gridspec(
            len(errors), len(columns), hspace=0.24, wspace=0.1, left=0.07, right=0.995,
            top=1.0 - 0.22 / height, bottom=0.36 / height,
        )  # fmt: skip
        for row, (name, error) in enumerate(errors.items()):
            reach = float(np.nanquantile(np.abs(error), 0.97)) or 1.0
            for column, (label, x, edges) in enumerate(columns):
                axes = figure.add_subplot(grid[row, column])
                axes.axhline(0.0, color=INK, linewidth=0.7)
                middles, halves = 0.5 * (edges[1:] + edges[:-1]), 0.36 * np.diff(edges)
                groups = [error[(x >= a) & (x < b) & ~late] for a, b in itertools.pairwise(edges)]
                if label.startswith("power"):
                    middles, halves = np.append(0.0, middles), np.append(0.02, halves)
                    groups.insert(0, error[~record.operating & ~late])
                _boxes(axes, middles, halves, groups)
                if late.any():
                    after = [error[(x >= a) & (x < b) & late] for a, b in itertools.pairwise(edges)]
                    after = [np.nanmedian(g) if np.isfinite(g).sum() >= 10 else np.nan for g in after]
                    axes.plot(middles[-len(after) :], after, "D", color=SIMULATED, markersize=3.2)
                axes.set_ylim(-reach, reach)
                if row < len(errors) - 1:
                    axes.tick_params(labelbottom=False)
                else:
                    axes.set_xlabel(label)
                if column == 0:
                    upright(axes, ERROR_LABEL[name])
                    axes.set_title("Temperature" if name == TEMPERATURE else "Absolute humidity")
                else:
                    axes.tick_params(labelleft=False)
                if label.startswith("hour"):
                    axes.set_xticks(np.arange(0, 25, 6))
                elif label.startswith("power"):
                    axes.set_xticks([0.0, 0.25, 0.5, 0.75, 1.0], ["stop", "0.25", "0.5", "0.75", "1"])
        figure_key(figure, _residual_handles(bool(late.any())), (0.997, 1.0))
    return figure


_POWER_EDGES = np.array([0.035, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.02])


def _boxes(axes: Axes, middles: np.ndarray, halves: np.ndarray, groups: list[np.ndarray]) -> None:
    """Median, middle half and middle nine tenths of every group of at least ten values."""
    groups = [values[np.isfinite(values)] for values in groups]
    rows = [
        (x, half, *np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95]))
        for x, half, values in zip(middles, halves, groups, strict=True)
        if len(values) >= 10
    ]
    if not rows:
        return
    x, half, least, low, middle, high, most = np.array(rows).T
    gap = np.full(len(x), np.nan)

    segments(axes, x, least, x, most, MEASURED, 0.7)
    segments(axes, x - half, middle, x + half, middle, MEASURED, 1.6)
    sides = np.column_stack([x - half, x + half, x + half]).ravel()
    below, above = (np.column_stack([edge, edge, gap]).ravel() for edge in (low, high))
    axes.fill_between(sides, below, above, color=MEASURED, alpha=0.25)


def _residual_handles(validation: bool) -> list[Artist]:
    handles = [
        line_handle(MEASURED, "median"),
        area_handle(MEASURED, "middle half", 0.25),
        line_handle(MEASURED, "middle 90 %", 0.7),
    ]
    if validation:
        handles.append(line_handle(SIMULATED, "median in validation", 0, marker="D", markersize=3.2))
    return handles
