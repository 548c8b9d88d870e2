"""Parameters of the final refinement in blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mvsgs_core.named_modules import is_installed

MISSING = "refine=ray needs Ray: pip install 'ray>=2.40', here and on the cluster's machines"


@dataclass(frozen=True)
class RefineConfig:
    """Who does the final refinement, and in how many parts of the map."""

    by: Literal["here", "ray"] = "here"  # this process, one block after the other; ray: a cluster's workers, one each
    keyframes: int | None = None  # in a block: a map with more is refined in as many as that takes; null: any number
    blocks: int | None = None  # so many; null: by `keyframes`, on a cluster at least one a machine
    overlap: float = 0.0  # part of what a keyframe sees in another block from which on it is trained on there, too
    address: str = "127.0.0.1:6379"  # of the Ray cluster, as `ray start --head` says; no other one is looked for

    def __post_init__(self) -> None:
        if any(count is not None and count < 1 for count in (self.keyframes, self.blocks)):
            raise ValueError("keyframes and blocks must be at least 1")
        if not 0.0 <= self.overlap <= 1.0:
            raise ValueError(f"overlap={self.overlap}: must be from 0 to 1")
        if not self.address or self.address in ("auto", "local"):
            raise ValueError(f"address={self.address!r}: must name the cluster, as HOST:PORT or ray://HOST:PORT")

    def check(self) -> None:
        """Raises ValueError where what it asks for is not installed."""
        if self.by == "ray" and not is_installed("ray"):
            raise ValueError(MISSING)


__all__ = ["RefineConfig"]
