from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from cameras import free_port, http_camera, noise, rtsp_camera

from sightline.clock import presentation_clock
from sightline.errors import InputError
from sightline.live.capture_times import CaptureTimes
from sightline.live.source import (
    CameraSource,
    LiveFrame,
    PlayedSource,
    SourceEvent,
    SourceSettings,
)

QUICK = SourceSettings(
    size_px=(320, 240),
    silent_s=0.6,
    frozen_s=0.6,
    black_s=0.4,
    first_wait_s=0.05,
    longest_wait_s=0.2,
)


def until(condition: Callable[[], bool], most_s: float = 15.0) -> None:
    end_s = time.monotonic() + most_s
    while not condition():
        assert time.monotonic() < end_s, "it did not come to that"
        time.sleep(0.02)


class Watched:
    """A source whose frames are taken, and whose events are kept."""

    def __init__(self, address: str, settings: SourceSettings = QUICK) -> None:
        self.events: list[SourceEvent] = []
        self.source = CameraSource(address, settings, self.events.append)

    def __enter__(self) -> Watched:
        self.source.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.source.close()

    def frame(self) -> LiveFrame:
        found = self.source.take(15.0)
        assert found is not None
        return found

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


def test_a_camera_that_is_killed_is_connected_again() -> None:
    before = threading.active_count()
    with http_camera() as camera, Watched(camera.address) as watched:
        for kills in range(3):
            assert watched.frame().frame.image_bgr.shape == (240, 320, 3)
            camera.kill()
            until(lambda: watched.source.health == "lost")
            camera.start()
            until(lambda k=kills: watched.source.counts.reconnections == k + 1)
        watched.frame()
        assert watched.kinds().count("lost") == 3
        assert watched.kinds().count("resumed") == 3
    until(lambda: threading.active_count() <= before)


@pytest.mark.slow
def test_a_camera_that_falls_silent_is_noticed_though_its_connection_stands() -> None:
    with http_camera() as camera, Watched(camera.address) as watched:
        for _ in range(2):
            watched.frame()
            camera.mode = "stall"
            until(lambda: watched.source.health == "silent")
            assert "no frame came" in watched.source.reason
            camera.mode = "run"
            until(lambda: watched.source.health == "ok")
        assert watched.kinds().count("silent") == 2


@pytest.mark.parametrize("mode", ["frozen", "black", "resized"])
def test_pictures_of_no_use_are_told_and_not_handed_on(mode: str) -> None:
    with http_camera() as camera, Watched(camera.address) as watched:
        watched.frame()
        if mode == "resized":
            camera.size_px = (160, 120)
        else:
            camera.mode = mode
        until(lambda: watched.source.health == mode)
        watched.source.take(0.0)
        assert watched.source.take(0.3) is None
        paused = watched.source.counts.paused
        camera.mode, camera.size_px = "run", (320, 240)
        assert watched.frame().frame.image_bgr.shape == (240, 320, 3)
        assert paused > 0
        assert watched.kinds()[-2:] == [mode, "resumed"]
        assert watched.source.reason == ""


def test_the_newest_frame_wins_and_the_others_are_counted() -> None:
    with http_camera() as camera, Watched(camera.address) as watched:
        watched.frame()
        camera.rate_hz = 100.0
        indices, ages = [], []
        for _ in range(12):
            found = watched.frame()
            indices.append(found.frame.index)
            ages.append(time.monotonic() - found.arrived_s)
            time.sleep(0.1)
        counts = watched.source.counts
        assert counts.left_out > 12
        assert counts.seen - counts.left_out - counts.taken in (0, 1)
        # Whoever is slow gets what is new, not what was waiting since.
        assert max(ages) < 1.0
        gaps = np.diff(indices)
        assert gaps.min() >= 1
        assert gaps[1:].max() <= 4.0 * np.median(gaps[1:])


def test_a_wrong_password_is_refused_without_being_told() -> None:
    with http_camera("right") as camera:
        wrong = f"http://operator:wrong@127.0.0.1:{camera.port}/video"
        with pytest.raises(InputError, match="401") as refused:
            CameraSource(wrong, QUICK).probe()
        assert "wrong" not in str(refused.value)
        assert "operator" not in str(refused.value)
        assert CameraSource(camera.address, QUICK).probe() == (320, 240)
        with Watched(camera.address) as watched:
            watched.frame()
            assert not any("right" in event.text for event in watched.events)


@pytest.mark.parametrize(
    "address", ["gopher://host/", "rtsp://", "harbour.mp4", "/dev/no-such-device", "file:///etc"]
)
def test_what_is_no_camera_is_refused(address: str) -> None:
    with pytest.raises(InputError, match=r"^\S+: "):
        CameraSource(address).probe()


def test_nobody_there_is_refused() -> None:
    with pytest.raises(InputError, match="refused"):
        CameraSource(f"rtsp://127.0.0.1:{free_port()}/x", QUICK).probe()


def test_a_source_that_waits_for_an_answer_can_be_closed() -> None:
    """Nothing answers; who waits inside FFmpeg hears of it all the same."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        source = CameraSource(f"rtsp://127.0.0.1:{silent.getsockname()[1]}/x")
        source.start()
        time.sleep(0.3)
        begun_s = time.monotonic()
        source.close()
        assert time.monotonic() - begun_s < 1.9
        assert not [t for t in threading.enumerate() if t.name.startswith("sightline-")]


@pytest.mark.slow
def test_capture_times_are_those_of_the_senders_reports() -> None:
    address = f"rtsp://127.0.0.1:{free_port()}/harbour"
    settings = SourceSettings(
        options={"rtsp_flags": "listen", "listen_timeout": "10"}, first_wait_s=0.05
    )
    with Watched(address, settings) as watched:
        for _ in range(2):
            # Killed each time in the middle of its frames.
            with rtsp_camera(address, frames=500) as start_utc_s:
                off_s = []
                while len(off_s) < 30:
                    found = watched.frame()
                    if found.capture == "sender":
                        brightness = float(np.median(found.frame.image_bgr[8, :, 1]))
                        number = round((brightness - 40.0) / 4.0)
                        late_s = found.frame.time_utc_s - start_utc_s - number / 25.0
                        # Fifty frames are two seconds.
                        off_s.append((late_s + 1.0) % 2.0 - 1.0)
                        assert 0.0 < found.sigma_s < 0.05
            assert abs(float(np.median(off_s))) < 0.005
            until(lambda: watched.source.health == "lost")
        assert watched.kinds().count("connected") == 2


class TestCaptureTimes:
    def test_a_senders_clock_that_is_set_is_noticed_once(self) -> None:
        times, now = CaptureTimes(), time.time() - time.monotonic()
        steps, got = [], []
        for i in range(60):
            at = 1000.0 + i * 0.04
            set_by = 7.0 if i >= 30 else 0.0
            times.report(i * 0.04, now + at + set_by, at + 0.02)
            got.append(times.of(i * 0.04, at + 0.02))
            steps.append(times.step_s())
        assert [step for step in steps if step] == [pytest.approx(7.0, abs=0.01)]
        known = np.array([one.utc_s for one in got])
        expected = now + 1000.0 + np.arange(60) * 0.04 + np.where(np.arange(60) >= 30, 7.0, 0.0)
        kept = np.isfinite(known)
        # Until it is sure, nothing is said.
        assert np.flatnonzero(~kept).tolist() == [30, 31]
        np.testing.assert_allclose(known[kept], expected[kept], atol=1e-5)
        assert {one.clock for one in got} == {"sender"}

    def test_a_burst_after_a_stall_is_no_step(self) -> None:
        times, now = CaptureTimes(), time.time() - time.monotonic()
        for i in range(100):
            at = 1000.0 + i * 0.04
            arrived = max(at, 1003.0) if i > 25 else at
            times.report(i * 0.04, now + at, arrived)
            found = times.of(i * 0.04, arrived)
            assert found.utc_s == pytest.approx(now + at, abs=1e-5)
        assert times.step_s() == 0.0

    def test_arrival_is_that_of_the_quickest(self) -> None:
        """The network adds delays that are never negative."""
        rng = np.random.default_rng(1)
        times, now = CaptureTimes(), time.time() - time.monotonic()
        off = []
        for i in range(200):
            at = 1000.0 + i * 0.04
            found = times.of(i * 0.04, at + float(rng.exponential(0.03)))
            off.append(found.utc_s - now - at)
            assert found.clock == "arrival"
            assert found.sigma_s > 0.01
        assert np.abs(off[50:]).max() < 0.005

    def test_a_senders_clock_of_another_year_is_not_believed(self) -> None:
        now = time.time() - time.monotonic()
        for clock, expected in (("auto", "arrival"), ("sender", "sender"), ("arrival", "arrival")):
            times = CaptureTimes(clock)
            times.report(0.0, now + 1000.0 - 3e7, 1000.0)
            assert times.of(0.0, 1000.0).clock == expected
            assert times.sender_off_s == pytest.approx(-3e7)


def _folder(path: Path, count: int) -> Path:
    path.mkdir()
    for i in range(count):
        cv2.imwrite(str(path / f"{i:04d}.png"), noise(i))
    return path


def test_a_recording_is_played_by_its_own_clock(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "frames", 20)
    clock = presentation_clock(1.7e9, np.arange(20) * 0.1)
    source = PlayedSource(folder, clock=clock, speed=2.0)
    begun_s = time.monotonic()
    source.start()
    got = []
    while (found := source.take(5.0)) is not None:
        got.append(found)
    assert time.monotonic() - begun_s >= 0.95
    assert source.health == "ended"
    assert len(got) + source.counts.left_out == 20
    for one in got:
        assert one.frame.time_utc_s == pytest.approx(1.7e9 + 0.1 * one.frame.index)
        assert one.capture == "sender"
        np.testing.assert_array_equal(one.frame.image_bgr, noise(one.frame.index))
    source.close()
