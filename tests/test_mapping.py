"""The interface for programs: the graph's own map, poses as they are found, refusals that change nothing."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from launch.compose import compose
from launch.inline import run_inline
from launch.refusal import GraphError
from msgs import Frame, GroundTruth, SplatMap, Trajectory
from mvsgs import GaussianMap, Mapping
from mvsgs_core.datasets import Item
from mvsgs_core.image_metrics import psnr
from mvsgs_core.mapping.losses import LossInputs
from mvsgs_core.maps.info import info
from nodes import Node
from tests.support.sequences import synthetic
from tests.support.shared_data import ROOT

pytestmark = pytest.mark.slow

FRAMES, SIZE = 26, (96, 128)
SMALL = ["mapper.iterations=4", "mapper.refinement=12", "device=cpu", "tracker.threads=1", "mapper.threads=1"]


def room() -> tuple[Item, ...]:
    return synthetic(frames=FRAMES, size=SIZE)


class Given(Node):
    """The same frames as any source sends them."""

    def run(self) -> Iterator[Frame | GroundTruth]:
        for item in room():
            yield Frame(item.index, item.timestamp, item.image, item.intrinsics)
            yield GroundTruth(item.index, item.timestamp, item.image, item.intrinsics, item.world_from_cam, item.depth)


@pytest.fixture(scope="module")
def items() -> tuple[Item, ...]:
    return room()


@pytest.fixture(scope="module")
def halfway(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the map is saved in the middle of the stream."""
    return tmp_path_factory.mktemp("halfway")


@pytest.fixture(scope="module")
def mapped(items: tuple[Item, ...], halfway: Path) -> Mapping:
    """The room, while another thread looks at what there is; it is saved on the way, which changes nothing."""
    mapping, done, seen = Mapping(*SMALL, intrinsics=items[0].intrinsics), threading.Event(), list[int]()

    def look() -> None:
        while not done.wait(0.02):
            for keyframe in mapping.keyframes[-1:]:
                with suppress(RuntimeError):  # before the first map
                    mapping.render(keyframe.world_from_cam, size=(24, 32))
                    seen.append(keyframe.index)

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        feed(mapping, items, halfway)
    finally:  # or a failure would be waited for
        done.set()
        watcher.join()
    assert seen
    return mapping


def feed(mapping: Mapping, items: tuple[Item, ...], halfway: Path) -> None:
    found: list[int] = []
    with mapping:
        for item in items:
            tracked = mapping.add(item.image, item.timestamp)
            assert tracked.index == item.index
            found += tracked.keyframes
            if tracked.index == FRAMES - 3:
                mapping.save(halfway, images=False)
        assert tracked.phase == "tracking"
        assert tracked.world_from_cam is not None
        assert tracked.confidence > 0.5
        assert [keyframe.index for keyframe in mapping.keyframes] == sorted(found)
        assert len(found) >= 5


def test_it_is_the_map_of_the_graph(mapped: Mapping, tmp_path: Path) -> None:
    sent: list[Any] = []
    words = [*SMALL, f"dataset._target_={__name__}.Given", "evaluator=off", f"output={tmp_path}"]
    run_inline(compose(words), lambda slot, node, message: sent.append(message))
    final = next(message for message in sent if isinstance(message, SplatMap) and message.refined)
    ours = mapped.map.snapshot
    for name, value in ours.splats.tensors().items():
        np.testing.assert_array_equal(getattr(final, name), value.numpy())
    np.testing.assert_array_equal(final.world_from_cam, ours.world_from_cam)
    track = next(message for message in sent if isinstance(message, Trajectory))
    np.testing.assert_array_equal(track.state, mapped.trajectory.state)


def test_poses_and_renders_are_those_of_the_frames(mapped: Mapping, items: tuple[Item, ...]) -> None:
    track = mapped.finish()  # again: nothing more happens
    assert track.posed.all()
    for keyframe in mapped.keyframes:
        np.testing.assert_allclose(track.world_from_cam[keyframe.index], keyframe.world_from_cam, atol=1e-9)
    held_out = 20
    view = mapped.render(track.world_from_cam[held_out])
    assert view.image.shape == (*SIZE, 3)
    assert psnr(view.image / 255.0, items[held_out].image / 255.0) > 24
    assert np.median(view.depth[view.opacity > 0.5]) > 0
    half = mapped.render(track.world_from_cam[held_out], size=(48, 64))
    assert psnr(half.image / 255.0, view.image[::2, ::2] / 255.0) > 20
    assert mapped.warnings == []
    assert mapped.statistics["tracker"]["counts"]["frames"] == FRAMES
    with pytest.raises(RuntimeError, match="the stream was finished"):
        mapped.add(items[0].image, 100.0)


def test_the_map_of_half_a_stream_can_be_gone_on_with(mapped: Mapping, halfway: Path) -> None:
    assert 0 < len(GaussianMap.load(halfway)) < 1.2 * len(mapped.map)
    assert info(halfway)
    assert not (halfway / "keyframes").exists()
    with Mapping.load(halfway, *SMALL, "mapper=frozen", intrinsics=room()[0].intrinsics) as again:
        assert again.add(room()[9].image, 0.0).confidence > 0.5
    assert again.trajectory.posed.all()
    with pytest.raises(RuntimeError, match="nothing new to save"):
        again.save(halfway)


def test_what_is_saved_is_read_and_gone_on_with(mapped: Mapping, items: tuple[Item, ...], tmp_path: Path) -> None:
    saved = mapped.save(tmp_path / "room")
    assert {path.name for path in saved.iterdir()} == {
        "map.ply", "cameras.json", "trajectory.txt", "transforms.json", "keyframes", "checkpoint"
    }  # fmt: skip
    assert len(np.loadtxt(saved / "trajectory.txt")) == FRAMES
    assert info(saved)[0].startswith(f"splats      {len(mapped.map)},")
    read = GaussianMap.load(saved)
    pose = mapped.trajectory.world_from_cam[3]
    assert psnr(read.render(pose).image / 255.0, mapped.render(pose).image / 255.0) > 50
    for name in ("room.splat", "room.glb", "model"):
        assert mapped.export(tmp_path / name, **({"voxel": 0.05} if name == "room.glb" else {})).exists()
    with pytest.raises(ValueError, match=r"no format '\.txt'; there are: \.ply"):
        read.export(tmp_path / "room.txt")

    again = Mapping.load(saved, *SMALL, "mapper.refinement=0", intrinsics=items[0].intrinsics)
    assert len(again.map) == len(mapped.map)
    for item in items[:4]:
        tracked = again.add(item.image, item.timestamp)
    assert tracked.phase == "tracking"
    assert tracked.world_from_cam is not None
    np.testing.assert_allclose(tracked.world_from_cam, mapped.trajectory.world_from_cam[3], atol=0.02)
    again.finish()
    before = again.map
    again.refine(3)
    assert again.map.snapshot.iterations == before.snapshot.iterations + 3
    assert info(again.save(saved))  # where it came from
    (saved / "report.json").touch()
    with pytest.raises(ValueError, match="the output of a run"):
        mapped.save(saved)
    with pytest.raises(ValueError, match="no such directory"):
        Mapping.load(tmp_path / "nowhere")


IMAGE, POSE = np.full((48, 64, 3), 128, np.uint8), np.eye(4)
REFUSED: dict[str, tuple[type[Exception], str, dict[str, Any]]] = {
    "a list": (TypeError, "not list", {"image": [[0]]}),
    "floats": (ValueError, "is uint8, 0 to 255, got float64", {"image": IMAGE / 255.0}),
    "gray": (ValueError, r"got an array of shape \(48, 64\); a gray image", {"image": IMAGE[..., 0]}),
    "with alpha": (ValueError, r"got an array of shape \(48, 64, 4\)", {"image": np.zeros((48, 64, 4), np.uint8)}),
    "a line": (ValueError, "sides must be 16 to", {"image": IMAGE[:1]}),
    "another size": (ValueError, "a frame of 32x48 after frames of 64x48", {"image": IMAGE[:, :32]}),
    "the same time": (ValueError, "1.0 is not after the last frame's, 1.0", {"timestamp": 1.0}),
    "time backward": (ValueError, "time goes forward", {"timestamp": 0.5}),
    "no time": (ValueError, "no time in seconds", {"timestamp": float("nan")}),
    "a text": (TypeError, "a number of seconds, not str", {"timestamp": "now"}),
    "no pose": (ValueError, "without a pose", {"pose": None}),
    "a pose of NaN": (ValueError, "not finite", {"pose": np.full((4, 4), np.nan)}),
    "half a pose": (ValueError, r"shape \(3, 4\)", {"pose": POSE[:3]}),
    "a mirror": (ValueError, "no rotation", {"pose": np.diag([1.0, 1.0, -1.0, 1.0])}),
    "a zoom": (ValueError, "a camera keeps its own", {"intrinsics": [90, 90, 31.5, 23.5]}),
    "a matrix": (ValueError, r"\[K\[0, 0\]", {"intrinsics": np.eye(3)}),
}  # fmt: skip


@pytest.fixture(scope="module")
def posed() -> Mapping:
    """One frame has come."""
    mapping = Mapping(*SMALL, poses=True, size=(48, 64))
    mapping.add(IMAGE, 1.0, intrinsics=[60, 60, 31.5, 23.5], pose=POSE)
    return mapping


@pytest.mark.parametrize("case", REFUSED)
def test_a_frame_that_is_none_changes_nothing(posed: Mapping, case: str) -> None:
    error, said, changed = REFUSED[case]
    given = {"image": IMAGE, "timestamp": 2.0, "pose": POSE} | changed
    with pytest.raises(error, match=said):
        posed.add(given.pop("image"), given.pop("timestamp"), **given)
    assert posed.statistics["dataset"]["counts"]["frames"] == 1


def test_the_first_frame_is_refused_too() -> None:
    mapping = Mapping(*SMALL, intrinsics=[60, 60, 31.5, 23.5])
    with pytest.raises(ValueError, match=r"Mapping\(poses=True\) takes yours"):
        mapping.add(IMAGE, 0.0, pose=POSE)
    with pytest.raises(ValueError, match="no camera's with 64x48 pixels"):
        Mapping(*SMALL).add(IMAGE, 0.0, intrinsics=[0.1, 0.1, 31.5, 23.5])
    with pytest.raises(RuntimeError, match="there is no map yet"):
        mapping.render(POSE)
    with pytest.raises(RuntimeError, match="after finish"):
        _ = mapping.trajectory
    assert mapping.add(IMAGE, 0.0).index == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [(["output=here"], "a Mapping has settings of tracker"), (["evaluator=standard"], "a Mapping has settings of"),
     (["mapper.iteratoins=3"], "did you mean iterations"), (["tracker=nothing"], "no choice 'nothing'"),
     (["mapper.training.loss_function=nowhere.loss"], "must be module.function")],
)  # fmt: skip
def test_settings_that_are_none_are_refused(words: list[str], said: str) -> None:
    with pytest.raises((ValueError, GraphError), match=said):
        Mapping(*words)


@pytest.mark.parametrize("setting", [3, ["mapper.iterations=3"], None])
def test_a_setting_that_is_no_text_is_refused(setting: Any) -> None:
    with pytest.raises(TypeError, match="a setting is a text"):
        Mapping(setting)


@pytest.mark.parametrize("intrinsics", [[-5, 60, 31.5, 23.5], [0.01, 0.01, 31.5, 23.5], [1, 2, 3]])
def test_intrinsics_that_no_camera_has_are_refused_before_any_frame(intrinsics: list[float]) -> None:
    with pytest.raises(ValueError, match=r"focal lengths|four finite numbers"):
        Mapping(*SMALL, intrinsics=intrinsics)


def test_intrinsics_of_images_of_another_size_are_doubted() -> None:
    mapping = Mapping(*SMALL, intrinsics=[120, 120, 63.5, 47.5])
    mapping.add(IMAGE, 0.0)
    assert any("64x48" in line and "another size (about 128x96)" in line for line in mapping.warnings)
    turned = Mapping(*SMALL, intrinsics=[60, 60, 23.5, 31.5])
    turned.add(IMAGE, 0.0)
    (doubt,) = [line for line in turned.warnings if "principal point" in line]
    assert "give intrinsics=[60,60,31.5,23.5]" in doubt


def test_given_poses_and_a_loss_of_ones_own(items: tuple[Item, ...]) -> None:
    seen: list[int] = []

    def loss(inputs: LossInputs) -> torch.Tensor:
        seen.append(1)
        return (inputs.render.color - inputs.target).square().mean()

    with Mapping(*SMALL, poses=True, intrinsics=items[0].intrinsics, loss=loss) as mapping:
        for item in items[:16]:
            mapping.add(item.image, item.timestamp, pose=item.world_from_cam)
    np.testing.assert_array_equal(mapping.trajectory.world_from_cam[5], items[5].world_from_cam)
    assert len(seen) == mapping.map.snapshot.iterations > 12
    assert psnr(mapping.render(items[5].world_from_cam).image / 255.0, items[5].image / 255.0) > 18


def test_an_exception_ends_the_stream(items: tuple[Item, ...]) -> None:
    def loss(inputs: LossInputs) -> float:
        return 1.0

    mapping = Mapping(*SMALL, poses=True, intrinsics=items[0].intrinsics, loss=loss)  # type: ignore[arg-type]

    def feed() -> None:
        with mapping:
            for item in items:
                mapping.add(item.image, item.timestamp, pose=item.world_from_cam)

    with pytest.raises(TypeError, match="must return a scalar tensor with a gradient"):
        feed()
    assert len(mapping.map) > 0
    for call in (mapping.finish, lambda: mapping.add(items[0].image, 99.0, pose=POSE)):
        with pytest.raises(RuntimeError, match="the stream was ended by TypeError: the loss function"):
            call()


def test_importing_it_is_light_and_leaves_the_path_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "nodes.py").touch()
    code = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
import mvsgs_core, mvsgs
assert not {{"torch", "cv2", "hydra"}} & set(sys.modules)
sys.path.remove({str(ROOT)!r})
path = list(sys.path)
from mvsgs_core import Mapping
assert Mapping is mvsgs.Mapping and sys.path == path
del sys.modules["nodes"]
import nodes
try:
    mvsgs.rooms.open_workspace()
except ImportError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    assert f"another one of that name: {tmp_path / 'nodes.py'}" in done.stdout
