"""Moments for the tests of feeds and of the page."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from sightline.moment import TargetState

# 1 June 2024, 10:00:00 UTC by `date -u -d 2024-06-01T10:00:00Z +%s`.
START = 1_717_236_000.0


def target(number: int = 17, **values) -> TargetState:
    return TargetState(
        **{
            "id": number,
            "latitude_deg": 54.3233,
            "longitude_deg": 10.1394,
            "covariance_m2": np.array([[4.0, 1.0], [1.0, 9.0]]),
            "speed_mps": 3.1,
            "course_deg": 210.5,
            "state": "measured",
            **values,
        }
    )


def until(true: Callable[[], bool], within_s: float = 10.0) -> None:
    """Wait for what another thread does; the bound only ends a test that has failed."""
    deadline = time.monotonic() + within_s
    while not true():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.01)
