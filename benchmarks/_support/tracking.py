r"""How well targets are told apart: HOTA and IDF1 of boxes with track ids against the true ones.

HOTA (Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", *IJCV*
129, 2021) is the geometric mean of how well targets are found and how well their identities are
kept, averaged over 19 thresholds of the similarity of a box with the true one. IDF1 (Ristani et
al., "Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking", 2016) is the
F1 score of boxes under the best one-to-one assignment of whole tracks to targets.

The definitions, down to the order of ties, are those of TrackEval, which
``benchmarks/tracking.py`` runs beside these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from sightline.errors import InputError
from sightline.overlap import iou
from sightline.types import NO_TRACK, Boxes, FloatArray, IntArray

_THRESHOLDS = np.arange(0.05, 0.99, 0.05)
_IDENTITY_THRESHOLD = 0.5
_EPSILON = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class TrackingScore:
    """How well targets are told apart; shares, 0 to 1, NaN where there is nothing to score.

    Attributes:
        hota: Higher order tracking accuracy.
        deta: Its detection accuracy: boxes found, boxes missed, boxes invented.
        assa: Its association accuracy: whether boxes of one target are of one track.
        idf1: F1 score of identities.
        idp: Share of the tracks' boxes that carry the right identity.
        idr: Share of the true boxes that carry the right identity.
        targets: How many true identities there are.
        tracks: How many track ids there are.
    """

    hota: float
    deta: float
    assa: float
    idf1: float
    idp: float
    idr: float
    targets: int
    tracks: int


def score_tracking(truth: Boxes, found: Boxes) -> TrackingScore:
    """Score boxes with track ids, similar as they overlap (intersection over union).

    Args:
        truth: Every true box, with its frame and the identity of its target.
        found: What a tracker made of the same frames. Rows without a track id are left out.

    Raises:
        InputError: A true box has no identity, or an identity has two boxes in one frame.
    """
    if (truth.track_id == NO_TRACK).any():
        raise InputError("a true box has no track id, so identities cannot be scored")
    found = found[found.track_id != NO_TRACK]
    for what, boxes in (("true", truth), ("found", found)):
        pairs = np.stack([boxes.frame, boxes.track_id], axis=1)
        if np.unique(pairs, axis=0).shape[0] < len(boxes):
            raise InputError(f"the {what} boxes have an identity twice in one frame")
    frames = np.unique(np.concatenate([truth.frame, found.frame]))
    parts = [_by_frame(boxes, frames) for boxes in (truth, found)]
    similarity = [
        iou(truth.xyxy_px[own, None], found.xyxy_px[theirs])
        for own, theirs in zip(*parts, strict=True)
    ]
    return score_identities(
        [truth.track_id[rows] for rows in parts[0]],
        [found.track_id[rows] for rows in parts[1]],
        similarity,
    )


def _by_frame(boxes: Boxes, frames: IntArray) -> list[IntArray]:
    order = np.argsort(boxes.frame, kind="stable")
    cuts = np.searchsorted(boxes.frame[order], frames[1:])
    return list(np.split(order, cuts)) if frames.size else []


def score_identities(
    true_ids: Sequence[IntArray], found_ids: Sequence[IntArray], similarity: Sequence[FloatArray]
) -> TrackingScore:
    """Score identities, moment by moment, whatever the similarity is made of.

    Args:
        true_ids: For each moment the identities that are there, (G,).
        found_ids: For each moment the track ids, (T,).
        similarity: For each moment (G, T), 0 (nothing in common) to 1 (the same).
    """
    targets, true_rows = _numbered(true_ids)
    tracks, found_rows = _numbered(found_ids)
    true_count = np.bincount(np.concatenate([*true_rows, np.empty(0, np.int64)]), minlength=targets)
    found_count = np.bincount(
        np.concatenate([*found_rows, np.empty(0, np.int64)]), minlength=tracks
    )
    boxes = (int(true_count.sum()), int(found_count.sum()))
    if 0 in boxes:
        nothing = 0.0 if any(boxes) else float("nan")
        return TrackingScore(*(nothing,) * 6, targets=targets, tracks=tracks)

    moments = list(zip(true_rows, found_rows, similarity, strict=True))
    alike = np.zeros((targets, tracks))
    overlapping = np.zeros((targets, tracks))
    for own, theirs, sim in moments:
        union = sim.sum(axis=0) + sim.sum(axis=1)[:, None] - sim
        alike[np.ix_(own, theirs)] += np.where(union > _EPSILON, sim / np.maximum(union, 1e-12), 0)
        overlapping[np.ix_(own, theirs)] += sim >= _IDENTITY_THRESHOLD
    either = true_count[:, None] + found_count[None, :]
    alignment = alike / np.maximum(either - alike, _EPSILON)

    matched = np.zeros((_THRESHOLDS.size, targets, tracks))
    for own, theirs, sim in moments:
        rows, columns = linear_sum_assignment(alignment[np.ix_(own, theirs)] * sim, maximize=True)
        good = sim[rows, columns] >= _THRESHOLDS[:, None] - _EPSILON
        # An identity is there once in a moment, so no cell is added to twice.
        matched[:, own[rows], theirs[columns]] += good
    hits = matched.sum(axis=(1, 2))
    deta = hits / (sum(boxes) - hits)
    shared = matched**2 / np.maximum(either - matched, 1.0)
    assa = shared.sum(axis=(1, 2)) / np.maximum(hits, 1.0)

    rows, columns = linear_sum_assignment(overlapping, maximize=True)
    right = float(overlapping[rows, columns].sum())
    return TrackingScore(
        hota=float(np.sqrt(deta * assa).mean()),
        deta=float(deta.mean()),
        assa=float(assa.mean()),
        idf1=2.0 * right / sum(boxes),
        idp=right / boxes[1],
        idr=right / boxes[0],
        targets=targets,
        tracks=tracks,
    )


def _numbered(ids: Sequence[IntArray]) -> tuple[int, list[IntArray]]:
    """How many distinct ids there are, and each as its rank among them."""
    flat = np.concatenate([*ids, np.empty(0, np.int64)])
    known, rank = np.unique(flat, return_inverse=True)
    cuts = np.cumsum([len(part) for part in ids])[:-1]
    return known.size, list(np.split(rank.astype(np.int64), cuts)) if ids else []
