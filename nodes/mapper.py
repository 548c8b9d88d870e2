"""FusedKeyframe, Poses, Keyframe -> SplatMap, Preview: builds the map, optimizes it, refines it at the end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msgs import FusedKeyframe, Keyframe, Poses, Preview, SplatMap
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.keyframe_images import write_image
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints import checkpoint
from mvsgs_core.mapping.checkpoints.checkpointing import Checkpointing
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.mapping.checkpoints.replay import Replay
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.preview import preview_arrays
from mvsgs_core.mapping.provisional import CoarseKeyframe, Provisional
from nodes import Node

_SLICE = 0.05  # seconds of optimization in one on_idle


class Mapper(Node):
    """The online mapper as a node.

    Without `realtime` every keyframe gets all its iterations before the next is added, whatever the timing: a slow
    mapper holds the senders back, and the result is the same in one process as in many.

    Parts of the stream between which tracking was lost share no frame of reference: each gets a map of its own. Where
    Poses say that a loop joined two, so are their maps; of those that stay apart, the one with the most keyframes is
    refined and sent.

    Keyframes are read for the previews alone: until a keyframe's FusedKeyframe comes, its coarse depth stands in there.
    """

    @dataclass(frozen=True)
    class Config(MapperConfig):
        preview_period: float = 1.0  # seconds between previews; 0: none
        preview_splats: int = 100000  # at most so many in a preview
        output: str | None = None  # folder for map.ply and cameras.json; null: none is written
        checkpoint: float = 30.0  # seconds of the stream or the clock between checkpoints in the output; 0: none
        keep_checkpoint: bool = False  # of the finished map, after a complete run
        resume: str | None = None  # output of a run whose checkpoint is gone on with; null: a new map
        save_images: bool = False  # write each keyframe's image to output/keyframes, for a COLMAP model

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self.atlas, resumed = Atlas(OnlineMapper(self.config, self.stats)), None
        self._replay: Replay | None = None
        if self.config.resume is not None:
            self.atlas, resumed = checkpoint.load(Path(self.config.resume), self.config, self.stats)
            self._replay = Replay(self.atlas)
        self._checkpoints: Checkpointing | None = None
        if self.config.output is not None:
            self._checkpoints = Checkpointing(Path(self.config.output), self.config.checkpoint, self.atlas, resumed)
        self._last_preview = 0.0
        self._provisional = Provisional(self.config.preview_splats)

    @classmethod
    def check(cls, config: Config) -> None:
        if config.resume is not None:
            checkpoint_info(config.resume)

    @property
    def mapper(self) -> OnlineMapper:
        return self.atlas.current

    def on_fused_keyframe(self, view: FusedKeyframe) -> Iterator[Preview]:
        self._provisional.came(view.index)
        if not self._is_new_view(view):
            return
        # sent on its way before its segment was joined: by keyframe and not by number, as the pose is corrected so, too
        segment = self.atlas.segment_of.get(view.index, view.segment)
        self._settle()
        self.atlas.enter(segment)
        self.atlas.came(view.index, view.timestamp)
        known = len(self.mapper.views)
        self.mapper.add_keyframe(
            RGBDKeyframe(
                index=view.index, image=view.image, intrinsics=view.intrinsics, world_from_cam=view.world_from_cam,
                depth=view.depth, scale=view.scale, confidence=view.confidence, normals=view.normals,
                unfiltered=view.unfiltered, timestamp=view.timestamp,
            )
        )  # fmt: skip
        self._save_image(view)
        self._report()
        if self._checkpoints is not None:
            for added in self.mapper.views[known:]:
                self._checkpoints.added(added)
            self._checkpoints.keep(self.atlas)
        yield from self._preview()

    def on_keyframe(self, keyframe: Keyframe) -> Iterator[Preview]:
        if not self._previewing:
            return
        self._provisional.see(
            CoarseKeyframe(
                index=keyframe.index, image=keyframe.image, intrinsics=keyframe.intrinsics, scale=keyframe.scale,
                world_from_cam=keyframe.world_from_cam, inverse_depth=keyframe.inverse_depth,
                weight=keyframe.inverse_depth_weight, segment=keyframe.segment,
            )
        )  # fmt: skip
        yield from self._preview()

    def on_poses(self, poses: Poses) -> Iterator[Preview]:
        self._provisional.correct(poses.index, poses.world_from_cam, poses.scale, poses.segment)
        if self._replay and not self._replay.poses(poses.revision, poses.index, poses.world_from_cam, poses.scale):
            self._say_what_does_not_fit()
            return
        self._settle()  # the map must not depend on when they come
        self.atlas.revision = max(self.atlas.revision, poses.revision)
        self.atlas.correct(poses.index, poses.world_from_cam, poses.scale)
        if poses.segment is not None:
            self.atlas.segment_of.update(zip(poses.index.tolist(), poses.segment.tolist()))
            self.atlas.join()
        yield from ()

    def on_idle(self) -> list[Preview] | None:
        deadline = time.perf_counter() + _SLICE
        if not self.mapper.step():
            return None
        while time.perf_counter() < deadline and self.mapper.step():
            pass
        self._keep()
        self._report()
        return list(self._preview())

    def on_end(self) -> Iterator[SplatMap | Preview]:
        self._settle(realtime=False)
        self.atlas.stream_ended = True
        self._choose_largest()
        self.stats.values["segments_apart"] = max(0, len(self.atlas.parts) - 1)  # beside the map that is shown
        yield self._map(refined=False)
        while self.atlas.refined < self.config.refinement:
            self.mapper.refine(self.atlas.refined, self.config.refinement)
            self.atlas.refined += 1
            self._keep()
        self._report()
        self._check()
        if not len(self.mapper.state):
            self.stats.nothing(self._why_nothing())
        elif self._checkpoints is not None:
            self.stats.values["map_bytes"] = self._checkpoints.finish(self.atlas)
        yield from self._preview(due=True)  # who watches is left with the map as it is now
        yield self._map(refined=True)
        if self._checkpoints is not None:
            self._checkpoints.close(self.atlas, keep=self.config.keep_checkpoint)
            self._checkpoints = None

    def on_abort(self, reason: str) -> None:
        if self._checkpoints is not None:
            self._checkpoints.last(self.atlas)

    def _is_new_view(self, view: FusedKeyframe) -> bool:
        if self._replay is None or self._replay.view(view.index, view.world_from_cam, view.scale):
            return True
        self.stats.skip(
            "keyframes that the checkpoint has" if not self._replay.problem else "keyframes that do not fit"
        )
        self._say_what_does_not_fit()
        return False

    def _say_what_does_not_fit(self) -> None:
        if self._replay is not None and self._replay.problem:
            self.stats.warn(self._replay.problem)

    def _settle(self, realtime: bool = True) -> None:
        """Does the pending iterations. realtime: where the mapper is, it is left for the next keyframe to cancel."""
        while not (realtime and self.config.realtime) and self.mapper.step():
            self._keep()

    def _keep(self) -> None:
        """Between two iterations, where nothing is half changed."""
        self.rest()
        if self._checkpoints is not None:
            self._checkpoints.keep(self.atlas)

    def _why_nothing(self) -> str:
        counts = self.stats.counts
        views, refused = int(counts.get("views", 0)), int(counts.get("refused_views", 0))
        if not views and not refused:
            return "the mapper made no splat: no keyframe with depth came to it"
        if not views:
            return f"the mapper made no splat: all {refused} keyframes were refused ({self.stats.warnings[0]})"
        blind = int(counts.get("views_without_depth", 0))
        if blind == views:
            return f"the mapper made no splat: none of {views} keyframes had a pixel with depth after the filters"
        return (
            f"the mapper has no splat left: {views} keyframes, {views - blind} of them with depth, gave "
            f"{int(counts.get('inserted', 0))} splats; all of them faded out"
        )

    def _save_image(self, view: FusedKeyframe) -> None:
        """A disk that is full costs images, not the map."""
        if not self.config.save_images or self.config.output is None:
            return
        try:
            write_image(Path(self.config.output) / keyframe_images.FOLDER, view.index, view.image)
            self.stats.count("images_saved")
        except OSError as error:
            self.stats.skip("images_not_saved")
            self.stats.warn(f"images of keyframes cannot be saved: {error.strerror or error}")

    def _choose_largest(self) -> None:
        parts = list(self.atlas.parts.values())
        if len(parts) < 2:
            return
        self.atlas.current = self.atlas.largest
        total = sum(len(mapper.views) for mapper in parts)
        self.stats.warn(
            f"tracking was lost: the map shows the largest of {len(parts)} parts, "
            f"{len(self.mapper.views)} of {total} keyframes"
        )

    def _report(self) -> None:
        self.stats.values["splats"] = len(self.mapper.state)
        self.stats.values["iterations"] = self.mapper.iterations
        self.stats.values["iterations_pending"] = self.mapper.schedule.pending
        self.stats.values["image_bytes"] = self.mapper.keyframes.image_bytes

    def _check(self) -> None:
        found = self.mapper.self_check()
        if found is None:
            return
        self.stats.values |= {"keyframe_psnr": found.psnr, "image_noise": found.noise}
        if found.warning:
            self.stats.warn(found.warning)

    def _map(self, refined: bool) -> SplatMap:
        final = self.mapper.snapshot()
        arrays = {name: value.numpy() for name, value in final.splats.tensors().items()}
        return SplatMap(
            refined=refined, iterations=final.iterations, kernel=final.kernel, origin=final.origin, **arrays,
            anchors=final.anchors, keyframes=final.keyframes, world_from_cam=final.world_from_cam, scale=final.scale,
            exposures=final.exposures,
        )  # fmt: skip

    @property
    def _previewing(self) -> bool:
        return self.config.preview_period > 0 and Preview not in self.unread

    def _preview(self, due: bool = False) -> Iterator[Preview]:
        now = time.monotonic()
        due |= now - self._last_preview >= self.config.preview_period
        if not self._previewing or not due or not self.mapper.views or not len(self.mapper.state):
            return
        self._last_preview = now
        view = self.mapper.views[-1]
        with self.stats.time("provisional"):
            segments = {segment for segment, part in self.atlas.parts.items() if part is self.mapper}
            provisional = self._provisional.splats(self.mapper, segments)
        arrays = preview_arrays(self.mapper, self.config.preview_splats, provisional)
        origin = np.zeros(3) if self.mapper.frame.origin is None else self.mapper.frame.origin
        poses = np.stack([view.world_from_cam for view in self.mapper.views])
        poses[:, :3, 3] -= origin
        yield Preview(
            index=view.index, iterations=self.mapper.iterations, world_from_cam=poses[-1],
            intrinsics=view.intrinsics, image=view.image.cpu().numpy(), **arrays,
            keyframes=np.array([view.index for view in self.mapper.views], dtype=np.int64), keyframe_poses=poses,
            origin=origin,
        )  # fmt: skip
