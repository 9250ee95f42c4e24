"""The page docs/reference/signals.md."""

from __future__ import annotations

from hygrokf.data.signals import SIGNALS, difference_from_si, fitting_units, from_si
from hygrokf.physics.holds import PREVIOUS


def signal_table_markdown() -> str:
    """The page docs/reference/signals.md: the signal table."""
    over_water = "over liquid water, also below 0 °C"
    jumping = [row for row in SIGNALS.values() if row.hold == PREVIOUS]
    live = ", ".join(f"`{row.name}`" for row in jumping if row.hold_of_instants != PREVIOUS)
    held = ", ".join(f"`{row.name}`" for row in jumping if row.hold_of_instants == PREVIOUS)
    lines = [
        "# Signals",
        "",
        "Made from `hygrokf/data/signals.py`; change that table, not this page.",
        "",
        "A case file names a signal, its column and the unit of that column. The first unit is the SI unit "
        "inside the package. Readings outside of the range are masked, with a warning. The accuracy (95 %) "
        f"is assumed where the case file states none. Humidities and dew points are {over_water}.",
        "",
        f"Instants of {held} hold from their stamp on, from live sources also {live}; others are joined by "
        "lines ([case file](case_file.md#stamps-and-holds)).",
        "",
        "| signal | units | range | accuracy | meaning |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in SIGNALS.values():
        low, high = (float(from_si(bound, row.display, row)) for bound in (row.low, row.high))
        limits = f"{low:.4g} … {high:.4g}" + ("" if row.display == "1" else f" {row.display}")
        accuracy = ""
        if row.default_accuracy is not None:
            shown = difference_from_si(row.default_accuracy, row.display, row)
            accuracy = f"{shown:.4g} {'K' if row.display == 'degC' else row.display}"
        lines.append(
            f"| `{row.name}` | {', '.join(fitting_units(row))} | {limits} | {accuracy} "
            f"| {row.meaning.removesuffix(', ' + over_water)} |"
        )
    return "\n".join(lines) + "\n"
