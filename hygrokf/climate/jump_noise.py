"""Disturbances that are rare and strong: how rare, from a fit's innovations, and how they are drawn.

To the filter, heat and vapour that the model does not explain are Gaussian noise.  A door, a drain or a fan
is strong and rare instead, with the same variance, and changes everything that depends on single events:
rates of change, hours above a limit.  The excess kurtosis of the fit's innovations, 0 for Gaussian noise,
shows how rare.

Noise with shots is a compound Poisson process: normal shots at random times, every h hours on average.  Over
a step d the variance is the Gaussian one times G h/d, G ~ Poisson(d/h), with mean 1; the excess kurtosis of
an increment is 3 h/d. h = 0 is the Gaussian noise.

Shapes: n states, m outputs, N members.

Source: Campbell's theorem (cumulants of shot noise; Rice 1944, doi:10.1002/j.1538-7305.1944.tb00874.x).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.identification.fit import Fit
from hygrokf.physics.expression import Value
from hygrokf.physics.model import Model

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
    means = [i for i, name in enumerate(model.states) if name not in model.own_states]
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


def shot_words(found: tuple[Shots, ...]) -> list[str]:
    """A statement on shots that are on average more than an hour apart."""
    rare = [f"{one.name} every {one.every_h:.0f} h" for one in found if one.every_h >= 1.0]
    if not rare:
        return []
    return [
        f"disturbances are simulated as shots, on average of {' and '.join(rare)}, because the fit's "
        "innovations have heavier tails than a normal distribution"
    ]


def _seen(fit: Fit, model: Model) -> dict[str, tuple[int, float, float, float]]:
    """Of every output with a diagnosis: its place, the innovations' excess kurtosis, step [h] and span
    [h]."""
    seen = {}
    for name, outputs in OUTPUTS.items():
        place = next((model.outputs.index(one) for one in outputs if one in model.outputs), None)
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
