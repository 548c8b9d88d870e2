"""A whole run between two programs of ROS 2: images in, poses, transforms, depth and the map out."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.support.ros2_peer import OWN_DOMAIN, Peer
from tests.support.shared_data import ROOT, shared

pytest.importorskip("cyclonedds", reason="ROS 2 is reached by cyclonedds (pip install cyclonedds)")
pytest.importorskip("rosbags", reason="the other program has rosbags' definitions")
pytestmark = pytest.mark.slow

FRAMES = 40
SLOWER = 4.0  # than it was taken: a busy machine lets no more frames pass than an idle one, and some it overtakes
TOPICS = {
    "/mvsgs/pose": "geometry_msgs/msg/PoseStamped", "/mvsgs/path": "nav_msgs/msg/Path", "/tf": "tf2_msgs/msg/TFMessage",
    "/mvsgs/points": "sensor_msgs/msg/PointCloud2", "/mvsgs/depth/image": "sensor_msgs/msg/Image",
}  # fmt: skip


def slowed(folder: Path) -> Path:
    """More frames of a sequence than are taken, at a pace that leaves time for each."""
    sequence = shared("data/tum_fr1_xyz")
    (folder / "rgb").mkdir(parents=True)
    lines = [line.split() for line in (sequence / "rgb.txt").read_text().splitlines() if line[0] != "#"][: 4 * FRAMES]
    first = float(lines[0][0])
    for _, name in lines:
        shutil.copy(sequence / name, folder / name)
    listed = [f"{first + SLOWER * (float(at) - first):.6f} {name}" for at, name in lines]
    (folder / "rgb.txt").write_text("\n".join(listed))
    return folder


def test_a_run_from_ros_to_ros(tmp_path: Path) -> None:
    peer = Peer()
    for topic, name in TOPICS.items():
        peer.subscribe(topic, name, transient_local=topic.endswith("points"), depth=1000)
    domain = {**os.environ, "ROS_DOMAIN_ID": str(OWN_DOMAIN), "PYTHONPATH": ""}
    camera = subprocess.Popen(
        [sys.executable, ROOT / "examples/robot.py", "--dataset", "tum", slowed(tmp_path / "tum_fr1"),
         "--ros2", "/eye/image_raw"],
        env=domain, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        done = subprocess.run(
            [sys.executable, ROOT / "launch/run_all.py", f"output={tmp_path / 'out'}", "dataset=ros2", "publisher=ros2",
             "dataset.path=/eye/image_raw", "dataset.size=[120,160]", f"dataset.stop={FRAMES}", "device=cpu",
             "mapper.iterations=2", "mapper.refinement=5", "evaluator.lpips=off", "tracker.threads=1"],
            cwd=tmp_path, capture_output=True, text=True, timeout=240, env=domain,
        )  # fmt: skip
    finally:
        camera.kill()
        said = camera.communicate()[0]
    assert done.returncode == 0, done.stdout + done.stderr + said
    report = json.loads((tmp_path / "out/report.json").read_text())
    tracked = report["trajectory"]["frames_tracked"]
    assert tracked >= 0.8 * report["trajectory"]["frames"] > 10, (report["counts"]["dataset"], report["warnings"], said)
    time.sleep(0.5)
    taken = {topic: peer.taken(topic) for topic in TOPICS}
    peer.close()
    poses = taken["/mvsgs/pose"]
    assert 5 <= len(poses) <= report["trajectory"]["frames"]  # from the moment on when the first keyframes are solved
    stamps = [p["header"]["stamp"]["sec"] + 1e-9 * p["header"]["stamp"]["nanosec"] for p in poses]
    assert stamps == sorted(stamps)
    trajectory = np.loadtxt(tmp_path / "out/trajectory.txt")
    assert np.abs(np.subtract.outer(trajectory[:, 0], stamps)).min(axis=0).max() < 1e-5
    final = trajectory[np.abs(trajectory[:, 0] - stamps[-1]).argmin(), 1:4]
    shown = [poses[-1]["pose"]["position"][axis] for axis in "xyz"]
    span = np.ptp(trajectory[:, 1:4], axis=0).max()
    assert [final[2], -final[0], -final[1]] == pytest.approx(shown, abs=0.1 * span)  # later corrections are small
    assert len(taken["/tf"]) >= len(poses)
    assert len(taken["/mvsgs/path"][-1]["poses"]) == len(taken["/mvsgs/path"])
    assert len(taken["/mvsgs/depth/image"]) >= 3
    assert taken["/mvsgs/points"][-1]["width"] > 1000
