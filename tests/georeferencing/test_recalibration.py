"""A camera that was turned after its model was fitted, told by boxes and a log."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.fit import FitInputs, FitSettings, fit
from sightline.georeferencing.recalibration import camera_changes
from sightline.simulation import BoxNoise, Harbour, HarbourSettings
from sightline.types import ControlPoints


def harbour_pairs(harbour, seed_px, times):
    boxes = harbour.boxes(times, noise=BoxNoise(std_px=seed_px, correlation_time_s=1.0))
    truth = harbour.truth(boxes.time_utc_s)
    return Correspondences(
        boxes=boxes,
        recording=np.full(len(boxes), "one"),
        east_north_m=np.stack([truth.east_m, truth.north_m], axis=1),
        velocity_mps=np.stack([truth.velocity_east_mps, truth.velocity_north_mps], axis=1),
        asked=len(boxes),
        plane=harbour.plane,
    )


def model_of(harbour, pairs):
    nothing = ControlPoints(np.empty((0, 2)), np.empty(0), np.empty(0))
    size = harbour.camera.image_size_px
    return fit(FitInputs(pairs, size, nothing), FitSettings("camera"))


@pytest.mark.slow
def test_a_turn_in_mid_recording_is_dated_and_measured_and_none_is_seen_without():
    alarms = 0
    for seed in range(4):
        harbour = Harbour.random(seed, HarbourSettings(duration_s=240.0))

        pairs = harbour_pairs(harbour, 1.0, harbour.times(rate_hz=1.0))
        model = model_of(harbour, pairs[::2])
        alarms += len(camera_changes(model, pairs[1::2]))
        # A turn to the right moves all columns to the left, by the focal length in the middle.
        turned_at = float(np.quantile(pairs.boxes.time_utc_s, 0.5))
        shifted = pairs.boxes.xyxy_px.copy()
        after = pairs.boxes.time_utc_s >= turned_at
        shift = harbour.camera.focal_length_px * np.tan(np.radians(1.0))
        shifted[after, 0::2] -= shift
        kept = shifted[:, 2] > 20.0
        shifted[:, 0] = np.minimum(shifted[:, 0], shifted[:, 2] - 1.0)
        boxes = pairs.boxes.with_columns(xyxy_px=shifted)
        found = camera_changes(model, replace(pairs, boxes=boxes)[kept])
        assert len(found) == 1
        assert abs(found[0].since_utc_s - turned_at) < 20.0
        assert found[0].heading_deg == pytest.approx(1.0, abs=0.4)
    assert alarms == 0
