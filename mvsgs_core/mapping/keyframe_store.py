"""The keyframes of a map with the frames between them, and the bounded number of images that are kept to train on."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Iterable

import numpy as np

from mvsgs_core.mapping.background import Background
from mvsgs_core.mapping.between import BetweenView
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.owed import Owed
from mvsgs_core.mapping.resting_images import bytes_of, rest, room_of
from mvsgs_core.mapping.thinning import closest
from mvsgs_core.stats import Stats


class KeyframeStore:
    """In the order of the stream. Beyond `max_images`, images are let go: first those of frames between keyframes, and
    these frames with them; of keyframes poses, scales and exposures all stay. Before that, older images go to disk,
    where they are trained on as before."""

    def __init__(
        self, max_images: int, window: int, log: Stats, views: Iterable[TrainingView] = (),
        between: Iterable[BetweenView] = (), in_memory: int | None = None,
    ) -> None:  # fmt: skip
        """window: newest keyframes, whose images are never let go. in_memory: images that do not wait on disk; None:
        all."""
        self._max_images, self._window, self._log = max_images, window, log
        self._in_memory = max_images if in_memory is None else awake(in_memory, window)
        self.views = list(views)
        self.with_image = [view for view in self.views if view.has_image]
        self.between = list(between)
        self._by_index = {view.index: view for view in self.views}
        self.owed = Owed()
        self.owed.count(self.with_image)
        self.background = Background(self.views)
        self._depths: list[float] | None = None  # of all keyframes, ascending; None: to be sorted

    def __len__(self) -> int:
        return len(self.views)

    def __contains__(self, index: object) -> bool:
        """Whether the frame of this index is one of the keyframes."""
        return index in self._by_index

    @property
    def median_depth(self) -> float:
        """Of the scene, in the mapper's unit: what lengths are related to."""
        if self._depths is None:
            self._depths = sorted(view.median_depth for view in self.views if view.median_depth > 0)
        known, half = self._depths, len(self._depths) // 2
        if not known:
            return 1.0
        return known[half] if len(known) % 2 else (known[half - 1] + known[half]) / 2

    def corrected(self) -> None:
        """Keyframes have other poses and scales: counts anew what is owed to them, and the depths."""
        self.owed.count(self.with_image)
        self._depths = None

    @property
    def image_bytes(self) -> int:
        """Of the images in memory, and their masks: what grows with the length of a run, to a bound."""
        return sum(bytes_of(view) for view in self.trained if not view.image_on_disk)

    @property
    def trained(self) -> list[TrainingView]:
        """All that is trained on: keyframes, then the frames between them."""
        return [*self.with_image, *self.between]

    def of(self, index: int) -> TrainingView | None:
        """The keyframe of this frame index."""
        return self._by_index.get(index)

    def add(self, view: TrainingView) -> bool:
        """Whether images were let go for it, so that positions in `with_image` have changed."""
        self.views.append(view)
        self.with_image.append(view)
        self._by_index[view.index] = view
        if self._depths is not None and view.median_depth > 0:
            bisect.insort(self._depths, view.median_depth)
        self.background.take([view])
        return self._bound_images() or bool(self.between)

    def add_between(self, view: BetweenView) -> None:
        """A frame between keyframes, one of which it belongs to. Positions in `trained` change."""
        self.between = sorted([*self.between, view], key=lambda known: known.index)
        self._bound_images()

    def take_over(self, other: KeyframeStore, scale: float) -> None:
        """The other's keyframes too, whose unit is `scale` of this one's."""

        def index(view: TrainingView) -> int:
            return view.index

        for view in other.views:
            view.rescale(scale)
            view.fixed = view.fixed and not self.views  # one holds the frame of reference
        self.views = sorted(self.views + other.views, key=index)
        self.with_image = sorted(self.with_image + other.with_image, key=index)
        self.between = sorted(self.between + other.between, key=index)
        self._by_index |= other._by_index
        self._bound_images()
        self.background = Background(self.views)
        self.corrected()

    def place_anew(self, local: Callable[[np.ndarray], np.ndarray], unit: float = 1.0) -> None:
        """The frame of reference has another unit: `local` takes poses (4, 4) of the world to it. unit: its length in
        the one before."""
        for view in self.views:
            view.velocity[:3] /= unit
            view.local_from_cam = local(view.world_from_cam)

    def move(self, velocities: dict[int, np.ndarray], readout_time: float, reads_columns: bool) -> None:
        """Velocities (6,) of the camera by keyframe, a twist a second, and the time in which photographs were read."""
        for view in self.views:
            found = velocities.get(view.index)
            if view.as_taken and found is not None and np.isfinite(found).all():
                view.velocity, view.readout_time, view.reads_columns = found, readout_time, reads_columns
            elif readout_time == 0.0:
                view.readout_time = 0.0
        for between in self.between:
            if between.twist.any():
                between.readout_time, between.reads_columns = readout_time, reads_columns

    def _bound_images(self) -> bool:
        """Lets go the images of the frames, then of the keyframes, whose neighbors in time are closest. Keyframes'
        splats stay, and move with their poses."""
        keyframes, between = self.with_image, self.between
        gone = min(len(between), max(0, len(keyframes) + len(between) - self._max_images))
        if gone:
            out = set(closest([view.index for view in between], range(len(between)), gone))
            self.between = [view for k, view in enumerate(between) if k not in out]
            self._log.skip("frames between keyframes beyond max_keyframes", gone)
        may = range(1, max(1, len(keyframes) - max(1, self._window)))
        thinned = min(len(may), max(0, len(keyframes) - self._max_images))
        if thinned:
            out = set(closest([view.index for view in keyframes], may, thinned))
            for k in out:
                keyframes[k].drop_image()
            self.with_image = [view for k, view in enumerate(keyframes) if k not in out]
            self._log.refuse(
                "images",
                thinned,
                f"more than {self._max_images} keyframes (max_keyframes): images of "
                "older ones are thinned out and no longer trained on",
            )
        self._rest(self._in_memory)
        return gone + thinned > 0

    def rest(self) -> None:
        """All images but those of the newest keyframes go to disk: the stream goes on in another map."""
        self._rest(self._window)

    def _rest(self, in_memory: int) -> None:
        """The oldest images beyond go to disk, with their masks, and of a GPU's those beyond its `room_of`; where the
        disk is full, they stay."""
        waking = sorted((view for view in self.trained if not view.image_on_disk), key=lambda view: view.index)
        room, held = room_of(waking[-1].image.device) if waking else math.inf, sum(map(bytes_of, waking))
        for place, view in enumerate(waking):
            if len(waking) - place <= in_memory and held <= room:
                return
            held -= bytes_of(view)
            if not rest(view, self._log):
                return


def awake(in_memory: int, window: int) -> int:
    """How many images do not wait on disk: what `images_in_memory` says, and the newest keyframes' in any case."""
    return max(in_memory, window)
