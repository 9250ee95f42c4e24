"""`report.html` of a climate: limits, numbers with bounds, distributions, and the test profile."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from hygrokf.climate.results import read_climate, write_climate
from hygrokf.climate.study import Study
from hygrokf.data.files import CLIMATE, REPORT, write_bytes_whole, write_text_whole
from hygrokf.data.lookup import entry
from hygrokf.identification.results import ResultFault
from hygrokf.identification.verdict import REJECT, rests_on
from hygrokf.identification.wording import percent, plain_number, sentence, text_of
from hygrokf.report.climate_tables import (
    class_text,
    excursions_table,
    hours_text,
    limits_table,
    part_of_year,
    profile_table,
    rates_table,
    regimes_table,
    regions_table,
    share_held,
    span_text,
    with_shares,
    year_table,
)
from hygrokf.report.figures.climate import figure_duration, figure_joint, figure_profile, figure_regions
from hygrokf.report.figures.drawing import png
from hygrokf.report.html import (
    document,
    figure_html,
    mark_html,
    moment,
    numbers_html,
    prose,
    section,
    tables_html,
)

PICTURE = "test_profile.png"
JOINT_CAPTION = (
    "Hours a year in bins of 2.5 K and 5 %. The red line is 80 %, above which a surface counts as wet. The cabinet is drier "
    "than the outside air because it is warmer, not because it holds less vapour."
)
DURATION_CAPTION = (
    "For how much of the time a value lies above the curve. The band holds {share} of single years: parameters that the fit "
    "leaves open, disturbances, and the spread between the years of weather."
)
PROFILE_CAPTION = (
    "Days of the simulated climate, chosen so that together they are like all of it, and warmed as far as the law of "
    "acceleration asks for. Relative humidity is the site's own."
)


def write_climate_report(study: Study | None, directory: str | os.PathLike[str]) -> Path:
    """Write climate.json, climate.csv, the test profile as CSV and PNG, and `report.html`; returns the page's path.

    study: None where the directory holds climate.json already: then the page and the picture alone are made again.
    Raises ResultFault where it is missing or damaged, OSError as the system gives it.
    """
    folder = Path(directory)
    if study is not None:
        write_climate(study, folder)
    found = read_climate(folder).results
    try:
        single = len(found["regions"]) == 1 and found["regions"][0]["test_profile"] is not None
        picture = png(figure_profile(found["regions"][0])) if single else None
        page = climate_page(found)
    except (LookupError, TypeError, AttributeError, ValueError) as fault:
        raise ResultFault(
            f"{folder / CLIMATE}: expected what `hygrokf climate` wrote, found it changed or of another version "
            f"({type(fault).__name__}: {fault}); run `hygrokf climate` again"
        ) from None
    if picture is None:
        (folder / PICTURE).unlink(missing_ok=True)
    else:
        write_bytes_whole(folder / PICTURE, picture)
    return write_text_whole(folder / REPORT, page)


def climate_page(found: Mapping) -> str:
    """The whole page as HTML text, from the data of `climate.json`."""
    regions = with_shares(found)
    name = text_of(entry(found, "name")).strip() or "unnamed model"
    parts = [_head(found, regions, name)]
    if len(regions) > 1:
        drawing = figure_html(
            "regions",
            "Regions side by side",
            f"Thin: bounds that hold {share_held(regions)} of single years. Thick: bounds that hold "
            f"{share_held(regions, 'mean_bounds_hold')} of the means over all years.",
            lambda: figure_regions(regions),
        )
        parts.append(section("Regions side by side", drawing, tables_html((regions_table(regions), ""))))
    for place, region in enumerate(regions, 1):
        parts += _region(region, place, len(regions) > 1, found.get("verdicts"))
    parts.append(_method(found))
    return document(f"{name} – hygrokf climate", parts)


def _head(found: Mapping, regions: Sequence[Mapping], name: str) -> str:
    where = ", ".join(text_of(one["name"]) for one in regions)
    line = (
        f"{where}; {found['members']} members, seed {found['seed']}, bounds that hold {share_held(regions)} of single years; cold surface "
        f"follows the cabinet air by {found['surface']['follows']:g}, offset {found['surface']['offset_K']:g} K"
    )
    banner = ""
    if found.get("synthetic") is True or any(one.get("synthetic") for one in regions):
        banner = (
            "<p class='banner synthetic'><b>SYNTHETIC</b> The model or the weather was made by a computer. "
            "Nothing on this page was measured.</p>"
        )
    return (
        "<header><p class=kind>Hygrothermal model of an enclosure · simulated climate</p>"
        f"<h1>{escape(name)}</h1><p class=meta>{prose(line)}</p>{banner}"
        f"{numbers_html(found.get('verdicts'), 'The numbers of the model')}</header>"
    )


def _region(region: Mapping, place: int, several: bool, verdicts: object) -> list[str]:
    title = f"{text_of(region['name'])}: " if several else ""
    short = f"r{place}-"
    spans = region["years"]
    many = f"{len(spans)} {'year' if len(spans) == 1 else 'years'}"
    if part := part_of_year(region):
        many = part if len(spans) == 1 else f"parts of {many}, the fullest of {part}"
    meta = f"Weather of {moment(spans[0]['from'])} to {moment(spans[-1]['until'])} UTC, {many}, from {', '.join(map(text_of, region['files'])) or 'a record'}."
    said = "".join(f"<p>{prose(sentence(one))}</p>" for one in region["statements"])
    return [
        f"<section class=cards>{''.join(_cards(region, verdicts))}</section>" if not several else "",
        section(_heading(title, "weather and power"), f"<p class=meta>{prose(meta)}</p>", said),
        section(
            _heading(title, "limits"),
            tables_html((limits_table(region), "No limits were given (--limits FILE).")),
        )
        if not several or region["limits"]
        else "",
        section(
            _heading(title, "hours, rates, cycles"),
            tables_html(
                (year_table(region), ""),
                (regimes_table(region), "All of the year is of one kind, operation or standstill."),
                (excursions_table(region), ""),
                (rates_table(region), ""),
            ),
        ),
        section(
            _heading(title, "distributions"),
            figure_html(
                f"{short}joint",
                "Temperature and relative humidity",
                JOINT_CAPTION,
                lambda: figure_joint(region),
            ),
            figure_html(
                f"{short}duration",
                "Duration curves",
                DURATION_CAPTION.format(share=share_held([region])),
                lambda: figure_duration(region),
            ),
        ),
        section(_heading(title, "test profile"), *_profile(region, short)),
    ]


def _heading(title: str, words: str) -> str:
    """The heading of a region's section; a capital where no name stands before it."""
    return title + words if title else words[:1].upper() + words[1:]


def _cards(region: Mapping, verdicts: object) -> list[str]:
    year, cards = region["scopes"]["all"], []
    doubt = rests_on(verdicts)
    doubtful = f"<p class=verdict>{mark_html(REJECT)} {prose(sentence(doubt))}</p>" if doubt else ""
    kind = f" {REJECT} resting" if doubt else ""
    part = part_of_year(region)
    scaled = f", scaled up from {part}" if part else ""
    verdicts = [one["verdict"] for one in region["limits"]]
    if verdicts:
        worst = next(v for v in ("fail", "undecided", "pass") if v in verdicts)
        counted = ", ".join(
            f"{verdicts.count(v)} {v}" for v in ("pass", "undecided", "fail") if v in verdicts
        )
        cards.append(
            f"<div class='card wide{'' if worst == 'pass' else ' open'}'><p class=label>Limits "
            f"<span>{len(verdicts)} asked{escape(_of_a_part(region))}</span></p><p class='value words'>{escape(counted)}</p></div>"
        )
    for name, label, note in (
        ("wetness_h", "Time of wetness", f"class {class_text(region)}, ISO 9223:1992"),
        ("condensation_h", "Condensation", "on the coldest surface"),
    ):
        if name in year:
            found = span_text(year[name], hours_text)
            value, _, rest = found.partition(" (")
            note += scaled
            share = share_held([region])
            bounds = f"{share} of single years: {rest.rstrip(')')}" if rest else "in every member and year"
            cards.append(
                f"<div class='card{kind}'><p class=label>{label} <span>{escape(note)}</span></p><p class=value>{escape(value)} h/a</p>"
                f"<p class=bounds>{escape(bounds)}</p>{doubtful}</div>"
            )
    return cards


def _of_a_part(region: Mapping) -> str:
    """What a verdict rests on, where that is less than a year."""
    part = part_of_year(region)
    return f", of {part} of weather, not a year" if part else ""


def _profile(region: Mapping, short: str) -> list[str]:
    profile = region["test_profile"]
    if profile is None:
        return ["<p class=left-out>There is none: see above.</p>"]
    close = profile["closeness"]
    years, hours = close["ageing"]["years"], len(profile["hour"])
    words = (
        f"{hours} hours that age as much as {plain_number(years)} years at the site "
        f"({plain_number(close['ageing']['years_lower'])} … {plain_number(close['ageing']['years_upper'])}), an acceleration "
        f"of {plain_number(profile['acceleration'])} before the chamber's limits; "
        f"{percent(profile['share_at_chamber_limit'])} of the hours stand at a limit of the chamber's temperature."
    )
    if not profile["reached"]:
        too_little = close["ageing"]["test_h"] < close["ageing"]["service_h"]
        words += (
            " The stated years of service are out of reach within these limits and this length: state "
            f"{'a longer test, fewer years, or a hotter chamber' if too_little else 'a shorter test, more years, or a colder chamber'}."
        )
    return [
        f"<p>{prose(words)}</p>",
        figure_html(f"{short}profile", "Test profile", PROFILE_CAPTION, lambda: figure_profile(region)),
        tables_html((profile_table(region), "")),
    ]


def _method(found: Mapping) -> str:
    law = found["plan"]["law"]
    kind = "Peck's law" if law["humidity_exponent"] else "Arrhenius' law"
    lines = [
        "Every member of the ensemble is the fitted model with parameters drawn from their estimated distribution, driven by "
        "the weather and the power alone, with disturbances simulated as the fit found them. Nothing was measured in these years.",
        "Bounds hold what the fit does not know of its own parameters, what the disturbances may do, and how years differ where "
        "there are several. They do not hold what the model leaves out: heaters and doors that no signal reports, moisture "
        "stored in materials and condensed water unless the model has them, another cabinet, another climate to come.",
        "Where the model has no condensation its air may be above saturation; such hours count as wet.",
        f"Ageing is {kind}, rate ∝ RH^{law['humidity_exponent']:g} exp(−{law['activation_energy_eV']:g} eV/kT), in hours at "
        f"{law['reference_degC']:g} °C and {law['reference_percent']:g} %. Its exponents are of single failure mechanisms "
        "(Peck 1986: aluminium corrosion in plastic packages); state those of yours.",
    ]
    return section("How this was made", *(f"<p>{prose(line)}</p>" for line in lines))
