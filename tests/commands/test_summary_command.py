"""`hygrokf summary` from the command line."""

from __future__ import annotations

import json

from builders.command_line import run

FILES = ["summary.html", "summary.pdf"]


def test_a_fit_is_summarised_beside_its_files_and_elsewhere(folder):
    said = run("summary result")
    assert (said.status, said.out.splitlines(), said.err) == (0, ["result/summary.html"], "")
    page = (folder / "result/summary.html").read_bytes()
    said = run("summary result/fit.json --out page --pdf --json")
    assert json.loads(said.out) == {"summaries": [f"page/{name}" for name in FILES]}
    assert (folder / "page/summary.html").read_bytes() == page


def test_what_is_no_result_is_told_at_once_and_nothing_is_written(folder):
    said = run("summary result case.toml absent --out page")
    assert said.status == 2 and said.out == "" and "Traceback" not in said.err
    assert "case.toml: expected fit.json" in said.err and "absent: expected fit.json" in said.err
    assert not (folder / "page").exists()


def test_a_damaged_result_leaves_no_files(folder):
    (folder / "result/series.npz").write_bytes(b"damaged")
    said = run("summary result")
    assert said.status == 2 and "series.npz" in said.err
    assert not any((folder / "result" / name).exists() for name in FILES)
