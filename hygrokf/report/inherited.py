"""The time constants that a result took over from a fit, each with the verdict that it came with."""

from __future__ import annotations

from collections.abc import Mapping

from hygrokf.identification.verdict import line
from hygrokf.identification.verdict_terms import REJECT, Inherited, Verdict
from hygrokf.identification.wording import interval
from hygrokf.report.blocks import Line, Verdicts


def inherited_verdicts(found: Mapping[str, Inherited], heading: str) -> Verdicts | None:
    """One line for each time constant, struck through where it is not to be believed; None without any."""
    lines = []
    for part, one in found.items():
        verdict = Verdict(one.verdict, one.reasons)
        value, bounds, _ = interval(one.value_h, one.lower_h, one.upper_h)
        span = f"{value} ({bounds})" if bounds else value
        if one.verdict == REJECT:
            why = f": {verdict.why}" if verdict.why else ""
            lines.append(Line(REJECT, f"{part} time constant, {verdict.words}{why}", struck=span))
        else:
            lines.append(Line(one.verdict, line(f"{part} time constant", span, verdict)))
    return Verdicts(tuple(lines), heading, key=False) if lines else None
