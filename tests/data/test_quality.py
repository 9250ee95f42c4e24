"""Marks of quality: each vocabulary by its own standard, numbers that contradict, columns by their names."""

from __future__ import annotations

import pickle
from decimal import Decimal

import numpy as np
import pandas as pd
import pytest

from hygrokf.data.quality import (
    UNSTATED_VOCABULARY,
    VOCABULARIES,
    StatedQuality,
    fitting,
    misfit,
    quality_columns,
    stated_vocabulary,
    unstated,
)

DA, UA, WORDS = VOCABULARIES["opc-da"], VOCABULARIES["opc-ua"], VOCABULARIES["words"]
SYMBOLS = {
    "Good": "good", "GoodClamped": "good", "Bad_SensorFailure": "bad", "Uncertain [EngUnits]": "uncertain",
    "TRUE": "good", True: "good", np.False_: "bad", "questionable": "uncertain", "??": "ambiguous",
}  # fmt: skip


@pytest.mark.parametrize(
    ("vocabulary", "outcomes"),
    [
        # quality in bits 7 and 6; substatus, limits and a maker's byte change nothing
        (DA, {192: "good", 216: "good", 195: "good", 0xAAC0: "good", 64: "uncertain", 84: "uncertain",
              0: "bad", 24: "bad", 0x80: "bad"}),
        (UA, {0: "good", 0x00A60000: "good", 0x40900000: "uncertain", 0x80340000: "bad", -2144075776: "bad",
              0xC0000000: "bad", "0x80340000": "bad"}),
        (WORDS, {1: "good", 0: "bad", 2: "ambiguous"}),
        (stated_vocabulary([100, "A"]), {100: "good", "a": "good", 0: "bad", "Good": "bad", 192: "bad"}),
        (UNSTATED_VOCABULARY, {192: "good", 216: "good", 24: "bad", 64: "uncertain", 0x80340000: "bad",
                    0: "ambiguous", 1: "ambiguous", 100: "ambiguous", 0.97: "ambiguous"}),
    ],
    ids=["opc-da", "opc-ua", "words", "list", "unstated"],
)  # fmt: skip
def test_outcomes(vocabulary, outcomes) -> None:
    kinds = (lambda one: one, float, str, lambda one: f" {float(one)!r} ", Decimal, np.float64)
    for mark, outcome in outcomes.items():
        for kind in kinds if isinstance(mark, int) else (lambda one: one, str):
            assert vocabulary.judge(kind(mark)) == outcome, (mark, kind)
    for nothing in (None, "", " ", float("nan"), "NaN", "null", pd.NA, pd.NaT):
        assert vocabulary.judge(nothing) == "good"
    if vocabulary.name in ("", *VOCABULARIES):
        assert {one: vocabulary.judge(one) for one in SYMBOLS} == SYMBOLS
    assert pickle.loads(pickle.dumps(vocabulary)).judge(0) == vocabulary.judge(0)


def test_a_column_s_whole_evidence_tells_its_vocabulary() -> None:
    assert fitting([0, 192, 24, 216]) == fitting(["192.0", 0.0]) == ("opc-da",)
    assert fitting([0, 0x80340000]) == fitting([0]) == ("opc-ua",)
    assert fitting([0, 1]) == fitting([1, "Good"]) == ("words",)
    assert fitting([0, 100]) == fitting(["Good", "Bad"]) == fitting([24]) == ()
    for stated, marks in (
        (UNSTATED_VOCABULARY, [192, 24]),
        (DA, [0, 192]),
        (UNSTATED_VOCABULARY, ["Good", "Bad"]),
    ):
        assert misfit(stated, marks) is None
    assert (
        'state vocabulary = "opc-da", which fits 0, 24, 192' in misfit(UNSTATED_VOCABULARY, [192, 0, 24]).text
    )
    assert '"opc-da"' in misfit(UA, [0, 192]).text and "[1]" in misfit(UNSTATED_VOCABULARY, [0, 100]).text
    assert misfit(stated_vocabulary([100]), [0, 100]) is None


@pytest.mark.parametrize("wrong", ["opc", "", 192, [], None, True])
def test_an_unknown_vocabulary_is_refused(wrong) -> None:
    with pytest.raises(ValueError, match='expected one of "opc-da", "opc-ua", "words" or a list'):
        stated_vocabulary(wrong)


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ("time,Cab Temp [°C],Cab Temp Quality,Amb,Amb_Quality Code", {"Cab Temp [°C]": "Cab Temp Quality",
                                                                      "Amb": "Amb_Quality Code"}),
        ("time,W01.Tcab,W01.Tcab.q,q_RH,RH", {"W01.Tcab": "W01.Tcab.q", "RH": "q_RH"}),
        ("time,T,T_ok,RH,RH status", {"T": "T_ok", "RH": "RH status"}),
        ("time,T,RH,quality", {"T": "quality", "RH": "quality"}),
        ("time,T,Quality,RH,Quality (2)", {"T": "Quality", "RH": "Quality (2)"}),
        ("time,温度,温度质量", {"温度": "温度质量"}),
        ("time,Converter status,Converter power,T", {}),
        ("id,v,q,t", {"v": "q"}),
    ],
)  # fmt: skip
def test_columns_of_quality_by_their_names(names: str, found: dict[str, str]) -> None:
    header = names.split(",")
    columns = [one for one in header if one in found or one in ("T", "Converter power")]
    assert quality_columns(header, columns) == found


def test_what_nobody_stated_is_a_doubt_unless_it_is_no_quality() -> None:
    assert 'quality = "T q"' in unstated("T", "T q", [192, 24]).text
    assert "vocabulary" not in unstated("T", "q", [24]).text
    assert 'vocabulary = "opc-da"' in unstated("T", "T q", [192, 0]).text
    assert "list the good marks" in unstated("T", "T quality", [1, 2, 3]).text
    # nothing to leave out; the state of a machine; specific humidity; an empty column
    for marks in ([192, "Good"], ["run", "stop"], [0.0031, 0.0042], []):
        assert unstated("T", "T q", marks) is None


def test_readings_are_judged_and_counted() -> None:
    marks = pd.Series([192, "64", None, 0.0, "Bad"], dtype=object)
    for stated, usable in (
        (StatedQuality({"T": "q"}, DA), [1, 1, 1, 0, 0]),
        (StatedQuality({"T": "q"}, DA, use_uncertain=False), [1, 0, 1, 0, 0]),
        (StatedQuality({"T": "q"}), [1, 1, 1, 0, 0]),
        (StatedQuality(), [1, 1, 1, 1, 1]),
    ):
        found = stated.judged("T", "q", marks)
        assert found.usable.tolist() == [bool(one) for one in usable]
        assert bool(found.doubt) is (stated.vocabulary is UNSTATED_VOCABULARY)
    (said,) = StatedQuality({"T": "q"}).judged("T", "q", marks).warnings
    assert said.endswith("1 bad left out, 1 uncertain used, 1 ambiguous left out")
