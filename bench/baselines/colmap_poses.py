"""Poses and sparse points by COLMAP (Schoenberger and Frahm 2016): SIFT, matching, incremental mapping.

    python -m bench.baselines.colmap_poses FOLDER [--threads N] [--photographs]

A process of its own: pycolmap brings libraries of its own, and a failed check inside it ends the process. FOLDER holds
images/NUMBER.png and camera.json (`size`, `intrinsics`); poses and points go to model.npz, times to seconds.json.
Frames of a video are matched with those around them, and their calibration is known; of photographs all pairs are
matched, and focal length and distortion, which they share, are estimated from the intrinsics as a guess.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import time
import zlib  # noqa: F401  # before pycolmap, which otherwise binds to another libz
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bench.pieces import Kept
from bench.runs import ROOT

READINGS = 2  # of each image by COLMAP: for its features, and for the colors of points


@dataclass(frozen=True)
class Model:
    """What COLMAP found, in its own frame and unit."""

    index: np.ndarray  # (N,) frames that it registered
    world_from_cam: np.ndarray  # (N, 4, 4)
    points: np.ndarray  # (M, 3)
    colors: np.ndarray  # (M, 3) uint8 RGB
    seconds: dict[str, float]  # by stage
    processor_seconds: float  # of all threads, from start to end of the process
    focal: float = float("nan")  # pixels, of photographs, where it is estimated
    solving_seconds: float = float("nan")  # of the processor, from images in memory to poses: no imports, no reading


def reconstruct(
    frames: dict[int, np.ndarray], intrinsics: np.ndarray, folder: Path, threads: int, photographs: bool = False
) -> tuple[Model | None, str]:
    """COLMAP's model of RGB images (H, W, 3) uint8 by frame index, and if there is none, why."""
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    for old in [*images.glob("*.png"), *(folder / name for name in ("model.npz", "database.db"))]:
        old.unlink(missing_ok=True)
    size = (0, 0)
    for index, image in frames.items():
        size = image.shape[0], image.shape[1]
        cv2.imwrite(str(images / f"{index:06d}.png"), image[..., ::-1])
    (folder / "camera.json").write_text(json.dumps({"size": size, "intrinsics": intrinsics.tolist()}))
    command = [sys.executable, "-m", "bench.baselines.colmap_poses", str(folder), "--threads", str(threads)]
    command += ["--photographs"] if photographs else []
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    (folder / "colmap.log").write_text(done.stdout + done.stderr)
    file = folder / "model.npz"
    if not file.exists():
        last = (done.stderr.strip().splitlines() or ["nothing said"])[-1]
        return None, f"COLMAP ended with code {done.returncode}: {last}"
    return load(folder), ""


def reconstruct_once(
    frames: dict[int, np.ndarray], intrinsics: np.ndarray, folder: Path, threads: int, kept: Kept,
    photographs: bool = False,
) -> tuple[Model | None, str]:  # fmt: skip
    """`reconstruct`, or the model that an earlier call left in the folder for the same images, where those are kept."""
    digest = hashlib.sha256(intrinsics.tobytes())
    for index, image in frames.items():
        digest.update(index.to_bytes(8, "little") + str(image.shape).encode() + image.tobytes())
    asked = {"images": digest.hexdigest(), "threads": threads, "photographs": photographs}
    file = folder / "model.npz"
    if kept.has(file, asked):
        return load(folder), ""
    model, why = reconstruct(frames, intrinsics, folder, threads, photographs)
    if model is not None:
        kept.keep(file, asked)
    return model, why


def load(folder: Path) -> Model:
    """The model that `reconstruct` left in a folder. Raises FileNotFoundError where there is none."""
    with np.load(folder / "model.npz") as arrays:
        index, poses, points, colors = (arrays[name] for name in ("index", "world_from_cam", "points", "colors"))
    times = json.loads((folder / "seconds.json").read_text())
    focal = times.get("focal", float("nan"))
    return Model(index, poses, points, colors, times["wall"], times["processor"], focal, times["solving"])


def run(folder: Path, threads: int, photographs: bool) -> None:
    """Everything from images to model.npz. Raises RuntimeError where no two images could be put together."""
    import pycolmap

    camera = json.loads((folder / "camera.json").read_text())
    fx, fy, cx, cy = camera["intrinsics"]
    reader = pycolmap.ImageReaderOptions()
    # COLMAP's first pixel is centered at 0.5
    pinhole, radial = f"{fx},{fy},{cx + 0.5},{cy + 0.5}", f"{fx},{cx + 0.5},{cy + 0.5},0,0"
    reader.camera_model, reader.camera_params = ("RADIAL", radial) if photographs else ("PINHOLE", pinhole)
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    mapping = pycolmap.IncrementalPipelineOptions()
    for options in (extraction, matching, mapping):
        options.num_threads = threads
    for name in ("ba_refine_focal_length", "ba_refine_extra_params"):
        setattr(mapping, name, photographs)  # of a video the calibration is known, to us as well
    mapping.ba_refine_principal_point = False
    mapping.random_seed = 0
    database, images, seconds = folder / "database.db", folder / "images", {}
    reading, begin = reading_seconds(images), time.process_time()
    start = time.perf_counter()
    pycolmap.extract_features(
        database, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
        extraction_options=extraction, device=pycolmap.Device.cpu,
    )  # fmt: skip
    seconds["features"] = time.perf_counter() - start
    start = time.perf_counter()
    match_all = pycolmap.match_exhaustive if photographs else pycolmap.match_sequential
    match_all(database, matching_options=matching, device=pycolmap.Device.cpu)
    seconds["matching"] = time.perf_counter() - start
    start = time.perf_counter()
    sparse = folder / "sparse"
    sparse.mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(database, images, sparse, options=mapping)
    seconds["mapping"] = time.perf_counter() - start
    solving = time.process_time() - begin - READINGS * reading
    if not models:
        raise RuntimeError("no model: no two images could be put together")
    best = max(models.values(), key=lambda model: model.num_reg_images())
    registered = [image for image in best.images.values() if image.has_pose]
    registered.sort(key=lambda image: image.name)
    poses = np.tile(np.eye(4), (len(registered), 1, 1))
    for pose, image in zip(poses, registered):
        pose[:3] = image.cam_from_world().inverse().matrix()
    points = list(best.points3D.values())
    focal = next(iter(best.cameras.values())).mean_focal_length()
    times = {"processor": time.process_time(), "solving": solving} | ({"focal": focal} if photographs else {})
    (folder / "seconds.json").write_text(json.dumps({"wall": seconds, **times}))
    np.savez(
        folder / "model.npz",
        index=np.array([int(Path(image.name).stem) for image in registered], dtype=np.int64),
        world_from_cam=poses,
        points=np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        colors=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
    )


def reading_seconds(images: Path) -> float:
    """Processor seconds of reading all of a folder once."""
    start = time.process_time()
    for file in sorted(images.glob("*.png")):
        cv2.imread(str(file))
    return time.process_time() - start


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--photographs", action="store_true", help="in any order, of an unknown lens")
    given = parser.parse_args()
    run(given.folder, given.threads, given.photographs)
