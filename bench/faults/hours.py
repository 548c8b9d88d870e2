"""A long stream of a camera that moves to and fro: what every process holds, and the disk, do not grow with its length.

Keyframes settle soon, so that all that could still grow is what is kept for frames. Memory at the stream's end is
compared with that around the frame by which everything has settled; what refinement and scoring need after the stream
is in the peak.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from bench.memory import resident
from bench.runs import ROOT, environment, launcher
from bench.table import Row, at_most

GROWTH = 1.1  # memory of a process at the end over that after it has settled
PERIOD = 0.2  # s between samples
MAX_BYTES = 4e6  # of the frames that wait to be scored: reached long before the end
OVERRIDES = (
    "device=cpu", "screen=off", "tracker.area=6912", "tracker.covisibility.min_keyframes=12", "mvs.area=6912",
    "mapper.iterations=2", "mapper.refinement=20", "mapper.checkpoint=5", f"evaluator.max_bytes={MAX_BYTES:g}",
    "evaluator.max_frames=20", "evaluator.lpips=off",
)  # fmt: skip


@dataclass
class Samples:
    """Over the time of a run: (time.monotonic() in s, MB), resident by node and on disk."""

    memory: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    folder: list[tuple[float, float]] = field(default_factory=list)  # the output
    unnamed: list[tuple[float, float]] = field(default_factory=list)  # files without a name that the processes hold


def measure(quick: bool) -> list[Row]:
    frames, settled = (500, 250) if quick else (10_000, 2_000)
    with tempfile.TemporaryDirectory() as folder:
        return _rows(*_watched(Path(folder), frames), frames, settled)


def _watched(folder: Path, frames: int) -> tuple[Samples, list[tuple[float, int]], dict[str, int]]:
    """A run: its samples, when how many frames had been sent, and counts of its report. Raises where it fails."""
    output, progress = folder / "out", folder / "progress"
    command = [
        *launcher(), f"output={output}", *OVERRIDES,
        "dataset._target_=bench.faults.to_and_fro.ToAndFro", f"dataset.frames={frames}", f"dataset.progress={progress}",
    ]  # fmt: skip
    samples = Samples()
    with (folder / "log").open("w+") as log:
        run = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, env=environment())
        try:
            while run.poll() is None:
                _sample(samples, run.pid, output)
                time.sleep(PERIOD)
        finally:
            run.terminate()  # the launcher stops its nodes; nothing happens where it has ended
            run.wait()
        if run.returncode:
            log.seek(0)
            raise RuntimeError(f"the long run ended with code {run.returncode}: {log.read()[-2000:]}")
    told = [line.split() for line in progress.read_text().splitlines()]
    report = json.loads((output / "report.json").read_text())
    return samples, [(float(at), int(count)) for at, count in told], report["trajectory"]


def _sample(samples: Samples, launcher: int, output: Path) -> None:
    now = time.monotonic()
    for name, megabytes in resident(launcher).items():
        samples.memory.setdefault(name, []).append((now, megabytes))
    samples.folder.append((now, _size(output) / 1e6))
    samples.unnamed.append((now, _unnamed(launcher) / 1e6))


def _size(folder: Path) -> int:
    """Bytes of all files."""
    found = 0
    for file in folder.rglob("*"):
        try:
            found += file.stat().st_size if file.is_file() else 0
        except FileNotFoundError:  # it has just been replaced
            continue
    return found


def _unnamed(launcher: int) -> int:
    """Bytes of files that were deleted, or never had a name, and that a process of the run still holds."""
    found = 0
    try:
        processes = psutil.Process(launcher).children(recursive=True)
    except psutil.NoSuchProcess:
        return 0
    for process in processes:
        for handle in Path(f"/proc/{process.pid}/fd").glob("*"):
            try:
                if "(deleted)" in str(handle.readlink()) and "/memfd:" not in str(handle.readlink()):
                    found += handle.stat().st_size
            except OSError:  # it has just been closed, or belongs to another user
                continue
    return found


def _rows(
    samples: Samples, progress: list[tuple[float, int]], counts: dict[str, int], frames: int, settled: int
) -> list[Row]:
    name = f"{frames} frames to and fro"
    early = _between(progress, 0.8 * settled, 1.2 * settled)
    late = _between(progress, frames - 0.4 * settled, frames)
    rows = [
        Row(
            f"{name}: keyframes",
            counts["keyframes"],
            f"of {counts['frames']} frames, {counts['frames_tracked']} tracked",
        )
    ]
    for node, taken in samples.memory.items():
        before, after = _median(taken, early), _median(taken, late)
        peak = max(megabytes for _, megabytes in taken)
        rows.append(
            at_most(
                f"{name}: {node}: memory at the end over that after {settled}",
                after / before,
                f"x ({after:.0f} MB; peak of the run {peak:.0f} MB)",
                GROWTH,
            )
        )
    before, after = _median(samples.folder, early), _median(samples.folder, late)
    rows.append(at_most(f"{name}: output folder at the end over that after {settled}", after / before, "x", 1.5))
    unnamed = max(megabytes for _, megabytes in samples.unnamed)
    rows.append(at_most(f"{name}: frames that wait on disk to be scored, most", unnamed, "MB", MAX_BYTES / 1e6))
    return rows


def _between(progress: list[tuple[float, int]], first: float, last: float) -> tuple[float, float]:
    """When so many frames had been sent."""
    times = [at for at, frames in progress if first <= frames <= last]
    return min(times), max(times)


def _median(samples: list[tuple[float, float]], during: tuple[float, float]) -> float:
    """Of the samples of that time; on a machine so slow that there are none, the one nearest to its middle."""
    found = [value for at, value in samples if during[0] <= at <= during[1]]
    middle = (during[0] + during[1]) / 2
    return statistics.median(found) if found else min(samples, key=lambda sample: abs(sample[0] - middle))[1]
