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
from itertools import pairwise
from typing import Any

import numpy as np

from hygrokf.data.record import kind_of
from hygrokf.engine.filter_loops import Control, filter_loop
from hygrokf.engine.gaps import gap_variances, widened, widened_slopes
from hygrokf.engine.information import summed
from hygrokf.engine.llvm_writer import LANES
from hygrokf.engine.packing import pack, trace_width, unpack
from hygrokf.engine.schedule import (
    STEP_TOLERANCE,
    Schedule,
    SubSteps,
    Unresolved,
    joined,
    scheduled,
    sub_steps,
    tags,
    whole_steps,
)
from hygrokf.engine.schedule_codegen import table_room
from hygrokf.engine.step_codegen import level_room
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Recursion, traced
from hygrokf.engine.wide_recursion import recursion_of
from hygrokf.estimation.moments import End as End
from hygrokf.estimation.moments import Gaussian as Gaussian
from hygrokf.estimation.moments import Sensitivities as Sensitivities
from hygrokf.estimation.moments import Trace as Trace
from hygrokf.estimation.moments import checked_loglik, covariances, expect_initial, loglik_of
from hygrokf.estimation.rates_fault import diverging_rates, unresolved_rates
from hygrokf.estimation.start import Moments, law, law_with_slopes, packed, packed_slopes
from hygrokf.physics.model import Model, describe_fields, field_values
from hygrokf.physics.parameters import Parameter, expect_values

CHUNK = 4096
"""Number of instants for which sensitivities are held in memory at a time."""

Blocks = tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]
"""First moments, their tangents, and the directions: one array each for every `LANES` directions."""


@dataclass(frozen=True)
class Likelihood:
    """The likelihood of the innovations of one model on one timeline.

    model, timeline: n states, d parameters; T instants [h] with readings (T, k), NaN where one is missing.
    initial, diffuse_states: "prior" (each mechanism's own), "stationary" (steady state at the first inputs),
        "diffuse" (exact: nothing is known of the `diffuse_states` at the first instant, and the others keep
        their prior; by default nothing is known of any state at the first reading), or a `Gaussian`.
    square_root: covariances as factors (`engine.square_root`), slower.  A run whose plain covariances lose
        their digits, or become indefinite, is repeated with factors automatically.
    tolerance: [1] largest error of a sub-step, in standard deviations; a search may take a larger one at the
        expense of the last digits.
    schedule: sub-steps to keep fixed (`scheduled`); by default they are chosen anew for every set of values.

    `value` gives ln L, `sensitivities` its score and information, `trace` all moments of the filter.  Raises
    ValueError for an unknown `initial`, unknown diffuse states, a schedule of other instants and parameters
    without a value, RatesFault where rates are not finite or no sub-step resolves a step, DigitsFault where
    covariances have no digits left.
    """

    model: Model
    timeline: Timeline
    initial: str | Gaussian = "prior"
    diffuse_states: tuple[str, ...] = ()
    square_root: bool = False
    tolerance: float = STEP_TOLERANCE
    schedule: Schedule | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.timeline, Timeline):
            raise ValueError(
                f"timeline: expected a Timeline, found {kind_of(self.timeline)}; timeline(model, …) makes one"
            )
        if not self.tolerance > 0.0:
            raise ValueError(f"tolerance: expected a number above 0, found {self.tolerance}")
        expect_initial(self.model, self.initial, self.diffuse_states)
        if self.schedule is not None and len(self.schedule.offset) != len(self.timeline) + 1:
            raise ValueError(
                f"schedule: expected the sub-steps of {len(self.timeline)} instants, found those of "
                f"{len(self.schedule.offset) - 1}; make one by `scheduled` on this timeline"
            )

    __getstate__ = field_values
    __repr__ = describe_fields

    @cached_property
    def recursion(self) -> Recursion:
        return recursion_of(self.model, len(self._unknown), self.square_root)

    @cached_property
    def _unknown(self) -> list[int]:
        """Indices of the states of which nothing is known at the start."""
        if self.initial != "diffuse":
            return []
        chosen = self.diffuse_states or self.model.states
        return [i for i, name in enumerate(self.model.states) if name in chosen]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.model.parameters

    # -- numbers that the compiled loops start from ----------------------------------------------------------
    def theta(self, values: Mapping[str, float]) -> np.ndarray:
        """Parameter values (d,) in the model's order, followed by the recursion's constants."""
        parameters = [values[p.name] for p in self.model.parameters]
        theta = np.array([*parameters, *self.recursion.constants], dtype=float)
        variances = self.recursion.variances
        variances.check(theta, self.recursion.symbols(values, (), self._inputs) if variances.doubtful else {})
        return theta

    @cached_property
    def _inputs(self) -> dict[str, np.ndarray]:
        """All values of each input over the run."""
        t = self.timeline
        return {name: t.input(name) for name in (*t.varying, *t.regimes)}

    # -- sub-steps -------------------------------------------------------------------------------------------
    def scheduled(self, values: Mapping[str, float]) -> Likelihood:
        """The likelihood with the sub-steps fixed that suit these values; itself where steps are exact."""
        # a copy has its own working memory: another thread may use it
        return self if self.recursion.exact else replace(self._with_schedule(values, True, None))

    def halved(self, values: Mapping[str, float]) -> Likelihood:
        """The likelihood with the sub-steps fixed that suit these values, each divided in two; itself where
        steps are exact."""
        held = self if self.schedule is not None else self.scheduled(values)
        return held if held.schedule is None else replace(held, schedule=held.schedule.halved())

    def steps_per_instant(self, values: Mapping[str, float]) -> float:
        """Filter steps of one pass with these values per instant of the record; 1 where steps are exact."""
        if self.recursion.exact:
            return 1.0
        return max(1.0, len(self._steps(values).row) / len(self.timeline))

    def _steps(
        self, values: Mapping[str, float], gain: bool = True, start: Gaussian | None = None
    ) -> SubSteps:
        """Sub-steps of every step; raises RatesFault where no sub-step resolves the rates of a step."""
        if self.recursion.exact:
            return whole_steps(self.timeline)
        likelihood = self if self.schedule is not None else self._with_schedule(values, gain, start)
        return likelihood._sub_steps

    @cached_property
    def _sub_steps(self) -> SubSteps:
        """The sub-steps of the schedule."""
        assert self.schedule is not None
        return sub_steps(self.timeline, self.schedule)

    def _with_schedule(self, values: Mapping[str, float], gain: bool, start: Gaussian | None) -> Likelihood:
        """The likelihood with the sub-steps chosen along a run; the result of the last run is kept."""
        state, theta = self._start(values, start), self.theta(values)
        run = (theta.tobytes(), state.tobytes(), gain)  # identifies the run of the schedule kept
        if self._latest.get("run") != run:
            schedule = self._schedule_of_run(values, theta, state, gain)
            if schedule is None:
                schedule = self._in_factors._with_schedule(values, gain, start).schedule
            self._latest.update(run=run, held=replace(self, schedule=schedule))
        held: Likelihood = self._latest["held"]
        return held

    @cached_property
    def _latest(self) -> dict[str, Any]:
        """The last run whose sub-steps were chosen: what identifies it, and the likelihood that holds
        them."""
        return {}

    def _schedule_of_run(
        self, values: Mapping[str, float], theta: np.ndarray, state: np.ndarray, gain: bool
    ) -> Schedule | None:
        """Choose the sub-steps along a run from packed moments; None where a covariance becomes
        indefinite."""
        schedules = []
        for part in self._pieces(self._span):
            state[:] = self._widened(part.start, state)
            schedule = scheduled(self.recursion, theta, self.timeline, part, state, self.tolerance, gain)
            if isinstance(schedule, Unresolved):
                if not self.square_root and self._is_indefinite(state):
                    return None
                raise unresolved_rates(self.recursion, self.timeline, values, schedule)
            schedules.append(schedule)
        return joined(schedules)

    def _is_indefinite(self, state: np.ndarray) -> bool:
        """Whether the covariance of packed moments has a negative eigenvalue."""
        covariance = self.recursion.covariance_of(state)
        return bool(np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance).min() < 0.0)

    @cached_property
    def _gaps(self) -> dict[int, np.ndarray]:
        """Variance (n,) that the end of each gap adds, by the instant of the end."""
        return gap_variances(self.model, self.recursion, self.timeline)

    def _pieces(self, part: slice) -> list[slice]:
        """Divide a part of a run into the pieces that the loops take in one call; every end of a gap begins a
        new piece."""
        ends = {*self._gaps, *self.recursion.cuts(self.timeline)}
        inner = sorted(k for k in ends if part.start < k < part.stop)
        return [slice(a, b) for a, b in pairwise([part.start, *inner, part.stop])]

    def _start(self, values: Mapping[str, float], start: Gaussian | None = None) -> np.ndarray:
        """The packed moments from which a loop starts; the loop overwrites them."""
        if start is None:
            return self.first_state(values)
        return self.recursion.packed_moments(start.mean, start.covariance)

    def first_inputs(self) -> dict[str, float]:
        """The inputs at the first instant, by name."""
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
            first = law(self.initial, self.model, values, self.first_inputs())
        return packed(self.recursion, first, self._unknown, bool(self.diffuse_states))

    def _first_with_derivatives(self, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """The packed moments before the first reading, and their derivatives (d, w)."""
        expect_values(self.model.parameters, values)
        if isinstance(self.initial, Gaussian):
            state = self.first_state(values)
            return state, np.zeros((len(self.model.parameters), len(state)))
        r, begun = self.recursion, bool(self.diffuse_states)
        first, slopes = law_with_slopes(self.initial, self.model, values, self.first_inputs())
        return packed(r, first, self._unknown, begun), packed_slopes(r, first, slopes, self._unknown)

    def jacobian(self, values: Mapping[str, float], mean: np.ndarray, u: Mapping[str, float]) -> np.ndarray:
        """Derivatives (n, n) [1/h] of the states' rates by the states, at `mean` (n,) and inputs `u`."""
        r = self.recursion
        symbols = r.symbols(values, mean, u)
        return np.array([r.graph.evaluate(row, symbols) for row in r.jacobian])

    def _loop(
        self,
        kind: str,
        values: Mapping[str, float],
        steps: SubSteps,
        state: np.ndarray,
        part: slice,
        *further: np.ndarray,
        gain: bool = True,
        controls: tuple[Control, ...] = (),
    ) -> None:
        """Run a compiled loop over a piece of the run, with `further` arguments of its kind; overwrites
        `state` with the moments at the end."""
        t, steps = self.timeline, steps.of(part)
        table = np.empty(
            max(table_room(self.recursion, kind), len(steps.keys) * len(self.recursion.key_nodes))
        )
        filter_loop(self.recursion, kind, gain, controls)(
            kind, len(steps.key), len(steps.keys), self.theta(values), steps.keys, steps.times, table,
            steps.key, steps.offset, steps.row, steps.within, t.u[1:][part], t.y[part], t.reset[part], state,
            state.copy(), *further,
        )  # fmt: skip
        if steps.times.min(initial=0) < 0:
            raise diverging_rates(self.recursion, self.timeline, values)

    @property
    def _span(self) -> slice:
        """All instants."""
        return slice(0, len(self.timeline))

    def _widened(self, k: int, state: np.ndarray) -> np.ndarray:
        """Packed moments (w,) before instant k: `state`, with the variance that the end of a gap adds
        there."""
        return widened(self.recursion, state, self._gaps[k]) if k in self._gaps else state

    def _gap_jacobian(self, k: int, state: np.ndarray) -> np.ndarray:
        """Transposed Jacobian (w, w) of the packed moments after gap k: row i = ∂`_widened`/∂state[i]."""
        return widened_slopes(self.recursion, state, self._gaps[k])

    @cached_property
    def _store(self) -> np.ndarray:
        """Moments for the backward pass, kept between calls: allocation costs more than the filter."""
        r = self.recursion
        return np.empty((2 * len(self.timeline), len(r.state)))

    def _loglik(self, sums: Sequence[np.ndarray]) -> float:
        """ln L from the sums of a run's pieces; NaN where the run must be repeated with factors."""
        return checked_loglik(sums, self.model.outputs, self.square_root)

    @cached_property
    def _in_factors(self) -> Likelihood:
        """The same likelihood, with covariances as factors."""
        return replace(self, square_root=True)

    # -- verbs -----------------------------------------------------------------------------------------------
    def value(self, values: Mapping[str, float]) -> float:
        """ln L; −inf where the filter breaks down (a variance that is not positive)."""
        value = self._loglik_of_run(values, self.first_state(values))
        return self._in_factors.value(values) if math.isnan(value) else value

    def end(self, values: Mapping[str, float]) -> End:
        """ln L and the Gaussian to continue from, as in `trace`, without the moments at each instant."""
        state = self.first_state(values)
        value, r = self._loglik_of_run(values, state), self.recursion
        if math.isnan(value):
            return self._in_factors.end(values)
        last = Gaussian(state[: r.n].copy(), covariances(r, state), float(self.timeline.time[-1]))
        return End(value, last)

    def _loglik_of_run(self, values: Mapping[str, float], state: np.ndarray) -> float:
        """Filter the whole run; returns ln L, NaN where the run must be repeated with factors, and moves
        `state` to its end."""
        steps = self._steps(values)
        return self._loglik([self._run(values, steps, part, state) for part in self._pieces(self._span)])

    def _run(
        self, values: Mapping[str, float], steps: SubSteps, part: slice, state: np.ndarray
    ) -> np.ndarray:
        """Filter a piece of a run; returns its sums, and moves `state` to its end."""
        state[:], sums = self._widened(part.start, state), self._sums()
        self._loop("value", values, steps, state, part, sums)
        return sums

    def _sums(self) -> np.ndarray:
        """Zeros for the sums of a piece of a run, which the loop writes (`information.RunningSums.write`)."""
        return np.zeros(3 + 2 * len(self.model.outputs))

    def controlled(
        self, values: Mapping[str, float], controls: Mapping[Control, tuple[float, float]], idle: np.ndarray
    ) -> np.ndarray:
        """Positions (T, c) of controls in the step to each instant, in a free run that the controls drive.

        `controls` maps each control to its two levels; `idle` (T,) is True at standstill.  Of the
        inputs that the controls set, the timeline gives only the values at the instant before the first.
        """
        n, count = len(self.model.states), len(self.timeline)
        state = self.first_state(values)
        state[n:] = 0.0
        positions = np.zeros((count, len(controls)))
        levels, standstill = np.array(list(controls.values()), dtype=float), np.asarray(idle, dtype=float)
        columns = [self.timeline.varying.index(control.input) for control in controls]
        # the loop writes the positions into the inputs, so it gets a copy
        copied = replace(self, timeline=replace(self.timeline, u=self.timeline.u.copy()))
        vars(copied)["recursion"] = traced(
            self.model, len(self._unknown)
        )  # this loop exists without matrices only
        steps = whole_steps(self.timeline)
        for part in self._parts():
            state[:] = self._widened(part.start, state)
            arguments = standstill[part], levels, positions[part], tags(), np.array([self.tolerance])
            copied._loop(
                "controlled", values, steps, state, part, *arguments, gain=False, controls=tuple(controls)
            )
            copied.timeline.u[part.stop, columns] = positions[part.stop - 1]
        return positions

    def score(self, values: Mapping[str, float]) -> tuple[float, np.ndarray]:
        """ln L and its exact derivatives (d,) with respect to all parameters, by one backward pass."""
        state, first_slopes = self._first_with_derivatives(values)
        steps = self._steps(values)
        pieces = self._pieces(self._span)
        states = [state]
        for part in pieces[:-1]:
            state = state.copy()
            self._run(values, steps, part, state)
            states.append(state)
        sums: list[np.ndarray] = []
        r, theta_bar, state_bar = self.recursion, np.zeros(len(self.recursion.p)), np.zeros(len(state))
        keys = max(1, len(steps.keys) * len(r.key_nodes))
        rows = max(int(np.diff(steps.offset).max(initial=1)), len(r.updates)) + 1
        buffer, levels = np.empty((rows, len(state))), np.empty(level_room(r))
        for part, state in zip(reversed(pieces), reversed(states), strict=True):
            entered = self._widened(part.start, state).copy()
            part_bar = np.zeros_like(theta_bar)
            sums.append(self._sums())
            self._loop(
                "adjoint", values, steps, entered, part, sums[-1], self._store, np.zeros(keys), part_bar,
                state_bar, buffer, levels,
            )  # fmt: skip
            theta_bar = theta_bar + part_bar
            if part.start in self._gaps:
                state_bar = self._gap_jacobian(part.start, state) @ state_bar
        loglik = self._loglik(sums)
        if math.isnan(loglik):
            return self._in_factors.score(values)
        return loglik, theta_bar + first_slopes @ state_bar

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
            e, s, de, ds, part_sums = self._tangent_part(values, steps, part, blocks, gain=True)
            sums.extend(part_sums)
            # only the instants with a reading contribute
            rows = np.flatnonzero(np.isfinite(self.timeline.y[part]).any(axis=1))
            de, ds = (np.take(array, rows, axis=1) for array in (de, ds))
            by_instant, added = summed(e[rows], s[rows], de, ds, self.recursion.square)
            score += by_instant.sum(axis=0)[:count]
            if each:
                scores[part.start + rows] = by_instant[:, :count]
            information += added[:count, :count]
        loglik = self._loglik(sums)
        if math.isnan(loglik):
            return self._in_factors.sensitivities(values, directions, each)
        return Sensitivities(loglik, score, information, scores)

    def _tangent_start(self, values: Mapping[str, float], directions: np.ndarray) -> Blocks:
        """The first moments with their derivatives along directions (d, r), in blocks of `LANES` directions;
        the last block is filled with zeros."""
        count = directions.shape[1]
        blocks = range(0, max(count, 1), LANES)
        padded = np.zeros((directions.shape[0], len(blocks) * LANES))
        padded[:, :count] = directions
        first, first_slopes = self._first_with_derivatives(values)
        slopes = first_slopes.T @ padded
        states = [first.copy() for _ in blocks]
        dots = [np.ascontiguousarray(slopes[:, b : b + LANES]) for b in blocks]
        seeds = [np.ascontiguousarray(padded[:, b : b + LANES]) for b in blocks]
        return states, dots, seeds

    def slopes(self, values: Mapping[str, float], directions: np.ndarray) -> np.ndarray:
        """Derivatives (T, k, r) of the innovations along directions (d, r) of the parameters."""
        return self._tangents(values, directions, True)[1]

    def residuals(self, values: Mapping[str, float], directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Free-run residuals (T, k), NaN without reading; derivatives (T, k, r) along directions (d, r)."""
        e, de = self._tangents(values, directions, False)
        return np.where(np.isfinite(self.timeline.y), e, np.nan), de

    def _tangents(
        self, values: Mapping[str, float], directions: np.ndarray, gain: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Innovations (T, k) and their derivatives (T, k, r) along directions (d, r)."""
        blocks, steps = self._tangent_start(values, directions), self._steps(values, gain)
        parts = [self._tangent_part(values, steps, part, blocks, gain) for part in self._chunks]
        e, _, de, _, sums = zip(*parts, strict=True)
        if gain and math.isnan(self._loglik([piece_sums for part in sums for piece_sums in part])):
            return self._in_factors._tangents(values, directions, gain)
        slopes = np.concatenate(list(np.concatenate(de, axis=1)), axis=-1)
        return np.concatenate(e), slopes[..., : directions.shape[1]]

    def _parts(self) -> Iterator[slice]:
        """The pieces of all chunks of the run, in order."""
        return (piece for chunk in self._chunks for piece in self._pieces(chunk))

    @property
    def _chunks(self) -> list[slice]:
        """The run in parts of `CHUNK` instants."""
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
        """Innovations and their variances (t, k), the derivatives (blocks, t, k, `LANES`) of both, and the
        sums of every piece."""
        r = self.recursion
        count, outputs = part.stop - part.start, len(r.updates)
        de, ds = np.zeros((2, len(blocks[0]), count, outputs, LANES))
        for block, (state, dot, seed) in enumerate(zip(*blocks, strict=True)):
            e, s, sums = np.zeros((count, outputs)), np.ones((count, outputs)), []
            key_dot = np.empty(max(1, len(steps.keys) * len(r.key_nodes)) * LANES)
            for piece in self._pieces(part):
                if piece.start in self._gaps:
                    dot[:] = self._gap_jacobian(piece.start, state).T @ dot
                state[:] = self._widened(piece.start, state)
                rows, totals = slice(piece.start - part.start, piece.stop - part.start), self._sums()
                arrays = (e[rows], s[rows], de[block, rows], ds[block, rows])
                self._loop(
                    "tangent", values, steps, state, piece, totals, seed, dot, key_dot, *arrays, gain=gain
                )
                sums.append(totals)
        return e, s, de, ds, sums

    def trace(self, values: Mapping[str, float], gain: bool = True, start: Gaussian | None = None) -> Trace:
        """Run the filter and keep all moments; without `gain`, readings enter ln L but do not correct the
        state.

        `start` is a Gaussian at the instant before the timeline's first (a checkpoint).
        """
        return self._filtered(values, gain, start)[0]

    def with_roots(self, values: Mapping[str, float]) -> tuple[Trace, np.ndarray, np.ndarray]:
        """The trace; factors W (T, n, n) of the finite part W W' of the covariance after each instant; and
        the directions (T, n, d) of the state of which nothing is known there."""
        trace, r, moments = self._filtered(values)
        return trace, r.root_of(moments), r.unknown_of(moments)

    def _filtered(
        self, values: Mapping[str, float], gain: bool = True, start: Gaussian | None = None
    ) -> tuple[Trace, Recursion, np.ndarray]:
        """The trace, its recursion, and the packed moments (T, w) after each instant."""
        if start is not None and self._unknown:
            return replace(self, initial=start)._filtered(values, gain)
        r = self.recursion
        n, outputs = r.n, len(r.updates)
        state = self._start(values, start)
        width = len(state)
        rows = np.empty((len(self.timeline), trace_width(width, n, outputs)))
        transition, noise = np.split(rows[:, 2 * width + 2 * outputs :], [n * n], axis=1)
        steps, sums = self._steps(values, gain, start), []
        for part in self._parts():
            k, piece_sums = part.start, self._sums()
            state[:] = self._widened(k, state)
            self._loop("trace", values, steps, state, part, piece_sums, rows[part], gain=gain)
            sums.append(piece_sums)
            if k in self._gaps:
                f = transition[k].reshape(n, n)
                noise[k] += pack((f * self._gaps[k]) @ f.T)
        before, after = rows[:, :width], rows[:, width + 2 * outputs : 2 * width + 2 * outputs]
        trace = Trace(
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
        if not self.square_root and (math.isnan(trace.loglik) or trace.lost):
            return self._in_factors._filtered(values, gain, start)
        if r.unknown:
            trace.variance[np.isnan(trace.variance)] = math.inf
        return trace, r, after
