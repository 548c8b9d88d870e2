"""Frame -> CameraPose, TrackerPhase, Trajectory: finds each frame in a map that another run left, and adds nothing."""

from __future__ import annotations

from dataclasses import dataclass

from nodes.tracker import Tracker


class Localizer(Tracker):
    """The tracker of a frozen map, see mvsgs_core.tracking.frozen_session. `map` must be given.

    Each pose is a line of localization.csv in the output, as soon as it is known.
    """

    @dataclass(frozen=True)
    class Config(Tracker.Config):
        pass

    config: Config
    only_localizes = True
    restartable = False

    @classmethod
    def check(cls, config: Tracker.Config) -> None:
        if config.map is None:
            raise ValueError("which map? give map=DIR, the output directory of a run with keep_map=true")
        super().check(config)
