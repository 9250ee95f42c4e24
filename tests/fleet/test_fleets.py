"""Fleets: the same table whatever does the work, whoever dies over it, and nothing done twice."""

from __future__ import annotations

import csv
import io
import json
import os
import pickle
import re
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.command_line import run
from builders.documents import document
from builders.fleet_case import first_alone

from hygrokf import identify, read_case, synthetic_turbine, write_case
from hygrokf.climate.limits import ClassFault
from hygrokf.commands.fleet_tasks import WORK, do_task, run_fleet
from hygrokf.data.result_file import ResultFault, result_text
from hygrokf.data.structured import structured
from hygrokf.data.toml_form import keys_of
from hygrokf.fleet import job as job_module
from hygrokf.fleet.fleet_plan import read_plan
from hygrokf.fleet.fleet_results import table_csv, table_parquet, task_columns
from hygrokf.fleet.job import FleetFault, Job, content_key, perform, stored_row
from hygrokf.fleet.running import batches, in_processes, on_cluster
from hygrokf.fleet.tasks import TASKS
from hygrokf.identification.fit import read_fit
from hygrokf.identification.turbine_type import pool_types, read_type
from hygrokf.report.fleet_page import write_fleet_report

DAYS, TURBINES = 5.0, 5
FLEET = 'name = "Park <A&B>"\ntask = "fit"\ncases = ["*/case.toml"]\n[options]\nstarts = 1\n'
WHOLE, HALF = ("T1", "T2", "T4"), {"T3": "cabinet.csv: no such file", "T5": "correct the unit or the column"}


@pytest.fixture(scope="module")
def park(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five synthetic turbines: a file of the third is missing, a unit of the fifth is wrong."""
    folder = tmp_path_factory.mktemp("park")
    for seed in range(1, TURBINES + 1):
        write_case(synthetic_turbine(seed=seed, days=DAYS), folder / f"T{seed}")
    (folder / "T3" / "cabinet.csv").unlink()
    case = folder / "T5" / "case.toml"
    case.write_text(case.read_text().replace('"T_cab_degC", unit = "degC"', '"T_cab_degC", unit = "K"'))
    (folder / "fleet.toml").write_text(FLEET)
    return folder


@pytest.fixture(scope="module")
def serial(park: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder and table of the fleet, each turbine done here, one after the other."""
    out = tmp_path_factory.mktemp("serial")
    jobs = read_plan(park / "fleet.toml").jobs(out)
    return out, table_csv("fit", [perform(job, do_task) for job in jobs])


def rows_of(text: str) -> dict[str, dict[str, str]]:
    return {row["turbine"]: row for row in csv.DictReader(io.StringIO(text))}


# -- the plan ------------------------------------------------------------------------------------------------
def test_a_plan_has_every_turbine_with_the_whole_set_of_options(park: Path) -> None:
    plan = read_plan(park / "fleet.toml")
    assert [one.name for one in plan.turbines] == [f"T{i}" for i in range(1, TURBINES + 1)]
    assert plan.options == {
        "criterion": "likelihood", "kind": "cascade", "starts": 1, "profiles": False, "report": False
    }  # fmt: skip
    jobs = plan.jobs(park / "out")
    assert pickle.loads(pickle.dumps(jobs)) == jobs
    assert b"pathlib" not in pickle.dumps(jobs), "other versions of Python do not read the paths of this one"


def test_models_are_named_by_turbine_or_for_all(park: Path) -> None:
    file = park / "evaluate.toml"
    file.write_text(
        'task = "evaluate"\ncases = ["T[12]/case.toml"]\nfit = "models/{name}/fit.json"\n'
        '[[turbine]]\nname = "other"\ncase = "T4/case.toml"\nfit = "own.json"\n'
    )
    plan = read_plan(file)
    assert plan.name == "evaluate"
    assert {one.name: Path(one.fit).relative_to(park).as_posix() for one in plan.turbines} == {
        "T1": "models/T1/fit.json",
        "T2": "models/T2/fit.json",
        "other": "own.json",
    }


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("task = ", ["line 1, at the end: not valid TOML"]),
        ('task = "fitt"\nnmae = "x"',
            ['unknown key "nmae"', "did you mean", "task must be one of fit, discover", '"fitt"']),
        ('cases = ["*/case.toml"]', ["needs task, one of fit, discover"]),
        ('task = "fit"', ["no turbine: state cases"]),
        ('task = "fit"\ncases = ["none/*.toml"]', ['no file matches "none/*.toml"']),
        (
            'task = "fit"\ncases = ["T1/case.toml"]\nfit = "f.json"\n[options]\nstart = 3\nstarts = 0\nkind '
            '= "both"\nreport = 1',
            ["uses no fitted model", 'unknown key "start" for fit',
                "starts must be a whole number from 1 on, found 0",
             'kind must be one of cascade, joint, found "both"', "report must be true or false, found 1",
             "5 faults"],
        ),
        (
            'task = "fit"\n[[turbine]]\nname = "../up"\ncase = "T1/case.toml"\n[[turbine]]\nname = "a"\ncase '
            '= "T1/case.toml"\n[[turbine]]\nname = "A"\ncase = "T2/case.toml"\n[[turbine]]\nname = "b"\nCase '
            '= "T2"',
            ['the name "../up" becomes a folder', 'the name "A" is that of [[turbine]] 2 too',
                'unknown key "Case"', "needs case"],
        ),
        ('task = "evaluate"\ncases = ["T1/case.toml"]', ["needs a fitted model"]),
        ('task = "discover"\ncases = ["T1/case.toml"]\noptions.library = ["none.py"]',
            ["no such file", "none.py"]),
    ],
)  # fmt: skip
def test_every_fault_of_a_plan_is_said_at_once(park: Path, text: str, words: list[str]) -> None:
    file = park / "faulty.toml"
    file.write_text(text)
    with pytest.raises(FleetFault) as found:
        read_plan(file)
    assert [word for word in words if word not in str(found.value)] == []


def test_a_plan_that_is_not_there_is_said(park: Path) -> None:
    with pytest.raises(FleetFault, match=r"cannot be read: No such file.*did you mean \"fleet.toml\""):
        read_plan(park / "fleets.toml")


# -- the same work -------------------------------------------------------------------------------------------
def test_the_key_follows_all_that_results_follow_from(
    park: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("case.toml", "cabinet.csv", "ambient.csv", "scada.csv"):
        (tmp_path / name).write_bytes((park / "T1" / name).read_bytes())
    fit = tmp_path / "fit.json"
    fit.write_text("{}")
    job = Job("T1", "fit", tmp_path / "case.toml", tmp_path / "out", fit, {"starts": 1})
    keys = [content_key(job)]
    os.utime(tmp_path / "scada.csv", (1, 1))
    assert content_key(replace(job, folder=tmp_path / "elsewhere")) == keys[0]
    for file in ("case.toml", "cabinet.csv", "ambient.csv", "scada.csv", "fit.json"):
        before = (tmp_path / file).read_bytes()
        (tmp_path / file).write_bytes(before + b"\n")
        keys.append(content_key(job))
        (tmp_path / file).write_bytes(before)
    assert content_key(job) == keys[0]
    (tmp_path / "scada.csv").unlink()
    keys += [
        content_key(job),
        content_key(replace(job, options={"starts": 2})),
        content_key(job, [park / "fleet.toml"]),
    ]
    monkeypatch.setattr(job_module, "__version__", "99.0")
    keys.append(content_key(job))
    assert len(set(keys)) == len(keys) == 10


def test_a_fleets_table_holds_every_turbine_with_result_or_reason(
    park: Path, serial: tuple[Path, str]
) -> None:
    out, table = serial
    rows = rows_of(table)
    assert list(rows) == [f"T{i}" for i in range(1, TURBINES + 1)]
    assert {name for name, row in rows.items() if row["status"] == "done"} == set(WHOLE)
    for name, reason in HALF.items():
        assert rows[name]["status"] == "failed" and reason in rows[name]["reason"]
        assert not rows[name]["thermal_value_h"] and not (out / "turbines" / name / "fit.json").exists()
    fit = identify(read_case(park / "T2" / "case.toml"), profiles=False, starts=1)
    found = fit.to_json()["time_constants"]["thermal"]
    assert float(rows["T2"]["thermal_upper_h"]) == found["upper_h"]
    assert float(rows["T2"]["loglik"]) == fit.to_json()["loglik"]
    assert (
        float(rows["T2"]["temperature_rmse_K"])
        == fit.to_json()["rmse"]["validation"]["temperature_K"]["total"]
    )
    assert rows["T2"]["provenance"] == "synthetic"


def children() -> list[int]:
    """Processes that this one and its threads have started, and theirs."""
    found, look = [], [os.getpid()]
    while look:
        for file in Path(f"/proc/{look.pop()}/task").glob("*/children"):
            try:
                new = [int(one) for one in file.read_text().split()]
            except OSError:
                continue
            found += new
            look += new
    return found


def working() -> list[int]:
    """Those of them that do jobs: processes of ours, and workers of a cluster under their nannies."""
    marks = ("hygrokf.fleet.running", "spawn_main", "--multiprocessing-fork", "dask_worker")
    found = []
    for one in children():
        try:
            said = Path(f"/proc/{one}/cmdline").read_text()
        except OSError:
            continue
        if any(mark in said for mark in marks) and "resource_tracker" not in said:
            found.append(one)
    return found


needs_proc = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds its processes in /proc")


@needs_proc
def test_processes_that_are_killed_cost_nothing(park: Path, serial: tuple[Path, str], tmp_path: Path) -> None:
    """Every process is killed while it works; the table is complete and that of the serial run; then nothing
    is done."""
    killed: list[int] = []
    came: list[str] = []

    def say(found: object, known: bool) -> None:
        came.append(found["turbine"])
        assert not known
        if len(came) == 1:
            for one in working():
                os.kill(one, signal.SIGKILL)
                killed.append(one)

    plan = read_plan(park / "fleet.toml")
    result = run_fleet(plan, tmp_path, workers=2, say=say)
    assert killed and sorted(came) == [f"T{i}" for i in range(1, TURBINES + 1)]
    assert (tmp_path / "fleet.csv").read_text() == serial[1]
    assert len(result.missing) == len(HALF)
    assert working() == []
    made = {name: (tmp_path / "turbines" / name / "fit.json").stat().st_mtime_ns for name in WHOLE}
    again: dict[str, bool] = {}
    run_fleet(plan, tmp_path, workers=1, say=lambda found, known: again.update({found["turbine"]: known}))
    assert again == {**dict.fromkeys(WHOLE, True), **dict.fromkeys(HALF, False)}
    assert made == {name: (tmp_path / "turbines" / name / "fit.json").stat().st_mtime_ns for name in WHOLE}
    assert (tmp_path / "fleet.csv").read_text() == serial[1]


def lethal_plan(park: Path) -> Path:
    """A plan with a library that kills the process that loads it."""
    (park / "deadly.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGKILL)\n")
    file = park / "lethal.toml"
    file.write_text('task = "discover"\ncases = ["T[12]/case.toml"]\noptions.library = ["deadly.py"]\n')
    return file


def test_a_turbine_that_kills_its_process_is_lost_and_told(park: Path, tmp_path: Path) -> None:
    result = run_fleet(read_plan(lethal_plan(park)), tmp_path, workers=1)
    assert [row["status"] for row in result.rows] == ["lost", "lost"]
    assert all("killed by SIGKILL, 2 times in a row" in str(row["reason"]) for row in result.rows)
    assert json.loads((tmp_path / "turbines" / "T1" / "row.json").read_text())["status"] == "lost"
    assert "lost" in (tmp_path / "report.html").read_text()


def test_a_process_that_dies_before_it_begins_stops_nothing(
    park: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has made no folder for its row."""
    from hygrokf.fleet import running as processes

    monkeypatch.setattr(processes.sys, "executable", "/bin/false")
    result = run_fleet(read_plan(park / "fleet.toml"), tmp_path, workers=1)
    assert [row["status"] for row in result.rows] == ["lost"] * TURBINES
    assert "ended with status 1, 2 times in a row" in str(result.rows[0]["reason"])
    assert (tmp_path / "turbines" / "T5" / "row.json").is_file()


def test_whoever_stops_early_leaves_no_process(park: Path, tmp_path: Path) -> None:
    coming = in_processes(read_plan(park / "fleet.toml").jobs(tmp_path), first_alone, 2)
    next(coming)
    coming.close()
    if Path("/proc/self/task").exists():
        assert working() == []


def test_changed_data_are_done_again_and_nothing_of_before_is_left(
    park: Path, serial: tuple[Path, str], tmp_path: Path
) -> None:
    for name in ("case.toml", "cabinet.csv", "ambient.csv", "scada.csv"):
        (tmp_path / "T2").mkdir(exist_ok=True)
        (tmp_path / "T2" / name).write_bytes((park / "T2" / name).read_bytes())
    (tmp_path / "fleet.toml").write_text(FLEET)
    (job,) = read_plan(tmp_path / "fleet.toml").jobs(tmp_path / "out")
    first = perform(job, do_task)
    assert stored_row(job) == first and perform(job, do_task) == first
    assert first["key"] == rows_of(serial[1])["T2"]["key"]
    for damaged, there in (
        ({}, None),
        ([1], None),
        (None, None),
        ({**first, "key": 1}, None),
        (first, first),
    ):
        (job.folder / "row.json").write_text(json.dumps(damaged))
        assert stored_row(job) == there, "a damaged row is work to be done again"
    (tmp_path / "T2" / "cabinet.csv").write_text("time,other\n")
    (job,) = read_plan(tmp_path / "fleet.toml").jobs(tmp_path / "out")
    assert stored_row(job) is None
    assert perform(job, do_task)["status"] == "failed"
    assert {one.name for one in job.folder.iterdir()} == {"row.json"}


def test_a_fault_that_no_one_foresaw_is_a_row_too(park: Path, tmp_path: Path) -> None:
    def broken(job: Job) -> dict:
        return {"thermal_value_h": 1 / (len(job.turbine) - 2)}

    found = perform(read_plan(park / "fleet.toml").jobs(tmp_path)[0], broken)
    assert found["status"] == "failed"
    assert found["reason"].startswith("ZeroDivisionError: division by zero (test_fleets.py, line ")


def test_a_models_scores_are_those_of_the_command(
    park: Path, serial: tuple[Path, str], tmp_path: Path
) -> None:
    file = park / "scores.toml"
    fits = serial[0] / "turbines"
    file.write_text(f'task = "evaluate"\ncases = ["T[14]/case.toml"]\nfit = "{(fits / "T2").as_posix()}"\n')
    of_all = run(f"fleet {file} --out {tmp_path} --workers 1 --json")
    of_one = run(f"evaluate {fits}/T2/fit.json {park}/T4/case.toml --json")
    assert (of_all.status, of_one.status) == (0, 0)
    (row,) = (row for row in json.loads(of_all.out)["rows"] if row["turbine"] == "T4")
    one = json.loads(of_one.out)
    rmse = one["rmse"]["validation"]
    assert row["temperature_rmse_K"] == rmse["temperature_K"]["total"]
    assert row["humidity_rmse_operation_g_m3"] == rmse["absolute_humidity_g_m3"]["operation"]
    assert row["humidity_coverage"] == one["bands"]["free_run"]["absolute_humidity_g_m3"]["coverage"]
    assert row["model"] == "synthetic-turbine-2"


# -- a cluster -----------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def cluster() -> Iterator[object]:
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
        ) as made,
    ):
        yield made


@needs_proc
@pytest.mark.slow
def test_a_cluster_whose_worker_is_killed_gives_the_serial_table(
    park: Path, serial: tuple[Path, str], tmp_path: Path, cluster: object
) -> None:
    came: list[str] = []
    killed: list[int] = []

    def say(found: object, known: bool) -> None:
        came.append(found["turbine"])
        if len(came) == 1:
            killed.append(max(cluster_pids(cluster)))
            os.kill(killed[0], signal.SIGKILL)

    run_fleet(read_plan(park / "fleet.toml"), tmp_path, cluster=cluster.scheduler_address, say=say)
    assert len(killed) == 1 and sorted(came) == [f"T{i}" for i in range(1, TURBINES + 1)]
    assert (tmp_path / "fleet.csv").read_text() == serial[1]


def cluster_pids(cluster: object) -> list[int]:
    from distributed import Client

    with Client(cluster.scheduler_address, set_as_default=False) as client:
        return list(client.run(os.getpid).values())


def test_a_turbine_that_kills_workers_is_lost_alone(park: Path, tmp_path: Path, cluster: object) -> None:
    """Three jobs in one batch, the second of which kills: sent again one by one, the others are done."""
    good = read_plan(park / "fleet.toml").jobs(tmp_path)
    bad = read_plan(lethal_plan(park)).jobs(tmp_path / "bad")[0]
    jobs = [good[2], bad, good[4]]
    assert batches(jobs * 20, 1) != [[job] for job in jobs * 20]
    found = {one["key"]: one for one in in_one_batch(jobs, cluster.scheduler_address)}
    assert [found[job.key]["status"] for job in jobs] == ["failed", "lost", "failed"]
    assert "no worker of the cluster could run it" in str(found[bad.key]["reason"])


def in_one_batch(jobs: list[Job], address: str) -> list:
    from hygrokf.fleet import running as cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cluster, "BATCHES", 0.01)
        return list(on_cluster(jobs, do_task, address))


def test_batches_hold_every_job_once_in_order() -> None:
    for count in (1, 7, 100, 5000):
        made = batches(list(range(count)), 4)
        assert [one for batch in made for one in batch] == list(range(count))
        assert max(map(len, made)) <= 25 and (count > 4000 or len(made) >= min(count, 4))


def sleeping(jobs: list, work: object) -> list:
    """In place of a batch: what is not done when the scheduler ends."""
    time.sleep(4.0)
    return []


def test_a_scheduler_that_ends_is_told(park: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not as turbines that are lost: what is left is done by the same command."""
    from distributed import LocalCluster

    from hygrokf.fleet import running as cluster

    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(cluster, "perform_batch", sleeping)
    monkeypatch.setattr(cluster, "WAIT_S", 1.5)
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    ) as made:
        threading.Timer(1.5, made.close).start()
        with pytest.raises(FleetFault, match="the scheduler ended before the work was done"):
            run_fleet(read_plan(park / "fleet.toml"), tmp_path / "out", cluster=made.scheduler_address)
    assert not (tmp_path / "out" / "turbines").exists()


@pytest.mark.parametrize(
    ("task", "options"),
    [
        pytest.param("transfer", "", marks=pytest.mark.slow),
        ("climate", '[options]\nmembers = 4\nlimits = ["limits.toml"]\n'),
    ],
)
def test_models_go_elsewhere_on_a_cluster_as_here(
    task: str, options: str, park: Path, serial: tuple[Path, str], tmp_path: Path, cluster: object
) -> None:
    """The table, and the numbers in every turbine's own files, are those of a serial run."""
    limits_file(park)
    file = park / f"{task}.toml"
    fit = serial[0] / "turbines" / "T1" / "fit.json"
    file.write_text(f'task = "{task}"\ncases = ["T[23]/case.toml"]\nfit = "{fit}"\n{options}')
    here, there = tmp_path / "here", tmp_path / "there"
    table = table_csv(task, [perform(job, do_task) for job in read_plan(file).jobs(here)])
    result = run_fleet(read_plan(file), there, cluster=cluster.scheduler_address)
    done, failed = result.rows
    assert (done["status"], failed["status"]) == ("done", "failed"), done["reason"]
    assert set(TASKS[task].columns) <= set(done) and done["model"] == "synthetic-turbine-1"
    assert (there / "fleet.csv").read_text() == table
    mine, theirs = (out / "turbines" / "T2" for out in (here, there))
    names = {one.name for one in mine.iterdir()}
    assert names == {one.name for one in theirs.iterdir()}
    assert names >= {f"{task}.json", "report.html"}
    for name in names:
        if name.endswith((".csv", ".json")):
            assert untimed((mine / name).read_text()) == untimed((theirs / name).read_text()), name
    data = json.loads((theirs / f"{task}.json").read_text())
    page = (there / "report.html").read_text(encoding="utf-8")
    if task == "transfer":
        (record,) = data["records"]
        assert (done["transfer"], done["sentence"]) == (record["verdict"], record["sentence"])
        assert done["temperature_rmse_K"] == record["rmse"]["temperature_K"]["re_estimated"]["total"]
        # five days are too few for bounds of the gain
        assert done["temperature_gain_K"] == pytest.approx(
            done["as_is_temperature_rmse_K"] - done["temperature_rmse_K"]
        )
        assert record["verdict"] in page
    else:
        (region,) = data["regions"]
        assert done["wetness_h"] == region["scopes"]["all"]["wetness_h"]["value"]
        assert done["ageing_h_lower"] <= done["ageing_h"] <= done["ageing_h_upper"]
        assert done["limits"] == "undecided"  # a few days are no year
        assert "Climate of a year" in page and "What was found" in page


def untimed(text: str) -> list[str]:
    """Lines of a file but the one that says when it was made."""
    return [line for line in text.split("\n") if not line.startswith(' "created": ')]


def test_where_there_is_no_cluster_it_is_said(park: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from hygrokf.fleet import running as cluster

    monkeypatch.setattr(cluster, "WAIT_S", 0.3)
    with pytest.raises(FleetFault, match="expected the scheduler of a Dask cluster"):
        list(on_cluster(read_plan(park / "fleet.toml").jobs(park), do_task, "tcp://127.0.0.1:1"))


# -- table and page ------------------------------------------------------------------------------------------
def test_both_tables_say_the_same(serial: tuple[Path, str], tmp_path: Path) -> None:
    from pyarrow import parquet

    files = sorted((serial[0] / "turbines").glob("*/row.json"))
    rows = [structured(job_module.Row, json.loads(one.read_text())) for one in files]
    file = tmp_path / "fleet.parquet"
    file.write_bytes(table_parquet("fit", rows))
    read = parquet.read_table(file)
    assert read.column_names == list(task_columns("fit")) == serial[1].split("\n")[0].split(",")
    for name, line in zip(("T1", "T3"), (read.to_pylist()[0], read.to_pylist()[2]), strict=True):
        for column, text in rows_of(serial[1])[name].items():
            value = line[column]
            assert text == (
                "" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
            )
    kinds = {field.name: str(field.type) for field in read.schema}
    assert (
        kinds["thermal_upper_h"] == "double"
        and kinds["n_readings"] == "int64"
        and kinds["converged"] == "bool"
    )


def test_every_task_has_its_function() -> None:
    assert list(WORK) == list(TASKS)


@pytest.mark.parametrize("task", TASKS)
def test_every_option_is_documented(task: str) -> None:
    """Columns stand on a page of the site: tests/test_site.py."""
    text = document("fleet.md").read_text(encoding="utf-8")
    for name, (_, option, _) in keys_of(TASKS[task].options).items():
        assert f"`{name}`" in text and option.help in text, name


def limits_file(park: Path) -> None:
    (park / "limits.toml").write_text('[[limit]]\nquantity = "temperature_degC"\nabove = 90\n')


def test_fits_of_a_fleet_give_the_type_of_its_turbines(
    park: Path, serial: tuple[Path, str], tmp_path: Path
) -> None:
    out = shutil.copytree(serial[0], tmp_path / "out")
    run_fleet(read_plan(park / "fleet.toml"), out, workers=1)
    kind = read_type(out / "type.json")
    assert kind.turbines == WHOLE
    fits = [replace(read_fit(serial[0] / "turbines" / name), name=name) for name in WHOLE]
    expected = pool_types(fits, "any").parameters["thermal_time_constant"]
    assert kind.parameters["thermal_time_constant"] == expected
    assert "The type of turbine" in (out / "report.html").read_text(encoding="utf-8")


def test_a_limits_file_that_is_wrong_is_named_in_the_row(
    park: Path, serial: tuple[Path, str], tmp_path: Path
) -> None:
    (park / "wrong.toml").write_text("[[limit\n")
    (park / "same.toml").write_text('[[limit]]\nquantity = "temperature_degC"\nabove = 90\n')
    limits_file(park)
    fit = serial[0] / "turbines" / "T1" / "fit.json"
    reasons = []
    for files in ('"wrong.toml"', '"limits.toml", "same.toml"'):
        file = park / "limited.toml"
        options = f"[options]\nmembers = 2\nlimits = [{files}]\n"
        file.write_text(f'task = "climate"\ncases = ["T2/case.toml"]\nfit = "{fit}"\n{options}')
        (job,) = read_plan(file).jobs(tmp_path)
        found = perform(job, do_task)
        assert found["status"] == "failed"
        reasons.append(str(found["reason"]))
    assert "wrong.toml: line" in reasons[0]
    assert 'two limits are called "temperature above 90 °C"' in reasons[1]


def test_limits_may_be_a_class(park: Path, serial: tuple[Path, str], tmp_path: Path) -> None:
    fit = serial[0] / "turbines" / "T1" / "fit.json"
    file = park / "classes.toml"
    text = f'task = "climate"\ncases = ["T2/case.toml"]\nfit = "{fit}"\n[options]\nmembers = 2\nlimits = '
    file.write_text(text + '["3K3"]\n')
    plan = read_plan(file)
    assert plan.options["limits"] == ["3K3"]
    (job,) = plan.jobs(tmp_path)
    found = perform(job, do_task)
    assert found["status"] == "done", found["reason"]
    data = json.loads((tmp_path / "turbines" / "T2" / "climate.json").read_text(encoding="utf-8"))
    assert [one["above"] or one["below"] for one in data["regions"][0]["limits"]] == [40.0, 5.0, 85.0, 5.0]
    (park / "limits.txt").write_text('[[limit]]\nquantity = "temperature_degC"\nabove = 90\n')
    file.write_text(text + '["limits.txt"]\n')
    assert read_plan(file).options["limits"] == [str((park / "limits.txt").absolute())]
    file.write_text(text + '["3K22", "gone.toml"]\n')
    with pytest.raises(FleetFault, match=r"no such file .*gone\.toml"):
        read_plan(file)
    file.write_text(text + '["3K22"]\n')
    with pytest.raises(ClassFault, match="IEC 60721-3-3 3K3"):
        run_fleet(read_plan(file), tmp_path / "never", workers=1)
    assert not (tmp_path / "never").exists()


# -- the command ---------------------------------------------------------------------------------------------
def test_the_command_tells_writes_and_reports_again(park: Path, serial: tuple[Path, str]) -> None:
    """On the folder of the serial run only the failures are tried again."""
    out = serial[0]
    said = run(f"fleet {park}/fleet.toml --out {out} --workers 1")
    assert said.status == 1
    assert "Turbines with a result: 3 of 5." in said.out and "T3" in said.out and "no such file" in said.out
    assert said.err.count("done before") == len(WHOLE) and "report: " in said.err
    assert (out / "fleet.csv").read_text() == serial[1]
    page = (out / "report.html").read_text(encoding="utf-8")
    (out / "report.html").unlink()
    assert run(f"report {out}").status == 0
    assert (out / "report.html").read_text(encoding="utf-8") == page and "Park &lt;A&amp;B&gt;" in page
    kept = (out / "fleet.json").read_text(encoding="utf-8")
    for damaged in ("{", '{"task": "none", "rows": []}', "[]"):
        (out / "fleet.json").write_text(damaged)
        with pytest.raises(ResultFault, match=r"fleet\.json"):
            write_fleet_report(out)
    (out / "fleet.json").write_text(kept, encoding="utf-8")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("--workers 2 --dask tcp://x:1", "leave it out beside --dask"),
        ("--dask nowhere", "--dask nowhere: 1 fault"),
    ],
)
def test_what_cannot_be_run_is_said(
    park: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: str, words: str
) -> None:
    from hygrokf.fleet import running as cluster

    monkeypatch.setattr(cluster, "WAIT_S", 0.3)
    said = run(f"fleet {park}/fleet.toml --out {tmp_path}/out {more}")
    assert said.status == 2 and words in said.err


def test_results_are_plain_data() -> None:
    """What a row holds survives JSON: not a number and infinities become null."""
    from hygrokf.fleet.job import row_of

    job = Job("a", "fit", Path("c"), Path("f"))
    found = row_of(job, "done", {"thermal_upper_h": float("inf"), "n_readings": np.int64(3)})
    assert found["thermal_upper_h"] is None and json.loads(result_text(found)) == found


@pytest.mark.slow
def test_discoveries_of_a_fleet_are_those_of_the_command(park: Path, tmp_path: Path) -> None:
    file = park / "discoveries.toml"
    file.write_text('task = "discover"\ncases = ["T[12]/case.toml"]\n')
    of_all = run(f"fleet {file} --out {tmp_path} --workers 1 --json")
    of_one = run(f"discover {park}/T2/case.toml --out {tmp_path}/alone --json")
    assert (of_all.status, of_one.status) == (0, 0)
    row, found = json.loads(of_all.out)["rows"][1], json.loads(of_one.out)
    assert row["verdict"] == found["verdict"]
    assert row["causes"] == ["/".join((one["cause"], *one["ambiguous_with"])) for one in found["causes"]]
    assert row["base_temperature_rmse_K"] == found["baseline"]["rmse"]["validation"]["temperature_K"]["total"]
    final = found["extended"] or found["baseline"]
    assert row["thermal_value_h"] == final["time_constants"]["thermal"]["value_h"]
    page = re.sub(r"(<[^>]+>|\s)+", " ", (tmp_path / "report.html").read_text(encoding="utf-8"))
    assert {row["verdict"] for row in json.loads(of_all.out)["rows"]} == {"none"}
    assert "verdict none 2 T1, T2" in page
    assert (tmp_path / "turbines" / "T2" / "fit_report.html").is_file()
