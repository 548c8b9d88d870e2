"""Where a bag's /tf says that its camera was: by the robot's own odometry, SLAM or motion capture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets.bag_file import messages
from mvsgs_core.datasets.sequence import Notices
from mvsgs_core.datasets.transform_tree import STATIC, TOPICS, TransformTree

if TYPE_CHECKING:
    from mvsgs_core.datasets.bag_file import OpenBag

ROUNDING = 1000  # ns by which a stamp may be off that is held in seconds: float64 has steps of 240 since 1970
_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


class BagPoses:
    """Poses of a camera in a fixed frame, in whose unit lengths are: meters."""

    def __init__(self, tree: TransformTree, camera: str, world: str) -> None:
        self._tree, self._camera, self._world = tree, camera, world

    def at(self, seconds: float, notices: Notices) -> np.ndarray | None:
        """(4, 4) world_from_cam of an image with this stamp; None, counted in `notices`, where /tf does not tell."""
        time = round(1e9 * seconds)
        near = (self._tree.pose(self._camera, self._world, time + off) for off in (0, -ROUNDING, ROUNDING))
        pose = next((pose for pose in near if pose is not None), None)
        if pose is None:
            what = f"images without a pose, as /tf does not say where {self._camera} was in {self._world} then"
            notices.tally(what, f"{seconds:.3f} s")
        return pose


def poses_in(bag: OpenBag, camera: str, world: str, notices: Notices) -> BagPoses:
    """Raises ValueError where the bag has no /tf, or one that does not connect the two frames."""
    topics = [c for c in bag.connections if c.topic in TOPICS and c.msgtype in _TYPES and c.msgcount]
    if not topics:
        raise ValueError(
            f"dataset.options.fixed_frame={world}: the bag has no /tf, which would say where the camera was"
        )
    tree, damage = TransformTree(), Notices()
    for connection, _, data in messages(bag, topics, damage):
        try:
            with reading("a message", "cannot be read"):
                tree.add(bag.deserialize(data, connection.msgtype), connection.topic == STATIC)
        except BadFileError as error:
            damage.tally("messages of /tf left out because they cannot be read", str(error))
    notices += damage
    if tree.refused:
        notices.append(f"transforms in /tf left out because they are none: {tree.refused}")
    if not tree.connects(camera, world):
        raise ValueError(
            f"the bag's /tf does not connect {camera!r}, the camera's frame, with {world!r}; it has "
            f"{', '.join(tree.frames) or 'none'}: choose with dataset.options.fixed_frame and .camera_frame"
        )
    return BagPoses(tree, camera, world)
