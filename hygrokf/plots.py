"""The figures of a fit: pure functions from the data of `fit.json` and `series.npz` to a matplotlib figure.

Every function raises `drawing.NothingToShow` with one sentence where its data are missing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.drawing import (
    AMBIENT,
    INK,
    MEASURED,
    QUIET,
    SHADE,
    SIMULATED,
    WARM_TO_COLD,
    NothingToShow,
    band,
    calendar,
    days,
    envelope,
    key,
    logarithmic,
    new_figure,
    stretches,
    styled,
)
from hygrokf.excerpts import choose_excerpts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KELVIN = 273.15
LEVEL_SD = 1.959964
TEMPERATURE = "temperature"
HUMIDITY = "absolute_humidity"
AXIS_LABEL = {TEMPERATURE: "temperature [°C]", HUMIDITY: "absolute humidity [g/m³]"}
ERROR_LABEL = {TEMPERATURE: "sim. − meas. [K]", HUMIDITY: "sim. − meas. [g/m³]"}
AMBIENT_SERIES = {TEMPERATURE: "ambient_temperature", HUMIDITY: "ambient_absolute_humidity"}
POINTS = 500
"""Points of one cloud; more of them only hide each other."""


def array(series: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """A series (T,) as floats; NaN throughout where it is not there or has another length."""
    length = len(np.atleast_1d(series["time_s"])) if "time_s" in series else 0
    value = np.asarray(series[name], dtype=float) if name in series else np.empty(0)
    return value if value.shape == (length,) else np.full(length, np.nan)


def entry(data: object, *path: str) -> object:
    """What stands at a path of nested mappings; None where anything on the way is missing or null."""
    for name in path:
        data = data.get(name) if isinstance(data, Mapping) else None
    return data


def number(data: object, *path: str) -> float:
    """The finite number at a path; NaN where there is none."""
    value = entry(data, *path)
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else math.nan


def numbers(data: object, *path: str) -> np.ndarray:
    """The list of numbers at a path as an array, null as NaN; empty where there is none."""
    value = entry(data, *path)
    if not isinstance(value, (list, tuple)):
        return np.empty(0)
    return np.array([number({"": v}, "") for v in value])


# --- the record ------------------------------------------------------------------------------


class _Record:
    """Both quantities of a record in the units of the figures [°C, g/m³], its span and its shaded stretches [s]."""

    def __init__(self, series: Mapping[str, np.ndarray]) -> None:
        self.time = np.atleast_1d(np.asarray(series.get("time_s", np.empty(0)), dtype=float))
        self.series = series
        if len(self.time) == 0 or not np.isfinite(self.time).all():
            raise NothingToShow("series.npz holds no instants, so there is nothing to draw over time.")
        self.span = (float(self.time[0]), float(self.time[-1]))
        self.until = float(np.asarray(series.get("until_s", math.nan), dtype=float).ravel()[0])
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
        shift = KELVIN if name == TEMPERATURE else 0.0
        measured, simulated = (array(self.series, f"{name}_{kind}") - shift for kind in ("measured", "simulated"))
        return measured, simulated, array(self.series, f"{name}_sd"), array(self.series, AMBIENT_SERIES[name]) - shift

    def known(self, name: str) -> bool:
        measured, simulated, _, _ = self.quantity(name)
        return bool(np.isfinite(measured).any() or np.isfinite(simulated).any())


def figure_temperature(fit: Mapping, series: Mapping[str, np.ndarray]) -> Figure:
    """Cabinet temperature over the whole record, error of the free run, relative power (Fig. 6 of the paper)."""
    return _whole(_Record(series), TEMPERATURE, "The fit has no cabinet temperature to show.")


def figure_humidity(fit: Mapping, series: Mapping[str, np.ndarray]) -> Figure:
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
        main.set_ylabel(AXIS_LABEL[name])
        key(main, _handles(record, name))
        measured, simulated, _, _ = record.quantity(name)
        difference = simulated - measured
        error.axhline(0.0, color=QUIET, linewidth=0.6)
        _line(error, record, difference, SIMULATED, 0.6)
        error.set_ylabel(ERROR_LABEL[name])
        every = [main, error]
        if power:
            low = figure.add_subplot(grid[2])
            _power(low, record, record.span)
            every.append(low)
        for axes in every:
            calendar(axes, record.span, 12, labels=axes is every[-1])
            _shade(axes, record, record.span)
        figure.align_ylabels(every)
        _mark_validation(main, record)
        every[-1].set_xlabel("UTC", loc="right", labelpad=-2)
    return figure


def _course(axes: Axes, record: _Record, name: str, span: tuple[float, float], width: float = 0.8) -> None:
    """Ambient, measured, simulated with its 95 % band."""
    measured, simulated, sd, ambient = record.quantity(name)
    t, below, above = band(record.time, simulated - LEVEL_SD * sd, simulated + LEVEL_SD * sd, span)
    axes.fill_between(days(t), below, above, color=SIMULATED, alpha=0.17, linewidth=0)
    for value, colour in ((ambient, AMBIENT), (measured, MEASURED), (simulated, SIMULATED)):
        t, v = envelope(record.time, value, span)
        single = np.isfinite(v).sum() == 1
        axes.plot(days(t), v, color=colour, linewidth=width, marker="o" if single else None, markersize=3)
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
    axes.plot(days(t), v, color=colour, linewidth=width, marker="o" if np.isfinite(v).sum() == 1 else None, markersize=3)


def _power(axes: Axes, record: _Record, span: tuple[float, float]) -> None:
    from matplotlib.lines import Line2D

    t, v = envelope(record.time, record.power, span)
    axes.plot(days(t), v, color=INK, linewidth=0.5)
    axes.fill_between(days(t), 0.0, v, color=INK, alpha=0.12)
    axes.set_ylim(-0.05, 1.08)
    axes.set_ylabel("power / rated")
    for start, end in stretches(record.time, record.preheating > 0, least=1800.0):
        if end >= span[0] and start <= span[1]:
            axes.add_line(
                Line2D([days(start), days(end)], [1.03, 1.03], color=SIMULATED, linewidth=3.0, solid_capstyle="butt")
            )


def _shade(axes: Axes, record: _Record, span: tuple[float, float]) -> None:
    if record.validation:
        axes.axvspan(days(max(record.until, span[0])), days(span[1]), color=SHADE, zorder=0, linewidth=0)
    least = (span[1] - span[0]) / 300.0
    for start, end in stretches(record.time, ~record.scored, least):
        if end >= span[0] and start <= span[1]:
            axes.axvspan(
                days(max(start, span[0])), days(min(end, span[1])), facecolor="none", edgecolor="#9aa4b1",
                hatch="////", linewidth=0.0, zorder=0.5,
            )  # fmt: skip


def _handles(record: _Record, name: str, period: bool = True) -> list:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    measured, simulated, sd, ambient = record.quantity(name)
    handles: list = []
    for value, colour, label in (
        (measured, MEASURED, "measured"),
        (simulated, SIMULATED, "simulated"),
        (ambient, AMBIENT, "ambient"),
    ):
        if np.isfinite(value).any():
            handles.append(Line2D([], [], color=colour, linewidth=1.6, label=label))
    if np.isfinite(sd).any():
        handles.insert(-1, Patch(facecolor=SIMULATED, alpha=0.17, label="95 % band"))
    if not record.scored.all():
        handles.append(Patch(facecolor="white", edgecolor="#9aa4b1", hatch="//////", label="inputs unknown, not scored"))
    if period and record.preheating.any() and name == TEMPERATURE:
        handles.append(Line2D([], [], color=SIMULATED, linewidth=3.0, label="pre-heating (above the power)"))
    return handles


def _mark_validation(axes: Axes, record: _Record) -> None:
    if not record.validation:
        return
    place = max(record.until, record.span[0])
    near_end = (record.span[1] - place) / max(record.span[1] - record.span[0], 1.0) < 0.12
    axes.annotate(
        "validation", (days(record.span[1] if near_end else place), 1.0), xycoords=("data", "axes fraction"),
        xytext=(-3 if near_end else 3, -3), textcoords="offset points", ha="right" if near_end else "left", va="top",
        color=QUIET, fontsize=7.0, fontstyle="italic",
    )  # fmt: skip


def figure_excerpts(fit: Mapping, series: Mapping[str, np.ndarray]) -> Figure:
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
            rows, len(chosen), height_ratios=[1.55] * len(names) + [0.7] * record.has_power, hspace=0.16, wspace=0.17,
            left=0.072, right=0.995, top=1.0 - 0.52 / height, bottom=0.3 / height,
        )  # fmt: skip
        left: list[Axes] = []
        for column, excerpt in enumerate(chosen):
            span = (excerpt.start_s, excerpt.end_s)
            for row in range(rows):
                axes = figure.add_subplot(grid[row, column])
                if row < len(names):
                    _course(axes, record, names[row], span, 1.0)
                else:
                    _power(axes, record, span)
                    axes.set_ylabel("")
                calendar(axes, span, 7, labels=row == rows - 1)
                _shade(axes, record, span)
                if column == 0:
                    axes.set_ylabel(AXIS_LABEL[names[row]] if row < len(names) else "power / rated")
                    left.append(axes)
                if row == 0:
                    late = record.validation and span[0] >= record.until
                    axes.set_title(f"({'abc'[column]}) {excerpt.reason}{' (validation)' if late else ''}")
        figure.align_ylabels(left)
        top = left[0]
        key(top, _handles(record, names[0]), anchor=(0.0, 1.0 + 0.24 / (top.get_position().height * height)))
    return figure


_EXCERPT_SERIES = (
    "temperature_measured", "temperature_simulated", "absolute_humidity_measured", "absolute_humidity_simulated",
    "ambient_temperature", "power", "operating", "preheating", "scored",
)  # fmt: skip


# --- heat release ----------------------------------------------------------------------------


def figure_heat_release(fit: Mapping, series: Mapping[str, np.ndarray]) -> Figure:
    """Quasi-stationary periods and the regression over them, operation and standstill (Fig. 4 of the paper)."""
    found = {name: _Points(fit, name) for name in ("operation", "standstill")}
    shown = [one for one in found.values() if one.there]
    if not shown:
        said = entry(fit, "heat_release", "statement")
        why = f" ({said})" if isinstance(said, str) and said else ""
        raise NothingToShow(f"There are too few quasi-stationary periods for a regression{why}.")
    with styled():
        figure = new_figure(2.9)
        grid = figure.add_gridspec(1, len(shown), wspace=0.2, left=0.065, right=0.915, top=0.9, bottom=0.15)
        ambient = np.concatenate([one.ambient for one in shown])
        low, high = np.quantile(ambient, [0.02, 0.98])
        edges = _round_edges(float(low), float(high))
        highest = max(float(np.nanmax(one.difference)) for one in shown)
        lowest = min(0.0, *(float(np.nanmin(one.difference)) for one in shown))
        for column, one in enumerate(shown):
            axes = figure.add_subplot(grid[column])
            (_operation if one.regime == "operation" else _standstill)(axes, one, edges, fit)
            axes.set_ylim(lowest - 0.3, highest + 0.08 * (highest - lowest))
            axes.set_ylabel("cabinet − ambient [K]" if column == 0 else "")
            axes.set_title(f"{one.regime}: {one.count} stationary periods, {one.episodes} episodes")
        _colour_scale(figure, edges)
    return figure


class _Points:
    """Points and coefficients of one regime of the heat-release regression."""

    def __init__(self, fit: Mapping, regime: str) -> None:
        data = entry(fit, "heat_release", regime)
        self.regime = regime
        self.power, self.difference, ambient, self.fitted = (
            numbers(data, "points", name) for name in ("power", "difference_K", "ambient_K", "fitted_K")
        )
        self.ambient = ambient - KELVIN
        lengths = {len(self.power), len(self.difference), len(self.ambient)}
        good = len(lengths) == 1 and len(self.power) > 0
        if good:
            kept = np.isfinite(self.power) & np.isfinite(self.difference) & np.isfinite(self.ambient)
            good = bool(kept.any())
            self.power, self.difference, self.ambient = self.power[kept], self.difference[kept], self.ambient[kept]
        self.there = good
        self.count = f"{number(data, 'n_points'):.0f}" if math.isfinite(number(data, "n_points")) else len(self.power)
        episodes = number(data, "n_episodes")
        self.episodes = f"{episodes:.0f}" if math.isfinite(episodes) else "–"
        self.reference = number(fit, "heat_release", "reference_K") - KELVIN
        found = entry(data, "coefficients")
        self.coefficients = {
            name: number(found, name, "value") for name in (found if isinstance(found, Mapping) else ())
        }

    def thinned(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        kept = np.unique(np.linspace(0, len(self.power) - 1, min(POINTS, len(self.power))).astype(int))
        return self.power[kept], self.difference[kept], self.ambient[kept]


def released(coefficients: Mapping[str, float], regime: str, power: object, warmer: object) -> object:
    """Heat release [K] at relative power [1] and ambient temperature above the reference [K]; NaN where unknown."""
    base = coefficients.get(f"heat_release_{regime}", math.nan)
    total = base + coefficients.get(f"heat_release_{regime}_ambient", 0.0) * warmer
    if regime == "operation":
        for name, value in coefficients.items():
            order = name.removeprefix("heat_release_power_")
            if order != name and order.isdigit():
                total = total + value * power ** int(order)
    return total + 0.0 * power


def _likelihood(fit: Mapping) -> tuple[dict[str, float], float]:
    """Coefficients of the final estimate and their reference temperature [°C]."""
    found = entry(fit, "parameters")
    values = {
        name: number(row, "value")
        for name, row in (found.items() if isinstance(found, Mapping) else ())
        if str(name).startswith("heat_release_")
    }
    reference = math.nan
    mechanisms = entry(fit, "design", "mechanisms")
    for one in mechanisms if isinstance(mechanisms, (list, tuple)) else ():
        if isinstance(one, (list, tuple)) and len(one) == 2 and one[0] == "heat_release":
            reference = number(one[1], "reference_K") - KELVIN
    return values, reference


def _round_edges(low: float, high: float) -> np.ndarray:
    """Six classes of ambient temperature [°C] with round edges."""
    step = next((s for s in (1.0, 2.0, 2.5, 5.0, 10.0) if 6 * s >= high - low), 20.0)
    first = step * math.floor(low / step)
    return first + step * np.arange(7)


def _classes(value: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(WARM_TO_COLD) - 1)


def _cloud(axes: Axes, x: np.ndarray, y: np.ndarray, ambient: np.ndarray, edges: np.ndarray) -> None:
    place = _classes(ambient, edges)
    for i, colour in enumerate(WARM_TO_COLD):
        axes.plot(x[place == i], y[place == i], ".", color=colour, markersize=4.0, alpha=0.7, markeredgewidth=0)


def _operation(axes: Axes, one: _Points, edges: np.ndarray, fit: Mapping) -> None:
    power, difference, ambient = one.thinned()
    _cloud(axes, power, difference, ambient, edges)
    p = np.linspace(min(0.0, float(power.min())), max(1.0, float(power.max())), 60)
    inside = [e for e in np.quantile(one.ambient, [0.1, 0.5, 0.9])]
    values, reference = _likelihood(fit)
    for degrees in sorted({round(float(e)) for e in inside}):
        colour = WARM_TO_COLD[int(_classes(np.array([degrees]), edges)[0])]
        curve = released(one.coefficients, "operation", p, degrees - one.reference)
        axes.plot(p, curve, color=colour, linewidth=1.6)
        axes.plot(p, released(values, "operation", p, degrees - reference), color=colour, linewidth=1.0, dashes=(4, 2))
        if math.isfinite(float(curve[-1])):
            axes.annotate(
                f"{degrees} °C", (p[-1], curve[-1]), xytext=(3, 0), textcoords="offset points", va="center",
                color=colour, fontweight="bold", fontsize=7.0, annotation_clip=False,
            )  # fmt: skip
    axes.set_xlabel("power / rated [1]")
    _line_key(axes, values)


def _standstill(axes: Axes, one: _Points, edges: np.ndarray, fit: Mapping) -> None:
    _, difference, ambient = one.thinned()
    _cloud(axes, ambient, difference, ambient, edges)
    x = np.linspace(float(ambient.min()), float(ambient.max()), 2)
    values, reference = _likelihood(fit)
    axes.plot(x, released(one.coefficients, "standstill", 0.0, x - one.reference), color=INK, linewidth=1.6)
    axes.plot(x, released(values, "standstill", 0.0, x - reference), color=INK, linewidth=1.0, dashes=(4, 2))
    axes.set_xlabel("ambient temperature [°C]")
    _line_key(axes, values)


def _line_key(axes: Axes, values: Mapping) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=INK, linewidth=1.6, label="regression over the points")]
    if values:
        handles.append(Line2D([], [], color=INK, linewidth=1.0, dashes=(4, 2), label="final estimate (likelihood)"))
    axes.legend(handles=handles, loc="upper right", handlelength=2.2)


def _colour_scale(figure: Figure, edges: np.ndarray) -> None:
    from matplotlib.patches import Rectangle

    axes = figure.add_axes((0.955, 0.15, 0.012, 0.66))
    for i, colour in enumerate(WARM_TO_COLD):
        axes.add_patch(Rectangle((0, edges[i]), 1, edges[i + 1] - edges[i], color=colour))
    axes.set_xlim(0, 1)
    axes.set_ylim(edges[0], edges[-1])
    axes.set_yticks(edges, [f"{e:g}" for e in edges])
    axes.yaxis.tick_right()
    axes.set_xticks([])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_title("ambient\n[°C]", fontweight="normal", fontsize=7.0, loc="center")


# --- time constants --------------------------------------------------------------------------


def figure_profiles(fit: Mapping, series: Mapping[str, np.ndarray]) -> Figure:
    """Profile likelihood of both time constants, with bounds and the estimate by simulation beside it."""
    shown = [name for name in ("thermal", "hygric") if math.isfinite(number(fit, "time_constants", name, "value_h"))]
    if not shown:
        raise NothingToShow("No time constant was identified, so there is no profile to show.")
    with styled():
        figure = new_figure(2.5)
        grid = figure.add_gridspec(1, 2, wspace=0.2, left=0.06, right=0.985, top=0.9, bottom=0.17)
        for column, name in enumerate(shown):
            axes = figure.add_subplot(grid[column])
            _profile(axes, fit["time_constants"][name])
            axes.set_title(
                "thermal time constant (R_AT+R_IC)·C" if name == "thermal" else "hygric time constant R_D*·V*"
            )
            axes.set_xlabel("time constant [h]")
            axes.set_ylabel("2 × drop of log-likelihood" if column == 0 else "")
    return figure


def _profile(axes: Axes, found: Mapping) -> None:
    value, low, high = (number(found, name) for name in ("value_h", "lower_h", "upper_h"))
    threshold = number(found, "threshold")
    threshold = threshold if threshold > 0 else LEVEL_SD**2
    top = 2.1 * threshold
    curve = entry(found, "curve")
    rows = [numbers({"": row}, "") for row in curve] if isinstance(curve, (list, tuple)) else []
    points = np.array(sorted(tuple(row) for row in rows if len(row) == 2 and np.isfinite(row).all() and row[0] > 0))
    points = points.reshape(-1, 2)
    simulated = tuple(number(found, "simulation", name) for name in ("value_h", "lower_h", "upper_h"))
    ends = [v for v in (value, low, high, *simulated) if math.isfinite(v) and value / 8 < v < value * 8]
    shown = points[points[:, 1] <= top]
    left = min([*ends, *shown[:, 0]]) / 1.04
    right = max([*ends, *shown[:, 0]]) * 1.04
    lower = low if math.isfinite(low) and low > 0 else left / 10
    upper = high if math.isfinite(high) else right * 10
    axes.axvspan(lower, upper, color=MEASURED, alpha=0.09, linewidth=0)
    if len(points) >= 3:
        x, y = _smooth_profile(points, value)
        axes.plot(x, y, color=MEASURED, linewidth=1.5)
        axes.plot(points[:, 0], points[:, 1], "o", color=MEASURED, markersize=3.0)
    axes.axhline(threshold, color=INK, linewidth=0.8, dashes=(4, 2))
    level = number(found, "level")
    factor = number(found, "factor")
    label = f"{100 * level:.0f} %" if math.isfinite(level) else "threshold"
    if factor > 1.005:
        label += f", widened × {factor:.2f}"
    axes.text(0.99, threshold + 0.02 * top, label, transform=axes.get_yaxis_transform(), ha="right", va="bottom")
    axes.axvline(value, color=MEASURED, linewidth=0.8)
    if math.isfinite(simulated[0]):
        height = 1.62 * threshold
        reach = [s if math.isfinite(s) else simulated[0] for s in simulated]
        axes.plot(reach[1:], [height, height], color=SIMULATED, linewidth=1.6)
        axes.plot(reach[:1], [height], "D", color=SIMULATED, markersize=4.0)
        middle = min(max(simulated[0], left), right)
        side = (
            "left"
            if middle < left * (right / left) ** 0.3
            else "right"
            if middle > left * (right / left) ** 0.7
            else "center"
        )
        axes.annotate(
            "by simulation (free run)", (middle, height), xytext=(0, 4), textcoords="offset points", ha=side,
            color=SIMULATED, fontweight="bold", fontsize=7.0,
        )  # fmt: skip
    axes.set_ylim(0.0, top)
    axes.set_xlim(left, right)
    if right / left > 3.0:
        logarithmic(axes, "x")


def _smooth_profile(points: np.ndarray, value: float) -> tuple[np.ndarray, np.ndarray]:
    """The curve through few points: the signed root of the drop is nearly straight over the logarithm."""
    side = np.sign(np.log(points[:, 0] / value))
    root = side * np.sqrt(np.maximum(points[:, 1], 0.0))
    x = np.geomspace(points[0, 0], points[-1, 0], 120)
    return x, np.interp(np.log(x), np.log(points[:, 0]), root) ** 2


# --- residuals -------------------------------------------------------------------------------


def figure_residuals(fit: Mapping, series: Mapping[str, np.ndarray]) -> Figure:
    """Error of the free run over power, ambient temperature and hour of the day: what the model still owes."""
    record = _Record(series)
    errors = {}
    for name in (TEMPERATURE, HUMIDITY):
        measured, simulated, _, _ = record.quantity(name)
        value = np.where(record.scored, simulated - measured, np.nan)
        if np.isfinite(value).sum() >= 30:
            errors[name] = value
    if not errors:
        raise NothingToShow("Fewer than 30 readings can be compared with the free run.")
    ambient = array(series, "ambient_temperature") - KELVIN
    hour = (record.time / 3600.0) % 24.0
    columns: list[tuple[str, np.ndarray, np.ndarray]] = []
    if record.has_power:
        columns.append(("power / rated [1]", np.where(record.operating, record.power, np.nan), _POWER_EDGES))
    low, high = np.nanquantile(ambient, [0.005, 0.995]) if np.isfinite(ambient).any() else (math.nan, math.nan)
    if math.isfinite(low) and high - low > 1.0:
        columns.append(("ambient temperature [°C]", ambient, np.linspace(low, high, 11)))
    columns.append(("hour of the day [UTC]", hour, np.arange(0.0, 25.0, 2.0)))
    late = record.time > record.until if record.validation else np.zeros(len(record.time), bool)
    with styled():
        figure = new_figure(0.45 + 1.65 * len(errors))
        height = figure.get_size_inches()[1]
        grid = figure.add_gridspec(
            len(errors), len(columns), hspace=0.14, wspace=0.12, left=0.072, right=0.995,
            top=1.0 - 0.2 / height, bottom=0.36 / height,
        )  # fmt: skip
        left = []
        for row, (name, error) in enumerate(errors.items()):
            reach = float(np.nanquantile(np.abs(error), 0.97))
            for column, (label, x, edges) in enumerate(columns):
                axes = figure.add_subplot(grid[row, column])
                axes.axhline(0.0, color=INK, linewidth=0.7)
                if column == 0 and record.has_power:
                    _box(axes, 0.0, error[~record.operating], 0.02, MEASURED)
                for a, b in zip(edges[:-1], edges[1:], strict=True):
                    inside = (x >= a) & (x < b)
                    _box(axes, 0.5 * (a + b), error[inside & ~late], 0.36 * (b - a), MEASURED)
                    part = error[inside & late]
                    part = part[np.isfinite(part)]
                    if len(part) >= 10:
                        axes.plot([0.5 * (a + b)], [np.median(part)], "D", color=SIMULATED, markersize=3.2)
                axes.set_ylim(-reach, reach)
                if row < len(errors) - 1:
                    axes.tick_params(labelbottom=False)
                else:
                    axes.set_xlabel(label)
                if column == 0:
                    axes.set_ylabel(f"{'temperature' if name == TEMPERATURE else 'humidity'}: {ERROR_LABEL[name]}")
                    left.append(axes)
                else:
                    axes.tick_params(labelleft=False)
                if label.startswith("hour"):
                    axes.set_xticks(np.arange(0, 25, 6))
                elif label.startswith("power"):
                    axes.set_xticks([0.0, 0.25, 0.5, 0.75, 1.0], ["stop", "0.25", "0.5", "0.75", "1"])
        figure.align_ylabels(left)
        _residual_key(left[0], bool(late.any()))
    return figure


_POWER_EDGES = np.array([0.035, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.02])


def _box(axes: Axes, x: float, values: np.ndarray, half: float, colour: str) -> None:
    """Median, middle half and middle nine tenths of at least ten values."""
    values = values[np.isfinite(values)]
    if len(values) < 10:
        return
    least, low, middle, high, most = np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95])
    axes.plot([x, x], [least, most], color=colour, linewidth=0.7)
    axes.fill_between([x - half, x + half], low, high, color=colour, alpha=0.25)
    axes.plot([x - half, x + half], [middle, middle], color=colour, linewidth=1.6)


def _residual_key(axes: Axes, validation: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], color=MEASURED, linewidth=1.6, label="median"),
        Patch(facecolor=MEASURED, alpha=0.25, label="middle half"),
        Line2D([], [], color=MEASURED, linewidth=0.7, label="middle 90 %"),
    ]
    if validation:
        handles.append(Line2D([], [], color=SIMULATED, marker="D", markersize=3.2, linewidth=0, label="median in validation"))
    key(axes, handles)
