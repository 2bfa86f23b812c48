"""Ellipses after a fit to a handful of targets, beside drawn errors."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.georeferencing.camera_regressor import (
    LEAST_FREEDOM,
    CameraRegressor,
    student_share,
)

INSIDE = 5.991
"""Square of a normal error in the plane that 95 % do not reach."""


@pytest.mark.parametrize("targets", [6, 8, 16, 60])
def test_ellipses_by_an_estimated_scatter_hold_95_percent(targets: int) -> None:
    rng = np.random.default_rng(targets)
    scatter = np.sqrt(np.mean(rng.normal(0.0, 3.0, (400_000, targets)) ** 2, axis=1))
    square = np.sum(rng.normal(0.0, 3.0, (400_000, 2)) ** 2, axis=1) / scatter**2
    assert np.mean(square < INSIDE * student_share(targets)) == pytest.approx(0.95, abs=0.002)
    # As if the scatter were known they hold fewer.
    assert (np.mean(square < INSIDE) < 0.94) == (targets < 60)


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
    known, few = (model.with_fit(replace(model.fit_, targets=count)) for count in (0, 7))
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
