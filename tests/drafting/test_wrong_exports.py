"""Exports that hold no table: one message each, without a traceback."""

from __future__ import annotations

import gzip
import re
import zipfile

import pytest
from builders.command_line import run

from hygrokf.drafting.draft import DraftFault, draft_case

ROWS = "time,T (degC)\n2020-01-01 00:00,1.5\n2020-01-01 00:10,1.6\n2020-01-01 00:20,1.8\n"
WRONG = {
    "empty": (b"", "is empty"),
    "blank": (b" \n\n", "is empty"),
    "binary": (bytes(range(1, 200)) * 40, "not text"),
    "zero bytes": (b"time,T\n2020-01-01 00:00,\x00\n", "zero byte"),
    "one column": (b"time\n2020-01-01 00:00\n2020-01-01 00:10\n", "one column alone"),
    "no time": (b"a,b\n1.5,2.5\n3.5,4.5\n", "column of stamps"),
    "a web page": (b"<!DOCTYPE html>\n<html><body>Log in</body></html>", "web page"),
    "old Excel or a password": (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600), "password"),
    "both decimal marks": (
        b"time;T;RH\n2020-01-01 00:00;1,5;40.5\n2020-01-01 00:10;1,6;40.6\n",
        "one decimal mark",
    ),
    "JSON": (b'{"time": ["2020-01-01"]}', "JSON"),
    "PDF": (b"%PDF-1.7\n1 0 obj", "PDF"),
    "header alone": (b"time,T\n", "column of stamps"),
    "one row": (b"time,T\n2020-01-01 00:00,1.5\n", "1 row"),
    "more cells than the header": (ROWS.encode() + b"2020-01-01 00:30,1,5\n", "more|cells"),
    "a damaged archive": (gzip.compress(ROWS.encode())[:-20], "decompressed"),
    "a stamp of no form": (b"time,T\n2020-99-01 00:00,1\n2020-99-01 00:10,2\n", "ISO 8601"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_what_is_no_table_is_named_in_one_message(kind, tmp_path):
    content, words = WRONG[kind]
    (tmp_path / "export.csv").write_bytes(content)
    with pytest.raises(DraftFault, match=words) as raised:
        draft_case([tmp_path / "export.csv"], tmp_path / "case.toml")
    assert len(str(raised.value).splitlines()) == 1
    assert not (tmp_path / "case.toml").exists()


def test_a_zip_archive_is_no_excel_table(tmp_path):
    with zipfile.ZipFile(tmp_path / "export.xlsx", "w") as archive:
        archive.writestr("readme.txt", "nothing")
    with pytest.raises(DraftFault, match=r"Excel"):
        draft_case([tmp_path / "export.xlsx"], tmp_path / "case.toml")


def test_the_faults_of_all_files_are_told_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.csv").write_bytes(b"")
    (tmp_path / "b.csv").write_bytes(b"<html></html>")
    said = run("init a.csv b.csv absent.csv")
    assert said.status == 2
    assert [line for line in ("a.csv", "b.csv", "absent.csv") if line in said.err] == [
        "a.csv",
        "b.csv",
        "absent.csv",
    ]
    assert "Traceback" not in said.err


def test_a_case_that_exists_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "export.csv").write_text(ROWS)
    (tmp_path / "case.toml").write_text("mine")
    said = run("init export.csv")
    assert said.status == 2 and "case.toml" in said.err
    assert (tmp_path / "case.toml").read_text() == "mine"


@pytest.mark.parametrize("site", ["abc", "95,0", "1,2,3"])
def test_a_site_is_two_numbers_of_degrees(site, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(f"init export.csv --site {site}").status == 2


def test_a_turbine_that_the_export_lacks_is_named_with_those_that_it_has(tmp_path):
    rows = "".join(f"T{n},2020-01-01 0{h}:00,{h + n}.5\n" for h in range(9) for n in (1, 2))
    (tmp_path / "park.csv").write_text("Turbine,time,Outside temperature (degC)\n" + rows)
    with pytest.raises(DraftFault, match=re.escape("T1, T2")):
        draft_case([tmp_path / "park.csv"], tmp_path / "case.toml", turbine="T3")


def test_exports_of_two_turbines_are_not_mixed(tmp_path):
    rows = "".join(f"2020-01-01 0{hour}:00,{hour}.5,{hour}.1,{hour}.2,{hour}.3\n" for hour in range(9))
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text("time,Power (kW),Cabinet (°C),Outside (°C),Nacelle (°C)\n" + rows)
    with pytest.raises(DraftFault, match="one case for each turbine"):
        draft_case([tmp_path / "a.csv", tmp_path / "b.csv"], tmp_path / "case.toml")
