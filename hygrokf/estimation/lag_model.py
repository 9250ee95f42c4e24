"""A first-order lag model, and its likelihood for every shift of its inputs at once.

The temperature or the vapour of the cabinet is a constant plus shares of the ambient value, direct and
lagged, and of the other inputs, lagged.  All inputs have the same first-order lag, and the residuals are a
second-order autoregression:

    y(t) = c + a u₀(t) + Σ bᵢ L uᵢ(t) + e(t),    e(t) = φ₁ e(t−1) + φ₂ e(t−2) + N(0, σ²).

With the lag and φ fixed the model is linear, and a shift of an input only shifts the input's columns: the
normal equations of all shifts consist of correlations, which one fast Fourier transform gives together.

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
"""[s] step of the grid on which records are compared."""
LARGEST_SHIFT = 56
"""Quarters of an hour of the largest shift, 14 h: the widest difference between two time zones in use."""
LAGS_H = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 24.0)
FEWEST_QUARTERS = 14 * 96
"""Quarters of an hour in common, 14 days, below which nothing is compared."""
MOST_QUARTERS = 120 * 96
"""Largest number of quarters of an hour compared; longer records say no more about a clock."""
PIECE = 1024 - 2 * LARGEST_SHIFT
"""Length [quarters of an hour] of the pieces over which correlations are summed."""
_SUBDIVISIONS = 3  # interpolated values of each quarter, of which the mean is taken
_BRIDGE_H = 3.0  # longest gap that is interpolated
_RIDGE = 1e-8  # keeps collinear columns solvable
_LEAST_VARIANCE_SHARE = 1e-9
"""Least residual variance as a share of the target's; a smaller residual variance is rounding."""


@dataclass(frozen=True)
class Relation:
    """A quantity of the cabinet and its inputs, as means over quarters of an hour.

    name: "temperature" or "vapour". time: (N,) [s] middles of the quarters. target: (N,) the cabinet's
    quantity minus its mean; 0 where there is no reading. every: quarters between two readings. rows: (N,)
    whether a quarter is compared: its target, the two targets `every` and twice `every` earlier, and all
    inputs are present.
    inputs: signal -> standardised columns (N, c); the first column of an ambient signal also acts direct.
    sources: the file, and so the clock, of each input; source: the target's file.
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
        return {
            lag_h: {signal: _lagged(signal, columns, lag_h) for signal, columns in self.inputs.items()}
            for lag_h in LAGS_H
        }

    def whitened(self, values: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """Values (N, ...) minus their prediction by the autoregression φ (2,)."""
        every = self.every
        result = values.copy()
        result[every:] -= phi[0] * values[:-every]
        result[2 * every :] -= phi[1] * values[: -2 * every]
        return result


def _lagged(signal: str, columns: np.ndarray, lag_h: float) -> np.ndarray:
    """Columns (N, c) of an input after a lag [h]; an ambient input's first column is also there unlagged."""
    decay = math.exp(-QUARTER_S / HOUR_S / lag_h)
    lagged = np.vstack([columns[:1], (1.0 - decay) * columns[1:]])
    width = 1
    while width < len(lagged):  # each pass doubles the number of earlier quarters in the sum Σ decayⁱ xₖ₋ᵢ
        lagged[width:] += decay**width * lagged[:-width]
        width *= 2
    return np.hstack([columns[:, :1], lagged]) if signal.startswith("ambient_") else lagged


def relations(record: Record) -> tuple[Relation, ...]:
    """The relations of a record's temperature and vapour, each where its data span at least 14 days."""
    if not {"cabinet_temperature", "ambient_temperature"} <= set(record.signals):
        return ()
    candidates = [_relation("temperature", record["cabinet_temperature"], _heat_inputs(record))]
    prepared = prepare(record)
    inside, outside = prepared.cabinet_vapour, prepared.ambient_vapour
    if inside is not None and outside is not None:
        candidates.append(_relation("vapour", inside, {"ambient_absolute_humidity": [outside]}))
    return tuple(relation for relation in candidates if relation is not None)


def _heat_inputs(record: Record) -> dict[str, list[Series]]:
    """The inputs of the temperature, each as one or several series: power as its share of the largest
    reading, the square of this share, and 1 in operation."""
    inputs: dict[str, list[Series]] = {}
    for series in record.series:
        if len(series.known[0]) < 2:
            continue
        if series.signal == "active_power":
            largest = float(np.nanmax(np.abs(series.value), initial=1.0))
            share = series.value / largest
            operating = np.where(series.missing, np.nan, (share > 0.0).astype(float))
            inputs[series.signal] = [replace(series, value=v) for v in (share, share**2, operating)]
        elif series.signal in _HEAT_INPUTS or series.signal.endswith("_duty"):
            inputs[series.signal] = [series]
    return inputs


_HEAT_INPUTS = ("ambient_temperature", "global_horizontal_irradiance", "wind_speed")


def _relation(name: str, target: Series, inputs: Mapping[str, list[Series]]) -> Relation | None:
    """The relation of a target and its inputs by means over quarters of an hour, where all of them overlap.

    None where they overlap for less than `FEWEST_QUARTERS`, or where nothing varies.
    """
    known_times = [times.known[0] for times in (target, *(group[0] for group in inputs.values()))]
    if any(len(times) < 2 for times in known_times):
        return None
    first = math.ceil(max(times[0] for times in known_times) / QUARTER_S) * QUARTER_S
    count = int((min(times[-1] for times in known_times) - first) // QUARTER_S)
    if count < FEWEST_QUARTERS:
        return None
    # of a long record, only the middle is compared
    spare = max(count - MOST_QUARTERS, 0)
    first, count = first + spare // 2 * QUARTER_S, count - spare
    every = max(1, round(modal_step(target.known[0])[0] / QUARTER_S))
    value, is_present = _means(target, first, count)
    if every > 1:  # a quarter counts only where a reading falls into it
        is_present &= np.isin(np.arange(count), (centred(target).known[0] - first) // QUARTER_S)
    rows, columns = is_present.copy(), {}
    for signal, group in inputs.items():
        means = [_means(times, first, count) for times in group]
        rows &= means[0][1]
        filled = np.column_stack([_standardise(*times) for times in means])
        if len(kept := np.flatnonzero(filled.std(axis=0) > 0.0)):
            columns[signal] = filled[:, kept]
    rows[: LARGEST_SHIFT + 2 * every] = rows[count - LARGEST_SHIFT :] = False
    for offset in (every, 2 * every):
        rows[offset:] &= is_present[:-offset]
    if rows.sum() * every < FEWEST_QUARTERS // 2 or not columns or not np.ptp(value[is_present]) > 0.0:
        return None
    return Relation(
        name,
        first + QUARTER_S * (np.arange(count) + 0.5),
        np.where(is_present, value - value[is_present].mean(), 0.0),
        rows,
        every,
        columns,
        {signal: inputs[signal][0].file for signal in columns},
        target.file,
    )


def _means(series: Series, first: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Means over quarters of an hour (N,), and whether each is known."""
    fine = first + QUARTER_S / _SUBDIVISIONS * (np.arange(count * _SUBDIVISIONS) + 0.5)
    value = at_times(input_path(series), fine, bridge_h(series, _BRIDGE_H))
    value = value.reshape(count, _SUBDIVISIONS).mean(axis=1)
    return value, np.isfinite(value)


def _standardise(value: np.ndarray, is_present: np.ndarray) -> np.ndarray:
    """Values (N,) with gaps bridged by straight lines, mean 0 and standard deviation 1; zeros if constant."""
    indices = np.flatnonzero(is_present)
    filled = (
        np.interp(np.arange(len(value)), indices, value[indices]) if len(indices) else np.zeros(len(value))
    )
    spread = float(filled.std())
    return (filled - filled.mean()) / spread if spread > 1e-9 * np.abs(filled).max() else np.zeros(len(value))


# -- the likelihood of one shift, and of all shifts ----------------------------------------------------------
Move = tuple[frozenset[str], int]
"""Inputs that are shifted together, and the additional shift [quarters of an hour] in summer time."""


def shift_columns(columns: np.ndarray, quarters: int, summer: np.ndarray, more: int) -> np.ndarray:
    """Columns (N, c) shifted later by `quarters` of an hour, and by another `more` where `summer` (N,)."""
    result = np.roll(columns, quarters, axis=0)
    return np.where(summer[:, None], np.roll(columns, quarters + more, axis=0), result) if more else result


def fit_autoregression(
    relation: Relation,
    lag_h: float,
    move: Move = (frozenset(), 0),
    quarters: int = 0,
    summer: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fit a relation at one lag [h], with the inputs of `move` shifted by `quarters` of an hour.

    summer: (N,) True in summer time.  Least squares of the inputs and of the autoregression alternate.

    Returns φ (2,), and each row's ln L (N,), 0 in rows that are not compared.
    """
    inputs, more = move
    is_summer = np.zeros(len(relation.time), dtype=bool) if summer is None else summer
    columns = relation.columns[lag_h]
    shifted = [
        shift_columns(matrix, quarters, is_summer, more) if signal in inputs else matrix
        for signal, matrix in columns.items()
    ]
    x = np.hstack([np.ones((len(relation.time), 1)), *shifted])
    y, rows, every = relation.target, relation.rows, relation.every
    phi = np.array([0.9, 0.0])
    for _ in range(4):
        wx, wy = relation.whitened(x, phi)[rows], relation.whitened(y, phi)[rows]
        products = wx.T @ wx
        products[np.diag_indices_from(products)] *= 1.0 + _RIDGE
        residual = y - x @ np.linalg.solve(products, wx.T @ wy)
        lagged_residuals = np.column_stack(
            [np.roll(residual, every)[rows], np.roll(residual, 2 * every)[rows]]
        )
        memory = lagged_residuals.T @ lagged_residuals
        memory[np.diag_indices_from(memory)] *= 1.0 + _RIDGE
        phi = np.linalg.solve(memory + 1e-300 * np.eye(2), lagged_residuals.T @ residual[rows])
    innovation = residual[rows] - lagged_residuals @ phi
    variance = max(
        float(innovation @ innovation) / len(innovation),
        _LEAST_VARIANCE_SHARE * float(y[rows] @ y[rows]) / len(innovation),
    )
    loglik = np.zeros(len(y))
    loglik[rows] = -0.5 * (math.log(variance) + innovation**2 / variance)
    return phi, loglik


def fit_without_shift(relation: Relation) -> tuple[np.ndarray, np.ndarray]:
    """`fit_autoregression` without a shift, at the lag of the largest likelihood."""
    return max((fit_autoregression(relation, lag_h) for lag_h in LAGS_H), key=lambda fit: float(fit[1].sum()))


def shift_logliks(
    relation: Relation, phi: np.ndarray, moves: set[Move], summer: np.ndarray
) -> dict[Move, np.ndarray]:
    """Compute ln L (K, H) of every shift of each move at every lag, with the autoregression φ (2,) fixed.

    The normal equations consist of correlations between shifted and unshifted columns.  Products of two
    shifted columns are correlated with the rows that are compared.
    """
    logliks = {move: np.empty((2 * LARGEST_SHIFT + 1, len(LAGS_H))) for move in moves}
    for column, lag_h in enumerate(LAGS_H):
        columns = relation.columns[lag_h]
        for move in moves:
            inputs, more = move
            unshifted = [matrix for signal, matrix in columns.items() if signal not in inputs]
            fixed = np.hstack([np.ones((len(relation.time), 1)), *unshifted])
            fixed[:, 1:] = relation.whitened(fixed[:, 1:], phi)
            shifted = np.hstack(
                [shift_columns(columns[signal], 0, summer, more) for signal in columns if signal in inputs]
            )
            logliks[move][:, column] = _all_shifts(relation, phi, fixed, relation.whitened(shifted, phi))
    return logliks


def _all_shifts(relation: Relation, phi: np.ndarray, fixed: np.ndarray, shifted: np.ndarray) -> np.ndarray:
    """Compute ln L (K,) of the linear model whose columns are `fixed` (N, a) and `shifted` (N, b), the latter
    moved by every shift; all columns are whitened.

    The normal equations of all shifts, `products` (K, a + b, a + b) and `with_target` (K, a + b), are put
    together from blocks: of fixed columns alike for all shifts, of the others from correlations.
    """
    rows = relation.rows.astype(float)
    target = relation.whitened(relation.target, phi) * rows
    fixed_count, masked = fixed.shape[1], fixed * rows[:, None]
    upper = np.triu_indices(shifted.shape[1])
    with_fixed = _correlations(np.column_stack([masked, target]), shifted)
    with_shifted = _correlations(rows[:, None], shifted[:, upper[0]] * shifted[:, upper[1]])[:, 0]
    products = np.empty((len(with_fixed), fixed_count + shifted.shape[1], fixed_count + shifted.shape[1]))
    products[:, :fixed_count, :fixed_count] = masked.T @ fixed
    products[:, :fixed_count, fixed_count:] = with_fixed[:, :fixed_count]
    products[:, fixed_count:, :fixed_count] = with_fixed[:, :fixed_count].transpose(0, 2, 1)
    products[:, fixed_count + upper[0], fixed_count + upper[1]] = products[
        :, fixed_count + upper[1], fixed_count + upper[0]
    ] = with_shifted
    with_target = np.hstack(
        [np.broadcast_to(target @ fixed, (len(with_fixed), fixed_count)), with_fixed[:, fixed_count]]
    )
    diagonal = np.einsum("kii->ki", products)
    diagonal *= 1.0 + _RIDGE
    explained = np.einsum(
        "ki,ki->k", np.linalg.solve(products, with_target[:, :, None])[:, :, 0], with_target
    )
    smallest_sse = _LEAST_VARIANCE_SHARE * float(relation.target**2 @ rows)
    count = rows.sum()
    return -0.5 * count * np.log(np.maximum(target @ target - explained, smallest_sse) / count) - 0.5 * count


def _correlations(columns: np.ndarray, shifted: np.ndarray) -> np.ndarray:
    """Correlations (K, a, b): Σ_t columns(t) shifted(t − shift) of columns (N, a) and shifted (N, b).

    The first and last `LARGEST_SHIFT` rows of `columns` must be 0.  The sum is taken over pieces of the
    record, because short Fourier transforms are faster.
    """
    count = -(-len(columns) // PIECE)
    padded = np.zeros((count * PIECE + 2 * LARGEST_SHIFT, columns.shape[1] + shifted.shape[1]))
    padded[LARGEST_SHIFT : LARGEST_SHIFT + len(columns)] = np.hstack([columns, shifted])
    pieces = sliding_window_view(padded, PIECE + 2 * LARGEST_SHIFT, axis=0)[
        ::PIECE
    ].copy()  # (pieces, a + b, t)
    pieces[:, : columns.shape[1], :LARGEST_SHIFT] = pieces[:, : columns.shape[1], -LARGEST_SHIFT:] = 0.0
    spectra = np.fft.rfft(pieces).transpose(2, 1, 0)
    first, second = np.split(spectra, [columns.shape[1]], axis=1)
    correlations = np.fft.irfft(first @ second.conj().transpose(0, 2, 1), PIECE + 2 * LARGEST_SHIFT, axis=0)
    return correlations[np.arange(-LARGEST_SHIFT, LARGEST_SHIFT + 1)]
