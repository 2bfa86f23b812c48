import numpy as np
import pytest

from sightline.errors import InputError
from sightline.simulation.harbour import EXACT, BoxNoise, Harbour, HarbourSettings, ReceiverNoise


@pytest.fixture(scope="module")
def harbour() -> Harbour:
    return Harbour.random(3, HarbourSettings(duration_s=600.0))


def test_a_seed_gives_the_same_world_and_another_seed_another() -> None:
    one, same, other = (
        Harbour.random(seed, HarbourSettings(duration_s=30.0)) for seed in (5, 5, 6)
    )
    times = one.times(5.0)
    noise = BoxNoise(std_px=1.0, correlation_time_s=0.5, miss_probability=0.1)
    first, second = (
        one.boxes(times, noise=noise, of="all"),
        same.boxes(times, noise=noise, of="all"),
    )
    np.testing.assert_array_equal(first.xyxy_px, second.xyxy_px)
    np.testing.assert_array_equal(first.track_id, second.track_id)
    np.testing.assert_array_equal(
        one.fixes(ReceiverNoise()).latitude_deg, same.fixes(ReceiverNoise()).latitude_deg
    )
    assert one.camera != other.camera
    again = one.boxes(times, noise=noise, of="all", seed=1)
    assert len(again) != len(first) or not np.array_equal(again.xyxy_px, first.xyxy_px)


@pytest.mark.slow
def test_the_foot_of_a_box_lies_within_the_hull_of_the_true_place(harbour: Harbour) -> None:
    times = harbour.times(2.0)
    boxes = harbour.boxes(times)
    truth = harbour.truth(boxes.time_utc_s)
    whole = (boxes.xyxy_px[:, 0] > 0.0) & (boxes.xyxy_px[:, 2] < 1280.0)
    foot = np.stack(
        [0.5 * (boxes.xyxy_px[:, 0] + boxes.xyxy_px[:, 2]), boxes.xyxy_px[:, 3]], axis=-1
    )
    water = harbour.camera.on_water(foot)
    off = np.hypot(water[:, 0] - truth.east_m, water[:, 1] - truth.north_m)[whole]
    assert whole.sum() > 800
    assert off.max() < 0.6 * harbour.target.shape.length_m
    # The waterline nearest to the camera is nearer than the antenna.
    assert (np.hypot(*water.T)[whole] < truth.range_m[whole]).mean() > 0.99


def test_boats_move_as_boats_do(harbour: Harbour) -> None:
    times = harbour.times(2.0)
    for boat in harbour.boats:
        truth = harbour.truth(times, [boat])
        if not boat.path.moves:
            assert truth.speed_mps.max() == 0.0
            continue
        assert truth.speed_mps.max() < 9.0
        assert truth.speed_mps.min() > 0.5
        turn = np.diff(np.unwrap(np.radians(truth.course_deg))) / 0.5
        assert np.degrees(np.abs(turn)).max() < 18.0
        # Velocities are the derivative of the places.
        step = np.hypot(np.diff(truth.east_m), np.diff(truth.north_m))
        np.testing.assert_allclose(
            step / 0.5, 0.5 * (truth.speed_mps[1:] + truth.speed_mps[:-1]), atol=0.1
        )


def test_the_target_is_mostly_in_view_near_and_far(harbour: Harbour) -> None:
    times = harbour.times(2.0)
    boxes = harbour.boxes(times)
    assert len(boxes) > 0.75 * times.size
    ranges = harbour.truth(boxes.time_utc_s).range_m
    assert ranges.max() > 2.5 * ranges.min()
    assert set(boxes.track_id) == {harbour.target.identity}
    everything = harbour.boxes(times, of="all")
    moving = harbour.boxes(times, of="moving")
    still = {boat.identity for boat in harbour.boats if not boat.path.moves}
    assert set(everything.track_id) - set(moving.track_id) <= still
    assert not set(moving.track_id) & still


@pytest.mark.slow
@pytest.mark.parametrize("correlation_time_s", [0.0, 1.0])
def test_box_noise_has_the_stated_spread_bias_and_memory(
    harbour: Harbour, correlation_time_s: float
) -> None:
    times = harbour.times(10.0)
    noise = BoxNoise(
        std_px=1.5, correlation_time_s=correlation_time_s, lower_edge_bias_px=-4.0, source="x"
    )
    true, noisy = harbour.boxes(times), harbour.boxes(times, noise=noise)
    np.testing.assert_array_equal(true.frame, noisy.frame)
    inside = (true.xyxy_px[:, [0]] > 10).all(axis=1) & (true.xyxy_px[:, 2] < 1270)
    error = (noisy.xyxy_px - true.xyxy_px)[inside]
    # 6,000 boxes; correlated over a second that is 300 independent ones.
    np.testing.assert_allclose(error.mean(axis=0), [0.0, 0.0, 0.0, -4.0], atol=0.3)
    np.testing.assert_allclose(error.std(axis=0), 1.5, rtol=0.12)
    y2 = error[:, 3] - error[:, 3].mean()
    next_to = np.diff(true.frame[inside]) == 1
    memory = (y2[1:] * y2[:-1])[next_to].mean() / y2.var()
    expected = np.exp(-0.1 / correlation_time_s) if correlation_time_s else 0.0
    assert memory == pytest.approx(expected, abs=0.05)
    assert set(noisy.source) == {"x"}


@pytest.mark.slow
def test_misses_take_the_stated_share(harbour: Harbour) -> None:
    times = harbour.times(10.0)
    share = len(harbour.boxes(times, noise=BoxNoise(miss_probability=0.3))) / len(
        harbour.boxes(times)
    )
    assert share == pytest.approx(0.7, abs=0.03)


def test_an_exact_log_is_the_truth(harbour: Harbour) -> None:
    fixes = harbour.fixes(EXACT)
    truth = harbour.truth(fixes.time_utc_s)
    assert len(fixes) == 601
    np.testing.assert_allclose(fixes.latitude_deg, truth.latitude_deg, atol=1e-12)
    np.testing.assert_allclose(fixes.longitude_deg, truth.longitude_deg, atol=1e-12)


def test_receiver_noise_has_the_stated_spread_intervals_gaps_and_offset() -> None:
    harbour = Harbour.random(
        4, HarbourSettings(duration_s=3000.0, motorboats=0, sailboats=0, ferries=0, anchored=0)
    )
    noise = ReceiverNoise(std_m=1.5, correlation_time_s=5.0, clock_offset_s=2.0)
    fixes = harbour.fixes(noise)
    truth = harbour.truth(fixes.time_utc_s - 2.0)
    east, north = harbour.plane.to_plane(fixes.latitude_deg, fixes.longitude_deg)
    error = np.stack([east - truth.east_m, north - truth.north_m])
    np.testing.assert_allclose(error.std(axis=1), 1.5, rtol=0.12)
    np.testing.assert_allclose(error.mean(axis=1), 0.0, atol=0.3)
    intervals = np.diff(fixes.time_utc_s)
    usual = intervals[intervals < 1.3]
    assert usual.min() >= 0.75
    assert usual.max() <= 1.25 + 1e-6
    assert usual.std() == pytest.approx(0.25 / np.sqrt(3.0), rel=0.1)
    gaps = intervals[intervals > 1.3]
    assert 8 <= gaps.size <= 35  # twenty are expected
    assert gaps.max() < 2.0 * 12.0 + 2.0
    lag = (error[:, 1:] * error[:, :-1]).mean() / error.var()
    assert lag == pytest.approx(np.exp(-1.0 / 5.0), abs=0.06)


@pytest.mark.slow
def test_a_post_hides_what_passes_behind_it() -> None:
    harbour = Harbour.random(0, HarbourSettings(duration_s=600.0))
    times = harbour.times(10.0)
    post = harbour.piles[1]
    without = Harbour(
        harbour.camera, harbour.plane, harbour.boats, duration_s=600.0, seed=harbour.seed
    )
    seen, unhidden = harbour.boxes(times, of="all"), without.boxes(times, of="all")
    assert len(seen) < len(unhidden)
    pairs = set(zip(seen.frame.tolist(), seen.track_id.tolist(), strict=True))
    hidden = np.array(
        [
            pair not in pairs
            for pair in zip(unhidden.frame.tolist(), unhidden.track_id.tolist(), strict=True)
        ]
    )
    pixels = harbour.camera.project(post.outline_enu_m())
    boxes = unhidden.xyxy_px[hidden]
    bollard = harbour.camera.project(harbour.piles[0].outline_enu_m())
    by_post = (boxes[:, 0] < np.nanmax(pixels[:, 0])) & (boxes[:, 2] > np.nanmin(pixels[:, 0]))
    by_bollard = (boxes[:, 0] < np.nanmax(bollard[:, 0])) & (boxes[:, 2] > np.nanmin(bollard[:, 0]))
    assert (by_post | by_bollard).all()


def test_wrong_arguments_are_refused(harbour: Harbour) -> None:
    with pytest.raises(InputError, match="target, all, moving"):
        harbour.boxes(harbour.times(1.0), of="some")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="not positive"):
        Harbour.random(settings=HarbourSettings(duration_s=0.0))


def test_no_times_give_no_boxes(harbour: Harbour) -> None:
    assert len(harbour.boxes(np.empty(0))) == 0
    assert len(harbour.truth(np.empty(0))) == 0
