"""The public names: each is there, known to a type checker, described, and not a module of the package."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import pytest

import hygrokf


@pytest.mark.parametrize("name", sorted(hygrokf.__all__))
def test_a_public_name_leads_to_what_is_described(name: str) -> None:
    found = getattr(hygrokf, name)
    assert not inspect.ismodule(found)
    if name != "__version__":
        assert len(inspect.getdoc(found) or "") > 20


def test_a_type_checker_knows_every_public_name() -> None:
    tree = ast.parse(Path(hygrokf.__file__).read_text(encoding="utf-8"))
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


@pytest.mark.parametrize("former", sorted(hygrokf._FORMER))
def test_a_former_name_is_told_its_new_one(former: str) -> None:
    with pytest.raises(AttributeError, match=f"hygrokf.{former} is called hygrokf.{hygrokf._FORMER[former]}"):
        getattr(hygrokf, former)
    assert hygrokf._FORMER[former] in hygrokf.__all__


def test_an_unknown_name_is_an_error_with_the_known_ones() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'fit_everything'.*'identify'"):
        hygrokf.fit_everything  # noqa: B018
