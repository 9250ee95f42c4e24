"""How many signals of exports `hygrokf init` finds, printed for docs/validation/real_input.md."""

from __future__ import annotations

from pathlib import Path

COUNTED = (
    "exports",
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

    makes, measured = [], []
    for number, make in enumerate(MAKES):
        made = make()
        folder = directory / f"make{number}"
        folder.mkdir()
        expected = {signal: (column,) for signal, column in made.expected.items()}
        makes.append(_counts(made.write(folder), folder, expected))
    for number, (name, expected) in enumerate(EXPECTED.items()):
        folder = directory / f"measured{number}"
        folder.mkdir()
        measured.append(_counts([export_of(name, folder)], folder, expected))
    for words, counted in (
        ("synthetic, layouts of makes and loggers", makes),
        ("measured files", measured),
        ("all", makes + measured),
    ):
        sums = [len(counted), *(sum(column) for column in zip(*counted, strict=True))]
        said = ", ".join(f"{name} {number}" for name, number in zip(COUNTED, sums, strict=True))
        print(f"{words}: {said}", flush=True)


def _counts(files: list[Path], folder: Path, expected: dict[str, tuple[str, ...]]) -> tuple[int, ...]:
    """Numbers of COUNTED behind the first, of one export."""
    from builders.measured_exports import counts

    from hygrokf.cases.case_file import CaseFault, read_case
    from hygrokf.drafting.draft import draft_case

    draft = draft_case(files, folder / "case.toml")
    signals = {one.signal: (one.column, bool(one.doubts)) for one in draft.signals if one.active}
    found = counts(signals, expected)
    try:
        read_case(folder / "case.toml", cabinet=False, ambient=False)
        read = 1
    except CaseFault:
        read = 0
    return found.right, found.asked, found.wrong, found.missed, len(draft.doubts), read
