"""Statements: their templates, their files, and that codes are unique over the package."""

from __future__ import annotations

import json
import math
import pickle
from collections import Counter
from string import Formatter

import pytest

from hygrokf.data.structured import StructureFault, plain, structured
from hygrokf.texts.reasons import Reason, ReasonCode
from hygrokf.texts.statement import FIELDS_OF_NAMES, Code, Statement
from hygrokf.texts.wording import NONE, signed


class Example(Code):
    FIELDS = "{name} {number:3} {number:.2} {number:+.1} {share:%} {share:.1%} {number:g}"
    TIMES = "{begin:stamp}, {length:duration}"
    WORDS = "{count:.0} {count:reading|readings} of {names} and of {names:and}"
    NESTED = "because {why}"
    LISTS = "{names:several} of {names:words and}, {size:bytes}, {number:4g}, {chance:chance}"


ENUMERATIONS = [kind for kind in Code.__subclasses__() if kind is not Example]


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (-0.004, 2, "0.00"), (0.004, 2, "0.00"), (-0.0, 1, "0.0"), (0.0, 2, "0.00"), (-0.4, 0, "0"),
        (-0.006, 2, "−0.01"), (0.006, 2, "+0.01"), (-12.0, 0, "−12"), (math.nan, 2, NONE),
    ],
)  # fmt: skip
def test_a_difference_has_its_sign_and_a_rounded_zero_has_none(
    value: float, decimals: int, text: str
) -> None:
    assert signed(value, decimals) == text


def test_fields_of_a_template() -> None:
    values = {"name": "heat", "number": -1.2345, "share": 0.1234}
    assert Example.FIELDS(**values).text == "heat −1.23 −1.23 −1.2 12 % 12.3 % −1.2345"
    assert Example.TIMES(begin=86400.0, length=5400.0).text == "1970-01-02T00:00Z, 90 min"
    words = Example.WORDS(count=2, names=("a", "b", "c"))
    assert words.text == "2 readings of a, b, c and of a, b and c"
    assert Example.WORDS(count=1, names=("a",)).text == "1 reading of a and of a"
    assert str(Example.NESTED(why=words)) == f"because {words.text}"


def test_a_page_writes_the_instants_itself() -> None:
    pieces = Example.NESTED(why=Example.TIMES(begin=86400.0, length=5400.0)).pieces
    assert pieces == ("because ", 86400.0, ", ", "90 min")


def test_lists_names_and_sizes() -> None:
    values = {"names": ("a_b", "c_d", *"efgh"), "size": 1.5e6, "number": -8.30679, "chance": 0.999}
    listed = "a_b, c_d, e, f, g and 1 more of a b, c d, e, f, g and h"
    assert Example.LISTS(**values).text == f"{listed}, 1.5 MB, −8.307, over 99 %"
    nested = Example.NESTED(why="x")
    assert Example.LISTS(**values | {"names": (nested, nested)}).text.startswith("because x, because x of")
    several = Example.LISTS(**values | {"names": (nested,)})
    assert structured(Statement, plain(several)) == several


def test_a_statement_survives_its_file_and_a_process() -> None:
    inner = Example.WORDS(count=1.0, names=("a", "b"))
    statement = Example.NESTED(why=inner)
    data = json.loads(json.dumps(plain(statement), allow_nan=False))
    values = {"count": 1.0, "names": ["a", "b"]}
    assert data == {"code": "nested", "values": {"why": {"code": "words", "values": values}}}
    assert structured(Statement, data) == statement == pickle.loads(pickle.dumps(statement))
    unknown = Example.FIELDS(name="x", number=math.nan, share=math.inf)
    assert structured(Statement, json.loads(json.dumps(plain(unknown)))).text == unknown.text


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        ({"code": "never_heard_of", "values": {}}, "expected a code of this version, found 'never_heard_of'"),
        ({"code": 3, "values": {}}, "expected a code of this version, found 3"),
        ({"code": "nested", "values": {"what": 1.0}}, "nested: expected values of why, found"),
        ({"code": "times", "values": {"begin": "7", "length": 1.0}}, "expected values of begin, length"),
        ({"code": "times", "values": {"begin": 1.0, "length": ["a"]}}, "times: expected values of begin"),
        ({"code": "nested", "values": {"why": {}}}, "expected a code with values, found '{}'"),
        ({"code": "nested", "values": "why"}, "expected a code with values, found"),
        ("short record: 3.0 days", "expected a code with values, found 'short record: 3.0 days'"),
    ],
)
def test_a_file_with_an_unknown_code_or_other_values_is_refused(data: object, fault: str) -> None:
    with pytest.raises(StructureFault) as refused:
        structured(Statement, data)
    assert fault in str(refused.value)


def test_a_reason_has_a_code_of_reasons() -> None:
    data = plain(ReasonCode.NOT_VALIDATED())
    with pytest.raises(StructureFault, match="expected a code of this version, found 'nested'"):
        structured(Reason, data | plain(Example.NESTED(why="x")))


def test_codes_are_unique_and_every_template_is_one() -> None:
    assert ReasonCode in ENUMERATIONS
    names = Counter(name for kind in ENUMERATIONS for name in kind.__members__)
    assert {name for name, count in names.items() if count > 1} == set()
    for kind in ENUMERATIONS:
        aliases = {name for name, code in kind.__members__.items() if code.name != name}
        assert not aliases, f"{kind.__name__}: equal templates {aliases}"
        for code in kind:
            fields = [(name, spec) for _, name, spec, _ in Formatter().parse(code.template) if name]
            values = {n: "a name" if spec.split(" ")[0] in FIELDS_OF_NAMES else 1.5 for n, spec in fields}
            assert Statement(code, values).text  # raises for a format that `Code` does not describe
            assert not code.template.endswith("."), code
