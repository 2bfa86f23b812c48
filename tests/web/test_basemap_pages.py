"""The user's basemap, and the picture on the map, on the pages."""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image
from web_browser import Browser, browser
from web_drawing import served, small_scene
from web_moments import harbour

from sightline import Georeferencer
from sightline.camera.pinhole import Camera
from sightline.cli import main
from sightline.errors import InputError
from sightline.formats.tiles import open_tiles
from sightline.geodesy import LocalPlane
from sightline.live.on_the_map import Newest, PictureOnMap
from sightline.web.app import build_app
from sightline.web.server import LiveServer

SIZE = (640, 360)


def picture(colour: tuple[int, int, int]) -> bytes:
    made = io.BytesIO()
    Image.new("RGB", (256, 256), colour).save(made, "PNG")
    return made.getvalue()


@pytest.fixture
def tiles(tmp_path: Path) -> Path:
    """Red tiles everywhere to zoom 1, and one that is no picture."""
    path = tmp_path / "chart.mbtiles"
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE metadata (name text, value text)")
        base.execute(
            "CREATE TABLE tiles (zoom_level int, tile_column int, tile_row int, tile_data blob)"
        )
        base.execute("INSERT INTO metadata VALUES ('format', 'png')")
        base.execute("INSERT INTO metadata VALUES ('attribution', '<i>Chart</i> office')")
        rows = [(0, 0, 0, picture((200, 0, 0)))]
        rows += [(1, x, y, picture((200, 0, 0))) for x in range(2) for y in range(2)]
        rows[1] = (1, 0, 0, b"<svg onload=alert(1)>")
        base.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", rows)
    base.close()
    return path


class Static:
    """What the map asks of a model: a level camera 5 m above the water that looks north."""

    camera = Camera(5.0, 0.0, 0.0, 0.0, 900.0, 0.0, 0.0, 0.0, 0.0, SIZE)
    moving = False
    plane = LocalPlane(54.3233, 10.1394)

    def above_m(self, water_level_m: float | None) -> np.ndarray:
        assert water_level_m is None
        return np.zeros(())


def on_the_map(rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PictureOnMap:
    image = np.full((360, 640, 3), (0, 200, 0), dtype=np.uint8)
    return PictureOnMap(
        cast(Georeferencer, Static()), lambda: Newest(image, np.array(rotation, dtype=float))
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser")) as one:
        one.size(1400, 900)
        yield one


def test_tiles_are_served_and_what_is_none_is_refused(tiles: Path) -> None:
    server = LiveServer("127.0.0.1:0", basemap=tiles)
    client = TestClient(build_app(server.hub))
    about = client.get("/api/about").json()["basemap"]
    assert (about["kind"], about["zooms"]) == ("raster", [0, 1])
    assert about["attribution"] == "Chart office"
    answer = client.get("/basemap/1/1/0")
    assert answer.headers["content-type"] == "image/png"
    assert answer.content == picture((200, 0, 0))
    refused = client.get("/basemap/1/0/1")
    assert refused.status_code == 422
    assert "is no PNG, JPEG or WebP" in refused.json()["reason"]
    # Where the file has none there is a picture of nothing.
    empty = Image.open(io.BytesIO(client.get("/basemap/5/3/3").content)).convert("RGBA")
    assert empty.getpixel((0, 0))[3] == 0
    for path in ("1/2/0", "25/0/0", "-1/0/0", "1/0/x", "1/0/0/../../../etc/passwd"):
        assert client.get(f"/basemap/{path}").status_code in (404, 422)
    bare = TestClient(build_app(LiveServer("127.0.0.1:0").hub))
    assert bare.get("/api/about").json()["basemap"] is None
    assert bare.get("/basemap/0/0/0").status_code == 404


def test_the_newest_picture_lies_on_the_map() -> None:
    server = LiveServer("127.0.0.1:0")
    client = TestClient(build_app(server.hub))
    assert client.get("/api/about").json()["on_the_map"] is False
    assert client.get("/rectified.webp").status_code == 404
    assert client.get("/api/rectified").status_code == 404
    server.hub.on_the_map = on_the_map()
    assert client.get("/api/about").json()["on_the_map"] is True
    told = client.get("/api/rectified").json()
    assert told["furthest_m"] == pytest.approx(450.0, rel=0.01)
    seen = np.asarray(Image.open(io.BytesIO(client.get("/rectified.webp").content)))
    # In its middle column, half way up, it shows the water; beside the camera nothing.
    assert np.abs(seen[400, seen.shape[1] // 2].astype(int) - (0, 200, 0, 255)).max() < 12
    assert seen[-1, 0, 3] == 0
    # A camera that was turned to the left since shows what lies further to the left.
    server.hub.on_the_map = on_the_map((0.0, np.radians(10.0), 0.0))
    turned = client.get("/api/rectified").json()
    assert turned["corners_deg"][0][1] < told["corners_deg"][0][1]


@pytest.mark.slow
def test_both_are_seen_on_the_live_page_by_keys(tiles: Path, page: Browser, tmp_path: Path) -> None:
    server = LiveServer("127.0.0.1:0", basemap=tiles)
    server.hub.on_the_map = on_the_map()
    server.start()
    try:
        server.publish(harbour(0.0))
        page.open_anew(server.url)
        page.until("!document.getElementById('on-map').hidden")
        page.until("sightline.chart.map.isSourceLoaded('tiles')")
        assert page.evaluate("document.querySelector('.attribution').textContent") == "Chart office"
        assert not any("rectified" in url for url in page.requests)
        for _ in range(8):
            page.press("o")
        page.until("Boolean(sightline.chart.map.getSource('picture'))")
        page.until("sightline.chart.map.areTilesLoaded()")
        opacity = "sightline.chart.map.getPaintProperty('picture', 'raster-opacity')"
        assert page.evaluate(opacity) == pytest.approx(0.8)
        page.press("O")
        assert page.evaluate(opacity) == pytest.approx(0.7)
        # Beneath all else: the tiles, and the picture above them.
        order = page.evaluate("sightline.chart.map.getStyle().layers.map(one => one.id)")
        assert order.index("tiles") < order.index("picture") < order.index("targets")
        page.evaluate(
            "new Promise(done => { sightline.chart.map.once('idle', () => done(true));"
            " sightline.chart.map.jumpTo({center: [10.1394, 54.325], zoom: 15}); })"
        )
        page.screenshot(tmp_path / "page.png")
        shot = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)
        red = (shot[..., 0] - shot[..., 1:3].max(axis=2)) > 100
        green = (shot[..., 1] - shot[..., [0, 2]].max(axis=2)) > 60
        assert red.mean() > 0.1
        assert green.sum() > 100
        assert page.complaints == []
        page.size(390, 844, mobile=True)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
    finally:
        server.close()
        page.size(1400, 900)


@pytest.mark.slow
def test_the_map_of_control_points_has_the_basemap(
    tiles: Path, page: Browser, tmp_path: Path
) -> None:
    (tmp_path / "scene").mkdir()
    with served(small_scene(tmp_path / "scene"), tiles=open_tiles(tiles)) as server:
        page.open_anew(server.url)
        page.until("sightline.state.shown")
        page.press("c")
        page.until("Boolean(sightline.points.map?.map.getSource('tiles'))")
        page.until("sightline.points.map.map.isSourceLoaded('tiles')")
        assert any("/basemap/" in url for url in page.requests)
        assert page.complaints == []


@pytest.mark.parametrize("text", [b"", b"a map", b"PMTiles\x03", b"SQLite format 3\0 and no more"])
def test_a_basemap_that_is_none_is_refused_in_a_line(
    text: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "chart.mbtiles"
    path.write_bytes(text)
    with pytest.raises(InputError):
        LiveServer("127.0.0.1:0", basemap=path)
    scene = small_scene(tmp_path)
    arguments = ["draw", str(scene), "--serve", "127.0.0.1:0", "--no-browser"]
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--basemap", str(path)])
    assert ended.value.code == 2
    said = capsys.readouterr().err.strip()
    assert str(path) in said.replace("\n", "")
