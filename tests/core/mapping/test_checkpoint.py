"""A checkpoint gives the map back to the bit, and a damaged one is refused with a sentence."""

from __future__ import annotations

import gc
import json
import shutil
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.checkpoint import load
from mvsgs_core.mapping.checkpoints.files import (
    FOLDER,
    KEYFRAMES,
    VERSION,
    checkpoint_info,
    read_state,
    state_files,
)
from mvsgs_core.mapping.checkpoints.keyframes import kept_keyframes
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.density_control import DensityControlConfig
from mvsgs_core.mapping.keyframes import ConvergenceConfig
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.stats import Stats
from tests.support.patience import LONG
from tests.support.small_atlas import PLAIN, VIGNETTING, begun, view, written
from tests.support.tiny_scene import pose_on_arc

EVERYTHING = replace(
    PLAIN,
    sh_degree=1,
    max_pixels=500,
    max_keyframes=4,
    training=TrainingConfig(kernel="exact", betas=True, refine_poses=True, pose_visits=1),
    convergence=ConvergenceConfig(visits=3),
    density_control=DensityControlConfig(every=7, prune_opacity=0.3),
)


def ended(atlas: Atlas) -> dict[str, torch.Tensor]:
    """The map that comes of it: views, a correction, a join, the rest of the iterations and the refinement."""
    for index in range(6, 9):
        atlas.enter(0)
        atlas.current.add_keyframe(view(index))
        atlas.came(index, 0.1 * index)
    atlas.current.correct(np.array([6]), pose_on_arc(0.76)[None], np.ones(1))
    atlas.segment_of[3] = 0
    atlas.join()
    while atlas.current.step():
        pass
    for done in range(atlas.current.config.refinement):
        atlas.current.refine(done, atlas.current.config.refinement)
    final = atlas.current.snapshot()
    poses = {"poses": torch.from_numpy(final.world_from_cam), "exposures": torch.from_numpy(final.exposures)}
    return atlas.current.state.tensors() | poses


@pytest.mark.slow
@pytest.mark.parametrize("config", [PLAIN, EVERYTHING], ids=["plain", "everything"])
def test_a_run_that_goes_on_from_a_checkpoint_gives_the_same_map_to_the_bit(
    config: MapperConfig, tmp_path: Path
) -> None:
    atlas = begun(config)
    written(atlas, tmp_path)
    expected = ended(atlas)
    log = Stats()
    again, file = load(tmp_path, config, log)
    assert (again.newest_view, again.revision, again.segment_of) == (5, 4, {3: 1, 2: 0})
    assert log.counts["views"] == 6
    assert list(again.current.photometry.exposures) == [1, 2, 3, 4, 5, 7]
    np.testing.assert_array_equal(again.current.photometry.vignetting, 2.0 * VIGNETTING)
    assert [v.measured is None for part in again.parts.values() for v in part.views] == [True] + 5 * [False]
    assert any("not finite" in text for text in log.warnings)  # of the run so far
    assert file == state_files(tmp_path)[0]
    found = ended(again)
    assert len(expected["steps"]) > 100
    for name, value in expected.items():
        assert torch.equal(found[name], value), name
    assert log.counts == atlas.current.log.counts


def test_the_stream_goes_on_while_a_frozen_atlas_stays_as_it_was(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    frozen = atlas.frozen()
    before = {name: value.clone() for name, value in frozen.current.state.tensors().items()}
    views = [replace(v, pose_delta=v.pose_delta.copy()) for v in frozen.current.views]
    ended(atlas)
    for name, value in frozen.current.state.tensors().items():
        assert torch.equal(value, before[name]), name
    for one, other in zip(frozen.current.views, views):
        assert one.image is other.image
        np.testing.assert_array_equal(one.world_from_cam, other.world_from_cam)
        np.testing.assert_array_equal(one.pose_delta, other.pose_delta)


def test_a_frozen_atlas_is_freed_where_it_is_let_go() -> None:
    """Not when Python's collector comes by: it takes as much memory as the map."""
    atlas = begun(PLAIN)
    gc.disable()
    try:
        frozen = atlas.frozen()
        state = weakref.ref(frozen.current.state)
        del frozen
        assert state() is None
    finally:
        gc.enable()


def test_what_a_checkpoint_says_of_itself_needs_no_mapper(tmp_path: Path) -> None:
    info = checkpoint_info(written(begun(PLAIN), tmp_path))
    assert (info.newest_keyframe_index, info.keyframes.tolist(), info.finished) == (5, [0, 1, 2, 3, 4, 5], False)
    assert info.stream_seconds == pytest.approx(0.5)
    assert info.splats > 100
    assert info.stereo_after() is None
    assert info.stereo_after(2) == 3


def test_the_keyframes_of_a_checkpoint_are_what_the_mapper_was_given(tmp_path: Path) -> None:
    found = kept_keyframes(written(begun(PLAIN), tmp_path))
    assert [(k.index, k.segment) for k in found] == [(0, 0), (1, 0), (2, 0), (3, 1), (4, 0), (5, 0)]
    image = found[4].image()
    assert image is not None
    np.testing.assert_array_equal(image, view(4).image)
    np.testing.assert_array_equal(found[4].intrinsics, view(4).intrinsics)
    np.testing.assert_array_equal(found[4].world_from_cam, view(4).world_from_cam)
    assert found[4].timestamp == 0.4
    np.testing.assert_array_equal(found[4].exposure, view(4).exposure)
    assert np.isnan(found[0].exposure).all()


def test_images_are_written_once_and_two_states_are_kept(tmp_path: Path) -> None:
    atlas, config = begun(EVERYTHING), EVERYTHING
    writer = CheckpointWriter(tmp_path, config)
    times = []
    for _ in range(3):
        writer.submit(atlas.frozen())
        assert writer.wait(LONG)
        times.append({f.name: f.stat().st_mtime_ns for f in (tmp_path / FOLDER / KEYFRAMES).iterdir()})
    assert times[0] == times[1] == times[2]
    assert len(times[0]) == 4 + 2  # of four keyframes, max_keyframes; the other segment's, and a frame beside it
    assert [file.name for file in state_files(tmp_path)] == ["state-00000003.npz", "state-00000002.npz"]
    for index in range(6, 9):
        atlas.current.add_keyframe(view(index))
    for _ in range(2):  # the state before the last one still needs what was let go
        writer.submit(atlas.frozen())
        assert writer.wait(LONG)
    left = {f.name for f in (tmp_path / FOLDER / KEYFRAMES).iterdir()}
    assert len(left) == 4 + 2
    assert left != set(times[0])
    load(tmp_path, config, Stats())


def test_another_runs_checkpoint_is_replaced_by_the_first_of_this_one(tmp_path: Path) -> None:
    written(begun(EVERYTHING), tmp_path)
    foreign = {f.name for f in (tmp_path / FOLDER / KEYFRAMES).iterdir()}
    (tmp_path / ".map.123.ply").write_text("of a process that was killed")
    written(begun(PLAIN), tmp_path)
    assert [file.name for file in state_files(tmp_path)] == ["state-00000002.npz"]
    assert not {f.name for f in (tmp_path / FOLDER / KEYFRAMES).iterdir()} & foreign
    assert not (tmp_path / ".map.123.ply").exists()
    load(tmp_path, PLAIN, Stats())


def test_a_damaged_state_is_said_and_the_one_before_taken(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    writer = CheckpointWriter(tmp_path, PLAIN)
    for _ in range(2):
        writer.submit(atlas.frozen())
        assert writer.wait(LONG)
    newest, before = state_files(tmp_path)
    data = bytearray(newest.read_bytes())
    middle = slice(len(data) // 2, len(data) // 2 + 500)  # longer than what a zip file says of no importance
    data[middle] = bytes(byte ^ 1 for byte in data[middle])
    newest.write_bytes(data)
    log = Stats()
    _, file = load(tmp_path, PLAIN, log)
    assert file == before
    assert any("an older checkpoint was taken" in text and "damaged" in text for text in log.warnings)
    assert checkpoint_info(tmp_path).file == before
    before.write_bytes(data[:1000])
    with pytest.raises(ValueError, match="damaged"):
        load(tmp_path, PLAIN, Stats())
    with pytest.raises(ValueError, match="damaged"):
        checkpoint_info(tmp_path)


def test_an_image_that_is_missing_or_another_is_refused(tmp_path: Path) -> None:
    written(begun(PLAIN), tmp_path)
    first, second, *_ = sorted((tmp_path / FOLDER / KEYFRAMES).glob("*.png"))
    whole = first.read_bytes()
    first.write_bytes(second.read_bytes())
    with pytest.raises(ValueError, match="shows something else than its name says"):
        load(tmp_path, PLAIN, Stats())
    first.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="damaged"):
        load(tmp_path, PLAIN, Stats())
    first.unlink()
    with pytest.raises(ValueError, match="cannot be read"):
        load(tmp_path, PLAIN, Stats())
    with pytest.raises(ValueError, match=f"1 are missing, such as {first.name}: copy the whole folder"):
        checkpoint_info(tmp_path)  # what is asked before anything starts


def two_checkpoints(output: Path) -> tuple[Path, Path]:
    """The states of a map of four keyframes, and before of three: the newest, the one before."""
    atlas, writer = Atlas(OnlineMapper(replace(PLAIN, iterations=0))), CheckpointWriter(output, PLAIN)
    for index in range(4):
        atlas.add(view(index), 0)
        if index > 1:
            writer.submit(atlas.frozen())
            assert writer.wait(LONG)
    newest, before = state_files(output)
    return newest, before


@pytest.mark.parametrize("damaged", ["cut off", "empty", "of another keyframe"])
def test_launcher_source_and_mapper_pass_over_a_state_with_a_damaged_image(tmp_path: Path, damaged: str) -> None:
    """As where the machine lost power before what a run that ended early had left was on the disk."""
    newest, before = two_checkpoints(tmp_path)
    assert checkpoint_info(tmp_path).file == newest
    *_, other, last = sorted(newest.parent.glob(f"{KEYFRAMES}/*.png"))
    data = {"cut off": last.read_bytes()[:100], "empty": b"", "of another keyframe": other.read_bytes()}
    last.write_bytes(data[damaged])
    log = Stats()
    atlas, file = load(tmp_path, PLAIN, log)
    assert file == before
    assert any("an older checkpoint was taken" in text and last.name in text for text in log.warnings)
    info = checkpoint_info(tmp_path)
    assert (info.file, info.newest_keyframe_index) == (before, atlas.newest_view)
    kept = kept_keyframes(tmp_path)
    assert [keyframe.index for keyframe in kept] == [0, 1, 2]
    assert all(keyframe.image() is not None for keyframe in kept)


def test_a_run_that_goes_on_from_the_state_before_writes_the_damaged_image_anew(tmp_path: Path) -> None:
    newest, before = two_checkpoints(tmp_path)
    last = max(newest.parent.glob(f"{KEYFRAMES}/*.png"))
    whole = last.read_bytes()
    last.write_bytes(whole[:100])
    atlas, file = load(tmp_path, PLAIN, Stats())
    writer = CheckpointWriter(tmp_path, PLAIN, file)
    assert state_files(tmp_path) == [before]
    atlas.add(view(3), 0)
    writer.submit(atlas.frozen())
    assert writer.wait(LONG)
    assert last.read_bytes() == whole
    assert load(tmp_path, PLAIN, Stats())[0].newest_view == 3


def test_an_image_that_all_states_need_is_looked_at_by_the_mapper_alone(tmp_path: Path) -> None:
    """There is no other state to take, and of a large map to look at all takes as long as to load it."""
    newest, _ = two_checkpoints(tmp_path)
    first = min(newest.parent.glob(f"{KEYFRAMES}/*.png"))
    first.write_bytes(first.read_bytes()[:100])
    assert checkpoint_info(tmp_path).file == newest
    with pytest.raises(ValueError, match=f"{first.name} is damaged"):
        load(tmp_path, PLAIN, Stats())


def test_other_parameters_are_said_and_refused_where_the_map_depends_on_them(tmp_path: Path) -> None:
    written(begun(PLAIN), tmp_path)
    log = Stats()
    load(tmp_path, replace(PLAIN, refinement=500), log)
    assert log.warnings[-1] == "the run goes on with other parameters than it had: refinement=500 (was 6)"
    with pytest.raises(ValueError, match="sh_degree was 0 in that run and is 2 now"):
        load(tmp_path, replace(PLAIN, sh_degree=2), Stats())


def test_a_folder_without_a_checkpoint_says_why(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has no checkpoint: the run ended before its first map"):
        load(tmp_path, PLAIN, Stats())
    with pytest.raises(ValueError, match="is no directory"):
        checkpoint_info(tmp_path / "nowhere")


def test_a_map_in_the_middle_of_a_change_is_not_frozen() -> None:
    atlas = begun(PLAIN)
    atlas.current.state.anchors = atlas.current.state.anchors[:-1]
    with pytest.raises(ValueError, match="middle of a change"):
        atlas.frozen()


def test_no_mutated_byte_raises_anything_but_a_value_error(tmp_path: Path) -> None:
    file = state_files(written(begun(EVERYTHING), tmp_path))[0]
    whole = file.read_bytes()
    random = np.random.default_rng(1)
    refused = 0
    for round in range(150):
        data = bytearray(whole)
        for _ in range(random.integers(1, 4)):
            at = int(random.integers(len(data)))
            match round % 4:
                case 0:
                    data[at] = random.integers(256)
                case 1:
                    del data[at:]
                    data += b"\0"
                case 2:
                    del data[at : at + int(random.integers(1, 64))]
                case 3:
                    data[at:at] = random.bytes(8)
        file.write_bytes(data)
        try:
            load(tmp_path, EVERYTHING, Stats())
        except ValueError:
            refused += 1
    assert refused > 140


@pytest.mark.slow
def test_no_mutated_value_raises_anything_but_a_value_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole files with a value that no mapper writes: wrong types, sizes, numbers that are not finite, none at all.

    They are given as they would be read: to write and read hundreds of whole files takes most of the time.
    """
    file = state_files(written(begun(EVERYTHING), tmp_path))[0]
    meta, arrays = read_state(file)
    del meta["format"], meta["version"]
    texts = (None, -2, 1.5, "x", [[]], 2**70)
    bad = [({**meta, key: value}, arrays) for key in meta for value in texts]
    for key in meta["mappers"][0]:
        bad += [({**meta, "mappers": [{**meta["mappers"][0], key: v}, *meta["mappers"][1:]]}, arrays) for v in texts]
    for key in meta["mappers"][0]["schedule"]:
        for value in texts:
            part = {**meta["mappers"][0], "schedule": {**meta["mappers"][0]["schedule"], key: value}}
            bad.append(({**meta, "mappers": [part, *meta["mappers"][1:]]}, arrays))
    for name, value in arrays.items():
        if name.startswith("map1"):
            continue  # as map0
        bad.append((meta, {k: v for k, v in arrays.items() if k != name}))
        bad.append((meta, {**arrays, name: value.astype(np.complex64)}))
        bad.append((meta, {**arrays, name: value[..., None]}))
        if value.dtype.kind == "f" and value.size:
            wrong = value.copy()
            wrong.flat[0] = np.inf
            bad.append((meta, {**arrays, name: wrong}))
    assert len(bad) > 250
    taken: list[dict[str, Any]] = []
    for head, columns in bad:
        read = json.loads(json.dumps(head)), columns
        monkeypatch.setattr("mvsgs_core.mapping.checkpoints.files.read_arrays", lambda *_, read=read: read)
        try:
            load(tmp_path, EVERYTHING, Stats())
            taken.append(head)
        except ValueError:
            continue
    changed = {key for head in taken for key in head if head[key] != meta[key]}
    assert changed <= {"splats", "stream_ended", "revision", "config", "mappers", "stream_seconds", "newest_view"}, (
        changed
    )
    assert len(taken) < 6


def test_another_version_is_refused_by_its_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvsgs_core.mapping.checkpoints.files.VERSION", VERSION + 1)
    written(begun(PLAIN), tmp_path)
    monkeypatch.undo()
    with pytest.raises(ValueError, match=f"version {VERSION + 1} of the format"):
        load(tmp_path, PLAIN, Stats())


def test_numpy_reads_it_without_pickle(tmp_path: Path) -> None:
    file = state_files(written(begun(PLAIN), tmp_path))[0]
    shutil.copy(file, tmp_path / "copy.npz")
    with np.load(tmp_path / "copy.npz", allow_pickle=False) as content:
        assert json.loads(content["meta"].tobytes())["format"] == "mvsgs checkpoint"
        assert len(content["map0/splats/means"]) == len(content["map0/splats/steps"])
