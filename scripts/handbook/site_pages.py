"""What Sphinx calls when a build starts: the pages of docs/generated, and the navigation."""

from __future__ import annotations

from pathlib import Path

from sphinx.application import Sphinx

from handbook import public_names, registries
from handbook.navigation import with_gallery, with_navigation


def write_pages(app: Sphinx) -> None:
    """Write docs/generated; unchanged files are left alone, so that Sphinx does not read them again."""
    for name, text in {**public_names.pages(), **registries.pages()}.items():
        path = Path(app.srcdir) / "generated" / f"{name}.rst"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def navigate(app: Sphinx, name: str, source: list[str]) -> None:
    """Give the index its navigation, and links to the gallery their page."""
    source[0] = with_navigation(source[0]) if name == "index" else with_gallery(source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register both."""
    app.connect("builder-inited", write_pages)
    app.connect("source-read", navigate)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
