"""Memory of every process of a run, sampled while it works.

What grows with the length of a stream shows between its first and its last frame. Start-up before, refinement and
scoring after it are in the peak.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import psutil

from bench import plots
from bench.runs import Matrix
from bench.table import Row, at_most
from mvsgs_core.evaluation import svg

PERIOD = 0.5  # s between samples
GROWTH = 1.25  # median of the last tenth over the median of the third tenth: what counts as flat

Samples = dict[str, list[tuple[float, float]]]  # by node: seconds since the start, resident MB


def sampled(matrix: Matrix, output: Path) -> Samples:
    """Runs the matrix; the samples are also written to memory.json in `output`."""
    process = matrix.start(output)
    start = time.monotonic()
    samples: Samples = {}
    while process.poll() is None:
        for name, megabytes in resident(process.pid).items():
            samples.setdefault(name, []).append((time.monotonic() - start, megabytes))
        time.sleep(PERIOD)
    (output / "memory.json").write_text(json.dumps(samples))
    return samples


def resident(launcher: int) -> dict[str, float]:
    """Resident MB by node: a node's process is `python -m nodes .../NODE.json`."""
    found: dict[str, float] = {}
    try:
        children = psutil.Process(launcher).children(recursive=True)
    except psutil.NoSuchProcess:
        return found
    for child in children:
        try:
            command = child.cmdline()
            if command[1:3] == ["-m", "nodes"]:
                found[Path(command[3]).stem] = child.memory_info().rss / 1e6
        except (psutil.NoSuchProcess, psutil.AccessDenied, IndexError):
            continue  # it has just ended
    return found


def stream(log: str, samples: Samples) -> tuple[float, float]:
    """First and last second of the stream, by the source's log and the samples of its process."""
    times = {}
    for line in log.splitlines():
        clock, phase = line.split()[:2]
        hours, minutes, seconds = clock.split(":")
        times[phase] = 3600 * int(hours) + 60 * int(minutes) + float(seconds)
    waited = (times["running"] - times["starting"]) % 86400
    return samples["dataset"][0][0] + waited, samples["dataset"][-1][0]


def growth(samples: list[tuple[float, float]]) -> float:
    """Median of the last tenth of the samples over the median of the third tenth: the start fills windows."""
    memory = np.array([megabytes for _, megabytes in samples])
    tenth = max(1, len(memory) // 10)
    return float(np.median(memory[-tenth:]) / np.median(memory[2 * tenth : 3 * tenth]))


def flat_rows(name: str, output: Path) -> list[Row]:
    """Peak and growth of each process by the samples in `output`, and memory.svg there."""
    samples: Samples = json.loads((output / "memory.json").read_text())
    start, end = stream((output / "0" / "logs" / "dataset.log").read_text(), samples)
    rows, series = [], []
    for node, taken in samples.items():
        streaming = [sample for sample in taken if start <= sample[0] <= end]
        if len(streaming) < 10:
            continue
        times, memory = np.array(taken).T
        rows.append(Row(f"{name}: {node}: peak memory", float(memory.max()), "MB"))
        rows.append(
            at_most(
                f"{name}: {node}: memory at the stream's end over that after a quarter", growth(streaming), "x", GROWTH
            )
        )
        series.append(svg.Series(node, times, memory))
    plots.write(output / "memory.svg", svg.plot(series, "time, s", "resident memory, MB", width=900, height=360))
    return rows
