"""End can always be encoded, whatever the nodes of the graph keep in their statistics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from msgs import End
from msgs.codec import decode, encode
from mvsgs_core.stats import Stats
from nodes import Node
from nodes.runtime.plain import SHORTENED
from nodes.runtime.process import _say_cut_off
from nodes.runtime.runner import STATS_KEYS, end_of


class Counting(Node):
    @dataclass
    class Config:
        pass


def sent(node: Node, name: str = "node") -> dict[str, Any]:
    """What arrives downstream."""
    message = decode(encode(end_of(name, node, wall_seconds=1.0))).message
    assert isinstance(message, End)
    return dict(message.stats)


def types(stats: dict[str, Any]) -> None:
    for key in STATS_KEYS:
        assert isinstance(stats[key], list if key == "warnings" else dict), key
    assert all(type(text) is str for text in stats["warnings"])


def test_a_text_of_60000_nuls_and_forty_more_of_them() -> None:
    node = Counting()
    for i in range(40):
        node.stats.warn(f"FusedKeyframe.image must be uint8, not {i}" + "\x00" * 60_000)
        node.stats.warn("\ud800" * 60_000)
    stats = sent(node)["node"]
    types(stats)
    assert len(stats["warnings"]) == 41
    assert all(text.isprintable() for text in stats["warnings"])


def test_more_warnings_than_a_list_may_have_stay_a_list() -> None:
    node = Counting()
    for i in range(10_000):
        node.stats.warn(f"warning {i}")
    stats = sent(node)["node"]
    assert len(stats["warnings"]) == 101
    assert stats["warnings"][-1] == "and 9900 further warnings"
    node.stats.warnings = [f"assigned {i}" for i in range(5000)]  # type: ignore[assignment]
    assert sent(node)["node"]["warnings"][-1] == "and 4900 further warnings"


@pytest.mark.parametrize(
    "value",
    [
        10**400,
        "\ud800" * 100_000,
        np.zeros((3000, 3000)),
        [["x" * 1000] * 4000] * 4000,
        {("k" * 1000) + str(i): i for i in range(4000)},
        [[[[[[[[[[[[1]]]]]]]]]]]],
        b"\xff" * 100_000,
    ],
    ids=["integer", "surrogates", "array", "nested", "keys", "deep", "bytes"],
)
def test_no_value_is_too_much(value: Any) -> None:
    node = Counting()
    node.stats.values["odd"] = value
    node.stats.values["name"] = "kept"
    node.stats.count("frames", 7)
    stats = sent(node)["node"]
    types(stats)
    assert stats["counts"] == {"frames": 7}
    assert stats["wall_seconds"] == 1.0


@pytest.mark.slow
def test_a_whole_graph_that_is_too_much_loses_its_longest_texts_first() -> None:
    upstream: dict[str, Any] = {}
    for i in range(30):
        node = Counting()
        for j in range(100):
            node.stats.warn(f"{i} {j} " + "雪" * 480)
        node.stats.warn("short")
        node.stats.count("frames", i)
        node.upstream = upstream
        upstream = sent(node, f"node{i}")
    assert len(upstream) == 30
    for i, stats in enumerate(upstream.values()):
        types(stats)
        assert stats["counts"] == {"frames": i}
        assert stats["warnings"][0].startswith(f"{i} 0 雪")
    assert SHORTENED in upstream["node0"]["warnings"]


def test_counts_without_end_stay_counts() -> None:
    node = Counting()
    node.stats = Stats(counts={f"{'c' * 500}{i}": float(i) for i in range(20_000)})
    types(sent(node)["node"])


@pytest.mark.parametrize(
    ("frames", "expected", "said"),
    [(8, 24, " after 8 of 24 frames"), (8, 0, " after 8 frames"), (None, None, ""), (24, 24, None)],
)
def test_a_stream_that_was_cut_off_is_said_to_be(frames: int | None, expected: int | None, said: str | None) -> None:
    node = Counting(Counting.Config())
    if frames is not None:
        node.stats.count("frames", frames)
    node.stats.values["frames_expected"] = expected
    _say_cut_off(node)
    text = None if said is None else f"the stream was ended by Ctrl-C{said}"
    assert node.stats.values.get("cut_off") == text
    assert list(node.stats.warnings) == ([] if text is None else [text])
