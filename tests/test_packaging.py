"""What is installed, and what stands where: metadata, top level, scripts, imports of the command line."""

from __future__ import annotations

import ast
import configparser
import importlib
import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from hygrokf.version import __version__

ROOT = Path(__file__).resolve().parents[1]
TOP_LEVEL = {
    "setup.cfg", "hygrokf", "tests", "scripts", "docs", "README.md",
    "pyproject.toml", "LICENSE", "CITATION.cff", ".gitignore", ".ci",
}  # fmt: skip
SCRIPTS = (
    *sorted(
        f"scripts/{p.name}"
        for p in (ROOT / "scripts").iterdir()
        if p.is_file() and p.name not in ("environment", "own_python.py")
    ),
    ".ci/run",
)
LATE = {
    "pandas",
    "scipy",
    "matplotlib",
    "statsmodels",
    "control",
    "filterpy",
    "numba",
    "llvmlite",
    "tqdm",
    "pyarrow",
    "dask",
    "distributed",
    "psycopg",
    "sqlalchemy",
    "asyncua",
    "cryptography",
    "xarray",
    "h5netcdf",
    "h5py",
    "openpyxl",
    "google",
    "shtab",
}
"""Packages that cost too much to be loaded before a command needs them."""
IMPORT_NAMES = {
    "pytest-xdist": "xdist",
    "paho-mqtt": "paho",
    "prometheus-client": "prometheus_client",
    "protobuf": "google",
    "pyyaml": "yaml",
}
ELSEWHERE = {"pysparkplug"}
"""Packages that a slow test installs into an environment of its own."""


@pytest.fixture(scope="module")
def settings() -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    return parser


def requirements(text: str) -> dict[str, str]:
    """Names and bounds of a list of requirements."""
    rows = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return {re.match(r"[A-Za-z0-9_-]+", row)[0]: re.sub(r"^[A-Za-z0-9_-]+", "", row) for row in rows}


def run(*command: object, **more: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False, **more)


# -- metadata ------------------------------------------------------------------------------------------------
def test_the_version_has_one_place(settings: configparser.ConfigParser) -> None:
    assert settings["metadata"]["version"] == "attr: hygrokf.version.__version__"
    assert importlib.import_module("hygrokf").__version__ == __version__
    # read without importing by the build: it must be a literal
    assigned = ast.parse((ROOT / "hygrokf" / "version.py").read_text(encoding="utf-8")).body[-1]
    assert isinstance(assigned, ast.Assign) and ast.literal_eval(assigned.value) == __version__
    stated = [p for p in ROOT.glob("hygrokf/**/*.py") if f'"{__version__}"' in p.read_text(encoding="utf-8")]
    assert stated == [ROOT / "hygrokf" / "version.py"]
    changes = (ROOT / "docs" / "project" / "changes.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\S+) \(\d{4}-\d\d-\d\d\)$", changes, re.MULTILINE)[0] == __version__
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_the_command_is_a_function_of_the_package(settings: configparser.ConfigParser) -> None:
    (line,) = settings["options.entry_points"]["console_scripts"].split("\n")[1:]
    name, target = (part.strip() for part in line.split("="))
    module, function = target.split(":")
    assert name == "hygrokf"
    assert callable(getattr(importlib.import_module(module), function))


def test_the_citation_names_what_the_metadata_name(settings: configparser.ConfigParser) -> None:
    import yaml

    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    stated = settings["metadata"]
    assert cited["title"] == stated["name"] and cited["license"] == stated["license"]
    assert cited["authors"] == [{"name": stated["author"]}] and cited["version"] == __version__
    assert cited["keywords"] == stated["keywords"].split(", ")


def test_requirements_have_a_lower_bound_and_no_cap(settings: configparser.ConfigParser) -> None:
    lists = [settings["options"]["install_requires"], *settings["options.extras_require"].values()]
    for text in lists:
        assert requirements(text)
        for name, bound in requirements(text).items():
            assert re.fullmatch(r">=[0-9.]+", bound), (
                f"{name}{bound}: expected one lower bound and nothing else"
            )


def test_every_third_party_import_is_required(settings: configparser.ConfigParser) -> None:
    required = {*requirements(settings["options"]["install_requires"])}
    optional = {
        IMPORT_NAMES.get(name, name)
        for extra, text in settings["options.extras_require"].items()
        if extra != "test"
        for name in requirements(text)
    }
    found = set()
    for path in ROOT.glob("hygrokf/**/*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                found.add(node.module.partition(".")[0])
    others = found - set(sys.stdlib_module_names) - {"hygrokf"}
    assert others <= required | optional, sorted(others - required - optional)


def test_the_tests_extra_holds_what_tests_import(settings: configparser.ConfigParser) -> None:
    extra = {IMPORT_NAMES.get(n, n) for n in requirements(settings["options.extras_require"]["test"])}
    installed = {*requirements(settings["options"]["install_requires"])}
    folders = (ROOT / "tests", ROOT / "scripts")
    packages = {path.parent.name for folder in folders for path in folder.rglob("__init__.py")}
    own = {path.stem for path in (ROOT / "tests").rglob("*.py")} | packages | {"hygrokf", "tests"}
    found = set()
    for path in (ROOT / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                found.add(node.module.partition(".")[0])
    others = found - set(sys.stdlib_module_names) - own - ELSEWHERE
    assert others <= extra | installed, sorted(others - extra - installed)


def test_slow_tests_are_left_out_by_default(settings: configparser.ConfigParser) -> None:
    options = settings["tool:pytest"]
    assert '-m "not slow"' in options["addopts"] and "--strict-markers" in options["addopts"]
    assert options["filterwarnings"].split() == ["error"]


def test_other_files_of_the_package_are_installed(settings: configparser.ConfigParser) -> None:
    """Every file beside the modules is named by package_data."""
    patterns = settings["options.package_data"]["hygrokf"].split()
    ignored = {".py", ".pyc"}
    for path in (ROOT / "hygrokf").rglob("*"):
        if path.is_file() and path.suffix not in ignored:
            inside = path.relative_to(ROOT / "hygrokf")
            assert any(inside.match(pattern) for pattern in patterns), f"{inside} would not be installed"


# -- the repository ------------------------------------------------------------------------------------------
def tracked() -> list[str]:
    """Files of the repository: git's own list, or what lies there where there is no git (an unpacked
    archive)."""
    listed = run("git", "-C", ROOT, "ls-files", "--cached", "--others", "--exclude-standard")
    if listed.returncode == 0 and listed.stdout:
        return [name for name in listed.stdout.splitlines() if (ROOT / name).exists()]
    known = TOP_LEVEL | {
        ".venv",
        "demo",
        ".git",
        ".pytest_cache",
        ".ruff_cache",
        ".hypothesis",
        "hygrokf.egg-info",
    }
    return [p.name for p in ROOT.iterdir() if p.name not in known] + sorted(TOP_LEVEL)


def test_the_top_level_holds_what_it_should() -> None:
    found = {name.partition("/")[0] for name in tracked()}
    assert found == TOP_LEVEL


@pytest.mark.skipif(os.name == "nt", reason="permissions as POSIX has them")
@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_can_be_run(name: str) -> None:
    path = ROOT / name
    assert os.access(path, os.X_OK), f"{name} is not executable"
    assert path.read_text(encoding="utf-8").startswith("#!/usr/bin/env ")


@pytest.mark.skipif(os.name == "nt", reason="bash scripts")
@pytest.mark.parametrize(
    "name", ["scripts/demo", "scripts/docs", "scripts/test", "scripts/environment", ".ci/run"]
)
def test_bash_can_read_the_scripts(name: str) -> None:
    checked = run("bash", "-n", ROOT / name)
    assert checked.returncode == 0, checked.stderr


REPORT = (
    '<testsuites><testsuite><testcase classname="a" name="b">{inside}</testcase></testsuite></testsuites>'
)


@pytest.mark.parametrize(
    ("inside", "shared", "status"),
    [
        ("", False, 0),
        ('<skipped type="pytest.xfail" message="known"/>', True, 0),
        ('<skipped type="pytest.skip" message="no chromium"/>', False, 1),
        ('<skipped type="pytest.skip" message="could not import \'pyarrow\'"/>', True, 1),
        ('<skipped type="pytest.skip" message="../shared/data is not there"/>', False, 0),
        ('<skipped type="pytest.skip" message="../shared/data is not there"/>', True, 1),
        ('<skipped type="pytest.skip" message="this processor has no such unit"/>', True, 0),
    ],
)
def test_a_skip_fails_the_checks_unless_its_data_are_absent(
    inside: str, shared: bool, status: int, tmp_path: Path
) -> None:
    home = tmp_path / "clone" / ".ci"
    home.mkdir(parents=True)
    if shared:
        (tmp_path / "shared").mkdir()
    (home / "skips").write_bytes((ROOT / ".ci" / "skips").read_bytes())
    report = tmp_path / "report.xml"
    report.write_text(REPORT.format(inside=inside))
    done = run(sys.executable, home / "skips", report)
    assert done.returncode == status, done.stderr
    assert ("a::b" in done.stdout) == bool(status)


# -- start-up ------------------------------------------------------------------------------------------------
def loaded_by(statement: str) -> set[str]:
    """Top-level packages that a fresh interpreter has loaded after a statement."""
    code = f"import sys\n{statement}\nprint('\\n'.join(sorted({{m.partition('.')[0] for m in sys.modules}})))"
    done = run(sys.executable, "-c", code, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


@pytest.mark.parametrize("module", ["hygrokf", "hygrokf.commands.main"])
def test_the_command_line_loads_no_heavy_package(module: str) -> None:
    assert not loaded_by(f"import {module}") & LATE


def test_help_loads_no_heavy_package() -> None:
    shown = (
        "from contextlib import redirect_stdout, suppress\nfrom io import StringIO\nfrom "
        "hygrokf.commands.main import main\n"
    )
    shown += "with suppress(SystemExit), redirect_stdout(StringIO()):\n    main(['--help'])"
    assert not loaded_by(shown) & (LATE | {"numpy"})


# -- an installation -----------------------------------------------------------------------------------------
NEEDS = {
    "cluster": "distributed hygrokf.commands.fleet_tasks",
    "docs": "sphinx furo myst_parser sphinx_gallery latex2mathml distributed",
    "excel": "openpyxl hygrokf.drafting",
    "live": "cryptography prometheus_client uvicorn hygrokf.live.web.server hygrokf.live.web.application",
    "mqtt": "cryptography paho.mqtt.client hygrokf.live.sources.mqtt",
    "opcua": "asyncua cryptography hygrokf.live.sources.opcua",
    "parquet": "pyarrow.parquet",
    "pdf": "weasyprint hygrokf.report.summary.writing",
    "postgres": "psycopg hygrokf.live.storage.postgres hygrokf.live.sources.postgres_source",
    "weather": "xarray h5netcdf h5py hygrokf.weather",
}
"""What each extra is for: modules that can be imported where it alone is installed."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in tracked():
        if name.partition("/")[0] in {"hygrokf", "setup.cfg", "pyproject.toml", "README.md", "LICENSE"}:
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    made = run(sys.executable, "-m", "pip", "wheel", "--no-deps", "-w", folder, source)
    assert made.returncode == 0, made.stderr
    (found,) = folder.glob("hygrokf-*.whl")
    return found


@pytest.mark.slow
def test_a_fresh_environment_runs_the_command(wheel: Path, tmp_path: Path) -> None:
    """The built wheel holds the package and nothing else, and its command runs outside the repository."""
    with zipfile.ZipFile(wheel) as archive:
        inside = {name.partition("/")[0] for name in archive.namelist()}
        modules = {name for name in archive.namelist() if name.startswith("hygrokf/")}
    assert inside == {"hygrokf", f"hygrokf-{__version__}.dist-info"}
    own = (p for p in (ROOT / "hygrokf").rglob("*") if p.is_file() and "__pycache__" not in p.parts)
    assert modules == {p.relative_to(ROOT).as_posix() for p in own}
    place = tmp_path / "environment"
    venv.create(place, with_pip=True)
    installed = run(place / "bin" / "python", "-m", "pip", "install", wheel)
    assert installed.returncode == 0, installed.stderr
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    shown = run(place / "bin" / "hygrokf", "--version", cwd=tmp_path, env=plain)
    assert (shown.returncode, shown.stdout.strip()) == (0, f"hygrokf {__version__}")
    demo = run(place / "bin" / "hygrokf", "demo", "--out", tmp_path / "demo", cwd=tmp_path, env=plain)
    assert demo.returncode == 0, demo.stderr
    assert (tmp_path / "demo" / "report.html").stat().st_size > 10_000


def test_every_extra_is_tried_alone(settings: configparser.ConfigParser) -> None:
    assert set(NEEDS) == set(settings["options.extras_require"]) - {"test"}


@pytest.mark.slow
@pytest.mark.parametrize("extra", NEEDS)
def test_an_extra_alone_brings_what_it_is_for(extra: str, wheel: Path, tmp_path: Path) -> None:
    """The modules of some other extra are missing there, so that the environment proves something."""
    place = tmp_path / "environment"
    venv.create(place, with_pip=True)
    installed = run(place / "bin" / "python", "-m", "pip", "install", f"{wheel}[{extra}]")
    assert installed.returncode == 0, installed.stderr
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    text = f"import {', '.join(NEEDS[extra].split())}"
    imported = run(place / "bin" / "python", "-c", text, cwd=tmp_path, env=plain)
    assert imported.returncode == 0, imported.stderr
    other = "openpyxl" if extra != "excel" else "pyarrow"
    assert run(place / "bin" / "python", "-c", f"import {other}", cwd=tmp_path, env=plain).returncode == 1
