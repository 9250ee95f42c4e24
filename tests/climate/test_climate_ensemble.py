"""Members and ensembles, against the filter's own moments, closed forms and another program's arithmetic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders.climate_case import FREE, HOUR_S, known_fit, made_up_weather

from hygrokf.climate.ensemble import _drawn, course, draw_members, kept_instants, simulate_years, years_of
from hygrokf.climate.region import driven
from hygrokf.data.record import Record
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.evaluation.simulation import free_run
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_results import Covariance, FitResults
from hygrokf.modelling.design import extended
from hygrokf.physics.psychrometrics import Surface, condenses


def short(days: int) -> Record:
    weather = made_up_weather()
    return weather.window(weather.start_s, weather.start_s + 86400.0 * days)


def test_members_have_the_fit_s_covariance_in_its_coordinates() -> None:
    fit = known_fit(0.1)
    correlated = np.array(fit.results.covariance.matrix)
    correlated[0, 3] = correlated[3, 0] = -0.8 * np.sqrt(correlated[0, 0] * correlated[3, 3])
    fit = replace(fit, results=FitResults(covariance=Covariance(tuple(FREE), correlated)))
    drawn = draw_members(fit, 4000, 3)
    logs = np.array([[np.log(m["thermal_time_constant"]), np.log(m["hygric_k"])] for m in drawn])
    assert logs.mean(axis=0) == pytest.approx(np.log([1.5, 0.4]), abs=0.006)
    assert logs.std(axis=0) == pytest.approx([0.1, 0.1], rel=0.05)
    assert np.corrcoef(logs.T)[0, 1] == pytest.approx(-0.8, abs=0.03)
    plain = np.array([m["heat_release_operation"] for m in drawn])  # not positive: its coordinate is itself
    assert plain.mean() == pytest.approx(5.0, abs=0.03) and plain.std() == pytest.approx(0.5, rel=0.05)
    assert {m["resistance_ratio"] for m in drawn} == {0.85}
    assert draw_members(fit, 2, 3) == drawn[:2] and draw_members(fit, 2, 4) != drawn[:2]


def test_a_noise_that_the_data_cannot_tell_from_zero_is_not_drawn_a_thousandfold() -> None:
    """A standard error of 0.06 beside a value of 2e-5: a logarithm would be uncertain by 3000."""
    fit = known_fit(hygric_diffusion=2e-5)
    covariance = Covariance(("hygric_diffusion",), np.array([[0.06**2]]))
    drawn = draw_members(replace(fit, results=FitResults(covariance=covariance)), 2000, 1)
    values = np.array([m["hygric_diffusion"] for m in drawn])
    assert values.min() == 1e-5 and values.max() < 0.3
    assert np.quantile(values, 0.975) == pytest.approx(1.96 * 0.06, rel=0.08)


def test_members_stay_within_bounds() -> None:
    fit = known_fit(30.0)
    bounds = {p.name: (p.lower, p.upper) for p in fit.design.model.parameters}
    for member in draw_members(fit, 200, 1):
        for name in FREE:
            assert bounds[name][0] <= member[name] <= bounds[name][1]


def test_an_ensemble_of_one_model_has_the_moments_of_the_filter_s_free_run() -> None:
    """The filter carries mean and variance forward without any random number; 600 members must scatter like
    that."""
    fit = known_fit()
    record, _ = driven(fit, short(20), None)
    members = [dict(fit.values)] * 600
    (year,) = simulate_years(fit, *course(fit, record), members, 11, Surface())
    _, run = course(fit, record)
    t = run.timeline.with_readings(np.full_like(run.timeline.y, np.nan))
    trace = Likelihood(fit.design.model, t).trace(fit.values)
    kept = kept_instants(t.time)
    states = list(fit.design.model.states)
    i = states.index("converter_temperature")
    ratio = fit.values["resistance_ratio"]
    mean = (ratio * trace.prior_mean[:, i] + (1 - ratio) * t.input("ambient_temperature"))[kept]
    sd = ratio * np.sqrt(trace.prior_covariance[:, i, i])[kept]
    late = slice(100, None)  # the ensemble was spun up, the filter starts from a wide prior
    z = (year.temperature_K.mean(axis=0) - mean)[late] / (sd[late] / np.sqrt(600))
    assert abs(z.mean()) < 0.6 and z.std() < 1.3
    assert np.mean(year.temperature_K.std(axis=0)[late] / sd[late]) == pytest.approx(1.0, abs=0.03)
    j = states.index("vapour")
    spread = np.sqrt(trace.prior_covariance[:, j, j])[kept][late]
    outside, inside = t.input("ambient_temperature")[kept], year.temperature_K
    vapour = (year.absolute_humidity_g_m3 * inside / outside).std(axis=0)[late]
    assert np.mean(vapour / spread) == pytest.approx(1.0, abs=0.04)


def test_the_disturbance_keeps_its_memory_from_hour_to_hour() -> None:
    """Under constant weather T − mean is an Ornstein–Uhlenbeck course through a lag: its autocovariance is
    known."""
    weather = short(40)
    flat = Record(
        "flat",
        tuple(
            replace(s, value=np.full(len(s), 10.0 if s.signal == "wind_speed" else 283.15))
            for s in weather.series
        ),
    )
    fit = known_fit(thermal_diffusion=1e-5)
    record, _ = driven(fit, flat, None)
    (year,) = simulate_years(fit, *course(fit, record), [dict(fit.values)] * 200, 5, Surface())
    error = year.temperature_K - year.temperature_K.mean()
    tau, theta, sd = 1.5, 8.0, 1.2
    variance = sd**2 * theta / (theta + tau)
    assert error.var() == pytest.approx(variance, rel=0.05)
    for lag in (1, 4, 12):
        found = np.mean(error[:, lag:] * error[:, :-lag])
        # convolution of the disturbance's autocovariance with the lag's response
        expected = (
            sd**2 * theta * (theta * np.exp(-lag / theta) - tau * np.exp(-lag / tau)) / (theta**2 - tau**2)
        )
        assert found == pytest.approx(expected, rel=0.08)


@pytest.mark.parametrize(
    "reads", ["cabinet_temperature", pytest.param("cabinet_relative_humidity", marks=pytest.mark.slow)]
)
def test_every_member_drives_its_own_heater(reads: str) -> None:
    """Without disturbances all members are the free run of the model; with them a heater holds each within
    its band."""
    start, full = (288.15, 285.15) if reads == "cabinet_temperature" else (0.6, 0.75)
    plain = known_fit()
    features = {"throttled_heating": {"reads": reads, "start": start, "full": full, "idle": True}}
    heated = extended(plain.design, (("unreported_heater", {}),), features=features)
    fit = Fit("heated", heated, dict(plain.values) | {"heater_heat": 20.0}, plain.results)
    record, _ = driven(fit, short(20), None)
    calm = record.replace_series(replace(record["active_power"], value=np.zeros(len(record["active_power"]))))
    (year,) = simulate_years(fit, *course(fit, calm), [dict(fit.values)] * 3, 1, Surface(), process=False)
    _, made = course(fit, calm)
    expected = free_run(fit.design, fit.values, made).temperature[0][kept_instants(made.timeline.time)]
    late = slice(48, None)
    assert np.ptp(year.temperature_K, axis=0).max() < 1e-9
    apart = (year.temperature_K[0] - expected)[late]
    assert abs(apart.mean()) < 0.05 and apart.std() < 0.2
    unheated = course(plain, calm)
    (bare,) = simulate_years(plain, *unheated, [dict(plain.values)] * 3, 1, Surface(), process=False)
    assert (
        bare.temperature_K[0][late].min() < 280.0
        and (year.temperature_K[0] - bare.temperature_K[0]).max() > 2.0
    )
    (noisy,) = simulate_years(fit, *course(fit, calm), [dict(fit.values)] * 8, 1, Surface())
    assert np.ptp(noisy.temperature_K, axis=0)[late].min() > 0.0
    if reads == "cabinet_temperature":
        assert noisy.temperature_K[:, late].min() > full - 1.5
    else:
        (damp,) = simulate_years(plain, *unheated, [dict(plain.values)] * 8, 1, Surface())
        hours = [np.mean(one.relative_humidity[:, late] > 0.8) for one in (noisy, damp)]
        assert hours[0] < 0.5 * hours[1]


def test_seeds_decide_and_process_can_be_left_out() -> None:
    fit = known_fit()
    record, _ = driven(fit, short(5), None)
    members = draw_members(fit, 5, 1)

    def run(seed: int, process: bool = True) -> np.ndarray:
        (year,) = simulate_years(fit, *course(fit, record), members, seed, Surface(), process)
        return year.temperature_K

    assert np.array_equal(run(1), run(1)) and not np.array_equal(run(1), run(2))
    assert np.array_equal(run(1, False), run(2, False))
    assert run(1, False).std(axis=0).mean() < 0.5 * run(1).std(axis=0).mean()


def test_drawn_errors_have_singular_covariances_too() -> None:
    random = np.random.default_rng(1)
    root = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 3.0]])
    covariance = root @ root.T  # rank 2, and
    covariance = np.block([[covariance, np.zeros((3, 1))], [np.zeros((1, 4))]])  # a state without noise
    errors = _drawn(np.repeat(covariance[None], 20000, axis=0), random.standard_normal((20000, 4)))
    assert np.cov(errors.T) == pytest.approx(covariance, abs=0.15)
    assert np.all(errors[:, 3] == 0.0) and np.abs(errors[:, 1] - 2 * errors[:, 0]).max() < 1e-3


def test_covariances_that_curvature_spoils_are_mended_and_endless_ones_told() -> None:
    """Rounding, or moments of a curved model: an eigenvalue a little below 0.  Not a number: said in
    words."""
    random = np.random.default_rng(2)
    spoiled = np.array([[1.0, 1.0 + 1e-7], [1.0 + 1e-7, 1.0]])
    batch = np.stack([spoiled, np.eye(2)])
    errors = np.array([_drawn(batch, random.standard_normal((2, 2))) for _ in range(20000)])
    assert np.cov(errors[:, 0].T) == pytest.approx(np.ones((2, 2)), abs=0.05)
    assert np.cov(errors[:, 1].T) == pytest.approx(np.eye(2), abs=0.05)
    with pytest.raises(ValueError, match="found others in 1 of 2 members"):
        _drawn(np.stack([np.eye(2), np.full((2, 2), np.nan)]), np.zeros((2, 2)))


def test_amounts_are_never_below_nothing() -> None:
    """Vapour under disturbances larger than the air's own humidity, and water in a material in very dry
    air."""
    base = known_fit(vapour_disturbance_sd=6.0)
    design = replace(base.design, mechanisms=(*base.design.mechanisms, ("moisture_sorption", {"slab": True})))
    values = {p.name: base.values.get(p.name, p.start) for p in design.model.parameters}
    fit = Fit(base.name, design, values | {"sorption_capacity": 60.0}, base.results)
    assert [n for n, yes in zip(design.model.states, design.model.amounts, strict=True) if yes] == [
        "vapour",
        "sorbed_water",
        "sorbed_skin",
    ]
    record, _ = driven(fit, short(15), None)
    (year,) = simulate_years(fit, *course(fit, record), [fit.values] * 20, 3, Surface())
    assert np.isfinite(year.relative_humidity).all() and year.relative_humidity.min() >= 0.0
    assert year.absolute_humidity_g_m3.max() < 60.0


def test_years_and_hours() -> None:
    assert kept_instants(np.arange(0, 5, 0.25)).tolist() == [0, 4, 8, 12, 16]
    assert kept_instants(np.array([0.0, 0.5, 1.5, 2.5, 3.0])).tolist() == [0, 2, 3]
    assert [len(g) for g in years_of(np.arange(17520.0))] == [8766, 8754]
    assert [len(g) for g in years_of(np.arange(10000.0))] == [8766]  # a rest of a month is no year
    assert [len(g) for g in years_of(np.arange(500.0))] == [500]


def test_a_surface_condenses_below_dew_and_frost_point() -> None:
    from hygrokf.physics.psychrometrics import dew_point, frost_point

    for pressure in (300.0, 900.0, 2500.0):
        point = dew_point(pressure) if pressure > 611.7 else frost_point(pressure)
        assert condenses(np.array(pressure), np.array(point - 0.01))
        assert not condenses(np.array(pressure), np.array(point + 0.01))
    assert Surface(0.3, -1.0).temperature(np.array(280.0), np.array(290.0)) == pytest.approx(282.0)


def test_gaps_of_the_weather_are_left_out() -> None:
    weather = short(30)
    holed = weather["ambient_temperature"].value.copy()
    holed[200:260] = np.nan
    gap = weather.replace_series(replace(weather["ambient_temperature"], value=holed))
    fit = known_fit()
    record, _ = driven(fit, gap, None)
    (year,) = simulate_years(fit, *course(fit, record), draw_members(fit, 3, 1), 1, Surface())
    unknown = ~year.known
    hours = (year.time_s - weather.start_s) / HOUR_S
    assert 60 <= unknown.sum() <= 80 and hours[unknown].min() >= 199 and hours[unknown].max() <= 275
