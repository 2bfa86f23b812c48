"""The page of drawing in a real browser: mouse, keys and fingers, beside the simulation's truth."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from web_browser import Browser, browser
from web_drawing import Box, Hand, harbour, served, small_scene, truth, undrawn
from web_moments import HOSTILE

from sightline.formats import read_boxes
from sightline.geodesy import LocalPlane
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.simulation import SimulatedCamera

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return harbour(tmp_path_factory.mktemp("harbour"))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser")) as one:
        one.size(1400, 900)
        yield one


def opened(page: Browser, url: str) -> Hand:
    page.size(1400, 900)
    page.requests.clear()
    page.complaints.clear()
    page.open(url)
    page.until("sightline.state.shown")
    return Hand(page)


def drawn(scene: Path) -> dict[int, Box]:
    boxes = Scene.load(scene)["01"].boxes()
    return dict(zip(boxes.frame.tolist(), boxes.xyxy_px.tolist(), strict=True))


def _rmse_m(model: Georeferencer, made: Path, true: dict[int, Box]) -> float:
    """How far boxes of the truth are placed from where the simulation has the boat."""
    with (made / "truth.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["target"] == "1"]
    frames = sorted(true)[::5]
    places = model.locate([true[frame] for frame in frames], "ada")
    north = np.array([float(rows[frame]["latitude_deg"]) for frame in frames])
    east = np.array([float(rows[frame]["longitude_deg"]) for frame in frames])
    x, y = LocalPlane(54.3233, 10.1394).to_plane(north, east)
    found = LocalPlane(54.3233, 10.1394).to_plane(places.latitude_deg, places.longitude_deg)
    apart = np.hypot(found[0] - x, found[1] - y)
    assert np.isfinite(apart).mean() > 0.9
    return float(np.sqrt(np.nanmean(apart**2)))


def test_fifteen_boxes_by_mouse_and_by_keys_are_in_the_table(
    made: Path, page: Browser, tmp_path: Path
) -> None:
    """And a model of them is as good as one of the truth's boxes in a file."""
    true = truth(made)
    wide = [frame for frame, box in true.items() if box[0] > 1 and box[2] < 1279]
    frames = [wide[i] for i in np.linspace(0, len(wide) - 1, 15).astype(int)]
    scene = undrawn(made, tmp_path / "drawn")
    with served(scene) as server:
        hand = opened(page, server.url)
        for i, frame in enumerate(frames):
            hand.go_to(frame)
            if i % 2:
                hand.key_box(true[frame])
            else:
                hand.drag_box(true[frame])
            hand.accept()
        assert page.complaints == []
    found = drawn(scene)
    assert sorted(found) == frames
    off = np.abs([np.subtract(found[frame], true[frame]) for frame in frames])
    assert off.max() <= 0.5
    assert set(read_boxes(tmp_path / "drawn/boxes/01.csv").source) == {"ada"}
    by_file = undrawn(made, tmp_path / "file", 'boxes = "boxes.csv"\n')
    rows = ["frame,x1,y1,x2,y2,annotator"]
    rows += [",".join(map(str, (frame, *true[frame], "ada"))) for frame in frames]
    (tmp_path / "file/boxes.csv").write_text("\n".join(rows), encoding="utf-8")
    errors = []
    for path in (scene, by_file):
        model = fit(Scene.load(path), "camera")
        errors.append(_rmse_m(model, made, true))
    assert errors[0] < 1.1 * errors[1] + 0.2


def test_what_is_followed_is_accepted_by_keys(made: Path, page: Browser, tmp_path: Path) -> None:
    true = truth(made)
    frame = next(f for f, box in true.items() if f > 60 and box[0] > 100 and box[2] < 1180)
    scene = undrawn(made, tmp_path / "scene")
    with served(scene) as server:
        hand = opened(page, server.url)
        hand.go_to(frame)
        hand.drag_box(true[frame])
        page.press("f")
        page.until("!sightline.state.busy && sightline.state.boxes.some(one => !one.accepted)")
        proposed = page.evaluate(
            "sightline.state.boxes.filter(one => !one.accepted).map(one => one.frame)"
        )
        assert len(proposed) >= 10
        # It goes to the nearest of them, which can be mended before it is accepted.
        page.until("sightline.state.shown && sightline.stage.kind === 'proposed'")
        first = page.evaluate("sightline.state.frame")
        assert abs(first - frame) == 1
        before = hand.box()
        page.press("ArrowDown")
        page.press("ArrowUp", shift=True)
        hand.accept()
        assert drawn(scene)[first] == pytest.approx(
            [before[0], before[1], before[2], before[3] + 0.75], abs=0.01
        )
        # One is thrown away, some more are accepted as they are.
        thrown = page.evaluate("sightline.state.frame")
        page.press("Delete")
        page.until(f"sightline.state.shown && sightline.state.frame !== {thrown}")
        for _ in range(6):
            hand.accept()
        found = drawn(scene)
        assert thrown not in found
        assert len(found) == 8
        lower = [abs(box[3] - true[one][3]) for one, box in found.items()]
        assert np.median(lower) < 3.0
        # The rest is thrown away at once, and comes back.
        page.press("x")
        page.until("!sightline.state.busy && sightline.state.boxes.every(one => one.accepted)")
        page.press("z")
        page.until("!sightline.state.busy && sightline.state.boxes.some(one => !one.accepted)")
        assert page.complaints == []


def test_a_box_is_taken_back_and_made_again(made: Path, page: Browser, tmp_path: Path) -> None:
    scene = undrawn(made, tmp_path / "scene")
    with served(scene) as server:
        hand = opened(page, server.url)
        hand.go_to(30)
        hand.drag_box((400.0, 300.0, 460.0, 330.0))
        kept = hand.box()
        hand.accept()
        for name, count in (("undo", 0), ("redo", 1), ("undo", 0)):
            hand.press_button(name)
            page.until(f"!sightline.state.busy && sightline.state.boxes.length === {count}")
            page.until("sightline.state.shown && sightline.state.frame === 30")
        page.press("y")
        page.until("!sightline.state.busy && sightline.state.boxes.length === 1")
        assert drawn(scene)[30] == pytest.approx(kept, abs=0.01)
        # A drag begun within the box moves it, one at its lower edge the edge alone.
        page.until("sightline.state.shown && sightline.stage.box")
        page.press("0")
        for _ in range(6):
            page.press("+")
        x1, y1, x2, y2 = hand.box()
        middle = hand.stage(0.5 * (x1 + x2), 0.5 * (y1 + y2))
        page.drag(middle, (middle[0] + 40.0, middle[1]))
        moved = hand.box()
        scale = page.evaluate("sightline.stage.scale")
        assert moved == pytest.approx((x1 + 40 / scale, y1, x2 + 40 / scale, y2), abs=0.6)
        lower = hand.stage(0.5 * (moved[0] + moved[2]), moved[3])
        page.drag(lower, (lower[0], lower[1] + 30.0))
        assert hand.box()[:3] == pytest.approx(moved[:3], abs=0.01)
        assert hand.box()[3] == pytest.approx(moved[3] + 30 / scale, abs=0.6)
        # What is not kept is taken back.
        page.press("Escape")
        assert hand.box() == pytest.approx(kept, abs=0.01)


def test_edges_are_typed_as_well(made: Path, page: Browser, tmp_path: Path) -> None:
    scene = undrawn(made, tmp_path / "scene")
    with served(scene) as server:
        hand = opened(page, server.url)
        frame = page.evaluate("sightline.state.frame")
        hand.press_button("new")
        for i, value in ((2, 700.5), (3, 420.25), (0, 640.0), (1, 390.75)):
            page.evaluate(f"document.getElementById('edge-{i}').focus()")
            page.evaluate(f"document.getElementById('edge-{i}').select()")
            page.type(str(value))
        page.press("Enter")
        page.until("!sightline.state.busy && sightline.state.boxes.length === 1")
        assert drawn(scene)[frame] == [640.0, 390.75, 700.5, 420.25]


def test_a_control_point_is_clicked_and_its_place_pasted(
    made: Path, page: Browser, tmp_path: Path
) -> None:
    """With residuals at once: places of the true camera are met, one that is off is told."""
    scene = undrawn(made, tmp_path / "scene")
    camera = json.loads((made / "truth.json").read_text(encoding="utf-8"))["camera"]
    pixels = [(200, 420), (640, 400), (1100, 430), (300, 600), (900, 650), (640, 520), (1000, 480)]
    places = _on_the_water(camera, pixels)
    with served(scene) as server:
        hand = opened(page, server.url)
        page.press("c")
        page.until("!document.getElementById('points-section').hidden")
        page.until("sightline.points.map?.map.loaded()")
        page.press("0")
        for i, (pixel, (latitude, longitude)) in enumerate(zip(pixels, places, strict=True)):
            for _ in range(8):
                page.press("-")
            page.click(*hand.stage(*pixel))
            _nudge_to(page, pixel)
            page.evaluate("document.getElementById('place').focus()")
            page.type(_as_pasted(i, latitude, longitude))
            page.until("document.getElementById('place-note').textContent.startsWith('Read as')")
            page.evaluate("document.getElementById('point-name').focus()")
            page.type(HOSTILE[:60] if i == 0 else f"mark {i}")
            page.press("Enter")
            page.until(f"sightline.points.list.length === {i + 1}")
        kept = Scene.load(scene).control_points
        assert np.abs(kept.pixel_px - pixels).max() < 0.5
        assert np.abs(kept.latitude_deg - [one[0] for one in places]).max() < 2e-6
        assert np.abs(kept.longitude_deg - [one[1] for one in places]).max() < 2e-6
        page.until("sightline.points.fits.get(7)?.left_out_m != null")
        cells = page.evaluate(
            "[...document.querySelectorAll('#points tr')].map(one =>"
            " [...one.children].map(cell => cell.textContent))"
        )
        assert all(float(row[1]) < 1.5 for row in cells)
        # A name is text, here and in the table of the scene.
        assert cells[0][0] == HOSTILE[:60]
        assert page.evaluate("document.querySelector('#points script, #points img')") is None
        # One is moved: chosen in the list, its place typed anew, a hundred metres off.
        page.evaluate("document.querySelectorAll('#points button')[5].click()")
        page.evaluate("document.getElementById('place').focus()")
        page.evaluate("document.getElementById('place').select()")
        page.type(f"{places[5][0] + 0.0002:.7f}, {places[5][1]:.7f}")
        page.press("Enter")
        page.until(
            "sightline.points.fits.size === 7 && document.querySelectorAll("
            "'#points td')[16].textContent > 5"
        )
        page.press("z")
        page.until(
            "sightline.points.fits.size === 7 && document.querySelectorAll("
            "'#points td')[16].textContent < 1.5"
        )
        # The map is a way to give a place as well.
        x, y = page.evaluate(
            "(() => { const b = document.getElementById('point-map').getBoundingClientRect();"
            " return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        page.click(x, y)
        page.until("document.getElementById('place').value !== ''")
        said = page.evaluate("document.getElementById('place').value")
        middle = page.evaluate("(c => [c.lat, c.lng])(sightline.points.map.map.getCenter())")
        assert [float(part) for part in said.split(",")] == pytest.approx(middle, abs=1e-4)
        assert page.complaints == []


def _on_the_water(camera: dict, pixels: list[tuple[int, int]]) -> list[tuple[float, float]]:
    """Where the true camera has pixels, by the simulation's own projection, inverted."""
    true = SimulatedCamera(
        **{
            key: value
            for key, value in camera.items()
            if key not in ("latitude_deg", "longitude_deg", "image_size_px")
        }
    )
    plane = LocalPlane(camera["latitude_deg"], camera["longitude_deg"])

    def missed(place: np.ndarray, pixel: tuple[int, int]) -> np.ndarray:
        return true.project([place[0], place[1], 0.0]) - pixel

    found = []
    for pixel in pixels:
        bearing = np.radians(camera["heading_deg"]) + np.arctan(
            (pixel[0] - 640) / camera["focal_length_px"]
        )
        start = 60.0 * np.array([np.sin(bearing), np.cos(bearing)])
        east, north = least_squares(missed, start, args=(pixel,)).x
        latitude, longitude = plane.to_geographic(east, north)
        found.append((float(latitude), float(longitude)))
    return found


def _as_pasted(i: int, latitude: float, longitude: float) -> str:
    """A place in one of the forms that people paste."""
    return [
        f"{latitude:.7f}, {longitude:.7f}",
        f"geo:{latitude:.7f},{longitude:.7f}",
        f"{_minutes(latitude)}N {_minutes(longitude)}E",
        f"https://www.openstreetmap.org/?mlat={latitude:.7f}&mlon={longitude:.7f}",
    ][i % 4]


def _minutes(degrees: float) -> str:
    return f"{int(degrees)}°{60 * (degrees % 1):.5f}'"


def _nudge_to(page: Browser, pixel: tuple[int, int]) -> None:
    """Arrow keys move the pixel by one, and with Shift by a quarter."""
    for i, keys in enumerate((("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown"))):
        off = pixel[i] - page.evaluate("sightline.stage.point")[i]
        for _ in range(round(abs(off) * 4)):
            page.press(keys[int(off > 0)], shift=True)


def test_a_finger_draws_with_a_magnifier_above_it(
    made: Path, page: Browser, tmp_path: Path
) -> None:
    scene = undrawn(made, tmp_path / "scene")
    with served(scene) as server:
        hand = opened(page, server.url)
        page.size(844, 390, mobile=True)
        page.call("Emulation.setTouchEmulationEnabled", enabled=True)
        try:
            hand.go_to(20)
            page.press("0")
            start, end = hand.stage(500.0, 420.0), hand.stage(620.0, 480.0)
            page.touch("touchStart", start)
            page.touch("touchMove", ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2))
            page.touch("touchMove", end)
            shown = page.evaluate(
                "(one => [one.hidden, one.getBoundingClientRect().bottom])"
                "(document.getElementById('finger'))"
            )
            assert shown[0] is False
            assert shown[1] < end[1]
            page.touch("touchEnd")
            assert page.evaluate("document.getElementById('finger').hidden")
            assert hand.box() == pytest.approx((500.0, 420.0, 620.0, 480.0), abs=2.0)
            # The lower edge follows a thumb on the magnifier by an eighth.
            before = hand.box()
            x, y = page.evaluate(
                "(b => [b.x + b.width / 2, b.y + b.height / 2])"
                "(document.getElementById('magnifier').getBoundingClientRect())"
            )
            page.touch("touchStart", (x, y))
            page.touch("touchMove", (x, y - 20.0))
            page.touch("touchEnd")
            assert hand.box()[3] == pytest.approx(before[3] + 2.5, abs=0.01)
            # Two fingers zoom, and draw nothing.
            scale = page.evaluate("sightline.stage.scale")
            page.touch("touchStart", (200.0, 150.0))
            page.touch("touchStart", (200.0, 150.0), (260.0, 150.0))
            page.touch("touchMove", (170.0, 150.0), (290.0, 150.0))
            page.touch("touchEnd")
            assert page.evaluate("sightline.stage.scale") == pytest.approx(2.0 * scale, rel=0.05)
            assert hand.box()[3] == pytest.approx(before[3] + 2.5, abs=0.01)
            hand.press_button("accept")
            page.until("!sightline.state.busy && sightline.state.boxes.length === 1")
            assert page.evaluate("document.documentElement.scrollWidth") <= 844
            page.size(390, 844, mobile=True)
            assert page.evaluate("document.documentElement.scrollWidth") <= 390
        finally:
            page.call("Emulation.setTouchEmulationEnabled", enabled=False)


def test_names_stay_text_and_nothing_is_fetched_from_elsewhere(
    page: Browser, tmp_path: Path
) -> None:
    scene = small_scene(tmp_path)
    name = HOSTILE.replace("\u202e", "")[:80]
    text = scene.read_text(encoding="utf-8").replace("[camera]", f"[camera]\nname = '''{name}'''")
    scene.write_text(text, encoding="utf-8")
    with served(scene, annotator=name) as server:
        hand = opened(page, server.url)
        for _ in range(2):
            page.press("b")
            hand.accept()
        page.press("c")
        page.until("sightline.points.map?.map.loaded()")
        page.press("c")
        assert page.evaluate("document.title") == f"{name} 01 – sightline draw"
        assert page.evaluate("document.getElementById('title').textContent") == f"{name} 01"
    with served(scene, annotator="bob") as server:
        hand = opened(page, server.url)
        hand.go_to(Scene.load(scene)["01"].boxes().frame.tolist()[0])
        page.until("document.getElementById('box-note').textContent.includes('onerror')")
        own = re.compile(rf"http://127\.0\.0\.1:{server._port}/|data:|blob:|about:")
        assert [url for url in page.requests if not own.match(url)] == []
        assert page.evaluate("document.querySelectorAll('img, script:not([src])').length") == 0
        assert page.complaints == []


def test_keys_of_one_letter_can_be_turned_off(page: Browser, tmp_path: Path) -> None:
    """Whoever speaks to the computer says letters that are not meant for it (WCAG 2.1.4)."""
    with served(small_scene(tmp_path)) as server:
        opened(page, server.url)
        page.press("?")
        page.until("document.getElementById('help').open")
        page.evaluate("document.getElementById('letters').click()")
        page.press("Escape")
        page.press("b")
        assert page.evaluate("sightline.stage.box") is None
        page.evaluate("document.getElementById('new').click()")
        assert page.evaluate("sightline.stage.box") is not None


def test_what_the_server_refuses_is_told_and_nothing_is_lost(page: Browser, tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    with served(scene) as server:
        hand = opened(page, server.url)
        page.press("b")
        box = hand.box()
        (tmp_path / "boxes").write_text("in the way", encoding="utf-8")
        page.press("Enter")
        page.until("document.getElementById('status').dataset.state === 'refused'")
        assert hand.box() == box
        (tmp_path / "boxes").unlink()
        hand.accept()
    assert len(drawn(scene)) == 1
