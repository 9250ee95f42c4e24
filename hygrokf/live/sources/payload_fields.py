"""Fields of payloads: which signal a name stands for, and how its numbers become SI values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hygrokf.data.numbers import Meaning
from hygrokf.data.signals import signal_named, to_si
from hygrokf.live.plan import Form


@dataclass(frozen=True)
class Field:
    """A value in a payload: its signal, its unit, the form of its readings, and what its stamp marks.

    `stamp`: "instant", or "start", "middle" or "end" of the averaging interval.  The value in `unit` is
    `scale` times the number in the payload plus `offset`.  `one`: the text of a flag that is 1.
    """

    signal: str
    unit: str
    form: Form = field(default_factory=Form)
    stamp: str = "instant"
    scale: float = 1.0
    offset: float = 0.0
    one: str = ""

    @property
    def shift_s(self) -> float:
        """[s] from the stamp to the end of the interval."""
        return {"start": 1.0, "middle": 0.5}.get(self.stamp, 0.0) * self.form.interval_s

    @property
    def conversion(self) -> Conversion:
        """The conversion of its numbers.  Raises ValueError for a unit that does not fit the signal."""
        zero, one = to_si(np.array([self.offset, self.scale + self.offset]), self.unit, self.signal).tolist()
        row = signal_named(self.signal)
        slack = 1e-9 * (row.high - row.low)
        meaning = Meaning(self.signal, self.unit, self.one)
        return Conversion(
            self.signal, one - zero, zero, self.shift_s, row.low - slack, row.high + slack, meaning
        )


class Conversion(NamedTuple):
    """Converts a field to a reading: value = factor * number + offset [SI unit], valid within `low` … `high`.

    `shift_s` [s] is added to the stamp; `meaning`: of texts.
    """

    signal: str
    factor: float
    offset: float
    shift_s: float
    low: float
    high: float
    meaning: Meaning
