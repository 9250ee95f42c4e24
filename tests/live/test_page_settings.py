"""How the page may be reached: others reach it by a proxy alone, with a token; every fault in words."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from hygrokf.data.toml_form import Place
from hygrokf.live.web.page_settings import PageSettings, page_settings

TOKEN = "correct-horse-battery"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "token").write_text(TOKEN + "\n", encoding="ascii")
    (tmp_path / "short").write_text("secret-9", encoding="ascii")
    return tmp_path


def read(folder: Path, value: object) -> tuple[PageSettings, list[str]]:
    place = Place()
    return page_settings(value, folder, place), place.faults


def test_an_address_alone(folder: Path) -> None:
    assert read(folder, "127.0.0.1:8090") == (PageSettings("127.0.0.1", 8090), [])
    found, _ = read(folder, "[::1]:80")
    assert (found.host, found.port, found.place) == ("::1", 80, "[::1]:80")
    assert found.names == {"::1", "127.0.0.1", "localhost"}
    found, faults = read(folder, "unix:page.sock")
    assert not faults and found.place == f"unix:{folder / 'page.sock'}"


def test_a_whole_table(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = {"address": "0.0.0.0:8443", "hosts": ["Farm.example."], "behind_proxy": True}
    found, faults = read(folder, {**table, "token_file": "token"})
    assert not faults and found.behind_proxy and found.token == TOKEN
    assert found.names == {"0.0.0.0", "farm.example", "::1", "127.0.0.1", "localhost"}
    assert TOKEN not in repr(found)
    monkeypatch.setenv("HYGROKF_PAGE", TOKEN)
    assert read(folder, {**table, "token_env": "HYGROKF_PAGE"})[0].token == TOKEN


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (8080, "expected \"HOST:PORT\" or a table"),
        ("8080", "page must be HOST:PORT"),
        ({"adress": "127.0.0.1:1"}, 'unknown key "adress"'),
        ("0.0.0.0:8080", "other machines reach 0.0.0.0: give an address such as 127.0.0.1:8080"),
        ("[::]:8080", "other machines reach ::"),
        ({"address": "10.0.0.7:80", "token_file": "token"}, "set behind_proxy = true"),
        ({"address": "10.0.0.7:80", "behind_proxy": True}, "behind_proxy needs token_file or token_env"),
        ({"behind_proxy": True}, "behind_proxy needs token_file or token_env"),
        ({"behind_proxy": "yes"}, "behind_proxy must be true or false"),
        ({"hosts": "farm.example"}, "hosts must be a list"),
        ({"token_file": "none"}, "No such file"),
        ({"token_file": "short"}, "at least 16 printable characters"),
        ({"token_env": "HYGROKF_NOT_SET"}, "the environment variable HYGROKF_NOT_SET is not set"),
        ({"token_env": "X", "token_file": "token"}, "not both"),
        ({"certificate": "page.pem"}, "the page does not use TLS itself: give this file to a proxy"),
        ({"key": "page.key"}, "docs/live_files/nginx.conf), and set behind_proxy = true"),
    ],
)  # fmt: skip
def test_faults_in_words(folder: Path, value: object, said: str) -> None:
    os.environ.pop("HYGROKF_NOT_SET", None)
    _, faults = read(folder, value)
    assert len(faults) == 1 and said in faults[0]
    assert "secret-9" not in faults[0] and TOKEN not in faults[0]
