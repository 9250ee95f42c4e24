"""Known effects put into measured readings: real noise with a truth.

Plain numpy on arrays in SI units, so that attics and houses of which nobody has a model can carry
them. Missing readings (NaN) stay missing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from plants.saturation import concentration, saturation_pressure

HOUR_S = 3600.0
YEAR_S = 365.2425 * 86400.0
_PARTS = 6


def _filled(time_s: np.ndarray, value: np.ndarray) -> np.ndarray:
    known = np.isfinite(value)
    if not known.any():
        raise ValueError("no reading is known: nothing can be injected")
    return np.interp(time_s, time_s[known], value[known])


def clock_shift(time_s: np.ndarray, value: np.ndarray, *, minutes: float) -> tuple[np.ndarray, np.ndarray]:
    """Stamps that are late by so many minutes; give every series of one source the same."""
    return time_s + 60.0 * minutes, value.copy()


def humidity_drift(
    time_s: np.ndarray, value: np.ndarray, *, per_year: float, since_s: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Relative humidity [-] whose offset grows by `per_year` [1/a] from an instant on, within 0
    and 1.
    """
    begin = float(time_s[0]) if since_s is None else since_s
    passed = np.maximum(time_s - begin, 0.0) / YEAR_S
    return time_s.copy(), np.clip(value + per_year * passed, 0.0, 1.0)


def temperature_step(
    time_s: np.ndarray, value: np.ndarray, *, kelvin: float, date_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Temperature [K] that reads `kelvin` too high from a date [s] on."""
    return time_s.copy(), value + kelvin * (time_s >= date_s)


def sorption(
    time_s: np.ndarray,
    value: np.ndarray,
    *,
    kelvin: np.ndarray,
    capacity_kg_m3: float,
    time_constant_h: float,
    exchange_h: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Relative humidity [-] of air that shares its room with a first-order moisture buffer,
    within 0 and 1.

    kelvin: temperature of the air [K] at the same instants, (T,). capacity_kg_m3: [kg/m3] water
    stored between dry and saturated air, per volume of room. time_constant_h: [h] of the buffer.
    exchange_h: [h] of the room's air against the outside.

    tau dm/dt = capacity (phi + x / c_s(T)) - m,      dx/dt = -dm/dt - x / t_exchange

    with phi as measured and x the vapour [kg/m3] that the buffer adds to it; m starts in balance.
    Implicit steps: right for any interval of the readings, exact where it is short.
    """
    phi, warm = _filled(time_s, value), _filled(time_s, np.asarray(kelvin, dtype=float))
    dense = concentration(saturation_pressure(warm), warm)
    lag_s, mixing_s = HOUR_S * time_constant_h, HOUR_S * exchange_h
    water, extra = capacity_kg_m3 * phi[0], 0.0
    added = np.zeros(phi.size)
    for which in range(1, phi.size):
        step = float(time_s[which] - time_s[which - 1]) / _PARTS
        for part in range(1, _PARTS + 1):
            share = part / _PARTS
            humidity = phi[which - 1] + share * (phi[which] - phi[which - 1])
            full = dense[which - 1] + share * (dense[which] - dense[which - 1])
            gain, slope = step / lag_s, capacity_kg_m3 / full
            # Both balances at the end of the part, solved for the vapour that the buffer adds.
            free = (water + gain * capacity_kg_m3 * humidity) / (1.0 + gain)
            extra = (extra - free + water) / (1.0 + step / mixing_s + gain * slope / (1.0 + gain))
            water = free + gain * slope * extra / (1.0 + gain)
        added[which] = extra / dense[which]
    return time_s.copy(), np.clip(value + added, 0.0, 1.0)


EFFECTS: dict[str, Callable[..., tuple[np.ndarray, np.ndarray]]] = {
    "clock_shift": clock_shift,
    "humidity_drift": humidity_drift,
    "temperature_step": temperature_step,
    "sorption": sorption,
}


def inject(
    time_s: np.ndarray, value: np.ndarray, effect: str, **parameters: object
) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and values of a series with a known effect in it; the series given stays as it is.

    effect: one of `EFFECTS`, which say what parameters they take.
    """
    if effect not in EFFECTS:
        raise ValueError(f"effect must be one of {', '.join(EFFECTS)}, found {effect!r}")
    return EFFECTS[effect](np.asarray(time_s, dtype=float), np.asarray(value, dtype=float), **parameters)
