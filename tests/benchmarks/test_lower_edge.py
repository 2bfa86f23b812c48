"""How low a detector's boxes end: a planted bias, and that of the detector that ships."""

import numpy as np
import pytest
from _support.lower_edge import Overhang, lower_edge, overhang

from sightline.detection import detector_by_name
from sightline.errors import FitError


def test_a_planted_habit_is_found_though_wakes_are_taken_for_boats():
    rng = np.random.default_rng(0)
    height = rng.uniform(5.0, 80.0, 800)
    harbour = np.repeat(np.arange(16), 50)
    own = rng.normal(0.0, 0.8, 16)[harbour]
    below = 2.5 + 0.16 * height + own + rng.normal(0.0, 0.7, 800)
    wake = rng.random(800) < 0.05
    below[wake] += rng.uniform(10.0, 60.0, int(wake.sum()))
    found = lower_edge(Overhang(height, below, harbour))
    assert found.px == pytest.approx(2.5, abs=0.5)
    assert found.share == pytest.approx(0.16, abs=0.01)
    assert found.spread_px == pytest.approx(0.8, abs=0.3)


def test_boats_are_as_high_as_the_habit_says_of_their_boxes():
    edge = lower_edge(Overhang(np.tile([10.0, 60.0], 20), np.tile([4.0, 9.0], 20), np.zeros(40)))
    # As much is left above as below.
    np.testing.assert_allclose(edge.hull_px(np.array([18.0, 78.0])), [10.0, 60.0])
    np.testing.assert_array_equal(edge.hull_px(np.array([1.0])), [0.0])


@pytest.mark.slow
def test_the_detector_that_ships_says_what_it_does_on_boats_that_nobody_looked_at():
    detector = detector_by_name("harbour")
    seen = overhang(detector, 2, seed=7)
    assert len(seen) >= 20
    told = detector.lower_edge
    off = seen.below_px - told.px - told.share * seen.height_px
    assert abs(np.median(off)) < 3.0 * told.spread_px


def test_too_few_boats_are_refused():
    few = Overhang(np.full(5, 10.0), np.full(5, 4.0), np.zeros(5, dtype=np.int64))
    with pytest.raises(FitError, match="found 5 rendered boats"):
        lower_edge(few)
