"""Evaluation of forecasts against a log, from each filtered state of a target.

A forecast is scored from the second position of a target on, once a moment, where the log tells
the place at the time forecast. Beside it stands the log's own extrapolation: constant
velocity from its last two fixes at or before that moment, at those moments at which the last fix
is at most as old as fixes may lie apart, and the two lie no further apart. Other than the forecast
it knows place and velocity at once and to within the receiver's error.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from sightline.errors import InputError
from sightline.evaluation.metrics import ScoredPairs, absolute_error, coverage
from sightline.synchronisation import LARGEST_GAP_S, distinct, synchronise
from sightline.trajectory.forecast import HORIZONS_S, MotionState
from sightline.types import Fixes, FloatArray


@dataclass(frozen=True)
class BesideLog:
    """Forecasts compared with constant velocity from the log's own last two fixes.

    Attributes:
        n: Moments compared.
        rmse: Of the forecasts, metres; NaN, as the other, where there is no moment.
        log_rmse: Of the log's own constant velocity, metres.
    """

    n: int
    rmse: float
    log_rmse: float


@dataclass(frozen=True)
class ForecastError:
    """Errors of forecasts over one lead time.

    Attributes:
        n: Forecasts compared.
        rmse: Metres; NaN, as all others, where there is none.
        mean: Metres.
        median: Metres.
        p90: Metres, the 90th percentile.
        coverage_p95: Share of true positions inside the stated 95 % ellipse.
        beside_log: The same beside the log's own extrapolation.
    """

    n: int
    rmse: float
    mean: float
    median: float
    p90: float
    coverage_p95: float
    beside_log: BesideLog


@dataclass(frozen=True, eq=False)
class ForecastPairs:
    """Forecasts over one lead time, paired with the log.

    Attributes:
        pairs: Forecast and true positions.
        log_error_m: (N,) float64, error of constant velocity from the log's last two fixes, for
            each pair; NaN where those are too old or too far apart.
    """

    pairs: ScoredPairs
    log_error_m: FloatArray


def pair_forecasts(
    states: MotionState,
    fixes: Fixes,
    horizon_s: float,
    *,
    largest_gap_s: float = LARGEST_GAP_S,
) -> ForecastPairs:
    """Pair forecasts of one target, one from each of its states, with a log.

    Args:
        states: N of one target, in the order of time; see `sightline.trajectory.forecast.follow`.
            The first, which knows no velocity, is left out.
        fixes: The log.
        horizon_s: How far ahead, seconds.
        largest_gap_s: Times between fixes that are further apart are not compared.

    Raises:
        InputError: The horizon is not positive.
    """
    if not 0.0 < horizon_s < np.inf:
        raise InputError(f"a forecast over {horizon_s:g} s cannot be scored; give more than 0 s")
    states = states[1:]
    then = states.time_utc_s + horizon_s
    log = synchronise(fixes, then, states.plane, largest_gap_s=largest_gap_s)
    keep = log.matched
    mean, covariance = states[keep].ahead(horizon_s).moments()
    true = np.stack([log.east_m, log.north_m], axis=1)[keep]
    pairs = ScoredPairs(
        time_utc_s=then[keep],
        east_m=mean[:, 0],
        north_m=mean[:, 1],
        covariance_m2=covariance[:, :2, :2],
        true_east_m=true[:, 0],
        true_north_m=true[:, 1],
        segment=np.zeros(int(keep.sum()), dtype=np.int64),
        asked=len(states),
    )
    foretold = _constant_velocity(states[keep], fixes, horizon_s, largest_gap_s)
    return ForecastPairs(pairs, np.hypot(*(foretold - true).T))


def _constant_velocity(
    states: MotionState, fixes: Fixes, horizon_s: float, largest_gap_s: float
) -> FloatArray:
    """(N, 2) extrapolations of the last two fixes before each state; NaN where too old."""
    log = distinct(fixes)
    out = np.full((len(states), 2), np.nan)
    if len(log) < 2:
        return out
    place = np.stack(states.plane.to_plane(log.latitude_deg, log.longitude_deg), axis=1)
    last = np.searchsorted(log.time_utc_s, states.time_utc_s, side="right") - 1
    before = np.maximum(last - 1, 0)
    age = states.time_utc_s - log.time_utc_s[last]
    apart = log.time_utc_s[last] - log.time_utc_s[before]
    fresh = (last >= 1) & (age <= largest_gap_s) & (apart <= largest_gap_s)
    velocity = (place[last] - place[before])[fresh] / apart[fresh, None]
    out[fresh] = place[last][fresh] + velocity * (age[fresh, None] + horizon_s)
    return out


def forecast_errors(
    targets: Iterable[tuple[MotionState, Fixes]], horizons_s: Iterable[float] = HORIZONS_S
) -> dict[str, ForecastError]:
    """Errors of the forecasts of some targets, pooled, for each lead time.

    Args:
        targets: For each target its states and its log; see `pair_forecasts`.
        horizons_s: Seconds.

    Returns:
        By the time ahead in seconds, ``"5"``.
    """
    known = list(targets)
    return {
        f"{horizon:g}": _error([pair_forecasts(states, log, horizon) for states, log in known])
        for horizon in horizons_s
    }


def _error(parts: list[ForecastPairs]) -> ForecastError:
    pairs = ScoredPairs.concatenate(part.pairs for part in parts)
    log_error = np.concatenate([part.log_error_m for part in parts] or [np.empty(0)])
    both = np.isfinite(log_error)
    error = absolute_error(pairs)
    return ForecastError(
        n=error.n,
        rmse=error.rmse,
        mean=error.mean,
        median=error.median,
        p90=error.p90,
        coverage_p95=coverage(pairs).p95,
        beside_log=BesideLog(int(both.sum()), _rms(pairs.error_m[both]), _rms(log_error[both])),
    )


def _rms(error_m: FloatArray) -> float:
    return float(np.sqrt(np.mean(error_m**2))) if error_m.size else float("nan")


Forecasts = Mapping[str, ForecastError]
"""Errors by the time ahead in seconds."""
