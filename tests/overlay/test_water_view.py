"""Where places on the water lie in the picture, against the closed form of a level camera."""

from __future__ import annotations

import numpy as np
import pytest

from sightline.camera.pinhole import Camera
from sightline.overlay.water_view import WaterView
from sightline.simulation import SimulatedCamera

SIZE_PX = (640, 360)
FOCAL_PX, HEIGHT_M = 900.0, 5.0
MIDDLE = np.array([320.0, 180.0])
# Holds 95 % of two dimensions: -2 ln 0.05.
CHI_SQUARE = 5.991464547


def camera(heading_deg: float = 0.0, k1: float = 0.0) -> Camera:
    return Camera(
        height_m=HEIGHT_M,
        pitch_deg=0.0,
        roll_deg=0.0,
        heading_deg=heading_deg,
        focal_px=FOCAL_PX,
        k1=k1,
        k2=0.0,
        east_m=0.0,
        north_m=0.0,
        image_size_px=SIZE_PX,
    )


def place_of(pixels: np.ndarray) -> np.ndarray:
    """Right and ahead of a level camera, by similar triangles."""
    ahead = FOCAL_PX * HEIGHT_M / (pixels[:, 1] - MIDDLE[1])
    return np.stack([(pixels[:, 0] - MIDDLE[0]) * ahead / FOCAL_PX, ahead], axis=1)


def test_an_ellipse_lies_on_the_water_and_holds_95_percent() -> None:
    covariance = np.array([[16.0, 12.0], [12.0, 90.0]])
    place = np.array([8.0, 120.0])
    outline = WaterView.of(camera()).ellipse_px(place, covariance)
    away = place_of(outline) - place
    squares = np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away)
    np.testing.assert_allclose(squares, CHI_SQUARE, rtol=1e-6)
    # All around, not a part of it.
    angles = np.arctan2(away[:, 1], away[:, 0])
    assert np.histogram(angles, 8, (-np.pi, np.pi))[0].min() > 0


def test_what_a_track_does_not_tell_is_not_drawn() -> None:
    outline = WaterView.of(camera()).ellipse_px([0.0, 100.0], np.full((2, 2), np.nan))
    assert np.isnan(outline).all()


def test_rings_are_circles_about_the_camera_that_can_be_told_apart() -> None:
    rings = WaterView.of(camera(90.0)).rings()
    radii = [radius for radius, _ in rings]
    assert radii == sorted(radii)
    assert radii[0] == 50.0
    rows = []
    for radius, ring in rings:
        seen = ring[np.isfinite(ring).all(axis=1)]
        right, ahead = place_of(seen).T
        np.testing.assert_allclose(np.hypot(right, ahead), radius, rtol=1e-6)
        rows.append(180.0 + FOCAL_PX * HEIGHT_M / radius)
    assert (np.diff(rows) <= -18.0).all()


def test_the_grid_is_of_equal_east_and_of_equal_north() -> None:
    for line in WaterView.of(camera()).grid(400.0, 50.0):
        seen = line[np.isfinite(line).all(axis=1)]
        if len(seen) < 2:
            continue
        places = place_of(seen)
        same = np.ptp(places, axis=0) < 1e-3
        assert same.sum() == 1
        value = places[0, same][0]
        assert value == pytest.approx(50.0 * round(value / 50.0), abs=1e-3)
        assert (np.hypot(*places.T) <= 400.1).all()


def test_the_horizon_of_a_level_camera_is_its_middle_row() -> None:
    line = WaterView.of(camera()).horizon_px()
    inside = (line[:, 0] >= 0.0) & (line[:, 0] <= SIZE_PX[0])
    assert inside.sum() > 100
    np.testing.assert_allclose(line[inside, 1], 180.0, atol=1e-6)


def test_water_that_stands_higher_is_nearer_to_the_camera() -> None:
    (pixel,) = WaterView.of(camera(), above_m=2.0).pixels([[0.0, 100.0]])
    np.testing.assert_allclose(pixel, [320.0, 180.0 + FOCAL_PX * 3.0 / 100.0])


def test_a_camera_that_is_turned_sees_everything_moved() -> None:
    # The scene turns about the camera's axis that points down, to the right in the picture.
    (pixel,) = WaterView.of(camera(), rotation_rad=[0.0, 0.02, 0.0]).pixels([[0.0, 1e5]])
    assert pixel[0] == pytest.approx(320.0 + FOCAL_PX * np.tan(0.02), abs=1e-3)
    unknown = WaterView.of(camera(), rotation_rad=[np.nan] * 3).pixels([[0.0, 1e5]])
    np.testing.assert_allclose(unknown, WaterView.of(camera()).pixels([[0.0, 1e5]]))


def test_places_are_where_the_simulated_camera_sees_them() -> None:
    true = SimulatedCamera(
        height_m=7.0,
        pitch_deg=4.0,
        roll_deg=0.8,
        heading_deg=30.0,
        focal_length_px=1000.0,
        k1=-0.12,
        k2=0.01,
    )
    own = Camera(7.0, 4.0, 0.8, 30.0, 1000.0, -0.12, 0.01, 0.0, 0.0, (1280, 720))
    bearing = np.radians(np.linspace(10.0, 50.0, 9))
    places = 150.0 * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    seen = true.project(np.column_stack([places, np.zeros(9)]))
    np.testing.assert_allclose(WaterView.of(own).pixels(places), seen, atol=1e-6)


def test_the_edges_of_the_picture_are_seen_at_their_bearings() -> None:
    left, right = WaterView.of(camera(70.0)).edge_bearings_rad()
    half = np.arctan(320.0 / FOCAL_PX)
    np.testing.assert_allclose([left, right], np.radians(70.0) + np.array([-half, half]))


def test_the_edges_of_a_lens_that_folds_are_where_it_does() -> None:
    # r (1 + k1 r²) is largest at r = sqrt(-1 / 3 k1): at 0.25, where the picture reaches to 0.36.
    k1 = -1.0 / (3.0 * 0.25**2)
    left, right = WaterView.of(camera(0.0, k1)).edge_bearings_rad()
    assert -np.arctan(0.25) < left < -np.arctan(0.2)
    assert np.arctan(0.2) < right < np.arctan(0.25)
