"""The sources mask what is fixed to the camera, from the first frame of a file on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from msgs import End, Frame, GroundTruth
from mvsgs_core.datasets import Item
from mvsgs_core.datasets.fixed_parts import DOUBT, EVERY, WINDOW
from mvsgs_core.stats import Stats
from nodes.fixed_mask import AHEAD, FixedMask
from nodes.live import LiveSource
from nodes.reader import Reader
from tests.support.fixed_things import SIZE, Draw, frames, logo
from tests.support.sequences import ate, synthetic, track


def items(count: int, draw: Draw | None, **given: object) -> list[Item]:
    found = []
    for n, image in enumerate(frames(count)):
        if draw is not None:
            draw(image, n)
        found.append(Item(n, n / 30.0, image, np.array([100.0, 100.0, 80.0, 60.0]), **given))  # type: ignore[arg-type]
    return found


def test_the_first_frames_of_a_file_have_the_mask_as_well() -> None:
    stats = Stats()
    found = list(FixedMask(stats, True).masked_ahead(items(EVERY + 5, logo)))
    assert [item.index for item in found] == list(range(EVERY + 5))
    assert all(item.mask is not None and not item.mask[[8, 20], 40].any() for item in found)
    assert len([w for w in stats.warnings if "fixed to the camera" in w and "hide_fixed=false" in w]) == 1


@pytest.mark.parametrize(("part", "said"), [(0.25, True), (0.1, False)])
def test_where_much_is_fixed_the_camera_may_stand(part: float, said: bool) -> None:
    def bars(image: np.ndarray, number: int) -> None:
        thick = round(part * image.shape[1])
        image[:, :thick] = image[:, -thick:] = 0

    stats = Stats()
    assert len(list(FixedMask(stats, True).masked_ahead(items(EVERY + 5, bars)))) == EVERY + 5
    (warning,) = [w for w in stats.warnings if "fixed to the camera" in w]
    assert ("a camera that stands" in warning) == said


def test_a_stream_without_any_waits_for_a_few_frames_only() -> None:
    source = iter(items(AHEAD, None))
    first = next(FixedMask(Stats(), True).masked_ahead(source))
    assert first.mask is None
    assert len(list(source)) == AHEAD - DOUBT


def test_a_still_stream_is_not_kept_for_ever() -> None:
    one = items(1, None)[0]
    source = iter([replace(one, index=n) for n in range(2 * AHEAD)])
    next(FixedMask(Stats(), True).masked_ahead(source))
    assert len(list(source)) == AHEAD


def test_live_frames_have_it_as_soon_as_it_is_known() -> None:
    fixed = FixedMask(Stats(), True)
    found = [fixed.masked(item) for item in items(EVERY + 1, logo)]
    assert found[0].mask is None
    assert found[-1].mask is not None


def test_masks_that_frames_have_stay() -> None:
    own = np.ones(SIZE, bool)
    own[:, :10] = False
    for item in FixedMask(Stats(), True).masked_ahead(items(EVERY, logo, mask=own)):
        assert item.mask is not None
        assert not item.mask[:, :10].any()
        assert not item.mask[20, 40]
        assert item.mask[60, 80]


def test_it_can_be_left() -> None:
    found = list(FixedMask(Stats(), False).masked_ahead(items(WINDOW, logo)))
    assert all(item.mask is None for item in found)


@pytest.mark.slow
def test_bars_above_and_below_a_video_do_not_hold_the_tracker() -> None:
    """Their rims stand still, or slide along what is behind them."""
    shown = []
    for item in synthetic(frames=80):
        image = item.image.copy()
        image[:50] = image[-50:] = 0
        shown.append(replace(item, image=image))
    found = list(FixedMask(Stats(), True).masked_ahead(shown))
    assert all(item.mask is not None for item in found)
    assert ate(track(found)[1], found)[0] < 0.7 * ate(track(shown)[1], shown)[0]


def write_video(folder: Path, count: int) -> Path:
    folder.mkdir()
    for n, image in enumerate(frames(count)):
        logo(image, n)
        cv2.imwrite(str(folder / f"{n:03d}.png"), image[..., ::-1])
    return folder


def read(folder: Path, **given: Any) -> tuple[list[Frame | GroundTruth], Reader]:
    reader = Reader(Reader.Config(name="images", path=str(folder), intrinsics=[100.0, 100.0, 80.0, 60.0], **given))
    return list(reader.run()), reader


def test_a_file_s_frames_and_their_truth_are_masked_alike(tmp_path: Path) -> None:
    messages, reader = read(write_video(tmp_path / "logo", EVERY + 2))
    assert [type(m) for m in messages] == [Frame, GroundTruth] * (EVERY + 2)
    for message in messages:
        assert message.mask is not None
        assert not message.mask[20, 40]
        assert message.mask[80, 80]
    assert any("hide_fixed=false" in w for w in reader.stats.warnings)


def test_a_mask_that_is_given_or_a_refusal_counts_alone(tmp_path: Path) -> None:
    folder, mask = write_video(tmp_path / "logo", EVERY + 2), np.full(SIZE, 255, np.uint8)
    mask[:, :30] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    messages, _ = read(folder, mask=str(tmp_path / "mask.png"))
    for message in messages:
        np.testing.assert_array_equal(message.mask, mask > 0)
    messages, reader = read(folder, hide_fixed=False)
    assert all(message.mask is None for message in messages)
    assert not reader.stats.warnings


def test_at_the_recorded_rate_no_frame_waits_for_it(tmp_path: Path) -> None:
    messages, _ = read(write_video(tmp_path / "logo", EVERY + 2), realtime=True)
    assert messages[0].mask is None
    assert messages[-1].mask is not None


class Shown(LiveSource):
    """A camera that shows a moving scene with a logo."""

    _silence = "nothing is shown"

    def _hint(self) -> str:
        return "look at it"

    def _open(self) -> None:
        self._left = enumerate(frames(EVERY + 3))

    def _next(self, seconds: float) -> Frame | End:
        number, image = next(self._left, (0, None))
        if image is None:
            return End()
        logo(image, 0)
        return Frame(0, number / 30, image, np.array([100.0, 100.0, 80.0, 60.0]), False)

    def _framed(self, frame: Frame) -> Frame:
        return frame

    def _close(self) -> None:
        pass


def test_a_camera_s_frames_are_masked_once_it_is_known_and_at_once_not_held_back() -> None:
    camera = Shown(Shown.Config())
    messages = list(camera.run())
    assert messages[0].mask is None
    for message in messages[-2:]:
        assert message.mask is not None
        assert not message.mask[20, 40]
    assert any("fixed to the camera" in w for w in camera.stats.warnings)
    assert all(message.mask is None for message in Shown(Shown.Config(hide_fixed=False)).run())
