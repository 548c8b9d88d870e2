"""The composed graph as text: `run_all.py --graph`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import nodes
from launch.graph import Edge, Graph, Slot


def graph_text(graph: Graph, choices: Mapping[str, Any]) -> str:
    """A line for each slot, in the data's order, and under it one for each edge from it, with its quality of service.

    `choices`: the choice of each slot, as Hydra has them.
    """
    rows: list[tuple[str, str, str]] = []
    for name, slot in graph.slots.items():
        rows.append((f"{name}={choices.get(name, '')}".removesuffix("="), slot.target, _marks(graph, slot)))
        for edge in graph.out_of(name):
            rows.append((f"  {edge.message.__name__}", f"-> {edge.reader}", _service(edge)))
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    lines = [f"{first:{widths[0]}}  {second:{widths[1]}}  {third}".rstrip() for first, second, third in rows]
    off = [name for name, choice in choices.items() if name not in graph.slots and "/" not in name]
    if off:
        lines.append(f"off: {', '.join(off)}")
    s = graph.settings
    lines.append(
        f"reliable: every message arrives, {s.buffer} at most wait; newest only: what comes late is skipped; "
        "observer: the run goes on without it"
    )
    where = "in this process" if s.inline else f"a process each, {s.transport}"
    return "\n".join([*lines, f"nodes: {where}; device={s.device}; output={s.output}"])


def _marks(graph: Graph, slot: Slot) -> str:
    marks = {
        "source": nodes.is_source(slot.node),
        "observer": slot.name in graph.observers,
        "external": slot.placement.external,
    }
    return ", ".join(mark for mark, holds in marks.items() if holds)


def _service(edge: Edge) -> str:
    return "newest only" if edge.best_effort else "reliable"
