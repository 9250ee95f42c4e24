"""Pictures and tables from measured data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from validation.records import FINNISH, source_rows

from illustrations.pages import QUANTITIES, identified, save, write_table

UNTIL = '[identification]\nuntil = "2011-12-31T22:00:00Z"\n'


def _attic_scores(label: str, r: Mapping) -> list[list[str]]:
    """RMSE of the model in the validation period, and that of a rule without a model."""
    rows = []
    for (quantity, unit), rule in zip(QUANTITIES.items(), ("no_dynamics", "ambient"), strict=True):
        own = r["rmse"]["validation"][quantity]
        name = quantity.rsplit("_", 1)[0].replace("_g", "").replace("_", " ")
        simple = r["baselines"]["validation"][rule][quantity]["total"]
        rows.append(
            [label, f"{name} [{unit}]", f"{own['n']['total']:,}", f"**{own['total']:.2f}**", f"{simple:.2f}"]
        )
    return rows


def attic(directory: Path, data: Path) -> None:
    """The attic R2: its middle air as the cabinet; two choices of the ambient."""
    from hygrokf import read_case

    file = (data / "attic_trh1_R2_hourly.csv.gz").resolve()
    fits = {}
    for label, columns in {
        "weather station": "T_fmi RH_fmi",
        "eave logger": "T_roofwest_outside RH_roofwest_outside",
    }.items():
        case = directory / f"{label}.toml"
        rows = source_rows(
            FINNISH, f"T_roofmiddle_airmiddle RH_roofmiddle_airmiddle {columns} Rglob", str(file)
        )
        case.write_text(f'name = "attic R2, ambient {label}"\n' + rows.format() + UNTIL, encoding="utf-8")
        fits[label] = identified(read_case(case))
    scores = [["ambient", "quantity", "n", "model", "rule without a model"]]
    for label, fit in fits.items():
        r = fit.to_json()
        scores += _attic_scores(label, r)
        print(label, r["converged"], r["statements"], sep="\n  ", flush=True)
        for name, row in r["parameters"].items():
            print(
                f"    {name:34} {row['value']:.4g} ({row['lower']}, {row['upper']}) {row['unit']}", flush=True
            )
    write_table("real_input.md", "attic scores", scores)

    from hygrokf.report.figures.course_panels import figure_residuals

    shown = fits["weather station"]
    save(figure_residuals(shown.results, shown.series).figure(), "attic_residuals")


def truth_and_estimate(fits: Sequence, truths: Sequence):
    """Estimates with their bounds over the true values."""
    from hygrokf.report.figures.drawing import AMBIENT_COLOUR, MEASURED, QUIET, new_figure, styled

    with styled():
        made = new_figure(3.0)
        for place, (part, field) in enumerate((("thermal", "tau_h"), ("hygric", "hygric_h")), start=1):
            axis = made.add_subplot(1, 2, place)
            for fit, truth in zip(fits, truths, strict=True):
                entry, true = fit.to_json()["time_constants"][part], getattr(truth, field)
                other = entry["simulation"]
                axis.plot(
                    [1.012 * true] * 2,
                    [other["lower_h"], other["upper_h"]],
                    color=AMBIENT_COLOUR,
                    linewidth=1.2,
                )
                axis.plot([true] * 2, [entry["lower_h"], entry["upper_h"]], color=MEASURED, linewidth=2.4)
                axis.plot(true, entry["value_h"], "o", color=MEASURED, markersize=4)
            ends = axis.get_xlim()
            axis.plot(ends, ends, color=QUIET, linewidth=0.8, zorder=0)
            axis.set_xlabel(f"true {part} time constant [h]")
            axis.set_ylabel("estimate, 95 % bounds [h]")
        axis.plot([], [], color=MEASURED, linewidth=2.4, label="likelihood")
        axis.plot([], [], color=AMBIENT_COLOUR, linewidth=1.2, label="free run's least error")
        axis.legend(loc="upper left")
        made.subplots_adjust(left=0.08, right=0.98, bottom=0.16, top=0.92, wspace=0.25)
    return made


def uk(directory: Path, data: Path) -> None:
    """Simulated cabinets under measured UK weather and power."""
    import plants.uk as uk_module
    from plants import uk_plant
    from plants.as_record import to_record

    uk_module.UK_DRIVERS = data / "kelmarsh_2018_2019_era5_power_hourly.csv.gz"
    fits, truths = [], []
    for seed in (1, 2, 3, 4, 5):
        made = uk_plant(seed)
        record = to_record(made)
        until = record.start_s + 150 * 86400.0
        fit = identified(replace(record, until_s=until))
        fits.append(fit)
        truths.append(made.truth)
        print(
            fit.to_json()["converged"],
            fit.to_json()["statements"],
            fit.to_json()["bands"]["free_run"],
            made.truth.class_right,
            flush=True,
        )
    save(truth_and_estimate(fits, truths), "uk_truth", "simulated cabinet")


def climate(directory: Path, data: Path) -> None:
    """The pictures of docs/how_to/climate.md: a simulated cabinet under measured weather of two places."""
    from plants import uk_plant
    from plants.as_record import to_record

    from hygrokf.climate.climate_profile import climate_profile
    from hygrokf.climate.region import Region, read_region
    from hygrokf.report.figures.climate_figures import (
        figure_duration,
        figure_joint,
        figure_profile,
        figure_regions,
    )

    label = "simulated cabinet, measured weather"
    record = to_record(uk_plant(501, days=719.0, start="2018-01-01T00:00:00"))
    fit = identified(record.window(record.start_s + 90 * 86400.0, record.start_s + 210 * 86400.0))
    places = [
        Region("UK, 2018 and 2019", record, ("ERA5",)),
        read_region("northern Italy", [data / "weather" / "PVGIS_45N_8E.epw.gz"]),
    ]
    found = climate_profile(fit, places, record).regions
    save(figure_joint(found[0]).figure(), "climate_joint", label)
    save(figure_profile(found[0]).figure(), "climate_profile", label)
    # their titles leave no room for a label
    save(figure_duration(found[0]).figure(), "climate_duration")
    save(figure_regions(found).figure(), "climate_regions")
    for one in found:
        print(
            one["name"], one["statements"], one["wetness_class"], one["test_profile"]["closeness"], flush=True
        )
