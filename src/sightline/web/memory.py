"""What was published lately, as GeoJSON: a bounded memory, for trails and for QGIS."""

from __future__ import annotations

import json
import math
import struct
import threading
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sightline.moment import Moment, TargetState
from sightline.text import encodable_text
from sightline.types import ellipses, to_datetime64

_POINTS = 300_000
_NAMES = 20_000
_EVERY_S = 2.0
# One that lies still says nothing new.
_MOORED_EVERY_S = 30.0
# Number, time, latitude, longitude: a point takes 32 bytes, where a tuple would take 200.
_POINT = struct.Struct("<qddd")

_Point = tuple[float, float, float]


@dataclass
class _Known:
    """What is known of a target: its newest state, and when that and its last point were."""

    state: TargetState
    time_utc_s: float
    kept_utc_s: float


class TrackMemory:
    """The places of targets of the last minutes, as many as fit.

    Args:
        points: The most that are kept; the oldest are forgotten.
    """

    def __init__(self, points: int = _POINTS) -> None:
        self._points: deque[bytes] = deque(maxlen=points)
        self._known: OrderedDict[int, _Known] = OrderedDict()
        self._newest_utc_s = -math.inf
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._points)

    def add(self, moment: Moment) -> None:
        """Remember a moment: a point every two seconds a target, fewer where it lies still."""
        time = moment.time_utc_s
        with self._lock:
            self._newest_utc_s = time
            for target in moment.targets:
                if not (math.isfinite(target.latitude_deg) and math.isfinite(target.longitude_deg)):
                    continue
                known = self._known.get(target.id)
                every_s = _MOORED_EVERY_S if target.state == "moored" else _EVERY_S
                # A clock that was set back is no reason to keep nothing until it is there again.
                kept = known is not None and 0.0 <= time - known.kept_utc_s < every_s
                if known is not None and kept:
                    known.state, known.time_utc_s = target, time
                    continue
                self._known[target.id] = _Known(target, time, time)
                self._known.move_to_end(target.id)
                self._points.append(
                    _POINT.pack(target.id, time, target.latitude_deg, target.longitude_deg)
                )
            while len(self._known) > _NAMES:
                self._known.popitem(last=False)

    def geojson(self, minutes: float) -> str:
        """Tracks of the last minutes (RFC 7946), a feature a target with its newest state.

        Args:
            minutes: Before the newest moment.
        """
        with self._lock:
            packed = b"".join(self._points)
            known = {number: (one.state, one.time_utc_s) for number, one in self._known.items()}
            since = self._newest_utc_s - 60.0 * minutes
        lines: dict[int, list[_Point]] = {}
        for number, time, latitude, longitude in _POINT.iter_unpack(packed):
            if time >= since:
                lines.setdefault(number, []).append((time, latitude, longitude))
        features = []
        for number, (state, time) in known.items():
            if time < since:
                continue
            line = lines.get(number, [])
            if not line or line[-1][0] < time:
                line.append((time, state.latitude_deg, state.longitude_deg))
            features.append(_feature(state, line))
        return json.dumps(
            {"type": "FeatureCollection", "features": features},
            allow_nan=False,
            separators=(",", ":"),
        )


def _feature(target: TargetState, line: Sequence[_Point]) -> dict[str, object]:
    shape = ellipses(np.asarray(target.covariance_m2, dtype=float)[None])
    times = [_time(time) for time, _, _ in line]
    return {
        "type": "Feature",
        "id": target.id,
        "geometry": _geometry([(longitude, latitude) for _, latitude, longitude in line]),
        "properties": {
            "id": target.id,
            "name": None if target.name is None else encodable_text(target.name),
            "mmsi": target.mmsi,
            "match": target.match,
            "state": target.state,
            "time": times[-1],
            "speed_mps": _number(target.speed_mps),
            "course_deg": _number(target.course_deg),
            "semi_major_m": _number(float(shape.semi_major_m[0])),
            "semi_minor_m": _number(float(shape.semi_minor_m[0])),
            "ellipse_bearing_deg": _number(float(shape.bearing_deg[0])),
            "coordTimes": times,
        },
    }


def _geometry(line: Sequence[tuple[float, float]]) -> dict[str, object]:
    """A line, cut where it crosses the antimeridian (section 3.1.9), or a point where it is one."""
    if len(line) == 1:
        return {"type": "Point", "coordinates": _rounded(line)[0]}
    parts = [[line[0]]]
    for (west, south), (east, north) in pairwise(line):
        if abs(east - west) > 180.0:
            edge = math.copysign(180.0, west)
            beyond = east + math.copysign(360.0, west)
            share = (edge - west) / (beyond - west)
            latitude = south + share * (north - south)
            parts[-1].append((edge, latitude))
            parts.append([(-edge, latitude)])
        parts[-1].append((east, north))
    if len(parts) == 1:
        return {"type": "LineString", "coordinates": _rounded(parts[0])}
    return {"type": "MultiLineString", "coordinates": [_rounded(part) for part in parts]}


def _rounded(line: Sequence[tuple[float, float]]) -> list[list[float]]:
    return [[round(longitude, 7), round(latitude, 7)] for longitude, latitude in line]


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, 3)


def _time(time_utc_s: float) -> str:
    return f"{np.datetime_as_string(to_datetime64(time_utc_s + 0.0005), 'ms')}Z"
