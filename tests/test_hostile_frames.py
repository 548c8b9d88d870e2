"""Whatever bytes come, the decoder answers with a message or a CodecError: quickly, in little memory, printably."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import msgs
from bench.faults.frame_mutations import ESCAPES, frame, good, mutated, parts
from msgs import End, Frame, SplatMap
from msgs.codec import MAX_END_HEADER_BYTES, MAX_END_VALUES, CodecError, decode, encode
from mvsgs_core.stats import Stats

GOOD = bytes(encode(Frame(1, 0.5, np.zeros((4, 4, 3), np.uint8), np.ones(4))))
MARK = "here"


def answer(data: bytes) -> str:
    """Nothing for a message, or what is wrong with it; any other exception passes through."""
    try:
        decode(data)
    except CodecError as error:
        return str(error)
    return ""


def error_of(data: bytes) -> str:
    with pytest.raises(CodecError) as found:
        decode(data)
    return str(found.value)


def with_bytes_at(place: tuple[Any, ...], header_bytes: bytes, original: bytes = GOOD) -> bytes:
    """The frame, with these bytes of msgpack at a place of its header."""
    name, content, arrays = parts(original)
    container: Any = content
    for key in place[:-1]:
        container = container[key]
    container[place[-1]] = MARK
    return frame(name, msgpack.packb(content).replace(msgpack.packb(MARK), header_bytes), arrays)


@pytest.mark.parametrize("levels", [100, 990, 1010, 1023, 1030, 20_000])
@pytest.mark.parametrize(
    "place",
    [("arrays", "image", 0), ("arrays", "image", 1), ("arrays", "image", 2), ("arrays", "image", 1, 0),
     ("arrays", "image"), ("scalars", "index"), ("scalars",), ("sequence",), ("before",), ("begun",),
     ("arrays",)],
    ids=str,
)  # fmt: skip
def test_lists_in_lists_anywhere(place: tuple[Any, ...], levels: int) -> None:
    for opening, innermost in ((b"\x91", b"\x00"), (b"\x81\xa1a", b"\x00"), (b"\x91", b"")):
        assert len(error_of(with_bytes_at(place, opening * levels + innermost))) < 500


def test_lists_in_lists_in_the_statistics() -> None:
    original = bytes(encode(End({"a": 1})))
    for levels in (8, 100, 1010, 1030):
        for opening in (b"\x91", b"\x81\xa1a"):
            error_of(with_bytes_at(("scalars", "stats", "a"), opening * levels + b"\x00", original))


def test_what_an_error_quotes_is_short_and_printable() -> None:
    quoted = msgpack.packb("\x00" * 60_000), msgpack.packb(["\x00" * 60_000]), msgpack.packb(ESCAPES)
    for value in quoted:
        for place in (("arrays", "image", 0), ("arrays", "image", 1), ("scalars", "index"), ("scalars", ESCAPES)):
            text = error_of(with_bytes_at(place, value))
            assert text.isprintable(), place
            assert len(text) < 500, place
    assert "dtype" in error_of(with_bytes_at(("arrays", "image"), b"\x00"))
    assert r"\x1b]0;owned" in error_of(with_bytes_at(("arrays", "image", 0), msgpack.packb(ESCAPES)))
    sizes = msgpack.packb([2**64 - 1] * 60)
    assert len(error_of(with_bytes_at(("arrays", "image", 1), sizes))) < 500
    assert error_of(frame(b"\x1b[2J", b"\x80")).isprintable()
    statistics = with_bytes_at(
        ("scalars", "stats", ESCAPES), msgpack.packb({"x" * 60_000: 2**64 - 1}), bytes(encode(End()))
    )
    assert error_of(statistics).isprintable()
    assert len(error_of(statistics)) < 500


def test_sizes_that_no_array_has_are_refused_even_where_they_take_no_bytes() -> None:
    splats = good(SplatMap, np.random.default_rng(0))
    names = ("means", "log_scales", "quaternions", "opacity_logits", "sh", "betas", "anchors")
    original = bytes(encode(replace(splats, **{name: getattr(splats, name)[:0] for name in names})))
    for size in (2**63 - 1, 2**62, 2**40):
        data = with_bytes_at(("arrays", "sh", 1), msgpack.packb([0, size, 3]), original)
        assert "larger than any message" in error_of(data)


def crowded_end(item: bytes, total: int, key: bytes = b"a") -> bytes:
    """An End whose statistics are lists of the smallest values."""
    inner = b"\xdc" + (4000).to_bytes(2, "big") + item * 4000
    lists = (total - len(key) - 100) // len(inner)
    stats = b"\x81" + msgpack.packb(key.decode()) + b"\xdc" + lists.to_bytes(2, "big") + inner * lists
    return with_bytes_at(("scalars", "stats"), stats, bytes(encode(End())))


def thread_seconds(work: Callable[[], None]) -> float:
    began = time.thread_time()
    work()
    return time.thread_time() - began


def count() -> None:
    """A step for each value that a header may have: what this interpreter does in a given time, now and here."""
    for _ in range(MAX_END_VALUES):
        pass


@pytest.mark.parametrize(
    "data",
    [
        frame(b"End", b"\xdc\x10\x00" * 1020),
        frame(b"End", b"\xdc\x10\x00" * 1020 + b"\x80" * (MAX_END_HEADER_BYTES - 3060)),
        crowded_end(b"\x80", MAX_END_HEADER_BYTES),
        crowded_end(b"\x90", MAX_END_HEADER_BYTES),
        crowded_end(b"\x81\xa0\xc0", MAX_END_HEADER_BYTES),
        crowded_end(b"\xc0", MAX_END_HEADER_BYTES, key=b"k" * 60_000),
        crowded_end(b"\x90", 1_000_000),
        crowded_end(b"\xc0", 16_000),
    ],
    ids=["unfinished", "unfinished and crowded", "maps", "lists", "maps of one", "long key", "too long", "most"],
)
def test_a_small_frame_takes_little_time_and_memory(data: bytes) -> None:
    def attempt() -> None:
        with suppress(CodecError):
            decode(data)

    tracemalloc.start()
    attempt()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= 64e6
    decoding, counting = zip(*((thread_seconds(attempt), thread_seconds(count)) for _ in range(5)), strict=True)
    assert min(decoding) <= 350 * min(counting)  # 50 ms, where one step takes 8 ns


@pytest.mark.slow
def test_thousands_of_mutated_frames_give_messages_or_codec_errors() -> None:
    frames = mutated(np.random.default_rng(5))
    errors = [text for _ in range(3000) if (text := answer(next(frames)))]
    assert len(errors) > 2000
    assert [text for text in errors if not text.isprintable() or len(text) > 1000] == []


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=6), inner, max_size=6),
    max_leaves=30,
)


@pytest.mark.slow
@settings(max_examples=300)
@given(
    st.sampled_from(sorted(msgs.TYPES)), st.lists(st.tuples(st.integers(0, 30), values), max_size=4), st.integers(0, 3)
)
def test_any_values_at_any_places_of_any_header(name: str, changes: list[tuple[int, Any]], levels: int) -> None:
    _, content, arrays = parts(bytes(encode(good(msgs.TYPES[name], np.random.default_rng(1)))))
    for number, value in changes:
        places = [(content, key) for key in content]
        for part in ("scalars", "arrays"):
            if isinstance(content.get(part), dict):
                places += [(content[part], key) for key in content[part]]
        container, key = places[number % len(places)]
        for _ in range(levels * 150):
            value = [value]
        container[key] = value
    text = answer(frame(name.encode(), msgpack.packb(content), arrays))
    assert text.isprintable()
    assert len(text) < 1000


def test_a_warning_of_a_refused_frame_leaves_the_run_its_end() -> None:
    stats = Stats()
    for i in range(5000):
        stats.warn(error_of(with_bytes_at(("arrays", "image", 0), msgpack.packb([f"{i}" + "\x00" * 500]))))
    encode(End({"reader": {"warnings": stats.warnings.lines()}}))
