"""Dates and thresholds at which a cause may act, found by score statistics."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hygrokf.data.record import Record
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.baseline import Baseline, Part
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.scan import Scanned, scan, slow_scan
from hygrokf.modelling.derived_inputs import feature

MOST_DATES = 90
"""Dates of the first look at a record; the next look goes between the best one and its neighbours."""
PACES = (0.6, 0.8, 1.0, 1.25, 1.6)
"""Factors by which the days that a change takes are refined."""
SUDDEN = (0.2, 0.03)
"""Widths, in days of the grid, to which the date of a jump is narrowed down: to 45 min, then to 7 min."""
FEWEST_STARTS = 6
"""Times that a switch must have started by the readings: one that turns with the seasons is none."""
NARROWEST = 0.05
"""Share of its hysteresis that a switch keeps at least when its set-points are refined."""
Look = Callable[..., Scanned]


def silences(record: Record) -> list[tuple[float, float]]:
    """Beginnings and ends [s] of the gaps longer than a day in which no source has a reading."""
    time = np.sort(np.concatenate([series.known[0] for series in record.series]))
    return [(float(time[i]), float(time[i + 1])) for i in np.flatnonzero(np.diff(time) > DAY_S)]


def dates(record: Record, every_days: float = 1.0) -> list[float]:
    """Dates [s] for a change: every day with readings, `MOST_DATES` of them at most, five percent of these
    days away from the record's ends.
    """
    return _spaced(record, every_days)[0]


def _spaced(record: Record, every_days: float) -> tuple[list[float], float]:
    """The dates of `dates`, and their distance [s].  All dates within a silence are one to the readings."""
    gaps = silences(record)
    end = record.end_s - sum(last - first for first, last in gaps)
    margin = 0.05 * (end - record.start_s)
    count = min(max(int((end - record.start_s - 2 * margin) / (every_days * DAY_S)), 3), MOST_DATES)
    found = np.linspace(record.start_s + margin, end - margin, count)
    step = float(found[1]) - float(found[0])
    for first, last in gaps:
        found[found > first] += last - first
    return [float(d) for d in found], step


@dataclass(frozen=True)
class Probe:
    """A mechanism of one part whose parameter a scan of dates looks for."""

    part: str
    mechanism: tuple[str, Settings]
    parameter: str
    nulls: Mapping[str, float] = field(default_factory=dict)


def best_date(
    baseline: Baseline,
    feature: str,
    probes: Sequence[Probe],
    more: Sequence[float] = (),
    days: Sequence[float] = (),
    sudden: bool = False,
) -> tuple[Settings, float]:
    """(settings of the feature, effective number searched) of the change that the parts' score statistics ask
    for most.

    `more` dates [s] that are looked at exactly; `days` in which the change takes place, for features that
    have such; `sudden` for one whose beginning is a jump, which is dated to minutes.
    """
    spacing, step = _spaced(baseline.record, 1.0)
    searched = 0.0

    def asked_for(look: Look, settings: Sequence[Settings]) -> Settings:
        nonlocal searched
        looks = [
            look(baseline.parts[one.part], one.mechanism, one.parameter, feature, settings, one.nulls)
            for one in probes
            if one.part in baseline.parts
        ]
        scanned = functools.reduce(operator.add, looks)
        searched += scanned.effective
        return dict(settings[int(np.argmax(scanned.root**2))])

    paces = [{"days": d} for d in days] or [{}]
    found = asked_for(slow_scan, [{"date_s": d, **pace} for pace in paces for d in spacing])
    near = [found["date_s"] + step * f for f in np.linspace(-1.5, 1.5, 13)]
    found = asked_for(scan, [{**found, "date_s": float(d)} for d in (*near, *more)])
    for width in SUDDEN if sudden else ():
        near = [found["date_s"] + step * width * f for f in np.linspace(-1.0, 1.0, 13)]
        found = asked_for(scan, [{**found, "date_s": float(d)} for d in near])
    if len(days) > 1:
        found = asked_for(scan, [{**found, "days": found["days"] * factor} for factor in PACES])
    return found, searched


def best_hours(
    baseline: Baseline, probes: Sequence[Probe], name: str = "scheduled"
) -> tuple[Settings, float]:
    """(settings of a feature `name` like `scheduled`, effective number searched): the hours of the day, or of
    workdays, in which the parts' score statistics ask most for more of an effect.
    """
    hours = [
        {"start_h": float(h), "hours": 1.0, "workdays": only} for only in (False, True) for h in range(24)
    ]
    windows = [(start, long) for long in range(1, 23) for start in range(24)]
    sums = np.zeros((len(hours), 2 * len(windows)))
    for column, (start, long) in enumerate(windows):
        for kind in (0, 1):
            rows = 24 * kind + (start + np.arange(long)) % 24
            sums[rows, kind * len(windows) + column] = 1.0
    looks = [
        scan(baseline.parts[one.part], one.mechanism, one.parameter, name, hours, one.nulls, sums)
        for one in probes
        if one.part in baseline.parts
    ]
    wanted = np.minimum.reduce([np.sign(one.root) for one in looks])
    scanned = functools.reduce(operator.add, looks)
    kind, place = divmod(int(np.argmax(np.where(wanted > 0.0, scanned.root, -1.0))), len(windows))
    start, long = windows[place]
    return {"start_h": float(start), "hours": float(long), "workdays": bool(kind)}, scanned.effective


def inside(baseline: Baseline, name: str) -> np.ndarray:
    """Readings of a signal in the cabinet, NaN left out."""
    value = baseline.record[name].value
    return value[np.isfinite(value)]


def best_switch(
    baseline: Baseline,
    feature: str,
    probes: Sequence[Probe],
    grid: Sequence[Settings],
    steps: Mapping[str, float],
) -> tuple[Settings, float] | None:
    """(setting of a controller that the parts' score statistics ask for most, effective number searched).

    grid: settings with two bounds each, numbers; refined twice by `steps`, of a setting's `reads` or of any.
    None where no setting lets the controller start often enough.
    """
    probes = [one for one in probes if one.part in baseline.parts]
    searched, best, chosen = 0.0, -math.inf, grid[0]
    for factor in (1.0, 0.4, 0.0):
        grid = [one for one in grid if starts(baseline.parts[probes[0].part], feature, one) >= FEWEST_STARTS]
        if not grid:
            break
        looks = [
            scan(baseline.parts[one.part], one.mechanism, one.parameter, feature, grid, one.nulls)
            for one in probes
        ]
        scanned = functools.reduce(operator.add, looks)
        searched += scanned.effective
        if scanned.root.max() > best:
            best, chosen = float(scanned.root.max()), grid[int(np.argmax(scanned.root))]
        first, second = (key for key, value in chosen.items() if isinstance(value, float))
        step = factor * steps.get(str(chosen.get("reads", "")), next(iter(steps.values())))
        width = chosen[first] - chosen[second]
        grid = [
            {**chosen, first: chosen[first] + i * step, second: chosen[second] + j * step}
            for i in (-1.0, -0.5, 0.0, 0.5, 1.0)
            for j in (-1.0, -0.5, 0.0, 0.5, 1.0)
            if (width + (i - j) * step) / width > NARROWEST
        ]
    return (chosen, searched) if best > -math.inf else None


def starts(part: Part, name: str, settings: Settings) -> int:
    """How often a controller starts by the readings of the part's run."""
    on = feature(part.record, name, settings, part.time_s) > 0.0
    return int(np.sum(on[1:] & ~on[:-1]))


def span(baseline: Baseline) -> dict[str, float]:
    return {"start_s": float(baseline.record.start_s), "end_s": float(baseline.record.end_s)}
