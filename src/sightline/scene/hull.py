"""What is stated of a logged vessel's hull: its size, and where on it the antenna stands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.camera.observations import UNDER_WAY_MPS
from sightline.geodesy import LocalPlane
from sightline.reference_trajectory import ReferenceTrajectory, without_leaps
from sightline.types import Fixes


@dataclass(frozen=True)
class Hull:
    """Stated dimensions of a hull; NaN where nobody states them.

    Attributes:
        length_m: From bow to stern.
        beam_m: From side to side.
        ahead_m: How far the middle of the hull lies ahead of the antenna.
        starboard_m: How far it lies to starboard of it.
    """

    length_m: float = math.nan
    beam_m: float = math.nan
    ahead_m: float = math.nan
    starboard_m: float = math.nan

    @classmethod
    def of(
        cls,
        length_m: float | None,
        beam_m: float | None,
        antenna_m: Sequence[float] | None,
    ) -> Hull:
        """A hull by what is stated of it, as far as it is.

        Args:
            length_m: From bow to stern.
            beam_m: From side to side.
            antenna_m: From the antenna to bow, stern, port and starboard, as AIS has them: zero to
                both sides is as much as nothing.
        """
        bow, stern, port, starboard = antenna_m or (0.0, 0.0, 0.0, 0.0)
        long, wide = bow + stern, port + starboard
        # A receiver at the very bow and side stands for one of which AIS knows no place.
        known = long > 0.0 and not bow == port == 0.0
        return cls(
            length_m=length_m or long or math.nan,
            beam_m=beam_m or wide or math.nan,
            ahead_m=0.5 * (bow - stern) if known else math.nan,
            starboard_m=0.5 * (starboard - port) if known else math.nan,
        )

    def completed(self, told: Hull) -> Hull:
        """The hull with what another tells of it where nothing is stated."""
        antenna = self if self.antenna_known else told
        return Hull(
            self.length_m if math.isfinite(self.length_m) else told.length_m,
            self.beam_m if math.isfinite(self.beam_m) else told.beam_m,
            antenna.ahead_m,
            antenna.starboard_m,
        )

    @property
    def size_m(self) -> tuple[float, float]:
        """Length and beam; NaN where nobody states them."""
        return self.length_m, self.beam_m

    @property
    def antenna_known(self) -> bool:
        """Whether the place of the antenna along the hull is stated."""
        return math.isfinite(self.ahead_m)

    def middle_of(self, fixes: Fixes) -> Fixes:
        """Fixes of the middle of the hull, from those of its antenna.

        The bow points where the vessel goes; one that does not go keeps the course that it has
        before or after, whichever is nearer. Of one that never goes nothing is moved.

        Args:
            fixes: Of the antenna.
        """
        if not self.antenna_known or not len(fixes):
            return fixes
        plane = LocalPlane(
            float(np.median(fixes.latitude_deg)), float(np.median(fixes.longitude_deg))
        )
        log = ReferenceTrajectory.of(without_leaps(fixes, plane)[0], plane)
        velocity = log.smooth_velocity(fixes.time_utc_s)
        speed = np.hypot(*velocity.T)
        goes = np.flatnonzero(speed > UNDER_WAY_MPS)
        if not goes.size:
            return fixes
        times = fixes.time_utc_s
        after = np.clip(np.searchsorted(times[goes], times), 1, max(goes.size - 1, 1))
        before, after = goes[after - 1], goes[np.minimum(after, goes.size - 1)]
        nearest = np.where(times - times[before] < times[after] - times, before, after)
        east, north = (velocity[nearest] / speed[nearest, None]).T
        at_east, at_north = plane.to_plane(fixes.latitude_deg, fixes.longitude_deg)
        latitude, longitude = plane.to_geographic(
            at_east + self.ahead_m * east + self.starboard_m * north,
            at_north + self.ahead_m * north - self.starboard_m * east,
        )
        return replace(fixes, latitude_deg=latitude, longitude_deg=longitude)
