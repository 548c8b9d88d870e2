"""Requests from outside and their way: from the slot that asks back to the sources, and with the stream to who replies.

Messages flow one way, and nobody waits for a request: so this one edge may go against them. A source sends a request on
in its place among the frames, each stage does its part and passes it on, and the last one's Reply reaches who asked.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from msgs import Reply, Request

MESSAGES = frozenset({Request, Reply})  # whose edges are there only where a slot asks


def asker(
    reads: Mapping[str, Mapping[type, str]], sends: Mapping[str, Collection[type]]
) -> tuple[str | None, list[str]]:
    """The slot that asks, if any, and warnings. reads: message type -> sending slot, by slot; sends: message types.

    A slot that reads replies asks. None, too, where a stage on the way passes no requests on, which is warned of.
    """
    for name, inputs in reads.items():
        if Reply in inputs:
            broken = _broken(reads, sends, name)
            return (None, [f"{name} offers no services: {broken}"]) if broken else (name, [])
    return None, []


def _broken(reads: Mapping[str, Mapping[type, str]], sends: Mapping[str, Collection[type]], asking: str) -> str:
    """Why no request comes through to who replies; empty where all do."""
    slot = reads[asking][Reply]
    message: type = Reply
    passed: set[str] = set()
    while slot not in passed:
        passed.add(slot)
        if message not in sends.get(slot, ()):
            return f"{slot} {'is off' if slot not in sends else f'sends no {message.__name__}'}"
        if not reads[slot]:  # a source
            return ""
        if Request not in reads[slot]:
            return f"{slot} reads no Request"
        slot, message = reads[slot][Request], Request
    return f"{slot} reads its own requests"


__all__ = ["MESSAGES", "asker"]
