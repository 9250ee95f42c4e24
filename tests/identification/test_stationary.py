"""Heat release from quasi-stationary periods: recovery of the truth, standard errors by an independent
formula, and records of every legal shape."""

from __future__ import annotations

import gzip
import json
import math
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
from hygrokf.identification.steady_state import HeatRelease, Regression, heat_release_regression
from hygrokf.modelling.design import design
from hygrokf.physics.mechanisms.thermal import heat_release

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


def regressors(fit: Regression) -> np.ndarray:
    columns = [fit.points.power**k for k in range(fit.order + 1)]
    return np.column_stack([*columns, *([fit.points.ambient_K - REFERENCE_K] if fit.ambient else [])])


# --- truth ----------------------------------------------------------------------------------


def test_exact_on_a_cabinet_without_inertia() -> None:
    # Its time constant is nought; one given near nought asks for the shortest periods.
    found = heat_release_regression(block_record(1), reference_K=REFERENCE_K, time_constant_h=1e-6)
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
    assert found.operation.r2 > 0.999


def score(fit: Regression, power: float, right: float) -> tuple[float, float]:
    """Error of the release [K] at a power and the periods' mean ambient temperature; the same in clustered
    errors."""
    x, episode = regressors(fit), fit.points.episode
    residual = fit.points.settled_K - fit.points.fitted_K
    sums = np.array([x[episode == g].T @ residual[episode == g] for g in np.unique(episode)])
    bread = np.linalg.inv(x.T @ x)
    row = np.array([power**k for k in range(fit.order + 1)] + [mean_warmth(fit)] * fit.ambient)
    error = float(row @ [one.value for one in fit.coefficients.values()]) - right
    return error, error / math.sqrt(row @ bread @ sums.T @ sums @ bread @ row)


def mean_warmth(fit: Regression) -> float:
    return float(fit.points.ambient_K.mean()) - REFERENCE_K


def scores(
    found: HeatRelease, operation: tuple[float, ...], standstill: tuple[float, ...], bias_K: float
) -> list[tuple[float, float]]:
    """Scores at low and high power, where most periods are, and at standstill; a sensor's bias is no
    error."""
    rows = []
    a, b = operation, standstill
    for p in (0.03, 0.97):
        right = a[0] + a[1] * p + a[2] * p**2 + a[3] * mean_warmth(found.operation) + bias_K
        rows.append(score(found.operation, p, right))
    if found.standstill is not None:
        rows.append(score(found.standstill, 0.0, b[0] + b[1] * mean_warmth(found.standstill) + bias_K))
    return rows


def within_errors(rows: list[tuple[float, float]]) -> None:
    errors, ratios = np.array(rows).T
    assert math.sqrt(np.mean(ratios**2)) < 1.7
    assert np.max(np.abs(ratios)) < 4.0
    assert abs(np.mean(errors)) < 0.25
    assert np.median(np.abs(errors)) < 0.35


def test_truth_of_the_synthetic_turbine_within_clustered_errors() -> None:
    rows = []
    for seed in range(1, 6):
        record, bias = turbine_record(seed)
        found = heat_release_regression(record, reference_K=REFERENCE_K)
        assert found.time_constant_h == pytest.approx(1.5, rel=0.15)
        truth = SyntheticParameters()
        rows += scores(
            found, truth.operation_release, truth.standstill_release, bias["cabinet"] - bias["ambient"]
        )
    assert len(rows) == 15
    within_errors(rows)


@pytest.mark.parametrize("tau_h", [0.5, 3.0])
def test_truth_of_plants_within_clustered_errors(tau_h: float) -> None:
    rows = []
    for seed in range(1, 11):
        one = plant(seed, tau_h=tau_h)
        found = heat_release_regression(to_record(one), reference_K=REFERENCE_K)
        assert found.time_constant_h == pytest.approx(tau_h, rel=0.2)
        bias = dict(one.truth.biases).get("cabinet_temperature", 0.0)
        rows += scores(found, one.truth.operation_K, one.truth.standstill_K, bias)
    assert len(rows) >= 28
    within_errors(rows)


def rate_K_h(record: Record, fit: Regression) -> np.ndarray:
    """Mean rate of change of the cabinet temperature over each period, from the readings themselves."""
    cabinet = record["cabinet_temperature"]
    known = ~cabinet.missing
    ends = [
        np.interp(at, cabinet.time[known], cabinet.value[known])
        for at in (fit.points.start_s, fit.points.end_s)
    ]
    return (ends[1] - ends[0]) * HOUR_S / (fit.points.end_s - fit.points.start_s)


def test_settling_takes_the_transients_bias_off() -> None:
    """A slow cabinet is still warm from operation in the short periods of a standstill."""
    plain, settled = [], []
    for seed in range(1, 9):
        one, record = plant(seed, tau_h=6.0), to_record(plant(seed, tau_h=6.0))
        found = heat_release_regression(record, reference_K=REFERENCE_K)
        fit, truth = found.standstill, one.truth.standstill_K
        assert fit.settled and fit.transient_K > 0.5
        bias = dict(one.truth.biases).get("cabinet_temperature", 0.0)
        right = truth[0] + truth[1] * mean_warmth(fit) + bias
        # a regression with a constant has the mean of its response
        plain.append(fit.points.difference_K.mean() - right)
        settled.append(fit.points.fitted_K.mean() - right)
        np.testing.assert_allclose(
            fit.points.settled_K - fit.points.difference_K,
            found.time_constant_h * rate_K_h(record, fit),
            atol=1e-9,
        )
    assert np.mean(plain) > 0.4
    assert abs(np.mean(settled)) < 0.5 * np.mean(plain)


def test_a_wrong_time_constant_does_not_settle_anything() -> None:
    record = block_record(3, scatter_K=0.1, noise_K=0.15)
    fit = heat_release_regression(record, reference_K=REFERENCE_K, time_constant_h=100.0).operation
    assert not fit.settled
    np.testing.assert_array_equal(fit.points.settled_K, fit.points.difference_K)
    assert fit.coefficients["heat_release_operation_ambient"].value == pytest.approx(OPERATION[3], abs=0.02)


# --- regression -----------------------------------------------------------------------------


def test_clustered_errors_are_those_of_the_formula(scattered: HeatRelease) -> None:
    for fit in (scattered.operation, scattered.standstill):
        x, y, episode = regressors(fit), fit.points.settled_K, fit.points.episode
        n, k, groups = len(y), x.shape[1], np.unique(episode)
        beta = np.linalg.solve(x.T @ x, x.T @ y)
        meat = np.zeros((k, k))
        for g in groups:
            score = np.zeros(k)
            for i in np.flatnonzero(episode == g):
                score += x[i] * (y[i] - x[i] @ beta)
            meat += np.outer(score, score)
        bread = np.linalg.inv(x.T @ x)
        scale = len(groups) / (len(groups) - 1.0) * (n - 1.0) / (n - k)
        se = np.sqrt(np.diag(scale * bread @ meat @ bread))
        assert [one.value for one in fit.coefficients.values()] == pytest.approx(beta.tolist(), rel=1e-9)
        assert [one.se for one in fit.coefficients.values()] == pytest.approx(se.tolist(), rel=1e-9)
        assert fit.residual_sd_K == pytest.approx(math.sqrt(np.sum((y - x @ beta) ** 2) / (n - k)), rel=1e-9)
        assert fit.r2 == pytest.approx(1.0 - np.var(y - x @ beta) / np.var(y), rel=1e-9)
        np.testing.assert_allclose(fit.points.fitted_K, x @ beta)
        assert (fit.n_points, fit.n_episodes) == (n, len(groups))


def test_cross_validation_is_that_of_refitting(scattered: HeatRelease) -> None:
    fit = scattered.operation
    p, warm, y = fit.points.power, fit.points.ambient_K - REFERENCE_K, fit.points.settled_K
    errors = {}
    for one in fit.cross_validation:
        x = np.column_stack([*[p**k for k in range(one.order + 1)], *([warm] if one.ambient else [])])
        left = np.empty(len(y))
        for g in np.unique(fit.points.episode):
            out = fit.points.episode == g
            left[out] = y[out] - x[out] @ np.linalg.lstsq(x[~out], y[~out], rcond=None)[0]
        errors[one.order, one.ambient] = left**2
        assert one.error_K == pytest.approx(math.sqrt(np.mean(left**2)), rel=1e-9)
    assert set(errors) == {(k, t) for k in range(4) for t in (False, True)}
    best = min(errors, key=lambda form: errors[form].mean())
    for one in fit.cross_validation:
        above = errors[one.order, one.ambient] - errors[best]
        assert one.excess == pytest.approx(above.mean(), abs=1e-9)
        sums = [
            np.sum((above - above.mean())[fit.points.episode == g]) for g in np.unique(fit.points.episode)
        ]
        groups = len(sums)
        assert one.excess_se == pytest.approx(
            math.sqrt(groups / (groups - 1) * np.sum(np.square(sums))) / len(y), abs=1e-9
        )
    within = [c for c in fit.cross_validation if c.excess <= c.excess_se]
    fewest = min(c.order + c.ambient for c in within)
    chosen = [c for c in fit.cross_validation if c.chosen]
    assert len(chosen) == 1
    assert chosen[0] in within and chosen[0].order + chosen[0].ambient == fewest
    assert (fit.order, fit.ambient) == (chosen[0].order, chosen[0].ambient) == (2, True)


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
    assert fit.operation.r2 == 0.0


def test_no_curve_is_drawn_through_powers_that_no_period_reaches() -> None:
    ends = heat_release_regression(
        block_record(9, scatter_K=0.3, powers=(-0.01, 0.02, 0.1, 0.9, 1.0))
    ).operation
    assert {c.order for c in ends.cross_validation} == {0, 1}
    assert "not tried" in ends.statement
    middle = heat_release_regression(block_record(9, scatter_K=0.3, powers=(-0.01, 0.02, 0.5, 1.0))).operation
    assert {c.order for c in middle.cross_validation} == {0, 1, 2}
    whole = heat_release_regression(block_record(9, scatter_K=0.3)).operation
    assert {c.order for c in whole.cross_validation} == {0, 1, 2, 3}
    assert "not tried" not in whole.statement


def test_a_disagreement_of_the_robust_fit_is_reported() -> None:
    record = block_record(5, scatter_K=0.2)
    value, power = record["cabinet_temperature"].value.copy(), record["active_power"]
    blocks = ((record["cabinet_temperature"].time - START_S) // (8.0 * HOUR_S)).astype(int)
    levels = power.value[(blocks * 48 + 20).clip(max=len(power.value) - 1)] / RATED_W
    # A door stood open in every fourth block near rated power, for all of it.
    opened = (levels > 0.8) & (blocks % 4 == 0)
    fit = heat_release_regression(changed(record, "cabinet_temperature", value), reference_K=REFERENCE_K)
    assert "robust" not in fit.statement
    value[opened] -= 12.0
    fit = heat_release_regression(changed(record, "cabinet_temperature", value), reference_K=REFERENCE_K)
    right = OPERATION[0] + OPERATION[1] * 0.9 + OPERATION[2] * 0.81
    values = [
        [getattr(one, kind) for one in fit.operation.coefficients.values()] for kind in ("value", "robust")
    ]
    rows = np.array([0.9**k for k in range(fit.operation.order + 1)] + [0.0] * fit.operation.ambient)
    least, robust = (float(rows @ np.array(one)) for one in values)
    assert abs(robust - right) < 0.5 * abs(least - right)
    apart = [c for c in fit.operation.coefficients.values() if abs(c.value - c.robust) > 2.0 * c.se]
    assert bool(apart) == ("robust" in fit.statement)


def test_a_record_without_scatter_raises_no_warning() -> None:
    still = without(block_record(6, powers=(0.5,)), "active_power")
    still = changed(changed(still, "cabinet_temperature", 290.0), "ambient_temperature", 280.0)
    fit = heat_release_regression(still).standstill
    assert fit.coefficients["heat_release_standstill"].value == pytest.approx(10.0)
    assert fit.coefficients["heat_release_standstill"].robust == pytest.approx(10.0)
    assert fit.residual_sd_K == pytest.approx(0.0, abs=1e-9)


# --- what records are like ------------------------------------------------------------------


def test_too_few_periods_give_no_regression(made: Plant) -> None:
    record = to_record(made)
    short = record.window(record.start_s, record.start_s + 3.0 * 24.0 * HOUR_S)
    found = heat_release_regression(short)
    assert found.operation is None and found.standstill is None
    assert found.start() == {}
    assert "too few" in found.statement
    assert plain(found)["operation"] is None


def test_constant_power() -> None:
    one = plant(6, days=120.0, power="constant")
    found = heat_release_regression(to_record(one), reference_K=REFERENCE_K)
    assert found.operation.order == 0
    assert {c.order for c in found.operation.cross_validation} == {0}
    assert "0.60 … 0.60" in found.statement
    assert found.standstill is None and "standstill: none in the record" in found.statement
    a = one.truth.operation_K
    warm = found.operation.points.ambient_K.mean() - REFERENCE_K
    right = (
        a[0] + a[1] * 0.6 + a[2] * 0.36 + a[3] * warm + dict(one.truth.biases).get("cabinet_temperature", 0.0)
    )
    sd = found.operation.coefficients["heat_release_operation"].se
    assert abs(found.operation.points.fitted_K.mean() - right) < 3.5 * sd
    assert sd < 0.5


def test_no_standstill() -> None:
    found = heat_release_regression(to_record(plant(7, days=120.0, standstill=False)))
    assert found.operation.order >= 1
    assert found.standstill is None
    assert "standstill: none in the record" in found.statement
    assert not any("standstill" in name for name in found.start())


def test_no_power_is_standstill(made: Plant) -> None:
    record = to_record(made)
    for one in (without(record, "active_power"), changed(record, "active_power", np.nan)):
        found = heat_release_regression(one)
        assert found.operation is None and found.scale_W is None
        assert found.standstill.n_points > 100
        assert "no power" in found.statement
        assert "heat_release_standstill" in found.start()


def test_power_that_never_rises_above_zero(made: Plant) -> None:
    idle = changed(to_record(made), "active_power", -3e3)
    rated = heat_release_regression(idle)
    assert rated.operation is None and rated.standstill.n_points > 100
    assert "operation: none in the record" in rated.statement
    unrated = heat_release_regression(replace(idle, rated_power_W=None))
    assert unrated.standstill.n_points > 100
    assert "never rises above zero" in unrated.statement


def test_no_cabinet_or_no_time_in_common(made: Plant) -> None:
    record = to_record(made)
    found = heat_release_regression(without(record, "cabinet_temperature"))
    assert found.operation is None and found.standstill is None
    assert "cabinet_temperature" in found.statement
    cabinet = record["cabinet_temperature"]
    later = record.replace_series(replace(cabinet, time=cabinet.time + 1e9))
    assert heat_release_regression(later).start() == {}


def test_hourly_readings() -> None:
    record = block_record(7, scatter_K=0.5, step_s=(3600.0, 3600.0, 3600.0))
    found = heat_release_regression(record, reference_K=REFERENCE_K, time_constant_h=0.2)
    fit = found.operation
    assert fit.window_h == pytest.approx(2.0)  # two steps, though three time constants are less than one
    assert "the shortest allowed" in fit.statement
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
    for name, one in instants.operation.coefficients.items():
        if name in means.operation.coefficients:
            assert means.operation.coefficients[name].value == pytest.approx(one.value, abs=2.0 * one.se)


def test_the_length_of_the_periods_follows_the_time_constant() -> None:
    record = block_record(8, scatter_K=0.5)
    for tau_h, length_h in ((0.1, 1.0), (0.5, 1.5), (1.0, 3.0), (1.8, 5.5)):
        found = heat_release_regression(record, time_constant_h=tau_h)
        for fit in (found.operation, found.standstill):
            assert fit.window_h == pytest.approx(length_h)
            spans = (fit.points.end_s - fit.points.start_s) / HOUR_S
            np.testing.assert_allclose(spans, length_h)
        assert found.time_constant_h == tau_h
    # Blocks last for seven hours and the ends of ramps: nine hours are not to be had, and it is said.
    found = heat_release_regression(record, time_constant_h=3.0)
    assert 5.5 < found.operation.window_h < 9.0
    assert "time constant of 3 h" in found.operation.statement
    assert "would leave" in found.operation.statement


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
    assert found.scale_W == RATED_W


def test_starts_stay_within_the_mechanisms_bounds(scattered: HeatRelease) -> None:
    fit = scattered.standstill
    wild = {name: replace(one, value=1e4) for name, one in fit.coefficients.items()}
    start = replace(scattered, standstill=replace(fit, coefficients=wild)).start()
    bounds = {p.name: p.upper for p in heat_release().parameters}
    assert start["heat_release_standstill"] == bounds["heat_release_standstill"]


def test_plain_data(scattered: HeatRelease, monkeypatch: pytest.MonkeyPatch) -> None:
    data = json.loads(json.dumps(plain(scattered), allow_nan=False))
    assert set(data) == {"operation", "standstill", "reference_K", "scale_W", "time_constant_h", "statement"}
    regime, fit = data["operation"], scattered.operation
    assert regime["coefficients"]["heat_release_power_1"] == pytest.approx(
        vars(fit.coefficients["heat_release_power_1"])
    )
    assert regime["n_points"] == len(regime["points"]["power"]) == fit.n_points
    assert len({len(column) for column in regime["points"].values()}) == 1
    assert regime["points"]["fitted_K"] == fit.points.fitted_K.tolist()
    assert sum(row["chosen"] for row in regime["cross_validation"]) == 1
    assert data["statement"] == f"{data['operation']['statement']}; {data['standstill']['statement']}"
    monkeypatch.setattr("hygrokf.identification.steady_state.MOST_POINTS", 50)
    thinned = scattered.thinned().operation.points
    assert 25 <= len(thinned) <= 50
    np.testing.assert_array_equal(thinned.power, fit.points.power[:: -(-fit.n_points // 50)])


def test_statsmodels_is_not_imported_with_the_module() -> None:
    code = (
        "import sys, hygrokf.identification.steady_state; sys.exit('statsmodels' in sys.modules or "
        "'pandas' in sys.modules)"
    )
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
    assert found.standstill.window_h >= 2.0
    # A ventilated attic is hardly warmer than the air outside where nothing changes.
    assert abs(found.standstill.coefficients["heat_release_standstill"].value) < 2.0
    assert 0.0 < found.standstill.coefficients["heat_release_standstill"].se < 0.3
