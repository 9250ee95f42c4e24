"""Payloads from outside: what is right becomes readings, everything else is counted and changes nothing."""

from __future__ import annotations

import json
import math

import pytest
from builders.rejections import counted
from hypothesis import given, settings
from hypothesis import strategies as st

from hygrokf.live.plan import SignalReporting
from hygrokf.live.sources.payload import Field, PayloadMapping, TurbineReadings
from hygrokf.live.sources.payload_formats import DEEPEST_NESTING, LARGEST_PAYLOAD, Refused
from hygrokf.live.sources.payload_values import seconds

NOW = 1_772_367_000.0  # 2026-03-01T12:10:00Z
STAMP = "2026-03-01T12:10:00Z"
MEAN = SignalReporting("mean", 600.0)
WIDE = PayloadMapping(
    {
        "Tcab": Field("cabinet_temperature", "degC"),
        "RHcab": Field("cabinet_relative_humidity", "%"),
        "P": Field("active_power", "kW", MEAN, "start"),
        "env.T": Field("ambient_temperature", "degC", MEAN, "middle"),
    },
    quality="quality",
    turbines={"T07": "T07", "plant/7": "T07"},
)


def one(**changed: object) -> TurbineReadings:
    content = {"turbine": "T07", "time": STAMP, "Tcab": 31.2, **changed}
    (found,) = WIDE.read(json.dumps(content), NOW)
    return found


def refusal(text: bytes | str | dict) -> str:
    with pytest.raises(Refused) as fault:
        WIDE.read(text if isinstance(text, bytes | str) else json.dumps(text), NOW)
    assert "\n" not in str(fault.value) and len(str(fault.value)) < 200
    return fault.value.kind


def test_values_come_in_si_units_at_the_end_of_their_interval() -> None:
    found = one(RHcab="41.5", P=1500, env={"T": -3.0})
    assert found.turbine == "T07" and not counted(found)
    by_signal = {r.signal: (r.time - NOW, r.value) for r in found.readings}
    assert by_signal == {
        "cabinet_temperature": (0.0, pytest.approx(304.35)),
        "cabinet_relative_humidity": (0.0, pytest.approx(0.415)),
        "active_power": (600.0, pytest.approx(1.5e6)),
        "ambient_temperature": (300.0, pytest.approx(270.15)),
    }


@pytest.mark.parametrize(
    ("stamp", "expected"),
    [
        (STAMP, NOW), ("2026-03-01T13:10:00+01:00", NOW), ("2026-03-01 12:10:00.250Z", NOW + 0.25),
        (NOW, NOW),
        (NOW * 1000, NOW), (str(int(NOW)), NOW), ("2026-03-01T12:10:00", None), ("soon", None), (None, None),
        (True, None), ([], None), ("9999-12-31T23:59:59-23:00", None), ("", None), (math.inf, None),
    ],
)  # fmt: skip
def test_times(stamp: object, expected: float | None) -> None:
    assert seconds(stamp) == (None if expected is None else pytest.approx(expected, abs=1e-6))


@pytest.mark.parametrize(
    ("changed", "kind"),
    [
        ({"Tcab": 999.0}, "impossible value"), ({"Tcab": float("nan")}, "no number"),
        ({"Tcab": 1e400}, "no number"),
        ({"Tcab": "warm"}, "no number"), ({"Tcab": True}, "no number"), ({"Tcab": [31.2]}, "no number"),
        ({"quality": "Bad_SensorFailure"}, "bad quality"), ({"quality": 24}, "bad quality"),
            ({"quality": 0}, "ambiguous quality"), ({"quality": "?"}, "ambiguous quality"),
        ({"RHcab": -12}, "impossible value"),
    ],
)  # fmt: skip
def test_what_cannot_be_true_is_counted(changed: dict, kind: str) -> None:
    found = one(**changed)
    assert counted(found) == {kind: 1}
    assert len(found.readings) == ("RHcab" in changed)


@pytest.mark.parametrize("quality", ["good", "GOOD", "GoodClamped", 192, 192.0, "216", True, None, ""])
def test_marks_of_good_quality(quality: object) -> None:
    assert len(one(quality=quality).readings) == 1 and not counted(one(quality=quality))


def test_missing_values_are_no_fault() -> None:
    found = one(Tcab=None, RHcab="")
    assert not found.readings and not counted(found)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        (b"\xff\xfe\x00", "malformed"), ("", "malformed"), ("[1]", "malformed"), ("31.2", "malformed"),
        ('{"turbine": "T07"', "malformed"),
        ('{"a":' * (DEEPEST_NESTING + 1) + "1" + "}" * (DEEPEST_NESTING + 1), "too deep"),
        ("[" * 60_000, "too deep"), ('{"a": "' + "x" * LARGEST_PAYLOAD + '"}', "too large"),
        ('{"n": ' + "9" * 5000 + "}", "malformed"),
        ('{"turbine": "T07", "time": 1772367000, "Tcab": 31.2, "Tcab": 13.2}', "malformed"),
        ('{"turbine": "T07", "time": 1772367000, "env": {"T": 1, "T": 2}}', "malformed"),
        ({"time": STAMP}, "unknown turbine"), ({"turbine": "<script>", "time": STAMP}, "unknown turbine"),
        ({"turbine": ["T07"], "time": STAMP}, "unknown turbine"), ({"turbine": "T07"}, "no time"),
        ({"turbine": "T07", "time": "2026-03-01T12:10:00"}, "no time"),
        ({"turbine": "T07", "time": {"a": 1}}, "no time"),
        ({"turbine": "T07", "time": 0}, "impossible time"),
        ({"turbine": "T07", "time": NOW + 100 * 365.25 * 86400.0}, "impossible time"),
    ],
)  # fmt: skip
def test_payloads_that_are_refused(text: bytes | str | dict, kind: str) -> None:
    assert refusal(text) == kind


def test_one_reading_a_payload() -> None:
    narrow = PayloadMapping(WIDE.fields, turbine="{1}", time="t", tag="tag", value="v", turbines={"7": "T07"})
    (found,) = narrow.read({"t": NOW, "tag": "RHcab", "v": 55}, NOW, "plant/7/data")
    assert found.turbine == "T07" and found.readings[0].value == pytest.approx(0.55)
    (found,) = narrow.read({"t": NOW, "tag": "Oil", "v": 55}, NOW, "plant/7/data")
    assert counted(found) == {"unknown tag": 1}
    with pytest.raises(Refused, match="turbine 'None'"):
        narrow.read({"t": NOW, "tag": "RHcab", "v": 55}, NOW, "plant")


def test_a_field_must_fit_its_signal() -> None:
    with pytest.raises(ValueError, match="kPa"):
        PayloadMapping({"Tcab": Field("cabinet_temperature", "kPa")})


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=30),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
keys = st.sampled_from(["turbine", "time", "Tcab", "RHcab", "P", "env", "env.T", "quality", "T", "x"])


@settings(max_examples=600)
@given(
    st.dictionaries(keys, json_values | st.sampled_from(["T07", STAMP, NOW, 31.2]), max_size=7)
    | st.binary(max_size=200)
)
def test_nothing_from_outside_breaks_it(content: dict | bytes) -> None:
    text = content if isinstance(content, bytes) else json.dumps(content)
    try:
        found = WIDE.read(text, NOW)
    except Refused as fault:
        assert fault.kind
        return
    assert {one.turbine for one in found} <= {"T07", ""}
    for reading in (one for of in found for one in of.readings):
        assert math.isfinite(reading.value) and math.isfinite(reading.time)
