"""Naming causes: score statistics, candidates and the choice, on plants with and without a hidden cause."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from builders.documents import document
from plants.as_record import to_record
from plants.hidden import LIBRARY as HIDDEN
from plants.hidden import hidden_plant

from hygrokf.data.clocks import Shift, shifted, sources
from hygrokf.data.record import Record
from hygrokf.data.result_file import result_text
from hygrokf.discovery import submodel as submodel_module
from hygrokf.discovery.baseline import Baseline, baseline, refitted
from hygrokf.discovery.candidate import (
    MATERIAL,
    attempt,
    candidate_of,
    episodes,
    probability,
    score_statistic,
)
from hygrokf.discovery.cause import Variant, penalty
from hygrokf.discovery.clocks import shift_gains
from hygrokf.discovery.grids import dates
from hygrokf.discovery.library import LIBRARY, named
from hygrokf.discovery.model_selection import difference, select, verdict_on
from hygrokf.discovery.plugin_validation import IDENTIFIER
from hygrokf.discovery.procedure import discover
from hygrokf.discovery.scan import Probe, Scanned, scan, slow_scan
from hygrokf.discovery.submodel import HYGRIC, THERMAL, free_run_error, rmse, search_likelihood
from hygrokf.report.discovery_page import discovery_blocks
from hygrokf.report.terminal import page_text

DAY_S = 86400.0
DRIFT = Probe(THERMAL, ("release_drift", {"flag": "since"}), "heat_drift")


def record_of(cause: str, seed: int, days: float, form: int = 0) -> Record:
    return to_record(hidden_plant(seed, cause, form=form, days=days))


def library(*names: str) -> list:
    return [named(name) for name in names]


@pytest.fixture(scope="module")
def quiet() -> Baseline:
    """A plant that hides nothing."""
    return baseline(record_of("none", 811, 40.0), starts=1)


@pytest.fixture(scope="module")
def sorbing() -> Baseline:
    return baseline(record_of("moisture_sorption", 812, 50.0), starts=1)


def test_every_cause_of_the_library_has_a_name_of_its_own_and_its_words() -> None:
    assert len({cause.name for cause in LIBRARY}) == len(LIBRARY)
    for cause in LIBRARY:
        assert IDENTIFIER.fullmatch(cause.name)
        assert cause.meaning and cause.remedy and cause.separate_by and cause.forms
        assert not cause.mechanisms and not cause.features, "register them in the package's tables"


def test_plants_hide_causes_of_the_library() -> None:
    assert {*HIDDEN} - {cause.name for cause in LIBRARY} == set()


def test_the_page_names_the_causes_of_the_library() -> None:
    page = document("discover.md").read_text(encoding="utf-8").partition("## What it tries")[2]
    assert re.findall(r"`(\w+)`", page.partition("\n\n")[2].partition("\n\n")[0]) == [
        cause.name for cause in LIBRARY
    ]
    with pytest.raises(KeyError, match="no cause 'stove'; the library has moisture_sorption, condensation"):
        named("stove")


def test_score_statistics_are_standard_normal_where_there_is_no_effect(quiet: Baseline) -> None:
    """Neighbouring dates go together: their mean square is that of a few independent ones."""
    grid = [{"date_s": d} for d in dates(quiet.record)[0]]
    probes = (
        Probe(THERMAL, ("stepped_loss", {}), "conductance_change"),
        Probe(THERMAL, ("temperature_step", {}), "temperature_offset"),
        Probe(HYGRIC, ("stepped_exchange", {}), "exchange_change"),
    )
    z = np.concatenate([scan(quiet.submodels[one.submodel], one, "after_step", grid).root for one in probes])
    assert 0.2 < np.mean(z**2) < 2.5
    assert np.abs(z).max() < 4.5


def test_a_score_statistic_promises_what_the_refit_gains(quiet: Baseline) -> None:
    submodel = quiet.submodels[THERMAL]
    date = dates(quiet.record)[0][3]
    probe = Probe(THERMAL, ("temperature_step", {}), "temperature_offset")
    (z,) = scan(submodel, probe, "after_step", [{"date_s": date}]).root
    found = refitted(submodel, [("temperature_step", {})], {"after_step": {"date_s": date}}, ())
    assert 2.0 * (found.objective - submodel.objective) == pytest.approx(z * z, abs=0.6)
    assert np.sign(found.values["temperature_offset"]) == np.sign(z)


def test_slow_effects_are_scanned_in_one_pass(quiet: Baseline) -> None:
    """A release that drifts: the response to a lasting effect times its course is nearly the response
    itself."""
    submodel = quiet.submodels[THERMAL]
    settings = [{"date_s": d, "days": 10.0} for d in dates(quiet.record)[0][::4]]
    probe = submodel, DRIFT, "since", settings
    exact, quick = scan(*probe), slow_scan(*probe)
    assert np.max(np.abs(exact.root - quick.root)) < 0.3
    assert np.max(np.abs(exact.factor @ exact.factor.T - quick.factor @ quick.factor.T)) < 0.1


def test_settings_beside_each_other_give_what_each_gives_alone(quiet: Baseline) -> None:
    """Eight copies of a mechanism in one pass, and a last pass that is not full."""
    submodel = quiet.submodels[THERMAL]
    settings = [{"date_s": d, "days": 1.0} for d in dates(quiet.record)[0][::4]]
    assert len(settings) % 8
    probe = submodel, DRIFT, "since"
    together = scan(*probe, settings)
    alone = [scan(*probe, [one]).root[0] for one in settings]
    assert together.root == pytest.approx(alone, abs=1e-8)
    assert np.sum(together.factor**2, axis=1) == pytest.approx(np.ones(len(settings)))


def test_settings_that_say_the_same_count_once() -> None:
    none = np.zeros(20)
    assert Scanned(none, np.eye(20)).effective == pytest.approx(20.0, rel=0.25)
    assert Scanned(none, np.ones((20, 1))).effective == pytest.approx(1.0, abs=0.3)
    lag = np.abs(np.subtract.outer(np.arange(20), np.arange(20)))
    assert 2.0 < Scanned(none, np.linalg.cholesky(0.9**lag)).effective < 15.0
    both = Scanned(np.full(20, 3.0), np.eye(20)) + Scanned(np.full(20, 4.0), np.eye(20))
    assert both.root == pytest.approx(np.full(20, 5.0))


def test_a_step_in_the_readings_is_dated(quiet: Baseline) -> None:
    """1 K on the temperature readings from a date on: the statistic peaks there and the refit gives its
    size."""
    series = quiet.record["cabinet_temperature"]
    date = float(series.time[0] + 21.3 * DAY_S)
    moved = replace(series, value=series.value + (series.time > date))
    stepped = replace(quiet, record=quiet.record.replace_series(moved))
    submodel = replace(quiet.submodels[THERMAL], record=stepped.record)
    submodel = refitted(submodel, (), {}, ())
    stepped = replace(stepped, submodels={THERMAL: submodel})
    variant = next(
        v for v in named("temperature_sensor_offset").variants(stepped) if v.form == "from a date on"
    )
    assert abs(variant.settings["date_s"] - date) < 3600.0
    assert attempt(stepped, variant).bic_gain > 10.0
    found = refitted(submodel, [("temperature_step", {})], {"after_step": {"date_s": date}}, ())
    assert found.values["temperature_offset"] == pytest.approx(1.0, abs=0.35)


@pytest.mark.parametrize("source", ["cabinet", "ambient"])
def test_a_shifted_clock_is_measured(quiet: Baseline, source: str) -> None:
    """A source 20 minutes late: moving it back by that is what the innovations ask for."""
    name = next(n for n, signals in sources(quiet.record).items() if f"{source}_temperature" in signals)
    late = shifted(quiet.record, Shift(name, 1200.0))
    submodel = refitted(replace(quiet.submodels[THERMAL], record=late), (), {}, ())
    shifts = np.array([-2400.0, -1200.0, -600.0, 600.0])
    gains = shift_gains(submodel, name, shifts)
    assert shifts[int(np.argmax(gains))] == -1200.0
    assert gains.max() > 20.0
    alone = Baseline(late, {THERMAL: submodel})
    variant = next(
        v for v in named("clock_shift").variants(alone) if v.shift is not None and v.shift.source == name
    )
    candidate = attempt(alone, variant)
    assert candidate.variant.settings["shift_s"] == pytest.approx(-1200.0, abs=60.0)
    assert candidate.bic_gain > 20.0


def test_a_trial_counts_its_price_and_its_days(sorbing: Baseline) -> None:
    variant = named("moisture_sorption").variants(sorbing)[0]
    candidate = attempt(sorbing, variant)
    before = sorbing.submodels[HYGRIC]
    assert candidate.parameters == 2
    assert candidate.price == pytest.approx(2 * np.log(before.n) + 2 * np.log(4))
    assert candidate.bic_gain == pytest.approx(candidate.lr / sorbing.tempers[HYGRIC] - candidate.price)
    after = candidate.submodels[HYGRIC]
    assert candidate.gain[HYGRIC] == pytest.approx(1.0 - (rmse(after) / rmse(before)) ** 2, abs=1e-9)
    assert candidate.lasting[HYGRIC] < candidate.gain[HYGRIC]
    assert candidate.submodel == HYGRIC and candidate.episodes[HYGRIC] >= 2 and not candidate.once
    assert probability(candidate) < 1e-6
    assert score_statistic(sorbing, variant) > 10.0
    same = candidate_of(sorbing, variant, {HYGRIC: before})
    assert (same.lr, same.gain[HYGRIC]) == (0.0, 0.0)
    assert verdict_on(same, named("moisture_sorption")) == "it gains no likelihood"


def test_episodes_are_counted_by_the_days_that_gained() -> None:
    old = np.ones(60)
    new = old.copy()
    new[20:23] = 0.0
    assert episodes(old, new) == 1
    new[40] = 0.0
    assert episodes(old, new) == 2
    assert episodes(old, 0.5 * old) == 6  # a gain that lasts counts for every week of four fifths


def test_an_amplitude_at_its_boundary_has_half_a_chance(quiet: Baseline) -> None:
    """p of a sorption that gains 3.84: half of χ² with two and half with one degree of freedom."""
    sun = Variant("moisture_sorption", "x", {HYGRIC: (("moisture_sorption", {}),)})
    submodel = refitted(quiet.submodels[HYGRIC], sun.additions[HYGRIC], {}, ({},))
    candidate = replace(candidate_of(quiet, sun, {HYGRIC: submodel}), lrs={HYGRIC: 3.84})
    assert candidate.parameters == 2
    assert probability(candidate) == pytest.approx(0.5 * (0.05004 + 0.14661), abs=1e-4)
    drift = Variant("humidity_sensor_drift", "x", {HYGRIC: (("humidity_drift", {}),)})
    span = {"elapsed": {"start_s": quiet.record.start_s, "end_s": quiet.record.end_s}}
    submodel = refitted(quiet.submodels[HYGRIC], drift.additions[HYGRIC], span, ({},))
    candidate = replace(candidate_of(quiet, drift, {HYGRIC: submodel}), lrs={HYGRIC: 3.84})
    assert probability(candidate) == pytest.approx(0.05004, abs=1e-4)


def test_a_cause_is_like_itself_and_unlike_one_of_another_part(sorbing: Baseline) -> None:
    one = attempt(sorbing, named("moisture_sorption").variants(sorbing)[0])
    other = attempt(sorbing, named("wall_thermal_mass").variants(sorbing)[0])
    assert difference(sorbing, one, one) == 0.0
    assert difference(sorbing, one, other) > 0.9


def test_sensors_are_no_worse_than_their_accuracy_in_a_free_run(quiet: Baseline) -> None:
    submodel = quiet.submodels[HYGRIC]
    far = {**submodel.values, "cabinet_relative_humidity_bias": 0.5}
    held = free_run_error(submodel.base, submodel.run, far)
    sd = next(
        p for p in submodel.base.model.parameters if p.name == "cabinet_relative_humidity_bias"
    ).prior.sd
    clipped = free_run_error(
        submodel.base, submodel.run, {**far, "cabinet_relative_humidity_bias": 1.96 * sd}
    )
    assert held == pytest.approx(clipped, abs=1e-9, nan_ok=True)


def test_a_free_run_that_grows_beyond_all_numbers_is_no_fault(
    quiet: Baseline, monkeypatch: pytest.MonkeyPatch
) -> None:
    submodel = quiet.submodels[HYGRIC]
    plain = free_run_error(submodel.base, submodel.run, submodel.values)

    class Wild:
        def __init__(self, model: object, timeline: object) -> None:
            self.likelihood = search_likelihood(model, timeline)  # type: ignore[arg-type]

        def residuals(self, values: dict, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            error, slopes = self.likelihood.residuals(values, directions)
            slopes[..., 0] *= 1e200
            slopes[-1, :, 1] = np.inf
            return error, slopes

    monkeypatch.setattr(submodel_module, "search_likelihood", Wild)
    found = free_run_error(submodel.base, submodel.run, submodel.values)
    assert np.isfinite(found[np.isfinite(plain)]).all()
    assert np.nansum(found**2) <= np.nansum(plain**2) * 4.0


def test_nothing_is_named_where_nothing_is_hidden(quiet: Baseline) -> None:
    tried = library(
        "moisture_sorption", "wall_thermal_mass", "solar_gain", "humidity_sensor_drift", "ambient_bias"
    )
    selection = select(quiet, tried)
    assert selection.accepted == ()
    assert {candidate.variant.cause for candidate, _ in selection.rejected} <= {cause.name for cause in tried}
    assert all(reason for _, reason in selection.rejected)


def test_sorption_is_named_among_its_rivals(sorbing: Baseline) -> None:
    selection = select(
        sorbing, library("moisture_sorption", "dehumidifier", "internal_moisture_source", "ambient_bias")
    )
    first = selection.candidates[0]
    assert first.variant.cause == "moisture_sorption"
    assert first.lasting[HYGRIC] > MATERIAL and first.bic_gain > 50.0


def test_a_discovery_is_complete_json_and_plain_text() -> None:
    record = record_of("moisture_sorption", 10, 60.0)
    record = replace(record, until_s=record.start_s + 45 * DAY_S)
    found = discover(record, library=library("moisture_sorption", "solar_gain"), starts=1)
    data = json.loads(result_text(found.to_json()))
    assert data["verdict"] == "named"
    (cause,) = data["causes"]
    assert set(cause) >= set(
        "cause confidence statement parameters evidence gain ambiguous_with separate_by remedy".split()
    )
    assert cause["cause"] == "moisture_sorption" and 0.0 < cause["confidence"] <= 1.0
    assert set(cause["evidence"]) >= {"lr", "df", "p_adjusted", "bic_gain", "score_statistic"}
    gain = cause["gain"]
    assert (gain["quantity"], gain["period"]) == ("absolute_humidity_g_m3", "validation")
    assert gain["rmse_after"] < 0.8 * gain["rmse_before"]
    assert 0.0 < gain["lower"] < gain["rmse_before"] - gain["rmse_after"] < gain["upper"]
    for row in cause["parameters"].values():
        assert row["lower"] < row["value"] < row["upper"] and row["unit"]
    for side in ("baseline", "extended"):
        assert set(data[side]) >= {"rmse", "baselines", "time_constants"}
    (rejected,) = data["rejected"]
    assert rejected["cause"] == "solar_gain" and rejected["reason"]
    text = page_text(discovery_blocks(found.results))
    assert "Moisture sorption (" in text and "To check: Look for polymers" in text
    assert max(len(line) for line in text.splitlines()) <= 100
    # the extended model drives the validation period and beyond: it is a fit like any other
    assert found.extended.design.model.mechanism("moisture_sorption").name == "moisture_sorption"


def test_the_price_of_a_variant_grows_with_its_grid() -> None:
    one, many = Variant("a", "b"), Variant("a", "b", searched=100)
    assert penalty(many, 1, 1000) - penalty(one, 1, 1000) == pytest.approx(2 * np.log(100))
