"""The edge of the water, in pictures whose edge is known."""

import numpy as np

from sightline.camera.pinhole import Camera
from sightline.camera.shore_landmarks import shore_landmarks
from sightline.camera.shoreline import StillPicture, WaterEdge, find_water_edge
from sightline.types import Frame

CAMERA = Camera(
    height_m=4.0,
    pitch_deg=-2.0,
    roll_deg=0.6,
    heading_deg=75.0,
    focal_px=950.0,
    k1=-0.2,
    k2=0.03,
    east_m=0.0,
    north_m=0.0,
    image_size_px=(1280, 720),
)


def still_picture(images):
    still = StillPicture()
    for i, image in enumerate(images):
        still.look(Frame(i, float(i), image))
    return still.picture()


def picture(edge_row, rng, waves=6.0):
    """Land with texture above the edge, waves below it, anew in each picture."""
    rows = np.arange(720)[:, None]
    land = np.random.default_rng(5).normal(150.0, 25.0, (720, 1280))
    sea = 110.0 + rng.normal(0.0, waves, (720, 1280))
    grey = np.where(rows < edge_row[None, :], land, sea)
    grey[rows[:, 0] < 300] = 200.0
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def test_the_edge_is_found_within_pixels_though_it_lies_lower_and_tilted():
    rng = np.random.default_rng(0)
    expected = CAMERA.horizon_y_px(np.arange(1280.0))
    truth = expected + 12.0 + 6.0 * (np.arange(1280) / 1280 - 0.5)
    edge = find_water_edge(still_picture(picture(truth, rng) for _ in range(15)), expected)
    assert edge is not None
    off = edge.row_px - np.interp(edge.column_px, np.arange(1280.0), truth)
    assert np.abs(np.median(off)) < 2.0
    assert np.percentile(np.abs(off), 90) < 4.0


def test_boats_before_the_shore_do_not_move_it():
    rng = np.random.default_rng(1)
    expected = CAMERA.horizon_y_px(np.arange(1280.0))

    def with_boats():
        image = picture(expected + 8.0, rng)
        for left in (100, 500, 900):
            image[400:470, left : left + 90] = 255
        return image

    edge = find_water_edge(still_picture(with_boats() for _ in range(15)), expected)
    assert edge is not None
    off = edge.row_px - np.interp(edge.column_px, np.arange(1280.0), expected + 8.0)
    assert np.abs(np.median(off)) < 2.0


def test_without_water_there_is_no_edge():
    rng = np.random.default_rng(2)
    expected = CAMERA.horizon_y_px(np.arange(1280.0))
    flat = (np.full((720, 1280, 3), 120.0) + rng.normal(0, 4, (720, 1280, 3)) for _ in range(9))
    assert find_water_edge(still_picture(i.astype(np.uint8) for i in flat), expected) is None


BEARING = np.radians(75.0 + np.linspace(-30.0, 30.0, 61))
TOWARD = np.stack([np.sin(BEARING), np.cos(BEARING)], axis=1)
EARTH_M = 6.371e6 * 7.0 / 6.0


def places(*distances_m):
    """Logged places in all directions of the view, at some distances."""
    return np.concatenate([distance * TOWARD for distance in distances_m])


def edge_of(shore_m):
    """The edge of the water, where the shore lies so far away on an earth that is round."""
    drop = CAMERA.height_m / shore_m + 0.5 * shore_m / EARTH_M
    pixel = CAMERA.project(*(CAMERA.height_m / drop * TOWARD).T)
    inside = np.isfinite(pixel[:, 0]) & (pixel[:, 0] > 0) & (pixel[:, 0] < 1280)
    return WaterEdge(pixel[inside, 0], pixel[inside, 1], 1.0)


def rows_off(marks):
    """By how many pixels the camera sees landmarks off their rows, and what they state of it."""
    east, north = marks.east_north_m.T
    seen = CAMERA.project(east, north)
    assert np.abs(seen[:, 0] - marks.pixel_px[:, 0]).max() < 30.0
    away = np.hypot(east, north)
    below = CAMERA.project(*((1.0 - 1e-3) * marks.east_north_m).T)[:, 1] - seen[:, 1]
    return seen[:, 1] - marks.pixel_px[:, 1], below / (1e-3 * away) * marks.sigma_m


def test_landmarks_lie_where_the_camera_sees_the_shore_within_what_they_state():
    for shore_m in (1600.0, 2500.0, 7000.0):
        marks = shore_landmarks([edge_of(shore_m)], CAMERA, [places(80, 150, 280, 500, 900, 1500)])
        assert len(marks) >= 3
        off_px, sigma_px = rows_off(marks)
        # What is equally likely anywhere is at most sqrt(3) standard deviations off, and the shape
        # of a part of the edge takes a tenth of a pixel.
        assert (np.abs(off_px) < np.sqrt(3.0) * sigma_px + 0.1).all()
        # Beyond 1500 m, before a camera of 4 m: from 1.0 to 2.6 px below the horizon.
        assert np.abs(sigma_px - 1.6 / np.sqrt(12.0)).max() < 0.1


def test_behind_a_headland_a_log_does_not_say_that_there_is_water_before_it():
    # The vessel left the view at 280 m, and was next logged at 6 km, behind land 700 m away.
    marks = shore_landmarks([edge_of(700.0)], CAMERA, [places(80, 150, 280, 6000)])
    off_px, sigma_px = rows_off(marks)
    assert (np.abs(off_px) < np.sqrt(3.0) * sigma_px + 0.1).all()
    assert (sigma_px > 3.0).all()


def test_many_pictures_of_one_shore_tell_no_more_of_its_distance_than_one():
    logs = [places(80, 150, 280, 500, 900, 1500)]
    one = shore_landmarks([edge_of(2500.0)], CAMERA, logs)
    many = shore_landmarks([edge_of(2500.0)] * 10, CAMERA, logs)
    assert len(many) == len(one)
    np.testing.assert_allclose(many.sigma_m, one.sigma_m, rtol=0.05)


def test_a_shore_that_may_be_near_tells_nothing():
    edge = WaterEdge(np.linspace(10, 1270, 50), np.full(50, 420.0), 1.0)
    assert len(shore_landmarks([edge], CAMERA, [np.array([[60.0, 20.0]])])) == 0
    assert len(shore_landmarks([], CAMERA, [places(80, 150, 280, 500, 900, 1500)])) == 0
