"""What a planned camera is said to see and to know, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.planning import (
    PATTERNS,
    Hull,
    Mounting,
    curvature,
    known_camera,
    learn,
    pattern_drive,
    water_map,
)
from sightline.planning.drive import SOURCE
from sightline.planning.learning import LearnSettings
from sightline.planning.water_map import axes_at

RADIUS_M = 6_371_000.0 * 7.0 / 6.0
"""Of the earth as sight lines see it, that refraction bends."""

PLANE = LocalPlane(54.3233, 10.1394)
BOAT = Hull(5.0, 1.75)


def level(height_m: float = 10.0, focal_px: float = 1000.0) -> Mounting:
    """A camera that looks level to the north."""
    field = math.degrees(2.0 * math.atan(640.0 / focal_px))
    return Mounting(height_m, field, (1280, 720), 0.0, pitch_deg=0.0)


def test_the_picture_is_as_wide_as_the_field_of_view_whatever_the_lens() -> None:
    for distortion in ((0.0, 0.0), (-0.2, 0.03)):
        camera = Mounting(5.0, 70.0, (1280, 720), 0.0, 0.0, distortion=distortion).camera
        left, right = camera.rays([[0.0, 360.0], [1280.0, 360.0]])
        assert math.degrees(math.acos(left @ right)) == pytest.approx(70.0, abs=1e-6)


def test_the_horizon_lies_a_third_below_the_upper_edge() -> None:
    camera = Mounting(5.0, 65.0, (1280, 720), 30.0).camera
    assert camera.horizon_y_px([640.0])[0] == pytest.approx(240.0, abs=0.1)


def test_curvature_matters_from_where_closed_forms_have_it() -> None:
    bent = curvature(level(100.0, 5000.0).camera)
    horizon_m = math.sqrt(2.0 * RADIUS_M * 100.0)
    assert bent.horizon_m == pytest.approx(horizon_m)
    assert bent.geometric_horizon_m == pytest.approx(math.sqrt(2.0 * 6_371_000.0 * 100.0))
    # By d / 2 R, an angle, the water lies lower than a plane.
    assert bent.pixel_from_m == pytest.approx(2.0 * RADIUS_M / 5000.0, rel=0.01)
    # A plane is met nearer by 1 / (1 + (d / horizon)²).
    assert bent.matters_from_m == pytest.approx(horizon_m * math.sqrt(0.05 / 0.95), rel=0.01)


def test_a_low_camera_sees_no_pixel_of_curvature_before_its_horizon() -> None:
    assert curvature(level(5.0).camera).pixel_from_m == math.inf


def test_boats_are_found_where_a_pinhole_shows_them_as_wide() -> None:
    water = water_map(known_camera(level().camera, BOAT), [BOAT], least_px=8.0)
    (line,) = (one for one in water.contours if one.kind == "size")
    east, north = line.east_north_m.T
    # A broadside length at a bearing t is shown 1 / cos² t as wide.
    expected_m = 1000.0 * 5.0 / 8.0 * (1.0 + (east / north) ** 2)
    np.testing.assert_allclose(np.hypot(east, north), expected_m, rtol=0.01)
    assert np.ptp(np.degrees(np.arctan2(east, north))) > 60.0


def test_ellipses_of_a_known_camera_are_those_of_a_row_of_pixels() -> None:
    camera = level().camera
    ranges = np.array([300.0, 600.0, 1000.0])
    places = np.stack([np.zeros(3), ranges], axis=1)
    major, _ = axes_at(known_camera(camera, BOAT), places, BOAT)
    row_px = np.hypot(1.0, 0.15 * 1000.0 / ranges)
    expected_m = math.sqrt(5.9915) * row_px * ranges**2 / (10.0 * 1000.0)
    np.testing.assert_allclose(major, expected_m, rtol=0.04)


def test_higher_water_is_a_lower_camera() -> None:
    places = np.array([[0.0, 100.0], [20.0, 300.0]])
    high, _ = axes_at(known_camera(level(10.0).camera, BOAT), places, BOAT, above_m=4.0)
    low, _ = axes_at(known_camera(level(6.0).camera, BOAT), places, BOAT)
    np.testing.assert_allclose(high, low, rtol=1e-6)


def test_contours_lie_where_the_ellipse_is_as_long() -> None:
    model = known_camera(Mounting(6.0, 65.0, (1280, 720), 120.0).camera, BOAT)
    lines = [one for one in water_map(model, [BOAT]).contours if one.kind == "axis"]
    assert len({one.value for one in lines}) >= 4
    for line in lines:
        inside = line.east_north_m[3:-3]
        major, _ = axes_at(model, inside, BOAT)
        known = np.isfinite(major)
        np.testing.assert_allclose(major[known], line.value, rtol=0.02)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_pattern_stays_in_the_picture(pattern: str) -> None:
    camera = Mounting(6.0, 65.0, (1280, 720), 300.0).camera
    drive = pattern_drive(pattern, camera, BOAT, speed_mps=4.0, least_px=8.0)
    steps = np.hypot(*np.diff(drive.path.east_north_m, axis=0).T)
    # As fast as asked, but where a second has a corner in it.
    assert np.median(steps) == pytest.approx(4.0)
    assert steps.max() < 4.0 + 1e-6
    pairs = drive.correspondences(camera, PLANE, BOAT, interval_s=2.0, least_px=8.0)
    assert len(pairs) > 0.9 * pairs.asked
    width = pairs.boxes.xyxy_px[:, 2] - pairs.boxes.xyxy_px[:, 0]
    assert width.min() >= 8.0


def test_the_hull_in_the_picture_ends_at_its_near_side() -> None:
    camera = level().camera
    (bow_on,) = BOAT.boxes(camera, np.array([[0.0, 100.0]]), np.array([[0.0, 1.0]]))
    near_m = 100.0 - 2.5
    assert bow_on[3] == pytest.approx(360.0 + 1000.0 * 10.0 / near_m, abs=0.01)
    assert bow_on[2] - bow_on[0] == pytest.approx(1000.0 * 1.75 / near_m, abs=0.01)
    (abeam,) = BOAT.boxes(camera, np.array([[0.0, 100.0]]), np.array([[1.0, 0.0]]))
    assert abeam[2] - abeam[0] == pytest.approx(1000.0 * 5.0 / (100.0 - 0.875), abs=0.01)


@pytest.mark.slow
def test_a_drive_across_leaves_the_height_open_and_a_statement_closes_it() -> None:
    """At one range a higher camera that looks further down shows the same."""
    camera = Mounting(9.0, 65.0, (1280, 720), 30.0).camera
    drive = pattern_drive("across", camera, BOAT, speed_mps=4.0, least_px=8.0)
    learned = learn(camera, PLANE, drive, BOAT)
    told = learn(camera, PLANE, drive, BOAT, LearnSettings(stated=("height_m",)))
    assert "height_m" in learned.undetermined
    (before,), (after,) = (
        [one for one in own.parameters if one.name == "height_m"] for own in (learned, told)
    )
    assert before.value == after.value == pytest.approx(9.0)
    # Stated without a standard deviation, a height is good to a tenth.
    assert after.sigma <= 0.95 < before.sigma
    place = np.array([[60.0, 300.0]])
    wide, tight = (
        axes_at(own.model, place, BOAT, camera=camera, source=SOURCE)[0][0]
        for own in (learned, told)
    )
    assert not wide <= tight


@pytest.mark.slow
def test_the_same_seed_is_the_same_plan() -> None:
    camera = Mounting(6.0, 65.0, (1280, 720), 30.0).camera
    drive = pattern_drive("across", camera, BOAT, speed_mps=4.0, least_px=8.0)
    one, other = (learn(camera, PLANE, drive, BOAT) for _ in range(2))
    assert one.parameters == other.parameters


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"height_m": 0.0}, "a height of 0 m"),
        ({"field_of_view_deg": 200.0}, "a field of view of 200°"),
        ({"distortion": (-2.0, 0.0)}, "folds the picture"),
    ],
)
def test_what_no_camera_can_have_is_refused(settings: dict[str, float], message: str) -> None:
    given = {
        "height_m": 5.0,
        "field_of_view_deg": 65.0,
        "image_size_px": (1280, 720),
        "heading_deg": 0.0,
    }
    with pytest.raises(InputError, match=message):
        Mounting(**{**given, **settings})


def test_a_camera_that_sees_the_sky_alone_is_refused() -> None:
    camera = Mounting(5.0, 40.0, (1280, 720), 0.0, pitch_deg=-40.0).camera
    with pytest.raises(InputError, match="no water"):
        water_map(known_camera(camera, BOAT), [BOAT])
