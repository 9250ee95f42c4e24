"""The diagnosis against statsmodels, scipy and direct sums; its false alarms and its power by simulation."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hygrokf.data.structured import plain, structured
from hygrokf.evaluation.innovation_tests import (
    FEWEST_DIAGNOSED,
    MOST_POINTS,
    Diagnosis,
    InnovationTest,
    diagnose,
    whitened,
)
from hygrokf.texts.fit_codes import FitCode

STEP_H = 0.25
N = 1500


def _time(n: int = N) -> np.ndarray:
    return STEP_H * np.arange(n)


def _white(seed: int, n: int = N) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


def _autoregressive(random: np.random.Generator, n: int, gain: float) -> np.ndarray:
    values, state = [], 0.0
    for kick in random.standard_normal(n):
        state = gain * state + kick
        values.append(state)
    return np.array(values)


def _of(e: np.ndarray, **inputs: np.ndarray) -> dict:
    return diagnose(_time(len(e)), {"temperature": e}, inputs)


def _named(row: InnovationTest) -> str:
    return (
        row.test
        + (f" with {row.input}" if row.input else "")
        + (f" {row.lag_h:g} h" if row.lag_h > 0 else "")
    )


def _rejected(found: Diagnosis) -> set[str]:
    return {_named(row) for row in found.tests if row.rejected}


# --- numbers -----------------------------------------------------------------------------------


def test_moments_are_scipys() -> None:
    e = stats.t(df=6).rvs(N, random_state=1) + 0.1
    one = _of(e).outputs["temperature"]
    assert one.n == N
    assert one.mean == pytest.approx(np.mean(e), rel=1e-12)
    assert one.variance == pytest.approx(np.var(e), rel=1e-12)
    assert one.excess_kurtosis == pytest.approx(stats.kurtosis(e), rel=1e-9)
    assert one.beyond_3 == np.mean(np.abs(e) > 3)


def test_tests_of_moments_have_the_usual_p() -> None:
    e = 1.02 * _white(2) + 0.03
    p = {row.test: row.p for row in _of(e).tests}
    assert p["normality"] == pytest.approx(stats.jarque_bera(e).pvalue, rel=1e-12)
    s2 = np.var(e)
    assert p["mean"] == pytest.approx(2 * stats.norm.sf(abs(e.mean()) / np.sqrt(s2 / N)), rel=1e-9)
    fourth = np.mean((e - e.mean()) ** 4)
    z = (s2 - 1.0) / np.sqrt((fourth - s2**2) / N)
    assert p["variance"] == pytest.approx(2 * stats.norm.sf(abs(z)), rel=1e-9)


def test_autocorrelation_is_the_direct_sum_and_ljung_box_is_statsmodels() -> None:
    from statsmodels.stats.diagnostic import acorr_ljungbox

    e = _autoregressive(np.random.default_rng(3), N, 0.1)
    found = _of(e)
    one = found.outputs["temperature"]
    c = e - e.mean()
    direct = [np.sum(c[k:] * c[:-k]) / np.sum(c * c) for k in range(1, 97)]
    np.testing.assert_allclose(one.autocorrelation.value, direct, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(one.autocorrelation.lag_h, STEP_H * np.arange(1, 97))
    p = {row.lag_h: row.p for row in found.tests if row.test == "autocorrelation"}
    assert list(p) == [24.0, 1.0]
    known = acorr_ljungbox(e, lags=[4, 96])["lb_pvalue"]
    np.testing.assert_allclose([p[1.0], p[24.0]], known, rtol=1e-6)


def test_limits_of_the_autocorrelation() -> None:
    data = _of(_white(4)).outputs["temperature"].autocorrelation
    assert data.limit == pytest.approx(stats.norm.isf(0.025) / np.sqrt(N), rel=1e-9)
    assert data.limit_all == pytest.approx(stats.norm.isf((1 - 0.95 ** (1 / 96)) / 2) / np.sqrt(N), rel=1e-9)


@pytest.mark.parametrize("n", [400, 401])
def test_cumulative_periodogram_is_kolmogorov_smirnovs_test(n: int) -> None:
    e = _white(5, n)
    data = _of(e).outputs["temperature"].cumulative_periodogram
    t = np.arange(n)
    c = e - e.mean()
    power = np.array([abs(np.sum(c * np.exp(-2j * np.pi * j * t / n))) ** 2 for j in range(1, (n + 1) // 2)])
    steps = np.cumsum(power) / power.sum()
    known = stats.kstest(steps[:-1], "uniform")
    assert data.statistic == pytest.approx(known.statistic, rel=1e-9)
    assert data.p == pytest.approx(known.pvalue, rel=1e-6)
    np.testing.assert_allclose(data.value, steps, rtol=1e-5)
    np.testing.assert_allclose(data.frequency_per_h, np.arange(1, len(steps) + 1) / (n * STEP_H), rtol=1e-5)
    assert stats.kstwo(len(steps) - 1).sf(data.limit) == pytest.approx(0.05, rel=1e-6)


def test_periodogram_keeps_a_pure_tone_in_its_band_and_white_noise_within_limits() -> None:
    n = 4096
    tone = np.sqrt(2.0) * np.cos(2 * np.pi * np.arange(n) * 64 / n)
    data = _of(0.1 * _white(6, n) + tone).outputs["temperature"].periodogram
    peak = int(np.argmax(data.power))
    assert 1.0 / data.frequency_per_h[peak] == pytest.approx(16.0, rel=0.06)
    inside = []
    for seed in range(20):
        data = _of(_white(100 + seed, n)).outputs["temperature"].periodogram
        power, low, high = (np.array(getattr(data, name)) for name in ("power", "lower", "upper"))
        inside.append(np.mean((power >= low) & (power <= high)))
    # about 95 bands in each of 20 records: the share is binomial with a standard deviation of 0.5 %
    assert 0.93 < np.mean(inside) < 0.97


def test_daily_cycle_is_the_f_test_of_least_squares() -> None:
    from statsmodels.regression.linear_model import OLS

    e = _white(7) + 0.2 * np.cos(2 * np.pi * (_time() - 5.0) / 24.0)
    found = _of(e)
    (p,) = (row.p for row in found.tests if row.test == "daily cycle")
    angle = 2 * np.pi * _time() / 24.0
    fit = OLS(e, np.column_stack([np.ones(N), np.cos(angle), np.sin(angle)])).fit()
    assert p == pytest.approx(fit.f_pvalue, rel=1e-6)
    size, share = np.hypot(*fit.params[1:]), 100 * fit.rsquared
    (told,) = (one for one in found.statements if one.code is FitCode.DAILY_CYCLE)
    assert told.values["p"] < 0.001
    assert told.values["amplitude"] == pytest.approx(size, abs=0.005)
    assert 100 * told.values["explained"] == pytest.approx(share, abs=0.05)


def test_whitening_is_yule_walkers_prediction_error() -> None:
    from scipy.linalg import solve_toeplitz

    values = 280.0 + _autoregressive(np.random.default_rng(8), N, 0.9)
    error, order = whitened(values)
    c = values - values.mean()
    covariance = np.array([np.sum(c[k:] * c[: N - k]) / N for k in range(order + 1)])
    rho = solve_toeplitz(covariance[:-1], covariance[1:])
    direct = [c[k] - sum(rho[j] * c[k - 1 - j] for j in range(order)) for k in range(order, N)]
    assert order >= 1
    np.testing.assert_allclose(error[order:], direct, rtol=1e-8, atol=1e-9)
    assert np.isnan(error[:order]).all()


def test_whitening_spreads_an_unknown_input_no_further_than_its_order() -> None:
    values = _autoregressive(np.random.default_rng(9), N, 0.7)
    values[500] = np.nan
    error, order = whitened(values)
    assert np.isnan(error[500 : 501 + order]).all()
    assert np.isfinite(error[order:500]).all() and np.isfinite(error[501 + order :]).all()


def test_cross_correlation_is_the_direct_sum_and_finds_the_lag() -> None:
    u = _autoregressive(np.random.default_rng(10), N, 0.8)
    kicks = np.append(0.0, u[1:] - 0.8 * u[:-1])
    e = _white(11) + 0.3 * np.roll(kicks, 8)  # the innovation comes 2 h after the input
    found = _of(e, ambient_temperature=u)
    data = found.outputs["temperature"].cross_correlation["ambient_temperature"]
    w, _ = whitened(u)
    w = np.where(np.isfinite(w), w - np.nanmean(w), 0.0)
    c = e - e.mean()
    scale = np.sqrt(np.sum(c * c) * np.sum(w * w))
    lags = np.round(np.array(data.lag_h) / STEP_H).astype(int)
    assert lags[0] == -96 and lags[-1] == 96 and len(lags) == 193
    direct = [np.sum(c[max(k, 0) : N + min(k, 0)] * w[max(-k, 0) : N - max(k, 0)]) / scale for k in lags]
    np.testing.assert_allclose(data.value, direct, rtol=1e-4, atol=1e-7)
    largest = max(data.value)
    assert largest == pytest.approx(0.29, abs=0.06) and data.lag_h[data.value.index(largest)] == 2.0
    (told,) = (one.values for one in found.statements if one.code is FitCode.CORRELATED_WITH_INPUT)
    assert (told["input"], told["lag_h"], told["remarks"]) == ("ambient_temperature", 2.0, ())
    assert told["size"].values["r"] == pytest.approx(largest, rel=1e-5)
    assert next(row.p_adjusted for row in found.tests if row.input) < 1e-6


def test_a_reading_that_moves_before_its_input_casts_doubt_on_the_clocks() -> None:
    u = _white(12)
    found = _of(_white(13) + 0.4 * np.roll(u, -4), power=u)
    (told,) = (one.values for one in found.statements if one.values.get("input") == "power")
    assert told["lag_h"] == -1.0 and told["remarks"] == (FitCode.READINGS_LEAD(input="power"),)


def test_adjusted_p_is_holms() -> None:
    from statsmodels.stats.multitest import multipletests

    rows = diagnose(
        _time(), {"temperature": _white(14) + 0.05, "humidity": 1.1 * _white(15)}, {"power": _white(16)}
    ).tests
    reject, adjusted, *_ = multipletests([row.p for row in rows], alpha=0.05, method="holm")
    np.testing.assert_allclose([row.p_adjusted for row in rows], adjusted, rtol=1e-12)
    assert [row.rejected for row in rows] == list(reject)
    assert 0 < sum(reject) < len(rows)


# --- false alarms and power --------------------------------------------------------------------


def test_white_innovations_raise_no_more_alarms_than_the_level() -> None:
    """150 records of white noise, two outputs, three inputs: alarms within the binomial band of 5 %."""
    runs, n = 150, 1000
    alarms, single = 0, {}
    for seed in range(runs):
        random = np.random.default_rng(1000 + seed)
        inputs = {
            "ambient_temperature": _autoregressive(random, n, 0.98),
            "power": np.abs(_autoregressive(random, n, 0.9)),
            "preheating": (np.arange(n) % 200 < 12).astype(float),
        }
        e = {name: random.standard_normal(n) for name in ("temperature", "humidity")}
        found = diagnose(_time(n), e, inputs)
        alarms += any(row.rejected for row in found.tests)
        for row in found.tests:
            single.setdefault(_named(row), []).append(row.p < 0.05)
    assert alarms <= stats.binom(runs, 0.05).ppf(0.999), alarms
    assert alarms >= 1
    for name, hits in single.items():
        count, total = sum(hits), len(hits)
        assert count <= stats.binom(total, 0.05).ppf(0.9995), (name, count, total)
        # the correlations are conservative by design (the smaller of two statistics counts), and ten
        # switchings of the pre-heating can never be enough
        if not name.startswith("correlation"):
            assert count >= stats.binom(total, 0.05).ppf(0.0005), (name, count, total)
        elif not name.endswith("preheating"):
            assert count >= 1, name


def test_heavy_tails_and_a_rarely_switched_input_raise_no_false_correlation() -> None:
    """Two switchings and innovations with outliers: a limit by 1/√n alone would cry wolf in every third
    record."""
    runs, n, alarms, naive = 100, 600, 0, 0
    for seed in range(runs):
        random = np.random.default_rng(5000 + seed)
        e = random.standard_t(3, n) / np.sqrt(3.0)
        u = ((np.arange(n) > 200) & (np.arange(n) < 300)).astype(float)
        found = diagnose(_time(n), {"temperature": e}, {"preheating": u})
        data = found.outputs["temperature"].cross_correlation["preheating"]
        alarms += data.p < 0.05
        naive += max(np.abs(data.value)) > data.limit_all
    assert alarms <= stats.binom(runs, 0.05).ppf(0.999)
    assert naive > 2 * stats.binom(runs, 0.05).ppf(0.999)


@pytest.mark.parametrize(
    ("spoil", "test"),
    [
        (lambda e: e + 0.2, "mean"),
        (lambda e: 1.2 * e, "variance"),
        (lambda e: np.sign(e) * np.abs(e) ** 1.5, "normality"),
        (lambda e: e + 0.3 * np.roll(e, 1), "autocorrelation 1 h"),
        (lambda e: e + 0.3 * np.roll(e, 60), "autocorrelation 24 h"),
        (lambda e: e + 0.5 * np.roll(e, 1), "cumulative periodogram"),
        (lambda e: e + 0.3 * np.sin(2 * np.pi * _time() / 24), "daily cycle"),
    ],
)
def test_each_departure_is_found_and_reported(spoil, test: str) -> None:
    found = _of(spoil(_white(17)))
    assert test in _rejected(found)
    assert found.statements and {one.values["output"] for one in found.statements} == {"temperature"}


def test_white_innovations_are_called_so() -> None:
    found = _of(_white(18), power=_white(19))
    assert found.statements == (FitCode.WHITE(output="temperature", tests=8),)


# --- form --------------------------------------------------------------------------------------


def test_the_result_is_plain_json() -> None:
    e = {"temperature": _white(20), "humidity": np.full(N, np.nan), "other": np.ones(N)}
    u = {"power": np.zeros(N), "rain": np.where(np.arange(N) == 700, 1.0, 0.0), "unknown": np.full(N, np.nan)}
    found = diagnose(_time(), e, u)
    data = json.loads(json.dumps(plain(found), allow_nan=False))
    assert plain(structured(Diagnosis, data)) == data
    assert found.outputs["temperature"].cross_correlation.keys() <= {"rain"}
    assert found.outputs["humidity"].remark == FitCode.TOO_FEW_INNOVATIONS(output="humidity", n=0, fewest=30)
    assert found.outputs["other"].remark == FitCode.CONSTANT_INNOVATIONS(output="other")


@pytest.mark.parametrize("n", [0, 1, 2, FEWEST_DIAGNOSED - 1])
def test_few_readings_give_a_statement_and_no_test(n: int) -> None:
    e = np.full(200, np.nan)
    e[:n] = _white(21, n)
    found = diagnose(_time(200), {"humidity": e}, {"power": _white(22, 200)})
    assert found.tests == ()
    assert found.statements == (FitCode.TOO_FEW_INNOVATIONS(output="humidity", n=n, fewest=30),)


def test_infinite_innovations_count_as_missing() -> None:
    e = _white(23)
    e[[3, 77]] = np.inf, -np.inf
    assert _of(e).outputs["temperature"].n == N - 2


def test_a_gap_counts_as_one_step() -> None:
    e, u = _white(24), _autoregressive(np.random.default_rng(25), N, 0.5)
    time = _time()
    late = time + np.where(time > 100.0, 50.0, 0.0)
    a, b = (diagnose(one, {"temperature": e}, {"power": u}) for one in (time, late))
    assert a.outputs == b.outputs
    # at the readings' own times the daily cycle is another
    assert {one.test for one, other in zip(a.tests, b.tests, strict=True) if one.p != other.p} == {
        "daily cycle"
    }


def test_instants_without_a_reading_change_nothing() -> None:
    e, u = _white(26), _white(27)
    time = np.arange(2 * N) * 0.125
    wide = {name: np.full(2 * N, np.nan) for name in ("e", "u")}
    wide["e"][::2], wide["u"][::2] = e, u
    wide["u"][1::2] = 1e3
    a = diagnose(_time(), {"temperature": e}, {"power": u})
    b = diagnose(time, {"temperature": wide["e"]}, {"power": wide["u"]})
    assert a == b


def test_a_minute_logger_gives_short_lists_that_keep_the_extremes() -> None:
    n = 15000
    u = _white(28, n)
    e = _white(29, n) + 0.2 * np.roll(u, 777)
    found = diagnose(np.arange(n) / 60.0, {"temperature": e}, {"power": u})
    one = found.outputs["temperature"]
    crossed = one.cross_correlation["power"]
    assert one.lags == 1440
    lists = [
        values
        for part in (one.autocorrelation, one.cumulative_periodogram, one.periodogram, crossed)
        for values in vars(part).values()
        if isinstance(values, tuple)
    ]
    assert lists and all(len(v) <= MOST_POINTS for v in lists)
    assert crossed.lag_h[int(np.argmax(crossed.value))] == pytest.approx(777 / 60.0, rel=1e-5)
    assert list(crossed.lag_h) == sorted(crossed.lag_h)


@settings(max_examples=10)
@given(scale=st.floats(1e-3, 1e3), shift=st.floats(-1e3, 1e3), seed=st.integers(0, 1000))
def test_an_inputs_unit_does_not_matter(scale: float, shift: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    e, u = random.standard_normal(300), _autoregressive(random, 300, 0.6)
    a = _of(e, power=u).outputs["temperature"].cross_correlation["power"]
    b = _of(e, power=scale * u + shift).outputs["temperature"].cross_correlation["power"]
    np.testing.assert_allclose(a.value, b.value, atol=1e-4)
    assert a.p == pytest.approx(b.p, abs=1e-6)


def test_a_longest_lag_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="longest_h: expected a number of hours above 0"):
        diagnose(_time(), {"temperature": _white(30)}, {}, longest_h=-1.0)
