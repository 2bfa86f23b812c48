"""A shore that distracts: a quay with sheds and cranes, houses on a slope, trees, parked cars.

It lies in an arc around the camera, behind the water that boats are on. What stands there has a
place and a size in metres, so that the boxes that a detector takes for boats by mistake are known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sightline.simulation.camera import SimulatedCamera
from sightline.simulation.scenery import Image32, Panorama, hazy, noise_tile, random_profile
from sightline.types import FloatArray

Kind = Literal["house", "block", "shed", "crane", "tree", "car"]

_ROWS_M = (130.0, 95.0, 62.0, 34.0)
"""How far behind the quay the rows of houses stand."""
_SLOPE = 0.10
_HAZE_RANGE_M = 4500.0
_WALLS = [
    (222, 228, 232),
    (196, 214, 226),
    (150, 188, 216),
    (128, 150, 200),
    (206, 204, 196),
    (110, 120, 150),
]
_ROOFS = [(70, 78, 140), (62, 74, 118), (84, 84, 92), (60, 64, 72), (96, 104, 150)]
_SHEDS = [(188, 192, 196), (150, 126, 84), (96, 110, 160), (170, 176, 166), (214, 216, 214)]
_CARS = [(40, 40, 44), (200, 202, 206), (60, 50, 160), (150, 100, 50), (230, 232, 234)]
_LEAVES = [(46, 84, 62), (38, 70, 58), (56, 100, 78), (44, 92, 88)]
_PANE = (112, 98, 84)
_HIGHEST_DEG = 12.0


@dataclass(frozen=True)
class Feature:
    """Something that stands on the shore.

    Attributes:
        kind: What it is.
        bearing_deg: Of its middle, from the camera, clockwise from north.
        range_m: From the camera.
        ground_m: Height of the ground that it stands on, above the water.
        width_m: Across the line of sight.
        height_m: Of its top above the ground.
        look: A number from which its colours are drawn.
    """

    kind: Kind
    bearing_deg: float
    range_m: float
    ground_m: float
    width_m: float
    height_m: float
    look: int

    def outline_enu_m(self) -> FloatArray:
        """(4, 3) metres, the corners that the camera sees: feet and tops at either side."""
        half = np.degrees(0.5 * self.width_m / self.range_m)
        bearing = np.radians(self.bearing_deg + np.array([-half, half, half, -half]))
        up = self.ground_m + np.array([0.0, 0.0, self.height_m, self.height_m])
        east, north = self.range_m * np.sin(bearing), self.range_m * np.cos(bearing)
        return np.stack([east, north, up], axis=1)

    def part_enu_m(self) -> FloatArray:
        """(4, 3) metres, the part that is taken for a boat: the roof, or the top of a crane."""
        corners = self.outline_enu_m()
        share = {"house": 0.5, "block": 0.75, "shed": 0.3, "crane": 0.6}.get(self.kind, 0.0)
        corners[:2, 2] += share * self.height_m
        return corners


@dataclass(frozen=True, eq=False)
class Shore:
    """A shore behind the water.

    Attributes:
        range_m: Of the edge of the quay, all around the camera.
        quay_m: Height of the quay above the water.
        features: What stands on it, the furthest first.
    """

    range_m: float
    quay_m: float
    features: tuple[Feature, ...]

    @classmethod
    def random(cls, rng: np.random.Generator, camera: SimulatedCamera) -> Shore:
        """A town with a port, across the water of a camera.

        Args:
            rng: Where the randomness comes from.
            camera: That looks at it.
        """
        range_m = float(rng.uniform(240.0, 400.0))
        quay_m = float(rng.uniform(1.2, 2.2))
        builder = _Town(rng, camera, range_m, quay_m)
        builder.rows()
        builder.port()
        builder.quay()
        ordered = sorted(builder.features, key=lambda one: -one.range_m)
        return cls(range_m, quay_m, tuple(ordered))


class _Town:
    """Draws what stands on a shore."""

    def __init__(
        self, rng: np.random.Generator, camera: SimulatedCamera, range_m: float, quay_m: float
    ) -> None:
        self._rng = rng
        self._range_m, self._quay_m = range_m, quay_m
        self._first_deg = camera.heading_deg - 0.5 * camera.field_of_view_deg - 4.0
        self._last_deg = camera.heading_deg + 0.5 * camera.field_of_view_deg + 4.0
        self.features: list[Feature] = []

    def rows(self) -> None:
        """Houses on the slope, with trees between them."""
        rng = self._rng
        for behind_m in _ROWS_M:
            bearing = self._first_deg
            while bearing < self._last_deg:
                kind: Kind = "house"
                drawn = rng.random()
                if drawn < 0.32:
                    kind, wide, high = "tree", rng.uniform(4.0, 9.0), rng.uniform(5.0, 11.0)
                elif drawn < 0.42:
                    kind, wide, high = "block", rng.uniform(12.0, 26.0), rng.uniform(9.0, 17.0)
                else:
                    wide, high = rng.uniform(7.0, 15.0), rng.uniform(5.5, 9.0)
                bearing += self._add(kind, bearing, behind_m, float(wide), float(high))
                bearing += self._degrees(float(rng.uniform(-1.0, 5.0)), behind_m)

    def port(self) -> None:
        """Sheds and cranes in a part of the quay."""
        rng = self._rng
        middle = float(rng.uniform(0.25, 0.75))
        span = self._last_deg - self._first_deg
        for _ in range(7):
            at = self._first_deg + span * float(np.clip(rng.normal(middle, 0.10), 0.0, 0.97))
            size = float(rng.uniform(14.0, 34.0)), float(rng.uniform(5.0, 9.0))
            self._add("shed", at, 12.0 + float(rng.uniform(0.0, 6.0)), *size)
        for _ in range(int(rng.integers(2, 4))):
            at = self._first_deg + span * float(np.clip(rng.normal(middle, 0.14), 0.03, 0.97))
            self._add(
                "crane", at, 5.0, float(rng.uniform(9.0, 13.0)), float(rng.uniform(20.0, 32.0))
            )

    def quay(self) -> None:
        """Trees along the quay, and cars."""
        rng = self._rng
        for kind, count in (("tree", 26), ("car", 34)):
            for _ in range(count):
                at = float(rng.uniform(self._first_deg, self._last_deg))
                if kind == "tree":
                    size = float(rng.uniform(3.0, 6.0)), float(rng.uniform(4.0, 7.5))
                    self._add("tree", at, float(rng.uniform(8.0, 11.0)), *size)
                else:
                    wide = float(rng.uniform(1.8, 4.6))
                    self._add("car", at, 4.0, wide, float(rng.uniform(1.4, 2.0)))

    def _degrees(self, metres: float, behind_m: float) -> float:
        return float(np.degrees(metres / (self._range_m + behind_m)))

    def _add(
        self, kind: Kind, left_deg: float, behind_m: float, wide_m: float, high_m: float
    ) -> float:
        """Add a feature to the right of a bearing; returns how many degrees it takes."""
        wide_deg = self._degrees(wide_m, behind_m)
        self.features.append(
            Feature(
                kind=kind,
                bearing_deg=left_deg + 0.5 * wide_deg,
                range_m=self._range_m + behind_m,
                ground_m=self._quay_m + _SLOPE * max(behind_m - 20.0, 0.0),
                width_m=wide_m,
                height_m=high_m,
                look=int(self._rng.integers(2**31)),
            )
        )
        return wide_deg


def painted(shore: Shore, camera: SimulatedCamera, seed: int) -> Panorama:
    """The shore as a panorama: premultiplied colour and opacity.

    Args:
        shore: What stands there.
        camera: Above whose heading the middle of the panorama is.
        seed: Of its grain.
    """
    rng = np.random.default_rng([seed, 12])
    lowest_deg = -np.degrees(np.arctan(camera.height_m / shore.range_m)) - 0.2
    painting = Panorama.around(camera, lowest_deg, _HIGHEST_DEG)
    painter = _Painter(painting, camera, shore, noise_tile(rng, 256, 0.8))
    painter.slope(rng)
    for feature in shore.features:
        painter.draw(feature)
    painter.wall(rng)
    return painting


class _Painter:
    """Paints features into a panorama."""

    def __init__(
        self, painting: Panorama, camera: SimulatedCamera, shore: Shore, grain: Image32
    ) -> None:
        self._painting, self._camera, self._shore = painting, camera, shore
        self._grain = grain

    def _row(self, up_m: float, range_m: float) -> int:
        elevation = np.degrees(np.arctan((up_m - self._camera.height_m) / range_m))
        return int(self._painting.row(float(elevation)))

    def _elevation(self, up_m: FloatArray | float, range_m: float) -> FloatArray:
        up = np.asarray(up_m, dtype=float) - self._camera.height_m
        return np.degrees(np.arctan(up / range_m))

    def _colour(self, colour: tuple[int, int, int], range_m: float) -> FloatArray:
        return hazy(colour, 1.0 - float(np.exp(-range_m / _HAZE_RANGE_M)))

    def slope(self, rng: np.random.Generator) -> None:
        """Woods on the hill behind, and the ground that rises to them."""
        width, edge = self._painting.layer.shape[1], self._shore.range_m
        top_m = self._shore.quay_m + _SLOPE * 130.0
        far = edge + 150.0
        ground = np.full(width, float(self._elevation(self._shore.quay_m, edge)))
        crown_m = top_m + 9.0 + 3.5 * random_profile(rng, width, 420.0, 5)
        crown_m = crown_m + 1.2 * np.abs(random_profile(rng, width, 26.0, 3))
        woods = self._elevation(np.maximum(crown_m, top_m + 2.0), far)
        self._painting.fill(woods, ground, self._colour((52, 82, 66), far), 1.6 * self._grain)
        green = np.full(width, float(self._elevation(top_m, far)))
        self._painting.fill(green, ground, self._colour((92, 134, 118), edge), 1.2 * self._grain)

    def wall(self, rng: np.random.Generator) -> None:
        """The wall of the quay: stone with a wet foot, tyres and ladders."""
        width, edge = self._painting.layer.shape[1], self._shore.range_m
        top = np.full(width, float(self._elevation(self._shore.quay_m, edge)))
        foot = np.full(width, float(self._elevation(0.0, edge)))
        wet = np.full(width, float(self._elevation(0.45, edge)))
        self._painting.fill(top, foot, self._colour((128, 138, 144), edge), 0.8 * self._grain)
        self._painting.fill(wet, foot, self._colour((58, 66, 66), edge), 0.8 * self._grain)
        for column in range(0, width, int(rng.integers(36, 60))):
            upper = self._row(self._shore.quay_m - 0.3, edge)
            lower = self._row(self._shore.quay_m - 0.9, edge)
            self._painting.rectangle(
                column, column + 5, upper, lower, self._colour((34, 34, 36), edge)
            )

    def draw(self, feature: Feature) -> None:
        """Paint one feature."""
        left, right = self._columns(feature)
        foot = self._row(feature.ground_m, feature.range_m)
        draw = {
            "house": self._house,
            "block": self._block,
            "shed": self._shed,
            "crane": self._crane,
            "tree": self._tree,
            "car": self._car,
        }[feature.kind]
        draw(feature, np.random.default_rng(feature.look), left, right, foot)

    def _columns(self, feature: Feature) -> tuple[int, int]:
        half = np.degrees(0.5 * feature.width_m / feature.range_m)
        off = (feature.bearing_deg - self._camera.heading_deg + 180.0) % 360.0 - 180.0
        left, right = (self._painting.column(off + side * half) for side in (-1.0, 1.0))
        return left, max(right, left + 1)

    def _up(self, feature: Feature, metres: float) -> int:
        return self._row(feature.ground_m + metres, feature.range_m)

    def _picked(
        self, rng: np.random.Generator, colours: list[tuple[int, int, int]], range_m: float
    ) -> FloatArray:
        chosen = colours[int(rng.integers(len(colours)))]
        return self._colour(chosen, range_m) * float(rng.uniform(0.88, 1.05))

    def _windows(
        self, feature: Feature, left: int, right: int, foot: int, top: int, storey_m: float
    ) -> None:
        scale = (right - left) / feature.width_m
        pane = self._colour(_PANE, feature.range_m)
        wide, apart = max(round(1.1 * scale), 2), max(round(2.6 * scale), 4)
        up = (foot - top) / max(feature.height_m, 1.0)
        rows = np.arange(foot - 0.9 * up, top + 1.2 * up, -storey_m * up)
        for row in rows.astype(int).tolist():
            for column in range(left + apart // 2, right - wide, apart):
                high = max(round(1.3 * up), 2)
                self._painting.rectangle(column, column + wide, row - high, row, pane)

    def _house(
        self, feature: Feature, rng: np.random.Generator, left: int, right: int, foot: int
    ) -> None:
        wall = self._picked(rng, _WALLS, feature.range_m)
        roof = self._picked(rng, _ROOFS, feature.range_m)
        eaves, ridge = (
            self._up(feature, 0.58 * feature.height_m),
            self._up(feature, feature.height_m),
        )
        self._painting.rectangle(left, right, eaves, foot, wall)
        side = left + (right - left) * 2 // 3
        gable = rng.random() < 0.4
        self._painting.rectangle(side, right, eaves, foot, 0.84 * wall)
        self._windows(feature, left, right, foot, eaves, 2.9)
        over = max((right - left) // 20, 1)
        if gable:
            middle = (left + right) // 2
            corners = [(left - over, eaves), (right + over, eaves), (middle, ridge)]
            self._painting.polygon(corners, wall)
            self._painting.line(corners[0], corners[2], roof, max(over, 2))
            self._painting.line(corners[1], corners[2], 0.8 * roof, max(over, 2))
        else:
            inset = (right - left) // 7
            self._painting.polygon(
                [
                    (left - over, eaves),
                    (right + over, eaves),
                    (right - inset, ridge),
                    (left + inset, ridge),
                ],
                roof,
            )
        stack = left + int((right - left) * rng.uniform(0.25, 0.7))
        self._painting.rectangle(stack, stack + 4, ridge - 6, ridge + 2, 0.7 * roof)

    def _block(
        self, feature: Feature, rng: np.random.Generator, left: int, right: int, foot: int
    ) -> None:
        wall, top = self._picked(rng, _WALLS, feature.range_m), self._up(feature, feature.height_m)
        self._painting.rectangle(left, right, top, foot, wall)
        self._painting.rectangle(left + 3 * (right - left) // 4, right, top, foot, 0.82 * wall)
        self._windows(feature, left, right, foot, top, 3.0)
        self._painting.rectangle(left - 1, right + 1, top - 2, top + 1, 0.7 * wall)

    def _shed(
        self, feature: Feature, rng: np.random.Generator, left: int, right: int, foot: int
    ) -> None:
        wall = self._picked(rng, _SHEDS, feature.range_m)
        eaves, ridge = (
            self._up(feature, 0.78 * feature.height_m),
            self._up(feature, feature.height_m),
        )
        self._painting.rectangle(left, right, eaves, foot, wall)
        for column in range(left, right, 6):
            self._painting.rectangle(column, column + 1, eaves, foot, 0.93 * wall)
        middle = (left + right) // 2
        self._painting.polygon([(left, eaves), (right, eaves), (middle, ridge)], 0.86 * wall)
        door = (right - left) // 5
        self._painting.rectangle(
            middle - door,
            middle + door,
            self._up(feature, 0.55 * feature.height_m),
            foot,
            0.62 * wall,
        )

    def _crane(
        self, feature: Feature, rng: np.random.Generator, left: int, right: int, foot: int
    ) -> None:
        colours = [(60, 110, 190), (120, 90, 50), (70, 130, 150), (140, 140, 146)]
        colour = self._picked(rng, colours, feature.range_m)
        portal, head = (
            self._up(feature, 0.32 * feature.height_m),
            self._up(feature, feature.height_m),
        )
        thick = max((right - left) // 14, 2)
        for column in (left, right - thick):
            self._painting.rectangle(column, column + thick, portal, foot, colour)
        self._painting.rectangle(left, right, portal - 2 * thick, portal, colour)
        middle = (left + right) // 2
        cab = self._up(feature, 0.5 * feature.height_m)
        self._painting.rectangle(middle - 2 * thick, middle + 2 * thick, cab, portal, 0.9 * colour)
        self._painting.rectangle(
            middle, middle + thick, cab + 2, cab + 8, self._colour(_PANE, 300.0)
        )
        side = 1 if rng.random() < 0.5 else -1
        tip = (middle + side * 2 * (right - left), head)
        mast = (middle, self._up(feature, 0.75 * feature.height_m))
        for start, end in (
            ((middle - thick, cab), tip),
            ((middle + thick, cab), tip),
            ((middle, cab), mast),
            (mast, tip),
        ):
            self._painting.line(start, end, colour, 2)
        self._painting.line(tip, (tip[0], portal - 10), 0.6 * colour, 1)

    def _tree(
        self, feature: Feature, rng: np.random.Generator, left: int, right: int, foot: int
    ) -> None:
        leaves = self._picked(rng, _LEAVES, feature.range_m)
        top, wide = self._up(feature, feature.height_m), right - left
        middle = (left + right) // 2
        trunk = max(wide // 10, 1)
        self._painting.rectangle(
            middle - trunk, middle + trunk, foot - (foot - top) // 3, foot, 0.5 * leaves
        )
        for _ in range(26):
            angle, off = rng.uniform(0.0, 2.0 * np.pi), np.sqrt(rng.random())
            column = middle + int(0.4 * wide * off * np.cos(angle))
            row = (
                (top + foot) // 2
                - (foot - top) // 10
                + int(0.3 * (foot - top) * off * np.sin(angle))
            )
            light = 0.8 + 0.35 * (foot - row) / max(foot - top, 1) + rng.normal(0.0, 0.06)
            size = max(int(0.16 * wide), 1), max(int(0.12 * (foot - top)), 1)
            self._painting.disc((column, row), size, leaves * float(light))

    def _car(
        self, feature: Feature, rng: np.random.Generator, left: int, right: int, foot: int
    ) -> None:
        paint = self._picked(rng, _CARS, feature.range_m)
        waist, top = self._up(feature, 0.55 * feature.height_m), self._up(feature, feature.height_m)
        inset = max((right - left) // 5, 1)
        self._painting.rectangle(
            left + inset, right - inset, top, waist, self._colour(_PANE, 300.0)
        )
        self._painting.rectangle(left, right, waist, foot - 1, paint)
