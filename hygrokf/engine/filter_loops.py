"""The compiled loops of a traced filter, each compiled at first use."""

from __future__ import annotations

from threading import Lock

from hygrokf.engine.control_loop import Control, controlled_text
from hygrokf.engine.filter_codegen import loop_text
from hygrokf.engine.jit import Code
from hygrokf.engine.traced_filter import Recursion

_codes: dict[tuple[str, str, bool, tuple[Control, ...]], Code] = {}
"""Loops by structure of the recursion, kind, gain and controls."""
_compiling = Lock()


def filter_loop(
    recursion: Recursion, kind: str, gain: bool = True, controls: tuple[Control, ...] = ()
) -> Code:
    """The compiled function of a kind, and of that name: value, trace, adjoint or tangent.

    Without `gain` the filter runs free.  The kind "controlled" is a free run in which the `controls` follow
    the simulation.
    """
    key = (recursion.structure, kind, gain, controls)
    if key not in _codes:
        with _compiling:
            if key not in _codes:
                controlled = kind == "controlled"
                text = (
                    controlled_text(recursion, controls) if controlled else loop_text(recursion, kind, gain)
                )
                _codes[key] = Code(text, [kind])
    return _codes[key]
