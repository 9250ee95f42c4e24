"""A case that has been fitted."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from builders.command_line import Said, run

from hygrokf.cases.synthetic import synthetic_turbine, write_case


@pytest.fixture(scope="session")
def fitted(tmp_path_factory) -> tuple[Path, Said]:
    """A synthetic turbine of 20 days, fitted once, and what the fit said."""
    folder = tmp_path_factory.mktemp("turbine")
    write_case(synthetic_turbine(seed=3, days=20), folder)
    said = run(f"fit {folder}/case.toml --out {folder}/result --starts 1")
    assert said.status == 0, said.err
    return folder, said


@pytest.fixture
def folder(fitted, tmp_path, monkeypatch) -> Path:
    """The working directory: a copy of the case, and its fit in `result`."""
    copy = tmp_path / "work"
    shutil.copytree(fitted[0], copy)
    monkeypatch.chdir(copy)
    return copy
