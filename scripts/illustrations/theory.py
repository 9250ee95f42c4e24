"""Tables of docs/validation/modelling_choices.md: disturbances and the logger's clock."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from illustrations.pages import bounds_text, synthetic_record, write_table


def noise(directory: Path) -> None:
    """A table: the same records with and without coloured disturbances."""
    from hygrokf.estimation.confidence import uncertainty
    from hygrokf.estimation.likelihood import Likelihood
    from hygrokf.estimation.optimiser import Objective, fit_mle
    from hygrokf.modelling.design import design
    from hygrokf.modelling.inputs import model_inputs

    rows = [["seed", "τ [h]", "τ, white alone", "k [h]", "k, white alone"]]
    for seed in (1, 2, 3):
        record, _ = synthetic_record(seed, directory)
        early = record.identification()
        cells: dict[str, list[str]] = {"thermal_time_constant": [], "hygric_k": []}
        for coloured in (True, False):
            made = design(early, kind="joint", coloured=coloured)
            likelihood = Likelihood(made.model, model_inputs(made, early).timeline)
            estimate = fit_mle(likelihood)
            found = uncertainty(Objective(likelihood, estimate.coordinates), estimate)
            for name, row in cells.items():
                place, value = found.place(name), estimate.values[name]
                error = value * math.sqrt(found.sandwich[place, place])
                row.append(f"{value:.3f} ± {error:.3f}" + ("" if estimate.converged else " (not converged)"))
        rows.append([str(seed), *(cell for row in cells.values() for cell in row)])
    write_table("modelling_choices.md", "noise", rows)


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
