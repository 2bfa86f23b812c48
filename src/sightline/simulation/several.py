"""One harbour before several cameras: the same boats at the same times, each seen by some."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.errors import InputError
from sightline.simulation.boats import Boat, dinghy, ferry, motorboat, sailboat
from sightline.simulation.camera import SimulatedCamera
from sightline.simulation.harbour import DOCK, START_UTC_S, Harbour, Pile
from sightline.simulation.paths import Path, rest, steer
from sightline.types import FloatArray

_APART_DEG = 55.0
_NEAREST_M = 40.0
_PAST_S = 30.0
_TRIES = 40


@dataclass(frozen=True)
class SeveralSettings:
    """Settings of `harbours`.

    Attributes:
        cameras: How many look at the same water.
        vessels: How many go or lie there; every seventh lies at anchor.
        duration_s: How long.
        water_m: Radius of the water that the cameras look at, each from its edge.
        start_utc_s: POSIX seconds.

    Raises:
        InputError: There is no camera or no vessel, or the water is too small for them.
    """

    cameras: int = 3
    vessels: int = 20
    duration_s: float = 240.0
    water_m: float = 300.0
    start_utc_s: float = START_UTC_S

    def __post_init__(self) -> None:
        if self.cameras < 1 or self.vessels < 1:
            raise InputError("at least one camera and one vessel are needed")
        if not self.water_m >= 2.0 * _NEAREST_M:
            raise InputError(
                f"water of {self.water_m:g} m is too small; give {2.0 * _NEAREST_M:g} m or more"
            )


def harbours(seed: int = 0, settings: SeveralSettings | None = None) -> tuple[Harbour, ...]:
    """One harbour as each of several cameras sees it, which stand around its water.

    Vessels have the same ``identity`` before all cameras. No camera sees all of the water; piles
    before each hide what passes behind them.

    Args:
        seed: The same seed and settings give the same world.
        settings: What is in it.
    """
    settings = settings or SeveralSettings()
    rng = np.random.default_rng([seed, 21])
    first = rng.uniform(0.0, 360.0)
    bearings = first + _APART_DEG * (np.arange(settings.cameras) - 0.5 * (settings.cameras - 1))
    angle = np.radians(bearings)
    # From the middle of the water, and then from the first camera.
    stands = -settings.water_m * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    cameras = [_camera(rng, float(bearing)) for bearing in bearings]
    boats = _boats(rng, stands, settings)
    middle = Harbour(
        camera=cameras[0],
        plane=DOCK,
        boats=boats,
        start_utc_s=settings.start_utc_s,
        duration_s=settings.duration_s,
        seed=seed,
    )
    return tuple(
        middle.seen_from(camera, stand, piles=_piles(rng, camera))
        for camera, stand in zip(cameras, stands, strict=True)
    )


def _camera(rng: np.random.Generator, bearing_deg: float) -> SimulatedCamera:
    """One as people mount on the roof of a harbour office, that looks at the middle."""
    k1 = float(rng.uniform(-0.25, -0.08))
    return SimulatedCamera(
        height_m=float(rng.uniform(12.0, 25.0)),
        pitch_deg=float(rng.uniform(2.0, 6.0)),
        roll_deg=float(rng.uniform(-1.5, 1.5)),
        heading_deg=float(bearing_deg + rng.uniform(-8.0, 8.0)) % 360.0,
        focal_length_px=float(rng.uniform(0.7, 0.95)) * 1280,
        k1=k1,
        k2=float(rng.uniform(0.5, 0.8)) * k1**2,
    )


def _boats(
    rng: np.random.Generator, stands: FloatArray, settings: SeveralSettings
) -> tuple[Boat, ...]:
    boats: list[Boat] = []
    times = np.arange(0.0, settings.duration_s, 0.5)
    for number in range(1, settings.vessels + 1):
        kind = number % 7
        shape = (
            sailboat(rng, sails=bool(kind))
            if kind in (0, 2, 5)
            else ferry(rng)
            if kind == 4
            else dinghy(rng)
            if kind == 6
            else motorboat(rng)
        )
        for _ in range(_TRIES):
            path = _path(rng, kind, settings)
            place = path.at(times)
            free = all(np.hypot(*(place - stand).T).min() > _NEAREST_M for stand in stands)
            for other in boats:
                apart = np.hypot(*(place - other.path.at(times)).T).min()
                free &= bool(apart > 0.5 * (shape.length_m + other.shape.length_m) + 4.0)
            if free:
                break
        boats.append(Boat(number, f"{shape.kind}-{number}", shape, path))
    return tuple(boats)


def _path(rng: np.random.Generator, kind: int, settings: SeveralSettings) -> Path:
    def place(share: float) -> FloatArray:
        distance = share * settings.water_m * np.sqrt(rng.uniform())
        bearing = rng.uniform(0.0, 2.0 * np.pi)
        return np.array([distance * np.sin(bearing), distance * np.cos(bearing)])

    if kind == 0:
        return rest(place(0.8), float(rng.uniform(0.0, 360.0)), settings.duration_s)
    slowest, fastest, turn_rate_dps = {
        2: (1.2, 3.2, 5.0),
        4: (3.0, 5.5, 2.5),
        5: (1.2, 3.2, 5.0),
    }.get(kind, (1.5, 7.0, 10.0))
    count = 24
    cruise = rng.uniform(slowest, fastest)
    return steer(
        np.stack([place(0.95) for _ in range(count)]),
        speed_mps=np.clip(cruise * rng.uniform(0.75, 1.25, count), slowest, fastest),
        turn_rate_dps=turn_rate_dps,
        start_s=-_PAST_S,
        end_s=settings.duration_s + 1.0,
    )


def _piles(rng: np.random.Generator, camera: SimulatedCamera) -> tuple[Pile, ...]:
    """Dolphins before a camera, of which each hides a few degrees."""
    half_deg = 0.5 * camera.field_of_view_deg
    out = []
    for side in (-0.5, 0.4):
        bearing = np.radians(camera.heading_deg + half_deg * (side + rng.uniform(-0.2, 0.2)))
        distance = float(rng.uniform(20.0, 30.0))
        east_m, north_m = distance * float(np.sin(bearing)), distance * float(np.cos(bearing))
        out.append(Pile(east_m, north_m, radius_m=0.04 * distance, top_m=camera.height_m + 0.5))
    return tuple(out)
