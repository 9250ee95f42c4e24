"""Every command on records of every shape: a result, or an error in plain words; never a traceback.

Most cells take a second; those that take more are marked `slow`.  `ORDINARY` is the model of an ordinary
record.
"""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from builders.record_shapes import SHAPES, SIGNALS, base_record, write_record

from hygrokf.cases.case_file import read_case
from hygrokf.commands.main import main
from hygrokf.data.record import Record
from hygrokf.discovery.discover import discover
from hygrokf.identification.fit import read_fit
from hygrokf.modelling.library import LIBRARY

README = Path(__file__).resolve().parents[2] / "README.md"
ORDINARY = "ordinary"
FEW = r"cabinet_temperature: expected at least 50 readings .* found \d+: .* check the case"
NO_VAPOUR = (
    r"the model reads an ambient humidity .*which the record does not have .*: add the signal, or use a model"
)
NO_NUMBER = r"\bnan\b|Traceback|\bNone\b(?! of|\.)"
"""What no reader should see: numbers that are none, and a traceback; "None of 22 tests" is a sentence."""
NO_SCORE = r"a (model|fit) that (reads|knows) the power needs the power.*hygrokf check"
NO_POWER = r"expected a case file with signals\.active_power, found cabinet_temperature"
UNDRAWN = (ORDINARY, "hourly", "quantised", "no_ambient_humidity", "constant_power")
"""Shapes whose pages have the pictures of other shapes; `test_report` draws all, slowly."""
WITHOUT_VAPOUR = ("no_humidity", "no_ambient_humidity")


@dataclass
class Plant:
    """Cases of all shapes in a folder, and the fits of those that were asked for."""

    folder: Path
    cases: dict[str, Path]
    status: dict[str, int] = field(default_factory=dict)

    def fit(self, shape: str) -> Path:
        """The folder of a shape's fit; fitted at the first call."""
        out = self.folder / shape / "fit"
        if shape not in self.status:
            drawing = patch("hygrokf.report.fit_page.write_report", lambda out: out / "report.html")
            with drawing if shape in UNDRAWN else nullcontext():
                self.status[shape] = main(["fit", str(self.cases[shape]), "--out", str(out), "--starts", "1"])
        return out

    def model(self, shape: str) -> Path:
        """The fit of a shape; of an ordinary record where there is none."""
        found = self.fit(shape)
        return found / "fit.json" if (found / "fit.json").is_file() else self.fit(ORDINARY) / "fit.json"


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Plant:
    folder = tmp_path_factory.mktemp("shapes")
    base = base_record(folder)
    return Plant(folder, {name: write_record(shape(base), folder / name) for name, shape in SHAPES.items()})


@pytest.fixture
def told(capsys: pytest.CaptureFixture) -> Callable:
    """A function that runs a command: a result without a number that is none, or the error that is
    expected."""

    def run(arguments: Sequence[object], expected: str = "") -> str:
        capsys.readouterr()
        status = main([str(one) for one in arguments])
        out, err = capsys.readouterr()
        faults = [line for line in err.splitlines() if line.startswith("hygrokf: ")]
        if expected:
            assert status == 2 and re.search(expected, err.replace("\n", " ")), (status, err)
            return err
        assert status == 0 and not faults, err
        assert not re.search(NO_NUMBER, out + err), out + err
        return out

    return run


@pytest.fixture(params=SHAPES)
def shape(request: pytest.FixtureRequest) -> str:
    return request.param


# -- one record at a time ------------------------------------------------------------------------------------
def test_check(plant: Plant, told: Callable, shape: str) -> None:
    said = told(["check", plant.cases[shape]])
    assert "doubts:" in said and "-0 %" not in said


def test_fit_and_its_time_constants_by_the_readme_s_loop(
    plant: Plant, told: Callable, shape: str, capsys: pytest.CaptureFixture
) -> None:
    if shape == "eight_readings":
        told(["fit", plant.cases[shape], "--out", plant.folder / shape / "fit"], FEW)
        return
    plant.fit(shape)
    out, err = capsys.readouterr()
    assert plant.status[shape] == 0, err
    assert not re.search(NO_NUMBER, out + err), out + err
    fit = read_fit(plant.fit(shape))
    expected = ["thermal"] if shape in WITHOUT_VAPOUR else ["thermal", "hygric"]
    assert list(fit.results.time_constants) == expected
    (loop,) = re.findall(r"^for name, tau in .*?\n(?=\S)", README.read_text(), re.MULTILINE | re.DOTALL)
    exec(loop, {"fit": fit})
    lines = capsys.readouterr().out.splitlines()
    pattern = r"(thermal|hygric) \d+\.\d\d h, \d+\.\d\d … (\d+\.\d\d|nan) (believe|caution|reject)"
    assert [line.split()[0] for line in lines] == expected and all(
        re.fullmatch(pattern, line) for line in lines
    )


def test_simulate(plant: Plant, told: Callable, shape: str) -> None:
    out = plant.folder / shape / "simulated.csv"
    error = NO_VAPOUR if shape in WITHOUT_VAPOUR else ""
    told(["simulate", plant.fit(ORDINARY) / "fit.json", plant.cases[shape], "--out", out], error)
    told(["simulate", plant.model(shape), plant.cases[ORDINARY], "--out", out])
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert len(rows) > 100 and all(float(row["cabinet_temperature_degC"]) > -50.0 for row in rows)


PRINTED = ["eight_readings", "no_power", "no_humidity", "only_standstill"]
"""Shapes of which scores are printed in other words; the fleet below evaluates all."""


@pytest.mark.parametrize("shape", PRINTED)
def test_evaluate(plant: Plant, told: Callable, shape: str) -> None:
    error = NO_VAPOUR if shape in WITHOUT_VAPOUR else ""
    said = told(["evaluate", plant.fit(ORDINARY) / "fit.json", plant.cases[shape]], error)
    if shape == "no_power":
        assert re.search(NO_SCORE, said.replace("\n", " "))
    told(["evaluate", plant.model(shape), plant.cases[ORDINARY]])


@pytest.mark.parametrize("shape", PRINTED)
def test_compare(plant: Plant, told: Callable, shape: str) -> None:
    out = plant.folder / shape / "compared"
    ordinary = plant.fit(ORDINARY) / "fit.json"
    told(["compare", plant.cases[ORDINARY], "--fit", plant.model(shape), ordinary, "--out", out])
    error = NO_VAPOUR if shape in WITHOUT_VAPOUR else ""
    told(["compare", plant.cases[shape], plant.cases[ORDINARY], "--fit", ordinary, "--out", out], error)


# -- live ----------------------------------------------------------------------------------------------------
SHOWN = {
    "temperature": (273.15, 1.0),
    "humidity": (0.0, 100.0),
    "power": (0.0, 1e-3),
    "preheating": (0.0, 1.0),
}
"""Last word of a signal -> zero and factor of the unit in which a tracker reads it."""


def history(record: Record, path: Path) -> Path:
    """A record's readings in the order of their times, as a file that a tracker follows."""
    rows: dict[float, dict[str, str]] = {}
    names = [series.signal for series in record.series if series.signal in SIGNALS]
    for name in names:
        zero, factor = SHOWN[name.rpartition("_")[2]]
        for at, value in zip(*(a.tolist() for a in record[name].known), strict=True):
            rows.setdefault(at, {})[name] = f"{(value - zero) * factor:.4f}"
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, ["time", *names])
        table.writeheader()
        for at in sorted(rows):
            table.writerow({"time": datetime.fromtimestamp(at, UTC).isoformat(), **rows[at]})
    return path


OTHER_MODEL = (
    "no_standstill", "only_standstill", "no_power", "constant_power", "no_humidity", "no_ambient_humidity"
)  # fmt: skip
"""Shapes whose own model has other parts than that of an ordinary record."""


@pytest.mark.parametrize(
    ("shape", "own"), [*((name, False) for name in SHAPES), *((name, True) for name in OTHER_MODEL)]
)
def test_track_and_export(plant: Plant, told: Callable, shape: str, own: bool, tmp_path: Path) -> None:
    """Its own model on its own history, and an ordinary one: estimates to the last reading, or none and
    why."""
    record = read_case(plant.cases[shape])
    file = history(record, tmp_path / "live.csv")
    model = plant.model(shape) if own else plant.fit(ORDINARY) / "fit.json"
    live = [model, "--source", f"file:{file}", "--store", f"sqlite:{tmp_path / 'live.db'}", "--no-page"]
    told(["track", *live, "--until-ended"])
    told(["export", "--store", f"sqlite:{tmp_path / 'live.db'}", "--out", tmp_path / "history"])
    rows = list(csv.DictReader((tmp_path / "history" / "estimate.csv").read_text().splitlines()))
    if shape in WITHOUT_VAPOUR and not own:
        assert not rows
        assert re.search(r"ambient_(relative|absolute)_humidity", told(["doctor", *live, "--wait", "1s"]))
        return
    last = max(s.time[-1] for s in record.series if s.signal == "cabinet_temperature")
    until = datetime.fromisoformat(rows[-1]["time_utc"]).timestamp()
    assert until == pytest.approx(last, abs=1800.0)
    celsius = np.array([float(row["temperature_celsius"]) for row in rows])
    assert np.isfinite(celsius).all() and celsius.min() > 0.0 and celsius.max() < 60.0
    dry = shape in WITHOUT_VAPOUR and own
    assert all((row["relative_humidity_percent"] == "") == dry for row in rows)


# -- what takes longer ---------------------------------------------------------------------------------------
QUICK = ("eight_readings", "no_power", "no_humidity")
"""Shapes that the longer commands are run on by default, each of which leads another way; the others are
slow."""


def some(quick: Sequence[str] = QUICK) -> pytest.MarkDecorator:
    cells = [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in SHAPES]
    return pytest.mark.parametrize("shape", cells)


@some(QUICK[1:])
def test_climate(plant: Plant, told: Callable, shape: str) -> None:
    """The shape's record as weather and power of an ordinary cabinet, and an ordinary record as those of its
    own."""
    errors = {name: NO_VAPOUR for name in WITHOUT_VAPOUR} | {"no_power": NO_POWER}
    case, out, members = plant.cases[shape], plant.folder / shape / "climate", ["--members", 3]
    ordinary = plant.fit(ORDINARY) / "fit.json"
    weather = ["--weather", case, "--power", case]
    told(["climate", ordinary, *weather, *members, "--out", out], errors.get(shape, ""))
    weather = ["--weather", plant.cases[ORDINARY], "--power", plant.cases[ORDINARY]]
    told(["climate", plant.model(shape), *weather, *members, "--out", out])
    told(["report", out])


@some()
def test_transfer(plant: Plant, told: Callable, shape: str) -> None:
    errors = {name: NO_VAPOUR for name in WITHOUT_VAPOUR}
    errors |= {"no_power": NO_SCORE, "eight_readings": FEW}
    out = plant.folder / shape / "transfer"
    ordinary = plant.fit(ORDINARY) / "fit.json"
    told(["transfer", ordinary, plant.cases[shape], "--out", out], errors.get(shape, ""))
    if shape not in errors:
        told(["report", out])


@pytest.mark.slow
def test_an_own_model_on_an_ordinary_record(plant: Plant, told: Callable, shape: str) -> None:
    out = plant.folder / shape / "moved"
    told(["transfer", plant.model(shape), plant.cases[ORDINARY], "--out", out])
    told(["report", out])


@some(("no_humidity",))
def test_report(plant: Plant, told: Callable, shape: str) -> None:
    if shape == "eight_readings":
        return
    told(["report", plant.fit(shape)])
    page = (plant.fit(shape) / "report.html").read_text()
    assert not re.search(NO_NUMBER, page)


@pytest.mark.parametrize("shape", ["constant_power", "only_standstill"])
def test_a_drift_of_the_release_is_tried_whatever_the_operation(plant: Plant, shape: str) -> None:
    """It ended in a traceback on every record without standstill."""
    library = LIBRARY.only("heat_release_drift")
    assert len(library.causes) == 1
    found = discover(read_case(plant.cases[shape]), library=library).to_json()
    assert [row["cause"] for key in ("causes", "rejected") for row in found[key]] == ["heat_release_drift"]


@some(("eight_readings", "no_humidity"))
def test_discover(plant: Plant, told: Callable, shape: str) -> None:
    out = plant.folder / shape / "found"
    error = FEW if shape == "eight_readings" else ""
    told(["discover", plant.cases[shape], "--out", out], error)
    if not error:
        told(["report", out])


FLEET = 'name = "shapes"\ntask = "{task}"\ncases = ["*/case.toml"]\n{fit}[options]\n{options}'
FAILING = {
    "fit": {"eight_readings": FEW},
    "evaluate": {name: NO_VAPOUR for name in WITHOUT_VAPOUR},
    "transfer": {name: NO_VAPOUR for name in WITHOUT_VAPOUR} | {"eight_readings": FEW, "no_power": NO_SCORE},
    "climate": {name: NO_VAPOUR for name in WITHOUT_VAPOUR} | {"no_power": NO_POWER},
    "discover": {"eight_readings": FEW},
}


@pytest.mark.parametrize(
    "task", [name if name == "evaluate" else pytest.param(name, marks=pytest.mark.slow) for name in FAILING]
)
def test_a_fleet_of_all_shapes(
    plant: Plant, task: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """What fails has its reason in the table; the others are done."""
    for name, case in plant.cases.items():
        shutil.copytree(case.parent, tmp_path / name, ignore=shutil.ignore_patterns("[a-z]*[!v]", "fit"))
        shutil.copy(case, tmp_path / name)
    fit = "" if task in ("fit", "discover") else f'fit = "{plant.fit(ORDINARY).as_posix()}/fit.json"\n'
    options = {"fit": "starts = 1\n", "climate": "members = 3\n"}.get(task, "")
    (tmp_path / "fleet.toml").write_text(FLEET.format(task=task, fit=fit, options=options))
    capsys.readouterr()
    status = main(
        ["fleet", str(tmp_path / "fleet.toml"), "--out", str(tmp_path / "out"), "--workers", "1", "--json"]
    )
    rows = {row["turbine"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    assert status == 1 and set(rows) == set(SHAPES)
    for name, row in rows.items():
        reason = FAILING[task].get(name)
        assert row["status"] == ("failed" if reason else "done"), row
        assert re.search(reason or "^$", row["reason"]), row
    assert main(["report", str(tmp_path / "out")]) == 0
