"""Sentences of a fleet: why a turbine has no result, and time constants with an open bound."""

from hygrokf.texts.statement import Code


class FleetCode(Code):
    """Why a job was lost, or the bound that a time constant has."""

    NO_WORKER = "no worker of the cluster could run it: {fault}"
    PROCESS_ENDED = "its process ended with status {status:.0}, {attempts:.0} times in a row"
    PROCESS_KILLED = "its process was killed by {signal}, {attempts:.0} times in a row"
    MEMORY_SHORT = "{end}; the system kills processes when memory is short: run it again with fewer --workers"
    LAST_OUTPUT = "{end}; its last output: {output}"
    NOT_ABOVE = "≤ {bound:3} h"
    NOT_BELOW = "≥ {bound:3} h"
    NO_BOUNDS = "not identifiable"
