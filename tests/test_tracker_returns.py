"""A tracker that was killed: the process that is started in its place goes on in the map that the other one saved."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import msgs
from msgs import Asked, Frame, Keyframe, Poses, Request, Trajectory
from nodes.tracker import Tracker
from tests.support.sequences import synthetic

pytestmark = pytest.mark.slow


def frames() -> list[Frame]:
    return [Frame(i.index, i.timestamp, i.image, i.intrinsics) for i in synthetic(frames=80)]


def sent(node: Tracker, given: Sequence[Frame]) -> list[msgs.Message]:
    return [message for frame in given for message in node.on_frame(frame)]


def test_it_goes_on_in_the_map_with_numbers_of_its_own(tmp_path: Path) -> None:
    given = frames()
    killed, follower = Tracker(), Tracker()
    killed.kept_in = follower.kept_in = tmp_path / "kept"
    before = sent(killed, given[:45])
    scaled = {index: killed.core.scale(index) for index in killed.core.session.graph.keyframes}
    killed.core.keep_map(tmp_path / "kept" / "tracker.npz")  # as of the last frame
    first = [message.index for message in before if isinstance(message, Keyframe)]
    after = [*sent(follower, given[first[-1] - 3 :]), *follower.on_end()]
    assert follower.stats.skipped["frames that came again"] == 4
    assert follower.stats.skipped["keyframes that a killed tracker sent after it had saved its map"] == 0
    again = [message.index for message in after if isinstance(message, Keyframe)]
    assert len(again) > 3
    assert min(again) > max(first)
    revisions = [message.revision for message in (*before, *after) if isinstance(message, Poses)]
    assert revisions == sorted(set(revisions))
    for index, scale in scaled.items():
        assert follower.core.scale(index) == pytest.approx(scale, rel=0.02)  # of what readers have
    at_first, *_, corrected = [message for message in after if isinstance(message, Poses)]
    assert set(first) <= set(at_first.index.tolist())  # more may have been sent of them than was saved
    assert set(first + again) <= set(corrected.index.tolist())
    (path,) = (message for message in after if isinstance(message, Trajectory))
    assert set(path.segment.tolist()) == {0}
    assert np.isfinite(path.world_from_cam).all()
    assert set(first) <= set(path.index.tolist())


def test_what_was_sent_after_the_last_save_is_counted_and_no_map_is_no_return(tmp_path: Path) -> None:
    given = frames()
    killed = Tracker()
    killed.kept_in = tmp_path / "kept"
    last = max(m.index for m in sent(killed, given[:45]) if isinstance(m, Keyframe))
    assert killed._returning is not None
    killed._returning._due = 0.0  # how long ago it saved is a matter of the machine's speed
    killed._returning.save(killed.core)
    with (tmp_path / "kept" / "sent").open("a") as log:
        log.write(f"\nKeyframe {last + 5};\nPoses 70;\nKeyframe {last + 50}")  # and the last line cut off
    follower = Tracker()
    follower.kept_in = tmp_path / "kept"
    after = [*sent(follower, given[last + 4 :]), *follower.on_end()]
    assert follower.stats.skipped["frames that came again"] == 2
    assert follower.stats.skipped["keyframes that a killed tracker sent after it had saved its map"] >= 1
    assert min(message.revision for message in after if isinstance(message, Poses)) > 70
    assert any("are mapped and no longer corrected" in text for text in follower.stats.warnings)
    assert [m.number for m in killed.on_request(Request(7, Asked.LOCALIZE)) if isinstance(m, Request)] == [7]
    localizing = Tracker()
    localizing.kept_in = tmp_path / "kept"
    assert list(localizing.on_request(Request(7, Asked.LOCALIZE))) == []  # it came again
    assert localizing.core.frozen
    (tmp_path / "kept" / "tracker.npz").unlink()
    lost = Tracker()
    lost.kept_in = tmp_path / "kept"
    with pytest.raises(ValueError, match="before it had saved its map"):
        sent(lost, given[60:61])
