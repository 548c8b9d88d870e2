"""Which core and how many threads each node gets, so that the processes do not fight over the cores."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgs
from launch.graph import Graph, Slot
from mvsgs_core.machine import available_cores

# Share of the cores by work per keyframe; a slot that is not named counts as 1, one that works on a GPU as ON_GPU.
SHARES: Mapping[str, float] = {"mapper": 4, "mvs": 3, "tracker": 2, "depth_fusion": 1, "dataset": 0.5}
ON_GPU = 0.5
# Works only when the others have finished: all cores are its own by then.
LAST = ("evaluator",)
# The heaviest slot takes most of a whole run's CPU time (the mapper 76 to 94 % of it, measured on the synthetic room
# and on TUM's freiburg1_xyz): the others often wait for it, and it goes on when they have finished.
HEAVIEST_SHARE = 0.75
# Niceness in real time, for each stage that stands between a node and the frames, and of who only looks: a level is a
# tenth of the time of a core that two share, so that stereo is hardly slowed by a mapper that fills what is left.
STEP, WATCHING = 4, 15


def thread_plan(graph: Graph, cores: int | None = None) -> dict[str, int]:
    """Threads of each slot: its own `threads`, the number of cores in `cpu`, or its share of all cores.

    The sum may exceed the cores a little, because waiting threads sleep.
    """
    cores = available_cores() if cores is None else cores
    shares = {name: ON_GPU if _on_gpu(slot) else SHARES.get(name, 1) for name, slot in graph.slots.items()}
    total = sum(share for name, share in shares.items() if name not in LAST)
    on_cpu = [name for name, slot in graph.slots.items() if not _on_gpu(slot)]
    heaviest = max(on_cpu, key=shares.__getitem__, default="")
    plan = {}
    for name, slot in graph.slots.items():
        share = cores if name in LAST else max(1, round(cores * shares[name] / total))
        if name == heaviest:
            share = max(share, math.ceil(cores * HEAVIEST_SHARE))
        pinned = len(slot.placement.cpu) if slot.placement.cpu else share
        plan[name] = own_threads(slot) or min(share, pinned)
    return plan


def _on_gpu(slot: Slot) -> bool:
    return str(slot.config.get("device")).startswith("cuda")


def own_threads(slot: Slot) -> int | None:
    """What was said of its threads; where nothing was, whoever starts on another host takes all cores of that host."""
    threads: int | None = slot.placement.threads or slot.config.get("threads")
    return threads


def niceness(graph: Graph, name: str) -> int:
    """By how much a node gives way to others. In real time whoever stands nearer to the camera goes first."""
    if not graph.settings.realtime:
        return 0
    if any(edge.message is msgs.CameraPose for edge in graph.into(name)):
        return STEP  # a robot waits for what it sends
    if name in graph.observers and all(edge.best_effort for edge in graph.into(name)):
        return WATCHING
    away: dict[str, int] = {}
    for slot in graph.slots:  # senders come first
        frames = any(edge.message is msgs.Frame for edge in graph.into(slot))
        senders = [away[edge.sender] + 1 for edge in graph.into(slot) if edge.sender in away]
        away[slot] = 0 if frames or not senders else max(senders)
    # who reads every message and only looks must not fall far behind: no further than the last stage
    return STEP * min(away[name], max(n for slot, n in away.items() if slot not in graph.observers))


def thread_environment(threads: int) -> dict[str, str]:
    """Environment that holds OpenMP, BLAS and OpenCV to that many threads, which sleep instead of spinning."""
    libraries = ("OMP", "MKL", "OPENBLAS", "NUMEXPR", "VECLIB_MAXIMUM", "BLIS")
    return {f"{library}_NUM_THREADS": str(threads) for library in libraries} | {
        "OPENCV_FOR_THREADS_NUM": str(threads),
        "OMP_WAIT_POLICY": "PASSIVE",
        "GOMP_SPINCOUNT": "0",
        "OPENBLAS_THREAD_TIMEOUT": "4",  # 2**4 cycles, the least there is; by default it is 2**26
    }
