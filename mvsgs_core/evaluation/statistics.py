"""What the nodes of a run counted, timed, skipped and warned of, as the report shows it.

It came over the wire, perhaps from a node that somebody else wrote: what has not the form that it should have is left
out, or shown as the text that it is, and never ends the report.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


def collected(stats: Mapping[str, Any]) -> dict[str, Any]:
    """Parts of the report, from the statistics of each node by name; "nothing" where a node had nothing to show,
    "cut_off" where Ctrl-C ended a source's stream. Of a resumed run, "notes" and "time" say that nobody knows how long
    it took."""
    nodes = {str(name): s for name, s in stats.items() if isinstance(s, Mapping)}
    cpu = {name: _number(s.get("cpu_seconds")) for name, s in nodes.items()}
    peak = {name: _number(s.get("peak_bytes")) for name, s in nodes.items()}
    reasons = {key: _said(nodes, key) for key in ("cut_off", "nothing")}
    latency = {name: waited for name, s in nodes.items() if (waited := _latencies(_mapping(s.get("values"))))}
    resumed = ", ".join(_said(nodes, "resumed"))
    note = (
        "the run was resumed: how long it took is not known, nor its keyframes per second; seconds of its "
        f"{resumed} are of all its parts, those of other stages of the last one"
    )
    return {
        "time": {
            "stages": {name: _numbers(s.get("seconds")) for name, s in nodes.items()},
            "cpu": {name: seconds for name, seconds in cpu.items() if seconds is not None},
            **({"wall": None, "keyframes_per_second": None} if resumed else {}),
        },
        "memory": {"peak_bytes": {name: size for name, size in peak.items() if size is not None}},
        "skipped": {name: found for name, s in nodes.items() if (found := _skipped(s))},
        "counts": {name: found for name, s in nodes.items() if (found := _numbers(s.get("counts")))},
        "warnings": {name: texts for name, s in nodes.items() if (texts := _texts(s.get("warnings")))},
        **({"latency": latency} if latency else {}),
        **({"notes": [note]} if resumed else {}),
        **{key: by_node for key, by_node in reasons.items() if by_node},
    }


def _said(nodes: Mapping[str, Mapping[Any, Any]], key: str) -> dict[str, str]:
    """Text by node, of those that have one."""
    texts = {name: _mapping(s.get("values")).get(key) for name, s in nodes.items()}
    return {name: str(text) for name, text in texts.items() if text}


def _skipped(stats: Mapping[Any, Any]) -> dict[str, float]:
    """Work that was spared, and messages that a newer one overtook."""
    overtaken = {topic: count for topic, count in _numbers(stats.get("best_effort_skipped")).items() if count}
    return _numbers(stats.get("skipped")) | {f"overtaken by a newer {topic}": n for topic, n in overtaken.items()}


def _latencies(values: Mapping[Any, Any]) -> dict[str, dict[str, float]]:
    """Of a live stream, by what was waited for: median, p99 in seconds, count."""
    return {str(what): _numbers(figures) for what, figures in _mapping(values.get("latency")).items()}


def _mapping(value: Any) -> Mapping[Any, Any]:
    return value if isinstance(value, Mapping) else {}


def _number(value: Any) -> float | None:
    real = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return value if real else None


def _numbers(value: Any) -> dict[str, float]:
    pairs = ((str(key), _number(item)) for key, item in _mapping(value).items())
    return {key: number for key, number in pairs if number is not None}


def _texts(value: Any) -> list[str]:
    """A text is one text, not its characters."""
    if not value:
        return []
    return [str(item) for item in value] if isinstance(value, list | tuple) else [str(value)]
