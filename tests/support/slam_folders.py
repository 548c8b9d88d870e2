"""Small sequences on disk in the layouts of EuRoC, TUM VI, KITTI, ScanNet and TartanAir, beside `dataset_folders`."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from mvsgs_core.geometry import inverse, quaternion_from_rotation, so3_exp
from tests.support.dataset_folders import HEIGHT, WIDTH, pose, write_depth, write_image

START = 1403636579763555584  # nanoseconds
BODY_FROM_CAM = np.eye(4)
BODY_FROM_CAM[:3, :3] = so3_exp(np.array([0.3, -1.2, 0.5]))
BODY_FROM_CAM[:3, 3] = -0.02, -0.06, 0.01
DRIFTS = pose(0)  # where KITTI's color camera is beside its left gray one
DRIFTS[:3, 3] = -0.06, 0.01, 0.002


def _write_list(folder: Path, frames: int) -> list[int]:
    times = [START + i * 50_000_000 for i in range(frames)]
    folder.mkdir(parents=True, exist_ok=True)
    lines = "".join(f"{time},{time}.png\r\n" for time in times)
    (folder / "data.csv").write_text("#timestamp [ns],filename\r\n" + lines)
    return times


def _write_truth(folder: Path, frames: int) -> None:
    """Of the body, at 200 Hz; the camera moves by 1 a frame."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_x"]
    for step in range(10 * frames):
        world_from_cam = np.eye(4)
        world_from_cam[0, 3] = step / 10
        body = world_from_cam @ inverse(BODY_FROM_CAM)
        values = [*body[:3, 3], *quaternion_from_rotation(body[:3, :3]), 0.5]
        lines.append(",".join([str(START + step * 5_000_000), *(f"{v:.9f}" for v in values)]))
    (folder / "data.csv").write_text("\n".join(lines) + "\n")


def write_euroc(folder: Path, frames: int = 5, camera: int = 0) -> Path:
    cam = folder / f"mav0/cam{camera}"
    for i, time in enumerate(_write_list(cam, frames)):
        image = Image.fromarray(np.full((HEIGHT, WIDTH), 20 + i, dtype=np.uint8))
        (cam / "data").mkdir(exist_ok=True)
        image.save(cam / f"data/{time}.png")
    data = ", ".join(f"{v:.12f}" for v in BODY_FROM_CAM.ravel())
    (cam / "sensor.yaml").write_text(
        "%YAML:1.0\n# General sensor definitions.\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
        f"  data: [{data.replace('1.000000000000', '1.0')}]\nrate_hz: 20\nresolution: [{WIDTH}, {HEIGHT}]\n"
        "camera_model: pinhole\nintrinsics: [40.0, 40.0, 31.5, 23.5] #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0002, 2e-05]\n"
    )
    _write_truth(folder / "mav0/state_groundtruth_estimate0", frames)
    return folder


def write_tum_vi(folder: Path, frames: int = 5) -> Path:
    cam = folder / "mav0/cam0"
    for i, time in enumerate(_write_list(cam, frames)):
        (cam / "data").mkdir(exist_ok=True)
        Image.fromarray(np.full((HEIGHT, WIDTH), (20 + i) << 8, dtype=np.uint16)).save(cam / f"data/{time}.png")
    rows = "".join(f"  - {[float(v) for v in row]}\n" for row in inverse(BODY_FROM_CAM))
    (folder / "dso").mkdir()
    (folder / "dso/camchain.yaml").write_text(
        f"cam0:\n  T_cam_imu:\n{rows}  cam_overlaps: [1]\n  camera_model: pinhole\n"
        "  distortion_coeffs: [0.003, 0.0007, -0.002, 0.0002]\n  distortion_model: equidistant\n"
        f"  intrinsics: [30.0, 30.0, 31.5, 23.5]\n  resolution: [{WIDTH}, {HEIGHT}]\n  rostopic: /cam0/image_raw\n"
    )
    _write_truth(folder / "mav0/mocap0", frames)
    return folder


def write_kitti(root: Path, frames: int = 4) -> Path:
    """The folder of sequence 07: gray images are lighter by 100, the color camera stands at `DRIFTS`."""
    folder = root / "sequences/07"
    for i in range(frames):
        write_image(folder / f"image_2/{i:06d}.png", 20 + i)
        write_image(folder / f"image_0/{i:06d}.png", 120 + i)
    k = np.array([[50.0, 0, 31], [0, 51, 23], [0, 0, 1]])
    projections = {"P0": np.zeros(3), "P2": -DRIFTS[:3, 3]}
    lines = [f"{n}: " + " ".join(map(str, (k @ np.c_[np.eye(3), t]).ravel())) for n, t in projections.items()]
    (folder / "calib.txt").write_text("\n".join([*lines, "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"]) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.104 * i:e}\n" for i in range(frames)))
    (root / "poses").mkdir()
    poses = "".join(" ".join(map(str, pose(i)[:3].ravel())) + "\n" for i in range(frames))
    (root / "poses/07.txt").write_text(poses)
    return folder


def write_scannet(folder: Path, frames: int = 12) -> Path:
    """Color of 192x256 pixels, depth of 2 m in 96x128; image 1 was lost."""
    for i in range(frames):
        write_image(folder / f"color/{i}.png", 20 + i, (192, 256))
        write_depth(folder / f"depth/{i}.png", 2000, (96, 128))
        (folder / "pose").mkdir(exist_ok=True)
        text = "-inf " * 16 if i == 1 else "\n".join(" ".join(map(str, row)) for row in pose(i))
        (folder / f"pose/{i}.txt").write_text(text)
    (folder / "intrinsic").mkdir()
    for name, focal, middle in (("color", 200, (127.5, 95.5)), ("depth", 110, (63.5, 47.5))):
        k = np.eye(4)
        k[0, 0], k[1, 1], k[:2, 2] = focal, focal, middle
        (folder / f"intrinsic/intrinsic_{name}.txt").write_text("\n".join(" ".join(map(str, row)) for row in k))
    return folder


def write_sens(path: Path, frames: int = 4) -> Path:
    """What `write_scannet` writes, in one file: color as PNG, depth by zlib; image 1 was lost."""

    def camera(focal: float, middle: tuple[float, float]) -> bytes:
        k = np.eye(4, dtype="<f4")
        k[0, 0], k[1, 1], k[:2, 2] = focal, focal, middle
        return k.tobytes() + np.eye(4, dtype="<f4").tobytes()

    name = b"StructureSensor"
    parts = [struct.pack("<IQ", 4, len(name)), name, camera(200, (127.5, 95.5)), camera(110, (63.5, 47.5))]
    parts.append(struct.pack("<iiIIIIfQ", 1, 1, 256, 192, 128, 96, 1000.0, frames))
    for i in range(frames):
        color = BytesIO()
        Image.fromarray(np.full((192, 256, 3), 20 + i, dtype=np.uint8)).save(color, "png")
        depth = zlib.compress(np.full((96, 128), 2000, dtype="<u2").tobytes())
        world_from_cam = np.full((4, 4), -np.inf) if i == 1 else pose(i)
        parts.append(world_from_cam.astype("<f4").tobytes())
        parts += [struct.pack("<QQQQ", 0, 0, len(color.getvalue()), len(depth)), color.getvalue(), depth]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(parts))
    return path


def write_kitti_raw(root: Path, frames: int = 4) -> Path:
    """The folder of a drive, 100 m to the east a frame along the equator, heading east; image 1 was lost.

    The color camera stands .06 m to the left of the gray one; the inertial unit's axes are forward, left, up, the
    laser's are too, 1 m above it.
    """
    day = root / "2011_09_26"
    folder = day / "2011_09_26_drive_0001_sync"
    for i in (k for k in range(frames) if k != 1):
        write_image(folder / f"image_02/data/{i:010d}.png", 20 + i)
    times = [f"2011-09-26 13:02:25.{594360375 + 100000000 * i:09d}\n" for i in range(frames)]
    (folder / "image_02/timestamps.txt").write_text("".join(times))
    (folder / "oxts/data").mkdir(parents=True)
    for i in range(frames):
        east = np.degrees(100.0 * i / 6378137.0)
        values = [0.0, east, 116.0, 0.0, 0.0, 0.0, *[0.0] * 24]
        (folder / f"oxts/data/{i:010d}.txt").write_text(" ".join(map(str, values)))
    (day / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\nR_rect_00: 1 0 0 0 1 0 0 0 1\n"
        "P_rect_02: 50 0 31 3 0 51 23 0 0 0 1 0\n"  # 3 / 50 m to the right is what the camera sees moved
    )
    (day / "calib_velo_to_cam.txt").write_text("calib_time: x\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")
    (day / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: 0 0 -1\n")
    return folder


def write_tartanair(folder: Path, camera: str = "left", frames: int = 3) -> Path:
    """A trajectory going 1 m north a frame, that looks north and then turns to the east; depth of 2 m."""
    for i in range(frames):
        write_image(folder / f"image_{camera}/{i:06d}_{camera}.png", 20 + i)
        depth = np.full((48, 64), 2.0, np.float32)
        depth[0] = 10000.0  # the sky
        path = folder / f"depth_{camera}/{i:06d}_{camera}_depth.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        if camera == "left":
            np.save(path, depth)
        else:
            bgra = np.ascontiguousarray(depth[..., None]).view(np.uint8)
            Image.fromarray(np.ascontiguousarray(bgra[..., [2, 1, 0, 3]])).save(path.with_suffix(".png"))
    turns = [np.sqrt(0.5) if i == frames - 1 else 0.0 for i in range(frames)]
    lines = [f"{i} 0 -2 0 0 {turn} {np.sqrt(1 - turn**2)}" for i, turn in enumerate(turns)]
    (folder / f"pose_{camera}.txt").write_text("\n".join(lines))
    return folder
