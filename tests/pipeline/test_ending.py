"""A source that ends too early leaves all that was tracked until then."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np
import pytest

from sightline import iter_tracks, track
from sightline.errors import BrokenOffError, InputError, StoppedError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline import track as tracking
from sightline.scene import Scene
from sightline.tracks import Tracks
from sightline.types import Boxes, Frame, Track

MOST = 24

Source = Callable[..., Iterator[Frame]]


class Fitted(Protocol):
    def __call__(self, model: str) -> Georeferencer: ...


class _AsDrawn:
    """A detector that finds what somebody drew, by the number of the frame."""

    def __init__(self, boxes: Boxes) -> None:
        self._boxes = boxes

    def detect(self, frame: Frame) -> Boxes:
        found = self._boxes[np.flatnonzero(self._boxes.frame == frame.index)]
        return found.with_columns(time_utc_s=np.full(len(found), frame.time_utc_s))

    def reset(self) -> None:
        """There is nothing to forget."""


@pytest.fixture(autouse=True)
def black_pictures_are_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """They show no shore by which a rotation could be seen."""
    monkeypatch.setattr("sightline.pipeline.camera_state._watch", lambda _: None)


@pytest.fixture(scope="module")
def model(fitted: Fitted) -> Georeferencer:
    return fitted("camera")


@pytest.fixture
def drawn(small_scene: Scene) -> Boxes:
    return small_scene.recordings[0].boxes()


def frames(
    drawn: Boxes, count: int = MOST, ends: Callable[[int], None] = lambda _: None
) -> Iterator[Frame]:
    """Black pictures at the times at which boxes were drawn; ``ends`` is called after the last."""
    indices, first = np.unique(drawn.frame, return_index=True)
    image = np.zeros((720, 1280, 3), dtype=np.uint8)
    for index, time_s in list(zip(indices, drawn.time_utc_s[first], strict=True))[:count]:
        yield Frame(int(index), float(time_s), image)
    ends(count)


def tracks_of(model: Georeferencer, drawn: Boxes, source: str = "v.mp4", **more: Any) -> Any:
    return iter_tracks(source, model, detector=_AsDrawn(drawn), **more)


def read_from(monkeypatch: pytest.MonkeyPatch, make: Callable[[], Iterator[Frame]]) -> None:
    monkeypatch.setattr(tracking.video, "frames", lambda *_, **__: make())
    monkeypatch.setattr(tracking, "frame_count", lambda _: None)


def raising(error: Exception) -> Callable[[int], None]:
    def fail(_: int) -> None:
        raise error

    return fail


def same(one: Track, other: Track) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("track_id", "time_utc_s", "east_m", "north_m", "covariance_m2")
    )


@pytest.fixture
def whole(model: Georeferencer, drawn: Boxes, monkeypatch: pytest.MonkeyPatch) -> list[Track]:
    """The tracks of a source that has no more frames than those before it breaks off."""
    with monkeypatch.context() as patch:
        read_from(patch, lambda: frames(drawn))
        made = list(tracks_of(model, drawn))
    assert made
    assert sum(map(len, made)) > 8
    return made


@pytest.mark.parametrize(
    ("source", "error"),
    [
        ("v.mp4", BrokenOffError("v.mp4: breaks off after 24 frames")),
        ("rtsp://camera", BrokenOffError("rtsp://camera: no frame for 30 s")),
        # Of a stream whatever is wrong with it from some frame on.
        ("rtsp://camera", InputError("rtsp://camera: its pictures have another size")),
    ],
)
def test_the_tracks_until_then_are_those_of_a_source_that_ends_there(
    model: Georeferencer,
    drawn: Boxes,
    whole: list[Track],
    monkeypatch: pytest.MonkeyPatch,
    source: str,
    error: Exception,
) -> None:
    read_from(monkeypatch, lambda: frames(drawn, MOST, raising(error)))
    made: list[Track] = []
    with pytest.raises(BrokenOffError, match=str(error)):
        made.extend(tracks_of(model, drawn, source))
    assert [same(a, b) for a, b in zip(made, whole, strict=True)] == [True] * len(whole)


def test_the_error_carries_the_tracks(
    model: Georeferencer, drawn: Boxes, whole: list[Track], monkeypatch: pytest.MonkeyPatch
) -> None:
    read_from(monkeypatch, lambda: frames(drawn, MOST, raising(BrokenOffError("breaks off"))))
    with pytest.raises(BrokenOffError) as raised:
        track("v.mp4", model, detector=_AsDrawn(drawn))
    made = raised.value.tracks
    assert isinstance(made, Tracks)
    assert [same(a, b) for a, b in zip(made, whole, strict=True)] == [True] * len(whole)


def test_what_is_wrong_with_a_file_is_refused(
    model: Georeferencer, drawn: Boxes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It can be mended and given again, other than a stream."""
    read_from(monkeypatch, lambda: frames(drawn, MOST, raising(InputError("another size"))))
    with pytest.raises(InputError, match="another size"):
        next(tracks_of(model, drawn))


def test_what_breaks_off_before_its_first_frame_is_refused(
    model: Georeferencer, drawn: Boxes, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_from(monkeypatch, lambda: frames(drawn, 0, raising(BrokenOffError("no frame"))))
    with pytest.raises(BrokenOffError, match="no frame"):
        next(tracks_of(model, drawn))


def test_an_event_ends_a_stream_that_is_silent(
    model: Georeferencer, drawn: Boxes, whole: list[Track], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stream says nothing more, and never ends; whoever has seen all its frames stops."""
    stop, for_ever = threading.Event(), threading.Event()
    seen, count = itertools.count(1), sum(1 for _ in frames(drawn))

    def tell(_what: str, _share: float) -> None:
        if next(seen) == count:
            stop.set()

    read_from(monkeypatch, lambda: frames(drawn, MOST, lambda _: bool(for_ever.wait()) or None))
    made = list(tracks_of(model, drawn, "rtsp://camera", stop=stop, progress=tell))
    for_ever.set()
    assert [same(a, b) for a, b in zip(made, whole, strict=True)] == [True] * len(whole)


def test_an_event_that_is_set_before_there_is_anything(
    model: Georeferencer, drawn: Boxes, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_from(monkeypatch, lambda: frames(drawn))
    stop = threading.Event()
    stop.set()
    with pytest.raises(StoppedError):
        next(tracks_of(model, drawn, stop=stop))
