"""What the check says is what is in the files, and what it refuses a run would refuse."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from _support.clocks import drawn_scene, unlabelled_scene

import sightline
from sightline import formats
from sightline.errors import SightlineError
from sightline.pipeline.check import CheckReport, check, check_scene
from sightline.pipeline.file_checks import hours_apart
from sightline.scene import Recording, Scene
from sightline.simulation.simulate import SimulationSettings, simulate
from sightline.types import Fixes, Frame
from sightline.video import write_video

SIZE_PX = (640, 360)
START_UTC_S = 1_717_236_000.0


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("check") / "harbour"
    simulate(
        folder,
        SimulationSettings(
            video=False, recordings=2, duration_s=40.0, seed=3, image_size_px=SIZE_PX
        ),
    )
    return folder


@pytest.fixture
def harbour(made: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "harbour"
    shutil.copytree(made, folder, ignore=shutil.ignore_patterns("truth*"))
    return folder


def replace(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def checked(harbour: Path) -> CheckReport:
    return check(harbour / "scene.toml")


def shift_log(harbour: Path, **by: float) -> None:
    """The log with other times or places."""
    fixes = formats.read_fixes(harbour / "target.gpx")
    formats.write_fixes(
        Fixes(
            fixes.time_utc_s + by.get("seconds", 0.0),
            fixes.latitude_deg + by.get("north_deg", 0.0),
            fixes.longitude_deg + by.get("east_deg", 0.0),
        ),
        harbour / "target.gpx",
    )


def run_refuses(harbour: Path) -> bool:
    try:
        sightline.run(Scene.load(harbour / "scene.toml"), model="camera")
    except SightlineError:
        return True
    return False


def test_a_good_scene_is_described_as_its_files_are(harbour: Path) -> None:
    report = checked(harbour)
    assert report.problems == []
    assert report.warnings == []
    assert [one.name for one in report.recordings] == ["01", "02"]
    first = report.recordings[0]
    # Counted apart from any reader.
    drawn = (harbour / "boxes" / "01.csv").read_text().splitlines()[1:]
    boxes = first.of("boxes")
    assert boxes is not None
    assert boxes.facts["boxes"] == len(drawn)
    assert boxes.facts["sources"] == {"annotator": len(drawn)}
    feet = np.array([[float(v) for v in row.split(",")[1:5]] for row in drawn])
    across = (feet[:, 0] + feet[:, 2]) / 2 / SIZE_PX[0]
    expected = [across.min(), across.max(), *np.array([feet[:, 3].min(), feet[:, 3].max()]) / 360]
    assert boxes.facts["part_of_picture"] == pytest.approx(expected, abs=1e-3)
    assert first.overlap == 1.0
    assert first.placed == len(drawn)

    log = first.of("log")
    assert log is not None
    assert log.facts["fixes"] == (harbour / "target.gpx").read_text().count("<trkpt")
    assert log.facts["usual_interval_s"] == pytest.approx(1.0, abs=0.05)
    written = re.findall(r"<time>([^<]+)Z</time>", (harbour / "target.gpx").read_text())
    steps_s = np.diff(np.array(written, dtype="datetime64[ms]")) / np.timedelta64(1, "s")
    assert log.facts["gaps"] == (steps_s > 8.0).sum()
    assert log.facts["longest_gap_s"] == pytest.approx(steps_s.max())
    # The same log, with its distances on a sphere.
    places = re.findall(r'lat="([-\d.]+)" lon="([-\d.]+)"', (harbour / "target.gpx").read_text())
    north, east = np.radians(np.array(places, dtype=float)).T
    north_0, east_0 = np.radians([54.3233, 10.1394])
    range_m = 6_371_000.0 * np.hypot(north - north_0, (east - east_0) * np.cos(north_0))
    assert log.facts["nearest_m"] == pytest.approx(range_m.min(), rel=0.005)
    assert log.facts["farthest_m"] == pytest.approx(range_m.max(), rel=0.005)
    assert first.range_m is not None
    assert range_m.min() * 0.99 < first.range_m[0] < first.range_m[1] < range_m.max() * 1.01
    assert "54.32330, 10.13940" in report.head
    assert len(report.lines()) <= 20


def test_what_is_said_can_be_read_as_json(harbour: Path) -> None:
    content = json.loads(json.dumps(checked(harbour).to_dict(), allow_nan=False))
    assert content["refused"] is False
    assert {one["kind"] for one in content["files"]} == {"boxes", "clock", "detections", "log"}
    # A log that two recordings share is there once.
    assert len(content["files"]) == 7


@pytest.mark.parametrize("hours", [2, -7])
def test_a_wrong_zone_is_named(harbour: Path, hours: int) -> None:
    shift_log(harbour, seconds=3600.0 * hours)
    report = checked(harbour)
    # A run finds the clock of the other zone, and a check says that there is one to find.
    assert report.problems == []
    when = "later" if hours > 0 else "earlier"
    named = [line for line in report.warnings if "its log does not overlap it" in line]
    assert len(named) == 2
    for line in named:
        assert f"{abs(hours)} hours {when}, 100 % of the recording" in line
    assert not run_refuses(harbour)


def test_a_log_of_another_day_is_not_blamed_on_the_zone(harbour: Path) -> None:
    shift_log(harbour, seconds=86_400.0 * 3 + 1000.0)
    (first, _) = checked(harbour).problems
    assert "does not overlap" in first
    assert "hour" not in first


def test_one_recording_without_overlap_is_a_warning(harbour: Path) -> None:
    shutil.copy(harbour / "target.gpx", harbour / "good.gpx")
    shift_log(harbour, seconds=3600.0)
    replace(harbour / "scene.toml", 'clock/02.csv"\n', 'clock/02.csv"\n# second\n')
    text = (harbour / "scene.toml").read_text()
    head, tail = text.split("# second")
    (harbour / "scene.toml").write_text(head + tail.replace("target.gpx", "good.gpx"))
    report = checked(harbour)
    assert report.problems == []
    assert "1 hour later" in report.warnings[0]
    # By the clock that its boxes tell.
    assert report.recordings[0].overlap == 1.0
    assert report.recordings[1].overlap == 1.0


def test_hours_apart() -> None:
    log = START_UTC_S + np.arange(0.0, 1800.0)
    for hours in (-14, -5, -1, 1, 1.5, 3, 5.5, 14):
        recording = START_UTC_S + 100.0 + np.arange(60.0) - 3600.0 * hours
        assert hours_apart(recording, log) == (hours, 1.0)
    assert hours_apart(START_UTC_S + 86_400.0 * 2 + np.arange(60.0), log) is None


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ({"north_deg": -30.0}, "is it the log of this place"),
        ({"east_deg": -2 * 10.1394}, "the sign of its longitude differs"),
        ({"north_deg": -2 * 54.3233}, "the sign of its latitude differs"),
    ],
)
def test_a_log_far_away_is_refused(harbour: Path, edit: dict[str, float], said: str) -> None:
    shift_log(harbour, **edit)
    (problem,) = [line for line in checked(harbour).problems if "from the camera" in line]
    assert said in problem
    assert "km from the camera" in problem


def test_swapped_columns_are_named(harbour: Path) -> None:
    fixes = formats.read_fixes(harbour / "target.gpx")
    formats.write_fixes(
        Fixes(fixes.time_utc_s, fixes.longitude_deg, fixes.latitude_deg), harbour / "target.gpx"
    )
    (problem,) = checked(harbour).problems
    assert "latitude and longitude are swapped" in problem


def test_a_swapped_camera_is_named(harbour: Path) -> None:
    scene = harbour / "scene.toml"
    replace(
        scene,
        "latitude_deg = 54.3233\nlongitude_deg = 10.1394",
        "latitude_deg = 10.1394\nlongitude_deg = 54.3233",
    )
    (problem,) = checked(harbour).problems
    assert "swapped" in problem


def test_a_sparse_log_and_one_that_stands_still(harbour: Path) -> None:
    fixes = formats.read_fixes(harbour / "target.gpx")
    formats.write_fixes(fixes[::12], harbour / "target.gpx")
    report = checked(harbour)
    assert any("a fix every 12 s is seldom" in line for line in report.warnings)
    still = Fixes(fixes.time_utc_s, np.full(len(fixes), 54.3240), np.full(len(fixes), 10.1390))
    formats.write_fixes(still, harbour / "target.gpx")
    assert any("hardly moved" in line for line in checked(harbour).warnings)


def test_boxes_of_another_picture(harbour: Path) -> None:
    table = harbour / "boxes" / "01.csv"
    rows = table.read_text().splitlines()
    larger = [rows[0]]
    for row in rows[1:]:
        frame, *corners, name = row.split(",")
        larger.append(",".join([frame, *(str(3.0 * float(value)) for value in corners), name]))
    table.write_text("\n".join(larger) + "\n")
    report = checked(harbour)
    (problem,) = report.problems
    assert "boxes lie outside the picture of 640 x 360 px" in problem
    assert run_refuses(harbour)


def test_few_boxes_in_a_small_part(harbour: Path) -> None:
    for name in ("01", "02"):
        table = harbour / "boxes" / f"{name}.csv"
        table.write_text("".join(table.read_text().splitlines(keepends=True)[:5]))
    report = checked(harbour)
    assert any("only 8 of 8 boxes" in line for line in report.warnings)
    replace(harbour / "scene.toml", 'boxes = "boxes/02.csv"\n', "")
    assert any("of the picture's width" in line for line in checked(harbour).warnings)


def test_without_drawn_boxes_the_camera_must_have_a_place(harbour: Path) -> None:
    scene = harbour / "scene.toml"
    for name in ("01", "02"):
        replace(scene, f'boxes = "boxes/{name}.csv"\n', "")
    assert checked(harbour).problems == []
    replace(scene, "latitude_deg = 54.3233\nlongitude_deg = 10.1394\n", "")
    (problem,) = checked(harbour).problems
    assert "say where the camera stands" in problem
    assert run_refuses(harbour)


def test_every_missing_file_is_named(harbour: Path) -> None:
    (harbour / "clock" / "01.csv").unlink()
    (harbour / "boxes" / "02.csv").unlink()
    report = checked(harbour)
    assert len(report.problems) == 2
    assert "recordings[1].clock" in report.problems[0]
    assert "recordings[2].boxes" in report.problems[1]
    # What is there is read all the same.
    assert {one.kind for one in report.files} >= {"boxes", "clock", "log"}


def test_every_spoilt_file_is_named(harbour: Path) -> None:
    (harbour / "clock" / "01.csv").write_text("frame,utc\n0,never\n")
    (harbour / "boxes" / "02.csv").write_text("frame,x1,y1,x2,y2\n0,1,2,x,4\n")
    report = checked(harbour)
    assert any("01.csv, line 2: never is no time" in line for line in report.problems)
    assert any("02.csv, line 2" in line for line in report.problems)


def picture_frames(count: int = 20, size_px: tuple[int, int] = SIZE_PX) -> list[Frame]:
    image = np.full((size_px[1], size_px[0], 3), 120, dtype=np.uint8)
    return [Frame(i, START_UTC_S + 0.1 * i, image) for i in range(count)]


def with_video(harbour: Path, line: str = "") -> None:
    """A scene of one video, without boxes."""
    (harbour / "scene.toml").write_text(
        "[camera]\nlatitude_deg = 54.3233\nlongitude_deg = 10.1394\nimage_size_px = [640, 360]\n"
        f'[[recordings]]\nname = "01"\nvideo = "01.mp4"\nfixes = "target.gpx"\n{line}\n'
    )


def test_a_video_is_described(harbour: Path) -> None:
    write_video(harbour / "01.mp4", picture_frames())
    with_video(harbour, "start_utc = 2024-06-01T10:00:00Z")
    report = checked(harbour)
    assert report.problems == []
    video = report.recordings[0].of("video")
    assert video is not None
    assert video.facts["frames"] == 20
    assert video.facts["size_px"] == [640.0, 360.0]
    assert video.facts["usual_interval_s"] == pytest.approx(0.1, abs=1e-3)
    assert video.facts["first_utc_s"] == START_UTC_S
    assert video.facts["last_utc_s"] == pytest.approx(START_UTC_S + 1.9, abs=1e-3)
    assert video.facts["times_from"] == "start_utc"
    assert report.recordings[0].overlap == 1.0


def test_a_video_of_another_size_is_refused(harbour: Path) -> None:
    write_video(harbour / "01.mp4", picture_frames(size_px=(320, 240)))
    with_video(harbour, "start_utc = 2024-06-01T10:00:00Z")
    (problem,) = checked(harbour).problems
    assert "pictures of 320 x 240 px, and image_size_px says 640 x 360" in problem
    assert run_refuses(harbour)


def test_a_video_without_times_is_refused(harbour: Path) -> None:
    # A container that says nothing of when it was made.
    with av.open(str(harbour / "01.mkv"), "w") as file:
        stream = file.add_stream("libx264", rate=10)
        stream.width, stream.height = SIZE_PX
        for frame in picture_frames():
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame.image_bgr, format="bgr24")))
        file.mux(stream.encode())
    with_video(harbour)
    replace(harbour / "scene.toml", "01.mp4", "01.mkv")
    (problem,) = checked(harbour).problems
    assert "nothing tells the times of its frames" in problem
    assert run_refuses(harbour)


def test_an_unsteady_rate_is_a_warning(harbour: Path) -> None:
    frames = picture_frames()
    times = START_UTC_S + np.cumsum(np.where(np.arange(20) % 4 == 0, 0.5, 0.1))
    uneven = [Frame(f.index, float(t), f.image_bgr) for f, t in zip(frames, times, strict=True)]
    write_video(harbour / "01.mp4", uneven)
    with_video(harbour, "start_utc = 2024-06-01T10:00:00Z")
    (warning,) = checked(harbour).warnings
    assert "its rate is unsteady: frames are 0.1 to 0.5 s apart" in warning


def test_pictures_of_two_sizes(harbour: Path) -> None:
    (harbour / "frames").mkdir()
    for frame in picture_frames(3):
        cv2.imwrite(str(harbour / "frames" / f"{frame.index:03d}.png"), frame.image_bgr)
    with_video(harbour, 'clock = "clock/01.csv"')
    replace(harbour / "scene.toml", 'video = "01.mp4"', 'frames = "frames"')
    report = checked(harbour)
    pictures = report.recordings[0].of("pictures")
    assert report.problems == []
    assert pictures is not None
    assert pictures.facts["frames"] == 3
    cv2.imwrite(str(harbour / "frames" / "001.png"), np.zeros((100, 100, 3), np.uint8))
    (problem,) = checked(harbour).problems
    assert "001.png has 100 x 100 px, 000.png 640 x 360 px" in problem
    # The short check of a run opens the first picture alone.
    assert check_scene(Scene.load(harbour / "scene.toml"), every_picture=False).problems == []


def test_single_files_are_told_by_what_is_in_them(harbour: Path) -> None:
    write_video(harbour / "01.mp4", picture_frames())
    model = sightline.fit(Scene.load(harbour / "scene.toml"), model="qkr")
    tracks = harbour / "tracks.geojson"
    sightline.track(
        harbour / "boxes" / "01.csv", model, clock=formats.read_clock(harbour / "clock" / "01.csv")
    ).write(tracks)
    sightline.Tracks.read(tracks).write(harbour / "seen.kml")
    fixes = formats.read_fixes(harbour / "target.gpx")
    places = np.column_stack([fixes.longitude_deg, fixes.latitude_deg]).tolist()
    line = {"type": "LineString", "coordinates": places}
    times = {"coordTimes": fixes.time_utc_s.tolist()}
    feature = {"type": "Feature", "geometry": line, "properties": times}
    document = {"type": "FeatureCollection", "features": [feature]}
    (harbour / "log.geojson").write_text(json.dumps(document))
    names = {
        # Tracks in KML are written, and read as a log.
        "seen.kml": "log",
        "log.geojson": "log",
        "scene.toml": "scene",
        "target.gpx": "log",
        "ais.nmea": "AIS feed",
        "01.mp4": "video",
        "boxes/01.csv": "boxes",
        "clock/01.csv": "clock",
        "tracks.geojson": "tracks",
        str(model.save(harbour / "model.safetensors").name): "model",
    }
    report = check([harbour / name for name in names])
    assert report.problems == []
    assert [one.kind for one in report.files] == list(names.values())
    assert all(one.said for one in report.files)


def test_single_files_that_do_not_overlap(harbour: Path) -> None:
    shift_log(harbour, seconds=-3600.0)
    report = check([harbour / "target.gpx", harbour / "clock" / "01.csv"])
    assert any("1 hour earlier, 100 % of the recording" in line for line in report.warnings)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    assert check(tmp_path / "nothing.csv").problems == [
        f"{tmp_path / 'nothing.csv'}: there is no such file"
    ]


MARGIN_S = 5.0


def late_scene(folder: Path, ahead_s: float, duration_s: float = 60.0) -> Scene:
    """Drawn boxes by a clock that is ahead, and logs that begin and end with the recordings."""
    both = {"01": ahead_s, "02": ahead_s}
    return drawn_scene(folder, both, duration_s=duration_s, margin_s=MARGIN_S)


def cut_log(recording: Recording, begin_utc_s: float, end_utc_s: float) -> None:
    """The log of a recording between two times."""
    fixes, path = recording.fixes(), recording.fixes_path
    assert path is not None
    inside = (fixes.time_utc_s >= begin_utc_s) & (fixes.time_utc_s <= end_utc_s)
    formats.write_fixes(fixes[inside], path)


@pytest.mark.parametrize("ahead_s", [40.0, pytest.param(-40.0, marks=pytest.mark.slow)])
def test_an_overlap_is_judged_by_the_clock_that_a_run_takes(tmp_path: Path, ahead_s: float) -> None:
    """By the camera's own clock the log has fixes for a third of it."""
    report = check(late_scene(tmp_path, ahead_s).path)
    assert not [line for line in report.warnings if "fixes at most" in line]
    for one in report.recordings:
        assert one.overlap == 1.0
        assert one.clock is not None
        assert abs(one.clock.offset_s - ahead_s) < 3.0 * one.clock.sigma_s
        assert one.clock.words in one.said


@pytest.mark.slow
def test_a_log_that_a_late_clock_is_out_of_is_no_problem(tmp_path: Path) -> None:
    scene = late_scene(tmp_path, 50.0, 40.0)
    report = check(scene.path)
    assert report.problems == []
    said = [line for line in report.warnings if "does not overlap" in line]
    assert len(said) == 2
    assert all("ahead of the log by its boxes, which is taken off" in line for line in said)
    assert [one.overlap for one in report.recordings] == [1.0, 1.0]
    assert not run_refuses(tmp_path)


@pytest.mark.slow
def test_a_log_that_ends_too_early_is_said_whatever_the_clock(tmp_path: Path) -> None:
    scene = late_scene(tmp_path, 0.0)
    begin_utc_s = scene["01"].boxes().time_utc_s[0]
    cut_log(scene["01"], begin_utc_s, begin_utc_s + 20.0)
    report = check(scene.path)
    (line,) = [line for line in report.warnings if "fixes at most" in line]
    assert line.startswith("recording 01: ")
    assert report.recordings[0].overlap == pytest.approx(20.0 / 60.0, abs=0.05)
    assert report.recordings[0].clock is None


def test_where_no_boxes_are_drawn_a_check_says_what_a_clock_would_do(tmp_path: Path) -> None:
    """Nothing is fitted by a check, and so nothing tells that clock yet."""
    scene = unlabelled_scene(tmp_path, 40.0)
    (recording,) = scene.recordings
    begin_utc_s = recording.detections().time_utc_s.min() - 40.0
    cut_log(recording, begin_utc_s - MARGIN_S, begin_utc_s + 55.0)
    (line,) = [x for x in check(scene.path).warnings if "fixes at most" in x]
    found = re.search(r"were its clock (\d+) s ahead of the log's, .* for (\d+) %", line)
    assert found is not None
    ahead_s, share = map(int, found.groups())
    assert 40 <= ahead_s <= 46
    assert share == pytest.approx(100.0 * 60.0 / 120.0, abs=2.0)
    assert line.endswith("a run looks whether it is")


def test_a_stated_clock_is_taken_off_frames_as_well(harbour: Path) -> None:
    write_video(harbour / "01.mp4", picture_frames())
    shift_log(harbour, seconds=-500.0)
    with_video(harbour, "start_utc = 2024-06-01T10:00:00Z\nclock_offset_s = 500.0")
    report = checked(harbour)
    assert report.problems == []
    assert report.recordings[0].overlap == 1.0
