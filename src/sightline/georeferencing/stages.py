"""A fit in stages, each of which is looked at before it is kept.

A camera model is first fitted with the usual noise, taken as known and independent: that estimates
the least, and is moved the least by a few wrong fixes or boxes. By it the fixes of the logs are
weighed, and those that cannot be where they say are left out. The fit itself follows, which
estimates the noise as well, and at last one that learns from boxes in long gaps of the logs too. A
stage that has a not-finite number in it, that places fewer than half of the boxes, or that places
them worse than the first solution did, is no success: the last good one is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from scipy.linalg import LinAlgError

from sightline.camera.calibration import CameraFit
from sightline.camera.parameters import PARAMETERS
from sightline.camera.priors import CameraPrior
from sightline.camera.stated_place import (
    astray,
    doubtful,
    elsewhere,
    in_words,
    mixed,
    relaxed,
    share_elsewhere,
)
from sightline.errors import FitError
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.correspondences import ALMOST_ALL, Correspondences
from sightline.georeferencing.log_weighing import WrongFix, sentences, wrong_fixes
from sightline.georeferencing.models import BoxModel, CameraModelType, ModelType, Observations
from sightline.georeferencing.placement import Placement
from sightline.types import BoolArray, FloatArray, IntArray, utc_text

LEAST_PLACED = 0.5
"""A model that places a smaller share of the boxes that it learned from is no success."""

# Errors may grow by this share, and by this many of the first solution's standard deviations: the
# noise that is estimated weighs near boxes and far ones otherwise than the usual one does.
_WORSE_SHARE = 1.3
_WORSE_SIGMAS = 0.15
_WITHOUT_RESIDUAL = (
    "What the camera leaves of the errors could not be learned: the camera alone places the boxes."
)
_USUAL_NOISE = (
    "How far boxes and log are off could not be estimated: with it the boxes would be placed worse "
    "than by the first solution, which stands with the usual noise."
)
# Of the placed share: a box or two at the horizon come and go.
_FEWER = 0.05
_MOST_ROUNDS = 4
# A box that is placed so far from its log is worth a look.
_FAR_SIGMAS = 4.5
# Nobody sees a boat from further away.
_FARTHEST_M = 100e3
_FEWEST_TO_WEIGH = 8
# Of where the camera stands: what is likelier is taken, and what is as good as out of the question
# is in no ellipse.
_LIKELIER, _NEGLIGIBLE = 0.5, 0.01


Fitted = TypeVar("Fitted")
"""What a fit gives."""


@dataclass(frozen=True, eq=False)
class StagedFit:
    """A fitted model, what it learned from, and what is to be said of the way there.

    Attributes:
        model: Fitted.
        rows: (K,) int64, correspondences that it learned from.
        statements: Sentences for people.
        estimated: The camera by the noise that is estimated, from certain correspondences, whether
            it was kept or not; None where there is none.
        taught: (K,) int64, those that it learned from.
    """

    model: BoxModel
    rows: IntArray
    statements: tuple[str, ...] = ()
    estimated: CameraFit | None = None
    taught: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))


@dataclass(frozen=True)
class Quality:
    """How well a model places the boxes that it learned from.

    Attributes:
        placed: Share of the boxes that have a place, 0 to 1.
        typical: Median error, in standard deviations of a first solution; infinite counts what has
            no place.
        finite: Whether all places and covariances that there are, are numbers.
    """

    placed: float
    typical: float
    finite: bool

    @classmethod
    def of(cls, placed: Placement, east_north_m: FloatArray, unit_m2: FloatArray) -> Quality:
        """The quality of places.

        Args:
            placed: N places.
            east_north_m: (N, 2) where the logs say.
            unit_m2: (N, 2, 2) in which errors are measured.
        """
        known = np.isfinite(placed.east_north_m).all(axis=1)
        spread = placed.covariance_m2[known]
        size = np.full(known.size, np.inf)
        off = (placed.east_north_m - east_north_m)[known]
        solved = np.linalg.solve(unit_m2[known], off[:, :, None])[:, :, 0]
        size[known] = np.sqrt(0.5 * np.sum(off * solved, axis=1))
        return cls(
            placed=float(known.mean()) if known.size else 0.0,
            typical=float(np.median(size)) if known.size else np.inf,
            finite=bool(np.isfinite(spread).all() and np.isfinite(size[known]).all()),
        )

    @property
    def success(self) -> bool:
        """Whether a model of this quality may be kept."""
        return self.finite and self.placed >= LEAST_PLACED

    def holds_against(self, first: Quality) -> bool:
        """Whether it is a success, and no worse than an earlier one."""
        return (
            self.success
            and self.placed >= first.placed - _FEWER
            and self.typical <= _WORSE_SHARE * first.typical + _WORSE_SIGMAS
        )


def fit_in_stages(kind: ModelType, observations: Observations, *, seed: int = 0) -> StagedFit:
    """Fit a model in stages, from where the camera is said to stand, or where the data wants it.

    Args:
        kind: What is fitted.
        observations: What there is to learn from.
        seed: Of whatever is random.

    Raises:
        FitError: There is too little, or no stage is a success; says what is wrong, and which fix
            it would look at first.
    """
    far = _far_away(observations)
    if far:
        raise FitError(far)
    staged = _staged(kind, observations, seed)
    stated = observations.position_known and not observations.moving
    if not stated or not isinstance(kind, CameraModelType) or not staged.taught.size:
        return staged
    if staged.estimated is not None and not doubtful(staged.estimated):
        return staged
    return _where_the_data_wants(kind, observations, staged, seed)


def _where_the_data_wants(
    kind: CameraModelType, observations: Observations, staged: StagedFit, seed: int
) -> StagedFit:
    """A fit with the camera elsewhere, if the data prefers that, and what is to be said of it."""
    other = replace(observations, prior=elsewhere(observations.prior))
    # The camera alone settles where it stands.
    plain = replace(kind, residual=False)
    wide = _attempt(lambda: plain.fit(_of(other, staged.taught), seed=seed))
    stated, apart = staged.estimated, None if wide is None else wide.camera_fit
    if stated is not None and (apart is None or astray(apart, stated)):
        apart = relaxed(stated)
    if apart is None:
        return staged
    share = share_elsewhere(apart, stated)
    found = _attempt(lambda: _staged(kind, other, seed)) if share > _LIKELIER else None
    said = in_words(apart, share, taken=found is not None)
    if found is not None:
        staged, apart, share = found, stated, 1.0 - share
    model = staged.model
    if apart is not None and share > _NEGLIGIBLE and isinstance(model, CameraRegressor):
        staged = replace(staged, model=model.with_fit(mixed(model.camera_fit, apart, share)))
    return replace(staged, statements=(*((said,) if said else ()), *staged.statements))


def _staged(kind: ModelType, observations: Observations, seed: int) -> StagedFit:
    pairs = observations.correspondences
    certain = pairs.certain_rows()
    if not isinstance(kind, CameraModelType) or not len(pairs):
        return _in_one(kind, observations, certain, seed)
    try:
        first = _First.of(kind, observations, certain, seed)
    except FitError:
        # Noise that is estimated may find what the usual one does not.
        return _in_one(kind, observations, certain, seed)
    model, said, full = _fitted(kind, _of(observations, first.rows), first, seed)
    rows, statements = first.rows, [*sentences(first.wrong), *said]
    if certain.size < ALMOST_ALL * len(pairs):
        more = np.setdiff1d(np.flatnonzero(~_beside(pairs, first.wrong)), certain)
        whole = np.sort(np.concatenate([first.rows, more]))
        known = _of(observations, first.rows)
        wider = _attempt(lambda: kind.fit(_of(observations, whole), seed=seed))
        kept = wider is not None and first.quality_of(wider, known).holds_against(
            first.quality_of(model, known)
        )
        if wider is not None and kept:
            model, rows = wider, whole
        # Places of tracks are unsure everywhere, and no gap makes them so.
        if not pairs.of_tracks:
            statements.append(_on_gaps(pairs, rows))
    estimated = None if full is None else full.camera_fit
    return StagedFit(model, rows, tuple(statements), estimated, first.rows)


def _in_one(kind: ModelType, observations: Observations, rows: IntArray, seed: int) -> StagedFit:
    """A fit that has but one stage."""
    part = _of(observations, rows)
    model = kind.fit(part, seed=seed)
    if rows.size:
        _check(model, part)
    return StagedFit(model, rows, (), model.camera_fit, rows)


def _beside(pairs: Correspondences, wrong: tuple[WrongFix, ...]) -> BoolArray:
    """(N,) whether a wrong fix is on either side of a box."""
    out = np.zeros(len(pairs), dtype=bool)
    for fix in wrong:
        at = (pairs.fix_time_utc_s == fix.time_utc_s).any(axis=1)
        out |= at & (pairs.recording == fix.recording)
    return out


@dataclass(frozen=True, eq=False)
class _First:
    """First solution of a fit, and the fixes that it shows to be wrong.

    Attributes:
        model: Of the usual noise.
        rows: (K,) correspondences that it learned from in the end.
        wrong: These fixes.
        unit_m2: (K, 2, 2) covariances of its places, in which errors are measured.
        quality: Of its places.
    """

    model: CameraRegressor
    rows: IntArray
    wrong: tuple[WrongFix, ...]
    unit_m2: FloatArray
    quality: Quality

    @classmethod
    def of(
        cls, kind: CameraModelType, observations: Observations, rows: IntArray, seed: int
    ) -> _First:
        """The first solution, from what wrong fixes do not spoil."""
        wrong: tuple[WrongFix, ...] = ()
        for left in reversed(range(_MOST_ROUNDS)):
            part = _of(observations, rows)
            model = kind.first(part, seed=seed)
            placed = _placed(model, part)
            if not left or rows.size < _FEWEST_TO_WEIGH:
                break
            spoilt, found = wrong_fixes(part.correspondences, placed)
            if not found:
                break
            wrong, rows = (*wrong, *found), rows[~spoilt]
        unit_m2 = np.where(np.isfinite(placed.covariance_m2), placed.covariance_m2, np.eye(2))
        quality = Quality.of(placed, part.correspondences.east_north_m, unit_m2)
        return cls(model, rows, wrong, unit_m2, quality)

    def quality_of(self, model: BoxModel, observations: Observations) -> Quality:
        """The quality of another model on the same boxes."""
        pairs = observations.correspondences
        return Quality.of(_placed(model, observations), pairs.east_north_m, self.unit_m2)


def _fitted(
    kind: CameraModelType, observations: Observations, first: _First, seed: int
) -> tuple[BoxModel, tuple[str, ...], CameraRegressor | None]:
    """The last good stage of a fit, what is to be said of it, and what came of estimated noise."""
    full = _attempt(lambda: kind.fit(observations, seed=seed))
    if full is not None and first.quality_of(full, observations).holds_against(first.quality):
        return full, (), full
    if full is not None and kind.residual:
        plain = full.without_residual()
        if first.quality_of(plain, observations).holds_against(first.quality):
            return plain, (_WITHOUT_RESIDUAL,), full
    if not first.quality.success:
        raise FitError(_what_is_wrong(observations, first))
    worst = _where(observations, first)
    return first.model, (_USUAL_NOISE, *((f"Look at the log{worst}.",) if worst else ())), full


def _attempt(fit: Callable[[], Fitted]) -> Fitted | None:
    """What a fit gives, None where the fit fails: then an earlier stage stands."""
    try:
        return fit()
    except (FitError, LinAlgError):
        return None


def _of(observations: Observations, rows: IntArray) -> Observations:
    pairs = observations.correspondences
    return replace(
        observations,
        correspondences=pairs if rows.size == len(pairs) else pairs[rows],
        above_m=observations.above_m[rows],
    )


def _placed(model: BoxModel, observations: Observations) -> Placement:
    boxes = observations.correspondences.boxes
    return model.locate(boxes.xyxy_px, boxes.source, observations.above_m)


def _check(model: BoxModel, observations: Observations) -> None:
    """Raise FitError where a model without stages is no success."""
    placed = _placed(model, observations)
    unit = np.tile(np.eye(2), (len(placed.east_north_m), 1, 1))
    quality = Quality.of(placed, observations.correspondences.east_north_m, unit)
    if not quality.finite:
        raise FitError("a place that the model states, or its covariance, is not a number")
    if not quality.success:
        raise FitError(
            f"the model places {100.0 * quality.placed:.0f} % of the boxes that it learned from; "
            "check the log, the clock and the boxes"
        )


def _what_is_wrong(observations: Observations, first: _First) -> str:
    """What a fit without a good stage says."""
    prior = observations.prior or CameraPrior()
    fit, pairs = first.model.camera_fit, observations.correspondences
    share = f"{100.0 * first.quality.placed:.0f} %"
    said = (
        f"no camera explains the boxes and fixes: the best places {share} of the boxes that it "
        "learned from"
    )
    late = fit.clock_offset_s
    if late.size and np.abs(late).max() > 2.0 * prior.clock_sigma_s:
        worst = int(np.argmax(np.abs(late)))
        name = np.unique(pairs.recording)[fit.clock_groups[worst]]
        return (
            f"{said}; the clock of recording {name} seems {abs(late[worst]):.1f} s or more "
            f"{'behind' if late[worst] > 0 else 'ahead of'} the log: check it first"
        )
    moved = np.hypot(*fit.vector[[PARAMETERS.index("east_m"), PARAMETERS.index("north_m")]])
    if observations.position_known and moved > 3.0 * prior.position_sigma_m:
        return (
            f"{said}; the camera seems to stand {moved:.0f} m from where the scene says: check "
            "[camera] latitude_deg and longitude_deg first"
        )
    return f"{said}; look at the log first{_where(observations, first)}, then at the clock"


def _where(observations: Observations, first: _First) -> str:
    """Where in a log one would look first: at the box that is placed furthest from it, if any is.

    In standard deviations; nothing where none is far.
    """
    pairs, placed = observations.correspondences, _placed(first.model, observations)
    off = placed.east_north_m - pairs.east_north_m
    standard = np.sqrt(np.sum(off * np.linalg.solve(first.unit_m2, off[:, :, None])[:, :, 0], 1))
    if not (standard > _FAR_SIGMAS).any():
        return ""
    worst = int(np.nanargmax(standard))
    frame, time = int(pairs.boxes.frame[worst]), float(pairs.boxes.time_utc_s[worst])
    when = f" at {utc_text(time)}" if np.isfinite(time) else ""
    which = f", frame {frame}" if frame >= 0 else ""
    return (
        f"{when} (recording {pairs.recording[worst]}{which}), which is "
        f"{np.hypot(*off[worst]):.0f} m from where the box says"
    )


def _far_away(observations: Observations) -> str:
    """What is to be said of a log that is nowhere near its camera."""
    pairs = observations.correspondences
    if not observations.position_known or observations.moving or not len(pairs):
        return ""
    away_m = float(np.median(np.hypot(*pairs.east_north_m.T)))
    if away_m < _FARTHEST_M:
        return ""
    return (
        f"the log is {away_m / 1000.0:.0f} km from the camera: check [camera] latitude_deg and "
        "longitude_deg, and whether the log's latitude and longitude are swapped"
    )


def _on_gaps(pairs: Correspondences, rows: IntArray) -> str:
    """What is to be said of boxes in long gaps of the logs."""
    used: BoolArray = np.zeros(len(pairs), dtype=bool)
    used[rows] = True
    gaps = pairs.fix_sigma_m > 0.0
    span_s = float(np.median(np.diff(pairs.fix_time_utc_s[gaps], axis=1)))
    off_m = pairs.fix_sigma_m[gaps & used]
    reach = f", unsure by up to {off_m.max():.1f} m" if off_m.size else ""
    return (
        f"{int(gaps.sum())} boxes lie in gaps of the log, of {span_s:.0f} s in the median: a "
        f"motion model says where the vessel was then; {int((gaps & used).sum())} of them taught"
        f"{reach}."
    )
