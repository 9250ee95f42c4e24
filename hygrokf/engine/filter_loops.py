"""The compiled loops of a traced filter, each compiled at first use.

In one of them a free run drives its own controllers: heaters, fans and vents follow the readings that a
logger would show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock

from hygrokf.engine.filter_codegen import Emission, loop_text
from hygrokf.engine.jit import Code
from hygrokf.engine.llvm_writer import SCALAR, Writer, literal
from hygrokf.engine.schedule_codegen import Walk
from hygrokf.engine.traced_filter import Recursion
from hygrokf.engine.wide_loops import WideLoop, wide_loop
from hygrokf.engine.wide_recursion import WideRecursion
from hygrokf.physics.expression import Expression


@dataclass(frozen=True)
class Control:
    """A controller within the loop, which sets a varying input according to the reading a logger would show.

    `input` and `reads` are names; `mean_h` [h] is the logger's averaging interval, 0 for instants.  Its
    position is (reading − a)/(b − a), limited to 0 … 1, with its two levels a and b.  With `idle` it is 0
    except at standstill.
    """

    input: str
    reads: str
    mean_h: float
    idle: bool


def controlled_text(r: Recursion, controls: Sequence[Control]) -> str:
    """LLVM text of the loop: means of a free run, and `positions` (T, c) of the controls in the step that
    leads to each instant.

    The controls read the logger at the start of each step.  `idle` (T,) is 1 at standstill; `levels` (c, 2)
    are those of the controls.
    """
    emission = Emission(r, "controlled", gain=False)
    w = emission.writer
    means = [e.index for e in r.mean]
    slots = emission.slots(r.state)
    emission.load_state(slots, "%state")
    width = len(r.varying)
    walk = None if r.exact else Walk(emission, slots)
    with w.loop("%count") as k:
        key = emission.key_of(k)
        row = w.integer("mul", k, width)
        before = w.integer("sub", row, width)
        begun = {
            r.now[name].index: w.load(SCALAR, w.at(SCALAR, "%u", w.integer("add", before, c)))
            for c, name in enumerate(r.varying)
        }
        if walk is not None:
            walk.known(key)
        leaves = emission.read(slots) | emission.table(key) | begun | emission.at_parameters
        leaves |= {r.reading.index: literal(0.0)}
        shown = [name for _, name in w.block(r.graph, [_shown(r, control) for control in controls], leaves)]
        idle = w.value(f"fcmp ogt double {w.load(SCALAR, w.at(SCALAR, '%idle', k))}, {literal(0.5)}")
        place = w.integer("mul", k, len(controls))
        for c, (control, value) in enumerate(zip(controls, shown, strict=True)):
            if not control.mean_h:  # this is the innovation of a reading of 0
                value = w.value(f"fneg double {value}")
            position = _position(w, control, c, value, idle)
            w.store(SCALAR, position, w.at(SCALAR, "%positions", w.integer("add", place, c)))
            column = w.integer("add", row, r.varying.index(control.input))
            w.store(SCALAR, position, w.at(SCALAR, "%u", column))
        if walk is not None:
            walk.through(k, lambda place, level, times: None)
        else:
            leaves = emission.read(slots) | emission.table(key) | emission.inputs_between(k)
            after = w.block(r.graph, r.predict[: len(means)], leaves | emission.at_parameters)
            for i, (_, name) in zip(means, after, strict=True):
                w.store(SCALAR, name, slots[i])
    emission.save_state(slots, "%state")
    return emission.text()


def _shown(recursion: Recursion, control: Control) -> Expression:
    """The reading that a control follows; for an interval mean, the reading whose running mean grows at the
    state's rate."""
    if control.mean_h:
        place = recursion.model.states.index(f"mean_{control.reads}")
        return recursion.rates[place] * control.mean_h
    return recursion.updates[recursion.model.outputs.index(control.reads)][-3]


def _position(w: Writer, control: Control, c: int, value: str, idle: str) -> str:
    first, second = (w.load(SCALAR, w.at(SCALAR, "%levels", 2 * c + i)) for i in (0, 1))
    zero, one = literal(0.0), literal(1.0)
    share = w.real("fdiv", w.real("fsub", value, first), w.real("fsub", second, first))
    low = w.value(f"select i1 {w.value(f'fcmp ogt double {share}, {zero}')}, double {share}, double {zero}")
    found = w.value(f"select i1 {w.value(f'fcmp olt double {low}, {one}')}, double {low}, double {one}")
    return w.value(f"select i1 {idle}, double {found}, double {zero}") if control.idle else found


_codes: dict[tuple[str, str, bool, tuple[Control, ...]], Code | WideLoop] = {}
"""Loops by structure of the recursion, kind, gain and controls."""
_compiling = Lock()


def filter_loop(
    recursion: Recursion, kind: str, gain: bool = True, controls: tuple[Control, ...] = ()
) -> Code | WideLoop:
    """The compiled function of a kind, and of that name: value, trace, adjoint or tangent.

    Without `gain` the filter runs free.  The kind "controlled" is a free run in which the `controls` follow
    the simulation.
    """
    key = (recursion.structure, kind, gain, controls)
    if key not in _codes:
        with _compiling:
            if key not in _codes:
                source = repr(key)
                if isinstance(recursion, WideRecursion):
                    _codes[key] = wide_loop(recursion, kind, gain, source)
                elif kind == "controlled":
                    _codes[key] = Code(lambda: controlled_text(recursion, controls), [kind], source)
                else:
                    _codes[key] = Code(lambda: loop_text(recursion, kind, gain), [kind], source)
    return _codes[key]
