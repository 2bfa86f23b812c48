"""Tracks of several cameras fused to one a target, against closed forms and known paths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from sightline.errors import InputError
from sightline.fusion import (
    BiasPrior,
    CameraTracks,
    FuseSettings,
    HandoverSettings,
    cameras_of,
    fuse,
    intersect,
)
from sightline.fusion.bias import Differences, estimate
from sightline.fusion.handover import End, Seen, bridge, handover_nats, successors
from sightline.fusion.resampling import Piece, resampled
from sightline.fusion.track_association import (
    AssociationSettings,
    Pair,
    evidence,
    joined,
    without_changes,
)
from sightline.geodesy import LocalPlane
from sightline.types import PointKind, Track

PLANE = LocalPlane(54.3233, 10.1394)
START = 1_717_236_000.0


def straight(
    number: int,
    place: tuple[float, float],
    velocity: tuple[float, float],
    span: tuple[int, int],
    *,
    sigma: tuple[float, float] = (4.0, 4.0),
    off: tuple[float, float] = (0.0, 0.0),
    mmsi: int | None = None,
    name: str = "",
) -> Track:
    """A track of a vessel that goes straight on, which was at ``place`` at the start."""
    times = np.arange(span[0], span[1] + 1, dtype=float)
    n = times.size
    return Track(
        track_id=number,
        time_utc_s=START + times,
        east_m=place[0] + velocity[0] * times + off[0],
        north_m=place[1] + velocity[1] * times + off[1],
        velocity_east_mps=np.full(n, velocity[0]),
        velocity_north_mps=np.full(n, velocity[1]),
        covariance_m2=np.tile(np.diag(np.square(sigma)), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(0.1 * np.eye(2), (n, 1, 1)),
        kind=np.zeros(n, dtype=np.int8),
        plane=PLANE,
        mmsi=mmsi,
        name=name,
    )


def test_intersection_of_two_is_that_of_julier_and_uhlmann() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        first, second = (a @ a.T + 0.1 * np.eye(2) for a in rng.normal(size=(2, 2, 2)))
        one, other = rng.normal(size=(2, 2))

        def mixed(w: float, p: np.ndarray = first, q: np.ndarray = second) -> np.ndarray:
            return np.linalg.inv(w * np.linalg.inv(p) + (1.0 - w) * np.linalg.inv(q))

        best = minimize_scalar(
            lambda w: np.linalg.det(mixed(w)), bounds=(0.0, 1.0), method="bounded"
        )
        w, expected = best.x, mixed(best.x)
        place = expected @ (
            w * np.linalg.solve(first, one) + (1.0 - w) * np.linalg.solve(second, other)
        )
        value, covariance = intersect(np.array([[one, other]]), np.array([[first, second]]))
        assert np.linalg.det(covariance[0]) == pytest.approx(np.linalg.det(expected), rel=2e-3)
        assert value[0] == pytest.approx(place, abs=0.1)


def test_without_correlation_it_is_the_product_of_the_two_normal_distributions() -> None:
    first, second = np.diag([1.0, 25.0]), np.diag([16.0, 1.0])
    value, covariance = intersect(
        np.array([[[0.0, 0.0], [1.0, 2.0]]]), np.array([[first, second]]), 0.0
    )
    expected = np.linalg.inv(np.linalg.inv(first) + np.linalg.inv(second))
    assert covariance[0] == pytest.approx(expected)
    assert value[0] == pytest.approx(expected @ np.linalg.solve(second, [1.0, 2.0]))


def test_one_of_several_is_left_as_it_is_and_none_is_nothing() -> None:
    values = np.full((2, 3, 2), np.nan)
    covariances = np.full((2, 3, 2, 2), np.nan)
    values[0, 1], covariances[0, 1] = [3.0, 4.0], np.diag([2.0, 5.0])
    value, covariance = intersect(values, covariances, 0.3)
    assert value[0] == pytest.approx([3.0, 4.0])
    assert covariance[0] == pytest.approx(np.diag([2.0, 5.0]))
    assert np.isnan(value[1]).all()
    assert np.isnan(covariance[1]).all()


@pytest.mark.parametrize("share", [0.2, 0.6, 1.0])
@pytest.mark.parametrize("correlation", [-1.0, 0.0, 0.5, 1.0])
def test_the_stated_covariance_holds_whatever_the_correlation(
    share: float, correlation: float
) -> None:
    first, second = np.diag([1.0, 9.0]), np.array([[5.0, 1.0], [1.0, 2.0]])
    third = np.diag([4.0, 4.0])
    roots = [np.linalg.cholesky(p) for p in (first, second, third)]
    values, covariance = intersect(np.zeros((1, 3, 2)), np.array([[first, second, third]]), share)
    # The gain of each estimate, from what the fusion makes of a unit in it alone.
    gains = []
    for k in range(3):
        columns = []
        for axis in range(2):
            unit = np.zeros((1, 3, 2))
            unit[0, k, axis] = 1.0
            columns.append(intersect(unit, np.array([[first, second, third]]), share)[0][0])
        gains.append(np.stack(columns, axis=1))
    assert values[0] == pytest.approx([0.0, 0.0])
    assert sum(gains) == pytest.approx(np.eye(2))
    # Two cameras that have the share in common, with a correlation, and a third that has none.
    joint = np.zeros((6, 6))
    for i in range(3):
        for j in range(3):
            part = 1.0 if i == j else share * correlation if {i, j} == {0, 1} else 0.0
            joint[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = part * roots[i] @ roots[j].T
    gain = np.concatenate(gains, axis=1)
    actual = gain @ joint @ gain.T
    assert np.linalg.eigvalsh(covariance[0] - actual).min() > -1e-9


def test_a_share_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="not between 0 and 1"):
        intersect(np.zeros((1, 1, 2)), np.ones((1, 1, 2, 2)), 1.5)
    with pytest.raises(InputError, match="not between 0 and 1"):
        FuseSettings(correlated_share=-0.1)


def test_biases_are_found_from_differences() -> None:
    rng = np.random.default_rng(3)
    camera_m = np.array([[0.0, 0.0], [300.0, 0.0], [150.0, 400.0]])
    true = np.array([[2.0, -1.0, 0.010], [-3.0, 0.5, -0.006], [1.0, 0.5, -0.004]])
    rows = 400
    place = rng.uniform(-50.0, 350.0, (rows, 2))
    first, second = np.array([(0, 1), (0, 2), (1, 2)])[rng.integers(3, size=rows)].T

    def bias(camera: np.ndarray) -> np.ndarray:
        away = place - camera_m[camera]
        turn = true[camera, 2]
        return true[camera, :2] + np.stack([turn * away[:, 1], -turn * away[:, 0]], axis=1)

    noise = 1.5
    apart = bias(first) - bias(second) + noise * rng.normal(size=(rows, 2))
    seen = Differences(first, second, place, apart, np.tile(noise**2 * np.eye(2), (rows, 1, 1)))
    found = estimate(seen, camera_m, BiasPrior(3.0, 0.5))
    off = (found.value - true).reshape(-1)
    assert off @ np.linalg.solve(found.covariance, off) < 21.7
    # What two cameras differ by is known far better than what all have in common.
    assert np.abs(found.apart(seen) - (bias(first) - bias(second))).max() < 0.8
    sigma = np.sqrt(np.diag(found.covariance)).reshape(-1, 3)
    assert (sigma[:, :2] > 1.0).all()
    assert (found.compared > 200).all()


def test_a_camera_whose_place_nobody_knows_has_an_offset_alone() -> None:
    tracks = [straight(1, (0.0, 100.0), (2.0, 0.0), (0, 120))]
    other = [straight(1, (0.0, 100.0), (2.0, 0.0), (0, 120), off=(4.0, -2.0))]
    fused = fuse([CameraTracks("a", tuple(tracks)), CameraTracks("b", tuple(other))], PLANE)
    a, b = fused.cameras
    assert a.bias_heading_deg is None
    # Equal priors share the difference.
    assert b.bias_east_m == pytest.approx(-a.bias_east_m)
    assert b.bias_east_m - a.bias_east_m == pytest.approx(4.0, abs=1.5)
    assert len(fused.tracks) == 1


def test_two_cameras_and_three_vessels_are_three_targets() -> None:
    vessels = [((0.0, 0.0), (3.0, 0.0)), ((0.0, 30.0), (3.0, 0.0)), ((200.0, 60.0), (-2.0, 0.5))]
    a = [straight(i, *one, (0, 100), sigma=(2.0, 8.0)) for i, one in enumerate(vessels)]
    b = [straight(9 - i, *one, (20, 140), sigma=(8.0, 2.0)) for i, one in enumerate(vessels)]
    fused = fuse([CameraTracks("a", tuple(a)), CameraTracks("b", tuple(b))], PLANE)
    assert [cameras_of(track) for track in fused.tracks] == [{"a", "b"}] * 3
    assert [track.track_id for track in fused.tracks] == [1, 2, 3]
    for track in fused.tracks:
        at = track.time_utc_s - START
        assert (at[0], at[-1]) == (0.0, 140.0)
        assert (track.cameras[at < 20.0] == "a").all()
        assert (track.cameras[at > 100.0] == "b").all()
        both = (at >= 20.0) & (at <= 100.0)
        assert (track.cameras[both] == "a b").all()
        # Better along either axis than the camera that is bad at it, and than both at once.
        sigma = np.sqrt(track.covariance_m2[both][:, [0, 1], [0, 1]])
        assert (sigma < 2.3).all()
        assert (sigma > 1.9).all()


def test_different_mmsi_never_fuse_and_one_is_kept() -> None:
    def seen(mmsi: int | None, name: str = "") -> Track:
        return straight(1, (0.0, 0.0), (3.0, 0.0), (0, 60), mmsi=mmsi, name=name)

    apart = fuse(
        [CameraTracks("a", (seen(211000001),)), CameraTracks("b", (seen(211000002),))], PLANE
    )
    assert sorted(track.mmsi for track in apart.tracks) == [211000001, 211000002]
    one = fuse(
        [CameraTracks("a", (seen(None),)), CameraTracks("b", (seen(211000002, "Anna"),))], PLANE
    )
    assert [(track.mmsi, track.name) for track in one.tracks] == [(211000002, "Anna")]


def test_one_mmsi_speaks_for_one_target_where_places_alone_do_not() -> None:
    far = straight(1, (30.0, 0.0), (3.0, 0.0), (0, 60), mmsi=211000001)
    near = straight(1, (0.0, 0.0), (3.0, 0.0), (0, 60), mmsi=211000001)
    nameless = straight(1, (30.0, 0.0), (3.0, 0.0), (0, 60))
    settings = FuseSettings(bias=BiasPrior(0.5, 0.1))
    cameras = [CameraTracks("a", (near,)), CameraTracks("b", (far,))]
    assert len(fuse(cameras, PLANE, settings).tracks) == 1
    cameras = [CameraTracks("a", (near,)), CameraTracks("b", (nameless,))]
    assert len(fuse(cameras, PLANE, settings).tracks) == 2


@pytest.mark.parametrize("gap_s", [10, 40])
def test_handover_across_a_gap_between_two_fields_of_view(gap_s: int) -> None:
    a = straight(1, (0.0, 0.0), (4.0, 1.0), (0, 50))
    b = straight(1, (0.0, 0.0), (4.0, 1.0), (50 + gap_s, 130))
    other = straight(2, (0.0, 300.0), (4.0, 1.0), (50 + gap_s, 130))
    fused = fuse([CameraTracks("a", (a,)), CameraTracks("b", (b, other))], PLANE)
    assert fused.handovers == 1
    assert len(fused.tracks) == 2
    track = fused.tracks[0]
    at = track.time_utc_s - START
    assert np.diff(at) == pytest.approx(1.0)
    gap = (at > 50.0) & (at < 50.0 + gap_s)
    assert (track.kind[gap] == PointKind.INTERPOLATED).all()
    assert (track.cameras[gap] == "").all()
    assert track.east_m == pytest.approx(4.0 * at, abs=1e-6)
    variance = track.covariance_m2[:, 0, 0]
    assert (variance[gap] > variance[~gap].max()).all()


def test_what_is_gone_for_too_long_or_goes_elsewhere_is_another_target() -> None:
    a = straight(1, (0.0, 0.0), (4.0, 1.0), (0, 50))
    late = straight(1, (0.0, 0.0), (4.0, 1.0), (90, 130))
    astray = straight(1, (0.0, 200.0), (4.0, 1.0), (60, 130))
    settings = FuseSettings(handover=HandoverSettings(longest_s=30.0))
    for other in (late, astray):
        fused = fuse([CameraTracks("a", (a,)), CameraTracks("b", (other,))], PLANE, settings)
        assert len(fused.tracks) == 2
        assert fused.handovers == 0


def test_a_tracker_that_goes_over_to_another_vessel_is_told_by_two_other_cameras() -> None:
    first, second = ((0.0, 0.0), (3.0, 0.0)), ((0.0, 40.0), (3.0, -0.8))
    # They cross at 50 s, and from then on camera a takes either for the other.
    paths = [straight(i, *one, (0, 100)) for i, one in enumerate((first, second))]

    def swapped(before: Track, after: Track) -> Track:
        early, late = before[:50], after[50:]
        columns = {
            name: np.concatenate([getattr(early, name), getattr(late, name)])
            for name in Track._row_fields
        }
        return Track(track_id=before.track_id, plane=PLANE, **columns)

    a = (swapped(paths[0], paths[1]), swapped(paths[1], paths[0]))
    right = [CameraTracks(name, tuple(paths)) for name in ("b", "c")]
    fused = fuse([CameraTracks("a", a), *right], PLANE)
    whole = [track for track in fused.tracks if len(track) > 90]
    assert len(whole) == 2
    for track in whole:
        slope = np.polyfit(track.time_utc_s - START, track.north_m, 1)
        line = np.polyval(slope, track.time_utc_s - START)
        assert np.abs(track.north_m - line).max() < 6.0


def test_bridge_is_the_smoother_of_nearly_constant_velocity() -> None:
    """Against the posterior of a joint normal distribution, built from the model's increments."""
    settings = HandoverSettings(acceleration_m2ps3=0.2)
    p, v = np.diag([2.0, 3.0]), np.diag([0.2, 0.1])
    before = End(0.0, np.array([0.0, 0.0]), np.array([2.0, 0.0]), p, v)
    after = End(10.0, np.array([25.0, 3.0]), np.array([2.5, 1.0]), p, v)
    states, covariances = bridge(before, after, np.array([4.0]), settings, 0.0)

    def step(lag: float) -> tuple[np.ndarray, np.ndarray]:
        f = np.eye(4)
        f[0, 2] = f[1, 3] = lag
        q = np.zeros((4, 4))
        for axis in (0, 1):
            q[axis, axis] = lag**3 / 3.0
            q[axis, axis + 2] = q[axis + 2, axis] = lag**2 / 2.0
            q[axis + 2, axis + 2] = lag
        return f, 0.2 * q

    start = np.zeros((4, 4))
    start[:2, :2], start[2:, 2:] = p, v
    (f1, q1), (f2, q2) = step(4.0), step(6.0)
    m1, p1 = f1 @ [0.0, 0.0, 2.0, 0.0], f1 @ start @ f1.T + q1
    m2, p2 = f2 @ m1, f2 @ p1 @ f2.T + q2 + start
    gain = p1 @ f2.T @ np.linalg.inv(p2)
    assert states[0] == pytest.approx(m1 + gain @ (np.array([25.0, 3.0, 2.5, 1.0]) - m2))
    assert covariances[0] == pytest.approx(p1 - gain @ f2 @ p1)


def test_successors_are_one_to_one_with_the_largest_sum() -> None:
    nats = {(0, 2): 10.0, (0, 3): 9.0, (1, 2): 8.0, (1, 3): -np.inf}
    assert successors(nats, 2.0) == {0: 3, 1: 2}
    assert successors(nats, 9.5) == {0: 2}
    assert successors(nats, 11.0) == {}


def test_tracks_that_cannot_be_fused_are_refused() -> None:
    with pytest.raises(InputError, match="nothing to fuse"):
        fuse([CameraTracks("a", ()), CameraTracks("b", ())], PLANE)
    track = straight(3, (0.0, 0.0), (1.0, 0.0), (0, 10))
    unsure = Track(
        **{name: getattr(track, name) for name in ("track_id", "plane", *Track._row_fields)}
        | {"covariance_m2": np.full((11, 2, 2), np.nan)}
    )
    with pytest.raises(InputError, match="camera b: its track 3 does not say how unsure"):
        fuse([CameraTracks("a", (track,)), CameraTracks("b", (unsure,))], PLANE)
    with pytest.raises(InputError, match="an interval of 0 s"):
        FuseSettings(interval_s=0.0)
    far = straight(1, (300_000.0, 0.0), (1.0, 0.0), (0, 10))
    with pytest.raises(InputError, match="km apart"):
        fuse([CameraTracks("a", (track,)), CameraTracks("b", (far,))], PLANE)


def test_ellipses_hold_what_they_say_for_independent_errors() -> None:
    rng = np.random.default_rng(5)
    inside, count = 0, 0
    for _ in range(60):
        off = rng.normal(size=(2, 2)) * [[2.0, 8.0], [8.0, 2.0]]
        a = straight(1, (0.0, 0.0), (3.0, 1.0), (0, 30), sigma=(2.0, 8.0), off=tuple(off[0]))
        b = straight(1, (0.0, 0.0), (3.0, 1.0), (0, 30), sigma=(8.0, 2.0), off=tuple(off[1]))
        settings = FuseSettings(bias=BiasPrior(0.01, 0.01))
        fused = fuse([CameraTracks("a", (a,)), CameraTracks("b", (b,))], PLANE, settings)
        for track in fused.tracks:
            if cameras_of(track) == {"a", "b"}:
                at = track.time_utc_s[0] - START
                error = [track.east_m[0] - 3.0 * at, track.north_m[0] - at]
                inside += error @ np.linalg.solve(track.covariance_m2[0], error) < 5.991
                count += 1
    assert count >= 50
    assert 0.88 <= inside / count <= 1.0


def test_the_bias_is_taken_off_the_tracks() -> None:
    """Three cameras of which one is off: what it alone sees is where the others would have it."""
    rng = np.random.default_rng(1)
    paths = [
        (tuple(rng.uniform(-200.0, 200.0, 2)), tuple(rng.uniform(-3.0, 3.0, 2))) for _ in range(8)
    ]
    right = tuple(straight(i, *path, (0, 100)) for i, path in enumerate(paths))
    off = tuple(straight(i, *path, (0, 100), off=(6.0, -4.0)) for i, path in enumerate(paths))
    alone = straight(99, (900.0, 900.0), (1.0, 1.0), (0, 100), off=(6.0, -4.0))
    cameras = [
        CameraTracks("a", right),
        CameraTracks("b", right),
        CameraTracks("c", right),
        CameraTracks("d", (*off, alone)),
    ]
    fused = fuse(cameras, PLANE, FuseSettings(bias=BiasPrior(5.0, 0.1)))
    (single,) = (track for track in fused.tracks if cameras_of(track) == {"d"})
    at = single.time_utc_s - START
    # A fourth of it is what the priors ascribe to the other three.
    assert single.east_m - (900.0 + at) == pytest.approx(0.25 * 6.0, abs=0.3)
    assert single.north_m - (900.0 + at) == pytest.approx(-0.25 * 4.0, abs=0.3)


def test_moments_near_to_each_other_are_one_piece_of_evidence() -> None:
    settings = AssociationSettings(interval_s=1.0, correlation_time_s=10.0)
    often = AssociationSettings(interval_s=0.1, correlation_time_s=10.0)
    pair = Pair(0, 1, 0, np.full(20, 3.0), np.zeros(20))
    same = Pair(0, 1, 0, np.full(200, 3.0), np.zeros(200))
    assert evidence(pair, settings) == pytest.approx(3.0 * (1.0 + 2.0))
    assert evidence(same, often) == pytest.approx(evidence(pair, settings))


def test_pieces_change_over_where_they_fit_better() -> None:
    """The best evidence first joins two of different vessels, and all of it parts them again."""

    def piece(camera: int, number: int) -> Piece:
        found = resampled(straight(1, (0.0, 0.0), (1.0, 0.0), (0, 30)), camera, number, START, 1.0)
        assert found is not None
        return found

    def pair(one: int, other: int, nats: float) -> Pair:
        return Pair(one, other, 0, np.full(30, nats / 4.0), np.zeros(30))

    pieces = [piece(0, 0), piece(1, 1), piece(2, 2), piece(1, 3)]
    # 0-1 is the best pair; 2 is of one with 0, and cannot be with 1, but fits 3, as 0 does.
    pairs = [pair(0, 1, 10.0), pair(0, 3, 9.0), pair(0, 2, 8.0), pair(1, 2, -6.0), pair(2, 3, 9.0)]
    groups = joined(pieces, pairs, AssociationSettings())
    assert [0, 2, 3] in groups
    assert [1] in groups


def test_a_stretch_between_two_targets_is_of_none() -> None:
    whole = resampled(straight(1, (0.0, 0.0), (1.0, 0.0), (0, 60)), 0, 0, START, 1.0)
    assert whole is not None
    parts = [whole.part(0, 24), whole.part(25, 34), whole.part(35, 60)]
    assert without_changes(parts, [[0], [1], [2]], 1.0) == [[0], [2]]
    # It is kept where others see it, where its track goes on in one target, or for long.
    assert without_changes(parts, [[0, 2], [1]], 1.0) == [[0, 2], [1]]
    long = [whole.part(0, 9), whole.part(10, 49), whole.part(50, 60)]
    assert without_changes(long, [[0], [1], [2]], 1.0) == [[0], [1], [2]]


def test_handover_is_refused_beyond_the_gate_and_between_two_vessels() -> None:
    wide, unsure = 4.0 * np.eye(2), 0.1 * np.eye(2)

    def seen(time: float, east: float, mmsi: int | None = None) -> Seen:
        end = End(time, np.array([east, 0.0]), np.array([2.0, 0.0]), wide, unsure)
        return Seen(end, end, 0, 1, mmsi)

    settings, none = HandoverSettings(), np.zeros((2, 2))

    def nats(before: Seen, after: Seen) -> float:
        # Where hardly anybody is, anything near at all would be the same vessel but for the gate.
        return handover_nats(before, after, none, 1e-12, settings)

    assert nats(seen(0.0, 0.0), seen(5.0, 10.0)) > 10.0
    assert nats(seen(0.0, 0.0), seen(5.0, 40.0)) == -np.inf
    assert nats(seen(0.0, 0.0), seen(61.0, 122.0)) == -np.inf
    assert nats(seen(0.0, 0.0, 1), seen(5.0, 10.0, 2)) == -np.inf
    assert nats(seen(0.0, 0.0, 1), seen(5.0, 40.0, 1)) > 900.0


def test_resampling_goes_along_curves_and_knows_what_was_not_seen() -> None:
    angle = 0.1 * np.array([0.0, 4.0, 8.0, 20.0])
    track = Track(
        track_id=1,
        time_utc_s=START + np.array([0.0, 4.0, 8.0, 20.0]),
        east_m=50.0 * np.sin(angle),
        north_m=50.0 * np.cos(angle),
        velocity_east_mps=5.0 * np.cos(angle),
        velocity_north_mps=-5.0 * np.sin(angle),
        covariance_m2=np.tile(np.eye(2), (4, 1, 1)),
        velocity_covariance_m2ps2=np.tile(np.eye(2), (4, 1, 1)),
        kind=np.zeros(4, dtype=np.int8),
        plane=PLANE,
    )
    piece = resampled(track, 0, 0, START, 1.0)
    assert piece is not None
    at = np.arange(9)
    assert np.hypot(*piece.place_m[at].T) == pytest.approx(np.full(9, 50.0), abs=0.02)
    assert piece.known.tolist() == [True] * 9 + [False] * 11 + [True]
