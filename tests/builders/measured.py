"""Measured data beside the repository, and the mark of tests that need them."""

from __future__ import annotations

from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[2] / "../shared/data"
measured = pytest.mark.skipif(not DATA.exists(), reason="../shared/data is not there")
