"""Tables of docs/validation/modelling_choices.md: disturbances, steps and the logger's clock."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from illustrations.pages import bounds_text, synthetic_record, true_values, write_table


def noise(directory: Path) -> None:
    """A table: the same records with and without coloured disturbances."""
    from hygrokf.estimation.confidence import uncertainty
    from hygrokf.estimation.likelihood import Likelihood
    from hygrokf.estimation.optimiser import Objective, maximise
    from hygrokf.modelling.design import design
    from hygrokf.modelling.inputs import prepare_run

    rows = [["seed", "τ [h]", "τ, white alone", "k [h]", "k, white alone"]]
    for seed in (1, 2, 3):
        record, _ = synthetic_record(seed, directory)
        early = record.identification()
        cells: dict[str, list[str]] = {"thermal_time_constant": [], "hygric_k": []}
        for coloured in (True, False):
            made = design(early, kind="joint", coloured=coloured)
            likelihood = Likelihood(made.model, prepare_run(made, early).timeline)
            estimate = maximise(likelihood)
            found = uncertainty(Objective(likelihood, estimate.coordinates), estimate)
            for name, row in cells.items():
                place, value = found.place(name), estimate.values[name]
                error = value * math.sqrt(found.sandwich[place, place])
                row.append(f"{value:.3f} ± {error:.3f}" + ("" if estimate.converged else " (not converged)"))
        rows.append([str(seed), *(cell for row in cells.values() for cell in row)])
    write_table("modelling_choices.md", "noise", rows)


def _split(base, t, new: np.ndarray):
    """The same run with more instants, at which nothing is read."""
    from hygrokf.engine.timeline import timeline

    model, old = base.model, t.time
    ends, at = np.searchsorted(old, new), np.searchsorted(new, old)
    inputs = {
        n: np.interp(new, old, t.input(n)) if model.holds[n] == "linear" else t.input(n)[ends]
        for n in model.inputs
    }
    readings = {}
    for n in t.outputs:
        readings[n] = np.full(len(new), np.nan)
        readings[n][at] = t.reading(n)
    return timeline(model, new, inputs, readings, origin_s=t.origin_s)


def _finer(time: np.ndarray, parts: int) -> np.ndarray:
    """Instants with every step divided."""
    inner = [time[:-1] + (time[1:] - time[:-1]) * i / parts for i in range(1, parts)]
    return np.unique(np.concatenate([time, *inner]))


def _one_split(base, t, values: Mapping, count: int = 200) -> float:
    """Largest change of the log-likelihood when one of the first 4,000 steps is halved, over `count` of
    them."""
    from hygrokf.estimation.likelihood import Likelihood

    part = t.window(0, 4000)
    whole = Likelihood(base.model, _split(base, part, part.time)).value(values)
    changes = []
    for k in np.random.default_rng(1).choice(np.arange(1, 4000), count, replace=False):
        new = np.insert(part.time, k, 0.5 * (part.time[k - 1] + part.time[k]))
        changes.append(abs(Likelihood(base.model, _split(base, part, new)).value(values) - whole))
    return max(changes)


def steps(directory: Path) -> None:
    """A table: what dividing every step changes."""
    from hygrokf.estimation.likelihood import Likelihood
    from hygrokf.modelling.design import design
    from hygrokf.modelling.inputs import prepare_run

    record, truth = synthetic_record(1, directory)
    early = record.identification()
    known = true_values(truth)
    rows = [["model", "ln L", "one step in 2", "every step in 8"]]
    for kind in ("thermal", "cascade", "joint"):
        base = design(early, kind=kind)
        t = prepare_run(base, early).timeline
        values = {q.name: known.get(q.name, q.start) for q in base.model.parameters}
        found = [
            Likelihood(base.model, _split(base, t, _finer(t.time, n))).value(values) for n in (1, 8)
        ]
        changes = [f"{_one_split(base, t, values):.1e}", *(f"{v - found[0]:+.2e}" for v in found[1:])]
        rows.append([kind, f"{found[0]:,.1f}", *changes])
    write_table("modelling_choices.md", "steps", rows)


def clock(directory: Path) -> None:
    """A table: the cabinet logger's clock moved."""
    from hygrokf import identify

    record, truth = synthetic_record(1, directory)
    early = record.identification()
    rows = [["cabinet logger's stamps", "thermal [h]", "hygric [h]"]]
    rows.append(
        [
            "*truth*",
            f"*{truth.parameters.thermal_time_constant_h}*",
            f"*{truth.parameters.hygric_time_constant_h}*",
        ]
    )
    for minutes in (-10, -2, 0, 2, 10):
        moved = early.replace_series(
            *(
                replace(s, time=s.time + 60.0 * minutes)
                for s in early.series
                if s.signal.startswith("cabinet_")
            )
        )
        print(f"fit with a clock of {minutes:+d} min", flush=True)
        found = identify(moved, starts=1).to_json()["time_constants"]
        label = "as they are" if minutes == 0 else f"{abs(minutes)} min {'late' if minutes > 0 else 'early'}"
        rows.append([label, bounds_text(found["thermal"]), bounds_text(found["hygric"])])
    write_table("modelling_choices.md", "clock", rows)
