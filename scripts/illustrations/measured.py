"""Pictures and tables from measured data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from illustrations.pages import QUANTITIES, bounds_text, identified, save, simulation_text, write_table

ATTIC = """\
name = "attic R2, ambient {label}"
[[source]]
file = "{file}"
time = "t_UTC+2"
timezone = "+02:00"
signals.cabinet_temperature = {{ column = "T_roofmiddle_airmiddle", unit = "degC" }}
signals.cabinet_relative_humidity = {{ column = "RH_roofmiddle_airmiddle", unit = "%" }}
signals.ambient_temperature = {{ column = "{temperature}", unit = "degC" }}
signals.ambient_relative_humidity = {{ column = "{humidity}", unit = "%" }}
signals.global_horizontal_irradiance = {{ column = "Rglob", unit = "W/m2" }}
[identification]
until = "2011-12-31T22:00:00Z"
"""


FRENCH = ("R80736_10min_2014_2015", "era5_hourly_2014_2015")


def _attic_scores(label: str, r: Mapping) -> list[list[str]]:
    """RMSE of the model and of the simple ones beside it."""
    rows = []
    for period in ("identification", "validation"):
        for quantity, unit in QUANTITIES.items():
            own = r["rmse"][period][quantity]
            others = [
                r["baselines"][period].get(n, {}).get(quantity, {}).get("total")
                for n in ("no_dynamics", "ambient", "ambient_pressure_balance")
            ]
            rows.append([label, period,
                quantity.rsplit("_", 1)[0].replace("_g", "").replace("_", " ") + f" [{unit}]",
                           f"{own['n']['total']:,}", f"**{own['total']:.2f}**",
                           *("" if v is None else f"{v:.2f}" for v in others)])  # fmt: skip
    return rows


def _attic_constants(label: str, r: Mapping) -> list[list[str]]:
    """Time constants by both criteria, and their shift under a thinned ambient."""
    rows = []
    for part, entry in r["time_constants"].items():
        shift = entry["sampling"]["shift_ln_when_halved"]
        rows.append(
            [
                label,
                part,
                bounds_text(entry),
                f"{entry['factor']:.1f}",
                simulation_text(entry),
                f"{100 * math.expm1(shift):+.0f} %",
            ]
        )
    return rows


def _attic_bands(label: str, r: Mapping) -> list[list[str]]:
    """How often the bands hold the readings."""
    rows = []
    for quantity, text in (
        ("temperature_K", "temperature"),
        ("relative_humidity", "relative humidity"),
        ("absolute_humidity_g_m3", "absolute humidity"),
    ):
        rows.append(
            [
                label,
                text,
                *(
                    f"{100 * r['bands'][lead][quantity]['coverage']:.0f} %"
                    for lead in ("1h", "6h", "24h", "free_run")
                ),
            ]
        )
    return rows


def attic(directory: Path, data: Path) -> None:
    """The attic R2: its middle air as the cabinet; two choices of the ambient."""
    from hygrokf import read_case

    file = (data / "attic_trh1_R2_hourly.csv.gz").resolve()
    fits = {}
    for label, columns in {
        "from the weather station": ("T_fmi", "RH_fmi"),
        "from the logger at the west eave": ("T_roofwest_outside", "RH_roofwest_outside"),
    }.items():
        case = directory / f"{columns[0]}.toml"
        case.write_text(
            ATTIC.format(label=label, file=file, temperature=columns[0], humidity=columns[1]),
            encoding="utf-8",
        )
        fits[label] = identified(read_case(case))
    scores = [
        ["ambient", "period", "quantity", "n", "model", "no heat storage", "c = c_amb", "c_amb T_amb/T_a"]
    ]
    constants = [
        [
            "ambient",
            "time constant",
            "by the innovations [h]",
            "factor",
            "by the free run [h]",
            "every second ambient reading left out",
        ]
    ]
    bands = [["ambient", "quantity", "1 h", "6 h", "24 h", "free run"]]
    for label, fit in fits.items():
        r = fit.to_json()
        scores += _attic_scores(label, r)
        constants += _attic_constants(label, r)
        bands += _attic_bands(label, r)
        print(label, r["converged"], r["statements"], sep="\n  ", flush=True)
        for name, row in r["parameters"].items():
            print(
                f"    {name:34} {row['value']:.4g} ({row['lower']}, {row['upper']}) {row['unit']}", flush=True
            )
    write_table("real_input.md", "attic scores", scores)
    write_table("real_input.md", "attic time constants", constants)
    write_table("real_input.md", "attic bands", bands)

    from hygrokf.report.figures.course import figure_excerpts, figure_residuals

    shown = fits["from the weather station"]
    save(figure_excerpts(shown.results, shown.series), "attic")
    save(figure_residuals(shown.results, shown.series), "attic_residuals")


def truth_and_estimate(fits: Sequence, truths: Sequence):
    """Estimates with their bounds over the true values."""
    from hygrokf.report.figures.drawing import AMBIENT, MEASURED, QUIET, new_figure, styled

    with styled():
        made = new_figure(3.0)
        for place, (part, field) in enumerate((("thermal", "tau_h"), ("hygric", "hygric_h")), start=1):
            axis = made.add_subplot(1, 2, place)
            for fit, truth in zip(fits, truths, strict=True):
                entry, true = fit.to_json()["time_constants"][part], getattr(truth, field)
                other = entry["simulation"]
                axis.plot(
                    [1.012 * true] * 2, [other["lower_h"], other["upper_h"]], color=AMBIENT, linewidth=1.2
                )
                axis.plot([true] * 2, [entry["lower_h"], entry["upper_h"]], color=MEASURED, linewidth=2.4)
                axis.plot(true, entry["value_h"], "o", color=MEASURED, markersize=4)
            ends = axis.get_xlim()
            axis.plot(ends, ends, color=QUIET, linewidth=0.8, zorder=0)
            axis.set_xlabel(f"true {part} time constant [h]")
            axis.set_ylabel("estimate, 95 % bounds [h]")
        axis.plot([], [], color=MEASURED, linewidth=2.4, label="likelihood")
        axis.plot([], [], color=AMBIENT, linewidth=1.2, label="free run's least error")
        axis.legend(loc="upper left")
        made.subplots_adjust(left=0.08, right=0.98, bottom=0.16, top=0.92, wspace=0.25)
    return made


def uk(directory: Path, data: Path) -> None:
    """Simulated cabinets under measured UK weather and power."""
    import plants.uk as uk_module
    from plants import uk_plant
    from plants.as_record import to_record

    uk_module.UK_DRIVERS = data / "kelmarsh_2018_2019_era5_power_hourly.csv.gz"
    rows = [
        [
            "cabinet",
            "start",
            "thermal: truth",
            "estimate [h]",
            "by the free run",
            "hygric: truth",
            "estimate [h]",
            "by the free run",
            "free run, validation",
        ]
    ]
    fits, truths = [], []
    for seed in (1, 2, 3, 4, 5):
        made = uk_plant(seed)
        record = to_record(made)
        until = record.start_s + 150 * 86400.0
        fit = identified(replace(record, until_s=until))
        fits.append(fit)
        truths.append(made.truth)
        c, r = fit.to_json()["time_constants"], fit.to_json()["rmse"]["validation"]
        rows.append([
            str(seed), str(np.datetime64(int(record.start_s), "s"))[:10],
            f"{made.truth.tau_h:.2f}", bounds_text(c["thermal"]), simulation_text(c["thermal"]),
            f"{made.truth.hygric_h:.3f}", bounds_text(c["hygric"]), simulation_text(c["hygric"]),
            f"{r['temperature_K']['total']:.2f} K, {r['absolute_humidity_g_m3']['total']:.2f} g/m³",
        ])  # fmt: skip
        print(
            fit.to_json()["converged"],
            fit.to_json()["statements"],
            fit.to_json()["bands"]["free_run"],
            made.truth.class_right,
            flush=True,
        )
    write_table("real_input.md", "uk", rows)

    from hygrokf.report.figures.course import figure_excerpts

    label = "simulated cabinet"
    save(figure_excerpts(fits[0].to_json(), fits[0].series), "uk", label)
    save(truth_and_estimate(fits, truths), "uk_truth", label)


def clocks(directory: Path, data: Path) -> None:
    """The French wind farm's clock against the reanalysis."""
    from hygrokf.cases.case_file import read_case
    from hygrokf.report.figures.weather import figure_clocks
    from hygrokf.weather.clocks import alignments, clock_errors

    case = directory / "french.toml"
    files = {name: (data / f"la_haute_borne_{name}.csv.gz").resolve() for name in FRENCH}
    case.write_text(
        f'[[source]]\nfile = "{files["R80736_10min_2014_2015"]}"\ntime = "Date_time"\nstamp = "start"\n'
        'signals.ambient_temperature = { column = "Ot_avg", unit = "degC" }\nsignals.wind_speed = { column = '
        f'"Ws_avg", unit = "m/s" }}\n[[source]]\nfile = "{files["era5_hourly_2014_2015"]}"\ntime = '
        '"datetime"\ntimezone = "UTC"\ncompare = true\nsignals.ambient_temperature = { column = "t_2m", unit '
        '= "K" }\nsignals.wind_speed = { column = "ws_100m", unit = "m/s" }\n',
        encoding="utf-8",
    )
    record = read_case(case, cabinet=False)
    found = alignments(record)
    (error,) = clock_errors(found)
    by_signal = {one.signal: one for one in found}
    rows = [["signal", "offset", "daily wave", "lag by", "winter [min]", "summer [min]"]]
    for signal, name, unit in (
        ("ambient_temperature", "outdoor temperature", "K"),
        ("wind_speed", "wind speed", "m/s"),
    ):
        one = by_signal[signal]
        for by, how in (("weather", "the weather"), ("mean_day", "the mean day")):
            lags = [getattr(season, by) for season in (one.winter, one.summer)]
            rows.append([
                name, f"{one.offset.value:+.2f} ({one.offset.low:+.2f} … {one.offset.high:+.2f}) {unit}",
                f"{100 * one.amplitude_ratio.value:.0f} %", how,
                *(f"{lag.value / 60:+.0f} ({lag.low / 60:+.0f} … "
                  f"{lag.high / 60:+.0f})" if lag.known else "–" for lag in lags),
            ])  # fmt: skip
    write_table("weather.md", "clocks", rows)
    temperature = by_signal["ambient_temperature"]
    (second,) = (one for one in record.compared if one.signal == "ambient_temperature")
    figure = figure_clocks(
        record["ambient_temperature"],
        second,
        temperature,
        error.corrections_s,
        names=("turbine", "reanalysis"),
    )
    save(figure, "clocks", "measured")


def climate(directory: Path, data: Path) -> None:
    """The pictures of docs/how_to/climate.md: a simulated cabinet under measured weather of two places."""
    from plants import uk_plant
    from plants.as_record import to_record

    from hygrokf.climate.procedure import climate_profile
    from hygrokf.climate.region import Region, read_region
    from hygrokf.report.figures.climate import figure_duration, figure_joint, figure_profile, figure_regions

    label = "simulated cabinet, measured weather"
    record = to_record(uk_plant(501, days=719.0, start="2018-01-01T00:00:00"))
    fit = identified(record.window(record.start_s + 90 * 86400.0, record.start_s + 210 * 86400.0))
    places = [
        Region("UK, 2018 and 2019", record, ("ERA5",)),
        read_region("northern Italy", [data / "weather" / "PVGIS_45N_8E.epw.gz"]),
    ]
    found = climate_profile(fit, places, record).regions
    save(figure_joint(found[0]), "climate_joint", label)
    save(figure_profile(found[0]), "climate_profile", label)
    # their titles leave no room for a label
    save(figure_duration(found[0]), "climate_duration")
    save(figure_regions(found), "climate_regions")
    for one in found:
        print(
            one["name"], one["statements"], one["wetness_class"], one["test_profile"]["closeness"], flush=True
        )
