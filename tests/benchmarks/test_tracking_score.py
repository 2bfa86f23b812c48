from __future__ import annotations

import numpy as np
import pytest
from _support.tracking import score_identities, score_tracking

from sightline.errors import InputError
from sightline.types import NO_TRACK, Boxes

# TrackEval 1.3.0 of `_random_scene(seed)`: HOTA, DetA, AssA, IDF1, IDP, IDR.
TRACKEVAL = {
    0: (0.286938004374, 0.481479565845, 0.171301987702, 0.406451612903, 0.379518072289, 0.4375),
    1: (0.24940184459, 0.470869286561, 0.132776531609, 0.356302521008, 0.348684210526, 0.364261168),
    2: (0.2804815852, 0.460430369144, 0.171857269091, 0.379194630872, 0.36569579288, 0.393728223),
    3: (0.276369745236, 0.468971647844, 0.163271927775, 0.377179080824, 0.34593023256, 0.414634146),
}


def _random_scene(seed: int) -> tuple[list, list, list]:
    """Six targets and nine tracks that come and go, and swap half-way."""
    rng = np.random.default_rng(seed)
    true, found, similarity = [], [], []
    for t in range(60):
        own, their = np.flatnonzero(rng.random(6) < 0.8), np.flatnonzero(rng.random(9) < 0.6)
        alike = rng.random((own.size, their.size)) ** 2
        for i, a in enumerate(own):
            for j, b in enumerate(their):
                if b == (a + (t > 30) * (a % 2)) % 9:
                    alike[i, j] = rng.uniform(0.4, 1)
        true.append(own)
        found.append(their)
        similarity.append(alike)
    return true, found, similarity


@pytest.mark.parametrize("seed", TRACKEVAL)
def test_the_figures_are_those_of_trackeval(seed: int) -> None:
    got = score_identities(*_random_scene(seed))
    figures = (got.hota, got.deta, got.assa, got.idf1, got.idp, got.idr)
    assert figures == pytest.approx(TRACKEVAL[seed], abs=1e-9)
    assert (got.targets, got.tracks) == (6, 9)


def _two(frames: int) -> Boxes:
    boxes = [[0.0, 0.0, 10.0, 10.0], [50.0, 50.0, 60.0, 60.0]] * frames
    return Boxes.of(boxes, frame=np.repeat(np.arange(frames), 2), track_id=[1, 2] * frames)


def test_what_is_right_throughout_scores_one_whatever_its_ids_are() -> None:
    truth = _two(10)
    got = score_tracking(truth, truth.with_columns(track_id=truth.track_id * 7))
    assert (got.hota, got.deta, got.assa, got.idf1) == pytest.approx((1.0,) * 4)


def test_an_identity_broken_in_half_halves_the_association() -> None:
    truth = _two(10)
    late = truth.frame >= 5
    got = score_tracking(truth, truth.with_columns(track_id=truth.track_id + 2 * late))
    assert (got.deta, got.assa) == pytest.approx((1.0, 0.5))
    assert got.hota == pytest.approx(np.sqrt(0.5))
    assert (got.idf1, got.idp, got.idr) == pytest.approx((0.5,) * 3)
    assert (got.targets, got.tracks) == (2, 4)


def test_invented_boxes_cost_detection_and_boxes_without_an_id_are_none() -> None:
    truth = _two(4)
    clutter = Boxes.of([[200.0, 0.0, 210.0, 10.0]] * 4, frame=np.arange(4), track_id=9)
    got = score_tracking(truth, Boxes.concatenate([truth, clutter]))
    assert (got.deta, got.assa) == pytest.approx((8.0 / 12.0, 1.0))
    unnamed = clutter.with_columns(track_id=np.full(4, NO_TRACK))
    assert score_tracking(truth, Boxes.concatenate([truth, unnamed])).hota == pytest.approx(1.0)


def test_nothing_found_scores_nothing_and_nothing_asked_is_not_a_number() -> None:
    nothing = Boxes.of([])
    assert score_tracking(_two(3), nothing).hota == 0.0
    assert score_tracking(nothing, _two(3)).idf1 == 0.0
    assert np.isnan(score_tracking(nothing, nothing).hota)


def test_identities_that_cannot_be_scored_are_refused() -> None:
    truth = _two(2)
    with pytest.raises(InputError, match="no track id"):
        score_tracking(truth.with_columns(track_id=[1, 2, 1, NO_TRACK]), truth)
    with pytest.raises(InputError, match="found boxes have an identity twice"):
        score_tracking(truth, truth.with_columns(track_id=[1, 1, 1, 2]))
