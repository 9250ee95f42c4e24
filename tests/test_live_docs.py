"""Pages of documentation on the live tracker: what they tell to do is done, and every key of its file stands
in them."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

import pytest
from builders.documents import ROOT, document, run_page
from builders.fit_case import bare_fit
from builders.ports import free_port
from builders.track_case import MODEL

from hygrokf.data.record import Site
from hygrokf.data.toml_form import keys_of
from hygrokf.identification.fit import write_fit
from hygrokf.live import config
from hygrokf.live.config import (
    MappingForm,
    SignalForm,
    SurfaceForm,
    TrackForm,
    TurbineForm,
    WanderingForm,
    read_config,
)
from hygrokf.live.notification.transports import Mail, Webhook
from hygrokf.live.plan import TRACKED_PROPERTIES
from hygrokf.live.sources.broker import Broker
from hygrokf.live.sources.local import FileForm
from hygrokf.live.sources.opcua_form import Server
from hygrokf.live.sources.postgres_source import PostgresForm
from hygrokf.live.sources.stream import SourceKeys
from hygrokf.live.tracking import LogLines
from hygrokf.live.web.page_settings import PageForm

PATIENCE_S = 120.0
PORT = "127.0.0.1:8080"
TUTORIAL = document("live_tutorial.md")
OPERATION = document("live_operation.md")


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


@contextmanager
def started(command: str, folder: Path) -> Iterator[subprocess.Popen]:
    """A command of a page that stays, in a process of its own, which ends with the block."""
    assert command.startswith("hygrokf ")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error", "OMP_NUM_THREADS": "1"}
    with (folder / "stderr").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", *command.split()],
            cwd=folder,
            env=environment,
            stderr=log,
            stdin=subprocess.DEVNULL,
        )
    try:
        yield process
    finally:
        process.kill()
        process.wait(timeout=PATIENCE_S)


def test_the_tutorial_from_a_fit_to_a_live_page(tmp_path: Path) -> None:
    """The page's blocks in their order: what comes before `hygrokf track`, that command, what comes after it
    beside it."""
    address = f"127.0.0.1:{free_port()}"
    text = TUTORIAL.read_text(encoding="utf-8")
    assert text.count(PORT) >= 4
    track = next(block for block in blocks(TUTORIAL, "bash") if block.startswith("hygrokf track"))
    before, after = text.replace(PORT, address).split(f"```bash\n{track.replace(PORT, address)}```")
    parts = {}
    for name, part in (("before", before), ("after", after)):
        parts[name] = tmp_path / f"{name}.md"
        parts[name].write_text(part, encoding="utf-8")
    folder = tmp_path / "work"
    folder.mkdir()
    done = run_page(parts["before"], folder, "python,bash")
    assert done.returncode == 0, done.stdout + done.stderr
    assert " 0 fault: ready to track" in done.stdout and "rows gave readings" in done.stdout
    with started(track.replace(PORT, address), folder) as process:
        end = time.monotonic() + PATIENCE_S
        while True:  # what follows looks at the page at once
            assert process.poll() is None and time.monotonic() < end, (folder / "stderr").read_text()
            try:
                urllib.request.urlopen(f"http://{address}/healthz", timeout=5.0).close()
                break
            except OSError:
                time.sleep(0.1)
        parts["after"].write_text(
            "```python\nimport time\n```\n" + parts["after"].read_text(encoding="utf-8")
        )
        done = run_page(parts["after"], folder, "python,bash")
        assert done.returncode == 0, done.stdout + done.stderr + (folder / "stderr").read_text()
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=PATIENCE_S) == 0, (folder / "stderr").read_text()
    said = done.stdout.splitlines()[0].split()
    assert len(said) >= 4 and -30.0 < float(said[-3]) < 70.0 and 0.0 < float(said[-2]) < 100.0
    assert (folder / "history" / "observation.csv").is_file() and "Traceback" not in (
        folder / "stderr"
    ).read_text()
    (folder / "track.toml").write_text(blocks(TUTORIAL, "toml")[0])
    assert list(read_config(folder / "track.toml").turbines) == ["T07"]
    doctor = subprocess.run(
        [sys.executable, "-m", "hygrokf", "doctor", "track.toml", "--no-page", "--wait", "1s"],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "does not exist yet" in doctor.stdout  # T07 gets all lines of live.csv


def test_the_example_of_the_tracker_s_file_can_be_read(tmp_path: Path) -> None:
    values = {p.name: p.start for p in MODEL.model.parameters}
    write_fit(bare_fit("one", MODEL, values), tmp_path / "models" / "T07")
    (text,) = blocks(OPERATION, "toml")
    (tmp_path / "track.toml").write_text(text, encoding="utf-8")
    found = read_config(tmp_path / "track.toml")
    assert list(found.turbines) == ["T07"] and [one.mapping.weather for one in found.streams] == [False, True]


@pytest.mark.parametrize(
    ("page", "forms"),
    [
        (OPERATION, (TrackForm, TurbineForm, SignalForm, SurfaceForm, WanderingForm, Site)),
        (document("live_mapping.md"), (MappingForm,)),
        (OPERATION, (FileForm, PageForm)),
        (document("live_page.md"), (PageForm,)),
        (document("live_mqtt.md"), (Broker,)),
        (document("live_notify.md"), (Mail, Webhook)),
        (document("live_opcua.md"), (Server,)),
        (document("live_postgres.md"), (PostgresForm,)),
    ],
    ids=lambda value: value.name if isinstance(value, Path) else "",
)  # fmt: skip
def test_every_key_of_the_tracker_s_file_stands_in_the_pages(page: Path, forms: tuple[type, ...]) -> None:
    text = page.read_text(encoding="utf-8")
    common = () if page == OPERATION else keys_of(SourceKeys)
    keys = [key for form in forms for key in keys_of(form) if key not in common]
    assert [key for key in keys if not re.search(rf"(^|[`\[{{ .]){key}[`\]\" =]", text, re.MULTILINE)] == []


def test_defaults_that_are_told_are_those_of_the_code() -> None:
    text = OPERATION.read_text(encoding="utf-8")
    rates = {name: rate for name, (_, rate) in TRACKED_PROPERTIES.items()}
    for names, said in re.findall(r"^\| (`wandering[^|]*)\|[^|]*\| ([^|]*) \|$", text, re.MULTILINE):
        told = [float(number) for number in said.split(" and ")]
        stated = [rates.pop(name) for name in re.findall(r"`(\w+)`", names)]
        assert stated == (told if len(told) == len(stated) else told * len(stated))
    assert rates == {}
    assert config.RETENTION_S == 400 * 86400.0 and "`400d`" in text
    assert config.LATENESS_S == 1800.0 and "`30min`" in text
    assert [f.default for f in fields(config.Surface)] == [0.3, 0.0] and "0.3 and 0" in text


def test_the_fields_of_the_log_are_those_that_are_told() -> None:
    import json
    import logging

    record = logging.makeLogRecord({"name": "hygrokf.track", "levelname": "INFO", "msg": "x", "created": 0.0})
    section = OPERATION.read_text(encoding="utf-8").partition("## Logs")[2].partition("\n## ")[0]
    names = set(re.findall(r"`(\w+)`", section))
    assert set(json.loads(LogLines("json").format(record))) <= names
