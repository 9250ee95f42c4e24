"""Lines of a TOML file: every table and key is found where it stands."""

from __future__ import annotations

from hygrokf.data.toml_form import Place, lines_of

TEXT = """\
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
    found = lines_of(TEXT)
    assert found[("store",)] == 1 and found["turbine", 1] == 6 and found["turbine", 1, "name"] == 7
    assert found["turbine", 1, "site", "latitude_deg"] == 9 and found["mapping", "signals", "air.T"] == 11
    assert found["source", 0, "mapping", "time"] == 15
    assert found["source", 0, "mapping", "signals", "T", "unit"] == 17


def test_places_name_the_line_of_the_first_key_that_is_there() -> None:
    place = Place(lines=lines_of(TEXT))
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
