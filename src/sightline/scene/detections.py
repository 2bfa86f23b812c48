"""Detections in the frames of a scene, each frame decoded as seldom as can be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sightline.camera.shoreline import StillPicture
from sightline.camera.static_intervals import StaticIntervalMonitor
from sightline.detection.detector import Detector
from sightline.detection.metadata import LowerEdge
from sightline.detection.onnx import OnnxDetector
from sightline.detection.registry import DEFAULT_DETECTOR, detector_by_name, takes_options
from sightline.detection.run import FrameObserver, detect, observe, usable
from sightline.progress import Progress
from sightline.scene import Recording, Scene
from sightline.scene.camera_state import remember_static_intervals, static_intervals_known
from sightline.tally import Tally
from sightline.types import Boxes, FloatArray, Frame
from sightline.video.reader import frame_count

_EVERY_OF_VIDEO = 25


def lower_edges_of(detector: str | Detector) -> dict[str, LowerEdge | None]:
    """Lower-edge biases of a detector, by the names of its sources.

    Args:
        detector: As `detector_by_name` takes it.

    Raises:
        InputError: The detector is not known.
    """
    made = detector_by_name(detector)
    return dict(made.lower_edges) if isinstance(made, OnnxDetector) else {}


class DetectionObserver(Protocol):
    """Looks along while a detector goes through a recording."""

    def begin(self, recording: Recording) -> bool:
        """Whether it wants to see this one."""
        ...

    def observe(self, frame: Frame) -> object:
        """Observe the next frame."""
        ...

    def see(self, boxes: Boxes, time_utc_s: float) -> None:
        """See the boxes of a frame that was observed, and its time."""
        ...

    def end(self) -> None:
        """There are no more."""
        ...


class SceneDetections:
    """Detections in the frames of a scene, in one pass a recording.

    Whatever is to observe a recording's pictures as the detector does observes them in the same
    pass. A pass holds one picture at a time.

    Attributes:
        tally: What was found and left out, since it is masked.
    """

    def __init__(
        self,
        scene: Scene,
        detector: str | Detector | None = DEFAULT_DETECTOR,
        progress: Progress | None = None,
        *,
        stills: bool = False,
        observer: DetectionObserver | None = None,
    ) -> None:
        """Take the detector's name.

        Args:
            scene: Whose recordings are observed.
            detector: As `detector_by_name` takes it; None: no boxes are asked for.
            progress: Told how far it is.
            stills: Whether still pictures will be asked for too: then they are made in the
                detector's pass, and none of their own is needed.
            observer: Sees boxes as they are found.

        Raises:
            InputError: The detector is not known.
        """
        # Unknown names are told before the work begins.
        self._lower_edges = lower_edges_of(detector) if detector is not None else {}
        self._scene = scene
        self._detector = detector
        self._tell = progress or (lambda _what, _share: None)
        self._stills_wanted = stills
        self._observer = observer
        self._found: dict[str, tuple[Boxes, FloatArray]] = {}
        self._stills: dict[str, NDArray[np.uint8]] = {}
        self.tally = Tally(scene.path)

    @property
    def lower_edges(self) -> Mapping[str, LowerEdge | None]:
        """Lower-edge bias of each source, as far as the detectors' files tell."""
        return self._lower_edges

    def boxes(self, recording: Recording) -> Boxes:
        """Detected boxes in a recording's frames, with their times.

        Raises:
            InputError: The pictures cannot be read, have no times, or another size than the
                scene's.
        """
        self._detect(recording)
        boxes = self._found[recording.name][0]
        if not recording.clock_offset_s:
            return boxes
        return boxes.with_columns(time_utc_s=boxes.time_utc_s - recording.clock_offset_s)

    def times_utc_s(self, recording: Recording) -> FloatArray:
        """(N,) times of the recording's frames; raises as `boxes`."""
        self._detect(recording)
        return self._found[recording.name][1] - recording.clock_offset_s

    def still(self, recording: Recording) -> NDArray[np.uint8]:
        """(H, W) grey: the static scene of a recording; see `StillPicture`.

        Raises:
            InputError: The pictures cannot be read.
        """
        if recording.name not in self._stills:
            observer = still_picture(recording)
            for frame in recording.frames():
                observer.observe(frame)
                if observer.seen_enough:
                    break
            self._stills[recording.name] = observer.picture()
        return self._stills[recording.name]

    def _made(self, detector: str | Detector) -> Detector:
        """The detector, which looks at frames as the scene says where somebody only names it."""
        options = self._scene.looking if takes_options(detector) else None
        return detector_by_name(detector, options=options)

    def _detect(self, recording: Recording) -> None:
        """Run the detector on a recording's frames, unless it has been."""
        assert recording.source is not None, "a recording has boxes, detections or pictures"
        if recording.name in self._found:
            return
        assert self._detector is not None, "boxes are asked for where there is a detector"
        times = _Times()
        observers: list[FrameObserver] = [times]
        still: StillPicture | None = None
        if self._stills_wanted and recording.name not in self._stills:
            still = still_picture(recording)
            observers.append(still)
        static_intervals: StaticIntervalMonitor | None = None
        still_standing = self._scene.camera.compensate_rotation and recording.platform_path is None
        if still_standing and not static_intervals_known(recording):
            static_intervals = StaticIntervalMonitor()
            observers.append(static_intervals)
        observer = self._observer
        if observer is not None and observer.begin(recording):
            observers.append(observer)
        else:
            observer = None
        where = f"recording {recording.name}"
        frames = usable(recording.by_camera().frames(), self._scene.image_size_px, where)
        found: list[Boxes] = []
        for own in detect(
            observe(frames, observers),
            self._made(self._detector),
            frame_count(recording.source),
            lambda _what, share: self._tell(f"detecting in {recording.name}", share),
        ):
            found.append(own)
            if observer is not None:
                observer.see(own, times.utc_s[len(found) - 1])
        if observer is not None:
            observer.end()
        boxes = recording.unmasked(Boxes.concatenate(found), self.tally)
        self._found[recording.name] = boxes, np.array(times.utc_s)
        if static_intervals is not None:
            remember_static_intervals(recording, static_intervals.static_intervals)
        if still is not None:
            self._stills[recording.name] = still.picture()


class _Times:
    """Collects the times of frames."""

    def __init__(self) -> None:
        self.utc_s: list[float] = []

    def observe(self, frame: Frame) -> None:
        self.utc_s.append(frame.time_utc_s)


def still_picture(recording: Recording) -> StillPicture:
    """An observer for the median frame of a recording, from its first frame on."""
    # A folder holds pictures that somebody chose; in a video neighbours show the same waves.
    return StillPicture(every=1 if recording.frames_path is not None else _EVERY_OF_VIDEO)
