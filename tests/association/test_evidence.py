"""What an explanation costs, and when two of them are as good as each other."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from sightline.association import Association, associate
from sightline.association.associate import weigh
from sightline.association.evidence import clock_belief
from sightline.association.observations import TrackObservations, observe
from sightline.association.search import RecordingObservations
from sightline.camera.pinhole import Camera
from sightline.errors import FitError
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.types import Boxes, FloatArray

SIZE = (1280, 720)
CAMERA = Camera(5.0, 3.0, 0.4, 40.0, 1000.0, -0.1, 0.01, 0.0, 0.0, SIZE)
START_UTC_S = 1_717_236_000.0
DURATION_S = 240.0


def place(since_s: FloatArray) -> FloatArray:
    """(N, 2) of a vessel that turns to and fro before the camera, 45 to 280 m away."""
    phase = 2.0 * np.pi * since_s
    bearing = np.radians(
        CAMERA.heading_deg + 24.0 * np.sin(phase / 83.0 + 0.5) + 4.0 * np.sin(phase / 29.0)
    )
    distance = 110.0 * np.exp(0.75 * np.cos(phase / 61.0) + 0.2 * np.sin(since_s / 9.0))
    return distance[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)


def round_and_round(since_s: FloatArray) -> FloatArray:
    """(N, 2) of one that repeats itself every 40 s, as near."""
    phase = 2.0 * np.pi * since_s / 40.0
    bearing = np.radians(
        CAMERA.heading_deg + 20.0 * np.sin(phase + 0.5) + 4.0 * np.sin(2.0 * phase)
    )
    distance = 110.0 * np.exp(0.6 * np.cos(phase) + 0.1 * np.sin(3.0 * phase))
    return distance[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)


Goes = Callable[[FloatArray], FloatArray]


def seen(
    first_s: float = 0.0, last_s: float = DURATION_S, *, goes: Goes = place
) -> TrackObservations:
    """Its boxes, two a second."""
    since_s = np.arange(first_s, last_s, 0.5)
    where = goes(since_s)
    foot = CAMERA.project(*where.T)
    foot = foot + np.random.default_rng(1).normal(0.0, 1.0, foot.shape)
    half = 4000.0 / np.hypot(*where.T)
    column, row = foot.T
    return observe(
        Boxes.of(
            np.stack([column - half, row - half, column + half, row], axis=1),
            time_utc_s=START_UTC_S + since_s,
            track_id=np.ones(since_s.size, dtype=np.int64),
            source="detector",
        )
    )


def log(
    name: str,
    turned_deg: float = 0.0,
    north_m: float = 0.0,
    late_s: float = 0.0,
    *,
    goes: Goes = place,
) -> ReferenceTrajectory:
    """Its log, turned clockwise about the camera, moved north, or of another time."""
    since_s = np.arange(-80.0, DURATION_S + 80.0)
    sine, cosine = np.sin(np.radians(turned_deg)), np.cos(np.radians(turned_deg))
    path = goes(since_s - late_s) @ np.array([[cosine, -sine], [sine, cosine]])
    path[:, 1] += north_m
    return ReferenceTrajectory(name, START_UTC_S + since_s, path, np.full_like(path, np.nan))


def recognise(*logs: ReferenceTrajectory) -> Association:
    return associate([RecordingObservations("one", seen(), logs)], SIZE)


@pytest.mark.parametrize(("name", "turned_deg"), [("one", 0.0), ("other", 60.0)])
def test_each_of_two_logs_alone_explains_what_is_seen(name: str, turned_deg: float) -> None:
    """The camera of the other looks 60 degrees further to the right, and all is the same."""
    found = recognise(log(name, turned_deg))
    assert [one.vessel for one in found.found] == [name]
    heading_deg = CAMERA.heading_deg + turned_deg
    assert found.camera.heading_deg == pytest.approx(heading_deg, abs=1.0)


@pytest.mark.parametrize("order", [1, -1])
def test_two_logs_that_explain_it_alike_are_refused(order: int) -> None:
    """Nothing says which of two vessels is in view, nor where the camera looks."""
    logs = [log("one"), log("other", 60.0)][::order]
    with pytest.raises(
        FitError, match="two explanations are about as good as each other"
    ) as caught:
        recognise(*logs)
    assert "\n" not in str(caught.value)


def test_a_path_that_repeats_itself_does_not_tell_the_clock() -> None:
    """A clock that is off by a round explains it as well."""
    watches = [
        RecordingObservations(
            "one", seen(goes=round_and_round), (log("one", goes=round_and_round),)
        )
    ]
    with pytest.raises(FitError, match=r"about as good as each other: clocks .*40 s"):
        associate(watches, SIZE)
    # Where clocks are known to be nearer than a round there is only one.
    found = associate(watches, SIZE, largest_offset_s=15.0)
    assert found.offset_s["one"] == pytest.approx(0.0, abs=0.5)


def test_of_two_logs_the_one_that_goes_as_what_is_seen_is_told() -> None:
    """The other goes the same way, but not at the same time."""
    found = associate(
        [RecordingObservations("one", seen(), (log("one"), log("other", 60.0, late_s=150.0)))],
        SIZE,
        largest_offset_s=30.0,
    )
    assert [one.vessel for one in found.found] == ["one"]


def test_the_choice_among_vessels_is_paid() -> None:
    """One of four is log 4 less evident than the only one, where the others are never in view."""
    behind = [log(str(i), 180.0, north_m=-3000.0 * i) for i in (1, 2, 3)]
    alone, chosen = recognise(log("one")), recognise(log("one"), *behind)
    assert [one.vessel for one in chosen.found] == ["one"]
    assert alone.evidence - chosen.evidence == pytest.approx(np.log(4.0), abs=0.05)


def halves(recordings: int, late_s: float) -> list[RecordingObservations]:
    cuts = np.linspace(0.0, DURATION_S, recordings + 1)
    return [
        RecordingObservations(f"{i}", seen(first_s, last_s), (log("one", late_s=late_s),))
        for i, (first_s, last_s) in enumerate(pairwise(cuts.tolist()))
    ]


@pytest.mark.parametrize("recordings", [1, 2])
def test_a_clock_that_may_be_anywhere_is_paid(recordings: int) -> None:
    """Twice the time in which it may lie is log 2, once, since one camera has one clock."""
    watches = halves(recordings, -18.0)
    narrow, wide = (associate(watches, SIZE, largest_offset_s=s) for s in (20.0, 40.0))
    assert len(narrow.found) == len(wide.found) == recordings
    assert narrow.evidence - wide.evidence == pytest.approx(np.log(2.0), abs=0.15)


def test_a_clock_that_is_right_was_believed_to_be() -> None:
    """Half of all clocks are right, however far others may be off: room for them costs nothing."""
    watches = halves(1, 0.0)
    narrow, wide = (associate(watches, SIZE, largest_offset_s=s) for s in (20.0, 40.0))
    assert narrow.evidence - wide.evidence == pytest.approx(0.0, abs=0.1)
    off = associate(halves(1, -18.0), SIZE, largest_offset_s=40.0)
    # Densities at 0 and 18 s of a Cauchy and a uniform distribution, half each.
    scale_s = 0.5 * np.sqrt(2.0)
    density = [
        0.5 / (np.pi * scale_s * (1.0 + (offset_s / scale_s) ** 2)) + 0.5 / 80.0
        for offset_s in (0.0, 18.0)
    ]
    expected = np.log(density[0] / density[1])
    assert wide.evidence - off.evidence == pytest.approx(expected, abs=0.6)


def test_a_belief_in_clocks_integrates_to_one() -> None:
    """`cost` has a normal distribution as wide as the room; the belief is what differs from it."""
    largest_s = 40.0
    offset_s = np.linspace(-largest_s, largest_s, 16001)
    density = np.exp(
        [clock_belief(SimpleNamespace(offset_s=np.array([one])), largest_s) for one in offset_s]
    ) / (np.sqrt(2.0 * np.pi) * largest_s / np.sqrt(3.0))
    whole = np.trapezoid(density, offset_s)
    beyond = 1.0 / np.pi * np.arctan(0.5 * np.sqrt(2.0) / largest_s)
    assert whole == pytest.approx(1.0 - beyond, abs=1e-4)


def test_what_is_refused_can_be_weighed_by_eye() -> None:
    """Of two logs that explain it alike each is a candidate, at even odds with the other."""
    logs = (log("one"), log("other", 60.0))
    weighed = weigh([RecordingObservations("one", seen(), logs)], SIZE)
    first, second, *rest = weighed
    names = {each.vessel for one in (first, second) for each in one.association.found}
    assert names == {"one", "other"}
    assert first.evidence - second.evidence < 2.0
    assert first.probability + second.probability > 0.99
    turned = second.association.camera.heading_deg - first.association.camera.heading_deg
    assert abs((turned + 180.0) % 360.0 - 180.0) == pytest.approx(60.0, abs=2.0)
    # Odds are those of the evidence, with none of them at 0 nats.
    nats = np.array([0.0, *(one.evidence for one in weighed)])
    shares = 1.0 / np.exp(nats[None, :] - nats[:, None]).sum(axis=1)
    assert [one.probability for one in weighed] == pytest.approx(shares[1:].tolist(), abs=1e-9)
    assert [one.evidence for one in rest] == sorted((one.evidence for one in rest), reverse=True)


def test_the_likeliest_that_is_weighed_is_the_one_that_is_told() -> None:
    told = recognise(log("one"))
    best = weigh([RecordingObservations("one", seen(), (log("one"),))], SIZE)[0]
    assert best.evidence == pytest.approx(told.evidence)
    assert best.association.offset_s == told.offset_s
    assert [one.rows.tolist() for one in best.association.found] == [
        one.rows.tolist() for one in told.found
    ]
