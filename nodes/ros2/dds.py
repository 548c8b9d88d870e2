"""DDS by Cyclone: topics of ROS 2 as messages in and messages out. The only file that imports cyclonedds.

ROS 2 gives a topic `/camera/image_raw` the name `rt/camera/image_raw` in DDS and a type `sensor_msgs/msg/Image` the
name `sensor_msgs::msg::dds_::Image_`. What is written and taken are bytes of our own CDR (cdr.py): Cyclone's Python
serializer needs 0.2 to 0.4 s for an image. The types are declared to it field by field all the same, because newer
programs of ROS 2 compare them when they meet.

A service `/mvsgs/pause` is the topics `rq/mvsgs/pauseRequest` and `rr/mvsgs/pauseReply`, as rmw_cyclonedds has them.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
import struct
import time
import uuid
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar
from weakref import WeakValueDictionary

import psutil
from cyclonedds._clayer import ddspy_take, ddspy_write
from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from nodes.ros2.cdr import CdrError, Nested, NestedSequence, Number, Numbers, Text, decode, encode, kinds
from nodes.ros2.connection import ANY, DEFAULT, LOOPBACK, Connection, DdsError, Quality
from nodes.ros2.messages import Message
from nodes.ros2.services import ServiceMessage, ServiceType

T = TypeVar("T", bound=Message)
_BLOCKED = 100  # ms that a writer waits for a slow reader before it goes on without it
_EVERYTHING = SampleState.Any | ViewState.Any | InstanceState.Any
_TAKEN = 64  # samples at once
_SO_MEMINFO, _MEMINFO, _ROOM, _DROPS = 55, "9I", 1, 8  # linux/sock_diag.h; Python's socket does not name it
_NAME = 16  # bytes of a device's name
_IDL = {
    "?": bool, "u1": types.uint8, "i4": types.int32, "u4": types.uint32, "f8": types.float64,
    "i8": types.int64, "u8": types.uint64,
}  # fmt: skip


class Overrun(NamedTuple):
    """Datagrams that the kernel had no room for: each costs a best-effort reader a message, a reliable one time."""

    datagrams: int
    room: int  # bytes: the smallest limit (net.core.rmem_max) of a socket that lost some; 0: none did


class Participant:
    """One of a domain's. Raises DdsError where the interface is none, or nothing can keep DDS on this machine."""

    def __init__(self, connection: Connection) -> None:
        self._domain = _Domain.of(connection)
        self._entity = DomainParticipant(connection.number)
        self._domain.confine()

    def overrun(self) -> Overrun:
        """What this process has lost so far because it was not read in time."""
        full = [memory for memory in self._domain.memories() if memory[_DROPS]]
        return Overrun(sum(memory[_DROPS] for memory in full), min((memory[_ROOM] // 2 for memory in full), default=0))

    def writer(self, topic: str, message_type: type[T], quality: Quality) -> Writer[T]:
        """topic: its full name in ROS, with its first /."""
        dds = Topic(self._entity, f"rt{topic}", _idl(message_type))
        return Writer(self, DataWriter(self._entity, dds, qos=_qos(quality)))

    def reader(self, topic: str, message_type: type[T], quality: Quality) -> Reader[T]:
        """topic: its full name in ROS, with its first /."""
        dds = Topic(self._entity, f"rt{topic}", _idl(message_type))
        return Reader(self, DataReader(self._entity, dds, qos=_qos(quality)), message_type)

    def service(self, name: str, service_type: ServiceType) -> Service:
        """name: its full name in ROS, with its first /."""
        requests = Topic(self._entity, f"rq{name}Request", _idl(service_type.request))
        replies = Topic(self._entity, f"rr{name}Reply", _idl(service_type.response))
        both = Policy.Userdata(f"serviceid={uuid.uuid4().hex};".encode())  # by which clients know that they are a pair
        qos = Qos(Policy.EntityName(name), both, base=_qos(DEFAULT))
        return Service(
            self, DataReader(self._entity, requests, qos=qos), DataWriter(self._entity, replies, qos=qos), service_type
        )


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

    @property
    def offered_reliable(self) -> bool:
        """Whether all who write it, and somebody does, would send again what is lost."""
        of = Policy.Reliability
        writers = map(self._entity.get_matched_publication_data, self._entity.get_matched_publications())
        offered = [writer is not None and isinstance(writer.qos[of], of.Reliable) for writer in writers]
        return bool(offered) and all(offered)

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


class Call(NamedTuple):
    """A request of a service, to be replied to once."""

    request: Any
    writer: int  # handle of who wrote it


class Service:
    """Takes requests, and replies when it likes."""

    def __init__(self, participant: Participant, requests: Any, replies: Any, service_type: ServiceType) -> None:
        self._participant = participant  # which lives as long
        self._requests, self._replies = requests, replies
        self.type = service_type

    def take(self) -> list[Call | CdrError]:
        """All that came since, in order; errors for those that are no requests."""
        taken: list[Call | CdrError] = []
        found = ddspy_take(self._requests._ref, _EVERYTHING, _TAKEN)
        if isinstance(found, int):
            raise DdsError(f"nothing can be read: {DDSException(found)}")
        for data, info in found:
            if not info.valid_data:
                continue
            try:
                taken.append(Call(decode(self.type.request, data), info.publication_handle))
            except CdrError as error:
                taken.append(error)
        return taken

    def reply(self, call: Call, success: bool, message: str) -> None:
        """Raises DdsError. Who asked and is gone gets none."""
        request: ServiceMessage = call.request
        deadline = time.monotonic() + _BLOCKED / 1000
        while not self._heard(call) and time.monotonic() < deadline:  # a client can ask before it can be answered
            time.sleep(0.005)
        data = encode(self.type.response(request.guid, request.seq, success, message))
        code = ddspy_write(self._replies._ref, data + bytes(-len(data) % 4))
        if code < 0:
            raise DdsError(f"a reply could not be written: {DDSException(code)}")

    def _heard(self, call: Call) -> bool:
        """Whether a reply would reach the client, or there is no use in waiting for that."""
        asking = self._requests.get_matched_publication_data(call.writer)
        client = None if asking is None else _client(asking.qos)
        if client is None:  # it is gone, or does not say who it is
            return asking is None or bool(self._replies.get_matched_subscriptions())
        matched = map(self._replies.get_matched_subscription_data, self._replies.get_matched_subscriptions())
        return any(_client(reader.qos) == client for reader in matched if reader is not None)


def _client(qos: Any) -> bytes | None:
    """By what a client says that its reader and its writer are a pair."""
    data = qos[Policy.Userdata].data if Policy.Userdata in qos else b""
    return next((part for part in data.split(b";") if part.startswith(b"clientid=")), None)


class _Domain:
    """A domain as this process takes part in it: once, on one interface."""

    _known: ClassVar[WeakValueDictionary[int, _Domain]] = WeakValueDictionary()

    def __init__(self, connection: Connection) -> None:
        self._interface = connection.interface
        self._before = _sockets()
        self._own: set[int] = set()  # descriptors of its sockets
        try:
            self._entity = Domain(connection.number, connection.xml)
        except DDSException as error:
            raise DdsError(
                f"DDS cannot use interface={connection.interface} (domain {connection.number}): is it the name or the "
                f"address of one that is up (ip addr)? {error}"
            ) from error
        self._device = _device(connection.interface)
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
        """Cyclone sends on the interface that it is told, but listens on all: the kernel is told as well."""
        self._own = {descriptor for descriptor in _sockets() - self._before if _is_udp(descriptor)}
        if self._device is not None:
            for descriptor in self._own:
                _bind(descriptor, self._device)

    def memories(self) -> list[tuple[int, ...]]:
        """Of each of its sockets what the kernel says of its memory; nothing where the system does not tell."""
        return [memory for descriptor in self._own if (memory := _memory(descriptor))]


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


def _is_udp(descriptor: int) -> bool:
    try:
        with socket.socket(fileno=os.dup(descriptor)) as own:
            return own.family in (socket.AF_INET, socket.AF_INET6) and own.type == socket.SOCK_DGRAM
    except OSError as error:
        if error.errno not in (errno.EBADF, errno.ENOTSOCK):  # closed meanwhile, and so not Cyclone's
            raise
        return False


def _memory(descriptor: int) -> tuple[int, ...]:
    """The kernel's sock_diag(7) SK_MEMINFO of a socket; empty where it has none, as outside of Linux."""
    with socket.socket(fileno=os.dup(descriptor)) as own:
        try:
            return struct.unpack(_MEMINFO, own.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, struct.calcsize(_MEMINFO)))
        except (OSError, struct.error):
            return ()


def _device(interface: str) -> str | None:
    """The device that has it, by its name or address; None: any does. Raises DdsError where none is found."""
    if interface == ANY:
        return None
    try:
        address = ipaddress.ip_address(interface)
    except ValueError:
        return interface.partition(":")[0]  # eth0:1 is a further address of eth0
    if address.is_loopback:
        return LOOPBACK
    for name, told in psutil.net_if_addrs().items():
        if str(address) in [each.address for each in told]:
            return str(name).partition(":")[0]
    raise DdsError(f"interface={interface}: no device has that address; give the device's name (ip addr)")


def _bind(descriptor: int, device: str) -> None:
    """Nothing that came in by another device reaches the socket any more."""
    with socket.socket(fileno=os.dup(descriptor)) as own:
        try:
            if own.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _NAME).rstrip(b"\0") == os.fsencode(device):
                return  # a second time needs a privilege
            own.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, os.fsencode(device))
        except OSError as error:
            where = "this machine" if device == LOOPBACK else device
            raise DdsError(f"DDS cannot be kept on {where} ({error}): interface=auto lets it listen on all") from error


def _qos(quality: Quality) -> Any:
    reliable = Policy.Reliability.Reliable(duration(milliseconds=_BLOCKED))
    return Qos(
        reliable if quality.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if quality.transient_local else Policy.Durability.Volatile,
        Policy.History.KeepLast(quality.depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


@cache
def _idl(message_type: Any) -> Any:
    """The type as Cyclone declares it to others; it never serializes with it."""
    package, kind, name = message_type.ros.split("/")
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
