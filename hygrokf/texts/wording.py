"""How numbers, names and texts are written on pages and at the terminal."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta

NONE = "–"
UNBOUNDED = "not identifiable"
QUANTITY_NAMES = {
    "temperature_K": ("temperature", "K"),
    "absolute_humidity_g_m3": ("absolute humidity", "g/m³"),
    "relative_humidity": ("relative humidity", "1"),
}
BASELINES = {
    "temperature_K": {"no_dynamics": "heat release without heat storage"},
    "absolute_humidity_g_m3": {
        "ambient": "c = c_amb",
        "ambient_pressure_balance": "c = c_amb T_amb/T_conv,a",
    },
}
"""Rules that need no model, by the quantity that they predict."""
RULE_NAMES = {key: words for group in BASELINES.values() for key, words in group.items()}


def plain_number(value: float, digits: int = 3) -> str:
    """Write a number with `digits` significant digits, without an exponent from 1e-5 to 1e6."""
    if not math.isfinite(value):
        return NONE
    if value == 0:
        return "0"
    if 1e-5 <= abs(value) < 1e6:
        decimals = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
        return minus(f"{value:.{min(decimals, 8)}f}")
    return minus(f"{value:.{digits - 1}e}")


def fixed(value: float, decimals: int = 2) -> str:
    """Write a number with a fixed number of decimals; "–" if it is not finite."""
    return minus(f"{value:.{decimals}f}") if math.isfinite(value) else NONE


def chance_text(probability: float) -> str:
    """Write a probability [1] in per cent, never as 0 or 100 %: "over 99 %", "under 1 %"."""
    if probability > 0.99:
        return "over 99 %"
    return f"{100 * probability:.0f} %" if probability >= 0.01 else "under 1 %"


def signed(value: float, decimals: int = 2) -> str:
    """A difference with its sign and `decimals` decimals; what rounds to zero has no sign."""
    if not math.isfinite(value):
        return NONE
    text = f"{value:+.{decimals}f}"
    return minus(text) if float(text) else text[1:]


def minus(text: str) -> str:
    """Replace a leading hyphen by a minus sign."""
    return text.replace("-", "−", 1) if text.startswith("-") else text


def percent(share: float, decimals: int = 0) -> str:
    """Write a share [1] in per cent."""
    return f"{100.0 * share:.{decimals}f} %" if math.isfinite(share) else NONE


def p_value(p: float) -> str:
    """Write a p-value; values below `LEAST_P` as "< 0.001", NaN as "–"."""
    return NONE if math.isnan(p) else f"< {LEAST_P}" if p < LEAST_P else f"{p:.3f}"


def p_equation(p: float) -> str:
    """Write a p-value with its name: "p < 0.001", "p = 0.034"."""
    return f"p {'' if p < LEAST_P else '= '}{p_value(p)}"


LEAST_P = 0.001
"""[1] smaller p-values are written as "< 0.001"."""
MOST_DECIMALS = 8
"""Largest number of decimals; a number that needs more is written with significant digits."""


def decimals_for(spread: float) -> int:
    """The decimals that show `spread` with one significant digit, or with two if the first one is 1 or 2."""
    if not (math.isfinite(spread) and spread > 0):
        return 2
    return min(max(math.ceil(0.4 - math.log10(spread)), 0), MOST_DECIMALS)


WIDE = 4.0
"""[1] ratio of upper to lower end; above it, value and ends are rounded each by its own size."""


def ends(value: float, low: float, high: float) -> tuple[str, str]:
    """Write a value and its interval with the significant digits: ("1.49", "1.44 … 1.54")."""
    if high > WIDE * low:
        return plain_number(value), f"{plain_number(low, 2)} … {plain_number(high, 2)}"
    decimals = decimals_for(0.5 * (high - low))
    return fixed(value, decimals), f"{fixed(low, decimals)} … {fixed(high, decimals)}"


NAMES_SHOWN = 5
"""Number of names of a list that are shown; further names are only counted."""


def several(names: Iterable[str]) -> str:
    """Join the first `NAMES_SHOWN` names by commas, and add the number of further names."""
    all_names = list(names)
    rest = f" and {len(all_names) - NAMES_SHOWN} more" if len(all_names) > NAMES_SHOWN else ""
    return f"{', '.join(all_names[:NAMES_SHOWN])}{rest}"


def bytes_text(count: float) -> str:
    """Write a size [bytes] in a convenient unit, such as "12 MB"."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} bytes"


def one_line(text: str) -> str:
    """Replace line breaks and control characters of a text by blanks."""
    return text if text.isprintable() else "".join(c if c.isprintable() else " " for c in text)


def unbroken(text: str) -> str:
    """Return a text on one line, with no-break spaces between numbers and their units."""
    return re.sub(r"(?<=\d) (?=(?:%|K|h|g/m³|°C)(?![\w/]))", "\xa0", one_line(text))


def sentence(text: str) -> str:
    """A text with a capital first letter and a full stop; a leading name with underscores stays unchanged."""
    text = text[:1].upper() + text[1:] if not text.split(" ")[0].count("_") else text
    return text if text.endswith((".", "!", "?")) else text + "."


def iso_time(seconds: float) -> str:
    """Write an instant [s since 1970] in ISO 8601, UTC, to the second."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


def moment(text: str) -> str:
    """Write an instant of a result ("2024-05-01T12:00:00+00:00") as date and time to the minute."""
    return text[:16].replace("T", " ") if len(text) >= 16 else text


def duration_text(seconds: float) -> str:
    """Write a duration in a convenient unit, such as "10 min" or "3.5 d".

    seconds: [s] ≥ 0.
    """
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size or (seconds >= size and seconds % size == 0.0):
            return f"{float(f'{seconds / size:.3g}'):g} {unit}"
    return f"{seconds:.3g} s"


def shift_text(seconds: float) -> str:
    """Write the error of a clock [s] without its sign, such as "1.5 h" or "40 min"."""
    size = abs(seconds)
    return f"{size / 3600.0:g} h" if size >= 3600.0 and size % 1800.0 == 0.0 else f"{size / 60.0:.0f} min"


def signed_shift(seconds: float) -> str:
    """Write the error of a clock [s] with its sign in ASCII, as in case files: "+2 h"."""
    return f"{'+' if seconds >= 0 else '-'}{shift_text(seconds)}"


def lag_text(hours: float) -> str:
    """Write a lag [h]: "−0.25 h", "0"."""
    return minus(f"{hours:.3g} h") if hours else "0"


def stamp_text(seconds: float) -> str:
    """Write an instant in ISO 8601, UTC, such as "2020-12-01T00:00Z".

    seconds: [s] since 1970-01-01T00:00Z; NaN becomes "-".
    """
    if not math.isfinite(seconds):
        return "-"
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=round(float(seconds)))
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ" if moment.second else "%Y-%m-%dT%H:%MZ")


def day_text(seconds: float) -> str:
    """Write the date of an instant [s since 1970], UTC, such as "2020-12-01"; NaN becomes "-"."""
    return stamp_text(seconds)[:10]


def period_text(start_s: float, end_s: float) -> str:
    """Write a period, such as "2020-01-01T00:00Z to 2020-01-02T00:00Z"; one stamp if it has no length.

    start_s, end_s: [s] since 1970-01-01T00:00Z.
    """
    first, last = stamp_text(start_s), stamp_text(end_s)
    return first if first == last else f"{first} to {last}"
