"""A summary as a page for a reader who decides: question, answer, verdict, bounds, picture, what to do; it
prints on one sheet of A4."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from hygrokf.identification.verdict_terms import Kind, Reason
from hygrokf.identification.wording import one_line
from hygrokf.report.blocks import Card, Cards, Figure, Items, Page, Prose, Table, present, section, synthetic
from hygrokf.report.figures.drawing import WIDTH_IN, NothingToShow
from hygrokf.version import __version__

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
    period, version.  `synthetic`: the sentence that nothing was measured, or empty.
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
    synthetic: str = ""


def named(text: str, without: str = "unnamed record") -> str:
    """A name on one line; `without` one, what stands in its place."""
    return one_line(text).strip() or without


def known(term: str, text: str) -> tuple[tuple[str, str], ...]:
    """A line of the foot; none where its text is empty."""
    return ((term, text),) if text else ()


def made_by(version: str) -> tuple[str, str]:
    """The line of the foot with the versions of the result and of the page."""
    return ("Made by", f"hygrokf {version or '(version not stated)'}; summary by hygrokf {__version__}")


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
    "Settle the doubts about the record first: “hygrokf check” lists them.": ("record_doubted",),
    "Compare the humidity sensor with a second one.": ("sensor_or_water",),
    "Run “hygrokf fit” again with more starts (--starts): the estimation has not ended.": (
        "not_converged", "convergence_unknown",
    ),
    "Give the likelihood a smaller tolerance: the filter's steps are too long here.": ("not_exact",),
    LACKING: (
        "criteria_disagree", "worse_than_mean", "worse_than_rule", "band_failed", "innovations_correlated",
        "noise_not_as_modelled", "sensor_stretched", "forms_differ", "parts_differ",
    ),
    "Record for longer, with changes of load and standstills: this record hardly determines the number.": (
        "at_limit", "not_identifiable", "one_sided", "undetermined", "imprecise", "free_run_silent",
        "few_readings", "input_not_needed", "record_short", "guard_reached",
    ),
    "Log the cabinet at shorter steps.": ("readings_coarse",),
    "Take the weather from a source with shorter steps.": ("ambient_coarse",),
}  # fmt: skip
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
            *synthetic(bool(summary.synthetic), summary.synthetic),
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
        (0.85, summary.kind), (2.1, summary.name), (1.2, summary.synthetic), (1.15, summary.question),
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
