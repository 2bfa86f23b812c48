"""Both pages against WCAG 2.1 AA, as far as axe-core can tell."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from web_browser import Browser, browser
from web_drawing import Hand, served, small_scene
from web_moments import harbour

from sightline.web.server import LiveServer

pytestmark = pytest.mark.slow

TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]


CANDIDATES = {
    "state": "done",
    "doing": "",
    "share": None,
    "reason": "",
    "feed": False,
    "others": 0.2,
    "candidates": [
        {
            "number": i,
            "explanation": i,
            "vessel": f"boat {i}",
            "probability": 0.4,
            "evidence": 3.0,
            "match": 7.0,
            "clock_offset_s": 0.2,
            "seen": 20,
            "sources": ["harbour"],
            "boxes": [{"frame": 1, "box_px": [4.0, 5.0, 20.0, 30.0], "place_px": [12.0, 30.0]}],
        }
        for i in range(2)
    ],
}
"""Two candidates, as the server tells them."""


@pytest.fixture(scope="module")
def axe() -> str:
    """The source of axe-core; the tests are skipped where there is none."""
    root = Path(__file__).parents[2]
    named = os.environ.get("SIGHTLINE_AXE")
    path = Path(named) if named else root / "node_modules" / "axe-core" / "axe.min.js"
    if not path.is_file():
        pytest.skip(f"no axe-core: {path} does not exist; set SIGHTLINE_AXE to its axe.min.js")
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser")) as one:
        yield one


def violations(page: Browser, axe: str) -> list[str]:
    page.evaluate(f"{axe};0")
    told = page.evaluate(
        f"axe.run(document, {{runOnly: {json.dumps(TAGS)}}}).then(found => JSON.stringify("
        "[found.passes.length, found.violations.map(one => [one.id, one.help,"
        " one.nodes.map(node => node.html.slice(0, 120))])]))"
    )
    passed, found = json.loads(told)
    assert passed > 10
    return [json.dumps(one) for one in found]


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (844, 390), (390, 844)])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_the_live_page(theme: str, width: int, height: int, page: Browser, axe: str) -> None:
    server = LiveServer("127.0.0.1:0", health=lambda: {"state": "ok", "frames_seen": 17})
    server.start()
    try:
        page.size(width, height, mobile=width < 1000)
        server.publish(harbour(0.0))
        page.open(server.url)
        page.until("document.querySelectorAll('#targets tr').length === 8")
        page.evaluate("sightline.choose(100)")
        while page.evaluate("document.documentElement.dataset.theme") != theme:
            page.press("d")
        assert violations(page, axe) == []
    finally:
        server.close()


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (844, 390), (390, 844)])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_the_page_of_drawing(
    theme: str, width: int, height: int, page: Browser, axe: str, tmp_path: Path
) -> None:
    with served(small_scene(tmp_path)) as server:
        page.size(width, height, mobile=width < 1000)
        page.open(server.url)
        page.until("sightline.state.shown")
        while page.evaluate("document.documentElement.dataset.theme") != theme:
            page.press("d")
        page.press("b")
        Hand(page).accept()
        page.press("b")
        assert violations(page, axe) == []
        page.press("?")
        page.until("document.getElementById('help').open")
        assert violations(page, axe) == []
        page.press("Escape")
        page.until("!document.getElementById('help').open")
        page.press("c")
        page.until("!document.getElementById('points-section').hidden")
        assert violations(page, axe) == []
        page.press("v")
        page.until("!document.getElementById('check-section').hidden")
        page.until("document.getElementById('check-model').textContent !== ''")
        assert violations(page, axe) == []
        page.press("l")
        page.until("document.getElementById('whose-state').textContent !== ''")
        page.evaluate(f"sightline.whose.take({json.dumps(CANDIDATES)})")
        assert violations(page, axe) == []


def test_a_violation_is_found(page: Browser, axe: str, tmp_path: Path) -> None:
    """Else nothing would be said of a page on which nothing was looked at."""
    with served(small_scene(tmp_path)) as server:
        page.size(1400, 900)
        page.open(server.url)
        page.until("sightline.state.shown")
        page.evaluate("document.getElementById('next').removeAttribute('aria-label')")
        page.evaluate("document.getElementById('next').removeAttribute('title')")
        page.evaluate("document.getElementById('next').textContent = ''")
        assert "button-name" in "".join(violations(page, axe))
