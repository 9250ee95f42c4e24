"""Every measured file drafted: no signal in the wrong column, the case read without an edit."""

from __future__ import annotations

import pytest
from builders.measured import measured
from builders.measured_exports import EXPECTED, counts, export_of

from hygrokf.cases.case_file import read_case
from hygrokf.drafting.draft import draft_case

ROWS = 3500
"""Of each file, to be quick: weeks to months."""


def signals_of(draft):
    return {one.signal: (one.column, bool(one.doubts)) for one in draft.signals if one.active}


@measured
@pytest.mark.parametrize("name", EXPECTED)
def test_no_signal_of_a_measured_file_is_mistaken(name, tmp_path):
    draft = draft_case([export_of(name, tmp_path, ROWS)], tmp_path / "case.toml")
    found = counts(signals_of(draft), EXPECTED[name])
    assert (found.wrong, found.missed) == (0, 0), signals_of(draft)
    record = read_case(tmp_path / "case.toml", cabinet=False, ambient=False)
    assert len(record.series) >= len(EXPECTED[name])


@measured
def test_layouts_of_the_sources_give_the_records_of_the_tidied_files(tmp_path):
    pairs = (
        ("controller, as in its source", "turbine_controller_cabinet_660kW_10min_2013.csv.gz"),
        ("sister turbine, as in its source", "two_sister_turbines_2MW_10min_2016.csv.gz"),
    )
    for number, pair in enumerate(pairs):
        means = []
        for name in pair:
            out = tmp_path / f"{number}{len(means)}.toml"
            draft_case([export_of(name, tmp_path, ROWS)], out)
            record = read_case(out, cabinet=False)
            window = record.window(record.start_s, record.start_s + 10 * 86400.0)
            means.append({one.signal: float(one.value[~one.missing].mean()) for one in window.series})
        assert means[0] == pytest.approx(means[1], rel=1e-9)
