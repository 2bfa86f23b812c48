"""Boxes of which no track comes are told of."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.track import track
from sightline.types import Boxes

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
