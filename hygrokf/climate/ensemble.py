"""Free runs of an ensemble through years of weather: parameters drawn, disturbances simulated; these may be
rare and strong, as a fit's innovations show.

To the filter, heat and vapour that the model does not explain are Gaussian noise.  A door, a drain or a fan
is strong and rare instead, with the same variance, and changes everything that depends on single events:
rates of change, hours above a limit.  The excess kurtosis of the fit's innovations, 0 for Gaussian noise,
shows how rare.

Noise with shots is a compound Poisson process: normal shots at random times, every h hours on average.  Over
a step d the variance is the Gaussian one times G h/d, G ~ Poisson(d/h), with mean 1; the excess kurtosis of
an increment is 3 h/d. h = 0 is the Gaussian noise.

Source: Campbell's theorem (cumulants of shot noise; Rice 1944, doi:10.1002/j.1538-7305.1944.tb00874.x).

From a known state the model's moments over one step are the mean and covariance of the next state (exact
where the model is linear over a step).  Every member draws its next state from that distribution: Gaussian,
or with the rare shots that the fit's innovations show.  Compiled code steps all
members side by side.  In a model with switches every member operates its own.

Shapes: N members, T instants that are kept, n states, m outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.data.record import Record
from hygrokf.estimation.batch_filter import SideBySide
from hygrokf.evaluation.self_switching import Switchboard, cut, switches_of
from hygrokf.identification.fit import Fit
from hygrokf.modelling.design import Design, read_as
from hygrokf.modelling.inputs import Run, model_inputs
from hygrokf.physics.expression import Value
from hygrokf.physics.holds import inputs_between
from hygrokf.physics.model import Model
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.psychrometrics import (
    GAS_CONSTANT_VAPOUR,
    Surface,
    absolute_humidity_from_vapour_pressure,
    condenses,
    saturation_pressure_water,
)
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.statement import Statement

FEWEST_JUMPS = 30
"""Shots that the fit's period must have seen, which limits their distance: a fourth moment of fewer events is
worthless."""
SETTLED = 2000
"""Readings after which the filter's covariance has converged and a shot has decayed."""
OUTPUTS = {
    "temperature": ("cabinet_temperature",),
    "humidity": ("cabinet_relative_humidity", "cabinet_absolute_humidity"),
}
"""Outputs of a model by the names that the fit's diagnosis of innovations has for them."""


@dataclass(frozen=True)
class Shots:
    """Noise that comes as shots: in which `states` (n,), and how far apart on average, `every_h` [h] (0:
    Gaussian)."""

    name: str
    states: np.ndarray
    every_h: float

    def factors(self, random: np.random.Generator, step_h: float, count: int) -> np.ndarray:
        """Factors (N,) of the noise's standard deviation over one step [h]; their squares have mean 1."""
        if self.every_h <= 0.0:
            return np.ones(count)
        return np.sqrt(random.poisson(step_h / self.every_h, count) * (self.every_h / step_h))


def shots_from_innovations(
    fit: Fit, model: Model, inputs: Mapping[str, float], state: np.ndarray
) -> tuple[Shots, ...]:
    """How often the disturbances of heat and of vapour come, from the excess kurtosis of a fit's innovations.

    `model` is the fit's; it is linearised at typical `inputs` and a typical `state` (n,).  The filter of the
    readings remembers a shot: an innovation is the sum of h'M^s exp(A v) w over all shots w that came s
    readings and v hours before a reading, with M = F (I − K H), so that fourth cumulants add up to
    κ S² = 3 h Σ_s Σ_i ∫ (h'M^s exp(A v) e_i)⁴ q_i² dv over the readings' step, with S the innovation's
    variance and q_i the noise intensity of state i.  The temperature's innovations give the shots of heat;
    their share in the humidity's innovations is subtracted before the shots of vapour are found.
    """
    seen = _seen(fit, model)
    if not seen:
        return ()
    rates, reads, air, variance = _linear(model, fit.values, inputs, state)
    noise = np.diag(np.array(model.noise(fit.values), dtype=float))
    warms = air != 0.0
    for _ in range(len(air)):  # also through other states
        warms = warms | (rates[warms] != 0.0).any(axis=0)
    means = [i for i, name in enumerate(model.states) if name not in model.mechanism_states]
    found: list[Shots] = []
    for output, states in (("temperature", warms), ("humidity", ~warms)):
        if output not in seen:
            continue
        place, kurtosis, step_h, span_h = seen[output]
        for other in found:
            kurtosis -= other.every_h * _share(
                rates, reads, variance, noise, other.states, means, place, step_h
            )
        share = _share(rates, reads, variance, noise, states, means, place, step_h)
        every_h = min(max(kurtosis, 0.0) / share, span_h / FEWEST_JUMPS) if share > 0.0 else 0.0
        found.append(Shots({"temperature": "heat", "humidity": "vapour"}[output], states, every_h))
    return tuple(found)


def shot_statements(found: tuple[Shots, ...]) -> list[Statement]:
    """A statement on shots that are on average more than an hour apart."""
    rare = [
        ClimateCode.SHOTS_OF_BALANCE(balance=one.name, hours=one.every_h)
        for one in found
        if one.every_h >= 1.0
    ]
    return [ClimateCode.SHOTS(shots=tuple(rare))] if rare else []


def _seen(fit: Fit, model: Model) -> dict[str, tuple[int, float, float, float]]:
    """Of every output with a diagnosis: its place, the innovations' excess kurtosis, step [h] and span
    [h]."""
    seen = {}
    for name, outputs in OUTPUTS.items():
        place = next((model.outputs.index(output) for output in outputs if output in model.outputs), None)
        found = fit.results.innovations.outputs.get(name)
        if place is not None and found is not None and math.isfinite(found.excess_kurtosis):
            seen[name] = (place, found.excess_kurtosis, found.step_h, found.step_h * found.n)
    return seen


def _linear(
    model: Model, values: Mapping[str, float], inputs: Mapping[str, float], state: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Slopes of the rates (n, n), the outputs (m, n) and the cabinet's temperature (n,), and the sensors'
    variances (m,)."""

    def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        found = model.evaluate(list(x), inputs, values)
        outputs = [float(found.outputs[name][0]) for name in model.outputs]
        air = float(found.quantities["cabinet_air_temperature"])
        return np.array([float(rate) for rate in found.rates]), np.array(outputs), air

    columns = []
    for i, x in enumerate(state):
        move = np.zeros(len(state))
        move[i] = 1e-4 * max(1.0, abs(x))
        above: tuple[Value, ...] = at(state + move)
        below: tuple[Value, ...] = at(state - move)
        columns.append([(a - b) / (2.0 * move[i]) for a, b in zip(above, below, strict=True)])
    rates, reads, air = (np.array([c[k] for c in columns]).T for k in range(3))
    outputs = model.evaluate(list(state), inputs, values).outputs
    return rates, reads, air, np.array([float(outputs[name][1]) for name in model.outputs])


def _share(
    rates: np.ndarray,
    reads: np.ndarray,
    variance: np.ndarray,
    noise: np.ndarray,
    states: np.ndarray,
    means: list[int],
    place: int,
    step_h: float,
) -> float:
    """Excess kurtosis [1/h] of an output's innovations for each hour between shots of the states' noise."""
    from scipy.linalg import expm

    n = len(rates)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -rates, np.diag(noise), rates.T
    block = expm(block * step_h)  # Van Loan 1978
    transition = block[n:, n:].T
    whole = transition @ block[:n, n:]
    transition[:, means] = 0.0  # a running mean begins anew after every reading
    covariance = whole + 1e-9 * np.eye(n)
    for _ in range(SETTLED):
        spread = reads @ covariance @ reads.T + np.diag(variance)
        gain = covariance @ reads.T @ np.linalg.pinv(spread)
        covariance = transition @ (covariance - gain @ spread @ gain.T) @ transition.T + whole
        covariance = 0.5 * (covariance + covariance.T)
    carried = transition @ (np.eye(n) - gain @ reads)
    rows = np.empty((SETTLED, n))
    row = reads[place]
    for lag in range(SETTLED):
        rows[lag], row = row, row @ carried
    # a shot at any time between two readings, by Gauss-Legendre
    nodes, weights = np.polynomial.legendre.leggauss(8)
    total = 0.0
    for node, weight in zip(nodes, weights, strict=True):
        columns = expm(rates * (0.5 * step_h * (1.0 + node))) * np.sqrt(noise * states)
        total += 0.5 * step_h * weight * float(((rows @ columns) ** 4).sum())
    return 3.0 * total / float(spread[place, place]) ** 2


MEMBER_STEP_TOLERANCE = 1e-4
"""[1] `tolerance` of the members' sub-steps: a draw of a member is off by that share of its spread."""
STEP_H = 1.0
"""[h] distance of the kept instants; the steps between them are simulated but not kept."""
YEAR_H = 8766.0
"""[h] of a year, 365.25 days."""
WHOLE_SHARE = 0.9
"""Share of a year above which a stretch counts as a year."""
SPIN_UP_H = 720.0
"""[h] length of a first run, after which the state has forgotten its start; then the run starts over."""
OWN_NOISE = 1e-9
"""Share of a state's variance [1] that is added as noise of its own, so that singular covariances have a
factor."""
DRAWN = 256
"""Steps whose random numbers are drawn at once."""
LOG_MOST = 0.5
"""Standard error of a logarithm [1] up to which the logarithm is drawn from a normal distribution."""


@dataclass(frozen=True)
class Year:
    """One year of an ensemble; the last or only one may be a part of a year.

    `time_s` (T,) [s since 1970, UTC]; `temperature_K` (N, T) of the cabinet air; `relative_humidity` [1] over
    water and `absolute_humidity_g_m3` (N, T) or None; `condensing` (N, T) whether the cold surface is wet;
    `operating` (T,); `known` (T,) False where weather or power is not known; `ambient` the weather (T,) in
    the same units: temperature_K, relative_humidity, absolute_humidity_g_m3; `step_h` distance of the
    instants.
    """

    time_s: np.ndarray
    temperature_K: np.ndarray
    relative_humidity: np.ndarray | None
    absolute_humidity_g_m3: np.ndarray | None
    condensing: np.ndarray | None
    operating: np.ndarray
    known: np.ndarray
    ambient: Mapping[str, np.ndarray]
    step_h: float

    @property
    def hours(self) -> float:
        """[h] of which weather and power are known."""
        return float(self.known.sum()) * self.step_h


# --- members ---------------------------------------------------------------------------------


def draw_members(fit: Fit, count: int, seed: int) -> list[dict[str, float]]:
    """`count` sets of parameter values, each as plausible as the fit given its data.

    The values are drawn from the normal distribution of the estimates in the coordinates of the estimation
    (logarithms of positive parameters) and cut at the parameters' bounds.  A positive parameter whose
    logarithm is uncertain by more than `LOG_MOST`, usually a noise, cannot be distinguished from zero: a
    normal distribution of its logarithm would reach values a hundred times as large, which the data exclude.
    It is drawn in its own unit.  Parameters without covariance (at a bound, or fixed) keep the fit's value.
    The biases of the loggers are drawn with the others, because their uncertainty also makes the heat release
    uncertain.  A seed gives the same sets for every count.
    """
    names, matrix = fit.covariance
    by_name = {p.name: p for p in fit.design.model.parameters}
    chosen = [by_name[name] for name in names]
    values = np.array([fit.values[p.name] for p in chosen])
    slopes = np.array([p.slope(v) for p, v in zip(chosen, values, strict=True)])
    centre = np.array([p.to_coordinate(v) for p, v in zip(chosen, values, strict=True)])
    factor = _factor(matrix / np.outer(slopes, slopes)) if len(chosen) else np.zeros((0, 0))
    spread = np.sqrt((factor**2).sum(axis=1))
    rows = np.random.default_rng([seed, 1]).standard_normal((count, len(chosen)))
    members = []
    for row in rows:
        moves = factor @ row
        own = {
            p.name: _perturbed(p, float(z), float(move), float(s))
            for p, z, move, s in zip(chosen, centre, moves, spread, strict=True)
        }
        members.append({**fit.values, **own})
    return members


def _perturbed(p: Parameter, z: float, move: float, sd: float) -> float:
    """The value of a parameter whose coordinate changes from z by `move`, limited to its bounds.

    A positive parameter with a standard deviation `sd` above `LOG_MOST` in its logarithm changes linearly
    instead.
    """
    if p.positive and sd > LOG_MOST:
        value = p.from_coordinate(z) * (1.0 + move)
    else:
        # cut before the exponential, which could overflow
        value = p.from_coordinate(min(max(z + move, p.to_coordinate(p.lower)), p.to_coordinate(p.upper)))
    return min(max(value, p.lower), p.upper)


def _factor(covariance: np.ndarray) -> np.ndarray:
    """A matrix B such that B B' equals the covariance, which may be singular."""
    symmetric = 0.5 * (covariance + covariance.T)
    scale = np.sqrt(np.maximum(np.diag(symmetric), 0.0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(symmetric / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


# --- instants and years ----------------------------------------------------------------------


def course(fit: Fit, record: Record) -> tuple[Design, Run]:
    """A fit's design and its run on weather and power; raises ValueError where they do not suffice."""
    design = read_as(fit.design, record)
    return design, model_inputs(design, record)


def shots_of(fit: Fit, design: Design, run: Run) -> tuple[Shots, ...]:
    """The shots of a fit's disturbances, under inputs that are typical of a run of its `course`."""
    t, model = run.timeline, design.model
    inputs = {name: _typical(t.input(name), name in t.regimes) for name in model.inputs}
    first = np.array([model.initial(fit.values, inputs)[0]], dtype=float)
    still = {name: np.full(2, value) for name, value in inputs.items()}
    runs = SideBySide(model, [fit.values], MEMBER_STEP_TOLERANCE)
    walk = _EnsembleWalk(runs, first, still, np.array([0.0, STEP_H]), None)
    walk.through(range(1))
    for _ in range(int(SPIN_UP_H / STEP_H)):
        walk.through(range(1, 2), jump=False)
    return shots_from_innovations(fit, model, inputs, walk.state[0])


def _typical(values: np.ndarray, regime: bool) -> float:
    if not regime:
        return float(np.median(values))
    kinds, count = np.unique(values, return_counts=True)
    return float(kinds[count.argmax()])


def simulate_years(
    fit: Fit,
    design: Design,
    run: Run,
    members: Sequence[Mapping[str, float]],
    seed: int,
    surface: Surface,
    process: bool = True,
    rare: Sequence[Shots] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[Year]:
    """Years of weather and power, one after the other, through every member's model.

    design, run: of `course`.
    members: parameter values of each, as `draw_members` gives them.
    process: without it the disturbances stay at their means, and only the parameters differ.
    rare: noise that comes as shots (`shots_of`); all other noise is Gaussian.
    say: is told the number of each year.

    Raises ValueError where a member's state diverges.
    """
    model, t = design.model, run.timeline
    kept = kept_instants(t.time)
    groups = years_of(t.time[kept])
    switches = switches_of(design)
    starts = []
    random = np.random.default_rng([seed, 2])
    inputs = {name: t.input(name) for name in model.inputs}
    first = {name: float(value[0]) for name, value in inputs.items()}
    n = len(model.states)
    for values in members:
        mean, variance = (np.array(part, dtype=float) for part in model.initial(values, first))
        kick = random.standard_normal(n) if process else np.zeros(n)
        begin = mean + np.sqrt(variance) * kick
        starts.append(np.where(model.amounts, np.maximum(begin, 0.0), begin))
    runs = SideBySide(model, members, MEMBER_STEP_TOLERANCE)
    spread = {p.name: np.array([member[p.name] for member in members]) for p in model.parameters}
    off = {name: np.zeros(len(members)) for name in switches}
    board = Switchboard(model, spread, switches, off) if switches else None
    walk = _EnsembleWalk(
        runs, np.array(starts), inputs, t.time, random if process else None, rare, board, ~run.operating
    )
    again = int(np.searchsorted(t.time, t.time[0] + SPIN_UP_H, side="right"))
    walk.through(range(min(again, len(t.time))))
    at = 0
    for number, group in enumerate(groups):
        say(f"year {number + 1} of {len(groups)}")
        places = kept[group]
        states = np.empty((len(places), len(members), n))
        for row, place in enumerate(places):
            walk.through(range(at, place + 1), jump=at == 0)
            at = place + 1
            states[row] = walk.state
        yield _year(model, members, run, places, states, surface)


def kept_instants(time_h: np.ndarray) -> np.ndarray:
    """Places of the first instants [h] that are at least an hour apart."""
    whole = np.flatnonzero(np.abs(time_h / STEP_H - np.round(time_h / STEP_H)) < 1e-6)
    # where every hour has an instant of its own these are the hours; else whatever stands an hour on
    if len(whole) >= WHOLE_SHARE * (time_h[-1] - time_h[0]) / STEP_H:
        return whole
    chosen, last = [], -np.inf
    for place, hour in enumerate(time_h.tolist()):
        if hour - last >= STEP_H - 1e-6:
            chosen.append(place)
            last = hour
    return np.array(chosen)


def years_of(time_h: np.ndarray) -> list[np.ndarray]:
    """Places of the instants [h] of each year, without a last stretch that is much shorter than a year.

    Years without any instant, between weather files that are years apart, are not counted.
    """
    number = ((time_h - time_h[0]) // YEAR_H).astype(int)
    groups = [np.flatnonzero(number == year) for year in np.unique(number)]
    long = [g for g in groups if time_h[g[-1]] - time_h[g[0]] >= WHOLE_SHARE * YEAR_H]
    return long or groups[:1]


class _EnsembleWalk:
    """The states of all members on their way through the instants."""

    def __init__(
        self,
        runs: SideBySide,
        state: np.ndarray,
        inputs: Mapping[str, np.ndarray],
        time_h: np.ndarray,
        random: np.random.Generator | None,
        rare: Sequence[Shots] = (),
        board: Switchboard | None = None,
        idle: np.ndarray | None = None,
    ) -> None:
        self.runs, self.inputs, self.time_h, self.random = runs, inputs, time_h, random
        self.board, self.idle = board, np.zeros(len(time_h), bool) if idle is None else idle
        self.rare = [one for one in rare if one.every_h > 0.0 and one.states.any()]
        self.state = state
        self._amounts = np.array(runs.model.amounts)
        self._kicks = np.empty((0, *self.state.shape))
        self._at = 0

    def through(self, places: range, jump: bool = True) -> None:
        """Step to each of the instants; a `jump` to the first of them takes no time."""
        for place in places:
            now: dict[str, Value] = {name: float(value[place]) for name, value in self.inputs.items()}
            if jump:
                self.runs.begin(now | self._flags)
                jump = False
                continue
            step_h = self.time_h[place] - self.time_h[place - 1]
            if self.board is None:
                self._step(step_h, now)
                continue
            before = {name: float(value[place - 1]) for name, value in self.inputs.items()}
            holds, begun = self.runs.model.holds, 0.0
            hours, shares = cut(step_h)
            for length, ended in zip(hours.tolist(), shares.tolist(), strict=True):
                self.board.decide(self.state, inputs_between(holds, before, now, begun), self.idle[place])
                self._step(length, inputs_between(holds, before, now, ended) | self._flags)
                begun = ended

    @property
    def _flags(self) -> dict[str, Value]:
        return {} if self.board is None else self.board.flags

    def _step(self, step_h: float, inputs: Mapping[str, Value]) -> None:
        self.state, gained = self.runs.step(self.state, step_h, inputs)
        if self.random is not None:
            self.state = self.state + _drawn(gained, self._kick(step_h))
            self.state[:, self._amounts] = np.maximum(self.state[:, self._amounts], 0.0)

    def _kick(self, step_h: float) -> np.ndarray:
        assert self.random is not None, "a walk without chance has no kicks"
        if self._at == len(self._kicks):
            self._kicks, self._at = self.random.standard_normal((DRAWN, *self.state.shape)), 0
        kick = self._kicks[self._at]
        for one in self.rare:
            kick[:, one.states] *= one.factors(self.random, step_h, len(kick))[:, None]
        self._at += 1
        return kick


def _drawn(covariance: np.ndarray, kick: np.ndarray) -> np.ndarray:
    """Errors (N, n) with covariances (N, n, n), which may be singular, from standard normal numbers (N, n).

    Raises ValueError where a covariance is not finite.
    """
    lost = int((~np.isfinite(covariance).all(axis=(1, 2))).sum())
    if lost:
        raise ValueError(
            f"expected finite states, found others in {lost} of {len(covariance)} members: with the "
            "parameters that the fit leaves open its model runs away under this weather; identify it on more "
            "data, or with fewer causes"
        )
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    correlation = covariance / (safe[:, :, None] * safe[:, None, :])
    n = kick.shape[1]
    correlation[:, np.arange(n), np.arange(n)] = 1.0 + OWN_NOISE
    try:
        factor = np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        # the moments of a nonlinear model may have an eigenvalue a little below 0
        least = np.linalg.eigvalsh(correlation)[:, 0]
        correlation[:, np.arange(n), np.arange(n)] += np.maximum(2.0 * OWN_NOISE - least, 0.0)[:, None]
        factor = np.linalg.cholesky(correlation)
    return scale * np.einsum("nij,nj->ni", factor, kick)


def _year(
    model: Model,
    members: Sequence[Mapping[str, float]],
    made: Run,
    places: np.ndarray,
    states: np.ndarray,
    surface: Surface,
) -> Year:
    t = made.timeline
    u = {name: t.input(name)[places][:, None] for name in model.inputs}
    values = {p.name: np.array([m[p.name] for m in members])[None, :] for p in model.parameters}
    columns = [states[:, :, i] for i in range(states.shape[2])]
    quantity: Value = model.quantities(columns, u, values)["cabinet_air_temperature"]
    air = np.ascontiguousarray(np.broadcast_to(quantity, states.shape[:2]).T)
    outside = t.input("ambient_temperature")[places]
    ambient = {"temperature_K": outside}
    relative = absolute = wet = None
    if "vapour" in model.states:
        # the vapour is a linear state and may be negative where the air is all but dry
        c = np.maximum(states[:, :, model.states.index("vapour")].T, 1e-3)
        pressure = 1e-3 * GAS_CONSTANT_VAPOUR * outside * c
        relative = pressure / saturation_pressure_water(air)
        absolute = 1e3 * absolute_humidity_from_vapour_pressure(pressure, air)
        wet = condenses(pressure, surface.temperature(outside, air))
        vapour = t.input("ambient_absolute_humidity")[places]
        ambient["absolute_humidity_g_m3"] = vapour
        ambient["relative_humidity"] = (
            1e-3 * GAS_CONSTANT_VAPOUR * outside * vapour / saturation_pressure_water(outside)
        )
    seconds = t.origin_s + 3600.0 * t.time[places]
    step = float(np.median(np.diff(t.time[places]))) if len(places) > 1 else STEP_H
    return Year(
        seconds, air, relative, absolute, wet, made.operating[places], made.scored[places], ambient, step
    )
