"""Columns side by side: root mean squares, differences on common instants, and the command."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.comparison_case import HOUR, made_column
from builders.record_edits import without

from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.commands.compare_commands import labels_of, pairs_of
from hygrokf.commands.console import UserFault
from hygrokf.commands.main import main
from hygrokf.data.record import Record
from hygrokf.data.result_file import ResultFault
from hygrokf.identification.fit import Fit, write_fit
from hygrokf.identification.fit_on_record import evaluate
from hygrokf.identification.identify import identify
from hygrokf.report.blocks import Cards
from hygrokf.report.comparison_page import (
    comparison_blocks,
    read_comparison,
    scores_table,
    summary,
    write_comparison,
)
from hygrokf.report.figures.comparison_figures import short_labels
from hygrokf.report.page import page_html
from hygrokf.report.terminal import page_text
from hygrokf.texts.transfer_codes import TransferCode
from hygrokf.transfer.comparison import (
    ComparisonResults,
    ErrorRow,
    compare,
    comparison_column,
)


def test_scores_are_plain_root_mean_squares() -> None:
    one, two = made_column("a", 1), made_column("b", 2, scale=1.15)
    found = compare([one, two])
    on = one.course.operating
    for period, mask in one.masks.items():
        for regime, chosen in (("operation", on), ("standstill", ~on), ("total", True)):
            error = one.errors["temperature_K"]
            part = error[mask & chosen & np.isfinite(error)]
            row = found.row("rmse", "a", period, "temperature_K", regime)
            assert row.n == len(part) and row.value == pytest.approx(np.sqrt(np.mean(part**2)))
    total, other = found.errors("whole", "temperature_K").values()
    assert total.lower < total.value < total.upper
    skill = found.row("skill", "a", "whole", "temperature_K", against="no_dynamics")
    assert skill.value == pytest.approx(0.75)
    row = difference(found)
    assert row.value == pytest.approx(total.value - other.value) and row.sure
    # the errors go together: the difference is known far better than either error
    assert row.upper < 0 and row.upper - row.lower < 0.8 * (total.upper - total.lower)
    assert row.same_readings


def difference(found: ComparisonResults) -> ErrorRow:
    return found.row("difference", "a", "whole", "temperature_K", against="b")


def test_only_common_instants_are_compared_and_other_readings_are_reported() -> None:
    one, late = made_column("a", 1), made_column("b", 2, shift_s=600 * HOUR)
    row = difference(compare([one, late]))
    a, b = one.errors["temperature_K"][600:], late.errors["temperature_K"][:600]
    there = np.isfinite(a) & np.isfinite(b)
    assert row.n == there.sum()
    assert row.value == pytest.approx(np.sqrt(np.mean(a[there] ** 2)) - np.sqrt(np.mean(b[there] ** 2)))
    assert compare([one, made_column("b", 2, shift_s=0.5 * HOUR)]).pairs == []
    assert not difference(compare([one, made_column("b", 2, readings=2)])).same_readings


def test_columns_that_cannot_be_told_apart_or_scored_are_refused() -> None:
    with pytest.raises(ValueError, match="several called a"):
        compare([made_column("a", 1), made_column("a", 2)])
    empty = replace(made_column("a", 1), errors={}, rules={})
    with pytest.raises(ValueError, match="nothing to score"):
        compare([empty])


def test_the_table_holds_every_number_of_the_json(tmp_path) -> None:
    columns = [made_column("a", 1), made_column("b", 2, scale=1.15)]
    found = compare(columns)
    write_comparison(found, tmp_path, columns)
    text = (tmp_path / "compare.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(io.StringIO(text)))
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
    total = found.errors("whole", "temperature_K")["a"]
    assert float(row["value"]) == pytest.approx(total.value, rel=1e-5) and int(row["n"]) == total.n
    assert len(found.to_frame()) == len(rows)
    assert found.to_frame().value.tolist() == pytest.approx([float(row["value"]) for row in rows], rel=1e-5)
    table = scores_table(found, "temperature_K")
    assert table.rows[0][:2] == ("a", "whole") and table.rows[0][4] == f"{total.value:.2f}"
    assert table.heading in page_text(comparison_blocks(found))


def test_page_is_written_again_from_the_files(tmp_path: Path) -> None:
    columns = [made_column("<a>", 1), made_column("b", 2, scale=1.4)]
    page = write_comparison(compare(columns), tmp_path, columns).read_text(encoding="utf-8")
    assert "&lt;a&gt; errs by" in page and page.count("<svg") == 4
    assert write_comparison(None, tmp_path).read_text(encoding="utf-8") == page
    assert page_html(comparison_blocks(*read_comparison(tmp_path))) == page
    (tmp_path / "compare.npz").unlink()  # as in results of earlier versions
    assert write_comparison(None, tmp_path).read_text(encoding="utf-8").count("<svg") == 3
    (tmp_path / "compare.json").write_text("{}")
    with pytest.raises(ResultFault, match="run it again"):
        write_comparison(None, tmp_path)


def test_the_answer_is_the_column_that_errs_least() -> None:
    found = compare([made_column("a", 1, scale=1.4), made_column("b", 2), made_column("c", 3, scale=2.0)])
    (cards,) = (block for block in comparison_blocks(found).lead if isinstance(block, Cards))
    (card,) = cards.cards
    best = found.errors("validation", "temperature_K")["b"]
    assert card.value == f"b: {best.value:.2f} K" and len(card.lines) == 2
    assert all("b errs by" in line for line in card.lines)


def test_long_labels_are_cut_but_told_apart() -> None:
    same = "the turbine in the far north-east corner, "
    assert short_labels(["short", f"{same}as it is"])[0] == "short"
    cut = short_labels([f"{same}as it is", f"{same}without its power", f"{same}x{same}", f"{same}y{same}"])
    assert len(set(cut)) == 4 and all(len(one) <= 33 for one in cut)


def test_combinations_of_cases_and_fits() -> None:
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


def test_a_column_has_the_scores_of_evaluate(turbines: tuple[Path, Path, Fit]) -> None:
    from hygrokf.cases.case_file import read_case

    record: Record = read_case(turbines[1])
    found = compare([comparison_column(turbines[2], record, "x")])
    theirs = evaluate(turbines[2], record)
    for period in ("identification", "validation"):
        for quantity in ("temperature_K", "absolute_humidity_g_m3"):
            for regime in ("operation", "standstill", "total"):
                ours = found.row("rmse", "x", period, quantity, regime)
                errors = theirs.rmse[period][quantity]
                assert ours.value == pytest.approx(getattr(errors, regime), nan_ok=True)
                assert ours.n == getattr(errors.n, regime)


def test_a_column_without_a_score_says_why(turbines: tuple[Path, Path, Fit]) -> None:
    from hygrokf.cases.case_file import read_case

    record: Record = read_case(turbines[1])
    idle = without(record, "active_power")
    columns = [comparison_column(turbines[2], one, name) for one, name in ((record, "a"), (idle, "b"))]
    found = compare(columns)
    assert TransferCode.NOTHING_TO_SCORE() in found.columns[1].statements
    assert list(found.errors("whole", "temperature_K")) == ["a"]
    assert "b: Nothing to score" in page_text(comparison_blocks(found))


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
    assert {p.name for p in (tmp_path / "c").iterdir()} == {
        "compare.json", "compare.csv", "compare.npz", "report.html"
    }  # fmt: skip
    assert main(["report", str(tmp_path / "c")]) == 0
    assert main(["transfer", str(fit), str(second), "--out", str(tmp_path / "t")]) == 0
    said = capsys.readouterr().out
    assert "synthetic-turbine-21 on synthetic-turbine-22" in said and "\nsynthetic-turbine-22: " in said
    assert (tmp_path / "t" / "synthetic-turbine-22" / "fit.json").is_file()
    assert main(["report", str(tmp_path / "t")]) == 0
    # mistakes of the user's: one line, no traceback, nothing written
    assert main(["compare", str(first), "--fit", str(fit), "--out", str(tmp_path / "x")]) == 2
    assert "at least two columns" in capsys.readouterr().err
    assert main(["transfer", str(tmp_path / "none.json"), str(second), "--out", str(tmp_path / "x")]) == 2
    assert "no such file" in capsys.readouterr().err and not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("validation", "whole", "expected"),
    [
        ((-0.5, 0.2), (-0.4, 0.1), [("one errs by 0.50 K less than other in validation", "0.30 … 0.70")]),
        ((0.3, None), (-0.4, 0.5), [
            ("other errs by 0.30 K less than one in validation", "not enough data"),
            ("one errs by 0.40 K less than other over the whole record", "include zero"),
        ]),
        (None, (0.1, None), [("other errs by 0.10 K less than one", "not enough data")]),
        (None, (0.001, None), [("one and other differ by less than 0.01 K", "not enough data")]),
        (None, None, [("no common instants",)]),
    ],
)  # fmt: skip
def test_the_summary_tells_sure_differences_from_others(
    validation, whole, expected: list[tuple[str, ...]]
) -> None:
    """Validation alone where it has bounds; where it is too short for them, the whole record beside it."""
    rows = []
    for period, row in (("validation", validation), ("whole", whole)):
        if row is not None:
            value, reach = row
            ends = () if reach is None else (value - reach, value + reach)
            place = ("one", "other", "temperature_K", period, "total")
            rows.append(ErrorRow("difference", *place, 100, value, *ends))
    columns = compare([made_column("one", 1), made_column("other", 2)]).columns
    said = summary(ComparisonResults("", "", False, columns, tuple(rows)), "temperature_K", "one")
    assert len(said) == len(expected)
    assert all(part in line for line, parts in zip(said, expected, strict=True) for part in parts)
