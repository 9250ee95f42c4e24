"""FLEET.toml: the turbines of a fleet, the task, and its options."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hygrokf.data.toml_form import Place, read_form, read_toml, setting
from hygrokf.fleet.job import FleetFault, Job, content_key
from hygrokf.fleet.tasks import TASKS, Task

FOLDER = "turbines"
"""Name of the folder with the results of all turbines, one folder for each."""


def _patterns(value: object) -> tuple[str, ...]:
    """Return patterns of file names from one string or a list of strings. Raises ValueError."""
    patterns = [value] if isinstance(value, str) else value
    if not isinstance(patterns, list) or not all(isinstance(pattern, str) for pattern in patterns):
        raise ValueError(f'expected patterns such as ["*/case.toml"], found {value!r}')
    return tuple(patterns)


@dataclass(frozen=True)
class FleetTurbine:
    """A `[[turbine]]` of FLEET.toml."""

    case: str = setting(help="its case file")
    name: str = setting("", "of the folder of its results; by default that of its case")
    fit: str = setting("", "the fitted model that the task uses")


@dataclass(frozen=True)
class FleetForm:
    """FLEET.toml."""

    task: str = setting(help="the task for every turbine", choices=tuple(TASKS))
    name: str = setting("", "of the fleet; by default the file's name")
    cases: tuple[str, ...] = setting((), "patterns of case files", read=_patterns)
    fit: str = setting("", "the fitted model of all turbines; {name} is replaced by the name of a turbine")
    options: Mapping[str, Any] = setting(dict, "of the task")
    turbine: tuple[FleetTurbine, ...] = setting((), "turbines beside those of `cases`")


@dataclass(frozen=True)
class FleetPlan:
    """The content of FLEET.toml: name, task with all its options, and the turbines in their order, with
    absolute paths."""

    name: str
    task: str
    turbines: tuple[FleetTurbine, ...]
    options: Mapping[str, Any]

    def jobs(self, out: Path) -> list[Job]:
        """Return one job for each turbine, with the folder of its results in `out`, and the key of everything
        that it reads."""
        paths = [Path(path) for name in TASKS[self.task].files for path in self.options[name]]
        option_files = [path for path in paths if path.is_file()]  # without names of known limits
        jobs = (
            Job(
                turbine.name, self.task, Path(turbine.case), self.folder(out, turbine.name),
                Path(turbine.fit) if turbine.fit else None, self.options,
            )
            for turbine in self.turbines
        )  # fmt: skip
        return [replace(job, key=content_key(job, option_files)) for job in jobs]

    def folder(self, out: Path, turbine: str) -> Path:
        """Return the folder of a turbine's results."""
        return out.absolute() / FOLDER / turbine


def read_plan(path: str | os.PathLike[str]) -> FleetPlan:
    """Read FLEET.toml, whose paths are relative to the file. Raises FleetFault with every fault."""
    file, top_place = Path(path), Place()
    form = read_form(FleetForm, read_toml(file, FleetFault)[1], top_place)
    if form.task not in TASKS:
        raise FleetFault(file, top_place.faults)
    task = TASKS[form.task]
    options_place = replace(top_place, name="[options]", of=f" for {form.task}")
    options = asdict(read_form(task.options, form.options, options_place))
    for name in task.files:
        values, options[name] = options[name], []
        for path_or_name in values:
            full_path = (file.parent / path_or_name).absolute()
            is_class_name = name in task.named and full_path.suffix != ".toml" and not full_path.is_file()
            options[name].append(path_or_name if is_class_name else str(full_path))
            if not is_class_name and not full_path.is_file():
                options_place.fault(f"{name}: no such file {full_path}")
    turbines = _turbines(form, task, file.parent, top_place.faults)
    if top_place.faults:
        raise FleetFault(file, top_place.faults)
    return FleetPlan(form.name or file.stem, form.task, tuple(turbines), options)


def _turbines(form: FleetForm, task: Task, folder: Path, faults: list[str]) -> list[FleetTurbine]:
    """Return the turbines of a form with names and absolute paths; adds faults of names and of missing fits
    to `faults`."""
    if form.fit and not task.uses_fit:
        faults.append(f'fit: the task "{form.task}" uses no fitted model; leave it out')
    turbine_tables = [(f"cases, {case}", FleetTurbine(case)) for case in _matches(form.cases, folder, faults)]
    turbine_tables += [
        (f"[[turbine]] {table_number}", table)
        for table_number, table in enumerate(form.turbine, 1)
        if table.case
    ]
    if not turbine_tables and not faults:
        faults.append('no turbine: state cases = ["*/case.toml"], or one [[turbine]] for each')
    origin_of_name: dict[str, str] = {}
    turbines = []
    for origin, table in turbine_tables:
        name, fit = table.name or _name_of(table.case), table.fit or form.fit
        if not re.fullmatch(r"[^\W_](?:[\w .+-]{0,98}[\w+-])?", name):
            faults.append(
                f'{origin}: the name "{name}" becomes a folder: expected up to 100 letters, digits, spaces, '
                ". _ + -, the first of them a letter or digit; state another name in a [[turbine]]"
            )
        elif (first_origin := origin_of_name.setdefault(name.casefold(), origin)) != origin:
            faults.append(
                f'{origin}: the name "{name}" is that of {first_origin} too; state names of their own in '
                "[[turbine]] tables"
            )
        if task.uses_fit and not fit:
            faults.append(f'{origin}: needs a fitted model: state fit = "…" here, or for all at the top')
        fit_path = str((folder / fit.replace("{name}", name)).absolute()) if fit else ""
        turbines.append(FleetTurbine(str((folder / table.case).absolute()), name, fit_path))
    return turbines


def _matches(patterns: Sequence[str], folder: Path, faults: list[str]) -> list[str]:
    """Return the case files that match patterns; adds a fault for a pattern without any."""
    cases: dict[str, None] = {}
    for pattern in patterns:
        paths = sorted(glob.glob(pattern, root_dir=folder, recursive=True))
        if not paths:
            faults.append(f'cases: no file matches "{pattern}" in {folder.absolute()}')
        cases.update(dict.fromkeys(paths))
    return list(cases)


def _name_of(case: str) -> str:
    """Return the default name of a turbine: the name of the folder of case.toml; for other files, the name of
    the file."""
    path = Path(case)
    return path.parent.name if path.stem == "case" and path.parent.name else path.stem
