"""Which causes are accepted, on candidates with numbers by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from plants.as_record import to_record
from plants.hidden import hidden_plant

from hygrokf.data.clocks import Shift
from hygrokf.data.record import Record, Series
from hygrokf.discovery import evidence, grids
from hygrokf.discovery import model_selection as selection
from hygrokf.discovery.baseline import Baseline, baseline
from hygrokf.discovery.candidate import (
    Candidate,
    attempt,
    ordinary_shift,
    refined,
    restarted,
    score_statistic,
    standard_errors,
)
from hygrokf.discovery.cause import Variant
from hygrokf.discovery.discovery_results import CauseParameter
from hygrokf.discovery.library import LIBRARY, named
from hygrokf.discovery.model_selection import NO_BETTER, reason_against, select, verdict_on, with_candidate
from hygrokf.discovery.procedure import verdict as verdict_of
from hygrokf.discovery.scan import Probe
from hygrokf.discovery.submodel import HYGRIC, THERMAL
from hygrokf.evaluation.simulation import simulate
from hygrokf.modelling.design import Design, extended, merged
from hygrokf.modelling.inputs import prepare_run
from hygrokf.physics.mechanisms.moisture import condensation
from hygrokf.physics.mechanisms.sensors import humidity_ceiling, humidity_drift, temperature_step
from hygrokf.physics.model import Mechanism
from hygrokf.physics.psychrometrics import saturation_pressure_water


def submodel_of(*mechanisms: Mechanism, converged: bool = True, **values: float) -> SimpleNamespace:
    """What a choice reads of a submodel."""
    parameters = [p for mechanism in mechanisms for p in mechanism.parameters]
    base = SimpleNamespace(model=SimpleNamespace(parameters=parameters))
    return SimpleNamespace(base=base, values=values, converged=converged, n=5000)


def candidate(
    cause: str,
    bic: float,
    lasting: float,
    submodel: str = HYGRIC,
    features: dict | None = None,
    converged: bool = True,
) -> Candidate:
    return Candidate(
        Variant(cause, "by hand", features=features or {}, settings={"shift_s": 900.0, "ordinary_s": 240.0}),
        {submodel: submodel_of(converged=converged)},
        {submodel: bic + 20.0},
        2,
        bic,
        {submodel: lasting},
        {submodel: lasting},
        {submodel: 9},
    )


def verdict(one: Candidate) -> str:
    return verdict_on(one, named(one.variant.cause))


def test_evidence_and_a_better_free_run_are_both_needed() -> None:
    assert verdict(candidate("moisture_sorption", 40.0, 0.2)) == ""
    assert "does not pay" in verdict(candidate("moisture_sorption", 9.0, 0.2))
    assert "gains too little" in verdict(candidate("moisture_sorption", 90.0, 0.04))
    assert "free run worse" in verdict(candidate("moisture_sorption", 900.0, -0.05))
    assert "no likelihood" in verdict(candidate("moisture_sorption", -30.0, 0.2))
    assert verdict(candidate("moisture_sorption", 40.0, 0.2, converged=False)) == ""
    assert "no evidence" in verdict(candidate("moisture_sorption", 5.0, 0.2, converged=False))


def test_overwhelming_evidence_needs_no_better_free_run() -> None:
    """Wind that carries a tenth of the exchange shows in every gust, and hardly in the mean."""
    assert verdict(candidate("wind_driven_exchange", 201.0, 0.01)) == ""
    assert "gains too little" in verdict(candidate("wind_driven_exchange", 199.0, 0.01))
    assert "worse" in verdict(candidate("wind_driven_exchange", 900.0, -0.03))


@pytest.mark.parametrize(
    ("mechanism", "values", "beyond"),
    [
        (humidity_drift(), {"humidity_drift_total": -0.4}, True),
        (humidity_drift(), {"humidity_drift_total": 0.39}, False),
        (temperature_step(), {"temperature_offset": 30.0}, True),
        # a sensor that sticks shows nothing above its ceiling; a film may grow faster than a record can
        # resolve
        (humidity_ceiling(), {"humidity_lost": 1.0, "humidity_ceiling": 1.0}, False),
        (condensation(), {"condensation_rate": 4.0}, False),
    ],
)
def test_a_sensor_that_is_off_beyond_what_is_possible_is_no_cause(
    mechanism: Mechanism, values: dict, beyond: bool
) -> None:
    one = candidate("humidity_sensor_drift", 900.0, 0.3)
    variant = replace(one.variant, additions={HYGRIC: ((mechanism.name, {}),)})
    one = replace(one, variant=variant, submodels={HYGRIC: submodel_of(mechanism, **values)})
    assert ("physically possible" in verdict(one)) == beyond
    assert not candidate("humidity_sensor_drift", 900.0, 0.3).beyond


@pytest.mark.parametrize(
    ("cause", "bic", "enough"),
    [("clock_shift", 31.0, True), ("clock_shift", 29.0, False), ("door_opening", 31.0, True),
     ("exchange_step", 31.0, True), ("cooling_switching", 59.0, False), ("cooling_switching", 61.0, True),
     ("dehumidifier", 99.0, False)],
)  # fmt: skip
def test_some_causes_hardly_show_in_the_free_run(cause: str, bic: float, enough: bool) -> None:
    assert (verdict(candidate(cause, bic, 0.0)) == "") == enough


def test_what_simulates_worse_in_any_part_is_no_cause() -> None:
    assert "worse" in verdict(candidate("unlogged_heater", 900.0, -0.03, THERMAL))
    assert verdict(candidate("unlogged_heater", 900.0, -0.01, THERMAL)) == ""
    both = replace(candidate("cooling_switching", 900.0, 0.3, THERMAL), gain={THERMAL: 0.3, HYGRIC: -0.03})
    assert "worse" in verdict(both)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cause", "form", "strength", "seed", "submodel"),
    [("unlogged_heater", 0, 0.5, 9521, THERMAL), ("cooling_switching", 1, 1.0, 9026, THERMAL)],
)
def test_a_switch_that_drives_itself_simulates_better(
    cause: str, form: int, strength: float, seed: int, submodel: str
) -> None:
    """With the readings' course the free run of these plants was worse by a third and by 4 %; by its own it
    gains."""
    record = to_record(hidden_plant(seed, cause, form=form, strength=strength, days=60.0))
    shared = baseline(record, starts=1)
    candidates = [attempt(shared, variant) for variant in named(cause).variants(shared)]
    best = max(candidates, key=lambda one: one.lr)
    assert best.lr > 100.0 and best.lasting[submodel] > 0.05 and verdict(best) == ""
    # the candidate's submodels keep the errors by readings, which later candidates beside it are held against
    by_readings = 1.0 - np.nansum(best.submodels[submodel].error ** 2) / np.nansum(
        shared.submodels[submodel].error ** 2
    )
    assert best.gain[submodel] > by_readings + 0.05


def test_a_small_clock_error_is_ordinary() -> None:
    late = candidate("clock_shift", 400.0, 0.0)
    small = Candidate(
        **{
            **late.__dict__,
            "variant": Variant("clock_shift", "x", settings={"shift_s": -180.0, "ordinary_s": 240.0}),
        }
    )
    assert verdict(late) == "" and "ordinary" in verdict(small)


@pytest.mark.parametrize(
    ("interval_s", "ordinary_s"), [(0.0, 240.0), (300.0, 240.0), (600.0, 360.0), (3600.0, 2160.0)]
)
def test_half_an_interval_is_what_the_place_of_a_stamp_looks_like(
    interval_s: float, ordinary_s: float
) -> None:
    time = np.arange(1.0, 9.0) * 3600.0
    means = Series(
        "active_power", time, time, interval_s=interval_s, hold="mean" if interval_s else "linear",
        source="scada.csv, power",
    )
    other = Series("ambient_temperature", time, time, source="station.csv")
    record = Record("two", (means, other))
    assert ordinary_shift(record, "scada.csv") == pytest.approx(ordinary_s)
    assert ordinary_shift(record, "station.csv") == 240.0


def test_a_ceiling_at_saturation_is_the_airs() -> None:
    one = candidate("humidity_sensor_drift", 900.0, 0.3)
    for ceiling, named_so in ((0.9, True), (0.96, True), (0.98, False), (1.0, False)):
        submodels = {HYGRIC: submodel_of(humidity_ceiling(), humidity_lost=1.0, humidity_ceiling=ceiling)}
        found = verdict(replace(one, submodels=submodels))
        assert ("saturation" not in found) == named_so


def test_where_the_likelihood_knows_little_the_free_run_speaks() -> None:
    """Evidence that is nothing after tempering, and a free run that gains 12 of its own standard errors."""
    one = replace(
        candidate("internal_moisture_source", 2.0, 0.6), price=20.0, lrs={HYGRIC: 400.0}, z={HYGRIC: 12.0}
    )
    cause = named("internal_moisture_source")
    assert verdict_on(one, cause, tried=60) == ""
    assert "does not pay" in verdict_on(replace(one, z={HYGRIC: 2.5}), cause, tried=60)
    assert "does not pay" in verdict_on(replace(one, gain={HYGRIC: 0.03}), cause, tried=60)
    assert "does not pay" in verdict_on(replace(one, lrs={HYGRIC: 25.0}), cause, tried=60)
    # four standard errors are chance where a thousand settings were searched
    searched = replace(one.variant, searched=1000.0)
    assert verdict_on(replace(one, z={HYGRIC: 4.0}), cause, tried=60) == ""
    assert "does not pay" in verdict_on(replace(one, z={HYGRIC: 4.0}, variant=searched), cause, tried=60)


def test_standard_errors_of_a_gain_come_from_blocks_of_days() -> None:
    random = np.random.default_rng(3)
    old, gone = np.full(100, 10.0), random.normal(0.5, 1.0, 100)
    blocks = gone.reshape(25, 4).sum(axis=1)
    expected = gone.sum() / (5.0 * blocks.std(ddof=1))
    assert standard_errors(old, old - gone) == pytest.approx(expected)
    once = np.zeros(100)
    once[40] = 50.0
    assert standard_errors(old, old - once) == pytest.approx(1.0)
    assert standard_errors(old, old) == 0.0


def test_what_exchanges_air_must_show_in_heat_and_vapour() -> None:
    one = candidate("cooling_switching", 900.0, 0.2)
    both = replace(
        one,
        variant=replace(one.variant, joint=True),
        submodels={THERMAL: submodel_of(), HYGRIC: submodel_of()},
        lrs={THERMAL: 600.0, HYGRIC: 300.0},
    )
    assert verdict(both) == ""
    for name in (THERMAL, HYGRIC):
        assert "one of them does not show" in verdict(replace(both, lrs={**both.lrs, name: 3.0}))
    assert verdict(replace(both, variant=one.variant, lrs={THERMAL: 600.0, HYGRIC: 3.0})) == ""


def test_a_model_that_is_not_quite_right_tempers_its_likelihood() -> None:
    """Near one on a plant that hides nothing; measured boxes are far above it (test_greenhouse)."""
    plain = baseline(to_record(hidden_plant(941, "none", days=40.0)), starts=1)
    assert all(1.0 <= c < 1.6 for c in plain.tempers.values())
    (variant,) = named("wall_thermal_mass").variants(plain)
    found = attempt(plain, variant)
    assert found.bic_gain == pytest.approx(found.lrs[THERMAL] / plain.tempers[THERMAL] - found.price)


def test_what_a_form_leaves_behind_is_no_further_cause() -> None:
    """A thermometer 1.7 K off beside a drier had 9 % of its evidence; a drier that sorption's form leaves
    behind, 5 %."""
    first = candidate("moisture_sorption", 1000.0, 0.2)
    assert reason_against(candidate("temperature_sensor_offset", 90.0, 0.1), 1, [first], LIBRARY) == ""
    assert "leaves behind" in reason_against(candidate("dehumidifier", 50.0, 0.1), 1, [first], LIBRARY)
    assert reason_against(candidate("wall_thermal_mass", 20.0, 0.1, THERMAL), 1, [first], LIBRARY) == ""


def test_a_further_cause_simulates_better() -> None:
    """Evidence alone is enough for the first one."""
    clock = candidate("clock_shift", 1200.0, 0.0)
    assert reason_against(clock, 1, [], LIBRARY) == ""
    assert reason_against(clock, 1, [candidate("moisture_sorption", 400.0, 0.3)], LIBRARY) == NO_BETTER


def test_evidence_is_compared_in_the_part_that_causes_share() -> None:
    """Rain beside a fan: what the fan explains of the temperature is no reason against a cause of the
    vapour."""
    fan = replace(
        candidate("cooling_switching", 930.0, 0.3, THERMAL),
        submodels={THERMAL: submodel_of(), HYGRIC: submodel_of()},
        lrs={THERMAL: 750.0, HYGRIC: 200.0},
    )
    assert fan.lr == 950.0 and fan.bic_in([HYGRIC]) == pytest.approx(930.0 * 200.0 / 950.0)
    assert reason_against(candidate("rain_ingress", 36.0, 0.14), 1, [fan], LIBRARY) == ""
    alone = replace(fan, submodels={HYGRIC: submodel_of()}, lrs={HYGRIC: 950.0})
    assert "leaves behind" in reason_against(candidate("rain_ingress", 36.0, 0.14), 1, [alone], LIBRARY)
    assert candidate("rain_ingress", -30.0, 0.0).bic_in([HYGRIC]) == 0.0


def test_what_simulates_the_same_is_another_name_though_the_likelihood_prefers_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    best, source = candidate("ambient_bias", 40.0, 0.39), candidate("internal_moisture_source", 2.0, 0.41)
    idle, apart = candidate("condensation", 5.0, 0.01), candidate("rain_ingress", 3.0, 0.3)
    apart_from = {"internal_moisture_source": 0.1, "rain_ingress": 0.9}
    monkeypatch.setattr(
        selection, "difference", lambda baseline, best, other: apart_from[other.variant.cause]
    )
    found = selection._class(None, best, [best], [best, source, idle, apart])  # type: ignore[arg-type]
    assert [one.variant.cause for one in found] == ["internal_moisture_source"]
    refuted = replace(source, lrs={HYGRIC: -1.0})
    assert selection._class(None, best, [best], [best, refuted]) == ()  # type: ignore[arg-type]


def test_a_cause_is_judged_at_its_maximum(monkeypatch: pytest.MonkeyPatch) -> None:
    """What gained 5 % on the way and 4 % at the maximum of the likelihood is not worth having, and the next
    one has its turn."""
    given = {
        one.variant.cause: one
        for one in (candidate("condensation", 60.0, 0.06), candidate("ambient_bias", 40.0, 0.3))
    }
    monkeypatch.setattr(selection, "attempt", lambda baseline, variant: given[variant.cause])
    slipped = replace(given["condensation"], lasting={HYGRIC: 0.04}, gain={HYGRIC: 0.04})
    monkeypatch.setattr(
        selection, "polished", lambda baseline, one: slipped if one is given["condensation"] else one
    )
    monkeypatch.setattr(selection, "refined", lambda base, baseline, one, alone: (one, baseline))
    library = tuple(
        replace(named(name), variants=lambda baseline, one=one: [one.variant]) for name, one in given.items()
    )
    alone = select(Baseline(None, {HYGRIC: SimpleNamespace()}), library[:1])  # type: ignore[arg-type]
    assert not alone.accepted and "gains too little" in alone.rejected[0][1]
    # and the other one has its turn
    monkeypatch.setattr(selection, "difference", lambda baseline, best, other: math.inf)
    monkeypatch.setattr(selection, "MOST_CAUSES", 1)
    both = select(Baseline(None, {HYGRIC: SimpleNamespace()}), library)  # type: ignore[arg-type]
    assert [one.variant.cause for one in both.candidates] == ["ambient_bias"]


def test_what_a_coarse_form_leaves_behind_is_no_further_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    """The finer form comes first; what still looks like a further cause is then tried beside it."""
    plain = candidate("moisture_sorption", 900.0, 0.5)
    coarse = replace(plain, variant=replace(plain.variant, finer=plain.variant))
    leftover = candidate("ambient_bias", 200.0, 0.3)
    answers = {"moisture_sorption": [coarse], "ambient_bias": [leftover, candidate("ambient_bias", 3.0, 0.3)]}
    asked = []

    def attempted(baseline: object, variant: Variant) -> Candidate:
        asked.append(variant.cause)
        left = answers[variant.cause]
        return left.pop(0) if len(left) > 1 else left[0]

    def finer(base: object, baseline: Baseline, one: Candidate, alone: bool) -> tuple[Candidate, Baseline]:
        return replace(one, lrs={HYGRIC: 970.0}), replace(
            baseline, submodels={HYGRIC: SimpleNamespace(values={})}
        )

    monkeypatch.setattr(selection, "attempt", attempted)
    monkeypatch.setattr(selection, "polished", lambda baseline, one: one)
    monkeypatch.setattr(selection, "difference", lambda baseline, best, other: math.inf)
    monkeypatch.setattr(selection, "with_candidate", lambda baseline, one: baseline)
    monkeypatch.setattr(
        selection,
        "_again",
        lambda baseline, candidates, accepted, *rest: [t for t in candidates if t not in accepted],
    )
    monkeypatch.setattr(selection, "restarted", lambda baseline, one: one.variant)
    monkeypatch.setattr(selection, "refined", finer)
    library = tuple(
        replace(named(name), variants=lambda baseline, one=one: [one.variant])
        for name, one in {"moisture_sorption": coarse, "ambient_bias": leftover}.items()
    )
    found = select(Baseline(None, {HYGRIC: SimpleNamespace(values={})}), library)  # type: ignore[arg-type]
    assert [one.variant.cause for one in found.candidates] == ["moisture_sorption"]
    assert found.candidates[0].lr == 970.0
    assert asked.count("ambient_bias") == 2 and asked.count("moisture_sorption") == 1


def test_a_switch_is_refined_without_losing_its_hysteresis(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[dict] = []

    def narrowest(submodel: object, probe: Probe, feature: str, grid: list) -> SimpleNamespace:
        seen.extend(grid)
        width = np.array([one["on"] - one["off"] for one in grid])
        return SimpleNamespace(root=1.0 / np.abs(width), effective=1.0)

    monkeypatch.setattr(grids, "scan", narrowest)
    monkeypatch.setattr(grids, "count_starts", lambda submodel, name, settings: 99)
    first = [{"on": a, "off": a - width} for a in (0.6644, 0.8572) for width in (0.03, 0.08)]
    probe = Probe(HYGRIC, ("drier", {}), "rate")
    bare = Baseline(Record("bare", ()), {HYGRIC: SimpleNamespace()})
    chosen, searched = grids.best_switch(bare, "drying", [probe], first, {"": 0.02})
    # steps of 0.01 and 0.02 bring on and off together but for rounding: such a pair is no switch
    assert chosen["on"] - chosen["off"] > 1e-3 and searched == 3.0
    assert min(one["on"] - one["off"] for one in seen) > 1e-3


def test_what_turns_with_the_seasons_is_no_switch(monkeypatch: pytest.MonkeyPatch) -> None:
    """A roof that is above a threshold from April on had been taken for a fan that somebody leaves
    running."""
    time = 1.6e9 + 3600.0 * np.arange(24.0 * 120)
    days = (time - time[0]) / 86400.0
    warm = 285.0 + 15.0 * days / 120.0
    daily = 3.0 * np.sin(2.0 * np.pi * days)
    submodel = SimpleNamespace(
        time_s=time, record=Record("roof", (Series("cabinet_temperature", time, warm + daily),))
    )
    assert grids.count_starts(submodel, "cooling", {"on_K": 292.0, "off_K": 291.0}) > 20
    assert grids.count_starts(submodel, "cooling", {"on_K": 296.0, "off_K": 288.5}) == 1
    monkeypatch.setattr(
        grids, "scan", lambda *args: SimpleNamespace(root=np.ones(len(args[3])), effective=1.0)
    )
    probe = Probe(THERMAL, ("cooling_loss", {}), "cooling_conductance")
    roof = Baseline(submodel.record, {THERMAL: submodel})
    seldom, often = {"on_K": 296.0, "off_K": 288.5}, {"on_K": 292.0, "off_K": 291.0}
    assert grids.best_switch(roof, "cooling", [probe], [seldom], {"": 0.5}) is None
    setting, _ = grids.best_switch(roof, "cooling", [probe], [seldom, often], {"": 0.1})
    assert setting["on_K"] < 295.0


@pytest.mark.parametrize(
    ("seconds", "settings", "said"),
    [
        (-1890.0, {}, ": its stamps are 31.5 min late"),
        (
            3600.0,
            {"relative_to": "station"},
            ": its stamps are 60 min early against station, or those of station as much the other way",
        ),
    ],
)
def test_a_clock_is_told_with_its_error(seconds: float, settings: dict, said: str) -> None:
    shift = Shift("logger", seconds)
    variant = Variant("clock_shift", "logger", shift=shift, settings=settings)
    assert evidence._clock(Candidate(variant, {}, {THERMAL: 90.0}, 1, 80.0, {}, {}, {})) == said
    assert "clock_correction" in evidence._remedy(
        named("clock_shift"), Candidate(variant, {}, {THERMAL: 9.0}, 1, 8.0, {}, {}, {})
    )


@pytest.mark.slow
def test_finer_forms_are_tried_in_the_end() -> None:
    """A slab of material behind thin material's estimate; thin material itself does not become a slab."""
    made = baseline(to_record(hidden_plant(813, "moisture_sorption", form=1, days=50.0)), starts=1)
    thin = named("moisture_sorption").variants(made)[0]
    candidate = attempt(made, thin)
    beside = replace(made, submodels={**made.submodels, **candidate.submodels})
    found, after = refined(made, beside, candidate, alone=True)
    assert found.variant.form.startswith("slab") and found.bic_gain > candidate.bic_gain + 10.0
    assert found.lasting[HYGRIC] > candidate.lasting[HYGRIC]
    assert after.submodels[HYGRIC].base.mechanisms[-1] == (
        "moisture_sorption",
        {"activated": True, "slab": True},
    )
    assert len(after.submodels[HYGRIC].values) == len(beside.submodels[HYGRIC].values)
    again, same = refined(made, after, found, alone=True)
    assert again is found and same is after
    # beside others only what the form gains is its own, or another's evidence would be counted here too
    told, _ = refined(made, beside, candidate, alone=False)
    assert told.lr == pytest.approx(found.lr, abs=0.1) and told.gain == candidate.gain
    assert told.bic_gain > candidate.bic_gain + 5.0


@pytest.mark.parametrize(
    ("features", "left", "foreign", "repeated", "said"),
    [
        (None, False, False, False, "none"),
        (None, True, False, False, "unexplained"),
        ({}, True, False, False, "named"),
        ({}, True, True, False, "unexplained"),
        ({"cooling": {}}, True, True, False, "named"),
        ({"cooling": {}}, True, False, True, "unexplained"),
    ],
)
def test_what_is_left_overrules_a_name_only_where_it_is_another_one(
    features: dict | None, left: bool, foreign: bool, repeated: bool, said: str
) -> None:
    accepted = (
        []
        if features is None
        else [Candidate(Variant("a", "b", features=features), {}, {THERMAL: 9.0}, 1, 8.0, {}, {}, {})]
    )
    assert verdict_of(accepted, {} if left else None, foreign, repeated) == said


def test_a_source_that_begins_is_dated_to_the_reading() -> None:
    """An hour off, a jump of the vapour is none of the source's, and the evidence is gone."""
    plant = hidden_plant(331, "internal_moisture_source", form=2, days=50.0)
    begins = plant.truth.hidden[0].dates[0]
    record = to_record(plant)
    found = baseline(to_record(plant, until_s=record.end_s), starts=1)
    late = next(v for v in named("internal_moisture_source").variants(found) if "date" in v.form)
    assert late.settings["date_s"] == pytest.approx(begins, abs=1200.0)
    assert attempt(found, late).lr > 30.0


def test_humidity_is_driven_by_the_temperature_that_a_cause_makes_known() -> None:
    """A heater's cycles that the base smoothed away are errors of the saturation, and had looked like a drier
    that runs with it.
    """
    base = baseline(to_record(hidden_plant(930, "unlogged_heater", form=1, days=40.0)), starts=1)
    found = max(
        (attempt(base, one) for one in named("unlogged_heater").variants(base)), key=lambda t: t.bic_gain
    )
    driven = with_candidate(base, found)
    assert driven.submodels[THERMAL] is found.submodels[THERMAL]
    assert driven.submodels[HYGRIC].objective > base.submodels[HYGRIC].objective + 50.0
    before, after = (
        max(attempt(one, variant).lr for variant in named("dehumidifier").variants(one))
        for one in (base, driven)
    )
    assert before > 12.0 > after + 5.0
    # an error of the thermometer is none of the air's, and the hygric submodel is told of it by itself
    told = {HYGRIC: {"measured_air": {"step": True}}}
    offset = replace(found, variant=replace(found.variant, altered=told))
    assert with_candidate(base, offset).submodels[HYGRIC] is base.submodels[HYGRIC]


def test_a_source_is_found_behind_a_disturbance_that_stands_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the base model's maximum the disturbance has a memory of days and the size of what the source
    brings."""
    plant = hidden_plant(49608, "unlogged_heater", form=1, days=120.0, second=("internal_moisture_source", 0))
    made = baseline(to_record(plant))
    always = named("internal_moisture_source").variants(made)[0]
    found = attempt(made, always)
    assert found.lr > 12.0
    assert attempt(made, restarted(made, found)).lr > 9.0  # the bounded likelihood counts bursts less
    monkeypatch.setattr("hygrokf.discovery.baseline.disturbances", lambda model: {})
    assert attempt(made, replace(always, starts=always.starts[:2])).lr < 0.5 * found.lr


def test_a_thermometer_off_by_a_constant_is_simulated_as_it_is_read() -> None:
    """The reading 1.5 K too warm is told; so is the joint simulation, whose thermal submodel has the
    readings' temperature."""
    made = baseline(to_record(hidden_plant(941, "none", days=40.0)), starts=1)
    submodel, kelvin = made.submodels[HYGRIC], 1.5
    wider = extended(submodel.base, [("thermometer_offset", {})])
    values = {**submodel.values, "thermometer_offset": kelvin}

    def humidity(base: Design, at: dict, record: Record) -> np.ndarray:
        return simulate(base, at, prepare_run(base, record)).relative_humidity[0]

    told = humidity(wider, values, submodel.record)
    air = submodel.record["cabinet_temperature"]
    cooler = submodel.record.replace_series(replace(air, value=air.value - kelvin))
    # the exchange goes with T, half a per cent of it
    assert told == pytest.approx(humidity(submodel.base, dict(submodel.values), cooler), rel=0.01)
    thermal = made.submodels[THERMAL]
    both = {**thermal.values, **values}
    joint, plain = merged([thermal.base, wider]), merged([thermal.base, submodel.base])
    ratio = humidity(joint, both, made.record) / humidity(plain, both, made.record)
    simulated = simulate(joint, both, prepare_run(joint, made.record)).temperature[0]
    expected = saturation_pressure_water(simulated) / saturation_pressure_water(simulated - kelvin)
    assert np.median(ratio) == pytest.approx(np.median(expected), rel=0.005)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([(-0.245, 0.0, 0.462)], True),
        ([(0.1, 0.0, 0.462)], False),
        ([(-0.2, 0.0, 0.5), (1.0, math.nan, 2.0)], True),
        ([(-0.2, 0.0, 0.5), (-0.9, 0.0, -0.1)], False),
        ([(math.nan, 0.0, 0.5)], False),
        ([(1.0, math.nan, 2.0)], False),
        ([], False),
    ],
)
def test_a_cause_is_vague_where_no_amplitude_leaves_nothing_out(rows: list[tuple], said: bool) -> None:
    """The house: a scale that goes off by 0.11, bounds −0.25 to 0.46, and 2 ln L that pays for it."""
    table = {str(i): CauseParameter(1.0, "K", lower=a, upper=c, null=b) for i, (a, b, c) in enumerate(rows)}
    assert evidence.vague(table) is said


def test_the_score_statistic_knows_what_priors_know() -> None:
    """An ordinary offset that the base has anyway would take up all of a larger one: 2 ln L 118 were promised
    as 10⁸."""
    made = baseline(to_record(hidden_plant(942, "temperature_sensor_offset", form=0, days=40.0)), starts=1)
    constant = named("temperature_sensor_offset").variants(made)[1]
    found = attempt(made, constant)
    assert constant.form == "constant" and found.lr > 15.0
    assert score_statistic(made, constant) == pytest.approx(found.lr, rel=0.5)


@pytest.mark.parametrize(
    ("event", "once", "low", "said"),
    [
        (False, False, 0.2, ()),
        (False, False, -0.2, ("VAGUE",)),
        (True, False, 0.2, ("EVENT",)),
        (True, True, -0.2, ("ONCE", "VAGUE")),
    ],
)
def test_what_is_said_against_a_cause(event: bool, once: bool, low: float, said: tuple[str, ...]) -> None:
    parameters = {"size": CauseParameter(0.3, "K", lower=low, upper=0.5, null=0.0)}
    found = evidence.reservations(event, once, parameters)
    assert found == tuple(getattr(evidence, name) for name in said)
