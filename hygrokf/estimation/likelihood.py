"""Log-likelihood of the innovations, its score, its sensitivities: pure functions of the parameters.

    ln L(θ) = −½ Σ_k (ln 2πS_k + ρ(e_k²/S_k)),    e_k the innovation of reading k, S_k its variance,

with ρ(q) = q, or, in a model with a bound b, b² (1 + ln(q/b²)) where q > b² (`traced_filter.Recursion`).

Shapes: T instants, n states, k outputs, d parameters (all of the model, in its order).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hygrokf.data.timestamps import duration_text, stamp_text
from hygrokf.engine.discretisation import CONSTANT_RATES, VARYING_RATES
from hygrokf.engine.filter_loops import Control, filter_loop
from hygrokf.engine.information import summed
from hygrokf.engine.llvm_writer import LANES
from hygrokf.engine.long_steps import MOST, TAIL, LongStep, SubSteps, gap_variances, long_step
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Recursion, pack, trace_width, traced, unpack
from hygrokf.engine.wide_recursion import recursion_of
from hygrokf.physics.expression import is_zero
from hygrokf.physics.model import Model, fields_alone
from hygrokf.physics.parameters import expect_values

CHUNK = 4096
"""Number of instants for which sensitivities are held in memory at a time."""
INITIAL = ("prior", "stationary", "diffuse")
GAPS = 1_000
"""Largest number of long steps in one run; more mean a rate far above what the readings resolve."""

Place = tuple[int, int]
"""Row and column of an entry of a Jacobian."""
Blocks = tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]
"""First moments, their tangents, and the directions: one array each for every `LANES` directions."""


class RatesFault(FloatingPointError, ValueError):
    """Rates that no step can represent; the message names the state or the steps, and the remedy."""


@dataclass(frozen=True)
class Gaussian:
    """State at `time_h` as a normal distribution, a filter's checkpoint: mean (n,), covariance (n, n)."""

    mean: np.ndarray
    covariance: np.ndarray
    time_h: float = 0.0


@dataclass(frozen=True)
class Sensitivities:
    """Log-likelihood, score (r,), information (r, r) along r directions; `scores` (T, r): by instant, empty
    where they were not asked for."""

    loglik: float
    score: np.ndarray
    information: np.ndarray
    scores: np.ndarray


@dataclass(frozen=True)
class Trace:
    """All moments of one filter run: `prior_mean` (T, n), `prior_covariance` (T, n, n) before the readings of
    an instant, `mean`, `covariance` after them; `prediction` (T, k) and `variance` (T, k) of every output,
    each given the readings processed before it; `transition` (T, n, n) the derivative of the state with
    respect to that at the previous instant; `last` the Gaussian to continue from."""

    prior_mean: np.ndarray
    prior_covariance: np.ndarray
    prediction: np.ndarray
    variance: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    transition: np.ndarray
    loglik: float
    last: Gaussian


@dataclass(frozen=True)
class Likelihood:
    """The likelihood of the innovations of one model on one timeline.

    model, timeline: n states, d parameters; T instants [h] with readings (T, k), NaN where one is missing.
    initial, diffuse_states: "prior" (each mechanism's own), "stationary" (steady state at the first inputs),
        "diffuse" (exact, for these states, by default all; others keep their prior), or a `Gaussian`.
    rate_step: [1] largest product of the fastest rate and a sub-step, in place of the discretisation's own: a
        search may take longer sub-steps at the expense of the last digits.
    fastest: [1/h] the model's fastest rate, in place of the bound from all inputs of the run.

    `value` gives ln L, `sensitivities` its score and information, `trace` all moments of the filter.  Raises
    ValueError for an unknown `initial`, unknown diffuse states and parameters without a value, RatesFault
    where rates are not finite or too fast for any step.
    """

    model: Model
    timeline: Timeline
    initial: str | Gaussian = "prior"
    diffuse_states: tuple[str, ...] = ()
    rate_step: float | None = None
    fastest: float | None = None

    def __post_init__(self) -> None:
        unknown = sorted(set(self.diffuse_states) - set(self.model.states))
        if unknown:
            raise ValueError(f"diffuse_states: unknown {unknown}; the model has {list(self.model.states)}")
        if not isinstance(self.initial, Gaussian) and self.initial not in INITIAL:
            raise ValueError(f"initial: expected one of {INITIAL} or a Gaussian, found {self.initial!r}")

    __getstate__ = fields_alone

    @property
    def _diffuse(self) -> bool:
        return self.initial == "diffuse"

    @cached_property
    def recursion(self) -> Recursion:
        return recursion_of(self.model, self._diffuse)

    # -- numbers that the compiled loops start from ----------------------------------------------------------
    def theta(self, values: Mapping[str, float]) -> np.ndarray:
        """Parameter values (d,) in the model's order, followed by the record's own numbers."""
        known = [values[p.name] for p in self.model.parameters]
        return np.array([*known, *self.recursion.constants], dtype=float)

    def rate(self, values: Mapping[str, float], inputs: Mapping[str, np.ndarray] | None = None) -> float:
        """Upper bound of the model's fastest rate [1/h] over the record or the given inputs; or `fastest`."""
        if self.fastest is not None:
            return self.fastest
        return max((0.0, *self._bounds(values, inputs)))

    def _bounds(self, values: Mapping[str, float], inputs: Mapping[str, np.ndarray] | None) -> list[float]:
        """Upper bound of the rate of each state [1/h] (n,)."""
        r = self.recursion
        known = r.symbols(values)
        if self._rate_moves:
            corners = self.timeline.corners if inputs is None else inputs
            mean, _ = self.model.initial(values, corners)
            known = r.symbols(values, map(np.asarray, mean), corners)
        places, pairs = self._rate_entries
        try:
            found = r.graph.evaluate([r.jacobian[i][j] for i, j in places], known)
        except KeyError:
            expect_values(self.model.parameters, values)
            raise
        except ZeroDivisionError:  # a parameter at a physical limit, such as a resistance of 0
            return [math.inf] * r.n
        entry = dict(zip(places, found, strict=True))
        bounds = []
        for i in range(r.n):
            total = abs(entry.get((i, i), 0.0))
            for a, b in pairs[i]:
                total = total + np.sqrt(np.abs(entry[a] * entry[b]))
            bounds.append(float(np.max(total)))
        return bounds

    @cached_property
    def _rate_moves(self) -> bool:
        """Whether the rates depend on anything besides the parameters."""
        r = self.recursion
        needed = r.graph.needed([r.graph.lift(r.jacobian[i][j]) for i, j in self._rate_entries[0]])
        symbols = [r.graph.nodes[i][1] for i in needed if r.graph.nodes[i][0] == "symbol"]
        return not all(name.startswith(("p:", "c:")) for name in symbols)

    @cached_property
    def _rate_entries(self) -> tuple[list[Place], list[list[tuple[Place, Place]]]]:
        """Entries of the Jacobian that bound its eigenvalues: diagonal, and non-zero pairs (i, j), (j, i)."""
        r = self.recursion
        there = [[not is_zero(v) for v in row] for row in r.jacobian]
        pairs = [
            [((i, j), (j, i)) for j in range(r.n) if j != i and there[i][j] and there[j][i]]
            for i in range(r.n)
        ]
        places = {(i, i) for i in range(r.n) if there[i][i]}
        places |= {place for row in pairs for pair in row for place in pair}
        return sorted(places), pairs

    def _steps(self, values: Mapping[str, float]) -> SubSteps:
        """Sub-steps of every step; raises RatesFault where rates are not finite or too fast."""
        steps = self.timeline.steps
        limit = self.rate_step or (CONSTANT_RATES if self.recursion.exact else VARYING_RATES).rate_step
        rate = self.rate(values)
        if not math.isfinite(rate):
            raise RatesFault(self._not_finite(values))
        if self.recursion.wide or steps[:, 0].max() * rate <= limit:
            return SubSteps(steps, self._single, (*self._gaps, *self.recursion.cuts(self.timeline)))
        keys = steps.copy()
        parts = np.maximum(np.ceil(steps[:, 0] * (rate / limit) - 1e-9), self._single)
        far = parts > MOST
        long: tuple[int, ...] = ()
        tail_h = TAIL * limit / rate
        if far.any():
            long = tuple(np.flatnonzero(far[self.timeline.key]).tolist())
            if len(long) > GAPS:
                raise RatesFault(self._too_fast(rate, long))
            keys[far, 0], parts[far] = tail_h, TAIL
        keys[:, 0] /= np.maximum(parts, 1)
        return SubSteps(keys, parts.astype(np.int32), tuple(self._gaps), long, tail_h)

    def steps_per_instant(self, values: Mapping[str, float]) -> float:
        """Filter steps of one pass with these values per instant of the record, at least about 1."""
        steps = self._steps(values)
        taken = np.bincount(self.timeline.key, minlength=len(steps.parts)) @ steps.parts
        return float(taken) / len(self.timeline)

    def _not_finite(self, values: Mapping[str, float]) -> str:
        """The states without a finite rate, and the parameters that their rates depend on."""
        if self.fastest is not None:
            return f"fastest: expected a finite rate [1/h], found {self.fastest}"
        r = self.recursion
        lost = [i for i, bound in enumerate(self._bounds(values, None)) if not math.isfinite(bound)]
        rows = [r.graph.lift(r.jacobian[a][b]) for a, b in self._rate_entries[0] if a in lost or b in lost]
        symbols = [r.graph.nodes[k][1] for k in r.graph.needed(rows) if r.graph.nodes[k][0] == "symbol"]
        own = ", ".join(f"{n[2:]} = {values[n[2:]]:.3g}" for n in symbols if n.startswith("p:"))
        return (
            f"expected finite rates, found others of {', '.join(self.model.states[i] for i in lost)}"
            f"{' with ' + own if own else ''}: narrow the bounds of these parameters, or correct the inputs "
            "that the states follow"
        )

    def _too_fast(self, rate: float, long: tuple[int, ...]) -> str:
        t = self.timeline
        hours = np.sort(t.steps[t.key[list(long)], 0])
        return (
            f"expected at most {GAPS} gaps that the model's fastest time constant, "
            f"{duration_text(3600.0 / rate)}, divides into more than {MOST} parts, found {len(long)} (of "
            f"{duration_text(3600.0 * hours[0])} to {duration_text(3600.0 * hours[-1])}, the first until "
            f"{stamp_text(t.origin_s + 3600.0 * t.time[long[0]])}): the readings do not resolve so fast a "
            "model; narrow the bounds of its parameters, or leave out the part that is so fast"
        )

    @cached_property
    def _single(self) -> np.ndarray:
        """One sub-step for every key, none where no time passes."""
        return (self.timeline.steps[:, 0] > 0).astype(np.int32)

    @cached_property
    def _gaps(self) -> dict[int, np.ndarray]:
        return gap_variances(self.model, self.recursion, self.timeline)

    def first_inputs(self) -> dict[str, float]:
        t = self.timeline
        named = {name: float(t.u[1, i]) for i, name in enumerate(t.varying)}
        return named | {name: float(t.steps[t.key[0], 1 + i]) for i, name in enumerate(t.regimes)}

    def first_gaussian(self, values: Mapping[str, float]) -> Gaussian:
        """Moments of the state before the first reading (the finite part, for a diffuse start)."""
        n = len(self.model.states)
        state = np.asarray(self.first_state(values), dtype=float)
        return Gaussian(state[:n], unpack(state[n : n + n * (n + 1) // 2], n), float(self.timeline.time[0]))

    def first_state(self, values: Mapping[str, complex]) -> np.ndarray:
        """Packed moments before the first reading; complex values give complex moments (for derivatives)."""
        if isinstance(self.initial, Gaussian):
            return np.concatenate([self.initial.mean, pack(np.asarray(self.initial.covariance))])
        begun, variance = self.model.initial(values, self.first_inputs())
        if self.initial == "prior":
            n = len(begun)
            places = np.cumsum(np.arange(1, n + 1)) - 1  # of the diagonal in the packed triangle
            packed = np.zeros(n * (n + 1) // 2, dtype=np.result_type(*variance))
            packed[places] = variance
            return np.concatenate([begun, packed])
        mean = np.array(begun)
        covariance = np.diag(np.array(variance))
        if self.initial == "stationary":
            mean, covariance = self._stationary(values, mean)
        if not self._diffuse:
            return np.concatenate([mean, pack(covariance)])
        chosen = self.diffuse_states or self.model.states
        infinite = np.array([float(name in chosen) for name in self.model.states])
        covariance = covariance * np.outer(1.0 - infinite, 1.0 - infinite)
        return np.concatenate([mean * (1.0 - infinite), pack(covariance), pack(np.diag(infinite))])

    def _start(self, values: Mapping[str, float]) -> np.ndarray:
        """The packed moments that a loop starts from and moves."""
        return np.ascontiguousarray(self.first_state(values), dtype=float)

    def _stationary(self, values: Mapping[str, complex], mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Steady state at the first inputs, and the covariance that solves A P + P A' + Q = 0."""
        n = len(mean)
        u = self.first_inputs()
        for _ in range(5):  # a linear model needs one step
            matrix = self.jacobian(values, mean, u)
            rates = np.array(self.model.evaluate(list(mean), u, values).rates)
            mean = mean - np.linalg.solve(matrix, rates)
        noise: np.ndarray = np.array(self.model.noise(values))
        matrix = self.jacobian(values, mean, u)
        if np.linalg.eigvals(matrix).real.max() >= 0:
            raise ValueError(
                "initial: the model has no stationary state; use 'prior', 'diffuse' or a Gaussian"
            )
        eye = np.eye(n)
        flat = np.linalg.solve(np.kron(matrix, eye) + np.kron(eye, matrix), -noise.reshape(-1))
        return mean, flat.reshape(n, n)

    def jacobian(self, values: Mapping[str, complex], mean: np.ndarray, u: Mapping[str, float]) -> np.ndarray:
        """Derivatives (n, n) [1/h] of the states' rates by the states, at `mean` (n,) and inputs `u`."""
        r = self.recursion
        known = r.symbols(values, mean, u)
        return np.array([r.graph.evaluate(row, known) for row in r.jacobian])

    def _first_state_slopes(self, values: Mapping[str, float]) -> np.ndarray:
        """Derivatives (d, w) of the first moments, by complex steps (exact to rounding)."""
        width = len(self.first_state(values))
        result = np.zeros((len(self.model.parameters), width))
        if isinstance(self.initial, Gaussian):
            return result
        for i, p in enumerate(self.model.parameters):
            moved = {**values, p.name: values[p.name] + 1e-30j}
            result[i] = np.imag(self.first_state(moved)) * 1e30
        return result

    def _common(
        self, values: Mapping[str, float], steps: SubSteps, state: np.ndarray, part: slice
    ) -> tuple[np.ndarray | int, ...]:
        """Arguments that all compiled loops share, in their order (`filter_codegen.COMMON`)."""
        t = self.timeline
        key, keys, parts = t.key[part], steps.keys, steps.parts
        if len(key) < len(keys):
            # where every step has its own length, a table of all would fill the memory
            used, place = np.unique(key, return_inverse=True)
            key, keys, parts = place.astype(key.dtype), keys[used], parts[used]
        table = np.empty(max(1, len(keys) * len(self.recursion.key_nodes)))
        return (
            len(key), len(keys), self.theta(values), keys, parts, table, key, self._inputs(steps, part),
            t.y[part], t.reset[part], state, state.copy(),
        )  # fmt: skip

    def _inputs(self, steps: SubSteps, part: slice) -> np.ndarray:
        """Inputs of these instants as a view; the compiled loop also reads the row in front of them.

        Where a long step leads to the first instant, that row holds the inputs at the start of its tail.
        """
        t = self.timeline
        if part.start not in steps.long:
            return t.u[1:][part]
        rows = t.u[part.start : part.stop + 1].copy()
        tail = self._long(steps, part.start).tail
        rows[0] = [tail[name] for name in t.varying]
        return rows[1:]

    @property
    def _whole(self) -> slice:
        return slice(0, len(self.timeline))

    def _widened(self, k: int, state: np.ndarray) -> np.ndarray:
        """The state in front of instant k, with the variance that the end of a gap adds."""
        if k in self._gaps:
            n = len(self._gaps[k])
            state = state.copy()
            state[n - 1 + np.cumsum(np.arange(1, n + 1))] += self._gaps[k]
        return state

    def _enter(
        self, values: Mapping[str, float], steps: SubSteps, part: slice, state: np.ndarray
    ) -> np.ndarray | None:
        """Move a state to where the loops take over a piece, behind the end of a gap and the jump of a long
        step that it may begin with; returns the transition of the long step."""
        state[:] = self._widened(part.start, state)
        return self._long(steps, part.start).take(values, state) if part.start in steps.long else None

    def _long(self, steps: SubSteps, k: int) -> LongStep:
        return long_step(self.model, self.recursion, self.timeline, steps, k)

    @cached_property
    def _store(self) -> np.ndarray:
        """Moments for the backward pass, kept between calls: allocation costs more than the filter."""
        r = self.recursion
        return np.empty((2 * len(self.timeline), len(r.state)))

    @staticmethod
    def _loglik(out: np.ndarray) -> float:
        return -0.5 * float(out[0] + out[1] + out[2] * math.log(2.0 * math.pi))

    # -- verbs -----------------------------------------------------------------------------------------------
    def value(self, values: Mapping[str, float]) -> float:
        """ln L; −inf where the filter breaks down (a variance that is not positive)."""
        state = self._start(values)
        steps = self._steps(values)
        value = sum(self._run(values, steps, part, state) for part in steps.pieces(self._whole))
        return value if math.isfinite(value) else -math.inf

    def _run(self, values: Mapping[str, float], steps: SubSteps, part: slice, state: np.ndarray) -> float:
        """ln L of a piece; moves `state` through it."""
        self._enter(values, steps, part, state)
        out = np.zeros(3)
        filter_loop(self.recursion, "value")("value", *self._common(values, steps, state, part), out)
        return self._loglik(out)

    def controlled(
        self, values: Mapping[str, float], controls: Mapping[Control, tuple[float, float]], idle: np.ndarray
    ) -> np.ndarray:
        """Positions (T, c) of controls in the step to each instant, in a free run that they drive themselves.

        `controls` maps each control to its two levels; `idle` (T,) is True at standstill.  Of the inputs that
        the controls set, only the values at the instant before the first are used.
        """
        n, count = len(self.model.states), len(self.timeline)
        state = self._start(values)
        state[n:] = 0.0
        found = np.zeros((count, len(controls)))
        levels, still = np.array(list(controls.values()), dtype=float), np.asarray(idle, dtype=float)
        columns = [self.timeline.varying.index(control.input) for control in controls]
        # the loop writes the positions into the inputs, so it gets a copy
        own = replace(self, timeline=replace(self.timeline, u=self.timeline.u.copy()))
        vars(own)["recursion"] = traced(self.model, self._diffuse)  # controllers act in straight-line code
        code = filter_loop(own.recursion, "controlled", False, tuple(controls))
        steps = own._steps(values)
        for part in own._parts(steps):
            if part.start in steps.long:
                own.timeline.u[part.start + 1, columns] = own.timeline.u[part.start, columns]
            own._enter(values, steps, part, state)
            common = own._common(values, steps, state, part)
            code("controlled", *common, still[part], levels, found[part])
            own.timeline.u[part.stop, columns] = found[part.stop - 1]
        return found

    def score(self, values: Mapping[str, float]) -> tuple[float, np.ndarray]:
        """ln L and its exact derivatives (d,) with respect to all parameters, by one backward pass."""
        state = self._start(values)
        steps = self._steps(values)
        pieces = steps.pieces(self._whole)
        states = [state]
        for part in pieces[:-1]:
            state = state.copy()
            self._run(values, steps, part, state)
            states.append(state)
        loglik, theta_bar, state_bar = 0.0, np.zeros(len(self.recursion.p)), np.zeros(len(state))
        for part, state in zip(reversed(pieces), reversed(states), strict=True):
            entered = state.copy()
            self._enter(values, steps, part, entered)
            share, slopes = self._pulled_back(values, steps, part, entered, state_bar)
            loglik, theta_bar = loglik + share, theta_bar + slopes
            if part.start in steps.long:
                before = self._widened(part.start, state)
                state_bar, slopes = self._long(steps, part.start).adjoints(values, before, state_bar)
                theta_bar = theta_bar + slopes
        return loglik, theta_bar + self._first_state_slopes(values) @ state_bar

    def _pulled_back(
        self,
        values: Mapping[str, float],
        steps: SubSteps,
        part: slice,
        state: np.ndarray,
        state_bar: np.ndarray,
    ) -> tuple[float, np.ndarray]:
        """ln L of a piece and its derivatives (d,); moves `state_bar` back through it, in place."""
        r = self.recursion
        width = len(state)
        out, theta_bar = np.zeros(3), np.zeros(len(r.p))
        store = self._store
        key_bar = np.zeros(max(1, len(steps.keys) * len(r.key_nodes)))
        buffer = np.empty((max(int(steps.parts.max(initial=1)), len(r.updates)) + 1, width))
        common = self._common(values, steps, state, part)
        filter_loop(r, "adjoint")("adjoint", *common, out, store, key_bar, theta_bar, state_bar, buffer)
        return self._loglik(out), theta_bar

    # where the filter breaks down and the value is −∞, these sums are not finite either
    @np.errstate(invalid="ignore")
    def sensitivities(
        self, values: Mapping[str, float], directions: np.ndarray, each: bool = False
    ) -> Sensitivities:
        """Score and expected information along directions (d, r) of the parameters.

            I = Σ_k w_k ∂e_k ∂e_k'/S_k + ½ ∂S_k ∂S_k'/S_k²
        with w_k = min(1, b² S_k/e_k²), the weight ρ'(e_k²/S_k) of a reading beyond the model's bound b.
        """
        count = directions.shape[1]
        blocks = self._tangent_start(values, directions)
        score, information, loglik = np.zeros(count), np.zeros((count, count)), 0.0
        scores = np.zeros((len(self.timeline) if each else 0, count))
        steps = self._steps(values)
        for part in self._chunks:
            e, s, de, ds, value = self._tangent_part(values, steps, part, blocks, gain=True)
            by_instant, added = summed(e, s, de, ds, self.recursion.square)
            loglik += value
            score += by_instant.sum(axis=0)[:count]
            if each:
                scores[part] = by_instant[:, :count]
            information += added[:count, :count]
        return Sensitivities(loglik, score, information, scores)

    def _tangent_start(self, values: Mapping[str, float], directions: np.ndarray) -> Blocks:
        count = directions.shape[1]
        blocks = range(0, max(count, 1), LANES)
        padded = np.zeros((directions.shape[0], len(blocks) * LANES))
        padded[:, :count] = directions
        first = self._start(values)
        slopes = self._first_state_slopes(values).T @ padded
        states = [first.copy() for _ in blocks]
        dots = [np.ascontiguousarray(slopes[:, b : b + LANES]) for b in blocks]
        seeds = [np.ascontiguousarray(padded[:, b : b + LANES]) for b in blocks]
        return states, dots, seeds

    def slopes(self, values: Mapping[str, float], directions: np.ndarray) -> np.ndarray:
        """Slopes (T, k, r) of the innovations along directions (d, r) of the parameters."""
        return self._along(values, directions, True)[1]

    def residuals(self, values: Mapping[str, float], directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Free-run residuals (T, k), NaN without reading, and slopes (T, k, r) along directions (d, r)."""
        e, de = self._along(values, directions, False)
        return np.where(np.isfinite(self.timeline.y), e, np.nan), de

    def _along(
        self, values: Mapping[str, float], directions: np.ndarray, gain: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Innovations (T, k) and their slopes (T, k, r) along directions (d, r)."""
        blocks, steps = self._tangent_start(values, directions), self._steps(values)
        found = [self._tangent_part(values, steps, part, blocks, gain) for part in self._chunks]
        e, _, de, _, _ = zip(*found, strict=True)
        slopes = np.concatenate(list(np.concatenate(de, axis=1)), axis=-1)
        return np.concatenate(e), slopes[..., : directions.shape[1]]

    def _parts(self, steps: SubSteps) -> Iterator[slice]:
        """The pieces of a run, a chunk at a time."""
        return (piece for chunk in self._chunks for piece in steps.pieces(chunk))

    @property
    def _chunks(self) -> list[slice]:
        count = len(self.timeline)
        return [slice(first, min(first + CHUNK, count)) for first in range(0, max(count, 1), CHUNK)]

    def _tangent_part(
        self,
        values: Mapping[str, float],
        steps: SubSteps,
        part: slice,
        blocks: Blocks,
        gain: bool,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """Innovations, variances (t, k), derivatives of both (blocks, t, k, `LANES`), ln L of instants."""
        r = self.recursion
        count, outputs = part.stop - part.start, len(r.updates)
        de, ds = np.zeros((2, len(blocks[0]), count, outputs, LANES))
        for block, (state, dot, seed) in enumerate(zip(*blocks, strict=True)):
            e, s, loglik = np.zeros((count, outputs)), np.ones((count, outputs)), 0.0
            key_dot = np.empty(max(1, min(len(steps.keys), count) * len(r.key_nodes)) * LANES)
            for piece in steps.pieces(part):
                if piece.start in steps.long:
                    before = self._widened(piece.start, state)
                    dot[:] = self._long(steps, piece.start).tangents(values, before, dot, seed)
                self._enter(values, steps, piece, state)
                own = slice(piece.start - part.start, piece.stop - part.start)
                out, common = np.zeros(3), self._common(values, steps, state, piece)
                rows = (e[own], s[own], de[block, own], ds[block, own])
                filter_loop(r, "tangent", gain)("tangent", *common, out, seed, dot, key_dot, *rows)
                loglik += self._loglik(out)
        return e, s, de, ds, loglik

    def trace(self, values: Mapping[str, float], gain: bool = True, start: Gaussian | None = None) -> Trace:
        """Run the filter and keep all moments; without `gain`, readings enter ln L but do not correct the
        state.

        `start` is a Gaussian at the instant before the timeline's first (a checkpoint).
        """
        r = self.recursion
        n, outputs = r.n, len(r.updates)
        first = None if start is None else np.concatenate([start.mean, pack(start.covariance)])
        state = self._start(values) if first is None else first
        rows = np.empty((len(self.timeline), trace_width(n, outputs, self._diffuse)))
        width = len(state)
        q = n * (n + 1) // 2
        steps, loglik = self._steps(values), 0.0
        for part in self._parts(steps):
            through = self._enter(values, steps, part, state)
            out, common = np.zeros(3), self._common(values, steps, state, part)
            filter_loop(r, "trace", gain)("trace", *common, out, rows[part])
            loglik += self._loglik(out)
            if through is not None:
                transition = rows[part.start, 2 * width + 2 * outputs :]
                transition[:] = (transition.reshape(n, n) @ through).ravel()
        before, after = rows[:, :width], rows[:, width + 2 * outputs : 2 * width + 2 * outputs]
        return Trace(
            prior_mean=before[:, :n],
            prior_covariance=unpack(before[:, n : n + q], n),
            prediction=rows[:, width : width + 2 * outputs : 2],
            variance=rows[:, width + 1 : width + 2 * outputs : 2],
            mean=after[:, :n],
            covariance=unpack(after[:, n : n + q], n),
            transition=rows[:, 2 * width + 2 * outputs :].reshape(-1, n, n),
            loglik=loglik,
            last=Gaussian(state[:n].copy(), unpack(state[n : n + q], n), float(self.timeline.time[-1])),
        )
