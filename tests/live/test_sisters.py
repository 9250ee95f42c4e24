"""What sister turbines read of the ambient supports or refutes an error of a turbine's own sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import DAY_S
from hygrokf.live.fault_isolation import USUAL, SisterDeviations, sister_deviations

SIGNAL, DAYS = "ambient_temperature", 24
TIME = 1.6e9 + 3600.0 * np.arange(24 * DAYS)
RAMP = np.maximum(TIME - TIME[-1] + 8.0 * DAY_S, 0.0) * 0.2 / DAY_S
"""An error that grows by 0.2 K a day in the last eight days."""
WEATHER = 280.0 + 5.0 * np.sin(TIME / 5e4)


def reading(seed: int, error: np.ndarray | float = 0.0, sd: float = 0.3) -> Record:
    """A turbine that reads the weather with an offset and noise of its own and an error (T,)."""
    random = np.random.default_rng(seed)
    noise = random.normal(0.0, 0.5) + sd * random.standard_normal(len(TIME))
    return Record(f"T{seed}", (Series(SIGNAL, TIME, WEATHER + noise + error),))


def found_of(own: Record, *sisters: Record) -> SisterDeviations:
    found = sister_deviations(own, sisters, SIGNAL)
    assert found is not None
    return found


def test_the_error_of_the_own_sensor_is_supported_and_that_of_another_is_refuted() -> None:
    sisters = [reading(seed) for seed in (2, 3, 4)]
    wrong, right = found_of(reading(1, RAMP), *sisters), found_of(reading(1), *sisters)
    assert wrong.size[0] == pytest.approx(1.5, abs=0.2) and abs(right.size[0]) < 0.2
    assert wrong.support(TIME, RAMP, 0.1) > 20.0 and right.support(TIME, RAMP, 0.1) < -20.0
    assert wrong.support(TIME, -RAMP, 0.1) < 0.0
    assert wrong.support(TIME, 0.0 * RAMP, 0.0) == 0.0


def test_sisters_far_away_say_less_and_one_wrong_sister_of_three_nothing() -> None:
    near, far = ([reading(seed, sd=sd) for seed in (2, 3, 4)] for sd in (0.3, 12.0))
    weak, strong = (found_of(reading(1), *some).support(TIME, RAMP, 0.1) for some in (far, near))
    assert strong < 5.0 * weak < 0.0 or abs(weak) < 1.0
    spoilt = found_of(reading(1), *near[:2], reading(5, 3.0 * RAMP))
    assert spoilt.support(TIME, RAMP, 0.1) < -10.0


def test_a_sister_may_come_and_go_with_an_offset_of_its_own() -> None:
    gone = reading(2)
    series = gone[SIGNAL]
    late = series.time < TIME[-1] - 3.0 * DAY_S
    gone = replace(gone, series=(replace(series, time=series.time[late], value=series.value[late]),))
    found = found_of(reading(1), gone, reading(3))
    assert np.isfinite(found.size).all() and np.abs(found.size).max() < 0.5
    assert np.isnan(found_of(reading(1), gone).size[:3]).all()


def test_what_is_no_witness() -> None:
    own = reading(1)
    assert sister_deviations(own, [], SIGNAL) is None and sister_deviations(own, [reading(2)], "") is None
    assert sister_deviations(own, [own, Record("T2", (own[SIGNAL],))], SIGNAL) is None, "a common mast"
    short = own.window(TIME[-1] - (2 * USUAL - 2) * DAY_S, TIME[-1])
    assert sister_deviations(short, [reading(2)], SIGNAL) is None
    new = reading(2).window(TIME[-1] - USUAL * DAY_S, TIME[-1])
    assert sister_deviations(own, [new], SIGNAL) is None, "nothing is known of what is usual"
