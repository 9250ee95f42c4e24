"""FLEET.toml: which turbines, which task, with which options."""

from __future__ import annotations

import glob
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hygrokf.errors import suggestion
from hygrokf.fleet.job import FleetFault, Job, content_key
from hygrokf.fleet.tasks import TASKS, Task

_TOP = ("name", "task", "cases", "fit", "options", "turbine")
_TURBINE = ("name", "case", "fit")
FOLDER = "turbines"
"""Folder of the results that holds one folder for each turbine."""


@dataclass(frozen=True)
class Turbine:
    """One turbine of the fleet: its name, its case file, and the fitted model that the task uses."""

    name: str
    case: Path
    fit: Path | None = None


@dataclass(frozen=True)
class Plan:
    """What a fleet's file states: its name, the task with all of its options, the turbines in their order."""

    name: str
    task: str
    turbines: tuple[Turbine, ...]
    options: Mapping[str, Any]

    def jobs(self, out: Path) -> list[Job]:
        """One job for each turbine, with results in a folder of `out`, and with the key of what it reads."""
        beside = [Path(str(p)) for name in TASKS[self.task].files for p in self.options[name] or ()]
        made = []
        for one in self.turbines:
            folder = out.absolute() / FOLDER / one.name
            job = Job(
                one.name, self.task, one.case.absolute(), folder, one.fit and one.fit.absolute(), self.options
            )
            made.append(replace(job, key=content_key(job, beside)))
        return made


def read_plan(path: str | os.PathLike[str]) -> Plan:
    """The plan of a fleet's file; paths in it are relative to it.  Raises FleetFault with every fault."""
    file = Path(path)
    try:
        content = tomllib.loads(file.read_bytes().decode("utf-8-sig").replace("\r\n", "\n"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise FleetFault(str(file), [f"expected TOML text in UTF-8, found: {fault}"]) from None
    except OSError as fault:
        near = [one.name for one in file.parent.glob("*.toml")] if file.parent.is_dir() else []
        hint = suggestion(file.name, near) if isinstance(fault, FileNotFoundError) else ""
        raise FleetFault(str(file), [f"cannot be read: {fault.strerror or fault}{hint}"]) from None
    faults = [
        f'unknown key "{key}"; expected {", ".join(_TOP)}{suggestion(key, _TOP)}'
        for key in content
        if key not in _TOP
    ]
    name = _text(content, "name", "", faults) or file.stem
    task = _text(content, "task", "", faults)
    if task not in TASKS:
        found = f'found "{task}"{suggestion(task, TASKS)}' if task else "found none"
        faults.append(f"task: expected one of {', '.join(TASKS)}, {found}")
        raise FleetFault(str(file), faults)
    options = _options(content.get("options", {}), task, TASKS[task], file.parent, faults)
    turbines = _turbines(content, TASKS[task], file.parent, faults)
    if faults:
        raise FleetFault(str(file), faults)
    return Plan(name, task, tuple(turbines), options)


def _text(table: Mapping, key: str, where: str, faults: list[str]) -> str:
    value = table.get(key, "")
    if not isinstance(value, str):
        faults.append(f"{where}{key}: expected text in quotes, found {value!r}")
        return ""
    return value


def _options(table: Any, name: str, task: Task, folder: Path, faults: list[str]) -> dict:
    """Every option of the task, as stated or by default; files as absolute paths."""
    if not isinstance(table, dict):
        faults.append(f"options: expected a table [options], found {table!r}")
        table = {}
    for key in table:
        if key not in task.options:
            faults.append(
                f'[options]: unknown key "{key}" for {name}; expected {", ".join(task.options)}'
                f"{suggestion(key, task.options)}"
            )
    found = {}
    for key, option in task.options.items():
        value = table.get(key, option.default)
        if wrong := option.fault(value):
            faults.append(f"[options]: {key}: {wrong}")
        elif key in task.files:
            value = [str((folder / one).absolute()) for one in value]
            faults += [f"[options]: {key}: no such file {one}" for one in value if not Path(one).is_file()]
        found[key] = value
    return found


def _turbines(content: Mapping, task: Task, folder: Path, faults: list[str]) -> list[Turbine]:
    """Turbines of the patterns and of the tables, in this order."""
    usual = _text(content, "fit", "", faults)
    if usual and not task.uses_fit:
        faults.append(f'fit: the task "{content["task"]}" uses no fitted model; leave it out')
    found: list[tuple[str, str, str, str]] = [
        (f"cases, {case}", _name_of(case), case, usual) for case in _matched(content, folder, faults)
    ]
    tables = content.get("turbine", [])
    if not isinstance(tables, list) or not all(isinstance(one, dict) for one in tables):
        faults.append("turbine: write [[turbine]] with two brackets, once for each turbine")
        tables = []
    for place, table in enumerate(tables, start=1):
        where = f"[[turbine]] {place}: "
        for key in table:
            if key not in _TURBINE:
                faults.append(
                    f'{where}unknown key "{key}"; expected {", ".join(_TURBINE)}{suggestion(key, _TURBINE)}'
                )
        case = _text(table, "case", where, faults)
        if not case:
            faults.append(f'{where}needs case = "…", the path of its case file')
            continue
        name = _text(table, "name", where, faults) or _name_of(case)
        found.append((where.rstrip(": "), name, case, _text(table, "fit", where, faults) or usual))
    if not found and not faults:
        faults.append('no turbine: state cases = ["*/case.toml"], or one [[turbine]] for each')
    seen: dict[str, str] = {}
    turbines = []
    for where, name, case, fit in found:
        if not re.fullmatch(r"[^\W_](?:[\w .+-]{0,98}[\w+-])?", name):
            faults.append(
                f'{where}: the name "{name}" becomes a folder: expected up to 100 letters, digits, spaces, . _ + -, '
                "the first of them a letter or digit; state another name in a [[turbine]]"
            )
        elif (other := seen.setdefault(name.casefold(), where)) != where:
            faults.append(
                f'{where}: the name "{name}" is that of {other} too; state names of their own in [[turbine]] tables'
            )
        if task.uses_fit and not fit:
            faults.append(f'{where}: needs a fitted model: state fit = "…" here, or for all at the top')
        turbines.append(Turbine(name, folder / case, folder / fit.replace("{name}", name) if fit else None))
    return turbines


def _matched(content: Mapping, folder: Path, faults: list[str]) -> list[str]:
    """Case files of the patterns, sorted within each, every file once."""
    patterns = content.get("cases", [])
    if isinstance(patterns, str):
        patterns = [patterns]
    if not isinstance(patterns, list) or not all(isinstance(one, str) for one in patterns):
        faults.append(f'cases: expected patterns such as ["*/case.toml"], found {patterns!r}')
        return []
    found: dict[str, None] = {}
    for pattern in patterns:
        there = sorted(glob.glob(pattern, root_dir=folder, recursive=True))
        if not there:
            faults.append(f'cases: no file matches "{pattern}" in {folder.absolute()}')
        found.update(dict.fromkeys(there))
    return list(found)


def _name_of(case: str) -> str:
    """A turbine's name where none is stated: the folder of case.toml, else the file's name without its ending."""
    path = Path(case)
    return path.parent.name if path.stem == "case" and path.parent.name else path.stem
