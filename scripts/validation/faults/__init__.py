"""What is done to a live tracker, and what is found afterwards."""

from validation.faults.suite import CLAIM

__all__ = ["CLAIM"]
