"""Pages of the public names, made of docstrings and of the tested examples in docs/reference/reference.md."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
from functools import cached_property
from pathlib import Path

import hygrokf
from handbook.docstrings import Docstring, block, heading, parsed, rst

DOCS = Path(__file__).resolve().parents[2] / "docs"
NAMES = tuple(name for name in hygrokf.__all__ if name != "__version__")


def parameters(thing: object) -> dict[str, inspect.Parameter]:
    """Parameters of a function, or of the constructor of a class."""
    try:
        found = inspect.signature(thing)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return {}
    return {name: one for name, one in found.parameters.items() if name not in ("self", "args", "kwargs")}


def documented(name: str) -> Docstring:
    """The docstring of a public name, taken apart."""
    thing = getattr(hygrokf, name)
    return parsed(inspect.getdoc(thing) or "", tuple(parameters(thing)))


def groups() -> dict[str, list[str]]:
    """Names by the headings of docs/reference/reference.md."""
    found: dict[str, list[str]] = {}
    title = ""
    for line in (DOCS / "reference" / "reference.md").read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            title = line[3:]
        elif line.startswith("| `"):
            found.setdefault(title, []).extend(re.findall(r"`(\w+)", line.split("|")[1]))
    return found


def examples() -> dict[str, list[str]]:
    """Statements of docs/reference/reference.md that use each name; tests/test_docs.py runs its blocks."""
    text = (DOCS / "reference" / "reference.md").read_text(encoding="utf-8")
    found: dict[str, list[str]] = {name: [] for name in NAMES}
    for code in re.findall(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE):
        for statement in ast.parse(code).body:
            source = ast.get_source_segment(code, statement) or ""
            for name in dict.fromkeys(re.findall(r"\bhygrokf\.(\w+)\b(?!\.)", source)):
                if name in found:  # in a string, too: one statement writes a file of causes
                    found[name].append(source)
    return found


def signature(name: str, thing: object) -> str:
    """The signature as the source states it; defaults keep their names."""
    if inspect.isfunction(thing):
        tree = ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        returns = f" -> {ast.unparse(tree.returns)}" if tree.returns else ""
        return f"{name}({_arguments(tree.args)}){returns}"
    if dataclasses.is_dataclass(thing):
        return f"{name}({', '.join(_field(one) for one in dataclasses.fields(thing) if one.init)})"
    shown = [re.sub(r"<[^>]*>", "...", str(one)).replace("'", "") for one in parameters(thing).values()]
    return f"{name}({', '.join(shown)})"


def _arguments(arguments: ast.arguments) -> str:
    arguments.args = [one for one in arguments.args if one.arg not in ("self", "cls")]
    return ast.unparse(arguments)


def _field(one: dataclasses.Field[object]) -> str:
    shown = f"{one.name}: {one.type}"
    if one.default is not dataclasses.MISSING:
        return f"{shown} = {one.default!r}"
    return f"{shown} = ..." if one.default_factory is not dataclasses.MISSING else shown


def members(thing: type) -> list[tuple[str, str, str]]:
    """(directive, signature, docstring) of the public methods and properties that a class documents."""
    found = []
    for name, value in vars(thing).items():
        if name.startswith("_"):
            continue
        kind = "property" if isinstance(value, property | cached_property) else "method"
        inner = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        if kind == "method" and not inspect.isfunction(inner):
            continue
        shown = name if kind == "property" else signature(name, inner)
        if inner.__doc__:
            found.append((f"py:{kind}", shown, inner.__doc__))
    return found


def page(name: str, shown: list[str]) -> str:
    """The page of a public name.  shown: statements of its example."""
    thing = getattr(hygrokf, name)
    kind = "function" if inspect.isfunction(thing) else "class"
    if inspect.isclass(thing) and issubclass(thing, Exception):
        kind = "exception"
    taken = documented(name)
    lines = [
        heading(name, "="),
        f".. py:{kind}:: hygrokf.{signature(name, thing) if kind != 'exception' else name}",
        "",
        f"   {rst(taken.summary)}",
        "",
    ]
    lines += [block(part, "   ") for part in taken.body]
    for names, text in taken.arguments:
        lines += [f"   :param {one}: {rst(text)}" for one in names]
    if taken.returns:
        lines.append(f"   :returns: {rst(taken.returns)}")
    lines += [f"   :raises {error}: {rst(reason)}" for error, reason in taken.raises]
    lines.append("")
    if inspect.isclass(thing):
        for directive, written, docstring in members(thing):
            lines += [f"   .. {directive}:: {written}", ""]
            lines += [block(part, "      ") for part in re.split(r"\n\s*\n", inspect.cleandoc(docstring))]
    module = hygrokf._WHERE[name]
    lines += [f"Defined in ``hygrokf.{module}``.", ""]
    lines += [heading("Example", "-"), "", "From the tested examples of :doc:`/reference/reference`:", ""]
    lines += [".. code-block:: python", ""]
    lines += [textwrap.indent("\n".join(shown[:3]), "   "), ""]
    return "\n".join(lines)


def pages() -> dict[str, str]:
    """All pages by their name under docs/generated, with the index."""
    shown = examples()
    found = {f"api/{name}": page(name, shown[name]) for name in NAMES}
    index = [
        heading("API reference", "="),
        "Every public name of ``import hygrokf``. Times are seconds since 1970-01-01T00:00 UTC, model time",
        "is in hours, temperatures are in kelvin, vapour concentrations in g/m³, relative humidities 0 to 1.",
        "Shapes: T instants, n states, k outputs, d parameters.",
        "",
    ]
    for title, names in groups().items():
        index += [heading(title, "-"), ".. list-table::", "   :widths: 30 70", ""]
        for name in names:
            index += [f"   * - :doc:`{name} <{name}>`", f"     - {rst(documented(name).summary)}"]
        index += ["", ".. toctree::", "   :hidden:", "", *(f"   {name}" for name in names), ""]
    found["api/index"] = "\n".join(index)
    return found
