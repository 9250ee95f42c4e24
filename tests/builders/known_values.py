"""Parameter values of cabinets that are known: a usual heat release, and the truth of a simulated plant."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plants import Truth

    from hygrokf.modelling.design import Design

RELEASE = {
    "heat_release_operation": 7.5,
    "heat_release_power_1": 7.0,
    "heat_release_power_2": -2.0,
    "heat_release_operation_ambient": -0.15,
    "heat_release_standstill": 5.0,
    "heat_release_standstill_ambient": -0.1,
}


def physical_values(truth: Truth) -> dict[str, float]:
    """Thermal and hygric parameters of a plant by the package's names; heat releases at 283.15 K."""
    a0, a1, a2, slope = truth.operation_K
    return {
        "thermal_time_constant": truth.tau_h,
        "resistance_ratio": truth.rho,
        "hygric_k": truth.hygric_constant_h,
        "heat_release_operation": a0,
        "heat_release_power_1": a1,
        "heat_release_power_2": a2,
        "heat_release_operation_ambient": slope,
        "heat_release_standstill": truth.standstill_K[0],
        "heat_release_standstill_ambient": truth.standstill_K[1],
    }


def with_reference(base: Design, kelvin: float = 283.15) -> Design:
    """The design with another reference temperature of the heat release; that of the plants is 283.15 K."""
    chosen = tuple(
        (n, {**s, "reference_K": kelvin} if n == "heat_release" else s) for n, s in base.mechanisms
    )
    return replace(base, mechanisms=chosen)
