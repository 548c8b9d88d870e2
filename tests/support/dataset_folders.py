"""Small sequences on disk, in the layouts that the readers take. Frame i is gray 20 + i, its camera stands at x = i."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from mvsgs_core.geometry import inverse, quaternion_from_rotation, so3_exp

HEIGHT, WIDTH = 48, 64


def write_image(path: Path, value: int, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((*size, 3), value, dtype=np.uint8)).save(path)


def write_depth(path: Path, counts: int, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full(size, counts, dtype=np.uint16)).save(path)


def truncate(path: Path, share: float = 0.6) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def pose(i: int) -> np.ndarray:
    result = np.eye(4)
    result[0, 3] = i
    return result


def write_tum(folder: Path, frames: int = 5) -> Path:
    """At 10 frames a second; depth 2 m for even frames, 4 ms late; poses at 100 Hz."""
    rgb = [(i / 10, f"rgb/{i}.png") for i in range(frames)]
    for i, (_, name) in enumerate(rgb):
        write_image(folder / name, 20 + i)
    depth = [(i / 10 + 0.004, f"depth/{i}.png") for i in range(0, frames, 2)]
    for _, name in depth:
        write_depth(folder / name, 10000)
    (folder / "rgb.txt").write_text("# color\n" + "".join(f"{t:.4f} {name}\n" for t, name in rgb))
    (folder / "depth.txt").write_text("# depth\n" + "".join(f"{t:.4f} {name}\n" for t, name in depth))
    times = np.arange(0, frames / 10, 0.01)
    lines = "".join(f"{t:.4f} {10 * t:.6f} 0 0 0 0 0 1\n" for t in times)
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + lines)
    return folder


def write_replica(folder: Path, frames: int = 4) -> Path:
    for i in range(frames):
        write_image(folder / f"results/frame{i:06d}.png", 20 + i, (68, 120))
        write_depth(folder / f"results/depth{i:06d}.png", 13107, (68, 120))
    (folder / "traj.txt").write_text("\n".join(" ".join(map(str, pose(i).ravel())) for i in range(frames)))
    return folder


def write_seven_scenes(folder: Path, frames: int = 4) -> Path:
    for i in range(frames):
        stem = folder / f"seq-01/frame-{i:06d}"
        write_image(stem.with_suffix(".color.png"), 20 + i, (480, 640))
        write_depth(stem.with_suffix(".depth.png"), 65535 if i == 1 else 2000, (480, 640))
        stem.with_suffix(".pose.txt").write_text("\n".join("\t".join(map(str, row)) for row in pose(i)))
    return folder


def write_icl_nuim(folder: Path, frames: int = 12) -> Path:
    for i in range(frames):
        write_image(folder / f"rgb/{i}.png", 20 + i)
        write_depth(folder / f"depth/{i}.png", 10000)
    (folder / "groundtruth.txt").write_text("".join(f"{i} {i} 7 0 0.1 0.2 0.3 0.9\n" for i in range(1, frames)))
    return folder


def write_photos(folder: Path, frames: int = 11, suffix: str = ".png") -> Path:
    for i in range(frames):
        write_image(folder / f"photo{i}{suffix}", 20 + i)
    return folder


def huge_png(path: Path, width: int = 30_000, height: int = 30_000) -> None:
    """66 bytes that promise 900 million pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")[:1]))


def _turned(i: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = so3_exp(np.array([0.1 * i, -0.2, 0.3]))
    pose[:3, 3] = (i, 2.0, -i)
    return pose


POSES = [_turned(i) for i in range(4)]  # of photographs' models


def colmap_text(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("# cameras\n1 PINHOLE 64 48 50 51 32 24\n")
    lines = ["# images"]
    for i, name in enumerate(names):
        cam_from_world = inverse(POSES[i])
        q = quaternion_from_rotation(cam_from_world[:3, :3])
        lines.append(" ".join(map(str, [i + 1, *q, *cam_from_world[:3, 3], 1, name])))
        lines.append("1.5 2.5 -1 3 4 7" if i % 2 else "")  # an image without points has an empty line
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
