"""A record with the derived series that models read, each computed once: vapour, noise, paths of the inputs.

An input passes these stages from its file to the filter: readings (`record`); corrected for the sensor's
response and as a path between the readings (`input_paths`); for the ambient, the vapour, the noise and the
smoothed course (`ambient`); the instants of a run (`modelling.inputs`).  This module keeps all but the last.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field, fields
from functools import cached_property

from hygrokf.data.ambient import absolute_humidity_at, reading_noise, smoothed
from hygrokf.data.gate import scale_of
from hygrokf.data.input_paths import input_path, without_response
from hygrokf.data.record import Record, Series

VAPOUR = "ambient_absolute_humidity"
Noise = tuple[float, float]
"""(q, r) of `ambient.reading_noise`."""


@dataclass(frozen=True, repr=False)
class PreparedRecord(Record):
    """A record that computes its derived series when they are first read, and keeps them.

    A record made from it (`replace_series`, `window`) computes them anew.
    """

    _paths: dict[tuple[object, ...], Series] = field(default_factory=dict, init=False, compare=False)

    @cached_property
    def ambient_vapour(self) -> Series | None:
        """Vapour concentration outside [kg/m³] at the times of its humidity readings; None without such
        readings.

        The sensor's response is removed.
        """
        return absolute_humidity_at(self, "ambient")

    @cached_property
    def cabinet_vapour(self) -> Series | None:
        """Vapour concentration in the cabinet [kg/m³], as `ambient_vapour`."""
        return absolute_humidity_at(self, "cabinet")

    @cached_property
    def noise(self) -> Mapping[str, Noise]:
        """Noise (q, r) of the ambient inputs, by input; for humidity that of the vapour computed from the
        readings."""
        series = {"ambient_temperature": self["ambient_temperature"], VAPOUR: self.ambient_vapour}
        estimated = {name: reading_noise(item) for name, item in series.items() if item is not None}
        return {name: noise for name, noise in estimated.items() if noise is not None}

    @cached_property
    def scales(self) -> dict[str, tuple[float, float, float, float]]:
        """The numbers of the `gate.Scale` of every series that has one, by signal."""
        scales = {s.signal: scale_of(s.signal, *s.known, s.resolution) for s in self.series}
        return {signal: astuple(scale) for signal, scale in scales.items() if scale is not None}

    def path(self, name: str) -> Series:
        """Return the path between a signal's readings, without correction; `VAPOUR` stands for the ambient
        vapour."""
        if (name,) not in self._paths:
            self._paths[name,] = input_path(self._vapour_or(name))
        return self._paths[name,]

    def course(self, name: str, noise: Noise | None = None) -> Series:
        """Return the path of a signal as a model's input: corrected for the sensor's response and smoothed.

        noise: (q, r) of the readings that a design states; None: not smoothed.
        """
        if (name, noise) not in self._paths:
            series = smoothed(without_response(self._vapour_or(name)), noise)
            self._paths[name, noise] = input_path(series, noise)
        return self._paths[name, noise]

    def _vapour_or(self, name: str) -> Series:
        """Return the ambient vapour for `VAPOUR` if the record has humidity, else the series of the
        signal."""
        vapour = self.ambient_vapour if name == VAPOUR else None
        return self[name] if vapour is None else vapour


def prepare(record: Record) -> PreparedRecord:
    """Return the record as a `PreparedRecord`; unchanged if it is one already."""
    if isinstance(record, PreparedRecord):
        return record
    return PreparedRecord(**{item.name: getattr(record, item.name) for item in fields(Record)})
