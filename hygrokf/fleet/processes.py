"""Jobs on the cores of one machine: a process for each, of which one may die without the others."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

from hygrokf.fleet.job import LOST, Job, Outcome, outcome
from hygrokf.fleet.worker import ENVIRONMENT

ATTEMPTS = 2
"""A job whose process died is done again in a new one, so often in all."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_processes(jobs: Sequence[Job], workers: int) -> Iterator[Outcome]:
    """Outcomes of jobs as they come, in no order: exactly one for each.

    A process that dies (killed by the system for its memory, a crash of compiled code) takes its one job with
    it; that is tried once more, and is `lost` if that process dies too.  When the caller stops early all
    processes end.
    """
    todo: queue.SimpleQueue[Job] = queue.SimpleQueue()
    for job in jobs:
        todo.put(job)
    done: queue.SimpleQueue[Outcome | BaseException] = queue.SimpleQueue()
    crew = [_Worker() for _ in range(min(workers, len(jobs)))]
    threads = [threading.Thread(target=_serve, args=(one, todo, done), daemon=True) for one in crew]
    for thread in threads:
        thread.start()
    try:
        for _ in jobs:
            found = done.get()
            if isinstance(found, BaseException):
                raise found
            yield found
    finally:
        for one in crew:
            one.dismiss()
        for thread in threads:
            thread.join()


def _serve(worker: _Worker, todo: queue.SimpleQueue[Any], done: queue.SimpleQueue[Any]) -> None:
    """Give a worker one job after the other."""
    try:
        while not worker.dismissed:
            try:
                job = todo.get_nowait()
            except queue.Empty:
                break
            found = None
            for _ in range(ATTEMPTS):
                found = found or (None if worker.dismissed else worker.ask(job))
            done.put(found or outcome(job, LOST, reason=worker.epitaph))
    except BaseException as fault:  # the caller waits for an outcome of every job
        done.put(fault)
    finally:
        worker.close()


class _Worker:
    """A process that answers; a new one is started where the last has died."""

    def __init__(self) -> None:
        self.dismissed = False
        self.epitaph = ""
        self._process: subprocess.Popen[str] | None = None
        self._said = tempfile.TemporaryFile()
        self._lock = threading.Lock()

    def ask(self, job: Job) -> Outcome | None:
        """The outcome of a job; None where the process died over it (`epitaph` says of what)."""
        process = self._started()
        if process is None:
            return None
        line = ""
        assert process.stdin is not None and process.stdout is not None
        with suppress(OSError, ValueError):  # it may die while it is written to
            process.stdin.write(json.dumps(job.to_json()) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        if line.endswith("\n"):
            return Outcome.from_json(json.loads(line))
        self.epitaph = _epitaph(self._buried(process), self._last_words())
        return None

    def _buried(self, process: subprocess.Popen[str]) -> int:
        """Exit status of a process that has ended or is about to; a new one can be started after it."""
        status = process.wait()
        for pipe in (process.stdin, process.stdout):
            with suppress(OSError):  # what was not written can not be written any more
                if pipe is not None:
                    pipe.close()
        with self._lock:
            self._process = None
        return status

    def _started(self) -> subprocess.Popen[str] | None:
        with self._lock:  # a worker that is dismissed starts no process any more
            if self._process is None and not self.dismissed:
                self._said.seek(0)
                self._said.truncate()
                # the same places of modules as here, in the same order
                begin = (
                    f"import sys; sys.path[:] = {sys.path!r}; from hygrokf.fleet.worker import main; "
                    "sys.exit(main())"
                )
                self._process = subprocess.Popen(
                    [sys.executable, "-c", begin],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=self._said,
                    text=True,
                    encoding="utf-8",
                    env={**os.environ, **ENVIRONMENT},
                )
            return self._process

    def _last_words(self) -> str:
        """The last line that the process wrote to its standard error."""
        self._said.seek(max(0, self._said.seek(0, os.SEEK_END) - 4000))
        lines = self._said.read().decode(errors="replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

    def dismiss(self) -> None:
        """End the process, whatever it does."""
        with self._lock:
            self.dismissed = True
            if self._process is not None:
                self._process.kill()

    def close(self) -> None:
        """The same, and nothing of it is left."""
        self.dismiss()
        if self._process is not None:
            self._buried(self._process)
        self._said.close()


def _epitaph(status: int, last_words: str) -> str:
    """What a process died of, and what to do."""
    killer = ""
    if status >= 0:
        said = f"its process ended with status {status}"
    else:
        killer = str(status)
        with suppress(ValueError):
            killer = signal.Signals(-status).name
        said = f"its process was killed by {killer}"
    said += f", {ATTEMPTS} times in a row"
    if killer == "SIGKILL":
        said += "; the system does so where memory is short: run it again with fewer --workers"
    return f"{said}; it last said: {last_words}" if last_words else said
