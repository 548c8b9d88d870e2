"""DDS by Cyclone: topics of ROS 2 as messages in and messages out. The only file that imports cyclonedds.

ROS 2 gives a topic `/camera/image_raw` the name `rt/camera/image_raw` in DDS and a type `sensor_msgs/msg/Image` the
name `sensor_msgs::msg::dds_::Image_`. What is written and taken are bytes of our own CDR (cdr.py): Cyclone's Python
serializer needs 0.2 to 0.4 s for an image. The types are declared to it field by field all the same, because newer
programs of ROS 2 compare them when they meet.
"""

from __future__ import annotations

import os
import socket
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar
from weakref import WeakValueDictionary

from cyclonedds._clayer import ddspy_take, ddspy_write
from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from nodes.ros2.cdr import Nested, NestedSequence, Number, Numbers, Text, decode, encode, kinds
from nodes.ros2.connection import LOOPBACK, Connection, Quality
from nodes.ros2.messages import Message

T = TypeVar("T", bound=Message)
_BLOCKED = 100  # ms that a writer waits for a slow reader before it goes on without it
_EVERYTHING = SampleState.Any | ViewState.Any | InstanceState.Any
_TAKEN = 64  # samples at once
_IDL = {
    "?": bool, "u1": types.uint8, "i4": types.int32, "u4": types.uint32, "f8": types.float64,
}  # fmt: skip


class DdsError(RuntimeError):
    """DDS cannot do it; the message says what to change."""


class Participant:
    """One of a domain's. Raises DdsError where the interface is none, or nothing can keep DDS on this machine."""

    def __init__(self, connection: Connection) -> None:
        self._domain = _Domain.of(connection)
        self._entity = DomainParticipant(connection.number)
        self._domain.confine()

    def writer(self, topic: str, message_type: type[T], quality: Quality) -> Writer[T]:
        """topic: its full name in ROS, with its first /."""
        dds = Topic(self._entity, f"rt{topic}", _idl(message_type))
        return Writer(self, DataWriter(self._entity, dds, qos=_qos(quality)))

    def reader(self, topic: str, message_type: type[T], quality: Quality) -> Reader[T]:
        """topic: its full name in ROS, with its first /."""
        dds = Topic(self._entity, f"rt{topic}", _idl(message_type))
        return Reader(self, DataReader(self._entity, dds, qos=_qos(quality)), message_type)


class Writer(Generic[T]):
    def __init__(self, participant: Participant, entity: Any) -> None:
        self._participant = participant  # which lives as long
        self._entity = entity

    @property
    def readers(self) -> int:
        return len(self._entity.get_matched_subscriptions())

    def write(self, message: T) -> bool:
        """False where a reliable reader was too slow to take it. Raises DdsError."""
        data = encode(message)
        code = ddspy_write(self._entity._ref, data + bytes(-len(data) % 4))
        if code == DDSException.DDS_RETCODE_TIMEOUT:
            return False
        if code < 0:
            raise DdsError(f"a {message.ros} could not be written: {DDSException(code)}")
        return True


class Reader(Generic[T]):
    def __init__(self, participant: Participant, entity: Any, message_type: type[T]) -> None:
        self._participant = participant  # which lives as long
        self._entity = entity
        self.type = message_type
        self._condition = ReadCondition(entity, _EVERYTHING)
        self._waiting = WaitSet(entity.participant)
        self._waiting.attach(self._condition)

    @property
    def writers(self) -> int:
        return len(self._entity.get_matched_publications())

    def wait(self, seconds: float) -> None:
        """Until something came, so many seconds at most."""
        self._waiting.wait(duration(seconds=seconds))

    def take(self) -> list[bytes]:
        """All that came since, in order; `decode` reads one."""
        taken: list[bytes] = []
        while True:
            found = ddspy_take(self._entity._ref, _EVERYTHING, _TAKEN)
            if isinstance(found, int):
                raise DdsError(f"nothing can be read: {DDSException(found)}")
            taken += [data for data, info in found if info.valid_data]
            if len(found) < _TAKEN:
                return taken

    def decode(self, data: bytes) -> T:
        """Raises CdrError."""
        return decode(self.type, data)


class _Domain:
    """A domain as this process takes part in it: once, on one interface."""

    _known: ClassVar[WeakValueDictionary[int, _Domain]] = WeakValueDictionary()

    def __init__(self, connection: Connection) -> None:
        self._interface = connection.interface
        self._before = _sockets()
        try:
            self._entity = Domain(connection.number, connection.xml)
        except DDSException as error:
            raise DdsError(
                f"DDS cannot use interface={connection.interface} (domain {connection.number}): is it the name or the "
                f"address of one that is up (ip addr)? {error}"
            ) from error
        self.confine()

    @classmethod
    def of(cls, connection: Connection) -> _Domain:
        known = cls._known.get(connection.number)
        if known is None:
            known = cls._known[connection.number] = cls(connection)
        elif known._interface != connection.interface:
            raise DdsError(
                f"this process is in domain {connection.number} on interface={known._interface} already, "
                f"it cannot be there on {connection.interface} too"
            )
        return known

    def confine(self) -> None:
        """Cyclone sends on the interface that it is told, but binds to all: on loopback, the kernel is told as well."""
        if self._interface == LOOPBACK:
            for descriptor in _sockets() - self._before:
                _bind_to_loopback(descriptor)


def _sockets() -> set[int]:
    """Open file descriptors that are sockets. Raises DdsError where the system does not tell."""
    found = set()
    try:
        links = list(Path("/proc/self/fd").iterdir())
    except OSError as error:
        raise DdsError(f"interface={LOOPBACK} needs Linux, which lists a process's sockets: {error}") from error
    for link in links:
        try:
            if str(link.readlink()).startswith("socket:"):
                found.add(int(link.name))
        except OSError:  # closed meanwhile
            continue
    return found


def _bind_to_loopback(descriptor: int) -> None:
    """Nothing that came in by another interface reaches the socket any more."""
    with socket.socket(fileno=os.dup(descriptor)) as own:
        if own.family not in (socket.AF_INET, socket.AF_INET6) or own.type != socket.SOCK_DGRAM:
            return
        try:
            own.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, LOOPBACK.encode())
        except OSError as error:
            raise DdsError(
                f"DDS cannot be kept on this machine ({error}): interface=auto, or an interface's name, lets it listen"
            ) from error


def _qos(quality: Quality) -> Any:
    reliable = Policy.Reliability.Reliable(duration(milliseconds=_BLOCKED))
    return Qos(
        reliable if quality.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if quality.transient_local else Policy.Durability.Volatile,
        Policy.History.KeepLast(quality.depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


@cache
def _idl(message_type: type) -> Any:
    """The type as Cyclone declares it to others; it never serializes with it."""
    package, kind, name = message_type.ros.split("/")  # type: ignore[attr-defined]
    members = {member: _idl_member(of) for member, of in kinds(message_type)}
    return make_idl_struct(f"{name}_", f"{package}::{kind}::dds_::{name}_", members)


def _idl_member(kind: Any) -> Any:
    match kind:
        case Number(code):
            return _IDL[code]
        case Numbers(code, None):
            return types.sequence[_IDL[code]]
        case Numbers(code, count):
            return types.array[_IDL[code], count]
        case Text():
            return str
        case Nested(of):
            return _idl(of)
        case NestedSequence(of):
            return types.sequence[_idl(of)]
    raise TypeError(kind)
