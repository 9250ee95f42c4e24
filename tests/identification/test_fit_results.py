"""The results of a fit as data: files of earlier revisions, faults with their places, copies, tables."""

from __future__ import annotations

import json
import lzma
import pickle
from pathlib import Path

import numpy as np
import pytest

from hygrokf.data.result_file import ResultFault
from hygrokf.data.structured import StructureFault, plain, structured
from hygrokf.identification.fit import Fit, read_fit
from hygrokf.identification.fit_results import FitResults, TimeConstant
from hygrokf.texts.reasons import WORDS

GOLDEN = Path(__file__).parents[1] / "golden" / "references"
MADE = [("demo", "fit/fit.json"), ("discovery", "out/fit.json"), ("uk", "fit/fit.json")]


def golden(name: str, file: str) -> dict:
    """The data of a fit as an earlier revision wrote them."""
    return json.loads(lzma.decompress((GOLDEN / f"{name}.json.xz").read_bytes()))["json"][file]


@pytest.mark.parametrize(("name", "file"), MADE)
def test_a_file_of_an_earlier_revision_is_read_and_written_alike(name: str, file: str) -> None:
    data = golden(name, file)
    assert json.loads(json.dumps(plain(structured(FitResults, data)))) == data


def test_a_damaged_file_is_refused_with_every_fault_and_its_place(tmp_path: Path) -> None:
    data = golden(*MADE[0])
    data["time_constants"]["thermal"]["value_h"] = "long"
    data["parameters"]["hygric_k"]["fixed"] = 1
    data["time_constants"]["hygric"]["curve"] = [[1.0, 2.0, 3.0]]
    (tmp_path / "fit.json").write_text(json.dumps(data))
    with pytest.raises(ResultFault) as fault:
        read_fit(tmp_path)
    for words in (
        "time_constants.thermal.value_h: expected a number, found 'long'",
        "parameters.hygric_k.fixed: expected true or false, found 1",
        "time_constants.hygric: curve: expected pairs of numbers",
        f"it states {data['version']}",
    ):
        assert words in str(fault.value)


def test_a_fit_is_copied_between_processes_and_says_its_verdicts() -> None:
    fit = Fit.from_json(golden(*MADE[0]))
    assert fit.design.model.outputs  # a model that was made does not stand in the way
    again = pickle.loads(pickle.dumps(fit))
    assert again.design.model is fit.design.model
    assert again.to_json() == fit.to_json() and again.values == fit.values
    first, *numbers, last = repr(again).splitlines()
    assert first == fit.name and len(numbers) == len(fit.results.time_constants)
    assert last.startswith(f"ln L {fit.results.loglik:.2f} of {fit.results.n_obs} readings")
    frame = fit.to_frame()
    for part, constant in fit.results.time_constants.items():
        ends = [constant.value_h, constant.lower_h, constant.upper_h]
        assert list(frame.loc[part]) == [*ends, WORDS[constant.verdict]]
    assert "lower bound [h]" in fit._repr_html_() and frame.loc["thermal", "verdict"] in fit._repr_html_()


def test_the_table_of_parameters_is_a_data_frame() -> None:
    results = structured(FitResults, golden(*MADE[0]))
    frame = results.to_frame()
    assert list(frame.index) == list(results.parameters)
    assert frame.loc["hygric_k", "value"] == results.parameters["hygric_k"].value


def test_a_curve_is_pairs_or_nothing() -> None:
    assert structured(TimeConstant, {"curve": []}).curve.shape == (0, 2)
    with pytest.raises(StructureFault, match="expected pairs of numbers"):
        structured(TimeConstant, {"curve": [1.0, 2.0]})
    np.testing.assert_array_equal(structured(TimeConstant, {"curve": [[1.0, 2.0]]}).curve, [[1.0, 2.0]])
