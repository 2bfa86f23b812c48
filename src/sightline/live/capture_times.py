"""When frames were taken: by the sender's reports where there are any, else by their arrival."""

from __future__ import annotations

import struct
import time
from collections import deque
from typing import NamedTuple

import av
import numpy as np

from sightline.moment import CaptureClock

_REMEMBERED = 25
_STEP_S = 0.5
_STEPPED_FRAMES = 3
_WINDOW_S = 20.0
_LEAST_SENDER_S = 0.002
_LEAST_ARRIVAL_S = 0.01
# What nobody knows of a time of arrival: how long encoder and network took at the least.
_UNKNOWN_DELAY_S = 0.05
_JUMP_S = 2.0
_OTHER_TIME_S = 1.0
_OWN_STEP_S = 0.25


class CaptureTime(NamedTuple):
    """When a frame was taken.

    Attributes:
        utc_s: POSIX seconds; NaN for a frame of which that is not known.
        clock: Whose time it is.
        sigma_s: Standard deviation.
    """

    utc_s: float
    clock: CaptureClock
    sigma_s: float


def sender_utc_s(packet: av.Packet[av.VideoStream]) -> float | None:
    """POSIX seconds at which a packet's picture was taken by its sender; None if it says nothing.

    RTCP sender reports tie the camera's own clock to the times of its packets.
    """
    if not packet.has_sidedata("prft"):
        return None
    for one in packet.iter_sidedata():
        if one.data_type == "prft":
            stamp_us, _flags = struct.unpack_from("<qi", bytes(one))
            return float(stamp_us) * 1e-6
    return None


class CaptureTimes:
    """Capture times of one camera, over connections that come and go.

    Within a connection the presentation times say how far apart frames are, and one offset says
    when. It is the median of what the sender's reports say, or else that of the frame that was the
    quickest to arrive of late: all delays are longer.
    """

    def __init__(self, clock: str = "auto", largest_error_s: float = 30.0) -> None:
        """Begin without a connection.

        Args:
            clock: ``"auto"``, ``"sender"`` or ``"arrival"``.
            largest_error_s: A sender's clock that is further off than that from this machine's is
                not believed, unless it is asked for.
        """
        self._wanted, self._largest_error_s = clock, largest_error_s
        self.sender_off_s: float | None = None
        self._ahead_s: float | None = None
        self._own_s = time.time() - time.monotonic()
        self._step_s = 0.0
        self.connected()

    def connected(self) -> None:
        """Begin a new connection, whose presentation times are others."""
        self._reports: deque[float] = deque(maxlen=_REMEMBERED)
        self._odd: list[float] = []
        self._arrivals: deque[tuple[float, float]] = deque()
        self._anew = True

    def report(self, presented_s: float, utc_s: float, arrived_s: float) -> None:
        """Take what the sender says of a presentation time.

        Args:
            presented_s: The presentation time.
            utc_s: POSIX seconds.
            arrived_s: When it came, by `time.monotonic`.
        """
        self.sender_off_s = utc_s - (arrived_s + self._own_s)
        offset = utc_s - presented_s
        if self._reports and abs(offset - float(np.median(self._reports))) > _STEP_S:
            self._odd.append(offset)
            if len(self._odd) < _STEPPED_FRAMES:
                return
            # Not one odd report: the clock of the camera was set.
            self._reports.clear()
            self._reports.extend(self._odd)
            self._anew = True
        else:
            self._reports.append(offset)
        self._odd = []

    @property
    def believed(self) -> bool:
        """Whether the sender's clock is gone by."""
        if self._wanted == "arrival" or not self._reports:
            return False
        return self._wanted == "sender" or abs(self.sender_off_s or 0.0) <= self._largest_error_s

    def of(self, presented_s: float | None, arrived_s: float) -> CaptureTime:
        """Capture time of a frame.

        Args:
            presented_s: Its presentation time, where it has one.
            arrived_s: When it came, by `time.monotonic`.
        """
        self._look_at_own_clock()
        found = self._of(presented_s, arrived_s)
        if self._odd:
            return CaptureTime(float("nan"), found.clock, found.sigma_s)
        ahead_s = found.utc_s - arrived_s
        if (
            self._anew
            and self._ahead_s is not None
            and abs(ahead_s - self._ahead_s) > _OTHER_TIME_S
        ):
            self._step_s += ahead_s - self._ahead_s
        self._anew, self._ahead_s = False, ahead_s
        return found

    def step_s(self) -> float:
        """By how much the clock was set since this was asked last; 0 where it was not."""
        step_s, self._step_s = self._step_s, 0.0
        return step_s

    def _look_at_own_clock(self) -> None:
        own_s = time.time() - time.monotonic()
        if abs(own_s - self._own_s) > _OWN_STEP_S:
            self._arrivals.clear()
            self._anew = True
        self._own_s = own_s

    def _of(self, presented_s: float | None, arrived_s: float) -> CaptureTime:
        arrived_utc_s = arrived_s + self._own_s
        if presented_s is None:
            return CaptureTime(arrived_utc_s, "arrival", 2.0 * _UNKNOWN_DELAY_S)
        delay_s = arrived_utc_s - presented_s
        if self._arrivals and abs(delay_s - self._arrivals[-1][1]) > _JUMP_S:
            # Presentation times that begin anew, or a stream that stood still.
            self._arrivals.clear()
        self._arrivals.append((arrived_s, delay_s))
        while self._arrivals[0][0] < arrived_s - _WINDOW_S:
            self._arrivals.popleft()
        clock: CaptureClock = "sender" if self.believed else "arrival"
        if clock == "sender":
            offset = float(np.median(self._reports))
            spread = float(np.median(np.abs(np.array(self._reports) - offset)))
            return CaptureTime(presented_s + offset, "sender", max(1.5 * spread, _LEAST_SENDER_S))
        delays = np.array([delay for _, delay in self._arrivals])
        least = float(delays.min())
        spread = max(float(np.median(delays)) - least, _LEAST_ARRIVAL_S)
        return CaptureTime(
            presented_s + least, "arrival", float(np.hypot(spread, _UNKNOWN_DELAY_S))
        )
