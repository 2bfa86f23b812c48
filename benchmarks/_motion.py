"""The settings of a target's motion that make a log likeliest, at the times that forecasts ask for.

From each window of a log a filter is run over some seconds, and what it then foretells is compared
with the log some seconds to a minute later. The settings with the greatest sum of log densities are
taken (a composite likelihood), with weak beliefs about those that ship.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from sightline.geodesy import LocalPlane
from sightline.synchronisation import LARGEST_GAP_S, distinct
from sightline.trajectory.forecast import HORIZONS_S, MotionModel, MotionState
from sightline.types import BoolArray, Fixes, FloatArray

SIGMA_M = 1.0
STEP_S, STEPS = 2.0, 10
CORRELATION_TIME_S = 5.0
BELIEF = 1.5
LEAST_LOG_DENSITY = -20.0
"""Of one forecast: jumps of a receiver are no motion."""
OVERLAP = 10.0
"""So many windows tell about as much as one: they overlap."""
LEARNED = (
    "turn_rate_radps",
    "mode_s",
    "straight_share",
    "straight_s",
    "turning_s",
    "straight_m2ps3",
    "turning_m2ps3",
)


class Windows:
    """Stretches of a log: N times STEPS places, and those after the forecast times."""

    def __init__(self, fixes: Fixes, plane: LocalPlane, without: tuple[float, float]) -> None:
        log = distinct(fixes)
        self._time_s = log.time_utc_s
        self._en_m = np.stack(plane.to_plane(log.latitude_deg, log.longitude_deg), axis=1)
        self._without = without
        now = np.arange(self._time_s[0], self._time_s[-1], CORRELATION_TIME_S)[:, None]
        before, told = self._at(now + STEP_S * np.arange(1 - STEPS, 1))
        after, known = self._at(now + np.array(HORIZONS_S))
        kept = told.all(axis=1) & known.any(axis=1)
        self.plane = plane
        self.before_m, self.after_m, self.known = before[kept], after[kept], known[kept]

    def _at(self, times: FloatArray) -> tuple[FloatArray, BoolArray]:
        log_s = self._time_s
        after = np.clip(np.searchsorted(log_s, times), 1, len(log_s) - 1)
        known = (times <= log_s[-1]) & (log_s[after] - log_s[after - 1] <= LARGEST_GAP_S)
        known &= (times < self._without[0]) | (times > self._without[1])
        places = [np.interp(times, log_s, column) for column in self._en_m.T]
        return np.stack(places, axis=-1), known


def log_density(motion: MotionModel, windows: Windows) -> float:
    """The mean over the windows, summed over the forecast times."""
    state, last_s, total = _followed(motion, windows), 0.0, 0.0
    for j, ahead_s in enumerate(HORIZONS_S):
        state, last_s = state.ahead(ahead_s - last_s), ahead_s
        mean, covariance = state.moments()
        rows = windows.known[:, j]
        spread = covariance[rows, :2, :2] + SIGMA_M**2 * np.eye(2)
        density = _log_normal(windows.after_m[rows, j] - mean[rows, :2], spread)
        total += float(np.mean(np.maximum(density, LEAST_LOG_DENSITY)))
    return total


def _followed(motion: MotionModel, windows: Windows) -> MotionState:
    """The states at the ends of all windows (a Kalman filter a mode, mixed in between)."""
    places = windows.before_m
    start = np.concatenate([places[:, 0], np.zeros((len(places), 2))], axis=1)
    doubt = np.diag([SIGMA_M**2, SIGMA_M**2, 25.0, 25.0])
    state = MotionState.of_moments(
        np.zeros(len(places)),
        start,
        np.tile(doubt, (len(places), 1, 1)),
        windows.plane,
        motion,
    )
    for j in range(1, places.shape[1]):
        state = state.ahead(STEP_S)
        off = places[:, j, None] - state.mean[..., :2]
        cross = state.covariance[..., :, :2]
        spread = cross[..., :2, :] + SIGMA_M**2 * np.eye(2)
        likely = np.log(np.maximum(state.weight, 1e-300)) + _log_normal(off, spread)
        weight = np.exp(likely - likely.max(axis=1, keepdims=True))
        gain = cross @ np.linalg.inv(spread)
        left = state.covariance - gain @ np.swapaxes(cross, -1, -2)
        state = replace(
            state,
            weight=weight / weight.sum(axis=1, keepdims=True),
            mean=state.mean + np.einsum("nkij,nkj->nki", gain, off),
            covariance=0.5 * (left + np.swapaxes(left, -1, -2)),
        )
    return state


def _log_normal(off: FloatArray, spread: FloatArray) -> FloatArray:
    distance2 = np.einsum("...i,...ij,...j->...", off, np.linalg.inv(spread), off)
    return -0.5 * (distance2 + np.log(np.linalg.det(spread))) - np.log(2.0 * np.pi)


def likeliest(fixes: Fixes, plane: LocalPlane, *, without: tuple[float, float]) -> MotionModel:
    """The settings that a log makes likeliest.

    Args:
        fixes: The log.
        plane: Of the places.
        without: Beginning and end of what is left out, POSIX seconds.
    """
    windows, usual = Windows(fixes, plane, without), MotionModel()
    belief = _packed(usual)

    def cost(values: FloatArray) -> float:
        told = len(windows.known) / OVERLAP * log_density(_unpacked(values), windows)
        return 0.5 * float(np.sum(((values - belief) / BELIEF) ** 2)) - told

    options = {"maxfev": 250, "xatol": 0.02, "fatol": 0.02}
    return _unpacked(minimize(cost, belief, method="Nelder-Mead", options=options).x)


def _packed(motion: MotionModel) -> FloatArray:
    values = {name: getattr(motion, name) for name in LEARNED}
    values["straight_share"] /= 1.0 - values["straight_share"]
    return np.log(list(values.values()))


def _unpacked(values: FloatArray) -> MotionModel:
    plain = dict(zip(LEARNED, np.exp(np.clip(values, -12.0, 12.0)).tolist(), strict=True))
    plain["straight_share"] /= 1.0 + plain["straight_share"]
    return MotionModel(**plain)
