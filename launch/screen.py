"""What a run shows: a live table of all nodes on a terminal, now and then a line elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial

import psutil
from rich.cells import cell_len
from rich.console import Console, JustifyMethod
from rich.live import Live
from rich.table import Table

from launch.graph import Graph
from launch.printing import discard, say
from launch.status import NodeStatus, total

PLAIN_SECONDS = 5.0  # between two lines
FOLLOWED = ("frames", "keyframes", "views", "splats", "iterations")
LEAST_COLUMNS = 70  # of a terminal whose table has more to tell than lines
SPARED = ("skipped", "memory", "cpu", "in", "out", "queue")  # columns that a narrow terminal lacks, the first first
LEFT = ("node", "state", "progress", "skipped")
PROGRESS, SKIPPED = 24, 20  # their least width: progress always has it, so that the table keeps still


class _Console(Console):
    def on_broken_pipe(self) -> None:
        raise  # as any other error of writing: by itself rich ends the process here


class Screen:
    """Shows nothing but notes and warnings: the base of the others. The run goes on where nothing can be shown."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or _Console(highlight=False)
        self._noted: set[str] = set()
        self._nodes: dict[str, NodeStatus] = {}

    def start(self, graph: Graph, nodes: dict[str, NodeStatus], processes: dict[str, psutil.Process]) -> None:
        """`nodes` and `processes` are kept and looked at again at every refresh."""
        self._graph = graph
        self._nodes = nodes
        self._processes = processes
        self._began = time.monotonic()
        self.note(f"output: {graph.settings.output}")
        for warning in graph.warnings:
            self.note(f"note: {warning}")

    def refresh(self) -> None:
        for status in self._nodes.values():
            if "url" in status.values:
                self._note_once(f"{status.name}: {status.values['url']}")
            for text in status.warnings:
                self._note_once(f"warning: {status.name}: {text}")

    def _note_once(self, text: str) -> None:
        if text not in self._noted:
            self._noted.add(text)
            self.note(text)

    def note(self, text: str) -> None:
        self._show(partial(self.console.print, text, markup=False, soft_wrap=True))

    def _show(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            discard(self.console.file)
            why = error.strerror or error
            say(f"warning: nothing more can be shown ({why}); the run goes on, and its report says how", sys.stderr)

    def stop(self) -> None:
        pass

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._began


class PlainScreen(Screen):
    """A line every few seconds, with the nodes that have got further, for logs and pipes."""

    def start(self, graph: Graph, nodes: dict[str, NodeStatus], processes: dict[str, psutil.Process]) -> None:
        self._next = PLAIN_SECONDS
        self._printed: set[str] = set()
        super().start(graph, nodes, processes)

    def refresh(self) -> None:
        super().refresh()
        if self._nodes and self.seconds >= self._next:
            self._next = self.seconds + PLAIN_SECONDS
            news = [text for status in self._nodes.values() if (text := brief(status)) not in self._printed]
            self._printed.update(news)
            if any(news):
                self.note(f"{self.seconds:6.1f} s  {'; '.join(filter(None, news))}")


class LiveScreen(Screen):
    """One table, redrawn in place."""

    _live: Live | None = None

    def start(self, graph: Graph, nodes: dict[str, NodeStatus], processes: dict[str, psutil.Process]) -> None:
        super().start(graph, nodes, processes)
        self._live = Live(self._table(), console=self.console, auto_refresh=False)
        self._show(self._live.start)

    def refresh(self) -> None:
        super().refresh()
        if self._live:
            self._show(partial(self._live.update, self._table(), refresh=True))

    def stop(self) -> None:
        if self._live:
            self._show(self._live.stop)
            self._live = None

    def _table(self) -> Table:
        rows = [self._row(name, status) for name, status in self._nodes.items()]
        names = ("node", "state", "in", "queue", "out", "progress", "skipped", "cpu", "memory")
        columns = {name: [row[name] for row in rows] for name in names}
        table = Table(title=f"{self.seconds:.0f} s", title_justify="left")
        widths = _widths(columns, self.console.width)
        for name, width in widths.items():
            justify: JustifyMethod = "left" if name in LEFT else "right"
            table.add_column(name, width=width, no_wrap=name != "progress", justify=justify)
        for row in rows:
            table.add_row(*(row[name] for name in widths))
        return table

    def _row(self, name: str, status: NodeStatus) -> dict[str, str]:
        cpu, memory = self._load(status)
        return {
            "node": name,
            "state": status.state,
            "in": str(total(status.received) or ""),
            "queue": str(total(status.queue) or ""),
            "out": str(total(status.sent) or ""),
            "progress": progress(status),
            "skipped": figures(status.skipped),
            "cpu": cpu,
            "memory": memory,
        }

    def _load(self, status: NodeStatus) -> tuple[str, str]:
        """CPU since the last look and resident memory: the system's figures, the node's last ones once it is gone."""
        process, memory = self._processes.get(status.name), status.memory
        cpu = ""
        if process is not None:
            with suppress(psutil.Error):
                memory = process.memory_info().rss or memory
                cpu = f"{process.cpu_percent():.0f} %"
        return cpu, f"{memory / 2**20:.0f} MB" if memory else ""


def _widths(columns: Mapping[str, Sequence[str]], room: int) -> dict[str, int]:
    """Widths of the columns that a line of `room` characters has room for: whole ones, but for progress, which wraps,
    and what was skipped, which is cut and whole in the report."""
    whole = {name: max(map(cell_len, (name, *texts))) for name, texts in columns.items()}
    widths = whole | {"progress": PROGRESS, "skipped": min(SKIPPED, whole["skipped"])}

    def free() -> int:
        return room - 1 - sum(3 + width for width in widths.values())  # borders, and a blank on both sides

    for name in SPARED:
        if free() < 0:
            del widths[name]
    for name in ("progress", "skipped"):
        if name in widths:
            widths[name] = max(1, min(max(whole[name], widths[name]), widths[name] + free()))
    return widths


def make_screen(kind: str, console: Console | None = None) -> Screen:
    """The screen of `screen=auto|live|plain|off`: auto is live on a terminal that has room for it, plain elsewhere."""
    console = console or _Console(highlight=False)
    if kind == "auto":
        kind = "live" if console.is_terminal and console.width >= LEAST_COLUMNS else "plain"
    return {"live": LiveScreen, "plain": PlainScreen, "off": Screen}[kind](console)


def progress(status: NodeStatus) -> str:
    """What a user follows, as the node counts it (`frames_expected` makes frames 12/160); else its first two counts."""
    known = {
        name: value for name, value in {**status.counts, **status.values}.items() if isinstance(value, int | float)
    }
    expected = known.get("frames_expected")
    names = [name for name in FOLLOWED if name in known] or list(status.counts)[:2]
    parts = []
    for name in names:
        whole = f"/{number(expected)}" if name == "frames" and expected is not None else ""
        parts.append(f"{number(known[name])}{whole} {label(name)}")
    return ", ".join(parts)


def brief(status: NodeStatus) -> str:
    """One node in a plain line; nothing for one that has nothing to say."""
    text = progress(status)
    waiting = total(status.queue)
    if waiting:
        text += f" ({waiting} waiting)"
    return f"{status.name} {text}" if text else ""


def figures(counts: Mapping[str, float]) -> str:
    return ", ".join(f"{number(value)} {label(name)}" for name, value in counts.items())


def label(name: str) -> str:
    return name.replace("_", " ")


def number(value: float) -> str:
    """Short: 950, 12.3k, 4.56M; three digits for a fraction."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    for size, unit in ((1e6, "M"), (1e4, "k")):
        if abs(value) >= size:
            return f"{value / (1e3 if unit == 'k' else size):.3g}{unit}"
    return str(int(value)) if float(value).is_integer() else f"{value:.3g}"
