"""A picture on the map: each place has the colour of its pixel, by similar triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scene import FOCAL_PX, HEIGHT_M, LEVEL, SIZE_PX, pixel
from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.overlay.rectified import Rectifier, resolved_m
from sightline.overlay.water_view import WaterView

PLANE = LocalPlane(54.3, 10.1)


def ramps() -> np.ndarray:
    """A picture whose blue tells the column of each pixel, and whose green its row."""
    width, height = SIZE_PX
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    blue, green = 255.0 * columns / width, 255.0 * rows / height
    return np.dstack([blue, green, np.zeros_like(blue)]).round().astype(np.uint8)


def place_on(rectifier: Rectifier, east_m: float, north_m: float) -> tuple[int, int]:
    """Row and column of a place: corners are latitudes and longitudes, and rows are Mercator's."""
    (north, west), _, (south, east), _ = rectifier.corners_deg
    (latitude,), (longitude,) = PLANE.to_geographic([east_m], [north_m])

    def mercator(degrees: float) -> float:
        return float(np.log(np.tan(np.pi / 4 + np.radians(degrees) / 2)))

    height, width = rectifier.shown.shape
    down = (mercator(north) - mercator(latitude)) / (mercator(north) - mercator(south))
    return int(down * height), int((longitude - west) / (east - west) * width)


@pytest.fixture(scope="module")
def level() -> Rectifier:
    return Rectifier.of(WaterView.of(LEVEL), PLANE)


@pytest.mark.parametrize("place", [(0.0, 60.0), (-20.0, 100.0), (60.0, 200.0), (-100.0, 400.0)])
def test_a_place_has_the_colour_of_its_pixel(level: Rectifier, place: tuple[float, float]) -> None:
    row, column = place_on(level, *place)
    found = level.rectified(ramps())[row, column]
    x, y = pixel(*place)
    assert found[3] == 255
    assert found[0] == pytest.approx(255.0 * x / SIZE_PX[0], abs=2.0)
    assert found[1] == pytest.approx(255.0 * y / SIZE_PX[1], abs=2.0)


def test_it_ends_where_rows_do_not_tell_ranges_apart(level: Rectifier) -> None:
    """One row is ``r² / (h f)``: a tenth of the range at ``h f / 10``."""
    furthest_m = 0.1 * HEIGHT_M * FOCAL_PX
    assert level.furthest_m == pytest.approx(furthest_m, rel=0.01)
    assert resolved_m(WaterView.of(LEVEL), 0.02) == pytest.approx(0.2 * furthest_m, rel=0.01)
    for north_m, shown in ((furthest_m - 5.0, True), (furthest_m + 5.0, False)):
        row, column = place_on(level, 0.0, north_m)
        inside = 0 <= row < level.shown.shape[0]
        assert (inside and bool(level.shown[row, column])) is shown
    # Beside the view, and nearer than its lowest row: h f / 180 px.
    for east_m, north_m in ((80.0, 200.0), (0.0, 20.0)):
        row, column = place_on(level, east_m, north_m)
        assert not (0 <= row < level.shown.shape[0]) or not level.shown[row, column]
    picture = level.rectified(ramps())
    assert (picture[..., 3] == np.where(level.shown, 255, 0)).all()
    assert not picture[~level.shown].any()


def test_it_reaches_no_further_than_somebody_wants() -> None:
    near = Rectifier.of(WaterView.of(LEVEL), PLANE, reach_m=100.0)
    assert near.furthest_m == 100.0
    for north_m, shown in ((98.0, True), (103.0, False)):
        row, column = place_on(near, 0.0, north_m)
        assert (0 <= row < near.shown.shape[0] and bool(near.shown[row, column])) is shown
    row, column = place_on(near, -20.0, 90.0)
    x, _ = pixel(-20.0, 90.0)
    assert near.rectified(ramps())[row, column, 0] == pytest.approx(255 * x / SIZE_PX[0], abs=2.0)
    with pytest.raises(InputError, match="sees no water"):
        Rectifier.of(WaterView.of(LEVEL), PLANE, reach_m=5.0)


def test_the_edges_of_the_view_are_those_of_the_picture(level: Rectifier) -> None:
    """North up, all of what is seen and no more: 640 px of 900 px about the heading."""
    (north, west), *_ = level.corners_deg
    (south, east) = level.corners_deg[2]
    left, top = PLANE.to_plane([north, south], [west, east])
    half = np.arctan(0.5 * SIZE_PX[0] / FOCAL_PX)
    reach_m = level.furthest_m
    assert [left[0], left[1]] == pytest.approx(
        [-reach_m * np.sin(half), reach_m * np.sin(half)], abs=3.0
    )
    # The outermost at the far end, the lowest row at h f / 180 px.
    assert [top[0], top[1]] == pytest.approx([reach_m, HEIGHT_M * FOCAL_PX / 180.0], abs=3.0)


def test_a_camera_that_sees_no_water_is_refused() -> None:
    up = replace(LEVEL, pitch_deg=-60.0)
    with pytest.raises(InputError, match="sees no water"):
        Rectifier.of(WaterView.of(up), PLANE)
