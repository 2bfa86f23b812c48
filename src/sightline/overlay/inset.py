"""The map in the corner: north up, with the camera, what it sees, and a scale."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from sightline.overlay.style import (
    WHITE,
    Colour,
    Image,
    dot,
    length_text,
    line,
    nice_length,
    text_size_px,
    write,
)
from sightline.overlay.water_view import WaterView
from sightline.types import FloatArray

_SHARE = 0.40
_MARGIN_PX = 10
_EDGE = 0.10
_LAND: Colour = (74, 58, 44)
_SEEN: Colour = (110, 88, 66)
_OPACITY = 0.82
_LEAST_SPAN_M = 40.0


class InsetMap:
    """A map that holds all of the tracks, drawn over the upper right corner of a picture."""

    def __init__(
        self, view: WaterView, size_px: tuple[int, int], places_m: FloatArray, scale: float
    ) -> None:
        """Draw what stays: the camera and what it looks at, north, the scale.

        Args:
            view: Of the camera.
            size_px: Width and height of the picture.
            places_m: (N, 2) all that the map is to hold, in the plane of the model.
            scale: Of texts.
        """
        self._scale = scale
        self._side = max(int(_SHARE * min(size_px)), 24)
        self._left, self._top = size_px[0] - self._side - _MARGIN_PX, _MARGIN_PX
        camera = np.array([[view.camera.east_m, view.camera.north_m]])
        places = np.concatenate([camera, places_m[np.isfinite(places_m).all(axis=1)]])
        if len(places) == 1:
            ahead = np.mean(view.edge_bearings_rad())
            places = np.concatenate(
                [places, camera + 500.0 * np.array([[np.sin(ahead), np.cos(ahead)]])]
            )
        low, high = places.min(axis=0), places.max(axis=0)
        span_m = max(float((high - low).max()), _LEAST_SPAN_M)
        self._middle = 0.5 * (low + high)
        self._px_per_m = self._side * (1.0 - 2.0 * _EDGE) / span_m
        self._ground = self._static(view)
        self._now = self._ground.copy()

    @property
    def fits(self) -> bool:
        """Whether the picture is large enough for it."""
        return self._left > 0 and self._side >= 96

    @property
    def bounds_px(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom edge in the picture."""
        return (
            float(self._left),
            float(self._top),
            float(self._left + self._side),
            float(self._top + self._side),
        )

    def to_map_px(self, east_north_m: FloatArray) -> FloatArray:
        """Pixels in the map of places, (N, 2)."""
        offset = (np.reshape(east_north_m, (-1, 2)) - self._middle) * self._px_per_m
        return np.asarray(0.5 * self._side + offset * [1.0, -1.0])

    def to_picture_px(self, east_north_m: FloatArray) -> FloatArray:
        """Pixels in the picture at which the map shows places, (N, 2)."""
        return np.asarray(self.to_map_px(east_north_m) + np.array([self._left, self._top]))

    def begin(self) -> None:
        """Take off what was drawn of the frame before."""
        np.copyto(self._now, self._ground)

    def way(self, east_north_m: FloatArray, colour: Colour) -> None:
        """Draw a way, (N, 2)."""
        line(self._now, self.to_map_px(east_north_m), colour, halo=False)

    def target(
        self, east_north_m: FloatArray, outline_m: FloatArray, name: str, colour: Colour
    ) -> None:
        """Draw a target: its place, (2,); its ellipse, (N, 2); and its name."""
        line(self._now, self.to_map_px(outline_m), colour, halo=False)
        at = self.to_map_px(east_north_m)[0]
        dot(self._now, at, colour, 2.2 * self._scale)
        if name and np.isfinite(at).all():
            small = 0.75 * self._scale
            write(self._now, name, at[0] + 5 * self._scale, at[1] - 3, colour, small)

    def put_on(self, image: Image) -> None:
        """Lay the map over a picture."""
        where = image[self._top : self._top + self._side, self._left : self._left + self._side]
        cv2.addWeighted(self._now, _OPACITY, where, 1.0 - _OPACITY, 0.0, dst=where)
        corners = [self._left - 1, self._top - 1], [self._left + self._side, self._top + self._side]
        cv2.rectangle(image, *corners, WHITE, 1)

    def _static(self, view: WaterView) -> Image:
        side, scale = self._side, self._scale
        ground = np.full((side, side, 3), _LAND, dtype=np.uint8)
        camera = np.array([view.camera.east_m, view.camera.north_m])
        left, right = view.edge_bearings_rad()
        bearings = np.linspace(left, left + (right - left) % (2.0 * np.pi), 33)
        far_m = 4.0 * side / self._px_per_m
        fan = camera + far_m * np.stack([np.sin(bearings), np.cos(bearings)], axis=1)
        corners = self.to_map_px(np.concatenate([camera[None], fan]))
        cv2.fillPoly(ground, [np.rint(corners).astype(np.int32)], _SEEN, cv2.LINE_AA)
        at = self.to_map_px(camera)[0]
        size = 5.0 * scale
        triangle = at + size * np.array([[0.0, -1.2], [1.0, 0.8], [-1.0, 0.8]])
        cv2.fillPoly(ground, [np.rint(triangle).astype(np.int32)], WHITE, cv2.LINE_AA)
        self._north(ground)
        length_m = nice_length(0.3 * side / self._px_per_m)
        length_px = length_m * self._px_per_m
        y = side - 9.0 * scale
        bar = np.array([[8.0, y - 4], [8.0, y], [8.0 + length_px, y], [8.0 + length_px, y - 4]])
        line(ground, bar, WHITE)
        write(ground, length_text(length_m), 10.0, y - 6.0 * scale, WHITE, 0.8 * scale)
        return ground

    def _north(self, ground: Image) -> None:
        scale, x = self._scale, self._side - 14.0 * self._scale
        tip, foot = 6.0 * scale, 26.0 * scale
        arrow = [[x, tip], [x + 5 * scale, foot], [x, foot - 5 * scale], [x - 5 * scale, foot]]
        cv2.fillPoly(ground, [np.rint(arrow).astype(np.int32)], WHITE, cv2.LINE_AA)
        width, height = text_size_px("N", 0.9 * scale)
        write(ground, "N", x - 0.5 * width, foot + height, WHITE, 0.9 * scale)


def all_places(parts: Iterable[FloatArray]) -> FloatArray:
    """(N, 2) places of several, one below the other."""
    return np.concatenate([np.empty((0, 2)), *parts])
