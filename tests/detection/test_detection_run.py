"""One pass over the pictures of a recording serves all who want to look."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sightline import video
from sightline.camera.shoreline import StillPicture
from sightline.detection import MotionDetector, detect, shown
from sightline.scene import Scene
from sightline.scene.detections import SceneDetections
from sightline.types import Boxes, Frame

SIZE_PX = (320, 240)
FRAMES = 30


class Notes:
    """Remembers the frames that it was shown."""

    def __init__(self) -> None:
        self.index: list[int] = []

    def look(self, frame: Frame) -> None:
        self.index.append(frame.index)


def pictures() -> Iterator[Frame]:
    """A dark boat before a noisy sea."""
    rng = np.random.default_rng(0)
    for i in range(FRAMES):
        image = rng.integers(140, 170, (SIZE_PX[1], SIZE_PX[0], 3), dtype=np.uint8)
        image[150:170, 20 + 8 * i : 60 + 8 * i] = 20
        yield Frame(i, 1000.0 + 0.2 * i, image)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    (tmp_path / "frames").mkdir()
    clock = "frame,utc\n"
    for frame in pictures():
        cv2.imwrite(str(tmp_path / "frames" / f"{frame.index}.png"), frame.image_bgr)
        clock += f"{frame.index},{frame.time_utc_s}\n"
    (tmp_path / "clock.csv").write_text(clock)
    (tmp_path / "scene.toml").write_text(
        f"[camera]\nimage_size_px = {list(SIZE_PX)}\n"
        '[[recordings]]\nname = "a"\nframes = "frames"\nclock = "clock.csv"\n'
        'detections = "none.csv"\n'
    )
    (tmp_path / "none.csv").write_text("frame,x1,y1,x2,y2\n")
    return Scene.load(tmp_path / "scene.toml")


@pytest.fixture
def passes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many pictures were decoded in each pass over a source."""
    counts: list[int] = []
    frames = video.frames

    def counted(*arguments: Any, **more: Any) -> Iterator[Frame]:
        counts.append(0)
        row = len(counts) - 1
        for frame in frames(*arguments, **more):
            counts[row] += 1
            yield frame

    monkeypatch.setattr(video, "frames", counted)
    return counts


def same(first: Boxes, second: Boxes) -> None:
    np.testing.assert_array_equal(first.xyxy_px, second.xyxy_px)
    np.testing.assert_array_equal(first.frame, second.frame)
    np.testing.assert_array_equal(first.time_utc_s, second.time_utc_s)


def test_everybody_has_looked_when_a_picture_is_handed_on() -> None:
    one, other = Notes(), Notes()
    for i, frame in enumerate(shown(pictures(), [one, other])):
        assert frame.index == i
        assert one.index == other.index == list(range(i + 1))
    alone = Notes()
    list(shown(pictures(), [alone]))
    assert alone.index == one.index


def test_a_pass_serves_the_detector_and_the_still_picture(scene: Scene, passes: list[int]) -> None:
    seen = SceneDetections(scene, "motion", stills=True)
    boxes, still, times = (
        seen.boxes(scene["a"]),
        seen.still(scene["a"]),
        seen.times_utc_s(scene["a"]),
    )
    assert passes == [FRAMES]
    # Each by itself finds the same.
    assert len(boxes) > 10
    same(boxes, Boxes.concatenate(list(detect(scene["a"].frames(), MotionDetector()))))
    alone = StillPicture()
    list(shown(scene["a"].frames(), [alone]))
    np.testing.assert_array_equal(still, alone.picture())
    np.testing.assert_allclose(times, [frame.time_utc_s for frame in pictures()])


def test_a_still_picture_alone_takes_no_more_pictures_than_it_needs(
    scene: Scene, passes: list[int]
) -> None:
    seen = SceneDetections(scene, None)
    first = seen.still(scene["a"])
    assert seen.still(scene["a"]) is first
    assert passes == [25]


def test_what_moves_is_not_in_the_still_picture() -> None:
    still = StillPicture(every=3, most=9)
    list(shown(pictures(), [still]))
    assert still.seen_enough
    assert still.picture().min() > 130
    odd = Frame(99, 0.0, np.zeros((8, 8, 3), np.uint8))
    mixed = StillPicture()
    list(shown([next(pictures()), odd], [mixed]))
    assert mixed.picture().shape == SIZE_PX[::-1]
