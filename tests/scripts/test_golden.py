"""Whatever a change of structure moves, the outputs on fixed cases stay: `scripts/golden make` where a change
means to alter them."""

from __future__ import annotations

import pytest
from golden.cases import CASES, Case, Page, outputs
from golden.difference import differences, read

RELATIVE = 1e-3
"""Tolerance of numbers: processors and versions of libraries move the last digits of an estimate."""


def check(case: Case) -> None:
    different = list(differences(read(case.name), outputs(case), RELATIVE))
    assert not different, "\n".join([f"{case.name}: {len(different)} differences", *different[:40]])


@pytest.mark.parametrize("case", [one for one in CASES if not one.large], ids=lambda case: case.name)
def test_outputs_are_those_of_the_reference(case: Case) -> None:
    check(case)


@pytest.mark.slow
@pytest.mark.parametrize("case", [one for one in CASES if one.large], ids=lambda case: case.name)
def test_large_outputs_are_those_of_the_reference(case: Case) -> None:
    if case.absent:
        pytest.skip(f"measured data are not here: {', '.join(path.name for path in case.absent)}")
    check(case)


def test_a_difference_is_told_with_its_place() -> None:
    was = {"fit": {"rmse": 1.0, "n": 10, "seconds": 3.0}, "text": ["τ = 1.25 h (1.1 … 1.4)"], "old": 1}
    now = {
        "fit": {"rmse": 1.01, "n": 10, "seconds": 4.0},
        "text": ["τ = 1.26 h (1.1 … 1.4)", "more"],
        "new": 2,
    }
    assert list(differences(was, now, 0.02)) == ["/new: new", "/old: gone", "/text: 1 entries, now 2"]
    assert "/fit/rmse: 1.0, now 1.01" in list(differences(was, now, 1e-3))
    assert "/text[0]: 'τ = 1.25 h (1.1 … 1.4)', now 'τ = 1.26 h (1.1 … 1.4)'" in list(
        differences(was, now, 1e-3)
    )


@pytest.mark.parametrize("now", ["τ = 1.25 min", "τ = 1,25 h", "τ 1.25 h", "τ = −1.25 h"])
def test_words_units_and_signs_are_held_exactly(now: str) -> None:
    assert list(differences("τ = 1.25 h", now, 0.5))


def test_a_page_is_its_tags_and_words() -> None:
    text = (
        '<p class="a" id="x7">one\n  two<img src="data:image/png;base64,AAAA" alt="c"></p><style>p '
        "{}</style><svg><g>d</g></svg>"
    )
    assert Page(text).lines == ["<p class=a>", "one two", "<img alt=c>", "</p>", "<svg>"]
