"""Plain values, as they come from a launch file or JSON, into a node's `Config`."""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from nodes import Node


def make_config(node: type[Node], given: Mapping[str, Any]) -> Any:
    """`node.Config` with these parameters, defaults for the others.

    Raises TypeError, naming the parameter and what is valid, for an unknown or missing one or a wrong type.
    """
    return _build(node.Config, given, node.__qualname__)


def _build(config: type, given: Mapping[str, Any], where: str) -> Any:
    hints = typing.get_type_hints(config)
    declared = {field.name: field for field in fields(config) if field.init}
    unknown = [name for name in given if name not in declared]
    missing = [
        name
        for name, field in declared.items()
        if name not in given and field.default is MISSING and field.default_factory is MISSING
    ]
    if unknown or missing:
        problem = f"has no parameter {', '.join(unknown)}" if unknown else f"needs {', '.join(missing)}"
        raise TypeError(f"{where} {problem}; its parameters are: {', '.join(declared) or 'none'}")
    return config(**{name: _convert(value, hints[name], f"{where}.{name}") for name, value in given.items()})


def _convert(value: Any, annotation: Any, where: str) -> Any:
    """The value as an instance of the annotated type: nested dataclasses, enums, paths and tuples are built."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation is Any or (annotation is type(None) and value is None):
        return value
    if origin is typing.Annotated:
        return _convert(value, arguments[0], where)
    if origin in (typing.Union, types.UnionType):
        exact = sorted(arguments, key=lambda member: type(value) is not member)  # int | float keeps 3 an int
        for member in exact:
            try:
                return _convert(value, member, where)
            except TypeError:
                continue
    elif origin is typing.Literal:
        if value in arguments:
            return value
    elif is_dataclass(annotation):
        if isinstance(value, Mapping):
            return _build(typing.cast(type, annotation), value, where)
    elif (origin or annotation) in (tuple, list) and isinstance(value, list | tuple):
        return _sequence(value, origin or annotation, arguments, where)
    elif isinstance(origin or annotation, type) and issubclass(origin or annotation, Mapping):
        if isinstance(value, Mapping):
            of = arguments[1] if arguments else Any
            return {key: _convert(item, of, f"{where}.{key}") for key, item in value.items()}
    elif isinstance(annotation, type):
        return _scalar(value, annotation, where)
    raise TypeError(f"{where}={value!r}: must be {annotation}")


def _sequence(value: Any, kind: type, arguments: tuple[Any, ...], where: str) -> Any:
    if kind is tuple and arguments and arguments[-1] is not Ellipsis:
        if len(value) != len(arguments):
            raise TypeError(f"{where}={value!r}: must have {len(arguments)} entries")
        return tuple(_convert(item, of, f"{where}[{i}]") for i, (item, of) in enumerate(zip(value, arguments)))
    of = arguments[0] if arguments else Any
    return kind(_convert(item, of, f"{where}[{i}]") for i, item in enumerate(value))


def _scalar(value: Any, kind: type, where: str) -> Any:
    if issubclass(kind, Enum) and value in kind.__members__:
        return kind[value]
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if isinstance(value, kind) and not (isinstance(value, bool) and kind is not bool):
        return value
    raise TypeError(f"{where}={value!r}: must be {kind.__name__}")
