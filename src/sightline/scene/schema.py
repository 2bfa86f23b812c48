"""The schema of a scene file: which keys there are, and what each may hold."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import (
    AliasChoices,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from sightline.configuration import Table, UtcTime, checked, read_toml
from sightline.errors import InputError, no_scene_file

# Whole metres are stated, and of either side.
_HULL_SHARE, _HULL_M = 0.05, 1.5
# A picture that is cut out of a larger one may lie far from the axis, but not so far.
_FARTHEST_PX = 1e5

Latitude = Annotated[float, Field(ge=-90.0, le=90.0)]


Longitude = Annotated[float, Field(ge=-180.0, le=180.0)]


Pixels = Annotated[int, Field(gt=0)]


Metres = Annotated[float, Field(gt=0.0, le=600.0)]


Aboard = Annotated[float, Field(ge=0.0, le=600.0)]


STATED = {
    "height_m": (0.01, 9000.0, "metres above the water or the road", "12.0, 0.5"),
    # A model without a fisheye's projection sees less than half of all around.
    "horizontal_fov_deg": (0.1, 170.0, "degrees from edge to edge", "62.0, 2.0"),
    "focal_px": (10.0, 1e6, "pixels", "940.0, 20.0"),
    "heading_deg": (-360.0, 360.0, "degrees clockwise from north", "215.0, 3.0"),
    "pitch_deg": (-90.0, 90.0, "degrees below the horizontal", "4.0, 1.0"),
    "roll_deg": (-90.0, 90.0, "degrees, positive where the right end is lower", "0.5, 0.5"),
    # Sight lines bend with the water by up to all of its curvature, and away from it by its half.
    "effective_earth_radius_m": (3e6, 1e12, "metres, 7.43e6 as a rule", "7.4e6, 5e5"),
}
"""What may be stated of a camera: between which values, in what, and an example."""


class CameraTable(Table):
    """`[camera]`."""

    name: str = ""
    latitude_deg: Latitude | None = None
    longitude_deg: Longitude | None = None
    image_size_px: Annotated[list[Pixels], Field(min_length=2, max_length=2)] | None = None
    area: str | list[str] | None = None
    mask: str | None = None
    compensate_rotation: bool = Field(
        default=True, validation_alias=AliasChoices("compensate_rotation", "watched")
    )
    height_m: float | list[float] | None = None
    horizontal_fov_deg: float | list[float] | None = None
    focal_px: float | list[float] | None = None
    heading_deg: float | list[float] | None = None
    pitch_deg: float | list[float] | None = None
    roll_deg: float | list[float] | None = None
    principal_point_px: list[float] | None = None
    effective_earth_radius_m: float | list[float] | None = None

    @field_validator(*STATED)
    @classmethod
    def _of_a_camera(
        cls, given: float | list[float] | None, info: ValidationInfo
    ) -> float | list[float] | None:
        if given is None:
            return None
        low, high, unit, example = STATED[info.field_name or ""]
        values = given if isinstance(given, list) else [given]
        if isinstance(given, list) and (len(given) != 2 or not 0.0 < given[1] <= high):
            raise ValueError(
                f"give {unit}, or that and its standard deviation, [{example}]; it is {given!r}"
            )
        if not low < values[0] < high:
            raise ValueError(f"give {unit}, between {low:g} and {high:g}; it is {values[0]:g}")
        return given

    @field_validator("area")
    @classmethod
    def _of_files(cls, given: str | list[str] | None) -> str | list[str] | None:
        if given is not None and not (given and all(given)):
            raise ValueError("give a GeoJSON file of polygons, or a list of such files")
        return given

    @field_validator("principal_point_px")
    @classmethod
    def _of_a_lens(cls, given: list[float] | None) -> list[float] | None:
        if given is None:
            return None
        usable = len(given) in (2, 3) and max(map(abs, given)) < _FARTHEST_PX
        if not usable or (len(given) == 3 and not given[2] > 0.0):
            raise ValueError(
                "give the column and the row of the optical axis, px, or these and their standard "
                f"deviation, [640, 360, 20]; it is {given!r}"
            )
        return given

    @model_validator(mode="after")
    def _one_focal_length(self) -> Self:
        if self.horizontal_fov_deg is not None and self.focal_px is not None:
            raise ValueError("give horizontal_fov_deg or focal_px, not both")
        return self

    @model_validator(mode="after")
    def _whole_place(self) -> Self:
        if (self.latitude_deg is None) != (self.longitude_deg is None):
            raise ValueError("give both latitude_deg and longitude_deg, or neither")
        return self


class DetectionTable(Table):
    """`[detection]`: how detectors look at the frames."""

    views: str | None = None
    enlarge: float | None = None
    frame_width_px: Pixels | None = None
    budget_ms: float | None = None


class RecordingTable(Table):
    """One of `[[recordings]]`."""

    name: Annotated[str, Field(min_length=1)]
    video: str | None = None
    frames: str | None = None
    start_utc: UtcTime | None = None
    clock: str | None = None
    boxes: str | None = None
    detections: str | None = None
    fixes: str | None = None
    mmsi: int | None = None
    platform: str | None = None
    horizon: str | None = None
    water_level_m: float | None = None
    water_levels: str | None = None
    clock_offset_s: float | list[float] | None = None
    length_m: Metres | None = None
    beam_m: Metres | None = None
    antenna_m: Annotated[list[Aboard], Field(min_length=4, max_length=4)] | None = None

    @field_validator("name")
    @classmethod
    def _of_a_file(cls, value: str) -> str:
        if any(letter in "/\\" or not letter.isprintable() for letter in value):
            raise ValueError(
                f"{value!r} holds / or \\ or what cannot be printed, and files are named after it"
            )
        return value

    @field_validator("clock_offset_s")
    @classmethod
    def _of_a_clock(cls, value: float | list[float] | None) -> float | list[float] | None:
        if isinstance(value, list) and (len(value) != 2 or not value[1] > 0.0):
            raise ValueError(
                "give the seconds by which the camera's clock is ahead of the log's, or these and "
                f"their standard deviation, [40.0, 2.0]; it is {value!r}"
            )
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
        self._check_hull()
        if self.platform is not None and (self.water_level_m is not None or self.water_levels):
            raise ValueError("a platform floats with the water; leave its level away")
        if self.frames is None and self.video is None and not (self.boxes or self.detections):
            raise ValueError("give a video, frames, boxes or detections; there is nothing to see")
        return self

    def _check_hull(self) -> None:
        """Raise ValueError where what is stated of the hull cannot be true together."""
        stated = (self.length_m, self.beam_m, self.antenna_m)
        if self.fixes is None and any(one is not None for one in stated):
            raise ValueError(
                "length_m, beam_m and antenna_m are of the vessel that fixes names; give fixes"
            )
        if self.antenna_m is None:
            return
        bow, stern, port, starboard = self.antenna_m
        for key, given, both in (
            ("length_m", self.length_m, bow + stern),
            ("beam_m", self.beam_m, port + starboard),
        ):
            if given is not None and abs(given - both) > _HULL_SHARE * given + _HULL_M:
                raise ValueError(
                    f"antenna_m is metres to bow, stern, port and starboard, which make {key} "
                    f"{both:g}; it is {given:g}"
                )


class PointTable(Table):
    """One of `[[control_points]]`."""

    pixel_px: Annotated[list[float], Field(min_length=2, max_length=2)]
    latitude_deg: Latitude
    longitude_deg: Longitude


class SceneTable(Table):
    """A whole scene file."""

    camera: CameraTable = CameraTable()
    recordings: list[RecordingTable] = Field(default_factory=list)
    control_points: list[PointTable] | str = Field(default_factory=list)
    detection: DetectionTable = DetectionTable()

    @model_validator(mode="after")
    def _something_to_learn_from(self) -> Self:
        if not self.recordings and not self.control_points:
            raise ValueError("give [[recordings]] or [[control_points]]; the scene is empty")
        return self


def parse_scene_table(path: Path) -> SceneTable:
    """Read the tables of a scene file.

    Raises:
        InputError: There is no such file, it is no TOML, or a key or a value cannot stand there.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; expected a scene file, as {path / 'scene.toml'}")
    try:
        content = read_toml(path, "scene file")
    except FileNotFoundError as error:
        raise no_scene_file(path) from error
    return checked(path, content, SceneTable)
