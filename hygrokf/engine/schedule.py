"""The sub-steps of a run: the division of every step, and the number of doublings of each sub-step.

Shapes: T instants, S sub-steps, K distinct sub-steps (rows of the key table).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hygrokf.engine.filter_loops import filter_loop
from hygrokf.engine.schedule_codegen import WORKSPACE, table_room
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Recursion

STEP_TOLERANCE = 1e-7
"""[1] largest error of a sub-step, in standard deviations of a mean and as a share of a covariance: the error
of a cabinet's ln L is 8e-6 in 10,000 instants."""
MAX_SUB_STEPS = 2_000_000
"""Largest number of sub-steps of a run, in addition to a hundred for every instant."""


@dataclass(frozen=True)
class Schedule:
    """Sub-steps of a run: those to instant k are `offset[k]` … `offset[k+1]` (T+1,).  A sub-step begins
    at the fraction `place` 2^−`depth` of its step, has 2^−`depth` of its length, and has `doubled` doublings,
    (S,) each."""

    offset: np.ndarray
    place: np.ndarray
    depth: np.ndarray
    doubled: np.ndarray

    def window(self, first: int, last: int) -> Schedule:
        """The sub-steps to the instants first … last−1."""
        begin, end = self.offset[first], self.offset[last]
        parts = (np.ascontiguousarray(array[begin:end]) for array in (self.place, self.depth, self.doubled))
        return Schedule(self.offset[first : last + 1] - begin, *parts)

    def halved(self) -> Schedule:
        """The schedule with every sub-step divided into two halves."""
        place = np.repeat(2 * self.place, 2)
        place[1::2] += 1
        return Schedule(2 * self.offset, place, np.repeat(self.depth + 1, 2), np.repeat(self.doubled, 2))


@dataclass(frozen=True)
class SubSteps:
    """Sub-steps as the compiled loops take them: the K distinct ones `keys` (K, 1 + regimes), lengths
    [h] and regimes, and `times` (K,), their doublings; `key` (T,) of every instant; `offset` (T+1,) as in
    `Schedule`; `row` (S,), index of each sub-step's key, and `within` (S, 2), its fractions of the step."""

    keys: np.ndarray
    times: np.ndarray
    key: np.ndarray
    offset: np.ndarray
    row: np.ndarray
    within: np.ndarray

    def of(self, part: slice) -> SubSteps:
        """The sub-steps of some instants, with only the keys that they need where these are fewer."""
        key, row, offset, within = self.key[part], self.row, self.offset, self.within
        if len(offset) > 1:
            first, last = offset[part.start], offset[part.stop]
            row, within = row[first:last], within[first:last]
            offset = offset[part.start : part.stop + 1] - first
        keys, times = self.keys, self.times
        if len(key) + len(row) < len(
            keys
        ):  # where every step has its own length, a table of all would fill memory
            used, index = np.unique(np.concatenate([key, row]), return_inverse=True)
            index = index.astype(np.int32)
            key, row = index[: len(key)], np.ascontiguousarray(index[len(key) :])
            keys, times = keys[used], times[used]
        return SubSteps(keys, times, np.ascontiguousarray(key), offset, row, np.ascontiguousarray(within))


def whole_steps(t: Timeline) -> SubSteps:
    """One exact step to every instant."""
    none = np.zeros(1, np.int32)
    return SubSteps(t.steps, np.zeros(len(t.steps), np.int32), t.key, none, none[:0], np.zeros((0, 2)))


def sub_steps(t: Timeline, schedule: Schedule) -> SubSteps:
    """The sub-steps of a schedule."""
    count = np.diff(schedule.offset)
    step_key = np.repeat(t.key, count).astype(np.int64)
    code = (step_key * 64 + schedule.depth) * 1024 + schedule.doubled
    instant_code = t.key.astype(np.int64) * 64 * 1024  # instants without a step keep depth 0 and no doubling
    instant_code[count > 0] = code[schedule.offset[1:][count > 0] - 1]
    distinct, index = np.unique(np.concatenate([code, instant_code]), return_inverse=True)
    index = index.astype(np.int32)
    keys = t.steps[distinct // (64 * 1024)]
    share = 2.0**-schedule.depth
    keys[:, 0] *= 2.0 ** -(distinct // 1024 % 64).astype(float)
    within = np.column_stack([schedule.place * share, (schedule.place + 1) * share])
    row, key = np.ascontiguousarray(index[: len(code)]), np.ascontiguousarray(index[len(code) :])
    return SubSteps(keys, (distinct % 1024).astype(np.int32), key, schedule.offset, row, within)


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
    """Choose the sub-steps of some instants along the filtered course.

    `state`: packed moments at the start, replaced by the moments at the end."""
    count, step_count = part.stop - part.start, len(t.steps)
    limit = MAX_SUB_STEPS + 100 * count
    room, first_state = 8 * count + 64, state.copy()
    empty, table = np.zeros(1, np.int32), np.empty(table_room(recursion, "schedule"))
    while True:
        places, depths, doubled = (np.empty(room, np.int32) for _ in range(3))
        offset, numbers = np.zeros(count + 1, np.int32), np.array([room, limit, 0, 0, -1])
        state[:] = first_state
        filter_loop(recursion, "schedule", gain)(
            "schedule", count, step_count, theta, t.steps, np.zeros(step_count, np.int32), table, t.key[part],
            offset, empty, np.zeros(2), t.u[1:][part], t.y[part], t.reset[part], state, first_state, places,
            depths, doubled, numbers, tags(), np.array([tolerance]),
        )  # fmt: skip
        _, _, taken, instant, worst = numbers.tolist()
        if worst >= 0:
            return Unresolved(part.start + instant, worst)
        if taken <= room:
            return Schedule(offset, places[:taken], depths[:taken], doubled[:taken])
        room = taken


def tags() -> np.ndarray:
    """The keys whose values the rows of a walk's table hold: −1, for no key yet."""
    return np.full(WORKSPACE, -1, np.int64)


def joined(parts: list[Schedule]) -> Schedule:
    """Concatenate the schedules of consecutive pieces of a run."""
    offsets, total = [np.zeros(1, np.int32)], 0
    for part in parts:
        offsets.append(part.offset[1:] + total)
        total += len(part.place)
    place, depth, doubled = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("place", "depth", "doubled")
    )
    return Schedule(np.concatenate(offsets).astype(np.int32), place, depth, doubled)
