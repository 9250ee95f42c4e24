"""How commands read records, libraries of causes and models, and estimate fits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.commands.console import Progress, activity, faults_of

if TYPE_CHECKING:
    from hygrokf.data.record import Record
    from hygrokf.identification.fit import Fit
    from hygrokf.identification.turbine_type import TurbineType
    from hygrokf.modelling.library import Library


def case_record(case: Path, cabinet: bool = True) -> Record:
    """Read the record of a case, and print its warnings on standard error."""
    from hygrokf.cases.case_file import read_case

    record = read_case(case, cabinet=cabinet)
    for warning in record.warnings:
        activity().note(f"warning: {warning}")
    return record


def case_fit(
    record: Record, case: Path, criterion: str = "likelihood", starts: int = 4, kind: str | None = None,
    model: Fit | None = None,
) -> Fit:  # fmt: skip
    """Estimate the fit of a record, with a progress bar; the options are those of `identify`. Raises
    UserFault that names the case."""
    from hygrokf.identification.identify import DEFAULT_KIND, identify

    with faults_of(case), Progress(16) as progress:
        return identify(
            record, criterion=criterion, kind=kind or DEFAULT_KIND, starts=starts, progress=progress,
            model=model,
        )  # fmt: skip


def library_of(files: Sequence[str | Path], installed: bool = False) -> Library:
    """Return the library of causes: the package's own, those in the user's files, and with `installed` those
    of installed packages."""
    from hygrokf.modelling.library import LIBRARY

    if not (files or installed):
        return LIBRARY
    from hygrokf.discovery.own_causes import load_library

    return load_library(*files, installed=installed, library=LIBRARY)


def stored_fit(path: Path, files: Sequence[Path]) -> Fit:
    """Read a fit that may use mechanisms of the user; installed packages are searched only if the fit needs
    them."""
    from hygrokf.identification.fit import LibraryAbsent, read_fit

    library = library_of(files)
    try:
        return read_fit(path, library=library)
    except LibraryAbsent:
        return read_fit(path, library=library_of(files, installed=True))


def source_model(path: Path, files: Sequence[Path]) -> Fit | TurbineType:
    """Read the fit or the type of turbine in a file."""
    from hygrokf.identification.turbine_type import is_type, read_type

    return read_type(path, library_of(files)) if is_type(path) else stored_fit(path, files)


def write_fit_and_page(fit: Fit, out: Path) -> Path:
    """Write a fit and its page; returns the path of the page."""
    from hygrokf.identification.fit import write_fit
    from hygrokf.report.fit_page import write_report

    with Progress(2) as progress:
        progress("write the fit")
        write_fit(fit, out)
        progress("draw the report")
        return write_report(out)
