"""Navigation of the site: the lists of docs/index.md, one for each heading."""

from __future__ import annotations

import re

MADE = {
    "Tutorials": (("Gallery", "generated/gallery/index"),),
    "Reference": (
        ("API reference", "generated/api/index"),
        ("Mechanisms", "generated/mechanisms/index"),
        ("Causes", "generated/causes"),
        ("Columns of a fleet", "generated/fleet_columns"),
    ),
}
"""Pages that exist in the built site only, by heading; they stand first."""


def sections(text: str) -> dict[str, list[tuple[str, str]]]:
    """(title, page) of each link to a page of docs/, by heading of docs/index.md."""
    found: dict[str, list[tuple[str, str]]] = {}
    title = ""
    for line in text.splitlines():
        if line.startswith("## "):
            title = line[3:].strip()
        elif title:
            links = re.findall(r"\[([^\]]+)\]\((\w[\w/.-]*)\.md\)", line)
            found.setdefault(title, []).extend((name, page) for name, page in links)
    return {name: pages for name, pages in found.items() if pages}


def with_gallery(text: str) -> str:
    """A page whose links to the folder of the gallery lead to its built page."""
    return re.sub(r"\]\(((?:\.\./)*)gallery/\)", r"](\1generated/gallery/index.rst)", text)


def with_navigation(text: str) -> str:
    """docs/index.md with a hidden list of pages for each heading, as the site needs it."""
    lists = []
    for title, pages in sections(text).items():
        entries = [f"{name} <{page}>" for name, page in (*MADE.get(title, ()), *pages)]
        lists += ["```{toctree}", ":hidden:", f":caption: {title}", "", *entries, "```", ""]
    return with_gallery(text) + "\n\n" + "\n".join(lists)
