"""What a text in a result is, where it is no literal and no code of an enumeration.

A result holds no other text: what it has to say are statements (`texts.statement`).
"""

from __future__ import annotations

from typing import Annotated, TypeAlias

Name: TypeAlias = Annotated[str, "name"]
"""Of an entry of a registry (signal, parameter, mechanism, quantity, form), or one that a user gave."""
Unit: TypeAlias = Annotated[str, "unit"]
"""As the registry of signals or of parameters writes it."""
Instant: TypeAlias = Annotated[str, "instant"]
"""In ISO 8601."""
Source: TypeAlias = Annotated[str, "source"]
"""A file as a case names it, maybe with a column."""
Digest: TypeAlias = Annotated[str, "digest"]
"""SHA-256 of a file."""
Version: TypeAlias = Annotated[str, "version"]
"""Of the package."""
Meaning: TypeAlias = Annotated[str, "meaning"]
"""The one-line meaning of a registry's entry, where a user's own mechanism may have brought it: a page drawn
from a file has no registry of those."""
ReaderText: TypeAlias = Annotated[str, "sentence of a reader"]
"""What a reader of tables masked or repaired, which nothing but pages and terminals reads."""
FaultText: TypeAlias = Annotated[str, "text of an exception"]
"""Why a turbine of a fleet has no result."""
TERMS = (FaultText, Name, Unit, Instant, Source, Digest, Version, Meaning, ReaderText)
