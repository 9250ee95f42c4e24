"""The pieces of a run that the compiled loops take in one call, and what comes between: long steps, which are
gaps of months or of ten years, and the ends of gaps.

The compiled loops divide a step into sub-steps according to the fastest rate.  A year takes a hundred
thousand of them, most of which change nothing: the fast states follow the inputs, the slow ones move slowly.
Such a step is therefore taken in two parts.  The first part is a *jump*: with the Jacobian A fixed at the
state x₀ where a piece of the step begins and at the inputs where it ends, and the remainder b(t) = f(x₀,
u(t)) a straight line through its two Gauss nodes, the moment equations

    dm/dt = A (m − x₀) + b(t),     dP/dt = A P + P A' + Q

have closed solutions for any length H.  The matrices of a short step h = H/2^s are Taylor polynomials,
doubled s times: with z = (m − x₀, 1, t), z(t+h) = (I + D) z(t) and N = ∫₀ʰ e^{Aσ} Q e^{A'σ} dσ,

    D ← 2 D + D²,     N ← N + E N E',  E = I + D's upper left part.

I + D is never formed while D is small, so that slow states keep all digits.  The compiled loops take the
second part, the last `TAIL` sub-steps.

Steps of constant rates need no jump (`discretisation.Doubling`).  A jump is divided into pieces, each at most
half of the remaining time: for a state that follows the inputs every piece is a Newton step, and
the tail removes the remaining error.  States that outlast the tail (random walks, slow disturbances) are
linear, so their moments are exact too.

Source: Van Loan 1978, doi:10.1109/TAC.1978.1101743 (the integrals); Moler & Van Loan 2003,
doi:10.1137/S00361445024180 (scaling and squaring).

In a gap too long to bridge the inputs hold their last values, and no reading is used.  The true inputs may
have been any, so every state that follows an input, at once or through other states, is as uncertain at the
end of the gap as at a record's first instant:

    P ← P + diag(p₀),    p₀ the initial variance of these states, 0 of the others.

The filter's own covariance says from then on how much a reading tells, and how soon the gap is forgotten.
Disturbances, sensors' errors and random walks keep what is known of them.
Shapes: B runs or directions side by side, T instants, n states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hygrokf.engine.discretisation import NODES
from hygrokf.engine.packing import pack, unpack
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.expression import Matrix, is_zero
from hygrokf.physics.holds import inputs_between
from hygrokf.physics.model import Model, Values

MOST = 10_000
"""Largest number of sub-steps that the loops take for a whole step; of a longer step they take the last
`TAIL`."""
TAIL = 2_000
"""Sub-steps at the end of a long step: with 0.35 of the fastest time constant each, they span 700 time
constants."""
ORDER = 13
"""Degree of the polynomials for the short step, whose rate times length is at most `SHORT`: remainder
1e-18."""
SHORT = 0.125


@dataclass(frozen=True)
class LongStep:
    """One long step of a run: a jump of `hours` [h] from the inputs `before` to those at the start of its
    tail of `tail_h` [h].

    States are packed moments (width,), in the layout of the compiled loops.
    """

    recursion: Recursion
    before: Mapping[str, np.ndarray | float]
    tail: Mapping[str, np.ndarray | float]
    hours: float
    tail_h: float

    def take(self, values: Mapping[str, float], state: np.ndarray) -> np.ndarray:
        """Move a state to the tail, in place; returns the transition (n, n) to there."""
        moved, transition = self._jumped(values, state[None])
        state[:] = moved[0]
        return transition[0]

    def tangents(
        self, values: Mapping[str, float], state: np.ndarray, dots: np.ndarray, seeds: np.ndarray
    ) -> np.ndarray:
        """Tangents (width, r) at the tail from those before the step and the directions (d, r), by complex
        steps."""
        moved = {
            name: values[name] + 1e-30j * seed for name, seed in zip(self.recursion.p, seeds, strict=True)
        }
        found, _ = self._jumped(moved, state + 1e-30j * dots.T)
        return np.imag(found).T * 1e30

    def adjoints(
        self, values: Mapping[str, float], state: np.ndarray, bar: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Adjoints (width,) of the state before and (d,) of the parameters, from the adjoints `bar` of the
        state at the tail."""
        r = self.recursion
        n, d, width = r.n, len(r.p), len(state)
        # covariances pass through linearly, so only means and parameters need separate directions
        own = width if r.unknown or r.factored else n
        dots, seeds = np.zeros((width, own + d)), np.zeros((d, own + d))
        dots[:own, :own], seeds[:, own:] = np.eye(own), np.eye(d)
        found = bar @ self.tangents(values, state, dots, seeds)
        if own == width:
            return found[:own], found[own:]
        transition = self._jumped(values, state[None])[1][0]
        # off the diagonal, a packed entry stands for two entries: each takes half of its adjoint
        share = np.where(np.eye(n, dtype=bool), 1.0, 0.5)
        back = pack(transition.T @ (unpack(bar[n:], n) * share) @ transition / share)
        return np.concatenate([found[:n], back]), found[n:]

    def _jumped(self, values: Values, packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Packed moments (B, width) at the tail, and the transition (B, n, n)."""
        r, count = self.recursion, len(packed)
        mean, (covariance,), transition = jump(
            r,
            values,
            self.before,
            self.tail,
            np.full(count, self.hours),
            np.full(count, self.tail_h),
            packed[:, : r.n],
            [r.covariance_of(packed)],
        )
        moved = r.put(packed.astype(np.result_type(packed, mean, covariance)), covariance)
        moved[:, : r.n] = mean
        if r.unknown:
            loadings = slice(r.loaded, r.loaded + r.n * r.unknown)
            carried = transition @ packed[:, loadings].reshape(count, r.n, r.unknown)
            begun = packed[:, -1:].real > 0.5
            moved[:, loadings] = np.where(begun, carried.reshape(count, -1), packed[:, loadings])
        return moved, transition


def jump(
    recursion: Recursion,
    values: Values,
    before: Mapping[str, np.ndarray | float],
    after: Mapping[str, np.ndarray | float],
    hours: np.ndarray,
    rest_h: np.ndarray,
    mean: np.ndarray,
    covariances: Sequence[np.ndarray],
) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
    """Mean (B, n) and covariances (B, n, n) after `hours` (B,) [h], and the transition (B, n, n) of the
    state.

    `values` of the parameters; `before` and `after` the inputs at both ends (numbers or (B,)), linear in
    between; `rest_h` (B,) [h] the remainder of the step after the jump; `covariances` (B, n, n) each: the
    first one accumulates the noise, the others are only propagated.  Accepts complex numbers, so that complex
    steps give exact derivatives.  A model that grows without limit yields numbers that are not finite.
    """
    if recursion.rising_noise:
        raise ValueError(
            f"expected steps of at most {MOST} sub-steps where the process noise follows an input between "
            'two instants, found a longer one; hold this input "previous" or "mean", or give instants within'
        )
    transition = np.broadcast_to(np.eye(recursion.n), (len(mean), recursion.n, recursion.n))
    pieces = max(1, math.ceil(math.log2(np.max(1.0 + hours / rest_h)) - 1e-9))
    shrink = (1.0 + hours / rest_h) ** (-1.0 / pieces)
    share = [(hours + rest_h) * (1.0 - shrink**k) / hours for k in range(pieces)] + [np.ones_like(hours)]
    carried, holds = tuple(covariances), recursion.holds
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(pieces):
            first, last = (inputs_between(holds, before, after, share[i]) for i in (k, k + 1))
            at_end = recursion.symbols(values, mean.T, last)
            matrix = _matrix(recursion, recursion.jacobian, at_end, len(mean))
            nodes = [at_end | recursion.symbols({}, (), inputs_between(holds, first, last, c)) for c in NODES]
            rest = [_vector(recursion, known, len(mean)) for known in nodes]
            noise = _matrix(recursion, recursion.noise, nodes[0], len(mean))
            change, gained = _doubled(matrix, rest, noise, (share[k + 1] - share[k]) * hours)
            n = recursion.n
            step = np.eye(n) + change[:, :n, :n]
            mean = mean + change[:, :n, n]
            carried = tuple(_symmetric(step @ p @ np.swapaxes(step, 1, 2)) for p in carried)
            carried = (carried[0] + gained, *carried[1:])
            transition = step @ transition
    return mean, carried, transition


def _doubled(
    matrix: np.ndarray, rest: Sequence[np.ndarray], noise: np.ndarray, hours: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """D (B, n+2, n+2) of z = (x − x₀, 1, t) and the accumulated noise (B, n, n) over `hours`."""
    n = matrix.shape[1]
    slope = (rest[1] - rest[0]) / ((NODES[1] - NODES[0]) * hours)[:, None]
    field = np.zeros((len(matrix), n + 2, n + 2), dtype=np.result_type(matrix, *rest))
    field[:, :n, :n] = matrix
    field[:, :n, n] = rest[0] - NODES[0] * hours[:, None] * slope
    field[:, :n, n + 1] = slope
    field[:, n + 1, n] = 1.0
    reach = float(np.max(_rates(matrix) * hours))
    if not math.isfinite(reach):
        return np.full_like(field, np.nan), np.full_like(noise, np.nan)
    doublings = max(0, math.ceil(math.log2(max(reach, SHORT) / SHORT)))
    short = hours / 2.0**doublings
    field = field * short[:, None, None]
    inner, spread = field[:, :n, :n], noise * short[:, None, None]
    change, gained = field, spread
    for k in range(ORDER, 1, -1):  # D = X (I + X/2 (I + X/3 (…)))
        change = field + (field @ change) / k
    for k in range(2, ORDER + 1):
        half = inner @ spread / k
        spread = half + np.swapaxes(half, 1, 2)
        gained = gained + spread
    for _ in range(doublings):
        half = change[:, :n, :n] @ gained
        gained = 2.0 * gained + half + np.swapaxes(half, 1, 2) + half @ np.swapaxes(change[:, :n, :n], 1, 2)
        change = 2.0 * change + change @ change
    return change, _symmetric(gained)


def _rates(matrix: np.ndarray) -> np.ndarray:
    """Upper bound (B,) of the eigenvalues' size, from the diagonal and the pairs of states that act on each
    other."""
    size = np.abs(matrix)
    pairs = np.sqrt(size * np.swapaxes(size, 1, 2))
    return pairs.sum(axis=2).max(axis=1)


def _vector(recursion: Recursion, known: Values, count: int) -> np.ndarray:
    """The rates f (B, n)."""
    found = [np.broadcast_to(v, count) for v in recursion.graph.evaluate(recursion.rates, known)]
    return np.stack(found, axis=1)


def _matrix(recursion: Recursion, rows: Matrix, known: Values, count: int) -> np.ndarray:
    """A matrix of expressions as numbers (B, n, n)."""
    n = recursion.n
    places = [(i, j) for i in range(n) for j in range(n) if not is_zero(rows[i][j])]
    found = recursion.graph.evaluate([rows[i][j] for i, j in places], known)
    matrix = np.zeros((count, n, n), dtype=np.result_type(float, *found))
    for (i, j), value in zip(places, found, strict=True):
        matrix[:, i, j] = value
    return matrix


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + np.swapaxes(matrix, 1, 2))


@dataclass(frozen=True)
class SubSteps:
    """Sub-steps: `keys` (distinct steps, 1 + regimes) with their length [h], `parts` their number; `ends` the
    instants after the ends of gaps; `long` the instants that a long step leads to, of which the loops take
    the last `tail_h` [h]."""

    keys: np.ndarray
    parts: np.ndarray
    ends: tuple[int, ...]
    long: tuple[int, ...] = ()
    tail_h: float = 0.0

    def pieces(self, part: slice) -> list[slice]:
        """Stretches of instants that the loops take in one call; every long step and every end of a gap
        begins a new one."""
        inner = {k for k in (*self.long, *self.ends) if part.start < k < part.stop}
        return [slice(a, b) for a, b in pairwise([part.start, *sorted(inner), part.stop])]


def gap_variances(model: Model, recursion: Recursion, t: Timeline) -> dict[int, np.ndarray]:
    """p₀ (n,) of each end of a gap, by the instant after it; parameters that it depends on have their start
    values."""
    start, found = {p.name: p.start for p in model.parameters}, {}
    driven = _driven(recursion) if t.ends.any() else np.empty(0)
    for k in np.flatnonzero(t.ends).tolist():
        held = zip((*t.regimes, *t.varying), (*t.steps[t.key[k], 1:], *t.u[k]), strict=True)
        _, variance = model.initial(start, {name: float(value) for name, value in held})
        found[k] = np.where(driven, np.array(variance, dtype=float), 0.0)
    return found


def _driven(recursion: Recursion) -> np.ndarray:
    """(n,) True for states that follow an input, by themselves or through other states."""
    graph, n = recursion.graph, recursion.n
    inputs = {i for i, node in enumerate(graph.nodes) if node[0] == "symbol" and node[1][:2] in ("b:", "g:")}
    driven = np.array([not inputs.isdisjoint(graph.needed([rate])) for rate in recursion.rates])
    acts = np.array([[not is_zero(entry) for entry in row] for row in recursion.jacobian]).reshape(n, n)
    for _ in range(n):
        driven = driven | (acts @ driven)
    return driven


def long_step(model: Model, recursion: Recursion, t: Timeline, steps: SubSteps, k: int) -> LongStep:
    """The long step to instant k."""
    hours, *held = t.steps[t.key[k]].tolist()
    before, after = (
        dict(zip((*t.regimes, *t.varying), (*held, *t.u[row].tolist()), strict=True)) for row in (k, k + 1)
    )
    tail = inputs_between(model.holds, before, after, 1.0 - steps.tail_h / hours)
    return LongStep(recursion, before, tail, hours - steps.tail_h, steps.tail_h)
