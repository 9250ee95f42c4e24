"""How large a hidden cause is, measured against a bare model that a user would refit.

The bare cabinet runs with its true parameters and without disturbances on the inputs as logged.
What refitting would absorb is taken off its error by least squares: for the temperature the heat
release's coefficients and both thermal parameters, for the humidity the hygric constant and
offsets of both humidity sensors within their accuracy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.optimize import lsq_linear

from plants.cabinet import Cabinet, Forcing, Trajectory, integrate
from plants.chance import low_pass
from plants.drivers import Drivers
from plants.saturation import concentration, saturation_pressure
from plants.scene import QUANTITIES, Scene

GROWTH = 0.3
"""[-] growth of the error at strength 1."""

HUMIDITY_ACCURACY = 0.02
_USUAL = (1.5, 4e-4)  # [K], [kg/m3]
_SCORE_S = 900.0
_SETTLE_DAYS = 1.0


@dataclass(frozen=True)
class Errors:
    """Error of the bare model by quantity, (T,) at quarters of an hour, and what refitting leaves
    of it.

    size: (temperature [K], absolute humidity [kg/m3]) root mean square of what is left.
    """

    raw: tuple[np.ndarray, np.ndarray]
    left: tuple[np.ndarray, np.ndarray]

    @property
    def size(self) -> tuple[float, float]:
        """Root mean square of what refitting leaves."""
        temperature, humidity = (math.sqrt(float(np.mean(part**2))) for part in self.left)
        return temperature, humidity


def bare_run(cabinet: Cabinet, drivers: Drivers) -> Trajectory:
    """The bare cabinet under drivers as logged, without disturbances."""
    heat = cabinet.heat_release(drivers.power_W[:-1], drivers.held_ambient_K, drivers.preheating[:-1])
    step_s = float(drivers.time[1] - drivers.time[0])
    forcing = Forcing(heat, np.zeros(heat.size))
    return integrate(cabinet, step_s, drivers.ambient_K, drivers.ambient_kg_m3, forcing)


class Yardstick:
    """Measures errors of one plant's bare model; made once, used for every amplitude tried."""

    def __init__(self, scene: Scene) -> None:
        self.cabinet = scene.cabinet
        self.every = max(round(_SCORE_S / scene.step_s), 1)
        self.first = round(_SETTLE_DAYS * 86400.0 / _SCORE_S)
        self.bare = bare_run(scene.cabinet, scene.drivers)
        self.basis = (self._thermal(scene), self._hygric(scene))
        # A refit moves the hygric constant by half, the resistance ratio and time constant likewise.
        self.bounds = (
            np.array([np.inf] * (self.basis[0].shape[1] - 2) + [0.5, 0.15]),
            np.array([0.5, HUMIDITY_ACCURACY, HUMIDITY_ACCURACY]),
        )

    def _pick(self, values: np.ndarray) -> np.ndarray:
        return values[:: self.every][self.first :]

    def _thermal(self, scene: Scene) -> np.ndarray:
        """Columns: lagged regressors of the heat release, derivatives by log tau and by rho."""
        cabinet, drivers = scene.cabinet, scene.drivers
        step_h = scene.step_s / 3600.0
        running = (drivers.power_W > 0.0).astype(float)
        share = running * drivers.power_W / cabinet.rated_W
        warm = drivers.ambient_K - 283.15
        still = np.ones(warm.size)
        parts = [still, running, share, share**2, warm, running * warm]
        if drivers.preheating.any():
            parts.append(drivers.preheating)
        columns = [low_pass(part, step_h, cabinet.thermal_h) for part in parts]
        slow = replace(cabinet, heat_capacity=1.02 * cabinet.heat_capacity)
        columns.append((bare_run(slow, drivers).cabinet_K - self.bare.cabinet_K) / 0.02)
        through = cabinet.outer_resistance + cabinet.inner_resistance
        rho = cabinet.rho - 0.01
        tight = replace(
            cabinet,
            inner_resistance=cabinet.outer_resistance * (1.0 / rho - 1.0),
            heat_capacity=cabinet.heat_capacity * through * rho / cabinet.outer_resistance,
        )
        columns.append((bare_run(tight, drivers).cabinet_K - self.bare.cabinet_K) / -0.01)
        return np.column_stack([self._pick(column) for column in columns])

    def _hygric(self, scene: Scene) -> np.ndarray:
        """Columns: derivative by log k, and what both humidity sensors' offsets make of the error."""
        cabinet, drivers, bare = scene.cabinet, scene.drivers, self.bare
        slow = replace(cabinet, gap=cabinet.gap / 1.05)
        slower = (bare_run(slow, drivers).cabinet_kg_m3 - bare.cabinet_kg_m3) / math.log(1.05)
        inside = concentration(saturation_pressure(bare.cabinet_K), bare.cabinet_K)
        outside = concentration(saturation_pressure(drivers.ambient_K), drivers.ambient_K)
        lag_h = cabinet.hygric_h(float(bare.cabinet_K.mean()), float(drivers.ambient_K.mean()))
        outside = low_pass(outside, scene.step_s / 3600.0, lag_h) * drivers.ambient_K / bare.cabinet_K
        return np.column_stack([self._pick(column) for column in (slower, inside, outside)])

    def _refit(self, which: int, error: np.ndarray) -> np.ndarray:
        return _least(self.basis[which], error, self.bounds[which])

    def errors(self, drivers: Drivers, trajectory: Trajectory) -> Errors:
        """Errors of the bare model against what is seen of drivers and states."""
        bare = bare_run(self.cabinet, drivers)
        raw = (
            self._pick(trajectory.cabinet_K - bare.cabinet_K),
            self._pick(trajectory.cabinet_kg_m3 - bare.cabinet_kg_m3),
        )
        return Errors(raw, (self._refit(0, raw[0]), self._refit(1, raw[1])))

    def noncentrality(
        self, without: Errors, with_cause: Errors, noise: tuple[float, float]
    ) -> tuple[float, float]:
        """Noncentrality of the likelihood ratio for both quantities, if everything else were known.

        The cause's mark on the readings, whitened by an autoregression of the error without it
        plus sensor noise [K], [kg/m3], refitted, squared and summed.
        """
        numbers = []
        for which in range(2):
            mark = with_cause.raw[which] - without.raw[which]
            weights, variance = _autoregression(without.left[which], noise[which])
            white = np.column_stack(
                [np.convolve(column, weights, "valid") for column in (mark, *self.basis[which].T)]
            )
            left = _least(white[:, 1:], white[:, 0], self.bounds[which])
            numbers.append(float(left @ left / variance))
        return numbers[0], numbers[1]


def _least(basis: np.ndarray, target: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """What least squares with coefficients within their bounds leaves of a target."""
    scale = np.abs(basis).max(axis=0)
    orthogonal, upper = np.linalg.qr(basis / scale)
    limit = bound * scale
    found = lsq_linear(upper, orthogonal.T @ target, bounds=(-limit, limit), method="bvls")
    return target - basis @ (found.x / scale)


def _autoregression(values: np.ndarray, noise: float, order: int = 24) -> tuple[np.ndarray, float]:
    """Filter (order + 1,) that whitens a series with added white noise, and the variance it leaves."""
    values = values - values.mean()
    size = values.size
    moments = np.array([values[lag:] @ values[: size - lag] for lag in range(order + 1)]) / size
    moments[0] += noise**2
    gains = solve_toeplitz(moments[:-1], moments[1:])
    return np.concatenate(([1.0], -gains)), float(moments[0] - gains @ moments[1:])


def growth(errors: Errors, without: Errors, quantities: tuple[str, ...] = QUANTITIES) -> tuple[float, str]:
    """Growth of the error in the quantity where it grows most [-], and that quantity.

    A plant without disturbances is measured as if they were of their usual size and independent.
    """
    grown = []
    for now, before, usual in zip(errors.size, without.size, _USUAL, strict=True):
        grown.append(now / before - 1.0 if before > 1e-3 * usual else math.hypot(now / usual, 1.0) - 1.0)
    which = max((QUANTITIES.index(name) for name in quantities), key=grown.__getitem__)
    return grown[which], QUANTITIES[which]


def find_amplitude(
    grows: Callable[[float], float], low: float, high: float, wanted: float, tries: int = 11
) -> tuple[float, bool]:
    """Amplitude at which the error grows as wanted, and whether it misses by a tenth and more.

    grows: growth at an amplitude. Chords and halvings on the logarithm, to 3 % of what is wanted.
    """
    at_high = grows(high) - wanted
    if at_high <= 0.0:
        return high, abs(at_high) > 0.1 * wanted
    start = max(low, 1e-3 * high)
    at_low = grows(start) - wanted
    if at_low >= 0.0:
        return start, abs(at_low) > 0.1 * wanted
    left, right = math.log(start), math.log(high)
    best, off = high, at_high
    for turn in range(tries):
        # A chord where the growth is nearly straight, the middle where it is not.
        chord = (left * at_high - right * at_low) / (at_high - at_low)
        middle = chord if turn % 2 == 0 else 0.5 * (left + right)
        value = grows(math.exp(middle)) - wanted
        if abs(value) < abs(off):
            best, off = math.exp(middle), value
        if abs(off) < 0.03 * wanted:
            break
        if value > 0.0:
            right, at_high = middle, value
        else:
            left, at_low = middle, value
    # Growth that jumps (a further door, a further cycle of a fan) may step over what is wanted.
    return best, abs(off) > 0.1 * wanted
