"""Pictures of the harbour, as its camera would take them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sightline.simulation.boats import Boat, Shape, to_world
from sightline.simulation.harbour import Gull, Harbour, Pile
from sightline.simulation.scenery import (
    Image,
    Light,
    backdrop,
    noise_tile,
    pixel_rays,
    sample_tile,
    vignette,
)
from sightline.simulation.sea import Sea
from sightline.simulation.shore import painted
from sightline.types import BoolArray, FloatArray, IntArray

_HAZE = np.array([196.0, 200.0, 200.0])
_HAZE_RANGE_M = 4500.0
_FOAM = np.array([226.0, 230.0, 228.0])
_SUBPIXEL_BITS = 4
_TRAIL_S = 16.0
_FOAM_PIXELS_PER_M = 5.0
_FULL_GRAIN = 200.0


@dataclass(frozen=True)
class Look:
    """What is drawn besides the solids.

    Attributes:
        wakes: Foam behind the boats.
        reflections: Boats mirrored in the water.
        sensor_noise: The camera's own.
    """

    wakes: bool = True
    reflections: bool = True
    sensor_noise: bool = True


class Renderer:
    """Paints a harbour; what does not move is painted once, the sea a few seconds long."""

    def __init__(self, harbour: Harbour, look: Look | None = None) -> None:
        """Prepare sky, shore, sea and posts.

        Args:
            harbour: What to paint.
            look: Absent: everything.
        """
        self._harbour = harbour
        self._camera = harbour.camera
        self._look = look if look is not None else Look()
        rng = np.random.default_rng([harbour.seed, 4])
        self._light = Light.random(rng, self._camera)
        rays = pixel_rays(self._camera)
        near = None
        if harbour.shore is not None:
            near = painted(harbour.shore, self._camera, harbour.seed)
        above, cover = backdrop(rng, self._camera, self._light, rays, near)
        self._shading = vignette(self._camera, rays)
        self._still: Image = np.clip(above * self._shading, 0.0, 255.0).astype(np.uint8)
        self._sea = Sea(rng, self._camera, self._light, rays, above, cover, self._shading)
        foam = sample_tile(
            noise_tile(rng, 256, 0.8),
            self._sea.right_m * _FOAM_PIXELS_PER_M,
            self._sea.ahead_m * _FOAM_PIXELS_PER_M,
        )
        grain = np.clip(0.85 + 0.35 * foam, 0.25, 1.25) * _FULL_GRAIN
        self._foam = _u8(np.repeat(grain[..., None], 4, axis=2))
        self._noise = [
            np.clip(rng.normal(4.0, 1.6, self._still.shape), 0.0, 9.0).astype(np.uint8)
            for _ in range(3)
        ]
        self._models = {boat.identity: _Model(boat.shape) for boat in harbour.boats}
        self._posts = [self._post(rng, pile) for pile in harbour.piles]

    def image(self, time_utc_s: float) -> Image:
        """The picture at a time: (H, W, 3) uint8, blue, green, red.

        The same time gives the same picture.
        """
        time_s = time_utc_s - self._harbour.start_utc_s
        picture = np.concatenate([self._still[: self._sea.top_row], self._sea.at(time_s)])
        things: list[tuple[float, Boat | Gull]] = [
            (float(np.hypot(*boat.path.at([time_s])[0])), boat) for boat in self._harbour.boats
        ]
        for gull in self._harbour.gulls:
            place, _ = gull.at(time_s)
            things.append((float(np.hypot(place[0], place[1])), gull))
        things.sort(key=lambda thing: -thing[0])
        if self._look.wakes:
            for _, thing in things:
                if isinstance(thing, Boat) and thing.path.moves:
                    self._draw_wake(picture, thing, time_s)
        for distance, thing in things:
            if isinstance(thing, Gull):
                self._draw_gull(picture, thing, time_s, distance)
                continue
            if self._look.reflections:
                self._draw_boat(picture, thing, time_s, distance, mirrored=True)
            self._draw_boat(picture, thing, time_s, distance)
        for post in self._posts:
            post.blend_into(picture)
        if not self._look.sensor_noise:
            return picture
        shown = int(np.floor(time_s * 1000.0))
        return _u8(cv2.add(picture, self._noise[shown % len(self._noise)]))

    def _draw_boat(
        self,
        picture: Image,
        boat: Boat,
        time_s: float,
        distance_m: float,
        *,
        mirrored: bool = False,
    ) -> None:
        model = self._models[boat.identity]
        corners = to_world(model.corners_m, boat.path, np.array([time_s]))[0]
        pixels = self._camera.project(corners * ([1.0, 1.0, -1.0] if mirrored else 1.0))
        if not np.isfinite(pixels).all():
            return
        size = float(np.ptp(pixels, axis=0).max())
        if mirrored and size < 22.0:
            return
        fineness = 4 if size < 70.0 else 3 if size < 160.0 else 2
        layer = _Layer(pixels, self._camera.image_size_px, 1 if mirrored else fineness)
        if layer.empty:
            return
        # The mirror image is what a camera as far below the water would see.
        eye = np.array([0.0, 0.0, self._camera.height_m * (-1.0 if mirrored else 1.0)])
        course = float(np.radians(boat.path.course_deg([time_s])[0]))
        visible, light, order = model.lit(corners, eye, course, self._light.direction)
        haze = 1.0 - np.exp(-distance_m / _HAZE_RANGE_M)
        shading = self._shading_at(pixels)
        colours = model.colours * light[:, None]
        colours = (colours + haze * (_HAZE - colours)) * shading
        values = np.column_stack([colours.clip(0.0, 255.0), np.full(len(colours), 255.0)]).tolist()
        points = layer.place(pixels)
        for i in order:
            if visible[i]:
                layer.fill(points[model.faces[i]], values[i])
        if mirrored:
            layer.ripple(time_s, opacity=0.24)
        layer.blend_into(picture)

    def _draw_wake(self, picture: Image, boat: Boat, time_s: float) -> None:
        age = _TRAIL_S * np.linspace(0.0, 1.0, 18) ** 1.5
        place = boat.path.at(time_s - age)
        velocity = boat.path.velocity(time_s - age)
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        along = velocity / np.maximum(speed, 1e-6)[:, None]
        across = np.stack([along[:, 1], -along[:, 0]], axis=-1)
        # The trail starts at the stern, not at the antenna.
        place = place - along * 0.46 * boat.shape.length_m
        shape = boat.shape
        half = 0.34 * shape.beam_m + 0.13 * age * np.minimum(speed, 6.0) / 4.0
        strength = shape.wake * np.clip((speed - 0.8) / 4.5, 0.0, 1.0)
        if strength[0] < 0.04:
            return
        foam = 0.95 * strength * (0.65 * np.exp(-age / 2.5) + 0.35 * np.exp(-age / 10.0))
        arm = 0.5 * shape.beam_m + 0.30 * speed * age
        crest = 0.35 * strength * np.exp(-age / 5.0)
        thick = 0.10 * shape.beam_m + 0.05 * age
        strips = [(-half, half, foam), (arm, arm + thick, crest), (-arm - thick, -arm, crest)]
        # (strips, left and right, ages, 3)
        edges = np.zeros((3, 2, age.size, 3))
        for i, (left, right, _) in enumerate(strips):
            edges[i, 0, :, :2] = place + across * left[:, None]
            edges[i, 1, :, :2] = place + across * right[:, None]
        pixels = self._camera.project(edges)
        if not np.isfinite(pixels).all():
            return
        layer = _Layer(pixels.reshape(-1, 2), self._camera.image_size_px, 1)
        if layer.empty:
            return
        left, right = pixels[:, 0], pixels[:, 1]
        quads = np.stack([left[:, :-1], right[:, :-1], right[:, 1:], left[:, 1:]], axis=2)
        opacity = np.stack([strip[2][:-1] for strip in strips])
        # Polygons cover a pixel at least; thinner ones must be fainter instead.
        opacity = opacity * np.minimum(_thickness(quads), 1.0) * self._shading_at(pixels[0, 0])
        values = (opacity[..., None] * np.append(_FOAM, 255.0)).tolist()
        points = layer.place(quads)
        for j in range(age.size - 2, -1, -1):
            for i in range(3):
                layer.fill(points[i, j], values[i][j])
        layer.soften()
        top = self._sea.top_row
        rows, columns = layer.window
        below = slice(max(rows.start - top, 0), max(rows.stop - top, 0))
        layer.grain(self._foam[below, columns])
        layer.blend_into(picture)

    def _draw_gull(self, picture: Image, gull: Gull, time_s: float, distance_m: float) -> None:
        place, course = gull.at(time_s)
        ahead = np.array([np.sin(course), np.cos(course), 0.0])
        right = np.array([np.cos(course), -np.sin(course), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        span = gull.span_m
        if gull.radius_m > 0.0:
            beat = np.sin(2.0 * np.pi * (2.6 * time_s + gull.phase))
            tip, bend = 0.34 * span * beat * up, 0.10 * span * (1.0 + 0.5 * beat) * up
            solids = [
                (
                    _GULL_WHITE,
                    [
                        0.22 * span * ahead,
                        0.05 * span * right,
                        -0.2 * span * ahead,
                        -0.05 * span * right,
                    ],
                ),
            ]
            for side in (-1.0, 1.0):
                wrist = side * 0.25 * span * right + bend
                end = side * 0.5 * span * right + bend + tip - 0.08 * span * ahead
                root = 0.09 * span * ahead
                solids.append((_GULL_GREY, [root, wrist + root, wrist - 0.5 * root, -root]))
                solids.append((_GULL_GREY, [wrist + root, end, wrist - 0.5 * root]))
                solids.append(
                    (
                        _GULL_BLACK,
                        [
                            0.3 * (wrist + root) + 0.7 * end,
                            end,
                            0.3 * (wrist - 0.5 * root) + 0.7 * end,
                        ],
                    )
                )
        else:
            body = [
                0.5 * span * ahead + 0.1 * up,
                0.2 * span * ahead + 0.22 * up,
                -0.5 * span * ahead + 0.2 * up,
                -0.3 * span * ahead,
                0.35 * span * ahead,
            ]
            head = [
                0.5 * span * ahead + 0.12 * up,
                0.5 * span * ahead + 0.34 * up,
                0.24 * span * ahead + 0.34 * up,
                0.24 * span * ahead + 0.12 * up,
            ]
            solids = [(_GULL_GREY, body), (_GULL_WHITE, head)]
        corners = np.concatenate([np.stack(points) for _, points in solids])
        pixels = self._camera.project(place + corners)
        ends = np.cumsum([len(points) for _, points in solids])
        if not np.isfinite(pixels).all():
            return
        layer = _Layer(pixels, self._camera.image_size_px, 6)
        if layer.empty:
            return
        haze = 1.0 - np.exp(-distance_m / _HAZE_RANGE_M)
        shading = self._shading_at(pixels)
        for (colour, _), outline in zip(solids, np.split(pixels, ends[:-1]), strict=True):
            layer.polygon(outline, (colour + haze * (_HAZE - colour)) * shading)
        layer.blend_into(picture)

    def _post(self, rng: np.random.Generator, pile: Pile) -> _Layer:
        """A round wooden post: weathered sides with a wet foot, and a lighter head."""
        angle = np.linspace(0.0, 2.0 * np.pi, 73)
        axis = np.array([pile.east_m, pile.north_m])
        outward = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        levels = np.linspace(0.0, pile.top_m, 40)
        rim = axis + pile.radius_m * outward
        rings = np.stack([np.column_stack([rim, np.full(angle.size, z)]) for z in levels])
        pixels = self._camera.project(rings)
        seen = pixels[np.isfinite(pixels).all(axis=-1)]
        size = self._camera.image_size_px
        layer = _Layer(seen if len(seen) else np.zeros((1, 2)), size, 3)
        if layer.empty:
            return layer
        facing = -(outward @ axis) / np.hypot(*axis)
        grain = np.cumsum(rng.normal(0.0, 1.0, angle.size))
        grain = (grain - grain.mean()) / grain.std()
        sun = np.clip(outward @ self._light.direction[:2], 0.0, 1.0)
        for i in range(angle.size - 1):
            if facing[i] <= -0.08:
                continue
            for j in range(levels.size - 1):
                quad = np.stack(
                    [pixels[j, i], pixels[j, i + 1], pixels[j + 1, i + 1], pixels[j + 1, i]]
                )
                if not np.isfinite(quad).all():
                    continue
                light = 0.5 + 0.35 * sun[i] + 0.15 * max(facing[i], 0.0) + 0.06 * grain[i]
                light += float(rng.normal(0.0, 0.025))
                wet = 0.5 if levels[j] < 0.5 else 0.62 if levels[j] < 0.8 else 1.0
                layer.polygon(quad, np.array([70.0, 78.0, 88.0]) * light * wet)
        head = pixels[-1]
        if np.isfinite(head).all() and self._camera.height_m > pile.top_m:
            middle = head.mean(axis=0)
            layer.polygon(head, np.array([92.0, 100.0, 108.0]))
            for ring in (0.72, 0.66, 0.38, 0.34):
                shade = 1.0 if ring in (0.66, 0.34) else 0.86
                layer.polygon(
                    middle + ring * (head - middle), np.array([92.0, 100.0, 108.0]) * shade
                )
        return layer

    def _shading_at(self, pixels: FloatArray) -> float:
        height, width = self._still.shape[:2]
        x, y = np.clip(pixels.mean(axis=0), 0.0, [width - 1.0, height - 1.0]).astype(int)
        return float(self._shading[y, x, 0])


_GULL_WHITE = np.array([236.0, 238.0, 238.0])
_GULL_GREY = np.array([196.0, 196.0, 192.0])
_GULL_BLACK = np.array([60.0, 60.0, 60.0])


class _Model:
    """The faces of a shape, laid out for drawing."""

    def __init__(self, shape: Shape) -> None:
        counts = [len(face.corners_m) for face in shape.faces]
        ends = np.cumsum(counts, dtype=np.int64)
        self.corners_m = np.concatenate([face.corners_m for face in shape.faces])
        self.faces = [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]
        self._counts = np.array(counts, dtype=np.int64)
        self._starts: IntArray = ends - self._counts
        self.colours = np.array([face.colour for face in shape.faces], dtype=float)
        self._normals = np.stack([face.normal for face in shape.faces])
        self._two_sided = np.array([face.two_sided for face in shape.faces])
        self._hull = np.array([face.hull for face in shape.faces])

    def lit(
        self, corners_enu_m: FloatArray, eye: FloatArray, course_rad: float, sun: FloatArray
    ) -> tuple[BoolArray, FloatArray, list[int]]:
        """Which faces are seen, how bright they are, and the order in which to paint them."""
        centres = np.add.reduceat(corners_enu_m, self._starts, axis=0) / self._counts[:, None]
        x, y, z = self._normals.T
        cos, sin = np.cos(course_rad), np.sin(course_rad)
        normals = np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=-1)
        towards = eye - centres
        facing = np.einsum("ij,ij->i", normals, towards)
        sunlit = normals @ sun
        sunlit = np.where(self._two_sided, np.abs(sunlit), np.maximum(sunlit, 0.0))
        light = 0.66 + 0.10 * np.maximum(z, 0.0) + 0.38 * sunlit
        distance = np.linalg.norm(towards, axis=1)
        order = np.lexsort((-distance, ~self._hull))
        return (facing > 0.0) | self._two_sided, light, order.tolist()


class _Layer:
    """A small picture with opacity, painted finer than the image and then laid on it."""

    def __init__(
        self, pixels: FloatArray, image_size_px: tuple[int, int], scale: int, margin_px: int = 2
    ) -> None:
        size = np.array(image_size_px)
        # Clipped before they become integers: near the edge of the lens pixels lie very far out.
        low = (np.floor(pixels.min(axis=0)) - margin_px).clip(0, size).astype(int)
        high = (np.ceil(pixels.max(axis=0)) + margin_px).clip(0, size).astype(int)
        self.empty = bool((high <= low).any())
        self.window = (slice(low[1], high[1]), slice(low[0], high[0]))
        self._origin = low
        self._scale = scale
        width, height = np.maximum(high - low, 0)
        # Premultiplied: blue, green, red and opacity, 0 to 255.
        self._canvas = np.zeros((height * scale, width * scale, 4), np.uint8)

    def place(self, pixels: FloatArray) -> NDArray[np.int32]:
        """Pixels of the image as OpenCV's fixed-point coordinates on the canvas, any shape."""
        fine = ((pixels - self._origin) * self._scale - 0.5) * 2.0**_SUBPIXEL_BITS
        # Far outside the canvas is as good as a little outside, and fits OpenCV's integers.
        return np.asarray(np.rint(fine).clip(-(2**24), 2**24), dtype=np.int32)

    def fill(self, points: NDArray[np.int32], value: list[float]) -> None:
        """A filled polygon from `place`, in a premultiplied blue, green, red and opacity."""
        cv2.fillPoly(self._canvas, [points], value, cv2.LINE_8, _SUBPIXEL_BITS)

    def polygon(self, pixels: FloatArray, colour: FloatArray) -> None:
        """An opaque polygon."""
        self.fill(self.place(pixels), [*colour.clip(0.0, 255.0).tolist(), 255.0])

    def soften(self) -> None:
        """Blur by about a pixel."""
        self._canvas = _u8(cv2.GaussianBlur(self._canvas, (3, 3), 0.8))

    def grain(self, factor: Image) -> None:
        """Multiply the lower rows by a texture, in shares of `_FULL_GRAIN`."""
        rows = factor.shape[0]
        part = self._canvas[self._canvas.shape[0] - rows :]
        part[:] = cv2.multiply(part, factor, scale=1.0 / _FULL_GRAIN)

    def ripple(self, time_s: float, opacity: float) -> None:
        """Break the picture up as moving water does, and let it fade downwards."""
        height, width = self._canvas.shape[:2]
        rows, columns = np.arange(height, dtype=np.float32), np.arange(width, dtype=np.float32)
        fine = rows / self._scale
        sway = (
            (0.8 + 0.07 * fine)
            * self._scale
            * (np.sin(1.7 * fine + 5.1 * time_s) + 0.6 * np.sin(0.63 * fine - 3.3 * time_s))
        )
        moved = cv2.remap(
            self._canvas,
            (columns[None, :] + sway[:, None]).astype(np.float32),
            np.repeat(rows[:, None], width, axis=1),
            cv2.INTER_LINEAR,
        )
        fade = opacity * np.linspace(1.0, 0.25, height, dtype=np.float32)
        self._canvas = _u8(moved * fade[:, None, None])

    def blend_into(self, picture: Image) -> None:
        """Lay it on the image."""
        if self.empty:
            return
        region = picture[self.window]
        layer = self._canvas
        if self._scale > 1:
            size = region.shape[1], region.shape[0]
            layer = _u8(cv2.resize(layer, size, interpolation=cv2.INTER_AREA))
        # cv2 on small pictures is several times faster than the same in NumPy.
        covered = cv2.cvtColor(cv2.bitwise_not(layer[..., 3]), cv2.COLOR_GRAY2BGR)
        behind = cv2.multiply(region, covered, scale=1.0 / 255.0)
        region[:] = cv2.add(behind, layer[..., :3])


def _u8(image: ArrayLike) -> Image:
    return np.asarray(image).astype(np.uint8, copy=False)


def _thickness(quads: FloatArray) -> FloatArray:
    """Area of quadrilaterals (..., 4, 2) by half their girth, px."""
    sides = np.roll(quads, -1, axis=-2) - quads
    one = quads[..., 2, :] - quads[..., 0, :]
    other = quads[..., 3, :] - quads[..., 1, :]
    area = 0.5 * np.abs(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])
    girth = np.hypot(sides[..., 0], sides[..., 1]).sum(axis=-1)
    return np.asarray(2.0 * area / np.maximum(girth, 1e-9))
