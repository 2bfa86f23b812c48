"""What counts as one thing that is seen."""

from __future__ import annotations

import numpy as np

from sightline.association.observations import SPLIT_S, TrackObservations, observe
from sightline.types import Boxes, FloatArray


def observed(times: FloatArray, left_px: FloatArray) -> TrackObservations:
    """One track id, of boxes of one size."""
    top = np.full(times.size, 300.0)
    return observe(
        Boxes.of(
            np.stack([left_px, top, left_px + 40.0, top + 20.0], axis=1),
            time_utc_s=1_717_236_000.0 + times,
            track_id=np.full(times.size, 7),
            source="detector",
        )
    )


def test_an_id_that_comes_back_after_long_is_of_something_else() -> None:
    """A tracker that begins its numbers anew gives one id to two vessels."""
    here, later = np.arange(0.0, 10.0, 0.25), np.arange(60.0, 75.0, 0.25)
    seen = observed(np.append(here, later), np.append(100.0 + here, 900.0 - later))
    assert seen.followed
    tracks = [np.unique(seen.track[seen.row_of_box[rows]]) for rows in np.split(range(100), [40])]
    assert [one.size for one in tracks] == [1, 1]
    assert tracks[0] != tracks[1]


def test_an_id_that_is_missed_for_moments_stays_one() -> None:
    times = np.arange(0.0, 30.0, 0.25)
    times = times[(times < 10.0) | (times >= 10.0 + 0.9 * SPLIT_S)]
    seen = observed(times, 100.0 + times)
    assert np.unique(seen.track).size == 1
