"""What is kept of all keyframes of a map is what they say now, and no iteration looks at all of them for it."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from mvsgs_core.mapping.background import Background
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.mapper import OnlineMapper
from tests.support.small_atlas import PLAIN, gain, view
from tests.support.tiny_scene import pose_on_arc

CONFIG = replace(PLAIN, iterations=2)


def mapped(*indices: int, config: MapperConfig = CONFIG, corrections: dict | None = None) -> OnlineMapper:
    mapper = OnlineMapper(config, corrections=corrections)
    for index in indices:
        mapper.add_keyframe(replace(view(index), depth=view(index).depth * np.float32(1.0 + 0.01 * index)))
        check(mapper)
    return mapper


def check(mapper: OnlineMapper) -> None:
    """To the bit."""
    depths = [known.median_depth for known in mapper.views if known.median_depth > 0]
    assert mapper.median_depth == (statistics.median(depths) if depths else 1.0)
    expected = Background(mapper.views).color
    assert (expected is None) == (mapper.trainer.background is None)
    if expected is not None:
        np.testing.assert_array_equal(mapper.trainer.background, expected)


def test_depth_and_background_are_those_of_the_keyframes_as_they_are_now() -> None:
    check(OnlineMapper(CONFIG))
    corrections: dict = {}
    one, other = mapped(0, 2, 4, 5, corrections=corrections), mapped(1, 3, corrections=corrections)
    before = one.median_depth
    one.correct(np.array([0, 2, 5]), np.stack([pose_on_arc(k / 8) for k in (0, 2, 5)]), np.array([2.0, 3.0, 1.5]))
    check(one)
    assert one.median_depth != before
    background = one.trainer.background
    one.photometry.take([2, 4], np.stack([gain(0.5), gain(0.6)]), None, one.log)
    one.expose()
    check(one)
    assert not np.array_equal(one.trainer.background, background)
    one.join(other)
    assert len(one.views) == 6
    check(one)
    one.add_keyframe(view(7))
    check(one)


class NotLookedThrough(list[TrainingView]):
    """Keyframes of a long run."""

    def __iter__(self) -> Iterator[TrainingView]:
        raise AssertionError("all keyframes were looked at")


def test_no_iteration_and_no_new_keyframe_looks_at_all_keyframes() -> None:
    mapper = mapped(0, 1, 2)
    mapper.keyframes.views = NotLookedThrough(mapper.views)
    mapper.add_keyframe(view(3))
    iterations = mapper.iterations
    while mapper.step():
        pass
    mapper.refine(0, 10)
    assert mapper.iterations > iterations
    mapper.keyframes.views = list.copy(mapper.views)
    check(mapper)


def test_images_beyond_are_let_go_at_once_with_one_warning() -> None:
    config = replace(CONFIG, max_keyframes=4)
    corrections: dict = {}
    one = mapped(0, 2, 4, config=config, corrections=corrections)
    one.join(mapped(1, 3, 5, config=config, corrections=corrections))
    assert [known.index for known in one.keyframes.with_image] == [0, 2, 4, 5]
    assert not any(torch.numel(known.image) for known in one.views if known.index in (1, 3))
    assert one.log.counts["refused_images"] == 2
    assert sum("max_keyframes" in text for text in one.log.warnings) == 1
