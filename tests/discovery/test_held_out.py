"""The held-out period against accepted causes: what it refutes, to whom a gain belongs, and what is
recommended then."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plants.as_record import to_record
from plants.hidden import hidden_plant

from hygrokf.cases.case_file import read_case
from hygrokf.data.record import Record, Series
from hygrokf.discovery.baseline import Budget, BudgetSpent, baseline
from hygrokf.discovery.candidate import attempt
from hygrokf.discovery.held_out import Model, Simulated, difference_bounds, gain_of, refutes
from hygrokf.discovery.library import named
from hygrokf.discovery.model_selection import select
from hygrokf.discovery.procedure import discover
from hygrokf.report.discovery_page import discovery_blocks
from hygrokf.report.discovery_text import gain_sentence
from hygrokf.report.terminal import page_text

DAY_S = 86400.0
RIVALS = (named("exchange_step"), named("moisture_sorption"))
CABINET = (
    Path(__file__).resolve().parents[2] / "../shared/data/turbine_controller_cabinet_660kW_10min_2013.csv.gz"
)
TURBINE = """\
name = "controller's cabinet of a turbine"
rated_power_kW = 660.0
[[source]]
file = "{file}"
time = "time"
timezone = "UTC"
stamp = "end"
interval = "10min"
signals.cabinet_temperature = {{ column = "controller_temperature_degC", unit = "degC" }}
signals.ambient_temperature = {{ column = "outside_temperature_degC", unit = "degC" }}
signals.active_power = {{ column = "active_power_kW", unit = "kW" }}
[identification]
until = "2013-05-15T00:00Z"
"""


# --- a change that is taken back ----------------------------------------------------------------------------
def spliced(early: Series, late: Series, at_s: float) -> Series:
    """A series until an instant, another one from then on."""
    first, last = early.time <= at_s, late.time > at_s
    return replace(
        early,
        time=np.concatenate([early.time[first], late.time[last]]),
        value=np.concatenate([early.value[first], late.value[last]]),
    )


@pytest.fixture(scope="module")
def taken_back() -> Record:
    """An exchange that changes within the identification period, and is as before in the validation
    period."""
    changed, plain = (to_record(hidden_plant(9710, cause, days=80.0)) for cause in ("exchange_step", "none"))
    until = changed.start_s + 55.0 * DAY_S
    names = [s.signal for s in changed.series if s.signal.startswith("cabinet_")]
    record = changed.replace_series(*(spliced(changed[n], plain[n], until) for n in names))
    return replace(record, until_s=until)


def test_a_change_that_the_held_out_period_does_not_show_is_refuted(taken_back: Record) -> None:
    found = discover(taken_back, starts=1, library=RIVALS)
    results = found.results
    (one,) = [row for row in results.refuted if row.cause == "exchange_step"]
    assert one.gain.upper < 0.0 and one.gain.rmse_after > one.gain.rmse_before
    assert "exchange_step" not in [row.cause for row in results.causes]
    (said,) = [row.reason for row in results.rejected if row.cause == "exchange_step"]
    assert said.startswith("the held-out period refutes it") and "grows from" in said
    if not results.causes:
        assert found.extended is None and results.extended is None
        assert results.verdict == "unexplained"
    assert "Refuted by the held-out period: exchange step" in page_text(discovery_blocks(results))


def test_the_same_change_that_lasts_is_named(taken_back: Record) -> None:
    lasting = to_record(hidden_plant(9710, "exchange_step", days=80.0), until_s=taken_back.until_s)
    results = discover(lasting, starts=1, library=RIVALS).results
    assert [row.cause for row in results.causes][:1] == ["exchange_step"]
    assert results.refuted == ()


@pytest.mark.slow
def test_a_measured_cabinet_keeps_its_base_model(tmp_path: Path) -> None:
    """A step was accepted once with 60 %, and the held-out error grew from 1.12 to 1.63 K."""
    if not CABINET.is_file():
        pytest.skip(f"../shared/data/{CABINET.name} is not there")
    case = tmp_path / "case.toml"
    case.write_text(TURBINE.format(file=CABINET.resolve()), encoding="utf-8")
    found = discover(read_case(case))
    assert found.extended is None and found.results.causes == ()
    assert found.results.verdict == "unexplained"
    for one in found.results.refuted:
        assert one.gain.upper < 0.0


# --- numbers ------------------------------------------------------------------------------------------------
def simulated(size: float, seed: int = 0) -> Simulated:
    """Errors of that size at hours over 60 days, the last twenty held out."""
    time = 1.6e9 + 3600.0 * np.arange(60 * 24.0)
    error = size * np.random.default_rng(seed).standard_normal(len(time))
    return Simulated({"temperature_K": (time, error)}, time[0] + 40 * DAY_S)


def test_a_gain_is_that_of_the_better_simulators() -> None:
    """By the identification period: moved toward the least free-run error where that is better there."""
    before = Model(simulated(1.0), simulated(0.8))
    after = Model(simulated(0.5), simulated(0.9))
    gain = gain_of("temperature_K", before, after)
    assert gain.rmse_before == before.moved.rmse("temperature_K", "validation")
    assert gain.rmse_after == after.identified.rmse("temperature_K", "validation")
    assert gain.identified_before == before.identified.rmse("temperature_K", "validation")
    assert gain.lower < gain.rmse_before - gain.rmse_after < gain.upper
    assert not refutes(gain) and refutes(gain_of("temperature_K", after, before))


def test_without_a_held_out_period_nothing_is_refuted() -> None:
    open_ended = [replace(simulated(size), until_s=math.inf) for size in (0.5, 1.0)]
    gain = gain_of("temperature_K", *(Model(one, one) for one in open_ended))
    assert gain.period == "identification" and gain.upper < 0.0 and not refutes(gain)


def test_bounds_compare_the_readings_that_both_have() -> None:
    """An extended model may have instants of its own, and fewer readings."""
    time, error = simulated(1.0).of("temperature_K", "validation")
    both = difference_bounds((time, error), (time, 0.5 * error))
    fewer = difference_bounds((time, error), (time[::2], 0.5 * error[::2]))
    assert both[0] < 0.5 < both[1] and fewer[0] < 0.5 < fewer[1]


@pytest.mark.parametrize("late_only", [False, True])
def test_a_free_run_that_diverges_has_no_error(late_only: bool) -> None:
    """As identified, the model with the cause ran away to 4e33 in an attic; moved, it simulates well."""
    before = Model(simulated(1.0), simulated(0.8))
    time, error = simulated(1.0).errors["temperature_K"]
    grown = np.where(time > time[1000], 4e33, error) if late_only else np.full(len(time), 4e33)
    after = Model(replace(simulated(1.0), errors={"temperature_K": (time, grown)}), simulated(0.5))
    gain, plain = (
        gain_of("temperature_K", before, one) for one in (after, replace(after, identified=after.moved))
    )
    assert math.isnan(gain.identified_after) and math.isfinite(plain.identified_after)
    assert "diverges" in gain_sentence(gain) and "diverges" not in gain_sentence(plain)
    if not late_only:
        assert replace(gain, identified_after=0.0) == replace(plain, identified_after=0.0)


# --- the time that it takes ---------------------------------------------------------------------------------
def test_what_the_time_does_not_last_for_is_said(taken_back: Record) -> None:
    results = discover(taken_back, starts=1, budget_s=0.5).results
    untried = results.not_tried.causes
    tried = {row.cause for row in (*results.causes, *results.rejected)}
    assert len(untried) > 10 and not tried & set(untried)
    assert results.not_tried.budget_s == 0.5
    said = " ".join(page_text(discovery_blocks(results)).split())
    assert "were not tried: allow more time with --budget" in said and untried[0].replace("_", " ") in said


def test_a_trial_that_runs_ends_with_the_time(taken_back: Record) -> None:
    """No pass of the filter is begun after it; the parts that are estimated already stay whole."""
    made = baseline(taken_back.identification(), starts=1)
    variant = named("moisture_sorption").variants(made)[0]

    class Short(Budget):
        left = 12

        @property
        def spent(self) -> bool:
            self.left -= 1
            return self.left < 0

    with pytest.raises(BudgetSpent):
        attempt(replace(made, budget=Short()), variant)
    short = Short()
    found = select(replace(made, budget=short), [named("moisture_sorption"), named("solar_gain")])
    assert set(found.untried) == {"moisture_sorption", "solar_gain"} and not found.accepted
    assert not found.baseline.budget.spent


def test_a_budget_is_a_time() -> None:
    for seconds in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="seconds above 0"):
            Budget(seconds)
    assert not Budget(math.inf).spent


def test_a_refutation_in_words_tells_the_rise() -> None:
    gain = gain_of("temperature_K", *(Model(one, one) for one in (simulated(0.5), simulated(1.0))))
    said = gain_sentence(gain)
    assert "rises from 0.51 to 1.02 K" in said and "bounds of the rise: 0.4" in said
    assert "not certain" not in said


def test_a_growth_that_is_certain_and_nothing_refutes_nothing() -> None:
    """A clock that is set right moves the simulated error by a hundredth: certain, as all readings agree, and
    no matter."""
    gain = gain_of("temperature_K", *(Model(one, one) for one in (simulated(1.0), simulated(1.005))))
    assert gain.upper < 0.0 and not refutes(gain)
