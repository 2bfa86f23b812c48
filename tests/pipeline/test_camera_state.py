"""A camera that is turned while tracks are made, before a shore that stands still."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest

from sightline import Georeferencer, Scene, fit
from sightline.camera.motion import StaticInterval
from sightline.camera.pinhole import Camera
from sightline.camera.registration import ReferenceView
from sightline.camera.rotation import CameraRotation
from sightline.camera.state import ObservedBoxes
from sightline.camera.static_intervals import StaticIntervalMonitor
from sightline.formats import read_clock
from sightline.geodesy import LocalPlane
from sightline.pipeline.camera_state import CameraMotionMonitor, camera_turns
from sightline.pipeline.track import iter_tracks
from sightline.types import Boxes, Frame, LocatedBoxes, Positions

SIZE_PX = (640, 360)
START_S = 1_700_000_000.0
LEVEL = Camera(
    height_m=5.0,
    pitch_deg=0.0,
    roll_deg=0.0,
    heading_deg=0.0,
    focal_px=900.0,
    k1=0.0,
    k2=0.0,
    east_m=0.0,
    north_m=0.0,
    image_size_px=SIZE_PX,
)


@dataclass(frozen=True)
class Fitted:
    """What is asked of a model: its camera, and whether that moves."""

    camera: Camera | None = LEVEL
    moving: bool = False
    image_size_px: tuple[int, int] = SIZE_PX
    horizon_px: None = None
    view: ReferenceView | None = None
    static_places: None = None
    plane: LocalPlane = field(default_factory=lambda: LocalPlane(54.3, 10.1))

    def check_water(self, given: bool, _where: str = "") -> None:
        assert not given

    def rotation_in(self, static_intervals: Sequence[StaticInterval]) -> CameraRotation | None:
        return (
            None
            if self.camera is None
            else CameraRotation.of(static_intervals, self.camera, self.view)
        )

    def compensated(self, boxes: ObservedBoxes) -> ObservedBoxes:
        return boxes

    def place_compensated(self, boxes: ObservedBoxes) -> LocatedBoxes:
        assert not len(boxes), "there are no boxes to place"
        empty = np.empty(0)
        nowhere = Positions(empty, empty, np.empty((0, 2, 2)), empty, self.plane)
        return LocatedBoxes.at(boxes, nowhere)


class SeesNothing:
    def detect(self, _frame: Frame) -> Boxes:
        return Boxes.of([])

    def reset(self) -> None:
        pass


def model(**changes: object) -> Georeferencer:
    return cast(Georeferencer, Fitted(**changes))  # type: ignore[arg-type]


def pictures(
    *,
    turned_at_s: float = np.inf,
    turn_px: tuple[float, float] = (0.0, 0.0),
    apart_s: float = 0.5,
    duration_s: float = 40.0,
    shore: bool = True,
    seed: int = 0,
) -> Iterator[Frame]:
    """Sky, houses on a shore, and waves that are new in each picture."""
    rng = np.random.default_rng(seed)
    wide = np.full((420, 720), 210.0, dtype=np.float32)
    for _ in range(120 if shore else 0):
        x, high = rng.integers(0, 700), rng.integers(3, 22)
        wide[210 - high : 210, x : x + rng.integers(4, 20)] = rng.uniform(60, 190)
    for i in range(int(duration_s / apart_s)):
        time_s = i * apart_s
        image = wide.copy()
        waves = cv2.resize(rng.normal(0.0, 30.0, (70, 240)).astype(np.float32), (720, 210))
        image[210:] = 110.0 + waves
        x_px, y_px = turn_px if time_s >= turned_at_s else (0.0, 0.0)
        move = np.array([[1.0, 0.0, x_px - 40.0], [0.0, 1.0, y_px - 30.0]])
        image = cv2.warpAffine(image, move, SIZE_PX)
        grey = np.clip(image + rng.normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8)
        yield Frame(i, START_S + time_s, np.repeat(grey[:, :, None], 3, axis=2))


def folder_of(frames: Iterator[Frame], folder: Path) -> tuple[Path, Path]:
    """Pictures in a folder, and their clock."""
    (folder / "frames").mkdir()
    clock = "frame,utc\n"
    for frame in frames:
        cv2.imwrite(str(folder / "frames" / f"{frame.index}.png"), frame.image_bgr)
        clock += f"{frame.index},{frame.time_utc_s}\n"
    (folder / "clock.csv").write_text(clock)
    return folder / "frames", folder / "clock.csv"


@pytest.mark.slow
@pytest.mark.parametrize("apart_s", [0.5, 4.0])
def test_track_warns_of_a_turn_within_20_seconds(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, apart_s: float
) -> None:
    turn_px = -900.0 * np.tan(np.radians(1.0))
    frames = pictures(
        turned_at_s=24.0, turn_px=(turn_px, 0.0), apart_s=apart_s, duration_s=44.0 + apart_s
    )
    source, clock = folder_of(frames, tmp_path)
    with caplog.at_level(logging.WARNING, logger="sightline"):
        made = list(
            iter_tracks(
                source,
                model(),
                detector=SeesNothing(),
                clock=read_clock(clock),
            )
        )
    assert made == []
    (said,) = [r.getMessage() for r in caplog.records if "rotated" in r.getMessage()]
    assert said.startswith(f"{source}: the camera was rotated shortly before 2023-11-14T22:1")
    heading_deg = float(said.split(" degrees in heading")[0].split()[-1])
    assert heading_deg == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("shore", [True, False], ids=["a shore", "open water"])
def test_a_camera_that_stands_still_is_not_said_to_turn(shore: bool) -> None:
    for seed in range(10):
        watch = CameraMotionMonitor(model())
        for frame in pictures(seed=seed, shore=shore, apart_s=1.0, duration_s=30.0):
            assert watch.observe(frame) is None


def test_a_turn_of_a_pixel_and_a_half_is_seen_and_measured() -> None:
    watch = CameraMotionMonitor(model())
    frames = pictures(turned_at_s=12.0, turn_px=(0.0, 1.5), apart_s=1.0, duration_s=25.0)
    (turn,) = [turn for frame in frames if (turn := watch.observe(frame)) is not None]
    assert turn.pitch_deg == pytest.approx(-np.degrees(1.5 / 900.0), abs=0.02)
    assert START_S + 12.0 < turn.time_utc_s < START_S + 20.0


def view_of(frames: Iterator[Frame]) -> ReferenceView:
    watch = StaticIntervalMonitor()
    for frame in frames:
        watch.observe(frame)
    return watch.static_intervals[0].view


def at_night(frames: Iterator[Frame]) -> Iterator[Frame]:
    """So dark that the noise of the sensor is all that is left."""
    rng = np.random.default_rng(9)
    for frame in frames:
        dark = 0.01 * frame.image_bgr + rng.normal(12.0, 4.0, frame.image_bgr.shape)
        yield replace(frame, image_bgr=np.clip(dark, 0, 255).astype(np.uint8))


@pytest.mark.parametrize(
    ("later", "told"),
    [
        (lambda: pictures(seed=1, apart_s=1.0, duration_s=20.0), False),
        (lambda: pictures(seed=2, apart_s=1.0, duration_s=20.0), True),
        (lambda: at_night(pictures(seed=1, apart_s=1.0, duration_s=20.0)), True),
    ],
    ids=["by day", "another shore", "by night"],
)
def test_a_shore_that_the_model_does_not_know_is_told_of(
    later: Callable[[], Iterator[Frame]], told: bool, caplog: pytest.LogCaptureFixture
) -> None:
    view = view_of(pictures(seed=1, apart_s=1.0, duration_s=12.0))
    watch = CameraMotionMonitor(model(view=view), warn_of="later.mp4")
    with caplog.at_level(logging.WARNING, logger="sightline"):
        for frame in later():
            watch.observe(frame)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == int(told)
    assert all(one.startswith("later.mp4: the far shore that the model was") for one in said)


@pytest.mark.parametrize(
    "changes",
    [
        {"camera": None},
        {"moving": True},
        {"camera": replace(LEVEL, pitch_deg=40.0)},
        {"camera": replace(LEVEL, image_size_px=(100, 50)), "image_size_px": (100, 50)},
    ],
    ids=["no camera", "on a platform that moves", "horizon outside the picture", "too small"],
)
def test_what_cannot_be_watched_is_not(changes: dict[str, object]) -> None:
    watch = CameraMotionMonitor(model(**changes))
    assert not watch.able
    for frame in pictures(turned_at_s=5.0, turn_px=(20.0, 0.0), apart_s=1.0, duration_s=15.0):
        assert watch.observe(frame) is None


@pytest.mark.slow
def test_the_real_camera_was_turned_in_one_recording(data_dir: Path) -> None:
    scene = Scene.load(data_dir / "tracks-at-sea" / "scene.toml")
    fitted = fit(scene, "camera")
    said = {name: camera_turns(scene[name], fitted) for name in ("07", "08", "13")}
    # The model is of the camera as it lay at the end, after it was knocked in recording 08.
    assert said["13"] is None
    for name in ("07", "08"):
        assert said[name] is not None
        assert "from its beginning the camera was rotated" in said[name]
        roll_deg = float(said[name].split(" in roll")[0].split(" ± ")[-2].split()[-1])
        assert roll_deg == pytest.approx(-0.1, abs=0.03)
    assert "Z on the camera pointed as for the model" in said["08"]
    assert "Z on" not in said["07"]
