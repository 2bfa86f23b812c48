"""Frames of a recording beside the place that the log states, and where that is in the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.labelling.expected import Expected, TargetSize, expect
from sightline.logged_motion import LARGEST_SIGMA_M
from sightline.reference_trajectory import ReferenceTrajectory, without_leaps
from sightline.scene import Recording
from sightline.scene.correspondences import levels_at
from sightline.synchronisation import LARGEST_GAP_S, Synchronised
from sightline.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class LoggedFrames:
    """Frames of a recording beside its log, one row a frame.

    Attributes:
        frame: (N,) int64, increasing.
        time_utc_s: (N,) float64, POSIX seconds by the log's clock; NaN where not known.
        east_north_m: (N, 2) float64, metres in the plane; NaN where the log does not tell.
        velocity_mps: (N, 2) float64, east and north; 0 where it does not tell.
        sigma_m: (N,) float64, of the place, by gaps of the log.
        gap_s: (N,) float64, seconds to the nearest fix; infinite without any.
        span_s: (N,) float64, seconds between the fixes on either side; infinite outside the log.
    """

    frame: IntArray
    time_utc_s: FloatArray
    east_north_m: FloatArray
    velocity_mps: FloatArray
    sigma_m: FloatArray
    gap_s: FloatArray
    span_s: FloatArray

    @classmethod
    def of(
        cls, recording: Recording, frame: IntArray, time_utc_s: FloatArray, plane: LocalPlane
    ) -> LoggedFrames:
        """Look frames up in the log of a recording; nothing is known of them without one.

        Args:
            recording: Whose log.
            frame: (N,) frames.
            time_utc_s: (N,) POSIX seconds of these, by the log's clock.
            plane: Of the places.

        Raises:
            InputError: The log cannot be used.
        """
        n = frame.size
        nowhere, never = np.full((n, 2), np.nan), np.full(n, np.inf)
        if recording.fixes_path is None:
            return cls(frame, time_utc_s, nowhere, np.zeros((n, 2)), never, never, never)
        fixes, _ = without_leaps(recording.fixes(), plane)
        path = ReferenceTrajectory.of(fixes, plane)
        at = path.at(time_utc_s)
        place = at.east_north_m.copy()
        sigma = np.where(np.isfinite(at.sigma_m), at.sigma_m, np.inf)
        place[sigma > LARGEST_SIGMA_M] = np.nan
        near = np.full(n, np.inf)
        if len(path.time_utc_s):
            right = np.searchsorted(path.time_utc_s, time_utc_s)
            for beside in (right - 1, right):
                beside = np.clip(beside, 0, len(path.time_utc_s) - 1)
                off = np.abs(path.time_utc_s[beside] - time_utc_s)
                near = np.fmin(near, off)
        span = np.diff(at.fix_time_utc_s, axis=1)[:, 0]
        # Between near fixes a fit takes the place for certain, as what it is off is in its noise.
        sigma = np.where(span <= LARGEST_GAP_S, 0.0, sigma)
        return cls(
            frame,
            time_utc_s,
            place,
            np.nan_to_num(path.smooth_velocity(time_utc_s)),
            sigma,
            near,
            np.where(np.isfinite(span), span, np.inf),
        )

    def __len__(self) -> int:
        return int(self.frame.size)

    def __getitem__(self, rows: IntArray | BoolArray) -> LoggedFrames:
        return LoggedFrames(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def joined(self, other: LoggedFrames) -> LoggedFrames:
        """These frames, then those of another."""
        names = self.__dataclass_fields__
        return LoggedFrames(
            *(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names)
        )

    @property
    def known(self) -> BoolArray:
        """(N,) bool, whether the log tells the place."""
        return np.asarray(np.isfinite(self.east_north_m).all(axis=1))

    def water_level_m(
        self, recording: Recording, georeferencer: Georeferencer
    ) -> FloatArray | None:
        """(N,) water levels, NaN where not known; None for a model that knows of none."""
        if georeferencer.water_level_m is None:
            return None
        out = np.full(len(self), np.nan)
        rows = np.flatnonzero(self.known)
        try:
            out[rows] = levels_at(recording, self.time_utc_s[rows])
        except InputError:
            return out
        return out

    def expected(
        self, recording: Recording, georeferencer: Georeferencer, size: TargetSize
    ) -> Expected:
        """The boxes that a fitted camera expects of the target in these frames.

        Args:
            recording: Tells the water levels.
            georeferencer: Has a camera that stands still.
            size: Of the target.

        Raises:
            InputError: The model has no camera.
        """
        level = self.water_level_m(recording, georeferencer)
        known = self.known if level is None else self.known & np.isfinite(level)
        east, north = np.where(known[:, None], self.east_north_m, np.nan).T
        velocity = self.velocity_mps.T
        span_s = np.minimum(self.span_s, 1e3)
        place = Synchronised(east, north, velocity[0], velocity[1], span_s)
        safe = None if level is None else np.where(known, level, georeferencer.water_level_m or 0.0)
        return expect(place, georeferencer, size, safe)
