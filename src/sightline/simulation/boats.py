"""The boats: simple solids of coloured faces, in metres about the place where the antenna is.

Boat axes: x to starboard, y to the bow, z up from the waterline. Parts that belong to the solid
stand on or above the water, so the box of a boat ends at the waterline nearest to the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.simulation.paths import Path
from sightline.types import FloatArray

Colour = tuple[int, int, int]
"""Blue, green, red, 0 to 255."""

_WHITE: Colour = (236, 238, 238)
_GLASS: Colour = (92, 74, 62)
_DARK: Colour = (70, 62, 58)


@dataclass(frozen=True, eq=False)
class Face:
    """A plane polygon of one colour.

    Attributes:
        corners_m: (K, 3) in boat axes.
        colour: As lit from straight ahead.
        two_sided: Sails are seen from behind too.
        hull: Whether it belongs to the hull, which everything else stands on.
    """

    corners_m: FloatArray
    colour: Colour
    two_sided: bool = False
    hull: bool = False

    @cached_property
    def normal(self) -> FloatArray:
        """(3,) unit vector that points out of the solid, in boat axes."""
        # Newell's sum holds for any plane polygon, also where two corners fall together.
        ahead = np.roll(self.corners_m, -1, axis=0)
        normal = np.cross(self.corners_m, ahead).sum(axis=0)
        return np.asarray(normal / np.linalg.norm(normal))


@dataclass(frozen=True, eq=False)
class Shape:
    """What a boat looks like.

    Attributes:
        kind: ``"motorboat"``, ``"sailboat"``, ``"ferry"`` or ``"dinghy"``.
        length_m: Of the hull.
        beam_m: Of the hull.
        faces: The solid.
        wake: How much foam it makes, 0 to 1.
    """

    kind: str
    length_m: float
    beam_m: float
    faces: tuple[Face, ...]
    wake: float

    @cached_property
    def points_m(self) -> FloatArray:
        """(V, 3) all corners of the solid, each once."""
        return np.unique(np.concatenate([face.corners_m for face in self.faces]), axis=0)


@dataclass(frozen=True, eq=False)
class Boat:
    """A shape on a path.

    Attributes:
        identity: Number of the boat in its harbour, from 1.
        name: As in its log.
        shape: What it looks like.
        path: Where it goes.
    """

    identity: int
    name: str
    shape: Shape
    path: Path

    def points_enu_m(self, time_s: FloatArray) -> FloatArray:
        """(N, V, 3) metres, the corners of the solid in the world at N times."""
        return to_world(self.shape.points_m, self.path, time_s)


def to_world(points_m: FloatArray, path: Path, time_s: FloatArray) -> FloatArray:
    """Points in boat axes, put where the boat is.

    Args:
        points_m: (V, 3) starboard, bow, up.
        path: Where the boat goes.
        time_s: (N,) seconds.

    Returns:
        (N, V, 3) metres east, north, up.
    """
    course = np.radians(path.course_deg(time_s))[:, None]
    place = path.at(time_s)
    x, y, z = points_m.T
    return np.stack(
        [
            place[:, :1] + np.cos(course) * x + np.sin(course) * y,
            place[:, 1:] - np.sin(course) * x + np.cos(course) * y,
            np.broadcast_to(z, (len(place), len(z))),
        ],
        axis=-1,
    )


def motorboat(rng: np.random.Generator, length_m: float | None = None) -> Shape:
    """A day cruiser of 5 to 12 m: hull, cabin with a windscreen, sometimes a flying bridge."""
    length = length_m if length_m is not None else float(rng.uniform(5.0, 12.0))
    beam = 0.36 * length if length < 8.0 else 0.31 * length
    freeboard = 0.13 * length
    hull = _pick(rng, [_WHITE, (228, 232, 230), (150, 96, 48), (84, 64, 50), (214, 214, 226)])
    faces = [*_hull(length, beam, freeboard, hull, (168, 190, 204))]
    roof = 1.0 + 0.08 * length
    faces += _cabin(0.62 * beam, -0.16 * length, 0.20 * length, freeboard, freeboard + roof)
    top = freeboard + roof
    if length > 7.5:
        faces += _block(0.5 * beam, -0.10 * length, 0.08 * length, top, top + 0.8, _WHITE)
        top += 0.8
    faces += _block(0.06, -0.05 * length, -0.05 * length + 0.06, top, top + 0.15 * length, _DARK)
    if length < 8.0:
        faces += _block(0.4, -0.53 * length, -0.47 * length, 0.0, freeboard + 0.35, _DARK)
    return Shape("motorboat", length, beam, tuple(faces), wake=1.0)


def sailboat(
    rng: np.random.Generator, length_m: float | None = None, *, sails: bool = True
) -> Shape:
    """A yacht of 7 to 14 m under main and jib, or with its main furled on the boom."""
    length = length_m if length_m is not None else float(rng.uniform(7.0, 14.0))
    beam, freeboard = 0.30 * length, 0.10 * length
    hull = _pick(rng, [_WHITE, (120, 80, 46), (60, 52, 48), (226, 230, 232)])
    sail = _pick(rng, [(232, 238, 240), (220, 228, 236), (88, 80, 76), (198, 214, 228)])
    mast = 1.30 * length
    y_mast, boom = 0.08 * length, 1.2 + freeboard
    faces = [*_hull(length, beam, freeboard, hull, (176, 196, 208))]
    faces += _cabin(0.5 * beam, -0.18 * length, 0.16 * length, freeboard, freeboard + 0.6)
    faces += _block(0.16, y_mast - 0.08, y_mast + 0.08, freeboard, mast, (150, 150, 152))
    # Sails belly to leeward: a little to one side of the keel line.
    side = 0.10 * length * (1.0 if rng.random() < 0.5 else -1.0)
    if not sails:
        faces += _block(0.3, -0.40 * length, y_mast, boom, boom + 0.3, (150, 110, 70))
        return Shape("sailboat", length, beam, tuple(faces), wake=0.12)
    faces += [
        Face(
            _corners((0, y_mast, boom), (side, -0.40 * length, boom), (0, y_mast, mast)),
            sail,
            two_sided=True,
        ),
        Face(
            _corners(
                (0, 0.48 * length, freeboard + 0.4),
                (0.6 * side, y_mast, boom),
                (0, y_mast, 0.86 * mast),
            ),
            sail,
            two_sided=True,
        ),
    ]
    return Shape("sailboat", length, beam, tuple(faces), wake=0.12)


def ferry(rng: np.random.Generator, length_m: float | None = None) -> Shape:
    """A harbour ferry of 20 to 32 m with two decks."""
    length = length_m if length_m is not None else float(rng.uniform(20.0, 32.0))
    beam, freeboard = 0.26 * length, 0.075 * length
    stripe = _pick(rng, [(146, 84, 32), (52, 60, 150), (70, 110, 60)])
    faces = [*_hull(length, beam, freeboard, stripe, (150, 160, 166))]
    top = freeboard + 0.09 * length
    faces += _cabin(0.86 * beam, -0.38 * length, 0.30 * length, freeboard, top)
    upper = top + 0.075 * length
    faces += _cabin(0.66 * beam, -0.28 * length, 0.18 * length, top, upper)
    faces += _block(1.2, -0.2 * length, -0.2 * length + 1.6, upper, upper + 2.0, stripe)
    faces += _block(0.2, 0.1 * length, 0.1 * length + 0.2, upper, upper + 3.2, _DARK)
    return Shape("ferry", length, beam, tuple(faces), wake=0.6)


def dinghy(rng: np.random.Generator, length_m: float | None = None) -> Shape:
    """An open boat of 3 to 5 m with one person in it."""
    length = length_m if length_m is not None else float(rng.uniform(3.2, 4.8))
    beam, freeboard = 0.42 * length, 0.11 * length
    hull = _pick(rng, [(110, 110, 116), (40, 70, 200), (60, 60, 64), _WHITE])
    jacket = _pick(rng, [(36, 60, 196), (40, 150, 230), (110, 60, 30)])
    faces = [*_hull(length, beam, freeboard, hull, (90, 96, 100))]
    back = -0.25 * length
    faces += _block(0.5, back, back + 0.35, freeboard * 0.6, freeboard + 0.75, jacket)
    faces += _block(
        0.24, back + 0.05, back + 0.3, freeboard + 0.75, freeboard + 1.0, (130, 160, 196)
    )
    faces += _block(0.3, -0.54 * length, -0.48 * length, 0.0, freeboard + 0.3, _DARK)
    return Shape("dinghy", length, beam, tuple(faces), wake=0.7)


def _pick(rng: np.random.Generator, colours: list[Colour]) -> Colour:
    return colours[int(rng.integers(len(colours)))]


def _corners(*points: tuple[float, float, float]) -> FloatArray:
    return np.array(points, dtype=float)


def _hull(length: float, beam: float, freeboard: float, colour: Colour, deck: Colour) -> list[Face]:
    """A hull with flare, a raked bow and a little sheer; faces turn outwards."""
    # Half breadths at stations from stern to stem, at the waterline and at the deck.
    stations = np.array([-0.5, -0.25, 0.05, 0.28, 0.42, 0.47])
    waterline = 0.5 * beam * np.array([0.80, 0.88, 0.86, 0.58, 0.18, 0.0])
    rail_y = np.array([-0.5, -0.25, 0.05, 0.30, 0.45, 0.5]) * length
    rail = 0.5 * beam * np.array([0.92, 1.0, 1.0, 0.78, 0.30, 0.0])
    rail_z = freeboard * np.array([0.90, 0.92, 1.0, 1.12, 1.24, 1.28])
    low = np.stack([waterline, stations * length, np.zeros(6)], axis=1)
    high = np.stack([rail, rail_y, rail_z], axis=1)
    mirror = np.array([-1.0, 1.0, 1.0])
    faces = []
    for i in range(5):
        quad = np.stack([low[i], low[i + 1], high[i + 1], high[i]])
        faces.append(Face(quad, colour, hull=True))
        faces.append(Face((quad * mirror)[::-1], colour, hull=True))
    transom = np.stack([low[0] * mirror, low[0], high[0], high[0] * mirror])
    faces.append(Face(transom, colour, hull=True))
    outline = np.concatenate([high, (high * mirror)[-2::-1]])
    faces.append(Face(outline, deck, hull=True))
    return faces


def _block(
    width: float, back: float, front: float, bottom: float, top: float, colour: Colour
) -> list[Face]:
    """A box about the keel line."""
    w = 0.5 * width
    return [
        Face(
            _corners((w, back, bottom), (w, front, bottom), (w, front, top), (w, back, top)), colour
        ),
        Face(
            _corners((-w, front, bottom), (-w, back, bottom), (-w, back, top), (-w, front, top)),
            colour,
        ),
        Face(
            _corners((w, front, bottom), (-w, front, bottom), (-w, front, top), (w, front, top)),
            colour,
        ),
        Face(
            _corners((-w, back, bottom), (w, back, bottom), (w, back, top), (-w, back, top)), colour
        ),
        Face(_corners((w, back, top), (w, front, top), (-w, front, top), (-w, back, top)), colour),
    ]


def _cabin(width: float, back: float, front: float, bottom: float, top: float) -> list[Face]:
    """A house with a band of windows: three boxes, the middle one of glass."""
    sill = bottom + 0.42 * (top - bottom)
    head = bottom + 0.80 * (top - bottom)
    return [
        *_block(width, back, front, bottom, sill, _WHITE),
        *_block(0.97 * width, back, front - 0.04 * (front - back), sill, head, _GLASS),
        *_block(width, back, front - 0.04 * (front - back), head, top, _WHITE),
    ]
