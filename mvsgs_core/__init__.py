"""MVS-GS core: arrays in, arrays out. Imports neither msgs, nodes nor zmq.

`from mvsgs_core import Mapping` is the whole system for programs, see `mvsgs.Mapping`; loaded when it is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mvsgs.mapping import Mapping


def __getattr__(name: str) -> Any:
    if name == "Mapping":
        from mvsgs.mapping import Mapping

        return Mapping
    raise AttributeError(f"module 'mvsgs_core' has no attribute {name!r}")


__all__ = ["Mapping"]
