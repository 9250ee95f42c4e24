"""The joint normal distribution of all readings of a linear model, assembled densely and without a filter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Course:
    """A linear model on T rows: `steps` (F (n, n), f (n,), Q (n, n)) from row to row, T−1 of them; first
    `mean` (n,) and `covariance` (n, n); `rows` (k, n) of the readings, which are all there, and their
    `noise` (k,)."""

    steps: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]
    mean: np.ndarray
    covariance: np.ndarray
    rows: np.ndarray
    noise: np.ndarray


def moments(course: Course) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean (T n,) and covariance (T n, T n) of the states, and of all readings (T k,), (T k, T k); complex
    numbers pass through."""
    mean, block = course.mean, course.covariance
    n, count = len(mean), len(course.steps) + 1
    means, blocks = [mean], [block]
    for f, shift, q in course.steps:
        mean, block = f @ mean + shift, f @ block @ f.T + q
        means.append(mean)
        blocks.append(block)
    joint = np.zeros((count * n, count * n), dtype=np.result_type(*blocks))
    for k in range(count):
        across = blocks[k]
        for j in range(k, count):
            across = across if j == k else course.steps[j - 1][0] @ across
            joint[j * n : (j + 1) * n, k * n : (k + 1) * n] = across
            joint[k * n : (k + 1) * n, j * n : (j + 1) * n] = across.T
    h = np.kron(np.eye(count), course.rows)
    return np.concatenate(means), joint, h, np.tile(course.noise, count)


def loglik(course: Course, y: np.ndarray) -> float:
    """ln L of readings (T, k), NaN where there is none."""
    mean, joint, h, r = moments(course)
    there = np.isfinite(y.ravel())
    h, error = h[there], y.ravel()[there] - h[there] @ mean
    spread = h @ joint @ h.T + np.diag(r[there])
    return -0.5 * float(
        len(error) * np.log(2 * np.pi) + np.linalg.slogdet(spread)[1] + error @ np.linalg.solve(spread, error)
    )


def smoothed(course: Course, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means (T, n) and covariances (T, n, n) of the states given all readings."""
    mean, joint, h, r = moments(course)
    there = np.isfinite(y.ravel())
    n = len(course.mean)
    h = h[there]
    gain = np.linalg.solve(h @ joint @ h.T + np.diag(r[there]), h @ joint).T
    after = mean + gain @ (y.ravel()[there] - h @ mean)
    left = joint - gain @ h @ joint
    blocks = [left[i : i + n, i : i + n] for i in range(0, len(mean), n)]
    return after.reshape(-1, n), np.array(blocks)


def score(course_of: Callable[[np.ndarray], Course], theta: np.ndarray, y: np.ndarray) -> np.ndarray:
    """∂ln L/∂θ (d,) with the moments' derivatives by complex steps: ½ e'V⁻¹∂V V⁻¹e − ½ tr V⁻¹∂V + e'V⁻¹∂m."""
    there = np.isfinite(y.ravel())

    def of_readings(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean, joint, h, r = moments(course_of(theta))
        return h[there] @ mean, h[there] @ joint @ h[there].T + np.diag(r[there])

    mean, spread = of_readings(theta)
    inverse = np.linalg.inv(spread)
    weighted = inverse @ (y.ravel()[there] - mean)
    found = []
    for i in range(len(theta)):
        moved = theta.astype(complex)
        moved[i] += 1e-30j
        dm, dv = (np.imag(part) * 1e30 for part in of_readings(moved))
        found.append(0.5 * weighted @ dv @ weighted - 0.5 * np.trace(inverse @ dv) + weighted @ dm)
    return np.array(found)
