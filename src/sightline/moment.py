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

    def to_message(self) -> dict[str, object]:
        """The target as the message of a moment has it."""
        covariance = np.asarray(self.covariance_m2, dtype=float)
        box = None if self.box_xyxy_px is None else [round(x, 1) for x in self.box_xyxy_px]
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
    """

    time_utc_s: float
    capture: CaptureClock
    camera: str
    targets: tuple[TargetState, ...]
    frame_size_px: tuple[int, int] | None = None
    capture_sigma_s: float | None = None

    def to_message(self) -> dict[str, object]:
        """The message of the moment, ready for JSON."""
        # Rounded, where the conversion to text cuts off.
        time = to_datetime64(self.time_utc_s + 0.0005)
        return {
            "time_utc": f"{np.datetime_as_string(time, 'ms')}Z",
            "capture": self.capture,
            "camera": self.camera,
            "targets": [target.to_message() for target in self.targets],
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


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(float(value), digits)
