"""Bags whose recorder was killed: they have no index, ROS 2's no metadata.yaml either."""

from __future__ import annotations

import os
from pathlib import Path
from shutil import rmtree

import pytest

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset, recognized
from mvsgs_core.datasets.bag_file import opened_bag

pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from tests.support.bag_messages import Messages, images_of, walk, write_walk


@pytest.mark.parametrize("metadata", [True, False])
@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_bag_of_ros_2_whose_recorder_was_killed_is_read(
    tmp_path: Path, plugin: StoragePlugin, metadata: bool
) -> None:
    """It has no metadata.yaml, and of MCAP no index."""
    ros = Messages(2)
    with Writer2(tmp_path / "walk", version=9, storage_plugin=plugin) as writer:
        write_walk(ros, writer)
    if not metadata:
        (tmp_path / "walk/metadata.yaml").unlink()
    if plugin is StoragePlugin.MCAP:
        (file,) = (tmp_path / "walk").glob("*.mcap")
        file.write_bytes(file.read_bytes()[:-1700])
    assert recognized(tmp_path / "walk") == ["bag"]
    sequence = open_dataset("bag", path=tmp_path / "walk")
    assert any("was cut off" in warning for warning in sequence.warnings) == (plugin is StoragePlugin.MCAP)
    assert [int(item.image[0, 0, 0]) - 20 for item in sequence] == list(range(6))
    assert sequence.lens.intrinsics[0] == 40


def test_the_files_of_a_bag_of_ros_2_follow_one_another(tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    for part in (0, 1):
        with Writer2(tmp_path / "part", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            write_walk(Messages(2), writer, range(6 * part, 6 * part + 6))
        (file,) = (tmp_path / "part").glob("*.mcap")
        (tmp_path / f"walk/walk_{part + 9}.mcap").write_bytes(file.read_bytes()[:-1700])
        rmtree(tmp_path / "part")
    sequence = open_dataset("bag", path=tmp_path / "walk")
    assert [int(item.image[0, 0, 0]) - 20 for item in sequence] == list(range(12))


def test_a_hidden_file_of_another_disk_is_none_of_the_bag(tmp_path: Path) -> None:
    with Writer2(tmp_path / "walk", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        write_walk(Messages(2), writer)
    (tmp_path / "walk/metadata.yaml").unlink()
    (tmp_path / "walk/._walk.mcap").write_bytes(b"\x00\x05\x16\x07Mac OS X")
    assert recognized(tmp_path / "walk") == ["bag"]
    assert len(open_dataset("bag", path=tmp_path / "walk")) == 6


@pytest.mark.parametrize("end", ["no index", "within a chunk", "within a chunk that is open"])
def test_a_bag_of_ros_1_whose_recorder_was_killed_is_read(tmp_path: Path, end: str) -> None:
    ros, path = Messages(1), tmp_path / "walk.bag"
    writer = Writer1(path)
    writer.chunk_threshold = 1  # a chunk a message
    with writer:
        write_walk(ros, writer)
    with opened_bag(path) as bag:
        chunks = list(bag.readers[0].chunks.values())
    last, content = chunks[-1], bytearray(path.read_bytes())
    if end == "within a chunk that is open":  # its lengths are filled in when it is closed
        last = chunks[-2]
        content[last.datapos - 4 : last.datapos] = bytes(4)
        at = content.rindex(b"size=", 0, last.datapos)
        content[at + 5 : at + 9] = bytes(4)
        del content[last.datapos + last.datasize + 200 :]
    else:
        del content[last.datapos + (last.datasize if end == "no index" else 200) :]
    path.unlink()
    path = path.with_name("walk.bag.active")
    path.write_bytes(content)
    assert recognized(path) == ["bag"]
    sequence = open_dataset("bag", path=path)
    assert any("read record by record" in warning for warning in sequence.warnings)
    assert any("was cut off" in warning for warning in sequence.warnings) == (end != "no index")
    assert [int(item.image[0, 0, 0]) - 20 for item in sequence] == list(range(6 if end == "no index" else 5))
    assert sequence.lens.intrinsics[0] == 40


def test_a_part_that_is_missing_is_said(tmp_path: Path) -> None:
    with Writer2(tmp_path / "walk", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        write_walk(Messages(2), writer)
    settings = tmp_path / "walk/metadata.yaml"
    name = next((tmp_path / "walk").glob("*.mcap")).name
    settings.write_text(settings.read_text().replace(name, "walk_1.mcap"))
    sequence = open_dataset("bag", path=tmp_path / "walk")
    assert "walk_1.mcap" in sequence.warnings[0]
    assert len(list(sequence)) == 6
    (tmp_path / "walk/walk_1.mcap.zstd").touch()
    settings.unlink()
    assert recognized(tmp_path / "walk") == []
    with pytest.raises(BadFileError, match="ros2 bag reindex"):
        open_dataset("bag", path=tmp_path / "walk")


def test_records_of_a_topic_whose_name_was_lost_cost_no_others(tmp_path: Path) -> None:
    ros, path = Messages(1), tmp_path / "walk.bag"
    ros.write(path, [("/imu", 0.5, ros.info()), *images_of(ros), ("/imu", 9.5, ros.info())])
    content = bytearray(path.read_bytes())
    at = content.index(b"topic=/imu") - 4  # its connection's record in the chunk, and no index
    content[at : at + 4] = b"\xff" * 4
    path.write_bytes(content[: content.rindex(b"topic=/imu") - 100])
    sequence = open_dataset("bag", path=path)
    assert [int(item.image[0, 0, 0]) - 20 for item in sequence] == list(range(6))
    assert any("records of the bag left out because they are damaged" in w for w in sequence.warnings)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert recognized(tmp_path / "pipe") == []


def test_what_is_too_damaged_to_be_walked_is_refused(tmp_path: Path) -> None:
    ros = Messages(2)
    one = walk(ros, tmp_path / "other")
    next(one.glob("*.db3")).write_bytes(b"SQLite format 3\0")
    with pytest.raises(BadFileError, match="ros2 bag reindex"):
        open_dataset("bag", path=one)
    first = Messages(1)
    old = walk(first, tmp_path / "old.bag")
    old.write_bytes(old.read_bytes()[:900])
    with pytest.raises(BadFileError, match=r"old\.bag: no message could be read: .*; old\.bag was cut off"):
        open_dataset("bag", path=old)
