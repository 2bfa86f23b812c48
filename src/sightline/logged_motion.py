"""Motion of a logged vessel in the gaps of its log: the path between fixes, with its uncertainty.

Acceleration is white noise, so that velocity is a Wiener process in east and another in north
(the integrated Wiener process, or "nearly constant velocity"; Bar-Shalom, Li and Kirubarajan 2001,
section 6.2). Between two fixes the expected path is then the cubic of Hermite through places and
velocities that the fixes around it tell, and what it may be off by is a closed form. How restless a
vessel is, its log tells: the density of the acceleration and the error of a fix are those under
which the fixes are likeliest, with weak priors of what vessels do.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.optimize import minimize

from sightline.types import BoolArray, FloatArray, IntArray

LONGEST_GAP_S = 120.0
"""In a longer gap a vessel may have been anywhere."""

SLOWEST_MPS = 0.514
"""A knot: with less a rudder does not steer, and a vessel is not under way."""

LARGEST_SIGMA_M = 40.0
"""A place that is less certain than this tells nothing."""

# Over so long a knot is ten metres, more than a receiver is off.
_WINDOW_S = 20.0
# Medians before any fix, and standard deviations of the logarithms: a boat that is steered by hand,
# and a receiver of a phone's grade.
_DENSITY_M2PS3, _DENSITY_WIDTH = 0.5, 1.5
_FIX_SIGMA_M, _FIX_SIGMA_WIDTH = 0.3, 0.7
# A density that a handful of fixes tell is unsure itself, and vessels turn in bouts.
_BOUTS = 1.4
# A fix that is so many times further off the line between its neighbours than others are leaps.
_LEAP = 8.0
# So many fixes on either side say how fast a vessel went into a gap, and came out of it.
_AROUND = 8
# The first so many say how restless a vessel is.
_MOST_FIXES = 4000


@dataclass(frozen=True)
class MotionNoise:
    """How a logged vessel moves, and how far its fixes are off.

    Attributes:
        density_m2ps3: Power spectral density of the acceleration along either axis.
        fix_sigma_m: Standard deviation of a fix along either axis, anew for each.
    """

    density_m2ps3: float = _DENSITY_M2PS3
    fix_sigma_m: float = _FIX_SIGMA_M


@dataclass(frozen=True, eq=False)
class GapStates:
    """Places and velocities in gaps of a log.

    Attributes:
        east_north_m: (N, 2) float64, metres.
        velocity_mps: (N, 2) float64, east and north.
        sigma_m: (N,) float64, standard deviation of the place along either axis, metres.
    """

    east_north_m: FloatArray
    velocity_mps: FloatArray
    sigma_m: FloatArray


@dataclass(frozen=True, eq=False)
class LoggedMotion:
    """Expected motion of a logged vessel between its fixes.

    Attributes:
        time_s: (K,) float64, strictly increasing.
        east_north_m: (K, 2) float64, metres.
        noise: How it moves.
    """

    time_s: FloatArray
    east_north_m: FloatArray
    noise: MotionNoise
    _known: dict[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, time_s: FloatArray, east_north_m: FloatArray) -> LoggedMotion:
        """The motion of a log, restless as its fixes say.

        Args:
            time_s: (K,) strictly increasing.
            east_north_m: (K, 2) metres.
        """
        return cls(time_s, east_north_m, estimate_motion(time_s, east_north_m))

    def at(self, time_s: FloatArray, left: IntArray) -> GapStates:
        """Places at times in gaps.

        Args:
            time_s: (N,) seconds.
            left: (N,) index of the fix before each; there is one after it.
        """
        n = time_s.size
        out = GapStates(np.empty((n, 2)), np.empty((n, 2)), np.empty(n))
        for gap in np.unique(left):
            rows = np.flatnonzero(left == gap)
            state, covariance = self._ends(int(gap))
            span = float(self.time_s[gap + 1] - self.time_s[gap])
            u = (time_s[rows] - self.time_s[gap]) / span
            weights, slopes = _hermite(u, span)
            out.east_north_m[rows] = weights @ state
            out.velocity_mps[rows] = slopes @ state
            variance = np.einsum("ni,ij,nj->n", weights, covariance, weights)
            variance += self.noise.density_m2ps3 * span**3 * (u * (1.0 - u)) ** 3 / 3.0
            out.sigma_m[rows] = np.sqrt(_BOUTS * variance)
        return out

    def _ends(self, gap: int) -> tuple[FloatArray, FloatArray]:
        """(4, 2) place and velocity at either end of a gap, and their (4, 4) covariance."""
        if gap not in self._known:
            self._known[gap] = self._solve_ends(gap)
        return self._known[gap]

    def _solve_ends(self, gap: int) -> tuple[FloatArray, FloatArray]:
        first, last = max(gap - _AROUND + 1, 0), min(gap + _AROUND + 1, self.time_s.size)
        part = slice(first, last)
        banded, right = _normal(self.time_s[part], self.east_north_m[part], self.noise)
        factor = (cholesky_banded(banded, lower=True, check_finite=False), True)
        at = 2 * (gap - first)
        ends = np.zeros((2 * (last - first), 4))
        ends[np.arange(at, at + 4), np.arange(4)] = 1.0
        state = cho_solve_banded(factor, right, check_finite=False)[at : at + 4]
        covariance = cho_solve_banded(factor, ends, check_finite=False)[at : at + 4]
        return state, covariance


def estimate_motion(time_s: FloatArray, east_north_m: FloatArray) -> MotionNoise:
    """The motion noise under which the fixes of a log are likeliest, with weak priors.

    A fix that leaps off and back is none of the motion, and would make all of it look restless.

    Args:
        time_s: (K,) strictly increasing.
        east_north_m: (K, 2) metres.
    """
    kept = ~spikes(time_s[:_MOST_FIXES], east_north_m[:_MOST_FIXES])
    times, places = time_s[:_MOST_FIXES][kept], east_north_m[:_MOST_FIXES][kept]
    if times.size < 3:
        return MotionNoise()
    places = places - places.mean(axis=0)
    centre = np.log([_DENSITY_M2PS3, _FIX_SIGMA_M])
    width = np.array([_DENSITY_WIDTH, _FIX_SIGMA_WIDTH])

    def negative_log(t: FloatArray) -> float:
        noise = MotionNoise(*np.exp(t).tolist())
        belief = (t - centre) / width
        return 0.5 * float(belief @ belief) - log_likelihood(times, places, noise)

    found = minimize(
        negative_log,
        centre,
        method="Nelder-Mead",
        bounds=list(zip(centre - 4.0 * width, centre + 4.0 * width, strict=True)),
        options={"xatol": 0.05, "fatol": 0.05, "maxiter": 120},
    )
    return MotionNoise(*np.exp(found.x).tolist())


def spikes(time_s: FloatArray, east_north_m: FloatArray) -> BoolArray:
    """(K,) whether a fix leaps off the path and back, as no vessel does.

    It lies far off the line between its neighbours, and with it on that line they lie nearer to
    theirs: where a vessel turns, they would lie further off.

    Args:
        time_s: (K,) strictly increasing.
        east_north_m: (K, 2) metres.
    """
    out = np.zeros(time_s.size, dtype=bool)
    if time_s.size < 7:
        return out
    off, scale = _off_line(time_s, east_north_m)
    size = np.hypot(*off.T)
    far = size / scale
    limit = _LEAP * float(np.median(far[1:-1]))
    for index in np.argsort(-far):
        if far[index] < limit or not 1 < index < time_s.size - 2:
            continue
        part = slice(index - 2, index + 3)
        places = east_north_m[part].copy()
        places[2] -= off[index]
        then = np.hypot(*_off_line(time_s[part], places)[0].T)
        before = size[part]
        if (then[[1, 3]] < 0.5 * before[[1, 3]]).all():
            out[index] = True
    return out


def _off_line(time_s: FloatArray, east_north_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(K, 2) of each fix off the line between its neighbours, and (K,) its scale, alike for all.

    The ends have none. The scale is by how much white acceleration makes it differ with the steps.
    """
    step = np.diff(time_s)
    before, after = step[:-1], step[1:]
    share = (before / (before + after))[:, None]
    off = np.zeros_like(east_north_m)
    line = east_north_m[:-2] + share * (east_north_m[2:] - east_north_m[:-2])
    off[1:-1] = east_north_m[1:-1] - line
    scale = np.ones(time_s.size)
    scale[1:-1] = before * after / np.sqrt(3.0 * (before + after))
    return off, scale


def log_likelihood(time_s: FloatArray, east_north_m: FloatArray, noise: MotionNoise) -> float:
    """Logarithm of the density of fixes under a motion noise, up to a constant.

    Nothing is known of the first place and velocity.

    Args:
        time_s: (K,) strictly increasing.
        east_north_m: (K, 2) metres.
        noise: How the vessel moves.
    """
    banded, right = _normal(time_s, east_north_m, noise)
    try:
        factor = cholesky_banded(banded, lower=True, check_finite=False)
    except LinAlgError:
        return -np.inf
    state = cho_solve_banded((factor, True), right, check_finite=False)
    square = np.sum(east_north_m**2) / noise.fix_sigma_m**2 - np.sum(right * state)
    steps = np.diff(time_s)
    determinant = 2.0 * np.sum(np.log(factor[0])) + 2.0 * time_s.size * np.log(noise.fix_sigma_m)
    determinant += np.sum(np.log(noise.density_m2ps3**2 * steps**4 / 12.0))
    return float(-0.5 * square - determinant)


def _normal(
    time_s: FloatArray, east_north_m: FloatArray, noise: MotionNoise
) -> tuple[FloatArray, FloatArray]:
    """Precision of the states at the fixes, (4, 2 K) lower banded, and the right side (2 K, 2)."""
    k = time_s.size
    banded, right = np.zeros((4, 2 * k)), np.zeros((2 * k, 2))
    banded[0, ::2] = noise.fix_sigma_m**-2
    right[::2] = east_north_m / noise.fix_sigma_m**2
    step = np.diff(time_s)
    # The inverse of the covariance that white acceleration gives place and velocity in a step.
    place = 12.0 / (noise.density_m2ps3 * step**3)
    mixed = 6.0 / (noise.density_m2ps3 * step**2)
    speed = 4.0 / (noise.density_m2ps3 * step)
    banded[0, 0:-2:2] += place
    banded[0, 2::2] += place
    banded[0, 1:-2:2] += speed
    banded[0, 3::2] += speed
    banded[1, 0:-2:2] += mixed
    banded[1, 2::2] -= mixed
    banded[1, 1:-2:2] = -mixed
    banded[2, 0:-2:2] = -place
    banded[2, 1:-2:2] = 0.5 * speed
    banded[3, 0:-2:2] = mixed
    return banded, right


def _hermite(u: FloatArray, span_s: float) -> tuple[FloatArray, FloatArray]:
    """(N, 4) weights of the ends' places and velocities in a place, and in its velocity."""
    v = 1.0 - u
    weights = np.stack(
        [v * v * (1.0 + 2.0 * u), span_s * u * v * v, u * u * (3.0 - 2.0 * u), -span_s * u * u * v],
        axis=1,
    )
    bend = 6.0 * u * v / span_s
    slopes = np.stack([-bend, v * (1.0 - 3.0 * u), bend, u * (3.0 * u - 2.0)], axis=1)
    return weights, slopes


def usable(states: GapStates) -> BoolArray:
    """(N,) whether places in gaps are certain enough to count."""
    return np.asarray(states.sigma_m <= LARGEST_SIGMA_M)


def under_way(time_s: FloatArray, east_north_m: FloatArray, at_s: FloatArray) -> BoolArray:
    """(N,) whether a logged vessel is under way: faster than a knot over 20 s.

    Args:
        time_s: (K,) of its fixes, never decreasing.
        east_north_m: (K, 2) metres.
        at_s: (N,) when it is asked for; before and after the log it is not under way.
    """
    if time_s.size < 2:
        return np.zeros(at_s.shape, dtype=bool)
    begin = np.clip(at_s - 0.5 * _WINDOW_S, time_s[0], time_s[-1])
    end = np.clip(at_s + 0.5 * _WINDOW_S, time_s[0], time_s[-1])
    moved = [
        np.interp(end, time_s, column) - np.interp(begin, time_s, column)
        for column in east_north_m.T
    ]
    inside = (at_s >= time_s[0]) & (at_s <= time_s[-1])
    return np.asarray(inside & (np.hypot(*moved) > SLOWEST_MPS * (end - begin)))
