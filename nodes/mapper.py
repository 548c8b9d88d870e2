"""FusedKeyframe, TrackedFrame, Poses, Keyframe -> SplatMap, Preview: builds the map, optimizes and refines it."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from msgs import Asked, FusedKeyframe, Keyframe, Poses, Preview, Reply, Request, SplatMap, TrackedFrame
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.keyframe_images import write_image
from mvsgs_core.export.source_camera import source_camera
from mvsgs_core.held_out import is_held_out
from mvsgs_core.kept_map import check_kept_map
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints import checkpoint
from mvsgs_core.mapping.checkpoints.begun import begin_on
from mvsgs_core.mapping.checkpoints.checkpointing import Checkpointing
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.mapping.checkpoints.replay import Replay
from mvsgs_core.mapping.checkpoints.saved_map import SavedMap
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.losses import loss_function
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.self_check import why_nothing
from mvsgs_core.mapping.trainer import FINAL_RATE
from mvsgs_core.mapping.warm_up import warm_up
from mvsgs_core.maps.unfinished import what_is_missing
from mvsgs_core.pace import Effort, Pace
from mvsgs_core.setting_ranges import at_least
from nodes import Node
from nodes.last_seconds import LastSeconds
from nodes.mapped_messages import frame_between, rgbd_keyframe
from nodes.once import Once
from nodes.previews import GrowingPreviews, PreviewConfig
from nodes.runtime.freed_memory import return_large_blocks
from nodes.saved_maps import ABORT, SavedMaps
from nodes.splat_map import splat_map

_SLICE = 0.05  # seconds of optimization in one on_idle
EFFORTS = (  # one by the number of halvings of the image
    Effort("full", 1.0),
    Effort("new splats as of half the image's size", 0.5),
    Effort("no new splats for now", 0.1, telling=False),
)


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
    class Config(PreviewConfig):
        output: str | None = None  # folder for map.ply and cameras.json; null: none is written
        checkpoint: float = 30.0  # seconds of the stream or the clock between checkpoints in the output; 0: none
        keep_map: bool = False  # the finished map's checkpoint stays, for another run to begin on
        map: str | None = None  # output of a run whose map is gone on with; null: a new map
        resume: str | None = None  # output of a run whose checkpoint is gone on with; null: a new map
        save_images: bool = False  # write each keyframe's image to output/keyframes, for a COLMAP model

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        return_large_blocks()
        self._pace = Pace(EFFORTS, self.config.share, self.stats, None if self.config.realtime else (0,))
        self._pace.waiting = lambda: self.waiting(FusedKeyframe)
        self._once = Once(self.stats)
        self._last_captured = 0.0  # of the keyframes that came
        self._last_seconds = LastSeconds()
        self._previews = GrowingPreviews(self, self.config)
        self.atlas, resumed = Atlas(OnlineMapper(self.config, self.stats)), None
        self._replay: Replay | None = None
        if self.config.resume is not None:
            self.atlas, resumed = checkpoint.load(Path(self.config.resume), self.config, self.stats)
            self._replay = Replay(self.atlas)
        elif self.config.map is not None:
            self.atlas = self._begun_on(self.config.map)
            self._previews.unshown = True
        self._checkpoints: Checkpointing | None = None
        if self.config.output is not None:
            self._checkpoints = Checkpointing(Path(self.config.output), self.config.checkpoint, self.atlas, resumed)
        self._frozen = False  # frames are only found in the map
        self._one_before = ""  # where the map is in whose place another was begun on request; empty: none was
        self._counted_before: dict[str, float] = {}  # up to then
        self._saved = SavedMaps(self.stats)
        warm_up(self.config, self.atlas.current.state.device)

    @classmethod
    def check(cls, config: Config) -> None:
        at_least(config, checkpoint=0)
        if config.training.loss_function is not None:
            loss_function(config.training.loss_function)
        config.refine.check()
        if config.resume is not None:
            checkpoint_info(config.resume)
        elif config.map is not None:
            check_kept_map(config.map)
            checkpoint_info(config.map)

    def on_fused_keyframe(self, fused: FusedKeyframe) -> Iterator[Preview]:
        if not self._once.keyframe(fused):
            return
        self._previews.came(fused)
        if self._replay and not self._replay.view(fused.index, fused.world_from_cam, fused.scale):
            self._pass_over(
                "keyframes that do not fit" if self._replay.problem else "keyframes that the checkpoint has"
            )
            return
        self._settle()
        self._pace.came(fused.timestamp)
        with self._pace.spend() as effort:
            added = self._add(fused, effort)
        self.stats.arrived("keyframe to map", fused.captured)
        self._previews.mapped(fused)
        self._came(fused)
        self._save_image(fused)
        if self._checkpoints is not None and added is not None:
            self._checkpoints.added(added)
        self._keep()
        self._report()
        yield from self._previews.of(self.atlas)

    def on_tracked_frame(self, frame: TrackedFrame) -> Iterator[Preview]:
        if is_held_out(frame.index):
            self.stats.refuse("frames", 1, "the tracker sent held-out frames to be trained on: they were refused")
        elif self._once.frame(frame) and (not self._replay or not self._replay.problem):
            self.atlas.add_between(frame_between(frame))
        yield from ()

    def on_keyframe(self, keyframe: Keyframe) -> Iterator[Preview]:
        if not self._previews.wanted:
            return
        self._came(keyframe)
        self._previews.see(keyframe)
        yield from self._previews.of(self.atlas)

    def on_poses(self, poses: Poses) -> Iterator[Preview]:
        if not self._once.poses(poses):
            return
        self._previews.correct(poses)
        if self._replay and not self._replay.poses(poses.revision, poses.index, poses.world_from_cam, poses.scale):
            self._pass_over()
            return
        self._settle()  # the map must not depend on when they come
        self.atlas.revision = max(self.atlas.revision, poses.revision)
        self.atlas.correct(
            poses.index, poses.world_from_cam, poses.scale, poses.segment, poses.exposure, poses.vignetting,
            poses.velocity, poses.readout_time, poses.reads_columns,
        )  # fmt: skip
        yield from ()

    def on_request(self, request: Request) -> Iterator[Reply]:
        """In its place among the keyframes; the reply to what is written to a disk comes when it is there."""
        if not self._once.request(request):
            return
        if request.problem or request.asked == Asked.PAUSE:
            paused = "paused" if request.on else "the stream goes on"
            yield Reply(request.number, not request.problem, request.problem or paused)
            return
        self._settle_last() if request.asked == Asked.LOCALIZE else self._settle()
        if (reply := self._meet(request, Reply(request.number, True, ""))) is not None:
            yield reply

    def on_idle(self) -> list[Preview | Reply] | None:
        replies: list[Preview | Reply] = list(self._saved.replies())
        deadline = time.perf_counter() + _SLICE
        if self._frozen or not self._piece():
            self._keep()
            return [*replies, *(self._previews.of(self.atlas, due=True) if self._previews.unshown else ())] or None
        while time.perf_counter() < deadline and self._piece():
            pass
        self._keep()
        self._report()
        return [*replies, *self._previews.of(self.atlas)]

    def _piece(self) -> bool:
        """An iteration; of a live stream the first splats of a keyframe without any before it, and where none is
        pending, a piece of what there was no time for."""
        if self._live and self.atlas.begin_late():
            return True
        return self.atlas.step() or (self._live and self.atlas.make_up(self._pace.fits))

    @property
    def _live(self) -> bool:
        return self.config.realtime and self._last_captured > 0.0

    def on_end(self) -> Iterator[SplatMap | Preview | Reply]:
        yield from self._saved.replies(wait=True)
        if self._replay is None:
            self._once.report_missing()
        just_ended = self._last_seconds.running
        self._settle_last()
        self.atlas.finish()
        self._settle_last()
        if just_ended:
            self.stats.arrived("last keyframe to the map before its refinement", self._last_captured)
        if not self.atlas.refined:
            yield splat_map(self.atlas.current.snapshot(), refined=False)
        else:
            self.stats.warn("the run was cut off within its refinement: the map before that is not reported")
        while not self._frozen and (self._made_up() or self.atlas.refine()):
            self._keep()
            if self.config.realtime:
                yield from self._previews.of(self.atlas)
        self._report()
        self._check()
        if self._checkpoints is not None and len(self.atlas.current.state):
            source = source_camera(self.upstream)
            self.stats.values["map_bytes"] = self._checkpoints.finish(self.atlas, source, self.rest)
        yield from self._previews.of(self.atlas, due=True)  # who watches is left with the map as it is now
        yield splat_map(self.atlas.current.snapshot(), refined=True)
        if self._checkpoints is not None:
            self._checkpoints.close(self.atlas, keep=self.config.keep_map)
            self._checkpoints = None
        self._saved.close()

    def _made_up(self) -> bool:
        """A piece of what a live stream left no time for: this one, or that whose map is gone on with."""
        return (self.config.realtime or len(self.atlas.current.coarse) > 0) and self.atlas.make_up()

    def on_abort(self, reason: str) -> None:
        began = time.monotonic()
        if self._checkpoints is not None:
            self._checkpoints.last(self.atlas)
        self._saved.close(began + ABORT - time.monotonic())

    def _add(self, fused: FusedKeyframe, halvings: int) -> TrainingView | None:
        return self.atlas.add(rgbd_keyframe(fused), fused.segment, halvings)

    def _meet(self, request: Request, reply: Reply) -> Reply | None:
        """Does the mapper's part. None: the reply comes later, with what is written to a disk."""
        if request.asked == Asked.LOCALIZE:
            self._frozen = request.on
            what = "frames are only found in the map, which stays as it is" if request.on else "the map grows again"
            return replace(reply, message=what)
        try:
            saved = SavedMap(self.atlas, self.config, Path(request.kept or request.folder))
        except (OSError, ValueError) as error:
            if request.asked == Asked.SAVE_MAP or len(self.atlas.largest.state):
                return replace(reply, success=False, message=str(error))
            saved = None
        kept = "there was nothing to keep of the one before"
        before = kept if saved is None else f"the one before is in {saved.what}"
        if request.asked != Asked.SAVE_MAP:
            self._one_before, self._counted_before = before, dict(self.stats.counts)
        if request.asked == Asked.RESET:
            self._go_on_with(Atlas(OnlineMapper(self.config, self.stats)))
            self._frozen = False  # a new map has to grow
            reply = replace(reply, message=f"a new map begins; {before}")
        elif request.asked == Asked.LOAD_MAP:
            reply = self._load(request.folder, before, reply)
        elif saved is not None:
            reply = replace(reply, message=saved.what)
        if saved is None:
            return reply
        self._saved.begin(saved, reply, last=request.asked != Asked.SAVE_MAP)
        return None

    def _load(self, folder: str, before: str, reply: Reply) -> Reply:
        """Goes on in a map in which the tracker looks for the camera already."""
        try:
            self._go_on_with(self._begun_on(folder))
            self._previews.unshown = True
        except ValueError as error:
            self._go_on_with(Atlas(OnlineMapper(self.config, self.stats)))
            what = f"the camera is looked for in {folder}, but its splats cannot be taken up ({error}); {before}"
            return replace(reply, success=False, message=what)
        return replace(reply, message=f"the camera is looked for in {folder}; {before}")

    def _begun_on(self, folder: str) -> Atlas:
        """Raises ValueError."""
        if missing := what_is_missing(folder):
            self.stats.warn(f"{folder}: {missing}")
        return begin_on(Path(folder), self.config, self.stats)

    def _go_on_with(self, atlas: Atlas) -> None:
        """Another map; what is counted goes on."""
        self.atlas, self._replay = atlas, None
        self._previews.begin_anew()

    def _pass_over(self, counted: str = "") -> None:
        """A message that is not taken in, as the checkpoint has it or the stream does not fit, which is said."""
        if counted:
            self.stats.skip(counted)
        if self._replay is not None and self._replay.problem:
            self.stats.warn(self._replay.problem)
            self.atlas.between.waiting.clear()

    def _settle(self) -> None:
        """Does the pending iterations. In real time that is left for when nothing else is to be done."""
        while not self.config.realtime and self.atlas.step():
            self._keep()

    def _settle_last(self) -> None:
        """The stream has ended: the pending iterations; of a live one those that its last frame may wait for."""
        if self._frozen:
            return
        for passed in self._last_seconds.passed() if self._last_captured else itertools.repeat(0.0):
            rate = FINAL_RATE**passed  # what the last images pulled at would show
            if self._live:
                done = self.atlas.begin_late() or self.atlas.make_up(splats=False, rate=rate)
            else:
                done = self.atlas.step()
            if not done:
                break
            self._keep()

    def _came(self, keyframe: FusedKeyframe | Keyframe) -> None:
        """Of a live stream, whose latencies are measured."""
        if keyframe.captured > 0.0:
            self._last_captured = max(self._last_captured, keyframe.captured)
            self._last_seconds.came(keyframe.captured)

    def _keep(self) -> None:
        """Between two iterations, where nothing is half changed."""
        self.rest()
        if self._checkpoints is not None:
            self._checkpoints.keep(self.atlas)

    def _save_image(self, fused: FusedKeyframe) -> None:
        """A disk that is full costs images, not the map."""
        if not self.config.save_images or self.config.output is None:
            return
        try:
            write_image(Path(self.config.output) / keyframe_images.FOLDER, fused.index, fused.image)
            self.stats.count("images_saved")
        except OSError as error:
            self.stats.skip("images_not_saved")
            self.stats.warn(f"images of keyframes cannot be saved: {error.strerror or error}")

    def _report(self) -> None:
        self.stats.values |= self.atlas.current.figures

    def _check(self) -> None:
        mapper = self.atlas.current
        if not len(mapper.state):
            why = why_nothing(self.stats, self._counted_before)
            asked = f"another map was begun on request ({self._one_before}); since then " if self._one_before else ""
            self.stats.nothing(asked + why)
        found = mapper.self_check()
        if found is None:
            return
        self.stats.values |= {"keyframe_psnr": found.psnr, "image_noise": found.noise}
        if found.warning:
            self.stats.warn(found.warning)
