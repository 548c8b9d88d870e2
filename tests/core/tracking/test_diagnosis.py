"""A map that never began says why, with what was measured."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.datasets import Item, open_dataset
from tests.support.sequences import synthetic, track
from tests.support.true_maps import item as true_room


def blank() -> list[Item]:
    return [replace(i, image=np.full_like(i.image, 128)) for i in synthetic(frames=80)[:10]]


def resting() -> list[Item]:
    return [replace(synthetic(frames=80)[0], index=n, timestamp=n / 20.0) for n in range(10)]


def turning() -> list[Item]:
    return list(synthetic(frames=75, pure_rotation=20)[:12])


def jumping() -> list[Item]:
    """Views in all directions of the room and from far apart over a landscape: no frame shows what another does."""
    landscape = list(open_dataset("synthetic", frames=400, stride=130, threads=1, scene="aerial"))
    far = [item for items in zip([true_room(k) for k in (0, 75, 150, 225)], landscape) for item in items]
    return [replace(i, index=n, timestamp=n / 20.0) for n, i in enumerate(far)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("items", "kind", "figures"),
    [
        (blank, "no texture", r"10 of 10 frames .* 0\.0 %"),
        (resting, "too little motion", r"0\.0 % of its longer side .* \d of 6 keyframes"),
        (turning, "parallax", r"explains the matches to 0\.\d pixels|\d\.\d pixels of"),
        (jumping, "steps too wide", r"\d of \d frames .* \d+ % of the matches survive, 20 % are needed"),
    ],
)
def test_the_reason_is_what_was_measured(items: object, kind: str, figures: str) -> None:
    tracker, trajectory, _ = track(items())  # type: ignore[operator]
    assert not np.isfinite(trajectory.world_from_cam).any()
    assert kind in tracker.nothing
    assert re.search(figures, tracker.nothing), tracker.nothing
    assert tracker.nothing in list(tracker.stats.warnings)


@pytest.mark.slow
def test_a_jump_is_one_frame_that_could_not_be_followed() -> None:
    """The next one is followed from it, and the start begins there."""
    places = [true_room(k) for k in (0, 75, 150, 225)]
    items = [replace(place, index=n, timestamp=n / 20.0) for n, place in enumerate(p for p in places for _ in range(4))]
    tracker, _, _ = track(items)
    diagnosis = tracker.session.diagnosis
    assert diagnosis.lost.frames == len(places) - 1
    assert diagnosis.jumped.frames == 0


@pytest.mark.slow
def test_a_map_has_no_reason_to_be_none() -> None:
    tracker, _, _ = track(synthetic(frames=80)[:30])
    assert tracker.nothing == ""
