"""The page of drawing in a real browser: mouse, keys and fingers, beside the simulation's truth."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from web_browser import Browser, browser
from web_drawing import Box, Hand, harbour, served, truth, undrawn

from sightline.formats import read_boxes
from sightline.geodesy import LocalPlane
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.fit import fit
from sightline.scene import Scene

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
    print(errors)
    assert errors[0] < 1.1 * errors[1] + 0.2
