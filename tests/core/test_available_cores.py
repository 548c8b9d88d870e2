"""The cores that a process may use, of control groups as files say them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import pytest

from mvsgs_core.machine import available_cores

CORES = 16
SERVICE = "0::/system.slice/mvsgs.service\n"
BOTH = "3:cpuset:/\n2:cpu,cpuacct:/docker/a1\n1:memory:/docker/a1\n0::/docker/a1\n"


@pytest.mark.parametrize(
    ("groups", "files", "cores"),
    [
        ("0::/\n", {}, CORES),
        ("0::/\n", {"cpu.max": "300000 100000"}, 3),  # a container with a view of its own
        ("0::/docker/a1\n", {"cpu.max": "250000 100000"}, 3),  # and one that sees its host's path
        (SERVICE, {"system.slice/mvsgs.service/cpu.max": "200000 100000", "system.slice/cpu.max": "max 100000"}, 2),
        (SERVICE, {"system.slice/mvsgs.service/cpu.max": "max 100000", "system.slice/cpu.max": "400000 100000"}, 4),
        (SERVICE, {"system.slice/mvsgs.service/cpu.max": "50000 100000"}, 1),
        (SERVICE, {"system.slice/other.service/cpu.max": "50000 100000"}, CORES),
        (BOTH, {"cpu/docker/a1/cpu.cfs_quota_us": "600000", "cpu/docker/a1/cpu.cfs_period_us": "100000"}, 6),
        (BOTH, {"cpu/cpu.cfs_quota_us": "150000", "cpu/cpu.cfs_period_us": "50000"}, 3),
        (BOTH, {"cpu/docker/a1/cpu.cfs_quota_us": "-1", "cpu/docker/a1/cpu.cfs_period_us": "100000"}, CORES),
        (None, {}, CORES),  # a system without control groups
    ],
)
def test_the_smallest_quota_counts(
    groups: str | None, files: Mapping[str, str], cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(CORES)))
    if groups is not None:
        (tmp_path / "proc/self").mkdir(parents=True)
        (tmp_path / "proc/self/cgroup").write_text(groups)
    for name, text in files.items():
        file = tmp_path / "sys/fs/cgroup" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{text}\n")
    assert available_cores(tmp_path) == cores
