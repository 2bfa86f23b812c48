r"""Robust Rauch-Tung-Striebel smoother with covariances and learned noise.

The target moves with nearly constant velocity. What is told of a position's covariance is taken
for its size, and the rest is learned from the track itself by maximum likelihood:

* how much of the noise is white from box to box and how much is correlated (a detector that is
  wrong in one frame is wrong in the next), its correlation time, and how large both are against
  what was stated, along the line of sight and across it;
* how hard the target accelerates, usually and in each part of the track.

Priors hold where a track is too short or too sparse to tell.

The noise along the line of sight grows with the range. It is taken at the range that the smoother
*predicts*: a measured range that fell short looks precise, and would pull the track towards the
camera. How it grows is read from the covariances, as a power of the range
:math:`\sigma(r) \propto r^p`, and the measurement is taken in the coordinate

.. math:: z(r) = \int r^{-p}\,dr,

in which its noise is the same everywhere: the inverse range for a camera over a plane
(:math:`p = 2`), the range itself where the covariance does not depend on it. The measurement
equation is linearised at the smoothed track and the smoother run again (an iterated extended
smoother, Bell, *SIAM J. Optim.* 4(3), 1994). With :math:`p = 0` it is linear from the start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import Bounds, minimize
from scipy.special import chdtri

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.trajectory import gauss_markov_chain as chain
from sightline.trajectory.base import Measurements, measurements, point_kinds
from sightline.trajectory.range_noise import Linearised, NoiseAtRange, RobustStart
from sightline.types import BoolArray, EastNorthPositions, FloatArray, Track

_PROCESS_NOISE_SCALE_WIDTH_S = 3.0
_PROCESS_NOISE_SCALE_GRID_S = 0.5
_PROCESS_NOISE_SCALE_DRAWS = 0.5
_PROCESS_NOISE_SCALE_LIMITS = (0.02, 20.0)
_MOST_ROUNDS = 5
_SETTLED = 0.2
"""The track is done when it moves by less than this share of its standard deviation."""
_STRETCH = 64
_STRETCHES = 4
_STATED_DOUBT = 0.15
"""Standard deviation of the logarithm of a stated variance: nobody states one more exactly."""
_MEDIAN_CHI2_2 = 2.0 * np.log(2.0)


@dataclass(frozen=True)
class NoiseModel:
    """Process noise of a target and measurement noise of its positions.

    Shares are of the stated standard deviation; along the line of sight, and across it.

    Attributes:
        acceleration_m2ps3: Spectral density of the white acceleration, m²/s³.
        correlation_time_s: Time constant of the correlated noise, seconds.
        white_along: Share that is independent from box to box.
        white_across: The same, across the line of sight.
        correlated_along: Share that is correlated.
        correlated_across: The same, across.
    """

    acceleration_m2ps3: float
    correlation_time_s: float
    white_along: float
    white_across: float
    correlated_along: float
    correlated_across: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            allowed = value >= 0.0 if name.startswith("correlated_a") else value > 0.0
            if not (allowed and np.isfinite(value)):
                raise InputError(f"noise model: {name} is {value:g}; expected a positive number")


# Normal priors of the logarithms: median and standard deviation. Vessels and vehicles accelerate
# at 0.1 to 2 m/s², for seconds. The errors of detectors are correlated over half a second to a
# second; that is held tightly, since what lasts longer cannot be told from a turn. The correlated
# part has a low median: where the measurements show none of it, it must fade out.
_PRIOR_MEDIAN = NoiseModel(0.1, 0.8, 0.8, 0.8, 0.03, 0.03)
_PRIOR_SD = np.array([2.0, 0.15, 1.0, 1.0, 2.0, 2.0])
_BEFORE_LEARNING = NoiseModel(0.2, 0.8, 0.7, 0.7, 0.5, 0.5)
_TOTAL_PRIOR_SD = 0.4
# Of the acceleration, the time constant, all noise along and across, the correlated over the white.
_BOUNDS = [(1e-4, 30.0), (0.1, 5.0), (0.03, 20.0), (0.03, 20.0), (1e-3, 100.0), (1e-3, 100.0)]
_CURVATURE = np.array([0.3, 0.3, 2.0, 1.0, 0.03, 0.03])
"""Of the log likelihood by the logarithms of these, for each node; about."""
_ENOUGH = 3e-3
"""The search ends at a step that adds no more than this share to what was gained."""


@dataclass(frozen=True, eq=False)
class SmoothedTrack:
    """Smoothed track that can be evaluated at any time.

    Attributes:
        noise: What was learned, or was set.
        used: (N,) bool, of the given rows: those that the track was made of. The others had no
            position or were taken for outliers.
        common_along: Share of the stated variance along the line of sight that the scatter of
            the track does not show, and that is therefore taken for common to all its points.
        common_across: The same, across.
    """

    noise: NoiseModel
    used: BoolArray
    common_along: float
    common_across: float
    _posterior: chain.Posterior
    _noise_at_range: NoiseAtRange
    _epoch_utc_s: float
    _used_utc_s: FloatArray
    _plane: LocalPlane
    _longest_gap_s: float
    _measured: Measurements

    def at(self, time_utc_s: FloatArray, *, track_id: int = 0, label: str = "") -> Track:
        """Evaluate the track at given times.

        Args:
            time_utc_s: (M,) float64, POSIX seconds, strictly increasing.
            track_id: Passed on.
            label: Passed on.
        """
        mean, covariance = self._posterior.at(time_utc_s - self._epoch_utc_s)
        common = self._noise_at_range.common_covariance(
            mean[:, :2], self.common_along, self.common_across
        )
        return Track(
            track_id=track_id,
            time_utc_s=time_utc_s,
            east_m=mean[:, 0],
            north_m=mean[:, 1],
            velocity_east_mps=mean[:, 2],
            velocity_north_mps=mean[:, 3],
            covariance_m2=covariance[:, :2, :2] + common + self._measured.shared_at(time_utc_s),
            velocity_covariance_m2ps2=covariance[:, 2:, 2:],
            kind=point_kinds(time_utc_s, self._used_utc_s, self._longest_gap_s),
            plane=self._plane,
            label=label,
        )


@dataclass(frozen=True)
class RtsSmoother:
    """Rauch-Tung-Striebel smoother; without settings its noise is learned from each track.

    Attributes:
        noise: Motion and noise; None: learned from each track. Where they are given, the target
            is taken to be as agile in all parts of its track.
        gate_probability: A good measurement is kept with this probability; one that is less
            likely than that, given the track without its outliers, is left out.
        longest_gap_s: Between measurements further apart than this, points are extrapolated.
        resolution_s: Measurements closer together than this enter as their mean.
        speed_mps: Standard deviation of each component of the velocity before any measurement.
        common_share: Share of the stated variance that is common to all points of a track (the
            uncertainty of the camera, which time does not average out) and is added to the
            smoothed covariance. None: that by which the scatter of the measurements falls
            clearly short of what was stated, none if it does not.
    """

    noise: NoiseModel | None = None
    gate_probability: float = 0.999
    longest_gap_s: float = 15.0
    resolution_s: float = 0.3
    speed_mps: float = 10.0
    common_share: float | None = None

    def __post_init__(self) -> None:
        for name in ("longest_gap_s", "resolution_s", "speed_mps"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"rts: {name} is {getattr(self, name):g}; expected above 0")
        if not 0.0 < self.gate_probability < 1.0:
            raise InputError(
                f"rts: gate_probability is {self.gate_probability:g}; expected between 0 and 1"
            )
        if self.common_share is not None and not 0.0 <= self.common_share <= 1.0:
            raise InputError(
                f"rts: common_share is {self.common_share:g}; expected between 0 and 1"
            )

    def apply(
        self,
        time_utc_s: FloatArray,
        positions: EastNorthPositions,
        *,
        confidence: FloatArray | None = None,
        at_utc_s: FloatArray | None = None,
        track_id: int = 0,
        label: str = "",
    ) -> Track:
        """See `TrajectoryMethod.apply`; confidences are not used, the covariances are."""
        measured, at = measurements(time_utc_s, positions, confidence, at_utc_s, track_id)
        return self._smooth(measured, positions).at(at, track_id=track_id, label=label)

    def smooth(
        self, time_utc_s: FloatArray, positions: EastNorthPositions, *, track_id: int = 0
    ) -> SmoothedTrack:
        """Smooth the positions of one target to a track at any time.

        Args:
            time_utc_s: (N,) float64, POSIX seconds.
            positions: N rows.
            track_id: For messages.

        Raises:
            InputError: See `TrajectoryMethod.apply`.
        """
        measured, _ = measurements(time_utc_s, positions, None, None, track_id)
        return self._smooth(measured, positions)

    def _smooth(self, measured: Measurements, positions: EastNorthPositions) -> SmoothedTrack:
        epoch = float(measured.time_utc_s[0])
        time = measured.time_utc_s - epoch
        noise_at_range = NoiseAtRange.of(measured)
        gate = float(chdtri(2, 1.0 - self.gate_probability))
        noise = self.noise or _BEFORE_LEARNING
        start = RobustStart.of(time, measured.en_m)
        linear = noise_at_range.linearised(start.position_at(time))
        used = linear.start_gate(gate)
        nodes = linear.nodes(time, used, start, self.resolution_s)
        posterior = chain.smooth(nodes, _parameters(noise, self.speed_mps))
        for i in range(_MOST_ROUNDS):
            at = posterior.position_at(time)
            agreeing = _gate(time, linear, posterior, at, noise, used, gate)
            # In later rounds none comes back: those on the edge would go in and out for ever.
            used = agreeing if i < 2 or not (agreeing & used).any() else agreeing & used
            linear = noise_at_range.linearised(at)
            nodes = linear.nodes(time, used, posterior, self.resolution_s)
            if self.noise is None and i == 0:
                noise = _learned(nodes, noise, self.speed_mps)
            elif self.noise is None:
                nodes = replace(
                    nodes, process_noise_scale=_process_noise_scale(posterior, nodes.time_s, noise)
                )
            before = posterior.position_at(nodes.time_s)
            posterior = chain.smooth(nodes, _parameters(noise, self.speed_mps))
            moved2 = ((posterior.mean[:, :2] - before) ** 2).sum(axis=1)
            doubt = np.trace(posterior.covariance[:, :2, :2], axis1=1, axis2=2)
            if i > 0 and (moved2 <= _SETTLED**2 * doubt).all():
                break
        along, across = self._common(noise, nodes)
        rows = np.zeros(len(positions), dtype=np.bool_)
        rows[measured.rows[used]] = True
        return SmoothedTrack(
            noise=noise,
            used=rows,
            common_along=along,
            common_across=across,
            _posterior=posterior,
            _noise_at_range=noise_at_range,
            _epoch_utc_s=epoch,
            _used_utc_s=measured.time_utc_s[used],
            _plane=positions.plane,
            _longest_gap_s=self.longest_gap_s,
            _measured=measured,
        )

    def _common(self, noise: NoiseModel, nodes: chain.Nodes) -> tuple[float, float]:
        if self.common_share is not None:
            return self.common_share, self.common_share
        if self.noise is not None:
            return 0.0, 0.0
        n = float(nodes.count.sum())
        spells = 1.0 + float(nodes.time_s[-1] - nodes.time_s[0]) / noise.correlation_time_s
        shares = []
        for white, correlated in (
            (noise.white_along, noise.correlated_along),
            (noise.white_across, noise.correlated_across),
        ):
            seen = white**2 + correlated**2
            # Standard deviation of the logarithm of the scatter, as for so many independent draws.
            spread = np.sqrt(2.0 * (white**4 / n + correlated**4 / min(n, spells))) / seen
            doubt = float(np.hypot(spread, _STATED_DOUBT))
            shares.append(max(0.0, 1.0 - seen * float(np.exp(2.0 * doubt))))
        return shares[0], shares[1]


def _logs(noise: NoiseModel) -> FloatArray:
    return np.log(list(vars(noise).values()))


def _parameters(noise: NoiseModel, speed_mps: float) -> chain.Parameters:
    return chain.Parameters(
        q_m2ps3=noise.acceleration_m2ps3,
        correlation_time_s=noise.correlation_time_s,
        white=(noise.white_along, noise.white_across),
        correlated=(noise.correlated_along, noise.correlated_across),
        speed_mps=speed_mps,
    )


def _gate(
    time_s: FloatArray,
    linear: Linearised,
    posterior: chain.Posterior,
    position_m: FloatArray,
    noise: NoiseModel,
    used: BoolArray,
    gate: float,
) -> BoolArray:
    """Gate measurements by their Mahalanobis distance from the track of the others.

    Args:
        time_s: (N,) of the measurements.
        linear: The measurements.
        posterior: The track.
        position_m: (N, 2) of the track at their times.
        noise: Of the measurements.
        used: (N,) which ones the track was made of.
        gate: Of their squared distance from it.
    """
    near = np.searchsorted(posterior.time_s, time_s)
    near = np.minimum(near, posterior.time_s.size - 1)
    fitted = np.stack([posterior.covariance[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1))])
    fitted = fitted[:, near]
    if not used.all():
        apart = posterior.at(time_s[~used])[1]
        fitted[:, ~used] = [apart[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1))]
    share = np.sqrt(
        [
            noise.white_along**2 + noise.correlated_along**2,
            noise.white_across**2 + noise.correlated_across**2,
        ]
    )
    distance2 = linear.squared_distance(position_m, fitted, share, used)
    kept = distance2 <= gate * max(1.0, float(np.median(distance2[used])) / _MEDIAN_CHI2_2)
    return kept if (kept & used).any() else used


def _process_noise_scale(
    posterior: chain.Posterior, time_s: FloatArray, noise: NoiseModel
) -> FloatArray:
    """Local scale of the process noise along a track, against its usual value.

    Boats go straight, and then they turn. The spectral density of the acceleration is that which
    fits the smoothed track within some seconds, held to the usual one as by so many draws.

    Args:
        posterior: The track so far.
        time_s: (N,) nodes.
        noise: With the usual density.

    Returns:
        (N + 1,) factors; 1 before the first node and after the last.
    """
    factors = np.ones(time_s.size + 1)
    if time_s.size < 2:
        return factors
    energy, draws = posterior.acceleration_energy()
    middle = 0.5 * (posterior.time_s[1:] + posterior.time_s[:-1])
    cell = (middle / _PROCESS_NOISE_SCALE_GRID_S).astype(np.int64)
    width = _PROCESS_NOISE_SCALE_WIDTH_S / _PROCESS_NOISE_SCALE_GRID_S
    near = [
        gaussian_filter1d(np.bincount(cell, values), width, mode="constant")
        * (np.sqrt(2.0 * np.pi) * width)
        for values in (energy / noise.acceleration_m2ps3, draws)
    ]
    local = np.log((near[0] + _PROCESS_NOISE_SCALE_DRAWS) / (near[1] + _PROCESS_NOISE_SCALE_DRAWS))
    local = np.clip(local, *np.log(_PROCESS_NOISE_SCALE_LIMITS))
    grid_s = (np.arange(local.size) + 0.5) * _PROCESS_NOISE_SCALE_GRID_S
    factors[1:-1] = np.exp(np.interp(0.5 * (time_s[1:] + time_s[:-1]), grid_s, local))
    return factors


def _excerpt(nodes: chain.Nodes) -> chain.Nodes:
    """Evenly spread excerpts of a long track, enough to learn its noise from."""
    stretch = np.arange(nodes.time_s.size) // _STRETCH
    if stretch[-1] < _STRETCHES:
        return nodes
    chosen = np.linspace(0, stretch[-1], _STRETCHES).round()
    kept = np.isin(stretch, chosen)
    columns = {
        name: column[kept] for name, column in vars(nodes).items() if name != "process_noise_scale"
    }
    return chain.Nodes(**columns, process_noise_scale=np.ones(int(kept.sum()) + 1))


def _learned(nodes: chain.Nodes, start: NoiseModel, speed_mps: float) -> NoiseModel:
    """Maximum a posteriori noise model, given the measurements.

    In place of the white and the correlated share along each axis it is looked for by the
    logarithms of both together and of their ratio: the measurements tell the former well whatever
    the latter is, so that the objective is nearly a sum of functions of one variable.
    """
    nodes = _excerpt(nodes)
    centre = np.einsum("nij,ni->nj", nodes.axes, nodes.measured_m).mean(axis=0)
    nodes = replace(nodes, measured_m=nodes.measured_m - nodes.axes @ centre)
    median = _logs(_PRIOR_MEDIAN)
    # About the curvature of the objective, so that the first step has the right length.
    scale = 1.0 / np.sqrt(_CURVATURE * nodes.time_s.size + _PRIOR_SD**-2.0)

    values: list[float] = []

    def objective(scaled: FloatArray) -> tuple[float, FloatArray]:
        logs, correlated_part = _shares(scaled * scale)
        noise = NoiseModel(*np.exp(logs).tolist())
        value, gradient = chain.minus_two_log_likelihood(nodes, _parameters(noise, speed_mps))
        belief = (logs - median) / _PRIOR_SD
        total = scaled[2:4] * scale[2:4] / _TOTAL_PRIOR_SD
        value += float(belief @ belief + total @ total)
        gradient += 2.0 * belief / _PRIOR_SD
        white, correlated = gradient[2:4].copy(), gradient[4:].copy()
        gradient[2:4] = white + correlated + 2.0 * total / _TOTAL_PRIOR_SD
        gradient[4:] = correlated - correlated_part * (white + correlated)
        values.append(0.5 * value)
        # What is gained since the start is the measure of when to stop.
        return values[-1] - values[0], 0.5 * gradient * scale

    begin = _logs(start)
    ratio = begin[4:] - begin[2:4]
    begin[2:4] += 0.5 * np.log1p(np.exp(2.0 * ratio))
    begin[4:] = ratio
    low, high = np.log(_BOUNDS).T
    found = minimize(
        objective,
        np.clip(begin, low, high) / scale,
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds(low / scale, high / scale),
        options={"maxiter": 40, "ftol": _ENOUGH, "gtol": 0.1},
    )
    return NoiseModel(*np.exp(_shares(found.x * scale)[0]).tolist())


def _shares(logs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Logarithms of `NoiseModel`, from the parameters that `_learned` optimises.

    Also the share (2,) of the correlated noise in the variance, along and across.
    """
    out = logs.copy()
    correlated_part = 1.0 / (1.0 + np.exp(-2.0 * logs[4:]))
    out[2:4] += 0.5 * np.log1p(-correlated_part)
    out[4:] += out[2:4]
    return out, correlated_part
