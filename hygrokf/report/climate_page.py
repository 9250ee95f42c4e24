"""The page and the terminal text of a climate, from the same blocks."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Literal

from hygrokf.climate.chamber_profile import ChamberProfile
from hygrokf.climate.study import STATISTIC_UNITS, RegionClimate, Study, read_climate, write_climate
from hygrokf.data.files import REPORT, write_bytes_whole, write_text_whole
from hygrokf.data.record import Provenance
from hygrokf.identification.verdict_terms import rests_on
from hygrokf.report.blocks import (
    Block,
    Card,
    Cards,
    Details,
    Figure,
    Items,
    Page,
    Prose,
    inherited_verdicts,
    method,
    present,
    section,
    table_or,
    unmeasured,
)
from hygrokf.report.climate_tables import (
    class_text,
    events_table,
    hours_text,
    limits_table,
    number_text,
    profile_table,
    regimes_table,
    regions_table,
    share_held,
    span_text,
    value_and_bounds,
    year_table,
)
from hygrokf.report.figures.climate_figures import figure_profile
from hygrokf.report.figures.drawing import png
from hygrokf.report.figures.lead import duration_figure, lead_of_climate, year_figure
from hygrokf.report.page import page_html
from hygrokf.report.quantities import versions
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.reasons import REJECT
from hygrokf.texts.wording import moment, sentence

PICTURE = "test_profile.png"
LIMIT_TONES: dict[str, Literal["open", "plain", "reject"]] = {
    "pass": "plain", "undecided": "open", "fail": "reject"
}  # fmt: skip
"""How the verdict on limits is shown."""
OF_CLIMATE = {
    Provenance.SIMULATED: "The readings behind the model were simulated, or the weather was.",
    Provenance.SYNTHETIC: "The model or the weather is synthetic. Nothing on this page was measured.",
}
MOST_CARDS = 4
"""Regions that have a card each on the first screen."""
PROFILE_CAPTION = (
    "Days of the simulated climate that together resemble all of it, warmed until they cause the same "
    "ageing as the years of service. The relative humidity is the site's own."
)


def write_climate_report(study: Study | None, directory: str | os.PathLike[str]) -> Path:
    """Write climate.json, climate.csv, the test profile as CSV and PNG, and `report.html`; returns the page's
    path.

    study: None where the directory holds climate.json already: then the page and the picture alone are made
    again. Raises ResultFault where it is missing or damaged, OSError from the system.
    """
    folder = Path(directory)
    if study is None:
        study = read_climate(folder)
    else:
        write_climate(study, folder)
    page = page_html(climate_blocks(study))
    if len(study.regions) == 1 and study.regions[0].test_profile is not None:
        write_bytes_whole(folder / PICTURE, png(figure_profile(study.regions[0]).figure()))
    else:
        (folder / PICTURE).unlink(missing_ok=True)
    return write_text_whole(folder / REPORT, page)


def climate_blocks(study: Study) -> Page:
    """What a climate says: the answer with the picture of the year, then statements, tables and the test."""
    regions = study.regions
    several = len(regions) > 1
    cards = Cards(_cards(study))
    parts = [_region(region, place, several) for place, region in enumerate(regions, 1)]
    where = ", ".join(region.name for region in regions)
    held = f"bounds hold {share_held(regions)} of single years"
    return Page(
        "Climate report",
        study.name.strip() or "unnamed model",
        (f"Simulated for {where}: {study.members} members, seed {study.seed}; {held}",),
        present(
            *unmeasured(study.least_measured, OF_CLIMATE),
            cards if cards.cards else None,
            lead_of_climate(study),
        ),
        (
            *section("Regions side by side", regions_table(regions)),
            *section("The model", inherited_verdicts(study.verdicts, "The time constants of the model")),
            *(block for part in parts for block in part),
        ),
        _method(study),
    )


def doubt_text(study: Study) -> str:
    """A sentence where the climate rests on numbers of the fit that are not reliable; else empty."""
    return "".join(sentence(one.text) for one in rests_on(study.verdicts))


# --- the answer ------------------------------------------------------------------------------


def _cards(study: Study) -> tuple[Card, ...]:
    """Of one region the verdict on its limits, then its hours; of a few regions the hours of wetness."""
    regions, doubt = study.regions, doubt_text(study)
    if len(regions) > 1:
        few = regions if len(regions) <= MOST_CARDS else ()
        return tuple(
            _number_card(one, "wetness_h", f"{one.name}: time of wetness", doubt, *_besides(one))
            for one in few
            if "wetness_h" in one.year
        )
    (region,) = regions
    cards = [_limits_card(region)] if region.limits else []
    if "wetness_h" not in region.year:
        cards.append(_number_card(region, "mean_temperature_degC", "Mean temperature", doubt))
    scaled = f", scaled up from {region.part_of_year}" if region.part_of_year else ""
    wet = f"class {class_text(region)}, ISO 9223:1992"
    for name, label, note in (
        ("wetness_h", "Time of wetness", wet),
        ("condensation_h", "Condensation", "on the coldest surface"),
    ):
        if name in region.year:
            cards.append(_number_card(region, name, label, doubt, f"{note}{scaled}"))
    return tuple(cards)


def _number_card(region: RegionClimate, name: str, label: str, doubt: str, *lines: str) -> Card:
    value, bounds = value_and_bounds(region.year[name], number_text(name))
    held = f"{share_held([region])} of single years: {bounds}" if bounds else "in every member and year"
    kind = REJECT if doubt else ""
    return Card(label, f"{value} {STATISTIC_UNITS[name]}", kind, held, doubt, lines=lines, tone="plain")


def _besides(region: RegionClimate) -> list[str]:
    """Condensation and the verdicts on the limits, as lines of a card."""
    lines = []
    if "condensation_h" in region.year:
        lines.append(f"condensation {span_text(region.year['condensation_h'], hours_text)} h/a")
    return [*lines, f"limits: {_counted(region)}"] if region.limits else lines


def _limits_card(region: RegionClimate) -> Card:
    failed = [limit for limit in region.limits if limit.verdict == "fail"]
    lines = tuple(f"Fails: {one.name}, {span_text(one.hours, hours_text)} h/a" for one in failed[:2])
    part = f", judged on {region.part_of_year} of weather, not a year" if region.part_of_year else ""
    label = f"Limits, {len(region.limits)} in all{part}"
    return Card(label, _counted(region), lines=lines, wide=True, words=True, tone=LIMIT_TONES[region.verdict])


def _counted(region: RegionClimate) -> str:
    found = [limit.verdict for limit in region.limits]
    return ", ".join(f"{found.count(v)} {v}" for v in ("pass", "undecided", "fail") if v in found)


# --- a region --------------------------------------------------------------------------------


def _region(region: RegionClimate, place: int, several: bool) -> tuple[Block, ...]:
    limits = table_or(limits_table(region), "No limits were given (--limits FILE).")
    title = f"{region.name}: {{}}" if several else "{}"
    one_kind = "The cabinet is only in operation, or only at standstill, all year."
    return (
        *section(
            title.format("Weather and power"),
            Prose(weather_text(region)),
            Items(tuple(sentence(str(one)) for one in (*region.statements, *region.warnings))),
        ),
        *(section(title.format("Limits"), limits) if not several or region.limits else ()),
        *section(
            title.format("The year"),
            year_figure(region, place) if several else None,
            year_table(region),
            table_or(regimes_table(region), one_kind),
            Details("Excursions, rates of change and cycles", (events_table(region),), printed=True),
            duration_figure(region, place) if region.joint is not None else None,
        ),
        *section(title.format("Test profile"), *_profile(region, place)),
    )


def weather_text(region: RegionClimate) -> str:
    """The span and the files of a region's weather, in a sentence."""
    spans = region.years
    many = f"{len(spans)} {'year' if len(spans) == 1 else 'years'}"
    if part := region.part_of_year:
        many = part.text if len(spans) == 1 else f"parts of {many}, the fullest of {part}"
    files = ", ".join(region.files) or "a record"
    return f"Weather from {moment(spans[0].start)} to {moment(spans[-1].end)} UTC ({many}), from {files}."


def _profile(region: RegionClimate, place: int) -> tuple[Block, ...]:
    profile = region.test_profile
    if profile is None:
        return (Prose("There is no test profile; the statements above give the reason.", "missing"),)
    table = profile_table(region)
    return (
        Prose(_profile_text(profile)),
        Figure(
            f"r{place}-profile", "Set points of the chamber", PROFILE_CAPTION, partial(figure_profile, region)
        ),
        *([Details("What the test profile reproduces", (table,))] if table else []),
    )


def _profile_text(profile: ChamberProfile) -> str:
    aged = profile.closeness.ageing
    statements = [
        ClimateCode.SAME_AGEING(
            hours=len(profile.temperature_degC),
            years=aged.years,
            lower=aged.years_lower,
            upper=aged.years_upper,
            acceleration=profile.acceleration,
            share=profile.share_at_chamber_limit,
        )
    ]
    if not profile.reached:
        short = aged.test_h < aged.service_h
        code = ClimateCode.AGEING_TOO_LITTLE if short else ClimateCode.AGEING_TOO_MUCH
        statements.append(code())
    return " ".join(sentence(statement.text) for statement in statements)


def _method(study: Study) -> tuple[Block, ...]:
    surface, law = study.surface, study.plan.law
    kind = "Peck's law" if law.humid else "Arrhenius' law"
    return method(
        "How this was computed",
        "Each member of the ensemble is the fitted model with parameters drawn from their estimated "
        "distribution. Weather and power alone drive it, and disturbances are simulated with the strength "
        "and memory that the fit found. Nothing was measured in these years.",
        "The bounds include the uncertainty of the parameters, the effect of the disturbances and, with "
        "several years, the differences between them. They do not include what the model lacks: heaters and "
        "doors that no signal reports, moisture stored in materials and condensed water unless the model has "
        "them, another cabinet, a future climate.",
        "In a model without condensation the air may exceed saturation; such hours count as wet. The "
        f"temperature of the cold surface where vapour condenses is the ambient's plus {surface.follows:g} "
        f"times the difference between cabinet air and ambient, plus {surface.offset_K:g} K.",
        f"Ageing follows {kind}, rate ∝ RH^{law.humidity_exponent:g} exp(−{law.activation_energy_eV:g} "
        f"eV/kT), in hours at {law.reference_degC:g} °C and {law.reference_percent:g} %. Its parameters "
        "describe a single failure mechanism (Peck 1986: aluminium corrosion in plastic packages); state the "
        "parameters of your own mechanism.",
        f"Simulated by {versions(study.version)}.",
    )
