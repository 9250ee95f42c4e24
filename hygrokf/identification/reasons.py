"""What speaks for or against a number: every code with the verdict that it gives and its sentence.

`{x}` in a sentence is a text, `{x:3}` a number with three significant digits, `{x:.2}` one with two decimals,
`{x:%}` a share in per cent.
"""

from __future__ import annotations

from collections.abc import Mapping

from hygrokf.identification.verdict_terms import BELIEVE, CAUTION, REJECT, Kind, Reason
from hygrokf.identification.wording import worded

REASONS: Mapping[str, tuple[Kind, str]] = {
    # against a time constant
    "convergence_unknown": (CAUTION, "whether the estimation converged is not stated"),
    "not_converged": (REJECT, "the estimation did not converge{why}"),
    "not_exact": (
        REJECT,
        "the filter's steps are not exact: sub-steps of half the length change ln L by {change:2}",
    ),
    "at_limit": (
        REJECT,
        "the estimate ended at the limit of the search, {value_h:3} h, so the record does not determine it",
    ),
    "input_not_needed": (
        REJECT,
        "the readings do not need the input through which it acts: {model} explains them {how} {by:.0} in "
        "2 ln L (the fit would have to gain {required:.0})",
    ),
    "not_identifiable": (REJECT, "the record bounds it on neither side"),
    "one_sided": (CAUTION, "the record bounds it from {side} only ({sign} {bound_h:3} h)"),
    "undetermined": (
        REJECT,
        "its interval spans {spread} on either side: not even its order of magnitude is known",
    ),
    "imprecise": (CAUTION, "it is known to {spread} only"),
    "guard_reached": (
        CAUTION,
        "{names} ended at a limit that only guards the search, on which the interval may depend",
    ),
    "sensor_stretched": (
        CAUTION,
        "the fit needs a constant error {name} of {error:3}{unit}, {standard_deviations:.1} standard "
        "deviations of the sensor's accuracy: the error absorbs a defect of the model",
    ),
    "criteria_disagree": (
        REJECT,
        "the one-step predictions say {likelihood_h:3} h, the free run says {simulation_h:3} h "
        "({simulation_lower_h:3} … {simulation_upper_h:3}): more than both uncertainties explain; the model "
        "lacks something",
    ),
    "free_run_silent": (
        CAUTION,
        "the free run alone hardly determines it ({simulation_h:3} h, {bounds}): the number rests on the "
        "one-step predictions alone",
    ),
    "worse_than_mean": (
        REJECT,
        "the free run's {quantity} errs by {error:.2} {unit} in {period}, more than the standard deviation "
        "of the readings ({readings_sd:.2} {unit}): their mean would predict better",
    ),
    "worse_than_rule": (
        REJECT,
        "the free run's {quantity} errs by {error:.2} {unit} in {period}, the rule “{rule}” by "
        "{rule_error:.2} {unit}{but}",
    ),
    "band_failed": (
        CAUTION,
        "the free run's 95 % band holds only {coverage:%} of the readings of the {quantity}",
    ),
    "innovations_correlated": (
        CAUTION,
        "the one-step predictions of the {quantity} are still correlated with {beside}, by up to "
        "{correlation:.2}: the interval may be too narrow",
    ),
    "noise_not_as_modelled": (
        CAUTION,
        "the variance of the estimate is {factor:2} times what the model's noise explains: the interval was "
        "widened accordingly, but the noise model is not right",
    ),
    "ambient_coarse": (
        CAUTION,
        "without every second ambient reading it changes by {shift:%}, more than its interval allows: "
        "ambient readings every {ambient_step_min:3} min hardly resolve it",
    ),
    "readings_coarse": (
        CAUTION,
        "the cabinet is read every {step_min:3} min; by then {decayed:%} of a deviation has decayed",
    ),
    "few_readings": (
        CAUTION,
        "{readings:.0} readings determine {parameters:.0} parameters: too few to trust the interval",
    ),
    "record_short": (
        CAUTION,
        "the identification period is {time_constants:2} time constants long: too short to trust the "
        "interval",
    ),
    "record_doubted": (CAUTION, "doubt about the record: {doubt}"),
    "sensor_or_water": (
        REJECT,
        "what the model takes as an error of the humidity sensor may be water in the cabinet",
    ),
    "forms_differ": (
        CAUTION,
        "another form of the model ({form}, weight {weight:%}) gives {other_h:3} h, outside the interval",
    ),
    "parts_differ": (
        CAUTION,
        "parts of the record scatter {scatter:2} times as much as their own bounds explain: the number "
        "changes over the record, or the model lacks something",
    ),
    # for a time constant
    "criteria_agree": (BELIEVE, "the free run alone gives {free}: both criteria agree"),
    # about the free run
    "not_validated": (
        CAUTION,
        "these are the data that the model was fitted to: no later data validate it",
    ),
    "worse_on_new_data": (CAUTION, "the model does worse on new data"),
    "no_better_than_rule": (
        CAUTION,
        "the rule “{rule}” errs by {rule_error:.2} {unit}: the free run is hardly better, however well the "
        "time constant describes the cabinet",
    ),
    "better_than_rule": (BELIEVE, "it errs {gain:%} less than the rule “{rule}” ({rule_error:.2} {unit})"),
    # about the one-step predictions and the bands
    "not_white": (CAUTION, "tests that reject: {kinds}"),
    "correlated_little": (BELIEVE, "the correlations are measurable, but small: at most {correlation:.2}"),
    "correlated": (CAUTION, "still correlated, by up to {correlation:.2}"),
    "bands_narrow": (CAUTION, "too narrow: {bands}"),
    "bands_wide": (CAUTION, "wider than needed: {bands}"),
}


def reason(code: str, verdict: Kind | None = None, /, **values: float | str) -> Reason:
    """The reason of a code with the values of its sentence; `verdict`: where it is not that of the table."""
    usual, template = REASONS[code]
    numbers = {name: float(value) for name, value in values.items() if not isinstance(value, str)}
    return Reason(code, verdict or usual, worded(template, values), numbers)
