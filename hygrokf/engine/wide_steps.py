"""The matrices of whole steps where rates are constant within a step, and their derivatives, as numbers.

For dx = (A x + B (u₀ + t u₁)) dt + L dW, Q = L L', a step of length h has

    T = (e^{Ah} − I,  ∫₀ʰ e^{Aσ} B dσ,  ∫₀ʰ (h−σ) e^{Aσ} B dσ),     N = ∫₀ʰ e^{Aσ} Q e^{A'σ} dσ.

Both are power series in the length.  A share h/2^s of the step takes them, whose coefficients all steps with
the same A and Q have in common, and is doubled s times: with E the left part of T, G its middle,

    T ← 2 T + E T + (0, 0, h G),     N ← N + (I + E) N (I + E)'.

I + E is never formed while E is small, so that slow states keep all digits.  Tangents and adjoints
differentiate these recursions.

Source: Van Loan 1978, doi:10.1109/TAC.1978.1101743 (the integrals); Moler & Van Loan 2003,
doi:10.1137/S00361445024180 (scaling and squaring).
Shapes: K steps, U distinct pairs of A and Q, n states, c columns of B, r directions, w = n + 2 c.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

SHORT = 1.0
"""Largest product of the bound of the rates and the share of a step that the series take."""
ORDER = 20
"""Degree of the series: remainder 2e-20."""


@dataclass(frozen=True)
class StepSeries:
    """Coefficients of T (U, n, w) and N (U, n, n), for powers of the length in 1/`rate` (U, 1, 1)."""

    a: np.ndarray
    rate: np.ndarray
    rows: list[np.ndarray]
    spreads: list[np.ndarray]

    def tangents(self, da: np.ndarray, dq: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Derivatives of the coefficients along those of A and Q, (U, r, n, n) each."""
        a, n = self.a[:, None], self.a.shape[-1]
        da, ds = da / self.rate[:, None], dq / self.rate[:, None]
        dr = np.zeros((*da.shape[:-1], self.rows[0].shape[-1]))
        dr[..., :n] = da
        rows, spreads = [dr], [ds]
        for k, (row, spread) in enumerate(zip(self.rows[:-1], self.spreads[:-1], strict=True), 2):
            dr = (da @ row[:, None] + a @ dr) / k
            ds = _both(da @ spread[:, None] + a @ ds) / k
            rows.append(dr)
            spreads.append(ds)
        return rows, spreads

    def adjoints(
        self, row_bars: list[np.ndarray], spread_bars: list[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Adjoints (U, n, n) of A and Q from those of the coefficients."""
        a, a_bar = self.a, np.zeros_like(self.a)
        row_bar, spread_bar = row_bars[-1], spread_bars[-1]
        for k in range(len(self.rows), 1, -1):
            a_bar += (row_bar @ _t(self.rows[k - 2]) + 2.0 * spread_bar @ self.spreads[k - 2]) / k
            row_bar = row_bars[k - 2] + _t(a) @ row_bar / k
            spread_bar = spread_bars[k - 2] + _both(_t(a) @ spread_bar) / k
        return (a_bar + row_bar[..., : a.shape[-1]]) / self.rate, spread_bar / self.rate


def series(a: np.ndarray, q: np.ndarray, b: np.ndarray) -> StepSeries:
    """The coefficients for A, Q (U, n, n) [1/h] and a constant B (n, c)."""
    (n, c), rate = b.shape, bound(a)[:, None, None]
    rate = np.where(rate > 0.0, rate, 1.0)
    a, drive = a / rate, b / rate
    row = np.concatenate([a, drive, np.zeros_like(drive)], axis=2)
    rows, spreads = [row], [q / rate]
    for k in range(2, ORDER + 1):
        row = a @ row
        if k == 2:
            row[..., n + c :] = drive / rate
        row = row / k
        rows.append(row)
        spreads.append(_both(a @ spreads[-1]) / k)
    return StepSeries(a, rate, rows, spreads)


@dataclass(frozen=True)
class Powers:
    """T (K, n, w) and N (K, n, n) of steps that are doubled equally often; `which` (K,) of the series they
    take at `share` (K, 1, 1), in units of 1/rate; `stages` T, N and the length before each doubling."""

    series: StepSeries
    which: np.ndarray
    share: np.ndarray
    stages: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    whole: np.ndarray
    noise: np.ndarray

    def tangents(self, rows: list[np.ndarray], spreads: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (K, r, n, w) and (K, r, n, n) of T and N from those of the coefficients."""
        n = self.whole.shape[-2]
        change, gained = (_at(one, self.which, self.share[:, None]) for one in (rows, spreads))
        for whole, noise, hours in self.stages:
            e, de = whole[:, None, :, :n], change[..., :n]
            moved = np.eye(n) + e
            gained = gained + moved @ gained @ _t(moved) + _both(de @ (noise[:, None] @ _t(moved)))
            change = 2.0 * change + de @ whole[:, None] + e @ change + _ramp(change, n, hours[:, None])
        return change, gained

    def adjoints(self, bar: np.ndarray, noise_bar: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Adjoints of the coefficients from those of T (K, n, w) and N (K, n, n), the latter symmetric."""
        n = self.whole.shape[-2]
        c = (bar.shape[-1] - n) // 2
        for whole, noise, hours in reversed(self.stages):
            e = whole[..., :n]
            moved = np.eye(n) + e
            before = 2.0 * bar + _t(e) @ bar
            before[..., n : n + c] += hours * bar[..., n + c :]
            before[..., :n] += bar @ _t(whole) + 2.0 * noise_bar @ moved @ noise
            bar, noise_bar = before, noise_bar + _t(moved) @ noise_bar @ moved
        chosen = np.arange(len(self.series.a))[:, None] == self.which
        factors = [chosen * self.share[:, 0, 0] ** k for k in range(1, ORDER + 1)]
        rows, spreads = ([np.tensordot(f, one, 1) for f in factors] for one in (bar, noise_bar))
        return rows, spreads


def powers(found: StepSeries, which: np.ndarray, hours: np.ndarray) -> Iterator[tuple[np.ndarray, Powers]]:
    """Steps of equally many doublings at a time: their places among the K, and their matrices.

    which: (K,) of the pairs of A and Q that a step has; hours: (K,) [h].
    """
    reach = found.rate[which, 0, 0] * hours
    doublings = np.ceil(np.log2(np.maximum(reach / SHORT, 1.0))).astype(int)
    for count in np.unique(doublings).tolist():
        places = np.flatnonzero(doublings == count)
        shrink = 2.0**-count
        share, length = reach[places, None, None] * shrink, hours[places, None, None] * shrink
        whole, noise = (_at(one, which[places], share) for one in (found.rows, found.spreads))
        n, stages = noise.shape[-1], []
        for i in range(count):
            stages.append((whole, noise, length * 2.0**i))
            e = whole[..., :n]
            moved = np.eye(n) + e
            noise = noise + moved @ noise @ _t(moved)
            whole = 2.0 * whole + e @ whole + _ramp(whole, n, length * 2.0**i)
        yield places, Powers(found, which[places], share, stages, whole, noise)


def _at(coefficients: list[np.ndarray], which: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Σ_k share^k c_k, the smallest terms first."""
    total = np.zeros(())
    for one in reversed(coefficients):
        total = (total + one[which]) * share
    return total


def bound(a: np.ndarray) -> np.ndarray:
    """Upper bound (K,) of the eigenvalues' size of matrices (K, n, n), near the spectral radius of |A|.

    For every positive v, max (|A| v)_i / v_i is one (Collatz 1942, doi:10.1007/BF01180013).  In the norm
    that v scales, |A| has this size, so that series in A converge as those of a number do.
    """
    size = np.abs(a)
    v = np.ones((*a.shape[:-1], 1))
    for _ in range(16):  # half of the old vector keeps all entries positive, and rings of states from turning
        grown = size @ v
        v = 0.5 * (v + grown / np.maximum(grown.max(axis=-2, keepdims=True), np.finfo(float).tiny))
    return np.asarray((size @ v / v).max(axis=(-2, -1)))


def _ramp(whole: np.ndarray, n: int, hours: np.ndarray) -> np.ndarray:
    """(0, 0, h G) of a T."""
    c = (whole.shape[-1] - n) // 2
    moved = np.zeros_like(whole)
    moved[..., n + c :] = hours * whole[..., n : n + c]
    return moved


def _t(matrix: np.ndarray) -> np.ndarray:
    return np.swapaxes(matrix, -1, -2)


def _both(matrix: np.ndarray) -> np.ndarray:
    """A matrix and its transpose, added."""
    return matrix + _t(matrix)
