"""The second simulator of cabinets, against closed forms, balances and finer steps."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from other_make import ROWS, Cabinet, Scenario, as_record, integrate, make_plant
from other_make.loggers import Clock, Sensor, write_down
from other_make.moist_air import concentration, relative_humidity, saturation_pressure
from other_make.random_processes import first_order_lag, flaring, interval_means, ornstein_uhlenbeck
from scipy.linalg import expm

CABINET = Cabinet(
    heat_capacity=1.5e5,
    outer_resistance=0.02,
    inner_resistance=0.004,
    volume=2.0,
    gap=60.0,
    standstill_W=(250.0, 0.0),
)
SECOND = replace(CABINET, second_capacity=0.8e5, second_resistance=0.15)
AMBIENT_K, OUTSIDE = 281.0, 6e-3
STEP_S = 20.0


def constant(cabinet: Cabinet, hours: float, heat_W: float, start: tuple[float, float, float]):
    """Trajectory under a constant ambient and heat, and its time [h]."""
    size = round(3600.0 * hours / STEP_S) + 1
    run = integrate(
        cabinet, STEP_S, np.full(size, AMBIENT_K), np.full(size, OUTSIDE), np.full(size, heat_W), start
    )
    return STEP_S / 3600.0 * np.arange(size), run


# -- the cabinet ---------------------------------------------------------------------------------------------
def test_one_mass_answers_a_step_of_heat_by_an_exponential() -> None:
    hours, run = constant(CABINET, 6.0, 400.0, (AMBIENT_K, AMBIENT_K, OUTSIDE))
    tau = 1.5e5 * 0.024 / 3600.0
    rise = -np.expm1(-hours / tau)
    assert CABINET.resistance_capacity_h() == CABINET.small_signal_h() == pytest.approx(tau, rel=1e-12)
    assert CABINET.poles_h() == (CABINET.small_signal_h(),)
    np.testing.assert_allclose(run.converter_K, AMBIENT_K + 400.0 * 0.024 * rise, atol=1e-7)
    np.testing.assert_allclose(run.cabinet_K, AMBIENT_K + 400.0 * 0.020 * rise, atol=1e-7)


def test_the_vapour_answers_a_step_by_an_exponential_of_equation_4() -> None:
    hours, run = constant(CABINET, 6.0, 400.0, (AMBIENT_K + 9.6, AMBIENT_K, 1.5 * OUTSIDE))
    cabinet_K = AMBIENT_K + 8.0
    tau = CABINET.hygric_k_h * 273.0**1.8 / (cabinet_K * AMBIENT_K**0.8)
    assert CABINET.hygric_h(cabinet_K, AMBIENT_K) == pytest.approx(tau, rel=1e-12)
    np.testing.assert_allclose(run.equivalent_kg_m3, OUTSIDE * (1.0 + 0.5 * np.exp(-hours / tau)), rtol=1e-7)
    # in balance both sides hold the same vapour pressure
    shown = run.cabinet_kg_m3(np.full(len(hours), AMBIENT_K))[-1] * cabinet_K
    assert shown == pytest.approx(OUTSIDE * AMBIENT_K, rel=1e-4)


def test_two_masses_answer_as_the_matrix_exponential_of_their_network() -> None:
    inner, outer, beside = 1 / 0.004, 1 / 0.02, 1 / 0.15
    # nodes: converter, second mass, cabinet air, ambient; the air stores nothing and is eliminated
    links = [(0, 2, inner), (2, 3, outer), (1, 2, beside)]
    laplacian = np.zeros((4, 4))
    for a, b, g in links:
        laplacian[[a, b], [a, b]] += g
        laplacian[[a, b], [b, a]] -= g
    kept = [0, 1, 3]
    reduced = (
        laplacian[np.ix_(kept, kept)] - np.outer(laplacian[kept, 2], laplacian[2, kept]) / laplacian[2, 2]
    )
    capacity = np.array([1.5e5, 0.8e5])
    rates = -3600.0 * reduced[:2, :2] / capacity[:, None]
    driven = np.array([400.0 - reduced[0, 2] * AMBIENT_K, -reduced[1, 2] * AMBIENT_K])
    rest = np.linalg.solve(reduced[:2, :2], driven)
    start = np.array([AMBIENT_K + 1.0, AMBIENT_K + 5.0])
    hours, run = constant(SECOND, 20.0, 400.0, (*start, OUTSIDE))
    for k in (100, 700, 3600):
        expected = rest + expm(rates * hours[k]) @ (start - rest)
        np.testing.assert_allclose([run.converter_K[k], run.second_K[k]], expected, atol=1e-6)
    expected = sorted(-1.0 / np.linalg.eigvals(rates).real, reverse=True)
    np.testing.assert_allclose(SECOND.poles_h(), expected, rtol=1e-9)
    # a second mass changes no steady state: the air is Q R_AT above the ambient
    assert rest[0] - AMBIENT_K == pytest.approx(400.0 * 0.024, rel=1e-9)


@pytest.mark.parametrize("heat_W", [120.0, 900.0])
def test_convection_has_its_steady_state_and_its_small_signal_constant(heat_W: float) -> None:
    exponent = 0.27
    cabinet = replace(CABINET, exponent=exponent)
    # Q = G (ΔT/10 K)^n ΔT
    difference = 10.0 * (heat_W * 0.02 / 10.0) ** (1.0 / (1.0 + exponent))
    inner = 0.004 * (difference / 10.0) ** -exponent
    rest = AMBIENT_K + difference + heat_W * inner
    hours, run = constant(cabinet, 3.0, heat_W, (rest + 1e-3, AMBIENT_K, OUTSIDE))
    np.testing.assert_allclose(run.cabinet_K[-1] - AMBIENT_K, difference, atol=1e-3)
    small = -np.polyfit(hours, np.log(run.converter_K - rest), 1)[0]
    assert cabinet.small_signal_h(difference) == pytest.approx(1.0 / small, rel=1e-4)
    assert cabinet.poles_h(difference)[0] == cabinet.small_signal_h(difference)
    whole = (difference / heat_W + inner) * 1.5e5 / 3600.0
    assert cabinet.resistance_capacity_h(difference) == pytest.approx(whole, rel=1e-9)
    assert whole / cabinet.small_signal_h(difference) == pytest.approx(1.0 + exponent)


@pytest.fixture(scope="module")
def course() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ambient temperature, vapour and heat of three days with all frequencies that a grid of 20 s holds."""
    random = np.random.default_rng(5)
    size = 3 * 4320 + 1
    kelvin = 283.0 + 4.0 * ornstein_uhlenbeck(random, size, STEP_S / 3600.0, 3.0)
    vapour = 6e-3 + 5e-4 * ornstein_uhlenbeck(random, size, STEP_S / 3600.0, 1.0)
    return kelvin, vapour, 300.0 + 200.0 * random.random(size)


@pytest.mark.parametrize("cabinet", [CABINET, SECOND, replace(CABINET, exponent=0.3)])
def test_heat_and_vapour_are_conserved(cabinet: Cabinet, course: tuple) -> None:
    kelvin, vapour, heat = course
    run = integrate(cabinet, STEP_S, kelvin, vapour, heat)
    difference = run.cabinet_K - kelvin
    left = difference / (0.02 * (np.abs(difference) / 10.0) ** -cabinet.exponent)
    stored = cabinet.heat_capacity * (run.converter_K[-1] - run.converter_K[0])
    stored += cabinet.second_capacity * (run.second_K[-1] - run.second_K[0])
    gone = np.trapezoid(left, dx=STEP_S)
    released = STEP_S * heat[:-1].sum()
    # the trapezoidal rule is exact for what is linear in the temperatures; a curved flow costs it 1.5e-5
    assert stored == pytest.approx(released - gone, abs=(3e-5 if cabinet.exponent else 2e-6) * released)
    flow = (vapour - run.equivalent_kg_m3) * 60.0 * 2.2e-5 * (kelvin / 273.0) ** 1.8
    gained = np.trapezoid(flow * run.cabinet_K / (2.0 * kelvin), dx=STEP_S)
    assert run.equivalent_kg_m3[-1] - run.equivalent_kg_m3[0] == pytest.approx(gained, abs=1e-7)


def test_the_steps_are_of_third_order_and_fine_enough(course: tuple) -> None:
    kelvin, vapour, heat = course
    cabinet = replace(CABINET, exponent=0.25, gap=200.0)
    size = len(kelvin)

    def at(parts: int) -> np.ndarray:
        fine = np.arange(parts * (size - 1) + 1) / parts
        run = integrate(
            cabinet,
            STEP_S / parts,
            np.interp(fine, np.arange(size), kelvin),
            np.interp(fine, np.arange(size), vapour),
            np.append(np.repeat(heat[:-1], parts), heat[-1]),
        )
        return np.stack([run.cabinet_K, 1e4 * run.equivalent_kg_m3])[:, ::parts]

    best = at(16)
    errors = [np.abs(at(parts) - best).max(axis=1) for parts in (1, 2, 4)]
    assert (errors[0] < [1e-6, 1e-4]).all()  # [K], [1e-4 kg/m³]
    assert (errors[0] / errors[1] > 6.0).all() and (errors[1] / errors[2] > 6.0).all()


# -- processes and loggers -----------------------------------------------------------------------------------
def test_a_first_order_lag_is_exact_for_steps_and_ramps() -> None:
    time = STEP_S * np.arange(200)
    ramp = 3.0 + 0.01 * time
    expected = ramp - 0.01 * 240.0 * -np.expm1(-time / 240.0)
    np.testing.assert_allclose(first_order_lag(ramp, STEP_S, 240.0), expected, rtol=1e-12)
    np.testing.assert_array_equal(first_order_lag(ramp, STEP_S, 0.0), ramp)
    # the closed form of a bend: a sum of ramps
    bend = ramp + 0.05 * np.maximum(time - 1000.0, 0.0)
    after = np.maximum(time - 1000.0, 0.0)
    expected += 0.05 * (after + 240.0 * np.expm1(-after / 240.0))
    np.testing.assert_allclose(first_order_lag(bend, STEP_S, 240.0), expected, rtol=1e-12)


def test_interval_means_are_the_integral_of_the_broken_line() -> None:
    time = STEP_S * np.arange(400)
    line = 2.0 + 0.5 * time
    np.testing.assert_allclose(
        interval_means(time, line, np.array([905.0, 6000.0]), 600.0), [2 + 0.5 * 605, 2 + 0.5 * 5700]
    )
    square = time**2
    # ∫t² lies below the broken line by h²/6 in the mean
    expected = (6000.0**3 - 5400.0**3) / 3.0 / 600.0 + STEP_S**2 / 6.0
    assert interval_means(time, square, np.array([6000.0]), 600.0)[0] == pytest.approx(expected, rel=1e-12)


def test_random_courses_have_their_variance_and_correlation() -> None:
    random = np.random.default_rng(2)
    x = ornstein_uhlenbeck(random, 400_000, 0.1, 2.0)
    assert x.var() == pytest.approx(1.0, abs=0.03)
    assert np.mean(x[20:] * x[:-20]) == pytest.approx(np.exp(-1.0), abs=0.03)
    intensity = flaring(random, 400_000, 0.1, 0.8, 5.0)
    assert np.mean(intensity**2) == pytest.approx(1.0, abs=0.1)
    assert np.log(intensity).std() == pytest.approx(0.8, abs=0.05)
    modulated = ornstein_uhlenbeck(random, 400_000, 0.1, 2.0, intensity)
    assert modulated.var() == pytest.approx(1.0, abs=0.15)
    calm, wild = intensity < 0.3, intensity > 1.5
    assert modulated[wild].std() > 3.0 * modulated[calm].std()


TIME = 1e9 // 3600 * 3600 + STEP_S * np.arange(3 * 4320 + 1)


def written(clock: Clock, sensor: Sensor | None = None, course: np.ndarray | None = None, **options):
    random = np.random.default_rng(3)
    line = 1e-3 * (TIME - TIME[0]) if course is None else course
    return write_down(random, "any", "cabinet", TIME, line, clock, sensor or Sensor(), **options)


@pytest.mark.parametrize("late_s", [-60.0, 0.0, 60.0])
def test_a_reading_is_of_its_stamp_less_what_the_clock_is_late(late_s: float) -> None:
    instants = written(Clock(900.0, 120.0, late_s))
    assert (instants.time % 900.0 == 120.0).all() and instants.interval_s == 0.0
    np.testing.assert_allclose(instants.value, 1e-3 * (instants.time - late_s - TIME[0]), atol=1e-9)
    means = written(Clock(600.0, 0.0, late_s, mean=True))
    assert means.interval_s == 600.0
    np.testing.assert_allclose(means.value, 1e-3 * (means.time - 300.0 - late_s - TIME[0]), atol=1e-7)
    assert len(means.time) >= 3 * 144 - 1


def test_sensors_err_as_they_say() -> None:
    flat = np.full(len(TIME), 300.07)
    assert set(written(Clock(60.0), Sensor(resolution=0.5, zero=273.15), flat).value) == {300.15}
    noisy = written(Clock(STEP_S), Sensor(noise=0.2, bias=-1.0), flat).value
    assert noisy.mean() == pytest.approx(299.07, abs=0.01) and noisy.std() == pytest.approx(0.2, rel=0.03)
    heavy = written(Clock(STEP_S), Sensor(noise=0.2, degrees=3.0), flat).value - 300.07
    assert heavy.std() == pytest.approx(0.2, rel=0.2)
    assert 2.0 * np.mean(np.abs(heavy) > 0.8) > 10.0 * np.mean(np.abs(noisy - 299.07) > 0.8)
    struck = written(Clock(STEP_S), Sensor(noise=0.2, outliers=0.05), flat).value - 300.07
    assert np.mean(np.abs(struck) > 1.0) == pytest.approx(0.05, abs=0.01) and np.abs(struck).max() < 3.3
    holes = written(Clock(STEP_S), Sensor(missing=0.1), flat).value
    assert np.isnan(holes).mean() == pytest.approx(0.1, abs=0.01)


def test_saturation_pressure_is_that_of_the_tables() -> None:
    # IAPWS-95: triple point, 20, 25 and 50 °C
    kelvin = np.array([273.16, 293.15, 298.15, 323.15])
    np.testing.assert_allclose(saturation_pressure(kelvin), [611.66, 2339.3, 3169.9, 12352.0], rtol=3e-4)
    half = concentration(0.5 * saturation_pressure(kelvin), kelvin)
    np.testing.assert_allclose(relative_humidity(half, kelvin), 0.5)


# -- plants and rows -----------------------------------------------------------------------------------------
DAYS = 8.0


@pytest.fixture(scope="module")
def plants() -> dict:
    """Every row's plant of one seed."""
    return {row: make_plant(7, scenario, DAYS) for row, scenario in ROWS.items()}


def test_a_seed_gives_one_plant_and_rows_change_what_they_name(plants: dict) -> None:
    right = plants["instants"]
    again = make_plant(7, Scenario(), DAYS)
    for one, other in zip(right.channels, again.channels, strict=True):
        np.testing.assert_array_equal(one.value, other.value)
    for row, plant in plants.items():
        np.testing.assert_array_equal(plant.weather.ambient_K, right.weather.ambient_K)
        np.testing.assert_array_equal(plant.power_W, right.power_W)
        assert plant.truth.hygric_k_h == right.truth.hygric_k_h
        same_course = np.array_equal(plant.trajectory.cabinet_K, right.trajectory.cabinet_K)
        assert same_course == (row not in ("convection", "second_mass", "flare"))
    for row in ("means10", "means60"):
        for signal in ("cabinet_temperature", "cabinet_relative_humidity"):
            np.testing.assert_array_equal(plants[row][signal].value, right[signal].value)
    hourly, fine = plants["means60"]["ambient_temperature"], plants["means10"]["ambient_temperature"]
    assert (hourly.interval_s, fine.interval_s) == (3600.0, 600.0)
    inside = np.searchsorted(fine.time, hourly.time[3]) - np.arange(6)
    assert hourly.value[3] == pytest.approx(np.nanmean(fine.value[inside]), abs=0.02)


def test_rows_hold_what_their_truth_says(plants: dict) -> None:
    for row in ("lag_stated", "lag_unstated"):
        ((signal, lag),) = plants[row].truth.lags_s.items()
        stated = plants[row][signal].response_time_s
        assert stated == (None if row.endswith("unstated") else lag)
        assert 120.0 <= lag <= 900.0
        assert not np.array_equal(plants[row][signal].value, plants["instants"][signal].value)
    late = {seed: make_plant(seed, ROWS["clock"], 1.0).truth.late_s for seed in range(30)}
    assert {tuple(sorted(np.abs(list(one.values())))) for one in late.values()} == {(0.0, 0.0, 60.0)}
    assert {(system, s) for one in late.values() for system, s in one.items() if s} == {
        (system, s) for system in ("cabinet", "ambient", "scada") for s in (-60.0, 60.0)
    }
    truth = plants["convection"].truth
    assert 0.2 <= truth.cabinet.exponent <= 0.33
    assert truth.thermal_h > 1.1 * truth.small_signal_h == 1.1 * truth.dominant_h
    truth = plants["second_mass"].truth
    assert 0.3 <= truth.cabinet.second_capacity / truth.cabinet.heat_capacity <= 1.0
    assert truth.dominant_h > truth.thermal_h == plants["instants"].truth.thermal_h
    steps = np.diff(np.unique(plants["quantised"]["cabinet_relative_humidity"].value))
    assert np.nanmin(steps) == pytest.approx(0.01)


def test_disturbances_and_cabinets_are_of_the_stated_size() -> None:
    made = [make_plant(seed, None, 60.0) for seed in range(8)]
    assert np.mean([p.truth.free_run_K for p in made]) == pytest.approx(1.25, abs=0.2)
    assert np.mean([1e3 * p.truth.free_run_kg_m3 for p in made]) == pytest.approx(0.33, abs=0.06)
    for plant in made:
        assert 0.8 <= plant.truth.thermal_h <= 4.0
        hygric = plant.truth.hygric_h(plant.trajectory.cabinet_K.mean(), plant.weather.ambient_K.mean())
        assert 0.14 <= hygric <= 0.62
        assert 0.3 < np.mean(plant.power_W > 0.0) < 1.0


def test_only_the_adapter_knows_the_package() -> None:
    for file in (Path(__file__).parent / "other_make").glob("*.py"):
        names = [
            name
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
            for name in (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else []
            )
        ]
        foreign = {name.split(".")[0] for name in names} & {"hygrokf", "plants"}
        assert foreign == ({"hygrokf"} if file.stem == "as_record" else set())


def test_a_plant_becomes_a_record(plants: dict) -> None:
    record = as_record.to_record(plants["means60"])
    outside, inside = record["ambient_relative_humidity"], record["cabinet_temperature"]
    assert (outside.hold, outside.interval_s, inside.hold, inside.interval_s) == (
        "mean",
        3600.0,
        "linear",
        0.0,
    )
    assert record["active_power"].interval_s == 600.0 and inside.resolution == 0.1
    assert record.rated_power_W == plants["means60"].rated_W
    np.testing.assert_array_equal(inside.value, plants["means60"]["cabinet_temperature"].value)


def test_a_stated_response_time_is_passed_on(plants: dict) -> None:
    signal = "cabinet_relative_humidity"
    stated = as_record.to_series(plants["lag_stated"][signal])
    assert stated.response_time_s == plants["lag_stated"].truth.lags_s[signal]
    assert as_record.to_series(plants["lag_unstated"][signal]).response_time_s is None
