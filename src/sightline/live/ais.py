r"""AIS beside a camera: which of the targets are which vessels, and how sure that is.

Where a vessel is at the time of a frame follows from its last report and its velocity. That a
target is that vessel gains or loses by

.. math:: \log N(z_t - z_v; 0, P_t + P_v) - \log \rho

at each look, with :math:`\rho` the density of targets that are not it, as anywhere in view. Errors
of boxes and of reports last, so looks are seconds apart, and what was long ago counts for less.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from sightline.addresses import Address
from sightline.errors import InputError
from sightline.formats import AisReport, AisStream
from sightline.geodesy import LocalPlane
from sightline.live.ais_check import AisCheck, ModelCheck
from sightline.live.view import View
from sightline.moment import Moment, TargetState, UnseenVessel
from sightline.tally import Tally
from sightline.types import FloatArray

_LOOKS_APART_S = 2.0
_MEMORY_S = 40.0
_OLD_S = 200.0
_FORGOTTEN_S = 600.0
# Antenna and waterline differ by a part of the hull, and reports are rounded to a second.
_PLACE_M = 10.0
_LATE_S = 1.0
_ACCELERATION_MPS2 = 0.05
_STILL_MPS, _ADRIFT_MPS = 0.3, 0.1
_DENSITY_PER_M2 = 1.0 / 300.0**2
_BEST_LOG = 12.0
_WORST_LOG = -30.0
_NAMED = 0.5
_HEARD_S = 120.0
_UNDECIDED_S = 10.0
_UNSEEN_S = 10.0
_SURE_MATCH = 0.9
# A vessel whose place is less certain may as well be out of view.
_CERTAIN_M = 40.0
_NEAR = 16.0
_WAIT_S = 0.25
_LONGEST_WAIT_S = 5.0
_LONGEST_LINE = 4096


@dataclass
class _Vessel:
    """What a vessel said last, and what it is called."""

    mmsi: int
    name: str = ""
    reports: deque[AisReport] | None = None

    def at(self, time_utc_s: float, plane: LocalPlane) -> tuple[FloatArray, float] | None:
        """Place in the plane and variance of a coordinate, m²; None where nothing recent tells."""
        past = [one for one in self.reports or () if one.time_utc_s <= time_utc_s + _LATE_S]
        if not past:
            return None
        last = past[-1]
        lag_s = time_utc_s - last.time_utc_s
        if lag_s > _OLD_S:
            return None
        east, north = plane.to_plane(last.latitude_deg, last.longitude_deg)
        velocity = np.array(last.velocity_mps)
        known = bool(np.isfinite(velocity).all())
        speed = float(np.hypot(*velocity)) if known else 3.0
        place = np.array([float(east), float(north)])
        if known:
            place = place + lag_s * velocity
            astray_m = 0.5 * _ACCELERATION_MPS2 * lag_s**2
            if speed < _STILL_MPS:
                # One that sets out says so.
                astray_m = min(astray_m, _ADRIFT_MPS * abs(lag_s))
        else:
            astray_m = speed * abs(lag_s)
        return place, _PLACE_M**2 + (speed * _LATE_S) ** 2 + astray_m**2


class AisMatcher:
    """Names the targets of moments by what vessels said of themselves."""

    def __init__(
        self,
        plane: LocalPlane,
        *,
        view: View | None = None,
        check: ModelCheck | None = None,
        told: Callable[[str, str], None] | None = None,
    ) -> None:
        """Begin without a vessel.

        Args:
            plane: Of the camera.
            view: Of the camera; None: no vessel is missed.
            check: Compares targets with the vessels that they are.
            told: Is told of vessels that no target is: a kind, and a text.
        """
        self._plane, self._view, self._check, self._told = plane, view, check, told
        self._lock = threading.Lock()
        self._heard_utc_s = -np.inf
        self._first_s: dict[int, float] = {}
        self._alone: dict[int, bool] = {}
        self._unseen_s: dict[int, float] = {}
        self._told_of: set[int] = set()
        self._unseen: tuple[UnseenVessel, ...] = ()
        self._counts: dict[str, int] = {}
        self._vessels: dict[int, _Vessel] = {}
        self._evidence: dict[tuple[int, int], float] = {}
        self._named: dict[int, tuple[int, float]] = {}
        self._looked_utc_s = -np.inf

    def take(self, report: AisReport) -> None:
        """Take a report; from any thread."""
        with self._lock:
            vessel = self._vessels.setdefault(report.mmsi, _Vessel(report.mmsi))
            vessel.name = report.name or vessel.name
            if math.isfinite(report.time_utc_s):
                self._heard_utc_s = max(self._heard_utc_s, report.time_utc_s)
                kept = vessel.reports if vessel.reports is not None else deque(maxlen=200)
                if not kept or report.time_utc_s > kept[-1].time_utc_s:
                    kept.append(report)
                vessel.reports = kept
        if self._check is not None:
            # In the receiver's thread, where nobody waits for it.
            self._check.judge()

    def __len__(self) -> int:
        """Number of vessels."""
        return len(self._vessels)

    def change(self, view: View) -> None:
        """Miss vessels in another view from now on; from any thread."""
        self._view = view

    def figures(self) -> dict[str, object]:
        """What health tells: vessels, those in view and those without a target."""
        told: dict[str, object] = {"vessels": len(self._vessels), **self._counts}
        if self._check is not None:
            told["accuracy"] = self._check.figures()
        return told

    def take_checks(self) -> list[AisCheck]:
        """The comparisons of targets and vessels since this was asked last, to be kept."""
        return [] if self._check is None else self._check.take_new()

    def identify(self, moment: Moment, source: str = "") -> Moment:
        """The moment, its targets named where that is likelier than not.

        Args:
            moment: The targets.
            source: Who made the boxes, as the model knows them.
        """
        with self._lock:
            step_s = moment.time_utc_s - self._looked_utc_s
            look = step_s >= _LOOKS_APART_S or step_s < 0.0
            if look:
                self._look(moment, max(step_s, 0.0))
                self._looked_utc_s = moment.time_utc_s
            named = replace(
                moment,
                targets=tuple(self._with_name(one, moment.time_utc_s) for one in moment.targets),
                unseen=self._unseen,
            )
            if self._check is not None:
                self._check.remember(named, source)
                if look:
                    self._compare()
        return named

    def _with_name(self, target: TargetState, now_s: float) -> TargetState:
        told = self._named.get(target.id)
        if told is not None:
            mmsi, match = told
            name = self._vessels[mmsi].name or None
            return replace(target, mmsi=mmsi, name=name, match=match, identity="identified")
        heard = now_s - self._heard_utc_s <= _HEARD_S
        known_s = now_s - self._first_s.get(target.id, now_s)
        if heard and known_s >= _UNDECIDED_S and self._alone.get(target.id, False):
            return replace(target, identity="unidentified")
        return target

    def _compare(self) -> None:
        assert self._check is not None, "the caller has looked"
        for number, (mmsi, match) in self._named.items():
            if match >= _SURE_MATCH:
                self._check.compare(number, mmsi, list(self._vessels[mmsi].reports or ()))

    def _look(self, moment: Moment, step_s: float) -> None:
        """Weigh all targets against all vessels, and name those that are likely."""
        kept = math.exp(-min(step_s, 1e3) / _MEMORY_S)
        self._evidence = {pair: kept * value for pair, value in self._evidence.items()}
        now_s = moment.time_utc_s
        vessels = {m: at for m, v in self._vessels.items() if (at := v.at(now_s, self._plane))}
        for target in moment.targets:
            if target.state == "predicted":
                continue
            east, north = self._plane.to_plane(target.latitude_deg, target.longitude_deg)
            place = np.array([float(east), float(north)])
            for mmsi, (where, variance) in vessels.items():
                gain = _log_ratio(place - where, target.covariance_m2, variance)
                pair = target.id, mmsi
                total = self._evidence.get(pair, 0.0) + gain * (1.0 - kept) * 4.0
                self._evidence[pair] = min(max(total, _WORST_LOG), _BEST_LOG)
        here = {target.id for target in moment.targets}
        self._evidence = {
            pair: value
            for pair, value in self._evidence.items()
            if abs(value) > 1e-3 or pair[0] in here
        }
        self._named = self._decided(sorted(here), sorted(vessels))
        self._first_s = {one: self._first_s.get(one, now_s) for one in here}
        self._alone = {}
        for number in here:
            odds = [value for (one, _), value in self._evidence.items() if one == number]
            # It is nobody's with the share that all vessels leave.
            self._alone[number] = 1.0 / (1.0 + float(np.exp(odds).sum())) > 1.0 - _NAMED
        self._miss(moment, vessels)
        old = [m for m, v in self._vessels.items() if m not in vessels and _is_over(v, now_s)]
        for mmsi in old:
            del self._vessels[mmsi]

    def _miss(self, moment: Moment, vessels: dict[int, tuple[FloatArray, float]]) -> None:
        """Note which vessels are in view without a target."""
        view = self._view
        if view is None:
            return
        now_s, taken = moment.time_utc_s, {mmsi for mmsi, _ in self._named.values()}
        numbers = [m for m, (_, variance) in vessels.items() if variance <= _CERTAIN_M**2]
        places = np.array([vessels[m][0] for m in numbers]).reshape(-1, 2)
        latitude, longitude = self._plane.to_geographic(places[:, 0], places[:, 1])
        inside = view.holds(latitude, longitude)
        missing: dict[int, UnseenVessel] = {}
        for k, mmsi in enumerate(numbers):
            variance = vessels[mmsi][1]
            if not inside[k] or mmsi in taken or self._may_be_seen(moment, places[k], variance):
                continue
            since_s = min(self._unseen_s.get(mmsi, now_s), now_s)
            missing[mmsi] = UnseenVessel(
                mmsi=mmsi,
                name=self._vessels[mmsi].name or None,
                latitude_deg=float(latitude[k]),
                longitude_deg=float(longitude[k]),
                sigma_m=math.sqrt(variance),
                unseen_s=now_s - since_s,
            )
        self._unseen_s = {m: now_s - one.unseen_s for m, one in missing.items()}
        self._unseen = tuple(one for one in missing.values() if one.unseen_s >= _UNSEEN_S)
        self._counts = {
            "in_view": int(inside.sum()),
            "without_target": len(self._unseen),
            "identified": len(self._named),
            "unidentified": sum(
                self._with_name(one, now_s).identity == "unidentified" for one in moment.targets
            ),
        }
        new = {one.mmsi for one in self._unseen} - self._told_of
        self._told_of = (self._told_of | new) & set(missing)
        for one in self._unseen:
            if one.mmsi in new and self._told is not None:
                name = f"{one.name} ({one.mmsi})" if one.name else f"vessel {one.mmsi}"
                self._told(
                    "ais-without-target",
                    f"{name} says that it is in view, at {one.latitude_deg:.5f}, "
                    f"{one.longitude_deg:.5f}, and no target is seen there",
                )

    def _may_be_seen(self, moment: Moment, place: FloatArray, variance: float) -> bool:
        """Whether a target that nobody is is near enough to be a vessel."""
        for target in moment.targets:
            if target.id in self._named:
                continue
            east, north = self._plane.to_plane(target.latitude_deg, target.longitude_deg)
            off = np.array([float(east), float(north)]) - place
            spread = np.asarray(target.covariance_m2) + variance * np.eye(2)
            if float(off @ np.linalg.solve(spread, off)) < _NEAR:
                return True
        return False

    def _decided(self, ids: list[int], vessels: list[int]) -> dict[int, tuple[int, float]]:
        if not ids or not vessels:
            return {}
        odds = np.array([[self._evidence.get((i, m), _WORST_LOG) for m in vessels] for i in ids])
        named = {}
        for i, j in zip(*linear_sum_assignment(-odds), strict=True):
            # It may be nobody's, another's, or the vessel another target.
            own = np.exp(odds[i, j])
            row, column = np.exp(odds[i]).sum(), np.exp(odds[:, j]).sum()
            match = float(own / (1.0 + row + column - own))
            if match >= _NAMED:
                named[ids[int(i)]] = vessels[int(j)], round(match, 3)
        return named


def _is_over(vessel: _Vessel, now_s: float) -> bool:
    last = vessel.reports[-1].time_utc_s if vessel.reports else -np.inf
    return bool(math.isfinite(last) and now_s - last > _FORGOTTEN_S)


def _log_ratio(off_m: FloatArray, covariance_m2: FloatArray, variance_m2: float) -> float:
    """Log of how much likelier a difference is of one and the same than of any two."""
    spread = np.asarray(covariance_m2) + variance_m2 * np.eye(2)
    distance2 = float(off_m @ np.linalg.solve(spread, off_m))
    density = -0.5 * distance2 - 0.5 * math.log((2.0 * math.pi) ** 2 * np.linalg.det(spread))
    return density - math.log(_DENSITY_PER_M2)


def check_ais(address: str) -> None:
    """Raise InputError where an address is none of an AIS receiver.

    Raises:
        InputError: It is none, or there is no such file.
    """
    if "://" not in address:
        if not Path(address).is_file():
            raise InputError(f"{address}: there is no such file of AIS sentences")
        return
    _parsed(address)


def _parsed(address: str) -> Address:
    ports = {"tcp": None, "udp": None}
    return Address.parse(address, ports, feed="--ais", or_else="a file that grows")


class AisReceiver:
    """Receives AIS in a thread of its own, and hands reports to a matcher.

    Attributes:
        tally: What was received.
    """

    def __init__(self, address: str, matcher: AisMatcher) -> None:
        """Take where it comes from; `start` begins.

        Args:
            address: A file that grows, ``tcp://`` (connects) or ``udp://`` (listens).
            matcher: Is given the reports.

        Raises:
            InputError: See `check_ais`.
        """
        check_ais(address)
        self._address, self._matcher = address, matcher
        self.tally = Tally(address)
        self._stream = AisStream(self.tally)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="sightline-ais")

    def start(self) -> None:
        """Begin to receive."""
        self._thread.start()

    def close(self) -> None:
        """Receive no more."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(1.0)

    def _run(self) -> None:
        wait_s = _WAIT_S
        while not self._stop.is_set():
            try:
                for line, live in self._lines():
                    wait_s = _WAIT_S
                    for report in self._stream.add(line, time.time() if live else None):
                        self._matcher.take(report)
            except OSError as error:
                self.tally.leave_out(f"connections: {error.strerror or error}")
            self._stop.wait(wait_s)
            wait_s = min(2.0 * wait_s, _LONGEST_WAIT_S)

    def _lines(self) -> Iterator[tuple[str, bool]]:
        """Lines, and whether they came just now."""
        if "://" not in self._address:
            yield from self._of_file()
            return
        parts = _parsed(self._address)
        if parts.scheme == "udp":
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
                receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                receiver.bind((parts.host, parts.port))
                yield from self._received(receiver, datagrams=True)
            return
        with socket.create_connection((parts.host, parts.port), timeout=5.0) as receiver:
            yield from self._received(receiver, datagrams=False)

    def _received(self, receiver: socket.socket, *, datagrams: bool) -> Iterator[tuple[str, bool]]:
        receiver.settimeout(_WAIT_S)
        rest = b""
        while not self._stop.is_set():
            try:
                got = receiver.recv(65536)
            except TimeoutError:
                continue
            if not got and not datagrams:
                return
            *lines, rest = (rest + got + (b"\n" if datagrams else b"")).split(b"\n")
            rest = rest[-_LONGEST_LINE:]
            for line in lines:
                yield line.decode("latin-1"), True

    def _of_file(self) -> Iterator[tuple[str, bool]]:
        with Path(self._address).open("rb") as file:
            rest, live = b"", False
            while not self._stop.is_set():
                got = file.read(65536)
                if not got:
                    # What stood in it before has no time unless it says so.
                    live = True
                    if file.tell() > Path(self._address).stat().st_size:
                        return
                    self._stop.wait(_WAIT_S)
                    continue
                *lines, rest = (rest + got).split(b"\n")
                rest = rest[-_LONGEST_LINE:]
                for line in lines:
                    yield line.decode("latin-1"), live
