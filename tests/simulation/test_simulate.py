import json
from pathlib import Path

import numpy as np
import pytest

from sightline import formats
from sightline.errors import InputError
from sightline.scene import Scene
from sightline.simulation import EXACT, BoxNoise, Simulation, SimulationSettings, simulate
from sightline.video import frames, video_info

SETTINGS = {"recordings": 2, "duration_s": 5.0, "pause_s": 3.0, "image_size_px": (320, 180)}


@pytest.fixture(scope="module")
def simulation(tmp_path_factory: pytest.TempPathFactory) -> Simulation:
    folder = tmp_path_factory.mktemp("harbour")
    return simulate(folder, SimulationSettings(seed=3, **SETTINGS))  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_times_in_the_video_are_the_true_ones(simulation: Simulation) -> None:
    for recording in simulation.recordings:
        path = simulation.scene.parent / f"{recording.name}.mp4"
        info = video_info(path)
        assert info.image_size_px == (320, 180)
        assert info.creation_utc_s == recording.time_utc_s[0]
        expected = recording.time_utc_s - recording.time_utc_s[0]
        np.testing.assert_allclose(info.presentation_s, expected, atol=1.1e-6)
        # Frames are irregular: no two intervals alike.
        assert np.unique(np.round(np.diff(expected), 5)).size > 0.8 * (expected.size - 1)


def test_a_decoded_frame_shows_what_was_painted(simulation: Simulation) -> None:
    from sightline.simulation import Renderer

    recording = simulation.recordings[1]
    painted = Renderer(simulation.harbour).image(recording.time_utc_s[7])
    path = simulation.scene.parent / "02.mp4"
    shown = next(frame for frame in frames(path) if frame.index == 7).image_bgr
    assert np.abs(shown.astype(int) - painted).mean() < 6.0


def test_the_scene_loads_with_all_it_names(simulation: Simulation) -> None:
    scene = Scene.load(simulation.scene)
    truth = json.loads((simulation.scene.parent / "truth.json").read_text())
    assert scene.image_size_px == (320, 180)
    assert truth["camera"]["height_m"] == simulation.harbour.camera.height_m
    for recording, made in zip(scene.recordings, simulation.recordings, strict=True):
        boxes, detections = recording.boxes(), recording.detections()
        assert len(boxes) > 2
        assert set(boxes.source) == {"annotator"}
        assert len(detections) > len(boxes)
        exact = simulation.harbour.boxes(made.time_utc_s[boxes.frame], frame=boxes.frame)
        assert np.isin(boxes.frame, exact.frame).all()
        error = boxes.xyxy_px - exact.xyxy_px
        assert np.abs(error).max() < 5.0
        assert recording.fixes().time_utc_s[0] < made.time_utc_s[0]


def test_an_exact_clock_tells_every_frame(tmp_path: Path) -> None:
    made = simulate(tmp_path, SimulationSettings(seed=3, clock="exact", video=False, **SETTINGS))  # type: ignore[arg-type]
    for recording, shot in zip(Scene.load(made.scene).recordings, made.recordings, strict=True):
        indices = np.arange(shot.time_utc_s.size)
        times = recording.clock().time_utc_s(indices)
        np.testing.assert_allclose(times, shot.time_utc_s, atol=1e-6)


def test_a_stepped_clock_was_read_before_the_frame_and_cut_off_to_the_second(
    tmp_path: Path,
) -> None:
    made = simulate(
        tmp_path,
        SimulationSettings(seed=3, clock="stepped", video=False, recordings=1, duration_s=60.0),
    )
    lines = (tmp_path / "clock" / "01.csv").read_text().splitlines()[1:]
    stamps = [line.split(",")[1] for line in lines]
    true = made.recordings[0].time_utc_s
    assert len(lines) == true.size
    read = np.array([np.datetime64(stamp[:-1], "us").astype(float) / 1e6 for stamp in stamps])
    assert (read % 1.0 == 0.0).all()
    late = true - read
    assert late.min() >= 0.0
    assert late.max() < 6.0
    np.testing.assert_array_equal(np.unique(np.diff(read)), [0.0, 5.0])
    # The times between the steps can be recovered to within the second that was cut off.
    recovered = Scene.load(made.scene).recordings[0].clock().time_utc_s(np.arange(true.size))
    assert np.abs(recovered - true).max() < 1.0


def test_logs_are_what_their_receivers_would_have_written(tmp_path: Path) -> None:
    made = simulate(
        tmp_path,
        SimulationSettings(seed=4, recordings=1, duration_s=120.0, video=False, receiver=EXACT),
    )
    gpx = formats.read_fixes(tmp_path / "target.gpx")
    truth = made.harbour.truth(gpx.time_utc_s)
    east, north = made.harbour.plane.to_plane(gpx.latitude_deg, gpx.longitude_deg)
    np.testing.assert_allclose(east, truth.east_m, atol=0.01)
    np.testing.assert_allclose(north, truth.north_m, atol=0.01)
    ais = formats.read_fixes(tmp_path / "ais.nmea", mmsi=211_000_001)
    truth = made.harbour.truth(ais.time_utc_s)
    east, north = made.harbour.plane.to_plane(ais.latitude_deg, ais.longitude_deg)
    assert (ais.time_utc_s % 1.0 == 0.0).all()
    assert len(ais) > 20
    assert 0.5 < np.hypot(east - truth.east_m, north - truth.north_m).mean() < 6.0
    with pytest.raises(InputError, match="vessels"):
        formats.read_fixes(tmp_path / "ais.nmea")


def test_a_seed_gives_the_same_files(tmp_path: Path) -> None:
    noise = BoxNoise(std_px=2.0)
    for name in ("one", "two"):
        simulate(
            tmp_path / name, SimulationSettings(seed=9, video=False, annotator=noise, **SETTINGS)
        )  # type: ignore[arg-type]
    first = sorted(p for p in (tmp_path / "one").rglob("*") if p.is_file())
    assert len(first) > 8
    for path in first:
        twin = tmp_path / "two" / path.relative_to(tmp_path / "one")
        assert path.read_bytes() == twin.read_bytes()


def test_unlabelled_recordings_have_a_video_and_a_log_alone(tmp_path: Path) -> None:
    made = simulate(
        tmp_path,
        SimulationSettings(
            seed=2, recordings=2, duration_s=1.0, pause_s=1.0, image_size_px=(128, 72), unlabelled=1
        ),
    )
    labelled, bare = Scene.load(made.scene).recordings
    assert labelled.boxes_path is not None
    assert bare.boxes_path is None
    assert bare.detections_path is None
    assert bare.fixes_path is not None


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"clock": "atomic"}, "known are start, exact, stepped"),
        ({"recordings": 0}, "at least one"),
        ({"duration_s": 0.2}, "give 1 to 86400 s"),
        ({"duration_s": float("inf")}, "give 1 to 86400 s"),
        ({"rate_hz": 0.0}, "not between"),
        ({"image_size_px": (641, 360)}, "must be even"),
        ({"clock": "stepped", "duration_s": 10.0}, "or longer"),
        ({"unlabelled": 4}, "without boxes"),
    ],
)
def test_wrong_settings_are_refused_and_nothing_is_written(
    tmp_path: Path, settings: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        simulate(tmp_path / "out", SimulationSettings(**settings))  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
