"""How many signals of exports `hygrokf init` finds, in docs/how_to/init.md."""

from __future__ import annotations

from pathlib import Path

from illustrations.pages import write_table

HEAD = (
    "export",
    "right",
    "right, to confirm",
    "wrong",
    "missed",
    "doubts about stamps or turbine",
    "read without an edit",
)


def drafts(directory: Path, data: Path) -> None:
    """Signals of the synthetic exports of makes and of the whole measured files, counted."""
    from builders.measured_exports import EXPECTED, export_of
    from builders.vendor_exports import MAKES

    rows = [HEAD]
    for number, make in enumerate(MAKES):
        made = make()
        folder = directory / f"make{number}"
        folder.mkdir()
        expected = {signal: (column,) for signal, column in made.expected.items()}
        rows.append((made.make, *_row(made.write(folder), folder, expected)))
    for number, (name, expected) in enumerate(EXPECTED.items()):
        folder = directory / f"measured{number}"
        folder.mkdir()
        shown = f"`{Path(name).name}`" if "." in name else name
        rows.append((shown, *_row([export_of(name, folder)], folder, expected)))
    totals = [sum(int(row[column]) for row in rows[1:]) for column in range(1, 6)]
    unedited = sum(row[6] == "yes" for row in rows[1:])
    rows.append(("all", *map(str, totals), f"{unedited} of {len(rows) - 1}"))
    write_table("init.md", "drafts", rows)


def _row(files: list[Path], folder: Path, expected: dict[str, tuple[str, ...]]) -> tuple[str, ...]:
    from builders.measured_exports import counts

    from hygrokf.cases.case_file import CaseFault, read_case
    from hygrokf.drafting.draft import draft_case

    draft = draft_case(files, folder / "case.toml")
    signals = {one.signal: (one.column, bool(one.doubts)) for one in draft.signals if one.active}
    found = counts(signals, expected)
    try:
        read_case(folder / "case.toml", cabinet=False, ambient=False)
        read = "yes"
    except CaseFault:
        read = "no"
    numbers = (found.right, found.asked, found.wrong, found.missed, len(draft.doubts))
    return (*map(str, numbers), read)
