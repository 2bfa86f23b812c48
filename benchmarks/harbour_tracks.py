"""Boats on curved paths before a level camera, without pixels: truth and noisy positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.geodesy import LocalPlane
from sightline.types import FloatArray, Positions

HEIGHT_M = 3.5
FOCAL_PX = 940.0
HALF_VIEW_RAD = 0.55
PLANE = LocalPlane(32.703, -117.2346)
EPOCH_UTC_S = 1_600_000_000.0


@dataclass(frozen=True, eq=False)
class Scene:
    """One boat: when it was seen, where it was, where it seemed to be."""

    time_utc_s: FloatArray
    truth_m: FloatArray
    velocity_mps: FloatArray
    positions: Positions
    outlier: np.ndarray


def path(rng: np.random.Generator, duration_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, positions and velocities of a boat that steers for one place after another."""
    step = 0.1
    n = int(duration_s / step) + 2

    def place() -> FloatArray:
        range_m = np.exp(rng.uniform(np.log(30.0), np.log(300.0)))
        bearing = rng.uniform(-HALF_VIEW_RAD, HALF_VIEW_RAD)
        return range_m * np.array([np.sin(bearing), np.cos(bearing)])

    at, goal = place(), place()
    speed = wanted = rng.uniform(1.0, 8.0)
    heading = np.arctan2(*(goal - at))
    turn = 0.0
    out = np.empty((n, 4))
    for i in range(n):
        to_goal = goal - at
        # Further off than its turning circle, or it would go round its goal for ever.
        if np.hypot(*to_goal) < 20.0 + 2.0 * speed / 0.1:
            goal, wanted = place(), rng.uniform(1.0, 8.0)
        off = (np.arctan2(*to_goal) - heading + np.pi) % (2.0 * np.pi) - np.pi
        # A rudder's limits: 6 degrees a second at most, reached within two seconds.
        turn += step / 2.0 * (np.clip(0.3 * off, -0.1, 0.1) - turn)
        heading += step * turn
        speed += step * np.clip(0.3 * (wanted - speed), -0.3, 0.3)
        velocity = speed * np.array([np.sin(heading), np.cos(heading)])
        out[i] = *at, *velocity
        at = at + step * velocity
    return step * np.arange(n), out[:, :2], out[:, 2:]


def lasting(rng: np.random.Generator, time_s: FloatArray, correlation_time_s: float) -> FloatArray:
    """(N,) draws of unit variance, correlated over `correlation_time_s`; 0: independent."""
    draws = rng.standard_normal(time_s.size)
    if correlation_time_s > 0.0:
        kept = np.exp(-np.diff(time_s) / correlation_time_s)
        for i, a in enumerate(kept):
            draws[i + 1] = a * draws[i] + np.sqrt(1.0 - a * a) * draws[i + 1]
    return draws


def scene(
    seed: int,
    *,
    correlation_time_s: float = 0.0,
    outliers: float = 0.0,
    dropouts: bool = False,
    sparse: bool = False,
) -> Scene:
    """One boat.

    Args:
        seed: Of everything.
        correlation_time_s: How long errors of boxes last; 0: white.
        outliers: Share of boxes that are grossly wrong.
        dropouts: Gaps of one to eight seconds, single missing boxes and a rate that changes.
        sparse: One box each four seconds, 20 to 40 of them.
    """
    rng = np.random.default_rng(seed)
    if sparse:
        time = 4.0 * np.arange(rng.integers(20, 41)) + rng.uniform(-0.3, 0.3)
        time = time - time[0]
    else:
        time = np.arange(0.0, rng.uniform(60.0, 180.0), 1.0 / rng.uniform(10.0, 25.0))
    if dropouts:
        keep = rng.random(time.size) > 0.1
        keep &= ~((time % 40.0 > 20.0) & (np.arange(time.size) % 2 == 0))
        for start in rng.uniform(0.0, time[-1], 4):
            keep &= ~((time > start) & (time < start + rng.uniform(1.0, 8.0)))
        time = time[keep]
    fine, at, velocity = path(rng, float(time[-1]) + 0.1)
    truth = np.stack([np.interp(time, fine, column) for column in at.T], axis=1)
    moving = np.stack([np.interp(time, fine, column) for column in velocity.T], axis=1)

    foot_px = HEIGHT_M * FOCAL_PX / np.hypot(*truth.T) + lasting(rng, time, correlation_time_s)
    bearing = np.arctan2(*truth.T) + 1.5 / FOCAL_PX * lasting(rng, time, correlation_time_s)
    wrong = rng.random(time.size) < outliers
    foot_px = np.where(wrong, foot_px * rng.uniform(0.3, 2.5, time.size) + 5.0, foot_px)
    bearing = np.where(wrong, bearing + rng.normal(0.0, 0.1, time.size), bearing)
    known = foot_px > 2.0
    range_m = np.where(known, HEIGHT_M * FOCAL_PX / np.where(known, foot_px, 1.0), np.nan)
    axes = np.stack([np.sin(bearing), np.cos(bearing), np.cos(bearing), -np.sin(bearing)], axis=1)
    axes = axes.reshape(-1, 2, 2)
    sigma = np.stack([range_m**2 / (HEIGHT_M * FOCAL_PX), range_m * 1.5 / FOCAL_PX], axis=1)
    return Scene(
        time_utc_s=EPOCH_UTC_S + time,
        truth_m=truth,
        velocity_mps=moving,
        positions=Positions(
            east_m=range_m * np.sin(bearing),
            north_m=range_m * np.cos(bearing),
            covariance_m2=np.swapaxes(axes, 1, 2) @ (sigma[:, :, None] ** 2 * axes),
            extrapolated=~known,
            plane=PLANE,
        ),
        outlier=wrong,
    )
