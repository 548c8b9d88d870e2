"""The keys of a run that belong to no slot."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from mvsgs_core.setting_ranges import SEEDS, UNBOUNDED, at_least, within

BUFFER, LIVE_BUFFER = 4, 128  # messages: a live stage works off a burst, and holds nobody up meanwhile


@dataclass(frozen=True)
class Supervise:
    """What the launcher does about a node that it no longer hears of."""

    silent: float = 10.0  # seconds until it is named
    # seconds until the run ends without it, or goes on without it where it only observes; so long a stage that was
    # started by hand, on another host, is waited for once it is lost
    dead: float = 60.0


@dataclass(frozen=True)
class Settings:
    """The keys that belong to no slot."""

    output: str = ""  # directory of everything a run writes; none given: runs/<time>-<dataset>
    map: str | None = None  # output of a run with keep_map=true: its map is gone on with; null: a new map
    keep_map: bool | None = None  # leave the map in the output, for another run to begin on; null: where `map` is given
    device: str = "auto"  # auto, cpu, cuda or cuda:1: for every node that has a `device` and leaves it at auto
    seed: Annotated[int, UNBOUNDED] = 0  # of every random choice
    inline: bool = False  # true (or --inline): all nodes in this process, one message at a time, for a debugger
    # keep the camera's pace, at the price of detail: recordings too, at theirs; null: where the source is live
    realtime: bool | None = None
    buffer: int | None = None  # messages that a reliable edge holds before it stops its sender; null: 4, live 128
    transport: Literal["ipc", "tcp"] = "ipc"
    host: str = "127.0.0.1"  # tcp: where the nodes' publishers are reached; a slot may have its own `host`
    # tcp: the first of the ports, one a topic, best below 32768, from where on the system gives them to whoever
    # connects; null: free ones, known to nodes started here
    port: int | None = None
    keys: str | None = None  # directory of CURVE keys: without them no topic is offered beyond loopback
    screen: Literal["auto", "live", "plain", "off"] = "auto"
    supervise: Supervise = field(default_factory=Supervise)

    def __post_init__(self) -> None:
        within(self, seed=SEEDS)
        at_least(self, buffer=1)


# nodes that have such a parameter and are given none of their own get these
FROM_SETTINGS = ("output", "seed", "map", "keep_map", "realtime")
