"""The stages in a row: from a source to boxes, to tracks, to a score, and a whole scene at once."""

from sightline.detection import Progress, detect
from sightline.pipeline.scoring import (
    Placed,
    compare,
    evaluate,
    leave_one_out,
    place_boxes,
    score,
    with_forecasts,
)
from sightline.pipeline.standing import camera_turns
from sightline.pipeline.tracking import (
    DEFAULT_TRAJECTORY,
    TrackSettings,
    iter_tracks,
    smooth_boxes,
    track,
)
from sightline.pipeline.whole import RunResult, run

__all__ = [
    "DEFAULT_TRAJECTORY",
    "Placed",
    "Progress",
    "RunResult",
    "TrackSettings",
    "camera_turns",
    "compare",
    "detect",
    "evaluate",
    "iter_tracks",
    "leave_one_out",
    "place_boxes",
    "run",
    "score",
    "smooth_boxes",
    "track",
    "with_forecasts",
]
