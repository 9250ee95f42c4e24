"""How a revision's outputs differ from their reference: numbers within a tolerance, everything else word for
word."""

from __future__ import annotations

import json
import lzma
import math
import re
from collections.abc import Iterator
from pathlib import Path

REFERENCES = Path(__file__).resolve().parent / "references"
NUMBER = re.compile(r"[-\u2212]?\d[\d,\u202f\u2009]*(?:\.\d+)?(?:e[-+]?\d+)?")
VOLATILE = re.compile(r"(?:_|^)(?:cpu_s|wall_s|seconds|created|began_utc|id|key)$")
"""Keys of JSON whose values are of one run or one version: times that it took, digests of what it read."""
CANCELLED = 1e-12
"""Largest size of what is left where numbers cancel, such as an effect [K] that is none: its digits are
rounding, and have no tolerance of their own."""


def read(name: str) -> dict:
    """The reference of a case."""
    return json.loads(lzma.decompress((REFERENCES / f"{name}.json.xz").read_bytes()))


def write(name: str, outputs: dict) -> Path:
    """Make what a case gave its reference."""
    REFERENCES.mkdir(exist_ok=True)
    path = REFERENCES / f"{name}.json.xz"
    path.write_bytes(lzma.compress(json.dumps(outputs, sort_keys=True).encode(), preset=9))
    return path


def differences(was: object, now: object, relative: float, place: str = "") -> Iterator[str]:
    """Every place in which two outputs differ; `relative` is the tolerance of numbers."""
    if isinstance(was, dict) and isinstance(now, dict):
        for key in sorted({*was, *now}):
            if VOLATILE.search(key):
                continue
            if key not in now:
                yield f"{place}/{key}: gone"
            elif key not in was:
                yield f"{place}/{key}: new"
            else:
                yield from differences(was[key], now[key], relative, f"{place}/{key}")
    elif isinstance(was, list) and isinstance(now, list):
        if len(was) != len(now):
            yield f"{place}: {len(was)} entries, now {len(now)}"
        for number, (one, other) in enumerate(zip(was, now, strict=False)):
            yield from differences(one, other, relative, f"{place}[{number}]")
    elif isinstance(was, str) and isinstance(now, str):
        if not same_text(was, now, relative):
            yield f"{place}: {was!r}, now {now!r}"
    elif is_number(was) and is_number(now):
        if not close(float(was), float(now), relative):  # type: ignore[arg-type]
            yield f"{place}: {was!r}, now {now!r}"
    elif was != now:
        yield f"{place}: {was!r}, now {now!r}"


def is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def close(was: float, now: float, relative: float) -> bool:
    if was == now or (math.isnan(was) and math.isnan(now)):
        return True
    return math.isclose(was, now, rel_tol=relative, abs_tol=CANCELLED if relative > 0.0 else 0.0)


def same_text(was: str, now: str, relative: float) -> bool:
    """Whether two texts have the same words and, within the tolerance, the same numbers."""
    if was == now:
        return True
    if relative == 0.0 or NUMBER.sub("\0", was) != NUMBER.sub("\0", now):
        return False
    pairs = zip(NUMBER.findall(was), NUMBER.findall(now), strict=True)
    return all(one == other or close(_value(one), _value(other), relative) for one, other in pairs)


def _value(text: str) -> float:
    return float(re.sub(r"[,\u202f\u2009]", "", text.replace("\u2212", "-")))
