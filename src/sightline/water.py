"""Water levels over time, below a camera at a fixed height.

The model of a camera knows its height above a datum, and the water is where a gauge or a table of
tides says: a metre of tide under a camera four metres high is a quarter of every range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sightline.errors import InputError
from sightline.types import FloatArray, utc_text

LEVEL_SIGMA_M = 0.1
"""How far off a level is taken to be: tables of tides know nothing of wind and weather."""

_HELD_S = 1800.0
"""So long a level is taken to last beyond the ends of a table."""
_SLACK_S = 3600.0
"""Between rows further apart the water is taken to rise and fall as between two slacks."""
_LONGEST_GAP_S = 8.0 * 3600.0


@dataclass(frozen=True, eq=False)
class WaterLevels:
    """Water levels above the datum that all recordings of a camera share.

    Attributes:
        time_utc_s: (N,) float64, strictly increasing; of a single level it does not matter.
        level_m: (N,) float64, metres above the datum.

    Raises:
        InputError: There is no level, a value is not a number, or times do not increase.
    """

    time_utc_s: FloatArray
    level_m: FloatArray

    def __post_init__(self) -> None:
        for name in ("time_utc_s", "level_m"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.ndim != 1 or not np.isfinite(values).all():
                raise InputError(f"water levels: a value of {name} is not a number")
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        n = self.time_utc_s.size
        if n == 0 or self.level_m.size != n or (np.diff(self.time_utc_s) <= 0.0).any():
            raise InputError("water levels: at least one is needed, and their times must increase")

    @classmethod
    def constant(cls, level_m: float) -> WaterLevels:
        """A constant water level."""
        return cls(np.zeros(1), np.array([level_m]))

    def at(self, time_utc_s: ArrayLike) -> FloatArray:
        """(N,) water levels at times, metres above the datum.

        Between rows up to an hour apart the level goes straight. Rows further apart are taken for
        high and low water, between which a tide follows half a cosine.

        Args:
            time_utc_s: (N,) POSIX seconds.

        Raises:
            InputError: The levels say nothing of a time.
        """
        times = np.asarray(time_utc_s, dtype=np.float64)
        if self.time_utc_s.size == 1:
            return np.full(times.shape, self.level_m[0])
        first, last = self.time_utc_s[[0, -1]]
        after = np.clip(np.searchsorted(self.time_utc_s, times), 1, self.time_utc_s.size - 1)
        begin = self.time_utc_s[after - 1]
        gap = self.time_utc_s[after] - begin
        unknown = ~((times >= first - _HELD_S) & (times <= last + _HELD_S))
        unknown |= (gap > _LONGEST_GAP_S) & (times > begin) & (times < begin + gap)
        if unknown.any():
            time_s = float(times[np.argmax(unknown)])
            when = utc_text(time_s) if np.isfinite(time_s) else "a frame without a time"
            raise InputError(
                f"water levels: they say nothing of {when}; they run from {utc_text(first)} to "
                f"{utc_text(last)} (UTC), and no gap may be longer than "
                f"{_LONGEST_GAP_S / 3600.0:g} h"
            )
        share = np.clip((times - begin) / gap, 0.0, 1.0)
        share = np.where(gap > _SLACK_S, 0.5 - 0.5 * np.cos(np.pi * share), share)
        return np.asarray(
            self.level_m[after - 1] + share * (self.level_m[after] - self.level_m[after - 1])
        )
