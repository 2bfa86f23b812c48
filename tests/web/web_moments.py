"""Moments for the tests of the page."""

from __future__ import annotations

import functools
import math

import numpy as np

import moments
from moments import START, target
from sightline.geodesy import LocalPlane
from sightline.moment import Moment, TargetState

PLANE = LocalPlane(54.3233, 10.1394)
HOSTILE = '</script><img src="/owned" onerror="document.title=\'owned\'">&lt;b&gt;\u202e'
SIZE_PX = (1280, 720)


def moment(time_s: float = 0.0, *targets: TargetState, camera: str = "dock") -> Moment:
    return Moment(START + time_s, "sender", camera, targets or (target(),), SIZE_PX)


# A browser takes longer than a socket.
until = functools.partial(moments.until, within_s=20.0)

NAMES = ("ANNA KATHARINA", "LOTSE 4", None, None, "FÄHRE SCHWENTINE", None, "GORCH FOCK", None)


def harbour(time_s: float, count: int = 8) -> Moment:
    """Boats that go round in a harbour north of the camera, and some that lie still."""
    targets = []
    for i in range(count):
        moored = i % 4 == 3
        turn = 0.7 * i + (0.0 if moored else 0.012 * (1 + i % 3) * time_s)
        radius = 60.0 + 12.0 * (i % 20)
        east = (i % 5 - 2) * 60.0 + radius * math.sin(turn)
        north = 260.0 + 40.0 * (i % 4) + 0.5 * radius * math.cos(turn)
        range_m = math.hypot(east, north)
        # Along the line of sight a camera is less sure, and the more so the further away.
        along, across = (range_m**2 / 9000.0) ** 2, (range_m / 300.0) ** 2
        sight = np.array([east, north]) / range_m
        covariance = across * np.eye(2) + (along - across) * np.outer(sight, sight)
        latitude, longitude = PLANE.to_geographic(east, north)
        speed = 0.0 if moored else 0.012 * (1 + i % 3) * radius
        x, y = 640.0 + 600.0 * east / range_m, 300.0 + 40_000.0 / range_m
        predicted = i % 7 == 5
        name = NAMES[i % len(NAMES)]
        targets.append(
            TargetState(
                id=100 + i,
                latitude_deg=float(latitude),
                longitude_deg=float(longitude),
                covariance_m2=covariance,
                speed_mps=speed,
                course_deg=math.degrees(math.atan2(math.cos(turn), -0.5 * math.sin(turn))) % 360.0,
                state="moored" if moored else "predicted" if predicted else "measured",
                box_xyxy_px=None if predicted else (x - 40.0, y - 45.0, x + 40.0, y),
                confidence=None if predicted else 0.9,
                mmsi=None if name is None else 211_000_000 + i,
                name=name,
                match=None if name is None else 0.97,
            )
        )
    return Moment(START + time_s, "sender", "harbour-office", tuple(targets), SIZE_PX)
