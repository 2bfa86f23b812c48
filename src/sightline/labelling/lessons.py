"""What the log of a target teaches a detector of the camera that filmed it, without a drawn box.

In each frame the log and the fitted camera say where the target is. What stands out there against
the median of the recording is proposed as its box; proposals that do not go with the log as their
neighbours in time do are left out. Of what moves elsewhere nothing is said: it may be another
target. The rest does not move, and so is none.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields

import cv2
import numpy as np

from sightline.detection import Detector
from sightline.errors import InputError
from sightline.formats.labels import Margin
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.labelling.expected import camera_of, learn_size
from sightline.labelling.proposals import IN_GAP, OUTSIDE, TOO_SMALL, Proposals, propose
from sightline.labelling.snapping import Background, Image
from sightline.overlap import iou
from sightline.plausibility import distance_m
from sightline.progress import Progress
from sightline.scene import Recording, Scene
from sightline.tally import Tally
from sightline.tracking.static_map import PASSED_BY, StaticMap, certainly_moves
from sightline.types import BoolArray, Boxes, FloatArray, Frame

_logger = logging.getLogger(__name__)

_EVERY_S = 1.0
_MOST_BYTES = 800_000_000
"""Of the frames that are kept in memory, of all recordings together."""
_BYTES_A_PX = 4
"""Three of the picture, and one of its contrast."""
_STEPS = 8.0
"""Steps of contrast that is kept, for a spread of the background."""
_MOST_FRAMES = 240
_SURE = 0.3
"""Confidence from which on nearly all proposals are right; see the how-to on labels."""
_SAME, _CONFIRMED = 0.3, 0.5
"""Overlap from which a detection is of what was proposed, and what its confidence is asked then."""
_NEIGHBOURS = 5
_APART = 4.0
"""Robust standard deviations by which a proposal may differ from its neighbours in time."""
_LEAST_APART = 0.15
"""Of a box's height: what differs by less is drawn from pixel to pixel."""
_FEWEST = 6
"""Proposals of a recording that tell whether one of them differs."""
_MOVES, _STANDS_OUT = 1.5, 5.0
"""Contrast, in spreads of the background: its mean in a box of something that is not always there,
and of a pixel that is certainly not of the background."""
_SPECK_PX = (4, 3, 12)
"""Width, height and area below which something that stands out teaches nothing either way."""
_UNSURE_SIGMAS = 4.0
_UNSURE_PX = 20.0
_FAR_KM = 2.0


@dataclass(frozen=True, eq=False)
class Lesson:
    """A frame, and what the log teaches of it.

    Attributes:
        recording: Name of its recording.
        frame: Number of it there.
        time_utc_s: POSIX seconds by the recording's clock.
        image_bgr: (H, W, 3) the picture.
        target_xyxy_px: (M, 4) box of the target, as tight as it stands out; M is 0 or 1.
        open_xyxy_px: (K, 4) regions of which nothing is known: what moves there may be another
            target, or the target where it was not found. In the rest there is none.
    """

    recording: str
    frame: int
    time_utc_s: float
    image_bgr: Image
    target_xyxy_px: FloatArray
    open_xyxy_px: FloatArray


@dataclass(frozen=True)
class TeacherSettings:
    """How a log teaches.

    Attributes:
        every_s: Frames that follow the last one sooner are left out.
        most_frames: Of all recordings together; of a longer one they are further apart.
        least_confidence: Of a proposal.
        margin: By which the boxes will be widened; what touches a widened box is of the target.
        keep_moored: Leave open what the detector is sure of and never moves; else it is none.
        sure_confidence: From which on it is sure.
    """

    every_s: float = _EVERY_S
    most_frames: int = _MOST_FRAMES
    least_confidence: float = _SURE
    margin: Margin = field(default_factory=Margin)
    keep_moored: bool = False
    sure_confidence: float = 0.25

    def __post_init__(self) -> None:
        if self.most_frames < 1 or not self.every_s >= 0.0:
            raise InputError("a log teaches with a frame or more, and a time of 0 s or more apart")


@dataclass(frozen=True, eq=False)
class _Remembered(Recording):
    """A recording of which some frames are in memory."""

    kept: tuple[Frame, ...] = ()

    @classmethod
    def of(cls, recording: Recording, kept: Sequence[Frame]) -> _Remembered:
        own = {one.name: getattr(recording, one.name) for one in fields(recording)}
        return cls(**own, kept=tuple(kept))

    def frames(self, *, apart_s: float = 0.0) -> Iterator[Frame]:  # noqa: ARG002
        return iter(self.kept)


def check_camera(scene: Scene, model: Georeferencer) -> None:
    """Refuse a model that is of another camera than a scene.

    Raises:
        InputError: It has no camera, one that moves, is for pictures of another size, or stands
            elsewhere.
    """
    camera_of(model)
    if model.moving:
        raise InputError(
            f"{scene.path}: its camera is on a vessel under way, so that nothing tells what never "
            "moves; a detector is tuned to a camera that stands still"
        )
    wide, high = model.image_size_px
    given = scene.image_size_px
    if given != (wide, high):
        raise InputError(
            f"{scene.path}: its pictures are {given[0]} x {given[1]} px, and the model is of a "
            f"camera with {wide} x {high} px; give the model that was fitted to this camera"
        )
    latitude, longitude = scene.camera.latitude_deg, scene.camera.longitude_deg
    if latitude is None or longitude is None:
        return
    plane = model.plane
    places = (plane.latitude_deg, plane.longitude_deg, latitude, longitude)
    away_km = float(distance_m(*map(np.asarray, places))) / 1000.0
    if away_km > _FAR_KM:
        raise InputError(
            f"{scene.path}: its camera stands {away_km:.0f} km from that of the model; give the "
            "model that was fitted to this camera"
        )


def learn_lessons(
    scene: Scene,
    model: Georeferencer,
    detector: Detector,
    settings: TeacherSettings,
    *,
    tally: Tally | None = None,
    progress: Progress | None = None,
) -> list[Lesson]:
    """Collect what the log of a scene teaches, in the order of recordings and time.

    Args:
        scene: Its recordings with pictures; those with a log show the target.
        model: Of its camera; its clock offsets are honoured.
        detector: With a low threshold, so that it proposes as much as it can.
        settings: How.
        tally: Counts frames and boxes, and what is left out.
        progress: Told what is done, and the share.

    Raises:
        InputError: The model is of another camera, no recording has both pictures and a log, the
            log is nowhere in view, or nothing moves where it is.
    """
    told = tally is not None
    tally = tally if tally is not None else Tally(scene.path)
    check_camera(scene, model)
    filmed = [one for one in scene.recordings if one.source is not None]
    if not any(one.fixes_path is not None for one in filmed):
        raise InputError(
            f"{scene.path}: no recording has both pictures and a log; give frames or video, and "
            "fixes"
        )
    size = learn_size(scene, model)
    made: list[Lesson] = []
    proposed: list[Proposals] = []
    share = _share_of(scene, settings, len(filmed))
    for number, recording in enumerate(filmed):
        if progress is not None:
            progress(f"looking at {recording.name}", number / len(filmed))
        kept = _sampled(recording, settings.every_s, share)
        tally.count("frames", len(kept))
        if len(kept) < 3:
            tally.leave_out("recording of fewer than three frames with times", row=recording.name)
            continue
        shown = _Remembered.of(recording, kept)
        background = Background.of(iter(kept), recording.name)
        found, stays = _detections(detector, kept)
        contrasts = [_contrast(background, frame) for frame in kept]
        moves = _moving(found, kept, contrasts)
        proposals = None
        if recording.fixes_path is not None:
            proposals = propose(
                shown,
                model,
                size,
                every_s=0.0,
                # Boxes along what stands out are closer than those of a network.
                detections=found[:0],
                background=background,
            )
            proposed.append(proposals)
        seen = _Seen(found, stays & ~moves, moves & ~stays, contrasts)
        made += _taught(recording, kept, proposals, seen, settings, tally)
    _check_taught(scene, proposed, made)
    if not told:
        tally.warn(_logger)
    return made


def _share_of(scene: Scene, settings: TeacherSettings, recordings: int) -> int:
    """How many frames of a recording are kept."""
    width, height = scene.image_size_px
    most = min(settings.most_frames, _MOST_BYTES // (_BYTES_A_PX * width * height))
    return max(most // recordings, 8)


def _sampled(recording: Recording, every_s: float, most: int) -> list[Frame]:
    """Frames spread evenly over a recording."""
    kept: list[Frame] = []
    last_s = -np.inf
    for frame in recording.frames(apart_s=every_s):
        if not np.isfinite(frame.time_utc_s) or frame.time_utc_s - last_s < every_s:
            continue
        kept.append(frame)
        last_s = frame.time_utc_s
        if len(kept) > most:
            kept = kept[::2]
            apart_s = np.diff([one.time_utc_s for one in kept])
            # Times are read to a part of the frame interval.
            every_s = max(2.0 * every_s, 0.9 * float(np.median(apart_s)))
            last_s = kept[-1].time_utc_s
    return kept


def _contrast(background: Background, frame: Frame) -> Image:
    """(H, W) uint8 contrast of a frame, in `_STEPS` a spread."""
    height, width = frame.image_bgr.shape[:2]
    contrast = background.contrast(frame.image_bgr, (0, 0, width, height))
    return np.asarray(np.minimum(_STEPS * contrast, 255.0), np.uint8)


def _detections(detector: Detector, frames: Sequence[Frame]) -> tuple[Boxes, BoolArray]:
    """What a detector sees in the frames of a recording, and what of that stays in its place."""
    detector.reset()
    found = Boxes.concatenate([detector.detect(frame) for frame in frames])
    places = StaticMap()
    places.update(found)
    places.finish()
    return found, np.asarray(places.at(found) != PASSED_BY)


def _moving(found: Boxes, frames: Sequence[Frame], contrasts: Sequence[Image]) -> BoolArray:
    """(N,) whether there is something in a box that is not there in most frames."""
    row = {frame.index: i for i, frame in enumerate(frames)}
    out = np.zeros(len(found), dtype=bool)
    for i, box in enumerate(found.xyxy_px):
        x1, y1 = np.maximum(np.floor(box[:2]), 0.0).astype(int)
        x2, y2 = np.ceil(box[2:]).astype(int) + 1
        out[i] = contrasts[row[int(found.frame[i])]][y1:y2, x1:x2].mean() > _STEPS * _MOVES
    return out


@dataclass(frozen=True, eq=False)
class _Seen:
    """What is to be seen in the frames of a recording besides its target.

    Attributes:
        found: Boxes of the detector.
        stays: (N,) whether each stays in its place.
        moves: (N,) whether each certainly does not.
        contrasts: Of each frame.
    """

    found: Boxes
    stays: BoolArray
    moves: BoolArray
    contrasts: Sequence[Image]


def _taught(
    recording: Recording,
    frames: Sequence[Frame],
    proposals: Proposals | None,
    seen: _Seen,
    settings: TeacherSettings,
    tally: Tally,
) -> list[Lesson]:
    sure = np.zeros(0, dtype=bool)
    if proposals is not None:
        sure = _sure(proposals, seen.found[seen.moves], settings)
    if proposals is not None:
        dropped = int((proposals.made & ~sure).sum())
        tally.leave_out("proposed boxes, unsure or not as their neighbours in time", dropped)
    out = []
    for i, frame in enumerate(frames):
        target, unsure = np.empty((0, 4)), np.empty((0, 4))
        if proposals is not None:
            reason = str(proposals.reason[i])
            if sure[i]:
                target = proposals.xyxy_px[i][None]
                tally.count("boxes")
            elif reason not in (IN_GAP, OUTSIDE):
                unsure = _around(proposals, i)
        open_px = _open(frame, seen, i, settings)
        if len(target):
            open_px = open_px[~_touch(open_px, settings.margin.widened(target[0]))]
        out.append(
            Lesson(
                recording.name,
                frame.index,
                frame.time_utc_s,
                frame.image_bgr,
                target,
                np.concatenate([open_px, unsure]),
            )
        )
    return out


def _sure(proposals: Proposals, moving: Boxes, settings: TeacherSettings) -> BoolArray:
    """(N,) which proposals are confident, and lie to the log as their neighbours in time do.

    What a detector sees as well, and does not stay, is confident sooner.
    """
    least = np.full(len(proposals), settings.least_confidence)
    for i in np.flatnonzero(proposals.made):
        seen = moving.xyxy_px[moving.frame == proposals.frame[i]]
        if len(seen) and (iou(proposals.xyxy_px[i], seen) >= _SAME).any():
            least[i] *= _CONFIRMED
    sure = proposals.made & (proposals.confidence >= least)
    rows = np.flatnonzero(sure)
    if rows.size < _FEWEST:
        return sure & (proposals.confidence >= 0.5)
    box, expected = proposals.xyxy_px[rows], proposals.expected.xyxy_px[rows]
    height = expected[:, 3] - expected[:, 1]
    off = np.column_stack(
        [
            0.5 * (box[:, 0] + box[:, 2] - expected[:, 0] - expected[:, 2]) / height,
            (box[:, 3] - expected[:, 3]) / height,
            np.log((box[:, 3] - box[:, 1]) / height),
        ]
    )
    apart = np.empty_like(off)
    for k in range(rows.size):
        near = np.argsort(np.abs(np.arange(rows.size) - k), kind="stable")[1 : 1 + 2 * _NEIGHBOURS]
        apart[k] = np.abs(off[k] - np.median(off[near], axis=0))
    allowed = np.maximum(_APART * 1.4826 * np.median(apart, axis=0), _LEAST_APART)
    sure[rows] = np.all(apart <= allowed, axis=1)
    # What stays is no vessel under way, whatever the log says of it.
    if not certainly_moves(
        Boxes.of(
            proposals.xyxy_px[sure],
            frame=proposals.frame[sure],
            time_utc_s=proposals.time_utc_s[sure],
        )
    ):
        sure[:] = False
    return np.asarray(sure)


def _around(proposals: Proposals, row: int) -> FloatArray:
    """(1, 4) where the target may be, though it was not found."""
    box = proposals.expected.xyxy_px[row]
    reach = _UNSURE_SIGMAS * proposals.expected.sigma_px[row] + _UNSURE_PX
    return np.asarray([[*(box[:2] - reach), *(box[2:] + reach)]])


def _open(frame: Frame, seen: _Seen, row: int, settings: TeacherSettings) -> FloatArray:
    """(K, 4) what moves in a frame, or is seen by the detector and does not certainly stay."""
    own = seen.found.frame == frame.index
    left = ~seen.stays[own]
    if settings.keep_moored:
        left |= seen.found.confidence[own] >= settings.sure_confidence
    hard = (seen.contrasts[row] > _STEPS * _STANDS_OUT).astype(np.uint8)
    hard = np.asarray(cv2.morphologyEx(hard, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)))
    _, _, stats, _ = cv2.connectedComponentsWithStats(hard)
    x, y, width, height, area = np.asarray(stats[1:], dtype=float).reshape(-1, 5).T
    large = (width >= _SPECK_PX[0]) & (height >= _SPECK_PX[1]) & (area >= _SPECK_PX[2])
    blobs = np.column_stack([x, y, x + width, y + height])[large]
    return np.concatenate([seen.found.xyxy_px[own][left], settings.margin.widened(blobs)])


def _touch(boxes: FloatArray, box: FloatArray) -> BoolArray:
    return np.asarray(
        (boxes[:, 0] < box[2])
        & (boxes[:, 2] > box[0])
        & (boxes[:, 1] < box[3])
        & (boxes[:, 3] > box[1])
    )


def _check_taught(scene: Scene, proposed: Sequence[Proposals], made: Sequence[Lesson]) -> None:
    """Refuse where there is no box to learn from, and say why."""
    if any(len(one.target_xyxy_px) for one in made):
        return
    reasons = [str(why) for one in proposed for why in one.reason]
    in_view = sum(why not in (IN_GAP, OUTSIDE, TOO_SMALL) for why in reasons)
    if not in_view:
        counted = ", ".join(f"{reasons.count(why)} {why}" for why in dict.fromkeys(reasons))
        raise InputError(
            f"{scene.path}: the log's vessel is never in view ({counted or 'no times'}); "
            "nothing can be learned from it. Give recordings in which it passes"
        )
    raise InputError(
        f"{scene.path}: by the log its vessel is in view in {in_view} frames, and nothing moves "
        "there as it does; is the model of this camera, and are the clocks right?"
    )
