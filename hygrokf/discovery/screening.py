"""Screening: the largest gain of every setting of every form, first linearised and then simulated.

One simulation with a small effect gives the column (sensitivity) of a setting.  Whitened by the parent's
filter and projected off the parent's own columns, the column gives the linearised gain.  The linear ranking
is wrong for large effects, so that the best settings of a form are simulated at several sizes.

Shapes: T readings of a quantity, n settings, d parameters of the parent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hygrokf.data.shared_clocks import Shift
from hygrokf.discovery.error_model import filtered, loss
from hygrokf.discovery.estimate import Calibration, Columns, estimate_at, frame, slopes, weighted
from hygrokf.discovery.repeats import joined
from hygrokf.discovery.simulator import Simulator
from hygrokf.modelling.causes.forms import Form, MechanismSettings, Setting, Settings
from hygrokf.modelling.design import Design, extended
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.switches import CONTROLLED, Throttle

SMALL_SIZE = 0.1
"""Share of an effect's typical size at which its linear response is simulated."""
SIZES = (1.0, 2.5, 0.4, 6.0)
"""Multiples of the linearised amplitude at which the best settings are simulated."""
FOLLOWED_SETTINGS = 3
"""Number of settings of a form that are simulated, and of a cause that are fitted."""
LEAST_GAIN = 6.0
"""Gain in −2 ln L below which a setting is dropped."""
LIMIT_SHARE = 1e-3
"""Share of a coordinate's range within which a parameter is at its limit."""


@dataclass(frozen=True)
class Screened:
    """A setting of a form that is worth fitting, with start values of the form's parameters and its gain in
    −2 ln L."""

    form: Form
    setting: Setting
    values: Mapping[str, float]
    gain: float


@dataclass(frozen=True)
class Parent:
    """A fitted model to which causes are added, prepared for screening.

    basis: by quantity, orthonormal basis (T, d) of the whitened, weighted columns of its own parameters.
    error: (T,) whitened, weighted errors by quantity.
    columns: its Jacobian, by quantity and parameter.
    """

    estimate: Calibration
    basis: Mapping[str, np.ndarray]
    error: Mapping[str, np.ndarray]
    columns: Columns

    @cached_property
    def remaining_squares(self) -> dict[str, float]:
        """Sum of the squared errors that the parent's own parameters cannot explain, by quantity."""
        return {
            q: float((_orthogonal_part(basis, self.error[q]) ** 2).sum()) for q, basis in self.basis.items()
        }


def parent_of(estimate: Calibration, quantities: Sequence[str] | None = None) -> Parent:
    """Prepare an estimate for screening, in the given quantities (None: all).

    Parameters that are held at a limit by the gradient are left out of the basis.
    """
    coordinates = frame(estimate.simulator.parameters, set(estimate.simulator.names), estimate.linear)
    position = coordinates.coordinates(estimate.theta)
    margin = LIMIT_SHARE * (coordinates.upper - coordinates.lower)
    basis, error, columns_of = {}, {}, {}
    for q, columns in slopes(estimate, coordinates, quantities).items():
        columns_of[q] = {
            estimate.simulator.names[parameter_index]: columns[:, column]
            for column, parameter_index in enumerate(coordinates.place)
        }
        white, error[q] = weighted(estimate, q, columns)
        gradient = white.T @ error[q]
        is_held = ((position <= coordinates.lower + margin) & (gradient < 0.0)) | (
            (position >= coordinates.upper - margin) & (gradient > 0.0)
        )
        white = white[:, columns.any(axis=0) & ~is_held]
        scale = np.maximum(np.sqrt((white**2).sum(axis=0)), 1e-300)
        basis[q] = np.linalg.qr(white / scale)[0] if white.shape[1] else white
    return Parent(estimate, basis, error, columns_of)


def _orthogonal_part(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the columns (T, k) without their projections on an orthonormal basis (T, d)."""
    return columns - basis @ (basis.T @ columns)


def widened(parent: Calibration, form: Form, setting: Setting, own_inputs: tuple[str, ...] = ()) -> Simulator:
    """Return the parent's simulator, extended by a form of a cause at a setting.

    own_inputs: inputs that each run has of its own.
    """
    simulator = parent.simulator
    heat = _wider(simulator.heat, form.heat, setting.features)
    vapour = simulator.vapour
    if vapour is not None:
        if form.altered:
            altered_mechanisms = (
                (name, {**settings, **form.altered.get(name, {})}) for name, settings in vapour.mechanisms
            )
            vapour = replace(vapour, mechanisms=tuple(altered_mechanisms))
        vapour = _wider(vapour, form.vapour, setting.features)
        if form.freed:
            vapour = replace(vapour, priors={**vapour.priors, form.freed: (0.0, FREE[form.freed], False)})
    scene = simulator.scene
    if form.clock:
        scene = scene.moved(Shift(form.clock, setting.shift_s, form.summer))
    return Simulator(scene, heat, vapour, own_inputs, {**simulator.limits, **form.limits}, simulator.work)


def _wider(base: Design, additions: Sequence[MechanismSettings], features: Mapping[str, Settings]) -> Design:
    """Return a design extended by mechanisms, with the features that the extended model reads."""
    extended_design = extended(base, additions)
    model_inputs = set(extended_design.model.inputs)
    return replace(
        extended_design,
        features={
            **extended_design.features,
            **{name: settings for name, settings in features.items() if name in model_inputs},
        },
    )


FREE = {
    "breathed_gain": 0.3, "breathed_humidity_offset": 0.3, "humidity_scale_error": 0.3,
    "cabinet_temperature_offset": 5.0,
}  # fmt: skip
"""Standard deviation of the wide prior of a freed parameter, in the parameter's unit."""


def _freed(parent: Parent, form: Form) -> list[Screened]:
    """Return the gain of a form that only widens the prior of one of the parent's parameters; empty if it is
    small."""
    estimate = parent.estimate
    if form.freed not in estimate.simulator.names:
        return []
    index = estimate.simulator.names.index(form.freed)
    parameter = estimate.simulator.parameters[index]
    if parameter.prior is None or parameter.prior.sd >= FREE[form.freed]:
        return []
    gain = ((estimate.values[form.freed] - parameter.prior.mean) / parameter.prior.sd) ** 2
    for q in estimate.simulator.affects(form.freed):
        # the linearised gain beyond the limit that the sensor's accuracy sets
        white_column = weighted(estimate, q, parent.columns[q][form.freed][:, None])[0]
        remainder = _orthogonal_part(parent.basis[q], white_column)[:, 0]
        square_of_column = float(remainder @ remainder)
        gain += (
            float(remainder @ parent.error[q]) ** 2 / square_of_column
            if square_of_column > 1e-9 * float(white_column[:, 0] @ white_column[:, 0])
            else 0.0
        )
    return [Screened(form, form.grid[0], {}, gain)] if gain > LEAST_GAIN else []


def added(parent: Calibration, wider: Simulator) -> tuple[Parameter, ...]:
    """Return the parameters that a wider simulator has in addition to the parent's."""
    parent_names = set(parent.simulator.names)
    return tuple(p for p in wider.parameters if p.name not in parent_names)


def amplitudes(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Return the parameters that set the size of an effect: those with a null value."""
    return tuple(parameter for parameter in parameters if parameter.null is not None)


def size_of(parameter: Parameter) -> float:
    """Return a typical size of an effect: its parameter's start value minus its null value."""
    assert parameter.null is not None
    return (
        parameter.start - parameter.null
        if parameter.start != parameter.null
        else 0.01 * (parameter.upper - parameter.null)
    )


def start_values(parent: Calibration, wider: Simulator, setting: Setting) -> dict[str, float]:
    """Return start values of all parameters at a setting, with the amplitudes at their null values."""
    values = {p.name: p.start for p in added(parent, wider)} | parent.values
    values |= {p.name: p.null for p in amplitudes(added(parent, wider)) if p.null is not None}
    for name, settings in setting.features.items():
        if name in CONTROLLED and name in wider.controls:
            first, second = Throttle(**settings).levels
            values |= {f"{name}_first": first, f"{name}_second": second}
    return values | dict(setting.values)


def screened(parent: Parent, form: Form) -> list[Screened]:
    """Return the settings of a form with the largest gain in −2 ln L, at most `FOLLOWED_SETTINGS`, the best
    first.

    All settings are ranked by the linearised gain of a small effect; the best are simulated.
    """
    estimate = parent.estimate
    if form.clock:
        return _clocks(parent, form)
    if form.freed:
        return _freed(parent, form)
    if form.windows:
        return _windows(parent, form)
    varied_features = _varied(form)
    wider = widened(estimate, form, form.grid[0], varied_features)
    sizes = amplitudes(added(estimate, wider))
    if not sizes:
        return []
    start_values_of_settings = [start_values(estimate, wider, setting) for setting in form.grid]
    columns = {name: [wider.column(name, s.features[name]) for s in form.grid] for name in varied_features}
    small_changes = {p.name: SMALL_SIZE * size_of(p) for p in sizes}
    theta = np.column_stack(
        [wider.vector({**values, **_sized(sizes, small_changes)}) for values in start_values_of_settings]
    )
    gain, amplitude = (
        np.zeros(len(start_values_of_settings)),
        {p.name: np.zeros(len(start_values_of_settings)) for p in sizes},
    )
    for p in sizes:
        for q in wider.affects(p.name):
            simulated = wider.simulated(theta, q, columns)
            white_columns = weighted(estimate, q, simulated - estimate.simulated[q][:, None])[0]
            remainder = _orthogonal_part(parent.basis[q], white_columns)
            square_of_column = np.maximum((remainder**2).sum(axis=0), 1e-300)
            linear_amplitude = remainder.T @ parent.error[q] / square_of_column
            linear_amplitude = np.where(np.isfinite(linear_amplitude), linear_amplitude, 0.0)
            if p.lower >= (p.null or 0.0) or p.positive:
                linear_amplitude = np.maximum(linear_amplitude, 0.0)
            linear_amplitude = np.where(square_of_column > 1e-12, linear_amplitude, 0.0)
            gain += linear_amplitude**2 * square_of_column
            amplitude[p.name] += linear_amplitude * small_changes[p.name]
    best_settings = [i for i in np.argsort(-gain)[:FOLLOWED_SETTINGS] if gain[i] >= LEAST_GAIN]
    return _run(parent, form, wider, sizes, best_settings, start_values_of_settings, columns, amplitude)


def _varied(form: Form) -> tuple[str, ...]:
    """Return the features whose settings differ within a form's grid; controllers are left out."""
    names = {name for setting in form.grid for name in setting.features if name not in CONTROLLED}
    return tuple(
        sorted(
            name
            for name in names
            if any(setting.features.get(name) != form.grid[0].features.get(name) for setting in form.grid)
        )
    )


def _sized(sizes: Sequence[Parameter], changes: Mapping[str, float]) -> dict[str, float]:
    """Return the values of amplitude parameters: their null value plus a change, within their bounds."""
    return {
        p.name: float(np.clip((p.null or 0.0) + changes[p.name], min(p.lower, p.null or 0.0), p.upper))
        for p in sizes
    }


def _run(
    parent: Parent, form: Form, wider: Simulator, sizes: Sequence[Parameter], best_settings: Sequence[int],
    starts: Sequence[Mapping[str, float]], columns: Mapping[str, Sequence[np.ndarray]],
    amplitude: Mapping[str, np.ndarray],
) -> list[Screened]:  # fmt: skip
    """Simulate the best settings at several effect sizes and return each with its largest gain, the best
    first.

    best_settings: indices of settings.  starts: start values of each setting.  columns: means of the varied
        inputs by setting.  amplitude: linearised amplitudes (n,) by parameter.
    """
    if not best_settings:
        return []
    estimate, vectors, setting_of_run = parent.estimate, [], []
    for i in best_settings:
        for factor in SIZES:
            size = {p.name: factor * float(amplitude[p.name][i]) for p in sizes}
            vectors.append(wider.vector({**starts[i], **_sized(sizes, size)}))
            setting_of_run.append(i)
    theta = np.column_stack(vectors)
    run_columns = {
        name: [columns_of_setting[i] for i in setting_of_run] for name, columns_of_setting in columns.items()
    }
    gain = chord_gains(parent, wider, theta, run_columns, {q for p in sizes for q in wider.affects(p.name)})
    index_of = {p.name: wider.names.index(p.name) for p in added(estimate, wider)}
    result = []
    for number, i in enumerate(best_settings):
        columns_of_setting = slice(number * len(SIZES), (number + 1) * len(SIZES))
        best = columns_of_setting.start + int(np.argmax(gain[columns_of_setting]))
        values = {name: float(theta[index, best]) for name, index in index_of.items()}
        result.append(Screened(form, form.grid[i], values, float(gain[best])))
    return sorted(result, key=lambda s: -s.gain)


def chord_gains(
    parent: Parent, wider: Simulator, theta: np.ndarray, columns: Mapping[str, Sequence[np.ndarray]],
    quantities: set[str],
) -> np.ndarray:  # fmt: skip
    """Return the gain (n,) in −2 ln L of runs with parameters (P, n).

    Each run gets one linear step of the parent's parameters, with the Jacobian at the parent's estimate.
    """
    estimate, gain = parent.estimate, np.zeros(theta.shape[1])
    for q in sorted(quantities):
        simulated = wider.simulated(theta, q, columns)
        error = (
            parent.error[q][:, None] - weighted(estimate, q, simulated - estimate.simulated[q][:, None])[0]
        )
        remainder = _orthogonal_part(parent.basis[q], error)
        # the gain of the same step without the effect belongs to the parent, hence its remaining squares
        gain += parent.remaining_squares[q] - (remainder**2).sum(axis=0)
    return np.where(np.isfinite(gain), gain, -np.inf)


def _clocks(parent: Parent, form: Form) -> list[Screened]:
    """Return the clock shifts that gain most, each with the parent's parameters refitted by one linear step.

    The Jacobian is that of the shifted inputs: in the parent, an input whose clock is an hour off may have
    lost its effect.
    """
    estimate, shifts = parent.estimate, []
    affected = [q for q in estimate.quantities if form.clock in estimate.simulator.clocks(q)]
    squares_before = sum(parent.remaining_squares[q] for q in affected)
    for setting in form.grid:
        wider = widened(estimate, form, setting)
        shifted_parent = parent_of(
            estimate_at(wider, estimate.errors, estimate.theta, estimate.linear, estimate.variances), affected
        )
        shifts.append(
            Screened(form, setting, {}, squares_before - sum(shifted_parent.remaining_squares.values()))
        )
    return sorted((s for s in shifts if s.gain >= LEAST_GAIN), key=lambda s: -s.gain)[:FOLLOWED_SETTINGS]


WINDOWS_H = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
"""[h] lengths of the windows in which a door may stand open."""
WINDOW_GRID_S = 900.0
"""[s] grid on which windows begin and end."""
MOST_WINDOWS = 12


EDGES_H = (-4.0, -2.0, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 2.0)
"""[h] shifts of a window's edges that are tried."""
EXCHANGES = (0.5, 3.0, 15.0)
"""Sizes of the air exchange through an open door that are tried, as multiples of the cabinet's own
exchange."""


def _windows(parent: Parent, form: Form) -> list[Screened]:
    """Return the setting of a form of door openings with the best opening times; empty if the gain is
    small."""
    estimate = parent.estimate
    spans, price = openings(estimate, form, identified=True)
    if not spans:
        return []
    spans, sizes, gain = _move_edges(estimate, form, spans)
    setting = Setting({"door_open": {"spans": spans}}, price=price * len(spans))
    return [Screened(form, setting, sizes, gain)] if gain > LEAST_GAIN else []


def _move_edges(
    estimate: Calibration, form: Form, spans: list[list[float]]
) -> tuple[list[list[float]], dict[str, float], float]:
    """Improve the start and end times of door openings.

    Returns the openings [start, end] [s], the amplitudes and the gain in −2 ln L.  The matched filter assumes
    an immediate effect and therefore finds openings too late.
    """
    wider = widened(estimate, form, form.grid[0], ("door_open",))
    sizes = amplitudes(added(estimate, wider))
    start = start_values(estimate, wider, form.grid[0])

    def gains(trials: list[list[list[float]]]) -> dict[str, np.ndarray]:
        """Return the gains (sizes, trials) in −2 ln L, by amplitude parameter."""
        columns = {"door_open": [wider.column("door_open", {"spans": spans}) for spans in trials]}
        gain_of = {}
        for parameter in sizes:
            gain_of[parameter.name] = np.zeros((len(EXCHANGES), len(trials)))
            for i, size in enumerate(EXCHANGES):
                theta = wider.vector({**start, parameter.name: size})[:, None].repeat(len(trials), axis=1)
                for q in wider.affects(parameter.name):
                    reference, readings = estimate.filtered[q], estimate.simulator.scene.readings[q]
                    identified = np.where(readings.identified, readings.value, np.nan)[:, None]
                    white = reference.whitened(identified - wider.simulated(theta, q, columns))
                    loss_before = loss(np.nan_to_num(reference.standardised), reference.bound).sum()
                    gain_of[parameter.name][i] += loss_before - loss(white, reference.bound).sum(axis=0)
        return gain_of

    for edge in (0, 1):
        trials = [spans]
        for i in range(len(spans)):
            for hours in EDGES_H:
                moved = [list(span) for span in spans]
                moved[i][edge] += 3600.0 * hours
                trials.append(moved if moved[i][0] < moved[i][1] else spans)
        total = sum(np.max(gain, axis=0) for gain in gains(trials).values())
        best = [list(span) for span in spans]
        for i in range(len(spans)):
            own_trials = slice(1 + i * len(EDGES_H), 1 + (i + 1) * len(EDGES_H))
            best_trial = own_trials.start + int(np.argmax(total[own_trials]))
            if total[best_trial] > total[0]:
                best[i] = trials[best_trial][i]
        spans = [list(span) for span in joined(best)]
    final = gains([spans])
    chosen = {name: EXCHANGES[int(np.argmax(gain[:, 0]))] for name, gain in final.items()}
    return spans, chosen, float(sum(gain.max() for gain in final.values()))


def openings(estimate: Calibration, form: Form, identified: bool) -> tuple[list[list[float]], float]:
    """Find times at which a door was probably open, by a matched filter of the innovations.

    identified: whether to search the identification period, or else the rest.
    Returns windows [start, end] [s] that do not overlap, and the price of a window in −2 ln L.

    The response within a window is that to a permanently open door, cut to the window, since the filter
    forgets within hours.  Every quantity must gain.
    """
    wider = widened(estimate, form, form.grid[0])
    sizes = amplitudes(added(estimate, wider))
    small_changes = {p.name: SMALL_SIZE * size_of(p) for p in sizes}
    values = start_values(estimate, wider, form.grid[0])
    theta = wider.vector({**values, **_sized(sizes, small_changes)})[:, None]
    scene = estimate.simulator.scene
    count = int(scene.count * scene.cell_h * 3600.0 / WINDOW_GRID_S) + 2
    products, squares = np.zeros((2, len(estimate.quantities), count))
    for i, q in enumerate(estimate.quantities):
        r = scene.readings[q]
        in_period = r.identified == identified
        reference = filtered(
            estimate.errors[q],
            estimate.variances[q],
            np.where(in_period, r.value - estimate.simulated[q], np.nan),
        )
        white_response = reference.whitened(wider.simulated(theta, q) - estimate.simulated[q][:, None])[:, 0]
        weighted_innovation = np.nan_to_num(reference.standardised) * reference.weight
        grid_cell = np.clip(((r.time_s - scene.first_s) / WINDOW_GRID_S).astype(int), 0, count - 1)
        np.add.at(products[i], grid_cell, weighted_innovation * white_response)
        np.add.at(squares[i], grid_cell, white_response * white_response)
    cumulated = [np.cumsum(np.pad(a, ((0, 0), (1, 0))), axis=1) for a in (products, squares)]
    price_of_window = 2.0 * float(np.log(count * len(WINDOWS_H)))
    candidates = []
    for hours in WINDOWS_H:
        window_cells = int(hours * 3600.0 / WINDOW_GRID_S)
        product, square = (total[:, window_cells:] - total[:, :-window_cells] for total in cumulated)
        matched = (product > 0) & (square > 1e-12)
        gains = np.where(matched, product * product / np.maximum(square, 1e-12), 0.0)
        gain = np.where((gains > 1.0).all(axis=0), gains.sum(axis=0), 0.0)
        candidates += [(float(gain[i]), i, window_cells) for i in np.flatnonzero(gain > price_of_window)]
    chosen_windows: list[tuple[int, int]] = []
    is_used = np.zeros(count + 1, bool)
    for _, first, window_cells in sorted(candidates, reverse=True):
        if len(chosen_windows) < MOST_WINDOWS and not is_used[first : first + window_cells].any():
            is_used[first : first + window_cells] = True
            chosen_windows.append((int(first), window_cells))
    spans = sorted(
        [scene.first_s + WINDOW_GRID_S * first, scene.first_s + WINDOW_GRID_S * (first + window_cells)]
        for first, window_cells in chosen_windows
    )
    return spans, price_of_window
