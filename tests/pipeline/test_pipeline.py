from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import ArrayLike

from sightline import Georeferencer, Scene, evaluate, fit, iter_tracks, run, track
from sightline.camera.state import ObservedBoxes
from sightline.errors import InputError
from sightline.formats import write_boxes
from sightline.geodesy import LocalPlane
from sightline.pipeline import sources
from sightline.pipeline.evaluate import leave_one_out, place_boxes
from sightline.pipeline.track import TrackSettings, _OpenTracks
from sightline.simulation import (
    BoxNoise,
    Harbour,
    HarbourSettings,
    SimulatedCamera,
    SimulationSettings,
)
from sightline.simulation.simulate import Simulation, simulate
from sightline.types import NO_TRACK, Boxes, FloatArray, Frame, LocatedBoxes, Positions, Track
from sightline.video import write_video

START_S = 1_700_000_000.0
SIZE_PX = (1000, 800)


@dataclass(frozen=True)
class FromAbove:
    """A camera that looks straight down: ten pixels of a box's foot are a metre."""

    plane: LocalPlane
    image_size_px: tuple[int, int] = SIZE_PX
    camera: None = None
    horizon_px: None = None
    moving: bool = False
    static_places: None = None

    def check_water(self, given: bool) -> None:
        assert not given

    def compensated(self, boxes: ObservedBoxes) -> ObservedBoxes:
        return boxes

    def place_compensated(self, boxes: ObservedBoxes) -> LocatedBoxes:
        xyxy, n = boxes.xyxy_px, len(boxes)
        positions = Positions(
            east_m=0.05 * (xyxy[:, 0] + xyxy[:, 2]),
            north_m=0.1 * (SIZE_PX[1] - xyxy[:, 3]),
            covariance_m2=np.tile(0.04 * np.eye(2), (n, 1, 1)),
            extrapolated=np.zeros(n, dtype=bool),
            plane=self.plane,
        )
        return LocatedBoxes.at(boxes, positions)


QUICK = TrackSettings(trajectory="paper")
MODEL = cast(Georeferencer, FromAbove(LocalPlane(32.7, -117.2)))


def crossing(
    y_px: float, times_s: ArrayLike, *, speed_px_s: float = 8.0, track_id: int = -1, seed: int = 0
) -> Boxes:
    """The boxes of a target that crosses the picture from left to right, a little noisy."""
    times = np.asarray(times_s, dtype=float)
    noise = np.random.default_rng(seed).normal(0.0, 0.5, (len(times), 2))
    x = 20.0 + speed_px_s * (times - np.min(times, initial=np.inf)) + noise[:, 0]
    y = y_px + noise[:, 1]
    return Boxes.of(
        np.stack([x, y - 20.0, x + 40.0, y], axis=1),
        frame=np.round(10.0 * times).astype(int),
        time_utc_s=START_S + times,
        track_id=track_id,
    )


def in_order(parts: Iterable[Boxes]) -> Boxes:
    boxes = Boxes.concatenate(list(parts))
    return boxes[np.argsort(boxes.time_utc_s, kind="stable")]


def traffic(*, ids: bool) -> Boxes:
    """Five targets that come and go, two of them twice."""
    spans = [(0, 30), (10, 50), (12, 20), (40, 70), (60, 80)]
    parts = [
        crossing(
            100.0 + 120.0 * i,
            np.arange(5 * first, 5 * last) / 5.0,
            track_id=i + 3 if ids else -1,
            seed=i,
        )
        for i, (first, last) in enumerate(spans)
    ]
    for i, late_s in ((0, 60.0), (2, 55.0)):
        parts.append(parts[i].with_columns(time_utc_s=parts[i].time_utc_s + late_s))
    boxes = in_order(parts)
    return boxes.with_columns(frame=np.round(10.0 * (boxes.time_utc_s - START_S)).astype(int))


def table(folder: Path, boxes: Boxes) -> Path:
    path = folder / "boxes.csv"
    write_boxes(boxes, path)
    return path


def assert_same_tracks(some: Iterable[Track], others: Iterable[Track], *, ids: bool = True) -> None:
    first, second = (
        sorted(tracks, key=lambda t: (t.time_utc_s[0].round(2), t.north_m[0].round()))
        for tracks in (some, others)
    )
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        assert not ids or one.track_id == other.track_id
        # Files of boxes keep milliseconds.
        np.testing.assert_allclose(one.time_utc_s, other.time_utc_s, atol=1e-3)
        np.testing.assert_allclose(one.east_m, other.east_m, atol=1e-2)
        np.testing.assert_allclose(one.north_m, other.north_m, atol=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("ids", [True, False], ids=["with ids", "without ids"])
@pytest.mark.parametrize("chunk_rows", [20, 100])
def test_a_table_in_pieces_gives_the_tracks_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ids: bool, chunk_rows: int
) -> None:
    boxes = traffic(ids=ids)
    # Several boxes a moment, so many a chunk ends between boxes of one time.
    assert np.unique(boxes.time_utc_s).size < len(boxes)
    whole = track(boxes, MODEL, settings=QUICK)
    monkeypatch.setattr(sources, "_CHUNK_ROWS", chunk_rows)
    pieces = list(iter_tracks(table(tmp_path, boxes), MODEL, settings=QUICK))
    assert len(whole) == 7
    assert_same_tracks(pieces, whole)


@pytest.fixture(scope="module")
def many_boxes(small_camera: SimulatedCamera) -> Boxes:
    """What a detector sees of eight vessels near and far, with the vessels' ids."""
    harbour = Harbour.random(
        3,
        HarbourSettings(
            duration_s=30.0,
            motorboats=4,
            sailboats=2,
            ferries=1,
            anchored=0,
            gulls=0,
            camera=small_camera,
        ),
    )
    noise = BoxNoise(std_px=1.5, correlation_time_s=0.8, miss_probability=0.05, source="detector")
    return harbour.boxes(harbour.times(10.0), noise=noise, of="all", seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("ids", [True, False], ids=["with ids", "without ids"])
@pytest.mark.parametrize("model", ["camera", "camera+gpr"])
def test_tracks_do_not_depend_on_how_a_table_is_cut(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    many_boxes: Boxes,
    fitted: Callable[[str], Georeferencer],
    ids: bool,
    model: str,
) -> None:
    # To the last bit: what differs there in a position can be centimetres in a track far away.
    boxes = (
        many_boxes if ids else many_boxes.with_columns(track_id=np.full(len(many_boxes), NO_TRACK))
    )
    source = table(tmp_path, boxes)
    number = attrgetter("track_id")
    made = {}
    for chunk_rows in (100, 1000, 20_000):
        monkeypatch.setattr(sources, "_CHUNK_ROWS", chunk_rows)
        forecasts: list[Track] = []
        tracks = list(iter_tracks(source, fitted(model), forecasts=forecasts.append))
        # With ids, those of which the same piece tells that they have gone come in the ids' order.
        made[chunk_rows] = [*sorted(tracks, key=number), *sorted(forecasts, key=number)]
    assert len(boxes) > 1500
    assert len(made[20_000]) >= 10
    for chunk_rows in (100, 1000):
        for one, other in zip(made[chunk_rows], made[20_000], strict=True):
            assert one.track_id == other.track_id
            for name in Track._row_fields:
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("seed", range(5))
def test_groups_of_moments_are_the_same_however_the_boxes_come(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Three boxes a moment on average, and some moments with one.
    times = START_S + np.repeat(np.arange(100) / 5.0, rng.integers(1, 6, 100))
    boxes = Boxes.of(np.tile([1.0, 2.0, 3.0, 4.0], (times.size, 1)), time_utc_s=times)
    cuts = np.sort(rng.choice(np.arange(1, times.size), 12, replace=False))
    pieces = [boxes[rows] for rows in np.split(np.arange(times.size), cuts)]
    groups = list(sources.groups_of_moments(pieces, 16))
    assert [np.unique(group.time_utc_s).size for group in groups] == [16] * 6 + [4]
    np.testing.assert_array_equal(np.concatenate([g.time_utc_s for g in groups]), times)


@pytest.mark.parametrize("ids", [True, False], ids=["with ids", "without ids"])
def test_each_box_is_located_once(
    many_boxes: Boxes, fitted: Callable[[str], Georeferencer], ids: bool
) -> None:
    boxes = (
        many_boxes if ids else many_boxes.with_columns(track_id=np.full(len(many_boxes), NO_TRACK))
    )
    located: list[FloatArray] = []

    class Counting(Georeferencer):
        def locate(self, boxes_xyxy_px: ArrayLike, *args: Any, **named: Any) -> Positions:
            located.append(np.reshape(boxes_xyxy_px, (-1, 4)))
            return super().locate(boxes_xyxy_px, *args, **named)

    model = fitted("camera")
    counting = Counting(**{one.name: getattr(model, one.name) for one in fields(model)})
    assert list(iter_tracks(boxes, counting))
    rows = np.concatenate(located)
    assert len(np.unique(rows, axis=0)) == len(rows) <= len(boxes)
    assert len(rows) > 0.95 * len(boxes)


@pytest.mark.slow
@pytest.mark.parametrize("ids", [True, False], ids=["with ids", "without ids"])
def test_a_table_in_no_order_gives_the_same_tracks(tmp_path: Path, ids: bool) -> None:
    boxes = traffic(ids=ids)
    shuffled = boxes[np.random.default_rng(1).permutation(len(boxes))]
    ordered = track(boxes, MODEL, settings=QUICK)
    # Of those that come at one time, a tracker numbers first whichever it is given first.
    for source in (shuffled, table(tmp_path, shuffled)):
        assert_same_tracks(track(source, MODEL, settings=QUICK), ordered, ids=ids)


@pytest.mark.slow
def test_tracks_come_as_soon_as_their_targets_have_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    boxes = traffic(ids=True)
    monkeypatch.setattr(sources, "_CHUNK_ROWS", 20)
    tracks = iter_tracks(table(tmp_path, boxes), MODEL, settings=QUICK)
    ends = [one.time_utc_s[-1] for one in tracks]
    # The one that left first is there first, those that stay to the end come last.
    assert ends[0] == min(ends)
    assert np.all(np.diff(ends) > -TrackSettings().ends_after_s)


def test_a_target_that_leaves_and_returns_has_two_tracks() -> None:
    times = np.r_[np.arange(0.0, 10.0, 0.1), np.arange(40.0, 50.0, 0.1)]
    boxes = crossing(300.0, times, track_id=4)
    tracks = list(track(boxes, MODEL))
    assert [one.track_id for one in tracks] == [4, 5]
    assert [len(one) for one in tracks] == [100, 100]
    patient = track(boxes, MODEL, settings=TrackSettings(ends_after_s=31.0))
    assert [one.track_id for one in patient] == [4]


def test_a_returning_target_takes_no_id_of_the_table() -> None:
    leaves = crossing(300.0, np.r_[np.arange(0, 5, 0.1), np.arange(40, 45, 0.1)], track_id=1)
    later = crossing(500.0, np.arange(60.0, 65.0, 0.1), track_id=2)
    tracks = {one.track_id: one for one in track(in_order([leaves, later]), MODEL)}
    assert sorted(tracks) == [1, 2, 3]
    assert tracks[2].time_utc_s[0] == later.time_utc_s[0]


@pytest.mark.slow
@pytest.mark.parametrize("chunk_rows", [1, 13, 10_000])
def test_a_long_track_is_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk_rows: int
) -> None:
    boxes = crossing(300.0, np.arange(0.0, 100.0, 0.5), track_id=1)
    monkeypatch.setattr(sources, "_CHUNK_ROWS", chunk_rows)
    settings = replace(QUICK, longest_s=30.0)
    pieces = list(iter_tracks(table(tmp_path, boxes), MODEL, settings=settings))
    assert [one.track_id for one in pieces] == [1, 2, 3, 4]
    assert [len(one) for one in pieces] == [61, 61, 61, 17]
    np.testing.assert_allclose(
        np.concatenate([one.time_utc_s for one in pieces]), boxes.time_utc_s, atol=1e-3
    )


@pytest.mark.parametrize("seed", range(5))
def test_tracks_of_many_moments_end_as_of_one_after_the_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 600
    times = np.sort(rng.choice(np.arange(200.0), n))
    # Targets come, go for longer than the limit, come back, and stay too long.
    here = rng.integers(1, 8, n) + 7 * (times // 60.0).astype(int) * rng.integers(0, 2, n)
    boxes = Boxes.of(
        np.tile([0.0, 0.0, 5.0, 5.0], (n, 1)), time_utc_s=times, track_id=here, frame=np.arange(n)
    )
    settings = TrackSettings(ends_after_s=6.0, longest_s=30.0)
    moments = [boxes[boxes.time_utc_s == time] for time in np.unique(times)]
    cuts = np.searchsorted(times, [50.0, 51.0, 120.0])
    parts = [boxes[rows] for rows in np.split(np.arange(n), cuts)]
    expected = list(_OpenTracks(settings, NO_TRACK).ended(moments))
    got = list(_OpenTracks(settings, NO_TRACK).ended_by_moment(parts))
    assert len(expected) > 20
    assert [number for number, _ in got] == [number for number, _ in expected]
    for (_, some), (_, others) in zip(got, expected, strict=True):
        np.testing.assert_array_equal(some.frame, others.frame)


def test_boxes_of_which_no_two_are_of_one_time_are_of_one_target(tmp_path: Path) -> None:
    # A box every four seconds, far from the one before: no tracker could tell.
    boxes = crossing(300.0, np.arange(0.0, 60.0, 4.0), speed_px_s=15.0)
    for source in (boxes, table(tmp_path, boxes)):
        (one,) = track(source, MODEL)
        assert (one.track_id, len(one)) == (1, len(boxes))


def test_a_tracker_tells_targets_apart() -> None:
    times = np.arange(0.0, 20.0, 0.1)
    boxes = in_order([crossing(200.0, times), crossing(600.0, times, seed=1)])
    tracks = track(boxes, MODEL)
    assert len(tracks) == 2
    for one, y_px in zip(sorted(tracks, key=lambda t: -t.north_m[0]), (200.0, 600.0), strict=True):
        # A box's foot lies within a few tenths of a pixel, a tenth of a metre each.
        np.testing.assert_allclose(one.north_m, 0.1 * (SIZE_PX[1] - y_px), atol=0.15)
        np.testing.assert_allclose(one.velocity_east_mps, 0.8, atol=0.4)


class ByLane:
    """A tracker that knows nothing of `LocatedBoxes`: each lane of the picture is a target."""

    def __init__(self, *, moves_px: float = 0.0) -> None:
        self._moves_px = moves_px

    def update(self, boxes: Boxes) -> Boxes:
        lane = (boxes.xyxy_px[:, 3] // 200.0).astype(int)
        order = np.argsort(-lane)
        return Boxes.of(
            boxes.xyxy_px[order] + self._moves_px,
            frame=boxes.frame[order],
            time_utc_s=boxes.time_utc_s[order],
            track_id=lane[order],
        )

    def reset(self) -> None:
        pass


def test_a_tracker_may_give_back_plain_boxes_in_another_order() -> None:
    times = np.arange(0.0, 10.0, 0.2)
    lanes = [crossing(250.0 + 200.0 * i, times, track_id=i + 1, seed=i) for i in range(3)]
    boxes = in_order(lanes)
    plain = boxes.with_columns(track_id=np.full(len(boxes), NO_TRACK))
    made = track(plain, MODEL, settings=replace(QUICK, tracker=ByLane()))
    assert_same_tracks(made, track(boxes, MODEL, settings=QUICK))
    with pytest.raises(InputError, match="a box that it was not given"):
        track(plain, MODEL, settings=replace(QUICK, tracker=ByLane(moves_px=1.0)))


def test_boxes_without_an_id_among_those_that_have_one_are_of_no_target(tmp_path: Path) -> None:
    times = np.arange(0.0, 20.0, 0.1)
    boat = crossing(200.0, times, track_id=6)
    both = in_order([boat, crossing(600.0, times, seed=1)])
    for source in (both, table(tmp_path, both)):
        assert_same_tracks(track(source, MODEL), track(boat, MODEL))


def test_boxes_too_seldom_to_follow_are_refused() -> None:
    times = np.arange(0.0, 60.0, 4.0)
    boxes = in_order([crossing(200.0, times), crossing(600.0, times, seed=1)])
    with pytest.raises(
        InputError, match=r"the boxes are 4\.0 s apart, and a target can be followe"
    ):
        track(boxes, MODEL)


def test_what_is_seen_for_a_moment_is_dropped() -> None:
    boat = crossing(200.0, np.arange(0.0, 20.0, 0.1), track_id=1)
    gull = crossing(600.0, np.arange(5.0, 6.5, 0.1), track_id=2)
    assert [one.track_id for one in track(in_order([boat, gull]), MODEL)] == [1]
    eager = TrackSettings(shortest_s=1.0)
    assert len(track(in_order([boat, gull]), MODEL, settings=eager)) == 2


def test_nothing_has_no_tracks(tmp_path: Path) -> None:
    (tmp_path / "none.csv").write_text("frame,x1,y1,x2,y2,time_utc\n")
    for source in (Boxes.of([]), tmp_path / "none.csv"):
        assert len(track(source, MODEL)) == 0


def test_an_id_belongs_to_one_target_though_its_label_changes() -> None:
    boxes = crossing(300.0, np.arange(0.0, 10.0, 0.1), track_id=1)
    (one,) = track(boxes.with_columns(label=np.where(np.arange(100) < 60, "boat", "ship")), MODEL)
    assert one.label == "boat"
    assert len(one) == 100


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"ends_after_s": 0.0}, "ends_after_s must be positive; it is 0 s"),
        ({"longest_s": float("nan")}, "longest_s must be positive; it is nan s"),
        ({"interval_s": 0.0001}, "interval_s is 0.0001 s; it must be at least 0.001 s"),
        ({"trajectory": "spline"}, "unknown trajectory method 'spline'; known are paper, rts"),
    ],
)
def test_settings_that_make_no_sense(settings: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TrackSettings(**settings)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def harbour(tmp_path_factory: pytest.TempPathFactory) -> Simulation:
    return simulate(
        tmp_path_factory.mktemp("harbour"),
        SimulationSettings(video=False, recordings=3, duration_s=20.0, seed=1),
    )


def test_a_model_never_sees_the_recording_that_is_left_out(
    harbour: Simulation, tmp_path: Path
) -> None:
    scene = Scene.load(harbour.scene)
    before = leave_one_out(scene, "qkr")
    spoilt = scene["02"].boxes()
    write_boxes(
        spoilt.with_columns(xyxy_px=spoilt.xyxy_px + np.array([40.0, 30.0, 40.0, 30.0])),
        tmp_path / "02.csv",
    )
    recordings = tuple(
        replace(one, boxes_path=tmp_path / "02.csv") if one.name == "02" else one
        for one in scene.recordings
    )
    after = leave_one_out(replace(scene, recordings=recordings), "qkr")
    assert before.keys() == after.keys() == {"01", "02", "03"}
    boxes = scene["02"].boxes()
    for name, same in (("01", False), ("02", True), ("03", False)):
        first, second = (
            models[name].locate(boxes.xyxy_px, boxes.source) for models in (before, after)
        )
        assert np.array_equal(first.east_m, second.east_m, equal_nan=True) is same
        assert name not in after[name].report.recordings


def boat_video(path: Path, start_s: float) -> None:
    """A dark boat that crosses a grey sea in four seconds."""
    rng = np.random.default_rng(0)
    sea = rng.integers(150, 160, (720, 1280, 3), dtype=np.uint8)

    def frames() -> Iterable[Frame]:
        for i in range(40):
            image = sea.copy()
            image[560:600, 200 + 10 * i : 300 + 10 * i] = 20
            yield Frame(i, start_s + 0.1 * i, image)

    write_video(path, frames())


@pytest.mark.slow
def test_run_takes_boxes_detections_and_videos(harbour: Simulation, tmp_path: Path) -> None:
    folder = harbour.scene.parent
    boat_video(tmp_path / "03.mp4", START_S)
    scene = Scene.load(harbour.scene)
    one, two, three = scene.recordings
    mixed = replace(
        scene,
        recordings=(
            one,
            replace(two, boxes_path=None),
            replace(
                three,
                boxes_path=None,
                detections_path=None,
                clock_path=None,
                fixes_path=None,
                video_path=tmp_path / "03.mp4",
            ),
        ),
    )
    told: list[str] = []
    result = run(
        mixed,
        model="qkr",
        detector="motion",
        progress=lambda what, _share: told.append(what),
    )
    assert list(result.tracks) == ["01", "02", "03"]
    assert [one.track_id for one in result.tracks["01"]] == [1]
    # The detections are of all boats.
    truth = np.genfromtxt(folder / "truth-boxes" / "02.csv", delimiter=",", skip_header=1)
    assert 1 < len(result.tracks["02"]) <= 2 * np.unique(truth[:, 5]).size
    (crossing_boat,) = result.tracks["03"]
    assert START_S <= crossing_boat.time_utc_s[0] < crossing_boat.time_utc_s[-1] <= START_S + 4.0
    assert result.detected == ("03",)
    # Nothing was learned from 02, and without 01 there is nothing to learn from.
    assert result.left_out == ("02",)
    assert any("Recording 01 could not be left out" in note for note in result.notes)
    assert result.single is None
    assert result.smoothed is not None
    assert set(result.smoothed.recordings) == {"02"}
    for report in (result.single_learned_from, result.smoothed_learned_from):
        assert report is not None
        assert set(report.recordings) == {"01"}
    assert "detecting in 03" in told


def truth_at(harbour: Simulation, times: FloatArray) -> FloatArray:
    """(N, 2) where the target was, metres from the simulated camera."""
    truth = harbour.harbour.truth(times, [harbour.harbour.target])
    return np.stack([truth.east_m, truth.north_m], axis=1)


@pytest.mark.slow
def test_smoothing_takes_error_away(tmp_path: Path) -> None:
    """Against the world's own truth, not its log, over harbours with different cameras."""
    single, smoothed = [], []
    for seed in (1, 2, 5):
        made = simulate(
            tmp_path / str(seed), SimulationSettings(video=False, duration_s=20.0, seed=seed)
        )
        model = fit(Scene.load(made.scene), "camera")
        for placed in place_boxes(Scene.load(made.scene), lambda _, model=model: model):
            positions = model.locate(placed.boxes.xyxy_px, placed.boxes.source)
            path = placed.track("rts")
            assert path is not None
            times = placed.boxes.time_utc_s
            where = np.stack([positions.east_m, positions.north_m], axis=1)
            error = where - truth_at(made, times)
            single.append(np.hypot(*error[positions.known].T))
            where = np.stack([path.east_m, path.north_m], axis=1)
            smoothed.append(np.hypot(*(where - truth_at(made, path.time_utc_s)).T))
    rms = [float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) for errors in (single, smoothed)]
    assert rms[1] < rms[0]


def test_what_evaluate_needs(harbour: Simulation, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a scene is scored with a model"):
        evaluate(harbour.scene)
    tracks = track(crossing(300.0, np.arange(0.0, 10.0, 0.1), track_id=1), MODEL)
    with pytest.raises(InputError, match="tracks are scored against a log; give fixes"):
        evaluate(tracks)
    with pytest.raises(InputError, match="no position falls between two fixes"):
        evaluate(tracks, fixes=harbour.scene.parent / "target.gpx")
