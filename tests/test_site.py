"""The built site's sources: docstrings with all parts, pages of the registries, navigation, gallery."""

from __future__ import annotations

import ast
import builtins
import inspect
import os
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from builders.documents import DOCS, ROOT, document
from handbook import navigation, pictures, public_names, registries
from handbook.docstrings import parsed, rst

import hygrokf
from hygrokf.fleet.tasks import SHARED_COLUMNS, TASKS
from hygrokf.modelling.library import LIBRARY

NO_QUANTITY = {
    "read_fit", "write_fit", "write_report", "load_library", "run_fleet", "HygrokfError", "Cause", "discover",
}  # fmt: skip
"""Public names with no argument, result or field that has a unit."""
UNIT = re.compile(r"\[[^\]]+\]|\b[Uu]nits?\b|`unit`|\bSI\b")
QUICK = ("charger_network.py", "own_mechanism.py")
"""Scripts of the gallery that take few seconds, and run by default."""


# -- docstrings ----------------------------------------------------------------------------------------------
def test_a_docstring_is_taken_apart() -> None:
    taken = parsed(
        """Warm the cabinet.

        power: [W] of the heater.
        start, end: [s] when it runs.  twice: whether it runs again.

            C dT/dt = P

        More about it.

        Returns the energy [J].  Raises ValueError for a negative power, and KeyError without a heater.
        """,
        ("power", "start", "end", "twice"),
    )
    assert taken.summary == "Warm the cabinet."
    assert taken.described() == {
        "power": "[W] of the heater.",
        "start": "[s] when it runs.",
        "end": "[s] when it runs.",
        "twice": "whether it runs again.",
    }
    assert [part.strip() for part in taken.body] == ["C dT/dt = P", "More about it."]
    assert taken.returns == "the energy [J]."
    assert taken.raises == (("ValueError", "for a negative power"), ("KeyError", "without a heater"))


@pytest.mark.parametrize("name", public_names.NAMES)
def test_a_public_name_documents_arguments_units_and_errors(name: str) -> None:
    thing = getattr(hygrokf, name)
    taken, text = public_names.documented(name), inspect.getdoc(thing) or ""
    described = taken.described()
    assert [one for one in public_names.parameters(thing) if not described.get(one)] == []
    assert (name in NO_QUANTITY) != bool(UNIT.search(text)), "units, or an entry in NO_QUANTITY"
    lacking = [
        one
        for one, parameter in public_names.parameters(thing).items()
        if re.search(r"\bfloat\b|ndarray", str(parameter.annotation)) and not UNIT.search(described[one])
    ]
    assert lacking == []
    if inspect.isfunction(thing):
        assert taken.returns and taken.raises
    module = import_module(thing.__module__)
    for error, reason in taken.raises:
        assert reason, error
        found = getattr(builtins, error, None) or getattr(module, error, None) or _fault(error)
        assert issubclass(found, Exception)


def _fault(name: str) -> type:
    """The class of this name somewhere in the package."""
    (path,) = (
        p for p in (ROOT / "hygrokf").rglob("*.py") if f"\nclass {name}(" in p.read_text(encoding="utf-8")
    )
    found = import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    kind: type = getattr(found, name)
    return kind


# -- pages ---------------------------------------------------------------------------------------------------
def test_every_public_name_has_a_page_with_an_example() -> None:
    made = public_names.pages()
    assert {f"api/{name}" for name in public_names.NAMES} | {"api/index"} == set(made)
    assert sorted(name for names in public_names.groups().values() for name in names) == sorted(
        public_names.NAMES
    )
    for name in public_names.NAMES:
        example = made[f"api/{name}"].partition("\nExample\n")[2]
        assert f"hygrokf.{name}" in example
        ast.parse(
            "\n".join(line[3:] for line in example.splitlines() if line.startswith("   ") and ":" != line[3])
        )


def test_every_mechanism_has_equation_null_parameters_and_trace() -> None:
    text = "".join(page for name, page in registries.pages().items() if name.startswith("mechanisms/"))
    listed = [factory for _, _, factories in registries.GROUPS.values() for factory in factories]
    assert {factory.__name__ for factory in listed} == set(registries.MECHANISMS)
    for factory in listed:
        section = text.partition(f".. _mechanism-{factory.__name__}:")[2].partition(".. _mechanism-")[0]
        one = registries.made(factory)
        for parameter in one.parameters:
            assert f"* - ``{parameter.name}``" in section, parameter.name
            assert parameter.meaning, f"{factory.__name__}: {parameter.name} has no meaning"
        assert ":What it is:" in section
        if any(parameter.null is not None for parameter in one.parameters):
            assert ":Null value:" in section
    for factory in (*registries.FURTHER, *registries.LOGGED):
        assert registries.made(factory).leaves and registries.made(factory).source, factory.__name__


def test_every_cause_has_its_mechanisms_and_what_to_check() -> None:
    text = registries.pages()["causes"]
    without = set()
    for cause in registries.CAUSES:
        section = text.partition(f".. _cause-{cause.name}:")[2].partition(".. _cause-")[0]
        keys = (":Forms (settings):", ":To check:", ":Told apart by:")
        assert all(key in section for key in keys)
        names = registries.mechanisms_of(cause)
        if not names:
            without.add(cause.name)
        assert all(f"<mechanism-{name}>" in section for name in names)
    assert without == {"clock_shift"} and "stamps of one source moved (" in text
    assert registries.mechanisms_of(LIBRARY.cause("temperature_sensor_offset")) == ("temperature_step",)


def test_every_column_of_a_fleet_has_its_meaning() -> None:
    text = registries.pages()["fleet_columns"]
    for task in TASKS:
        section = text.partition(f"Columns of ``{task}``")[2].partition("\nColumns of ")[0]
        for name, meaning in TASKS[task].columns.items():
            assert f"* - ``{name}``\n     - {rst(meaning)}\n" in section, name
    assert all(f"``{name}``" in text.partition("Columns of ``")[0] for name in SHARED_COLUMNS)


def test_the_navigation_holds_every_page_once() -> None:
    text = document("index.md").read_text(encoding="utf-8")
    found = [page for pages in navigation.sections(text).values() for _, page in pages]
    pages = {str(page.relative_to(DOCS).with_suffix("")) for page in DOCS.rglob("*.md")}
    assert sorted(found) == sorted(pages - {"index"})
    assert set(navigation.MADE) <= set(navigation.sections(text))
    assert navigation.with_navigation(text).count("{toctree}") == len(navigation.sections(text))


def test_made_pages_link_to_pages_that_exist() -> None:
    links = {
        target
        for module in (ROOT / "scripts" / "handbook").glob("*.py")
        for target in re.findall(r":doc:`/([^`]+)`", module.read_text(encoding="utf-8"))
    }
    assert len(links) >= 3
    assert [target for target in sorted(links) if not (DOCS / f"{target}.md").is_file()] == []
    assert navigation.with_gallery("[a](../gallery/), [b](gallery/)") == (
        "[a](../generated/gallery/index.rst), [b](generated/gallery/index.rst)"
    )


# -- the gallery ---------------------------------------------------------------------------------------------
def test_the_gallery_lists_its_scripts() -> None:
    there = sorted(path.name for path in (DOCS / "gallery").glob("*.py"))
    assert sorted(pictures.ORDER) == there and len(there) >= 12
    for name in there:
        text = (DOCS / "gallery" / name).read_text(encoding="utf-8")
        assert re.match(r'"""\n[^\n]+\n=+\n\n', text), f"{name}: a title, then a sentence"
        assert text.endswith("figure.tight_layout()\n"), f"{name}: ends in a picture"


SHOWN = """
import runpy, sys
import matplotlib.pyplot as plt
from handbook.pictures import style
style()
runpy.run_path(sys.argv[1], run_name="__main__")
(number,) = plt.get_fignums()
plt.figure(number).savefig(sys.argv[2])
"""


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in pictures.ORDER],
)
def test_a_script_of_the_gallery_ends_in_one_picture(name: str, tmp_path: Path) -> None:
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "scripts")]),
        "PYTHONWARNINGS": "error",
        "PYTHONIOENCODING": "utf-8",
        "MPLBACKEND": "Agg",
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        [sys.executable, "-c", SHOWN, str(DOCS / "gallery" / name), str(tmp_path / "picture.png")],
        cwd=tmp_path, env=environment, capture_output=True, text=True, encoding="utf-8", timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-4000:]
    assert (tmp_path / "picture.png").stat().st_size > 10_000


# -- the build -----------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_one_command_builds_the_site_without_warnings(tmp_path: Path) -> None:
    """In a copy with an environment of its own; every link leads to a file, and nothing is fetched."""
    copy = tmp_path / "copy"
    ignored = shutil.ignore_patterns(".git", ".venv", "build", "generated", "__pycache__", ".*_cache", "demo")
    shutil.copytree(ROOT, copy, ignore=ignored)
    done = subprocess.run([copy / "scripts" / "docs"], capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    site = copy / "build" / "docs"
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 90 and (site / "searchindex.js").is_file()
    assert "<math " in (site / "explanation" / "theory.html").read_text(encoding="utf-8")
    broken = []
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert not re.search(r'<(?:script|img)[^>]+src="https?:|<link[^>]+stylesheet[^>]+href="https?:', text)
        for target in re.findall(r'(?:href|src)="([^"#?]+)', text):
            if not re.match(r"[a-z]+:", target) and not (page.parent / target).exists():
                broken.append(f"{page.name}: {target}")
    assert broken == []
