"""The RViz configuration shows what publisher=ros2 sends by default, with a quality of service that it offers."""

from __future__ import annotations

import dataclasses

import yaml

from nodes.ros2_publisher import Ros2Publisher
from tests.support.shared_data import ROOT

# RViz's display -> the topic that it draws
DISPLAYS = {"Map": "points", "Keyframes": "path", "Camera": "pose", "Depth": "depth"}
CLASSES = {
    "Map": "PointCloud2",
    "Keyframes": "Path",
    "Camera": "Pose",
    "Depth": "Image",
    "Frames": "TF",
    "Grid": "Grid",
}


def test_rviz_shows_what_is_published() -> None:
    config = Ros2Publisher.Config()
    manager = yaml.safe_load((ROOT / "examples/ros2.rviz").read_text())["Visualization Manager"]
    displays = {display["Name"]: display for display in manager["Displays"]}
    assert {name: display["Class"] for name, display in displays.items()} == {
        name: f"rviz_default_plugins/{kind}" for name, kind in CLASSES.items()
    }
    topics = dataclasses.asdict(config.topics)
    for name, topic in DISPLAYS.items():
        shown = displays[name]["Topic"]
        assert shown["Value"] == config.topic(topics[topic])
        assert shown["Durability Policy"] == ("Transient Local" if topic == "points" else "Volatile")
    assert manager["Global Options"]["Fixed Frame"] == config.frames.map
    assert manager["Views"]["Current"]["Target Frame"] == config.frames.camera
