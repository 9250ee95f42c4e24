"""Types of the texts in results that are neither literals nor codes.

All other sentences of a result are statements (`texts.statement`).
"""

from __future__ import annotations

from typing import Annotated, TypeAlias

Name: TypeAlias = Annotated[str, "name"]
"""The name of a signal, parameter, mechanism, quantity or form, or a name that the user gave."""
Unit: TypeAlias = Annotated[str, "unit"]
"""A unit as the tables of signals and parameters write it."""
Instant: TypeAlias = Annotated[str, "instant"]
"""A time in ISO 8601."""
Source: TypeAlias = Annotated[str, "source"]
"""A file as the case names it, maybe with a column."""
Digest: TypeAlias = Annotated[str, "digest"]
"""SHA-256 of a file."""
Version: TypeAlias = Annotated[str, "version"]
"""A version of hygrokf."""
Meaning: TypeAlias = Annotated[str, "meaning"]
"""The meaning of a parameter or mechanism in one line; stored in the result, because a page that is made from
its file does not know the mechanisms of the user."""
ReaderText: TypeAlias = Annotated[str, "sentence of a reader"]
"""A sentence on readings that were masked or repaired; only shown, never evaluated."""
FaultText: TypeAlias = Annotated[str, "text of an exception"]
"""The text of an exception: why a turbine of a fleet has no result."""
TERMS = (FaultText, Name, Unit, Instant, Source, Digest, Version, Meaning, ReaderText)
