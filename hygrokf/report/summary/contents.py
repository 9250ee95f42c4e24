"""Summaries of a fit, a discovery and a climate: one page for a reader who decides, with question, answer,
verdict, numbers, figure and actions. A summary prints on one sheet of A4."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from hygrokf.climate.limits import Exceedance
from hygrokf.climate.study import RegionClimate, Study, profile_files
from hygrokf.discovery.discovery_results import DiscoveryResults
from hygrokf.discovery.residuals import Residuals
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import inherited
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.report.blocks import (
    OF_RECORD,
    Banner,
    Card,
    Cards,
    Figure,
    Items,
    Page,
    Prose,
    Table,
    present,
    section,
    unmeasured,
)
from hygrokf.report.climate_page import LIMIT_TONES, OF_CLIMATE, doubt_text, weather_text
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
from hygrokf.report.discovery_page import gains_table, spans_text
from hygrokf.report.discovery_text import discovery_verdict
from hygrokf.report.figures.climate_figures import short_words
from hygrokf.report.figures.drawing import WIDTH_IN, NothingToShow
from hygrokf.report.figures.lead import lead_of_climate, lead_of_discovery, lead_of_fit
from hygrokf.report.fit_page import fit_period
from hygrokf.report.fit_text import judgements
from hygrokf.report.quantities import quantity, versions
from hygrokf.texts.parts import BOTH_PARTS, PARTS, SCORED
from hygrokf.texts.reasons import BELIEVE, CAUTION, REJECT, VERDICTS, WORDS, Kind, Reason, ReasonCode
from hygrokf.texts.statement import listed
from hygrokf.texts.wording import NONE, one_line, sentence

MOST_ROWS, MOST_ACTIONS = 12, 8
"""Largest numbers of table rows and of actions on the page."""
TODO = "What to do"
Tone: TypeAlias = Literal["plain", "open", "reject"]
"""How an answer without a verdict is shown: as it is, as a warning, as a refusal."""


@dataclass(frozen=True)
class Summary:
    """The content of a summary.

    `kind`: sort of result. `name`: of the record or model. `question`, `answer` and the `verdict` on the
    answer's numbers ("": none, then the `tone` decides how the answer is shown); `reasons` in sentences.
    `bounds`: table of the numbers behind the answer. `picture`: None if there is nothing to draw. `actions`:
    what to do. `foot`: record, period, version. `banners`: what was not measured.
    """

    kind: str
    name: str
    question: str
    answer: str
    verdict: Kind | Literal[""]
    reasons: tuple[str, ...]
    bounds: Table
    picture: Figure | None
    actions: tuple[str, ...]
    foot: tuple[tuple[str, str], ...]
    tone: Tone = "plain"
    banners: tuple[Banner, ...] = ()


def named(text: str, placeholder: str = "unnamed record") -> str:
    """Return a name on one line; `placeholder` for an empty name."""
    return one_line(text).strip() or placeholder


def foot_line(term: str, text: str) -> tuple[tuple[str, str], ...]:
    """Return a line of the foot, as a tuple of one (term, text); empty for an empty text."""
    return ((term, text),) if text else ()


def first_rows(table: Table) -> Table:
    """Return the first `MOST_ROWS` rows of a table; its note then says how many were left out."""
    omitted = len(table.rows) - MOST_ROWS
    if omitted <= 0:
        return table
    note = f"{table.note} {omitted} more rows: see the report.".strip()
    return replace(table, rows=table.rows[:MOST_ROWS], note=note)


def first_actions(actions: Sequence[str]) -> tuple[str, ...]:
    """Return the first `MOST_ACTIONS` actions, and a line that says how many were left out."""
    omitted = len(actions) - MOST_ACTIONS
    return (*actions[:MOST_ACTIONS], *([f"{omitted} more: see the report."] if omitted > 0 else []))


def picture_or_none(make: Callable[[], Figure]) -> Figure | None:
    """Return the figure that `make` returns; None if its data are missing."""
    try:
        picture = make()
        picture.draw()
        return picture
    except NothingToShow:
        return None


LACKING = "Run “hygrokf discover” on the record: the model lacks something that the readings show."
REASON_REMEDIES = {
    "Settle the doubts about the record first: “hygrokf check” lists them.": (ReasonCode.RECORD_DOUBTED,),
    "Compare the humidity sensor with a second one.": (ReasonCode.SENSOR_OR_WATER,),
    "Run “hygrokf fit” again with more starts (--starts): the estimation has not ended.": (
        ReasonCode.NOT_CONVERGED,
        ReasonCode.CONVERGENCE_UNKNOWN,
    ),
    "Give the likelihood a smaller tolerance: the filter's steps are too long here.": (ReasonCode.NOT_EXACT,),
    LACKING: (
        ReasonCode.CRITERIA_DISAGREE,
        ReasonCode.WORSE_THAN_MEAN,
        ReasonCode.WORSE_THAN_RULE,
        ReasonCode.BAND_FAILED,
        ReasonCode.INNOVATIONS_CORRELATED,
        ReasonCode.NOISE_NOT_AS_MODELLED,
        ReasonCode.SENSOR_STRETCHED,
        ReasonCode.FORMS_DIFFER,
        ReasonCode.PARTS_DIFFER,
    ),
    "Record for longer, with changes of load and standstills: this record hardly determines the number.": (
        ReasonCode.AT_LIMIT,
        ReasonCode.NOT_IDENTIFIABLE,
        ReasonCode.ONE_SIDED,
        ReasonCode.UNDETERMINED,
        ReasonCode.IMPRECISE,
        ReasonCode.FREE_RUN_SILENT,
        ReasonCode.FEW_READINGS,
        ReasonCode.INPUT_NOT_NEEDED,
        ReasonCode.RECORD_SHORT,
        ReasonCode.GUARD_REACHED,
    ),
    "Log the cabinet at shorter steps.": (ReasonCode.READINGS_COARSE,),
    "Take the weather from a source with shorter steps.": (ReasonCode.AMBIENT_COARSE,),
}
"""Action → codes of the reasons against a time constant (`identification.verdict`) that call for it, in the
order in which the actions are listed on the page."""


def remedies(reasons: Iterable[Reason]) -> tuple[str, ...]:
    """Return the actions that the given reasons call for, each action once."""
    codes = {reason.code for reason in reasons}
    return tuple(
        action for action, reason_codes in REASON_REMEDIES.items() if codes.intersection(reason_codes)
    )


def summary_blocks(summary: Summary) -> Page:
    """Return the page of a summary: answer, numbers, figure, then actions; it prints on one sheet of A4."""
    card = Card(
        summary.question, summary.answer, summary.verdict, lines=summary.reasons, wide=True,
        words=True, tone=summary.tone,
    )  # fmt: skip
    picture = summary.picture
    letter_pt, height_in = page_layout(summary)
    return Page(
        summary.kind,
        summary.name,
        (),
        present(
            *summary.banners,
            Cards((card,)),
            replace(summary.bounds, heading=""),
            None
            if picture is None
            else replace(picture, draw=lambda: replace(picture.draw(), height_in=height_in)),
        ),
        section(TODO, Items(summary.actions)),
        tuple(Prose(f"{term}: {text}") for term, text in summary.foot),
        sheet=letter_pt,
    )


LETTERS_PT = (10.0, 9.5, 9.0, 8.5, 8.0, 7.5, 7.0, 6.5, 6.0, 5.5, 5.0, 4.5, 4.0)
"""[pt] sizes of letters; the largest one that leaves room for the picture is taken."""
WIDTH_PT, HEIGHT_PT = 487.6, 728.0
"""[pt] what the margins in `page.css` leave of A4; of the height two lines are kept free."""
LETTER_EM, LEADING_EM, GAPS_EM = 0.545, 1.45, 11.0
"""[1] average width of a letter, height of a line, and all spaces between the parts of the page, in sizes of
the letters."""
LEAST_SHARE, MOST_SHARE, ALWAYS_ALLOWED_IN = 0.9, 1.5, 3.4
"""[1] limits of the picture's height relative to its height in a report; a height of `ALWAYS_ALLOWED_IN` [in]
is allowed even above the upper limit."""


def page_layout(summary: Summary) -> tuple[float, float]:
    """Size of the letters [pt] with which the summary fits on one sheet, and height of its figure [in]."""
    usual_height_in = 0.0 if summary.picture is None else summary.picture.draw().height_in
    letter_pt, free_height_in = 0.0, 0.0
    for letter_pt in LETTERS_PT:
        free_height_in = (HEIGHT_PT - text_pt(summary, letter_pt)) / WIDTH_PT * WIDTH_IN
        if free_height_in >= LEAST_SHARE * usual_height_in:
            break
    return letter_pt, max(
        LEAST_SHARE * usual_height_in,
        min(free_height_in, max(MOST_SHARE * usual_height_in, ALWAYS_ALLOWED_IN)),
    )


def text_pt(summary: Summary, letter_pt: float) -> float:
    """Estimate the height [pt] of all texts of a summary in letters of `letter_pt` [pt]."""
    picture = summary.picture
    picture_texts = () if picture is None else ((1.05, picture.heading), (0.85, picture.caption))
    texts = (
        (0.85, summary.kind), (2.1, summary.name), *((1.2, banner.text) for banner in summary.banners),
        (1.15, summary.question),
        (1.55, summary.answer), (1.2, summary.verdict), *((1.1, text) for text in summary.reasons),
        (0.85, summary.bounds.note), *picture_texts, (1.3, TODO), *((1.15, text) for text in summary.actions),
        *((0.75, f"{term}: {text}") for term, text in summary.foot),
    )  # fmt: skip
    lines = sum(
        relative_size * math.ceil(len(text) / chars_per_line(relative_size * letter_pt))
        for relative_size, text in texts
    )
    return ((lines + _rows_em(summary.bounds, letter_pt)) * LEADING_EM + GAPS_EM) * letter_pt


def chars_per_line(letter_pt: float) -> float:
    """Return the number of characters that fit into one line in letters of `letter_pt` [pt]."""
    return WIDTH_PT / (LETTER_EM * letter_pt)


def _rows_em(table: Table, letter_pt: float) -> float:
    """Estimate the height of a table in lines of the page; only cells with words wrap."""
    if not table:
        return 0.0
    line_chars = chars_per_line(TABLE_LETTER * letter_pt)
    widths = [max(len(text) + CELL_GAP for text in column) for column in zip(*table.rows, strict=True)]
    head_widths = [len(text) + CELL_GAP for text in table.columns]
    head_lines = 1
    if sum(map(max, zip(head_widths, widths, strict=True))) > line_chars:
        head_lines = max(math.ceil(head / width) for head, width in zip(head_widths, widths, strict=True))
    word_chars = sum(widths[column] for column in table.left)
    # how often the columns of words exceed the width that the columns of numbers leave
    wrap_factor = word_chars / max(line_chars - sum(widths) + word_chars, LEAST_WORD_CHARS)
    fullest = (
        max((len(row[column]) + CELL_GAP) / widths[column] for column in table.left) for row in table.rows
    )
    row_lines = (head_lines, *(math.ceil(wrap_factor * fullness) for fullness in fullest))
    return sum(ROW_PADDING + TABLE_LETTER * lines for lines in row_lines)


TABLE_LETTER, ROW_PADDING = 0.95, 0.35
"""[1] size of a table's letters relative to those of the page, and space between two rows in lines."""
CELL_GAP, LEAST_WORD_CHARS = 3, 8.0
"""[1] space between two columns, and least width of all columns of words together, in characters."""


def summary_of_fit(fit: FitResults, series: Mapping[str, np.ndarray]) -> Summary:
    """Return the summary of a fit: the time constants with their verdicts, and the errors of the free run.

    series: the arrays of `series.npz`.
    """
    constants = inherited(fit)
    parts = [name for name in PARTS if name in constants]
    quantities = " and ".join(QUANTITIES_OF[name] for name in parts) or "the air"
    not_reliable = [name for name in parts if constants[name].verdict != BELIEVE]
    return Summary(
        "Summary of an identification",
        named(fit.name),
        f"How fast do {quantities} in the cabinet follow the weather and the operation?"
        if len(parts) > 1
        else f"How fast does {quantities} in the cabinet follow the weather and the operation?",
        " ".join(f"{judgement.head}." for judgement in judgements(fit) if judgement.about in parts)
        or "This record determines no time constant.",
        max((constants[name].verdict for name in parts), key=VERDICTS.index, default=REJECT),
        tuple(sentence(f"{name} time constant, {constants[name].sentence}") for name in not_reliable),
        _constants(fit),
        picture_or_none(lambda: lead_of_fit(series)),
        (
            *_uses(constants),
            *remedies(reason for constant in constants.values() for reason in constant.reasons),
        ),
        (
            ("Record", named(fit.name)),
            *foot_line("Period", fit_period(fit)),
            ("Made by", versions(fit.version)),
        ),
        banners=unmeasured(fit.provenance, OF_RECORD),
    )


QUANTITIES_OF = {part.name: f"the {part.output}" for part in BOTH_PARTS}


def _uses(constants: Mapping[str, Inherited]) -> tuple[str, ...]:
    """Return sentences on what the time constants may be used for, grouped by verdict."""
    sentences = []
    for verdict in VERDICTS:
        names = [name for name, constant in constants.items() if constant.verdict == verdict]
        if not names:
            continue
        plural, its, them = ("s", "their", "them") if len(names) > 1 else ("", "its", "it")
        permission = {
            BELIEVE: f"can be used with {its} bounds: in simulations, forecasts and the climate of a site",
            CAUTION: f"can be used if {its} bounds and the doubts above are stated with {them}",
            REJECT: f"must not be used, nor what rests on {them}",
        }[verdict]
        sentences.append(f"The {' and '.join(names)} time constant{plural} {permission}.")
    return tuple(sentences)


def _constants(fit: FitResults) -> Table:
    """Return the table of the time constants and of the free run's errors."""
    rows = []
    for name, constant in inherited(fit).items():
        value, bounds = constant.texts
        rows.append(
            (f"{name} time constant", value, f"{bounds} h" if constant.closed else NONE, constant.words)
        )
    verdicts = {judgement.about: judgement.verdict for judgement in judgements(fit)}
    for name in SCORED:
        on_new_data, on_fitted_data = (
            fit.errors(period, name).total for period in ("validation", "identification")
        )
        if name not in verdicts or (math.isnan(on_new_data) and math.isnan(on_fitted_data)):
            continue
        if math.isnan(on_new_data):
            error, readings = on_fitted_data, "on the data of the fit"
        else:
            error, readings = on_new_data, "on new data"
        label = f"error of the simulated {quantity(name).words}, {readings}"
        rows.append((label, quantity(name).with_unit(error), "", WORDS[verdicts[name]]))
    return Table(
        "Key figures",
        ("", "value", "95 % bounds", "verdict"),
        tuple(rows),
        left=(0, 3),
        note="A time constant is the time in which 63 % of a lasting change outside reach the cabinet.",
    )


def summary_of_discovery(
    results: DiscoveryResults, before: Residuals | None, after: Residuals | None
) -> Summary:
    """Return the summary of a discovery: the named cause with its confidence and its gain, or that none is
    named.

    before, after: residuals of the base and the extended model.
    """
    verdict = discovery_verdict(results)
    return Summary(
        "Summary of a discovery",
        named(results.name),
        "What does the model of this cabinet lack?",
        f"{', '.join(filter(None, (verdict.headline, verdict.confidence)))}.",
        "",
        tuple(map(sentence, verdict.reasons)),
        gains_table(results),
        picture_or_none(lambda: lead_of_discovery(results, before, after)),
        tuple(map(sentence, verdict.actions or _otherwise(results))),
        (
            ("Record", named(results.name)),
            *foot_line("Period", " ".join(spans_text(before))),
            ("Made by", versions(results.version)),
        ),
        "open" if verdict.warned else "plain",
        unmeasured(results.provenance, OF_RECORD),
    )


def _otherwise(results: DiscoveryResults) -> tuple[str, ...]:
    """The actions if the discovery itself states none."""
    if results.causes:
        return ("use the extended model, fit.json beside the discovery, in the place of the base model",)
    against = [reason for constant in inherited(results.baseline.fit).values() for reason in constant.reasons]
    return ("do not rely on the base model", *(remedy for remedy in remedies(against) if remedy != LACKING))


def summary_of_climate(study: Study) -> Summary:
    """Return the summary of a climate: whether the limits are kept; without limits, the hours of wetness."""
    regions = study.regions
    several = len(regions) > 1
    doubt = doubt_text(study)
    limited = any(region.limits for region in regions)
    worst = next(
        (verdict for verdict in WORST_FIRST if verdict in {region.verdict for region in regions}), ""
    )
    name = regions[0].name.strip()
    single_place = f"at “{name}”" if name != "site" else "at the site"  # --weather states no name
    places = f"in {len(regions)} regions" if several else single_place
    return Summary(
        "Summary of a climate",
        named(study.name, "unnamed model"),
        f"Does the climate in the cabinet keep the limits {places}?"
        if limited
        else f"What is the climate in the cabinet {places}?",
        _answer_of_regions(regions) if several else _answer(regions[0]),
        REJECT if doubt else "",
        tuple(text for text in (doubt, *_conditions(study)) if text),
        first_rows(_numbers(study)),
        picture_or_none(lambda: lead_of_climate(study)),
        first_actions(_actions(study, doubt)),
        (
            ("Model", named(study.name, "unnamed model")),
            *(("Weather", weather_text(region).removeprefix("Weather ")) for region in regions[:3]),
            ("Ensemble", f"{study.members} members, seed {study.seed}"),
            ("Made by", versions(study.version)),
        ),
        LIMIT_TONES.get(worst, "plain"),
        unmeasured(study.least_measured, OF_CLIMATE),
    )


def _answer(region: RegionClimate) -> str:
    """Whether a region keeps its limits; without limits, its hours of wetness or its mean temperature."""
    if region.limits:
        return _limits_text(region.limits)
    numbers = [
        f"{label} {span_text(region.year[name], hours_text)} h a year"
        for name, label in (("wetness_h", "wet for"), ("condensation_h", "condensation for"))
        if name in region.year
    ]
    if not numbers:
        numbers = [f"{span_text(region.year['mean_temperature_degC'])} °C on average"]
    return sentence(", ".join(numbers))


def _answer_of_regions(regions: Sequence[RegionClimate]) -> str:
    """In which regions the limits are kept; without limits, the least and the most wetness."""
    if any(region.limits for region in regions):
        parts = []
        for verdict, label in VERDICTS_IN_WORDS.items():
            names = [region.name for region in regions if region.verdict == verdict]
            if names:
                names_text = listed(names, "and") if len(names) <= MOST_NAMES else f"{len(names)} regions"
                parts.append(f"{label} in {names_text}")
        return f"The limits are {listed(parts, 'and')}."
    statistic, label, unit = ("wetness_h", "Wet for", "h a year")
    if not all(statistic in region.year for region in regions):
        statistic, label, unit = ("mean_temperature_degC", "On average", "°C")
    text = number_text(statistic)
    lowest, *_, highest = sorted(regions, key=lambda region: region.year[statistic].value)
    low, high = (
        f"{text(region.year[statistic].value)} {unit} ({region.name})" for region in (lowest, highest)
    )
    return f"{label} {low} to {high}."


WORST_FIRST = ("fail", "undecided", "pass")
VERDICTS_IN_WORDS = {"pass": "kept", "fail": "exceeded", "undecided": "undecided"}
MOST_NAMES = 4
"""Most regions whose names are listed; for more regions only their number is given."""


def _limits_text(limits: tuple[Exceedance, ...]) -> str:
    """Return how many limits are kept and exceeded ("Limits: 2 kept and 1 exceeded.")."""
    verdicts = [limit.verdict for limit in limits]
    parts = [
        f"{verdicts.count(verdict)} {word}"
        for verdict, word in VERDICTS_IN_WORDS.items()
        if verdict in verdicts
    ]
    return f"Limits: {listed(parts, 'and')}."


def _conditions(study: Study) -> tuple[str, ...]:
    """Return sentences on the share of years inside the bounds, and on weather of less than a year."""
    parts = {region.part_of_year.text for region in study.regions if region.part_of_year}
    bounds_statement = f"The bounds hold {share_held(study.regions)} of single years."
    return (bounds_statement, *(f"Judged on {part} of weather, not on a year." for part in sorted(parts)))


def _numbers(study: Study) -> Table:
    """Return the table of key figures: limits of a single region, else the compared statistics."""
    regions = study.regions
    chosen = compared_statistics(regions)
    if len(regions) > MOST_NAMES:
        titles = (f"{short_words(statistic)} [{statistic.unit}]" for statistic in chosen)
        texts = (
            (span_text(region.year[statistic.name], number_text(statistic.name)) for statistic in chosen)
            for region in regions
        )
        rows_by_region = tuple((region.name, *row) for region, row in zip(regions, texts, strict=True))
        return Table("Key figures", ("", *titles), rows_by_region)
    if (several := regions_table(regions)) is not None:
        return several
    if regions[0].limits:
        worst_first = sorted(regions[0].limits, key=lambda limit: WORST_FIRST.index(limit.verdict))
        table = limits_table(replace(regions[0], limits=tuple(worst_first)))
        kept = table.brief
        heads = tuple(table.columns[column] for column in kept)
        cells = tuple(tuple(row[column] for column in kept) for row in table.rows)
        return Table("Key figures", heads, cells, left=(0, 1, len(kept) - 1))
    rows = []
    for statistic in chosen:
        text = number_text(statistic.name)
        outside = regions[0].outside
        weather = text(outside[statistic.name]) if statistic.weather and statistic.name in outside else NONE
        value, bounds = value_and_bounds(regions[0].year[statistic.name], text)
        rows.append((statistic.words, statistic.unit, value, bounds or NONE, weather))
    return Table("Key figures", ("", "unit", "cabinet", "bounds", "outside"), tuple(rows), left=(0, 1))


def _actions(study: Study, doubt: str) -> list[str]:
    """The actions that follow from doubts about the model, from the limits, and from the test profiles."""
    several = len(study.regions) > 1
    profiles = list(profile_files(study))
    actions = ["Do not use this climate before the model is reliable."] if doubt else []
    actions += [text for region in study.regions for text in _limit_actions(region, several)]
    if profiles:
        name = listed(profiles, "and") if len(profiles) <= MOST_NAMES else "the files test_profile_….csv"
        actions.append(f"For a test in a chamber use {name}.")
    return actions or ["No limits were given (--limits FILE): nothing was judged."]


def _limit_actions(region: RegionClimate, several: bool) -> list[str]:
    """Return the actions that follow from the verdicts on a region's limits."""
    prefix = f"{region.name}: " if several else ""
    actions = []
    for limit in sorted(region.limits, key=lambda limit: WORST_FIRST.index(limit.verdict)):
        hours = f"{span_text(limit.hours, hours_text)} h a year, {hours_text(limit.hours_a_year)} h allowed"
        if limit.verdict == "fail":
            actions.append(f"{prefix}Act on the limit “{limit.name.strip()}”: exceeded for {hours}.")
        elif limit.verdict == "undecided":
            reason = limit.why or "the allowed hours lie between the bounds"
            actions.append(
                f"{prefix}Do not decide on the limit “{limit.name.strip()}” yet: {hours} ({reason})."
            )
    if region.limits and not actions:
        actions.append(f"{prefix}The limits are kept, also at the upper bounds: no measure is needed.")
    return actions
