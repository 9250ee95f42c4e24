"""Classes of climatic conditions as limits by name."""

from __future__ import annotations

import pytest
from builders.documents import document

from hygrokf.climate.limits import CLASSES, LIMITED_QUANTITIES, ClassFault, duplicate_name_faults, limits_of


@pytest.mark.parametrize(
    "name", ["IEC 60721-3-3 3K3", "EN 60721-3-3 class 3K3", "DIN EN 60721-3-3 3k3", "3K3"]
)
def test_a_class_by_its_names(name: str) -> None:
    found = {(one.quantity, one.side): one.level for one in limits_of(name)}
    assert found == {
        ("temperature_degC", "above"): 40.0,
        ("temperature_degC", "below"): 5.0,
        ("relative_humidity_percent", "above"): 85.0,
        ("relative_humidity_percent", "below"): 5.0,
    }
    assert all(one.hours_a_year == 0.0 and one.during == "all" for one in limits_of(name))


@pytest.mark.parametrize("name", CLASSES)
def test_every_class_has_its_limits_in_the_docs(name: str) -> None:
    limits = limits_of(name)
    assert duplicate_name_faults(limits) == []
    assert {limit.quantity for limit in limits} <= set(LIMITED_QUANTITIES)
    text = document("climate.md").read_text(encoding="utf-8")
    assert f"| {name} " in text
    for limit in limits:
        assert f"{limit.side} {limit.level:g} {LIMITED_QUANTITIES[limit.quantity]}" in text


def test_a_file_is_read_as_before() -> None:
    assert len(limits_of(document("climate_limits.toml"))) == 5


@pytest.mark.parametrize(
    "name", ["IEC 60721-3-3 3K22", "IEC 60721-3-4 4K4H", "IEC 62477-1", "60721-3-4 3K3", ""]
)
def test_a_class_without_public_numbers_is_refused(name: str) -> None:
    with pytest.raises(ClassFault, match="IEC 60721-3-3 3K3"):
        limits_of(name or "no-such-class")
