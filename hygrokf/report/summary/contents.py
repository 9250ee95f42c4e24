"""The summaries of a fit, of a discovery and of a climate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hygrokf.climate.limits import Exceedance
from hygrokf.climate.study import RegionClimate, Study, profile_files
from hygrokf.discovery.discovery_results import DiscoveryResults
from hygrokf.discovery.residuals import Residuals
from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import inherited, verdicts
from hygrokf.identification.verdict_terms import BELIEVE, CAUTION, REJECT, VERDICTS, WORDS, Verdict
from hygrokf.identification.wording import NONE, QUANTITIES, fixed, sentence
from hygrokf.modelling.design import PARTS
from hygrokf.report.blocks import SYNTHETIC_PAGE, Table
from hygrokf.report.climate_page import SYNTHETIC_CLIMATE, TONES, doubt_text, weather_text
from hygrokf.report.climate_tables import (
    compared_statistics,
    hours_text,
    limits_table,
    number_text,
    regions_table,
    share_held,
    span_text,
    value_and_bounds,
)
from hygrokf.report.discovery_page import spans_text
from hygrokf.report.discovery_tables import gains_table
from hygrokf.report.discovery_text import actions, headline, listed, named_alone, reasons, warned
from hygrokf.report.figures.climate import short_words
from hygrokf.report.figures.lead import lead_of_climate, lead_of_discovery, lead_of_fit
from hygrokf.report.fit_page import period_text
from hygrokf.report.fit_text import head, judgements, time_constant
from hygrokf.report.summary.page import (
    LACKING,
    Summary,
    drawable,
    first_actions,
    first_rows,
    known,
    made_by,
    named,
    remedies,
)


def summary_of_fit(fit: FitResults, series: Mapping[str, np.ndarray]) -> Summary:
    """How fast the cabinet follows: both time constants with verdicts, and the errors of the free run.

    series: the arrays of `series.npz`.
    """
    found = verdicts(fit)
    parts = [name for name in PARTS if name in found]
    quantities = " and ".join(QUANTITIES_OF[name] for name in parts) or "the air"
    doubted = [name for name in parts if found[name].verdict != BELIEVE]
    return Summary(
        "Summary of an identification",
        named(fit.name),
        f"How fast do {quantities} in the cabinet follow the weather and the operation?"
        if len(parts) > 1
        else f"How fast does {quantities} in the cabinet follow the weather and the operation?",
        " ".join(f"{head(fit, name).rstrip(':.')}." for name in parts)
        or "This record determines no time constant.",
        max((found[name].verdict for name in parts), key=VERDICTS.index, default=REJECT),
        tuple(sentence(f"{name} time constant, {found[name].sentence}") for name in doubted),
        _constants(fit, parts),
        drawable(lambda: lead_of_fit(series)),
        (*_uses(found), *remedies(reason for one in found.values() for reason in one.reasons)),
        (
            ("Record", named(fit.name)),
            *known("Period", period_text(fit)),
            made_by(fit.version),
        ),
        synthetic=SYNTHETIC_PAGE if fit.synthetic else "",
    )


QUANTITIES_OF = {"thermal": "the temperature", "hygric": "the humidity"}


def _uses(found: Mapping[str, Verdict]) -> tuple[str, ...]:
    """Which time constants may be used."""
    said = []
    for kind in VERDICTS:
        names = [name for name, one in found.items() if one.verdict == kind]
        if not names:
            continue
        end, its, them = ("s", "their", "them") if len(names) > 1 else ("", "its", "it")
        how = {
            BELIEVE: f"can be used with {its} bounds: in simulations, forecasts and the climate of a site",
            CAUTION: f"can be used if {its} bounds and the doubts above are stated with {them}",
            REJECT: f"must not be used, nor what rests on {them}",
        }[kind]
        said.append(f"The {' and '.join(names)} time constant{end} {how}.")
    return tuple(said)


def _constants(fit: FitResults, parts: list[str]) -> Table:
    """The time constants, then the errors of the free run."""
    rows = []
    for name in parts:
        one = time_constant(fit, name)
        bounds = f"{one.bounds.split(',')[0]} h" if one.closed else NONE
        rows.append((f"{name} time constant", one.value, bounds, one.verdict.words))
    kinds = {one.about: one.kind for one in judgements(fit)}
    for quantity in SCORED:
        late, early = (fit.errors(period, quantity).total for period in ("validation", "identification"))
        if quantity in kinds and (late == late or early == early):
            name, unit = QUANTITIES[quantity]
            error, where = (late, "on new data") if late == late else (early, "on the data of the fit")
            words = f"error of the simulated {name}, {where}"
            rows.append((words, f"{fixed(error)} {unit}", "", WORDS[kinds[quantity]]))
    return Table(
        "The numbers",
        ("", "value", "95 % bounds", "verdict"),
        tuple(rows),
        left=(0, 3),
        note="A time constant is the time in which 63 % of a lasting change outside reach the cabinet.",
    )


def summary_of_discovery(
    found: DiscoveryResults, before: Residuals | None, after: Residuals | None
) -> Summary:
    """What the model lacks: the cause with its confidence and gain, or that none is named.

    before, after: residuals of the base and of the extended model.
    """
    return Summary(
        "Summary of a discovery",
        named(found.name),
        "What does the model of this cabinet lack?",
        f"{headline(found)}{named_alone(found)}.",
        "",
        tuple(map(sentence, reasons(found))),
        gains_table(found),
        drawable(lambda: lead_of_discovery(found, before, after)),
        tuple(map(sentence, actions(found) or _otherwise(found))),
        (
            ("Record", named(found.name)),
            *known("Period", " ".join(spans_text(before))),
            made_by(found.version),
        ),
        "open" if warned(found) else "plain",
        SYNTHETIC_PAGE if found.synthetic else "",
    )


def _otherwise(found: DiscoveryResults) -> tuple[str, ...]:
    """What to do where the discovery states nothing: after a cause without a check, or a base model that is
    wrong although no cause was found."""
    if found.causes:
        return ("use the extended model, fit.json beside the discovery, in the place of the base model",)
    against = [reason for one in inherited(found.baseline.fit).values() for reason in one.reasons]
    return ("do not rely on the base model", *(one for one in remedies(against) if one != LACKING))


def summary_of_climate(study: Study) -> Summary:
    """The climate in the cabinet: limits kept or not, else hours of wetness; several regions beside each
    other."""
    regions = study.regions
    several = len(regions) > 1
    doubt = doubt_text(study)
    limited = any(one.limits for one in regions)
    worst = next((v for v in WORST_FIRST if v in {one.verdict for one in regions}), "")
    place = regions[0].name.strip()
    alone = f"at “{place}”" if place != "site" else "at the site"  # --weather states no name
    where = f"in {len(regions)} regions" if several else alone
    made_up = study.synthetic or any(one.synthetic for one in regions)
    return Summary(
        "Summary of a climate",
        named(study.name, "unnamed model"),
        f"Does the climate in the cabinet keep the limits {where}?"
        if limited
        else f"What is the climate in the cabinet {where}?",
        _answer_of_regions(regions) if several else _answer(regions[0]),
        REJECT if doubt else "",
        tuple(text for text in (doubt, *_conditions(study)) if text),
        first_rows(_numbers(study)),
        drawable(lambda: lead_of_climate(study)),
        first_actions(_actions(study, doubt)),
        (
            ("Model", named(study.name, "unnamed model")),
            *(("Weather", weather_text(one).removeprefix("Weather ")) for one in regions[:3]),
            ("Ensemble", f"{study.members} members, seed {study.seed}"),
            made_by(study.version),
        ),
        TONES.get(worst, "plain"),
        SYNTHETIC_CLIMATE if made_up else "",
    )


def _answer(region: RegionClimate) -> str:
    """The limits in words, else hours of wetness and of condensation, else the mean temperature."""
    if region.limits:
        return _limits_text(region.limits)
    numbers = [
        f"{words} {span_text(region.year[name], hours_text)} h a year"
        for name, words in (("wetness_h", "wet for"), ("condensation_h", "condensation for"))
        if name in region.year
    ]
    if not numbers:
        numbers = [f"{span_text(region.year['mean_temperature_degC'])} °C on average"]
    return sentence(", ".join(numbers))


def _answer_of_regions(regions: Sequence[RegionClimate]) -> str:
    """Where the limits are kept, else the regions with the least and the most hours of wetness."""
    if any(one.limits for one in regions):
        parts = []
        for verdict, words in VERDICTS_IN_WORDS.items():
            there = [one.name for one in regions if one.verdict == verdict]
            if there:
                place = listed(there) if len(there) <= MOST_NAMES else f"{len(there)} regions"
                parts.append(f"{words} in {place}")
        return f"The limits are {listed(parts)}."
    name, words, unit = ("wetness_h", "Wet for", "h a year")
    if not all(name in one.year for one in regions):
        name, words, unit = ("mean_temperature_degC", "On average", "°C")
    text = number_text(name)
    least, *_, most = sorted(regions, key=lambda one: one.year[name].value)
    low, high = (f"{text(one.year[name].value)} {unit} ({one.name})" for one in (least, most))
    return f"{words} {low} to {high}."


WORST_FIRST = ("fail", "undecided", "pass")
VERDICTS_IN_WORDS = {"pass": "kept", "fail": "exceeded", "undecided": "undecided"}
MOST_NAMES = 4
"""Regions that are named; of more the number is given."""


def _limits_text(limits: tuple[Exceedance, ...]) -> str:
    """How many limits are kept: "Of 3 limits 2 are kept and 1 is exceeded." """
    found: list[str] = [one.verdict for one in limits]
    if set(found) == {"undecided"}:
        return "Undecided: this climate does not show whether the limits are kept."
    if len(set(found)) == 1 and len(found) > 1:
        all_of_them = "Both limits" if len(found) == 2 else f"All {len(found)} limits"
        return f"{all_of_them} are {VERDICTS_IN_WORDS[found[0]]}."
    parts = []
    for kind, words in VERDICTS_IN_WORDS.items():
        if count := found.count(kind):
            parts.append(f"{count} {'is' if count == 1 else 'are'} {words}")
    if len(found) == 1:
        return f"The limit {parts[0][2:]}."
    return f"Of {len(found)} limits {listed(parts)}."


def _conditions(study: Study) -> tuple[str, ...]:
    """On what the answer rests: the share of years that the bounds hold, and how much weather there was."""
    parts = {one.part_of_year for one in study.regions if one.part_of_year}
    said = f"The bounds hold {share_held(study.regions)} of single years."
    return (said, *(f"Judged on {part} of weather, not on a year." for part in sorted(parts)))


def _numbers(study: Study) -> Table:
    """The limits of a single region, else the numbers by which regions are compared."""
    regions = study.regions
    chosen = compared_statistics(regions)
    if len(regions) > MOST_NAMES:
        heads = (f"{short_words(one)} [{one.unit}]" for one in chosen)
        cells = ((span_text(one.year[s.name], number_text(s.name)) for s in chosen) for one in regions)
        many = tuple((one.name, *row) for one, row in zip(regions, cells, strict=True))
        return Table("The numbers", ("", *heads), many)
    if (several := regions_table(regions)) is not None:
        return several
    if regions[0].limits:
        worst_first = sorted(regions[0].limits, key=lambda one: WORST_FIRST.index(one.verdict))
        table = limits_table(replace(regions[0], limits=tuple(worst_first)))
        kept = table.brief
        found = tuple(tuple(row[i] for i in kept) for row in table.rows)
        return Table("The numbers", tuple(table.columns[i] for i in kept), found, left=(0, 1, len(kept) - 1))
    rows = []
    for one in chosen:
        text = number_text(one.name)
        outside = regions[0].outside
        weather = text(outside[one.name]) if one.weather and one.name in outside else NONE
        value, bounds = value_and_bounds(regions[0].year[one.name], text)
        rows.append((one.words, one.unit, value, bounds or NONE, weather))
    return Table("The numbers", ("", "unit", "cabinet", "bounds", "outside"), tuple(rows), left=(0, 1))


def _actions(study: Study, doubt: str) -> list[str]:
    """What doubts about the model, the limits and the test profile ask for."""
    several = len(study.regions) > 1
    profiles = list(profile_files(study))
    said = ["Do not use this climate before the model is reliable."] if doubt else []
    said += [text for one in study.regions for text in _limit_actions(one, several)]
    if profiles:
        name = listed(profiles) if len(profiles) <= MOST_NAMES else "the files test_profile_….csv"
        said.append(f"For a test in a chamber use {name}.")
    return said or ["No limits were given (--limits FILE): nothing was judged."]


def _limit_actions(region: RegionClimate, several: bool) -> list[str]:
    """What the verdicts on the limits ask for."""
    place = f"{region.name}: " if several else ""
    said = []
    for one in sorted(region.limits, key=lambda one: WORST_FIRST.index(one.verdict)):
        hours = f"{span_text(one.hours, hours_text)} h a year, {hours_text(one.hours_a_year)} h allowed"
        if one.verdict == "fail":
            said.append(f"{place}Act on the limit “{one.name.strip()}”: exceeded for {hours}.")
        elif one.verdict == "undecided":
            why = one.why or "the allowed hours lie between the bounds"
            said.append(f"{place}Do not decide on the limit “{one.name.strip()}” yet: {hours} ({why}).")
    if region.limits and not said:
        said.append(f"{place}The limits are kept, also at the upper bounds: no measure is needed.")
    return said
