"""Verdicts on numbers, and the reasons for them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, Literal, Self, TypeAlias

from hygrokf.texts.statement import Code, Statement, Value

Kind: TypeAlias = Literal["believe", "caution", "reject"]
BELIEVE: Final = "believe"
CAUTION: Final = "caution"
REJECT: Final = "reject"
VERDICTS: tuple[Kind, ...] = (BELIEVE, CAUTION, REJECT)
"""From best to worst."""
WORDS = {BELIEVE: "reliable", CAUTION: "with caution", REJECT: "not reliable"}
MARKS = {BELIEVE: "✓", CAUTION: "!", REJECT: "✕"}
PLAIN_MARKS = {BELIEVE: "+", CAUTION: "!", REJECT: "x"}
"""Marks for a terminal."""


class ReasonCode(Code):
    """A reason for or against a number: the verdict that it gives on its own, and the template of its
    sentence."""

    # against a time constant
    CONVERGENCE_UNKNOWN = (CAUTION, "whether the estimation converged is not stated")
    NOT_CONVERGED = (REJECT, "the estimation did not converge{why:;}")
    NOT_EXACT = (
        REJECT,
        "the filter's steps are not exact: sub-steps of half the length change ln L, or the parameters in "
        "standard errors, by {change:2}",
    )
    AT_LIMIT = (
        REJECT,
        "the estimate ended at the limit of the search, {value_h:3} h, so the record does not determine it",
    )
    INPUT_NOT_NEEDED = (
        REJECT,
        "the readings do not need the input through which it acts: {model} explains them {how} in "
        "2 ln L (the fit would have to gain {required:.0})",
    )
    NOT_IDENTIFIABLE = (REJECT, "the record bounds it on neither side")
    ONE_SIDED = (CAUTION, "the record bounds it from {side} only ({sign} {bound_h:3} h)")
    UNDETERMINED = (
        REJECT,
        "its interval spans {spread} on either side: not even its order of magnitude is known",
    )
    IMPRECISE = (CAUTION, "it is known to {spread} only")
    GUARD_REACHED = (
        CAUTION,
        "{names} ended at a limit that only guards the search, on which the interval may depend",
    )
    SENSOR_STRETCHED = (
        CAUTION,
        "the fit needs a constant error {name} of {error:3}{unit:unit}, {standard_deviations:.1} standard "
        "deviations of the sensor's accuracy: the error absorbs a defect of the model",
    )
    CRITERIA_DISAGREE = (
        REJECT,
        "the one-step predictions say {likelihood_h:3} h, the free run says {simulation_h:3} h "
        "({simulation_lower_h:3} … {simulation_upper_h:3}): more than both uncertainties explain; the model "
        "lacks something",
    )
    FREE_RUN_SILENT = (
        CAUTION,
        "the free run alone hardly determines it ({simulation_h:3} h, {bounds}): the number rests on the "
        "one-step predictions alone",
    )
    WORSE_THAN_MEAN = (
        REJECT,
        "the free run's {quantity} errs by {error:.2} {unit} in {period}, more than the standard deviation "
        "of the readings ({readings_sd:.2} {unit}): their mean would predict better",
    )
    WORSE_THAN_RULE = (
        REJECT,
        "the free run's {quantity} errs by {error:.2} {unit} in {period}, the rule “{rule}” by "
        "{rule_error:.2} {unit}{but:;}",
    )
    BAND_FAILED = (
        CAUTION,
        "the free run's 95 % band holds only {coverage:%} of the readings of the {quantity}",
    )
    INNOVATIONS_CORRELATED = (
        CAUTION,
        "the one-step predictions of the {quantity} are still correlated with {beside}, by up to "
        "{correlation:.2}: the interval may be too narrow",
    )
    NOISE_NOT_AS_MODELLED = (
        CAUTION,
        "the variance of the estimate is {factor:2} times what the model's noise explains: the interval was "
        "widened accordingly, but the noise model is not right",
    )
    AMBIENT_COARSE = (
        CAUTION,
        "without every second ambient reading it changes by {shift:%}, more than its interval allows: "
        "ambient readings every {ambient_step_min:3} min hardly resolve it",
    )
    READINGS_COARSE = (
        CAUTION,
        "the cabinet is read every {step_min:3} min; by then {decayed:%} of a deviation has decayed",
    )
    FEW_READINGS = (
        CAUTION,
        "{readings:.0} readings determine {parameters:.0} parameters: too few to trust the interval",
    )
    RECORD_SHORT = (
        CAUTION,
        "the identification period is {time_constants:2} time constants long: too short to trust the "
        "interval",
    )
    RECORD_DOUBTED = (CAUTION, "doubt about the record: {doubt}")
    SENSOR_OR_WATER = (
        REJECT,
        "what the model takes as an error of the humidity sensor may be water in the cabinet",
    )
    FORMS_DIFFER = (
        CAUTION,
        "another form of the model ({form}, weight {weight:%}) gives {other_h:3} h, outside the interval",
    )
    PARTS_DIFFER = (
        CAUTION,
        "parts of the record scatter {scatter:2} times as much as their own bounds explain: the number "
        "changes over the record, or the model lacks something",
    )
    # for a time constant
    CRITERIA_AGREE = (BELIEVE, "the free run alone gives {free}: both criteria agree")
    # about the free run
    NOT_VALIDATED = (
        CAUTION,
        "these are the data that the model was fitted to: no later data validate it",
    )
    WORSE_ON_NEW_DATA = (CAUTION, "the model does worse on new data")
    NO_BETTER_THAN_RULE = (
        CAUTION,
        "the rule “{rule}” errs by {rule_error:.2} {unit}: the free run is hardly better, however well the "
        "time constant describes the cabinet",
    )
    BETTER_THAN_RULE = (BELIEVE, "it errs {gain:%} less than the rule “{rule}” ({rule_error:.2} {unit})")
    # about the one-step predictions and the bands
    NOT_WHITE = (CAUTION, "tests that reject: {kinds}")
    CORRELATED_LITTLE = (BELIEVE, "the correlations are measurable, but small: at most {correlation:.2}")
    CORRELATED = (CAUTION, "still correlated, by up to {correlation:.2}")
    BANDS_NARROW = (CAUTION, "too narrow: {bands}")
    BANDS_WIDE = (CAUTION, "wider than needed: {bands}")

    def __init__(self, usual: Kind, template: str) -> None:
        super().__init__(template)
        self.usual = usual

    def __call__(self, verdict: Kind | None = None, /, **values: Value) -> Reason:
        """Return the reason with these values; `verdict`: if it is not the usual one."""
        return Reason(self, values, verdict or self.usual)


class VerdictCode(Code):
    """What a result says if it uses a number that is not reliable."""

    RESTS_ON_REJECTED = (
        "the model's {parts:and} time {count:constant|constants}, on which this rests, {count:is|are} not "
        "reliable"
    )


@dataclass(frozen=True)
class Reason(Statement):
    """A reason for or against a number.

    `verdict`: the one that this reason gives on its own. `source`: name of the fit that the reason was taken
    over from, else "".
    """

    codes: ClassVar[type[Code]] = ReasonCode

    verdict: Kind = BELIEVE
    source: str = ""

    @property
    def text(self) -> str:
        """The sentence; for a reason that was taken over, it names the source."""
        return f"on {self.source}: {super().text}" if self.source else super().text

    def to_json(self) -> dict[str, Any]:
        return {**super().to_json(), "verdict": self.verdict, "source": self.source}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the reason that `to_json` wrote. Raises ValueError for an unknown code or verdict."""
        statement, verdict = super().from_json(data), data.get("verdict")
        if verdict not in VERDICTS:
            known_verdicts = ", ".join(map(repr, VERDICTS))
            raise ValueError(f"expected one of {known_verdicts}, found {verdict!r}")
        return replace(statement, verdict=verdict, source=data.get("source", ""))


def worst_first(reasons: Iterable[Reason]) -> tuple[Reason, ...]:
    """Sort reasons by their verdicts, the worst first."""
    return tuple(sorted(reasons, key=lambda reason: -VERDICTS.index(reason.verdict)))


def verdict_of(reasons: Iterable[Reason]) -> Kind:
    """Return the worst verdict of the reasons; "believe" without any."""
    return max((reason.verdict for reason in reasons), key=VERDICTS.index, default=BELIEVE)
