"""Columns of quality in exports: found by name and marks, written with the vocabulary that fits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from builders.vendor_exports import TIMES, TRUTH

from hygrokf.cases.case_file import read_case
from hygrokf.drafting.draft import Draft, draft_case

BAD = [5, 40, 41]


def export(
    folder: Path, header: str, row: str, good: object, bad: object, stamp: str = "%Y-%m-%d %H:%M"
) -> Path:
    """An export whose rows `BAD` hold zeros of bad quality."""
    lines = [header]
    for number, moment in enumerate(TIMES):
        wrong = number in BAD
        values = {key: "0" if wrong else f"{TRUTH[key][number]:g}" for key in ("cabinet_temperature",)}
        outside = f"{TRUTH['ambient_temperature'][number]:g}"
        lines.append(
            row.format(time=f"{moment:{stamp}}", inside=values["cabinet_temperature"], outside=outside,
                       mark=bad if wrong else good, sound=good)
        )  # fmt: skip
    (folder / "export.csv").write_text("\n".join(lines) + "\n", "utf-8")
    return folder / "export.csv"


def doubts(draft: Draft) -> str:
    return " ".join(draft.doubts)


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("time,Cabinet Temp,Cabinet Temp Quality,Ambient Temp,Ambient Temp Quality",
         "{time},{inside},{mark},{outside},{sound}"),
        ("time,Cabinet Temp,Quality,Ambient Temp,Quality", "{time},{inside},{mark},{outside},{sound}"),
        ("time,tag,value,quality",
         "{time},Cabinet Temp,{inside},{mark}\n{time},Ambient Temp,{outside},{sound}"),
    ],
    ids=["named", "of one name", "one row a value"],
)  # fmt: skip
@pytest.mark.parametrize(
    ("good", "bad", "vocabulary"),
    [(192, 0, "opc-da"), (0, 0x80340000, "opc-ua"), ("Good", "Bad", None), (216, 24, "opc-da")],
)
def test_quality_is_found_and_its_vocabulary(
    header: str, row: str, good: object, bad: object, vocabulary: str | None, tmp_path: Path
) -> None:
    draft = draft_case([export(tmp_path, header, row, good, bad)], tmp_path / "case.toml")
    text = (tmp_path / "case.toml").read_text()
    assert (f'vocabulary = "{vocabulary}"' in text) is (vocabulary is not None)
    assert text.count(', quality = "') == 2 and "quality" not in doubts(draft)
    assert {one.signal for one in draft.signals} == {"cabinet_temperature", "ambient_temperature"}
    record = read_case(tmp_path / "case.toml")
    assert np.flatnonzero(record["cabinet_temperature"].missing).tolist() == BAD
    assert not record["ambient_temperature"].missing.any()


@pytest.mark.parametrize(("good", "bad", "words"), [(1, 0, '"words"'), (1, 3, "list the good marks")])
def test_what_the_marks_do_not_tell_is_a_doubt(good: int, bad: int, words: str, tmp_path: Path) -> None:
    row = "{time},{inside},{mark},{outside}"
    made = export(tmp_path, "time,Cabinet Temp,Cabinet Temp Quality,Ambient Temp", row, good, bad)
    assert words in doubts(draft_case([made], tmp_path / "case.toml"))
    assert any("doubt" in one for one in read_case(tmp_path / "case.toml").warnings)
