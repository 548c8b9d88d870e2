"""Writes a synthetic sequence in TUM RGB-D layout.

    python -m mvsgs_core.datasets.write_tum OUTDIR --scene room --frames 100

Further options are those of the synthetic dataset, as name=value: noise=4 loop=true scale=10.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mvsgs_core.atomic_file import replace_text
from mvsgs_core.datasets import Item
from mvsgs_core.datasets.synthetic import Synthetic
from mvsgs_core.geometry import quaternion_from_rotation

UNITS_PER_METER = 5000.0  # of the 16-bit depth images, as in the original sets


def write_tum(items: Iterable[Item], folder: Path) -> int:
    """Writes the images, camera.txt, groundtruth.txt, depth.txt and, last, rgb.txt; returns how many frames.

    Raises FileExistsError if the folder has a sequence already, OSError where it cannot be written, ValueError where
    depth does not fit into 16 bits (more than 13.1 units) or is too small for their step of 0.2 thousandths.
    """
    if (folder / "rgb.txt").exists():
        raise FileExistsError(f"{folder} has a sequence already: give another folder or remove it")
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    lists = {
        "groundtruth": ["# timestamp tx ty tz qx qy qz qw, camera to world"],
        "depth": ["# depth images"],
        "rgb": ["# color images"],  # last: where it is, all is
    }
    count = 0
    for item in items:
        if item.depth is None or item.world_from_cam is None:
            raise ValueError(f"frame {item.index} has no depth or no pose")
        known = item.depth[item.depth > 0]
        if known.size and (known.max() * UNITS_PER_METER > 65535 or np.median(known) * UNITS_PER_METER < 500):
            raise ValueError(
                f"depths up to {known.max():.4g} do not fit the layout's 16 bits of 1/5000: choose scale so that they "
                "lie between about 0.1 and 13 (scene=aerial: scale=0.05)"
            )
        stamp = f"{item.timestamp:.6f}"
        _write_png(folder / "rgb" / f"{stamp}.png", item.image[:, :, ::-1])
        steps = np.round(item.depth.astype(np.float64) * UNITS_PER_METER).astype(np.uint16)
        _write_png(folder / "depth" / f"{stamp}.png", steps)
        w, x, y, z = quaternion_from_rotation(item.world_from_cam[:3, :3])
        position = " ".join(f"{v:.9g}" for v in item.world_from_cam[:3, 3])
        lists["rgb"].append(f"{stamp} rgb/{stamp}.png")
        lists["depth"].append(f"{stamp} depth/{stamp}.png")
        lists["groundtruth"].append(f"{stamp} {position} {x:.9f} {y:.9f} {z:.9f} {w:.9f}")
        if count == 0:
            (folder / "camera.txt").write_text(" ".join(f"{v:.9g}" for v in item.intrinsics) + "\n")
        count += 1
    for name, lines in lists.items():
        replace_text(folder / f"{name}.txt", "\n".join(lines) + "\n")
    return count


def _write_png(file: Path, pixels: np.ndarray) -> None:
    """Raises OSError. OpenCV writes no file itself: it does not say where the end of one finds no room on the disk."""
    _, content = cv2.imencode(".png", pixels)
    file.write_bytes(content.tobytes())


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scene", default="room")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 640), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("options", nargs="*", metavar="name=value", help="options of the synthetic dataset")
    given = parser.parse_intermixed_args(arguments)
    options: dict[str, Any] = {}
    for text in given.options:
        name, equals, value = text.partition("=")
        if not equals:
            parser.error(f"{text!r}: options are written name=value")
        try:
            options[name] = json.loads(value)
        except ValueError:
            parser.error(f"{text!r}: a value is a number, true or false")
    try:
        sequence = Synthetic(scene=given.scene, frames=given.frames, size=tuple(given.size), **options)
        count = write_tum(sequence, given.folder)
    except (ValueError, FileExistsError) as error:
        parser.error(str(error))
    except OSError as error:
        sys.exit(
            f"write_tum: {given.folder} is not whole: {error}; once it can be written, give the same command again"
        )
    print(f"{count} frames in {given.folder}; read them with dataset=tum dataset.path={given.folder}")


if __name__ == "__main__":
    main()
