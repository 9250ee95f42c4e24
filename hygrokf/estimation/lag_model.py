"""A lag model of two parameters, and the likelihood of every shift of its inputs at once.

Temperature or vapour of the cabinet is a constant plus shares of the ambient value, now and lagged, and of
the other inputs, lagged; one first-order lag serves all, and the residuals are a second-order autoregression:

    y(t) = c + a u₀(t) + Σ bᵢ L uᵢ(t) + e(t),    e(t) = φ₁ e(t−1) + φ₂ e(t−2) + N(0, σ²).

With the lag and φ fixed the model is linear, and shifts of an input only shift its columns: the products of
least squares for all shifts are correlations, which fast Fourier transforms give together.

Shapes: N quarters of an hour, K = 2 REACH + 1 shifts, H lags.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hygrokf.data.ambient import at_times, bridge_h
from hygrokf.data.input_paths import centred, input_path
from hygrokf.data.prepared import prepare
from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import HOUR_S, modal_step

QUARTER_S = 900.0
"""[s] the grid."""
REACH = 56
"""Quarters of an hour of the largest shift, 14 h: the widest difference between two time zones in use."""
LAGS_H = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 24.0)
FEWEST = 14 * 96
"""Quarters of an hour in common, 14 days, below which nothing is compared."""
LONGEST = 120 * 96
"""Quarters of an hour that are compared at most; more would tell no more about a clock."""
PIECE = 1024 - 2 * REACH
"""Quarters of an hour of the pieces over which correlations are summed."""
_FINE = 3
_BRIDGE_H = 3.0
_RIDGE = 1e-8
_EXACT = 1e-9
"""Share of the target's variance below which what is left is rounding."""


@dataclass(frozen=True)
class Relation:
    """What the cabinet shows and what drives it, as means over quarters of an hour.

    name: "temperature" or "vapour". time: (N,) [s] middles of the quarters. target: (N,) less its mean; 0
    where there is no reading. rows: (N,) whether a quarter is compared, and the two before it, `every` apart,
    are known.
    inputs: signal -> columns (N, c), standardised, the first of them direct where it is ambient.
    sources: clock of each input; source: that of the target.
    """

    name: str
    time: np.ndarray
    target: np.ndarray
    rows: np.ndarray
    every: int
    inputs: Mapping[str, np.ndarray]
    sources: Mapping[str, str]
    source: str

    @cached_property
    def columns(self) -> dict[float, dict[str, np.ndarray]]:
        """The columns of each input under each lag [h]."""
        return {lag_h: {s: _lagged(s, one, lag_h) for s, one in self.inputs.items()} for lag_h in LAGS_H}

    def whitened(self, values: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """Values (N, ...) less their prediction by the autoregression."""
        every = self.every
        result = values.copy()
        result[every:] -= phi[0] * values[:-every]
        result[2 * every :] -= phi[1] * values[: -2 * every]
        return result


def _lagged(signal: str, columns: np.ndarray, lag_h: float) -> np.ndarray:
    """Columns (N, c) of an input under a lag [h], the first of an ambient one also direct."""
    keep = math.exp(-QUARTER_S / HOUR_S / lag_h)
    lagged = np.vstack([columns[:1], (1.0 - keep) * columns[1:]])
    reach = 1
    while reach < len(lagged):  # Σ keepⁱ of twice as many quarters each time
        lagged[reach:] += keep**reach * lagged[:-reach]
        reach *= 2
    return np.hstack([columns[:, :1], lagged]) if signal.startswith("ambient_") else lagged


def relations(record: Record) -> tuple[Relation, ...]:
    """The relations of a record that span at least 14 days: of its temperature, of its vapour."""
    if not {"cabinet_temperature", "ambient_temperature"} <= set(record.signals):
        return ()
    made = [_relation("temperature", record["cabinet_temperature"], _heat_inputs(record))]
    prepared = prepare(record)
    inside, outside = prepared.cabinet_vapour, prepared.ambient_vapour
    if inside is not None and outside is not None:
        made.append(_relation("vapour", inside, {"ambient_absolute_humidity": [outside]}))
    return tuple(one for one in made if one is not None)


def _heat_inputs(record: Record) -> dict[str, list[Series]]:
    found: dict[str, list[Series]] = {}
    for one in record.series:
        if len(one.known[0]) < 2:
            continue
        if one.signal == "active_power":
            top = float(np.nanmax(np.abs(one.value), initial=1.0))
            share = one.value / top
            operating = np.where(one.missing, np.nan, (share > 0.0).astype(float))
            found[one.signal] = [replace(one, value=v) for v in (share, share**2, operating)]
        elif one.signal in _HEAT_INPUTS or one.signal.endswith("_duty"):
            found[one.signal] = [one]
    return found


_HEAT_INPUTS = ("ambient_temperature", "global_horizontal_irradiance", "wind_speed")


def _relation(name: str, target: Series, inputs: Mapping[str, list[Series]]) -> Relation | None:
    known = [one.known[0] for one in (target, *(group[0] for group in inputs.values()))]
    if any(len(one) < 2 for one in known):
        return None
    first = math.ceil(max(one[0] for one in known) / QUARTER_S) * QUARTER_S
    count = int((min(one[-1] for one in known) - first) // QUARTER_S)
    if count < FEWEST:
        return None
    # the middle of a long record
    spare = max(count - LONGEST, 0)
    first, count = first + spare // 2 * QUARTER_S, count - spare
    every = max(1, round(modal_step(target.known[0])[0] / QUARTER_S))
    value, there = _means(target, first, count)
    if every > 1:  # once a reading
        there &= np.isin(np.arange(count), (centred(target).known[0] - first) // QUARTER_S)
    rows, columns = there.copy(), {}
    for signal, group in inputs.items():
        means = [_means(one, first, count) for one in group]
        rows &= means[0][1]
        filled = np.column_stack([_standardised(*one) for one in means])
        if len(kept := np.flatnonzero(filled.std(axis=0) > 0.0)):
            columns[signal] = filled[:, kept]
    rows[: REACH + 2 * every] = rows[count - REACH :] = False
    for before in (every, 2 * every):
        rows[before:] &= there[:-before]
    if rows.sum() * every < FEWEST // 2 or not columns or not np.ptp(value[there]) > 0.0:
        return None
    return Relation(
        name,
        first + QUARTER_S * (np.arange(count) + 0.5),
        np.where(there, value - value[there].mean(), 0.0),
        rows,
        every,
        columns,
        {signal: inputs[signal][0].file for signal in columns},
        target.file,
    )


def _means(series: Series, first: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Means over quarters of an hour (N,), and where they are known."""
    fine = first + QUARTER_S / _FINE * (np.arange(count * _FINE) + 0.5)
    value = at_times(input_path(series), fine, bridge_h(series, _BRIDGE_H)).reshape(count, _FINE).mean(axis=1)
    return value, np.isfinite(value)


def _standardised(value: np.ndarray, there: np.ndarray) -> np.ndarray:
    place = np.flatnonzero(there)
    filled = np.interp(np.arange(len(value)), place, value[place]) if len(place) else np.zeros(len(value))
    spread = float(filled.std())
    return (filled - filled.mean()) / spread if spread > 1e-9 * np.abs(filled).max() else np.zeros(len(value))


# -- one likelihood, and those of all shifts ----------------------------------------------------------------
Move = tuple[frozenset[str], int]
"""Inputs that are shifted together, and by how many more quarters of an hour in summer time."""


def moved(columns: np.ndarray, quarters: int, summer: np.ndarray, more: int) -> np.ndarray:
    """Columns (N, c) stamped later by some quarters of an hour, and by `more` in summer (N,)."""
    result = np.roll(columns, quarters, axis=0)
    return np.where(summer[:, None], np.roll(columns, quarters + more, axis=0), result) if more else result


def fitted(
    relation: Relation,
    lag_h: float,
    move: Move = (frozenset(), 0),
    quarters: int = 0,
    summer: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """φ (2,) and ln L (N,) of each row, 0 where none is compared, at a lag [h] with some inputs shifted.

    Least squares and the autoregression take turns.
    """
    inputs, more = move
    season = np.zeros(len(relation.time), dtype=bool) if summer is None else summer
    columns = relation.columns[lag_h]
    shifted = [
        moved(one, quarters, season, more) if signal in inputs else one for signal, one in columns.items()
    ]
    x = np.hstack([np.ones((len(relation.time), 1)), *shifted])
    y, rows, every = relation.target, relation.rows, relation.every
    phi = np.array([0.9, 0.0])
    for _ in range(4):
        wx, wy = relation.whitened(x, phi)[rows], relation.whitened(y, phi)[rows]
        products = wx.T @ wx
        products[np.diag_indices_from(products)] *= 1.0 + _RIDGE
        residual = y - x @ np.linalg.solve(products, wx.T @ wy)
        past = np.column_stack([np.roll(residual, every)[rows], np.roll(residual, 2 * every)[rows]])
        memory = past.T @ past
        memory[np.diag_indices_from(memory)] *= 1.0 + _RIDGE
        phi = np.linalg.solve(memory + 1e-300 * np.eye(2), past.T @ residual[rows])
    error = residual[rows] - past @ phi
    variance = max(float(error @ error) / len(error), _EXACT * float(y[rows] @ y[rows]) / len(error))
    each = np.zeros(len(y))
    each[rows] = -0.5 * (math.log(variance) + error**2 / variance)
    return phi, each


def declared(relation: Relation) -> tuple[np.ndarray, np.ndarray]:
    """`fitted` without a shift, at the lag of the largest likelihood."""
    return max((fitted(relation, lag_h) for lag_h in LAGS_H), key=lambda one: float(one[1].sum()))


def shift_logliks(
    relation: Relation, phi: np.ndarray, moves: set[Move], summer: np.ndarray
) -> dict[Move, np.ndarray]:
    """ln L (K, H) of every shift of each move under every lag, at one autoregression.

    The products of least squares are correlations of shifted with unshifted columns; those among shifted
    columns are correlations of their products with the rows that are compared.
    """
    found = {move: np.empty((2 * REACH + 1, len(LAGS_H))) for move in moves}
    for place, lag_h in enumerate(LAGS_H):
        columns = relation.columns[lag_h]
        for move in moves:
            inputs, more = move
            still = [one for signal, one in columns.items() if signal not in inputs]
            fixed = np.hstack([np.ones((len(relation.time), 1)), *still])
            fixed[:, 1:] = relation.whitened(fixed[:, 1:], phi)
            going = np.hstack([moved(one, 0, summer, more) for s, one in columns.items() if s in inputs])
            found[move][:, place] = _all_shifts(relation, phi, fixed, relation.whitened(going, phi))
    return found


def _all_shifts(relation: Relation, phi: np.ndarray, fixed: np.ndarray, going: np.ndarray) -> np.ndarray:
    """ln L (K,) with the columns `going` at every shift beside the `fixed` ones."""
    rows = relation.rows.astype(float)
    target = relation.whitened(relation.target, phi) * rows
    kept, still = fixed.shape[1], fixed * rows[:, None]
    upper = np.triu_indices(going.shape[1])
    against = _correlations(np.column_stack([still, target]), going)
    among = _correlations(rows[:, None], going[:, upper[0]] * going[:, upper[1]])[:, 0]
    products = np.empty((len(against), kept + going.shape[1], kept + going.shape[1]))
    products[:, :kept, :kept] = still.T @ fixed
    products[:, :kept, kept:] = against[:, :kept]
    products[:, kept:, :kept] = against[:, :kept].transpose(0, 2, 1)
    products[:, kept + upper[0], kept + upper[1]] = products[:, kept + upper[1], kept + upper[0]] = among
    aims = np.hstack([np.broadcast_to(target @ fixed, (len(against), kept)), against[:, kept]])
    diagonal = np.einsum("kii->ki", products)
    diagonal *= 1.0 + _RIDGE
    explained = np.einsum("ki,ki->k", np.linalg.solve(products, aims[:, :, None])[:, :, 0], aims)
    least = _EXACT * float(relation.target**2 @ rows)
    number = rows.sum()
    return -0.5 * number * np.log(np.maximum(target @ target - explained, least) / number) - 0.5 * number


def _correlations(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Σ one(t) other(t − shift) of columns (N, a) and (N, b), (K, a, b); the first are 0 within a reach of
    both ends.

    The sum is taken over pieces of the record: what is within reach of a piece is short to transform.
    """
    count = -(-len(one) // PIECE)
    padded = np.zeros((count * PIECE + 2 * REACH, one.shape[1] + other.shape[1]))
    padded[REACH : REACH + len(one)] = np.hstack([one, other])
    pieces = sliding_window_view(padded, PIECE + 2 * REACH, axis=0)[::PIECE].copy()  # (pieces, a + b, t)
    pieces[:, : one.shape[1], :REACH] = pieces[:, : one.shape[1], -REACH:] = 0.0
    spectra = np.fft.rfft(pieces).transpose(2, 1, 0)
    first, second = np.split(spectra, [one.shape[1]], axis=1)
    found = np.fft.irfft(first @ second.conj().transpose(0, 2, 1), PIECE + 2 * REACH, axis=0)
    return found[np.arange(-REACH, REACH + 1)]
