"""The cases of the golden outputs: commands, run in this process in an empty folder, and all that they leave
behind."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from builders.documents import document
from builders.store_case import queried

from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.commands.main import main
from hygrokf.data.record import Record
from hygrokf.discovery.discover import discover
from hygrokf.engine import jit
from hygrokf.report.discovery_page import discovery_blocks, write_discovery_report
from hygrokf.report.terminal import page_text
from hygrokf.version import __version__

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
UK = (ROOT / "../shared/data/kelmarsh_2018_2019_era5_power_hourly.csv.gz").resolve()
ATTIC = (ROOT / "../shared/data/attic_trh1_R2_hourly.csv.gz").resolve()
PLANTS = (
    ("none", 0),
    ("moisture_sorption", 0),
    ("unlogged_heater", 0),
    ("clock_shift", 0),
    ("humidity_sensor_drift", 0),
    ("wind_driven_exchange", 0),
)
PLANT_SEED, PLANT_DAYS = 70400, 90.0
ROUND = 400
"""Messages that a played-back turbine's tracker takes at once."""


Step = tuple[str, ...] | Callable[[Path], str]
"""A command's arguments, or a function of the folder that returns text."""


@dataclass(frozen=True)
class Case:
    """A name, what makes the inputs in its folder, and the steps that are taken there; `large` ones take
    minutes."""

    name: str
    prepare: Callable[[Path], None]
    steps: tuple[Step, ...] = ()
    large: bool = False
    needs: tuple[Path, ...] = ()

    @property
    def absent(self) -> list[Path]:
        """The measured files that it needs and that are not here."""
        return [path for path in self.needs if not path.exists()]


def outputs(case: Case) -> dict:
    """`made` in a process of its own, where no loop is compiled already, and in a folder that goes with
    it."""
    with tempfile.TemporaryDirectory() as folder:
        path = f"{HERE.parent}{os.pathsep}{ROOT / 'scripts'}{os.pathsep}{ROOT}"
        # in one thread: the nodes of a model's graph are numbered in the order in which its loops are written
        own = {"PYTHONPATH": path, "HYGROKF_THREADS": "1"}
        command = [sys.executable, "-m", "golden.cases", case.name, str(Path(folder).resolve())]
        done = subprocess.run(
            command, env={**os.environ, **own}, stdout=subprocess.PIPE, cwd=ROOT, check=True
        )
    return json.loads(done.stdout)


def made(case: Case, folder: Path) -> dict:
    """Everything that a case writes and says: `json`, `text`, `page` by file or command, and the digests of
    its `loops`."""
    texts: dict[str, list[str]] = {}
    with in_folder(folder), compiled_texts() as loops:
        case.prepare(folder)
        given = set(folder.rglob("*"))
        for step in case.steps:
            if callable(step):
                texts[step.__name__] = step(folder).splitlines()
            else:
                texts[" ".join(step)] = said(step)
        written = sorted(p for p in folder.rglob("*") if p.is_file() and p not in given)
        result = {
            "json": {named(p, folder): json.loads(p.read_text()) for p in written if p.suffix == ".json"},
            "table": {named(p, folder): table(p, folder) for p in written if p.suffix == ".csv"},
            "page": {named(p, folder): Page(p.read_text()).lines for p in written if p.suffix == ".html"},
        }
    return scrubbed({**result, "text": texts, "loops": sorted(loops)}, folder)


TODAY = re.compile(r"\b20\d\d-\d\d-\d\d[ T]\d\d:\d\d(?::\d\d(?:\+00:00)?)?(?: UTC)?")
BEAT = re.compile(r"hygrokf [a-z]+: \d+ s: ")
"""Signs of life, which come on a slow machine alone."""
SPENT = re.compile(r"\b[\d.]+ (s of CPU|s CPU|seconds)\b")


def scrubbed(value: Any, folder: Path) -> Any:
    """Outputs without what is of one run alone: its folder, the present time, the time it took, and the
    version."""
    if isinstance(value, dict):
        return {key: scrubbed(one, folder) for key, one in value.items()}
    if isinstance(value, list):
        return [scrubbed(one, folder) for one in value]
    if not isinstance(value, str):
        return value
    today = datetime.now(UTC).date().isoformat()
    text = TODAY.sub(lambda found: "NOW" if found.group().startswith(today) else found.group(), value)
    return SPENT.sub(r"# \1", text.replace(str(folder), "FOLDER").replace(__version__, "VERSION"))


def said(command: Sequence[str]) -> list[str]:
    """Exit status and lines of both streams of a command."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(list(command))
    told = [line for line in err.getvalue().splitlines() if not BEAT.match(line)]
    return [f"exit {status}", *out.getvalue().splitlines(), *told]


def named(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()


def table(path: Path, folder: Path) -> dict:
    """Columns of a CSV file: number of rows, of numbers their mean and standard deviation, of texts their
    digest."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(line for line in file if not line.startswith("#")))
    head, body = rows[0], rows[1:]
    found: dict = {"rows": len(body)}
    for name, column in zip(head, zip(*body, strict=True) if body else [()] * len(head), strict=True):
        try:
            numbers = np.array([float(text) if text else np.nan for text in column])
        except ValueError:
            found[name] = hashlib.sha256(scrubbed("\n".join(column), folder).encode()).hexdigest()
            continue
        if np.isfinite(numbers).any():
            found[name] = [float(np.nanmean(numbers)), float(np.nanstd(numbers))]
    return found


class Page(HTMLParser):
    """A page as lines, one a tag or a text: no style, pictures by their size alone, no ids of generated
    drawings."""

    KEPT = ("class", "href", "alt", "lang", "colspan", "rowspan", "scope", "role", "open")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.lines: list[str] = []
        self._quiet = 0
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag in ("style", "script", "svg"):
            self._quiet += 1
        if not self._quiet or tag == "svg":
            kept = [f"{name}={value}" for name, value in attributes if name in self.KEPT]
            self.lines.append(" ".join([f"<{tag}", *kept]) + ">")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("style", "script", "svg"):
            self._quiet -= 1
        elif not self._quiet:
            self.lines.append(f"</{tag}>")

    def handle_data(self, data: str) -> None:
        if not self._quiet and data.strip():
            self.lines.append(" ".join(data.split()))


@contextlib.contextmanager
def in_folder(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


@contextlib.contextmanager
def compiled_texts() -> Iterator[set[str]]:
    """Digests of all texts that are given to the compiler meanwhile, also those that are compiled already."""
    found: set[str] = set()
    real = jit.CompiledCode.__init__

    def noted(
        self: jit.CompiledCode, text: str | Callable[[], str], functions: Sequence[str], source: str = ""
    ) -> None:
        written = text if isinstance(text, str) else text()
        # their derivatives are nodes of the model's graph, numbered after those of loops written before, an
        # order that garbage collection and threads may change: what they are made from stands for them
        told = source if {"adjoint", "tangent"} & {*functions} else written
        found.add(hashlib.sha256(told.encode()).hexdigest()[:16])
        real(self, written, functions, source)

    jit.CompiledCode.__init__ = noted
    try:
        yield found
    finally:
        jit.CompiledCode.__init__ = real


def turbine(days: float, *names: str, seed: int = 31) -> Callable[[Path], None]:
    """Synthetic turbines, each in a folder of its name, seeds from `seed` on."""

    def prepare(folder: Path) -> None:
        for number, name in enumerate(names):
            write_case(synthetic_turbine(seed=seed + number, days=days), folder / name)

    return prepare


def fleet(folder: Path) -> None:
    turbine(5.0, "T1", "T2", "T3", seed=51)(folder)
    (folder / "T3" / "cabinet.csv").unlink()
    (folder / "fleet.toml").write_text(
        'name = "park"\ntask = "fit"\ncases = ["*/case.toml"]\n[options]\nstarts = 1\n'
    )


def playback(folder: Path) -> str:
    """Ten days of a turbine played back into a store, in rounds that do not depend on the machine's speed:
    when alarms begin and from which state the last forecast is made depend on the rounds."""
    from builders.live_case import live_record, live_turbine

    from hygrokf.live.forecast_job import isolation_steps, make_forecast
    from hygrokf.live.sources.local import record_mapping, record_messages
    from hygrokf.live.sources.stream import Delivery
    from hygrokf.live.storage.store import open_store
    from hygrokf.live.turbines import Fleet
    from hygrokf.live.web.views import turbine_view

    record = live_record(folder / "T1", seed=61, days=10.0)
    turbine, mapping = live_turbine(record), record_mapping(record, "T1")
    store = open_store(f"sqlite:{folder / 'store.db'}")
    fleet = Fleet.from_store({"T1": turbine}, store)
    deliveries = [
        Delivery(content, at, place=str(number))
        for number, (at, content) in enumerate(record_messages(record, "T1"), start=1)
    ]
    for first in range(0, len(deliveries), ROUND):
        part = deliveries[first : first + ROUND]
        store.commit(fleet.round(part, mapping, "replay:"))
        store.commit(fleet.tick(part[-1].received, {}))
        while (due := fleet.isolation_due()) is not None:
            finding = next(filter(None, isolation_steps("T1", turbine, due[1], store)))
            store.commit(fleet.keep_finding("T1", finding))
        made = make_forecast("T1", turbine, fleet.tracked["T1"].tracker, store)
        if made is not None:
            fleet.keep_forecast("T1", *made)
            store.commit(made[1])
    last = float(queried(store, "SELECT MAX(time) FROM observation")[0][0])
    view = turbine_view(store, "T1", last - 86400.0, last)
    store.close()
    return json.dumps({**view, "alarms": [asdict(one) for one in view["alarms"]]}, indent=1, sort_keys=True)


def found(cause: str, form: int) -> Callable[[Path], str]:
    """What `discover` finds in a simulated plant that hides a cause."""

    def discovery(folder: Path) -> str:
        from plants.as_record import to_record
        from plants.hidden import hidden_plant

        return discovered(to_record(hidden_plant(PLANT_SEED, cause, form=form, days=PLANT_DAYS)), folder)

    return discovery


def attic(folder: Path) -> str:
    """What `discover` finds in a measured attic."""
    from validation.records import measured

    return discovered(measured("attic R2"), folder)


def discovered(record: Record, folder: Path) -> str:
    one = discover(record)
    write_discovery_report(one, folder / "out")
    return page_text(discovery_blocks(one.results))


UK_WEATHER = """\
name = "UK"
[[source]]
file = "{file}"
time = "datetime_start_utc"
timezone = "UTC"
signals.ambient_temperature = {{ column = "T2m_C", unit = "degC" }}
signals.ambient_dew_point_temperature = {{ column = "Td2m_C", unit = "degC" }}
signals.wind_speed = {{ column = "ws100_mps", unit = "m/s" }}
signals.active_power = {{ column = "P_K2_kW", unit = "kW" }}
"""


def uk(folder: Path) -> None:
    turbine(30.0, "A")(folder)
    (folder / "uk.toml").write_text(UK_WEATHER.format(file=UK))
    for name in ("climate_limits.toml", "climate_test.toml"):
        shutil.copy(document(name), folder)


def nothing(folder: Path) -> None:
    """A case whose steps need no inputs."""


CASES = (
    Case(
        "demo",
        turbine(20.0, "A", "B"),
        (
            ("check", "A/case.toml"),
            ("fit", "A/case.toml", "--out", "fit", "--starts", "2"),
            ("evaluate", "fit", "B/case.toml"),
            ("simulate", "fit", "B/case.toml", "--out", "simulated.csv"),
            ("compare", "A/case.toml", "B/case.toml", "--out", "compared"),
            ("transfer", "fit", "B/case.toml", "--out", "transferred"),
        ),
    ),
    Case(
        "discovery",
        turbine(20.0, "A"),
        (("discover", "A/case.toml", "--out", "out"),),
        large=True,
    ),
    Case("playback", nothing, (playback, ("export", "--store", "sqlite:store.db", "--out", "exported"))),
    Case("fleet", fleet, (("fleet", "fleet.toml", "--out", "park", "--workers", "1"),)),
    Case(
        "uk",
        uk,
        (
            ("fit", "A/case.toml", "--out", "fit", "--starts", "2"),
            (
                "climate",
                "fit",
                "--weather",
                "uk.toml",
                "--power",
                "uk.toml",
                "--limits",
                "climate_limits.toml",
                "--test",
                "climate_test.toml",
                "--members",
                "20",
                "--out",
                "climate",
            ),
        ),
        large=True,
        needs=(UK,),
    ),
    Case("attic", nothing, (attic,), large=True, needs=(ATTIC,)),
    *(Case(f"plant_{cause}", nothing, (found(cause, form),), large=True) for cause, form in PLANTS),
)


if __name__ == "__main__":
    chosen = next(case for case in CASES if case.name == sys.argv[1])
    print(json.dumps(made(chosen, Path(sys.argv[2]))))
