"""Images of more than 8 bits: read as bright as they are, or refused, or said to be dark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset
from mvsgs_core.datasets.files import UnreadableImageError, read_depth


@pytest.mark.parametrize(("kind", "said"), [(np.int32, "32-bit integers"), (np.float32, "fractions")])
def test_values_of_which_nothing_says_what_is_white_are_refused(tmp_path: Path, kind: type, said: str) -> None:
    for i in range(2):
        Image.fromarray((np.arange(48 * 64).reshape(48, 64) / 3071).astype(kind)).save(tmp_path / f"{i}.tif")
    with pytest.raises(BadFileError, match=f"0.tif: its values are {said}.* convert all images by one scale"):
        list(open_dataset("images", path=tmp_path, intrinsics=[50, 51, 31, 24]))


def test_16_bit_gray_is_read_whatever_its_file(tmp_path: Path) -> None:
    gray = np.linspace(0, 65535, 48 * 64).reshape(48, 64).astype(np.uint16)
    for name in ("a.png", "b.tif"):
        Image.fromarray(gray).save(tmp_path / name)
    for name in ("c.ppm", "d.pgm", "e.pnm"):
        (tmp_path / name).write_bytes(b"P5 64 48 65535\n" + gray.astype(">u2").tobytes())
    sequence = open_dataset("images", path=tmp_path, intrinsics=[50, 51, 31, 24])
    assert len(sequence) == 5
    for item in sequence:
        assert (item.image == (gray >> 8)[..., None]).all()
    assert not sequence.warnings


def test_of_12_bits_in_16_it_is_said_what_to_do(tmp_path: Path) -> None:
    def warnings(values: int, last: int) -> list[str]:
        for i in range(9):
            gray = np.full((48, 64), last if i == 8 else values // (i + 1), dtype=np.uint16)
            Image.fromarray(gray).save(tmp_path / f"{i}.png")
        return open_dataset("images", path=tmp_path, intrinsics=[50, 51, 31, 24]).warnings

    (told,) = warnings(4095, 300)
    assert "has a value above 4095 of 65535" in told
    assert "mogrify -path bright -evaluate multiply 16 *.png" in told
    assert not warnings(4095, 4096), "a dark picture among others"
    Image.fromarray(np.full((48, 64), 3, dtype=np.uint8)).save(tmp_path / "8.png")
    assert not open_dataset("images", path=tmp_path, start=8, intrinsics=[50, 51, 31, 24]).warnings, "8 bits"


@pytest.mark.parametrize("maximum", [256, 4095, 10_000, 65_535])
@pytest.mark.parametrize("plain", [False, True])
def test_counts_of_depth_are_those_of_the_file_whatever_maximum_it_names(
    tmp_path: Path, maximum: int, plain: bool
) -> None:
    counts = np.linspace(0, maximum, 12 * 16).astype(np.uint16).reshape(12, 16)
    pixels = " ".join(map(str, counts.ravel())).encode() if plain else counts.astype(">u2").tobytes()
    (tmp_path / "a.pgm").write_bytes(f"P{2 if plain else 5}\n16 12\n{maximum}\n".encode() + pixels)
    depth = read_depth(tmp_path / "a.pgm", 1.0)
    assert (depth == counts).all()


@pytest.mark.parametrize("kind", [2, 5])
def test_depth_of_a_maximum_of_8_bits_is_refused(tmp_path: Path, kind: int) -> None:
    pixels = b"7 8 " * 96 if kind == 2 else bytes(192)
    (tmp_path / "a.pgm").write_bytes(f"P{kind}\n16 12\n100\n".encode() + pixels)
    with pytest.raises(UnreadableImageError, match="this one has 8 bits"):
        read_depth(tmp_path / "a.pgm", 1000.0)
