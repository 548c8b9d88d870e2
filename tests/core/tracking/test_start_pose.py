"""The pose that a frame's search begins with is kept as it was found, to the last bit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking import frames
from mvsgs_core.tracking.frames import FrameRecord, seen_pose


def test_it_is_not_rounded(monkeypatch: pytest.MonkeyPatch) -> None:
    own = geometry.se3_exp(np.array([0.1, -2.0, 30.0, 0.3, -0.2, 0.1]))
    graph: Any = SimpleNamespace(keyframes={3: SimpleNamespace(segment=0)}, world_from_cam=lambda index: own)
    monkeypatch.setattr(frames, "sample", lambda *given: b"")
    pose = geometry.se3_exp(np.array([0.2, -2.1, 30.3, 0.28, -0.21, 0.12]))
    record: Any = FrameRecord(5, 0.5, "tracking", reference=3)  # type: ignore[arg-type]
    record._stand(graph, None, geometry.inverse(pose))
    found = seen_pose([record], 0, graph)
    assert found is not None
    assert np.abs(found[0] - pose).max() < 1e-12
