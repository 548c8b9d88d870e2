"""A session that goes on in a map: its keyframes are the session's from the start, and the camera is looked for there.

The first frames are searched for in the map as those of a camera that was lost are. Where they are not found, the
session begins a segment of its own, and a loop may join it later.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.tracking.estimation.calibration import LAST
from mvsgs_core.tracking.frames import FrameRecord
from mvsgs_core.tracking.known_map import KnownMap
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.session import Session
from mvsgs_core.trajectory import TrackingState

MAX_OFFSET = 0.01  # of the image's width: by which a camera's rays may miss those of the map's camera


def go_on(session: Session, known: KnownMap, frames: tuple[int, int]) -> None:
    """Gives a session that has seen no frame the keyframes of a map. frames: their (height, width), as they come.

    The map's intrinsics hold: those of the frames must be near them, but for a focal length that is a guess. Raises
    BadFileError for another camera.
    """
    _check_camera(session, known, frames)
    graph = session.graph
    graph.intrinsics, graph.vignetting = known.intrinsics.copy(), known.vignetting.copy()
    if session.calibration.readout_time is None:
        graph.readout_time, graph.reads_columns = known.readout_time, known.reads_columns
        parts = Counter(keyframe.segment for keyframe in known.keyframes)
        session.calibration.readout_of = min(max(parts.values()), LAST)
    session.calibration.settled = True
    session.calibration.guessed = False
    session.calibration.of_map = True
    for keyframe in known.keyframes:
        graph.add(keyframe)
    graph.edges |= known.edges
    session.photometer.take_up()
    for keyframe in known.keyframes:
        session.loops.add(keyframe.index)
        scale = known.scales.get(keyframe.index, 1.0)
        session.publisher.known(keyframe.index, known.exposures.get(keyframe.index), scale)
        if keyframe.index >= 0:  # of this stream, which a tracker before this one followed so far
            record = FrameRecord(keyframe.index, keyframe.image.timestamp, TrackingState.TRACKED)
            session.records.append(record)
        keyframe.image.release()
    session.publisher.known_vignetting(known.published_vignetting)
    session.publisher.behind = bool(known.scales)  # of this run: more may have been sent since it was saved
    session.covisible_keyframes.known(graph.keyframes)
    session.segment = known.keyframes[-1].segment
    session.phase = Phase.RELOCALIZING


def _check_camera(session: Session, known: KnownMap, frames: tuple[int, int]) -> None:
    if session.matcher.flow.needs_color and any(keyframe.image.color is None for keyframe in known.keyframes):
        raise BadFileError("the map was tracked in gray, and tracker.flow needs its colors: use the flow of that run")
    if known.size != session.size:
        raise BadFileError(
            f"the map was tracked at {known.size[1]}x{known.size[0]} pixels, these frames are at {session.size[1]}x"
            f"{session.size[0]}: give frames of the same shape and the tracker.area of that run"
        )
    height, width = known.size
    corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    sent, guessed = session.intrinsics.copy(), session.calibration.guessed
    if guessed:  # keyframes go out with the map's focal length, and with the rest of the guess
        sent[:2] *= known.intrinsics[0] / sent[0]
    rays = (corners - sent[2:]) / sent[:2]
    off = np.abs(rays * known.intrinsics[:2] + known.intrinsics[2:] - corners).max()
    if off > MAX_OFFSET * width:
        its, theirs = (scale_intrinsics(each, known.size, frames) for each in (known.intrinsics, sent))
        whose, what = "these frames", "give frames of that camera, or its intrinsics,"
        if guessed:
            whose = "these frames, a guess but for that focal length,"
            what = f"if it took them, too, give {_option(session, its, frames)},"
        raise BadFileError(
            f"the map was made by another camera: at {frames[1]}x{frames[0]} pixels its intrinsics are "
            f"{np.round(its, 1).tolist()}, those of {whose} are {np.round(theirs, 1).tolist()}; {what} or begin a map "
            "of their own"
        )


def _option(session: Session, intrinsics: np.ndarray, frames: tuple[int, int]) -> str:
    """For the next run: intrinsics (4,) at the size of the frames as those of the original images."""
    original, came = session.calibration.original, scale_intrinsics(session.intrinsics, session.size, frames)
    scale = original[:2] / came[:2]
    (fx, fy), (cx, cy) = scale * intrinsics[:2], original[2:] + scale * (intrinsics[2:] - came[2:])
    return f"dataset.intrinsics=[{fx:.1f},{fy:.1f},{cx:.1f},{cy:.1f}]"


__all__ = ["go_on"]
