"""The report in a browser: on a telephone and a desk, by day and by night, with nothing fetched."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from nodes.evaluator import Evaluator
from tests.support.chromium import Browser, browser
from tests.support.evaluated_wall import feed, wall_evaluator

WIDE = "[...document.querySelectorAll('table')].filter(t => t.scrollWidth > t.clientWidth + 1).map(t => t.innerText)"
LONG = "/a/folder/whose/name/is/so/long/that/it/must/be/broken/somewhere/" * 2


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("report")
    node = wall_evaluator(folder)
    upstream = {
        "mapper": {
            "skipped": {"splats_unseen": 1234, "wool_gathered": 7},
            "peak_bytes": 3e8,
            "warnings": [f"full: {LONG}"],
        },
        "tracker": {"warnings": ["lost for 3 frames"], "best_effort_skipped": {"dataset.Frame": 3}},
    }
    node.evaluation.given = {"lpips": lambda render, photograph: float(np.abs(render - photograph).mean())}
    feed(node, upstream=upstream)
    return (folder / "report.html").as_uri()


@pytest.fixture(scope="module")
def page() -> Iterator[Browser]:
    with browser() as opened:
        yield opened


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1400])
def test_everything_is_within_the_screen(page: Browser, report: str, width: int) -> None:
    page.size(width, 900)
    page.open(report)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(WIDE) == []
    assert page.errors == []
    assert {address for address in page.requests if not address.startswith("data:")} <= {report, "about:blank"}


@pytest.mark.slow
def test_a_picture_is_enlarged_by_a_click_and_by_the_keyboard(page: Browser, report: str) -> None:
    page.size(1400, 900)
    page.open(report)
    width = "document.querySelector('.pictures img').clientWidth"
    before = page.evaluate(width)
    x, y = page.evaluate(
        "(() => { const i = document.querySelector('.pictures img'); i.scrollIntoView({block: 'center'});"
        "const b = i.getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]; })()"
    )
    page.click(x, y)
    assert page.evaluate(width) > 3 * before
    page.evaluate("document.querySelector('.pictures img').focus()")
    page.call("Input.dispatchKeyEvent", type="keyDown", key="Enter", code="Enter", windowsVirtualKeyCode=13)
    assert page.evaluate(width) == before


@pytest.mark.slow
def test_by_night_it_is_light_on_dark(page: Browser, report: str) -> None:
    seen = {}
    for dark in (False, True):
        page.size(1400, 900, dark)
        page.open(report)
        picture = page.screenshot()
        seen[dark] = float(np.median(picture)), page.evaluate("getComputedStyle(document.querySelector('.plot')).fill")
    assert seen[False] == (255.0, "rgb(0, 0, 0)")
    assert seen[True][0] < 40
    assert seen[True][1] == "rgb(255, 255, 255)"


@pytest.mark.slow
def test_what_it_says(page: Browser, report: str) -> None:
    page.open(report)
    text = page.evaluate("document.body.innerText")
    assert text.index("tracker: lost for 3 frames") < text.index("mapper: full")
    for said in (
        "splats that a view does not see: not stepped by it", "mapper: wool gathered",
        "messages Frame of dataset that a newer one overtook", "right of the first view, unit of the true poses",
        "PSNR along the path", "Coverage along the path", "Error of the position by frame",
        "rendered depth, the map's unit",
    ):  # fmt: skip
        assert said in text, said
    assert page.evaluate("document.querySelectorAll('.scale').length") >= 2


@pytest.mark.parametrize(
    ("given", "title"),
    [
        ("video /data/a walk/over the hill.mp4", "video over the hill.mp4"),
        ("/data/recording.mcap", "recording.mcap"),
        ("camera rtsp://host/2", "camera rtsp://host/2"),
        ("tum ../walk", "tum ../walk"),
    ],
)
def test_the_title_has_the_inputs_name_and_the_table_where_it_is(given: str, title: str, tmp_path: Path) -> None:
    list(Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off", input=given)).on_end())
    document = (tmp_path / "report.html").read_text()
    assert f": {title}</h1>" in document
    assert f"<td>input</td><td>{given}</td>" in document
