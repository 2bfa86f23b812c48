from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.platform import (
    HEADING_SIGMA_DEG,
    POSITION_SIGMA_M,
    Platform,
    Pose,
    moved_positions,
    moved_track,
    north_up,
    on_earth,
    to_bow,
)
from sightline.synchronisation import synchronise
from sightline.trajectory import method
from sightline.types import BodyPositions, Fixes, Headings

PLANE = LocalPlane(54.0, 10.0)


def pose(heading_deg: float, en_m: tuple[float, float] = (0.0, 0.0), n: int = 1) -> Pose:
    return Pose(
        en_m=np.tile(en_m, (n, 1)).astype(float),
        velocity_mps=np.zeros((n, 2)),
        heading_rad=np.full(n, np.radians(heading_deg)),
        heading_sigma_rad=np.full(n, np.radians(HEADING_SIGMA_DEG)),
    )


def positions(
    starboard_ahead_m: np.ndarray, covariance_m2: np.ndarray | None = None
) -> BodyPositions:
    n = len(starboard_ahead_m)
    covariance = np.zeros((n, 2, 2)) if covariance_m2 is None else covariance_m2
    return BodyPositions(
        starboard_m=starboard_ahead_m[:, 0],
        ahead_m=starboard_ahead_m[:, 1],
        covariance_m2=covariance,
        extrapolated=np.zeros(n, dtype=bool),
        plane=PLANE,
    )


def log(times: np.ndarray, en_m: np.ndarray) -> Fixes:
    return Fixes(times, *PLANE.to_geographic(en_m[:, 0], en_m[:, 1]))


@pytest.mark.parametrize(
    ("heading_deg", "east_north", "starboard_ahead"),
    [
        (0.0, (3.0, 4.0), (3.0, 4.0)),
        # Under way to the east: what lies east is ahead, what lies north is to port.
        (90.0, (10.0, 0.0), (0.0, 10.0)),
        (90.0, (0.0, 10.0), (-10.0, 0.0)),
        (180.0, (3.0, 4.0), (-3.0, -4.0)),
    ],
)
def test_what_the_bow_sees(heading_deg, east_north, starboard_ahead) -> None:
    seen = to_bow(np.array([east_north]) + np.array([5.0, 6.0]), pose(heading_deg, (5.0, 6.0)))
    np.testing.assert_allclose(seen, [starboard_ahead], atol=1e-12)


@given(
    heading_deg=st.floats(0.0, 360.0),
    east=st.floats(-500.0, 500.0),
    north=st.floats(-500.0, 500.0),
)
def test_there_and_back(heading_deg: float, east: float, north: float) -> None:
    where = pose(heading_deg, (40.0, -70.0))
    seen = to_bow(np.array([[east, north]]), where)
    back = moved_positions(north_up(positions(seen), where), where)
    np.testing.assert_allclose([back.east_m[0], back.north_m[0]], [east, north], atol=1e-9)


def test_only_places_on_the_earth_have_a_latitude() -> None:
    where = pose(90.0, (40.0, -70.0))
    body = positions(np.array([[3.0, 200.0]]))
    about = north_up(body, where)
    for relative in (body, about):
        assert not hasattr(relative, "latitude_deg")
        assert not hasattr(relative, "longitude_deg")
    # Under way to the east: 200 m ahead lie east, 3 m to starboard lie south.
    earth = on_earth(body, where)
    expected = PLANE.to_geographic([40.0 + 200.0], [-70.0 - 3.0])
    np.testing.assert_allclose(earth.latitude_deg, expected[0], atol=1e-12)
    np.testing.assert_allclose(earth.longitude_deg, expected[1], atol=1e-12)
    with pytest.raises(InputError, match="2 poses for 1 boxes"):
        on_earth(body, pose(90.0, (40.0, -70.0), n=2))


def test_an_unsure_heading_swings_a_place_across_the_line_of_sight() -> None:
    made = north_up(positions(np.array([[0.0, 200.0]])), pose(0.0))
    across = 200.0 * np.radians(HEADING_SIGMA_DEG)
    np.testing.assert_allclose(
        made.covariance_m2[0],
        np.diag([across**2, 0.0]) + POSITION_SIGMA_M**2 * np.eye(2),
        atol=1e-9,
    )


@pytest.mark.parametrize("heading_deg", [0.0, 35.0, 160.0, 290.0])
def test_an_unsure_heading_swings_a_place_in_any_direction(heading_deg: float) -> None:
    """The covariance is that of the places which headings a little off would make."""
    seen = np.array([[150.0, 80.0], [-60.0, 240.0], [90.0, -120.0]])
    step = 1e-5
    swung = [
        north_up(positions(seen), pose(heading_deg + np.degrees(by), n=3)) for by in (-step, step)
    ]
    by_heading = (
        np.stack([swung[1].east_m - swung[0].east_m, swung[1].north_m - swung[0].north_m], axis=1)
        / (2.0 * step)
        * np.radians(HEADING_SIGMA_DEG)
    )
    expected = by_heading[:, :, None] * by_heading[:, None, :] + POSITION_SIGMA_M**2 * np.eye(2)
    made = north_up(positions(seen), pose(heading_deg, n=3))
    np.testing.assert_allclose(made.covariance_m2, expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(made.shared_covariance_m2, expected, rtol=1e-6, atol=1e-6)


def test_the_ellipse_turns_with_the_bow() -> None:
    # Long ahead; under way to the east that is long to the east.
    made = north_up(positions(np.array([[0.0, 1e-9]]), np.diag([1.0, 100.0])[None]), pose(90.0))
    extra = POSITION_SIGMA_M**2 * np.eye(2)
    np.testing.assert_allclose(made.covariance_m2[0], np.diag([100.0, 1.0]) + extra, atol=1e-6)


def test_a_course_is_told_by_the_way_made_good_and_not_at_rest() -> None:
    times = np.arange(0.0, 60.0)
    gone = np.where(times < 30.0, 4.0 * times, 120.0)
    platform = Platform(log(times, np.stack([gone, np.zeros(60)], axis=1)))
    where = platform.pose([15.0, 50.0, 70.0], PLANE)
    assert np.degrees(where.heading_rad[0]) == pytest.approx(90.0, abs=1e-3)
    # Two fixes, each off by so much, 32 m apart.
    assert where.heading_sigma_rad[0] == pytest.approx(np.sqrt(2) * POSITION_SIGMA_M / 32.0, 1e-3)
    assert np.isnan(where.heading_rad[1:]).all()
    assert where.known.tolist() == [True, False, False]


def test_a_logged_heading_is_followed_through_north_and_not_over_silence() -> None:
    platform = Platform(
        log(np.array([0.0, 8.0]), np.zeros((2, 2))),
        Headings(np.array([0.0, 2.0, 100.0]), np.array([350.0, 10.0, 20.0])),
    )
    where = platform.pose([1.0, 50.0], PLANE)
    assert np.degrees(where.heading_rad[0]) % 360.0 == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(where.heading_rad[1])


def test_a_track_is_put_where_the_platform_was() -> None:
    times = np.arange(0.0, 20.0)
    platform = Platform(log(times, np.stack([2.0 * times, np.zeros(20)], axis=1)))
    # Seen from the platform it falls astern at 2 m/s: it lies still.
    there = np.stack([100.0 - 2.0 * times, np.full(20, 50.0)], axis=1)
    seen = north_up(positions(there, np.tile(np.eye(2), (20, 1, 1))), pose(0.0, n=20))
    made = method("rts").apply(times, seen, track_id=1)
    track = moved_track(made, platform.pose(made.time_utc_s, PLANE))
    np.testing.assert_allclose(track.east_m, 100.0, atol=1e-3)
    np.testing.assert_allclose(track.velocity_east_mps, 0.0, atol=1e-2)


@pytest.mark.parametrize(
    ("times", "headings"),
    [([0.0], [1.0]), ([0.0, 0.0], [1.0, 2.0]), ([0.0, 1.0], [1.0, np.nan])],
    ids=["one", "same time", "not a number"],
)
def test_headings_that_are_none(times, headings) -> None:
    with pytest.raises(InputError):
        Headings(np.array(times), np.array(headings))


def noisy_way(seed: int, way_m: np.ndarray, every_s: int = 1) -> Platform:
    """A fix a second, or more seldom, from a receiver whose error lasts for twenty seconds."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-1.0 / 20.0)
    off = POSITION_SIGMA_M * rng.standard_normal(way_m.shape)
    for i in range(1, len(off)):
        off[i] = kept * off[i - 1] + np.sqrt(1.0 - kept**2) * off[i]
    return Platform(log(np.arange(len(way_m), dtype=float)[::every_s], (way_m + off)[::every_s]))


def accelerated_way(seed: int, acceleration_m2ps3: float) -> tuple[np.ndarray, np.ndarray]:
    """Places and velocities (240, 2), a second apart, under white acceleration."""
    push = np.sqrt(acceleration_m2ps3 * 0.1)
    push = push * np.random.default_rng([seed, 1]).normal(size=(2400, 2))
    velocity = np.cumsum(push, axis=0) + np.array([1.5, -0.8])
    return np.cumsum(0.1 * velocity, axis=0)[::10], velocity[::10]


def squared_errors(pose: Pose, way_m: np.ndarray, velocity_mps: np.ndarray) -> np.ndarray:
    """(N,) of place and velocity, in stated standard deviations; their mean should be 4."""
    off = np.stack([pose.en_m - way_m, pose.velocity_mps - velocity_mps], axis=1)
    return np.asarray((off * np.linalg.solve(pose.covariance, off)).sum(axis=(1, 2)))


def straight(n: int) -> np.ndarray:
    return np.arange(n)[:, None] * np.array([1.5, -0.8])


@pytest.mark.slow
@pytest.mark.parametrize("until_then", [False, True])
def test_the_velocity_of_a_platform_is_known_as_well_as_is_stated(until_then: bool) -> None:
    rows = np.arange(60, 235, 5)
    distances, errors, courses = [], [], []
    for seed in range(40):
        way, velocity = accelerated_way(seed, 0.003)
        pose = noisy_way(seed, way).pose(rows.astype(float), PLANE, until_then=until_then)
        distances.append(squared_errors(pose, way[rows], velocity[rows]))
        errors.append(pose.velocity_mps - velocity[rows])
        wrong = pose.heading_rad - np.arctan2(*velocity[rows].T)
        courses.append(((wrong + np.pi) % (2.0 * np.pi) - np.pi) / pose.heading_sigma_rad)
    # Two numbers along each of two axes.
    assert np.mean(distances) == pytest.approx(4.0, rel=0.35)
    # Two fixes a second apart tell a velocity to half a metre a second.
    assert np.std(errors) < 0.25
    if until_then:
        # The course that stands in for a heading is that of the velocity.
        assert np.sqrt(np.nanmean(np.square(courses))) == pytest.approx(1.0, rel=0.2)
        assert np.isfinite(courses).mean() > 0.9


def test_the_first_fixes_tell_no_more_than_their_errors_allow() -> None:
    """What the receiver is off by lasts, so that the second fix repeats the error of the first."""
    rows = np.arange(1, 9)
    distances = []
    for seed in range(40):
        way, velocity = accelerated_way(seed, 0.003)
        pose = noisy_way(seed, way).pose(rows.astype(float), PLANE, until_then=True)
        distances.append(squared_errors(pose, way[rows], velocity[rows]))
        # No more than the first fix and, for its own little noise, the second.
        assert (pose.covariance[:, 0, 0] > 0.8 * POSITION_SIGMA_M**2).all()
    assert np.mean(distances) == pytest.approx(4.0, rel=0.35)


def test_what_a_platform_does_after_its_last_fix_is_not_known() -> None:
    """Six seconds of acceleration are more than all that the fixes leave open."""
    rows = np.arange(62, 230, 7)
    distances = []
    for seed in range(40):
        way, velocity = accelerated_way(seed, 0.1)
        platform = noisy_way(seed, way, every_s=7)
        pose = platform.pose(rows.astype(float), PLANE, until_then=True)
        distances.append(squared_errors(pose, way[rows], velocity[rows]))
    assert np.mean(distances) == pytest.approx(4.0, rel=0.35)


def test_until_then_nothing_later_counts() -> None:
    whole = noisy_way(3, straight(200))
    part = Platform(
        Fixes(
            *(getattr(whole.fixes, name)[:101] for name in ("time_utc_s", "latitude_deg")),
            whole.fixes.longitude_deg[:101],
        )
    )
    times = np.arange(10.0, 100.0, 3.7)
    one, other = (p.pose(times, PLANE, until_then=True) for p in (whole, part))
    np.testing.assert_allclose(one.en_m, other.en_m, atol=1e-9)
    np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-12)
    # Without headings the course stands in for them.
    np.testing.assert_array_equal(one.heading_rad, other.heading_rad)
    np.testing.assert_array_equal(one.heading_sigma_rad, other.heading_sigma_rad)
    smoothed = whole.pose(times, PLANE)
    assert np.abs(smoothed.en_m - one.en_m).max() > 0.1


def test_a_platform_that_circles_is_followed_round() -> None:
    angle = np.arange(300) / 20.0
    way = 80.0 * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    pose = noisy_way(1, way).pose(np.arange(5.0, 290.0), PLANE)
    off = pose.en_m - way[5:290]
    assert np.sqrt(np.mean(off**2)) < 2.0
    assert np.mean(off**2) < 1.6 * pose.covariance[:, 0, 0].mean()
    speed = np.hypot(*pose.velocity_mps.T)
    assert np.std(speed - 4.0) < 0.5


def test_silence_in_the_log_leaves_no_place_and_no_way_across_it() -> None:
    times = np.append(np.arange(0.0, 40.0), np.arange(100.0, 140.0))
    place = np.where(times < 60.0, 2.0 * times, 500.0 - 3.0 * times)
    platform = Platform(log(times, np.stack([place, np.zeros(80)], axis=1)))
    pose = platform.pose([20.5, 70.0, 120.5], PLANE)
    np.testing.assert_allclose(pose.velocity_mps[[0, 2], 0], [2.0, -3.0], atol=1e-2)
    assert np.isnan(pose.en_m[1]).all()


def test_a_track_is_as_unsure_of_its_velocity_as_the_platform_is_of_its_own() -> None:
    times = np.arange(0.0, 20.0)
    platform = Platform(log(times, np.stack([2.0 * times, np.zeros(20)], axis=1)))
    about = positions(np.full((20, 2), 50.0), np.tile(np.eye(2), (20, 1, 1)))
    seen = north_up(about, pose(0.0, n=20))
    made = method("rts").apply(times, seen, track_id=1)
    where = platform.pose(made.time_utc_s, PLANE)
    track = moved_track(made, where)
    np.testing.assert_allclose(
        track.velocity_covariance_m2ps2 - made.velocity_covariance_m2ps2,
        where.covariance[:, 1:, 1:] * np.eye(2),
    )
    assert (where.covariance[:, 1, 1] > 0.0).all()


def test_a_place_is_told_where_the_log_is_interpolated() -> None:
    times = np.array([0.0, 2.0, 9.9, 10.0, 30.0, 31.0])
    platform = Platform(log(times, np.zeros((6, 2))))
    asked = np.array([-1.0, 0.0, 1.0, 5.0, 9.9, 15.0, 30.0, 30.5, 31.0, 32.0, np.nan])
    expected = synchronise(platform.fixes, asked, PLANE).matched
    np.testing.assert_array_equal(np.isfinite(platform.pose(asked, PLANE).en_m[:, 0]), expected)
    assert expected.sum() == 7


def test_a_log_without_a_fix_tells_nothing() -> None:
    platform = Platform(Fixes(np.empty(0), np.empty(0), np.empty(0)), compass())
    assert not platform.pose([1.0, 2.0], PLANE).known.any()
    one = Platform(log(np.array([1.0]), np.array([[3.0, 4.0]])), compass())
    pose = one.pose([1.0, 2.0], PLANE)
    assert pose.known.tolist() == [True, False]
    np.testing.assert_allclose(pose.en_m[0], [3.0, 4.0], atol=1e-6)


def yawing_deg(time_s: np.ndarray) -> np.ndarray:
    """A vessel that swings by some degrees about a course near north, in three ways at once."""
    swings = ((1.2, 9.0, 0.3), (0.8, 14.0, 1.7), (1.5, 27.0, 4.0))
    return 359.0 + sum(a * np.sin(2.0 * np.pi * time_s / p + f) for a, p, f in swings)


def heading_errors_deg(
    per_s: float, noise_deg: float, *, seed: int = 0, until_then: bool = False
) -> np.ndarray:
    """What headings are off by, of a compass with white noise."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 240.0, 1.0 / per_s)
    seen = yawing_deg(times) + noise_deg * rng.standard_normal(times.size)
    platform = Platform(
        log(np.arange(0.0, 241.0), np.zeros((241, 2))), Headings(times, seen % 360.0)
    )
    asked = np.sort(rng.uniform(5.0, 235.0, 500))
    pose = platform.pose(asked, PLANE, until_then=until_then)
    off = np.degrees(pose.heading_rad) - yawing_deg(asked)
    return np.asarray((off + 180.0) % 360.0 - 180.0)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize(
    ("per_s", "noise_deg", "most_deg"),
    [
        # The mean of what is known within a second or two, in which the turn is even.
        (10.0, 0.25, 0.09),
        (5.0, 0.25, 0.11),
        (10.0, 1.0, 0.27),
        (5.0, 1.0, 0.35),
    ],
)
def test_the_noise_of_a_compass_is_not_in_the_heading(
    per_s: float, noise_deg: float, most_deg: float
) -> None:
    assert rms(heading_errors_deg(per_s, noise_deg)) < most_deg


def test_until_then_a_heading_is_better_than_the_last_one_of_a_noisy_compass() -> None:
    assert rms(heading_errors_deg(10.0, 0.25, until_then=True)) < 0.2
    assert rms(heading_errors_deg(10.0, 1.0, until_then=True)) < 0.6


@pytest.mark.parametrize(
    ("per_s", "most_deg"), [(1.0, 0.05), (5.0, 0.01), (10.0, 0.01), (50.0, 0.01)]
)
def test_headings_without_noise_stay_as_they_are(per_s: float, most_deg: float) -> None:
    """Those of each second are interpolated: in a swell a hull yaws between them."""
    assert rms(heading_errors_deg(per_s, 0.0)) < most_deg


def test_until_then_no_later_heading_counts() -> None:
    rng = np.random.default_rng(5)
    times = np.arange(0.0, 60.0, 0.1)
    seen = yawing_deg(times) + 0.3 * rng.standard_normal(times.size)
    asked = np.arange(3.03, 29.0, 0.37)
    where = log(np.arange(0.0, 61.0), np.zeros((61, 2)))
    poses = []
    for end in (np.zeros(300), np.full(300, 40.0)):
        # What comes later turns away, or does not; the noise that is found is nearly the same.
        bent = seen + np.append(np.zeros(300), end * np.linspace(0.0, 1e-3, 300))
        poses.append(
            Platform(where, Headings(times, bent % 360.0)).pose(asked, PLANE, until_then=True)
        )
    np.testing.assert_allclose(poses[0].heading_rad, poses[1].heading_rad, atol=1e-12)


def test_a_turn_before_a_silence_does_not_go_on_after_it() -> None:
    times = np.append(np.arange(0.0, 20.0, 0.2), np.arange(60.0, 80.0, 0.2))
    seen = np.where(times < 40.0, 10.0 * times, 90.0) % 360.0
    platform = Platform(log(np.arange(0.0, 81.0), np.zeros((81, 2))), Headings(times, seen))
    pose = platform.pose([10.0, 19.7, 40.0, 60.1, 70.0], PLANE)
    wanted = np.radians([100.0, 197.0, np.nan, 90.0, 90.0])
    off = (pose.heading_rad - wanted + np.pi) % (2.0 * np.pi) - np.pi
    np.testing.assert_allclose(off[[0, 1, 3, 4]], 0.0, atol=np.radians(0.05))
    assert np.isnan(pose.heading_rad[2])


def compass() -> Headings:
    return Headings(np.array([0.0, 5.0]), np.array([10.0, 10.0]))
