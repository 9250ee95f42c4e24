"""The jobs of a plan, on one machine or a cluster; their table, and the type of turbine pooled from fits."""

from __future__ import annotations

import logging
import math
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from hygrokf.data.files import FLEET, TYPE, write_bytes_whole, write_text_whole
from hygrokf.data.result_file import ResultFault, result_text
from hygrokf.data.structured import JsonObject
from hygrokf.engine.parallel import THREADS
from hygrokf.fleet.job import (
    DONE,
    LOST,
    FleetFault,
    Job,
    Row,
    Work,
    finished,
    keep,
    perform,
    row_of,
)
from hygrokf.fleet.outliers import spreads
from hygrokf.fleet.plan import FleetPlan
from hygrokf.fleet.results import CSV, PARQUET, FleetResults, table_csv, table_parquet
from hygrokf.fleet.tasks import TASKS
from hygrokf.identification.fit import read_fit
from hygrokf.identification.turbine_type import TurbineType, TypeFault, pool_types, write_type
from hygrokf.texts.fleet import FleetCode
from hygrokf.texts.statement import Statement
from hygrokf.version import __version__

FEWEST_OF_A_TYPE = 3
"""Fewest turbines from which a type is pooled."""
EVERY_S = 2.0
"""[s] between two writings of the table while results come."""


def run_jobs(
    plan: FleetPlan,
    out: Path,
    work: Work,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    say: Callable[[Row, bool], None] = lambda found, known: None,
) -> FleetResults:
    """Do the work for every turbine of a plan and write fleet.json, fleet.csv, fleet.parquet and, of three
    fits or more, type.json.

    plan, out, workers, cluster, say: as for `hygrokf.run_fleet`. work: what is done for one turbine.

    Returns the table.  Raises FleetFault where there is no cluster.
    """
    jobs = {job.turbine: job for job in plan.jobs(out)}
    out.mkdir(parents=True, exist_ok=True)
    found: dict[str, Row] = {}
    for name, job in jobs.items():
        if (known := finished(job)) is not None:
            found[name] = known
            say(known, True)
    todo = [job for name, job in jobs.items() if name not in found]
    written = time.monotonic()
    if not todo:
        coming: Iterator[Row] = iter(())
    elif cluster:
        coming = on_cluster(todo, work, cluster)
    else:
        coming = in_processes(todo, work, workers or cores())
    for one in coming:
        name = str(one["turbine"])
        found[name] = one
        if one["status"] == LOST:  # its process could not write the row
            keep(jobs[name], one)
        say(one, False)
        if time.monotonic() - written > EVERY_S:
            rows = [found[name] for name in jobs if name in found]
            write_text_whole(out / CSV, table_csv(plan.task, rows))
            written = time.monotonic()
    return _written(plan, out, [found[name] for name in jobs])


def _written(plan: FleetPlan, out: Path, rows: Sequence[Row]) -> FleetResults:
    write_text_whole(out / CSV, table_csv(plan.task, rows))
    binary = table_parquet(plan.task, rows)
    if binary is None:
        (out / PARQUET).unlink(missing_ok=True)  # that of an earlier run has other numbers
    else:
        write_bytes_whole(out / PARQUET, binary)
    kind, without = _type_of(plan, out, rows)
    results = FleetResults(
        task=plan.task,
        rows=tuple(rows),
        name=plan.name,
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        options=dict(plan.options),
        type=kind,
        type_without=tuple(without),
    )
    write_text_whole(out / FLEET, result_text(results))
    return results


def _type_of(plan: FleetPlan, out: Path, rows: Sequence[Row]) -> tuple[TurbineType | None, list[str]]:
    """The type of turbine pooled from a fleet's fits, also written as `type.json`, and the turbines left out.

    Turbines whose time constants depart from the others' are left out; the type is None where the fits share
    none.
    """
    file = out / TYPE
    file.unlink(missing_ok=True)  # that of an earlier run was made of other fits
    done = [row for row in rows if row["status"] == DONE]
    names = [str(row["turbine"]) for row in done]
    if plan.task != "fit" or len(names) < FEWEST_OF_A_TYPE:
        return None, []
    constants = [one for one in spreads(done, TASKS[plan.task].compared) if one.compared.lower]
    odd = sorted({one.turbines[i] for one in constants for i in one.outliers})
    try:
        fits = [replace(read_fit(plan.folder(out, name)), name=name) for name in names if name not in odd]
        kind = pool_types(fits, plan.name)
    except (TypeFault, ResultFault):  # the fits have nothing in common, or someone has removed them
        return None, []
    write_type(kind, file)
    return kind, odd


BATCHES = 8
"""Batches for each worker: so many that no worker waits long for the others at the end."""
LARGEST = 25
"""Most jobs in a batch: all of them are done again where its worker dies."""
WAIT_S = 30.0
"""[s] time limit for the connection to the scheduler, and for its first worker."""
_one_at_a_time = threading.Lock()


def perform_batch(jobs: Sequence[Job], work: Work) -> list[Row]:
    """What a worker of the cluster runs: some jobs, one after the other."""
    with _one_at_a_time:  # a worker with several threads receives several batches
        return [perform(job, work) for job in jobs]


def batches(jobs: Sequence[Job], workers: int) -> list[Sequence[Job]]:
    """Jobs in batches, in their order."""
    size = max(1, min(LARGEST, math.ceil(len(jobs) / (BATCHES * max(workers, 1)))))
    return [jobs[i : i + size] for i in range(0, len(jobs), size)]


def on_cluster(jobs: Sequence[Job], work: Work, address: str) -> Iterator[Row]:
    """Rows of jobs as they come, in no order: exactly one for each.

    Another worker repeats a batch whose worker has died.  Where that happens more often than the scheduler
    allows, its jobs are sent one by one, and a job that goes on killing workers is `lost`.  Raises
    FleetFault where there is no cluster at the address, no worker, or another version of hygrokf on it, and
    where the scheduler ends before the work.
    """
    try:
        from distributed import Client
        from distributed import as_completed as outcomes_of
    except ImportError:
        raise FleetFault("--dask", ["needs dask.distributed: pip install 'hygrokf[cluster]'"]) from None
    with _quiet(), _client(Client, address) as client:
        workers = _checked(client, address)
        sent = {}

        def send(batch: Sequence[Job]) -> object:
            future = client.submit(perform_batch, batch, work, pure=False)
            sent[future.key] = batch
            return future

        coming = outcomes_of([send(batch) for batch in batches(jobs, workers)], loop=client.loop)
        for future in coming:
            batch = sent.pop(future.key)
            if future.status == "finished":
                yield from future.result()
            elif future.status != "error":  # the worker's death is an error; this is the scheduler's
                raise FleetFault(
                    f"--dask {address}",
                    [
                        "the scheduler ended before the work was done, or is no longer reachable (the tasks "
                        f"are {future.status}); finished turbines are kept: start a scheduler with workers, "
                        "and run the same command again"
                    ],
                )
            elif len(batch) > 1:
                coming.update([send([job]) for job in batch])
            else:
                reason = " ".join(str(future.exception()).split())
                yield row_of(batch[0], LOST, reason=FleetCode.NO_WORKER(fault=reason))


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the tracebacks that the client logs where a scheduler ends; `on_cluster` reports it."""
    log = logging.getLogger("distributed.client")
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(before)


def _client(kind: type, address: str) -> Any:
    try:
        return kind(address, timeout=WAIT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as fault:
        said = " ".join(str(fault).split())
        raise FleetFault(
            f"--dask {address}",
            [f"expected the scheduler of a Dask cluster, such as tcp://HOST:8786, found none: {said}"],
        ) from None


def _checked(client: Any, address: str) -> int:
    """The number of workers; raises FleetFault where one of them cannot do the work."""
    try:
        client.wait_for_workers(1, timeout=WAIT_S)
    except TimeoutError:
        raise FleetFault(
            f"--dask {address}",
            [f"the scheduler has no worker after {WAIT_S:g} s: start some with `dask worker {address}`"],
        ) from None
    faults = []
    for worker, found in client.run(_described, on_error="return").items():
        if isinstance(found, BaseException):
            faults.append(f"worker {worker}: hygrokf cannot be loaded there: {found}; install it there too")
        elif found["version"] != __version__:
            faults.append(
                f"worker {worker}: expected hygrokf {__version__} as here, found {found['version']}; install "
                "the same one"
            )
        elif found["threads"] != "1":
            faults.append(
                f"worker {worker}: expected one thread for linear algebra, found OMP_NUM_THREADS = "
                f"{found['threads'] or 'not set'}; start it with a nanny (the default), or set "
                "OMP_NUM_THREADS=1 there"
            )
    if faults:
        raise FleetFault(f"--dask {address}", faults)
    return len(client.scheduler_info(n_workers=-1)["workers"])


def _described() -> JsonObject:
    return {"version": __version__, "threads": os.environ.get("OMP_NUM_THREADS", "")}


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
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # other prints must not stand among the answers
    with suppress(EOFError):
        while True:
            pickle.dump(perform(pickle.load(sys.stdin.buffer), work), answers)
            answers.flush()
    return 0


def in_processes(jobs: Sequence[Job], work: Work, workers: int) -> Iterator[Row]:
    """Rows of jobs as they come, in no order: exactly one for each.

    A process that dies (killed by the system for its memory, a crash of compiled code) takes its one job with
    it; the job is tried once more, and is `lost` if that process dies too.  When the caller stops early all
    processes end.
    """
    crew = _Crew(work)
    pool = ThreadPoolExecutor(min(workers, len(jobs)))
    try:
        for future in as_completed([pool.submit(crew.do, job) for job in jobs]):
            yield future.result()
    finally:
        crew.dismiss()
        pool.shutdown(cancel_futures=True)
        crew.bury_all()


class _Crew:
    """Processes that do jobs, one for each thread that asks; a new one is started where the last has died."""

    def __init__(self, work: Work) -> None:
        self._begin = (
            f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import answer_jobs; "
            f"from {work.__module__} import {work.__qualname__} as work; sys.exit(answer_jobs(work))"
        )
        self._own, self._lock, self._dismissed = threading.local(), threading.Lock(), False
        self._said: dict[subprocess.Popen[bytes], IO[bytes]] = {}
        """What each process writes to its standard error."""

    def do(self, job: Job) -> Row:
        """The row of a job; it is lost where the process died over it every time."""
        reason: str | Statement = ""
        for _ in range(ATTEMPTS):
            if (process := self._process()) is None:
                break
            assert process.stdin is not None and process.stdout is not None
            with suppress(OSError, ValueError, EOFError, pickle.UnpicklingError):  # it may die over the job
                pickle.dump(job, process.stdin)
                process.stdin.flush()
                found: Row = pickle.load(process.stdout)
                return found
            reason = self._buried(process)
        return row_of(job, LOST, reason=reason)

    def _process(self) -> subprocess.Popen[bytes] | None:
        with self._lock:  # a dismissed crew starts no process
            process: subprocess.Popen[bytes] | None = getattr(self._own, "process", None)
            if process is None and not self._dismissed:
                said = tempfile.TemporaryFile()
                process = self._own.process = subprocess.Popen(
                    [sys.executable, "-c", self._begin],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=said,
                    env={**os.environ, **ENVIRONMENT},
                )
                self._said[process] = said
            return process

    def _buried(self, process: subprocess.Popen[bytes]) -> Statement:
        """Wait for a process to end, and close what belongs to it; returns why it died."""
        status, self._own.process = process.wait(), None
        for pipe in (process.stdin, process.stdout):
            with suppress(OSError):  # unwritten text is lost
                if pipe is not None:
                    pipe.close()
        with self._lock:
            said = self._said.pop(process)
        with said:
            said.seek(max(0, said.seek(0, os.SEEK_END) - 4000))
            lines = said.read().decode(errors="replace").split("\n")
        return _epitaph(status, next((line.strip() for line in reversed(lines) if line.strip()), ""))

    def dismiss(self) -> None:
        with self._lock:
            self._dismissed = True
            for process in self._said:
                process.kill()

    def bury_all(self) -> None:
        """Remove everything that belongs to dismissed processes."""
        for process in list(self._said):
            self._buried(process)


def _epitaph(status: int, last_words: str) -> Statement:
    """Why a process ended, and the last line that it wrote."""
    names = {-one.value: one.name for one in signal.Signals}
    if status >= 0:
        end = FleetCode.PROCESS_ENDED(status=status, attempts=ATTEMPTS)
    else:
        end = FleetCode.PROCESS_KILLED(signal=names.get(status, str(status)), attempts=ATTEMPTS)
    if names.get(status) == "SIGKILL":
        end = FleetCode.MEMORY_SHORT(end=end)
    return FleetCode.LAST_OUTPUT(end=end, output=last_words) if last_words else end
