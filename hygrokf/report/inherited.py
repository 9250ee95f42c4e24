"""The time constants that a result took over from a fit, each with the verdict that it came with."""

from __future__ import annotations

from collections.abc import Mapping

from hygrokf.identification.verdict_terms import REJECT, Inherited, verdict_line
from hygrokf.identification.wording import interval
from hygrokf.report.blocks import Line, Verdicts


def inherited_verdicts(found: Mapping[str, Inherited], heading: str) -> Verdicts | None:
    """One line for each time constant, struck through where it is not to be believed; None without any."""
    lines = []
    for part, one in found.items():
        value, bounds, _ = interval(one.value_h, one.lower_h, one.upper_h)
        span = f"{value} ({bounds})" if bounds else value
        if one.verdict == REJECT:
            why = f": {one.why}" if one.why else ""
            lines.append(Line(REJECT, f"{part} time constant, {one.words}{why}", struck=span))
        else:
            lines.append(Line(one.verdict, verdict_line(f"{part} time constant", span, one)))
    return Verdicts(tuple(lines), heading, key=False) if lines else None
