"""The command line: each command is one function of the package."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hygrokf.commands.climate import climate_arguments
from hygrokf.commands.console import (
    Progress,
    UserFault,
    expect_file,
    expect_other,
    expect_own_directory,
    printable,
    system_words,
)
from hygrokf.commands.fleet import fleet_arguments, tell_fleet
from hygrokf.commands.live import doctor_arguments, export_arguments, track_arguments
from hygrokf.commands.transfer import compare_arguments, transfer_arguments
from hygrokf.data.files import DISCOVERY, FIT
from hygrokf.errors import HygrokfError
from hygrokf.version import __version__

if TYPE_CHECKING:
    from hygrokf.data.record import Record

USER_FAULT = 2
"""Exit status of a mistake that the user can mend."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status (0, 2 for the user's mistakes, 130 when interrupted)."""
    # the filter's matrices are tiny: more BLAS threads only wait for each other
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a terminal without ≤ or τ gets a question mark, not a traceback
            stream.reconfigure(errors="replace")
    parser = _parser()
    options = parser.parse_args(arguments)
    if not hasattr(options, "command"):
        parser.print_help()
        return 0
    try:
        status = options.command(options)
        if sys.stdout is not None:  # None where the shell has closed it
            sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        print("interrupted; nothing half-written is left", file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever read the output has gone; the rest of it must not complain at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as fault:
        print(f"hygrokf: {system_words(fault)}", file=sys.stderr)
        return USER_FAULT
    except HygrokfError as fault:
        print(f"hygrokf: {printable(str(fault))}", file=sys.stderr)
        return USER_FAULT


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hygrokf",
        description="Hygrothermal models of converter cabinets in wind turbines by Kalman filtering.",
    )
    parser.add_argument("--version", action="version", version=f"hygrokf {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")

    def command(name: str, function: Any, text: str) -> argparse.ArgumentParser:
        made = commands.add_parser(name, help=text, description=text)
        made.set_defaults(command=function)
        return made

    demo = command("demo", _demo, "make a synthetic turbine, fit it, evaluate and report it")
    demo.add_argument("--out", type=Path, required=True, help="directory for the case and the results")
    demo.add_argument("--seed", type=_whole(0), default=1, help="seed of the synthetic turbine (default 1)")
    _json(demo)
    check = command("check", _check, "say what was read from a case: spans, steps, gaps, clocks, doubts")
    check.add_argument("case", type=Path, metavar="CASE.toml")
    _json(check)
    fit = command("fit", _fit, "identify the models of a case")
    fit.add_argument("case", type=Path, metavar="CASE.toml")
    fit.add_argument(
        "--out", type=Path, required=True, help="directory for fit.json, series.npz and report.html"
    )
    fit.add_argument(
        "--criterion",
        choices=("likelihood", "simulation"),
        default="likelihood",
        help="innovations (default) or the free run's error, as in the paper",
    )
    fit.add_argument(
        "--kind",
        choices=("joint", "cascade"),
        default=None,
        help="one filter, or hygric on the measured temperature",
    )
    fit.add_argument(
        "--starts", type=_whole(1), default=5, help="starts of the search for the maximum (default 5)"
    )
    _json(fit)
    discover = command(
        "discover", _discover, "show what the simulation gets wrong, name the cause, extend the model"
    )
    discover.add_argument("case", type=Path, metavar="CASE.toml")
    discover.add_argument(
        "--out",
        type=Path,
        required=True,
        help="directory for discovery.json, report.html and the extended model",
    )
    discover.add_argument(
        "--starts", type=_whole(1), default=5, help="starts of the search for the maximum (default 5)"
    )
    discover.add_argument(
        "--budget",
        type=_seconds,
        default=120.0,
        metavar="SECONDS",
        help="time after which no further trial is begun, bar what is needed to finish (default: %(default)g; inf: none)",
    )
    _library(discover)
    _json(discover)
    simulate = command(
        "simulate", _simulate, "run a fitted model on the inputs of a case, without its readings"
    )
    simulate.add_argument("fit", type=Path, metavar="FIT.json")
    simulate.add_argument("case", type=Path, metavar="CASE.toml")
    simulate.add_argument("--out", type=Path, required=True, help="CSV file to write")
    _library(simulate)
    _json(simulate)
    evaluate = command("evaluate", _evaluate, "score a fitted model on a case")
    evaluate.add_argument("fit", type=Path, metavar="FIT.json")
    evaluate.add_argument("case", type=Path, metavar="CASE.toml")
    _library(evaluate)
    _json(evaluate)
    fleet = command("fleet", _fleet, "do one of these for many turbines: one table and one page of all")
    fleet_arguments(fleet, _whole)
    _json(fleet)
    climate = command(
        "climate", _climate, "simulate a site's climate in a fitted cabinet; limits, and a test profile"
    )
    climate_arguments(climate, _whole)
    _library(climate)
    _json(climate)
    compare = command("compare", _compare, "put cases, models or ambient sources side by side, with bounds")
    compare_arguments(compare)
    _library(compare)
    _json(compare)
    transfer = command(
        "transfer", _transfer, "try a fitted model on another turbine: what travels, what differs"
    )
    transfer_arguments(transfer)
    _library(transfer)
    _json(transfer)
    export = command("export", _export, "write what a live tracker has stored to CSV or Parquet files")
    export_arguments(export)
    _json(export)
    track = command("track", _track, "follow cabinets live: condition, forecast, alarms, on a page")
    track_arguments(track)
    _library(track)
    doctor = command("doctor", _doctor, "look at all that a tracker needs, change nothing, say what to mend")
    doctor_arguments(doctor)
    _library(doctor)
    _json(doctor)
    report = command("report", _report, "write the pages again from a directory of results")
    report.add_argument("directory", type=Path, metavar="DIR")
    _json(report)
    return parser


def _whole(least: int) -> Callable[[str], int]:
    """A whole number from `least` on."""

    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"expected a whole number from {least} on, found {text!r}")
        return value

    return number


def _json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def _library(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--library",
        type=Path,
        action="append",
        default=[],
        metavar="FILE.py",
        help="a file with causes of your own, which is executed; may be given several times",
    )


def _record(path: Path, cabinet: bool = True) -> Record:
    """The record of a case, with its warnings on standard error."""
    from hygrokf.cases.case_file import read_case

    record = read_case(path, cabinet=cabinet)
    for warning in record.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return record


def _identify(record: Record, case: Path, options: argparse.Namespace) -> Any:
    from hygrokf.identification.procedure import identify

    progress = Progress(16)
    try:
        fit = identify(
            record,
            criterion=getattr(options, "criterion", "likelihood"),
            starts=getattr(options, "starts", 4),
            progress=progress,
            **({"kind": options.kind} if getattr(options, "kind", None) else {}),
        )
    except ValueError as fault:
        progress.abandon()
        raise UserFault(f"{case}: {fault}") from fault
    except BaseException:
        progress.abandon()
        raise
    progress.close()
    return fit


def _load(libraries: Sequence[Path]) -> None:
    """Load the users' own causes, which models may be made of."""
    if libraries:
        from hygrokf.discovery.own_causes import load_library

        load_library(*libraries)


def _stored(options: argparse.Namespace, path: Path | None = None) -> Any:
    """The fit that a command names, or that of a path, with the users' mechanisms of its model."""
    from hygrokf.identification.results import LibraryAbsent, read_fit

    path = options.fit if path is None else path
    _load(options.library)
    try:
        return read_fit(path)
    except LibraryAbsent:  # packages are asked only where a model needs them
        from hygrokf.discovery.own_causes import load_library

        load_library(*options.library, installed=True)
        return read_fit(path)


def _write(fit: Any, out: Path) -> Path:
    from hygrokf.identification.results import write_fit
    from hygrokf.report.fit_page import write_report

    write_fit(fit, out)
    return write_report(out)


def _print(data: Any, text: str, as_json: bool) -> None:
    from hygrokf.identification.results import dump

    print(dump(data) if as_json else text, end="" if as_json else "\n")


def _demo(options: argparse.Namespace) -> int:
    from hygrokf.cases.synthetic import synthetic_turbine, write_case
    from hygrokf.report.fit_page import report_text

    expect_own_directory(options.out, FIT)
    there = options.out / "case.toml"
    if there.is_file() and b"synthetic" not in there.read_bytes():
        raise UserFault(
            f"--out {options.out}: it holds a case.toml of another turbine; name another directory"
        )
    case = write_case(synthetic_turbine(seed=options.seed), options.out)
    print(f"synthetic turbine written: {case}", file=sys.stderr)
    fit = _identify(_record(case), case, options)
    page = _write(fit, options.out)
    return _reported(page, fit.to_json(), report_text(fit.to_json()), options)


def _check(options: argparse.Namespace) -> int:
    from hygrokf.cases.case_file import read_case
    from hygrokf.cases.summary import describe, describe_text

    found = describe(read_case(options.case, cabinet=False))
    _print(found, describe_text(found), options.json)
    return 0


def _fit(options: argparse.Namespace) -> int:
    from hygrokf.report.fit_page import report_text

    expect_own_directory(options.out, FIT)
    there = _fit_there(options.out)
    record = _record(options.case)
    fit = _identify(record, options.case, options)
    if there and there != record.name:
        print(f"note: --out {options.out}: replaces the fit of {printable(there)}", file=sys.stderr)
    page = _write(fit, options.out)
    return _reported(page, fit.to_json(), report_text(fit.to_json()), options)


def _fit_there(out: Path) -> str:
    """The name of the record whose fit a directory holds already; a fit.json of another program's is refused."""
    import json

    file = out / FIT
    if not file.exists():
        return ""
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        data = None
    if not isinstance(data, dict) or not {"name", "version", "parameters", "time_constants"} <= set(data):
        raise UserFault(
            f"--out {out}: expected a new directory or one with an earlier fit, found a {FIT} in it that is no result "
            "of `hygrokf fit`; name another one, or take that file away"
        )
    return str(data["name"])


def _seconds(text: str) -> float:
    """A number of seconds above 0; `inf` is one."""
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not found > 0.0:
        raise argparse.ArgumentTypeError(f"expected seconds above 0 or inf, found {text!r}")
    return found


def _discover(options: argparse.Namespace) -> int:
    from hygrokf.discovery.library import LIBRARY
    from hygrokf.discovery.own_causes import load_library
    from hygrokf.discovery.procedure import discover
    from hygrokf.report.discovery_page import write_discovery_report
    from hygrokf.report.discovery_text import discovery_text

    expect_own_directory(options.out, DISCOVERY)
    own = load_library(*options.library, installed=True)
    record = _record(options.case)
    progress = Progress(45)
    wider = {"library": (*LIBRARY, *own)} if own else {}
    try:
        found = discover(record, starts=options.starts, progress=progress, budget_s=options.budget, **wider)
    except ValueError as fault:
        progress.abandon()
        raise UserFault(f"{options.case}: {fault}") from fault
    except BaseException:
        progress.abandon()
        raise
    progress.close()
    tried = {row["cause"] for key in ("causes", "rejected") for row in found.to_json()[key]}
    for cause in own:
        if cause.name not in tried:
            needs = f"; it needs {cause.needs}" if cause.needs else ""
            print(f"note: {cause.name} was not tried: this record cannot show it{needs}", file=sys.stderr)
    page = write_discovery_report(found, options.out)
    return _reported(page, found.to_json(), discovery_text(found.to_json()), options)


def _simulate(options: argparse.Namespace) -> int:
    from hygrokf.data.files import write_text_whole
    from hygrokf.identification.tables import simulation_csv, simulation_summary
    from hygrokf.identification.verdict import told

    expect_file(options.out)
    fit = _stored(options)
    record = _record(options.case, cabinet=False)
    sources = (options.case.parent / file for file, _ in record.provenance)
    expect_other(options.out, options.fit, options.fit / FIT, options.case, *sources)
    try:
        text, summary = simulation_csv(fit, record), simulation_summary(fit, record)
    except ValueError as fault:
        raise UserFault(f"{options.case}: {fault}") from fault
    write_text_whole(options.out, text)
    for sentence in summary["statements"]:
        print(f"note: {sentence}", file=sys.stderr)
    _print(
        summary,
        "\n".join([f"{summary['n']} instants written: {options.out}", *told(summary["verdicts"])]),
        options.json,
    )
    return 0


def _evaluate(options: argparse.Namespace) -> int:
    from hygrokf.identification.tables import evaluate, evaluation_text

    fit = _stored(options)
    record = _record(options.case)
    try:
        found = evaluate(fit, record)
    except ValueError as fault:
        raise UserFault(f"{options.case}: {fault}") from fault
    _print(found, evaluation_text(found), options.json)
    return 0


def _fleet(options: argparse.Namespace) -> int:
    page, rows, text, status = tell_fleet(options)
    _print({"rows": rows}, text, options.json)
    print(f"report: {page}", file=sys.stderr)
    return status


def _climate(options: argparse.Namespace) -> int:
    from hygrokf.commands.climate import run_climate

    return _reported(*run_climate(options, lambda: _stored(options)), options)


def _compare(options: argparse.Namespace) -> int:
    from hygrokf.commands.transfer import run_compare

    def stored(path: Path) -> Any:
        return _stored(options, path)

    found = run_compare(options, _record, stored, lambda record, case: _identify(record, case, options))
    return _reported(*found, options)


def _transfer(options: argparse.Namespace) -> int:
    from hygrokf.commands.transfer import run_transfer

    return _reported(*run_transfer(options, _record, lambda path: _stored(options, path)), options)


def _reported(page: Path, data: Any, text: str, options: argparse.Namespace) -> int:
    _print(data, text, options.json)
    print(f"report: {page}", file=sys.stderr)
    return 0


def _report(options: argparse.Namespace) -> int:
    from hygrokf.data.files import CLIMATE, COMPARISON, DISCOVERY, FLEET, TRANSFER
    from hygrokf.report.fit_page import write_report

    folder = options.directory.parent if options.directory.is_file() else options.directory
    if (folder / DISCOVERY).is_file():
        from hygrokf.report.discovery_page import write_discovery_report

        page = write_discovery_report(None, folder)
    elif (folder / FLEET).is_file():
        from hygrokf.fleet.running import write_fleet_report

        page = write_fleet_report(folder)
    elif (folder / CLIMATE).is_file():
        from hygrokf.report.climate_page import write_climate_report

        page = write_climate_report(None, folder)
    elif (folder / COMPARISON).is_file():
        from hygrokf.report.comparison_page import write_comparison

        page = write_comparison(None, folder)
    elif (folder / TRANSFER).is_file():
        from hygrokf.report.transfer_page import rewrite_transfer

        page = rewrite_transfer(folder)
    else:
        page = write_report(options.directory)
    _print({"report": str(page)}, str(page), options.json)
    return 0


def _export(options: argparse.Namespace) -> int:
    from hygrokf.commands.live import run_export

    _print(*run_export(options), options.json)
    return 0


def _track(options: argparse.Namespace) -> int:
    from hygrokf.commands.live import run_track

    _load(options.library)
    run_track(options)
    return 0


def _doctor(options: argparse.Namespace) -> int:
    from hygrokf.commands.live import run_doctor

    _load(options.library)
    data, text, status = run_doctor(options)
    _print(data, text, options.json)
    return status


if __name__ == "__main__":
    sys.exit(main())
