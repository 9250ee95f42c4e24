"""The faults with which a reader refuses its input."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hygrokf.errors import HygrokfError


def faults_of(read: Callable, *arguments: object, **options: object) -> tuple[str, ...]:
    """All faults of a call that must fail; the message of the error contains each of them."""
    with pytest.raises(HygrokfError) as caught:
        read(*arguments, **options)
    assert all(fault in str(caught.value) for fault in caught.value.faults)
    return caught.value.faults
