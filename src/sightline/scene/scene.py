"""The scene file: which camera, which recordings, which logs.

TOML, with paths relative to the file. The whole of it is checked when it is loaded, the files
that it names are opened when they are asked for.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from sightline import formats, video
from sightline.clock import Clock, presentation_clock
from sightline.errors import InputError, no_scene_file, unknown_name
from sightline.geodesy import LocalPlane
from sightline.platform import Platform
from sightline.types import Boxes, ControlPoints, Fixes, Frame, Horizons, check_inside
from sightline.water import WaterLevels

Latitude = Annotated[float, Field(ge=-90.0, le=90.0)]
Longitude = Annotated[float, Field(ge=-180.0, le=180.0)]
Pixels = Annotated[int, Field(gt=0)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class _CameraTable(_Table):
    name: str = ""
    latitude_deg: Latitude | None = None
    longitude_deg: Longitude | None = None
    image_size_px: Annotated[list[Pixels], Field(min_length=2, max_length=2)] | None = None
    watched: bool = True

    @model_validator(mode="after")
    def _whole_place(self) -> Self:
        if (self.latitude_deg is None) != (self.longitude_deg is None):
            raise ValueError("give both latitude_deg and longitude_deg, or neither")
        return self


class _RecordingTable(_Table):
    name: Annotated[str, Field(min_length=1)]
    video: str | None = None
    frames: str | None = None
    start_utc: datetime | None = None
    clock: str | None = None
    boxes: str | None = None
    detections: str | None = None
    fixes: str | None = None
    mmsi: int | None = None
    platform: str | None = None
    horizon: str | None = None
    water_level_m: float | None = None
    water_levels: str | None = None

    @field_validator("name")
    @classmethod
    def _of_a_file(cls, value: str) -> str:
        if any(letter in "/\\" or not letter.isprintable() for letter in value):
            raise ValueError(
                f"{value!r} holds / or \\ or what cannot be printed, and files are named after it"
            )
        return value

    @field_validator("start_utc", mode="before")
    @classmethod
    def _moment(cls, value: object) -> object:
        if isinstance(value, str):
            return datetime.fromisoformat(value)
        return value

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        for one, other in (
            ("video", "frames"),
            ("start_utc", "clock"),
            ("water_level_m", "water_levels"),
        ):
            if getattr(self, one) is not None and getattr(self, other) is not None:
                raise ValueError(f"give {one} or {other}, not both")
        if self.start_utc is not None and self.video is None:
            raise ValueError(
                "start_utc tells the times of a video's frames; without a video give a clock"
            )
        if self.mmsi is not None and self.fixes is None:
            raise ValueError("mmsi chooses a vessel of the log that fixes names; give fixes")
        if self.platform is not None and (self.water_level_m is not None or self.water_levels):
            raise ValueError("a platform floats with the water; leave its level away")
        if self.frames is None and self.video is None and not (self.boxes or self.detections):
            raise ValueError("give a video, frames, boxes or detections; there is nothing to see")
        return self


class _PointTable(_Table):
    pixel_px: Annotated[list[float], Field(min_length=2, max_length=2)]
    latitude_deg: Latitude
    longitude_deg: Longitude


class _SceneTable(_Table):
    camera: _CameraTable = _CameraTable()
    recordings: list[_RecordingTable] = []
    control_points: list[_PointTable] | str = []

    @model_validator(mode="after")
    def _something_to_learn_from(self) -> Self:
        if not self.recordings and not self.control_points:
            raise ValueError("give [[recordings]] or [[control_points]]; the scene is empty")
        return self


_TABLES: dict[str, type[_Table]] = {
    "": _SceneTable,
    "camera": _CameraTable,
    "recordings": _RecordingTable,
    "control_points": _PointTable,
}


_FILES = (
    "video",
    "frames",
    "clock",
    "boxes",
    "detections",
    "fixes",
    "platform",
    "horizon",
    "water_levels",
)


@dataclass(frozen=True)
class CameraSite:
    """Where the camera stands, as far as it is known, and the size of its picture.

    Attributes:
        name: Of the camera, or ``""``.
        latitude_deg: Degrees north; None if it is not known.
        longitude_deg: Degrees east; None if it is not known.
        image_size_px: Width and height; None where the scene file leaves that to the video.
        watched: Whether pictures are asked if the camera was turned, and a turn is made up for.
    """

    name: str = ""
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    image_size_px: tuple[int, int] | None = None
    watched: bool = True


@dataclass(frozen=True)
class Recording:
    """One recording of the camera, and what belongs to it. Files are read when asked for.

    Attributes:
        name: Unique in its scene.
        video_path: A video file, or None.
        frames_path: A folder of pictures, or None.
        start_utc_s: POSIX seconds of the video's first frame, or None.
        clock_path: A table ``frame,utc``, or None.
        boxes_path: Boxes of the target that was logged, or None.
        detections_path: Boxes of anything, or None.
        fixes_path: The log of the target, or None.
        mmsi: Which vessel of an AIS log, or None.
        platform_path: The log of what the camera stands on, where that moves, or None.
        horizon_path: Where the horizon lies in each frame, or None.
        water_level_m: How high the water stood above the datum, or None.
        water_levels_path: A table of how high it stood, or None.
        image_size_px: Width and height of the picture where the scene file says it, or None.
    """

    name: str
    video_path: Path | None = None
    frames_path: Path | None = None
    start_utc_s: float | None = None
    clock_path: Path | None = None
    boxes_path: Path | None = None
    detections_path: Path | None = None
    fixes_path: Path | None = None
    mmsi: int | None = None
    platform_path: Path | None = None
    horizon_path: Path | None = None
    water_level_m: float | None = None
    water_levels_path: Path | None = None
    image_size_px: tuple[int, int] | None = None

    @property
    def source(self) -> Path | None:
        """The video or the folder of pictures; None where boxes stand alone."""
        return self.video_path if self.video_path is not None else self.frames_path

    def clock(self) -> Clock:
        """The time of each frame: from the clock's table, or from the video and its start.

        Without a start, a video's own creation time is taken for it.

        Raises:
            InputError: There is neither, or a file cannot be used.
        """
        if self.clock_path is not None:
            return _clock(self.clock_path, self.clock_path.stat().st_mtime_ns)
        if self.video_path is not None:
            info = _video_info(self.video_path, self.video_path.stat().st_mtime_ns)
            start_s = self.start_utc_s if self.start_utc_s is not None else info.creation_utc_s
            if start_s is not None:
                return presentation_clock(start_s, info.presentation_s)
        raise InputError(
            f"recording {self.name}: nothing tells the times of its frames; give start_utc (with "
            "a video), clock (a table frame,utc), or time_utc with the boxes"
        )

    def boxes(self) -> Boxes:
        """The boxes of the target that was logged, with their times.

        Raises:
            InputError: The recording has none, they cannot be used, lie wholly outside the
                picture, or have no times.
        """
        if self.boxes_path is None:
            raise InputError(f"recording {self.name}: has no boxes; give boxes = FILE")
        return self._timed(formats.read_boxes(self.boxes_path), self.boxes_path)

    def detections(self) -> Boxes:
        """The boxes of anything, with their times.

        Boxes without an annotator get the file's name, less its ending, for their source. Boxes
        without width or height, which some detectors put out, are left out.

        Raises:
            InputError: As `boxes`.
        """
        if self.detections_path is None:
            raise InputError(f"recording {self.name}: has no detections; give detections = FILE")
        path = self.detections_path
        return self._timed(formats.read_boxes(path, source=path.stem, skip_empty=True), path)

    def fixes(self) -> Fixes:
        """The log of the target.

        Raises:
            InputError: The recording has none, or it cannot be used.
        """
        if self.fixes_path is None:
            raise InputError(f"recording {self.name}: has no log; give fixes = FILE")
        return _fixes(self.fixes_path, self.mmsi, self.fixes_path.stat().st_mtime_ns)

    def platform(self) -> Platform | None:
        """What the camera stands on, where that moves; None where it stands still.

        Raises:
            InputError: The log cannot be used.
        """
        if self.platform_path is None:
            return None
        return _platform(self.platform_path, self.platform_path.stat().st_mtime_ns)

    def water_levels(self) -> WaterLevels | None:
        """How high the water stood; None where nobody says.

        Raises:
            InputError: The table cannot be used.
        """
        if self.water_level_m is not None:
            return WaterLevels.constant(self.water_level_m)
        if self.water_levels_path is None:
            return None
        return _water(self.water_levels_path, self.water_levels_path.stat().st_mtime_ns)

    def horizons(self) -> Horizons | None:
        """Where the horizon lies in the frames, as its table says; None where there is no table.

        Raises:
            InputError: The table cannot be used, or nothing tells the times of its frames.
        """
        if self.horizon_path is None:
            return None
        try:
            clock = self.clock()
        except InputError as error:
            raise InputError(f"{self.horizon_path}: {error}") from error
        return formats.read_horizons_csv(self.horizon_path, clock)

    def logs(self) -> tuple[formats.AisVessel, ...]:
        """The logs of whatever may be in view: of one target, or of all vessels of an AIS feed.

        An AIS log of which no vessel is chosen (``mmsi``) is a feed.

        Raises:
            InputError: The recording has none, or it cannot be used.
        """
        path = self.fixes_path
        if path is not None and self.mmsi is None and formats.holds_ais(path):
            return _feed(path, path.stat().st_mtime_ns)
        fixes = self.fixes()
        return (formats.AisVessel(fixes, np.full((len(fixes), 2), np.nan)),)

    def frames(self, *, apart_s: float = 0.0) -> Iterator[Frame]:
        """The pictures, one at a time, with their times; NaN where nothing tells them.

        Args:
            apart_s: Pictures that follow the one before them sooner are left out.

        Raises:
            InputError: The recording has none, or they cannot be read.
        """
        if self.source is None:
            raise InputError(f"recording {self.name}: has no pictures; give video or frames")
        if self.clock_path is not None:
            return video.frames(self.source, clock=self.clock(), apart_s=apart_s)
        return video.frames(self.source, start_utc_s=self.start_utc_s, apart_s=apart_s)

    def _timed(self, boxes: Boxes, path: Path) -> Boxes:
        if self.image_size_px is not None:
            check_inside(boxes, self.image_size_px, f"{path}: ")
        unknown = ~np.isfinite(boxes.time_utc_s)
        if not unknown.any():
            return boxes
        time_utc_s = boxes.time_utc_s.copy()
        try:
            time_utc_s[unknown] = self.clock().time_utc_s(boxes.frame[unknown])
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        return boxes.with_columns(time_utc_s=time_utc_s)


@dataclass(frozen=True)
class Scene:
    """A camera and what it recorded.

    Attributes:
        camera: Where it stands.
        recordings: In the order of the file.
        control_points: Pixels whose place is known; may be none.
        path: The scene file.
    """

    camera: CameraSite
    recordings: tuple[Recording, ...]
    control_points: ControlPoints
    path: Path

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Scene:
        """Read a scene file.

        Raises:
            InputError: The file is missing or no TOML, a key is unknown or has a value that it
                cannot have, a name comes twice, or a file that it names is missing.

        Examples:
            >>> scene = sightline.Scene.load("scene.toml")
            >>> [recording.name for recording in scene.recordings]
            ['01', '02', '03']
            >>> scene["02"].boxes().xyxy_px.shape
            (60, 4)
        """
        table = _parse(Path(path))
        base = Path(path).parent
        size = table.camera.image_size_px
        camera = CameraSite(
            name=table.camera.name,
            latitude_deg=table.camera.latitude_deg,
            longitude_deg=table.camera.longitude_deg,
            image_size_px=(size[0], size[1]) if size else None,
            watched=table.camera.watched,
        )
        names = [recording.name for recording in table.recordings]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"{path}: two recordings are named {name!r}; names must differ")
        return cls(
            camera=camera,
            recordings=tuple(
                _recording(Path(path), base, i, recording, camera.image_size_px)
                for i, recording in enumerate(table.recordings)
            ),
            control_points=_control_points(
                Path(path), base, table.control_points, camera.image_size_px
            ),
            path=Path(path),
        )

    @property
    def plane(self) -> LocalPlane | None:
        """The plane whose origin is the camera; None where its place is not known."""
        if self.camera.latitude_deg is None or self.camera.longitude_deg is None:
            return None
        return LocalPlane(self.camera.latitude_deg, self.camera.longitude_deg)

    @property
    def moves(self) -> bool:
        """Whether the camera stands on a platform that moves.

        Raises:
            InputError: It does in some recordings and not in others: these are two cameras.
        """
        return self._all_or_none(
            [recording.platform_path is not None for recording in self.recordings],
            "platform",
            "a camera that moves and one that stands still are two scenes",
        )

    @property
    def tidal(self) -> bool:
        """Whether the recordings say how high the water stood.

        Raises:
            InputError: Some do and some do not: then nobody knows what height that of the camera
                is.
        """
        return self._all_or_none(
            [
                recording.water_level_m is not None or recording.water_levels_path is not None
                for recording in self.recordings
            ],
            "water level",
            "give water_level_m or water_levels to all recordings, or to none",
        )

    def _all_or_none(self, has: list[bool], what: str, mend: str) -> bool:
        """Whether the recordings have something that all must have, or none."""
        if any(has) and not all(has):
            name = self.recordings[has.index(False)].name
            raise InputError(
                f"{self.path}: recording {name} has no {what}, and others have; {mend}"
            )
        return any(has)

    @property
    def image_size_px(self) -> tuple[int, int]:
        """Width and height of the picture: as the scene file says, or of the first frame.

        Raises:
            InputError: Neither tells.
        """
        if self.camera.image_size_px is not None:
            return self.camera.image_size_px
        for recording in self.recordings:
            if recording.source is not None:
                return video.image_size_px(recording.source)
        raise InputError(
            f"{self.path}: nothing tells the size of the picture; give [camera] image_size_px = "
            "[WIDTH, HEIGHT]"
        )

    def __getitem__(self, name: str) -> Recording:
        """The recording of a name.

        Raises:
            InputError: There is none; lists the names that there are.
        """
        for recording in self.recordings:
            if recording.name == name:
                return recording
        raise unknown_name("recording", name, [recording.name for recording in self.recordings])

    def select(self, names: Iterable[str]) -> Scene:
        """The scene with only the recordings of these names, in the order of the scene.

        Raises:
            InputError: A name is unknown.
        """
        chosen = {self[name].name for name in names}
        return replace(self, recordings=tuple(one for one in self.recordings if one.name in chosen))

    def without(self, names: Iterable[str]) -> Scene:
        """The scene without the recordings of these names.

        Raises:
            InputError: A name is unknown.
        """
        left_out = {self[name].name for name in names}
        return replace(
            self, recordings=tuple(one for one in self.recordings if one.name not in left_out)
        )


# Recordings share their logs, which are long.
@lru_cache(maxsize=32)
def _fixes(path: Path, mmsi: int | None, _modified_ns: int) -> Fixes:
    return formats.read_fixes(path, mmsi=mmsi)


@lru_cache(maxsize=32)
def _platform(path: Path, _modified_ns: int) -> Platform:
    return Platform(formats.read_fixes(path), formats.read_headings(path))


@lru_cache(maxsize=32)
def _water(path: Path, _modified_ns: int) -> WaterLevels:
    return formats.read_water_levels(path)


@lru_cache(maxsize=8)
def _feed(path: Path, _modified_ns: int) -> tuple[formats.AisVessel, ...]:
    return tuple(formats.read_ais_feed(path).values())


@lru_cache(maxsize=128)
def _clock(path: Path, _modified_ns: int) -> Clock:
    return formats.read_clock(path)


@lru_cache(maxsize=128)
def _video_info(path: Path, _modified_ns: int) -> video.VideoInfo:
    return video.video_info(path)


def _parse(path: Path) -> _SceneTable:
    if path.is_dir():
        raise InputError(f"{path}: is a folder; expected a scene file, as {path / 'scene.toml'}")
    try:
        # Some editors begin a file with a byte order mark.
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise no_scene_file(path) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8, so it is no scene file") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no TOML: {error}") from error
    try:
        return _SceneTable.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{path}: {_first_problem(error)}") from error


def _first_problem(error: ValidationError) -> str:
    """The first problem of a validation in one line: the key's path, and what mends it."""
    # An unknown key is often why another is missing, so it goes first.
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    problem = problems[0]
    # The names of the alternatives of a union are no keys.
    steps = [step for step in problem["loc"] if step not in ("str", "list[_PointTable]")]
    where = ""
    for step in steps:
        where += f"[{step + 1}]" if isinstance(step, int) else f".{step}" if where else str(step)
    if problem["type"] == "extra_forbidden":
        table = str(steps[0]) if len(steps) > 1 else ""
        known = ", ".join(_TABLES[table].model_fields)
        return f"unknown key {where}; known are {known}"
    if problem["type"] == "missing":
        return f"{where} is missing"
    if problem["type"] == "model_type":
        return f"{where}: expected a table of keys and values; it is {problem['input']!r}"
    message = problem["msg"].removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    given = problem["input"]
    if isinstance(given, str | int | float | list) and problem["type"] != "value_error":
        message += f"; it is {given!r}"
    return f"{where}: {message}" if where else message


def _recording(
    scene: Path,
    base: Path,
    number: int,
    table: _RecordingTable,
    image_size_px: tuple[int, int] | None,
) -> Recording:
    paths: dict[str, Path | None] = {}
    for key in _FILES:
        written = getattr(table, key)
        paths[f"{key}_path"] = None if written is None else base / written
        if written is not None:
            _check_there(scene, f"recordings[{number + 1}].{key}", base / written, key == "frames")
    start = table.start_utc
    if start is not None and start.tzinfo is None:
        start = start.replace(tzinfo=UTC)
    return Recording(
        name=table.name,
        start_utc_s=None if start is None else start.timestamp(),
        mmsi=table.mmsi,
        water_level_m=table.water_level_m,
        image_size_px=image_size_px,
        **paths,
    )


def _check_there(scene: Path, key: str, path: Path, folder: bool) -> None:
    # os.path answers where pathlib raises: for a name that is too long, or a folder that is closed.
    if not os.path.exists(path):
        raise InputError(f"{scene}: {key} names {path}, which does not exist")
    if os.path.isdir(path) != folder:
        raise InputError(
            f"{scene}: {key} names {path}, which is a {'file' if folder else 'folder'}; "
            f"expected a {'folder of FRAME.jpg' if folder else 'file'}"
        )


def _control_points(
    scene: Path,
    base: Path,
    points: list[_PointTable] | str,
    image_size_px: tuple[int, int] | None,
) -> ControlPoints:
    if isinstance(points, str):
        _check_there(scene, "control_points", base / points, False)
        where, found = str(base / points), formats.read_control_points(base / points)
    else:
        where = str(scene)
        found = ControlPoints(
            pixel_px=np.array([point.pixel_px for point in points]).reshape(-1, 2),
            latitude_deg=np.array([point.latitude_deg for point in points]),
            longitude_deg=np.array([point.longitude_deg for point in points]),
        )
    if image_size_px is not None:
        outside = ((found.pixel_px < 0.0) | (found.pixel_px > image_size_px)).any(axis=1)
        if outside.any():
            i = int(np.argmax(outside))
            x, y = found.pixel_px[i]
            raise InputError(
                f"{where}: control point {i + 1} ({x:g}, {y:g} px) lies outside the picture of "
                f"{image_size_px[0]} x {image_size_px[1]} px"
            )
    return found
