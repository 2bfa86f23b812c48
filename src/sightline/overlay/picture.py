"""A frame with what was found drawn into it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sightline.camera.pinhole import Camera
from sightline.errors import InputError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.overlay.inset import InsetMap, all_places
from sightline.overlay.style import (
    GREY,
    WHITE,
    Colour,
    Image,
    box_outline,
    colour_of,
    dot,
    drawable,
    length_text,
    line,
    plate,
    scale_of,
    text_size_px,
    write,
)
from sightline.overlay.targets import BoxBook, Target, Targets, box_of_each
from sightline.overlay.water_view import (
    WaterView,
    ellipse_outline,
    grid_spacing_m,
)
from sightline.platform import POSITION_SIGMA_M
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.types import Boxes, Fixes, FloatArray, Frame, IntArray, Track, ellipses, rfc3339
from sightline.video.mask import GREY as GREY_MASK
from sightline.video.mask import Mask
from sightline.water import WaterLevels

_LEAST_CONFIDENCE = 0.4
_LAYER_OPACITY = 0.7
_GRID: Colour = (233, 200, 140)
_KNOTS_PER_MPS = 3600.0 / 1852.0


@dataclass(frozen=True)
class OverlaySettings:
    """What is drawn.

    Attributes:
        trail_s: For how long the way behind a target is drawn; 0: none.
        rings: Whether circles about the camera are drawn on the water.
        grid: Whether lines of equal east and of equal north are.
        horizon: Whether the horizon is.
        inset: Whether there is a map in the corner.
        labels: Whether names, positions and the time are written.
        fixes_sigma_m: How far off the log is, a standard deviation along either axis; None: as the
            model knows it.
        clock_offset_s: How far the times of frames are ahead of those of tracks and log.
    """

    trail_s: float = 60.0
    rings: bool = False
    grid: bool = False
    horizon: bool = True
    inset: bool = True
    labels: bool = True
    fixes_sigma_m: float | None = None
    clock_offset_s: float = 0.0


@dataclass(frozen=True)
class Found:
    """What was found in a video, each part optional.

    Attributes:
        tracks: In the plane of the model.
        boxes: Of the frames; they need no track ids.
        fixes: The log of a vessel.
        water: How high the water stands, where the model knows of that.
        mask: What is not to be seen of the pictures.
    """

    tracks: Sequence[Track] = ()
    boxes: Boxes | None = None
    fixes: Fixes | None = None
    water: WaterLevels | None = None
    mask: Mask | None = None


_Layer = tuple[IntArray, NDArray[np.float32], NDArray[np.float32]]
"""Rows of the flat picture that are painted, (N,); the paint, (N, 3), as much as there is of it;
and how much is left of the picture, (N, 1)."""


@dataclass
class _Labels:
    """Texts of a frame, of which none lies on another."""

    taken: list[tuple[float, float, float, float]] = field(default_factory=list)

    def place(self, left: float, top: float, right: float, bottom: float) -> bool:
        """Whether there is room; then it is taken."""
        for x1, y1, x2, y2 in self.taken:
            if left < x2 and x1 < right and top < y2 and y1 < bottom:
                return False
        self.taken.append((left, top, right, bottom))
        return True


class Overlay:
    """Draws what was found into the frames of a video, which come in the order of time."""

    def __init__(
        self, model: Georeferencer, found: Found, settings: OverlaySettings | None = None
    ) -> None:
        """Take the model and what was found.

        Args:
            model: With a camera that stands still.
            found: In the video.
            settings: What is drawn.

        Raises:
            InputError: The model has no camera, or one that moves; or water levels are missing,
                or of no use.
        """
        self._camera = still_camera(model)
        model.check_water(found.water is not None)
        self._model, self._found = model, found
        self._settings = settings or OverlaySettings()
        self._scale = scale_of(model.image_size_px[1])
        self._targets = Targets(found.tracks)
        self._boxes = None if found.boxes is None else BoxBook(found.boxes)
        self._log = None
        if found.fixes is not None:
            self._log = ReferenceTrajectory.of(found.fixes, model.plane)
        self._fixes_sigma_m = self._settings.fixes_sigma_m or fixes_sigma_of(model)
        self._key: tuple[float, ...] = ()
        self._view = WaterView.of(self._camera)
        self._layer: _Layer | None = None
        self._trails: dict[int, FloatArray] = {}
        self._map = self._inset()

    @property
    def view(self) -> WaterView:
        """The water as it was seen in the last frame."""
        return self._view

    @property
    def inset(self) -> InsetMap | None:
        """The map in the corner; None where there is none."""
        return self._map

    def drawn(self, frame: Frame, rotation_rad: FloatArray | None = None) -> Image:
        """A copy of a frame with all that was found at its time.

        Args:
            frame: With its time, by the camera's clock.
            rotation_rad: (3,) rotation vector by which the camera's scene has turned since the
                model's; NaN, or None, where that is not known.
        """
        time_utc_s = frame.time_utc_s - self._settings.clock_offset_s
        image = frame.image_bgr.copy()
        self._look(time_utc_s, rotation_rad)
        if self._found.mask is not None:
            self._found.mask.check_size((image.shape[1], image.shape[0]), "the video")
            image[self._found.mask.hidden] = GREY_MASK
        self._draw_layer(image)
        labels = _Labels()
        if self._map is not None:
            self._map.begin()
            labels.taken.append(self._map.bounds_px)
        self._draw_targets(image, frame, time_utc_s, labels)
        self._draw_log(image, time_utc_s, labels)
        if self._map is not None:
            self._map.put_on(image)
        if self._settings.labels:
            stamp = rfc3339(time_utc_s).replace("T", " ").replace("Z", " UTC")
            wide, tall = text_size_px(stamp, 1.1 * self._scale)
            plate(image, 6, 6, 14 + wide, 12 + tall)
            write(image, stamp, 10, 4 + tall, WHITE, 1.1 * self._scale)
        return image

    def _inset(self) -> InsetMap | None:
        if not self._settings.inset:
            return None
        places = [np.stack([track.east_m, track.north_m], axis=1) for track in self._targets.tracks]
        if self._log is not None:
            times = self._log.time_utc_s
            ends = [(track.time_utc_s[0], track.time_utc_s[-1]) for track in self._targets.tracks]
            first, last = (min(e[0] for e in ends), max(e[1] for e in ends)) if ends else (0, 0)
            places.append(self._log.east_north_m[(times >= first) & (times <= last)])
        made = InsetMap(self._view, self._model.image_size_px, all_places(places), self._scale)
        return made if made.fits else None

    def _look(self, time_utc_s: float, rotation_rad: FloatArray | None) -> None:
        """Take in how the camera lies and how high the water stands."""
        rotation = np.zeros(3) if rotation_rad is None else rotation_rad
        above_m = 0.0
        if self._found.water is not None:
            level_m = self._found.water.at(np.array([time_utc_s]))
            above_m = round(float(np.ravel(self._model.above_m(level_m))[0]), 2)
        key = (above_m, *np.nan_to_num(rotation).tolist())
        if key != self._key:
            self._key = key
            self._view = WaterView.of(self._camera, above_m, rotation)
            self._layer = self._water_layer()
            self._trails = {}

    def _water_layer(self) -> _Layer | None:
        """Rings, grid and horizon."""
        settings = self._settings
        width, height = self._model.image_size_px
        if not (settings.rings or settings.grid or settings.horizon):
            return None
        paint = np.zeros((height, width, 3), dtype=np.uint8)
        rings = self._view.rings()
        if settings.grid and rings:
            reach_m = rings[-1][0]
            for one in self._view.grid(reach_m, grid_spacing_m(reach_m)):
                line(paint, one, _GRID, halo=False)
        if settings.rings:
            for radius_m, ring in rings:
                line(paint, ring, WHITE, halo=False)
                self._write_radius(paint, radius_m, ring)
        if settings.horizon:
            line(paint, self._view.horizon_px(), colour_of(2), halo=False, dashed=True)
        flat = paint.reshape(-1, 3)
        rows = np.flatnonzero(flat.any(axis=1))
        # The smooth edge of a line on black is its colour times the share of the pixel.
        chosen = flat[rows].astype(np.float32) * _LAYER_OPACITY
        return rows, chosen, 1.0 - chosen.max(axis=1, keepdims=True) / 255.0

    def _write_radius(self, paint: Image, radius_m: float, ring: FloatArray) -> None:
        width, height = self._model.image_size_px
        column = 0.06 * width
        inside = np.isfinite(ring).all(axis=1)
        if not inside.any():
            return
        near = int(np.nanargmin(np.where(inside, np.abs(ring[:, 0] - column), np.nan)))
        x, y = ring[near]
        if 0.0 <= x < width and 0.0 <= y < height:
            write(paint, length_text(radius_m), x, y - 3, WHITE, 0.8 * self._scale)

    def _draw_layer(self, image: Image) -> None:
        if self._layer is None:
            return
        rows, paint, left = self._layer
        flat = image.reshape(-1, 3)
        flat[rows] = (flat[rows] * left + paint).astype(np.uint8)

    def _draw_log(self, image: Image, time_utc_s: float, labels: _Labels) -> None:
        """Draw where the log says that its vessel was, with its ellipse."""
        if self._log is None:
            return
        now = self._log.at(np.array([time_utc_s]))
        place = now.east_north_m[0]
        if not np.isfinite(place).all():
            return
        sigma_m = float(np.hypot(self._fixes_sigma_m, now.sigma_m[0]))
        outline = ellipse_outline(place, sigma_m**2 * np.eye(2))
        name = drawable(self._log.name) or "log"
        line(image, self._view.pixels(outline), WHITE, dashed=True)
        at = self._view.pixels(place)[0]
        if np.isfinite(at).all():
            arm = 6.0 * self._scale
            for step in ([arm, arm], [arm, -arm]):
                line(image, np.array([at - step, at + step]), WHITE)
        if self._map is not None:
            self._map.target(place, outline, "", WHITE)
        self._label(image, [name], _around(at, 8.0 * self._scale), WHITE, labels)

    def _draw_targets(self, image: Image, frame: Frame, time_utc_s: float, labels: _Labels) -> None:
        targets = self._targets.at(time_utc_s)
        places = np.array([target.east_north_m for target in targets]).reshape(-1, 2)
        feet = self._view.pixels(places)
        boxes = Boxes.of(np.empty((0, 4)))
        if self._boxes is not None:
            boxes = self._boxes.at(frame.index, frame.time_utc_s)
        numbers = [target.track.track_id for target in targets]
        rows, free = box_of_each(feet, boxes, numbers, self._scale)
        for xyxy_px in boxes.xyxy_px[free & (boxes.confidence >= _LEAST_CONFIDENCE)]:
            line(image, box_outline(xyxy_px), GREY)
        thick = max(round(1.6 * self._scale), 2)
        for target, foot, row in zip(targets, feet, rows, strict=True):
            paint = _colour(target)
            self._draw_trail(image, target, time_utc_s)
            outline = ellipse_outline(target.east_north_m, target.covariance_m2)
            shape = self._view.pixels(outline)
            line(image, shape, paint, thickness=thick, halo=False, dashed=not target.measured)
            if row is not None:
                line(image, box_outline(boxes.xyxy_px[row]), paint, thickness=thick)
            dot(image, foot, paint, 2.5 * self._scale)
            if self._map is not None:
                name = "" if target.track.never_moves else str(target.track.track_id)
                self._map.target(target.east_north_m, outline, name, paint)
        # What moves is written first, and what lies near before what lies far.
        order = sorted(
            range(len(targets)), key=lambda i: (targets[i].track.never_moves, -feet[i, 1])
        )
        about = [
            _around(foot, 6.0 * self._scale) if row is None else boxes.xyxy_px[row]
            for foot, row in zip(feet, rows, strict=True)
        ]
        labels.taken += [tuple(box) for box in boxes.xyxy_px.tolist()]
        for i in order:
            self._label(image, self._texts(targets[i]), about[i], _colour(targets[i]), labels)

    def _draw_trail(self, image: Image, target: Target, time_utc_s: float) -> None:
        if not self._settings.trail_s > 0.0 or target.track.never_moves:
            return
        track = target.track
        if target.index not in self._trails:
            places = np.stack([track.east_m, track.north_m], axis=1)
            self._trails[target.index] = self._view.pixels(places)
        begin = np.searchsorted(track.time_utc_s, time_utc_s - self._settings.trail_s)
        end = np.searchsorted(track.time_utc_s, time_utc_s)
        now = target.east_north_m[None]
        seen = np.concatenate([self._trails[target.index][begin:end], self._view.pixels(now)])
        line(image, seen, _colour(target), halo=False)
        if self._map is not None:
            way = np.stack([track.east_m[begin:end], track.north_m[begin:end]], axis=1)
            self._map.way(np.concatenate([way, now]), _colour(target))

    def _texts(self, target: Target) -> list[str]:
        """Lines that say who a target is and where."""
        track = target.track
        name = f"{track.track_id} {drawable(track.label)}".strip()
        if track.never_moves:
            return [name]
        latitude, longitude = self._model.plane.to_geographic(*target.east_north_m[:, None])
        place = (
            f"{abs(float(latitude[0])):.5f}{'N' if latitude[0] >= 0 else 'S'} "
            f"{abs(float(longitude[0])):.5f}{'E' if longitude[0] >= 0 else 'W'}"
        )
        camera = self._view.camera
        range_m = float(np.hypot(*(target.east_north_m - [camera.east_m, camera.north_m])))
        far = f"{range_m:.0f} m"
        axis = float(ellipses(target.covariance_m2[None]).semi_major_m[0])
        if np.isfinite(axis):
            far += f" +-{axis:.1f} m"
        return [name, place, f"{far}, {target.speed_mps * _KNOTS_PER_MPS:.1f} kn"]

    def _label(
        self, image: Image, texts: list[str], about: FloatArray, colour: Colour, labels: _Labels
    ) -> None:
        """Write lines above, below or beside a box; only the first where there is no more room.

        Args:
            image: Is drawn into.
            texts: The lines.
            about: (4,) corners of the box.
            colour: Of the texts.
            labels: That are there already.
        """
        height, width = image.shape[:2]
        x1, y1, x2, y2 = about
        inside = np.isfinite(about).all() and x1 < width and x2 > 0.0 and y1 < height and y2 > 0.0
        if not (self._settings.labels and inside):
            return
        scale, gap = 0.9 * self._scale, 4.0 * self._scale
        step = text_size_px("Ag", scale)[1] + 2.0
        for lines in (texts, texts[:1]):
            wide = max(text_size_px(text, scale)[0] for text in lines)
            tall = step * len(lines)
            for left, top in (
                (x1, y1 - gap - tall),
                (x2 + 2.0 * gap, y1),
                (x1 - gap - wide, y1),
                (x1, y2 + gap),
            ):
                left = float(np.clip(left, 2.0, max(width - wide - 2.0, 2.0)))
                top = float(np.clip(top, 2.0, max(height - tall - 2.0, 2.0)))
                if labels.place(left - 2.0, top, left + wide + 2.0, top + tall):
                    plate(image, left - 2.0, top, left + wide + 2.0, top + tall)
                    side = np.array([[left - 3.0, top], [left - 3.0, top + tall]])
                    line(image, side, colour, thickness=3, halo=False)
                    for i, text in enumerate(lines, 1):
                        write(image, text, left, top + i * step - 4.0, WHITE, scale)
                    return


def fixes_sigma_of(model: Georeferencer) -> float:
    """Standard deviation of a log along either axis, as the model knows it, metres."""
    return model.reference_sigma_m or POSITION_SIGMA_M


def still_camera(model: Georeferencer) -> Camera:
    """The camera of a model, with which places are projected into pictures.

    Raises:
        InputError: It has none, or one on a platform that moves.
    """
    if model.moving:
        raise InputError(
            "the model is of a camera on a platform that moves, and places are drawn into the "
            "pictures of a camera that stands still alone; draw the tracks on a map instead"
        )
    if model.camera is None:
        raise InputError(
            f"the model {model.model} knows no camera, so nothing says where a place lies in the "
            "picture; fit one of camera or camera+gpr"
        )
    return model.camera


def _colour(target: Target) -> Colour:
    return GREY if target.track.never_moves else colour_of(target.track.track_id)


def _around(point_px: FloatArray, reach_px: float) -> FloatArray:
    return np.concatenate([point_px - reach_px, point_px + reach_px])
