"""A camera that does not stand still: on a vessel under way in a swell, or knocked once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sightline.simulation.boats import Boat
from sightline.simulation.camera import SimulatedCamera
from sightline.simulation.paths import Path
from sightline.types import FloatArray

_GRID_PX = 16
_GRAVITY_MPS2 = 9.81


@dataclass(frozen=True, eq=False)
class Sway:
    """A sum of sines: how an angle of the hull moves in a swell.

    Attributes:
        amplitude_deg: (K,) of each sine.
        period_s: (K,).
        phase_rad: (K,).
    """

    amplitude_deg: FloatArray
    period_s: FloatArray
    phase_rad: FloatArray

    @classmethod
    def random(
        cls, rng: np.random.Generator, std_deg: float, period_s: tuple[float, float], count: int = 4
    ) -> Sway:
        """Sines of random periods and phases.

        Args:
            rng: Where the randomness comes from.
            std_deg: Standard deviation of their sum.
            period_s: Shortest and longest period.
            count: How many.
        """
        share = rng.uniform(0.5, 1.0, count)
        amplitude = std_deg * np.sqrt(2.0) * share / np.linalg.norm(share)
        return cls(amplitude, rng.uniform(*period_s, count), rng.uniform(0.0, 2.0 * np.pi, count))

    def at(self, time_s: FloatArray) -> FloatArray:
        """(N,) degrees."""
        angle = 2.0 * np.pi * time_s[:, None] / self.period_s + self.phase_rad
        return np.asarray((self.amplitude_deg * np.sin(angle)).sum(axis=1))

    def elevation_m(self, time_s: FloatArray) -> FloatArray:
        r"""(N,) metres by which the water lifts a hull that lies along its slope.

        A wave of deep water whose slope is :math:`\theta \sin \omega t` has the elevation
        :math:`(\theta / k) \cos \omega t`, with the wave number :math:`k = \omega^2 / g`.
        """
        frequency = 2.0 * np.pi / self.period_s
        angle = frequency * time_s[:, None] + self.phase_rad
        amplitude = np.radians(self.amplitude_deg) * _GRAVITY_MPS2 / frequency**2
        return np.asarray((amplitude * np.cos(angle)).sum(axis=1))


@dataclass(frozen=True, eq=False)
class SimulatedPlatform:
    """A vessel that goes straight on, and yaws, pitches, rolls and heaves as it goes.

    It is small against the waves: it pitches and rolls with the slope of the water, and heaves with
    its height. The lens is where the hull turns about, so it does not swing besides.

    Attributes:
        start_m: East and north of the origin at time 0.
        velocity_mps: East and north.
        heading_deg: Of the bow, clockwise from north, without the yawing.
        yaw: About ``heading_deg``, positive clockwise.
        pitch: Positive bow down.
        roll: Positive starboard down.
    """

    start_m: tuple[float, float]
    velocity_mps: tuple[float, float]
    heading_deg: float
    yaw: Sway
    pitch: Sway
    roll: Sway

    @classmethod
    def random(
        cls, rng: np.random.Generator, camera: SimulatedCamera, duration_s: float
    ) -> SimulatedPlatform:
        """A small vessel that passes slowly by what its camera looks at, abeam or on the quarter.

        Args:
            rng: Where the randomness comes from.
            camera: On board.
            duration_s: Half-way through it is at the origin.
        """
        side = 1.0 if rng.random() < 0.5 else -1.0
        heading = camera.heading_deg + side * float(rng.uniform(90.0, 130.0))
        speed = float(rng.uniform(0.3, 0.7))
        angle = np.radians(heading)
        east, north = speed * float(np.sin(angle)), speed * float(np.cos(angle))
        return cls(
            start_m=(-0.5 * duration_s * east, -0.5 * duration_s * north),
            velocity_mps=(east, north),
            heading_deg=heading % 360.0,
            yaw=Sway.random(rng, 1.5, (8.0, 30.0)),
            pitch=Sway.random(rng, 0.8, (3.0, 7.0)),
            roll=Sway.random(rng, 1.6, (3.0, 7.0)),
        )

    def at(self, time_s: ArrayLike) -> FloatArray:
        """(N, 2) metres east and north."""
        gone = np.multiply.outer(np.asarray(time_s, dtype=float), self.velocity_mps)
        return np.asarray(np.asarray(self.start_m) + gone)

    def heading_at_deg(self, time_s: ArrayLike) -> FloatArray:
        """(N,) where the bow points, in [0, 360)."""
        times = np.atleast_1d(np.asarray(time_s, dtype=float))
        return np.asarray((self.heading_deg + self.yaw.at(times)) % 360.0)

    def heave_m(self, time_s: ArrayLike) -> FloatArray:
        """(N,) metres by which the lens is higher above the water's mean level than on average."""
        times = np.atleast_1d(np.asarray(time_s, dtype=float))
        return self.pitch.elevation_m(times) + self.roll.elevation_m(times)

    def turn(self, time_s: ArrayLike) -> FloatArray:
        """(N, 3, 3), from directions in the world (east, north, up) to what they are for a hull.

        The result is in the axes of the world as well: of a hull that lies level with its bow at
        ``heading_deg`` it is the identity.
        """
        times = np.atleast_1d(np.asarray(time_s, dtype=float))
        yaw, pitch, roll = (
            np.radians(sway.at(times)) for sway in (self.yaw, self.pitch, self.roll)
        )
        heading = np.radians(self.heading_deg)
        bow = np.array([np.sin(heading), np.cos(heading), 0.0])
        starboard = np.array([np.cos(heading), -np.sin(heading), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        # Clockwise seen from above, bow down, starboard down; undone in the reverse order.
        hull = _about(-up, yaw) @ _about(-starboard, pitch) @ _about(bow, roll)
        return np.asarray(np.swapaxes(hull, 1, 2))

    def seen(self, boat: Boat) -> Boat:
        """A boat whose path is that which the platform sees, north up."""
        return replace(boat, path=_SeenPath.of(boat.path, self))


@dataclass(frozen=True)
class Knock:
    """A camera that is turned at one moment, and stands as well as before after it.

    Attributes:
        time_utc_s: When, POSIX seconds.
        heading_deg: To the right.
        pitch_deg: Downwards.
        roll_deg: The right end of the horizon downwards.
    """

    time_utc_s: float
    heading_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    def turn(self, camera: SimulatedCamera, time_utc_s: ArrayLike) -> FloatArray:
        """(N, 3, 3) of a camera, as `SimulatedPlatform.turn`: before the knock the identity."""
        times = np.atleast_1d(np.asarray(time_utc_s, dtype=float))
        after = replace(
            camera,
            heading_deg=camera.heading_deg + self.heading_deg,
            pitch_deg=camera.pitch_deg + self.pitch_deg,
            roll_deg=camera.roll_deg + self.roll_deg,
        )
        turned = (times >= self.time_utc_s)[:, None, None]
        return np.where(turned, camera.rotation.T @ after.rotation, np.eye(3))


def _about(axis: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """(N, 3, 3) rotations by angles (N,) about a unit vector, by the right hand."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, cosine = np.sin(angle_rad)[:, None, None], np.cos(angle_rad)[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross))


@dataclass(frozen=True, eq=False)
class _SeenPath(Path):
    """Places relative to the platform; course and speed through the water stay what they are."""

    own: Path | None = None
    platform: SimulatedPlatform | None = None

    @classmethod
    def of(cls, path: Path, platform: SimulatedPlatform) -> _SeenPath:
        return cls(path.time_s, path.position_m, path.resting_course_deg, path, platform)

    def at(self, time_s: ArrayLike) -> FloatArray:
        assert self.own is not None, "made by `of`"
        assert self.platform is not None, "made by `of`"
        return self.own.at(time_s) - self.platform.at(time_s)


class Warp:
    """Rotates pictures of a camera that lies still into those of one on a hull that does not."""

    def __init__(self, camera: SimulatedCamera, margin_px: int = 224) -> None:
        """Prepare the still camera.

        Args:
            camera: On board, while the hull lies level.
            margin_px: How much more the still camera sees on each side.
        """
        width, height = camera.image_size_px
        self.still = replace(camera, image_size_px=(width + 2 * margin_px, height + 2 * margin_px))
        self._size = camera.image_size_px
        columns = np.arange(0.5, width + _GRID_PX, _GRID_PX)
        rows = np.arange(0.5, height + _GRID_PX, _GRID_PX)
        self._rays = camera.directions(np.stack(np.meshgrid(columns, rows), axis=-1))

    def apply(
        self, image: NDArray[np.uint8], turn: FloatArray, heave_m: float = 0.0
    ) -> NDArray[np.uint8]:
        """The picture of the turned camera.

        What a camera that has risen sees is right on the water, where boxes end; the tops of boats
        are off by their height times the share by which the camera rose.

        Args:
            image: Of `still`.
            turn: (3, 3) as of `SimulatedPlatform.turn`.
            heave_m: How much higher the camera is.
        """
        # A ray of the hull is this one in the world; it is looked up where the still camera has it.
        height = self.still.height_m
        rays = self._rays @ turn
        down = rays[..., 2] < 0.0
        # From another height the same point of the water is seen at another depression.
        rays[..., 2] = np.where(down, rays[..., 2] * height / (height + heave_m), rays[..., 2])
        lens = np.array([0.0, 0.0, height])
        coarse = self.still.project(lens + rays).astype(np.float32) - np.float32(0.5)
        width, height = self._size
        fine = cv2.warpAffine(
            coarse,
            np.array([[_GRID_PX, 0.0, 0.0], [0.0, _GRID_PX, 0.0]]),
            (width, height),
            flags=cv2.INTER_LINEAR,
        )
        return np.asarray(
            cv2.remap(image, fine, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),  # type: ignore[call-overload]
            dtype=np.uint8,
        )
