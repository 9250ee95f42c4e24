"""Sentences about records: doubts, and what a record cannot tell."""

from __future__ import annotations

from hygrokf.texts.statement import Code, Statement

TOUCHES_THERMAL, TOUCHES_HYGRIC, TOUCHES_BOTH, TOUCHES_NEITHER = (
    ("thermal",),
    ("hygric",),
    ("thermal", "hygric"),
    (),
)
"""The time constants that a doubt makes doubtful, too."""
TOUCHED_BY_SIGNAL = None
"""The time constants depend on the signal of the doubt."""


class RecordCode(Code):
    """Phrases in doubts and remedies, and what a record cannot tell."""

    # times
    PERIOD = "{start:stamp} to {end:stamp}"
    INSTANT = "{start:stamp}"
    BETWEEN = "between {start:stamp} and {end:stamp}"
    AT_TIMES = "{times}"
    IN_WINTER = "in winter"
    IN_SUMMER = "in summer"
    NOVEMBER_TO_MARCH = "from November to March"
    APRIL_TO_OCTOBER = "from April to October"
    # clocks
    CLOCK_RIGHT = "right"
    CLOCK_SLOW = "{by:shift} slow"
    CLOCK_FAST = "{by:shift} fast"
    COMES_LATE = "{minutes:.0} min late ({low:.0} … {high:.0})"
    COMES_EARLY = "{minutes:.0} min early ({low:.0} … {high:.0})"
    BY_SEASON = "{first:+shift} {early} and {second:+shift} {late}"
    CLOCK_WITHOUT_SUMMER_TIME = (
        "{needed}: it has no summer time although its stamps are read with it. Read them at the clock's own "
        "fixed offset{zone:;}, with ignore_offset = true where the stamps carry offsets"
    )
    OFFSET_OF_WINTER = ": timezone = the offset of winter"
    OFFSET_OF_UTC = ': timezone = "UTC" if they are read at {offset} in winter'
    CLOCK_WITH_SUMMER_TIME = (
        "{needed}: it follows summer time although its stamps are read at a fixed offset. State its zone by "
        'name, such as timezone = "{zone}"'
    )
    CLOCK_SEEMS = "the clock of {source} seems {pace}"
    CLOCK_SEEMS_BY_SEASON = "the clock of {source} seems {winter} in winter and {summer} in summer"
    STATE_CORRECTION = 'state clock_correction = "{correction}" in that source'
    STAMPS_NEED = "its stamps need {remedy}"
    CLOCK_UNTOLD = "the record cannot tell whether the clock of {source} is right within an hour"
    CLOCKS_TOO_SHORT = "clocks: fewer than 14 days in common to tell whether they agree"
    # units, columns and decimal marks
    SEEM = "{signals:and} {count:seems|seem} {mistake}"
    IN_OTHER_UNIT = "in {unit}, called {called}"
    FRACTIONS_CALLED_PER_CENT = "fractions, called per cent"
    PER_CENT_CALLED_FRACTIONS = "per cent, called fractions"
    WRONG_DECIMAL_MARK = "read with the wrong decimal mark"
    SEEM_EXCHANGED = "{pairs:and} seem exchanged"
    PAIR = "{first} and {second}"
    STATE_UNIT = 'unit = "{unit}"'
    STATE_DECIMAL_MARK = 'decimal = "," or "."'
    EXCHANGE_COLUMNS = "exchange their columns"
    WITNESSED = " ({witnesses:and}; {gain:.0} in ln L)"
    WOULD_FIT = "; they would fit as {units:or}"
    BESIDE_RATED = "reaches {high_kW:4g} kW, {times:3g} times the rated {rated_kW:g} kW"
    POWER_IN_OTHER_UNIT = "active_power is called {unit} and {beside}: correct its unit or rated_power_kW"
    OUT_OF_RANGE_MASKED = (
        "{label}: {n:.0} {n:reading|readings} outside of {low} … {high} masked, such as {examples:and} "
        "({when})"
    )
    IN_FILE = " in {file}"
    # quality
    VOCABULARY_FITS = "state vocabulary = {fits:or}, which fits {marks}{more:;}"
    NO_VOCABULARY_FITS = (
        "no known vocabulary fits {marks}{more:;}: list the good marks, such as vocabulary = [1]"
    )
    AND_MORE = " …"
    FURTHER_ADVICE = "; {advice}"
    QUALITY_MISFIT = "the vocabulary does not define all quality marks: {advice}"
    QUALITY_MEANING = "the meaning of the quality marks is not known: {advice}"
    QUALITY_OF_COLUMN = 'column "{column}", "{name}": {doubt}'
    QUALITY_UNSTATED = (
        'column "{column}": "{name}" beside it seems to hold its quality, which is not used: state quality = '
        '"{name}", or "" if it is none{advice:;}'
    )


class DoubtCode(Code):
    """A doubt about a record: the time constants that it makes doubtful, too, and the template of its
    sentence."""

    CLOCK_RUNS = (
        TOUCHES_BOTH,
        "the clock of {source} runs {pace} against {other}: by their stamps the weather comes {lag}; its "
        "stamps need {needed:+shift}. If {other} is right, {remedy}",
    )
    CLOCK_RUNS_BY_SEASON = (
        TOUCHES_BOTH,
        "the clock of {source} runs {first_pace} {early} and {second_pace} {late} against {other}: by their "
        "stamps the weather comes {first_lag} {early} and {second_lag} {late}; its stamps need {remedy}",
    )
    NOT_COMPARED = (
        TOUCHES_NEITHER,
        "{file} cannot be compared ({signals}): fewer than {fewest_d:g} days in common with the source that "
        "is used",
    )
    READ_OTHERWISE = (TOUCHES_BOTH, "{mistake}{evidence:;}: if so, {remedy}")
    CLOCK_OR_WALL = (
        TOUCHES_BOTH,
        "either the clock is wrong ({mistake}{evidence:;}; then {remedy}) or a wall is heavy; power, "
        "humidity or the sun would tell which, and none of them does here",
    )
    EITHER_CLOCK = (
        TOUCHES_BOTH,
        "{mistake}{evidence:;} (then {remedy}), or {other_mistake} (then {other_remedy})",
    )
    RADIATION_LATE = (
        TOUCHES_BOTH,
        "the sun's radiation is centred {minutes:.0} min after solar noon at the site: wrong zone, wrong "
        "stamp (start, middle, end) or wrong longitude? If the clock is wrong, {remedy}",
    )
    RADIATION_EARLY = (
        TOUCHES_BOTH,
        "the sun's radiation is centred {minutes:.0} min before solar noon at the site: wrong zone, wrong "
        "stamp (start, middle, end) or wrong longitude? If the clock is wrong, {remedy}",
    )
    # readings
    CALLED_PER_CENT = (
        TOUCHED_BY_SIGNAL,
        "{signal} is called %, but its readings reach only {high:3g}: they look like fractions; state unit = "
        '"1"',
    )
    CALLED_FRACTION = (
        TOUCHED_BY_SIGNAL,
        "{signal} is called a fraction (unit 1), but its readings reach {high:3g}: they look like per cent; "
        'state unit = "%"',
    )
    HOTTER_THAN_CLIMATES = (
        TOUCHED_BY_SIGNAL,
        "{signal} is called degC, but half of its readings exceed {median:4g}, hotter than any climate; they "
        "would fit as degF: correct the unit or the column",
    )
    WRONG_UNIT = (
        TOUCHED_BY_SIGNAL,
        "{signal} is called {unit}, but its readings (median {median:4g}) do not lie within {low} … "
        "{high}{hint:;}: correct the unit or the column",
    )
    OUT_OF_RANGE = (
        TOUCHED_BY_SIGNAL,
        "{label}: {n:.0} {n:reading|readings} outside of {low} … {high}, such as {examples:and} ({when}); "
        "read_case and read_frames mask such readings",
    )
    SAME_READINGS = (
        TOUCHED_BY_SIGNAL,
        "{inside} and {signal} are the same readings ({inside_source}; {source}): one of the two columns is "
        "wrong",
    )
    COMPUTED_FROM_CABINET = (
        TOUCHED_BY_SIGNAL,
        "{signal} ({source}) is computed from the cabinet's own readings ({temperature_source}; "
        "{humidity_source}): name the source of the air outside, or call it {instead}",
    )
    QUALITY_DOUBTED = (TOUCHED_BY_SIGNAL, "{file}: {doubt}")
    OTHER_PROBE = (
        TOUCHES_HYGRIC,
        '{temperature} ({temperature_file}, column "{temperature_column}") is not of the probe of {humidity} '
        '({humidity_file}, column "{humidity_column}"), whose own temperature is there ("{own}"): relative '
        "humidity holds at the temperature of its own probe",
    )
    ONLY_ON_CHANGE = (
        TOUCHES_NEITHER,
        "{signal} comes only when it changes (no two successive values are equal), and is joined by lines: "
        'state hold = "previous" if each value holds until the next',
    )
    BEGINS_TOO_EARLY = (
        TOUCHES_NEITHER,
        "the readings begin on {start:stamp}: are the times seconds since 1970-01-01T00:00Z, or since the "
        "start of the record?",
    )
    NO_OVERLAP = (
        TOUCHES_NEITHER,
        "no overlap: {signals}{file:;} ({period}) and the cabinet's readings ({of_cabinet}) share no time; "
        "check the sources, and zone and offset of their stamps",
    )
    GAPS_OUTSIDE = (
        TOUCHES_NEITHER,
        "{lost:.0} of the {n:.0} readings of {signal} are not used: the ambient {unknown:and} is unknown "
        "then, in gaps too long to bridge",
    )
    MANY_MISSING = (TOUCHES_NEITHER, "{signal}: {share:%} of its readings are missing")
    IRREGULAR_STEPS = (
        TOUCHES_NEITHER,
        "irregular steps in {file}: only {share:%} of the steps are {step_s:duration}",
    )
    AMBIENT_TOO_COARSE = (
        TOUCHES_NEITHER,
        "ambient temperature every {step_s:duration} only: the cabinet's response to it (rho) will hardly be "
        "resolved",
    )
    # periods
    SHORT_RECORD = (
        TOUCHES_NEITHER,
        "short record: {days:.1} days; below {least:.0} days weather and operation hardly vary, and bounds "
        "will be wide",
    )
    NO_VALIDATION_PERIOD = (
        TOUCHES_NEITHER,
        "no validation period: every score will be computed on the fitted data; state [identification] until",
    )
    UNTIL_OUTSIDE = (TOUCHES_NEITHER, "until = {until:stamp} is outside of the record ({period})")
    SHORT_PERIOD = (TOUCHES_NEITHER, "short {period} period: {days:.1} days")
    # power
    POWER_ABSENT = (TOUCHES_NEITHER, "no active power: the whole record counts as standstill")
    POWER_UNREAD = (TOUCHES_NEITHER, "active power has no reading: the whole record counts as standstill")
    POWER_NEGATIVE = (
        TOUCHES_THERMAL,
        "active power is negative for {share:%} of its readings and hardly ever positive: is the sign "
        "reversed (feed-in is positive)?",
    )
    NO_STANDSTILL = (
        TOUCHES_NEITHER,
        "no standstill: {share:.1%} of the power readings are ≤ 0, so standstill cannot be identified apart "
        "from operation",
    )
    LITTLE_OPERATION = (TOUCHES_NEITHER, "hardly any operation: {share:%} of the power readings are ≤ 0")
    NO_RATED_POWER = (
        TOUCHES_NEITHER,
        "no rated power: stationary periods cannot be found; state rated_power_kW",
    )
    POWER_BESIDE_RATED = (TOUCHES_NEITHER, "active power {beside}: are its unit and the rated power right?")
    POWER_COVERS_LITTLE = (TOUCHES_NEITHER, "active power covers only {share:%} of the period of {signal}")
    # what a model needs
    NO_CABINET_SIGNAL = (TOUCHES_NEITHER, "no cabinet signal: nothing can be identified or scored")
    NO_CABINET_TEMPERATURE = (
        TOUCHES_NEITHER,
        "no cabinet temperature: the thermal model cannot be identified",
    )
    NO_CABINET_HUMIDITY = (TOUCHES_NEITHER, "no cabinet humidity: only the thermal model can be identified")
    NO_AMBIENT_HUMIDITY = (TOUCHES_NEITHER, "no ambient humidity: the hygric model has no input")
    COLDER_THAN_OUTSIDE = (
        TOUCHES_BOTH,
        "the cabinet is {colder_K:.1} K colder than outside on average: are the columns swapped?",
    )
    OTHER_VAPOUR = (
        TOUCHES_HYGRIC,
        "absolute humidity in the cabinet is {factor:.2} times that outside on average: a source or sink of "
        "vapour, a sensor error, or the wrong column",
    )

    def __init__(self, touches: tuple[str, ...] | None, template: str) -> None:
        super().__init__(template)
        self.touches = touches


def touched(doubt: Statement) -> tuple[str, ...]:
    """Return the time constants ("thermal", "hygric") that a doubt about a record makes doubtful, too."""
    touches = doubt.code.touches if isinstance(doubt.code, DoubtCode) else TOUCHES_NEITHER
    return told_by(str(doubt.values["signal"])) if touches is TOUCHED_BY_SIGNAL else touches


def told_by(signal: str) -> tuple[str, ...]:
    """Return the time constants that depend on a signal."""
    if "humidity" in signal or "dew_point" in signal:
        return TOUCHES_HYGRIC
    return (
        TOUCHES_BOTH
        if signal.endswith("_temperature")
        else TOUCHES_THERMAL
        if signal == "active_power"
        else TOUCHES_NEITHER
    )


def period(start_s: float, end_s: float) -> Statement:
    """Return the statement of a period [s since 1970]; for a period without length, of its instant."""
    same = round(start_s) == round(end_s)
    return RecordCode.INSTANT(start=start_s) if same else RecordCode.PERIOD(start=start_s, end=end_s)
