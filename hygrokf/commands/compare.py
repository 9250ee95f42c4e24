"""`hygrokf compare`: cases, models or ambient sources side by side."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

from hygrokf.commands.console import Progress, UserFault, expect_own_directory, show_reported
from hygrokf.commands.inputs import identified, record_of, stored_fit
from hygrokf.commands.verb import Verb, add_json, add_library, add_out
from hygrokf.data.files import COMPARISON


def _arguments(parser: ArgumentParser) -> None:
    parser.add_argument("cases", type=Path, nargs="+", metavar="CASE.toml", help="the case files")
    parser.add_argument(
        "--fit",
        type=Path,
        nargs="+",
        default=[],
        metavar="FIT.json",
        help="one fit for all cases, several fits for one case, or one fit per case; default: fit each case",
    )
    parser.add_argument(
        "--label",
        nargs="+",
        default=[],
        metavar="NAME",
        help="names of the columns (default: the names of the cases or fits)",
    )
    add_out(parser, "directory for compare.json, compare.csv and report.html")
    add_library(parser)
    add_json(parser)


def pairs_of(cases: Sequence[Path], fits: Sequence[Path]) -> list[tuple[Path, Path | None]]:
    """Pairs of case and fit to run; raises UserFault that lists the permitted combinations."""
    if not fits:
        return [(case, None) for case in cases]
    if len(fits) == 1:
        return [(case, fits[0]) for case in cases]
    if len(cases) == 1:
        return [(cases[0], fit) for fit in fits]
    if len(cases) == len(fits):
        return list(zip(cases, fits, strict=True))
    raise UserFault(
        "expected one fit for all cases, one case for all fits, as many fits as cases (the first on the "
        f"first, and so on), or no --fit; found {len(cases)} cases and {len(fits)} fits"
    )


def labels_of(given: Sequence[str], pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Names of columns: the given ones, or whatever distinguishes the (case, fit) pairs; numbered where
    nothing does."""
    if given:
        if len(given) != len(pairs):
            raise UserFault(f"--label: expected {len(pairs)} names, one a column, found {len(given)}")
        if not all(name.strip() for name in given):
            raise UserFault("--label: expected a name for each column, found an empty one")
        if len(set(given)) < len(given):
            raise UserFault(f"--label: expected names that differ, found {', '.join(given)}")
        return list(given)
    cases, fits = {case for case, _ in pairs}, {fit for _, fit in pairs}
    if len(cases) == len(pairs):
        found = [case for case, _ in pairs]
    elif len(fits) == len(pairs):
        found = [fit for _, fit in pairs]
    else:
        found = [f"{fit} on {case}" for case, fit in pairs]
    return [name if found.count(name) == 1 else f"{name} ({i + 1})" for i, name in enumerate(found)]


def _run(options: Namespace) -> int:
    from hygrokf.report.comparison_page import comparison_blocks, write_comparison
    from hygrokf.transfer.comparison import compare, comparison_column

    expect_own_directory(options.out, COMPARISON)
    pairs = pairs_of(options.cases, options.fit)
    if len(pairs) < 2:
        raise UserFault("expected at least two columns to compare: several cases, or several fits; found one")
    fits = {path: stored_fit(path, options.library) for path in options.fit}
    records = {case: record_of(case) for case in dict.fromkeys(case for case, _ in pairs)}
    alone = dict.fromkeys(case for case, path in pairs if path is None)
    own = {case: identified(records[case], case) for case in alone}
    chosen = [(records[case], own[case] if path is None else fits[path], case, path) for case, path in pairs]
    labels = labels_of(options.label, [(record.name, fit.name) for record, fit, _, _ in chosen])
    columns, faults = [], []
    for label, (record, fit, case, path) in zip(labels, chosen, strict=True):
        try:
            columns.append(comparison_column(fit, record, label, own=path is None))
        except ValueError as fault:
            faults.append(f"{case}: {fault}")
    if faults:
        raise UserFault("\n".join(faults))
    try:
        found = compare(columns)
    except ValueError as fault:
        raise UserFault(str(fault)) from fault
    with Progress(1) as progress:
        progress("draw the report")
        page = write_comparison(found, options.out)
    return show_reported(page, found.results, comparison_blocks(found.results), options.json)


VERB = Verb("compare", "put cases, models or ambient sources side by side, with bounds", _arguments, _run)
