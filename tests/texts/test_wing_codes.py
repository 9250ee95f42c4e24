"""The texts of discoveries, transfers, climates and fleets: a code with its values, and its sentence."""

from __future__ import annotations

import math
from typing import get_args

import pytest

from hygrokf.discovery.results import Exclusion, Reason, Verdict
from hygrokf.report.discovery_text import ANSWERS, REFUTATIONS
from hygrokf.texts.climate import ClimateCode
from hygrokf.texts.discovery import ConditionCode, DiscoveryCode
from hygrokf.texts.fleet import FleetCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.transfer import TransferCode, TransferVerdict
from hygrokf.texts.verdict import VerdictCode

MARCH_S, JULY_S = 1583020800.0, 1594771200.0
"""1 March and 15 July 2020, midnight UTC."""
STOPS = ConditionCode.STOPS_LONGER_THAN_A_DAY()
RANGE = ConditionCode.DRIVER_BETWEEN(lower=3.04, upper=12.1, unit="m/s")
FALLING = ConditionCode.DRIVER_BELOW(upper=-4.0, unit="%/h")
SPAN = {"first": MARCH_S, "last": JULY_S}
PART = ClimateCode.LENGTH_IN_DAYS(days=80.4)
CELSIUS = {"hours": 8766.0, "lower": -12.04, "upper": 32.0, "least": -20.0, "most": 40.26}
TEXTS: list[tuple[Statement, str]] = [
    # conditions
    (ConditionCode.SATURATED_AIR(share=0.97), "while the simulated relative humidity is 97 % or more"),
    (ConditionCode.IN_STOPS(stops=STOPS), "at standstills longer than a day"),
    (ConditionCode.IN_STOPS(stops=ConditionCode.STOPS_LONGER_THAN(hours=6.0)),
     "at standstills longer than 6 h"),
    (ConditionCode.STARTED_AFTER_STOPS(stops=STOPS, hours=6.0),
     "after standstills longer than a day, in the first 6 h of operation"),
    (ConditionCode.PREHEATED_AFTER_STOPS(stops=STOPS),
     "after standstills longer than a day, during pre-heating"),
    (ConditionCode.PREHEATED(hours=6.0), "in the first 6 h after pre-heating"),
    (ConditionCode.SINCE_STOP(first=0.0, last=3.0), "0 to 3 h after the stop, at standstill"),
    (ConditionCode.LONG_SINCE_START(first=24.0), "more than 24 h after the start, in operation"),
    (ConditionCode.HOURS_OF_THE_DAY(first=10, last=15), "from 10 to 15 h UTC"),
    (ConditionCode.MONTHS(first="March 2020", last="May 2020"), "from March 2020 to May 2020"),
    (ConditionCode.SINCE_DATE(date=MARCH_S), "since 2020-03-01T00:00Z"),
    (ConditionCode.SINCE_ABOUT_DATE(date=MARCH_S), "since about 2020-03-01"),
    (ConditionCode.LEVEL_OF_DRIVER(driver="wind speed", range=RANGE),
     "while the wind speed is between 3.0 and 12 m/s"),
    (ConditionCode.RATE_OF_DRIVER(driver="power", range=FALLING),
     "while the change of the power is below −4.0 %/h"),
    (ConditionCode.EARLIER_DRIVER(driver="sun", hours=3.0,
                                  range=ConditionCode.DRIVER_ABOVE(lower=20.0, unit="")),
     "3 h after the sun was above 20"),
    (ConditionCode.DIRECTION_OF_DRIVER(driver="wind direction", lower=330.0, upper=30.0),
     "while the wind direction is between 330 and 30°"),
    # discovery
    (DiscoveryCode.SIMULATED_TOO_HIGH_FOR(condition=ConditionCode.PREHEATING(), quantity="temperature",
                                          size=1.44, unit="K", hours=5.4),
     "during pre-heating, simulated temperature is 1.4 K too high for 5 h"),
    (DiscoveryCode.PERIOD_IN_ERRORS(quantity="temperature",
                                    period=DiscoveryCode.PERIOD_IN_HOURS(hours=12.42)),
     "the errors of the temperature have a period of 12.4 h that no cause explains"),
    (DiscoveryCode.PERIOD_IN_SCORES(cause="solar_gain", quantity="temperature",
                                    period=DiscoveryCode.PERIOD_IN_DAYS(days=7.0)),
     "the daily scores of solar gain in the temperature have a period of 7.00 days: the effect changes with "
     "it, which this cause does not describe"),
    (DiscoveryCode.ANSWER_ENDED(budget=3000, causes=("rain", "door", "wall")),
     "the budget of 3,000 simulations ended the search; not judged: rain, door and wall"),
    (DiscoveryCode.ALLOW_MORE_SIMULATIONS(budget=1), "allow more than 1 simulation with --budget"),
    (DiscoveryCode.NONE_EXPLAINS(tried=2),
     "none of the 2 causes that were judged explains it, so no cause is named"),
    (DiscoveryCode.READINGS_SATURATED(share=0.034),
     "3.4 % of the humidity readings are at the sensor’s ceiling, so condensation cannot be excluded"),
    (DiscoveryCode.READINGS_REPEATED_OFTEN(signal="cabinet_temperature", hours=51.6, more=1,
                                           days=("2020-03-01", "2020-03-02", "2020-03-03")),
     "readings of cabinet temperature repeat those of the day before, 52 h in all: 2020-03-01, 2020-03-02, "
     "2020-03-03 and 1 more day; they were set aside"),
    (DiscoveryCode.CORRECT_CLOCK(remedy="set the clock", correction="-60min", source="a.csv"),
     'set the clock; until then write clock_correction = "-60min" in each [[source]] of a.csv in the case '
     "file, added to a correction that already stands there"),
    (DiscoveryCode.REFUTED_UNPROVEN(cause="solar_gain", least=0.02),
     "solar gain: its evidence is small, and it lowers no held-out free-run error by 2 %"),
    (DiscoveryCode.REFUTED_WORSE(cause="door_opening", quantities=("temperature", "absolute humidity")),
     "door opening: with it the errors of the temperature and absolute humidity on held-out readings grow"),
    (DiscoveryCode.FEW_DAYS_HELD_OUT(days=1), "readings of 1 day were held out: too short a part to refute "
     "much"),
    (DiscoveryCode.ALIKE_FORMS(forms=("on a wall", "on the roof")),
     "in this form or on a wall or on the roof: this record cannot tell these apart"),
    (DiscoveryCode.ACCEPTED_AHEAD(lead=33.3), "accepted, 33 ahead of the best rival"),
    (DiscoveryCode.AGAINST_SOURCE(shift=DiscoveryCode.CHOSEN_SHIFT(minutes=-60.0), source="b.csv"),
     "stamps moved by −60.0 min against b.csv"),
    (DiscoveryCode.CHOSEN_SPANS(spans=(DiscoveryCode.CHOSEN_SPAN(**SPAN), DiscoveryCode.CHOSEN_SPAN(**SPAN))),
     ", ".join(["2020-03-01T00:00Z to 2020-07-15T00:00Z"] * 2)),
    # transfer and comparison
    (TransferCode.PARTLY_BY_GROUPS(groups=("heat release", "hygric exchange")),
     "transfers after re-estimating heat release and hygric exchange"),
    (TransferCode.STRUCTURE_LACKS(quantity="temperature", unit="K", error=4.0, ratio=2.66),
     "even with all parameters estimated here the simulated temperature errs by 4.00 K, 2.7 times as much as "
     "the fit did on its own record: the model lacks something here; `hygrokf discover` may name it"),
    (TransferCode.RULE_BETTER(quantity="temperature", unit="K", excess=0.4, rule="c = c_amb"),
     "no gain over a rule without a model: the simulated temperature errs by 0.40 K more than “c = c_amb”"),
    (TransferCode.ERROR_GAINED(error=TransferCode.ERROR_HELD_OUT(), quantity="temperature", unit="K",
                               before=1.2, after=0.8, change=TransferCode.BY_OWN_OFFSETS(), gain=0.4,
                               lower=-0.1, upper=0.9),
     "held-out error of the temperature: 1.20 K as it is, 0.80 K after own offsets, a gain of 0.40 K "
     "(−0.10 … 0.90, 95 %)"),
    (TransferCode.ERRS_LESS(better="a", worse="b", difference=0.3, unit="K",
                            period=TransferCode.OVER_VALIDATION(),
                            bounds=TransferCode.BOUNDS_95(lower=0.1, upper=0.5)),
     "a errs by 0.30 K less than b in validation (95 % 0.10 … 0.50)"),
    (TransferCode.DIFFERS_LITTLE(first="a", second="b", least=0.01, unit="K",
                                 period=TransferCode.OVER_WHOLE_RECORD(),
                                 bounds=TransferCode.BOUNDS_LACKING()),
     "a and b differ by less than 0.01 K over the whole record; not enough data for bounds"),
    # climate
    (ClimateCode.POWER_BY_SEASON(length=ClimateCode.ONE_YEAR(),
                                 used=ClimateCode.POWER_ALL_USED(spans=(ClimateCode.POWER_SPAN(**SPAN),))),
     "power is from another time than the weather, assigned by the time of the year from a record of a year: "
     "it does not match this weather's wind; all of it, 2020-03-01 … 2020-07-15, is used"),
    (ClimateCode.POWER_BY_CURVE(wind_height_m=10.0, hub_height_m=80.0, factor=1.35797,
                                law=ClimateCode.LOGARITHMIC_LAW(roughness_m=0.03)),
     "power follows the power curve from the weather's wind at 10 m, brought to 80 m by the log law, "
     "roughness 0.03 m (factor 1.358); it has no faults, curtailment or wakes"),
    (ClimateCode.SHOTS(shots=(ClimateCode.SHOTS_OF_BALANCE(balance="heat", hours=12.3),
                              ClimateCode.SHOTS_OF_BALANCE(balance="vapour", hours=30.0))),
     "disturbances are simulated as shots, on average of heat every 12 h and vapour every 30 h, because the "
     "fit's innovations have heavier tails than a normal distribution"),
    (ClimateCode.YEARS_LEFT_OUT(left_out=4, years=6, share=0.9),
     "4 of 6 years are left out: less than 90 % of their weather and power is known"),
    (ClimateCode.SCALED_UP(length=PART, years=ClimateCode.MANY_YEARS(years=2)),
     "the weather covers 80 days, not 2 years: hours per year are scaled up as if the rest were alike"),
    (ClimateCode.INPUTS_UNKNOWN(share=0.0312),
     "weather or power is unknown for 3.1 % of the time, which is left out"),
    (ClimateCode.FEW_MEMBERS(members=3, share=0.5, level=0.95, fewest=39),
     "3 members are too few: the bounds are the smallest and the largest member, which hold a single year in "
     "50 % of cases, not in 95 %; use 39 or more (--members)"),
    (ClimateCode.PASSES_WITHOUT_HOURS(limit="idle", regime=ClimateCode.AT_STANDSTILL()),
     'limit "idle" passes only because these years have no hours at standstill'),
    (ClimateCode.OF_A_PART(part=PART), "of 80 days, not a year"),
    (ClimateCode.EXTRAPOLATED_TEMPERATURE(**CELSIUS),
     "8766 h/a are outside the −12.0 … 32.0 °C of ambient air on which the model was identified (here "
     "−20.0 … 40.3): the model is extrapolated"),
    (ClimateCode.EXTRAPOLATED_POWER(**CELSIUS),
     "8766 h/a are outside the −12 … 32 kW of power on which the model was identified (here −20 … 40): the "
     "model is extrapolated"),
    (ClimateCode.CYCLES_IN_SERVICE(range_K=5.0), "temperature cycles of 5 K and more, in service"),
    (ClimateCode.SAME_AGEING(hours=1000, years=20.0, lower=17.5, upper=math.nan, acceleration=12.34,
                             share=0.05),
     "1000 hours in the chamber cause the same ageing as 20.0 years at the site (17.5 … –). The acceleration "
     "factor is 12.3 before the chamber's limits apply; 5 % of the hours are at a limit of the chamber's "
     "temperature"),
    (VerdictCode.RESTS_ON_ALL_REJECTED(parts=("thermal", "hygric"), verdict="not reliable"),
     "the model's thermal and hygric time constants, on which this rests, are not reliable"),
    # fleet
    (FleetCode.LAST_OUTPUT(output="boom", end=FleetCode.MEMORY_SHORT(
        end=FleetCode.PROCESS_KILLED(signal="SIGKILL", attempts=2))),
     "its process was killed by SIGKILL, 2 times in a row; the system kills processes when memory is short: "
     "run it again with fewer --workers; its last output: boom"),
    (FleetCode.NOT_ABOVE(bound=0.35), "≤ 0.350 h"),
]  # fmt: skip


@pytest.mark.parametrize(("statement", "text"), TEXTS, ids=lambda one: getattr(one, "code", None))
def test_values_fill_the_template(statement: Statement, text: str) -> None:
    assert statement.text == text
    assert Statement.from_json({"code": statement.code.key, "values": dict(statement.values)}) == statement


def test_every_verdict_and_every_reason_has_its_sentence() -> None:
    assert set(ANSWERS) == set(get_args(Verdict))
    assert set(REFUTATIONS) == set(get_args(Reason))
    excluded = {name for name in DiscoveryCode.__members__ if name.startswith("EXCLUDED_")}
    assert excluded == {f"EXCLUDED_{reason.upper()}" for reason in get_args(Exclusion)}
    assert [str(one) for one in TransferVerdict] == [one().text for one in TransferVerdict]
