"""The [[source]] of an MQTT broker: payloads for the mapping, or Sparkplug B."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hygrokf.data.toml_form import Place, across, setting
from hygrokf.live.sources.broker import BrokerForm
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.mqtt_link import libraries_fault
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.sparkplug import Sparkplug
from hygrokf.live.sources.sparkplug_metrics import NAMESPACE

MAPPED, SPARKPLUG = "mapped", "sparkplug-b"
FORMATS = (MAPPED, SPARKPLUG)
"""Payloads that the mapping reads as they are, or messages of Sparkplug B."""


@dataclass(frozen=True)
class MqttForm(BrokerForm):
    """A [[source]] of `mqtt://[USER@]HOST[:PORT]`, or `mqtts://` for TLS."""

    format: str = setting(MAPPED, "of the messages", choices=FORMATS)
    rebirth_requests: bool = setting(False, "whether edge nodes are asked for their birth certificates")

    @across("format", "rebirth_requests")
    def requests_of_sparkplug(self) -> str | None:
        if self.format == SPARKPLUG or not self.rebirth_requests:
            return None
        return f'rebirth_requests: only with format = "{SPARKPLUG}"'

    @across("format", "weather")
    def readings_of_sparkplug(self) -> str | None:
        wrong = self.format == SPARKPLUG and self.weather
        return f'weather: not with format = "{SPARKPLUG}"' if wrong else None

    @across("format", "topics")
    def topics_of_sparkplug(self) -> Iterator[str]:
        for one in self.topics if self.format == SPARKPLUG else ():
            levels = one.split("/")
            if levels[0] == "$share":
                yield f"topics: a share has gaps in the sequence of every edge node, found {one!r}"
            elif levels[0] != NAMESPACE or ("#" not in levels[1:3] and levels[2:3] != ["+"]):
                yield (
                    f"topics: births, data and deaths are needed: write {NAMESPACE}/GROUP/# or "
                    f"{NAMESPACE}/GROUP/+/NODE/#, found {one!r}"
                )

    def stream(self, folder: Path, mapping: PayloadMapping, place: Place) -> Mqtt | None:
        """The stream, or None with faults."""
        missing = libraries_fault()
        if missing is not None:
            place.fault(missing)
        broker = self.broker(folder, place)
        if missing is not None:
            return None
        if self.format == SPARKPLUG:
            return Sparkplug(broker, mapping, self.rebirth_requests)
        return Mqtt(broker, mapping)
