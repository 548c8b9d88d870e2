"""A program that stands for one of ROS 2: another process, with Cyclone's own serializer and rosbags' definitions.

It shares no line with what it is to test: types come from rosbags, bytes from cyclonedds.idl, and it is configured as
ROS_LOCALHOST_ONLY=1 configures rmw_cyclonedds.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
from collections.abc import Iterator, Mapping
from multiprocessing.connection import Connection
from typing import Any

from tests.support.patience import until

# of rmw_cyclonedds: its header, and the fields of the .srv file
SERVICES = {
    "Trigger": ("uint8 structure_needs_at_least_one_member", "bool success\nstring message"),
    "SetBool": ("bool data", "bool success\nstring message"),
}
HEADER = "uint64 guid\nint64 seq\n"
LOCALHOST_ONLY = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>'
    "</Domain></CycloneDDS>"
)
OWN_DOMAIN = 1 + os.getpid() % 200  # tests that run beside these have another


class Peer:
    """Calls are carried out by the other process, in order."""

    def __init__(self, domain: int = OWN_DOMAIN) -> None:
        context = multiprocessing.get_context("spawn")
        self._end, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, domain), daemon=True)
        self._process.start()
        theirs.close()

    def advertise(self, topic: str, name: str, **quality: Any) -> None:
        """quality: reliable, transient_local, depth."""
        self._call("advertise", topic, name, quality)

    def publish(self, topic: str, message: Mapping[str, Any]) -> None:
        """Fields that are not given are zero, false and empty."""
        self._call("publish", topic, message)

    def publish_raw(self, topic: str, data: bytes) -> None:
        self._call("publish_raw", topic, data)

    def readers(self, topic: str) -> int:
        return int(self._call("readers", topic))

    def subscribe(self, topic: str, name: str, **quality: Any) -> None:
        self._call("subscribe", topic, name, quality)

    def taken(self, topic: str) -> list[dict[str, Any]]:
        """All that came since."""
        return list(self._call("taken", topic))

    def client(self, service: str, kind: str) -> None:
        """kind: Trigger or SetBool; returns when the service is there."""
        self._call("client", service, kind)
        until(lambda: self._call("available", service), what=f"nobody offers {service}")

    def ask(self, service: str, *, times: int = 1, **fields: Any) -> list[int]:
        """Sequence numbers of as many requests, sent without waiting for a reply."""
        return list(self._call("ask", service, times, fields))

    def replies(self, service: str, count: int = 1) -> list[dict[str, Any]]:
        """The next so many replies to this client."""
        found: list[dict[str, Any]] = []
        until(
            lambda: found.extend(self._call("replies", service)) or len(found) >= count,
            what=lambda: f"{len(found)} of {count} replies of {service}",
        )
        return found

    def wait_for_reader(self, topic: str) -> None:
        until(lambda: self.readers(topic), what=f"nobody reads {topic}")

    def wait_for(self, topic: str, count: int = 1) -> list[dict[str, Any]]:
        """At least so many messages."""
        found: list[dict[str, Any]] = []
        until(
            lambda: found.extend(self.taken(topic)) or len(found) >= count,
            what=lambda: f"{len(found)} messages at {topic}",
        )
        return found

    def close(self) -> None:
        self._end.send(None)
        self._process.join(10.0)
        if self._process.is_alive():
            self._process.kill()

    def kill(self) -> None:
        self._process.kill()

    def _call(self, *request: Any) -> Any:
        self._end.send(request)
        answer = self._end.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer


def _serve(connection: Connection, domain: int) -> None:
    program = _Program(domain)
    while (request := connection.recv()) is not None:
        try:
            connection.send(getattr(program, request[0])(*request[1:]))
        except Exception as error:
            connection.send(RuntimeError(f"{request[:2]}: {error!r}"))


class _Program:
    def __init__(self, domain: int) -> None:
        from cyclonedds.domain import Domain, DomainParticipant
        from rosbags.typesys import Stores, get_typestore

        self._domain = Domain(domain, LOCALHOST_ONLY)
        self._participant = DomainParticipant(domain)
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._types: dict[str, Any] = {}
        self._writers: dict[str, Any] = {}
        self._readers: dict[str, Any] = {}
        self._clients: dict[str, tuple[Any, Any, int, Iterator[int]]] = {}

    def advertise(self, topic: str, name: str, quality: dict[str, Any]) -> None:
        from cyclonedds.pub import DataWriter

        self._writers[topic] = DataWriter(self._participant, self._topic(topic, name), qos=_qos(**quality))

    def subscribe(self, topic: str, name: str, quality: dict[str, Any]) -> None:
        from cyclonedds.sub import DataReader

        self._readers[topic] = DataReader(self._participant, self._topic(topic, name), qos=_qos(**quality))

    def publish(self, topic: str, message: Mapping[str, Any]) -> None:
        writer = self._writers[topic]
        writer.write(self._filled(writer.data_type, message))

    def publish_raw(self, topic: str, data: bytes) -> None:
        from cyclonedds._clayer import ddspy_write

        assert ddspy_write(self._writers[topic]._ref, data + bytes(-len(data) % 4)) >= 0

    def readers(self, topic: str) -> int:
        return len(self._writers[topic].get_matched_subscriptions())

    def taken(self, topic: str) -> list[dict[str, Any]]:
        return [_plain(sample) for sample in self._readers[topic].take(1000) if sample.sample_info.valid_data]

    def client(self, service: str, kind: str) -> None:
        """As rmw_init_cs makes one: reliable, keep last 10, the pair known by its user data."""
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        for end, text in zip(("Request", "Response"), SERVICES[kind]):
            self._store.register(service_type(f"{kind}_{end}", text))
        guid = int.from_bytes(os.urandom(7))
        qos = Qos(
            Policy.Reliability.Reliable(duration(milliseconds=100)),
            Policy.Durability.Volatile,
            Policy.History.KeepLast(10),
            Policy.Userdata(f"clientid={guid:x};".encode()),
        )
        request, response = (self._type(f"std_srvs/srv/{kind}_{end}") for end in ("Request", "Response"))
        writer = DataWriter(self._participant, Topic(self._participant, f"rq{service}Request", request), qos=qos)
        reader = DataReader(self._participant, Topic(self._participant, f"rr{service}Reply", response), qos=qos)
        self._clients[service] = writer, reader, guid, itertools.count(1)

    def available(self, service: str) -> bool:
        writer, reader, *_ = self._clients[service]
        return bool(writer.get_matched_subscriptions() and reader.get_matched_publications())

    def ask(self, service: str, times: int, fields: Mapping[str, Any]) -> list[int]:
        writer, _, guid, numbers = self._clients[service]
        asked = [next(numbers) for _ in range(times)]
        for number in asked:
            writer.write(self._filled(writer.data_type, {"guid": guid, "seq": number, **fields}))
        return asked

    def replies(self, service: str) -> list[dict[str, Any]]:
        _, reader, guid, _ = self._clients[service]
        taken = [_plain(sample) for sample in reader.take(1000) if sample.sample_info.valid_data]
        return [reply for reply in taken if reply["guid"] == guid]

    def _topic(self, topic: str, name: str) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self._participant, f"rt{topic}", self._type(name))

    def _type(self, name: str) -> Any:
        from cyclonedds.idl import make_idl_struct

        if name not in self._types:
            package, kind, short = name.split("/")
            members = {member: self._member(spec) for member, spec in self._fields(name)}
            self._types[name] = make_idl_struct(f"{short}_", f"{package}::{kind}::dds_::{short}_", members)
        return self._types[name]

    def _member(self, spec: Any) -> Any:
        from cyclonedds.idl import types

        kind, what = spec[0].name, spec[1]
        if kind == "NAME":
            return self._type(what)
        if kind == "BASE":
            return {"string": str, "bool": bool}.get(what[0]) or getattr(types, what[0])
        element = self._member(what[0])
        return types.array[element, what[1]] if kind == "ARRAY" else types.sequence[element]

    def _filled(self, message_type: Any, given: Mapping[str, Any]) -> Any:
        """The message with what is given, and zeros for the rest."""
        name = next(n for n, t in self._types.items() if t is message_type)
        return message_type(**{member: self._value(spec, given.get(member)) for member, spec in self._fields(name)})

    def _fields(self, name: str) -> Any:
        return self._store.fielddefs[name.replace("/srv/", "/msg/")][1]  # rosbags knows no services

    def _value(self, spec: Any, given: Any) -> Any:
        kind, what = spec[0].name, spec[1]
        if kind == "NAME":
            return self._filled(self._type(what), given or {})
        if kind == "BASE":
            return given if given is not None else {"string": "", "bool": False}.get(what[0], 0)
        if kind == "ARRAY":
            return list(given) if given is not None else [self._value(what[0], None)] * what[1]
        return [self._value(what[0], each) for each in (given if given is not None else ())]


def service_type(name: str, text: str) -> Any:
    """rosbags' definition of one end of a service of std_srvs."""
    from rosbags.typesys import get_types_from_msg

    return get_types_from_msg(HEADER + text, f"std_srvs/msg/{name}")


def _qos(reliable: bool = True, transient_local: bool = False, depth: int = 10) -> Any:
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=100)) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if transient_local else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
    )


def _plain(value: Any) -> Any:
    """A message as nested dictionaries and lists."""
    if hasattr(value, "__idl__"):
        return {name: _plain(member) for name, member in vars(value).items() if name != "sample_info"}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value
