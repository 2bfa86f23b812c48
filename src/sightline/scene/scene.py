"""The scene file: camera, recordings and logs.

TOML, with paths relative to the file. The whole of it is checked when it is loaded, the files
that it names are opened when they are asked for.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from sightline import formats, video
from sightline.area import Area
from sightline.camera.stated import PICTURE_FOCAL_SHARE, SLOTS, StatedCamera, stated_camera
from sightline.clock import Clock, OffsetClock, presentation_clock
from sightline.clock_offset import STATED_SIGMA_S, ClockOffset, ClockPrior
from sightline.configuration import posix_s
from sightline.detection.onnx import DetectorOptions
from sightline.detection.tiling import TilingSettings
from sightline.errors import InputError, unknown_name
from sightline.geodesy import LocalPlane
from sightline.platform import Platform
from sightline.plausibility import check_near, check_together
from sightline.scene.hull import Hull
from sightline.scene.schema import (
    CameraTable,
    DetectionTable,
    PointTable,
    RecordingTable,
    parse_scene_table,
)
from sightline.tally import Tally
from sightline.types import Boxes, ControlPoints, Fixes, Frame, Horizons, check_inside
from sightline.video.mask import Mask, read_mask
from sightline.water import WaterLevels

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


_LONGEST_PATH = 400

MASKED = "boxes in what is masked"
"""The reason for which a `Tally` counts them."""


@dataclass(frozen=True)
class CameraSite:
    """Position of the camera, as far as it is known, and the size of its image.

    Attributes:
        name: Of the camera, or ``""``.
        latitude_deg: Degrees north; None if it is not known.
        longitude_deg: Degrees east; None if it is not known.
        image_size_px: Width and height; None where the scene file leaves that to the video.
        compensate_rotation: Whether camera rotation seen in the frames is compensated.
        stated: What else the scene file states of the camera.
        area_paths: GeoJSON files of polygons where targets can be; none: anywhere.
        mask_path: A picture that masks parts of the frames, or None.
    """

    name: str = ""
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    image_size_px: tuple[int, int] | None = None
    compensate_rotation: bool = True
    stated: StatedCamera = field(default_factory=StatedCamera)
    area_paths: tuple[Path, ...] = ()
    mask_path: Path | None = None

    @property
    def place_deg(self) -> tuple[float, float] | None:
        """Latitude and longitude; None where they are not known."""
        if self.latitude_deg is None or self.longitude_deg is None:
            return None
        return self.latitude_deg, self.longitude_deg


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
        platform_path: The log of the moving platform that the camera is on, or None.
        horizon_path: A table of the horizon in each frame, or None.
        water_level_m: Water level above the datum, or None.
        water_levels_path: A table of water levels, or None.
        image_size_px: Width and height of the picture where the scene file says it, or None.
        camera_place_deg: Latitude and longitude of the camera where the scene file says them.
        stated_hull: What is stated of the hull of the target that was logged.
        clock_offset_s: How far the camera's clock is taken to be ahead of the log's: it is taken
            off all times of frames and boxes, which are then in the log's time.
        clock_prior: What was believed of that offset before any data.
        clock_found: What boxes and log told of it; None where they were not asked.
        mask_path: A picture that masks parts of its frames, or None.
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
    camera_place_deg: tuple[float, float] | None = None
    stated_hull: Hull = field(default_factory=Hull)
    clock_offset_s: float = 0.0
    clock_prior: ClockPrior = field(default_factory=ClockPrior)
    clock_found: ClockOffset | None = None
    mask_path: Path | None = None

    def by_camera(self) -> Recording:
        """The same by the camera's own clock, whatever offset it has."""
        return self.with_clock(0.0)

    def with_clock(self, offset_s: float) -> Recording:
        """The same with the camera's clock so many seconds ahead of the log's."""
        return replace(self, clock_offset_s=offset_s)

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
        if self.clock_offset_s:
            return OffsetClock(self.by_camera().clock(), self.clock_offset_s)
        if self.clock_path is not None:
            return _clock(self.clock_path, self.clock_path.stat().st_mtime_ns)
        if self.video_path is not None:
            info = _video_info(self.video_path, self.video_path.stat().st_mtime_ns)
            start_s = self.start_utc_s if self.start_utc_s is not None else info.creation_utc_s
            if start_s is not None:
                return presentation_clock(start_s, info.presentation_s)
        raise InputError(
            f"recording {self.name}: nothing tells the times of its frames; give start_utc (with "
            "a video that has times), clock (a table frame,utc), or time_utc with the boxes"
        )

    def boxes(self) -> Boxes:
        """The boxes of the logged target, with their times.

        Raises:
            InputError: The recording has none, they cannot be used, lie wholly outside the
                picture, or have no times.
        """
        if self.boxes_path is None:
            raise InputError(f"recording {self.name}: has no boxes; give boxes = FILE")
        boxes = formats.read_boxes(self.boxes_path, image_size_px=self.image_size_px)
        return self._timed(boxes, self.boxes_path)

    def detections(self, *, tally: Tally | None = None) -> Boxes:
        """The boxes of anything, with their times.

        Boxes without an annotator get the file's name, less its ending, for their source. Boxes
        without width or height, which some detectors put out, are left out, and so are those that
        are masked.

        Args:
            tally: Told how many were masked.

        Raises:
            InputError: As `boxes`.
        """
        if self.detections_path is None:
            raise InputError(f"recording {self.name}: has no detections; give detections = FILE")
        path = self.detections_path
        boxes = formats.read_boxes(
            path, source=path.stem, skip_empty=True, image_size_px=self.image_size_px
        )
        return self.unmasked(self._timed(boxes, path), tally)

    def unmasked(self, boxes: Boxes, tally: Tally | None = None) -> Boxes:
        """Boxes without those that are masked; see `sightline.video.mask.Mask.hides`.

        Args:
            boxes: Of the recording.
            tally: Told how many were masked.

        Raises:
            InputError: The mask cannot be used.
        """
        mask = self.mask()
        if mask is None:
            return boxes
        if self.image_size_px is not None:
            mask.check_size(self.image_size_px, f"recording {self.name}")
        hidden = mask.hides(boxes)
        if tally is not None:
            tally.leave_out(MASKED, int(hidden.sum()))
        return boxes[~hidden]

    def mask(self) -> Mask | None:
        """Which pixels of the frames are masked; None where there is no mask.

        Raises:
            InputError: It cannot be used.
        """
        if self.mask_path is None:
            return None
        return _mask(self.mask_path, self.mask_path.stat().st_mtime_ns)

    def fixes(self) -> Fixes:
        """The log of the target, as fixes: of the middle of its hull, where that is known.

        Raises:
            InputError: The recording has none, it cannot be used, or all of it is so far from the
                camera that one of the two places is wrong.
        """
        if self.fixes_path is None:
            raise InputError(f"recording {self.name}: has no log; give fixes = FILE")
        if self.taught_by_tracks:
            raise InputError(
                f"{self.fixes_path}: is a file of tracks, and nobody says which is of the target; "
                "they teach sightline fit of a recording with detections and without boxes"
            )
        changed_ns = self.fixes_path.stat().st_mtime_ns
        fixes = _fixes(self.fixes_path, self.mmsi, self.stated_hull, changed_ns)
        if self.camera_place_deg is not None:
            check_near(fixes, *self.camera_place_deg, str(self.fixes_path), "the camera")
        return fixes

    def hull(self) -> Hull:
        """The hull of the target that was logged: as stated, else as its AIS tells.

        Raises:
            InputError: As `fixes`.
        """
        if self.fixes_path is None:
            return self.stated_hull
        changed_ns = self.fixes_path.stat().st_mtime_ns
        return self.stated_hull.completed(_log(self.fixes_path, self.mmsi, changed_ns)[1])

    def platform(self) -> Platform | None:
        """The platform that the camera is on; None where it is static.

        Raises:
            InputError: The log cannot be used.
        """
        if self.platform_path is None:
            return None
        return _platform(self.platform_path, self.platform_path.stat().st_mtime_ns)

    def water_levels(self) -> WaterLevels | None:
        """Water levels; None where none are given.

        Raises:
            InputError: The table cannot be used.
        """
        if self.water_level_m is not None:
            return WaterLevels.constant(self.water_level_m)
        if self.water_levels_path is None:
            return None
        return _water(self.water_levels_path, self.water_levels_path.stat().st_mtime_ns)

    def horizons(self) -> Horizons | None:
        """Horizons of the frames from their table; None where there is no table.

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

    @property
    def taught_by_tracks(self) -> bool:
        """Whether its log is the tracks of other cameras, with their covariances."""
        return (
            self.fixes_path is not None
            and self.mmsi is None
            and formats.holds_tracks(self.fixes_path)
        )

    def logs(self) -> tuple[formats.AisVessel, ...]:
        """The logs of whatever may be in view: of one target, or of all vessels of an AIS feed.

        An AIS log of which no vessel is chosen (``mmsi``) is a feed, and a file of tracks, of other
        cameras, one as well.

        Raises:
            InputError: The recording has none, or it cannot be used.
        """
        path = self.fixes_path
        # Fused tracks have MMSIs as well, of which tables of AIS are known.
        if path is not None and self.taught_by_tracks:
            return _track_logs(path, path.stat().st_mtime_ns)
        if path is not None and self.mmsi is None and formats.holds_ais(path):
            return _feed(path, path.stat().st_mtime_ns)
        fixes = self.fixes()
        return (formats.AisVessel(fixes, np.full((len(fixes), 2), np.nan)),)

    def is_feed(self) -> bool:
        """Whether the log is of many vessels, and which of them is the target is not said.

        Raises:
            InputError: As `logs`.
        """
        return self.fixes_path is not None and self.mmsi is None and len(self.logs()) > 1

    def frames(self, *, apart_s: float = 0.0) -> Iterator[Frame]:
        """The frames, one at a time, with their times; NaN where nothing tells them.

        What is masked is grey in them, whoever looks.

        Args:
            apart_s: Pictures that follow the one before them sooner are left out.

        Raises:
            InputError: The recording has none, they cannot be read, or the mask has another size.
        """
        mask = self.mask()
        frames = self._frames(apart_s)
        return frames if mask is None else mask.painted(frames, f"recording {self.name}")

    def _frames(self, apart_s: float) -> Iterator[Frame]:
        if self.source is None:
            raise InputError(f"recording {self.name}: has no pictures; give video or frames")
        if self.clock_path is not None:
            return video.frames(self.source, clock=self.clock(), apart_s=apart_s)
        frames = video.frames(self.source, start_utc_s=self.start_utc_s, apart_s=apart_s)
        if not self.clock_offset_s:
            return frames
        return (
            replace(frame, time_utc_s=frame.time_utc_s - self.clock_offset_s) for frame in frames
        )

    def _timed(self, boxes: Boxes, path: Path) -> Boxes:
        if self.image_size_px is not None:
            check_inside(boxes, self.image_size_px, f"{path}: ")
        unknown = ~np.isfinite(boxes.time_utc_s)
        if not unknown.any() and not self.clock_offset_s:
            return boxes
        time_utc_s = boxes.time_utc_s - self.clock_offset_s
        if not unknown.any():
            return boxes.with_columns(time_utc_s=time_utc_s)
        try:
            time_utc_s[unknown] = self.clock().time_utc_s(boxes.frame[unknown])
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        return boxes.with_columns(time_utc_s=time_utc_s)


@dataclass(frozen=True)
class Scene:
    """A camera and its recordings.

    Attributes:
        camera: Where it stands.
        recordings: In the order of the file.
        control_points: Pixels whose place is known; may be none.
        path: The scene file.
        looking: How a detector in an ONNX file looks at the frames, where nobody says otherwise.
    """

    camera: CameraSite
    recordings: tuple[Recording, ...]
    control_points: ControlPoints
    path: Path
    looking: DetectorOptions = field(default_factory=DetectorOptions)

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
        table = parse_scene_table(Path(path))
        base = Path(path).parent
        size = table.camera.image_size_px
        camera = CameraSite(
            name=table.camera.name,
            latitude_deg=table.camera.latitude_deg,
            longitude_deg=table.camera.longitude_deg,
            image_size_px=(size[0], size[1]) if size else None,
            compensate_rotation=table.camera.compensate_rotation,
            stated=stated_camera({key: getattr(table.camera, key) for key in SLOTS}),
            area_paths=tuple(base / name for name in _area_files(table.camera)),
            mask_path=None if table.camera.mask is None else base / table.camera.mask,
        )
        for key, written in _camera_files(table.camera):
            _check_there(Path(path), key, base / written, False)
        names = [recording.name for recording in table.recordings]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"{path}: two recordings are named {name!r}; names must differ")
        return cls(
            camera=camera,
            recordings=tuple(
                _recording(Path(path), base, i, recording, camera)
                for i, recording in enumerate(table.recordings)
            ),
            control_points=_control_points(
                Path(path), base, table.control_points, camera.image_size_px
            ),
            path=Path(path),
            looking=_looking(Path(path), table.detection),
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """The scene file, and all files and folders that it names."""
        named = [
            value
            for part in (self.camera, *self.recordings)
            for value in vars(part).values()
            if isinstance(value, Path)
        ]
        return (self.path, *dict.fromkeys([*self.camera.area_paths, *named]))

    def area(self) -> Area | None:
        """Where targets can be; None where the scene does not say.

        Raises:
            InputError: A file of it cannot be used.
        """
        paths = self.camera.area_paths
        if not paths:
            return None
        return _area(paths, tuple(path.stat().st_mtime_ns for path in paths))

    @property
    def plane(self) -> LocalPlane | None:
        """The local plane with the camera as its origin; None where its position is not known."""
        if self.camera.latitude_deg is None or self.camera.longitude_deg is None:
            return None
        return LocalPlane(self.camera.latitude_deg, self.camera.longitude_deg)

    @property
    def stated(self) -> StatedCamera:
        """What the scene file states of the camera, and the focal length that its pictures carry.

        Of pictures that were cut out of others, or of which the file states it, it is not asked.
        """
        stated = self.camera.stated
        cut = stated.principal_point_px is not None
        if stated.focal_px is not None or stated.horizontal_fov_deg is not None or cut:
            return stated
        for recording in self.recordings:
            if recording.frames_path is not None:
                changed_ns = recording.frames_path.stat().st_mtime_ns
                focal_px = _focal_length_px(recording.frames_path, changed_ns)
                if focal_px is not None:
                    sigma_px = PICTURE_FOCAL_SHARE * focal_px
                    return replace(stated, focal_px=(focal_px, sigma_px), focal_in_pictures=True)
        return stated

    @property
    def moves(self) -> bool:
        """Whether the camera is on a moving platform.

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
        """Whether the recordings have water levels.

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
        """Width and height of the image: as the scene file says, or of the first frame.

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
        """The recording with a name.

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

    def with_clocks(self, offset_s: Mapping[str, float]) -> Scene:
        """The scene with other clock offsets for some recordings.

        Args:
            offset_s: By recording, how far the camera's clock is ahead of the log's.
        """
        return replace(
            self,
            recordings=tuple(
                one.with_clock(offset_s.get(one.name, one.clock_offset_s))
                for one in self.recordings
            ),
        )

    def without(self, names: Iterable[str]) -> Scene:
        """The scene without the recordings of these names.

        Raises:
            InputError: A name is unknown.
        """
        left_out = {self[name].name for name in names}
        return replace(
            self, recordings=tuple(one for one in self.recordings if one.name not in left_out)
        )


def named_files(path: str | os.PathLike[str]) -> tuple[list[Path], list[str]]:
    """The files that a scene file names: those that are there, and a sentence on each other.

    Args:
        path: The scene file.

    Raises:
        InputError: It is missing itself, no TOML, or has a key or a value that cannot stand there.
    """
    table = parse_scene_table(Path(path))
    base = Path(path).parent
    named = [(key, written, False) for key, written in _camera_files(table.camera)]
    named += [
        (f"recordings[{i}].{key}", written, key == "frames")
        for i, recording in enumerate(table.recordings, start=1)
        for key in _FILES
        if (written := getattr(recording, key)) is not None
    ]
    if isinstance(table.control_points, str):
        named.append(("control_points", table.control_points, False))
    there: dict[Path, None] = {}
    missing = []
    for key, written, folder in named:
        try:
            _check_there(Path(path), key, base / written, folder)
            there[base / written] = None
        except InputError as error:
            missing.append(str(error))
    return list(there), missing


def _looking(scene: Path, table: DetectionTable) -> DetectorOptions:
    try:
        return DetectorOptions(
            views=None if table.views is None else TilingSettings(kind=table.views),
            enlarge=table.enlarge,
            frame_width_px=table.frame_width_px,
            budget_ms=table.budget_ms,
        )
    except InputError as error:
        raise InputError(f"{scene}: detection: {error}") from error


def _area_files(camera: CameraTable) -> list[str]:
    if camera.area is None:
        return []
    return [camera.area] if isinstance(camera.area, str) else camera.area


def _camera_files(camera: CameraTable) -> list[tuple[str, str]]:
    """The files that a camera names, with their keys."""
    masks = [] if camera.mask is None else [("camera.mask", camera.mask)]
    return [*(("camera.area", name) for name in _area_files(camera)), *masks]


@lru_cache(maxsize=8)
def _area(paths: tuple[Path, ...], _modified_ns: tuple[int, ...]) -> Area:
    return formats.read_area(paths)


@lru_cache(maxsize=8)
def _mask(path: Path, _modified_ns: int) -> Mask:
    return read_mask(path)


# Recordings share their logs, which are long.
@lru_cache(maxsize=32)
def _log(path: Path, mmsi: int | None, _modified_ns: int) -> tuple[Fixes, Hull]:
    """Fixes of an antenna, and what its AIS tells of the hull."""
    fixes = formats.read_fixes(path, mmsi=mmsi)
    told = None
    if fixes.name.isdecimal() and (mmsi is not None or formats.holds_ais(path)):
        told = formats.read_ais_dimensions(path, int(fixes.name))
    return fixes, Hull.of(None, None, told)


@lru_cache(maxsize=32)
def _fixes(path: Path, mmsi: int | None, stated: Hull, modified_ns: int) -> Fixes:
    fixes, told = _log(path, mmsi, modified_ns)
    return stated.completed(told).middle_of(fixes)


@lru_cache(maxsize=32)
def _platform(path: Path, _modified_ns: int) -> Platform:
    return Platform(formats.read_fixes(path), formats.read_headings(path))


@lru_cache(maxsize=32)
def _water(path: Path, _modified_ns: int) -> WaterLevels:
    return formats.read_water_levels(path)


@lru_cache(maxsize=8)
def _feed(path: Path, _modified_ns: int) -> tuple[formats.AisVessel, ...]:
    return tuple(formats.read_ais_feed(path).values())


@lru_cache(maxsize=8)
def _track_logs(path: Path, _modified_ns: int) -> tuple[formats.AisVessel, ...]:
    return formats.read_track_logs(path)


@lru_cache(maxsize=128)
def _clock(path: Path, _modified_ns: int) -> Clock:
    return formats.read_clock(path)


@lru_cache(maxsize=128)
def _video_info(path: Path, _modified_ns: int) -> video.VideoInfo:
    return video.video_info(path)


@lru_cache(maxsize=128)
def _focal_length_px(folder: Path, _modified_ns: int) -> float | None:
    try:
        first = next(iter(video.numbered_pictures(folder).values()))
    except InputError:
        return None
    return video.focal_length_px(first)


def _recording(
    scene: Path,
    base: Path,
    number: int,
    table: RecordingTable,
    camera: CameraSite,
) -> Recording:
    paths: dict[str, Path | None] = {}
    for key in _FILES:
        written = getattr(table, key)
        paths[f"{key}_path"] = None if written is None else base / written
        if written is not None:
            _check_there(scene, f"recordings[{number + 1}].{key}", base / written, key == "frames")
    clock = _stated_clock(table.clock_offset_s)
    return Recording(
        name=table.name,
        start_utc_s=posix_s(table.start_utc),
        mmsi=table.mmsi,
        water_level_m=table.water_level_m,
        image_size_px=camera.image_size_px,
        camera_place_deg=camera.place_deg,
        clock_offset_s=clock.mean_s,
        clock_prior=clock,
        clock_found=None,
        stated_hull=Hull.of(table.length_m, table.beam_m, table.antenna_m),
        mask_path=camera.mask_path,
        **paths,
    )


def _stated_clock(stated: float | list[float] | None) -> ClockPrior:
    if stated is None:
        return ClockPrior()
    mean_s, sigma_s = stated if isinstance(stated, list) else (stated, STATED_SIGMA_S)
    return ClockPrior(mean_s, sigma_s, stated=True)


def _check_there(scene: Path, key: str, path: Path, folder: bool) -> None:
    # os.path answers where pathlib raises: for a name that is too long, or a folder that is closed.
    if not os.path.exists(path):
        named = str(path)
        if len(named) > _LONGEST_PATH:
            named = f"{named[:_LONGEST_PATH]}..."
        raise InputError(f"{scene}: {key} names {named}, which does not exist")
    if os.path.isdir(path) != folder:
        raise InputError(
            f"{scene}: {key} names {path}, which is a {'file' if folder else 'folder'}; "
            f"expected a {'folder of FRAME.jpg' if folder else 'file'}"
        )


def _control_points(
    scene: Path,
    base: Path,
    points: list[PointTable] | str,
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
        names = [f"control point {number + 1}" for number in range(len(points))]
        check_together(found.latitude_deg, found.longitude_deg, names, where)
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
