"""Images of keyframes: whole, or not there."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.export.keyframe_images import known_image, there, write_image

IMAGE = (np.arange(24 * 32 * 3) % 251).astype(np.uint8).reshape(24, 32, 3)


def test_a_full_disk_leaves_no_part_of_an_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_image(tmp_path, 7, IMAGE)
    whole = Path.write_bytes

    def full(file: Path, data: bytes) -> int:
        whole(file, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    for index in (7, 14):
        with pytest.raises(OSError, match="No space left"):
            write_image(tmp_path, index, 255 - IMAGE)
    assert there(tmp_path, np.array([7, 14])).tolist() == [True, False]
    np.testing.assert_array_equal(known_image(tmp_path, 7), IMAGE)
    assert [file.name for file in tmp_path.iterdir()] == ["000007.png"]
