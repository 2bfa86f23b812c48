from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sightline.camera.parameters import PARAMETERS
from sightline.camera.pinhole import (
    BY_ABOVE,
    BY_BEYOND,
    BY_COLUMN,
    BY_ROW,
    Camera,
    locate_one,
    locate_with_jacobian,
    project_with_jacobian,
)
from sightline.errors import InputError
from sightline.simulation import SimulatedCamera

SIZE = (1280, 720)

CAMERA = Camera(
    height_m=6.5,
    pitch_deg=5.0,
    roll_deg=-2.5,
    heading_deg=287.0,
    focal_px=1010.0,
    k1=-0.18,
    k2=0.03,
    east_m=-14.0,
    north_m=33.0,
    image_size_px=SIZE,
)

cameras = st.builds(
    Camera,
    height_m=st.floats(1.5, 60.0),
    pitch_deg=st.floats(-8.0, 50.0),
    roll_deg=st.floats(-12.0, 12.0),
    heading_deg=st.floats(0.0, 360.0),
    focal_px=st.floats(600.0, 4000.0),
    # No lens has a distortion of 1e-300.
    k1=st.integers(-200, 200).map(lambda n: n / 1000.0),
    k2=st.integers(0, 100).map(lambda n: n / 1000.0),
    east_m=st.floats(-300.0, 300.0),
    north_m=st.floats(-300.0, 300.0),
    image_size_px=st.sampled_from([SIZE, (1920, 1080), (641, 481)]),
)


def independent_rotation(camera: Camera) -> np.ndarray:
    """From east, north, up to right, down, forward: turn, then look down, then tilt."""
    heading, pitch, roll = np.radians([camera.heading_deg, camera.pitch_deg, camera.roll_deg])
    turned = Rotation.from_rotvec([0.0, 0.0, heading]).as_matrix()
    level_to_the_north = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    down = Rotation.from_rotvec([pitch, 0.0, 0.0]).as_matrix()
    tilted = Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix()
    return np.asarray(tilted @ down @ level_to_the_north @ turned)


def before(camera: Camera, seed: int, n: int = 40) -> np.ndarray:
    """(n, 3) points ahead of a camera, east, north and up, some out of its image."""
    rng = np.random.default_rng(seed)
    bearing = np.radians(camera.heading_deg + rng.uniform(-28.0, 28.0, n))
    distance = np.exp(rng.uniform(np.log(5.0), np.log(900.0), n))
    up = rng.uniform(0.0, 0.8, n) * camera.height_m
    return np.column_stack(
        [
            camera.east_m + distance * np.sin(bearing),
            camera.north_m + distance * np.cos(bearing),
            up,
        ]
    )


@given(camera=cameras, seed=st.integers(0, 1000))
def test_projects_as_opencv_does(camera: Camera, seed: int) -> None:
    points = before(camera, seed)
    rotation = independent_rotation(camera)
    place = np.array([camera.east_m, camera.north_m, camera.height_m])
    width, height = camera.image_size_px
    matrix = np.array(
        [[camera.focal_px, 0.0, 0.5 * width], [0.0, camera.focal_px, 0.5 * height], [0, 0, 1.0]]
    )
    expected, _ = cv2.projectPoints(
        points,
        cv2.Rodrigues(rotation)[0],
        -rotation @ place,
        matrix,
        np.array([camera.k1, camera.k2, 0.0, 0.0]),
    )
    found = camera.project(*points.T)
    seen = np.isfinite(found[:, 0])
    assert seen.any()
    np.testing.assert_allclose(found[seen], expected[seen, 0], rtol=1e-8, atol=1e-5)
    ahead = (points - place) @ rotation.T
    radius = np.hypot(ahead[:, 0], ahead[:, 1]) / ahead[:, 2]
    np.testing.assert_array_equal(seen, (ahead[:, 2] > 1e-6) & (radius < camera.largest_radius))


@pytest.mark.parametrize("seed", range(12))
def test_agrees_with_the_camera_of_the_simulation(seed: int) -> None:
    simulated = SimulatedCamera.random(np.random.default_rng(seed), SIZE)
    camera = Camera(
        height_m=simulated.height_m,
        pitch_deg=simulated.pitch_deg,
        roll_deg=simulated.roll_deg,
        heading_deg=simulated.heading_deg,
        focal_px=simulated.focal_length_px,
        k1=simulated.k1,
        k2=simulated.k2,
        east_m=0.0,
        north_m=0.0,
        image_size_px=SIZE,
    )
    points = before(camera, seed, 400)
    np.testing.assert_allclose(camera.project(*points.T), simulated.project(points), atol=1e-8)
    pixels = np.random.default_rng(seed).uniform([0.0, 0.0], SIZE, (500, 2))
    water = simulated.on_water(pixels)
    assert 50 < np.isfinite(water[:, 0]).sum() < 450
    near = ~(np.hypot(*water.T) > 1e4)
    np.testing.assert_allclose(
        np.stack(camera.locate(pixels), axis=1)[near], water[near], rtol=1e-7, atol=1e-7
    )
    columns = np.linspace(0.0, SIZE[0], 30)
    # Both look the row up among bearings, and these differ.
    np.testing.assert_allclose(
        camera.horizon_y_px(columns), simulated.horizon_px(columns), atol=2e-3
    )


@given(camera=cameras, seed=st.integers(0, 1000))
def test_a_projected_point_is_located_where_it_is(camera: Camera, seed: int) -> None:
    points = before(camera, seed)
    pixel = camera.project(*points.T)
    width, height = camera.image_size_px
    inside = ((pixel >= 0.0) & (pixel <= [width, height])).all(axis=1)
    east, north = camera.locate(pixel[inside], points[inside, 2])
    distance = np.hypot(points[inside, 0] - camera.east_m, points[inside, 1] - camera.north_m)
    # A ray that grazes the plane turns rounding in the pixel into metres.
    grazing = distance / (camera.height_m - points[inside, 2])
    off = np.hypot(east - points[inside, 0], north - points[inside, 1])
    assert (off <= 1e-9 * distance * np.maximum(grazing, 1.0)).all()


@given(
    camera=cameras,
    share=st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)), min_size=1, max_size=20),
    above=st.floats(-2.0, 0.5),
)
def test_a_located_pixel_is_projected_to_itself(
    camera: Camera, share: list[tuple[float, float]], above: float
) -> None:
    pixel = np.array(share) * camera.image_size_px
    east, north = camera.locate(pixel, above)
    there = np.isfinite(east) & (np.hypot(east, north) < 1e7)
    np.testing.assert_allclose(
        camera.project(east[there], north[there], above), pixel[there], atol=1e-6
    )


@pytest.mark.parametrize(
    ("k1", "k2", "radii"),
    [
        # Nearly flat at a radius of 2, where the distorted radius is 1.104.
        (-0.16, 0.012, [1.0, 1.104, 1.2238, 1.5]),
        # Folds at a radius of 1.4907, where the distorted radius is 0.99381.
        (-0.15, 0.0, [0.5, 0.9, 0.9937, 0.99380]),
        (0.1, 0.05, [0.5, 3.0, 20.0]),
    ],
)
def test_a_lens_is_undone_where_it_is_nearly_flat(k1: float, k2: float, radii: list[float]) -> None:
    camera = replace(CAMERA, k1=k1, k2=k2, image_size_px=(40_000, 40_000))
    middle = np.array(camera.image_size_px) / 2.0
    pixel = middle + camera.focal_px * np.array(radii)[:, None] * [0.6, -0.8]
    rays = camera.rays(pixel)
    radius = np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2]
    # The lens model by hand.
    np.testing.assert_allclose(radius * (1.0 + k1 * radius**2 + k2 * radius**4), radii, rtol=1e-12)
    for one, (x, y) in zip(radius, pixel, strict=True):
        assert np.hypot(*camera._undistorted_one(x, y)) == pytest.approx(one, rel=1e-9)


@given(camera=cameras)
def test_nothing_lies_at_or_above_the_horizon(camera: Camera) -> None:
    columns = np.linspace(0.0, camera.image_size_px[0], 9)
    rows = camera.horizon_y_px(columns)
    seen = np.isfinite(rows)
    columns, rows = columns[seen], rows[seen]
    limit = camera.largest_radius
    if np.isfinite(limit):
        top = limit * (1.0 + camera.k1 * limit**2 + camera.k2 * limit**4) * camera.focal_px
        offset = np.hypot(
            columns - 0.5 * camera.image_size_px[0], rows - 0.5 * camera.image_size_px[1]
        )
        columns, rows = columns[offset < 0.9 * top], rows[offset < 0.9 * top]
    for above, located in ((1.0, False), (40.0, False), (-1.0, True)):
        east, north = camera.locate(np.column_stack([columns, rows - above]))
        assert (np.isfinite(east) == located).all()
        assert (np.isfinite(north) == located).all()


def test_the_row_of_the_horizon_itself_has_no_place() -> None:
    level = replace(CAMERA, pitch_deg=0.0, roll_deg=0.0, k1=0.0, k2=0.0)
    east, north = level.locate([[100.0, 360.0], [640.0, 360.0], [640.0, 361.0]])
    assert np.isnan(east[:2]).all()
    assert np.isnan(north[:2]).all()
    # A pixel below the horizon sees the plane at height times focal length.
    distance = np.hypot(east[2] - level.east_m, north[2] - level.north_m)
    assert distance == pytest.approx(level.height_m * level.focal_px)


@pytest.mark.parametrize("pitch_deg", [-7.0, 0.0, 3.0, 12.0])
def test_the_horizon_of_a_level_camera_without_distortion(pitch_deg: float) -> None:
    camera = replace(CAMERA, pitch_deg=pitch_deg, roll_deg=0.0, k1=0.0, k2=0.0)
    expected = 0.5 * SIZE[1] - camera.focal_px * np.tan(np.radians(pitch_deg))
    np.testing.assert_allclose(
        camera.horizon_y_px([0.0, 333.0, 640.0, 1280.0]), expected, atol=1e-9
    )


def test_a_positive_roll_lowers_the_right_end_of_the_horizon() -> None:
    camera = replace(CAMERA, pitch_deg=0.0, roll_deg=3.0, k1=0.0, k2=0.0)
    left, middle, right = camera.horizon_y_px([140.0, 640.0, 1140.0])
    assert middle == pytest.approx(360.0)
    assert right - middle == pytest.approx(500.0 * np.tan(np.radians(3.0)))
    assert left - middle == pytest.approx(-500.0 * np.tan(np.radians(3.0)))


def test_a_barrel_with_one_term_refuses_what_lies_beyond_its_fold() -> None:
    k1, focal = -0.32, 940.0
    camera = replace(CAMERA, focal_px=focal, k1=k1, k2=0.0, pitch_deg=30.0, roll_deg=0.0)
    limit = np.sqrt(-1.0 / (3.0 * k1))
    assert camera.largest_radius == pytest.approx(limit, rel=1e-12)
    # There 1 + k1 r² is two thirds.
    fold_px = 2.0 / 3.0 * limit * focal
    assert 630.0 < fold_px < 645.0
    angle = np.radians(np.arange(10.0, 171.0, 10.0))
    outwards = np.column_stack([np.cos(angle), np.sin(angle)])
    middle = 0.5 * np.array(SIZE)
    for radius, located in ((0.9, True), (0.999, True), (1.001, False), (1.15, False)):
        east, _ = camera.locate(middle + radius * fold_px * outwards)
        assert (np.isfinite(east) == located).all()
    # Points further off the axis than the fold would come back into the picture.
    rays = np.column_stack([1.05 * limit * outwards, np.ones(angle.size)]) @ camera.rotation
    rays = rays[rays[:, 2] < -0.05]
    reach = -camera.height_m / rays[:, 2]
    points = np.array([camera.east_m, camera.north_m]) + reach[:, None] * rays[:, :2]
    assert len(points) > 5
    assert np.isnan(camera.project(*points.T)).all()


def test_one_pixel_beyond_the_fold_has_no_place_and_neither_among_many() -> None:
    """No ray reaches further out in the image than the largest radius that the lens makes."""
    camera = replace(CAMERA, focal_px=700.0, k1=-0.32, k2=0.02, pitch_deg=60.0)
    radius = np.linspace(0.0, 1.5, 100_001)
    made = radius * (1.0 + camera.k1 * radius**2 + camera.k2 * radius**4)
    fold_px = camera.focal_px * made[: np.argmax(np.diff(made) < 0.0) + 1].max()
    pixel = np.random.default_rng(5).uniform((0.0, 0.0), SIZE, (400, 2))
    away = np.hypot(*(pixel - 0.5 * np.array(SIZE)).T)
    seen = away < fold_px
    # Looking down as steeply as here, whatever the lens shows is water.
    assert 40 < np.sum(~seen) < 360
    assert away.max() < 2.0 * fold_px
    many = locate_with_jacobian(camera, *pixel.T, 0.0, 0.0)
    np.testing.assert_array_equal(np.isfinite(many.distance_m), seen)
    for i, (x, y) in enumerate(pixel.tolist()):
        one = locate_one(camera, x, y, 0.0, 0.0)
        assert (one is not None) == seen[i]
        if one is not None:
            assert one[0] == pytest.approx(many.distance_m[i], rel=1e-9)


def test_pixels_up_to_the_fold_come_back_to_themselves() -> None:
    camera = replace(CAMERA, focal_px=940.0, k1=-0.32, k2=0.0, pitch_deg=45.0, roll_deg=0.0)
    fold_px = 2.0 / 3.0 * camera.largest_radius * 940.0
    radius = fold_px * np.linspace(0.0, 0.999, 60)
    pixel = np.column_stack([np.full(60, 640.0), 360.0 + radius])
    np.testing.assert_allclose(camera.project(*camera.locate(pixel)), pixel, atol=1e-6)


def test_a_lens_that_never_folds_has_no_largest_radius() -> None:
    assert replace(CAMERA, k1=0.1, k2=0.02).largest_radius == np.inf
    assert replace(CAMERA, k1=0.0, k2=0.0).largest_radius == np.inf
    # 20 k2 > 9 k1² keeps the distorted radius growing everywhere.
    assert replace(CAMERA, k1=-0.2, k2=0.0181).largest_radius == np.inf
    assert replace(CAMERA, k1=-0.2, k2=0.0179).largest_radius < np.inf


@given(camera=cameras)
def test_a_parameter_vector_holds_the_whole_camera(camera: Camera) -> None:
    again = Camera.from_vector(camera.to_vector(), camera.image_size_px)
    for name in PARAMETERS:
        expected = getattr(camera, name)
        if name == "heading_deg":
            expected %= 360.0
            off = (getattr(again, name) - expected + 180.0) % 360.0 - 180.0
            assert off == pytest.approx(0.0, abs=1e-9)
        else:
            assert getattr(again, name) == pytest.approx(expected, rel=1e-12, abs=1e-12)


@given(camera=cameras, seed=st.integers(0, 1000))
def test_derivatives_of_the_projection_are_finite_differences(camera: Camera, seed: int) -> None:
    points = before(camera, seed, 12)
    projected = camera.project(*points.T)
    points = points[((projected > 0.0) & (projected < camera.image_size_px)).all(axis=1)]
    assume(len(points) > 0)
    vector = camera.to_vector()

    def project(vector: np.ndarray, points: np.ndarray) -> np.ndarray:
        return project_with_jacobian(vector, camera.image_size_px, *points.T)[0]

    pixel, by_parameter, by_point = project_with_jacobian(vector, camera.image_size_px, *points.T)
    np.testing.assert_allclose(pixel, camera.project(*points.T), rtol=1e-12, atol=1e-9)
    for derivative, base in ((by_parameter, vector), (by_point, np.zeros(3))):
        for i in range(len(base)):
            step = np.zeros(len(base))
            step[i] = 1e-5
            if derivative is by_parameter:
                change = project(vector + step, points) - project(vector - step, points)
            else:
                change = project(vector, points + step) - project(vector, points - step)
            scale = max(1.0, np.abs(derivative[:, :, i]).max())
            np.testing.assert_allclose(
                derivative[:, :, i], change / 2e-5, rtol=1e-5, atol=1e-6 * scale
            )


@pytest.mark.parametrize("above_m", [0.0, 0.7, -0.4])
@pytest.mark.parametrize("beyond_m", [0.0, 2.5])
@pytest.mark.parametrize(
    "camera",
    [
        CAMERA,
        replace(CAMERA, heading_deg=12.0, pitch_deg=25.0, roll_deg=8.0, k1=0.1, k2=-0.01),
        replace(CAMERA, heading_deg=150.0, pitch_deg=-3.0, k1=0.0, k2=0.0, height_m=30.0),
    ],
    ids=["barrel", "pincushion", "looking up"],
)
def test_derivatives_of_places_are_finite_differences(
    camera: Camera, above_m: float, beyond_m: float
) -> None:
    rng = np.random.default_rng(4)
    column = rng.uniform(60.0, 1220.0, 40)
    row = camera.horizon_y_px(column) + rng.uniform(15.0, 180.0, 40)

    def place(
        camera: Camera, column: np.ndarray, row: np.ndarray, above: float, beyond: float
    ) -> np.ndarray:
        east, north = camera.locate(np.column_stack([column, row]), above)
        ray = np.stack([east - camera.east_m, north - camera.north_m])
        longer = 1.0 + beyond / np.hypot(*ray)
        return np.array([[camera.east_m], [camera.north_m]]) + longer * ray

    found = locate_with_jacobian(camera, column, row, above_m, beyond_m)
    here = place(camera, column, row, above_m, beyond_m)
    along = np.stack([found.sine, found.cosine])
    across = np.stack([found.cosine, -found.sine])
    np.testing.assert_allclose(
        np.array([[camera.east_m], [camera.north_m]]) + found.distance_m * along, here, rtol=1e-11
    )

    vector, step = camera.to_vector(), 1e-6
    for i in range(len(PARAMETERS) + 4):

        def moved(by: float, i: int = i) -> np.ndarray:
            shifted = vector.copy()
            if i < len(PARAMETERS):
                shifted[i] += by
            return place(
                Camera.from_vector(shifted, SIZE),
                column + by * (i == BY_COLUMN),
                row + by * (i == BY_ROW),
                above_m + by * (i == BY_ABOVE),
                beyond_m + by * (i == BY_BEYOND),
            )

        change = (moved(step) - moved(-step)) / (2.0 * step)
        expected = np.stack([(change * along).sum(axis=0), (change * across).sum(axis=0)])
        scale = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(
            found.derivatives[i], expected, rtol=1e-5, atol=1e-6 * scale, err_msg=str(i)
        )


def test_places_with_derivatives_are_unknown_above_the_horizon_too() -> None:
    row = CAMERA.horizon_y_px([400.0]) - 5.0
    found = locate_with_jacobian(CAMERA, np.array([400.0]), row, 0.0, 1.0)
    assert np.isnan(found.distance_m).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height_m": 0.0}, "must be positive"),
        ({"height_m": -3.0}, "must be positive"),
        ({"focal_px": -900.0}, "must be positive"),
        ({"image_size_px": (0, 720)}, "must be positive"),
        ({"pitch_deg": float("nan")}, "pitch_deg is not a number"),
        ({"k1": float("inf")}, "k1 is not a number"),
        ({"height_m": float("nan")}, "height_m is not a number"),
    ],
)
def test_refuses_what_is_no_camera(change: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(CAMERA, **change)
