"""The log: one line an event, JSON throughout, whoever speaks and whatever is said."""

from __future__ import annotations

import gc
import json
import logging
import sys
import threading
import warnings

import pytest

from hygrokf.live.tracking import log_to_stderr

ODD = {
    "name of it": "a\nb \udcff \x00 ä",
    "number": float("nan"),
    "far": float("inf"),
    "thing": {1: object()},
}


class Unraisable:
    def __del__(self) -> None:
        raise ValueError("cannot be raised")


def boom() -> None:
    raise RuntimeError("of a thread")


def speak() -> None:
    """All ways to standard error that a library may take."""
    logging.getLogger("hygrokf.track").info("own %s", "words", extra=ODD)
    logging.getLogger("hygrokf.track").info("%d does not fit", "this")
    logging.getLogger("uvicorn.error").error("two\nlines", exc_info=ValueError("inside"))
    logging.getLogger("asyncio").warning("slow")
    logging.getLogger("anything").debug("silent")
    logging.warning("root")
    warnings.warn("old\nways", DeprecationWarning, stacklevel=1)
    thread = threading.Thread(target=boom)
    thread.start()
    thread.join()
    one = Unraisable()
    del one
    gc.collect()


def said(capsys: pytest.CaptureFixture, form: str) -> list[str]:
    with warnings.catch_warnings(), log_to_stderr(form):
        warnings.simplefilter("always")
        logging.captureWarnings(False)  # pytest has its own way to show them
        logging.captureWarnings(True)
        speak()
    return capsys.readouterr().err.splitlines()


def test_every_line_is_an_object(capsys: pytest.CaptureFixture) -> None:
    lines = [json.loads(line, parse_constant=pytest.fail) for line in said(capsys, "json")]
    assert all({"time", "level", "name", "message"} <= set(line) for line in lines)
    told = {line["message"]: line for line in lines}
    assert {"own words", "two\nlines", "slow", "root", "a thread ended by an exception"} <= set(told)
    assert "silent" not in told and told["own words"]["name of it"] == ODD["name of it"]
    assert told["own words"]["number"] == "nan" and told["own words"]["name"] == "hygrokf.track"
    assert "ValueError: inside" in told["two\nlines"]["trace"]
    assert "of a thread" in told["a thread ended by an exception"]["trace"]
    assert told["an exception could not be raised"]["fault"] == "cannot be raised"
    assert any(line["name"] == "py.warnings" and "old" in line["message"] for line in lines)
    assert len(lines) == 8


def test_text_is_one_line_an_event(capsys: pytest.CaptureFixture) -> None:
    lines = said(capsys, "text")
    assert len(lines) == 8 and all(line[:2] == "20" and line[10] == "T" for line in lines)


def test_afterwards_all_is_as_before() -> None:
    root, hooks = logging.getLogger(), (sys.unraisablehook, threading.excepthook)
    before = list(root.handlers), root.level
    with log_to_stderr("json"):
        assert root.handlers != before[0]
    assert (list(root.handlers), root.level) == before and hooks == (sys.unraisablehook, threading.excepthook)
