"""The page in a real browser, beside what was published."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from web_browser import Browser, browser
from web_moments import HOSTILE, PLANE, SIZE_PX, START, harbour, moment, target, until

from sightline.moment import Moment
from sightline.types import ellipses
from sightline.web.pages import STATIC
from sightline.web.server import LiveServer

OWN = sorted(
    path for path in STATIC.iterdir() if path.suffix != ".txt" and "maplibre" not in path.name
)


HEALTH = {
    "state": "ok",
    "frames_seen": 17,
    "frames_per_s": 12.5,
    "age_s": 0.084,
    "kept_utc_s": START,
}


def picture() -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (640, 360), (90, 110, 120)).save(buffer, "JPEG")
    return buffer.getvalue()


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.name)
def test_the_page_names_no_other_place_and_makes_no_markup_of_text(path: Path) -> None:
    text = path.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"https?:|[\"'(]//", text)
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(", text)
    assert not re.search(r"<[^>]+\s(?:on\w+|style)=|<script>|<style|javascript:", text)


def test_the_licence_of_the_map_comes_with_it() -> None:
    licence = (STATIC / "maplibre-gl-LICENSE.txt").read_text(encoding="utf-8")
    assert "MapLibre contributors" in licence
    assert "Redistribution and use in source and binary forms" in licence


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LiveServer, Browser]]:
    """A server with the harbour, and a browser that shows its page."""
    folder = tmp_path_factory.mktemp("page")
    server = LiveServer("127.0.0.1:0", health=lambda: HEALTH, picture=picture)
    server.start()
    for i in range(30):
        server.publish(harbour(2.0 * i - 60.0))
    try:
        with browser(folder) as made:
            made.size(1400, 900)
            made.open(server.url)
            yield server, made
    finally:
        server.close()


def show(server: LiveServer, page: Browser, one: Moment) -> None:
    """Publish a moment, and wait until it is on the map."""
    server.publish(one)
    time = json.loads(one.text)["time_utc"]
    page.until(f"sightline.state.moment?.time_utc === {time!r} && sightline.state.drawn")
    page.until("sightline.chart.map.areTilesLoaded()")


def drawn(page: Browser, layer: str) -> dict[int, dict]:
    """What is on the screen: the features of a layer by their number."""
    found = page.evaluate(
        f"sightline.chart.map.queryRenderedFeatures({{layers: ['{layer}']}})"
        ".map(one => ({id: one.properties.id, properties: one.properties,"
        " geometry: one.geometry}))"
    )
    return {one["id"]: one for one in found}


@pytest.mark.slow
def test_targets_are_on_the_map_where_they_are(shown: tuple[LiveServer, Browser]) -> None:
    server, page = shown
    one = harbour(0.0)
    show(server, page, one)
    page.evaluate("sightline.chart.fit(sightline.state.moment.targets, false)")
    page.until("sightline.chart.map.areTilesLoaded() && !sightline.chart.map.isMoving()")
    until(lambda: len(drawn(page, "targets")) == len(one.targets))
    points = drawn(page, "targets")
    for each in one.targets:
        east, north = PLANE.to_plane(*reversed(points[each.id]["geometry"]["coordinates"]))
        true = PLANE.to_plane(each.latitude_deg, each.longitude_deg)
        # Tiles have 8192 steps a side, which is a matter of centimetres here.
        assert math.hypot(east - true[0], north - true[1]) < 0.5
    kinds = {number: point["properties"]["kind"] for number, point in points.items()}
    assert kinds[100] == "identified"
    assert kinds[102] == "unidentified"
    assert kinds[103] == "moored"


@pytest.mark.slow
def test_ellipses_on_the_map_are_those_of_the_covariance(
    shown: tuple[LiveServer, Browser],
) -> None:
    """The source's rings as the map has them, against eigenvalues by another library."""
    server, page = shown
    one = harbour(1.0)
    show(server, page, one)
    rings = page.evaluate(
        "import('/static/geometry.mjs').then(geometry => Object.fromEntries("
        "sightline.state.moment.targets.map(one => [one.id, geometry.ellipseRing(one)])))"
    )
    for each in one.targets:
        corners = np.array(rings[str(each.id)])
        east, north = PLANE.to_plane(corners[:, 1], corners[:, 0])
        middle = PLANE.to_plane(each.latitude_deg, each.longitude_deg)
        apart = np.hypot(east - middle[0], north - middle[1])
        shape = ellipses(each.covariance_m2[None])
        assert apart.max() == pytest.approx(shape.semi_major_m[0], rel=1e-3)
        assert apart.min() == pytest.approx(shape.semi_minor_m[0], rel=1e-2)
        i = int(np.argmax(apart))
        bearing = math.degrees(math.atan2(east[i] - middle[0], north[i] - middle[1]))
        off = (bearing - shape.bearing_deg[0] + 90.0) % 180.0 - 90.0
        assert off == pytest.approx(0.0, abs=0.2)
    on_screen = drawn(page, "ellipses")
    assert set(on_screen) == {each.id for each in one.targets}
    for each in one.targets:
        ring = np.array(on_screen[each.id]["geometry"]["coordinates"][0])
        east, north = PLANE.to_plane(ring[:, 1], ring[:, 0])
        spread = np.hypot(east[:, None] - east, north[:, None] - north).max()
        assert spread == pytest.approx(
            2.0 * ellipses(each.covariance_m2[None]).semi_major_m[0], 0.03
        )


@pytest.mark.slow
def test_a_course_ends_where_the_target_will_be(shown: tuple[LiveServer, Browser]) -> None:
    server, page = shown
    one = moment(100.0, target(1, speed_mps=5.0, course_deg=120.0))
    show(server, page, one)
    end = page.evaluate(
        "import('/static/geometry.mjs').then(g => g.ahead(sightline.state.moment.targets[0], 60))"
    )
    start = PLANE.to_plane(54.3233, 10.1394)
    east, north = PLANE.to_plane(end[1], end[0])
    assert east - start[0] == pytest.approx(300.0 * math.sin(math.radians(120.0)), abs=0.05)
    assert north - start[1] == pytest.approx(300.0 * math.cos(math.radians(120.0)), abs=0.05)


@pytest.mark.slow
def test_a_target_is_picked_on_the_map_in_the_picture_and_in_the_list(
    shown: tuple[LiveServer, Browser],
) -> None:
    server, page = shown
    one = harbour(200.0)
    show(server, page, one)
    page.evaluate("sightline.chart.fit(sightline.state.moment.targets, false)")
    page.until("sightline.chart.map.areTilesLoaded() && !document.querySelector('figure').hidden")
    until(lambda: len(drawn(page, "targets")) == len(one.targets))

    def chosen() -> str:
        return page.evaluate("document.getElementById('chosen-title').textContent")

    # On the map.
    spot = page.evaluate(
        "(() => { const m = sightline.chart.map, t = sightline.state.moment.targets[2],"
        " p = m.project([t.longitude_deg, t.latitude_deg]),"
        " b = m.getCanvas().getBoundingClientRect(); return [b.x + p.x, b.y + p.y]; })()"
    )
    page.click(*spot)
    page.until("sightline.state.chosen === 102")
    assert chosen() == "target 102"
    # In the picture, which is half as wide as the frame and as wide as the page lets it be.
    x1, y1, x2, y2 = one.targets[4].box_xyxy_px
    frame = page.evaluate(
        "(() => { const b = document.getElementById('picture').getBoundingClientRect();"
        " return [b.x, b.y, b.width, b.height]; })()"
    )
    page.click(
        frame[0] + 0.5 * (x1 + x2) / SIZE_PX[0] * frame[2],
        frame[1] + 0.5 * (y1 + y2) / SIZE_PX[1] * frame[3],
    )
    page.until("sightline.state.chosen === 104")
    assert chosen() == "FÄHRE SCHWENTINE"
    # With the keyboard, in the list.
    page.evaluate("document.querySelector('#targets button').focus()")
    page.press("ArrowDown")
    assert page.evaluate("document.activeElement.textContent") == "LOTSE 4"
    page.evaluate("document.activeElement.click()")
    page.until("sightline.state.chosen === 101")
    assert chosen() == "LOTSE 4"
    page.press("Escape")
    page.until("document.getElementById('chosen-section').hidden")


@pytest.mark.slow
def test_speeds_and_times_are_shown_in_the_units_that_were_chosen(
    shown: tuple[LiveServer, Browser],
) -> None:
    server, page = shown
    show(server, page, moment(300.0, target(1, speed_mps=10.0)))
    speed = "document.querySelector('#targets td:nth-child(3)')?.textContent"
    # 10 m/s: 19.44 knots of 1852 m, 36 km/h.
    page.until(f"{speed} === '19.4'")
    page.press("u")
    page.until(f"{speed} === '36.0'")
    page.press("u")
    assert page.evaluate("document.getElementById('clock').textContent") == (
        "2024-06-01 10:05:00 UTC"
    )
    page.press("t")
    assert "local" in page.evaluate("document.getElementById('clock').textContent")
    page.press("t")
    for theme in ("light", "dark", "auto"):
        page.press("d")
        word = page.evaluate("document.getElementById('theme').textContent")
        assert word.lower() == theme


@pytest.mark.slow
def test_health_is_told(shown: tuple[LiveServer, Browser]) -> None:
    _, page = shown
    rows = page.until(
        "(terms => terms.length && Object.fromEntries(terms.map(one =>"
        " [one.textContent, one.nextElementSibling.textContent])))"
        "([...document.querySelectorAll('#health dt')])"
    )
    expected = {"frames seen": "17", "frames per s": "12.5", "age, s": "0.084"}
    assert (expected | {"kept": "2024-06-01 10:00:00 UTC"}).items() <= rows.items()
    assert page.evaluate("document.getElementById('health-state').textContent") == "All is well."


@pytest.mark.slow
def test_a_hostile_name_stays_text_and_nothing_is_fetched_from_elsewhere(
    shown: tuple[LiveServer, Browser],
) -> None:
    server, page = shown
    tags = "[...document.querySelectorAll('*')].map(one => one.localName).sort().join()"
    show(server, page, moment(400.0, target(1, name="boat", mmsi=1)))
    page.evaluate("sightline.choose(1)")
    page.until("document.querySelectorAll('#targets tr').length === 1")
    before = page.evaluate(tags)
    show(server, page, moment(401.0, target(1, name=HOSTILE, mmsi=1), camera=HOSTILE))
    text = HOSTILE.replace("\u202e", "\ufffd")
    for place in ("#targets button", "#chosen-title", "#camera"):
        page.until(f"document.querySelector({place!r}).textContent === {json.dumps(text)}")
    assert page.evaluate(tags) == before
    assert page.evaluate("document.title") == f"{text} – sightline"
    until(lambda: 1 in drawn(page, "targets"))
    assert drawn(page, "targets")[1]["properties"]["title"] == text
    own = re.compile(rf"(?:http|ws)://127\.0\.0\.1:{server._port}/|data:|blob:|about:")
    assert [url for url in page.requests if not own.match(url)] == []
    assert not any("owned" in url for url in page.requests)
    assert page.complaints == []


@pytest.mark.slow
def test_a_telephone_shows_all_without_scrolling_sideways(
    shown: tuple[LiveServer, Browser],
) -> None:
    server, page = shown
    page.size(390, 844, mobile=True)
    show(server, page, harbour(500.0))
    page.until("document.querySelectorAll('#targets tr').length === 8")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    narrow = page.evaluate(
        "[...document.querySelectorAll('button')].filter(one => one.offsetParent)"
        ".every(one => one.getBoundingClientRect().height >= 28)"
    )
    assert narrow
    page.size(1400, 900)


@pytest.mark.slow
def test_a_server_that_returns_is_found_again(tmp_path: Path) -> None:
    first = LiveServer("127.0.0.1:0")
    first.start()
    first.publish(moment(0.0))
    with browser(tmp_path) as page:
        page.open(first.url)
        page.until("document.getElementById('status').textContent === 'live'")
        first.close()
        page.until("document.getElementById('status').dataset.state === 'lost'")
        second = LiveServer(f"127.0.0.1:{first._port}")
        second.start()
        second.publish(moment(60.0, target(1), target(2)))
        page.until("document.querySelectorAll('#targets tr').length === 2")
        second.close()
    assert first.hub.newest.time_utc_s == START
