"""Measured records, and what is known of them.

Attics: the air in the middle under the roof stands for the cabinet, the weather station for the ambient.
House: the living room.  Neither has a converter, so there is no power.  The loggers inside and the weather
station are two sources with a clock each, although they come in one file.

Where the sun or an actuator was logged, a variant of the record withholds it: what is hidden then is known by
construction.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd

from hygrokf.cases.case_file import read_case
from hygrokf.data.record import Record
from validation.frame import DATA, Absent

IDENTIFIED = 2.0 / 3.0
"""Share of a record, from its start, that identifies; the rest gives the gain."""
INSIDE = ("cabinet_temperature", "cabinet_relative_humidity")

COLUMNS = {
    "cabinet_temperature degC": (
        "T_roofmiddle_airmiddle", "T2", "controller_temperature_degC", "T_in", "air_temperature_degC",
    ),
    "cabinet_relative_humidity %": (
        "RH_roofmiddle_airmiddle", "RH_2", "RH_in", "air_relative_humidity_pct",
    ),
    "ambient_temperature degC": ("T_fmi", "T_roofwest_outside", "T_out", "outside_temperature_degC"),
    "ambient_relative_humidity %": (
        "RH_fmi", "RH_roofwest_outside", "RH_out", "outside_relative_humidity_pct",
    ),
    "wind_speed m/s": ("ws", "Windspeed", "wind", "wind_speed_m_s"),
    "global_horizontal_irradiance W/m2": ("Rglob", "sun", "global_irradiance_W_m2"),
    "rain mm": ("precip",),
    "rain 1": ("rain_flag",),
    "active_power kW": ("active_power_kW",),
    "fan_duty 1": ("vents", "vent", "ext"),
    "heater_duty 1": ("pipe",),
}  # fmt: skip
"""Signal and unit -> the names that their columns have in one file or another."""


def source_rows(clock: str, columns: str, file: str = "{file}") -> str:
    """A [[source]] of a case file: its clock, and its columns by their names."""
    names = columns.split()
    signals = [(*kind.split(), name) for name in names for kind, known in COLUMNS.items() if name in known]
    assert len(signals) == len(names), columns
    rows = [
        f'signals.{signal} = {{{{ column = "{name}", unit = "{unit}" }}}}' for signal, unit, name in signals
    ]
    return "\n".join(["[[source]]", f'file = "{file}"', clock, *rows, ""])


def _site(latitude_deg: float, longitude_deg: float) -> str:
    return f"[site]\nlatitude_deg = {latitude_deg}\nlongitude_deg = {longitude_deg}\n"


_UTC = 'time = "time"\ntimezone = "UTC"'
FINNISH = 'time = "t_UTC+2"\ntimezone = "+02:00"'
_ATTIC = source_rows(FINNISH, "T_roofmiddle_airmiddle RH_roofmiddle_airmiddle T_fmi RH_fmi ws") + source_rows(
    f'{FINNISH}\nstamp = "end"', "Rglob precip"
)
# The stamps run through the night in which summer time begins: the clock keeps winter time.
_HOUSE = _site(50.5, 3.7) + source_rows(
    'time = "date"\ntime_format = "%Y/%m/%d %H:%M"\ntimezone = "+01:00"', "T2 RH_2 T_out RH_out Windspeed"
)
# The stamps are taken as the ends of the intervals; which of nacelle and tower surrounds it is not said.
_CONTROLLER = "rated_power_kW = 660.0\n" + source_rows(
    f'{_UTC}\nstamp = "end"\ninterval = "10min"',
    "controller_temperature_degC outside_temperature_degC active_power_kW",
)
_BOX = _site(55.69, 12.58) + source_rows(_UTC, "T_in T_out RH_out wind sun")
_DUTCH = 'time = "time"\ntimezone = "+01:00"'
# The site is where the challenge was held: Bleiswijk.
_GREENHOUSE = (
    _site(52.03, 4.53)
    + source_rows(_DUTCH, "air_temperature_degC air_relative_humidity_pct vents pipe")
    + source_rows(
        _DUTCH,
        "outside_temperature_degC outside_relative_humidity_pct wind_speed_m_s rain_flag "
        "global_irradiance_W_m2",
        "{weather}",
    )
)
# The stamps skip the hour in which summer time begins, and from then on the sun is an hour later by them.
# The longitude is that by which its noon is right before; the latitude is that of Denmark's middle.
_CELLE = _site(55.5, 10.2) + source_rows(
    'time = "time"\ntimezone = "Europe/Copenhagen"', "T_in T_out vent pipe sun"
)
# The site is that of the university that published the data: Chapingo.
_DRYER = _site(19.49, -98.88) + source_rows(
    'time = "time"\ntimezone = "-06:00"\nstamp = "end"\ninterval = "5min"',
    "T_in RH_in T_out RH_out wind ext sun",
)
COLD_PIPE_DEGC, HOT_PIPE_DEGC = 20.0, 80.0
"""[°C] heating pipe that gives no heat to a greenhouse's air, and full heat."""
COLDEST_CELL_DEGC = 12.0
"""[°C] what the heated cell in Celle never fell below while its sensors were read."""
MEAN_OF_ROWS = 5


def _compartment(rows: pd.DataFrame) -> pd.DataFrame:
    """The vents' opening and the heating pipe's warmth as duties.  The lamps burn at all times but the first
    two days: they are part of the constants."""
    vents = (rows.vent_lee_pct + rows.vent_wind_pct) / 200.0
    pipe = (rows.heating_pipe_degC - COLD_PIPE_DEGC) / (HOT_PIPE_DEGC - COLD_PIPE_DEGC)
    return rows.assign(vents=vents.clip(0.0, 1.0), pipe=pipe.clip(0.0, 1.0))


def _cell(rows: pd.DataFrame) -> pd.DataFrame:
    """Without the rows in which the sensors were not read, which hold zeros in place of readings."""
    down = (rows.T_in < COLDEST_CELL_DEGC) | (rows.T_out == 0.0)
    signals = rows.columns.drop("time")
    return rows.assign(**{name: rows[name].mask(down) for name in signals})


def _means(rows: pd.DataFrame) -> pd.DataFrame:
    """Means over five minutes, stamped at their ends, of which all five rows are there."""
    stamps = pd.to_datetime(rows.time).dt.ceil(f"{MEAN_OF_ROWS}min")
    groups = rows.drop(columns="time").groupby(stamps)
    return groups.mean()[groups.size() == MEAN_OF_ROWS].reset_index()


@dataclass(frozen=True)
class Source:
    """Where a record comes from: its file, its case, further files by their names in the case, and what makes
    the rows that the case reads from those of the file."""

    file: str
    case: str
    others: tuple[tuple[str, str], ...] = ()
    prepared: Callable[[pd.DataFrame], pd.DataFrame] | None = None

    @property
    def files(self) -> tuple[str, ...]:
        return (self.file, *(file for _, file in self.others))


_WEATHER = (("weather", "greenhouse_agc2022_weather_5min.csv.gz"),)
COMPARTMENTS = ("Reference", "Koala", "CVA")
SOURCES: dict[str, Source] = {
    "attic R2": Source("attic_trh1_R2_hourly.csv.gz", _ATTIC),
    "attic R4": Source("attic_trh1_R4_hourly.csv.gz", _ATTIC),
    "attic R7": Source("attic_trh1_R7_hourly.csv.gz", _ATTIC),
    "house": Source("house_uci_energy_10min.csv.gz", _HOUSE),
    "controller": Source("turbine_controller_cabinet_660kW_10min_2013.csv.gz", _CONTROLLER),
    "logger box": Source("logger_box_roof_10min_2022.csv.gz", _BOX),
    **{
        name: Source(f"greenhouse_agc2022_{name}_5min.csv.gz", _GREENHOUSE, _WEATHER, _compartment)
        for name in COMPARTMENTS
    },
    "Celle": Source("greenhouse_celle5_10min_2014.csv.gz", _CELLE, prepared=_cell),
    "dryer": Source("solar_dryer_1min_2023.csv.gz", _DRYER, prepared=_means),
}
"""Name of a record -> where it comes from."""
RECORDS = ("attic R2", "attic R4", "attic R7", "house")
"""Records into which effects are put; their order is part of the seeds."""
AS_IT_IS = "as it is"
VARIANTS: dict[str, tuple[str, ...]] = {
    AS_IT_IS: (),
    "sun withheld": ("global_horizontal_irradiance",),
    "vents withheld": ("fan_duty",),
    "heating pipe withheld": ("heater_duty",),
    "extractors withheld": ("fan_duty",),
    "all given": (),
}
"""Name of a variant -> the signals that it leaves out."""
KINDS = {
    "fan_duty": ("cooling_switching", "door_opening"),
    "heater_duty": ("unlogged_heater",),
}
"""Signal of an actuator -> names that are right where it is withheld, and wrong where it is given."""
KNOWN, WITHHELD, GIVEN = "known by construction", "withheld actuators", "given ones"


@dataclass(frozen=True)
class Known:
    """What is known of a variant of a record.

    right: names of causes any of which is right; wrong: names that may not come; quantity: "temperature" or
    "vapour", in which the right one shows; row: of the table of figures in which it counts, empty for none.
    """

    record: str
    variant: str
    right: tuple[str, ...] = ()
    wrong: tuple[str, ...] = ()
    quantity: str = ""
    row: str = ""


def _withheld(record: str, variant: str) -> Known:
    (signal,) = VARIANTS[variant]
    return Known(record, variant, KINDS[signal], (), "temperature", WITHHELD)


def _given(record: str, *signals: str) -> Known:
    return Known(record, "all given", (), tuple(name for one in signals for name in KINDS[one]), "", GIVEN)


CASES: tuple[Known, ...] = (
    *(Known(name, AS_IT_IS, ("moisture_sorption",), (), "vapour", KNOWN) for name in RECORDS[:3]),
    *(
        Known(name, "sun withheld", ("solar_gain",), (), "temperature", KNOWN)
        for name in ("Celle", "logger box", "dryer", *COMPARTMENTS)
    ),
    *(_withheld(name, "vents withheld") for name in (*COMPARTMENTS, "Celle")),
    *(_withheld(name, "heating pipe withheld") for name in COMPARTMENTS),
    _withheld("dryer", "extractors withheld"),
    *(_given(name, "fan_duty", "heater_duty") for name in (*COMPARTMENTS, "Celle")),
    _given("dryer", "fan_duty"),
    Known("house", AS_IT_IS),
    Known("controller", AS_IT_IS),
    Known("logger box", AS_IT_IS, ("solar_gain",), (), "temperature"),
)
"""All variants that are tried, and what is known of them."""


def expect(*files: str) -> None:
    """Raise Absent that names measured files which are not there."""
    if gone := [file for file in files if not (DATA / file).is_file()]:
        raise Absent(f"../shared/data/{gone[0]} is not there")


def case_of(name: str, variant: str, folder: Path) -> Path:
    """The case file of a record's variant, written to a folder together with what it reads."""
    source, withheld = SOURCES[name], VARIANTS[variant]
    file = (DATA / source.file).resolve()
    if source.prepared is not None:
        rows = source.prepared(pd.read_csv(file))
        file = (folder / source.file.removesuffix(".gz")).resolve()
        rows.to_csv(file, index=False)
    others = {key: (DATA / other).resolve() for key, other in source.others}
    text = f'name = "{name}"\n' + source.case.format(file=file, **others)
    lines = text.splitlines(keepends=True)
    kept = (line for line in lines if not line.startswith(tuple(f"signals.{one} =" for one in withheld)))
    case = folder / "case.toml"
    case.write_text("".join(kept), encoding="utf-8")
    return case


def measured(name: str, variant: str = AS_IT_IS) -> Record:
    """A measured record, identified in its first two thirds.  Raises Absent where its files are not there."""
    expect(*SOURCES[name].files)
    with tempfile.TemporaryDirectory() as directory:
        record = read_case(case_of(name, variant, Path(directory)))
    # What a folder is called must not show in results, and two clocks may come in one file.
    clocks = {one.signal: Path(one.source).name for one in record.series}
    if name in RECORDS:
        clocks = {signal: "loggers inside" if signal in INSIDE else "weather station" for signal in clocks}
    record = record.replace_series(*(replace(one, source=clocks[one.signal]) for one in record.series))
    return _identified(record)


def _inside_s(record: Record) -> tuple[float, float]:
    """First and last reading inside [s]: the loggers there may stop long before the weather station does."""
    times = [record[name].known[0] for name in INSIDE if name in record]
    return min(float(one[0]) for one in times), max(float(one[-1]) for one in times)


def _identified(record: Record) -> Record:
    start, end = record.start_s, _inside_s(record)[1]
    return replace(record, until_s=start + IDENTIFIED * (end - start))


def before_the_last_fifth(record: Record) -> tuple[Record, Record]:
    """A record cut before the last fifth of its readings inside, and the whole one; both are identified in
    the first two thirds of the cut one."""
    start, end = _inside_s(record)
    cut = _identified(record.window(-math.inf, end - 0.2 * (end - start)))
    return cut, replace(record, until_s=cut.until_s)
