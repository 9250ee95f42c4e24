"""Quasi-stationary periods against a brute-force search, with separate clocks, holds, gaps and regimes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import plant
from plants.as_record import to_record

from hygrokf.data.record import Record, Series
from hygrokf.identification.periods import (
    ENOUGH_PERIODS,
    EPISODE_GAP_H,
    EPISODE_LONGEST_H,
    OPERATION,
    STANDSTILL,
    Cells,
    Periods,
    cell_edges,
    cells_between,
    choose_length,
    earliest_starts,
    periods_of_length,
    rough_time_constant,
)

RATED_W = 2.0e6
HOUR_S = 3600.0
START_S = 1.6e9


def bare_cells(cabinet: np.ndarray, regime: np.ndarray, usable: np.ndarray, step_s: float = 600.0) -> Cells:
    """Cells whose cabinet temperature alone varies, in units of what a period may span."""
    count = len(cabinet)
    still = np.zeros(count)
    start = START_S + step_s * np.arange(count)
    span = (cabinet, cabinet)
    return Cells(
        start, start + step_s, cabinet, still, 0.5 * regime, regime, (span, (still, still), (still, still)),
        still, still, regime, usable,
    )  # fmt: skip


def random_record(seed: int, days: float = 12.0, cabinet_hold: str = "linear") -> Record:
    """Three clocks that share no instant; wandering temperatures, stepping power, gaps and single missing
    readings."""
    random = np.random.default_rng(seed)
    span = days * 24.0 * HOUR_S

    def wander(time: np.ndarray, scale: float) -> np.ndarray:
        knots = np.arange(0.0, span + 3.0 * HOUR_S, 3.0 * HOUR_S)
        return np.interp(time, knots, scale * random.standard_normal(len(knots)).cumsum() / 3.0)

    power_time = np.arange(600.0, span, 600.0)
    level = np.repeat(random.choice([-0.01, 0.02, 0.05, 0.5, 1.0], size=len(power_time) // 24 + 1), 24)
    power = RATED_W * (level[: len(power_time)] + 0.012 * random.uniform(-1, 1, len(power_time)))
    ambient_time = np.arange(130.0, span, 1200.0)
    cabinet_time = np.arange(410.0, span, 900.0)
    ambient, cabinet = 283.0 + wander(ambient_time, 1.0), 290.0 + wander(cabinet_time, 1.0)
    power[random.random(len(power)) < 0.01] = np.nan
    cabinet[random.random(len(cabinet)) < 0.01] = np.nan
    cabinet[200:230] = np.nan
    cabinet_interval = 900.0 if cabinet_hold == "mean" else 0.0
    return Record(
        "random",
        (
            Series("cabinet_temperature", START_S + cabinet_time, cabinet, cabinet_hold, cabinet_interval),
            Series("ambient_temperature", START_S + ambient_time, ambient),
            Series("active_power", START_S + power_time, power, "mean", 600.0),
        ),
        rated_power_W=RATED_W,
    )


def all_cells(record: Record) -> Cells:
    used = record.series
    first, last = max(one.time[0] - one.interval_s for one in used), min(one.time[-1] for one in used)
    clock = record["active_power"] if "active_power" in record else record["cabinet_temperature"]
    scale = RATED_W if "active_power" in record else None
    return cells_between(record, scale, cell_edges(clock, first, last))


def found(record: Record, regime: str, window_h: float) -> Periods:
    cells = all_cells(record)
    return periods_of_length(cells, earliest_starts(cells, 12.0), regime, window_h)


def dense(series: Series, time: np.ndarray) -> np.ndarray:
    """A series at many instants by a plain loop-free rule of its own, with one missing reading bridged."""
    there = np.isfinite(series.value)
    known, value = series.time[there], series.value[there]
    if series.hold == "linear":
        return np.interp(time, known, value)
    after = np.searchsorted(known, time, side="left")
    inside = after < len(known)
    inside[inside] &= time[inside] > known[after[inside]] - series.interval_s
    return np.where(inside, value[np.minimum(after, len(known) - 1)], value[np.maximum(after - 1, 0)])


# --- runs -----------------------------------------------------------------------------------


@settings(max_examples=150)
@given(st.integers(0, 10_000), st.integers(1, 70))
def test_runs_are_those_of_brute_force(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    cabinet = (0.25 * random.integers(-1, 2, count)).cumsum()
    regime = (random.random(count) < 0.85).astype(int) - (random.random(count) < 0.05)
    usable = random.random(count) < 0.93
    cells = bare_cells(cabinet, regime, usable)
    reached = earliest_starts(cells, 24.0)
    for end in range(count):
        if not usable[end] or regime[end] < 0:
            assert reached[end] == count
            continue
        start = end
        while (
            start > 0
            and usable[start - 1]
            and regime[start - 1] == regime[end]
            and np.ptp(cabinet[start - 1 : end + 1]) <= 1.0
        ):
            start -= 1
        assert reached[end] == start


@pytest.mark.parametrize("hold", ["linear", "mean"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_periods_hold_their_tolerances_at_every_instant(seed: int, hold: str) -> None:
    record = random_record(seed, cabinet_hold=hold)
    counted = 0
    for regime in (OPERATION, STANDSTILL):
        periods = found(record, regime, 1.5)
        counted += len(periods)
        assert np.all(periods.start_s[1:] >= periods.end_s[:-1])
        for k in range(len(periods)):
            start, end = periods.start_s[k], periods.end_s[k]
            assert end - start >= 1.5 * HOUR_S - 1e-3
            time = start + (end - start) * (np.arange(5400) + 0.5) / 5400.0
            cabinet, ambient = (
                dense(record[f"{place}_temperature"], time) for place in ("cabinet", "ambient")
            )
            power = dense(record["active_power"], time) / RATED_W
            assert np.ptp(cabinet) <= 1.0 + 1e-5
            assert np.ptp(ambient) <= 1.0 + 1e-5
            assert np.ptp(power) <= 0.05 + 1e-6
            assert np.all(power > 0) if regime == OPERATION else np.all(power <= 0)
            assert periods.difference_K[k] == pytest.approx(np.mean(cabinet - ambient), abs=2e-3)
            assert periods.ambient_K[k] == pytest.approx(np.mean(ambient), abs=1e-3)
            assert periods.power[k] == pytest.approx(np.mean(power), abs=1e-4)
            assert periods.rate_K_h[k] == pytest.approx(periods.change_K[k] / ((end - start) / HOUR_S))
    assert counted > 20


def steady(hours: float = 48.0, **changed: np.ndarray) -> Record:
    """Everything constant: cabinet every 15 min, ambient hourly, power in ten-minute means."""
    cabinet = np.arange(200.0, hours * HOUR_S, 900.0)
    ambient = np.arange(0.0, hours * HOUR_S + 1.0, 3600.0)
    power = np.arange(600.0, hours * HOUR_S + 1.0, 600.0)
    values = {
        "cabinet": np.full(len(cabinet), 290.0),
        "ambient": np.full(len(ambient), 280.0),
        "power": np.full(len(power), 0.5 * RATED_W),
    } | changed
    more = (
        (Series("preheating", START_S + power, values["preheating"], "mean", 600.0),)
        if "preheating" in values
        else ()
    )
    return Record(
        "steady",
        (
            Series("cabinet_temperature", START_S + cabinet, values["cabinet"]),
            Series("ambient_temperature", START_S + ambient, values["ambient"]),
            Series("active_power", START_S + power, values["power"], "mean", 600.0),
            *more,
        ),
        rated_power_W=RATED_W,
    )


def test_a_steady_record_is_covered_without_overlap() -> None:
    periods = found(steady(), OPERATION, 4.0)
    assert (
        len(periods) == 11
    )  # 200 s and a part of the last quarter of an hour are outside of the cabinet's readings
    np.testing.assert_allclose(periods.end_s - periods.start_s, 4.0 * HOUR_S)
    np.testing.assert_allclose(periods.difference_K, 10.0)
    np.testing.assert_allclose(periods.change_K, 0.0, atol=1e-9)
    assert len(found(steady(), STANDSTILL, 4.0)) == 0


def test_a_mean_holds_over_the_interval_before_its_stamp() -> None:
    # The mean stamped 24 h is the first at full power, so the power rises at 23 h 50 min.
    power = np.where(np.arange(288) < 143, 0.5, 0.9) * RATED_W
    periods = found(steady(power=power), OPERATION, 1.0)
    rise = START_S + 24.0 * HOUR_S - 600.0
    assert not np.any((periods.start_s < rise) & (periods.end_s > rise))
    assert rise in periods.end_s
    assert rise <= periods.start_s[periods.start_s >= rise - 1.0].min() < rise + HOUR_S
    assert set(np.round(periods.power, 12)) == {0.5, 0.9}


def test_gaps_are_left_out_and_one_missing_reading_is_not_a_gap() -> None:
    cabinet = np.full(192, 290.0)
    cabinet[50] = np.nan
    assert len(found(steady(cabinet=cabinet), OPERATION, 4.0)) == 11
    cabinet[50:58] = np.nan
    periods = found(steady(cabinet=cabinet), OPERATION, 1.0)
    # Known up to reading 49 and from reading 58 on.
    begin, end = START_S + 200.0 + 49 * 900.0, START_S + 200.0 + 58 * 900.0
    assert not np.any((periods.start_s < end) & (periods.end_s > begin))
    power = np.full(288, 0.5 * RATED_W)
    power[100:103] = np.nan
    periods = found(steady(power=power), OPERATION, 1.0)
    begin, end = START_S + 100 * 600.0, START_S + 103 * 600.0
    assert not np.any((periods.start_s < end) & (periods.end_s > begin))


def test_preheating_and_changes_of_regime_are_left_out() -> None:
    power = np.where(np.arange(288) < 144, 0.004, -0.004) * RATED_W  # within the tolerance, yet two regimes
    heating = np.zeros(288)
    heating[200:230] = 0.5
    record = steady(power=power, preheating=heating)
    running, standing = found(record, OPERATION, 1.0), found(record, STANDSTILL, 1.0)
    stop = START_S + 24.0 * HOUR_S
    assert len(running) == 23 and running.end_s.max() == stop
    assert standing.start_s.min() >= stop
    begin, end = START_S + 200 * 600.0, START_S + 230 * 600.0
    assert not np.any((standing.start_s < end) & (standing.end_s > begin))
    assert len(standing) == 9 + 9


def test_minute_power_is_judged_by_its_ten_minute_means() -> None:
    minutes = START_S + 60.0 * np.arange(1, 2881)
    gusts = 0.5 + 0.2 * np.where(np.arange(2880) % 2, 1.0, -1.0)
    plain = steady()
    record = Record(
        "gusty",
        (*plain.series[:2], Series("active_power", minutes, gusts * RATED_W, "mean", 60.0)),
        rated_power_W=RATED_W,
    )
    assert len(found(record, OPERATION, 4.0)) == 11


def test_periods_end_where_a_stretch_ends() -> None:
    """The start of a stretch, where a transient dies away, is what remains uncovered."""
    power = np.where((np.arange(288) >= 100) & (np.arange(288) < 133), 0.9, 0.1) * RATED_W
    periods = found(steady(power=power), OPERATION, 2.0)
    there = periods.power > 0.5
    assert there.sum() == 2
    assert periods.end_s[there].max() == START_S + 133 * 600.0


# --- episodes -------------------------------------------------------------------------------


def test_a_pause_or_a_long_spell_ends_an_episode() -> None:
    hours = 14 * 24.0
    power = np.full(int(hours * 6), 0.5 * RATED_W)
    pause = np.arange(len(power))
    jumps = (pause >= 6 * 24 * 5) & (pause < 6 * 24 * 5 + 6 * 13)
    power[jumps] = np.where(pause[jumps] % 2, 0.2, 0.8) * RATED_W
    periods = found(steady(hours, power=power), OPERATION, 2.0)
    assert np.all(np.diff(periods.episode) >= 0)
    for number in np.unique(periods.episode):
        rows = periods.episode == number
        assert periods.end_s[rows].max() - periods.start_s[rows].min() <= EPISODE_LONGEST_H * HOUR_S
        assert np.all(periods.start_s[rows][1:] - periods.end_s[rows][:-1] < EPISODE_GAP_H * HOUR_S)
    after = periods.start_s > START_S + 5.3 * 24 * HOUR_S
    assert not set(periods.episode[after]) & set(periods.episode[~after])
    # 120 h are two spells of at most 72 h, the 203 h after the pause are three.
    assert periods.n_episodes == 5


# --- length ---------------------------------------------------------------------------------


def stretches(count: int, cells_each: int, apart: int) -> Cells:
    """Stationary stretches of one length, some days apart."""
    block = np.full(apart, 10.0) * (np.arange(apart) % 2)
    cabinet = np.concatenate([np.concatenate([np.zeros(cells_each), block]) for _ in range(count)])
    return bare_cells(cabinet, np.zeros(len(cabinet), int), np.ones(len(cabinet), bool))


def test_the_longest_length_is_taken_where_it_yields_enough() -> None:
    cells = stretches(40, 18, 6 * 30)
    choice = choose_length(cells, earliest_starts(cells, 3.0), STANDSTILL, 1.0, 3.0)
    assert choice.window_h == pytest.approx(3.0)
    assert len(choice.periods) == choice.periods.n_episodes == 40


def test_a_length_that_leaves_too_few_is_shortened() -> None:
    cells = stretches(40, 12, 6 * 30)
    choice = choose_length(cells, earliest_starts(cells, 6.0), STANDSTILL, 1.0, 6.0)
    assert 1.0 < choice.window_h <= 2.0
    assert len(choice.periods) == 40


@pytest.mark.parametrize("count", [40, 80])
def test_a_length_that_loses_the_range_of_power_is_shortened(count: int) -> None:
    """Stretches of 3 h at low power take turns with stretches of 1.5 h at high power."""
    cells = stretches(count, 18, 6 * 30)
    place, turn = np.arange(len(cells.start)) % 198, np.arange(len(cells.start)) // 198
    high = turn % 2 == 1
    power = np.where(high, 0.85, 0.15)
    changed = replace(
        cells,
        usable=~(high & (place >= 9) & (place < 18)),
        power=power,
        regime=np.ones(len(power), int),
        ranges=(*cells.ranges[:2], (power / 0.05, power / 0.05)),
    )
    choice = choose_length(changed, earliest_starts(changed, 3.0), OPERATION, 1.0, 3.0)
    assert 1.0 < choice.window_h <= 1.5
    assert set(np.round(choice.periods.power, 2)) == {0.15, 0.85}
    # with 40 stretches only 20 are longer, too few by themselves; with 80 they would lose the high power
    whole = periods_of_length(changed, earliest_starts(changed, 3.0), OPERATION, 3.0)
    assert (len(whole) >= ENOUGH_PERIODS[0]) == (count == 80)
    assert set(np.round(whole.power, 2)) == {0.15}


# --- time constant --------------------------------------------------------------------------


def hourly(record: Record) -> Cells:
    used = [record[name] for name in ("cabinet_temperature", "ambient_temperature", "active_power")]
    first, last = max(one.time[0] for one in used), min(one.time[-1] for one in used)
    return cells_between(record, record.rated_power_W, np.arange(first, last, HOUR_S))


@pytest.mark.parametrize(("seed", "tau_h"), [(1, 0.5), (2, 1.5), (3, 5.0), (4, 12.0)])
def test_rough_time_constant_of_a_disturbed_plant(seed: int, tau_h: float) -> None:
    made = plant(seed, tau_h=tau_h, days=150.0)
    assert rough_time_constant(hourly(to_record(made))) == pytest.approx(tau_h, rel=0.2)


def test_no_time_constant_where_nothing_moves_or_little_is_known() -> None:
    assert rough_time_constant(hourly(steady(300.0))) is None
    assert rough_time_constant(hourly(steady(48.0))) is None


def test_the_cells_of_nothing() -> None:
    cells = cells_between(steady(), RATED_W, np.empty(0))
    assert len(cells.start) == 0
    assert len(earliest_starts(cells, 3.0)) == 0
    choice = choose_length(cells, np.empty(0, int), OPERATION, 1.0, 3.0)
    assert len(choice.periods) == choice.periods.n_episodes == 0
    assert rough_time_constant(cells) is None
    assert math.isfinite(choice.window_h)
