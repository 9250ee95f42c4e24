"""Holds: how a series continues between its stamps, and an input between two instants of the filter."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from hygrokf.errors import suggestion

PREVIOUS = "previous"
"""Held from its stamp on, until the next one: settings, switches, values reported on change."""
MEAN = "mean"
"""Constant over the interval that ends at its stamp, or over the step that ends at the instant: means."""
LINEAR = "linear"
"""Joined by straight lines: readings of an instant."""
HOLDS = (PREVIOUS, MEAN, LINEAR)
REGIME = "mean of few distinct values"
"""`MEAN` with few distinct values, so that steps of the same length share their matrices (internal)."""
_ABBREVIATIONS = {"zoh": PREVIOUS, "foh": LINEAR}
"""Abbreviations whose meaning does not differ between tools."""


def hold_named(word: object) -> str:
    """The hold that a word means: one of `HOLDS`, "zoh" (previous) or "foh" (linear).

    Raises ValueError for any other word, and for "zero-order", which has two meanings.
    """
    if word in HOLDS:
        return str(word)
    if isinstance(word, str) and word in _ABBREVIATIONS:
        return _ABBREVIATIONS[word]
    if isinstance(word, str) and re.match(r"zero(th)?order", re.sub(r"[\W_]", "", word.lower())):
        raise ValueError(
            f"the hold {word!r} has two meanings: held from its stamp on (control, scipy, MATLAB, ctsmTMB), "
            f'which is "{PREVIOUS}", or constant over the interval that ends at its stamp (hygrokf before), '
            f'which is "{MEAN}"; state which'
        )
    near = suggestion(word, (*HOLDS, *_ABBREVIATIONS), 1) if isinstance(word, str) else ""
    raise ValueError(f"expected the hold {', '.join(HOLDS[:-1])} or {LINEAR}, found {word!r}{near}")


def holds_named(holds: Mapping[str, object]) -> dict[str, str]:
    """The hold of every input of a model, by `hold_named`.  Raises one ValueError for all invalid holds."""
    named, faults = {}, []
    for name, word in holds.items():
        try:
            named[name] = REGIME if word == REGIME else hold_named(word)
        except ValueError as fault:
            faults.append(f"{name}: {fault}")
    if faults:
        raise ValueError("; ".join(faults))
    return named


def inputs_between(
    holds: Mapping[str, str],
    before: Mapping[str, np.ndarray | float],
    after: Mapping[str, np.ndarray | float],
    share: np.ndarray | float,
) -> dict[str, np.ndarray | float]:
    """Interpolate inputs at a `share` [1] of the step between two instants, from their values `before` and
    `after` the step.  An input held from its stamp on takes its next value at the end (share = 1)."""
    return {name: between(holds[name], before[name], value, share) for name, value in after.items()}


def between(
    hold: str, before: np.ndarray | float, after: np.ndarray | float, share: np.ndarray | float
) -> np.ndarray | float:
    """Interpolate one input at a `share` [1] of a step, as `inputs_between` does."""
    if hold == LINEAR:
        return before + share * (after - before)
    return np.where(np.less(share, 1.0), before, after) if hold == PREVIOUS else after
