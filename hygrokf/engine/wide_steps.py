"""The matrices of whole steps where rates are constant within a step, and their derivatives, as numbers.

For dx = (A x + B (u₀ + t u₁)) dt + L dW, Q = L L', a step of length h has

    T = (e^{Ah} − I,  ∫₀ʰ e^{Aσ} B dσ,  ∫₀ʰ (h−σ) e^{Aσ} B dσ),     N = ∫₀ʰ e^{Aσ} Q e^{A'σ} dσ.

Both are power series of a share h/2^s of the step, doubled s times: with E the left part of T, G its middle,

    T ← 2 T + E T + (0, 0, h G),     N ← N + (I + E) N (I + E)'.

I + E is never formed while E is small, so that slow states keep all digits.  Tangents and adjoints
differentiate these recursions.

Source: Van Loan 1978, doi:10.1109/TAC.1978.1101743 (the integrals); Moler & Van Loan 2003,
doi:10.1137/S00361445024180 (scaling and squaring).
Shapes: K steps, n states, c columns of B, r directions, w = n + 2 c.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

SHORT = 0.25
"""Largest product of the bound of the rates and the share of a step that the series take."""
ORDER = 13
"""Degree of the series: remainder 4e-20."""


@dataclass(frozen=True)
class Powers:
    """T (K, n, w) and N (K, n, n) of steps that are doubled equally often, with all that led to them.

    `x` A times the shares, `rows` and `spreads` the terms of both series, `stages` T, N and the length before
    each doubling.
    """

    x: np.ndarray
    rows: list[np.ndarray]
    spreads: list[np.ndarray]
    stages: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    share: np.ndarray
    whole: np.ndarray
    noise: np.ndarray

    def tangents(self, da: np.ndarray, dq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (K, r, n, w) and (K, r, n, n) of T and N along those of A and Q, (K, r, n, n) each."""
        n = self.x.shape[-1]
        short = self.share[:, None]
        dx, ds = da * short, dq * short
        dr = np.zeros((*dx.shape[:-1], self.whole.shape[-1]))
        dr[..., :n] = dx
        change, gained = dr, ds
        x = self.x[:, None]
        for k, (row, spread) in enumerate(zip(self.rows[:-1], self.spreads[:-1], strict=True), 2):
            dr = (dx @ row[:, None] + x @ dr) / k
            ds = _both(dx @ spread[:, None] + x @ ds) / k
            change, gained = change + dr, gained + ds
        for whole, noise, hours in self.stages:
            e, de = whole[:, None, :, :n], change[..., :n]
            moved = np.eye(n) + e
            gained = gained + moved @ gained @ _t(moved) + _both(de @ (noise[:, None] @ _t(moved)))
            change = 2.0 * change + de @ whole[:, None] + e @ change + _ramp(change, n, hours[:, None])
        return change, gained

    def adjoints(self, bar: np.ndarray, noise_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Adjoints (K, n, n) of A and Q from those of T (K, n, w) and N (K, n, n), the latter symmetric."""
        n = self.x.shape[-1]
        c = (bar.shape[-1] - n) // 2
        for whole, noise, hours in reversed(self.stages):
            e = whole[..., :n]
            moved = np.eye(n) + e
            before = 2.0 * bar + _t(e) @ bar
            before[..., n : n + c] += hours * bar[..., n + c :]
            before[..., :n] += bar @ _t(whole) + 2.0 * noise_bar @ moved @ noise
            bar, noise_bar = before, noise_bar + _t(moved) @ noise_bar @ moved
        x, x_bar = self.x, np.zeros_like(self.x)
        row_bar, spread_bar = bar, noise_bar
        for k in range(len(self.rows), 1, -1):
            x_bar += (row_bar @ _t(self.rows[k - 2]) + 2.0 * spread_bar @ self.spreads[k - 2]) / k
            row_bar = bar + _t(x) @ row_bar / k
            spread_bar = noise_bar + _both(_t(x) @ spread_bar) / k
        return (x_bar + row_bar[..., :n]) * self.share, spread_bar * self.share


def powers(
    a: np.ndarray, q: np.ndarray, b: np.ndarray, hours: np.ndarray
) -> Iterator[tuple[np.ndarray, Powers]]:
    """Steps of equally many doublings at a time: their places among the K, and their matrices.

    a, q: (K, n, n) [1/h]; b: (n, c) constant; hours: (K,) [h].
    """
    doublings = np.ceil(np.log2(np.maximum(bound(a) * hours / SHORT, 1.0))).astype(int)
    for count in np.unique(doublings).tolist():
        places = np.flatnonzero(doublings == count)
        yield places, _powers(a[places], q[places], b, hours[places, None, None], count)


def _powers(a: np.ndarray, q: np.ndarray, b: np.ndarray, hours: np.ndarray, doublings: int) -> Powers:
    (n, c), share = b.shape, hours / 2.0**doublings
    x = a * share
    row = np.concatenate([x, np.broadcast_to(b, (len(x), n, c)) * share, np.zeros((len(x), n, c))], axis=2)
    rows, spreads = [row], [q * share]
    whole, noise = row, spreads[0]
    for k in range(2, ORDER + 1):
        row = x @ row
        if k == 2:
            row[..., n + c :] = b * share**2
        row, spread = row / k, _both(x @ spreads[-1]) / k
        rows.append(row)
        spreads.append(spread)
        whole, noise = whole + row, noise + spread
    stages = []
    for i in range(doublings):
        stages.append((whole, noise, share * 2.0**i))
        e = whole[..., :n]
        moved = np.eye(n) + e
        noise = noise + moved @ noise @ _t(moved)
        whole = 2.0 * whole + e @ whole + _ramp(whole, n, share * 2.0**i)
    return Powers(x, rows, spreads, stages, share, whole, noise)


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
