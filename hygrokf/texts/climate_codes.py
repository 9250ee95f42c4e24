"""Sentences of a climate study: on weather, power, bounds, limits, and what the model lacks."""

from hygrokf.texts.statement import Code


class ClimateCode(Code):
    """A sentence about a region's climate, or a part of one."""

    LENGTH_IN_DAYS = "{days:.0} days"
    LENGTH_IN_HOURS = "{hours:.0} hours"
    ONE_YEAR = "a year"
    MANY_YEARS = "{years:.0} years"

    # power and actuators
    NO_POWER_INPUT = "the model has no power input: the whole year counts as standstill"
    NO_POWER_ALL_YEAR = "the turbine stands still all year: there is no power at any time"
    POWER_BY_RECORD = "power follows its record, hour by hour"
    POWER_BY_SEASON = (
        "power is from another time than the weather, assigned by the time of the year from a record of "
        "{length}: it does not match this weather's wind; {used}"
    )
    POWER_UNKNOWN = "none of it is known"
    POWER_ALL_USED = "all of it, {spans:and}, is used"
    POWER_PARTLY_USED = (
        "the part {spans:and} is used, the rest of the record from {first:day} to {last:day} is not; the "
        "choice matters, because years differ in their hours of standstill"
    )
    POWER_SPAN = "{first:day} … {last:day}"
    POWER_BY_CURVE = (
        "power follows the power curve from the weather's wind at {wind_height_m:g} m, brought to "
        "{hub_height_m:g} m by the {law} (factor {factor:.3}); it has no faults, curtailment or wakes"
    )
    POWER_LAW = "power law, exponent {exponent:g}"
    LOGARITHMIC_LAW = "log law, roughness {roughness_m:g} m"
    RATED_DIFFERENTLY = (
        "the turbine of the power is rated {rated_kW:.0} kW, that of the fit {scale_kW:.0} kW: the heat "
        "release is that of the same power in kW"
    )
    ACTUATOR_BY_RECORD = "{actuator} follows the record of the power, hour by hour"
    ACTUATOR_NOT_RECORDED = "{actuator} is off all year: no record shows when it is on"
    ACTUATOR_NOT_COVERED = (
        "{actuator} is off all year: the record of the power does not cover the weather's time"
    )
    OPERATES = "the turbine operates {share:%} of the time"
    OPERATES_LITTLE = "the turbine operates {share:%} of the time: check unit and sign of the power"
    OPERATES_LITTLE_BY_CURVE = (
        "the turbine operates {share:%} of the time: check units and height of the wind"
    )
    SHOTS = (
        "disturbances are simulated as shots, on average of {shots:and}, because the fit's innovations have "
        "heavier tails than a normal distribution"
    )
    SHOTS_OF_BALANCE = "{balance} every {hours:.0} h"

    # weather
    TYPICAL_YEAR_REPEATED = (
        "the typical year is repeated {years:.0} times, once for each year of power: between_years and the "
        "bounds describe years that differ in their power, not in their weather"
    )
    WEATHER_RARE = (
        "{signal} comes every {step_h:g} h and is interpolated linearly: extremes, rates, cycles and short "
        "excursions are underestimated"
    )
    WEATHER_WITHOUT_DAYS = (
        "{signal} comes every {step_h:g} h and is interpolated linearly: extremes, rates, cycles and short "
        "excursions are underestimated; the course of a day is lost"
    )
    YEARS_LEFT_OUT = (
        "{left_out:.0} of {years:.0} years are left out: less than {share:%} of their weather and power is "
        "known"
    )
    BOUNDS_OF_A_PART = (
        "the bounds rest on {part} of weather and say nothing about the rest of the year or other years"
    )
    BOUNDS_OF_ONE_YEAR = "the bounds rest on one year of weather and say nothing about how years differ"
    SCALED_UP = (
        "the weather covers {length}, not {years}: hours per year are scaled up as if the rest were alike"
    )
    NO_LIMIT_PASSES = (
        "on {part} no limit passes, because the rest of the year may exceed it: a limit that is kept here is "
        "undecided, one that is exceeded fails"
    )
    INPUTS_UNKNOWN = "weather or power is unknown for {share:.1%} of the time, which is left out"
    FEW_MEMBERS = (
        "{members:.0} members are too few: the bounds are the smallest and the largest member, which hold a "
        "single year in {share:%} of cases, not in {level:%}; use {fewest:.0} or more (--members)"
    )
    LIMIT_NOT_JUDGED = 'limit "{limit}" is not judged: the model has no {quantity}, only a temperature'
    PASSES_WITHOUT_HOURS = 'limit "{limit}" passes only because these years have no hours {regime}'
    KEPT_WITHOUT_HOURS = 'limit "{limit}" is not exceeded only because these days have no hours {regime}'
    IN_OPERATION = "in operation"
    AT_STANDSTILL = "at standstill"
    OF_A_PART = "of {part}, not a year"
    AIR_ABOVE_SATURATION = (
        "the cabinet's air is above 100 % for {hours:.0} h a year: the model lacks a process that limits the "
        "humidity (condensation, moisture storage), and the bounds do not include this error; hours of "
        "wetness and condensation are unreliable"
    )
    EXTRAPOLATED_TEMPERATURE = (
        "{hours:.0} h/a are outside the {lower:.1} … {upper:.1} °C of ambient air on which the model was "
        "identified (here {least:.1} … {most:.1}): the model is extrapolated"
    )
    EXTRAPOLATED_HUMIDITY = (
        "{hours:.0} h/a are outside the {lower:.1} … {upper:.1} g/m³ of ambient air on which the model was "
        "identified (here {least:.1} … {most:.1}): the model is extrapolated"
    )
    EXTRAPOLATED_POWER = (
        "{hours:.0} h/a are outside the {lower:.0} … {upper:.0} kW of power on which the model was "
        "identified (here {least:.0} … {most:.0}): the model is extrapolated"
    )

    # the test in a chamber
    NO_PROFILE = "there is no test profile: it needs humidity, and weather known hour by hour for whole days"
    WET_HOURS = "hours above {percent:g} %, %"
    WET_AGEING = "ageing above {percent:g} %, %"
    MEAN_HUMIDITY = "mean relative humidity, %"
    CYCLES_BEFORE_WARMING = "temperature cycles of {range_K:g} K and more, a year, before warming"
    CYCLES_IN_SERVICE = "temperature cycles of {range_K:g} K and more, in service"
    SAME_AGEING = (
        "{hours:.0} hours in the chamber cause the same ageing as {years:3} years at the site ({lower:3} … "
        "{upper:3}). The acceleration factor is {acceleration:3} before the chamber's limits apply; "
        "{share:%} of the hours are at a limit of the chamber's temperature"
    )
    AGEING_TOO_LITTLE = (
        "the chamber cannot reach the ageing of the stated years of service within these limits and this "
        "length: state a longer test, fewer years, or a hotter chamber"
    )
    AGEING_TOO_MUCH = (
        "the chamber cannot reach the ageing of the stated years of service within these limits and this "
        "length: state a shorter test, more years, or a colder chamber"
    )
