"""The steps of a long computation: told to a function, shown as one line in a notebook or on a terminal."""

from __future__ import annotations

import io
import sys
from types import ModuleType, SimpleNamespace

import pytest

from hygrokf.data.progress import reporting


def test_a_function_is_told_the_steps_and_nothing_more() -> None:
    told: list[str] = []
    with reporting(told.append, "identify") as say:
        say("start 1 of 2")
    assert told == ["start 1 of 2"]


@pytest.mark.parametrize("silent", [None, False])
def test_nothing_is_shown_unless_it_is_asked_for(silent, capsys) -> None:
    with reporting(silent, "identify") as say:
        say("start 1 of 2")
    assert capsys.readouterr() == ("", "")


def test_a_terminal_shows_one_line_that_is_overwritten(monkeypatch) -> None:
    screen = io.StringIO()
    screen.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stderr", screen)
    with reporting(True, "identify") as say:
        say("start 1 of 2")
    shown = screen.getvalue()
    assert shown.count("\n") == 1 and shown.endswith("\n")
    assert [line.partition(" (")[0] for line in shown.split("\r")] == [
        "", "identify: begins", "identify: start 1 of 2", "identify: done",
    ]  # fmt: skip


def test_a_log_has_a_line_for_each_step_and_how_it_ended(capsys) -> None:
    with pytest.raises(ValueError, match="no readings"), reporting(True, "identify") as say:
        say("start 1 of 2")
        raise ValueError("no readings")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and lines[-1].startswith("identify: stopped by ValueError (")


class _Display:
    """Stands for IPython's display: the outputs of a cell, each of which can be updated."""

    def __init__(self) -> None:
        self.outputs: list[list[str]] = []

    def __call__(self, data: dict[str, str], *, raw: bool, display_id: bool) -> SimpleNamespace:
        assert raw and display_id
        history = [data["text/plain"]]
        self.outputs.append(history)
        return SimpleNamespace(update=lambda data, raw: history.append(data["text/plain"]))


def _ipython(monkeypatch, shell: object) -> _Display:
    display = _Display()
    made, of_display = ModuleType("IPython"), ModuleType("IPython.display")
    made.get_ipython, of_display.display = lambda: shell, display  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython", made)
    monkeypatch.setitem(sys.modules, "IPython.display", of_display)
    return display


def test_a_notebook_shows_one_output_that_is_updated(monkeypatch, capsys) -> None:
    display = _ipython(monkeypatch, SimpleNamespace(kernel=object()))
    with reporting(True, "discover") as say:
        say("solar_gain")
    (history,) = display.outputs
    assert [text.partition(" (")[0] for text in history] == [
        "", "discover: begins", "discover: solar_gain", "discover: done",
    ]  # fmt: skip
    assert capsys.readouterr() == ("", "")


def test_ipython_on_a_terminal_has_the_line_of_a_terminal(monkeypatch, capsys) -> None:
    display = _ipython(monkeypatch, SimpleNamespace())
    with reporting(True, "discover"):
        pass
    assert display.outputs == [] and "discover: done" in capsys.readouterr().err
