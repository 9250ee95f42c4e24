"""Equations of the site as MathML, which browsers draw without a script."""

from __future__ import annotations

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

logger = logging.getLogger(__name__)


def _drawn(translator: HTML5Translator, node: nodes.Element, display: str) -> None:
    try:
        drawn = convert(node.astext(), display=display)
    except Exception as fault:
        logger.warning("equation %r cannot be drawn: %s", node.astext(), fault, location=node)
        drawn = translator.encode(node.astext())
    translator.body.append(f'<div class="equation">{drawn}</div>' if display == "block" else drawn)
    raise nodes.SkipNode


def inline(translator: HTML5Translator, node: nodes.Element) -> None:
    """An equation in a line."""
    _drawn(translator, node, "inline")


def displayed(translator: HTML5Translator, node: nodes.Element) -> None:
    """An equation in a block of its own."""
    _drawn(translator, node, "block")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer under the name "mathml"."""
    app.add_html_math_renderer("mathml", (inline, None), (displayed, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
