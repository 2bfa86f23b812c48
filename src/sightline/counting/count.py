"""Counts by interval of what tracks do at lines, in zones, and with each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr

from sightline.area import Area, Line
from sightline.counting.boundaries import LineBoundary, ZoneBoundary
from sightline.counting.crossings import Crossing, Passage, moments, passage, time_inside
from sightline.counting.near_misses import near_misses
from sightline.errors import InputError
from sightline.types import FloatArray, Track, rfc3339

Row = dict[str, str | int | float | None]
"""A line of a result: what is not known is None."""

UNLABELLED = "unlabelled"
"""The class of tracks without one."""

LEFT_TO_RIGHT, RIGHT_TO_LEFT = "left to right", "right to left"

_BOUND = ("north", "northeast", "east", "southeast", "south", "southwest", "west", "northwest")
_MOST_ROWS = 1_000_000
# The 95 % quantile of chi squared with two degrees of freedom.
_INDISTINCT = 5.991


@dataclass(frozen=True)
class CountSettings:
    """Settings of `count`.

    Attributes:
        every_s: Length of an interval; intervals begin at whole multiples of it since 1970, UTC.
        closest_m: Closest approaches under it are near misses; None: they are not looked for.

    Raises:
        InputError: A value is not positive and finite.
    """

    every_s: float = 900.0
    closest_m: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("an interval", self.every_s), ("a limit", self.closest_m)):
            if value is not None and not 0.0 < value < np.inf:
                raise InputError(f"{name} of {value:g} is none; give a positive number")


@dataclass(frozen=True)
class Flow:
    """A way through the scene: from one line or zone to another.

    Attributes:
        name: As its file names it.
        origin: The line that is crossed, or the zone that is entered, first.
        destination: The one after it.
    """

    name: str
    origin: str
    destination: str


@dataclass(frozen=True)
class CountReport:
    """What was counted, as rows that a table or JSON takes.

    Attributes:
        lines: A row an interval, line, class and direction.
        zones: A row an interval, zone and class.
        journeys: A row an interval, class, origin and destination.
        flows: A row an interval, flow and class.
        near_misses: A row a near miss.
        tracks: How many there were.
        moored: Of these, how many never move.
        without_covariance: Of these, how many do not say how unsure they are.
        every_s: Length of an interval.
    """

    lines: list[Row] = field(default_factory=list)
    zones: list[Row] = field(default_factory=list)
    journeys: list[Row] = field(default_factory=list)
    flows: list[Row] = field(default_factory=list)
    near_misses: list[Row] = field(default_factory=list)
    tracks: int = 0
    moored: int = 0
    without_covariance: int = 0
    every_s: float = 900.0

    def to_dict(self) -> dict[str, object]:
        """As JSON has it."""
        return {
            "every_s": self.every_s,
            "tracks": self.tracks,
            "moored": self.moored,
            "without_covariance": self.without_covariance,
            "lines": self.lines,
            "zones": self.zones,
            "journeys": self.journeys,
            "flows": self.flows,
            "near_misses": self.near_misses,
        }

    def rows(self) -> list[Row]:
        """All in one, each with ``what`` it is."""
        parts = (
            ("line", self.lines),
            ("zone", self.zones),
            ("journey", self.journeys),
            ("flow", self.flows),
            ("near miss", self.near_misses),
        )
        return [{"what": what, **row} for what, rows in parts for row in rows]


def count(
    tracks: Sequence[Track],
    *,
    lines: Mapping[str, Line] | None = None,
    zones: Mapping[str, Area] | None = None,
    flows: Sequence[Flow] = (),
    settings: CountSettings | None = None,
) -> CountReport:
    """Count what tracks do at lines, in zones, and with each other.

    A crossing counts where it is likelier than not; ``expected`` sums the probabilities of all.

    Args:
        tracks: In one plane.
        lines: By name.
        zones: By name.
        flows: Between these lines and zones.
        settings: Intervals, and what is a near miss.

    Raises:
        InputError: There is no point of a track, a flow's line or zone is not there, or there
            would be too many intervals.
    """
    settings = settings or CountSettings()
    tracks = [track for track in tracks if len(track)]
    if not tracks:
        raise InputError("there is no point of a track, so nothing can be counted")
    plane = tracks[0].plane
    if any(track.plane != plane for track in tracks):
        raise InputError("the tracks are in different planes; read them with one")
    here = [LineBoundary.of(name, line, plane) for name, line in (lines or {}).items()]
    there = [ZoneBoundary.of(name, area, plane) for name, area in (zones or {}).items()]
    classes = sorted({_class(track) for track in tracks})
    rows = (2 * len(here) + len(there) + len(flows)) * len(classes)
    bins = _Bins.of(tracks, settings.every_s, rows)
    at_lines = [[passage(track, line) for track in tracks] for line in here]
    at_zones = [[passage(track, zone) for track in tracks] for zone in there]
    crossed = [
        _crossed([line.name for line in here], [one[k] for one in at_lines])
        for k in range(len(tracks))
    ]
    return CountReport(
        lines=[
            row
            for line, passages in zip(here, at_lines, strict=True)
            for row in _line_rows(line, tracks, passages, bins)
        ],
        zones=[
            row
            for zone, passages in zip(there, at_zones, strict=True)
            for row in _zone_rows(zone, tracks, passages, bins)
        ],
        journeys=_journeys(tracks, crossed, bins),
        flows=_flow_rows(
            flows,
            tracks,
            [
                _in_order(at_line + _crossed([zone.name for zone in there], at_zone, inwards=True))
                for at_line, at_zone in zip(
                    crossed,
                    ([one[k] for one in at_zones] for k in range(len(tracks))),
                    strict=True,
                )
            ],
            {one.name for one in here} | {one.name for one in there},
            bins,
        ),
        near_misses=_near_misses(tracks, settings.closest_m),
        tracks=len(tracks),
        moored=sum(track.never_moves for track in tracks),
        without_covariance=sum(not np.isfinite(track.covariance_m2).all() for track in tracks),
        every_s=settings.every_s,
    )


@dataclass(frozen=True, eq=False)
class _Bins:
    """Intervals, and the part of each that tracks were made in."""

    edges_s: FloatArray
    first_s: float
    last_s: float

    @classmethod
    def of(cls, tracks: Sequence[Track], every_s: float, rows: int) -> _Bins:
        first = min(float(track.time_utc_s[0]) for track in tracks)
        last = max(float(track.time_utc_s[-1]) for track in tracks)
        begin, end = np.floor(first / every_s), np.floor(last / every_s) + 1.0
        if (end - begin) * max(rows, 1) > _MOST_ROWS:
            raise InputError(
                f"from {rfc3339(first)} to {rfc3339(last)} every {every_s:g} s there would be "
                f"more than {_MOST_ROWS:,} rows; count in longer intervals"
            )
        return cls(np.arange(begin, end + 1.0) * every_s, first, last)

    def __len__(self) -> int:
        return len(self.edges_s) - 1

    def part(self, i: int) -> tuple[float, float]:
        """Begin and end of an interval."""
        return float(self.edges_s[i]), float(self.edges_s[i + 1])

    def number(self, time_s: float) -> int:
        """Which interval a time is in; one that begins with it, where two meet."""
        at = int(np.searchsorted(self.edges_s, time_s, side="right")) - 1
        return min(max(at, 0), len(self) - 1)

    def observed_s(self, i: int) -> float:
        """How much of an interval the tracks, all together, extend over."""
        begin, end = self.part(i)
        return max(min(end, self.last_s) - max(begin, self.first_s), 0.0)

    def head(self, i: int) -> Row:
        """The first columns of an interval's rows."""
        begin, end = self.part(i)
        return {"begin_utc": rfc3339(begin), "end_utc": rfc3339(end)}


class _Sum:
    """Sums of expectations and variances over tracks, an interval each."""

    def __init__(self, size: int) -> None:
        self.counted: list[list[Crossing]] = [[] for _ in range(size)]
        self.expected, self.variance = np.zeros(size), np.zeros(size)

    def add(self, one: Passage, rising: bool, bins: _Bins) -> None:
        """The crossings of a track in one direction."""
        for crossing in one.counted:
            if crossing.rising == rising:
                self.counted[bins.number(crossing.time_utc_s)].append(crossing)
        possible = [crossing for crossing in one.possible if crossing.rising == rising]
        if not possible:
            return
        first = bins.number(min(float(crossing.time_s[0]) for crossing in possible))
        last = bins.number(max(float(crossing.time_s[-1]) for crossing in possible))
        ends = np.array([crossing.between_ends for crossing in possible])
        for i in range(first, last + 1):
            low, high = np.array([crossing.levels(*bins.part(i)) for crossing in possible]).T
            mean, variance = moments(low, high, ends)
            self.expected[i] += mean
            self.variance[i] += variance + float((ends * (1.0 - ends) * (high - low)).sum())
            if not one.known and mean > 0.0:
                self.variance[i] = np.nan

    def columns(self, i: int, prefix: str = "") -> Row:
        """Count, expectation and its standard deviation."""
        return {
            f"{prefix}count": len(self.counted[i]),
            f"{prefix}expected": _number(self.expected[i]),
            f"{prefix}sigma": _number(np.sqrt(self.variance[i])),
        }


def _line_rows(
    line: LineBoundary, tracks: Sequence[Track], passages: Sequence[Passage], bins: _Bins
) -> list[Row]:
    sums = {
        (name, rising): _Sum(len(bins))
        for name in sorted({_class(track) for track in tracks})
        for rising in (True, False)
    }
    for track, one in zip(tracks, passages, strict=True):
        for rising in (True, False):
            sums[_class(track), rising].add(one, rising, bins)
    twice = _maybe_twice(tracks, passages)
    rows: list[Row] = []
    for i in range(len(bins)):
        for (name, rising), total in sums.items():
            speeds = np.array([crossing.speed_mps for crossing in total.counted[i]])
            sigmas = np.array([crossing.speed_sigma_mps for crossing in total.counted[i]])
            n = len(speeds)
            rows.append(
                {
                    **bins.head(i),
                    "name": line.name,
                    "class": name,
                    "direction": LEFT_TO_RIGHT if rising else RIGHT_TO_LEFT,
                    "bound": _bound(line.right_deg + (0.0 if rising else 180.0)),
                    **total.columns(i),
                    "maybe_twice": sum(id(crossing) in twice for crossing in total.counted[i]),
                    "speed_mean_mps": _number(speeds.mean()) if n else None,
                    "speed_se_mps": _number(np.sqrt((sigmas**2).sum()) / n) if n else None,
                    "speed_std_mps": _number(speeds.std(ddof=1)) if n > 1 else None,
                }
            )
    return rows


def _maybe_twice(tracks: Sequence[Track], passages: Sequence[Passage]) -> set[int]:
    """Crossings, by their id, that may be another track's of the same vessel, told before.

    Two tracks that cross a line in the same direction may be one vessel where, halfway between
    their crossings, their places are not further apart than 95 % of the differences that their
    covariances state (chi squared with two degrees of freedom).
    """
    found: set[int] = set()
    all_of = [
        (crossing, track)
        for track, one in zip(tracks, passages, strict=True)
        for crossing in one.counted
        if one.known
    ]
    all_of.sort(key=lambda pair: pair[0].time_utc_s)
    for k, (crossing, track) in enumerate(all_of):
        for before, other in reversed(all_of[:k]):
            middle = 0.5 * (before.time_utc_s + crossing.time_utc_s)
            if middle < track.time_utc_s[0]:
                break
            same_way = before.rising == crossing.rising and other is not track
            if same_way and _indistinct(track, other, middle):
                found.add(id(crossing))
                break
    return found


def _indistinct(first: Track, second: Track, time_s: float) -> bool:
    if not all(one.time_utc_s[0] <= time_s <= one.time_utc_s[-1] for one in (first, second)):
        return False
    apart, covariance = np.zeros(2), np.zeros((2, 2))
    for track, sign in ((first, 1.0), (second, -1.0)):
        columns = np.column_stack([track.east_m, track.north_m, track.covariance_m2.reshape(-1, 4)])
        values = np.array([np.interp(time_s, track.time_utc_s, one) for one in columns.T])
        apart += sign * values[:2]
        covariance += values[2:].reshape(2, 2)
    squared = float(apart @ np.linalg.pinv(covariance) @ apart)
    return squared < _INDISTINCT


def _zone_rows(
    zone: ZoneBoundary, tracks: Sequence[Track], passages: Sequence[Passage], bins: _Bins
) -> list[Row]:
    most, most_sigma = _most(passages, bins)
    rows: list[list[Row]] = [[] for _ in range(len(bins))]
    for name in sorted({_class(track) for track in tracks}):
        own = [one for track, one in zip(tracks, passages, strict=True) if _class(track) == name]
        entries, exits = _Sum(len(bins)), _Sum(len(bins))
        time, variance, moored = np.zeros((3, len(bins)))
        dwell: list[list[tuple[float, float]]] = [[] for _ in range(len(bins))]
        for one in own:
            entries.add(one, True, bins)
            exits.add(one, False, bins)
            for i, inside in _time_inside(one, bins).items():
                time[i] += inside.moving_s
                variance[i] += inside.variance_s2
                moored[i] += inside.moored_s
            for entry, leaving in zip(one.counted[:-1], one.counted[1:], strict=True):
                if entry.rising and not leaving.rising:
                    sigma = np.hypot(entry.time_sigma_s, leaving.time_sigma_s)
                    stay = (leaving.time_utc_s - entry.time_utc_s, float(sigma))
                    dwell[bins.number(leaving.time_utc_s)].append(stay)
        own_most, own_sigma = _most(own, bins)
        for i in range(len(bins)):
            span = bins.observed_s(i)
            lasted, sigmas = np.array(dwell[i]).reshape(-1, 2).T
            n = len(lasted)
            rows[i].append(
                {
                    **bins.head(i),
                    "name": zone.name,
                    "class": name,
                    **entries.columns(i, "entries_"),
                    **exits.columns(i, "exits_"),
                    "stays": n,
                    "dwell_mean_s": _number(lasted.mean()) if n else None,
                    "dwell_se_s": _number(np.sqrt((sigmas**2).sum()) / n) if n else None,
                    "dwell_std_s": _number(lasted.std(ddof=1)) if n > 1 else None,
                    "occupancy_mean": _number(time[i] / span) if span else None,
                    "occupancy_sigma": _number(np.sqrt(variance[i]) / span) if span else None,
                    "occupancy_moored": _number(moored[i] / span) if span else None,
                    "occupancy_most": own_most[i],
                    "occupancy_most_sigma": _number(own_sigma[i]),
                    "occupancy_most_of_all": most[i],
                    "occupancy_most_of_all_sigma": _number(most_sigma[i]),
                }
            )
    return [row for part in rows for row in part]


@dataclass(frozen=True)
class _Inside:
    """How long a track is in a zone during an interval."""

    moving_s: float
    moored_s: float
    variance_s2: float


def _time_inside(one: Passage, bins: _Bins) -> dict[int, _Inside]:
    begin, end = float(one.time_s[0]), float(one.time_s[-1])
    edges = bins.edges_s[(bins.edges_s > begin) & (bins.edges_s < end)]
    time = np.union1d(one.time_s, edges)
    z = np.interp(time, one.time_s, one.z)
    moored = np.interp(0.5 * (time[:-1] + time[1:]), one.time_s, one.moored)
    share, lasts = time_inside(z[:-1], z[1:]), np.diff(time)
    number = np.searchsorted(bins.edges_s, time[:-1], side="right") - 1
    found = {}
    for i in np.unique(number).tolist():
        here = number == i
        moving = lasts[here] * (moored[here] <= 0.5)
        mean, variance = moments(np.zeros(len(moving)), share[here], moving)
        if not one.known and mean > 0.0:
            variance = float("nan")
        total = float((share[here] * lasts[here]).sum())
        found[i] = _Inside(mean, max(total - mean, 0.0), variance)
    return found


def _most(passages: Sequence[Passage], bins: _Bins) -> tuple[list[int], FloatArray]:
    """The most targets under way at once in each interval, and its standard deviation."""
    changes: list[tuple[float, int]] = []
    for one in passages:
        inside = _nominal(one)
        changes += [(a, 1) for a, _ in inside] + [(b, -1) for _, b in inside]
    # Who leaves as another comes is not there with it.
    changes.sort()
    most, at = [0] * len(bins), [float("nan")] * len(bins)
    level, k = 0, 0
    for i in range(len(bins)):
        begin, end = bins.part(i)
        most[i], at[i] = level, begin
        while k < len(changes) and changes[k][0] < end:
            level += changes[k][1]
            if level > most[i]:
                # Halfway to what changes next, where the number is as sure as it comes to be.
                until = min(changes[k + 1][0] if k + 1 < len(changes) else end, end)
                most[i], at[i] = level, 0.5 * (changes[k][0] + until)
            k += 1
    sigma = np.zeros(len(bins))
    for i, when in enumerate(at):
        for one in passages:
            if one.time_s[0] <= when <= one.time_s[-1]:
                level_of = float(ndtr(np.interp(when, one.time_s, one.z)))
                here = np.interp(when, one.time_s, one.moored) <= 0.5 and level_of > 1e-6
                unsure = level_of * (1.0 - level_of) if one.known else float("nan")
                sigma[i] += unsure if here else 0.0
    return most, np.sqrt(sigma)


def _nominal(one: Passage) -> list[tuple[float, float]]:
    """When a track is in a zone and not moored, as its crossings say that count."""
    way = np.where(one.moored > 0.5, -1.0, one.z)
    inside = way > 0.0
    edges = np.flatnonzero(np.diff(np.r_[False, inside, False]))
    found = []
    for a, b in edges.reshape(-1, 2).tolist():
        begin, end = float(one.time_s[a]), float(one.time_s[b - 1])
        if a > 0 and one.moored[a - 1] <= 0.5:
            begin = float(np.interp(0.0, one.z[a - 1 : a + 1], one.time_s[a - 1 : a + 1]))
        if b < len(way) and one.moored[b] <= 0.5:
            end = float(np.interp(0.0, one.z[[b, b - 1]], one.time_s[[b, b - 1]]))
        found.append((begin, end))
    return found


_Visit = tuple[Crossing, str]
"""A crossing that counts, and the name of what was crossed."""


def _crossed(
    names: Sequence[str], passages: Sequence[Passage], *, inwards: bool = False
) -> list[_Visit]:
    """What a track crosses, in the order of time; or of zones, what it enters."""
    return _in_order(
        [
            (crossing, name)
            for name, one in zip(names, passages, strict=True)
            for crossing in one.counted
            if crossing.rising or not inwards
        ]
    )


def _in_order(visits: Sequence[_Visit]) -> list[_Visit]:
    return sorted(visits, key=lambda visit: visit[0].time_utc_s)


@dataclass(frozen=True)
class _Trip:
    """A track from one crossing to another.

    Attributes:
        chance: That both were; NaN where the track does not say how unsure it is.
        took_s: Time between them.
        sigma_s: Its standard deviation.
    """

    chance: float
    took_s: float
    sigma_s: float

    @classmethod
    def of(cls, track: Track, begin: Crossing, end: Crossing) -> _Trip:
        known = np.isfinite(track.covariance_m2).all()
        return cls(
            begin.probability * end.probability if known else float("nan"),
            end.time_utc_s - begin.time_utc_s,
            float(np.hypot(begin.time_sigma_s, end.time_sigma_s)),
        )


def _trip_columns(trips: Sequence[_Trip]) -> Row:
    chance = np.array([one.chance for one in trips])
    took_s = np.array([one.took_s for one in trips])
    sigma_s = np.array([one.sigma_s for one in trips])
    n = len(trips)
    return {
        "count": n,
        "expected": _number(chance.sum()),
        "sigma": _number(np.sqrt((chance * (1.0 - chance)).sum())),
        "travel_mean_s": _number(took_s.mean()) if n else None,
        "travel_se_s": _number(np.sqrt((sigma_s**2).sum()) / n) if n else None,
    }


def _journeys(
    tracks: Sequence[Track], crossed: Sequence[Sequence[_Visit]], bins: _Bins
) -> list[Row]:
    """From the first line that a track crosses to the last, by the interval of the first."""
    trips: dict[tuple[int, str, str, str], list[_Trip]] = {}
    for track, visits in zip(tracks, crossed, strict=True):
        if len(visits) < 2:
            continue
        (begin, origin), (end, destination) = visits[0], visits[-1]
        key = (bins.number(begin.time_utc_s), _class(track), origin, destination)
        trips.setdefault(key, []).append(_Trip.of(track, begin, end))
    return [
        {
            **bins.head(i),
            "class": name,
            "origin": origin,
            "destination": destination,
            **_trip_columns(found),
        }
        for (i, name, origin, destination), found in sorted(trips.items(), key=lambda kv: kv[0])
    ]


def _flow_rows(
    flows: Sequence[Flow],
    tracks: Sequence[Track],
    crossed: Sequence[Sequence[_Visit]],
    known: set[str],
    bins: _Bins,
) -> list[Row]:
    """Each track in the one flow that it is in for longest, by the interval of its first crossing.

    So OTAnalytics assigns road users (``application/analysis/traffic_counting.py``,
    ``SimpleRoadUserAssigner``): of all pairs of crossings that make a flow, the one that takes
    longest.
    """
    for flow in flows:
        for name in (flow.origin, flow.destination):
            if name not in known:
                raise InputError(f"flow {flow.name}: there is no line or zone {name!r}")
    trips: dict[tuple[int, int, str], list[_Trip]] = {}
    for track, visits in zip(tracks, crossed, strict=True):
        pairs = [
            (end.time_utc_s - begin.time_utc_s, number, begin, end)
            for k, (begin, origin) in enumerate(visits)
            for end, destination in visits[k + 1 :]
            for number, flow in enumerate(flows)
            if (flow.origin, flow.destination) == (origin, destination)
        ]
        if pairs:
            _, number, begin, end = max(pairs, key=lambda pair: pair[0])
            key = (bins.number(begin.time_utc_s), number, _class(track))
            trips.setdefault(key, []).append(_Trip.of(track, begin, end))
    classes = sorted({_class(track) for track in tracks})
    return [
        {
            **bins.head(i),
            "name": flow.name,
            "class": name,
            "origin": flow.origin,
            "destination": flow.destination,
            **_trip_columns(trips.get((i, number, name), [])),
        }
        for i in range(len(bins))
        for number, flow in enumerate(flows)
        for name in classes
    ]


def _near_misses(tracks: Sequence[Track], limit_m: float | None) -> list[Row]:
    if limit_m is None:
        return []
    rows: list[Row] = []
    for one in near_misses(tracks, limit_m):
        latitude, longitude = tracks[0].plane.to_geographic([one.east_m], [one.north_m])
        rows.append(
            {
                "time_utc": f"{rfc3339(one.time_utc_s)[:-1]}.{int(one.time_utc_s % 1 * 1000):03d}Z",
                "track_id": one.track_ids[0],
                "other_track_id": one.track_ids[1],
                "class": one.labels[0] or UNLABELLED,
                "other_class": one.labels[1] or UNLABELLED,
                "distance_m": _number(one.distance_m),
                "distance_sigma_m": _number(one.distance_sigma_m),
                "probability": _number(one.probability),
                "latitude_deg": round(float(latitude[0]), 7),
                "longitude_deg": round(float(longitude[0]), 7),
            }
        )
    return rows


def _class(track: Track) -> str:
    return track.label or UNLABELLED


def _bound(bearing_deg: float) -> str:
    return _BOUND[round(bearing_deg / 45.0) % 8] + "bound"


def _number(value: float) -> float | None:
    """Rounded to a millionth; None for NaN, which JSON does not know."""
    return round(float(value), 6) + 0.0 if np.isfinite(value) else None
