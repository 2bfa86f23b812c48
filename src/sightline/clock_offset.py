"""The offset of a camera's clock against a log's: an estimate, its prior, and the zones of clocks.

One sign everywhere: an offset is how far the camera's clock is *ahead* of the log's. Taken off the
camera's times it gives the log's.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

LARGEST_OFFSET_S = 60.0
"""Clocks that are further apart than this are not brought together, but for whole zones."""

STATED_SIGMA_S = 0.1
"""Standard deviation of a clock offset that somebody states without one."""

USUAL_SIGMA_S = 0.5
"""Standard deviation of a clock that is right: logs and clocks often keep whole seconds."""

ZONES_S = tuple(
    sign * 3600.0 * hours
    for hours in sorted([0.5 * k for k in range(1, 29)] + [5.75, 8.75, 12.75, 13.75])
    for sign in (1.0, -1.0)
)
"""Offsets of time zones against UTC, and of summer time: the nearest first."""

# Standard deviations: a right clock seems to be off in one recording of eighty, by half a second or
# so, and one that is off by a second is seldom missed.
_SURE = 2.5
_ZONE_NATS = 5.0


@dataclass(frozen=True)
class ClockOffset:
    """How far the camera's clock of a recording is ahead of the log's.

    Attributes:
        offset_s: Seconds; negative where it is behind.
        sigma_s: Its standard deviation.
        stated: Whether somebody has stated it, so that it counts however small it is.
    """

    offset_s: float
    sigma_s: float
    stated: bool = False

    @property
    def used_s(self) -> float:
        """What is taken off the camera's times: nothing that is not sure to be there."""
        sure = abs(self.offset_s) > _SURE * self.sigma_s
        return self.offset_s if self.stated or sure else 0.0

    @property
    def words(self) -> str:
        """As ``"40.0 ± 0.1 s ahead of the log"``."""
        size, sigma = abs(self.offset_s), max(self.sigma_s, 0.05)
        return (
            f"{size:.1f} ± {sigma:.1f} s {'ahead of' if self.offset_s > 0.0 else 'behind'} the log"
        )


@dataclass(frozen=True)
class ClockPrior:
    """What is believed of a clock offset before any data.

    A clock that nobody spoke of is mostly right within a second, and sometimes off by anything: a
    Cauchy distribution, whose sides do not pull at what is far out. One that somebody stated is
    normally distributed.

    Attributes:
        mean_s: The camera's clock ahead of the log's, seconds.
        sigma_s: Standard deviation; of the middle of the distribution where it has long sides.
        stated: Whether somebody stated it.
    """

    mean_s: float = 0.0
    sigma_s: float = USUAL_SIGMA_S
    stated: bool = False

    def log_density(self, offset_s: float) -> float:
        """Logarithm of the density against that at the mean."""
        apart = (offset_s - self.mean_s) / self.sigma_s
        if self.stated:
            return -0.5 * apart**2
        near = -np.log1p(0.5 * apart**2)
        zone = offset_s - self.mean_s - self._zone_s(offset_s)
        return float(max(near, -_ZONE_NATS - np.log1p(0.5 * (zone / self.sigma_s) ** 2)))

    def near(self, offset_s: float) -> tuple[float, float]:
        """Mean and standard deviation of the normal distribution that pulls as this does there."""
        if self.stated:
            return self.mean_s, self.sigma_s
        zone_s = self._zone_s(offset_s)
        here = self.log_density(offset_s)
        plain = -np.log1p(0.5 * ((offset_s - self.mean_s) / self.sigma_s) ** 2)
        mean_s = self.mean_s + (zone_s if here > plain else 0.0)
        apart_s = offset_s - mean_s
        return mean_s, float(np.sqrt(self.sigma_s**2 + 0.5 * apart_s**2))

    def _zone_s(self, offset_s: float) -> float:
        apart_s = offset_s - self.mean_s
        return min(ZONES_S, key=lambda zone: abs(apart_s - zone))


@dataclass(frozen=True)
class RecordingClock:
    """What is known of a recording's clock as a fit begins.

    Attributes:
        offset_s: What was taken off its times already.
        prior: Of its offset.
        found: What was found before the fit; None where nothing was looked for.
    """

    offset_s: float = 0.0
    prior: ClockPrior = field(default_factory=ClockPrior)
    found: ClockOffset | None = None

    @property
    def left(self) -> tuple[float, float] | None:
        """Mean and standard deviation of what is to be put back; None: as of any right clock."""
        if not self.offset_s and not self.prior.stated:
            return None
        mean_s, sigma_s = self.prior.near(self.offset_s)
        return self.offset_s - mean_s, sigma_s

    def after(self, put_back_s: float, sigma_s: float) -> ClockOffset:
        """The offset once a fit has told how much is to be put back."""
        return ClockOffset(self.offset_s - put_back_s, sigma_s, self.prior.stated)
