"""Traffic before a camera, light enough for many seeds: boxes with ids, clutter, and an AIS feed.

    traffic = Traffic.random(seed=3)
    boxes = traffic.boxes()             # of everything seen: vessels, some without AIS, clutter
    reports = traffic.reports()         # by MMSI: what a receiver logged of all vessels
    paths = traffic.paths()             # by MMSI: the same as paths, for `sightline.association`
    traffic.in_view                     # the MMSI of the vessels that were seen
    traffic.owner(boxes)                # whose each box is

No pictures are made; for those see `sightline.simulation.Harbour`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from sightline.geodesy import LocalPlane
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.simulation.camera import SimulatedCamera
from sightline.types import NO_TRACK, BoolArray, Boxes, Fixes, FloatArray, IntArray

_START_UTC_S = 1_717_236_000.0
_PLANE = LocalPlane(54.3233, 10.1394)
_KNOT_MPS = 1852.0 / 3600.0
_WAYPOINT_S = 45.0
_NOBODY = 0


@dataclass(frozen=True, eq=False)
class TrafficVessel:
    """One vessel.

    Attributes:
        mmsi: Its number; those that send nothing have one too.
        path: East and north, metres, over seconds since the start.
        length_m: Of the hull.
        beam_m: Of the hull.
        height_m: Above the water.
        class_a: Whether it reports often.
        sends: Whether it has AIS.
    """

    mmsi: int
    path: CubicSpline
    length_m: float
    beam_m: float
    height_m: float
    class_a: bool
    sends: bool


@dataclass(frozen=True, eq=False)
class VesselReports:
    """What a receiver logged of one vessel, in the order of time.

    Attributes:
        time_utc_s: (N,) float64, by the receiver's clock.
        latitude_deg: (N,) float64.
        longitude_deg: (N,) float64.
        speed_mps: (N,) float64, over ground.
        course_deg: (N,) float64, over ground.
        class_a: Whether the reports are of class A.
    """

    time_utc_s: FloatArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    speed_mps: FloatArray
    course_deg: FloatArray
    class_a: bool

    @property
    def velocity_mps(self) -> FloatArray:
        """(N, 2) float64, east and north, over ground."""
        course = np.radians(self.course_deg)
        toward = np.stack([np.sin(course), np.cos(course)], axis=1)
        return np.asarray(self.speed_mps[:, None] * toward)


@dataclass(frozen=True, eq=False)
class Traffic:
    """A world of vessels before a camera.

    Attributes:
        camera: The true one.
        plane: Its origin is the camera.
        vessels: All of them.
        in_view: MMSI of those with AIS that were seen.
        duration_s: Of the recording.
        offset_s: What is to be added to the camera's times to agree with the feed's.
        seed: Of the noise.
    """

    camera: SimulatedCamera
    plane: LocalPlane
    vessels: tuple[TrafficVessel, ...]
    in_view: tuple[int, ...]
    duration_s: float
    offset_s: float
    seed: int

    @classmethod
    def random(
        cls,
        seed: int,
        *,
        vessels: int = 50,
        seen: int = 5,
        unlogged: int = 2,
        duration_s: float = 600.0,
        offset_s: float = -37.0,
    ) -> Traffic:
        """A world from a seed.

        Args:
            seed: Of the camera and all paths.
            vessels: With AIS.
            seen: How many of them pass before the camera; the others are elsewhere: behind it,
                beside its picture, or too far to be seen.
            unlogged: Vessels without AIS that pass before the camera.
            duration_s: Of the recording.
            offset_s: Of the clocks.
        """
        rng = np.random.default_rng(seed)
        camera = SimulatedCamera.random(rng)
        half_deg = np.degrees(np.arctan(0.5 * camera.image_size_px[0] / camera.focal_length_px))
        made = []
        for i in range(seen + unlogged):
            path = _passing(rng, camera.heading_deg, half_deg, duration_s)
            made.append(_vessel(rng, 211_000_001 + i, path, sends=i < seen))
        for i in range(vessels - seen):
            path = _elsewhere(rng, camera.heading_deg, half_deg, duration_s)
            made.append(_vessel(rng, 211_000_101 + i, path, sends=True))
        return cls(
            camera=camera,
            plane=_PLANE,
            vessels=tuple(made),
            in_view=tuple(one.mmsi for one in made[:seen]),
            duration_s=duration_s,
            offset_s=offset_s,
            seed=seed,
        )

    def boxes(self, rate_hz: float = 2.0, *, clutter: float = 1.5, noise_px: float = 1.5) -> Boxes:
        """The boxes of everything, with the ragged track ids of an image tracker.

        Args:
            rate_hz: Of the pictures.
            clutter: Boxes of nothing a picture, most of them where there were some before.
            noise_px: Standard deviation of every edge; half of it lasts for seconds.
        """
        return self._seen(rate_hz, clutter, noise_px)[0]

    def owner(
        self, rate_hz: float = 2.0, *, clutter: float = 1.5, noise_px: float = 1.5
    ) -> IntArray:
        """(N,) the MMSI of each of `boxes` of the same arguments; 0 for clutter."""
        return self._seen(rate_hz, clutter, noise_px)[1]

    def reports(self, *, missing: float = 0.2, noise_m: float = 2.5) -> Mapping[int, VesselReports]:
        """What a receiver logged, by MMSI.

        Args:
            missing: Share of the reports that were not received.
            noise_m: Of the positions, slowly changing, metres in east and in north.
        """
        rng = np.random.default_rng([self.seed, 2])
        out = {}
        for one in self.vessels:
            times = self._report_times(one, rng)
            times = times[rng.uniform(size=times.size) >= missing]
            if not one.sends or times.size < 2:
                continue
            error = np.stack([_slow(rng, times, 60.0) for _ in range(2)], axis=1) * noise_m
            place = one.path(times) + error
            velocity = one.path(times, 1) + rng.normal(0.0, 0.08, (times.size, 2))
            latitude, longitude = self.plane.to_geographic(place[:, 0], place[:, 1])
            speed = np.hypot(velocity[:, 0], velocity[:, 1])
            course = np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1])) % 360.0
            out[one.mmsi] = VesselReports(
                time_utc_s=np.round(_START_UTC_S + self.offset_s + times),
                latitude_deg=np.round(latitude * 600000.0) / 600000.0,
                longitude_deg=np.round(longitude * 600000.0) / 600000.0,
                speed_mps=np.round(speed / _KNOT_MPS, 1) * _KNOT_MPS,
                course_deg=np.round(course, 1) % 360.0,
                class_a=one.class_a,
            )
        return out

    def paths(self) -> dict[int, ReferenceTrajectory]:
        """The reports as paths in the plane, by MMSI."""
        out = {}
        for mmsi, log in self.reports().items():
            fixes = Fixes(log.time_utc_s, log.latitude_deg, log.longitude_deg, name=str(mmsi))
            out[mmsi] = ReferenceTrajectory.of(fixes, self.plane, log.velocity_mps)
        return out

    def _report_times(self, one: TrafficVessel, rng: np.random.Generator) -> FloatArray:
        """When a vessel reports: on whole seconds of the feed's clock, before and after as well."""
        out, time = [], -180.0 + rng.uniform(0.0, 30.0)
        while time < self.duration_s + 180.0:
            out.append(np.round(time))
            fast = float(np.hypot(*one.path(time, 1))) > 14.0 * _KNOT_MPS
            interval = (6.0 if fast else 10.0) if one.class_a else 30.0
            time += interval * rng.uniform(0.9, 1.1)
        return np.unique(out)

    def _seen(self, rate_hz: float, clutter: float, noise_px: float) -> tuple[Boxes, IntArray]:
        rng = np.random.default_rng([self.seed, 1])
        times = np.arange(0.0, self.duration_s, 1.0 / rate_hz)
        width, height = self.camera.image_size_px
        rows: list[FloatArray] = []
        next_id = 1
        for one in self.vessels:
            box, seen = self._box(one, times)
            for edge in range(4):
                box[:, edge] += noise_px * np.sqrt(0.5) * rng.normal(size=times.size)
                box[:, edge] += noise_px * np.sqrt(0.5) * _slow(rng, times, 2.0)
            seen &= rng.uniform(size=times.size) > 0.08
            seen &= (box[:, 2] - box[:, 0] > 4.0) & (box[:, 3] - box[:, 1] > 3.0)
            # An image tracker loses its target now and then, and finds it under another number.
            cut = rng.uniform(size=times.size) < 1.0 / (40.0 * rate_hz)
            number = next_id + np.cumsum(cut)
            next_id = int(number[-1]) + 1
            rows.append(np.column_stack([times, number, np.full(times.size, one.mmsi), box])[seen])
        horizon = 0.5 * height + self.camera.focal_length_px * np.tan(
            np.radians(-self.camera.pitch_deg)
        )
        spots = np.column_stack(
            [rng.uniform(0.0, width, 6), rng.uniform(horizon + 5.0, 0.95 * height, 6)]
        )
        for time in times:
            for _ in range(rng.poisson(clutter)):
                size = rng.uniform(6.0, 40.0, 2) * (1.0, 0.6)
                spot = rng.integers(0, 8)
                if spot < 6:
                    foot, own = spots[spot] + rng.normal(0.0, 5.0, 2), 1_000_000 + int(spot)
                else:
                    foot = np.array([rng.uniform(0.0, width), rng.uniform(horizon + 5.0, height)])
                    own = NO_TRACK
                left, right = foot[0] - size[0] / 2, foot[0] + size[0] / 2
                rows.append(
                    np.array([[time, own, _NOBODY, left, foot[1] - size[1], right, foot[1]]])
                )
        table = np.concatenate(rows)
        table = table[np.argsort(table[:, 0], kind="stable")]
        box = table[:, 3:].copy()
        box[:, 0::2] = np.clip(box[:, 0::2], 0.0, width)
        box[:, 1::2] = np.clip(box[:, 1::2], 0.0, height)
        whole = (box[:, 2] - box[:, 0] > 2.0) & (box[:, 3] - box[:, 1] > 2.0)
        table, box = table[whole], box[whole]
        return (
            Boxes.of(
                box,
                frame=np.round(table[:, 0] * rate_hz).astype(np.int64),
                time_utc_s=_START_UTC_S + table[:, 0],
                track_id=table[:, 1].astype(np.int64),
                source="detector",
            ),
            table[:, 2].astype(np.int64),
        )

    def _box(self, one: TrafficVessel, times: FloatArray) -> tuple[FloatArray, BoolArray]:
        """(N, 4) the box of a vessel's hull, and (N,) whether it can be seen."""
        place, velocity = one.path(times), one.path(times, 1)
        ahead = velocity / np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), 1e-6)[:, None]
        side = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        distance = np.hypot(place[:, 0], place[:, 1])
        bearing = np.degrees(np.arctan2(place[:, 0], place[:, 1])) - self.camera.heading_deg
        before = np.cos(np.radians(bearing)) > 0.2
        corners = [
            np.column_stack(
                [
                    place + along * one.length_m * ahead + across * one.beam_m * side,
                    np.full(times.size, up),
                ]
            )
            for along in (-0.5, 0.5)
            for across in (-0.5, 0.5)
            for up in (0.0, one.height_m)
        ]
        pixel = np.stack([self.camera.project(corner) for corner in corners])
        box = np.full((times.size, 4), np.nan)
        known = before & np.isfinite(pixel).all(axis=(0, 2))
        box[known, :2] = pixel[:, known].min(axis=0)
        box[known, 2:] = pixel[:, known].max(axis=0)
        width, height = self.camera.image_size_px
        middle = 0.5 * (box[:, 0] + box[:, 2])
        with np.errstate(invalid="ignore"):
            inside = (middle > 0.0) & (middle < width) & (box[:, 3] > 0.0) & (box[:, 3] < height)
        return np.nan_to_num(box), known & inside & (distance < 2500.0) & (distance > 20.0)


def _vessel(
    rng: np.random.Generator, mmsi: int, path: CubicSpline, *, sends: bool
) -> TrafficVessel:
    length = float(rng.uniform(7.0, 35.0))
    return TrafficVessel(
        mmsi=mmsi,
        path=path,
        length_m=length,
        beam_m=0.28 * length,
        height_m=float(rng.uniform(0.15, 0.3) * length + 1.0),
        class_a=bool(rng.uniform() < 0.6),
        sends=sends,
    )


def _slow(rng: np.random.Generator, times: FloatArray, duration_s: float) -> FloatArray:
    """(N,) noise of unit variance whose errors decay with time (Ornstein-Uhlenbeck)."""
    out = np.empty(times.size)
    value = rng.normal()
    last = times[0] if times.size else 0.0
    for i, time in enumerate(times):
        kept = np.exp(-(time - last) / duration_s)
        value = kept * value + np.sqrt(1.0 - kept**2) * rng.normal()
        out[i], last = value, time
    return out


def _passing(
    rng: np.random.Generator, heading_deg: float, half_deg: float, duration_s: float
) -> CubicSpline:
    """A vessel that crosses the picture at some time, more or less straight on."""
    crossing_s = rng.uniform(0.15, 0.85) * duration_s
    bearing = np.radians(heading_deg + rng.uniform(-0.6, 0.6) * half_deg)
    distance = float(np.exp(rng.uniform(np.log(70.0), np.log(700.0))))
    at = distance * np.array([np.sin(bearing), np.cos(bearing)])
    speed = rng.uniform(2.0, 8.0)
    side = rng.choice([-1.0, 1.0])
    course = bearing + side * np.radians(rng.uniform(50.0, 130.0))
    return _wandering(rng, at, crossing_s, course, speed, duration_s)


def _elsewhere(
    rng: np.random.Generator, heading_deg: float, half_deg: float, duration_s: float
) -> CubicSpline:
    """A vessel that the camera never sees."""
    while True:
        far = rng.uniform() < 0.3
        away = rng.uniform(-180.0, 180.0)
        distance = rng.uniform(4500.0, 9000.0) if far else rng.uniform(150.0, 3000.0)
        bearing = np.radians(heading_deg + away)
        at = distance * np.array([np.sin(bearing), np.cos(bearing)])
        path = _wandering(
            rng,
            at,
            0.5 * duration_s,
            rng.uniform(0.0, 2.0 * np.pi),
            rng.uniform(0.5, 8.0),
            duration_s,
        )
        place = path(np.arange(-60.0, duration_s + 60.0, 5.0))
        off = np.degrees(np.arctan2(place[:, 0], place[:, 1])) - heading_deg
        off = np.abs((off + 180.0) % 360.0 - 180.0)
        near = np.hypot(place[:, 0], place[:, 1]) < 4000.0
        if not (near & (off < half_deg + 15.0)).any():
            return path


def _wandering(
    rng: np.random.Generator,
    at: FloatArray,
    when_s: float,
    course: float,
    speed: float,
    duration_s: float,
) -> CubicSpline:
    """A path through a place at a time, whose course and speed wander."""
    times = np.arange(-300.0, duration_s + 300.0 + _WAYPOINT_S, _WAYPOINT_S)
    turns = np.cumsum(rng.normal(0.0, np.radians(9.0), times.size))
    turns -= np.interp(when_s, times, turns)
    speeds = speed * np.exp(np.clip(np.cumsum(rng.normal(0.0, 0.06, times.size)), -0.5, 0.5))
    courses = course + turns
    step = np.stack([np.sin(courses), np.cos(courses)], axis=1) * (speeds * _WAYPOINT_S)[:, None]
    path = np.cumsum(step, axis=0)
    spline = CubicSpline(times, path)
    return CubicSpline(times, path - spline(when_s) + at)
