"""Unspoilt examples of every format that is read, small, and made by the project itself."""

from __future__ import annotations

import io
import json
import re
import shutil
import sqlite3
import struct
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path

import av
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from PIL import Image

from sightline import formats
from sightline.formats import read_tracks
from sightline.formats.labels import Labels, write_labels
from sightline.formats.tiles import tile_number
from sightline.geodesy import LocalPlane
from sightline.live.state import SmoothedPart
from sightline.live.store import Store
from sightline.moment import Moment, TargetState
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.simulation.simulate import SimulationSettings, simulate
from sightline.types import Fixes, PointKind, Track, rfc3339

SIZE_PX = (640, 360)
"""Of the simulated pictures."""

FRAME_PX = (64, 48)
"""Of the pictures in the videos and in the folder."""

_START_UTC_S = 1_717_236_000.0
_VIDEOS = {
    "clip.mp4": ("mp4", "libx264"),
    "clip.mov": ("mov", "mpeg4"),
    "clip.mkv": ("matroska", "libx264"),
    "clip.avi": ("avi", "mpeg4"),
    "clip.ts": ("mpegts", "libx264"),
    "clip.mjpeg": ("mjpeg", "mjpeg"),
    "clip.webm": ("webm", "libvpx"),
    "clip.h264": ("h264", "libx264"),
}
# Without a number that is drawn anew each time.
_SAME = {"fflags": "+bitexact"}
_PICTURES = {"jpg": "JPEG", "png": "PNG", "tif": "TIFF", "webp": "WEBP", "bmp": "BMP"}
_CITY = """\
$GPRMC,100000.00,A,5419.39800,N,01008.36400,E,10.20,081.6,010624,,,A*{}
$GPGGA,100000.00,5419.39800,N,01008.36400,E,1,08,1.0,2.1,M,44.0,M,,*{}
$GPZDA,100000.00,01,06,2024,00,00*{}
$HEHDT,081.2,T*{}
$GPTHS,081.3,A*{}
$GPVTG,081.6,T,,M,10.20,N,18.9,K,A*{}
"""


def make_examples(folder: Path) -> None:
    """Write all examples; the same every time with the same libraries.

    Args:
        folder: Where to; made if it is not there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _harbour(folder)
    _logs(folder)
    _tables(folder)
    _tracks(folder)
    _models(folder)
    _scenes(folder)
    _detectors(folder)
    _videos(folder)
    _pictures(folder)
    _picture_labels(folder)
    _areas(folder)
    _live(folder)
    _tiles(folder)
    _foreign(folder)


def _harbour(folder: Path) -> None:
    for name, moving in (("still", False), ("aboard", True)):
        made = folder / name
        simulate(
            made,
            SimulationSettings(
                video=False,
                recordings=1 if moving else 2,
                duration_s=12.0,
                seed=1,
                image_size_px=SIZE_PX,
                moving=moving,
            ),
        )
        for path in sorted(made.glob("truth*")):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        for path in made.glob("detections/*.csv"):
            _cut(path, 41)
        for path in made.glob("horizon/*.csv"):
            path.rename(folder / "horizon.csv")


def _scenes(folder: Path) -> None:
    """The scene of each harbour with what else may stand in one, and one of control points."""
    still = folder / "still" / "scene.toml"
    text = still.read_text(encoding="utf-8")
    for number, key in (("01", "water_level_m = 0.4"), ("02", 'water_levels = "../levels.csv"')):
        boxes = f'boxes = "boxes/{number}.csv"'
        text = text.replace(boxes, f"{key}\n{boxes}")
    still.write_text(text, encoding="utf-8")
    aboard = folder / "aboard" / "scene.toml"
    text = aboard.read_text(encoding="utf-8").replace("horizon/01.csv", "../horizon.csv")
    aboard.write_text(text, encoding="utf-8")
    (folder / "points.toml").write_text(
        "[camera]\nlatitude_deg = 54.3233\nlongitude_deg = 10.1394\nimage_size_px = [640, 360]\n"
        + "".join(
            f"\n[[control_points]]\npixel_px = [{x}, {y}]\nlatitude_deg = {latitude}\n"
            f"longitude_deg = {longitude}\n"
            for x, y, latitude, longitude in _points()
        ),
        encoding="utf-8",
    )


def _cut(path: Path, lines: int) -> None:
    text = path.read_text(encoding="utf-8").splitlines(keepends=True)
    path.write_text("".join(text[:lines]), encoding="utf-8")


def _points() -> list[tuple[float, float, float, float]]:
    """Pixels and places as a camera 7 m above the water, 500 px long, facing north sees them."""
    out = []
    for x, y in ((100, 250), (320, 260), (500, 240), (200, 300), (450, 320), (600, 280)):
        north_m = 7.0 * 500.0 / (y - 200.0)
        east_m = (x - 320.0) / 500.0 * north_m
        latitude, longitude = LocalPlane(54.3233, 10.1394).to_geographic([east_m], [north_m])
        out.append((float(x), float(y), float(latitude[0]), float(longitude[0])))
    return out


def with_checksum(sentence: str) -> str:
    """A sentence of NMEA 0183 up to its asterisk, with the checksum after it."""
    body = sentence[1:].split("*")[0]
    total = 0
    for byte in body.encode("utf-8", "surrogateescape"):
        total ^= byte
    return f"{sentence[0]}{body}*{total:02X}"


def _logs(folder: Path) -> None:
    fixes = formats.read_fixes(folder / "still" / "target.gpx")
    formats.write_fixes(fixes[:20], folder / "log.csv")
    lines = []
    for second in range(20):
        time = f"{100000 + second:06d}.00"
        for line in _CITY.splitlines():
            moved = line.replace("100000.00", time).replace("39800", f"{39800 + 30 * second:05d}")
            lines.append(with_checksum(moved))
    (folder / "log.nmea").write_text("\r\n".join(lines) + "\r\n", encoding="ascii")
    from pyais import encode_dict

    static = {
        "type": 5,
        "mmsi": 211000001,
        "shipname": "HARBOUR LAUNCH",
        "callsign": "DABC",
        "to_bow": 8,
        "to_stern": 4,
        "to_port": 2,
        "to_starboard": 2,
        "destination": "KIEL",
    }
    reports = (folder / "still" / "ais.nmea").read_text(encoding="ascii").splitlines()
    parts = [f"\\s:sightline,c:1717236001\\{line}" for line in encode_dict(static)]
    (folder / "feed.nmea").write_text(
        "\n".join([*reports[:10], *parts, *reports[10:]]) + "\n", encoding="ascii"
    )
    own = [
        encode_dict(
            {
                "type": 1,
                "mmsi": 211000001,
                "lat": 54.3243 + 1e-5 * second,
                "lon": 10.1381,
                "speed": 9.0,
                "course": 81.0,
                "second": second,
            }
        )[0]
        for second in range(0, 40, 4)
    ]
    (folder / "one.nmea").write_text(
        "".join(
            f"2024-06-01T10:00:{4 * i:02d}.120Z {sentence}\n" for i, sentence in enumerate(own)
        ),
        encoding="ascii",
    )

    _json_logs(folder, fixes[:20])


def _json_logs(folder: Path, fixes: Fixes) -> None:
    """The same log of gpsd, of Signal K, as GeoJSON, and as reports of two vessels."""
    stamps = [rfc3339(time_s) for time_s in fixes.time_utc_s.tolist()]
    rows = list(zip(stamps, fixes.latitude_deg.tolist(), fixes.longitude_deg.tolist(), strict=True))
    gpsd: list[object] = [{"class": "VERSION", "release": "3.25"}]
    deltas: list[object] = [{"self": "vessels.urn:mrn:imo:mmsi:211000001", "version": "1.0"}]
    ais = ["MMSI,BaseDateTime,LAT,LON,SOG,COG,VesselName"]
    danish = ["# Timestamp,Type of mobile,MMSI,Latitude,Longitude,SOG,COG"]
    for i, (when, north, east) in enumerate(rows):
        device = f"/dev/ttyACM{i % 2}"
        told = {"class": "TPV", "device": device, "mode": 3, "time": when}
        gpsd.append({**told, "lat": north, "lon": east})
        place = {"latitude": north, "longitude": east}
        value = {"path": "navigation.position", "value": place}
        update = {"$source": "gps.GP", "timestamp": when, "values": [value]}
        deltas.append({"context": "vessels.self", "updates": [update]})
        mmsi = 211000001 + i % 2
        ais.append(f"{mmsi},{when},{north},{east},6.1,17.0,LAUNCH")
        day = f"{when[8:10]}/{when[5:7]}/{when[:4]} {when[11:19]}"
        danish.append(f"{day},Class A,{mmsi},{north},{east},6.1,17.0")
    positions = [[east, north] for _, north, east in rows]
    line = {"type": "LineString", "coordinates": positions}
    feature = {"type": "Feature", "properties": {"coordTimes": stamps}, "geometry": line}
    document = {"type": "FeatureCollection", "features": [feature]}
    whens = "".join(f"<when>{when}</when>\n" for when, _, _ in rows)
    coords = "".join(f"<gx:coord>{east} {north} 0</gx:coord>\n" for _, north, east in rows)
    track = f"<Placemark><name>launch</name><gx:Track>\n{whens}{coords}</gx:Track></Placemark>"
    marks = "".join(
        f"<Placemark><TimeStamp><when>{when}</when></TimeStamp><Point><coordinates>{east},{north}"
        "</coordinates></Point></Placemark>\n"
        for when, north, east in rows
    )
    tcx = "".join(
        f"<Trackpoint><Time>{when}</Time><Position><LatitudeDegrees>{north}</LatitudeDegrees>"
        f"<LongitudeDegrees>{east}</LongitudeDegrees></Position></Trackpoint>\n"
        for when, north, east in rows
    )
    kml = (
        '<kml xmlns="http://www.opengis.net/kml/2.2" '
        'xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>\n{}</Document></kml>'
    )
    objects = [
        {"time": when, "coords": {"lat": north, "lon": east}, "accuracy": 5}
        for when, north, east in rows
    ]
    records = [
        {"timestamp": when, "latitudeE7": round(north * 1e7), "longitudeE7": round(east * 1e7)}
        for when, north, east in rows
    ]
    german = ['"Zeit\n(UTC)";Breite;Länge']
    ublox = ["iTOW,year,month,day,hour,min,sec,nano,fixType,lon,lat"]
    for when, north, east in rows:
        day = f"{when[8:10]}.{when[5:7]}.{when[:4]} {when[11:19]}"
        german.append(f"{day};'{north};'{east}".replace(".", ",").replace(",", ".", 2))
        parts = ",".join(map(str, map(int, re.split("[-T:]", when[:19]))))
        ublox.append(f"1,{parts},-90000,3,{round(east * 1e7)},{round(north * 1e7)}")
    for name, text in (
        ("track.kml", kml.format(track)),
        ("marks.kml", kml.format(marks)),
        ("log.tcx", f"<TrainingCenterDatabase><Track>{tcx}</Track></TrainingCenterDatabase>"),
        ("list.json", json.dumps(objects, indent=1)),
        ("records.json", json.dumps({"locations": records})),
        ("german.csv", "\n".join(german)),
        ("ublox.csv", "\n".join(ublox)),
        ("gpsd.json", "\n".join(map(json.dumps, gpsd))),
        ("signalk.json", "\n".join(map(json.dumps, deltas))),
        ("log.geojson", json.dumps(document)),
        ("ais.csv", "\n".join(ais)),
        ("danish.csv", "\n".join(danish)),
    ):
        (folder / name).write_text(text + "\n", encoding="utf-8")


def _tables(folder: Path) -> None:
    boxes = formats.read_boxes(folder / "still" / "boxes" / "01.csv")
    detections = formats.read_boxes(folder / "still" / "detections" / "01.csv")
    formats.write_boxes(detections, folder / "boxes.txt")
    size = np.array([640.0, 360.0])
    yolo, xywh = [], ["frame,x,y,w,h,conf,id"]
    for i in range(min(len(detections), 40)):
        corners = detections.xyxy_px[i].reshape(2, 2)
        middle, extent = corners.mean(axis=0), corners[1] - corners[0]
        four = [*(middle / size), *(extent / size)]
        yolo += [
            " ".join(map(str, [int(detections.frame[i]) + 1, k, *four, 0.5, k])) for k in (0, 0)
        ]
        xywh.append(",".join(map(str, [int(detections.frame[i]), *corners[0], *extent, 0.5, 1])))
    (folder / "yolo.txt").write_text("\n".join(yolo) + "\n", encoding="utf-8")
    (folder / "xywh.csv").write_text("\n".join(xywh) + "\n", encoding="utf-8")
    _copy_lines(folder / "still" / "clock" / "01.csv", folder / "clock.csv", 60)
    target = np.arange(len(boxes)) % 3 > 0
    write_labels(Labels(boxes, target, np.array([3, 9])), folder / "labels.csv")
    (folder / "empty.csv").write_text(
        "recording,frame\n01,4\n01,7\n02,4\n01,90\n", encoding="utf-8"
    )
    (folder / "levels.csv").write_text(
        "time_utc,water_level_m\n2024-06-01T09:00:00Z,0.2\n2024-06-01T10:00:00Z,0.5\n"
        "2024-06-01T11:00:00Z,0.4\n",
        encoding="utf-8",
    )
    (folder / "points.csv").write_text(
        "x_px,y_px,latitude_deg,longitude_deg,name\n"
        + "".join(f"{x},{y},{north},{east},pier\n" for x, y, north, east in _points()),
        encoding="utf-8",
    )
    survey = {
        str(i): {
            "x_px": 100.0 * i,
            "y_px": 260.0 - 10 * i,
            "lon_utm": 573000.0 + 12 * i,
            "lat_utm": 6020000.0 + 30 * i,
            "zone_utm": 32,
            "hemisphere": "N",
        }
        for i in range(1, 5)
    }
    (folder / "points.otrfpts").write_text(json.dumps(survey, indent=1), encoding="utf-8")
    (folder / "pasted.txt").write_text(
        "54.3233, 10.1394\n54°19.398'N 010°08.364'E\n54 19 23.9 N, 10 8 21.8 E\n"
        "geo:54.3233,10.1394;u=20\nhttps://www.openstreetmap.org/#map=17/54.3233/10.1394\n"
        "https://maps.example/@54.3233,10.1394,17z\n",
        encoding="utf-8",
    )
    (folder / "fleet.toml").write_text(
        '[tracks]\ninterval_s = 1.0\n\n[[cameras]]\nname = "pier"\n'
        'model = "camera-gpr.safetensors"\n'
        'threshold = 0.3\narea = ["water.geojson"]\nmask = "mask.png"\nrecordings = [\n'
        '  "clip.mp4",\n  {source = "still/detections/01.csv", name = "one", clock = "clock.csv",'
        ' start_utc = 2024-06-01T10:00:00Z, clock_offset_s = 0.5, log = "feed.nmea",'
        ' mmsi = 211000001, water_levels = "levels.csv"},\n]\n',
        encoding="utf-8",
    )
    (folder / "stepped.csv").write_text(
        "frame,utc\n" + "".join(f"{i},2024-06-01 10:00:{i // 12:02d}+00:00\n" for i in range(60)),
        encoding="utf-8",
    )


def _copy_lines(source: Path, target: Path, lines: int) -> None:
    shutil.copy(source, target)
    _cut(target, lines)


def _tracks(folder: Path) -> None:
    import pyogrio

    # Nothing in an example may tell when it was made.
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": "2024-06-01T10:00:00.000Z"})
    plane = LocalPlane(54.3233, 10.1394)
    tracks = []
    for number in (1, 2):
        n = 12
        times = _START_UTC_S + 0.5 * np.arange(n)
        tracks.append(
            Track(
                number,
                times,
                10.0 * number + 2.0 * np.arange(n),
                np.full(n, 80.0),
                np.full(n, 4.0),
                np.zeros(n),
                np.tile(np.diag([4.0, 9.0]), (n, 1, 1)),
                np.tile(np.diag([0.2, 0.3]), (n, 1, 1)),
                np.full(n, PointKind.MEASURED, dtype=np.int8),
                plane,
                label="boat",
            )
        )
    for ending in ("geojson", "gpx", "csv", "kml", "parquet", "gpkg"):
        formats.write_tracks(tracks, folder / f"tracks.{ending}")
    # A page of the journal tells of the writing, not of the content.
    with sqlite3.connect(folder / "tracks.gpkg") as database:
        database.execute("VACUUM")


def _models(folder: Path) -> None:
    scene = Scene.load(folder / "still" / "scene.toml")
    for name in ("camera+gpr", "qkr+gpr", "nn", "qkr"):
        fit(scene, name).save(folder / f"{name.replace('+', '-')}.safetensors")


def _detectors(folder: Path) -> None:
    """A detector that puts out the same whatever it is shown, and one that looks."""
    boxes = np.tile(np.array([[[8.0], [9.0], [6.0], [5.0], [0.9]]], np.float32), (1, 1, 20))
    value = numpy_helper.from_array(boxes, "output0")
    node = helper.make_node("Constant", [], ["output0"], value=value)
    _save(folder / "constant.onnx", [node], [1, 3, 64, 64], [1, 5, 20], [])
    nodes = [
        helper.make_node("ReduceMean", ["images", "channel"], ["grey"], keepdims=1),
        helper.make_node("AveragePool", ["grey"], ["cells"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node("Reshape", ["cells", "flat"], ["score"]),
        helper.make_node("Concat", ["score"] * 5, ["output0"], axis=1),
    ]
    stored = [
        numpy_helper.from_array(np.array([1], np.int64), "channel"),
        numpy_helper.from_array(np.array([0, 1, -1], np.int64), "flat"),
    ]
    _save(folder / "looks.onnx", nodes, ["batch", 3, 64, 64], ["batch", 5, "n"], stored)


def _save(
    path: Path,
    nodes: list[onnx.NodeProto],
    shape: list[int | str],
    found: list[int | str],
    stored: list[onnx.TensorProto],
) -> None:
    pictures = helper.make_tensor_value_info("images", TensorProto.FLOAT, shape)
    output = helper.make_tensor_value_info("output0", TensorProto.FLOAT, found)
    graph = helper.make_graph(nodes, "example", [pictures], [output], stored)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 21)], ir_version=10)
    for key, value in (("names", "{0: 'boat'}"), ("task", "detect"), ("stride", "8")):
        model.metadata_props.add(key=key, value=value)
    onnx.save(model, str(path))


def frames(count: int = 8) -> Iterator[np.ndarray]:
    """(H, W, 3) pictures of a bright square that crosses a grey sea."""
    width, height = FRAME_PX
    for i in range(count):
        image = np.full((height, width, 3), 110 + i, dtype=np.uint8)
        image[20:28, 4 + 6 * i : 12 + 6 * i] = 220
        yield image


def _videos(folder: Path) -> None:
    for name, (container, codec) in _VIDEOS.items():
        _video(folder / name, container, codec, frames())


def _video(path: Path, container: str, codec: str, pictures: Iterable[np.ndarray]) -> None:
    pictures = list(pictures)
    with av.open(str(path), "w", format=container, options=_SAME) as file:
        if container in ("mp4", "mov", "matroska"):
            file.metadata["creation_time"] = "2024-06-01T10:00:00.000000Z"
        stream = file.add_stream(codec, rate=10)
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.thread_count = 1
        stream.height, stream.width = pictures[0].shape[:2]
        for image in pictures:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        file.mux(stream.encode())


def _pictures(folder: Path) -> None:
    for ending, kind in _PICTURES.items():
        for i, image in enumerate(frames(2)):
            content = io.BytesIO()
            Image.fromarray(image).save(content, kind)
            (folder / f"picture-{i}.{ending}").write_bytes(content.getvalue())


def _picture_labels(folder: Path) -> None:
    """Labels of single pictures, with the names of their classes."""
    (folder / "picture.txt").write_text(
        "0 0.5 0.5 0.1 0.05\n1 0.25 0.6 0.05 0.1\n0 0.1 0.1 0.2 0.1 0.2 0.2 0.1 0.2\n"
    )
    (folder / "classes.txt").write_text("boat\nsailboat\n")
    (folder / "data.yaml").write_text("path: here\nnames:\n  0: boat\n  1: sailboat\nnc: 2\n")
    content = {
        "images": [
            {"id": i, "file_name": f"{i}.png", "width": 640, "height": 360} for i in range(3)
        ],
        "annotations": [
            {"id": i, "image_id": i % 3, "category_id": 1 + i % 2, "bbox": [10.0 * i, 50, 30, 20]}
            for i in range(8)
        ],
        "categories": [{"id": 1, "name": "boat"}, {"id": 2, "name": "sailboat"}],
    }
    (folder / "coco.json").write_text(json.dumps(content))


def _areas(folder: Path) -> None:
    """The water with an island, a pond beside it, and a mask."""
    water = [[10.0, 54.0], [10.2, 54.0], [10.2, 54.1], [10.1, 54.15], [10.0, 54.1], [10.0, 54.0]]
    island = [[10.05, 54.05], [10.1, 54.05], [10.1, 54.08], [10.05, 54.05]]
    pond = [[10.3, 54.0], [10.4, 54.0], [10.35, 54.1], [10.3, 54.0]]
    shapes = [
        {"type": "Polygon", "coordinates": [water, island]},
        {"type": "MultiPolygon", "coordinates": [[pond]]},
    ]
    features = [{"type": "Feature", "properties": {}, "geometry": shape} for shape in shapes]
    content = {"type": "FeatureCollection", "features": features}
    (folder / "water.geojson").write_text(json.dumps(content))
    _boundaries(folder)
    mask = np.full((FRAME_PX[1], FRAME_PX[0]), 255, dtype=np.uint8)
    mask[:30] = 0
    Image.fromarray(mask).save(folder / "mask.png")


def _boundaries(folder: Path) -> None:
    """Lines and zones, which the tracks of the examples cross."""
    plane = LocalPlane(54.3233, 10.1394)

    def places(*east_north_m: tuple[float, float]) -> list[list[float]]:
        east_m, north_m = np.transpose(east_north_m)
        latitude_deg, longitude_deg = plane.to_geographic(east_m, north_m)
        return np.stack([longitude_deg, latitude_deg], axis=1).tolist()

    pier = places((15.0, 60.0), (16.0, 80.0), (15.0, 100.0))
    gate = places((30.0, 70.0), (30.0, 95.0))
    berth = places((12.0, 70.0), (24.0, 70.0), (24.0, 90.0), (12.0, 90.0), (12.0, 70.0))
    pool = places((28.0, 75.0), (40.0, 75.0), (34.0, 85.0), (28.0, 75.0))
    for name, shapes in (
        ("lines", {"pier": ("LineString", pier), "gate": ("LineString", gate)}),
        ("zones", {"berth": ("Polygon", [berth]), "pool": ("MultiPolygon", [[pool]])}),
    ):
        features = [
            {
                "type": "Feature",
                "properties": {"name": label},
                "geometry": {"type": kind, "coordinates": coordinates},
            }
            for label, (kind, coordinates) in shapes.items()
        ]
        content = {"type": "FeatureCollection", "features": features}
        (folder / f"{name}.geojson").write_text(json.dumps(content))
    box = {"class": "car", "confidence": 0.9, "x": 100.0, "y": 50.0, "w": 20.0, "h": 10.0}
    video = {"recorded_start_date": "1577836800.0", "recorded_fps": 20.0}
    content = {
        "metadata": {"otdet_version": "1.2", "video": video},
        "data": {"detections": [{**box, "frame": k, "track-id": 1} for k in range(1, 9)]},
    }
    (folder / "tracks.ottrk").write_text(json.dumps(content))
    corners = [{"x": 100, "y": 200}, {"x": 300, "y": 220}, {"x": 300, "y": 340}]
    sections = [
        {"id": kind, "type": kind, "coordinates": corners, "plugin_data": {}}
        for kind in ("line", "area")
    ]
    flows = [{"id": "in", "start": "line", "end": "area", "distance": 25.0}]
    content = {"sections": sections, "flows": flows}
    (folder / "sections.otflow").write_text(json.dumps(content))


def _live(folder: Path) -> None:
    """What live is told, and what it keeps."""
    (folder / "live.toml").write_text(
        'camera = "quay"\nmodel = "camera-gpr.safetensors"\nwater_level_m = 1.5\n'
        '[source]\naddress = "rtsp://192.0.2.7/a"\nclock = "auto"\nsilent_s = 5.0\n'
        '[detector]\nname = "harbour"\nclasses = ["boat"]\n[store]\nfile = "live.db"\n'
        '[feeds]\nnmea = ["udp://127.0.0.1:10110"]\n'
    )
    (folder / "played.toml").write_text(
        'camera = "quay"\nmodel = "camera-gpr.safetensors"\narea = ["water.geojson"]\n'
        '[source]\naddress = "played.mp4"\nas_live = true\nspeed = 4.0\n'
        'start_utc = "2024-06-01T10:00:00Z"\nframe_clock = "clock.csv"\n'
        '[detector]\nname = "motion"\n[targets]\ngone_s = 10.0\n'
        '[store]\nfile = "kept.db"\nretention_days = 30.0\n[log]\nfile = "live.log"\n'
    )
    sea = np.full((SIZE_PX[1], SIZE_PX[0], 3), 120, dtype=np.uint8)
    _video(folder / "played.mp4", "mp4", "libx264", [sea, sea])
    store = Store(folder / "live.db", camera="quay", plane=LocalPlane(54.3, 10.1))
    for k in range(40):
        target = TargetState(
            1 + k % 2, 54.3 + 1e-5 * k, 10.1, np.eye(2), 2.0, 10.0, "measured", name="ALBATROS"
        )
        store.keep([Moment(1_717_236_000.0 + 0.1 * k, "sender", "quay", (target,))])
    track = read_tracks(folder / "tracks.geojson")[0]
    store.keep([], [SmoothedPart(track, final=True)], {"tracker": {}})
    store.close()


TILES = ((0, 0, 0), (1, 1, 0), (2, 2, 1))
"""Zoom, column and row of the tiles of the maps."""


def _tiles(folder: Path) -> None:
    """Maps of pictures, as MBTiles and as PMTiles whose directory is not compressed."""
    coded = io.BytesIO()
    Image.fromarray(np.full((2, 2, 3), 90, dtype=np.uint8)).save(coded, "PNG")
    picture = coded.getvalue()
    with closing(sqlite3.connect(folder / "map.mbtiles")) as base, base:
        base.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        base.execute(
            "CREATE TABLE tiles (zoom_level INTEGER, tile_column INTEGER, tile_row INTEGER,"
            " tile_data BLOB)"
        )
        told = [("format", "png"), ("bounds", "9,53,11,55"), ("attribution", "<b>Chart</b>")]
        base.executemany("INSERT INTO metadata VALUES (?, ?)", told)
        rows = [(zoom, x, (1 << zoom) - 1 - y, picture) for zoom, x, y in TILES]
        base.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", rows)
    numbers = sorted({tile_number(*place) for place in TILES})
    steps = np.diff([0, *numbers]).tolist()
    # One picture for all: each entry is at the offset 0, which is written as 1.
    values = [len(numbers), *steps, *[1] * len(numbers), *[len(picture)] * len(numbers)]
    root = bytes([*values, *[1] * len(numbers)])
    meta = b'{"attribution": "Chart"}'
    at = 127 + len(root)
    header = struct.pack(
        "<7sB11Q6B4iB2i",
        *(b"PMTiles", 3, 127, len(root), at, len(meta), at + len(meta), 0, at + len(meta)),
        *(len(picture), len(numbers), len(numbers), 1, 1, 1, 1, 2, 0, 2),
        *(90_000_000, 530_000_000, 110_000_000, 550_000_000, 0, 100_000_000, 540_000_000),
    )
    (folder / "map.pmtiles").write_bytes(header + root + meta + picture)


def _foreign(folder: Path) -> None:
    """Content that has no business under the name of something else, and might start something."""
    made = folder / "foreign"
    made.mkdir(exist_ok=True)
    contents = {
        "eps": "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\nshowpage\n%%EOF\n",
        "vrt": '<OGRVRTDataSource><OGRVRTLayer name="tracks"><SrcDataSource>/etc/hostname'
        "</SrcDataSource></OGRVRTLayer></OGRVRTDataSource>\n",
        "m3u8": "#EXTM3U\n#EXT-X-TARGETDURATION:4\n#EXTINF:4,\n/etc/hostname\n#EXT-X-ENDLIST\n",
        "ffconcat": "ffconcat version 1.0\nfile '/etc/hostname'\n",
        "sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 9 RTP/AVP 96\n",
        "svg": '<svg xmlns="http://www.w3.org/2000/svg" width="64" height="48"><image href="'
        'file:///etc/hostname"/></svg>\n',
        "xxe": '<?xml version="1.0"?><!DOCTYPE gpx [<!ENTITY a SYSTEM "file:///etc/hostname">]>'
        "<gpx>&a;</gpx>\n",
        "gzip": "\x1f\x8b\x08",
        "pickle": "\x80\x04cos\nsystem\n(S'true'\ntR.",
    }
    for name, text in contents.items():
        (made / name).write_bytes(text.encode("latin-1"))
    for kind in ("GIF", "PPM", "ICO", "TGA"):
        content = io.BytesIO()
        Image.fromarray(next(frames(1))).save(content, kind)
        (made / kind.lower()).write_bytes(content.getvalue())
