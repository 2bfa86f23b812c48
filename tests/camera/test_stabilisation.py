from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sightline
from sightline.camera.horizon_line import find_waterline
from sightline.camera.pinhole import EARTH_RADIUS_M, Camera
from sightline.camera.stabilisation import horizons_at, nominal_camera, stabilise
from sightline.camera.state import CameraHistory
from sightline.cli import main
from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.pipeline.evaluate import leave_one_out, place_boxes, score, with_forecasts
from sightline.pipeline.track import TrackSettings
from sightline.scene.camera_state import scene_horizons
from sightline.simulation import Harbour, HarbourSettings, SimulationSettings, simulate
from sightline.simulation.camera import SimulatedCamera
from sightline.simulation.platform import SimulatedPlatform, Sway
from sightline.synchronisation import synchronise
from sightline.trajectory.forecast import follow
from sightline.types import Boxes, Frame, Horizons, Positions

LENS = {"height_m": 5.0, "heading_deg": 30.0, "k1": -0.12, "k2": 0.02}


def still() -> Sway:
    return Sway(np.zeros(1), np.ones(1), np.zeros(1))


def tilted(pitch_deg: float, roll_deg: float) -> SimulatedPlatform:
    """A hull whose bow is where the camera looks, tilted for good."""
    quarter = np.array([np.pi / 2.0])
    period = np.array([1e12])
    return SimulatedPlatform(
        start_m=(0.0, 0.0),
        velocity_mps=(0.0, 0.0),
        heading_deg=30.0,
        yaw=still(),
        pitch=Sway(np.array([pitch_deg]), period, quarter),
        roll=Sway(np.array([roll_deg]), period, quarter),
    )


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(2.0, 0.0), (0.0, 4.0), (-1.5, 3.0)])
def test_a_box_of_a_tilted_hull_is_where_it_would_be_on_a_level_one(pitch_deg, roll_deg) -> None:
    simulated = SimulatedCamera(pitch_deg=2.0, roll_deg=0.5, focal_length_px=900.0, **LENS)
    camera = Camera(
        pitch_deg=2.0,
        roll_deg=0.5,
        focal_px=900.0,
        east_m=0.0,
        north_m=0.0,
        image_size_px=(1280, 720),
        **LENS,
    )
    turn = tilted(pitch_deg, roll_deg).turn([0.0])
    bearing = np.radians(30.0 + np.linspace(-25.0, 25.0, 11))
    ground = 80.0 * np.stack([np.sin(bearing), np.cos(bearing), np.zeros(11)], axis=1)
    true = simulated.project(ground)
    seen = simulated.project(ground, np.repeat(turn, 11, axis=0))
    assert np.abs(seen - true).max() > 20.0
    boxes = Boxes.of(
        np.hstack([seen - np.array([5.0, 10.0]), seen + np.array([5.0, 0.0])]), time_utc_s=0.0
    )
    line = simulated.horizon_line_px(turn[0])
    rows, usable = stabilise(
        boxes.xyxy_px,
        horizons_at(Horizons(np.array([0.0]), line[:1], line[1:]), boxes.time_utc_s),
        tuple(simulated.horizon_line_px()),
        camera,
    )
    assert usable.all()
    foot = np.stack([rows[:, [0, 2]].mean(axis=1), rows[:, 3]], axis=1)
    # Up and down it is right; the least rotation does not know the turn about the vertical that a
    # roll of the hull brings along where the camera looks down, so sideways it is a little off.
    np.testing.assert_allclose(foot[:, 1], true[:, 1], atol=0.5)
    np.testing.assert_allclose(foot[:, 0], true[:, 0], atol=2.5)


def test_a_nominal_camera_is_level() -> None:
    camera = nominal_camera((1280, 720))
    middle_row = camera.rays(np.array([[0.0, 360.0], [1280.0, 360.0]]))
    east, north, up = (middle_row @ camera.rotation).T
    np.testing.assert_allclose(up, 0.0, atol=1e-12)
    assert east[0] == pytest.approx(-east[1])
    assert east[1] > 0.0
    assert (north > 0.0).all()


def test_boxes_without_a_horizon_near_their_time_are_left_out() -> None:
    camera = Camera(5.0, 2.0, 0.0, 0.0, 900.0, 0.0, 0.0, 0.0, 0.0, (1280, 720))
    boxes = Boxes.of(np.tile([600.0, 400.0, 640.0, 420.0], (3, 1)), time_utc_s=[0.0, 0.1, 5.0])
    horizons = Horizons(np.array([0.0, 0.2, 9.0]), np.full(3, 330.0), np.full(3, 330.0))
    seen_px = horizons_at(horizons, boxes.time_utc_s)
    moved, usable = stabilise(boxes.xyxy_px, seen_px, (330.0, 330.0), camera)
    assert usable.tolist() == [True, True, False]
    np.testing.assert_allclose(moved[:2], boxes.xyxy_px[:2], atol=1e-9)


@pytest.fixture(scope="module")
def at_sea(tmp_path_factory: pytest.TempPathFactory) -> sightline.Scene:
    folder = tmp_path_factory.mktemp("sea")
    return sightline.Scene.load(
        simulate(folder, SimulationSettings(seed=1, video=False, moving=True)).scene
    )


@pytest.mark.slow
def test_a_camera_under_way_is_learned_and_its_ellipses_hold(at_sea: sightline.Scene) -> None:
    truth = json.loads((at_sea.path.parent / "truth.json").read_text())
    model = sightline.fit(at_sea, "camera")
    assert model.moving
    assert model.camera is not None
    bow = truth["platform"]["heading_deg"]
    off = model.camera.heading_deg - (truth["camera"]["heading_deg"] - bow)
    assert abs((off + 180.0) % 360.0 - 180.0) < 2.0
    assert model.camera.height_m == pytest.approx(truth["camera"]["height_m"], rel=0.15)
    assert model.camera.focal_px == pytest.approx(truth["camera"]["focal_length_px"], rel=0.1)
    placed = place_boxes(at_sea, leave_one_out(at_sea, "camera").__getitem__)
    report = score(placed, "rts")
    assert report.ape.per_range < 0.08
    assert report.coverage.p95 >= 0.85


@pytest.mark.slow
def test_forecasts_from_on_board_are_scored_on_the_earth(at_sea: sightline.Scene) -> None:
    placed = place_boxes(at_sea, leave_one_out(at_sea, "camera").__getitem__)
    report = with_forecasts(score(placed), placed)
    assert report.forecast is not None
    for ahead in ("10", "30", "60"):
        error = report.forecast[ahead]
        assert error.n > 100
        # The log knows where the target is to a metre or two, and goes straight on.
        assert error.rmse < error.beside_log.log_rmse


def test_a_target_at_rest_is_foretold_to_stay_though_the_platform_goes_on() -> None:
    plane = LocalPlane(54.3, 10.1)
    times = np.arange(0.0, 40.0, 1.0)
    en_m = np.stack([2.0 * times, 1.0 * times], axis=1)
    there = np.full((times.size, 2), [60.0, 200.0])
    noise = np.tile(0.25 * np.eye(2), (times.size, 1, 1))
    seen = Positions(there[:, 0], there[:, 1], noise, np.zeros(times.size, bool), plane)
    followed = follow(times, seen, camera_position_m=en_m)
    mean, _ = followed[-1:].ahead(10.0).moments()
    np.testing.assert_allclose(mean[0, :2], [60.0, 200.0], atol=1.0)
    np.testing.assert_allclose(mean[0, 2:], 0.0, atol=0.2)


def test_a_box_seen_from_a_vessel_has_a_place_on_the_earth_only_with_its_pose(
    at_sea: sightline.Scene,
) -> None:
    model = sightline.fit(at_sea, "camera")
    recording = at_sea.recordings[0]
    boxes, fixes, platform = recording.boxes(), recording.fixes(), recording.platform()
    assert platform is not None
    horizons = recording.horizons()
    boxes = model.compensated(CameraHistory(horizons=horizons).observed(boxes))
    with pytest.raises(InputError, match=r"no place on the earth; give the platform's pose"):
        model.locate(boxes.xyxy_px, boxes.source)
    body = model.locate_body(boxes.xyxy_px, boxes.source)
    assert not hasattr(body, "latitude_deg")
    pose = platform.pose(boxes.time_utc_s, model.plane)
    there = model.locate(boxes.xyxy_px, boxes.source, pose=pose)
    true = synchronise(fixes, boxes.time_utc_s, model.plane)
    east, north = model.plane.to_plane(there.latitude_deg, there.longitude_deg)
    error = np.hypot(east - true.east_m, north - true.north_m)
    assert np.nanmedian(error) < 10.0
    # Starboard and ahead, taken for east and north, are hundreds of metres off.
    wrong = np.hypot(body.starboard_m - true.east_m, body.ahead_m - true.north_m)
    assert np.nanmedian(wrong) > 5.0 * np.nanmedian(error)


class Drawn:
    """A detector that knows the boxes, and looks at one frame after another."""

    def __init__(self, boxes: Boxes) -> None:
        self._boxes = boxes

    def detect(self, frame: Frame) -> Boxes:
        here = self._boxes[self._boxes.frame == frame.index]
        return here.with_columns(time_utc_s=np.full(len(here), frame.time_utc_s))

    def reset(self) -> None:
        """Nothing is remembered."""


class DrawnByEight(Drawn):
    """The same, which looks at eight frames at once."""

    batch_size = 8

    def detect_batch(self, frames: Sequence[Frame]) -> list[Boxes]:
        return [self.detect(frame) for frame in frames]


def test_boxes_keep_the_horizon_of_their_own_frame_however_far_the_detector_runs_ahead(
    tmp_path: Path,
) -> None:
    made = simulate(
        tmp_path,
        SimulationSettings(
            seed=0, recordings=1, duration_s=9.0, rate_hz=4.0, moving=True, image_size_px=(640, 360)
        ),
    )
    scene = sightline.Scene.load(made.scene)
    (recording,) = scene.recordings
    model = sightline.fit(scene, "camera")
    assert model.horizon_px is not None

    def tracked(detector: Drawn) -> list[sightline.Track]:
        source = recording.video_path
        assert source is not None
        found = sightline.track(
            source,
            model,
            detector=detector,
            clock=recording.clock(),
            platform=recording.platform(),
            settings=TrackSettings(shortest_s=0.0),
        )
        return list(found)

    (one,) = tracked(Drawn(recording.boxes()))
    (by_eight,) = tracked(DrawnByEight(recording.boxes()))
    assert len(one) > 12
    for column in ("time_utc_s", "east_m", "north_m", "covariance_m2"):
        np.testing.assert_array_equal(getattr(by_eight, column), getattr(one, column))


def test_without_levelling_it_would_be_lost(at_sea: sightline.Scene) -> None:
    level_error = sightline.fit(at_sea, "camera").report.median_m
    text = at_sea.path.read_text()
    flat = "\n".join(line for line in text.splitlines() if not line.startswith("horizon"))
    path = at_sea.path.with_name("flat.toml")
    path.write_text(flat)
    assert sightline.fit(sightline.Scene.load(path), "camera").report.median_m > 2.0 * level_error


def test_tracks_lie_on_the_log(at_sea: sightline.Scene) -> None:
    model = sightline.fit(at_sea, "camera")
    recording = at_sea.recordings[2]
    tracks = sightline.track(
        recording.boxes(),
        model,
        platform=recording.platform_path,
        horizons=recording.horizons(),
    )
    report = sightline.evaluate(tracks, fixes=recording.fixes())
    assert report.ape.median < 15.0


def test_models_of_moving_and_still_cameras_are_told_apart(
    at_sea: sightline.Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sea.safetensors"
    model = sightline.fit(at_sea, "camera")
    model.save(path)
    again = sightline.load(path)
    assert again.moving
    assert again.horizon_px == model.horizon_px
    table = at_sea.path.parent / "boxes" / "01.csv"
    clock = at_sea.path.parent / "clock" / "01.csv"
    arguments = ["track", str(table), "--model", str(path), "--clock", str(clock)]
    with pytest.raises(SystemExit) as stopped:
        main([*arguments, "-o", str(tmp_path / "out.csv")])
    assert stopped.value.code == 2
    assert "--platform" in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()


def test_a_scene_of_a_camera_that_moves_only_now_and_then_is_refused(
    at_sea: sightline.Scene,
) -> None:
    text = at_sea.path.read_text().replace('platform = "platform.csv"', "", 1)
    path = at_sea.path.with_name("mixed.toml")
    path.write_text(text)
    with pytest.raises(InputError, match="two scenes"):
        sightline.fit(sightline.Scene.load(path), "camera")


@pytest.mark.slow
def test_the_waterline_is_found_in_pictures_of_a_sea_way(tmp_path: Path) -> None:
    made = simulate(
        tmp_path, SimulationSettings(seed=0, recordings=1, duration_s=4.0, rate_hz=3.0, moving=True)
    )
    (recording,) = sightline.Scene.load(made.scene).recordings
    found = scene_horizons(recording)
    assert found is not None
    harbour = made.harbour
    assert harbour.platform is not None
    turns = harbour.platform.turn(found.time_utc_s - harbour.start_utc_s)
    true = np.stack([harbour.camera.horizon_line_px(turn) for turn in turns])
    error = np.stack([found.left_y_px, found.right_y_px], axis=1) - true
    # The shore's foot lies below the horizon, always by as much; what matters is the change.
    assert np.ptp(true[:, 0]) > 5.0
    assert len(found) >= 0.9 * made.recordings[0].time_utc_s.size
    assert np.median(np.abs(error - np.median(error, axis=0))) < 1.0


def test_the_waterline_of_the_real_harbour_stays_where_it_is(data_dir: Path) -> None:
    scene = sightline.Scene.load(data_dir / "tracks-at-sea" / "scene.toml")
    lines = [find_waterline(frame.image_bgr) for frame in scene["09"].frames()]
    found = np.array([line for line in lines if line is not None])
    assert len(found) >= 0.6 * len(lines)
    # The camera stands on a dock. On the right a pale beach and dark trees take turns as the edge.
    middle = found.mean(axis=1)
    assert np.median(np.abs(middle - np.median(middle))) < 3.0


def test_nothing_is_found_where_nothing_is() -> None:
    assert find_waterline(np.full((360, 640, 3), 90, np.uint8)) is None
    assert find_waterline(np.zeros((8, 8, 3), np.uint8)) is None


def test_heave_is_told_from_errors_of_the_log(at_sea: sightline.Scene) -> None:
    simulated = Harbour.random(1, HarbourSettings(duration_s=214.0, moving=True))
    assert simulated.platform is not None
    lifted = simulated.platform.heave_m(np.arange(0.0, 214.0, 0.1))
    model = sightline.fit(at_sea, "camera")
    fitted = model.regressor.fit_
    noise = fitted.noise
    assert noise.heave_m == pytest.approx(np.std(lifted), rel=0.25)
    assert f"rises and falls by {noise.heave_m:.2f} m" in " ".join(model.report.statements)
    # Without it the rows would be off by what the annotator is, and the horizon. What the log's
    # drift takes of that is little where boxes are: the whole of a row's error is as simulated.
    assert noise.row_m < 0.1
    per_metre = model.camera.focal_px / fitted.typical_range_m
    whole = np.hypot(noise.row_px, per_metre * np.hypot(noise.heave_m, noise.row_m))
    simulated_px = np.hypot(np.hypot(1.0, 0.5), per_metre * np.std(lifted))
    assert whole == pytest.approx(simulated_px, rel=0.2)
    # It is in the ellipse of a box: as if its foot were as much too high or low.
    camera = model.camera
    box = np.array([[630.0, 380.0, 650.0, camera.horizon_y_px([640.0])[0] + 60.0]])
    off_axis = (box[0, 3] - 360.0 - camera.principal_dy_px) / camera.focal_px
    down = np.tan(np.radians(camera.pitch_deg) + np.arctan(off_axis))
    # The water falls away: down * d = height + curvature * d**2 / 2 R.
    bent = camera.curvature / (2.0 * EARTH_RADIUS_M)
    foot_m = (down - np.sqrt(down**2 - 4.0 * bent * camera.height_m)) / (2.0 * bent)
    per_metre_up = 1.0 / (down - 2.0 * bent * foot_m)
    still = replace(
        model, regressor=CameraRegressor.from_state(*_without_heave(model.regressor.state()))
    )
    more, less = (m.locate_body(box).covariance_m2[0] for m in (model, still))
    at = model.locate_body(box)
    sight = np.array([at.starboard_m[0], at.ahead_m[0]])
    sight /= np.hypot(*sight)
    expected = (noise.heave_m * per_metre_up) ** 2
    assert sight @ (more - less) @ sight == pytest.approx(expected, rel=0.1)


def _without_heave(state: tuple) -> tuple:
    arrays, settings = state
    return arrays, {**settings, "noise": {**settings["noise"], "heave_m": 0.0}}


@pytest.mark.slow
def test_a_camera_that_stands_still_does_not_heave(tmp_path: Path) -> None:
    scene = sightline.Scene.load(simulate(tmp_path, SimulationSettings(seed=1, video=False)).scene)
    assert sightline.fit(scene, "camera").regressor.fit_.noise.heave_m == 0.0


def test_waves_are_not_learned_as_of_places(at_sea: sightline.Scene) -> None:
    model = sightline.fit(at_sea, "camera+gpr")
    assert model.regressor.range_process_ is None
    assert model.regressor.bearing_process_ is None
