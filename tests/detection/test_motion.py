from collections.abc import Iterator

import numpy as np
import pytest

from sightline.detection import MotionDetector, MotionSettings, detector_by_name
from sightline.errors import InputError
from sightline.simulation import Harbour, HarbourSettings, Renderer, SimulatedCamera
from sightline.types import Boxes, Frame


def _iou(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = np.clip(high - low, 0.0, None).prod(axis=2)
    area = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (first, second)]
    return shared / (area[0][:, None] + area[1][None, :] - shared)


def _square_on_noise(rate_hz: float, *, flicker: bool = False) -> Iterator[tuple[Frame, list]]:
    """A light square of 24 x 16 px at 30 px/s over noisy water, and where it is."""
    rng = np.random.default_rng(1)
    water = rng.integers(60, 90, (200, 320, 3))
    for i in range(int(10.0 * rate_hz)):
        image = water + rng.integers(-4, 5, water.shape)
        if flicker:
            glints = rng.random((60, 100)) < 0.15
            image[120:180, 20:120][glints] = 250
        left = 10 + 30.0 * i / rate_hz
        box = [round(left), 100, round(left) + 24, 116]
        image[box[1] : box[3], box[0] : min(box[2], 320)] = 200
        yield Frame(i, 1e9 + i / rate_hz, image.clip(0, 255).astype(np.uint8)), box


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 12.0, 25.0])
def test_a_moving_square_is_boxed_to_the_pixel_at_any_frame_rate(rate_hz: float) -> None:
    detector = MotionDetector()
    found = wanted = 0
    for frame, box in _square_on_noise(rate_hz):
        boxes = detector.detect(frame)
        if frame.time_utc_s < 1e9 + 3.0 or box[2] > 310:
            continue
        wanted += 1
        assert len(boxes) <= 1
        if len(boxes):
            found += 1
            np.testing.assert_allclose(boxes.xyxy_px[0], box, atol=2.0)
            assert boxes.frame[0] == frame.index
            assert boxes.time_utc_s[0] == frame.time_utc_s
            assert boxes.source[0] == "motion"
    assert found > 0.95 * wanted


def test_glitter_is_no_boat() -> None:
    detector = MotionDetector()
    in_glitter = 0
    for frame, _ in _square_on_noise(12.0, flicker=True):
        boxes = detector.detect(frame).xyxy_px
        if frame.time_utc_s > 1e9 + 4.0:
            in_glitter += int((boxes[:, 3] > 122).sum())
    assert in_glitter == 0


def test_nothing_is_found_above_the_horizon() -> None:
    for horizon, expected in (((160.0, 160.0), False), ((90.0, 90.0), True)):
        detector = MotionDetector(horizon_px=horizon, above_horizon_px=5.0)
        found = [len(detector.detect(frame)) > 0 for frame, _ in _square_on_noise(10.0)]
        assert any(found) == expected


def test_a_reset_begins_anew() -> None:
    detector, fresh = MotionDetector(), MotionDetector()
    frames = [frame for frame, _ in _square_on_noise(8.0)]
    for frame in frames:
        detector.detect(frame)
    detector.reset()
    for frame in frames:
        np.testing.assert_array_equal(detector.detect(frame).xyxy_px, fresh.detect(frame).xyxy_px)


def test_frames_without_times_and_still_pictures_are_taken() -> None:
    detector = MotionDetector()
    still = np.full((90, 160, 3), 120, np.uint8)
    for i in range(20):
        assert len(detector.detect(Frame(i, float("nan"), still))) == 0


def test_detectors_have_names() -> None:
    assert isinstance(detector_by_name("motion", horizon_px=(10.0, 12.0)), MotionDetector)
    with pytest.raises(InputError, match="unknown detector 'yolo'; known are motion"):
        detector_by_name("yolo")
    with pytest.raises(InputError, match="positive"):
        MotionSettings(memory_s=0.0)


@pytest.fixture(scope="module")
def harbour() -> Harbour:
    camera = SimulatedCamera(5.0, 3.0, 0.5, 40.0, 470.0, k1=-0.2, k2=0.03, image_size_px=(640, 360))
    return Harbour.random(
        5,
        HarbourSettings(
            duration_s=25.0, camera=camera, motorboats=3, sailboats=1, ferries=1, anchored=1
        ),
    )


@pytest.fixture(scope="module")
def detections(harbour: Harbour) -> Boxes:
    renderer = Renderer(harbour)
    left, right = harbour.camera.horizon_px([0.0, 640.0])
    detector = MotionDetector(horizon_px=(float(left), float(right)), above_horizon_px=20.0)
    found = [
        detector.detect(Frame(i, float(time_s), renderer.image(float(time_s))))
        for i, time_s in enumerate(harbour.times(8.0))
    ]
    return Boxes.concatenate(found)


@pytest.mark.slow
def test_boats_in_a_harbour_are_found(harbour: Harbour, detections: Boxes) -> None:
    times = harbour.times(8.0)
    true = harbour.boxes(times, of="moving")
    everything = harbour.boxes(times, of="all")
    size = true.xyxy_px[:, 2:] - true.xyxy_px[:, :2]
    true = true[(size[:, 0] >= 10.0) & (size[:, 1] >= 7.0) & (true.frame >= 48)]
    detections = detections[detections.frame >= 48]
    hit, right, low = [], [], []
    for frame in range(48, times.size):
        found = detections.xyxy_px[detections.frame == frame]
        wanted = true.xyxy_px[true.frame == frame]
        if not len(found):
            hit += [False] * len(wanted)
            continue
        overlap = _iou(wanted, found)
        hit += (overlap.max(axis=1, initial=0.0) >= 0.3).tolist()
        near = overlap.max(axis=1, initial=0.0) >= 0.5
        low += (found[overlap.argmax(axis=1), 3] - wanted[:, 3])[near].tolist()
        seen = everything.xyxy_px[everything.frame == frame]
        right += (_iou(found, seen).max(axis=1, initial=0.0) >= 0.3).tolist()
    assert len(hit) > 400
    assert np.mean(hit) > 0.75
    assert np.mean(right) > 0.65
    # The lower edge is what a georeferencer needs.
    assert abs(np.mean(low)) < 2.0
