"""Plain values, as a launch file or JSON has them, into a dataclass and back.

A node's `Config` is the one place that says which parameters there are, of which type and with which default. The
launcher and the node's process both build it here, so what one takes the other takes too.
"""

from __future__ import annotations

import difflib
import math
import sys
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Literal, TypeVar

from mvsgs_core.setting_ranges import LARGEST, UNBOUNDED

T = TypeVar("T")
MOST: dict[type, float] = {int: LARGEST, float: sys.float_info.max}  # of a number that is not UNBOUNDED


class ParameterError(ValueError):
    """A parameter that is unknown, missing or of the wrong type; the message says which, and what would be valid."""


@dataclass(frozen=True)
class Parameter:
    """One that is no dataclass itself."""

    path: str  # as a user writes it: mapper.insertion.price
    owner: type  # the dataclass that declares it
    name: str
    annotation: Any
    default: Any  # the JSON value; MISSING where it must be given


def build(config: type[T], given: Mapping[str, Any], where: str = "", base: T | None = None) -> T:
    """The dataclass `config` with the values given, and for the others those of `base`, or its own defaults.

    `where`: the path of these parameters, as a user writes it (`mapper.insertion`). Raises ParameterError.
    """
    hints = typing.get_type_hints(config, include_extras=True)
    declared = {field.name: field for field in fields(config) if field.init}  # type: ignore[arg-type]
    for name in given:
        if name not in declared:
            raise ParameterError(
                f"{_path(where, name)}: {_owner(config)} has no parameter {name!r}"
                f"{_meant(config, where, name, given)}; it has: {describe(config)}"
            )
    values = {}
    for name, field in declared.items():
        default, path = _default(field, base), _path(where, name)
        if name not in given:
            if default is MISSING:
                wanted = type_name(hints[name])
                raise ParameterError(f"{path} must be given: {_owner(config)} has no default for it ({wanted})")
            values[name] = default
        elif (nested := nested_in(hints[name])) and isinstance(default, nested) and isinstance(given[name], Mapping):
            values[name] = build(nested, given[name], path, default)  # the rest as it is here, not as in general
        else:
            values[name] = convert(given[name], hints[name], path, bounded=not _is_beyond(default))
    try:
        return config(**values)
    except ValueError as error:
        raise ParameterError(located(error, config, where)) from error


def located(error: Exception, config: type, where: str) -> str:
    """What a configuration's error says, with the path of the parameter that it names first (`lag=-1: ...`)."""
    said = str(error)
    if not where or said.startswith(where):
        return said
    return _path(where, said) if said.partition("=")[0] in parameter_names(config) else f"{where}: {said}"


def plain_values(value: Any) -> Any:
    """A parameter, or a whole dataclass of them, as the JSON value that `build` makes it from."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain_values(getattr(value, field.name)) for field in fields(value) if field.init}
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): plain_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(item) for item in value]
    return value


def parameter_names(config: type) -> list[str]:
    """Of a dataclass, without those of the dataclasses in it."""
    return [field.name for field in fields(config) if field.init]


def parameters(config: type, where: str = "", base: Any = None) -> Iterator[Parameter]:
    """Every parameter of a dataclass and of those in it, in order; `base`: an instance with the defaults."""
    hints = typing.get_type_hints(config)
    for field in fields(config):
        path, annotation, default = _path(where, field.name), hints[field.name], _default(field, base)
        nested = nested_in(annotation)
        if nested is not None and (nested is annotation or isinstance(default, nested)):
            yield from parameters(nested, path, None if default is MISSING else default)
        elif field.init:
            yield Parameter(path, config, field.name, annotation, plain_values(default))


def nested_in(annotation: Any) -> type | None:
    """The dataclass that a parameter is, or may be beside null; None where it is none."""
    members = [member for member in typing.get_args(annotation) if member is not type(None)] or [annotation]
    return members[0] if len(members) == 1 and isinstance(members[0], type) and is_dataclass(members[0]) else None


def describe(config: type) -> str:
    """All parameters in one line: name, type, default; of nested ones the names."""
    hints = typing.get_type_hints(config)
    described = []
    for field in fields(config):
        default = _default(field, None)
        if default is MISSING:
            text = " (must be given)"
        else:
            text = "" if is_dataclass(default) else f" = {plain_values(default)}"
        described.append(f"{field.name}: {type_name(hints[field.name])}{text}")
    return ", ".join(described) or "no parameters"


def did_you_mean(word: str, valid: Iterable[str]) -> str:
    """' (did you mean X?)' for the closest valid word, or nothing."""
    close = difflib.get_close_matches(word, list(valid), n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def convert(value: Any, annotation: Any, where: str, *, bounded: bool = True) -> Any:
    """`value` as an instance of the annotated type. Raises ParameterError, naming `where`, where it is none.

    bounded: numbers are finite, and integers at most LARGEST, unless the annotation says UNBOUNDED.
    """
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    kind = origin or annotation
    if origin is typing.Annotated:
        return convert(value, arguments[0], where, bounded=bounded and UNBOUNDED not in arguments[1:])
    if annotation is Any or annotation is object or (annotation is type(None) and value is None):
        return value
    if origin in (typing.Union, types.UnionType):
        # the member that the value already is comes first, so that int | str keeps 3 a number
        for member in sorted(arguments, key=lambda member: type(value) is not member):
            try:
                return convert(value, member, where, bounded=bounded)
            except ParameterError:
                if type(value) is member:  # and beyond its bounds: no text either
                    break
    elif origin is Literal:
        if any(value == argument and type(value) is type(argument) for argument in arguments):
            return value
    elif isinstance(kind, type) and is_dataclass(kind):
        if isinstance(value, Mapping):
            return build(kind, value, where)
    elif kind in (tuple, list, Sequence):
        if isinstance(value, Sequence) and not isinstance(value, str):
            return _sequence(value, annotation, where, bounded)
    elif kind in (dict, Mapping):
        if isinstance(value, Mapping):
            of = arguments[1] if arguments else Any
            return {str(key): convert(item, of, f"{where}.{key}", bounded=bounded) for key, item in value.items()}
    elif isinstance(kind, type):
        scalar = _scalar(value, kind, bounded)
        if scalar is not None:
            return scalar
    raise _wrong_type(value, annotation, where)


def _sequence(value: Sequence[Any], annotation: Any, where: str, bounded: bool) -> Any:
    kind, arguments = typing.get_origin(annotation) or annotation, typing.get_args(annotation)
    if kind is tuple and arguments and arguments[-1] is not Ellipsis:
        if len(value) != len(arguments):
            raise _wrong_type(value, annotation, where)
        types_of = arguments
    else:
        types_of = (arguments[0] if arguments else Any,) * len(value)
    pairs = enumerate(zip(value, types_of, strict=True))
    items = [convert(item, of, f"{where}[{i}]", bounded=bounded) for i, (item, of) in pairs]
    return tuple(items) if kind is tuple else items


def _scalar(value: Any, kind: type, bounded: bool = True) -> Any:
    """A bool, int, float, str, path or member of an enumeration; None where `value` is no such thing."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if issubclass(kind, Enum):
        return kind[value] if isinstance(value, str) and value in kind.__members__ else None
    if kind in MOST:  # NaN is below, above and equal to nothing: no other check would find it
        most = MOST[kind] if bounded else math.inf
        fits = is_number and (kind is float or isinstance(value, int)) and abs(value) <= most
        return (float(value) if kind is float else value) if fits else None
    if kind in (str, Path):
        return kind(str(value)) if is_number or isinstance(value, str | Path) else None
    return value if isinstance(value, kind) and (kind is bool or not isinstance(value, bool)) else None


def _is_beyond(default: Any) -> bool:
    """Whether a default is no bounded number, or has one among several."""
    items = default if isinstance(default, list | tuple) else [default]
    return any(isinstance(item, int | float) and _scalar(item, type(item)) is None for item in items)


def type_name(annotation: Any) -> str:
    """The annotation as a user reads it: `int`, `[int, int] or null`, `'a' or 'b'`, `{name, name}` of a dataclass."""
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
    if isinstance(annotation, type) and is_dataclass(annotation):
        return f"{{{', '.join(parameter_names(annotation))}}}"
    if origin in (tuple, list, Sequence):
        return f"[{', '.join('...' if argument is Ellipsis else type_name(argument) for argument in arguments)}]"
    return getattr(annotation, "__name__", str(annotation))


def _wrong_type(value: Any, annotation: Any, where: str) -> ParameterError:
    why = ""
    if isinstance(value, float) and not math.isfinite(value):
        why = "not a number, " if math.isnan(value) else "not finite, "
    elif isinstance(value, int) and abs(value) > LARGEST:
        why = f"beyond {LARGEST}, "
    return ParameterError(f"{where}={value}: {why}must be {type_name(annotation)}")


def _meant(config: type, where: str, name: str, given: Mapping[str, Any]) -> str:
    """The parameter that a wrong name is close to: the one of that name in a nested dataclass or a mapping first."""
    paths = [parameter.path for parameter in parameters(config)]
    paths += [f"{key}.{inner}" for key, value in given.items() if isinstance(value, Mapping) for inner in value]
    same = [path for path in paths if "." in path and path.rpartition(".")[2] == name]
    if same:
        return f" (did you mean {_path(where, same[0])}?)"
    return did_you_mean(name, parameter_names(config)) or did_you_mean(name, paths)


def _default(field: Field[Any], base: Any) -> Any:
    """What a field has that is not given; MISSING where it must be."""
    if base is not None:
        return getattr(base, field.name)
    return field.default if field.default_factory is MISSING else field.default_factory()


def _owner(config: type) -> str:
    return f"{config.__module__}.{config.__qualname__}".removesuffix(".Config")


def _path(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name
