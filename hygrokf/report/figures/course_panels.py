"""Figures of a fit over the record: readings, free run and error over time, excerpts, and the error over
power, ambient temperature and hour of the day."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.result_file import array, instants, scalar
from hygrokf.data.timestamps import HOUR_S
from hygrokf.identification.fit_results import FitResults
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.figures.drawing import (
    AMBIENT_COLOUR,
    BINS,
    INK,
    LEVEL_SD,
    MEASURED,
    QUIET,
    SHADE,
    SIMULATED_COLOUR,
    NothingToShow,
    band,
    envelope,
    means,
    stretches,
)
from hygrokf.report.figures.panels import (
    Axis,
    Band,
    CrossLine,
    Curve,
    Limits,
    Mark,
    Note,
    Panel,
    Picture,
    Shade,
    course,
    strokes,
    validation,
)
from hygrokf.report.quantities import quantity

TEMPERATURE_PANEL = "temperature"
HUMIDITY_PANEL = "absolute_humidity"
POWER_PANEL = "power"
FORTNIGHT_S = 14.0 * 86400.0
HATCH = "#9aa4b1"
UNSCORED_LABEL = "inputs unknown, not scored"
EXCERPT_BINS = 170
"""Bins of time over the width of an excerpt."""
LENGTH_H = 144.0
"""[h] length of an excerpt, a quarter of the record if that is shorter."""
PACE_H = 6.0
"""[h] distance between the starts of the excerpts among which the choice is made."""
PART_LOAD = (0.05, 0.85)
"""[1] relative power that counts as part load."""
AMBIENT_SERIES = {TEMPERATURE_PANEL: "ambient_temperature", HUMIDITY_PANEL: "ambient_absolute_humidity"}


@dataclass(frozen=True)
class Excerpt:
    """A part of the record, from `start_s` to `end_s` [s since 1970], and why it was chosen."""

    start_s: float
    end_s: float
    reason: str


def hourly(time: np.ndarray, value: np.ndarray, hours: int) -> np.ndarray:
    """Means (hours,) of `value` (T,) over each hour from the first instant of `time` [s] (T,) on; or NaN."""
    is_known = np.isfinite(value)
    hour = np.minimum(((time[is_known] - time[0]) // HOUR_S).astype(int), hours - 1)
    return means(hour, value[is_known], hours)


def choose_excerpts(series: Mapping[str, np.ndarray]) -> tuple[Excerpt, ...]:
    """Choose up to three excerpts of six days that do not overlap, in order of time.

    series: the arrays of series.npz. The three are: the longest standstill with pre-heating (without one:
    operation close to rated power; without power: the largest errors of the free run); the most dynamic days;
    and part load with a pronounced daily cycle (without power: the most pronounced daily cycle). Days with
    few readings or unknown inputs are used only if there are no others. A record of less than two days is one
    excerpt.
    """
    time = series["time_s"]
    if len(time) < 2 or not time[-1] > time[0]:
        return ()
    hours = int((time[-1] - time[0]) // HOUR_S) + 1
    if hours < 48:
        return (Excerpt(float(time[0]), float(time[-1]), "the whole record"),)
    length_h = int(min(LENGTH_H, max(hours // 4, 12)))
    state = _State(series, hours)
    starts = np.arange(0, hours - length_h + 1, int(PACE_H if length_h >= 24 else 1))
    window = _Windows(starts, length_h)
    weight = window.mean(state.known) * np.maximum(window.mean(state.scored), 0.05)
    is_usable = weight >= 0.75 * weight.max()
    chosen: list[tuple[int, str]] = []
    for score, reason in (state.rare(window), state.dynamic(window), state.daily(window)):
        is_free = is_usable & np.array(
            [all(abs(start - taken) >= length_h for taken, _ in chosen) for start in starts]
        )
        score = np.where(is_free & np.isfinite(score), score, -np.inf)
        if score.max() > -np.inf:
            chosen.append((int(starts[int(score.argmax())]), reason))
    first_s = float(time[0])
    return tuple(
        Excerpt(first_s + start * HOUR_S, min(first_s + (start + length_h) * HOUR_S, float(time[-1])), reason)
        for start, reason in sorted(chosen)
    )


@dataclass(frozen=True)
class _Windows:
    """Windows of `length` hours that begin at the hours `starts` (W,) of the record; the methods take hourly
    values (T,) and return one number for each window (W,)."""

    starts: np.ndarray
    length: int

    def mean(self, value: np.ndarray) -> np.ndarray:
        """Return the mean over each window; an hour without a value counts as 0."""
        running_sum = np.concatenate([[0.0], np.cumsum(np.nan_to_num(value))])
        return (running_sum[self.starts + self.length] - running_sum[self.starts]) / self.length

    def end(self, value: np.ndarray, hours: int) -> np.ndarray:
        """Return the mean over the last `hours` hours of each window."""
        hours = min(hours, self.length)
        return _Windows(self.starts + self.length - hours, hours).mean(value)

    def daily_amplitude(self, value: np.ndarray) -> np.ndarray:
        """Return the amplitude of the 24 h cycle in each window, in the unit of the values."""
        is_known = np.isfinite(value)
        centred = np.where(is_known, value - (value[is_known].mean() if is_known.any() else 0.0), 0.0)
        daily_wave = np.exp(-2j * np.pi * np.arange(len(value)) / 24.0)
        running_sum = np.concatenate([[0.0], np.cumsum(centred * daily_wave)])
        return 2.0 * np.abs(running_sum[self.starts + self.length] - running_sum[self.starts]) / self.length


class _State:
    """Hourly means of the series on which the choice of excerpts depends."""

    def __init__(self, series: Mapping[str, np.ndarray], hours: int) -> None:
        time = series["time_s"]

        def of(name: str) -> np.ndarray:
            return hourly(time, series[name], hours)

        temperature = of("temperature_measured")
        has_temperature = bool(np.isfinite(temperature).any())
        self.measured = temperature if has_temperature else of("absolute_humidity_measured")
        simulated = "temperature_simulated" if has_temperature else "absolute_humidity_simulated"
        self.known = np.isfinite(self.measured).astype(float)
        self.scored = of("scored")
        self.ambient = of("ambient_temperature")
        self.error = self.measured - of(simulated)
        self.power = of("power")
        self.operating = of("operating")
        self.preheating = np.nan_to_num(of("preheating"))
        self.has_power = bool(np.nanmax(self.operating, initial=0.0) > 0)

    def rare(self, window: _Windows) -> tuple[np.ndarray, str]:
        """Rank windows by how well they show a rare state; returns ranks (W,) and the words for it."""
        standing = 1.0 - self.operating
        if self.has_power and np.nansum(standing) >= 12:
            heated_share = window.mean(self.preheating)
            rank = window.mean(standing) + 8.0 * heated_share
            # the end of a standstill is the most informative part: show the return to operation
            rank = rank + 0.2 * window.end(self.operating, 24)
            reason = "standstill and pre-heating" if self.preheating.max() > 0 else "standstill"
            return rank, reason
        if self.has_power:
            return window.mean(self.power), "operation close to rated power"
        return window.mean(self.error**2), "largest errors of the free run"

    def dynamic(self, window: _Windows) -> tuple[np.ndarray, str]:
        """Rank windows by the hourly changes of readings and power; returns ranks (W,) and words."""
        rank = window.mean(np.abs(np.diff(self.measured, prepend=np.nan)))
        rank = rank / max(float(np.max(rank)), 1e-12)
        if self.has_power:
            jumps = window.mean(np.abs(np.diff(self.power, prepend=np.nan)))
            rank = rank + jumps / max(float(np.max(jumps)), 1e-12)
        return rank, "most dynamic"

    def daily(self, window: _Windows) -> tuple[np.ndarray, str]:
        """Rank the windows by their daily cycle at part load; return ranks (W,) and the words for them."""
        rank = window.daily_amplitude(self.ambient)
        if not self.has_power:
            return rank, "pronounced day-night cycle"
        is_part_load = (self.power > PART_LOAD[0]) & (self.power < PART_LOAD[1]) & (self.operating > 0.5)
        return rank * window.mean(is_part_load.astype(float)), "part load, day-night cycle"


def courses(
    time: np.ndarray, lines: Sequence[tuple[str, np.ndarray, str, float]], sd: np.ndarray | None,
    span: tuple[float, float], bins: int = BINS,
) -> tuple[tuple[Mark, ...], Limits]:  # fmt: skip
    """Return the curves of several series within `span` [s], with the 95 % band of the last one, and the
    limits of the y axis.

    lines: label, values (T,), colour and width of each series, the simulation last.
    sd: (T,) standard deviation of the simulation; None: no band. The limits include all values, but not the
        whole band.
    """
    marks: list[Mark] = [
        course(time, value, span, colour, width, label, bins) for label, value, colour, width in lines
    ]
    if sd is not None:
        simulated = lines[-1][1]
        band_time, low, high = band(time, simulated - LEVEL_SD * sd, simulated + LEVEL_SD * sd, span, bins)
        marks.append(
            Band(band_time, low, high, SIMULATED_COLOUR, label="95 % band" if np.isfinite(sd).any() else "")
        )
    in_span = (time >= span[0]) & (time <= span[1])
    values = np.concatenate([value[in_span & np.isfinite(value)] for _, value, _, _ in lines])
    if not len(values):
        return tuple(marks), (None, None)
    margin = 0.07 * float(np.ptp(values)) or 1.0
    return tuple(marks), (float(values.min()) - margin, float(values.max()) + margin)


# --- the record ------------------------------------------------------------------------------


class _Record:
    """Series of a fit over the record in the units of figures, and the periods to shade."""

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
        """Whether the record has a power that is not zero throughout."""
        return bool(np.isfinite(self.power).any() and (self.operating.any() or np.nanmax(self.power) > 0))

    @property
    def validation(self) -> bool:
        """Whether the record has a validation period."""
        return math.isfinite(self.until) and self.until < self.span[1]

    def quantity(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Readings, simulation, its standard deviation, and ambient value of a quantity, each (T,)."""
        zero = quantity(name).zero
        measured, simulated = (
            array(self.series, f"{name}_{source}") - zero for source in ("measured", "simulated")
        )
        ambient = array(self.series, AMBIENT_SERIES[name]) - zero
        return measured, simulated, array(self.series, f"{name}_sd"), ambient

    def has(self, name: str) -> bool:
        """Whether the record has readings or a simulation of the quantity."""
        measured, simulated, _, _ = self.quantity(name)
        return bool(np.isfinite(measured).any() or np.isfinite(simulated).any())

    @property
    def names(self) -> list[str]:
        """The quantities of which the record has readings or a simulation."""
        return [name for name in (TEMPERATURE_PANEL, HUMIDITY_PANEL) if self.has(name)]

    # --- panels ---

    def course(self, name: str, span: tuple[float, float], width: float = 0.8, bins: int = BINS) -> Panel:
        """The panel of a quantity over a span [s]: ambient, readings, simulation with 95 % band; or power."""
        if name == POWER_PANEL:
            return self.operation(span, bins)
        measured, simulated, sd, ambient = self.quantity(name)
        lines = (
            ("ambient", ambient, AMBIENT_COLOUR, width),
            ("readings", measured, MEASURED, 1.25 * width),
            ("simulated", simulated, SIMULATED_COLOUR, 0.8 * width),
        )
        marks, limits = courses(self.time, lines, sd, span, bins)
        return Panel((*marks, *self.unscored(span)), _time(span), Axis(quantity(name).level, limits))

    def operation(self, span: tuple[float, float], bins: int = BINS) -> Panel:
        """Return the panel of the relative power, with bars above it while the cabinet was pre-heated."""
        time, power = envelope(self.time, self.power, span, bins)
        marks: list[Mark] = [Curve(time, power, INK, 0.5), Band(time, 0.0 * power, power, INK, 0.12)]
        shortest = 0.004 * (span[1] - span[0])
        for start, end in stretches(self.time, self.preheating > 0, shortest_gap=1800.0):
            if end >= span[0] and start <= span[1]:
                middle, half = 0.5 * (start + end), 0.5 * max(end - start, shortest)
                ends = np.array([middle - half, middle + half])
                if len(marks) == 2:
                    late = middle > span[0] + 0.7 * (span[1] - span[0])
                    note = Note("pre-heating", float(ends[1]), 1.04, SIMULATED_COLOUR, boxed=True)
                    marks.append(replace(note, x=float(ends[0]), side="right") if late else note)
                marks.append(Curve(ends, np.array([1.04, 1.04]), SIMULATED_COLOUR, 3.0))
        return Panel((*marks, *self.unscored(span)), _time(span), Axis("power / rated", (-0.05, 1.14)))

    def unscored(self, span: tuple[float, float]) -> tuple[Mark, ...]:
        """Return hatched shades over the periods in which inputs are unknown."""
        shortest_s = (span[1] - span[0]) / 300.0
        return tuple(
            Shade(max(start, span[0]), min(end, span[1]), HATCH, label=UNSCORED_LABEL, hatched=True)
            for start, end in stretches(self.time, ~self.scored, shortest_s)
            if end >= span[0] and start <= span[1]
        )

    def validation_shade(self, span: tuple[float, float]) -> tuple[Mark, ...]:
        """Return the shade over the validation period; empty without one."""
        return (Shade(max(self.until, span[0]), span[1], SHADE),) if self.validation else ()


def _time(span: tuple[float, float]) -> Axis:
    """Return an axis of time over a span [s since 1970]."""
    return Axis(limits=span, kind="time")


def figure_temperature(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """Draw the cabinet temperature over the whole record, with the error of the free run and the relative
    power (Fig. 6 of the paper)."""
    return _full_record(_Record(series), TEMPERATURE_PANEL, "The fit has no cabinet temperature to show.")


def figure_humidity(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """Draw the absolute humidity over the whole record, with the error of the free run (Fig. 8 there)."""
    why = "There is no cabinet humidity: the record, or the model, lacks it."
    return _full_record(_Record(series), HUMIDITY_PANEL, why)


def _full_record(record: _Record, name: str, reason_if_absent: str) -> Picture:
    """Return the panels of one quantity over the whole record: its course, the error of the free run, and
    with the temperature also the power."""
    if not record.has(name):
        raise NothingToShow(reason_if_absent)
    measured, simulated, _, _ = record.quantity(name)
    error = (
        *record.unscored(record.span),
        CrossLine(0.0, "y", QUIET),
        course(record.time, simulated - measured, record.span, SIMULATED_COLOUR, 0.6),
    )
    rows = [
        record.course(name, record.span),
        Panel(error, _time(record.span), Axis(quantity(name).error)),
        *([record.operation(record.span)] if name == TEMPERATURE_PANEL and record.has_power else []),
    ]
    rows = [replace(row, marks=(*record.validation_shade(record.span), *row.marks)) for row in rows]
    if record.validation:
        rows[0] = replace(rows[0], marks=(*rows[0].marks, *validation(record.until, record.span)))
    height, shares = 4.3 if len(rows) > 2 else 3.5, (3.2, 1.1, 1.0)
    return Picture(tuple(rows), height, shared="x", heights=shares[: len(rows)])


def figure_validation(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """Draw readings and free run with its 95 % band after the identification period (without a validation
    period: in the last fortnight), temperature above humidity."""
    record = _Record(series)
    if not record.names:
        raise NothingToShow("The fit has neither a temperature nor a humidity of the cabinet to show.")
    begin = record.until if record.validation else record.span[1] - FORTNIGHT_S
    span = (max(begin, record.span[0]), record.span[1])
    panels = []
    for name in record.names:
        panel = record.course(name, span)
        panels.append(replace(panel, y=replace(panel.y, label=quantity(name).level.replace(" [", "\n["))))
    return Picture(tuple(panels), height_in=0.45 + 1.25 * len(panels), shared="x")


def figure_excerpts(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """Draw up to three excerpts side by side (Fig. 7 of the paper): temperature, humidity and power."""
    record = _Record(series)
    names = record.names
    usable = {name: array(series, name) for name in _EXCERPT_SERIES} | {"time_s": record.time}
    chosen = choose_excerpts(usable) if names else ()
    if not chosen:
        raise NothingToShow("The record is too short for excerpts.")
    rows_shown = [*names, POWER_PANEL] if record.has_power else names
    panels = []
    for name in rows_shown:
        for letter, excerpt in zip("abc", chosen, strict=False):
            span = (excerpt.start_s, excerpt.end_s)
            panel = record.course(name, span, 1.0, EXCERPT_BINS)
            remark = " (validation)" if record.validation and span[0] >= record.until else ""
            panels.append(
                replace(
                    panel,
                    marks=(*record.validation_shade(span), *panel.marks),
                    x=replace(panel.x, most=7),
                    y=panel.y if letter == "a" else replace(panel.y, label=""),
                    title=f"({letter}) {excerpt.reason}{remark}" if name == names[0] else "",
                )
            )
    return Picture(
        tuple(panels),
        height_in=0.75 + 1.55 * len(names) + 0.75 * record.has_power,
        columns=len(chosen),
        shared="x",
        heights=tuple(0.7 if name == POWER_PANEL else 1.55 for name in rows_shown),
    )


_EXCERPT_SERIES = (
    "temperature_measured", "temperature_simulated", "absolute_humidity_measured",
    "absolute_humidity_simulated",
    "ambient_temperature", "power", "operating", "preheating", "scored",
)  # fmt: skip


# --- residuals -------------------------------------------------------------------------------


def figure_residuals(fit: FitResults, series: Mapping[str, np.ndarray]) -> Picture:
    """Draw the error of the free run over power, ambient temperature and hour of the day, as boxes with the
    medians of the validation period."""
    record = _Record(series)
    errors = {}
    for name in (TEMPERATURE_PANEL, HUMIDITY_PANEL):
        measured, simulated, _, _ = record.quantity(name)
        error_scored = np.where(record.scored, simulated - measured, np.nan)
        if np.isfinite(error_scored).sum() >= 30:
            errors[name] = error_scored
    if not errors:
        raise NothingToShow("Fewer than 30 readings can be compared with the free run.")
    in_validation = record.time > record.until if record.validation else np.zeros(len(record.time), bool)
    panels = []
    for name, error in errors.items():
        largest_error = float(np.nanquantile(np.abs(error), 0.97)) or 1.0
        for column, (axis, x, edges) in enumerate(_conditions(record)):
            middles, halves = 0.5 * (edges[1:] + edges[:-1]), 0.36 * np.diff(edges)
            in_classes = [(x >= low) & (x < high) for low, high in itertools.pairwise(edges)]
            groups = [error[in_class & ~in_validation] for in_class in in_classes]
            validated = [error[in_class & in_validation] for in_class in in_classes]
            medians = [np.nanmedian(g) if np.isfinite(g).sum() >= 10 else np.nan for g in validated]
            lines: list[Mark] = [CrossLine(0.0, "y", INK, 0.7)]
            if in_validation.any():
                label = "median in validation"
                lines.append(Curve(middles, np.array(medians), SIMULATED_COLOUR, 0.0, label, "D", 3.2))
            if "stop" in axis.words:
                middles, halves = np.append(0.0, middles), np.append(0.02, halves)
                groups.insert(0, error[~record.operating & ~in_validation])
            title = "" if column else quantity(name).title
            y = Axis(quantity(name).error, (-largest_error, largest_error))
            panels.append(Panel((*_boxes(middles, halves, groups), *lines), axis, y, title))
    columns = len(panels) // len(errors)
    return Picture(tuple(panels), height_in=0.55 + 1.75 * len(errors), columns=columns, shared="xy")


_POWER_EDGES = np.array([0.035, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.02])


def _conditions(record: _Record) -> list[tuple[Axis, np.ndarray, np.ndarray]]:
    """The variables over which errors are shown: axis, values (T,), and edges of the classes (C + 1,)."""
    conditions = []
    if record.has_power:
        axis = Axis(
            "power / rated [1]", at=(0.0, 0.25, 0.5, 0.75, 1.0), words=("stop", "0.25", "0.5", "0.75", "1")
        )
        conditions.append((axis, np.where(record.operating, record.power, np.nan), _POWER_EDGES))
    ambient = array(record.series, "ambient_temperature") - ZERO_CELSIUS_K
    if np.isfinite(ambient).any():
        low, high = np.nanquantile(ambient, [0.005, 0.995])
        if math.isfinite(low) and high - low > 1.0:
            conditions.append((Axis("ambient temperature [°C]"), ambient, np.linspace(low, high, 11)))
    hour = (record.time / HOUR_S) % 24.0
    conditions.append((Axis("hour of the day [UTC]", at=range(0, 25, 6)), hour, np.arange(0.0, 25.0, 2.0)))
    return conditions


def _boxes(middles: np.ndarray, halves: np.ndarray, groups: list[np.ndarray]) -> tuple[Mark, ...]:
    """Draw a box for each group of at least ten values: median, interquartile range, and 5 to 95 % quantiles.

    middles, halves: (G,) centre and half the width of each group's box on the x axis. groups: values of each
    group.
    """
    groups = [values[np.isfinite(values)] for values in groups]
    boxes = [
        (x, half, *np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95]))
        for x, half, values in zip(middles, halves, groups, strict=True)
        if len(values) >= 10
    ]
    if not boxes:
        return ()
    x, half, q05, q25, median, q75, q95 = np.array(boxes).T
    gap = np.full(len(x), np.nan)
    sides = np.column_stack([x - half, x + half, x + half]).ravel()
    below, above = (np.column_stack([edge, edge, gap]).ravel() for edge in (q25, q75))
    return (
        strokes(x - half, median, x + half, median, MEASURED, 1.6, "median"),
        Band(sides, below, above, MEASURED, 0.25, "25 to 75 %"),
        strokes(x, q05, x, q95, MEASURED, 0.7, "5 to 95 %"),
    )
