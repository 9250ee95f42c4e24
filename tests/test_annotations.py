"""No result holds a sentence: a text in it is declared as a name, unit, path or instant (`texts.terms`)."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import pytest

from hygrokf.climate.study import Study
from hygrokf.discovery.results import DiscoveryResults
from hygrokf.fleet.results import FleetResults
from hygrokf.texts.statement import Code, Statement
from hygrokf.texts.terms import TERMS
from hygrokf.transfer.comparison import ComparisonResults
from hygrokf.transfer.results import TransferResults

RESULTS = (DiscoveryResults, TransferResults, ComparisonResults, Study, FleetResults)
DECLARED = {get_args(one)[1] for one in TERMS}
OWN_FORM = ("Design", "TimeConstant", "ParameterRow")
"""Classes with a form of their own in files, which hold registry entries and no statements; and those of a
fit."""


def texts_in(kind: Any, place: str, seen: set[Any]) -> Iterator[str]:
    """The places of undeclared texts in a type and everything that it holds; keys of mappings are names."""
    origin = get_origin(kind)
    if kind is str:
        yield place
    elif origin is Annotated:
        if not DECLARED.intersection(get_args(kind)[1:]):
            yield from texts_in(get_args(kind)[0], place, seen)
    elif origin in (Union, types.UnionType):
        for one in get_args(kind):
            yield from texts_in(one, place, seen)
    elif origin is Mapping:
        yield from texts_in(get_args(kind)[1], f"{place}.*", seen)
    elif origin in (tuple, list, Sequence):
        for one in get_args(kind):
            yield from texts_in(one, f"{place}[]", seen)
    elif isinstance(kind, type) and issubclass(kind, Statement | Code):
        return
    elif dataclasses.is_dataclass(kind) and kind not in seen and kind.__name__ not in OWN_FORM:
        seen.add(kind)
        hints = get_type_hints(kind, include_extras=True)
        for field in dataclasses.fields(kind):
            yield from texts_in(hints[field.name], f"{kind.__name__}.{field.name}", seen)


@pytest.mark.parametrize("kind", RESULTS, ids=lambda kind: kind.__name__)
def test_a_text_in_a_result_is_declared(kind: type) -> None:
    assert list(texts_in(kind, kind.__name__, set())) == []


@dataclasses.dataclass
class Told:
    """A result with a sentence."""

    words: Mapping[str, tuple[str, ...]]
    statement: Statement
    reason: str | None = None


def test_a_sentence_in_a_result_is_found() -> None:
    assert list(texts_in(Told, "Told", set())) == ["Told.words.*[]", "Told.reason"]
