"""Search for the clock offsets of recordings, by what a camera makes of the boxes.

With a clock that is off by more than a few seconds a fit of the camera ends at a camera that is
none, and the offset that the fit estimates with it stays where it began. So cameras are fitted at
clocks some seconds apart, each with a clock that may move between them, to some of the boxes; what
explains them best, less what it is to believe, is where the fit begins. The errors of a box are
taken to be Student's (three degrees of freedom): then how much worse a wrong clock is counts as a
ratio, and not by how large the boxes' noise is believed to be.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import LinAlgError

from sightline.camera.calibration import CameraFitSettings, fit_camera
from sightline.camera.mixed_model import MixedModel
from sightline.camera.observations import Landmarks, PointCorrespondences
from sightline.camera.priors import CameraPrior, PixelNoise, SourcePrior
from sightline.camera.stated_place import elsewhere, surprise
from sightline.clock_offset import LARGEST_OFFSET_S, ZONES_S, ClockOffset, ClockPrior
from sightline.errors import FitError
from sightline.types import FloatArray

MOST_BOXES = 48
"""Boxes of a recording that the search looks at."""

INDEPENDENT_S = 2.0
"""Boxes nearer in time than this tell little more than one."""

_STEP_S = 4.0
_FREE_S = 3.0
_COARSE_S = 2.0
_FINE_S = 0.5
_STARTS = 3
_WIDE = 20.0
_EVALUATIONS = 40
_MOST_CANDIDATES = 3
_MOST_ZONES = 12
_DEGREES = 3.0
# Squares of standardised residuals: of a box without a fix, the largest that counts, and what a
# camera leaves where the clock is right, in the median over the boxes of a recording.
_UNMATCHED = 60.0
_LARGEST = 2e3
_GOOD = 4.0
_VERY_GOOD = 2.0
_BAD = 30.0
_LOOKS = 9
# Nats by which another clock has to be likelier than the one that was believed.
_LEAST_LEAD = 3.0
_MORE_A_BOX = 0.5
_FEWEST = 5
# Of the boxes of a recording that might have a place: where fewer have, the clock may be to blame.
_COVERED = 0.8
_ROUNDS = 4
_STILL_S = 0.05


@dataclass(frozen=True, eq=False)
class ClockedBoxes:
    """The boxes of one recording, beside its log at any clock offset.

    Attributes:
        at: From a clock offset, the camera's ahead of the log's in seconds, to the boxes that have
            a place then.
        asked: How many boxes there are.
        duration_s: Between the first and the last.
        prior: Of the offset.
    """

    at: Callable[[float], PointCorrespondences]
    asked: int
    duration_s: float
    prior: ClockPrior = field(default_factory=ClockPrior)

    @property
    def weight(self) -> float:
        """How many independent boxes each box is worth."""
        return min(1.0, (self.duration_s / INDEPENDENT_S + 1.0) / max(self.asked, 1))


@dataclass(frozen=True, eq=False)
class CameraBeliefs:
    """What is known of a camera before its fit.

    Attributes:
        image_size_px: Width and height.
        n_sources: How many sources of boxes there are.
        prior: Of the camera.
        sources: Priors of single sources.
        landmarks: Control points and landmarks.
        settings: How the camera is fitted.
        noise: Of a box's foot, by which a camera explains the boxes or does not. The search itself
            is by the usual noise: a wider one lets wrong clocks pass.
    """

    image_size_px: tuple[int, int]
    n_sources: int
    prior: CameraPrior = field(default_factory=CameraPrior)
    sources: Mapping[int, SourcePrior] = field(default_factory=dict)
    landmarks: Landmarks = field(default_factory=Landmarks.none)
    settings: CameraFitSettings = field(default_factory=CameraFitSettings)
    noise: PixelNoise = field(default_factory=PixelNoise)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Clock offsets with the camera that they make.

    Attributes:
        offset_s: (R,) float64.
        shape: Camera, target and sources, without clocks.
        score: Logarithm of the posterior density, up to a constant.
        median: (R,) median squared standardised residual of each recording's boxes; infinite where
            most of them have no place.
        loss: (R,) mean over its boxes of what their residuals cost, nats: a few that are far off
            count, which the median does not see.
    """

    offset_s: FloatArray
    shape: FloatArray
    score: float
    median: FloatArray
    loss: FloatArray


def search_clocks(
    recordings: Sequence[ClockedBoxes],
    beliefs: CameraBeliefs,
    *,
    largest_offset_s: float = LARGEST_OFFSET_S,
) -> list[ClockOffset]:
    """Clock offsets of recordings of one camera; zero, and unsure, where nothing tells.

    Where the boxes of a recording meet no log, or no camera explains them, the camera's clock is
    tried in other time zones as well.

    Args:
        recordings: With boxes.
        beliefs: About the camera.
        largest_offset_s: Largest offset, but for time zones.
    """
    search = _Search(recordings, beliefs, largest_offset_s)
    best = search.best()
    if beliefs.settings.position_known and not beliefs.settings.heaving:
        # A camera that stands elsewhere looks like clocks that are off, and the other way round.
        apart = replace(beliefs, prior=elsewhere(beliefs.prior))
        other = _Search(recordings, apart, largest_offset_s)
        found = other.believed() if best is None or search.off(best) else None
        cost = surprise(beliefs.prior)
        if found is not None and (best is None or found.score - cost > best.score):
            search, best = other, found
    if best is None:
        return [_believed(one.prior) for one in recordings]
    # Where no camera explains the boxes, none can tell how late they are.
    return [
        told if median < _GOOD else _believed(one.prior)
        for one, told, median in zip(
            recordings, search.refined(best), search.explained(best), strict=True
        )
    ]


def _believed(prior: ClockPrior) -> ClockOffset:
    return ClockOffset(prior.mean_s, prior.sigma_s, prior.stated)


class _Search:
    """The search over the clocks of some recordings."""

    def __init__(
        self, recordings: Sequence[ClockedBoxes], beliefs: CameraBeliefs, largest_offset_s: float
    ) -> None:
        self.recordings = recordings
        self.beliefs = beliefs
        self.largest_s = largest_offset_s
        self.start_s = np.array([one.prior.mean_s for one in recordings])
        self.free = np.array([not one.prior.stated for one in recordings])
        self.noise = PixelNoise()
        self.most: dict[int, int] = {}

    def best(self) -> _Candidate | None:
        """The best candidate; None where no clock lets a camera be fitted."""
        believed = self.fitted(self.start_s)
        found = []
        if believed is not None:
            believed = self._again(believed)
            found.append(self._placed(believed))
        # At a wrong clock a camera that explains most boxes draws the clock along, as a rule.
        limit = _VERY_GOOD if found and self.off(found[0]) else _GOOD
        if not found or not (self._good(found[0], limit) and self._covered(found[0])):
            found += self._along(0.0, found)
            if not found or self._bad(max(found, key=_score)):
                for zone_s in self._zones(range(len(self.recordings))):
                    found += self._along(zone_s, found)
        if not found:
            return None
        found.sort(key=_score, reverse=True)
        few = _distinct(found)
        if self._good(few[0], _VERY_GOOD) and not self._bad(few[0]):
            few = few[:1]
        best = max((self._each(self._again(one)) for one in few), key=_score)
        if believed is not None and best.score < believed.score + self._lead(believed):
            return believed
        return best

    def _lead(self, believed: _Candidate) -> float:
        """Nats by which another clock has to be likelier than one that was believed."""
        if not (believed.median < _GOOD).all() or not self._covered(believed):
            return _LEAST_LEAD
        # Where it explains most boxes, another one is to explain the rest, and not by chance.
        independent = sum(one.weight * one.asked for one in self.recordings)
        return _LEAST_LEAD + _MORE_A_BOX * independent

    def off(self, one: _Candidate) -> bool:
        """Whether a clock of a candidate is not what was believed of it."""
        return bool((np.abs(one.offset_s - self.start_s) > _FREE_S).any())

    def believed(self) -> _Candidate | None:
        """The candidate at the clocks that were believed; None where it does not explain all."""
        found = self.fitted(self.start_s)
        if found is None or not (self._good(found, _GOOD) and self._covered(found)):
            return None
        return None if self._bad(found) or self.off(found) else found

    def _good(self, one: _Candidate, limit: float) -> bool:
        """Whether a camera explains the boxes with places at its clocks, and not most alone."""
        known = np.isfinite(one.median)
        most = float(_loss(np.array(limit)))
        return bool((one.median[known] < limit).all() and (one.loss[known] < most).all())

    def _covered(self, one: _Candidate) -> bool:
        """Whether no other clock gives many more boxes a place."""
        for index in np.flatnonzero(self.free).tolist():
            recording = self.recordings[index]
            here = len(recording.at(float(one.offset_s[index])))
            if here < _COVERED * recording.asked and here < _COVERED * self._most(index):
                return False
        return True

    def _most(self, index: int) -> int:
        """The most boxes of a recording that have places at any clock, but for other zones."""
        if index not in self.most:
            around = np.arange(-self.largest_s, self.largest_s + _STEP_S, _STEP_S)
            at = self.recordings[index].at
            self.most[index] = max(len(at(float(self.start_s[index] + o))) for o in around)
        return self.most[index]

    def _bad(self, one: _Candidate) -> bool:
        """Whether it explains none, or most of a recording's have no place."""
        return bool((~(one.median < _BAD)).any())

    def _zones(self, which: Iterable[int]) -> list[float]:
        """Zones in which boxes of some of the recordings have places, the nearest first."""
        around = np.linspace(-self.largest_s, self.largest_s, _LOOKS)
        free = [index for index in which if self.free[index]]
        out = [
            zone_s
            for zone_s in ZONES_S
            if any(
                len(self.recordings[index].at(float(self.start_s[index] + zone_s + o)))
                for index in free
                for o in around
            )
        ]
        return out[:_MOST_ZONES]

    def _along(self, zone_s: float, known: Sequence[_Candidate]) -> list[_Candidate]:
        """Candidates at clocks about a zone, all recordings alike, until one is good."""
        count = int(np.ceil(self.largest_s / _STEP_S))
        steps = sorted(_STEP_S * np.arange(-count, count + 1), key=abs)
        out: list[_Candidate] = []
        shapes = [one.shape for one in sorted(known, key=_score, reverse=True)[:1]]
        for step in steps:
            offset_s = self.start_s + np.where(self.free, zone_s + step, 0.0)
            found = self.fitted(offset_s, shapes)
            if found is None:
                continue
            out.append(found)
            shapes = [max(out, key=_score).shape]
            if self._good(found, _VERY_GOOD) and self._covered(found) and not self._bad(found):
                break
        return out

    def _placed(self, one: _Candidate) -> _Candidate:
        """A candidate with clocks looked for where the boxes of a recording have no places."""
        lost = np.flatnonzero(~np.isfinite(one.median) & self.free)
        if not lost.size or lost.size == len(self.recordings):
            return one
        for index in lost.tolist():
            centres = [0.0, *self._zones([index])]
            offset_s = one.offset_s.copy()
            offset_s[index] = self._scan(one, index, [self.start_s[index] + c for c in centres])
            if offset_s[index] == one.offset_s[index]:
                continue
            other = self.fitted(offset_s, [one.shape])
            if other is None or not other.median[index] < _GOOD:
                continue
            # Of so many clocks one is likely by chance, where places in gaps may be anywhere.
            looked = len(centres) * (2.0 * self.largest_s / _COARSE_S + 1.0)
            if other.score > one.score + _LEAST_LEAD + np.log(looked):
                one = other
        return one

    def _each(self, one: _Candidate) -> _Candidate:
        """A candidate with the clock of each recording looked for by itself, in its camera."""
        for _ in range(2):
            offset_s = one.offset_s.copy()
            for index in np.flatnonzero(self.free & ~(one.median < _GOOD)).tolist():
                centres = {float(self.start_s[index]), float(one.offset_s[index])}
                offset_s[index] = self._scan(one, index, sorted(centres))
            moved = np.abs(offset_s - one.offset_s).max(initial=0.0) > _FINE_S
            again = self.fitted(offset_s, [one.shape]) if moved else None
            again = None if again is None else self._again(again)
            if again is None or again.score <= one.score:
                break
            one = again
        return one

    def _scan(self, one: _Candidate, index: int, centres: Sequence[float]) -> float:
        """The likeliest offset of one recording before a known camera."""
        best_s = float(one.offset_s[index])
        best = self._told(one, index, best_s)
        for step_s, reach_s in ((_COARSE_S, self.largest_s), (_FINE_S, _COARSE_S)):
            count = int(np.ceil(reach_s / step_s))
            around = step_s * np.arange(-count, count + 1)
            for offset in np.unique(np.add.outer(np.array(centres), around)):
                told = self._told(one, index, float(offset))
                if told > best:
                    best, best_s = told, float(offset)
            centres = [best_s]
        return best_s

    def _told(self, one: _Candidate, index: int, offset_s: float) -> float:
        """Log density of a recording's boxes before a known camera, at a clock offset."""
        recording = self.recordings[index]
        sightings = recording.at(offset_s)
        cost = self._unmatched(index, len(sightings))
        if len(sightings):
            problem = self._problem(sightings)
            vector = np.append(one.shape, np.zeros(problem.clock_groups.size))
            cost += float(self._cost(problem, vector)[1].sum())
        return recording.prior.log_density(offset_s) - recording.weight * cost

    def fitted(self, offset_s: FloatArray, shapes: Sequence[FloatArray] = ()) -> _Candidate | None:
        """The best camera near some clock offsets, with the offsets that go with it.

        Args:
            offset_s: (R,) where the clocks begin.
            shapes: Cameras to begin with, beside a few of the prior.
        """
        sightings = self._sightings(offset_s)
        if len(sightings) < _FEWEST:
            return None
        problem = self._problem(sightings, offset_s)
        rng = np.random.default_rng(self.beliefs.settings.seed)
        clocks = np.zeros(problem.clock_groups.size)
        starts = [np.append(shape, clocks) for shape in shapes]
        few = 1 if shapes else _STARTS
        starts += problem.starts(few if self.beliefs.settings.position_known else 3 * few, rng)
        best: _Candidate | None = None
        for number, start in enumerate(starts):
            noise = self.noise if number < len(shapes) else self.noise.scaled(_WIDE)
            solved = problem.solve(start, noise, _EVALUATIONS)
            if solved is not None:
                problem.expect_hull(solved[1])
                solved = problem.solve(solved[1], self.noise, _EVALUATIONS)
            if solved is None:
                continue
            one = self._judged(problem, solved[1], offset_s)
            if best is None or one.score > best.score:
                best = one
        return best

    def _again(self, one: _Candidate) -> _Candidate:
        """A candidate fitted to the places at its own clocks, as long as that betters it."""
        for _ in range(_ROUNDS):
            sightings = self._sightings(one.offset_s)
            if len(sightings) < _FEWEST:
                break
            problem = self._problem(sightings, one.offset_s)
            start = np.append(one.shape, np.zeros(problem.clock_groups.size))
            problem.expect_hull(start)
            solved = problem.solve(start, self.noise, _EVALUATIONS)
            if solved is None:
                break
            other = self._judged(problem, solved[1], one.offset_s)
            moved_s = np.abs(other.offset_s - one.offset_s).max(initial=0.0)
            one = other
            if moved_s < _STILL_S:
                break
        return one

    def _judged(self, problem: MixedModel, vector: FloatArray, offset_s: FloatArray) -> _Candidate:
        """A candidate, scored; a clock's own parameter is what is to be added to it."""
        moved_s = offset_s.copy()
        moved_s[problem.clock_groups] -= vector[problem.layout.clocks]
        square, cost = self._cost(problem, vector)
        off = (vector - problem.mean)[problem.held] / problem.sigma[problem.held]
        clocks = np.zeros(problem.size, dtype=bool)
        clocks[problem.layout.clocks] = True
        score = -0.5 * float(np.sum(off[~clocks[problem.held]] ** 2))
        group = problem.sightings.group
        for index, recording in enumerate(self.recordings):
            rows = group == index
            cost_here = cost[rows].sum() + self._unmatched(index, int(rows.sum()))
            score += recording.prior.log_density(float(moved_s[index]))
            score -= recording.weight * float(cost_here)
        score -= float(cost[group >= len(self.recordings)].sum())
        shape = vector[: problem.layout.clocks.start].copy()
        return _Candidate(moved_s, shape, score, *self._explained(problem, square))

    def _explained(self, problem: MixedModel, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(R,) `_Candidate.median` and ``loss`` of squared standardised residuals (N,)."""
        median = np.full(len(self.recordings), np.inf)
        loss = median.copy()
        for index, recording in enumerate(self.recordings):
            rows = problem.sightings.group == index
            # Logs have gaps; only where most boxes have no place is the clock to blame.
            if rows.sum() >= recording.asked - rows.sum():
                median[index] = np.median(square[rows])
                loss[index] = np.mean(_loss(square[rows]))
        return median, loss

    def explained(self, one: _Candidate) -> FloatArray:
        """(R,) `_Candidate.median`, by the noise that is believed."""
        if self.beliefs.noise == self.noise:
            return one.median
        problem = self._problem(self._sightings(one.offset_s))
        vector = np.append(one.shape, np.zeros(problem.clock_groups.size))
        return self._explained(problem, self._cost(problem, vector, self.beliefs.noise)[0])[0]

    def _unmatched(self, index: int, matched: int) -> float:
        missing = self.recordings[index].asked - matched
        return missing * float(_loss(np.array(_UNMATCHED)))

    def _cost(
        self, problem: MixedModel, vector: FloatArray, noise: PixelNoise | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """(N,) squared standardised residuals and what each costs, in nats.

        A place in a gap of the log that might be anywhere is worth as little as none: a density
        that is spread so much wider is so much lower. And what a vessel did in a gap is the same
        for all boxes in it, which count as one as far as it is more than their own noise.
        """
        aspect, noise = problem.aspect(vector), noise or self.noise
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            pixel = problem.project(vector, aspect)[0]
            sigma = problem.sigmas(vector, noise)
            standard = (problem.sightings.pixel_px - pixel) / sigma
            square = np.sum(standard**2, axis=1)
            own = problem.sigmas(vector, noise, gaps=False) / sigma
            wider = -np.log(own).sum(axis=1)
        square = np.where(np.isfinite(square), np.minimum(square, _LARGEST), _LARGEST)
        most = float(_loss(np.array(_UNMATCHED)))
        wider = np.clip(np.nan_to_num(wider, nan=most, posinf=most), 0.0, most)
        counts = np.maximum(np.mean(own**2, axis=1), 1.0 / _alike(problem.sightings))
        counts = np.clip(np.nan_to_num(counts, nan=1.0), 0.0, 1.0)
        return square, most + counts * (_loss(square) + wider - most)

    def _sightings(self, offset_s: FloatArray) -> PointCorrespondences:
        parts = []
        for index, (recording, offset) in enumerate(zip(self.recordings, offset_s, strict=True)):
            own = recording.at(float(offset))
            number = np.full(len(own), index)
            parts.append(replace(own, group=number, log=number))
        return _joined([*parts, _points(self.beliefs.landmarks, len(self.recordings))])

    def _problem(
        self, sightings: PointCorrespondences, offset_s: FloatArray | None = None
    ) -> MixedModel:
        b = self.beliefs
        problem = MixedModel(
            sightings,
            b.image_size_px,
            b.n_sources,
            b.prior,
            b.settings.position_known,
            b.sources,
        )
        if offset_s is not None:
            problem.expect_clocks(
                {
                    index: self._held(index, float(offset))
                    if recording.prior.stated
                    else (0.0, _FREE_S)
                    for index, (recording, offset) in enumerate(
                        zip(self.recordings, offset_s, strict=True)
                    )
                }
            )
        return problem

    def _held(self, index: int, offset_s: float) -> tuple[float, float]:
        """Mean and standard deviation of what is to be added to a recording's clock."""
        mean_s, sigma_s = self.recordings[index].prior.near(offset_s)
        return offset_s - mean_s, sigma_s

    def refined(self, one: _Candidate) -> list[ClockOffset]:
        """Clock offsets of a candidate with their standard deviations, by a whole fit."""
        offset_s = one.offset_s.copy()
        held = [self._held(index, float(offset)) for index, offset in enumerate(offset_s)]
        sigma_s = np.array([sigma for _, sigma in held])
        for _ in range(_ROUNDS):
            sightings = self._sightings(offset_s)
            clocks = {i: self._held(i, float(offset)) for i, offset in enumerate(offset_s)}
            try:
                fit = fit_camera(
                    sightings,
                    self.beliefs.image_size_px,
                    n_sources=self.beliefs.n_sources,
                    prior=self.beliefs.prior,
                    beliefs=self.beliefs.sources,
                    settings=replace(self.beliefs.settings, clocks=clocks),
                )
            except (FitError, LinAlgError):
                break
            own = fit.clock_groups
            sigma_s[own] = np.sqrt(np.diag(fit.covariance)[fit.layout.clocks])
            move_s = np.clip(fit.clock_offset_s, -_STEP_S, _STEP_S)
            offset_s[own] -= move_s
            if np.abs(move_s).max(initial=0.0) < _STILL_S:
                break
        return [
            ClockOffset(float(offset), float(sigma), recording.prior.stated)
            for offset, sigma, recording in zip(offset_s, sigma_s, self.recordings, strict=True)
        ]


def _score(one: _Candidate) -> float:
    return one.score


def _distinct(found: Sequence[_Candidate]) -> list[_Candidate]:
    """The best candidates, each at clocks unlike those before it."""
    out: list[_Candidate] = []
    for one in found:
        if all(np.abs(one.offset_s - other.offset_s).max() > _STEP_S for other in out):
            out.append(one)
        if len(out) == _MOST_CANDIDATES:
            break
    return out


def _loss(square: FloatArray) -> FloatArray:
    """Negative logarithm of Student's density in two dimensions, against that at its middle."""
    return np.asarray(0.5 * (_DEGREES + 2.0) * np.log1p(square / _DEGREES))


def _alike(sightings: PointCorrespondences) -> FloatArray:
    """(N,) how many boxes are in the gap of its log that each is in; 1 where no gap is known."""
    out = np.ones(len(sightings))
    known = np.flatnonzero(np.isfinite(sightings.gap_s).all(axis=1))
    if known.size:
        gap = np.stack([sightings.group[known].astype(float), sightings.gap_s[known, 0]], axis=1)
        _, of, count = np.unique(gap, axis=0, return_inverse=True, return_counts=True)
        out[known] = count[of.ravel()]
    return out


def _points(landmarks: Landmarks, first: int) -> PointCorrespondences:
    """Landmarks as sightings, each of a group of its own."""
    n = len(landmarks)
    alone = first + np.arange(n)
    return PointCorrespondences(
        pixel_px=landmarks.pixel_px,
        east_m=landmarks.east_north_m[:, 0],
        north_m=landmarks.east_north_m[:, 1],
        source=np.full(n, -1, dtype=np.int64),
        group=alone,
        velocity_mps=np.zeros((n, 2)),
        sigma_m=landmarks.sigma_m,
        log=alone,
    )


def _joined(parts: Sequence[PointCorrespondences]) -> PointCorrespondences:
    names = PointCorrespondences.__dataclass_fields__
    return PointCorrespondences(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    )
