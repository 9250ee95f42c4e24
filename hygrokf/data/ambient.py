"""Ambient series at any time, the noise of their readings, and the smoothed course behind noisy readings.

Noisy readings used as an input attenuate the estimated effects, as errors in a regressor do: 0.05 K of noise
on the ambient temperature shifts the resistance ratio and the time constants by several times their standard
error.  The mean of the true course given all readings avoids this.  It is computed under a local level model,

    x(t+Δ) = x(t) + N(0, q Δ),    reading = x + N(0, r),

with a linear course between the smoothed values (`input_paths`).  r and q come from the autocovariances γ of
the readings' increments.  If the weather's own increments are equally correlated at lags 1 and 2, instants
have γ₁ − γ₂ = −r and γ₀ = q Δ + 2 r; means over intervals Δ have γ₀ − γ₂ = ⅔ q Δ + 2 r and γ₁ − γ₂ = ⅙ q Δ −
r.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hygrokf.data.input_paths import centred, without_response
from hygrokf.data.record import Record, Series
from hygrokf.data.signals import SIGNALS
from hygrokf.physics.holds import LINEAR, PREVIOUS
from hygrokf.physics.psychrometrics import absolute_humidity, absolute_humidity_from_dew_point

AMBIENT_BRIDGE_H = 6.0
"""[h] longest gap of the ambient series that is bridged linearly; readings in longer gaps are left out."""
MOST_VAPOUR = SIGNALS["ambient_absolute_humidity"].high
"""[kg/m³] limit of derived concentrations: a temperature in a wrong unit would yield impossible values, for
which a series raises ValueError."""
FEWEST_FOR_NOISE = 200
"""Number of readings below which no noise is estimated."""


def reading_noise(series: Series) -> tuple[float, float] | None:
    """Estimate the noise of a series' readings; None where that is impossible.

    Returns the variance q of the level's increments per second, and the variance r of a reading's noise.
    Short or irregular series, and means whose intervals are not adjacent, give None: they are not smoothed.
    """
    is_present = ~series.missing
    time, value = series.time[is_present], series.value[is_present]
    if len(time) < FEWEST_FOR_NOISE:
        return None
    step_s = np.diff(time)
    usual_step_s = float(np.median(step_s))
    is_regular = np.abs(step_s - usual_step_s) < 0.1 * usual_step_s
    if is_regular.sum() < FEWEST_FOR_NOISE // 2:
        return None
    increment = np.where(is_regular, np.diff(value), np.nan)
    # weather fronts are not noise: increments beyond eight times the usual spread are left out
    usual_spread = 1.4826 * float(np.nanmedian(np.abs(increment - np.nanmedian(increment))))
    if not usual_spread > 0:
        return None
    increment = np.where(np.abs(increment) < 8.0 * usual_spread, increment, np.nan)
    products = [increment[lag:] * increment[: len(increment) - lag] for lag in range(3)]
    if min(np.isfinite(product).sum() for product in products) < FEWEST_FOR_NOISE // 2:
        return None
    autocovariances = [float(np.nanmean(product)) for product in products]
    if series.interval_s > 0:
        if abs(series.interval_s - usual_step_s) > 0.01 * usual_step_s:
            return None
        level_variance = autocovariances[0] + 2.0 * autocovariances[1] - 3.0 * autocovariances[2]
        noise_variance = level_variance / 6.0 - (autocovariances[1] - autocovariances[2])
    else:
        noise_variance = autocovariances[2] - autocovariances[1]
        level_variance = autocovariances[0] - 2.0 * noise_variance
    # γ₁ and γ₂ each have the standard error γ₀/√T; the noise must exceed three standard errors
    if (
        noise_variance <= 3.0 * np.sqrt(2.0 / np.isfinite(increment).sum()) * autocovariances[0]
        or level_variance <= 0
    ):
        return None
    return level_variance / usual_step_s, noise_variance


def smoothed(series: Series, noise: tuple[float, float] | None) -> Series:
    """Return the series with its noise (q, r) removed: the expected course given all readings, at their
    times.

    Gaps remain.  Without noise, or unless the series is linear, it is returned unchanged.
    """
    if noise is None or series.hold != LINEAR:
        return series
    from scipy.linalg import solveh_banded

    is_present = ~series.missing
    time, value = series.time[is_present], series.value[is_present]
    if len(time) < 3:
        return series
    level_variance, noise_variance = noise
    coupling = noise_variance / (level_variance * np.diff(time))
    bands = np.zeros((2, len(time)))
    bands[1] = 1.0
    bands[1, :-1] += coupling
    bands[1, 1:] += coupling
    bands[0, 1:] = -coupling
    result = series.value.copy()
    result[is_present] = solveh_banded(bands, value)
    return replace(series, value=result)


def absolute_humidity_at(record: Record, place: str) -> Series | None:
    """Return the vapour concentration [kg/m³] in the "cabinet" or of the "ambient", at the times of its
    humidity readings.

    None without such readings.
    """
    name = f"{place}_absolute_humidity"
    if name in record:
        return without_response(record[name])
    for kind, convert in (
        ("relative_humidity", absolute_humidity),
        ("dew_point_temperature", absolute_humidity_from_dew_point),
    ):
        if {f"{place}_{kind}", f"{place}_temperature"} <= set(record.signals):
            series = without_response(record[f"{place}_{kind}"])
            temperature_series = centred(without_response(record[f"{place}_temperature"]))
            temperature = at_times(
                temperature_series, centred(series).time, bridge_h(temperature_series, AMBIENT_BRIDGE_H)
            )
            vapour = np.minimum(convert(series.value, temperature), MOST_VAPOUR)
            # properties of the sensor do not apply to the derived quantity
            series = replace(series, resolution=0.0, accuracy=None, response_time_s=None, saturated=0)
            return replace(series, signal=name, value=vapour)
    return None


def bridge_h(series: Series, limit_h: float) -> float:
    """Return the longest gap [h] of a series to bridge: `limit_h`, but at least 1.5 of its usual steps."""
    steps = series.steps_s
    if not len(steps):
        return limit_h
    return max(limit_h, (1.5 * middle(steps) - series.interval_s) / 3600.0)


def middle(ordered: np.ndarray) -> float:
    """Return the median of sorted numbers (n,), n ≥ 1; faster than numpy's for short arrays."""
    return 0.5 * float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])


def at_times(series: Series, time: np.ndarray, bridge_h: float) -> np.ndarray:
    """Return the values of a series at other times [s], according to its hold.

    NaN outside the series, in gaps longer than `bridge_h` [h], and where a held value is too old.
    """
    stamps, value = series.known
    if len(stamps) == 0:
        return np.full(len(time), np.nan)
    if series.hold == PREVIOUS:
        return series.held_at(time)
    is_linear = series.hold == LINEAR
    if is_linear:
        result = np.interp(time, stamps, value, left=np.nan, right=np.nan)
        if np.all(series.steps_s[-1:] <= bridge_h * 3600.0):  # most series have no gap
            return result
    following = np.minimum(stamps.searchsorted(time, side="left"), len(stamps) - 1)
    preceding = np.maximum(stamps.searchsorted(time, side="right") - 1, 0)
    if is_linear:
        in_gap = stamps[following] - stamps[preceding] > bridge_h * 3600.0
        return np.where(in_gap, np.nan, result)
    # a mean holds over (end − interval, end]; the previous value bridges a gap after it
    in_interval = (time > stamps[following] - max(series.interval_s, 1e-6)) & (time <= stamps[following])
    result = np.where(in_interval, value[following], value[preceding])
    gap_s = np.where(in_interval, 0.0, stamps[following] - series.interval_s - stamps[preceding])
    outside = (time > stamps[-1] + bridge_h * 3600.0) | (time <= stamps[0] - max(series.interval_s, 1e-6))
    return np.where((gap_s > bridge_h * 3600.0) | outside, np.nan, result)
