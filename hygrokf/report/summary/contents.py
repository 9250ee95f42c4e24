"""The summaries of a fit, of a discovery and of a climate, each a page for a reader who decides: question,
answer, verdict, bounds, picture, what to do; it prints on one sheet of A4."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from hygrokf.climate.limits import Exceedance
from hygrokf.climate.study import RegionClimate, Study, profile_files
from hygrokf.discovery.residuals import Residuals
from hygrokf.discovery.results import DiscoveryResults
from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import inherited
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.modelling.design import PARTS
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
from hygrokf.report.climate_page import OF_CLIMATE, TONES, doubt_text, weather_text
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
from hygrokf.report.discovery_text import verdict_of
from hygrokf.report.figures.climate import short_words
from hygrokf.report.figures.drawing import WIDTH_IN, NothingToShow
from hygrokf.report.figures.lead import lead_of_climate, lead_of_discovery, lead_of_fit
from hygrokf.report.fit_page import period_text
from hygrokf.report.fit_text import judgements
from hygrokf.report.quantities import quantity, versions
from hygrokf.texts.statement import listed
from hygrokf.texts.verdict import BELIEVE, CAUTION, REJECT, VERDICTS, WORDS, Kind, Reason, ReasonCode
from hygrokf.texts.wording import NONE, one_line, sentence

MOST_ROWS, MOST_ACTIONS = 12, 8
"""What one page can hold."""
TODO = "What to do"
Tone: TypeAlias = Literal["plain", "open", "reject"]
"""How an answer without a verdict is shown: as it is, as a warning, as a refusal."""


@dataclass(frozen=True)
class Summary:
    """A result for a manager.

    `kind` of result and `name`, whose it is.  `question` and `answer`, with the `verdict` on its numbers
    ("" without one, then with a `tone`) and the `reasons` in sentences; `bounds`: the numbers behind the
    answer.  `picture`: None where the result has nothing to draw.  `actions`: what to do.  `foot`: record,
    period, version.  `banners`: what was not measured.
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


def named(text: str, without: str = "unnamed record") -> str:
    """A name on one line; `without` one, what stands in its place."""
    return one_line(text).strip() or without


def known(term: str, text: str) -> tuple[tuple[str, str], ...]:
    """A line of the foot; none where its text is empty."""
    return ((term, text),) if text else ()


def first_rows(table: Table) -> Table:
    """A table of at most `MOST_ROWS` rows, whose note names the rest."""
    rest = len(table.rows) - MOST_ROWS
    if rest <= 0:
        return table
    note = f"{table.note} {rest} more rows: see the report.".strip()
    return replace(table, rows=table.rows[:MOST_ROWS], note=note)


def first_actions(actions: Sequence[str]) -> tuple[str, ...]:
    """At most `MOST_ACTIONS`, and how many more there are."""
    rest = len(actions) - MOST_ACTIONS
    return (*actions[:MOST_ACTIONS], *([f"{rest} more: see the report."] if rest > 0 else []))


def drawable(make: Callable[[], Figure]) -> Figure | None:
    """A picture; None where there is nothing to show."""
    try:
        picture = make()
        picture.draw()
        return picture
    except NothingToShow:
        return None


LACKING = "Run “hygrokf discover” on the record: the model lacks something that the readings show."
REMEDIES = {
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
"""What to do about the reasons against a time constant (`identification.verdict`), what comes first first:
the action, and the codes of the reasons that ask for it."""


def remedies(reasons: Iterable[Reason]) -> tuple[str, ...]:
    """What to do about reasons, each action once."""
    codes = {one.code for one in reasons}
    return tuple(action for action, asking in REMEDIES.items() if codes.intersection(asking))


def summary_blocks(summary: Summary) -> Page:
    """The answer to the question, its numbers and its picture, then what to do; prints on one page of A4."""
    card = Card(
        summary.question, summary.answer, summary.verdict, lines=summary.reasons, wide=True,
        words=True, tone=summary.tone,
    )  # fmt: skip
    picture = summary.picture
    size, height_in = fitted(summary)
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
        sheet=size,
    )


LETTERS_PT = (10.0, 9.5, 9.0, 8.5, 8.0, 7.5, 7.0, 6.5, 6.0, 5.5, 5.0, 4.5, 4.0)
"""[pt] sizes of letters; the largest one that leaves room for the picture is taken."""
WIDTH_PT, HEIGHT_PT = 487.6, 728.0
"""[pt] what the margins in `page.css` leave of A4; of the height two lines are kept free."""
LETTER_EM, LEADING_EM, GAPS_EM = 0.545, 1.45, 11.0
"""[1] average width of a letter, height of a line, and all spaces between the parts of the page, in sizes of
the letters."""
LEAST_SHARE, MOST_SHARE, MOST_IN = 0.9, 1.5, 3.4
"""[1] height of the picture against that in a report; every picture may be as high as `MOST_IN` [in]."""


def fitted(summary: Summary) -> tuple[float, float]:
    """Size of the letters [pt] with which the summary fits on its page, and height of its picture [in]."""
    wanted = 0.0 if summary.picture is None else summary.picture.draw().height_in
    size, room = 0.0, 0.0
    for size in LETTERS_PT:
        room = (HEIGHT_PT - text_pt(summary, size)) / WIDTH_PT * WIDTH_IN
        if room >= LEAST_SHARE * wanted:
            break
    return size, max(LEAST_SHARE * wanted, min(room, max(MOST_SHARE * wanted, MOST_IN)))


def text_pt(summary: Summary, size: float) -> float:
    """[pt] height of all texts in letters of `size` [pt], as far as the average width of a letter tells."""
    shown = summary.picture
    picture = () if shown is None else ((1.05, shown.heading), (0.85, shown.caption))
    texts = (
        (0.85, summary.kind), (2.1, summary.name), *((1.2, one.text) for one in summary.banners),
        (1.15, summary.question),
        (1.55, summary.answer), (1.2, summary.verdict), *((1.1, text) for text in summary.reasons),
        (0.85, summary.bounds.note), *picture, (1.3, TODO), *((1.15, text) for text in summary.actions),
        *((0.75, f"{term}: {text}") for term, text in summary.foot),
    )  # fmt: skip
    lines = sum(em * math.ceil(len(text) / letters_a_line(em * size)) for em, text in texts)
    return ((lines + _rows_em(summary.bounds, size)) * LEADING_EM + GAPS_EM) * size


def letters_a_line(size: float) -> float:
    """[1] letters of `size` [pt] side by side on the page."""
    return WIDTH_PT / (LETTER_EM * size)


def _rows_em(table: Table, size: float) -> float:
    """Height of a table in lines of the page [1]: numbers stay on one line, the words beside them wrap."""
    if not table:
        return 0.0
    letters = letters_a_line(0.95 * size)
    longest = [max(len(text) + 3 for text in column) for column in zip(*table.rows, strict=True)]
    heads = [(len(text) + 3, room) for text, room in zip(table.columns, longest, strict=True)]
    wrapped = sum(map(max, heads)) > letters
    head = max(math.ceil(wide / room) for wide, room in heads) if wrapped else 1
    words = sum(longest[i] for i in table.left)
    crowding = words / max(letters - sum(longest) + words, 8.0)
    fullest = (max((len(row[i]) + 3) / longest[i] for i in table.left) for row in table.rows)
    return sum(0.35 + 0.95 * lines for lines in (head, *(math.ceil(crowding * share) for share in fullest)))


def summary_of_fit(fit: FitResults, series: Mapping[str, np.ndarray]) -> Summary:
    """How fast the cabinet follows: both time constants with verdicts, and the errors of the free run.

    series: the arrays of `series.npz`.
    """
    found = inherited(fit)
    parts = [name for name in PARTS if name in found]
    quantities = " and ".join(QUANTITIES_OF[name] for name in parts) or "the air"
    doubted = [name for name in parts if found[name].verdict != BELIEVE]
    return Summary(
        "Summary of an identification",
        named(fit.name),
        f"How fast do {quantities} in the cabinet follow the weather and the operation?"
        if len(parts) > 1
        else f"How fast does {quantities} in the cabinet follow the weather and the operation?",
        " ".join(f"{one.head}." for one in judgements(fit) if one.about in parts)
        or "This record determines no time constant.",
        max((found[name].verdict for name in parts), key=VERDICTS.index, default=REJECT),
        tuple(sentence(f"{name} time constant, {found[name].sentence}") for name in doubted),
        _constants(fit),
        drawable(lambda: lead_of_fit(series)),
        (*_uses(found), *remedies(reason for one in found.values() for reason in one.reasons)),
        (
            ("Record", named(fit.name)),
            *known("Period", period_text(fit)),
            ("Made by", versions(fit.version)),
        ),
        banners=unmeasured(fit.provenance, OF_RECORD),
    )


QUANTITIES_OF = {"thermal": "the temperature", "hygric": "the humidity"}


def _uses(found: Mapping[str, Inherited]) -> tuple[str, ...]:
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


def _constants(fit: FitResults) -> Table:
    """The time constants, then the errors of the free run."""
    rows = []
    for name, one in inherited(fit).items():
        value, bounds = one.texts
        rows.append((f"{name} time constant", value, f"{bounds} h" if one.closed else NONE, one.words))
    kinds = {one.about: one.verdict for one in judgements(fit)}
    for name in SCORED:
        late, early = (fit.errors(period, name).total for period in ("validation", "identification"))
        if name in kinds and (late == late or early == early):
            error, where = (late, "on new data") if late == late else (early, "on the data of the fit")
            words = f"error of the simulated {quantity(name).words}, {where}"
            rows.append((words, quantity(name).with_unit(error), "", WORDS[kinds[name]]))
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
    verdict = verdict_of(found)
    return Summary(
        "Summary of a discovery",
        named(found.name),
        "What does the model of this cabinet lack?",
        f"{', '.join(filter(None, (verdict.headline, verdict.confidence)))}.",
        "",
        tuple(map(sentence, verdict.reasons)),
        gains_table(found),
        drawable(lambda: lead_of_discovery(found, before, after)),
        tuple(map(sentence, verdict.actions or _otherwise(found))),
        (
            ("Record", named(found.name)),
            *known("Period", " ".join(spans_text(before))),
            ("Made by", versions(found.version)),
        ),
        "open" if verdict.warned else "plain",
        unmeasured(found.provenance, OF_RECORD),
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
            ("Made by", versions(study.version)),
        ),
        TONES.get(worst, "plain"),
        unmeasured(study.least_measured, OF_CLIMATE),
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
                place = listed(there, "and") if len(there) <= MOST_NAMES else f"{len(there)} regions"
                parts.append(f"{words} in {place}")
        return f"The limits are {listed(parts, 'and')}."
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
    """How many limits are kept: "Limits: 2 kept and 1 exceeded." """
    found = [one.verdict for one in limits]
    parts = [f"{found.count(kind)} {words}" for kind, words in VERDICTS_IN_WORDS.items() if kind in found]
    return f"Limits: {listed(parts, 'and')}."


def _conditions(study: Study) -> tuple[str, ...]:
    """On what the answer rests: the share of years that the bounds hold, and how much weather there was."""
    parts = {one.part_of_year.text for one in study.regions if one.part_of_year}
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
        name = listed(profiles, "and") if len(profiles) <= MOST_NAMES else "the files test_profile_….csv"
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
