"""When targets begin, go on and end, at the very limits that the settings name.

All times are whole multiples of a power of two, so that what is at a limit is exactly there.
"""

from __future__ import annotations

import pytest

from sightline.errors import InputError
from sightline.tracking import (
    ImageTracker,
    ImageTrackerSettings,
    WorldTracker,
    WorldTrackerSettings,
)
from sightline.types import Boxes

BOAT = [100.0, 100.0, 140.0, 124.0]
OTHER = [500.0, 100.0, 540.0, 124.0]
STEP = 0.125


def ids_at(
    tracker: ImageTracker | WorldTracker,
    time_utc_s: float,
    confidence: float = 0.9,
    box: list[float] = BOAT,
) -> list[int]:
    moment = Boxes.of([box], time_utc_s=time_utc_s, confidence=confidence)
    return tracker.update(moment).track_id.tolist()


def followed(settings: ImageTrackerSettings, until_s: float = 2.0) -> ImageTracker:
    """A tracker that has seen the boat from 0 to then, and has confirmed it as 1."""
    tracker = ImageTracker(settings)
    for i in range(round(until_s / STEP) + 1):
        found = ids_at(tracker, STEP * i)
    assert found == [1]
    return tracker


@pytest.mark.parametrize(("confirm_s", "expected"), [(0.5, [1]), (0.5001, [])])
def test_a_target_is_confirmed_once_followed_for_so_long(
    confirm_s: float, expected: list[int]
) -> None:
    tracker = ImageTracker(ImageTrackerSettings(confirm_s=confirm_s))
    assert [ids_at(tracker, 0.125 * i) for i in range(4)] == [[]] * 4
    assert ids_at(tracker, 0.5) == expected


@pytest.mark.parametrize(("silent_s", "left"), [(1.5, 1), (1.5 + STEP, 0)])
def test_a_confirmed_target_is_kept_for_the_coast(silent_s: float, left: int) -> None:
    tracker = followed(ImageTrackerSettings(coast_s=1.5, direct_s=9.0))
    # A frame between, or the next would be the one that is not late.
    assert ids_at(tracker, 2.0 + STEP, box=OTHER) == []
    ids_at(tracker, 2.0 + silent_s, box=OTHER)
    assert sum(known == 1 for known in tracker.state()["track_id"]) == left


@pytest.mark.parametrize(("missed_s", "expected"), [(0.25, [1]), (0.25 + STEP, [])])
def test_one_that_is_not_confirmed_is_kept_for_a_shorter_time_once_it_was_missed(
    missed_s: float, expected: list[int]
) -> None:
    settings = ImageTrackerSettings(confirm_s=0.375, coast_unconfirmed_s=0.25)
    tracker = ImageTracker(settings)
    assert ids_at(tracker, 0.0) == ids_at(tracker, STEP) == []
    assert ids_at(tracker, STEP + 0.0625, box=OTHER) == []
    assert ids_at(tracker, STEP + missed_s) == expected


def test_a_late_frame_ends_nothing_that_was_not_missed() -> None:
    tracker = ImageTracker(ImageTrackerSettings(confirm_s=1.0, coast_unconfirmed_s=0.25))
    assert ids_at(tracker, 0.0) == []
    assert ids_at(tracker, 1.0) == [1]


@pytest.mark.parametrize(("silent_s", "expected"), [(1.0, [1]), (1.0 + STEP, [])])
def test_single_boxes_are_given_to_what_was_just_seen(silent_s: float, expected: list[int]) -> None:
    tracker = followed(ImageTrackerSettings(coast_s=9.0, direct_s=1.0))
    ids_at(tracker, 2.0 + STEP, box=OTHER)
    assert ids_at(tracker, 2.0 + silent_s) == expected


def test_the_next_frame_is_never_too_late_for_a_target_of_the_last() -> None:
    tracker = followed(ImageTrackerSettings(coast_s=9.0, direct_s=1.0))
    assert ids_at(tracker, 5.0) == [1]
    # Neither is one that comes after it was in the frame before the last.
    tracker = followed(ImageTrackerSettings(coast_s=9.0, direct_s=1.0))
    ids_at(tracker, 4.0, box=OTHER)
    assert ids_at(tracker, 5.0) == []


@pytest.mark.parametrize(("silent_s", "expected"), [(1.0, [1]), (1.0 + STEP, [])])
def test_a_doubtful_box_goes_on_with_what_had_a_box_so_recently(
    silent_s: float, expected: list[int]
) -> None:
    tracker = followed(ImageTrackerSettings(doubtful_s=1.0))
    assert ids_at(tracker, 2.0 + silent_s, confidence=0.2) == expected


@pytest.mark.parametrize(("confidence", "expected"), [(0.25, [1]), (0.2499, [])])
def test_boxes_of_less_than_the_least_confidence_are_left_out(
    confidence: float, expected: list[int]
) -> None:
    tracker = followed(ImageTrackerSettings(sure_confidence=0.5, least_confidence=0.25))
    assert ids_at(tracker, 2.0 + STEP, confidence=confidence) == expected


@pytest.mark.parametrize(("confidence", "begun"), [(0.5, 1), (0.4999, 0)])
def test_boxes_of_less_than_the_sure_confidence_begin_no_target(
    confidence: float, begun: int
) -> None:
    tracker = ImageTracker(ImageTrackerSettings(sure_confidence=0.5))
    ids_at(tracker, 0.0, confidence=confidence)
    assert len(tracker) == begun


def test_a_doubtful_box_confirms_nothing() -> None:
    tracker = ImageTracker(ImageTrackerSettings(confirm_s=0.25, coast_unconfirmed_s=9.0))
    ids_at(tracker, 0.0)
    assert ids_at(tracker, 0.25, confidence=0.2) == []
    assert ids_at(tracker, 0.5) == [1]


def test_a_sure_box_is_taken_before_a_doubtful_one_that_lies_nearer() -> None:
    tracker = followed(ImageTrackerSettings())
    moment = Boxes.of([BOAT, [x + 3.0 for x in BOAT]], time_utc_s=2.0 + STEP, confidence=[0.2, 0.9])
    assert tracker.update(moment).xyxy_px[:, 0].tolist() == [103.0]


def test_a_confirmed_target_chooses_before_one_that_is_not() -> None:
    tracker = followed(ImageTrackerSettings(confirm_s=2.0))
    near = [x + 6.0 for x in BOAT]
    both = Boxes.of([BOAT, near], time_utc_s=2.0 + STEP)
    assert tracker.update(both).track_id.tolist() == [1]
    # The only box lies where the other one was.
    assert ids_at(tracker, 2.0 + 2 * STEP, box=near) == [1]


def test_limits_of_zero_are_allowed() -> None:
    tracker = ImageTracker(ImageTrackerSettings(confirm_s=0.0, coast_s=0.0, least_overlap=0.0))
    assert ids_at(tracker, 0.0) == [1]
    with pytest.raises(InputError, match=r"confirm_s is -0\.5"):
        WorldTrackerSettings(confirm_s=-0.5)
    with pytest.raises(InputError, match="gate is nan"):
        WorldTrackerSettings(gate=float("nan"))


def test_time_must_go_on() -> None:
    tracker = followed(ImageTrackerSettings())
    with pytest.raises(InputError, match="0 s before those seen last"):
        ids_at(tracker, 2.0)


def test_new_targets_are_numbered_in_the_order_of_their_boxes() -> None:
    tracker = ImageTracker(ImageTrackerSettings(confirm_s=0.0))
    third = [300.0, 300.0, 340.0, 324.0]
    assert tracker.update(Boxes.of([BOAT, OTHER], time_utc_s=0.0)).track_id.tolist() == [1, 2]
    moment = Boxes.of([third, OTHER, BOAT], time_utc_s=STEP)
    assert tracker.update(moment).track_id.tolist() == [3, 2, 1]
    moment = Boxes.of([[700.0, 300.0, 740.0, 324.0], third], time_utc_s=2 * STEP)
    assert tracker.update(moment).track_id.tolist() == [4, 3]
