"""Association of detections with logged vessels, without any box drawn by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.association.evidence import Match, clock_belief, cost, goes_along, matches
from sightline.association.refine import Explanation, Refiner
from sightline.association.search import Candidate, RecordingObservations, candidates
from sightline.camera.parameters import HEADING
from sightline.camera.pinhole import Camera
from sightline.clock_offset import LARGEST_OFFSET_S
from sightline.errors import FitError
from sightline.threads import on_one_thread
from sightline.types import BoolArray, FloatArray, IntArray

LEAST_EVIDENCE = 0.0
LEAST_LEAD = 2.0
"""An explanation counts where it is likelier than none by the first, and by the second than the
next one that says something else; in nats."""

# Within so many standard deviations of where the log says it is, a box is a part of the vessel.
_GATE = 6.0
_NARROW_GATE = 2.5
_LASTING = 10
_BRIDGE_S = 15.0
_HULL_M = 6.0
_HULL_ROW_M = 0.6
_MOST_CANDIDATES = 12
_MOST_WITH_FEED = 6
_SAME_OFFSET_S = 4.0
_SAME_HEADING_DEG = 4.0


@dataclass(frozen=True, eq=False)
class Found:
    """A logged vessel that was recognised in a recording.

    Attributes:
        recording: Name of the recording.
        vessel: Name of the log; an MMSI where it is of an AIS feed.
        log_likelihood_ratio: Of what is seen given the log, in nats.
        rows: (K,) observations of the recording that were matched, in the order of time.
        taken: (M,) bool, which boxes of the recording are the vessel's.
        first_utc_s: When it is first seen, by the camera's clock.
        last_utc_s: When it is last seen.
    """

    recording: str
    vessel: str
    log_likelihood_ratio: float
    rows: IntArray
    taken: BoolArray
    first_utc_s: float
    last_utc_s: float


@dataclass(frozen=True, eq=False)
class Association:
    """Detections associated with logged vessels, and the evidence for it.

    Attributes:
        watches: The recordings.
        camera: That explains all of them.
        found: The vessels, by recording.
        offset_s: By recording, what is to be added to its times to agree with the log (in the
            camera's time zone): of the other sign than `ahead_s`.
        offset_sigma_s: By recording, its standard deviation.
        evidence: Log-likelihood ratio of this explanation against no logged vessel in view, in
            nats.
        runner_up: The same of the next best explanation that says something else; minus infinity
            where there is none.
        statements: Sentences for people.
    """

    watches: tuple[RecordingObservations, ...]
    camera: Camera
    found: tuple[Found, ...]
    offset_s: Mapping[str, float]
    offset_sigma_s: Mapping[str, float]
    evidence: float
    runner_up: float
    statements: tuple[str, ...]

    def ahead_s(self, recording: str) -> float:
        """How far a recording's times are ahead of the log's, with the camera's time zone."""
        watch = next(watch for watch in self.watches if watch.name == recording)
        return watch.zone_s - self.offset_s[recording]


@dataclass(frozen=True, eq=False)
class Weighed:
    """An explanation that was weighed, however likely.

    Attributes:
        association: What it takes for the logged vessels, with its camera and clocks.
        evidence: Log-likelihood ratio against no logged vessel in view, in nats.
        probability: Of it among all that were weighed and that there is none, equally likely
            before any data.
    """

    association: Association
    evidence: float
    probability: float


@dataclass(frozen=True, eq=False)
class _Judged:
    explanation: Explanation
    matches: list[Match]
    evidence: float


@on_one_thread
def associate(
    watches: Sequence[RecordingObservations],
    image_size_px: tuple[int, int],
    *,
    largest_offset_s: float = LARGEST_OFFSET_S,
) -> Association:
    """Associate detections with logged vessels.

    Args:
        watches: The recordings of one static camera, at the origin of the logs' plane within some
            metres.
        image_size_px: Width and height.
        largest_offset_s: Largest clock offset.

    Raises:
        FitError: What is seen cannot be told from something without a log, or two explanations
            are as good as each other.
    """
    watches, judged = _all_judged(watches, image_size_px, largest_offset_s)
    best = judged[0]
    belief = clock_belief(best.explanation, largest_offset_s)
    evidence = best.evidence + belief
    if not best.matches or evidence < LEAST_EVIDENCE:
        how = "nothing that is seen moves as a log says"
        if best.matches:
            more = "likelier" if evidence > 0.0 else "less likely"
            how = f"the best explanation is {abs(evidence):.0f} nats {more} than none"
        raise FitError(
            f"no logged vessel can be told from what else is seen: {how}; check the clock and that "
            "the log is of something in view, give more recordings, or draw boxes"
        )
    second = next((one for one in judged[1:] if _differ(best, one)), None)
    runner_up = second.evidence if second else -np.inf
    if best.evidence - runner_up < LEAST_LEAD:
        raise FitError(
            "two explanations are about as good as each other: clocks "
            f"{_offset(best):.0f} s or {_offset(second or best):.0f} s apart; give more "
            "recordings, a log of more turns, or draw boxes"
        )
    best = replace(best, evidence=evidence)
    return _summary(watches, image_size_px, best, float(runner_up + belief))


@on_one_thread
def weigh(
    watches: Sequence[RecordingObservations],
    image_size_px: tuple[int, int],
    *,
    largest_offset_s: float = LARGEST_OFFSET_S,
) -> tuple[Weighed, ...]:
    """Weigh all explanations that say something else, likely or not, the likeliest first.

    Where `associate` refuses, these are what somebody who looks may choose from.

    Args:
        watches: As for `associate`.
        image_size_px: Width and height.
        largest_offset_s: Largest clock offset.

    Raises:
        FitError: No recording has both boxes and a log.
    """
    watches, judged = _all_judged(watches, image_size_px, largest_offset_s)
    apart: list[_Judged] = []
    for one in judged:
        if one.matches and all(_differ(other, one) for other in apart):
            apart.append(one)
    if not apart:
        return ()
    # As `associate` has it: between several clocks the data decides alone.
    belief = clock_belief(apart[0].explanation, largest_offset_s)
    apart = [replace(one, evidence=one.evidence + belief) for one in apart]
    evidence = np.array([0.0, *(one.evidence for one in apart)])
    weights = np.exp(evidence - evidence.max())
    shares = (weights / weights.sum())[1:].tolist()
    return tuple(
        Weighed(_summary(watches, image_size_px, one, -np.inf), one.evidence, share)
        for one, share in zip(apart, shares, strict=True)
    )


def _all_judged(
    watches: Sequence[RecordingObservations],
    image_size_px: tuple[int, int],
    largest_offset_s: float,
) -> tuple[tuple[RecordingObservations, ...], list[_Judged]]:
    """The recordings that tell something, and all candidates, the likeliest first."""
    watches = tuple(watch for watch in watches if len(watch.seen) and watch.paths)
    if not watches:
        raise FitError("no recording has both boxes and a log, so nobody can be recognised")
    feed = max(len(watch.paths) for watch in watches) > 4
    starts = candidates(
        watches,
        image_size_px,
        largest_offset_s=largest_offset_s,
        count=_MOST_WITH_FEED if feed else _MOST_CANDIDATES,
    )
    refiner = Refiner(watches, image_size_px, largest_offset_s=largest_offset_s)
    judged = [_judge(refiner, start, image_size_px, largest_offset_s) for start in starts]
    judged.sort(key=lambda one: -one.evidence)
    if judged[0].matches:
        other = refiner.at_another_clock(judged[0].explanation, _SAME_OFFSET_S)
        rival = None if other is None else _judge(refiner, other, image_size_px, largest_offset_s)
        # One that ends where the best has ended is the same explanation.
        if rival is not None and _differ(judged[0], rival):
            judged.append(rival)
            judged.sort(key=lambda one: -one.evidence)
    return watches, judged


def _judge(
    refiner: Refiner, start: Candidate, image_size_px: tuple[int, int], largest_offset_s: float
) -> _Judged:
    """Refine a candidate, and weigh its evidence against its cost."""
    explanation = refiner.refine(start)
    found = matches(refiner.watches, explanation, image_size_px)
    evidence = sum(match.log_likelihood_ratio for match in found)
    evidence -= cost(explanation, largest_offset_s, image_size_px)
    return _also(refiner, _Judged(explanation, found, evidence), image_size_px)


def _also(refiner: Refiner, one: _Judged, image_size_px: tuple[int, int]) -> _Judged:
    """Add the vessels that an explanation misses because of their size.

    A long hull ends far nearer to the camera than where its receiver is. While nothing was known,
    room for that would have let in others; with the camera known it does not. Such a vessel counts
    as any other, less the choice between a short hull and a long one.
    """
    if not one.matches:
        return one
    known = one.explanation
    state = np.concatenate([known.vector, known.offset_s])
    wide = replace(
        known.noise,
        place_m=max(known.noise.place_m, _HULL_M),
        row_m=max(known.noise.row_m, _HULL_ROW_M),
    )
    wider = refiner.explain(state, wide)
    kept = list(one.matches)
    evidence = one.evidence
    standard = [apart.copy() for apart in known.standard]
    for match in matches(refiner.watches, wider, image_size_px):
        here = [other for other in kept if other.recording == match.recording]
        if any(other.vessel == match.vessel for other in here):
            continue
        if any(np.isin(match.rows, other.rows).any() for other in here):
            continue
        kept.append(match)
        evidence += match.log_likelihood_ratio - float(np.log(2.0))
        index = match.recording
        standard[index][match.vessel] = wider.standard[index][match.vessel]
    return _Judged(replace(known, standard=tuple(standard)), kept, evidence)


def _offset(one: _Judged) -> float:
    known = {match.recording for match in one.matches}
    return float(np.median([one.explanation.offset_s[i] for i in known] or [0.0]))


def _differ(one: _Judged, other: _Judged) -> bool:
    """Whether two explanations differ in the vessels, the clock or the camera."""
    mine = {(m.recording, m.vessel) for m in one.matches}
    theirs = {(m.recording, m.vessel) for m in other.matches}
    turn = np.degrees(one.explanation.vector[HEADING] - other.explanation.vector[HEADING])
    if abs((turn + 180.0) % 360.0 - 180.0) > _SAME_HEADING_DEG:
        return True
    if len(mine & theirs) < 0.5 * len(mine | theirs):
        return True
    both = sorted({r for r, _ in mine} & {r for r, _ in theirs})
    apart = np.abs(one.explanation.offset_s - other.explanation.offset_s)[both]
    return bool(apart.size and np.median(apart) > _SAME_OFFSET_S)


def _summary(
    watches: tuple[RecordingObservations, ...],
    image_size_px: tuple[int, int],
    best: _Judged,
    runner_up: float,
) -> Association:
    explanation = best.explanation
    found = []
    for match in best.matches:
        watch = watches[match.recording]
        others = [
            one.rows
            for one in best.matches
            if one is not match and one.recording == match.recording
        ]
        taken = _taken(
            watch,
            explanation.standard[match.recording][match.vessel],
            explanation.predicted_px[match.recording][match.vessel],
            match,
            np.concatenate([np.empty(0, dtype=np.int64), *others]),
        )
        times = watch.seen.boxes.time_utc_s[taken]
        found.append(
            Found(
                recording=watch.name,
                vessel=watch.paths[match.vessel].name,
                log_likelihood_ratio=match.log_likelihood_ratio,
                rows=match.rows,
                taken=taken,
                first_utc_s=float(times.min()),
                last_utc_s=float(times.max()),
            )
        )
    known = sorted({match.recording for match in best.matches})
    sigma = np.sqrt(np.diag(explanation.covariance)[explanation.vector.size :])
    vector = explanation.vector.copy()
    lead = (
        "none other was found"
        if runner_up == -np.inf
        else (f"the next best is {best.evidence - runner_up:.0f} nats less likely")
    )
    statements = [
        (
            f"Recognised without drawn boxes: {best.evidence:.0f} nats likelier than that no "
            f"logged vessel is in view; {lead}."
        )
    ]
    for one in found:
        name = one.vessel or "the logged vessel"
        statements.append(
            f"Recording {one.recording}: {name} is {int(one.taken.sum())} of {one.taken.size} "
            f"boxes, for {one.last_utc_s - one.first_utc_s:.0f} s."
        )
    return Association(
        watches=watches,
        camera=Camera.from_vector(vector, image_size_px),
        found=tuple(found),
        offset_s={watches[i].name: float(explanation.offset_s[i]) for i in known},
        offset_sigma_s={watches[i].name: float(sigma[i]) for i in known},
        evidence=float(best.evidence),
        runner_up=runner_up,
        statements=tuple(statements),
    )


def _taken(
    watch: RecordingObservations,
    standard: FloatArray,
    predicted: FloatArray,
    match: Match,
    others: IntArray,
) -> BoolArray:
    """(M,) whether a box is the vessel's: near its place, or of its tracks in gaps of the log."""
    seen = watch.seen
    near = standard < _GATE
    near[others] = False
    rows = np.zeros(len(seen), dtype=bool)
    rows[match.rows] = True
    if seen.followed:
        size = int(seen.track.max()) + 1
        own = np.bincount(seen.track[rows], minlength=size)
        foretold = np.bincount(seen.track[np.isfinite(standard)], minlength=size)
        mostly = (own > 0) & (own >= 0.5 * foretold)
        # A track that only meets the vessel's is not it.
        inside = np.bincount(seen.track[near], minlength=size) >= 0.5 * foretold
        inside[np.unique(seen.track[others])] = False
        for track in np.unique(seen.track[near & (inside & ~mostly)[seen.track]]):
            part = np.flatnonzero((seen.track == track) & np.isfinite(predicted[:, 0]))
            inside[track] = part.size < 3 or goes_along(seen, part, predicted)
        near &= (inside | mostly)[seen.track]
        # What was seen only for moments may be anything; it has to lie right there.
        lasting = np.bincount(seen.track, minlength=size) >= _LASTING
        near &= (standard < _NARROW_GATE) | (lasting | mostly)[seen.track]
        anchors = np.sort(seen.time_utc_s[rows])
        after = np.clip(np.searchsorted(anchors, seen.time_utc_s), 0, anchors.size - 1)
        before = np.maximum(after - 1, 0)
        away = np.minimum(
            np.abs(anchors[after] - seen.time_utc_s), np.abs(anchors[before] - seen.time_utc_s)
        )
        near |= mostly[seen.track] & np.isinf(standard) & (away < _BRIDGE_S)
    return np.asarray((near | rows)[seen.row_of_box])
