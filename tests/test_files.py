"""Files are written whole or not at all."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from hygrokf.data import files
from hygrokf.data.files import write_bytes_whole, write_text_whole


def test_text_arrives_as_utf8_with_its_line_ends(tmp_path):
    path = write_text_whole(tmp_path / "a.txt", "τ = 1 h\nρ\r\n")
    assert path.read_bytes() == "τ = 1 h\nρ\r\n".encode()
    assert [one.name for one in tmp_path.iterdir()] == ["a.txt"]


def test_old_content_is_replaced(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old and longer")
    write_bytes_whole(path, b"new")
    assert path.read_bytes() == b"new"


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_failure_on_the_way_leaves_the_old_file_and_no_litter(tmp_path, monkeypatch, step):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, step, full)
    with pytest.raises(OSError, match="No space left"):
        write_text_whole(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert [one.name for one in tmp_path.iterdir()] == ["a.txt"]


def test_interruption_leaves_nothing_behind(tmp_path, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(files.os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_text_whole(tmp_path / "a.txt", "new")
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


def test_the_target_is_complete_before_it_is_renamed(tmp_path, monkeypatch):
    seen = []
    real = os.replace

    def look(source, target):
        seen.append(Path(source).read_bytes())
        real(source, target)

    monkeypatch.setattr(files.os, "replace", look)
    write_bytes_whole(tmp_path / "a.bin", b"x" * 100_000)
    assert seen == [b"x" * 100_000]


def test_missing_directory_is_the_systems_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_text_whole(tmp_path / "nowhere" / "a.txt", "x")


@pytest.mark.skipif(sys.platform == "win32", reason="permissions and links as POSIX has them")
def test_permissions_and_links_survive(tmp_path):
    real = tmp_path / "real.txt"
    real.write_text("old")
    real.chmod(0o640)
    link = tmp_path / "link.txt"
    link.symlink_to(real)
    write_text_whole(link, "new")
    assert link.is_symlink()
    assert real.read_text() == "new"
    assert real.stat().st_mode & 0o777 == 0o640
