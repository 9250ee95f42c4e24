"""`hygrokf doctor --try`: payloads of a file or a topic, and what the mapping makes of them."""

from __future__ import annotations

import gzip
import json
import time
from pathlib import Path

import pytest
from builders.brokers import mosquitto, needs_mosquitto, overheard, peer, publish
from builders.track_case import write_model
from builders.waiting import repeating

from hygrokf.commands.main import main
from hygrokf.live.doctor.payloads import MOST_SHOWN

TRACK = """\
[[turbine]]
name = "T07"
fit = "T07"
[mapping]
turbine = "{1}"
time = "t"
[mapping.signals]
Tcab = { signal = "cabinet_temperature", unit = "degC" }
[[source]]
url = "URL"
topics = ["scada/+/cabinet"]
"""
PAYLOAD = json.dumps({"t": "2026-03-01T12:10:00Z", "Tcab": 31.2})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_model(tmp_path / "T07")
    (tmp_path / "track.toml").write_text(TRACK.replace("URL", "mqtt://127.0.0.1:1"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def tried(capsys: pytest.CaptureFixture, what: str, *options: str) -> tuple[int, str, str]:
    status = main(["doctor", "track.toml", "--try", what, *options])
    return status, *capsys.readouterr()


def test_captured_messages(folder: Path, capsys: pytest.CaptureFixture) -> None:
    lines = [f"scada/T07/cabinet {PAYLOAD}", f"scada/T99/cabinet {PAYLOAD}", "scada/T07/cabinet {}\x1b[31m"]
    (folder / "captured.txt").write_text("\n".join(lines) + "\n")
    status, said, _ = tried(capsys, "captured.txt")
    assert status == 0 and "T07  cabinet_temperature  2026-03-01T12:10Z  31.2 degC" in said
    assert "unknown turbine: turbine 'T99' is not tracked" in said and "\x1b" not in said
    assert "1 of 3 payloads gave readings" in said
    (folder / "captured.gz").write_bytes(gzip.compress("\n".join(lines * 40).encode()))
    status, said, _ = tried(capsys, "captured.gz", "--json")
    (found,) = json.loads(said)["trials"]
    assert status == 0 and (found["count"], found["used"], len(found["payloads"])) == (120, 40, MOST_SHOWN)
    assert found["payloads"][0]["readings"][0]["signal"] == "cabinet_temperature"
    assert {path.name for path in folder.iterdir()} == {"T07", "captured.gz", "captured.txt", "track.toml"}


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("empty.txt", b"", "0 of 0 payloads"), ("none.json", b'{"t": 1', "0 of 1 payloads"),
        ("cut.gz", gzip.compress(PAYLOAD.encode(), mtime=0)[:20], "cannot be read"),
        ("bytes", bytes(range(256)), "0 of"),
        ("folder", None, "cannot be read: Is a directory"),
    ],
)  # fmt: skip
def test_files_that_give_nothing(
    folder: Path, capsys: pytest.CaptureFixture, name: str, content: bytes | None, said: str
) -> None:
    (folder / name).mkdir() if content is None else (folder / name).write_bytes(content)
    status, out, err = tried(capsys, name)
    assert status in (1, 2) and said in out + err and "Traceback" not in err


def test_brokers_that_are_not_reached_and_topics_that_are_none(
    folder: Path, capsys: pytest.CaptureFixture
) -> None:
    status, _, err = tried(capsys, "scada/+/cabinet")
    assert status == 2 and "refused: nothing listens there" in err
    status, _, err = tried(capsys, "scada/a+")
    assert status == 2 and "there is no file 'scada/a+'" in err
    text = (folder / "track.toml").read_text().split("[[source]]")[0] + '[[source]]\nurl = "stdin"\n'
    (folder / "track.toml").write_text(text)
    status, _, err = tried(capsys, "scada/+/cabinet")
    assert status == 2 and "a topic needs a [[source]] that is a broker" in err


@needs_mosquitto
def test_messages_of_a_topic(folder: Path, capsys: pytest.CaptureFixture) -> None:
    """They are heard, and whoever else reads them loses nothing."""
    (folder / "broker").mkdir()
    with mosquitto(folder / "broker") as broker:
        (folder / "track.toml").write_text(TRACK.replace("URL", broker.url))
        with peer(broker) as client, peer(broker) as other:
            beside = overheard(other, "scada/#")
            publish(client, [("scada/T07/cabinet", PAYLOAD)], retain=True)
            both = [("scada/T07/cabinet", PAYLOAD), ("scada/T07/cabinet", "31.2")]
            with repeating(lambda: publish(client, both)):
                status, said, err = tried(capsys, "scada/+/cabinet", "--wait", "900ms")
            time.sleep(0.1)
            assert len(beside) > 2
        assert status == 0, err
        assert said.count("T07  cabinet_temperature  2026-03-01T12:10Z  31.2 degC") >= 2
        assert "not used: malformed: expected a JSON object" in said
        assert not (folder / "live.db").exists() and "hygrokf-doctor" in broker.log()
