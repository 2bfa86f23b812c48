from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sklearn.base import clone

from sightline.camera.observations import NO_SOURCE, Landmarks
from sightline.camera.pinhole import Camera
from sightline.camera.priors import SourcePrior
from sightline.errors import FitError, InputError
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.observations import CameraObservations
from sightline.types import FloatArray

SIZE = (1280, 720)
CAMERA = Camera(6.0, 5.0, 0.5, 20.0, 1000.0, -0.1, 0.01, 1.0, -2.0, SIZE)


def boxes_and_places(n: int = 40) -> tuple[FloatArray, FloatArray]:
    """Boxes of 20 by 12 px in all of the picture, and where their feet are."""
    rng = np.random.default_rng(0)
    foot = rng.uniform((100.0, 330.0), (1180.0, 700.0), (n, 2))
    boxes = np.concatenate([foot, foot], axis=1) + np.array([-10.0, -12.0, 10.0, 0.0])
    return boxes, np.stack(CAMERA.locate(foot), axis=1)


def test_features_and_targets_alone_teach_a_camera() -> None:
    boxes, places = boxes_and_places()
    model = CameraRegressor(SIZE, residual=False, starts=2, random_state=3)
    plain = clone(model).fit(boxes, places)
    told = clone(model).fit_observations(
        CameraObservations(
            boxes,
            places,
            source=np.full(40, ""),
            recording=np.full(40, "one"),
            vessel=np.full(40, "hers"),
            velocity_mps=np.zeros((40, 2)),
            time_s=np.full(40, np.nan),
            above_m=np.zeros(40),
            bias_only=np.zeros(40, dtype=np.bool_),
        )
    )
    np.testing.assert_array_equal(plain.fit_.vector, told.fit_.vector)
    assert np.hypot(*(plain.predict(boxes) - places).T).max() < 1.0


def test_a_clone_keeps_what_is_believed_of_sources() -> None:
    belief = SourcePrior(bias_px=(6.0, 0.01), bias_m=(0.0, 0.01))
    boxes, places = boxes_and_places()
    boxes[:, [1, 3]] += 6.0
    model = CameraRegressor(SIZE, residual=False, starts=2, source_priors={"low": belief})
    fitted = clone(model).fit_observations(
        CameraObservations(boxes, places, source=np.full(40, "low"))
    )
    assert fitted.bias("low")[0][0] == pytest.approx(6.0, abs=0.05)


def test_boxes_come_before_landmarks_and_each_landmark_stands_alone() -> None:
    boxes, places = boxes_and_places(4)
    landmarks = Landmarks(np.array([[5.0, 6.0], [7.0, 8.0]]), np.eye(2), np.array([0.1, 30.0]))
    observations = CameraObservations(
        boxes,
        places,
        source=np.array(["b", "a", "b", "b"]),
        recording=np.array(["x", "x", "y", "y"]),
        vessel=np.array(["v", "w", "v", "v"]),
        velocity_mps=np.arange(8.0).reshape(4, 2),
        time_s=np.arange(4.0),
        above_m=np.full(4, 0.5),
        landmarks=landmarks,
    )
    assert observations.sources == ("a", "b")
    found = observations.sightings()
    np.testing.assert_array_equal(found.pixel_px[:4], boxes[:, [2, 3]] - (10.0, 0.0))
    np.testing.assert_array_equal(found.pixel_px[4:], landmarks.pixel_px)
    np.testing.assert_array_equal(found.north_m, [*places[:, 1], 0.0, 1.0])
    np.testing.assert_array_equal(found.source, [1, 0, 1, 1, NO_SOURCE, NO_SOURCE])
    np.testing.assert_array_equal(found.group, [0, 0, 1, 1, 2, 3])
    # The vessels v of two recordings have a log each.
    np.testing.assert_array_equal(found.log, [0, 1, 2, 2, 3, 4])
    np.testing.assert_array_equal(
        found.velocity_mps, [[0, 1], [2, 3], [4, 5], [6, 7], [0, 0], [0, 0]]
    )
    np.testing.assert_array_equal(found.sigma_m, [0, 0, 0, 0, 0.1, 30.0])
    np.testing.assert_array_equal(found.time_s, [0, 1, 2, 3, np.nan, np.nan])
    np.testing.assert_allclose(found.width_px, [20, 20, 20, 20, np.nan, np.nan])
    np.testing.assert_array_equal(found.above_m, [0.5] * 4 + [0.0] * 2)


def test_landmarks_alone_are_observations() -> None:
    known = np.stack([np.linspace(100.0, 1100.0, 6), np.linspace(400.0, 600.0, 6)], axis=1)
    landmarks = Landmarks(known, np.stack(CAMERA.locate(known), axis=1), np.full(6, 0.1))
    nothing = np.empty((0, 4))
    found = CameraObservations(nothing, nothing[:, :2], landmarks=landmarks).sightings()
    np.testing.assert_array_equal(found.source, NO_SOURCE)
    np.testing.assert_array_equal(found.group, np.arange(6))


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("east_north_m", np.zeros((3, 2))),
        ("source", np.array(["a"])),
        ("velocity_mps", np.zeros((5, 2))),
        ("time_s", np.zeros(3)),
        ("bias_only", np.zeros(2, dtype=np.bool_)),
    ],
)
def test_columns_of_another_length_are_refused(column: str, values: Any) -> None:
    boxes, places = boxes_and_places(4)
    columns = {"east_north_m": places, column: values}
    with pytest.raises(InputError, match=f"4 boxes, but {column} has {len(values)} rows"):
        CameraObservations(boxes, **columns)


def test_values_that_are_not_numbers_are_refused() -> None:
    boxes, places = boxes_and_places(4)
    spoilt = places.copy()
    spoilt[2, 0] = np.nan
    far = Landmarks(np.zeros((1, 2)), np.array([[np.nan, 0.0]]), np.ones(1))
    for observed in (
        lambda: CameraObservations(boxes, spoilt),
        lambda: CameraObservations(boxes, places, landmarks=far),
    ):
        with pytest.raises(FitError, match="not a number"):
            observed()
    with pytest.raises(InputError, match="1 pixels, 1 places and 2 standard deviations"):
        CameraObservations(boxes, places, landmarks=Landmarks(*np.zeros((2, 1, 2)), np.ones(2)))
