"""Results with hostile texts or wrong pieces: places in plain data, and what a page must do about them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from builders.html_page import Page
from hygrokf.report.terminal import cells

EVIL = "<img src=x onerror=alert(1)>\"'&amp;</style></svg><script>$x_{$\u202e\x00\n"
"""A text that breaks a page which does not escape it."""


def nodes(data: Any, path: tuple = (), most: int | None = None) -> Iterator[tuple]:
    """Paths to all nodes of plain data; of each list at most so many entries."""
    if path:
        yield path
    children = (
        data.items() if isinstance(data, dict) else enumerate(data[:most]) if isinstance(data, list) else ()
    )
    for key, value in children:
        yield from nodes(value, (*path, key), most)


def at(data: Any, path: tuple) -> Any:
    """The node at a path."""
    for part in path:
        data = data[part]
    return data


def put(data: Any, path: tuple, value: object) -> None:
    """Replace the node at a path."""
    at(data, path[:-1])[path[-1]] = value


def expect_escaped(page: str, text: str) -> None:
    """Fail where a page executes or loads something, or a terminal's text holds control characters."""
    parsed = Page(page)
    assert "<img" not in page and "<script" not in page
    assert not {"\x00", "\u202e"} & set(page + text)
    assert {tag for tag, _ in parsed.tags} & {"img", "script", "iframe", "object"} == set()
    assert all(not name.startswith("on") for _, attributes in parsed.tags for name in attributes)
    assert page.count("</style>") == 1
    expect_narrow(text)


def expect_narrow(text: str) -> None:
    """Fail where a line is wider than a terminal of 100 columns."""
    assert max(cells(line) for line in text.splitlines()) <= 100


def expect_alone(page: str) -> Page:
    """Fail where a page needs another file or script, or uses an identifier twice; returns it parsed."""
    import re

    parsed = Page(page)
    bare = re.sub(r"data:image/png;base64,[^\"]*|<style>.*?</style>", "", page, flags=re.S)
    assert "http" not in page and "<script" not in page and "@import" not in page and "//" not in bare
    names = [attributes["id"] for _, attributes in parsed.tags if "id" in attributes]
    assert len(names) == len(set(names)) > 100
    used = {a or b for a, b in re.findall(r'href="#([^"]*)"|url\(#([^)]*)\)', page)}
    assert used and used <= set(names)
    return parsed
