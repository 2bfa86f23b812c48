"""How fits are scored before other cameras: against truths that were planted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _support.cameras import (
    SPEED_CAMERA,
    Held,
    Truth,
    camera_fit,
    feet,
    held,
    homography_rmse_m,
    passing_targets,
    score,
    scored,
    splits,
    total,
)

from sightline.camera.parameters import LOG_FOCAL, LOG_HEIGHT
from sightline.evaluation.metrics import absolute_error, coverage
from sightline.geodesy import LocalPlane
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit import FitSettings, fit
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.simulation import SimulationSettings, simulate
from sightline.types import Boxes, FloatArray

TRUTH = Truth(SPEED_CAMERA.height_m, SPEED_CAMERA.focal_px)


@pytest.fixture(scope="module")
def model() -> Georeferencer:
    return fit(passing_targets(12, 120), FitSettings(model="camera"))


def _pairs(pixel: FloatArray, place: FloatArray) -> Correspondences:
    boxes = np.tile(pixel, 2) + np.array([-5.0, -10.0, 5.0, 0.0])
    return Correspondences(
        boxes=Boxes.of(boxes, time_utc_s=np.arange(len(boxes))),
        recording=np.full(len(boxes), "one"),
        east_north_m=place,
        velocity_mps=np.zeros((len(boxes), 2)),
        asked=len(boxes),
        plane=LocalPlane(54.0, 10.0),
    )


def _planted(n: int, seed: int) -> Correspondences:
    pixel = np.random.default_rng(seed).uniform((0.0, 300.0), (1280.0, 720.0), (n, 2))
    matrix = np.array([[0.1, 0.02, -60.0], [0.01, -0.05, 90.0], [0.0, 0.004, -0.5]])
    found = np.column_stack([pixel, np.ones(n)]) @ matrix.T
    return _pairs(pixel, found[:, :2] / found[:, 2:])


def test_seeds_are_one_split_and_folders_without_both_scenes_none(tmp_path: Path) -> None:
    for name in ("road/id", "road/id-seed1", "road/near-far", "river/feed"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "train.toml").touch()
        if name != "river/feed":
            (tmp_path / name / "test.toml").touch()
    found = splits(tmp_path)
    assert {name: len(folders) for name, folders in found.items()} == {
        "road id": 2,
        "road near-far": 1,
    }


def test_a_planted_homography_is_found_though_some_places_are_wrong() -> None:
    train, test = _planted(60, 0), _planted(40, 1)
    assert homography_rmse_m(train, test) == pytest.approx(0.0, abs=1e-6)
    wrong = train.east_north_m.copy()
    wrong[::12] += (30.0, -40.0)
    assert homography_rmse_m(replace(train, east_north_m=wrong), test) < 0.01


def test_feet_are_the_middles_of_lower_edges() -> None:
    boxes = Boxes.of([[10.0, 20.0, 30.0, 50.0]])
    np.testing.assert_array_equal(feet(boxes), [[20.0, 50.0]])


def test_boxes_without_a_place_are_counted_and_the_others_scored(model: Georeferencer) -> None:
    rng = np.random.default_rng(0)
    pixel = rng.uniform((100.0, 400.0), (1180.0, 700.0), (2000, 2))
    pixel[::4, 1] = 15.0
    pairs = _pairs(pixel, np.zeros((2000, 2)))
    found = model.locate(pairs.boxes.xyxy_px)
    known = found.known
    assert known.sum() == 1500
    # Truths drawn from the stated ellipses lie in 95 % of those that hold as many.
    off = np.linalg.cholesky(found.covariance_m2[known]) @ rng.normal(size=(1500, 2, 1))
    truth = np.zeros((2000, 2))
    truth[known] = np.stack([found.east_m, found.north_m], axis=1)[known] + off[:, :, 0]
    scores = scored(model, replace(pairs, east_north_m=truth))
    assert (scores.asked, scores.without_position, len(scores)) == (2000, 500, 1500)
    assert coverage(scores).p95 == pytest.approx(0.95, abs=0.02)
    assert absolute_error(scores).rmse == pytest.approx(np.sqrt(np.mean(off**2) * 2.0))


def test_a_parameter_is_within_or_outside_or_not_determined(model: Georeferencer) -> None:
    found = camera_fit(model)
    sigma = np.sqrt(np.diag(found.covariance))[[LOG_HEIGHT, LOG_FOCAL]]
    at = np.exp(found.vector[[LOG_HEIGHT, LOG_FOCAL]] + sigma * (2.9, -3.1))
    assert held(found, Truth(*at)) == {"height": Held(within=1), "focal length": Held(outside=1)}
    loose = replace(found, prior_sigma=np.sqrt(np.diag(found.covariance)))
    both = total([held(loose, Truth(*at)), held(found, Truth(*at))])
    assert both["focal length"] == Held(undetermined=1, outside=1)
    assert str(both["height"]) == "1 / 1 / 0"


def test_passing_targets_are_what_they_are_said_to_be(model: Georeferencer) -> None:
    inputs = passing_targets(7, 100)
    assert len(inputs.correspondences) == 100
    assert np.unique(inputs.correspondences.recording).size == 7
    found = held(camera_fit(model), TRUTH)
    assert not any(one.outside for one in found.values())


def test_a_split_is_fitted_and_scored(tmp_path: Path) -> None:
    folder = tmp_path / "harbour" / "id"
    made = simulate(
        folder,
        SimulationSettings(seed=3, recordings=2, duration_s=30.0, video=False, clock="exact"),
    )
    for name in ("train.toml", "test.toml"):
        (folder / name).write_bytes(made.scene.read_bytes())
    ((found, model),) = score(folder, ["camera"]).values()
    assert found.n > 50
    assert found.placed == 1.0
    assert 0.0 < found.median_m <= found.rmse_m < 10.0
    assert found.covered > 0.5
    assert found.fit_s > 0.0
    assert found.homography_m > 0.0
    assert model.camera is not None
