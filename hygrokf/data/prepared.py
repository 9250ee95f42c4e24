"""A record with what models read of it, each computed once: vapour, noise, and the paths of its inputs.

The way of an input from its file to the filter: readings (`record`); without the sensor's response, and as a
path between the readings (`input_paths`); the ambient's vapour, its noise, and the course behind it
(`ambient`): all held here; then the instants of a run (`modelling.inputs`).
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
    """A record whose derived series are computed when they are first read, and kept.

    A record made from this one (`replace_series`, `window`) computes its own.
    """

    _paths: dict[tuple[object, ...], Series] = field(default_factory=dict, init=False, compare=False)

    @cached_property
    def ambient_vapour(self) -> Series | None:
        """Vapour concentration outside [kg/m³] at the times of its humidity readings, without the sensor's
        response; None without such readings."""
        return absolute_humidity_at(self, "ambient")

    @cached_property
    def cabinet_vapour(self) -> Series | None:
        """Vapour concentration in the cabinet [kg/m³], as `ambient_vapour`."""
        return absolute_humidity_at(self, "cabinet")

    @cached_property
    def noise(self) -> Mapping[str, Noise]:
        """Noise of the ambient readings that a model reads, by input; for humidity, that of the vapour
        computed from them."""
        series = {"ambient_temperature": self["ambient_temperature"], VAPOUR: self.ambient_vapour}
        estimated = {name: reading_noise(one) for name, one in series.items() if one is not None}
        return {name: noise for name, noise in estimated.items() if noise is not None}

    @cached_property
    def scales(self) -> dict[str, tuple[float, float, float, float]]:
        """The numbers of the gate's scale of every series that has one."""
        known = {one.signal: scale_of(one.signal, *one.known, one.resolution) for one in self.series}
        return {signal: astuple(scale) for signal, scale in known.items() if scale is not None}

    def path(self, name: str) -> Series:
        """The path of a signal's readings as they are, or of the ambient's vapour."""
        if (name,) not in self._paths:
            self._paths[name,] = input_path(self._vapour_or(name))
        return self._paths[name,]

    def course(self, name: str, noise: Noise | None = None) -> Series:
        """The path of a signal or of the ambient's vapour as it drives a model: without the sensor's response
        and, where a design states their `noise`, without that of the readings."""
        if (name, noise) not in self._paths:
            series = smoothed(without_response(self._vapour_or(name)), noise)
            self._paths[name, noise] = input_path(series, noise)
        return self._paths[name, noise]

    def _vapour_or(self, name: str) -> Series:
        vapour = self.ambient_vapour if name == VAPOUR else None
        return self[name] if vapour is None else vapour


def prepare(record: Record) -> PreparedRecord:
    """The record prepared; one that is prepared already is returned as it is."""
    if isinstance(record, PreparedRecord):
        return record
    return PreparedRecord(**{one.name: getattr(record, one.name) for one in fields(Record)})
