"""What stays is told apart from what moves, whatever detectors do to its boxes."""

from __future__ import annotations

import numpy as np
import pytest

from sightline.camera.pinhole import Camera
from sightline.camera.rotation import compensate_rotation
from sightline.simulation import BoxNoise, Harbour, HarbourSettings
from sightline.tracking.static_map import (
    PASSED_BY,
    SLOWEST_SIZES_PER_S,
    StaticMap,
    StaticPlaces,
    certainly_moves,
)
from sightline.types import Boxes, FloatArray

_DETECTOR = BoxNoise(std_px=1.5, correlation_time_s=0.8, miss_probability=0.08)


def _boxes(
    times: FloatArray,
    centre: FloatArray,
    *,
    size: tuple[float, float] = (30.0, 18.0),
    jitter_px: float = 1.5,
    seed: int = 0,
    confidence: float = 0.8,
) -> Boxes:
    rng = np.random.default_rng(seed)
    middle = np.broadcast_to(centre, (times.size, 2))
    half = 0.5 * np.array(size)
    edges = np.concatenate([middle - half, middle + half], axis=1)
    edges = edges + rng.normal(0.0, jitter_px, edges.shape)
    return Boxes.of(edges, time_utc_s=times, confidence=np.full(times.size, confidence))


def _of_all(*parts: Boxes) -> Boxes:
    boxes = Boxes.concatenate(parts)
    return boxes[np.argsort(boxes.time_utc_s, kind="stable")]


def _learned(boxes: Boxes) -> StaticMap:
    made = StaticMap()
    made.update(boxes)
    made.finish()
    return made


@pytest.mark.parametrize("seed", range(6))
def test_boats_of_the_harbour_at_anchor_stay_and_those_under_way_do_not(seed: int) -> None:
    harbour = Harbour.random(seed, HarbourSettings(duration_s=120.0, anchored=6))
    boxes = harbour.boxes(harbour.times(5.0), noise=_DETECTOR, of="all")
    learned = _learned(boxes)
    told = 0
    for boat in harbour.boats:
        own = boxes[boxes.track_id == boat.identity]
        if len(own) < 400:
            continue
        share = float(learned.staying(own).mean())
        if boat.path.moves:
            assert share == 0.0, boat.name
            assert certainly_moves(own), boat.name
        else:
            told += share > 0.9
    hundred_seconds = sum(
        not boat.path.moves and (boxes.track_id == boat.identity).sum() >= 400
        for boat in harbour.boats
    )
    # Those of few pixels at 500 m take longer.
    assert told >= hundred_seconds - 1


def test_it_takes_longer_to_tell_of_small_boxes() -> None:
    first = []
    for size in ((60.0, 36.0), (20.0, 12.0), (10.0, 6.0)):
        times = np.arange(0.0, 180.0, 0.1)
        boxes = _boxes(times, np.array([400.0, 300.0]), size=size, jitter_px=0.5 * size[1] / 6.0)
        learned, told_s = StaticMap(), np.inf
        for i in range(0, len(boxes), 10):
            learned.update(boxes[i : i + 10])
            if len(learned.places()):
                told_s = float(times[i])
                break
        first.append(told_s)
    # A boat at a knot would have gone by more than its own length by then.
    assert min(first) * SLOWEST_SIZES_PER_S > 1.0
    assert max(first) < 180.0


@pytest.mark.parametrize("speed", [0.02, 0.125, 0.5])
@pytest.mark.parametrize("angle_deg", [0.0, 40.0, 80.0])
def test_a_slow_boat_never_stays(speed: float, angle_deg: float) -> None:
    # In sizes of its box a second, across the picture and towards the camera.
    times = np.arange(0.0, 120.0, 0.1)
    size = float(np.sqrt(30.0 * 18.0))
    way = np.array([np.cos(np.radians(angle_deg)), 0.2 * np.sin(np.radians(angle_deg))])
    centre = np.array([200.0, 300.0]) + speed * size * times[:, None] * way
    boxes = _boxes(times, centre)
    assert not _learned(boxes).staying(boxes).any()


def test_a_place_survives_gaps_and_misses() -> None:
    rng = np.random.default_rng(2)
    times = np.arange(0.0, 150.0, 0.1)
    times = times[rng.random(times.size) > 0.5]
    times = times[(times < 40.0) | (times > 75.0)]
    boxes = _boxes(times, np.array([400.0, 300.0]))
    learned = _learned(boxes)
    assert len(learned.places()) == 1
    assert learned.staying(boxes).all()


def test_a_boat_that_casts_off_is_under_way_within_two_seconds() -> None:
    times = np.arange(0.0, 150.0, 0.1)
    # From rest at 100 s, at 0.4 m/s², a boat of 8 m that is 40 px long.
    gone_m = 0.2 * np.maximum(times - 100.0, 0.0) ** 2
    centre = np.array([400.0, 300.0]) + 5.0 * gone_m[:, None] * np.array([1.0, 0.0])
    boxes = _boxes(times, centre, size=(40.0, 24.0))
    learned = _learned(boxes)
    staying = learned.staying(boxes)
    assert staying[times < 100.0].all()
    # By then it has gone 1.8 m, less than a fourth of its length.
    assert not staying[times > 103.0].any()
    before = StaticMap()
    before.update(boxes[times < 100.0])
    before.finish()
    assert before.staying(boxes[times < 100.0]).all()


def test_the_berth_of_a_boat_that_left_is_forgotten_and_remembered_of_it() -> None:
    times = np.arange(0.0, 300.0, 0.2)
    rests = _boxes(times[times < 100.0], np.array([400.0, 300.0]))
    other = _boxes(times, np.array([900.0, 300.0]), seed=1)
    learned = _learned(_of_all(rests, other))
    assert len(learned.places()) == 1
    assert learned.places().centre_px[0, 0] == pytest.approx(900.0, abs=1.0)
    assert learned.staying(rests).all()
    # Who comes there later is not taken for it.
    later = _boxes(times[times > 250.0], np.array([400.0, 300.0]))
    assert (learned.at(later) == PASSED_BY).all()


def test_who_passes_a_moored_boat_is_under_way_all_the_time() -> None:
    times = np.arange(0.0, 120.0, 0.1)
    rests = _boxes(times, np.array([640.0, 300.0]))
    passing = (times > 60.0) & (times < 100.0)
    centre = np.array([440.0, 300.0]) + (times[passing] - 60.0)[:, None] * np.array([10.0, 0.0])
    passes = _boxes(times[passing], centre, seed=1)
    learned = _learned(_of_all(rests, passes))
    assert not learned.staying(passes).any()
    assert learned.staying(rests).all()


def test_confidence_of_what_stays_is_its_mean_over_all_frames() -> None:
    rng = np.random.default_rng(5)
    times = np.arange(0.0, 200.0, 0.1)
    seldom = rng.random(times.size) < 0.2
    roof = _boxes(times[seldom], np.array([300.0, 200.0]), confidence=0.7)
    boat = _boxes(times, np.array([600.0, 300.0]), seed=1, confidence=0.8)
    moves = _boxes(times, np.array([100.0, 400.0]) + times[:, None] * [5.0, 0.0], seed=2)
    everything = _of_all(roof, boat, moves)
    learned = _learned(everything)
    assert np.median(learned.lowered(roof)) == pytest.approx(0.2 * 0.7, abs=0.02)
    assert np.median(learned.lowered(boat)) == pytest.approx(0.8, abs=0.02)
    assert (learned.lowered(moves) == moves.confidence).all()


def test_moments_without_boxes_count_against_what_is_seen_seldom() -> None:
    rng = np.random.default_rng(5)
    times = np.arange(0.0, 300.0, 0.1)
    roof = _boxes(times[rng.random(times.size) < 0.3], np.array([300.0, 200.0]), confidence=0.7)
    assert np.median(_learned(roof).lowered(roof)) == pytest.approx(0.3 * 0.7, abs=0.03)


def test_a_shaken_camera_does_not_matter_where_its_rotation_is_known() -> None:
    rng = np.random.default_rng(4)
    camera = Camera(*(5.0, 3.0, 0.0, 0.0, 1000.0, 0.0, 0.0, 0.0, 0.0), image_size_px=(1280, 720))
    times = np.arange(0.0, 120.0, 0.2)
    still = _boxes(times, np.array([700.0, 330.0]))
    rotation = np.zeros((times.size, 3))
    # Gusts of a few seconds, 10 px: more than the box of a boat lets pass.
    for axis in (0, 1):
        rotation[:, axis] = np.repeat(rng.normal(0.0, 0.01, times.size // 10), 10)
    shaken, _ = compensate_rotation(still.xyxy_px, -rotation, camera)
    seen = still.with_columns(xyxy_px=shaken)
    assert np.std(shaken[:, 0] - still.xyxy_px[:, 0]) > 5.0
    back, _ = compensate_rotation(shaken, rotation, camera)
    told = still.with_columns(xyxy_px=back)
    assert not _learned(seen).staying(seen).all()
    assert _learned(told).staying(told).all()


def test_what_is_known_holds_from_the_first_box() -> None:
    times = np.arange(0.0, 100.0, 0.1)
    boxes = _boxes(times, np.array([400.0, 300.0]))
    kept = StaticPlaces.of_array(_learned(boxes).places().to_array())
    assert kept.centre_px[0] == pytest.approx([400.0, 300.0], abs=0.5)
    assert kept.size_px[0] == pytest.approx([30.0, 18.0], rel=0.05)
    later = _boxes(times[:20] + 5000.0, np.array([400.0, 300.0]), seed=7)
    again = StaticMap(kept)
    again.update(later)
    again.finish()
    assert again.staying(later).all()
    moved = _boxes(times[:20] + 5000.0, np.array([430.0, 300.0]), seed=7)
    assert not again.staying(moved).any()


def test_recordings_at_any_times_add_up() -> None:
    learned, found = StaticMap(), []
    for i in (3, 1, 2, 0):
        times = np.arange(0.0, 6.0, 0.1) + 1e4 * i
        learned.update(_boxes(times, np.array([400.0, 300.0]), seed=i))
        learned.rest()
        found.append(len(learned.places()))
    assert (found[0], found[-1]) == (0, 1)


def test_what_was_learned_does_not_depend_on_the_batches() -> None:
    harbour = Harbour.random(2, HarbourSettings(duration_s=90.0))
    boxes = harbour.boxes(harbour.times(5.0), noise=_DETECTOR, of="all")
    whole, pieces = _learned(boxes), StaticMap()
    for i in range(0, len(boxes), 37):
        pieces.update(boxes[i : i + 37])
    pieces.finish()
    assert len(whole.places()) > 0
    assert np.array_equal(whole.places().to_array(), pieces.places().to_array())


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (np.zeros((2, 9)), "columns"),
        (np.full((1, 10), np.nan), "none"),
        (np.array([[1.0, 1.0, -5.0, 5.0, 1.0, 1.0, 20.0, 60.0, 0.5, 0.5]]), "none"),
        (np.array([[1.0, 1.0, 5.0, 5.0, 1.0, 1.0, 20.0, 60.0, 1.5, 0.5]]), "between 0 and 1"),
    ],
)
def test_places_of_a_damaged_file_are_refused(rows: FloatArray, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        StaticPlaces.of_array(rows)
