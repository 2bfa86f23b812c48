"""A moment: all targets of a camera at one capture time, as live publishes it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol

import numpy as np

from sightline.types import FloatArray, to_datetime64

State = Literal["measured", "predicted", "moored"]
"""Whether a box placed a target in this frame, its past did, or it lies still."""

CaptureClock = Literal["sender", "arrival"]
"""Whose clock a capture time is: the camera's sender reports, or this machine's on arrival."""

AlertKind = Literal["cross", "enter", "leave", "speed", "dwell"]
"""What a target did: crossed a line, entered or left a zone, was too fast or too long in it."""

Identity = Literal["identified", "unidentified"]
"""Whether a target is a vessel that AIS tells of, or none of those: a dark one."""


@dataclass(frozen=True, eq=False)
class TargetState:
    """State of a target at a moment.

    Attributes:
        id: Number of the target; none is used twice, not even after a restart.
        latitude_deg: Degrees, WGS 84.
        longitude_deg: Degrees, WGS 84.
        covariance_m2: (2, 2) covariance of the position, east and north, m².
        speed_mps: Speed over ground, m/s; None while unknown.
        course_deg: Course over ground, degrees from true north; None while unknown.
        state: How it is known.
        box_xyxy_px: Its box in this frame; None without one.
        confidence: Of that box, 0 to 1; None without one.
        mmsi: Of the AIS vessel that it is; None: unidentified.
        name: Of that vessel: text from outside, never markup.
        match: Probability that it is that vessel; None without one.
        velocity_sigma_mps: Standard deviation of the velocity, m/s along each axis; None while
            unknown.
        identity: What AIS says of it; None where there is no AIS, or while it is undecided.
        label: Its class, as the detector calls it; empty where it tells none.
    """

    id: int
    latitude_deg: float
    longitude_deg: float
    covariance_m2: FloatArray
    speed_mps: float | None
    course_deg: float | None
    state: State
    box_xyxy_px: tuple[float, float, float, float] | None = None
    confidence: float | None = None
    mmsi: int | None = None
    name: str | None = None
    match: float | None = None
    velocity_sigma_mps: float | None = None
    identity: Identity | None = None
    label: str = ""

    def to_message(self) -> dict[str, object]:
        """The target as the message of a moment has it."""
        covariance = np.asarray(self.covariance_m2, dtype=float)
        box = None if self.box_xyxy_px is None else [round(x, 1) for x in self.box_xyxy_px]
        told: dict[str, object] = {"identity": self.identity, "label": self.label}
        told = {key: value for key, value in told.items() if value}
        return {
            "id": self.id,
            "latitude_deg": round(self.latitude_deg, 7),
            "longitude_deg": round(self.longitude_deg, 7),
            "covariance_m2": [[round(float(x), 4) for x in row] for row in covariance],
            "speed_mps": _rounded(self.speed_mps, 3),
            "course_deg": _rounded(self.course_deg, 1),
            "state": self.state,
            "box_xyxy_px": box,
            "confidence": _rounded(self.confidence, 3),
            "mmsi": self.mmsi,
            "name": self.name,
            "match": _rounded(self.match, 3),
            **told,
        }


@dataclass(frozen=True)
class Alert:
    """What a target has done at a line or in a zone.

    Attributes:
        time_utc_s: When it is taken to have, POSIX seconds.
        kind: What it did.
        boundary: Name of the line or zone.
        target_id: Number of the target.
        probability: That it did.
        direction: Across a line, ``left to right`` or ``right to left``; else None.
        speed_mps: Of the target then, m/s; None while unknown.
        mmsi: Of the vessel that it is, where that is known.
        name: Of that vessel: text from outside, never markup.
    """

    time_utc_s: float
    kind: AlertKind
    boundary: str
    target_id: int
    probability: float = 1.0
    direction: str | None = None
    speed_mps: float | None = None
    mmsi: int | None = None
    name: str | None = None

    def to_message(self) -> dict[str, object]:
        """The alert as messages have it."""
        return {
            "time_utc": _time(self.time_utc_s),
            "kind": self.kind,
            "boundary": self.boundary,
            "target_id": self.target_id,
            "probability": round(self.probability, 3),
            "direction": self.direction,
            "speed_mps": _rounded(self.speed_mps, 3),
            "mmsi": self.mmsi,
            "name": self.name,
        }


@dataclass(frozen=True)
class BoundaryState:
    """What has happened at a line or in a zone since it is watched.

    Attributes:
        name: As its file names it.
        kind: ``line`` or ``zone``.
        left_to_right: Crossings of a line, seen from its first corner to its last.
        right_to_left: Likewise.
        inside: How many targets are in a zone now.
        entries: How many have come into it.
        exits: How many have left it.
        mean_dwell_s: How long those stayed that are in it no more; None before the first.
        longest_dwell_s: How long one has been in it that is in it now; None without one.
    """

    name: str
    kind: Literal["line", "zone"]
    left_to_right: int = 0
    right_to_left: int = 0
    inside: int = 0
    entries: int = 0
    exits: int = 0
    mean_dwell_s: float | None = None
    longest_dwell_s: float | None = None

    def to_message(self) -> dict[str, object]:
        """The line or zone as messages have it."""
        told: dict[str, object] = {"name": self.name, "kind": self.kind}
        if self.kind == "line":
            return told | {
                "left_to_right": self.left_to_right,
                "right_to_left": self.right_to_left,
            }
        return told | {
            "inside": self.inside,
            "entries": self.entries,
            "exits": self.exits,
            "mean_dwell_s": _rounded(self.mean_dwell_s, 1),
            "longest_dwell_s": _rounded(self.longest_dwell_s, 1),
        }


@dataclass(frozen=True)
class UnseenVessel:
    """A vessel that AIS places in view of the camera, and that no target is.

    Attributes:
        mmsi: Of the vessel.
        name: Its name: text from outside, never markup; None while it has told none.
        latitude_deg: Degrees, WGS 84, at the time of the moment.
        longitude_deg: Degrees, WGS 84.
        sigma_m: Standard deviation of that along either axis.
        unseen_s: For how long it has been in view without a target.
    """

    mmsi: int
    name: str | None
    latitude_deg: float
    longitude_deg: float
    sigma_m: float
    unseen_s: float

    def to_message(self) -> dict[str, object]:
        """The vessel as the message of a moment has it."""
        return {
            "mmsi": self.mmsi,
            "name": self.name,
            "latitude_deg": round(self.latitude_deg, 7),
            "longitude_deg": round(self.longitude_deg, 7),
            "sigma_m": round(self.sigma_m, 1),
            "unseen_s": round(self.unseen_s, 1),
        }


@dataclass(frozen=True, eq=False)
class Moment:
    """All targets of a camera at one capture time.

    Attributes:
        time_utc_s: Capture time of the frame, seconds since the epoch.
        capture: Whose clock that is.
        camera: Name of the camera.
        targets: Its targets, by number.
        frame_size_px: Width and height of the frame, px; None where there was none.
        capture_sigma_s: Standard deviation of the capture time, seconds; None while unknown.
        unseen: Vessels in view that no target is; None where there is no AIS.
        boundaries: What has happened at lines and in zones; None where there are none.
        alerts: What targets have done at these since the moment before.
    """

    time_utc_s: float
    capture: CaptureClock
    camera: str
    targets: tuple[TargetState, ...]
    frame_size_px: tuple[int, int] | None = None
    capture_sigma_s: float | None = None
    unseen: tuple[UnseenVessel, ...] | None = None
    boundaries: tuple[BoundaryState, ...] | None = None
    alerts: tuple[Alert, ...] = ()

    def to_message(self) -> dict[str, object]:
        """The message of the moment, ready for JSON."""
        told: dict[str, object] = {}
        if self.unseen is not None:
            told["vessels_without_target"] = [vessel.to_message() for vessel in self.unseen]
        if self.boundaries is not None:
            told["boundaries"] = [boundary.to_message() for boundary in self.boundaries]
            told["alerts"] = [alert.to_message() for alert in self.alerts]
        return {
            "time_utc": _time(self.time_utc_s),
            "capture": self.capture,
            "camera": self.camera,
            "targets": [target.to_message() for target in self.targets],
            **told,
        }

    @cached_property
    def text(self) -> str:
        """The message as JSON, written once however many receive it."""
        return json.dumps(self.to_message(), allow_nan=False, separators=(",", ":"))


class Feed(Protocol):
    """What publishes moments; `publish` returns at once and never raises for a dead receiver."""

    def publish(self, moment: Moment) -> None:
        """Hand a moment over; one that cannot keep up loses the oldest and counts them."""

    def close(self) -> None:
        """Send what is left, for at most a second, and let go of sockets and threads."""


def _time(time_utc_s: float) -> str:
    # Rounded, where the conversion to text cuts off.
    return f"{np.datetime_as_string(to_datetime64(time_utc_s + 0.0005), 'ms')}Z"


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(float(value), digits)
