"""`mvsgs`: the command that starts everything that a user starts, and `Mapping`, which maps within a program.

    from mvsgs import Mapping

    with Mapping("mapper.iterations=100", intrinsics=[610, 610, 320, 240]) as mapping:
        for image, timestamp in frames:
            mapping.add(image, timestamp)
    mapping.save("runs/kitchen")

`launch`, `nodes` and `msgs`, generic names, are no packages of their own in site-packages: a wheel carries them in
`mvsgs/workspace`, which is on the path only of what this command starts. In a checkout they are beside this folder.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mvsgs.rooms import WORKSPACE

if TYPE_CHECKING:
    from mvsgs.gaussian_map import GaussianMap, View
    from mvsgs.mapping import Mapping, Tracked


def __getattr__(name: str) -> Any:
    """The names of the interface, loaded when they are asked for: they bring torch."""
    if name in ("Mapping", "Tracked"):
        from mvsgs import mapping

        return getattr(mapping, name)
    if name in ("GaussianMap", "View"):
        from mvsgs import gaussian_map

        return getattr(gaussian_map, name)
    raise AttributeError(f"module 'mvsgs' has no attribute {name!r}")


__all__ = ["WORKSPACE", "GaussianMap", "Mapping", "Tracked", "View"]
