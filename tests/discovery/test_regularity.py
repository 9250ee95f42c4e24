"""What errors show in time and frequency: periods of any length, growth, bursts; and that ordinary errors
show none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from other_make import ROWS, make_plant
from other_make.as_record import to_record
from plants.chance import ornstein_uhlenbeck

from hygrokf.data.record import Record
from hygrokf.discovery.changes import growth, period
from hygrokf.discovery.residual_structure import bursts, unlogged
from hygrokf.discovery.residuals import residuals
from hygrokf.identification.procedure import identify
from hygrokf.physics.psychrometrics import absolute_humidity

HOURS = 24 * 60
LEVEL = 1e-3


def coloured(seed: int, memory_h: float = 8.0) -> np.ndarray:
    """An Ornstein–Uhlenbeck series of unit variance, by the hour."""
    return ornstein_uhlenbeck(np.random.default_rng(seed), HOURS, 1.0, memory_h)


def test_ordinary_errors_have_no_period_do_not_grow_and_do_not_burst() -> None:
    """40 coloured series with a daily course and holes; at 0.001 each, one alarm is already rare."""
    alarms = 0
    for seed in range(40):
        made = coloured(seed, memory_h=2.0 + seed % 20) + 0.5 * np.sin(2.0 * np.pi * np.arange(HOURS) / 24.0)
        made[200:260] = np.nan
        alarms += period(made, 1.0, LEVEL) is not None
        ratio, p = growth(made, 1.0)
        alarms += p < 0.01 and not 0.5 < ratio < 2.0
        kurtosis, p = bursts(made)
        alarms += p < 0.01 and kurtosis > 6.0
    assert alarms <= 1


@pytest.mark.parametrize("hours", [5.0, 9.3, 17.0, 31.0, 50.0])
def test_a_period_of_any_length_is_found_in_coloured_errors(hours: float) -> None:
    """A course that is on for two fifths of its period, as large as the errors beside it."""
    on = ((np.arange(HOURS) / hours) % 1.0 < 0.4).astype(float)
    made = coloured(int(hours)) + (on - on.mean()) / on.std()
    made[300:340] = np.nan
    found = period(made, 1.0, LEVEL)
    assert found is not None and found.p < 1e-6
    assert found.hours == pytest.approx(hours, rel=0.02)
    assert found.size == pytest.approx(1.0, rel=0.2)


def test_a_short_series_has_no_period() -> None:
    assert period(coloured(1)[:100], 1.0, LEVEL) is None
    assert period(np.full(HOURS, np.nan), 1.0, LEVEL) is None


def test_errors_that_grow_are_seen() -> None:
    ramp = np.exp(np.linspace(0.0, np.log(4.0), HOURS))
    ratio, p = growth(ramp * coloured(3), 1.0)
    assert 2.5 < ratio < 6.5 and p < 0.01
    ratio, p = growth(ramp[::-1] * coloured(3), 1.0)
    assert 0.15 < ratio < 0.4 and p < 0.01
    assert growth(coloured(3)[:100], 1.0) == (1.0, 1.0)


def test_errors_that_come_in_bursts_are_seen() -> None:
    random = np.random.default_rng(5)
    now_and_then = np.repeat(random.random(HOURS // 6) < 0.08, 6).astype(float)
    kurtosis, p = bursts((0.3 + 4.0 * now_and_then) * random.standard_normal(HOURS))
    assert kurtosis > 6.0 and p < 0.01


def with_source(record: Record, hours: float, size_g_m3: float) -> Record:
    """The record of a cabinet with a source of vapour beside: on for two fifths of its period, through an
    exchange of 0.5 h."""
    series, warm = record["cabinet_relative_humidity"], record["cabinet_temperature"]
    kelvin = np.interp(series.time, *warm.known)
    on = ((series.time / 3600.0 / hours) % 1.0 < 0.4).astype(float)
    vapour = np.zeros(len(on))
    keep = np.exp(-np.diff(series.time) / 1800.0)
    for k, share in enumerate(keep):
        vapour[k + 1] = share * vapour[k] + (1.0 - share) * on[k + 1]
    vapour *= size_g_m3 / vapour.std()
    humidity = series.value + 1e-3 * vapour / absolute_humidity(1.0, kelvin)
    return record.replace_series(replace(series, value=np.clip(humidity, 0.0, 1.0)))


def test_an_unknown_periodic_source_is_told_and_its_absence_is_not() -> None:
    """A source as large as the free run's error in a cabinet of another make, every 31 hours; without it
    nothing is told."""
    record = to_record(make_plant(95107, ROWS["instants"], days=60.0))
    quiet = residuals(identify(record, starts=1, profiles=False), record)
    assert unlogged(quiet) is None
    size = float(np.nanstd(quiet.humidity_error))
    disturbed = with_source(record, 31.0, size)
    found = unlogged(residuals(identify(disturbed, starts=1, profiles=False), disturbed))
    assert found is not None and found.kind == "period" and found.quantity == "humidity"
    assert found.when == "every 31.0 h" and "timer" in found.statement
