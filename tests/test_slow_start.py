"""A camera and a node that is late: no frame is lost to it, and nobody who waits takes its time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.support.launches import Launch

pytestmark = pytest.mark.slow

FRAMES = 40
LATE = "tests.support.fake_graph.stages.LateSink"


def late_sink(folder: Path, *overrides: str) -> dict[str, Any]:
    run = Launch(
        folder, "source=live", f"source.count={FRAMES}", "source.period=0.03", f"sink._target_={LATE}",
        "sink.reads={Keyframe: relay}", "sink.seconds=3", *overrides,
    )  # fmt: skip
    code, out, err = run.finish()
    assert code == 0, out + err
    return dict(json.loads((run.output / "late.json").read_text()))


def test_a_camera_begins_when_the_last_node_has_started(tmp_path: Path) -> None:
    """Frames that were sent before would be overtaken, all but the newest."""
    keyframes = late_sink(tmp_path)["keyframes"]
    assert len(keyframes) >= 0.75 * FRAMES, "a few may be overtaken on a busy machine"
    assert keyframes[0] <= 3


def test_who_waits_for_a_node_that_starts_takes_none_of_its_time(tmp_path: Path) -> None:
    """While frames wait that nobody takes yet."""
    told = late_sink(tmp_path, "source.best_effort=[]")
    assert told["keyframes"] == list(range(FRAMES))
    assert told["relay_cpu"] < 2.0, "seconds"
