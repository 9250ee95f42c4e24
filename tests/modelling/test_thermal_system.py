"""The thermal network as a python-control system, against closed forms."""

from __future__ import annotations

import control
import pytest
from numpy.testing import assert_allclose

from hygrokf.evaluation.responses import to_statespace
from hygrokf.identification.fit import Fit
from hygrokf.modelling.design import Design
from hygrokf.modelling.thermal_system import SYSTEM_INPUTS, thermal_poles, thermal_system

TAU, RHO = 1.7, 0.83


@pytest.fixture
def network() -> tuple[Design, dict]:
    design = Design(
        mechanisms=(
            ("thermal_network", {}),
            (
                "heat_release",
                {"order": 0, "operation": False, "standstill_ambient": False, "reference_K": 283.15},
            ),
            ("thermal_diffusion", {}),
            ("temperature_sensor", {"accuracy": 0.0}),
        )
    )
    values = {p.name: p.start for p in design.model.parameters}
    return design, values | {
        "thermal_time_constant": TAU,
        "resistance_ratio": RHO,
        "heat_release_standstill": 3.0,
    }


def test_matrices_are_equations_2_and_3(network):
    found = thermal_system(*network)
    a, b, c, d = found.A, found.B, found.C, found.D
    assert_allclose(a, [[-1 / TAU]], rtol=1e-14)
    assert_allclose(b, [[1 / TAU, 1 / (TAU * RHO)]], rtol=1e-14)
    assert_allclose(c, [[RHO]], rtol=1e-14)
    assert_allclose(d, [[1 - RHO, 0.0]], rtol=1e-13)


def test_system_has_names_and_poles(network):
    system = to_statespace(Fit("made", *network))
    assert system.input_labels == list(SYSTEM_INPUTS)
    assert system.state_labels == ["converter_temperature"]
    assert system.output_labels == ["cabinet_air_temperature"]
    _, _, poles = control.damp(system, doprint=False)
    assert_allclose(-1.0 / poles.real, [TAU], rtol=1e-12)
    assert thermal_poles(*network) == pytest.approx([TAU], rel=1e-12)


def test_a_design_without_network_says_so():
    design = Design(mechanisms=(("measured_air", {}), ("hygric_exchange", {})))
    with pytest.raises(ValueError, match="no thermal network"):
        to_statespace(Fit("made", design, {}))
