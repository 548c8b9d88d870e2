"""How a run ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

DONE = 0
FAILED = 1  # a stage that makes the map
REFUSED = 2  # before anything started
NOTHING = 3  # no map, or no pose at all
OBSERVER_FAILED = 4  # the map is finished, but who only watched is not
BY_SIGNAL = 128  # plus its number: 130 Ctrl-C, 143 SIGTERM


@dataclass(frozen=True)
class Failure:
    """What befell a node."""

    node: str
    error: str  # one line
    traceback: str = ""
    log: Path | None = None


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    code: int = DONE  # for the shell
    reason: str = ""  # why it did not reach its end, as a sentence without a full stop; empty: it did
    failed: Failure | None = None  # the stage that ended it
    observers: tuple[Failure, ...] = ()  # who failed alone
    nothing: Mapping[str, str] = field(default_factory=dict)  # reasons by node for an empty result, in graph order
    cut_off: Mapping[str, str] = field(default_factory=dict)  # what Ctrl-C left of a source's stream, by node
    unseen: tuple[str, ...] = ()  # external stages that may still work: all others reached their end

    @property
    def whole(self) -> bool:
        """Whether every stage reached its end."""
        return not self.reason


def finished(
    observers: tuple[Failure, ...], nothing: Mapping[str, str], cut_off: Mapping[str, str] | None = None
) -> Outcome:
    """Of a run whose stages all reached their end."""
    code = NOTHING if nothing else OBSERVER_FAILED if observers else DONE
    return Outcome(code, observers=observers, nothing=nothing, cut_off=cut_off or {})
