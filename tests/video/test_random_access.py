"""Single frames in any order, against the same video read from its beginning."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from videos import number_of, overwrite, packet_places, picture, write

from sightline import InputError
from sightline.video import frames
from sightline.video.random_access import FramePictures

COUNT = 60
IRREGULAR_MS = np.cumsum([0, *[(40, 33, 90, 41)[i % 4] for i in range(COUNT - 1)]]).tolist()


@pytest.fixture(params=["with B frames", "motion JPEG", "AVI", "folder"])
def source(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    if request.param == "folder":
        for number in range(COUNT):
            cv2.imwrite(str(tmp_path / f"{number:06d}.png"), picture(number))
        return tmp_path
    if request.param == "motion JPEG":
        return write(tmp_path / "v.mov", IRREGULAR_MS, "mjpeg", pix_fmt="yuvj420p")
    if request.param == "AVI":
        return write(
            tmp_path / "v.avi", list(range(0, 40 * COUNT, 40)), "mjpeg", pix_fmt="yuvj420p"
        )
    return write(tmp_path / "v.mp4", IRREGULAR_MS, b_frames=3, gop=12)


def test_any_frame_is_the_one_of_that_number(source: Path) -> None:
    order = np.random.default_rng(0).permutation(COUNT).tolist()
    single = FramePictures(source, most_bytes=5 * picture(0).nbytes)
    assert single.frame.tolist() == list(range(COUNT))
    assert single.size_px == (64, 48)
    assert [number_of(single.read(number)) for number in order] == order
    backward = list(range(COUNT - 1, -1, -1))
    assert [number_of(single.read(number)) for number in backward] == backward


def test_pictures_are_those_of_the_whole_video(source: Path) -> None:
    single = FramePictures(source)
    for frame in frames(source):
        if frame.index % 7 == 3:
            np.testing.assert_array_equal(single.read(frame.index), frame.image_bgr)


def test_a_little_of_the_video_is_kept(tmp_path: Path) -> None:
    path = write(tmp_path / "v.mp4", IRREGULAR_MS, gop=12)
    single = FramePictures(path, most_bytes=5 * picture(0).nbytes)
    for number in (59, 3, 30, 31, 2):
        single.read(number)
    assert len(single._kept) <= 5
    assert single.read(2) is single.read(2)
    with pytest.raises(ValueError, match="read-only"):
        single.read(2)[0, 0] = 0


def test_a_frame_that_is_lost_keeps_its_number(tmp_path: Path) -> None:
    """Damage that makes others of its group unreadable leaves those of other groups alone."""
    path = write(tmp_path / "v.mkv", IRREGULAR_MS, gop=10)
    place, size = packet_places(path)[20]
    overwrite(path, place, size)
    told = {frame.index: number_of(frame.image_bgr) for frame in frames(path)}
    single = FramePictures(path)
    for number in (5, 15, 35, 55):
        assert number_of(single.read(number)) == told[number] == number


def test_what_is_not_there_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "v.mp4", IRREGULAR_MS)
    single = FramePictures(path)
    for number in (-1, COUNT, 10**9):
        with pytest.raises(InputError, match=f"has no frame {number}; its 60 frames are between"):
            single.read(number)
    with pytest.raises(InputError, match="single frames are had of files alone"):
        FramePictures("rtsp://127.0.0.1/never")
    with pytest.raises(InputError):
        FramePictures(tmp_path / "none.mp4")
