"""Scores and baselines by hand, the sensors' share, and the coverage of bands."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from builders.known_values import physical_values, with_reference
from numpy.testing import assert_array_equal
from plants import plant
from plants.as_record import to_record
from scipy.stats import binom

from hygrokf.data.structured import plain
from hygrokf.evaluation.scoring import (
    REGIMES,
    Counts,
    Coverage,
    Errors,
    bands,
    baselines,
    coverage,
    period_masks,
    rmse,
    scores,
    sensor_share,
)
from hygrokf.evaluation.simulation import Prediction, free_run, measured
from hygrokf.modelling.design import design
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.psychrometrics import absolute_humidity

DAY_S = 86400.0


def true_values(made) -> dict[str, float]:
    """All parameters of a plant of the model's class: physics, disturbances, biases and noise."""
    truth = made.truth
    biases = dict(truth.biases)
    ratio = truth.cabinet_K / truth.ambient_K
    vapour = 1e3 * truth.vapour.free_run_kg_m3 * ratio

    def coloured(free_run: float, correlation_h: float, lag_h: float) -> float:
        """What a first-order lag makes the stated free-run error of."""
        return free_run * math.sqrt((correlation_h + lag_h) / correlation_h)

    return {
        **physical_values(truth),
        "heat_disturbance_sd": coloured(truth.heat.free_run_K, truth.heat.correlation_h, truth.tau_h),
        "heat_disturbance_time": truth.heat.correlation_h,
        "thermal_diffusion": truth.heat.diffusion_K,
        "cabinet_temperature_bias": biases["cabinet_temperature"],
        "cabinet_temperature_noise": 0.05,
        "vapour_disturbance_sd": coloured(vapour, truth.vapour.correlation_h, truth.hygric_h),
        "vapour_disturbance_time": truth.vapour.correlation_h,
        "hygric_diffusion": 1e3 * truth.vapour.diffusion_kg_m3,
        "cabinet_relative_humidity_bias": biases["cabinet_relative_humidity"] / 100.0,
        "cabinet_relative_humidity_noise": 0.003,
    }


def parted(run, until_s):
    """The run whose record's identification period ends at a time [s]; None: nowhere."""
    return replace(run, record=replace(run.record, until_s=until_s))


def true_model(seed: int, days: float = 30.0):
    made = plant(seed, days=days)
    record = to_record(made)
    return record, with_reference(design(record)), true_values(made)


@pytest.fixture(scope="module")
def one():
    record, base, values = true_model(51, 20.0)
    until_s = record.start_s + 14 * DAY_S
    driven = parted(model_inputs(base, record), until_s)
    return SimpleNamespace(
        record=record,
        base=base,
        values=values,
        run=driven,
        predicted=free_run(base, values, driven),
        until=until_s,
        whole=parted(driven, None),
        seconds=driven.timeline.seconds,
        known=measured(driven),
    )


# --- errors ---------------------------------------------------------------------------------


def test_root_mean_squared_errors_by_hand():
    error = np.array([3.0, -4.0, np.nan, 1.0, 1.0])
    operating = np.array([True, True, True, False, False])
    found = rmse(error, operating)
    assert found.operation == pytest.approx(math.sqrt(12.5))
    assert found.standstill == pytest.approx(1.0)
    assert found.total == pytest.approx(math.sqrt(27.0 / 4.0))
    assert found.n == Counts(operation=2, standstill=2, total=4)
    nothing = rmse(error, np.ones(5, bool))
    assert math.isnan(nothing.standstill)
    assert nothing.n.standstill == 0
    empty = rmse(np.full(5, np.nan), operating)
    assert all(math.isnan(getattr(empty, regime)) for regime in REGIMES)


def test_periods_part_at_until(one):
    masks = period_masks(one.run)
    assert_array_equal(masks["identification"], one.seconds <= one.until)
    assert_array_equal(masks["validation"], one.seconds > one.until)
    whole = period_masks(one.whole)
    assert whole["identification"].all()
    assert not whole["validation"].any()


def test_scores_by_hand(one):
    found = scores(one.run, one.predicted)
    early = one.seconds <= one.until
    on = one.run.operating
    for quantity in ("temperature_K", "absolute_humidity_g_m3"):
        square = (one.known[quantity] - one.predicted.of(quantity)[0]) ** 2
        for period, chosen in (("identification", early), ("validation", ~early)):
            for regime, part in (("operation", on), ("standstill", ~on), ("total", on | ~on)):
                there = chosen & part & np.isfinite(square)
                assert getattr(found[period][quantity].n, regime) == there.sum() > 50
                expected = math.sqrt(square[there].mean())
                assert getattr(found[period][quantity], regime) == pytest.approx(expected)


def test_unknown_stretches_are_not_scored(one):
    scored = one.seconds < one.until - DAY_S
    found = scores(replace(one.run, scored=scored), one.predicted)
    assert plain(found["validation"]["temperature_K"]) == plain(Errors())
    assert found["identification"]["temperature_K"].n.total == np.sum(
        np.isfinite(one.known["temperature_K"]) & scored
    )


def test_a_quantity_that_the_model_lacks_has_no_score(one):
    thermal = Prediction(one.predicted.temperature, None, None)
    found = scores(one.whole, thermal)
    assert math.isnan(found["identification"]["absolute_humidity_g_m3"].total)
    assert found["identification"]["temperature_K"].total > 0


# --- baselines ------------------------------------------------------------------------------


def test_humidity_baselines_by_hand(one):
    found = baselines(one.run)
    t = one.run.timeline
    inside, outside = one.known["absolute_humidity_g_m3"], t.input("ambient_absolute_humidity")
    balance = outside * t.input("ambient_temperature") / one.known["temperature_K"]
    late = (one.seconds > one.until) & np.isfinite(inside)
    for name, guess in (("ambient", outside), ("ambient_pressure_balance", balance)):
        part = late & np.isfinite(guess)
        expected = math.sqrt(np.mean((inside - guess)[part] ** 2))
        assert found["validation"][name]["absolute_humidity_g_m3"].total == pytest.approx(expected)
        assert found["validation"][name]["absolute_humidity_g_m3"].n.total == part.sum()


def test_heat_release_without_storage_by_hand(one):
    """Normal equations on the identification period alone; the score of the validation period is a
    prediction."""
    t = one.run.timeline
    warm, outside = one.known["temperature_K"], t.input("ambient_temperature")
    on, dT = t.input("operating"), outside - 283.15
    x = np.column_stack([np.ones(len(t)), dT, on, on * dT, t.input("power_1"), t.input("power_2")])
    early = (one.seconds <= one.until) & np.isfinite(warm)
    beta = np.linalg.inv(x[early].T @ x[early]) @ (x[early].T @ (warm - outside)[early])
    found = baselines(one.run)
    for period, chosen in (
        ("identification", early),
        ("validation", (one.seconds > one.until) & np.isfinite(warm)),
    ):
        expected = math.sqrt(np.mean((warm - outside - x @ beta)[chosen] ** 2))
        assert found[period]["no_dynamics"]["temperature_K"].total == pytest.approx(expected, rel=1e-6)
    # validation readings do not touch the fit
    y = t.y.copy()
    y[one.seconds > one.until] += 5.0
    spoilt = baselines(replace(one.run, timeline=t.with_readings(y)))
    assert spoilt["identification"]["no_dynamics"] == found["identification"]["no_dynamics"]


def test_a_model_with_its_true_parameters_beats_every_baseline(one):
    """Temperature by far. Of the humidity a sceptic's c_amb leaves little to win at a time constant below an
    hour."""
    found = scores(one.whole, one.predicted)["identification"]
    guesses = baselines(one.whole)["identification"]
    assert found["temperature_K"].total < 0.8 * guesses["no_dynamics"]["temperature_K"].total
    for name in ("ambient", "ambient_pressure_balance"):
        assert found["absolute_humidity_g_m3"].total < guesses[name]["absolute_humidity_g_m3"].total


def test_baselines_of_a_thermal_model_and_of_few_readings(one):
    thermal = design(one.record, kind="thermal")
    found = baselines(parted(model_inputs(thermal, one.record), None))
    assert set(found["identification"]) == {"no_dynamics"}
    y = np.full_like(one.run.timeline.y, np.nan)
    y[:20] = one.run.timeline.y[:20]
    few = replace(one.whole, timeline=one.run.timeline.with_readings(y))
    assert "no_dynamics" not in baselines(few)["identification"]


# --- sensors --------------------------------------------------------------------------------


def errors_of(kelvin: float, grams: float) -> dict[str, dict[str, Errors]]:
    """The same errors in both periods."""
    row = {"temperature_K": Errors(total=kelvin), "absolute_humidity_g_m3": Errors(total=grams)}
    return dict.fromkeys(("identification", "validation"), row)


def sensor_case(record, humidity: float, celsius: float):
    """The run of the record with constant readings."""
    warm, moist = record["cabinet_temperature"], record["cabinet_relative_humidity"]
    constant = record.replace_series(
        replace(warm, value=np.full(len(warm), celsius + 273.15)),
        replace(moist, value=np.full(len(moist), humidity)),
    )
    return model_inputs(design(record), constant)


def test_two_percent_of_humidity_are_a_quarter_of_a_gram(one):
    """2 % RH is 0.26 g/m³ at 15 °C; as a 95 % bound it is 0.13 g/m³ of standard deviation."""
    grams = 1e3 * absolute_humidity(0.02, 288.15)
    assert grams == pytest.approx(0.256, abs=0.002)
    driven = sensor_case(one.record, 0.5, 15.0)
    record = driven.record
    exact = record.replace_series(replace(record["cabinet_temperature"], accuracy=0.0))
    found = sensor_share(replace(driven, record=exact), errors_of(1.5, 0.4))["identification"]
    assert found["absolute_humidity_g_m3"] == pytest.approx((grams / 1.96) ** 2 / 0.4**2, rel=1e-3)
    assert "temperature_K" not in found  # stated as exact: nothing to explain
    # a temperature sensor that is 0.3 K off moves e_s by 2 %: in quadrature
    both = sensor_share(driven, errors_of(1.5, 0.4))["identification"]
    slope = (absolute_humidity(0.5, 288.45) - absolute_humidity(0.5, 287.85)) / 0.6 * 1e3
    expected = ((grams / 1.96) ** 2 + (slope * 0.3 / 1.96) ** 2) / 0.4**2
    assert both["absolute_humidity_g_m3"] == pytest.approx(expected, rel=1e-3)
    assert both["temperature_K"] == pytest.approx((0.3 / 1.96) ** 2 / 1.5**2)


def test_sensor_share_is_a_share(one):
    driven = sensor_case(one.record, 0.5, 15.0)
    found = sensor_share(driven, errors_of(0.01, math.nan))
    assert found["identification"]["temperature_K"] == 1.0
    assert math.isnan(found["identification"]["absolute_humidity_g_m3"])


def test_a_bone_dry_cabinet_divides_by_nothing(one):
    driven = sensor_case(one.record, 0.0, 15.0)
    found = sensor_share(driven, errors_of(1.5, 0.4))["identification"]["absolute_humidity_g_m3"]
    assert found == pytest.approx((0.256 / 1.96) ** 2 / 0.16, rel=0.01)


# --- bands ----------------------------------------------------------------------------------


def test_coverage_by_hand():
    reading = np.array([0.0, 1.0, -3.0, np.nan, 2.5])
    found = coverage(reading, np.zeros(5), np.array([1.0, 1.0, 1.0, 1.0, 2.0]))
    assert found.n == 4
    assert found.coverage == 0.75
    z = np.sort([0.0, 1.0, 3.0, 1.25])
    assert found.scale == pytest.approx(np.quantile(z, 0.95) / 1.959964, rel=1e-6)
    assert plain(coverage(reading[3:4], np.zeros(1), np.ones(1))) == plain(Coverage())


def test_coverage_of_normal_numbers_is_nominal():
    random = np.random.default_rng(61)
    sd = random.uniform(0.1, 3.0, 4000)
    found = coverage(sd * random.normal(size=4000), np.zeros(4000), sd)
    low, high = binom.ppf([0.0005, 0.9995], 4000, 0.95) / 4000
    assert low <= found.coverage <= high
    assert found.scale == pytest.approx(1.0, abs=0.05)
    assert coverage(2 * sd, np.zeros(4000), sd, 0.5).coverage == 0.0


def test_forecast_bands_hold_on_plants_with_their_true_parameters():
    """One-hour forecasts that start two hours apart are all but independent: over three plants of 30 days the
    count of readings inside the 95 % band lies in the binomial band (99.9 %).  Longer leads overlap: there
    only that the scale is about one."""
    inside, total, scales = {}, {}, {}
    for seed in (71, 72, 73):
        record, base, values = true_model(seed)
        driven = parted(model_inputs(base, record), record.start_s + 5 * DAY_S)
        found = bands(base, values, driven, free_run(base, values, driven))
        assert list(found) == ["1h", "6h", "24h", "free_run"]
        for lead, by_quantity in found.items():
            assert set(by_quantity) == {"temperature_K", "relative_humidity", "absolute_humidity_g_m3"}
            for quantity, cell in by_quantity.items():
                scales.setdefault((lead, quantity), []).append(cell.scale)
                if lead == "1h":
                    inside[quantity] = inside.get(quantity, 0) + round(cell.coverage * cell.n)
                    total[quantity] = total.get(quantity, 0) + cell.n
    for quantity, count in inside.items():
        low, high = binom.ppf([0.0005, 0.9995], total[quantity], 0.95)
        assert total[quantity] > 700
        assert low <= count <= high, (quantity, count / total[quantity])
    for key, found in scales.items():
        assert 0.8 < np.mean(found) < 1.25, (key, found)


def test_bands_are_those_of_the_validation_period(one):
    """Readings before `until` are not counted, and a record without validation period is counted whole."""
    late = bands(one.base, one.values, one.run, one.predicted)
    there = np.isfinite(one.known["temperature_K"]) & (one.seconds > one.until)
    assert late["free_run"]["temperature_K"].n == there.sum()
    whole = bands(one.base, one.values, one.whole, one.predicted)
    assert whole["free_run"]["temperature_K"].n == np.isfinite(one.known["temperature_K"]).sum()
    y = one.run.timeline.y.copy()
    y[one.seconds > one.until] += 50.0
    spoilt = replace(one.run, timeline=one.run.timeline.with_readings(y))
    found = bands(one.base, one.values, spoilt, one.predicted)["free_run"]["temperature_K"]
    assert found.coverage == 0.0
