"""`hygrokf compare` and `hygrokf transfer`: what they are asked, and how that is done."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hygrokf.commands.console import Progress, UserFault, expect_own_directory
from hygrokf.data.files import COMPARISON, TRANSFER

if TYPE_CHECKING:
    from hygrokf.data.record import Record
    from hygrokf.identification.fit import Fit

Read = Callable[[Path], Any]
STEPS = 8
"""Words of progress that a transfer tells."""


def compare_arguments(parser: argparse.ArgumentParser) -> None:
    """Cases and fits."""
    parser.add_argument("cases", type=Path, nargs="+", metavar="CASE.toml")
    parser.add_argument(
        "--fit",
        type=Path,
        nargs="+",
        default=[],
        metavar="FIT.json",
        help="one fit for all cases, several for one case, or one a case; none: each case is fitted first",
    )
    parser.add_argument(
        "--label",
        nargs="+",
        default=[],
        metavar="NAME",
        help="names of the columns (default: of cases or fits)",
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="directory for compare.json, compare.csv and report.html"
    )


def transfer_arguments(parser: argparse.ArgumentParser) -> None:
    """A fit or a type, and the cases that it is tried on."""
    parser.add_argument("fit", type=Path, metavar="FIT.json|TYPE.json")
    parser.add_argument("cases", type=Path, nargs="+", metavar="CASE.toml")
    parser.add_argument(
        "--out", type=Path, required=True, help="directory for transfer.json, report.html and the models"
    )


def pairs_of(cases: Sequence[Path], fits: Sequence[Path]) -> list[tuple[Path, Path | None]]:
    """Which fit is run on which case; raises UserFault that says what may be combined."""
    if not fits:
        return [(case, None) for case in cases]
    if len(fits) == 1:
        return [(case, fits[0]) for case in cases]
    if len(cases) == 1:
        return [(cases[0], fit) for fit in fits]
    if len(cases) == len(fits):
        return list(zip(cases, fits, strict=True))
    raise UserFault(
        f"expected one fit for all cases, one case for all fits, as many fits as cases (the first on the first, and so on), "
        f"or no --fit; found {len(cases)} cases and {len(fits)} fits"
    )


def labels_of(given: Sequence[str], pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Names of columns: those given, else what tells (case, fit) pairs apart; numbered where nothing does."""
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


def run_compare(
    options: argparse.Namespace, record_of: Read, stored: Read, identified: Callable[[Any, Path], Any]
) -> tuple[Path, dict, str]:
    """Do `hygrokf compare`: the page, its data, and the text for the terminal."""
    from hygrokf.report.comparison_page import write_comparison
    from hygrokf.transfer.comparison import compare, comparison_column, comparison_text

    expect_own_directory(options.out, COMPARISON)
    pairs = pairs_of(options.cases, options.fit)
    if len(pairs) < 2:
        raise UserFault("expected at least two columns to compare: several cases, or several fits; found one")
    fits: dict[Path, Fit] = {path: stored(path) for path in options.fit}
    records: dict[Path, Record] = {}
    for case, _ in pairs:
        if case not in records:
            records[case] = record_of(case)
    own: dict[Path, Fit] = {}
    for case, fit in pairs:
        if fit is None and case not in own:
            own[case] = identified(records[case], case)
    chosen = [(records[case], own[case] if fit is None else fits[fit], case, fit) for case, fit in pairs]
    labels = labels_of(options.label, [(record.name, fit.name) for record, fit, _, _ in chosen])
    columns, faults = [], []
    for label, (record, made, case, path) in zip(labels, chosen, strict=True):
        try:
            columns.append(comparison_column(made, record, label, own=path is None))
        except ValueError as fault:
            faults.append(f"{case}: {fault}")
    if faults:
        raise UserFault("\n".join(faults))
    try:
        found = compare(columns)
    except ValueError as fault:
        raise UserFault(str(fault)) from fault
    return write_comparison(found, options.out), found.to_json(), comparison_text(found.results)


def run_transfer(options: argparse.Namespace, record_of: Read, stored: Read) -> tuple[Path, dict, str]:
    """Do `hygrokf transfer`: the page, its data, and the text for the terminal."""
    from hygrokf.identification.turbine_type import TurbineType, TypeFault, is_type, pool_types, read_type
    from hygrokf.report.transfer_page import transfer_text, write_transfer
    from hygrokf.transfer.procedure import transfer_fit, transfer_json

    expect_own_directory(options.out, TRANSFER)
    try:
        source = read_type(options.fit) if is_type(options.fit) else stored(options.fit)
    except TypeFault as fault:
        raise UserFault(str(fault)) from fault
    records = [record_of(case) for case in options.cases]
    progress = Progress(STEPS * len(records))
    found = []
    try:
        for case, record in zip(options.cases, records, strict=True):
            try:
                found.append(transfer_fit(source, record, progress))
            except ValueError as fault:
                raise UserFault(f"{case}: {fault}") from fault
    except BaseException:
        progress.abandon()
        raise
    progress.close()
    fits: list[Fit] = [source] if not isinstance(source, TurbineType) else []
    fits += [one.own for one in found if one.own is not None]
    kind, unpooled = None, ""
    if len(fits) > 2:
        try:
            kind = pool_types(fits)
        except TypeFault as fault:
            unpooled = f"\n\nno type of turbine was made: {fault}"
    return (
        write_transfer(found, options.out, kind),
        transfer_json(found, kind),
        transfer_text(transfer_json(found, kind)) + unpooled,
    )
