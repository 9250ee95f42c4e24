"""Tables from files, and every fault with its line."""

from __future__ import annotations

import gzip
import hashlib
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.faults import faults_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hygrokf.data import table_readers
from hygrokf.data.columns import FileColumns, Notation, TableFault
from hygrokf.data.numbers import UNKNOWN_MEANING, Meaning

BASE = 1577836800.0  # 2020-01-01T00:00Z


def read_table(path: Path, columns: list[str], time: str, meanings=None, **stated) -> FileColumns:
    of_columns = dict.fromkeys(columns, UNKNOWN_MEANING) | (meanings or {})
    return table_readers.read_table(path, of_columns, time, Notation(**stated))


def stamps(count: int = 4) -> list[str]:
    return [f"2020-01-01T00:{one:02d}:00Z" for one in range(count)]


def table(rows: list[str], header: str = "time,T,RH") -> str:
    return "\n".join([header, *rows]) + "\n"


GOOD = table([f"{stamp},{20 + k}.5,{50 + k}" for k, stamp in enumerate(stamps())])


@pytest.fixture
def write(tmp_path: Path):
    def file(content: str | bytes, name: str = "a.csv") -> Path:
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return file


def faults(path: Path, columns=("T", "RH"), time="time", **more) -> tuple[str, ...]:
    return faults_of(read_table, path, list(columns), time, **more)


def test_csv_is_read(write):
    path = write(GOOD)
    read = read_table(path, ["RH", "T"], "time")
    np.testing.assert_array_equal(read.time, BASE + 60.0 * np.arange(4))
    np.testing.assert_array_equal(read.values["T"], [20.5, 21.5, 22.5, 23.5])
    np.testing.assert_array_equal(read.values["RH"], [50, 51, 52, 53])
    assert read.warnings == ()
    assert read.sha256 == hashlib.sha256(GOOD.encode()).hexdigest()


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (gzip.compress(GOOD.encode(), mtime=0), "a.csv.gz"),
        (GOOD.encode("utf-16"), "a.csv"),
        (b"\xef\xbb\xbf" + GOOD.encode(), "a.csv"),
        (GOOD.replace("\n", "\r\n").encode(), "a.csv"),
        (GOOD.replace("\n", "\r").encode(), "a.csv"),
        (GOOD.rstrip().encode(), "a.csv"),
        (GOOD.replace(",", " , ").encode(), "a.csv"),
        (GOOD.replace("\n", ",\n").encode(), "a.csv"),
        (GOOD.replace("\n", "\n\n").encode(), "a.csv"),
        (("# made by x, 2020\n\nTurbine,7\n" + GOOD).encode(), "a.csv"),
        (GOOD.replace("time,", "# time,").encode(), "a.csv"),
        (GOOD.replace("time,T", '"time","T"').encode(), "a.csv"),
        (GOOD.replace("T", "Température °C").replace("Température °C0", "T0").encode("cp1252"), "a.csv"),
    ],
    ids="gzip utf16 bom crlf cr end blanks trailing empty preamble hash quotes cp1252".split(),
)
def test_the_same_table_in_other_dress(write, content, name):
    column = "Température °C" if b"rature" in content else "T"
    read = read_table(write(content, name), [column], "time")
    np.testing.assert_array_equal(read.values[column], [20.5, 21.5, 22.5, 23.5])
    np.testing.assert_array_equal(read.time, BASE + 60.0 * np.arange(4))


def test_semicolon_and_decimal_comma_when_stated(write):
    path = write(GOOD.replace(",", ";").replace(".5", ",5"))
    read = read_table(path, ["T"], "time", separator=";", decimal=",")
    np.testing.assert_array_equal(read.values["T"], [20.5, 21.5, 22.5, 23.5])


def test_semicolons_not_stated_name_the_remedy(write):
    (fault,) = faults(write(GOOD.replace(",", ";")))
    assert 'separator = ";"' in fault
    assert 'decimal = ","' in fault


def test_decimal_comma_not_stated_names_the_remedy(write):
    path = write(GOOD.replace(",", ";").replace(".5", ",5"))
    (fault,) = faults(path, separator=";")
    assert 'line 2 "20,5"' in fault
    assert 'decimal = ","' in fault


def test_decimal_comma_between_commas_cannot_shift_columns(write):
    (fault,) = faults(write(GOOD.replace(".5", ",5")))
    assert "lines 2, 3, 4, 5" in fault
    assert "expected 3 cells" in fault
    assert "decimal comma" in fault


@pytest.mark.parametrize("quoted", [False, True])
def test_one_row_too_wide_is_named(write, quoted):
    content = GOOD.replace("21.5", "21.5,9")
    content = content.replace("20.5", '"20.5"') if quoted else content
    (fault,) = faults(write(content))
    assert fault.startswith("line 3: expected 3 cells")


@pytest.mark.parametrize("word", ["", "NaN", "nan", "NA", "null", "NULL", "-", "n/a"])
def test_what_counts_as_missing(write, word):
    read = read_table(write(GOOD.replace("21.5", word)), ["T"], "time")
    np.testing.assert_array_equal(np.isnan(read.values["T"]), [False, True, False, False])


def test_infinite_readings_are_missing(write):
    read = read_table(write(GOOD.replace("21.5", "inf")), ["T"], "time")
    assert np.isnan(read.values["T"][1])


def test_text_in_a_number_column_names_lines_below_blanks_and_comments(write):
    content = "# a\n\n" + GOOD.replace("21.5", "\t error ").replace("22.5", "err")
    content = content.replace("2020-01-01T00:02", "\n# two\n2020-01-01T00:02")
    (fault,) = faults(write(content), comment="#")
    assert 'column "T"' in fault
    assert "2 of 4 rows" in fault
    assert 'line 5 "error", line 8 "err"' in fault
    assert "missing = [" in fault


def test_stated_words_mean_missing(write):
    path = write(GOOD.replace("21.5", "Bad Input").replace("52", "Bad Input"))
    read = read_table(path, ["T", "RH"], "time", missing=("Bad Input",))
    assert np.isnan(read.values["T"]).tolist() == [False, True, False, False]
    assert np.isnan(read.values["RH"]).tolist() == [False, False, True, False]


def test_truth_values_are_numbers(write):
    content = table([f"{s},{w},1" for s, w in zip(stamps(), ["true", "false", "", "True"], strict=True)])
    read = read_table(write(content), ["T"], "time")
    np.testing.assert_array_equal(read.values["T"], [1.0, 0.0, np.nan, 1.0])


@pytest.mark.parametrize(
    ("old", "new", "remedy"),
    [
        ("20.5", "°C", "units"),
        ("22.5", '"1,022.5"', 'thousands = ","'),
        ("\n2020-01-01T00:02:00Z,22.5,52", "\ntime,T,RH", "header is repeated"),
    ],
)
def test_common_texts_get_their_own_remedy(write, old, new, remedy):
    assert any(remedy in fault for fault in faults(write(GOOD.replace(old, new))))


def power(*texts: str, separator: str = ",") -> str:
    rows = [f"{stamp}{separator}{one}" for stamp, one in zip(stamps(len(texts)), texts, strict=True)]
    return table(rows, f"time{separator}P")


def test_a_point_beside_a_decimal_comma_divides_thousands(write):
    path = write(power("998,5", "1.003", "1.250", "2.050", separator=";"))
    for stated in ({"decimal": ","}, {"thousands": "."}):
        read = read_table(path, ["P"], "time", separator=";", **stated)
        np.testing.assert_array_equal(read.values["P"], [998.5, 1003.0, 1250.0, 2050.0])
    wrong = write(power("998,5", "21.5", separator=";"), "b.csv")
    (fault,) = faults(wrong, ["P"], separator=";", decimal=",")
    assert 'line 3 "21.5"' in fault and 'state decimal = "."' in fault


@pytest.mark.parametrize(
    ("texts", "advised"),
    [
        (("998", '"1,003"', '"2,050"'), 'state thousands = ","'), (("998", '"21,5"'), 'state decimal = ","'),
        (("30", '"1,003"', "32"), 'state decimal = "," or thousands = ","'),
        (("998", "1.003", "1.117"), '"1.003" may be 1003 or 1.003'),
    ],
)  # fmt: skip
def test_the_advice_on_marks_is_right(write, texts, advised):
    path = write(power(*texts))
    (fault,) = faults(path, ["P"])
    assert advised in fault
    if "thousands = " in fault:
        mark = "," if "," in texts[1] else "."
        right = [float(one.strip('"').replace(mark, "")) for one in texts]
        np.testing.assert_array_equal(read_table(path, ["P"], "time", thousands=mark).values["P"], right)


def test_a_point_that_both_readings_allow_is_a_doubt_until_stated(write):
    path = write(power("30", "1.003", "32"))
    read = read_table(path, ["P"], "time")
    (doubt,) = read.warnings
    assert '"1.003" may be 1003 or 1.003' in doubt and 'thousands = "." or decimal = "."' in doubt
    assert read_table(path, ["P"], "time", decimal=".").warnings == ()
    assert read_table(path, ["P"], "time", thousands=".").values["P"][1] == 1003.0


def test_texts_with_units_and_flags_are_numbers(write):
    path = write(table([f"{stamps()[0]},21.5 °C,45%,ON,open", f"{stamps()[1]},unavailable,0.46,off,closed"],
                       "time,T,RH,H,D"))  # fmt: skip
    meanings = {
        "T": Meaning("cabinet_temperature", "degC"), "RH": Meaning("cabinet_relative_humidity", "1"),
        "H": Meaning("heater_duty", "1"), "D": Meaning("door_open", "1"),
    }  # fmt: skip
    read = read_table(path, [*meanings], "time", meanings=meanings)
    found = np.array([*read.values.values()])
    np.testing.assert_array_equal(found, [[21.5, np.nan], [0.45, 0.46], [1.0, 0.0], [1.0, 0.0]])
    fan = {"D": Meaning("fan_duty", "1")}
    (fault,) = faults(path, ["D"], meanings=fan)
    assert 'one = "open" or "closed"' in fault
    closed = {"D": Meaning("fan_duty", "1", "closed")}
    np.testing.assert_array_equal(read_table(path, ["D"], "time", meanings=closed).values["D"], [0.0, 1.0])


def test_a_repeated_row_within_the_repeated_hour_is_no_second_pass(write):
    minutes = ["01:50", "02:00", "02:10", "02:10", "02:20", "02:50", "04:00"]
    rows = [f"2021-10-31 {one},{k - (k > 2)}" for k, one in enumerate(minutes)]
    read = read_table(write(table(rows, "time,T")), ["T"], "time", timezone="Europe/Berlin")
    np.testing.assert_array_equal(read.values["T"], [0.0, 5.0])
    assert any("5 stamps left out" in said for said in read.warnings)
    hours = [f"2021-10-31 {one}" for one in ("01:00,0", "02:00,1", "02:00,1")]
    read = read_table(write(table(hours, "time,T"), "b.csv"), ["T"], "time", timezone="Europe/Berlin")
    np.testing.assert_array_equal(read.values["T"], [0.0])


def test_forms_and_headers_of_stamps(write):
    ampm = write(table(["2/1/2022 12:04 AM,1", "2/1/2022 01:05 PM,2"], "time,T"))
    (fault,) = faults(ampm, ["T"], time_format="%m/%d/%Y %H:%M %p", timezone="UTC")
    assert "write %I for %H" in fault
    read = read_table(ampm, ["T"], "time", time_format="%m/%d/%Y %I:%M %p", timezone="UTC")
    np.testing.assert_array_equal(np.diff(read.time), 13 * 3600 + 60)
    serial = write(table(["43831.0,1", "43831.5,2"], "Time (CEST),T"), "b.csv")
    assert 'time_format = "excel"' in faults(serial, ["T"], "Time (CEST)", timezone="UTC")[0]
    read = read_table(serial, ["T"], "Time (CEST)", time_format="excel")
    np.testing.assert_array_equal(read.time, BASE - 7200.0 + np.array([0.0, 43200.0]))
    assert any('read at "+02:00"' in said for said in read.warnings)
    months = write(table(["2022-01,1", "2022-02,2"], "time,T"), "c.csv")
    assert read_table(months, ["T"], "time", timezone="UTC").warnings == ()


def test_missing_columns_are_all_named_with_near_names(write):
    first, second = faults(write(GOOD), ["Temp", "rh"])
    assert first == 'no column "Temp" (line 1 has "time", "T", "RH")'
    assert second.endswith('did you mean "RH"?')


def test_missing_time_column_does_not_hide_other_faults(write):
    found = faults(write(GOOD.replace("21.5", "bad")), ["T", "H"], "Time")
    assert 'no column "Time"' in found[0]
    assert 'did you mean "time"?' in found[0]
    assert 'no column "H"' in found[1]
    assert 'line 3 "bad"' in found[2]


def test_a_column_that_occurs_twice_is_a_fault(write):
    (fault,) = faults(write(GOOD.replace("RH", "T")), ["T"])
    assert 'column "T" occurs 2 times' in fault


def test_unreadable_stamps_are_listed(write):
    content = GOOD.replace(stamps()[1], "yesterday").replace(stamps()[3], "2020-13-01")
    (fault,) = faults(write(content))
    assert "2 of 4 rows" in fault
    assert 'line 3 "yesterday"' in fault
    assert 'line 5 "2020-13-01"' in fault


@pytest.mark.parametrize(
    ("form", "remedy"),
    [
        ("0{}.01.2020 00:00", 'time_format = "%d.%m.%Y %H:%M"'),
        ("0{}/01/2020 00:00", 'time_format = "%d/%m/%Y %H:%M"'),
        ("157783680{}", "bare numbers"),
        ("day {}", "state the form"),
        ("# {}", 'comment = "#"'),
    ],
)
def test_other_forms_of_stamps_get_a_remedy(write, form, remedy):
    content = table([f"{form.format(k + 1)},1,2" for k in range(4)])
    (fault,) = faults(write(content))
    assert remedy in fault


def test_naive_stamps_need_a_zone(write):
    path = write(GOOD.replace("Z", ""))
    (fault,) = faults(path)
    assert "4 of 4 stamps have no offset" in fault
    assert 'line 2 "2020-01-01T00:00:00"' in fault
    assert "timezone =" in fault
    read = read_table(path, ["T"], "time", timezone="+02:00")
    assert read.time[0] == BASE - 7200.0


def test_an_unknown_zone_does_not_hide_other_faults(write):
    found = faults(write(GOOD.replace("Z", "").replace("21.5", "bad")), timezone="Europe/Berln")
    assert len(found) == 2
    assert "Europe/Berlin" in found[0]


def test_a_zone_beside_offsets_is_said(write):
    read = read_table(write(GOOD), ["T"], "time", timezone="+02:00")
    assert read.time[0] == BASE
    assert "not used" in read.warnings[0]


def test_rows_without_stamp_are_left_out_and_said(write):
    read = read_table(write(GOOD.replace(stamps()[2], "") + ",,\n"), ["T"], "time")
    assert len(read.time) == 3
    np.testing.assert_array_equal(read.values["T"], [20.5, 21.5, 23.5])
    assert read.warnings == ("1 row without a stamp left out: line 4",)


@pytest.mark.parametrize(
    ("content", "name", "word"),
    [
        (b"", "a.csv", "empty"),
        (gzip.compress(b"", mtime=0), "a.csv.gz", "empty"),
        (b"\n\n\n", "a.csv", "empty"),
        (b"time,T,RH\n", "a.csv", "no row"),
        (b"PK\x03\x04rest", "a.csv", "Excel"),
        (b"PAR1rest", "a.csv", "Parquet"),
        (GOOD.encode() + b"\x00\x00", "a.csv", "line 6: is not text"),
        (gzip.compress(GOOD.encode(), mtime=0)[:40], "a.csv.gz", "decompressed"),
        (b"not gzip", "a.csv.gz", 'no column "time"'),
        (GOOD.replace("20.5", '"20.5').encode(), "a.csv", "line 2: a quotation mark"),
        (b"PAR1 no", "a.parquet", "Parquet"),
        (GOOD.encode(), "a.dat", "expected a file of the kind"),
    ],
)
def test_files_that_are_none(write, content, name, word):
    assert word in faults(write(content, name))[0]


def test_absent_files_suggest_a_name(tmp_path, write):
    write(GOOD, "cabinet.csv")
    (fault,) = faults(tmp_path / "cabinett.csv")
    assert "no such file" in fault
    assert 'did you mean "cabinet.csv"?' in fault
    (fault,) = faults(tmp_path / "nowhere" / "cabinet.csv")
    assert "no such file" in fault
    (fault,) = faults(tmp_path)
    assert "directory" in fault


def test_only_stamps_of_an_absent_hour_leave_nothing(write):
    content = table(["2020-03-29 02:10,1,2", "2020-03-29 02:20,1,2"])
    (fault,) = faults(write(content), timezone="Europe/Berlin")
    assert "no row with a stamp that can be used" in fault


def test_line_numbers_hold_in_a_long_file(write):
    rows = [f"2020-01-{1 + k // 1440:02d}T{k // 60 % 24:02d}:{k % 60:02d}Z,{k},1" for k in range(20000)]
    rows[17000] = rows[17000].replace(",17000,", ",oops,")
    (fault,) = faults(write(table(rows)))
    assert 'line 17002 "oops"' in fault


class TestParquet:
    """The extra `parquet`."""

    @pytest.fixture
    def frame(self):
        pytest.importorskip("pyarrow")
        import pandas as pd

        return pd.DataFrame({"time": stamps(), "T": [1.0, 2.0, None, 4.0], "RH": [1, 2, 3, 4]})

    @pytest.mark.parametrize("kind", ["text", "aware", "index"])
    def test_is_read(self, frame, tmp_path, kind):
        import pandas as pd

        if kind != "text":
            frame["time"] = pd.to_datetime(frame["time"])
        if kind == "index":
            frame = frame.set_index("time")
        frame.to_parquet(tmp_path / "a.parquet")
        read = read_table(tmp_path / "a.parquet", ["T", "RH"], "time")
        np.testing.assert_array_equal(read.time, BASE + 60.0 * np.arange(4))
        np.testing.assert_array_equal(read.values["T"], [1.0, 2.0, np.nan, 4.0])
        np.testing.assert_array_equal(read.values["RH"], [1, 2, 3, 4])

    def test_faults_name_rows(self, frame, tmp_path):
        frame["T"] = ["1", "2", "x", "4"]
        frame["time"] = [one.removesuffix("Z") for one in stamps()]
        frame.to_parquet(tmp_path / "a.parquet")
        found = faults(tmp_path / "a.parquet", ["T", "H"])
        assert 'no column "H" (the file has "time", "T", "RH")' in found[0]
        assert 'row 3 "x"' in found[1]
        assert 'row 1 "2020-01-01T00:00:00"' in found[2]

    def test_without_pyarrow_the_extra_is_named(self, monkeypatch, write):
        monkeypatch.setitem(sys.modules, "pyarrow", None)
        (fault,) = faults(write(b"PAR1", "a.parquet"))
        assert 'pip install "hygrokf[parquet]"' in fault


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused_but_never_breaks(write, data):
    content = GOOD
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(content)))
        gone = data.draw(st.integers(0, 12))
        new = data.draw(st.text(alphabet='",;\n\r\t#\0é .-Z+:0123456789eTn\\', max_size=4))
        content = content[:place] + new + content[place + gone :]
    zone = data.draw(st.sampled_from([None, "Europe/Berlin", "+01:00"]))
    path = write(content.encode(data.draw(st.sampled_from(["utf-8", "utf-16", "cp1252"]))))
    try:
        read = read_table(path, ["T", "RH"], "time", timezone=zone)
    except TableFault as refused:
        assert refused.faults
        assert all(refused.faults)
    else:
        assert np.isfinite(read.time).all()
        assert all(len(array) == len(read.time) for array in read.values.values())


@pytest.mark.parametrize(("name", "separator"), [("a.txt", ","), ("a.tsv", "\t")])
def test_text_tables_have_other_endings_too(write, name: str, separator: str) -> None:
    path = write(GOOD.replace(",", separator).encode(), name)
    found = read_table(path, ["T"], "time", separator=separator, timezone="UTC")
    usual = read_table(write(GOOD.encode(), "b.csv"), ["T"], "time", timezone="UTC")
    assert np.array_equal(found.values["T"], usual.values["T"]) and len(usual.time) > 2
