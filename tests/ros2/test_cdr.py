"""CDR: equal to rosbags' bytes for every type, both byte orders; nothing that comes from the wire breaks the reader."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.ros2 import messages
from nodes.ros2.cdr import MAX_STRING, CdrError, decode, encode
from tests.support.ros2_messages import TYPES, example, plain


def in_rosbags(store: Any, message: Any) -> Any:
    """The same message as one of rosbags' classes."""
    values = {}
    for field in dataclasses.fields(message):
        value = getattr(message, field.name)
        if dataclasses.is_dataclass(value):
            value = in_rosbags(store, value)
        elif isinstance(value, list):
            value = [in_rosbags(store, each) for each in value]
        values[field.name] = value
    return store.types[message.ros](**values)


@pytest.fixture(scope="module")
def store() -> Any:
    typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is the oracle of the encoding")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


@pytest.mark.parametrize("message_type", TYPES, ids=lambda t: t.ros)
@pytest.mark.parametrize("big", [False, True], ids=["little", "big"])
@pytest.mark.parametrize("many", [0, 1, 5])
def test_bytes_are_those_of_rosbags(store: Any, message_type: type, big: bool, many: int) -> None:
    message = example(message_type, np.random.default_rng(many), many)
    ours = encode(message, big)
    theirs = bytes(store.serialize_cdr(in_rosbags(store, message), message.ros, little_endian=not big))
    assert ours == theirs
    assert plain(decode(message_type, ours)) == plain(message)
    assert plain(decode(message_type, ours + b"\0\0\0")) == plain(message)


def test_every_type_is_compared(store: Any) -> None:
    assert len(TYPES) >= 17
    for message_type in TYPES:
        names = [name for name, _ in store.fielddefs[message_type.ros][1]]
        assert [field.name for field in dataclasses.fields(message_type)] == names


@pytest.mark.parametrize("message_type", TYPES, ids=lambda t: t.ros)
def test_what_is_cut_off_or_too_long_is_refused(message_type: type) -> None:
    whole = encode(example(message_type, np.random.default_rng(0)))
    for length in range(len(whole)):
        with pytest.raises(CdrError):
            decode(message_type, whole[:length])
    with pytest.raises(CdrError, match="too many"):
        decode(message_type, whole + bytes(4))


def test_other_representations_are_refused() -> None:
    data = encode(messages.Time(1, 2))
    for header in (b"\0\3\0\0", b"\0\7\0\0", b"\1\0\0\0", b""):
        with pytest.raises(CdrError, match="plain CDR"):
            decode(messages.Time, header + data[4:])


@pytest.mark.parametrize("padding", range(4))
def test_options_that_count_the_padding_are_no_other_representation(padding: int) -> None:
    """As writers of XTypes say it, in the last bits of the header."""
    for big in (False, True):
        data = encode(messages.Time(1, 2), big)
        assert decode(messages.Time, data[:2] + bytes([0, padding]) + data[4:] + bytes(padding)) == messages.Time(1, 2)


@given(st.data())
def test_a_changed_message_is_refused_or_one(data: st.DataObject) -> None:
    message_type = data.draw(st.sampled_from(TYPES))
    raw = bytearray(encode(example(message_type, np.random.default_rng(1)), data.draw(st.booleans())))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    try:
        decode(message_type, bytes(raw))
    except CdrError:
        return


def test_false_lengths_make_no_array() -> None:
    header = messages.Header(messages.Time(0, 0), "camera")
    image = encode(messages.Image(header, 1, 1, "mono8", 0, 1, np.zeros(1, np.uint8)))
    at = len(image) - 5
    assert image[at : at + 4] == b"\1\0\0\0"
    with pytest.raises(CdrError, match="4294967295 bytes where 1"):
        decode(messages.Image, image[:at] + b"\xff\xff\xff\xff" + image[at + 4 :])
    path = encode(messages.Path(header, []))
    with pytest.raises(CdrError, match="4294967295 of them"):
        decode(messages.Path, path[:-4] + b"\xff\xff\xff\xff")


@pytest.mark.parametrize(
    ("text", "problem"),
    [(b"", "a text of 0"), (b"ab", "does not end"), (b"a\0b\0", "does not end"), (b"\xff\0", "UTF-8"),
     (bytes(MAX_STRING + 1), "a text of 65537")],
)  # fmt: skip
def test_a_text_that_is_none_is_refused(text: bytes, problem: str) -> None:
    data = encode(messages.Time(0, 0)) + len(text).to_bytes(4, "little") + text
    with pytest.raises(CdrError, match=problem):
        decode(messages.Header, data)


def test_a_number_that_is_no_truth_is_refused() -> None:
    data = encode(messages.RegionOfInterest(1, 2, 3, 4, True))
    with pytest.raises(CdrError, match="neither true nor false"):
        decode(messages.RegionOfInterest, data[:-1] + b"\2")


def test_an_array_of_another_length_is_not_written() -> None:
    header = messages.Header(messages.Time(0, 0), "camera")
    nine, twelve = np.zeros(9), np.zeros(12)
    with pytest.raises(ValueError, match="8 numbers where there must be 9"):
        encode(messages.CameraInfo(header, 1, 1, "plumb_bob", np.zeros(5), nine[:8], nine, twelve))


def test_times_are_within_what_ros_can_say() -> None:
    assert messages.Time.of(1.5) == messages.Time(1, 500_000_000)
    assert messages.Time.of(1e9 + 0.9999999999) == messages.Time(10**9 + 1, 0)
    assert messages.Time.of(-3.0) == messages.Time(0, 0)
    assert messages.Time.of(1e12) == messages.Time(2**31 - 1, 10**9 - 1)
    stamp = messages.Time(1_790_000_000, 123_456_789)
    assert messages.Time.at(stamp.nanoseconds) == stamp
    for microseconds in range(100_000, 101_000):  # a float64 of them is up to 119 ns off
        stamp = messages.Time(1_790_000_000, 1000 * microseconds)
        assert messages.Time.of(stamp.sec + 1e-9 * stamp.nanosec) == stamp
