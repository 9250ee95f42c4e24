"""Summaries on disk: the kind of a result from its file, and the three files of its summary."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from hygrokf.climate.study import read_climate
from hygrokf.data.files import (
    BESIDE_SUMMARY,
    CLIMATE,
    DISCOVERY,
    FIT,
    RESULTS,
    SUMMARY,
    write_bytes_whole,
)
from hygrokf.discovery.results import read_discovery
from hygrokf.errors import HygrokfError
from hygrokf.report.figures.drawing import expect_matplotlib
from hygrokf.report.fit_page import read_results
from hygrokf.report.page import page_html
from hygrokf.report.summary.climate import summary_of_climate
from hygrokf.report.summary.content import Summary
from hygrokf.report.summary.discovery import summary_of_discovery
from hygrokf.report.summary.fit import summary_of_fit
from hygrokf.report.summary.page import summary_blocks
from hygrokf.report.summary.sheet import summary_bytes


class SummaryFault(HygrokfError):
    """Results of which no summary can be made; one message lists everything wrong with them."""


Planned = tuple[Callable[[], Summary], Path, str]
"""How a summary is made, the directory of its files, and their name without the ending."""


def planned(results: Sequence[Path], directory: Path | None) -> list[Planned]:
    """The summaries of results, before any is read.

    directory: of all files; of several results each has one of its own in it, named like that of the result.
    Raises SummaryFault that lists every result of another kind, and those whose directories share a name.
    """
    expect_matplotlib()
    faults, plans, names = [], [], []
    for path in results:
        file = _file_of(path)
        if file is None:
            faults.append(_refused(path))
            continue
        home = file.parent
        own = file.name == FIT and (home / DISCOVERY).exists() and directory is None
        names.append(home.resolve().name)
        out = home if directory is None else directory if len(results) == 1 else directory / names[-1]
        plans.append((_maker(file), out, BESIDE_SUMMARY if own else SUMMARY))
    if directory is not None:
        faults += [
            f"--out {directory}: expected directories of results with different names, found {name} twice"
            for name in sorted({one for one in names if names.count(one) > 1})
        ]
    if faults:
        raise SummaryFault("\n".join(faults))
    return plans


def written(summary: Summary, directory: Path, stem: str) -> tuple[Path, ...]:
    """The three files of a summary."""
    pdf, png = summary_bytes(summary)
    files = {"html": page_html(summary_blocks(summary)).encode(), "pdf": pdf, "png": png}
    directory.mkdir(parents=True, exist_ok=True)
    return tuple(write_bytes_whole(directory / f"{stem}.{end}", content) for end, content in files.items())


def _fit(folder: Path) -> Summary:
    return summary_of_fit(*read_results(folder))


def _discovery(folder: Path) -> Summary:
    read = read_discovery(folder)
    return summary_of_discovery(read.results, read.before, read.after)


def _climate(folder: Path) -> Summary:
    return summary_of_climate(read_climate(folder))


KINDS: Mapping[str, Callable[[Path], Summary]] = {DISCOVERY: _discovery, CLIMATE: _climate, FIT: _fit}
"""By the file of a result; in a directory the first that is there."""


def _maker(file: Path) -> Callable[[], Summary]:
    return lambda: KINDS[file.name](file.parent)


def _file_of(path: Path) -> Path | None:
    """The file that says of which kind a result is; None where there is none."""
    if path.is_dir():
        return next((path / name for name in KINDS if (path / name).is_file()), None)
    return path if path.name in KINDS and path.is_file() else None


def _refused(path: Path) -> str:
    others = [name for name in RESULTS if name not in KINDS]
    expected = f"expected {FIT}, {DISCOVERY} or {CLIMATE}, or a directory that holds one"
    there = next((name for name in others if path.name == name or (path / name).exists()), "")
    if there:
        return f"{path}: {expected}, found {there}; its page is report.html (hygrokf report)"
    if not path.exists():
        return f"{path}: {expected}, found no such file; run `hygrokf fit`, `discover` or `climate` first"
    what = "a directory without them" if path.is_dir() else "another file"
    return f"{path}: {expected}, found {what}; name what `hygrokf fit`, `discover` or `climate` wrote"
