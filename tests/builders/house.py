"""The house: floors, folders, modules, and what imports what.  The tests of the floors and the picture in the
docs read it here."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import hygrokf

ROOT = Path(hygrokf.__file__).parent
FACE = "hygrokf"
FLOORS = (
    "physics texts",
    "engine data",
    "weather estimation modelling",
    "cases evaluation drafting",
    "identification",
    "discovery transfer climate live fleet",
    "report",
    "commands",
)
"""Every folder of the package, from the lowest floor to the highest; folders of one floor do not know each
other."""
OUTSIDE = {"", "version", "errors", "__main__"}
"""Modules that stand in no folder: the face, and what everybody may import."""
ONLY_IN = {"llvmlite": "engine.jit", "sqlalchemy": "live.storage"}
"""Third parties that are imported with a module, and the module or folder that may."""
SHELVES = ("hygrokf", "scripts", "tests/plants", "tests/other_make")
"""Folders whose modules and functions have a readable length."""
PLACE = {name: floor for floor, names in enumerate(FLOORS) for name in names.split()}


def modules() -> dict[str, Path]:
    """Module name below the package -> file; the face is the empty name."""
    result = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        result[".".join(p for p in parts if p != "__init__")] = path
    return result


MODULES = modules()


def shelf(name: str) -> list[Path]:
    """Python sources below a folder of the repository; programs of `scripts` have no ending."""
    files = sorted(path for path in (ROOT.parent / name).rglob("*") if path.is_file())
    return [path for path in files if path.suffix == ".py" or _is_program(path)]


def _is_program(path: Path) -> bool:
    with path.open("rb") as file:
        return not path.suffix and file.readline().rstrip().endswith(b"python3")


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def long_functions(path: Path, most: int = 80) -> set[str]:
    """Names of the functions that have more lines than `most`."""
    return {
        one.name
        for one in ast.walk(tree(path))
        if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)
        and (one.end_lineno or 0) - one.lineno >= most
    }


def bound_twice(path: Path) -> set[str]:
    """Names that a module binds more than once at its top level: the second silently replaces the first."""
    found: list[str] = []
    for node in tree(path).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.append(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found += [n.id for one in targets for n in ast.walk(one) if isinstance(n, ast.Name)]
    return {name for name in found if found.count(name) > 1}


@cache
def imports(path: Path, top_only: bool = False) -> tuple[tuple[str, str, int], ...]:
    """(module, imported name or '', line) of all imports that run: those under TYPE_CHECKING do not."""

    def walk(parent: ast.AST) -> Iterator[tuple[str, str, int]]:
        for node in ast.iter_child_nodes(parent):
            if isinstance(node, ast.Import):
                yield from ((alias.name, "", node.lineno) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path.name}:{node.lineno}: relative import"
                yield from ((str(node.module), alias.name, node.lineno) for alias in node.names)
            elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
                continue
            elif not (top_only and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)):
                yield from walk(node)

    return tuple(walk(tree(path)))


def below(module: str, name: str) -> str:
    """The module of the package that an import reaches."""
    inner = module.removeprefix(FACE).removeprefix(".")
    whole = f"{inner}.{name}".strip(".")
    return whole if whole in MODULES else inner


def folder(module: str) -> str:
    """The folder at the top of the package in which a module stands."""
    return module.partition(".")[0]


def known(name: str) -> Iterator[tuple[str, int]]:
    """Modules of the package that a module imports, with the line."""
    for module, imported, line in imports(MODULES[name]):
        if module.split(".")[0] == FACE:
            lower = below(module, imported)
            assert lower, (
                f"{name}:{line}: imports the package's own face; name the module: hygrokf.{imported}"
            )
            assert module != FACE or lower in OUTSIDE, (
                f"{name}:{line}: write `from hygrokf.{lower} import ...`, the face has names of its own"
            )
            yield lower, line


def meaning(name: str) -> str:
    """The first sentence of what a folder's docstring says lives there."""
    text = ast.get_docstring(tree(ROOT / name / "__init__.py")) or ""
    return " ".join(text.split("\n\n")[0].split())


def headline(name: str) -> str:
    """What lives in a folder, up to the list of its parts."""
    return re.split("[:;]", meaning(name))[0].rstrip(".")


def neighbours(name: str) -> list[str]:
    """Folders that the modules of a folder import, lowest floor first."""
    found = {
        folder(lower)
        for module in MODULES
        if folder(module) == name
        for lower, _ in known(module)
        if lower not in OUTSIDE
    }
    return sorted(found - {name}, key=lambda one: (PLACE[one], list(PLACE).index(one)))


def table() -> list[tuple[str, ...]]:
    """Floors from the highest to the lowest: number, folder, what lives there without its details."""
    rows: list[tuple[str, ...]] = [("floor", "folder", "what lives there")]
    for floor in reversed(range(len(FLOORS))):
        rows += [(str(floor + 1), f"`{name}`", headline(name)) for name in FLOORS[floor].split()]
    return rows
