"""The text of a drafted case file: what was found, its doubts as comments, all columns that are left."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hygrokf.data.files import DRAFT_DOUBT
from hygrokf.data.input_paths import ON_CHANGE, on_change
from hygrokf.data.readings import detect_resolution
from hygrokf.data.signals import SIGNALS
from hygrokf.data.timestamps import duration_text, stamp_text
from hygrokf.drafting.mapping import Assigned, Source
from hygrokf.physics.holds import LINEAR

_WIDTH = 100


@dataclass(frozen=True)
class Weather:
    """A weather file: its path in the case, its `format`, and whether it is a typical year."""

    file: str
    format: str
    typical: bool = False


@dataclass(frozen=True)
class Contents:
    """All that a drafted case says.

    name: of the enclosure. rated_kW: by the plateau of the power [kW], None where there is none.
    power_kW: its largest readings [kW], None where no power was found.
    site: latitude and longitude [deg], or None.
    """

    name: str
    sources: tuple[Source, ...]
    found: tuple[Assigned, ...]
    left: dict[tuple[int, str], str]
    weather: tuple[Weather, ...]
    rated_kW: float | None
    power_kW: float | None
    site: tuple[float, float] | None


def case_text(case: Contents) -> str:
    """The case file (TOML)."""
    return "\n".join(_lines(case)) + "\n"


def lacking(case: Contents) -> tuple[str, ...]:
    """What a fit needs or would miss, and no active signal of the draft holds."""
    signals = {one.best.signal for one in case.found if one.active and not one.compare}
    lacks = []
    if not case.weather and "ambient_temperature" not in signals:
        lacks.append("no ambient temperature was found, and every model needs it: add its export")
    if not any(one.startswith("cabinet_") for one in signals):
        lacks.append("no reading of the cabinet was found; `hygrokf fit` needs one: add its export")
    humid = {one.partition("_")[0] for one in signals if "humidity" in one or "dew_point" in one}
    if "cabinet" in humid and "ambient" not in humid and not case.weather:
        lacks.append("no humidity of the air outside was found, which the hygric model needs: add its export")
    if "active_power" not in signals:
        lacks.append(
            "no active power was found: the whole record would count as standstill; add its export, "
            "or name its column"
        )
    return tuple(lacks)


def _lines(case: Contents) -> Iterator[str]:
    yield "# Drafted by `hygrokf init` from the exports below. Check what is marked `doubt`, then run"
    yield "# `hygrokf check` on this file. docs/reference/case_file.md describes all keys."
    yield f"name = {_text(case.name)}"
    if case.rated_kW is not None:
        yield f"rated_power_kW = {case.rated_kW:g}  # where the power stops rising; see the type plate"
    elif case.power_kW is not None:
        yield from _doubt(f"the power shows no plateau; its largest readings are {case.power_kW:.4g} kW")
        yield "# rated_power_kW = "
    yield ""
    if case.site is None:
        yield "# [site]  # gives the height of the sun, and the pressure of the air by altitude_m"
        yield "# latitude_deg = "
        yield "# longitude_deg = "
    else:
        yield "[site]"
        yield f"latitude_deg = {case.site[0]:g}"
        yield f"longitude_deg = {case.site[1]:g}"
    for lack in lacking(case):
        yield from ("", *_doubt(lack))
    for number in range(len(case.sources)):
        for compare in (False, True):
            lines = [one for one in case.found if one.best.source == number and one.compare is compare]
            if any(one.active for one in lines):
                yield from ("", *_source(case, number, lines, compare))
            elif not compare:
                yield from ("", f"# {case.sources[number].path}: no signal was recognised; its columns:")
                yield from _left(case, number)
    for weather in case.weather:
        yield from ("", "[[source]]", f"file = {_text(weather.file)}", f'format = "{weather.format}"')
        if weather.typical:
            yield from _doubt("a typical year has no calendar year of its own: the year that it stands for")
            yield f"year = {_year(case)}"
    yield from _period(case)


def _source(case: Contents, number: int, lines: list[Assigned], compare: bool) -> Iterator[str]:
    source = case.sources[number]
    clock, export = source.clock, source.export
    finite = clock.time[np.isfinite(clock.time)]
    gone = 1.0 - len(np.unique(finite)) / max(1.0, np.ptp(finite) / clock.step_s + 1.0)
    zone = "" if clock.timezone is None else " by its own clock"
    span = f"{stamp_text(finite.min()).rstrip('Z')} to {stamp_text(finite.max()).rstrip('Z')}{zone}"
    yield f"# {len(finite)} rows, {span}, step {duration_text(clock.step_s)}" + (
        f", {100 * gone:.0f} % of the rows missing" if gone > 0.01 else ""
    )
    yield "[[source]]"
    if export.changes:
        yield from _comment(
            f"# a copy of {export.file.name}, in a form that a case can name: {'; '.join(export.changes)}"
        )
    yield f"file = {_text(source.path)}"
    yield f"time = {_text(clock.column)}"
    if clock.time_format is not None:
        yield f"time_format = {_text(clock.time_format)}"
    for remark in filter(None, (*clock.remarks, source.sun)):
        yield from _comment(f"# {remark}")
    for doubt in () if compare else (*clock.doubts, *source.said):
        yield from _doubt(doubt)
    if clock.timezone is not None:
        yield f"timezone = {_text(clock.timezone)}"
    if clock.stamp != "instant":
        yield f"stamp = {_text(clock.stamp)}"
    if export.separator != ",":
        yield f"separator = {_text(export.separator)}"
    if export.decimal != ".":
        yield f"decimal = {_text(export.decimal)}"
    if export.thousands:
        yield f"thousands = {_text(export.thousands)}"
    if export.comment is not None:
        yield f"comment = {_text(export.comment)}"
    texts = set().union(*(export.read(one.best.column)[1] for one in lines))
    if len(texts) > 8:
        yield from _doubt(f"{len(texts)} different texts among the readings are taken as missing")
    if export.missing or texts:
        yield f"missing = {json.dumps(sorted(texts.union(export.missing)), ensure_ascii=False)}"
    for doubt in () if compare else source.quality_doubts:
        yield from _doubt(doubt)
    if source.vocabulary.name and any(one.best.column in source.quality for one in lines):
        yield f"vocabulary = {_text(source.vocabulary.name)}"
    if compare:
        yield "compare = true  # only compared with the source above that has the same signal"
    for one in lines:
        yield from _signal(source, one)
    if not compare:
        yield from _left(case, number)


def _signal(source: Source, one: Assigned) -> Iterator[str]:
    best = one.best
    for doubt in one.doubts:
        yield from _doubt(doubt)
    values = source.values[best.column]
    resolution = detect_resolution(values)
    lines = source.clock.stamp == "instant" and SIGNALS[best.signal].hold_of_instants == LINEAR
    if lines and resolution and on_change(source.clock.time, values, resolution):
        yield from _doubt(f"{best.signal} {ON_CHANGE}")
    note = best.why + (f"; readings in steps of {resolution:g}" if resolution else "")
    quality = f", quality = {_text(source.quality.get(best.column, ''))}" * (best.column in source.quality)
    entry = f"signals.{best.signal} = {{ column = {_text(best.column)}, unit = {_text(best.unit)}{quality} }}"
    yield f"{'' if one.active else '# '}{entry}  # {note}"


def _left(case: Contents, number: int) -> Iterator[str]:
    rest = [f"{column} ({why})" for (source, column), why in case.left.items() if source == number]
    if rest:
        yield from _comment("# not used: " + ", ".join(rest))


def _year(case: Contents) -> int:
    """The calendar year in the middle of the exports; 2019 without one."""
    times = [float(np.nanmedian(one.clock.time)) for one in case.sources]
    return int(stamp_text(times[0])[:4]) if times else 2019


def _period(case: Contents) -> Iterator[str]:
    times = [one.clock.time for one in case.sources]
    if not times:
        return
    start, end = (float(edge([edge(t[np.isfinite(t)]) for t in times])) for edge in (np.min, np.max))
    yield from ("", "# [identification]  # the readings after `until` are kept to validate the model")
    yield f'# until = "{stamp_text(86400.0 * round((start + 0.7 * (end - start)) / 86400.0))}"'


def _text(text: str) -> str:
    """A TOML string."""
    return json.dumps(text, ensure_ascii=False)


def _doubt(text: str) -> Iterator[str]:
    yield from _comment(f"{DRAFT_DOUBT}{text}")


def _comment(text: str) -> Iterator[str]:
    """Lines of a comment; no text of a file can end it."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    lines = textwrap.wrap(
        plain, _WIDTH, subsequent_indent="#   ", break_long_words=False, break_on_hyphens=False
    )
    yield from lines
