"""CameraPose, Frame -> SplatMap, Preview: a map that another run left, as it is, and the camera in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msgs import Asked, CameraPose, Frame, Preview, Reply, Request, SplatMap
from mvsgs_core.kept_map import check_kept_map
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.begun import begin_on
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.mapping.keyframes import RGBDKeyframe, training_view
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.preview import preview_arrays, seen
from mvsgs_core.maps.unfinished import what_is_missing
from mvsgs_core.stats import Stats
from nodes import Node
from nodes.once import Once
from nodes.previews import PreviewConfig, Previews
from nodes.splat_map import splat_map

NEWEST = 8  # frames that wait for their poses, to be shown
NO_DEPTH = np.zeros((1, 1), dtype=np.float32)


class FrozenMapper(Node):
    """Trains nothing: the map is sent at the end as it was kept, so that it is scored by the frames found in it.

    A preview shows the newest frame that was found beside the map's render from its pose.
    """

    @dataclass(frozen=True)
    class Config(PreviewConfig):
        map: str | None = None  # output of the run that kept the map
        keep_map: bool = False  # it is kept where it is

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self.check(self.config)
        self.atlas = self._begun_on(self.config.map or "")
        self._once = Once(self.stats)
        self._found: Counter[int] = Counter()  # frames in each part of the map
        self._frames: dict[int, Frame] = {}
        self._previews = Previews(self, self.config)

    @classmethod
    def check(cls, config: Config) -> None:
        if config.map is None:
            raise ValueError("which map? give map=DIR, the output directory of a run with keep_map=true")
        check_kept_map(config.map)
        checkpoint_info(config.map)

    def on_frame(self, frame: Frame) -> Iterator[Preview]:
        """For previews alone."""
        if self._previews.wanted:
            self._frames[frame.index] = frame
            for index in sorted(self._frames)[:-NEWEST]:
                del self._frames[index]
        yield from ()

    def on_camera_pose(self, pose: CameraPose) -> Iterator[Preview]:
        self._found[pose.segment] += 1
        self.stats.values |= {"splats": len(self._mapper.state), "confidence": round(pose.confidence, 3)}
        frame = self._frames.get(pose.index)
        if frame is not None and self._previews.due:
            self._previews.begin()
            yield self._preview(pose, frame)

    def on_request(self, request: Request) -> Iterator[Reply]:
        if not self._once.request(request):
            return
        said, problem = "it localizes", request.problem
        if request.asked == Asked.PAUSE:
            said = "paused" if request.on else "the stream goes on"
        elif request.asked == Asked.LOAD_MAP and not problem:
            try:
                self.atlas = self._begun_on(request.folder)
                self._found.clear()  # parts and poses of the map before
                self._frames.clear()
                said = f"the camera is looked for in {request.folder}"
            except ValueError as error:
                problem = f"the camera is looked for in {request.folder}, whose splats cannot be taken up: {error}"
        yield Reply(request.number, not problem, problem or said)

    def on_end(self) -> Iterator[SplatMap | Preview]:
        yield splat_map(self._mapper.snapshot(), refined=True)

    def _begun_on(self, folder: str) -> Atlas:
        """Raises ValueError."""
        if missing := what_is_missing(folder):
            self.stats.warn(f"{folder}: {missing}")
        return begin_on(Path(folder), self.config, Stats())

    @property
    def _mapper(self) -> OnlineMapper:
        """The part of the map that most frames were found in."""
        for segment, _ in self._found.most_common():
            if segment in self.atlas.parts:
                return self.atlas.parts[segment]
        return self.atlas.current

    def _preview(self, pose: CameraPose, frame: Frame) -> Preview:
        mapper = self._mapper
        keyframe = RGBDKeyframe(frame.index, frame.image, frame.intrinsics, pose.world_from_cam, NO_DEPTH)
        local = mapper.frame.local(pose.world_from_cam)
        view = training_view(keyframe, local, self.config.max_pixels, mapper.state.device)
        shown = preview_arrays(mapper, self.config.preview_splats)
        camera = pose.world_from_cam.copy()
        camera[:3, 3] -= shown["origin"]
        return Preview(
            **shown
            | {
                "index": frame.index,
                "world_from_cam": camera,
                **seen(mapper, view),
                "keyframes": np.append(shown["keyframes"], frame.index),
                "splats": np.append(shown["splats"], 0),
                "keyframe_poses": np.concatenate([shown["keyframe_poses"], camera[None]]),
            }
        )
