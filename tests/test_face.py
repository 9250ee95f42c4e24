"""The public names: each is there, known to a type checker, described, in the reference, and not a module."""

from __future__ import annotations

import ast
import inspect
import re

import pytest
from builders.documents import ROOT, document

import hygrokf

NAMES = sorted(set(hygrokf.__all__) - {"__version__"})


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_leads_to_what_is_described(name: str) -> None:
    found = getattr(hygrokf, name)
    assert not inspect.ismodule(found)
    described = inspect.getdoc(found) or ""
    assert len(described) > 60
    if inspect.isfunction(found):
        assert "Returns" in described and "Raises" in described


def test_the_reference_uses_every_public_name_and_lists_it() -> None:
    """test_docs.py runs its examples."""
    text = document("reference.md").read_text(encoding="utf-8")
    code = "\n".join(re.findall(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE))
    rows = "\n".join(line.split("|")[1] for line in text.splitlines() if line.startswith("| `"))
    assert sorted(set(re.findall(r"hygrokf\.(\w+)", code)) & set(NAMES)) == NAMES
    assert sorted(set(re.findall(r"`(\w+)", rows))) == NAMES


def test_a_type_checker_knows_every_public_name() -> None:
    tree = ast.parse((ROOT / "hygrokf" / "__init__.py").read_text(encoding="utf-8"))
    checked = next(
        node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    declared = {
        alias.asname: f"{node.module}".removeprefix("hygrokf.")
        for node in ast.walk(checked)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert declared == hygrokf._WHERE


def test_an_unknown_name_is_an_error_with_the_known_ones() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'fit_everything'.*'identify'"):
        hygrokf.fit_everything  # noqa: B018
