"""A result holds no text but names, units, instants and the like, declared as such, and codes."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Annotated, Any, get_args, get_origin

import numpy as np
import pytest

from hygrokf.cases.summary import RecordSummary
from hygrokf.climate.study import Study
from hygrokf.discovery.discovery_results import DiscoveryResults
from hygrokf.fleet.fleet_results import FleetResults
from hygrokf.identification.fit_on_record import Evaluation, SimulationSummary
from hygrokf.identification.fit_results import FitResults
from hygrokf.modelling.design import Design
from hygrokf.modelling.library import Library
from hygrokf.texts import terms
from hygrokf.texts.statement import Statement
from hygrokf.transfer.comparison import ComparisonResults
from hygrokf.transfer.transfer_results import TransferResults
from hygrokf.weather import clock_comparison

LEAVES = {float, int, bool, type(None), np.ndarray}
DECLARED = {get_args(term)[1] for term in terms.TERMS}


def texts(annotation: Any, place: str, seen: set[type]) -> Iterator[str]:
    """The places of undeclared texts in an annotation and in all that it reaches."""
    origin, args = get_origin(annotation), get_args(annotation)
    if annotation is str or (origin is Annotated and not DECLARED.intersection(args[1:])):
        yield place
    elif annotation in LEAVES or origin in (typing.Literal, Annotated) or annotation is Ellipsis:
        return
    elif isinstance(annotation, type) and issubclass(annotation, (Enum, Statement, Library)):
        return
    elif dataclasses.is_dataclass(annotation):
        yield from fields(annotation, seen)
    elif isinstance(origin, type) and issubclass(origin, Mapping):
        if args[1] is not Any:  # the settings of a mechanism are its own; a key is a name
            yield from texts(args[1], place, seen)
    elif origin in (tuple, typing.Union, types.UnionType):
        for one in args:
            yield from texts(one, place, seen)
    else:
        raise TypeError(f"{place}: expected a kind of result, found {annotation}")


def fields(kind: type, seen: set[type]) -> Iterator[str]:
    """The places of undeclared texts among the fields of a result."""
    if kind in seen:
        return
    seen.add(kind)
    names = {"DataFrame": object}  # imported for type checkers alone
    hints = typing.get_type_hints(kind, localns=names, include_extras=True)
    for one in dataclasses.fields(kind):
        yield from texts(hints[one.name], f"{kind.__name__}.{one.name}", seen)


RESULTS = (
    FitResults, Evaluation, SimulationSummary, RecordSummary, DiscoveryResults, TransferResults,
    ComparisonResults, Study, FleetResults,
)  # fmt: skip


@pytest.mark.parametrize("kind", RESULTS)
def test_texts_of_a_result_are_declared(kind: type) -> None:
    seen: set[type] = set()
    assert list(fields(kind, seen)) == []
    assert Design in seen or kind is not FitResults
    assert clock_comparison.Alignment in seen or kind is not RecordSummary


def test_an_undeclared_text_is_found() -> None:
    @dataclasses.dataclass
    class Inner:
        sentence: tuple[str, ...]
        name: terms.Name

    members = [("inner", Mapping[str, Inner | None]), ("odd", Annotated[str, "anything"])]
    outer = dataclasses.make_dataclass("Outer", members)
    assert list(texts(Inner | None, "", set())) == ["Inner.sentence"]
    assert sorted(fields(outer, set())) == ["Inner.sentence", "Outer.odd"]
