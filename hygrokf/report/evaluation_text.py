"""What the scores of a fit on another record say, as blocks and as text for the command line."""

from __future__ import annotations

from hygrokf.identification.fit_on_record import Evaluation
from hygrokf.report.blocks import Block, Heading, Items, Prose
from hygrokf.report.fit_tables import bands_table, rmse_table
from hygrokf.report.inherited import inherited_verdicts
from hygrokf.report.terminal import blocks_text


def evaluation_text(found: Evaluation) -> str:
    """The evaluation as text of at most 100 columns."""
    return "\n\n".join(blocks_text(evaluation_blocks(found)))


def evaluation_blocks(found: Evaluation) -> tuple[Block, ...]:
    """Table III of the paper for both periods, with the rules that need no model, and the bands."""
    tables = [rmse_table(found, "identification"), rmse_table(found, "validation")]
    scored = any(table is not None for table in tables)
    blocks = (
        Heading(f"{found.fit} on {found.record}: errors of the free run"),
        inherited_verdicts(found.verdicts, ""),
        Items(tuple(f"note: {line}" for line in found.statements)) if found.statements else None,
        *(tables if scored else [Prose(NOTHING, "missing")]),
        bands_table(found) if scored else None,
    )
    return tuple(block for block in blocks if block is not None)


NOTHING = (
    "Nothing to score: there is no temperature or absolute humidity of the cabinet at a time when all inputs "
    "are known. Relative humidity needs the temperature beside it; a fit that knows the power needs the "
    "power; after a gap in the inputs the score waits 12 h. See the gaps in `hygrokf check`."
)
