"""Transfers between simulated cabinets: the right verdict, the adapted model, and the objections in words.

The plants share no code with the package.  `scripts/validate transfer` does the same on many more pairs
(docs/validation/coverage.md).
"""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.fit_case import with_parts
from builders.record_edits import without
from builders.transfer_pairs import Pair, changed, pair, record_of
from plants.plant import plant

from hygrokf.data.record import Record
from hygrokf.data.structured import plain
from hygrokf.evaluation.simulation import free_run
from hygrokf.identification.fit import Fit, read_fit, write_fit
from hygrokf.identification.fit_on_record import evaluate
from hygrokf.identification.identify import identify
from hygrokf.identification.turbine_type import pool_types
from hygrokf.report.blocks import Cards
from hygrokf.report.terminal import page_text
from hygrokf.report.transfer_page import (
    folders,
    rewrite_transfer,
    transfer_blocks,
    write_transfer,
)
from hygrokf.texts.transfer_codes import TransferCode, TransferVerdict
from hygrokf.transfer.baseline import HEAT_GROUP, HYGRIC_GROUP, THERMAL_GROUP
from hygrokf.transfer.transfer_fit import transfer_fit
from hygrokf.transfer.transfer_results import Reduction, Structure, Transfer, TransferResult, transfer_results
from hygrokf.transfer.transferability import with_verdict

DAYS, HELD_OUT = 36.0, 9.0
SEED = 31_000


@pytest.fixture(scope="module")
def origin() -> Fit:
    return identify(record_of(SEED, None, DAYS, HELD_OUT, "ou"), starts=1, profiles=False)


def sister(differ: tuple[str, ...], seed: int = SEED + 1) -> Record:
    """A turbine with weather, operation and loggers of its own, whose cabinet differs in these groups
    alone."""
    cabinet = changed(plant(SEED, days=2.0).cabinet, differ, np.random.default_rng([SEED, 3]), least=1.5)
    return record_of(seed, cabinet, DAYS, HELD_OUT, "ou")


@pytest.fixture(scope="module")
def other(origin: Fit) -> Transfer:
    """The one pair whose own fits are made: the heat release differs."""
    return transfer_fit(origin, sister((HEAT_GROUP,)))


@pytest.mark.parametrize(
    "differ", [(), (THERMAL_GROUP,), (HYGRIC_GROUP,), (THERMAL_GROUP, HEAT_GROUP, HYGRIC_GROUP)]
)
def test_the_verdict_is_right(origin: Fit, differ: tuple[str, ...]) -> None:
    record = sister(differ)
    found = transfer_fit(origin, record, fits=False)
    verdict, names = Pair(record, record, differ).right
    assert str(found.verdict) == verdict and sorted(found.results.re_estimate) == sorted(names)
    outcomes = {row.group: row.outcome for row in found.results.groups}
    assert {g for g, said in outcomes.items() if said == "differs"} == set(differ)
    assert outcomes["sensor offsets"] == outcomes["disturbances"] == "own"


def test_re_estimating_gains_where_something_differs(other: Transfer) -> None:
    assert other.results.verdict is TransferVerdict.PARTLY
    assert other.results.statement == TransferCode.PARTLY_BY_GROUPS(groups=(HEAT_GROUP,))
    rows = other.results.rmse["temperature_K"]
    assert rows["re_estimated"].total < 0.7 * rows["as_is"].total
    gain = other.results.gains["temperature_K"]["re_estimated"]["over_as_is"]
    assert 0.0 < gain.lower < gain.gain < gain.upper
    assert gain.gain == pytest.approx(rows["as_is"].total - rows["re_estimated"].total)
    ratios = other.results.likelihood_ratios
    assert ratios[0].p < 1e-6
    assert ratios[0].parameters == tuple(n for n in other.results.parameters if n.startswith("heat_release"))


def test_the_model_as_it_is_has_the_scores_of_evaluate(origin: Fit, other: Transfer) -> None:
    """The same free run as `hygrokf evaluate`, on the instants that all columns score."""
    record = sister((HEAT_GROUP,))
    theirs = evaluate(origin, record).rmse["validation"]["temperature_K"]
    ours = other.results.rmse["temperature_K"]["as_is"]
    assert ours.n.total == theirs.n.total and ours.total == pytest.approx(theirs.total, rel=1e-9)


def test_the_adapted_fit_keeps_shared_parameters_and_can_be_used(
    origin: Fit, other: Transfer, tmp_path: Path
) -> None:
    made = other.adapted
    assert made.values["thermal_time_constant"] == origin.values["thermal_time_constant"]
    assert made.values["hygric_k"] == origin.values["hygric_k"]
    assert made.values["heat_release_operation"] != origin.values["heat_release_operation"]
    names, matrix = made.covariance
    old_names, old = origin.covariance
    i, j = names.index("thermal_time_constant"), old_names.index("thermal_time_constant")
    assert matrix[i, i] == pytest.approx(old[j, j])
    assert np.linalg.eigvalsh(matrix).min() > -1e-9
    write_fit(made, tmp_path)
    again = read_fit(tmp_path)
    assert again.values == pytest.approx(dict(made.values))
    rows = again.to_json()["parameters"]
    assert rows["hygric_k"]["fixed"] and not rows["heat_release_operation"]["fixed"]
    assert again.to_json()["time_constants"]["thermal"]["method"] == "taken over"


def test_a_type_takes_the_place_of_a_fit(origin: Fit, other: Transfer) -> None:
    third = identify(sister((), SEED + 2), starts=1, profiles=False)
    made = pool_types([origin, third, other.own])
    found = transfer_fit(made, sister((), SEED + 3), fits=False)
    assert found.results.source.kind == "type" and found.verdict is TransferVerdict.TRANSFERS
    assert found.results.structure == {}  # a type has no record of its own to be compared with
    helped = identify(
        sister((), SEED + 3).window(0.0, sister((), SEED + 3).start_s + 6 * 86400.0),
        starts=1,
        profiles=False,
        prior=made.prior,
    )
    row = helped.to_json()["parameters"]["thermal_time_constant"]
    prior = made.prior()["thermal_time_constant"]
    assert row["prior"]["mean"] == pytest.approx(np.exp(prior.mean))
    assert row["se"] / row["value"] < 1.05 * prior.sd


def test_without_until_a_quarter_is_held_out_and_another_rated_power_is_reported(origin: Fit) -> None:
    record = replace(sister(()), until_s=None, rated_power_W=3e6)
    found = transfer_fit(origin, record, fits=False).results
    codes = [one.code for one in found.statements]
    assert TransferCode.NO_UNTIL in codes and len(codes) == 2
    assert any("times that of the fit" in str(one) for one in found.statements)
    assert found.period == "validation"


def test_parameters_that_a_record_does_not_determine_are_kept(origin: Fit) -> None:
    """No humidity in the cabinet: nothing is said about the hygric exchange."""
    record = sister(())
    dry = without(record, "cabinet_relative_humidity")
    found = transfer_fit(origin, dry, fits=False).results
    (names,) = (one.values["names"] for one in found.statements if one.code is TransferCode.NO_INFORMATION)
    assert "hygric_k" in names
    assert {row.group: row.outcome for row in found.groups}[HYGRIC_GROUP] == "not judged"
    assert found.parameters["hygric_k"].kept and "absolute_humidity_g_m3" not in found.rmse
    assert found.verdict is TransferVerdict.TRANSFERS


def with_gain(found: TransferResult, **gains: Reduction) -> TransferResult:
    """A result with other gains of the re-estimated temperature."""
    rows = dict(found.gains["temperature_K"])
    rows["re_estimated"] = {**rows["re_estimated"], **gains}
    return replace(found, gains={**found.gains, "temperature_K": rows})


@pytest.mark.parametrize(
    ("spoil", "code", "values"),
    [
        (lambda one: replace(one, at_bounds=("hygric_k",)), TransferCode.ENDED_AT_LIMIT,
         {"names": ("hygric_k",)}),
        (lambda one: with_gain(one, over_rule=Reduction("no_dynamics", -1.0, -1.5, -0.4)),
         TransferCode.RULE_BETTER, {"excess": 1.0}),
        (lambda one: replace(one, structure={"temperature_K": Structure(4.0, 1.5, 2.7, 2.2)}),
         TransferCode.STRUCTURE_LACKS, {"error": 4.0, "ratio": 2.7}),
        (lambda one: with_gain(one, over_as_is=Reduction("as_is", -3.0, -5.0, -1.0)),
         TransferCode.WORSE_RE_ESTIMATED, {"excess": 3.0, "unit": "K"}),
        (lambda one: replace(one, re_estimate=(THERMAL_GROUP, HEAT_GROUP, HYGRIC_GROUP)),
         TransferCode.ALL_GROUPS_DIFFER, {"groups": (THERMAL_GROUP, HEAT_GROUP, HYGRIC_GROUP)}),
    ],
)  # fmt: skip
def test_objections_to_a_transfer_are_named(
    other: Transfer, spoil: Callable[[TransferResult], TransferResult], code: TransferCode, values: dict
) -> None:
    assert with_verdict(other.results) == other.results
    found = with_verdict(spoil(other.results))
    assert found.verdict is TransferVerdict.DOES_NOT_TRANSFER and found.reasons[0].code is code
    assert values.items() <= found.reasons[0].values.items()


def test_a_record_that_can_judge_nothing_is_refused(origin: Fit) -> None:
    record = sister(())
    idle = without(record, "active_power")
    with pytest.raises(ValueError, match="needs the power"):
        transfer_fit(origin, idle, fits=False)
    with pytest.raises(ValueError, match="at least 50 readings in the identification period, found"):
        transfer_fit(origin, replace(record, until_s=record.start_s + 3 * 3600.0), fits=False)


def test_a_short_record_excludes_little_of_the_heat_release(origin: Fit) -> None:
    """An estimate that would matter and lies within its bounds is no proof that the heat release is the
    same."""
    record = sister(()).window(0.0, sister(()).start_s + 4 * 86400.0)
    rows = transfer_fit(origin, replace(record, until_s=None), fits=False).results.groups
    row = next(row for row in rows if row.group == HEAT_GROUP)
    assert row.outcome == "travels" and row.effect["temperature_K"] > 0.3
    assert row.statement == TransferCode.GROUP_OPEN()


def test_the_fits_own_record_and_a_types_own_turbine_are_reported(origin: Fit) -> None:
    record = replace(sister(()), files=(("cabinet.csv", "a" * 64),))
    made = with_parts(origin, files=[["elsewhere/cabinet.csv", "a" * 64]])
    statements = transfer_fit(made, record, fits=False).results.statements
    assert TransferCode.SAME_FILES() in statements
    kind = pool_types([replace(origin, name="one"), replace(origin, name=record.name)])
    known = {name: row for name, row in kind.parameters.items() if name != "hygric_k"}
    found = transfer_fit(replace(kind, parameters=known), record, fits=False).results
    assert TransferCode.ONE_OF_THE_TYPE(record=record.name) in found.statements
    # a start value is no knowledge of the type
    assert TransferCode.UNKNOWN_TO_THE_TYPE(names=("hygric_k",)) in found.statements
    assert found.parameters["hygric_k"].difference is None and found.verdict is TransferVerdict.TRANSFERS


def test_a_plant_that_the_model_cannot_describe_does_not_transfer(origin: Fit) -> None:
    """Ten times the disturbance: even its own estimate errs far more than the fit did at home."""
    record = sister(())
    warm = record["cabinet_temperature"]
    random = np.random.default_rng(9)
    drift = np.cumsum(random.standard_normal(len(warm.value)))
    drift = 5.0 * (drift - drift.mean()) / drift.std()
    found = transfer_fit(origin, record.replace_series(replace(warm, value=warm.value + drift)), fits=False)
    assert found.verdict is TransferVerdict.DOES_NOT_TRANSFER
    assert any(one.code is TransferCode.STRUCTURE_LACKS for one in found.results.reasons)


def test_results_page_and_text(other: Transfer, origin: Fit, tmp_path: Path) -> None:
    kind = pool_types([origin, replace(other.own, name="other")])
    page = write_transfer([other], tmp_path, kind)
    text = page.read_text(encoding="utf-8")
    blocks = transfer_blocks(transfer_results([other], kind), [other.course])
    (cards,) = (block for block in blocks.lead if isinstance(block, Cards))
    assert cards.cards[0].value == "Transfers after re-estimating heat release."
    assert cards.cards[0].value in text and "The type of turbine" in text
    assert text.count("<svg") == 4 and "nan" not in text.lower().replace("finance", "")
    data = json.loads((tmp_path / "transfer.json").read_text(encoding="utf-8"))
    assert data["records"][0]["verdict"] == "partly" and data["type"]["turbines"] == [
        origin.name,
        "other",
    ]
    name = folders([other.results.name])
    assert folders(["a b", "a b", "ä"]) == ["a-b", "a-b-2", "record"]
    assert all((tmp_path / one / "fit.json").is_file() for one in name) and (tmp_path / "type.json").is_file()
    assert rewrite_transfer(tmp_path).read_text(encoding="utf-8") == text
    said = page_text(transfer_blocks(transfer_results([other], kind)))
    assert "Transfers after re-estimating heat release" in said and "2 turbines" in said
    assert plain(pickle.loads(pickle.dumps(replace(other, adapted=None, own=None))).results) == plain(
        other.results
    )


def test_the_free_run_of_all_sets_is_in_the_series(other: Transfer) -> None:
    """What is shown is what was scored."""
    course = other.course
    late = (course.time_s > course.until_s) & course.scored
    simulation = course.simulated["re_estimated"]["temperature_K"]
    error = course.measured["temperature_K"] - simulation
    error = error[late & np.isfinite(error)]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(
        other.results.rmse["temperature_K"]["re_estimated"].total
    )
    from hygrokf.modelling.inputs import model_inputs

    record = sister((HEAT_GROUP,))
    again = free_run(
        other.adapted.design, other.adapted.values, model_inputs(other.adapted.design, record)
    ).temperature[0]
    np.testing.assert_allclose(again, simulation, rtol=1e-9)


def test_a_record_too_short_to_judge_has_no_verdict(origin: Fit) -> None:
    """Two days, of which nothing is held out, on which a rule without a model does better: no verdict."""
    made = pair(3, differ=(), days=30.0)
    begin = made.second.start_s
    short = replace(made.second.window(begin, begin + 2 * 86400.0), until_s=None)
    found = transfer_fit(origin, short, fits=False).results
    for rows in found.gains.values():
        assert math.isnan(rows["re_estimated"]["over_rule"].upper)
    found = replace(found, re_estimate=())
    worse = with_verdict(with_gain(found, over_rule=Reduction("no_dynamics", -0.5)))
    assert worse.verdict is TransferVerdict.CANNOT_BE_JUDGED
    assert worse.reasons[0].code is TransferCode.RULE_BETTER_UNBOUNDED
    better = with_gain(found, over_rule=Reduction("no_dynamics", 0.5))
    all_better = all(rows["re_estimated"]["over_rule"].gain > 0 for rows in better.gains.values())
    assert (with_verdict(better).verdict is TransferVerdict.TRANSFERS) == all_better


@pytest.mark.slow
def test_right_verdicts_on_many_pairs() -> None:
    """At least nine of ten, on seeds of their own; docs/validation/coverage.md has more."""
    right = 0
    for seed in range(600, 624):
        made = pair(seed)
        found = transfer_fit(identify(made.first, starts=1, profiles=False), made.second, fits=False).results
        word, names = made.right
        right += str(found.verdict) == word and sorted(found.re_estimate) == sorted(names)
    assert right >= 22
