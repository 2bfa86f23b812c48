"""The fit held against the picture: the log, the water, the clock and the map, by keys alone."""

from __future__ import annotations

import csv
import io
import json
import re
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image
from web_browser import Browser, browser
from web_drawing import Hand, harbour, served, small_scene, truth, undrawn

from sightline.geodesy import LocalPlane
from sightline.labelling.drawing import Drawing
from sightline.scene import Scene
from sightline.simulation import SimulatedCamera
from sightline.web.access import Guard
from sightline.web.draw_app import build_draw_app
from sightline.web.workbench import Workbench

pytestmark = pytest.mark.slow

ORIGIN = LocalPlane(54.3233, 10.1394)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return harbour(tmp_path_factory.mktemp("harbour"))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser")) as one:
        one.size(1400, 900)
        yield one


def drawn_scene(made: Path, folder: Path) -> tuple[Path, list[int]]:
    """The harbour with twenty boxes of the truth in its table."""
    true = truth(made)
    wide = [frame for frame, box in true.items() if box[0] > 1 and box[2] < 1279]
    frames = [wide[i] for i in np.linspace(0, len(wide) - 1, 20).astype(int)]
    scene = undrawn(made, folder, 'boxes = "boxes.csv"\n')
    rows = ["frame,x1,y1,x2,y2,annotator"]
    rows += [",".join(map(str, (frame, *true[frame], "ada"))) for frame in frames]
    (folder / "boxes.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return scene, frames


def true_pixel(made: Path, frame: int) -> np.ndarray:
    """Where the simulation's own projection has the boat's place on the water."""
    camera = json.loads((made / "truth.json").read_text(encoding="utf-8"))["camera"]
    left_out = ("latitude_deg", "longitude_deg", "image_size_px")
    true = SimulatedCamera(**{key: camera[key] for key in camera if key not in left_out})
    with (made / "truth.csv").open(encoding="utf-8") as file:
        row = [row for row in csv.DictReader(file) if row["target"] == "1"][frame]
    plane = LocalPlane(camera["latitude_deg"], camera["longitude_deg"])
    (east,), (north,) = plane.to_plane([float(row["latitude_deg"])], [float(row["longitude_deg"])])
    return np.asarray(true.project([east, north, 0.0]))


@pytest.fixture(scope="module")
def asked(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    scene, _ = drawn_scene(made, tmp_path_factory.mktemp("asked"))
    drawing = Drawing(scene, annotator="ada")
    assert drawing.wait()
    app = Guard(build_draw_app(Workbench(scene, drawing)), None, 8081)
    with TestClient(app, base_url="http://127.0.0.1:8081", follow_redirects=False) as client:
        yield client
    drawing.close()


def test_the_log_lies_where_the_boat_was(asked: TestClient, made: Path) -> None:
    true = truth(made)
    for frame in (60, 160, 250):
        told = asked.get(f"/api/fit/{frame}/log").json()
        now, *fixes = told["places"]
        assert (now["fix"], now["name"]) == (False, "target")
        # One of its ellipses is some 3 m, and a metre some ten pixels.
        width = true[frame][2] - true[frame][0]
        assert np.abs(np.subtract(now["pixel_px"], true_pixel(made, frame))).max() < 0.6 * width
        after = [one["after_s"] for one in fixes]
        assert after == sorted(after)
        assert all(one["fix"] for one in fixes)
        assert max(map(abs, after)) <= 30.0
        (outline,) = now["ellipse_px"]
        low, high = np.min(outline, axis=0), np.max(outline, axis=0)
        assert (low < now["pixel_px"]).all()
        assert (now["pixel_px"] < high).all()
    assert told["boxes"] == 20
    assert told["rmse_m"] < 4.0


def test_a_clock_that_is_off_moves_the_log_along_its_way(asked: TestClient, made: Path) -> None:
    """By so many seconds it is where the boat was so many seconds before."""
    own_s = asked.get("/api/fit").json()["clock_offset_s"]
    times = asked.get("/api/frames").json()["time_utc_s"]
    later_s = own_s + times[160] - times[140]
    late = asked.get("/api/fit/160/log", params={"clock_offset_s": later_s}).json()
    before = asked.get("/api/fit/140/log", params={"clock_offset_s": own_s}).json()
    assert late["places"][0]["place_deg"] == pytest.approx(
        before["places"][0]["place_deg"], abs=1e-6
    )
    right = asked.get("/api/fit/160/log").json()
    assert late["rmse_m"] > 2.0 * right["rmse_m"]
    away = asked.get("/api/fit/160/log", params={"clock_offset_s": 5000.0}).json()
    assert (away["places"], away["rmse_m"]) == ([], None)


def test_horizon_and_rings_are_those_of_the_true_camera(asked: TestClient, made: Path) -> None:
    water = asked.get("/api/fit/160/water").json()
    camera = json.loads((made / "truth.json").read_text(encoding="utf-8"))["camera"]
    left_out = ("latitude_deg", "longitude_deg", "image_size_px")
    true = SimulatedCamera(**{key: camera[key] for key in camera if key not in left_out})
    rings = {ring["radius_m"]: np.concatenate(ring["lines_px"]) for ring in water["rings"]}
    heading = np.radians(camera["heading_deg"])
    for radius_m in (50.0, 100.0):
        x, y = true.project([radius_m * np.sin(heading), radius_m * np.cos(heading), 0.0])
        ring = rings[radius_m]
        row = ring[np.argmin(np.abs(ring[:, 0] - x)), 1]
        assert row == pytest.approx(y, abs=4.0)
    assert water["grid_px"]
    assert water["spacing_m"] == 100.0
    far = 1e6 * np.array([np.sin(heading), np.cos(heading), 0.0])
    x, y = true.project(far)
    horizon = np.concatenate(water["horizon_px"])
    assert horizon[np.argmin(np.abs(horizon[:, 0] - x)), 1] == pytest.approx(y, abs=4.0)


def test_the_picture_on_the_map_is_clear_where_it_shows_nothing(asked: TestClient) -> None:
    told = asked.get("/api/fit/160/map").json()
    assert 200.0 < told["furthest_m"] < 1000.0
    answer = asked.get("/rectified/160.webp")
    assert answer.headers["content-type"] == "image/webp"
    picture = np.asarray(Image.open(io.BytesIO(answer.content)))
    assert picture.shape[2] == 4
    assert 0.2 < (picture[..., 3] > 0).mean() < 0.8
    near = asked.get("/api/fit/160/map", params={"reach_m": 100.0}).json()
    assert near["furthest_m"] == 100.0
    # Within the corners the camera's own place is at their edge, and all else before it.
    corners = np.array(told["corners_deg"])
    east, north = ORIGIN.to_plane(*corners.T)
    assert np.hypot(east, north).max() < 1.5 * told["furthest_m"]


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("GET", "/api/fit/160/log?clock_offset_s=nan", None),
        ("GET", "/api/fit/160/log?clock_offset_s=1e9", None),
        ("GET", "/api/fit/99999/log", None),
        ("GET", "/api/fit/99999/water", None),
        ("GET", "/rectified/99999.webp", None),
        ("GET", "/rectified/-1.webp", None),
        ("GET", "/rectified/160.webp?reach_m=-1", None),
        ("GET", "/rectified/160.webp?reach_m=1", None),
        ("GET", "/api/fit/160/map?reach_m=inf", None),
        ("PUT", "/api/clock", {"clock_offset_s": "2"}),
        ("PUT", "/api/clock", {"clock_offset_s": 1e300}),
        ("PUT", "/api/clock", {}),
        ("PUT", "/api/clock", {"clock_offset_s": 1.0, "recording": "../../x"}),
    ],
)
def test_what_is_none_is_refused_in_a_line(
    method: str, path: str, body: object, asked: TestClient
) -> None:
    answer = asked.request(method, path, json=body)
    assert answer.status_code == 422
    assert "\n" not in answer.json()["reason"]


def test_without_a_fit_it_says_what_is_wanted(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    drawing = Drawing(scene, annotator="ada")
    app = Guard(build_draw_app(Workbench(scene, drawing)), None, 8081)
    with TestClient(app, base_url="http://127.0.0.1:8081") as client:
        assert "draw boxes" in client.get("/api/fit").json()["reason"]
        assert client.get("/api/fit/2/water").status_code == 422
        # The clock can be stated nevertheless, and nothing else of the scene changes.
        before = scene.read_text(encoding="utf-8")
        told = client.put("/api/clock", json={"clock_offset_s": 1.5}).json()
        assert (told["stated_s"], told["before_s"]) == (1.5, None)
        assert tomllib.loads(scene.read_text())["recordings"][0]["clock_offset_s"] == 1.5
        frames = client.get("/api/frames").json()
        assert frames["time_utc_s"][0] == pytest.approx(1717236000.0 - 1.5)
        told = client.put("/api/clock", json={"clock_offset_s": None}).json()
        assert (told["stated_s"], told["before_s"]) == (None, 1.5)
        assert scene.read_text(encoding="utf-8") == before
    drawing.close()


def test_points_that_the_page_cannot_change_are_looked_at_as_well(tmp_path: Path) -> None:
    """Of a level camera 5 m high that looks north, by similar triangles: a row is r² / (h f)."""
    scene = small_scene(tmp_path)
    text = scene.read_text(encoding="utf-8").replace('fixes = "log.csv"\n', "")
    for east, north in ((0.0, 20.0), (-6.0, 25.0), (8.0, 30.0), (-12.0, 40.0), (15.0, 45.0)):
        (latitude,), (longitude,) = ORIGIN.to_geographic([east], [north])
        x, y = 32.0 + 60.0 * east / north, 24.0 + 60.0 * 5.0 / north
        text += f"[[control_points]]\npixel_px = [{x:.4f}, {y:.4f}]\n"
        text += f"latitude_deg = {latitude:.9f}\nlongitude_deg = {longitude:.9f}\n"
    scene.write_text(text.replace("[camera]", "[camera]\nimage_size_px = [64, 48]"))
    drawing = Drawing(scene, annotator="ada")
    app = Guard(build_draw_app(Workbench(scene, drawing)), None, 8081)
    with TestClient(app, base_url="http://127.0.0.1:8081") as client:
        told = client.get("/api/fit").json()
        assert (told["reason"], told["model"], told["logs"]) == ("", "the fit to control points", 0)
        assert client.get("/api/fit/2/log").json()["places"] == []
        reach_m = client.get("/api/fit/2/map").json()["furthest_m"]
        assert reach_m == pytest.approx(0.1 * 5.0 * 60.0, rel=0.25)
        assert client.get("/rectified/2.webp").status_code == 200
    drawing.close()


def test_it_is_seen_and_the_clock_is_moved_by_keys_alone(
    made: Path, page: Browser, tmp_path: Path
) -> None:
    scene, frames = drawn_scene(made, tmp_path / "scene")
    with served(scene) as server:
        page.open_anew(server.url)
        page.until("sightline.state.shown")
        page.until("sightline.state.shown && sightline.state.advice?.rmse_m != null")
        hand = Hand(page)
        hand.go_to(frames[8])
        page.press("v")
        page.until("sightline.check.log && sightline.check.water")
        page.until("Boolean(sightline.check.map.map.getSource('picture'))")
        page.until("sightline.check.map.map.areTilesLoaded()")
        cross = page.evaluate("sightline.stage.spots.find(one => !one.small).pixel")
        own_s = page.evaluate("sightline.check.offset")
        for _ in range(2):
            page.press("ArrowRight", ctrl=True)
        page.until(f"Math.abs(sightline.check.log.clock_offset_s - {own_s} - 2) < 1e-6")
        moved = page.evaluate("sightline.stage.spots.find(one => !one.small).pixel")
        expected = true_pixel(made, frames[8] - 20) - true_pixel(made, frames[8])
        assert np.subtract(moved, cross) == pytest.approx(expected, abs=12.0)
        assert "scene states nothing" in _text(page, "clock-note")
        assert f"--clock-offset {own_s + 2:.3f}".rstrip("0") in _text(page, "clock-key")
        # Nothing is written before somebody says so.
        assert "clock_offset_s" not in scene.read_text(encoding="utf-8")
        page.press("w")
        page.until("sightline.check.about.stated_s !== null")
        stated = tomllib.loads(scene.read_text())["recordings"][0]["clock_offset_s"]
        assert stated == pytest.approx(own_s + 2.0, abs=1e-3)
        page.press("z")
        page.until("sightline.check.about.stated_s === null")
        assert "clock_offset_s" not in scene.read_text(encoding="utf-8")
        # Each kind of line can be put out, and the picture faded.
        count = page.evaluate("sightline.stage.lines.length")
        for key in ("2", "4", "1"):
            page.press(key)
            now = page.evaluate("sightline.stage.lines.length")
            assert now < count
            count = now
        assert count == 0
        assert page.evaluate("sightline.stage.spots.length") == 0
        page.press("3")
        assert page.evaluate("sightline.stage.lines.length") > 0
        page.press("O")
        assert page.evaluate(
            "sightline.check.map.map.getPaintProperty('picture', 'raster-opacity')"
        ) == pytest.approx(0.7)
        far = page.evaluate("sightline.check.map.map.getSource('picture').coordinates[0][1]")
        page.evaluate("document.getElementById('reach').focus()")
        page.type("100")
        page.press("Enter")
        page.press("Escape")
        page.until(f"sightline.check.map.map.getSource('picture').coordinates[0][1] !== {far}")
        assert "as far as 100 m" in _text(page, "check-reach")
        # A box cannot be drawn here, and the arrows move none.
        before = hand.box()
        page.press("b")
        page.press("ArrowDown")
        assert hand.box() == before
        page.press("v")
        page.until("document.getElementById('check-section').hidden")
        assert page.evaluate("document.documentElement.scrollWidth") <= 1400
        own = re.compile(rf"http://127\.0\.0\.1:{server._port}/|data:|blob:")
        assert [url for url in page.requests if not own.match(url)] == []
        assert page.complaints == []


def undrawn_beside(made: Path, folder: Path, log: str) -> Path:
    """The harbour without drawn boxes, with detections of all that is in view."""
    scene = undrawn(made, folder, 'detections = "detections.csv"\n')
    (folder / "detections.csv").symlink_to(made / "detections" / "01.csv")
    (folder / "ais.nmea").symlink_to(made / "ais.nmea")
    scene.write_text(scene.read_text().replace("target.gpx", log), encoding="utf-8")
    return scene


@pytest.mark.parametrize("log", ["target.gpx", "ais.nmea"])
def test_whose_log_it_is_is_confirmed_by_keys_alone(
    log: str, made: Path, page: Browser, tmp_path: Path
) -> None:
    """And the boxes that are labelled so are those of the boat that the simulation has logged."""
    true = truth(made)
    scene = undrawn_beside(made, tmp_path / "scene", log)
    before = scene.read_text(encoding="utf-8")
    with served(scene) as server:
        page.open_anew(server.url)
        page.until("sightline.state.shown")
        page.press("l")
        page.until(
            "document.getElementById('whose-state').textContent.startsWith('All that moves')"
        )
        page.press("m")
        page.until("sightline.whose.list.length > 0")
        told = page.evaluate("sightline.whose.list")
        assert [one["probability"] for one in told] == sorted(
            (one["probability"] for one in told), reverse=True
        )
        vessels = [one["vessel"] for one in told]
        at = vessels.index("target" if log == "target.gpx" else "211000001")
        # Nothing is labelled before somebody says so.
        assert not (tmp_path / "scene/boxes").exists()
        page.press(str(at + 1))
        page.until("sightline.state.shown && sightline.stage.lines.length > 0")
        first = page.evaluate("sightline.state.frame")
        page.press("n")
        page.until(f"sightline.state.frame > {first} && sightline.state.shown")
        page.press("Enter")
        page.until("sightline.state.boxes.length > 0")
        labelled = Scene.load(scene)["01"].boxes()
        assert set(labelled.source) == {"detections"}
        assert len(labelled) == len(told[at]["boxes"]) >= 10
        off = [
            np.abs(np.subtract(true[frame], box)).max()
            for frame, box in zip(labelled.frame.tolist(), labelled.xyxy_px.tolist(), strict=True)
            if frame in true
        ]
        assert len(off) >= 0.9 * len(labelled)
        assert np.median(off) < 10.0
        # The fit learns from them as from any others.
        page.until("!sightline.state.advice.running && sightline.state.advice.rmse_m !== null")
        assert page.evaluate("sightline.state.advice.rmse_m") < 8.0
        mmsi = tomllib.loads(scene.read_text())["recordings"][0].get("mmsi")
        assert mmsi == (None if log == "target.gpx" else 211000001)
        page.press("z")
        page.until("sightline.state.boxes.length === 0")
        assert scene.read_text().replace('boxes = "boxes/01.csv"\n', "") == before
        assert page.complaints == []


def test_candidates_that_are_none_are_refused(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    drawing = Drawing(scene, annotator="ada")
    bench = Workbench(scene, drawing, detector="motion")
    app = Guard(build_draw_app(bench), None, 8081)
    with TestClient(app, base_url="http://127.0.0.1:8081") as client:
        assert client.get("/api/candidates").json()["state"] == "idle"
        for body in ({"number": 0}, {"number": -1}, {"number": "0"}, {}):
            answer = client.post("/api/candidates/confirm", json=body)
            assert answer.status_code == 422
            assert "\n" not in answer.json()["reason"]
        client.post("/api/candidates", json={})
        until = time.monotonic() + 60.0
        while (told := client.get("/api/candidates").json())["state"] == "running":
            assert time.monotonic() < until
            time.sleep(0.05)
        # Six pictures of noise show nothing that moves as a log says, and it is said why.
        assert told["state"] == "failed" or told["candidates"] == []
        assert "\n" not in told["reason"]
    bench.whose.close()
    drawing.close()


def _text(page: Browser, name: str) -> str:
    return page.evaluate(f"document.getElementById({name!r}).textContent")
