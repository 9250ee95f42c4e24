"""Scripts and examples that no default test runs still import names that exist."""

from __future__ import annotations

import ast
import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PYTHON = b"#!/usr/bin/env python3"
PROGRAMS = [
    path
    for folder in ("scripts", ".ci", "docs/gallery")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.is_file() and (path.suffix == ".py" or path.read_bytes().startswith(PYTHON))
]


def test_programs_are_found() -> None:
    names = {path.name for path in PROGRAMS}
    assert {"validate", "golden", "first_fit.py", "command.py"} <= names


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_a_program_imports_of_the_package_is_there(path: Path) -> None:
    missing = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("hygrokf"):
            continue
        try:
            module = importlib.import_module(node.module)
        except ImportError:
            missing.append(node.module)
            continue
        folder = ROOT / node.module.replace(".", "/")
        names = [alias.name for alias in node.names]
        missing += [
            f"{node.module}.{name}"
            for name in names
            if not hasattr(module, name) and not (folder / f"{name}.py").exists()
        ]
    assert not missing


@pytest.mark.parametrize("name", ["benchmark", "golden", "validate", "pictures"])
def test_a_program_goes_on_in_the_repository_s_environment(name: str) -> None:
    """An interpreter that lacks the requirements gives the program to .venv, or says what to run."""
    bare = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(
        [sys.executable, "-S", ROOT / "scripts" / name, "--help"], env=bare, capture_output=True, text=True
    )
    if (ROOT / ".venv" / "bin" / "python").exists():
        assert done.returncode == 0 and done.stdout.startswith("usage:"), done.stderr
    else:
        assert done.returncode == 1 and "run scripts/demo or scripts/test once" in done.stderr
