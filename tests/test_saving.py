"""A map that a program saves, as the folder that a run would leave."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from torch import from_numpy

from mvsgs.saving import save_map
from mvsgs_core.export.cameras import read_cameras, write_cameras
from mvsgs_core.export.keyframe_images import image_name, known_image
from mvsgs_core.kept_map import check_kept_map, tracker_file
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.begun import begin_on
from mvsgs_core.mapping.checkpoints.results import cameras_of
from mvsgs_core.shared_folder import ROOT, shared
from mvsgs_core.stats import Stats
from mvsgs_core.trajectory import Trajectory
from tests.support.small_atlas import PLAIN, SIZE, begun, written
from tests.support.small_atlas import view as keyframe


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    return begun(PLAIN)


@pytest.fixture(scope="module")
def larger() -> Atlas:
    """By a keyframe."""
    found = begun(PLAIN)
    found.add(keyframe(6), 0)
    return found


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["transforms.json", "keyframes/mine.png", "map.ply", "checkpoint/weights.pt"])
@pytest.mark.parametrize("images", [False, True])
def test_files_that_no_save_has_left_are_not_replaced(atlas: Atlas, tmp_path: Path, name: str, images: bool) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"of somebody else")
    (tmp_path / "notes.txt").write_bytes(b"which is in nobody's way")
    before = files(tmp_path)
    with pytest.raises(ValueError, match=rf"{name.partition('/')[0]} is there and was left by no save of a map"):
        save_map(tmp_path, atlas, None, None, images)
    assert files(tmp_path) == before


def test_neither_the_root_nor_the_home_folder_itself_takes_a_map(
    atlas: Atlas, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "link").symlink_to(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for folder in (tmp_path, tmp_path / "link"):
        with pytest.raises(ValueError, match=f"^{folder}: is your home folder; a map .* such as {folder}/runs/first"):
            save_map(folder, atlas, None, None, images=False)
    monkeypatch.setattr("mvsgs.saving.shared", lambda folder: ROOT)  # instead of the one that there is
    with pytest.raises(ValueError, match="is the root of the file system; a map needs a folder of its own"):
        save_map(tmp_path / "root", atlas, None, None, images=False)
    assert files(tmp_path) == {}
    assert shared(Path("/")) == shared(Path("//")) == ROOT
    assert shared(tmp_path / "runs") is None


def test_an_earlier_save_is_replaced_and_what_others_left_beside_it_stays(atlas: Atlas, tmp_path: Path) -> None:
    save_map(tmp_path, atlas, None, None, images=True)
    kept = read_cameras(tmp_path / "cameras.json").keyframes.tolist()
    assert {path.name for path in (tmp_path / "keyframes").iterdir()} == {image_name(index) for index in kept}
    (tmp_path / "keyframes/mine.png").write_bytes(b"of somebody else")
    save_map(tmp_path, atlas, None, None, images=False)
    assert [path.name for path in (tmp_path / "keyframes").iterdir()] == ["mine.png"]
    assert (tmp_path / "keyframes/mine.png").read_bytes() == b"of somebody else"
    (tmp_path / "keyframes/mine.png").unlink()
    save_map(tmp_path, atlas, None, None, images=True)
    save_map(tmp_path, atlas, None, None, images=False)
    assert not (tmp_path / "keyframes").exists()
    assert not (tmp_path / "transforms.json").exists()  # it would name images that are not there


def test_a_save_that_was_cut_off_can_be_done_again(
    atlas: Atlas, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("mvsgs_core.mapping.checkpoints.writer.save", full)
        with pytest.raises(OSError, match="No space left"):
            save_map(tmp_path, atlas, None, None, images=True)
    save_map(tmp_path, atlas, None, None, images=True)
    assert (tmp_path / "map.ply").exists()


def test_images_are_those_that_came_and_what_is_left_out_is_counted(tmp_path: Path) -> None:
    """Of a rolling shutter the map is trained on the photograph as it was taken; a run saves the image without it."""
    atlas = begun(PLAIN)
    views = atlas.largest.views
    rectified = np.full((*SIZE, 3), 77, np.uint8)
    views[1].take_photograph(np.full((*SIZE, 3), 200, np.uint8), np.zeros(6), 0.01)
    views[2].drop_image()
    views[3].image = views[3].image[::2, ::2]  # as of mapper.max_pixels
    images = {views[1].index: from_numpy(rectified), views[3].index: from_numpy(rectified + 1)}
    assert save_map(tmp_path / "a", atlas, None, None, True, images) == 1
    folder = tmp_path / "a/keyframes"
    for view, level in ((views[1], 77), (views[3], 78)):
        found = known_image(folder, view.index)
        assert found is not None
        assert (found == level).all()
    assert not (folder / image_name(views[2].index)).exists()
    np.testing.assert_array_equal(known_image(folder, views[0].index), views[0].image.numpy())
    assert save_map(tmp_path / "b", atlas, None, None, False) == 0


def test_photographs_of_a_map_that_is_gone_on_with_are_left_out(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    for view in atlas.largest.views[:2]:
        view.take_photograph(np.full((*SIZE, 3), 200, np.uint8), np.zeros(6), 0.01)
    again = begin_on(written(atlas, tmp_path / "before"), PLAIN, Stats())
    assert save_map(tmp_path / "now", again, None, None, True) == 2


def test_the_trajectory_saved_is_of_the_part_that_is_saved(tmp_path: Path) -> None:
    """Six frames with the map's keyframes, and nine with a single one in another frame of reference."""
    index = np.arange(15)
    segment = np.isin(index, [3, *range(7, 15)]).astype(np.int32)
    poses = np.tile(np.eye(4), (15, 1, 1))
    track = Trajectory(index, index / 30, poses, index < 6, np.zeros(15, np.uint8), segment)
    atlas = begun(PLAIN)
    assert [view.index for view in atlas.largest.views] == [0, 1, 2, 4, 5]
    save_map(tmp_path, atlas, None, track, images=False)
    saved = np.loadtxt(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(saved[:, 0], np.flatnonzero(segment == 0) / 30, atol=1e-6)


def test_a_map_without_a_tracker_s_half_takes_away_that_of_the_save_before(atlas: Atlas, tmp_path: Path) -> None:
    save_map(tmp_path, atlas, None, None, images=False)
    tracker_file(tmp_path).write_bytes(b"of the map before")
    save_map(tmp_path, atlas, None, None, images=False)
    with pytest.raises(ValueError, match="no map to begin on there"):
        check_kept_map(tmp_path)


HALF = "the tracker's half"
STEPS = (  # of a save, in the order in which they come
    "mvsgs_core.mapping.checkpoints.writer.write_image", "mvsgs_core.mapping.checkpoints.checkpoint.write_state",
    "mvsgs_core.mapping.checkpoints.writer.save", "mvsgs_core.mapping.checkpoints.writer.CheckpointWriter.keep_newest",
    "mvsgs_core.export.keyframe_images.write_image", "mvsgs.saving.write_results",
)  # fmt: skip


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["full", "Ctrl-C"])
@pytest.mark.parametrize("after", [False, True], ids=["instead", "after"])
@pytest.mark.parametrize(
    ("step", "tracked"), [*((step, False) for step in STEPS), *((step, True) for step in (*STEPS, HALF))]
)
def test_whatever_a_second_save_raises_the_first_or_the_second_is_there_whole(
    atlas: Atlas, larger: Atlas, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tracked: bool, step: str, after: bool,
    error: BaseException,
) -> None:  # fmt: skip
    """after: when the step has been made."""
    half = tracker_file(tmp_path)
    save_map(tmp_path, atlas, None, None, True, keep_tracker=lambda file: file.write_bytes(b"first"))

    def keep(file: Path) -> None:
        if step != HALF or after:
            file.write_bytes(b"second")
        if step == HALF:
            raise error

    def failing(made: Callable[..., object]) -> Callable[..., object]:
        def found(*given: object, **named: object) -> None:
            if after:
                made(*given, **named)
            raise error

        return found

    if step in STEPS:
        monkeypatch.setattr(step, failing(pkgutil.resolve_name(step)))
    with pytest.raises(type(error)):
        save_map(tmp_path, larger, None, None, True, keep_tracker=keep if tracked else None)
    monkeypatch.undo()
    keyframes = len(begin_on(tmp_path, PLAIN, Stats()).largest.views)
    if keyframes == len(atlas.largest.views):
        assert half.read_bytes() == b"first"
        assert step in (*STEPS[:3], HALF)
    else:
        assert keyframes == len(larger.largest.views)
        assert (half.read_bytes() == b"second") if tracked else not half.exists()
    assert not list(half.parent.glob(".*"))
    save_map(tmp_path, larger, None, None, True)
    assert len(list(half.parent.glob("state-*"))) == 1


def test_what_was_exported_is_no_save(atlas: Atlas, tmp_path: Path) -> None:
    shown = atlas.largest
    write_cameras(tmp_path / "cameras.json", cameras_of(shown.snapshot(), shown.views))
    (tmp_path / "map.ply").write_bytes(b"of somebody else")
    (tmp_path / "keyframes").mkdir()
    (tmp_path / "keyframes" / image_name(0)).write_bytes(b"of somebody else")
    before = files(tmp_path)
    with pytest.raises(ValueError, match="was left by no save of a map"):
        save_map(tmp_path, atlas, None, None, images=True)
    assert files(tmp_path) == before


def test_a_save_that_was_cut_off_at_once_can_be_done_again(atlas: Atlas, tmp_path: Path) -> None:
    (tmp_path / "checkpoint").mkdir()
    save_map(tmp_path, atlas, None, None, images=False)
    assert (tmp_path / "map.ply").exists()


def test_transforms_name_no_images_that_are_not_there(atlas: Atlas, tmp_path: Path) -> None:
    save_map(tmp_path, atlas, None, None, images=True)
    assert (tmp_path / "transforms.json").exists()
    (tmp_path / "keyframes/mine.png").write_bytes(b"of somebody else")
    save_map(tmp_path, atlas, None, None, images=False)
    assert not (tmp_path / "transforms.json").exists()


def test_images_of_the_save_before_stay_until_the_new_ones_are_there(
    atlas: Atlas, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_map(tmp_path, atlas, None, None, images=True)
    before = files(tmp_path / "keyframes")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mvsgs_core.export.keyframe_images.write_image", full)
    with pytest.raises(OSError, match="No space left"):
        save_map(tmp_path, atlas, None, None, images=True)
    assert files(tmp_path / "keyframes") == before
