"""`hygrokf compare`: cases, models or ambient sources side by side; `hygrokf transfer`: a model on other
turbines."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

from hygrokf.commands.console import (
    Progress,
    UserFault,
    expect_own_directory,
    faults_of,
    show_reported,
)
from hygrokf.commands.opening import case_fit, case_record, source_model, stored_fit
from hygrokf.commands.verb import Verb, add_json, add_library, add_out
from hygrokf.data import files
from hygrokf.errors import HygrokfError

TRANSFER_STEPS = 8
"""Number of progress messages of one transfer."""


def _compare_arguments(parser: ArgumentParser) -> None:
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
    """Return the pairs of case and fit (None: to be fitted) to run. Raises UserFault for numbers of cases and
    fits that do not match."""
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
    """Return the labels of columns: `given`, or the names of cases, fits or both, whichever are different for
    all (case, fit) pairs; equal labels are numbered. Raises UserFault."""
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
        names = [case for case, _ in pairs]
    elif len(fits) == len(pairs):
        names = [fit for _, fit in pairs]
    else:
        names = [f"{fit} on {case}" for case, fit in pairs]
    return [name if names.count(name) == 1 else f"{name} ({number + 1})" for number, name in enumerate(names)]


def _compare(options: Namespace) -> int:
    """Compare the free runs of the columns, write the files, and show the report."""
    from hygrokf.report.comparison_page import comparison_blocks, write_comparison
    from hygrokf.transfer.comparison import compare, comparison_column

    expect_own_directory(options.out, files.COMPARISON)
    pairs = pairs_of(options.cases, options.fit)
    if len(pairs) < 2:
        raise UserFault("expected at least two columns to compare: several cases, or several fits; found one")
    fits = {fit_path: stored_fit(fit_path, options.library) for fit_path in options.fit}
    records = {case: case_record(case) for case in dict.fromkeys(case for case, _ in pairs)}
    without_fit = dict.fromkeys(case for case, fit_path in pairs if fit_path is None)
    own_fits = {case: case_fit(records[case], case) for case in without_fit}
    inputs_of_columns = [
        (records[case], own_fits[case] if fit_path is None else fits[fit_path], case, fit_path)
        for case, fit_path in pairs
    ]
    labels = labels_of(options.label, [(record.name, fit.name) for record, fit, _, _ in inputs_of_columns])
    columns, faults = [], []
    for label, (record, fit, case, fit_path) in zip(labels, inputs_of_columns, strict=True):
        try:
            columns.append(comparison_column(fit, record, label, own=fit_path is None))
        except ValueError as fault:
            faults.append(f"{case}: {fault}")
    if faults:
        raise UserFault("\n".join(faults))
    try:
        comparison = compare(columns)
    except ValueError as fault:
        raise UserFault(str(fault)) from fault
    with Progress(1) as progress:
        progress("draw the report")
        page = write_comparison(comparison, options.out, columns)
    return show_reported(page, comparison, comparison_blocks(comparison), options.json)


COMPARE = Verb(
    "compare", "put cases, models or ambient sources side by side, with bounds", _compare_arguments, _compare
)


def _transfer_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("fit", type=Path, metavar="FIT.json|TYPE.json", help="fitted model or pooled type")
    parser.add_argument("cases", type=Path, nargs="+", metavar="CASE.toml", help="cases of other turbines")
    add_out(parser, "directory for transfer.json, report.html and the models")
    add_library(parser)
    add_json(parser)


def _transfer(options: Namespace) -> int:
    """Try a model on the records of other turbines, write the files, and show the report."""
    from hygrokf.identification.turbine_type import TurbineType, pool_types
    from hygrokf.report.transfer_page import transfer_blocks, write_transfer
    from hygrokf.transfer.transfer_fit import transfer_fit
    from hygrokf.transfer.transfer_results import transfer_results

    expect_own_directory(options.out, files.TRANSFER)
    source = source_model(options.fit, options.library)
    records = [case_record(case) for case in options.cases]
    transfers = []
    with Progress(TRANSFER_STEPS * len(records)) as progress:
        for case, record in zip(options.cases, records, strict=True):
            with faults_of(case):
                transfers.append(transfer_fit(source, record, progress))
    fits = [] if isinstance(source, TurbineType) else [source]
    fits += [transfer.own for transfer in transfers if transfer.own is not None]
    pooled, pooling_remark = None, ""
    if len(fits) > 2:
        try:
            pooled = pool_types(fits)
        except HygrokfError as fault:
            pooling_remark = f"\n\nno type of turbine was made: {fault}"
    with Progress(1) as progress:
        progress("draw the report")
        page = write_transfer(transfers, options.out, pooled)
        results = transfer_results(transfers, pooled)
    return show_reported(page, results, transfer_blocks(results), options.json, pooling_remark)


TRANSFER_VERB = Verb(
    "transfer",
    "try a fitted model on another turbine: which parameters carry over, which differ",
    _transfer_arguments,
    _transfer,
)
