"""Heat release from quasi-stationary periods: recovery of the truth, cross-validation by refitting, and
records of every legal shape."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.record_edits import changed, without
from plants import Plant, plant
from plants.as_record import to_record

from hygrokf.cases.synthetic import SyntheticParameters, synthetic_turbine
from hygrokf.data.record import Record, Series
from hygrokf.data.structured import plain
from hygrokf.identification import steady_state
from hygrokf.identification.periods import Choice, choose_length
from hygrokf.identification.steady_state import HeatRelease, Regression, _left_out, heat_release_regression
from hygrokf.modelling.design import design
from hygrokf.physics.mechanisms.thermal import heat_release
from hygrokf.texts.fit_codes import FitCode

SHARED = Path(__file__).resolve().parents[2] / "../shared/data"
RATED_W = 2.0e6
REFERENCE_K = 283.15
HOUR_S = 3600.0
START_S = 1.6e9
OPERATION = (7.0, 9.0, -4.0, -0.15)
STANDSTILL = (5.0, -0.1)


# --- records --------------------------------------------------------------------------------


def turbine_record(seed: int) -> tuple[Record, dict[str, float]]:
    """The synthetic turbine as a record, and the sensors' biases [K] by place."""
    made = synthetic_turbine(seed)
    end = made.scada.time + 600.0
    series = (
        Series("cabinet_temperature", made.cabinet.time, made.cabinet["T_cab_degC"] + 273.15),
        Series("ambient_temperature", made.ambient.time, made.ambient["T_amb_degC"] + 273.15),
        Series("active_power", end, 1e3 * made.scada["P_kW"], "mean", 600.0),
        Series("preheating", end, made.scada["preheating"], "mean", 600.0),
    )
    bias = dict(made.truth.sensor_bias)
    places = {place: bias[f"{place}.T_{place[:3]}_degC"] for place in ("cabinet", "ambient")}
    return Record(made.name, series, rated_power_W=2.05e6, until_s=made.until_s), places


def block_record(
    seed: int = 1,
    *,
    days: float = 90.0,
    scatter_K: float = 0.0,
    noise_K: float = 0.0,
    powers: tuple[float, ...] = (-0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0),
    step_s: tuple[float, float, float] = (900.0, 600.0, 600.0),
) -> Record:
    """A cabinet without inertia: blocks of eight hours of one power and weather, a ramp of an hour between
    them.

    `scatter_K` [K] differs by block and `noise_K` by reading; `step_s` of cabinet, ambient and power.
    """
    random = np.random.default_rng(seed)
    blocks = int(days * 3)
    power = random.choice(powers, blocks)
    ambient = REFERENCE_K + random.uniform(-8.0, 8.0, blocks)
    a, b = OPERATION, STANDSTILL
    warm = ambient - REFERENCE_K
    release = np.where(
        power > 0, a[0] + a[1] * power + a[2] * power**2 + a[3] * warm, b[0] + b[1] * warm
    ) + scatter_K * random.standard_normal(blocks)
    corners = 8.0 * HOUR_S * np.arange(blocks)[:, None] + np.array([0.0, 7.0 * HOUR_S])

    def course(time: np.ndarray, level: np.ndarray) -> np.ndarray:
        return np.interp(time, corners.ravel(), np.repeat(level, 2))

    span = 8.0 * HOUR_S * blocks
    times = [np.arange(first, span, step) for first, step in zip((0.0, 0.0, step_s[2]), step_s, strict=True)]
    held = power[((times[2] - 1.0) // (8.0 * HOUR_S)).astype(int)]
    cabinet = course(times[0], ambient + release) + noise_K * random.standard_normal(len(times[0]))
    return Record(
        "blocks",
        (
            Series("cabinet_temperature", START_S + times[0], cabinet),
            Series("ambient_temperature", START_S + times[1], course(times[1], ambient)),
            Series("active_power", START_S + times[2], RATED_W * held, "mean", step_s[2]),
        ),
        rated_power_W=RATED_W,
    )


@pytest.fixture(scope="module")
def scattered() -> HeatRelease:
    return heat_release_regression(block_record(2, scatter_K=1.0), reference_K=REFERENCE_K)


@pytest.fixture(scope="module")
def made() -> Plant:
    return plant(5, days=180.0)


# --- truth ----------------------------------------------------------------------------------


def with_time_constant(
    monkeypatch: pytest.MonkeyPatch, record: Record, tau_h: float
) -> tuple[HeatRelease, list[float]]:
    """The heat release with this estimate of the time constant, and the lengths [h] of its periods."""
    lengths = []

    def chosen(*given: object) -> Choice:
        choice = choose_length(*given)
        lengths.append(choice.window_h)
        return choice

    monkeypatch.setattr(steady_state, "rough_time_constant", lambda cells: tau_h)
    monkeypatch.setattr(steady_state, "choose_length", chosen)
    return heat_release_regression(record, reference_K=REFERENCE_K), lengths


def test_exact_on_a_cabinet_without_inertia(monkeypatch: pytest.MonkeyPatch) -> None:
    # Its time constant is nought; one given near nought asks for the shortest periods.
    found, _ = with_time_constant(monkeypatch, block_record(1), 1e-6)
    assert (found.operation.order, found.operation.ambient) == (2, True)
    assert found.standstill.ambient
    expected = dict(
        zip(
            (
                "heat_release_operation", "heat_release_power_1", "heat_release_power_2",
                "heat_release_operation_ambient", "heat_release_standstill",
                "heat_release_standstill_ambient",
            ),
            (*OPERATION, *STANDSTILL),
            strict=True,
        )
    )  # fmt: skip
    start = found.start()
    assert list(start) == list(expected)
    for name, value in expected.items():
        # Periods reach some minutes into a ramp, within the tolerance; the difference follows the ramp
        # linearly.
        assert start[name] == pytest.approx(value, abs=0.05), name


def release(fit: Regression, power: float) -> float:
    """The release [K] at a power and the periods' mean ambient temperature."""
    row = np.array([power**k for k in range(fit.order + 1)] + [mean_warmth(fit)] * fit.ambient)
    return float(row @ list(fit.coefficients.values()))


def mean_warmth(fit: Regression) -> float:
    return float(fit.points.ambient_K.mean()) - REFERENCE_K


def errors(
    found: HeatRelease, operation: tuple[float, ...], standstill: tuple[float, ...], bias_K: float
) -> list[float]:
    """Errors [K] at low and high power, where most periods are, and at standstill; a sensor's bias is no
    error."""
    rows = []
    a, b = operation, standstill
    for p in (0.03, 0.97):
        right = a[0] + a[1] * p + a[2] * p**2 + a[3] * mean_warmth(found.operation) + bias_K
        rows.append(release(found.operation, p) - right)
    if found.standstill is not None:
        right = b[0] + b[1] * mean_warmth(found.standstill) + bias_K
        rows.append(release(found.standstill, 0.0) - right)
    return rows


def small(errors: list[float]) -> None:
    assert abs(np.mean(errors)) < 0.25
    assert np.median(np.abs(errors)) < 0.35
    assert np.max(np.abs(errors)) < 2.0


def test_truth_of_the_synthetic_turbine() -> None:
    rows = []
    for seed in range(1, 6):
        record, bias = turbine_record(seed)
        found = heat_release_regression(record, reference_K=REFERENCE_K)
        truth = SyntheticParameters()
        rows += errors(
            found, truth.operation_release, truth.standstill_release, bias["cabinet"] - bias["ambient"]
        )
    assert len(rows) == 15
    small(rows)


@pytest.mark.parametrize("tau_h", [0.5, 3.0])
def test_truth_of_plants(tau_h: float) -> None:
    rows = []
    for seed in range(1, 11):
        one = plant(seed, tau_h=tau_h)
        found = heat_release_regression(to_record(one), reference_K=REFERENCE_K)
        bias = dict(one.truth.biases).get("cabinet_temperature", 0.0)
        rows += errors(found, one.truth.operation_K, one.truth.standstill_K, bias)
    assert len(rows) >= 28
    small(rows)


def test_settling_takes_the_transients_bias_off() -> None:
    """A slow cabinet is still warm from operation in the short periods of a standstill."""
    plain, settled = [], []
    for seed in range(1, 9):
        one = plant(seed, tau_h=6.0)
        found = heat_release_regression(to_record(one), reference_K=REFERENCE_K)
        fit, truth = found.standstill, one.truth.standstill_K
        bias = dict(one.truth.biases).get("cabinet_temperature", 0.0)
        right = truth[0] + truth[1] * mean_warmth(fit) + bias
        # a regression with a constant has the mean of its response
        plain.append(fit.points.difference_K.mean() - right)
        settled.append(release(fit, 0.0) - right)
    assert np.mean(plain) > 0.4
    assert abs(np.mean(settled)) < 0.5 * np.mean(plain)


def test_a_wrong_time_constant_does_not_settle_anything(monkeypatch: pytest.MonkeyPatch) -> None:
    found, _ = with_time_constant(monkeypatch, block_record(3, scatter_K=0.1, noise_K=0.15), 100.0)
    slope = found.operation.coefficients["heat_release_operation_ambient"]
    assert slope == pytest.approx(OPERATION[3], abs=0.02)


# --- regression -----------------------------------------------------------------------------


def test_what_is_left_out_is_that_of_refitting() -> None:
    random = np.random.default_rng(3)
    episode = np.repeat(np.arange(12), 4)
    power, noise = random.uniform(size=(2, 48))
    x, y = np.column_stack([np.ones(48), power, power**2]), 2.0 + power + noise
    sums = []
    for g in range(12):
        out = episode == g
        error = y[out] - x[out] @ np.linalg.lstsq(x[~out], y[~out], rcond=None)[0]
        sums.append(float(error @ error))
    assert _left_out(x, y, episode) == pytest.approx(sums, rel=1e-9)
    assert _left_out(x, y, np.zeros(48, int)) is None


def test_the_simplest_form_that_predicts_as_well_is_taken(scattered: HeatRelease) -> None:
    assert (scattered.operation.order, scattered.operation.ambient) == (2, True)
    assert scattered.standstill.ambient


def test_no_slope_is_found_where_there_is_none() -> None:
    record = block_record(4, scatter_K=1.0)
    ambient = record["ambient_temperature"]
    flat = np.interp(record["cabinet_temperature"].time, ambient.time, ambient.value) + 6.0
    flat += 0.1 * np.random.default_rng(1).standard_normal(len(flat))
    fit = heat_release_regression(changed(record, "cabinet_temperature", flat), reference_K=REFERENCE_K)
    assert (fit.operation.order, fit.operation.ambient, fit.standstill.ambient) == (0, False, False)
    assert fit.start() == pytest.approx(
        {"heat_release_operation": 6.0, "heat_release_standstill": 6.0}, abs=0.02
    )


def test_no_curve_is_drawn_through_powers_that_no_period_reaches() -> None:
    for powers, most in (((-0.01, 0.02, 0.1, 0.9, 1.0), 1), ((-0.01, 0.02, 0.5, 1.0), 2)):
        found = heat_release_regression(block_record(9, scatter_K=0.3, powers=powers))
        assert 1 <= found.operation.order <= most
    assert heat_release_regression(block_record(9, scatter_K=0.3)).operation.order == 2


def test_a_record_without_scatter_raises_no_warning() -> None:
    still = without(block_record(6, powers=(0.5,)), "active_power")
    still = changed(changed(still, "cabinet_temperature", 290.0), "ambient_temperature", 280.0)
    fit = heat_release_regression(still).standstill
    assert fit.coefficients["heat_release_standstill"] == pytest.approx(10.0)


# --- what records are like ------------------------------------------------------------------


def test_too_few_periods_give_no_regression(made: Plant) -> None:
    record = to_record(made)
    short = record.window(record.start_s, record.start_s + 3.0 * 24.0 * HOUR_S)
    found = heat_release_regression(short)
    assert found.operation is None and found.standstill is None
    assert found.start() == {}
    assert FitCode.TOO_FEW_PERIODS in [one.code for one in found.statements]
    assert plain(found)["operation"] is None


def test_constant_power() -> None:
    one = plant(6, days=120.0, power="constant")
    found = heat_release_regression(to_record(one), reference_K=REFERENCE_K)
    assert found.operation.order == 0
    assert found.standstill is None and FitCode.REGIME_ABSENT(regime="standstill") in found.statements
    a = one.truth.operation_K
    warm = found.operation.points.ambient_K.mean() - REFERENCE_K
    right = (
        a[0] + a[1] * 0.6 + a[2] * 0.36 + a[3] * warm + dict(one.truth.biases).get("cabinet_temperature", 0.0)
    )
    assert release(found.operation, 0.6) == pytest.approx(right, abs=0.5)


def test_no_standstill() -> None:
    found = heat_release_regression(to_record(plant(7, days=120.0, standstill=False)))
    assert found.operation.order >= 1
    assert found.standstill is None
    assert FitCode.REGIME_ABSENT(regime="standstill") in found.statements
    assert not any("standstill" in name for name in found.start())


def test_no_power_is_standstill(made: Plant) -> None:
    record = to_record(made)
    for one in (without(record, "active_power"), changed(record, "active_power", np.nan)):
        found = heat_release_regression(one)
        assert found.operation is None
        assert found.standstill.n_points > 100
        assert FitCode.NO_POWER() in found.statements
        assert "heat_release_standstill" in found.start()


def test_power_that_never_rises_above_zero(made: Plant) -> None:
    idle = changed(to_record(made), "active_power", -3e3)
    rated = heat_release_regression(idle)
    assert rated.operation is None and rated.standstill.n_points > 100
    assert FitCode.REGIME_ABSENT(regime="operation") in rated.statements
    unrated = heat_release_regression(replace(idle, rated_power_W=None))
    assert unrated.standstill.n_points > 100
    assert FitCode.POWER_NEVER_POSITIVE() in unrated.statements


def test_no_cabinet_or_no_time_in_common(made: Plant) -> None:
    record = to_record(made)
    found = heat_release_regression(without(record, "cabinet_temperature"))
    assert found.operation is None and found.standstill is None
    assert found.statements == (FitCode.NO_READINGS_FOR_PERIODS(signals=("cabinet_temperature",)),)
    cabinet = record["cabinet_temperature"]
    later = record.replace_series(replace(cabinet, time=cabinet.time + 1e9))
    assert heat_release_regression(later).start() == {}


def test_hourly_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    record = block_record(7, scatter_K=0.5, step_s=(3600.0, 3600.0, 3600.0))
    found, lengths = with_time_constant(monkeypatch, record, 0.2)
    assert lengths == [2.0, 2.0]  # two steps, though three time constants are less than one
    start = found.start()
    assert start["heat_release_operation_ambient"] == pytest.approx(OPERATION[3], abs=0.03)
    assert start["heat_release_standstill"] == pytest.approx(STANDSTILL[0], abs=0.3)


def test_logger_means_are_means() -> None:
    """A cabinet logger that writes half-hour means gives what its instants give."""
    instants = heat_release_regression(to_record(plant(8, days=120.0)), reference_K=REFERENCE_K)
    means = heat_release_regression(
        to_record(plant(8, days=120.0, logger_mean=True, logger_step_min=30.0)),
        reference_K=REFERENCE_K,
    )
    assert means.operation.n_points > 0.5 * instants.operation.n_points
    for power in (0.1, 0.5, 1.0):
        assert release(means.operation, power) == pytest.approx(release(instants.operation, power), abs=0.5)


def test_the_length_of_the_periods_follows_the_time_constant(monkeypatch: pytest.MonkeyPatch) -> None:
    record = block_record(8, scatter_K=0.5)
    for tau_h, length_h in ((0.1, 1.0), (0.5, 1.5), (1.0, 3.0), (1.8, 5.5)):
        assert with_time_constant(monkeypatch, record, tau_h)[1] == pytest.approx([length_h, length_h])
    # blocks last for seven hours and the ends of ramps: nine hours are not to be had
    assert 5.5 < with_time_constant(monkeypatch, record, 3.0)[1][0] < 9.0


# --- use ------------------------------------------------------------------------------------


def test_readings_after_the_identification_period_are_not_used(made: Plant) -> None:
    record = to_record(made, until_s=to_record(made).start_s + 120.0 * 24.0 * HOUR_S)
    found = heat_release_regression(record)
    other = heat_release_regression(changed(record, "cabinet_temperature", 350.0, record.until_s))
    assert plain(found) == plain(other)
    assert plain(found) == plain(heat_release_regression(record.identification()))
    assert plain(found) != plain(heat_release_regression(replace(record, until_s=None)))


def test_names_and_starts_are_the_mechanisms(scattered: HeatRelease) -> None:
    start = scattered.start()
    known = {p.name: p for p in heat_release(order=3).parameters}
    assert set(start) <= set(known)
    record = block_record(2, scatter_K=1.0)
    made = design(record, kind="thermal", power_order=scattered.operation.order, heat_start=start)
    given = {p.name: p.start for p in made.model.parameters}
    assert {name: given[name] for name in start} == start


def test_the_reference_is_that_of_the_design() -> None:
    record = block_record(2, scatter_K=1.0)
    found = heat_release_regression(record)
    settings = dict(design(record, kind="thermal").mechanisms)["heat_release"]
    assert found.reference_K == settings["reference_K"]


def test_starts_stay_within_the_mechanisms_bounds(scattered: HeatRelease) -> None:
    fit = scattered.standstill
    wild = dict.fromkeys(fit.coefficients, 1e4)
    start = replace(scattered, standstill=replace(fit, coefficients=wild)).start()
    bounds = {p.name: p.upper for p in heat_release().parameters}
    assert start["heat_release_standstill"] == bounds["heat_release_standstill"]


def test_plain_data(scattered: HeatRelease, monkeypatch: pytest.MonkeyPatch) -> None:
    data = json.loads(json.dumps(plain(scattered), allow_nan=False))
    assert set(data) == {"operation", "standstill", "reference_K", "statements"}
    regime, fit = data["operation"], scattered.operation
    assert regime["coefficients"] == pytest.approx(dict(fit.coefficients))
    assert regime["n_points"] == len(regime["points"]["power"]) == fit.n_points
    assert len({len(column) for column in regime["points"].values()}) == 1
    assert regime["points"]["power"] == fit.points.power.tolist()
    assert data["statements"] == []
    monkeypatch.setattr("hygrokf.identification.steady_state.MOST_REGIME_POINTS", 50)
    thinned = scattered.thinned().operation.points
    assert 25 <= len(thinned) <= 50
    np.testing.assert_array_equal(thinned.power, fit.points.power[:: -(-fit.n_points // 50)])


def test_pandas_is_not_imported_with_the_module() -> None:
    code = "import sys, hygrokf.identification.steady_state; sys.exit('pandas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- measured -------------------------------------------------------------------------------


@pytest.mark.skipif(not SHARED.exists(), reason="measured data are not beside the repository")
@pytest.mark.parametrize("house", ["R2", "R4", "R7"])
def test_an_attic_has_a_release_without_power(house: str) -> None:
    with gzip.open(SHARED / f"attic_trh1_{house}_hourly.csv.gz", "rt", encoding="utf-8") as file:
        names = file.readline().strip().split(",")
        rows = [line.rstrip("\n").split(",") for line in file]
    time, first = np.unique(
        np.array([row[0] for row in rows], "datetime64[s]").astype(float) - 7200.0, return_index=True
    )

    def column(name: str) -> np.ndarray:
        place = names.index(name)
        return np.array([float(row[place] or "nan") for row in rows])[first] + 273.15

    record = Record(
        house,
        (
            Series("cabinet_temperature", time, column("T_roofmiddle_airtop")),
            Series("ambient_temperature", time, column("T_fmi")),
        ),
    )
    found = heat_release_regression(record)
    assert found.operation is None
    assert found.standstill.n_episodes > 100
    # A ventilated attic is hardly warmer than the air outside where nothing changes.
    assert abs(found.standstill.coefficients["heat_release_standstill"]) < 2.0
