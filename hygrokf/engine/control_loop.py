"""A free run that drives its own controllers, as a compiled loop: heaters, fans and vents follow what a logger would show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hygrokf.engine.llvm_writer import SCALAR, Writer, literal

if TYPE_CHECKING:
    from hygrokf.engine.filter_codegen import Emission
    from hygrokf.engine.traced_filter import Recursion
    from hygrokf.physics.expression import Expression


@dataclass(frozen=True)
class Control:
    """A controller within the loop: it sets a varying input by what a logger would show of an output.

    `input`, `reads` names; `mean_h` [h] over which the logger takes means, 0 for none.  `proportional`: its position is
    (reading − a)/(b − a), within 0 and 1, of its two levels.  Else it is 1 from a reading beyond a on until one beyond b, on
    the other side: `rising` for one that starts above and stops below; `idle`: 0 but at standstill.
    """

    input: str
    reads: str
    mean_h: float
    proportional: bool
    rising: bool = True
    idle: bool = False


def write_controlled(emission: Emission, controls: Sequence[Control]) -> None:
    """Means of a free run; `positions` (T, c) of the controls in the step that leads to each instant.

    Before each step the controls look at what the logger would show where it begins; `idle` (T,) is 1 at standstill, `levels`
    (c, 2) are theirs.
    """
    w, r = emission.writer, emission.recursion
    means = [e.index for e in r.mean]
    slots = emission.slots(r.state)
    emission.load_state(slots, "%state")
    width = len(r.varying)
    with w.loop("%count") as k:
        key, parts = emission.instant_keys(k)
        row = w.integer("mul", k, width)
        before = w.integer("sub", row, width)
        begun = {
            r.now[name].index: w.load(SCALAR, w.at(SCALAR, "%u", w.integer("add", before, c)))
            for c, name in enumerate(r.varying)
        }
        leaves = emission.read(slots) | emission.table(key) | begun | emission.at_parameters
        leaves |= {r.reading.index: literal(0.0)}
        shown = [name for _, name in w.block(r.graph, [_shown(r, one) for one in controls], leaves)]
        idle = w.value(f"fcmp ogt double {w.load(SCALAR, w.at(SCALAR, '%idle', k))}, {literal(0.5)}")
        place = w.integer("mul", k, len(controls))
        for c, (control, value) in enumerate(zip(controls, shown, strict=True)):
            if not control.mean_h:  # the innovation of a reading of 0
                value = w.value(f"fneg double {value}")
            position = _position(w, control, c, value, begun[r.now[control.input].index], idle)
            w.store(SCALAR, position, w.at(SCALAR, "%positions", w.integer("add", place, c)))
            column = w.integer("add", row, r.varying.index(control.input))
            w.store(SCALAR, position, w.at(SCALAR, "%u", column))
        with w.loop(parts) as j:
            leaves = emission.read(slots) | emission.table(key) | emission.inputs_within(k, j, parts)
            after = w.block(r.graph, r.predict.outputs[: len(means)], leaves | emission.at_parameters)
            for i, (_, name) in zip(means, after, strict=True):
                w.store(SCALAR, name, slots[i])
    emission.save_state(slots, "%state")


def _shown(recursion: Recursion, control: Control) -> Expression:
    """What the logger shows to a control: a mean's is the reading whose running mean grows at this rate."""
    if control.mean_h:
        place = recursion.system.states.index(f"mean_{control.reads}")
        return recursion.rates[place] * control.mean_h
    names = [name for name, _ in recursion.system.outputs]
    return recursion.updates[names.index(control.reads)].outputs[-3]


def _position(w: Writer, control: Control, c: int, value: str, before: str, idle: str) -> str:
    first, second = (w.load(SCALAR, w.at(SCALAR, "%levels", 2 * c + i)) for i in (0, 1))
    zero, one = literal(0.0), literal(1.0)
    if control.proportional:
        share = w.real("fdiv", w.real("fsub", value, first), w.real("fsub", second, first))
        low = w.value(
            f"select i1 {w.value(f'fcmp ogt double {share}, {zero}')}, double {share}, double {zero}"
        )
        return w.value(f"select i1 {w.value(f'fcmp olt double {low}, {one}')}, double {low}, double {one}")
    above, below = ("ogt", "olt") if control.rising else ("olt", "ogt")
    started = w.value(f"fcmp {above} double {value}, {first}")
    stopped = w.value(f"fcmp {below} double {value}, {second}")
    if control.idle:
        stopped = w.value(f"or i1 {stopped}, {w.value(f'xor i1 {idle}, true')}")
    on = w.value(f"select i1 {started}, double {one}, double {before}")
    return w.value(f"select i1 {stopped}, double {zero}, double {on}")
