"""Camera paths: smooth, hand-held, functions of a real frame number so that an exposure can be cut into sub-frames."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mvsgs_core import geometry


class CameraPath(Protocol):
    """A camera's pose over time."""

    def pose(self, s: float) -> np.ndarray:
        """World_from_cam (4, 4) float64 in scene units at frame number s."""
        ...


def look_at(eye: np.ndarray, target: np.ndarray, north: np.ndarray | None = None) -> np.ndarray:
    """World_from_cam (4, 4): z toward the target, x level; `north` is up in the image (default: the world's z)."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, np.array([0.0, 0.0, 1.0]) if north is None else north)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


class Shake:
    """Tremor of a hand: a sum of slow and fast sines per axis, none a multiple of another."""

    def __init__(self, rng: np.random.Generator, shift: float, turn: float, loop_frames: int | None) -> None:
        """shift: scene units, turn: radians; root mean square per axis. At the ends of a loop it fades: that closes."""
        self.loop_frames = loop_frames
        self.cycles = np.geomspace(0.011, 0.16, 5)[:, None] * rng.uniform(0.8, 1.25, (5, 6))  # per frame
        self.phases = rng.uniform(0.0, 2.0 * np.pi, (5, 6))
        weights = np.geomspace(1.0, 0.12, 5)[:, None]
        self.amplitudes = weights / np.sqrt(0.5 * np.sum(weights**2)) * np.array([shift] * 3 + [turn] * 3)

    def pose(self, s: float) -> np.ndarray:
        xi = np.sum(self.amplitudes * np.sin(2.0 * np.pi * self.cycles * s + self.phases), axis=0)
        pose = geometry.se3_exp(xi)
        if self.loop_frames is None:
            return pose
        fade = np.clip(min(s, self.loop_frames - s) / 15.0, 0.0, 1.0)
        return geometry.se3_exp(fade * geometry.se3_log(pose))


class RoomPath:
    """Around the room's table, looking across it at the furniture on the far side, up and down, near and far."""

    TURN = np.radians(0.9)  # a frame
    CENTER = np.array([2.6, 2.2, 0.0])

    def __init__(self, seed: int, loop_frames: int | None = None) -> None:
        """loop_frames: come back to the first pose after so many frames; None: wander on without repeating."""
        rng = np.random.default_rng([seed, 2])
        self.shake = Shake(rng, 0.008, np.radians(0.35), loop_frames)
        self.loop_frames = loop_frames
        self.phases = rng.uniform(0.0, 2.0 * np.pi, 5)

    def pose(self, s: float) -> np.ndarray:
        if self.loop_frames is None:
            angle = -self.TURN * s
            slow = np.sin(np.array([0.0231, 0.0317, 0.0173, 0.0407, 0.0271]) * s + self.phases)
        else:
            angle = -2.0 * np.pi * s / self.loop_frames
            slow = np.sin(np.array([2, 3, 1, 4, 3]) * angle + self.phases)
        angle += 0.35
        outward = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = self.CENTER + (1.0 + 0.1 * slow[0]) * outward * (1.45, 1.12, 0.0)
        eye[2] = 1.42 + 0.16 * slow[1]
        across = angle + np.pi + 0.3 * slow[2]
        target = self.CENTER + 1.3 * np.array([np.cos(across), np.sin(across), 0.0])
        target[2] = 1.0 + 0.28 * slow[3]
        return look_at(eye, target) @ self.shake.pose(s)


class FlightPath:
    """Back and forth over the land with the camera held north, looking straight down at times and ahead at others."""

    SPEED = 1.25  # meters a frame
    REACH = np.array([85.0, 80.0])  # half the area flown over, x and y
    HEIGHT = 78.0

    def __init__(self, seed: int, loop_frames: int | None = None) -> None:
        rng = np.random.default_rng([seed, 7])
        self.shake = Shake(rng, 0.12, np.radians(0.25), loop_frames)
        self.loop_frames = loop_frames
        self.phases = rng.uniform(0.0, 2.0 * np.pi, 3)

    def pose(self, s: float) -> np.ndarray:
        if self.loop_frames is None:
            lap = 4.0 * self.REACH[1] / self.SPEED
            # Legs along y, drifting in x; the two periods have no common multiple, so that no leg is flown twice.
            place = self.REACH * np.array([_zigzag(s / (5.318 * lap) - 0.25), _zigzag(s / lap - 0.25)])
            slow = np.sin(np.array([0.0213, 0.0131, 0.0179]) * s + self.phases)
        else:
            turn = 2.0 * np.pi * s / self.loop_frames
            place = 0.8 * self.REACH * np.array([np.sin(turn), -np.cos(turn)])
            slow = np.sin(np.array([2, 1, 3]) * turn + self.phases)
        eye = np.array([*place, self.HEIGHT + 6.0 * slow[0]])
        tilt, heading = np.radians(23.0 + 17.0 * slow[1]), 0.12 * slow[2]
        ahead = np.array([np.sin(heading), np.cos(heading), 0.0])
        down = np.array([0.0, 0.0, -1.0])
        return look_at(eye, eye + np.sin(tilt) * ahead + np.cos(tilt) * down, north=ahead) @ self.shake.pose(s)


def _zigzag(t: float) -> float:
    """Triangle wave of period 1 between -1 and 1 with rounded corners; rises through 0 at t = 0."""
    sharp = 0.985
    return float(np.arcsin(sharp * np.sin(2.0 * np.pi * t)) / np.arcsin(sharp))
