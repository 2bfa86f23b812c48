"""A plan beside what a fit then finds of the simulated camera that was planned."""

from __future__ import annotations

import numpy as np
import pytest

import planning


@pytest.mark.slow
def test_the_fit_finds_what_was_planned() -> None:
    """A zigzag tells a camera fully, so that noise hardly moves what is known of it."""
    one = planning.case(2)
    assert one.pattern == "zigzag"
    assert one.boxes > 200
    # Two thirds of the water or more have a position by both.
    assert np.mean(np.isfinite(one.planned_m) & np.isfinite(one.reached_m)) > 0.66
    assert 0.75 < one.ratio < 1.25
    assert one.missed <= one.by_chance
