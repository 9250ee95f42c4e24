"""Jobs on the cores of one machine: a process for each, of which one may die without the others.

A process reads jobs from its standard input and writes outcomes to its standard output, one line of JSON
each; it ends with its input.
"""

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

from hygrokf.engine.parallel import THREADS
from hygrokf.fleet.job import LOST, Job, Outcome, Work, outcome, perform

ATTEMPTS = 2
"""Attempts at a job, each in a new process, before it is lost."""
ENVIRONMENT = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", THREADS)}
"""One thread for linear algebra: the matrices are tiny, and every core has a process of its own."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def answer_jobs(work: Work) -> int:
    """What the process runs: do the jobs of the standard input until it ends; returns the exit status 0."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the interrupted parent ends this process
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # other prints must not stand among the answers
    for line in sys.stdin:
        found = perform(Job.from_json(json.loads(line)), work)
        answers.write(json.dumps(found.to_json()) + "\n")
        answers.flush()
    return 0


def in_processes(jobs: Sequence[Job], work: Work, workers: int) -> Iterator[Outcome]:
    """Outcomes of jobs as they come, in no order: exactly one for each.

    A process that dies (killed by the system for its memory, a crash of compiled code) takes its one job with
    it; the job is tried once more, and is `lost` if that process dies too.  When the caller stops early all
    processes end.
    """
    todo: queue.SimpleQueue[Job] = queue.SimpleQueue()
    for job in jobs:
        todo.put(job)
    done: queue.SimpleQueue[Outcome | BaseException] = queue.SimpleQueue()
    crew = [_Worker(work) for _ in range(min(workers, len(jobs)))]
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


def _serve(
    worker: _Worker, todo: queue.SimpleQueue[Job], done: queue.SimpleQueue[Outcome | BaseException]
) -> None:
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
    """A process that does jobs; a new one is started where the last has died."""

    def __init__(self, work: Work) -> None:
        self._work = work
        self.dismissed = False
        self.epitaph = ""
        self._process: subprocess.Popen[str] | None = None
        self._said = tempfile.TemporaryFile()
        self._lock = threading.Lock()

    def ask(self, job: Job) -> Outcome | None:
        """The outcome of a job; None where the process died over it (`epitaph` says why)."""
        process = self._started()
        if process is None:
            return None
        line = ""
        assert process.stdin is not None and process.stdout is not None
        with suppress(OSError, ValueError):  # it may die while the job is written to it
            process.stdin.write(json.dumps(job.to_json()) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        if line.endswith("\n"):
            return Outcome.from_json(json.loads(line))
        self.epitaph = _epitaph(self._reap(process), self._last_words())
        return None

    def _reap(self, process: subprocess.Popen[str]) -> int:
        """Wait for a process to end; returns its exit status."""
        status = process.wait()
        for pipe in (process.stdin, process.stdout):
            with suppress(OSError):  # unwritten text is lost
                if pipe is not None:
                    pipe.close()
        with self._lock:
            self._process = None
        return status

    def _started(self) -> subprocess.Popen[str] | None:
        with self._lock:  # a dismissed worker starts no process
            if self._process is None and not self.dismissed:
                self._said.seek(0)
                self._said.truncate()
                work = self._work
                begin = (
                    f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import answer_jobs; "
                    f"from {work.__module__} import {work.__qualname__} as work; sys.exit(answer_jobs(work))"
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
        """Kill the process."""
        with self._lock:
            self.dismissed = True
            if self._process is not None:
                self._process.kill()

    def close(self) -> None:
        """Kill the process and remove everything that belongs to it."""
        self.dismiss()
        if self._process is not None:
            self._reap(self._process)
        self._said.close()


def _epitaph(status: int, last_words: str) -> str:
    """Why a process died, and what to do."""
    names = {-one.value: one.name for one in signal.Signals}
    end = f"ended with status {status}" if status >= 0 else f"was killed by {names.get(status, status)}"
    reason = f"its process {end}, {ATTEMPTS} times in a row"
    if names.get(status) == "SIGKILL":
        reason += "; the system kills processes when memory is short: run it again with fewer --workers"
    return f"{reason}; its last output: {last_words}" if last_words else reason
