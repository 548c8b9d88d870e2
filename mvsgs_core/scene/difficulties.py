"""What makes reconstruction hard: switches of the synthetic scene, all off by default, and the camera that has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.scene.path import CameraPath


@dataclass(frozen=True)
class Difficulties:
    """Each switch and its strength; 0 is off. Frames count in the stream before start, stop and stride."""

    textureless: int = 0  # bare walls, 0 to 4; quarters of the fields, or of the fronts, without texture
    pure_rotation: int = 0  # frames during which the camera only turns, about its center
    pure_rotation_start: int = 0  # first of them
    rest: int = 0  # frames during which the camera stands perfectly still
    rest_start: int = 40  # first of them
    covered: int = 0  # frames with the lens covered
    covered_start: int = 60  # first of them
    jump: int = 0  # frames of the path that are missing at once: the view jumps
    jump_start: int = 60  # first frame after the jump
    drop: float = 0.0  # fraction of frames lost at random, 0 to 1; their time stamps are missing
    motion_blur: float = 0.0  # exposure time as a fraction of the time between two frames, 0 to 1
    rolling_shutter: float = 0.0  # readout time as a fraction of the time between two frames, 0 to 1
    rolling_columns: float = 0.0  # the same of a camera that is held upright, which reads columns
    exposure: float = 0.0  # brightness drifts by up to so many stops up and down
    white_balance: float = 0.0  # red against blue drifts by up to so many stops either way
    vignetting: float = 0.0  # part of the light that is missing in the corners, 0 to 1
    response: float = 0.0  # offset o of a response (1 + o) light^(1 / 2.4) - o in place of sRGB's; sRGB's is 0.055
    noise: float = 0.0  # standard deviation of the sensor's noise at mid gray, 8-bit levels
    gloss: float = 0.0  # strength of highlights, 1 is plausible: surfaces that change with the view
    moving_object: float = 0.0  # a ball of so many times its usual size swings and bounces through the view
    origin: float = 0.0  # added to all world coordinates
    scale: float = 1.0  # multiplies all world lengths

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, bool) or not np.isfinite(value):
                raise ValueError(f"{f.name}: {value!r} is no number; it is a strength, 0 is off")
            if f.name not in ("origin", "scale") and value < 0:
                raise ValueError(f"{f.name}: {value} is negative; 0 is off")
        if self.scale <= 0:
            raise ValueError(f"scale: {self.scale} must be positive")
        if self.rolling_shutter and self.rolling_columns:
            raise ValueError("rolling_columns: a camera that has a rolling_shutter reads rows")
        limits = {"drop": 0.95, "motion_blur": 1.0, "rolling_shutter": 1.0, "rolling_columns": 1.0, "textureless": 4}
        for name, limit in (limits | {"vignetting": 0.95, "response": 1.0}).items():
            if getattr(self, name) > limit:
                raise ValueError(f"{name}: {getattr(self, name)} is more than {limit}")


class DifficultPath:
    """A path with a stop, a stretch of pure rotation and a jump put in; other frames follow one another smoothly."""

    SWEEP = np.radians(30.0)  # the camera turns so far to either side and back while it only turns

    def __init__(self, path: CameraPath, difficulties: Difficulties) -> None:
        self.path = path
        self.difficulties = difficulties

    def pose(self, s: float, frame: int | None = None) -> np.ndarray:
        """(4, 4) world from camera at time s, in frames. frame: whose exposure or readout this instant is of, which
        lies on one side of a jump as a whole; None: of the one at s."""
        d = self.difficulties
        of, _ = _without(s if frame is None else frame, d.rest_start, d.rest)
        s, _ = _without(s, d.rest_start, d.rest)
        if d.jump and of >= d.jump_start:
            s += d.jump
        s, turning = _without(s, d.pure_rotation_start, d.pure_rotation)
        pose = self.path.pose(s)
        if turning is not None:
            yaw = self.SWEEP * np.sin(2.0 * np.pi * turning) * np.sin(np.pi * turning)
            nod = 0.3 * self.SWEEP * np.sin(4.0 * np.pi * turning) * np.sin(np.pi * turning)
            pose = pose.copy()
            pose[:3, :3] = pose[:3, :3] @ geometry.so3_exp(np.array([nod, yaw, 0.0]))
        return pose


def _without(s: float, start: int, length: int) -> tuple[float, float | None]:
    """Frame number with the stretch taken out, and how far into it `s` is, 0 to 1 (None outside)."""
    if length <= 0 or s < start:
        return s, None
    if s < start + length:
        return float(start), (s - start) / length
    return s - length, None


class Sensor:
    """From linear light to the image that a camera gives: exposure, response curve, noise of its own a frame."""

    STEPS = 8192

    def __init__(self, difficulties: Difficulties, seed: int) -> None:
        self.difficulties = difficulties
        self.seed = seed
        light = np.linspace(0.0, 4.0, self.STEPS + 1)
        # Highlights roll off instead of clipping hard, as every camera's curve does.
        knee = 0.72
        curve = np.where(light < knee, light, knee + (1 - knee) * (1 - np.exp(-(light - knee) / (1 - knee))))
        o = difficulties.response
        encoded = np.where(curve <= 0.0031308, 12.92 * curve, 1.055 * curve ** (1 / 2.4) - 0.055)
        if o > 0:
            encoded = np.maximum((1.0 + o) * curve ** (1 / 2.4) - o, 0.0)
        self.curve = (255.0 * encoded).astype(np.float32)

    def gain(self, s: float) -> float:
        """Factor of the light at frame s."""
        phase = self.seed % 7
        stops = 0.6 * np.sin(2 * np.pi * s / 47.0 + phase) + 0.4 * np.sin(2 * np.pi * s / 29.0 + 2.0 * phase)
        return float(2.0 ** (self.difficulties.exposure * stops))

    def white(self, s: float) -> np.ndarray:
        """(3,) factors of red, green and blue light at frame s."""
        stops = self.difficulties.white_balance * np.sin(2 * np.pi * s / 61.0 + self.seed % 5)
        return np.asarray(2.0 ** (stops * np.array([0.5, 0.0, -0.5])))

    def transferred(self, levels: np.ndarray, s: int, mean: Sequence[int]) -> np.ndarray:
        """(3, L) what gray levels (L,), 0 to 1, of the mean camera of frames `mean` are at frame s, by channel."""
        scale = np.linspace(0.0, 4.0, self.STEPS + 1)
        light = np.geomspace(1e-4, 4.0, 4000)

        def shown(gain: float) -> np.ndarray:
            return np.asarray(np.interp(light * gain, scale, self.curve) / 255.0)

        usual = np.exp(np.mean([np.log(self.gain(k) * self.white(k)) for k in mean], axis=0))
        here = self.gain(s) * self.white(s)
        return np.array([np.interp(np.interp(levels, shown(u), light), light, shown(h)) for u, h in zip(usual, here)])

    def falloff(self, height: int, width: int) -> np.ndarray:
        """(height, width) factor of the light by vignetting: a parabola of the distance from the middle."""
        v, u = np.mgrid[:height, :width]
        square = (u - (width - 1) / 2) ** 2 + (v - (height - 1) / 2) ** 2
        return np.asarray(1.0 - self.difficulties.vignetting * square / (0.25 * (height**2 + width**2)))

    def image(self, light: np.ndarray, s: int, covered: bool = False) -> np.ndarray:
        """(H, W, 3) uint8 RGB of linear light (H, W, 3) at frame s."""
        light = np.zeros_like(light) if covered else light * np.float32(self.gain(s))
        if self.difficulties.white_balance > 0:
            light = light * self.white(s).astype(np.float32)
        if self.difficulties.vignetting > 0:
            light = light * self.falloff(*light.shape[:2])[..., None].astype(np.float32)
        steps = np.clip(light * (self.STEPS / 4.0) + 0.5, 0, self.STEPS).astype(np.int32)
        values = self.curve[steps]
        if self.difficulties.noise > 0:
            rng = np.random.default_rng([self.seed, 3, s])
            # Shot noise on a gamma-coded scale grows slowly with the light; a floor stays in the dark.
            sigma = self.difficulties.noise * np.sqrt(0.25 + 0.75 * values / 128.0)
            values = values + sigma * rng.standard_normal(values.shape, dtype=np.float32)
        return np.clip(values + 0.5, 0, 255).astype(np.uint8)
