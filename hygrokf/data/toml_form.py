"""TOML files as frozen dataclasses: a field is a key of a table, with its help, range and choices.

    @dataclass(frozen=True)
    class Chamber:
        temperature_ramp_K_per_h: float = setting(60.0, "steepest ramp", least=0.1, most=6000.0)

`read_form` makes the dataclass from a table and collects every fault.  The type of a field is that of its
value: text, a number, a whole number, true or false, a tuple (a list of these, or of tables [[key]]), a
dataclass (a table) or a mapping of dataclasses (a table of named tables).  Methods marked by `across` check
several keys together, if none of them is at fault.  A form's `REFUSED` gives the message for keys that a user
may expect but that do not exist.  A form's `OF` completes the message "unknown key …", such as " of [test]",
and takes precedence over `Place.of`.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast, get_args, get_origin, get_type_hints

from hygrokf.data.structured import shown
from hygrokf.errors import HygrokfError, suggestion

T = TypeVar("T")
BLANKS: Mapping[Any, Any] = {str: "", float: math.nan}
"""Placeholder for a missing or faulty value without a default; None for other types."""
TablePath = tuple[str | int, ...]
"""Names of tables and keys from the outside in; a number counts the tables of one [[name]] from 0."""
_NAME = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_NAMES = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_HEAD = re.compile(rf"\s*(\[\[?)\s*({_NAMES})\s*\]")
_KEY = re.compile(rf"\s*({_NAMES})\s*=")
STATED, OF_ENTRY = "stated", "of entry"
Check = Callable[[Any], str | Iterable[str] | None]
"""A method of a form that returns its faults: one, several or none."""


class FormFault(HygrokfError):
    """A file that cannot be used; `faults` lists every reason, the message contains all of them."""

    def __init__(self, file: str | os.PathLike[str], faults: Iterable[str]) -> None:
        self.file, self.faults = str(file), tuple(faults)
        count = f"{len(self.faults)} fault{'s' if len(self.faults) != 1 else ''}"
        listed = (f"  {number}. {fault}" for number, fault in enumerate(self.faults, 1))
        super().__init__("\n".join([f"{file}: {count}", *listed]))

    def __reduce__(self) -> tuple[type[FormFault], tuple[str, tuple[str, ...]]]:
        return type(self), (self.file, self.faults)  # a worker process can return the fault


# --- the keys of a form ----------------------------------------------------------------------


@dataclass(frozen=True)
class Key:
    """The declaration of a key besides its type.

    help: its meaning. choices: all permitted values. least, most, above: limits of a number; `above`
        itself is excluded.
    empty: whether a text may be empty. expected: description of a valid value, in place of that of the type.
    read: converts the value, in place of the type's reader; raises ValueError. fits: a further condition on
        the converted value, described by `expected`. remedy: a hint appended to the message of a fault.
        lacking: what to state, in place of `help`, where the table at a place lacks the key.
    """

    help: str = ""
    choices: tuple[str, ...] = ()
    least: float | None = None
    most: float | None = None
    above: float | None = None
    empty: bool = False
    expected: str = ""
    read: Callable[[Any], Any] | None = None
    fits: Callable[[Any], bool] | None = None
    remedy: str = ""
    lacking: Callable[[Place], str] | None = None

    @property
    def limits(self) -> str:
        """The limits of a number in words, such as " within 0 … 1"."""
        if self.least is not None and self.most is not None:
            return f" within {self.least:g} … {self.most:g}"
        low = f" above {self.above:g}" if self.above is not None else ""
        low += f" from {self.least:g} on" if self.least is not None else ""
        return low + (f"{' and' * bool(low)} at most {self.most:g}" if self.most is not None else "")

    def within(self, number: float) -> bool:
        """Whether a number keeps to the limits."""
        return (
            (self.least is None or number >= self.least)
            and (self.most is None or number <= self.most)
            and (self.above is None or number > self.above)
        )


def setting(default: Any = MISSING, help: str = "", **stated: Any) -> Any:
    """A field of a form: default (a key without one is required), meaning, further fields of its `Key`."""
    metadata = {STATED: Key(help, **{"empty": isinstance(default, str) and not default, **stated})}
    if isinstance(default, type):
        return dataclasses.field(default_factory=default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def entry_name(read: Callable[[str], Any] = str) -> Any:
    """The field of a form that holds the name of its named table; `read` converts it, raises ValueError."""
    return dataclasses.field(metadata={OF_ENTRY: True, STATED: Key(read=read)})


@dataclass(frozen=True, kw_only=True)
class FolderKeys:
    """A table that names files; their paths are relative to `folder`, the folder of the TOML file."""

    folder: Path = field(default=Path(), metadata={OF_ENTRY: True})

    def path(self, key: str) -> Path | None:
        """The path of the file that a key names; None where the key is empty."""
        return self.folder / getattr(self, key) if getattr(self, key) else None


def across(*keys: str) -> Callable[[Check], Check]:
    """Mark a method of a form as a check of these keys; it runs if none of them is missing or at fault.

    Its faults are reported at the first of these keys that the table has.
    """

    def mark(check: Check) -> Check:
        setattr(check, "keys", keys)  # noqa: B010
        return check

    return mark


@cache
def keys_of(form: Any) -> Mapping[str, tuple[dataclasses.Field[Any], Key, Any]]:
    """The keys of a form by their names in the file: field, declaration, type without None.

    The text of a value with its own reader states the unit ("10min"), so its key has no "_s" for seconds.
    """
    keys, hints = {}, get_type_hints(form)
    # keyword-only fields are those of a base: they come last
    for declared in sorted(dataclasses.fields(form), key=lambda declared: declared.kw_only is True):
        stated = declared.metadata.get(STATED, Key())
        if not declared.metadata.get(OF_ENTRY):
            kinds = [kind for kind in get_args(hints[declared.name]) if kind is not type(None)]
            optional = len(kinds) == 1 and type(None) in get_args(hints[declared.name])
            name = declared.name if stated.read is None else declared.name.removesuffix("_s")
            keys[name] = (declared, stated, kinds[0] if optional else hints[declared.name])
    return keys


@cache
def _checks(form: Any) -> list[tuple[tuple[str, ...], Check]]:
    """The checks across keys of a form, those that it inherits first."""
    members = [
        member for kind in reversed(form.__mro__) for member in vars(kind).values() if callable(member)
    ]
    return [(check.keys, check) for check in members if isinstance(getattr(check, "keys", None), tuple)]


# --- places in messages ----------------------------------------------------------------------


def lines_of(text: str) -> dict[TablePath, int]:
    """The line of each table and key of a TOML text, counted from 1; keys of inline tables are left out."""
    lines: dict[TablePath, int] = {}
    counts: dict[TablePath, int] = {}
    table: TablePath = ()
    for number, line in enumerate(text.splitlines(), 1):
        head, key = _HEAD.match(line), _KEY.match(line)
        if head is not None:
            table = _table_path(_split(head[2]), counts, head[1] == "[[")
            lines.setdefault(table, number)
        elif key is not None:
            names = _split(key[1])
            for length in range(len(names)):
                lines.setdefault((*table, *names[: length + 1]), number)
    return lines


def _split(names: str) -> list[str]:
    return [name.strip("\"'") for name in re.findall(_NAME, names)]


def _table_path(names: list[str], counts: dict[TablePath, int], begins: bool) -> TablePath:
    """The path of a table's head; [[name]] counts as the newest of its name, with `begins` as a new one."""
    path: TablePath = ()
    for place, name in enumerate(names, 1):
        path = (*path, name)
        if begins and place == len(names):
            counts[path] = counts.get(path, -1) + 1
        if path in counts:
            path = (*path, counts[path])
    return path


@dataclass(frozen=True)
class Place:
    """How messages name a table, such as "[test]" or "line 7, [[turbine]] 2", and the faults so far.

    name: of the table; empty for the file itself. of: the table as the end of "unknown key …". faults: of the
    whole file. lines: line numbers of tables and keys, if messages give them. path: of the table. file: name
    of the file, if messages begin with it.
    """

    name: str = ""
    of: str = ""
    faults: list[str] = field(default_factory=list, repr=False, compare=False)
    lines: Mapping[TablePath, int] = field(default_factory=dict, repr=False, compare=False)
    path: TablePath = ()
    file: str = ""

    def at(self, *keys: str) -> str:
        """The place of the first of these keys whose line is known, else of the table."""
        around = (self.path[:length] for length in range(len(self.path), 0, -1))
        # a key of an inline table stands on the line of that table
        places = (*((*self.path, key) for key in keys), *around)
        line = next((self.lines[place] for place in places if place in self.lines), None)
        return ", ".join(filter(None, (self.file, "" if line is None else f"line {line}", self.name)))

    def fault(self, text: str, *keys: str) -> None:
        """Add a fault at the place that `at` gives for these keys."""
        where = self.at(*keys)
        self.faults.append(f"{where}: {text}" if where else text)

    def table(self, key: str) -> str:
        """The head of the table under a key, such as " [site]"; empty inside another table."""
        return "" if self.name else f" [{key}]"

    def needs(self, key: str, stated: Key) -> str:
        """The fault of a key that is missing."""
        meaning = f"one of {', '.join(stated.choices)}" if stated.choices else stated.help
        meaning = meaning if stated.lacking is None else stated.lacking(self)
        return f"needs {key}, {meaning}" if meaning else f"needs {key}"

    def inside(self, key: str, number: int | None = None, entry: str | None = None) -> Place:
        """The place of the table under a key; `number` counts the tables [[key]] from 0, `entry` names a
        table inside."""
        name = f"{self.name} {key}" if self.name else f"[{key}]"
        if number is not None:
            name = f"[[{key}]] {number + 1}"
        elif entry is not None:
            name = f"{name}.{entry}"
        within = (step for step in (number, entry) if step is not None)
        return dataclasses.replace(self, name=name, path=(*self.path, key, *within))


# --- reading ---------------------------------------------------------------------------------


def read_toml(
    path: str | os.PathLike[str], fault_class: type[FormFault] = FormFault
) -> tuple[str, dict[str, Any]]:
    """Text and content of a TOML file.  Raises FormFault, which names the line of a mistake."""
    file = Path(path)
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        near = [form_file.name for form_file in file.parent.glob("*.toml")] if file.parent.is_dir() else []
        fault = f"cannot be read: No such file; check the path{suggestion(file.name, near)}"
        raise fault_class(file, [fault]) from None
    except OSError as fault:
        remedies = {IsADirectoryError: "name a file in it", PermissionError: "check its rights"}
        remedy = remedies.get(type(fault), "check path and disk")
        raise fault_class(file, [f"cannot be read: {fault.strerror or fault}; {remedy}"]) from None
    except UnicodeDecodeError:
        raise fault_class(file, ["expected TOML text in UTF-8, found other bytes"]) from None
    try:
        return text, tomllib.loads(text.replace("\r\n", "\n"))
    except tomllib.TOMLDecodeError as fault:
        raise fault_class(file, [syntax_fault(str(fault), text)]) from None
    except (ValueError, RecursionError) as fault:  # more digits or brackets than Python reads
        raise fault_class(file, [f"not valid TOML: {fault}"]) from None


def syntax_fault(reason: str, text: str) -> str:
    """The fault of invalid TOML, with its line."""
    position = re.search(r"\(at line (\d+), column (\d+)\)", reason)
    reason = re.sub(r"\s*\(at [^)]*\)$", "", reason)
    if twice := re.search(r"\('(\w+)',\)", reason):
        reason += f"; write [[{twice[1]}]] with two brackets, once for each"
    if position is not None:
        number, where = int(position[1]), f"line {position[1]}, column {position[2]}"
    else:
        # the parser gives no line for a fault at the end of the document
        number = len(text.rstrip().splitlines())
        where = f"line {number}, at the end"
    line = text.splitlines()[number - 1 : number]
    shown = f", in: {line[0].strip()[:80]}" if line else ""
    return f"{where}: not valid TOML: {reason}{shown}"


def read_toml_form(form: type[T], path: str | os.PathLike[str]) -> T:
    """The form of a file.  Raises FormFault with every fault."""
    place = Place()
    result = read_form(form, read_toml(path)[1], place)
    if place.faults:
        raise FormFault(path, place.faults)
    return result


def read_form(form: type[T], table: Mapping[str, object], place: Place, **named: object) -> T:
    """The form of a table; every fault is added to those of `place`.

    place: of the table in messages. named: fields that are not in the table.
    """
    keys = keys_of(cast(Any, form))
    refused: Mapping[str, str] = getattr(form, "REFUSED", {})
    for name in table:
        if name not in keys:
            of, near = getattr(form, "OF", place.of), suggestion(str(name), keys)
            unknown = f'unknown key "{name}"{of}; expected {", ".join(keys)}{near}'
            place.fault(refused.get(name, unknown), name)
    faulty: set[str] = set()
    values = dict(named)
    for name, (declared, stated, kind) in keys.items():
        before = len(place.faults)
        needed = declared.default is MISSING and declared.default_factory is MISSING
        try:
            if name in table:
                values[declared.name] = _value(name, table[name], kind, stated, place)
            elif needed:
                place.fault(place.needs(name, stated))
            elif _is_form(declared.default_factory):  # a table that is left out is an empty one
                values[declared.name] = read_form(kind, {}, place.inside(name))
        except ValueError as fault:
            place.fault(str(fault), name)
        if len(place.faults) > before:
            faulty.add(name)
            if needed:
                values.setdefault(declared.name, BLANKS.get(kind))
    try:
        result = form(**values)
    except ValueError as fault:
        if not faulty:
            place.fault(str(fault), *keys)
        return cast(T, None)
    for checked, check in _checks(cast(Any, form)):
        if faulty.isdisjoint(checked):
            messages = check(result) or ()
            for text in [messages] if isinstance(messages, str) else messages:
                place.fault(text, *(name for name in checked if name in table))
    return result


def _value(name: str, value: Any, kind: Any, stated: Key, place: Place) -> Any:
    """The value of a key; faults inside of its tables go to `place`.  Raises ValueError."""
    inner = get_args(kind)
    if _is_form(kind) and stated.read is None:
        if isinstance(value, Mapping):
            return read_form(kind, value, place.inside(name))
        raise ValueError(f"{name} must be a table{place.table(name)}, found {value!r}")
    if get_origin(kind) is Mapping and inner[1] is not Any:
        return _read_named_tables(name, value, inner[1], place)
    if inner and (_is_form(inner[0]) or get_origin(inner[0]) is Mapping):
        return _read_tables(name, value, inner[0], place)
    try:
        converted = stated.read(value) if stated.read is not None else _plain(value, kind, stated)
        if (stated.fits is None or stated.fits(converted)) and (
            stated.read is None or stated.within(converted)
        ):
            return converted
    except ValueError as fault:
        raise ValueError(f"{name}: {fault}") from None
    except (TypeError, OverflowError):
        pass
    near = suggestion(value, stated.choices) if isinstance(value, str) else ""
    value_text = f'"{value}"' if stated.choices and isinstance(value, str) else shown(value)
    remedy = f"; {stated.remedy}" if stated.remedy else ""
    raise ValueError(f"{name} must be {_expected_value(kind, stated)}, found {value_text}{near}{remedy}")


def _read_tables(name: str, value: Any, form: Any, place: Place) -> tuple[Any, ...]:
    """The tables [[name]], as mappings or as forms; a single table [name] is a fault, but is read too."""
    rows = [value] if isinstance(value, Mapping) else value
    is_list_of_tables = isinstance(rows, list) and all(isinstance(row, Mapping) for row in rows)
    if not is_list_of_tables or rows is not value:
        place.fault(f"{name}: write [[{name}]] with two brackets, once for each", name)
    if not is_list_of_tables or not _is_form(form):
        return tuple(rows) if is_list_of_tables else ()
    return tuple(read_form(form, row, place.inside(name, number)) for number, row in enumerate(rows))


def _is_form(kind: object) -> bool:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def _read_named_tables(name: str, value: Any, form: Any, place: Place) -> Mapping[str, Any]:
    """The named tables under a key, without those whose name is at fault."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a table{place.table(name)}, found {value!r}")
    title = next(declared for declared in dataclasses.fields(form) if declared.metadata.get(OF_ENTRY))
    needed = (f"{key} = …" for key, (stated, *_) in keys_of(form).items() if stated.default is MISSING)
    shape = f"expected {{ {', '.join(needed)} }}"
    entries: dict[str, Any] = {}
    for entry, table in value.items():
        inside = place.inside(name, entry=entry)
        try:
            named = {title.name: title.metadata[STATED].read(entry)}
        except ValueError as fault:
            inside.fault(str(fault))
            continue
        if isinstance(table, Mapping):
            entries[entry] = read_form(form, table, inside, **named)
        else:
            inside.fault(f"{shape}, found {shown(table)}")
    return entries


def _plain(value: Any, kind: Any, stated: Key) -> Any:
    """A value of a plain type.  Raises TypeError for another type."""
    if kind is Any or get_origin(kind) is Mapping:
        is_valid = kind is Any or isinstance(value, Mapping)
    elif stated.choices and kind is str:
        is_valid = isinstance(value, str) and value in stated.choices
    elif isinstance(kind, type) and issubclass(kind, StrEnum):
        is_valid = value in list(kind)
        value = kind(value) if is_valid else value
    elif kind in (float, int):
        number = isinstance(value, numbers.Integral if kind is int else numbers.Real)
        is_valid = number and not isinstance(value, bool) and math.isfinite(value) and stated.within(value)
        value = kind(value) if is_valid else value
    elif kind in (str, bool):
        is_valid = isinstance(value, kind) and (value != "" or stated.empty)
    else:
        inner = get_args(kind)
        is_valid = isinstance(value, (list, tuple)) and (inner[1] is ... or len(value) == len(inner))
        value = tuple(_plain(item, inner[0], stated) for item in value) if is_valid else value
        is_valid = is_valid and (inner[1] is ... or value[0] < value[1])
    if not is_valid:
        raise TypeError
    return value


def _expected_value(kind: Any, stated: Key) -> str:
    """Description of a valid value."""
    inner = get_args(kind)
    if stated.expected or stated.choices:
        return stated.expected or f"{'a list' if inner else 'one'} of {', '.join(stated.choices)}"
    if get_origin(kind) is Mapping:
        return "a table"
    if inner:
        several = {str: "texts", float: "numbers"}[inner[0]] + stated.limits
        return f"a list of {several}" if inner[1] is ... else f"two rising {several}"
    return {str: "text in quotes", bool: "true or false"}.get(kind) or (
        f"a {'whole ' * (kind is int)}number{stated.limits}"
    )
