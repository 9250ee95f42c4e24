"""HTML pages from blocks, by one template and one style sheet, without scripts and further files; they print
on A4."""

from __future__ import annotations

import re
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

from hygrokf.report.blocks import Figure, Page, Table
from hygrokf.report.figures.drawing import FONTS, NothingToShow, inline_svg, styled
from hygrokf.texts.reasons import MARKS, VERDICTS, WORDS
from hygrokf.texts.wording import one_line, unbroken

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup


def page_html(page: Page) -> str:
    """Return a page as HTML text; it depends on the blocks alone and names no host."""
    return _template().render(page=page)


@cache
def _template() -> Template:
    """Return the template of all pages, with its filters, functions and style sheet."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    folder = resources.files("hygrokf.report")
    style = (folder / "page.css").read_text(encoding="utf-8").replace("FONTS", FONTS)
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True, finalize=_printable
    )
    environment.filters |= {"prose": unbroken, "line": one_line, "symbol": _symbol}
    environment.globals |= {
        "kind_of": lambda block: type(block).__name__,
        "starts": _group_starts,
        "drawn": _drawn,
        "marks": MARKS,
        "words": {kind: WORDS[kind] for kind in VERDICTS},
        "style": Markup(style),
    }
    return environment.from_string((folder / "page.html").read_text(encoding="utf-8"))


def _printable(value: object) -> object:
    """Replace control characters by blanks; texts that the template itself made stay unchanged."""
    if type(value) is not str or value.isprintable():
        return value
    return "".join(c if c.isprintable() or c == "\xa0" else " " for c in value)


def _symbol(text: str) -> Markup:
    """Return a formula with its indices set below the line: R_AT becomes R with AT below."""
    from markupsafe import Markup, escape

    return Markup(re.sub(r"_(\w+)", r"<sub>\1</sub>", str(escape(text))))


def _group_starts(table: Table) -> set[int]:
    """Return the columns in which a group of columns begins."""
    counts = [count for _, count in table.groups]
    return {sum(counts[:number]) for number in range(len(counts))}


def _drawn(figure: Figure) -> tuple[Markup | None, str]:
    """Return a figure as SVG with an empty text; where its data are missing, None with the reason."""
    from markupsafe import Markup

    try:
        picture = figure.draw()
        with styled():
            return Markup(inline_svg(picture.figure(), figure.name, one_line(figure.heading))), ""
    except NothingToShow as reason:
        return None, one_line(str(reason))
