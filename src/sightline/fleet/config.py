"""`fleet.toml`: the cameras, each with its model and its recordings."""

from __future__ import annotations

import glob
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from sightline.configuration import Table, UtcTime, checked, posix_s, read_toml
from sightline.errors import InputError

_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}"
_MOST_RECORDINGS = 1_000_000

Name = Annotated[str, Field(pattern=f"^{_NAME}$")]


class RecordingTable(Table):
    """An element of `recordings` that says more than where its source lies."""

    source: str
    name: Name | None = None
    clock: str | None = None
    start_utc: UtcTime | None = None
    clock_offset_s: float = 0.0
    platform: str | None = None
    water_level_m: float | None = None
    water_levels: str | None = None
    log: str | None = None
    mmsi: Annotated[int, Field(ge=1, le=999_999_999)] | None = None


class CameraTable(Table):
    """One of `[[cameras]]`."""

    name: Name
    model: str
    recordings: Annotated[list[str | RecordingTable], Field(min_length=1)]
    detector: str | None = None
    classes: list[str] | None = None
    threshold: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    area: list[str] = Field(default_factory=list)
    mask: str | None = None


class TracksTable(Table):
    """`[tracks]`."""

    trajectory: str | None = None
    interval_s: Annotated[float, Field(gt=0.0)] | None = None
    moving_only: bool = False


class FleetTable(Table):
    """All of `fleet.toml`."""

    cameras: Annotated[list[CameraTable], Field(min_length=1)]
    tracks: TracksTable = TracksTable()


@dataclass(frozen=True)
class FleetRecording:
    """A recording of a camera.

    Attributes:
        name: Of its own among its camera's.
        source: A video, a folder of frames, or a table of boxes.
        clock: A table of its frames' times.
        start_utc_s: POSIX seconds of its first frame.
        clock_offset_s: How far the camera's clock is ahead.
        platform: Log of the vessel that the camera is on.
        water_level_m: Metres above the datum of the model's scene.
        water_levels: A table of them.
        log: Of a vessel or vehicle in it, to score the tracks against.
        mmsi: Which vessel of an AIS log.
    """

    name: str
    source: Path
    clock: Path | None = None
    start_utc_s: float | None = None
    clock_offset_s: float = 0.0
    platform: Path | None = None
    water_level_m: float | None = None
    water_levels: Path | None = None
    log: Path | None = None
    mmsi: int | None = None


@dataclass(frozen=True)
class FleetCamera:
    """A camera of a fleet.

    Attributes:
        name: Of its own.
        model: The file of its fitted model.
        recordings: In the order of their names.
        detector: A name, or the path of an ONNX file; None: the default.
        classes: That are kept; None: all.
        threshold: Least confidence; None: the detector's own.
        area: GeoJSON files of where targets can be.
        mask: A picture, black where nothing is kept.
    """

    name: str
    model: Path
    recordings: tuple[FleetRecording, ...]
    detector: str | None = None
    classes: tuple[str, ...] | None = None
    threshold: float | None = None
    area: tuple[Path, ...] = ()
    mask: Path | None = None


@dataclass(frozen=True)
class Fleet:
    """The cameras, and how their tracks are made.

    Attributes:
        cameras: At least one.
        trajectory: The trajectory method; None: the default.
        interval_s: Time between the points of a track; None: a point a box.
        moving_only: Whether what never moves is left out.
    """

    cameras: tuple[FleetCamera, ...]
    trajectory: str | None = None
    interval_s: float | None = None
    moving_only: bool = False


def read_fleet(path: Path) -> Fleet:
    """Read `fleet.toml`, and find the recordings; paths and patterns in it are relative to it.

    Raises:
        InputError: There is no such file, it is no TOML, a key or a value cannot stand there, a
            file that it names does not exist, a pattern matches nothing, or two cameras name one
            recording.
    """
    try:
        content = read_toml(path, "fleet file")
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such fleet file") from error
    table = checked(path, content, FleetTable)
    cameras = tuple(_camera(path, one) for one in table.cameras)
    _refuse_twice(path, cameras)
    tracks = table.tracks
    return Fleet(cameras, tracks.trajectory, tracks.interval_s, tracks.moving_only)


def _camera(path: Path, table: CameraTable) -> FleetCamera:
    folder = path.parent
    where = f"{path}: camera {table.name}"
    recordings: dict[str, FleetRecording] = {}
    for entry in table.recordings:
        for recording in _recordings(where, folder, entry):
            if recording.name in recordings:
                raise InputError(
                    f"{where}: two recordings are called {recording.name}, "
                    f"{recordings[recording.name].source} and {recording.source}; give one a name "
                    '({ source = "...", name = "..." })'
                )
            recordings[recording.name] = recording
    detector = table.detector
    if detector is not None and (folder / detector).is_file():
        detector = str(folder / detector)
    return FleetCamera(
        table.name,
        _there(where, folder, table.model),
        tuple(recordings[name] for name in sorted(recordings)),
        detector,
        tuple(table.classes) if table.classes is not None else None,
        table.threshold,
        tuple(_there(where, folder, one) for one in table.area),
        None if table.mask is None else _there(where, folder, table.mask),
    )


def _recordings(where: str, folder: Path, entry: str | RecordingTable) -> list[FleetRecording]:
    if isinstance(entry, str):
        return [FleetRecording(name, source) for name, source in _matching(where, folder, entry)]
    source = _there(where, folder, entry.source)

    def file(given: str | None) -> Path | None:
        return None if given is None else _there(where, folder, given)

    return [
        FleetRecording(
            entry.name or _name(Path(Path(entry.source).name)),
            source,
            file(entry.clock),
            posix_s(entry.start_utc),
            entry.clock_offset_s,
            file(entry.platform),
            entry.water_level_m,
            file(entry.water_levels),
            file(entry.log),
            entry.mmsi,
        )
    ]


def _matching(where: str, folder: Path, pattern: str) -> list[tuple[str, Path]]:
    """Names and paths of the recordings that a pattern matches: their paths below what is fixed."""
    if not glob.has_magic(pattern):
        return [(_name(Path(Path(pattern).name)), _there(where, folder, pattern))]
    parts = Path(pattern).parts
    fixed = next(i for i, part in enumerate(parts) if glob.has_magic(part))
    base = folder.joinpath(*parts[:fixed])
    found = sorted(glob.glob(pattern, root_dir=folder, recursive=True))
    if not found:
        raise InputError(f"{where}: {pattern} matches no file")
    if len(found) > _MOST_RECORDINGS:
        raise InputError(
            f"{where}: {pattern} matches {len(found):,} files; {_MOST_RECORDINGS:,} are the most"
        )
    paths = [folder / one for one in found]
    return [(_name(one.relative_to(base)), one) for one in paths]


def _name(path: Path) -> str:
    """A recording's name by its path: what no folder of results can be called is a dash."""
    whole = "-".join(part for part in path.with_suffix("").parts if part not in ("..", os.sep))
    return re.sub(r"[^A-Za-z0-9._-]+", "-", whole).lstrip("._-")[:100] or "recording"


def _there(where: str, folder: Path, name: str) -> Path:
    path = folder / name
    if not path.exists():
        raise InputError(f"{where}: {path}: there is no such file or folder")
    return path


def _refuse_twice(path: Path, cameras: tuple[FleetCamera, ...]) -> None:
    names: set[str] = set()
    sources: dict[str, str] = {}
    for camera in cameras:
        # Folders of results are told apart by it, on disks that know no case as well.
        if camera.name.lower() in names:
            raise InputError(f"{path}: two cameras are called {camera.name}; rename one of them")
        names.add(camera.name.lower())
        for recording in camera.recordings:
            real = os.path.realpath(recording.source)
            if real in sources:
                raise InputError(
                    f"{path}: {recording.source} is a recording of camera {sources[real]} and of "
                    f"camera {camera.name}; one of them names another's file"
                )
            sources[real] = camera.name
