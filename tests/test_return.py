"""An end of a topic that is lost and comes back: what it can have lost is sent again, what begins anew is taken."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from msgs import End, Frame, Keyframe, Message, Poses
from mvsgs_core.stats import Stats
from nodes.once import Once
from nodes.runtime.addresses import PeerLost, TransportError
from nodes.runtime.inbox import Inbox
from nodes.runtime.transport import Publisher, ReliableReader, create_keys, kept
from nodes.runtime.transport.kept import Kept
from nodes.runtime.transport.live import LiveReader
from tests.support.patience import LONG, until
from tests.support.ports import free_port

AWAY = 5.0  # s
ONE = np.ones((2, 2), np.float32)


def frame(index: int) -> Frame:
    return Frame(index, index / 30, np.full((48, 64, 3), index, np.uint8), np.ones(4))


def keyframe(index: int) -> Keyframe:
    return Keyframe(index, index / 30, np.zeros((4, 4, 3), np.uint8), np.ones(4), np.eye(4), 1.0, ONE, ONE, 0)


def poses(revision: int, *index: int) -> Poses:
    return Poses(revision, np.array(index), np.tile(np.eye(4), (len(index), 1, 1)), np.ones(len(index)))


@pytest.fixture
def opened() -> Iterator[Callable]:
    """Notes what a test opens, and closes it."""
    ends: list[Publisher | ReliableReader] = []

    def note(end: Publisher | ReliableReader) -> object:
        ends.append(end)
        return end

    yield note
    for end in reversed(ends):
        end.close()


def taken(inbox: Inbox, count: int) -> list[Message]:
    found: list[Message] = []
    limit = time.monotonic() + LONG
    while len(found) < count and time.monotonic() < limit:
        received = inbox.receive(0.1)
        if received is not None:
            found.append(received[1])
    return found


def seen(publisher: Publisher, said: list[str], what: str) -> bool:
    publisher.watch()
    return any(what in text for text in said)


def ready(publisher: Publisher, inbox: Inbox) -> bool:
    """A reader that is not looked at does not subscribe again."""
    inbox.watch(0.01)
    return publisher.ready(1)


def indices(messages: list[Message]) -> list[int]:
    return [message.index for message in messages if isinstance(message, Frame)]


def test_a_reader_that_is_started_again_gets_what_it_can_have_lost_and_nobody_else_does(
    tmp_path: Path, opened: Callable
) -> None:
    address, said = f"ipc://{tmp_path}/s", list[str]()
    publisher: Publisher = opened(Publisher(address, buffer=4, away=AWAY, say=said.append))
    other: ReliableReader = opened(ReliableReader(address, Frame, buffer=64))
    mortal: ReliableReader = opened(ReliableReader(address, Frame, joins=True))
    until(lambda: publisher.ready(2))
    publisher.start()
    for n in range(6):
        publisher.send(frame(n))
    assert indices(taken(Inbox([mortal], []), 3)) == [0, 1, 2]
    mortal.close()
    until(lambda: seen(publisher, said, "was lost"))
    publisher.send(frame(6))
    again: ReliableReader = opened(ReliableReader(address, Frame, buffer=64, joins=True))
    until(lambda: seen(publisher, said, "was started again"))
    publisher.send(frame(7))
    publisher.end(End())
    assert indices(taken(Inbox([again], []), 9)) == list(range(8))
    assert not publisher.gone()
    assert indices(taken(Inbox([other], []), 9)) == list(range(8))
    assert (again.ended, other.ended) == (True, True)
    until(publisher.gone)


def test_who_stays_away_is_an_error_and_holds_the_sender_back_until_then(tmp_path: Path, opened: Callable) -> None:
    address, said = f"ipc://{tmp_path}/s", list[str]()
    publisher: Publisher = opened(Publisher(address, buffer=2, away=1.5, say=said.append))
    mortal: ReliableReader = opened(ReliableReader(address, Frame, joins=True))
    until(lambda: publisher.ready(1))
    publisher.start()
    mortal.close()
    until(lambda: seen(publisher, said, "was lost"))
    began = time.monotonic()
    publisher.send(frame(0))
    publisher.send(frame(1))
    assert time.monotonic() - began < 1.0
    with pytest.raises(PeerLost, match=r"was not back within 1\.5 s"):
        publisher.send(frame(2))
    assert time.monotonic() - began >= 1.0


def test_a_sender_that_dies_in_a_handshake_refuses_nobody_whom_it_let_in(tmp_path: Path, opened: Callable) -> None:
    port, keys, said = free_port(), create_keys(tmp_path / "keys"), list[str]()
    address = f"tcp://127.0.0.1:{port}"
    publisher: Publisher = opened(Publisher(address, keys=keys))
    reader: ReliableReader = opened(ReliableReader(address, Frame, keys=keys, away=AWAY, say=said.append))
    inbox = Inbox([reader], [])
    until(lambda: ready(publisher, inbox))
    publisher.close(farewell=False)
    with socket.create_server(("127.0.0.1", port)) as dying:
        dying.settimeout(LONG)
        for _ in range(3):  # nothing has come from there yet, as from the tracker's Trajectory until the end
            dying.accept()[0].close()
            inbox.watch(0.05)
    again: Publisher = opened(Publisher(address, keys=keys))
    until(lambda: ready(again, inbox))
    again.start()
    again.send(frame(0))
    assert indices(taken(inbox, 1)) == [0]
    assert ["was lost" in said[0], "is back" in said[1]] == [True, True]


def test_a_live_sender_that_dies_in_a_handshake_refuses_nobody_either(tmp_path: Path, opened: Callable) -> None:
    port, keys = free_port(), create_keys(tmp_path / "keys")
    address = f"tcp://127.0.0.1:{port}"
    publisher: Publisher = opened(Publisher(address, keys=keys))
    reader: LiveReader = opened(LiveReader(address, Frame, keys=keys))
    until(lambda: publisher.ready(1))
    publisher.close(farewell=False)
    with socket.create_server(("127.0.0.1", port)) as dying:
        dying.settimeout(LONG)
        for _ in range(3):  # a robot's program that was connected, and had no frame yet
            dying.accept()[0].close()
            reader.watch()
    again: Publisher = opened(Publisher(address, keys=keys))
    until(lambda: again.ready(1))
    again.send(frame(7))

    def taken_up() -> bool:
        reader.watch()
        found = reader.take()
        return isinstance(found, Frame) and found.index == 7

    until(taken_up)


def test_a_sender_that_is_started_again_begins_anew_and_keeps_the_order_of_its_topics(
    tmp_path: Path, opened: Callable
) -> None:
    addresses = f"ipc://{tmp_path}/k", f"ipc://{tmp_path}/p"
    readers = [
        opened(ReliableReader(address, kind, topic=f"tracker.{kind.__name__}", away=AWAY))
        for address, kind in zip(addresses, (Keyframe, Poses), strict=True)
    ]
    inbox = Inbox(readers, [])

    def start(begun: int) -> tuple[Publisher, Publisher]:
        ends = opened(Publisher(addresses[0], begun=begun)), opened(Publisher(addresses[1], begun=begun))
        for end in ends:
            until(lambda: ready(end, inbox))  # noqa: B023
            end.start()
        return ends

    keyframes, corrections = start(1)
    for n in range(4):
        corrections.send(poses(n + 1, n), {"Keyframe": n})
        keyframes.send(keyframe(n), {"Poses": n + 1})
    first = taken(inbox, 7)
    keyframes.close()
    corrections.close()
    time.sleep(0.8)  # longer than a lost sender without a return is given
    keyframes, corrections = start(2)
    keyframes.send(keyframe(3), {"Poses": 1})
    corrections.send(poses(4, 3))
    keyframes.send(keyframe(4), {"Poses": 1})
    second = taken(inbox, 4)
    order = [(type(message).__name__, getattr(message, "index", None)) for message in (*first, *second)]
    assert [kind for kind, _ in order] == ["Poses", "Keyframe"] * 4 + ["Poses", "Keyframe", "Keyframe"]
    assert [reader.begun for reader in readers] == [2, 2]


def test_a_topic_that_was_silent_between_two_restarts_holds_no_other_one_up(tmp_path: Path, opened: Callable) -> None:
    addresses = f"ipc://{tmp_path}/k", f"ipc://{tmp_path}/p"
    readers = [
        opened(ReliableReader(address, kind, topic=f"tracker.{kind.__name__}", away=AWAY))
        for address, kind in zip(addresses, (Keyframe, Poses), strict=True)
    ]
    inbox, found = Inbox(readers, []), list[Message]()
    for begun in (1, 2, 3):
        keyframes, corrections = (opened(Publisher(address, begun=begun)) for address in addresses)
        for end in (keyframes, corrections):
            until(lambda end=end: ready(end, inbox))
            end.start()
        keyframes.send(keyframe(begun))
        if begun == 3:
            corrections.send(poses(1, 3), {"Keyframe": 1})
            keyframes.send(keyframe(4), {"Poses": 1})
        found += taken(inbox, 3 if begun == 3 else 1)
        keyframes.close(farewell=False)
        corrections.close(farewell=False)
    assert [getattr(message, "index", None) for message in found if isinstance(message, Keyframe)] == [1, 2, 3, 4]
    assert [type(message).__name__ for message in found][-3:] == ["Keyframe", "Poses", "Keyframe"]


def test_a_sender_that_counts_anew_and_is_no_other_process_has_lost_messages(tmp_path: Path, opened: Callable) -> None:
    address = f"ipc://{tmp_path}/s"
    reader: ReliableReader = opened(ReliableReader(address, Frame, away=AWAY))
    inbox = Inbox([reader], [])
    publisher: Publisher = opened(Publisher(address, begun=7))
    until(lambda: ready(publisher, inbox))
    publisher.send(frame(0))
    publisher.send(frame(1))
    assert indices(taken(inbox, 2)) == [0, 1]
    publisher.sent = 0
    publisher.send(frame(2))
    with pytest.raises(TransportError, match="message 0 came where 2 was due"):
        taken(inbox, 1)


def test_what_came_already_is_told_and_so_is_what_never_came() -> None:
    once = Once(Stats())
    assert [once.keyframe(keyframe(n)) for n in (0, 5, 5, 7)] == [True, True, False, True]
    assert [once.poses(p) for p in (poses(1, 0, 5), poses(2, 7, 8), poses(1, 0, 5))] == [True, True, False]
    once.report_missing()
    assert once.stats.skipped == {
        "keyframes that came again": 1, "corrections that came again": 1, "keyframes that never came": 1,
    }  # fmt: skip
    assert "such as 8" in once.stats.warnings[0]


def test_as_much_is_kept_as_can_be_on_the_way_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "ON_THE_WAY", 1000)
    monkeypatch.setattr(kept, "MAX_BYTES", 5000)
    for size, left in ((10, 100), (100, 28), (1000, 5)):
        ring = Kept(4)
        for n in range(200):
            ring.add(memoryview(b"R" + bytes([n]) * (size - 1)))
        assert len(ring) == left
        assert [frame[:2] for frame in ring] == [b"A" + bytes([n]) for n in range(200 - left, 200)]
