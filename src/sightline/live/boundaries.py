"""Lines and zones that are watched: who crosses, enters, leaves, stays long and goes fast.

A target is on a side of a boundary once its place is a standard deviation beyond it, and has
crossed once it is on the other: errors that last would otherwise count one that lies at the border
again and again. What happened is counted when that is known, at the time at which the place passed
the boundary. See `sightline.counting` for the same of tracks that are whole.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import ndtr

from sightline.area import Area, Line
from sightline.counting.boundaries import LineBoundary, Sides, ZoneBoundary
from sightline.counting.count import LEFT_TO_RIGHT, RIGHT_TO_LEFT
from sightline.geodesy import LocalPlane
from sightline.moment import Alert, AlertKind, BoundaryState, Moment, TargetState
from sightline.types import FloatArray

_SURE_Z = 1.0
_LEAST_SIGMA_M = 0.1
_LIKELIER_THAN_NOT = 0.5
# One standard deviation that is exceeded by 5 % alone.
_SURE_SPEED = 1.645
_FORGOTTEN_S = 60.0


@dataclass(frozen=True)
class BoundaryLimits:
    """When stays and speeds in zones are worth an alert.

    Attributes:
        speed_mps: Above it, for sure (95 %), a target is too fast; None: at no speed.
        dwell_s: After so long a target has stayed too long; None: never.
    """

    speed_mps: float | None = None
    dwell_s: float | None = None


@dataclass(eq=False)
class _Side:
    """On which side of a boundary a target is."""

    z: float
    time_utc_s: float
    passed_utc_s: float
    between_ends: float = 1.0
    right: bool | None = None
    since_utc_s: float | None = None
    told: set[AlertKind] = field(default_factory=set)


@dataclass(eq=False)
class _Watched:
    """A boundary, and who is where beside it."""

    boundary: LineBoundary | ZoneBoundary
    counts: BoundaryState
    sides: dict[int, _Side] = field(default_factory=dict)
    stays: int = 0
    stayed_s: float = 0.0

    @property
    def is_zone(self) -> bool:
        return isinstance(self.boundary, ZoneBoundary)


class BoundaryWatch:
    """Watches lines and zones, moment by moment."""

    def __init__(
        self,
        plane: LocalPlane,
        *,
        lines: Mapping[str, Line] | None = None,
        zones: Mapping[str, Area] | None = None,
        limits: BoundaryLimits | None = None,
    ) -> None:
        """Begin with nobody anywhere.

        Args:
            plane: Of the camera.
            lines: By name.
            zones: By name.
            limits: Of stays and speeds in zones.
        """
        self._plane, self._limits = plane, limits or BoundaryLimits()
        self._on_earth = dict(lines or {}), dict(zones or {})
        self._watched = [
            *(
                _Watched(LineBoundary.of(name, line, plane), BoundaryState(name, "line"))
                for name, line in (lines or {}).items()
            ),
            *(
                _Watched(ZoneBoundary.of(name, area, plane), BoundaryState(name, "zone"))
                for name, area in (zones or {}).items()
            ),
        ]
        self._last_utc_s = -np.inf

    def carry_on(self, before: BoundaryWatch) -> None:
        """Take what was counted at boundaries that are where they were."""
        same = {_key(one.boundary): one for one in before._watched}
        self._watched = [same.get(_key(one.boundary), one) for one in self._watched]

    def states(self) -> tuple[BoundaryState, ...]:
        """What has happened at each until now."""
        return tuple(one.counts for one in self._watched)

    def geojson(self) -> dict[str, object]:
        """The boundaries as GeoJSON, each with its name and kind."""
        lines, zones = self._on_earth
        features = []
        for name, line in lines.items():
            corners = _between_180(line.corners)
            features.append(_feature(name, "line", "LineString", corners))
        for name, area in zones.items():
            rings = [[_between_180(_closed(ring)) for ring in p.rings] for p in area.polygons]
            features.append(_feature(name, "zone", "MultiPolygon", rings))
        return {"type": "FeatureCollection", "features": features}

    def update(self, moment: Moment) -> Moment:
        """The moment, with what its targets have done and what was counted until now."""
        now_s = moment.time_utc_s
        if now_s < self._last_utc_s:
            # A clock that was set back: who is where is found anew.
            for one in self._watched:
                one.sides.clear()
        self._last_utc_s = now_s
        seen = [one for one in moment.targets if one.state != "predicted"]
        alerts: list[Alert] = []
        if seen and self._watched:
            latitude = np.array([one.latitude_deg for one in seen])
            longitude = np.array([one.longitude_deg for one in seen])
            place = np.column_stack(self._plane.to_plane(latitude, longitude))
            covariance = np.array([one.covariance_m2 for one in seen])
            for watched in self._watched:
                sides = watched.boundary.sides(place)
                z = sides.distance_m / _sigma(covariance, sides.normal)
                ends = _between_ends(watched.boundary, sides, covariance)
                for k, target in enumerate(seen):
                    alerts += self._look(watched, target, float(z[k]), float(ends[k]), now_s)
        for watched in self._watched:
            self._count_stays(watched, {one.id for one in moment.targets}, now_s)
        return replace(moment, boundaries=self.states(), alerts=(*moment.alerts, *alerts))

    def _look(
        self, watched: _Watched, target: TargetState, z: float, ends: float, now_s: float
    ) -> list[Alert]:
        side = watched.sides.get(target.id)
        if side is None:
            side = watched.sides[target.id] = _Side(z, now_s, now_s)
        if (side.z < 0.0) != (z < 0.0):
            share = side.z / (side.z - z)
            side.passed_utc_s = side.time_utc_s + share * (now_s - side.time_utc_s)
            side.between_ends = ends
        side.z, side.time_utc_s = z, now_s
        found: list[Alert] = []

        def tell(kind: AlertKind, time_s: float, direction: str | None = None) -> None:
            found.append(
                Alert(
                    time_utc_s=time_s,
                    kind=kind,
                    boundary=watched.boundary.name,
                    target_id=target.id,
                    probability=float(ndtr(abs(z))) * side.between_ends,
                    direction=direction,
                    speed_mps=target.speed_mps,
                    mmsi=target.mmsi,
                    name=target.name,
                )
            )

        if abs(z) >= _SURE_Z and side.right is not (z > 0.0):
            before, side.right = side.right, z > 0.0
            # What lies still does not cross; what appears has not.
            crossed = before is not None and target.state != "moored"
            if watched.is_zone:
                self._enter_or_leave(watched, side, crossed, now_s, tell)
            elif crossed and side.between_ends > _LIKELIER_THAN_NOT:
                self._cross(watched, side, tell)
        if watched.is_zone and side.right:
            self._limit(target, side, now_s, tell)
        return found

    def _enter_or_leave(
        self,
        watched: _Watched,
        side: _Side,
        crossed: bool,
        now_s: float,
        tell: Callable[..., None],
    ) -> None:
        counts, at_s = watched.counts, side.passed_utc_s if crossed else now_s
        if side.right:
            side.since_utc_s = at_s
            side.told.clear()
            if crossed:
                watched.counts = replace(counts, entries=counts.entries + 1)
                tell("enter", at_s)
        elif side.since_utc_s is not None:
            self._end_stay(watched, side, at_s)
            if crossed:
                watched.counts = replace(counts, exits=counts.exits + 1)
                tell("leave", at_s)

    @staticmethod
    def _cross(watched: _Watched, side: _Side, tell: Callable[..., None]) -> None:
        counts = watched.counts
        if side.right:
            watched.counts = replace(counts, left_to_right=counts.left_to_right + 1)
        else:
            watched.counts = replace(counts, right_to_left=counts.right_to_left + 1)
        tell("cross", side.passed_utc_s, LEFT_TO_RIGHT if side.right else RIGHT_TO_LEFT)

    def _limit(
        self, target: TargetState, side: _Side, now_s: float, tell: Callable[..., None]
    ) -> None:
        """Tell once a stay of one that is too fast, or has stayed too long."""
        speed, sigma = target.speed_mps, target.velocity_sigma_mps
        most = self._limits.speed_mps
        fast = most is not None and speed is not None
        fast = fast and speed - _SURE_SPEED * (sigma or 0.0) > most  # type: ignore[operator]
        longest, since_s = self._limits.dwell_s, side.since_utc_s
        long = longest is not None and since_s is not None and now_s - since_s > longest
        kinds: dict[AlertKind, bool] = {"speed": fast, "dwell": long}
        for kind, is_so in kinds.items():
            if is_so and kind not in side.told:
                side.told.add(kind)
                tell(kind, now_s)

    def _count_stays(self, watched: _Watched, here: set[int], now_s: float) -> None:
        """Forget who has gone, and count who is inside."""
        for number in [one for one in watched.sides if one not in here]:
            side = watched.sides[number]
            if now_s - side.time_utc_s > _FORGOTTEN_S:
                del watched.sides[number]
                if side.right:
                    self._end_stay(watched, side, side.time_utc_s)
        if not watched.is_zone:
            return
        # One that has gone may come back as the same, but is not there meanwhile.
        inside = [side for number, side in watched.sides.items() if side.right and number in here]
        begun = [side.since_utc_s for side in inside if side.since_utc_s is not None]
        watched.counts = replace(
            watched.counts,
            inside=len(inside),
            mean_dwell_s=watched.stayed_s / watched.stays if watched.stays else None,
            longest_dwell_s=now_s - min(begun) if begun else None,
        )

    @staticmethod
    def _end_stay(watched: _Watched, side: _Side, end_s: float) -> None:
        if side.since_utc_s is not None:
            watched.stays += 1
            watched.stayed_s += max(end_s - side.since_utc_s, 0.0)
            side.since_utc_s = None


def _sigma(covariance: FloatArray, direction: FloatArray) -> FloatArray:
    variance = np.einsum("ni,nij,nj->n", direction, covariance, direction)
    return np.asarray(np.sqrt(np.maximum(variance, _LEAST_SIGMA_M**2)))


def _between_ends(
    boundary: LineBoundary | ZoneBoundary, sides: Sides, covariance: FloatArray
) -> FloatArray:
    """(N,) probability that places lie between the ends of a line; 1 at zones."""
    if not np.isfinite(boundary.length_m):
        return np.ones(len(sides.along_m))
    along = np.column_stack([sides.normal[:, 1], -sides.normal[:, 0]])
    sigma = _sigma(covariance, along)
    here = sides.along_m
    return np.asarray(ndtr(here / sigma) - ndtr((here - boundary.length_m) / sigma))


def _key(boundary: LineBoundary | ZoneBoundary) -> tuple[object, ...]:
    if isinstance(boundary, LineBoundary):
        return boundary.name, boundary.corners_m.tobytes()
    return boundary.name, *(ring.tobytes() for rings in boundary.polygons_m for ring in rings)


def _closed(ring: FloatArray) -> FloatArray:
    return ring if (ring[0] == ring[-1]).all() else np.vstack([ring, ring[:1]])


def _between_180(corners: FloatArray) -> list[list[float]]:
    """Corners for a map, which draws one that goes on beyond 180 degrees as it is."""
    longitude = np.degrees(np.unwrap(np.radians(corners[:, 0])))
    return np.column_stack([longitude, corners[:, 1]]).round(8).tolist()  # type: ignore[no-any-return]


def _feature(name: str, kind: str, geometry: str, coordinates: object) -> dict[str, object]:
    return {
        "type": "Feature",
        "properties": {"name": name, "kind": kind},
        "geometry": {"type": geometry, "coordinates": coordinates},
    }
