r"""Forecasts by an interacting multiple-model filter over integrated Ornstein-Uhlenbeck modes.

A target goes straight, turns left or right, or turns hard, and changes between these after some
time. In each of these modes its velocity turns at a rate :math:`\omega` and reverts to rest,
slowly where it goes straight and faster where it turns, under white acceleration: an integrated
Ornstein-Uhlenbeck process, which, other than constant velocity, stays honest for minutes
(Millefiori et al., "Modeling vessel kinematics using a stochastic mean-reverting process for
long-term prediction", *IEEE Trans. Aerosp. Electron. Syst.* 52(5), 2016). With east and north as
one complex number it is

.. math:: \dot p = v, \qquad \dot v = -\lambda v + \text{noise}, \qquad
          \lambda = 1 / \tau - i \omega .

Which of the modes holds is followed by an interacting multiple-model filter (Blom and
Bar-Shalom, *IEEE Trans. Autom. Control* 33(8), 1988). It uses no box that comes after the moment
that it speaks of.

The camera stands at the origin of the plane, or moves, and where it was is told. Measurements are
taken as bearing and inverse range from it, so that their noise is that of the range predicted; see
`sightline.trajectory.smoother`. The target is followed in the plane itself: before a camera that
moves, what goes straight does not look so.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.trajectory.base import Measurements, measurements
from sightline.types import FloatArray, PointKind, Positions, Track

HORIZONS_S = (5.0, 10.0, 30.0, 60.0)
"""Default lead times of forecasts."""

_LONGEST_STEP_S = 2.0
_SAME_TIME_S = 1e-6
_NEAREST_M = 1e-3
_ITERATIONS = 3
_STEADY = np.sqrt(0.5)
_MAY_BE_ZERO = ("turn_rate_radps", "hard_turn_rate_radps", "hard_share", "correlation_time_s")


@dataclass(frozen=True)
class MotionModel:
    """Motion model of targets: modes, their turn rates and process noise.

    Attributes:
        turn_rate_radps: Of the two modes in which a target turns, radians a second.
        hard_turn_rate_radps: Of the two in which it turns hard, as small boats do.
        hard_share: Share of the time of turning in which it turns hard.
        mode_s: Mean time in one mode.
        straight_share: Share of the time in which targets go straight.
        straight_s: Time constant with which the velocity reverts to rest while it goes straight.
        turning_s: The same while it turns.
        straight_m2ps3: Spectral density of the white acceleration while it goes straight, m²/s³.
        turning_m2ps3: The same while it turns.
        speed_mps: Standard deviation of each component of the velocity of a new target.
        correlation_time_s: Correlation time of the errors of boxes; boxes that follow each other
            faster are down-weighted.
        forgotten_s: After so long without a position a target is begun anew: it may be anywhere,
            and a filter that is linear about where it was expected may end far from where it is.
        outlier_gate: A position further from the expected one than so many standard deviations is
            down-weighted.
    """

    turn_rate_radps: float = 0.17
    hard_turn_rate_radps: float = 0.3
    hard_share: float = 0.2
    mode_s: float = 5.0
    straight_share: float = 0.55
    straight_s: float = 600.0
    turning_s: float = 60.0
    straight_m2ps3: float = 0.03
    turning_m2ps3: float = 0.1
    speed_mps: float = 2.0
    correlation_time_s: float = 0.6
    forgotten_s: float = 30.0
    outlier_gate: float = 3.5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            least = 0.0 if name in _MAY_BE_ZERO else np.nextafter(0.0, 1.0)
            if not least <= value < np.inf:
                raise InputError(f"motion model: {name} is {value:g}; expected a positive number")
        for name in ("straight_share", "hard_share"):
            if not getattr(self, name) <= 1.0:
                raise InputError(
                    f"motion model: {name} is {getattr(self, name):g}; expected at most 1"
                )

    @property
    def turn_rates_radps(self) -> FloatArray:
        """(5,) turn rates of the modes: straight, left, right, hard left, hard right."""
        usual, hard = self.turn_rate_radps, self.hard_turn_rate_radps
        return np.array([0.0, usual, -usual, hard, -hard])

    @property
    def shares(self) -> FloatArray:
        """(5,) stationary probabilities of the modes."""
        turning = 0.5 * (1.0 - self.straight_share)
        usual, hard = turning * (1.0 - self.hard_share), turning * self.hard_share
        return np.array([self.straight_share, usual, usual, hard, hard])

    @property
    def revertings_s(self) -> FloatArray:
        """(5,) time constants of the modes."""
        return np.array([self.straight_s, *4 * [self.turning_s]])

    @property
    def accelerations_m2ps3(self) -> FloatArray:
        """(5,) spectral densities of the acceleration of the modes."""
        return np.array([self.straight_m2ps3, *4 * [self.turning_m2ps3]])


def transition(
    lag_s: float, turn_rate_radps: ArrayLike, reverting_s: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    r"""Transition and process noise of a mode, for a spectral density of 1 m²/s³.

    With :math:`a = e^{-\lambda h}` and :math:`b = (1 - a) / \lambda` the mean is
    :math:`p + b v,\ a v`; the covariances are the integrals of :math:`|a|^2`,
    :math:`b \bar a` and :math:`|b|^2` over the lag.

    Args:
        lag_s: Not negative.
        turn_rate_radps: (K,) radians a second, counter-clockwise as east turns to north.
        reverting_s: Time constant of the velocity, (K,) or one for all.

    Returns:
        (K, 4, 4) and (K, 4, 4): positions and velocities, east and north.
    """
    turning = np.atleast_1d(np.asarray(turn_rate_radps, dtype=np.float64))
    tau = np.broadcast_to(np.asarray(reverting_s, dtype=np.float64), turning.shape)
    rate = 1.0 / tau - 1j * turning
    kept = np.exp(-rate * lag_s)
    moved = -np.expm1(-rate * lag_s) / rate
    energy = -0.5 * tau * np.expm1(-2.0 * lag_s / tau)
    crossed = (np.conj(moved) - energy) / rate
    position = (lag_s - 2.0 * moved.real + energy) / np.abs(rate) ** 2
    # Over short lags these are differences of nearly equal numbers; there they are their series.
    short = (np.abs(rate) + 2.0 / tau) * lag_s < 3e-3
    crossed = np.where(
        short, 0.5 * lag_s**2 * (1.0 - lag_s * (np.conj(rate) + 2.0 / tau) / 3.0), crossed
    )
    position = np.where(short, lag_s**3 / 3.0 * (1.0 - 0.75 * lag_s / tau), position)
    zero, one = np.zeros(rate.shape), np.ones(rate.shape)
    step = _blocks(one, moved, zero, kept)
    return step, _blocks(position, crossed, np.conj(crossed), energy)


def _blocks(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """(K, 4, 4) real matrices of 2 x 2 complex ones, acting on east and north."""
    out = np.empty((a.size, 4, 4))
    for rows, columns, values in ((0, 0, a), (0, 2, b), (2, 0, c), (2, 2, d)):
        out[:, rows, columns] = out[:, rows + 1, columns + 1] = np.real(values)
        out[:, rows + 1, columns] = np.imag(values)
        out[:, rows, columns + 1] = -np.imag(values)
    return out


@dataclass(frozen=True, eq=False)
class MotionState:
    """State of N targets, each at its own time: a mixture over the K modes of motion.

    Attributes:
        time_utc_s: (N,) float64, POSIX seconds.
        weight: (N, K) float64, probability of each mode.
        mean: (N, K, 4) float64, metres east and north, and their velocities.
        covariance: (N, K, 4, 4) float64, without what all positions of a target share.
        shared: (N, 4, 4) float64, what they share. That of a static camera is of the place
            alone, and constant; the velocity error of a moving camera makes that of the place grow
            with time.
        plane: Where the origin lies on the earth.
        motion: How targets move.
    """

    time_utc_s: FloatArray
    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray
    shared: FloatArray
    plane: LocalPlane
    motion: MotionModel

    def __len__(self) -> int:
        return int(self.time_utc_s.size)

    def __getitem__(self, rows: object) -> MotionState:
        """The states selected by an index array, a mask or a slice."""
        names = ("time_utc_s", "weight", "mean", "covariance", "shared")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @classmethod
    def of_track(cls, track: Track, motion: MotionModel | None = None) -> MotionState:
        r"""State at the end of a track, for a target that is known by its track alone.

        A track does not say how the errors of place and velocity hang together. They are taken to
        do so as in the steady state of a filter for constant velocity under white acceleration,
        where their correlation is :math:`1/\sqrt 2`.

        Args:
            track: At least one point.
            motion: How targets move.

        Raises:
            InputError: The track has no point, or states no covariance.
        """
        motion = motion or MotionModel()
        stated = [track.covariance_m2[-1:], track.velocity_covariance_m2ps2[-1:]]
        if not len(track) or not all(np.isfinite(part).all() for part in stated):
            raise InputError(
                f"track {track.track_id}: its last point does not say how unsure place and "
                "velocity are, so nothing can be forecast"
            )
        place, velocity = (_root(part[0]) for part in stated)
        covariance = np.zeros((4, 4))
        covariance[:2, :2], covariance[2:, 2:] = place @ place, velocity @ velocity
        covariance[:2, 2:] = _STEADY * place @ velocity
        covariance[2:, :2] = covariance[:2, 2:].T
        mean = [track.east_m[-1], track.north_m[-1]]
        mean += [track.velocity_east_mps[-1], track.velocity_north_mps[-1]]
        return cls.of_moments(
            track.time_utc_s[-1:], np.array([mean]), covariance[None], track.plane, motion
        )

    @classmethod
    def of_moments(
        cls,
        time_utc_s: FloatArray,
        mean: FloatArray,
        covariance: FloatArray,
        plane: LocalPlane,
        motion: MotionModel | None = None,
    ) -> MotionState:
        """States from mean and covariance, with the modes at their stationary probabilities.

        Args:
            time_utc_s: (N,) POSIX seconds.
            mean: (N, 4) metres east and north, and their velocities.
            covariance: (N, 4, 4).
            plane: Where the origin lies on the earth.
            motion: How targets move.
        """
        motion = motion or MotionModel()
        n, k = len(mean), motion.shares.size
        return cls(
            time_utc_s=np.asarray(time_utc_s, dtype=np.float64),
            weight=np.tile(motion.shares, (n, 1)),
            mean=np.repeat(mean[:, None], k, axis=1),
            covariance=np.repeat(covariance[:, None], k, axis=1),
            shared=np.zeros((n, 4, 4)),
            plane=plane,
            motion=motion,
        )

    def carried(self, covariance: FloatArray) -> MotionState:
        """States seen from a moving platform, with the covariance of its velocity.

        Args:
            covariance: (N, 2, 2) of its place and velocity, along either axis, at the time of each
                state. That of its place is in the states already, as it was in the positions.
        """
        own = np.einsum("nij,ab->niajb", covariance, np.eye(2)).reshape(-1, 4, 4)
        own[:, :2, :2] = 0.0
        return replace(self, shared=self.shared + own)

    def ahead(self, lag_s: float) -> MotionState:
        """Predict all states by the same lag.

        Args:
            lag_s: Seconds, not negative.
        """
        steps = max(1, int(np.ceil(lag_s / _LONGEST_STEP_S - 1e-9)))
        h, motion = lag_s / steps, self.motion
        move, noise = transition(h, motion.turn_rates_radps, motion.revertings_s)
        noise = motion.accelerations_m2ps3[:, None, None] * noise
        stay = np.exp(-h / motion.mode_s)
        change = stay * np.eye(motion.shares.size) + (1.0 - stay) * motion.shares
        weight, mean, covariance = self.weight, self.mean, self.covariance
        for _ in range(steps if lag_s > 0.0 else 0):
            weight, mean, covariance = _mixed(weight, mean, covariance, change)
            mean = np.einsum("kij,nkj->nki", move, mean)
            covariance = move @ covariance @ np.swapaxes(move, 1, 2) + noise
        return replace(
            self,
            time_utc_s=self.time_utc_s + lag_s,
            weight=weight,
            mean=mean,
            covariance=covariance,
            shared=_taken_along(self.shared, lag_s),
        )

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (N, 4) and covariance (N, 4, 4) of the mixture, the shared part included."""
        mean = np.einsum("nk,nki->ni", self.weight, self.mean)
        off = self.mean - mean[:, None]
        spread = self.covariance + off[..., :, None] * off[..., None, :]
        covariance = np.einsum("nk,nkij->nij", self.weight, spread)
        return mean, covariance + self.shared

    def forecast(self, lag_s: ArrayLike, *, track_id: int = 0, label: str = "") -> Track:
        """Forecast of one target as an extrapolated track.

        Args:
            lag_s: (M,) seconds after the state, positive and increasing.
            track_id: Passed on.
            label: Passed on.

        Raises:
            InputError: There is not one state, or a time is not later than the one before it.
        """
        lags = np.atleast_1d(np.asarray(lag_s, dtype=np.float64))
        if len(self) != 1:
            raise InputError(f"a forecast is of one target; these are {len(self)}")
        if not (np.diff(lags, prepend=0.0) > 0.0).all() or not np.isfinite(lags).all():
            raise InputError("the times of a forecast must be positive and increase")
        means, covariances, state = [], [], self
        for step in np.diff(lags, prepend=0.0).tolist():
            state = state.ahead(step)
            mean, covariance = state.moments()
            means.append(mean[0])
            covariances.append(covariance[0])
        at, doubt = np.reshape(means, (-1, 4)), np.reshape(covariances, (-1, 4, 4))
        return Track(
            track_id=track_id,
            time_utc_s=self.time_utc_s[0] + lags,
            east_m=at[:, 0],
            north_m=at[:, 1],
            velocity_east_mps=at[:, 2],
            velocity_north_mps=at[:, 3],
            covariance_m2=doubt[:, :2, :2],
            velocity_covariance_m2ps2=doubt[:, 2:, 2:],
            kind=np.full(lags.size, PointKind.EXTRAPOLATED, dtype=np.int8),
            plane=self.plane,
            label=label,
        )


def _taken_along(shared: FloatArray, lag_s: float) -> FloatArray:
    """Propagate a shared error of position and velocity by a lag."""
    if not shared[:, 2:, 2:].any():
        return shared
    step = np.eye(4)
    step[0, 2] = step[1, 3] = lag_s
    return np.asarray(step @ shared @ step.T)


def _root(matrix: FloatArray) -> FloatArray:
    """Symmetric square root of a covariance."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _mixed(
    weight: FloatArray, mean: FloatArray, covariance: FloatArray, change: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """IMM mixing step: the mixture after mode transitions, moment-matched for each mode."""
    joint = weight[:, :, None] * change
    after = joint.sum(axis=1)
    share = joint / np.maximum(after, 1e-300)[:, None, :]
    mixed = np.einsum("njk,nji->nki", share, mean)
    off = mean[:, :, None] - mixed[:, None]
    spread = np.einsum("njk,njka,njkb->nkab", share, off, off)
    return after, mixed, spread + np.einsum("njk,njab->nkab", share, covariance)


def follow(
    time_utc_s: FloatArray,
    positions: Positions,
    motion: MotionModel | None = None,
    *,
    camera_position_m: FloatArray | None = None,
    track_id: int = 0,
) -> MotionState:
    """Filtered states of one target, one at each of its positions.

    Args:
        time_utc_s: (N,) POSIX seconds, in any order.
        positions: N rows; those without a position are left out.
        motion: How targets move.
        camera_position_m: (N, 2) metres east and north of the camera. Absent: it stands at the
            origin.
        track_id: For messages.

    Returns:
        A state for each time at which there is a position, in the order of time.

    Raises:
        InputError: There is no position, or the columns are of different lengths.
    """
    motion = motion or MotionModel()
    measured, _ = measurements(time_utc_s, positions, None, None, track_id)
    eye = (
        np.zeros((len(positions), 2))
        if camera_position_m is None
        else np.asarray(camera_position_m, dtype=np.float64)
    )
    eye = eye[measured.rows]
    state = _begun(measured, positions.plane, motion, 0)
    states = [state]
    last_s = float(measured.time_utc_s[0])
    for i in range(1, measured.time_utc_s.size):
        lag_s = float(measured.time_utc_s[i]) - last_s
        last_s += lag_s
        if lag_s > motion.forgotten_s:
            state = _begun(measured, positions.plane, motion, i)
        else:
            state = _updated(state.ahead(lag_s), measured, eye[i], i, lag_s)
        if lag_s > _SAME_TIME_S:
            states.append(state)
        else:
            states[-1] = state
    return MotionState(
        time_utc_s=np.concatenate([one.time_utc_s for one in states]),
        weight=np.concatenate([one.weight for one in states]),
        mean=np.concatenate([one.mean for one in states]),
        covariance=np.concatenate([one.covariance for one in states]),
        shared=np.concatenate([one.shared for one in states]),
        plane=positions.plane,
        motion=motion,
    )


def _begun(measured: Measurements, plane: LocalPlane, motion: MotionModel, i: int) -> MotionState:
    k = motion.shares.size
    covariance = np.zeros((4, 4))
    covariance[:2, :2] = measured.covariance_m2[i]
    covariance[2:, 2:] = motion.speed_mps**2 * np.eye(2)
    return MotionState(
        time_utc_s=measured.time_utc_s[i : i + 1],
        weight=motion.shares[None, :],
        mean=np.tile(np.append(measured.en_m[i], [0.0, 0.0]), (1, k, 1)),
        covariance=np.tile(covariance, (1, k, 1, 1)),
        shared=_of_place(measured.shared_m2[i]),
        plane=plane,
        motion=motion,
    )


def _of_place(shared_m2: FloatArray) -> FloatArray:
    """(1, 4, 4) covariance of position and velocity, from the shared one of position (2, 2)."""
    out = np.zeros((1, 4, 4))
    out[0, :2, :2] = shared_m2
    return out


def _updated(
    state: MotionState, measured: Measurements, camera_position_m: FloatArray, i: int, lag_s: float
) -> MotionState:
    """Update a predicted state with a position (an iterated Kalman filter)."""
    motion = state.motion
    sight, axes = _line_of_sight(measured.en_m[i : i + 1] - camera_position_m)
    noise = axes[0] @ measured.covariance_m2[i] @ axes[0].T
    # Correlated errors make boxes that follow each other closely one box.
    noise = noise * max(1.0, 2.0 * motion.correlation_time_s / max(lag_s, 1e-3))
    expected, covariance = state.mean[0], state.covariance[0]
    at, place = expected, covariance[:, :2, :2]
    there, design = _line_of_sight(expected[:, :2] - camera_position_m)
    off = _residual(sight, there)
    spread = design @ place @ np.swapaxes(design, 1, 2) + noise
    distance2 = np.einsum("ki,kij,kj->k", off, np.linalg.inv(spread), off)
    # How far from the expected place a position may be is asked once, of all modes.
    far = max(1.0, float(distance2.min()) / motion.outlier_gate**2)
    noise, spread = far * noise, spread + (far - 1.0) * noise
    distance2 = np.einsum("ki,kij,kj->k", off, np.linalg.inv(spread), off)
    prior = np.log(np.maximum(state.weight[0], 1e-300))
    likely = prior - 0.5 * (distance2 + np.log(np.linalg.det(spread)))
    weight = np.exp(likely - likely.max())
    for k in range(_ITERATIONS):
        if k > 0:
            there, design = _line_of_sight(at[:, :2] - camera_position_m)
        cross = covariance[:, :, :2] @ np.swapaxes(design, 1, 2)
        gain = cross @ np.linalg.inv(design @ place @ np.swapaxes(design, 1, 2) + noise)
        rest = _residual(sight, there) - np.einsum("kij,kj->ki", design, (expected - at)[:, :2])
        at = expected + np.einsum("kij,kj->ki", gain, rest)
    left = covariance - gain @ np.swapaxes(cross, 1, 2)
    return replace(
        state,
        weight=(weight / weight.sum())[None, :],
        mean=at[None],
        covariance=0.5 * (left + np.swapaxes(left, 1, 2))[None],
        shared=_of_place(measured.shared_m2[i]),
    )


def _line_of_sight(en_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bearing and inverse range (N, 2) of places (N, 2), and their Jacobian (N, 2, 2)."""
    east, north = en_m.T
    range_m = np.maximum(np.hypot(east, north), _NEAREST_M)
    squared, cubed = range_m**2, range_m**3
    # Filled in column by column: each step of a filter asks for a few, again and again.
    sight, rows = np.empty((len(en_m), 2)), np.empty((len(en_m), 2, 2))
    sight[:, 0], sight[:, 1] = np.arctan2(east, north), 1.0 / range_m
    rows[:, 0, 0], rows[:, 0, 1] = north / squared, -east / squared
    rows[:, 1, 0], rows[:, 1, 1] = -east / cubed, -north / cubed
    return sight, rows


def _residual(measured: FloatArray, expected: FloatArray) -> FloatArray:
    off = measured - expected
    off[:, 0] = np.remainder(off[:, 0] + np.pi, 2.0 * np.pi) - np.pi
    return np.asarray(off)


@dataclass(frozen=True)
class ClosestApproach:
    """Closest point of approach of a target to the camera or another, at constant velocity.

    Attributes:
        time_utc_s: POSIX seconds; not before now, nor after the horizon.
        in_s: Seconds from now.
        distance_m: Metres between the two at that time.
        in_sigma_s: Standard deviation of ``in_s``; zero where it is now or at the horizon,
            infinite where neither moves.
        distance_sigma_m: Standard deviation of ``distance_m``.
    """

    time_utc_s: float
    in_s: float
    distance_m: float
    in_sigma_s: float
    distance_sigma_m: float


def closest_approach(
    one: MotionState, other: MotionState | None = None, *, horizon_s: float = 600.0
) -> ClosestApproach:
    r"""Closest point of approach of a target to the camera, or to another target.

    With relative place :math:`p` and velocity :math:`v` it is at
    :math:`t = -p \cdot v / v \cdot v`. The standard deviations are of first order: that of the
    distance is that of the place at :math:`t` along the line between the two, accelerations until
    then included; those of :math:`t` come from :math:`\partial t / \partial p = -v / v^2` and
    :math:`\partial t / \partial v = -(p + 2 t v) / v^2`. A distance smaller than its standard
    deviation says that the two may meet.

    Args:
        one: One target.
        other: Another; absent: the camera, at the origin. Now is the later of their times.
        horizon_s: Later approaches are of no interest: the nearest until then is told.

    Raises:
        InputError: There is not one state each, they are of different planes, or the horizon is
            not positive.
    """
    if not 0.0 < horizon_s < np.inf:
        raise InputError(f"horizon_s is {horizon_s:g} s; it must be positive")
    for state in (one, other):
        if state is not None and len(state) != 1:
            raise InputError(f"an approach is of one target to another; these are {len(state)}")
    now = float(one.time_utc_s[0])
    if other is not None:
        if other.plane != one.plane:
            raise InputError("an approach needs both targets in one plane; theirs differ")
        now = max(now, float(other.time_utc_s[0]))
        other = other.ahead(now - float(other.time_utc_s[0]))
    one = one.ahead(now - float(one.time_utc_s[0]))
    mean, covariance = (part[0] for part in one.moments())
    density = float(one.motion.shares @ one.motion.accelerations_m2ps3)
    if other is not None:
        # What both share through the camera is left in: it is not known to cancel.
        their_mean, their_covariance = (part[0] for part in other.moments())
        mean, covariance = mean - their_mean, covariance + their_covariance
        density += float(other.motion.shares @ other.motion.accelerations_m2ps3)
    place, velocity = mean[:2], mean[2:]
    speed2 = float(velocity @ velocity)
    moves = speed2 > 1e-12
    passing = -float(place @ velocity) / speed2 if moves else 0.0
    in_s = min(max(passing, 0.0), horizon_s)
    apart = place + in_s * velocity
    distance = float(np.hypot(*apart))
    step = np.hstack([np.eye(2), in_s * np.eye(2)])
    spread = step @ covariance @ step.T + density * in_s**3 / 3.0 * np.eye(2)
    if distance > 1e-9:
        along = apart / distance
    else:
        # They meet: the distance can only grow across the way that one goes.
        along = np.array([-velocity[1], velocity[0]]) / np.sqrt(speed2) if moves else np.ones(2)
    in_sigma = np.inf if not moves else 0.0
    if moves and in_s == passing:
        slope = np.concatenate([-velocity, -(place + 2.0 * in_s * velocity)]) / speed2
        in_sigma = float(np.sqrt(slope @ covariance @ slope))
    return ClosestApproach(
        time_utc_s=now + in_s,
        in_s=in_s,
        distance_m=distance,
        in_sigma_s=float(in_sigma),
        distance_sigma_m=float(np.sqrt(along @ spread @ along)),
    )


def closest_approaches(
    states: Iterable[MotionState], *, horizon_s: float = 600.0
) -> dict[tuple[int, int], ClosestApproach]:
    """Closest points of approach of all pairs of targets.

    Args:
        states: One target each.
        horizon_s: See `closest_approach`.

    Returns:
        By their places in what was given, the smaller first.
    """
    known = list(states)
    return {
        (i, j): closest_approach(known[i], known[j], horizon_s=horizon_s)
        for i in range(len(known))
        for j in range(i + 1, len(known))
    }
