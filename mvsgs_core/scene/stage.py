"""The scenes by name: what is built, lit and walked through; kept in memory, because building takes seconds."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from . import aerial, room
from .lighting import Lighting
from .materials import marbled
from .patches import blob
from .path import FlightPath, Path, RoomPath
from .renderer import SceneRenderer

SCENES = ("room", "aerial")


@dataclass(frozen=True)
class Stage:
    """A scene ready to be filmed."""

    name: str
    renderer: SceneRenderer
    path: Path
    ball: SceneRenderer  # stands at its own origin
    ball_path: tuple[np.ndarray, np.ndarray]  # ends (3,) between which it rolls, scene units


@functools.lru_cache(maxsize=4)
def renderer_of(scene: str, seed: int, textureless: int) -> SceneRenderer:
    """The scene built and lit; the same object for the same arguments."""
    if scene == "aerial":
        return SceneRenderer(aerial.build(seed, textureless), aerial.LIGHTING, seed)
    return SceneRenderer(room.build(seed, textureless), room.LIGHTING, seed)


@functools.lru_cache(maxsize=4)
def ball_of(radius: float, seed: int) -> SceneRenderer:
    """A colorful ball of a radius in scene units."""
    rng = np.random.default_rng([seed, 4])
    tones = [(196, 60, 40), (236, 214, 160), (40, 90, 140), (240, 240, 232), (60, 130, 80)]
    skin = marbled(rng, tones, density=70 / radius, grain=1.2 / radius)
    light = Lighting(texel=radius / 4, horizon=(0.5,) * 3, zenith=(0.9,) * 3, below=(0.25,) * 3)
    ball = blob((0, 0, 0), (radius, radius, radius), skin, rows=16, columns=24)
    return SceneRenderer([ball], light, seed)


def stage(scene: str, seed: int, textureless: int, loop_frames: int | None, moving_object: float) -> Stage:
    """Raises ValueError for an unknown scene."""
    if scene not in SCENES:
        raise ValueError(f"no scene {scene!r}; there are: {', '.join(SCENES)}")
    size = max(moving_object, 0.01)
    renderer = renderer_of(scene, seed, textureless)
    if scene == "aerial":
        ends = (np.array([-90.0, -60.0, 22.0]), np.array([90.0, 80.0, 22.0]))
        return Stage(scene, renderer, FlightPath(seed, loop_frames), ball_of(5.0 * size, seed), ends)
    ends = (np.array([0.9, 1.0, 0.5]), np.array([4.3, 3.5, 0.5]))
    return Stage(scene, renderer, RoomPath(seed, loop_frames), ball_of(0.2 * size, seed), ends)
