"""The tracker's file: what it gives, and that every fault is told at once and in words."""

from __future__ import annotations

from pathlib import Path

import pytest
from builders.track_case import write_model

from hygrokf.live.config import Config, ConfigFault, read_config
from hygrokf.live.web.page_settings import PageSettings

WHOLE = """\
store = "sqlite:live.db"
page = "127.0.0.1:8090"
lateness = "20min"
retention = "90d"
[[turbine]]
name = "T07"
fit = "T07"
known_as = ["plant/7", "T-07"]
cold_surface = { follows = 0.1, offset_K = -0.5 }
site = { latitude_deg = 54.0, longitude_deg = 8.0 }
rated_power_kW = 2050
[[turbine]]
name = "T08"
fit = "T07"
lateness = "1h"
humidity_limit = 0.7
stale = "30min"
[mapping]
turbine = "{1}"
time = "t"
quality = "q"
good = ["Good", 192]
[mapping.signals]
Tcab = { signal = "cabinet_temperature", unit = "degC", accuracy = 0.3 }
RHcab = { signal = "cabinet_relative_humidity", unit = "%", accuracy = 2.0 }
P = { signal = "active_power", unit = "kW", stamp = "start", interval = "10min" }
"env.T" = { signal = "ambient_temperature", unit = "degC" }
[[source]]
url = "file:live.csv"
[[source]]
url = "stdin"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_model(tmp_path / "T07")
    return tmp_path


def read(folder: Path, text: str) -> Config:
    file = folder / "track.toml"
    file.write_text(text, encoding="utf-8")
    return read_config(file)


def faults(folder: Path, text: str) -> str:
    with pytest.raises(ConfigFault) as fault:
        read(folder, text)
    assert all(line.startswith(("track.toml: ", str(folder))) for line in str(fault.value).splitlines())
    return str(fault.value)


def test_a_password_in_the_store_s_url_is_told_and_not_shown(folder: Path) -> None:
    said = faults(folder, WHOLE.replace("sqlite:live.db", "postgresql://me:geheim@host/live"))
    assert "store: the password does not belong" in said and "geheim" not in said
    assert read(folder, WHOLE.replace("sqlite:live.db", "postgresql://me@host/live")).store.endswith(
        "me@host/live"
    )


def test_a_whole_file(folder: Path) -> None:
    found = read(folder, WHOLE)
    assert list(found.turbines) == ["T07", "T08"]
    first, second = found.turbines.values()
    assert (first.plan.lateness_s, second.plan.lateness_s) == (1200.0, 3600.0)
    assert (first.surface.follows, first.surface.offset_K, second.surface.follows) == (0.1, -0.5, 0.3)
    assert first.plan.site.latitude_deg == 54.0 and first.plan.rated_power_W == 2.05e6
    assert first.errors["thermal_time_constant"] == pytest.approx(0.1 / 2.0)
    assert (
        "log_thermal_change" in first.plan.model.states and "log_hygric_change" not in first.plan.model.states
    )
    assert (found.turbines["T08"].limit, found.turbines["T08"].stale_s) == (0.7, 1800.0)
    assert (first.limit, first.stale_s) == (0.8, 7200.0)
    mapping = found.streams[0].mapping
    assert mapping.turbines == {"plant/7": "T07", "T-07": "T07", "T08": "T08"}
    assert [mapping.vocabulary.judge(one) for one in ("GOOD", 192.0, 0)] == ["good", "good", "bad"]
    assert mapping.turbine == "{1}"
    power = mapping.fields["P"]
    assert (power.form.hold, power.form.interval_s, power.shift_s) == ("mean", 600.0, 600.0)
    assert mapping.fields["Tcab"].form.accuracy == 0.3
    assert mapping.fields["RHcab"].form.accuracy == pytest.approx(0.02)
    assert found.page == PageSettings("127.0.0.1", 8090)
    assert found.store == f"sqlite:{folder / 'live.db'}" and found.retention_s == 90 * 86400.0
    assert [one.url for one in found.streams] == [f"file:{folder / 'live.csv'}", "stdin"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("store =", "stroe ="), 'unknown key "stroe"'),
        (('page = "127.0.0.1:8090"', 'page = "8090"'), "page must be HOST:PORT"),
        (('page = "127.0.0.1:8090"', 'page = { address = "0.0.0.0:80" }'), "other machines reach 0.0.0.0"),
        (('lateness = "20min"', 'lateness = "soon"'), "lateness"),
        (('retention = "90d"', 'retention = "1d"'), "at least 7 d"),
        (('name = "T08"', 'name = "T07"'), "a second turbine is named 'T07'"),
        (('name = "T08"', 'name = ""'), "1 to 100 printable characters"),
        (('name = "T08"\nfit = "T07"', 'name = "T08"\nfit = "none"'), "none"),
        (('name = "T08"\nfit = "T07"', 'name = "T08"'), "needs fit, its model"),
        (("humidity_limit = 0.7", "humidity_limit = 70"), "and at most 1"),
        (('stale = "30min"', 'stale = "never"'), "stale"),
        (("follows = 0.1", "follows = 1.5"), "within 0 … 1"),
        (("follows = 0.1", 'follows = "much"'), "must be a number"),
        (("latitude_deg = 54.0", "latitude_deg = 154.0"), "[[turbine]] 1 site: latitude_deg must"),
        (('known_as = ["plant/7", "T-07"]', 'known_as = ["T08"]'), "already stands for 'T07'"),
        (('signal = "cabinet_temperature"', 'signal = "cabinet_temprature"'), "cabinet_temperature"),
        (('unit = "degC", accuracy', 'unit = "kPa", accuracy'), "kPa"),
        ((', interval = "10min"', ""), "a mean needs both"),
        ((', interval = "10min"', ', interval = "10min", hold = "zoh"'), "a mean needs hold"),
        ((', interval = "10min"', ', interval = "10min", hold = "zero-order"'), "has two meanings"),
        ((', interval = "10min"', ', interval = "10min", hold = "Linear"'), "expected the hold previous"),
        (('stamp = "start"', 'stamp = "begin"'), "stamp must be one of"),
        (('"env.T" = { signal = "ambient_temperature"', '"env.T" = { signal = "cabinet_temperature"'),
            "are both"),
        (('quality = "q"', 'quality = 7'), "quality must be text"),
        (('quality = "q"', 'tag = "tag"'), "tag and value belong together"),
        (('url = "file:live.csv"', 'url = "kafka://x"'), "url must begin with one of"),
        (('url = "file:live.csv"', 'url = "file:none.csv"\nspeed = 2'),
            "a file that is played back must exist at the start"),
        (('url = "file:live.csv"', 'url = "file:live.csv"\nrepeated = 0.1'),
            "late and repeated need a speed"),
        (('url = "file:live.csv"', 'url = "file:live.csv"\nfollow = "no"'), "follow must be true or false"),
        (('[[source]]\nurl = "file:live.csv"', "[wandering]\nseal = 0.1\n[[source]]\nurl = \"stdin\""),
            'unknown key "seal"'),
        (('[[source]]\nurl = "file:live.csv"',
            "[wandering]\nwandering_release = 9\n[[source]]\nurl = \"stdin\""), "rate above 0"),
        (('url = "stdin"', 'url = "stdin"\n[[source]]\nurl = "stdin"'),
            "[[source]] 3: stdin is already a source"),
        (("[mapping]", "[mapping"), "line 18, column 9: not valid TOML"),
    ],
)  # fmt: skip
def test_faults_in_words(folder: Path, change: tuple[str, str], said: str) -> None:
    text = WHOLE.replace(*change)
    assert text != WHOLE
    assert said in faults(folder, text)


def test_all_faults_at_once(folder: Path) -> None:
    text = (
        WHOLE.replace("follows = 0.1", "follows = 7")
        .replace('unit = "kW"', 'unit = "kg"')
        .replace('lateness = "1h"', "lateness = 1")
    )
    found = faults(folder, text)
    assert len(found.splitlines()) == 3


def test_an_empty_file_says_what_is_needed(folder: Path) -> None:
    found = faults(folder, "")
    for word in ("no turbine", "no source", "no signals"):
        assert word in found
    with pytest.raises(ConfigFault, match="cannot be read"):
        read_config(folder / "none.toml")
