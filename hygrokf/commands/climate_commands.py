"""`hygrokf climate`: simulate the climate in a fitted cabinet under years of weather."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.commands.console import (
    Progress,
    UserFault,
    activity,
    collect_faults,
    expect_own_directory,
    faults_of,
    show_reported,
)
from hygrokf.commands.opening import stored_fit
from hygrokf.commands.verb import Verb, add_json, add_library, add_out, reader, whole_number, within
from hygrokf.data.files import CLIMATE

if TYPE_CHECKING:
    from hygrokf.climate.chamber import ProfilePlan
    from hygrokf.climate.limits import ClimateLimit
    from hygrokf.climate.region import PowerCurve, Region
    from hygrokf.data.record import Record
    from hygrokf.identification.fit import Fit
    from hygrokf.physics.psychrometrics import Surface


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("fit", type=Path, metavar="FIT.json", help="the fitted model, or its directory")
    parser.add_argument(
        "--weather",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="weather of one site: files of ERA5, MERRA-2, Open-Meteo, EPW or TRY, or a case file (.toml)",
    )
    parser.add_argument(
        "--region",
        action="append",
        default=[],
        metavar="NAME=FILE[,FILE]",
        help="weather of a region; several regions are compared",
    )
    power = parser.add_mutually_exclusive_group()
    power.add_argument(
        "--power", type=Path, metavar="CASE.toml", help="case file with active power over time"
    )
    power.add_argument(
        "--power-curve", type=Path, metavar="CURVE.toml", help="power over the weather's wind speed"
    )
    power.add_argument("--standstill", action="store_true", help="no power all year")
    parser.add_argument(
        "--limits",
        metavar="LIMITS.toml|CLASS",
        help='limits for the climate: a file, or a class such as "IEC 60721-3-3 3K3"',
    )
    parser.add_argument(
        "--test", type=Path, metavar="TEST.toml", help="length, law and chamber of the test profile"
    )
    parser.add_argument(
        "--members", type=whole_number(2), default=50, help="members of the ensemble (default 50)"
    )
    parser.add_argument("--seed", type=whole_number(0), default=1, help="seed of the ensemble (default 1)")
    parser.add_argument(
        "--surface",
        type=reader("a number within 0 … 1 and maybe an offset in K, such as 0.3,-1", _surface),
        default=None,
        metavar="FOLLOWS[,OFFSET_K]",
        help="the coldest surface: 0 as cold as outside, 1 as warm as the cabinet air (default 0.3)",
    )
    add_out(parser, "directory for climate.json, climate.csv and report.html")
    add_library(parser)
    add_json(parser)


def _surface(text: str) -> Surface:
    """Read "FOLLOWS" or "FOLLOWS,OFFSET_K" as the coldest surface. Raises ValueError."""
    from hygrokf.physics.psychrometrics import Surface

    share, *offsets_K = (float(part) for part in text.split(","))
    within(0, len(offsets_K), 1)
    return Surface(within(0.0, share, 1.0), *(within(-50.0, offset_K, 50.0) for offset_K in offsets_K))


def _run(options: argparse.Namespace) -> int:
    """Simulate the climate, write its files, and show its report."""
    from hygrokf.climate.climate_profile import climate_profile
    from hygrokf.data.structured import plain
    from hygrokf.report.climate_page import climate_blocks, write_climate_report

    expect_own_directory(options.out, CLIMATE)
    fit, regions, power, limits, plan = _inputs(options)
    for region in regions:
        for warning in (*region.weather.warnings, *region.statements):
            activity().note(f"warning: {region.name}: {warning}")
    with Progress(4 * len(regions) + 1) as progress:
        with faults_of(options.fit):
            study = climate_profile(
                fit, regions, power, limits=limits, plan=plan, members=options.members, seed=options.seed,
                surface=options.surface, progress=progress,
            )  # fmt: skip
        progress("draw the report")
        page = write_climate_report(study, options.out)
    return show_reported(page, plain(study), climate_blocks(study), options.json)


def _inputs(
    options: argparse.Namespace,
) -> tuple[Fit, list[Region], Record | PowerCurve | None, tuple[ClimateLimit, ...], ProfilePlan | None]:
    """Read the files of the command line: fit, weather, power, limits, and plan of the test. Raises UserFault
    with the faults of all files."""
    from hygrokf.climate.chamber import ProfilePlan
    from hygrokf.climate.limits import limits_of
    from hygrokf.climate.region import PowerCurve, read_power, read_region
    from hygrokf.data.toml_form import read_toml_form

    groups = _regions(options)
    faults: list[str] = []
    with collect_faults(faults):
        fit = stored_fit(options.fit, options.library)
        has_power = options.power or options.power_curve or options.standstill
        if not has_power and fit.design.power_scale_W is not None:
            faults.append(
                "expected --power, --power-curve or --standstill, as the model reads a power; found none"
            )
    power: Record | PowerCurve | None = None
    with collect_faults(faults):
        power = read_power(options.power) if options.power else None
        if options.power_curve:
            power = read_toml_form(PowerCurve, options.power_curve)
    with collect_faults(faults):
        limits = limits_of(options.limits) if options.limits else ()
    with collect_faults(faults):
        plan = read_toml_form(ProfilePlan, options.test) if options.test else None
    regions: list[Region] = []
    for name, files in groups:
        with collect_faults(faults):
            regions.append(read_region(name, files, power))
    if faults:
        raise UserFault("\n".join(faults))
    return fit, regions, power, limits, plan


def _regions(options: argparse.Namespace) -> list[tuple[str, list[Path]]]:
    """Return the weather files of each region by its name. Raises UserFault for a wrong --region, or names
    that occur twice."""
    groups = [("site", options.weather)] if options.weather else []
    for text in options.region:
        name, equals_sign, files = text.partition("=")
        paths = [Path(file) for file in files.split(",") if file]
        if not (name.strip() and equals_sign and paths):
            raise UserFault(f"--region {text}: expected NAME=FILE or NAME=FILE,FILE; write it so")
        groups.append((name.strip(), paths))
    names = [name for name, _ in groups]
    if not groups or len(set(names)) < len(names):
        repeated = sorted({name for name in names if names.count(name) > 1})
        remark = f"found twice: {', '.join(repeated)}" if groups else "found none"
        raise UserFault(f"expected --weather FILE, or --region NAME=FILE with a name each; {remark}")
    return groups


CLIMATE_VERB = Verb(
    "climate", "simulate a site's climate in a fitted cabinet; limits, and a test profile", _arguments, _run
)
