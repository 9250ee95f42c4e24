"""A summary as a page: the blocks of a page, in the order of the sheet."""

from __future__ import annotations

from dataclasses import replace

from hygrokf.report.blocks import Card, Cards, Figure, Items, Page, Prose, present, section, synthetic
from hygrokf.report.summary.content import TODO, Summary
from hygrokf.report.summary.sheet import fitting_scale


def summary_blocks(summary: Summary) -> Page:
    """The answer to the question, its numbers and its picture, then what to do; prints on one page of A4."""
    card = Card(
        summary.question, summary.answer, summary.answer, summary.verdict, lines=summary.reasons, wide=True,
        words=True, tone=summary.tone,
    )  # fmt: skip
    picture = summary.picture
    return Page(
        summary.kind,
        summary.name,
        (),
        present(
            *synthetic(bool(summary.synthetic), summary.synthetic),
            Cards((card,)),
            replace(summary.bounds, heading=""),
            None if picture is None else Figure("lead", picture.heading, picture.caption, picture.figure),
        ),
        section(TODO, Items(summary.actions)),
        tuple(Prose(f"{term}: {text}") for term, text in summary.foot),
        sheet=fitting_scale(summary),
    )
