"""What never moves, told apart while boxes become tracks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from scipy.stats import norm

from sightline.camera.state import ObservedBoxes
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.logged_motion import SLOWEST_MPS
from sightline.tracking.static_map import SURE, StaticMap, StaticPlaces, certainly_moves
from sightline.types import BoolArray, Boxes, FloatArray, Track

TOLD_S = 120.0
"""A minute tells of boxes of ten pixels whether they stay, and two where half are missed."""

# Squared Mahalanobis distance in two dimensions that chance exceeds as seldom as `SURE`.
_CERTAIN = float(-2.0 * np.log(2.0 * norm.sf(SURE)))


class MooredTeller:
    """Learns from boxes what stays before a camera, and tells it in its tracks.

    A camera on a vessel under way has nothing that stays.
    """

    def __init__(self, model: Georeferencer, *, enabled: bool = True) -> None:
        """Begin with what the model knows of its camera's view.

        Args:
            model: Its boxes are compensated to its camera.
            enabled: Without, nothing is learned and nothing is told.
        """
        able = enabled and not model.moving
        self._map = StaticMap(model.static_places) if able else None

    def lowered(self, boxes: ObservedBoxes) -> ObservedBoxes:
        """Boxes that were learned from, of less confidence where they stay.

        Args:
            boxes: Compensated, later than those before, in the order of time.
        """
        if self._map is None or not len(boxes):
            return boxes
        self._map.update(boxes)
        confidence = self._map.lowered(boxes)
        if (confidence == boxes.confidence).all():
            return boxes
        return ObservedBoxes.at(boxes.boxes.with_columns(confidence=confidence), boxes.state)

    def learned(self, batches: Iterable[ObservedBoxes]) -> Iterator[ObservedBoxes]:
        """Pass on batches that were learned from, in any order within each."""
        for boxes in batches:
            if self._map is not None and len(boxes):
                self._map.update(boxes[np.argsort(boxes.time_utc_s, kind="stable")])
            yield boxes
        self.finish()

    def finished(self, batches: Iterable[Boxes]) -> Iterator[Boxes]:
        """Pass on batches; with the last of them there is nothing more to be learned."""
        yield from batches
        self.finish()

    def finish(self) -> None:
        """Learn from the last boxes."""
        if self._map is not None:
            self._map.finish()

    def knows(self, track: Track) -> bool:
        """Whether enough was seen since a track began to tell whether its target stays."""
        return self._map is None or self._map.now_s >= track.time_utc_s[0] + TOLD_S

    def told(self, track: Track, boxes: Boxes) -> Track:
        """A track with where its target stayed.

        What stays in the image, and has certainly moved on the earth faster than the slowest
        boat, is under way: far away, straight towards the camera.

        Args:
            track: Smooth.
            boxes: It was made of, compensated, in the order of time.
        """
        if self._map is None:
            return track
        staying, place = self._map.staying(boxes), self._map.at(boxes)
        if not staying.any():
            return replace(track, untold=not certainly_moves(boxes))
        moored = np.zeros(len(track), dtype=bool)
        times = boxes.time_utc_s
        cuts = np.flatnonzero(np.diff(staying)) + 1
        for part in np.split(np.arange(len(boxes)), cuts):
            if staying[part[0]]:
                # Points between two boxes of the same part are in it, too.
                inside = (track.time_utc_s >= times[part[0]]) & (
                    track.time_utc_s <= times[part[-1]]
                )
                # What is taken for its neighbours goes to and fro between them.
                alone = place[part[0]] == place[part[-1]]
                if not (alone and _goes(track, inside)):
                    moored |= inside
        return replace(track, moored=moored)

    def places(self) -> StaticPlaces | None:
        """The places that stay; None where there can be none."""
        return None if self._map is None else self._map.places()


def _goes(track: Track, rows: BoolArray) -> bool:
    """Whether a part of a track has certainly moved, and as fast as a boat under way."""
    of = np.flatnonzero(rows)
    if of.size < 2:
        return False
    first, last = int(of[0]), int(of[-1])
    moved_m: FloatArray = np.array(
        [track.east_m[last] - track.east_m[first], track.north_m[last] - track.north_m[first]]
    )
    seconds = float(track.time_utc_s[last] - track.time_utc_s[first])
    if np.hypot(*moved_m) < SLOWEST_MPS * seconds:
        return False
    covariance = track.covariance_m2[first] + track.covariance_m2[last]
    if not np.isfinite(covariance).all():
        return False
    return bool(moved_m @ np.linalg.solve(covariance, moved_m) > _CERTAIN)


def learn_places(
    recordings: Iterable[Iterable[ObservedBoxes]], model: Georeferencer
) -> StaticPlaces | None:
    """Places that hold a detection that stays, learned from all recordings of a camera.

    Args:
        recordings: The boxes of each, with the state of the camera.
        model: To whose camera they are compensated.

    Returns:
        None where the camera does not stand still, or nothing stays.
    """
    if model.moving:
        return None
    learned = StaticMap(model.static_places)
    for batches in recordings:
        for boxes in map(model.compensated, batches):
            learned.update(boxes[np.argsort(boxes.time_utc_s, kind="stable")])
        learned.rest()
    found = learned.places()
    return found if len(found) else None
