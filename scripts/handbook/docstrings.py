"""Docstrings taken apart (summary, arguments, result, errors) and written as reStructuredText."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

NAME = r"`?[a-z]\w*`?"
ERROR = r"[A-Z]\w*(?:Error|Fault|Absent)"


@dataclass(frozen=True)
class Docstring:
    """`summary`: the first paragraph; `arguments`: (names, description); `body`: further paragraphs in their
    order; `returns`: what comes back; `raises`: (error, when)."""

    summary: str
    arguments: tuple[tuple[tuple[str, ...], str], ...]
    body: tuple[str, ...]
    returns: str
    raises: tuple[tuple[str, str], ...]

    def described(self) -> dict[str, str]:
        """The description of each argument by name."""
        return {name: text for names, text in self.arguments for name in names}


def parsed(text: str, parameters: Sequence[str]) -> Docstring:
    """A docstring taken apart.

    parameters: names of the signature; only these are recognised as arguments.
    """
    paragraphs = [part for part in re.split(r"\n[ \t]*\n", inspect.cleandoc(text)) if part.strip()]
    summary, arguments, body = " ".join(paragraphs[0].split()), [], []
    returns, raises = "", []
    for part in paragraphs[1:]:
        named = _arguments(part, parameters)
        if named:
            arguments += named
        elif re.match(r"(Returns|Raises)\b", part):
            result, errors = _result(" ".join(part.split()))
            returns, raises = returns or result, [*raises, *errors]
        else:
            before, errors = _result(part) if re.search(r"(?<=[.`)] )\s?Raises ", part) else (part, [])
            raises += errors
            if before.strip():
                body.append(before)
    return Docstring(summary, tuple(arguments), tuple(body), returns, tuple(raises))


def _arguments(paragraph: str, parameters: Sequence[str]) -> list[tuple[tuple[str, ...], str]]:
    """Arguments of a paragraph `name: text`, several to a line; none where it is something else."""
    flat = " ".join(paragraph.split())
    known = {*parameters}
    starts = []
    for match in re.finditer(rf"(?:^|(?<=[.;)\]] )|(?<=[.;)\]]  ))({NAME}(?:, {NAME})*): ", flat):
        names = tuple(name.strip("`") for name in match[1].split(", "))
        if known.issuperset(names):
            starts.append((match.start(), match.end(), names))
    if not starts or starts[0][0]:
        return []
    ends = [start for start, _, _ in starts[1:]] + [len(flat)]
    return [(names, flat[begin:end].strip()) for (_, begin, names), end in zip(starts, ends, strict=True)]


def _result(text: str) -> tuple[str, list[tuple[str, str]]]:
    """What comes back, and the errors with their reasons."""
    before, _, after = re.sub(r"(^|(?<=[.`)] )|(?<=[.`)]  ))Raises ", "\0", text, count=1).partition("\0")
    errors = []
    flat = " ".join(after.split())
    for error, reason in re.findall(rf"\b({ERROR})\b(.*?)(?=[,;]?(?: and)? {ERROR}\b|$)", flat):
        errors.append((error, reason.strip(" ,.;")))
    return re.sub(r"^Returns\s+", "", before).strip(), errors


def rst(text: str) -> str:
    """Prose of a docstring as reStructuredText: code in double backquotes, signs of markup escaped."""
    parts = re.split(r"(`[^`]+`)", text)
    return "".join(
        f"``{part[1:-1].strip()}``\\ " if part.startswith("`") and part.endswith("`") and len(part) > 2
        else re.sub(r"([\\*_|`])", r"\\\1", part)
        for part in parts
    )  # fmt: skip


def block(paragraph: str, indent: str = "") -> str:
    """A paragraph as reStructuredText; indented lines (equations, tables of the source) stay as they are."""
    lines, out, literal = paragraph.splitlines(), [], False
    margin = min((len(line) - len(line.lstrip()) for line in lines if line.strip()), default=0)
    prose: list[str] = []
    for line in [*lines, ""]:
        inner = line[margin:]
        indented = inner.startswith("    ") or (margin >= 4 and bool(line.strip()))
        if indented and not literal:
            out += [*_prose(prose), "", ".. code-block:: text", "   :class: equation", ""]
            prose, literal = [], True
        if indented:
            out.append("   " + inner.removeprefix("    "))
            continue
        if literal:
            out.append("")
            literal = False
        prose.append(inner)
    out += _prose(prose)
    return "\n".join(f"{indent}{line}".rstrip() for line in out).rstrip() + "\n"


def _prose(lines: Iterable[str]) -> list[str]:
    flat = " ".join(" ".join(lines).split())
    return [rst(flat)] if flat else []


def prose_and_equations(docstring: str) -> str:
    """A whole docstring as reStructuredText: paragraphs, with indented lines as equations."""
    paragraphs = [part for part in re.split(r"\n[ \t]*\n", inspect.cleandoc(docstring)) if part.strip()]
    return "\n".join(block(part) for part in paragraphs)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], widths: str = "auto") -> str:
    """A list-table; cells are reStructuredText."""
    lines = [".. list-table::", "   :header-rows: 1", f"   :widths: {widths}", ""]
    for row in (head, *rows):
        for place, cell in enumerate(row):
            lines.append(f"   {'* -' if place == 0 else '  -'} {cell or '–'}")
    return "\n".join(lines) + "\n"


def heading(text: str, sign: str) -> str:
    """A heading of reStructuredText."""
    return f"{text}\n{sign * len(text)}\n"
