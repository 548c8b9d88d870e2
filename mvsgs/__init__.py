"""The command `mvsgs`: everything that a user starts, by one word.

`launch`, `nodes` and `msgs`, generic names, are no packages of their own in site-packages: a wheel carries them in
`mvsgs/workspace`, which is on the path only of what this command starts. In a checkout they are beside this folder.
"""

from __future__ import annotations

from pathlib import Path

_PACKED = Path(__file__).resolve().parent / "workspace"
WORKSPACE = _PACKED if _PACKED.is_dir() else Path(__file__).resolve().parents[1]

__all__ = ["WORKSPACE"]
