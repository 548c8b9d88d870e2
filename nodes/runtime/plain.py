"""Statistics as a message can carry them, whatever a node keeps: a figure too many must not cost a whole run."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from typing import Any

import numpy as np

from msgs.statistics import MAX_DEPTH, MAX_ENTRIES, MAX_ITEMS, fits

MAX_CHARACTERS = 10_000  # of a text: 60 kB at most where each takes an escape, below the codec's limit
MAX_KEY = 200  # characters
SHORTENED = "some figures were left out or cut: those of the whole graph did not fit into a message"
# characters of a text and entries of a list or map, tried in turn until all figures fit: the longest texts go first
_STEPS = ((1000, MAX_ITEMS), (200, MAX_ITEMS), (100, MAX_ITEMS), (100, 500), (100, 50), (50, 10), (20, 1))


def plain(value: Any, depth: int = MAX_DEPTH - 2) -> Any:
    """Dicts with string keys, lists, numbers, strings, booleans and None, within the codec's limits for one value.

    What does not fit them is replaced by a text that says so.
    """
    return _plain(value, depth, [MAX_ENTRIES])


def _plain(value: Any, depth: int, room: list[int]) -> Any:
    """`room`: one number, the entries that the whole value may still have."""
    if isinstance(value, np.ndarray) and value.size > MAX_ITEMS:
        return f"({value.size} entries left out)"
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if value is None or isinstance(value, bool | float):
        return value
    if isinstance(value, int):
        if abs(value) < 2**63:
            return int(value)
        return float(value) if abs(value) < 2**1023 else f"(an integer of {value.bit_length()} bits)"
    if isinstance(value, Mapping | list | tuple | set | frozenset):
        if depth == 0 or len(value) > min(MAX_ITEMS, room[0]):
            return f"({len(value)} entries left out)"
        room[0] -= len(value)
        if isinstance(value, Mapping):
            return {_text(key, MAX_KEY): _plain(item, depth - 1, room) for key, item in value.items()}
        return [_plain(item, depth - 1, room) for item in value]
    return _text(value, MAX_CHARACTERS)


def plain_section(figures: Mapping[str, Any] | list[Any]) -> Any:
    """As `plain`, but a map stays a map and a list a list however long it is: those who read a report count on it."""
    if isinstance(figures, Mapping):
        return plain(dict(islice(figures.items(), MAX_ITEMS)))
    return plain(figures[:MAX_ITEMS])


def fitted(stats: dict[str, Any], limit: int) -> dict[str, Any]:
    """Plain statistics by node name in at most `limit` bytes, as a message has them.

    Where they take more, the longest texts are cut first, then the ends of long lists and maps; who lost something
    says so in its warnings.
    """
    if fits(stats, limit):
        return stats
    for characters, entries in _STEPS:
        short = {name: _noted(own, _cut(own, characters, entries)) for name, own in stats.items()}
        if fits(short, limit):
            return short
    return {}


def _noted(before: Any, after: Any) -> Any:
    if after != before and isinstance(after, dict) and isinstance(after.get("warnings"), list):
        after["warnings"].append(SHORTENED)
    return after


def _cut(value: Any, characters: int, entries: int) -> Any:
    if isinstance(value, str):
        return _text(value, characters)
    if isinstance(value, dict):
        return {_text(key, characters): _cut(item, characters, entries) for key, item in islice(value.items(), entries)}
    if isinstance(value, list):
        return [_cut(item, characters, entries) for item in value[:entries]]
    return value


def _text(value: Any, characters: int) -> str:
    text = value if type(value) is str else str(value)
    if len(text) > characters:
        text = text[: characters - 3] + "..."
    return text.encode(errors="backslashreplace").decode()  # a lone surrogate has no bytes


__all__ = ["fitted", "plain", "plain_section"]
