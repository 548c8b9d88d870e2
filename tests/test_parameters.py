"""A node's parameters from plain values, and what a runner checks and counts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest

from msgs import End, Frame, Keyframe
from msgs.codec import decode, encode
from mvsgs_core.setting_ranges import LARGEST, UNBOUNDED
from nodes import Node
from nodes.parameters import ParameterError, build, parameters, plain_values
from nodes.runtime.plain import plain
from nodes.runtime.runner import Runner, merge_stats, own_stats
from tests.support.sample_nodes import Left, Wrong


class Color(Enum):
    RED = "r"
    BLUE = "b"


@dataclass
class Inner:
    weight: float = 0.5
    count: int = 1


class Sample(Node):
    @dataclass
    class Config:
        required: int
        ratio: float = 1.0
        name: str | None = None
        path: Path = Path("x")
        size: tuple[int, int] | None = None
        names: list[str] = field(default_factory=list)
        many: tuple[float, ...] = ()
        mode: Literal["fast", "slow"] = "fast"
        color: Color = Color.RED
        inner: Inner = field(default_factory=Inner)
        parts: tuple[Inner, ...] = ()
        options: dict[str, Any] = field(default_factory=dict)
        limits: dict[str, float] = field(default_factory=dict)
        number: int | float = 0
        flag: bool = False
        reach: float = math.inf
        span: tuple[float, float] = (0.0, math.inf)
        total: int = 2**40
        far: Annotated[float, UNBOUNDED] = 1.0


def test_plain_values_become_what_the_annotations_say() -> None:
    config = build(
        Sample.Config,
        {
            "required": 3,
            "ratio": 2,
            "name": None,
            "path": "a/b",
            "size": [4, 5],
            "names": ["u"],
            "many": [1, 2.5],
            "mode": "slow",
            "color": "BLUE",
            "inner": {"weight": 1},
            "parts": [{"weight": 2}, {}],
            "options": {"any": [1, None]},
            "limits": {"a": 1},
            "number": 3,
            "flag": True,
        },
    )
    assert config == Sample.Config(
        3, 2.0, None, Path("a/b"), (4, 5), ["u"], (1.0, 2.5), "slow", Color.BLUE, Inner(1.0), (Inner(2.0), Inner()),
        {"any": [1, None]}, {"a": 1.0}, 3, True,
    )  # fmt: skip
    assert build(Sample.Config, json.loads(json.dumps(plain_values(config)))) == config  # and back
    assert isinstance(config.number, int)
    assert isinstance(config.limits["a"], float)


@pytest.mark.parametrize(
    ("given", "error"),
    [
        ({}, "sample.required must be given: tests.test_parameters.Sample has no default for it (int)"),
        ({"required": 1, "requird": 1}, "sample.requird: tests.test_parameters.Sample has no parameter 'requird'"),
        ({"required": 1, "requird": 1}, "(did you mean required?); it has: required: int (must be given), "),
        ({"required": 1.5}, "sample.required=1.5: must be int"),
        ({"required": True}, "sample.required=True: must be int"),
        ({"required": 1, "flag": 1}, "sample.flag=1: must be bool"),
        ({"required": 1, "size": [1, 2, 3]}, "sample.size=[1, 2, 3]: must be [int, int] or null"),
        ({"required": 1, "size": [1, "a"]}, "sample.size"),
        ({"required": 1, "names": "abc"}, "sample.names=abc: must be [str]"),
        ({"required": 1, "mode": "medium"}, "sample.mode=medium: must be 'fast' or 'slow'"),
        ({"required": 1, "color": "GREEN"}, "sample.color=GREEN: must be RED or BLUE"),
        ({"required": 1, "inner": {"wait": 1}}, "sample.inner.wait: tests.test_parameters.Inner has no parameter"),
        ({"required": 1, "inner": {"wait": 1}}, "(did you mean weight?)"),
        ({"required": 1, "weight": 1}, "(did you mean sample.inner.weight?)"),
        ({"required": 1, "inner": 3}, "sample.inner=3: must be {weight, count}"),
        ({"required": 1, "inner": {"weight": "x"}}, "sample.inner.weight=x: must be float"),
        ({"required": 1, "parts": [{"weight": "x"}]}, "sample.parts[0].weight=x: must be float"),
        ({"required": 1, "limits": {"a": "b"}}, "sample.limits.a=b: must be float"),
        ({"required": 1, "ratio": float("nan")}, "sample.ratio=nan: not a number, must be float"),
        ({"required": 1, "many": [1.0, float("nan")]}, "sample.many[1]=nan: not a number, must be float"),
        ({"required": 1, "ratio": math.inf}, "sample.ratio=inf: not finite, must be float"),
        ({"required": 1, "ratio": 10**400}, ": beyond 4294967295, must be float"),
        ({"required": 1, "limits": {"a": -math.inf}}, "sample.limits.a=-inf: not finite, must be float"),
        ({"required": LARGEST + 1}, "sample.required=4294967296: beyond 4294967295, must be int"),
        ({"required": 1, "far": math.nan}, "sample.far=nan: not a number, must be float"),
    ],
)
def test_what_does_not_fit_is_named(given: dict[str, Any], error: str) -> None:
    with pytest.raises(ParameterError) as caught:
        build(Sample.Config, given, "sample")
    assert error in str(caught.value)


def test_what_is_as_large_by_default_or_says_so_may_be() -> None:
    config = build(Sample.Config, {"required": 1, "reach": math.inf, "span": [0, math.inf], "far": -math.inf})
    assert (config.reach, config.span, config.far) == (math.inf, (0.0, math.inf), -math.inf)
    assert build(Sample.Config, {"required": LARGEST, "total": 2**41}).total == 2**41
    assert build(Sample.Config, {"required": 1, "ratio": 1e300}).ratio == 1e300


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=lambda: Inner(0.25, 3))

    def __post_init__(self) -> None:
        if self.inner.weight < 0:
            raise ValueError("the weight is negative")
        if self.inner.count < 0:
            raise ValueError(f"inner={self.inner.count}: must be 0 or more")


def test_what_is_given_in_part_keeps_its_parent_s_default_for_the_rest() -> None:
    assert build(Outer, {"inner": {"count": 5}}) == Outer(Inner(0.25, 5))
    assert [parameter.default for parameter in parameters(Outer)] == [0.25, 3]


def test_what_a_dataclass_refuses_itself_is_refused_with_its_path() -> None:
    with pytest.raises(ParameterError, match=r"^outer: the weight is negative$"):
        build(Outer, {"inner": {"weight": -1.0}}, "outer")
    with pytest.raises(ParameterError, match=r"^outer\.inner=-1: must be 0 or more$"):
        build(Outer, {"inner": {"count": -1}}, "outer")


def test_every_parameter_has_a_path_down_to_the_innermost() -> None:
    paths = [parameter.path for parameter in parameters(Sample.Config, "sample")]
    assert paths[0] == "sample.required"
    assert "sample.inner.weight" in paths
    assert "sample.inner" not in paths


def frame() -> Frame:
    return Frame(1, 0.5, np.zeros((4, 4, 3), np.uint8), np.ones(4))


def test_a_runner_gives_what_the_hook_yields_and_counts_it() -> None:
    runner = Runner("left", Left())
    (keyframe,) = runner.handle(frame())
    assert isinstance(keyframe, Keyframe)
    assert runner.sent == {"Keyframe": 1}
    assert runner.busy_seconds > 0
    assert list(runner.end()) == []
    assert runner.idle() is None


def test_a_runner_refuses_what_a_node_did_not_declare() -> None:
    with pytest.raises(TypeError, match="Wrong yields a Frame, but its annotations say Keyframe"):
        list(Runner("wrong", Wrong()).handle(frame()))


def test_a_runner_says_how_a_message_is_returned() -> None:
    class Returning(Node):
        def on_frame(self, frame: Frame) -> Iterator[Frame]:
            return frame  # type: ignore[return-value]

    with pytest.raises(TypeError, match="Returning returns a Frame: a node yields its messages, or returns a list of"):
        list(Runner("returning", Returning()).handle(frame()))


def test_a_runner_refuses_frames_that_are_not_numbered_upward() -> None:
    class Numbered(Node):
        indices = (0, 3)

        def run(self) -> Iterator[Frame]:
            for index in self.indices:
                yield replace(frame(), index=index)

    node = Numbered()
    runner = Runner("camera", node)
    assert len(list(runner.source())) == 2
    for wrong in (3, 1):
        node.indices = (wrong, 4)  # begun again, as a program's source is
        with pytest.raises(ValueError, match=f"Numbered yields Frame {wrong} after Frame 3: a source's frames are"):
            list(runner.source())


def test_a_runner_refuses_a_node_that_was_not_made_as_one() -> None:
    class Unmade(Left):
        def __init__(self, config: Any = None) -> None:
            self.config = config

    with pytest.raises(TypeError, match=r"^Unmade\.__init__ must call super\(\).__init__\(config\)"):
        Runner("left", Unmade())


def test_ends_of_a_diamond_are_merged_by_node() -> None:
    runner = Runner("left", Left())
    for branch in ("b", "c"):
        news = {"a": {"counts": {"x": 1}}, branch: {"counts": {}}}
        assert list(runner.handle(End(news))) == []
    assert runner.node.upstream == {"a": {"counts": {"x": 1}}, "b": {"counts": {}}, "c": {"counts": {}}}


def test_any_statistics_can_be_sent() -> None:
    class Odd(Node):
        def on_frame(self, message: Frame) -> Iterator[Keyframe]:
            yield from ()

    node = Odd()
    node.stats.count("n", np.int64(3))
    node.stats.values |= {
        "array": np.arange(3),
        "nan": float("nan"),
        "path": Path("a"),
        "color": Color.RED,
        "huge": 2**70,
        "keys": {1: 2},
        "long": list(range(10_000)),
        "deep": [[[[[[[[[1]]]]]]]]],
    }
    stats = own_stats(node, wall_seconds=np.float32(1.5))
    decoded = decode(encode(End(merge_stats({}, {"odd": stats})))).message.stats["odd"]
    assert decoded["counts"] == {"n": 3}
    assert decoded["wall_seconds"] == 1.5
    values = decoded["values"]
    assert values["array"] == [0, 1, 2]
    assert values["path"] == "a"
    assert values["keys"] == {"1": 2}
    assert values["huge"] == float(2**70)
    assert values["long"] == "(10000 entries left out)"
    assert "left out" in str(values["deep"])
    assert plain({"a": (1, {2})}) == {"a": [1, [2]]}
