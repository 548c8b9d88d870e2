"""Decompression that ends at a bound: a few bytes of zstd, lz4 or bz2 can stand for gigabytes."""

from __future__ import annotations

import bz2

import lz4.frame
import zstandard

from mvsgs_core.bad_file import BadFileError, brief

_BLOCK = 2**20  # bytes


def decompress(data: bytes, method: str, limit: int) -> bytes:
    """The content of `data`, one frame of "zstd", "lz4" or "bz2"; "" and "none" are for data as they are.

    Raises BadFileError for damaged data, another method, and content longer than `limit` bytes, of which no more than
    those are ever in memory.
    """
    if method in ("", "none"):
        content: bytes | None = data if len(data) <= limit else None
    elif method not in _METHODS:
        raise BadFileError(f"compressed by {method[:20]!r}; known are {', '.join(_METHODS)}")
    else:
        try:
            content = _METHODS[method](data, limit)
        except Exception as error:  # each library has errors of its own
            raise BadFileError(f"damaged {method} data: {brief(error)}") from error
    if content is None:
        raise BadFileError(f"{len(data)} bytes of {method} would become more than the {limit} that are read")
    return content


def _zstd(data: bytes, limit: int) -> bytes | None:
    """None: longer than `limit`, as with the others."""
    promised = zstandard.frame_content_size(data)  # -1 where the frame does not say
    blocks, length = list[bytes](), 0
    with zstandard.ZstdDecompressor().stream_reader(data) as stream:
        while block := stream.read(_BLOCK):
            blocks.append(block)
            length += len(block)
            if length > limit:
                return None
    if promised not in (-1, length):
        raise ValueError("the frame ends early")
    return b"".join(blocks)


def _lz4(data: bytes, limit: int) -> bytes | None:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    content: bytes = decompressor.decompress(data, max_length=limit + 1)
    if len(content) > limit:
        return None
    if not decompressor.eof:
        raise ValueError("the frame ends early")
    return content


def _bz2(data: bytes, limit: int) -> bytes | None:
    decompressor = bz2.BZ2Decompressor()
    content = decompressor.decompress(data, max_length=limit + 1)
    if len(content) > limit:
        return None
    if not decompressor.eof:
        raise ValueError("the stream ends early")
    return content


_METHODS = {"zstd": _zstd, "lz4": _lz4, "bz2": _bz2}
