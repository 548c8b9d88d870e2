"""The offset of a depth sensor, on the synthetic room with true depths that were spoiled on purpose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.depth.data import load_scene
from bench.depth.sensor import sensor_offset, without_offset

pytestmark = pytest.mark.slow


def test_an_offset_of_inverse_depth_is_found_and_taken_out_and_none_is_believed_where_there_is_none() -> None:
    scene = load_scene("room", 160 * 120, 9)
    assert not sensor_offset(scene).believed
    spoiled = without_offset(scene, -0.05)
    found = sensor_offset(spoiled)
    assert found.believed
    assert found.offset == pytest.approx(0.05, abs=0.01)
    for mended, true in zip(without_offset(spoiled, 0.05).truths, scene.truths, strict=True):
        np.testing.assert_allclose(mended, true, rtol=1e-4)


def test_unknown_depth_stays_unknown_and_too_few_maps_are_refused() -> None:
    scene = load_scene("room", 160 * 120, 3)
    holes = [np.where(np.arange(t.shape[1]) < 9, 0.0, t).astype(np.float32) for t in scene.truths if t is not None]
    shifted = without_offset(replace(scene, truths=holes), 0.1).truths[0]
    assert shifted is not None
    assert (shifted[:, :9] == 0).all()
    assert (shifted[:, 9:] > 0).all()
    with pytest.raises(ValueError, match="3 depth maps"):
        sensor_offset(scene)
