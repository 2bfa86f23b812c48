"""A detector at work on the frames of a source, or of all recordings of a scene."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sightline import video
from sightline.camera.shoreline import StillPicture
from sightline.camera.static_intervals import StanceWatch, remember_stances, stances_known
from sightline.detection.detector import Detector
from sightline.detection.metadata import LowerEdge
from sightline.detection.onnx import OnnxDetector
from sightline.detection.registry import DEFAULT_DETECTOR, detector_by_name
from sightline.errors import InputError
from sightline.scene import Recording, Scene
from sightline.types import Boxes, FloatArray, Frame

Progress = Callable[[str, float], None]
"""Told what is being done and what share of it is done, 0 to 1; NaN where nobody knows."""


class Looker(Protocol):
    """Whatever is shown pictures one after another, and remembers of them what it is for.

    What it has found out it tells by attributes or methods of its own.
    """

    def look(self, frame: Frame) -> object:
        """Look at the next picture; they come in the order of time."""
        ...


def shown(frames: Iterable[Frame], lookers: Iterable[Looker]) -> Iterator[Frame]:
    """Hand pictures on, each when all have looked at it: one pass serves them all.

    Args:
        frames: In the order of time.
        lookers: Are shown each picture.
    """
    lookers = tuple(lookers)
    for frame in frames:
        for looker in lookers:
            looker.look(frame)
        yield frame


def detect(
    frames: Iterable[Frame],
    detector: Detector,
    count: int | None = None,
    progress: Progress | None = None,
) -> Iterator[Boxes]:
    """The boxes of each frame, as the detector finds them.

    Args:
        frames: In the order of time.
        detector: Finds boxes.
        count: How many frames there are, where that is known.
        progress: Told how far it is.
    """
    for i, frame in enumerate(frames):
        if progress:
            progress("detecting", (i + 1) / count if count else float("nan"))
        yield detector.detect(frame)


def frame_count(source: str | os.PathLike[str]) -> int | None:
    """How many frames a source has; None for a stream."""
    path = Path(source)
    if path.is_dir():
        return sum(1 for _ in path.iterdir())
    if "://" in str(source) or not path.is_file():
        return None
    return len(video.video_info(path).presentation_s)


def same_size(frames: Iterable[Frame], size_px: tuple[int, int], where: str) -> Iterator[Frame]:
    """Pass pictures on, and refuse those of another size than those that the model learned from.

    Raises:
        InputError: A picture has another size.
    """
    for frame in frames:
        own_px = (frame.image_bgr.shape[1], frame.image_bgr.shape[0])
        if own_px != size_px:
            raise InputError(
                f"{where}: its pictures have {own_px[0]} x {own_px[1]} px, the model learned "
                f"from {size_px[0]} x {size_px[1]} px; fit one to pictures of this size"
            )
        yield frame


def usable(frames: Iterable[Frame], size_px: tuple[int, int], where: str) -> Iterator[Frame]:
    """Pass pictures on, and refuse those that no target can be found and placed in.

    Raises:
        InputError: A picture has no time, or another size than those that the model learned from.
    """
    for frame in same_size(frames, size_px, where):
        if not np.isfinite(frame.time_utc_s):
            raise InputError(
                f"{where}: nothing tells the time of frame {frame.index}; give the start of the "
                "video (--start-utc), or a clock (--clock)"
            )
        yield frame


def lower_edges_of(detector: str) -> dict[str, LowerEdge | None]:
    """Where a detector's boxes end, by the name of their source.

    Args:
        detector: As `detector_by_name` takes it.

    Raises:
        InputError: The detector is not known.
    """
    made = detector_by_name(detector)
    return {made.name: made.lower_edge} if isinstance(made, OnnxDetector) else {}


class SceneDetections:
    """What is found in the pictures of a scene, decoded as seldom as can be.

    Whatever wants to look at a recording's pictures at the same time as the detector is shown them
    in the same pass. A pass holds one picture at a time.
    """

    def __init__(
        self,
        scene: Scene,
        detector: str | None = DEFAULT_DETECTOR,
        progress: Progress | None = None,
        *,
        stills: bool = False,
    ) -> None:
        """Take the detector's name.

        Args:
            scene: Whose recordings are to be looked at.
            detector: As `detector_by_name` takes it; None: no boxes are asked for.
            progress: Told how far it is.
            stills: Whether still pictures will be asked for too: then they are made in the
                detector's pass, and none of their own is needed.

        Raises:
            InputError: The detector is not known.
        """
        # Unknown names are told before the work begins.
        self._lower_edges = lower_edges_of(detector) if detector is not None else {}
        self._scene = scene
        self._detector = detector
        self._tell = progress or (lambda _what, _share: None)
        self._stills_wanted = stills
        self._found: dict[str, tuple[Boxes, FloatArray]] = {}
        self._stills: dict[str, NDArray[np.uint8]] = {}

    @property
    def lower_edges(self) -> Mapping[str, LowerEdge | None]:
        """Where the boxes of each source end, as far as the detectors' files tell."""
        return self._lower_edges

    def boxes(self, recording: Recording) -> Boxes:
        """The boxes in a recording's pictures, with their times.

        Raises:
            InputError: The pictures cannot be read, have no times, or another size than the
                scene's.
        """
        self._detect(recording)
        return self._found[recording.name][0]

    def times_utc_s(self, recording: Recording) -> FloatArray:
        """(N,) the times of its pictures; raises as `boxes`."""
        self._detect(recording)
        return self._found[recording.name][1]

    def still(self, recording: Recording) -> NDArray[np.uint8]:
        """(H, W) grey: what stands still in a recording's pictures; see `StillPicture`.

        Raises:
            InputError: The pictures cannot be read.
        """
        if recording.name not in self._stills:
            looker = StillPicture.of(recording)
            for frame in recording.frames():
                looker.look(frame)
                if looker.seen_enough:
                    break
            self._stills[recording.name] = looker.picture()
        return self._stills[recording.name]

    def _detect(self, recording: Recording) -> None:
        """Let the detector look at a recording's pictures, if it has not yet."""
        assert recording.source is not None, "a recording has boxes, detections or pictures"
        if recording.name in self._found:
            return
        assert self._detector is not None, "boxes are asked for where there is a detector"
        times = _Times()
        lookers: list[Looker] = [times]
        still: StillPicture | None = None
        if self._stills_wanted and recording.name not in self._stills:
            still = StillPicture.of(recording)
            lookers.append(still)
        stances: StanceWatch | None = None
        still_standing = self._scene.camera.watched and recording.platform_path is None
        if still_standing and not stances_known(recording):
            stances = StanceWatch()
            lookers.append(stances)
        where = f"recording {recording.name}"
        frames = usable(recording.frames(), self._scene.image_size_px, where)
        found = list(
            detect(
                shown(frames, lookers),
                detector_by_name(self._detector),
                frame_count(recording.source),
                lambda _what, share: self._tell(f"detecting in {recording.name}", share),
            )
        )
        self._found[recording.name] = Boxes.concatenate(found), np.array(times.utc_s)
        if stances is not None:
            remember_stances(recording, stances.stances)
        if still is not None:
            self._stills[recording.name] = still.picture()


class _Times:
    """Notes when pictures were taken."""

    def __init__(self) -> None:
        self.utc_s: list[float] = []

    def look(self, frame: Frame) -> None:
        self.utc_s.append(frame.time_utc_s)
