"""An example of every message."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

import msgs
from msgs import Message
from msgs.codec import ArraySpec, array_specs

MESSAGES = list(msgs.TYPES.values())


def example(message_type: type, seed: int = 0, absent: bool = False) -> Message:
    """A message of that type with random content; `absent` leaves out what may be None."""
    rng = np.random.default_rng(seed)
    sizes = {name: int(rng.integers(1, 9)) for name in "HWhwKNB"}
    values: dict[str, Any] = {}
    for name, spec in array_specs(message_type).items():
        if isinstance(spec, ArraySpec):
            shape = [dim if isinstance(dim, int) else sizes[dim] for dim in spec.dims]
            values[name] = None if absent and spec.optional else (rng.random(shape) * 2).astype(spec.dtype)
        else:
            values[name] = {int: 7, float: 0.25, str: "exact", bool: True}.get(spec, {"a": {"b": [1, 2.5, None, "c"]}})
    return message_type(**values)


def assert_equal(a: Message, b: Message) -> None:
    assert type(a) is type(b)
    for field in fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            assert (x.dtype, x.shape) == (y.dtype, y.shape)
            np.testing.assert_array_equal(x, y)
        else:
            assert x == y
            assert isinstance(y, type(x))
