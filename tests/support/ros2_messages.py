"""Messages of ROS 2 with a value of its own in every field."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from nodes.ros2 import messages
from nodes.ros2.cdr import Nested, NestedSequence, Number, Numbers, Text, kinds

TYPES = sorted((t for t in vars(messages).values() if dataclasses.is_dataclass(t)), key=lambda t: t.ros)


def example(message_type: type, rng: np.random.Generator, many: int = 3) -> Any:
    """A message with a value of its own in every field."""
    values: dict[str, Any] = {}
    for name, kind in kinds(message_type):
        match kind:
            case Number(code):
                values[name] = number(code, rng)
            case Numbers(code, count):
                values[name] = np.array([number(code, rng) for _ in range(many if count is None else count)], code)
            case Text():
                values[name] = "".join(chr(rng.integers(97, 123)) for _ in range(rng.integers(0, 9))) + "é"
            case Nested(of):
                values[name] = example(of, rng, many)
            case NestedSequence(of):
                values[name] = [example(of, rng, many) for _ in range(many)]
    return message_type(**values)


def number(code: str, rng: np.random.Generator) -> Any:
    if code == "?":
        return bool(rng.integers(2))
    if code[0] == "f":
        return float(rng.normal())
    info = np.iinfo(code)
    return int(rng.integers(info.min, info.max, endpoint=True, dtype=code))


def plain(message: Any) -> Any:
    """What a message holds, to compare."""
    if dataclasses.is_dataclass(message):
        return {field.name: plain(getattr(message, field.name)) for field in dataclasses.fields(message)}
    if isinstance(message, np.ndarray | list):
        return [plain(each) for each in message]
    return message.item() if isinstance(message, np.generic) else message
