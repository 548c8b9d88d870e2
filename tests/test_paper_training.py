"""What the paper's mapper is trained with, from its configuration to each iteration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torch import Tensor

from launch.compose import compose
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.losses import LossInputs, name_of
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.trainer import FINAL_RATE
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

KEYFRAMES, ITERATIONS, REFINEMENT = 4, 12, 48


def paper(*overrides: str) -> MapperConfig:
    slot = compose(["mapper=paper", "dataset=synthetic", *overrides]).slots["mapper"]
    config = slot.node(slot.parameters).config
    assert isinstance(config, MapperConfig)
    return config


@pytest.fixture(scope="module")
def frequencies() -> list[float]:
    """Of the loss, in each iteration of a small map."""
    seen: list[float] = []

    def watched(inputs: LossInputs) -> Tensor:
        seen.append(inputs.frequency)
        return (inputs.render.color - inputs.target).abs().mean()

    config = paper(f"mapper.iterations={ITERATIONS}", f"mapper.refinement={REFINEMENT}", "device=cpu")
    training = replace(config.training, loss_function=name_of(watched))
    mapper = OnlineMapper(replace(config, training=training, threads=1))
    for k in range(KEYFRAMES):
        mapper.add_keyframe(rgbd_keyframe(k, pose_on_arc(k / KEYFRAMES), size=(24, 32)))
    while mapper.step():
        pass
    for done in range(REFINEMENT):
        mapper.refine(done, REFINEMENT)
    assert mapper.trainer.rate == pytest.approx(FINAL_RATE, rel=0.1)
    return seen


def test_the_losses_frequency_runs_through_all_of_the_training(frequencies: list[float]) -> None:
    assert len(frequencies) == KEYFRAMES * ITERATIONS + REFINEMENT
    stream, refinement = np.array(frequencies[:-REFINEMENT]), np.array(frequencies[-REFINEMENT:])
    assert frequencies[0] == 0.0
    assert stream.max() <= 50.0
    assert 30.0 < np.mean(stream[-KEYFRAMES:]) <= 50.0
    np.testing.assert_allclose(refinement, 50.0 + 50.0 * np.arange(REFINEMENT) / REFINEMENT)


def test_a_splats_place_settles_with_the_iterations_that_the_paper_makes() -> None:
    given, usual = paper(), MapperConfig()
    assert given.budget == 1000
    assert given.optimizer.decay_steps == 10 * usual.optimizer.decay_steps
