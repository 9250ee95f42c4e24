"""Dates and thresholds at which a cause may act, found by score statistics."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from hygrokf.data.record import Record
from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.discovery_results import Settings
from hygrokf.discovery.scan import Probe, Scanned, scan, slow_scan
from hygrokf.discovery.submodel import Submodel
from hygrokf.modelling.derived_inputs import feature

MOST_DATES = 90
"""Dates of the first look at a record; the next look goes between the best of them and its neighbours."""
SETTLING_DAYS = (8.0, 20.0, 50.0)
"""[d] that a change at a date may take."""
PACES = (0.6, 0.8, 1.0, 1.25, 1.6)
"""Factors by which the days that a change takes are refined."""
SUDDEN = (0.2, 0.03)
"""Widths, in days of the grid, to which the date of a jump is narrowed down: to 45 min, then to 7 min."""
FEWEST_STARTS = 6
"""Times that a switch must have started by the readings; a setting that turns with the seasons is no
switch."""
NARROWEST = 0.05
"""Share of its hysteresis that a switch keeps at least when its set-points are refined."""


def silences(record: Record) -> list[tuple[float, float]]:
    """Beginnings and ends [s] of the gaps longer than a day in which no source has a reading."""
    time = np.sort(np.concatenate([series.known[0] for series in record.series]))
    return [(float(time[i]), float(time[i + 1])) for i in np.flatnonzero(np.diff(time) > DAY_S)]


def dates(record: Record) -> tuple[list[float], float]:
    """(dates [s] for a change, their distance [s]): every day with readings, `MOST_DATES` of them at most,
    five percent of these days away from the record's ends.  All dates within a silence are the same to the
    readings."""
    gaps = silences(record)
    end = record.end_s - sum(last - first for first, last in gaps)
    margin = 0.05 * (end - record.start_s)
    count = min(max(int((end - record.start_s - 2 * margin) / DAY_S), 3), MOST_DATES)
    found = np.linspace(record.start_s + margin, end - margin, count)
    step = float(found[1]) - float(found[0])
    for first, last in gaps:
        found[found > first] += last - first
    return [float(d) for d in found], step


def _looks(
    look: Callable[..., Scanned],
    baseline: Baseline,
    probes: Sequence[Probe],
    feature: str,
    settings: Sequence[Settings],
    *sums: np.ndarray,
) -> list[Scanned]:
    """Score statistics of the settings by each probe whose submodel the baseline has."""
    return [
        look(baseline.submodels[probe.submodel], probe, feature, settings, *sums)
        for probe in probes
        if probe.submodel in baseline.submodels
    ]


def _together(looks: Sequence[Scanned]) -> Scanned:
    return functools.reduce(operator.add, looks)


def best_date(
    baseline: Baseline,
    feature: str,
    probes: Sequence[Probe],
    more: Sequence[float] = (),
    days: Sequence[float] = (),
    sudden: bool = False,
) -> tuple[Settings, float]:
    """(settings of the feature, effective number searched) of the change for which the submodels' score
    statistics are largest.

    more: dates [s] that are also looked at.  days: [d] that the change may take, for features with such a
        setting.  sudden: whether the feature begins with a jump, which is dated to minutes.
    """
    spacing, step = dates(baseline.record)
    searched = 0.0

    def best(look: Callable[..., Scanned], settings: Sequence[Settings]) -> Settings:
        nonlocal searched
        scanned = _together(_looks(look, baseline, probes, feature, settings))
        searched += scanned.effective
        return dict(settings[int(np.argmax(scanned.root**2))])

    paces = [{"days": d} for d in days] or [{}]
    found = best(slow_scan, [{"date_s": d, **pace} for pace in paces for d in spacing])
    near = [found["date_s"] + step * f for f in np.linspace(-1.5, 1.5, 13)]
    found = best(scan, [{**found, "date_s": float(d)} for d in (*near, *more)])
    for width in SUDDEN if sudden else ():
        near = [found["date_s"] + step * width * f for f in np.linspace(-1.0, 1.0, 13)]
        found = best(scan, [{**found, "date_s": float(d)} for d in near])
    if len(days) > 1:
        found = best(scan, [{**found, "days": found["days"] * factor} for factor in PACES])
    return found, searched


def best_hours(baseline: Baseline, probes: Sequence[Probe], feature: str) -> tuple[Settings, float]:
    """(settings of a feature such as `scheduled`, effective number searched): the hours of the day, or of
    workdays, in which the submodels' score statistics ask most for more of an effect.
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
    looks = _looks(scan, baseline, probes, feature, hours, sums)
    wanted = np.minimum.reduce([np.sign(one.root) for one in looks])
    scanned = _together(looks)
    kind, place = divmod(int(np.argmax(np.where(wanted > 0.0, scanned.root, -1.0))), len(windows))
    start, long = windows[place]
    return {"start_h": float(start), "hours": float(long), "workdays": bool(kind)}, scanned.effective


def readings_of(baseline: Baseline, name: str) -> np.ndarray:
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
    """(setting of a controller for which the submodels' score statistics are largest, effective number
    searched).

    grid: settings with two numbers each, the bounds, refined twice by the step of the reading that a setting
        `reads`, else by the first of `steps`.
    None where no setting lets the controller start often enough.
    """
    first_run = next(baseline.submodels[p.submodel] for p in probes if p.submodel in baseline.submodels)
    searched, best, chosen = 0.0, -math.inf, grid[0]
    for factor in (1.0, 0.4, 0.0):
        grid = [one for one in grid if count_starts(first_run, feature, one) >= FEWEST_STARTS]
        if not grid:
            break
        scanned = _together(_looks(scan, baseline, probes, feature, grid))
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


def count_starts(submodel: Submodel, name: str, settings: Settings) -> int:
    """How often a controller starts by the readings in a submodel's run."""
    on = feature(submodel.record, name, settings, submodel.time_s) > 0.0
    return int(np.sum(on[1:] & ~on[:-1]))


def span(baseline: Baseline) -> dict[str, float]:
    return {"start_s": float(baseline.record.start_s), "end_s": float(baseline.record.end_s)}
