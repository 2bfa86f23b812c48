"""Track-to-track association: which tracks of several cameras are of one target.

Two tracks of one target differ by their errors, two of different targets by anything. For each pair
that shares some time the log-likelihood ratio of the two is taken (Bar-Shalom, Willett and Tian,
*Tracking and Data Fusion*, 2011, chapter 9). The errors of a smooth track last, so moments near to
each other are one piece of evidence, not many: the ratio is that of a mean moment, times how many
independent stretches of time there are. Tracks are then joined, the best evidence first, never two
of one camera at the same time and never two of different MMSIs.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sightline.fusion.bias import Biases, Differences
from sightline.fusion.resampling import Piece
from sightline.types import BoolArray, FloatArray

SAME_VESSEL = 1000.0
"""Nats by which one MMSI speaks for one target: more than places say against it."""

GOES_ON = 5.0
"""Nats by which a tracker is believed where it may have gone over to another target."""

_WORST = -12.0
_RUNNING_S = 5.0
_PARTED_S = 5.0
_CHANGE_S = 15.0
_SWEEPS = 10
_GATE = 16.0
_UNTOLD_MPS = 0.3
_SPREAD_MPS = 3.0
_LARGEST_AREA_M2 = 1e8


@dataclass(frozen=True)
class AssociationSettings:
    """Settings of the association of tracks.

    Attributes:
        interval_s: Of the common time base.
        correlation_time_s: How long errors of a track last; so far apart are two moments that are
            evidence of their own.
        least_s: Tracks that share less time are not compared.
        least_nats: Tracks are joined where they are of one target by more than this.
    """

    interval_s: float = 1.0
    correlation_time_s: float = 10.0
    least_s: float = 2.0
    least_nats: float = 2.0


@dataclass(frozen=True, eq=False)
class Pair:
    """Two pieces of different cameras that share some time.

    Attributes:
        one: Index of a piece.
        other: Index of the other.
        first: Index of the first moment that is compared.
        nats: (N,) log-likelihood ratio of each moment from then on; NaN where one is not seen.
        distance: (N,) squared Mahalanobis distance of the places; NaN likewise.
    """

    one: int
    other: int
    first: int
    nats: FloatArray
    distance: FloatArray


def corrected(piece: Piece, biases: Biases) -> FloatArray:
    """(N, 2) places of a piece without the bias of its camera."""
    return np.asarray(piece.place_m - biases.at(piece.camera, piece.place_m))


def density_per_m2(pieces: Sequence[Piece]) -> float:
    """How many targets a camera sees at once on a square metre, where it sees any."""
    place = np.concatenate([piece.place_m[piece.known] for piece in pieces])
    at = np.concatenate([np.flatnonzero(piece.known) + piece.first for piece in pieces])
    cameras = max(len({piece.camera for piece in pieces}), 1)
    at_once = len(place) / max(np.unique(at).size, 1) / cameras
    spread = np.cov(place.T) if len(place) > 2 else np.eye(2)
    area_m2 = 4.0 * np.pi * np.sqrt(max(float(np.linalg.det(spread)), 1.0))
    return float(max(at_once, 1.0) / min(max(area_m2, 1.0), _LARGEST_AREA_M2))


def pairs_of(
    pieces: Sequence[Piece], biases: Biases, density: float, settings: AssociationSettings
) -> list[Pair]:
    """All pairs of pieces of different cameras that share time, and come near to each other."""
    first = np.array([piece.first for piece in pieces])
    last = np.array([piece.last for piece in pieces])
    camera = np.array([piece.camera for piece in pieces])
    # What is far further apart than any of its moments is uncertain needs no closer look.
    low, high, reach = _bounds(pieces, biases)
    place = [corrected(piece, biases) for piece in pieces]
    out = []
    for i in range(len(pieces)):
        others = (camera > camera[i]) & (first <= last[i]) & (last >= first[i])
        room = reach + reach[i]
        others &= (low <= high[i] + room[:, None]).all(axis=1)
        others &= (high >= low[i] - room[:, None]).all(axis=1)
        for j in np.flatnonzero(others).tolist():
            pair = _pair((i, j), pieces, place, biases, density)
            count = int(np.isfinite(pair.nats).sum())
            if count * settings.interval_s >= settings.least_s:
                out.append(pair)
    return out


def _bounds(pieces: Sequence[Piece], biases: Biases) -> tuple[FloatArray, FloatArray, FloatArray]:
    low, high, reach = [], [], []
    for piece in pieces:
        place = corrected(piece, biases)[piece.known]
        variance = np.trace(piece.covariance_m2[piece.known], axis1=1, axis2=2).max()
        own = biases.of_difference(piece.camera, piece.camera, place[:1])
        low.append(place.min(axis=0))
        high.append(place.max(axis=0))
        reach.append(10.0 * np.sqrt(variance + np.trace(own[0])) + 30.0)
    return np.array(low), np.array(high), np.array(reach)


def _pair(
    numbers: tuple[int, int],
    pieces: Sequence[Piece],
    place: Sequence[FloatArray],
    biases: Biases,
    density: float,
) -> Pair:
    """The evidence of each moment that two pieces share."""
    one, other = pieces[numbers[0]], pieces[numbers[1]]
    first, last = max(one.first, other.first), min(one.last, other.last)
    a = slice(first - one.first, last - one.first + 1)
    b = slice(first - other.first, last - other.first + 1)
    apart = place[numbers[0]][a] - place[numbers[1]][b]
    middle = 0.5 * (place[numbers[0]][a] + place[numbers[1]][b])
    known = np.isfinite(apart).all(axis=1)
    nats, distance = np.full(len(apart), np.nan), np.full(len(apart), np.nan)
    if known.any():
        covariance = one.covariance_m2[a][known] + other.covariance_m2[b][known]
        covariance = covariance + biases.of_difference(one.camera, other.camera, middle[known])
        distance[known], log_size = _mahalanobis(apart[known], covariance)
        own = -0.5 * (distance[known] + log_size) - np.log(2.0 * np.pi * density)
        own = own + of_velocities(
            one.velocity_mps[a][known] - other.velocity_mps[b][known],
            one.velocity_covariance[a][known] + other.velocity_covariance[b][known],
        )
        nats[known] = np.maximum(own, _WORST)
    return Pair(*numbers, first, nats, distance)


def _mahalanobis(apart: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N,) squared distances, and (N,) logarithms of the determinants."""
    # Written out: for two by two this is many times faster than a general inverse.
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    size = a * c - b * b
    x, y = apart[:, 0], apart[:, 1]
    return (c * x * x - 2.0 * b * x * y + a * y * y) / size, np.log(size)


def of_velocities(apart_mps: FloatArray, covariance: FloatArray) -> FloatArray:
    """(N,) log-likelihood ratio of velocities that are the same, against those of two vessels.

    Args:
        apart_mps: (N, 2) difference.
        covariance: (N, 2, 2) of it, m²/s²; NaN where nobody says: then it tells nothing.
    """
    known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(apart_mps).all(axis=1)
    out = np.zeros(len(apart_mps))
    if known.any():
        same = covariance[known] + _UNTOLD_MPS**2 * np.eye(2)
        near, near_size = _mahalanobis(apart_mps[known], same)
        other = same + 2.0 * _SPREAD_MPS**2 * np.eye(2)
        far, far_size = _mahalanobis(apart_mps[known], other)
        out[known] = 0.5 * (far + far_size - near - near_size)
    return out


def evidence(pair: Pair, settings: AssociationSettings) -> float:
    """Log-likelihood ratio of all that two pieces share: as many stretches as are independent."""
    known = np.isfinite(pair.nats)
    shared_s = settings.interval_s * float(known.sum())
    return float(pair.nats[known].mean()) * (1.0 + shared_s / settings.correlation_time_s)


def cuts(pairs: Sequence[Pair], interval_s: float) -> dict[int, set[int]]:
    """Moments at which a tracker may have gone over from one target to another, by piece.

    Where two pieces are together for some time and then far apart for some time, one of them is of
    two targets. Which, the association of the parts tells.
    """
    out: dict[int, set[int]] = {}
    least = max(1, round(_PARTED_S / interval_s))
    for pair in pairs:
        near = _running(pair.distance, max(1, round(_RUNNING_S / interval_s))) < _GATE
        if near.all() or not near.any():
            continue
        edges = np.flatnonzero(np.diff(near)) + 1
        starts = np.r_[0, edges]
        ends = np.r_[edges, near.size]
        lasting = ends - starts >= least
        for k in range(1, len(starts)):
            if lasting[k - 1] and lasting[k]:
                at = pair.first + int(starts[k])
                out.setdefault(pair.one, set()).add(at)
                out.setdefault(pair.other, set()).add(at)
    return out


def _running(values: FloatArray, width: int) -> FloatArray:
    """Running mean over what is known."""
    known = np.isfinite(values)
    kernel = np.ones(min(width, values.size))
    total = np.convolve(np.where(known, values, 0.0), kernel, mode="same")
    count = np.convolve(known.astype(float), kernel, mode="same")
    return np.asarray(np.where(count > 0.0, total / np.maximum(count, 1.0), 0.0))


def parted(
    pieces: Sequence[Piece], pairs: Sequence[Pair], settings: AssociationSettings
) -> tuple[list[Piece], list[Pair]]:
    """The pieces, cut where `cuts` says, and the pairs of their parts."""
    at = cuts(pairs, settings.interval_s)
    out: list[Piece] = []
    rows: list[list[int]] = []
    for i, piece in enumerate(pieces):
        inside = [k for k in sorted(at.get(i, ())) if piece.first < k <= piece.last]
        own = []
        for first, end in zip([piece.first, *inside], [*inside, piece.last + 1], strict=True):
            part = piece.part(first, end - 1)
            if part.known.any():
                own.append(len(out))
                out.append(part)
        rows.append(own)
    found = []
    for pair in pairs:
        for i in rows[pair.one]:
            for j in rows[pair.other]:
                first = max(out[i].first, out[j].first, pair.first)
                end = min(out[i].last, out[j].last, pair.first + pair.nats.size - 1) + 1
                at_both = slice(first - pair.first, end - pair.first)
                shared = int(np.isfinite(pair.nats[at_both]).sum()) if end > first else 0
                if shared * settings.interval_s >= settings.least_s:
                    found.append(Pair(i, j, first, pair.nats[at_both], pair.distance[at_both]))
    return out, found


def without_changes(
    pieces: Sequence[Piece], groups: Sequence[Sequence[int]], interval_s: float
) -> list[list[int]]:
    """Groups without the stretches in which a tracker goes over from one target to another.

    Such a short stretch, between parts of its track that are of two targets, is of neither.
    """
    group = _group_of(groups)
    dropped = set()
    for rows in _by_track(pieces):
        for before, i, after in zip(rows, rows[1:], rows[2:], strict=False):
            apart = len({group[before], group[i], group[after]}) == 3
            short = len(pieces[i]) * interval_s <= _CHANGE_S
            if apart and short and len(groups[group[i]]) == 1:
                dropped.add(i)
    return [list(rows) for rows in groups if not dropped.issuperset(rows)]


def joined(
    pieces: Sequence[Piece], pairs: Sequence[Pair], settings: AssociationSettings
) -> list[list[int]]:
    """Groups of pieces that are of one target each, the best evidence first.

    Evidence of groups is the sum over their pieces (correlation clustering, greedily).
    """
    graph = _Groups(pieces, settings)
    for pair in pairs:
        graph.add(pair.one, pair.other, evidence(pair, settings))
    for rows in _by_track(pieces):
        for i, j in pairwise(rows):
            graph.add(i, j, GOES_ON)
    graph.merge()
    graph.improve()
    return graph.groups()


def _by_track(pieces: Sequence[Piece]) -> list[list[int]]:
    """The pieces of each track, in their order."""
    found: dict[int, list[int]] = {}
    for i, piece in enumerate(pieces):
        found.setdefault(piece.track, []).append(i)
    return list(found.values())


def _group_of(groups: Sequence[Sequence[int]]) -> dict[int, int]:
    """The number of each piece's group."""
    return {i: number for number, rows in enumerate(groups) for i in rows}


class _Groups:
    """Groups of pieces with the evidence between them."""

    def __init__(self, pieces: Sequence[Piece], settings: AssociationSettings) -> None:
        self._pieces = pieces
        self._least = settings.least_nats
        self._tolerance = max(1, round(1.0 / settings.interval_s))
        self._members = {i: {i} for i in range(len(pieces))}
        self._links: dict[int, dict[int, float]] = {i: {} for i in range(len(pieces))}

    def add(self, one: int, other: int, nats: float) -> None:
        """Add evidence that two pieces are of one target."""
        mine, theirs = self._pieces[one].mmsi, self._pieces[other].mmsi
        if mine is not None and mine == theirs:
            nats += SAME_VESSEL
        self._links[one][other] = self._links[one].get(other, 0.0) + nats
        self._links[other][one] = self._links[one][other]

    def groups(self) -> list[list[int]]:
        """The groups, each sorted, in the order of their first piece."""
        return sorted(sorted(rows) for rows in self._members.values() if rows)

    def merge(self) -> None:
        """Join groups as long as there is evidence for it, the best first."""
        links = {i: dict(own) for i, own in self._links.items()}
        heap = [
            (-nats, i, j)
            for i, own in links.items()
            for j, nats in own.items()
            if i < j and nats > self._least
        ]
        heapq.heapify(heap)
        while heap:
            negative, i, j = heapq.heappop(heap)
            if links.get(i, {}).get(j) != -negative:
                continue
            if not self._may_be_one(self._members[i], self._members[j]):
                continue
            self._members[i] |= self._members.pop(j)
            for k, nats in links.pop(j).items():
                del links[k][j]
                if k != i:
                    links[i][k] = links[k][i] = links[i].get(k, 0.0) + nats
            for k, nats in links[i].items():
                if nats > self._least:
                    heapq.heappush(heap, (-nats, min(i, k), max(i, k)))

    def improve(self) -> None:
        """Let single pieces change groups, two of one camera their places, while that gains."""
        home = {piece: key for key, rows in self._members.items() for piece in rows}
        for _ in range(_SWEEPS):
            moved = False
            for piece in range(len(self._pieces)):
                moved |= self._moved(piece, home)
            if not moved:
                break

    def _moved(self, piece: int, home: dict[int, int]) -> bool:
        """Move a piece to where it fits best; whether that was elsewhere."""
        here = home[piece]
        stays = self._fit(piece, self._members[here])
        best, where, out = self._least, None, set[int]()
        for key in {home[k] for k, nats in self._links[piece].items() if nats > 0.0} - {here}:
            against = self._in_the_way(piece, self._members[key])
            rest = self._members[key] - against
            if len(against) > 1 or not self._may_be_one({piece}, rest):
                continue
            gain = self._fit(piece, rest) - stays
            for other in against:
                gain -= self._fit(other, rest)
                left = self._members[here] - {piece}
                if self._may_be_one({other}, left):
                    gain += max(self._fit(other, left), 0.0)
            if gain > best:
                best, where, out = gain, key, against
        if where is None and stays < -self._least:
            where = max(self._members) + 1
            self._members[where] = set()
        if where is None:
            return False
        self._put(piece, where, home)
        for other in out:
            left = self._members[here]
            if left and self._may_be_one({other}, left) and self._fit(other, left) > 0.0:
                self._put(other, here, home)
            else:
                alone = max(self._members) + 1
                self._members[alone] = set()
                self._put(other, alone, home)
        return True

    def _put(self, piece: int, key: int, home: dict[int, int]) -> None:
        self._members[home[piece]].discard(piece)
        self._members[key].add(piece)
        home[piece] = key

    def _fit(self, piece: int, rows: set[int]) -> float:
        return sum(nats for k, nats in self._links[piece].items() if k in rows and k != piece)

    def _in_the_way(self, piece: int, rows: set[int]) -> set[int]:
        """The pieces of the same camera at the same time."""
        own = self._pieces[piece]
        return {
            k
            for k in rows
            if self._pieces[k].camera == own.camera
            and at_once(own, self._pieces[k]) > self._tolerance
        }

    def _may_be_one(self, some: set[int], others: set[int]) -> bool:
        vessels = {self._pieces[k].mmsi for k in some | others} - {None}
        return len(vessels) < 2 and not any(self._in_the_way(k, others) for k in some)


def at_once(one: Piece, other: Piece) -> int:
    """At how many moments both are seen."""
    first, last = max(one.first, other.first), min(one.last, other.last)
    if last < first:
        return 0
    a = one.known[first - one.first : last - one.first + 1]
    b = other.known[first - other.first : last - other.first + 1]
    return int((a & b).sum())


def differences(
    pieces: Sequence[Piece],
    pairs: Sequence[Pair],
    groups: Sequence[Sequence[int]],
    settings: AssociationSettings,
    stretch_s: float,
) -> Differences:
    """Differences of cameras in targets that two see, a row a stretch of time.

    Args:
        pieces: As the cameras have them.
        pairs: Of them.
        groups: Which pieces are of one target.
        settings: As of the association.
        stretch_s: Length of a stretch; within it errors are taken for one.
    """
    group = _group_of(groups)
    steps = max(1, round(stretch_s / settings.interval_s))
    rows: list[tuple[int, int, FloatArray, FloatArray, FloatArray]] = []
    for pair in pairs:
        if group[pair.one] != group[pair.other]:
            continue
        one, other = pieces[pair.one], pieces[pair.other]
        known: BoolArray = np.isfinite(pair.nats)
        for begin in range(0, known.size, steps):
            at = begin + np.flatnonzero(known[begin : begin + steps])
            if at.size * 2 < steps and at.size < known.sum():
                continue
            a, b = at + pair.first - one.first, at + pair.first - other.first
            apart = (one.place_m[a] - other.place_m[b]).mean(axis=0)
            middle = 0.5 * (one.place_m[a] + other.place_m[b]).mean(axis=0)
            covariance = (one.covariance_m2[a] + other.covariance_m2[b]).mean(axis=0)
            rows.append((one.camera, other.camera, middle, apart, covariance))
    if not rows:
        return Differences.none()
    first, second, middle_m, apart_m, covariances = zip(*rows, strict=True)
    return Differences(
        np.array(first),
        np.array(second),
        np.array(middle_m),
        np.array(apart_m),
        np.array(covariances),
    )
