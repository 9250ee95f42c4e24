"""Columns side by side: plain root mean squares, like compared with like, and what the command combines."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.commands.console import UserFault
from hygrokf.commands.main import main
from hygrokf.commands.transfer import labels_of, pairs_of
from hygrokf.data.record import Record
from hygrokf.identification.fit import Fit
from hygrokf.identification.procedure import identify
from hygrokf.identification.results import ResultFault, write_fit
from hygrokf.identification.tables import evaluate
from hygrokf.report.comparison_page import comparison_page, summary, write_comparison
from hygrokf.transfer.comparison import Column, compare, comparison_column, comparison_csv, comparison_text

HOUR = 3600.0


def made_column(
    label: str, seed: int, size: int = 1200, shift_s: float = 0.0, scale: float = 1.0, readings: int = 1
) -> Column:
    """A column of hourly errors that are drawn, not simulated."""
    random = np.random.default_rng([81, seed])
    time = HOUR * np.arange(size) + shift_s
    common = np.random.default_rng(82).standard_normal(size)
    error = scale * (common + 0.3 * random.standard_normal(size))
    operating = (np.arange(size) // 50) % 3 > 0
    error[::13] = np.nan
    late = np.arange(size) > 0.75 * size
    return Column(
        label, f"fit of {label}", "a case", False, time, operating,
        {"temperature_K": np.random.default_rng(readings).standard_normal(size)},
        {"temperature_K": error},
        {"temperature_K": {"no_dynamics": 2.0 * error}},
        {"identification": ~late, "validation": late, "whole": np.ones(size, bool)},
        (), False,
    )  # fmt: skip


def test_scores_are_plain_root_mean_squares() -> None:
    one, two = made_column("a", 1), made_column("b", 2, scale=1.15)
    found = compare([one, two]).results
    for period, mask in one.masks.items():
        for regime, chosen in (("operation", one.operating), ("standstill", ~one.operating), ("total", True)):
            error = one.errors["temperature_K"]
            part = error[mask & chosen & np.isfinite(error)]
            row = found["columns"][0]["scores"][period]["temperature_K"][regime]
            assert row["n"] == len(part) and row["rmse"] == pytest.approx(np.sqrt(np.mean(part**2)))
    total = found["columns"][0]["scores"]["whole"]["temperature_K"]["total"]
    assert total["lower"] < total["rmse"] < total["upper"]
    assert total["rules"]["no_dynamics"]["skill"] == pytest.approx(0.75)
    row = found["differences"][0]["scores"]["whole"]["temperature_K"]["total"]
    both = found["columns"][1]["scores"]["whole"]["temperature_K"]["total"]["rmse"]
    assert row["value"] == pytest.approx(total["rmse"] - both)
    # the errors go together: the difference is known far better than either error
    assert row["upper"] < 0 and row["upper"] - row["lower"] < 0.8 * (total["upper"] - total["lower"])
    assert found["differences"][0]["same_readings"] == {"temperature_K": True}


def test_only_common_instants_are_compared_and_other_readings_are_told() -> None:
    one, late = made_column("a", 1), made_column("b", 2, shift_s=600 * HOUR)
    row = compare([one, late]).results["differences"][0]["scores"]["whole"]["temperature_K"]["total"]
    a, b = one.errors["temperature_K"][600:], late.errors["temperature_K"][:600]
    there = np.isfinite(a) & np.isfinite(b)
    assert row["n"] == there.sum()
    assert row["value"] == pytest.approx(np.sqrt(np.mean(a[there] ** 2)) - np.sqrt(np.mean(b[there] ** 2)))
    apart = compare([one, made_column("b", 2, shift_s=0.5 * HOUR)]).results["differences"][0]
    assert apart["same_readings"] == {} and apart["scores"]["whole"] == {}
    other = compare([one, made_column("b", 2, readings=2)]).results["differences"][0]
    assert other["same_readings"] == {"temperature_K": False}


def test_columns_that_cannot_be_told_apart_or_scored_are_refused() -> None:
    with pytest.raises(ValueError, match="several called a"):
        compare([made_column("a", 1), made_column("a", 2)])
    empty = replace(made_column("a", 1), errors={}, rules={})
    with pytest.raises(ValueError, match="nothing to score"):
        compare([empty])


def test_the_table_holds_every_number_of_the_json() -> None:
    found = compare([made_column("a", 1), made_column("b", 2, scale=1.15)]).results
    rows = list(csv.DictReader(io.StringIO(comparison_csv(found))))
    kinds = [row["kind"] for row in rows]
    # two columns, three periods, three regimes
    assert (
        kinds.count("rmse") == kinds.count("rule") == kinds.count("skill") == 18
        and kinds.count("difference") == 9
    )
    row = next(
        r
        for r in rows
        if (r["kind"], r["column"], r["period"], r["regime"]) == ("rmse", "a", "whole", "total")
    )
    total = found["columns"][0]["scores"]["whole"]["temperature_K"]["total"]
    assert float(row["value"]) == pytest.approx(total["rmse"], rel=1e-5) and int(row["n"]) == total["n"]
    text = comparison_text(found)
    assert (
        "RMSE of the temperature [K], whole" in text and "a − b:" in text and f"{total['rmse']:.2f}" in text
    )


def test_page_is_written_again_from_the_json(tmp_path: Path) -> None:
    found = compare([made_column("<a>", 1), made_column("b", 2, scale=1.4)])
    page = write_comparison(found, tmp_path).read_text(encoding="utf-8")
    assert "&lt;a&gt; simulates the temperature" in page and page.count("<svg") == 3
    assert write_comparison(None, tmp_path).read_text(encoding="utf-8") == page
    assert comparison_page(json.loads((tmp_path / "compare.json").read_text(encoding="utf-8"))) == page
    (tmp_path / "compare.json").write_text("{}")
    with pytest.raises(ResultFault, match="run it again"):
        write_comparison(None, tmp_path)


def test_what_may_be_combined() -> None:
    a, b, f, g = (Path(name) for name in ("a.toml", "b.toml", "f.json", "g.json"))
    assert pairs_of([a, b], []) == [(a, None), (b, None)]
    assert pairs_of([a, b], [f]) == [(a, f), (b, f)]
    assert pairs_of([a], [f, g]) == [(a, f), (a, g)]
    assert pairs_of([a, b], [f, g]) == [(a, f), (b, g)]
    with pytest.raises(UserFault, match="found 3 cases and 2 fits"):
        pairs_of([a, b, b], [f, g])


def test_names_of_columns() -> None:
    assert labels_of([], [("a", "f"), ("b", "f")]) == ["a", "b"]
    assert labels_of([], [("a", "f"), ("a", "g")]) == ["f", "g"]
    assert labels_of([], [("a", "f"), ("a", "f")]) == ["f on a (1)", "f on a (2)"]
    assert labels_of(["x", "y"], [("a", "f"), ("a", "g")]) == ["x", "y"]
    for given, word in (
        (["x"], "expected 2 names"),
        (["x", "x"], "names that differ"),
        (["x", " "], "an empty one"),
    ):
        with pytest.raises(UserFault, match=word):
            labels_of(given, [("a", "f"), ("a", "g")])


@pytest.fixture(scope="module")
def turbines(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Fit]:
    """Two synthetic cases and the fit of the first."""
    from hygrokf.cases.case_file import read_case

    folder = tmp_path_factory.mktemp("turbines")
    paths = [write_case(synthetic_turbine(seed=seed, days=16.0), folder / str(seed)) for seed in (21, 22)]
    fit = identify(read_case(paths[0]), starts=1, profiles=False)
    write_fit(fit, folder / "fit")
    return paths[0], paths[1], fit


def test_a_column_is_what_evaluate_says(turbines: tuple[Path, Path, Fit]) -> None:
    from hygrokf.cases.case_file import read_case

    record: Record = read_case(turbines[1])
    found = compare([comparison_column(turbines[2], record, "x")]).results["columns"][0]["scores"]
    theirs = evaluate(turbines[2], record)
    for period in ("identification", "validation"):
        for quantity in ("temperature_K", "absolute_humidity_g_m3"):
            for regime in ("operation", "standstill", "total"):
                ours = found[period][quantity][regime]
                assert ours["rmse"] == pytest.approx(theirs["rmse"][period][quantity][regime], nan_ok=True)
                assert ours["n"] == theirs["rmse"][period][quantity]["n"][regime]


def test_a_column_without_a_score_says_why_and_long_names_stay_apart(
    turbines: tuple[Path, Path, Fit],
) -> None:
    from hygrokf.cases.case_file import read_case

    record: Record = read_case(turbines[1])
    idle = replace(record, series=tuple(one for one in record.series if one.signal != "active_power"))
    names = [
        f"the turbine in the far north-east corner, {name}" for name in ("as it is", "without its power")
    ]
    found = compare(
        [comparison_column(turbines[2], one, name) for one, name in zip((record, idle), names, strict=True)]
    )
    assert any("nothing to score" in said for said in found.results["columns"][1]["statements"])
    text = comparison_text(found.results)
    assert f"note: {names[1]}: nothing to score" in text
    assert f"\n{names[0]} " in text and "against heat release without heat storage: skill" in text


def test_compare_and_transfer_from_the_command_line(
    turbines: tuple[Path, Path, Fit], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, _ = turbines
    fit = first.parent.parent / "fit" / "fit.json"
    assert (
        main(["compare", str(first), str(second), "--fit", str(fit), "--out", str(tmp_path / "c"), "--json"])
        == 0
    )
    data = json.loads(capsys.readouterr().out)
    assert [one["case"] for one in data["columns"]] == ["synthetic-turbine-21", "synthetic-turbine-22"]
    assert {p.name for p in (tmp_path / "c").iterdir()} == {"compare.json", "compare.csv", "report.html"}
    assert main(["report", str(tmp_path / "c")]) == 0
    assert main(["transfer", str(fit), str(second), "--out", str(tmp_path / "t")]) == 0
    said = capsys.readouterr().out
    assert "synthetic-turbine-21 on synthetic-turbine-22:" in said
    assert (tmp_path / "t" / "synthetic-turbine-22" / "fit.json").is_file()
    assert main(["report", str(tmp_path / "t")]) == 0
    # mistakes of the user's: one line, no traceback, nothing written
    assert main(["compare", str(first), "--fit", str(fit), "--out", str(tmp_path / "x")]) == 2
    assert "at least two columns" in capsys.readouterr().err
    assert main(["transfer", str(tmp_path / "none.json"), str(second), "--out", str(tmp_path / "x")]) == 2
    assert "no such file" in capsys.readouterr().err and not (tmp_path / "x").exists()


def test_the_summary_says_what_is_sure() -> None:
    """Validation alone where it has bounds; where it is too short for them, the whole record beside it."""

    def row(value: float, reach: float | None) -> dict:
        ends = (
            {"lower": None, "upper": None}
            if reach is None
            else {"lower": value - reach, "upper": value + reach}
        )
        return {"total": {"value": value, "n": 100, **ends}}

    def said(validation: dict | None, whole: dict) -> list[str]:
        scores = {"whole": {"temperature_K": whole}}
        if validation is not None:
            scores["validation"] = {"temperature_K": validation}
        return summary({"differences": [{"of": "one", "less": "other", "scores": scores}]})

    assert said(row(-0.5, 0.2), row(-0.4, 0.1)) == [
        "One simulates the temperature in validation with 0.50 K less error than other (95 % 0.30 … 0.70)."
    ]
    both = said(row(0.3, None), row(-0.4, 0.5))
    assert both[0].startswith("Other simulates") and both[0].endswith("too few blocks for bounds.")
    assert "over the whole record" in both[1] and both[1].endswith("the bounds include no difference.")
    assert len(both) == 2 and len(said(None, row(0.1, None))) == 1
    assert summary({"differences": []})[0].startswith("The columns have no instants in common")
