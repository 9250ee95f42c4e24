"""The text of every code of verdicts, fits and records by its values; the package uses every code."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import hygrokf
from hygrokf.data.structured import plain, structured
from hygrokf.texts.fit import FitCode
from hygrokf.texts.record import DoubtCode, RecordCode, touched
from hygrokf.texts.statement import Code, Statement
from hygrokf.texts.verdict import ReasonCode

TABLES = {"fit": FitCode, "record": RecordCode, "doubt": DoubtCode, "verdict": ReasonCode}
PACKAGE = Path(hygrokf.__file__).parent


@cache
def rows(table: str) -> dict[str, dict[str, Any]]:
    """Code -> its text, and the values that fill it."""
    return tomllib.loads((Path(__file__).parent / f"{table}.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("table", TABLES)
def test_every_code_has_its_text(table: str) -> None:
    assert list(rows(table)) == [code.key for code in TABLES[table]]
    for key, row in rows(table).items():
        statement = structured(Statement, {"code": key, "values": row.get("values", {})})
        assert statement.text == row["text"]
        assert structured(Statement, plain(statement)) == statement


def test_every_doubt_touches_the_constants_that_it_names_or_that_its_signal_tells() -> None:
    for key, row in rows("doubt").items():
        doubt = structured(Statement, {"code": key, "values": row.get("values", {})})
        assert set(touched(doubt)) <= {"thermal", "hygric"}
    assert touched(DoubtCode.WRONG_UNIT(signal="active_power")) == ("thermal",)
    assert touched(DoubtCode.WRONG_UNIT(signal="ambient_dew_point_temperature")) == ("hygric",)
    assert touched(DoubtCode.WRONG_UNIT(signal="cabinet_temperature")) == ("thermal", "hygric")
    assert touched(DoubtCode.WRONG_UNIT(signal="wind_speed")) == ()
    assert touched(FitCode.NO_POWER()) == ()


@cache
def sources() -> str:
    """All of the package outside of the enumerations."""
    texts = PACKAGE / "texts"
    files = (path for path in sorted(PACKAGE.rglob("*.py")) if path.parent != texts or path.stem == "record")
    return "\n".join(path.read_text(encoding="utf-8") for path in files)


@pytest.mark.parametrize("kind", TABLES.values())
def test_the_package_uses_every_code(kind: type[Code]) -> None:
    used = set(re.findall(rf"\b{kind.__name__}\.([A-Z_]+)\b", sources()))
    assert set(kind.__members__) - used == set()
