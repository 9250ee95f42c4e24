"""Figures of fleets: fits with bounds a core-second, scaling over processes, what Dask costs a fit."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import cases
from benchmarks.measure import Figure, Times, repeated, timed
from hygrokf.cases.synthetic import synthetic_turbine, write_case
from hygrokf.commands.fleet_tasks import do_task
from hygrokf.estimation.confidence import uncertainty, wald_bounds
from hygrokf.estimation.optimiser import Objective, fit_mle
from hygrokf.fleet.job import DONE, Job, perform
from hygrokf.fleet.plan import read_plan
from hygrokf.fleet.running import batches, cores, in_processes, on_cluster

INSTANTS = 8_000
DAYS = 25.2
"""[d] synthetic records whose identification period has about as many instants."""
Section = Callable[[bool], Iterable[Figure]]


def rates(times: Times) -> Times:
    """Fits a core-second."""
    return Times(1.0 / times.seconds)


def cpu_s(job: Job) -> float:
    """[s] of this process for a job."""
    begin = time.process_time()
    perform(job, do_task)
    return time.process_time() - begin


def fits(quick: bool) -> Iterator[Figure]:
    """One core: the joint likelihood's fit with its bounds; a turbine from its files to its row."""
    count = 2_000 if quick else INSTANTS
    case = cases.joint(count)

    def fit() -> None:
        estimate = fit_mle(case.likelihood, count=1)
        found = uncertainty(Objective(case.likelihood, estimate.coordinates), estimate)
        for name in ("thermal_time_constant", "hygric_k"):
            bounds = wald_bounds(estimate, found, name)
            if not (estimate.converged and 0 < bounds.lower < bounds.upper < np.inf):
                raise RuntimeError(f"{name}: the fit that is timed has no bounds")

    fit()
    yield timed(
        "joint fit",
        f"sixteen parameters with Wald bounds, N = {count:,}",
        "1/s",
        rates(repeated(fit, 3 if quick else 15)),
        at_least=1.0,
        note="one start, observed information, sandwich",
    )
    with tempfile.TemporaryDirectory() as folder:
        for kind, starts in (("cascade", 4), ("cascade", 1), ("joint", 4), ("joint", 1)):
            jobs = turbines(Path(folder), 2 if quick else 6, 5.0 if quick else DAYS, kind, starts)
            if perform(jobs[0], do_task)["status"] != DONE:  # compiles
                raise RuntimeError("the turbine that is timed has no result")
            seconds = np.array([cpu_s(job) for job in jobs[1:]])
            yield timed(
                "from files to row",
                f"{kind}, {starts} starts, records of {5.0 if quick else DAYS:g} d",
                "1/s",
                rates(Times(seconds)),
                note="reading, regression, second disturbances tried, Wald bounds, clocks, sampling, scores, "
                "forecasts",
            )


def turbines(folder: Path, count: int, days: float, kind: str = "cascade", starts: int = 4) -> list[Job]:
    """Jobs of synthetic turbines, with results in a folder of their own."""
    for seed in range(1, count + 1):
        case = folder / f"{days:g}" / f"T{seed}"
        if not (case / "case.toml").exists():
            write_case(synthetic_turbine(seed=seed, days=days), case)
    file = folder / f"{days:g}" / "fleet.toml"
    file.write_text(
        f'task = "fit"\ncases = ["*/case.toml"]\noptions.kind = "{kind}"\noptions.starts = {starts}\n'
    )
    return read_plan(file).jobs(folder / f"{kind}{starts}")[:count]


def again(jobs: Sequence[Job], folder: Path) -> list[Job]:
    """The same jobs with results elsewhere, so that they are work again."""
    return [replace(job, folder=folder / job.turbine) for job in jobs]


def wall(outcomes: Iterable) -> float:
    """[s] until all have come; a failure among them is no figure."""
    begin = time.perf_counter()
    if any(one["status"] != DONE for one in outcomes):
        raise RuntimeError("a turbine of the benchmark has no result")
    return time.perf_counter() - begin


def scaling(quick: bool) -> Iterator[Figure]:
    """Wall time of one process against as many as there are cores, their start included."""
    count, days = (4, 5.0) if quick else (48, DAYS)
    with tempfile.TemporaryDirectory() as folder:
        jobs = turbines(Path(folder), count, days)
        perform(jobs[0], do_task)  # compiles
        many = [n for n in (2, 4, 8, 16, 32, 64) if n <= cores()] or [1]
        shares: dict[int, list[float]] = {n: [] for n in many}
        for turn in range(1 if quick else 3):
            alone = wall(in_processes(again(jobs, Path(folder) / f"alone{turn}"), do_task, 1))
            for n in many:
                together = wall(in_processes(again(jobs, Path(folder) / f"{n}-{turn}"), do_task, n))
                shares[n].append(alone / together / n)
        for n in many:
            yield timed(
                "scaling",
                f"{count} turbines on {n} processes, share of ideal",
                "1",
                Times(np.array(shares[n])),
                at_least=0.9,
                note="on idle cores; wall times, interleaved",
            )


def dask(quick: bool) -> Iterator[Figure]:
    """What a Dask cluster costs beside the work itself: turbines that are done, batched and one by one."""
    from distributed import LocalCluster

    from hygrokf.fleet import running as module

    count = 20 if quick else 200
    with tempfile.TemporaryDirectory() as folder:
        (first,) = turbines(Path(folder), 1, 5.0)
        perform(first, do_task)
        jobs = []
        for place in range(count):  # rows that are on disk already: reading one is all the work
            job = replace(
                first, turbine=f"{first.turbine}-{place}", folder=Path(folder) / "many" / str(place)
            )
            found = perform(first, do_task)
            job.folder.mkdir(parents=True)
            text = (first.folder / "row.json").read_text(encoding="utf-8")
            old, new = f'"turbine": "{first.turbine}"', f'"turbine": "{job.turbine}"'
            if found["status"] != DONE or text.count(old) != 1:
                raise RuntimeError("the row that is copied is not there")
            (job.folder / "row.json").write_text(text.replace(old, new), encoding="utf-8")
            jobs.append(job)
        here = wall(perform(job, do_task) for job in jobs)
        with LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
        ) as made:
            wall(on_cluster(jobs[:2], do_task, made.scheduler_address))  # imports
            begin = wall(
                on_cluster(jobs[:1], do_task, made.scheduler_address)
            )  # connecting is paid once, not for each
            for name, largest in (("in batches", module.LARGEST), ("one by one", 1)):
                usual, module.LARGEST = module.LARGEST, largest
                try:
                    spent = [
                        (wall(on_cluster(jobs, do_task, made.scheduler_address)) - begin - here) / count
                        for _ in range(2 if quick else 9)
                    ]
                    sent = len(batches(jobs, 1))
                finally:
                    module.LARGEST = usual
                note = (
                    f"{count} turbines in {sent} tasks; connecting ({begin:.2f} s) and the work itself "
                    "taken out"
                )
                yield timed("dask", f"overhead a fit, {name}", "ms", Times(1e3 * np.array(spent)), note=note)


SECTIONS: dict[str, Section] = {"fits": fits, "scaling": scaling, "dask": dask}
