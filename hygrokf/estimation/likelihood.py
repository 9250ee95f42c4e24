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
from typing import Any

import numpy as np

from hygrokf.data.timestamps import duration_text, stamp_text
from hygrokf.engine.filter_loops import Control, filter_loop
from hygrokf.engine.gaps import gap_variances
from hygrokf.engine.llvm_writer import LANES
from hygrokf.engine.schedule import (
    TOLERANCE,
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
from hygrokf.engine.traced_filter import Recursion, bounded_weight, pack, trace_width, traced, unpack
from hygrokf.estimation.start import Moments, Slopes, prior, prior_slopes, stationary, stationary_slopes
from hygrokf.physics.model import Model, fields_alone
from hygrokf.physics.parameters import expect_values

CHUNK = 4096
"""Number of instants for which sensitivities are held in memory at a time."""
INITIAL = ("prior", "stationary", "diffuse")
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
    tolerance: [1] largest error of a sub-step, in standard deviations; a search may take a larger one at
    the expense
        of the last digits.
    schedule: sub-steps to hold (`scheduled`); by default they are chosen anew for every set of values.

    `value` gives ln L, `sensitivities` its score and information, `trace` all moments of the filter.  Raises
    ValueError for an unknown `initial`, unknown diffuse states, a schedule of other instants and parameters
    without a value, RatesFault where rates are not finite or no sub-step resolves a step.
    """

    model: Model
    timeline: Timeline
    initial: str | Gaussian = "prior"
    diffuse_states: tuple[str, ...] = ()
    tolerance: float = TOLERANCE
    schedule: Schedule | None = None

    def __post_init__(self) -> None:
        if self.schedule is not None and len(self.schedule.offset) != len(self.timeline) + 1:
            raise ValueError(
                f"schedule: expected the sub-steps of {len(self.timeline)} instants, found those of "
                f"{len(self.schedule.offset) - 1}; make one by `scheduled` on this timeline"
            )
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
        return traced(self.model, self._diffuse)

    # -- numbers that the compiled loops start from ----------------------------------------------------------
    def theta(self, values: Mapping[str, float]) -> np.ndarray:
        """Parameter values (d,) in the model's order, followed by the record's own numbers."""
        try:
            known = [values[p.name] for p in self.model.parameters]
        except KeyError:
            expect_values(self.model.parameters, values)
            raise
        return np.array([*known, *self.recursion.constants], dtype=float)

    # -- sub-steps -------------------------------------------------------------------------------------------
    def scheduled(self, values: Mapping[str, float]) -> Likelihood:
        """The likelihood that holds the sub-steps chosen for these values; itself where steps are exact."""
        if self.recursion.exact:
            return self
        return replace(self, schedule=self._scheduled(values, True, None))

    def discretisation_error(self, values: Mapping[str, float]) -> float:
        """Change of ln L where every sub-step is halved; 0 where steps are exact."""
        if self.recursion.exact:
            return 0.0
        held = self if self.schedule is not None else self.scheduled(values)
        assert held.schedule is not None
        return abs(replace(held, schedule=held.schedule.halved()).value(values) - held.value(values))

    def steps_per_instant(self, values: Mapping[str, float]) -> float:
        """Filter steps of one pass with these values per instant of the record; 1 where steps are exact."""
        if self.recursion.exact:
            return 1.0
        return max(1.0, len(self._steps(values).row) / len(self.timeline))

    def _steps(
        self, values: Mapping[str, float], gain: bool = True, start: Gaussian | None = None
    ) -> SubSteps:
        """Sub-steps of every step; raises RatesFault where no sub-step resolves one."""
        if self.recursion.exact:
            return whole_steps(self.timeline, tuple(self._gaps))
        if self.schedule is not None:
            return self._held
        return sub_steps(self.timeline, self._scheduled(values, gain, start), tuple(self._gaps))

    @cached_property
    def _held(self) -> SubSteps:
        assert self.schedule is not None
        return sub_steps(self.timeline, self.schedule, tuple(self._gaps))

    def _scheduled(self, values: Mapping[str, float], gain: bool, start: Gaussian | None) -> Schedule:
        state, theta, found = self._start(values, start), self.theta(values), []
        point = (theta.tobytes(), state.tobytes(), gain)
        if self._latest.get("point") != point:
            pieces = whole_steps(self.timeline, tuple(self._gaps)).pieces(self._whole)
            for part in pieces:
                state[:] = self._widened(part.start, state)
                made = scheduled(self.recursion, theta, self.timeline, part, state, self.tolerance, gain)
                if isinstance(made, Unresolved):
                    raise RatesFault(self._unresolved(values, made))
                found.append(made)
            self._latest.update(point=point, schedule=joined(found))
        return self._latest["schedule"]

    @cached_property
    def _latest(self) -> dict[str, Any]:
        """The last schedule, and the values, first moments and kind of run that it was made for."""
        return {}

    def _unresolved(self, values: Mapping[str, float], where: Unresolved) -> str:
        t, r = self.timeline, self.recursion
        names = (*self.model.states, *self.model.outputs)
        lost = names[where.state]
        needed = r.graph.needed(r.rates if where.state >= r.n else [r.rates[where.state]])
        symbols = [r.graph.nodes[k][1] for k in needed if r.graph.nodes[k][0] == "symbol"]
        own = ", ".join(f"{n[2:]} = {values[n[2:]]:.3g}" for n in symbols if n.startswith("p:"))
        hours = float(t.steps[t.key[where.instant], 0])
        return (
            f"expected rates that sub-steps resolve, found others of {lost} in the step of "
            f"{duration_text(3600.0 * hours)} until {stamp_text(t.origin_s + 3600.0 * t.time[where.instant])}"
            f"{' with ' + own if own else ''}: the state leaves every bound, its rate is not finite there, "
            "or it jumps; narrow the bounds of these parameters, or smooth the jump"
        )

    def _not_finite(self, values: Mapping[str, float]) -> str:
        """The states without a finite rate, and the parameters that their rates depend on."""
        r, t = self.recursion, self.timeline
        known = r.symbols(values, (), {name: t.input(name) for name in t.regimes})
        with np.errstate(all="ignore"):
            wide = {name: np.asarray(value, dtype=float) for name, value in known.items()}
            found = [r.graph.evaluate([r.graph.lift(v) for v in row], wide) for row in r.jacobian]
        lost = [i for i, row in enumerate(found) if not all(np.isfinite(v).all() for v in row)]
        rows = [r.graph.lift(v) for i in lost for v in r.jacobian[i]]
        symbols = [r.graph.nodes[k][1] for k in r.graph.needed(rows) if r.graph.nodes[k][0] == "symbol"]
        own = ", ".join(f"{n[2:]} = {values[n[2:]]:.3g}" for n in symbols if n.startswith("p:"))
        return (
            f"expected finite rates, found others of {', '.join(self.model.states[i] for i in lost)}"
            f"{' with ' + own if own else ''}: narrow the bounds of these parameters, or correct the inputs "
            "that the states follow"
        )

    @cached_property
    def _gaps(self) -> dict[int, np.ndarray]:
        return gap_variances(self.model, self.recursion, self.timeline)

    def first_inputs(self) -> dict[str, float]:
        t = self.timeline
        named = {name: float(t.u[1, i]) for i, name in enumerate(t.varying)}
        return named | {name: float(t.steps[t.key[0], 1 + i]) for i, name in enumerate(t.regimes)}

    def first_gaussian(self, values: Mapping[str, float]) -> Gaussian:
        """Moments of the state before the first reading (the finite part, for a diffuse start)."""
        first = self._first_moments(values)
        return Gaussian(first.mean, first.covariance, float(self.timeline.time[0]))

    def first_state(self, values: Mapping[str, float]) -> np.ndarray:
        """Packed moments (w,) before the first reading."""
        return self._packed(self._first_moments(values))

    def _first_moments(self, values: Mapping[str, float]) -> Moments:
        if isinstance(self.initial, Gaussian):
            return Moments(np.asarray(self.initial.mean), np.asarray(self.initial.covariance))
        if self.initial == "stationary":
            return stationary(self.model, self.recursion, values, self.first_inputs())[0]
        return prior(self.model, values, self.first_inputs())

    def _packed(self, first: Moments | Slopes) -> np.ndarray:
        """Moments (w,), or their derivatives (d, w), as the loops take them."""
        known = 1.0 - self._infinite
        mean, covariance = first.mean * known, first.covariance * np.outer(known, known)
        found = np.concatenate([mean, pack(covariance)], axis=-1)
        if not self._diffuse:
            return found
        start = pack(np.diag(self._infinite)) * isinstance(first, Moments)
        return np.concatenate([found, np.broadcast_to(start, (*found.shape[:-1], len(start)))], axis=-1)

    @cached_property
    def _infinite(self) -> np.ndarray:
        """(n,) 1 for states of which nothing is known, 0 for the others."""
        chosen = (self.diffuse_states or self.model.states) if self._diffuse else ()
        return np.array([float(name in chosen) for name in self.model.states])

    def _start(self, values: Mapping[str, float], start: Gaussian | None = None) -> np.ndarray:
        """The packed moments that a loop starts from and moves."""
        if start is not None:
            return np.concatenate([start.mean, pack(start.covariance)])
        return np.ascontiguousarray(self.first_state(values), dtype=float)

    def _start_with_slopes(self, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """The packed moments that a loop starts from, and their derivatives (d, w)."""
        inputs = self.first_inputs()
        if self.initial == "stationary":
            first, matrix = stationary(self.model, self.recursion, values, inputs)
            found = stationary_slopes(self.model, self.recursion, values, inputs, first, matrix)
        else:
            first = self._first_moments(values)
            found = prior_slopes(self.model, values, inputs)
            if isinstance(self.initial, Gaussian):
                found = Slopes(0.0 * found.mean, 0.0 * found.covariance)
        return np.ascontiguousarray(self._packed(first), dtype=float), self._packed(found)

    def jacobian(self, values: Mapping[str, float], mean: np.ndarray, u: Mapping[str, float]) -> np.ndarray:
        """Derivatives (n, n) [1/h] of the states' rates by the states, at `mean` (n,) and inputs `u`."""
        r = self.recursion
        known = r.symbols(values, mean, u)
        return np.array([r.graph.evaluate(row, known) for row in r.jacobian])

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
        """Run a compiled loop over a piece, which moves `state` through it; `further` are its own
        arguments."""
        t, own = self.timeline, steps.of(part)
        table = np.empty(max(table_room(self.recursion, kind), len(own.keys) * len(self.recursion.key_nodes)))
        filter_loop(self.recursion, kind, gain, controls)(
            kind, len(own.key), len(own.keys), self.theta(values), own.keys, own.times, table, own.key,
            own.offset, own.row, own.within, t.u[1:][part], t.y[part], t.reset[part], state, state.copy(),
            *further,
        )  # fmt: skip
        if own.times.min(initial=0) < 0:
            raise RatesFault(self._not_finite(values))

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
        state[:] = self._widened(part.start, state)
        out = np.zeros(3)
        self._loop("value", values, steps, state, part, out)
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
        steps = whole_steps(self.timeline, tuple(self._gaps))
        for part in self._parts(steps):
            state[:] = self._widened(part.start, state)
            further = still[part], levels, found[part], tags(), np.array([self.tolerance])
            own._loop(
                "controlled", values, steps, state, part, *further, gain=False, controls=tuple(controls)
            )
            own.timeline.u[part.stop, columns] = found[part.stop - 1]
        return found

    def score(self, values: Mapping[str, float]) -> tuple[float, np.ndarray]:
        """ln L and its exact derivatives (d,) with respect to all parameters, by one backward pass."""
        state, first_slopes = self._start_with_slopes(values)
        steps = self._steps(values)
        pieces = steps.pieces(self._whole)
        states = [state]
        for part in pieces[:-1]:
            state = state.copy()
            self._run(values, steps, part, state)
            states.append(state)
        loglik, theta_bar, state_bar = 0.0, np.zeros(len(self.recursion.p)), np.zeros(len(state))
        for part, state in zip(reversed(pieces), reversed(states), strict=True):
            entered = self._widened(part.start, state).copy()
            share, slopes = self._pulled_back(values, steps, part, entered, state_bar)
            loglik, theta_bar = loglik + share, theta_bar + slopes
        return loglik, theta_bar + first_slopes @ state_bar

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
        most = max(int(np.diff(steps.offset).max(initial=1)), len(r.updates)) + 1
        buffer, levels = np.empty((most, width)), np.empty(level_room(r))
        self._loop(
            "adjoint", values, steps, state, part, out, store, key_bar, theta_bar, state_bar, buffer, levels
        )
        return self._loglik(out), theta_bar

    # where the filter breaks down and the value is −∞, these sums are not finite either
    @np.errstate(invalid="ignore", divide="ignore", over="ignore")
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
            *found, value = self._tangent_part(values, steps, part, blocks, gain=True)
            read = np.isfinite(self.timeline.y[part])  # few instants have a reading
            e, s, de, ds = (one[read] for one in found)
            weight = bounded_weight(e * e / s, self.model.bound)
            e, de, ds = weight * e, weight[:, None] * de[:, :count], ds[:, :count]
            share = -(e / s)[:, None] * de - 0.5 * (1.0 / s - (e / s) ** 2)[:, None] * ds
            loglik += value
            score += share.sum(axis=0)
            if each:
                by_output = np.zeros((*read.shape, count))
                by_output[read] = share
                scores[part] = by_output.sum(axis=1)
            a = de / np.sqrt(s)[:, None]
            b = ds / (math.sqrt(2.0) * s)[:, None]
            information += a.T @ a + b.T @ b
        return Sensitivities(loglik, score, information, scores)

    def _tangent_start(self, values: Mapping[str, float], directions: np.ndarray) -> Blocks:
        count = directions.shape[1]
        blocks = range(0, max(count, 1), LANES)
        padded = np.zeros((directions.shape[0], len(blocks) * LANES))
        padded[:, :count] = directions
        first, first_slopes = self._start_with_slopes(values)
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
        blocks, steps = self._tangent_start(values, directions), self._steps(values, gain)
        found = [self._tangent_part(values, steps, part, blocks, gain) for part in self._chunks]
        e, _, de, _, _ = zip(*found, strict=True)
        return np.concatenate(e), np.concatenate(de)[..., : directions.shape[1]]

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
        """Innovations and variances (t, k), the derivatives of both (t, k, r), and ln L, of some instants."""
        r = self.recursion
        count, outputs = part.stop - part.start, len(r.updates)
        derivatives: list[tuple[np.ndarray, np.ndarray]] = []
        for state, dot, seed in zip(*blocks, strict=True):
            e, s, loglik = np.zeros((count, outputs)), np.ones((count, outputs)), 0.0
            de, ds = np.zeros((count, outputs, LANES)), np.zeros((count, outputs, LANES))
            key_dot = np.empty(max(1, len(steps.keys) * len(r.key_nodes)) * LANES)
            for piece in steps.pieces(part):
                state[:] = self._widened(piece.start, state)
                own = slice(piece.start - part.start, piece.stop - part.start)
                out, rows = np.zeros(3), (e[own], s[own], de[own], ds[own])
                self._loop("tangent", values, steps, state, piece, out, seed, dot, key_dot, *rows, gain=gain)
                loglik += self._loglik(out)
            derivatives.append((de, ds))
        return (
            e,
            s,
            np.concatenate([d[0] for d in derivatives], axis=2),
            np.concatenate([d[1] for d in derivatives], axis=2),
            loglik,
        )

    def trace(self, values: Mapping[str, float], gain: bool = True, start: Gaussian | None = None) -> Trace:
        """Run the filter and keep all moments; without `gain`, readings enter ln L but do not correct the
        state.

        `start` is a Gaussian at the instant before the timeline's first (a checkpoint).
        """
        r = self.recursion
        n, outputs = r.n, len(r.updates)
        state = self._start(values, start)
        rows = np.empty((len(self.timeline), trace_width(n, outputs, self._diffuse)))
        width = len(state)
        q = n * (n + 1) // 2
        steps, loglik = self._steps(values, gain, start), 0.0
        for part in self._parts(steps):
            state[:], out = self._widened(part.start, state), np.zeros(3)
            self._loop("trace", values, steps, state, part, out, rows[part], gain=gain)
            loglik += self._loglik(out)
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
