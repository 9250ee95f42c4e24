"""Sentences of a transfer and of a comparison: verdicts, groups of parameters, reasons and differences."""

from hygrokf.texts.statement import Code


class TransferVerdict(Code):
    """Whether a model holds on another turbine."""

    TRANSFERS = "transfers"
    PARTLY = "transfers after re-estimating"
    DOES_NOT_TRANSFER = "does not transfer"
    CANNOT_BE_JUDGED = "cannot be judged"

    def __str__(self) -> str:
        return self.template


class TransferCode(Code):
    """A sentence about a transfer or a comparison."""

    PARTLY_BY_GROUPS = "transfers after re-estimating {groups:and}"

    # about the record and the source
    NO_UNTIL = "no `until` is stated: estimated on the first three quarters, up to {until}"
    SAME_FILES = (
        "this record was read from the files of the fit: if the columns are also the same, both estimates "
        "come from the same readings, which does not test the fit"
    )
    ONE_OF_THE_TYPE = "{record} is one of the turbines of the type: its record hardly tests the type"
    UNKNOWN_TO_THE_TYPE = "the type has no value of {names}: estimated on this record, not judged"
    NO_INFORMATION = "this record holds no information about {names}: kept unchanged"

    # groups of parameters
    GROUP_OF_THE_RECORD = "always estimated on the record itself"
    GROUP_NOT_SHOWN = "this record cannot show"
    GROUP_ALIKE = "no difference beyond both uncertainties"
    GROUP_OPEN = (
        "no difference beyond both uncertainties, but this record cannot exclude a difference that would "
        "matter"
    )
    GROUP_IMMATERIAL = "differs measurably, but too little to matter"
    GROUP_DIFFERS = "differs by more than both uncertainties explain, and enough to matter"
    RATIO_OF_DIFFERING = "re-estimating the groups that differ"
    RATIO_OF_REST = "re-estimating the rest"

    # reasons
    ALL_GROUPS_DIFFER = "all groups of the cabinet differ ({groups:and}): identify this turbine on its own"
    ENDED_AT_LIMIT = "at a limit of its range after re-estimating: {names}"
    STRUCTURE_LACKS = (
        "even with all parameters estimated here the simulated {quantity} errs by {error:.2} {unit}, "
        "{ratio:.1} times as much as the fit did on its own record: the model lacks something here; `hygrokf "
        "discover` may name it"
    )
    RULE_BETTER_UNBOUNDED = (
        "the simulated {quantity} errs by {excess:.2} {unit} more than the rule “{rule}”, and {readings:.0} "
        "readings are too few for bounds: use a longer record"
    )
    RULE_BETTER = (
        "no gain over a rule without a model: the simulated {quantity} errs by {excess:.2} {unit} more than "
        "“{rule}”"
    )
    WORSE_RE_ESTIMATED = (
        "re-estimating {groups:and} makes the error of the simulated {quantity} larger by {excess:.2} "
        "{unit}, beyond its bounds: the estimates of the identification period do not hold afterwards; use a "
        "longer period"
    )
    ERROR_BEFORE_AND_AFTER = (
        "{error} of the {quantity}: {before:.2} {unit} as it is, {after:.2} {unit} after {change}"
    )
    ERROR_GAINED = (
        "{error} of the {quantity}: {before:.2} {unit} as it is, {after:.2} {unit} after {change}, a gain of "
        "{gain:.2} {unit} ({lower:.2} … {upper:.2}, 95 %)"
    )
    ERROR_HELD_OUT = "held-out error"
    ERROR_IDENTIFIED = "error"
    BY_RE_ESTIMATING = "re-estimating"
    BY_OWN_OFFSETS = "own offsets"

    # comparisons
    NOTHING_TO_SCORE = (
        "nothing to score: no temperature or absolute humidity of the cabinet at a time when all inputs are "
        "known (a fit that knows the power needs the power); see `hygrokf check`"
    )
    NO_COMMON_INSTANTS = "the columns have no common instants: compare the bounds of their errors"
    ERRS_LESS = "{better} errs by {difference:.2} {unit} less than {worse} {period}{bounds}"
    DIFFERS_LITTLE = "{first} and {second} differ by less than {least:.2} {unit} {period}{bounds}"
    OVER_VALIDATION = "in validation"
    OVER_WHOLE_RECORD = "over the whole record"
    BOUNDS_LACKING = "; not enough data for bounds"
    BOUNDS_INCLUDE_ZERO = "; the bounds include zero"
    BOUNDS_STATED = " (95 % {lower:.2} … {upper:.2})"
