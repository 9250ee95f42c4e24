"""Files of summaries: which results they are made from, the HTML page, and its PDF."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from functools import partial
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
from hygrokf.discovery.discovery_results import read_discovery
from hygrokf.errors import HygrokfError
from hygrokf.report.figures.drawing import FONTS, expect_matplotlib
from hygrokf.report.fit_page import read_results
from hygrokf.report.page import page_html
from hygrokf.report.summary.contents import (
    Summary,
    summary_blocks,
    summary_of_climate,
    summary_of_discovery,
    summary_of_fit,
)


class SummaryFault(HygrokfError):
    """Results from which no summary can be made; the message lists everything that is wrong with them."""


Planned = tuple[Callable[[], Summary], Path, str]
"""A function that makes the summary, the directory of its files, and their name without the ending."""


def plan_summaries(results: Sequence[Path], directory: Path | None) -> list[Planned]:
    """Plan the summaries of results before any result is read.

    directory: for all files; None: each summary beside its result. With several results each gets a folder in
        it, named like the folder of the result.

    Raises SummaryFault with every path that holds no such result, and with folders that share a name.
    """
    expect_matplotlib()
    plans: list[Planned] = []
    faults, names = [], []
    for path in results:
        file = _file_of(path)
        if file is None:
            faults.append(_refused(path))
            continue
        folder = file.parent
        beside_summary = file.name == FIT and (folder / DISCOVERY).exists() and directory is None
        names.append(folder.resolve().name)
        out = folder if directory is None else directory if len(results) == 1 else directory / names[-1]
        plans.append(
            (partial(SUMMARY_OF[file.name], folder), out, BESIDE_SUMMARY if beside_summary else SUMMARY)
        )
    if directory is not None:
        faults += [
            f"--out {directory}: expected directories of results with different names, found {name} twice"
            for name in sorted({name for name in names if names.count(name) > 1})
        ]
    if faults:
        raise SummaryFault("\n".join(faults))
    return plans


def write_summary(summary: Summary, directory: Path, stem: str) -> Path:
    """Write the HTML page of a summary and return its path; an earlier PDF of the page is deleted."""
    content = page_html(summary_blocks(summary)).encode()
    directory.mkdir(parents=True, exist_ok=True)
    (directory / f"{stem}.pdf").unlink(missing_ok=True)
    return write_bytes_whole(directory / f"{stem}.html", content)


def write_pdf(page: Path) -> Path:
    """Write the PDF of an HTML page beside it and return its path; the same page gives the same bytes.

    The font is DejaVu Sans of matplotlib; letters that it lacks come from fonts of the system. Raises
    SummaryFault without WeasyPrint or the libraries that it needs.
    """
    try:
        # WeasyPrint prints advice when it is imported without its libraries
        with redirect_stdout(io.StringIO()):
            from weasyprint import CSS, HTML
            from weasyprint.text.fonts import FontConfiguration
    except (ImportError, OSError) as fault:
        raise SummaryFault(
            f"{page} is written, its PDF is not: expected WeasyPrint and the system's library Pango, found: "
            f"{str(fault).partition(':')[0]}; "
            'pip install "hygrokf[pdf]", and on Debian apt-get install libpango-1.0-0 libpangoft2-1.0-0 '
            "libharfbuzz-subset0"
        ) from None
    fonts = FontConfiguration()
    letters = CSS(string=_faces(), font_config=fonts)
    content = HTML(filename=page).write_pdf(stylesheets=[letters], font_config=fonts)
    return write_bytes_whole(page.with_suffix(".pdf"), content)


def _faces() -> str:
    """Return CSS rules that assign the font files of matplotlib to the first font of the pages."""
    import matplotlib

    family = FONTS.split(",")[0]
    folder = Path(matplotlib.get_data_path()) / "fonts/ttf"
    files = {"normal": folder / "DejaVuSans.ttf", "bold": folder / "DejaVuSans-Bold.ttf"}
    return "".join(
        f"@font-face {{ font-family: {family}; font-weight: {weight}; src: url({file.as_uri()}) }}"
        for weight, file in files.items()
    )


def _discovery(folder: Path) -> Summary:
    """Return the summary of the discovery in a folder."""
    stored = read_discovery(folder)
    return summary_of_discovery(stored.results, stored.before, stored.after)


SUMMARY_OF: Mapping[str, Callable[[Path], Summary]] = {
    DISCOVERY: _discovery,
    CLIMATE: lambda folder: summary_of_climate(read_climate(folder)),
    FIT: lambda folder: summary_of_fit(*read_results(folder)),
}
"""File of a result → how its summary is made; of a directory, the first of these files that exists."""


def _file_of(path: Path) -> Path | None:
    """Return the file of a result: in a directory, or the path itself; None without one."""
    if path.is_dir():
        return next((path / name for name in SUMMARY_OF if (path / name).is_file()), None)
    return path if path.name in SUMMARY_OF and path.is_file() else None


def _refused(path: Path) -> str:
    """Return the message for a path from which no summary can be made."""
    others = [name for name in RESULTS if name not in SUMMARY_OF]
    expected = f"expected {FIT}, {DISCOVERY} or {CLIMATE}, or a directory that holds one"
    other_result = next((name for name in others if path.name == name or (path / name).exists()), "")
    if other_result:
        return f"{path}: {expected}, found {other_result}; its page is report.html (hygrokf report)"
    if not path.exists():
        return f"{path}: {expected}, found no such file; run `hygrokf fit`, `discover` or `climate` first"
    obstacle = "a directory without them" if path.is_dir() else "another file"
    return f"{path}: {expected}, found {obstacle}; name what `hygrokf fit`, `discover` or `climate` wrote"
