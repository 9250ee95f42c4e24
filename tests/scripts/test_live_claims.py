"""Claims about the live tracker: their sums on lines made by hand, a small run of each, in full with the slow
marker."""

from __future__ import annotations

import math

import numpy as np
import pytest
from validation import changes, contradictions, faulty, forecast, restart, saturation, spikes
from validation.counts import Columns, between_plants, reliability
from validation.frame import claim_of, run


# -- the sums ------------------------------------------------------------------------------------------------
def forecasts(said: np.ndarray, humidity: np.ndarray, seeds: int = 5) -> dict:
    """Lines of forecasts whose P(RH > 60 %) is `said` and whose humidity came out so; all other columns are
    plain."""
    lines = []
    for seed, (p, h) in enumerate(zip(np.split(said, seeds), np.split(humidity, seeds), strict=True)):
        rows = np.zeros((len(p), len(forecast.COLUMNS)))
        put = {"lead_h": 6.0, "kelvin": 290.0, "kelvin_sd": 1.0, "kelvin_true": 290.5, "humidity": 0.5,
            "humidity_sd": 0.1,
               "humidity_true": h, "above_60": p, "margin_true": 5.0}  # fmt: skip
        for name, value in put.items():
            rows[:, forecast.COLUMNS.index(name)] = value
        lines.append({"seed": seed, "rows": rows.tolist()})
    return forecast.Forecasts(lines)


def test_reliability_counts_what_came_true() -> None:
    said = np.tile([0.05, 0.25, 0.25, 0.95, 1.0], 20)
    came = np.tile([0.0, 1.0, 0.0, 1.0, 1.0], 20)
    f = forecasts(said, 0.5 + 0.2 * came)
    rows = [*reliability(f.columns["above_60"], f.happened("above_60"), f.seed, forecast.DECILES).values()]
    counts = [(r.edge, r.rate.hits, r.rate.n) for r in rows]
    assert counts == [(0.0, 0, 20), (0.2, 20, 40), (0.9, 40, 40)]
    assert rows[1].said == pytest.approx(0.25) and rows[2].said == pytest.approx(0.975)
    assert rows[1].low == rows[1].high == 0.5  # all plants alike
    score, base = forecast.brier(f.columns["above_60"], f.happened("above_60"), f.seed)
    assert score == pytest.approx((0.05**2 + 0.75**2 + 0.25**2 + 0.05**2 + 0.0) / 5)
    assert base == pytest.approx(0.6 * 0.4)
    held = forecast.coverage(f, "kelvin", f.within(3.0, 12.0))
    assert (held["rate"].hits, held["bias"], held["rms"]) == (100, -0.5, 0.5)
    assert held["rate"].n == 100 and not f.within(12.0, 24.0).any()


def test_bounds_between_plants_are_wider_than_those_of_single_forecasts() -> None:
    came = np.repeat([0.0, 1.0, 0.0, 1.0, 0.5], 40)
    came[-40::2] = 1.0
    f = forecasts(np.full(200, 0.55), 0.5 + 0.2 * (came > 0.5))
    (row,) = reliability(f.columns["above_60"], f.happened("above_60"), f.seed, forecast.DECILES).values()
    low, high = row.rate.bounds
    assert row.low < low - 0.1 and row.high > high + 0.1


def test_restarts_are_counted_by_advice() -> None:
    rows = [[5.0, 0.96, 0.55, 0.58, 2.0, 0.7], [3.0, 0.95, 0.62, 0.63, 5.0, 0.7],
        [0.0, 1.0, 0.3, 0.3, 0.0, 0.3],
            [-1.0, 0.8, 0.7, 0.7, -1.0, 0.9]]  # fmt: skip
    text = restart.table([{"variant": "flag", "rows": rows}, {"variant": "flag", "rows": []}])
    assert text.startswith(
        "flag: 1 plants with a pre-heating in their identification period (of 2), 4 restarts"
    )
    assert "| pre-heat for … h | 2 | 1/2 = 50 % (1 … 99) | 96 % |" in text
    assert "Advised 4.0 h on average (median 4.0 h); truly needed 3.5 h" in text
    assert "| 24 h are not enough | 1 |  |  |  | more than 24 h in 1 |" in text


def test_heating_that_it_took_is_where_it_stays_dry() -> None:
    minutes = np.arange(restart.HEATED_MIN)
    assert restart._needed(np.where(minutes < 90, 0.7, 0.5)) == 1.5
    assert restart._needed(np.where((minutes < 90) | ((minutes > 120) & (minutes < 240)), 0.7, 0.5)) == 4.0
    assert restart._needed(np.full(restart.HEATED_MIN, 0.7)) == -1.0


def test_the_heater_of_a_trial_has_a_thermostat_and_waits_for_the_end_of_a_standstill() -> None:
    drivers, ends = restart._drivers(3, np.random.default_rng(3), 6.0, 4.0, heater=True)
    plain, same = restart._drivers(3, np.random.default_rng(3), 6.0, 4.0, heater=False)
    assert ends == same and np.array_equal(plain.power_W, drivers.power_W)
    cold = drivers.ambient_K < np.quantile(drivers.ambient_K, restart.COLD)
    learnt = np.arange(len(cold)) < 4 * 1440
    assert drivers.preheating[cold & learnt].all() and cold[learnt].any()
    for end in ends:
        assert not drivers.preheating[end - 1440 : end].any()
        assert drivers.preheating[end : end + restart.HEATED_MIN].all()


def condensation(margin: np.ndarray, said: np.ndarray, seeds: int = 5) -> list[dict]:
    """Lines of the trial of condensation: the second surface a day ahead, known scenarios, with these
    margins."""
    lines = []
    for seed, (m, p) in enumerate(zip(np.split(margin, seeds), np.split(said, seeds), strict=True)):
        rows = np.column_stack(
            [np.zeros(len(m)), np.ones(len(m)), np.full(len(m), 24.0), np.zeros(len(m)), p, m]
        )
        windows = np.column_stack([np.zeros(len(m)), np.ones(len(m)), p, m < 1.0])
        lines.append(
            {"seed": seed, "kind": saturation.KINDS[0], "rows": rows.tolist(), "windows": windows.tolist()}
        )
    return lines


def test_condensation_is_a_margin_below_zero() -> None:
    margin = np.tile([-0.5, 0.5, 2.0, 2.0], 50)
    said = np.tile([0.3, 0.3, 0.3, 1.0], 50)
    text = saturation.table(condensation(margin, said))
    assert text.startswith("5 plants (5 ordinary, 0 damp, 0 damp, errors of all sensors).")
    (row,) = [line for line in text.splitlines() if line.startswith("| 0.3 / +0 K | 24 h | 200 |")]
    assert row.startswith("| 0.3 / +0 K | 24 h | 200 | 47.50 % | 25.00 % (25.00–25.00) |")
    assert "| 30.0 → 33.3 (33.3–33.3), 150 |" in row and row.endswith("| 100.0 → 0.0 (0.0–0.0), 50 |")
    # at any time of the window it came twice as often
    assert "| known | 200 | 47.50 % | 50.00 % (50.00–50.00) |" in text


def test_seeds_are_ordinary_and_damp_cabinets() -> None:
    ordinary, damp, every = (saturation.cabinet(seed) for seed in (9, 10, 11))
    assert ordinary == {} and (damp["sensor_errors"], every["sensor_errors"]) == ("cabinet", "all")
    for one in (damp, every):
        assert 0.5 <= one["standstill_W"][0] * one["outer_resistance"] <= 3.0
        through = one["outer_resistance"] + one["inner_resistance"]
        assert 0.8 <= through * one["heat_capacity"] / 3600.0 <= 3.0


def test_waits_count_from_the_change() -> None:
    found = {"tau": [["hygric_k", 61.0, 63.0, 0.2], ["thermal_time_constant", 60.0, 66.5, 0.4]], "none": []}
    early = {"tau": [["thermal_time_constant", 10.0, 12.0, 0.4]], "none": [["hygric_k", 1.0, 3.0, 0.2]]}
    lines = [{"seed": i, "days": 120.0, "change_day": 60.0, "found": f} for i, f in enumerate((found, early))]
    assert changes.waits(lines, "tau") == [6.5, math.inf]


def test_picture_of_lines() -> None:
    random = np.random.default_rng(3)
    said = random.random(500)
    f = forecasts(said, np.where(random.random(500) < said, 0.65, 0.55))
    assert forecast.reliability_png(f).startswith(b"\x89PNG")


# -- small trials --------------------------------------------------------------------------------------------
def test_a_small_trial_of_forecasts() -> None:
    """Twelve days of one plant: bands hold the truth, are no wider than they must, and probabilities say
    something."""
    f = forecast.Forecasts([{"seed": 51, **forecast.one("forecast", 51, days=12.0, learnt=32.0)}])
    everything = np.ones(len(f.seed), bool)
    assert len(f.seed) == 19 * len(forecast.LEADS_H)
    for quantity in ("kelvin", "humidity"):
        assert 0.85 < forecast.coverage(f, quantity, everything)["rate"].share < 1.0, quantity
        early, late = (f.within(*hours) for hours in ((0.0, 1.0), (23.0, 48.0)))
        assert (
            forecast.coverage(f, quantity, early)["rms"] < 0.4 * forecast.coverage(f, quantity, late)["rms"]
        )
        assert f.columns[f"{quantity}_sd"][early].mean() < 0.4 * f.columns[f"{quantity}_sd"][late].mean()
    soon = f.within(0.0, 6.0)
    score, base = forecast.brier(f.columns["above_50"][soon], f.happened("above_50")[soon], f.seed[soon])
    assert score < 0.6 * base
    assert "| RH > 50 % |" in forecast.table(
        [{"seed": 51, "rows": np.column_stack(list(f.columns.values())).tolist()}]
    )


def test_a_small_trial_of_contradictions() -> None:
    """Ten days of the plant of the forecasts: no reading is flagged wrongly, and large steps are noticed."""
    line = contradictions.one("contradictions", 51, days=12.0, learnt=32.0)
    assert line["days"] == 10.0
    for signal, steps in contradictions.STEPS.items():
        found = line[signal]
        assert found["readings"] > 750 and found["beyond"] == 0
        assert found["noticed"] == sorted(found["noticed"]) and len(found["noticed"]) == len(steps)
        assert found["noticed"][-1] > 0.98 * found["readings"]
    assert "| cabinet_temperature |" in contradictions.table([line])


def test_a_small_trial_of_condensation() -> None:
    """Ten days of a damp cabinet: with the weather that came, probabilities are right on the whole and tell
    the hours apart."""
    line = {"seed": 6010, **saturation.one("saturation", 6010, days=12.0, learnt=32.0)}
    c = Columns([line], "rows", saturation.COLUMNS).columns
    known = (c["scenarios"] == 0.0) & (c["lead_h"] <= 6.0)
    came = c["margin_true"] < 0.0
    base = came[known].mean()
    assert 0.02 < base < 0.5 and c["said"][known].mean() == pytest.approx(base, abs=0.03)
    assert np.mean((c["said"][known] - came[known]) ** 2) < 0.4 * base * (1.0 - base)
    w = Columns([line], "windows", saturation.WINDOW_COLUMNS).columns
    assert w["came"].mean() > base and "| persistence |" in saturation.table([line])


def test_a_small_trial_of_restarts() -> None:
    """Five restarts of one plant: dry when the advice said so, and it said neither never nor always the
    longest."""
    line = restart.one("flag", 51, days=26.0, learnt=35.0)
    hours, probability, humidity, _, needed, _ = np.array(line["rows"]).T
    assert len(hours) == 5 and line["silent"] == 0
    given = hours > 0.0
    assert given.sum() >= 2 and np.all(humidity[hours >= 0.0] < restart.LIMIT)
    assert np.all(probability[hours >= 0.0] >= 0.95)
    assert np.all(needed[given] <= hours[given]) and np.median(hours[given]) < 18.0


def test_a_small_trial_of_changes() -> None:
    """A time constant that grows from 1.5 to 2.5 h six days after the tracker's beginning; and one that does
    not."""
    found = changes.changed(50, ("none", "tau"), (30.0, 36.0, 52.0))
    assert found["none"] == []
    ((name, begin, lasts, change),) = found["tau"]
    assert name == "thermal_time_constant" and 6.0 < begin < lasts < 6.0 + changes.FOUND_DAYS
    assert 1.2 < math.exp(change) < 2.2


def test_a_small_trial_of_a_faulty_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frozen temperature is named within two days, and the cabinet is not."""
    line = {"variant": "frozen temperature", **faulty.one("frozen temperature", 2000)}
    kinds = [(alarm["kind"], alarm["subject"]) for alarm in line["alarms"]]
    assert ("sensor frozen", "cabinet_temperature") in kinds and "cabinet changed" not in dict(kinds)
    assert "right name within 2 days in 1 of 1" in faulty.table([line])


def test_bad_readings_of_a_tracked_cabinet_are_counted_by_step_and_signal() -> None:
    rows = [
        {"step": "1 min", "signal": "active_power", "kind": "1", "moved": [0.05, 0.2]},
        {"step": "1 h", "signal": "active_power", "kind": "1", "moved": [0.0]},
    ]
    text = spikes.table([{"variant": "tracked", "rows": rows}, {"variant": "tracked", "rows": rows[:1]}])
    assert "| 1 min | active_power | 1 | 4 | 50.0% | 0.12 | 0.20 |" in text
    assert text.endswith("all: 60.0% of 5 within 0.1 sd")


# -- in full -------------------------------------------------------------------------------------------------
def lines_of(name: str, seeds: range, variant: str = "") -> list[dict]:
    """Lines of many seeds, two at a time."""
    claim = claim_of(name)
    lines = list(run(claim, claim.chosen([variant or name], seeds), claim.settings, 2))
    assert not any(line["failure"] for line in lines)
    return lines


@pytest.mark.slow
def test_probabilities_come_true() -> None:
    lines = lines_of("forecast", range(100, 120))
    f = forecast.Forecasts(lines)
    for column in ("above_50", "above_60", "above_70", "above_80", "close"):
        for row in reliability(f.columns[column], f.happened(column), f.seed, forecast.DECILES).values():
            if row.rate.n >= 100:
                assert row.low - 0.1 < row.said < row.high + 0.1, (column, row)
    for quantity in ("kelvin", "humidity"):
        assert 0.92 < forecast.coverage(f, quantity, np.ones(len(f.seed), bool))["rate"].share < 0.98


@pytest.mark.slow
def test_condensation_comes_as_often_as_it_is_said_also_where_the_sensor_is_at_its_ceiling() -> None:
    """With the weather that came, in damp cabinets: a surface at 0.3 / 0 K and one at 0.6 / 0 K, where it is
    rare."""
    lines = lines_of("saturation", range(7200, 7224))
    cases = Columns(lines, "rows", saturation.COLUMNS)
    c, came = cases.columns, cases.columns["margin_true"] < 0.0
    near = (c["scenarios"] == 0.0) & np.isin(c["surface"], (1, 3)) & (c["lead_h"] <= 6.0)
    for ceiling in (0.0, 1.0):
        here = near & (c["ceiling"] == ceiling)
        bins = reliability(c["said"][here], came[here], cases.seed[here], saturation.BINS)
        for row in bins.values():
            if row.rate.n >= 50:
                assert row.low - 0.1 < row.said < row.high + 0.1, (ceiling, row)
        low, high = between_plants(came[here], cases.seed[here])
        assert low < c["said"][here].mean() < high


@pytest.mark.slow
def test_it_is_dry_when_the_advice_said_so() -> None:
    rows = np.array([row for line in lines_of("restart", range(200, 222), "flag") for row in line["rows"]])
    advised = rows[rows[:, 0] > 0.0]
    assert len(advised) > 80
    assert 0.90 <= np.mean(advised[:, 2] < restart.LIMIT) <= 0.98


@pytest.mark.slow
def test_it_is_dry_when_the_advice_by_a_logged_heater_said_so() -> None:
    rows = np.array(
        [row for line in lines_of("restart", range(9001, 9013), "heater") for row in line["rows"]]
    )
    advised = rows[rows[:, 0] > 0.0]
    assert len(advised) > 60
    assert 0.86 <= np.mean(advised[:, 2] < restart.LIMIT) <= 0.99


@pytest.mark.slow
def test_changes_are_found_and_few_are_made_up() -> None:
    lines = lines_of("changes", range(300, 320))
    assert np.mean(np.array(changes.waits(lines, "tau")) <= changes.FOUND_DAYS) >= 0.95
    for runs, days in (
        ([line["found"]["none"] for line in lines], "days"),
        ([line["plant"] for line in lines], "plant_days"),
    ):
        years = sum(line[days] for line in lines) / changes.YEAR_DAYS
        assert sum(map(len, runs)) <= years
