"""Small sound inputs of every kind that is read from files, to be mutated. Made here, so that no data is needed."""

from __future__ import annotations

import json
import sqlite3
import struct
import zlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import Writer
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from msgs import Frame, GroundTruth
from msgs.codec import encode
from mvsgs_core.export.cameras import Cameras, write_cameras
from mvsgs_core.export.ply import write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping.checkpoints.files import state_file, write_state
from mvsgs_core.rasterizer.splats import Splats
from nodes.recorder import COMPRESSION, ENCODING

HEIGHT, WIDTH, FRAMES = 24, 32, 4
_FOCAL = 30.0
_POSE = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
_EXIF_IFD, _FOCAL_35MM, _ORIENTATION = 0x8769, 0xA405, 0x0112


def picture(number: int) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) uint8: smooth, so that it compresses as photographs do, with a little noise."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    smooth = np.stack([4 * x + number, 6 * y, 2 * (x + y)], axis=-1)
    return (smooth + np.random.default_rng(number).integers(0, 4, smooth.shape)).astype(np.uint8)


def _depth(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((HEIGHT, WIDTH), 5000, np.uint16)).save(path)


def _photos(folder: Path, names: list[str]) -> None:
    for number, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        exif = Image.Exif()
        exif[_ORIENTATION] = 1
        exif.get_ifd(_EXIF_IFD)[_FOCAL_35MM] = 26
        known: dict[str, Any] = {"exif": exif} if path.suffix in (".jpg", ".png", ".webp") else {}
        Image.fromarray(picture(number)).save(path, **known)


def images(folder: Path) -> None:
    _photos(folder, ["0.jpg", "1.png", "2.tif", "3.webp", "4.bmp", "5.ppm"])


def transforms(folder: Path) -> None:
    _photos(folder, ["0.jpg", "1.jpg"])
    frames = [{"file_path": f"./{i}.jpg", "transform_matrix": np.eye(4).tolist()} for i in range(2)]
    camera = {"fl_x": _FOCAL, "fl_y": _FOCAL, "cx": 16.0, "cy": 12.0, "w": WIDTH, "h": HEIGHT, "k1": 0.01, "k2": 0.0}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}, indent=1))


def colmap_text(folder: Path) -> None:
    _photos(folder, ["images/0.jpg", "images/1.jpg"])
    (folder / "sparse").mkdir()
    (folder / "sparse/cameras.txt").write_text(f"# cameras\n1 OPENCV {WIDTH} {HEIGHT} 30 30 16 12 0.01 0 0 0\n")
    lines = [f"{i + 1} 1 0 0 0 {i} 0 0 1 {i}.jpg\n1.5 2.5 -1\n" for i in range(2)]
    (folder / "sparse/images.txt").write_text("# images\n" + "".join(lines))


def colmap_binary(folder: Path) -> None:
    _photos(folder, ["images/0.jpg", "images/1.jpg"])
    (folder / "sparse").mkdir()
    camera = struct.pack("<QiiQQ4d", 1, 1, 1, WIDTH, HEIGHT, 30, 30, 16, 12)
    (folder / "sparse/cameras.bin").write_bytes(camera)
    shots = [
        struct.pack("<i7di", i + 1, 1, 0, 0, 0, i, 0, 0, 1) + f"{i}.jpg\0".encode() + struct.pack("<Qddq", 1, 1, 2, -1)
        for i in range(2)
    ]
    (folder / "sparse/images.bin").write_bytes(struct.pack("<Q", 2) + b"".join(shots))


def strecha(folder: Path) -> None:
    _photos(folder, ["0.jpg", "1.jpg"])
    for i in range(2):
        text = f"30 0 15.5\n0 30 11.5\n0 0 1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n{i} 0 0\n{WIDTH} {HEIGHT}\n"
        (folder / f"{i}.jpg.camera").write_text(text)


def tum(folder: Path) -> None:
    _photos(folder, [f"rgb/{i}.png" for i in range(FRAMES)])
    for i in range(FRAMES):
        _depth(folder / f"depth/{i}.png")
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text("".join(f"{i / 10} {kind}/{i}.png\n" for i in range(FRAMES)))
    (folder / "groundtruth.txt").write_text("".join(f"{i / 10} {i} 0 0 0 0 0 1\n" for i in range(FRAMES)))
    (folder / "camera.txt").write_text("30 30 15.5 11.5 0.01 0 0 0\n")


def replica(folder: Path) -> None:
    _photos(folder, [f"results/frame{i:06d}.jpg" for i in range(FRAMES)])
    for i in range(FRAMES):
        _depth(folder / f"results/depth{i:06d}.png")
    (folder / "traj.txt").write_text(_POSE * FRAMES)
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))


def seven_scenes(folder: Path) -> None:
    for i in range(2):
        _photos(folder, [f"frame-{i:06d}.color.png"])
        _depth(folder / f"frame-{i:06d}.depth.png")
        (folder / f"frame-{i:06d}.pose.txt").write_text(_POSE)
    (folder / "camera-intrinsics.txt").write_text("585 0 320\n0 585 240\n0 0 1\n")


def icl_nuim(folder: Path) -> None:
    _photos(folder, [f"rgb/{i}.png" for i in range(FRAMES)])
    for i in range(FRAMES):
        _depth(folder / f"depth/{i}.png")
    (folder / "groundtruth.txt").write_text("".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(FRAMES)))


def _video(suffix: str, code: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        path = folder / f"walk.{suffix}"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 20.0, (2 * WIDTH, 2 * HEIGHT))
        for i in range(3 * FRAMES):
            writer.write(cv2.resize(picture(i), (2 * WIDTH, 2 * HEIGHT)))
        writer.release()
        if not path.is_file():
            raise OSError(f"OpenCV cannot write {code} into {suffix} here")

    return make


def _recording(compression: str) -> Callable[[Path], None]:
    """As `nodes.recorder` writes it, but in several chunks, as those of larger frames are."""

    def make(folder: Path) -> None:
        intrinsics = np.array([_FOCAL, _FOCAL, 15.5, 11.5])
        with (folder / "recording.mcap").open("wb") as file:
            writer = Writer(file, chunk_size=8192, compression=COMPRESSION[compression])
            writer.start(profile=ENCODING, library="mvsgs")
            channels = {name: writer.register_channel(name, ENCODING, 0) for name in ("Frame", "GroundTruth")}
            for i in range(2 * FRAMES):
                frame = Frame(i, i / 10, picture(i), intrinsics)
                truth = GroundTruth(i, i / 10, picture(i), intrinsics, np.eye(4), None)
                for message in (frame, truth):
                    writer.add_message(channels[type(message).__name__], i, bytes(encode(message, i)), i, i)
            writer.finish()

    return make


def _bag_messages(store: Any, ros: int) -> list[tuple[str, Any]]:
    t = store.types

    def header(seconds: int) -> Any:
        stamp = t["builtin_interfaces/msg/Time"](seconds, 0)
        return t["std_msgs/msg/Header"](*((0,) if ros == 1 else ()), stamp, "camera")

    k = np.array([_FOCAL, 0, 15.5, 0, _FOCAL, 11.5, 0, 0, 1])
    p = np.array([_FOCAL, 0, 15.5, 0, 0, _FOCAL, 11.5, 0, 0, 0, 1, 0])
    region = t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = t["sensor_msgs/msg/CameraInfo"](
        header(1), HEIGHT, WIDTH, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region
    )
    raw = [
        t["sensor_msgs/msg/Image"](header(1 + i), HEIGHT, WIDTH, "rgb8", 0, 3 * WIDTH, picture(i).ravel())
        for i in range(FRAMES)
    ]
    return [("/camera/camera_info", info), *(("/camera/image_raw", message) for message in raw)]


def _write_bag(writer: Writer1 | Writer2, ros: int) -> None:
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for seconds, (topic, message) in enumerate(_bag_messages(store, ros)):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], seconds * 10**9, serialize(message, kind))


def _bag(compression: str) -> Callable[[Path], None]:
    """ROS 1; `compression`: "", "bz2" or "lz4"."""

    def make(folder: Path) -> None:
        writer = Writer1(folder / "walk.bag")
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
        _write_bag(writer, 1)

    return make


def _bag2(plugin: str, mode: str) -> Callable[[Path], None]:
    """ROS 2; `plugin`: "SQLITE3" or "MCAP"; `mode` of zstd: "NONE", "MESSAGE", "FILE" or "STORAGE"."""

    def make(folder: Path) -> None:
        writer = Writer2(folder / "walk", version=9, storage_plugin=StoragePlugin[plugin])
        if mode != "NONE":
            writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
        _write_bag(writer, 2)

    return make


def ply(folder: Path) -> None:
    draw = torch.Generator().manual_seed(0)
    n = 40
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "opacity_logits": (n,), "sh": (n, 4, 3)}
    splats = Splats(
        **{name: torch.randn(shape, generator=draw) for name, shape in shapes.items()}, betas=torch.full((n,), 2.0)
    )
    snapshot = Snapshot(
        splats, np.zeros(n, np.int64), np.zeros(3), "exact", 0, keyframes=np.zeros(0, np.int64),
        world_from_cam=np.zeros((0, 4, 4)), scale=np.zeros(0), exposures=np.zeros((0, 3, 4), np.float32),
    )  # fmt: skip
    write_ply(folder / "map.ply", snapshot)


def cameras(folder: Path) -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    known = {
        "intrinsics": np.tile([_FOCAL, _FOCAL, 15.5, 11.5], (2, 1)), "sizes": np.tile([HEIGHT, WIDTH], (2, 1)),
        "exposures": poses[:, :3], "world_from_cam": poses,
    }  # fmt: skip
    write_cameras(folder / "cameras.json", Cameras(np.arange(2), np.arange(2.0), **known))


def checkpoint(folder: Path) -> None:
    numbers = {"newest_view": 1, "revision": 1, "splats": 40, "refined": 0}
    meta = {**numbers, "stream_seconds": 0.5, "stream_ended": False}
    path = state_file(folder, 1)
    path.parent.mkdir()
    write_state(path, meta, {"keyframes": np.arange(2, dtype=np.int64), "means": np.zeros((40, 3), np.float32)})


def weights(folder: Path) -> None:
    state = {f"layer{i}.weight": torch.arange(64.0).reshape(8, 8) for i in range(3)}
    torch.save({"state_dict": state, "epoch": 7}, folder / "weights.pth")


def huge_header(folder: Path) -> None:
    """A picture of 66 bytes that promises 900 million pixels, after one that keeps its promise."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    _photos(folder, ["0.png"])
    header = struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(1000))
    (folder / "1.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels))


def zstd_bomb() -> bytes:
    """A gigabyte of zeros."""
    compressor = zstandard.ZstdCompressor().compressobj()
    block = bytes(2**20)
    return b"".join(compressor.compress(block) for _ in range(2**10)) + compressor.flush()


def _chunk_bomb(promised: int) -> Callable[[Path], None]:
    """A recording whose second chunk becomes a gigabyte; `promised`: what its header says of that, in bytes."""

    def make(folder: Path) -> None:
        _recording("zstd")(folder)
        path = folder / "recording.mcap"
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        second = summary.chunk_indexes[1].chunk_start_offset
        bomb = RecordBuilder()
        Chunk("zstd", zstd_bomb(), 0, 0, 0, promised).write(bomb)
        data = path.read_bytes()
        path.write_bytes(data[:second] + bomb.end() + data[second:])

    return make


def message_bomb(folder: Path) -> None:
    """A bag of which one message becomes a gigabyte."""
    _bag2("SQLITE3", "MESSAGE")(folder)
    with closing(sqlite3.connect(next((folder / "walk").glob("*.db3")))) as database, database:
        database.execute("UPDATE messages SET data = ? WHERE id = 3", (zstd_bomb(),))


def _cut_off(make: Callable[[Path], None]) -> Callable[[Path], None]:
    """A bag whose recorder was killed: what is written at the end is not there."""

    def cut(folder: Path) -> None:
        make(folder)
        for file in [path for path in folder.rglob("*") if path.is_file()]:
            if file.name == "metadata.yaml":
                file.unlink()
            else:
                file.write_bytes(file.read_bytes()[:-100])

    return cut


def sens(folder: Path) -> None:
    """Version 4, of one camera for color and depth."""
    camera, there = np.diag([_FOCAL, _FOCAL, 1.0, 1.0]).astype("<f4"), np.eye(4, dtype="<f4").tobytes()
    camera[:2, 2] = 16.0, 12.0
    parts = [struct.pack("<IQ", 4, 6) + b"camera", 2 * (camera.tobytes() + there)]
    parts.append(struct.pack("<iiIIIIfQ", 2, 1, WIDTH, HEIGHT, WIDTH, HEIGHT, 1000.0, FRAMES))
    for number in range(FRAMES):
        color = cv2.imencode(".jpg", picture(number))[1].tobytes()
        depth = zlib.compress(np.full((HEIGHT, WIDTH), 2000, dtype="<u2").tobytes())
        parts += [there, struct.pack("<4Q", number, number, len(color), len(depth)), color, depth]
    (folder / "scan.sens").write_bytes(b"".join(parts))


# kind -> how it is opened ("DATASET", or what `file_worker` calls it), what is opened in its folder, how it is made
SEEDS: dict[str, tuple[str, str, Callable[[Path], None]]] = {
    "images": ("images", ".", images),
    "transforms.json": ("images", ".", transforms),
    "COLMAP text": ("images", ".", colmap_text),
    "COLMAP binary": ("images", ".", colmap_binary),
    "Strecha": ("images", ".", strecha),
    "TUM": ("tum", ".", tum),
    "Replica": ("replica", ".", replica),
    "7-Scenes": ("seven_scenes", ".", seven_scenes),
    "ICL-NUIM": ("icl_nuim", ".", icl_nuim),
    "ScanNet .sens": ("sens", "scan.sens", sens),
    "video mp4": ("video", "walk.mp4", _video("mp4", "mp4v")),
    "video avi": ("video", "walk.avi", _video("avi", "MJPG")),
    "video mkv": ("video", "walk.mkv", _video("mkv", "mp4v")),
    **{f"recording {c}": ("recording", "recording.mcap", _recording(c)) for c in COMPRESSION},
    **{f"bag {c or 'plain'}": ("bag", "walk.bag", _bag(c)) for c in ("", "bz2", "lz4")},
    "bag db3": ("bag", "walk", _bag2("SQLITE3", "NONE")),
    "bag db3 zstd": ("bag", "walk", _bag2("SQLITE3", "MESSAGE")),
    "bag db3 zstd file": ("bag", "walk", _bag2("SQLITE3", "FILE")),
    "bag mcap": ("bag", "walk", _bag2("MCAP", "NONE")),
    "bag mcap zstd": ("bag", "walk", _bag2("MCAP", "STORAGE")),
    "bag cut off": ("bag", "walk.bag", _cut_off(_bag(""))),
    "bag mcap cut off": ("bag", "walk", _cut_off(_bag2("MCAP", "NONE"))),
    "ply": ("ply", "map.ply", ply),
    "cameras.json": ("cameras", "cameras.json", cameras),
    "checkpoint": ("checkpoint", ".", checkpoint),
    "weights": ("weights", "weights.pth", weights),
}

# the same, of inputs that are hostile as they are: what is sound in them is read
HOSTILE: dict[str, tuple[str, str, Callable[[Path], None]]] = {
    "huge header": ("images", ".", huge_header),
    "zstd of a promised gigabyte": ("recording", "recording.mcap", _chunk_bomb(2**30)),
    "zstd of a denied gigabyte": ("recording", "recording.mcap", _chunk_bomb(2**20)),
    "message of a gigabyte": ("bag", "walk", message_bomb),
}
