"""How the house is built: imports point strictly down, nobody enters by the face, libraries stay where they
belong."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest
from builders.house import (
    FACE,
    FLOORS,
    MODULES,
    ONLY_IN,
    OUTSIDE,
    PLACE,
    ROOT,
    SHELVES,
    bound_twice,
    folder,
    imports,
    known,
    long_functions,
    meaning,
    shelf,
    tree,
)


def test_every_module_has_its_folder() -> None:
    there = {name for name in MODULES if name not in OUTSIDE}
    assert {folder(name) for name in there} == set(PLACE)
    flat = sorted(name for name in there - set(PLACE) if "." not in name)
    assert not flat, f"in no folder: {flat}"
    assert len(PLACE) == sum(len(names.split()) for names in FLOORS), "a folder stands on two floors"


@pytest.mark.parametrize("name", PLACE)
def test_a_folder_says_what_lives_there(name: str) -> None:
    assert len(meaning(name)) > 40


@pytest.mark.parametrize("name", [n for n in MODULES if n not in OUTSIDE])
def test_imports_point_to_lower_floors(name: str) -> None:
    own = folder(name)
    for lower, line in known(name):
        if lower in OUTSIDE or folder(lower) == own:
            continue
        assert PLACE[folder(lower)] < PLACE[own], f"{name}:{line}: {lower} does not lie below {own}"


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = {name: {lower for lower, _ in known(name)} for name in MODULES if name}
    done: set[str] = set()

    def walk(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " imports ".join((*path[path.index(name) :], name))
        if name not in done:
            for lower in sorted(graph[name] - {"", name}):
                walk(lower, (*path, name))
            done.add(name)

    for name in graph:
        walk(name, ())


def test_the_face_loads_nothing_but_the_version() -> None:
    assert {m for m, _, _ in imports(MODULES[""]) if m.startswith(FACE)} == {"hygrokf.version"}


@pytest.mark.parametrize("name", MODULES)
def test_third_parties_are_imported_where_they_are_needed(name: str) -> None:
    """With a module come numpy and, for the compiler and the store, what `ONLY_IN` names: everything else
    costs the command line its start."""
    for module, _, line in imports(MODULES[name], top_only=True):
        root = module.split(".")[0]
        if root in sys.stdlib_module_names or root in (FACE, "numpy"):
            continue
        assert root in ONLY_IN, f"{name}:{line}: import {root} inside the function that needs it"
    for module, _, line in imports(MODULES[name]):
        root = module.split(".")[0]
        place = ONLY_IN.get(root, name)
        assert f"{name}.".startswith(f"{place}."), f"{name}:{line}: only {place} imports {root}"


@pytest.mark.parametrize("name", MODULES)
def test_modules_have_one_noun_and_a_readable_length(name: str) -> None:
    last = name.rsplit(".", 1)[-1]
    assert not {"utils", "util", "base", "common", "helpers", "misc"} & set(last.split("_")), (
        "a helper lives with its noun"
    )
    assert ast.get_docstring(tree(MODULES[name])), f"{name} does not say what it is"


@pytest.mark.parametrize("name", SHELVES)
def test_modules_and_functions_are_short(name: str) -> None:
    files = {str(path.relative_to(ROOT.parent)): path for path in shelf(name)}
    assert files
    lines = {place: len(path.read_text(encoding="utf-8").splitlines()) for place, path in files.items()}
    assert not {place: count for place, count in lines.items() if count > 600}, "split these modules"
    found = {place: long for place, path in files.items() if (long := long_functions(path))}
    assert not found, "functions have at most 80 lines: split these"


@pytest.mark.parametrize("name", MODULES)
def test_a_name_is_bound_once(name: str) -> None:
    assert bound_twice(MODULES[name]) == set()


def test_names_that_are_bound_twice_are_found(tmp_path: Path) -> None:
    file = tmp_path / "some.py"
    file.write_text("A = 1\nB: int = 2\ndef f():\n    A = 3\nA, C = 4, 5\nclass f: ...\n")
    assert bound_twice(file) == {"A", "f"}


def test_long_functions_are_found(tmp_path: Path) -> None:
    file = tmp_path / "some.py"
    body = "".join(f"    x = {n}\n" for n in range(79))
    file.write_text(f"def at():\n{body}async def over():\n{body}    pass\nclass A:\n  def f(self): ...\n")
    assert long_functions(file) == {"over"}


def test_the_walk_sees_what_it_must(tmp_path: Path) -> None:
    """The guard itself: functions are looked into, type checking is not."""
    file = tmp_path / "some.py"
    file.write_text(
        "import os\nfrom typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import hidden\nclass A:\n    "
        "import in_class\n    def f(self):\n        import lazy\n        if 1:\n            from deep import "
        "x\ntry:\n    import tried\nexcept ImportError:\n    pass\n"
    )
    assert {m for m, _, _ in imports(file)} == {"os", "typing", "in_class", "lazy", "deep", "tried"}
    assert {m for m, _, _ in imports(file, top_only=True)} == {"os", "typing", "in_class", "tried"}
