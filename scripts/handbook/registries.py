"""Pages of the mechanisms, the causes and the columns of a fleet, made of the registries."""

from __future__ import annotations

import inspect
import math
from dataclasses import replace
from functools import cache

from handbook.docstrings import heading, prose_and_equations, rst, table
from hygrokf.discovery.own_causes import trial_ground
from hygrokf.fleet.tasks import SHARED_COLUMNS, TASKS
from hygrokf.modelling.causes.cause import Cause
from hygrokf.modelling.causes.forms import Ground
from hygrokf.modelling.library import CAUSES
from hygrokf.physics.mechanisms import BASE, FURTHER, LOGGED, MECHANISMS, WANDERING, Factory
from hygrokf.physics.model import Mechanism
from hygrokf.physics.parameters import Parameter
from hygrokf.report.discovery_text import form_words

GROUPS: dict[str, tuple[str, str, tuple[Factory, ...]]] = {
    "base": ("Base models", "The two networks of the paper, their disturbances and the sensors.", BASE),
    "logged": ("Logged actuators", "Effects of actuators that the record contains.", LOGGED),
    "further": ("Further physics", "What may act beside the base models.", FURTHER),
    "tracking": ("Tracking", "Properties of the cabinet as wandering states.", WANDERING),
}
"""Key of the page → title, sentence, factories."""


def number(value: float) -> str:
    """A number of a table; infinite limits as signs."""
    if math.isinf(value):
        return "−∞" if value < 0 else "∞"
    return f"{value:.4g}".replace("-", "−")


def made(factory: Factory) -> Mechanism:
    """The mechanism with its default settings."""
    return factory()


def parameter_row(one: Parameter) -> list[str]:
    """name, unit, start, range of the search, null value, meaning."""
    return [
        f"``{one.name}``", rst(one.unit), number(one.start), f"{number(one.lower)} … {number(one.upper)}",
        "" if one.null is None else number(one.null), rst(one.meaning),
    ]  # fmt: skip


def mechanism_section(factory: Factory) -> str:
    """Equation, parameters with null values, states, inputs, what its absence leaves, and the source."""
    one = made(factory)
    lines = [f".. _mechanism-{factory.__name__}:", "", heading(factory.__name__, "-")]
    lines += [prose_and_equations(factory.__doc__ or ""), ""]
    if one.parameters:
        head = ("parameter", "unit", "start", "search", "null", "meaning")
        lines += [table(head, map(parameter_row, one.parameters), "24 10 8 16 8 34"), ""]
    settings = str(inspect.signature(factory)).partition(" ->")[0].replace("'", "")
    facts = {
        "What it is": rst(one.meaning),
        "Null value": _null(one),
        "Its absence leaves": rst(one.leaves),
        "States": ", ".join(f"``{name}``" for name in one.states),
        "Inputs": ", ".join(f"``{name}``" for name in one.inputs),
        "Settings": f"``{settings[1:-1]}``" if len(settings) > 2 else "",
        "Source": rst(one.source),
        "Causes": ", ".join(
            f":ref:`{cause.name} <cause-{cause.name}>`"
            for cause in CAUSES
            if factory.__name__ in mechanisms_of(cause)
        ),
        "Module": f"``{factory.__module__}``",
    }
    lines += [f":{key}: {value}" for key, value in facts.items() if value]
    return "\n".join([*lines, "", ""])


def _null(one: Mechanism) -> str:
    """The values at which the mechanism has no effect."""
    return ", ".join(f"``{p.name}`` = {number(p.null)}" for p in one.parameters if p.null is not None)


@cache
def _ground() -> Ground:
    """A record with every signal but a door's contact: without one, openings are sought."""
    ground = trial_ground()
    series = tuple(one for one in ground.record.series if one.signal != "door_open")
    return replace(ground, record=replace(ground.record, series=series))


def mechanisms_of(cause: Cause) -> tuple[str, ...]:
    """Names of the mechanisms that the forms of a cause add."""
    found = {name for form in cause.forms(_ground()) for name, _ in (*form.heat, *form.vapour)}
    return tuple(name for name in MECHANISMS if name in found)


def cause_section(cause: Cause) -> str:
    """What a cause is, its forms, its mechanisms with null values and traces, and what to check."""
    names = mechanisms_of(cause)
    lines = [f".. _cause-{cause.name}:", "", heading(cause.name, "-")]
    lines += [f"{rst(cause.meaning[:1].upper() + cause.meaning[1:])}.", ""]
    forms = {
        "stamps of one source moved" if form.clock else form_words(form.code): form
        for form in cause.forms(_ground())
    }
    facts = {
        "Forms (settings)": rst("; ".join(f"{words} ({len(form.grid)})" for words, form in forms.items())),
        "Needs": rst(cause.needs),
        "To check": rst(cause.remedy),
        "Told apart by": rst(cause.separate_by),
    }
    lines += [f":{key}: {value}" for key, value in facts.items() if value]
    if names:
        rows = [
            [
                f":ref:`{name} <mechanism-{name}>`",
                _null(made(MECHANISMS[name])),
                rst(made(MECHANISMS[name]).leaves),
            ]
            for name in names
        ]
        head = ("mechanism (equation there)", "null value", "its absence leaves")
        lines += ["", table(head, rows, "30 30 40")]
    else:
        lines += [
            "",
            "It adds no mechanism: it changes how readings are taken; its null is the record as it is.",
        ]
    return "\n".join([*lines, "", ""])


def fleet_columns() -> str:
    """Columns of the table that `hygrokf fleet` writes, by task."""
    lines = [
        heading("Columns of a fleet", "="),
        "The columns of ``fleet.csv``, made of the registry when the site is built. A cell is empty if the",
        "value is unknown, not applicable or not bounded. Fleets: :doc:`/how_to/fleet`.",
        "",
    ]
    named = {"every task": SHARED_COLUMNS, **{f"``{name}``": task.columns for name, task in TASKS.items()}}
    for title, columns in named.items():
        rows = [[f"``{name}``", rst(meaning)] for name, meaning in columns.items()]
        lines += [heading(f"Columns of {title}", "-"), table(("column", "meaning"), rows, "40 60"), ""]
    return "\n".join(lines)


def pages() -> dict[str, str]:
    """Pages of the registries by their name under docs/generated."""
    found = {}
    for key, (title, sentence, factories) in GROUPS.items():
        sections = [mechanism_section(factory) for factory in factories]
        head = [heading(f"Mechanisms: {title.lower()}", "="), sentence, ""]
        found[f"mechanisms/{key}"] = "\n".join([*head, *sections])
    index = [
        heading("Mechanisms", "="),
        "A model is a tuple of mechanisms. Model units are h, K, g/m³ and 1; a heat release is the",
        "temperature difference [K] that it sustains across :math:`R_{AT}`. At its null value a mechanism",
        "has no effect.",
        "These pages are made of the registry when the site is built.",
        "",
    ]
    for title, sentence, factories in GROUPS.values():
        rows = [[f":ref:`{f.__name__} <mechanism-{f.__name__}>`", rst(made(f).meaning)] for f in factories]
        index += [heading(title, "-"), sentence, "", table(("mechanism", "what it is"), rows, "35 65"), ""]
    entries = [f"   {title} <{key}>" for key, (title, _, _) in GROUPS.items()]
    index += [".. toctree::", "   :hidden:", "", *entries]
    found["mechanisms/index"] = "\n".join([*index, ""])
    head = [
        heading("Causes", "="),
        "The library that ``hygrokf discover`` searches, made of the registry when the site is built. How",
        "causes are tried and accepted: :doc:`/explanation/discover`. A cause of your own:",
        ":doc:`/how_to/own_cause`.",
        "",
    ]  # fmt: skip
    found["causes"] = "\n".join([*head, *(cause_section(cause) for cause in CAUSES)])
    found["fleet_columns"] = fleet_columns()
    return found
