"""A page from its blocks: one template, one style, no script and no other file; prints on A4."""

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
    """The whole page as HTML text; names no host and is a pure function of the blocks."""
    return _template().render(page=page)


@cache
def _template() -> Template:
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    folder = resources.files("hygrokf.report")
    style = (folder / "page.css").read_text(encoding="utf-8").replace("FONTS", FONTS)
    made = Environment(
        autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True, finalize=_printable
    )
    made.filters |= {"prose": unbroken, "line": one_line, "symbol": _symbol}
    made.globals |= {
        "kind_of": lambda block: type(block).__name__,
        "starts": _group_starts,
        "drawn": _drawn,
        "marks": MARKS,
        "words": {kind: WORDS[kind] for kind in VERDICTS},
        "style": Markup(style),
    }
    return made.from_string((folder / "page.html").read_text(encoding="utf-8"))


def _printable(value: object) -> object:
    """A text of a result without control characters; what the template itself makes stays as it is."""
    if type(value) is not str or value.isprintable():
        return value
    return "".join(c if c.isprintable() or c == "\xa0" else " " for c in value)


def _symbol(text: str) -> Markup:
    """A formula with its indices below the line: R_AT becomes R with AT below."""
    from markupsafe import Markup, escape

    return Markup(re.sub(r"_(\w+)", r"<sub>\1</sub>", str(escape(text))))


def _group_starts(table: Table) -> set[int]:
    """The columns in which a group of a table begins."""
    counts = [count for _, count in table.groups]
    return {sum(counts[:place]) for place in range(len(counts))}


def _drawn(figure: Figure) -> tuple[Markup | None, str]:
    """The drawing of a figure; None with the reason where there is nothing to show."""
    from markupsafe import Markup

    try:
        picture = figure.draw()
        with styled():
            return Markup(inline_svg(picture.figure(), figure.name, one_line(figure.heading))), ""
    except NothingToShow as why:
        return None, one_line(str(why))
