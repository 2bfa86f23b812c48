"""Tracks of several cameras fused to one track a target."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from sightline.errors import InputError
from sightline.fusion.bias import Biases, BiasPrior, Differences, estimate
from sightline.fusion.handover import (
    End,
    HandoverSettings,
    Seen,
    bridge,
    handover_nats,
    successors,
)
from sightline.fusion.intersection import intersect
from sightline.fusion.resampling import Piece, kinds_of, resampled
from sightline.fusion.track_association import (
    AssociationSettings,
    corrected,
    density_per_m2,
    differences,
    joined,
    pairs_of,
    parted,
    without_changes,
)
from sightline.geodesy import LocalPlane
from sightline.threads import on_one_thread
from sightline.types import BoolArray, FloatArray, FusedTrack, IntArray, PointKind, Track

CORRELATED_SHARE = 0.2
"""The share of each camera's covariance whose errors others may have in common, unless told."""

_ROUNDS = 3
_STRETCH_S = 30.0
_LEAST_INTERVAL_S = 0.05
_WITHIN_M = 50_000.0


@dataclass(frozen=True, eq=False)
class CameraTracks:
    """The tracks of one camera.

    Attributes:
        name: Of the camera.
        tracks: With covariances, all in one plane.
        place_m: (2,) metres east and north, where it stands; None where nobody says.
    """

    name: str
    tracks: tuple[Track, ...]
    place_m: FloatArray | None = None


@dataclass(frozen=True)
class FuseSettings:
    """Settings of `fuse`.

    Attributes:
        interval_s: Time between the points of a track.
        correlated_share: The share of each camera's covariance, 0 to 1, whose errors others may
            have in common: the motion that no model foretells, logs by which several cameras were
            calibrated. With 1 nothing is taken for independent (covariance intersection).
        bias: What is believed of the bias of each camera.
        handover: How targets go on that no camera sees.
        correlation_time_s: How long errors of a track last.

    Raises:
        InputError: A value is out of its range.
    """

    interval_s: float = 1.0
    correlated_share: float = CORRELATED_SHARE
    bias: BiasPrior = field(default_factory=BiasPrior)
    handover: HandoverSettings = field(default_factory=HandoverSettings)
    correlation_time_s: float = 10.0

    def __post_init__(self) -> None:
        if not _LEAST_INTERVAL_S <= self.interval_s < np.inf:
            raise InputError(
                f"an interval of {self.interval_s:g} s cannot be; give {_LEAST_INTERVAL_S:g} s or "
                "more"
            )
        if not 0.0 <= self.correlated_share <= 1.0:
            raise InputError(
                f"a correlated share of {self.correlated_share:g} is not between 0 and 1"
            )


@dataclass(frozen=True)
class CameraSummary:
    """What a camera adds to the picture.

    Attributes:
        name: Of the camera.
        tracks: How many tracks it has.
        targets: How many of the targets it sees.
        shared: How many of them another camera sees too.
        compared: Stretches of time in which it was compared with another.
        bias_east_m: Its bias, which was taken off.
        bias_north_m: The same to the north.
        bias_sigma_m: Standard deviation of either.
        bias_heading_deg: How far its bearings are turned clockwise; None where nobody says where
            it stands.
        bias_heading_sigma_deg: Standard deviation of that.
    """

    name: str
    tracks: int
    targets: int
    shared: int
    compared: int
    bias_east_m: float
    bias_north_m: float
    bias_sigma_m: float
    bias_heading_deg: float | None
    bias_heading_sigma_deg: float | None


@dataclass(frozen=True, eq=False)
class Fusion:
    """One track a target, of several cameras.

    Attributes:
        tracks: In the order of their beginnings; numbers begin at 1.
        cameras: In their order.
        handovers: How often a target was taken up again after no camera had seen it.
        scatter: How far two cameras are apart in the targets that both see, without the biases,
            in standard deviations of what their covariances say (root of the mean square, of one
            coordinate): 1 is as stated. NaN where no two see the same.
    """

    tracks: tuple[FusedTrack, ...]
    cameras: tuple[CameraSummary, ...]
    handovers: int
    scatter: float

    @property
    def shared(self) -> int:
        """How many targets more than one camera has seen."""
        return sum(len(cameras_of(track)) > 1 for track in self.tracks)


def cameras_of(track: FusedTrack) -> set[str]:
    """Names of the cameras that have seen a target."""
    return {name for names in np.unique(np.asarray(track.cameras)) for name in str(names).split()}


@on_one_thread
def fuse(
    cameras: Sequence[CameraTracks], plane: LocalPlane, settings: FuseSettings | None = None
) -> Fusion:
    """Fuse the tracks of several cameras.

    The biases of the cameras are estimated from targets that two of them see and taken off, tracks
    of one target are associated, and its places fused by split covariance intersection.

    Args:
        cameras: Each with its tracks.
        plane: Of all their tracks.
        settings: How.

    Raises:
        InputError: There are no tracks, or some without covariances.
    """
    settings = settings or FuseSettings()
    pieces = _pieces(cameras, settings)
    unknown_m = np.full(2, np.nan)
    place_m = np.array([unknown_m if c.place_m is None else c.place_m for c in cameras])
    density = density_per_m2(pieces)
    biases = Biases.unknown(place_m, settings.bias)
    how = AssociationSettings(settings.interval_s, settings.correlation_time_s)
    whole = pieces
    seen, groups = Differences.none(), [[i] for i in range(len(pieces))]
    for _ in range(_ROUNDS):
        pairs = pairs_of(whole, biases, density, how)
        pieces, pairs = parted(whole, pairs, how)
        groups = joined(pieces, pairs, how)
        seen = differences(pieces, pairs, groups, how, _STRETCH_S)
        biases = estimate(seen, place_m, settings.bias)
    groups = without_changes(pieces, groups, settings.interval_s)
    groups, handovers = _handed_over(pieces, groups, biases, density, settings)
    start_utc_s = _start(cameras)
    names = [camera.name for camera in cameras]
    made = [_target([pieces[i] for i in rows], biases, len(cameras), settings) for rows in groups]
    made.sort(key=lambda one: (one.first, one.place_m[0, 0]))
    tracks = tuple(
        _track(one, number, names, start_utc_s, plane, settings)
        for number, one in enumerate(made, start=1)
    )
    return Fusion(tracks, _summaries(cameras, tracks, biases), handovers, _scatter(seen, biases))


def check_covariances(track: Track, where: str) -> None:
    """Raise InputError for a track that does not say how unsure it is.

    Args:
        track: With points.
        where: It is from, for the message.
    """
    if not np.isfinite(track.covariance_m2).all(axis=(1, 2)).any():
        raise InputError(
            f"{where}: its track {track.track_id} does not say how unsure it is, so it cannot be "
            "weighed; give tracks with covariances or ellipses, as sightline writes them to .csv, "
            ".parquet, .gpkg and .geojson"
        )


def _start(cameras: Sequence[CameraTracks]) -> float:
    times = [track.time_utc_s[0] for camera in cameras for track in camera.tracks if len(track)]
    return float(np.floor(min(times)))


def _pieces(cameras: Sequence[CameraTracks], settings: FuseSettings) -> list[Piece]:
    if not any(len(track) for camera in cameras for track in camera.tracks):
        raise InputError("no camera has a point of a track; there is nothing to fuse")
    start_utc_s = _start(cameras)
    out, number = [], 0
    for k, camera in enumerate(cameras):
        for track in camera.tracks:
            if len(track):
                check_covariances(track, f"camera {camera.name}")
            piece = resampled(track, k, number, start_utc_s, settings.interval_s)
            number += 1
            if piece is not None:
                out.append(piece)
    if not out:
        raise InputError(
            f"no track lasts for {settings.interval_s:g} s, the interval of the common times; "
            "give a shorter one"
        )
    far = max(float(np.nanmax(np.abs(piece.place_m))) for piece in out)
    if far > 2.0 * _WITHIN_M:
        raise InputError(
            f"the cameras' tracks lie {far / 1000.0:.0f} km apart; cameras that are fused see one "
            "place"
        )
    return out


@dataclass(frozen=True, eq=False)
class _Target:
    """One target on the time base; NaN where no camera sees it."""

    first: int
    place_m: FloatArray
    velocity_mps: FloatArray
    covariance_m2: FloatArray
    velocity_covariance: FloatArray
    kind: np.ndarray
    moored: BoolArray
    by: BoolArray
    mmsi: int | None
    name: str
    label: str
    untold: bool

    def end(self, row: int, interval_s: float) -> End:
        return End(
            interval_s * (self.first + row),
            self.place_m[row],
            self.velocity_mps[row],
            self.covariance_m2[row],
            self.velocity_covariance[row],
        )


def _target(
    pieces: Sequence[Piece], biases: Biases, cameras: int, settings: FuseSettings
) -> _Target:
    """What all cameras together say of a target."""
    first = min(piece.first for piece in pieces)
    n = max(piece.last for piece in pieces) - first + 1
    shape = (n, cameras)
    place, velocity = np.full((*shape, 2), np.nan), np.full((*shape, 2), np.nan)
    spread, speed_spread = np.full((*shape, 2, 2), np.nan), np.full((*shape, 2, 2), np.nan)
    kind = np.full(shape, int(PointKind.EXTRAPOLATED), dtype=np.int8)
    moored = np.zeros(shape, dtype=bool)
    for piece in pieces:
        known = piece.known
        rows = np.flatnonzero(known) + piece.first - first
        k = piece.camera
        place[rows, k] = corrected(piece, biases)[known]
        velocity[rows, k] = piece.velocity_mps[known]
        spread[rows, k] = piece.covariance_m2[known]
        speed_spread[rows, k] = piece.velocity_covariance[known]
        kind[rows, k], moored[rows, k] = piece.kind[known], piece.moored[known]
    by = np.isfinite(place[..., 0])
    share = settings.correlated_share
    places, covariances = intersect(place, spread, share)
    velocities, velocity_covariances = intersect(velocity, speed_spread, share)
    # Formats that tell no covariance of velocities still tell velocities.
    told = np.isfinite(velocities[:, 0]) | ~by.any(axis=1)
    if not told.all():
        part = np.where(by[~told][..., None], velocity[~told], 0.0).sum(axis=1)
        velocities[~told] = part / by[~told].sum(axis=1, keepdims=True)
    labels = Counter(piece.label for piece in pieces if piece.label for _ in range(len(piece)))
    return _Target(
        first=first,
        place_m=places,
        velocity_mps=velocities,
        covariance_m2=covariances,
        velocity_covariance=velocity_covariances,
        kind=kinds_of(kind, by),
        moored=by.any(axis=1) & (moored | ~by).all(axis=1),
        by=by,
        mmsi=next((piece.mmsi for piece in pieces if piece.mmsi is not None), None),
        name=next((piece.name for piece in pieces if piece.name), ""),
        label=labels.most_common(1)[0][0] if labels else "",
        untold=all(piece.untold for piece in pieces),
    )


def _handed_over(
    pieces: Sequence[Piece],
    groups: Sequence[Sequence[int]],
    biases: Biases,
    density: float,
    settings: FuseSettings,
) -> tuple[list[list[int]], int]:
    """Groups of pieces, those that go on in one another joined; and how often that was."""
    cameras = len(biases.camera_m)
    made = [_target([pieces[i] for i in rows], biases, cameras, settings) for rows in groups]
    seen = [_seen(one, settings.interval_s) for one in made]
    n = len(seen)
    nats: dict[tuple[int, int], float] = {}
    begin = np.array([one.begin.time_s for one in seen])
    for i, before in enumerate(seen):
        lag_s = begin - before.end.time_s
        near = (lag_s >= -2.0) & (lag_s <= settings.handover.longest_s)
        near &= begin > before.begin.time_s
        near[i] = False
        for j in np.flatnonzero(near).tolist():
            after = seen[j]
            bias_m2 = biases.of_difference(
                before.end_camera, after.begin_camera, after.begin.place_m[None]
            )[0]
            nats[i, j] = handover_nats(before, after, bias_m2, density, settings.handover)
    following = successors(nats, settings.handover.least_nats)
    chained = set(following.values())
    out = []
    for i in range(n):
        if i in chained:
            continue
        rows, mmsi, at = list(groups[i]), seen[i].mmsi, i
        while at in following:
            after_mmsi = seen[following[at]].mmsi
            if mmsi is not None and after_mmsi not in (None, mmsi):
                # Between two vessels lies a stretch of which nobody knows whose it is.
                out.append(rows)
                rows = []
            mmsi = after_mmsi if after_mmsi is not None else mmsi
            at = following[at]
            rows += groups[at]
        out.append(rows)
    return out, n - len(out)


def _seen(one: _Target, interval_s: float) -> Seen:
    rows = np.flatnonzero(one.by.any(axis=1))
    begin, end = int(rows[0]), int(rows[-1])
    return Seen(
        one.end(begin, interval_s),
        one.end(end, interval_s),
        int(np.argmax(one.by[begin])),
        int(np.argmax(one.by[end])),
        one.mmsi,
    )


def _bridged(one: _Target, settings: FuseSettings) -> _Target:
    """A target with its gaps filled, as far as they are short enough."""
    rows: IntArray = np.flatnonzero(one.by.any(axis=1))
    place, velocity = one.place_m.copy(), one.velocity_mps.copy()
    spread, speed_spread = one.covariance_m2.copy(), one.velocity_covariance.copy()
    kind = one.kind.copy()
    moored = one.moored.copy()
    for left, right in pairwise(rows.tolist()):
        gap_s = settings.interval_s * (right - left)
        if right - left < 2 or gap_s > settings.handover.longest_s:
            continue
        between = np.arange(left + 1, right)
        states, covariances = bridge(
            one.end(left, settings.interval_s),
            one.end(right, settings.interval_s),
            settings.interval_s * (one.first + between),
            settings.handover,
        )
        place[between], velocity[between] = states[:, :2], states[:, 2:]
        spread[between], speed_spread[between] = covariances[:, :2, :2], covariances[:, 2:, 2:]
        kind[between] = int(PointKind.INTERPOLATED)
        moored[between] = one.moored[left] and one.moored[right]
    return replace(
        one,
        place_m=place,
        velocity_mps=velocity,
        covariance_m2=spread,
        velocity_covariance=speed_spread,
        kind=kind,
        moored=moored,
    )


def _track(
    one: _Target,
    number: int,
    names: Sequence[str],
    start_utc_s: float,
    plane: LocalPlane,
    settings: FuseSettings,
) -> FusedTrack:
    one = _bridged(one, settings)
    rows = np.flatnonzero(np.isfinite(one.place_m[:, 0]))
    by = [" ".join(np.array(names)[row]) for row in one.by[rows]]
    return FusedTrack(
        track_id=number,
        time_utc_s=np.asarray(start_utc_s + settings.interval_s * (one.first + rows)),
        east_m=one.place_m[rows, 0],
        north_m=one.place_m[rows, 1],
        velocity_east_mps=one.velocity_mps[rows, 0],
        velocity_north_mps=one.velocity_mps[rows, 1],
        covariance_m2=one.covariance_m2[rows],
        velocity_covariance_m2ps2=one.velocity_covariance[rows],
        kind=one.kind[rows],
        plane=plane,
        label=one.label,
        moored=one.moored[rows],
        untold=one.untold,
        mmsi=one.mmsi,
        name=one.name,
        cameras=np.array(by, dtype=np.str_),
    )


def _scatter(seen: Differences, biases: Biases) -> float:
    if not len(seen):
        return float("nan")
    left = seen.apart_m - biases.apart(seen)
    squared = np.einsum("mi,mij,mj->m", left, np.linalg.inv(seen.covariance_m2), left)
    return float(np.sqrt(squared.mean() / 2.0))


def _summaries(
    cameras: Sequence[CameraTracks], tracks: Sequence[FusedTrack], biases: Biases
) -> tuple[CameraSummary, ...]:
    by = [cameras_of(track) for track in tracks]
    sigma = np.sqrt(np.diag(biases.covariance)).reshape(len(cameras), -1)
    out = []
    for k, camera in enumerate(cameras):
        turns = camera.place_m is not None
        east_m, north_m, turn = biases.value[k].tolist()
        out.append(
            CameraSummary(
                name=camera.name,
                tracks=len(camera.tracks),
                targets=sum(camera.name in names for names in by),
                shared=sum(camera.name in names and len(names) > 1 for names in by),
                compared=int(biases.compared[k]),
                bias_east_m=east_m,
                bias_north_m=north_m,
                bias_sigma_m=float(np.sqrt(np.mean(sigma[k, :2] ** 2))),
                bias_heading_deg=float(np.degrees(turn)) if turns else None,
                bias_heading_sigma_deg=float(np.degrees(sigma[k, 2])) if turns else None,
            )
        )
    return tuple(out)
