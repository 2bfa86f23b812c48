"""Clips of the pictures around tracks: what is in them, when they end, and what is removed."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.live.clips import SIZE_PX, ClipRecorder, ClipSettings, around
from sightline.moment import Moment, TargetState
from sightline.video import frames, video_info

START_UTC_S = 1_717_236_000.0  # 2024-06-01 10:00:00
PLAIN = ClipSettings(most_waiting=10_000)


def target(number: int, box: tuple | None, state: str = "measured") -> TargetState:
    return TargetState(
        number, 54.3, 10.1, np.eye(2), 2.0, 90.0, state, box, None if box is None else 0.9
    )


def moment(since_s: float, *targets: TargetState) -> Moment:
    return Moment(START_UTC_S + since_s, "sender", "dock", targets, frame_size_px=(640, 360))


def sea(boat: tuple[float, float] = (320.0, 200.0)) -> np.ndarray:
    """Grey, with a blue boat of 24 x 12 px whose middle is there."""
    image = np.full((360, 640, 3), 128, dtype=np.uint8)
    x, y = (round(value) for value in boat)
    image[y - 6 : y + 6, x - 12 : x + 12] = (255, 0, 0)
    return image


def box(x: float, y: float = 200.0) -> tuple[float, float, float, float]:
    return x - 12.0, y - 6.0, x + 12.0, y + 6.0


def record(folder: Path, moments: list[tuple[np.ndarray, Moment]], **options) -> list[Path]:
    recorder = ClipRecorder(folder, settings=options.pop("settings", PLAIN), **options)
    recorder.start()
    for image, one in moments:
        recorder.offer(image, one)
    recorder.close(30.0)
    assert recorder.problem == ""
    return sorted(folder.glob("*/*.mp4"))


def passage(first_s: float, last_s: float, number: int = 7, rate_hz: float = 25.0):
    for since_s in np.arange(first_s, last_s, 1.0 / rate_hz).tolist():
        x = 100.0 + 20.0 * since_s
        yield sea((x, 200.0)), moment(since_s, target(number, box(x)))


def test_the_boat_is_in_the_middle_with_its_box(tmp_path: Path) -> None:
    (clip,) = record(tmp_path, list(passage(0.0, 6.0)))
    assert clip.relative_to(tmp_path) == Path("2024-06-01/100000-7.mp4")
    info = video_info(str(clip))
    assert info.creation_utc_s == START_UTC_S
    seen = list(frames(str(clip), start_utc_s=START_UTC_S))
    # Five a second of twenty-five, at their own times.
    assert len(seen) == 30
    assert np.diff([one.time_utc_s for one in seen]) == pytest.approx(0.2, abs=0.005)
    for frame in seen[::7]:
        image = frame.image_bgr.astype(int)
        assert image.shape == (SIZE_PX[1], SIZE_PX[0], 3)
        blue = image[..., 0] - image[..., 2] > 100
        rows, columns = np.nonzero(blue)
        assert np.mean(columns) == pytest.approx(240.0, abs=8.0)
        assert np.mean(rows) == pytest.approx(135.0, abs=8.0)
        # 96 px of the picture are its 270: a boat of 24 px is 67.
        assert np.ptp(columns) == pytest.approx(67.0, abs=6.0)


def test_the_box_is_drawn_on_its_edges() -> None:
    seen = around(sea(), target(3, box(320.0))).astype(int)
    scale = 270.0 / 96.0
    yellow = (np.abs(seen - (0, 200, 255)) < 60).all(axis=2)
    rows, columns = np.nonzero(yellow[:220])
    assert columns.min() == pytest.approx(240.0 - 12.0 * scale, abs=2.0)
    assert columns.max() == pytest.approx(240.0 + 12.0 * scale, abs=2.0)
    assert rows.min() == pytest.approx(135.0 - 6.0 * scale, abs=2.0)
    assert rows.max() == pytest.approx(135.0 + 6.0 * scale, abs=2.0)
    # At the edge of the picture there is black beyond it, and the boat stays in the middle.
    edge = around(sea((14.0, 200.0)), target(3, box(14.0)))
    assert (edge[100:170, :150] < 30).all()


def test_one_clip_a_track_as_long_as_it_may_be(tmp_path: Path) -> None:
    long = list(passage(0.0, 26.0, rate_hz=5.0))
    (clip,) = record(tmp_path, long)
    seen = list(frames(str(clip), start_utc_s=0.0))
    assert seen[-1].time_utc_s == pytest.approx(PLAIN.longest_s, abs=0.3)


def test_a_track_that_goes_ends_its_clip_and_others_go_on(tmp_path: Path) -> None:
    moments = []
    for since_s in np.arange(0.0, 12.0, 0.2).tolist():
        targets = [target(2, box(300.0))]
        if since_s < 4.0:
            targets.append(target(1, box(100.0)))
        if 5.0 < since_s < 5.5:
            # Seen for moments only.
            targets.append(target(3, box(400.0)))
        targets.append(target(4, box(500.0), "moored"))
        targets.append(target(5, None, "predicted"))
        moments.append((sea(), moment(since_s, *targets)))
    clips = record(tmp_path, moments)
    assert [one.name for one in clips] == ["100000-1.mp4", "100000-2.mp4"]
    lasts = [list(frames(str(one), start_utc_s=0.0))[-1].time_utc_s for one in clips]
    assert lasts == pytest.approx([3.8, 11.8], abs=0.3)


def test_more_than_may_be_are_left_out(tmp_path: Path) -> None:
    settings = ClipSettings(most_at_once=2, most_waiting=10_000)
    crowd = [target(number, box(100.0 + 60.0 * number)) for number in range(1, 6)]
    moments = [(sea(), moment(0.2 * i, *crowd)) for i in range(10)]
    assert len(record(tmp_path, moments, settings=settings)) == 2
    # A recorder that is slower than the camera holds up nobody.
    slow = ClipRecorder(tmp_path / "slow")
    for image, one in passage(0.0, 20.0, rate_hz=5.0):
        slow.offer(image, one)
    assert slow.left_out == 100 - ClipSettings().most_waiting
    slow.close()


def test_old_days_are_removed_and_nothing_else(tmp_path: Path) -> None:
    today = datetime.now(UTC)
    for days, name in ((40, "101500-3.mp4"), (2, "101500-4.mp4")):
        folder = tmp_path / f"{today - timedelta(days=days):%Y-%m-%d}"
        folder.mkdir()
        (folder / name).write_bytes(b"a clip")
    mine = tmp_path / f"{today - timedelta(days=50):%Y-%m-%d}"
    mine.mkdir()
    (mine / "holiday.mp4").write_bytes(b"mine")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "101500-3.mp4").write_bytes(b"mine")
    outside = tmp_path.parent / "outside"
    outside.mkdir()
    (outside / "101500-3.mp4").write_bytes(b"mine")
    (tmp_path / "2001-01-01").symlink_to(outside)
    recorder = ClipRecorder(tmp_path, retention_days=30.0)
    recorder.start()
    until = time.monotonic() + 30.0
    gone = tmp_path / f"{today - timedelta(days=40):%Y-%m-%d}"
    while gone.exists() and time.monotonic() < until:
        time.sleep(0.02)
    recorder.close()
    left = sorted(str(one.relative_to(tmp_path)) for one in tmp_path.glob("*/*.mp4"))
    assert [Path(one).name for one in left] == [
        "101500-3.mp4",
        "holiday.mp4",
        "101500-4.mp4",
        "101500-3.mp4",
    ]
    assert not gone.exists()
    assert (outside / "101500-3.mp4").exists()


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="clips cannot be kept there"):
        ClipRecorder(tmp_path / "file" / "clips")


def test_a_disk_that_takes_nothing_is_told_once(tmp_path: Path) -> None:
    said: list[str] = []
    recorder = ClipRecorder(tmp_path / "clips", settings=PLAIN, told=said.append)
    # In the place of the day's folder there is a file.
    (tmp_path / "clips" / "2024-06-01").write_bytes(b"")
    recorder.start()
    for number in (1, 2):
        for image, one in passage(10.0 * number, 10.0 * number + 2.0, number, 5.0):
            recorder.offer(image, one)
    recorder.close(30.0)
    assert len(said) == 1
    assert "no clip can be written" in said[0]
    assert recorder.problem
