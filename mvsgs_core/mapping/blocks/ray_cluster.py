"""Blocks on a Ray cluster that the user started and named: one a machine at a time, with all of its cores.

Ray is an extra, `ray` in pyproject.toml. Its members trust each other: who reaches its port runs code on all of them,
and what they exchange is pickled, by Ray. So none is started or looked for here.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterable, Iterator
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

from mvsgs_core.mapping.blocks.config import RefineConfig
from mvsgs_core.mapping.blocks.job import Job, Result, refined
from mvsgs_core.mapping.config import MapperConfig

WAIT = 0.1  # seconds between two looks


class ClusterError(Exception):
    """The cluster is not there, or lost what it was given."""


def refine_job(job: Job, config: MapperConfig) -> Result:
    """What a worker runs."""
    for result in refined(job, config):
        if result is not None:
            return result
    raise AssertionError("a refinement ends with its result")


class RayCluster:
    """Joined in a `with`. Raises ClusterError."""

    def __init__(self, config: RefineConfig) -> None:
        """`config.address`: HOST:PORT of its head, where this machine is a member, or ray://HOST:PORT of a server."""
        self._config = config
        self.machines = self.cpus = self.gpus = 0  # machines; cores and GPUs of the smallest of them

    def __enter__(self) -> Self:
        try:
            self._config.check()
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is told to anybody
            import ray

            self._ray: Any = ray
            main = threading.current_thread() is threading.main_thread()
            handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)} if main else {}
            try:
                ray.init(address=self._config.address, log_to_driver=False, logging_level="error")
            finally:
                for number, handler in handlers.items():  # Ray sets its own
                    signal.signal(number, handler)
            machines = self._working()
            self.machines = len(machines)
            self.cpus = int(min((resources["CPU"] for resources in machines), default=0))
            self.gpus = min(1, int(min((resources.get("GPU", 0) for resources in machines), default=0)))
        except Exception as error:
            self.__exit__(None, None, None)
            raise ClusterError(str(error)) from error
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if hasattr(self, "_ray"):
            self._ray.shutdown()

    def refined(self, jobs: Iterable[Job], config: MapperConfig) -> Iterator[dict[int, Result]]:
        """The results by number of their job, as they come; often none, `WAIT` after the last look.

        No job is made before a machine is free for it. What a machine that is lost had is given to another one.
        """
        # The mapper's own device is this machine's. Of a worker's GPUs, Ray shows it the one that it asked for.
        config = replace(config, threads=self.cpus, device="auto" if self.gpus else "cpu")
        numbered = enumerate(jobs)
        running: dict[Any, int] = {}
        try:
            work = self._ray.remote(
                num_cpus=self.cpus, num_gpus=self.gpus, scheduling_strategy="SPREAD", max_retries=2
            )(refine_job)
            while True:
                while len(running) < self.machines and (following := next(numbered, None)) is not None:
                    number, job = following
                    running[work.remote(job, config)] = number
                if not running:
                    return
                done, _ = self._ray.wait(list(running), timeout=WAIT)
                if not done and not any(resources["CPU"] >= self.cpus for resources in self._working()):
                    raise ClusterError("none of its machines is left")
                yield {running.pop(reference): self._ray.get(reference) for reference in done}
        except (self._ray.exceptions.RayError, OSError, RuntimeError) as error:
            raise ClusterError(str(error)) from error

    def _working(self) -> list[dict[str, float]]:
        """The resources of the machines that are there and have a core to give."""
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        found = [resources for resources in nodes if resources.get("CPU", 0) >= 1]
        if not found:
            raise ClusterError("none of its machines has a core to give")
        return found


__all__ = ["ClusterError", "RayCluster"]
