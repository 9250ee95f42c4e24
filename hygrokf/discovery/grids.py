"""Dates and thresholds at which a cause may act, found by score statistics."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hygrokf.discovery.scan import scan, slow_scan
from hygrokf.discovery.scene import Part, Scene
from hygrokf.record import Record

DAY_S = 86400.0


def dates(record: Record, every_days: float = 1.0) -> list[float]:
    """Dates [s] for a change: every day, five percent of the record away from its ends."""
    margin = 0.05 * (record.end_s - record.start_s)
    count = max(int((record.end_s - record.start_s - 2 * margin) / (every_days * DAY_S)), 3)
    return [float(d) for d in np.linspace(record.start_s + margin, record.end_s - margin, count)]


@dataclass(frozen=True)
class Probe:
    """A mechanism of one part whose parameter a scan of dates looks for."""

    part: str
    mechanism: tuple[str, dict]
    parameter: str
    nulls: Mapping[str, float] = field(default_factory=dict)


def best_date(
    scene: Scene, feature: str, probes: Sequence[Probe], more: Sequence[float] = (), **fixed: float
) -> tuple[dict, float]:
    """(settings of the feature, effective number searched) of the change that the parts' score statistics ask for most."""
    spacing = dates(scene.record)
    grid = list(spacing)
    step = spacing[1] - spacing[0]
    searched, found = 0.0, grid[0]
    for look in (slow_scan, scan):
        settings = [{"date_s": d, **fixed} for d in grid]
        looks = [
            look(scene.parts[one.part], one.mechanism, one.parameter, feature, settings, one.nulls)
            for one in probes
            if one.part in scene.parts
        ]
        scanned = functools.reduce(operator.add, looks)
        found = float(grid[int(np.argmax(scanned.root**2))])
        searched += scanned.effective
        grid = [*(found + step * f for f in np.linspace(-1.5, 1.5, 13)), *more]
    return {"date_s": found, **fixed}, searched


def inside(scene: Scene, name: str) -> np.ndarray:
    """Readings of a signal in the cabinet, NaN left out."""
    value = scene.record[name].value
    return value[np.isfinite(value)]


def best_switch(
    part: Part,
    mechanism: str,
    parameter: str,
    feature: str,
    grid: list[dict],
    steps: Mapping[str, float],
    nulls: Mapping[str, float] | None = None,
) -> tuple[dict, float]:
    """(two-point setting that the score statistic asks for most, effective number searched); refined twice by `steps`."""
    searched, best, chosen = 0.0, -math.inf, grid[0]
    for factor in (1.0, 0.4, 0.0):
        scanned = scan(part, (mechanism, {}), parameter, feature, grid, nulls)
        searched += scanned.effective
        if scanned.root.max() > best:
            best, chosen = float(scanned.root.max()), grid[int(np.argmax(scanned.root))]
        on, off = (key for key in chosen if key.startswith("o"))
        step = factor * steps.get(str(chosen.get("reads", "")), next(iter(steps.values())))
        grid = [
            {**chosen, on: chosen[on] + i * step, off: chosen[off] + j * step}
            for i in (-1.0, -0.5, 0.0, 0.5, 1.0)
            for j in (-1.0, -0.5, 0.0, 0.5, 1.0)
            if (chosen[on] + i * step - chosen[off] - j * step) * (chosen[on] - chosen[off]) > 0
        ]
    return chosen, searched


def span(scene: Scene) -> dict[str, float]:
    return {"start_s": float(scene.record.start_s), "end_s": float(scene.record.end_s)}
