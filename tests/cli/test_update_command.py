"""`sightline fit --update`, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from sightline.cli import app
from sightline.errors import InputError, ModelFileError
from sightline.formats import write_boxes, write_fixes
from sightline.pipeline.fit_unlabelled import fit_scene, update_scene
from sightline.scene import Scene
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, ReceiverNoise


def day(folder, harbour, turned_px=0.0, size="[1280, 720]"):
    """A day of a camera: boxes, a log, and the scene file."""
    folder.mkdir()
    times = harbour.times(rate_hz=0.5)
    boxes = harbour.boxes(times, noise=BoxNoise(std_px=1.0))
    xyxy = boxes.xyxy_px.copy()
    xyxy[:, 0::2] -= turned_px
    inside = (xyxy[:, 2] > 20.0) & (xyxy[:, 0] < 1260.0)
    write_boxes(boxes.with_columns(xyxy_px=xyxy)[inside], folder / "boxes.csv")
    write_fixes(harbour.fixes(ReceiverNoise(std_m=1.0)), folder / "log.csv")
    plane = harbour.plane
    (folder / "scene.toml").write_text(
        f"[camera]\nlatitude_deg = {plane.latitude_deg}\nlongitude_deg = {plane.longitude_deg}\n"
        f'image_size_px = {size}\n[[recordings]]\nname = "one"\nboxes = "boxes.csv"\n'
        'fixes = "log.csv"\n',
        encoding="utf-8",
    )
    return Scene.load(folder / "scene.toml")


def test_a_new_day_improves_a_model_and_tells_whether_the_camera_was_turned(tmp_path):
    harbour = Harbour.random(3, HarbourSettings(duration_s=240.0))

    focal_px = harbour.camera.focal_length_px
    old = fit_scene(day(tmp_path / "first", harbour), "camera")
    same = update_scene(day(tmp_path / "second", harbour), old)
    assert "stands as it did" in same.report.statements[0]
    before = {p.name: p.sigma for p in old.report.parameters}
    after = {p.name: p.sigma for p in same.report.parameters}
    assert after["height_m"] < before["height_m"]
    other = day(tmp_path / "third", harbour, turned_px=focal_px * np.tan(np.radians(1.0)))
    turned = update_scene(other, old)
    assert "was rotated" in turned.report.statements[0]
    assert turned.camera is not None
    assert old.camera is not None
    change = turned.camera.heading_deg - old.camera.heading_deg
    assert (change + 180.0) % 360.0 - 180.0 == pytest.approx(1.0, abs=0.4)


def test_models_that_cannot_be_updated_are_refused_in_one_line_and_nothing_is_written(tmp_path):
    harbour = Harbour.random(3, HarbourSettings(duration_s=120.0))

    scene = day(tmp_path / "first", harbour)
    paper = fit_scene(scene, "qkr")
    with pytest.raises(InputError, match="has no camera"):
        update_scene(scene, paper)
    camera = fit_scene(scene, "camera")
    with pytest.raises(InputError, match="fit anew"):
        update_scene(day(tmp_path / "wide", harbour, size="[1920, 1080]"), camera)
    path = tmp_path / "first" / "scene.toml"
    out = tmp_path / "new.safetensors"
    run = CliRunner().invoke(app, ["fit", str(path), "--update", "none.st", "-o", str(out)])
    assert isinstance(run.exception, ModelFileError)
    run = CliRunner().invoke(app, ["fit", str(path), "--detector", "owl", "-o", str(out)])
    assert isinstance(run.exception, InputError)
    assert not out.exists()


@pytest.fixture(scope="module")
def bay(data_dir):
    """The real scene, and a model of its camera as it lay after it was knocked in recording 08."""
    scene = Scene.load(data_dir / "tracks-at-sea" / "scene.toml")
    return scene, fit_scene(scene.select(["09", "10", "13", "15", "17"]), "camera")


def test_pictures_tell_a_tenth_of_a_degree_of_roll_between_two_days(bay):
    scene, after = bay
    before = update_scene(scene.select(["07"]), after)
    said = before.report.statements[0]
    assert said.startswith("The camera was rotated: in recording 07, by its pictures, from its")
    roll_deg = float(said.split(" in roll")[0].split(" ± ")[-2].split()[-1])
    assert roll_deg == pytest.approx(-0.1, abs=0.03)
    same = update_scene(scene.select(["21"]), after)
    assert same.report.statements[0] == (
        "The camera stands as it did when the old model was fitted, as far as the pictures tell."
    )


def test_boxes_that_contradict_pictures_are_told_of(bay, tmp_path):
    """Boxes of a turned camera beside pictures of one that was not."""
    scene, after = bay
    recording = scene["21"]
    boxes = recording.boxes()
    corners = boxes.xyxy_px + np.array([0.0, 12.0, 0.0, 12.0])
    write_boxes(boxes.with_columns(xyxy_px=corners), tmp_path / "b.csv")
    lowered = replace(scene, recordings=(replace(recording, boxes_path=tmp_path / "b.csv"),))
    said = update_scene(lowered, after).report.statements[0]
    assert said.startswith("The boxes of recording 21 lie as if the camera were rotated by")
    assert "raised, lowered or put elsewhere" in said
