"""One node in this process: its topics opened, its hooks called as messages come, and everything closed at the end.

Life: start, wait for the readers of its topics, ask for a camera's frames, run, `on_end` once every input has ended (a
source: once `run` is exhausted, or SIGINT has come), End on each topic, wait for the goodbyes, done. A failure at any
point is reported, with its traceback unless it is of bad input, which its message explains; the node saves what it has
(`on_abort`), and the process ends with exit code 1; the neighbors notice and fail as well. SIGTERM ends it in the same
way at the next safe point, with exit code 143; so does a second SIGINT where it was started by hand, with 130.
"""

from __future__ import annotations

import gc
import logging
import queue
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import msgs
from msgs import Frame, Message
from mvsgs_core.named_modules import import_named
from nodes import Node, is_source, outputs
from nodes.parameters import build
from nodes.runtime.addresses import PeerLost, load_keys
from nodes.runtime.explained import is_explained
from nodes.runtime.freed_memory import FreedMemory
from nodes.runtime.inbox import Inbox, Reader
from nodes.runtime.requests import Requests
from nodes.runtime.runner import Runner, end_of, exit_fails, seed, stats_of
from nodes.runtime.signals import ABORT_SECONDS, Signals, Stopped, end_within
from nodes.runtime.spec import Input, Spec
from nodes.runtime.status import Status, peak_bytes
from nodes.runtime.transport import LivePublisher, NewestReader, Publisher, ReliableReader, shut_down

POLL = 0.25  # s between looks at signals and lost peers while nothing arrives
STOP_GRACE = 2.0  # s that a source's current item may take after SIGINT


def run(spec: Spec, signals: Signals) -> int:
    """Runs the node to its end; exit code."""
    process = _Process(spec, signals)
    try:
        try:
            process.run()
        except PeerLost:
            signals.check_soon()
            raise
    except Stopped as stop:
        process.abort("stopped", str(stop))
        return 128 + stop.number
    except Exception as error:
        logging.exception("failed")
        line = next(iter(str(error).splitlines()), "")
        explained = is_explained(error)
        process.abort(
            "failed",
            line if explained else f"{type(error).__name__}: {line}",
            traceback="" if explained else traceback.format_exc(),
            peer=isinstance(error, PeerLost),  # the consequence of another node's failure
        )
        return 1
    finally:
        process.close()
    return 0


def load_node(target: str) -> type[Node]:
    """The class `module.Class`. Raises TypeError if it is no node, ImportError if it does not exist."""
    module, _, name = target.rpartition(".")
    found = getattr(import_named(module), name, None) if module else None
    if not (isinstance(found, type) and issubclass(found, Node)):
        raise TypeError(f"{target} is no node (a subclass of nodes.Node); give module.Class")
    return found


def parameters(spec: Spec) -> dict[str, Any]:
    """The node's, as given; where nobody says how many threads, its kernels have all cores of this host."""
    found = dict(spec.config)
    if spec.threads is None and found.get("threads", 0) is None:
        from mvsgs_core.machine import available_cores  # loads the kernels

        found["threads"] = available_cores()
    return found


@dataclass
class _Step:
    """What the main thread is at, for whoever asks whether the work goes on."""

    number: int = 0  # of steps so far: messages, slices of background work, items of a source
    doing: str = "starting"  # working, waiting (for messages) or held back (by readers)
    topic: str | None = None  # whose readers hold it back

    def next(self, doing: str, topic: str | None = None) -> None:
        self.number += 1
        self.doing, self.topic = doing, topic


class _Process:
    def __init__(self, spec: Spec, signals: Signals) -> None:
        self._spec = spec
        self._signals = signals
        self._began = time.monotonic()
        self._step = _Step()
        self._freed = FreedMemory()
        self._runner: Runner | None = None
        self._is_source, self._missed_kept = False, 0
        self._readers: list[Reader] = []
        self._publishers: dict[str, Publisher] = {}  # by message type
        self.status = Status(spec.status_fd, self._snapshot)

    def run(self) -> None:
        self.status.set("starting")
        node_type = load_node(self._spec.target)
        self._is_source, self._missed_kept = is_source(node_type), node_type.missed_kept
        seed(self._spec.seed)
        config = build(node_type.Config, parameters(self._spec), self._spec.name)
        with exit_fails(self._spec.name):
            node = node_type(config)
        runner = self._runner = Runner(self._spec.name, node)
        runner.node.rest, runner.node.waiting, runner.node.missed = self._rest, self._waiting, self._missed
        runner.node.kept_in = self._spec.kept_in()
        read = {given.type for given in self._spec.outputs}
        runner.node.unread = frozenset(sent for sent in outputs(node_type) if sent.__name__ not in read)
        inbox = self._open()
        self.status.set("waiting")
        self._await_readers(inbox)
        inbox = self._open_frames()
        for publisher in self._publishers.values():
            publisher.start()
        self.status.set("running")
        gc.freeze()  # modules and the node stay: the collector need not walk through them again and again
        messages = self._source(runner, inbox) if self._is_source else self._answers(runner, inbox)
        for message in messages:
            self._send(message)
        self.status.set("ending")
        self._step.next("working")
        for message in runner.end():
            self._send(message)
        self._finish(runner, inbox)
        self.status.set("done")

    def _await_readers(self, inbox: Inbox) -> None:
        for given in self._spec.outputs:
            while not self._publishers[given.type].ready(given.readers):
                self._wait(inbox, self._publishers[given.type])
        began = time.monotonic()
        for given in self._spec.outputs:
            publisher, over = self._publishers[given.type], False
            while not publisher.ready(given.readers, () if over else self._spec.awaited_observers(given)):
                self._wait(inbox, publisher)
                over = 0 < given.patience < time.monotonic() - began
            missing = ", ".join(sorted(set(self._spec.awaited_observers(given)) - publisher.observers.keys()))
            if missing:
                self._say(f"{publisher.topic} begins without {missing}: not there after {given.patience:g} s")

    def _rest(self) -> None:
        """In the midst of a hook's long work."""
        self._signals.check()
        self._freed.give_back()
        self._step.next("working")

    def _waiting(self, kind: type) -> int:
        return sum(reader.waiting for reader in self._readers if reader.type_name == kind.__name__)

    def _missed(self, kind: type) -> list[Message]:
        of_kind = (r for r in self._readers if isinstance(r, NewestReader) and r.type_name == kind.__name__)
        return [message for reader in of_kind for message in reader.missed()]

    def abort(self, state: str, error: str, **details: Any) -> None:
        """Tells the launcher, then lets the node save what it has."""
        self.status.set(state, error=error, **details)
        end_within(ABORT_SECONDS)
        if self._runner is not None:
            self._runner.abort(error)
        end_within(ABORT_SECONDS)

    def close(self) -> None:
        for publisher in self._publishers.values():
            publisher.close(farewell=False)
        for reader in self._readers:
            reader.close()
        shut_down()
        self.status.close()

    def _open(self) -> Inbox:
        """Readers first: the nodes upstream wait for them, whoever waits here for others."""
        spec = self._spec
        self._read([i for i in spec.inputs if not _of_a_camera(i)])
        begun = time.time_ns() if spec.returns else 0
        for o in spec.outputs:
            topic = f"{spec.name}.{o.type}"
            options = self._shared | {"topic": topic, "held_back": partial(self._held_back, topic), "dead": spec.dead}
            if o.live:
                self._publishers[o.type] = LivePublisher(o.address, **options)
            else:
                self._publishers[o.type] = Publisher(o.address, buffer=spec.buffer, away=o.away, begun=begun, **options)
        return self._inbox()

    def _open_frames(self) -> Inbox:
        """A camera is not to begin before those who wait here for others can take its frames: the first would be lost,
        for as long as the slowest of them needs to start."""
        self._read([i for i in self._spec.inputs if _of_a_camera(i)])
        return self._inbox()

    def _inbox(self) -> Inbox:
        return Inbox([] if self._is_source else self._readers, list(self._publishers.values()))

    @cached_property
    def _shared(self) -> dict[str, Any]:
        """What all readers and publishers are given."""
        keys = None if self._spec.keys is None else load_keys(Path(self._spec.keys))
        return {"keys": keys, "token": self._spec.token, "say": self._say}

    def _read(self, inputs: Sequence[Input]) -> None:
        spec, shared = self._spec, self._shared
        observer = spec.name if spec.observer or self._is_source else None  # of requests, which may come too late
        for i in inputs:
            kind = msgs.TYPES[i.type]
            if i.best_effort:
                reader: Reader = NewestReader(
                    i.address, kind, topic=i.topic, missed_kept=self._missed_kept, observer=observer, away=i.away,
                    **shared,
                )  # fmt: skip
            else:
                reader = ReliableReader(
                    i.address, kind, topic=i.topic, buffer=spec.buffer, observer=observer, away=i.away,
                    joins=spec.returns, **shared,
                )  # fmt: skip
            self._readers.append(reader)

    def _answers(self, runner: Runner, inbox: Inbox) -> Iterator[Message]:
        """What a node makes of its inputs, and of the time when none waits."""
        idle = False  # background work is left
        while not all(reader.ended for reader in self._readers):
            self._signals.check()
            if not idle:
                self._step.next("waiting")
            received = inbox.receive(0.0 if idle else POLL)
            self._step.next("working")
            if received is not None:
                idle = True
                yield from runner.handle(received[1])
                self._freed.give_back()
            else:
                produced = runner.idle()
                idle = produced is not None
                yield from produced or ()

    def _source(self, runner: Runner, inbox: Inbox) -> Iterator[Message]:
        """A source runs in a thread: it may hang in a camera's read, and must still be stopped and watched."""
        source, requests = _Source(runner), Requests(self._readers, runner.node)
        deadline = None
        while True:
            self._signals.check()
            if deadline is None and self._signals.interrupted:
                source.stop()
                deadline = time.monotonic() + STOP_GRACE
            yield from requests.new()
            if requests.pause.waits and deadline is None:
                self._step.next("waiting")
                inbox.watch(POLL)
                continue
            try:
                message = source.take(POLL)
            except queue.Empty:
                if deadline is not None and time.monotonic() > deadline:
                    break
                inbox.watch()
                continue
            if message is None:
                if source.cut_off:
                    _say_cut_off(runner.node)
                return
            self._step.next("working")
            if not requests.pause.leaves_out(message):
                yield message
            if deadline is not None:  # to send it may have taken long, which is no fault of the read
                deadline = time.monotonic() + STOP_GRACE
        runner.node.stats.warn(f"{self._spec.name}: its last read did not return within {STOP_GRACE:g} s of Ctrl-C")
        _say_cut_off(runner.node)

    def _send(self, message: Message) -> None:
        name = type(message).__name__
        publisher = self._publishers.get(name)
        if publisher is not None:  # else nobody reads it
            publisher.send(message, {t: p.sent for t, p in self._publishers.items() if t != name and p.sent})
            self._step.next("working")

    def _finish(self, runner: Runner, inbox: Inbox) -> None:
        node = runner.node
        end = end_of(
            self._spec.name,
            node,
            wall_seconds=time.monotonic() - self._began,
            busy_seconds=runner.busy_seconds,
            cpu_seconds=time.process_time(),
            peak_bytes=peak_bytes(),
            received={reader.topic: reader.received for reader in self._readers},
            best_effort_skipped={r.topic: r.skipped for r in self._readers if isinstance(r, NewestReader)},
            sent=dict(runner.sent),
        )
        for publisher in self._publishers.values():
            publisher.end(end)
        open_topics = list(self._publishers.values())
        while open_topics := [publisher for publisher in open_topics if not publisher.gone()]:
            self._wait(inbox, open_topics[0])

    def _say(self, text: str) -> None:
        """What the transport has to tell goes where the node's own warnings go."""
        if self._runner is not None:
            self._runner.node.stats.warn(text)

    def _wait(self, inbox: Inbox, publisher: Publisher) -> None:
        """For readers of that topic, which are not there yet or have not said goodbye. Messages that wait here are none
        of its news: with them this would never rest, and take the time that others need to start."""
        self._held_back(publisher.topic)
        publisher.socket.poll(round(1000 * POLL))
        inbox.watch()
        inbox.check_peers()

    def _held_back(self, topic: str) -> None:
        self._step.topic, self._step.doing = topic, "held back"  # in this order: another thread reads them
        self._signals.check()

    def _snapshot(self) -> dict[str, Any]:
        stats = stats_of(self._runner.node.stats) if self._runner else {}
        stats.pop("seconds", None)
        return stats | {
            "progress": self._step.number,
            "doing": self._step.doing,
            "topic": self._step.topic,
            "in": {reader.topic: reader.received for reader in self._readers},
            "queue": {reader.topic: reader.waiting for reader in self._readers},
            "out": dict(self._runner.sent) if self._runner else {},
        }


def _say_cut_off(node: Node) -> None:
    """That Ctrl-C ended its stream, unless all that was expected had come: what there is of the rest is not known."""
    if node.live:  # a camera's stream has no other end
        return
    frames, expected = node.stats.counts.get("frames"), node.stats.values.get("frames_expected")
    if frames is not None and expected and frames >= expected:
        return
    come = "" if frames is None else f" after {frames:.0f}{f' of {expected}' if expected else ''} frames"
    node.stats.values["cut_off"] = f"the stream was ended by Ctrl-C{come}"
    node.stats.warn(node.stats.values["cut_off"])


def _of_a_camera(given: Input) -> bool:
    """Whether it is of frames that nobody waits for."""
    return given.best_effort and given.type == Frame.__name__


class _Source:
    """A source's `run` in a thread, one message ahead of its taker."""

    def __init__(self, runner: Runner) -> None:
        self._messages: queue.Queue[Message | None] = queue.Queue(maxsize=1)
        self._runner = runner
        self._stopping = False
        self.cut_off = False  # by `stop`, before it had come to its own end
        self._error: BaseException | None = None
        threading.Thread(target=self._run, name="source", daemon=True).start()

    def stop(self) -> None:
        """The current item is still to be taken; then the stream ends."""
        self._stopping = True

    def take(self, timeout_s: float) -> Message | None:
        """The next message, None at the end. Raises queue.Empty when none comes in time, and what `run` raised."""
        message = self._messages.get(timeout=timeout_s)
        if self._error is not None:
            raise self._error
        return message

    def _run(self) -> None:
        try:
            for message in self._runner.source():
                self._messages.put(message)
                if self._stopping:
                    self.cut_off = True
                    break
        except BaseException as error:
            self._error = error
        self._messages.put(None)


__all__ = ["load_node", "run"]
