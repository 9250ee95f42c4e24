"""`HygrokfError`, the class above all faults that a user can mend, and the names that a misspelt one may have
meant."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class HygrokfError(Exception):
    """An input error: the message says what was expected, what was found and what to do."""


def near_names(name: str, candidates: Iterable[str], count: int = 3) -> list[str]:
    """Candidates that look like a misspelt name, best first.

    name: what was written. candidates: what would have been right. count: at most so many.
    """
    candidates = list(candidates)
    lower = {candidate.lower().strip(): candidate for candidate in reversed(candidates)}
    found = get_close_matches(name.lower().strip(), list(lower), n=count, cutoff=0.6)
    return [lower[match] for match in found]


def suggestion(name: str, candidates: Iterable[str], count: int = 3) -> str:
    """Half a sentence that names the nearest candidates, `count` at most, or nothing if none is near."""
    near = near_names(name, candidates, count)
    quoted = " or ".join(f'"{one}"' for one in near)
    return f"; did you mean {quoted}?" if near else ""


def unknown_names(where: str, given: Iterable[object], known: Iterable[str]) -> list[str]:
    """A fault for each name that is not a known one.

    where: the argument, or the function, that gave the names.
    """
    known = tuple(known)
    return [
        f'{where}: expected names of {", ".join(known) or "nothing"}, found "{name}"'
        f"{suggestion(str(name), known, 1)}"
        for name in given
        if name not in known
    ]
