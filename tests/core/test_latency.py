"""Quantiles of durations, in constant memory."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from mvsgs_core.latency import Latency
from mvsgs_core.stats import Stats


def test_quantiles_are_those_of_the_values() -> None:
    values = np.random.default_rng(0).lognormal(-3.0, 1.0, 5000)
    latency = Latency()
    for value in values:
        latency.add(value)
    assert latency.quantile(0.5) == pytest.approx(np.median(values), rel=0.02)
    assert latency.quantile(0.99) == pytest.approx(np.percentile(values, 99), rel=0.05)
    assert latency.figures["count"] == 5000


def test_one_value_is_every_quantile() -> None:
    latency = Latency()
    latency.add(0.25)
    assert latency.quantile(0.5) == pytest.approx(0.25, rel=0.02)
    assert latency.quantile(0.99) <= 0.25


def test_nothing_is_no_latency_and_a_clock_that_was_set_none_either() -> None:
    latency = Latency()
    for seconds in (-1.0, math.nan, math.inf):
        latency.add(seconds)
    assert latency.figures == {"median": 0.0, "p99": 0.0, "count": 0}


def test_what_is_of_no_camera_is_not_measured() -> None:
    stats = Stats()
    stats.arrived("frame to pose", 0.0)
    assert "latency" not in stats.values
    stats.arrived("frame to pose", time.time() - 0.5)
    assert stats.values["latency"]["frame to pose"]["median"] == pytest.approx(0.5, abs=0.1)
    assert stats.latency("frame to pose", "keyframe to map")[1] == [0.0, 0.0]
