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
        """Make the message: the file, the number of faults, and all faults numbered."""
        self.file, self.faults = str(file), tuple(faults)
        count = f"{len(self.faults)} fault{'s' if len(self.faults) != 1 else ''}"
        listed = (f"  {number}. {fault}" for number, fault in enumerate(self.faults, 1))
        super().__init__("\n".join([f"{file}: {count}", *listed]))

    def __reduce__(self) -> tuple[type[FormFault], tuple[str, tuple[str, ...]]]:
        """Return how to pickle the fault, so that a worker process can return it."""
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
        """The limits of a number in words, such as " within 0 … 1"; "" without limits."""
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
    """Declare a field of a form.

    default: a key without one is required.  help: what the key means.  stated: further fields of its `Key`.
    """
    metadata = {STATED: Key(help, **{"empty": isinstance(default, str) and not default, **stated})}
    if isinstance(default, type):
        return dataclasses.field(default_factory=default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def entry_name(read: Callable[[str], Any] = str) -> Any:
    """Declare the field of a form that holds the name of its named table.

    read: converts the name; raises ValueError.
    """
    return dataclasses.field(metadata={OF_ENTRY: True, STATED: Key(read=read)})


@dataclass(frozen=True, kw_only=True)
class FolderKeys:
    """A table that names files; their paths are relative to `folder`, the folder of the TOML file."""

    folder: Path = field(default=Path(), metadata={OF_ENTRY: True})

    def path(self, key: str) -> Path | None:
        """Return the path of the file that a key names; None where the key is empty."""
        return self.folder / getattr(self, key) if getattr(self, key) else None


def across(*keys: str) -> Callable[[Check], Check]:
    """Mark a method of a form as a check of several keys.

    It runs if none of these keys is missing or at fault.  Its faults are reported at the first of them that
    the table has.
    """

    def mark(check: Check) -> Check:
        """Store the keys at the method."""
        setattr(check, "keys", keys)  # noqa: B010
        return check

    return mark


@cache
def keys_of(form: Any) -> Mapping[str, tuple[dataclasses.Field[Any], Key, Any]]:
    """Return the keys of a form by their names in the file: field, declaration, type without None.

    A value with its own reader states its unit in the text ("10min"), so its key has no "_s" for seconds.
    """
    keys, hints = {}, get_type_hints(form)
    # keyword-only fields are those of a base: they come last
    for declared in sorted(dataclasses.fields(form), key=lambda declared: declared.kw_only is True):
        key = declared.metadata.get(STATED, Key())
        if not declared.metadata.get(OF_ENTRY):
            types_without_none = [kind for kind in get_args(hints[declared.name]) if kind is not type(None)]
            is_optional = len(types_without_none) == 1 and type(None) in get_args(hints[declared.name])
            name = declared.name if key.read is None else declared.name.removesuffix("_s")
            keys[name] = (declared, key, types_without_none[0] if is_optional else hints[declared.name])
    return keys


@cache
def _checks(form: Any) -> list[tuple[tuple[str, ...], Check]]:
    """Return the checks of several keys that a form declares, those of its bases first."""
    members = [
        member for kind in reversed(form.__mro__) for member in vars(kind).values() if callable(member)
    ]
    return [(check.keys, check) for check in members if isinstance(getattr(check, "keys", None), tuple)]


# --- places in messages ----------------------------------------------------------------------


def lines_of(text: str) -> dict[TablePath, int]:
    """Return the line number of each table and key of a TOML text; keys of inline tables are left out."""
    lines: dict[TablePath, int] = {}
    counts: dict[TablePath, int] = {}
    table_path: TablePath = ()
    for number, line in enumerate(text.splitlines(), 1):
        table_head, key_head = _HEAD.match(line), _KEY.match(line)
        if table_head is not None:
            table_path = _table_path(_split(table_head[2]), counts, table_head[1] == "[[")
            lines.setdefault(table_path, number)
        elif key_head is not None:
            names = _split(key_head[1])
            for length in range(len(names)):
                lines.setdefault((*table_path, *names[: length + 1]), number)
    return lines


def _split(names: str) -> list[str]:
    """Return the parts of a dotted TOML name without quotes."""
    return [name.strip("\"'") for name in re.findall(_NAME, names)]


def _table_path(names: list[str], counts: dict[TablePath, int], begins: bool) -> TablePath:
    """Return the path of a table's head.

    [[name]] counts as the newest table of that name; with `begins` it begins a new one.
    """
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
    """How messages name a table of a TOML file, such as "[test]" or "line 7, [[turbine]] 2", with the faults
    so far.

    name: of the table; empty for the file itself.
    of: the table as the end of "unknown key …".
    faults: of the whole file.
    lines: line numbers of tables and keys, if messages give them.
    path: of the table.  file: name of the file, if messages begin with it.
    """

    name: str = ""
    of: str = ""
    faults: list[str] = field(default_factory=list, repr=False, compare=False)
    lines: Mapping[TablePath, int] = field(default_factory=dict, repr=False, compare=False)
    path: TablePath = ()
    file: str = ""

    def at(self, *keys: str) -> str:
        """Return the place of the first of these keys whose line is known, else of the table."""
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
        """Return the head of the table under a key, such as " [site]"; empty inside another table."""
        return "" if self.name else f" [{key}]"

    def needs(self, key: str, stated: Key) -> str:
        """Return the fault of a key that is missing."""
        meaning = f"one of {', '.join(stated.choices)}" if stated.choices else stated.help
        meaning = meaning if stated.lacking is None else stated.lacking(self)
        return f"needs {key}, {meaning}" if meaning else f"needs {key}"

    def inside(self, key: str, number: int | None = None, entry: str | None = None) -> Place:
        """Return the place of the table under a key.

        number: counts the tables [[key]] from 0.  entry: name of a table inside.
        """
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
    """Return text and content of a TOML file.  Raises FormFault, which names the line of a mistake.

    fault_class: class of the fault.
    """
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
    """Return the fault of invalid TOML with its line; reason: message of the parser."""
    position = re.search(r"\(at line (\d+), column (\d+)\)", reason)
    reason = re.sub(r"\s*\(at [^)]*\)$", "", reason)
    if repeated_table := re.search(r"\('(\w+)',\)", reason):
        reason += f"; write [[{repeated_table[1]}]] with two brackets, once for each"
    if position is not None:
        number, where = int(position[1]), f"line {position[1]}, column {position[2]}"
    else:
        # the parser gives no line for a fault at the end of the document
        number = len(text.rstrip().splitlines())
        where = f"line {number}, at the end"
    line = text.splitlines()[number - 1 : number]
    quoted_line = f", in: {line[0].strip()[:80]}" if line else ""
    return f"{where}: not valid TOML: {reason}{quoted_line}"


def read_toml_form(form: type[T], path: str | os.PathLike[str]) -> T:
    """Return the form of a TOML file.  Raises FormFault with every fault."""
    place = Place()
    result = read_form(form, read_toml(path)[1], place)
    if place.faults:
        raise FormFault(path, place.faults)
    return result


def read_form(form: type[T], table: Mapping[str, object], place: Place, **named: object) -> T:
    """Return the form (dataclass) of a TOML table; every fault is added to those of `place`.

    place: of the table in messages.  named: values of fields that are not in the table.
    """
    keys = keys_of(cast(Any, form))
    refused_keys: Mapping[str, str] = getattr(form, "REFUSED", {})
    for name in table:
        if name not in keys:
            where_unknown, suggestion_text = getattr(form, "OF", place.of), suggestion(str(name), keys)
            unknown = f'unknown key "{name}"{where_unknown}; expected {", ".join(keys)}{suggestion_text}'
            place.fault(refused_keys.get(name, unknown), name)
    faulty_keys: set[str] = set()
    values = dict(named)
    for name, (declared, key, kind) in keys.items():
        fault_count = len(place.faults)
        is_required = declared.default is MISSING and declared.default_factory is MISSING
        try:
            if name in table:
                values[declared.name] = _value(name, table[name], kind, key, place)
            elif is_required:
                place.fault(place.needs(name, key))
            elif _is_form(declared.default_factory):  # a table that is left out is an empty one
                values[declared.name] = read_form(kind, {}, place.inside(name))
        except ValueError as fault:
            place.fault(str(fault), name)
        if len(place.faults) > fault_count:
            faulty_keys.add(name)
            if is_required:
                values.setdefault(declared.name, BLANKS.get(kind))
    try:
        form_object = form(**values)
    except ValueError as fault:
        if not faulty_keys:
            place.fault(str(fault), *keys)
        return cast(T, None)
    for checked_keys, check in _checks(cast(Any, form)):
        if faulty_keys.isdisjoint(checked_keys):
            messages = check(form_object) or ()
            for text in [messages] if isinstance(messages, str) else messages:
                place.fault(text, *(name for name in checked_keys if name in table))
    return form_object


def _value(name: str, value: Any, kind: Any, key: Key, place: Place) -> Any:
    """Return the value of a key; faults inside of its tables go to `place`.  Raises ValueError for its own
    faults.

    kind: type of the field.  key: its declaration.
    """
    type_arguments = get_args(kind)
    if _is_form(kind) and key.read is None:
        if isinstance(value, Mapping):
            return read_form(kind, value, place.inside(name))
        raise ValueError(f"{name} must be a table{place.table(name)}, found {value!r}")
    if get_origin(kind) is Mapping and type_arguments[1] is not Any:
        return _read_named_tables(name, value, type_arguments[1], place)
    if type_arguments and (_is_form(type_arguments[0]) or get_origin(type_arguments[0]) is Mapping):
        return _read_tables(name, value, type_arguments[0], place)
    try:
        converted_value = key.read(value) if key.read is not None else _plain(value, kind, key)
        if (key.fits is None or key.fits(converted_value)) and (
            key.read is None or key.within(converted_value)
        ):
            return converted_value
    except ValueError as fault:
        raise ValueError(f"{name}: {fault}") from None
    except (TypeError, OverflowError):
        pass
    suggestion_text = suggestion(value, key.choices) if isinstance(value, str) else ""
    value_text = f'"{value}"' if key.choices and isinstance(value, str) else shown(value)
    remedy = f"; {key.remedy}" if key.remedy else ""
    raise ValueError(
        f"{name} must be {_expected_value(kind, key)}, found {value_text}{suggestion_text}{remedy}"
    )


def _read_tables(name: str, value: Any, form: Any, place: Place) -> tuple[Any, ...]:
    """Return the tables [[name]], as mappings or as forms; a single table [name] is a fault, but is read
    too."""
    tables = [value] if isinstance(value, Mapping) else value
    is_list_of_tables = isinstance(tables, list) and all(isinstance(table, Mapping) for table in tables)
    if not is_list_of_tables or tables is not value:
        place.fault(f"{name}: write [[{name}]] with two brackets, once for each", name)
    if not is_list_of_tables or not _is_form(form):
        return tuple(tables) if is_list_of_tables else ()
    return tuple(read_form(form, table, place.inside(name, number)) for number, table in enumerate(tables))


def _is_form(kind: object) -> bool:
    """Whether a type is a form, that is, a dataclass."""
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def _read_named_tables(name: str, value: Any, form: Any, place: Place) -> Mapping[str, Any]:
    """Return the named tables under a key as forms, without those whose name is at fault."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a table{place.table(name)}, found {value!r}")
    name_field = next(declared for declared in dataclasses.fields(form) if declared.metadata.get(OF_ENTRY))
    required_keys = (
        f"{key} = …"
        for key, (declared_field, *_) in keys_of(form).items()
        if declared_field.default is MISSING
    )
    expected_shape = f"expected {{ {', '.join(required_keys)} }}"
    entries: dict[str, Any] = {}
    for entry, table in value.items():
        place_of_entry = place.inside(name, entry=entry)
        try:
            name_argument = {name_field.name: name_field.metadata[STATED].read(entry)}
        except ValueError as fault:
            place_of_entry.fault(str(fault))
            continue
        if isinstance(table, Mapping):
            entries[entry] = read_form(form, table, place_of_entry, **name_argument)
        else:
            place_of_entry.fault(f"{expected_shape}, found {shown(table)}")
    return entries


def _plain(value: Any, kind: Any, key: Key) -> Any:
    """Return a value of a plain type (text, number, flag, list).  Raises TypeError for another type."""
    if kind is Any or get_origin(kind) is Mapping:
        is_valid = kind is Any or isinstance(value, Mapping)
    elif key.choices and kind is str:
        is_valid = isinstance(value, str) and value in key.choices
    elif isinstance(kind, type) and issubclass(kind, StrEnum):
        is_valid = value in list(kind)
        value = kind(value) if is_valid else value
    elif kind in (float, int):
        is_number = isinstance(value, numbers.Integral if kind is int else numbers.Real)
        is_valid = is_number and not isinstance(value, bool) and math.isfinite(value) and key.within(value)
        value = kind(value) if is_valid else value
    elif kind in (str, bool):
        is_valid = isinstance(value, kind) and (value != "" or key.empty)
    else:
        type_arguments = get_args(kind)
        is_valid = isinstance(value, (list, tuple)) and (
            type_arguments[1] is ... or len(value) == len(type_arguments)
        )
        value = tuple(_plain(item, type_arguments[0], key) for item in value) if is_valid else value
        is_valid = is_valid and (type_arguments[1] is ... or value[0] < value[1])
    if not is_valid:
        raise TypeError
    return value


def _expected_value(kind: Any, key: Key) -> str:
    """Describe a valid value of a key for a message."""
    type_arguments = get_args(kind)
    if key.expected or key.choices:
        return key.expected or f"{'a list' if type_arguments else 'one'} of {', '.join(key.choices)}"
    if get_origin(kind) is Mapping:
        return "a table"
    if type_arguments:
        plural = {str: "texts", float: "numbers"}[type_arguments[0]] + key.limits
        return f"a list of {plural}" if type_arguments[1] is ... else f"two rising {plural}"
    return {str: "text in quotes", bool: "true or false"}.get(kind) or (
        f"a {'whole ' * (kind is int)}number{key.limits}"
    )
