import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.errors import InputError
from sightline.simulation.camera import SimulatedCamera

cameras = st.builds(
    SimulatedCamera,
    height_m=st.floats(1.0, 60.0),
    pitch_deg=st.floats(-10.0, 40.0),
    roll_deg=st.floats(-10.0, 10.0),
    heading_deg=st.floats(0.0, 360.0),
    focal_length_px=st.floats(800.0, 3000.0),
    k1=st.floats(-0.3, 0.1),
    k2=st.just(0.05),
)


def _opencv(camera: SimulatedCamera, points: np.ndarray) -> np.ndarray:
    """The same camera, put together from OpenCV's conventions: Rodrigues vectors one by one."""
    axes = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # east, north, up -> x, y, z
    heading, pitch, roll = np.radians([camera.heading_deg, camera.pitch_deg, camera.roll_deg])
    turn = cv2.Rodrigues(np.array([0.0, -heading, 0.0]))[0]
    tilt = cv2.Rodrigues(np.array([pitch, 0.0, 0.0]))[0]
    spin = cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    rotation = spin @ tilt @ turn @ axes
    translation = -rotation @ np.array([0.0, 0.0, camera.height_m])
    width, height = camera.image_size_px
    f = camera.focal_length_px
    matrix = np.array([[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]])
    distortion = np.array([camera.k1, camera.k2, 0.0, 0.0])
    rotation_vector = cv2.Rodrigues(rotation)[0]
    return cv2.projectPoints(points, rotation_vector, translation, matrix, distortion)[0][:, 0]


@given(cameras, st.integers(0, 2**31))
def test_projects_as_opencv_does(camera: SimulatedCamera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    bearing = np.radians(camera.heading_deg + rng.uniform(-30.0, 30.0, 50))
    distance = rng.uniform(5.0, 1000.0, 50)
    points = np.stack(
        [distance * np.sin(bearing), distance * np.cos(bearing), rng.uniform(0, 10, 50)], axis=-1
    )
    ours = camera.project(points)
    seen = np.isfinite(ours).all(axis=1)
    np.testing.assert_allclose(ours[seen], _opencv(camera, points)[seen], atol=1e-6)


@given(cameras, st.integers(0, 2**31))
def test_pixels_of_water_come_back(camera: SimulatedCamera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0.0, 1.0, (50, 2)) * camera.image_size_px
    water = camera.on_water(pixels)
    on_water = np.isfinite(water).all(axis=1) & (np.hypot(*water.T) < 1e5)
    again = camera.project(np.column_stack([water, np.zeros(50)])[on_water])
    np.testing.assert_allclose(again, pixels[on_water], atol=1e-4)


def test_axes_are_as_the_conventions_say() -> None:
    level = SimulatedCamera(4.0, 0.0, 0.0, 90.0, 1000.0)
    # Due east, at the height of the lens: the centre of the image; to the south: to the right.
    np.testing.assert_allclose(level.project([100.0, 0.0, 4.0]), [640.0, 360.0])
    assert level.project([100.0, -10.0, 4.0])[0] > 640.0
    assert level.project([100.0, 0.0, 0.0])[1] == pytest.approx(360.0 + 1000.0 * 4.0 / 100.0)
    # Looking down lifts the horizon in the image.
    down = SimulatedCamera(4.0, 5.0, 0.0, 90.0, 1000.0)
    assert down.horizon_px([640.0])[0] == pytest.approx(360.0 - 1000.0 * np.tan(np.radians(5.0)))
    # A positive roll lowers the right end of the horizon.
    rolled = SimulatedCamera(4.0, 0.0, 3.0, 90.0, 1000.0).horizon_px([0.0, 640.0, 1280.0])
    slope = np.tan(np.radians(3.0))
    np.testing.assert_allclose(rolled, 360.0 + slope * np.array([-640.0, 0.0, 640.0]), atol=1e-6)


def test_what_lies_behind_has_no_pixel() -> None:
    camera = SimulatedCamera(4.0, 0.0, 0.0, 0.0, 1000.0)
    assert np.isnan(camera.project([[0.0, -50.0, 0.0], [50.0, 0.0, 0.0]])).all()
    assert np.isnan(camera.on_water([640.0, 10.0])).all()


def test_a_lens_that_folds_inside_the_image_is_refused() -> None:
    with pytest.raises(InputError, match="folds the image"):
        SimulatedCamera(3.5, 0.0, 0.0, 0.0, 940.0, k1=-0.32)
    with pytest.raises(InputError, match="positive"):
        SimulatedCamera(0.0, 0.0, 0.0, 0.0, 940.0)


@pytest.mark.parametrize("seed", range(20))
def test_random_cameras_see_water_and_horizon(seed: int) -> None:
    camera = SimulatedCamera.random(np.random.default_rng(seed))
    horizon = camera.horizon_px(np.linspace(0.0, 1280.0, 9))
    assert (horizon > 0.15 * 720).all()
    assert (horizon < 0.7 * 720).all()
    assert camera.nearest_water_m < 30.0
