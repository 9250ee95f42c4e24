"""The one form of TOML files: what each type of a field accepts; every fault is told with its place."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest
from builders.documents import document

from hygrokf.cases.form import CaseForm, StatedColumn, StatedPeriod, StatedSource, StatedWeather
from hygrokf.climate.chamber import ProfilePlan
from hygrokf.climate.limits import ClimateLimit
from hygrokf.climate.region import PowerCurve, Shear
from hygrokf.data.record import Site
from hygrokf.data.timestamps import duration
from hygrokf.data.toml_form import (
    FormFault,
    Place,
    across,
    entry_name,
    keys_of,
    lines_of,
    read_form,
    read_toml,
    read_toml_form,
    setting,
)
from hygrokf.fleet.fleet_plan import FleetForm, FleetTurbine


@dataclass(frozen=True)
class Node:
    id: str = entry_name()
    field: str = setting(help="of a payload")


@dataclass(frozen=True)
class Row:
    name: str = setting(help="of the row")


@dataclass(frozen=True)
class Box:
    REFUSED: ClassVar = {"password": "no password here"}
    size: float = setting(help="its edge", above=0.0, most=2.0)
    count: int = setting(1, "how many", least=1)
    colour: str = setting("red", "of the paint", choices=("red", "green"))
    title: str | None = setting(None, "in capitals", fits=str.isupper, expected="text in capitals")
    note: str = setting("", "may be empty")
    open: bool = setting(False, "whether it is open")
    names: tuple[str, ...] = setting((), "of the things in it")
    range: tuple[float, float] = setting((0.0, 1.0), "between", least=0.0, most=9.0)
    wait_s: float | None = setting(None, "until it is used", read=duration, least=1.0, expected="1 s or more")
    site: Site | None = setting(None, "where it is")
    row: tuple[Row, ...] = setting((), "tables")
    nodes: Mapping[str, Node] = setting(dict, "named tables")
    rest: Mapping[str, Any] = setting(dict, "anything")

    @across("open", "note")
    def open_needs_a_note(self) -> str | None:
        return "open needs a note" if self.open and not self.note else None


def read(table: dict, place: Place | None = None) -> tuple[Box, list[str]]:
    place = place or Place()
    return read_form(Box, table, place), place.faults


def test_a_whole_table() -> None:
    found, faults = read(
        {
            "size": 1, "count": 2, "colour": "green", "title": "A", "note": "", "names": ["a"],
            "range": [1, 2], "wait": "2min", "site": {"latitude_deg": 54, "longitude_deg": 8},
            "row": [{"name": "x"}, {"name": "y"}], "nodes": {"i=1": {"field": "T"}}, "rest": {"k": [1]},
        }
    )  # fmt: skip
    assert faults == []
    assert found == Box(
        1.0, 2, "green", "A", "", False, ("a",), (1.0, 2.0), 120.0, Site(54.0, 8.0),
        (Row("x"), Row("y")), {"i=1": Node("i=1", "T")}, {"k": [1]},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("size", "1", "size must be a number above 0 and at most 2, found '1'"),
        ("size", True, "size must be a number above 0 and at most 2, found True"),
        ("size", 0, "size must be a number above 0 and at most 2, found 0"),
        ("size", float("nan"), "size must be a number above 0 and at most 2, found nan"),
        ("size", 10**400, "size must be a number above 0 and at most 2, found 1000"),
        ("count", 1.5, "count must be a whole number from 1 on, found 1.5"),
        ("colour", "gren", 'colour must be one of red, green, found "gren"; did you mean "green"'),
        ("colour", ["red"], "colour must be one of red, green, found ['red']"),
        ("title", "a", "title must be text in capitals, found 'a'"),
        ("title", "", "title must be text in capitals, found ''"),
        ("note", 3, "note must be text in quotes, found 3"),
        ("open", 1, "open must be true or false, found 1"),
        ("open", True, "open needs a note"),
        ("names", "a", "names must be a list of texts, found 'a'"),
        ("names", ["a", 1], "names must be a list of texts, found ['a', 1]"),
        ("range", [2, 1], "range must be two rising numbers within 0 … 9, found [2, 1]"),
        ("range", [1, 2, 3], "range must be two rising numbers within 0 … 9, found [1, 2, 3]"),
        ("wait", 3, "wait: expected a duration such as"),
        ("wait", "0s", "wait must be 1 s or more, found '0s'"),
        ("site", 3, "site must be a table [site], found 3"),
        ("site", {"latitude_deg": 99, "longitude_deg": 8}, "[site]: site: latitude_deg must lie within"),
        ("site", {"latitude_deg": 99}, "[site]: needs longitude_deg"),
        ("row", 3, "row: write [[row]] with two brackets, once for each"),
        ("row", {"name": "x"}, "row: write [[row]] with two brackets, once for each"),
        ("row", [{"name": "x"}, {}], "[[row]] 2: needs name, of the row"),
        ("nodes", 3, "nodes must be a table [nodes], found 3"),
        ("nodes", {"i=1": 3}, "[nodes].i=1: expected { field = … }, found 3"),
        ("nodes", {"i=1": {"feld": "T", "field": "T"}}, '[nodes].i=1: unknown key "feld"; expected field'),
        ("rest", 3, "rest must be a table, found 3"),
        ("password", "s3cret", "no password here"),
        ("colur", "red", 'unknown key "colur"; expected size, count,'),
    ],
)
def test_a_fault_says_what_is_expected_and_found(key: str, value: object, said: str) -> None:
    _, (fault,) = read({"size": 1.0, key: value})
    assert fault.startswith(said) and "s3cret" not in fault and len(fault) < 300


def test_all_faults_at_once_each_with_its_table() -> None:
    found, faults = read({"count": 0, "row": [{}], "colur": 1}, Place("[box]", of=" of this box"))
    assert faults == [
        '[box]: unknown key "colur" of this box; expected '
        + ", ".join(keys_of(Box))
        + '; did you mean "colour" or "count"?',
        "[box]: needs size, its edge",
        "[box]: count must be a whole number from 1 on, found 0",
        "[[row]] 1: needs name, of the row",
    ]
    assert found.count == 1 and found.colour == "red"  # a value at fault is replaced by its default


def test_a_check_across_keys_waits_until_all_of_them_are_sound() -> None:
    assert read({"size": 1.0, "open": True, "note": 3})[1] == ["note must be text in quotes, found 3"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"a = ", "line 1, at the end: not valid TOML"),
        (b"a = 1\n[a]\nb = ", "line 2, column 3: not valid TOML"),
        (b"a = 1\n b == 2", "line 2, column 5: not valid TOML"),
        (b"[row]\n[row]\n", "write [[row]] with two brackets, once for each"),
        (b"a = " + b"[" * 20_000, "not valid TOML"),
        (b"\xff\x00", "expected TOML text in UTF-8, found other bytes"),
    ],
)
def test_what_is_no_toml_is_told_with_its_line(tmp_path: Path, text: bytes, said: str) -> None:
    file = tmp_path / "box.toml"
    file.write_bytes(text)
    with pytest.raises(FormFault, match=re.escape(said)) as found:
        read_toml(file)
    assert str(found.value).startswith(f"{file}: 1 fault\n  1. ")


def test_a_file_is_read_or_missed(tmp_path: Path) -> None:
    file = tmp_path / "box.toml"
    file.write_bytes("\ufeffsize = 1\r\n".encode())
    assert read_toml_form(Box, file) == Box(1.0)
    with pytest.raises(FormFault, match=r'check the path; did you mean "box.toml"\?'):
        read_toml(tmp_path / "bx.toml")
    with pytest.raises(FormFault, match="cannot be read: Is a directory"):
        read_toml(tmp_path)


FORMS = [
    ("case_file.md", (CaseForm, Site, StatedPeriod, StatedSource, StatedColumn)),
    ("weather.md", (StatedWeather,)),
    ("fleet.md", (FleetForm, FleetTurbine)),
    ("climate.md", (PowerCurve, Shear)),
    ("climate.md", (ClimateLimit,)),
    ("climate_test.toml", (ProfilePlan, *(kind for _, _, kind in keys_of(ProfilePlan).values()))),
]


@pytest.mark.parametrize(("page", "forms"), FORMS)
def test_every_key_stands_in_its_page(page: str, forms: tuple[type, ...]) -> None:
    """Those of the tracker's file: tests/test_live_docs.py; options of a fleet's task: tests/fleet."""
    text = document(page).read_text(encoding="utf-8")
    keys = [key for form in forms for key in keys_of(form)]
    assert [key for key in keys if not re.search(rf"(^|[`\[{{ .]){key}[`\]\" =]", text, re.MULTILINE)] == []
    assert [key for form in forms for key, (_, stated, _) in keys_of(form).items() if not stated.help] == []


LINED = """\
store = "sqlite:live.db"
[[turbine]]
name = "W01"
site = { latitude_deg = 54.0 }

[[turbine]]  # the second one
name = "W02"
[turbine.site]
latitude_deg = 54.0
[mapping.signals]
"air.T" = { signal = "x" }
[[source]]
url = "stdin"
[source.mapping]
time = "t"
[source.mapping.signals]
T.unit = "K"
"""


def test_tables_and_keys_have_their_lines() -> None:
    found = lines_of(LINED)
    assert found[("store",)] == 1 and found["turbine", 1] == 6 and found["turbine", 1, "name"] == 7
    assert found["turbine", 1, "site", "latitude_deg"] == 9 and found["mapping", "signals", "air.T"] == 11
    assert found["source", 0, "mapping", "time"] == 15
    assert found["source", 0, "mapping", "signals", "T", "unit"] == 17


def test_places_name_the_line_of_the_first_key_that_is_there() -> None:
    place = Place(lines=lines_of(LINED))
    assert place.at("page", "store") == "line 1" and place.at("page") == ""
    assert place.inside("turbine", 1).at("fit", "name") == "line 7, [[turbine]] 2"
    assert place.inside("turbine", 0).inside("site").at("latitude_deg") == "line 4, [[turbine]] 1 site"
    own = place.inside("source", 0).inside("mapping")
    assert own.at("time") == "line 15, [[source]] 1 mapping"
    assert own.at("tag") == "line 14, [[source]] 1 mapping"
    entry = place.inside("mapping").inside("signals", entry="air.T")
    assert entry.at("unit") == "line 11, [mapping] signals.air.T"
    own.fault("wrong", "tag")
    assert place.faults == ["line 14, [[source]] 1 mapping: wrong"]
