"""Numbers of a year: counts by hand, published examples, laws with known ratios, bounds by simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders.climate_case import study_of
from builders.documents import document

from hygrokf.climate import statistics
from hygrokf.climate.bounds import bounded, bounded_array, held
from hygrokf.climate.chamber import Acceleration
from hygrokf.climate.climate_profile import TEMPERATURE_EDGES, reduced
from hygrokf.climate.ensemble import Year
from hygrokf.climate.limits import ClimateLimit, exceeded, judge_limit
from hygrokf.climate.statistics import (
    STATISTICS,
    excursions,
    outside,
    rainflow,
    scalars,
    turning_points,
    wetness_class,
)
from hygrokf.report import climate_tables

LAW = Acceleration()


def year_of(celsius: np.ndarray, percent: np.ndarray, known: np.ndarray | None = None) -> Year:
    """A year from courses (T,) or (N, T)."""
    celsius, percent = np.atleast_2d(celsius), np.atleast_2d(percent)
    count = celsius.shape[1]
    dry = {
        "temperature_K": celsius[0] + 270.0,
        "relative_humidity": percent[0] / 100,
        "absolute_humidity_g_m3": percent[0],
    }
    return Year(
        3600.0 * np.arange(count), celsius + 273.15, percent / 100.0, 0.1 * percent, percent > 99.0,
        np.arange(count) % 2 == 0, np.ones(count, bool) if known is None else known, dry, 1.0,
    )  # fmt: skip


def test_rainflow_of_the_standard_s_example() -> None:
    """ASTM E1049-85, figure 6: peaks −2, 1, −3, 5, −1, 3, −4, 4, −2."""
    ranges, counts = rainflow(np.array([-2, 1, -3, 5, -1, 3, -4, 4, -2], float))
    table = {r: counts[ranges == r].sum() for r in np.unique(ranges)}
    assert table == {3.0: 0.5, 4.0: 1.5, 6.0: 0.5, 8.0: 1.0, 9.0: 0.5}


def test_rainflow_of_plain_courses() -> None:
    assert rainflow(np.full(9, 3.0))[0].size == 0 and rainflow(np.array([]))[0].size == 0
    ranges, counts = rainflow(np.array([0.0, 5.0]))
    assert (ranges.tolist(), counts.tolist()) == ([5.0], [0.5])
    # a hundred days of the same swing are a hundred cycles, whatever stands between the turning points
    hours = np.arange(2401)
    ranges, counts = rainflow(10 * np.sin(2 * np.pi * hours / 24))
    assert counts[ranges > 19.9].sum() == pytest.approx(100, abs=1)
    assert turning_points(np.array([1.0, 1.0, 2.0, 2.0, 1.0])).tolist() == [1.0, 2.0, 1.0]


def test_the_number_that_the_page_adds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of docs/how_to/climate.md, put into the module as the page says."""
    page = document("climate.md").read_text(encoding="utf-8")
    _, _, text = page.partition("## Adding a number")
    function, row = text.split("```text\n")[1].split("```")[0].split("\n\n\n")
    space = dict(vars(statistics))
    exec(function, space)
    added = (*STATISTICS, *eval(f"({row})", space))
    for module in (statistics, climate_tables):
        monkeypatch.setattr(module, "STATISTICS", added)
    percent = np.full(8766, 50.0)
    percent[:40], percent[100:103] = 15.0, 20.0
    year = year_of(np.full(8766, 20.0), percent)
    assert scalars(year, LAW)["dry_h"][0] == 40.0
    assert scalars(year, LAW, "operation")["dry_h"][0] == 20.0
    without = replace(year, relative_humidity=None, absolute_humidity_g_m3=None)
    assert "dry_h" not in scalars(without, LAW)
    (region,) = study_of().regions
    rows = climate_tables.year_table(region).rows
    assert "dry_h" in region.year and "air below 20 % relative humidity" in [row[0] for row in rows]


def test_hours_are_counted() -> None:
    percent = np.full(8766, 50.0)
    celsius = np.full(8766, 20.0)
    percent[100:150] = 85.0
    percent[300:310] = 101.0
    celsius[300:305] = -5.0  # wet, but frozen: no time of wetness by ISO 9223
    found = scalars(year_of(celsius, percent), LAW)
    assert (
        found["wetness_h"][0] == 55.0
        and found["saturation_h"][0] == 10.0
        and found["condensation_h"][0] == 10.0
    )
    assert found["humidity_above_80_h"][0] == 60.0 and found["humidity_above_80_number"][0] == 2.0
    assert (
        found["humidity_above_80_longest_h"][0] == 50.0
        and found["humidity_above_80_mean_length_h"][0] == 30.0
    )
    assert found["temperature_below_0_h"][0] == 5.0
    assert found["relative_humidity_rate_largest_percent_per_h"][0] == 51.0
    operation, still = (scalars(year_of(celsius, percent), LAW, s) for s in ("operation", "standstill"))
    assert operation["wetness_h"][0] + still["wetness_h"][0] == 55.0
    assert operation["hours"][0] == still["hours"][0] == 4383.0


def test_every_statistic_of_the_table_is_computed() -> None:
    """In its order, those of the whole year for the scope "all" alone, and those that a dry model has."""
    year = year_of(np.full(48, 20.0), np.full(48, 50.0))
    assert list(scalars(year, LAW)) == [one.name for one in STATISTICS]
    wanted = [one.name for one in STATISTICS if one.table == "scope"]
    assert list(scalars(year, LAW, "operation")) == wanted
    dry = replace(year, relative_humidity=None, absolute_humidity_g_m3=None, condensing=None)
    assert list(scalars(dry, LAW, "standstill")) == ["hours", "mean_temperature_degC"]
    assert "ageing_h" in scalars(dry, Acceleration(humidity_exponent=0.0))


def test_hours_of_a_part_of_a_year_are_scaled_and_gaps_left_out() -> None:
    percent = np.tile([90.0] * 6 + [50.0] * 18, 100)
    known = np.ones(2400, bool)
    known[1200:1224] = False
    found = scalars(year_of(np.full(2400, 20.0), percent, known), LAW)
    assert found["wetness_h"][0] == pytest.approx(8766 / 4)
    assert found["humidity_above_80_number"][0] == pytest.approx(8766 / 24)
    assert found["hours"][0] == 8766.0
    coarse = replace(year_of(np.full(2400, 20.0), percent), time_s=3 * 3600.0 * np.arange(2400), step_h=3.0)
    found = scalars(coarse, LAW)  # the same course stretched to steps of three hours
    assert found["wetness_h"][0] == pytest.approx(8766 / 4)
    assert found["humidity_above_80_number"][0] == pytest.approx(8766 / 72)
    assert found["humidity_above_80_longest_h"][0] == 18.0


def test_excursions_of_many_members() -> None:
    random = np.random.default_rng(2)
    beyond = random.random((20, 300)) < 0.4
    number, mean, longest = excursions(beyond, 2.0)
    for row, n, m, most in zip(beyond, number, mean, longest, strict=True):
        runs = [len(part) for part in "".join("x" if b else " " for b in row).split()]
        assert (n, most) == (len(runs), 2.0 * max(runs)) and m == pytest.approx(2.0 * np.mean(runs))
    number, mean, longest = excursions(np.zeros((1, 5), bool), 1.0)
    assert number[0] == longest[0] == 0.0 and np.isnan(mean[0])


def test_members_without_an_excursion_do_not_shorten_the_others() -> None:
    """Three members in two years, two of six without any: the mean length is that of the stretches that there
    are."""
    lengths = np.array([[4.0, np.nan, 6.0], [2.0, np.nan, 8.0]])
    found = bounded(lengths)
    assert found.value == 5.0 and (found.lower, found.upper) == (2.0, 8.0)
    assert (found.mean_lower, found.mean_upper) == (3.0, 7.0) and found.between_years == 0.0
    assert np.isnan(bounded(np.full((1, 3), np.nan)).value)
    whole = np.random.default_rng(1).random((2, 50))
    some = bounded(np.concatenate([whole, np.full((2, 5), np.nan)], axis=1))
    assert vars(some) == pytest.approx(vars(bounded(whole)))


def test_curves_and_the_joint_distribution() -> None:
    celsius = np.linspace(0.0, 40.0, 8001)
    year = year_of(celsius, 100.0 - 2.0 * celsius)
    found = reduced(year, LAW)
    assert found["duration", "temperature_degC"][0, [0, -1]] == pytest.approx([40.0, 0.0])
    assert found["duration", "temperature_degC"][0, 12] == pytest.approx(40.0 * (1 - 0.45), abs=0.01)
    assert found["joint", "hours"].sum() == pytest.approx(8766.0)
    row = int(np.searchsorted(TEMPERATURE_EDGES, 10.0))
    assert found["joint", "hours"][0, row].sum() == pytest.approx(8766 * 2.5 / 40, rel=0.01)
    assert found["joint", "hours"][0, row, 15] > 0.99 * found["joint", "hours"][0, row].sum()  # 75 … 80 %
    weather = outside(year)
    assert weather.condensing is None and weather.temperature_K.shape == (1, 8001)


def test_peck_s_law() -> None:
    """Ratios by hand: (85/60)^2.66 for humidity, exp(0.79/k (1/313.15 − 1/323.15)) for ten kelvin."""
    assert LAW.rate(np.array(358.15), np.array(0.85)) == pytest.approx(1.0)
    assert LAW.rate(np.array(300.0), np.array(0.85)) / LAW.rate(
        np.array(300.0), np.array(0.6)
    ) == pytest.approx(2.52564, rel=1e-4)
    assert LAW.rate(np.array(323.15), np.array(0.5)) / LAW.rate(
        np.array(313.15), np.array(0.5)
    ) == pytest.approx(2.4742, rel=1e-3)
    assert LAW.rate(np.array(300.0), np.array(1.3)) == LAW.rate(np.array(300.0), np.array(1.0))
    arrhenius = Acceleration(humidity_exponent=0.0)
    assert arrhenius.rate(np.array(358.15)) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="humidity_exponent = 0"):
        LAW.rate(np.array(300.0))


def test_classes_of_wetness() -> None:
    assert [wetness_class(h) for h in (0, 10, 11, 250, 2000, 5000, 6000)] == [
        "τ1",
        "τ1",
        "τ2",
        "τ2",
        "τ3",
        "τ4",
        "τ5",
    ]


@pytest.mark.parametrize("n", [2, 10, 40, 60])
def test_bounds_hold_a_further_draw(n: int) -> None:
    """From 39 members on in 95 % of cases; the extremes of fewer in (n − 1)/(n + 1) of them."""
    draws = np.random.default_rng([8, n]).gamma(2.0, size=(4000, n + 1))
    found = [bounded(row[None, :n]) for row in draws]
    share = np.mean([one.lower <= row[n] <= one.upper for one, row in zip(found, draws, strict=True)])
    assert share == pytest.approx(held(n), abs=0.02)


def test_bounds_of_a_year_hold_the_spread_between_years() -> None:
    random = np.random.default_rng(3)
    values = (
        random.standard_normal((30, 1, 1)) * 3.0 + random.standard_normal((1, 50, 1)) + np.zeros((30, 50, 2))
    )
    found = bounded_array(values)
    assert found["value"].shape == (2,) and found["between_years"][0] == pytest.approx(3.0, rel=0.35)
    assert np.all(found["upper"] - found["lower"] > 2.0 * (found["mean_upper"] - found["mean_lower"]))
    single = bounded_array(values[:1])
    assert np.all(single["between_years"] == 0.0) and np.array_equal(single["lower"], single["mean_lower"])


def test_limits_are_judged_by_their_bounds() -> None:
    random = np.random.default_rng(4)
    hours = random.integers(20, 60, 100)
    celsius = np.where(np.arange(8766)[None, :] < hours[:, None], 50.0, 20.0)
    year = year_of(celsius, np.full((100, 8766), 40.0))
    for allowed, verdict in ((5.0, "fail"), (40.0, "undecided"), (70.0, "pass")):
        limit = ClimateLimit("temperature_degC", above=45.0, hours_a_year=allowed, name="hot")
        found = judge_limit(limit, exceeded(year, limit)[None])
        assert found.verdict == verdict and found.hours.value == pytest.approx(hours.mean(), rel=1e-6)
    steep = ClimateLimit("temperature_rate_K_per_h", above=10.0, name="steep")
    assert exceeded(year, steep)[:, 0] == pytest.approx(1.0)  # one fall of 30 K
    still = ClimateLimit("temperature_degC", above=45.0, during="standstill", name="still")
    assert exceeded(year, still)[:, 0] == pytest.approx(hours // 2)
    dry = replace(year, relative_humidity=None)
    assert exceeded(dry, ClimateLimit("relative_humidity_percent", above=80.0, name="damp")) is None
