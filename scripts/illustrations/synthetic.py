"""Pictures and tables from synthetic turbines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from illustrations.pages import DOCS, identified, save, synthetic_record


def demo(directory: Path) -> None:
    """README's picture, and the profiles of docs/explanation/theory.md."""
    from hygrokf.report.figures.course_panels import figure_excerpts
    from hygrokf.report.figures.fit_figures import figure_profiles

    record, _ = synthetic_record(1, directory)
    fit = identified(record)
    save(figure_excerpts(fit.results, fit.series).figure(), "demo", "synthetic turbine")
    save(figure_profiles(fit.results, fit.series).figure(), "profiles", "synthetic turbine")


def fleet(directory: Path) -> None:
    """The fleet of docs/how_to/fleet.md: its own blocks up to the picture, then its time constants."""
    import contextlib
    import json
    import re

    from hygrokf.commands.main import main as hygrokf
    from hygrokf.fleet.outliers import spreads
    from hygrokf.fleet.tasks import TASKS
    from hygrokf.report.figures.comparison_figures import figure_spreads

    text = (DOCS / "how_to" / "fleet.md").read_text(encoding="utf-8").partition("## Outliers")[0]
    here = {}
    with contextlib.chdir(directory):
        for language, block in re.findall(r"^```(\w+)\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            if language == "python":
                exec(block, here)
            elif "hygrokf fleet" in block:
                hygrokf(["fleet", "park/fleet.toml", "--out", "result", "--workers", "1"])
        rows = json.loads(Path("result/fleet.json").read_text(encoding="utf-8"))["rows"]
    done = [row for row in rows if row["status"] == "done"]
    found = [one for one in spreads(done, TASKS["fit"].compared) if one.compared.lower]
    save(figure_spreads(found).figure(), "fleet", "synthetic fleet")


def compare(directory: Path) -> None:
    """One fit under three ambient sources."""
    from hygrokf.report.figures.comparison_figures import figure_errors
    from hygrokf.transfer.comparison import compare, comparison_column

    record, _ = synthetic_record(1, directory)
    fit = identified(record)
    columns = []
    for label, every in (("every 10 min", 1), ("every hour", 6), ("every 6 h", 36)):
        thinned = [
            replace(s, time=s.time[::every], value=s.value[::every])
            for s in record.series
            if s.signal.startswith("ambient_")
        ]
        columns.append(comparison_column(fit, record.replace_series(*thinned), label, own=every == 1))
    found = compare(columns)
    save(figure_errors(found, "whole").figure(), "compare", "synthetic turbine")


def transfer(directory: Path) -> None:
    """A cabinet that releases and stores heat otherwise."""
    from hygrokf import identify, read_case, synthetic_turbine, write_case
    from hygrokf.cases.synthetic import SyntheticParameters
    from hygrokf.report.figures.comparison_figures import figure_course, figure_parameters
    from hygrokf.transfer.transfer_fit import transfer_fit

    other = SyntheticParameters(
        thermal_time_constant_h=2.4,
        operation_release=(10.5, 9.8, -2.8, -0.21),
        standstill_release=(7.0, -0.14),
    )
    records = [
        read_case(write_case(synthetic_turbine(seed=seed, days=60, parameters=p), directory / f"moved{seed}"))
        for seed, p in ((51, None), (52, other))
    ]
    found = transfer_fit(identify(records[0], starts=1, profiles=False), records[1], fits=False)
    print(found.results.statement, flush=True)
    save(figure_parameters(found.results).figure(), "transfer_parameters", "synthetic turbines")
    save(figure_course(found.course, True).figure(), "transfer_course", "synthetic turbines")
