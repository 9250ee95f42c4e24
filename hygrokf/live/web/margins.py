"""Courses of the dew-point margin for the overview: each turbine's last three days and next two, thinned.

The lowest margin of each step stands for it, because the overview is about condensation.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

import numpy as np

from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.live.condition import Z95
from hygrokf.live.storage.store import Store
from hygrokf.live.web.reader import Reader
from hygrokf.live.web.views import View

BACK_S, AHEAD_S = 3.0 * DAY_S, 2.0 * DAY_S
"""[s] of the past and of the forecast that are shown."""
STEP_S = 2.0 * HOUR_S
"""[s] of a step."""
PAST, AHEAD = round(BACK_S / STEP_S), round(AHEAD_S / STEP_S)
"""Number of steps of the past, and of the forecast."""
TOGETHER = 50
"""Turbines that are read at once; others may read the store between two groups."""
KEPT_S = 300.0
"""[s] of the tracker's time for which the courses are kept."""
LEAST_S = 5.0
"""[s] of real time for which they are kept, because the time of a playback may run faster."""


class MarginsKept:
    """The margins of the fleet, read again when they are old."""

    def __init__(self) -> None:
        self._kept: tuple[float, View] | None = None

    def view(self, reader: Reader, names: Sequence[str], now: float) -> View:
        """The margins of all turbines at `now` [s], from `start` [s] on in steps of `step` [s], of which the
        first `past` are estimates and the others forecasts."""
        if self._kept is not None:
            read_s, found = self._kept
            age_s = now - found["start"] - BACK_S
            if 0.0 <= age_s < KEPT_S or 0.0 <= time.monotonic() - read_s < LEAST_S:
                return found
        start = now - BACK_S
        turbines: View = {}
        for first in range(0, len(names), TOGETHER):
            some = names[first : first + TOGETHER]
            turbines |= reader.read(partial(margins_of, names=some, start=start))
        made = {"start": start, "step": STEP_S, "past": PAST, "turbines": turbines}
        self._kept = (time.monotonic(), made)
        return made


def margins_of(store: Store, names: Sequence[str], start: float) -> View:
    """The margins of those turbines that have some, step by step from `start` [s] on: the lowest `value` [K]
    and `half` the width of its 95 % band [K]; None in steps without any."""
    found = {}
    now = start + BACK_S
    for name in names:
        courses = [
            row
            for table, since, until in (("estimate", start, now), ("forecast", now, now + AHEAD_S))
            for row in store.rows(
                f"SELECT time, margin_K, margin_sd FROM {table} WHERE turbine = ? AND time >= ? AND time < ? "
                "AND margin_K IS NOT NULL",
                (name, since, until),
            )
        ]
        if not courses:
            continue
        rows = np.array(courses, dtype=float)
        value, half = lowest((rows[:, 0] - start) / STEP_S, rows[:, 1], rows[:, 2], PAST + AHEAD)
        found[name] = {"value": value, "half": half}
    return found


def lowest(
    place: np.ndarray, margin: np.ndarray, sd: np.ndarray, steps: int
) -> tuple[list[float | None], list[float | None]]:
    """The lowest margin [K] in each of the steps, and half the width of its 95 % band [K].

    place (T,): time as a multiple of the step; margin, sd (T,) [K].
    """
    step = np.floor(place).astype(int)
    order = np.lexsort((margin, step))
    first = order[np.r_[True, np.diff(step[order]) != 0]]
    value: list[float | None] = [None] * steps
    half: list[float | None] = [None] * steps
    for i in first:
        if 0 <= step[i] < steps and np.isfinite(margin[i]) and np.isfinite(sd[i]):
            value[step[i]], half[step[i]] = round(float(margin[i]), 1), round(Z95 * float(sd[i]), 1)
    return value, half
