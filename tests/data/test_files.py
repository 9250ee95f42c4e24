"""Files are written whole or not at all."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import nullcontext
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


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_is_written_to_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = subprocess.Popen(["cat", str(pipe)], stdout=subprocess.PIPE)
    write_text_whole(pipe, "time,value\n")
    assert reader.communicate(timeout=10)[0] == b"time,value\n"
    assert pipe.is_fifo()
    assert [one.name for one in tmp_path.iterdir()] == ["pipe"]


@pytest.mark.parametrize("redirected", [False, True], ids=["a pipe", "a file"])
def test_standard_output_is_written_to(tmp_path: Path, redirected: bool) -> None:
    code = (
        "import sys; from hygrokf.data.files import write_text_whole as w; print('a', flush=True); "
        "w('/dev/stdout', 'b\\n')"
    )
    to = tmp_path / "shown"
    with open(to, "wb") if redirected else nullcontext(subprocess.PIPE) as stdout:
        done = subprocess.run([sys.executable, "-c", code], stdout=stdout, check=True)
    assert (to.read_bytes() if redirected else done.stdout) == b"a\nb\n"
