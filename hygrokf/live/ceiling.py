"""The filter where a humidity sensor is at its ceiling: the reading then says how moist the air is at least, not how moist.

A reading at the ceiling c is censored: all that it tells is that the sensor would show y ≥ c.  With the prediction ŷ of
the reading and its variance S, z = (c − ŷ)/√S and λ = φ(z)/Φ(−z), the moments of y given that are
    E y = ŷ + λ √S,    var y = S (1 − δ),    δ = λ (λ − z),  between 0 and 1,
and those of the state follow from them by the gain K of an ordinary reading:
    m + K (E y − ŷ),   P − δ K S K'.
So a censored reading moves the mean as its own expectation would, and the covariance by the share δ of a reading.  The
Gaussian with these moments is the one that the filter goes on with (the Tobit Kalman filter; Allik et al. 2016,
doi:10.1109/TCST.2015.2432155; moments of a truncated normal distribution: Tobin 1958).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hygrokf.data.masks import SATURATED
from hygrokf.engine.timeline import Timeline
from hygrokf.estimation.likelihood import Gaussian, Likelihood, Trace

HUMIDITY = "cabinet_relative_humidity"


def filtered(likelihood: Likelihood, values: Mapping[str, float], start: Gaussian | None = None) -> Trace:
    """The filter's trace where relative humidity from `SATURATED` on is censored, from a state or from the prior.

    A stretch may be filtered in pieces: each goes on, bit for bit, where the one before it ended.
    """
    t = likelihood.timeline
    places = np.flatnonzero(t.reading(HUMIDITY) >= SATURATED) if HUMIDITY in t.outputs else ()
    if not len(places):
        return likelihood.trace(values, start=start)
    found: list[Trace] = []
    first = 0
    for place in (*places, len(t)):
        if place > first:
            found.append(_on(likelihood, t.window(first, place)).trace(values, start=start))
            start = found[-1].last
        if place < len(t):
            found.append(_censored(_on(likelihood, t.window(place, place + 1)), values, start))
            start, first = found[-1].last, place + 1
    return _joined(found)


def _censored(likelihood: Likelihood, values: Mapping[str, float], start: Gaussian | None) -> Trace:
    """One instant whose reading of humidity is at the ceiling."""
    t = likelihood.timeline
    column = t.outputs.index(HUMIDITY)

    def read(humidity: float) -> Trace:
        y = t.y.copy()
        y[:, column] = humidity
        return _on(likelihood, t.with_readings(y)).trace(values, start=start)

    without = read(np.nan)
    prediction, spread = float(without.prediction[0, column]), float(np.sqrt(without.variance[0, column]))
    mean, share, chance = truncated((SATURATED - prediction) / spread)
    expected = read(prediction + mean * spread)

    def partly(unread: np.ndarray, whole: np.ndarray) -> np.ndarray:
        return unread + share * (whole - unread)

    return replace(
        without,
        mean=expected.mean,
        covariance=partly(without.covariance, expected.covariance),
        loglik=without.loglik + chance,
        last=replace(expected.last, covariance=partly(without.last.covariance, expected.last.covariance)),
    )


def truncated(z: float) -> tuple[float, float, float]:
    """λ, δ and ln Φ(−z): mean and 1 − variance of a standard normal number that is above z, and how likely it is to be."""
    from scipy.special import erfcx, log_ndtr

    mean = float(np.sqrt(2.0 / np.pi) / erfcx(z / np.sqrt(2.0)))
    # far above, the difference of two large numbers has no digits left
    return mean, float(np.clip(mean * (mean - z), 0.0, 1.0)), float(log_ndtr(-z))


def _on(likelihood: Likelihood, t: Timeline) -> Likelihood:
    return replace(likelihood, timeline=t)


def _joined(found: list[Trace]) -> Trace:
    """Pieces as one trace."""
    arrays = {
        name: np.concatenate([getattr(one, name) for one in found])
        for name, value in vars(found[0]).items()
        if isinstance(value, np.ndarray)
    }
    return Trace(**arrays, loglik=sum(one.loglik for one in found), last=found[-1].last)
