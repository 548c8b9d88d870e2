"""The global `device`: where nodes run that are not told otherwise."""

from __future__ import annotations

from functools import cached_property

from launch.refusal import GraphError


class GlobalDevice:
    """torch, which knows what there is, is loaded only for a node that needs to know."""

    def __init__(self, wanted: str) -> None:
        """Raises GraphError for what is no device."""
        kind, _, number = wanted.partition(":")
        if kind not in ("auto", "cpu", "cuda") or (number and not number.isdigit()):
            raise GraphError(f"device={wanted}: must be auto, cpu, cuda or cuda:<number>")
        self.wanted = wanted
        self.warnings: list[str] = []  # once it is resolved

    @cached_property
    def resolved(self) -> str:
        """cpu, cuda or cuda:<number>. Raises GraphError for a GPU that is not there, or of no use."""
        if self.wanted == "cpu":
            return "cpu"
        import torch

        from mvsgs_core.devices import lacks_for_gpu

        there = torch.cuda.device_count()
        if self.wanted != "auto" and int(self.wanted.partition(":")[2] or 0) >= there:
            raise GraphError(f"device={self.wanted}: this machine has {there} CUDA devices; use device=cpu")
        lacking = lacks_for_gpu("cuda" if self.wanted == "auto" else self.wanted) if there else ""
        if self.wanted != "auto":
            if lacking:
                raise GraphError(f"device={self.wanted}: {lacking}; or use device=cpu")
            return self.wanted
        if lacking:
            self.warnings.append(f"the GPU is not used: {lacking}")
        return "cuda" if there and not lacking else "cpu"
