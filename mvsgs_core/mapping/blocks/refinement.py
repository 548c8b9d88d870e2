"""The final refinement of a large map in blocks: here, one after the other, or on a cluster, one a worker.

The last iterations go over the whole map: what a block makes of its edge is made for what another one had there before.
"""

from __future__ import annotations

from collections.abc import Iterator

from mvsgs_core.mapping.blocks.job import Result, iterations_of, job_of, merge, parting_of, plain, refined
from mvsgs_core.mapping.blocks.parting import Parting
from mvsgs_core.mapping.blocks.ray_cluster import ClusterError, RayCluster
from mvsgs_core.mapping.mapper import OnlineMapper

WORTH = 1.5  # times the iterations of the whole map that blocks of it may take in one process
TOGETHER = 0.2  # of the iterations, the last, over the whole map


def refined_in_blocks(mapper: OnlineMapper, total: int) -> Iterator[int] | None:
    """Of `total` iterations over the map those that blocks make, a piece at a time: yields how many of them are done, 0
    until the map changes, with the last piece. The rest are ordinary ones, over the whole map. None: all are, as it is
    small, or neither blocks nor a cluster are asked for."""
    config = mapper.config.refine
    if not mapper.views or not len(mapper.state):
        return None
    if config.by == "ray":
        return _on_cluster(mapper, total)
    count = _blocks(mapper)
    if count == 1:
        return None
    parting = parting_of(mapper, count)
    if config.blocks is None and sum(iterations_of(mapper, parting, total)) > WORTH * total:
        return None  # all keyframes see the same: one after the other, blocks would only take longer
    return _here(mapper, total, parting)


def _blocks(mapper: OnlineMapper, machines: int = 1) -> int:
    config, keyframes = mapper.config.refine, len(mapper.views)
    return config.blocks or max(machines, -(-keyframes // (config.keyframes or keyframes)))


def _here(
    mapper: OnlineMapper, total: int, parting: Parting, results: dict[int, Result] | None = None
) -> Iterator[int]:
    """results: of blocks that are done already."""
    results, blocks = results or {}, len(parting)
    for block, iterations in enumerate(iterations_of(mapper, parting, total)):
        if block in results:
            continue
        job = job_of(mapper, parting, block, iterations, together(iterations, blocks))
        for result in refined(job, mapper.config):
            if result is not None:
                results[block] = result
            yield 0
    merge(mapper, [results[block] for block in sorted(results)])
    mapper.log.values["blocks"] = blocks
    yield total - together(total, blocks)


def together(iterations: int, blocks: int) -> int:
    """Of a refinement's iterations, the last ones: of the whole map, no block's own. A single block has no seams."""
    return round(TOGETHER * iterations) if blocks > 1 else 0


def _on_cluster(mapper: OnlineMapper, total: int) -> Iterator[int]:
    """What the cluster cannot do is done here: a stream's map is not lost for want of a machine."""
    results: dict[int, Result] = {}
    parting = None
    try:
        with mapper.log.time("refinement on Ray"), RayCluster(mapper.config.refine) as cluster:
            parting = parting_of(mapper, _blocks(mapper, cluster.machines))
            parts = iterations_of(mapper, parting, total)
            jobs = (
                job_of(mapper, parting, block, each, together(each, len(parts))) for block, each in enumerate(parts)
            )
            for finished in cluster.refined(jobs, plain(mapper.config)):
                results.update(finished)
                yield 0
            mapper.log.values["machines"] = cluster.machines
    except ClusterError as error:
        mapper.log.warn(f"the Ray cluster at {mapper.config.refine.address} failed, the map is refined here: {error}")
    yield from _here(mapper, total, parting or parting_of(mapper, _blocks(mapper)), results)


__all__ = ["refined_in_blocks", "together"]
