"""A climate as a result: its file, its table, and files that are wrong."""

from __future__ import annotations

import copy
import csv
import json
import lzma
import math
import pickle
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.climate_case import study_of

from hygrokf.climate.limits import ClimateLimit
from hygrokf.climate.study import Study, climate_csv, profile_files, read_climate, write_climate
from hygrokf.data.result_file import ResultFault, result_text
from hygrokf.data.structured import StructureFault, plain, structured

GOLDEN = Path(__file__).resolve().parents[1] / "golden/references/uk.json.xz"
LIMITS = tuple(
    ClimateLimit("temperature_degC", above=level, name=name)
    for name, level in (("hot", 60.0), ("mild", 10.0))
)


@cache
def small() -> Study:
    return study_of(limits=LIMITS)


@cache
def golden() -> dict[str, Any]:
    return json.loads(lzma.open(GOLDEN).read())["json"]["climate/climate.json"]


def test_the_golden_file_is_read_and_written_alike() -> None:
    study = structured(Study, golden())
    data = plain(study)
    assert plain(structured(Study, data)) == data
    (region,) = study.regions
    assert region.year["wetness_h"].value == golden()["regions"][0]["scopes"]["all"]["wetness_h"]["value"]
    assert set(data["regions"][0]) == set(golden()["regions"][0]) and set(data) == set(golden())


def test_a_study_comes_back_from_its_file_and_from_a_pickle(tmp_path: Path) -> None:
    write_climate(small(), tmp_path)
    for again in (read_climate(tmp_path), pickle.loads(pickle.dumps(small()))):
        assert result_text(plain(again)) == result_text(plain(small()))
    assert repr(small()) == "Study('known cabinet': here; 3 members, seed 1)"


def test_the_table_has_every_number() -> None:
    (region,) = small().regions
    frame = small().to_frame()
    rows = list(csv.DictReader(climate_csv(small()).splitlines()))
    assert len(frame) == len(rows) == sum(map(len, region.scopes.values())) + 3 * len(LIMITS)
    mean = frame.loc[("here", "all", "mean_temperature_degC")]
    assert mean["value"] == region.year["mean_temperature_degC"].value
    assert mean["outside"] == region.outside["mean_temperature_degC"]
    assert frame.loc[("here", "limit", "mild: hours"), "lower"] == region.limits[1].hours.lower
    assert all(row["outside"] == "" for row in rows if row["scope"] != "all")


def test_profiles_of_several_regions_have_names_of_their_own() -> None:
    (name,) = profile_files(small())
    assert name == "test_profile.csv"
    data = plain(small())
    data["regions"] = [data["regions"][0] | {"name": one} for one in ("a b", "a/b", "—")]
    names = set(profile_files(structured(Study, data)))
    assert names == {"test_profile_a_b.csv", "test_profile_a_b_2.csv", "test_profile_3.csv"}


@pytest.mark.parametrize(
    ("path", "value", "place"),
    [
        (("members",), "many", "members"),
        (("regions",), [], "at least one region"),
        (("regions", 0, "scopes"), {}, "scopes.all"),
        (("regions", 0, "years"), [], "at least one year"),
        (("regions", 0, "limits", 1, "verdict"), "perhaps", "regions[0].limits[1].verdict"),
        (("regions", 0, "scopes", "all", "hours", "upper"), "x", "regions[0].scopes.all.hours.upper"),
        (("regions", 0, "duration", "temperature_degC", "lower"), [1.0], "regions[0].duration"),
        (("regions", 0, "joint", "upper"), [[1.0]], "regions[0].joint"),
        (("regions", 0, "test_profile", "site_temperature_degC"), [1.0], "regions[0].test_profile"),
    ],
)  # fmt: skip
def test_a_fault_of_a_file_names_its_place(path: tuple[str | int, ...], value: object, place: str) -> None:
    data = copy.deepcopy(plain(small()))
    inner: Any = data
    for step in path[:-1]:
        inner = inner[step]
    inner[path[-1]] = value
    with pytest.raises(StructureFault) as told:
        structured(Study, data)
    assert place in str(told.value) and len(told.value.faults) == 1


def test_all_faults_and_the_writer_of_a_file_are_told(tmp_path: Path) -> None:
    data = plain(small()) | {"version": "0.0.7", "members": "many", "seed": None}
    (tmp_path / "climate.json").write_text(json.dumps(data))
    with pytest.raises(ResultFault, match=r"written by hygrokf 0\.0\.7; run it again") as told:
        read_climate(tmp_path)
    assert "members: expected a whole number" in str(told.value) and "seed: " in str(told.value)


def test_numbers_that_are_not_known_are_null_in_the_file() -> None:
    data = plain(small())
    hours = data["regions"][0]["scopes"]["all"]["humidity_above_95_h"]
    assert None not in hours.values()
    never = [name for name, one in small().regions[0].year.items() if math.isnan(one.value)]
    assert all(data["regions"][0]["scopes"]["all"][name]["value"] is None for name in never)
    assert np.sum(small().regions[0].joint.hours) == pytest.approx(8766, rel=1e-3)
