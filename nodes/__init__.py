"""The contract of a node: a function from messages to messages.

    class Strided(Node):
        @dataclass
        class Config:
            stride: int = 10  # frames

        def on_frame(self, frame: Frame) -> Iterator[Keyframe]:
            ...
            yield Keyframe(...)

The parameter's type declares the input, the yielded type the output. Hooks:

- `on_<anything>(self, message: T) -> Iterator[U | V]`: one per input type; of a union those that `reads` names.
- `run(self) -> Iterator[U]`: a source instead has this.
- `on_idle(self) -> list[U] | None`: one slice (well under 100 ms) of background work while no message waits;
  None when there is nothing to do now: it is asked again after the next message, or a quarter of a second.
- `on_end(self) -> Iterator[U]`: every input has ended.
- `on_abort(self, reason)`: the run ends early for this node, by SIGTERM, a second SIGINT where it was started by hand,
  a lost neighbor or an exception of its own: save what must not be lost, within 3 s, or be killed. Called once, between
  two hooks, at a `yield` of one or in a call of `self.rest()`, which a hook that works for long makes where nothing is
  half changed (after an exception, where that left the node); nothing can be sent any more.
- `check(cls, config)`: before any process starts, on the launcher's machine: raises OSError or ValueError, saying what
  to do, where it is plain that the node cannot run (its file is missing, or cannot be read). A source opens its input
  and reads one frame of it, no more: quick, and nothing is written or sent.
- `advise(cls, config)`: before that, and as quick: the choices of other slots that its input asks for, taken where
  nobody chose.

Arrays of a message that came from another process are read-only, and those over 4 kB are views that keep its whole
frame in memory: copy what you change, and what you keep of it.

A node imports no socket and knows no topic: it is tested as `list(Tracker(config).on_frame(frame))`.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, ClassVar

import msgs
from mvsgs_core.stats import Stats
from nodes.parameters import Parameter


@dataclass(frozen=True)
class Advice:
    """A choice of another slot."""

    choice: str
    why: str  # what was measured, and how to choose otherwise
    parameters: Mapping[str, Any] = field(default_factory=dict)  # of that choice


class Node:
    """Base of all nodes. `Config` is the node's parameters with their defaults; a launch file sets them."""

    @dataclass
    class Config:
        pass

    replayable: ClassVar[bool] = False  # sources: the same command gives the same stream once more
    live: ClassVar[bool] = False  # sources: a camera that waits for nobody
    # a process of it that is started again in the midst of a run goes on: it needs the newest messages, and what the
    # one before left in `kept_in`
    restartable: ClassVar[bool] = False
    missed_kept: ClassVar[int] = 0  # messages that a newer one overtook, see `missed`
    reports: ClassVar[bool] = False  # writes report.json at the end: without it a run is not finished
    in_stream_order: ClassVar[bool] = True  # keyframes leave in the order of their indices, which resuming relies on

    config: Any

    def __init__(self, config: Any = None) -> None:
        self.config = self.Config() if config is None else config
        self.stats = Stats()
        self.upstream: dict[str, Any] = {}  # what each node upstream counted, by name: complete when on_end runs
        self.unread: frozenset[type] = frozenset()  # messages that nobody reads here: work for them alone can be spared
        self.rest: Callable[[], object] = _go_on  # to be called in long work where nothing is half changed, see above
        self.kept_in: Path | None = None  # folder for what a process started in this one's place needs; None: none is
        self.waiting: Callable[[type], int] = _none  # messages of a type that came and were not taken up, about
        # of a type of which only the newest is taken up: those that the last one overtook, oldest first, as far as kept
        self.missed: Callable[[type], list[Any]] = _no_messages

    @classmethod
    def check(cls, config: Any) -> None:
        """Nothing to check."""

    @classmethod
    def advise(cls, config: Any) -> Mapping[str, Advice]:
        """By slot: nothing. Raises OSError or ValueError where the input cannot be read, as `check` will."""
        return {}

    @classmethod
    def keys_of(cls, config: Any) -> Mapping[str, Sequence[Parameter]]:
        """Of a parameter that is a mapping: the keys that it takes, with their defaults. Others take any."""
        return {}

    @classmethod
    def unused_inputs(cls, config: Any) -> frozenset[type]:
        """Of the messages that `reads` names, those that the node makes nothing of with these parameters."""
        return frozenset()

    def run(self) -> Iterator[Any]:
        """Sources only: yields messages until the stream ends; frames are numbered upward."""
        raise TypeError(f"{type(self).__name__} is no source: it has no run()")

    def on_idle(self) -> list[Any] | None:
        return None

    def on_end(self) -> Iterator[Any]:
        yield from ()

    def on_abort(self, reason: str) -> None:
        """Nothing to save."""


def _go_on() -> None:
    """Nobody asks a node to stop that runs in no process of its own."""


def _none(kind: type) -> int:
    """Nothing waits for a node that runs in no process of its own."""
    return 0


def _no_messages(kind: type) -> list[Any]:
    """Nothing overtakes what is given to a node that runs in no process of its own."""
    return []


_OUTPUT_HOOKS: tuple[str, ...] = ("run", "on_idle", "on_end")
_NO_HANDLERS = (*_OUTPUT_HOOKS, "on_abort")


def is_source(node: type[Node]) -> bool:
    return node.run is not Node.run


def handlers(node: type[Node]) -> dict[type, str]:
    """Input message type -> name of the method that takes it. Raises TypeError where an annotation is missing."""
    found: dict[type, str] = {}
    for name in dir(node):
        if not name.startswith("on_") or name in _NO_HANDLERS or not callable(getattr(node, name)):
            continue
        hints = _hints(node, name)
        parameters = [t for key, t in hints.items() if key != "return"]
        kinds = _alternatives(parameters[0]) if len(parameters) == 1 else ()
        if not kinds or not set(kinds) <= set(msgs.TYPES.values()):
            raise TypeError(f"{node.__qualname__}.{name} must take one message, annotated with its type from msgs")
        for kind in kinds:
            if kind in found:
                raise TypeError(f"{node.__qualname__}: {found[kind]} and {name} take the same type")
            found[kind] = name
    return found


def free_inputs(node: type[Node]) -> set[type]:
    """Inputs of hooks that take several types, as `Frame | Keyframe` or `Message`: those come that `reads` names."""
    names = list(handlers(node).values())
    return {kind for kind, name in handlers(node).items() if names.count(name) > 1}


def outputs(node: type[Node]) -> tuple[type, ...]:
    """Message types that a node yields, from the return annotations of its hooks."""
    found: dict[type, None] = {}
    for name in (*handlers(node).values(), *_OUTPUT_HOOKS):
        if getattr(node, name) is getattr(Node, name, None):
            continue
        returned = _hints(node, name).get("return")
        if returned is None:
            raise TypeError(f"{node.__qualname__}.{name} must say what it yields: -> Iterator[Keyframe]")
        for alone in set(_alternatives(returned)) & set(msgs.TYPES.values()):
            raise TypeError(
                f"{node.__qualname__}.{name} must yield its messages, not return one: -> Iterator[{alone.__name__}]"
            )
        for t in _message_types(returned):
            found[t] = None
    return tuple(found)


def _alternatives(annotation: Any) -> tuple[type, ...]:
    union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    return typing.get_args(annotation) if union else (annotation,)


def _hints(node: type[Node], name: str) -> dict[str, Any]:
    try:
        return typing.get_type_hints(getattr(node, name))
    except NameError as error:
        raise TypeError(f"{node.__qualname__}.{name}: {error}; import message types at module level") from error


def _message_types(annotation: Any) -> Iterator[type]:
    if isinstance(annotation, type) and is_dataclass(annotation):
        if annotation in msgs.TYPES.values():
            yield annotation
        return
    if typing.get_origin(annotation) in (typing.Union, types.UnionType) or typing.get_args(annotation):
        for part in typing.get_args(annotation):
            yield from _message_types(part)


__all__ = ["Advice", "Node", "free_inputs", "handlers", "is_source", "outputs"]
