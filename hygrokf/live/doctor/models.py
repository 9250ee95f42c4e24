"""Models: whether what each one needs is delivered under a name that the mapping has, and whether it ever came."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from collections.abc import Mapping as MappingOf

import numpy as np

from hygrokf.data.signals import SIGNALS
from hygrokf.identification.verdict import REJECT, handed_on
from hygrokf.live.doctor.check import Check, doubt, fault, ok, several
from hygrokf.live.plan import Plan
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.streams import Stream
from hygrokf.live.tracker import AMBIENT_HUMIDITIES, Reading, Tracker, record_of
from hygrokf.live.turbines import Turbine
from hygrokf.modelling.inputs import prepare_run

HOUR_S = 3600.0
TRIED_H = 72
"""[h] of readings that a model is tried on."""


def model_checks(
    turbines: MappingOf[str, Turbine], streams: Sequence[Stream], came: MappingOf[str, Collection[str]]
) -> Iterator[Check]:
    """Every turbine's model; `came` are signals of which the store or a source has readings."""
    fine, unheard = [], []
    for name, one in turbines.items():
        mapped = mapped_signals(name, streams)
        for part, _, found in handed_on(one.verdicts):
            if found.verdict == REJECT:
                yield doubt(
                    f"turbine {name}",
                    f"the {part} time constant of its model is {found.words}: {found.why}",
                    "see the fit's report; what is told of this turbine says that it rests on it",
                )
        wrong = model_fault(one.plan, mapped)
        if wrong is not None:
            yield fault(f"turbine {name}", *wrong)
            continue
        if mapped.isdisjoint(one.plan.model.outputs):
            yield ok(
                f"turbine {name}",
                "no field is a reading of its cabinet: the model alone says what it is like",
            )
        if "operating" in one.plan.model.inputs and "active_power" not in mapped:
            yield doubt(
                f"turbine {name}",
                "the model heats by operation, and no field is active_power: it counts as at standstill",
                "add the field to [mapping.signals]",
            )
        absent = lacking(one.plan, mapped, came.get(name, ()))
        if not came.get(name):
            unheard.append(name)
        elif absent:
            yield doubt(
                f"turbine {name}",
                f"{several(absent)} never came, which its model reads",
                "compare the names in [mapping.signals] with what is delivered",
            )
        else:
            fine.append(name)
    if unheard:
        yield doubt(
            "turbines",
            f"nothing has ever come of {several(unheard)}",
            "compare their known_as with the names that are delivered, or wait longer (--wait 10min)",
        )
    if fine:
        yield ok("turbines", f"{len(fine)} have a model that can be run, and have delivered what it reads")


def mapped_signals(turbine: str, streams: Sequence[Stream]) -> set[str]:
    """Signals of a turbine that some source may deliver."""
    found: set[str] = set()
    for stream in streams:
        fields = stream.mapping.fields
        if stream.mapping.weather:
            continue
        if isinstance(stream, OpcUa):
            found |= {fields[node.field].signal for node in stream.nodes if node.turbine == turbine}
        elif turbine in stream.mapping.turbines.values():
            found |= {one.signal for one in fields.values()}
    return found


def lacking(plan: Plan, mapped: Collection[str], came: Collection[str]) -> list[str]:
    """Signals that a model reads and that are mapped, but never came; of the ambient's humidities any one is enough."""
    inputs = {*plan.model.inputs, *plan.model.outputs, "ambient_temperature"}
    if "operating" in inputs or plan.design.power_order:
        inputs.add("active_power")
    if "ambient_absolute_humidity" in inputs and set(came).isdisjoint(AMBIENT_HUMIDITIES):
        inputs |= set(AMBIENT_HUMIDITIES)
    elif "ambient_absolute_humidity" in inputs:
        inputs -= set(AMBIENT_HUMIDITIES)
    return sorted(inputs & set(mapped) - set(came))


def model_fault(plan: Plan, signals: Collection[str]) -> tuple[str, str] | None:
    """Why a model could not be run on these signals, however many readings come, and what to do; None where it can."""
    times = HOUR_S * np.arange(1.0, TRIED_H)
    values = {name: np.full(len(times), 0.5 * (SIGNALS[name].low + SIGNALS[name].high)) for name in signals}
    awaited = Tracker(
        plan, readings=(Reading(name, 0.0, float(v[0])) for name, v in values.items())
    ).awaited()
    if awaited:
        return f"its model needs {several(awaited)}, and no field is that", "add it to [mapping.signals]"
    try:
        prepare_run(plan.design, record_of(plan, dict.fromkeys(values, times), values))
    except (ValueError, KeyError) as error:
        return (
            f"its model cannot be run on these signals: {error}",
            "mend [mapping.signals] or [[turbine]], or fit anew",
        )
    return None
