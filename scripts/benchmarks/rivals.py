"""The same log-likelihoods by other libraries' filters: what the package is compared with.

Each is a function without arguments that gives the log-likelihood; both agree with the package (tested).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from benchmarks.cases import STEP_H, VAPOUR, Case

LOG_2PI = math.log(2.0 * math.pi)
SONNTAG = (-6096.9385, 16.635794 + math.log(100.0), -2.711193e-2, 1.673952e-5, 2.433502)


# -- statsmodels: one thermal state --------------------------------------------------------------------------
def statsmodels_variants(case: Case) -> dict[str, Callable[[], float]]:
    """Log-likelihood of the thermal case by `statsmodels.tsa.statespace.kalman_filter.KalmanFilter`.

    Every variant sets the system's matrices for the parameters and filters; all are exact.  `loglike` keeps
    no moments (memory_conserve) in each.  "conventional": the default filter, inputs as a time-varying
    `state_intercept`; "univariate": Durbin and Koopman's univariate treatment of it, the fastest found;
    "response subtracted": the deterministic response is taken from the readings beforehand, which leaves a
    time-invariant system.  The symmetry enforcement, inversion method and filter timing move none of them by
    more than 3 %; the Chandrasekhar recursions take no missing readings, the collapsed filter is for more
    readings than states.
    """
    from scipy.signal import lfilter
    from statsmodels.tsa.statespace.kalman_filter import FILTER_CONVENTIONAL, FILTER_UNIVARIATE, KalmanFilter

    v, u = case.values, case.inputs
    reading = case.readings["cabinet_temperature"]
    ambient = u["ambient_temperature"]
    count = len(reading)

    def matrices() -> tuple[float, np.ndarray, float]:
        """Transition, intercepts (T,) to the next instant, noise: exact under the holds (ambient linear)."""
        a = STEP_H / v["thermal_time_constant"]
        factor = math.exp(-a)
        ramp = 1.0 - (1.0 - factor) / a
        release = v["heat_release_operation"] + v["heat_release_power_1"] * u["power_1"]
        intercept = np.zeros(count)
        intercept[:-1] = (
            (1.0 - factor - ramp) * ambient[:-1] + ramp * ambient[1:] + (1.0 - factor) * release[1:]
        )
        noise = 0.5 * v["thermal_diffusion"] ** 2 * v["thermal_time_constant"] * (1.0 - factor**2)
        return factor, intercept, noise

    def prepared(method: int) -> KalmanFilter:
        model = KalmanFilter(k_endog=1, k_states=1)
        model.bind(reading[:, None].copy())
        model["design", 0, 0] = model["selection", 0, 0] = 1.0
        model["obs_cov", 0, 0] = v["cabinet_temperature_noise"] ** 2
        model.set_filter_method(method)
        return model

    def with_intercept(method: int) -> Callable[[], float]:
        model = prepared(method)

        def loglike() -> float:
            factor, intercept, noise = matrices()
            model["transition", 0, 0], model["state_cov", 0, 0] = factor, noise
            model["obs_cov", 0, 0] = v["cabinet_temperature_noise"] ** 2
            model["state_intercept"] = intercept[None, :]
            model.initialize_known(ambient[:1] + 5.0, np.array([[25.0]]))
            return model.loglike()

        return loglike

    def subtracted() -> float:
        factor, intercept, noise = matrices()
        model = prepared(FILTER_UNIVARIATE)
        response = lfilter([1.0], [1.0, -factor], np.concatenate([ambient[:1] + 5.0, intercept[:-1]]))
        model.bind((reading - response)[:, None])
        model["transition", 0, 0], model["state_cov", 0, 0] = factor, noise
        model.initialize_known(np.zeros(1), np.array([[25.0]]))
        return model.loglike()

    return {
        "conventional": with_intercept(FILTER_CONVENTIONAL),
        "univariate": with_intercept(FILTER_UNIVARIATE),
        "response subtracted": subtracted,
    }


# -- filterpy: four states, two readings ---------------------------------------------------------------------
Moments = tuple[np.ndarray, np.ndarray, np.ndarray]


class JointStep:
    """One step of the joint case in numpy: next mean (4,), transition F (4, 4), noise Q (4, 4).

    The same sub-steps and Magnus step as the package's (docs/theory), written for this model by hand.
    States: converter temperature, heat disturbance, vapour, vapour disturbance.
    """

    def __init__(self, case: Case) -> None:
        v, u = case.values, case.inputs
        self.v = v
        self.parts = math.ceil(case.likelihood.steps_per_instant(v))
        self.ambient, self.vapour = u["ambient_temperature"], u["ambient_absolute_humidity"]
        self.factor = u["exchange_factor"]
        on = u["operating"]
        self.release = on * v["heat_release_operation"] + v["heat_release_power_1"] * u["power_1"]
        self.release = self.release + (1.0 - on) * v["heat_release_standstill"]
        self.noise = np.diag(
            [
                v["thermal_diffusion"] ** 2,
                2.0 * v["heat_disturbance_sd"] ** 2 / v["heat_disturbance_time"],
                v["hygric_diffusion"] ** 2,
                2.0 * v["vapour_disturbance_sd"] ** 2 / v["vapour_disturbance_time"],
            ]
        )

    def _rates(self, x: np.ndarray, kelvin: float, damp: float, factor: float, heat: float) -> np.ndarray:
        v = self.v
        ratio = v["resistance_ratio"]
        rate = (ratio * x[0] + (1.0 - ratio) * kelvin) * factor / v["hygric_k"]
        return np.array(
            [
                (kelvin - x[0] + (heat + x[1]) / ratio) / v["thermal_time_constant"],
                -x[1] / v["heat_disturbance_time"],
                rate * (damp - x[2] + x[3]),
                -x[3] / v["vapour_disturbance_time"],
            ]
        )

    def _jacobian(self, x: np.ndarray, kelvin: float, damp: float, factor: float) -> np.ndarray:
        v = self.v
        ratio, tau = v["resistance_ratio"], v["thermal_time_constant"]
        rate = (ratio * x[0] + (1.0 - ratio) * kelvin) * factor / v["hygric_k"]
        slope = ratio * factor / v["hygric_k"] * (damp - x[2] + x[3])
        return np.array(
            [
                [-1.0 / tau, 1.0 / (ratio * tau), 0.0, 0.0],
                [0.0, -1.0 / v["heat_disturbance_time"], 0.0, 0.0],
                [slope, 0.0, -rate, rate],
                [0.0, 0.0, 0.0, -1.0 / v["vapour_disturbance_time"]],
            ]
        )

    def __call__(self, k: int, x: np.ndarray) -> Moments:
        """The step from instant k−1 to k: sub-steps of equal length, chained."""
        transition, noise = np.eye(4), np.zeros((4, 4))
        for j in range(self.parts):
            x, f, q = self._sub_step(k, x, j / self.parts, STEP_H / self.parts)
            transition, noise = f @ transition, f @ noise @ f.T + q
        return x, transition, noise

    def _sub_step(self, k: int, x: np.ndarray, begin: float, h: float) -> Moments:
        """From the fraction `begin` of the step on for h [h]."""
        heat, levels = self.release[k], []

        def inputs(share: float) -> tuple[float, ...]:
            c = begin + share * h / STEP_H
            return tuple(s[k - 1] + c * (s[k] - s[k - 1]) for s in (self.ambient, self.vapour, self.factor))

        for share in (0.5 - math.sqrt(3.0) / 6.0, 0.5 + math.sqrt(3.0) / 6.0):
            half = x + 0.5 * share * h * self._rates(x, *inputs(0.0), heat)
            point = x + share * h * self._rates(half, *inputs(0.5 * share), heat)
            now = inputs(share)
            a = self._jacobian(point, *now)
            levels.append((a, self._rates(point, *now, heat) - a @ (point - x)))
        (a1, b1), (a2, b2) = levels
        correction = math.sqrt(3.0) / 12.0 * h * h
        slope = (b2 - b1) * (math.sqrt(3.0) / h)
        level = 0.5 * (b1 + b2) - 0.5 * h * slope
        difference = a2 - a1
        omega = 0.5 * h * (a1 + a2) + correction * (a2 @ a1 - a1 @ a2)
        constant = h * level + correction * (difference @ level)
        linear = h * (h * slope + correction * (difference @ slope))
        spread = difference @ self.noise
        spread = h * self.noise + correction * (spread + spread.T)
        # e^Ω, φ₁ and φ₂ at work on the vectors, and the noise let in: their series, to rounding
        transition, power = np.eye(4), np.eye(4)
        one, two, term, noise = constant, 0.5 * linear, spread, spread
        mean = x + one + two
        for j in range(1, 12):  # to rounding
            power = power @ omega / j
            transition = transition + power
            one, two = omega @ one / (j + 1.0), omega @ two / (j + 2.0)
            mean = mean + one + two
            half = omega @ term / (j + 1.0)
            term = half + half.T
            noise = noise + term
        return mean, transition, noise


def joint_observation(case: Case, k: int, output: int, x: np.ndarray) -> tuple[float, np.ndarray, float]:
    """Prediction, its row of derivatives (4,) and the noise variance of one reading."""
    v = case.values
    ratio, outside = v["resistance_ratio"], case.inputs["ambient_temperature"][k]
    kelvin = ratio * x[0] + (1.0 - ratio) * outside
    if output == 0:
        row = np.array([ratio, 0.0, 0.0, 0.0])
        return kelvin + v["cabinet_temperature_bias"], row, v["cabinet_temperature_noise"] ** 2
    a, b, c, d, e = SONNTAG
    pressure = math.exp(a / kelvin + b + (c + d * kelvin) * kelvin + e * math.log(kelvin))
    slope = -a / kelvin**2 + c + 2.0 * d * kelvin + e / kelvin
    share = VAPOUR * outside / pressure
    humidity = x[2] * share
    row = np.array([-humidity * slope * ratio, 0.0, share, 0.0])
    return humidity + v["cabinet_relative_humidity_bias"], row, v["cabinet_relative_humidity_noise"] ** 2


def filterpy_loop(case: Case, count: int, step: Callable[[int, np.ndarray], Moments]) -> Callable[[], float]:
    """Log-likelihood of the joint case's first `count` instants by filterpy's extended Kalman filter.

    The Gaussian term is computed from the innovation and its variance (`.log_likelihood` is four times as
    slow as the whole update).  `step` gives next mean, F and Q; filterpy does the rest.
    """
    from filterpy.kalman import ExtendedKalmanFilter

    class Filter(ExtendedKalmanFilter):
        following: np.ndarray

        def predict_x(self, u: object = 0) -> None:
            self.x = self.following

    first = case.likelihood.first_state(case.values)
    readings = np.column_stack(list(case.readings.values()))[:count].tolist()
    covariance = np.zeros((4, 4))
    covariance[np.tril_indices(4)] = first[4:]
    covariance = covariance + np.tril(covariance, -1).T

    def loglike() -> float:
        f = Filter(dim_x=4, dim_z=1)
        f.x, f.P = first[:4].copy(), covariance.copy()
        total = 0.0
        for k in range(count):
            if k:
                f.following, f.F, f.Q = step(k, f.x)
                f.predict()
            for output, z in enumerate(readings[k]):
                if z == z:
                    shown, row, variance = joint_observation(case, k, output, f.x)
                    f.update(
                        np.array([z]),
                        lambda x, row=row: row[None, :],
                        lambda x, s=shown: np.array([s]),
                        R=variance,
                    )
                    s, y = float(f.S[0, 0]), float(f.y[0])
                    total -= 0.5 * (LOG_2PI + math.log(s) + y * y / s)
        return total

    return loglike


def remembered(case: Case, count: int) -> Callable[[int, np.ndarray], Moments]:
    """The steps of one run, kept: a loop over them spends its time in filterpy alone."""
    kept: list[Moments] = []
    real = JointStep(case)

    def keeping(k: int, x: np.ndarray) -> Moments:
        kept.append(real(k, x))
        return kept[-1]

    filterpy_loop(case, count, keeping)()
    return lambda k, x: kept[k - 1]


def package(case: Case, values: Mapping[str, float] | None = None) -> Callable[[], float]:
    """The package's own log-likelihood of a case."""
    at = dict(values or case.values)
    return lambda: case.likelihood.value(at)
