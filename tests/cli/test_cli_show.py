"""`sightline show`: what it writes, and what it refuses in a line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from conftest import SIZE_PX, Outcome, frames
from sightline import load, video
from sightline.formats import write_boxes, write_fixes, write_tracks
from sightline.types import Boxes, Fixes, PointKind, Track

Shell = Callable[..., Outcome]


@pytest.fixture
def found(harbour: Path) -> Path:
    """Tracks, boxes and a log of the boat in the small video."""
    model = load(harbour / "camera.safetensors")
    every = list(frames())
    times = np.array([frame.time_utc_s for frame in every])
    corners = np.array([[100 + 8 * i, 225, 150 + 8 * i, 255] for i in range(len(every))], float)
    where = model.locate(corners)
    n = len(times)
    track = Track(
        track_id=7,
        time_utc_s=times,
        east_m=where.east_m,
        north_m=where.north_m,
        velocity_east_mps=np.gradient(where.east_m, times),
        velocity_north_mps=np.gradient(where.north_m, times),
        covariance_m2=where.covariance_m2,
        velocity_covariance_m2ps2=np.tile(np.eye(2), (n, 1, 1)),
        kind=np.full(n, PointKind.MEASURED),
        plane=model.plane,
        label="boat",
    )
    write_tracks([track], harbour / "t.geojson")
    write_boxes(Boxes.of(corners, frame=np.arange(n)), harbour / "b.csv")
    write_fixes(Fixes(times, where.latitude_deg, where.longitude_deg, "Anna"), harbour / "log.csv")
    return harbour


def given(folder: Path, *more: object) -> list[object]:
    return [
        *("show", folder / "boat.mp4", "--model", folder / "camera.safetensors"),
        *("--tracks", folder / "t.geojson", "--boxes", folder / "b.csv", *more),
    ]


def test_a_video_is_written_with_the_times_of_the_source(found: Path, sightline: Shell) -> None:
    out = found / "out.mp4"
    extras = ("--fixes", found / "log.csv", "--rings", "--no-labels", "--json", found / "r.json")
    done = sightline(*given(found, "-o", out, *extras))
    assert (done.status, done.err) == (0, "")
    assert done.out == f"40 frames, 1 tracks\nvideo: {out}\n"
    result = json.loads((found / "r.json").read_text())
    assert result == {
        "frames": 40,
        "tracks": 1,
        "sound": False,
        "file": str(out),
        "complete": True,
    }
    np.testing.assert_allclose(
        video.video_info(out).presentation_s,
        video.video_info(found / "boat.mp4").presentation_s,
        atol=2e-5,
    )
    # The box that is drawn goes along with the boat.
    before = [frame.image_bgr.astype(int) for frame in frames()]
    for frame in list(video.frames(out))[5::10]:
        change = np.abs(frame.image_bgr - before[frame.index])[228:240].mean(axis=(0, 2))
        left = 100 + 8 * frame.index
        edge, beside = change[left - 1 : left + 1].min(), change[left - 14 : left - 6].max()
        # Beside it the ellipse is drawn.
        assert edge > max(30.0, 2.0 * beside)


def test_what_was_written_may_be_written_again_and_other_files_stay(
    found: Path, sightline: Shell
) -> None:
    for name, more in (("out.mp4", ()), ("out.png", ("--at", 3))):
        assert sightline(*given(found, "-o", found / name, *more)).status == 0
        assert sightline(*given(found, "-o", found / name, *more)).status == 0
    shutil.copy(found / "boat.mp4", found / "holiday.mp4")
    cv2.imwrite(str(found / "holiday.png"), np.zeros((9, 9, 3), np.uint8))
    for name, more in (("holiday.mp4", ()), ("holiday.png", ("--at", 3))):
        before = (found / name).read_bytes()
        done = sightline(*given(found, "-o", found / name, *more))
        assert done.status == 2
        assert "--overwrite" in done.err
        assert (found / name).read_bytes() == before
        assert sightline(*given(found, "-o", found / name, *more, "--overwrite")).status == 0


def test_a_picture_is_written(found: Path, sightline: Shell) -> None:
    done = sightline(*given(found, "-o", found / "p.png", "--at", "2023-11-14T22:13:21Z"))
    assert (done.status, done.err) == (0, "")
    named = cv2.imread(str(found / "p.png"))
    sightline(*given(found, "-o", found / "q.png", "--at", "10"))
    numbered = cv2.imread(str(found / "q.png"))
    assert named is not None
    assert numbered is not None
    assert named.shape == (SIZE_PX[1], SIZE_PX[0], 3)
    np.testing.assert_array_equal(named, numbered)


@pytest.mark.slow
def test_without_tracks_it_tracks_first(harbour: Path, sightline: Shell) -> None:
    done = sightline(
        *("show", harbour / "boat.mp4", "--model", harbour / "camera.safetensors"),
        *("--detector", "motion", "-o", harbour / "out.mp4"),
    )
    assert done.status == 0, done.err
    assert "40 frames, 1 tracks" in done.out
    last = list(video.frames(harbour / "out.mp4"))[-1].image_bgr
    boat = last[215:265, 400:480].astype(int)
    # The boat is dark, the sea is grey, and what was drawn has a colour.
    assert np.ptp(boat, axis=2).max() > 60


REFUSED = {
    "no model": (("--model", "none"), "none: there is no such model file"),
    "no picture's moment": (("-o", "p.png"), "nothing says which; give --at TIME or --at FRAME"),
    "a moment of a video": (("-o", "p.mp4", "--at", "3"), "--at 3: is for a picture"),
    "another ending": (("-o", "p.avi"), "known are .mp4, .png"),
    "no moment": (("-o", "p.png", "--at", "noon"), "'noon' is no time"),
    "no such frame": (("-o", "p.png", "--at", "40"), "has no frame 40; its frames are 0 to 39"),
    "no such tracks": (("--tracks", "none.csv"), "none.csv"),
    "no such boxes": (("--boxes", "none.csv"), "none.csv"),
    "no such log": (("--fixes", "none.gpx"), "none.gpx"),
    "no such mask": (("--mask", "none.png"), "none.png: there is no such file"),
    "no such clock": (("--clock", "none.csv"), "none.csv"),
    "a level of no use": (("--water-level", "1"), "fitted without water levels"),
    "no error": (("--fixes-sigma", "-1"), "--fixes-sigma -1: is no error of a log"),
    "no camera": (("--model", "qkr.safetensors"), "knows no camera"),
    "over a source": (("-o", "boat.mp4"), "is read by this command"),
    "over the tracks": (("-o", "t.geojson"), "known are .mp4, .png"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_input_is_refused_in_a_line(
    name: str, found: Path, sightline: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(found)
    before = sorted(path.name for path in found.iterdir())
    options, said = REFUSED[name]
    output = () if "-o" in options else ("-o", "out.mp4")
    done = sightline(*given(found), *output, *options)
    assert (done.status, done.out) == (2, "")
    assert said in done.err
    assert done.err.count("\n") == 1
    assert sorted(path.name for path in found.iterdir()) == before


@pytest.mark.parametrize("source", ["none.mp4", "b.csv", "rtsp://127.0.0.1/1", "log.gpx"])
def test_bad_sources_are_refused_in_a_line(
    source: str, found: Path, sightline: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(found)
    (found / "log.gpx").write_text("no video")
    done = sightline(
        *("show", source, "--model", "camera.safetensors", "--tracks", "t.geojson"),
        *("-o", "out.mp4"),
    )
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith(f"error: {source}: ")
    assert done.err.count("\n") == 1
    assert not (found / "out.mp4").exists()
