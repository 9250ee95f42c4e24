"""Log-likelihood of the innovations, its score, its sensitivities: pure functions of the parameters.

    ln L(θ) = −½ Σ_k (ln 2πS_k + ρ(e_k²/S_k)),    e_k the innovation of reading k, S_k its variance,

with ρ(q) = q, or, in a model with a bound b, b² (1 + ln(q/b²)) where q > b² (`traced_filter.Recursion`).

Shapes: T instants, n states, k outputs, d parameters (all of the model, in its order).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hygrokf.data.timestamps import duration_text, stamp_text
from hygrokf.engine.discretisation import RATE_STEP, doublings
from hygrokf.engine.filter_loops import Control, filter_loop
from hygrokf.engine.information import summed
from hygrokf.engine.llvm_writer import LANES
from hygrokf.engine.long_steps import MOST, TAIL, LongStep, SubSteps, gap_variances, long_step
from hygrokf.engine.packing import pack, trace_width, unpack
from hygrokf.engine.rates import rate_bound, sizes
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Place, Recursion, traced
from hygrokf.engine.wide_recursion import recursion_of
from hygrokf.estimation.gaussian import Gaussian as Gaussian
from hygrokf.estimation.gaussian import expect_initial
from hygrokf.estimation.moments import End as End
from hygrokf.estimation.moments import Sensitivities as Sensitivities
from hygrokf.estimation.moments import Trace as Trace
from hygrokf.estimation.moments import checked_loglik, covariances, loglik_of
from hygrokf.estimation.start import Moments, law, law_with_slopes, packed, packed_slopes
from hygrokf.physics.model import Model, fields_alone, fields_by_line
from hygrokf.physics.parameters import Parameter, expect_values

CHUNK = 4096
"""Number of instants for which sensitivities are held in memory at a time."""
FASTEST = 2.0**1000
"""[1] product of a rate and a step beyond which a rate counts as infinite."""
GAPS = 1_000
"""Largest number of long steps in one run; more mean a rate far above what the readings resolve."""

Blocks = tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]
"""First moments, their tangents, and the directions: one array each for every `LANES` directions."""


class RatesFault(FloatingPointError, ValueError):
    """Rates that no step can represent; the message names the state or the steps, and the remedy."""


@dataclass(frozen=True)
class Likelihood:
    """The likelihood of the innovations of one model on one timeline.

    model, timeline: n states, d parameters; T instants [h] with readings (T, k), NaN where one is missing.
    initial, diffuse_states: "prior" (each mechanism's own), "stationary" (steady state at the first inputs),
        "diffuse" (exact; of these states nothing is known at the first instant, others keep their prior; by
        default of no state at the first reading), or a `Gaussian`.
    rate_step: [1] largest product of the fastest rate and a sub-step, in place of the discretisation's own: a
        search may take longer sub-steps at the expense of the last digits.
    fastest: [1/h] the model's fastest rate, in place of the bound from all inputs of the run.
    square_root: covariances as factors (`engine.square_root`), slower.  A run whose covariances lose their
        digits without, or their sign, is repeated with them by itself.

    `value` gives ln L, `sensitivities` its score and information, `trace` all moments of the filter.  Raises
    ValueError for an unknown `initial`, unknown diffuse states and parameters without a value, RatesFault
    where rates are not finite or too fast for any step, DigitsFault where covariances have no digits left.
    """

    model: Model
    timeline: Timeline
    initial: str | Gaussian = "prior"
    diffuse_states: tuple[str, ...] = ()
    rate_step: float | None = None
    fastest: float | None = None
    square_root: bool = False

    def __post_init__(self) -> None:
        expect_initial(self.model, self.initial, self.diffuse_states)

    __getstate__ = fields_alone
    __repr__ = fields_by_line

    @cached_property
    def recursion(self) -> Recursion:
        return recursion_of(self.model, len(self._unknown), self.square_root)

    @cached_property
    def _unknown(self) -> list[int]:
        """Places of the states of which nothing is known at the start."""
        if self.initial != "diffuse":
            return []
        chosen = self.diffuse_states or self.model.states
        return [i for i, name in enumerate(self.model.states) if name in chosen]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.model.parameters

    # -- numbers that the compiled loops start from ----------------------------------------------------------
    def theta(self, values: Mapping[str, float]) -> np.ndarray:
        """Parameter values (d,) in the model's order, followed by the record's own numbers."""
        known = [values[p.name] for p in self.model.parameters]
        theta = np.array([*known, *self.recursion.constants], dtype=float)
        found, r = self.recursion.variances, self.recursion
        found.check(theta, r.symbols(values, (), self.timeline.whole) if found.doubtful else {})
        return theta

    def rate(self, values: Mapping[str, float], inputs: Mapping[str, np.ndarray] | None = None) -> float:
        """Upper bound of the model's fastest rate [1/h] over the record or the given inputs; or `fastest`."""
        if self.fastest is not None:
            return self.fastest
        corners = self.timeline.corners if inputs is None else inputs
        return rate_bound(self.recursion, self._sizes(values, corners))

    def _sizes(self, values: Mapping[str, float], corners: Mapping[str, np.ndarray]) -> dict[Place, float]:
        try:
            return sizes(self.recursion, values, corners)
        except KeyError:
            expect_values(self.model.parameters, values)
            raise

    def _steps(self, values: Mapping[str, float]) -> SubSteps:
        """Doublings or sub-steps of every step; raises RatesFault where rates are not finite or too fast."""
        steps = self.timeline.steps
        rate = self.rate(values)
        if not rate * float(steps[:, 0].max()) < FASTEST:
            raise RatesFault(self._not_finite(values))
        cuts = (*self._gaps, *self.recursion.cuts(self.timeline))
        if self.recursion.wide:
            return SubSteps(steps, self._single, cuts)
        if self.recursion.exact:
            return SubSteps(steps, doublings(steps[:, 0] * rate).astype(np.int32), cuts)
        limit = self.rate_step or RATE_STEP
        if steps[:, 0].max() * rate <= limit:
            return SubSteps(steps, self._single, cuts)
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
        if self.recursion.exact:
            return 1.0
        steps = self._steps(values)
        taken = np.bincount(self.timeline.key, minlength=len(steps.parts)) @ steps.parts
        return float(taken) / len(self.timeline)

    def _not_finite(self, values: Mapping[str, float]) -> str:
        """The states without a finite rate, and the parameters that their rates depend on."""
        if self.fastest is not None:
            return f"fastest: expected a finite rate [1/h], found {self.fastest}"
        r = self.recursion
        found = self._sizes(values, self.timeline.corners)
        lost = sorted({i for (i, _), size in found.items() if not math.isfinite(size)})
        rows = [r.graph.lift(r.jacobian[a][b]) for a, b in r.rate_entries if a in lost]
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
        state, r = self.first_state(values), self.recursion
        return Gaussian(state[: r.n], r.covariance_of(state), float(self.timeline.time[0]))

    def first_state(self, values: Mapping[str, float]) -> np.ndarray:
        """Packed moments (w,) before the first reading."""
        expect_values(self.model.parameters, values)
        if isinstance(self.initial, Gaussian):
            first = Moments(np.asarray(self.initial.mean), np.asarray(self.initial.covariance))
        else:
            first = law(self.initial, self.model, self.recursion, values, self.first_inputs())
        return packed(self.recursion, first, self._unknown, bool(self.diffuse_states))

    def _first_with_slopes(self, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """The packed moments before the first reading, and their derivatives (d, w)."""
        expect_values(self.model.parameters, values)
        if isinstance(self.initial, Gaussian):
            state = self.first_state(values)
            return state, np.zeros((len(self.model.parameters), len(state)))
        r, begun = self.recursion, bool(self.diffuse_states)
        first, slopes = law_with_slopes(self.initial, self.model, r, values, self.first_inputs())
        return packed(r, first, self._unknown, begun), packed_slopes(r, first, slopes, self._unknown)

    def jacobian(self, values: Mapping[str, float], mean: np.ndarray, u: Mapping[str, float]) -> np.ndarray:
        """Derivatives (n, n) [1/h] of the states' rates by the states, at `mean` (n,) and inputs `u`."""
        r = self.recursion
        known = r.symbols(values, mean, u)
        return np.array([r.graph.evaluate(row, known) for row in r.jacobian])

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
        if k not in self._gaps:
            return state
        return self.recursion.put(state, self.recursion.covariance_of(state) + np.diag(self._gaps[k]))

    def _widening(self, k: int, state: np.ndarray) -> np.ndarray:
        """Derivatives (w, w) of the state in front of instant k by that before; rows of the latter."""
        eye = np.eye(len(state))
        if k not in self._gaps or not self.square_root:
            return eye
        return np.imag(self._widened(k, state + 1e-30j * eye)) * 1e30

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

    def _loglik(self, sums: Sequence[np.ndarray]) -> float:
        """ln L of the pieces of a run; NaN asks for a run in factors."""
        return checked_loglik(sums, self.model.outputs, self.square_root)

    @cached_property
    def _in_factors(self) -> Likelihood:
        """The same likelihood, with covariances as factors."""
        return replace(self, square_root=True)

    # -- verbs -----------------------------------------------------------------------------------------------
    def value(self, values: Mapping[str, float]) -> float:
        """ln L; −inf where the filter breaks down (a variance that is not positive)."""
        value = self._through(values, self.first_state(values))
        return self._in_factors.value(values) if math.isnan(value) else value

    def end(self, values: Mapping[str, float]) -> End:
        """ln L and the Gaussian to continue from: those of the `trace`, without what lies between."""
        state = self.first_state(values)
        value, r = self._through(values, state), self.recursion
        if math.isnan(value):
            return self._in_factors.end(values)
        last = Gaussian(state[: r.n].copy(), covariances(r, state), float(self.timeline.time[-1]))
        return End(value, last)

    def _through(self, values: Mapping[str, float], state: np.ndarray) -> float:
        """ln L, NaN where the run has to be repeated in factors; moves `state` through it."""
        steps = self._steps(values)
        return self._loglik([self._run(values, steps, part, state) for part in steps.pieces(self._whole)])

    def _run(
        self, values: Mapping[str, float], steps: SubSteps, part: slice, state: np.ndarray
    ) -> np.ndarray:
        """Sums of a piece; moves `state` through it."""
        self._enter(values, steps, part, state)
        sums = np.zeros(3 + 2 * len(self.model.outputs))
        filter_loop(self.recursion, "value")("value", *self._common(values, steps, state, part), sums)
        return sums

    def controlled(
        self, values: Mapping[str, float], controls: Mapping[Control, tuple[float, float]], idle: np.ndarray
    ) -> np.ndarray:
        """Positions (T, c) of controls in the step to each instant, in a free run that they drive themselves.

        `controls` maps each control to its two levels; `idle` (T,) is True at standstill.  Of the inputs that
        the controls set, only the values at the instant before the first are used.
        """
        n, count = len(self.model.states), len(self.timeline)
        state = self.first_state(values)
        state[n:] = 0.0
        found = np.zeros((count, len(controls)))
        levels, still = np.array(list(controls.values()), dtype=float), np.asarray(idle, dtype=float)
        columns = [self.timeline.varying.index(control.input) for control in controls]
        # the loop writes the positions into the inputs, so it gets a copy
        own = replace(self, timeline=replace(self.timeline, u=self.timeline.u.copy()))
        vars(own)["recursion"] = traced(self.model, len(self._unknown))  # not by matrices
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
        state, first_slopes = self._first_with_slopes(values)
        steps = self._steps(values)
        pieces = steps.pieces(self._whole)
        states = [state]
        for part in pieces[:-1]:
            state = state.copy()
            self._run(values, steps, part, state)
            states.append(state)
        sums, theta_bar, state_bar = [], np.zeros(len(self.recursion.p)), np.zeros(len(state))
        for part, state in zip(reversed(pieces), reversed(states), strict=True):
            entered = state.copy()
            self._enter(values, steps, part, entered)
            share, slopes = self._pulled_back(values, steps, part, entered, state_bar)
            sums.append(share)
            theta_bar = theta_bar + slopes
            if part.start in steps.long:
                before = self._widened(part.start, state)
                state_bar, slopes = self._long(steps, part.start).adjoints(values, before, state_bar)
                theta_bar = theta_bar + slopes
            if part.start in self._gaps:
                state_bar = self._widening(part.start, state) @ state_bar
        loglik = self._loglik(sums)
        if math.isnan(loglik):
            return self._in_factors.score(values)
        return loglik, theta_bar + first_slopes @ state_bar

    def _pulled_back(
        self,
        values: Mapping[str, float],
        steps: SubSteps,
        part: slice,
        state: np.ndarray,
        state_bar: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Sums of a piece, and its derivatives (d,); moves `state_bar` back through it, in place."""
        r = self.recursion
        width = len(state)
        out, theta_bar = np.zeros(3 + 2 * len(self.model.outputs)), np.zeros(len(r.p))
        store = self._store
        key_bar = np.zeros(max(1, len(steps.keys) * len(r.key_nodes)))
        most = int(steps.parts.max(initial=1)) + 1
        held = 0 if r.doubling is None else most * len(r.doubling.now)
        buffer = np.empty(max(most * width, (len(r.updates) + 1) * width, held))
        common = self._common(values, steps, state, part)
        filter_loop(r, "adjoint")("adjoint", *common, out, store, key_bar, theta_bar, state_bar, buffer)
        return out, theta_bar

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
        score, information, sums = np.zeros(count), np.zeros((count, count)), []
        scores = np.zeros((len(self.timeline) if each else 0, count))
        steps = self._steps(values)
        for part in self._chunks:
            e, s, de, ds, found = self._tangent_part(values, steps, part, blocks, gain=True)
            sums.extend(found)
            # few instants may have a reading
            read = np.flatnonzero(np.isfinite(self.timeline.y[part]).any(axis=1))
            de, ds = (np.take(one, read, axis=1) for one in (de, ds))
            by_instant, added = summed(e[read], s[read], de, ds, self.recursion.square)
            score += by_instant.sum(axis=0)[:count]
            if each:
                scores[part.start + read] = by_instant[:, :count]
            information += added[:count, :count]
        loglik = self._loglik(sums)
        if math.isnan(loglik):
            return self._in_factors.sensitivities(values, directions, each)
        return Sensitivities(loglik, score, information, scores)

    def _tangent_start(self, values: Mapping[str, float], directions: np.ndarray) -> Blocks:
        count = directions.shape[1]
        blocks = range(0, max(count, 1), LANES)
        padded = np.zeros((directions.shape[0], len(blocks) * LANES))
        padded[:, :count] = directions
        first, first_slopes = self._first_with_slopes(values)
        slopes = first_slopes.T @ padded
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
        e, _, de, _, sums = zip(*found, strict=True)
        if gain and math.isnan(self._loglik([one for part in sums for one in part])):
            return self._in_factors._along(values, directions, gain)
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
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
        """Innovations, variances (t, k), derivatives of both (blocks, t, k, `LANES`), sums of instants."""
        r = self.recursion
        count, outputs = part.stop - part.start, len(r.updates)
        de, ds = np.zeros((2, len(blocks[0]), count, outputs, LANES))
        for block, (state, dot, seed) in enumerate(zip(*blocks, strict=True)):
            e, s, sums = np.zeros((count, outputs)), np.ones((count, outputs)), []
            key_dot = np.empty(max(1, min(len(steps.keys), count) * len(r.key_nodes)) * LANES)
            for piece in steps.pieces(part):
                if piece.start in self._gaps:
                    dot[:] = self._widening(piece.start, state).T @ dot
                if piece.start in steps.long:
                    before = self._widened(piece.start, state)
                    dot[:] = self._long(steps, piece.start).tangents(values, before, dot, seed)
                self._enter(values, steps, piece, state)
                own = slice(piece.start - part.start, piece.stop - part.start)
                out = np.zeros(3 + 2 * outputs)
                common = self._common(values, steps, state, piece)
                rows = (e[own], s[own], de[block, own], ds[block, own])
                filter_loop(r, "tangent", gain)("tangent", *common, out, seed, dot, key_dot, *rows)
                sums.append(out)
        return e, s, de, ds, sums

    def trace(self, values: Mapping[str, float], gain: bool = True, start: Gaussian | None = None) -> Trace:
        """Run the filter and keep all moments; without `gain`, readings enter ln L but do not correct the
        state.

        `start` is a Gaussian at the instant before the timeline's first (a checkpoint).
        """
        return self._traced(values, gain, start)[0]

    def with_roots(self, values: Mapping[str, float]) -> tuple[Trace, np.ndarray, np.ndarray]:
        """The trace; W (T, n, n), W W' the covariance after an instant but for what is infinite; and the
        directions (T, n, d) of the state of which nothing is known there."""
        found, r, moments = self._traced(values)
        return found, r.root_of(moments), r.unknown_of(moments)

    def _traced(
        self, values: Mapping[str, float], gain: bool = True, start: Gaussian | None = None
    ) -> tuple[Trace, Recursion, np.ndarray]:
        """The trace, and the moments (T, w) after each instant as the loops of the recursion keep them."""
        if start is not None and self._unknown:
            return replace(self, initial=start)._traced(values, gain)
        r = self.recursion
        n, outputs = r.n, len(r.updates)
        state = self.first_state(values) if start is None else r.packed_moments(start.mean, start.covariance)
        width = len(state)
        rows = np.empty((len(self.timeline), trace_width(width, n, outputs)))
        transition, noise = np.split(rows[:, 2 * width + 2 * outputs :], [n * n], axis=1)
        steps, sums = self._steps(values), []
        for part in self._parts(steps):
            k, entered = part.start, r.put(state, np.zeros((n, n)))
            through = self._enter(values, steps, part, state)
            out, common = np.zeros(3 + 2 * len(self.model.outputs)), self._common(values, steps, state, part)
            filter_loop(r, "trace", gain)("trace", *common, out, rows[part])
            sums.append(out)
            if through is not None or k in self._gaps:
                self._enter(values, steps, part, entered)
                f = transition[k].reshape(n, n)
                noise[k] += pack(f @ r.covariance_of(entered) @ f.T)
                transition[k] = (f if through is None else f @ through).ravel()
        before, after = rows[:, :width], rows[:, width + 2 * outputs : 2 * width + 2 * outputs]
        found = Trace(
            prior_mean=before[:, :n],
            prior_covariance=covariances(r, before),
            prediction=rows[:, width : width + 2 * outputs : 2],
            variance=rows[:, width + 1 : width + 2 * outputs : 2],
            mean=after[:, :n],
            covariance=covariances(r, after),
            transition=transition.reshape(-1, n, n),
            noise=unpack(noise, n),
            loglik=self._loglik(sums) if gain else loglik_of(sums),
            last=Gaussian(state[:n].copy(), covariances(r, state), float(self.timeline.time[-1])),
        )
        if not self.square_root and (math.isnan(found.loglik) or found.lost):
            return self._in_factors._traced(values, gain, start)
        if r.unknown:
            found.variance[np.isnan(found.variance)] = math.inf
        return found, r, after
