"""The final refinement in blocks: the same as of the whole map where there is one, every splat in one of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.blocks.config import RefineConfig
from mvsgs_core.mapping.blocks.job import NOBODY, iterations_of, job_of, merge, parting_of, refined
from mvsgs_core.mapping.blocks.parting import Parting, part
from mvsgs_core.mapping.blocks.refinement import refined_in_blocks, together
from mvsgs_core.mapping.checkpoints.checkpoint import load
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.stats import Stats
from tests.support.small_atlas import PLAIN, begun, written
from tests.support.small_maps import CONFIG, mapped, score
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

SIZE = (24, 32)
MOVING = replace(PLAIN, refinement=12, training=replace(PLAIN.training, refine_poses=True, pose_visits=0))


def corridor(blocks: int | None = 2, keyframes: int = 8, overlap: float = 0.1) -> OnlineMapper:
    """Keyframes along a line that each see a part of it; not yet refined."""
    config = replace(CONFIG, refinement=0, iterations=4, refine=RefineConfig(blocks=blocks, overlap=overlap))
    views = [rgbd_keyframe(k, pose_on_arc(k / (keyframes - 1)), SIZE) for k in range(keyframes)]
    return mapped(views, config)


def refine(mapper: OnlineMapper, total: int) -> int:
    """In blocks, then whole; in how many pieces the former were, 0: it is to be refined whole."""
    pieces = refined_in_blocks(mapper, total)
    if pieces is None:
        return 0
    *waits, merged = pieces
    assert not any(waits)
    for done in range(merged, total):
        mapper.refine(done, total)
    return len(waits) + 1


def test_one_block_is_the_refinement_of_the_whole_map_to_the_bit() -> None:
    """With exposures, pixels left out, frames between keyframes, corrected keyframes and poses that are refined."""
    whole, parted = begun(MOVING).largest, begun(MOVING).largest
    for done in range(12):
        whole.refine(done, 12)
    parting = parting_of(parted, 1)
    *pieces, result = refined(job_of(parted, parting, 0, 12), parted.config)
    assert pieces == [None] * 12
    assert result is not None
    merge(parted, [result])
    for name, value in whole.state.tensors().items():
        assert torch.equal(value, parted.state.tensors()[name]), name
    for a, b in zip(whole.keyframes.trained, parted.keyframes.trained, strict=True):
        assert (a.visits, a.visits_here, a.pose_steps, a.fixed) == (b.visits, b.visits_here, b.pose_steps, b.fixed)
        assert np.array_equal([a.loss_fast, a.loss_slow], [b.loss_fast, b.loss_slow], equal_nan=True)
    for a, b in zip(whole.views, parted.views, strict=True):
        assert np.array_equal(a.pose_delta, b.pose_delta)
    assert whole.iterations == parted.iterations
    assert whole.log.counts == parted.log.counts
    assert whole.trainer.rate == parted.trainer.rate


@pytest.mark.parametrize(("blocks", "uneven"), [(2, 1), (3, 4)])
def test_every_splat_is_owned_and_trained_once(blocks: int, uneven: int) -> None:
    mapper = corridor(blocks)
    splats, parting = len(mapper.state), parting_of(mapper, blocks)
    assert len(parting) == blocks
    assert np.ptp(np.bincount(parting.home)) <= uneven
    work = parting.trained.sum(axis=1) * np.bincount(parting.owner)
    assert work.max() < 1.4 * work.min()
    for b in range(blocks):
        assert parting.needed[b][parting.owner == b].all()
        assert parting.trained[b][parting.home == b].all()
    none = replace(mapper.config, density_control=replace(mapper.config.density_control, mode="none"))
    results = [list(refined(job_of(mapper, parting, b, 2), none))[-1] for b in range(blocks)]
    owned = [len(result.arrays["splats/steps"]) for result in results if result is not None]
    assert owned == np.bincount(parting.owner, minlength=blocks).tolist()
    before = np.sort(mapper.state.anchors.numpy())
    merge(mapper, [result for result in results if result is not None])
    assert len(mapper.state) == splats
    assert np.array_equal(np.sort(mapper.state.anchors.numpy()), before)


def test_the_denser_part_of_a_map_gets_fewer_keyframes() -> None:
    mapper = corridor(overlap=1.0)
    means, log_scales = mapper.state.splats.means.detach().numpy(), mapper.state.splats.log_scales.detach().numpy()
    dense = parting_of(mapper, 2).owner == 0

    def parted(times: int) -> Parting:
        rows = np.concatenate([np.arange(len(means)), np.repeat(np.flatnonzero(dense), times - 1)])
        opacity, nothing = np.ones(len(rows)), np.zeros(len(rows), bool)
        alone = np.zeros(len(mapper.views), bool)
        return part(
            mapper.views, means[rows], log_scales[rows], opacity, mapper.median_depth, 2, 1.0, lambda k: nothing, alone
        )

    for times in (1, 3):
        parting = parted(times)
        keyframes, splats = np.bincount(parting.home), np.bincount(parting.owner)
        assert (keyframes * splats).max() < 1.6 * (keyframes * splats).min()
    assert parted(3).home.sum() > parted(1).home.sum()


def test_where_frames_between_are_trained_on_a_block_is_given_what_the_keyframes_around_show() -> None:
    mapper = corridor(overlap=1.0)
    means, log_scales = mapper.state.splats.means.detach().numpy(), mapper.state.splats.log_scales.detach().numpy()
    opacity, owner = np.ones(len(means)), parting_of(mapper, 2).owner
    told = np.stack([np.flatnonzero(owner == b)[: len(mapper.views)] for b in range(2)])  # a splat each a keyframe

    def given(shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(2, K) bool: whether a block has the other's splats of a keyframe; and whether it trains on that."""

        def shown(k: int) -> np.ndarray:
            return np.isin(np.arange(len(means)), told[:, k])

        parting = part(mapper.views, means, log_scales, opacity, mapper.median_depth, 2, 1.0, shown, shared)
        return np.stack([parting.needed[b][told[1 - b]] for b in range(2)]), parting.trained

    alone = np.zeros(len(mapper.views), bool)
    found, trained = given(alone)
    assert np.array_equal(found, trained)
    last = int(np.flatnonzero(np.diff(trained[0].astype(int)))[0])
    found, trained = given(np.arange(len(alone)) == last)
    home = int(trained[1, last])
    assert found[home, last + 1]
    assert not trained[home, last + 1]
    assert found.sum() == trained.sum() + 1


def test_what_pruning_takes_is_gone_and_nothing_of_another_block_comes() -> None:
    mapper = corridor(2)
    splats, needless = len(mapper.state), mapper.log.counts.get("needless", 0.0)
    refine(mapper, 12)
    assert len(mapper.state) == splats - (mapper.log.counts["needless"] - needless) < splats
    assert int(mapper.state.anchors.min()) > NOBODY


def test_an_image_has_as_many_iterations_in_each_block_and_the_map_ends_as_well() -> None:
    whole, parted = corridor(), corridor()
    for done in range(40):
        whole.refine(done, 40)
    before, parting = parted.iterations, parting_of(parted, 2)
    refine(parted, 40)
    each = 5 * parting.trained.sum(axis=1)  # 40 for 8 images
    last = [together(n, 2) for n in (40, *each.tolist())]  # 8 of 40 over the whole map, for as many of the blocks'
    assert last == [8, *(round(0.2 * n) for n in each.tolist())]
    assert parted.iterations - before == each.sum() - sum(last[1:]) + 8
    assert together(40, 1) == 0
    held_out = [rgbd_keyframe(0, pose_on_arc(t), SIZE) for t in (0.21, 0.5, 0.77)]
    psnr = [np.mean([score(mapper, view) for view in held_out]) for mapper in (whole, parted)]
    assert psnr[1] > psnr[0] - 0.2


def test_blocks_that_see_the_same_leave_out_no_more_splats_than_the_whole_map_would() -> None:
    """Each image's error may grow by as much, however many blocks train on it."""
    whole, parted = corridor(), corridor()
    splats = len(whole.state)
    jobs = [job_of(parted, parting_of(parted, 2), block, 40) for block in range(2)]
    assert max(job.meta["at_home"] for job in jobs) < 0.6  # most see what both have
    for done in range(40):
        whole.refine(done, 40)
    refine(parted, 40)
    assert 0 < splats - len(parted.state) < 1.1 * (splats - len(whole.state))


def test_keyframes_whose_images_were_let_go_are_merged_too() -> None:
    config = replace(
        CONFIG, refinement=0, iterations=4, max_keyframes=6, window=2, refine=RefineConfig(blocks=2, overlap=0.1)
    )
    mapper = mapped([rgbd_keyframe(k, pose_on_arc(k / 7), SIZE) for k in range(8)], config)
    assert sum(view.has_image for view in mapper.views) == 6
    assert refine(mapper, 8) > 0
    assert len(mapper.views) == 8


def test_a_result_of_another_map_is_refused_before_anything_changes() -> None:
    mapper, shorter = corridor(blocks=1), corridor(blocks=1, keyframes=6)
    *_, result = refined(job_of(mapper, parting_of(mapper, 1), 0, 1), mapper.config)
    assert result is not None
    before = shorter.state.tensors()["means"].clone()
    with pytest.raises(ValueError, match="frame 6"):
        merge(shorter, [result])
    assert torch.equal(shorter.state.tensors()["means"], before)


def test_the_same_blocks_come_out_each_time() -> None:
    first, second = corridor(), corridor()
    refine(first, 8)
    refine(second, 8)
    assert all(torch.equal(value, second.state.tensors()[name]) for name, value in first.state.tensors().items())


def test_keyframes_that_see_enough_of_a_block_are_guests_and_no_others() -> None:
    alone, all_ = parting_of(corridor(overlap=1.0), 2), parting_of(corridor(overlap=0.0), 2)
    assert alone.trained.sum() == 8
    assert 8 < all_.trained.sum() <= 16
    assert iterations_of(corridor(), alone, 80) == [50, 30]


def test_a_pose_is_refined_at_home_and_not_where_its_keyframe_is_a_guest() -> None:
    mapper = begun(MOVING).largest
    parting = parting_of(mapper, 2)
    guests = parting.trained & (parting.home != np.arange(2)[:, None])
    assert guests.any()
    steps = [view.pose_steps for view in mapper.views]
    results = [list(refined(job_of(mapper, parting, b, 12), mapper.config))[-1] for b in range(2)]
    assert [view.pose_steps for view in mapper.views] == steps  # the map waits for all blocks
    merge(mapper, [result for result in results if result is not None])
    learned = np.concatenate([result.arrays["views/index"] for result in results if result is not None])
    assert sorted(learned) == [view.index for view in mapper.views]
    assert sum(view.pose_steps for view in mapper.views) > sum(steps)
    assert [view.fixed for view in mapper.views] == [view.fixed for view in begun(MOVING).largest.views]


def test_a_small_map_is_refined_whole_and_a_large_one_in_blocks() -> None:
    assert refined_in_blocks(corridor(blocks=None), 4) is None
    atlas = Atlas(corridor(blocks=None, keyframes=4))
    config = replace(atlas.current.config, refinement=6, refine=RefineConfig(keyframes=2, overlap=1.0))
    atlas.current.config = config
    while atlas.refine():
        assert len(atlas.current.log.values) == 0 or atlas.refined >= 6 - together(6, 2) == 5
    assert atlas.current.log.values["blocks"] == 2
    assert not atlas.refine()


def test_what_is_cut_off_after_the_blocks_goes_on_in_the_merged_map(tmp_path: Path) -> None:
    """And gives the same map, to the bit; cut off before, the map is as it was, and the blocks are made again."""

    def in_parts(cut: int | None) -> tuple[Atlas, list[int]]:
        atlas, total, done = Atlas(corridor()), 40, []
        atlas.parts[0] = atlas.current
        atlas.current.config = replace(atlas.current.config, refinement=total)
        while atlas.refine():
            done.append(atlas.refined)
            if len(done) == cut:
                written(atlas, tmp_path / f"{cut}")
                atlas = load(tmp_path / f"{cut}", atlas.current.config, Stats())[0]
        return atlas, done

    whole, done = in_parts(None)
    blocks = done.count(0)
    assert done[blocks:] == list(range(32, 41))
    for cut in (blocks // 2, blocks + 1, blocks + 2):
        again, others = in_parts(cut)
        assert others[cut:] == done[cut if cut > blocks else 0 :]
        for name, value in whole.current.state.tensors().items():
            assert torch.equal(value, again.current.state.tensors()[name]), (cut, name)
        assert again.current.iterations == whole.current.iterations
        assert again.current.log.counts == whole.current.log.counts


def test_keyframes_that_all_see_the_same_are_refined_whole_unless_blocks_are_asked_for() -> None:
    mapper = corridor(overlap=0.0)
    assert refined_in_blocks(mapper, 4) is not None
    mapper.config = replace(mapper.config, refine=RefineConfig(keyframes=2, overlap=0.0))
    assert refined_in_blocks(mapper, 4) is None


@pytest.mark.parametrize("wrong", [{"blocks": 0}, {"keyframes": 0}, {"overlap": 1.5}, {"address": "auto"}])
def test_wrong_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError):
        RefineConfig(**wrong)


def test_a_block_is_not_given_what_none_of_its_images_shows() -> None:
    mapper = corridor(2, overlap=0.0)
    before = parting_of(mapper, 2)
    foreign = np.flatnonzero(before.needed[0] & (before.owner == 1))
    assert len(foreign) > 10
    mapper.state.splats.opacity_logits.data[torch.from_numpy(foreign)] = -8.0
    after = parting_of(mapper, 2)
    assert not after.needed[0][foreign].any()
    assert after.needed[1][foreign].all()  # its own
    shown = np.zeros(len(mapper.state), bool)
    for view, trained in zip(mapper.views, after.trained[0]):
        if trained:
            shown |= (mapper.trainer.weights(view, mapper.median_depth) >= 1 / 255).numpy()
    assert np.array_equal(after.needed[0], shown | (after.owner == 0))
