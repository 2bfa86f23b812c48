"""Ranges that are multiplied by their errors, beside drawn ones."""

import numpy as np
import pytest

from sightline.georeferencing.one_box import ranges_variance


@pytest.mark.parametrize("relative", [0.01, 0.2, 0.5, 0.9])
def test_the_spread_about_the_likeliest_range_is_that_of_log_normal_draws(relative: float) -> None:
    draws = np.exp(np.random.default_rng(1).normal(0.0, relative, 2_000_000))
    expected = 200.0**2 * np.mean((draws - 1.0) ** 2)
    assert ranges_variance((200.0 * relative) ** 2, 200.0) == pytest.approx(expected, rel=0.02)
