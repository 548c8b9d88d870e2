"""What nodes say of themselves is never trusted in form."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mvsgs_core.evaluation.statistics import collected


def test_what_nodes_counted_is_taken_over() -> None:
    stats = {
        "tracker": {"seconds": {"flow": 1.5}, "cpu_seconds": 2, "peak_bytes": 5, "skipped": {"frames": 2},
                    "counts": {"frames": 60}, "warnings": ["w"], "values": {"nothing": "too little motion"}},
        "mvs": {"seconds": {}},
    }  # fmt: skip
    assert collected(stats) == {
        "time": {"stages": {"tracker": {"flow": 1.5}, "mvs": {}}, "cpu": {"tracker": 2}},
        "memory": {"peak_bytes": {"tracker": 5}},
        "skipped": {"tracker": {"frames": 2}},
        "counts": {"tracker": {"frames": 60}},
        "warnings": {"tracker": ["w"]},
        "nothing": {"tracker": "too little motion"},
    }


def test_latencies_and_what_was_overtaken_are_shown() -> None:
    figures = {"median": 0.02, "p99": 0.08, "count": 7}
    tracker = {"values": {"latency": {"frame to pose": figures}}, "best_effort_skipped": {"dataset.Frame": 3, "x.Y": 0}}
    found = collected({"tracker": tracker, "mvs": {"values": {}}})
    assert found["latency"] == {"tracker": {"frame to pose": figures}}
    assert found["skipped"] == {"tracker": {"overtaken by a newer dataset.Frame": 3}}
    for odd in (None, 7, "text", ["a"]):
        assert "latency" not in collected({"tracker": {"values": {"latency": odd}}})
    assert collected({"tracker": {"values": {"latency": {"x": 7}}}})["latency"] == {"tracker": {"x": {}}}


def test_a_string_of_warnings_is_one_warning() -> None:
    assert collected({"mapper": {"warnings": "(5000 entries left out)"}})["warnings"] == {
        "mapper": ["(5000 entries left out)"]
    }


@pytest.mark.parametrize("odd", [None, 7, math.nan, "text", ["a"], {"b": []}, {"c": math.inf}, {"d": True}, []])
def test_whatever_a_node_says_of_itself_does_not_end_the_report(odd: Any) -> None:
    keys = ("seconds", "cpu_seconds", "peak_bytes", "skipped", "counts", "warnings", "values")
    found = collected({"node": dict.fromkeys(keys, odd), "other": odd})
    assert all(not numbers for numbers in found["time"]["stages"].values())
    assert found["skipped"] == found["counts"] == {}
    assert "nothing" not in found
    assert all(isinstance(text, str) for texts in found["warnings"].values() for text in texts)
    assert all(math.isfinite(value) for value in found["memory"]["peak_bytes"].values())
