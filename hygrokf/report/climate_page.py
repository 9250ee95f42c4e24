"""The page of a climate study: the answer, limits, numbers of the year, and the test profile."""

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
"""Verdict on limits → tone of its card."""
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
    """Write climate.json, climate.csv, the test profile as CSV and PNG, and `report.html`; returns the path
    of report.html.

    study: None: only the page and the PNG are written, from climate.json in the directory.

    Raises ResultFault if climate.json is missing or damaged, OSError from the system.
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
    """Return the page of a climate study; the answer and the figure of the year come first."""
    regions = study.regions
    several = len(regions) > 1
    cards = Cards(_cards(study))
    sections = [_region(region, number, several) for number, region in enumerate(regions, 1)]
    places = ", ".join(region.name for region in regions)
    bounds_text = f"bounds hold {share_held(regions)} of single years"
    return Page(
        "Climate report",
        study.name.strip() or "unnamed model",
        (f"Simulated for {places}: {study.members} members, seed {study.seed}; {bounds_text}",),
        present(
            *unmeasured(study.least_measured, OF_CLIMATE),
            cards if cards.cards else None,
            lead_of_climate(study),
        ),
        (
            *section("Regions side by side", regions_table(regions)),
            *section("The model", inherited_verdicts(study.verdicts, "The time constants of the model")),
            *(block for blocks_of_region in sections for block in blocks_of_region),
        ),
        _method(study),
    )


def doubt_text(study: Study) -> str:
    """Return a sentence if the climate rests on numbers of the fit that are not reliable; else ""."""
    return "".join(sentence(statement.text) for statement in rests_on(study.verdicts))


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
    """The card of one number of a region's year with its bounds; rejected if the fit is in doubt."""
    value, bounds = value_and_bounds(region.year[name], number_text(name))
    bounds_text = (
        f"{share_held([region])} of single years: {bounds}" if bounds else "in every member and year"
    )
    kind = REJECT if doubt else ""
    return Card(
        label, f"{value} {STATISTIC_UNITS[name]}", kind, bounds_text, doubt, lines=lines, tone="plain"
    )


def _besides(region: RegionClimate) -> list[str]:
    """Return condensation and the verdicts on the limits as lines of a card."""
    lines = []
    if "condensation_h" in region.year:
        lines.append(f"condensation {span_text(region.year['condensation_h'], hours_text)} h/a")
    return [*lines, f"limits: {_counted(region)}"] if region.limits else lines


def _limits_card(region: RegionClimate) -> Card:
    """Return the card with the verdicts on a region's limits; names the first two that fail."""
    failed = [limit for limit in region.limits if limit.verdict == "fail"]
    lines = tuple(f"Fails: {limit.name}, {span_text(limit.hours, hours_text)} h/a" for limit in failed[:2])
    remark = f", judged on {region.part_of_year} of weather, not a year" if region.part_of_year else ""
    label = f"Limits, {len(region.limits)} in all{remark}"
    return Card(label, _counted(region), lines=lines, wide=True, words=True, tone=LIMIT_TONES[region.verdict])


def _counted(region: RegionClimate) -> str:
    """Return how many limits have each verdict: "2 pass, 1 fail"."""
    verdicts = [limit.verdict for limit in region.limits]
    present_verdicts = [verdict for verdict in ("pass", "undecided", "fail") if verdict in verdicts]
    return ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in present_verdicts)


# --- a region --------------------------------------------------------------------------------


def _region(region: RegionClimate, number: int, several: bool) -> tuple[Block, ...]:
    """Return the sections of one region; number: of the region on the page, from 1."""
    limits = table_or(limits_table(region), "No limits were given (--limits FILE).")
    title_form = f"{region.name}: {{}}" if several else "{}"
    reason_if_empty = "The cabinet is only in operation, or only at standstill, all year."
    return (
        *section(
            title_form.format("Weather and power"),
            Prose(weather_text(region)),
            Items(tuple(sentence(str(statement)) for statement in (*region.statements, *region.warnings))),
        ),
        *(section(title_form.format("Limits"), limits) if not several or region.limits else ()),
        *section(
            title_form.format("The year"),
            year_figure(region, number) if several else None,
            year_table(region),
            table_or(regimes_table(region), reason_if_empty),
            Details("Excursions, rates of change and cycles", (events_table(region),), printed=True),
            duration_figure(region, number) if region.joint is not None else None,
        ),
        *section(title_form.format("Test profile"), *_profile(region, number)),
    )


def weather_text(region: RegionClimate) -> str:
    """Return the span and the files of a region's weather in a sentence."""
    years = region.years
    years_text = f"{len(years)} {'year' if len(years) == 1 else 'years'}"
    if part_of_year := region.part_of_year:
        several = f"parts of {years_text}, the fullest of {part_of_year}"
        years_text = part_of_year.text if len(years) == 1 else several
    files = ", ".join(region.files) or "a record"
    start, end = moment(years[0].start), moment(years[-1].end)
    return f"Weather from {start} to {end} UTC ({years_text}), from {files}."


def _profile(region: RegionClimate, number: int) -> tuple[Block, ...]:
    """Return the blocks of the test profile: its acceleration, set points, and what it reproduces."""
    profile = region.test_profile
    if profile is None:
        return (Prose("There is no test profile; the statements above give the reason.", "missing"),)
    table, draw = profile_table(region), partial(figure_profile, region)
    return (
        Prose(_profile_text(profile)),
        Figure(f"r{number}-profile", "Set points of the chamber", PROFILE_CAPTION, draw),
        *([Details("What the test profile reproduces", (table,))] if table else []),
    )


def _profile_text(profile: ChamberProfile) -> str:
    """Return sentences on the ageing that the test profile causes."""
    ageing = profile.closeness.ageing
    statements = [
        ClimateCode.SAME_AGEING(
            hours=len(profile.temperature_degC),
            years=ageing.years,
            lower=ageing.years_lower,
            upper=ageing.years_upper,
            acceleration=profile.acceleration,
            share=profile.share_at_chamber_limit,
        )
    ]
    if not profile.reached:
        is_too_little = ageing.test_h < ageing.service_h
        code = ClimateCode.AGEING_TOO_LITTLE if is_too_little else ClimateCode.AGEING_TOO_MUCH
        statements.append(code())
    return " ".join(sentence(statement.text) for statement in statements)


def _method(study: Study) -> tuple[Block, ...]:
    """Return how the climate was computed."""
    surface, law = study.surface, study.plan.law
    law_name = "Peck's law" if law.humid else "Arrhenius' law"
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
        f"Ageing follows {law_name}, rate ∝ RH^{law.humidity_exponent:g} exp(−{law.activation_energy_eV:g} "
        f"eV/kT), in hours at {law.reference_degC:g} °C and {law.reference_percent:g} %. Its parameters "
        "describe a single failure mechanism (Peck 1986: aluminium corrosion in plastic packages); state the "
        "parameters of your own mechanism.",
        f"Simulated by {versions(study.version)}.",
    )
