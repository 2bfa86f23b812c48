"""Where targets can be, and what is masked: left out of boxes, tracks and pictures, and counted."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import sightline
import sightline.cli
from sightline import formats
from sightline.area import Area, Polygon
from sightline.detection import DetectorOptions
from sightline.errors import InputError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.labelling.expected import Expected
from sightline.labelling.proposals import Proposals
from sightline.labelling.sheets import contact_sheets
from sightline.pipeline.check import check
from sightline.pipeline.run import _track_each
from sightline.pipeline.track import BOXES_OUTSIDE, TRACKS_OUTSIDE, TrackSettings
from sightline.scene import Scene
from sightline.scene.detections import SceneDetections
from sightline.scene.scene import MASKED
from sightline.simulation.simulate import SimulationSettings, simulate
from sightline.tally import Tally
from sightline.types import Boxes, Frame, Track

SIZE_PX = (640, 360)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("area") / "harbour"
    simulate(
        folder,
        SimulationSettings(
            video=False, recordings=2, duration_s=40.0, seed=3, image_size_px=SIZE_PX
        ),
    )
    sightline.fit(Scene.load(folder / "scene.toml"), "camera").save(folder / "model.safetensors")
    return folder


@pytest.fixture
def harbour(made: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "harbour"
    shutil.copytree(made, folder)
    return folder


@pytest.fixture(scope="module")
def model(made: Path) -> Georeferencer:
    return sightline.load(made / "model.safetensors")


def box_around(west: float, south: float, east: float, north: float) -> Area:
    corners = [(west, south), (east, south), (east, north), (west, north)]
    return Area((Polygon((np.array(corners),)),))


def around_log(harbour: Path, *, metres: float = 40.0) -> tuple[float, float, float, float]:
    """West, south, east and north of the logged target's path, and somewhat more."""
    log = formats.read_fixes(harbour / "target.gpx")
    recording = Scene.load(harbour / "scene.toml")["01"].detections().time_utc_s
    now = (log.time_utc_s >= recording.min()) & (log.time_utc_s <= recording.max())
    latitude, longitude = log.latitude_deg[now], log.longitude_deg[now]
    up = metres / 111_000.0
    side = up / np.cos(np.radians(latitude.mean()))
    return (
        longitude.min() - side,
        latitude.min() - up,
        longitude.max() + side,
        latitude.max() + up,
    )


def write_area(path: Path, west: float, south: float, east: float, north: float) -> Path:
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    return path


def share_inside(track: Track, edges: tuple[float, float, float, float]) -> float:
    west, south, east, north = edges
    x, y = track.longitude_deg, track.latitude_deg
    return float(((x > west) & (x < east) & (y > south) & (y < north)).mean())


def numbered(boxes: Boxes) -> Boxes:
    """Boxes with an id for each column of 80 px: what crosses it is one target."""
    middle = boxes.xyxy_px[:, [0, 2]].mean(axis=1)
    return boxes.with_columns(track_id=(middle // 80).astype(np.int64) + 1)


@pytest.mark.parametrize("ids", [False, True], ids=["boxes", "boxes with ids"])
def test_what_lies_outside_of_the_area_is_left_out_and_counted(
    harbour: Path, model: Georeferencer, ids: bool
) -> None:
    boxes = Scene.load(harbour / "scene.toml")["01"].detections()
    boxes = numbered(boxes) if ids else boxes
    edges = around_log(harbour)
    tally = Tally("x")
    anywhere = sightline.track(boxes, model)
    there = sightline.track(
        boxes, model, settings=TrackSettings(area=box_around(*edges), tally=tally)
    )
    assert len(anywhere) > len(there) >= 1
    assert min(share_inside(track, edges) for track in anywhere) < 0.5
    assert min(share_inside(track, edges) for track in there) >= 0.5
    # Counted apart: the box around the log is level with longitude and latitude.
    west, south, east, north = edges
    where = model.locate(boxes.xyxy_px, source=str(boxes.source[0]))
    x, y = where.longitude_deg, where.latitude_deg
    outside = where.known & ~((x > west) & (x < east) & (y > south) & (y < north))
    rows = np.ones(len(boxes), bool) if not ids else boxes.track_id > 0
    assert tally.left_out[BOXES_OUTSIDE].count == int((outside & rows).sum())


class Listens:
    """A tracker that keeps what it is given."""

    def __init__(self) -> None:
        self.given: list[Boxes] = []

    def update(self, boxes: Boxes) -> Boxes:
        self.given.append(boxes)
        return boxes.with_columns(track_id=np.ones(len(boxes), dtype=np.int64))

    def reset(self) -> None:
        self.given = []


def test_a_tracker_is_given_nothing_that_lies_outside(harbour: Path, model: Georeferencer) -> None:
    boxes = Scene.load(harbour / "scene.toml")["01"].detections()
    west, south, east, north = around_log(harbour)
    listens = Listens()
    settings = TrackSettings(area=box_around(west, south, east, north), tracker=listens)
    sightline.track(boxes, model, settings=settings)
    given = Boxes.concatenate([Boxes.of(one.xyxy_px) for one in listens.given])
    where = model.locate(given.xyxy_px, source=str(boxes.source[0]))
    x, y = where.longitude_deg[where.known], where.latitude_deg[where.known]
    assert 0 < len(given) < len(boxes)
    assert ((x > west) & (x < east) & (y > south) & (y < north)).all()


def test_what_is_left_out_is_counted_once_where_a_recording_is_judged_by_another_model(
    harbour: Path, model: Georeferencer
) -> None:
    without_drawn(harbour, "01")
    scene = Scene.load(harbour / "scene.toml").select(["01"])
    tally = Tally("x")
    settings = TrackSettings(area=box_around(*around_log(harbour)), tally=tally)
    again = sightline.load(harbour / "model.safetensors")
    seen = SceneDetections(scene, None)
    counts = []
    for models in ({}, {"01": again}):
        tally.left_out.clear()
        _track_each(scene, scene, model, models, seen, settings, lambda _what, _share: None)
        counts.append(tally.left_out[BOXES_OUTSIDE].count)
    assert counts[0] == counts[1] > 0


@pytest.mark.parametrize("tracker", [None, sightline.tracking.ImageTracker])
def test_an_area_that_holds_all_changes_nothing(
    harbour: Path, model: Georeferencer, tracker: Callable | None
) -> None:
    boxes = Scene.load(harbour / "scene.toml")["01"].detections()
    tally = Tally("x")
    settings = TrackSettings(tracker=tracker)
    plain = sightline.track(boxes, model, settings=settings)
    held = replace(settings, area=box_around(-180.0, -90.0, 180.0, 90.0), tally=tally)
    same = sightline.track(boxes, model, settings=held)
    assert len(plain) == len(same) > 1
    for one, other in zip(plain, same, strict=True):
        np.testing.assert_array_equal(one.east_m, other.east_m)
    assert tally.left_out == {}


def test_a_track_that_leaves_the_area_in_a_gap_is_left_out() -> None:
    """Whatever made it: its points lie outside for the most part."""
    from sightline.geodesy import LocalPlane
    from sightline.pipeline.track import _lies_in

    n = 10
    track = Track(
        track_id=1,
        time_utc_s=np.arange(n, dtype=float),
        east_m=100.0 * np.arange(n),
        north_m=np.zeros(n),
        velocity_east_mps=np.ones(n),
        velocity_north_mps=np.zeros(n),
        covariance_m2=np.tile(np.eye(2), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(np.eye(2), (n, 1, 1)),
        kind=np.zeros(n, dtype=np.int8),
        plane=LocalPlane(54.0, 10.0),
    )
    tally = Tally("x")
    # Five of ten points, and then four.
    metre = 1.0 / (111_320.0 * np.cos(np.radians(54.0)))
    for east_m, lies in ((450.0, True), (350.0, False)):
        area = box_around(9.9, 53.9, 10.0 + east_m * metre, 54.1)
        assert _lies_in(track, TrackSettings(area=area, tally=tally)) is lies
    assert tally.left_out[TRACKS_OUTSIDE].count == 1


def add_to_camera(harbour: Path, line: str) -> Path:
    scene = harbour / "scene.toml"
    text = scene.read_text()
    assert "[camera]\n" in text
    scene.write_text(text.replace("[camera]\n", f"[camera]\n{line}\n"))
    return scene


def without_drawn(harbour: Path, name: str) -> None:
    scene = harbour / "scene.toml"
    text = scene.read_text()
    assert f'boxes = "boxes/{name}.csv"\n' in text
    scene.write_text(text.replace(f'boxes = "boxes/{name}.csv"\n', ""))


def test_a_run_keeps_what_lies_in_the_area_of_its_scene(harbour: Path) -> None:
    without_drawn(harbour, "01")
    plain = sightline.run(Scene.load(harbour / "scene.toml"), model="camera")
    edges = around_log(harbour)
    write_area(harbour / "water.geojson", *edges)
    scene = Scene.load(add_to_camera(harbour, 'area = "water.geojson"'))
    assert harbour / "water.geojson" in scene.files
    result = sightline.run(scene, model="camera")
    assert 1 <= len(result.tracks["01"]) < len(plain.tracks["01"])
    assert all(share_inside(track, edges) >= 0.5 for track in result.tracks["01"])
    left = result.left_out_of_area[BOXES_OUTSIDE]
    assert left > 0
    assert any(f"Left out: {left} boxes outside of the area" in note for note in result.notes)
    assert plain.left_out_of_area == {}
    # Boxes that somebody drew are those of the target, wherever it was.
    assert len(result.tracks["02"]) == len(plain.tracks["02"]) == 1


def mask_of(path: Path, *, left: int, size: tuple[int, int] = SIZE_PX) -> Path:
    image = np.full((size[1], size[0]), 255, np.uint8)
    image[:, :left] = 0
    cv2.imwrite(str(path), image)
    return path


def test_detections_of_a_table_that_are_masked_are_left_out(harbour: Path) -> None:
    without_drawn(harbour, "01")
    before = Scene.load(harbour / "scene.toml")["01"].detections()
    mask_of(harbour / "mask.png", left=320)
    scene = Scene.load(add_to_camera(harbour, 'mask = "mask.png"'))
    kept = scene["01"].detections()
    seen = np.clip(before.xyxy_px[:, [0, 2]], 0.0, 640.0)
    first, last = np.floor(seen[:, 0]), np.ceil(seen[:, 1])
    hidden = np.clip(320.0 - first, 0.0, last - first) >= 0.5 * (last - first)
    assert 0 < hidden.sum() < len(before)
    np.testing.assert_array_equal(kept.xyxy_px, before.xyxy_px[~hidden])
    result = sightline.run(scene, model="camera")
    assert result.left_out_of_area == {MASKED: int(hidden.sum())}


class Sees:
    """A detector of red things, which says what it was shown."""

    name = "red"

    def __init__(self) -> None:
        self.shown: list[np.ndarray] = []

    def reset(self) -> None:
        self.shown = []

    def detect(self, frame: Frame) -> Boxes:
        self.shown.append(frame.image_bgr)
        boxes = [[300.0, 200.0, 330.0, 215.0], [340.0, 200.0, 370.0, 215.0]]
        return Boxes.of(
            boxes, frame=frame.index, time_utc_s=frame.time_utc_s, confidence=0.9, source="red"
        )


RED = (10, 10, 240)


@pytest.fixture
def filmed(harbour: Path) -> Path:
    """Pictures of the first recording, red in what is masked."""
    without_drawn(harbour, "01")
    (harbour / "frames").mkdir()
    times = Scene.load(harbour / "scene.toml")["01"].detections().time_utc_s
    for index in range(5):
        image = np.full((SIZE_PX[1], SIZE_PX[0], 3), 120, np.uint8)
        image[:, :320] = RED
        cv2.imwrite(str(harbour / "frames" / f"{index}.png"), image)
    rows = "".join(f"{i},{times.min() + 0.2 * i}\n" for i in range(5))
    (harbour / "frames.csv").write_text("frame,utc\n" + rows)
    scene = harbour / "scene.toml"
    text = scene.read_text().replace('detections = "detections/01.csv"', 'frames = "frames"')
    scene.write_text(text.replace('clock = "clock/01.csv"', 'clock = "frames.csv"'))
    mask_of(harbour / "mask.png", left=320)
    return add_to_camera(harbour, 'mask = "mask.png"')


def is_red(image: np.ndarray) -> np.ndarray:
    return (image[..., 2].astype(int) - image[..., 1] > 60) & (image[..., 2] > 150)


def test_a_detector_never_sees_what_is_masked_and_nothing_there_is_kept(filmed: Path) -> None:
    detector = Sees()
    scene = Scene.load(filmed)
    seen = SceneDetections(scene, detector, stills=True)
    boxes = seen.boxes(scene["01"])
    assert boxes.xyxy_px[:, 0].tolist() == [340.0] * 5
    assert seen.tally.left_out[MASKED].count == 5
    assert len(detector.shown) == 5
    for image in detector.shown:
        assert not is_red(image).any()
        assert (image[:, :320] == 114).all()
        assert (image[:, 320:] == 120).all()
    assert np.ptp(seen.still(scene["01"])) <= 6


def test_contact_sheets_show_nothing_that_is_masked(filmed: Path, tmp_path: Path) -> None:
    n = 5
    boxes = np.tile([310.0, 200.0, 340.0, 215.0], (n, 1))
    expected = Expected(boxes, np.ones((n, 2)), np.full(n, 100.0), np.zeros(n, dtype=bool))
    proposals = Proposals(
        recording="01",
        frame=np.arange(n),
        time_utc_s=np.arange(n, dtype=float),
        expected=expected,
        xyxy_px=boxes,
        confidence=np.full(n, 0.9),
        reason=np.full(n, "", dtype="<U1"),
    )
    (page,) = contact_sheets(proposals, Scene.load(filmed)["01"], tmp_path)
    assert not is_red(cv2.imread(str(page))).any()


def test_a_source_is_masked_as_well(filmed: Path, model: Georeferencer) -> None:
    detector, tally = Sees(), Tally("x")
    sightline.track(
        filmed.parent / "frames",
        model,
        detector=detector,
        clock=formats.read_clock(filmed.parent / "frames.csv"),
        mask=filmed.parent / "mask.png",
        settings=TrackSettings(tally=tally),
    )
    assert len(detector.shown) == 5
    assert not any(is_red(image).any() for image in detector.shown)
    assert tally.left_out[MASKED].count == 5


def test_a_scene_says_how_its_frames_are_looked_at(filmed: Path) -> None:
    """One word, and the network that ships is shown more tiles of each frame."""
    text = filmed.read_text()
    plain = Scene.load(filmed)
    assert plain.looking == DetectorOptions()
    filmed.write_text(f'[detection]\nviews = "everywhere"\nenlarge = 2\n{text}')
    scene = Scene.load(filmed)
    made = SceneDetections(scene, "harbour")._made("harbour")
    usual = SceneDetections(plain, "harbour")._made("harbour")
    frame = next(plain["01"].frames())
    assert max(tile.scale for tile in usual.views(frame)) == 1.0
    assert max(tile.scale for tile in made.views(frame)) == 2.0
    # What moves is found without a network, and so without tiles.
    assert SceneDetections(scene, "motion")._made("motion").name == "motion"
    over = DetectorOptions(enlarge=1.0, threshold=0.5).over(scene.looking)
    assert (over.enlarge, over.threshold, over.views) == (1.0, 0.5, scene.looking.views)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('views = "all"', r"scene.toml: detection: unknown kind of views 'all'; known are strip"),
        ("enlarge = 0.0", r"scene.toml: detection: views: enlarge is 0; it must be more than 0"),
        ("budget_ms = -1.0", r"scene.toml: detection: budget is -1 ms; give the milliseconds"),
        ("frame_width_px = 0", r"scene.toml: detection.frame_width_px: "),
        ("tiles = 3", r"unknown key detection.tiles; known are views, enlarge"),
    ],
)
def test_a_scene_that_looks_in_no_known_way_is_refused(
    harbour: Path, line: str, message: str
) -> None:
    scene = harbour / "scene.toml"
    scene.write_text(f"[detection]\n{line}\n{scene.read_text()}")
    with pytest.raises(InputError, match=message):
        Scene.load(scene)


def test_a_check_describes_mask_and_area(filmed: Path) -> None:
    write_area(filmed.parent / "water.geojson", 10.0, 54.0, 10.3, 54.5)
    add_to_camera(filmed.parent, 'area = ["water.geojson"]')
    lines = "\n".join(check(filmed).lines())
    assert "mask.png: 50.0 % of the picture is masked" in lines
    assert "water.geojson: 1 polygon of 4 corners" in lines
    assert "polygon of 4 corners" in "\n".join(check(filmed.parent / "water.geojson").lines())


def test_a_check_warns_of_an_area_without_the_log_and_a_mask_that_masks_nothing(
    filmed: Path,
) -> None:
    write_area(filmed.parent / "water.geojson", -10.0, 54.0, -9.0, 54.5)
    add_to_camera(filmed.parent, 'area = "water.geojson"')
    mask_of(filmed.parent / "mask.png", left=0)
    warnings = "\n".join(check(filmed).warnings)
    assert "recording 01: 100 % of the fixes of its log lie outside of the area" in warnings
    assert "mask.png: masks nothing; paint black" in warnings


PROBLEMS = [
    ('mask = "small.png"', r"small.png: has 320 x 360 px, and the pictures of .* 640 x 360 px"),
    ('mask = "grey.png"', r"grey.png: is no mask: 100 % of it is neither black nor white"),
    ('mask = "none.png"', r"camera.mask names .*none.png, which does not exist"),
    ('mask = "frames"', r"camera.mask names .*frames, which is a folder"),
    ('area = "crossed.geojson"', r"crossed.geojson: polygon 1: its edges cross at longitude 10\."),
    ('area = ["crossed.geojson"]', r"crossed.geojson: polygon 1: its edges cross"),
    ('area = "beyond.geojson"', r"beyond.geojson: polygon 1: .* not on the earth"),
    ('area = "empty.geojson"', r"empty.geojson: is empty"),
    ('area = "none.geojson"', r"camera.area names .*none.geojson, which does not exist"),
    ("area = []", r"camera.area: give a GeoJSON file of polygons, or a list of such files"),
    ('area = ""', r"camera.area: give a GeoJSON file of polygons"),
    ("area = 7", r"camera.area: .*; it is 7"),
    ("mask = true", r"camera.mask: .*"),
]


@pytest.mark.parametrize(("line", "message"), PROBLEMS)
def test_masks_and_areas_that_cannot_be_used_are_problems_and_refused(
    filmed: Path, line: str, message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = filmed.parent
    mask_of(folder / "small.png", left=10, size=(320, 360))
    cv2.imwrite(str(folder / "grey.png"), np.full((360, 640), 128, np.uint8))
    crossed = [[10.0, 54.0], [10.2, 54.1], [10.2, 54.0], [10.0, 54.1], [10.0, 54.0]]
    beyond = [[10.0, 54.0], [190.2, 54.1], [10.2, 54.2], [10.0, 54.0]]
    for name, ring in (("crossed", crossed), ("beyond", beyond)):
        content = {"type": "Polygon", "coordinates": [ring]}
        (folder / f"{name}.geojson").write_text(json.dumps(content))
    (folder / "empty.geojson").write_text("")
    filmed.write_text(filmed.read_text().replace('mask = "mask.png"\n', ""))
    add_to_camera(folder, line)
    (problem,) = check(filmed).problems
    assert problem.count("\n") == 0

    assert re.search(message, problem), problem
    with pytest.raises(SystemExit) as stopped:
        sightline.cli.main(["run", str(filmed), "-o", str(folder / "out")])
    assert stopped.value.code == 2
    errors = [one for one in capfd.readouterr().err.splitlines() if one.startswith("error: ")]
    assert len(errors) == 1
    assert re.search(message, errors[0]), errors
