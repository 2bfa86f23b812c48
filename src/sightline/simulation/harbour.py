"""The world without pixels: who is where at any time, and what its boxes and logs would be.

    harbour = Harbour.random(1, HarbourSettings(duration_s=300.0))
    times = harbour.times(rate_hz=10.0)                     # (N,) POSIX seconds
    boxes = harbour.boxes(times)                            # the target's, exact; one row a time
                                                            # at which it is seen
    boxes = harbour.boxes(times, noise=BoxNoise(std_px=1.0, correlation_time_s=1.0))
    boxes = harbour.boxes(times, of="all")                  # every boat's, track_id = boat
    fixes = harbour.fixes(ReceiverNoise(std_m=1.5))         # the target's log; no argument: exact
    truth = harbour.truth(boxes.time_utc_s)                 # the target's true place at those times
    harbour.camera.height_m, .pitch_deg, ...                # the true camera
    harbour.plane                                           # the local plane at the camera

All is drawn from seeds: the same arguments give the same world and the same noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm

from sightline.errors import InputError, unknown_name
from sightline.geodesy import LocalPlane
from sightline.overlap import shared_area
from sightline.platform import Platform
from sightline.simulation.boats import Boat, Shape, dinghy, ferry, motorboat, sailboat
from sightline.simulation.camera import SimulatedCamera
from sightline.simulation.paths import Path, rest, steer
from sightline.simulation.platform import Knock, SimulatedPlatform
from sightline.simulation.shore import Shore
from sightline.types import BoolArray, Boxes, Fixes, FloatArray, Headings, IntArray, StrArray

START_UTC_S = 1_717_236_000.0
"""2024-06-01T10:00:00Z, when a harbour starts unless it is told otherwise."""

DOCK = LocalPlane(latitude_deg=54.3233, longitude_deg=10.1394)
"""Where a harbour lies unless it is told otherwise: the shore of a fjord on the Baltic."""

_LEAST_SHARE_SEEN = 0.6
_PAST_S = 30.0
_COMPASS_LASTS_S = 120.0
_SPELL_S = 3.0
# Boats keep so far off a quay, and lie so far from it.
_OFF_QUAY_M = 45.0
_BERTH_M = (3.0, 6.0)

Of = Literal["target", "all", "moving"]


@dataclass(frozen=True)
class BoxNoise:
    """How an annotator or a detector strays from the true box.

    Attributes:
        std_px: Standard deviation of every edge.
        correlation_time_s: Errors of one boat decay as ``exp(-Δt / correlation_time_s)``; 0: white.
        lower_edge_bias_px: Added to y2; positive reaches too low.
        miss_probability: Share of boxes that are left out.
        source: Name of the source.
        least_px: Boats whose true box is narrower or lower are not found.
    """

    std_px: float = 1.0
    correlation_time_s: float = 0.0
    lower_edge_bias_px: float = 0.0
    miss_probability: float = 0.0
    source: str = "annotator"
    least_px: float = 0.0


@dataclass(frozen=True)
class ReceiverNoise:
    """How a receiver's log strays from the truth.

    Attributes:
        std_m: Standard deviation of the position's error, in east and in north.
        correlation_time_s: Errors decay as ``exp(-Δt / correlation_time_s)``; 0: white.
        interval_s: Mean time between fixes.
        interval_jitter: Share by which single intervals vary, in [0, 1).
        dropouts_per_minute: How often the receiver falls silent.
        dropout_s: Longest silence; they last from a third of it.
        clock_offset_s: Added to every time of the log.
        whole_seconds: Whether it fixes on whole seconds only.
    """

    std_m: float = 1.5
    correlation_time_s: float = 20.0
    interval_s: float = 1.0
    interval_jitter: float = 0.25
    dropouts_per_minute: float = 0.4
    dropout_s: float = 12.0
    clock_offset_s: float = 0.0
    whole_seconds: bool = False


EXACT = ReceiverNoise(std_m=0.0, interval_jitter=0.0, dropouts_per_minute=0.0)
"""A receiver without fault: a fix a second."""


@dataclass(frozen=True)
class Pile:
    """A round post in the water: fenders, mooring posts, dolphins.

    Attributes:
        east_m: Of its axis.
        north_m: Of its axis.
        radius_m: Of the post.
        top_m: Height of its head above the water.
    """

    east_m: float
    north_m: float
    radius_m: float
    top_m: float

    def outline_enu_m(self) -> FloatArray:
        """(48, 3) metres, the rims at the water and at the head."""
        angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
        rim = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * self.radius_m
        rim += [self.east_m, self.north_m]
        foot = np.column_stack([rim, np.zeros(24)])
        head = np.column_stack([rim, np.full(24, self.top_m)])
        return np.concatenate([foot, head])


@dataclass(frozen=True)
class Gull:
    """A bird that circles, or sits on the water where radius and height are zero.

    Attributes:
        centre_m: East and north of what it circles.
        radius_m: Of the circle.
        height_m: Above the water.
        period_s: For a turn.
        phase: Radians at time 0.
        drift_mps: Of the centre, east and north.
        span_m: From wing tip to wing tip.
    """

    centre_m: tuple[float, float]
    radius_m: float
    height_m: float
    period_s: float
    phase: float
    drift_mps: tuple[float, float]
    span_m: float = 1.2

    def at(self, time_s: float) -> tuple[FloatArray, float]:
        """(3,) metres east, north and up, and the course in radians clockwise from north."""
        angle = self.phase + 2.0 * np.pi * time_s / self.period_s
        east = self.centre_m[0] + self.drift_mps[0] * time_s + self.radius_m * np.sin(angle)
        north = self.centre_m[1] + self.drift_mps[1] * time_s + self.radius_m * np.cos(angle)
        height = self.height_m * (1.0 + 0.15 * np.sin(1.7 * angle + self.phase))
        return np.array([east, north, height]), angle + 0.5 * np.pi


@dataclass(frozen=True, eq=False)
class Truth:
    """Where boats truly were, one row a boat and time.

    Attributes:
        time_utc_s: (N,) POSIX seconds.
        boat: (N,) identity of the boat.
        name: (N,) its name.
        east_m: (N,) metres from the camera.
        north_m: (N,) metres.
        velocity_east_mps: (N,) metres a second.
        velocity_north_mps: (N,) metres a second.
        latitude_deg: (N,).
        longitude_deg: (N,).
    """

    time_utc_s: FloatArray
    boat: IntArray
    name: StrArray
    east_m: FloatArray
    north_m: FloatArray
    velocity_east_mps: FloatArray
    velocity_north_mps: FloatArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray

    @property
    def speed_mps(self) -> FloatArray:
        """(N,) over ground."""
        return np.hypot(self.velocity_east_mps, self.velocity_north_mps)

    @property
    def course_deg(self) -> FloatArray:
        """(N,) over ground, clockwise from north, in [0, 360)."""
        return np.degrees(np.arctan2(self.velocity_east_mps, self.velocity_north_mps)) % 360.0

    @property
    def range_m(self) -> FloatArray:
        """(N,) metres from the camera."""
        return np.hypot(self.east_m, self.north_m)

    def __len__(self) -> int:
        return int(self.time_utc_s.size)


@dataclass(frozen=True)
class HarbourSettings:
    """Settings of `Harbour.random`.

    Attributes:
        duration_s: How long the boats have paths.
        camera: Absent: a random one.
        image_size_px: Of the random camera.
        plane: Where the camera stands.
        start_utc_s: POSIX seconds.
        motorboats: How many besides the target.
        sailboats: How many under sail.
        ferries: How many.
        anchored: How many boats lie at anchor.
        gulls: How many birds.
        piles: Whether a bollard and a mooring post stand before the camera.
        moving: Whether the camera is on a vessel under way in a swell; then without piles.
        shore: Whether a town with a port lies behind the water, at 240 to 400 m.
        moored: How many boats lie along its quay.

    Raises:
        InputError: The duration is not positive, or there is a shore before a camera that moves.
    """

    duration_s: float = 240.0
    camera: SimulatedCamera | None = None
    image_size_px: tuple[int, int] = (1280, 720)
    plane: LocalPlane = DOCK
    start_utc_s: float = START_UTC_S
    motorboats: int = 3
    sailboats: int = 3
    ferries: int = 1
    anchored: int = 2
    gulls: int = 6
    piles: bool = True
    moving: bool = False
    shore: bool = False
    moored: int = 30

    def __post_init__(self) -> None:
        if self.shore and self.moving:
            raise InputError(
                "a shore with a town lies before a camera that stands still; leave one of the two "
                "out"
            )
        if not self.duration_s > 0.0:
            raise InputError(f"a duration of {self.duration_s:g} s is not positive")


@dataclass(frozen=True, eq=False)
class Harbour:
    """A harbour, its boats, and the camera that watches them.

    Attributes:
        camera: At the origin of the plane.
        plane: Where that is on the earth.
        boats: The first is the target: the one that keeps a log.
        piles: What stands between camera and boats.
        gulls: Clutter that has no boxes.
        start_utc_s: When it begins, POSIX seconds.
        duration_s: How long the boats have paths.
        seed: What it was drawn from; noise is drawn from it too.
        platform: What the camera stands on, where that moves: then the camera is as it lies while
            the hull is level and its bow at ``platform.heading_deg``.
        knock: When a camera that stands still was turned; then the camera is as it lay before.
        shore: A town with a port behind the water, where there is one.
    """

    camera: SimulatedCamera
    plane: LocalPlane
    boats: tuple[Boat, ...]
    piles: tuple[Pile, ...] = ()
    gulls: tuple[Gull, ...] = ()
    start_utc_s: float = START_UTC_S
    duration_s: float = 240.0
    seed: int = 0
    platform: SimulatedPlatform | None = None
    knock: Knock | None = None
    shore: Shore | None = None

    @classmethod
    def random(cls, seed: int = 0, settings: HarbourSettings | None = None) -> Harbour:
        """A harbour from a seed.

        Args:
            seed: The same seed and settings give the same harbour.
            settings: What is in it.
        """
        settings = settings or HarbourSettings()
        rng = np.random.default_rng([seed, 1])
        camera, duration_s = settings.camera, settings.duration_s
        if camera is None:
            camera = SimulatedCamera.random(rng, settings.image_size_px)
        shore = None
        if settings.shore:
            shore = Shore.random(np.random.default_rng([seed, 11]), camera)
        builder = _Builder(rng, camera, duration_s, shore)
        builder.target()
        for _ in range(settings.motorboats):
            builder.motorboat()
        for _ in range(settings.sailboats):
            builder.sailboat()
        for _ in range(settings.ferries):
            builder.ferry()
        for _ in range(settings.anchored):
            builder.anchored()
        if shore is not None:
            builder.moored(settings.moored)
        return cls(
            camera=camera,
            plane=settings.plane,
            boats=tuple(builder.boats),
            piles=builder.piles() if settings.piles and not settings.moving else (),
            gulls=tuple(builder.gull(i % 2 == 0) for i in range(settings.gulls)),
            start_utc_s=settings.start_utc_s,
            duration_s=duration_s,
            seed=seed,
            platform=SimulatedPlatform.random(np.random.default_rng([seed, 8]), camera, duration_s)
            if settings.moving
            else None,
            shore=shore,
        )

    def seen_from(
        self, camera: SimulatedCamera, place_m: ArrayLike, *, piles: tuple[Pile, ...] = ()
    ) -> Harbour:
        """The same boats at the same times before another camera that stands still.

        Args:
            camera: The other camera.
            place_m: (2,) where it stands, metres east and north of this one.
            piles: What stands before it, from where it stands.
        """
        east_m, north_m = np.asarray(place_m, dtype=float)
        latitude, longitude = self.plane.to_geographic([east_m], [north_m])
        boats = tuple(
            replace(
                boat, path=replace(boat.path, position_m=boat.path.position_m - (east_m, north_m))
            )
            for boat in self.boats
        )
        return replace(
            self,
            camera=camera,
            plane=LocalPlane(float(latitude[0]), float(longitude[0])),
            boats=boats,
            piles=piles,
            gulls=(),
            platform=None,
            knock=None,
            shore=None,
        )

    @property
    def target(self) -> Boat:
        """The boat that keeps a log."""
        return self.boats[0]

    @property
    def end_utc_s(self) -> float:
        """When the paths end, POSIX seconds."""
        return self.start_utc_s + self.duration_s

    def times(self, rate_hz: float = 10.0) -> FloatArray:
        """(N,) POSIX seconds, evenly over the whole duration."""
        count = int(np.floor(self.duration_s * rate_hz + 1e-9)) + 1
        return self.start_utc_s + np.arange(count) / rate_hz

    def truth(self, time_utc_s: ArrayLike, boats: Sequence[Boat] | None = None) -> Truth:
        """Where boats truly are.

        Args:
            time_utc_s: (N,) POSIX seconds.
            boats: Absent: the target alone. Rows come boat after boat.
        """
        times = np.atleast_1d(np.asarray(time_utc_s, dtype=float))
        chosen = (self.target,) if boats is None else tuple(boats)
        place = [boat.path.at(times - self.start_utc_s) for boat in chosen]
        velocity = [boat.path.velocity(times - self.start_utc_s) for boat in chosen]
        east, north = np.concatenate([np.empty((0, 2)), *place]).T
        v_east, v_north = np.concatenate([np.empty((0, 2)), *velocity]).T
        latitude, longitude = self.plane.to_geographic(east, north)
        return Truth(
            time_utc_s=np.tile(times, len(chosen)),
            boat=np.repeat([boat.identity for boat in chosen], times.size).astype(np.int64),
            name=np.repeat([boat.name for boat in chosen], times.size).astype(np.str_),
            east_m=east,
            north_m=north,
            velocity_east_mps=v_east,
            velocity_north_mps=v_north,
            latitude_deg=latitude,
            longitude_deg=longitude,
        )

    def outlines_px(self, boat: Boat, time_utc_s: ArrayLike) -> FloatArray:
        """The box of a boat's projected corners, whether or not it is hidden or out of the image.

        Args:
            boat: Any boat.
            time_utc_s: (N,) POSIX seconds.

        Returns:
            (N, 4) float64, x1, y1, x2, y2 px; NaN where a corner cannot be projected.
        """
        times = np.atleast_1d(np.asarray(time_utc_s, dtype=float)) - self.start_utc_s
        if self.platform is None:
            turn = None
            if self.knock is not None:
                turn = self.knock.turn(self.camera, times + self.start_utc_s)
            pixels = self.camera.project(boat.points_enu_m(times), turn)
        else:
            points = self.platform.seen(boat).points_enu_m(times)
            # The camera's own height stays what it is; the water falls as the hull rises.
            points[..., 2] -= self.platform.heave_m(times)[:, None]
            pixels = self.camera.project(points, self.platform.turn(times))
        return np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=-1)

    def boxes(
        self,
        time_utc_s: ArrayLike,
        *,
        noise: BoxNoise | None = None,
        of: Of = "target",
        frame: ArrayLike | None = None,
        seed: int = 0,
    ) -> Boxes:
        """What a perfect or an imperfect eye would draw.

        A boat has a box where at least three fifths of it lie in the image, its waterline with it,
        and no pile or nearer boat covers more than half of it. Boxes end at the image's border.

        Args:
            time_utc_s: (N,) POSIX seconds.
            noise: Absent: the true boxes, with the source ``"truth"``.
            of: ``"target"``, ``"all"`` boats, or those that are ``"moving"``.
            frame: (N,) frame numbers; absent: the index of the time.
            seed: Another seed, other noise.

        Returns:
            One row a boat and time that is seen, in the order of time; ``track_id`` is the boat's
            identity, ``label`` its kind.

        Raises:
            InputError: ``of`` is none of the above.
        """
        known: tuple[Of, ...] = ("target", "all", "moving")
        if of not in known:
            raise unknown_name("choice of boats", of, known)
        times = np.atleast_1d(np.asarray(time_utc_s, dtype=float))
        frames = np.arange(times.size) if frame is None else np.asarray(frame)
        outlines = np.stack([self.outlines_px(boat, times) for boat in self.boats], axis=1)
        seen = self._seen(times, outlines)
        if of == "target":
            seen[:, 1:] = False
        if of == "moving":
            seen[:, [not boat.path.moves for boat in self.boats]] = False
        if noise is not None:
            if noise.least_px > 0.0:
                with np.errstate(invalid="ignore"):
                    seen &= (outlines[..., 2:] - outlines[..., :2]).min(axis=-1) >= noise.least_px
            rng = np.random.default_rng([self.seed, 2, seed])
            for j in range(len(self.boats)):
                error = noise.std_px * _correlated(rng, times, noise.correlation_time_s, 4)
                outlines[:, j] += error
            outlines[..., 3] += noise.lower_edge_bias_px
            seen &= rng.random(seen.shape) >= noise.miss_probability
        rows, boats = np.nonzero(seen)
        return Boxes.of(
            _inside(outlines[rows, boats], self.camera.image_size_px),
            frame=frames[rows],
            time_utc_s=times[rows],
            source="truth" if noise is None else noise.source,
            track_id=np.array([boat.identity for boat in self.boats], dtype=np.int64)[boats],
            label=np.array([boat.shape.kind for boat in self.boats])[boats],
        )

    def false_boxes(
        self,
        time_utc_s: ArrayLike,
        *,
        noise: BoxNoise,
        count: int = 16,
        frame: ArrayLike | None = None,
        seed: int = 0,
    ) -> Boxes:
        """What a detector takes for boats on the shore: roofs, tops of cranes, cars, trees.

        Each is found in a share of the frames of its own, a tenth to nine tenths, in spells of
        some seconds.

        Args:
            time_utc_s: (N,) POSIX seconds.
            noise: Of the boxes.
            count: How many things on the shore are taken for boats.
            frame: (N,) frame numbers; absent: the index of the time.
            seed: Another seed, other things.

        Returns:
            In the order of time; without ids, as nothing is there.
        """
        times = np.atleast_1d(np.asarray(time_utc_s, dtype=float))
        frames = np.arange(times.size) if frame is None else np.asarray(frame)
        if self.shore is None:
            return Boxes.of([])
        rng = np.random.default_rng([self.seed, 13, seed])
        width, height = self.camera.image_size_px
        parts = []
        order = rng.permutation(len(self.shore.features)).tolist()
        for i in order:
            corners = self.camera.project(self.shore.features[i].part_enu_m())
            box = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
            inside = (box > 4.0) & (box < np.tile([width - 4.0, height - 4.0], 2))
            if not (np.isfinite(box).all() and inside.all()) or (box[2:] - box[:2]).min() < max(
                noise.least_px, 4.0
            ):
                continue
            edges = box + noise.std_px * _correlated(rng, times, noise.correlation_time_s, 4)
            level = norm.ppf(rng.uniform(0.1, 0.9))
            found = _correlated(rng, times, _SPELL_S, 1)[:, 0] < level
            confidence = np.clip(
                rng.uniform(0.3, 0.8) + 0.1 * _correlated(rng, times, 1.0, 1)[:, 0], 0.05, 0.98
            )
            parts.append(
                Boxes.of(
                    _inside(edges[found], self.camera.image_size_px),
                    frame=frames[found],
                    time_utc_s=times[found],
                    confidence=confidence[found],
                    source=noise.source,
                    label="motorboat",
                )
            )
            if len(parts) == count:
                break
        boxes = Boxes.concatenate(parts)
        return boxes[np.argsort(boxes.time_utc_s, kind="stable")]

    def _seen(self, times: FloatArray, outlines: FloatArray) -> BoolArray:
        """(N, boats) bool: enough of the boat is in the image and nothing hides it."""
        width, height = self.camera.image_size_px
        known: BoolArray = np.asarray(np.isfinite(outlines).all(axis=-1))
        boxes = np.where(known[..., None], outlines, 0.0)
        area = np.maximum((boxes[..., 2:] - boxes[..., :2]).prod(axis=-1), 1e-9)
        limits = np.array([0.0, 0.0, width, height])
        seen: BoolArray = known & (shared_area(boxes, limits) / area >= _LEAST_SHARE_SEEN)
        seen = seen & (boxes[..., 3] <= height)
        since = times - self.start_utc_s
        eye = 0.0 if self.platform is None else self.platform.at(since)
        distance = np.stack(
            [np.hypot(*(boat.path.at(since) - eye).T) for boat in self.boats], axis=1
        )
        for j in range(len(self.boats)):
            nearer = distance[:, j : j + 1] < distance
            hidden = shared_area(boxes, boxes[:, j : j + 1]) / area
            seen = seen & ~(nearer & known[:, j : j + 1] & (hidden > 0.5))
        for pile in self.piles:
            corners = self.camera.project(pile.outline_enu_m())
            if not np.isfinite(corners).any():
                continue
            box = np.concatenate([np.nanmin(corners, axis=0), np.nanmax(corners, axis=0)])
            nearer = np.hypot(pile.east_m, pile.north_m) < distance
            seen = seen & ~(nearer & (shared_area(boxes, box) / area > 0.5))
        return seen

    def fixes(
        self, noise: ReceiverNoise = EXACT, *, boat: Boat | None = None, seed: int = 0
    ) -> Fixes:
        """The log that a boat keeps, over the whole duration.

        Args:
            noise: Of the receiver.
            boat: Absent: the target.
            seed: Another seed, other noise.
        """
        chosen = self.target if boat is None else boat
        rng = np.random.default_rng([self.seed, 3, seed, chosen.identity])
        count = int(np.ceil(self.duration_s / (noise.interval_s * (1.0 - noise.interval_jitter))))
        jitter = 1.0 + noise.interval_jitter * rng.uniform(-1.0, 1.0, count + 1)
        times = self.start_utc_s + np.append(0.0, np.cumsum(noise.interval_s * jitter))
        if noise.whole_seconds:
            times = np.unique(np.round(times))
        times = times[(times >= self.start_utc_s) & (times <= self.end_utc_s + 1e-9)]
        silences = rng.poisson(noise.dropouts_per_minute * self.duration_s / 60.0)
        keep = np.ones(times.size, dtype=bool)
        for _ in range(silences):
            begin = self.start_utc_s + rng.uniform(0.0, self.duration_s)
            length = noise.dropout_s * rng.uniform(1.0 / 3.0, 1.0)
            keep &= (times < begin) | (times > begin + length)
        times = times[keep]
        return self._log(rng, times, chosen.path.at(times - self.start_utc_s), noise, chosen.name)

    def platform_log(
        self,
        noise: ReceiverNoise = EXACT,
        *,
        heading_std_deg: float = 0.3,
        heading_drift_deg: float = 0.7,
    ) -> Platform:
        """What a platform that moves logs of itself, over the whole duration.

        Args:
            noise: Of its receiver; it keeps even intervals.
            heading_std_deg: Of its compass, white.
            heading_drift_deg: Standard deviation of the compass's error that lasts for minutes.

        Raises:
            InputError: The camera stands still.
        """
        if self.platform is None:
            raise InputError("this harbour's camera stands on no platform that moves")
        rng = np.random.default_rng([self.seed, 9])
        times = np.arange(self.start_utc_s, self.end_utc_s + 1e-9, noise.interval_s)
        since = times - self.start_utc_s
        fixes = self._log(rng, times, self.platform.at(since), noise, "platform")
        heading = self.platform.heading_at_deg(since)
        heading = heading + heading_std_deg * rng.standard_normal(times.size)
        drift = _correlated(rng, times, _COMPASS_LASTS_S, 1)[:, 0]
        heading = (heading + heading_drift_deg * drift) % 360.0
        return Platform(fixes, Headings(times, heading))

    def _log(
        self,
        rng: np.random.Generator,
        times: FloatArray,
        place: FloatArray,
        noise: ReceiverNoise,
        name: str,
    ) -> Fixes:
        place = place + noise.std_m * _correlated(rng, times, noise.correlation_time_s, 2)
        latitude, longitude = self.plane.to_geographic(place[:, 0], place[:, 1])
        return Fixes(times + noise.clock_offset_s, latitude, longitude, name=name)


def _correlated(
    rng: np.random.Generator, times: FloatArray, correlation_time_s: float, columns: int
) -> FloatArray:
    """(N, columns) of unit variance, a first-order Gauss-Markov process in time."""
    out = rng.standard_normal((times.size, columns))
    if correlation_time_s <= 0.0:
        return out
    order = np.argsort(times, kind="stable")
    memory = np.exp(-np.diff(times[order]) / correlation_time_s)
    fresh = np.sqrt(1.0 - memory**2)
    for i in range(1, times.size):
        out[order[i]] = memory[i - 1] * out[order[i - 1]] + fresh[i - 1] * out[order[i]]
    return out


def _inside(boxes: FloatArray, image_size_px: tuple[int, int]) -> FloatArray:
    """Boxes cut at the image's border; noise must not turn a far boat's box inside out."""
    centre = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    half = np.maximum(0.5 * (boxes[:, 2:] - boxes[:, :2]), 0.5)
    size = np.array(image_size_px, dtype=float)
    low = np.clip(centre - half, 0.0, size - 1.0)
    return np.concatenate([low, np.clip(centre + half, low + 1.0, size)], axis=1)


class _Builder:
    """Draws boats one after another, each clear of those before it."""

    def __init__(
        self,
        rng: np.random.Generator,
        camera: SimulatedCamera,
        duration_s: float,
        shore: Shore | None = None,
    ) -> None:
        self._rng = rng
        self._shore = shore
        self._camera = camera
        self._duration_s = duration_s
        self._half_view_deg = 0.5 * camera.field_of_view_deg
        self._nearest_m = max(26.0, 1.8 * camera.nearest_water_m)
        self.boats: list[Boat] = []

    def target(self) -> None:
        shape = motorboat(self._rng, float(self._rng.uniform(5.8, 7.4)))
        best: Path | None = None
        most = -1.0
        for _ in range(12):
            path = self._wander(
                range_m=(self._nearest_m, self._nearest_m + 200.0),
                speed_mps=(3.0, 7.0),
                turn_rate_dps=16.0,
            )
            share = self._share_in_view(path)
            if share > most:
                best, most = path, share
            if share > 0.95:
                break
        assert best is not None
        self.boats.append(Boat(1, "target", shape, best))

    def motorboat(self) -> None:
        make = motorboat if self._rng.random() < 0.7 else dinghy
        self._add(make, (self._nearest_m, 320.0), (1.5, 8.0), 12.0)

    def sailboat(self) -> None:
        self._add(sailboat, (self._nearest_m + 60.0, 600.0), (1.2, 3.2), 5.0)

    def ferry(self) -> None:
        self._add(ferry, (self._nearest_m + 200.0, 800.0), (3.0, 5.5), 2.5)

    def anchored(self) -> None:
        makes = (sailboat, motorboat)
        shape = makes[int(self._rng.integers(2))](self._rng)
        for _ in range(30):
            place = self._place((self._nearest_m + 120.0, 500.0), 0.95)
            path = rest(place, float(self._rng.uniform(0.0, 360.0)), self._duration_s)
            if self._clear(path, shape.length_m):
                break
        self._append(shape, path)

    def moored(self, count: int) -> None:
        """Boats along the quay of the shore, side by side in a few groups, some on buoys."""
        assert self._shore is not None, "the caller has looked"
        rng, edge = self._rng, self._shore.range_m
        groups = rng.uniform(-0.8, 0.8, 4)
        taken = list[tuple[float, float]]()
        for _ in range(count):
            made = int(rng.integers(3))
            shape = dinghy(rng) if made == 0 else motorboat(rng)
            if made == 2:
                shape = sailboat(rng, sails=False)
            place, course = np.zeros(2), 0.0
            for _ in range(60):
                on_buoy = rng.random() < 0.15
                share = rng.uniform(-0.9, 0.9) if on_buoy else rng.normal(rng.choice(groups), 0.12)
                bearing = self._camera.heading_deg + float(share) * self._half_view_deg
                off = float(
                    rng.uniform(14.0, 0.7 * _OFF_QUAY_M) if on_buoy else rng.uniform(*_BERTH_M)
                )
                distance = edge - off - 0.5 * shape.length_m
                place = np.array(_at(bearing, distance))
                # Bow or stern to the quay; on a buoy as the wind has it.
                course = bearing + (0.0 if rng.random() < 0.6 else 180.0)
                course += float(rng.normal(0.0, 6.0)) + (70.0 if on_buoy else 0.0)
                apart = [
                    abs(share_of - share) * np.radians(self._half_view_deg) * edge
                    for share_of, _ in taken
                ]
                room = [0.5 * (shape.beam_m + beam) + 1.2 for _, beam in taken]
                if abs(share) < 0.95 and all(a > b for a, b in zip(apart, room, strict=True)):
                    taken.append((float(share), shape.beam_m if not on_buoy else shape.length_m))
                    self._append(shape, rest(place, course % 360.0, self._duration_s))
                    break

    def piles(self) -> tuple[Pile, ...]:
        """A bollard at the foot of the image and a mooring post further out."""
        camera, rng = self._camera, self._rng
        bearing = camera.heading_deg + rng.uniform(0.1, 0.4) * self._half_view_deg
        # Its head shows in the lowest tenth of the image.
        width, height = camera.image_size_px
        ray = camera.directions([0.65 * width, 0.93 * height])
        reach = 2.6
        top = camera.height_m + reach * float(ray[2] / np.hypot(ray[0], ray[1]))
        bollard = Pile(*_at(bearing, reach), radius_m=0.28, top_m=max(top, 0.2))
        side = -1.0 if rng.random() < 0.5 else 1.0
        bearing = camera.heading_deg + side * rng.uniform(0.35, 0.6) * self._half_view_deg
        distance = max(1.25 * camera.nearest_water_m, 14.0)
        post = Pile(*_at(bearing, distance), radius_m=0.17, top_m=camera.height_m + 0.35)
        return (bollard, post)

    def gull(self, flies: bool) -> Gull:
        rng = self._rng
        radius = float(rng.uniform(10.0, 40.0)) if flies else 0.0
        place = self._place((self._nearest_m + radius, 150.0), 0.9)
        centre = (float(place[0]), float(place[1]))
        phase = float(rng.uniform(0.0, 2.0 * np.pi))
        drift = (float(rng.normal(0.0, 0.25)), float(rng.normal(0.0, 0.25)))
        if not flies:
            return Gull(centre, 0.0, 0.0, 60.0, phase, (0.1 * drift[0], 0.1 * drift[1]), 0.45)
        return Gull(
            centre,
            radius,
            height_m=float(rng.uniform(2.0, 14.0)),
            period_s=2.0 * np.pi * radius / float(rng.uniform(7.0, 11.0)),
            phase=phase,
            drift_mps=drift,
        )

    def _add(
        self,
        make: Callable[[np.random.Generator], Shape],
        range_m: tuple[float, float],
        speed_mps: tuple[float, float],
        turn_rate_dps: float,
    ) -> None:
        shape = make(self._rng)
        path = self._wander(range_m, speed_mps, turn_rate_dps)
        for _ in range(15):
            if self._clear(path, shape.length_m):
                break
            path = self._wander(range_m, speed_mps, turn_rate_dps)
        self._append(shape, path)

    def _append(self, shape: Shape, path: Path) -> None:
        identity = len(self.boats) + 1
        self.boats.append(Boat(identity, f"{shape.kind}-{identity}", shape, path))

    def _wander(
        self,
        range_m: tuple[float, float],
        speed_mps: tuple[float, float],
        turn_rate_dps: float,
    ) -> Path:
        path = self._wandered(range_m, speed_mps, turn_rate_dps)
        if self._shore is None:
            return path
        # Before a quay who cannot turn is to keep off it, and go slower.
        times = np.arange(0.0, self._duration_s, 0.5)
        for share in np.linspace(0.95, 0.2, 40).tolist():
            if np.hypot(*path.at(times).T).max() < self._shore.range_m - 0.5 * _OFF_QUAY_M:
                break
            nearer = (share * range_m[0], share * min(range_m[1], self._shore.range_m))
            slower = (share * speed_mps[0], share * speed_mps[1])
            path = self._wandered(nearer, slower, turn_rate_dps)
        return path

    def _wandered(
        self,
        range_m: tuple[float, float],
        speed_mps: tuple[float, float],
        turn_rate_dps: float,
    ) -> Path:
        rng = self._rng
        count = 24
        cruise = rng.uniform(*speed_mps)
        waypoints = np.stack([self._place(range_m, 0.85) for _ in range(count)])
        speeds = np.clip(cruise * rng.uniform(0.75, 1.25, count), *speed_mps)
        return steer(
            waypoints,
            speed_mps=speeds,
            turn_rate_dps=turn_rate_dps,
            start_s=-_PAST_S,
            end_s=self._duration_s + 1.0,
        )

    def _place(self, range_m: tuple[float, float], share_of_view: float) -> FloatArray:
        if self._shore is not None:
            most = self._shore.range_m - _OFF_QUAY_M
            range_m = (min(range_m[0], 0.55 * most), min(range_m[1], most))
        bearing = self._camera.heading_deg + share_of_view * self._half_view_deg * float(
            self._rng.uniform(-1.0, 1.0)
        )
        # Even in the logarithm: as many places near as far, as they look in the image.
        distance = float(np.exp(self._rng.uniform(*np.log(range_m))))
        return np.array(_at(bearing, distance))

    def _share_in_view(self, path: Path) -> float:
        times = np.arange(0.0, self._duration_s, 0.5)
        pixels = self._camera.project(np.column_stack([path.at(times), np.zeros(times.size)]))
        width, height = self._camera.image_size_px
        with np.errstate(invalid="ignore"):
            inside = (pixels[:, 0] > 0.04 * width) & (pixels[:, 0] < 0.96 * width)
            inside &= pixels[:, 1] < 0.9 * height
        return float(inside.mean())

    def _clear(self, path: Path, length_m: float) -> bool:
        times = np.arange(0.0, self._duration_s, 0.5)
        place = path.at(times)
        if (np.hypot(*place.T) < self._nearest_m).any():
            return False
        for other in self.boats:
            apart = np.hypot(*(place - other.path.at(times)).T).min()
            if apart < 0.5 * (length_m + other.shape.length_m) + 4.0:
                return False
        return True


def _at(bearing_deg: float, distance_m: float) -> tuple[float, float]:
    angle = np.radians(bearing_deg)
    return float(distance_m * np.sin(angle)), float(distance_m * np.cos(angle))
