"""How the house is built: imports point strictly down, nobody enters by the face, libraries stay where they belong."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import hygrokf

ROOT = Path(hygrokf.__file__).parent
FACE = "hygrokf"
FLOORS = (
    # what knows nothing of the package
    "expression machine moments parallel parameters signals psychrometrics files lookup version discovery discovery.budget live weather live.schema live.reasons live.certificates climate climate.form climate.cycles climate.bounds climate.acceleration resampling transfer fleet switches",
    # text of code, one step, what a record is
    "console emission discretisation record stamps live.database surface climate.chamber wording",
    "verdict_terms",
    "verdict running_sums control_loop case_keys columns paths live.table_reader live.sqlite live.postgres live.check",
    "loops masks actuators weather_form readers synthetic ambient live.opcua_security live.opcua_samples",
    "features fleet_loop long_steps live.opcua_client case_form weather.archive weather.fields weather.altitude weather.joining weather.alignment climate.power",
    "recursion weather.gridded weather.epw weather.clocks",
    "doubts weather.era5",
    "checks",
    "weather.reading",
    "model case weather.years",
    "frames",
    # the physics
    "mechanisms.thermal mechanisms.network mechanisms.sensors",
    "mechanisms.hygric mechanisms.heat mechanisms.moisture mechanisms.readings mechanisms.wandering",
    "mechanisms timeline",
    "additions",
    # the estimation
    "likelihood design",
    "fitting kalman drivers thermal side_by_side",
    "switching confidence periods",
    "simulation forms clock_offsets composition inference",
    # judgement
    "output_error scoring actuator_effects stationary diagnosis discovery.significance",
    "stage",
    "time_constants discovery.scene discovery.clocks",
    "fit discovery.scan discovery.cause live.operation live.ceiling",
    "climate.shots",
    "results tables identification discovery.residuals discovery.changes discovery.grids live.plan live.condition live.outlook climate.ensemble climate.members climate.region turbine_type",
    "discovery.causes_heat discovery.causes_moisture discovery.causes_readings discovery.results discovery.conditions live.tracker live.properties climate.statistics climate.days climate.range transfer.comparison transfer.groups",
    "discovery.library discovery.misfits discovery.repeats live.forecast live.inquiry climate.limits climate.sequence transfer.scene",
    "discovery.nesting discovery.trial discovery.regularity live.store live.payload climate.study transfer.account",
    "discovery.own_causes discovery.choice discovery.remainder discovery.evidence live.alarms live.tally climate.results transfer.transfer",
    "discovery.held_out live.fleet",
    "discovery.discover",
    "live.streams live.ahead live.retention live.export",
    "live.broker live.opcua live.mqtt_client",
    "live.mqtt_link live.opcua_table",
    "live.mqtt",
    "live.sources live.page_settings live.doctor_files",
    "live.config",
    # pictures and faces
    "drawing excerpts report_words live.service live.views live.demo live.web_access live.usual live.logs live.doctor_clock live.doctor_store live.doctor_models",
    "plots_course plots_composition plots_identification plots_innovations report_tables discovery.plots_residuals live.web_events live.web_metrics live.doctor_mqtt transfer.plots",
    "plots page weather.plots discovery.plots_misfits discovery.words live.web live.web_server live.doctor_opcua climate.tables",
    "live.tracking live.doctor_sources climate.plots",
    "live.doctor climate.page",
    "report live.command discovery.tables climate.command transfer.comparison_page",
    "discovery.page transfer.page fleet.job",
    "fleet.tasks",
    "fleet.plan fleet.worker fleet.cluster fleet.table fleet.outliers",
    "fleet.processes fleet.plots fleet.words",
    "fleet.page",
    "fleet.running",
    "fleet.command",
    "transfer.command",
    "cli",
    "__main__",
)
"""Every module of the package, from the lowest floor to the highest; modules of one floor do not know each other."""
ONLY_IN = {"llvmlite": "machine"}
"""Third parties that are imported with a module, and the module that may."""
UPWARD = {("record", "frames")}
"""Imports that point up, with their reason: `Record.from_frames` stands where one looks for it and leads to the whole
way from tables to a record, which knows `Record`."""
PLACE = {name: floor for floor, names in enumerate(FLOORS) for name in names.split()}


def modules() -> dict[str, Path]:
    """Module name below the package -> file; the face is the empty name."""
    result = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        result[".".join(p for p in parts if p != "__init__")] = path
    return result


MODULES = modules()


def imports(path: Path, top_only: bool = False) -> Iterator[tuple[str, str, int]]:
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

    yield from walk(ast.parse(path.read_text(encoding="utf-8")))


def below(module: str, name: str) -> str:
    """The module of the package that an import reaches."""
    inner = module.removeprefix(FACE).removeprefix(".")
    whole = f"{inner}.{name}".strip(".")
    return whole if whole in MODULES else inner


def test_every_module_has_its_floor() -> None:
    listed, there = set(PLACE), set(MODULES) - {""}
    assert listed == there, f"without a floor: {sorted(there - listed)}; gone: {sorted(listed - there)}"
    assert len(PLACE) == sum(len(names.split()) for names in FLOORS), "a module stands on two floors"


@pytest.mark.parametrize("name", [n for n in MODULES if n])
def test_imports_point_strictly_down(name: str) -> None:
    for module, imported, line in imports(MODULES[name]):
        if module.split(".")[0] == FACE:
            lower = below(module, imported)
            assert lower, (
                f"{name}:{line}: imports the package's own face; name the module: hygrokf.{imported}"
            )
            assert module != FACE, (
                f"{name}:{line}: write `from hygrokf.{lower} import ...`, the face has names of its own"
            )
            assert PLACE[lower] < PLACE[name] or (name, lower) in UPWARD, (
                f"{name}:{line}: {lower} does not lie below {name}"
            )


def test_the_face_loads_nothing_but_the_version() -> None:
    assert {m for m, _, _ in imports(MODULES[""]) if m.startswith(FACE)} == {"hygrokf.version"}


@pytest.mark.parametrize("name", MODULES)
def test_third_parties_are_imported_where_they_are_needed(name: str) -> None:
    """With a module come numpy and, for the compiler, llvmlite: everything else costs the command line its start."""
    for module, _, line in imports(MODULES[name], top_only=True):
        root = module.split(".")[0]
        if root in sys.stdlib_module_names or root in (FACE, "numpy"):
            continue
        assert ONLY_IN.get(root) == name, f"{name}:{line}: import {root} inside the function that needs it"
    for module, _, line in imports(MODULES[name]):
        assert module.split(".")[0] not in ONLY_IN or name in ONLY_IN.values(), (
            f"{name}:{line}: only the machine compiles"
        )


@pytest.mark.parametrize("name", MODULES)
def test_modules_have_one_noun_and_a_readable_length(name: str) -> None:
    last = name.rsplit(".", 1)[-1]
    assert not {"utils", "util", "base", "common", "helpers", "misc"} & set(last.split("_")), (
        "a helper lives with its noun"
    )
    lines = len(MODULES[name].read_text(encoding="utf-8").splitlines())
    assert lines <= 600, f"{name} has {lines} lines: split it"
    assert ast.get_docstring(ast.parse(MODULES[name].read_text(encoding="utf-8"))), (
        f"{name} does not say what it is"
    )


def test_the_walk_sees_what_it_must(tmp_path: Path) -> None:
    """The guard itself: functions are looked into, type checking is not."""
    file = tmp_path / "some.py"
    file.write_text(
        "import os\nfrom typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import hidden\n"
        "class A:\n    import in_class\n    def f(self):\n        import lazy\n        if 1:\n            from deep import x\n"
        "try:\n    import tried\nexcept ImportError:\n    pass\n"
    )
    assert {m for m, _, _ in imports(file)} == {"os", "typing", "in_class", "lazy", "deep", "tried"}
    assert {m for m, _, _ in imports(file, top_only=True)} == {"os", "typing", "in_class", "tried"}
