"""Runs the jobs of a plan on this machine or a cluster, and writes their table and the type of turbine pooled
from the fits."""

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
from hygrokf.fleet.fleet_plan import FleetPlan
from hygrokf.fleet.fleet_results import CSV, PARQUET, FleetResults, table_csv, table_parquet
from hygrokf.fleet.job import (
    DONE,
    LOST,
    FleetFault,
    Job,
    Row,
    Work,
    perform,
    row_of,
    stored_row,
    write_row,
)
from hygrokf.fleet.outliers import spreads
from hygrokf.fleet.tasks import TASKS
from hygrokf.identification.fit import read_fit
from hygrokf.identification.turbine_type import TurbineType, TypeFault, pool_types, write_type
from hygrokf.texts.fleet_codes import FleetCode
from hygrokf.texts.statement import Statement
from hygrokf.version import __version__

FEWEST_POOLED = 3
"""Smallest number of turbines from which a type is pooled."""
TABLE_S = 2.0
"""[s] while results arrive, the table is written no more often than this."""


def run_jobs(
    plan: FleetPlan,
    out: Path,
    work: Work,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    say: Callable[[Row, bool], None] = lambda row, is_stored: None,
) -> FleetResults:
    """Do the work for every turbine of a plan; write fleet.json, fleet.csv, fleet.parquet and, from three
    fits on, type.json.

    plan, out, workers, cluster, say: as for `hygrokf.run_fleet`. work: called for each turbine.

    Returns the table. Raises FleetFault if the cluster cannot be reached.
    """
    jobs = {job.turbine: job for job in plan.jobs(out)}
    out.mkdir(parents=True, exist_ok=True)
    rows: dict[str, Row] = {}
    for name, job in jobs.items():
        if (stored := stored_row(job)) is not None:
            rows[name] = stored
            say(stored, True)
    jobs_to_do = [job for name, job in jobs.items() if name not in rows]
    last_written_s = time.monotonic()
    if not jobs_to_do:
        new_rows: Iterator[Row] = iter(())
    elif cluster:
        new_rows = on_cluster(jobs_to_do, work, cluster)
    else:
        new_rows = in_processes(jobs_to_do, work, workers or cores())
    for row in new_rows:
        name = str(row["turbine"])
        rows[name] = row
        if row["status"] == LOST:  # the job's process has died before it could write the row
            write_row(jobs[name], row)
        say(row, False)
        if time.monotonic() - last_written_s > TABLE_S:
            done = [rows[name] for name in jobs if name in rows]
            write_text_whole(out / CSV, table_csv(plan.task, done))
            last_written_s = time.monotonic()
    return _write_results(plan, out, [rows[name] for name in jobs])


def _write_results(plan: FleetPlan, out: Path, rows: Sequence[Row]) -> FleetResults:
    """Write the table and the type of turbine; returns the results."""
    write_text_whole(out / CSV, table_csv(plan.task, rows))
    parquet_bytes = table_parquet(plan.task, rows)
    if parquet_bytes is None:
        (out / PARQUET).unlink(missing_ok=True)  # a file of an earlier run has other numbers
    else:
        write_bytes_whole(out / PARQUET, parquet_bytes)
    turbine_type, left_out = _type_of(plan, out, rows)
    results = FleetResults(
        task=plan.task,
        rows=tuple(rows),
        name=plan.name,
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        options=dict(plan.options),
        type=turbine_type,
        type_without=tuple(left_out),
    )
    write_text_whole(out / FLEET, result_text(results))
    return results


def _type_of(plan: FleetPlan, out: Path, rows: Sequence[Row]) -> tuple[TurbineType | None, list[str]]:
    """Pool the type of turbine from a fleet's fits and write `type.json`; returns the type and the turbines
    left out.

    Turbines with outlying time constants are left out. The type is None for other tasks, for fewer than
    `FEWEST_POOLED` turbines, and if the fits have no time constant in common.
    """
    type_file = out / TYPE
    type_file.unlink(missing_ok=True)  # a file of an earlier run was pooled from other fits
    done = [row for row in rows if row["status"] == DONE]
    names = [str(row["turbine"]) for row in done]
    if plan.task != "fit" or len(names) < FEWEST_POOLED:
        return None, []
    constants = [scatter for scatter in spreads(done, TASKS[plan.task].compared) if scatter.compared.lower]
    outliers = sorted({scatter.turbines[i] for scatter in constants for i in scatter.outliers})
    try:
        kept = [name for name in names if name not in outliers]
        fits = [replace(read_fit(plan.folder(out, name)), name=name) for name in kept]
        turbine_type = pool_types(fits, plan.name)
    except (TypeFault, ResultFault):  # no time constant in common, or a fit was removed meanwhile
        return None, []
    write_type(turbine_type, type_file)
    return turbine_type, outliers


BATCHES = 8
"""Number of batches per worker; with many batches no worker waits long for the others at the end."""
LARGEST_BATCH = 25
"""Largest number of jobs in a batch; if a worker dies, all jobs of its batch are repeated."""
WAIT_S = 30.0
"""[s] longest wait for the connection to the scheduler, and for its first worker."""
_batch_lock = threading.Lock()


def perform_batch(jobs: Sequence[Job], work: Work) -> list[Row]:
    """Do the jobs of a batch one after the other on a worker of the cluster."""
    with _batch_lock:  # a worker with several threads receives several batches
        return [perform(job, work) for job in jobs]


def batches(jobs: Sequence[Job], workers: int) -> list[Sequence[Job]]:
    """Split jobs into batches; their order is kept."""
    size = max(1, min(LARGEST_BATCH, math.ceil(len(jobs) / (BATCHES * max(workers, 1)))))
    return [jobs[i : i + size] for i in range(0, len(jobs), size)]


def on_cluster(jobs: Sequence[Job], work: Work, address: str) -> Iterator[Row]:
    """Yield exactly one row for each job, in the order in which the jobs end.

    A batch whose worker has died is repeated by another worker. If this happens more often than the scheduler
    allows, the jobs of the batch are sent one by one, and a job that still kills its workers is `lost`.
    Raises FleetFault if there is no cluster at the address, if it has no worker or another version of
    hygrokf, or if the scheduler ends before the work is done.
    """
    try:
        from distributed import Client
        from distributed import as_completed as futures_of
    except ImportError:
        raise FleetFault("--dask", ["needs dask.distributed: pip install 'hygrokf[cluster]'"]) from None
    with _client_log_suppressed(), _client(Client, address) as client:
        workers = _count_workers(client, address)
        batch_of_future = {}

        def send(batch: Sequence[Job]) -> object:
            future = client.submit(perform_batch, batch, work, pure=False)
            batch_of_future[future.key] = batch
            return future

        futures = futures_of([send(batch) for batch in batches(jobs, workers)], loop=client.loop)
        for future in futures:
            batch = batch_of_future.pop(future.key)
            if future.status == "finished":
                yield from future.result()
            elif future.status != "error":  # "error" is a worker's death; other states are the scheduler's
                raise FleetFault(
                    f"--dask {address}",
                    [
                        "the scheduler ended before the work was done, or is no longer reachable (the tasks "
                        f"are {future.status}); finished turbines are kept: start a scheduler with workers, "
                        "and run the same command again"
                    ],
                )
            elif len(batch) > 1:
                futures.update([send([job]) for job in batch])
            else:
                reason = " ".join(str(future.exception()).split())
                yield row_of(batch[0], LOST, reason=FleetCode.NO_WORKER(fault=reason))


@contextmanager
def _client_log_suppressed() -> Iterator[None]:
    """Suppress the tracebacks that the client logs when a scheduler ends; `on_cluster` reports the fault
    instead."""
    log = logging.getLogger("distributed.client")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(level)


def _client(client_class: type, address: str) -> Any:
    """Connect to a scheduler. Raises FleetFault if there is none at the address."""
    try:
        return client_class(address, timeout=WAIT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as fault:
        reason = " ".join(str(fault).split())
        raise FleetFault(
            f"--dask {address}",
            [f"expected the scheduler of a Dask cluster, such as tcp://HOST:8786, found none: {reason}"],
        ) from None


def _count_workers(client: Any, address: str) -> int:
    """Return the number of workers. Raises FleetFault if one of them cannot do the work."""
    try:
        client.wait_for_workers(1, timeout=WAIT_S)
    except TimeoutError:
        raise FleetFault(
            f"--dask {address}",
            [f"the scheduler has no worker after {WAIT_S:g} s: start some with `dask worker {address}`"],
        ) from None
    faults = []
    for worker, setup in client.run(_worker_setup, on_error="return").items():
        if isinstance(setup, BaseException):
            faults.append(f"worker {worker}: hygrokf cannot be loaded there: {setup}; install it there too")
        elif setup["version"] != __version__:
            faults.append(
                f"worker {worker}: expected hygrokf {__version__} as here, found {setup['version']}; install "
                "the same one"
            )
        elif setup["threads"] != "1":
            faults.append(
                f"worker {worker}: expected one thread for linear algebra, found OMP_NUM_THREADS = "
                f"{setup['threads'] or 'not set'}; start it with a nanny (the default), or set "
                "OMP_NUM_THREADS=1 there"
            )
    if faults:
        raise FleetFault(f"--dask {address}", faults)
    return len(client.scheduler_info(n_workers=-1)["workers"])


def _worker_setup() -> JsonObject:
    """Return the version of hygrokf and the number of threads on a worker."""
    return {"version": __version__, "threads": os.environ.get("OMP_NUM_THREADS", "")}


ERROR_TAIL = 4000
"""[bytes] length of the end of a process's standard error that is searched for the last line."""
ATTEMPTS = 2
"""Number of attempts at a job, each in a new process, before it is lost."""
ENVIRONMENT = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", THREADS)}
"""One thread for linear algebra, because the matrices are tiny and every core has its own process."""


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def answer_jobs(work: Work) -> int:
    """Do the jobs read from standard input in a worker process until the input ends; returns the exit status
    0."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the interrupted parent ends this process
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # printed text must not mix with the answers
    with suppress(EOFError):
        while True:
            pickle.dump(perform(pickle.load(sys.stdin.buffer), work), answers)
            answers.flush()
    return 0


def in_processes(jobs: Sequence[Job], work: Work, workers: int) -> Iterator[Row]:
    """Yield exactly one row for each job, in the order in which the jobs end.

    If a process dies (killed for lack of memory, crash of compiled code), its job is tried once more; if the
    second process dies too, the job is `lost`. If the caller stops early, all processes end.
    """
    processes = _Processes(work)
    pool = ThreadPoolExecutor(min(workers, len(jobs)))
    try:
        for future in as_completed([pool.submit(processes.do, job) for job in jobs]):
            yield future.result()
    finally:
        processes.kill_all()
        pool.shutdown(cancel_futures=True)
        processes.close_all()


class _Processes:
    """Worker processes, one for each calling thread; a process that has died is replaced by a new one."""

    def __init__(self, work: Work) -> None:
        self._program = (
            f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import answer_jobs; "
            f"from {work.__module__} import {work.__qualname__} as work; sys.exit(answer_jobs(work))"
        )
        self._of_thread, self._lock, self._is_ended = threading.local(), threading.Lock(), False
        self._error_files: dict[subprocess.Popen[bytes], IO[bytes]] = {}
        """Process → file that receives its standard error."""

    def do(self, job: Job) -> Row:
        """Do a job and return its row; the job is lost if its process dies at every attempt."""
        reason: str | Statement = ""
        for _ in range(ATTEMPTS):
            if (process := self._process()) is None:
                break
            assert process.stdin is not None and process.stdout is not None
            with suppress(OSError, ValueError, EOFError, pickle.UnpicklingError):  # if the process dies
                pickle.dump(job, process.stdin)
                process.stdin.flush()
                row: Row = pickle.load(process.stdout)
                return row
            reason = self._close(process)
        return row_of(job, LOST, reason=reason)

    def _process(self) -> subprocess.Popen[bytes] | None:
        """Return the process of the calling thread, started if necessary; None after `kill_all`."""
        with self._lock:  # no process is started after `kill_all`
            process: subprocess.Popen[bytes] | None = getattr(self._of_thread, "process", None)
            if process is None and not self._is_ended:
                error_file = tempfile.TemporaryFile()
                process = self._of_thread.process = subprocess.Popen(
                    [sys.executable, "-c", self._program],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=error_file,
                    env={**os.environ, **ENVIRONMENT},
                )
                self._error_files[process] = error_file
            return process

    def _close(self, process: subprocess.Popen[bytes]) -> Statement:
        """Wait for a process to end and close its files; returns a statement of why it ended."""
        status, self._of_thread.process = process.wait(), None
        for pipe in (process.stdin, process.stdout):
            with suppress(OSError):  # unwritten text is lost
                if pipe is not None:
                    pipe.close()
        with self._lock:
            error_file = self._error_files.pop(process)
        with error_file:
            error_file.seek(max(0, error_file.seek(0, os.SEEK_END) - ERROR_TAIL))
            lines = error_file.read().decode(errors="replace").split("\n")
        return _end_statement(status, next((line.strip() for line in reversed(lines) if line.strip()), ""))

    def kill_all(self) -> None:
        """Kill all processes; no new one is started."""
        with self._lock:
            self._is_ended = True
            for process in self._error_files:
                process.kill()

    def close_all(self) -> None:
        """Close the files of all killed processes."""
        for process in list(self._error_files):
            self._close(process)


def _end_statement(status: int, last_line: str) -> Statement:
    """Return the statement of why a process ended, with the last line that it wrote."""
    signal_names = {-number.value: number.name for number in signal.Signals}
    if status >= 0:
        statement = FleetCode.PROCESS_ENDED(status=status, attempts=ATTEMPTS)
    else:
        statement = FleetCode.PROCESS_KILLED(signal=signal_names.get(status, str(status)), attempts=ATTEMPTS)
    if signal_names.get(status) == "SIGKILL":
        statement = FleetCode.MEMORY_SHORT(end=statement)
    return FleetCode.LAST_OUTPUT(end=statement, output=last_line) if last_line else statement
