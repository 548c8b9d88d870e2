"""A flight through a map as a video that browsers play, read by programs that are not ours."""

from __future__ import annotations

import base64
import functools
import http.server
import struct
import threading
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from mvsgs_core import camera
from mvsgs_core.export import render_path
from mvsgs_core.export.ply import write_ply
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.video_file import write_video
from tests.support.chromium import browser
from tests.support.tiny_map import INTRINSICS, SIZE, final_map, save_cameras, write_poses
from tests.support.tiny_scene import pose_on_arc

VIDEO_SIZE = (96, 128)


def flight(folder: Path, *arguments: str) -> Path:
    """Of five frames."""
    write_poses(folder / "trajectory.txt", [0.0, 1.0])
    write_ply(folder / "map.ply", final_map())
    out = folder / "flight.mp4"
    words = [str(folder / "map.ply"), str(folder / "trajectory.txt"), str(out), "--frames", "5", *arguments]
    assert render_path.main(words) == 0
    return out


def rendered(t: float) -> np.ndarray:
    """(96, 128, 3) uint8 of the map from the path."""
    intrinsics = camera.scale_intrinsics(INTRINSICS, SIZE, VIDEO_SIZE)
    color = rasterize(final_map().splats, pose_on_arc(t), intrinsics, VIDEO_SIZE).color
    return np.round(255.0 * color.clamp(0.0, 1.0).numpy()).astype(np.uint8)


def psnr(one: np.ndarray, two: np.ndarray) -> float:
    return float(10.0 * np.log10(255.0**2 / np.mean((one.astype(float) - two.astype(float)) ** 2)))


def test_the_video_is_h264_as_browsers_decode_it_with_every_frame_and_its_colors(tmp_path: Path) -> None:
    save_cameras(tmp_path, [0.5])
    out = flight(tmp_path, "--size", "96", "128", "--fps", "25")
    with av.open(str(out)) as container:
        (stream,) = container.streams
        context = stream.codec_context
        assert (context.name, context.pix_fmt, context.width, context.height) == ("h264", "yuv420p", 128, 96)
        assert context.profile in ("Constrained Baseline", "Main", "High")
        assert (context.colorspace, context.color_range, context.color_primaries, context.color_trc) == (1, 1, 1, 1)
        assert stream.average_rate == 25
        frames = [frame.to_ndarray(format="rgb24", src_colorspace="ITU709") for frame in container.decode(video=0)]
    assert len(frames) == 5
    assert cv2.VideoCapture(str(out)).get(cv2.CAP_PROP_FRAME_COUNT) == 5
    assert psnr(frames[0], rendered(0.0)) > 32.0
    assert psnr(frames[-1], rendered(1.0)) > 32.0
    assert psnr(frames[-1], rendered(0.0)) < 25.0


def test_the_index_comes_before_the_frames(tmp_path: Path) -> None:
    save_cameras(tmp_path, [0.5])
    data, boxes, place = flight(tmp_path).read_bytes(), [], 0
    while place < len(data):
        (length,) = struct.unpack(">I", data[place : place + 4])
        boxes.append(data[place + 4 : place + 8].decode())
        place += length
    assert boxes.index("moov") < boxes.index("mdat")


PAGE = """<!doctype html><video id=v src=flight.mp4 muted preload=auto></video><canvas id=c></canvas><script>
const c = document.getElementById("c"), v = document.getElementById("v")
function drawn() {  // the first frame's pixels, empty until the decoder hands one out
  if (v.error) return "error " + v.error.message
  if (v.readyState < 2) return ""
  c.width = v.videoWidth; c.height = v.videoHeight
  const context = c.getContext("2d")
  context.drawImage(v, 0, 0)
  const pixels = context.getImageData(0, 0, c.width, c.height).data
  if (pixels.every((value, i) => i % 4 == 3 || value == 0)) return ""
  let text = ""
  for (const value of pixels) text += String.fromCharCode(value)
  return btoa(text)
}
</script>"""


@pytest.mark.slow
def test_a_browser_plays_it(tmp_path: Path) -> None:
    save_cameras(tmp_path, [0.5])
    flight(tmp_path, "--size", "96", "128", "--fps", "25")
    (tmp_path / "page.html").write_text(PAGE)
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path)
    with browser() as page, http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page.open(f"http://127.0.0.1:{server.server_address[1]}/page.html")
        page.until("drawn()")
        shown = page.evaluate("[v.duration, v.videoWidth, v.videoHeight, drawn()]")
        server.shutdown()
    assert not shown[3].startswith("error"), shown[3]
    assert shown[0] == pytest.approx(0.2, abs=0.001)
    assert shown[1:3] == [128, 96]
    first = np.frombuffer(base64.b64decode(shown[3]), dtype=np.uint8).reshape(96, 128, 4)[..., :3]
    assert psnr(first, rendered(0.0)) > 30.0


def test_an_odd_row_and_column_are_left_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = [np.full((9, 11, 3), rng.integers(0, 255, 3), dtype=np.uint8) for _ in range(3)]
    assert write_video(tmp_path / "odd.mp4", iter(frames), (9, 11), 29.97) == 3
    with av.open(str(tmp_path / "odd.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, float(stream.average_rate)) == (10, 8, pytest.approx(29.97, abs=1e-3))
        read = [frame.to_ndarray(format="rgb24", src_colorspace="ITU709") for frame in container.decode(video=0)]
    for one, two in zip(read, frames, strict=True):
        np.testing.assert_allclose(one, two[:8, :10], atol=6)


@pytest.mark.parametrize(
    ("name", "size", "error", "message"),
    [
        ("flight.avi", (8, 8), ValueError, "must end in .mp4"),
        ("flight.mp4", (1, 8), ValueError, "no video has frames of 8x1"),
        ("missing/flight.mp4", (8, 8), OSError, "cannot write a video to .*: No such file"),
    ],
)
def test_what_cannot_be_written_is_said(
    tmp_path: Path, name: str, size: tuple[int, int], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        write_video(tmp_path / name, iter([np.zeros((*size, 3), dtype=np.uint8)]), size, 30.0)


def test_without_a_camera_nothing_is_rendered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "map.ply", final_map())
    words = [str(tmp_path / name) for name in ("map.ply", "trajectory.txt", "flight.mp4")]
    assert render_path.main(words) == 1
    assert "trajectory.txt is missing: a path is poses" in capsys.readouterr().err
    write_poses(tmp_path / "trajectory.txt", [0.0, 1.0])
    assert render_path.main(words) == 1
    assert "there is no cameras.json beside" in capsys.readouterr().err
    (tmp_path / "trajectory.txt").write_text("# none\n")
    assert render_path.main(words) == 1
    assert "has no poses" in capsys.readouterr().err


def test_a_resampled_path_keeps_its_ends_and_is_even() -> None:
    poses = np.stack([pose_on_arc(t) for t in (0.0, 0.5, 1.0)])
    path = render_path.resampled(poses, 9)
    np.testing.assert_allclose(path[[0, 4, 8]], poses, atol=1e-9)
    np.testing.assert_allclose(render_path.resampled(poses[:1], 3), poses[[0, 0, 0]], atol=1e-9)
