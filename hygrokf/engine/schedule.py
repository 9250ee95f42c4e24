"""The sub-steps of a run: where every step is divided, and how often each sub-step is doubled.

Shapes: T instants, S sub-steps, K distinct sub-steps (rows of the key table).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hygrokf.engine.filter_loops import filter_loop
from hygrokf.engine.schedule_codegen import WORKSPACE, table_room
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Recursion

TOLERANCE = 1e-7
"""[1] largest error of a sub-step, in standard deviations of a mean and as a share of a covariance: a
cabinet's ln L is right to 8e-6 in 10,000 instants."""
MOST = 2_000_000
"""Most sub-steps of a run, besides a hundred for every instant."""


@dataclass(frozen=True)
class Schedule:
    """Sub-steps of a run: those to instant k are `offset[k]` … `offset[k+1]` (T+1,).  Each begins at `place`
    2^−`depth` of its step, has 2^−`depth` of its length, and is `doubled` as often (S,)."""

    offset: np.ndarray
    place: np.ndarray
    depth: np.ndarray
    doubled: np.ndarray

    def window(self, first: int, last: int) -> Schedule:
        """Those to the instants first … last−1."""
        begin, end = self.offset[first], self.offset[last]
        parts = (np.ascontiguousarray(one[begin:end]) for one in (self.place, self.depth, self.doubled))
        return Schedule(self.offset[first : last + 1] - begin, *parts)

    def halved(self) -> Schedule:
        """Every sub-step as two of half its length."""
        place = np.repeat(2 * self.place, 2)
        place[1::2] += 1
        return Schedule(2 * self.offset, place, np.repeat(self.depth + 1, 2), np.repeat(self.doubled, 2))


@dataclass(frozen=True)
class SubSteps:
    """Sub-steps as the compiled loops take them: the K distinct ones `keys` (K, 1 + regimes) with their
    lengths [h] and `times` (K,) doubled; `key` (T,) of every instant; `offset` (T+1,), `row` (S,) among the
    keys and `within` (S, 2) fractions of the step."""

    keys: np.ndarray
    times: np.ndarray
    key: np.ndarray
    offset: np.ndarray
    row: np.ndarray
    within: np.ndarray

    def of(self, part: slice) -> SubSteps:
        """Those of some instants, with no more keys than these need."""
        key, row, offset, within = self.key[part], self.row, self.offset, self.within
        if len(offset) > 1:
            first, last = offset[part.start], offset[part.stop]
            row, within = row[first:last], within[first:last]
            offset = offset[part.start : part.stop + 1] - first
        keys, times = self.keys, self.times
        if len(key) + len(row) < len(
            keys
        ):  # where every step has its own length, a table of all would fill memory
            used, place = np.unique(np.concatenate([key, row]), return_inverse=True)
            place = place.astype(np.int32)
            key, row = place[: len(key)], np.ascontiguousarray(place[len(key) :])
            keys, times = keys[used], times[used]
        return SubSteps(keys, times, np.ascontiguousarray(key), offset, row, np.ascontiguousarray(within))


def whole_steps(t: Timeline) -> SubSteps:
    """One exact step to every instant."""
    none = np.zeros(1, np.int32)
    return SubSteps(t.steps, np.zeros(len(t.steps), np.int32), t.key, none, none[:0], np.zeros((0, 2)))


def sub_steps(t: Timeline, schedule: Schedule) -> SubSteps:
    """The sub-steps of a schedule."""
    count = np.diff(schedule.offset)
    owner = np.repeat(t.key, count).astype(np.int64)
    kind = (owner * 64 + schedule.depth) * 1024 + schedule.doubled
    last = t.key.astype(np.int64) * 64 * 1024  # of the instants to which no time passes
    last[count > 0] = kind[schedule.offset[1:][count > 0] - 1]
    found, place = np.unique(np.concatenate([kind, last]), return_inverse=True)
    place = place.astype(np.int32)
    keys = t.steps[found // (64 * 1024)]
    share = 2.0**-schedule.depth
    keys[:, 0] *= 2.0 ** -(found // 1024 % 64).astype(float)
    within = np.column_stack([schedule.place * share, (schedule.place + 1) * share])
    row, key = np.ascontiguousarray(place[: len(kind)]), np.ascontiguousarray(place[len(kind) :])
    return SubSteps(keys, (found % 1024).astype(np.int32), key, schedule.offset, row, within)


@dataclass(frozen=True)
class Unresolved:
    """The instant whose step no sub-step resolves, and the state with the largest error."""

    instant: int
    state: int


def scheduled(
    recursion: Recursion,
    theta: np.ndarray,
    t: Timeline,
    part: slice,
    state: np.ndarray,
    tolerance: float,
    gain: bool,
) -> Schedule | Unresolved:
    """The schedule of some instants along the filter's course from packed moments, which are moved to their
    end."""
    count, whole = part.stop - part.start, len(t.steps)
    most = MOST + 100 * count
    room, begun = 8 * count + 64, state.copy()
    none, table = np.zeros(1, np.int32), np.empty(table_room(recursion, "schedule"))
    while True:
        places, depths, doubled = (np.empty(room, np.int32) for _ in range(3))
        offset, numbers = np.zeros(count + 1, np.int32), np.array([room, most, 0, 0, -1])
        state[:] = begun
        filter_loop(recursion, "schedule", gain)(
            "schedule", count, whole, theta, t.steps, np.zeros(whole, np.int32), table, t.key[part], offset,
            none, np.zeros(2), t.u[1:][part], t.y[part], t.reset[part], state, begun, places, depths, doubled,
            numbers, tags(), np.array([tolerance]),
        )  # fmt: skip
        _, _, taken, instant, worst = numbers.tolist()
        if worst >= 0:
            return Unresolved(part.start + instant, worst)
        if taken <= room:
            return Schedule(offset, places[:taken], depths[:taken], doubled[:taken])
        room = taken


def tags() -> np.ndarray:
    """The keys whose values the rows of a walk's table hold: none yet."""
    return np.full(WORKSPACE, -1, np.int64)


def joined(parts: list[Schedule]) -> Schedule:
    """Schedules of pieces of a run, one after the other."""
    offsets, total = [np.zeros(1, np.int32)], 0
    for one in parts:
        offsets.append(one.offset[1:] + total)
        total += len(one.place)
    place, depth, doubled = (
        np.concatenate([getattr(one, name) for one in parts]) for name in ("place", "depth", "doubled")
    )
    return Schedule(np.concatenate(offsets).astype(np.int32), place, depth, doubled)
