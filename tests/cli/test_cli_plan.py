"""`sightline plan`: what it writes, and what it refuses in a line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from conftest import Outcome
from sightline import load
from sightline.formats import write_fixes
from sightline.geodesy import LocalPlane
from sightline.types import Fixes

Shell = Callable[..., Outcome]

PLACE = (54.3233, 10.1394)
CAMERA = {
    "--height": "6",
    "--field-of-view": "65",
    "--size": "1280x720",
    "--place": "54.3233,10.1394",
    "--heading": "30",
}


def given(*more: object, **changed: str | None) -> list[object]:
    options = {**CAMERA, **{f"--{name.replace('_', '-')}": text for name, text in changed.items()}}
    return [
        "plan",
        *(f"{name}={text}" for name, text in options.items() if text is not None),
        *more,
    ]


@pytest.mark.slow
def test_a_plan_is_a_page_a_map_contours_and_numbers(tmp_path: Path, sightline: Shell) -> None:
    files = [tmp_path / name for name in ("plan.html", "plan.png", "plan.geojson")]
    outputs = [part for path in files for part in ("-o", path)]
    numbers = tmp_path / "plan.json"
    asked = given(
        "--drive", "across", "--every=4", "--boat", "5x2", "--boat", "12", "--tide=-1,1", *outputs
    )
    done = sightline(*asked, "--json", numbers)
    assert (done.status, done.err) == (0, "")
    assert "The horizon is 9.4 km away (8.7 km without refraction)." in done.out
    assert "1 m higher, all ranges come out 20 % too far unless its level is told" in done.out

    result = json.loads(numbers.read_text())
    assert result["plan"]["latitude_deg"] == pytest.approx(PLACE[0])
    assert result["curvature"]["pixel_from_m"] is None
    assert [boat["length_m"] for boat in result["boats"]] == [5.0, 12.0]
    assert {"height_m", "principal_dx_px"} <= set(result["undetermined"])
    assert {row["above_m"] for row in result["ahead"]} == {0.0, -1.0, 1.0}
    for row in result["ahead"]:
        if row["axis_m"] is not None and row["known_m"] is not None:
            assert row["axis_m"] > 0.9 * row["known_m"]

    page = files[0].read_text()
    assert "http" not in page.replace("http-equiv", "")
    assert "determined" in page
    assert cv2.imread(str(files[1])).std() > 20.0

    features = json.loads(files[2].read_text())["features"]
    assert {one["properties"]["kind"] for one in features} >= {"axis", "size"}
    plane = LocalPlane(*PLACE)
    at_mean = [one for one in features if one["properties"]["above_m"] == 0.0]
    (found,) = (one for one in at_mean if one["properties"].get("boat_m") == 5.0)
    longitude, latitude = np.array(found["geometry"]["coordinates"]).T
    east, north = plane.to_plane(latitude, longitude)
    ahead = np.argmin(np.abs(np.degrees(np.arctan2(east, north)) - 30.0))
    focal_px = 640.0 / np.tan(np.radians(32.5))
    assert np.hypot(east[ahead], north[ahead]) == pytest.approx(focal_px * 5.0 / 8.0, rel=0.02)

    # A later plan replaces an earlier one, and nothing else.
    assert sightline(*given("--drive", "none", *outputs, "--json", numbers)).status == 0
    files[2].write_text('{"type": "FeatureCollection", "features": []}')
    refused = sightline(*given("--drive", "none", *outputs))
    assert refused.status == 2
    assert "is not contours of a plan" in refused.err


def log_of(folder: Path, north_m: float) -> Path:
    """The log of a boat that drives to the west and back, so far north of the camera."""
    times = 1_700_000_000.0 + np.arange(160.0)
    east_m = np.concatenate([np.linspace(90.0, -20.0, 80), np.linspace(-20.0, 90.0, 80)])
    latitude, longitude = LocalPlane(*PLACE).to_geographic(east_m, np.full(160, north_m))
    path = folder / "boat.csv"
    write_fixes(Fixes(times, latitude, longitude, "boat"), path)
    return path


@pytest.mark.slow
def test_a_log_is_a_drive(tmp_path: Path, sightline: Shell) -> None:
    numbers = tmp_path / "plan.json"
    done = sightline(*given("--drive", log_of(tmp_path, 100.0), "--json", numbers))
    assert (done.status, done.err) == (0, "")
    drive = json.loads(numbers.read_text())["drive"]
    assert drive["duration_s"] == pytest.approx(159.0)
    assert 50 <= drive["boxes"] <= 80


def test_a_drive_behind_the_camera_is_refused(tmp_path: Path, sightline: Shell) -> None:
    done = sightline(*given("--drive", log_of(tmp_path, -100.0)))
    assert done.status == 2
    assert "the boat is never in the picture and 8 px wide" in done.err
    assert done.err.count("\n") == 1


def test_a_fitted_model_is_mapped_as_it_is(harbour: Path, sightline: Shell) -> None:
    numbers = harbour / "plan.json"
    model = harbour / "camera.safetensors"
    done = sightline("plan", "--model", model, "-o", harbour / "p.png", "--json", numbers)
    assert (done.status, done.err) == (0, "")
    result = json.loads(numbers.read_text())
    fitted = load(model)
    assert fitted.camera is not None
    assert result["plan"]["height_m"] == pytest.approx(fitted.camera.height_m)
    said = {one.name: one.determined for one in fitted.report.parameters}
    assert {one["name"]: one["determined"] for one in result["parameters"]} == said


@pytest.mark.parametrize(
    ("changed", "more", "message"),
    [
        ({"height": "0"}, (), "--height 0: must be more than 0"),
        ({"height": "nan"}, (), "--height nan: must be more than 0"),
        ({"field_of_view": "200"}, (), "--field-of-view 200: must lie between 1 and 170 degrees"),
        ({"heading": "400"}, (), "--heading 400: must lie between 0 and 360 degrees"),
        ({"heading": "-1"}, (), "--heading -1: must lie between 0 and 360 degrees"),
        ({"place": "95,10"}, (), "--place '95,10': is not on the earth"),
        ({"place": "here"}, (), "--place 'here': expected two numbers"),
        ({"place": None}, (), "--place: missing"),
        ({"size": "0x720"}, (), "--size"),
        ({"pitch": "-44"}, (), "water"),
        ({"boat": "0"}, (), "--boat '0'"),
        ({"boat": "5xbeam"}, (), "--boat '5xbeam': expected a length"),
        ({"least_px": "0"}, (), "--least-px 0: must be more than 0"),
        ({"box_px": "-1"}, (), "--box-px -1: must be more than 0"),
        ({"tide": "1,-1"}, (), "--tide '1,-1': give low water, then high water"),
        ({"tide": "-1,7"}, (), "drowns a camera 6 m above the water"),
        ({"drive": "circles"}, (), "--drive circles: there is no such log, and no such pattern"),
        ({"state": "colour"}, (), "unknown key of [camera] 'colour'"),
        ({"source": "me"}, (), "--source: is for a fitted model"),
        ({"distortion": "-3,0"}, (), "folds the picture over itself"),
        ({}, ("-o", "plan.pdf"), "no plan is written that ends in '.pdf'"),
        ({"model": "no.safetensors"}, (), "--height: the model no.safetensors has a camera"),
    ],
)
def test_a_wrong_option_is_one_line(
    changed: dict[str, str | None], more: tuple[str, ...], message: str, sightline: Shell
) -> None:
    done = sightline(*given(*more, **changed))
    assert done.status == 2
    assert message in done.err
    assert done.err.count("\n") == 1
    assert done.out == ""


def test_models_without_a_camera_or_on_a_platform_are_refused(
    harbour: Path, sightline: Shell
) -> None:
    replace(load(harbour / "camera.safetensors"), moving=True).save(harbour / "ship.safetensors")
    for name, message in (("qkr", "knows no camera"), ("ship", "a platform that moves")):
        done = sightline("plan", "--model", harbour / f"{name}.safetensors")
        assert done.status == 2
        assert message in done.err
        assert done.err.count("\n") == 1
    done = sightline("plan", "--model", harbour / "camera.safetensors", "--source", "nobody")
    assert (done.status, "has learned from no boxes of 'nobody'" in done.err) == (2, True)
