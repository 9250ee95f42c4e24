"""What a fit says of another record."""

from hygrokf.texts.statement import Code


class FitCode(Code):
    """A sentence about a fit."""

    INPUT_UNKNOWN_THROUGHOUT = (
        "no row has all inputs known (inputs_known is 0 throughout): throughout, an input is unknown or was "
        "until shortly before; see the gaps in `hygrokf check`"
    )
    POWER_UNKNOWN_THROUGHOUT = (
        "no row has all inputs known (inputs_known is 0 throughout): the fit uses the power, but the record "
        "has no active_power: all of it counts as standstill"
    )
    OTHER_RATED_POWER = (
        "this turbine's rated power is {ratio:.2} times that of the fit: another type? The heat release "
        "counts power in the fit's scale"
    )
    PREHEATING_NOT_LOGGED = (
        "the fit's model has pre-heating, but the record has no such signal: pre-heating counts as off"
    )
    PREHEATING_NOT_MODELLED = "the record has pre-heating, which the fit's model does not use"
    OTHER_HUMIDITY = (
        "the fit predicts {predicted}, the record has {recorded}: the humidity is not scored"
    )
