"""Two hypotheses of where a camera stands, of cameras that are linear: there all is exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sightline.camera.calibration import CameraFit
from sightline.camera.parameters import HEADING, LOG_FOCAL, NORTH, POSITION, ParameterLayout
from sightline.camera.priors import CameraPrior, PixelNoise
from sightline.camera.restricted_likelihood import RestrictedLikelihood, negative_log_evidence
from sightline.camera.stated_place import (
    WRONG_PLACE_SHARE,
    WRONG_PLACE_SIGMA_M,
    astray,
    doubtful,
    elsewhere,
    in_words,
    mixed,
    relaxed,
    share_elsewhere,
)
from sightline.types import FloatArray

SIZE = ParameterLayout(1, 0).size
ROWS = 40


def data(seed: int, place_m: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """A matrix and observations with unit noise, linear in the parameters; the rest is at zero."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(ROWS, SIZE))
    # Two of the parameters look like the place.
    matrix[:, POSITION] = 0.05 * matrix[:, [HEADING, LOG_FOCAL]] + 0.02 * matrix[:, POSITION]
    return matrix, matrix[:, POSITION] @ place_m + rng.normal(size=ROWS)


def fitted(matrix: FloatArray, observed: FloatArray, position_sigma_m: float) -> CameraFit:
    """The posterior of a linear model, and the density of the data under it, in closed form."""
    sigma = np.ones(SIZE)
    sigma[POSITION] = position_sigma_m
    covariance = np.linalg.inv(matrix.T @ matrix + np.diag(sigma**-2.0))
    whole = np.eye(ROWS) + matrix @ np.diag(sigma**2) @ matrix.T
    nothing = np.empty(0)
    return CameraFit(
        vector=covariance @ matrix.T @ observed,
        covariance=covariance,
        prior_sigma=sigma,
        clock_groups=np.empty(0, dtype=np.int64),
        noise=PixelNoise(),
        image_size_px=(1280, 720),
        residual_px=np.empty((0, 2)),
        standard_residual=nothing,
        leverage=nothing,
        outlier=np.empty(0, dtype=np.bool_),
        starts_agreeing=1,
        starts=1,
        typical_range_m=1000.0,
        negative_log_evidence=-float(multivariate_normal(np.zeros(ROWS), whole).logpdf(observed)),
    )


@pytest.mark.parametrize("seed", range(3))
def test_densities_under_two_priors_differ_as_those_of_gaussians(seed: int) -> None:
    matrix, observed = data(seed, (40.0, -60.0))
    noise = PixelNoise(row_px=1.0, column_px=1.0)
    at = np.random.default_rng(seed).normal(size=SIZE)
    found, expected = [], []
    for sigma_m in (3.0, 300.0):
        one = fitted(matrix, observed, sigma_m)
        expected.append(one.negative_log_evidence)
        likelihood = RestrictedLikelihood(
            residual_px=(observed - matrix @ at).reshape(-1, 2),
            jacobian=matrix.reshape(-1, 2, SIZE),
            by_point=np.zeros((ROWS // 2, 2, 3)),
            pixels_per_metre=np.zeros(ROWS // 2),
            is_box=np.ones(ROWS // 2, dtype=np.bool_),
            known_m2=np.zeros(ROWS // 2),
            weight=np.ones((ROWS // 2, 2)),
            blocks=[],
            half_lengths_m=np.zeros((ROWS // 2, 2)),
            precision=np.diag(one.prior_sigma**-2.0),
            off_mean=at,
        )
        found.append(negative_log_evidence(likelihood, noise))
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], rel=1e-6)


WIDE_M = elsewhere(None).position_sigma_m


@pytest.mark.parametrize("seed", range(5))
def test_a_linear_camera_is_the_same_relaxed_and_fitted_under_the_wide_prior(seed: int) -> None:
    matrix, observed = data(seed, (40.0, -60.0))
    one = relaxed(fitted(matrix, observed, 3.0))
    other = fitted(matrix, observed, WIDE_M)
    np.testing.assert_allclose(one.vector, other.vector, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(one.prior_sigma, other.prior_sigma)


def test_a_fit_less_sure_of_the_place_than_its_prior_is_relaxed_to_a_wide_one() -> None:
    # No linear camera is; noise that was estimated once more can make one.
    one = fitted(np.zeros((ROWS, SIZE)), np.zeros(ROWS), 3.0)
    found = relaxed(replace(one, covariance=1.2 * one.covariance)).covariance[POSITION, POSITION]
    assert np.all(np.linalg.eigvalsh(found) >= WRONG_PLACE_SIGMA_M**2)
    assert np.all(np.linalg.eigvalsh(found) <= (1.3 * WRONG_PLACE_SIGMA_M) ** 2)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("place_m", [(0.0, 0.0), (15.0, 10.0), (40.0, -60.0), (0.0, 250.0)])
def test_a_fit_is_doubted_as_far_as_bayes_factor_says(
    seed: int, place_m: tuple[float, float]
) -> None:
    matrix, observed = data(seed, place_m)
    stated, wide = fitted(matrix, observed, 3.0), fitted(matrix, observed, WIDE_M)
    gain = stated.negative_log_evidence - wide.negative_log_evidence
    log_share = np.log(WRONG_PLACE_SHARE / (1.0 - WRONG_PLACE_SHARE))
    assert doubtful(stated) == (gain > log_share - 3.0)
    odds = np.exp(gain + log_share)
    stated, wide = replace(stated, left_out_m=2.0), replace(wide, left_out_m=1.0)
    assert share_elsewhere(wide, stated) == pytest.approx(odds / (1.0 + odds), abs=1e-9)
    assert not astray(wide, stated)


def test_the_place_is_not_taken_for_wrong_where_left_out_targets_speak_against_it() -> None:
    matrix, observed = data(0, (40.0, -60.0))
    stated, wide = fitted(matrix, observed, 3.0), fitted(matrix, observed, WIDE_M)
    worse = share_elsewhere(replace(wide, left_out_m=2.0), replace(stated, left_out_m=1.0))
    assert worse == WRONG_PLACE_SHARE
    said = in_words(wide, worse, taken=False)
    assert "not sure enough to be used" in said


def test_of_a_single_target_the_density_has_to_be_much_higher() -> None:
    matrix, observed = data(0, (40.0, -60.0))
    wide = fitted(matrix, observed, WIDE_M)
    for gain, share in ((15.0, WRONG_PLACE_SHARE), (30.0, 1.0)):
        stated = replace(wide, negative_log_evidence=wide.negative_log_evidence + gain)
        assert share_elsewhere(wide, stated) == share


def test_a_fit_that_lost_more_than_its_prior_is_wide_went_astray() -> None:
    matrix, observed = data(0, (0.0, 0.0))
    stated, wide = fitted(matrix, observed, 3.0), fitted(matrix, observed, WIDE_M)
    lost = replace(wide, negative_log_evidence=stated.negative_log_evidence + 9.3 + 3.0)
    assert astray(lost, stated)
    assert not astray(lost, None)


def test_a_mixture_has_the_moments_of_draws_from_both() -> None:
    matrix, observed = data(3, (40.0, -60.0))
    stated, wide = fitted(matrix, observed, 3.0), fitted(matrix, observed, WIDE_M)
    rng, n = np.random.default_rng(5), 200_000
    draws = np.where(
        (rng.uniform(size=n) < 0.3)[:, None],
        rng.multivariate_normal(wide.vector, wide.covariance, n),
        rng.multivariate_normal(stated.vector, stated.covariance, n),
    )
    off = draws - stated.vector
    expected = off.T @ off / n
    size = np.sqrt(np.diag(expected))
    found = mixed(stated, wide, 0.3)
    np.testing.assert_allclose(
        found.covariance / np.outer(size, size), expected / np.outer(size, size), atol=0.02
    )
    np.testing.assert_array_equal(found.vector, stated.vector)


def test_headings_on_both_sides_of_north_are_near_one_another() -> None:
    matrix, observed = data(3, (0.0, 0.0))
    stated = fitted(matrix, observed, 3.0)
    stated.vector[HEADING] = 0.01
    other = replace(stated, vector=stated.vector.copy())
    other.vector[HEADING] = 2.0 * np.pi - 0.01
    added = (mixed(stated, other, 0.5).covariance - stated.covariance)[HEADING, HEADING]
    assert added == pytest.approx(0.5 * 0.02**2)


def test_a_wide_prior_is_as_wide_as_is_said_and_else_the_same() -> None:
    own = CameraPrior(height_m=8.0, position_sigma_m=40.0)
    wide = elsewhere(own)
    assert wide.position_sigma_m == pytest.approx(np.hypot(40.0, WRONG_PLACE_SIGMA_M))
    assert replace(wide, position_sigma_m=40.0) == own


def test_what_is_said_tells_how_far_and_in_which_direction() -> None:
    matrix, observed = data(0, (0.0, 0.0))
    wide = fitted(matrix, observed, WIDE_M)
    wide.vector[POSITION] = -150.0, 150.0 * np.sqrt(3.0)
    wide.covariance[POSITION, POSITION] = np.diag([40.0, 20.0]) ** 2
    said = in_words(wide, 1.0, taken=True)
    # Along the direction: 0.25 of the variance east and 0.75 of that north.
    assert "300 ± 26 m to the north-west (bearing 330°)" in said
    assert not in_words(wide, 0.01, taken=False)
    wide.covariance[NORTH, NORTH] = 200.0**2
    assert "within some 200 m" in in_words(wide, 0.01, taken=False)
