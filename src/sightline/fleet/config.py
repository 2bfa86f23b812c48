"""`fleet.toml`: the cameras, each with its model and its recordings."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from sightline.configuration import Table, UtcTime, checked, posix_s, read_toml
from sightline.errors import InputError
from sightline.fusion import BiasPrior, FuseSettings, HandoverSettings
from sightline.fusion.fuse import CORRELATED_SHARE
from sightline.types import LARGEST_MMSI

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
    mmsi: Annotated[int, Field(ge=1, le=LARGEST_MMSI)] | None = None


class CameraTable(Table):
    """One of `[[cameras]]`."""

    name: Name
    model: str | None = None
    recordings: list[str | RecordingTable] = Field(default_factory=list)
    tracks: list[str] = Field(default_factory=list)
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)] | None = None
    detector: str | None = None
    classes: list[str] | None = None
    threshold: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    area: list[str] = Field(default_factory=list)
    mask: str | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.recordings and not self.tracks:
            raise ValueError("give recordings, that batch tracks, or tracks, that fuse fuses")
        if self.recordings and self.model is None:
            raise ValueError("recordings are tracked by a model; give model")
        if (self.latitude_deg is None) != (self.longitude_deg is None):
            raise ValueError("give both latitude_deg and longitude_deg, or neither")
        return self


class TracksTable(Table):
    """`[tracks]`."""

    trajectory: str | None = None
    interval_s: Annotated[float, Field(gt=0.0)] | None = None
    moving_only: bool = False


class FusionTable(Table):
    """`[fusion]`."""

    interval_s: Annotated[float, Field(ge=0.05, le=3600.0)] = FuseSettings.interval_s
    longest_gap_s: Annotated[float, Field(gt=0.0, le=3600.0)] = HandoverSettings.longest_s
    correlated_share: Annotated[float, Field(ge=0.0, le=1.0)] = CORRELATED_SHARE
    bias_m: Annotated[float, Field(gt=0.0, le=1000.0)] = BiasPrior.offset_m
    bias_heading_deg: Annotated[float, Field(gt=0.0, le=45.0)] = BiasPrior.heading_deg


class FleetTable(Table):
    """All of `fleet.toml`."""

    cameras: Annotated[list[CameraTable], Field(min_length=1)]
    tracks: TracksTable = TracksTable()
    fusion: FusionTable = FusionTable()


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

    @property
    def files(self) -> list[Path]:
        """Every file and folder that it names."""
        named: list[Path | None] = []
        for camera in self.cameras:
            named += [camera.model, camera.mask, *camera.area]
            named += [Path(camera.detector)] if camera.detector is not None else []
            for one in camera.recordings:
                named += [one.source, one.clock, one.platform, one.water_levels, one.log]
        return [path for path in named if path is not None]


@dataclass(frozen=True)
class TracksOfCamera:
    """A camera of a fleet whose tracks are in files.

    Attributes:
        name: Of its own.
        tracks: The files.
        place: Latitude and longitude of the camera, degrees; None where nobody says.
        model: The file of its fitted model, whose place is the camera's where nothing else is.
    """

    name: str
    tracks: tuple[Path, ...]
    place: tuple[float, float] | None = None
    model: Path | None = None


@dataclass(frozen=True)
class FusedFleet:
    """The cameras whose tracks are fused, and how.

    Attributes:
        path: The fleet file.
        cameras: At least two.
        settings: Of the fusion.
    """

    path: Path
    cameras: tuple[TracksOfCamera, ...]
    settings: FuseSettings


def read_fleet(path: Path) -> Fleet:
    """Read `fleet.toml`, and find the recordings; paths and patterns in it are relative to it.

    Raises:
        InputError: There is no such file, it is no TOML, a key or a value cannot stand there, a
            file that it names does not exist, a pattern matches nothing, two cameras name one
            recording, or there is none.
    """
    table = _table(path)
    recorded = [one for one in table.cameras if one.recordings]
    if not recorded:
        raise InputError(
            f"{path}: no camera has recordings; tracks that are there already, sightline fuse fuses"
        )
    cameras = tuple(_camera(path, one) for one in recorded)
    _refuse_twice(
        path,
        [(camera.name, one.source, "recording") for camera in cameras for one in camera.recordings],
    )
    tracks = table.tracks
    return Fleet(cameras, tracks.trajectory, tracks.interval_s, tracks.moving_only)


def read_fused_fleet(path: Path) -> FusedFleet:
    """Read the cameras of `fleet.toml` that have tracks; paths and patterns are relative to it.

    Raises:
        InputError: As `read_fleet`, of files of tracks; or fewer than two cameras have any.
    """
    table = _table(path)
    folder = path.parent
    cameras = []
    for one in table.cameras:
        where = f"{path}: camera {one.name}"
        files = [file for name in one.tracks for _, file in _matching(where, folder, name)]
        place = None
        if one.latitude_deg is not None and one.longitude_deg is not None:
            place = one.latitude_deg, one.longitude_deg
        if files:
            model = None if one.model is None else _there(where, folder, one.model)
            cameras.append(TracksOfCamera(one.name, tuple(files), place, model))
    if len(cameras) < 2:
        raise InputError(
            f"{path}: {len(cameras)} of {len(table.cameras)} cameras have tracks, and two are the "
            'least to fuse; give each its files (tracks = ["pier.parquet"])'
        )
    _refuse_twice(
        path,
        [(camera.name, file, "file of tracks") for camera in cameras for file in camera.tracks],
    )
    told = table.fusion
    settings = FuseSettings(
        interval_s=told.interval_s,
        correlated_share=told.correlated_share,
        bias=BiasPrior(told.bias_m, told.bias_heading_deg),
        handover=HandoverSettings(longest_s=told.longest_gap_s),
    )
    return FusedFleet(path, tuple(cameras), settings)


def _table(path: Path) -> FleetTable:
    """The tables of a fleet file, whose cameras have names of their own."""
    try:
        content = read_toml(path, "fleet file")
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such fleet file") from error
    table = checked(path, content, FleetTable)
    names: set[str] = set()
    for camera in table.cameras:
        # Folders of results are told apart by it, on disks that know no case as well.
        if camera.name.lower() in names:
            raise InputError(f"{path}: two cameras are called {camera.name}; rename one of them")
        names.add(camera.name.lower())
    return table


def _camera(path: Path, table: CameraTable) -> FleetCamera:
    assert table.model is not None, "recordings have one"
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
    # A name that is too long for any file is that of none.
    if not os.path.exists(path):
        raise InputError(f"{where}: {path}: there is no such file or folder")
    return path


def _refuse_twice(path: Path, named: Sequence[tuple[str, Path, str]]) -> None:
    """Raise InputError where two cameras, or one twice, name the same file."""
    sources: dict[str, str] = {}
    for camera, file, what in named:
        real = os.path.realpath(file)
        if real in sources:
            raise InputError(
                f"{path}: {file} is a {what} of camera {sources[real]} and of camera {camera}; "
                "one of them names another's file"
            )
        sources[real] = camera
