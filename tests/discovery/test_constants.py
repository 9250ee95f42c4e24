"""No constant stands in code alone: the page of constants has each of them, with its value."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest
from builders.documents import document

import hygrokf
from hygrokf.discovery import error_model, search

Constants = dict[tuple[str, str], object]
PACKAGE = Path(hygrokf.__file__).parent
MODULES = [
    *sorted((PACKAGE / "discovery").glob("*.py")),
    *sorted((PACKAGE / "modelling" / "causes").glob("*.py")),
    PACKAGE / "report" / "discovery_text.py",
]
MOST_THAT_DECIDE = 14


def assigned(text: str) -> set[str]:
    """Upper-case names that a module assigns at its top level."""
    found: set[str] = set()
    for one in ast.parse(text).body:
        targets = one.targets if isinstance(one, ast.Assign) else [getattr(one, "target", None)]
        names = [name for target in targets if target is not None for name in ast.walk(target)]
        found |= {name.id for name in names if isinstance(name, ast.Name) and name.id.isupper()}
    return found


def numeric(value: object) -> bool:
    """Whether a value is a number, or holds nothing but numbers."""
    if isinstance(value, dict):
        return numeric(tuple(value.values()))
    if isinstance(value, tuple):
        return bool(value) and all(map(numeric, value))
    return isinstance(value, int | float)


def of_code() -> Constants:
    """(module, name) → value of every numeric constant."""
    found: Constants = {}
    for file in MODULES:
        module = import_module(".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts))
        names = assigned(file.read_text(encoding="utf-8"))
        known = {name: getattr(module, name) for name in names}
        found |= {(file.stem, name): value for name, value in known.items() if numeric(value)}
    return found


def of_page(text: str) -> Constants:
    """(module, name) → value that the tables state, None where they state none."""
    found: Constants = {}
    for module, cell in re.findall(r"^\| `(\w+)`: (`[^|]*) \|", text, re.MULTILINE):
        for name, stated in re.findall(r"`(\w+)(?:=([^`]+))?`", cell):
            assert (module, name) not in found, f"{name} of {module} stands twice"
            found[module, name] = value_of(stated) if stated else None
    return found


def value_of(text: str) -> float | tuple[float, ...]:
    """A value as the page writes it: 1e-6, 2/3, (3,12,48)."""
    if text.startswith("("):
        return tuple(number(one) for one in text.strip("()").split(","))
    return number(text)


def number(text: str) -> float:
    above, _, below = text.partition("/")
    return float(above) / float(below or 1.0)


def page() -> str:
    return document("discover_constants.md").read_text(encoding="utf-8")


def test_every_constant_of_the_code_stands_on_the_page_and_no_other() -> None:
    code, told = of_code(), of_page(page())
    assert sorted(code.keys() - told.keys()) == [] == sorted(told.keys() - code.keys())


def test_the_page_states_the_values_of_the_code() -> None:
    code, told = of_code(), of_page(page())
    unstated = {name for (_, name), value in told.items() if value is None}
    assert unstated == {"POSSIBLE", "FREE", "_RANGES"}, "a logarithm and two tables"
    for key, value in told.items():
        assert value is None or value == pytest.approx(code[key], rel=1e-9), key


def test_few_constants_decide_and_each_has_a_reason() -> None:
    table = page().split("## ")[1]
    rows = [row.split(" | ") for row in table.splitlines() if row.startswith("| `")]
    assert 5 <= len(rows) <= MOST_THAT_DECIDE == len(of_page(table))
    assert all(len(row) == 4 and len(row[1].split()) >= 4 for row in rows)


def test_a_constant_that_is_missing_or_stale_is_found() -> None:
    text = "| `search`: `FURTHER_EVIDENCE=12` | a |\n"
    text += "| `error_model`: `TIMES_H=(1,2/3)`, `SEEN`, `GONE=2` | b |\n"
    told = of_page(text)
    assert told == {
        ("search", "FURTHER_EVIDENCE"): 12.0, ("error_model", "TIMES_H"): (1.0, 2 / 3),
        ("error_model", "SEEN"): None, ("error_model", "GONE"): 2.0,
    }  # fmt: skip
    code = of_code()
    assert code["search", "FURTHER_EVIDENCE"] == search.FURTHER_EVIDENCE != told["search", "FURTHER_EVIDENCE"]
    assert code["error_model", "TIMES_H"] == error_model.TIMES_H
    assert ("error_model", "GONE") not in code and ("search", "SENSOR") not in code
    assert assigned("A, b = 1, 2\nC: int = 3\n_D = 4\nE += 5\ndef f():\n    G = 1\n") == {"A", "C", "_D", "E"}
