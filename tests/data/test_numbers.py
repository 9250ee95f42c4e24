"""Numbers from texts: marks by the evidence of a column, units, flags."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from hygrokf.data.numbers import (
    Marks,
    Meaning,
    Unread,
    evidence,
    flag_word,
    number_in,
    stated_marks,
    unit_among,
    value_in,
    values_in,
)

GERMAN = Marks(",", ".")


def column(*texts: object) -> pd.Series:
    return pd.Series(list(texts), dtype=object)


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (("998", "1.003", "1.117"), "thousands"), (("998", "1.003.250"), "thousands"),
        (("998,5", "1.003"), "thousands"), (("-998 kW", "1.003 kW"), "thousands"),
        (("0", "0", "998", "1.003"), "thousands"),
        (("998", "1.003", "1.1"), "decimal"), (("998", "1.003", "0.998"), "decimal"),
        (("2000", "1.003"), "decimal"), (("21.503", "22.117"), "decimal"),
        (("0", "1.503", "1.117"), "decimal"),
        (("5", "5.125", "5", "4.875"), "decimal"), (("1.5e3",), "decimal"),
        (("30", "1.003", "32"), "either"),
        (("998", "21"), "none"), (("01.02.2020", "02.02.2020"), "none"), ((), "none"),
        (("error.", None), "none"),
    ],
)  # fmt: skip
def test_what_a_mark_does_is_told_by_the_whole_column(texts, said):
    assert evidence(column(*texts), ".") == said
    exchanged = [one and one.translate(str.maketrans(".,", ",.")) for one in texts]
    assert evidence(column(*exchanged), ",") == said


@pytest.mark.parametrize("seed", range(20))
def test_whole_numbers_with_thousands_marks_are_read_back(seed):
    """A power that wanders through 1000: whatever its course, marks and values are right."""
    steps = np.random.default_rng(seed).normal(0.0, 60.0, 300)
    power = np.round(np.abs(900.0 + np.cumsum(steps)))
    power[:2] = 998.0, 1003.0
    texts = column(*[f"{one:,.0f}".replace(",", ".") for one in power])
    assert evidence(texts, ".") == "thousands"
    values, refused = values_in(texts, GERMAN)
    assert not refused
    np.testing.assert_array_equal(values, power)
    assert evidence(column(*[f"{one / 1e3:.3f}" for one in power]), ".") == "decimal"


@pytest.mark.parametrize(
    ("decimal", "thousands", "marks"),
    [(None, None, None), (",", None, GERMAN), (None, ".", GERMAN), (".", None, (".", ",")),
     (None, ",", (".", ",")), (None, "'", (".", "'"))],
)  # fmt: skip
def test_each_stated_mark_implies_the_other(decimal, thousands, marks):
    assert stated_marks(decimal, thousands) == marks


@pytest.mark.parametrize(
    ("text", "value"),
    [("998,5", 998.5), ("1.003", 1003.0), ("-1.250.003,25", -1250003.25), ("21.5", None), ("0.998", None),
     ("1.2500", None), ("21,5.1", None), (",5", 0.5), ("", None)],
)  # fmt: skip
def test_a_point_beside_a_decimal_comma_divides_thousands_or_is_wrong(text, value):
    assert number_in(text, GERMAN) == value


def test_values_with_a_unit_and_flags():
    power = Meaning("active_power", "kW")
    values, refused = values_in(column("980 kW", "1.23 MW", 7, None, "2 h", "990"), Marks(), power)
    np.testing.assert_array_equal(values, [980.0, 1230.0, 7.0, np.nan, np.nan, 990.0])
    assert {text: reason.kind for text, reason in refused.items()} == {"2 h": "no number"}
    with pytest.raises(Unread, match="in degF, not in degC"):
        value_in("70 °F", Marks(), Meaning("ambient_temperature", "degC"))
    assert [value_in(one) for one in ("ON", "off", "True", "false")] == [1.0, 0.0, 1.0, 0.0]
    with pytest.raises(Unread):
        value_in("ON", Marks(), power)


@pytest.mark.parametrize(
    ("signal", "one", "value"),
    [("door_open", "", 1.0), ("door_open", "closed", 0.0), ("fan_duty", "open", 1.0), ("fan_duty", "", None)],
)
def test_open_is_one_for_a_door_and_as_stated_for_others(signal, one, value):
    meaning = Meaning(signal, "1", one)
    if value is not None:
        assert value_in(" Open", Marks(), meaning) == value == 1.0 - value_in("closed", Marks(), meaning)
        return
    with pytest.raises(Unread, match='one = "open" or "closed"'):
        value_in("open", Marks(), meaning)


def test_what_a_column_of_texts_holds():
    assert unit_among(column("21.5 °C", "22 °C", None, "error")) == "degC"
    assert unit_among(column("45%", "46 %")) == "%"
    assert unit_among(column("21.5", "22")) == unit_among(column()) == ""
    assert flag_word(column("ON", "Off", None)) == "on"
    assert flag_word(column("open", "closed")) == "open"
    assert flag_word(column("ON", "5")) == flag_word(column()) == ""
