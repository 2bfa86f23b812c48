from __future__ import annotations

import csv
import re
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import read_boxes
from sightline.geodesy import LocalPlane
from sightline.scene import Scene
from sightline.synchronisation import check_overlap
from sightline.types import Fixes, Frame
from sightline.video import write_video

START_S = 1_601_467_200.0  # 2020-09-30T12:00:00Z


def write_scene(folder: Path, text: str) -> Path:
    """A scene file beside one of everything that it may name."""
    (folder / "boxes.csv").write_text("frame,x1,y1,x2,y2\n0,1,2,5,6\n2,1,2,5,6\n")
    (folder / "timed.csv").write_text("time_utc,x1,y1,x2,y2\n100.5,1,2,5,6\n")
    (folder / "mixed.csv").write_text("frame,time_utc,x1,y1,x2,y2\n0,,1,2,5,6\n1,100.5,1,2,5,6\n")
    (folder / "clock.csv").write_text("frame,utc\n0,10.25\n1,11.5\n2,12.75\n")
    (folder / "fixes.csv").write_text(
        "time_utc,latitude_deg,longitude_deg\n1000000010,32.7,-117.2\n"
    )
    (folder / "points.csv").write_text("x_px,y_px,latitude_deg,longitude_deg\n1,2,32.7,-117.2\n")
    (folder / "frames").mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "frames" / "2.png"), np.zeros((8, 12, 3), np.uint8))
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def write_clip(path: Path) -> None:
    frames = [
        Frame(i, START_S + t, np.zeros((8, 12, 3), np.uint8)) for i, t in enumerate([0, 0.25, 1.5])
    ]
    write_video(path, frames)


def test_the_real_scene(data_dir: Path) -> None:
    folder = data_dir / "tracks-at-sea"
    scene = Scene.load(folder / "scene.toml")
    assert scene.camera.name == "san-diego-dock"
    assert scene.plane == LocalPlane(32.70297, -117.234631)
    assert scene.image_size_px == (1280, 720)
    assert len(scene.control_points) == 0
    names = re.findall(r'^name = "(\d+)"', (folder / "scene.toml").read_text(), re.MULTILINE)
    assert [recording.name for recording in scene.recordings] == names

    rows = {path.stem: list(csv.DictReader(path.open())) for path in (folder / "boxes").iterdir()}
    boxed = [recording for recording in scene.recordings if recording.boxes_path is not None]
    assert len(boxed) == 11
    assert {recording.name: len(recording.boxes()) for recording in boxed} == {
        name: len(lines) for name, lines in rows.items()
    }
    assert sum(map(len, rows.values())) == 178


def test_boxes_of_the_real_scene_have_the_times_of_its_clocks(data_dir: Path) -> None:
    folder = data_dir / "tracks-at-sea"
    scene = Scene.load(folder / "scene.toml")
    for recording in scene.recordings:
        if recording.boxes_path is None:
            continue
        with (folder / "clock" / f"{recording.name}.csv").open() as file:
            stamps = [
                datetime.fromisoformat(row["utc"]).timestamp() for row in csv.DictReader(file)
            ]
        boxes = recording.boxes()
        late = boxes.time_utc_s - np.array(stamps)[boxes.frame]
        assert (late >= 0.0).all()
        assert (late < 7.0).all()


def test_real_detections_carry_their_file_as_source(data_dir: Path) -> None:
    recording = Scene.load(data_dir / "tracks-at-sea" / "scene.toml")["07"]
    detections = recording.detections()
    assert set(detections.source) == {"07-orb"}
    assert np.isfinite(detections.time_utc_s).all()
    assert len(recording.fixes()) == 1837
    frame = next(recording.frames())
    assert frame.image_bgr.shape == (720, 1280, 3)
    assert frame.time_utc_s == recording.clock().time_utc_s([0])[0]


def test_a_scene_of_control_points_alone(tmp_path: Path, data_dir: Path) -> None:
    source = data_dir / "otvision" / "Cars-Truck.otrfpts"
    path = write_scene(tmp_path, f'control_points = "{source.as_posix()}"\n')
    scene = Scene.load(path)
    assert scene.plane is None
    assert scene.recordings == ()
    assert len(scene.control_points) == 5
    with pytest.raises(InputError, match="nothing tells the size of the picture"):
        _ = scene.image_size_px


def test_control_points_in_the_scene_file(tmp_path: Path) -> None:
    point = "[[control_points]]\npixel_px = [{}, 2.5]\nlatitude_deg = 51\nlongitude_deg = 13.9\n"
    scene = Scene.load(write_scene(tmp_path, point.format(1) + point.format(3)))
    np.testing.assert_array_equal(scene.control_points.pixel_px, [[1.0, 2.5], [3.0, 2.5]])
    np.testing.assert_array_equal(scene.control_points.latitude_deg, [51.0, 51.0])


def test_a_byte_order_mark_is_no_part_of_a_scene(tmp_path: Path) -> None:
    path = write_scene(tmp_path, '[[recordings]]\nname = "Süd"\nboxes = "timed.csv"\n')
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert [recording.name for recording in Scene.load(path).recordings] == ["Süd"]


def load(folder: Path, recording: str, camera: str = "") -> Scene:
    return Scene.load(write_scene(folder, f'{camera}\n[[recordings]]\nname = "a"\n{recording}\n'))


def test_a_clock_tells_the_times(tmp_path: Path) -> None:
    recording = load(tmp_path, 'frames = "frames"\nclock = "clock.csv"\nboxes = "boxes.csv"')["a"]
    np.testing.assert_array_equal(recording.boxes().time_utc_s, [10.25, 12.75])
    (frame,) = recording.frames()
    assert (frame.index, frame.time_utc_s) == (2, 12.75)


def test_boxes_with_times_need_no_clock(tmp_path: Path) -> None:
    recording = load(tmp_path, 'boxes = "timed.csv"\nfixes = "fixes.csv"')["a"]
    np.testing.assert_array_equal(recording.boxes().time_utc_s, [100.5])
    assert len(recording.fixes()) == 1


def test_the_table_has_the_last_word_on_times(tmp_path: Path) -> None:
    recording = load(tmp_path, 'boxes = "mixed.csv"\nclock = "clock.csv"')["a"]
    np.testing.assert_array_equal(recording.boxes().time_utc_s, [10.25, 100.5])


@pytest.mark.parametrize(
    ("start", "start_s"),
    [
        ("start_utc = 1970-01-01T00:16:40.5Z", 1000.5),
        ("start_utc = 1970-01-01T01:16:40.5+01:00", 1000.5),
        ("start_utc = 1970-01-01T00:16:40", 1000.0),
        ('start_utc = "1970-01-01T00:16:40Z"', 1000.0),
        ("", START_S),
    ],
)
def test_a_video_tells_the_times(tmp_path: Path, start: str, start_s: float) -> None:
    write_clip(tmp_path / "clip.mp4")
    scene = load(tmp_path, f'video = "clip.mp4"\nboxes = "boxes.csv"\n{start}')
    recording = scene["a"]
    np.testing.assert_allclose(recording.boxes().time_utc_s, [start_s, start_s + 1.5], atol=1e-5)
    times = [frame.time_utc_s for frame in recording.frames()]
    np.testing.assert_allclose(times, start_s + np.array([0, 0.25, 1.5]), rtol=0, atol=1e-5)
    assert scene.image_size_px == (12, 8)


def test_the_size_of_pictures_in_a_folder(tmp_path: Path) -> None:
    assert load(tmp_path, 'frames = "frames"').image_size_px == (12, 8)


def test_one_vessel_of_a_log(tmp_path: Path) -> None:
    recording = load(tmp_path, 'boxes = "timed.csv"\nfixes = "fixes.csv"\nmmsi = 366123456')["a"]
    with pytest.raises(InputError, match="holds no AIS sentence"):
        recording.fixes()


def test_some_recordings_of_a_scene(tmp_path: Path) -> None:
    recordings = "".join(f'[[recordings]]\nname = "{n}"\nboxes = "timed.csv"\n' for n in "abc")
    scene = Scene.load(write_scene(tmp_path, recordings))
    assert [r.name for r in scene.select(["c", "a"]).recordings] == ["a", "c"]
    assert [r.name for r in scene.without(["b"]).recordings] == ["a", "c"]
    for choose in (scene.select, scene.without):
        with pytest.raises(InputError, match="unknown recording 'd'; known are a, b, c"):
            choose(["d"])


def test_a_changed_log_is_read_again(tmp_path: Path) -> None:
    recording = load(tmp_path, 'boxes = "timed.csv"\nfixes = "fixes.csv"')["a"]
    assert recording.fixes().time_utc_s.tolist() == [1e9 + 10.0]
    (tmp_path / "fixes.csv").write_text(
        "time_utc,latitude_deg,longitude_deg\n1000000011,32.7,-117.2\n"
    )
    assert recording.fixes().time_utc_s.tolist() == [1e9 + 11.0]


A = '[[recordings]]\nname = "a"\n'
POINT = "[[control_points]]\npixel_px = [1, 2]\nlatitude_deg = 1\nlongitude_deg = 2\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[camera", "is no TOML: "),
        ("", "the scene is empty"),
        ("cameras = 1\n" + POINT, "unknown key cameras; known are camera, recordings, control_poi"),
        ("[camera]\nlattitude_deg = 1\n", "unknown key camera.lattitude_deg; known are name, lati"),
        (A + 'stream = "x"\n', r"unknown key recordings\[1\]\.stream; known are name, video, fram"),
        (POINT + "height = 1\n", r"unknown key control_points\[1\]\.height; known are pixel_px"),
        ("[camera]\nlatitude_deg = 91\nlongitude_deg = 0\n", r"camera\.latitude_deg: .*; it is 91"),
        ("[camera]\nlatitude_deg = 1\n", "camera: give both latitude_deg and longitude_deg, or"),
        (
            '[camera]\ncompensate_rotation = "no"\n',
            r"camera\.compensate_rotation: input should be a valid boolean",
        ),
        ('[camera]\nwatched = "no"\n', r"camera\.watched: input should be a valid boolean"),
        ("[camera]\nimage_size_px = [1280]\n", r"camera\.image_size_px: list should have at leas"),
        ("[camera]\nimage_size_px = [1280, 0]\n", r"camera\.image_size_px\[2\]: .* greater than 0"),
        ("[camera]\nname = 3\n", r"camera\.name: input should be a valid string; it is 3"),
        ('[[recordings]]\nboxes = "boxes.csv"\n', r"recordings\[1\]\.name is missing"),
        (A, r"recordings\[1\]: give a video, frames, boxes or detections; there is nothing to see"),
        (
            A + 'video = "v"\nframes = "frames"\n',
            r"recordings\[1\]: give video or frames, not both",
        ),
        (A + 'boxes = "b"\nstart_utc = 2020-09-30T12:00:00Z\n', "without a video give a clock"),
        (
            A + 'video = "v"\nclock = "c"\nstart_utc = 2020-09-30T12:00:00Z\n',
            "give start_utc or cl",
        ),
        (A + 'video = "v"\nstart_utc = 2020-09-30\n', r"recordings\[1\]\.start_utc: "),
        (A + 'video = "v"\nstart_utc = "noon"\n', r"recordings\[1\]\.start_utc: invalid isoformat"),
        (A + 'boxes = "boxes.csv"\nmmsi = 1\n', "mmsi chooses a vessel of the log"),
        (A + 'boxes = "missing.csv"\n', r"recordings\[1\]\.boxes names .*missing\.csv, which does"),
        (A + 'boxes = "frames"\n', r"recordings\[1\]\.boxes names .*frames, which is a folder"),
        (
            A + 'frames = "boxes.csv"\n',
            r"recordings\[1\]\.frames names .*boxes\.csv, which is a fi",
        ),
        ((A + 'boxes = "boxes.csv"\n') * 2, "two recordings are named 'a'; names must differ"),
        (
            'control_points = "missing.csv"\n',
            r"control_points names .*missing\.csv, which does not",
        ),
        (
            "[[control_points]]\npixel_px = [1, 2]\n",
            r"control_points\[1\]\.latitude_deg is missing",
        ),
        (POINT.replace("[1, 2]", "[1, inf]"), r"control_points\[1\]\.pixel_px\[2\]: .* finite"),
        ("control_points = 3\n", "control_points: input should be a valid list; it is 3"),
    ],
)
def test_refused_scenes(tmp_path: Path, text: str, message: str) -> None:
    path = write_scene(tmp_path, text)
    with pytest.raises(InputError, match=message) as caught:
        Scene.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_scene_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such scene file"):
        Scene.load(tmp_path / "missing.toml")
    with pytest.raises(InputError, match="is a folder; expected a scene file"):
        Scene.load(tmp_path)
    (tmp_path / "a.toml").write_bytes(b"\x89PNG\xff")
    with pytest.raises(InputError, match="is not text in UTF-8"):
        Scene.load(tmp_path / "a.toml")


def test_what_a_recording_does_not_have(tmp_path: Path) -> None:
    seen = load(tmp_path, 'frames = "frames"\n')["a"]
    with pytest.raises(InputError, match="recording a: has no boxes; give boxes = FILE"):
        seen.boxes()
    with pytest.raises(InputError, match="recording a: has no detections; give detections = FILE"):
        seen.detections()
    with pytest.raises(InputError, match="recording a: has no log; give fixes = FILE"):
        seen.fixes()
    boxed = load(tmp_path, 'boxes = "boxes.csv"\n')["a"]
    with pytest.raises(InputError, match="recording a: has no pictures; give video or frames"):
        boxed.frames()
    with pytest.raises(InputError, match=r"boxes\.csv: recording a: nothing tells the times"):
        boxed.boxes()


def test_boxes_beyond_the_clock(tmp_path: Path) -> None:
    recording = load(tmp_path, 'boxes = "boxes.csv"\nclock = "clock.csv"\n')["a"]
    (tmp_path / "boxes.csv").write_text("frame,x1,y1,x2,y2\n7,1,2,5,6\n")
    with pytest.raises(InputError, match=r"boxes\.csv: frame 7 has no time: the clock runs from"):
        recording.boxes()


@pytest.mark.parametrize("box", ["12,2,15,6", "-5,2,0,6", "1,8,5,9", "1,-4,5,0"])
def test_boxes_wholly_outside_the_picture(tmp_path: Path, box: str) -> None:
    (tmp_path / "out.csv").write_text(f"frame,time_utc,x1,y1,x2,y2\n0,5,1,2,5,6\n3,5,{box}\n")
    recording = load(tmp_path, 'boxes = "out.csv"', "[camera]\nimage_size_px = [12, 8]")["a"]
    message = (
        rf"out\.csv: the box of frame 3 \({box}\) lies wholly outside the picture of 12 x 8 px"
    )
    with pytest.raises(InputError, match=message):
        recording.boxes()


def test_boxes_that_reach_over_the_edge_are_kept(tmp_path: Path) -> None:
    (tmp_path / "over.csv").write_text("time_utc,x1,y1,x2,y2\n5,-3,-3,20,20\n")
    scene = load(tmp_path, 'boxes = "over.csv"', "[camera]\nimage_size_px = [12, 8]")
    np.testing.assert_array_equal(
        scene["a"].boxes().xyxy_px, read_boxes(tmp_path / "over.csv").xyxy_px
    )


def test_a_log_of_another_day_states_both_spans() -> None:
    times = START_S + np.array([0.0, 60.0, np.nan])
    day_after = Fixes(START_S + 86400.0 + np.array([0.0, 5.0]), np.zeros(2), np.zeros(2))
    with pytest.raises(InputError) as caught:
        check_overlap(times, day_after, "recording a")
    stamps = [
        datetime.fromtimestamp(moment, UTC).strftime("%Y-%m-%d %H:%M:%S")
        for moment in (START_S, START_S + 60.0, START_S + 86400.0, START_S + 86405.0)
    ]
    message = str(caught.value)
    assert [message.index(stamp) for stamp in stamps] == sorted(map(message.index, stamps))
    check_overlap(times, Fixes(START_S + np.array([-5.0, 5.0]), [0, 0], [0, 0]), "recording a")
    with pytest.raises(InputError, match="has no times"):
        check_overlap(np.array([np.nan]), day_after, "recording a")
