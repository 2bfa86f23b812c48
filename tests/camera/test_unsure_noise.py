"""What it adds to a fit that its noise is estimated, beside the posterior taken by samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sightline.camera.priors import NOISE_PRIORS, PixelNoise
from sightline.camera.restricted_likelihood import (
    RestrictedLikelihood,
    most_probable_noise,
    of_unsure_noise,
)
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.observations import CameraObservations
from sightline.types import FloatArray

WHITE = ("row_px", "row_m", "column_px", "place_m")


def few(boxes: int, seed: int = 0) -> RestrictedLikelihood:
    """The residuals of some boxes without times, of which rows tell one parameter and columns
    another, both without a prior to speak of."""
    rng = np.random.default_rng(seed)
    jacobian = np.zeros((boxes, 2, 2))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = 1.0, rng.uniform(0.5, 1.5, boxes)
    by_point = np.zeros((boxes, 2, 3))
    by_point[:, 0, 0], by_point[:, 1, 1], by_point[:, 1, 2] = 2.0, -0.2, 2.0
    return RestrictedLikelihood(
        residual_px=rng.normal(0.0, (4.0, 3.0), (boxes, 2)),
        jacobian=jacobian,
        by_point=by_point,
        pixels_per_metre=np.full(boxes, 2.0),
        is_box=np.ones(boxes, dtype=bool),
        known_m2=np.zeros(boxes),
        weight=np.ones((boxes, 2)),
        blocks=[],
        half_lengths_m=np.zeros((boxes, 2)),
        precision=1e-6 * np.eye(2),
        off_mean=np.zeros(2),
    )


def sampled(likelihood: RestrictedLikelihood, noise: PixelNoise) -> FloatArray:
    """(2, 2) mean covariance and covariance of the mean, by weighted samples of the noise."""
    centre = np.log([getattr(noise, name) for name in WHITE])

    def value(logs: FloatArray) -> tuple[float, PixelNoise]:
        at = replace(noise, **dict(zip(WHITE, np.exp(logs).tolist(), strict=True)))
        beliefs = [NOISE_PRIORS[n].penalty(log)[0] for n, log in zip(WHITE, logs, strict=True)]
        return likelihood(at)[0] + sum(beliefs), at

    rng = np.random.default_rng(1)
    weights, means, covariances = [], [], []
    lowest = value(centre)[0]
    for off in rng.normal(0.0, 1.0, (6000, 4)):
        negative_log, at = value(centre + off)
        weights.append(np.exp(lowest - negative_log + 0.5 * off @ off))
        _, step, covariance = likelihood.estimate(at)
        means.append(step)
        covariances.append(covariance)
    share = np.array(weights) / np.sum(weights)
    spread = np.array(means) - share @ np.array(means)
    out: FloatArray = np.einsum("s,sij->ij", share, np.array(covariances))
    return out + np.einsum("s,si,sj->ij", share, spread, spread)


@pytest.mark.parametrize("boxes", [6, 12])
def test_the_doubt_is_that_of_the_posterior_of_the_noise(boxes: int) -> None:
    likelihood = few(boxes)
    noise = most_probable_noise(likelihood, PixelNoise())
    known = np.diag(likelihood.estimate(noise)[2])
    found = np.diag(of_unsure_noise(likelihood, noise)) / known
    true = np.diag(sampled(likelihood, noise)) / known - 1.0
    assert true.min() > 0.1
    np.testing.assert_allclose(found, true, rtol=0.25)


def test_noise_that_many_boxes_tell_adds_nothing() -> None:
    shares = []
    for boxes in (6, 400):
        likelihood = few(boxes)
        noise = most_probable_noise(likelihood, PixelNoise())
        added = np.diag(of_unsure_noise(likelihood, noise))
        shares.append(added / np.diag(likelihood.estimate(noise)[2]))
    assert (shares[0] > 0.2).all()
    assert (shares[1] < 0.03).all()


def test_where_all_go_one_way_it_is_open_to_which_side_of_a_receiver_its_middle_is() -> None:
    """A receiver that stands ahead of the middle turns the camera, and no other error tells."""
    rng = np.random.default_rng(3)
    spread = {}
    for kind, ways in (("one way", [1.0] * 6), ("both ways", [1.0, -1.0] * 3)):
        time_s = np.linspace(-8.0, 8.0, 9)
        distance_m = rng.uniform(180.0, 220.0, 6)
        east_m = np.concatenate([4.0 * way * time_s for way in ways])
        north_m = np.repeat(distance_m, time_s.size)
        column = 640.0 + 1000.0 * east_m / north_m
        row, half_px = 360.0 + 8000.0 / north_m, 9000.0 / north_m
        boxes = np.stack([column - half_px, row - 30.0, column + half_px, row], axis=1)
        boxes += rng.normal(0.0, 0.5, boxes.shape)
        velocity = np.stack([np.repeat(4.0 * np.array(ways), time_s.size), 0.0 * east_m], axis=1)
        vessel = np.repeat([f"v{i}" for i in range(6)], time_s.size)
        model = CameraRegressor(residual=False, starts=2).fit_observations(
            CameraObservations(
                boxes,
                np.stack([east_m, north_m], axis=1),
                velocity_mps=velocity,
                time_s=np.concatenate([time_s + 100.0 * i for i in range(6)]),
                vessel=vessel,
            )
        )
        assert model.fit_.sizes is not None
        assert model.fit_.sizes.half_length_m == pytest.approx(9.0, rel=0.2)
        spread[kind] = model.fit_.noise.middle_m
    # Before any data it is 0.4 of half a length of 9 m; afterwards the mean of six receivers, each
    # 0.3 of half a length from where such stand, and of six clocks.
    assert 2.5 < spread["one way"] < 4.0
    assert spread["both ways"] < 2.0
