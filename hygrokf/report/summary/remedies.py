"""What to do about the reasons against a time constant, in the words of a manager's page."""

from __future__ import annotations

from collections.abc import Iterable

from hygrokf.identification.verdict_terms import Reason

LONGER = "Record for longer, with changes of load and standstills: this record hardly determines the number."
LACKING = "Run “hygrokf discover” on the record: the model lacks something that the readings show."
AGAIN = "Run “hygrokf fit” again with more starts (--starts): the estimation has not ended."
CABINET_FASTER = "Log the cabinet at shorter steps."
AMBIENT_FASTER = "Take the weather from a source with shorter steps."
SECOND_SENSOR = "Compare the humidity sensor with a second one."
DOUBTS = "Settle the doubts about the record first: “hygrokf check” lists them."

REMEDIES = {
    "not_converged": AGAIN,
    "convergence_unknown": AGAIN,
    "at_limit": LONGER,
    "not_identifiable": LONGER,
    "one_sided": LONGER,
    "undetermined": LONGER,
    "imprecise": LONGER,
    "free_run_silent": LONGER,
    "few_readings": LONGER,
    "input_not_needed": LONGER,
    "record_short": LONGER,
    "guard_reached": LONGER,
    "criteria_disagree": LACKING,
    "worse_than_mean": LACKING,
    "worse_than_rule": LACKING,
    "band_failed": LACKING,
    "innovations_correlated": LACKING,
    "noise_not_as_modelled": LACKING,
    "sensor_stretched": LACKING,
    "forms_differ": LACKING,
    "parts_differ": LACKING,
    "ambient_coarse": AMBIENT_FASTER,
    "readings_coarse": CABINET_FASTER,
    "record_doubted": DOUBTS,
    "sensor_or_water": SECOND_SENSOR,
}
"""By the code of the reason (`identification.verdict`)."""
ORDER = (DOUBTS, SECOND_SENSOR, AGAIN, LACKING, LONGER, CABINET_FASTER, AMBIENT_FASTER)


def remedies(reasons: Iterable[Reason]) -> tuple[str, ...]:
    """What to do about reasons, each action once, what comes first first."""
    wanted = {REMEDIES[one.code] for one in reasons if one.code in REMEDIES}
    return tuple(action for action in ORDER if action in wanted)
