"""Verdicts on time constants: the reason that each rule gives, and consistency between all statements."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace

import pytest
from builders.documents import document
from builders.fit_case import typed
from builders.report_case import report_case

from hygrokf.data.structured import StructureFault, plain, structured
from hygrokf.discovery.discover import WET_SENSOR
from hygrokf.identification.composition import CompositionStep
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import criteria_apart, inherited, with_reasons, with_verdicts
from hygrokf.identification.verdict_terms import Inherited, verdict_lines
from hygrokf.report.blocks import Cards
from hygrokf.report.fit_page import fit_blocks
from hygrokf.report.fit_text import judgements
from hygrokf.report.terminal import page_text
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.reasons import BELIEVE, CAUTION, REJECT, VERDICTS, WORDS, Reason, ReasonCode, verdict_of
from hygrokf.texts.record_codes import DoubtCode

PAGE = document("verdict.md")


def _sound() -> dict:
    """The least of a fit against which nothing speaks."""

    def constant(value: float) -> dict:
        ends = {"value_h": value, "lower_h": 0.95 * value, "upper_h": 1.05 * value}
        return {
            **ends,
            "factor": 1.2,
            "sampling": {"shift_ln_when_halved": 0.01, "ambient_step_h": 1 / 6},
            "simulation": {"value_h": 1.05 * value, "lower_h": 0.9 * value, "upper_h": 1.2 * value},
            "criteria_disagree": False,
        }

    def errors(kelvin: float, grams: float) -> dict:
        return {"temperature_K": {"total": kelvin}, "absolute_humidity_g_m3": {"total": grams}}

    def output() -> dict:
        return {
            "n": 6000,
            "step_h": 0.25,
            "autocorrelation": {"value": [0.02, -0.01], "limit_all": 0.04},
            "cross_correlation": {"power": {"value": [0.03, 0.01], "limit_all": 0.04}},
        }

    rules = {"no_dynamics": errors(1.8, math.nan), "ambient": errors(math.nan, 0.42)}
    return {
        "converged": True,
        "at_bounds": [],
        "period": {"start": "2020-01-01T00:00:00+00:00", "until": "2020-03-01T00:00:00+00:00"},
        "time_constants": {"thermal": constant(1.5), "hygric": constant(0.3)},
        "parameters": {
            "thermal_time_constant": {"value": 1.5, "fixed": False, "parts": ["thermal"]},
            "cabinet_temperature_bias": {
                "value": 0.1, "unit": "K", "fixed": False, "prior": {"mean": 0.0, "sd": 0.15},
                "parts": ["thermal"],
            },
            "hygric_k": {"value": 0.33, "fixed": False, "parts": ["hygric"]},
        },
        "rmse": {"identification": errors(1.4, 0.4), "validation": errors(1.5, 0.41)},
        "baselines": {"identification": rules, "validation": rules},
        "readings_sd": {
            period: {"temperature_K": 6.0, "absolute_humidity_g_m3": 2.0}
            for period in ("identification", "validation")
        },
        "bands": {"free_run": {q: {"coverage": 0.94, "n": 500} for q in errors(0.0, 0.0)}},
        "innovations": {
            "outputs": {"temperature": output(), "humidity": output()},
            "tests": [
                {"output": name, "test": test, "input": source, "rejected": False}
                for name in ("temperature", "humidity")
                for test, source in (("autocorrelation", ""), ("correlation", "power"), ("mean", ""))
            ],
        },
    }  # fmt: skip


def _put(path: str, value: object) -> Callable[[dict], None]:
    def change(fit: dict) -> None:
        *parts, last = path.split("/")
        at = fit
        for part in parts:
            at = at.setdefault(part, {})
        at[last] = value

    return change


def _all(*changes: Callable[[dict], None]) -> Callable[[dict], None]:
    def change(fit: dict) -> None:
        for one in changes:
            one(fit)

    return change


THERMAL = "time_constants/thermal"
SIMULATION = f"{THERMAL}/simulation"


def _correlated(value: float) -> Callable[[dict], None]:
    def change(fit: dict) -> None:
        fit["innovations"]["outputs"]["temperature"]["cross_correlation"]["power"]["value"] = [value]
        for row in fit["innovations"]["tests"]:
            row["rejected"] = (row["output"], row["test"]) == ("temperature", "correlation")

    return change


def _errors(kelvin: float, *periods: str) -> Callable[[dict], None]:
    return _all(*(_put(f"rmse/{period}/temperature_K/total", kelvin) for period in periods))


BOTH = ("identification", "validation")
SILENT = _put(SIMULATION, {"value_h": 0.02, "lower_h": 0.0, "upper_h": None})
CASES = {
    "not_converged": (_put("converged", False), REJECT, "did not converge"),
    "not_exact": (_put("discretisation_error", 0.02), REJECT, "not exact"),
    "convergence_unknown": (_put("converged", None), CAUTION, "not stated"),
    "at_limit": (_put("at_bounds", ["thermal_time_constant"]), REJECT, "limit of the search, 1.50 h"),
    "input_not_needed": (
        _put(
            "time_constants/thermal/without_input",
            {"model": plain(FitCode.CONSTANT_INPUTS()), "gain": -3.0, "required": 28.0},
        ),
        REJECT,
        "explains them better, by 3",
    ),
    "not_identifiable": (
        _all(_put(f"{THERMAL}/lower_h", 0.0), _put(f"{THERMAL}/upper_h", None)), REJECT, "neither side",
    ),
    "one_sided": (_put(f"{THERMAL}/lower_h", 0.0), CAUTION, "from above only (≤ 1.58 h)"),
    "imprecise": (_put(f"{THERMAL}/upper_h", 3.0), CAUTION, "±52 % only"),
    "undetermined": (
        _all(_put(f"{THERMAL}/lower_h", 0.3), _put(f"{THERMAL}/upper_h", 4.8)), REJECT,
        "a factor of 4.0",
    ),
    "criteria_disagree": (
        _all(
            _put(f"{THERMAL}/criteria_disagree", True),
            _put(SIMULATION, {"value_h": 15.0, "lower_h": 14.0, "upper_h": 16.0}),
        ),
        REJECT,
        "one-step predictions say 1.50 h, the free run says 15.0 h (14.0",
    ),
    "free_run_silent": (SILENT, CAUTION, "(0.0200 h, without bounds)"),
    "worse_than_mean": (_errors(7.0, *BOTH), REJECT,
        "7.00 K in validation, more than the standard deviation of the readings (6.00 K)"),
    "worse_than_rule": (
        _all(_errors(2.5, *BOTH), SILENT), REJECT,
        "errs by 2.50 K in validation, the rule “heat release without heat",
    ),
    "band_failed": (_put("bands/free_run/temperature_K/coverage", 0.31), CAUTION, "holds only 31 %"),
    "innovations_correlated": (_correlated(-0.4), CAUTION, "correlated with the power, by up to 0.40"),
    "noise_not_as_modelled": (_put(f"{THERMAL}/factor", 3.2), CAUTION, "3.2 times"),
    "ambient_coarse": (_put(f"{THERMAL}/sampling/shift_ln_when_halved", -0.3), CAUTION, "changes by −26 %"),
    "readings_coarse": (_put("innovations/outputs/temperature/step_h", 4.0), CAUTION,
        "every 240 min; by then 93 %"),
    "few_readings": (_put("innovations/outputs/temperature/n", 39), CAUTION,
        "39 readings determine 2 parameters"),
    "record_short": (_put("period/until", "2020-01-02T00:00:00+00:00"), CAUTION, "is 16 time constants long"),
    "sensor_stretched": (_put("parameters/cabinet_temperature_bias/value", -1.2), CAUTION,
        "−1.20 K, 8.0 standard"),
    "guard_reached": (_put("parameters/cabinet_temperature_bias/at_guard", True), CAUTION,
        "bias ended at a limit"),
    "record_doubted": (_put("doubts", [plain(DoubtCode.POWER_NEGATIVE(share=0.9))]), CAUTION,
        "is negative for 90 % of its readings"),
    "forms_differ": (
        _put(f"{THERMAL}/forms", [{"form": "two masses", "weight": 0.3, "value_h": 2.0}]), CAUTION,
        "two masses, weight 30 %",
    ),
    "parts_differ": (
        _put(f"{THERMAL}/parts_scatter", 2.6), CAUTION,
        "scatter 2.6 times as much",
    ),
}  # fmt: skip


def spoilt(*changes: Callable[[dict], None]) -> dict:
    """A sound fit after these changes."""
    fit = _sound()
    _all(*changes)(fit)
    return fit


def decided(fit: dict) -> dict[str, Inherited]:
    return inherited(typed(fit))


# --- the rules -------------------------------------------------------------------------------


def test_a_sound_fit_is_believed() -> None:
    found = decided(_sound())
    assert {part: (one.verdict, one.reasons) for part, one in found.items()} == {
        "thermal": (BELIEVE, ()), "hygric": (BELIEVE, ()),
    }  # fmt: skip
    assert found["thermal"].sentence == "reliable"


@pytest.mark.parametrize("code", CASES)
def test_each_rule_gives_its_reason_and_no_other(code: str) -> None:
    change, verdict, words = CASES[code]
    fit = spoilt(change)
    found = decided(fit)
    others = {"worse_than_rule": {"free_run_silent"}, "worse_than_mean": {"worse_than_rule"}}.get(code, set())
    assert {one.code.key for one in found["thermal"].reasons} - others == {code}
    reason = next(one for one in found["thermal"].reasons if one.code.key == code)
    assert reason.verdict == verdict == found["thermal"].verdict
    assert words in reason.text
    whole = code in ("not_converged", "convergence_unknown", "not_exact", "record_short")
    assert {one.code.key for one in found["hygric"].reasons} == (
        {code} if whole and code != "record_short" else set()
    )


def test_the_docs_name_every_reason() -> None:
    rows = re.findall(
        r"^\| `(\w+)` \| (\w+)", PAGE.read_text(encoding="utf-8").partition("## The reasons")[2], re.M
    )
    assert [code for code, _ in rows] == list(dict.fromkeys(code for code, _ in rows))
    # a discovery's own reason is none of a fit's
    assert {code for code, _ in rows} == {*CASES, WET_SENSOR.code.key}
    assert {verdict for _, verdict in rows} <= set(VERDICTS)


def test_the_worst_reason_decides_and_stands_first() -> None:
    fit = spoilt(CASES["imprecise"][0], CASES["not_converged"][0])
    found = decided(fit)["thermal"]
    assert found.verdict == REJECT
    assert [one.verdict for one in found.reasons] == [REJECT, CAUTION]
    assert found.sentence == "not reliable: the estimation did not converge (1 more reason)"


@pytest.mark.parametrize(
    ("simulated", "verdict"), [(1.9, CAUTION), (2.6, REJECT), (0.9, REJECT), (1.15, CAUTION)]
)
def test_criteria_that_contradict_reject_and_those_that_differ_a_little_warn(
    simulated: float, verdict: str
) -> None:
    fit = _sound()
    ends = {"value_h": simulated, "lower_h": 0.85 * simulated, "upper_h": simulated / 0.85}
    _put(SIMULATION, ends)(fit)
    _put(f"{THERMAL}/criteria_disagree", True)(fit)
    found = decided(fit)["thermal"]
    assert found.verdict == verdict
    # the distance by hand: both half-widths on the logarithm, in quadrature
    reach = math.hypot(math.log(1 / 0.85), 0.5 * math.log(1.05 / 0.95))
    apart = abs(math.log(simulated / 1.5)) / reach
    assert found.reasons[0].values["apart"] == pytest.approx(apart)
    assert (apart > 2.0) == (verdict == REJECT)


def test_a_contradiction_that_the_interval_holds_only_warns() -> None:
    fit = spoilt(CASES["criteria_disagree"][0])
    profile = {key: fit["time_constants"]["thermal"][key] for key in ("lower_h", "upper_h")}
    _put(f"{THERMAL}/composition", [{"source": "profile", **profile}])(fit)
    _put(SIMULATION, {"value_h": 2.6, "lower_h": 2.4, "upper_h": 2.8})(fit)
    assert decided(fit)["thermal"].verdict == REJECT
    _all(_put(f"{THERMAL}/lower_h", 0.8), _put(f"{THERMAL}/upper_h", 2.8))(fit)
    found = decided(fit)["thermal"]
    assert found.verdict == CAUTION and found.reasons[0].values["half_width"] > 0.25
    assert {one.code.key for one in found.reasons} == {"imprecise", "criteria_disagree"}


def test_the_plain_profile_is_held_against_the_free_run_where_the_headline_is_wider() -> None:
    data = typed(_sound()).time_constants["thermal"]
    narrow = criteria_apart(data)
    wide = replace(data, lower_h=0.5, upper_h=4.0)
    assert criteria_apart(wide) < narrow
    profile = CompositionStep("profile", data.lower_h, data.upper_h)
    assert criteria_apart(replace(wide, composition=(profile,))) == pytest.approx(narrow)


def test_losing_to_a_rule_in_one_period_or_against_a_free_run_that_agrees_only_warns() -> None:
    for change in (_all(_errors(2.5, "validation"), SILENT), _errors(2.5, *BOTH)):
        fit = spoilt(change)
        found = {one.code.key: one for one in decided(fit)["thermal"].reasons}
        assert found["worse_than_rule"].verdict == CAUTION
    assert "its own best constant agrees" in found["worse_than_rule"].text
    fit = spoilt(_all(_errors(1.9, *BOTH), SILENT))  # by less than a tenth
    assert "worse_than_rule" not in {one.code.key for one in decided(fit)["thermal"].reasons}


def test_small_or_accidental_correlations_are_no_reason() -> None:
    for change in (
        _correlated(0.09),
        _put("innovations/outputs/temperature/cross_correlation/power/value", [0.4]),  # no test rejects
    ):
        fit = spoilt(change)
        assert decided(fit)["thermal"].verdict == BELIEVE


def test_a_shift_within_the_interval_or_below_a_tenth_is_no_reason() -> None:
    for shift, ends in ((0.09, (1.45, 1.55)), (0.2, (1.2, 1.86))):
        fit = spoilt(_put(f"{THERMAL}/sampling/shift_ln_when_halved", shift))
        _all(_put(f"{THERMAL}/lower_h", ends[0]), _put(f"{THERMAL}/upper_h", ends[1]))(fit)
        assert decided(fit)["thermal"].verdict == BELIEVE


def test_parameters_of_the_other_part_are_no_reason() -> None:
    fit = spoilt(CASES["sensor_stretched"][0])
    assert decided(fit)["hygric"].verdict == BELIEVE
    del fit["parameters"]["cabinet_temperature_bias"]["parts"]  # not stated: it may belong to both
    assert decided(fit)["hygric"].verdict == CAUTION


def test_the_simulation_criterion_is_judged_by_its_own_interval() -> None:
    fit = _sound()
    data = fit["time_constants"]["thermal"]
    likelihood = {key: data[key] for key in ("value_h", "lower_h", "upper_h")}
    data |= {**data["simulation"], "likelihood": likelihood}
    assert decided(fit)["thermal"].verdict == BELIEVE
    data |= {
        "lower_h": 0.0,
        "upper_h": None,
        "simulation": {"value_h": 0.02, "lower_h": 0.0, "upper_h": None},
    }
    assert [one.code.key for one in decided(fit)["thermal"].reasons] == ["not_identifiable"]


# --- as data ---------------------------------------------------------------------------------


def test_verdicts_survive_json() -> None:
    fit = _sound()
    for code in ("imprecise", "criteria_disagree"):
        CASES[code][0](fit)
    found = decided(fit)["thermal"]
    data = json.loads(json.dumps(plain(found), allow_nan=False))
    assert structured(Inherited, data) == found
    assert data["reasons"][0].keys() == {"code", "values", "verdict", "source"}
    assert data["reasons"][0]["values"].keys() >= {"simulation_h", "apart"}
    for faulty in (
        data | {"verdict": "perhaps"},
        data | {"reasons": [data["reasons"][0] | {"verdict": "x"}]},
    ):
        with pytest.raises(StructureFault, match="expected one of 'believe', 'caution', 'reject'"):
            structured(Inherited, faulty)
    for faulty in ({"code": "never_heard_of"}, {"values": {"likelihood_h": 1.0}}):
        with pytest.raises(StructureFault, match=r"expected (a code|values)"):
            structured(Inherited, data | {"reasons": [data["reasons"][0] | faulty]})
    unbounded = ReasonCode.ONE_SIDED(side="above", sign="≤", bound_h=math.inf)
    assert plain(unbounded)["values"]["bound_h"] is None
    assert structured(Reason, plain(unbounded)).text == unbounded.text


def test_stated_verdicts_stay_and_missing_ones_are_decided() -> None:
    data = _sound()
    CASES["imprecise"][0](data)
    fit = typed(data)
    filled = with_verdicts(fit)
    assert fit.time_constants["thermal"].verdict is None  # nothing is changed in place
    assert filled.time_constants["thermal"].verdict == CAUTION
    assert (filled.time_constants["hygric"].verdict, filled.time_constants["hygric"].reasons) == (BELIEVE, ())
    stated = ReasonCode.RECORD_DOUBTED(REJECT, doubt="its clock")
    _put(f"{THERMAL}/verdict", REJECT)(data)
    _put(f"{THERMAL}/reasons", [plain(stated)])(data)
    kept = inherited(typed(data))["thermal"]
    assert (kept.verdict, kept.reasons) == (REJECT, (stated,))
    again = with_verdicts(filled)
    assert plain(again) == plain(filled)
    assert inherited(FitResults()) == {} and with_verdicts(FitResults(name="a")).name == "a"


def test_further_reasons_are_added_once() -> None:
    fit = with_verdicts(typed(_sound()))
    further = ReasonCode.BAND_FAILED(REJECT, coverage=0.1, quantity="temperature")
    wider = with_reasons(with_reasons(fit, "thermal", [further]), "thermal", [further])
    assert {part: (one.verdict, one.reasons) for part, one in inherited(wider).items()} == {
        "thermal": (REJECT, (further,)), "hygric": (BELIEVE, ()),
    }  # fmt: skip
    assert plain(with_reasons(FitResults(), "thermal", [further])) == plain(FitResults())


def test_a_fit_of_an_older_version_is_judged_when_it_is_read(tmp_path) -> None:
    from hygrokf import identify, read_case, read_fit, synthetic_turbine, write_case, write_fit

    fit = identify(
        read_case(write_case(synthetic_turbine(seed=5, days=12), tmp_path)), starts=1, profiles=False
    )
    path = write_fit(fit, tmp_path)
    data = json.loads(path.read_text(encoding="utf-8"))
    stated = {part: data["time_constants"][part]["verdict"] for part in ("thermal", "hygric")}
    assert all(one in VERDICTS for one in stated.values())
    for part in stated:
        for key in ("verdict", "reasons"):
            del data["time_constants"][part][key]
    path.write_text(json.dumps(data), encoding="utf-8")
    again = read_fit(path)
    assert {part: again.results.time_constants[part].verdict for part in stated} == stated
    assert Fit.from_json(again.to_json()).to_json() == again.to_json()


def test_an_inherited_verdict_is_one_line() -> None:
    fit = spoilt(CASES["not_converged"][0])
    fit["time_constants"]["hygric"] |= {"verdict": BELIEVE, "reasons": []}
    fit["time_constants"]["thermal"] |= plain(decided(fit)["thermal"])
    handed = inherited(typed(fit))
    assert handed["thermal"].value_h == 1.5 and handed["hygric"].verdict == BELIEVE
    assert verdict_lines(handed) == [
        "x thermal time constant, not reliable: the estimation did not converge – 1.50 h (1.42 … 1.58)",
        "+ hygric time constant 0.300 h (0.285 … 0.315): reliable",
    ]
    assert verdict_lines({}) == []
    open_ = Inherited(9.0, 0.0, math.nan, REJECT)
    assert verdict_lines({"thermal": open_}) == [
        "x thermal time constant, not reliable – not identifiable (best 9.00 h)"
    ]


# --- no mark of belief beside a refutation ---------------------------------------------------


def _rejected() -> dict:
    fit, _ = report_case()
    fit["time_constants"]["thermal"]["simulation"] = {"value_h": 0.02, "lower_h": 0.0, "upper_h": None}
    for period in ("identification", "validation"):
        fit["rmse"][period]["temperature_K"]["total"] = (
            1.3 * fit["baselines"][period]["no_dynamics"]["temperature_K"]["total"]
        )
    return fit


@pytest.mark.parametrize("code", [None, *(code for code in CASES if not code.startswith("worse_than"))])
def test_nothing_is_believed_beside_its_refutation(code: str | None) -> None:
    """A subject is as reliable as the worst reason, and nothing speaks for one that is not."""
    fit = _rejected()
    if code is not None:
        CASES[code][0](fit)
    found = {one.about: one for one in judgements(typed(fit))}
    for one in found.values():
        assert one.verdict == verdict_of(one.reasons)
        assert len({why.verdict == BELIEVE for why in one.reasons}) < 2, one.about
    assert found["thermal"].verdict == found["temperature_K"].verdict == REJECT
    assert found["bands"].verdict == CAUTION


def test_a_number_that_is_not_to_be_believed_is_no_headline() -> None:
    cards = next(block for block in fit_blocks(typed(_rejected()), {}).lead if isinstance(block, Cards))
    thermal, hygric = cards.cards
    assert (thermal.kind, thermal.verdict) == (REJECT, WORDS[REJECT])
    assert (thermal.value, thermal.bounds) == ("1.45 h", "1.40 … 1.50, 95 %, all sources")
    assert (hygric.kind, hygric.value) == (CAUTION, "0.30 h")
    text = page_text(fit_blocks(typed(_rejected()), {}))
    first = text.split("\n\n")[1].splitlines()[0]
    assert first.startswith(
        "thermal time constant, not reliable: 1.45 h (1.40 … 1.50, 95 %, all sources). The free"
    )
