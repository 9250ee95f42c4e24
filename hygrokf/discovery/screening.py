"""Screening: what every setting of every form would gain at most, at first order and then by real runs.

Of each setting one run with a small effect gives a column; whitened by the parent's filter and with the
parent's own columns projected out, it tells the gain to first order.  Where an effect is large that ranks
wrongly, so that the best settings of a form are run at several sizes.

Shapes: T readings of a quantity, n settings, d parameters of the parent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hygrokf.data.clocks import Shift
from hygrokf.discovery.error_model import filtered, loss
from hygrokf.discovery.estimate import Calibration, Columns, estimate_at, frame, slopes, weighted
from hygrokf.discovery.repeats import joined
from hygrokf.discovery.simulator import Simulator
from hygrokf.modelling.causes.forms import Form, MechanismSettings, Setting, Settings
from hygrokf.modelling.design import Design, extended
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.switches import CONTROLLED, Throttle

SMALL = 0.1
"""Share of an effect's usual size at which its column is taken."""
SIZES = (1.0, 2.5, 0.4, 6.0)
FOLLOWED = 3
"""Settings of a form that are run, and of a cause that are estimated."""
LEAST = 6.0
AT_LIMIT = 1e-3
"""Share of a coordinate's range within which a parameter is at its limit."""


@dataclass(frozen=True)
class Screened:
    """A setting of a form that may be worth an estimate: start values of its own parameters, gain in
    −2 ln L."""

    form: Form
    setting: Setting
    values: Mapping[str, float]
    gain: float


@dataclass(frozen=True)
class Parent:
    """An estimate, and what its own parameters can imitate: an orthonormal basis (T, d) by quantity, of
    whitened columns times the roots of their weights; columns: its slopes."""

    estimate: Calibration
    basis: Mapping[str, np.ndarray]
    error: Mapping[str, np.ndarray]
    columns: Columns

    @cached_property
    def left(self) -> dict[str, float]:
        """By quantity, the squared errors that the parent's own parameters cannot imitate."""
        return {q: float((_free_of(basis, self.error[q]) ** 2).sum()) for q, basis in self.basis.items()}


def parent_of(one: Calibration, quantities: Sequence[str] | None = None) -> Parent:
    """A parent's own columns, by quantity (all); those of parameters that are held at a limit imitate
    nothing."""
    f = frame(one.simulator.parameters, set(one.simulator.names), one.linear)
    z = f.coordinates(one.theta)
    near = AT_LIMIT * (f.upper - f.lower)
    basis, error, kept = {}, {}, {}
    for q, columns in slopes(one, f, quantities).items():
        kept[q] = {one.simulator.names[i]: columns[:, c] for c, i in enumerate(f.place)}
        white, error[q] = weighted(one, q, columns)
        pull = white.T @ error[q]
        held = ((z <= f.lower + near) & (pull < 0.0)) | ((z >= f.upper - near) & (pull > 0.0))
        white = white[:, columns.any(axis=0) & ~held]
        scale = np.maximum(np.sqrt((white**2).sum(axis=0)), 1e-300)
        basis[q] = np.linalg.qr(white / scale)[0] if white.shape[1] else white
    return Parent(one, basis, error, kept)


def _free_of(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    return columns - basis @ (basis.T @ columns)


def widened(parent: Calibration, form: Form, setting: Setting, own: tuple[str, ...] = ()) -> Simulator:
    """The simulator with a form of a cause."""
    before = parent.simulator
    heat = _wider(before.heat, form.heat, setting.features)
    vapour = before.vapour
    if vapour is not None:
        if form.altered:
            altered = ((name, {**known, **form.altered.get(name, {})}) for name, known in vapour.mechanisms)
            vapour = replace(vapour, mechanisms=tuple(altered))
        vapour = _wider(vapour, form.vapour, setting.features)
        if form.freed:
            vapour = replace(vapour, priors={**vapour.priors, form.freed: (0.0, FREE[form.freed], False)})
    scene = before.scene
    if form.clock:
        scene = scene.moved(Shift(form.clock, setting.shift_s, form.summer))
    return Simulator(scene, heat, vapour, own, {**before.limits, **form.limits}, before.work)


def _wider(base: Design, additions: Sequence[MechanismSettings], features: Mapping[str, Settings]) -> Design:
    made = extended(base, additions)
    read = set(made.model.inputs)
    return replace(made, features={**made.features, **{k: v for k, v in features.items() if k in read}})


FREE = {
    "breathed_gain": 0.3, "breathed_humidity_offset": 0.3, "humidity_scale_error": 0.3,
    "cabinet_temperature_offset": 5.0,
}  # fmt: skip
"""Standard deviation of a freed parameter's prior, wide in its place, in its unit."""


def _freed(parent: Parent, form: Form) -> list[Screened]:
    one = parent.estimate
    if form.freed not in one.simulator.names:
        return []
    place = one.simulator.names.index(form.freed)
    p = one.simulator.parameters[place]
    if p.prior is None or p.prior.sd >= FREE[form.freed]:
        return []
    gain = ((one.values[form.freed] - p.prior.mean) / p.prior.sd) ** 2
    for q in one.simulator.affects(form.freed):
        # beyond the limit where its accuracy holds it
        x = weighted(one, q, parent.columns[q][form.freed][:, None])[0]
        free = _free_of(parent.basis[q], x)[:, 0]
        square = float(free @ free)
        gain += (
            float(free @ parent.error[q]) ** 2 / square if square > 1e-9 * float(x[:, 0] @ x[:, 0]) else 0.0
        )
    return [Screened(form, form.grid[0], {}, gain)] if gain > LEAST else []


def added(parent: Calibration, wider: Simulator) -> tuple[Parameter, ...]:
    known = set(parent.simulator.names)
    return tuple(p for p in wider.parameters if p.name not in known)


def amplitudes(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Those that are the size of an effect: they have a null."""
    return tuple(p for p in parameters if p.null is not None)


def size_of(p: Parameter) -> float:
    """A usual size of an effect, in the parameter's unit."""
    assert p.null is not None
    return p.start - p.null if p.start != p.null else 0.01 * (p.upper - p.null)


def start_values(parent: Calibration, wider: Simulator, setting: Setting) -> dict[str, float]:
    """Values of all parameters at a setting, without an effect."""
    values = {p.name: p.start for p in added(parent, wider)} | parent.values
    values |= {p.name: p.null for p in amplitudes(added(parent, wider)) if p.null is not None}
    for name, settings in setting.features.items():
        if name in CONTROLLED and name in wider.controls:
            first, second = Throttle(**settings).levels
            values |= {f"{name}_first": first, f"{name}_second": second}
    return values | dict(setting.values)


def screened(parent: Parent, form: Form) -> list[Screened]:
    """The settings of a form that gain most."""
    one = parent.estimate
    if form.clock:
        return _clocks(parent, form)
    if form.freed:
        return _freed(parent, form)
    if form.windows:
        return _windows(parent, form)
    varied = _varied(form)
    wider = widened(one, form, form.grid[0], varied)
    sizes = amplitudes(added(one, wider))
    if not sizes:
        return []
    rows = [start_values(one, wider, setting) for setting in form.grid]
    columns = {name: [wider.column(name, s.features[name]) for s in form.grid] for name in varied}
    given = {p.name: SMALL * size_of(p) for p in sizes}
    theta = np.column_stack([wider.vector({**row, **_sized(sizes, given)}) for row in rows])
    gain, found = np.zeros(len(rows)), {p.name: np.zeros(len(rows)) for p in sizes}
    for p in sizes:
        for q in wider.affects(p.name):
            y = wider.simulated(theta, q, columns)
            x = weighted(one, q, y - one.simulated[q][:, None])[0]
            free = _free_of(parent.basis[q], x)
            square = np.maximum((free**2).sum(axis=0), 1e-300)
            share = free.T @ parent.error[q] / square
            share = np.where(np.isfinite(share), share, 0.0)
            if p.lower >= (p.null or 0.0) or p.positive:
                share = np.maximum(share, 0.0)
            share = np.where(square > 1e-12, share, 0.0)
            gain += share**2 * square
            found[p.name] += share * given[p.name]
    order = [i for i in np.argsort(-gain)[:FOLLOWED] if gain[i] >= LEAST]
    return _run(parent, form, wider, sizes, order, rows, columns, found)


def _varied(form: Form) -> tuple[str, ...]:
    """Features whose settings differ within the grid and that no controller gives."""
    names = {name for s in form.grid for name in s.features if name not in CONTROLLED}
    return tuple(
        sorted(n for n in names if any(s.features.get(n) != form.grid[0].features.get(n) for s in form.grid))
    )


def _sized(sizes: Sequence[Parameter], found: Mapping[str, float]) -> dict[str, float]:
    return {
        p.name: float(np.clip((p.null or 0.0) + found[p.name], min(p.lower, p.null or 0.0), p.upper))
        for p in sizes
    }


def _run(
    parent: Parent, form: Form, wider: Simulator, sizes: Sequence[Parameter], order: Sequence[int],
    rows: Sequence[Mapping[str, float]], columns: Mapping[str, Sequence[np.ndarray]],
    found: Mapping[str, np.ndarray],
) -> list[Screened]:  # fmt: skip
    """Real runs of the best settings at several sizes; the parent follows by one chord step."""
    if not order:
        return []
    one, made, owned = parent.estimate, [], []
    for i in order:
        for factor in SIZES:
            size = {p.name: factor * float(found[p.name][i]) for p in sizes}
            made.append(wider.vector({**rows[i], **_sized(sizes, size)}))
            owned.append(i)
    theta = np.column_stack(made)
    own = {name: [part[i] for i in owned] for name, part in columns.items()}
    gain = chord_gains(parent, wider, theta, own, {q for p in sizes for q in wider.affects(p.name)})
    own_places = {p.name: wider.names.index(p.name) for p in added(one, wider)}
    result = []
    for place, i in enumerate(order):
        part = slice(place * len(SIZES), (place + 1) * len(SIZES))
        best = part.start + int(np.argmax(gain[part]))
        values = {name: float(theta[at, best]) for name, at in own_places.items()}
        result.append(Screened(form, form.grid[i], values, float(gain[best])))
    return sorted(result, key=lambda s: -s.gain)


def chord_gains(
    parent: Parent, wider: Simulator, theta: np.ndarray, columns: Mapping[str, Sequence[np.ndarray]],
    quantities: set[str],
) -> np.ndarray:  # fmt: skip
    """(n,) gain in −2 ln L of runs with parameters (P, n), where the parent follows by one chord step."""
    one, gain = parent.estimate, np.zeros(theta.shape[1])
    for q in sorted(quantities):
        y = wider.simulated(theta, q, columns)
        e = parent.error[q][:, None] - weighted(one, q, y - one.simulated[q][:, None])[0]
        left = _free_of(parent.basis[q], e)
        # what the parent's own step would gain is no gain of theirs
        gain += parent.left[q] - (left**2).sum(axis=0)
    return np.where(np.isfinite(gain), gain, -np.inf)


def _clocks(parent: Parent, form: Form) -> list[Screened]:
    """The shifts that gain most, with the parent's parameters refitted to first order at each.

    Their slopes are those of the shifted inputs: an input whose clock is an hour off may have no effect left
    in the parent."""
    one, found = parent.estimate, []
    mine = [q for q in one.quantities if form.clock in one.simulator.clocks(q)]
    before = sum(parent.left[q] for q in mine)
    for setting in form.grid:
        wider = widened(one, form, setting)
        moved = parent_of(estimate_at(wider, one.errors, one.theta, one.linear, one.variances), mine)
        found.append(Screened(form, setting, {}, before - sum(moved.left.values())))
    return sorted((s for s in found if s.gain >= LEAST), key=lambda s: -s.gain)[:FOLLOWED]


WINDOWS_H = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
"""[h] lengths of the windows in which a door may stand open."""
EVERY_S = 900.0
MOST_WINDOWS = 12


EDGES_H = (-4.0, -2.0, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 2.0)
"""[h] by which the edges of a window are moved."""
EXCHANGES = (0.5, 3.0, 15.0)
"""Sizes of an open door's exchange at which windows are run, in units of the cabinet's own."""


def _windows(parent: Parent, form: Form) -> list[Screened]:
    one = parent.estimate
    spans, price = openings(one, form, identified=True)
    if not spans:
        return []
    spans, sizes, gain = _edged(one, form, spans)
    setting = Setting({"door_open": {"spans": spans}}, price=price * len(spans))
    return [Screened(form, setting, sizes, gain)] if gain > LEAST else []


def _edged(
    one: Calibration, form: Form, spans: list[list[float]]
) -> tuple[list[list[float]], dict[str, float], float]:
    """Windows whose edges are those of the best real runs, with the sizes and the gain there: a matched
    filter sees an opening late, and as if its effect were there at once."""
    wider = widened(one, form, form.grid[0], ("door_open",))
    sizes = amplitudes(added(one, wider))
    rest = start_values(one, wider, form.grid[0])

    def gains(trials: list[list[list[float]]]) -> dict[str, np.ndarray]:
        """(sizes, trials) of each amplitude."""
        columns = {"door_open": [wider.column("door_open", {"spans": spans}) for spans in trials]}
        found = {}
        for p in sizes:
            found[p.name] = np.zeros((len(EXCHANGES), len(trials)))
            for i, size in enumerate(EXCHANGES):
                theta = wider.vector({**rest, p.name: size})[:, None].repeat(len(trials), axis=1)
                for q in wider.affects(p.name):
                    known, r = one.filtered[q], one.simulator.scene.readings[q]
                    read = np.where(r.identified, r.value, np.nan)[:, None]
                    white = known.whitened(read - wider.simulated(theta, q, columns))
                    before = loss(np.nan_to_num(known.standardised), known.bound).sum()
                    found[p.name][i] += before - loss(white, known.bound).sum(axis=0)
        return found

    for edge in (0, 1):
        trials = [spans]
        for i in range(len(spans)):
            for hours in EDGES_H:
                moved = [list(span) for span in spans]
                moved[i][edge] += 3600.0 * hours
                trials.append(moved if moved[i][0] < moved[i][1] else spans)
        total = sum(np.max(one, axis=0) for one in gains(trials).values())
        best = [list(span) for span in spans]
        for i in range(len(spans)):
            mine = slice(1 + i * len(EDGES_H), 1 + (i + 1) * len(EDGES_H))
            place = mine.start + int(np.argmax(total[mine]))
            if total[place] > total[0]:
                best[i] = trials[place][i]
        spans = [list(span) for span in joined(best)]
    at = gains([spans])
    chosen = {name: EXCHANGES[int(np.argmax(gain[:, 0]))] for name, gain in at.items()}
    return spans, chosen, float(sum(gain.max() for gain in at.values()))


def openings(one: Calibration, form: Form, identified: bool) -> tuple[list[list[float]], float]:
    """Windows [start, end] [s] of the identification period, or of the rest, in which innovations ask for
    more exchange, by a matched filter; their price in −2 ln L each.

    The response within a window is taken as that to a lasting effect, cut to the window: a filter forgets
    within hours.  Every quantity must gain.
    """
    wider = widened(one, form, form.grid[0])
    sizes = amplitudes(added(one, wider))
    given = {p.name: SMALL * size_of(p) for p in sizes}
    row = start_values(one, wider, form.grid[0])
    theta = wider.vector({**row, **_sized(sizes, given)})[:, None]
    scene = one.simulator.scene
    count = int(scene.count * scene.cell_h * 3600.0 / EVERY_S) + 2
    products, squares = np.zeros((2, len(one.quantities), count))
    for i, q in enumerate(one.quantities):
        r = scene.readings[q]
        there = r.identified == identified
        known = filtered(one.errors[q], one.variances[q], np.where(there, r.value - one.simulated[q], np.nan))
        x = known.whitened(wider.simulated(theta, q) - one.simulated[q][:, None])[:, 0]
        e = np.nan_to_num(known.standardised) * known.weight
        place = np.clip(((r.time_s - scene.first_s) / EVERY_S).astype(int), 0, count - 1)
        np.add.at(products[i], place, e * x)
        np.add.at(squares[i], place, x * x)
    sums = [np.cumsum(np.pad(a, ((0, 0), (1, 0))), axis=1) for a in (products, squares)]
    price = 2.0 * float(np.log(count * len(WINDOWS_H)))
    candidates = []
    for hours in WINDOWS_H:
        width = int(hours * 3600.0 / EVERY_S)
        p, square = (s[:, width:] - s[:, :-width] for s in sums)
        gains = np.where((p > 0) & (square > 1e-12), p * p / np.maximum(square, 1e-12), 0.0)
        total = np.where((gains > 1.0).all(axis=0), gains.sum(axis=0), 0.0)
        candidates += [(float(total[i]), i, width) for i in np.flatnonzero(total > price)]
    chosen: list[tuple[int, int]] = []
    used = np.zeros(count + 1, bool)
    for _, first, width in sorted(candidates, reverse=True):
        if len(chosen) < MOST_WINDOWS and not used[first : first + width].any():
            used[first : first + width] = True
            chosen.append((int(first), width))
    spans = sorted(
        [scene.first_s + EVERY_S * first, scene.first_s + EVERY_S * (first + width)]
        for first, width in chosen
    )
    return spans, price
