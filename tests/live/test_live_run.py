from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from sightline.georeferencing.georeferencer import Georeferencer
from sightline.live.clips import ClipRecorder, ClipSettings
from sightline.live.lines import Lines
from sightline.live.run import Camera, EarlierRun, LiveRun
from sightline.live.source import Health, LiveFrame, SourceCounts
from sightline.live.store import Keeper, Store, stored_tracks
from sightline.moment import Moment
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, SimulatedCamera
from sightline.types import Boxes, Frame
from sightline.video import frames
from sightline.video.mask import Mask

LASTING = BoxNoise(std_px=1.5, correlation_time_s=0.8, miss_probability=0.05, source="first")


class Scripted:
    """A source whose frames are there when they are asked for."""

    def __init__(self, times: np.ndarray, *, endless: bool = False) -> None:
        self.counts, self.reason = SourceCounts(), ""
        self.health: Health = "ok"
        self._times, self._endless, self._next = times, endless, 0
        self.closed = False

    def start(self) -> None:
        self.counts.connections = 1

    def take(self, timeout_s: float) -> LiveFrame | None:
        if self._next >= self._times.size:
            if self._endless:
                time.sleep(timeout_s)
            else:
                self.health = "ended"
            return None
        image = np.full((720, 1280, 3), 90, dtype=np.uint8)
        frame = Frame(self._next, float(self._times[self._next]), image)
        self._next += 1
        self.counts.seen = self.counts.taken = self._next
        return LiveFrame(frame, "sender", 0.002, time.monotonic())

    def age_s(self) -> float | None:
        return 0.0 if self._next else None

    def close(self) -> None:
        self.closed = True


class Knows:
    """A detector that is told the boxes."""

    def __init__(self, boxes: Boxes, *, fails: range = range(0)) -> None:
        self._boxes, self._fails = boxes, fails

    def detect(self, frame: Frame) -> Boxes:
        if frame.index in self._fails:
            raise ValueError("a frame that the network does not like")
        return self._boxes[self._boxes.time_utc_s == frame.time_utc_s]

    def reset(self) -> None:
        pass


class Collects:
    """A feed that keeps what it is given."""

    def __init__(self) -> None:
        self.moments: list[Moment] = []
        self.closed = False

    def publish(self, moment: Moment) -> None:
        self.moments.append(moment)

    def close(self) -> None:
        self.closed = True


class Tells(Collects):
    def statistics(self) -> dict[str, int]:
        return {"connected": 1, "lost": 3}


class Raises(Collects):
    def publish(self, moment: Moment) -> None:
        raise ConnectionError("mqtt://user:secret@host is gone")


class Hangs(Collects):
    def __init__(self) -> None:
        super().__init__()
        self.let_go = threading.Event()

    def publish(self, moment: Moment) -> None:
        self.let_go.wait(60.0)


@pytest.fixture(scope="module")
def model(fitted: Callable[[str], Georeferencer]) -> Georeferencer:
    return fitted("camera")


@pytest.fixture(scope="module")
def harbour(small_camera: SimulatedCamera, model: Georeferencer) -> Harbour:
    settings = HarbourSettings(duration_s=20.0, camera=small_camera, plane=model.plane, gulls=0)
    return Harbour.random(5, settings)


@pytest.fixture
def no_thread_is_left() -> Iterator[None]:
    yield
    end_s = time.monotonic() + 3.0
    while own := [t.name for t in threading.enumerate() if t.name.startswith("sightline-")]:
        assert time.monotonic() < end_s, own
        time.sleep(0.02)


def _camera(model: Georeferencer, harbour: Harbour, **options: object) -> tuple[Camera, np.ndarray]:
    times = harbour.times(10.0)
    boxes = harbour.boxes(times, noise=LASTING, of="all")
    detector = Knows(boxes, fails=options.pop("fails", range(0)))  # type: ignore[arg-type]
    return Camera("quay", model, detector, **options), times  # type: ignore[arg-type]


@pytest.mark.usefixtures("no_thread_is_left")
def test_frames_become_moments_that_are_published_and_kept(
    model: Georeferencer, harbour: Harbour, tmp_path: Path
) -> None:
    camera, times = _camera(model, harbour)
    feed, source = Collects(), Scripted(times)
    store = Store(tmp_path / "quay.db", camera="quay", plane=model.plane)
    told: list[tuple[str, str]] = []
    run = LiveRun(
        source,
        camera,
        feeds={"collected": feed},
        keeper=Keeper(store),
        earlier=EarlierRun(99),
        told=lambda kind, text: told.append((kind, text)),
    )
    run.run(threading.Event())
    assert source.closed
    assert feed.closed
    health = run.health()
    assert health["frames_processed"] == times.size
    assert health["state"] == "ended"
    assert health["kept_utc_s"] == pytest.approx(times[-1])
    assert feed.moments[-1].time_utc_s == times[-1]
    assert feed.moments[-1].capture_sigma_s == 0.002
    tracks = list(stored_tracks(tmp_path / "quay.db"))
    assert min(track.track_id for track in tracks) == 100
    everywhere = {boat.identity: harbour.truth(times, [boat]) for boat in harbour.boats}
    for track in tracks:
        if len(track) < 100:
            continue
        # Some boat was there all the time, as near as a pixel at its range lets one see.
        off = [
            np.median(
                np.hypot(
                    track.east_m - np.interp(track.time_utc_s, times, boat.east_m),
                    track.north_m - np.interp(track.time_utc_s, times, boat.north_m),
                )
                / np.interp(track.time_utc_s, times, boat.range_m)
            )
            for boat in everywhere.values()
        ]
        assert min(off) < 0.08
    assert told == []


@pytest.mark.usefixtures("no_thread_is_left")
def test_linear_algebra_takes_one_thread(model: Georeferencer, harbour: Harbour) -> None:
    _, times = _camera(model, harbour)
    seen: set[int] = set()

    class Counts(Knows):
        def detect(self, frame: Frame) -> Boxes:
            pools = [one for one in threadpool_info() if one["user_api"] == "blas"]
            seen.update(one["num_threads"] for one in pools)
            return Boxes.of([])

    with threadpool_limits(2, user_api="blas"):
        counting = Camera("quay", model, Counts(Boxes.of([])))
        LiveRun(Scripted(times[:3]), counting).run(threading.Event())
    assert seen == {1}


@pytest.mark.usefixtures("no_thread_is_left")
def test_a_feed_that_raises_holds_up_nobody_and_is_told_without_its_password(
    model: Georeferencer, harbour: Harbour
) -> None:
    camera, times = _camera(model, harbour)
    good, told = Tells(), []
    run = LiveRun(
        Scripted(times),
        camera,
        feeds={"broken": Raises(), "good": good},
        told=lambda kind, text: told.append((kind, text)),
    )
    run.run(threading.Event())
    assert run.health()["frames_processed"] == times.size
    assert good.moments[-1].time_utc_s == times[-1]
    feeds = run.health()["feeds"]
    assert isinstance(feeds, dict)
    assert feeds["good"]["connected"] == 1
    assert feeds["good"]["lost"] >= 3
    assert feeds["broken"]["failed"] > 0
    assert told == [("feed", "broken: mqtt://***@host is gone")]


def test_a_feed_that_hangs_loses_its_own_moments_alone(model: Georeferencer) -> None:
    good, hanging = Collects(), Hangs()
    lines = Lines({"hangs": hanging, "good": good})
    begun_s = time.monotonic()
    for k in range(50):
        lines.publish(Moment(float(k), "sender", "quay", ()))
        time.sleep(0.002)
    assert lines.counts()["hangs"]["lost"] >= 45
    lines.close(0.3)
    assert time.monotonic() - begun_s < 5.0
    assert good.moments[-1].time_utc_s == 49.0
    hanging.let_go.set()


@pytest.mark.usefixtures("no_thread_is_left")
def test_it_stops_when_asked_and_finishes_what_is_kept(
    model: Georeferencer, harbour: Harbour, tmp_path: Path
) -> None:
    camera, times = _camera(model, harbour)
    store = Store(tmp_path / "quay.db", camera="quay", plane=model.plane)
    run = LiveRun(Scripted(times, endless=True), camera, keeper=Keeper(store))
    stop = threading.Event()
    watching = threading.Thread(target=run.run, args=(stop,))
    watching.start()
    end_s = time.monotonic() + 30.0
    while run.health()["frames_processed"] != times.size and time.monotonic() < end_s:
        time.sleep(0.02)
    stop.set()
    watching.join(5.0)
    assert not watching.is_alive()
    tracks = list(stored_tracks(tmp_path / "quay.db"))
    assert max(track.time_utc_s[-1] for track in tracks) == pytest.approx(times[-1], abs=0.5)


@pytest.mark.usefixtures("no_thread_is_left")
def test_some_frames_that_fail_are_told_and_many_in_a_row_end_it(
    model: Georeferencer, harbour: Harbour
) -> None:
    camera, times = _camera(model, harbour, fails=range(30, 35))
    told: list[tuple[str, str]] = []
    run = LiveRun(Scripted(times), camera, told=lambda kind, text: told.append((kind, text)))
    run.run(threading.Event())
    assert run.health()["frames_failed"] == 5
    assert run.health()["frames_processed"] == times.size - 5
    assert [kind for kind, _ in told] == ["failed"]
    camera, times = _camera(model, harbour, fails=range(30, 200))
    with pytest.raises(ValueError, match="does not like"):
        LiveRun(Scripted(times), camera).run(threading.Event())


def test_what_is_masked_is_neither_shown_nor_looked_for(
    model: Georeferencer, harbour: Harbour
) -> None:
    hidden = np.ones((720, 1280), dtype=bool)
    hidden[:10] = False
    camera, times = _camera(model, harbour, mask=Mask(hidden))
    feed = Collects()
    run = LiveRun(Scripted(times[:30]), camera, feeds={"a": feed})
    assert run.picture() is None
    run.run(threading.Event())
    assert {moment.targets for moment in feed.moments} == {()}
    jpeg = run.picture()
    assert jpeg is not None
    shown = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert abs(int(shown[600, 600, 0]) - 114) < 3
    assert abs(int(shown[2, 600, 0]) - 90) < 3


@pytest.mark.usefixtures("no_thread_is_left")
def test_clips_are_taken_of_masked_pictures_where_asked_for(
    model: Georeferencer, harbour: Harbour, tmp_path: Path
) -> None:
    hidden = np.zeros((720, 1280), dtype=bool)
    hidden[::2] = True
    camera, times = _camera(model, harbour)
    run = LiveRun(Scripted(times), camera)
    run.run(threading.Event())
    assert "clips" not in run.health()
    camera = replace(camera, mask=Mask(hidden))
    clips = ClipRecorder(tmp_path / "clips", settings=ClipSettings(most_waiting=1000))
    feed = Collects()
    run = LiveRun(Scripted(times), camera, feeds={"a": feed})
    run.record(clips)
    # Boxes are hidden where more than half of their lower part is.
    run.run(threading.Event())
    clips.close(30.0)
    assert run.health()["clips"] == {"left_out": 0, "problem": ""}
    ids = {target.id for moment in feed.moments for target in moment.targets}
    made = sorted((tmp_path / "clips").glob("*/*.mp4"))
    assert made
    assert {int(one.stem.split("-")[1]) for one in made} <= ids
    newest = run.newest()
    assert newest is not None
    # Every second row is grey: of the sea's own 90 and the mask's 114 the eye sees the mean.
    assert np.unique(newest.image_bgr).tolist() == [90, 114]
    picture = next(iter(frames(str(made[0]), start_utc_s=0.0))).image_bgr.astype(int)
    assert np.ptp(picture[5:9, 300:], axis=0).max() > 5


@pytest.mark.slow
def test_a_restart_carries_targets_on_and_uses_no_number_twice(
    model: Georeferencer, harbour: Harbour, tmp_path: Path
) -> None:
    camera, times = _camera(model, harbour)
    seen: list[Collects] = []
    # Three seconds are lost between the first two; the third comes an hour later.
    for some in (times[:100], times[130:], times + 3600.0):
        store = Store(tmp_path / "quay.db", camera="quay", plane=model.plane)
        feed = Collects()
        if some[0] > times[-1]:
            boxes = harbour.boxes(times, noise=LASTING, of="all")
            later = boxes.with_columns(time_utc_s=boxes.time_utc_s + 3600.0)
            camera = Camera("quay", model, Knows(later))
        run = LiveRun(
            Scripted(some),
            camera,
            feeds={"a": feed},
            keeper=Keeper(store),
            earlier=EarlierRun(store.highest_id(), store.kept_state()),
        )
        run.run(threading.Event())
        seen.append(feed)
    first, second, third = ({t.id for m in feed.moments for t in m.targets} for feed in seen)
    assert len(first & second) >= len(first) / 2
    assert not (first | second) & third
    assert min(third) == max(first | second) + 1
