"""The frame of the claims: what stops goes on, what fails is counted, what is documented is what is run."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

import pytest
from builders.documents import document
from validation import frame
from validation.counts import Rate, markdown, rate

DOCS = document("index.md").parent


def made(seen: list[tuple], name: str = "coverage") -> frame.Claim:
    """A claim whose cases are noted; those of seed 13 raise, those of seed 14 need what is not there."""

    def one(variant: str, seed: int, *, days: float = 9.0) -> Mapping:
        if seed == 13:
            raise ValueError("nothing can be identified")
        if seed == 14:
            raise frame.Absent("../shared/data is not there")
        seen.append((variant, seed, days))
        return {"value": float("inf"), "held": seed != 15}

    return frame.Claim(name, {"a": range(2), "b": range(1, 3)}, one, lambda lines: f"{len(lines)} lines")


def test_a_run_goes_on_where_it_ended(tmp_path: Path) -> None:
    seen: list[tuple] = []
    claim, file = made(seen), tmp_path / "new" / "lines.jsonl"
    frame.run_into(file, claim, claim.chosen(["a", "b"]), claim.settings)
    assert seen == [("a", 0, 9.0), ("a", 1, 9.0), ("b", 1, 9.0), ("b", 2, 9.0)]
    with file.open("a") as out:
        out.write('{"key": "a:2", "va')  # cut off in writing
    frame.run_into(file, claim, claim.chosen(["a"], range(4)), claim.settings)
    assert seen[4:] == [("a", 2, 9.0), ("a", 3, 9.0)]
    lines = frame.read_lines([file])
    assert [line["key"] for line in lines] == ["a:0", "a:1", "b:1", "b:2", "a:2", "a:3"]
    assert all(line["value"] is None and line["sources"] == frame.sources_hash() for line in lines)
    with pytest.raises(SystemExit, match=r"holds lines of \{'days': 9.0\}: expected \{'days': 30.0\}"):
        frame.run_into(file, claim, claim.chosen(["a"]), {"days": 30.0})
    file.write_text('{"key"\n{"key": "a:5"}\n')
    with pytest.raises(SystemExit, match="line 1: expected JSON"):
        frame.read_lines([file])


def test_what_is_raised_is_a_line_and_what_is_absent_is_none(tmp_path: Path) -> None:
    claim, file = made([]), tmp_path / "lines.jsonl"
    absent = frame.run_into(file, claim, claim.chosen(["a"], range(12, 15)), claim.settings)
    assert absent == ["a:14: left out, ../shared/data is not there"]
    good, broken = frame.read_lines([file])
    assert good["failure"] is None and broken["failure"] == "ValueError: nothing can be identified"
    assert frame.printed(claim, [good, broken]) == "1 lines\na:13: ValueError: nothing can be identified"


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    seen: list[tuple] = []
    monkeypatch.setattr(frame, "claim_of", lambda name: made(seen))
    out = ["--out", str(tmp_path / "lines.jsonl")]
    assert frame.main(["coverage", "b", *out, "--days", "3"]) == 0
    assert seen == [("b", 1, 3.0), ("b", 2, 3.0)] and capsys.readouterr().out == "2 lines\n"
    assert frame.main(["coverage", "a", "--seeds", "15:16", *out]) == 1  # it did not hold
    assert frame.main(["coverage", "--table", str(tmp_path / "lines.jsonl")]) == 1
    assert len(seen) == 3
    with pytest.raises(SystemExit, match="no lines in"):
        frame.main(["coverage", "--table", "--out", str(tmp_path / "nowhere.jsonl")])
    with pytest.raises(SystemExit, match="a:14: left out"):
        frame.main(["coverage", "a", "--seeds", "14:15", "--out", str(tmp_path / "none.jsonl")])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("nothing", "nothing"),
        ("discovery nowhere", "found nowhere"),
        ("discovery nulls --seeds 5", "expected FIRST:LAST"),
        ("discovery nulls --docs", "no picture"),
    ],
)
def test_mistakes_are_told(words: str, said: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as ended:
        frame.main(words.split())
    assert ended.value.code == 2 and said in capsys.readouterr().err


@pytest.mark.parametrize("name", frame.CLAIMS)
def test_a_claim_is_on_the_page_that_it_names(name: str) -> None:
    claim = frame.claim_of(name)
    assert claim.name == name and all(len(seeds) for seeds in claim.seeds.values())
    first = next(iter(claim.seeds))
    keys = [frame.key_of(case) for case in claim.chosen([first])]
    assert keys and len(set(keys)) == len(keys)
    source = frame.import_module(f"validation.{name}")
    about = (
        (source.__doc__ or "") if name != "faults" else frame.import_module("validation.faults.suite").__doc__
    )
    pages = [page for page in DOCS.rglob("*.md") if f"/{page.name}" in about]
    assert any(f"scripts/validate {name}" in page.read_text(encoding="utf-8") for page in pages), about


def test_what_the_pages_call_is_there() -> None:
    for page in DOCS.rglob("*.md"):
        for name, words in re.findall(r"scripts/validate (\w+)([^`:\n]*)", page.read_text(encoding="utf-8")):
            assert name in frame.CLAIMS, (page.name, name)
            first = words.split(" --")[0].strip().strip('"')
            assert not first or first.split()[0] in " ".join(frame.claim_of(name).seeds), (page.name, words)


def test_counts_have_exact_bounds() -> None:
    assert Rate(0, 7).bounds == pytest.approx((0.0, 0.4096), abs=1e-4)  # Clopper and Pearson's table
    assert Rate(0, 0).share is None
    assert str(rate([True, True, False])) == "2/3 = 67 % (9 … 99)" and str(rate([])) == "0/0"
    assert markdown(("a", "b"), [(1, "x")]) == "| a | b |\n| --- | --- |\n| 1 | x |"


def test_numbers_become_those_of_json() -> None:
    import numpy as np

    value = {"a": np.arange(2), "b": (float("nan"), np.float64(1.5)), 3: np.True_}
    assert json.loads(json.dumps(frame.plain(value))) == {"a": [0, 1], "b": [None, 1.5], "3": True}
