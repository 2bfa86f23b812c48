"""Every reader that commands use, how it is called, and the examples that it is given spoilt."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from fuzz.containers import BYTES, GEOPACKAGE, MP4, ONNX, PARQUET, PICTURE, SAFETENSORS, STORE, TS
from fuzz.examples import FRAME_PX, TILES
from fuzz.texts import AIS, SENTENCES, TABLE, TEXT, TOML, XML, Mutator
from fuzz.trees import JSON, JSON_LINES
from sightline import formats, video
from sightline.cli import main
from sightline.clock import presentation_clock
from sightline.detection import DetectorOptions, detector_by_name
from sightline.errors import InputError
from sightline.fleet.config import read_fleet
from sightline.fleet.tasks import tasks_of
from sightline.formats.labels import empty_frames, read_labels
from sightline.formats.otanalytics import read_otflow
from sightline.formats.pasted_position import parse_position
from sightline.formats.picture_labels import (
    read_class_names,
    read_coco_labels,
    read_yolo_labels,
)
from sightline.formats.tiles import open_tiles
from sightline.geodesy import LocalPlane
from sightline.georeferencing.georeferencer import load_model
from sightline.labelling.box_table import BoxTable
from sightline.labelling.control_points import ControlPointSheet
from sightline.live.ais import AisMatcher
from sightline.live.config import read_live_config
from sightline.live.store import stored_tracks
from sightline.moment import Moment
from sightline.pipeline.sections import place_sections
from sightline.scene import Scene
from sightline.tally import Tally
from sightline.tracks import Tracks
from sightline.types import Boxes, Frame
from sightline.video.mask import read_mask

Read = Callable[[Path, Path], object]


@dataclass(frozen=True)
class Reader:
    """A reader, and what it is given.

    Attributes:
        name: In the table.
        read: Called with the spoilt file, and the folder of all unspoilt examples.
        examples: Names of its examples, from that folder.
        mutators: How these are spoilt.
        weight: How often it has its turn, beside others.
    """

    name: str
    read: Read
    examples: tuple[str, ...]
    mutators: tuple[Mutator, ...]
    weight: int = 2


def _tiles(path: Path, _: Path) -> None:
    """All tiles that the example has, one at a time, as a map asks for them."""
    tiles = open_tiles(path)
    refused = None
    for place in TILES:
        try:
            tiles.tile(*place)
        except InputError as error:
            refused = error
    tiles.close()
    if refused is not None:
        raise refused


def _fixes(path: Path, _: Path) -> None:
    formats.read_fixes(path)


def _feed(path: Path, _: Path) -> None:
    formats.holds_ais(path)
    formats.read_ais_feed(path)
    formats.read_fixes(path, mmsi=211000001)


def _receiver(path: Path, _: Path) -> None:
    """As from a receiver, line by line."""
    stream, matcher = formats.AisStream(Tally(path)), AisMatcher(LocalPlane(54.3, 10.1))
    for line in path.read_bytes().split(b"\n"):
        for report in stream.add(line.decode("latin-1"), 1_717_236_000.0):
            matcher.take(report)
    matcher.identify(Moment(1_717_236_010.0, "arrival", "quay", ()))


def _store(path: Path, _: Path) -> None:
    for track in stored_tracks(path):
        assert len(track)


def _live_config(path: Path, _: Path) -> None:
    read_live_config(path)


def _boxes(path: Path, _: Path) -> None:
    formats.read_boxes(path, source="somebody")
    for _chunk in formats.iter_boxes(path, 7, skip_empty=True):
        pass


def _sized_boxes(path: Path, _: Path) -> None:
    formats.read_boxes(path, image_size_px=(640, 360), skip_empty=True)


def _tracks(path: Path, _: Path) -> None:
    Tracks.read(path)


def _clock(path: Path, _: Path) -> None:
    clock = formats.read_clock(path)
    clock.sigma_s(clock.frame)
    clock.time_utc_s(clock.frame)


def _headings(path: Path, _: Path) -> None:
    formats.read_headings(path)


def _horizons(path: Path, _: Path) -> None:
    formats.read_horizons_csv(path, presentation_clock(1_717_236_000.0, np.arange(400) / 12.0))


def _levels(path: Path, _: Path) -> None:
    levels = formats.read_water_levels(path)
    levels.at(levels.time_utc_s)


def _points(path: Path, _: Path) -> None:
    formats.read_control_points(path)


def _labels(path: Path, _: Path) -> None:
    read_labels(path)


def _area(path: Path, _: Path) -> None:
    area = formats.read_area(path)
    area.contains(np.linspace(-90.0, 90.0, 50), np.linspace(-180.0, 180.0, 50))


def _lines(path: Path, _: Path) -> None:
    for line in formats.read_lines(path).values():
        assert np.isfinite(line.corners).all()


def _zones(path: Path, _: Path) -> None:
    for zone in formats.read_zones(path).values():
        zone.contains(np.linspace(-90.0, 90.0, 50), np.linspace(-180.0, 180.0, 50))


def _sections(path: Path, examples: Path) -> None:
    sections = read_otflow(path)
    place_sections(sections, load_model(examples / "camera-gpr.safetensors"), str(path))


def _drawn_boxes(path: Path, _: Path) -> None:
    """The table that the workbench writes to: what it does not change stays as it is."""
    BoxTable(path.with_name("scene.toml"), "01", path, (640, 360)).rows()


def _drawn_points(path: Path, examples: Path) -> None:
    for name in ("points.toml", "still/scene.toml"):
        shutil.copy(examples / name, path.with_name(Path(name).name))
    text = path.with_name("points.toml").read_text(encoding="utf-8")
    scene = path.with_name("scene.toml")
    scene.write_text(f'control_points = "{path.name}"\n' + text.split("[[")[0], encoding="utf-8")
    ControlPointSheet(scene).points()


def _pasted(path: Path, _: Path) -> None:
    """A line at a time: all are refused, or one is a place on the earth."""
    refused: InputError | None = None
    places = 0
    for line in path.read_text(encoding="utf-8", errors="surrogateescape").splitlines():
        try:
            latitude, longitude = parse_position(line)
        except InputError as error:
            refused = error
        else:
            assert abs(latitude) <= 90.0
            assert abs(longitude) <= 180.0
            places += 1
    if refused is not None and not places:
        raise refused


def _fleet(path: Path, examples: Path) -> None:
    """A fleet among the files that it names, up to the tasks that it makes."""
    home = path.parent / "home"
    shutil.copytree(examples, home)
    shutil.copy(path, home / path.name)
    fleet = read_fleet(home / path.name)
    assert fleet.files
    assert len(tasks_of(fleet)) == sum(len(camera.recordings) for camera in fleet.cameras)


def _mask(path: Path, _: Path) -> None:
    mask = read_mask(path)
    mask.hides(Boxes.of([[0.0, 0.0, 20.0, 10.0]]))


def _yolo(path: Path, _: Path) -> None:
    read_yolo_labels(path, ("boat", "sailboat")).in_pixels((640, 360))


def _coco(path: Path, _: Path) -> None:
    for labels in read_coco_labels(path).values():
        assert labels.size_px is not None
        labels.in_pixels(labels.size_px)


def _class_names(path: Path, _: Path) -> None:
    read_class_names(path)


def _empty_frames(path: Path, _: Path) -> None:
    empty_frames(path, "01")


def _scene(path: Path, examples: Path) -> None:
    """The scene among its own files, each of which is read as the verbs read it."""
    home = examples / "still"
    there = path.parent / "home" / "still"
    shutil.copytree(home, there)
    shutil.copytree(examples / "aboard", path.parent / "home" / "aboard")
    for name in ("levels.csv", "horizon.csv", "points.csv", "clip.mp4", "log.nmea"):
        shutil.copy(examples / name, path.parent / "home" / name)
    moving = b"platform" in path.read_bytes()
    scene_file = there.parent / "aboard" / "scene.toml" if moving else there / "scene.toml"
    shutil.copy(path, scene_file)
    scene = Scene.load(scene_file)
    _ = scene.plane, scene.moves, scene.tidal, scene.image_size_px
    for one in scene.recordings:
        asked: dict[Callable[[], object], object] = {
            one.boxes: one.boxes_path,
            one.detections: one.detections_path,
            one.fixes: one.fixes_path,
            one.logs: one.fixes_path,
            one.platform: one.platform_path,
            one.water_levels: one.water_levels_path,
            one.horizons: one.horizon_path,
            one.clock: one.clock_path,
            partial(next, one.frames(), None) if one.source else int: one.source,
        }
        for ask, named in asked.items():
            if named is not None:
                ask()


def _model(path: Path, _: Path) -> None:
    model = load_model(path)
    boxes = np.array([[100.0, 180.0, 120.0, 195.0], [0.0, 0.0, 640.0, 360.0], [5.0, 5.0, 6.0, 6.0]])
    model.locate(boxes)
    model.save(path.with_name("again.safetensors"))


def _detector(path: Path, _: Path) -> None:
    detector = detector_by_name(str(path), options=DetectorOptions(threads=1))
    image = np.full((FRAME_PX[1], FRAME_PX[0], 3), 120, dtype=np.uint8)
    detector.detect(Frame(0, 1_717_236_000.0, image))


def _video(path: Path, _: Path) -> None:
    info = video.video_info(path)
    count = 0
    for frame in video.frames(path, start_utc_s=1_717_236_000.0):
        count += frame.image_bgr.size > 0
    if not len(info.presentation_s) or not count:
        raise AssertionError("a video without a frame was not refused")


def _raw_video(path: Path, _: Path) -> None:
    """A stream without times of its own, by the times of a clock."""
    clock = presentation_clock(1_717_236_000.0, np.arange(50) / 10.0)
    for frame in video.frames(path, clock=clock):
        assert frame.image_bgr.size > 0


def _pictures(path: Path, examples: Path) -> None:
    folder = path.parent / "pictures"
    folder.mkdir()
    shutil.copy(path, folder / f"000001{path.suffix}")
    shutil.copy(examples / "picture-1.png", folder / "000002.png")
    video.image_size_px(folder)
    for frame in video.frames(folder):
        assert frame.image_bgr.dtype == np.uint8


def _run(*arguments: object) -> None:
    """A command, which may refuse its input and do nothing else."""
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            main([str(argument) for argument in arguments])
    except SystemExit as stopped:
        status = stopped.code
    line = said.getvalue().strip()
    if "not enough memory" in line:
        raise MemoryError(line)
    if status == 2 and line.splitlines()[-1].startswith("error: "):
        raise InputError(line)
    assert status == 0, f"exit status {status}: {line}"


def _track(path: Path, examples: Path) -> None:
    """Boxes to tracks in all formats, each of which must be whole and readable."""
    out = [path.with_name(f"out.{end}") for end in ("geojson", "csv", "gpx", "kml")]
    clock = examples / "still" / "clock" / "01.csv"
    model = examples / "camera-gpr.safetensors"
    _run("track", path, "--model", model, "--clock", clock, "-o", out[0], *out[1:])
    json.loads(out[0].read_text(encoding="utf-8"), parse_constant=_no_number)
    for file in out[2:]:
        ElementTree.fromstring(file.read_bytes())  # noqa: S314 - written by the project itself
    if json.loads(out[0].read_text(encoding="utf-8"))["features"]:
        for file in out[:3]:
            Tracks.read(file)


def _no_number(text: str) -> None:
    raise AssertionError(f"{text} is no JSON")


def _evaluate_tracks(path: Path, examples: Path) -> None:
    result = path.with_name("report.json")
    _run("evaluate", path, "--fixes", examples / "still" / "target.gpx", "--json", result)
    json.loads(result.read_text(encoding="utf-8"), parse_constant=_no_number)


def _evaluate_log(path: Path, examples: Path) -> None:
    _run("evaluate", examples / "tracks.geojson", "--fixes", path)


def _count(path: Path, examples: Path) -> None:
    """One of what is counted spoilt, and the others whole: the names tell which."""
    given = {name: examples / name for name in ("tracks.geojson", "lines.geojson", "zones.geojson")}
    given[path.name] = path
    tracks, lines, zones = given.values()
    made = [path.with_name(f"counts.{ending}") for ending in ("csv", "json")]
    where = ("--lines", lines, "--zones", zones, "--closest", 50, "--every", "1min")
    _run("count", tracks, *where, "-o", made[0], "-o", made[1])
    json.loads(made[1].read_text(encoding="utf-8"), parse_constant=_no_number)
    with made[0].open(encoding="utf-8", newline="") as file:
        widths = {len(row) for row in csv.reader(file)}
    assert len(widths) == 1, f"rows of {widths} cells"


def _export(path: Path, _: Path) -> None:
    """What live kept, to all texts, each of which must be whole."""
    made = {end: path.with_name(f"out.{end}") for end in ("mfjson", "geojson", "csv", "gpx", "kml")}
    _run("export", path, *(text for file in made.values() for text in ("-o", file)))
    for end in ("mfjson", "geojson"):
        json.loads(made[end].read_text(encoding="utf-8"), parse_constant=_no_number)
    for end in ("gpx", "kml"):
        ElementTree.fromstring(made[end].read_bytes())  # noqa: S314 - written by the project itself


def _live(path: Path, examples: Path) -> None:
    """All that live opens before it watches, of a recording that it plays."""
    for name in ("played.mp4", "camera-gpr.safetensors", "water.geojson", "clock.csv"):
        shutil.copy(examples / name, path.parent)
    # Names in the file are told from where the command is given.
    os.chdir(path.parent)
    _run("live", "--config", path.name, "--check")


def _detect(path: Path, _: Path) -> None:
    _run("detect", path, "--detector", "motion", "-o", path.with_name("found.csv"))


def _check(path: Path, _: Path) -> None:
    result = path.with_name("check.json")
    try:
        _run("check", path, "--json", result)
    finally:
        if result.exists():
            json.loads(result.read_text(encoding="utf-8"), parse_constant=_no_number)


def _fit(path: Path, _: Path) -> None:
    _run("fit", path, "-o", path.with_name("made.safetensors"))


_VIDEOS = ("clip.mp4", "clip.mov", "clip.mkv", "clip.avi", "clip.webm", "clip.ts")
_OF_ALL_KINDS = (
    *("still/target.gpx", "log.nmea", "feed.nmea", "log.csv", "still/boxes/01.csv", "boxes.txt"),
    *("clock.csv", "levels.csv", "points.csv", "points.otrfpts", "tracks.geojson", "tracks.csv"),
)
_PICTURES = tuple(f"picture-0.{ending}" for ending in ("jpg", "png", "tif", "webp", "bmp"))
_MODELS = tuple(f"{name}.safetensors" for name in ("camera-gpr", "qkr-gpr", "nn", "qkr"))

READERS: tuple[Reader, ...] = (
    Reader("log: GPX", _fixes, ("still/target.gpx",), XML, 4),
    Reader("log: NMEA 0183", _fixes, ("log.nmea",), SENTENCES, 4),
    Reader("log: AIS", _feed, ("feed.nmea", "one.nmea"), AIS, 4),
    Reader("AIS receiver", _receiver, ("feed.nmea", "one.nmea"), AIS),
    Reader("live: configuration", _live_config, ("live.toml",), TOML),
    Reader("live: store", _store, ("live.db",), STORE),
    Reader("map: MBTiles", _tiles, ("map.mbtiles",), STORE),
    Reader("map: PMTiles", _tiles, ("map.pmtiles",), BYTES),
    Reader("log: KML, TCX", _fixes, ("track.kml", "marks.kml", "log.tcx"), XML, 3),
    Reader("log: CSV", _fixes, ("log.csv", "german.csv", "ublox.csv"), TABLE, 3),
    Reader("log: CSV of AIS", _feed, ("ais.csv", "danish.csv"), TABLE, 3),
    Reader("log: JSON lines", _fixes, ("gpsd.json", "signalk.json"), JSON_LINES, 3),
    Reader("log: JSON", _fixes, ("list.json", "records.json"), JSON, 2),
    Reader("log: GeoJSON", _fixes, ("log.geojson",), JSON),
    Reader("boxes: centres", _sized_boxes, ("yolo.txt", "xywh.csv"), TABLE),
    Reader("boxes: CSV", _boxes, ("still/boxes/01.csv", "still/detections/01.csv"), TABLE, 4),
    Reader("boxes: MOTChallenge", _boxes, ("boxes.txt",), TABLE, 3),
    Reader("boxes: OTVision", _boxes, ("tracks.ottrk",), JSON, 2),
    Reader("tracks: GeoJSON", _tracks, ("tracks.geojson",), JSON, 4),
    Reader("tracks: GPX", _tracks, ("tracks.gpx",), XML),
    Reader("tracks: CSV", _tracks, ("tracks.csv",), TABLE, 3),
    Reader("tracks: Parquet", _tracks, ("tracks.parquet",), PARQUET, 3),
    Reader("tracks: GeoPackage", _tracks, ("tracks.gpkg",), GEOPACKAGE, 3),
    Reader("clock", _clock, ("clock.csv", "stepped.csv"), TABLE, 3),
    Reader("headings: CSV", _headings, ("aboard/platform.csv",), TABLE),
    Reader("headings: NMEA 0183", _headings, ("log.nmea",), SENTENCES, 3),
    Reader("horizons", _horizons, ("horizon.csv",), TABLE),
    Reader("water levels", _levels, ("levels.csv",), TABLE),
    Reader("control points: CSV", _points, ("points.csv",), TABLE),
    Reader("control points: OTVision", _points, ("points.otrfpts",), JSON),
    Reader("labels", _labels, ("labels.csv",), TABLE),
    Reader("labels: empty frames", _empty_frames, ("empty.csv",), TABLE, 1),
    Reader("labels: YOLO", _yolo, ("picture.txt",), TABLE),
    Reader("labels: COCO", _coco, ("coco.json",), JSON),
    Reader("labels: names of classes", _class_names, ("data.yaml", "classes.txt"), TEXT, 1),
    Reader("draw: boxes", _drawn_boxes, ("still/boxes/01.csv",), TABLE, 2),
    Reader("draw: control points", _drawn_points, ("points.csv",), TABLE, 2),
    Reader("draw: pasted positions", _pasted, ("pasted.txt",), TEXT, 2),
    Reader("batch: fleet", _fleet, ("fleet.toml",), TOML, 2),
    Reader("area", _area, ("water.geojson",), JSON, 3),
    Reader("lines", _lines, ("lines.geojson",), JSON, 2),
    Reader("zones", _zones, ("zones.geojson",), JSON, 2),
    Reader("sections: OTAnalytics", _sections, ("sections.otflow",), JSON, 2),
    Reader("mask", _mask, ("mask.png",), PICTURE),
    Reader("scene", _scene, ("still/scene.toml", "aboard/scene.toml", "points.toml"), TOML, 5),
    Reader("model", _model, _MODELS, SAFETENSORS, 4),
    Reader("detector: ONNX", _detector, ("constant.onnx", "looks.onnx"), ONNX, 4),
    Reader("video: MP4, MOV", _video, _VIDEOS[:2], MP4, 4),
    Reader("video: other", _video, _VIDEOS[2:5], BYTES, 4),
    Reader("video: MPEG-TS", _video, ("clip.ts",), TS, 3),
    Reader("video: raw", _raw_video, ("clip.h264", "clip.mjpeg"), BYTES, 2),
    Reader("pictures", _pictures, _PICTURES, PICTURE, 5),
    Reader("command: track", _track, ("still/detections/01.csv",), TABLE, 3),
    Reader("command: track, MOT", _track, ("boxes.txt",), TABLE, 1),
    Reader("command: evaluate, tracks", _evaluate_tracks, ("tracks.geojson",), JSON, 3),
    Reader("command: evaluate, log", _evaluate_log, ("still/target.gpx", "log.csv"), TEXT, 2),
    Reader("command: count", _count, ("lines.geojson", "zones.geojson", "tracks.geojson"), JSON),
    Reader("command: export", _export, ("live.db",), STORE),
    Reader("command: live", _live, ("played.toml",), TOML),
    Reader("command: detect", _detect, _VIDEOS[:3], BYTES, 2),
    Reader("command: check, texts", _check, _OF_ALL_KINDS, TABLE, 3),
    Reader("command: check, videos", _check, _VIDEOS, BYTES, 1),
    Reader("command: fit", _fit, ("points.toml",), TOML, 2),
)
"""All of them."""


def reader_by_name(name: str) -> Reader:
    """A reader, by its name in the table."""
    for reader in READERS:
        if reader.name == name:
            return reader
    raise SystemExit(f"unknown reader {name!r}; known are {', '.join(r.name for r in READERS)}")
