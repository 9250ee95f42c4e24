"""The table of causes of docs/explanation/discover.md."""

from __future__ import annotations

from pathlib import Path

from illustrations.pages import write_table


def causes(directory: Path) -> None:
    """Every cause of the library with the forms that are tried, as the library has them."""
    from hygrokf.discovery.library import cause_table

    write_table("discover.md", "causes", cause_table())
