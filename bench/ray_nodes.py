"""A Ray cluster on the loopback device, a machine of one core each, that lives as long as a `with`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from bench.runs import ROOT

STORE = 256 << 20  # bytes of each node's object store
LOOPBACK = "127.0.0.2"  # Ray takes 127.0.0.1 for the address that others reach this machine by


@contextmanager
def ray_nodes(count: int) -> Iterator[str]:
    """The address of so many nodes. Raises ImportError where Ray is not installed."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray.cluster_utils import Cluster

    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *([before] if before else [])])  # workers need the core
    one = {"num_cpus": 1, "num_gpus": 0, "object_store_memory": STORE, "node_ip_address": LOOPBACK}
    cluster = Cluster()
    try:
        for _ in range(count):
            cluster.add_node(**one)
        cluster.wait_for_nodes()
        yield str(cluster.address)
    finally:
        cluster.shutdown()
        os.environ.pop("PYTHONPATH") if before is None else os.environ.update(PYTHONPATH=before)


__all__ = ["ray_nodes"]
