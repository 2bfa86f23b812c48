"""Fixes that cannot be where they say, by the boxes around them."""

from __future__ import annotations

import numpy as np
import pytest

from sightline.geodesy import LocalPlane
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.log_weighing import sentences, wrong_fixes
from sightline.georeferencing.placement import Placement
from sightline.types import Boxes, FloatArray

START_UTC_S = 1_717_236_000.0
SIGMA_M = 2.0
EVERY_S = 2.0
PER_S = 2.0


def world(
    error_m: FloatArray, *, drift_m: float = 0.0, seed: int = 0
) -> tuple[Correspondences, Placement]:
    """Boxes that a model places with two metres of noise, beside a log with an error each fix.

    Args:
        error_m: (K, 2) of fixes two seconds apart.
        drift_m: By how much the model is off at last, in a direction that it reaches slowly.
        seed: Of the noise.
    """
    rng = np.random.default_rng(seed)
    fix_s = EVERY_S * np.arange(len(error_m))
    since_s = np.arange(0.25, fix_s[-1], 1.0 / PER_S)
    n = since_s.size
    true = np.stack([4.0 * since_s, 80.0 + 20.0 * np.sin(since_s / 30.0)], axis=1)
    off = np.stack([np.interp(since_s, fix_s, error_m[:, axis]) for axis in (0, 1)], axis=1)
    before = EVERY_S * (since_s // EVERY_S)
    pairs = Correspondences(
        boxes=Boxes.of(
            np.tile([600.0, 400.0, 640.0, 420.0], (n, 1)),
            frame=np.arange(n),
            time_utc_s=START_UTC_S + since_s,
        ),
        recording=np.full(n, "one"),
        east_north_m=true + off,
        velocity_mps=np.zeros((n, 2)),
        asked=n,
        plane=LocalPlane(54.0, 10.0),
        fix_time_utc_s=START_UTC_S + np.stack([before, before + EVERY_S], axis=1),
    )
    slow = np.linspace(0.0, drift_m, n)[:, None] * (1.0, 0.0)
    placed = true + slow + SIGMA_M * rng.normal(size=(n, 2))
    return pairs, Placement(placed, np.tile(SIGMA_M**2 * np.eye(2), (n, 1, 1)))


def errors(count: int = 60) -> FloatArray:
    return np.zeros((count, 2))


@pytest.mark.parametrize("off_m", [15.0, 60.0, 300.0, 3000.0, 6e6])
def test_one_wrong_fix_is_named_and_its_boxes_alone_are_spoilt(off_m: float) -> None:
    wrong = errors()
    wrong[20] = off_m * np.array([0.6, -0.8])
    spoilt, (found,) = wrong_fixes(*world(wrong))
    assert found.time_utc_s == START_UTC_S + 20 * EVERY_S
    assert found.off_m == pytest.approx(off_m, rel=0.2)
    since_s = np.arange(0.25, 59 * EVERY_S, 1.0 / PER_S)
    beside = np.abs(since_s - 20 * EVERY_S) < EVERY_S
    assert not spoilt[~beside].any()
    assert spoilt.sum() == found.boxes >= 0.9 * beside.sum()


@pytest.mark.parametrize("seed", range(8))
def test_a_log_without_wrong_fixes_is_left_alone(seed: int) -> None:
    spoilt, found = wrong_fixes(*world(errors(200), seed=seed))
    assert not found
    assert not spoilt.any()


def test_a_stretch_is_left_out_whole() -> None:
    wrong = errors(200)
    wrong[50:70] = (30.0, 0.0)
    spoilt, found = wrong_fixes(*world(wrong))
    named = {round((fix.time_utc_s - START_UTC_S) / EVERY_S) for fix in found}
    # Those in between lose their boxes to their neighbours.
    assert {50, 69} < named <= set(range(50, 70))
    assert len(named) >= 10
    since_s = np.arange(0.25, 199 * EVERY_S, 1.0 / PER_S)
    inside = (since_s > 50 * EVERY_S) & (since_s < 69 * EVERY_S)
    assert spoilt[inside].all()
    assert not spoilt[(since_s < 49 * EVERY_S) | (since_s > 70 * EVERY_S)].any()
    (said,) = sentences(found)
    assert said.startswith("The fixes from 2024-06-01 10:01:40 to 2024-06-01 10:02:18")


def test_what_a_model_is_off_by_slowly_is_no_error_of_the_log() -> None:
    spoilt, found = wrong_fixes(*world(errors(200), drift_m=60.0))
    assert not found
    assert not spoilt.any()


def test_where_too_many_fixes_look_wrong_the_model_is() -> None:
    wrong = errors(80)
    wrong[::3] = (200.0, 0.0)
    spoilt, found = wrong_fixes(*world(wrong))
    assert not found
    assert not spoilt.any()


def test_a_place_in_a_gap_is_not_wrong_while_the_gap_says_so() -> None:
    """What a motion model is unsure of by so much says nothing against its fix."""
    wrong = errors()
    wrong[20] = (25.0, 0.0)
    pairs, placed = world(wrong)
    unsure = Correspondences(**{**pairs.__dict__, "fix_sigma_m": np.full(len(pairs), 15.0)})
    assert wrong_fixes(pairs, placed)[1]
    assert not wrong_fixes(unsure, placed)[1]


def test_without_the_times_of_fixes_there_is_nothing_to_weigh() -> None:
    wrong = errors()
    wrong[20] = (300.0, 0.0)
    pairs, placed = world(wrong)
    untold = Correspondences(
        **{**pairs.__dict__, "fix_time_utc_s": np.full((len(pairs), 2), np.nan)}
    )
    spoilt, found = wrong_fixes(untold, placed)
    assert not found
    assert not spoilt.any()


def test_only_the_worst_places_are_named() -> None:
    wrong = errors(400)
    for index in range(8):
        wrong[20 + 40 * index] = (50.0 + 10.0 * index, 0.0)
    said = sentences(wrong_fixes(*world(wrong))[1])
    assert len(said) == 6
    assert "120 m" in said[0] or "119 m" in said[0] or "121 m" in said[0]
    assert said[-1] == "So are fixes at 3 more places of the logs."
