"""What a node's process is told: a JSON file with its class, parameters, addresses and placement."""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import Any

from launch.graph import Edge, Graph
from launch.placement import niceness
from launch.ports import free_ports
from launch.refusal import GraphError
from msgs.codec import array_specs
from nodes.runtime.addresses import TransportError, is_loopback, load_keys


def check_addresses(graph: Graph) -> None:
    """Raises GraphError for bad keys, a host that may not be listened on, or ports that there are not."""
    settings = graph.settings
    if settings.keys is not None:
        try:
            load_keys(Path(settings.keys))
        except TransportError as error:
            raise GraphError(f"keys={settings.keys}: {error}") from error
    if settings.transport == "ipc":
        return
    topics = _topics(graph)
    for topic in topics:
        host = _host(graph, topic)
        if settings.keys is None and not is_loopback(host):
            raise GraphError(
                f"{topic} at {host}: beyond loopback only with keys=DIR (CURVE keys), which docs/guides/node.md says "
                "how to make"
            )
    if settings.port is not None and not 1 <= settings.port <= 65536 - len(topics):
        raise GraphError(
            f"port={settings.port}: the run takes {len(topics)} ports from there on, of 1 to 65535; best below 32768"
        )


def addresses(graph: Graph, directory: Path) -> dict[str, str]:
    """Topic (`slot.MessageType`) -> address."""
    topics = _topics(graph)
    if graph.settings.transport == "ipc":
        return {topic: f"ipc://{directory}/{topic}" for topic in topics}
    first = graph.settings.port
    ports = [first + i for i in range(len(topics))] if first is not None else free_ports(len(topics))
    hosts = [_host(graph, topic) for topic in topics]
    at = [f"[{host}]" if ":" in host else host for host in hosts]  # an address of IPv6 has colons of its own
    return {topic: f"tcp://{host}:{port}" for topic, host, port in zip(topics, at, ports, strict=True)}


def _topics(graph: Graph) -> list[str]:
    return list(dict.fromkeys(topic_of(edge) for edge in graph.edges))


def _host(graph: Graph, topic: str) -> str:
    """Where a topic's publisher is reached."""
    host = graph.slots[topic.partition(".")[0]].placement.host or graph.settings.host
    return host.removeprefix("[").removesuffix("]")


def new_token(graph: Graph) -> str:
    """By which the nodes of one run know each other where anybody on the machine may connect: tcp without keys."""
    return secrets.token_hex(16) if graph.settings.transport == "tcp" and graph.settings.keys is None else ""


def spec(
    graph: Graph, name: str, address: dict[str, str], threads: int | None, status_fd: int | None, token: str = ""
) -> dict[str, Any]:
    """The JSON that `python -m nodes` runs a node from."""
    slot = graph.slots[name]
    settings = graph.settings
    away = settings.supervise.dead
    own_threads = {"threads": threads} if "threads" in slot.config else {}  # a node's kernels keep to its share too
    outputs: dict[str, dict[str, Any]] = {}
    for edge in graph.out_of(name):
        kind = edge.message.__name__
        output = outputs.setdefault(
            kind,
            {
                "type": kind, "address": address[topic_of(edge)], "readers": 0, "observers": [],
                "patience": settings.supervise.dead if slot.placement.external else 0.0, "away": 0.0,
                # what it lacks the next image makes up for, as no map does for the last one
                "live": settings.transport == "tcp" and "image" in array_specs(edge.message),
            },
        )  # fmt: skip
        output["live"] &= edge.best_effort
        if returns(graph, edge.reader) and not edge.best_effort:
            output["away"] = away
        if edge.reader in graph.observers or edge.reader in graph.sources:  # a source that has ended is not missed
            output["observers"].append(edge.reader)
            if graph.slots[edge.reader].placement.external:  # whoever starts it by hand takes the time that it takes
                output["patience"] = 0.0
        else:
            output["readers"] += 1
    return {
        "name": name,
        "target": slot.target,
        "config": slot.config | own_threads,
        "observer": name in graph.observers,
        "returns": returns(graph, name),
        "inputs": [
            {
                "type": edge.message.__name__,
                "slot": edge.sender,
                "address": address[topic_of(edge)],
                "best_effort": edge.best_effort,
                "away": away if returns(graph, edge.sender) else 0.0,
            }
            for edge in graph.into(name)
        ],
        "outputs": list(outputs.values()),
        "buffer": settings.buffer,
        "dead": settings.supervise.dead,
        "seed": settings.seed,
        "threads": threads,
        "cpu": slot.placement.cpu,
        "nice": niceness(graph, name),
        "keys": None if settings.keys is None else str(Path(settings.keys).absolute()),
        "token": token,
        "status_fd": status_fd,
    }


def returns(graph: Graph, name: str) -> bool:
    """Whether the run waits for a node that is lost: who started it, by hand or on another host, starts it again."""
    slot = graph.slots[name]
    return slot.placement.external and slot.node.restartable and name not in graph.observers


def write_spec(content: dict[str, Any], path: Path) -> Path:
    path.write_text(json.dumps(content, indent=1))
    return path


def topic_of(edge: Edge) -> str:
    """`slot.MessageType`."""
    return f"{edge.sender}.{edge.message.__name__}"
