"""The scenes by name: what is built, lit and walked through; kept in memory and on disk, as building takes seconds."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.scene import aerial, room, town
from mvsgs_core.scene.drive import TownPath
from mvsgs_core.scene.kept import kept
from mvsgs_core.scene.lighting import Lighting
from mvsgs_core.scene.lit import LitScene, lit
from mvsgs_core.scene.materials import marbled
from mvsgs_core.scene.patches import blob
from mvsgs_core.scene.path import CameraPath, FlightPath, RoomPath
from mvsgs_core.scene.renderer import SceneRenderer

SCENES = ("room", "aerial", "town")


@dataclass(frozen=True)
class Stage:
    """A scene ready to be filmed."""

    # scene units of one unit of the ball's swing
    REACH: ClassVar[dict[str, float]] = {"room": 0.12, "aerial": 4.0, "town": 0.25}
    name: str
    renderer: SceneRenderer
    path: CameraPath
    ball: SceneRenderer  # stands at its own origin
    focus: np.ndarray  # (3,) the middle of where it moves, scene units; relative to the camera outdoors

    def world_from_ball(self, s: float, world_from_cam: np.ndarray) -> np.ndarray:
        """Pose (4, 4) of the ball at frame s: it swings and bounces over the table, or ahead of the camera."""
        swing = np.array([6.0 * np.sin(2.0 * np.pi * s / 90.0), 4.5 * np.sin(2.0 * np.pi * s / 127.0), 0.0])
        swing[2] = 4.0 * abs(np.sin(2.0 * np.pi * s / 34.0))
        pose = np.eye(4)
        pose[:3, :3] = geometry.so3_exp(np.array([0.09 * s, 0.05 * s, 0.02 * s]))
        pose[:3, 3] = self.focus + self.REACH[self.name] * swing
        if self.name == "aerial":
            pose[:2, 3] += world_from_cam[:2, 3]
        elif self.name == "town":
            pose[:2, 3] += world_from_cam[:2, 3] + 9.0 * world_from_cam[:2, 2]
        return pose


@functools.lru_cache(maxsize=4)
def renderer_of(scene: str, seed: int, textureless: int, streets: int = town.STREETS) -> SceneRenderer:
    """The scene built and lit; the same object for the same arguments. streets: of a town."""

    def build() -> LitScene:
        if scene == "aerial":
            return lit(aerial.build(seed, textureless), aerial.LIGHTING, seed)
        if scene == "town":
            return lit(town.build(seed, textureless, streets), town.LIGHTING, seed)
        return lit(room.build(seed, textureless), room.LIGHTING, seed)

    return SceneRenderer(kept(f"{scene} {seed} {textureless} {streets if scene == 'town' else ''}", build))


@functools.lru_cache(maxsize=4)
def ball_of(radius: float, seed: int) -> SceneRenderer:
    """A colorful ball of a radius in scene units."""
    rng = np.random.default_rng([seed, 4])
    tones = [(196, 60, 40), (236, 214, 160), (40, 90, 140), (240, 240, 232), (60, 130, 80)]
    skin = marbled(rng, tones, density=70 / radius, grain=1.2 / radius)
    light = Lighting(texel=radius / 4, horizon=(0.5,) * 3, zenith=(0.9,) * 3, below=(0.25,) * 3)
    ball = blob((0, 0, 0), (radius, radius, radius), skin, rows=16, columns=24)
    return SceneRenderer(lit([ball], light, seed))


def stage(
    scene: str,
    seed: int,
    textureless: int,
    loop_frames: int | None,
    moving_object: float,
    streets: int = town.STREETS,
) -> Stage:
    """streets: of a town. Raises ValueError for an unknown scene."""
    if scene not in SCENES:
        raise ValueError(f"no scene {scene!r}; there are: {', '.join(SCENES)}")
    size = max(moving_object, 0.01)
    renderer = renderer_of(scene, seed, textureless, streets)
    if scene == "aerial":
        path: CameraPath = FlightPath(seed, loop_frames)
        return Stage(scene, renderer, path, ball_of(5.0 * size, seed), np.array([0.0, 30.0, 15.0]))
    if scene == "town":
        path = TownPath(seed, loop_frames, streets)
        return Stage(scene, renderer, path, ball_of(0.5 * size, seed), np.array([0.0, 0.0, 0.8]))
    return Stage(scene, renderer, RoomPath(seed, loop_frames), ball_of(0.13 * size, seed), np.array([2.6, 2.2, 1.1]))
