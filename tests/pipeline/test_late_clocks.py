"""A camera's clock that is ahead of the log's: found, told, and taken off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _support.clocks import CAMERA, drawn_scene, unlabelled_recordings, unlabelled_scene

import sightline
from sightline import formats
from sightline.errors import InputError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.evaluate import evaluate, place_boxes
from sightline.pipeline.fit import fit
from sightline.pipeline.track import TrackSettings, track
from sightline.scene import Scene
from sightline.scene.correspondences import collect, settled
from sightline.types import Track


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Two recordings by a right clock."""
    return drawn_scene(tmp_path_factory.mktemp("right"), {"01": 0.0, "02": 0.0}, duration_s=60.0)


@pytest.fixture(scope="module")
def model(right: Scene) -> Georeferencer:
    return fit(right, "camera")


@pytest.mark.parametrize(
    "offset_s",
    [
        (1.0, 1.0),
        pytest.param((5.0, 5.0), marks=pytest.mark.slow),
        pytest.param((-40.0, -40.0), marks=pytest.mark.slow),
        pytest.param((0.0, 40.0), marks=pytest.mark.slow),
        pytest.param((3600.0, 3600.0), marks=pytest.mark.slow),
        pytest.param((-19789.0, -19789.0), marks=pytest.mark.slow),
    ],
)
def test_the_camera_is_that_of_a_right_clock(
    tmp_path: Path, model: Georeferencer, offset_s: tuple[float, float]
) -> None:
    scene = drawn_scene(tmp_path, dict(zip(("01", "02"), offset_s, strict=True)), duration_s=60.0)
    found = fit(scene, "camera")
    for name, true_s in zip(("01", "02"), offset_s, strict=True):
        clock = found.report.clocks[name]
        assert abs(clock.offset_s - true_s) < 3.0 * clock.sigma_s
        assert clock.sigma_s < 0.5
        # The older key says the same with the other sign.
        assert found.report.clock_offset_s[name] == -clock.offset_s
        said = any(f"clock of recording {name}" in text for text in found.report.statements)
        # A second may be what chance makes of a right clock; it is estimated all the same.
        if abs(true_s) != 1.0:
            assert said == (true_s != 0.0)
    assert found.camera is not None
    assert model.camera is not None
    for mine, other in zip(found.report.parameters, model.report.parameters, strict=True):
        assert abs(mine.value - other.value) < other.sigma, mine.name
    assert found.camera.focal_px == pytest.approx(CAMERA.focal_length_px, rel=0.06)


def test_a_model_file_keeps_the_clocks(tmp_path: Path, model: Georeferencer) -> None:
    again = sightline.load(model.save(tmp_path / "model.safetensors"))
    assert again.report.clocks == model.report.clocks


def test_a_right_clock_is_left_as_it_is(right: Scene) -> None:
    assert [one.clock_offset_s for one in settled(right).recordings] == [0.0, 0.0]


def test_a_clock_is_looked_for_once_though_another_recording_has_too_few_boxes(
    right: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = tmp_path / "few.csv"
    formats.write_boxes(right["02"].boxes()[:3], few)
    scene = replace(right, recordings=(right["01"], replace(right["02"], boxes_path=few)))
    once = settled(scene)
    assert [one.clock_found is None for one in once.recordings] == [False, True]
    monkeypatch.delattr("sightline.scene.clocks.search_clocks")
    assert settled(once) is once


def test_boxes_are_scored_in_the_logs_time(
    tmp_path: Path, right: Scene, model: Georeferencer
) -> None:
    """Of recordings that the model never saw, whose clock it cannot know."""
    scene = drawn_scene(tmp_path, {"01": 40.0, "02": 5.0}, duration_s=60.0)
    report, expected = evaluate(scene, model=model), evaluate(right, model=model)
    assert report.ape.rmse == pytest.approx(expected.ape.rmse, rel=0.1)
    for name, true_s in (("01", 40.0), ("02", 5.0)):
        clock = report.recordings[name].clock
        assert clock is not None
        assert abs(clock.offset_s - true_s) < 3.0 * clock.sigma_s
        assert expected.recordings[name].clock is None


def test_a_stated_clock_is_taken_off_everything(tmp_path: Path, right: Scene) -> None:
    late_s = 10.0
    names = {"01": late_s, "02": late_s}
    scene = drawn_scene(tmp_path, names, duration_s=60.0, keys="clock_offset_s = [10.0, 0.05]")
    for name in names:
        np.testing.assert_allclose(
            scene[name].boxes().time_utc_s, right[name].boxes().time_utc_s, atol=2e-6
        )
        assert scene[name].by_camera().boxes().time_utc_s[0] == pytest.approx(
            right[name].boxes().time_utc_s[0] + late_s, abs=2e-6
        )
    found = fit(scene, "camera")
    for clock in found.report.clocks.values():
        assert clock.stated
        assert abs(clock.offset_s - late_s) < 0.2
        assert clock.sigma_s <= 0.05


@pytest.mark.parametrize(
    "value", ["[1.0]", "[1.0, 0.0]", "[1.0, -2.0]", '"ten"', "[1.0, 2.0, 3.0]"]
)
def test_a_clock_offset_that_is_none_is_refused(tmp_path: Path, value: str) -> None:
    with pytest.raises(InputError, match="clock_offset_s"):
        drawn_scene(tmp_path, {"01": 0.0}, duration_s=20.0, keys=f"clock_offset_s = {value}")


def test_tracks_can_be_told_the_clock(right: Scene, model: Georeferencer) -> None:
    boxes = right["01"].boxes()
    late = boxes.with_columns(time_utc_s=boxes.time_utc_s + 40.0)
    (expected,) = track(boxes, model)
    (found,) = track(late, model, settings=TrackSettings(clock_offset_s=40.0))
    np.testing.assert_allclose(found.time_utc_s, expected.time_utc_s, atol=1e-5)
    np.testing.assert_allclose(found.east_m, expected.east_m, atol=1e-3)
    with pytest.raises(InputError, match="clock_offset_s"):
        TrackSettings(clock_offset_s=float("nan"))


def error_m(made: Track, scene: Scene, name: str) -> float:
    """RMSE of a track against the log at the track's own times."""
    fixes, plane = scene[name].fixes(), scene.plane
    assert plane is not None
    east, north = plane.to_plane(fixes.latitude_deg, fixes.longitude_deg)
    at = made.time_utc_s
    off = np.hypot(
        np.interp(at, fixes.time_utc_s, east) - made.east_m,
        np.interp(at, fixes.time_utc_s, north) - made.north_m,
    )
    return float(np.sqrt(np.mean(off**2)))


@pytest.mark.parametrize("seed", [21, 31])
@pytest.mark.parametrize("offset_s", [-58.0, -40.0, 40.0])
def test_a_clock_is_found_though_the_log_is_no_longer_than_its_recording(
    tmp_path: Path, offset_s: float, seed: int
) -> None:
    """By the camera's own clock most boxes have no place, and the few lie where others are."""
    both = {"01": offset_s, "02": offset_s}
    scene = drawn_scene(tmp_path, both, seed=seed, duration_s=60.0, margin_s=5.0)
    for recording in settled(scene).recordings:
        clock = recording.clock_found
        assert clock is not None
        assert clock.used_s == clock.offset_s
        assert abs(clock.offset_s - offset_s) < 3.0 * clock.sigma_s


@pytest.mark.parametrize(("seed", "offset_s"), [(116, 20.0), (118, 20.0), (118, 30.0), (120, 20.0)])
def test_what_most_boxes_fit_is_no_clock_where_another_gives_all_a_place(
    tmp_path: Path, seed: int, offset_s: float
) -> None:
    """One recording by itself, of which some camera fits most boxes at the wrong clock."""
    scene = drawn_scene(tmp_path, {"01": offset_s}, seed=seed, duration_s=60.0, margin_s=5.0)
    clock = settled(scene)["01"].clock_found
    assert clock is not None
    assert clock.used_s == clock.offset_s
    assert abs(clock.offset_s - offset_s) < 3.0 * clock.sigma_s


@pytest.mark.slow
@pytest.mark.parametrize("seed", [24, 26, 31])
def test_a_camera_that_explains_most_boxes_at_a_wrong_clock_is_no_end_of_the_search(
    tmp_path: Path, seed: int
) -> None:
    """One recording of a minute by itself, whose log goes on as long before and after."""
    scene = drawn_scene(tmp_path, {"01": 40.0}, seed=seed, duration_s=60.0)
    clock = settled(scene)["01"].clock_found
    assert clock is not None
    assert clock.used_s == clock.offset_s
    assert abs(clock.offset_s - 40.0) < 3.0 * clock.sigma_s


@pytest.mark.parametrize("seed", [21, 31])
@pytest.mark.parametrize("part_s", [(19.0, 41.0), (-60.0, 25.0), (-60.0, 40.0), (20.0, 120.0)])
def test_a_log_of_part_of_a_recording_makes_its_clock_no_other(
    tmp_path: Path, seed: int, part_s: tuple[float, float]
) -> None:
    """Though another clock might give more boxes a place."""
    scene = drawn_scene(tmp_path, {"01": 0.0}, seed=seed, duration_s=60.0)
    recording = scene["01"]
    fixes, path = recording.fixes(), recording.fixes_path
    assert path is not None
    since_s = fixes.time_utc_s - recording.boxes().time_utc_s[0]
    formats.write_fixes(fixes[(since_s >= part_s[0]) & (since_s <= part_s[1])], path)
    assert settled(Scene.load(scene.path))["01"].clock_offset_s == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [21, 31])
@pytest.mark.parametrize("every_s", [20, 40])
def test_a_sparse_log_of_another_hour_tells_no_clock(
    tmp_path: Path, seed: int, every_s: int
) -> None:
    """In gaps as long a vessel may have been where the boxes are, at any clock."""
    scene = drawn_scene(tmp_path, {"01": 0.0, "02": 0.0}, seed=seed, duration_s=60.0)
    other, own = scene["01"].fixes(), scene["02"]
    early_s = other.time_utc_s.mean() - (own.boxes().time_utc_s.mean() - 1800.0)
    elsewhere = replace(other, time_utc_s=other.time_utc_s - early_s)
    path = own.fixes_path
    assert path is not None
    formats.write_fixes(elsewhere[np.arange(0, len(elsewhere), every_s)], path)
    assert settled(Scene.load(scene.path))["02"].clock_offset_s == 0.0


@pytest.mark.slow
def test_a_run_writes_and_scores_tracks_in_the_logs_time(tmp_path: Path, right: Scene) -> None:
    scene = drawn_scene(tmp_path, {"01": 40.0, "02": 40.0}, duration_s=60.0)
    result, expected = sightline.run(scene), sightline.run(right)
    assert result.smoothed is not None
    assert expected.smoothed is not None
    assert result.smoothed.ape.rmse == pytest.approx(expected.smoothed.ape.rmse, rel=0.1)
    for name, tracks in result.tracks.items():
        assert error_m(tracks[0], scene, name) < 1.1 * error_m(
            expected.tracks[name][0], right, name
        )
    told = {name: clock.used_s for name, clock in result.clocks.items()}
    for name, used_s in told.items():
        assert used_s == pytest.approx(40.0, abs=1.0)
        assert any(f"clock of recording {name} is" in note for note in result.notes)
    assert set(result.clocks) == {"01", "02"}


@pytest.mark.slow
def test_a_recording_that_is_left_out_tells_nothing_of_the_other_clocks(tmp_path: Path) -> None:
    names = ("01", "02", "03")
    scene = drawn_scene(tmp_path, dict.fromkeys(names, 40.0), duration_s=60.0)
    result = sightline.run(scene)
    assert result.left_out == names
    for placed in result.placed:
        never_saw = fit(scene.without([placed.recording]))
        # One search tells the clocks of all that are asked together.
        for other, told in never_saw.report.clocks.items():
            assert other != placed.recording
            assert told.offset_s != result.clocks[other].offset_s
        assert placed.model.report.clocks == never_saw.report.clocks
        assert placed.model.report.parameters == never_saw.report.parameters


@pytest.mark.slow
def test_a_recording_left_out_without_drawn_boxes_is_scored_at_a_clock_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the model of all recordings says of its clock may be wrong: it saw the recording."""
    scene = unlabelled_recordings(tmp_path, 40.0, seeds=(1, 2, 4))
    expected = sightline.run(scene)
    assert expected.left_out == ("01", "02", "03")
    for name in expected.left_out:
        assert any(
            f"clock of recording {name} is" in note and "by its own boxes and log" in note
            for note in expected.notes
        )
    monkeypatch.setattr(
        "sightline.pipeline.run._in_log_time",
        lambda by_camera, _: (by_camera.with_clocks(dict.fromkeys(("01", "02", "03"), 37.0)), ()),
    )
    told_wrongly = sightline.run(scene).smoothed
    assert told_wrongly is not None
    assert expected.smoothed is not None
    assert told_wrongly.ape.rmse == pytest.approx(expected.smoothed.ape.rmse, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("offset_s", [1.0, 40.0, 3600.0])
def test_a_run_without_drawn_boxes_uses_the_clock_that_it_finds(
    tmp_path: Path, offset_s: float
) -> None:
    (tmp_path / "right").mkdir()
    expected = sightline.run(unlabelled_scene(tmp_path / "right", 0.0, seed=1)).smoothed
    result = sightline.run(unlabelled_scene(tmp_path, offset_s, seed=1))
    clock = result.clocks["01"]
    assert abs(clock.offset_s - offset_s) < 3.0 * clock.sigma_s
    assert expected is not None
    assert result.smoothed is not None
    assert result.smoothed.ape.rmse < 1.1 * expected.ape.rmse


def test_a_recording_left_out_is_scored_at_a_clock_of_its_own(
    tmp_path: Path, model: Georeferencer
) -> None:
    """Its model never saw it: the clock comes from its boxes and log, and may differ."""
    scene = drawn_scene(tmp_path, {"01": 3.0, "02": -20.0}, duration_s=60.0)
    first, second = place_boxes(scene, lambda _: model)
    assert first.clock is not None
    assert second.clock is not None
    assert abs(first.clock.offset_s - 3.0) < 3.0 * first.clock.sigma_s
    assert abs(second.clock.offset_s + 20.0) < 3.0 * second.clock.sigma_s


@pytest.mark.slow
def test_what_has_no_place_in_a_log_is_said_with_number_and_reason(tmp_path: Path) -> None:
    stated = "clock_offset_s = 0.0"
    scene = drawn_scene(tmp_path, {"01": 0.0}, duration_s=200.0, keys=stated)
    fixes, path = scene["01"].fixes(), scene["01"].fixes_path
    assert path is not None
    times = scene["01"].boxes().time_utc_s
    since_s = fixes.time_utc_s - times.min()
    left = (since_s <= 30.0) | ((since_s >= 160.0) & (since_s <= 185.0))
    formats.write_fixes(fixes[left], path)
    at_s = fixes.time_utc_s[left]
    before, after = at_s[since_s[left] <= 30.0].max(), at_s[since_s[left] >= 160.0].min()
    outside, long = (times > at_s.max()).sum(), ((times > before) & (times < after)).sum()
    inputs = collect(Scene.load(scene.path), pictures=False)
    assert len(inputs.correspondences) == times.size - outside - long
    said = next(text for text in inputs.statements if "no place in the log" in text)
    assert said.startswith(f"{outside + long} of {times.size} boxes ")
    assert f"{outside} outside the time of the log" in said
    assert f"{long} in gaps of the log of more than 120 s" in said
    assert "recordings 01" in said
