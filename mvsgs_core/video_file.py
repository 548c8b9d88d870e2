"""Videos that browsers play: H.264 in .mp4, by PyAV, whose wheel brings the encoder."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

from mvsgs_core.atomic_file import replacing

QUALITY = "18"  # constant rate factor of x264: hardly to be told from the frames


def write_video(path: Path, frames: Iterator[np.ndarray], size: tuple[int, int], fps: float) -> int:
    """Replaces `path` in one step by frames (H, W, 3) uint8 sRGB of `size` (height, width); returns their number.

    4:2:0 at BT.709, marked as such, is what all browsers decode; it halves the chroma, so that an odd last row or
    column is left out. The index comes first, so that a page plays the file while it loads. Raises ValueError for a
    name or a size that no .mp4 has, OSError if the file cannot be written.
    """
    height, width = size[0] // 2 * 2, size[1] // 2 * 2
    if path.suffix != ".mp4":
        raise ValueError(f"{path}: the video's name must end in .mp4")
    if min(height, width) < 2 or not fps > 0:
        raise ValueError(f"no video has frames of {size[1]}x{size[0]} pixels, {fps:g} a second")
    count = 0
    try:
        with (
            replacing(path, sync=False) as aside,
            av.open(aside, "w", options={"movflags": "+faststart"}) as container,
        ):
            stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.options = {"crf": QUALITY, "preset": "medium"}
            context = stream.codec_context
            context.colorspace, context.color_range = int(Colorspace.ITU709), int(ColorRange.MPEG)
            context.color_primaries, context.color_trc = int(ColorPrimaries.BT709), int(ColorTrc.BT709)
            for pixels in frames:
                rgb = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels[:height, :width]), format="rgb24")
                frame = rgb.reformat(
                    format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
                )
                container.mux(stream.encode(frame))
                count += 1
            container.mux(stream.encode())
    except av.FFmpegError as error:
        raise OSError(f"cannot write a video to {path}: {error.strerror}") from error
    return count
