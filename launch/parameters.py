"""Checks a node's parameters against its `Config` dataclass, and turns them into plain JSON values.

The dataclass is the one place that says which parameters there are, of which type and with which default; a launch
file that disagrees is refused before any process starts, with a message that lists what would be valid.
"""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Literal


class GraphError(ValueError):
    """A graph that cannot run; the message says why and what would be valid."""


def did_you_mean(word: str, valid: Iterable[str]) -> str:
    """' (did you mean X?)' for the closest valid word, or nothing."""
    close = difflib.get_close_matches(word, list(valid), n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def check_parameters(slot: str, owner: str, config: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """All parameters of the dataclass `config`: those given, checked and converted, and defaults for the others.

    `owner` is the node's name for messages. Raises GraphError for an unknown or missing parameter or a wrong type.
    """
    hints = typing.get_type_hints(config)
    declared = [field for field in fields(config) if field.init]
    names = [field.name for field in declared]
    for name in given:
        if name not in names:
            raise GraphError(
                f"{_path(slot, name)}: {owner} has no parameter {name!r}{_meant(slot, name, given, names)}; it has:\n"
                + describe(config)
            )
    values: dict[str, Any] = {}
    for field in declared:
        where = _path(slot, field.name)
        if field.name in given:
            values[field.name] = convert(given[field.name], hints[field.name], where)
        elif field.default is not MISSING:
            values[field.name] = _plain(field.default)
        elif field.default_factory is not MISSING:
            values[field.name] = _plain(field.default_factory())
        else:
            raise GraphError(f"{where} must be given: {owner} has no default for it ({type_name(hints[field.name])})")
    return values


def _meant(slot: str, name: str, given: Mapping[str, Any], names: Sequence[str]) -> str:
    """The parameter that a wrong name is close to; or the one, a mapping, that has such a key."""
    for parameter, value in given.items():
        if isinstance(value, Mapping) and name in value:
            return f" (did you mean {_path(slot, parameter)}.{name}?)"
    return did_you_mean(name, names)


def _path(slot: str, name: str) -> str:
    return f"{slot}.{name}" if slot else name


def describe(config: type) -> str:
    """One line a parameter: name, type, default."""
    hints = typing.get_type_hints(config)
    lines = []
    for field in fields(config):
        if field.default is not MISSING:
            default = f" = {_plain(field.default)}"
        elif field.default_factory is not MISSING:
            default = f" = {_plain(field.default_factory())}"
        else:
            default = "  (must be given)"
        lines.append(f"  {field.name}: {type_name(hints[field.name])}{default}")
    return "\n".join(lines) or "  (no parameters)"


def convert(value: Any, annotation: Any, where: str) -> Any:
    """`value` as a plain JSON value of the annotated type. Raises GraphError, naming `where`, if it is none."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return convert(value, arguments[0], where)
    if annotation is Any or annotation is object:
        return _plain(value)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(value, annotation, where)
    if origin is Literal:
        if value in arguments and type(value) in {type(argument) for argument in arguments}:
            return value
    elif annotation is type(None):
        if value is None:
            return None
    elif isinstance(annotation, type) and is_dataclass(annotation):
        if isinstance(value, Mapping):
            return check_parameters(where, where, annotation, value)
    elif isinstance(annotation, type) and issubclass(annotation, Enum):
        if isinstance(value, annotation) or value in annotation.__members__:
            return value.name if isinstance(value, Enum) else value
    elif origin in (tuple, list, Sequence) or annotation in (tuple, list):
        return _convert_sequence(value, annotation, where)
    elif origin in (dict, Mapping) or annotation in (dict, Mapping):
        if isinstance(value, Mapping):
            of = arguments[1] if arguments else Any
            return {str(key): convert(item, of, f"{where}.{key}") for key, item in value.items()}
    else:
        scalar = _convert_scalar(value, annotation)
        if scalar is not None:
            return scalar
    raise GraphError(f"{where}={value}: must be {type_name(annotation)}")


def _convert_scalar(value: Any, annotation: Any) -> Any:
    """A bool, int, float, str or path; None where `value` is no such thing."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if annotation is bool:
        return value if isinstance(value, bool) else None
    if annotation is int:
        return value if is_number and isinstance(value, int) else None
    if annotation is float:
        return float(value) if is_number else None
    if annotation in (str, Path):
        return str(value) if is_number or isinstance(value, str | Path) else None
    return None


def _convert_union(value: Any, annotation: Any, where: str) -> Any:
    members = typing.get_args(annotation)
    # the member that the value already is comes first, so that int | str keeps 3 a number
    for member in sorted(members, key=lambda member: not (isinstance(member, type) and type(value) is member)):
        try:
            return convert(value, member, where)
        except GraphError:
            continue
    raise GraphError(f"{where}={value}: must be {type_name(annotation)}")


def _convert_sequence(value: Any, annotation: Any, where: str) -> list[Any]:
    arguments = typing.get_args(annotation)
    if isinstance(value, Sequence) and not isinstance(value, str):
        if typing.get_origin(annotation) is tuple and arguments and arguments[-1] is not Ellipsis:
            if len(value) == len(arguments):
                return [convert(v, t, f"{where}[{i}]") for i, (v, t) in enumerate(zip(value, arguments, strict=True))]
        else:
            of = arguments[0] if arguments else Any
            return [convert(item, of, f"{where}[{i}]") for i, item in enumerate(value)]
    raise GraphError(f"{where}={value}: must be {type_name(annotation)}")


def type_name(annotation: Any) -> str:
    """The annotation as a user reads it: `int`, `[int, int] or null`, `'a' or 'b'`."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return type_name(arguments[0])
    if annotation is type(None):
        return "null"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(type_name(member) for member in arguments)
    if origin is Literal:
        return " or ".join(repr(argument) for argument in arguments)
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return " or ".join(annotation.__members__)
    if origin in (tuple, list, Sequence):
        return f"[{', '.join('...' if argument is Ellipsis else type_name(argument) for argument in arguments)}]"
    return getattr(annotation, "__name__", str(annotation))


def _plain(value: Any) -> Any:
    """A default as the JSON value that `convert` would give."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
