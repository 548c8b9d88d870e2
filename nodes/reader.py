"""Source: a recorded or generated sequence; its ground truth has a topic of its own, so that no estimator can peek."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from msgs import Frame, GroundTruth
from mvsgs_core import datasets
from mvsgs_core.datasets import Item, check, open_dataset, options_of
from mvsgs_core.datasets.options import FileOptions
from mvsgs_core.datasets.sequence import ImageSequence
from mvsgs_core.export.source_camera import LENS, lens_values
from nodes import Advice, Node
from nodes.fixed_mask import FixedMask
from nodes.parameters import Parameter, parameter_names, parameters
from nodes.playback import Playback


class Reader(Node):
    """Any sequence that `mvsgs_core.datasets.open_dataset` opens -> Frame and GroundTruth of each of its frames."""

    replayable = True

    @dataclass
    class Config(FileOptions):
        name: str  # format, a file of mvsgs_core.datasets
        realtime: bool = False  # play at the recorded rate, not as fast as it is read
        hide_fixed: bool = True  # mask what is fixed to the camera: bars, a logo, a car's hood; not beside `mask`
        options: dict[str, Any] = field(default_factory=dict)  # of that format: see its class in mvsgs_core.datasets

    config: Config

    @classmethod
    def check(cls, config: Config) -> None:
        check(config.name, **_options(config))

    @classmethod
    def advise(cls, config: Config) -> Mapping[str, Advice]:
        """Of a folder of images: the tracker of photographs where they step wide."""
        if config.name != datasets.PLAIN or config.realtime:
            return {}
        from mvsgs_core.photographs import steps as measured  # loads what only the tracker needs

        sequence = open_dataset(config.name, **_options(config))
        assert isinstance(sequence, ImageSequence)
        steps = measured.measure_steps(sequence.successive(measured.chosen_pairs(len(sequence)), measured.ENOUGH))
        if not steps.wide:
            return {}
        if len(sequence) > measured.MOST:
            why = f"{steps}, but {len(sequence)} are too many for tracker=photographs, which waits for all"
            return {"tracker": Advice("dense", why)}
        why = f"{steps}, so they are taken for photographs; tracker=dense takes them for a video"
        return {"tracker": Advice("photographs", why, {"because": why})}

    @classmethod
    def keys_of(cls, config: Config) -> Mapping[str, Sequence[Parameter]]:
        shared = parameter_names(FileOptions)
        own = [parameter for kind in options_of(config.name) for parameter in parameters(kind)]
        return {"options": [parameter for parameter in own if parameter.name not in shared]}

    def run(self) -> Iterator[Frame | GroundTruth]:
        sequence = open_dataset(self.config.name, **_options(self.config))
        self.stats.values["frames_expected"] = len(sequence)
        self.stats.values[LENS] = lens_values(sequence.lens)
        self._pass_warnings_on(sequence)  # those that opening gave; the others are counted until the end
        playback = Playback(self.stats.warn)
        fixed = FixedMask(self.stats, self.config.hide_fixed and self.config.mask is None)
        frames = map(fixed.masked, sequence) if self.config.realtime else fixed.masked_ahead(sequence)
        try:
            while True:
                with self.stats.time("read"):
                    item = next(frames, None)
                if item is None:
                    return
                captured = playback.wait(item.timestamp) if self.config.realtime else 0.0
                self.stats.count("frames")
                guessed, exposure = item.intrinsics_guessed, item.exposure
                yield Frame(
                    item.index, item.timestamp, item.image, item.intrinsics, guessed, exposure, captured=captured,
                    place=item.place, mask=item.mask, original_intrinsics=item.original,
                )  # fmt: skip
                yield _ground_truth(item)
        finally:  # also when the run is interrupted
            self._pass_warnings_on(sequence)

    def _pass_warnings_on(self, sequence: datasets.Sequence) -> None:
        self.stats.warnings.include(sequence.warnings)


def _options(c: Reader.Config) -> dict[str, Any]:
    """Of `open_dataset`: those that were given, for not every format takes all of them."""
    own, unset = {f.name: getattr(c, f.name) for f in fields(FileOptions)}, vars(FileOptions())
    return {name: value for name, value in own.items() if value != unset[name]} | c.options


def _ground_truth(item: Item) -> GroundTruth:
    return GroundTruth(
        item.index, item.timestamp, item.image, item.intrinsics, item.world_from_cam, item.depth, mask=item.mask
    )
