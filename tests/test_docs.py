"""The pages say what is true: their code runs, their links resolve, their tables and pictures are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from builders import house
from builders.documents import DOCS, ROOT, document, run_page

PAGES = sorted([ROOT / "README.md", *DOCS.rglob("*.md")])


RUN = [
    (ROOT / "README.md", "python", ["turbine/case.toml"]),
    pytest.param(
        document("tutorial.md"),
        "python,bash",
        ["result/report.html", "simulated.csv"],
        marks=pytest.mark.slow,
    ),
    pytest.param(
        document("fleet.md"),
        "python,bash",
        ["result/fleet.csv", "result/fleet.parquet", "result/report.html"],
        marks=pytest.mark.slow,
    ),
    (document("add_a_mechanism.md"), "python", []),
    (document("own_model.md"), "python", []),
    pytest.param(
        document("reference.md"),
        "python",
        ["result/report.html", "fleet/report.html"],
        marks=pytest.mark.slow,
    ),
    pytest.param(
        document("climate.md"),
        "python,bash",
        ["climate/report.html", "checked/climate.csv", "regions/report.html"],
        marks=pytest.mark.slow,
    ),
    pytest.param(
        document("compare.md"),
        "python,bash",
        ["compared/report.html", "compared/compare.csv"],
        marks=pytest.mark.slow,
    ),
    pytest.param(
        document("transfer.md"),
        "python,bash",
        ["moved/report.html", "moved/synthetic-turbine-42/fit.json"],
        marks=pytest.mark.slow,
    ),
    (document("own_cause.md"), "python", []),
    (document("live_notify.md"), "bash", ["hook.secret"]),
    (document("live_opcua.md"), "bash", ["pki/tracker.key", "pki/tracker.pem"]),
    (document("live_page.md"), "bash", ["page.token"]),
]
"""(page, languages of its blocks that are run, files that they must leave)."""


def prose(text: str) -> str:
    """A page without its code blocks and inline code."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))


def anchors(text: str) -> set[str]:
    """Anchors that GitHub makes of a page's headings."""
    heads = re.findall(
        r"^#+ (.*)$", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def broken_links(page: Path, text: str) -> list[str]:
    """Relative links of a page that lead nowhere."""
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(text)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        if not file.exists():
            broken.append(target)
        elif anchor and file.suffix == ".md":
            there = text if file == page else file.read_text(encoding="utf-8")
            if anchor not in anchors(there):
                broken.append(target)
    return broken


def test_the_pages_can_be_read() -> None:
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in DOCS.rglob("*.md")) <= 30_000


@pytest.mark.parametrize(
    ("page", "languages", "made"),
    RUN,
    ids=lambda value: value.name if isinstance(value, Path) else "",
)
def test_the_code_of_a_page_runs(page: Path, languages: str, made: list[str], tmp_path: Path) -> None:
    done = run_page(page, tmp_path, languages)
    assert done.returncode == 0, f"{page.name}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    assert [name for name in made if not (tmp_path / name).is_file()] == []


def test_every_block_of_code_is_run() -> None:
    """The tracker's tutorial has tests of its own; what installs the package cannot be run by it."""
    run = {page: languages for page, languages, _ in (getattr(one, "values", one) for one in RUN)}
    run |= {document("live_tutorial.md"): "python,bash"}
    installs = {ROOT / "README.md", document("index.md")}
    left = []
    for page in PAGES:
        found = set(re.findall(r"^```(python|bash)$", page.read_text(encoding="utf-8"), re.MULTILINE))
        left += [
            (page.name, one)
            for one in found - ({"bash"} if page in installs else set())
            if one not in run.get(page, "")
        ]
    assert left == []


def test_a_failing_block_fails_and_names_its_line(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# A page\n\n```python\na = 1\n```\n\n```bash\ntrue\n```\n\n```python\nassert a == 2\n```\n"
    )
    done = run_page(page, tmp_path, "python,bash")
    assert done.returncode != 0 and "page.md" in done.stderr and "line 12" in done.stderr
    page.write_text("```bash\nfalse\ntrue\n```\n")
    assert run_page(page, tmp_path, "python,bash").returncode != 0
    assert run_page(page, tmp_path, "python").returncode == 0


def test_readme_opens_with_the_two_commands_and_a_tour_of_ten_lines() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w+)\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    assert [language for language, _ in blocks[:2]] == ["bash", "python"]
    assert [line.split()[0] for line in blocks[0][1].splitlines()] == ["scripts/demo", "scripts/test"]
    assert all((ROOT / name).is_file() for name in ("scripts/demo", "scripts/test"))
    assert len([line for line in blocks[1][1].splitlines() if line.strip()]) == 10


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_relative_link_resolves(page: Path) -> None:
    assert broken_links(page, page.read_text(encoding="utf-8")) == []


def test_a_broken_link_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    text = (
        "# One head\n[a](page.md) [b](none.md) [c](#one-head) [d](#two) [e](https://x.org) `[f](code.md)`\n"
    )
    page.write_text(text)
    assert broken_links(page, text) == ["none.md", "#two"]


def test_every_page_is_linked_from_the_readme_or_the_index() -> None:
    linked = set()
    for page in (ROOT / "README.md", document("index.md")):
        for target in re.findall(r"\]\(([^)\s#]+)", prose(page.read_text(encoding="utf-8"))):
            linked.add((page.parent / target).resolve())
    assert [str(page.relative_to(ROOT)) for page in DOCS.rglob("*.md") if page.resolve() not in linked] == []


def test_pictures_are_small_and_shown() -> None:
    shown = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    pictures = sorted((DOCS / "pictures").glob("*.png"))
    assert pictures
    for picture in pictures:
        assert picture.stat().st_size <= 150_000, picture.name
        assert f"pictures/{picture.name})" in shown, f"{picture.name} is on no page"


def test_every_table_of_the_pictures_script_is_filled() -> None:
    modules = (ROOT / "scripts" / "illustrations").glob("*.py")
    script = "".join(module.read_text(encoding="utf-8") for module in modules)
    made = set(re.findall(r'write_table\("([\w.]+)", "([\w ]+)"', script))
    assert made
    found = set()
    for page in DOCS.rglob("*.md"):
        for name, body in re.findall(
            r"<!-- made by scripts/pictures: ([\w ]+) -->(.*?)<!-- end -->",
            page.read_text(encoding="utf-8"),
            re.DOTALL,
        ):
            assert re.search(r"^\| --- ", body, re.MULTILINE) and body.count("\n| ") >= 3, (
                f"{page.name}: {name} is empty"
            )
            found.add((page.name, name))
    assert found == made


def test_the_floor_plan_is_the_house() -> None:
    """The table in the docs is the one of the imports; the floors' own test guards them."""
    text = document("house.md").read_text(encoding="utf-8")
    assert len(house.table()) == len(house.PLACE) + 1
    for row in house.table():
        assert "| " + " | ".join(row) + " |" in text, (
            f"house.md: run scripts/pictures --only house_plan; {row}"
        )


def test_the_tests_that_hold_a_promise_exist() -> None:
    text = document("live_guarantees.md").read_text(encoding="utf-8")
    found = re.findall(r"`(test_\w+\.py)::(test_\w+)`", text)
    assert len(found) >= 40
    files = {file.name: file for file in (ROOT / "tests").rglob("test_*.py")}
    sources = {file: files[file].read_text(encoding="utf-8") for file, _ in found}
    missing = [f"{file}::{name}" for file, name in found if f"def {name}(" not in sources[file]]
    assert not missing
    promises = text.partition("## The fault suite")[0].splitlines()
    rows = [
        line for line in promises if line.startswith("| ") and not line.startswith(("| promise |", "| ---"))
    ]
    assert len(rows) >= 25 and not [row for row in rows if "::test_" not in row]
