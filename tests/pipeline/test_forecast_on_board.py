"""Forecasts from a vessel under way are by what was known at their moment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import pytest

from sightline import Georeferencer, iter_tracks
from sightline.camera.state import ObservedBoxes
from sightline.geodesy import LocalPlane
from sightline.platform import POSITION_SIGMA_M, Platform
from sightline.types import BodyPositions, Boxes, Fixes, FloatArray, Headings, LocatedBoxes, Track

PLANE = LocalPlane(54.0, 10.0)
SIZE_PX = (4000, 3000)
UNTIL_S = 60
WAY_MPS, TARGET_MPS = np.array([1.5, 2.0]), np.array([-1.0, 0.5])
BEGIN_M = np.array([60.0, 200.0])


@dataclass(frozen=True)
class OnBoard:
    """A camera on a vessel, looking straight down: ten pixels of a box's foot are a metre."""

    plane: LocalPlane = PLANE
    image_size_px: tuple[int, int] = SIZE_PX
    camera: None = None
    horizon_px: None = None
    moving: bool = True

    def check_water(self, given: bool) -> None:
        assert not given

    def compensated(self, boxes: ObservedBoxes) -> ObservedBoxes:
        return boxes

    def place_compensated(self, boxes: ObservedBoxes) -> LocatedBoxes:
        xyxy, n = boxes.xyxy_px, len(boxes)
        positions = BodyPositions(
            starboard_m=0.1 * (0.5 * (xyxy[:, 0] + xyxy[:, 2]) - 0.5 * SIZE_PX[0]),
            ahead_m=0.1 * (SIZE_PX[1] - xyxy[:, 3]),
            covariance_m2=np.tile(0.04 * np.eye(2), (n, 1, 1)),
            extrapolated=np.zeros(n, dtype=bool),
            plane=self.plane,
        )
        return LocatedBoxes.at(boxes, positions)


def logs(bow_rad: float) -> tuple[Fixes, Headings, Boxes]:
    """Two minutes of a vessel whose receiver is off for a while, and what it saw in the first."""
    times = np.arange(0.0, 2 * UNTIL_S + 1.0)
    off = POSITION_SIGMA_M * np.random.default_rng(0).standard_normal((times.size, 2))
    for i in range(1, len(off)):
        off[i] = np.exp(-0.05) * off[i - 1] + np.sqrt(1.0 - np.exp(-0.1)) * off[i]
    fixes = Fixes(times, *PLANE.to_geographic(*(times[:, None] * WAY_MPS + off).T))
    seen_s = times[: UNTIL_S + 1 : 2]
    away = BEGIN_M + seen_s[:, None] * (TARGET_MPS - WAY_MPS)
    sine, cosine = np.sin(bow_rad), np.cos(bow_rad)
    starboard = cosine * away[:, 0] - sine * away[:, 1]
    ahead = sine * away[:, 0] + cosine * away[:, 1]
    x, y = 10.0 * starboard + 0.5 * SIZE_PX[0], SIZE_PX[1] - 10.0 * ahead
    boxes = Boxes.of(np.stack([x - 20, y - 20, x + 20, y], axis=1), time_utc_s=seen_s, track_id=1)
    return fixes, Headings(times, np.full(times.size, np.degrees(bow_rad) % 360.0)), boxes


def forecast(boxes: Boxes, fixes: Fixes, headings: Headings | None) -> Track:
    told: list[Track] = []
    platform = Platform(fixes, headings)
    list(
        iter_tracks(boxes, cast(Georeferencer, OnBoard()), platform=platform, forecasts=told.append)
    )
    (one,) = told
    return one


def until(fixes: Fixes, headings: Headings) -> tuple[Fixes, Headings]:
    """Logs that end with the last picture."""
    n = UNTIL_S + 1
    return (
        Fixes(fixes.time_utc_s[:n], fixes.latitude_deg[:n], fixes.longitude_deg[:n]),
        Headings(headings.time_utc_s[:n], headings.heading_deg[:n]),
    )


def places(track: Track) -> FloatArray:
    return np.stack([track.east_m, track.north_m], axis=1)


@pytest.mark.parametrize("with_headings", [True, False])
def test_later_fixes_of_the_vessel_change_no_forecast(with_headings: bool) -> None:
    fixes, headings, boxes = logs(float(np.arctan2(*WAY_MPS)))
    early_fixes, early_headings = until(fixes, headings)
    one = forecast(boxes, early_fixes, early_headings if with_headings else None)
    other = forecast(boxes, fixes, headings if with_headings else None)
    assert len(one) > 5
    np.testing.assert_allclose(places(one), places(other), atol=1e-6)
    np.testing.assert_allclose(one.covariance_m2, other.covariance_m2, rtol=1e-6)
    # And they tell where the target goes, whichever way the vessel does.
    true = BEGIN_M + one.time_utc_s[:, None] * TARGET_MPS
    distance_m = np.hypot(*(places(one) - true).T)
    assert (distance_m < 3.5 * np.sqrt(np.linalg.eigvalsh(one.covariance_m2)[:, 1])).all()


def test_a_fix_that_is_changed_before_the_last_picture_does() -> None:
    """The test above would pass were the vessel's log not looked at."""
    fixes, headings, boxes = logs(0.3)
    latitude = fixes.latitude_deg.copy()
    latitude[UNTIL_S - 10 : UNTIL_S] += 2e-5
    changed = Fixes(fixes.time_utc_s, latitude, fixes.longitude_deg)
    one, other = forecast(boxes, fixes, headings), forecast(boxes, changed, headings)
    assert np.abs(places(one) - places(other)).max() > 0.5
