"""The identified thermal network as a linear system."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hygrokf.modelling.design import Design
from hygrokf.physics.holds import MEAN
from hygrokf.physics.linearisation import LinearSystem, linearise
from hygrokf.physics.model import Mechanism, Model, Values, compose
from hygrokf.physics.parameters import expect_values

NETWORK = ("thermal_network", "natural_convection")
"""Mechanisms that make up the thermal network itself; heat releases and disturbances drive it."""
SYSTEM_INPUTS = ("ambient_temperature", "heat_release")
AT_K = 283.15
"""[K] ambient temperature at which a network with natural convection is linearised; only differences
matter."""


def _network(design: Design) -> Model:
    """The network alone, with the whole heat release f_ΔT [K] as an input."""
    parts = [m for m in design.model.mechanisms if m.name in NETWORK]
    if not parts:
        raise ValueError(
            "the design has no thermal network; its mechanisms are "
            + ", ".join(name for name, _ in design.mechanisms)
        )
    drive = Mechanism(
        name="heat_input",
        inputs=("heat_release",),
        contributions=lambda p, x, u, q: {"heat_release": u.heat_release},
        outputs={"cabinet_air_temperature": lambda p, x, u, q, s: (q.cabinet_air_temperature, 0.0)},
    )
    return compose([*parts, drive], dict.fromkeys(SYSTEM_INPUTS, MEAN))


def thermal_system(design: Design, values: Values) -> LinearSystem:
    """Equations (2) and (3): inputs `SYSTEM_INPUTS` [K], output T_conv,a [K], state T_IC [K].

    values: in the parameters' units, numbers or arrays (N,).  The paper's network is linear.  One with
    natural convection is linearised at the temperature difference that the exponent refers to.
    Raises ValueError for a design without a thermal network, and for parameters without a value.
    """
    model = _network(design)
    expect_values(model.parameters, values)
    difference = dict(design.mechanisms).get("natural_convection", {}).get("difference_K", 0.0)
    warm = AT_K + difference / values["resistance_ratio"]
    inputs = dict(zip(SYSTEM_INPUTS, (AT_K, difference), strict=True))
    return linearise(model, values, [warm] * len(model.states), inputs)


def thermal_poles(design: Design, values: Mapping[str, float]) -> list[float]:
    """Time constants [h] of the thermal network, −1/Re(pole), slowest first."""
    poles = np.linalg.eigvals(thermal_system(design, values).A)
    return sorted((float(-1.0 / v.real) for v in poles), reverse=True)
