"""The same command twice: whether the maps are equal to the bit, as processes and against all in one process.

Every run has the same number of threads for each stage: sums are rounded by how many threads share them.
"""

from __future__ import annotations

import itertools
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from bench.runs import launch
from bench.table import Row, all_of
from launch.placement import thread_environment

SMALL = ("dataset.size=[120,160]", "dataset.options.frames=80", "mapper.iterations=20", "mapper.refinement=60")
QUICK = ("dataset.stop=40",)


@dataclass(frozen=True)
class Case:
    name: str
    overrides: tuple[str, ...]
    inline: bool  # compare with a run in one process too


CASES = (
    Case("small room", SMALL, True),
    Case("demonstration", (), False),
    Case("demonstration, poses trained", ("mapper.training.refine_poses=true",), False),
    Case("true poses", ("tracker=ground_truth", *SMALL), False),
)


def measure(quick: bool) -> list[Row]:
    rows = []
    for case in CASES[:1] if quick else CASES:
        runs = 2 if quick else 4
        with tempfile.TemporaryDirectory() as folder:
            overrides = (*case.overrides, *QUICK) if quick else case.overrides
            maps = [_map(Path(folder) / str(k), overrides) for k in range(runs)]
            equal = sum(a == b for a, b in itertools.pairwise(maps))
            rows.append(all_of(f"{case.name}: pairs of runs with equal maps", equal, runs - 1))
            if case.inline and not quick:
                inline = _map(Path(folder) / "inline", (*case.overrides, "inline=true"))
                rows.append(all_of(f"{case.name}: equal to a run in one process", int(inline == maps[0]), 1))
    return rows


def _map(output: Path, overrides: tuple[str, ...]) -> bytes:
    """The bytes of the map that a run leaves. Raises CalledProcessError where it fails."""
    environment = {**os.environ, **thread_environment(1)}  # an inline run has only this
    launch(
        f"output={output}", "device=cpu", "evaluator.max_frames=0", "tracker.threads=1", "mvs.threads=1",
        "depth_fusion.threads=1", "mapper.threads=1", "screen=off", *overrides, env=environment,
    )  # fmt: skip
    return (output / "map.ply").read_bytes()
