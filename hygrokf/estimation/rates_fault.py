"""Rates of a model that no step can represent: which states have them, and which parameters cause them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.engine.schedule import Unresolved
from hygrokf.engine.step_codegen import DOUBLINGS
from hygrokf.engine.timeline import Timeline
from hygrokf.engine.traced_filter import Recursion
from hygrokf.physics.expression import Expression
from hygrokf.texts.wording import duration_text, stamp_text


class RatesFault(FloatingPointError, ValueError):
    """Rates that no step can represent; the message names the state or the step, and the remedy."""


def unresolved_rates(
    recursion: Recursion, t: Timeline, values: Mapping[str, float], where: Unresolved
) -> RatesFault:
    """The fault of a step that no sub-steps resolve, with the state whose rate is too fast."""
    model = recursion.model
    state = (*model.states, *model.outputs)[where.state]
    rates = recursion.rates if where.state >= recursion.n else [recursion.rates[where.state]]
    hours = float(t.steps[t.key[where.instant], 0])
    return RatesFault(
        f"expected rates that sub-steps resolve, found faster ones of {state} in the step of "
        f"{duration_text(3600.0 * hours)} until {stamp_text(t.origin_s + 3600.0 * t.time[where.instant])}"
        f"{_parameters_of(recursion, rates, values)}: the state leaves every bound, its rate is not finite "
        "there, or it jumps; narrow the bounds of these parameters, or smooth the jump"
    )


def diverging_rates(recursion: Recursion, t: Timeline, values: Mapping[str, float]) -> RatesFault:
    """The fault of rates that are not finite, or too large for any step, with their states."""
    graph, states = recursion.graph, recursion.model.states
    symbols = recursion.symbols(values, (), {name: t.input(name) for name in t.regimes})
    with np.errstate(all="ignore"):
        arrays = {name: np.asarray(value, dtype=float) for name, value in symbols.items()}
        jacobian = [graph.evaluate([graph.lift(v) for v in row], arrays) for row in recursion.jacobian]
    largest_rate = 2.0**DOUBLINGS / t.steps[:, 0].max()
    diverging = [
        i for i, row in enumerate(jacobian) if not all(np.all(np.abs(v) < largest_rate) for v in row)
    ]
    rates = [graph.lift(v) for i in diverging for v in recursion.jacobian[i]]
    return RatesFault(
        f"expected finite rates, found none for {', '.join(states[i] for i in diverging)}"
        f"{_parameters_of(recursion, rates, values)}: narrow the bounds of these parameters, or correct the "
        "inputs that the states follow"
    )


def _parameters_of(recursion: Recursion, rates: Sequence[Expression], values: Mapping[str, float]) -> str:
    """The parameters on which rates depend, with their values, as a phrase of a message."""
    nodes = (recursion.graph.nodes[k] for k in recursion.graph.needed(rates))
    names = [node[1][2:] for node in nodes if node[0] == "symbol" and node[1].startswith("p:")]
    listed = ", ".join(f"{name} = {values[name]:.3g}" for name in names)
    return f" with {listed}" if listed else ""
