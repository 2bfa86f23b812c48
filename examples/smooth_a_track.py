"""Smooth the positions of one boat, fill the gaps, and look a few seconds ahead."""

import numpy as np

from sightline.geodesy import LocalPlane
from sightline.trajectory import RtsSmoother, method
from sightline.types import PointKind, Positions

SIGMA_ALONG_M = 6.0
SIGMA_ACROSS_M = 1.0


def main() -> None:
    # A boat that passes 100 m before a camera at the origin, seen five times a second, with a
    # gap of ten seconds behind a pier.
    rng = np.random.default_rng(1)
    time_s = np.arange(0.0, 60.0, 0.2)
    time_s = time_s[(time_s < 25.0) | (time_s > 35.0)]
    true = np.stack([-90.0 + 3.0 * time_s, np.full(time_s.size, 100.0)], axis=1)

    # A camera sees well in which direction a boat lies, and badly how far away it is.
    bearing = np.arctan2(true[:, 0], true[:, 1])
    along = np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    across = np.stack([np.cos(bearing), -np.sin(bearing)], axis=1)
    measured = true + SIGMA_ALONG_M * rng.normal(size=(time_s.size, 1)) * along
    measured += SIGMA_ACROSS_M * rng.normal(size=(time_s.size, 1)) * across
    covariance = SIGMA_ALONG_M**2 * along[:, :, None] * along[:, None, :]
    covariance += SIGMA_ACROSS_M**2 * across[:, :, None] * across[:, None, :]
    positions = Positions(
        east_m=measured[:, 0],
        north_m=measured[:, 1],
        covariance_m2=covariance,
        extrapolated=np.zeros(time_s.size, dtype=bool),
        plane=LocalPlane(latitude_deg=54.3233, longitude_deg=10.1394),
    )

    error = np.hypot(*(measured - true).T)
    print(f"single boxes: {np.sqrt(np.mean(error**2)):.2f} m RMSE")
    for name in ("paper", "rts"):
        track = method(name).apply(time_s, positions)
        error = np.hypot(track.east_m - true[:, 0], track.north_m - true[:, 1])
        print(f"{name}: {np.sqrt(np.mean(error**2)):.2f} m RMSE")

    # Any time can be asked for: in the gap, and after the end.
    track = RtsSmoother().apply(time_s, positions, at_utc_s=np.array([10.0, 30.0, 65.0]))
    for i in range(len(track)):
        sigma_m = np.sqrt(np.linalg.eigvalsh(track.covariance_m2[i])[-1])
        print(
            f"after {track.time_utc_s[i]:.0f} s: {track.east_m[i]:.1f} m east, "
            f"{track.north_m[i]:.1f} m north, ± {sigma_m:.1f} m in the worst direction, "
            f"{track.speed_mps[i]:.1f} m/s, {PointKind(track.kind[i]).name.lower()}"
        )


if __name__ == "__main__":
    main()
