"""Composition: the order of mechanisms does not matter, and what does not fit together is named."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from hygrokf.engine import traced_filter
from hygrokf.engine.timeline import timeline
from hygrokf.engine.traced_filter import Recursion
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.physics.holds import REGIME
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import SUMS, Mechanism, Model, compose, extend
from hygrokf.physics.parameters import Parameter


def store(name: str = "store", state: str = "heat", **more: object) -> Mechanism:
    """A state that decays towards a sum and is read."""
    return Mechanism(
        name=name,
        parameters=(Parameter(f"{name}_rate", "1/h", 1.0, 0.1, 9.0),),
        states=(state,),
        inputs=("outside",),
        drift=lambda p, x, u, q, s: {
            state: getattr(p, f"{name}_rate") * (u.outside + s.heat_release - getattr(x, state))
        },
        diffusion=lambda p: {state: 0.5},
        initial=lambda p, u: {state: (u.outside, 2.0)},
        **more,
    )


def source(name: str, value: float, of: str = "heat_release") -> Mechanism:
    return Mechanism(name=name, contributions=lambda p, x, u, q: {of: value * getattr(q, "scale", 1.0)})


READ = Mechanism(name="sensor", outputs={"y": lambda p, x, u, q, s: (x.heat + q.shift, 0.1)})
SHIFT = Mechanism(name="shift", quantities=lambda p, x, u, g: {"shift": 2.0, "scale": 3.0})


def test_the_order_of_mechanisms_does_not_matter() -> None:
    """Quantities before contributions before rates, whoever comes first."""
    parts = [store(), source("sun", 1.0), source("fan", -0.25), SHIFT, READ]
    for order in permutations(parts):
        found = compose(order, {"outside": "linear"}).evaluate([1.0], {"outside": 4.0}, {"store_rate": 0.5})
        assert found.sums["heat_release"] == pytest.approx(3.0 * 0.75)
        assert found.rates == [pytest.approx(0.5 * (4.0 + 2.25 - 1.0))]
        assert found.outputs["y"] == (3.0, 0.1)
        assert set(SUMS) <= set(found.sums)


def test_the_likelihood_does_not_depend_on_the_order(joint: object) -> None:
    case = joint.first(60)
    # sensors stay in their order: an extended filter linearises the second reading where the first has left
    # the state
    sensors = tuple(m for m in case.model.mechanisms if m.outputs)
    others = tuple(m for m in case.model.mechanisms if not m.outputs)
    turned = Model((*sensors, *others[::-1]), case.model.holds)
    assert turned.states != case.model.states and turned.outputs == case.model.outputs
    run = timeline(turned, case.timeline.time, case.inputs, case.readings)
    expected = case.likelihood.value(case.values)
    assert Likelihood(turned, run).value(case.values) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("bound", [0.0, -4.0, 2.5, float("nan")])
def test_a_bound_that_the_likelihood_cannot_represent_is_refused(bound: float) -> None:
    with pytest.raises(ValueError, match="bound: expected a number above 0 whose square is an integer"):
        Model((), bound=bound)
    assert Model((), bound=4.0).bound == 4.0


def test_interval_means_are_states_that_begin_at_zero() -> None:
    model = compose([store(), SHIFT, READ], {"outside": "linear"}, {"y": 0.5})
    assert model.states == ("heat", "mean_y") and model.mechanism_states == ("heat",)
    found = model.evaluate([1.0, 0.7], {"outside": 4.0}, {"store_rate": 0.5})
    assert found.rates == [pytest.approx(1.5), pytest.approx((1.0 + 2.0) / 0.5)]
    assert found.outputs["y"] == (0.7, 0.1)  # the reading is the mean; its noise is the sensor's
    mean, variance = model.initial({"store_rate": 0.5}, {"outside": 4.0})
    assert mean == [4.0, 0.0] and variance == [2.0, 0.0]
    assert model.noise({"store_rate": 0.5}) == [[0.5, 0.0], [0.0, 0.0]]
    assert model.resets == (1,)


def test_extending() -> None:
    base = compose([store(), SHIFT, READ], {"outside": "linear"})
    sun = Mechanism(
        name="sun", inputs=("irradiance",), contributions=lambda p, x, u, q: {"heat_release": u.irradiance}
    )
    larger = extend(replace(base, bound=3.0), sun, {"irradiance": "mean"})
    assert larger.bound == 3.0
    assert larger.inputs == ("outside", "irradiance")
    assert larger.holds == {"outside": "linear", "irradiance": "mean"}
    assert base.inputs == ("outside",) and base.holds == {"outside": "linear"}  # nothing changes in place
    assert larger.mechanisms[-1] is sun


def faulty(**changes: object) -> Model:
    parts = {
        "drift": lambda p, x, u, q, s: {"heat": -x.heat},
        "initial": lambda p, u: {"heat": (0.0, 1.0)},
    } | changes
    return compose([Mechanism(name="m", states=("heat", "cold"), **parts), READ, SHIFT])


def test_what_does_not_fit_is_named() -> None:
    with pytest.raises(ValueError, match=r"state of the same name: \['heat'\]"):
        _ = compose([store(), store("second")]).states
    with pytest.raises(ValueError, match="parameter named 'store_rate'"):
        _ = compose([store(), store(state="other")]).parameters
    with pytest.raises(ValueError, match=r"rate is given for the states \['cold'\]"):
        faulty().evaluate([0.0, 0.0], {}, {})
    with pytest.raises(ValueError, match=r"initial mean and variance for the states \['cold'\]"):
        faulty().initial({}, {})
    with pytest.raises(ValueError, match=r"holds of the inputs \['outside'\]"):
        _ = compose([store(), READ, SHIFT]).input_holds
    with pytest.raises(ValueError, match=r"\['outside'\] are not stated; stated are those of outsid"):
        _ = compose([store(), READ, SHIFT], {"outsid": "mean"}).input_holds
    with pytest.raises(ValueError, match=r"output of the same name: \['y'\]"):
        _ = compose([READ, READ]).outputs
    with pytest.raises(ValueError, match=r'averaged: expected names of y, found "Y"; did you mean "y"'):
        compose([READ], averaged={"Y": 1.0})
    with pytest.raises(ValueError, match="mechanisms: expected Mechanisms, found Model"):
        compose(compose([]))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="averaged: expected an interval above 0 h for y, found 0"):
        compose([READ], averaged={"y": 0.0})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"rates": lambda p, x, u: {"roon": -x.room}},
            'rates of .*"roon"; did you mean "room"',
        ),
        ({"rates": lambda p, x, u: [-x.room]}, r"rates .*expected a mapping .* found \["),
        (
            {"rates": lambda p, x, u: {"room": -x.rom}},
            'reads x.rom, but the states .* room; did you mean "room"',
        ),
        (
            {"rates": lambda p, x, u: {"room": p.pace * x.room}},
            "reads p.pace, but the parameters .* rate",
        ),
        (
            {"rates": lambda p, x, u: {"room": u.warm}},
            'reads u.warm, but the inputs .* "warmth"',
        ),
        (
            {"intensities": lambda p: {"rom": 1.0}},
            'diffusion of .*"rom"; did you mean "room"',
        ),
        ({"intensities": lambda p: 1.0}, r"diffusion .*expected a mapping .* found 1\.0"),
        (
            {"initial": lambda p, u: {"rom": (0.0, 1.0)}},
            'initial of .*"rom"; did you mean "room"',
        ),
        (
            {"initial": lambda p, u: {"room": 0.0}},
            r'initial of .* "room": expected a pair .*found 0.0',
        ),
        ({"outputs": {"y": lambda p, x, u: x.room}}, r'output "y": expected a pair \(mean, variance\)'),
    ],
)
def test_misspelt_names_and_wrong_forms_of_a_network_are_named(changes: dict, words: str) -> None:
    parts = {
        "rates": lambda p, x, u: {"room": p.rate * (u.warmth - x.room)},
        "outputs": {"y": lambda p, x, u: (x.room, 1.0)},
        "intensities": lambda p: {"room": 1.0},
        "initial": lambda p, u: {"room": (0.0, 1.0)},
    } | changes
    rate = Parameter("rate", "1/h", 1.0, 0.1, 9.0)
    network = linear_network("net", [rate], states=["room"], inputs=["warmth"], **parts)
    model = compose([network], {"warmth": "mean"})
    with pytest.raises(ValueError, match=words):
        run = timeline(model, np.arange(3.0), {"warmth": np.ones(3)}, {"y": np.ones(3)})
        Likelihood(model, run).value({"rate": 1.0})


def test_two_mechanisms_do_not_give_the_same_state() -> None:
    again = Mechanism(name="again", drift=lambda p, x, u, q, s: {"heat": 0.0})
    with pytest.raises(ValueError, match=r'rates of the mechanism "again": another mechanism gives .*heat'):
        compose([store(), again, READ, SHIFT]).evaluate([1.0], {"outside": 1.0}, {"store_rate": 1.0})
    first = Mechanism(name="first", initial=lambda p, u: {"heat": (0.0, 1.0)})
    with pytest.raises(ValueError, match=r'initial of the mechanism "first": another mechanism gives .*heat'):
        compose([store(), first]).initial({"store_rate": 1.0}, {"outside": 1.0})


def traced(*mechanisms: Mechanism) -> Recursion:
    return traced_filter.traced(compose([store(), READ, SHIFT, *mechanisms], {"outside": "linear"}))


def test_a_misspelt_sum_is_an_error_that_names_the_sums() -> None:
    with pytest.raises(ValueError, match="no mechanism reads") as caught:
        traced(
            source("sun", 1.0), source("fan", 1.0, of="heat_relese"), source("pump", 2.0, of="vapor_release")
        )
    said = str(caught.value)
    for word in ('"fan"', '"heat_relese"', '"heat_release"', '"pump"', '"vapor_release"', '"vapour_release"'):
        assert word in said
    assert '"sun"' not in said and all(name in said for name in SUMS)


def test_a_sum_that_is_read_and_never_added_to_is_named() -> None:
    reads = Mechanism(name="deep", states=("deep",), drift=lambda p, x, u, q,
        s: {"deep": s.deep_heat - x.deep},
                      initial=lambda p, u: {"deep": (0.0, 1.0)})  # fmt: skip
    with pytest.raises(AttributeError, match=r'"deep_heat", to which no mechanism adds.*heat_release'):
        traced(reads)
    # with a term the sum is the model's own, beside those that every model has, read or not
    made = traced(reads, source("rock", 2.0, of="deep_heat"), source("rain", 1.0, of="vapour_release"))
    assert made.model.states == ("heat", "deep")


def test_a_model_with_regimes_only_and_one_without_inputs_run() -> None:
    for inputs in ([], ["on"]):
        made = linear_network(
            "room", [Parameter("k", "1/h", 1.0, 0.1, 9.0)], ["x"], inputs,
            lambda p, x, u: {"x": -p.k * x.x + getattr(u, "on", 0.0)},
            {"y": lambda p, x, u: (x.x, 0.1)}, lambda p: {"x": 0.2}, lambda p, u: {"x": (1.0, 0.0)},
        )  # fmt: skip
        model = compose([made], {"on": REGIME})
        time = 0.5 * np.arange(6)
        on = (time > 1.2).astype(float)
        run = timeline(model, time, {"on": on} if inputs else {}, {"y": np.zeros(6)})
        found = Likelihood(model, run).trace({"k": 0.8}, gain=False).mean[:, 0]
        expected = [1.0]
        for k in range(1, 6):  # the regime of a step is that of the instant which ends it
            goal = on[k] / 0.8 if inputs else 0.0
            expected.append(goal + (expected[-1] - goal) * np.exp(-0.4))
        np.testing.assert_allclose(found, expected, rtol=1e-12)
