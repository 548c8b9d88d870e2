"""The embedded scene, rendered on the fly: exact poses, exact depth, any view, and switches for what is difficult."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from mvsgs_core.datasets import Item, dataset
from mvsgs_core.datasets.framing import target_size
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.scene import town
from mvsgs_core.scene.difficulties import Difficulties, DifficultPath, Sensor
from mvsgs_core.scene.renderer import Rendering
from mvsgs_core.scene.stage import SCENES, stage

FPS = 20.0
SIZE = (240, 320)  # height, width
FOCAL = 0.8  # of the image's width: a field of view of 64 degrees
SUB_FRAMES = 8  # averaged over one exposure
STRIP = 8  # rows that are read out at once


@dataclass(kw_only=True, eq=False)
class Film:
    """What is filmed, without what makes it hard."""

    scene: Literal["room", "aerial", "town"] = "room"
    frames: int = 120  # length of the stream, at 20 a second
    size: tuple[int, int] | int = SIZE  # height, width; or at most so many pixels
    start: int = 0  # first frame of the stream
    stop: int | None = None  # frame to stop before; null: the end
    stride: int = 1  # every which frame
    seed: int = 0  # of textures, relief and noise
    loop: bool = False  # the last frame leads on to the first
    threads: int = 0  # of the renderer; 0: what OpenMP gives
    streets: int = town.STREETS  # of the town in either direction, an even number; building takes their square


@dataset
class Synthetic:
    """A sequence through the room, over the landscape or along the streets of the town."""

    OPTIONS = (Film, Difficulties)

    def __init__(self, **options: Any) -> None:
        """options: the fields of `Film` and of `Difficulties`. Raises ValueError for a bad one, with the valid ones."""
        film, self.difficulties = self.checked(**options)
        scene, frames, seed, loop = film.scene, film.frames, film.seed, film.loop
        self.warnings: list[str] = []
        self.size = target_size(film.size, SIZE)
        self.seed = seed
        self.threads = film.threads
        self.intrinsics = np.array(
            [FOCAL * self.size[1], FOCAL * self.size[1], (self.size[1] - 1) / 2, (self.size[0] - 1) / 2]
        )
        d = self.difficulties
        moving = frames - min(d.rest, frames) - min(d.pure_rotation, frames) + d.jump
        lap = max(1, moving) if loop else None
        self.stage = stage(scene, seed, d.textureless, lap, d.moving_object, film.streets)
        if loop and moving < 240:
            self.warnings.append(f"synthetic: a loop of {moving} frames is fast; take at least 240")
        self.path = DifficultPath(self.stage.path, d)
        self.sensor = Sensor(d, seed)
        lost = np.random.default_rng([seed, 5]).random(frames) < d.drop
        self.numbers = [n for n in range(frames)[film.start : film.stop : film.stride] if not lost[n]]

    @classmethod
    def checked(cls, **options: Any) -> tuple[Film, Difficulties]:
        """What is filmed and what makes it hard, with nothing made yet. Raises what making it does."""
        own, known = ({f.name for f in fields(kind)} for kind in cls.OPTIONS)
        unknown = sorted(options.keys() - own - known)
        if unknown:
            there = ", ".join(f.name for kind in cls.OPTIONS for f in fields(kind))
            raise ValueError(
                f"synthetic, the scene that is mapped where no input is given: no option {', '.join(unknown)}; "
                f"there are: {there}"
            )
        film = Film(**{k: v for k, v in options.items() if k in own})
        film.size = target_size(film.size, SIZE)
        if film.scene not in SCENES:
            raise ValueError(f"synthetic: no scene {film.scene!r}; there are: {', '.join(SCENES)}")
        if film.frames < 1 or film.stride < 1 or film.start < 0 or film.seed < 0:
            raise ValueError("synthetic: frames and stride at least 1, start and seed at least 0")
        if film.streets < 2 or film.streets % 2:
            raise ValueError("synthetic: streets must be an even number, so that the outer ones make a ring")
        return film, Difficulties(**{k: v for k, v in options.items() if k in known and v is not None})

    @property
    def lens(self) -> Lens:
        fx, fy, cx, cy = self.intrinsics.tolist()
        return Lens((fx, fy, cx, cy), self.size)

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[Item]:
        for index, _ in enumerate(self.numbers):
            yield self[index]

    def __getitem__(self, index: int) -> Item:
        """Frame `index` of the sequence; the same whichever frames were read before."""
        n = self.numbers[index]
        d = self.difficulties
        pose = self.path.pose(n)
        at_once = not (d.motion_blur > 0 or d.rolling_shutter > 0 or d.rolling_columns > 0)
        view = self._view(pose, self.intrinsics, self.size, n, color=at_once)
        light = view.color
        if d.motion_blur > 0:
            # The exposure is centered on the frame's time, where pose and depth are exact.
            offsets = d.motion_blur * ((np.arange(SUB_FRAMES) + 0.5) / SUB_FRAMES - 0.5)
            light = np.asarray(np.mean([self._light(n, o) for o in offsets], axis=0, dtype=np.float32))
        elif not at_once:
            light = self._light(n)
        covered = d.covered > 0 and d.covered_start <= n < d.covered_start + d.covered
        return Item(
            index=index,
            timestamp=n / FPS,
            image=self.sensor.image(light, n, covered),
            intrinsics=self.intrinsics.copy(),
            world_from_cam=self._to_world(pose),
            depth=view.depth * np.float32(d.scale),
        )

    def render(
        self, world_from_cam: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Any view: image (H, W, 3) uint8 RGB, without noise, blur or exposure drift, and depth (H, W) float32.

        world_from_cam (4, 4) in the world of the items' poses (origin and scale included), intrinsics (4,) at `size`.
        """
        d = self.difficulties
        pose = np.array(world_from_cam, dtype=np.float64)
        pose[:3, 3] = (pose[:3, 3] - d.origin) / d.scale
        view = self.stage.renderer.render(pose, intrinsics, size, gloss=d.gloss, threads=self.threads)
        return Sensor(Difficulties(), self.seed).image(view.color, 0), view.depth * np.float32(d.scale)

    def _light(self, n: int, offset: float = 0.0) -> np.ndarray:
        """(H, W, 3) float32 of an instant of frame n, `offset` frames from its time; of a rolling shutter, whose middle
        row or column is read then."""
        d, s = self.difficulties, n + offset
        readout_time, axis = d.rolling_shutter or d.rolling_columns, 1 if d.rolling_columns else 0
        if readout_time == 0:
            return self._view(self.path.pose(s, n), self.intrinsics, self.size, s, depth=False).color
        strips, lines = [], self.size[axis]
        for first in range(0, lines, STRIP):
            count = min(STRIP, lines - first)
            at = s + readout_time * ((first + (count - 1) / 2) / lines - 0.5)
            lens, size = self.intrinsics.copy(), (self.size[0], count) if axis else (count, self.size[1])
            lens[3 - axis] -= first
            strips.append(self._view(self.path.pose(at, n), lens, size, at, depth=False).color)
        return np.concatenate(strips, axis)

    def _view(
        self, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], s: float, color: bool = True,
        depth: bool = True,
    ) -> Rendering:  # fmt: skip
        d = self.difficulties
        moving = d.moving_object > 0
        return self.stage.renderer.render(
            pose,
            intrinsics,
            size,
            gloss=d.gloss,
            mover=self.stage.ball if moving else None,
            world_from_mover=self.stage.world_from_ball(s, pose) if moving else None,
            threads=self.threads,
            color=color,
            depth=depth,
        )

    def _to_world(self, pose: np.ndarray) -> np.ndarray:
        world = pose.copy()
        world[:3, 3] = pose[:3, 3] * self.difficulties.scale + self.difficulties.origin
        return world
