"""The codec gives back what it was given, and refuses everything else without a crash or a large allocation."""

from __future__ import annotations

import re
import struct
import tracemalloc
from dataclasses import fields, replace
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import msgs
from msgs import End, Frame, GroundTruth, Keyframe, Message, Poses, SplatMap, Trajectory
from msgs.codec import NEWEST, CodecError, decode, encode, type_name
from tests.support.example_messages import MESSAGES, assert_equal, example
from tests.support.shared_data import ROOT

MORE = settings(max_examples=150)


def frame(height: int = 48, width: int = 64) -> Frame:
    return Frame(1, 0.5, np.zeros((height, width, 3), np.uint8), np.ones(4))


def refused(data: Any, match: str, expect: tuple[type, ...] | None = None) -> None:
    with pytest.raises(CodecError, match=match):
        decode(data, expect=expect)


def with_header(data: bytes, change: Any) -> bytes:
    """The frame with its header changed by `change(content)`, arrays moved to follow it."""
    name_length, header_length = data[5], struct.unpack_from("<I", data, 8)[0]
    start = 12 + name_length
    content = msgpack.unpackb(data[start : start + header_length])
    change(content)
    header = msgpack.packb(content)
    assert len(header) <= header_length + 64
    body = data[:8] + struct.pack("<I", len(header)) + data[12:start] + header
    rest = -(-(start + header_length) // 64) * 64
    return body.ljust(-(-len(body) // 64) * 64, b"\0") + data[rest:]


@pytest.mark.parametrize("message_type", MESSAGES, ids=lambda t: t.__name__)
@pytest.mark.parametrize("absent", [False, True])
def test_every_type_comes_back_equal(message_type: type, absent: bool) -> None:
    for seed in range(5):
        message = example(message_type, seed, absent)
        data = encode(message, seed)
        decoded = decode(data)
        assert decoded.sequence == seed
        assert_equal(message, decoded.message)
        assert type_name(data) == message_type.__name__


def test_what_was_sent_before_and_by_whom_comes_back_and_is_left_out_where_it_says_nothing() -> None:
    assert decode(encode(frame(), 3, before={"Poses": 2})).before == {"Poses": 2}
    assert b"before" not in bytes(encode(frame(), 3, before={}))
    for wrong in ([1], {"Poses": -1}, {"Poses": True}, {"Nothing": 1}, {"Poses": "2"}, {"Poses": 2**63}):
        with pytest.raises(CodecError, match="before must be a map"):
            decode(with_header(bytes(encode(frame())), lambda c, w=wrong: c.__setitem__("before", w)))
    assert decode(encode(frame(), 3, begun=2**62)).begun == 2**62
    assert decode(encode(frame(), 3)).begun == 0
    assert b"begun" not in bytes(encode(frame(), 3, begun=0))
    for wrong in (-1, True, 1.5, "2", None, 2**63, [1]):
        refused(with_header(bytes(encode(frame())), lambda c, w=wrong: c.__setitem__("begun", w)), "begun must be")


def test_a_default_is_left_out_and_comes_back() -> None:
    plain, guessed = frame(), replace(frame(), intrinsics_guessed=True)
    assert b"intrinsics_guessed" not in bytes(encode(plain))
    assert b"intrinsics_guessed" in bytes(encode(guessed))
    assert b"stamp" not in bytes(encode(plain)).replace(b"timestamp", b"")  # recordings of before have none
    assert decode(encode(replace(plain, stamp=2**62 + 1))).message.stamp == 2**62 + 1
    for message in (plain, guessed):
        assert decode(encode(message)).message.intrinsics_guessed == message.intrinsics_guessed
    preview = example(msgs.Preview, absent=True)
    nil = with_header(bytes(encode(preview)), lambda c: c["scalars"].__setitem__("keyframe_poses", None))
    for data in (encode(preview), nil):
        assert decode(data).message.keyframe_poses is None
    poses = Poses(1, np.zeros(1, np.int64), np.zeros((1, 4, 4)), np.ones(1))
    assert b"segment" not in bytes(encode(poses))  # readers of before this field take it
    assert decode(encode(poses)).message.segment is None
    for name in (b"unfiltered", b"exposure", b"vignetting", b"photograph", b"velocity"):
        assert name not in bytes(encode(example(msgs.FusedKeyframe, absent=True)))
    joined = decode(encode(replace(poses, segment=np.array([3], np.int32)))).message
    assert joined.segment.tolist() == [3]
    wrong = with_header(bytes(encode(guessed)), lambda c: c["scalars"].__setitem__("intrinsics_guessed", 1))
    refused(wrong, "must be bool")


def test_arrays_are_read_only_views_on_the_frame() -> None:
    data = encode(frame())
    image = decode(data).message.image
    assert np.shares_memory(image, np.frombuffer(data, np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        image[0, 0, 0] = 1


def test_who_keeps_a_small_array_does_not_keep_the_frame() -> None:
    data = encode(frame())
    intrinsics = decode(data).message.intrinsics
    assert not np.shares_memory(intrinsics, np.frombuffer(data, np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        intrinsics[0] = 1


def test_a_frame_anywhere_in_memory_gives_aligned_arrays() -> None:
    message = example(Keyframe)
    data = bytearray(1) + encode(message)
    decoded = decode(memoryview(data)[1:]).message
    assert decoded.world_from_cam.flags.aligned
    assert not decoded.world_from_cam.flags.writeable
    assert_equal(message, decoded)


def test_views_and_other_memory_orders_are_sent_as_they_look() -> None:
    image = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    message = replace(frame(), image=image[::2, ::-1], intrinsics=np.arange(8.0)[::2])
    assert_equal(message, decode(encode(message)).message)
    matrix = np.asfortranarray(np.arange(16.0).reshape(4, 4))
    truth = GroundTruth(1, 0.0, image, np.ones(4), matrix, None)
    np.testing.assert_array_equal(decode(encode(truth)).message.world_from_cam, matrix)


def test_empty_lists_are_fine_and_empty_images_are_not() -> None:
    poses = Poses(1, np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros(0))
    assert_equal(poses, decode(encode(poses)).message)
    with pytest.raises(CodecError, match="empty image"):
        encode(frame(0, 3))


def test_numpy_scalars_are_sent_as_numbers() -> None:
    message = replace(frame(), index=np.int64(3), timestamp=np.float32(0.5))
    assert decode(encode(message)).message.index == 3
    end = decode(encode(End({"a": {"n": np.int32(2), "x": np.float32(0.5), "t": (1, 2)}}))).message
    assert end.stats == {"a": {"n": 2, "x": 0.5, "t": [1, 2]}}


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"image": np.zeros((4, 4, 3), np.float32)}, "Frame.image must be uint8, not float32"),
        ({"image": np.zeros((4, 4), np.uint8)}, r"Frame.image must have the shape \(H W 3\)"),
        ({"image": np.zeros((4, 4, 4), np.uint8)}, "but 3 is 3"),
        ({"image": [[1, 2, 3]]}, "is a list, not an array"),
        ({"image": None}, "is a NoneType, not an array"),
        ({"timestamp": float("nan")}, "Frame.timestamp is nan"),
        ({"timestamp": float("inf")}, "Frame.timestamp is inf"),
        ({"timestamp": "now"}, "Frame.timestamp must be float, not str"),
        ({"index": 1.5}, "Frame.index must be int, not float"),
        ({"index": True}, "Frame.index must be int, not bool"),
        ({"index": 2**63}, "64 bits"),
    ],
)
def test_a_message_that_differs_from_its_annotations_is_not_sent(change: dict[str, Any], match: str) -> None:
    with pytest.raises(CodecError, match=match):
        encode(replace(frame(), **change))


def test_sizes_of_one_name_agree_within_a_message() -> None:
    with pytest.raises(CodecError, match="h is"):
        encode(replace(example(Keyframe), inverse_depth=np.zeros((3, 99), np.float32)))
    with pytest.raises(CodecError, match="N is"):
        encode(replace(example(SplatMap), betas=np.zeros(99, np.float32)))


def test_what_is_no_message_is_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CodecError, match="no message; the types are Frame"):
        encode({"index": 1})  # type: ignore[arg-type]
    monkeypatch.setattr("msgs.codec.MAX_MESSAGE_BYTES", 1000)
    with pytest.raises(CodecError, match="may have 1000"):
        encode(frame())


@pytest.mark.parametrize(
    ("stats", "match"),
    [
        ({"a": object()}, "object cannot be sent"),
        ({"a": np.zeros(3)}, "ndarray cannot be sent"),
        ({1: 2}, "keys must be strings"),
        ({"a": [0] * 5000}, "5000 entries"),
        ({"a": "x" * 70000}, "longer than"),
        ({"a": [[[[[[[[1]]]]]]]]}, "nested more than"),
        ({str(i): "x" * 1000 for i in range(2000)}, "header of"),
        ([1], "must be a map"),
    ],
)
def test_statistics_are_limited(stats: Any, match: str) -> None:
    with pytest.raises(CodecError, match=match):
        encode(End(stats))


def test_foreign_and_damaged_frames_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    data = bytes(encode(frame()))
    refused(b"", "too short")
    refused(b"GET / HTTP/1.1\r\n\r\n", "no message")
    refused(data[:4] + b"\x03" + data[5:], "version 3")
    refused(data[:6] + b"\x01" + data[7:], "flags 1,")
    refused(data.replace(b"Frame", b"Fname"), "type 'Fname'")
    refused(data.replace(b"Frame", b"Fr\xffme"), "not ASCII")
    refused(data[:-1], "not inside the")
    refused(data + b"\0", "its content ends at")
    refused(data[:40], "cut off in its header")
    refused(data, "Keyframe or End", expect=(Keyframe, End))
    refused(data[:8] + struct.pack("<I", 2**32 - 1) + data[12:], "a header of 4294967295 bytes")
    monkeypatch.setattr("msgs.codec.MAX_MESSAGE_BYTES", 100)
    refused(data, "more than the 100")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda c: c["arrays"]["image"].__setitem__(0, "object"), "must be uint8, not object"),
        (lambda c: c["arrays"]["image"].__setitem__(0, ["uint8"]), "must be uint8"),
        (lambda c: c["arrays"]["image"].__setitem__(1, [2**31, 2**31, 3]), "not inside the"),
        (lambda c: c["arrays"]["image"].__setitem__(1, [-1, 4, 3]), "integers from 0"),
        (lambda c: c["arrays"]["image"].__setitem__(1, [True, 4, 3]), "integers from 0"),
        (lambda c: c["arrays"]["image"].__setitem__(1, [4, 3]), "must have the shape"),
        (lambda c: c["arrays"]["image"].__setitem__(2, 65), "multiple of 64"),
        (lambda c: c["arrays"]["image"].__setitem__(2, 2**40), "not inside the"),
        (lambda c: c["arrays"].__setitem__("image", 3), "must be given as"),
        (lambda c: c["arrays"].pop("image"), "Frame has the fields"),
        (lambda c: c["arrays"].__setitem__("x", ["uint8", [1], 0]), "Frame has the fields"),
        (lambda c: c["scalars"].__setitem__("image", 1), "Frame has the fields"),
        (lambda c: c["scalars"].__setitem__("index", "1"), "Frame.index must be int"),
        (lambda c: c["scalars"].__setitem__("timestamp", float("nan")), "Frame.timestamp is nan"),
        (lambda c: (c["scalars"].pop("index"), c["arrays"].__setitem__("index", ["uint8", [1], 0])), "is no array"),
        (lambda c: (c["arrays"].pop("image"), c["scalars"].__setitem__("image", None)), "must be an array"),
        (lambda c: c.__setitem__("sequence", -1), "sequence number"),
        (lambda c: c.__setitem__("scalars", [1]), "must be maps"),
        (lambda c: c.pop("scalars"), "map of sequence"),
    ],
)
def test_a_false_header_is_named(change: Any, match: str) -> None:
    refused(with_header(bytes(encode(frame(), 123456)), change), match)


def test_arrays_hold_only_what_their_type_allows() -> None:
    trajectory = example(Trajectory)
    data = bytearray(encode(replace(trajectory, keyframe=np.ones_like(trajectory.keyframe))))
    name, length = data[5], struct.unpack_from("<I", data, 8)[0]
    content = msgpack.unpackb(bytes(data[12 + name : 12 + name + length]))
    data[-(-(12 + name + length) // 64) * 64 + content["arrays"]["keyframe"][2]] = 2
    refused(data, "a bool is 0 or 1")
    times = np.full(trajectory.timestamp.shape, np.nan)
    refused(encode(replace(trajectory, timestamp=times)), "timestamp is not finite")


@MORE
@given(st.binary(max_size=4096))
def test_random_bytes_are_refused(data: bytes) -> None:
    for prefix in (b"", b"RMVS\x02\x05\0\0", b"RMVS\x02\x03\0\0" + struct.pack("<I", len(data)) + b"End"):
        with pytest.raises(CodecError):
            decode(prefix + data)


@MORE
@given(st.sampled_from(MESSAGES), st.integers(0, 5), st.data())
def test_damage_gives_an_error_or_a_valid_message(message_type: type, seed: int, data: st.DataObject) -> None:
    original = bytes(encode(example(message_type, seed)))
    damaged = bytearray(original)
    for _ in range(data.draw(st.integers(1, 4))):
        kind = data.draw(st.sampled_from(["flip", "cut", "extend", "splice"]))
        at = data.draw(st.integers(0, max(0, min(len(damaged) - 1, 600))))
        if kind == "flip" and damaged:
            damaged[at] ^= 1 << data.draw(st.integers(0, 7))
        elif kind == "cut":
            del damaged[at : at + data.draw(st.integers(1, 64))]
        elif kind == "extend":
            damaged[at:at] = data.draw(st.binary(max_size=64))
        else:
            damaged[at : at + 8] = data.draw(st.binary(min_size=8, max_size=8))
    try:
        message, sequence, *_ = decode(damaged)
    except CodecError:
        return
    assert_survives(message, sequence)


def assert_survives(message: Message, sequence: int) -> None:
    """What was accepted satisfies the annotations: it can be sent again and comes back bit for bit."""
    again = decode(encode(message, sequence)).message
    for field in fields(message):
        x, y = getattr(message, field.name), getattr(again, field.name)
        assert x.tobytes() == y.tobytes() if isinstance(x, np.ndarray) else repr(x) == repr(y)


HEADER_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=12,
)


@pytest.mark.slow
@MORE
@given(st.sampled_from(["sequence", "scalars", "arrays", "index", "timestamp", "image", "intrinsics"]), HEADER_VALUES)
def test_any_value_anywhere_in_a_header_is_checked(key: str, value: Any) -> None:
    def change(content: dict[str, Any]) -> None:
        for part in (content, content["scalars"], content["arrays"]):
            if key in part:
                part[key] = value
                return

    name, length = b"Frame", 4096
    original = bytes(encode(frame(8, 8)))
    start = 12 + len(name)
    content = msgpack.unpackb(original[start : start + struct.unpack_from("<I", original, 8)[0]])
    change(content)
    header = msgpack.packb(content)
    body = original[:8] + struct.pack("<I", len(header)) + name + header
    try:
        decoded = decode(body.ljust(length, b"\0"))
    except CodecError:
        return
    assert_survives(decoded.message, decoded.sequence)


def nested(levels: int, opening: bytes) -> bytes:
    return opening * levels


@pytest.mark.parametrize(
    "header",
    [
        nested(200_000, b"\xdd\x00\x0f\xff\xff"),  # lists of a million, one inside the other
        nested(2000, b"\xdc\x0f\xff"),  # of 4095 each: as long as is allowed
        nested(100_000, b"\x91"),
        nested(100_000, b"\x81\xa1a"),
        b"\xdf\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xc9\xff\xff\xff\xff\x01",
        b"\xdd\xff\xff\xff\xff",
        b"\xdc\x10\x00" * 1 + (b"\xdc\x10\x00" + b"\x80" * 4096) * 255,
    ],
)
def test_a_false_length_allocates_little(header: bytes) -> None:
    data = b"RMVS\x02\x03\0\0" + struct.pack("<I", len(header)) + b"End" + header
    tracemalloc.start()
    refused(data, "End|header")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100 * 2**20


def test_decoding_allocates_nothing_of_the_arrays_size() -> None:
    data = encode(frame(1000, 1000))
    tracemalloc.start()
    decode(data)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100_000


def wire_document() -> str:
    return (ROOT / "msgs" / "WIRE.md").read_text()


def expected_of_the_document(decoded: Any) -> None:
    message, sequence, *_ = decoded
    assert sequence == 7
    expected = Frame(7, 0.25, np.array([[[255, 0, 0], [0, 0, 255]]], np.uint8), np.array([500.0, 500.0, 320.0, 240.0]))
    assert_equal(expected, message)


def test_the_documented_bytes_are_a_frame() -> None:
    lines = re.findall(r"^[0-9a-f]{4}  ((?:[0-9a-f]{2} ?){16})", wire_document(), re.M)
    data = bytes.fromhex(" ".join(lines))
    expected_of_the_document(decode(data))
    assert data[:1] == NEWEST


def test_all_arrays_that_may_be_left_out_are_named() -> None:
    """Of each type, or of all keyframes, or of all that have an image."""
    (listed,) = re.findall(r"an array whose default is `None` may be\sleft out \((.*?)\)\.", wire_document(), re.S)
    named = [part.partition(" of ") for part in " ".join(listed.split()).split("; ")]
    for kind in msgs.TYPES.values():
        groups = {f"`{kind.__name__}`"} | (
            {"keyframes"} if {f.name for f in fields(kind)} >= {"image", "world_from_cam", "scale"} else set()
        )
        groups |= {"every message with an image"} if "image" in {f.name for f in fields(kind)} else set()
        for field in (f for f in fields(kind) if f.default is None):
            of = [whose for names, _, whose in named if f"`{field.name}`" in names]
            assert any(group in whose for whose in of for group in groups), (kind, field.name)


def test_the_documented_program_writes_a_frame() -> None:
    (program,) = re.findall(r"```python\n(.*?)```", wire_document(), re.S)
    scope: dict[str, Any] = {}
    exec(program, scope)
    data = scope["frame"](7, 7, 0.25, 1, 2, bytes([255, 0, 0, 0, 0, 255]), [500.0, 500.0, 320.0, 240.0])
    expected_of_the_document(decode(data))
