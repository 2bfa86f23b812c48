"""Boxes of a camera that was turned, as if it had not been."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sightline
from sightline import Georeferencer, Scene
from sightline.camera.motion import CameraMotionDetector
from sightline.camera.pinhole import Camera
from sightline.camera.registration import ReferenceView
from sightline.camera.rotation import CameraRotation, compensate_rotation, seen_again, widen
from sightline.camera.static_intervals import StaticIntervalMonitor
from sightline.errors import InputError, ModelFileError
from sightline.geodesy import LocalPlane
from sightline.pipeline.evaluate import place_boxes, score
from sightline.pipeline.track import TrackSettings
from sightline.simulation import Knock, SimulatedCamera, SimulationSettings, simulate
from sightline.simulation.harbour import START_UTC_S
from sightline.synchronisation import synchronise
from sightline.types import Boxes, Frame, Positions

LENS = Camera(5.0, 2.0, 0.7, 30.0, 900.0, -0.12, 0.02, 1.0, -2.0, (1280, 720))
TURN_DEG = (0.8, -0.6, 0.5)
KNOCKED_S = START_UTC_S + 65.0 + 20.0


def turned(camera: Camera) -> Camera:
    heading_deg, pitch_deg, roll_deg = TURN_DEG
    return replace(
        camera,
        heading_deg=camera.heading_deg + heading_deg,
        pitch_deg=camera.pitch_deg + pitch_deg,
        roll_deg=camera.roll_deg + roll_deg,
    )


def turns(covariance_rad2: np.ndarray | None = None) -> CameraRotation:
    """The camera as the model knows it until 100 s, and turned from 101 s on."""
    rotation = Rotation.from_matrix(turned(LENS).rotation @ LENS.rotation.T).as_rotvec()
    covariance = np.zeros((3, 3)) if covariance_rad2 is None else covariance_rad2
    return CameraRotation(
        before_utc_s=np.array([-np.inf, 100.0]),
        since_utc_s=np.array([-np.inf, 101.0]),
        rotation_rad=np.array([np.zeros(3), rotation]),
        covariance_rad2=np.array([np.zeros((3, 3)), covariance]),
        heading_known=np.array([True, True]),
        camera=LENS,
    )


def places() -> tuple[np.ndarray, np.ndarray]:
    bearing = np.radians(30.0 + np.linspace(-25.0, 25.0, 11))
    return 1.0 + 90.0 * np.sin(bearing), -2.0 + 90.0 * np.cos(bearing)


def boxes_at(foot: np.ndarray, time_utc_s: float) -> Boxes:
    corners = np.hstack([foot - np.array([5.0, 10.0]), foot + np.array([5.0, 0.0])])
    return Boxes.of(corners, time_utc_s=time_utc_s)


def compensated(boxes: Boxes) -> tuple[np.ndarray, np.ndarray]:
    return compensate_rotation(boxes.xyxy_px, turns().at(boxes.time_utc_s)[0], LENS)


def test_a_box_after_the_turn_is_where_it_would_be_without() -> None:
    seen = turned(LENS).project(*places())
    true = LENS.project(*places())
    assert np.abs(seen - true).max() > 10.0
    levelled, known = compensated(boxes_at(seen, 101.0))
    assert known.all()
    foot = np.stack([levelled[:, [0, 2]].mean(axis=1), levelled[:, 3]], axis=1)
    np.testing.assert_allclose(foot, true, atol=1e-6)
    before = boxes_at(true, 99.0)
    np.testing.assert_allclose(compensated(before)[0], before.xyxy_px, atol=1e-9)


def test_angles_are_those_of_the_camera() -> None:
    # Heading and roll are about the camera's axes, which lie two degrees off the earth's.
    np.testing.assert_allclose(turns().angles_deg[1], TURN_DEG, atol=0.04)


def test_boxes_of_which_nobody_knows_whether_they_come_after_are_left_out() -> None:
    boxes = boxes_at(LENS.project(*places())[:4], 0.0).with_columns(
        time_utc_s=[100.0, 100.1, 100.9, 101.0]
    )
    assert boxes.time_utc_s[compensated(boxes)[1]].tolist() == [100.0, 101.0]


def test_what_is_not_known_of_a_turn_is_in_the_ellipse_as_samples_say() -> None:
    root = np.radians(np.array([[0.20, 0.0, 0.0], [0.05, 0.30, 0.0], [0.0, 0.10, 0.15]]))
    east, north = places()
    foot = LENS.project(east, north)
    zero = np.zeros((east.size, 2, 2))
    exact = Positions(east, north, zero, np.zeros(east.size, bool), LocalPlane(54.0, 10.0), zero)
    found = turns(root @ root.T)
    wide = widen(exact, found.at(np.full(east.size, 200.0))[1], LENS)
    rng = np.random.default_rng(0)
    found = np.array(
        [
            LENS.locate(LENS.pixels(Rotation.from_rotvec(root @ w).apply(LENS.rays(foot))))
            for w in 0.1 * rng.standard_normal((4000, 3))
        ]
    )
    sampled = np.array([100.0 * np.cov(found[:, :, i].T) for i in range(east.size)])
    np.testing.assert_allclose(wide.covariance_m2, sampled, rtol=0.12, atol=0.1)
    assert wide.shared_covariance_m2 is not None
    np.testing.assert_allclose(wide.shared_covariance_m2, wide.covariance_m2)
    before = widen(exact, turns(root @ root.T).at(np.full(east.size, 50.0))[1], LENS)
    assert not before.covariance_m2.any()


def sea(turn_px: tuple[float, float], seed: int, *, duration_s: int = 40) -> Iterator[Frame]:
    """Sky above waves that are new in each picture, and nothing that stands still."""
    rng = np.random.default_rng(seed)
    for i in range(duration_s):
        image = np.full((420, 720), 210.0, dtype=np.float32)
        waves = cv2.resize(rng.normal(0.0, 30.0, (70, 240)).astype(np.float32), (720, 210))
        image[210:] = 110.0 + waves
        x_px, y_px = turn_px if i >= 20 else (0.0, 0.0)
        move = np.array([[1.0, 0.0, x_px - 40.0], [0.0, 1.0, y_px - 30.0]])
        image = cv2.warpAffine(image, move, (640, 360))
        grey = np.clip(image + rng.normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8)
        yield Frame(i, 1000.0 + i, np.repeat(grey[:, :, None], 3, axis=2))


@pytest.mark.parametrize("seed", range(3))
def test_a_horizon_alone_tells_pitch_and_roll_and_leaves_the_heading_open(seed: int) -> None:
    level = Camera(5.0, 0.0, 0.0, 0.0, 900.0, 0.0, 0.0, 0.0, 0.0, (640, 360))
    watch = CameraMotionDetector((180.0, 180.0), 900.0, least_deg=0.05, reference_frames=5)
    shift_px = 900.0 * np.tan(np.radians(1.0))
    noticed = [one for f in sea((12.0, shift_px), seed) if (one := watch.update(f)) is not None]
    (turn,) = noticed
    assert np.isnan(turn.heading_deg)
    assert 1020.0 < turn.time_utc_s < 1040.0
    found = CameraRotation.of(watch.static_intervals, level)
    assert found is not None
    assert found.heading_known.tolist() == [True, False]
    assert found.angles_deg[1, 1:] == pytest.approx([-1.0, 0.0], abs=0.05)
    assert found.sigma_deg[1, 0] >= 0.9
    assert "unknown angle in heading" in found.sentences()[0]
    # The unknown heading makes places unsure across the sight, and by as much as it says.
    zero = np.zeros((1, 2, 2))
    ahead = Positions([0.0], [100.0], zero, [False], LocalPlane(54.0, 10.0), zero)
    wide = widen(ahead, found.at(np.array([1039.0]))[1], level).covariance_m2[0]
    assert np.sqrt(wide[0, 0]) == pytest.approx(100.0 * np.radians(1.0), rel=0.1)


def test_nothing_is_turned_where_only_waves_move() -> None:
    level = Camera(5.0, 0.0, 0.0, 0.0, 900.0, 0.0, 0.0, 0.0, 0.0, (640, 360))
    for seed in range(5):
        watch = CameraMotionDetector((180.0, 180.0), 900.0, least_deg=0.05, reference_frames=5)
        assert [watch.update(f) for f in sea((0.0, 0.0), seed)] == [None] * 40
        assert CameraRotation.of(watch.static_intervals, level) is None


@dataclass(frozen=True)
class World:
    """A harbour whose camera is turned by a degree in the second of two recordings.

    Attributes:
        scene: The harbour.
        still: The same, not turned, without pictures.
        model: Fitted to the first recording.
    """

    scene: Scene
    still: Scene
    model: Georeferencer


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    scene, still = (
        Scene.load(
            simulate(
                tmp_path_factory.mktemp("harbour"),
                SimulationSettings(
                    seed=2,
                    recordings=2,
                    duration_s=50.0,
                    rate_hz=2.0,
                    image_size_px=(640, 360),
                    clock="exact",
                    video=knock is not None,
                    knock=knock,
                ),
            ).scene
        )
        for knock in (Knock(KNOCKED_S, pitch_deg=1.0), None)
    )
    return World(scene, still, sightline.fit(scene.select(["01"]), "camera"))


def off_m(scene: Scene, model: Georeferencer) -> float:
    """RMSE of single boxes after the turn."""
    (placed,) = place_boxes(scene.select(["02"]), lambda _: model)
    pairs = placed.single()
    return float(np.sqrt(np.mean(pairs.error_m[pairs.time_utc_s > KNOCKED_S + 2.0] ** 2)))


@pytest.mark.slow
def test_places_hold_after_a_turn_of_a_degree(world: World) -> None:
    still_m = off_m(world.still, world.model)
    assert off_m(world.scene, world.model) < 1.15 * still_m
    unwatched = replace(world.scene, camera=replace(world.scene.camera, compensate_rotation=False))
    assert off_m(unwatched, world.model) > 5.0 * still_m


class Eye:
    """A detector that knows the boxes."""

    def __init__(self, boxes: Boxes) -> None:
        self._boxes = boxes

    def detect(self, frame: Frame) -> Boxes:
        here = self._boxes[self._boxes.frame == frame.index]
        return here.with_columns(time_utc_s=np.full(len(here), frame.time_utc_s))

    def reset(self) -> None:
        """Nothing is remembered."""


@pytest.mark.slow
@pytest.mark.parametrize("corrected", [True, False])
def test_tracks_hold_as_pictures_come_in(world: World, corrected: bool) -> None:
    recording = world.scene["02"]
    found = sightline.track(
        recording.video_path,
        world.model,
        clock=recording.clock(),
        detector=Eye(recording.boxes()),
        settings=TrackSettings(compensate_rotation=corrected),
    )
    error_m, inside = [], []
    for one in found:
        log = synchronise(recording.fixes(), one.time_utc_s, world.model.plane)
        off = np.stack([one.east_m - log.east_m, one.north_m - log.north_m], axis=1)
        rows = log.matched & (one.time_utc_s > KNOCKED_S)
        error_m += np.hypot(*off[rows].T).tolist()
        distance2 = np.einsum("ni,nij,nj->n", off, np.linalg.inv(one.covariance_m2), off)
        inside += (distance2[rows] < 5.99).tolist()
    assert len(error_m) > 30
    if corrected:
        assert np.median(error_m) < 10.0
        assert np.mean(inside) > 0.6
    else:
        assert np.median(error_m) > 30.0


def test_a_fit_takes_the_turn_of_a_recording_off_its_boxes(world: World) -> None:
    def residual_m(watched: bool) -> float:
        camera = replace(world.scene.camera, compensate_rotation=watched)
        fitted = sightline.fit(replace(world.scene, camera=camera), "camera")
        said = " ".join(fitted.report.statements)
        assert ("was rotated" in said) == watched
        assert fitted.camera is not None
        return fitted.report.rmse_m

    assert residual_m(True) < 0.5 * residual_m(False)


def test_a_fit_to_drawn_boxes_does_without_a_video_that_cannot_be_read(
    world: World, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = Path(shutil.copytree(world.scene.path.parent, tmp_path / "harbour"))
    video = folder / "01.mp4"
    video.write_bytes(video.read_bytes()[:5000])
    fitted = sightline.fit(Scene.load(folder / "scene.toml").select(["01"]), "camera")
    assert fitted.view is None
    np.testing.assert_allclose(
        fitted.regressor.fit_.vector, world.model.regressor.fit_.vector, rtol=1e-6
    )
    (warning,) = caplog.messages
    assert warning.startswith("nothing tells whether the camera was rotated: ")
    assert "\n" not in warning


def test_a_model_remembers_what_stands_still(world: World, tmp_path: Path) -> None:
    path = world.model.save(tmp_path / "model.safetensors")
    again = sightline.load(path)
    assert world.model.view is not None
    assert again.view is not None
    for name in ("strips", "top_px", "left_px"):
        np.testing.assert_array_equal(getattr(again.view, name), getattr(world.model.view, name))
    broken = replace(world.model, view=replace(world.model.view, top_px=np.zeros(7)))
    object.__setattr__(broken.view, "strips", world.model.view.strips[:3])
    with pytest.raises(ModelFileError, match="strips"):
        sightline.load(broken.save(tmp_path / "broken.safetensors"))


def test_a_view_without_places_is_refused() -> None:
    with pytest.raises(InputError, match="each with its row"):
        ReferenceView(np.zeros((3, 4, 4), np.uint8), np.zeros(2, np.int64), np.zeros(3, np.int64))


def test_a_knock_turns_the_simulated_camera_and_the_sky_stays(world: World) -> None:
    camera = SimulatedCamera(5.0, 1.0, 0.4, 80.0, 500.0, image_size_px=(640, 360))
    knock = Knock(10.0, heading_deg=1.0, pitch_deg=-0.5, roll_deg=0.3)
    after = replace(camera, heading_deg=81.0, pitch_deg=0.5, roll_deg=0.7)
    there = np.array([[[120.0, 30.0, 2.0]]])
    np.testing.assert_allclose(
        camera.project(there, knock.turn(camera, [11.0])), after.project(there)
    )
    np.testing.assert_allclose(
        camera.project(there, knock.turn(camera, [9.0])), camera.project(there)
    )
    with pytest.raises(InputError, match="under way"):
        simulate(world.scene.path.parent / "none", SimulationSettings(moving=True, knock=knock))


@pytest.mark.slow
def test_the_real_camera_was_knocked_once_and_its_boxes_are_better_without(data_dir: Path) -> None:
    scene = Scene.load(data_dir / "tracks-at-sea" / "scene.toml")
    fitted = sightline.fit(scene, "camera")
    (said,) = [s for s in fitted.report.statements if "was rotated" in s]
    # It was knocked in recording 08; 18 and 19 are the earliest.
    assert "recordings 06, 07, 08, 18, 19 it" in said
    unwatched = replace(scene, camera=replace(scene.camera, compensate_rotation=False))
    plain = sightline.fit(unwatched, "camera")
    # In the others the camera stood as it does in the model either way.
    watched, unwatched_too = (
        score(
            [
                placed
                for placed in place_boxes(one, lambda _, m=model: m)
                if placed.recording in ("06", "07", "08", "18", "19")
            ]
        ).ape
        for one, model in ((scene, fitted), (unwatched, plain))
    )
    assert watched.median < unwatched_too.median
    assert watched.rmse < unwatched_too.rmse


@pytest.mark.slow
@pytest.mark.parametrize("name", ["06", "07", "13", "17"])
def test_the_mirror_image_of_a_shore_is_not_taken_for_the_shore_turned(
    data_dir: Path, name: str
) -> None:
    scene = Scene.load(data_dir / "tracks-at-sea" / "scene.toml")
    fitted = sightline.fit(scene, "camera")
    assert fitted.camera is not None
    assert fitted.view is not None
    watches = {mirrored: StaticIntervalMonitor() for mirrored in (False, True)}
    for frame in scene[name].frames(apart_s=1.0):
        watches[False].observe(frame)
        watches[True].observe(replace(frame, image_bgr=frame.image_bgr[:, ::-1].copy()))
    shore = {mirrored: watch.static_intervals for mirrored, watch in watches.items()}
    assert shore[False]
    assert shore[True]
    assert seen_again(fitted.view, shore[False][0].view, fitted.camera)
    assert not seen_again(fitted.view, shore[True][0].view, fitted.camera)
    assert CameraRotation.of(shore[True], fitted.camera, fitted.view) is None
