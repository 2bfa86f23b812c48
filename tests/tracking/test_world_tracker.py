from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.platform import Platform, on_earth
from sightline.tracking import ImageTracker, TargetTracker, WorldTracker, WorldTrackerSettings
from sightline.types import BodyPositions, Boxes, Fixes, FloatArray, Headings, Positions

HEIGHT_M, FOCAL_PX, HORIZON_PX, CENTRE_PX = 6.0, 1000.0, 200.0, 640.0


def locate(seen: Boxes) -> Positions:
    """A level camera, and edges good to a pixel; nothing above the horizon has a place."""
    boxes = seen.xyxy_px
    down = boxes[:, 3] - HORIZON_PX
    known = down > 3.0
    down = np.where(known, down, np.nan)
    north = HEIGHT_M * FOCAL_PX / down
    sideways = (0.5 * (boxes[:, 0] + boxes[:, 2]) - CENTRE_PX) / FOCAL_PX
    jacobian = np.zeros((len(boxes), 2, 2))
    jacobian[:, 0, 0] = north / FOCAL_PX
    jacobian[:, 0, 1] = -sideways * north / down
    jacobian[:, 1, 1] = -north / down
    return Positions(
        east_m=sideways * north,
        north_m=north,
        covariance_m2=jacobian @ np.swapaxes(jacobian, 1, 2),
        extrapolated=~known,
        plane=LocalPlane(54.0, 10.0),
    )


def box_of(east: float, north: float, length: float = 8.0, height: float = 3.0) -> list[float]:
    x, foot = CENTRE_PX + FOCAL_PX * east / north, HORIZON_PX + HEIGHT_M * FOCAL_PX / north
    half = 0.5 * length * FOCAL_PX / north
    return [x - half, foot - height * FOCAL_PX / north, x + half, foot]


def run(
    tracker: TargetTracker,
    times: FloatArray,
    boats: list[Callable[[float], tuple[float, float]]],
    seen: Callable[[int, float], bool] = lambda _i, _t: True,
    noise_px: float = 0.7,
) -> list[tuple[float, int, int]]:
    """(time, boat, track) for each box that came out."""
    rng = np.random.default_rng(0)
    out = []
    for frame, time_s in enumerate(times.tolist()):
        there = [i for i in range(len(boats)) if seen(i, time_s)]
        if not there:
            continue
        xyxy = np.array([box_of(*boats[i](time_s)) for i in there])
        xyxy = xyxy + rng.normal(0.0, noise_px, xyxy.shape)
        order = rng.permutation(len(there))
        given = Boxes.of(xyxy[order], time_utc_s=time_s, frame=frame)
        owner = {tuple(xyxy[k].tolist()): there[k] for k in range(len(there))}
        found = tracker.update(given)
        out += [
            (time_s, owner[tuple(row)], track)
            for row, track in zip(found.xyxy_px.tolist(), found.track_id.tolist(), strict=True)
        ]
    return out


def ids_of(out: list[tuple[float, int, int]], boat: int) -> set[int]:
    return {track for _, owner, track in out if owner == boat}


def irregular(seconds: float) -> FloatArray:
    """Eight frames a second on average, some of them lost, and a second without any."""
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.05, 0.2, int(12 * seconds)))
    kept = (rng.random(times.size) > 0.1) & ((times < 4.0) | (times > 5.0))
    return times[kept & (times < seconds)]


@pytest.mark.parametrize("hidden_s", [3.0, 6.0, 10.0])
def test_an_identity_is_kept_through_an_occlusion_of_seconds(hidden_s: float) -> None:
    out = run(
        WorldTracker(locate),
        irregular(30.0),
        [lambda t: (-60.0 + 4.0 * t, 110.0), lambda t: (70.0 - 4.0 * t, 160.0)],
        lambda boat, t: boat == 1 or not 10.0 < t < 10.0 + hidden_s,
    )
    assert len(ids_of(out, 0)) == len(ids_of(out, 1)) == 1
    assert ids_of(out, 0) != ids_of(out, 1)


def test_one_that_stopped_being_seen_is_not_taken_up_by_one_that_cannot_be_it() -> None:
    def second(t: float) -> tuple[float, float]:
        return (60.0 - 5.0 * (t - 14.0), 60.0)

    out = run(
        WorldTracker(locate),
        np.arange(0.0, 25.0, 0.1),
        [lambda t: (-60.0 + 5.0 * t, 150.0), second],
        lambda boat, t: t < 10.0 if boat == 0 else t > 14.0,
    )
    assert ids_of(out, 0).isdisjoint(ids_of(out, 1))


def test_what_is_lost_for_longer_than_the_coast_comes_back_as_another() -> None:
    out = run(
        WorldTracker(locate, WorldTrackerSettings(coast_s=4.0)),
        np.arange(0.0, 25.0, 0.1),
        [lambda t: (-50.0 + 4.0 * t, 120.0)],
        lambda _boat, t: not 8.0 < t < 14.0,
    )
    assert ids_of(out, 0) == {1, 2}


def test_boats_that_pass_each_other_in_the_image_are_told_apart_by_their_ranges() -> None:
    boats = [lambda t: (-40.0 + 4.0 * t, 80.0), lambda t: (80.0 - 8.0 * t, 160.0)]

    def seen(boat: int, t: float) -> bool:
        if boat == 0:
            return True
        near, far = (box_of(*place(t)) for place in boats)
        return not (near[0] < 0.5 * (far[0] + far[2]) < near[2])

    out = run(WorldTracker(locate), np.arange(0.0, 20.0, 0.1), boats, seen)
    assert len(ids_of(out, 0)) == len(ids_of(out, 1)) == 1
    assert ids_of(out, 0) != ids_of(out, 1)


def test_what_has_no_place_is_followed_in_the_image() -> None:
    tracker = WorldTracker(locate)
    found = []
    for i in range(20):
        gull = [300.0 + 3.0 * i, 60.0, 320.0 + 3.0 * i, 75.0]
        found.append(tracker.update(Boxes.of([gull], time_utc_s=0.1 * i)))
    assert {int(i) for boxes in found for i in boxes.track_id} == {1}
    assert tracker.estimates().track_id.size == 0


@pytest.mark.slow
def test_estimates_follow_the_truth_with_an_honest_covariance() -> None:
    inside = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        tracker = WorldTracker(locate)
        speed = rng.uniform(-3.0, 3.0, 2)
        start = np.array([rng.uniform(-40.0, 40.0), rng.uniform(60.0, 150.0)])
        for time_s in np.arange(0.0, 12.0, 0.5).tolist():
            box = np.array(box_of(*(start + time_s * speed)))
            # Errors of the edges are those that `locate` states.
            error = rng.normal(0.0, 1.0, 2)
            tracker.update(
                Boxes.of([box + np.array([error[0], 0.0, error[0], error[1]])], time_utc_s=time_s)
            )
        known = tracker.estimates()
        off = known.mean[0] - np.concatenate([start + time_s * speed, speed])
        inside.append(float(off @ np.linalg.solve(known.covariance[0], off)) < 9.488)
        assert known.track_id.tolist() == [1]
        assert known.time_utc_s == known.seen_utc_s[0] == time_s
    assert np.mean(inside) >= 0.9


@pytest.mark.parametrize("kind", ["image", "world"])
def test_doubtful_boxes_go_on_with_a_target_and_begin_none(kind: str) -> None:
    tracker = ImageTracker() if kind == "image" else WorldTracker(locate)
    ids = []
    for i in range(40):
        boat, clutter = box_of(-20.0 + 0.3 * i, 100.0), box_of(30.0, 60.0)
        sure = 0.9 if i < 15 or i > 25 else 0.2
        found = tracker.update(
            Boxes.of([boat, clutter], time_utc_s=0.1 * i, confidence=[sure, 0.2], label=["b", "c"])
        )
        ids += list(zip(found.label.tolist(), found.track_id.tolist(), strict=True))
    assert set(ids) == {("b", 1)}
    assert len(ids) >= 35


@pytest.mark.parametrize("kind", ["image", "world"])
def test_a_run_that_is_resumed_gives_the_ids_of_one_that_was_not(kind: str) -> None:
    def new() -> TargetTracker:
        return ImageTracker() if kind == "image" else WorldTracker(locate)

    rng = np.random.default_rng(5)
    moments = []
    for i in range(120):
        here = [box_of(-50.0 + 0.4 * i, 90.0), box_of(50.0 - 0.5 * i, 140.0)]
        if 40 <= i < 75:
            here = here[1:]
        noisy = np.array(here) + rng.normal(0.0, 0.5, (len(here), 4))
        moments.append(Boxes.of(noisy, time_utc_s=1e9 + 0.1 * i, frame=i))
    whole, first = new(), new()
    expected = [whole.update(boxes).track_id.tolist() for boxes in moments]
    got = [first.update(boxes).track_id.tolist() for boxes in moments[:50]]
    saved = json.dumps(first.state(), allow_nan=False)
    second = new()
    second.restore(json.loads(saved))
    got += [second.update(boxes).track_id.tolist() for boxes in moments[50:]]
    assert got == expected
    assert json.loads(json.dumps(new().state(), allow_nan=False)) == new().state()


@pytest.mark.parametrize("kind", ["image", "world"])
def test_many_moments_at_once_get_the_ids_of_one_after_the_other(kind: str) -> None:
    def new() -> TargetTracker:
        return ImageTracker() if kind == "image" else WorldTracker(locate)

    rng = np.random.default_rng(6)
    moments = []
    for i in range(150):
        here = [box_of(-50.0 + 0.4 * i, 90.0), box_of(50.0 - 0.5 * i, 140.0), box_of(0.0, 40.0)]
        kept = rng.random(3) < 0.8
        # Some have no place: they are above the horizon.
        high = [[300.0 + i, 20.0, 340.0 + i, 50.0]]
        noisy = np.array(here)[kept] + rng.normal(0.0, 0.5, (int(kept.sum()), 4))
        sure = rng.uniform(0.2, 1.0, len(noisy) + 1)
        moments.append(
            Boxes.of(np.concatenate([noisy, high]), time_utc_s=1e9 + 0.1 * i, confidence=sure)
        )
    one, several = new(), new()
    expected = Boxes.concatenate([one.update(boxes) for boxes in moments])
    got = Boxes.concatenate(
        [several.follow(Boxes.concatenate(part)) for part in (moments[:70], moments[70:])]
    )
    assert np.unique(expected.track_id).size >= 3
    np.testing.assert_array_equal(got.track_id, expected.track_id)
    np.testing.assert_array_equal(got.xyxy_px, expected.xyxy_px)
    assert several.state() == one.state()


def test_moments_in_no_order_are_refused() -> None:
    tracker = ImageTracker()
    two = Boxes.of([box_of(0.0, 50.0)] * 2, time_utc_s=[2.0, 1.0])
    with pytest.raises(InputError, match="in no order"):
        tracker.follow(two)
    tracker.follow(two[[1, 0]])
    with pytest.raises(InputError, match="1 s before"):
        tracker.follow(two[[1]])


@pytest.mark.parametrize(
    "spoil",
    [
        lambda s: s.pop("track_id"),
        lambda s: s.update(version=99),
        lambda s: s.update(next_id=1),
        lambda s: s.update(first_utc_s=[1.0, 2.0, 3.0]),
        lambda s: s["targets"].pop("place"),
        lambda s: s["targets"].update(centre=[[1.0, 2.0, 3.0]]),
        lambda s: s["targets"].update(centre=[["a", "b"]]),
        lambda s: s["targets"].update(centre=[[float("nan"), 1.0]]),
        lambda s: s.update(time_utc_s="noon"),
    ],
)
def test_a_damaged_state_is_refused_and_changes_nothing(spoil: Callable[[dict], object]) -> None:
    tracker = WorldTracker(locate)
    run(tracker, np.arange(0.0, 2.0, 0.1), [lambda t: (4.0 * t, 100.0)])
    state = json.loads(json.dumps(tracker.state()))
    spoil(state)
    before = tracker.state()
    with pytest.raises(InputError, match="state of a tracker"):
        tracker.restore(state)
    assert tracker.state() == before


def test_a_state_without_targets_is_taken_up() -> None:
    tracker = ImageTracker()
    run(tracker, np.arange(0.0, 2.0, 0.1), [lambda t: (4.0 * t, 100.0)])
    tracker.restore(ImageTracker().state())
    assert len(tracker) == 0
    # Ids begin anew, and so does time.
    out = run(tracker, np.arange(0.0, 2.0, 0.1), [lambda t: (4.0 * t, 100.0)])
    assert ids_of(out, 0) == {1}
    with pytest.raises(InputError, match="do not fit together"):
        tracker.restore({**ImageTracker().state(), "next_id": 0})


def test_a_state_of_another_plane_is_refused() -> None:
    tracker = ImageTracker()
    run(tracker, np.arange(0.0, 2.0, 0.1), [lambda t: (4.0 * t, 100.0)])
    with pytest.raises(InputError, match="another plane"):
        WorldTracker(locate).restore(tracker.state())
    with pytest.raises(InputError, match="begin without one"):
        WorldTracker(locate).restore([])  # type: ignore[arg-type]


def test_settings_that_mean_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="earth_gate is -1"):
        WorldTrackerSettings(earth_gate=-1.0)


def test_the_assignment_is_that_of_the_whole_table() -> None:
    from scipy.optimize import linear_sum_assignment

    from sightline.tracking.assignment import assign

    rng = np.random.default_rng(0)
    short = 0
    for _ in range(200):
        n, m = rng.integers(1, 16, 2)
        possible = rng.random((n, m)) < rng.uniform(0.05, 0.35)
        cost = rng.random((n, m))
        i, j = np.nonzero(possible)
        rows, columns = assign(i, j, cost[i, j], (n, m))
        assert np.unique(rows).size == rows.size
        assert np.unique(columns).size == columns.size
        assert possible[rows, columns].all()
        table = np.where(possible, cost, 1e6)
        best = linear_sum_assignment(table)
        taken = possible[best]
        assert rows.size == int(taken.sum())
        assert cost[rows, columns].sum() == pytest.approx(table[best][taken].sum(), abs=1e-9)
        linked = possible.any(axis=1).sum(), possible.any(axis=0).sum()
        short += rows.size < min(linked)
    # Of some that could have a box, none was left.
    assert short > 10


def of_platform(boxes: Boxes, platform: Platform, plane: LocalPlane) -> Positions:
    """Where boxes lie on the earth that a camera on a platform sees as `locate` says."""
    seen = locate(boxes)
    body = BodyPositions(
        seen.east_m,
        seen.north_m,
        seen.covariance_m2,
        seen.extrapolated,
        plane,
        seen.shared_covariance_m2,
    )
    return on_earth(body, platform.pose(boxes.time_utc_s, plane, until_then=True))


@pytest.mark.parametrize("on_board", [True, False])
def test_from_a_vessel_that_turns_an_identity_is_kept_on_the_earth(on_board: bool) -> None:
    """A boat at anchor is hidden while the vessel swings round by 25 degrees: it has moved in the
    picture by its own length several times, and not on the earth."""
    seconds = np.arange(0.0, 30.0, 0.1)
    way = np.stack([1.5 * seconds, 0.5 * seconds], axis=1)
    heading = np.interp(seconds, [0.0, 12.0, 16.0, 40.0], [0.0, 0.0, 25.0, 25.0])
    plane = LocalPlane(54.0, 10.0)
    platform = Platform(
        Fixes(seconds, *plane.to_geographic(way[:, 0], way[:, 1])), Headings(seconds, heading)
    )

    def seen_from(east: float, north: float) -> Callable[[float], tuple[float, float]]:
        def at(time_s: float) -> tuple[float, float]:
            angle = np.radians(np.interp(time_s, seconds, heading))
            apart = np.array([east, north]) - [1.5 * time_s, 0.5 * time_s]
            ahead = apart @ [np.sin(angle), np.cos(angle)]
            return float(apart @ [np.cos(angle), -np.sin(angle)]), float(ahead)

        return at

    boats = [seen_from(20.0, 120.0), seen_from(-25.0, 140.0)]

    def on_the_earth(boxes: Boxes) -> Positions:
        return of_platform(boxes, platform, plane)

    tracker = WorldTracker(on_the_earth, platform=platform) if on_board else WorldTracker(locate)
    out = run(tracker, seconds, boats, lambda boat, t: boat == 1 or not 11.0 < t < 17.0)
    kept = len(ids_of(out, 0)) == 1 and ids_of(out, 0).isdisjoint(ids_of(out, 1))
    assert kept == on_board
    if on_board:
        places = tracker.estimates()
        found = sorted(places.mean[:, :2].round(3).tolist())
        np.testing.assert_allclose(found, [[-25.0, 140.0], [20.0, 120.0]], atol=4.0)
        assert np.abs(places.mean[:, 2:]).max() < 0.8


def test_boxes_of_which_nobody_knows_where_the_vessel_was_are_followed_in_the_picture() -> None:
    seconds = np.arange(0.0, 5.0)
    platform = Platform(
        Fixes(seconds, np.full(5, 54.0), np.full(5, 10.0)), Headings(seconds, np.zeros(5))
    )
    plane = LocalPlane(54.0, 10.0)
    tracker = WorldTracker(lambda boxes: of_platform(boxes, platform, plane), platform=platform)
    out = run(tracker, np.arange(0.0, 15.0, 0.1), [lambda t: (2.0 * t, 100.0)])
    assert len(ids_of(out, 0)) == 1
    assert out[-1][0] > 14.0


@pytest.mark.parametrize("kind", ["image", "world"])
@pytest.mark.parametrize(("silent_s", "goes_on"), [(0.8, True), (1.3, False)])
def test_a_doubtful_box_goes_on_only_with_what_was_just_seen(
    kind: str, silent_s: float, goes_on: bool
) -> None:
    tracker = ImageTracker() if kind == "image" else WorldTracker(locate)
    box = box_of(10.0, 100.0)
    for i in range(20):
        found = tracker.update(Boxes.of([box], time_utc_s=0.1 * i, confidence=0.9))
    assert found.track_id.tolist() == [1]
    doubtful = Boxes.of([box], time_utc_s=1.9 + silent_s, confidence=0.2)
    assert tracker.update(doubtful).track_id.tolist() == [1] * goes_on


@pytest.mark.parametrize(("begins_s", "same"), [(3.75, False), (4.45, True)])
def test_nothing_goes_on_as_what_was_there_beside_it(begins_s: float, same: bool) -> None:
    """A second boat that comes while the first is still seen is another, wherever it is."""
    tracker = WorldTracker(locate, WorldTrackerSettings(confirm_s=3.0, direct_s=0.3))
    out = run(
        tracker,
        np.arange(0.0, 10.0, 0.1),
        [lambda t: (-20.0 + 2.0 * t, 100.0), lambda t: (-28.0 + 2.0 * t, 100.0)],
        lambda boat, t: t < 4.0 if boat == 0 else t > begins_s,
    )
    assert ids_of(out, 0) == {1}
    assert (ids_of(out, 1) == {1}) == same


@pytest.mark.parametrize(("times", "same"), [(1.0, True), (1.9, False)])
def test_a_boat_that_comes_back_with_another_size_is_another(times: float, same: bool) -> None:
    tracker = WorldTracker(locate)
    found: set[int] = set()
    for i in range(140):
        time_s = 0.1 * i
        large = times if time_s >= 9.0 else 1.0
        boat = box_of(-30.0 + 3.0 * time_s, 110.0, 8.0 * large, 3.0 * large)
        # Another one, so that time goes on while the boat is hidden.
        boxes = Boxes.of([box_of(0.0, 40.0), boat], time_utc_s=time_s, label=["other", "boat"])
        out = tracker.update(boxes[:1] if 5.0 < time_s < 9.0 else boxes)
        found |= set(out.track_id[out.label == "boat"].tolist())
    assert len(found) == (1 if same else 2)


def placed_by_frame(variance_m2: float, shared_m2: float = 0.0) -> Callable[[Boxes], Positions]:
    """A camera that sees one place in the image, however far to the east its frame says it is."""

    def locate(seen: Boxes) -> Positions:
        n = len(seen)
        return Positions(
            east_m=seen.frame / 1000.0,
            north_m=np.full(n, 100.0),
            covariance_m2=np.tile((variance_m2 + shared_m2) * np.eye(2), (n, 1, 1)),
            extrapolated=np.zeros(n, dtype=bool),
            plane=LocalPlane(54.0, 10.0),
            shared_covariance_m2=np.tile(shared_m2 * np.eye(2), (n, 1, 1)),
        )

    return locate


def test_what_a_target_has_in_common_with_itself_is_not_in_its_estimate() -> None:
    settings = WorldTrackerSettings(confirm_s=0.0)
    tracker = WorldTracker(placed_by_frame(2.0, 400.0), settings)
    tracker.update(Boxes.of([box_of(0.0, 100.0)], time_utc_s=0.0, frame=0))
    # A twentieth of it stays, as a reserve.
    expected = np.diag([22.0, 22.0, settings.speed_mps**2, settings.speed_mps**2])
    np.testing.assert_allclose(tracker.estimates().covariance[0], expected)


def test_one_that_had_no_place_yet_begins_with_its_first() -> None:
    settings = WorldTrackerSettings()
    somewhere = placed_by_frame(2.0)

    def locate(seen: Boxes) -> Positions:
        known = seen.frame >= 0
        found = somewhere(seen)
        return replace(found, east_m=np.where(known, found.east_m, np.nan))

    tracker = WorldTracker(locate, settings)
    for i in range(20):
        tracker.update(Boxes.of([box_of(0.0, 100.0)], time_utc_s=0.1 * i, frame=-1))
    assert tracker.estimates().track_id.size == 0
    tracker.update(Boxes.of([box_of(0.0, 100.0)], time_utc_s=2.0, frame=3000))
    known = tracker.estimates()
    np.testing.assert_allclose(known.mean, [[3.0, 100.0, 0.0, 0.0]])
    expected = np.diag([2.0, 2.0, settings.speed_mps**2, settings.speed_mps**2])
    np.testing.assert_allclose(known.covariance[0], expected)


@pytest.mark.parametrize(
    ("silent_s", "sigmas", "goes_on"),
    [(0.2, 6.0, True), (0.2, 9.0, False), (1.0, 3.5, True), (1.0, 6.0, False)],
)
def test_what_is_off_on_the_earth_is_allowed_while_the_image_tells_more(
    silent_s: float, sigmas: float, goes_on: bool
) -> None:
    settings = WorldTrackerSettings(earth_gate=4.0, loose_gate=8.0, image_s=0.6)
    tracker = WorldTracker(placed_by_frame(1.0), settings)
    box = box_of(0.0, 100.0)
    for i in range(31):
        tracker.update(Boxes.of([box], time_utc_s=0.2 * i, frame=0))
    step = np.array([1.0, silent_s])
    along = tracker.estimates().covariance[0][np.ix_([0, 2], [0, 2])]
    wandered = settings.acceleration_m2ps3 * silent_s**3 / 3.0
    sigma_m = np.sqrt(step @ along @ step + wandered + 1.0)
    off = Boxes.of([box], time_utc_s=6.0 + silent_s, frame=round(1000.0 * sigmas * sigma_m))
    assert tracker.update(off).track_id.tolist() == [1] * goes_on


def test_boxes_whose_errors_last_do_not_make_an_estimate_too_sure() -> None:
    """Twenty boxes a second, whose errors are alike for a second: by simulated targets."""
    kept = np.exp(-0.05)
    inside = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        tracker = WorldTracker(locate)
        start, speed = np.array([rng.uniform(-20.0, 20.0), 90.0]), rng.uniform(-2.0, 2.0, 2)
        error = rng.normal(0.0, 1.0, 2)
        for time_s in np.arange(0.0, 5.0, 0.05).tolist():
            error = kept * error + np.sqrt(1.0 - kept**2) * rng.normal(0.0, 1.0, 2)
            box = np.array(box_of(*(start + time_s * speed)))
            tracker.update(
                Boxes.of([box + np.array([error[0], 0.0, error[0], error[1]])], time_utc_s=time_s)
            )
        known = tracker.estimates()
        off = known.mean[0] - np.concatenate([start + time_s * speed, speed])
        inside.append(float(off @ np.linalg.solve(known.covariance[0], off)) < 9.488)
    assert np.mean(inside) >= 0.85
