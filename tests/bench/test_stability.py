"""The stability benchmark says what a pass looked at."""

from __future__ import annotations

from bench.stability import box_view, mapped
from mvsgs_core.mapping.config import MapperConfig


def test_a_pass_says_whether_quality_was_judged() -> None:
    views = [box_view(k, 0.2 * k) for k in range(2)]
    config = MapperConfig(iterations=2, threads=1, device="cpu")
    finite = mapped("finite", views, config)
    assert finite.met
    assert "quality not judged" in finite.goal
    bad = mapped("bad", views, config, minimum=60.0)
    assert bad.met is False
    assert ">= 60 dB" in bad.goal
