"""The identified thermal network as a linear system in python-control."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.modelling.design import Design
from hygrokf.physics.holds import MEAN
from hygrokf.physics.model import Mechanism, Model, compose
from hygrokf.physics.parameters import expect_values

if TYPE_CHECKING:
    import control

NETWORK = ("thermal_network", "natural_convection")
"""Mechanisms that make up the thermal network itself; heat releases and disturbances drive it."""
INPUTS = ("ambient_temperature", "heat_release")


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
    )
    return compose([*parts, drive], dict.fromkeys(INPUTS, MEAN))


AT_K = 283.15
"""[K] ambient temperature at which a network with natural convection is linearised; only differences
matter."""


def state_space(
    design: Design, values: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A (n, n) [1/h], B (n, 2), C (1, n), D (1, 2) of the network; inputs `INPUTS`, output T_conv,a.

    Derivatives by complex steps, exact to rounding.  The paper's network is linear.  With natural convection
    the network is linearised at the temperature difference that the exponent refers to.
    """
    model = _network(design)
    expect_values(model.parameters, values)
    n = len(model.states)
    settings = dict(design.mechanisms).get("natural_convection", {})
    difference = settings.get("difference_K", 0.0)
    point = np.array([AT_K + difference / values["resistance_ratio"]] * n + [AT_K, difference], dtype=complex)

    def answer(z: np.ndarray) -> np.ndarray:
        equations = model.evaluate(list(z[:n]), dict(zip(INPUTS, z[n:], strict=True)), values)
        return np.array([*equations.rates, equations.quantities["cabinet_air_temperature"]], dtype=complex)

    columns = [answer(point + 1e-30j * row).imag * 1e30 for row in np.eye(n + len(INPUTS))]
    matrix = np.array(columns).T
    return matrix[:n, :n], matrix[:n, n:], matrix[n:, :n], matrix[n:, n:]


def to_statespace(design: Design, values: Mapping[str, float]) -> control.StateSpace:
    """Equations (2) and (3) as a `control.StateSpace`, time in hours.

    design, values: model and parameter values, in the parameters' units (`fit.design`, `fit.values`).

    Returns the system with inputs `ambient_temperature` [K] and `heat_release` [K] (f_ΔT), output
    `cabinet_air_temperature` [K], state `converter_temperature` [K].  `control.sample_system(system, step_h,
    "zoh")` gives the F and G of the filter; `control.step_response`, `control.frequency_response` and
    `control.damp` work on it as on any other system.
    Raises ValueError for a design without a thermal network, and for parameters without a value.
    """
    import control

    return control.ss(
        *state_space(design, values),
        states=list(_network(design).states),
        inputs=list(INPUTS),
        outputs=["cabinet_air_temperature"],
        name="thermal_network",
    )


def thermal_poles(design: Design, values: Mapping[str, float]) -> list[float]:
    """Time constants [h] of the thermal network, −1/Re(pole), slowest first."""
    a, *_ = state_space(design, values)
    return sorted((float(-1.0 / v.real) for v in np.linalg.eigvals(a)), reverse=True)
