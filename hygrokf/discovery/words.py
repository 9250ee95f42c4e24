"""A discovery as text for the terminal."""

from __future__ import annotations

from collections.abc import Mapping

from hygrokf.report_tables import TEXT_WIDTH, wrapped

VERDICTS = {
    "none": "nothing that is both significant and worth having",
    "named": "a cause is named",
    "unexplained": "structure remains that nothing in the library explains",
}


def discovery_text(found: Mapping) -> str:
    """Verdict, misfits, causes with their gain, and what was tried in vain; lines of at most 100 columns."""
    lines = [f"{found['name']}: {VERDICTS[found['verdict']]}", ""]
    lines.append("what the simulation gets wrong")
    lines += _items(one["statement"] for one in found["misfits"]) or ["  nothing significant and material"]
    for cause in found["causes"]:
        gain = cause["gain"]
        lines += [
            "",
            f"cause: {cause['cause']} ({cause['form']}), confidence {100 * cause['confidence']:.0f} %",
        ]
        lines += _items([cause["statement"]])
        lines += [
            f"    {name} = {_number(row['value'])} ({_number(row['lower'])} … {_number(row['upper'])}) {row['unit']}"
            for name, row in cause["parameters"].items()
        ]
        lines += [
            f"    free run, {gain['quantity']}, {gain['period']}: {_number(gain['rmse_before'])} before, "
            f"{_number(gain['rmse_after'])} after (gain {_number(gain['lower'])} … {_number(gain['upper'])})",
            f"    evidence: 2 ln L grows by {cause['evidence']['lr']:.0f}",
        ]
        if cause["ambiguous_with"]:
            lines += _items(
                [f"could also be {', '.join(cause['ambiguous_with'])}; to tell: {cause['separate_by']}"]
            )
        lines += _items([f"check: {cause['remedy']}"])
    if found["unexplained"] is not None:
        lines += [
            "",
            "unexplained",
            *_items([found["unexplained"].get("statement", str(found["unexplained"]))]),
        ]
    lines += ["", f"tried and left out: {len(found['rejected'])} causes (discovery.json has the evidence)"]
    return "\n".join(lines)


def _items(sentences) -> list[str]:
    return [line for text in sentences for line in wrapped(f"  - {text}", TEXT_WIDTH, "    ")]


def _number(value: float | None) -> str:
    return "open" if value is None else f"{value:.3g}"
