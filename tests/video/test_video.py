from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from sightline.clock import presentation_clock
from sightline.errors import InputError
from sightline.types import Frame
from sightline.video import frames, image_size_px, video_info, write_video

START_S = 1_601_494_584.0


def pictures(times_s: np.ndarray, size_px: tuple[int, int] = (160, 120)) -> Iterator[Frame]:
    """Frames whose brightness tells their number."""
    for index, time_s in enumerate(times_s):
        shape = (size_px[1], size_px[0], 3)
        yield Frame(index, float(time_s), np.full(shape, 20 + 4 * (index % 50), np.uint8))


@pytest.fixture
def irregular_s() -> np.ndarray:
    gaps = np.random.default_rng(0).uniform(0.01, 0.4, 49)
    return START_S + np.round(np.concatenate([[0.0], np.cumsum(gaps)]), 6)


@pytest.fixture
def video(tmp_path: Path, irregular_s: np.ndarray) -> Path:
    path = tmp_path / "clip.mp4"
    assert write_video(path, pictures(irregular_s)) == irregular_s.size
    return path


def test_irregular_times_survive_the_file(video: Path, irregular_s: np.ndarray) -> None:
    seen = list(frames(video))
    np.testing.assert_allclose([f.time_utc_s for f in seen], irregular_s, rtol=0, atol=9e-6)
    assert [f.index for f in seen] == list(range(irregular_s.size))
    level = np.array([f.image_bgr.mean() for f in seen])
    np.testing.assert_allclose(level, 20 + 4 * np.arange(irregular_s.size), atol=4)


def test_what_a_video_says_of_itself(video: Path, irregular_s: np.ndarray) -> None:
    info = video_info(video)
    assert info.image_size_px == (160, 120)
    assert info.creation_utc_s == START_S
    np.testing.assert_allclose(info.presentation_s, irregular_s - START_S, rtol=0, atol=9e-6)


def test_names_are_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("http:a.mp4", "-a.mp4", "%d.mp4", "a|b.mp4"):
        assert write_video(name, pictures(START_S + np.arange(3.0))) == 3
        assert len(list(frames(name))) == 3


def test_the_start_may_be_given(video: Path, irregular_s: np.ndarray) -> None:
    times = [f.time_utc_s for f in frames(video, start_utc_s=1000.0)]
    np.testing.assert_allclose(times, irregular_s - START_S + 1000.0, rtol=0, atol=9e-6)


def test_a_clock_alone_tells_the_times(video: Path) -> None:
    clock = presentation_clock(500.0, np.arange(50) * 2.0)
    assert [f.time_utc_s for f in frames(video, clock=clock)][:3] == [500.0, 502.0, 504.0]


def test_frames_that_come_too_soon_are_left_out(
    video: Path, irregular_s: np.ndarray, tmp_path: Path
) -> None:
    seen = list(frames(video, apart_s=0.5))
    times = np.array([frame.time_utc_s for frame in seen])
    assert times[0] == pytest.approx(irregular_s[0], abs=9e-6)
    assert np.diff(times).min() >= 0.5
    # None is left out that might have been kept, and those kept have their own number.
    assert np.diff(times).max() <= 0.5 + np.diff(irregular_s).max()
    np.testing.assert_allclose(
        times, irregular_s[[frame.index for frame in seen]], rtol=0, atol=9e-6
    )
    clock = presentation_clock(0.0, np.arange(50.0))
    assert [f.index for f in frames(video, clock=clock, apart_s=10.0)] == [0, 10, 20, 30, 40]
    for number in range(6):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.zeros((8, 8, 3), np.uint8))
    assert [f.index for f in frames(tmp_path, clock=clock, apart_s=2.0)] == [0, 2, 4]
    # Where nothing tells the times, nothing is too soon.
    assert len(list(frames(tmp_path, apart_s=2.0))) == 6


def test_a_real_clip(data_dir: Path) -> None:
    path = data_dir / "otvision" / "Cars-Truck.mp4"
    info = video_info(path)
    assert info.creation_utc_s is None
    capture = cv2.VideoCapture(str(path))
    size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    assert info.image_size_px == image_size_px(path) == size
    np.testing.assert_allclose(info.presentation_s, np.arange(60) / 20.0, atol=1e-9)
    count = 0
    for frame in frames(path):
        known, expected = capture.read()
        assert known
        assert np.isnan(frame.time_utc_s)
        # The two libraries convert from YUV with roundings of their own.
        assert np.abs(frame.image_bgr.astype(int) - expected).mean() < 2.0
        count += 1
    assert count == 60


def test_telephone_video_is_turned_upright(tmp_path: Path) -> None:
    path = tmp_path / "portrait.mp4"
    lying = np.zeros((120, 160, 3), np.uint8)
    lying[:, :80] = 250
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=Fraction(10))
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        stream.set_display_rotation(90)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(lying, format="bgr24")))
        container.mux(stream.encode(None))
    (frame,) = frames(path)
    assert frame.image_bgr.shape == (160, 120, 3)
    assert video_info(path).image_size_px == (120, 160)
    # Turned counterclockwise, what was on the left is below.
    assert frame.image_bgr[100:].mean() > 200
    assert frame.image_bgr[:60].mean() < 50


def test_memory_does_not_grow_with_the_length(tmp_path: Path) -> None:
    def peak(n: int) -> int:
        path = tmp_path / f"{n}.mp4"
        tracemalloc.start()
        write_video(path, pictures(START_S + np.arange(n) * 0.04))
        for _ in frames(path):
            pass
        high = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return high

    peak(10)
    assert peak(400) < peak(40) + 200_000


def test_a_folder_of_pictures(tmp_path: Path) -> None:
    for index in (200, 0, 1000):
        cv2.imwrite(str(tmp_path / f"{index:04d}.png"), np.full((4, 6, 3), index // 10, np.uint8))
    (tmp_path / "notes.txt").write_text("not a picture")
    seen = list(frames(tmp_path))
    assert [f.index for f in seen] == [0, 200, 1000]
    assert [int(f.image_bgr[0, 0, 0]) for f in seen] == [0, 20, 100]
    assert all(np.isnan(f.time_utc_s) for f in seen)
    assert image_size_px(tmp_path) == (6, 4)


def test_real_frames(data_dir: Path) -> None:
    folder = data_dir / "tracks-at-sea" / "frames" / "20"
    seen = [f.index for f in frames(folder)]
    assert seen == sorted(int(p.stem) for p in folder.iterdir())
    assert image_size_px(folder) == (1280, 720)


def test_a_cut_tail_gives_the_frames_before_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    whole, cut = tmp_path / "whole.mp4", tmp_path / "cut.mp4"
    noise = rng.integers(0, 255, (30, 120, 160, 3), dtype=np.uint8)
    # The index in front of the pictures, as web servers want it.
    with av.open(str(whole), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for image in noise:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    assert len(list(frames(whole))) == 30
    data = whole.read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    seen: list[int] = []
    with pytest.raises(InputError, match=r"cut\.mp4: breaks off after \d+ frames"):
        seen.extend(f.index for f in frames(cut))
    stored = iter(frames(cut))
    first = [next(stored).index for _ in range(10)]
    assert first == list(range(10))


def test_a_truncated_mp4(video: Path) -> None:
    video.write_bytes(video.read_bytes()[:-600])
    for read in (video_info, frames, image_size_px):
        with pytest.raises(InputError, match=r"clip\.mp4: cannot be read as a video"):
            read(video)


def test_sources_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such video"):
        frames(tmp_path / "missing.mp4")
    with pytest.raises(InputError, match="holds no picture"):
        frames(tmp_path)
    with pytest.raises(InputError, match="is a folder"):
        video_info(tmp_path)
    (tmp_path / "empty.mp4").touch()
    with pytest.raises(InputError, match="is empty"):
        frames(tmp_path / "empty.mp4")
    (tmp_path / "text.mp4").write_text("not a video at all")
    with pytest.raises(InputError, match="cannot be read as a video"):
        frames(tmp_path / "text.mp4")
    with pytest.raises(InputError, match="cannot be read as a video"):
        frames("rtsp://127.0.0.1:1/nothing")


def test_a_folder_has_no_presentation_times(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="have no presentation times"):
        frames(tmp_path, start_utc_s=0.0)


def test_pictures_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "5.jpg").write_text("not a picture")
    with pytest.raises(InputError, match=r"5\.jpg: is no picture"):
        list(frames(tmp_path))
    (tmp_path / "05.png").touch()
    with pytest.raises(InputError, match="are both frame"):
        frames(tmp_path)
    (tmp_path / "05.png").rename(tmp_path / "view.png")
    with pytest.raises(InputError, match=r"view\.png: the name does not end in the number"):
        frames(tmp_path)


def still(index: int, time_s: float, shape: tuple[int, int, int] = (4, 6, 3)) -> Frame:
    return Frame(index, time_s, np.zeros(shape, np.uint8))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([], "there is no frame to write"),
        ([still(0, np.nan)], "frame 0 has no time"),
        ([still(0, 1.0), still(1, 1.0)], "frame 1 is not later"),
        ([still(0, 1.0), still(1, 2.0, (8, 6, 3))], "frame 1 has the shape"),
        ([still(0, 1.0, (5, 6, 3))], "must be even"),
    ],
)
def test_refused_frames_leave_nothing_behind(
    tmp_path: Path, given: list[Frame], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        write_video(tmp_path / "clip.mp4", given)
    assert list(tmp_path.iterdir()) == []
