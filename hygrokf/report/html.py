"""One self-contained page: its head and style, sections, tables and figures as HTML."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from html import escape
from typing import TYPE_CHECKING

from hygrokf.identification.verdict import BELIEVE, MARKS, REJECT, VERDICTS, WORDS, Verdict, handed_on
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.identification.wording import interval, one_line, text_of
from hygrokf.report.blocks import Table
from hygrokf.report.figures.drawing import FONTS, NothingToShow, inline_svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONG = 36
"""Characters of a word column beyond which a cell may break anywhere."""


def document(title: str, parts: list[str]) -> str:
    """The whole page as HTML text: needs no script and no other file, names no host, prints on A4."""
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{CSS}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def prose(text: str) -> str:
    """A text for a paragraph, escaped; no line parts a number from its unit."""
    return re.sub(r"(?<=\d) (?=(?:%|K|h|g/m³|°C)(?![\w/]))", "&nbsp;", escape(one_line(text)))


def mark_html(kind: str) -> str:
    """The mark of a verdict, with its words for those who do not see it."""
    return f"<span class={kind} title='{WORDS[kind]}'>{MARKS[kind]}</span>"


def verdict_html(found: Verdict) -> str:
    """A verdict as it stands under its number: mark, words, first reason."""
    why = f": {prose(found.why)}" if found.why else ""
    return f"<p class='verdict {found.verdict}'>{mark_html(found.verdict)} <b>{found.words}</b>{why}</p>"


def numbers_html(inherited: Mapping[str, Inherited] | None, whose: str = "") -> str:
    """The numbers that a page rests on, with the verdicts that they came with; nothing where there are none.

    A number that is not to be believed is struck through.
    """
    items = ""
    for part, data, found in handed_on(inherited):
        value, bounds, _ = interval(data.value_h, data.lower_h, data.upper_h)
        span = prose(f"{value} ({bounds})" if bounds else value)
        span = (
            f"<s>{span}</s>"
            if found.verdict == REJECT
            else f"<b>{span}</b>"
            if found.verdict == BELIEVE
            else span
        )
        why = f": {prose(found.why)}" if found.why else ""
        items += (
            f"<li class={found.verdict}>{mark_html(found.verdict)}{part} time constant {span}, "
            f"{found.words}{why}</li>"
        )
    label = f"<p class=key>{prose(whose)}</p>" if whose and items else ""
    return f"<div class=numbers>{label}<ul class=judgements>{items}</ul></div>" if items else ""


KEY = "".join(f" {mark_html(kind)} {WORDS[kind]}" for kind in VERDICTS).strip()
"""What the marks mean."""


def figure_html(name: str, heading: str, caption: str, draw: Callable[[], Figure]) -> str:
    """A figure with heading and caption; one sentence where there is nothing to show.

    name: letters, digits and -, makes the identifiers of the drawing unique on the page.
    """
    try:
        drawing = inline_svg(draw(), name, heading)
    except NothingToShow as why:
        return f"<p class=left-out><b>{escape(heading)}</b> is left out. {escape(one_line(str(why)))}</p>"
    said = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure><h3>{escape(heading)}</h3><div class=drawing>{drawing}</div>{said}</figure>"


def section(heading: str, *parts: str) -> str:
    """Parts under a heading."""
    return f"<section><h2>{escape(heading)}</h2>{''.join(parts)}</section>"


def moment(value: object) -> str:
    """An instant of a result, "2024-05-01T12:00:00+00:00", as date and time to the minute."""
    text = text_of(value)
    return text[:16].replace("T", " ") if len(text) >= 16 else text


def tables_html(*tables: tuple[Table | None, str]) -> str:
    """Tables, or why there is none."""
    return "".join(
        table_html(table) if table is not None else f"<p class=left-out>{escape(why)}</p>"
        for table, why in tables
    )


def table_html(table: Table) -> str:
    """A table with its heading and note."""
    groups = ""
    starts: set[int] = set()
    if table.groups:
        at = 0
        for heading, count in table.groups:
            starts.add(at)
            at += count
            groups += f"<th colspan={count}{' class=group' if heading else ''}>{escape(heading)}</th>"
        groups = f"<tr>{groups}</tr>"

    def cell(tag: str, place: int, text: str) -> str:
        marks = {
            "l": place in table.left,
            "g": place in starts and place > 0,
            "long": place in table.left and len(text) > LONG,
        }
        names = [name for name, there in marks.items() if there]
        attribute = f" class='{' '.join(names)}'" if names else ""
        return f"<{tag}{attribute}>{escape(one_line(text))}</{tag}>"

    head = "".join(cell("th", i, text) for i, text in enumerate(table.columns))
    rows = "".join(
        f"<tr{' class=marked' if i in table.marked else ''}>{''.join(cell('td', k, text) for k, text in enumerate(row))}</tr>"
        for i, row in enumerate(table.rows)
    )
    note = f"<p class=note>{escape(table.note)}</p>" if table.note else ""
    return (
        f"<div class='table{' short' if len(table.rows) < 13 else ''}'><h3>{escape(table.heading)}</h3><table><thead>{groups}<tr>{head}</tr></thead>"
        f"<tbody>{rows}</tbody></table>{note}</div>"
    )


CSS = (
    """\
@page { size: A4; margin: 15mm 14mm 16mm; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: #fff; color: #22272e; font: 14px/1.45 """
    + FONTS
    + """; }
main { max-width: 820px; margin: 0 auto; padding: 28px 24px 48px; }
h1 { font-size: 27px; line-height: 1.2; margin: 0 0 6px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 34px 0 8px; padding-top: 10px; border-top: 2px solid #22272e; }
h3 { font-size: 14px; margin: 20px 0 6px; } sub { font-size: 75%; line-height: 0; }
p { margin: 4px 0; overflow-wrap: anywhere; }
.kind { color: #6b7480; font-size: 12px; letter-spacing: .02em; }
.meta { color: #4a525c; font-size: 13px; }
.banner { margin: 14px 0 0; padding: 9px 12px; border-left: 5px solid; font-size: 14px; }
.banner b { margin-right: 8px; letter-spacing: .05em; }
.synthetic { background: #fdf3d7; border-color: #c98a00; }
.failed { background: #fbe3e1; border-color: #b3140f; color: #8c0f0b; }
.cards { display: grid; grid-template-columns: 1fr 1fr; gap: 14px; margin-top: 20px; }
.card { border: 1px solid #d5dae0; border-top: 4px solid #1b5fa8; padding: 10px 14px 12px; break-inside: avoid; }
.card.open, .card.caution { border-top-color: #c98a00; } .card.reject { border-top-color: #b3140f; }
.card .label { font-weight: 600; } .card .label span { font-weight: 400; color: #6b7480; }
.card .value { font-size: 34px; line-height: 1.15; font-weight: 650; margin: 2px 0; }
.card .bounds { font-size: 15px; font-weight: 600; }
.card p { font-size: 13px; }
.verdict { margin: 5px 0 6px; } .card .verdict.reject { font-size: 13.5px; color: #8c0f0b; }
.card.reject .value { font-size: 23px; color: #8c0f0b; } .card.reject .bounds { font-weight: 400; font-size: 13px; color: #6b7480; }
.card.reject.resting .value { font-size: 19px; font-weight: 400; color: #6b7480; } .card.caution .value { font-weight: 500; }
.numbers { margin: 14px 0 0; } .numbers ul { margin: 0; } .numbers li { font-size: 13px; color: #22272e; font-weight: 400; }
.card.wide { grid-column: 1 / -1; } .card .value.words { font-size: 27px; line-height: 1.25; }
.check { margin-top: 8px; padding-top: 7px; border-top: 1px solid #edf0f3; }
.found + .found { margin-top: 26px; } h3.cause { font-size: 16px; } h3.cause span { font-weight: 400; color: #6b7480; }
dl { display: grid; grid-template-columns: 10.5em 1fr; margin: 6px 0; } dt, dd { padding: 4px 0; border-bottom: 1px solid #edf0f3; }
dt { font-weight: 600; color: #4a525c; } dd { margin: 0; overflow-wrap: anywhere; break-inside: avoid; }
.key { color: #4a525c; font-size: 12px; }
.key span { margin: 0 3px 0 12px; } .key span:first-child { margin-left: 0; }
.judgements { list-style: none; padding: 0; margin: 6px 0; }
.judgements li { position: relative; padding: 4px 0 4px 26px; border-bottom: 1px solid #edf0f3; break-inside: avoid; overflow-wrap: anywhere; }
.judgements li > span { position: absolute; left: 3px; font-weight: 700; }
.judgements li.reason { margin-left: 26px; } .judgements li.head { font-weight: 600; }
span.believe { color: #1d7a3a; } span.caution { color: #a86a00; } span.reject { color: #b3140f; }
.judgements li.reject:not(.reason) { color: #8c0f0b; } s { color: #6b7480; }
span.believe, span.caution, span.reject { font-weight: 700; }
.table { overflow-x: auto; } .table.short { break-inside: avoid; }
table { border-collapse: collapse; width: 100%; font-size: 12.5px; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 8px 3px 4px; text-align: right; vertical-align: top; }
th { font-weight: 600; color: #4a525c; border-bottom: 1px solid #6b7480; vertical-align: bottom; }
thead tr:first-child:not(:last-child) th { border-bottom: 0; } th.group { text-align: center; border-bottom: 1px solid #d5dae0 !important; }
td { border-bottom: 1px solid #edf0f3; }
tr { break-inside: avoid; }
td { white-space: nowrap; } .l { text-align: left; white-space: pre; } td.l:not(:first-child) { white-space: normal; }
.l.long { white-space: pre-wrap; overflow-wrap: anywhere; min-width: 14em; } .g { padding-left: 18px; }
.marked td { font-weight: 650; }
.note, figcaption { color: #4a525c; font-size: 12.5px; } .note { margin-top: 5px; }
figure { margin: 26px 0 0; break-inside: avoid; } figure svg { display: block; width: 100%; height: auto; }
figure h3 { margin-top: 0; font-size: 15px; } figcaption { margin-top: 4px; max-width: 46em; }
.left-out { color: #6b7480; font-style: italic; margin: 14px 0; }
section ul { padding-left: 20px; margin: 6px 0; } li { overflow-wrap: anywhere; }
footer p { font-size: 12.5px; color: #4a525c; }
h2, h3 { break-after: avoid; }
@media (max-width: 560px) {
  .cards, dl { grid-template-columns: 1fr; } main { padding: 16px 12px; }
  .drawing { overflow-x: auto; } figure svg { min-width: 600px; }
  dt { border-bottom: 0; padding-bottom: 0; } dd { padding-top: 0; }
}
@media print {
  body { font-size: 9.6pt; print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  main { max-width: none; padding: 0; } h2 { margin-top: 20px; } figure { margin-top: 16px; }
  .table { overflow: visible; } table { font-size: 7.8pt; } th, td { padding: 2px 5px 2px 2px; } .l.long { min-width: 11em; }
  .note, figcaption, footer p, .card p { font-size: 8.4pt; } .card .value { font-size: 22pt; } .card .bounds { font-size: 10.5pt; }
}
"""
)
