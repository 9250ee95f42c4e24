"""The figures: what they show, what they say, how large they get, and what they make of missing data."""

from __future__ import annotations

import contextlib
import copy
import re
from collections.abc import Callable
from xml.etree import ElementTree

import numpy as np
import pytest
from builders.report_case import REFERENCE_K, RELEASE, TAU_H, report_case, results

from hygrokf.data.structured import plain
from hygrokf.report.figures.course_panels import (
    figure_excerpts,
    figure_humidity,
    figure_residuals,
    figure_temperature,
)
from hygrokf.report.figures.drawing import NothingToShow, inline_svg, svg
from hygrokf.report.figures.fit_figures import (
    FIGURES,
    figure_heat_release,
    figure_innovations,
    figure_of,
    figure_profiles,
)
from hygrokf.texts.fit_codes import FitCode

LIMIT = 300_000


def _words(figure) -> str:
    return " ".join(ElementTree.fromstring(svg(figure, "x")).itertext())


def _lines(axes) -> list[tuple[np.ndarray, np.ndarray]]:
    return [
        (np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float))
        for line in axes.get_lines()
    ]


@pytest.mark.parametrize("picture", FIGURES)
def test_every_figure_is_drawn_small_well_formed_and_captioned(picture) -> None:
    fit, series = report_case()
    before = copy.deepcopy(fit), {name: value.copy() for name, value in series.items()}
    text = inline_svg(figure_of(picture, results(fit), series).draw().figure(), picture, FIGURES[picture][0])
    ElementTree.fromstring(text)
    assert 5_000 < len(text.encode()) < LIMIT
    assert FIGURES[picture][1].endswith(".") and 40 < len(FIGURES[picture][1]) < 260
    assert before[0] == fit and all(np.array_equal(before[1][n], series[n], equal_nan=True) for n in series)


@pytest.mark.parametrize("picture", FIGURES)
def test_a_year_of_two_minute_readings_stays_small(picture) -> None:
    fit, series = report_case()
    n, m = 260_000, len(series["time_s"])
    place = np.linspace(0, m - 1, n).astype(int)
    random = np.random.default_rng(1)
    long = {name: value[place] if value.shape == (m,) else value for name, value in series.items()}
    long["time_s"] = series["time_s"][0] + 120.0 * np.arange(n)
    long["until_s"] = np.array(long["time_s"][200_000])
    for name in ("temperature_measured", "absolute_humidity_measured"):
        long[name] = np.where(
            random.random(n) < 0.05, np.nan, np.nan_to_num(long[name], nan=290.0) + random.normal(size=n)
        )
    for name in ("temperature_innovation", "humidity_innovation"):
        long[name] = random.normal(size=n)
    long["scored"] = (random.random(n) > 0.001).astype(float)
    drawn = figure_of(picture, results(fit), long).draw().figure()
    assert len(inline_svg(drawn, picture, FIGURES[picture][0]).encode()) < LIMIT


def test_the_whole_series_shows_every_extreme_in_its_unit() -> None:
    fit, series = report_case()
    figure = figure_temperature(results(fit), series).figure()
    main, error, power = figure.get_axes()
    drawn = np.concatenate([y for _, y in _lines(main)])
    for name in ("temperature_measured", "temperature_simulated", "ambient_temperature"):
        assert np.nanmin(np.abs(drawn - (np.nanmax(series[name]) - 273.15))) < 1e-9
        assert np.nanmin(np.abs(drawn - (np.nanmin(series[name]) - 273.15))) < 1e-9
    assert main.get_ylabel() == "temperature [°C]"
    difference = series["temperature_simulated"] - series["temperature_measured"]
    assert np.nanmax(np.concatenate([y for _, y in _lines(error)])) == pytest.approx(np.nanmax(difference))
    assert np.nanmax(np.concatenate([y for _, y in _lines(power)])) >= np.nanmax(series["power"])
    assert main.get_xlim() == pytest.approx((series["time_s"][0] / 86400, series["time_s"][-1] / 86400))
    words = _words(figure)
    for word in ("readings", "simulated", "95 % band", "ambient", "validation", "pre-heating", "UTC"):
        assert word in words


def test_humidity_is_drawn_in_grams() -> None:
    fit, series = report_case()
    main = figure_humidity(results(fit), series).figure().get_axes()[0]
    assert main.get_ylabel() == "absolute humidity [g/m³]"
    drawn = np.concatenate([y for _, y in _lines(main)])
    assert np.nanmin(np.abs(drawn - np.nanmax(series["absolute_humidity_measured"]))) < 1e-9


def test_excerpts_show_three_stretches_of_both_quantities_and_the_power() -> None:
    fit, series = report_case()
    figure = figure_excerpts(results(fit), series).figure()
    assert len(figure.get_axes()) == 9
    words = _words(figure)
    assert all(word in words for word in ("(a)", "(b)", "(c)"))


def test_without_power_there_is_no_power_axis() -> None:
    fit, series = report_case()
    series["power"] = np.zeros_like(series["power"])
    series["operating"] = np.zeros_like(series["operating"])
    assert len(figure_temperature(results(fit), series).figure().get_axes()) == 2
    assert "power" not in _words(figure_residuals(results(fit), series).figure())
    assert len(figure_excerpts(results(fit), series).figure().get_axes()) == 6


def test_heat_release_draws_regression_and_estimate_at_round_temperatures() -> None:
    fit, series = report_case()
    figure = figure_heat_release(results(fit), series).figure()
    operation = figure.get_axes()[0]
    found = fit["heat_release"]["operation"]["coefficients"]
    degrees = [int(t.get_text().removesuffix(" °C")) for t in operation.texts if t.get_text().endswith("°C")]
    assert 1 <= len(degrees) <= 3
    drawn = [line for line in _lines(operation) if len(line[0]) == 60]
    for one in degrees:
        warmer = one + 273.15 - REFERENCE_K
        for values in (found, RELEASE):
            wanted = (
                values["heat_release_operation"]
                + values["heat_release_operation_ambient"] * warmer
                + values["heat_release_power_1"] * drawn[0][0]
            )
            assert any(np.allclose(y, wanted) for _, y in drawn)
    words = _words(figure)
    assert "operation: " in words and "standstill: " in words


def test_one_regime_is_enough_for_a_heat_release_figure() -> None:
    fit, series = report_case()
    fit["heat_release"]["operation"] = None
    assert "operation: " not in _words(figure_heat_release(results(fit), series).figure())
    fit["heat_release"]["standstill"] = None
    too_few = FitCode.TOO_FEW_PERIODS(
        regime="operation", periods=3, window_h=2.0, episodes=2, hours=40.0, fewest_periods=8,
        fewest_episodes=5,
    )  # fmt: skip
    fit["heat_release"]["statements"] = plain((too_few,))
    with pytest.raises(NothingToShow, match="operation: 3 quasi-stationary periods"):
        figure_heat_release(results(fit), series).figure()


def test_profiles_show_bounds_threshold_and_simulation() -> None:
    fit, series = report_case()
    figure = figure_profiles(results(fit), series).figure()
    thermal, hygric = figure.get_axes()
    for axes, name in ((thermal, "thermal"), (hygric, "hygric")):
        found = fit["time_constants"][name]
        low, high = axes.get_xlim()
        for value in (found["lower_h"], found["upper_h"], *found["simulation"].values()):
            assert low < value < high
        assert axes.get_ylim()[1] > found["threshold"]
        curve = max(_lines(axes), key=lambda line: len(line[0]))
        # the curve passes through the points that were computed
        for x, y in found["curve"]:
            assert np.interp(x, *curve) == pytest.approx(y, abs=0.02 * found["threshold"])
    words = _words(figure)
    assert f"{TAU_H:.3g} h" in words and "widened × 1.30" in words and "by simulation" in words


@pytest.mark.parametrize(
    "change",
    [
        {"upper_h": None},
        {"lower_h": 0.0, "upper_h": None},
        {"lower_h": 0.0},
        {"curve": []},
        {"curve": [], "threshold": None, "factor": None, "level": None, "simulation": None},
        {"simulation": {"value_h": 300.0, "lower_h": 1e-20, "upper_h": 1e20}},
        {"simulation": {"value_h": 1.3, "lower_h": None, "upper_h": None}},
        {"curve": [[0.01, 2.0], [1.45, 0.0], [1e4, 3.0]]},
        {"curve": [[1.45, 0.0], [1.0, None], [None, 2.0]]},
    ],
)
def test_open_bounds_and_short_curves_are_drawn(change: dict) -> None:
    fit, series = report_case()
    fit["time_constants"]["thermal"] |= change
    assert "thermal time constant" in _words(figure_profiles(results(fit), series).figure())


def test_residual_medians_are_those_of_the_data() -> None:
    fit, series = report_case()
    series["scored"] = np.ones_like(series["scored"])
    series["until_s"] = np.array(np.nan)
    hour = (series["time_s"] / 3600.0) % 24.0
    error = series["temperature_simulated"] - series["temperature_measured"]
    axes = figure_residuals(results(fit), series).figure().get_axes()[2]
    medians = [np.nanmedian(error[(hour >= a) & (hour < a + 2)]) for a in range(0, 24, 2)]
    drawn = np.concatenate([y for _, y in _lines(axes)])
    for value in medians:
        assert np.nanmin(np.abs(drawn - value)) < 1e-9


def test_innovations_of_each_output_with_every_input() -> None:
    fit, series = report_case()
    words = _words(figure_innovations(results(fit), series, "humidity").figure())
    for word in ("Autocorrelation", "Periodogram", "ambient absolute humidity", "Quantiles"):
        assert word in words
    fit["innovations"]["outputs"]["humidity"]["cross_correlation"] = {"power": {"statement": "does not vary"}}
    assert "no cross-correlation" in " ".join(
        _words(figure_innovations(results(fit), series, "humidity").figure()).split()
    )


def test_what_goes_beyond_the_limits_is_red() -> None:
    from hygrokf.report.figures.drawing import SIMULATED_COLOUR

    fit, series = report_case()
    data = fit["innovations"]["outputs"]["temperature"]["autocorrelation"]

    def red() -> int:
        axes = figure_innovations(results(fit), series).figure().get_axes()[0]
        return sum(len(line.get_xdata()) for line in axes.get_lines() if line.get_color() == SIMULATED_COLOUR)

    data["value"] = [0.0] * len(data["value"])
    assert red() == 0
    data["value"][5] = 1.5 * data["limit_all"]
    assert red() == 3


# --- missing data ------------------------------------------------------------------------------


def _without(name: str) -> Callable[[dict, dict], None]:
    def spoil(fit: dict, series: dict) -> None:
        for key in list(series):
            if key.startswith(name):
                series[key] = np.full_like(series[key], np.nan)

    return spoil


def test_missing_quantities_are_named() -> None:
    fit, series = report_case()
    _without("absolute_humidity")(fit, series)
    with pytest.raises(NothingToShow, match="no cabinet humidity"):
        figure_humidity(results(fit), series).figure()
    assert len(figure_excerpts(results(fit), series).figure().get_axes()) == 6
    _without("temperature")(fit, series)
    for draw in (figure_temperature, figure_excerpts, figure_residuals, figure_innovations):
        with pytest.raises(NothingToShow):
            draw(results(fit), series).figure()


@pytest.mark.parametrize("picture", FIGURES)
@pytest.mark.parametrize("n", [0, 1, 2])
def test_records_of_few_instants(picture, n: int) -> None:
    fit, series = report_case()
    m = len(series["time_s"])
    short = {name: value[:n] if value.shape == (m,) else value for name, value in series.items()}
    try:
        inline_svg(figure_of(picture, results(fit), short).draw().figure(), picture, "t")
    except NothingToShow as why:
        assert str(why).endswith((".", ")"))


@pytest.mark.parametrize("picture", FIGURES)
def test_an_empty_fit_and_empty_series_say_why(picture) -> None:
    for fit, series in (
        ({}, {}),
        ({"heat_release": None, "time_constants": {}}, {"time_s": np.empty(0)}),
    ):
        with pytest.raises(NothingToShow) as why:
            figure_of(picture, results(fit), series).draw()
        assert re.match(r"[A-Zs].*\.$", str(why.value))


def _wild(picture, changes: dict[str, int]) -> None:
    fit, series = report_case()
    m = len(series["time_s"])
    small = {name: value[::7] if value.shape == (m,) else value for name, value in series.items()}
    n = len(small["time_s"])
    for name, kind in changes.items():
        if kind == 0:
            del small[name]
        else:
            small[name] = (np.full(n, np.nan), np.full(n, np.inf), np.zeros(3), np.zeros(n))[kind - 1]
    with contextlib.suppress(NothingToShow):
        figure_of(picture, results(fit), small).draw().figure()


@pytest.mark.parametrize("picture", FIGURES)
@pytest.mark.parametrize("seed", range(2))
def test_several_series_may_be_missing_or_wild(picture, seed: int) -> None:
    random = np.random.default_rng(seed)
    names = [name for name in report_case()[1] if name != "time_s" and random.random() < 0.3]
    _wild(picture, {name: int(random.integers(5)) for name in names})


@pytest.mark.slow
@pytest.mark.parametrize("picture", FIGURES)
def test_any_series_may_be_missing_or_wild(picture) -> None:
    for name in report_case()[1]:
        for kind in range(5):
            _wild(picture, {name: kind})


def test_text_of_users_is_text() -> None:
    """A dollar sign is no formula, an angle bracket no tag."""
    fit, series = report_case()
    crossed = fit["innovations"]["outputs"]["temperature"]["cross_correlation"]
    crossed["<script>$x_{$"] = crossed.pop("power")
    assert "<script>$x {$" in _words(figure_innovations(results(fit), series).figure())
