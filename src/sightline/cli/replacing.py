"""What a command may replace: its own earlier results, known by what is in them."""

from __future__ import annotations

import json
import os
import re
import sqlite3
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from sightline.errors import InputError

_FIRST_BYTES = 4096
_LAST_BYTES = 65536
_LENGTH_BYTES = 8
_LONGEST_HEADER = 100_000_000
_LARGEST_JSON = 200_000_000

# Of these a table that somebody else wrote has some, not all.
_TRACK_COLUMNS = {
    *("track_id", "time_utc", "latitude_deg", "longitude_deg", "kind"),
    *("semi_major_m", "semi_minor_m", "ellipse_bearing_deg"),
}
_TRACK_PROPERTIES = (b'"track_id"', b'"semi_major_m"', b'"ellipse_bearing_deg"')
_COUNT_COLUMNS = ("entries_expected", "occupancy_moored", "other_track_id", "distance_sigma_m")
_FLOW_HEADER = "start time,end time,classification,flow,from section,to section,count"
_BOX_HEADER = "frame,x1,y1,x2,y2,confidence,annotator,label,time_utc"
# Numbers as they are written here, always with a point.
_BOX_ROW = re.compile(r"\d+,-?\d+(,-?\d+\.\d{1,2}){4},\d\.\d{1,4},-1,-1,-1")
_NO_TRACKS = '{"type": "FeatureCollection", "features": [ ]}'
# What the results of the commands have in common with no other file.
_RESULTS = (
    {"ape", "rpe", "coverage"},
    {"what", "refused", "problems"},
    {"single", "left_out", "tracks_per_recording"},
    {"model", "fit"},
    {"tracks", "points", "files"},
    {"frames", "boxes", "file"},
    {"frames", "tracks", "file"},
    {"scene", "recordings"},
    {"detector", "recordings"},
    {"detector", "export_difference"},
    {"detectors", "split", "settings"},
    {"labels", "recordings"},
    {"every_s", "journeys", "near_misses"},
    {"recordings", "done", "before", "failed"},
    {"targets", "shared", "handovers", "cameras"},
    {"plan", "curvature", "undetermined"},
)
_SCENE_MARK = "# A synthetic harbour"
_TRUTH = {"camera", "boats", "settings"}


def check_holds_tracks(path: Path) -> None:
    """Raise where a file exists that is not tracks: then it may be a source.

    Raises:
        InputError: It holds something else.
    """
    if not _is_ours(path, "tracks"):
        raise InputError(
            f"{path}: exists and holds no tracks, so it is not overwritten; track takes one "
            "source, and what follows -o FILE are further files for its tracks"
        )


def keep_others(outputs: Iterable[tuple[Path | None, str]], *, overwrite: bool = False) -> None:
    """Raise InputError where an output would replace what was not written here as such.

    Args:
        outputs: Files, and what is to be in each: a name in `KINDS`.
        overwrite: Whether the user has said that it may.

    Raises:
        InputError: A file exists that is no earlier result of this kind.
    """
    for path, kind in outputs:
        if path is not None and not overwrite and not _is_ours(path, kind):
            raise InputError(
                f"{path}: exists and is not {KINDS[kind]} that sightline wrote, so it is not "
                "replaced; give another name, or --overwrite"
            )


def keep_other_folder(path: Path, *, overwrite: bool = False) -> None:
    """Raise InputError where a folder holds anything but a harbour that was simulated.

    Raises:
        InputError: It does, and the user has not said that it may be written to.
    """
    if overwrite or not os.path.isdir(path) or _is_harbour(path):
        return
    if any(not name.startswith(".") for name in os.listdir(path)):
        raise InputError(
            f"{path}: is a folder that simulate has not made, and is not empty; give another "
            "name, or --overwrite"
        )


def kind_of_result(path: Path) -> str:
    """What a run writes to a file of its results, by the file's ending."""
    suffixes = {".safetensors": "model", ".html": "page", ".json": "result", ".png": "figure"}
    return suffixes.get(path.suffix, "tracks")


def _is_harbour(folder: Path) -> bool:
    try:
        scene = (folder / "scene.toml").read_text(encoding="utf-8", errors="replace")
        truth = json.loads((folder / "truth.json").read_bytes())
    except (OSError, ValueError):
        return False
    return scene.startswith(_SCENE_MARK) and isinstance(truth, dict) and truth.keys() >= _TRUTH


def _is_ours(path: Path, kind: str) -> bool:
    """Whether a file is there to be replaced: none, an empty one, or an earlier result."""
    # What is no file is refused, or written to, elsewhere.
    if not os.path.isfile(path) or os.path.getsize(path) == 0:
        return True
    try:
        return _KNOWN[kind](path)
    except OSError as error:
        raise InputError(f"{path}: may not be read; check its permissions") from error


def _ends(path: Path) -> tuple[bytes, bytes]:
    with path.open("rb") as file:
        head = file.read(_FIRST_BYTES)
        file.seek(max(path.stat().st_size - _LAST_BYTES, 0))
        return head, file.read()


def _first_line(head: bytes) -> str:
    return head.decode("utf-8-sig", errors="replace").partition("\n")[0].rstrip("\r")


def _is_tracks(path: Path) -> bool:
    head, tail = _ends(path)
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return {name.strip() for name in _first_line(head).split(",")} >= _TRACK_COLUMNS
    if suffix == ".geojson":
        empty = head.split() == _NO_TRACKS.encode().split()
        return empty or all(name in head for name in (b'"FeatureCollection"', *_TRACK_PROPERTIES))
    if suffix == ".mfjson":
        return head.startswith(b'{"type": "FeatureCollection", "crs"') and b"MovingPoint" in head
    if suffix in (".gpx", ".kml"):
        mark = b'creator="sightline"' if suffix == ".gpx" else b"<name>sightline</name>"
        return mark in head
    if suffix == ".parquet":
        return head.startswith(b"PAR1") and all(name.encode() in tail for name in _TRACK_COLUMNS)
    return suffix == ".gpkg" and _has_layer_of_tracks(path)


def _has_layer_of_tracks(path: Path) -> bool:
    address = f"file:{quote(os.path.abspath(path))}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(address, uri=True)) as file:
            columns = {row[1] for row in file.execute("PRAGMA table_info(tracks)")}
    except sqlite3.Error:
        return False
    return columns >= _TRACK_COLUMNS


def _is_boxes(path: Path) -> bool:
    head, _ = _ends(path)
    if path.suffix.lower() == ".csv":
        return _first_line(head) == _BOX_HEADER
    *rows, rest = head.decode("utf-8", errors="replace").split("\n")
    return all(map(_BOX_ROW.fullmatch, rows or [rest]))


def _is_counts(path: Path) -> bool:
    head, tail = _ends(path)
    if path.suffix.lower() == ".csv":
        return {name.strip() for name in _first_line(head).split(",")} >= set(_COUNT_COLUMNS)
    return head.startswith(b"PAR1") and all(name.encode() in tail for name in _COUNT_COLUMNS)


def _is_flows(path: Path) -> bool:
    # OTAnalytics' own have the same columns: whoever counts anew replaces those as well.
    head, _ = _ends(path)
    return _first_line(head) == _FLOW_HEADER


def _is_model(path: Path) -> bool:
    with path.open("rb") as file:
        length = int.from_bytes(file.read(_LENGTH_BYTES), "little")
        return length < _LONGEST_HEADER and b'"sightline-model"' in file.read(length)


def _is_result(path: Path) -> bool:
    if path.stat().st_size > _LARGEST_JSON:
        return False
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return False
    if not isinstance(content, dict):
        return False
    models = content.get("models")
    if isinstance(models, dict) and models:
        return all(isinstance(one, dict) and "ape" in one for one in models.values())
    return any(content.keys() >= keys for keys in _RESULTS)


def _is_page(path: Path) -> bool:
    return b"<footer>sightline " in path.read_bytes()


def _is_figure(path: Path) -> bool:
    head, tail = _ends(path)
    # As PNG, SVG and PDF tell what made them.
    return b"sightline" in head + tail


def _is_video(path: Path) -> bool:
    _, tail = _ends(path)
    # The comment of the file, behind its pictures.
    return b"sightline show" in tail


def _is_detector(path: Path) -> bool:
    _, tail = _ends(path)
    return b"sightline" in tail


def _is_contours(path: Path) -> bool:
    head, _ = _ends(path)
    return head.startswith(b'{"type": "FeatureCollection", "name": "sightline plan"')


KINDS = {
    "tracks": "a file of tracks",
    "boxes": "a table of boxes",
    "counts": "a table of counts",
    "flows": "a table of counted flows",
    "model": "a model",
    "result": "a result as JSON",
    "page": "a report",
    "figure": "a figure",
    "video": "a video",
    "detector": "a detector",
    "contours": "contours of a plan",
}
"""What a file can hold, as messages name it."""

_KNOWN: dict[str, Callable[[Path], bool]] = {
    "tracks": _is_tracks,
    "boxes": _is_boxes,
    "counts": _is_counts,
    "flows": _is_flows,
    "model": _is_model,
    "result": _is_result,
    "page": _is_page,
    "figure": _is_figure,
    "video": _is_video,
    "detector": _is_detector,
    "contours": _is_contours,
}
