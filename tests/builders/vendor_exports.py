"""Exports in the layouts of makes and loggers, of one synthetic turbine whose readings are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

STEP = timedelta(minutes=10)
START = datetime(2021, 3, 20, tzinfo=UTC)
ROWS = 2016
_RNG = np.random.default_rng(5)


def _truth() -> dict[str, np.ndarray]:
    """Signals in the unit of the exports: degC, %, kW, m/s, deg, rpm, hPa."""
    hour = np.arange(ROWS) / 6.0
    wander = np.convolve(_RNG.normal(size=ROWS + 600), np.ones(600) / 25.0, "valid")[:ROWS]
    ambient = 7.0 + 4.0 * np.sin(2 * np.pi * (hour - 9.0) / 24.0) + 2.0 * wander
    wind = np.clip(9.0 + 3.5 * np.sin(hour / 13.0) + _RNG.normal(0.0, 0.7, ROWS), 0.5, None)
    power = np.where(wind < 3.0, -6.0, np.clip(2050.0 * (wind / 12.0) ** 3, 0.0, 2050.0))
    loaded = np.convolve(np.concatenate([np.full(17, power[0]), power]), np.ones(18) / 18.0, "valid")
    return {
        "ambient_temperature": ambient.round(1),
        "ambient_relative_humidity": np.clip(78.0 - 2.0 * (ambient - 7.0), 30.0, 97.0).round(1),
        "nacelle_temperature": (ambient + 6.0 + loaded / 500.0).round(1),
        "cabinet_temperature": (0.8 * ambient + 14.0 + loaded / 180.0).round(1),
        "cabinet_relative_humidity": np.clip(38.0 - loaded / 200.0 + wander, 8.0, 80.0).round(1),
        "active_power": power.round(1),
        "wind_speed": wind.round(2),
        "wind_direction": np.mod(
            200.0 + 90.0 * np.sin(hour / 20.0) + 170.0 * np.sin(hour / 3.0), 360.0
        ).round(0),
        "rotor_speed": np.clip(power / 130.0, 0.0, 15.8).round(2),
        "generator_speed": np.clip(power / 1.2, 0.0, 1710.0).round(0),
        "ambient_pressure": (985.0 + 5.0 * np.sin(hour / 30.0)).round(1),
        "oil": (50.0 + loaded / 90.0).round(1),
    }


TRUTH = _truth()
TIMES = [START + number * STEP for number in range(ROWS)]


@dataclass(frozen=True)
class Made:
    """An export, and what it holds.

    files: name -> content. expected: signal -> its column. asked: whether the file leaves a choice to confirm
    about its stamps or turbine. enclosure: whether it has readings of the cabinet.
    """

    make: str
    files: dict[str, bytes]
    expected: dict[str, str]
    asked: bool = False
    enclosure: bool = True

    def write(self, folder: Path) -> list[Path]:
        paths = []
        for name, content in self.files.items():
            (folder / name).write_bytes(content)
            paths.append(folder / name)
        return paths


def _table(
    columns: Sequence[tuple[str, str]],
    stamp: Callable[[datetime], str],
    time: str,
    separator: str = ",",
    decimal: str = ".",
    *,
    above: str = "",
    below: str = "",
    before: Sequence[tuple[str, str]] = (),
) -> bytes:
    """Text of a table: `columns` of (header, key of TRUTH), `before` of (header, constant)."""
    header = separator.join([*(name for name, _ in before), time, *(name for name, _ in columns)])
    lines = [header, below] if below else [header]
    for row, moment in enumerate(TIMES):
        numbers = [f"{TRUTH[key][row]:g}".replace(".", decimal) for _, key in columns]
        lines.append(separator.join([*(value for _, value in before), stamp(moment), *numbers]))
    return (above + "\n".join(lines) + "\n").encode()


def _iso(moment: datetime) -> str:
    return f"{moment:%Y-%m-%d %H:%M:%S}"


def _german(moment: datetime) -> str:
    return f"{moment.astimezone(ZoneInfo('Europe/Berlin')):%d.%m.%Y %H:%M}"


def greenbyte() -> Made:
    columns = [
        ("Wind speed (m/s)", "wind_speed"),
        ('"Wind speed, Standard deviation (m/s)"', "oil"),
        ("Wind direction (°)", "wind_direction"),
        ("Power (kW)", "active_power"),
        ('"Power, Max (kW)"', "active_power"),
        ("Reactive power (kvar)", "oil"),
        ("Nacelle ambient temperature (°C)", "ambient_temperature"),
        ("Nacelle temperature (°C)", "nacelle_temperature"),
        ("Ambient temperature (converter) (°C)", "cabinet_temperature"),
        ("Gear oil temperature (°C)", "oil"),
        ("Rotor speed (RPM)", "rotor_speed"),
        ("Generator RPM (RPM)", "generator_speed"),
    ]
    above = "# This file was exported on 2022-01-01.\n# Turbine: One\n# Time zone: UTC\n#\n"
    kept = {
        "wind_speed": "Wind speed (m/s)",
        "wind_direction": "Wind direction (°)",
        "active_power": "Power (kW)",
        "ambient_temperature": "Nacelle ambient temperature (°C)",
        "nacelle_temperature": "Nacelle temperature (°C)",
        "cabinet_temperature": "Ambient temperature (converter) (°C)",
        "rotor_speed": "Rotor speed (RPM)",
        "generator_speed": "Generator RPM (RPM)",
    }
    return Made("Greenbyte", {"t1.csv": _table(columns, _iso, "# Date and time", above=above)}, kept)


def vestas() -> Made:
    columns = [
        ("Gen_RPM_Avg", "generator_speed"),
        ("Gen_Bear_Temp_Avg", "oil"),
        ("Nac_Temp_Avg", "nacelle_temperature"),
        ("Rtr_RPM_Avg", "rotor_speed"),
        ("Amb_WindSpeed_Avg", "wind_speed"),
        ("Amb_WindSpeed_Max", "wind_speed"),
        ("Amb_WindDir_Abs_Avg", "wind_direction"),
        ("Amb_Temp_Avg", "ambient_temperature"),
        ("Cont_VCP_Temp_Avg", "cabinet_temperature"),
        ("Cont_VCP_ChokcoilTemp_Avg", "oil"),
        ("Grd_Prod_Pwr_Avg", "active_power"),
        ("Grd_Prod_ReactPwr_Avg", "oil"),
    ]
    skipped = ("Bear", "Chok", "Max", "React")
    kept = {key: name for name, key in columns if not any(word in name for word in skipped)}

    def stamp(moment: datetime) -> str:
        return f"{moment:%Y-%m-%dT%H:%M:%S}+00:00"

    content = _table(columns, stamp, "Timestamp", ";", before=[("Turbine_ID", "T01")])
    return Made("Vestas, EDP", {"signals.csv": content}, kept)


def senvion() -> Made:
    columns = [
        ("P_avg", "active_power"),
        ("Ws_avg", "wind_speed"),
        ("Wa_avg", "wind_direction"),
        ("Ot_avg", "ambient_temperature"),
        ("Yt_avg", "nacelle_temperature"),
        ("Rs_avg", "rotor_speed"),
        ("Ds_avg", "generator_speed"),
        ("Gost_avg", "oil"),
        ("P_min", "active_power"),
    ]
    kept = {key: name for name, key in columns if name not in ("Gost_avg", "P_min")}

    def stamp(moment: datetime) -> str:
        local = moment.astimezone(ZoneInfo("Europe/Paris"))
        return local.isoformat()

    content = _table(columns, stamp, "Date_time", ";", before=[("Wind_turbine_name", "R80711")])
    return Made("Senvion, ENGIE", {"lhb.csv": content}, kept, enclosure=False)


def enercon() -> Made:
    columns = [
        ("WEC: ave. windspeed", "wind_speed"),
        ("WEC: max. windspeed", "wind_speed"),
        ("WEC: ave. Rotation", "rotor_speed"),
        ("WEC: ave. Power", "active_power"),
        ("Sys 1 inverter 1 cabinet temp.", "cabinet_temperature"),
        ("Transformer temp.", "oil"),
        ("Ambient temp.", "ambient_temperature"),
        ("Nacelle temp.", "nacelle_temperature"),
        ("Yaw inverter cabinet temp.", "oil"),
    ]
    skipped = ("Transformer temp.", "Yaw inverter cabinet temp.", "WEC: max. windspeed")
    kept = {key: name for name, key in columns if name not in skipped}
    return Made("Enercon", {"scada.csv": _table(columns, _iso, "DateTime")}, kept, asked=True)


def german() -> Made:
    columns = [
        ("Windgeschwindigkeit", "wind_speed"),
        ("Wirkleistung", "active_power"),
        ("Außentemperatur", "ambient_temperature"),
        ("Gondeltemperatur", "nacelle_temperature"),
        ("Schaltschrank Temperatur", "cabinet_temperature"),
        ("Schaltschrank rel. Feuchte", "cabinet_relative_humidity"),
        ("Getriebeöltemperatur", "oil"),
        ("Rotordrehzahl", "rotor_speed"),
    ]
    below = "TT.MM.JJJJ hh:mm;[m/s];[kW];[°C];[°C];[°C];[%rF];[°C];[U/min]"
    kept = {key: name for name, key in columns if key != "oil"}
    content = _table(columns, _german, "Datum/Zeit", ";", ",", above="Anlage: WEA 1\n\n", below=below)
    return Made("German, row of units", {"anlage.csv": content.decode().encode("cp1252")}, kept)


_TAGS = {
    "WTUR.W": "active_power",
    "WMET.EnvTmp": "ambient_temperature",
    "WMET.EnvHum": "ambient_relative_humidity",
    "WMET.EnvPres": "ambient_pressure",
    "WCNV.CabTmp": "cabinet_temperature",
    "WNAC.IntlTmp": "nacelle_temperature",
    "WMET.HorWdSpd": "wind_speed",
    "WCNV.CtlPnlHtTms": "oil",
}


def iec_narrow() -> Made:
    lines = ["tag,time,value,quality"]
    for row, moment in enumerate(TIMES):
        lines += [f"{tag},{moment:%Y-%m-%dT%H:%M:%SZ},{TRUTH[key][row]:g},Good" for tag, key in _TAGS.items()]
    kept = {key: tag for tag, key in _TAGS.items() if key != "oil"}
    return Made("IEC 61400-25, one row a value", {"history.csv": "\n".join(lines).encode()}, kept)


def gb_t() -> Made:
    columns = [
        ("WTUR.W", "active_power"),
        ("WNAC.ExtTmp", "ambient_temperature"),
        ("WNAC.Hum", "ambient_relative_humidity"),
        ("WCNV.CabTmp", "cabinet_temperature"),
        ("WCNV.CabHum", "cabinet_relative_humidity"),
        ("WGEN.Spd", "generator_speed"),
    ]
    kept = {key: name for name, key in columns}
    kept["nacelle_relative_humidity"] = kept.pop("ambient_relative_humidity")
    content = _table(columns, lambda moment: f"{moment.timestamp() * 1000:.0f}", "timestamp")
    return Made("GB/T 30966, Unix milliseconds", {"gb.csv": content}, kept)


def openoa() -> Made:
    columns = [
        ("WTUR_W", "active_power"),
        ("WMET_HorWdSpd", "wind_speed"),
        ("WMET_HorWdDir", "wind_direction"),
        ("WMET_EnvTmp", "ambient_temperature"),
        ("WCNV.CtlPnlTmp", "cabinet_temperature"),
        ("WROT_RotSpd", "rotor_speed"),
    ]
    kept = {key: name for name, key in columns}
    return Made("OpenOA", {"oa.csv": _table(columns, lambda m: f"{m:%Y-%m-%dT%H:%M:%SZ}", "time")}, kept)


def fleet_columns() -> Made:
    columns = [
        ("W01.Tcab (degC)", "cabinet_temperature"),
        ("W01.Power (kW)", "active_power"),
        ("W02.Tcab (degC)", "oil"),
        ("W02.Power (kW)", "wind_speed"),
        ("Outside temperature (degC)", "ambient_temperature"),
    ]
    kept = {
        "cabinet_temperature": "W01.Tcab (degC)",
        "active_power": "W01.Power (kW)",
        "ambient_temperature": "Outside temperature (degC)",
    }
    return Made("turbine in the column", {"park.csv": _table(columns, _iso, "Time (UTC)")}, kept, asked=True)


def testo() -> Made:
    columns = [("Temperatur [°C]", "cabinet_temperature"), ("Feuchte [%rF]", "cabinet_relative_humidity")]
    content = _table(columns, _german, "Datum / Uhrzeit", ";", ",")
    return Made("Testo", {"umrichterschrank.csv": content}, {key: name for name, key in columns})


def rotronic() -> Made:
    columns = [
        ("Rel.Humidity[%rh]", "cabinet_relative_humidity"),
        ("Temperature[°C]", "cabinet_temperature"),
    ]
    above = "Rotronic HW4\nDevice: HL-NT2\nSerial: 00123\n\n"
    content = _table(columns, lambda m: f"{m:%d.%m.%Y}\t{m:%H:%M:%S}", "Date\tTime", "\t", above=above)
    return Made("Rotronic", {"cabinet_log.txt": content}, {key: name for name, key in columns}, asked=True)


def hobo() -> Made:
    columns = [
        ('"Temp, °C (LGR S/N: 10340, SEN S/N: 10340, LBL: cabinet)"', "cabinet_temperature"),
        ('"RH, % (LGR S/N: 10340, SEN S/N: 10340, LBL: cabinet)"', "cabinet_relative_humidity"),
    ]
    offset = timedelta(hours=1)
    content = _table(
        columns,
        lambda m: f"{m + offset:%m/%d/%y %I:%M:%S %p}",
        '"Date Time, GMT+01:00"',
        above='"Plot Title: converter"\n',
        before=[('"#"', "1")],
    )
    return Made("HOBO", {"hobo.csv": content}, {key: name.strip('"') for name, key in columns})


def ibutton() -> Made:
    files = {}
    for name, key, unit in (
        ("cabinet_T", "cabinet_temperature", "C"),
        ("cabinet_RH", "cabinet_relative_humidity", "%RH"),
    ):
        above = "1-Wire/iButton Part Number: DS1923\nMission in Progress? false\n\n"
        lines = [f"{m:%d/%m/%y %H:%M:%S},{unit},{TRUTH[key][row]:g}" for row, m in enumerate(TIMES)]
        files[f"{name}.csv"] = (above + "Date/Time,Unit,Value\n" + "\n".join(lines) + "\n").encode()
    expected = {"cabinet_temperature": "Value", "cabinet_relative_humidity": "Value"}
    return Made("iButton", files, expected, asked=True)


MAKES: tuple[Callable[[], Made], ...] = (
    greenbyte, vestas, senvion, enercon, german, iec_narrow, gb_t, openoa, fleet_columns, testo, rotronic,
    hobo, ibutton,
)  # fmt: skip
