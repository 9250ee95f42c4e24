"""The contract that every mechanism of the library keeps, and the physics of each against formulas of its
own."""

from __future__ import annotations

import importlib
import inspect
import json
import math
import pickle
import pkgutil
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from builders.mechanism_case import TIME, host, smallest_host, some_inputs, some_run, some_values
from hypothesis import given
from hypothesis import strategies as st
from plants.cabinet import Cabinet

from hygrokf.engine.timeline import timeline
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.modelling.derived_inputs import FEATURES
from hygrokf.physics import mechanisms
from hygrokf.physics.expression import Graph, jacobian
from hygrokf.physics.holds import LINEAR, MEAN
from hygrokf.physics.mechanisms import MECHANISMS, linear_network
from hygrokf.physics.mechanisms.hygric import exchange_factor, hygric_time_constant
from hygrokf.physics.mechanisms.moisture import GAB_C, GAB_ENDS, GAB_K, GAB_SLOPE, SLAB, _gab, condensation
from hygrokf.physics.model import Mechanism, Model, compose, extend
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.psychrometrics import relative_humidity

GAP = ((0.2, 0.05, 0.04), (0.05, 0.08, 0.07), (0.04, 0.07, 0.08))
NEEDED = {
    "thermal_network",
    "measured_air",
    "hygric_exchange",
    "temperature_sensor",
    "humidity_sensor",
    "absolute_humidity_sensor",
}
"""A model cannot be without these: they bring what the others act on, or what is read."""
VARIANTS = [
    *((name, {}) for name in MECHANISMS),
    ("heat_release", {"order": 1, "ambient": False}),
    ("heat_release", {"operation": False, "order": 0}),
    ("heat_release", {"standstill": False, "preheating": True}),
    (
        "heat_release",
        {"order": 2, "gap_covariance": GAP, "gap_time_h": 10.0, "start": {"heat_release_operation": 4.0}},
    ),
    ("measured_air", {"accuracy": 0.3}),
    ("temperature_sensor", {"accuracy": 0.0, "resolution": 0.1}),
    ("humidity_sensor", {"accuracy": 0.0}),
    ("absolute_humidity_sensor", {"accuracy": 0.2, "resolution": 0.01}),
    ("moisture_sorption", {"activated": False}),
    ("moisture_sorption", {"slab": True}),
    ("moisture_sorption", {"activated": False, "slab": True}),
    ("heat_disturbance", {"longest_h": 40.0, "shortest_h": 1.0}),
    ("vapour_disturbance", {"longest_h": 8.0, "shortest_h": 6.0}),
]
every = pytest.mark.parametrize(
    "k",
    range(len(VARIANTS)),
    ids=[name + "".join(f"-{word}" for word in settings) for name, settings in VARIANTS],
)


# -- the contract --------------------------------------------------------------------------------------------
def test_the_library_names_its_mechanisms() -> None:
    for name, factory in MECHANISMS.items():
        made = factory()
        assert isinstance(made, Mechanism) and made.name == name == factory.__name__
        assert factory.__doc__ and factory.__doc__[0] != " "


def test_every_factory_of_the_folder_stands_in_the_library() -> None:
    """A module lists its factories by group, and the package collects the groups of every module."""
    for module in pkgutil.iter_modules(mechanisms.__path__, f"{mechanisms.__name__}."):
        if module.name.endswith(".effects"):
            continue  # patterns that take arguments
        functions = inspect.getmembers(importlib.import_module(module.name), inspect.isfunction)
        made = {
            name
            for name, function in functions
            if function.__module__ == module.name
            and name[0] != "_"
            and inspect.signature(function).return_annotation == "Mechanism"
        }
        assert made and made <= set(MECHANISMS), f"{module.name}: list them in its BASE, LOGGED, FURTHER"


@cache
def variant(k: int) -> tuple[Mechanism, Model]:
    """A mechanism with its settings, and its host; traced once for all tests of a variant."""
    name, settings = VARIANTS[k]
    made = MECHANISMS[name](**settings)
    return made, smallest_host(made)


BASES: dict[tuple, Model] = {}


def without(model: Model, name: str) -> Model:
    """The model without a mechanism; the same object for all that is nested in a base model, traced once."""
    kept = tuple(m for m in model.mechanisms if m.name != name)
    key = tuple((m.name, repr(dict(m.settings))) for m in kept)
    return BASES.setdefault(key, replace(model, mechanisms=kept))


@every
def test_units_meanings_and_features_are_stated(k: int) -> None:
    made, _ = variant(k)
    assert made.meaning
    for p in made.parameters:
        assert p.unit and p.meaning and p.unit != p.name, p.name
        if p.positive and p.null is not None:
            assert p.null == 0.0  # the limit of the coordinate: estimation approaches it, tests put it in
    for feature, (function, hold) in made.features.items():
        assert FEATURES[feature] == (function, hold) and hold in (LINEAR, MEAN)
        assert list(inspect.signature(function).parameters)[:2] == ["record", "time"]


@every
def test_settings_make_the_mechanism_again_and_pickle_keeps_it(k: int) -> None:
    made, model = variant(k)
    # whatever a factory can be told is kept, so that a later change of a default does not change a stored fit
    assert set(made.settings) == set(inspect.signature(MECHANISMS[made.name]).parameters)
    again = MECHANISMS[made.name](**json.loads(json.dumps(dict(made.settings))))
    for field in ("name", "parameters", "states", "inputs", "null", "meaning", "leaves", "source"):
        assert getattr(again, field) == getattr(made, field), field
    assert set(again.outputs) == set(made.outputs)
    told = tuple(replace(one, meaning=f"{one.meaning}, as told") for one in again.parameters)
    other = smallest_host(replace(again, parameters=told))
    run, values = some_run(model), some_values(model)
    likelihood = pickle.loads(pickle.dumps(Likelihood(other, run)))
    assert likelihood.model.parameters == other.parameters
    value = Likelihood(model, run).value(values)
    assert math.isfinite(value) and likelihood.value(values) == value


def _cooling(p, x, u):
    return {"warmth": (u.ambient_temperature - x.warmth) / p.lag}


def _warmth(p, x, u):
    return x.warmth, 0.01


def _still(p):
    return {"warmth": 0.01}


def _begin(p, u):
    return {"warmth": (u.ambient_temperature, 1.0)}


def test_a_network_of_functions_of_a_module_can_be_pickled() -> None:
    lag = Parameter("lag", "h", 2.0, 0.1, 50.0, positive=True, meaning="time constant")
    made = linear_network(
        "lagging", [lag], ["warmth"], ["ambient_temperature"], _cooling, {"reading": _warmth}, _still, _begin
    )
    model = compose([made], {"ambient_temperature": LINEAR})
    run = timeline(
        model, TIME, {"ambient_temperature": 280.0 + np.sin(TIME)}, {"reading": 280.0 + 0.5 * np.sin(TIME)}
    )
    likelihood = Likelihood(model, run)
    value = likelihood.value({"lag": 3.0})  # traced and compiled: what cannot be pickled is there
    again = pickle.loads(pickle.dumps(likelihood))
    assert again.value({"lag": 3.0}) == value != likelihood.value({"lag": 1.0})


@pytest.mark.parametrize(
    "replaced", [{"drift": lambda p, x, u, q, s: {"vapour": 0.0}}, {"inputs": ("exchange_factor",)}]
)
def test_a_mechanism_that_was_changed_is_not_made_again_by_its_factory(replaced: dict) -> None:
    """It still holds functions that are defined inside the factory, which pickle refuses."""
    with pytest.raises((pickle.PicklingError, AttributeError), match=r"Can.t pickle"):
        pickle.dumps(replace(MECHANISMS["hygric_exchange"](), **replaced))


@every
def test_at_its_null_value_the_model_is_the_one_without_it(k: int) -> None:
    made, model = variant(k)
    if made.name in NEEDED:
        assert set(made.null) <= {p.name for p in made.parameters if p.name.endswith(("_bias", "_offset"))}
        return
    assert made.null, f"{made.name} needs a null value: tests of it and starts of larger models rest on it"
    values, smaller = some_values(model) | made.null, without(model, made.name)
    run, inputs = some_run(model), some_inputs(model)
    readings = {output: run.reading(output) for output in model.outputs}
    small_run = timeline(smaller, TIME, {n: inputs[n] for n in smaller.inputs}, readings)
    expected = Likelihood(smaller, small_run).value({p.name: values[p.name] for p in smaller.parameters})
    likelihood = Likelihood(model, run)
    # terms that are zero may stand elsewhere in a sum, which is a matter of rounding
    assert likelihood.value(values) == pytest.approx(expected, rel=1e-12)
    assert likelihood.value(some_values(model)) != pytest.approx(expected, rel=1e-9)  # elsewhere it acts
    assert extend(smaller, made, model.holds).parameters == (*smaller.parameters, *made.parameters)


@pytest.mark.parametrize(
    ("name", "quantity"),
    [
        ("temperature_sensor", "cabinet_temperature"),
        ("humidity_sensor", "cabinet_relative_humidity"),
        ("absolute_humidity_sensor", "cabinet_absolute_humidity"),
    ],
)
def test_the_bias_of_a_sensor_has_the_prior_of_its_accuracy(name: str, quantity: str) -> None:
    biased, plain = MECHANISMS[name](accuracy=0.1), MECHANISMS[name](accuracy=0.0)
    assert f"{quantity}_bias" not in {p.name for p in plain.parameters}
    prior = next(p for p in biased.parameters if p.name == f"{quantity}_bias").prior
    assert prior.mean == 0.0 and prior.sd == pytest.approx(0.1 / 1.96)


@every
def test_derivatives_of_rates_and_outputs_are_exact(k: int) -> None:
    """The traced model's Jacobian against complex steps through the same functions called with numbers."""
    _, model = variant(k)
    graph = Graph()
    names = {"x": model.states, "u": model.inputs, "p": tuple(p.name for p in model.parameters)}
    leaves = {k: {n: graph.symbol(f"{k}:{n}") for n in v} for k, v in names.items()}

    def everything(x: dict, u: dict, p: dict) -> list:
        found = model.evaluate(list(x.values()), u, p)
        noise = [v for i, row in enumerate(model.noise(p)) for v in row[i : i + 1]]
        return [*found.rates, *(v for pair in found.outputs.values() for v in pair), *noise]

    traced = [graph.lift(v) for v in everything(leaves["x"], leaves["u"], leaves["p"])]
    values, inputs = some_values(model), some_inputs(model)
    states = {
        s: 290.0 if s == "converter_temperature" else 7.5 if s == "vapour" else 0.4 for s in model.states
    }
    at = {"x": states, "u": {n: float(v[20]) for n, v in inputs.items()}, "p": values}
    known = {f"{k}:{n}": v for k, group in at.items() for n, v in group.items()}
    symbols = [s for group in ("x", "p") for s in leaves[group].values()]
    plain = everything(at["x"], at["u"], at["p"])
    np.testing.assert_allclose(np.array(graph.evaluate(traced, known), float), plain, rtol=1e-13, atol=1e-13)
    found = np.array([graph.evaluate(row, known) for row in jacobian(traced, symbols)], dtype=float)
    columns = []
    for group in ("x", "p"):
        for n in names[group]:
            moved = {k: dict(v) for k, v in at.items()}
            moved[group][n] = complex(moved[group][n], 1e-30)
            columns.append([np.imag(v) * 1e30 for v in everything(moved["x"], moved["u"], moved["p"])])
    np.testing.assert_allclose(found, np.array(columns).T, rtol=1e-11, atol=1e-13)


@every
def test_functions_are_pure_and_take_arrays(k: int) -> None:
    _, model = variant(k)
    values, inputs = some_values(model), some_inputs(model)
    before = {n: v.copy() for n, v in inputs.items()}
    states = [
        np.linspace(280.0, 300.0, len(TIME)) if s == "converter_temperature" else np.full(len(TIME), 0.5)
        for s in model.states
    ]
    whole = model.evaluate(states, inputs, values)
    again = model.evaluate(states, inputs, values)
    for at in (0, 17, len(TIME) - 1):
        one = model.evaluate([s[at] for s in states], {n: v[at] for n, v in inputs.items()}, values)
        for many, single in zip(whole.rates, one.rates, strict=True):
            assert np.broadcast_to(many, TIME.shape)[at] == pytest.approx(single, rel=1e-13, abs=1e-13)
        for output in model.outputs:
            assert np.broadcast_to(whole.outputs[output][0], TIME.shape)[at] == pytest.approx(
                one.outputs[output][0], rel=1e-13
            )
            assert one.outputs[output][1] > 0
    np.testing.assert_equal(again.rates, whole.rates)
    for n, v in before.items():
        np.testing.assert_array_equal(inputs[n], v)
    assert values == some_values(model)


# -- balances and closed forms -------------------------------------------------------------------------------
def contribution(**sums: float) -> Mechanism:
    return Mechanism(name="given", contributions=lambda p, x, u, q: dict(sums))


def free_run(model: Model) -> np.ndarray:
    return Likelihood(model, some_run(model)).trace(some_values(model), gain=False).mean


def test_vapour_is_conserved_where_the_exchange_is_shut() -> None:
    """The store is R_D*-equivalent air at ambient temperature: c* stays while both temperatures wander."""
    base = host(MECHANISMS["thermal_network"]())
    shut = extend(base, contribution(exchange=-1.0))
    place = shut.states.index("vapour")
    course = free_run(shut)
    # the step's polynomials leave 7e-14 of a state without any rate
    np.testing.assert_allclose(course[:, place], course[0, place], rtol=1e-13 * len(TIME))
    assert np.ptp(course[:, shut.states.index("converter_temperature")]) > 1.0
    assert np.ptp(free_run(base)[:, place]) > 0.1  # open, it follows the ambient


def test_what_is_released_into_a_shut_cabinet_is_in_it() -> None:
    shut = extend(host(MECHANISMS["thermal_network"]()), contribution(exchange=-1.0, vapour_release=0.35))
    course = free_run(shut)[:, shut.states.index("vapour")]
    np.testing.assert_allclose(course - course[0], 0.35 * (TIME - TIME[0]), rtol=0, atol=1e-12 * len(TIME))


@given(
    st.floats(-20, 40), st.floats(0.2, 1.0), st.floats(0.1, 50.0), st.floats(-20.0, 60.0), st.floats(-15, 25)
)
def test_heat_that_does_not_leave_is_stored(
    outside: float, ratio: float, tau: float, air: float, heat: float
) -> None:
    """Equations (2) and (3): heat in minus heat through R_AT is stored, ρ τ dT_conv/dt = f − (T_conv,a −
    T_amb)."""
    made = compose([MECHANISMS["thermal_network"](), contribution(heat_release=heat)])
    kelvin = outside + 273.15
    converter = kelvin + (air - outside) / ratio
    p = {"thermal_time_constant": tau, "resistance_ratio": ratio}
    found = made.evaluate([converter], {"ambient_temperature": kelvin}, p)
    inside = found.quantities["cabinet_air_temperature"]
    assert inside == pytest.approx(air + 273.15, abs=1e-9)
    assert ratio * tau * found.rates[0] == pytest.approx(heat - (inside - kelvin), abs=1e-8)
    steady = made.evaluate([kelvin + heat / ratio], {"ambient_temperature": kelvin}, p)
    assert steady.rates[0] == pytest.approx(0.0, abs=1e-10 / tau)
    assert steady.quantities["cabinet_air_temperature"] == pytest.approx(kelvin + heat, abs=1e-9)


@given(st.floats(255, 310), st.floats(260, 330), st.floats(0.02, 100.0))
def test_the_hygric_rate_is_that_of_the_gap(ambient: float, inside: float, k: float) -> None:
    """Equation (4) against a cabinet in physical units: volume, gap and Schirmer's diffusivity."""
    made = compose([MECHANISMS["measured_air"](), MECHANISMS["hygric_exchange"]()])
    unit = Cabinet(1.0, 1.0, 0.0, volume=3.0, gap=1.0, operation_W=(0, 0, 0, 0), standstill_W=(0, 0))
    cabinet = replace(unit, gap=unit.hygric_constant_h / k)
    u = {
        "ambient_temperature": ambient, "cabinet_temperature": inside, "ambient_absolute_humidity": 9.0,
        "exchange_factor": exchange_factor(ambient),
    }  # fmt: skip
    hours = hygric_time_constant(k, inside, ambient)
    # R_D* V* with V* = V T_amb/T_conv,a: the equivalent air fills what the cabinet air would at ambient
    # temperature
    resistance = float(cabinet.diffusion_resistance(np.array(ambient)))
    assert hours == pytest.approx(resistance * 3.0 * ambient / inside / 3600.0, rel=1e-12)
    rate = made.evaluate([7.0], u, {"hygric_k": k}).rates[0]
    assert rate == pytest.approx((9.0 - 7.0) / hours, rel=1e-12)


@given(st.floats(0.0, 1.2), st.floats(260, 310), st.sampled_from([0.0, 1.0]))
def test_heat_release_is_the_polynomial_of_the_operating_point(
    power: float, ambient: float, heating: float
) -> None:
    """In kelvin against the same release in watts through the outer resistance."""
    cabinet = Cabinet(
        1.0, 0.03, 0.0, 1.0, 1.0,
        operation_W=(250.0, 230.0, -70.0, -5.0), standstill_W=(160.0, -3.0), preheating_W=300.0, rated_W=2e6,
    )  # fmt: skip
    release = MECHANISMS["heat_release"](preheating=True)
    model = compose([MECHANISMS["thermal_network"](), release])
    on = float(power > 0)
    u = {
        "ambient_temperature": ambient, "operating": on, "power_1": power, "power_2": power**2,
        "preheating": heating,
    }  # fmt: skip
    names = (
        "heat_release_operation", "heat_release_power_1", "heat_release_power_2",
        "heat_release_operation_ambient",
        "heat_release_standstill", "heat_release_standstill_ambient", "preheating_heat",
    )  # fmt: skip
    watts = (*cabinet.operation_W, *cabinet.standstill_W, cabinet.preheating_W)
    p = {n: 0.03 * w for n, w in zip(names, watts, strict=True)}
    p |= {"thermal_time_constant": 1.0, "resistance_ratio": 0.9}
    assert {q.name for q in model.parameters} == set(p)
    found = model.evaluate([300.0], u, p).sums["heat_release"]
    expected = 0.03 * cabinet.heat_release(np.array(2e6 * power), np.array(ambient), np.array(heating))
    assert found == pytest.approx(float(expected), rel=1e-12, abs=1e-12)


def test_unknown_power_is_random_heat_of_the_records_variance() -> None:
    """Var of the release over a gap: slopes' C slopes, C the covariance of the power features of the
    record."""
    random = np.random.default_rng(4)
    power = random.random(5000)
    running = (power > 0.3).astype(float)
    features = np.column_stack([running, running * power, running * power**2])
    made = MECHANISMS["heat_release"](gap_covariance=np.cov(features.T, bias=True).tolist(), gap_time_h=7.0)
    model = compose([MECHANISMS["thermal_network"](), made])
    values = {p.name: p.start for p in model.parameters} | {
        "heat_release_operation": 8.0, "heat_release_power_1": 6.0, "heat_release_power_2": -1.0,
        "heat_release_standstill": 5.0, "heat_release_operation_ambient": 0.0,
        "heat_release_standstill_ambient": 0.0,
    }  # fmt: skip
    release = 5.0 + running * (8.0 - 5.0 + 6.0 * power - power**2)
    place = model.states.index("unknown_heat")
    u = {"ambient_temperature": 283.15}
    variance = model.initial(values, u)[1][place]
    assert variance == pytest.approx(release.var(), rel=1e-9)
    rate = -model.evaluate([290.0, 1.0], {**dict.fromkeys(model.inputs, 0.0), **u}, values).rates[place]
    assert rate == pytest.approx(1 / 7.0)
    assert model.noise(values)[place][place] == pytest.approx(2 * variance * rate)  # stationary


@pytest.mark.parametrize(
    "name", ["heat_disturbance", "second_heat_disturbance", "vapour_disturbance", "second_vapour_disturbance"]
)
def test_disturbances_are_stationary_ornstein_uhlenbeck_processes(name: str) -> None:
    model = host(MECHANISMS[name]())
    values = some_values(model) | {f"{name}_sd": 0.7, f"{name}_time": 5.0}
    place = model.states.index(name)
    u = {n: v[0] for n, v in some_inputs(model).items()}
    mean, variance = model.initial(values, u)
    assert (mean[place], variance[place]) == (0.0, pytest.approx(0.49))
    states = [1.0 if s == name else 0.0 for s in model.states]
    states[model.states.index("converter_temperature")] = 290.0
    assert model.evaluate(states, u, values).rates[place] == pytest.approx(-1 / 5.0)
    assert model.noise(values)[place][place] == pytest.approx(2 * 0.49 / 5.0)
    # its effect: heat_release in kelvin, or the air that the cabinet breathes in g/m³
    sums = model.evaluate(states, u, values).sums
    states[place] = 0.0
    other = model.evaluate(states, u, values).sums
    target = "heat_release" if "heat" in name else "ambient_vapour"
    assert {n for n in sums if sums[n] != other[n]} == {target}
    assert sums[target] - other[target] == pytest.approx(1.0, rel=1e-12)


@given(st.floats(2.0, 20.0), st.floats(265, 305), st.floats(270, 320))
def test_sensors_show_the_air_of_the_cabinet(vapour: float, ambient: float, inside: float) -> None:
    """Equation (5): c_conv,a = c* T_amb/T_conv,a; the relative humidity by the psychrometric functions."""
    air = MECHANISMS["measured_air"]()
    exchange = MECHANISMS["hygric_exchange"]()
    u = {
        "ambient_temperature": ambient, "cabinet_temperature": inside, "ambient_absolute_humidity": 8.0,
        "exchange_factor": exchange_factor(ambient),
    }  # fmt: skip
    p = {
        "hygric_k": 0.5, "cabinet_relative_humidity_bias": 0.01, "cabinet_relative_humidity_noise": 0.02,
        "cabinet_absolute_humidity_noise": 0.3,
    }  # fmt: skip
    concentration = vapour * ambient / inside
    relative = compose([air, exchange, MECHANISMS["humidity_sensor"](resolution=0.01)])
    shown, variance = relative.evaluate([vapour], u, p).outputs["cabinet_relative_humidity"]
    assert shown == pytest.approx(float(relative_humidity(1e-3 * concentration, inside)) + 0.01, rel=1e-9)
    assert variance == pytest.approx(0.02**2 + 0.01**2 / 12)
    absolute = compose([air, exchange, MECHANISMS["absolute_humidity_sensor"](resolution=0.1)])
    shown, variance = absolute.evaluate([vapour], u, p).outputs["cabinet_absolute_humidity"]
    assert shown == pytest.approx(concentration, rel=1e-12)
    assert variance == pytest.approx(0.3**2 + 0.1**2 / 12)
    doubted = compose(
        [MECHANISMS["measured_air"](accuracy=0.3), exchange, MECHANISMS["humidity_sensor"](accuracy=0.0)]
    )
    shown, _ = doubted.evaluate(
        [vapour], u | {"cabinet_temperature": inside + 0.2}, p | {"cabinet_temperature_offset": 0.2}
    ).outputs["cabinet_relative_humidity"]
    assert shown == pytest.approx(float(relative_humidity(1e-3 * concentration, inside)), rel=1e-9)


def test_a_slab_takes_up_water_as_ficks_law_has_it() -> None:
    """Crank, The Mathematics of Diffusion, equation 4.18; two places cannot follow the root of time at its
    very beginning."""
    share, pace = np.array(list(SLAB.values())).T
    assert share.sum() == pytest.approx(1.0)
    order = 2.0 * np.arange(2000)[:, None] + 1.0
    passed = np.geomspace(1e-3, 10.0, 300)
    crank = 1.0 - (8.0 / math.pi**2 / order**2 * np.exp(-(order**2) * passed)).sum(axis=0)
    ours = 1.0 - (share[:, None] * np.exp(-pace[:, None] * passed)).sum(axis=0)
    assert np.abs(ours - crank).max() < 0.06
    pulse = 1j * np.geomspace(0.3, 100.0, 200)
    root = np.sqrt(pulse * math.pi**2 / 4.0)
    ratio = (share[:, None] / (1.0 + pulse / pace[:, None])).sum(axis=0) / (np.tanh(root) / root)
    assert np.sqrt(np.mean(np.abs(ratio - 1.0) ** 2)) < 0.135


def test_a_moisture_capacity_is_the_isotherms_slope_at_half_humidity() -> None:
    wet = GAB_K * np.array([0.4999, 0.5001])
    content = GAB_C * wet / ((1.0 - wet) * (1.0 - wet + GAB_C * wet))
    assert np.diff(content)[0] / 0.0002 == pytest.approx(GAB_SLOPE, rel=1e-5)


def test_the_isotherm_goes_on_straight_beyond_its_range() -> None:
    """Between 2 and 98 % it is the equation's within 0.1 %; beyond 0 and 100 % it neither turns round nor has
    a pole."""
    h = np.linspace(0.02, 0.98, 97)
    wet = GAB_K * h
    content = GAB_C * wet / ((1.0 - wet) * (1.0 - wet + GAB_C * wet))
    found = np.array([float(_gab(one)) for one in h])
    assert found == pytest.approx(content, rel=1e-3)
    outside = np.array([float(_gab(one)) for one in np.linspace(-1.0, 3.0, 801)])
    slopes = np.diff(outside) / 0.005
    assert slopes.min() > 2.0 and slopes.max() < 12.2
    assert slopes[[0, -1]] == pytest.approx(GAB_ENDS, rel=1e-3)


def test_a_film_that_the_filter_makes_negative_comes_back() -> None:
    """In dry air a film dries, ever slower as it becomes drops; a film below nothing grows back, whatever its
    size."""
    film = condensation()
    values = SimpleNamespace(
        condensation_rate=2.0, surface_time=3.0, surface_share=0.05, surface_undercooling=1.0
    )
    inputs = SimpleNamespace(ambient_temperature=283.15)
    shared = SimpleNamespace(cabinet_air_temperature=288.15)

    def rate(amount: float) -> float:
        state = SimpleNamespace(film=amount, surface_temperature=283.15, vapour=4.0)
        return float(film.drift(values, state, inputs, shared, None)["film"])

    for amount in (0.02, 0.1, 1.0, 30.0):
        rates = rate(amount), rate(-amount)
        assert rates[0] < 0.0 < rates[1]
        # the published form, m/(m + 1 g/m³), but for the rounding of |m|
        wet = amount / (1.0 + amount)
        assert (rate(0.0) - rates[0]) / (rate(0.0) - rate(1e9)) == pytest.approx(wet, rel=0.02)
