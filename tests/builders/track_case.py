"""A small thermal model for tracker files."""

from __future__ import annotations

from pathlib import Path

from builders.fit_case import bare_fit
from hygrokf.identification.fit import write_fit
from hygrokf.modelling.design import Design

MODEL = Design(
    (
        ("thermal_network", {}),
        ("heat_release", {"order": 0, "operation": False, "standstill_ambient": False, "ambient": False}),
        ("thermal_diffusion", {}),
        ("temperature_sensor", {}),
    )
)


def write_model(folder: Path) -> None:
    """Write the model at its start values as a fit named "one"."""
    write_fit(bare_fit("one", MODEL, {p.name: p.start for p in MODEL.model.parameters}), folder)
