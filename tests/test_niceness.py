"""Nodes of a run that gives way to others itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.patience import until
from tests.support.processes import ENVIRONMENT

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("own", "more", "found"), [(6, 3, 9), (0, 0, 0), (10, 15, 19)])
def test_a_node_gives_way_by_so_much_more_than_its_launcher(own: int, more: int, found: int, tmp_path: Path) -> None:
    spec, log = tmp_path / "left.json", tmp_path / "left.log"
    frames = {"type": "Frame", "slot": "source", "address": f"ipc://{tmp_path}/f"}
    left = {
        "name": "left",
        "target": "tests.support.sample_nodes.Left",
        "config": {},
        "inputs": [frames],
        "outputs": [],
    }
    spec.write_text(json.dumps(left | {"nice": more}))
    here = os.getpriority(os.PRIO_PROCESS, 0)
    command = ["nice", "-n", str(own), sys.executable, "-m", "nodes", str(spec)]
    with log.open("wb") as said:
        node = subprocess.Popen(command, env={**os.environ, **ENVIRONMENT}, stderr=said)
    try:
        until(lambda: "running" in log.read_text() or node.poll() is not None)
        assert node.poll() is None, log.read_text()
        tasks = [int(task.name) for task in Path(f"/proc/{node.pid}/task").iterdir()]
        assert {os.getpriority(os.PRIO_PROCESS, task) for task in tasks} == {min(19, here + found)}
    finally:
        node.kill()
        node.wait()
