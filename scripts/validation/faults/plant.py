"""A plant of a few turbines: their model, their tracker's file, their messages, and what must be in the store
afterwards."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

from builders.live_case import expect_offline, live_fit, live_record
from builders.store_case import queried

from hygrokf.data.record import Series
from hygrokf.data.signals import SIGNALS
from hygrokf.data.structured import structured
from hygrokf.identification.fit import write_fit
from hygrokf.identification.fit_results import FitResults
from hygrokf.live.config import read_config
from hygrokf.live.sources.local import record_messages
from hygrokf.live.storage.store import StoreFault, open_store

LATENESS_S = 1800.0
Message = tuple[str, bytes]
"""Topic and payload."""


@dataclass(frozen=True)
class Outcome:
    """What was done to a tracker, and what was found afterwards.

    `blows` how often something was done (kills, full disks, damaged files, payloads), `messages` that were
    sent in all. `missing` and `doubled` observations; `equal` whether the state is the offline filter's, bit
    for bit; `words` what else was seen; `fault` what did not hold, "" where all did.
    """

    blows: int
    messages: int
    missing: int = 0
    doubled: int = 0
    equal: bool = True
    words: str = ""
    fault: str = ""

    @property
    def held(self) -> bool:
        return self.equal and not (self.missing or self.doubled or self.fault)

    def to_json(self) -> dict:
        return {**asdict(self), "held": self.held}


class Plant:
    """Turbines T1, T2 … with the record of one synthetic turbine, tracked from files in `folder`.

    `sources` are the tables of the tracker's file after `[mapping.signals]`.
    """

    def __init__(self, folder: Path, days: float = 3.0, turbines: int = 1, seed: int = 7) -> None:
        self.folder, self.store = folder, f"sqlite:{folder / 'live.db'}"
        self.record = live_record(folder / "record", seed=seed, days=days)
        self.names = [f"T{n + 1}" for n in range(turbines)]
        fit = live_fit(self.record)
        results = {
            "name": fit.name, "version": "0.1.0", "design": fit.design.to_json(), "provenance": "synthetic",
            "time_constants": {},
            "parameters": {name: {"value": value} for name, value in fit.values.items()},
            "covariance": {"names": ["thermal_time_constant"], "matrix": [[0.01]]},
        }  # fmt: skip
        write_fit(replace(fit, results=structured(FitResults, results)), folder / "model")

    def config(self, sources: str, store: str) -> Path:
        """The tracker's file with these sources and this store."""
        file = self.folder / "track.toml"
        site = self.record.site
        place = f"latitude_deg = {site.latitude_deg}, longitude_deg = {site.longitude_deg}"
        lines = [f'store = "{store}"', f'lateness = "{LATENESS_S:.0f}s"', 'retention = "4000d"']
        for name in self.names:
            lines += ["[[turbine]]", f'name = "{name}"', 'fit = "model"', f"site = {{ {place} }}"]
            lines.append(f"rated_power_kW = {1e-3 * self.record.rated_power_W!r}")
        lines += ["[mapping.signals]", *(_field(s) for s in self.record.series), sources]
        file.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return file

    def timed(self) -> list[tuple[float, Message]]:
        """(time [s], message) of every reading of every turbine, by time."""
        rows = [
            (at, (f"scada/{name}", json.dumps({**content, "turbine": name}).encode()))
            for name in self.names
            for at, content in record_messages(self.record, name)
        ]
        return sorted(rows, key=lambda row: row[0])

    def messages(self) -> list[Message]:
        return [message for _, message in self.timed()]

    def judged(self, blows: int, messages: int, store: str, words: str = "", fault: str = "") -> Outcome:
        """What is in a store, held against every reading of the record and the offline filter."""
        sent = Counter(
            (s.signal, t, v)
            for s in self.record.series
            for t, v in zip(s.time[~s.missing].tolist(), s.value[~s.missing].tolist(), strict=True)
        )
        missing = doubled = 0
        equal = True
        turbines = read_config(self.folder / "track.toml").turbines
        for name in self.names:
            opened = open_store(store, read_only=True)
            rows = queried(opened, "SELECT signal, time, value FROM observation WHERE turbine = ?", (name,))
            opened.close()
            found = Counter(rows)
            missing += (sent - found).total()
            doubled += (found - sent).total()
            try:
                expect_offline(store, self.record, turbines[name], name)
            except AssertionError as difference:
                equal, fault = False, fault or f"{name}: {str(difference).splitlines()[:1]}"
        return Outcome(blows, messages, missing, doubled, equal, words, fault)


def _field(series: Series) -> str:
    unit = SIGNALS[series.signal].unit
    form = f', stamp = "end", interval = "{series.interval_s:g}s"' if series.interval_s else ""
    return (
        f'{series.signal} = {{ signal = "{series.signal}", unit = "{unit}", resolution = '
        f"{series.resolution!r}{form} }}"
    )


def stored(store: str) -> int:
    """How many observations a store holds, looked at from outside; 0 where it is not there or not reached."""
    return looked_at(store, lambda opened: queried(opened, "SELECT COUNT(*) FROM observation")[0][0])


def held(store: str) -> int:
    """How many readings a store holds back, because their stamps are ahead of the clock."""
    return looked_at(store, lambda opened: queried(opened, "SELECT COUNT(*) FROM held")[0][0])


def counted(store: str) -> Counter:
    """What was set aside, by kind."""
    found: Counter = Counter()
    for (_, kind), count in (looked_at(store, lambda opened: opened.counters()) or {}).items():
        found[kind] += count
    return found


def looked_at(store: str, question: Callable) -> object:
    try:
        opened = open_store(store, read_only=True)
    except StoreFault:
        return 0
    try:
        return question(opened)
    except StoreFault:
        return 0
    finally:
        opened.close()


def parts(messages: Sequence[Message], random, count: int) -> list[Sequence[Message]]:
    """Messages in `count` parts of random sizes, none of them empty."""
    cuts = [
        0,
        *sorted(random.choice(range(1, len(messages)), count - 1, replace=False).tolist()),
        len(messages),
    ]
    return [messages[a:b] for a, b in pairwise(cuts)]
