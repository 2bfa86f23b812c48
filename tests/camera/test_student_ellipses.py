"""Ellipses of noise that few targets told are those of Student's distribution."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, f

from sightline.camera.calibration import CameraFit
from sightline.camera.priors import PixelNoise


def fit_of(targets: int) -> CameraFit:
    nothing = np.empty(0)
    return CameraFit(
        vector=np.zeros(16),
        covariance=np.eye(16),
        prior_sigma=np.ones(16),
        clock_groups=np.empty(0, dtype=np.int64),
        noise=PixelNoise(),
        image_size_px=(1280, 720),
        residual_px=np.empty((0, 2)),
        standard_residual=nothing,
        leverage=nothing,
        outlier=np.empty(0, dtype=np.bool_),
        starts_agreeing=1,
        starts=1,
        typical_range_m=1.0,
        targets=targets,
    )


@pytest.mark.parametrize("targets", [1, 2, 7, 30, 1000])
def test_95_percent_of_errors_of_a_noise_from_few_targets_are_inside(targets: int) -> None:
    # Hotelling: two dimensions, and one more target than were seen for what is known before.
    expected = 2.0 * f(2, targets + 1).ppf(0.95) / chi2(2).ppf(0.95)
    assert fit_of(targets).student == pytest.approx(expected, rel=1e-9)


def test_noise_that_is_known_makes_no_ellipse_wider() -> None:
    assert replace(fit_of(7), targets=0).student == 1.0
