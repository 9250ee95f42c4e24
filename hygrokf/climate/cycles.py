"""Cycles of a course by rainflow counting, ASTM E1049-85 (2017), section 5.4.4."""

from __future__ import annotations

import itertools

import numpy as np


def turning_points(values: np.ndarray) -> np.ndarray:
    """Values (T,) at which a course turns, with its two ends."""
    values = np.asarray(values, dtype=float)
    if len(values) < 3:
        return values
    changed = np.append(True, values[1:] != values[:-1])
    values = values[changed]
    if len(values) < 3:
        return values
    rise = np.sign(np.diff(values))
    return values[np.concatenate([[True], rise[1:] != rise[:-1], [True]])]


def rainflow(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (c,) of the cycles in a course (T,), in its unit, and their counts (c,): 1, or 0.5 for half
    cycles."""
    ranges: list[float] = []
    counts: list[float] = []
    stack: list[float] = []
    for value in turning_points(values).tolist():
        stack.append(value)
        while len(stack) >= 3:
            last, before = abs(stack[-1] - stack[-2]), abs(stack[-2] - stack[-3])
            if last < before:
                break
            ranges.append(before)
            if len(stack) == 3:  # the range holds the start of the course: half a cycle
                counts.append(0.5)
                del stack[0]
            else:
                counts.append(1.0)
                del stack[-3:-1]
    ranges += [abs(b - a) for a, b in itertools.pairwise(stack)]
    counts += [0.5] * max(len(stack) - 1, 0)
    return np.array(ranges), np.array(counts)


def cycles_from(values: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Number (k,) of cycles in a course (T,) with a range of at least each of `least` (k,)."""
    ranges, counts = rainflow(values)
    return np.array([counts[ranges >= one].sum() for one in least])
