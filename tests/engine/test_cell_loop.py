"""The simulation over cells: closed forms, the package's own free run, the truth of plants of another make.

Vapour is compared as vapour: the simulated relative humidity times saturation at the measured temperature.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from plants import Plant, plant, undisturbed
from plants.as_record import to_record
from plants.hidden import hidden_plant

from hygrokf.data.record import Record
from hygrokf.discovery import simulator as simulator_module
from hygrokf.discovery.scene import Scene, driven, scene_of
from hygrokf.discovery.simulator import Simulator
from hygrokf.engine.cell_loop import CONTROL, CellInputs, CellModel, run
from hygrokf.engine.llvm_writer import LANES
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.evaluation.self_switching import self_switched
from hygrokf.evaluation.simulation import free_run
from hygrokf.modelling.design import CASCADE, JOINT, Chosen, Design, design, extended
from hygrokf.modelling.inputs import Run, model_inputs
from hygrokf.modelling.library import LIBRARY, Library
from hygrokf.physics.mechanisms import MECHANISMS, linear_network
from hygrokf.physics.mechanisms.hygric import exchange_factor
from hygrokf.physics.model import Mechanism, Model, compose
from hygrokf.physics.parameters import Parameter
from hygrokf.physics.switches import CONTROLLED, Throttle

TOLERANCE = {"temperature": 0.02, "vapour": 0.02}
"""[K], [g/m³] root mean square difference to the package's free run and to a plant's truth."""
SETTLED_H = 72.0


# -- closed forms --------------------------------------------------------------------------------------------
def low_pass(count: int = 1) -> Model:
    """x₁' = (u − x₁)/τ, x₂' = (x₁ − x₂)/τ …; the last one is read."""
    states = [f"x{i}" for i in range(count)]

    def rates(p, x, u):
        before = [u.drive, *(getattr(x, name) for name in states)]
        return {name: (before[i] - getattr(x, name)) / p.tau for i, name in enumerate(states)}

    mechanism = linear_network(
        "low_pass", [Parameter("tau", "h", 1.0, 1e-6, 1e6)], states, ["drive"], rates,
        {"reading": lambda p, x, u: (getattr(x, states[-1]), 1.0)}, lambda p: {}, lambda p, u: {},
    )  # fmt: skip
    return compose([mechanism], {"drive": "linear"})


def passed(model: Model, tau: float, hours: float, edges: np.ndarray, begun: float = 0.0) -> np.ndarray:
    """(K,) readings under an input that is straight within the cells."""
    cell_model = CellModel(None, model)
    inputs = np.zeros((len(edges), len(cell_model.inputs)))
    inputs[:, cell_model.inputs.index("drive")] = edges
    cells = CellInputs(hours, 0.5 * (inputs[1:] + inputs[:-1]), inputs)
    theta = np.zeros((len(cell_model.parameters), LANES))
    theta[cell_model.parameters.index("tau")] = tau
    out = run(cell_model, cells, theta, np.full((len(model.states), LANES), begun), [])
    assert (out == out[:, :, :1]).all()
    return out[:, 0, 0]


@pytest.mark.parametrize("tau", [1e-3, 0.1, 2.0, 300.0, 1e5])
def test_a_constant_input_is_exact(tau):
    time = 0.125 * np.arange(1, 401)
    expected = 7.0 + (3.0 - 7.0) * np.exp(-time / tau)
    assert_allclose(passed(low_pass(), tau, 0.125, np.full(401, 7.0), 3.0), expected, rtol=1e-12)


@pytest.mark.parametrize("tau", [1e-3, 0.1, 2.0, 300.0])
def test_an_input_that_rises_in_a_straight_line_is_exact(tau):
    """x = u − bτ + (x₀ − a + bτ) e^(−t/τ) for u = a + b t; a step's rounding is 1e-16 of the states."""
    time, a, b = 0.125 * np.arange(0, 401), 290.0, 0.4
    expected = a + b * time - b * tau + (3.0 - a + b * tau) * np.exp(-time / tau)
    found = passed(low_pass(), tau, 0.125, a + b * time, 3.0)
    assert_allclose(found, expected[1:], rtol=0, atol=1e-12 * 290.0 * (1.0 + tau))


def test_a_fast_state_follows_its_input_at_the_end_of_a_cell():
    edges = np.random.default_rng(1).uniform(280.0, 300.0, 200)
    found = passed(low_pass(), 1e-6, 0.125, edges, 280.0)
    assert_allclose(found, edges[1:], atol=1e-3)


def test_the_error_of_states_in_a_chain_falls_with_the_square_of_the_cell():
    """A state enters the one after it as a straight line; each alone would be exact."""

    def error(parts: int) -> float:
        time = np.linspace(0.0, 40.0, 40 * parts + 1)
        found = passed(low_pass(2), 1.5, 1.0 / parts, np.ones(len(time)))
        expected = 1.0 - (1.0 + time / 1.5) * np.exp(-time / 1.5)
        return float(np.abs(found - expected[1:]).max())

    errors = [error(parts) for parts in (2, 4, 8, 16)]
    assert errors[0] < 5e-3
    assert all(3.5 < coarse / fine < 4.5 for coarse, fine in pairwise(errors))


def test_an_amount_does_not_fall_below_zero():
    stock = Mechanism(
        name="stock", parameters=(Parameter("tau", "h", 1.0, 0.1, 10.0),), states=("stock",),
        inputs=("drive",), drift=lambda p, x, u, q, s: {"stock": u.drive},
        initial=lambda p, u: {"stock": (0.0, 1.0)},
        outputs={"reading": lambda p, x, u, q, s: (x.stock, 1.0)}, amounts=("stock",),
    )  # fmt: skip
    edges = np.array([1.0, 1.0, -3.0, -3.0, -3.0, 1.0, 1.0])
    found = passed(compose([stock], {"drive": "linear"}), 1.0, 1.0, edges)
    assert_allclose(found, [1.0, 0.0, 0.0, 0.0, 0.0, 1.0])


# -- the package's own free run ------------------------------------------------------------------------------
OPTIONS: dict[str, dict[str, Any]] = {
    "instants": {},
    "means": {"logger_mean": True},
    "hourly means": {"logger_mean": True, "logger_step_min": 60.0},
}


@cache
def record_of(seed: int, kind: str = "instants", days: float = 30.0) -> Record:
    # across a gap the scene joins the readings, the filter's inputs keep the last one
    whole = {"logger_gaps": 0, "power_gap_days": 0.0}
    return to_record(hidden_plant(seed, "none", days=days, **whole, **OPTIONS[kind]))


@dataclass(frozen=True)
class Effect:
    """What is added to the base models, and its values; the rest has its start."""

    heat: tuple[Chosen, ...] = ()
    vapour: tuple[Chosen, ...] = ()
    features: Mapping[str, Mapping[str, Any]] | None = None
    values: Mapping[str, float] | None = None


def designs(record: Record, effect: Effect) -> dict[str, Design]:
    def wider(kind: str, additions: tuple[Chosen, ...]) -> Design:
        made = extended(design(record, kind=kind, coloured=False), additions)
        read = {k: v for k, v in (effect.features or {}).items() if k in made.model.inputs}
        return replace(made, features={**made.features, **read})

    return {
        "temperature": wider("thermal", effect.heat),
        "vapour": wider(CASCADE, effect.vapour),
        "both": wider(JOINT, (*effect.heat, *effect.vapour)),
    }


CABINET = {
    "thermal_time_constant": 1.2, "resistance_ratio": 0.85, "heat_release_operation": 7.0,
    "heat_release_power_1": 6.0, "heat_release_power_2": -1.0, "heat_release_operation_ambient": -0.1,
    "heat_release_standstill": 5.0, "heat_release_standstill_ambient": -0.05, "preheating_heat": 8.0,
    "hygric_k": 0.35, "cabinet_temperature_bias": 0.1, "cabinet_relative_humidity_bias": 0.01,
}  # fmt: skip
"""A cabinet in the middle of the plants' ranges."""


def started(one: Design, effect: Effect) -> dict[str, float]:
    wanted = {**CABINET, **(effect.values or {})}
    return {p.name: wanted.get(p.name, p.start) for p in one.model.parameters}


def finer(scene: Scene, parts: int) -> Scene:
    """The scene with cells of a part of their length."""
    readings = {q: replace(r, begin=parts * r.begin, end=parts * r.end) for q, r in scene.readings.items()}
    made = replace(
        scene, cell_h=scene.cell_h / parts, count=scene.count * parts, readings=readings, _cache={}
    )
    return replace(made, drive=np.interp(made.edges_s, scene.edges_s, scene.drive))


def simulator(scene: Scene, made: Mapping[str, Design]) -> Simulator:
    return Simulator(scene, made["temperature"], made["vapour"])


def parameters(one: Simulator, *values: Mapping[str, float]) -> np.ndarray:
    """(P, 1) of values by name, the levels of controllers from their features."""
    given = {p.name: p.start for p in one.parameters}
    for some in values:
        given |= {k: v for k, v in some.items() if k in given}
    return np.array([[given[name]] for name in one.names])


def simulated(made: Design, values: Mapping[str, float], line: Run, quantity: str) -> np.ndarray:
    found = free_run(made, values, line)
    pair = found.temperature if quantity == "temperature" else found.relative_humidity
    assert pair is not None
    return pair[0]


def differences(record: Record, effect: Effect, quantity: str) -> list[float]:
    """Root mean square difference [K] or [g/m³] to the free run, for cells and for half cells."""
    made = designs(record, effect)
    one = made[quantity]
    values = started(one, effect)
    line = model_inputs(one, record)
    expected = simulated(one, values, line, quantity)
    scene = scene_of(record, made["temperature"], made["vapour"])
    found = []
    for part in (1, 2):
        sim = simulator(finer(scene, part) if part > 1 else scene, made)
        shown = sim.simulated(parameters(sim, values), quantity)[:, 0]
        r = sim.scene.readings[quantity]
        at = np.minimum(np.searchsorted(line.timeline.seconds, r.time_s - 0.5), len(expected) - 1)
        there = np.isfinite(r.value) & (r.time_h > SETTLED_H)
        assert np.abs(line.timeline.seconds[at] - r.time_s)[there].max() < 0.5
        found.append(rms((shown - expected[at] * r.saturated)[there]))
    return found


def rms(values: np.ndarray) -> float:
    return math.sqrt(float(np.mean(values**2)))


EFFECTS = {
    "base": Effect(),
    "wall": Effect(
        (("wall_thermal_mass", {}),),
        values={"wall_conductance": 1.5, "wall_time_constant": 7.0, "wall_position": 0.5},
    ),
    "condensation": Effect(
        vapour=(("condensation", {}),),
        values={"surface_time": 2.0, "surface_undercooling": 3.0, "condensation_rate": 2.0},
    ),
    "rain": Effect(
        vapour=(("rain_ingress", {}),), values={"rain_intake": 4.0, "rain_drying_time": 3.0}
    ),
    "throttled heater": Effect(
        (("unreported_heater", {"flag": "throttled_heating"}),),
        features={"throttled_heating": {"reads": "cabinet_temperature", "start": 290.0, "full": 288.0}},
        values={"heater_heat": 6.0},
    ),
    "vent": Effect(
        (("vent_loss", {}),), (("vent_exchange", {}),),
        {"venting": {"reads": "cabinet_temperature", "start": 292.0, "full": 296.0}},
        {"vent_conductance": 1.5, "vent_exchange": 2.0},
    ),
}  # fmt: skip


def names_of(effect: Effect) -> set[str]:
    added = [MECHANISMS[name](**settings) for name, settings in (*effect.heat, *effect.vapour)]
    return {p.name for one in added for p in one.parameters}


def acts_on(effect: Effect) -> tuple[str, ...]:
    return tuple(q for q, added in (("temperature", effect.heat), ("vapour", effect.vapour)) if added) or (
        "temperature", "vapour",
    )  # fmt: skip


CASES = [
    (name, quantity) for name, effect in EFFECTS.items() for quantity in acts_on(effect) if name != "vent"
]


@pytest.mark.parametrize(("name", "quantity"), CASES)
def test_cells_give_the_free_run_of_the_package(name, quantity):
    # this plant has a rain gauge
    coarse, fine = differences(record_of(8605, days=20.0), EFFECTS[name], quantity)
    assert coarse <= TOLERANCE[quantity]
    assert fine < 0.8 * coarse


@pytest.mark.parametrize(("kind", "quantity"), [("means", "vapour"), ("hourly means", "temperature")])
def test_readings_of_interval_means_are_simulated_as_means(kind, quantity):
    coarse, fine = differences(record_of(8602, kind, 20.0), EFFECTS["base"], quantity)
    assert coarse <= TOLERANCE[quantity]
    assert fine < 0.9 * coarse


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8611, 8621))
@pytest.mark.parametrize("quantity", ["temperature", "vapour"])
def test_cells_give_the_free_run_of_ten_plants(seed, quantity):
    kind = list(OPTIONS)[seed % 3]
    coarse, fine = differences(record_of(seed, kind, 60.0), EFFECTS["base"], quantity)
    assert coarse <= TOLERANCE[quantity]
    assert fine < coarse


JOINT_EFFECTS = {
    "base": Effect(),
    "vent": EFFECTS["vent"],
    "vent by humidity": replace(
        EFFECTS["vent"],
        features={"venting": {"reads": "cabinet_relative_humidity", "start": 0.4, "full": 0.6}},
    ),
    "drier": Effect(
        vapour=(("switched_drying", {"flag": "throttled_drying"}),), values={"drying_rate": 3.0},
        features={"throttled_drying": {"reads": "cabinet_relative_humidity", "start": 0.3, "full": 0.5}},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", JOINT_EFFECTS)
def test_heat_and_vapour_together_give_the_joint_free_run(name):
    """Vapour on the simulated temperature, and controllers that follow what the run itself shows."""
    record, effect = record_of(8601), JOINT_EFFECTS[name]
    made = designs(record, effect)
    values = started(made["both"], effect)
    line = model_inputs(made["both"], record)
    expected = free_run(made["both"], values, line)
    scene = scene_of(record, made["temperature"], made["vapour"])
    sim = simulator(scene, made)
    theta = parameters(sim, values, levels(effect))
    for quantity, pair in (("temperature", expected.temperature), ("vapour", expected.relative_humidity)):
        r = scene.readings[quantity]
        shown = r.sampled(sim.shown(theta, quantity, driven=False))[:, 0]
        at = np.searchsorted(line.timeline.seconds, r.time_s - 0.5)
        there = np.isfinite(r.value) & (r.time_h > SETTLED_H)
        assert pair is not None
        # the free run decides every five minutes; a vent that dries the air it follows feels the difference
        allowed = 3.0 if name == "vent by humidity" else 1.0
        assert rms((shown - pair[0][at] * r.saturated)[there]) <= allowed * TOLERANCE[quantity]


def levels(effect: Effect) -> dict[str, float]:
    """The levels of controllers, as parameters."""
    return {
        f"{name}_{word}": level
        for name, settings in (effect.features or {}).items()
        if name in CONTROLLED
        for word, level in zip(CONTROL, Throttle(**settings).levels, strict=False)
    }


COUNTED = {
    "cooling": Effect(
        (("throttled_cooling_loss", {}),), values={"throttled_conductance": 1.5},
        features={"venting": {"reads": "cabinet_temperature", "start": 293.0, "full": 296.0}},
    ),
    "heating": EFFECTS["throttled heater"],
    "heating at standstill": replace(
        EFFECTS["throttled heater"],
        features={"throttled_heating": {
            "reads": "cabinet_temperature", "start": 293.0, "full": 290.0, "idle": True
        }},
    ),
}  # fmt: skip


def counter(flag: str) -> Mechanism:
    """Hours for which a controller runs, shown as a reading."""
    return Mechanism(
        name="counter", states=("ran",), inputs=(flag,),
        drift=lambda p, x, u, q, s: {"ran": getattr(u, flag)},
        initial=lambda p, u: {"ran": (0.0, 1.0)}, outputs={"hours": lambda p, x, u, q, s: (x.ran, 1.0)},
        settings={"flag": flag},
    )  # fmt: skip


@pytest.mark.parametrize("effect", COUNTED.values(), ids=COUNTED)
def test_controllers_run_as_many_hours_a_day_as_in_the_free_run(effect, monkeypatch):
    record = record_of(8601)
    made = designs(record, effect)
    one = made["temperature"]
    values = started(one, effect)
    line = self_switched(one, values, [model_inputs(one, record)])[0]
    (flag,) = set(effect.features or {})
    seconds = line.timeline.seconds
    total = np.append(0.0, np.cumsum(line.timeline.input(flag)[1:] * np.diff(seconds) / 3600.0))

    wide = replace(one, library=LIBRARY.with_mechanisms(counter))
    monkeypatch.setattr(simulator_module, "OUTPUT", {"temperature": ("hours",)})
    counted = {**made, "temperature": extended(wide, [("counter", {"flag": flag})])}
    scene = scene_of(record, made["temperature"], made["vapour"])
    sim = simulator(scene, counted)
    shown = sim.shown(parameters(sim, values, levels(effect)), "temperature")[:, 0]
    time = scene.first_s + np.arange(1, len(shown) + 1) * scene.cell_h * 3600.0
    days = np.arange(time[0] + 86400.0, time[-1], 86400.0)
    found, expected = (np.diff(np.interp(days, *pair)) for pair in ((time, shown), (seconds, total)))
    assert expected.mean() > 0.5
    assert found.mean() == pytest.approx(expected.mean(), rel=0.02)
    assert np.abs(found - expected).mean() < 0.02 * 24.0


# -- the truth of plants of another make ---------------------------------------------------------------------
@cache
def exact_plant(seed: int) -> Plant:
    return plant(seed, days=30.0, sensor_errors="none", missing=0.0, preheating=True)


def true_values(made: Plant, reference_K: float) -> dict[str, float]:
    """A plant's truth in the package's parameters; its heat release counts the ambient from 283.15 K."""
    t, warmer = made.truth, reference_K - 283.15
    names = ("operation", "power_1", "power_2", "operation_ambient")
    found = {f"heat_release_{name}": value for name, value in zip(names, t.operation_K, strict=True)}
    found["heat_release_operation"] += t.operation_K[3] * warmer
    found |= {
        "heat_release_standstill": t.standstill_K[0] + t.standstill_K[1] * warmer,
        "heat_release_standstill_ambient": t.standstill_K[1],
        "preheating_heat": t.preheating_K, "thermal_time_constant": t.tau_h, "resistance_ratio": t.rho,
        "hygric_k": t.hygric_constant_h, "cabinet_temperature_bias": 0.0,
        "cabinet_relative_humidity_bias": 0.0,
    }  # fmt: skip
    return found


@pytest.mark.parametrize("seed", [8631, pytest.param(8633, marks=pytest.mark.slow)])
def test_cells_give_the_true_course_of_an_undisturbed_plant(seed):
    """Minutes of another make, which know the air outside each minute as the scene does here; the vapour runs
    on the true temperature."""
    made, still, drivers = exact_plant(seed), undisturbed(exact_plant(seed)), exact_plant(seed).drivers
    record = to_record(made)
    two = designs(record, Effect())
    scene = scene_of(record, two["temperature"], two["vapour"])
    outside = scene._base()[0]
    outside["ambient_temperature"][:] = np.interp(scene.edges_s, drivers.time, drivers.ambient_K)
    vapour = np.interp(scene.edges_s, drivers.time, drivers.ambient_kg_m3)
    outside["ambient_absolute_humidity"][:] = 1e3 * vapour
    outside["exchange_factor"][:] = exchange_factor(outside["ambient_temperature"])
    scene = driven(scene, np.interp(scene.edges_s, drivers.time, still.cabinet_K))
    sim = simulator(scene, two)
    reference_K = dict(two["temperature"].mechanisms)["heat_release"]["reference_K"]
    theta = parameters(sim, true_values(made, reference_K))
    for quantity, true in (("temperature", still.cabinet_K), ("vapour", 1e3 * still.cabinet_kg_m3)):
        r = scene.readings[quantity]
        shown = sim.simulated(theta, quantity)[:, 0]
        error = (shown - np.interp(r.time_s, drivers.time, true))[r.time_h > SETTLED_H]
        assert rms(error) <= {"temperature": 0.02, "vapour": 0.01}[quantity]


# -- each equation exists once -------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "kind", "quantity", "constant"),
    [
        ("thermal_network", "thermal", "temperature", "thermal_time_constant"),
        ("hygric_exchange", CASCADE, "vapour", "hygric_k"),
    ],
)
def test_likelihood_free_run_and_cells_follow_a_mechanism_that_changes(name, kind, quantity, constant):
    """A mechanism whose rates are doubled is that of half the time constant, to all three alike."""
    record = record_of(8601)

    def all_three(share: float, library: Library = LIBRARY) -> tuple[float, np.ndarray, np.ndarray]:
        made = {key: replace(one, library=library) for key, one in designs(record, Effect()).items()}
        one = made[quantity]
        values = started(one, Effect())
        values[constant] *= share
        line = model_inputs(one, record)
        sim = simulator(scene_of(record, made["temperature"], made["vapour"]), made)
        shown = sim.simulated(parameters(sim, values), quantity)[:, 0]
        found = Likelihood(one.model, line.timeline).value(values)
        return found, simulated(one, values, line, quantity), shown

    plain, expected = all_three(1.0), all_three(0.5)
    ordinary = MECHANISMS[name]

    def faster(**settings: Any) -> Mechanism:
        made = ordinary(**settings)
        assert made.drift is not None
        slow = made.drift
        return replace(made, drift=lambda *spaces: {k: 2.0 * v for k, v in slow(*spaces).items()})

    found = all_three(1.0, replace(LIBRARY, mechanisms={**MECHANISMS, name: faster}))
    for before, after, wanted in zip(plain, found, expected, strict=True):
        assert_allclose(after, wanted, rtol=1e-9)
        assert np.abs(np.asarray(after) - before).max() > 1e-3


# -- lanes ---------------------------------------------------------------------------------------------------
def test_runs_side_by_side_are_independent():
    """Eleven runs fill one block and a part of the next; one that diverges leaves the others alone."""
    record = record_of(8601)
    effect = EFFECTS["wall"]
    made = designs(record, effect)
    sim = simulator(scene_of(record, made["temperature"], made["vapour"]), made)
    one = parameters(sim, started(made["temperature"], effect), started(made["vapour"], effect))
    theta = np.repeat(one, 11, axis=1)
    theta[sim.names.index("thermal_time_constant")] *= np.linspace(0.5, 2.0, 11)
    theta[sim.names.index("wall_conductance"), 4] = np.nan
    before = sim.work.simulations
    found = sim.simulated(theta, "temperature")
    assert sim.work.simulations == before + 11
    assert np.isnan(found[:, 4]).all()
    for i in (0, 3, 5, 10):
        alone = sim.simulated(theta[:, i : i + 1], "temperature")[:, 0]
        assert np.array_equal(found[:, i], alone)
    assert rms(found[:, 0] - found[:, 10]) > 0.1


def test_own_inputs_act_on_their_run_alone():
    record = record_of(8601)
    effect = Effect((("stepped_loss", {}),), features={"after_step": {"date_s": 0.0}},
                    values={"conductance_change": 0.4})  # fmt: skip
    made = designs(record, effect)
    scene = scene_of(record, made["temperature"], made["vapour"])
    sim = Simulator(scene, made["temperature"], made["vapour"], own=("after_step",))
    assert set(effect.values or {}) == names_of(effect)
    theta = np.repeat(parameters(sim, started(made["temperature"], effect)), 10, axis=1)
    dates = record.start_s + 86400.0 * np.linspace(4.0, 18.0, 10)
    columns = [sim.column("after_step", {"date_s": date}) for date in dates]
    found = sim.simulated(theta, "temperature", {"after_step": columns})
    unchanged = sim.simulated(theta[:, :1], "temperature", {"after_step": [np.zeros(scene.count)]})[:, 0]
    time = scene.readings["temperature"].time_s
    for i, date in enumerate(dates):
        early = time < date - 1.0
        assert np.array_equal(found[early, i], unchanged[early])
        assert np.abs(found[~early, i] - unchanged[~early]).max() > 0.1
        shared = replace(made["temperature"], features={"after_step": {"date_s": float(date)}})
        same = Simulator(scene, shared, made["vapour"]).simulated(theta[:, :1], "temperature")[:, 0]
        assert rms(found[:, i] - same) < 0.01
