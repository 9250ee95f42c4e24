"""Sentences of fits and of their evaluation on other records."""

from __future__ import annotations

from hygrokf.texts.statement import Code


class FitCode(Code):
    """A sentence about a search for a maximum, its bounds, a model, the innovations, or a fit on another
    record."""

    # how a search for a maximum ended
    CONVERGED = "converged"
    CONVERGED_AT_BOUNDS = "converged: every free parameter is at a bound"
    START_NOT_FINITE = "the likelihood is not finite at the start"
    NO_SUB_STEPS = "no sub-steps resolve the rates at the end point"
    NO_STEP_IMPROVES = "no step improves the likelihood, yet its score is not zero"
    PASSES_SPENT = "stopped after {passes:.0} passes"
    BUDGET_SPENT = (
        "stopped after its budget of {budget:.0} filter steps per instant; one pass takes {steps:.0} here, "
        "which points to a time constant far shorter than the interval between the readings: narrow its "
        "bounds"
    )
    SEARCH_UNFINISHED = "not converged: {end}; try more starts or other start values"
    NESTED_MODEL_HIGHER = (
        "not converged: a nested model has a higher likelihood, by {gain:.2} in ln L; give start values "
        "nearer to that model, more starts or wider bounds"
    )
    STEPS_TOO_LONG = (
        "{end}; not exact: sub-steps of half the length change ln L, or the parameters in standard errors, "
        "by {change:2g}; give the likelihood tolerance={tolerance:1g}"
    )
    # bounds of a parameter
    OPEN_ON_BOTH_SIDES = "not identifiable from this record"
    AT_MOST = "≤ {bound:3g}{unit:unit}"
    AT_LEAST = "≥ {bound:3g}{unit:unit}"
    END_STAYS_OPEN = (
        "the {end} end stays open: there {parameter} is {value:3g}{unit:unit}, far beyond its limit "
        "{limit:3g}{unit:unit}"
    )
    END_NOT_FOUND = "the {end} end was not found in {passes:.0} passes"
    AT_BOUND_OR_FIXED = "at a bound or fixed"
    NO_SANDWICH = (
        "no sandwich: the scores of {parameter} depend on each other over too large a part of the record; it "
        "takes one {length:2g} times as long"
    )
    AS_IF_MODEL_RIGHT = "as if the model were right ({why})"
    BOUND_BEYOND_GUARD = (
        "the {end} bound of {bounded} has {parameter} = {value:3g}{unit:unit}, beyond the limit "
        "{limit:3g}{unit:unit} of its search"
    )
    BOUND_AT_PHYSICAL_LIMIT = (
        "the {end} bound of {bounded} has {parameter} = {value:3g}{unit:unit}, its physical limit"
    )
    # the model for a record
    NO_HUMIDITY = "no humidity readings of both inside and outside: the hygric model is left out"
    NO_POWER = "no power in the record: all of it counts as standstill"
    POWER_NEVER_POSITIVE = "the power never rises above zero: all of the record counts as standstill"
    HARDLY_ANY_STANDSTILL = (
        "hardly any standstill in the record: the heat release at standstill is that of operation"
    )
    HARDLY_ANY_OPERATION = "hardly any operation in the record: its heat release cannot be identified"
    POWER_CONSTANT = "the power hardly varies: the heat release has no slope over it"
    MODEL_OF_FIT = "the model and its first start are those of the fit {fit} by {criterion}"
    MODEL_TAKEN_OVER = "design and values that are marked as fixed come from {fit}"
    FORMS_NOT_COMPARED = "other forms of the model were not compared"
    ACTUATOR_UNUSED = "{signal} is not used: {why}"
    ACTUATOR_USED = "{signal} is a known input of the {networks:and the} network"
    ACTUATOR_UNREAD = "it has no reading"
    ACTUATOR_CONSTANT = "it never changes, so its effect is part of the model's constants"
    ACTUATOR_RARE = (
        "{above:.0} readings above half of its span and {below:.0} below; at least {fewest:.0} of each are "
        "needed"
    )
    HEATER_POWER_LOGGED = "heater_power says what the heater does"
    # heat release from stationary periods
    NO_READINGS_FOR_PERIODS = "no readings of {signals:and}: no heat release from stationary periods"
    REGIME_ABSENT = "{regime}: none in the record"
    TOO_FEW_PERIODS = (
        "{regime}: {periods:.0} quasi-stationary periods of {window_h:3g} h in {episodes:.0} episodes within "
        "{hours:.0} h are too few for a regression, which needs {fewest_periods:.0} in {fewest_episodes:.0}: "
        "the likelihood alone determines the heat release"
    )
    # what an estimate rests on
    SENSOR_ERRORS_ZERO = (
        "the criterion is the smallest free-run error: it sets constant errors of the cabinet's sensors to "
        "0, so that the other parameters absorb them"
    )
    NO_FEED_THROUGH = (
        "resistance_ratio is at its limit 1: the readings show no fast feed-through of the ambient "
        "temperature, so R_IC cannot be distinguished from 0"
    )
    AT_LIMITS = "at a limit, so without standard error: {names}"
    BOUNDS_OF = "{parameter}: {bounds:;}"
    NOT_DETERMINED = "not determined by this record: {names}"
    ONLY_COMBINATION = (
        "{first} and {second} are strongly correlated ({correlation:.2}): only a combination is identified"
    )
    COMBINATION_KNOWN_BETTER = (
        "{first} and {second} are strongly correlated ({correlation:.2}): a combination is known better than "
        "either of them"
    )
    OPERATION_KNOWN_BETTER = (
        "{first} and {second} are strongly correlated ({correlation:.2}): their {operation} is known better "
        "than either of them"
    )
    CLOCKS_NOT_COUNTED = "the bounds do not count what the clocks' errors may add"
    # models in which an input does not act
    CONSTANT_VAPOUR = "a constant vapour outside"
    HELD_HUMIDITY = "a relative humidity held in the cabinet"
    CONSTANT_INPUTS = "a constant temperature outside with constant power"
    # parts of reasons for a verdict
    EXPLAINS_BETTER = "better, by {by:.0}"
    EXPLAINS_AS_WELL = "as well up to chance, worse by {by:.0}"
    BECAUSE = " ({why:;})"
    WITHIN_BOUNDS = "{lower_h:3} … {upper_h:3} h"
    WITHOUT_BOUNDS = "without bounds"
    WITHIN_FACTOR = "a factor of {factor:2}"
    WITHIN_SHARE = "±{share:%}"
    WITHIN_SMALL_SHARE = "±{share:.1%}"
    OWN_BEST_AGREES = ", though its own best constant agrees with the number"
    OWN_BEST_DIFFERS = ", and its own best constant does not confirm the number"
    EARLIER_INNOVATIONS = "earlier innovations"
    THE_INPUT = "the {input:words}"
    # tests of the innovations
    TOO_FEW_INNOVATIONS = (
        "{output} innovations: {n:.0} {n:reading|readings}, too few for a diagnosis ({fewest:.0})"
    )
    CONSTANT_INNOVATIONS = "{output} innovations do not vary: nothing to diagnose"
    WHITE = "{output} innovations: none of {tests:.0} tests rejects white noise"
    MEAN_SMALL = "{output} innovations have a mean of {mean:.2} standard deviations instead of 0 (small)"
    MEAN_BIASED = (
        "{output} innovations have a mean of {mean:.2} standard deviations instead of 0: the prediction is "
        "biased"
    )
    WIDER_THAN_PREDICTED = (
        "{output} innovations are {excess:%} wider than the filter predicts (variance {variance:.2} instead "
        "of 1): its one-step band is too narrow"
    )
    NARROWER_THAN_PREDICTED = (
        "{output} innovations are {excess:%} narrower than the filter predicts (variance {variance:.2} "
        "instead of 1): its one-step band is too wide"
    )
    NOT_NORMAL = (
        "{output} innovations are not normal ({shape}: excess kurtosis {kurtosis:.2}, skewness "
        "{skewness:.2}): {beyond:.2%} lie beyond ±3, where {expected:.2%} are expected"
    )
    TAILS_HEAVY = "tails heavier than normal"
    TAILS_LIGHT = "tails lighter than normal"
    SKEWED = "skewed"
    AUTOCORRELATED = (
        "{output} innovations are autocorrelated over lags up to {longest_h:3g} h (Ljung–Box {p:p}), most at "
        "lag {lag_h:3g} h ({size}){remarks:;}"
    )
    SPECTRUM_TOO_HIGH = (
        "{output} innovations are not white: their cumulative periodogram leaves its band (distance "
        "{distance:.3}, limit {limit:.3}), with too much power at periods longer than {period_h:2g} h"
    )
    SPECTRUM_TOO_LOW = (
        "{output} innovations are not white: their cumulative periodogram leaves its band (distance "
        "{distance:.3}, limit {limit:.3}), with too little power at periods longer than {period_h:2g} h"
    )
    DAILY_CYCLE = (
        "{output} innovations keep a daily cycle of {amplitude:.2} standard deviations ({p:p}), "
        "{explained:.1%} of their variance: sun, ventilation or people may follow a daily cycle"
    )
    CORRELATED_WITH_INPUT = (
        "{output} innovations are correlated with the {input:words} at lag {lag_h:lag} ({size}){remarks:;}"
    )
    CORRELATION = "r = {r:.2}, limit {limit:.2}"
    CORRELATION_NEAR_LIMIT = "r = {r:.3}, limit {limit:.3}"
    SMALL_SHARE = ", small: {share:.1%} of the variance"
    READINGS_LEAD = (
        ": the readings move before the {input:words} does, so check the clocks and the hold first"
    )
    # a fit on another record
    INPUT_UNKNOWN_THROUGHOUT = (
        "at no instant are all inputs known (inputs_known is 0 in every row): some input is always missing, "
        "or was until shortly before; `hygrokf check` lists the gaps"
    )
    POWER_UNKNOWN_THROUGHOUT = (
        "at no instant are all inputs known (inputs_known is 0 in every row): the fit uses the power, but "
        "the record has no active_power, so the simulation takes the turbine to stand still throughout; add "
        "active_power to the record"
    )
    OTHER_RATED_POWER = (
        "this turbine's rated power is {ratio:.2} times that of the fit: another type? The heat release "
        "counts power in the fit's scale"
    )
    PREHEATING_NOT_LOGGED = (
        "the fit's model has pre-heating, but the record has no such signal: pre-heating counts as off"
    )
    PREHEATING_NOT_MODELLED = "the record has pre-heating, which the fit's model does not use"
    OTHER_HUMIDITY = "the fit predicts {predicted}, the record has {recorded}: the humidity is not scored"
