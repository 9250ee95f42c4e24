"""The plants that judge the package: right physics, stated sizes, nothing of the package inside."""

from __future__ import annotations

import ast
import math
from dataclasses import replace
from itertools import accumulate
from pathlib import Path

import numpy as np
import plants
import pytest
from plants import Forcing, Plant, integrate, plant, undisturbed
from plants.chance import ornstein_uhlenbeck, power_law, shots
from plants.plant import random_cabinet
from plants.saturation import relative_humidity, saturation_pressure

FOLDER = Path(plants.__file__).parent
ONLY_BRIDGE = "as_record.py"
uk_only = pytest.mark.skipif(
    not plants.UK_DRIVERS.exists(), reason="measured UK drivers are not beside the repository"
)


@pytest.fixture(scope="module")
def made() -> Plant:
    return plant(3)


@pytest.fixture(scope="module")
def walled() -> Plant:
    return plant(3, wall=True, vapour_balance="mass", days=60.0)


def root_mean_square(values: np.ndarray) -> float:
    return math.sqrt(float(np.mean(values**2)))


def free_run(one: Plant) -> tuple[float, float]:
    """Root mean square error of the bare physics with true parameters [K], [g/m3]."""
    bare = undisturbed(one)
    kelvin = root_mean_square(one.trajectory.cabinet_K - bare.cabinet_K)
    grams = 1e3 * root_mean_square(one.trajectory.cabinet_kg_m3 - bare.cabinet_kg_m3)
    return kelvin, grams


def trapezoid(values: np.ndarray) -> np.ndarray:
    """Running integral over minutes [unit s]."""
    return np.concatenate(([0.0], np.cumsum(30.0 * (values[:-1] + values[1:]))))


def held(values: np.ndarray) -> np.ndarray:
    """Running integral of values that hold over each minute [unit s]."""
    return np.concatenate(([0.0], np.cumsum(60.0 * values)))


# --- no code of the package -----------------------------------------------------------------


def imported_modules(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: relative import"
            names.add(str(node.module))
    return names


def test_only_the_bridge_imports_the_package() -> None:
    files = sorted(FOLDER.glob("*.py"))
    assert len(files) >= 8
    guilty = {
        path.name for path in files if any(name.split(".")[0] == "hygrokf" for name in imported_modules(path))
    }
    assert guilty == {ONLY_BRIDGE}
    # Nor does any other file reach the package through the bridge.
    for path in files:
        assert "plants.as_record" not in imported_modules(path), path.name


# --- physics --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kelvin", "published"),
    # Murphy and Koop (2005), table C1 [Pa], and IAPWS-95 above 0 degC.
    [(240.0, 37.667), (273.15, 611.213), (293.15, 2339.3), (313.15, 7384.9)],
)
def test_saturation_has_published_values(kelvin: float, published: float) -> None:
    assert saturation_pressure(np.array(kelvin)) == pytest.approx(published, rel=2e-4)


def test_trajectory_is_the_papers_model_in_lumped_form(made: Plant) -> None:
    """Equations (2) to (5) with tau, rho, k alone, discretised exactly, without any watt."""
    truth, drivers, bare = made.truth, made.drivers, undisturbed(made)
    step_h = 1.0 / 60.0
    share = drivers.power_W[:-1] / made.cabinet.rated_W
    ambient = drivers.ambient_K
    warmer = 0.5 * (ambient[:-1] + ambient[1:]) - 283.15
    b0, b1, b2, b3 = truth.operation_K
    s0, s1 = truth.standstill_K
    operation = b0 + b1 * share + b2 * share**2 + b3 * warmer
    release = np.where(drivers.power_W[:-1] > 0.0, operation, s0 + s1 * warmer)

    def lag(rate: np.ndarray, drive: np.ndarray, push: np.ndarray, start: float) -> np.ndarray:
        """dx/dt = rate (drive - x) + push with a straight drive."""
        turns = rate * step_h
        gain = np.exp(-turns)
        ramp = 1.0 - (1.0 - gain) / turns
        forced = (1.0 - gain) * (drive[:-1] + push / rate) + ramp * np.diff(drive)
        pairs = zip(gain.tolist(), forced.tolist(), strict=True)
        return np.array(list(accumulate(pairs, lambda x, p: p[0] * x + p[1], initial=start)))

    slow = np.full(release.size, 1.0 / truth.tau_h)
    push = release / (truth.tau_h * truth.rho)
    converter = lag(slow, ambient, push, float(bare.converter_K[0]))
    cabinet = truth.rho * converter + (1.0 - truth.rho) * ambient
    np.testing.assert_allclose(cabinet, bare.cabinet_K, atol=1e-6)

    rate = cabinet * ambient**0.8 / (truth.hygric_constant_h * 273.0**1.8)
    rate = 0.5 * (rate[:-1] + rate[1:])
    nothing = np.zeros(rate.size)
    equivalent = lag(rate, drivers.ambient_kg_m3, nothing, float(bare.equivalent_kg_m3[0]))
    np.testing.assert_allclose(equivalent * ambient / cabinet, bare.cabinet_kg_m3, rtol=1e-6)
    means = bare.cabinet_K.mean() * ambient.mean() ** 0.8
    hygric = truth.hygric_constant_h * 273.0**1.8 / means
    assert truth.hygric_h == pytest.approx(hygric, rel=1e-3)


def test_heat_balance_closes(made: Plant) -> None:
    cabinet, run = made.cabinet, made.trajectory
    lost = trapezoid((run.cabinet_K - made.drivers.ambient_K) / cabinet.outer_resistance)
    stored = cabinet.heat_capacity * (run.converter_K - run.converter_K[0])
    given = held(made.forcing.heat_W)
    np.testing.assert_allclose(lost + stored, given, atol=2e-6 * given[-1])
    assert np.ptp(stored) > 1e-4 * given[-1]


def test_heat_balance_with_a_wall_closes(walled: Plant) -> None:
    cabinet, run = walled.cabinet, walled.trajectory
    outer = cabinet.outer_resistance * (1.0 - cabinet.wall_place)
    lost = trapezoid((run.wall_K - walled.drivers.ambient_K) / outer)
    stored = cabinet.heat_capacity * (run.converter_K - run.converter_K[0])
    in_wall = cabinet.wall_capacity * (run.wall_K - run.wall_K[0])
    given = held(walled.forcing.heat_W)
    np.testing.assert_allclose(lost + stored + in_wall, given, atol=2e-6 * given[-1])
    assert np.ptp(in_wall) > 1e-3 * given[-1]


def test_vapour_mass_balance_closes(walled: Plant) -> None:
    run, drivers = walled.trajectory, walled.drivers
    resistance = walled.cabinet.diffusion_resistance(drivers.ambient_K)
    exchanged = trapezoid((drivers.ambient_kg_m3 - run.equivalent_kg_m3) / resistance)
    mass = walled.cabinet.volume * run.cabinet_kg_m3
    moved = exchanged + held(walled.forcing.vapour_kg_s)
    np.testing.assert_allclose(mass - mass[0], moved, atol=2e-3 * np.ptp(mass))


def test_equivalent_vapour_balance_closes(made: Plant) -> None:
    run, drivers, cabinet = made.trajectory, made.drivers, made.cabinet
    volume = cabinet.volume * drivers.ambient_K / run.cabinet_K
    resistance = cabinet.diffusion_resistance(drivers.ambient_K)
    exchanged = trapezoid((drivers.ambient_kg_m3 - run.equivalent_kg_m3) / (resistance * volume))
    middle = 0.5 * (volume[:-1] + volume[1:])
    moved = exchanged + held(made.forcing.vapour_kg_s / middle)
    change = run.equivalent_kg_m3 - run.equivalent_kg_m3[0]
    np.testing.assert_allclose(change, moved, atol=2e-3 * np.ptp(change))


def test_the_mass_balance_leaves_the_papers_only_while_temperatures_move() -> None:
    closed = plant(4, days=30.0, vapour_balance="mass")
    open_ = plant(4, days=30.0)
    apart = 1e3 * root_mean_square(closed.trajectory.cabinet_kg_m3 - open_.trajectory.cabinet_kg_m3)
    assert 1e-4 < apart < 0.1
    size = 40 * 60
    still = {
        "ambient_K": np.full(size, 283.15),
        "ambient_kg_m3": np.linspace(6e-3, 9e-3, size),
        "forcing": Forcing(np.full(size - 1, 300.0), np.full(size - 1, 1e-7)),
    }
    one = integrate(closed.cabinet, 60.0, **still)
    two = integrate(open_.cabinet, 60.0, **still)
    np.testing.assert_allclose(one.cabinet_kg_m3, two.cabinet_kg_m3, rtol=1e-9)


def test_halving_the_step_changes_nothing(made: Plant) -> None:
    drivers = made.drivers
    finer = integrate(made.cabinet, 60.0, drivers.ambient_K, drivers.ambient_kg_m3, made.forcing, substeps=2)
    np.testing.assert_allclose(finer.cabinet_K, made.trajectory.cabinet_K, atol=1e-7)
    np.testing.assert_allclose(finer.cabinet_kg_m3, made.trajectory.cabinet_kg_m3, atol=1e-9)


def test_the_integrator_is_of_fourth_order(made: Plant) -> None:
    coarse = slice(0, 1440 * 10 + 1, 20)
    ambient, outside = made.drivers.ambient_K[coarse], made.drivers.ambient_kg_m3[coarse]
    steps = ambient.size - 1
    forcing = Forcing(made.forcing.heat_W[coarse][:steps], made.forcing.vapour_kg_s[coarse][:steps])

    def final(substeps: int) -> np.ndarray:
        run = integrate(made.cabinet, 1200.0, ambient, outside, forcing, substeps)
        return run.cabinet_kg_m3

    reference = final(64)
    errors = [root_mean_square(final(substeps) - reference) for substeps in (2, 4, 8)]
    assert 12.0 < errors[0] / errors[1] < 26.0
    assert 12.0 < errors[1] / errors[2] < 26.0


def test_settled_cabinet_has_the_closed_form() -> None:
    cabinet = random_cabinet(np.random.default_rng(1))
    size = 3 * 1440
    run = integrate(
        cabinet,
        60.0,
        np.full(size, 280.0),
        np.full(size, 6e-3),
        Forcing(np.full(size - 1, 350.0), np.full(size - 1, 2e-7)),
    )
    rise = 350.0 * cabinet.outer_resistance
    assert run.cabinet_K[-1] == pytest.approx(280.0 + rise, abs=1e-9)
    through = cabinet.outer_resistance + cabinet.inner_resistance
    assert run.converter_K[-1] == pytest.approx(280.0 + 350.0 * through, abs=1e-9)
    lift = 2e-7 * float(cabinet.diffusion_resistance(np.array(280.0)))
    expected = (6e-3 + lift) * 280.0 / (280.0 + rise)
    assert run.cabinet_kg_m3[-1] == pytest.approx(expected, rel=1e-9)


def test_without_inner_resistance_air_and_equipment_are_one() -> None:
    one = plant(5, days=10.0, rho=1.0)
    assert one.truth.rho == 1.0
    assert one.cabinet.inner_resistance == 0.0
    np.testing.assert_allclose(one.trajectory.cabinet_K, one.trajectory.converter_K, rtol=1e-14)


# --- random parts ---------------------------------------------------------------------------


@pytest.mark.parametrize("process", [ornstein_uhlenbeck, shots])
def test_coloured_noise_has_unit_variance_and_its_correlation_time(process) -> None:
    values = process(np.random.default_rng(7), 2_000_000, 1.0 / 60.0, 0.5)
    assert np.var(values) == pytest.approx(1.0, abs=0.06)
    lagged = np.mean(values[30:] * values[:-30]) / np.var(values)
    assert lagged == pytest.approx(math.exp(-1.0), abs=0.03)
    kurtosis = np.mean(values**4) / np.var(values) ** 2
    assert (kurtosis > 4.0) == (process is shots)


def test_power_law_noise_has_unit_variance_and_its_slope() -> None:
    random = np.random.default_rng(8)
    draws = [power_law(random, 2**14, 1.0, 1.3, 200.0) for _ in range(40)]
    assert np.mean([np.mean(values**2) for values in draws]) == pytest.approx(1.0, abs=0.1)
    spectrum = np.mean([np.abs(np.fft.rfft(values)) ** 2 for values in draws], axis=0)
    frequency = np.fft.rfftfreq(2**14)
    inside = (frequency > 0.03) & (frequency < 0.3)
    slope = np.polyfit(np.log(frequency[inside]), np.log(spectrum[inside]), 1)[0]
    assert slope == pytest.approx(-1.3, abs=0.1)


def test_cabinets_lie_within_the_stated_ranges() -> None:
    cabinets = [random_cabinet(np.random.default_rng(seed)) for seed in range(300)]
    thermal = np.array([cabinet.thermal_h for cabinet in cabinets])
    hygric = np.array([cabinet.hygric_h(292.0, 283.0) for cabinet in cabinets])
    rho = np.array([cabinet.rho for cabinet in cabinets])
    for drawn, low, high in ((thermal, 0.8, 3.0), (hygric, 0.15, 0.8), (rho, 0.72, 0.93)):
        assert low <= drawn.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < drawn.max() <= high


@pytest.mark.parametrize("kind", [kind for kind in plants.DISTURBANCES if kind != "none"])
@pytest.mark.parametrize("seed", [1, 2])
def test_free_run_errs_as_much_as_stated(kind: str, seed: int) -> None:
    one = plant(seed, disturbance=kind)
    kelvin, grams = free_run(one)
    assert 1.0 < kelvin < 2.0
    assert 0.3 < grams < 0.5
    assert kelvin == pytest.approx(one.truth.heat.free_run_K, rel=0.2)
    assert grams == pytest.approx(1e3 * one.truth.vapour.free_run_kg_m3, rel=0.2)
    assert one.truth.class_right == (kind == "ou")


def test_a_plant_without_disturbance_is_its_own_free_run() -> None:
    assert free_run(plant(2, days=30.0, disturbance="none")) == (0.0, 0.0)


def test_disturbances_are_independent_of_every_driver() -> None:
    """Correlations over 24 plants average out; one plant's are as large as chance makes them."""
    rows = []
    for seed in range(24):
        one = plant(seed, days=90.0)
        drivers, steps = one.drivers, one.drivers.time.size - 1
        release = one.cabinet.heat_release(
            drivers.power_W[:-1], drivers.held_ambient_K, drivers.preheating[:-1]
        )
        heat, vapour = one.forcing.heat_W - release, one.forcing.vapour_kg_s
        each = [heat, vapour]
        for driver in (drivers.ambient_K, drivers.ambient_kg_m3, drivers.power_W, drivers.irradiance_W_m2):
            each.append(driver[:steps])
        table = np.corrcoef(np.array(each)[:, ::10])
        rows.append([*table[0, 1:], *table[1, 2:]])
    rows = np.array(rows)
    standard_error = rows.std(axis=0, ddof=1) / math.sqrt(len(rows))
    assert np.all(np.abs(rows).max(axis=0) > 0.0)
    assert np.all(np.abs(rows.mean(axis=0)) < 3.5 * standard_error)
    assert np.all(standard_error < 0.04)


def test_the_same_seed_gives_the_same_plant(made: Plant) -> None:
    again, other = plant(3), plant(4)
    for one, two in zip(made.series, again.series, strict=True):
        assert one.signal == two.signal
        np.testing.assert_array_equal(one.time, two.time)
        np.testing.assert_array_equal(one.value, two.value)
    assert made.truth == again.truth
    assert other.truth.tau_h != made.truth.tau_h


def test_options_of_the_loggers_leave_the_plant_alone(made: Plant) -> None:
    hourly = plant(3, logger_step_min=60.0, sensor_errors="all")
    np.testing.assert_array_equal(hourly.trajectory.cabinet_K, made.trajectory.cabinet_K)
    assert hourly.truth.tau_h == made.truth.tau_h
    assert np.all(np.diff(hourly["cabinet_temperature"].time) == 3600.0)


# --- drivers and loggers --------------------------------------------------------------------


def test_climate_is_that_of_a_cabinet_in_a_turbine(made: Plant) -> None:
    rise = made.trajectory.cabinet_K - made.drivers.ambient_K
    assert 5.0 < rise.mean() < 13.0
    outside = relative_humidity(made.drivers.ambient_kg_m3, made.drivers.ambient_K)
    assert 0.3 < outside.min() < outside.max() < 1.0
    assert np.mean(made["cabinet_relative_humidity"].value >= 100.0) < 1e-3
    share = made.drivers.power_W / made.cabinet.rated_W
    assert 0.2 < share.mean() < 0.45
    assert 0.1 < np.mean(share <= 0.0) < 0.35
    assert 0.02 < np.mean(share > 0.97) < 0.25
    ratio = made.trajectory.cabinet_kg_m3.mean() / made.drivers.ambient_kg_m3.mean()
    assert 0.95 < ratio < 0.99


def test_exact_inputs_can_be_rebuilt_from_the_readings(made: Plant) -> None:
    temperature = made["ambient_temperature"]
    drivers = made.drivers
    inside = (drivers.time >= temperature.time[0]) & (drivers.time <= temperature.time[-1])
    rebuilt = np.interp(drivers.time[inside], temperature.time, temperature.value + 273.15)
    np.testing.assert_allclose(rebuilt, drivers.ambient_K[inside], atol=1e-9)
    power = made["active_power"]
    steps = np.searchsorted(power.time, drivers.time, side="right")
    known = steps < power.time.size
    np.testing.assert_allclose(1e3 * power.value[steps[known]], drivers.power_W[known], rtol=1e-12)


def test_preheating_follows_faults_and_warms() -> None:
    one = plant(3, preheating=True)
    on = one.drivers.preheating > 0.0
    assert 0.0 < on.mean() < 0.01
    assert np.all(one.drivers.power_W[on] < 0.0)
    assert one["preheating"].value.max() == 1.0
    cold = replace(one, drivers=replace(one.drivers, preheating=np.zeros(on.size)))
    extra = undisturbed(one).cabinet_K - undisturbed(cold).cabinet_K
    assert 0.7 * one.truth.preheating_K < extra.max() <= one.truth.preheating_K
    with pytest.raises(KeyError, match="no preheating"):
        plant(3, days=20.0)["preheating"]


def test_readings_are_truth_plus_stated_errors(made: Plant) -> None:
    reading = made["cabinet_temperature"]
    true = np.interp(reading.time, made.drivers.time, made.trajectory.cabinet_K) - 273.15
    error = reading.value - true
    known = np.isfinite(error)
    assert 0.005 < 1.0 - known.mean() < 0.02
    assert error[known].mean() == pytest.approx(dict(made.truth.biases)[reading.signal], abs=3e-3)
    # White noise of 0.05 K and rounding to 0.1 K.
    assert error[known].std() == pytest.approx(math.hypot(0.05, 0.1 / math.sqrt(12.0)), rel=0.05)
    perfect = plant(3, sensor_errors="none", missing=0.0)["cabinet_temperature"]
    np.testing.assert_allclose(perfect.value, true, atol=1e-9)


def test_logger_means_are_means_and_stamped_at_the_end() -> None:
    one = plant(3, days=20.0, logger_mean=True, sensor_errors="none", missing=0.0)
    reading = one["cabinet_temperature"]
    assert (reading.stamp, reading.interval_s) == ("end", 900.0)
    fine = np.linspace(reading.time[50] - 900.0, reading.time[50], 1001)
    values = np.interp(fine, one.drivers.time, one.trajectory.cabinet_K) - 273.15
    mean = np.mean(0.5 * (values[:-1] + values[1:]))
    assert reading.value[50] == pytest.approx(mean, abs=1e-3)
    assert abs(reading.value[50] - values[-1]) > 2e-3


def test_power_gap_is_missing_not_zero() -> None:
    one = plant(3, power_gap_days=2.0)
    missing = np.isnan(one["active_power"].value)
    assert missing.sum() == 288
    assert np.ptp(np.flatnonzero(missing)) == 287


def test_absolute_humidity_may_be_what_is_logged() -> None:
    one = plant(3, days=20.0, sensor_errors="none", missing=0.0, ambient_humidity="absolute")
    reading = one["ambient_absolute_humidity"]
    true = np.interp(reading.time, one.drivers.time, one.drivers.ambient_kg_m3)
    np.testing.assert_allclose(reading.value, 1e3 * true, rtol=1e-12)


@pytest.mark.parametrize(
    "option", ["disturbance", "sensor_errors", "power", "ambient_humidity", "vapour_balance"]
)
def test_unknown_options_are_refused(option: str) -> None:
    with pytest.raises(ValueError, match="found 'pink'"):
        plant(1, days=5.0, **{option: "pink"})


# --- measured drivers and the bridge --------------------------------------------------------


@uk_only
def test_uk_plant_keeps_the_measured_hourly_power() -> None:
    one = plants.uk_plant(1, start="2018-07-01", days=30.0)
    power = one["active_power"].value.reshape(-1, 6).mean(axis=1)
    measured = plants.uk._hours()
    first = np.searchsorted(measured["time"], one.drivers.time[0])
    hours = measured["P_K2_kW"][first : first + power.size]
    np.testing.assert_allclose(power, hours, rtol=1e-9, atol=1e-9)
    outside = one["ambient_temperature"]
    assert np.all(np.diff(outside.time) == 3600.0)
    celsius = measured["T2m_C"][first : first + outside.value.size]
    np.testing.assert_allclose(outside.value, celsius, atol=1e-9)


@uk_only
@pytest.mark.parametrize("seed", [1])
def test_uk_free_run_errs_as_much_as_stated(seed: int) -> None:
    one = plants.uk_plant(seed)
    kelvin, grams = free_run(one)
    assert 1.0 < kelvin < 2.0
    assert 0.3 < grams < 0.5
    assert np.nanmax(one["active_power"].value) < 2.1e3


def test_record_of_a_plant_is_in_si_units(made: Plant) -> None:
    from plants.as_record import to_record

    until = float(made.drivers.time[-1]) - 30.0 * 86400.0
    record = to_record(made, until_s=until, clock_uncertainty_s=60.0)
    assert record.rated_power_W == made.cabinet.rated_W
    assert record.until_s == until
    inside = record["cabinet_temperature"]
    np.testing.assert_allclose(inside.value, made["cabinet_temperature"].value + 273.15)
    assert (inside.hold, inside.interval_s, inside.clock_uncertainty_s) == ("linear", 0.0, 60.0)
    assert (inside.resolution, inside.accuracy) == (0.1, 0.3)
    humidity = record["cabinet_relative_humidity"]
    assert 0.0 < np.nanmedian(humidity.value) < 1.0
    assert humidity.accuracy == pytest.approx(0.02)
    power = record["active_power"]
    assert (power.hold, power.interval_s) == ("mean", 600.0)
    # The first mean ends ten minutes after the record begins.
    assert power.time[0] == made.drivers.time[0] + 600.0
    assert power.value[7] == pytest.approx(made.drivers.power_W[70])
    assert record["ambient_temperature"].clock_uncertainty_s == 0.0
