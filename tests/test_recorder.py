"""What was recorded is played again, whole or in part, and a recording that was cut off as far as it goes."""

from __future__ import annotations

import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk, Header

from launch.compose import compose
from msgs import TYPES, Frame, GroundTruth, Trajectory
from msgs.codec import decode, encode
from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets.mcap_file import MAGIC
from nodes import free_inputs, handlers, is_source, outputs
from nodes.parameters import ParameterError, build
from nodes.player import Player
from nodes.recorder import ENCODING, Recorder
from tests.support.example_messages import MESSAGES, assert_equal, example


def recorded(path: Path, count: int = 10, **config: Any) -> list[Frame | GroundTruth]:
    """Records a frame and its ground truth, `count` times."""
    recorder = Recorder(Recorder.Config(str(path), **config))
    rng = np.random.default_rng(0)
    messages: list[Frame | GroundTruth] = []
    for index in range(3, 3 + 2 * count, 2):  # a stride of the source: indices are not places
        image = rng.integers(0, 255, (48, 64, 3), np.uint8)
        frame = Frame(index, index / 30, image, np.ones(4))
        truth = GroundTruth(index, index / 30, image, np.ones(4), np.eye(4), np.ones((48, 64), np.float32))
        recorder.on_message(frame)
        recorder.on_message(truth)
        messages += [frame, truth]
    assert list(recorder.on_end()) == []
    assert recorder.stats.counts["recorded"] == 2 * count
    return messages


def played(path: Path, **config: Any) -> tuple[Player, list[Any]]:
    player = Player(Player.Config(str(path), **config))
    return player, list(player.run())


@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_a_recording_is_played_as_it_was(tmp_path: Path, compression: str) -> None:
    messages = recorded(tmp_path / "a.mcap", compression=compression)
    player, again = played(tmp_path / "a.mcap")
    assert len(again) == len(messages)
    for a, b in zip(messages, again, strict=True):
        assert_equal(a, b)
    assert player.stats.counts == {"frames": 10}
    assert player.stats.warnings == []


def test_a_part_of_a_recording_is_played(tmp_path: Path) -> None:
    recorded(tmp_path / "a.mcap")
    _, again = played(tmp_path / "a.mcap", start=2, stop=8, stride=3)
    assert [(type(m), m.index) for m in again] == [(Frame, 7), (GroundTruth, 7), (Frame, 13), (GroundTruth, 13)]


def test_ground_truth_may_come_before_its_frame(tmp_path: Path) -> None:
    recorder = Recorder(Recorder.Config(str(tmp_path / "a.mcap")))
    image = np.ones((4, 4, 3), np.uint8)
    for index in (0, 1, 2):  # the two topics reach a recorder in any order
        recorder.on_message(GroundTruth(index, 0.0, image, np.ones(4), None, None))
    for index in (0, 1, 2):
        recorder.on_message(Frame(index, 0.0, image, np.ones(4)))
    list(recorder.on_end())
    _, again = played(tmp_path / "a.mcap", stop=2)
    assert sorted((type(m).__name__, m.index) for m in again) == [
        ("Frame", 0),
        ("Frame", 1),
        ("GroundTruth", 0),
        ("GroundTruth", 1),
    ]


def test_ground_truth_is_that_of_its_frame_where_a_live_recording_lacks_frames(tmp_path: Path) -> None:
    recorder = Recorder(Recorder.Config(str(tmp_path / "a.mcap")))
    image = np.ones((4, 4, 3), np.uint8)
    for index in range(11):
        truth = GroundTruth(index, 0.0, image, np.ones(4), None, None)
        if index in (3, 9):  # the truth comes first
            recorder.on_message(truth)
        if index in (0, 3, 4, 7, 9):
            recorder.on_message(Frame(index, 0.0, image, np.ones(4)))
        if index not in (3, 9):
            recorder.on_message(truth)
    list(recorder.on_end())
    assert [text for text in recorder.stats.warnings if "a.mcap lacks 6 of 11 frames" in text]

    def indices(**config: Any) -> list[tuple[str, int]]:
        player, again = played(tmp_path / "a.mcap", **config)
        if not config:
            assert any("lacks the frames of 6 ground truths" in text for text in player.stats.warnings)
        return [(type(message).__name__, message.index) for message in again]

    def pairs(*wanted: int) -> list[tuple[str, int]]:
        return [(name, index) for index in wanted for name in ("Frame", "GroundTruth")]

    assert indices() == pairs(0, 3, 4, 7, 9)
    assert indices(start=1, stop=4, stride=2) == pairs(3, 7)
    assert indices(stop=2) == pairs(0, 3)
    assert indices(start=4) == pairs(9)


@pytest.mark.parametrize("kept", [0.95, 0.5])
def test_a_recording_that_was_cut_off_is_played_as_far_as_it_goes(tmp_path: Path, kept: float) -> None:
    path = tmp_path / "a.mcap"
    messages = recorded(path, count=200)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    player, again = played(path)
    assert len(messages) * kept * 0.6 < len(again) < len(messages)
    for a, b in zip(messages, again, strict=False):
        assert_equal(a, b)
    assert any("cut off" in warning for warning in player.stats.warnings)


def test_what_cannot_be_played_says_why(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"must be an \.mcap file"):
        played(tmp_path / "none.mcap")
    with pytest.raises(FileNotFoundError, match="path=None"):
        list(Player().run())
    (tmp_path / "text.mcap").write_text("no recording\n" * 100)
    with pytest.raises(ValueError, match="is no recording"):
        played(tmp_path / "text.mcap")
    recorded(tmp_path / "a.mcap", 1)
    with pytest.raises(ValueError, match="0 <= start < stop"):
        played(tmp_path / "a.mcap", start=3, stop=2)
    with pytest.raises(ValueError, match="has 1 frames"):
        played(tmp_path / "a.mcap", start=5)


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    recorded(tmp_path / "a.mcap", 1)
    with pytest.raises(FileExistsError):
        recorded(tmp_path / "a.mcap", 1)
    with pytest.raises(ParameterError, match="compression=gzip: must be 'lz4' or 'zstd' or 'none'"):
        build(Recorder.Config, {"compression": "gzip"})


def test_other_tools_can_read_what_is_in_it(tmp_path: Path) -> None:
    recorder = Recorder(Recorder.Config(str(tmp_path / "a.mcap")))
    sent = {t.__name__: example(t) for t in MESSAGES}
    for message in sent.values():
        recorder.on_message(message)
    list(recorder.on_end())
    with (tmp_path / "a.mcap").open("rb") as file:
        seen = {}
        for schema, channel, record in make_reader(file).iter_messages():
            assert schema is not None
            if channel.message_encoding != ENCODING:
                continue  # what Foxglove shows
            assert schema.name == channel.topic
            seen[channel.topic] = decode(record.data).message
            if channel.topic == "GroundTruth":
                assert b"depth: float32 H W or nil" in schema.data
    assert seen.keys() == sent.keys()
    for name, message in sent.items():
        assert_equal(message, seen[name])
    assert isinstance(seen["Trajectory"], Trajectory)


def test_the_contract_of_both_nodes() -> None:
    assert is_source(Player)
    assert set(outputs(Player)) == {Frame, GroundTruth}
    assert set(handlers(Recorder)) == free_inputs(Recorder) == set(TYPES.values())
    assert free_inputs(Player) == set()
    assert outputs(Recorder) == ()


@pytest.mark.slow
@pytest.mark.parametrize("choice", ["mcap", "mcap_all"])
def test_both_recorders_and_the_player_fit_into_the_graph(tmp_path: Path, choice: str) -> None:
    recorded(tmp_path / "a.mcap", 1)
    graph = compose(["dataset=player", f"dataset.path={tmp_path / 'a.mcap'}", f"recorder={choice}", "output=/tmp/x"])
    read = {edge.message for edge in graph.edges if edge.reader == "recorder"}
    assert {Frame, GroundTruth} <= read
    assert graph.slots["recorder"].config["path"] == "/tmp/x/recording.mcap"


def damaged(path: Path, at: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        file.write(data)


def chunk_starts(path: Path) -> list[int]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [chunk.chunk_start_offset for chunk in summary.chunk_indexes]


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
@pytest.mark.parametrize(
    ("offset", "data"),
    [
        (4000, b"\x00\xff\x00\xff"),  # of the content: its checksum, or the decompressor, tells
        (
            1,
            b"\xff\xff\xff\xff\xff\xff\xff\x00",
        ),  # of the length: only the index knows where the next chunk is
        (0, b"\x00"),  # of the kind
        (0, b"\x0f"),  # "the data end here"
    ],
)
def test_behind_a_damaged_chunk_the_rest_is_played(tmp_path: Path, compression: str, offset: int, data: bytes) -> None:
    path = tmp_path / "a.mcap"
    messages = recorded(path, 200, compression=compression)
    starts = chunk_starts(path)
    assert len(starts) > 4
    damaged(path, starts[2] + offset, data)
    player, again = played(path)
    assert 0.6 * len(messages) < len(again) < len(messages)
    last = again[-1]
    assert (type(last), last.index) == (type(messages[-1]), messages[-1].index)
    assert any("a.mcap left out because they are damaged: 1" in warning for warning in player.stats.warnings)


def test_a_message_that_is_none_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    recorder = Recorder(Recorder.Config(str(path)))
    image = np.ones((4, 4, 3), np.uint8)
    for index in range(4):
        recorder.on_message(Frame(index, 0.0, image, np.ones(4)))
        if index == 1:
            for data in (b"", b"no message", bytes(encode(Frame(9, 0.0, image, np.ones(4))))[:-20]):
                recorder._writer.add_message(recorder._channels["Frame"], 0, data, 0, 2)
    list(recorder.on_end())
    recorder = Recorder(Recorder.Config(str(tmp_path / "b.mcap")))
    for intrinsics in ([2, 2, 2, 2], [2, 2, 1e9, 2], [0, 2, 2, 2], [np.nan, 2, 2, 2]):
        recorder.on_message(Frame(0, 0.0, image, np.array(intrinsics, np.float64)))
    for original in ([8, 8, 7, 7], [np.inf, 8, 7, 7], [8, -8, 7, 7]):
        frame = Frame(0, 0.0, image, 2 * np.ones(4), original_intrinsics=np.array(original, np.float64))
        recorder.on_message(frame)
    list(recorder.on_end())
    impossible, kept = played(tmp_path / "b.mcap")
    assert len(kept) == 2
    assert "left out because they are damaged: 5 (first: Frame 1: principal point" in impossible.stats.warnings[0]
    player, again = played(path)
    assert [message.index for message in again] == [0, 1, 2, 3]
    assert any("left out because they are damaged: 3 (first: " in warning for warning in player.stats.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("promised", [2**30, 2**20, 0])
def test_a_chunk_that_would_fill_the_memory_is_left_out(tmp_path: Path, promised: int) -> None:
    compressor = zstandard.ZstdCompressor().compressobj()
    block = bytes(2**20)
    bomb = b"".join(compressor.compress(block) for _ in range(2**10)) + compressor.flush()
    assert len(bomb) < 2**16, "a gigabyte"
    records = RecordBuilder()
    records.write(MAGIC)
    Header(profile="", library="").write(records)
    Chunk("zstd", bomb, 0, 0, 0, promised).write(records)
    (tmp_path / "a.mcap").write_bytes(records.end())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BadFileError, match=r"nothing of it can be played.*more than the"):
        Player.check(Player.Config(str(tmp_path / "a.mcap")))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**14, "kB"


def test_a_recording_without_anything_to_play_is_refused_before_the_run(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    recorded(path, 3)
    size = path.stat().st_size
    damaged(path, 60, bytes(size - 60))
    with pytest.raises(BadFileError, match=r"a\.mcap: nothing of it can be played: .*was cut off"):
        compose_and_check(["dataset=player", f"dataset.path={path}"])


def test_a_recording_that_cannot_be_made_is_refused_before_the_run(tmp_path: Path) -> None:
    def refusal(path: object) -> str:
        with pytest.raises(OSError, match=r"^path=") as refused:
            Recorder.check(Recorder.Config(str(path)))
        return str(refused.value)

    file = tmp_path / "file.mcap"
    file.touch()
    (tmp_path / "link.mcap").symlink_to(tmp_path / "nowhere")
    assert refusal("") == "path=: is empty; give a file, such as recording.mcap"
    assert f"is a folder; give a file, such as {tmp_path}/recording.mcap" in refusal(tmp_path)
    assert f"{file} is a file; give another file" in refusal(file / "new" / "a.mcap")
    assert "exists already" in refusal(file)
    assert "exists already" in refusal(tmp_path / "link.mcap")
    assert "File name too long; give a file that can be written" in refusal(tmp_path / ("a" * 300))
    Recorder.check(Recorder.Config(str(tmp_path / "new" / "folder" / "a.mcap")))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file.mcap", "link.mcap"], "nothing is made"


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="there is no /proc, in which nobody can make a file")
def test_a_recording_where_nothing_can_be_written_is_refused_before_the_run() -> None:
    with pytest.raises(OSError, match=r"^path=/proc/a\.mcap: .*; give a file that can be written$"):
        Recorder.check(Recorder.Config("/proc/a.mcap"))


def compose_and_check(overrides: list[str]) -> None:
    graph = compose([*overrides, "output=/tmp/x"])
    slot = graph.slots["dataset"]
    slot.node.check(slot.parameters)


def test_a_recording_of_another_wire_version_is_refused_as_one(tmp_path: Path) -> None:
    recorder = Recorder(Recorder.Config(str(tmp_path / "a.mcap"), compression="none"))
    recorder.on_message(Frame(0, 0.0, np.zeros((48, 64, 3), np.uint8), np.array([50.0, 50.0, 31.5, 23.5])))
    older = bytearray(encode(Frame(1, 0.1, np.zeros((48, 64, 3), np.uint8), np.ones(4)), 1))
    older[4] = 1
    recorder._writer.add_message(recorder._channels["Frame"], 0, bytes(older), 0, 1)
    list(recorder.on_end())
    with pytest.raises(BadFileError, match=r"a\.mcap was recorded by another release: .*version 1; .*version 2"):
        played(tmp_path / "a.mcap")
