"""A short clip of the pictures around each track, kept only where somebody asked for it."""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.moment import Moment, TargetState
from sightline.types import FloatArray, Frame
from sightline.video import write_video

SIZE_PX = (480, 270)
"""Width and height of a clip."""

_DAY_S = 86_400.0
_FORGET_EVERY_S = 3600.0
# Times of frames are no sums of their spacing.
_SLACK_S = 1e-3
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 88]
_FOLDER = re.compile(r"\d{4}-\d{2}-\d{2}")
_CLIP = re.compile(r"\d{6}-\d+\.mp4")
_LINE = (0, 200, 255)
# The picture is so many boxes wide and high, so that what is around is seen as well.
_AROUND = 3.0
_LEAST_SIDE_PX = 96.0


@dataclass(frozen=True)
class ClipSettings:
    """How clips are taken.

    Attributes:
        rate_hz: Pictures a second, at the most.
        longest_s: How long a clip is, at the most.
        fewest: Of pictures; a track that was seen in less has no clip.
        most_at_once: Tracks of which clips are taken at the same time.
        most_waiting: Pictures that wait to be looked at; the newest are left out beyond.
        gone_s: A clip ends when its target was not measured for so long.
    """

    rate_hz: float = 5.0
    longest_s: float = 20.0
    fewest: int = 5
    most_at_once: int = 12
    most_waiting: int = 4
    gone_s: float = 3.0


@dataclass
class _Clip:
    """The pictures of a track so far."""

    number: int
    begun_utc_s: float
    seen_utc_s: float
    pictures: list[tuple[float, bytes]] = field(default_factory=list)


class ClipRecorder:
    """Takes a clip of each track that moves, in a thread of its own.

    Clips lie in a folder a day, ``FOLDER/2024-06-01/101502-17.mp4``: the UTC time of the first
    picture, and the number of the target. Pictures are handed over masked.

    Attributes:
        left_out: Pictures that came while too many waited.
        problem: Why nothing can be written; empty where all is well.
    """

    def __init__(
        self,
        folder: Path,
        *,
        retention_days: float | None = None,
        settings: ClipSettings | None = None,
        told: Callable[[str], None] | None = None,
    ) -> None:
        """Take the folder; `start` begins.

        Args:
            folder: Is made where it is not there.
            retention_days: Clips of whole days that are older are removed; None: all are kept.
            settings: How clips are taken.
            told: Is told when nothing can be written, and when it can again.

        Raises:
            InputError: The folder cannot be made or written to.
        """
        self.left_out, self.problem = 0, ""
        self._folder, self._settings = folder, settings or ClipSettings()
        self._told = told
        self.change(retention_days)
        _check_folder(folder)
        self._waiting: deque[tuple[NDArray[np.uint8], Moment]] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._next_utc_s = -np.inf
        self._clips: dict[int, _Clip] = {}
        self._done: set[int] = set()
        self._thread = threading.Thread(target=self._run, daemon=True, name="sightline-clips")

    def change(self, retention_days: float | None) -> None:
        """Remove what is older than so many days, or nothing, from now on."""
        self._retention_s = None if retention_days is None else retention_days * _DAY_S
        self._forget_at_s = 0.0

    def start(self) -> None:
        """Begin to record."""
        self._thread.start()

    def offer(self, image_bgr: NDArray[np.uint8], moment: Moment) -> None:
        """Hand over a frame and what was found in it; returns at once.

        Args:
            image_bgr: (H, W, 3), masked; nobody writes to it any more.
            moment: Of it.
        """
        time_utc_s = moment.time_utc_s
        # A clock that was set back begins anew.
        if self._next_utc_s - 1.0 < time_utc_s < self._next_utc_s - _SLACK_S:
            return
        self._next_utc_s = time_utc_s + 1.0 / self._settings.rate_hz
        with self._changed:
            if len(self._waiting) >= self._settings.most_waiting:
                self.left_out += 1
                return
            self._waiting.append((image_bgr, moment))
            self._changed.notify_all()

    def close(self, timeout_s: float = 1.0) -> None:
        """Write the clips that are being taken, for so long at the most."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                if not (self._waiting or self._closing):
                    self._changed.wait(0.5)
                waiting, closing = list(self._waiting), self._closing
                self._waiting.clear()
            for image, moment in waiting:
                self._take(image, moment)
            self._forget()
            if closing:
                for clip in self._clips.values():
                    self._write(clip)
                return

    def _take(self, image: NDArray[np.uint8], moment: Moment) -> None:
        settings, now_s = self._settings, moment.time_utc_s
        for target in moment.targets:
            if target.state != "measured" or target.box_xyxy_px is None:
                continue
            clip = self._clips.get(target.id)
            if clip is None:
                if target.id in self._done or len(self._clips) >= settings.most_at_once:
                    continue
                clip = self._clips[target.id] = _Clip(target.id, now_s, now_s)
            done, jpeg = cv2.imencode(".jpg", around(image, target), _JPEG)
            if done and (not clip.pictures or now_s > clip.pictures[-1][0]):
                clip.pictures.append((now_s, jpeg.tobytes()))
            clip.seen_utc_s = now_s
        for clip in list(self._clips.values()):
            long = now_s - clip.begun_utc_s >= settings.longest_s
            gone = abs(now_s - clip.seen_utc_s) >= settings.gone_s
            if long or gone:
                del self._clips[clip.number]
                # One that was hardly seen may come again, and be seen better.
                if self._write(clip):
                    self._done.add(clip.number)
        # Numbers only grow: of those long past none comes again.
        if len(self._done) > 10_000:
            self._done = set(sorted(self._done)[-5_000:])

    def _write(self, clip: _Clip) -> bool:
        if len(clip.pictures) < self._settings.fewest:
            return False
        begun = datetime.fromtimestamp(clip.begun_utc_s, UTC)
        folder = self._folder / f"{begun:%Y-%m-%d}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_video(
                folder / f"{begun:%H%M%S}-{clip.number}.mp4",
                _frames(clip),
                bits_per_second=800_000,
                preset="superfast",
            )
        except (OSError, InputError) as error:
            if not self.problem:
                self.problem = str(error)
                self._tell(f"{self._folder}: no clip can be written: {error}")
            return True
        if self.problem:
            self.problem = ""
            self._tell(f"{self._folder}: clips are written again")
        return True

    def _forget(self) -> None:
        """Remove clips of days that are too old, and nothing that is not a clip."""
        now_s = time.time()
        if self._retention_s is None or now_s < self._forget_at_s:
            return
        self._forget_at_s = now_s + _FORGET_EVERY_S
        oldest = datetime.fromtimestamp(now_s - self._retention_s, UTC).strftime("%Y-%m-%d")
        with suppress(OSError):
            for folder in self._folder.iterdir():
                if not (_FOLDER.fullmatch(folder.name) and folder.name < oldest):
                    continue
                if folder.is_symlink() or not folder.is_dir():
                    continue
                for clip in folder.iterdir():
                    if _CLIP.fullmatch(clip.name):
                        clip.unlink()
                # Where something else lies in it, it stays.
                with suppress(OSError):
                    folder.rmdir()

    def _tell(self, text: str) -> None:
        if self._told is not None:
            self._told(text)


def around(image_bgr: NDArray[np.uint8], target: TargetState) -> NDArray[np.uint8]:
    """The picture around a target with its box drawn, `SIZE_PX`; black beyond the picture's edge.

    Args:
        image_bgr: (H, W, 3).
        target: Has a box.
    """
    assert target.box_xyxy_px is not None, "asked before"
    x1, y1, x2, y2 = target.box_xyxy_px
    width, height = SIZE_PX
    tall = max(_AROUND * (y2 - y1), _AROUND * (x2 - x1) * height / width, _LEAST_SIDE_PX)
    scale = height / tall
    middle = np.array([0.5 * (x1 + x2), 0.5 * (y1 + y2)])
    shift: FloatArray = 0.5 * np.array([width, height]) - scale * middle
    warp = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    seen = cv2.warpAffine(image_bgr, warp, SIZE_PX, flags=cv2.INTER_LINEAR)
    corners = [
        (round(scale * x + shift[0]), round(scale * y + shift[1])) for x, y in ((x1, y1), (x2, y2))
    ]
    cv2.rectangle(seen, corners[0], corners[1], _LINE, 2)
    cv2.putText(
        seen, str(target.id), (6, height - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _LINE, 1, cv2.LINE_AA
    )
    return np.asarray(seen)


def _frames(clip: _Clip) -> Iterator[Frame]:
    for index, (time_utc_s, jpeg) in enumerate(clip.pictures):
        image = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_COLOR)
        yield Frame(index, time_utc_s, np.asarray(image, dtype=np.uint8))


def _check_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".sightline-clips"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise InputError(f"{folder}: clips cannot be kept there ({error.strerror})") from error
