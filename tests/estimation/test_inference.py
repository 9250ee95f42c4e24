"""Bounds and time constants of any model, against closed forms, python-control and the parameters that are
time constants."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from builders import masses
from builders.constant_level import constant_level

from hygrokf.engine.timeline import timeline
from hygrokf.estimation import profile_likelihood
from hygrokf.estimation.confidence import uncertainty, wald_bounds
from hygrokf.estimation.inference import (
    BOUND_METHODS,
    confidence_intervals,
    modal_time_constants,
    parameter_table,
)
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective, fit_mle
from hygrokf.physics.mechanisms import linear_network
from hygrokf.physics.model import compose
from hygrokf.physics.parameters import Parameter, Prior
from hygrokf.texts.fit_codes import FitCode


@pytest.fixture(scope="module")
def thermal(make_case: Callable) -> tuple[Likelihood, Estimate]:
    case = make_case("thermal", 0.25 * np.arange(1200), 31, missing=0.02)
    held = {"cabinet_temperature_bias": case.values["cabinet_temperature_bias"]}
    return case.likelihood, fit_mle(case.likelihood, case.values, fixed=held, count=1)


def swing(period: float = 5.0, decay: float = 8.0) -> tuple[Likelihood, Estimate]:
    """Readings of a damped oscillator: x' = −x/τ + ω y, y' = −ω x − y/τ; and of an integral beside it."""
    made = linear_network(
        "swing",
        [
            Parameter("decay", "h", decay, 1.0, 100.0, positive=True),
            Parameter("omega", "1/h", 2.0 * math.pi / period, 0.1, 10.0, positive=True),
            Parameter("noise", "1", 0.3, 1e-3, 10.0, positive=True, noise=True),
        ],
        ["x", "y", "level"],
        ["push"],
        lambda p, x, u: {
            "x": u.push - x.x / p.decay + p.omega * x.y,
            "y": -p.omega * x.x - x.y / p.decay,
            "level": 0.0 * x.level,
        },
        {"read": lambda p, x, u: (x.x + x.level, p.noise * p.noise)},
        lambda p: {"x": 0.01, "y": 0.01, "level": 0.001},
        lambda p, u: {"x": (1.0, 0.01), "y": (0.0, 0.01), "level": (0.0, 0.01)},
    )
    model = compose([made], {"push": "mean"})
    random = np.random.default_rng(11)
    time = 0.5 * np.arange(400.0)
    push = np.repeat(random.normal(size=40), 10)
    angle = np.exp(-0.5 / decay) * np.exp(-2j * math.pi * 0.5 / period)
    pole = -1.0 / decay - 2j * math.pi / period
    x = np.empty(400, dtype=complex)
    x[0] = 1.0
    for k in range(1, 400):
        x[k] = angle * x[k - 1] + push[k] * (angle - 1.0) / pole
    read = x.real + 0.3 * random.normal(size=400)
    likelihood = Likelihood(model, timeline(model, time, {"push": push}, {"read": read}))
    return likelihood, fit_mle(likelihood, count=1)


def test_a_parameter_that_is_a_time_constant_has_its_own_bounds(thermal: tuple) -> None:
    """ln of the network's time constant is a coordinate: the delta method must give the parameter's Wald
    bounds."""
    likelihood, estimate = thermal
    known = uncertainty(Objective(likelihood, estimate.coordinates), estimate)
    bounds = wald_bounds(estimate, known, "thermal_time_constant")
    constants = modal_time_constants(likelihood, estimate, known=known)
    own = next(c for c in constants if next(iter(c.states)) == "converter_temperature")
    assert own.value == pytest.approx(estimate.values["thermal_time_constant"], rel=1e-12)
    # the Jacobian's derivatives are differences with an error of 1e-10
    assert own.lower == pytest.approx(bounds.lower, rel=1e-8)
    assert own.upper == pytest.approx(bounds.upper, rel=1e-8)
    slow = next(c for c in constants if next(iter(c.states)) == "heat_disturbance")
    assert slow.value == pytest.approx(estimate.values["heat_disturbance_time"], rel=1e-12)
    assert slow.period == math.inf and all(c.level == 0.95 for c in constants)


def test_oscillation_and_integral() -> None:
    """Closed form: λ = −1/τ ± iω, and 0 for the level; τ and ω are coordinates, so their errors are known."""
    likelihood, estimate = swing()
    known = uncertainty(Objective(likelihood, estimate.coordinates), estimate)
    constants = modal_time_constants(likelihood, estimate, 0.9, known=known)
    assert len(constants) == 2  # a pair of conjugate eigenvalues is one mode
    level, pair = constants
    assert level.value == level.lower == level.upper == math.inf and level.states["level"] == 1.0
    assert pair.value == pytest.approx(estimate.values["decay"], rel=1e-10)
    assert pair.period == pytest.approx(2.0 * math.pi / estimate.values["omega"], rel=1e-10)
    own = wald_bounds(estimate, known, "decay", 0.9)
    assert (pair.lower, pair.upper) == (
        pytest.approx(own.lower, rel=1e-7),
        pytest.approx(own.upper, rel=1e-7),
    )
    assert pair.lower < 8.0 < pair.upper and pair.period == pytest.approx(5.0, rel=0.1)
    assert pair.states["x"] == pytest.approx(0.5) and sum(pair.states.values()) == pytest.approx(1.0)


def test_two_masses_against_python_control_and_a_simulated_covariance() -> None:
    """Poles of two coupled masses; the bounds against the scatter of the poles over draws of the
    parameters."""
    random, time = np.random.default_rng(3), 0.25 * np.arange(1500.0)
    likelihood = masses.likelihood(time, *masses.simulated(time, random))
    estimate = fit_mle(likelihood, masses.VALUES, count=1)
    known = uncertainty(Objective(likelihood, estimate.coordinates), estimate)
    slow, fast = modal_time_constants(likelihood, estimate, known=known)

    import control

    a, b = masses.matrices(estimate.values)
    poles = control.poles(control.ss(a, b, np.eye(2), np.zeros((2, 2))))
    np.testing.assert_allclose(sorted(-1.0 / poles.real), [fast.value, slow.value], rtol=1e-9)

    places = [estimate.coordinates.names.index(name) for name in known.names]
    drawn = []
    for move in random.multivariate_normal(np.zeros(len(places)), 0.01 * known.wider, size=4000):
        z = estimate.z.copy()
        z[places] += move
        at, _ = masses.matrices(estimate.coordinates.values(z))
        drawn.append(np.sort(np.log(-1.0 / np.linalg.eigvals(at).real)))
    # a tenth of the covariance's root keeps the draws linear; 4,000 draws know a deviation to 1.1 %
    for one, sd in zip((fast, slow), np.std(drawn, axis=0), strict=True):
        assert math.log(one.upper / one.lower) / (2 * 1.959964) == pytest.approx(10.0 * sd, rel=0.05)


def test_a_model_that_is_not_linear_is_linearised_where_it_is_asked_to(make_case: Callable) -> None:
    """Equation (4): R_D*V* of a hygric part goes with 1/T of the cabinet, and its bounds are those of k."""
    case = make_case("cascade", 0.25 * np.arange(800), 32)
    estimate = fit_mle(case.likelihood, case.values, count=1)
    known = uncertainty(Objective(case.likelihood, estimate.coordinates), estimate)
    own = wald_bounds(estimate, known, "hygric_k")
    found = {}
    for kelvin in (285.0, 305.0):
        constants = modal_time_constants(
            case.likelihood, estimate, inputs={"cabinet_temperature": kelvin}, known=known
        )
        fast = constants[-1]
        assert next(iter(fast.states)) == "vapour"
        assert fast.upper / fast.lower == pytest.approx(own.upper / own.lower, rel=1e-6)
        found[kelvin] = fast.value
    assert found[285.0] / found[305.0] == pytest.approx(305.0 / 285.0, rel=1e-9)


def test_bounds_by_each_method_are_those_of_its_covariance(thermal: tuple) -> None:
    likelihood, estimate = thermal
    known = uncertainty(Objective(likelihood, estimate.coordinates), estimate)
    place = known.place("heat_disturbance_time")
    for method, covariance in (("wald", known.wald), ("sandwich", known.sandwich)):
        bounds = confidence_intervals(likelihood, estimate, ["heat_disturbance_time"], method, 0.9)
        found = bounds["heat_disturbance_time"]
        reach = 1.644854 * math.sqrt(covariance[place, place])
        assert found.upper == pytest.approx(found.value * math.exp(reach), rel=1e-6)
        assert found.lower == pytest.approx(found.value * math.exp(-reach), rel=1e-6)
        assert found.method == method and found.level == 0.9
    everything = confidence_intervals(likelihood, estimate, method="wald")
    assert tuple(everything) == estimate.coordinates.names
    profiled = confidence_intervals(likelihood, estimate, ["thermal_time_constant"])["thermal_time_constant"]
    assert profiled.method == "profile" and len(profiled.curve) > 3


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"names": ["thermal_time_constnt"]}, "thermal_time_constnt"),
        ({"names": ["cabinet_temperature_bias"]}, "expected free parameters"),
        ({"method": "bootstrap"}, "profile, likelihood-ratio, wald, sandwich, found 'bootstrap'"),
        ({"level": 95}, "between 0 and 1, found 95"),
    ],
)
def test_wrong_requests_are_named(thermal: tuple, wrong: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        confidence_intervals(*thermal, **wrong)


def test_points_that_the_model_does_not_have_are_named(thermal: tuple) -> None:
    with pytest.raises(ValueError, match=r"state: expected names of .*converter_temperature.*, found wall"):
        modal_time_constants(*thermal, state={"wall": 280.0})
    with pytest.raises(ValueError, match=r"inputs: expected names of .*, found windd"):
        modal_time_constants(*thermal, inputs={"windd": 3.0})


# -- what the readings do not determine ----------------------------------------------------------------------
def product_of_two(count: int = 300) -> tuple[Likelihood, Estimate]:
    """A lag with the gain a·b: neither of the two acts alone."""
    names = [("a", "1", 1.0, 0.1, 10.0), ("b", "1", 1.5, 0.1, 10.0), ("tau", "h", 2.0, 0.05, 50.0)]
    noise = [("r", "K", 0.1, 1e-3, 10.0), ("s", "K", 0.3, 1e-3, 10.0)]
    made = linear_network(
        "lag",
        [Parameter(*row, positive=True) for row in names]
        + [Parameter(*row, positive=True, noise=True) for row in noise],
        ["x"],
        ["u"],
        lambda p, x, u: {"x": (p.a * p.b * u.u - x.x) / p.tau},
        {"y": lambda p, x, u: (x.x, p.r * p.r)},
        lambda p: {"x": p.s * p.s},
        lambda p, u: {"x": (p.a * p.b * u.u, 1.0)},
    )
    model = compose([made], {"u": "mean"})
    random = np.random.default_rng(3)
    time = np.arange(count) / 6.0
    push, level, read = np.where(time % 8.0 < 4.0, 1.0, 0.0), 0.0, np.empty(count)
    for k in range(count):
        level += (2.0 * push[k] - level) / 18.0 + 0.3 * math.sqrt(1.0 / 6.0) * random.normal()
        read[k] = level + 0.1 * random.normal()
    likelihood = Likelihood(model, timeline(model, time, {"u": push}, {"y": read}))
    return likelihood, fit_mle(likelihood, count=1)


@pytest.fixture(scope="module")
def product() -> tuple[Likelihood, Estimate]:
    return product_of_two()


@pytest.mark.parametrize("method", ["profile", "likelihood-ratio", "wald", "sandwich"])
def test_what_acts_only_as_a_product_is_open_by_each_method(product: tuple, method: str) -> None:
    found = confidence_intervals(*product, ["a", "b", "tau"], method)
    for name in ("a", "b"):
        assert (found[name].lower, found[name].upper) == (0.0, math.inf)
        assert found[name].statements == (FitCode.OPEN_ON_BOTH_SIDES(),)
    assert 1.0 < found["tau"].lower < found["tau"].value < found["tau"].upper < 10.0
    assert found["tau"].method == method


def test_a_mode_whose_parameters_are_open_is_open() -> None:
    """x' = (u − x) a b: the decay is 1/(a b), and so is determined, while b alone is not; with b held a
    is."""
    made = linear_network(
        "lag",
        [Parameter(n, "1", 0.7, 0.01, 50.0, positive=True) for n in ("a", "b")]
        + [Parameter("r", "K", 0.1, 1e-3, 10.0, positive=True, noise=True)],
        ["x", "y"],
        ["u"],
        lambda p, x, u: {"x": (u.u - x.x) * p.a * p.b, "y": -p.b * x.y},
        {"read": lambda p, x, u: (x.x, p.r * p.r)},
        lambda p: {"x": 0.01, "y": 1.0},
        lambda p, u: {"x": (0.0, 1.0), "y": (0.0, 1.0)},
    )
    model = compose([made], {"u": "mean"})
    random = np.random.default_rng(8)
    push, level, read = np.repeat(random.normal(size=20), 10), 0.0, np.empty(200)
    for k in range(200):
        level += (push[k] - level) * -math.expm1(-0.25) + 0.1 * random.normal()
        read[k] = level + 0.1 * random.normal()
    likelihood = Likelihood(model, timeline(model, np.arange(200.0), {"u": push}, {"read": read}))
    estimate = fit_mle(likelihood, count=1)
    modes = {next(iter(one.states)): one for one in modal_time_constants(likelihood, estimate)}
    assert (modes["y"].lower, modes["y"].upper) == (0.0, math.inf)
    assert 2.0 < modes["x"].lower < modes["x"].value < modes["x"].upper < 8.0
    held = fit_mle(likelihood, fixed={"b": estimate.values["b"]}, count=1)
    alone = {next(iter(one.states)): one for one in modal_time_constants(likelihood, held)}
    assert modes["x"].upper == pytest.approx(alone["x"].upper, rel=1e-3)
    assert modes["x"].lower == pytest.approx(alone["x"].lower, rel=1e-3)


def test_a_time_constant_below_what_the_readings_resolve_is_open_below(product: tuple) -> None:
    """Independent readings under a constant input: as fast a lag as one likes explains them."""
    likelihood = product[0]
    read = 2.0 + 0.1 * np.random.default_rng(4).normal(size=len(likelihood.timeline))
    model, time = likelihood.model, likelihood.timeline.time
    flat = Likelihood(model, timeline(model, time, {"u": np.ones(len(time))}, {"y": read}))
    (found,) = modal_time_constants(flat, fit_mle(flat, count=3))
    assert found.lower == 0.0


def test_a_table_tells_what_is_known_together(product: tuple) -> None:
    likelihood, estimate = product
    table = parameter_table(likelihood, estimate)
    rows = {row.name: row for row in table.rows}
    assert math.isnan(rows["a"].standard_error) and rows["a"].upper == math.inf
    known = uncertainty(Objective(likelihood, estimate.coordinates), estimate)
    assert rows["tau"].standard_error == pytest.approx(
        rows["tau"].value * math.sqrt(known.wider[2, 2]), rel=1e-9
    )
    best, worst = table.combinations
    assert best.text in ("a·b", "b·a") and best.determined and not worst.determined
    # with b held, a alone has the product's standard error
    held = fit_mle(likelihood, fixed={"b": estimate.values["b"]}, count=1)
    alone = uncertainty(Objective(likelihood, held.coordinates), held)
    assert best.standard_error == pytest.approx(math.sqrt(alone.wald[0, 0]), rel=1e-3)
    assert str(best) == f"{best.text} is known to {100.0 * best.standard_error:.2g} %"
    shown = str(table).splitlines()
    assert len(shown) == 8 and max(map(len, shown)) <= 100 and shown[-1].endswith("is not determined")
    frame = table.to_frame()
    assert list(frame.index) == list(estimate.values) and frame.loc["tau", "unit"] == "h"
    assert table.correlation[0, 1] == pytest.approx(-1.0, abs=1e-6)
    with pytest.raises(ValueError, match="between 0 and 1"):
        parameter_table(likelihood, estimate, 95.0)


def test_a_table_names_priors_limits_and_what_is_held() -> None:
    parameters = [
        Parameter("mean", "K", 1.0, -5.0, 2.0),
        Parameter("bias", "K", 0.0, -4.0, 4.0, prior=Prior(0.0, 1.0)),
        Parameter("spread", "K", 1.0, 1e-3, 1e3, positive=True),
    ]
    read = 3.0 + 0.7 * np.random.default_rng(1).normal(size=60)
    likelihood = constant_level(parameters, read, lambda p: p.mean, lambda p: p.spread * p.spread)
    shown = str(parameter_table(likelihood, fit_mle(likelihood, fixed={"bias": 0.5}, count=1)))
    assert "at its upper limit" in shown and "fixed, prior 0 ± 1" in shown


def test_profiles_tell_their_progress_and_have_bounded_work(
    product: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    confidence_intervals(*product, ["tau", "r"], progress=said.append)
    assert said == [
        f"{k} of 2: profile of {name}, {end} end"
        for k, name in ((1, "tau"), (2, "r"))
        for end in ("lower", "upper")
    ]
    monkeypatch.setattr(profile_likelihood, "WALK_PASSES", 3)
    passes = []
    score = Likelihood.score

    def counted(self: Likelihood, values: dict) -> tuple:
        passes.append(1)
        return score(self, values)

    monkeypatch.setattr(Likelihood, "score", counted)
    cut = confidence_intervals(*product, ["tau"])["tau"]
    assert (cut.lower, cut.upper) == (0.0, math.inf)
    assert FitCode.END_NOT_FOUND(end="upper", passes=3) in cut.statements
    # ten for the observed information; a walk ends a few passes after its share
    assert len(passes) <= 10 + 2 * (3 + 12)


def in_units(hours: float) -> tuple[Likelihood, Estimate]:
    """A lag with a drift, with its time and all parameters in a unit of 1/`hours`."""
    root = math.sqrt(hours)
    made = linear_network(
        "lag",
        [
            Parameter("tau", "h", 4.0 * hours, 0.2 * hours, 100.0 * hours, positive=True),
            Parameter("gain", "1", 1.0, -10.0, 10.0),
            Parameter("drift", "K/h", 0.01 / hours, -5.0 / hours, 5.0 / hours),
            Parameter("s", "K", 0.3 / root, 1e-3 / root, 10.0 / root, positive=True, noise=True),
            Parameter("r", "K", 0.2, 1e-3, 10.0, positive=True, noise=True),
        ],
        ["x"],
        ["u"],
        lambda p, x, u: {"x": (p.gain * u.u - x.x) / p.tau + p.drift},
        {"y": lambda p, x, u: (x.x, p.r * p.r)},
        lambda p: {"x": p.s * p.s},
        lambda p, u: {"x": (0.0, 1.0)},
    )
    model = compose([made], {"u": "mean"})
    random = np.random.default_rng(5)
    push, level, slow, read = np.repeat(random.normal(size=15), 10), 0.0, 0.0, np.empty(150)
    for k in range(150):
        level += (2.0 * push[k] + 0.3 - level) * -math.expm1(-1.0 / 6.0) + 0.2 * random.normal()
        slow = 0.8 * slow + 0.1 * random.normal()
        read[k] = level + slow + 0.1 * random.normal()
    likelihood = Likelihood(model, timeline(model, hours * np.arange(150.0), {"u": push}, {"y": read}))
    return likelihood, fit_mle(likelihood, count=2)


def test_nothing_depends_on_the_unit_of_time() -> None:
    powers = {"tau": 1.0, "gain": 0.0, "drift": -1.0, "s": -0.5, "r": 0.0}

    def bounds(hours: float) -> dict:
        case = in_units(hours)
        found = {m: confidence_intervals(*case, method=m) for m in BOUND_METHODS}
        ends = {
            (m, n): np.array([b.lower, b.upper]) / hours ** powers[n]
            for m, each in found.items()
            for n, b in each.items()
        }
        (mode,) = modal_time_constants(*case)
        return ends | {("modal", "tau"): np.array([mode.lower, mode.upper]) / hours}

    one = bounds(1.0)
    for hours in (1.0 / 24.0, 3600.0):
        for key, ends in bounds(hours).items():
            np.testing.assert_allclose(ends, one[key], rtol=1e-6, err_msg=str(key))
