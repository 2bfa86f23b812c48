"""Ellipses after a fit to a handful of targets, beside drawn errors."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.camera.mixed_model import MixedModel
from sightline.camera.observations import PointCorrespondences
from sightline.camera.priors import CameraPrior, PixelNoise
from sightline.georeferencing.camera_regressor import (
    LEAST_FREEDOM,
    CameraRegressor,
    student_share,
)


@pytest.mark.parametrize("targets", [6, 8, 16, 60])
def test_errors_by_an_estimated_scatter_vary_as_students(targets: int) -> None:
    rng = np.random.default_rng(targets)
    scatter = np.sqrt(np.mean(rng.normal(0.0, 3.0, (400_000, targets)) ** 2, axis=1))
    error = rng.normal(0.0, 3.0, 400_000) / scatter
    assert np.var(error) == pytest.approx(student_share(targets), rel=0.02)


def test_known_noise_widens_nothing_and_fewer_targets_never_more_than_the_priors() -> None:
    assert student_share(0) == 1.0
    assert student_share(1) == student_share(int(LEAST_FREEDOM)) > student_share(7)


def test_only_what_lasts_and_the_camera_are_wider_after_few_targets() -> None:
    rng = np.random.default_rng(2)
    places = np.stack([rng.uniform(-20.0, 20.0, 60), rng.uniform(40.0, 120.0, 60)], axis=1)
    foot_px = np.stack([640.0 + 900.0 * places[:, 0] / places[:, 1], 300.0 + 7e3 / places[:, 1]], 1)
    foot_px += rng.normal(0.0, 0.5, foot_px.shape)
    boxes = np.tile(foot_px, 2) + np.array([-15.0, -30.0, 15.0, 0.0])
    model = CameraRegressor(residual=False).fit(boxes, places)
    known, few = (model.with_fit(replace(model.fit_, freedom=count)) for count in (0, 7))
    (where, whole, shared), (where_few, whole_few, shared_few) = (
        one.predict(boxes, return_shared=True) for one in (known, few)
    )
    np.testing.assert_array_equal(where, where_few)
    share = np.trace(shared_few, axis1=1, axis2=2) / np.trace(shared, axis1=1, axis2=2)
    assert (share > 1.3).all()
    assert (share < student_share(7) + 1e-9).all()
    np.testing.assert_allclose(whole_few - shared_few, whole - shared, rtol=1e-6, atol=1e-9)
    # One box alone says the same.
    np.testing.assert_allclose(few.predict(boxes[:1], return_cov=True)[1], whole_few[:1], rtol=1e-6)


def test_a_target_counts_once_or_as_often_as_it_is_forgotten() -> None:
    rng = np.random.default_rng(3)
    east, north = rng.uniform(-20.0, 20.0, 40), rng.uniform(40.0, 120.0, 40)
    foot_px = np.stack([640.0 + 900.0 * east / north, 300.0 + 7e3 / north], 1)
    time_s = np.concatenate([np.linspace(0.0, 4.0, 20), np.linspace(0.0, 100.0, 20)])
    log = np.repeat([0, 1], 20)
    sightings = PointCorrespondences(
        foot_px,
        east,
        north,
        source=np.zeros(40, dtype=np.int64),
        group=log,
        velocity_mps=np.zeros((40, 2)),
        sigma_m=np.zeros(40),
        time_s=time_s,
        log=log,
    )
    model = MixedModel(sightings, (1280, 720), 1, CameraPrior(), True, None)
    # Of squares of a process that is forgotten by exp(-t / 20 s), the variance of the mean.
    rng = np.random.default_rng(4)
    step_s, worth = 0.5, []
    for watched_s in (4.0, 100.0):
        steps = int(watched_s / step_s)
        value, sum_of_squares = rng.normal(size=20_000), np.zeros(20_000)
        for _ in range(steps):
            sum_of_squares += value**2
            kept = np.exp(-step_s / 20.0)
            value = kept * value + np.sqrt(1.0 - kept**2) * rng.normal(size=20_000)
        worth.append(2.0 / np.var(sum_of_squares / steps))
    found = model.freedom(PixelNoise(correlation_time_s=20.0))
    assert found == pytest.approx(sum(worth), rel=0.05)
