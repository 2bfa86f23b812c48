import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.errors import InputError
from sightline.simulation import BoxNoise, Harbour, HarbourSettings
from sightline.tracking import ImageTracker, ImageTrackerSettings
from sightline.types import NO_TRACK, Boxes


def _box(x: float, y: float, width: float = 40.0, height: float = 24.0) -> list[float]:
    return [x - width / 2, y - height / 2, x + width / 2, y + height / 2]


def _run(tracker: ImageTracker, moments: list[tuple[float, list[list[float]]]]) -> list[Boxes]:
    return [
        tracker.update(Boxes.of(boxes, time_utc_s=np.full(len(boxes), time_s), frame=i))
        for i, (time_s, boxes) in enumerate(moments)
    ]


def test_no_boxes_change_nothing() -> None:
    tracker = ImageTracker()
    assert len(tracker.update(Boxes.of([]))) == 0
    (out,) = _run(ImageTracker(ImageTrackerSettings(confirm_s=0.0)), [(5.0, [_box(9.0, 9.0)])])
    assert out.track_id.tolist() == [1]


def test_a_target_is_confirmed_after_the_stated_time_and_keeps_its_id() -> None:
    tracker = ImageTracker(ImageTrackerSettings(confirm_s=0.5))
    out = _run(tracker, [(0.1 * i, [_box(100.0 + 2.0 * i, 200.0)]) for i in range(20)])
    assert [len(boxes) for boxes in out] == [0] * 5 + [1] * 15
    assert {int(i) for boxes in out for i in boxes.track_id} == {1}


def test_an_identity_survives_a_gap_and_ends_after_the_coast() -> None:
    rng = np.random.default_rng(0)
    for gap_s, ids in ((2.0, {1}), (5.0, {1, 2})):
        tracker = ImageTracker()
        times = np.arange(0.0, 12.0, 0.1)
        times = times[(times < 5.0) | (times > 5.0 + gap_s)]
        moments = [
            (t, [_box(100.0 + 25.0 * t + rng.normal(0, 1), 200.0 + rng.normal(0, 1))])
            for t in times.tolist()
        ]
        assert {int(i) for out in _run(tracker, moments) for i in out.track_id} == ids


def test_identities_survive_a_crossing_in_which_one_hides_the_other() -> None:
    rng = np.random.default_rng(1)
    moments, owners = [], []
    for t in np.arange(0.0, 12.0, 0.08).tolist():
        near = _box(100.0 + 40.0 * t, 210.0, 60.0, 40.0)
        far = _box(600.0 - 40.0 * t, 200.0, 24.0, 14.0)
        hidden = near[0] < 0.5 * (far[0] + far[2]) < near[2]
        boxes = [near] if hidden else [near, far]
        order = rng.permutation(len(boxes))
        noisy = [(np.array(boxes[i]) + rng.normal(0.0, 0.7, 4)).tolist() for i in order]
        moments.append((t, noisy))
        owners.append([int(i) for i in order])
    ids: dict[int, set[int]] = {0: set(), 1: set()}
    for out, (_, boxes), owner in zip(_run(ImageTracker(), moments), moments, owners, strict=True):
        for row, track_id in zip(out.xyxy_px.tolist(), out.track_id.tolist(), strict=True):
            ids[owner[boxes.index(row)]].add(track_id)
    assert [len(ids[0]), len(ids[1])] == [1, 1]
    assert ids[0] != ids[1]


def test_irregular_times_are_no_matter() -> None:
    rng = np.random.default_rng(2)
    times = np.cumsum(rng.uniform(0.02, 0.5, 60))
    out = _run(ImageTracker(), [(t, [_box(50.0 + 60.0 * t, 300.0)]) for t in times.tolist()])
    assert {int(i) for boxes in out for i in boxes.track_id} == {1}
    assert sum(len(boxes) for boxes in out) >= 55


def test_a_frame_a_second_is_enough() -> None:
    out = _run(ImageTracker(), [(float(t), [_box(50.0 + 8.0 * t, 300.0)]) for t in range(10)])
    assert [boxes.track_id.tolist() for boxes in out] == [[]] + [[1]] * 9


def test_ids_belong_to_the_instance_and_go_on_after_a_reset() -> None:
    one, other = ImageTracker(), ImageTracker()
    moments = [(0.1 * i, [_box(100.0, 100.0), _box(300.0, 100.0)]) for i in range(10)]
    assert sorted(_run(one, moments)[-1].track_id.tolist()) == [1, 2]
    assert sorted(_run(other, moments)[-1].track_id.tolist()) == [1, 2]
    one.reset()
    assert sorted(_run(one, moments)[-1].track_id.tolist()) == [3, 4]


def test_times_must_be_known_alike_and_increasing() -> None:
    tracker = ImageTracker()
    box = [_box(10.0, 10.0)]
    tracker.update(Boxes.of(box, time_utc_s=2.0))
    with pytest.raises(InputError, match="in the order of time"):
        tracker.update(Boxes.of(box, time_utc_s=1.5))
    with pytest.raises(InputError, match="several"):
        tracker.update(Boxes.of(box * 2, time_utc_s=[3.0, 4.0]))
    with pytest.raises(InputError, match="several"):
        tracker.update(Boxes.of(box))
    with pytest.raises(InputError, match="coast_s is -1"):
        ImageTrackerSettings(coast_s=-1.0)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31))
def test_what_comes_out_went_in_and_no_id_is_given_twice_at_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracker = ImageTracker()
    for i in range(15):
        n = int(rng.integers(1, 8))
        boxes = [_box(*rng.uniform(20, 600, 2), *rng.uniform(4, 90, 2)) for _ in range(n)]
        given_boxes = Boxes.of(boxes, time_utc_s=0.2 * i, frame=i, source="x")
        out = tracker.update(given_boxes)
        assert {tuple(row) for row in out.xyxy_px} <= {tuple(row) for row in given_boxes.xyxy_px}
        assert (out.track_id != NO_TRACK).all()
        assert np.unique(out.track_id).size == len(out)
        assert (out.frame == i).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_boats_of_a_harbour_are_told_apart(seed: int) -> None:
    harbour = Harbour.random(seed, HarbourSettings(duration_s=60.0))
    noise = BoxNoise(std_px=1.5, correlation_time_s=0.8, miss_probability=0.08)
    times = harbour.times(10.0)
    boxes = harbour.boxes(times, noise=noise, of="all")
    tracker = ImageTracker()
    pairs = []
    for frame in range(times.size):
        rows = boxes[boxes.frame == frame]
        owner = dict(zip(map(tuple, rows.xyxy_px.tolist()), rows.track_id.tolist(), strict=True))
        out = tracker.update(rows.with_columns(track_id=np.full(len(rows), NO_TRACK)))
        pairs += [
            (owner[tuple(row)], track)
            for row, track in zip(out.xyxy_px.tolist(), out.track_id.tolist(), strict=True)
        ]
    boat, track = np.array(pairs).T
    assert len(pairs) > 0.97 * len(boxes)
    # Most boxes of a track are of one boat, and most of a boat's in one track.
    pure = sum(np.bincount(boat[track == k]).max() for k in np.unique(track))
    whole = sum(np.bincount(track[boat == k]).max() for k in np.unique(boat))
    assert pure > 0.97 * len(pairs)
    assert whole > 0.85 * len(pairs)


@pytest.mark.parametrize(("times", "same"), [(2.6, True), (3.4, False)])
def test_a_box_of_another_size_is_of_something_else(times: float, same: bool) -> None:
    tracker = ImageTracker()
    moments = [(0.1 * i, [_box(200.0, 100.0)]) for i in range(20)]
    moments += [(2.0 + 0.1 * i, [_box(200.0, 100.0, 40.0 * times, 24.0 * times)]) for i in range(8)]
    out = _run(tracker, moments)
    assert [1 in boxes.track_id for boxes in out[20:]] == [same] * 8
