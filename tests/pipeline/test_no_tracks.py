"""Boxes of which no track comes are told of."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.track import iter_tracks, track
from sightline.types import Boxes, Frame
from sightline.video import write_video

START = 1_717_236_000.0


@pytest.mark.parametrize(("confidence", "count"), [(0.2, 0), (0.9, 2)], ids=["doubtful", "sure"])
def test_boxes_that_begin_no_track_are_counted(
    fitted: Callable[[str], Georeferencer],
    caplog: pytest.LogCaptureFixture,
    confidence: float,
    count: int,
) -> None:
    times = np.repeat(START + 0.25 * np.arange(24), 2)
    boxes = Boxes.of(
        np.tile([[300.0, 420.0, 340.0, 440.0], [800.0, 450.0, 860.0, 480.0]], (24, 1)),
        time_utc_s=times,
        confidence=confidence,
    )
    with caplog.at_level(logging.WARNING):
        assert len(track(boxes, fitted("camera"))) == count
    assert ("no track came of 48 boxes" in caplog.text) == (count == 0)


def test_no_track_of_what_was_stopped_is_no_warning(
    fitted: Callable[[str], Georeferencer], caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """Who stops at once expects none."""
    image = np.full((720, 1280, 3), 150, np.uint8)

    class Boat:
        name = "boat"
        stop: threading.Event | None = None

        def detect(self, frame: Frame) -> Boxes:
            if self.stop is not None and frame.index == 3:
                self.stop.set()
            box = [[300.0, 420.0, 340.0, 440.0]]
            return Boxes.of(box, frame=frame.index, time_utc_s=frame.time_utc_s, confidence=0.9)

        def reset(self) -> None:
            pass

    path = tmp_path / "a.mp4"
    write_video(path, (Frame(i, START + 0.1 * i, image) for i in range(8)))
    for stop in (None, threading.Event()):
        detector = Boat()
        detector.stop = stop
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            found = iter_tracks(
                path, fitted("camera"), detector=detector, start_utc_s=START, stop=stop
            )
            assert not list(found)
        assert ("no track came of 8 boxes" in caplog.text) == (stop is None)


def test_shares_of_the_picture_become_pixels_of_the_model(
    fitted: Callable[[str], Georeferencer], tmp_path: Path
) -> None:
    width, height = fitted("camera").image_size_px
    head = "time_utc,x1,y1,x2,y2,track_id\n"
    corners = np.array([300.0, 420.0, 340.0, 440.0])
    rows = [START + 0.25 * i for i in range(24)]
    shares = corners / [width, height, width, height]
    for name, four in (("pixels.csv", corners), ("shares.csv", shares)):
        cells = ",".join(f"{value:.9f}" for value in four)
        (tmp_path / name).write_text(head + "".join(f"{t},{cells},1\n" for t in rows))
    (one,), (other,) = (
        track(tmp_path / name, fitted("camera")) for name in ("pixels.csv", "shares.csv")
    )
    np.testing.assert_allclose(one.east_m, other.east_m, rtol=1e-5)
    np.testing.assert_allclose(one.north_m, other.north_m, rtol=1e-5)
