"""Names of columns in exports: quantities, places, and names of a make or a standard."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from hygrokf.data.signals import SIGNALS, UNITS, fitting_units
from hygrokf.drafting.layout import unit_in_export

OWN_NAMES: tuple[tuple[str, str, str], ...] = (
    # Greenbyte: "converter" is where this sensor is, and the air around it is the cabinet's
    ("ambient temperature converter", "cabinet_temperature", "Greenbyte"),
    ("cont vcp temp", "cabinet_temperature", "Vestas, EDP"),
    ("cont vcp wtr temp", "coolant_temperature", "Vestas, EDP"),
    ("grd prod pwr", "active_power", "Vestas, EDP"),
    ("grd rtr inv phase 1 temp", "converter_temperature", "Vestas, EDP"),
    ("rtr rpm", "rotor_speed", "Vestas, EDP"),
    ("gen rpm", "generator_speed", "Vestas, EDP"),
    ("amb wind speed", "wind_speed", "Vestas, EDP"),
    ("amb wind dir abs", "wind_direction", "Vestas, EDP"),
    ("p", "active_power", "Senvion (ENGIE)"),
    ("ws", "wind_speed", "Senvion (ENGIE), OpenOA"),
    ("wa", "wind_direction", "Senvion (ENGIE)"),
    ("ot", "ambient_temperature", "Senvion (ENGIE)"),
    ("yt", "nacelle_temperature", "Senvion (ENGIE)"),
    ("rs", "rotor_speed", "Senvion (ENGIE)"),
    ("ds", "generator_speed", "Senvion (ENGIE)"),
    ("wec power", "active_power", "Enercon"),
    ("wec rotation", "rotor_speed", "Enercon"),
    ("wec windspeed", "wind_speed", "Enercon"),
    ("sys 1 inverter 1 cabinet temp", "cabinet_temperature", "Enercon"),
    ("wtur w", "active_power", "IEC 61400-25, OpenOA"),
    ("wtur tot w", "active_power", "IEC 61400-25"),
    ("wgen w", "active_power", "IEC 61400-25"),
    ("wgen spd", "generator_speed", "IEC 61400-25"),
    ("wrot spd", "rotor_speed", "IEC 61400-25"),
    ("wrot rot spd", "rotor_speed", "IEC 61400-25"),
    ("wcnv cab tmp", "cabinet_temperature", "IEC 61400-25, GB/T 30966"),
    ("wcnv cab hum", "cabinet_relative_humidity", "IEC 61400-25, GB/T 30966"),
    ("wcnv hum", "cabinet_relative_humidity", "IEC 61400-25, GB/T 30966"),
    ("wcnv ctl pnl tmp", "cabinet_temperature", "OpenOA"),
    ("wnac intl tmp", "nacelle_temperature", "IEC 61400-25"),
    ("wnac tmp", "nacelle_temperature", "IEC 61400-25"),
    ("wnac hum", "nacelle_relative_humidity", "GB/T 30966"),
    ("wnac intl hum", "nacelle_relative_humidity", "IEC 61400-25"),
    ("wnac ext tmp", "ambient_temperature", "IEC 61400-25"),
    ("wnac ex tmp", "ambient_temperature", "IEC 61400-25"),
    ("wnac ext hum", "ambient_relative_humidity", "IEC 61400-25"),
    ("wnac wd spd", "wind_speed", "IEC 61400-25"),
    ("wnac wd dir", "wind_direction", "IEC 61400-25"),
    ("wmet env tmp", "ambient_temperature", "IEC 61400-25, OpenOA"),
    ("wmet env hum", "ambient_relative_humidity", "IEC 61400-25"),
    ("wmet env pres", "ambient_pressure", "IEC 61400-25"),
    ("wmet hor wd spd", "wind_speed", "IEC 61400-25, OpenOA"),
    ("wmet hor wd dir", "wind_direction", "IEC 61400-25, OpenOA"),
    ("wtow intl tmp", "tower_temperature", "IEC 61400-25"),
    ("wtow intl hum", "tower_relative_humidity", "IEC 61400-25"),
    ("tt 10", "ambient_temperature", "DWD"),
    ("rf 10", "ambient_relative_humidity", "DWD"),
    ("td 10", "ambient_dew_point_temperature", "DWD"),
    ("pp 10", "ambient_pressure", "DWD"),
    ("ff 10", "wind_speed", "DWD"),
    ("dd 10", "wind_direction", "DWD"),
    ("tt tu", "ambient_temperature", "DWD"),
    ("rf tu", "ambient_relative_humidity", "DWD"),
    ("t 2 m", "ambient_temperature", "ERA5"),
    ("td 2 m", "ambient_dew_point_temperature", "ERA5"),
    ("d 2 m", "ambient_dew_point_temperature", "ERA5"),
    ("sp", "ambient_pressure", "ERA5"),
    ("surf pres", "ambient_pressure", "ERA5"),
    ("ssrd", "global_horizontal_irradiance", "ERA5"),
    ("tcc", "cloud_cover", "ERA5"),
)
"""Name without its unit and the word for the mean, the signal, and the makes or standards that use the
name."""

QUANTITY_WORDS: tuple[tuple[str, str], ...] = (
    ("dew_point_temperature", r"dew ?point|tdew|taupunkt| td |露点"),
    ("absolute_humidity", r"absolute (humidity|feuchte)|abs hum|absolute luftfeuchte"),
    ("relative_humidity", r"humid| hum | rh |feucht| rf |湿度"),
    ("wind_speed", r"wind ?speed|wd spd| ws |windgeschw|v ?wind |wind v |风速"),
    ("wind_direction", r"wind ?dir|wd dir| wd |windricht|风向"),
    ("diffuse_horizontal_irradiance", r"diffuse? |rdif| dhi |diffusstrahl"),
    ("direct_normal_irradiance", r"direct normal| dni "),
    (
        "global_horizontal_irradiance",
        r"global|irradia| ghi |rglob|solar rad|short ?wave|globalstrahl|hor sol",
    ),
    ("rotor_speed", r"rotor ?(speed|rpm)|rotordrehzahl|rot spd|rotor rotation"),
    ("generator_speed", r"generator ?(speed|rpm)|generatordrehzahl|gen spd"),
    ("pressure", r"pressure| press? |luftdruck|气压"),
    ("rain", r"rain|precip|niederschlag|regen"),
    ("cloud_cover", r"cloud|bewoelk"),
    ("heater_duty", r"(heater|heizung) (duty|on|status|ein)"),
    ("fan_duty", r"(fan|luefter) (duty|on|status|ein)"),
    ("door_open", r"(cabinet|cab|schrank) ?(door|tuer)|door open"),
    ("power", r"active power| power|leistung| pwr |有功"),
    ("temperature", r"temp| tmp |t \d+ ?m | t |温度"),
)
"""Quantity (a signal where it needs no place) and the pattern of its words; the first match counts."""

PLACES: tuple[tuple[str, str, float], ...] = (
    (
        "cabinet",
        r"cabinet|schrank| cab | top ?box | cont top |ctl pnl|control panel|enclosure|cubicle|controller"
        r"|控制柜|变流器柜|柜",
        0.95,
    ),
    (
        "ambient",
        r"ambient|outside|outdoor| amb | out |extern| ext | env |aussen|umgebung|w(eath|ett)er| met "
        r"|环境|舱外",
        0.95,
    ),
    ("ambient", r" fmi | knmi | dwd | era ?5 ", 0.85),
    ("coolant", r"coolant|cooling water| wtr |kuehlwasser|kuehlmittel|冷却", 0.85),
    ("nacelle", r"nacelle| nac |gondel|maschinenhaus|机舱", 0.95),
    ("tower", r"tower base|tower| tow |turmfuss|turm|塔", 0.85),
    ("converter", r"converter|inverter|igbt|umrichter|wechselrichter|变流", 0.8),
)
"""Place, the pattern of its words, and how far a name with it and a quantity is trusted (0 to 1)."""

PART_WORDS = (
    r"gear|getr|bearing|lager|generator| gen |stator|rotor|oil| oel |oelt|hydraul|transform|trafo| hub "
    r"|spinner|pitch|yaw|azimut|choke|indoor|brake|brems|winding|wicklung|blade|blatt|phase|rectifier|heatsink"
    r"|pipe|fan |slip ring|lueft|insulation|inverter averages"
)
"""Parts of a turbine or a building that are not the air of a place."""
OF_AIR = ("cabinet", "ambient", "coolant")
"""Places whose temperature counts although a part is named."""
NOT_MEANT = (
    r"psble|dir relative|react|blind"
    r"|apparent|schein|factor|faktor|set ?point|sollw|limit|possible|potential|available|theoretic"
    r"|lost|counter|zaehler|timer| tms |visib|density|appliance|light|lamp|screen|vent |cos ?phi|turbulen"
    r"|deviation"
)
"""Words of quantities for which there is no signal."""
_STATISTIC = r" (min|max|std|sd|stddev|stdev|minimum|maximum|stdabw|count|sum|range) "
_MEAN = r" (avg|ave|mean|average|mittel|mittelwert|mw|smp) "
_SUFFIX = re.compile(
    r"[ _](deg[ _]?[CF]|pct|percent|kW|MW|W|Pa|hPa|kPa|rpm|m[ _]s|mps|W[ _]?m2|K|C|F|mm|deg)$"
)
_LOGICAL_NODE = re.compile(r"^(?:.*[./$])?(W[A-Z]{3})\d*(?:[./$](?:MX|ST))?(?=[./$])")
_DATA_ATTRIBUTE = re.compile(r"[./$](?:(?:inst)?mag|cval|instcval)(?:[./$][fi])?(?![A-Za-z])", re.IGNORECASE)
_WRITTEN_OUT = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"})
_BRACKETS = re.compile(r"[(\[{]([^()\[\]{}]*)[)\]}]")


@dataclass(frozen=True)
class NamedColumn:
    """The meaning of a column's name.

    words: of the name, in lower case between blanks. unit: in `UNITS`, from the name or the row below it,
    None where not recognised; stated: the unit as written. quantity: "temperature", …, or a signal; "" where
    none is named. place: "" where none is named. signal: "" where the name does not determine it. score:
    trust in the name, 0 to 1. why: in words.
    """

    words: str
    unit: str | None
    stated: str
    quantity: str
    place: str
    signal: str
    score: float
    why: str


def name_says(name: str, unit: str = "") -> NamedColumn:
    """The meaning of a header.

    name: of the column. unit: from a row of units, or "".
    """
    if _LOGICAL_NODE.search(name):
        # IEC 61400-25: "WTG07/WTUR1.W.mag.f" is WTUR.W
        name = _DATA_ATTRIBUTE.sub("", _LOGICAL_NODE.sub(r"\1", name))
    plain, stated, unit_name = _split_unit(name, unit)
    words = words_of(plain)
    unnamed = NamedColumn(words, unit_name, stated, "", "", "", 0.0, "no signal of this name")
    if re.search(_STATISTIC, words):
        return replace(unnamed, why="a statistic other than the mean")
    name_without_mean = re.sub(r"\s+", " ", re.sub(_MEAN, " ", words)).strip()
    full_name = re.sub(r"\s+", " ", re.sub(_MEAN, " ", words_of(name))).strip()
    for make_name, signal, make in OWN_NAMES:
        has_unit_in_name = make_name == full_name != name_without_mean
        if has_unit_in_name or (
            make_name == name_without_mean and (unit_name is None or unit_name in fitting_units(signal))
        ):
            of_make = replace(unnamed, signal=signal, score=1.0, why=f"a name of {make}")
            return replace(of_make, unit=None, stated="") if has_unit_in_name else of_make
    quantity = next(
        (quantity_name for quantity_name, pattern in QUANTITY_WORDS if re.search(pattern, words)), ""
    )
    quantity = quantity or _quantity_by_unit(unit_name, stated, words)
    if re.search(NOT_MEANT, words) or not quantity:
        return unnamed
    place, score = place_of(words)
    is_part = re.search(PART_WORDS, words) is not None
    signal = _signal_of(quantity, place, words)
    needs_air = quantity in ("temperature", "relative_humidity") and place not in OF_AIR
    if is_part and (needs_air or quantity == "power"):
        return replace(unnamed, place=place, why="a part that is no signal")
    if not place and signal:
        score = 0.85 if quantity != "power" else 0.9
    if place == "cabinet":
        score = 0.5 if is_part else _cabinet_score(words)
    return NamedColumn(
        words, unit_name, stated, quantity, place, signal, score if signal else 0.0, "by its name"
    )


def words_of(text: str) -> str:
    """The words of a name in lower case, between blanks; camel case and digits apart, umlauts written out."""
    text = text.translate(_WRITTEN_OUT)
    text = re.sub(r"(?<![A-Za-z])(T|RH)_?(cab|amb|nac|out|ext)(?![a-z])", r"\1 \2", text)
    text = re.sub(r"([a-z])([A-Z])", r"\1 \2", text)
    text = re.sub(r"(?<=[A-Za-z])(?=\d)|(?<=\d)(?=[A-Za-z])", " ", text)
    return f" {re.sub(r'[^0-9a-z一-鿿]+', ' ', text.lower()).strip()} "


def place_of(words: str) -> tuple[str, float]:
    """The place that words name, and the trust in it, 0 to 1; ("", 0) where they name no place."""
    for place, pattern, score in PLACES:
        if re.search(pattern, words):
            return place, score
    return "", 0.0


def _cabinet_score(words: str) -> float:
    """Trust, 0 to 1, that a cabinet is the converter's."""
    if re.search(r"converter|inverter|umrichter|wechselrichter|变流", words):
        return 0.97
    if re.search(r" top ?box | cont top ", words):
        return 0.75  # the controller's, at the top of the tower: to confirm
    if re.search(PLACES[4][1] + "| wnac ", words):
        return 0.8
    return 0.9 if re.search(r"control|ctl", words) else 0.94


def _quantity_by_unit(unit: str | None, stated: str, words: str) -> str:
    """The quantity that a unit implies, where the words name no quantity; "" without one."""
    if unit == "m/s":
        return "wind_speed" if " wind " in words else ""
    if unit == "rpm":
        machine = re.search(r" (rotor|generator) ", words)
        return "" if machine is None else f"{machine[1]}_speed"
    if unit == "%":
        return "relative_humidity" if re.search(r"rf|rh", stated.lower()) else ""
    dimension = UNITS[unit].dimension if unit is not None else ""
    return dimension if dimension in ("pressure", "temperature") else ""


def _signal_of(quantity: str, place: str, words: str) -> str:
    if quantity == "power":
        if re.search(r"heater|heiz", words):
            return "heater_power"
        return (
            "auxiliary_power"
            if re.search(r"auxil|own consum|eigenverb|eigenbedarf", words)
            else "active_power"
        )
    if quantity == "pressure":
        return "ambient_pressure"
    if quantity in ("temperature", "relative_humidity", "absolute_humidity", "dew_point_temperature"):
        if place == "cabinet" and re.search(r" wall |wand", words):
            place = "cabinet_wall"
        return signal if (signal := f"{place}_{quantity}") in SIGNALS else ""
    return quantity


def _split_unit(name: str, below: str) -> tuple[str, str, str | None]:
    """Name without its unit, the unit as written, and the unit's name in `UNITS`."""
    if below.strip().strip("[]()-"):
        return name, below, unit_in_export(below)
    for bracket in reversed(list(_BRACKETS.finditer(name))):
        unit = unit_in_export(bracket[1])
        if unit is not None:
            return name[: bracket.start()] + name[bracket.end() :], bracket[1], unit
    # loggers: "Temp, °C (LGR S/N: 123, SEN S/N: 123)"
    logger = re.match(r"(.+?),\s*([^,(]+?)\s*(\(.*)?$", name)
    if logger is not None and unit_in_export(logger[2]) is not None:
        label = re.search(r"LBL:\s*([^,)]+)", logger[3] or "")
        return f"{logger[1]} {label[1] if label else ''}", logger[2], unit_in_export(logger[2])
    if unit_in_export(name) is not None and len(name) > 1:
        return name, name, unit_in_export(name)
    suffix = _SUFFIX.search(name) or re.search(r"[ _](Wm2)$", name)
    if suffix is not None:
        return name[: suffix.start()], suffix[1], unit_in_export(suffix[1])
    brackets = _BRACKETS.findall(name)
    return name, brackets[-1] if brackets else "", None
