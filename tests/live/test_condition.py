"""The air's condition from a Gaussian of the state: against Monte Carlo, published tables, and what it must
not do."""

from __future__ import annotations

import numpy as np
import pytest

from hygrokf.engine.timeline import Timeline, timeline
from hygrokf.live.condition import (
    Condition,
    Quantity,
    Surface,
    air_condition,
    inputs_of,
    probability_above,
    probability_below,
)
from hygrokf.physics.mechanisms import MECHANISMS
from hygrokf.physics.model import Model, compose
from hygrokf.physics.psychrometrics import (
    GAS_CONSTANT_VAPOUR,
    dew_point,
    frost_point,
    saturation_pressure_water,
)

THERMAL = ("thermal_network", "thermal_diffusion", "temperature_sensor")
HYGRIC = ("hygric_exchange", "hygric_diffusion", "humidity_sensor")
BOTH = (*THERMAL, *HYGRIC)
VALUES = {"resistance_ratio": 0.85}


def model_of(*names: str) -> Model:
    made = [MECHANISMS[name]() for name in names]
    return compose(made, {name: "linear" for m in made for name in m.inputs})


def at(model: Model, ambient_K: float, vapour: float) -> Timeline:
    known = {
        "ambient_temperature": ambient_K,
        "ambient_absolute_humidity": vapour,
        "exchange_factor": ambient_K**0.8 / 273.0**1.8,
    }
    return timeline(model, np.array([5.0]), {n: np.array([known[n]]) for n in model.inputs}, {})


def values_of(model: Model) -> dict[str, float]:
    return {p.name: p.start for p in model.parameters} | VALUES


def found_at(
    names: tuple[str, ...],
    ambient: tuple[float, float],
    state: tuple[float, ...],
    variance: float,
    surface: Surface = Surface(),  # noqa: B008
) -> Condition:
    """The condition of a model in an ambient (K, g/m³), at a state with independent components."""
    model = model_of(*names)
    covariance = variance * np.eye(len(state))[None]
    t, mean = at(model, *ambient), np.array([state])
    u = inputs_of(model, t)
    return air_condition(model, values_of(model), t.seconds, u, mean, covariance, surface)


@pytest.mark.parametrize(
    ("ambient_K", "converter_K", "vapour"),
    [(283.15, 295.15, 8.0), (263.15, 268.15, 1.5), (275.15, 276.0, 4.6)],
)
def test_spreads_are_those_of_drawn_states(ambient_K: float, converter_K: float, vapour: float) -> None:
    model = model_of(*THERMAL, *HYGRIC)
    t = at(model, ambient_K, vapour)
    mean = np.array([converter_K, vapour])
    covariance = np.array([[0.25, 0.02], [0.02, 0.01]])
    surface = Surface(follows=0.4, offset_K=-0.5)
    values, u = values_of(model), inputs_of(model, t)
    found = air_condition(model, values, t.seconds, u, mean[None], covariance[None], surface)
    random = np.random.default_rng(4)
    states = random.multivariate_normal(mean, covariance, 200_000)
    air = 0.85 * states[:, 0] + 0.15 * ambient_K
    e = 1e-3 * states[:, 1] * GAS_CONSTANT_VAPOUR * ambient_K
    dew = dew_point(e)
    cold = ambient_K + 0.4 * (air - ambient_K) - 0.5
    drops = np.where(cold < 273.15, frost_point(np.minimum(e, 611.0)), dew)
    expected = {
        "temperature_K": air,
        "relative_humidity": e / saturation_pressure_water(air),
        "absolute_humidity_g_m3": 1e3 * e / (GAS_CONSTANT_VAPOUR * air),
        "dew_point_K": dew,
        "margin_K": cold - drops,
    }
    for name, drawn in expected.items():
        quantity = getattr(found, name)
        # first order: the mean is off by the curvature, a tenth of the spread here; the spread by 5 %
        assert quantity.value[0] == pytest.approx(drawn.mean(), abs=0.1 * drawn.std()), name
        assert quantity.sd[0] == pytest.approx(drawn.std(), rel=0.05), name
    assert found.condensation[0] == pytest.approx(np.mean(cold < drops), abs=0.02)


def test_frost_is_told_from_dew() -> None:
    # 1.5 g/m3 at 263.15 K is 182.2 Pa.  Tables (Sonntag 1990): water 191.4 Pa at -15 degC and 176.3 Pa at -16
    # degC, ice 181.2 Pa at -14 degC and 198.5 Pa at -13 degC
    found = found_at(BOTH, (263.15, 1.5), (263.15, 1.5), 1e-6, Surface(1.0))
    assert found.dew_point_K.value[0] == pytest.approx(273.15 - 15.61, abs=0.03)
    assert found.frost_point_K.value[0] == pytest.approx(273.15 - 13.94, abs=0.03)
    assert found.margin_K.value[0] == pytest.approx(263.15 - found.frost_point_K.value[0])
    warm = found_at(BOTH, (293.15, 8.0), (293.15, 8.0), 1e-6)
    assert np.isnan(warm.frost_point_K.value[0]) and np.isfinite(warm.margin_K.value[0])


def test_a_model_of_the_temperature_alone_says_nothing_about_humidity() -> None:
    found = found_at(THERMAL, (283.15, 8.0), (290.0,), 0.04)
    assert found.temperature_K.value[0] == pytest.approx(0.85 * 290.0 + 0.15 * 283.15)
    assert found.temperature_K.sd[0] == pytest.approx(0.85 * 0.2)
    assert found.relative_humidity is None and found.condensation is None


def test_air_that_is_all_but_dry_has_a_dew_point() -> None:
    found = found_at(BOTH, (253.15, 0.3), (260.0, -0.2), 0.01)
    assert np.isfinite(found.dew_point_K.value[0]) and 0.0 < found.relative_humidity.value[0] < 0.01


def test_probabilities() -> None:
    two = Quantity(np.array([1.0, -1.0]), np.array([0.0, 1.0]))
    assert probability_below(two, 0.0) == pytest.approx([0.0, 0.841345], abs=1e-6)
    assert probability_above(two, 0.0) == pytest.approx([1.0, 0.158655], abs=1e-6)
    assert two.upper[1] == pytest.approx(0.959964) and two.lower[0] == 1.0
