"""A camera that was turned, before a shore that is known."""

import cv2
import numpy as np
import pytest

from sightline.camera.motion import CameraMotionDetector
from sightline.errors import InputError
from sightline.types import Frame

FOCAL_PX = 900.0
SIZE = (640, 360)


def frames(seed, turn_at_s=None, turn_deg=(0.0, 0.0, 0.0), duration_s=32.0, rate_hz=2.0):
    """Sky, a shore with houses, waves and a passing boat; turned about the middle of the image."""
    rng = np.random.default_rng(seed)
    wide = np.full((400, 760), 210.0)
    for _ in range(140):
        x, high = rng.integers(0, 740), rng.integers(3, 22)
        wide[200 - high : 200, x : x + rng.integers(4, 20)] = rng.uniform(60, 190)
    for i in range(int(duration_s * rate_hz)):
        time = i / rate_hz
        heading, pitch, roll = turn_deg if turn_at_s is not None and time >= turn_at_s else (0,) * 3
        image = wide.copy()
        image[200:] = 110.0 + cv2.GaussianBlur(rng.normal(0.0, 30.0, (200, 760)), (0, 0), 2.0)
        x = int(700 - 15.0 * time) % 700
        image[180:214, x : x + 60] = 250.0
        move = cv2.getRotationMatrix2D((380.0, 200.0), -roll, 1.0)
        move[:, 2] -= np.radians([heading, pitch]) * FOCAL_PX
        image = cv2.warpAffine(image, move, (760, 400), flags=cv2.INTER_LINEAR)
        image = image[20:380, 60:700] + rng.normal(0.0, 3.0, (360, 640))
        grey = np.clip(image, 0, 255).astype(np.uint8)
        yield Frame(i, 1000.0 + time, np.repeat(grey[:, :, None], 3, axis=2))


def turns(seed, **world):
    watch = CameraMotionDetector((180.0, 180.0), FOCAL_PX)
    return [turn for frame in frames(seed, **world) if (turn := watch.update(frame)) is not None]


@pytest.mark.parametrize(
    "turn_deg", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-0.6, 0.5, 0.0)]
)
def test_a_turn_in_mid_recording_is_reported_within_seconds_and_measured(turn_deg):
    found = turns(0, turn_at_s=20.0, turn_deg=turn_deg)
    assert len(found) == 1
    assert 1020.0 < found[0].time_utc_s < 1026.0
    measured = (found[0].heading_deg, found[0].pitch_deg, found[0].roll_deg)
    np.testing.assert_allclose(measured, turn_deg, atol=0.15)


def test_the_first_static_interval_has_no_beginning_and_starts_anew_after_a_reset():
    watch = CameraMotionDetector((180.0, 180.0), FOCAL_PX)
    for seed in range(2):
        for frame in frames(seed, duration_s=16.0, rate_hz=1.0):
            watch.update(frame)
        (only,) = watch.static_intervals
        assert (only.before_utc_s, only.since_utc_s) == (-np.inf, -np.inf)
        watch.reset()
        assert watch.static_intervals == ()
        # Without a reference, no time is known up to which nothing happened.
        assert watch.settled_utc_s == -np.inf


@pytest.mark.slow
def test_no_alarm_in_undisturbed_recordings():
    assert sum(len(turns(seed, rate_hz=1.0)) for seed in range(20)) == 0


def test_pictures_too_small_and_settings_that_are_none_are_refused():
    watch = CameraMotionDetector((10.0, 10.0), 100.0)
    with pytest.raises(InputError, match="too small"):
        watch.update(Frame(0, 0.0, np.zeros((30, 640, 3), np.uint8)))
    with pytest.raises(InputError, match="must be positive"):
        CameraMotionDetector((10.0, 10.0), 0.0)
