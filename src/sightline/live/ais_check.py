"""What AIS says of the model: each passage of a named target is compared with its vessel's reports.

A report is where a receiver on the vessel was. The target at that time is off by the errors of box
and model, and by a part of the hull. Boxes at the times of reports are to the camera what boxes and
a log are to `sightline.georeferencing.recalibration`, which tells whether it was turned; distances
are compared with the ellipses that were published, and with those of the passages before.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom, mannwhitneyu

from sightline.formats import AisReport
from sightline.georeferencing.correspondences import Correspondences
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.georeferencing.recalibration import CameraChange, camera_changes
from sightline.moment import Moment, TargetState
from sightline.types import Boxes, FloatArray

_REMEMBERED_S = 20.0
_REMEMBERED_APART_S = 0.2
_NEAREST_S = 0.6
_MOST = 20_000
_DAY_S = 86_400.0
_KEPT_S = 30.0 * _DAY_S
_HULL_M, _LATE_S = 5.0, 0.5
_WITHIN_95 = 5.991
_FEWEST_REPORTS, _FEWEST_PASSAGES, _FEWEST_VESSELS = 3, 3, 2
_NEW_REPORTS = 5
_LAST_PASSAGES = 10
_UNLIKELY = 1e-3
_GROWN = 1.5
# Errors of boxes and hull last for most of a passage.
_WORTH_A_PASSAGE = 3.0
_JUDGED_REPORTS = 150


@dataclass(frozen=True)
class AisCheck:
    """A target beside the report of the vessel that it is.

    Attributes:
        time_utc_s: Of the report, POSIX seconds.
        target_id: Number of the target.
        mmsi: Of the vessel.
        place_m: Of the report, metres east and north in the model's plane.
        velocity_mps: Of the vessel, east and north.
        off_m: The target's place less the report's, metres east and north.
        covariance_m2: Of the target's place: east, east-north, north.
        box_xyxy_px: The box of the target.
        source: Who made the box.
    """

    time_utc_s: float
    target_id: int
    mmsi: int
    place_m: tuple[float, float]
    velocity_mps: tuple[float, float]
    off_m: tuple[float, float]
    covariance_m2: tuple[float, float, float]
    box_xyxy_px: tuple[float, float, float, float]
    source: str = ""

    @property
    def distance_m(self) -> float:
        """How far the target is from the report."""
        return float(np.hypot(*self.off_m))

    @property
    def distance2(self) -> float:
        """The same squared, by the ellipse and by what a report has of errors itself."""
        a, b, c = self.covariance_m2
        late = np.array(self.velocity_mps) * _LATE_S
        spread = np.array([[a, b], [b, c]]) + _HULL_M**2 * np.eye(2) + np.outer(late, late)
        return float(np.array(self.off_m) @ np.linalg.solve(spread, np.array(self.off_m)))


class ModelCheck:
    """Compares targets with vessels, and says when the model does not hold any more."""

    def __init__(
        self,
        model: Georeferencer,
        *,
        water_level_m: float | None = None,
        before: Iterable[AisCheck] = (),
        told: Callable[[str, str], None] | None = None,
    ) -> None:
        """Begin with what was kept.

        Args:
            model: Of the camera.
            water_level_m: Where it needs that.
            before: Comparisons of earlier days, of the same model, in the order of time.
            told: Is told when the camera has moved or errors have grown: a kind, and a text.
        """
        self._model, self._told = model, told
        self._water_level_m = water_level_m
        self._lock = threading.Lock()
        self._recent: deque[tuple[Moment, dict[int, TargetState], str]] = deque()
        self._checks: deque[AisCheck] = deque(before, maxlen=_MOST)
        self._new: list[AisCheck] = []
        self._compared_s: dict[int, float] = {}
        self._total = len(self._checks)
        self._judged_total = 0
        self._doubts: dict[str, str] = {}

    def remember(self, moment: Moment, source: str) -> None:
        """Take a moment, since reports come later than what they tell of."""
        recent = self._recent
        while recent and not 0.0 <= moment.time_utc_s - recent[0][0].time_utc_s <= _REMEMBERED_S:
            recent.popleft()
        if recent and moment.time_utc_s - recent[-1][0].time_utc_s < _REMEMBERED_APART_S:
            return
        recent.append((moment, {one.id: one for one in moment.targets}, source))

    def compare(self, target_id: int, mmsi: int, reports: Sequence[AisReport]) -> None:
        """Compare a target with what its vessel has reported since it was last compared.

        Args:
            target_id: Number of the target.
            mmsi: Of the vessel.
            reports: Of the vessel, in the order of time.
        """
        after_s = self._compared_s.get(mmsi, -np.inf)
        for report in reports:
            if report.time_utc_s <= after_s or not np.isfinite(report.velocity_mps).all():
                continue
            if not self._recent or report.time_utc_s > self._recent[-1][0].time_utc_s:
                break
            self._compared_s[mmsi] = report.time_utc_s
            found = self._compared(target_id, report)
            if found is not None:
                with self._lock:
                    self._checks.append(found)
                    self._new.append(found)
                    self._total += 1

    def _compared(self, target_id: int, report: AisReport) -> AisCheck | None:
        nearest = min(self._recent, key=lambda one: abs(one[0].time_utc_s - report.time_utc_s))
        moment, targets, source = nearest
        lag_s = moment.time_utc_s - report.time_utc_s
        target = targets.get(target_id)
        if target is None or target.box_xyxy_px is None or abs(lag_s) > _NEAREST_S:
            return None
        plane = self._model.plane
        place = np.array(plane.to_plane(report.latitude_deg, report.longitude_deg), dtype=float)
        place = place.reshape(2) + lag_s * np.array(report.velocity_mps)
        seen = np.array(plane.to_plane(target.latitude_deg, target.longitude_deg), dtype=float)
        off = seen.reshape(2) - place
        covariance = np.asarray(target.covariance_m2)
        return AisCheck(
            time_utc_s=moment.time_utc_s,
            target_id=target_id,
            mmsi=report.mmsi,
            place_m=(float(place[0]), float(place[1])),
            velocity_mps=report.velocity_mps,
            off_m=(float(off[0]), float(off[1])),
            covariance_m2=(
                float(covariance[0, 0]),
                float(covariance[0, 1]),
                float(covariance[1, 1]),
            ),
            box_xyxy_px=target.box_xyxy_px,
            source=source,
        )

    def take_new(self) -> list[AisCheck]:
        """The comparisons since this was asked last."""
        with self._lock:
            new, self._new = self._new, []
        return new

    def figures(self) -> dict[str, object]:
        """How far targets are from their vessels, over a day and all that is known."""
        with self._lock:
            checks = list(self._checks)
        told: dict[str, object] = {"doubt": "; ".join(self._doubts.values()) or None}
        if not checks:
            return told
        last_s = checks[-1].time_utc_s
        for name, days in (("day", 1.0), ("week", 7.0), ("month", 30.0)):
            some = [one for one in checks if one.time_utc_s > last_s - days * _DAY_S]
            squared = np.array([one.distance2 for one in some])
            told[name] = {
                "passages": len({(one.target_id, one.mmsi) for one in some}),
                "reports": len(some),
                "median_error_m": round(float(np.median([one.distance_m for one in some])), 2),
                "inside_ellipse_share": round(float(np.mean(squared < _WITHIN_95)), 3),
            }
        return told

    def judge(self) -> None:
        """Say whether the camera has moved or its errors have grown, where there is news."""
        with self._lock:
            if self._total < self._judged_total + _NEW_REPORTS:
                return
            self._judged_total = self._total
            last_s = self._checks[-1].time_utc_s
            checks = [one for one in self._checks if one.time_utc_s > last_s - _KEPT_S]
        passages = _passages(checks)
        vessels = {passage[0].mmsi for passage in passages}
        if len(passages) < _FEWEST_PASSAGES or len(vessels) < _FEWEST_VESSELS:
            return
        change = self._change(passages)
        turned = ""
        if change is not None:
            turned = (
                f"the camera seems to have been turned by {change.angles}, by what AIS says of "
                f"{len(vessels)} vessels; fit its model again"
            )
        self._doubt("camera-moved", turned)
        self._doubt("errors-grown", "" if turned else _grown(passages))

    def _doubt(self, kind: str, text: str) -> None:
        if not text:
            self._doubts.pop(kind, None)
            return
        new = kind not in self._doubts
        self._doubts[kind] = text
        if new and self._told is not None:
            self._told(kind, text)

    def _change(self, passages: Sequence[Sequence[AisCheck]]) -> CameraChange | None:
        if self._model.calibrated is None:
            return None
        checks = sorted((one for some in passages for one in some), key=lambda one: one.time_utc_s)
        checks = checks[-_JUDGED_REPORTS:]
        n = len(checks)
        level_m = 0.0 if self._water_level_m is None else self._water_level_m
        pairs = Correspondences(
            boxes=Boxes.of(
                np.array([one.box_xyxy_px for one in checks]),
                time_utc_s=np.array([one.time_utc_s for one in checks]),
                source=np.array([one.source for one in checks], dtype=np.str_),
            ),
            recording=np.full(n, "live"),
            east_north_m=np.array([one.place_m for one in checks]),
            velocity_mps=np.array([one.velocity_mps for one in checks]),
            asked=n,
            plane=self._model.plane,
            water_level_m=np.full(n, level_m),
        )
        apart_s = max(float(np.median(np.diff(pairs.boxes.time_utc_s))), 1e-3)
        worth = min(1.0, _WORTH_A_PASSAGE * len(_passages(checks)) / n)
        found = camera_changes(self._model, pairs, correlation_time_s=apart_s / max(worth, 1e-6))
        since = [one for one in checks if found and one.time_utc_s >= found[0].since_utc_s]
        # One vessel whose antenna stands far aft turns no camera.
        seen = len(_passages(since)) >= _FEWEST_PASSAGES
        several = len({one.mmsi for one in since}) >= _FEWEST_VESSELS
        return found[0] if found and seen and several else None


def _passages(checks: Sequence[AisCheck]) -> list[list[AisCheck]]:
    """Comparisons by target and vessel, in the order in which they end, those of some reports."""
    found: dict[tuple[int, int], list[AisCheck]] = {}
    for one in checks:
        found.setdefault((one.target_id, one.mmsi), []).append(one)
    long_enough = [some for some in found.values() if len(some) >= _FEWEST_REPORTS]
    return sorted(long_enough, key=lambda some: some[-1].time_utc_s)


def _grown(passages: Sequence[Sequence[AisCheck]]) -> str:
    """In words, whether the last passages are further off than their ellipses, or others, say."""
    last, before = passages[-_LAST_PASSAGES:], passages[:-_LAST_PASSAGES]
    typical: FloatArray = np.array([np.median([one.distance2 for one in some]) for some in last])
    outside = int((typical > _WITHIN_95).sum())
    if binom.sf(outside - 1, len(last), 0.05) < _UNLIKELY:
        return (
            f"of the last {len(last)} passages with AIS {outside} lie outside of the ellipses that "
            "were published, where one in twenty is to be expected; fit the model again"
        )
    earlier = np.array([np.median([one.distance2 for one in some]) for some in before])
    if len(earlier) < _LAST_PASSAGES or len(last) < _LAST_PASSAGES:
        return ""
    grown = float(np.sqrt(np.median(typical) / np.median(earlier)))
    unlikely = float(mannwhitneyu(typical, earlier, alternative="greater").pvalue)
    if grown < _GROWN or unlikely > _UNLIKELY:
        return ""
    return (
        f"errors against AIS are {grown:.1f} times what they were in the {len(earlier)} passages "
        "before the last ten; look whether the picture has changed, and fit the model again"
    )
