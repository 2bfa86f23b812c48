"""What is learned from boxes that were recognised, of a vessel whose place and height are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sightline.association import Association, associate
from sightline.association.observations import observe
from sightline.association.search import RecordingObservations
from sightline.camera.pinhole import Camera
from sightline.detection import LowerEdge
from sightline.errors import FitError
from sightline.formats import write_boxes, write_fixes
from sightline.geodesy import LocalPlane
from sightline.pipeline.fit_unlabelled import (
    CORRELATION_TIME_S,
    MOST_A_RECORDING,
    fit_association,
    fit_scene,
    recognised_correspondences,
)
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.scene import Scene
from sightline.types import Boxes, Fixes, FloatArray

SIZE = (1280, 720)
CAMERA = Camera(5.0, 3.0, 0.4, 40.0, 1000.0, -0.1, 0.01, 0.0, 0.0, SIZE)
PLANE = LocalPlane(54.3233, 10.1394)
START_UTC_S = 1_717_236_000.0
DURATION_S = 280.0
HULL_M = 3.0
"""Of the vessel, above the water."""
EDGE = LowerEdge(px=0.0, share=0.3, spread_px=0.3)
"""The detector leaves so much of what it sees of a hull below it, and as much above it."""


def place(since_s: FloatArray) -> FloatArray:
    """(N, 2) of a vessel that turns to and fro before the camera, 45 to 280 m away."""
    phase = 2.0 * np.pi * since_s
    bearing = np.radians(
        CAMERA.heading_deg + 24.0 * np.sin(phase / 83.0 + 0.5) + 4.0 * np.sin(phase / 29.0)
    )
    distance = 110.0 * np.exp(0.75 * np.cos(phase / 61.0) + 0.2 * np.sin(since_s / 9.0))
    return distance[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)


def detections() -> Boxes:
    """Four a second, each with water below the hull."""
    since_s = np.arange(0.0, DURATION_S, 0.25)
    where = place(since_s)
    foot = CAMERA.project(*where.T)
    foot += np.random.default_rng(1).normal(0.0, 1.0, foot.shape)
    hull_px = HULL_M * CAMERA.focal_px / np.hypot(np.hypot(*where.T), CAMERA.height_m)
    column, row = foot.T
    left_px = EDGE.share * hull_px
    return Boxes.of(
        np.stack(
            [column - hull_px, row - hull_px - left_px, column + hull_px, row + left_px], axis=1
        ),
        time_utc_s=START_UTC_S + since_s,
        track_id=np.ones(since_s.size, dtype=np.int64),
        source="measured",
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("unlabelled")
    since_s = np.arange(-60.0, DURATION_S + 60.0)
    fixes = Fixes(START_UTC_S + since_s, *PLANE.to_geographic(*place(since_s).T))
    write_fixes(fixes, folder / "log.csv")
    write_boxes(detections(), folder / "seen.csv")
    (folder / "scene.toml").write_text(
        f"""[camera]
latitude_deg = {PLANE.latitude_deg}
longitude_deg = {PLANE.longitude_deg}
image_size_px = [{SIZE[0]}, {SIZE[1]}]
[[recordings]]
name = "one"
detections = "seen.csv"
fixes = "log.csv"
""",
        encoding="utf-8",
    )
    return Scene.load(folder / "scene.toml")


@pytest.fixture(scope="module")
def association(scene: Scene) -> Association:
    path = ReferenceTrajectory.of(scene["one"].fixes(), PLANE)
    return associate([RecordingObservations("one", observe(detections()), (path,))], SIZE)


def test_a_measured_edge_is_below_the_hull_and_not_the_camera_higher(
    scene: Scene, association: Association
) -> None:
    """Boxes that all end 0.9 m below the water look as from a camera that stands as much higher."""
    fitted = fit_association(scene, association, "camera", lower_edges={"measured": EDGE})
    (source,) = fitted.report.sources
    assert source.bias_m == pytest.approx(-EDGE.share * HULL_M, abs=0.3)
    assert fitted.camera is not None
    assert fitted.camera.height_m == pytest.approx(CAMERA.height_m, rel=0.06)
    # What is stated of the two holds.
    height = next(p for p in fitted.report.parameters if p.name == "height_m")
    assert abs(height.value - CAMERA.height_m) < 3.0 * height.sigma
    assert abs(source.bias_m + EDGE.share * HULL_M) < 3.0 * source.sigma_m


def test_boxes_that_teach_are_as_far_apart_as_their_errors_last(
    scene: Scene, association: Association
) -> None:
    (found,) = association.found
    assert found.taken.sum() > 4 * MOST_A_RECORDING
    pairs = recognised_correspondences(association, PLANE, scene)
    assert 0.5 * MOST_A_RECORDING < len(pairs) <= MOST_A_RECORDING
    apart_s = np.diff(pairs.boxes.time_utc_s)
    # A box may lie a quarter of a second from the middle of those that it stands for.
    assert apart_s.min() >= CORRELATION_TIME_S - 0.5
    # They are spread over all the time in which the vessel was seen.
    assert np.ptp(pairs.boxes.time_utc_s) > 0.95 * (found.last_utc_s - found.first_utc_s)


def thinned(scene: Scene, folder: Path, every: int) -> Scene:
    """The scene with fewer fixes in its log."""
    fixes = scene["one"].fixes()
    write_fixes(fixes[np.arange(0, len(fixes), every)], folder / "log.csv")
    write_boxes(detections(), folder / "seen.csv")
    text = scene.path.read_text("utf-8")
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return Scene.load(folder / "scene.toml")


@pytest.mark.slow
def test_a_vessel_is_recognised_by_a_log_of_a_fix_every_ten_seconds(
    scene: Scene, tmp_path: Path
) -> None:
    fitted = fit_scene(thinned(scene, tmp_path, 10), "camera", detector=None)
    assert fitted.camera is not None
    known = {one.name: one for one in fitted.report.parameters}
    assert known["heading_deg"].value == pytest.approx(CAMERA.heading_deg, abs=1.5)
    assert known["focal_px"].value == pytest.approx(CAMERA.focal_px, rel=0.08)
    # The boxes end as far below the water as nobody told, which looks like a higher camera.
    ranges = fitted.camera.height_m / CAMERA.height_m
    assert 0.9 < ranges < 1.4
    assert any("gaps of the log" in said for said in fitted.report.statements)


@pytest.mark.slow
def test_a_log_that_says_too_little_of_how_a_vessel_moves_is_named(
    scene: Scene, tmp_path: Path
) -> None:
    with pytest.raises(FitError, match="there is a fix every 60 s") as caught:
        fit_scene(thinned(scene, tmp_path, 60), "camera", detector=None)
    assert "\n" not in str(caught.value)
