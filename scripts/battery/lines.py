"""One line of the battery's results: what is hidden in its case, what was answered, what that is worth.

A case that failed counts as one that was not named: nothing is dropped but measured records that are not
there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

Line = Mapping
FULL, HALF, WEAKER = "full", "half", "weaker"
FULL_FROM, HALF_FROM = 0.85, 0.4
"""Reached strength from which a plant counts as one of full and of half strength."""
LEAST_GAIN = 0.05
"""Attainable gain from which a plant counts in the share of the gain."""
FAILURE = "failure"


def truths(line: Line) -> list[str]:
    """Causes that are hidden in a case; known from what was asked for where the case failed early."""
    return [one["cause"] for one in line["truth"]] or [cause for cause, _ in line["asked"]]


def answer(line: Line) -> str:
    """The name given first, or the verdict."""
    if line["failure"]:
        return FAILURE
    return line["causes"][0]["cause"] if line["causes"] else line["verdict"]


def first_right(line: Line, classes: bool = True) -> bool:
    """Whether the cause is named first, or stands in the class of what is."""
    if line["failure"] or not line["causes"]:
        return False
    first, (truth, *_) = line["causes"][0], truths(line)
    return first["cause"] == truth or (classes and truth in first["ambiguous_with"])


def names(line: Line, classes: bool = True) -> set[str]:
    """All names given, with the members of their classes."""
    if line["failure"]:
        return set()
    found = {one["cause"] for one in line["causes"]}
    return found.union(*(one["ambiguous_with"] for one in line["causes"])) if classes else found


def reached(line: Line) -> float:
    """Strength of what is hidden; as asked for where the case failed before it was known."""
    return line["truth"][0]["reached"] if line["truth"] else line["strength"]


def strength_class(line: Line) -> str:
    size = reached(line)
    return FULL if size >= FULL_FROM else HALF if size >= HALF_FROM else WEAKER


def of(lines: Iterable[Line], *groups: str) -> list[Line]:
    return [line for line in lines if line["group"] in groups and not line["skipped"]]


def hidden_by_cause(lines: Iterable[Line]) -> dict[str, list[Line]]:
    """Lines with one cause of the library, by cause."""
    found: dict[str, list[Line]] = {}
    for line in of(lines, "hidden"):
        found.setdefault(truths(line)[0], []).append(line)
    return dict(sorted(found.items()))


def last_of_each(lines: Iterable[Line]) -> list[Line]:
    """One line a case: the last one that was written."""
    return list({line["key"]: line for line in lines}.values())


def both_named(line: Line, classes: bool = True) -> bool:
    """Whether each of two causes is named, or in the class of a name that no other needs."""
    wanted = truths(line)
    given = [] if line["failure"] else line["causes"]
    holds = [
        {i for i, one in enumerate(given) if t == one["cause"] or (classes and t in one["ambiguous_with"])}
        for t in wanted
    ]
    return any(len({a, b}) == 2 for a in holds[0] for b in holds[1])


def excused(line: Line) -> set[str]:
    """Names that are right, or whose class holds the truth."""
    true, given = set(truths(line)), [] if line["failure"] else line["causes"]
    return true | {one["cause"] for one in given if true & set(one["ambiguous_with"])}


def gain_share(line: Line, attainable: str = "attainable_there") -> float | None:
    """Achieved over attainable gain; None where there is less than a twentieth to gain, or it was not
    measured.

    attainable: "attainable_there" on the stretch on which the gain was achieved, "attainable" on the whole
        record.
    """
    account = line["truth"][0] if line["truth"] else {}
    if line["failure"]:
        return 0.0 if account.get("attainable", 0.0) >= LEAST_GAIN else None
    if (account.get(attainable) or 0.0) < LEAST_GAIN or account.get("achieved") is None:
        return None
    return account["achieved"] / account[attainable]
