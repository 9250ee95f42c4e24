"""Measured files as exports, also in the layouts of their sources, with the columns that hold each signal."""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from builders.measured import DATA

_WEATHER = {
    "global_horizontal_irradiance": "Rglob",
    "diffuse_horizontal_irradiance": "Rdif",
    "wind_speed": "ws",
    "wind_direction": "wd",
    "rain": "precip",
}


def _attic(side: str) -> dict[str, tuple[str, ...]]:
    """Any air of the attic may be the enclosure's; a sensor outside or the weather station's that outside."""
    air = ("airmiddle", "airtop")
    rooms = tuple(
        f"roof{place}_{kind}" for place in ("middle", "south", "north", "east", "west") for kind in air
    )
    return {
        "ambient_temperature": ("T_fmi", f"T_roof{side}_outside"),
        "ambient_relative_humidity": ("RH_fmi", f"RH_roof{side}_outside"),
        "cabinet_temperature": tuple(f"T_{room}" for room in rooms),
        "cabinet_relative_humidity": tuple(f"RH_{room}" for room in rooms),
        **{signal: (column,) for signal, column in _WEATHER.items()},
    }


_GREENHOUSE = {
    "cabinet_temperature": ("air_temperature_degC",),
    "cabinet_relative_humidity": ("air_relative_humidity_pct",),
}
_SISTERS = {
    "active_power": ("active_power_kW", "Leistung"),
    "wind_speed": ("wind_speed_m_s", "Wind"),
    "rotor_speed": ("rotor_speed_rpm", "Rotor"),
    "ambient_temperature": ("outside_temperature_degC", "Außen"),
}
_CONTROLLER = {
    "cabinet_temperature": ("controller_temperature_degC", "Controller Temperature (C)"),
    "nacelle_temperature": ("nacelle_temperature_degC", "Temperature Inside Nacelle"),
    "ambient_temperature": ("outside_temperature_degC", "Temperature Outside Nacelle (C)"),
    "active_power": ("active_power_kW", "Active Power (W)"),
}
_KELMARSH = {
    "ambient_temperature": ("T2m_C",),
    "ambient_dew_point_temperature": ("Td2m_C",),
    "ambient_relative_humidity": ("RH_pct",),
    "ambient_pressure": ("p_Pa",),
    "wind_speed": ("ws10_mps", "ws100_mps"),
    "global_horizontal_irradiance": ("ssrd_Wm2",),
    "cloud_cover": ("tcc_pct",),
    "active_power": ("P_K1_kW",),
}
_HOUSE = {
    "cabinet_temperature": ("T1", "T2", "T3", "T4", "T5", "T7", "T8", "T9"),
    "cabinet_relative_humidity": ("RH_1", "RH_2", "RH_3", "RH_4", "RH_5", "RH_7", "RH_8", "RH_9"),
    "ambient_temperature": ("T_out",),
    "ambient_relative_humidity": ("RH_out",),
    "ambient_dew_point_temperature": ("Tdewpoint",),
    "wind_speed": ("Windspeed",),
}
EXPECTED: dict[str, dict[str, tuple[str, ...]]] = {
    "attic_trh1_R2_hourly.csv.gz": _attic("west"),
    "attic_trh1_R4_hourly.csv.gz": _attic("south"),
    "attic_trh1_R7_hourly.csv.gz": _attic("east"),
    "greenhouse_agc2022_CVA_5min.csv.gz": _GREENHOUSE,
    "greenhouse_agc2022_Koala_5min.csv.gz": _GREENHOUSE,
    "greenhouse_agc2022_Reference_5min.csv.gz": _GREENHOUSE,
    "greenhouse_agc2022_weather_5min.csv.gz": {
        "ambient_temperature": ("outside_temperature_degC",),
        "ambient_relative_humidity": ("outside_relative_humidity_pct",),
        "global_horizontal_irradiance": ("global_irradiance_W_m2",),
        "wind_speed": ("wind_speed_m_s",),
        "rain": ("rain_flag",),
    },
    "house_uci_energy_10min.csv.gz": _HOUSE,
    "kelmarsh_2018_2019_era5_power_hourly.csv.gz": _KELMARSH,
    "la_haute_borne_R80736_10min_2014_2015.csv.gz": {
        "active_power": ("P_avg",),
        "wind_speed": ("Ws_avg",),
        "wind_direction": ("Wa_avg",),
        "ambient_temperature": ("Ot_avg",),
    },
    "la_haute_borne_era5_hourly_2014_2015.csv.gz": {
        "ambient_temperature": ("t_2m",),
        "ambient_pressure": ("surf_pres",),
        "wind_speed": ("ws_100m",),
    },
    "turbine_controller_cabinet_660kW_10min_2013.csv.gz": _CONTROLLER,
    "two_sister_turbines_2MW_10min_2016.csv.gz": _SISTERS,
    "weather/PVGIS_45N_8E.epw.gz": {},
    "controller, as in its source": _CONTROLLER,
    "sister turbine, as in its source": _SISTERS,
}
"""Export -> signal -> the columns that may hold it; no other signal is there."""


@dataclass(frozen=True)
class Counts:
    """Signals of a draft: right without a doubt, right with a doubt to confirm, wrong, and not found."""

    right: int
    asked: int
    wrong: int
    missed: int


def counts(signals: dict[str, tuple[str, bool]], expected: dict[str, tuple[str, ...]]) -> Counts:
    """signals: of the draft that are read -> (column, whether in doubt)."""
    good = {name: doubt for name, (column, doubt) in signals.items() if column in expected.get(name, ())}
    asked = sum(good.values())
    return Counts(len(good) - asked, asked, len(signals) - len(good), len(set(expected) - set(signals)))


def export_of(name: str, folder: Path, rows: int | None = None) -> Path:
    """The first rows of a measured file in a folder, all for None; in the layout of its source where the name
    says so."""
    rebuilt = {"controller, as in its source": _controller, "sister turbine, as in its source": _sister}
    if name in rebuilt:
        return rebuilt[name](folder, rows)
    if rows is None or name.endswith(".epw.gz"):
        return DATA / name
    path = folder / Path(name).name.removesuffix(".gz")
    with gzip.open(DATA / name, "rt", encoding="utf-8") as file:
        path.write_text("".join(islice(file, rows)), encoding="utf-8")
    return path


def _controller(folder: Path, rows: int | None) -> Path:
    """American dates of two digits, columns without a name, a column of letters, watts, a name that occurs
    twice."""
    import pandas as pd

    table = pd.read_csv(DATA / "turbine_controller_cabinet_660kW_10min_2013.csv.gz", nrows=rows)
    time = pd.to_datetime(table["time"])
    stamp = [f"{one.month}/{one.day}/{one:%y} {one.hour}:{one:%M}" for one in time]
    watts = (1000 * table["active_power_kW"]).round()
    made = pd.DataFrame({"TimeStamp": stamp, "": "", "Grid OK Timer ": table["grid_ok_timer_s"]})
    columns = {
        "Active Power (W)": watts,
        "Hydraulic Temperature (C) ": table["hydraulic_degC"],
        "Temperature Outside Nacelle (C) ": table["outside_temperature_degC"],
        "Temperature Inside Nacelle ": table["nacelle_temperature_degC"],
        "Gearbox Oil Temperature (C) ": table["gearbox_oil_degC"],
        "Generator Stator Temperature (C) ": table["generator_stator_degC"],
        "Controller Temperature (C) ": table["controller_temperature_degC"],
        "Active Power Generation (W)": watts,
    }
    made = made.assign(**columns)
    made.insert(len(made.columns), "Active Power Generation (W) ", watts)
    made["Wind Speed (m/s) "] = "OP"
    path = folder / "controller.csv"
    made.to_csv(path, index=False, na_rep="NaN")
    return path


def _sister(folder: Path, rows: int | None) -> Path:
    """Padded German names with a row of units, decimal commas, and loose commas at the ends of lines."""
    import pandas as pd

    table = pd.read_csv(DATA / "two_sister_turbines_2MW_10min_2016.csv.gz")
    table = table[table["turbine"] == 1].iloc[:rows]
    head = "        Dat/Zeit;  Wind;Rotor;Leistung;Gen1-;Lager;Außen;GetrT; Status;Spann;Spann;  KH-Ana-1\n"
    head += "                 ;   m/s;  rpm;      kW;   °C;   °C;   °C;   °C;       ;    V;    V;          \n"
    lines = []
    for number, row in enumerate(table.itertuples(index=False)):
        power, wind, rotor, generator, bearing, gearbox, outside, status = row[2:10]
        ordered = (wind, rotor, power, generator, bearing, outside, gearbox, status)
        numbers = ";".join(f"{value:g}" for value in ordered).replace(".", ",")
        loose = "," * (number % 5)
        lines.append(f"{pd.Timestamp(row.time):%d.%m.%Y, %H:%M};{numbers};400,7;401,4;0{loose}\n")
    path = folder / "Turbine1.csv"
    path.write_text(head + "".join(lines), encoding="utf-8")
    return path
