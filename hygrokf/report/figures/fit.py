"""The figures of a fit in the order of the report, and those of what was identified: heat release by
operating point, profile likelihood of the time constants, and how their intervals grow source by source.

Each function takes (fit, series), the content of `fit.json` and `series.npz`, and raises
`drawing.NothingToShow` with one sentence where its data are missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.identification.composition import Step
from hygrokf.identification.fit_results import FitResults, Interval, TimeConstant
from hygrokf.identification.steady_state import Regression
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.blocks import Figure
from hygrokf.report.figures.course import (
    figure_excerpts,
    figure_humidity,
    figure_residuals,
    figure_temperature,
    figure_validation,
)
from hygrokf.report.figures.drawing import (
    INK,
    MEASURED,
    QUIET,
    SIMULATED,
    WARM_TO_COLD,
    NothingToShow,
    Panels,
    line_handle,
    logarithmic,
)
from hygrokf.report.figures.innovations import figure_innovations

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

THRESHOLD = 3.8415
"""95 % quantile of χ² with one degree of freedom."""
PRODUCT = {"thermal": "(R_AT+R_IC)·C", "hygric": "R_D*·V*"}
"""Symbols of the time constants."""
POINTS = 500
"""Points of one cloud; more of them only hide each other."""
LABELS = {
    "profile": "profile likelihood",
    "parts": "+ parts of the record",
    "forms": "+ other forms",
    "free run": "+ free run",
    "clocks": "+ clocks",
    "sampling": "+ ambient sampling",
}
SHOWN_SD = 1e-3
"""[1] standard deviation of the logarithm from which a source has a bar of its own."""
SHOWN_WEIGHT = 0.01
"""[1] share of the evidence above which another form is drawn."""


# --- heat release ----------------------------------------------------------------------------


def figure_heat_release(fit: FitResults, series: Mapping[str, np.ndarray]) -> Panels:
    """Quasi-stationary periods and the regression over them, operation and standstill (Fig. 4 of the
    paper)."""
    release = fit.heat_release
    reference = (
        math.nan if release is None or release.reference_K is None else release.reference_K - ZERO_CELSIUS_K
    )
    regimes = {} if release is None else release.regimes
    found = [_Points(name, one, reference) for name, one in regimes.items()]
    shown = [one for one in found if len(one.power)]
    if not shown:
        why = f" ({release.statement})" if release is not None and release.statement else ""
        raise NothingToShow(f"There are too few quasi-stationary periods for a regression{why}.")
    ambient = np.concatenate([one.ambient for one in shown])
    low, high = np.quantile(ambient, [0.02, 0.98])
    edges = _round_edges(float(low), float(high))
    highest = max(float(np.nanmax(one.difference)) for one in shown)
    lowest = min(0.0, *(float(np.nanmin(one.difference)) for one in shown))

    def draw(axes: Axes, one: _Points) -> None:
        (_operation if one.regime == "operation" else _standstill)(axes, one, edges, fit)
        axes.set_ylim(lowest - 0.3, highest + 0.08 * (highest - lowest))
        axes.set_ylabel("cabinet − ambient [K]" if one is shown[0] else "")
        count, episodes = one.data.n_points, one.data.n_episodes
        axes.set_title(f"{one.regime}: {count} stationary periods, {episodes} episodes")

    return Panels(
        tuple(partial(draw, one=one) for one in shown),
        height_in=2.9,
        columns=len(shown),
        handles=partial(_line_handles, bool(_likelihood(fit)[0])),
        finish=partial(_colour_scale, edges),
    )


class _Points:
    """Points and coefficients of one regime; temperatures in °C."""

    def __init__(self, regime: str, data: Regression, reference: float) -> None:
        self.regime, self.data, self.reference = regime, data, reference
        points = data.points
        ambient = points.ambient_K - ZERO_CELSIUS_K
        kept = np.isfinite(points.power) & np.isfinite(points.difference_K) & np.isfinite(ambient)
        self.power, self.difference = points.power[kept], points.difference_K[kept]
        self.ambient = ambient[kept]
        self.coefficients = {name: one.value for name, one in data.coefficients.items()}

    def thinned(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        kept = np.unique(np.linspace(0, len(self.power) - 1, min(POINTS, len(self.power))).astype(int))
        return self.power[kept], self.difference[kept], self.ambient[kept]


def released(
    coefficients: Mapping[str, float], regime: str, power: np.ndarray | float, warmer: np.ndarray | float
) -> np.ndarray:
    """Heat release [K] at relative power [1] and ambient temperature above the reference [K]; NaN where
    unknown."""
    base = coefficients.get(f"heat_release_{regime}", math.nan)
    total = base + coefficients.get(f"heat_release_{regime}_ambient", 0.0) * warmer
    if regime == "operation":
        for name, value in coefficients.items():
            order = name.removeprefix("heat_release_power_")
            if order != name and order.isdigit():
                total = total + value * power ** int(order)
    return np.asarray(total + 0.0 * power)


def _likelihood(fit: FitResults) -> tuple[dict[str, float], float]:
    """Coefficients of the final estimate and their reference temperature [°C]."""
    values = {name: row.value for name, row in fit.parameters.items() if name.startswith("heat_release_")}
    mechanisms = {} if fit.design is None else dict(fit.design.mechanisms)
    reference = mechanisms.get("heat_release", {}).get("reference_K")
    return values, reference - ZERO_CELSIUS_K if isinstance(reference, (int, float)) else math.nan


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
        axes.plot(
            x[place == i], y[place == i], ".", color=colour, markersize=5.0, alpha=0.7, markeredgewidth=0
        )


def _operation(axes: Axes, one: _Points, edges: np.ndarray, fit: FitResults) -> None:
    power, difference, ambient = one.thinned()
    _cloud(axes, power, difference, ambient, edges)
    p = np.linspace(min(0.0, float(power.min())), max(1.0, float(power.max())), 60)
    values, reference = _likelihood(fit)
    for degrees in sorted({round(float(e)) for e in np.quantile(one.ambient, [0.1, 0.5, 0.9])}):
        colour = WARM_TO_COLD[int(_classes(np.array([degrees]), edges)[0])]
        curve = released(one.coefficients, "operation", p, degrees - one.reference)
        axes.plot(p, curve, color=colour, linewidth=1.6)
        axes.plot(
            p,
            released(values, "operation", p, degrees - reference),
            color=colour,
            linewidth=1.0,
            dashes=(4, 2),
        )
        if math.isfinite(float(curve[-1])):
            axes.annotate(
                f"{degrees} °C", (p[-1], curve[-1]), xytext=(3, 0), textcoords="offset points", va="center",
                color=colour, fontweight="bold", fontsize=7.0, annotation_clip=False,
            )  # fmt: skip
    axes.set_xlabel("power / rated [1]")


def _standstill(axes: Axes, one: _Points, edges: np.ndarray, fit: FitResults) -> None:
    _, difference, ambient = one.thinned()
    _cloud(axes, ambient, difference, ambient, edges)
    x = np.linspace(float(ambient.min()), float(ambient.max()), 2)
    values, reference = _likelihood(fit)
    axes.plot(x, released(one.coefficients, "standstill", 0.0, x - one.reference), color=INK, linewidth=1.6)
    axes.plot(x, released(values, "standstill", 0.0, x - reference), color=INK, linewidth=1.0, dashes=(4, 2))
    axes.set_xlabel("ambient temperature [°C]")


def _line_handles(estimated: bool) -> list[Artist]:
    handles = [line_handle(INK, "regression over the points")]
    if estimated:
        handles.append(line_handle(INK, "final estimate, all data", 1.0, dashes=(4, 2)))
    return handles


def _colour_scale(edges: np.ndarray, axes: Sequence[Axes]) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, ListedColormap

    figure = axes[0].get_figure(root=True)
    assert figure is not None
    colours = ScalarMappable(BoundaryNorm(edges, len(WARM_TO_COLD)), ListedColormap(list(WARM_TO_COLD)))
    bar = figure.colorbar(colours, ax=list(axes), fraction=0.03, pad=0.03)
    bar.set_ticks(list(edges), labels=[f"{e:g}" for e in edges])
    bar.set_label("ambient [°C]")


# --- time constants --------------------------------------------------------------------------


def figure_profiles(fit: FitResults, series: Mapping[str, np.ndarray]) -> Panels:
    """Profile likelihood of both time constants, with bounds and the estimate by simulation beside it."""
    constants = fit.time_constants
    shown = [name for name in ("thermal", "hygric") if name in constants and constants[name].value_h > 0]
    if not shown:
        raise NothingToShow("No time constant was identified, so there is no profile to show.")

    def draw(axes: Axes, name: str) -> None:
        _profile(axes, constants[name])
        axes.set_title(f"{name} time constant {PRODUCT[name]}")
        axes.set_xlabel("time constant [h]")
        axes.set_ylabel("2 × drop of log-likelihood" if name == shown[0] else "")

    return Panels(tuple(partial(draw, name=name) for name in shown), height_in=2.5, columns=2)


def _profile(axes: Axes, found: TimeConstant) -> None:
    # the likelihood's own bounds, where they stand beside the headline interval
    own = found.profile if found.profile is not None and found.profile.value_h > 0 else found
    value, low, high = own.value_h, own.lower_h, own.upper_h
    threshold = found.threshold if found.threshold > 0 else THRESHOLD
    top = 2.1 * threshold
    good = np.isfinite(found.curve).all(axis=1) & (found.curve[:, 0] > 0)
    points = found.curve[good][np.argsort(found.curve[good][:, 0])]
    free = found.simulation or Interval()
    simulated = (free.value_h, free.lower_h, free.upper_h)
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
    label = f"{100 * found.level:.0f} %" if math.isfinite(found.level) else "threshold"
    if found.factor > 1.005:
        label += f", widened × {found.factor:.2f}"
    axes.text(
        0.99, threshold + 0.02 * top, label, transform=axes.get_yaxis_transform(), ha="right", va="bottom"
    )
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
            "by simulation (free run)", (middle, height), xytext=(0, 6), textcoords="offset points", ha=side,
            color=SIMULATED, fontweight="bold", fontsize=7.0,
            bbox={"facecolor": "white", "alpha": 0.75, "pad": 0.6, "linewidth": 0},
        )  # fmt: skip
    axes.set_ylim(0.0, top)
    axes.set_xlim(left, right)
    if right / left > 3.0:
        logarithmic(axes, "x")
    else:
        axes.locator_params(axis="x", nbins=6)
    axes.annotate(
        f"{value:.3g} h", (value, top), xytext=(3, -3), textcoords="offset points", va="top", color=MEASURED,
        fontweight="bold",
    )  # fmt: skip


def _smooth_profile(points: np.ndarray, value: float) -> tuple[np.ndarray, np.ndarray]:
    """The curve through few points: the signed root of the drop is nearly straight over the logarithm."""
    side = np.sign(np.log(points[:, 0] / value))
    root = side * np.sqrt(np.maximum(points[:, 1], 0.0))
    x = np.geomspace(points[0, 0], points[-1, 0], 120)
    return x, np.interp(np.log(x), np.log(points[:, 0]), root) ** 2


# --- composition of intervals ----------------------------------------------------------------


def figure_composition(fit: FitResults, series: Mapping[str, np.ndarray]) -> Panels:
    """One panel a time constant: a bar for each step of the interval, the last one the headline."""
    shown = [
        (name, fit.time_constants[name])
        for name in ("thermal", "hygric")
        if name in fit.time_constants and len(_steps(fit.time_constants[name])) > 1
    ]
    if not shown:
        raise NothingToShow("No interval is composed of several sources, so there is nothing to take apart.")

    def draw(axes: Axes, name: str, found: TimeConstant) -> None:
        _composed(axes, found)
        axes.set_title(f"{name} time constant")
        axes.set_xlabel("[h]")

    return Panels(
        tuple(partial(draw, name=name, found=found) for name, found in shown),
        height_in=0.75 + 0.2 * max(len(_steps(found)) for _, found in shown),
        columns=2,
    )


def _steps(found: TimeConstant) -> list[Step]:
    """Steps of an interval that is closed throughout, without those that add nothing."""
    rows = [row for row in found.composition if row.source in LABELS]
    if not all(0 < row.lower_h < row.upper_h < math.inf for row in rows):
        return []
    return [row for i, row in enumerate(rows) if i == 0 or row.sd_ln > SHOWN_SD]


def _composed(axes: Axes, found: TimeConstant) -> None:
    rows = _steps(found)
    last = len(rows) - 1
    for place, row in enumerate(rows):
        bold = place == last
        axes.plot(
            [row.lower_h, row.upper_h], [place, place], color=MEASURED, linewidth=5.0 if bold else 2.6,
            alpha=1.0 if bold else 0.55, solid_capstyle="butt",
        )  # fmt: skip
    axes.axvline(found.value_h, color=INK, linewidth=0.8)
    for one in found.forms:
        if one.form != "base" and one.weight >= SHOWN_WEIGHT:
            _mark(axes, rows, "forms", one.value_h, QUIET, 2.5 + 4.0 * one.weight)
    if found.simulation is not None:
        _mark(axes, rows, "free run", found.simulation.value_h, SIMULATED, 4.5)
    axes.set_yticks(range(len(rows)), [LABELS[row.source] for row in rows])
    axes.set_ylim(last + 0.6, -0.6)
    axes.locator_params(axis="x", nbins=5)
    axes.grid(False, axis="y")


def _mark(axes: Axes, rows: list[Step], source: str, value: float, colour: str, size: float) -> None:
    """Another estimate, on the row of the source that it stands for; none where that adds nothing."""
    places = [i for i, row in enumerate(rows) if row.source == source]
    if places and math.isfinite(value):
        axes.plot([value], places, "D", color=colour, markersize=size, markeredgecolor="white", clip_on=True)


FIGURES: Mapping[str, tuple[str, str, Callable[[FitResults, Mapping[str, np.ndarray]], Panels]]] = {
    "validation": (
        "Readings and free run after the identification period",
        "The model saw the weather and the power of these days, and no reading of the cabinet. Red should "
        "follow blue, and about one blue reading in twenty should lie outside the 95 % band.",
        figure_validation,
    ),
    "temperature": (
        "Cabinet temperature, whole record",
        "Red should follow blue through seasons, days and standstills, with an error around zero, before and "
        "in the shaded validation period.",
        figure_temperature,
    ),
    "humidity": (
        "Absolute humidity in the cabinet, whole record",
        "The humidity inside and outside is similar in most cabinets: a useful model follows blue more "
        "closely than yellow does.",
        figure_humidity,
    ),
    "excerpts": (
        "Three excerpts",
        "Check the lag after a change of load and at sunrise, and the level at standstill. About one blue "
        "reading in twenty should lie outside the band.",
        figure_excerpts,
    ),
    "heat-release": (
        "Heat release by operating point",
        "The points should scatter evenly around the curve of their own colour at every power. Where solid "
        "and dashed curves differ, the stationary periods and the dynamic record disagree.",
        figure_heat_release,
    ),
    "profiles": (
        "How well the record determines the time constants",
        "The likelihood's own bounds (shaded) lie where the curve crosses the dashed line. A curve that "
        "stays below the line on one side leaves that side open. A red bar outside the shading means that "
        "the two criteria disagree.",
        figure_profiles,
    ),
    "composition": (
        "Sources of uncertainty in the intervals",
        "Each bar adds one source of uncertainty to the bar above it; the last bar is the reported interval. "
        "Diamonds are other estimates: grey from other forms of the model (sized by their weights), red from "
        "the free run.",
        figure_composition,
    ),
    "residuals": (
        "Error of the free run by operating point",
        "The medians should lie on zero everywhere. Others show at which power, temperature or hour the "
        "model is wrong.",
        figure_residuals,
    ),
    "innovations-temperature": (
        "Innovations of the temperature",
        "Bars and curves should stay inside the grey bands and the dashed limits. Red marks the lag, the "
        "period or the input with which the one-step predictions are still correlated.",
        figure_innovations,
    ),
    "innovations-humidity": (
        "Innovations of the humidity",
        "As above. Bars beyond the dashed limits at positive lags of an input show a response to that input "
        "that the model lacks.",
        partial(figure_innovations, output="humidity"),
    ),
}
"""By name: heading, caption that says what to look for, and what draws it."""


def figure_of(name: str, fit: FitResults, series: Mapping[str, np.ndarray]) -> Figure:
    """One of `FIGURES` as a block of the page of a fit."""
    heading, caption, draw = FIGURES[name]
    return Figure(name, heading, caption, lambda: draw(fit, series))
