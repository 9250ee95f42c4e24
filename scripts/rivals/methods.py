"""The four methods, each from a record and what they share to a part of a line of results."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from hygrokf.discovery.procedure import discover
from rivals.forward import LIMIT_S, log_p, search
from rivals.ground import Ground
from rivals.network import corrected
from rivals.sparse import regressed

OWN, SPARSE, FORWARD, NETWORK = "discover", "pysindy", "likelihood ratio", "network"
METHODS = (OWN, SPARSE, FORWARD, NETWORK)


@dataclass(frozen=True)
class Options:
    """The interpreter that has PySINDy (None: skipped), and the time limit [s] of the forward search."""

    python: str | None = None
    limit_s: float = LIMIT_S


def own(ground: Ground, options: Options) -> dict:
    """`hygrokf.discover` as it is called without options."""
    begin = time.process_time()
    results = discover(ground.record).to_json()
    spent = time.process_time() - begin

    def errors(side: str) -> dict[str, float | None]:
        table = (results[side] or results["baseline"])["rmse"].get("validation", {})
        return {quantity: table.get(quantity, {}).get("total") for quantity in ground.quantities}

    causes = results["causes"]
    return {
        "names": [one["cause"] for one in causes],
        "alike": list(causes[0]["ambiguous_with"]) if causes else [],
        "before": errors("baseline"),
        "after": errors("extended"),
        "cpu_s": spent,
        "verdict": results["verdict"],
        "confidence": [one["confidence"] for one in causes],
        "refuted": [one["cause"] for one in results["refuted"]],
    }


def sparse(ground: Ground, options: Options) -> dict | None:
    return None if options.python is None else regressed(ground, options.python)


def forward(ground: Ground, options: Options) -> dict:
    begin = time.process_time()
    found = search(ground.base, ground.cpu_s, options.limit_s)
    spent = time.process_time() - begin + ground.cpu_s
    return {
        "names": [one.cause for one in found.added],
        "log_p": [log_p(one) for one in found.added],
        "after": ground.held_out(found.last if found.added else None),
        "cpu_s": spent,
        "ended": found.ended,
        "tried": found.tried,
    }


def network(ground: Ground, options: Options) -> dict:
    begin = time.process_time()
    after = corrected(ground)
    return {"names": [], "after": after, "cpu_s": time.process_time() - begin + ground.cpu_s}


RUN: Mapping[str, Callable[[Ground, Options], dict | None]] = {
    OWN: own,
    SPARSE: sparse,
    FORWARD: forward,
    NETWORK: network,
}
