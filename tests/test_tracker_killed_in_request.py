"""A tracker that is killed while it meets a request to go on in another map: its return is in the map that readers get
to know of, as the request passes on to them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from msgs import Frame, Keyframe, Request
from mvsgs_core.kept_map import tracker_file
from mvsgs_core.tracking.tracker import Tracker as Core
from nodes.returning import Returning
from nodes.tracker import Tracker
from tests.support.sequences import synthetic

pytestmark = pytest.mark.slow


class Killed(Exception):
    """As by the kernel."""


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [Frame(i.index, i.timestamp, i.image, i.intrinsics) for i in synthetic(frames=60)]


@pytest.fixture(scope="module")
def saved(frames: list[Frame], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tracker's half of a map of the same place."""
    node, folder = Tracker(), tmp_path_factory.mktemp("saved")
    for frame in frames[:45]:
        list(node.on_frame(frame))
    node.core.keep_map(tracker_file(folder))
    return folder


@pytest.mark.parametrize("asked", ["load_map", "reset"])
@pytest.mark.parametrize("cut_off", ["begin", "note_mode", "note", "sent"])
def test_it_returns_in_the_map_that_was_asked_for(
    asked: str, cut_off: str, frames: list[Frame], saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nodes.tracker.checkpoint_info", lambda _: None)  # the mapper's half
    killed, follower = Tracker(), Tracker()
    killed.kept_in = follower.kept_in = tmp_path / "run"
    sent = [message for frame in frames[:34] for message in killed.on_frame(frame)]
    last = max(message.index for message in sent if isinstance(message, Keyframe))
    request = Request(4, asked, folder=str(saved) if asked == "load_map" else "", kept=str(tmp_path / "kept"))

    def die(*_: Any) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        if cut_off == "sent":  # to be, that is: it was noted as met before
            assert next(m for m in killed.on_request(request) if isinstance(m, Request)) == request
        else:
            patch.setattr(Returning, cut_off, die)
            with pytest.raises(Killed):
                list(killed.on_request(request))
    again = [message for frame in frames[last - 1 : 34] for message in follower.on_frame(frame)]
    if cut_off != "begin":  # until then it is in the map before, and so it comes back
        assert again == [], "frames from before the request are none of the new map's"
    assert list(follower.on_request(request)) == [request]
    assert tracker_file(tmp_path / "kept").is_file()
    for frame in frames[34:37]:
        list(follower.on_frame(frame))
    found = min(follower.core.session.graph.keyframes, default=0)
    assert found < 0 if asked == "load_map" else found >= 34


def test_where_the_new_map_could_not_be_saved_none_is_gone_on_with(
    frames: list[Frame], saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The readers are in the map that was loaded: a tracker that begins anew would be taken for one within it."""
    monkeypatch.setattr("nodes.tracker.checkpoint_info", lambda _: None)  # the mapper's half
    killed, follower = Tracker(), Tracker()
    killed.kept_in = follower.kept_in = tmp_path / "run"
    for frame in frames[:34]:
        list(killed.on_frame(frame))
    keep = Core.keep_map

    def full(self: Core, file: Path) -> None:
        if file.name == "tracker-4.npz":
            raise OSError(28, "No space left on device")
        keep(self, file)

    monkeypatch.setattr(Core, "keep_map", full)
    list(killed.on_request(Request(4, "load_map", folder=str(saved), kept=str(tmp_path / "kept"))))
    with pytest.raises(ValueError, match="cannot go on"):
        list(follower.on_frame(frames[34]))
