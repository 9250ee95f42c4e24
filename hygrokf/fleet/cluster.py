"""Jobs on the workers of a Dask cluster, which may stand on other machines that share the files."""

from __future__ import annotations

import logging
import math
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from hygrokf.data.structured import JsonObject
from hygrokf.fleet.job import LOST, FleetFault, Job, Outcome, Work, outcome, perform
from hygrokf.version import __version__

BATCHES = 8
"""Batches for each worker: so many that no worker waits long for the others at the end."""
LARGEST = 25
"""Most jobs in a batch: all of them are done again where its worker dies."""
WAIT_S = 30.0
"""[s] time limit for the connection to the scheduler, and for its first worker."""
_one_at_a_time = threading.Lock()


def perform_batch(jobs: Sequence[JsonObject], work: Work) -> list[JsonObject]:
    """What a worker of the cluster runs: some jobs, one after the other, as plain data."""
    with _one_at_a_time:  # a worker with several threads receives several batches
        return [perform(Job.from_json(job), work).to_json() for job in jobs]


def batches(jobs: Sequence[Job], workers: int) -> list[Sequence[Job]]:
    """Jobs in batches, in their order."""
    size = max(1, min(LARGEST, math.ceil(len(jobs) / (BATCHES * max(workers, 1)))))
    return [jobs[i : i + size] for i in range(0, len(jobs), size)]


def on_cluster(jobs: Sequence[Job], work: Work, address: str) -> Iterator[Outcome]:
    """Outcomes of jobs as they come, in no order: exactly one for each.

    Another worker repeats a batch whose worker has died.  Where that happens more often than the scheduler
    allows, its jobs are sent one by one, and a job that goes on killing workers is `lost`.  Raises
    FleetFault where there is no cluster at the address, no worker, or another version of hygrokf on it, and
    where the scheduler ends before the work.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise FleetFault("--dask", ["needs dask.distributed: pip install 'hygrokf[cluster]'"]) from None
    with _quiet(), _client(Client, address) as client:
        workers = _checked(client, address)
        sent = {}

        def send(batch: Sequence[Job]) -> object:
            future = client.submit(perform_batch, [job.to_json() for job in batch], work, pure=False)
            sent[future.key] = batch
            return future

        coming = as_completed([send(batch) for batch in batches(jobs, workers)], loop=client.loop)
        for future in coming:
            batch = sent.pop(future.key)
            if future.status == "finished":
                yield from map(Outcome.from_json, future.result())
            elif future.status != "error":  # the worker's death is an error; this is the scheduler's
                raise FleetFault(
                    f"--dask {address}",
                    [
                        "the scheduler ended before the work was done, or is no longer reachable (the "
                        "tasks are "
                        f"{future.status}); finished turbines are kept: start a scheduler with workers, "
                        "and run the same command again"
                    ],
                )
            elif len(batch) > 1:
                coming.update([send([job]) for job in batch])
            else:
                reason = " ".join(str(future.exception()).split())
                yield outcome(batch[0], LOST, reason=f"no worker of the cluster could run it: {reason}")


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
    """The version of hygrokf on a worker, and its threads for linear algebra."""
    return {"version": __version__, "threads": os.environ.get("OMP_NUM_THREADS", "")}
