"""Control points that are set one at a time, before a simulated camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sightline import InputError, Scene
from sightline.geodesy import LocalPlane
from sightline.labelling import ControlPointSheet
from sightline.simulation import SimulatedCamera

PLANE = LocalPlane(54.3, 10.1)
CAMERA = SimulatedCamera(
    height_m=7.0, pitch_deg=4.0, roll_deg=0.8, heading_deg=30.0, focal_length_px=1000.0
)
PIXELS = np.array(
    [
        [100.0, 600.0],
        [400.0, 480.0],
        [640.0, 420.0],
        [900.0, 520.0],
        [1200.0, 640.0],
        [700.0, 690.0],
        [300.0, 400.0],
        [1000.0, 380.0],
    ]
)
SCENE = """[camera]
latitude_deg = 54.3
longitude_deg = 10.1
image_size_px = [1280, 720]

[[recordings]]
name = "a"
detections = "a.csv"
"""


def places() -> list[tuple[float, float]]:
    east, north = CAMERA.on_water(PIXELS)[:, :2].T
    latitude, longitude = PLANE.to_geographic(east, north)
    return list(zip(latitude.tolist(), longitude.tolist(), strict=True))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "a.csv").write_text("frame,x1,y1,x2,y2\n0,1,1,5,5\n")
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def sheet(scene: Path) -> ControlPointSheet:
    sheet = ControlPointSheet(scene)
    for (x, y), place in zip(PIXELS.tolist(), places(), strict=True):
        sheet.add((x, y), *place)
    return sheet


def test_points_are_written_at_once_and_read_by_the_scene(
    scene: Path, sheet: ControlPointSheet
) -> None:
    control = Scene.load(scene).control_points
    np.testing.assert_allclose(control.pixel_px, PIXELS)
    found = np.stack([control.latitude_deg, control.longitude_deg], axis=1)
    # To a millimetre.
    np.testing.assert_allclose(found, places(), atol=1e-8)
    assert [one.number for one in sheet.points()] == list(range(1, 9))
    assert scene.read_text().replace('control_points = "control_points.csv"\n\n', "") == SCENE


@pytest.mark.slow
def test_residuals_tell_the_point_that_was_moved(sheet: ControlPointSheet) -> None:
    sound = sheet.residuals()
    assert sound.error == ""
    assert max(one.error_m for one in sound.points) < 0.5
    assert sound.left_out_m < 1.0
    height = next(one for one in sound.parameters if one.name == "height_m")
    assert height.value == pytest.approx(7.0, abs=0.3)
    latitude, longitude = places()[1]
    sheet.move(2, place_deg=(latitude + 20.0 / 111_000.0, longitude))
    wrong = sheet.residuals()
    worst = max(wrong.points, key=lambda one: one.left_out_m)
    assert worst.number == 2
    assert worst.left_out_m == pytest.approx(20.0, abs=1.0)
    assert worst.outlier
    assert np.isnan(sheet.residuals(left_out=False).left_out_m)
    assert sheet.undo()
    assert max(one.error_m for one in sheet.residuals(left_out=False).points) < 0.5


def test_too_few_points_are_no_camera(scene: Path) -> None:
    sheet = ControlPointSheet(scene)
    assert "no control points" in sheet.residuals().error
    sheet.add((100.0, 600.0), *places()[0])
    assert "needs at least 3" in sheet.residuals().error


def test_changes_are_taken_back_and_made_again(scene: Path, sheet: ControlPointSheet) -> None:
    sheet.move(3, pixel_px=(641.0, 421.0))
    sheet.remove(5)
    assert [one.x_px for one in sheet.points()] == [100, 400, 641, 900, 700, 300, 1000]
    undone = 0
    while sheet.undo():
        undone += 1
    assert undone == 10
    # Without any the scene is as it was, and not one with an empty table.
    assert sheet.points() == []
    assert scene.read_text().strip() == SCENE.strip()
    assert not (scene.parent / "control_points.csv").exists()
    assert len(Scene.load(scene).control_points) == 0
    while sheet.redo():
        undone -= 1
    assert undone == 0
    assert [one.x_px for one in sheet.points()] == [100, 400, 641, 900, 700, 300, 1000]


def test_two_people_set_points(scene: Path, sheet: ControlPointSheet) -> None:
    other = ControlPointSheet(scene)
    other.add((500.0, 500.0), 54.3003, 10.1002, "pier, left")
    sheet.remove(1)
    assert [one.name for one in sheet.points()] == [""] * 7 + ["pier, left"]
    other.move(8, pixel_px=(501.0, 500.0))
    assert other.undo()
    assert other.undo()
    # The other has not seen that the first point went; it is told, and nothing is lost.
    sheet.move(1, pixel_px=(401.0, 480.0))
    other.move(1, pixel_px=(402.0, 480.0))
    with pytest.raises(InputError, match="changed by somebody else meanwhile"):
        sheet.undo()
    assert sheet.points()[0].x_px == 402.0
    assert len(sheet.points()) == 7


@pytest.mark.parametrize(
    ("pixel", "place", "why"),
    [
        ((-1.0, 5.0), (54.3, 10.1), "not in the picture of 1280 x 720 px"),
        ((5.0, 721.0), (54.3, 10.1), "not in the picture of 1280 x 720 px"),
        ((float("nan"), 5.0), (54.3, 10.1), "not in the picture"),
        ((5.0, 5.0), (91.0, 10.1), "no place on the earth"),
        ((5.0, 5.0), (54.3, 181.0), "no place on the earth"),
        ((5.0, 5.0), (float("inf"), 10.1), "no place on the earth"),
        ((5.0, 5.0), (-54.3, 10.1), "control point"),
    ],
)
def test_what_is_no_point_is_refused(
    scene: Path,
    sheet: ControlPointSheet,
    pixel: tuple[float, float],
    place: tuple[float, float],
    why: str,
) -> None:
    before = (scene.parent / "control_points.csv").read_bytes()
    with pytest.raises(InputError, match=why) as raised:
        sheet.add(pixel, *place)
    assert "\n" not in str(raised.value)
    assert (scene.parent / "control_points.csv").read_bytes() == before
    for number in (0, 9):
        with pytest.raises(InputError, match=f"there is no control point {number}"):
            sheet.remove(number)


def test_points_that_cannot_be_changed_are_refused(scene: Path) -> None:
    inline = (
        "[[control_points]]\npixel_px = [1.0, 2.0]\nlatitude_deg = 54.3\nlongitude_deg = 10.1\n"
    )
    scene.write_text(SCENE + inline)
    with pytest.raises(InputError, match="stand in the scene file; write them into a table"):
        ControlPointSheet(scene)
    assert scene.read_text() == SCENE + inline


def test_a_table_that_is_broken_by_hand_stays_as_it_is(
    scene: Path, sheet: ControlPointSheet
) -> None:
    path = scene.parent / "control_points.csv"
    path.write_text("x_px,y_px,latitude_deg,longitude_deg\n1,2,here,10.1\n")
    before = path.read_bytes()
    for asked in (sheet.points, lambda: sheet.remove(1), sheet.undo):
        with pytest.raises(InputError, match="line 2"):
            asked()
    assert "line 2" in sheet.residuals().error
    assert path.read_bytes() == before
