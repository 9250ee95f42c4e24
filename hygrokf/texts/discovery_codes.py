"""Sentences of a discovery: conditions under which a simulation errs, evidence for and against causes, and
what to check in the turbine."""

from hygrokf.texts.statement import Code


class ConditionCode(Code):
    """A condition under which the errors of a simulation differ."""

    SATURATED_AIR = "while the simulated relative humidity is {share:%} or more"
    STANDING = "at standstill"
    STOPS_LONGER_THAN = "standstills longer than {hours:g} h"
    STOPS_LONGER_THAN_A_DAY = "standstills longer than a day"
    IN_STOPS = "at {stops}"
    STARTED_AFTER_STOPS = "after {stops}, in the first {hours:g} h of operation"
    PREHEATED_AFTER_STOPS = "after {stops}, during pre-heating"
    PREHEATING = "during pre-heating"
    PREHEATED = "in the first {hours:g} h after pre-heating"
    SINCE_STOP = "{first:g} to {last:g} h after the stop, at standstill"
    LONG_SINCE_STOP = "more than {first:g} h after the stop, at standstill"
    SINCE_START = "{first:g} to {last:g} h after the start, in operation"
    LONG_SINCE_START = "more than {first:g} h after the start, in operation"
    HOURS_OF_THE_DAY = "from {first:g} to {last:g} h UTC"
    MONTH = "in {month}"
    MONTHS = "from {first} to {last}"
    FIRST_THIRD = "in the first third of the record"
    MIDDLE_THIRD = "in the middle of the record"
    LAST_THIRD = "in the last third of the record"
    FIRST_TWO_THIRDS = "in the first two thirds of the record"
    LAST_TWO_THIRDS = "in the last two thirds of the record"
    SINCE_DATE = "since {date:stamp}"
    SINCE_ABOUT_DATE = "since about {date:day}"
    LEVEL_OF_DRIVER = "while the {driver} is {range}"
    RATE_OF_DRIVER = "while the change of the {driver} is {range}"
    EARLIER_DRIVER = "{hours:g} h after the {driver} was {range}"
    DIRECTION_OF_DRIVER = "while the {driver} is between {lower:.0} and {upper:.0}°"
    DRIVER_BELOW = "below {upper:2}{unit:unit}"
    DRIVER_ABOVE = "above {lower:2}{unit:unit}"
    DRIVER_BETWEEN = "between {lower:2} and {upper:2}{unit:unit}"


class DiscoveryCode(Code):
    """A sentence about an error, a cause, the evidence for it, or the search."""

    # errors of a simulation
    SIMULATED_TOO_LOW = "{condition}, simulated {quantity} is {size:2} {unit} too low"
    SIMULATED_TOO_HIGH = "{condition}, simulated {quantity} is {size:2} {unit} too high"
    SIMULATED_TOO_LOW_FOR = "{condition}, simulated {quantity} is {size:2} {unit} too low for {hours:.0} h"
    SIMULATED_TOO_HIGH_FOR = "{condition}, simulated {quantity} is {size:2} {unit} too high for {hours:.0} h"
    EXTENDED_STILL_ERRS = "the extended model still errs: {finding}"
    PERIOD_IN_ERRORS = "the errors of the {quantity} have a period of {period} that no cause explains"
    PERIOD_IN_SCORES = (
        "the daily scores of {cause:words} in the {quantity} have a period of {period}: the effect changes "
        "with it, which this cause does not describe"
    )
    PERIOD_IN_HOURS = "{hours:3} h"
    PERIOD_IN_DAYS = "{days:3} days"

    # the verdict
    ANSWER_CAUSES = "{causes}"
    ANSWER_BESIDE = "something is missing beside {causes}"
    ANSWER_UNKNOWN = "something is missing; the cause is unknown"
    ANSWER_REFUTED = "held-out readings refute {refuted:and}"
    ANSWER_UNPROVEN = "held-out readings do not bear out {refuted:and}"
    ANSWER_NONE = "this record shows no missing cause"
    ANSWER_WRONG = "no cause was found, but the model is not right"
    ANSWER_ENDED = (
        "the budget of {budget:,} {budget:simulation|simulations} ended the search; not judged: {causes:and}"
    )
    SO_FAR = "so far: {answer}"
    SO_FAR_NONE = "so far: no cause is named"
    SETTLE_DOUBT = "settle this first, for a wrong reading looks like a cause: {doubt}"
    NONE_HAS_EVIDENCE = (
        "none of the {tried:.0} causes that were judged has enough evidence; the errors look like the "
        "ordinary disturbances of a cabinet"
    )
    NONE_BUT_WRONG = (
        "none of the {tried:.0} causes that were judged has enough evidence, yet the base model is wrong"
    )
    NONE_EXPLAINS = "none of the {tried:.0} causes that were judged explains it, so no cause is named"
    CONSTANT_WRONG = "its {part} time constant is {verdict}: {why}"
    READINGS_SATURATED = (
        "{share:.1%} of the humidity readings are at the sensor’s ceiling, so condensation cannot be excluded"
    )
    READINGS_REPEATED = (
        "readings of {signal:words} repeat those of the day before, {hours:.0} h in all: {days}; they were "
        "set aside"
    )
    READINGS_REPEATED_OFTEN = (
        "readings of {signal:words} repeat those of the day before, {hours:.0} h in all: {days} and "
        "{more:.0} more {more:day|days}; they were set aside"
    )
    NOT_TOLD_APART = "not told apart: {causes}"
    CONFIDENCE = "confidence {share:%}"
    CONFIDENCE_NEAR_ONE = "confidence > 99 %"
    CONFIDENCE_NOT_STATED = "confidence not stated"

    # what to do
    ALLOW_MORE_SIMULATIONS = "allow more than {budget:,} {budget:simulation|simulations} with --budget"
    LOOK_FOR_RHYTHM = "look for influences with this period that are not logged: tides, routines, duty cycles"
    KEEP_BASE_MODEL = "keep the base model; a cause may be missing that this record does not show"
    FIND_OUT_REPEATS = "find out why the logger repeats readings"
    CHECK_TURBINE = "check in the turbine for {cause:words}: {remedy}"
    TELL_FROM_RIVALS = "to tell {cause:words} from its rivals: {measurement}"
    COMPARE_SENSORS = "compare the humidity sensor with a second one, before anything rests on either"
    CORRECT_CLOCK = (
        '{remedy}; until then write clock_correction = "{correction}" in each [[source]] of {source} in the '
        "case file, added to a correction that already stands there"
    )

    # held-out readings
    REFUTED_NO_EFFECT = "{cause:words}: in the final set of parameters it has no effect"
    REFUTED_NO_GAIN = (
        "{cause:words}: held-out readings speak against it more strongly than the others speak for it"
    )
    REFUTED_UNPROVEN = (
        "{cause:words}: its evidence is small, and it lowers no held-out free-run error by {least:%}"
    )
    REFUTED_WORSE = "{cause:words}: with it the errors of the {quantities:and} on held-out readings grow"
    NOT_BETTER = "it does not improve the prediction of held-out readings"
    NOT_SEEN = "held-out readings show nothing of it, and can neither refute it nor bear it out"
    NO_READINGS_HELD_OUT = "no readings were held out"
    ERROR_FALLS = "a levelled free-run error falls by {share:%}"
    LIKELIHOOD_GROWS = "2 ln L grows by {change:.0}"
    LIKELIHOOD_FALLS = "2 ln L falls by {change:.0}"
    DAYS_WITH_READINGS = "{days:.0} days with readings"
    NOTHING_REFUTED = "no readings were held out, so nothing could be refuted and errors are those of the fit"
    FEW_DAYS_HELD_OUT = "readings of {days:.0} {days:day|days} were held out: too short a part to refute much"
    AFTER_SELECTION = (
        "after selection: held-out readings can refute a cause, so their errors are those of models that "
        "passed; in another season they may be larger"
    )
    BOTH_MODELS_ESTIMATED = "the parameters of both models {criterion}"
    ONE_MODEL_ESTIMATED = "the model’s parameters {criterion}"
    BY_LIKELIHOOD = "maximise the likelihood of the search"
    BY_OUTPUT_ERROR = "minimise the error of the free run (output error)"

    # a cause, and why it was left out
    ALIKE_FORMS = "in this form or {forms:or}: this record cannot tell these apart"
    ALIKE_CAUSES = "this record cannot tell it from {causes:and}"
    ACCEPTED = "accepted"
    ACCEPTED_AHEAD = "accepted, {lead:.0} ahead of the best rival"
    EXCLUDED_REFUTED = "held-out readings refute it"
    EXCLUDED_NO_EFFECT = "the screening finds no effect"
    EXCLUDED_WEAK = "too little evidence"
    EXCLUDED_WEAK_BY_DAYS = "too little evidence in independent days"
    EXCLUDED_LATER_GONE = "it lost its place to a cause that was accepted later"
    EXCLUDED_LEFT_TO_BUDGET = "not judged: the budget ended the search"
    EXCLUDED_NO_FORM = "this record cannot show it"
    MAYBE_HIDDEN = "{why}, but saturated readings may hide it"
    CHOSEN_DATE = "date {date:stamp}"
    CHOSEN_SPANS = "{spans}"
    CHOSEN_SPAN = "{first:stamp} to {last:stamp}"
    CHOSEN_AZIMUTH = "azimuth {azimuth:.0}°"
    CHOSEN_DAYS = "over {days:3g} days"
    CHOSEN_START = "from {hour:g} h UTC"
    CHOSEN_LENGTH = "for {hours:g} h"
    CHOSEN_SHIFT = "stamps moved by {minutes:.1} min"
    AGAINST_SOURCE = "{shift} against {source}"
    CHOSEN_OTHER = "{name} = {value}"
